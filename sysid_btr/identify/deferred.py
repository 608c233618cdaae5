"""Least squares whose derivatives come from a cheap integrator and whose residuals come from the right one.

Deferred correction (Stetter 1978, doi:10.1007/BF01432879): the cheap problem, shifted by the difference between the
two at a point, is solved; there the difference is taken again, until the solution stays. What it converges to is the
right integrator's minimum up to the difference of the derivatives, which is second order where the fit is good.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from sysid_btr._typing import BoolArray, FloatArray
from sysid_btr.estimators.base import Budget, Derived, FitResult, Progress, ResidualEstimator, Termination
from sysid_btr.estimators.journal import Journal
from sysid_btr.estimators.linearisation import linearise
from sysid_btr.identify.prior import MapProblem
from sysid_btr.objectives.problem import ReplayProblem
from sysid_btr.simulation.numerics import Numerics

if TYPE_CHECKING:
    from numpy.random import Generator

ROUNDS = 4
"""Times the difference is taken at most."""
LEAST_GAIN = 0.5
"""Decrease of the sum of squared residuals, in their mean square, for which a hypothesis, or a walk, is not simulated
again."""

ASTRAY = 0.01
"""Decrease, a fraction of the loss, that a cheap integrator promises where the right one shows none, from which its
derivatives lead astray."""


@dataclass(frozen=True, eq=False)
class Corrected(Derived):
    """A problem under a cheap integrator, with the right residuals at one point.

    Attributes
    ----------
    problem : under the cheap integrator.
    right : (r,) the right residuals at the point.
    offset : (r,) what the cheap ones lack there.
    point : (p,).
    """

    problem: ReplayProblem | MapProblem
    right: FloatArray
    offset: FloatArray
    point: FloatArray

    @property
    def start(self) -> FloatArray:
        """(p,) the point."""
        return self.point

    @property
    def deviation(self) -> float:
        """See `ReplayProblem.deviation`."""
        return self.problem.deviation

    @property
    def groups(self) -> tuple[tuple[int, ...], ...]:
        """See `ReplayProblem.groups`."""
        return self.problem.groups

    def support(self, parameter: int) -> BoolArray | None:
        """See `ReplayProblem.support`."""
        return self.problem.support(parameter)

    def residuals(self, candidates: FloatArray) -> FloatArray:
        return self.problem.residuals(candidates) + self.offset

    def loss(self, candidates: FloatArray) -> FloatArray:
        return np.asarray(np.sum(self.residuals(candidates) ** 2, axis=1))


def corrected(problem: ReplayProblem | MapProblem, cheap: Numerics, values: FloatArray) -> Corrected:
    """The problem under a cheap integrator, right at `values` (p,)."""
    rough = problem.with_numerics(cheap)
    pair = [p.residuals(values[None])[0] for p in (problem, rough)]
    return Corrected(rough, pair[0], np.nan_to_num(pair[0] - pair[1]), values)


def cheaper(problem: ReplayProblem, cheap: Numerics, values: FloatArray) -> ReplayProblem | Corrected:
    """The problem under a cheap integrator, right at `values` (p,), where that rises about as fast around them.

    It does not where teeth meet.
    """
    same = problem.terms.rough or cheap == problem.episodes[0].replay.numerics
    return problem if same else corrected(problem, cheap, values)


def deferred_fit(
    problem: ReplayProblem | MapProblem,
    cheap: Numerics,
    estimator: ResidualEstimator,
    *,
    step: float | None = None,
    rng: Generator,
    budget: Budget,
    journal: Journal,
    progress: Progress,
) -> FitResult:
    """Minimise a problem's squares with the derivatives of a cheaper integrator.

    Parameters
    ----------
    problem : under the right integrator.
    cheap : integrator and step of the derivatives.
    estimator : what minimises.
    step : finite-difference step, fraction of the range, of the Jacobian that the result shall have; None: none.
    rng, budget, journal, progress : see `sysid_btr.estimators`.

    Returns
    -------
    FitResult
        If a `step` is given, with the right residuals at `x` and the cheap integrator's Jacobian. Converged once
        another round lowers the right loss by less than `LEAST_GAIN`; where one that promised much raises it, the
        right integrator goes on alone.
    """
    bare = estimator.unconfirmed()
    near = corrected(problem, cheap, problem.start)
    loss, evaluations = float(np.sum(near.right**2)), 2
    for _ in range(ROUNDS):
        result = bare.fit(near, rng=rng, budget=budget.after(evaluations), journal=journal, progress=progress)
        evaluations += result.evaluations
        if result.termination in (Termination.INTERRUPTED, Termination.BUDGET_SPENT, Termination.NO_FINITE_CANDIDATE):
            return replace(result, evaluations=evaluations)
        if np.array_equal(result.x, near.start):
            break
        journal = journal.section()
        there = corrected(problem, cheap, result.x)
        now = float(np.sum(there.right**2))
        evaluations += 2
        gain = (loss - now) / (now / len(there.offset))
        if not gain >= 0 and loss - result.loss > ASTRAY * loss:
            beside = replace(near, problem=problem, offset=np.zeros(len(near.offset)))
            result = bare.fit(beside, rng=rng, budget=budget.after(evaluations), journal=journal, progress=progress)
            return _linearised(beside, replace(result, evaluations=evaluations + result.evaluations), step)
        if gain >= 0:
            near, loss = there, now
        if not gain >= LEAST_GAIN:
            break
    return _linearised(near, replace(result, x=near.start, loss=loss, evaluations=evaluations), step)


def _linearised(near: Corrected, result: FitResult, step: float | None) -> FitResult:
    """A result with residual and Jacobian of a problem at it, where a `step` is given to take the latter with."""
    if step is None:
        return result
    residual, jacobian = linearise(near, result.x, step=step)
    evaluations = result.evaluations + 2 * len(result.x) + 1
    return replace(result, evaluations=evaluations, jacobian=jacobian, residual=residual)
