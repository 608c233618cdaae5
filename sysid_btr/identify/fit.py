"""Fitting declared parameters: estimate, intervals, numerics check, scores before and after."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from time import perf_counter
from typing import TYPE_CHECKING, Any

import numpy as np

from sysid_btr._typing import FloatArray
from sysid_btr.errors import UsageError
from sysid_btr.estimators.base import Budget, Estimator, FitResult, Progress, Termination, uses_residuals, without_loss
from sysid_btr.estimators.chain import Chain, needs_residuals
from sysid_btr.estimators.journal import Journal
from sysid_btr.estimators.lsq import LeastSquares
from sysid_btr.identify.bounds import grow_bounds
from sysid_btr.identify.coarse import realise_servo, weigh_columns
from sysid_btr.identify.deferred import cheaper, deferred_fit
from sysid_btr.identify.discrepancy import widened
from sysid_btr.identify.ends import followed
from sysid_btr.identify.fixing import fix_unidentifiable
from sysid_btr.identify.intervals import Estimate, Profile, estimates, held_to_model
from sysid_btr.identify.nuisance import assumptions, check_nuisance, error_of_the_rest
from sysid_btr.identify.outcome import StudyOutcome
from sysid_btr.identify.prior import doubt
from sysid_btr.identify.recorder import as_recorded
from sysid_btr.identify.scores import Misfit, Scores, misfit_of, score
from sysid_btr.identify.sensitivity import with_sensitivity
from sysid_btr.identify.step_check import Optimum, with_short_steps
from sysid_btr.identify.study import Study
from sysid_btr.models.robot import channel_units
from sysid_btr.objectives.distance import Distance, DistanceProblem
from sysid_btr.objectives.problem import ReplayProblem
from sysid_btr.progress import phase, shows_progress, watched
from sysid_btr.terms.base import Term
from sysid_btr.terms.model import Model, Terms
from sysid_btr.units import si_all

if TYPE_CHECKING:
    from numpy.random import Generator


RISES = 1.01
"""Ratio of errors beyond which one is said to rise: less is a matter of the numerics."""


@dataclass(frozen=True, eq=False, repr=False)
class Fit(StudyOutcome):
    """Declared parameters fitted to a study.

    Attributes
    ----------
    study : as fitted; its numerics may have been refined.
    model : terms whose parameters were fitted, at the estimates' values.
    estimates : one a parameter.
    nominal, before : scores of the plain and of the fitted model on fitted and held-out data.
    result : what the estimator returned.
    numerics_shift : (p,) change of the estimates when the step is halved; on walks with the error of `Fused`.
    replays : candidates simulated.
    seconds : wall time.
    optimum : (p,) the model's values; for walks whose motion is more informative than replays are, where residuals
        are least.
    profiles : likelihood along single parameters, where it was asked for (`identify.profile`).
    """

    study: Study
    model: Model
    estimates: tuple[Estimate, ...]
    nominal: Scores
    before: Scores
    result: FitResult
    numerics_shift: FloatArray
    replays: int
    seconds: float
    optimum: FloatArray
    profiles: tuple[Profile, ...] = ()

    @property
    def parameters(self) -> tuple[Estimate, ...]:
        """The declared parameters, as in result.json: here these are all `estimates`."""
        return self.estimates

    @property
    def values(self) -> FloatArray:
        """(p,) the estimates' values."""
        return self.model.values

    @property
    def message(self) -> str:
        """The outcome in one sentence."""
        identifiable = sum(e.identifiable != "no" for e in self.estimates)
        parts = [] if self.misfit is None else [self.misfit.words]
        parts.append(f"{identifiable} of {len(self.estimates)} parameters are identifiable from this log")
        channel = self.study.leading_channel
        if channel in self.before.holdout:
            nominal, before = self.nominal.holdout[channel], self.before.holdout[channel]
            unit = channel_units(self.study.robot)[channel].partition(",")[0]
            first, last, floor = si_all([nominal.rmse, before.rmse, before.floor], unit)
            goes = "rises" if before.rmse > RISES * nominal.rmse else "goes"
            parts.append(f"the held-out {channel} error {goes} from {first} to {last}, with a noise floor of {floor}")
        if implausible := doubt(self.model.terms.parameters, self.values):
            parts.append(f"{implausible} (`sysid-btr close` looks for it)")
        if not self.result.converged:
            parts.append("the fit did not converge")
        return "; ".join(parts) + "."

    @property
    def misfit(self) -> Misfit | None:
        """How far the fitted model is from its own data; None where it explains them down to their noise."""
        return misfit_of(self.before.train, self.study.leading_channel, self.study.procedure.tolerated)

    @property
    def found(self) -> dict[str, Any]:
        """What results of kind ``fit`` have beside study and cost; as no effect is added, after equals before."""
        before = self.before.to_dict()
        return {
            "kind": "fit",
            "message": self.message,
            "converged": self.result.converged,
            "termination": self.result.termination.value,
            "misfit": None if self.misfit is None else asdict(self.misfit),
            "noise_floor": self.before.floors,
            "nominal": self.nominal.to_dict(),
            "before": before,
            "after": before,
            "parameters": [
                {**e.to_dict(), "numerics_shift": float(shift)}
                for e, shift in zip(self.estimates, self.numerics_shift, strict=True)
            ],
            "effects": [],
            "candidates": [],
            "steps": [],
            "history": [{"replays": done, "loss": loss} for done, loss in self.result.history],
            "signature": None,
            **assumptions(self.study, self.model.terms),
            **({"profiles": [p.to_dict() for p in self.profiles]} if self.profiles else {}),
        }


@shows_progress("fit")
def fit(
    study: Study,
    parameters: Sequence[str] | Sequence[Term],
    *,
    estimator: Estimator | None = None,
    rng: Generator | None = None,
    budget: Budget | None = None,
    journal: Journal | None = None,
    progress: Progress = watched,
    start: FloatArray | None = None,
    distance: Distance | None = None,
) -> Fit:
    """Fit parameters of the model to the training part of a study.

    Parameters
    ----------
    study : robot and logs.
    parameters : expressions of the grammar, or terms.
    estimator : default least squares.
    rng : for estimators that draw; default seed 0.
    budget, journal, progress : see `sysid_btr.estimators`. The budget is that of all searches of the fit together; what
        prepares them (numerics, the realisation of a servo) and what describes their result is not counted. Without
        `progress` a line is shown where stderr is a terminal or a notebook; `silent` shows none.
    start : (p,) where to begin; default the nominal values, of a payload a small mass.
    distance : minimised instead of the whitened squares (MSE, phi2), by an estimator that needs no residuals.
        Intervals are then those of the likelihood at the point found.

    Raises
    ------
    UsageError
        If no parameter is named, or least squares are asked to minimise a distance.

    Returns
    -------
    Fit
        Parameters that are not identifiable are fixed at their nominal value and marked.
    """
    began, given = perf_counter(), study
    check_nuisance(study.robot, study.nuisance)
    terms = as_terms(study, parameters)
    if not terms.parameters:
        raise UsageError("nothing to fit: free at least one parameter, for example --fit 'mass:*'")
    estimator = LeastSquares() if estimator is None else estimator
    check_distance(estimator, distance)
    rng = np.random.default_rng(0) if rng is None else rng
    model = Model.of(terms, terms.begin if start is None else start)
    budget = budget or Budget()
    search = _Search(estimator, distance, rng, budget, Journal() if journal is None else journal, progress)
    with phase("search", 0.7):
        solved = search.run(realise_servo(study, model), model)
    study, replays = solved.study, solved.replays
    at = Optimum.of(solved.problem, solved.result, study.stencil(terms))
    if solved.by_residuals:
        with phase("bounds", 0.2):
            at, spent = grow_bounds(study, at, budget.after(replays), progress)
            model, replays = at.problem.model, replays + spent
        with phase("half the step", 0.3):
            study, at, shift, spent = with_short_steps(study, model, at, rng, budget.after(replays), progress)
            replays += spent
    else:
        shift = at.shift
    problem, values, jacobian, residual = at.problem, at.values, at.jacobian, at.residual
    known, optimum = None, values
    fused = study.fuse(problem, values, jacobian, residual, follow=solved.by_residuals)
    if fused is not None:
        values, jacobian, residual = fused.values, fused.jacobian, fused.residual
        shift, known = np.hypot(shift, fused.error), fused.known
    beyond = np.hypot(shift, error_of_the_rest(study, problem.model.at(at.values), at.jacobian))
    found = estimates(problem.parameters, values, jacobian, residual, problem.blocks, beyond, known)
    if solved.by_residuals:
        with phase("intervals", 0.7):
            if known is None and solved.result.termination is not Termination.BUDGET_SPENT:
                near = cheaper(problem, study.cheap, values)
                found, spent = followed(problem.parameters, found, near, values, jacobian)
                replays += spent
            goal, left = study.with_belief(problem), budget.after(replays)
            values, found, spent = fix_unidentifiable(goal, values, found, jacobian, known, left)
            replays += spent
    before = score(study, model.at(values))
    # from the initial states that it wants itself, not from the fitted model's
    nominal = score(replace(study, train=given.train, holdout=given.holdout), Model.of(terms))
    if misfit_of(before.train, study.leading_channel, study.procedure.tolerated) is not None:
        found = widened(found, problem, at.values, jacobian, residual, study.scales)
    if solved.by_residuals and known is None and study.redundancy:
        found = held_to_model(found, problem.parameters)
    return Fit(
        study=study,
        model=model.at(values),
        estimates=with_sensitivity(found, at.problem, at.jacobian),
        nominal=nominal,
        before=before,
        result=solved.result,
        numerics_shift=shift,
        replays=replays,
        seconds=perf_counter() - began,
        optimum=values if known is None else optimum,
    )


def check_distance(estimator: Estimator, distance: Distance | None) -> None:
    """Refuse to minimise a distance by an estimator that minimises squared residuals."""
    if distance is not None and needs_residuals(estimator):
        raise UsageError(
            f"{estimator.name} minimises squared residuals: for another distance choose ga, cmaes or nlopt:ALGORITHM"
        )


@dataclass(frozen=True, eq=False)
class _Solved:
    """What a search ended with: the study, perhaps with weighed columns, its problem, and the estimator's result."""

    study: Study
    problem: ReplayProblem
    result: FitResult
    replays: int
    by_residuals: bool


@dataclass(frozen=True, eq=False)
class _Search:
    """How parameters are searched for."""

    estimator: Estimator
    distance: Distance | None
    rng: Generator
    budget: Budget
    journal: Journal
    progress: Progress

    def run(self, study: Study, model: Model) -> _Solved:
        """Search from a model; an estimator by residuals gets columns that are weighed by what can be explained."""
        estimator, rng, progress = self.estimator, self.rng, self.progress
        budget, journal = self.budget, self.journal
        problem, spent = study.train_problem(model), 0
        if isinstance(estimator, Chain) and uses_residuals(estimator.stages[-1]) and self.distance is None:
            # the others find the valley; least squares then do from there what they always do
            explored, estimator, budget = estimator.explore(
                problem, rng=rng, budget=budget, journal=journal, progress=progress
            )
            spent = explored.evaluations if uses_residuals(estimator) else 0
            journal = journal.section()
            problem = study.train_problem(model.at(explored.x))
        if not uses_residuals(estimator):
            study = as_recorded(study, problem.model)
            problem = study.train_problem(problem.model)
            goal = problem if self.distance is None else DistanceProblem(problem, self.distance)
            result = estimator.fit(goal, rng=rng, budget=budget, journal=journal, progress=progress)
            return _Solved(study, problem, result, result.evaluations + spent, False)
        with phase("first fit", 0.5):
            # columns get their weights here: its loss is another one
            study, coarse = weigh_columns(study, model.at(problem.start), budget, without_loss(progress))
        budget = budget.after(coarse.evaluations)
        problem, spent = study.train_problem(coarse.model), spent + coarse.evaluations
        believed = study.with_belief(problem)
        suited = study.procedure.suited(estimator)
        if study.procedure.deferred:
            result = deferred_fit(
                believed,
                study.cheap,
                suited,
                step=study.stencil(model.terms),
                rng=rng,
                budget=budget,
                journal=journal,
                progress=progress,
            )
        else:
            result = suited.fit(believed, rng=rng, budget=budget, journal=journal, progress=progress)
        return _Solved(study, problem, result, result.evaluations + spent, True)


def as_terms(study: Study, parameters: Sequence[str] | Sequence[Term]) -> Terms:
    """Expressions of the grammar as terms; terms as they are."""
    given = (p for p in parameters if isinstance(p, Term))
    return Terms((*given, *study.declare([p for p in parameters if isinstance(p, str)])))
