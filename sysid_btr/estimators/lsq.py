"""Batched Gauss-Newton / Levenberg-Marquardt least squares in a box.

One iteration is two batches: the finite-difference stencil of all parameters, and the undamped step with a
damped one; where that keeps little of what it promised a third, the rest of a ladder of damping factors, of
which the best is taken. All are what a parallel simulator does well. Steps are solutions of the damped
linear problem *with* the bounds, so an active bound never spoils a step.

Residuals are long and parameters few: an iteration keeps only the normal matrix ``J^T J`` and ``J^T r``, and
the journal records those. Steps are taken in the unit cube of the bounds, with columns scaled to unit length
(Marquardt 1963, doi:10.1137/0111030); directions the residuals do not see are cut from the spectrum, so
parameters that are confounded stay where they are.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Self

import numpy as np

from sysid_btr._typing import BoolArray, FloatArray
from sysid_btr.errors import UsageError
from sysid_btr.estimators.base import (
    Budget,
    FitResult,
    Problem,
    Progress,
    ResidualProblem,
    Termination,
    UnitBox,
    require_residuals,
    silent,
)
from sysid_btr.estimators.evaluator import Evaluator, Outcome, drive
from sysid_btr.estimators.journal import Journal
from sysid_btr.estimators.starting import finite_near, latin_hypercube

if TYPE_CHECKING:
    from numpy.random import Generator

_SMALLEST_CHANGE = 1e-6  # of the residual norm: a stencil that changes less is widened, to stay above round-off
_WIDEST_STEP = 1e-2  # of the bounds' range, to which a stencil that changes too little is widened
_WIDEST_ASKED = 5e-2  # of the same, that may be asked for where the residuals are rough
_STD_FRACTION = 1e-2  # a step shorter than 0.1 std lowers the loss by less than this times loss / r
_ROUGH_FRACTION = 1e-1  # tolerated instead where no step lowers the loss: 0.3 std
_SLOW_FRACTION = 0.5  # a step that gains less than this, in the same unit ...
_MANY = 1000  # residuals, from which on their mean square says what noise is
_KEPT = 0.1  # ... and less than this share of what it promised tells of a rough objective, not of a way to go
_KEEPS = 0.25  # of what it promised: a step that gains less is too long (Nocedal and Wright 2006, algorithm 4.1)
_LOSS_MISMATCH = 1e-6
_FIRST_DAMPING = 0.1


_Ladder = tuple[tuple[FloatArray, float], ...]
"""Batches of damping factors, and the share of the promised gain by which a step makes those after it needless."""


@dataclass(frozen=True, eq=False)
class Pattern:
    """Which parameters can be varied in one candidate, because they move different residuals.

    Curtis, Powell, Reid 1974, doi:10.1093/imamat/13.1.117. A problem offers it by `groups`, a partition of its
    parameters, and `support(j)`, the residuals ``(r,)`` that parameter j can move (None for all).
    """

    groups: tuple[tuple[int, ...], ...]
    support: Callable[[int], BoolArray | None]

    @classmethod
    def of(cls, problem: Problem) -> Pattern:
        """The problem's own pattern, or one candidate a parameter."""
        groups = getattr(problem, "groups", None)
        if groups is None:
            return cls(tuple((j,) for j in range(len(problem.lower))), lambda j: None)
        return cls(groups, problem.support)  # type: ignore[attr-defined]

    def group_of(self, parameter: int) -> int:
        """Index of the group a parameter belongs to."""
        return next(g for g, group in enumerate(self.groups) if parameter in group)

    def own(self, change: FloatArray, parameter: int) -> FloatArray:
        """The part of a change of all residuals that this parameter of its group made."""
        if len(self.groups[self.group_of(parameter)]) == 1:
            return change
        support = self.support(parameter)
        return change if support is None else np.where(support, change, 0.0)


@dataclass(frozen=True, eq=False)
class _Stencil:
    """Finite differences about one point: which candidates, and how their residuals make a Jacobian.

    `offsets` (p, k) are displacements in the unit cube, k = 1 (forward) or 2 (central, or one-sided at a
    bound). Parameters of one group of `pattern` share a candidate.
    """

    base: FloatArray
    offsets: FloatArray
    pattern: Pattern

    @classmethod
    def forward(cls, u: FloatArray, steps: FloatArray, pattern: Pattern) -> _Stencil:
        """One displaced candidate a group; `steps` are signed, flipped where they would leave the box."""
        inside = (u + steps >= 0.0) & (u + steps <= 1.0)
        return cls(u, np.where(inside, steps, -steps)[:, None], pattern)

    @classmethod
    def central(cls, u: FloatArray, steps: FloatArray, pattern: Pattern) -> _Stencil:
        """Two displaced candidates a group, error of second order also at a bound."""
        h = np.abs(steps)
        low, high = u - h < 0.0, u + h > 1.0
        first = np.where(low, h, -h)
        second = np.where(low, 2.0 * h, np.where(high, -2.0 * h, h))
        return cls(u, np.stack([first, second], axis=1), pattern)

    def candidates(self) -> FloatArray:
        """The point itself, then the displaced ones, shape ``(1 + groups k, p)``, in the unit cube."""
        k = self.offsets.shape[1]
        rows = np.repeat(self.base[None], 1 + len(self.pattern.groups) * k, axis=0)
        for g, group in enumerate(self.pattern.groups):
            for i in range(k):
                rows[1 + g * k + i, list(group)] += self.offsets[list(group), i]
        return rows

    def columns(self, rows: FloatArray) -> tuple[FloatArray, BoolArray]:
        """Derivatives ``(p, r)`` per unit of the cube, and which parameters had no finite neighbour."""
        p, k = self.offsets.shape
        base = rows[0]
        columns = np.zeros((p, rows.shape[1]))
        failed = np.zeros(p, dtype=bool)
        finite = np.isfinite(rows[1:].sum(axis=1)).reshape(len(self.pattern.groups), k)
        for j in range(p):
            g = self.pattern.group_of(j)
            usable = np.flatnonzero(finite[g])
            a = self.offsets[j, usable]
            changes = [self.pattern.own(rows[1 + g * k + i] - base, j) for i in usable]
            if len(usable) == 2:  # the derivative at 0 of the parabola through 0, a0, a1
                weights = np.array([a[1] / a[0], -a[0] / a[1]]) / (a[1] - a[0])
                columns[j] = weights[0] * changes[0] + weights[1] * changes[1]
            elif len(usable) == 1:
                columns[j] = changes[0] / a[0]
            else:
                failed[j] = True
        return columns, failed


@dataclass(frozen=True)
class _Scheme:
    """How to differentiate, and how far to believe the result."""

    stencil: Callable[[FloatArray, FloatArray, Pattern], _Stencil]
    central: bool
    rank_tolerance: float


@dataclass(frozen=True, eq=False)
class _Linear:
    """The quadratic model of the loss about one point of the unit cube.

    ``loss(u + d) ~ loss + 2 gradient.d + d.normal.d``; `deviation` is what one standard deviation is worth.
    """

    loss: float
    gradient: FloatArray
    normal: FloatArray
    failed: BoolArray
    faint: BoolArray
    residuals: int
    deviation: float
    neighbour: tuple[FloatArray, float]
    attachment: Callable[[], FloatArray]

    def predicted(self, d: FloatArray) -> float:
        """Decrease of the loss the model promises for a step, shape ``(p,)``."""
        return float(-(2.0 * self.gradient @ d + d @ self.normal @ d))

    def step(self, damping: float, low: FloatArray, high: FloatArray, rank_tolerance: float) -> FloatArray:
        """Minimiser of the damped model within ``low <= d <= high``."""
        scale = np.sqrt(np.diag(self.normal))
        scale[scale == 0.0] = 1.0
        matrix = self.normal / np.outer(scale, scale)
        values, vectors = np.linalg.eigh(matrix)
        keep = values > rank_tolerance**2 * max(values[-1], np.finfo(float).tiny)
        if not keep.any():
            return np.zeros_like(self.gradient)
        # J^T J = V w V^T and J^T r = g: the same least-squares problem with at most p rows is A d = b.
        root = np.sqrt(values[keep])
        a = root[:, None] * vectors[:, keep].T
        b = -(vectors[:, keep].T @ (self.gradient / scale)) / root
        if damping > 0.0:
            a = np.vstack([a, np.sqrt(damping) * np.eye(len(scale))])
            b = np.append(b, np.zeros(len(scale)))
        return np.clip(_bounded_least_squares(a, b, low * scale, high * scale) / scale, low, high)


def _bounded_least_squares(a: FloatArray, b: FloatArray, low: FloatArray, high: FloatArray) -> FloatArray:
    d = np.asarray(np.linalg.lstsq(a, b, rcond=None)[0], dtype=np.float64)
    if np.all((d >= low) & (d <= high)):
        return d
    from scipy.optimize import lsq_linear

    solution = lsq_linear(a, b, bounds=(low, high), method="bvls", max_iter=20 * len(low))
    return np.asarray(solution.x, dtype=np.float64)


@dataclass(frozen=True, eq=False)
class _Point:
    """Where a descent ended, and why."""

    u: FloatArray
    loss: float
    steps: FloatArray
    termination: Termination
    model: _Linear | None = None


@dataclass(frozen=True)
class LeastSquares:
    """Levenberg-Marquardt on batched finite differences, within bounds.

    Forward differences lead to the minimum (``p + 1`` candidates and the ladder an iteration); central ones
    (``2 p + 1``) confirm it, and give the Jacobian of the result.

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
        Iterations with forward differences from each start, and again with central ones.
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
    Method: Nocedal and Wright, Numerical Optimization (2006), ch. 10, doi:10.1007/978-0-387-40065-5.
    """

    tolerance: float = 1e-6
    step_tolerance: float = 1e-8
    forward_step: float = 1e-4
    central_step: float = 3e-4
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
        forward = _Scheme(_Stencil.forward, central=False, rank_tolerance=self.forward_rank_tolerance)
        central = _Scheme(_Stencil.central, central=True, rank_tolerance=self.central_rank_tolerance)
        ends = [self._descend(problem, evaluator, u, loss, steps, forward) for u, loss in starts]
        best = min(ends, key=lambda end: end.loss)
        if not self.confirm:
            return Outcome(best.termination, box.leave(best.u), best.loss)
        widest = max(_WIDEST_STEP, self.central_step)
        steps = np.minimum(np.abs(best.steps) * self.central_step / self.forward_step, widest)
        end = self._descend(problem, evaluator, best.u, best.loss, steps, central)
        if end.model is None:
            return Outcome(end.termination)
        x = box.leave(end.u)
        residual, jacobian = _unpack(end.model, box)
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
        scheme: _Scheme,
    ) -> _Point:
        ladder, slow, halted = self._ladder(_FIRST_DAMPING, trust=False), 0, Termination.STALLED
        for iteration in range(1, self.max_iterations + 1):
            note = f"iteration {iteration}"
            model, steps = _linearise(problem, evaluator, u, steps, scheme, note)
            if abs(model.loss - loss) > _LOSS_MISMATCH * loss + np.finfo(float).tiny:
                raise UsageError(
                    f"the objective is inconsistent: simulated twice at the same parameters, its loss was "
                    f"{loss:.9g}, then the sum of its squared residuals {model.loss:.9g}. A simulator has to give the "
                    "same twice; if this one does, the journal was changed: start over (--overwrite)"
                )
            full = model.step(0.0, -u, 1.0 - u, scheme.rank_tolerance)
            promised = model.predicted(full)
            # of correlated residuals, which count less, a standard deviation is more than their mean square
            tolerance = min(self.tolerance, self.least_gain / model.residuals)
            tolerance *= max(1.0, model.deviation * model.residuals / max(loss, np.finfo(float).tiny))
            short = bool(np.max(np.abs(full)) < self.step_tolerance)
            if short or promised <= tolerance * loss or slow == 2:
                there = halted if slow == 2 else Termination.CONVERGED
                return _Point(u, loss, steps, Termination.STALLED if model.failed.any() else there, model)
            found = _climb(evaluator, model, u, loss, scheme.rank_tolerance, ladder, promised, note)
            rough = promised <= max(_ROUGH_FRACTION, 4 * self.least_gain) * model.deviation
            rough |= promised <= tolerance * loss
            halted = Termination.CONVERGED if rough and not model.failed.any() else Termination.STALLED
            stumbled = found is None and model.neighbour[1] < (1.0 - tolerance) * loss
            if stumbled:
                found = (*model.neighbour, _FIRST_DAMPING)  # what the differences stumbled on
            if found is None:
                return _Point(u, loss, steps, halted, model)
            new_u, new_loss, factor = found
            ladder = self._ladder(factor or _FIRST_DAMPING, trust=factor == 0.0)
            gained = loss - new_loss
            slow = slow + 1 if gained < max(tolerance * loss, self._little(model, promised, stumbled)) else 0
            if slow == 2 and gained < tolerance * loss:
                # Two steps without a gain worth having: stay where the model was made.
                return _Point(u, loss, steps, halted, model)
            u, loss = new_u, new_loss
            if slow == 2 and not scheme.central:
                return _Point(u, loss, steps, halted)
        return _Point(u, loss, steps, Termination.ITERATION_LIMIT)

    def _little(self, model: _Linear, promised: float, stumbled: bool) -> float:
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


def _climb(
    evaluator: Evaluator,
    model: _Linear,
    u: FloatArray,
    loss: float,
    rank_tolerance: float,
    ladder: _Ladder,
    promised: float,
    note: str,
) -> tuple[FloatArray, float, float] | None:
    """The best point of the batches up to the first that lowers the loss enough, its loss and its damping, or None.

    `promised` is what the undamped step does in the model.
    """
    found: tuple[FloatArray, float, float] | None = None
    for factors, enough in ladder:
        if not len(factors):
            continue
        steps = [model.step(float(factor), -u, 1.0 - u, rank_tolerance) for factor in factors]
        trials = np.clip(u + np.array(steps), 0.0, 1.0)
        losses = evaluator.loss(evaluator.box.leave(trials), note)
        i = int(np.argmin(losses))
        if losses[i] < (loss if found is None else found[1]):
            found = trials[i], float(losses[i]), float(factors[i])
        if found is not None and loss - found[1] >= enough * promised:
            break
    return found


def linearise(
    problem: Problem, x: FloatArray, *, step: float = LeastSquares.central_step
) -> tuple[FloatArray, FloatArray]:
    """Residual and Jacobian at a point, by central differences of ``2 p + 1`` candidates.

    Parameters
    ----------
    problem
        Must have residuals.
    x
        Shape ``(p,)``, within the bounds.
    step
        Finite-difference step, fraction of each parameter's range.

    Returns
    -------
    residual, jacobian
        Shapes ``(r,)`` and ``(r, p)``; the column of a parameter whose neighbours all failed is NaN.

    Raises
    ------
    UsageError
        The problem has no residuals, or none that are finite at `x`.
    """
    residual_problem = require_residuals(problem, "lsq")
    evaluator = Evaluator(problem, budget=Budget(), journal=Journal(), progress=silent)
    u = evaluator.box.enter(x)
    central = _Scheme(_Stencil.central, central=True, rank_tolerance=0.0)
    model, _ = _linearise(residual_problem, evaluator, u, np.full(len(u), step), central, "Jacobian")
    if not np.isfinite(model.loss):
        raise UsageError("there is no Jacobian where the simulation fails: the residuals at this point are not finite")
    residual, jacobian = _unpack(model, evaluator.box)
    return residual, jacobian


def _linearise(
    problem: ResidualProblem, evaluator: Evaluator, u: FloatArray, steps: FloatArray, scheme: _Scheme, note: str
) -> tuple[_Linear, FloatArray]:
    """The model about `u`, and the finite-difference steps for the next one."""
    for _ in range(3):
        model = _simulate_stencil(
            problem, evaluator, scheme.stencil(u, steps, Pattern.of(problem)), keep=scheme.central, note=note
        )
        # A failed neighbour: look closer, and on the other side.
        closer = np.where(model.failed, -0.25 * steps, steps)
        size = np.abs(closer)
        wider = np.sign(closer) * np.maximum(size, np.minimum(10.0 * size, _WIDEST_STEP))
        steps = np.where(model.faint & ~model.failed, wider, closer)
        if not scheme.central or not model.failed.any():
            break
    return model, steps


def _simulate_stencil(
    problem: ResidualProblem, evaluator: Evaluator, stencil: _Stencil, *, keep: bool, note: str
) -> _Linear:
    points = stencil.candidates()
    candidates = evaluator.box.leave(points)

    def reduction(rows: FloatArray) -> tuple[dict[str, FloatArray], FloatArray | None]:
        columns, failed = stencil.columns(rows)
        stack = np.vstack([columns, rows[:1]])
        # einsum, not BLAS: the same bits whatever the number of threads.
        gram = np.einsum("ir,jr->ij", stack, stack)
        arrays = {"gram": gram, "failed": failed.astype(np.float64), "size": np.array([float(rows.shape[1])])}
        if not keep:
            return arrays, None
        stack[:-1][failed] = np.nan
        return arrays, stack

    p = len(candidates[0])
    shapes = {"gram": (p + 1, p + 1), "failed": (p,), "size": (1,)}
    reduced = evaluator.reduce(problem, candidates, reduction, note, shapes)
    gram, failed = reduced.arrays["gram"], reduced.arrays["failed"] > 0.0
    change = np.sqrt(np.diag(gram)[:-1]) * np.abs(stencil.offsets).max(axis=1)
    loss = float(reduced.loss[0])
    nearest = int(np.argmin(reduced.loss))
    residuals = int(reduced.arrays["size"][0])
    return _Linear(
        loss=loss,
        gradient=gram[:-1, -1],
        normal=gram[:-1, :-1],
        failed=failed,
        faint=change < _SMALLEST_CHANGE * np.sqrt(loss),
        residuals=residuals,
        deviation=max(loss / residuals, float(getattr(problem, "deviation", 0.0))),
        neighbour=(np.clip(points[nearest], 0.0, 1.0), float(reduced.loss[nearest])),
        attachment=reduced.attachment,
    )


def _unpack(model: _Linear, box: UnitBox) -> tuple[FloatArray, FloatArray]:
    """Residual ``(r,)`` and Jacobian ``(r, p)`` per unit of each parameter."""
    stack = model.attachment()
    jacobian: FloatArray = np.ascontiguousarray((stack[:-1] / box.span[:, None]).T)
    return stack[-1].copy(), jacobian
