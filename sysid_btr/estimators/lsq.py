"""Batched Gauss-Newton / Levenberg-Marquardt least squares in a box.

A stencil of all parameters begins, and from there each step is one batch of two: the undamped step with a damped one;
where that keeps little of what it promised a third, the rest of a ladder of damping factors, of which the best is
taken. What the residuals did on the way says how the derivatives changed (Broyden 1965), and the next stencil is
simulated where a step keeps too little. All are what a parallel simulator does well. Steps are solutions of the damped
linear problem *with* the bounds, so an active bound never spoils a step.

Residuals are long and parameters few: the journal records only the normal matrix ``J^T J`` and ``J^T r``; ``J`` is in
memory, and simulated once more where a fit is resumed. Steps are taken in the unit cube of the bounds, with columns
scaled to unit length (Marquardt 1963, doi:10.1137/0111030); directions the residuals do not see are cut from the
spectrum, so parameters that are confounded stay where they are.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Self

import numpy as np

from sysid_btr._typing import FloatArray
from sysid_btr.errors import UsageError
from sysid_btr.estimators.base import (
    Budget,
    FitResult,
    Problem,
    Progress,
    ResidualProblem,
    Termination,
    require_residuals,
)
from sysid_btr.estimators.evaluator import Evaluator, Outcome, drive
from sysid_btr.estimators.journal import Journal
from sysid_btr.estimators.linearisation import (
    CENTRAL_STEP,
    WIDEST_STEP,
    LinearModel,
    Neighbour,
    Scheme,
    Stencil,
    linear_model,
    unpack,
)
from sysid_btr.estimators.starting import finite_near, latin_hypercube

if TYPE_CHECKING:
    from numpy.random import Generator

_WIDEST_ASKED = 5e-2  # of the same, that may be asked for where the residuals are rough
_STD_FRACTION = 1e-2  # a step shorter than 0.1 std lowers the loss by less than this times loss / r
_ROUGH_FRACTION = 1e-1  # tolerated instead where no step lowers the loss: 0.3 std
_SLOW_FRACTION = 0.5  # a step that gains less than this, in the same unit ...
_MANY = 1000  # residuals, from which on their mean square says what noise is
_KEPT = 0.1  # ... and less than this share of what it promised tells of a rough objective, not of a way to go
_KEEPS = 0.25  # of what it promised: a step that gains less is too long (Nocedal and Wright 2006, algorithm 4.1)
_LOSS_MISMATCH = 1e-6
_STEPS = 4  # for each stencil that is allowed, at most
_FAR = 0.1  # of the loss: where steps since the last stencil gained more, the end has one of its own
_FIRST_DAMPING = 0.1


_Ladder = tuple[tuple[FloatArray, float], ...]
"""Batches of damping factors, and the share of the promised gain by which a step makes those after it needless."""


@dataclass(frozen=True, eq=False)
class _Point:
    """Where a descent ended, and why."""

    u: FloatArray
    loss: float
    steps: FloatArray
    termination: Termination
    model: LinearModel | None = None


@dataclass(frozen=True)
class LeastSquares:
    """Levenberg-Marquardt on batched finite differences, within bounds.

    Forward differences (``p + 1`` candidates) and what steps show of the derivatives lead to the minimum; central ones
    (``2 p + 1``), at every step, confirm it, and give the Jacobian of the result.

    Parameters
    ----------
    tolerance
        Converged when the decrease of the loss that the linear model still promises is below this fraction of
        the loss. Where the residuals are so many that this would leave a step longer than a tenth of a
        standard deviation, it is tightened to that. A standard deviation is worth the mean squared residual, or
        the problem's `deviation` where it has one and that is more.
    step_tolerance
        Converged when the Gauss-Newton step is shorter than this fraction of every parameter's range.
    forward_step, central_step
        Finite-difference steps, fractions of the range. Widened for a parameter whose residuals hardly
        change.
    damping
        The ladder: Levenberg-Marquardt factors, rising, relative to the one that worked last. The undamped
        step is always tried too. Factors multiply the squared column norms.
    rescue
        A second ladder, relative to the last of the first, tried when that lowers nothing.
    forward_rank_tolerance, central_rank_tolerance
        Directions whose singular value, columns at unit length, is below this fraction of the largest are not
        moved. The error of the differences hides what lies below.
    max_iterations
        Forward differences from each start at most, and central ones; up to four steps follow from each.
    n_starts
        Points to descend from: the problem's start, then `starts`, then random ones.
    starts
        Further points to descend from, in the parameters' units.
    prescreen
        Random candidates simulated for each random start wanted; the best are taken.
    confirm
        Whether central differences confirm the minimum; without, a result carries no Jacobian.
    least_gain
        Decrease of the loss, in mean squared residuals, that is worth a step: 0.01 is a tenth of a standard
        deviation. More where the objective is rough.

    Notes
    -----
    Method: Nocedal and Wright, Numerical Optimization (2006), ch. 10, doi:10.1007/978-0-387-40065-5; Madsen, Nielsen,
    Tingleff, Methods for Non-Linear Least Squares Problems (2004), section 3.5.
    """

    tolerance: float = 1e-6
    step_tolerance: float = 1e-8
    forward_step: float = 1e-4
    central_step: float = CENTRAL_STEP
    damping: tuple[float, ...] = (0.01, 0.1, 1.0, 10.0)
    rescue: tuple[float, ...] = (10.0, 1e2, 1e3, 1e5)
    forward_rank_tolerance: float = 1e-4
    central_rank_tolerance: float = 1e-6
    max_iterations: int = 30
    n_starts: int = 1
    starts: tuple[tuple[float, ...], ...] = ()
    prescreen: int = 8
    confirm: bool = True
    least_gain: float = _STD_FRACTION

    def __post_init__(self) -> None:
        if self.max_iterations < 1 or self.n_starts < 1 or self.prescreen < 1:
            raise UsageError("lsq: max_iterations, n_starts and prescreen must be at least 1")
        if not self.damping or min(self.damping + self.rescue) <= 0.0:
            raise UsageError("lsq: damping needs at least one factor, and all factors above 0")
        if not (0.0 < self.forward_step <= _WIDEST_ASKED and 0.0 < self.central_step <= _WIDEST_ASKED):
            raise UsageError(f"lsq: finite-difference steps are fractions of the range in (0, {_WIDEST_ASKED:g}]")

    @property
    def name(self) -> str:
        """``lsq``."""
        return "lsq"

    @property
    def uses_residuals(self) -> bool:
        """It minimises squared residuals."""
        return True

    def for_rough_objective(self, step: float, least_gain: float) -> Self:
        """Wider differences, few iterations and a coarser end."""
        return replace(
            self,
            tolerance=max(self.tolerance, 1e-4),
            forward_step=max(self.forward_step, step),
            central_step=max(self.central_step, step),
            max_iterations=min(self.max_iterations, 8),
            least_gain=least_gain,
        )

    def unconfirmed(self) -> Self:
        """No central differences at the minimum."""
        return replace(self, confirm=False)

    def fit(
        self, problem: Problem, *, rng: Generator, budget: Budget, journal: Journal, progress: Progress
    ) -> FitResult:
        """Minimise the sum of squared residuals of `problem`.

        `rng` is drawn from only for random starts. Where the fit ends by itself, the result carries residual
        and Jacobian at `x`.

        Raises
        ------
        UsageError
            The problem has no residuals, or its bounds or the starts cannot be used.
        """
        residual_problem = require_residuals(problem, self.name)

        def search(evaluator: Evaluator) -> Outcome:
            return self._search(residual_problem, evaluator, rng)

        return drive(problem, search, budget=budget, journal=journal, progress=progress)

    def _search(self, problem: ResidualProblem, evaluator: Evaluator, rng: Generator) -> Outcome:
        box = evaluator.box
        starts = self._choose_starts(evaluator, rng)
        if not starts:
            return Outcome(Termination.NO_FINITE_CANDIDATE)
        steps = np.full(len(box.lower), self.forward_step)
        forward = Scheme(Stencil.forward, central=False, rank_tolerance=self.forward_rank_tolerance)
        central = Scheme(Stencil.central, central=True, rank_tolerance=self.central_rank_tolerance)
        ends = [self._descend(problem, evaluator, u, loss, steps, forward) for u, loss in starts]
        best = min(ends, key=lambda end: end.loss)
        if not self.confirm:
            return Outcome(best.termination, box.leave(best.u), best.loss)
        widest = max(WIDEST_STEP, self.central_step)
        steps = np.minimum(np.abs(best.steps) * self.central_step / self.forward_step, widest)
        end = self._descend(problem, evaluator, best.u, best.loss, steps, central)
        if end.model is None:
            return Outcome(end.termination)
        x = box.leave(end.u)
        residual, jacobian = unpack(end.model, box)
        return Outcome(end.termination, x, end.loss, jacobian, residual)

    def _choose_starts(self, evaluator: Evaluator, rng: Generator) -> list[tuple[FloatArray, float]]:
        box = evaluator.box
        if any(len(start) != len(box.lower) for start in self.starts):
            raise UsageError(f"lsq: each start must be {len(box.lower)} numbers, one a parameter")
        given = np.vstack([evaluator.start, *(np.array(start, dtype=np.float64) for start in self.starts)])
        if np.any(given < box.lower) or np.any(given > box.upper):
            raise UsageError("lsq: a start lies outside the parameters' bounds")
        wanted = max(0, self.n_starts - len(given))
        pool = latin_hypercube(rng, wanted * self.prescreen, len(box.lower))
        u = np.vstack([box.enter(given), pool])
        losses = evaluator.loss(box.leave(u), "choosing starts")
        order = np.argsort(losses[len(given) :], kind="stable")[:wanted] + len(given)
        chosen = [i for i in (*range(len(given)), *order) if np.isfinite(losses[i])]
        if chosen:
            return [(u[i], float(losses[i])) for i in chosen]
        found = finite_near(evaluator, u[0], rng)
        return [] if found is None else [found]

    def _descend(
        self,
        problem: ResidualProblem,
        evaluator: Evaluator,
        u: FloatArray,
        loss: float,
        steps: FloatArray,
        scheme: Scheme,
    ) -> _Point:
        ladder, slow, halted = self._ladder(_FIRST_DAMPING, trust=False), 0, Termination.STALLED
        model, since, stencils = None, 0.0, 0
        for iteration in range(1, _STEPS * self.max_iterations + 1):
            note = f"iteration {iteration}"
            if model is None:
                if stencils == self.max_iterations:
                    break
                stencils += 1
                model, steps = linear_model(problem, evaluator, u, steps, scheme, note)
                _require_consistent(loss, model.loss)
                since = 0.0
            full = model.step(0.0, -u, 1.0 - u, scheme.rank_tolerance)
            promised = model.predicted(full)
            # of correlated residuals, which count less, a standard deviation is more than their mean square
            tolerance = min(self.tolerance, self.least_gain / model.residuals)
            tolerance *= max(1.0, model.deviation * model.residuals / max(loss, np.finfo(float).tiny))
            short = bool(np.max(np.abs(full)) < self.step_tolerance)
            if short or promised <= tolerance * loss or slow == 2:
                if since > _FAR * loss:
                    model = None
                    continue
                there = halted if slow == 2 else Termination.CONVERGED
                return _Point(u, loss, steps, Termination.STALLED if model.failed.any() else there, model)
            found = _climb(evaluator, problem, model, u, loss, scheme, ladder, promised, note)
            gained = 0.0 if found is None else loss - found.loss
            if not model.measured and gained < _KEEPS * promised:
                # what steps showed of the derivatives is not enough here
                model = None
                if found is not None:
                    u, loss = found.u, found.loss
                continue
            rough = promised <= max(_ROUGH_FRACTION, 4 * self.least_gain) * model.deviation
            rough |= promised <= tolerance * loss
            halted = Termination.CONVERGED if rough and not model.failed.any() else Termination.STALLED
            stumbled = found is None and model.neighbour[1] < (1.0 - tolerance) * loss
            if stumbled:
                found = _Found(*model.neighbour, _FIRST_DAMPING, None)  # what the differences stumbled on
                gained = loss - found.loss
            if found is None:
                return _Point(u, loss, steps, halted, model)
            ladder = self._ladder(found.damping or _FIRST_DAMPING, trust=found.damping == 0.0)
            slow = slow + 1 if gained < max(tolerance * loss, self._little(model, promised, stumbled)) else 0
            if slow == 2 and gained < tolerance * loss:
                # Two steps without a gain worth having: stay where the model was made.
                return _Point(u, loss, steps, halted, model)
            told = found.neighbour if gained >= _KEEPS * promised else None
            model = None if told is None else model.moved(u, told)
            u, loss, since = found.u, found.loss, since + gained
            if slow == 2 and not scheme.central:
                return _Point(u, loss, steps, halted)
        return _Point(u, loss, steps, Termination.ITERATION_LIMIT)

    def _little(self, model: LinearModel, promised: float, stumbled: bool) -> float:
        """Gain below which a step that promised more tells of a rough objective."""
        if model.residuals < _MANY:
            return 0.0
        worth = max(_SLOW_FRACTION, self.least_gain) * model.deviation
        return _KEPT * promised if stumbled else min(worth, _KEPT * promised)

    def _ladder(self, centre: float, *, trust: bool) -> _Ladder:
        """Damping factors about the one that worked last, in the batches to try them in.

        Two candidates do where the undamped step works, and the rest is kept for when it does not.
        """
        near = centre * np.array(self.damping)
        # once undamped steps work they go on working
        beside, enough = (0, 0.0) if trust else (int(np.argmin(np.abs(near - centre))), _KEEPS)
        rest = np.delete(near, beside)
        return (np.array([0.0, near[beside]]), enough), (rest, 0.0), (near[-1] * np.array(self.rescue), 0.0)


@dataclass(frozen=True, eq=False)
class _Found:
    """A point that lowers the loss, the damping that led there, and, where residuals were simulated, what they tell."""

    u: FloatArray
    loss: float
    damping: float
    neighbour: Neighbour | None


def _climb(
    evaluator: Evaluator,
    problem: ResidualProblem,
    model: LinearModel,
    u: FloatArray,
    loss: float,
    scheme: Scheme,
    ladder: _Ladder,
    promised: float,
    note: str,
) -> _Found | None:
    """The best point of the batches up to the first that lowers the loss enough, or None.

    `promised` is what the undamped step does in the model.
    """
    found: _Found | None = None
    for factors, enough in ladder:
        if not len(factors):
            continue
        steps = [model.step(float(factor), -u, 1.0 - u, scheme.rank_tolerance) for factor in factors]
        trials = np.clip(u + np.array(steps), 0.0, 1.0)
        near = () if scheme.central else model.neighbours(evaluator, problem, trials, note)
        losses = np.array([n.loss for n in near]) if near else evaluator.loss(evaluator.box.leave(trials), note)
        i = int(np.argmin(losses))
        if losses[i] < (loss if found is None else found.loss):
            found = _Found(trials[i], float(losses[i]), float(factors[i]), near[i] if near else None)
        if found is not None and loss - found.loss >= enough * promised:
            break
    return found


def _require_consistent(loss: float, squares: float) -> None:
    """Refuse a problem whose loss is not the sum of its squared residuals."""
    if abs(squares - loss) > _LOSS_MISMATCH * loss + np.finfo(float).tiny:
        raise UsageError(
            f"the objective is inconsistent: simulated twice at the same parameters, its loss was "
            f"{loss:.9g}, then the sum of its squared residuals {squares:.9g}. A simulator has to give the "
            "same twice; if this one does, the journal was changed: start over (--overwrite)"
        )
