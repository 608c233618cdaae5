"""Parameters that are not identifiable stay at their nominal value."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from sysid_btr._typing import BoolArray, FloatArray
from sysid_btr.estimators.base import Budget, Termination, silent
from sysid_btr.estimators.journal import Journal
from sysid_btr.estimators.lsq import LeastSquares
from sysid_btr.identify.intervals import NOT_IDENTIFIABLE, Estimate
from sysid_btr.identify.prior import MapProblem
from sysid_btr.objectives.covariance import RANK, Known
from sysid_btr.objectives.problem import Conditional, ReplayProblem

ENOUGH = 0.03
"""Decrease of the loss, in mean squared residuals, that moves no estimate by more than a sixth of its error."""
WORSE = 1.01
"""Ratio of losses beyond which nominal values are worse than estimates, whatever the intervals of these say."""


def fix_unidentifiable(
    problem: ReplayProblem | MapProblem,
    values: FloatArray,
    found: tuple[Estimate, ...],
    jacobian: FloatArray,
    known: Known | None = None,
    budget: Budget | None = None,
) -> tuple[FloatArray, tuple[Estimate, ...], int]:
    """Fix what is not identifiable at its nominal value, and refit the rest: values, estimates, evaluations.

    Of parameters that are identifiable only in combination, as few are fixed as it takes to identify the others: to fix
    them all would contradict what is known of their combination. The intervals stay those of the joint fit, about its
    own estimates, so they still cover whatever value the fixed parameters really have. Nothing is fixed where that
    predicts the log worse: the intervals are those of a linear model, and of the model's own error where there is one.
    Where more is known of the parameters than the residuals contain, the others are conditioned on the fixed ones.
    """
    if known is not None:
        blind = np.array([e.identifiable == "no" for e in found])
        if not blind.any():
            return values, found, 0
        values = np.where(blind, [e.nominal for e in found], values)
        values[known.which] = known.beside(np.flatnonzero(blind), values)
        values = np.clip(values, problem.lower, problem.upper)
        return values, _fixed(values, found, blind), 0
    blind = fewest_to_fix(jacobian, found)
    if not blind.any():
        return values, found, 0
    change = np.array([e.nominal for e in found]) - values
    change[~blind] = -np.linalg.lstsq(jacobian[:, ~blind], jacobian[:, blind] @ change[blind], rcond=1e-6)[0]
    start = np.clip(values + change, problem.lower, problem.upper)
    complete, spent = start, 2
    if not blind.all():
        conditional = Conditional(problem, ~blind, start)
        result = LeastSquares(confirm=False, least_gain=ENOUGH).fit(
            conditional, rng=np.random.default_rng(0), budget=budget or Budget(), journal=Journal(), progress=silent
        )
        if result.termination is Termination.INTERRUPTED:
            raise KeyboardInterrupt
        complete, spent = conditional.complete(result.x[None])[0], result.evaluations + 2
    free_loss, fixed_loss = problem.loss(np.stack([values, complete]))
    if not fixed_loss <= free_loss * WORSE:
        return values, found, spent
    return complete, _fixed(complete, found, blind), spent


def _fixed(values: FloatArray, found: tuple[Estimate, ...], blind: BoolArray) -> tuple[Estimate, ...]:
    """Estimates at these values, the blind ones said to be fixed; intervals cover these values too."""
    moved = []
    for estimate, value, fixed in zip(found, values, blind, strict=True):
        low, high = estimate.bounds if estimate.identifiable == "no" else estimate.ci95
        reason = f"{estimate.reason}; fixed at its nominal value" if fixed else estimate.reason
        span = estimate.bounds[1] - estimate.bounds[0]
        at_bound = bool(min(value - estimate.bounds[0], estimate.bounds[1] - value) <= 1e-6 * span)
        ci95 = (min(low, float(value)), max(high, float(value)))
        moved.append(replace(estimate, value=float(value), ci95=ci95, reason=reason, at_bound=at_bound))
    return tuple(moved)


def fewest_to_fix(jacobian: FloatArray, found: Sequence[Estimate]) -> BoolArray:
    """Parameters (p,) that are not identifiable even where the others of them are fixed."""
    blind: BoolArray = np.array([e.identifiable == "no" for e in found])
    span = np.array([e.bounds[1] - e.bounds[0] for e in found])
    norm = np.linalg.norm(jacobian, axis=0)
    scaled = jacobian / np.where(norm > 0, norm, 1.0)
    normal = scaled.T @ scaled
    fixed: BoolArray = blind & (norm == 0)
    while (blind & ~fixed).any():
        free = np.flatnonzero(~fixed)
        values, vectors = np.linalg.eigh(normal[np.ix_(free, free)])
        variance = (vectors**2 / np.maximum(values, RANK * max(values[-1], 1e-300))).sum(axis=1)
        unsure = np.where(blind[free], np.sqrt(variance) / (norm[free] * span[free]), 0.0)
        worst = int(np.argmax(unsure))
        if unsure[worst] <= NOT_IDENTIFIABLE:
            break
        fixed[free[worst]] = True
    return fixed
