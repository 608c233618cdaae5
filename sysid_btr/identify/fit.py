"""Fitting declared parameters: estimate, intervals, numerics check, scores before and after."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from time import perf_counter
from typing import TYPE_CHECKING, Any

import numpy as np

from sysid_btr._typing import BoolArray, FloatArray
from sysid_btr.errors import UsageError
from sysid_btr.estimators.base import Budget, Estimator, FitResult, Progress, Termination, silent
from sysid_btr.estimators.chain import Chain
from sysid_btr.estimators.journal import Journal
from sysid_btr.estimators.lsq import LeastSquares, linearise
from sysid_btr.floating_base.walk import Walk
from sysid_btr.identify.deferred import deferred_fit
from sysid_btr.identify.fusion import weigh_walks
from sysid_btr.identify.intervals import NOT_IDENTIFIABLE, Estimate, Profile, estimates
from sysid_btr.identify.numerics import held_numerics
from sysid_btr.identify.outcome import study_result
from sysid_btr.identify.refit import Fitted, best_start, inflate, judge, refit, robust_refit, shorten, walking
from sysid_btr.identify.scores import Scores, score
from sysid_btr.identify.study import Study
from sysid_btr.models.robot import channel_units
from sysid_btr.objectives.covariance import RANK, Known, newton
from sysid_btr.objectives.distance import Distance, DistanceProblem
from sysid_btr.objectives.problem import Conditional, ReplayProblem
from sysid_btr.terms.base import Term
from sysid_btr.terms.model import Model, Terms
from sysid_btr.units import si_all

if TYPE_CHECKING:
    from numpy.random import Generator

SHIFT_TOLERATED = 0.3
"""Shift of an estimate under half the step, in standard errors, beyond which the step is halved."""
MAX_REFINEMENTS = 3
MISFIT = 1.5
"""Chi2 of a column beyond which its error, not its noise, sets its weight."""
ROBUST_ROUNDS = 4
SERVO_SECONDS = 6.0
"""Part of each log on which the realisation of a digital servo is chosen ..."""
SERVO_MARGIN = 0.05
"""... and mean decrease of log chi2 for which the one that takes longer is."""
FAR = 3.0
"""Mean squared whitened residual beyond which a model is too wrong for its step to matter."""


@dataclass(frozen=True, eq=False)
class Fit:
    """Declared parameters fitted to a study.

    Attributes
    ----------
    study : as fitted; its numerics may have been refined.
    model : terms whose parameters were fitted, at the estimates' values.
    estimates : one a parameter.
    nominal, before : scores of the plain and of the fitted model on fitted and held-out data.
    result : what the estimator returned.
    numerics_shift : (p,) change of the estimates when the step is halved; on walks with the error of `weigh_walks`.
    replays : candidates simulated.
    seconds : wall time.
    optimum : (p,) the model's values, but for walks whose motion tells more than replays do: there, where residuals
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
    def values(self) -> FloatArray:
        """(p,) the estimates' values."""
        return self.model.values

    @property
    def message(self) -> str:
        """The outcome in one sentence."""
        told = sum(e.identifiable != "no" for e in self.estimates)
        parts = [f"{told} of {len(self.estimates)} parameters can be told from this log"]
        if "position" in self.before.holdout:
            nominal, before = self.nominal.holdout["position"], self.before.holdout["position"]
            unit = channel_units(self.study.robot)["position"].partition(",")[0]
            first, last, floor = si_all([nominal.rmse, before.rmse, before.floor], unit)
            parts.append(
                f"the held-out position error goes from {first} to {last}, "
                f"where the sensor's own noise is {floor}"
            )
        if not self.result.converged:
            parts.append("the fit did not converge")
        return "; ".join(parts) + "."

    @property
    def found(self) -> dict[str, Any]:
        """What results of kind ``fit`` have beside study and cost; as no effect is added, after equals before."""
        before = self.before.to_dict()
        return {
            "kind": "fit",
            "message": self.message,
            "converged": self.result.converged,
            "termination": self.result.termination.value,
            "noise_floor": self.before.floors,
            "nominal": self.nominal.to_dict(),
            "before": before,
            "after": before,
            "parameters": [
                {**asdict(e), "numerics_shift": float(shift)}
                for e, shift in zip(self.estimates, self.numerics_shift, strict=True)
            ],
            "effects": [],
            "candidates": [],
            "steps": [],
            "signature": None,
            **({"profiles": [p.to_dict() for p in self.profiles]} if self.profiles else {}),
        }

    def to_dict(self, *, seed: int = 0, wall_s: float | None = None) -> dict[str, Any]:
        """The content of result.json.

        Parameters
        ----------
        seed : of the generator the estimator was given.
        wall_s : wall time to record, s; default that of the fit.
        """
        wall_s = self.seconds if wall_s is None else wall_s
        return study_result(self.study, self.found, seed=seed, replays=self.replays, wall_s=wall_s)

    def _repr_html_(self) -> str:
        from sysid_btr.display.html import result_html

        return result_html(self.to_dict())


def fit(
    study: Study,
    parameters: Sequence[str] | Sequence[Term],
    *,
    estimator: Estimator | None = None,
    rng: Generator | None = None,
    budget: Budget | None = None,
    journal: Journal | None = None,
    progress: Progress = silent,
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
    budget, journal, progress : see `sysid_btr.estimators`.
    start : (p,) where to begin; default the nominal values.
    distance : minimised instead of the whitened squares (MSE, phi2), by an estimator that needs no residuals.
        Intervals are then those of the likelihood at the point found.

    Raises
    ------
    UsageError
        If nothing is freed, or least squares are asked to minimise a distance.

    Returns
    -------
    Fit
        Parameters that the log cannot tell are held at their nominal value and marked.
    """
    began = perf_counter()
    terms = as_terms(study, parameters)
    model = Model.of(terms, start)
    estimator = LeastSquares() if estimator is None else estimator
    if study.free and isinstance(estimator, LeastSquares):
        estimator = walking(estimator)
    rng = np.random.default_rng(0) if rng is None else rng
    journal = Journal() if journal is None else journal
    if terms.parameters:
        study = realise_servo(study, model)
    problem = study.train_problem(model)
    if not problem.parameters:
        raise UsageError("nothing to fit: free at least one parameter, for example --fit 'mass:*'")
    rough, budget = 0, budget or Budget()
    if isinstance(estimator, Chain) and isinstance(estimator.stages[-1], LeastSquares) and distance is None:
        # the others find the valley; least squares then do from there what they always do
        explored, estimator, budget = estimator.explore(
            problem, rng=rng, budget=budget, journal=journal, progress=progress
        )
        if isinstance(estimator, LeastSquares):
            rough, estimator = explored.evaluations, walking(estimator) if study.free else estimator
        journal = journal.section()
        problem = study.train_problem(model.at(explored.x))
    if isinstance(estimator, LeastSquares):
        # first find how large each column's error is, then weigh the columns by it
        if study.free:
            study, coarse = settled_refit(study, model.at(problem.start))
        else:
            coarse = refit(study, model.at(problem.start))
        if float(coarse.train_columns.max()) > MISFIT:
            if not study.free:  # windows are weighed one by one already
                study, coarse = robust_refit(study, coarse, ROBUST_ROUNDS)
            study = inflate(study, coarse, memory=True)
        rough += coarse.evaluations
        problem = study.train_problem(coarse.model)
    if distance is not None and isinstance(estimator, LeastSquares):
        raise UsageError("lsq minimises squared residuals: for another distance choose ga, cmaes or nlopt:ALGORITHM")
    if study.free and isinstance(estimator, LeastSquares):
        result = deferred_fit(
            problem, study.rough, estimator, rng=rng, budget=budget, journal=journal, progress=progress
        )
    else:
        goal = problem if distance is None else DistanceProblem(problem, distance)
        result = estimator.fit(goal, rng=rng, budget=budget, journal=journal, progress=progress)
    replays = result.evaluations + rough
    step = study.stencil(terms)
    values, jacobian, residual = _at_optimum(problem, result, step)
    for _ in range(MAX_REFINEMENTS):
        shift = numerics_shift(problem, values, jacobian, residual)
        found = estimates(problem.parameters, values, jacobian, residual, problem.blocks)
        std = np.array([e.std for e in found])
        worst = np.max(np.abs(shift) / np.maximum(std, 1e-300), initial=0.0)
        misfit = before_chi2(problem, residual)
        digital = study.numerics.integrator == "Euler"
        # impacts leave a little chaos under any step: it widens the intervals instead
        if study.free or not isinstance(estimator, LeastSquares) or worst <= SHIFT_TOLERATED or digital or misfit > FAR:
            break
        study = replace(study, numerics=study.numerics.halved())
        problem = study.train_problem(model.at(values))
        polished = LeastSquares().fit(
            problem, rng=rng, budget=Budget(), journal=Journal(), progress=progress
        )
        replays += polished.evaluations
        values, jacobian, residual = _at_optimum(problem, polished, step)
    known, optimum = None, values
    if study.free:
        follow = isinstance(estimator, LeastSquares)
        weighed = weigh_walks(study, problem, values, jacobian, residual, follow=follow)
        values, jacobian, residual = weighed.values, weighed.jacobian, weighed.residual
        shift, known = np.hypot(shift, weighed.error), weighed.known
    found = estimates(problem.parameters, values, jacobian, residual, problem.blocks, shift, known)
    extra = 0
    if isinstance(estimator, LeastSquares):
        values, found, extra = hold_unidentifiable(problem, values, found, jacobian, known)
    return Fit(
        study=study,
        model=model.at(values),
        estimates=found,
        nominal=score(study, Model.of(terms)),
        before=score(study, model.at(values)),
        result=result,
        numerics_shift=shift,
        replays=replays + extra,
        seconds=perf_counter() - began,
        optimum=values if known is None else optimum,
    )


def realise_servo(study: Study, model: Model) -> Study:
    """The study with the realisation of a digital servo that fits the log better.

    Held torque under a known velocity, or an Euler step a period, which is a velocity from differences.
    """
    if study.numerics.integrator != "Euler":
        return study
    held = held_numerics(study.robot, study.train[0], study.threads)
    if held is None:
        return study
    short = shorten(study, SERVO_SECONDS)
    misfit = [
        float(np.mean(np.log(refit(replace(short, numerics=n), model, iterations=4).train_columns)))
        for n in (held, study.numerics)
    ]
    return replace(study, numerics=held) if misfit[0] < misfit[1] - SERVO_MARGIN else study


def settled_refit(study: Study, model: Model) -> tuple[Study, Fitted]:
    """First fit of walks: parameters, and starts of windows, in turn, with a cheap integrator."""
    numerics = study.numerics
    study = replace(study, numerics=study.rough)
    first = best_start(study, model.terms, contact_starts(model))
    coarse = refit(study, model.at(first), iterations=5)
    study = study.settled(coarse.model, held=False, anew=False)
    again = refit(study, coarse.model, iterations=3)
    study = replace(study.settled(again.model), numerics=numerics)
    spent = again.evaluations + coarse.evaluations
    if all(isinstance(log, Walk) for log in study.train):
        return study, judge(study, again.model, spent)
    # what the cheap integrator does wrong is much beside the noise of a robot that hangs, and is no error of its model
    right = refit(study, again.model)
    return study, replace(right, evaluations=right.evaluations + spent)


def contact_starts(model: Model) -> FloatArray:
    """Starts (k, p) that differ in how stiff the ground is: between a soft and a hard one the loss is not convex."""
    own = [i for i, name in enumerate(model.terms.names) if name.startswith("foot_compliance")]
    starts = np.tile(model.values, (1 + len(STIFFER) * bool(own), 1))
    for row, factor in zip(starts[1:], STIFFER, strict=False):
        row[own] *= factor
    return starts


STIFFER = (0.6, 0.35, 0.25)
"""Contact time constants tried first, as factors of the nominal."""


def as_terms(study: Study, parameters: Sequence[str] | Sequence[Term]) -> Terms:
    """Expressions of the grammar as terms; terms as they are."""
    given = (p for p in parameters if isinstance(p, Term))
    return Terms((*given, *study.declare([p for p in parameters if isinstance(p, str)])))


def before_chi2(problem: ReplayProblem, residual: FloatArray) -> float:
    """Mean square of error over noise floor, however the residual was whitened."""
    factor = np.array([(t.sigma[k] / t.noise[k]) ** 2 for _, t, k in problem.columns])
    return float(np.mean(residual**2 * factor[problem.column_labels]))


def numerics_shift(
    problem: ReplayProblem, values: FloatArray, jacobian: FloatArray, residual: FloatArray
) -> FloatArray:
    """Change of the estimates, (p,), to first order, when the step is halved.

    Zero for a digital servo, whose period is part of the model.
    """
    numerics = problem.episodes[0].replay.numerics
    if numerics.integrator == "Euler":
        return np.zeros(len(values))
    fine = problem.with_numerics(numerics.halved()).residuals(values[None])[0]
    if not np.isfinite(fine).all():
        return np.full(len(values), np.inf)
    return newton(jacobian, fine - residual)


def _at_optimum(
    problem: ReplayProblem, result: FitResult, step: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    if result.jacobian is not None and result.residual is not None:
        return result.x, result.jacobian, result.residual
    residual, jacobian = linearise(problem, result.x, step=step)
    return result.x, jacobian, residual


def hold_unidentifiable(
    problem: ReplayProblem,
    values: FloatArray,
    found: tuple[Estimate, ...],
    jacobian: FloatArray,
    known: Known | None = None,
) -> tuple[FloatArray, tuple[Estimate, ...], int]:
    """Hold what the log cannot tell at its nominal value, and refit the rest: values, estimates, evaluations.

    Of parameters that the log tells only together, as few are held as it takes to tell the others: to hold them all
    would contradict what is known of them together. The intervals stay those of the joint fit, about its own
    estimates, so they still cover whatever value the held parameters really have. Nothing is held where that predicts
    the log worse: the intervals are those of a linear model, and of the model's own error where there is one. Where
    more is known of the parameters than the residuals tell, that says what the others are beside those that are held.
    """
    if known is not None:
        blind = np.array([e.identifiable == "no" for e in found])
        if not blind.any() or blind.all():
            return values, found, 0
        values = np.where(blind, [e.nominal for e in found], values)
        values[known.which] = known.beside(np.flatnonzero(blind), values)
        values = np.clip(values, problem.lower, problem.upper)
        return values, _held(values, found, blind), 0
    blind = fewest_to_hold(jacobian, found)
    if not blind.any() or blind.all():
        return values, found, 0
    change = np.array([e.nominal for e in found]) - values
    change[~blind] = -np.linalg.lstsq(jacobian[:, ~blind], jacobian[:, blind] @ change[blind], rcond=1e-6)[0]
    held = np.clip(values + change, problem.lower, problem.upper)
    conditional = Conditional(problem, ~blind, held)
    result = LeastSquares(confirm=False, least_gain=ENOUGH).fit(
        conditional, rng=np.random.default_rng(0), budget=Budget(), journal=Journal(), progress=silent
    )
    if result.termination is Termination.INTERRUPTED:
        raise KeyboardInterrupt
    complete = conditional.complete(result.x[None])[0]
    free_loss, held_loss = problem.loss(np.stack([values, complete]))
    if not held_loss <= free_loss * WORSE:
        return values, found, result.evaluations + 2
    return complete, _held(complete, found, blind), result.evaluations


def _held(values: FloatArray, found: tuple[Estimate, ...], blind: BoolArray) -> tuple[Estimate, ...]:
    """Estimates at these values, the blind ones said to be held; intervals cover these values too."""
    moved = []
    for estimate, value, fixed in zip(found, values, blind, strict=True):
        low, high = estimate.bounds if estimate.identifiable == "no" else estimate.ci95
        reason = f"{estimate.reason}; held at its nominal value" if fixed else estimate.reason
        span = estimate.bounds[1] - estimate.bounds[0]
        at_bound = bool(min(value - estimate.bounds[0], estimate.bounds[1] - value) <= 1e-6 * span)
        ci95 = (min(low, float(value)), max(high, float(value)))
        moved.append(replace(estimate, value=float(value), ci95=ci95, reason=reason, at_bound=at_bound))
    return tuple(moved)


ENOUGH = 0.03
"""Decrease of the loss, in mean squared residuals, that moves no estimate by more than a sixth of its error."""
WORSE = 1.01
"""Ratio of losses beyond which nominal values are worse than estimates, whatever the intervals of these say."""


def fewest_to_hold(jacobian: FloatArray, found: Sequence[Estimate]) -> BoolArray:
    """Parameters (p,) that the log cannot tell even where the others of them are held."""
    blind: BoolArray = np.array([e.identifiable == "no" for e in found])
    span = np.array([e.bounds[1] - e.bounds[0] for e in found])
    norm = np.linalg.norm(jacobian, axis=0)
    scaled = jacobian / np.where(norm > 0, norm, 1.0)
    normal = scaled.T @ scaled
    held: BoolArray = blind & (norm == 0)
    while (blind & ~held).any():
        free = np.flatnonzero(~held)
        values, vectors = np.linalg.eigh(normal[np.ix_(free, free)])
        variance = (vectors**2 / np.maximum(values, RANK * max(values[-1], 1e-300))).sum(axis=1)
        unsure = np.where(blind[free], np.sqrt(variance) / (norm[free] * span[free]), 0.0)
        worst = int(np.argmax(unsure))
        if unsure[worst] <= NOT_IDENTIFIABLE:
            break
        held[free[worst]] = True
    return held
