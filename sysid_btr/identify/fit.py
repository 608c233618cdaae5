"""Fitting declared parameters: estimate, intervals, numerics check, scores before and after."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from time import perf_counter
from typing import TYPE_CHECKING

import numpy as np

from sysid_btr._typing import BoolArray, FloatArray
from sysid_btr.errors import UsageError
from sysid_btr.estimators.base import Budget, Estimator, FitResult, Progress, silent
from sysid_btr.estimators.journal import Journal
from sysid_btr.estimators.lsq import LeastSquares, linearise
from sysid_btr.identify.intervals import Estimate, estimates
from sysid_btr.identify.refit import inflate, refit, robust_refit
from sysid_btr.identify.scores import Scores, score
from sysid_btr.identify.study import Study, nominal_start
from sysid_btr.models.modifier import Modifier
from sysid_btr.objectives.distance import Distance, DistanceProblem
from sysid_btr.objectives.problem import Conditional, ReplayProblem

if TYPE_CHECKING:
    from numpy.random import Generator

SHIFT_TOLERATED = 0.3
"""Shift of an estimate under half the step, in standard errors, beyond which the step is halved."""
MAX_REFINEMENTS = 3
MISFIT = 1.5
"""Chi2 of a column beyond which its error, not its noise, sets its weight."""
ROBUST_ROUNDS = 4
FAR = 3.0
"""Mean squared whitened residual beyond which a model is too wrong for its step to matter."""


@dataclass(frozen=True, eq=False)
class Fit:
    """Declared parameters fitted to a study.

    Attributes
    ----------
    study : as fitted; its numerics may have been refined.
    modifiers : whose parameters were fitted.
    estimates : one a parameter.
    values : (p,) the estimates' values.
    nominal, before : scores of the plain and of the fitted model on fitted and held-out data.
    result : what the estimator returned.
    numerics_shift : (p,) change of the estimates when the step is halved.
    replays : candidates simulated.
    seconds : wall time.
    """

    study: Study
    modifiers: tuple[Modifier, ...]
    estimates: tuple[Estimate, ...]
    values: FloatArray
    nominal: Scores
    before: Scores
    result: FitResult
    numerics_shift: FloatArray
    replays: int
    seconds: float


def fit(
    study: Study,
    parameters: Sequence[str] | Sequence[Modifier],
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
    parameters : expressions of the grammar, or modifiers.
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
    modifiers = as_modifiers(study, parameters)
    estimator = LeastSquares() if estimator is None else estimator
    rng = np.random.default_rng(0) if rng is None else rng
    journal = Journal() if journal is None else journal
    problem = study.train_problem(modifiers, start)
    if not problem.parameters:
        raise UsageError("nothing to fit: free at least one parameter, for example --fit 'mass:*'")
    rough = 0
    if isinstance(estimator, LeastSquares):
        # first find how large each column's error is, then weigh the columns by it
        coarse = refit(study, modifiers, problem.start)
        if float(coarse.train_columns.max()) > MISFIT:
            study, coarse = robust_refit(study, coarse, ROBUST_ROUNDS)
            study = inflate(study, coarse, memory=True)
        rough = coarse.evaluations
        problem = study.train_problem(modifiers, coarse.values)
    if distance is not None and isinstance(estimator, LeastSquares):
        raise UsageError("lsq minimises squared residuals: for another distance choose ga, cmaes or nlopt:ALGORITHM")
    goal = problem if distance is None else DistanceProblem(problem, distance)
    result = estimator.fit(goal, rng=rng, budget=budget or Budget(), journal=journal, progress=progress)
    replays = result.evaluations + rough
    values, jacobian, residual = _at_optimum(problem, result)
    for _ in range(MAX_REFINEMENTS):
        shift = numerics_shift(problem, values, jacobian, residual)
        found = estimates(problem.parameters, values, jacobian, residual, problem.blocks)
        std = np.array([e.std for e in found])
        worst = np.max(np.abs(shift) / np.maximum(std, 1e-300), initial=0.0)
        misfit = before_chi2(problem, residual)
        digital = study.numerics.integrator == "Euler"
        if not isinstance(estimator, LeastSquares) or worst <= SHIFT_TOLERATED or digital or misfit > FAR:
            break
        study = replace(study, numerics=study.numerics.halved())
        problem = study.train_problem(modifiers, values)
        polished = LeastSquares().fit(
            problem, rng=rng, budget=Budget(), journal=Journal(), progress=progress
        )
        replays += polished.evaluations
        values, jacobian, residual = _at_optimum(problem, polished)
    found = estimates(problem.parameters, values, jacobian, residual, problem.blocks, shift)
    extra = 0
    if isinstance(estimator, LeastSquares):
        values, found, extra = hold_unidentifiable(problem, values, found)
    return Fit(
        study=study,
        modifiers=modifiers,
        estimates=found,
        values=values,
        nominal=score(study, modifiers, nominal_start(modifiers)),
        before=score(study, modifiers, values),
        result=result,
        numerics_shift=shift,
        replays=replays + extra,
        seconds=perf_counter() - began,
    )


def as_modifiers(study: Study, parameters: Sequence[str] | Sequence[Modifier]) -> tuple[Modifier, ...]:
    """Expressions of the grammar as modifiers; modifiers as they are."""
    given = tuple(p for p in parameters if isinstance(p, Modifier))
    return (*given, *study.declare([p for p in parameters if isinstance(p, str)]))


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
    return -np.asarray(np.linalg.lstsq(jacobian, fine - residual, rcond=1e-6)[0])


def _at_optimum(problem: ReplayProblem, result: FitResult) -> tuple[FloatArray, FloatArray, FloatArray]:
    if result.jacobian is not None and result.residual is not None:
        return result.x, result.jacobian, result.residual
    residual, jacobian = linearise(problem, result.x)
    return result.x, jacobian, residual


def hold_unidentifiable(
    problem: ReplayProblem, values: FloatArray, found: tuple[Estimate, ...]
) -> tuple[FloatArray, tuple[Estimate, ...], int]:
    """Hold what the log cannot tell at its nominal value, and refit the rest: values, estimates, evaluations.

    The intervals of the others stay those of the joint fit, so they still cover whatever value the held
    parameters really have.
    """
    blind: BoolArray = np.array([e.identifiable == "no" for e in found])
    if not blind.any() or blind.all():
        return values, found, 0
    held = values.copy()
    held[blind] = np.array([e.nominal for e in found])[blind]
    conditional = Conditional(problem, ~blind, held)
    result = LeastSquares().fit(
        conditional, rng=np.random.default_rng(0), budget=Budget(), journal=Journal(), progress=silent
    )
    values = conditional.complete(result.x[None])[0]
    moved = []
    for estimate, value in zip(found, values, strict=True):
        half = 0.5 * (estimate.ci95[1] - estimate.ci95[0])
        low, high = max(value - half, estimate.bounds[0]), min(value + half, estimate.bounds[1])
        reason = estimate.reason
        if estimate.identifiable == "no":
            reason = f"{reason}; held at its nominal value"
            low, high = estimate.bounds
        span = estimate.bounds[1] - estimate.bounds[0]
        at_bound = bool(min(value - estimate.bounds[0], estimate.bounds[1] - value) <= 1e-6 * span)
        moved.append(
            replace(estimate, value=float(value), ci95=(low, high), reason=reason, at_bound=at_bound)
        )
    return values, tuple(moved), result.evaluations
