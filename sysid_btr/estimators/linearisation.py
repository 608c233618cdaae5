"""Residuals about a point as a linear function: by finite differences, and along a descent by what its steps show.

Residuals are long and parameters few: what is journalled is the normal matrix ``J^T J`` and ``J^T r``. ``J`` itself is
kept in memory, and simulated anew where a journal answers instead.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from sysid_btr._typing import BoolArray, FloatArray
from sysid_btr.errors import UsageError
from sysid_btr.estimators.base import Budget, Problem, ResidualProblem, UnitBox, require_residuals, silent
from sysid_btr.estimators.evaluator import Evaluator
from sysid_btr.estimators.journal import Journal

CENTRAL_STEP = 3e-4
"""Of the bounds' range: displacement of central differences."""
WIDEST_STEP = 1e-2
"""Of the same, to which a stencil that changes too little is widened."""
_SMALLEST_CHANGE = 1e-6  # of the residual norm: a stencil that changes less is widened, to stay above round-off


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
class Stencil:
    """Finite differences about one point: which candidates, and how their residuals make a Jacobian.

    `offsets` (p, k) are displacements in the unit cube, k = 1 (forward) or 2 (central, or one-sided at a
    bound). Parameters of one group of `pattern` share a candidate.
    """

    base: FloatArray
    offsets: FloatArray
    pattern: Pattern

    @classmethod
    def forward(cls, u: FloatArray, steps: FloatArray, pattern: Pattern) -> Stencil:
        """One displaced candidate a group; `steps` are signed, flipped where they would leave the box."""
        inside = (u + steps >= 0.0) & (u + steps <= 1.0)
        return cls(u, np.where(inside, steps, -steps)[:, None], pattern)

    @classmethod
    def central(cls, u: FloatArray, steps: FloatArray, pattern: Pattern) -> Stencil:
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
class Scheme:
    """How to differentiate, and how far to believe the result."""

    stencil: Callable[[FloatArray, FloatArray, Pattern], Stencil]
    central: bool
    rank_tolerance: float


class Stack:
    """Derivatives and residuals ``(p + 1, r)`` about a point: in memory, or made when they are asked for."""

    def __init__(self, make: Callable[[], FloatArray]) -> None:
        self._make: Callable[[], FloatArray] | None = make
        self._held: FloatArray = np.empty((0, 0))

    def hold(self, rows: FloatArray) -> FloatArray:
        """Keep the array, and let go of what would make it."""
        self._make, self._held = None, rows
        return rows

    def __call__(self) -> FloatArray:
        """The array, which is held from then on."""
        return self._held if self._make is None else self.hold(self._make())


@dataclass(frozen=True, eq=False)
class LinearModel:
    """The quadratic model of the loss about one point of the unit cube.

    ``loss(u + d) ~ loss + 2 gradient.d + d.normal.d``.

    Attributes
    ----------
    failed, faint : (p,) whose neighbours failed, or hardly change the residuals.
    residuals : number of them.
    least_deviation : of the problem.
    neighbour : the best candidate of the stencil, and its loss.
    stack : derivatives and residuals.
    measured : whether its derivatives are differences about this very point.
    """

    loss: float
    gradient: FloatArray
    normal: FloatArray
    failed: BoolArray
    faint: BoolArray
    residuals: int
    least_deviation: float
    neighbour: tuple[FloatArray, float]
    stack: Stack
    measured: bool = True

    @property
    def deviation(self) -> float:
        """Loss that one standard deviation is worth."""
        return max(self.loss / self.residuals, self.least_deviation)

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

    def neighbours(
        self, evaluator: Evaluator, problem: ResidualProblem, points: FloatArray, note: str
    ) -> tuple[Neighbour, ...]:
        """Candidates ``(m, p)`` of the unit cube, simulated, with what a step there tells of the derivatives."""
        candidates, size = evaluator.box.leave(points), len(self.gradient) + 1
        simulated: list[FloatArray] = []

        def reduction(rows: FloatArray) -> tuple[dict[str, FloatArray], FloatArray | None]:
            simulated.append(rows)
            inner = np.einsum("mr,ir->mi", rows, self.stack())
            return {"inner": np.where(np.isfinite(inner), inner, 0.0)}, None

        def rows_of(i: int) -> FloatArray:
            rows = simulated[0] if simulated else evaluator.again(problem.residuals, candidates)
            return np.asarray(rows[i])

        shapes = {"inner": (len(candidates), size)}
        reduced = evaluator.reduce(problem, candidates, reduction, note, shapes)
        inner = reduced.arrays["inner"]
        return tuple(
            Neighbour(points[i], float(reduced.loss[i]), inner[i], partial(rows_of, i)) for i in range(len(points))
        )

    def moved(self, u: FloatArray, to: Neighbour) -> LinearModel | None:
        """The model about a point that a step from u led to, by what the step showed; None where it shows nothing.

        The least change of the derivatives, parameters counted by what they move, that explains the residuals there
        (Broyden 1965, doi:10.1090/S0025-5718-1965-0198670-6).
        """
        d = to.u - u
        weight = np.diag(self.normal) * d
        size = float(d @ weight)
        if not size > 0.0 or self.failed.any():
            return None
        weight = weight / size
        ours, cross = to.inner[:-1], float(to.inner[-1])
        change = ours - self.gradient
        # J' = J + weight z with z = r' - r - J d, of which only products with J, r' and itself are wanted here
        jz = change - self.normal @ d
        zz = to.loss - 2.0 * cross + self.loss - 2.0 * float(d @ change) + float(d @ self.normal @ d)
        rz = to.loss - cross - float(d @ ours)

        def make() -> FloatArray:
            before, rows = self.stack(), to.rows()
            derivatives = before[:-1] + np.outer(weight, rows - before[-1] - d @ before[:-1])
            return np.vstack([derivatives, rows[None]])

        normal = self.normal + np.outer(jz, weight) + np.outer(weight, jz) + max(zz, 0.0) * np.outer(weight, weight)
        return replace(
            self,
            loss=to.loss,
            gradient=ours + rz * weight,
            normal=normal,
            neighbour=(to.u, to.loss),
            stack=Stack(make),
            measured=False,
        )


@dataclass(frozen=True, eq=False)
class Neighbour:
    """A candidate beside a point with a linear model.

    Attributes
    ----------
    u, loss : where, in the unit cube, and how good.
    inner : (p + 1,) its residuals times the model's derivatives and residuals.
    rows : gives its residuals ``(r,)``.
    """

    u: FloatArray
    loss: float
    inner: FloatArray
    rows: Callable[[], FloatArray]


def _bounded_least_squares(a: FloatArray, b: FloatArray, low: FloatArray, high: FloatArray) -> FloatArray:
    d = np.asarray(np.linalg.lstsq(a, b, rcond=None)[0], dtype=np.float64)
    if np.all((d >= low) & (d <= high)):
        return d
    from scipy.optimize import lsq_linear

    solution = lsq_linear(a, b, bounds=(low, high), method="bvls", max_iter=20 * len(low))
    return np.asarray(solution.x, dtype=np.float64)


def linearise(problem: Problem, x: FloatArray, *, step: float = CENTRAL_STEP) -> tuple[FloatArray, FloatArray]:
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
    central = Scheme(Stencil.central, central=True, rank_tolerance=0.0)
    model, _ = linear_model(residual_problem, evaluator, u, np.full(len(u), step), central, "Jacobian")
    if not np.isfinite(model.loss):
        raise UsageError("there is no Jacobian where the simulation fails: the residuals at this point are not finite")
    residual, jacobian = unpack(model, evaluator.box)
    return residual, jacobian


def linear_model(
    problem: ResidualProblem, evaluator: Evaluator, u: FloatArray, steps: FloatArray, scheme: Scheme, note: str
) -> tuple[LinearModel, FloatArray]:
    """The model about `u`, and the finite-difference steps for the next one."""
    for _ in range(3):
        model = _simulate_stencil(
            problem, evaluator, scheme.stencil(u, steps, Pattern.of(problem)), keep=scheme.central, note=note
        )
        # A failed neighbour: look closer, and on the other side.
        closer = np.where(model.failed, -0.25 * steps, steps)
        size = np.abs(closer)
        wider = np.sign(closer) * np.maximum(size, np.minimum(10.0 * size, WIDEST_STEP))
        steps = np.where(model.faint & ~model.failed, wider, closer)
        if not scheme.central or not model.failed.any():
            break
    return model, steps


def _simulate_stencil(
    problem: ResidualProblem, evaluator: Evaluator, stencil: Stencil, *, keep: bool, note: str
) -> LinearModel:
    points = stencil.candidates()
    candidates = evaluator.box.leave(points)

    def reduction(rows: FloatArray) -> tuple[dict[str, FloatArray], FloatArray | None]:
        columns, failed = stencil.columns(rows)
        stack = np.vstack([columns, rows[:1]])
        # einsum, not BLAS: the same bits whatever the number of threads.
        gram = np.einsum("ir,jr->ij", stack, stack)
        arrays = {"gram": gram, "failed": failed.astype(np.float64), "size": np.array([float(rows.shape[1])])}
        if not keep:
            made.hold(stack)
            return arrays, None
        stack[:-1][failed] = np.nan
        return arrays, stack

    made = Stack(lambda: reduced.attachment() if keep else again())

    def again() -> FloatArray:
        rows = evaluator.again(problem.residuals, candidates)
        return np.vstack([stencil.columns(rows)[0], rows[:1]])

    p = len(candidates[0])
    shapes = {"gram": (p + 1, p + 1), "failed": (p,), "size": (1,)}
    reduced = evaluator.reduce(problem, candidates, reduction, note, shapes)
    gram, failed = reduced.arrays["gram"], reduced.arrays["failed"] > 0.0
    change = np.sqrt(np.diag(gram)[:-1]) * np.abs(stencil.offsets).max(axis=1)
    loss = float(reduced.loss[0])
    nearest = int(np.argmin(reduced.loss))
    residuals = int(reduced.arrays["size"][0])
    return LinearModel(
        loss=loss,
        gradient=gram[:-1, -1],
        normal=gram[:-1, :-1],
        failed=failed,
        faint=change < _SMALLEST_CHANGE * np.sqrt(loss),
        residuals=residuals,
        least_deviation=float(getattr(problem, "deviation", 0.0)),
        neighbour=(np.clip(points[nearest], 0.0, 1.0), float(reduced.loss[nearest])),
        stack=made,
    )


def unpack(model: LinearModel, box: UnitBox) -> tuple[FloatArray, FloatArray]:
    """Residual ``(r,)`` and Jacobian ``(r, p)`` per unit of each parameter."""
    stack = model.stack()
    jacobian: FloatArray = np.ascontiguousarray((stack[:-1] / box.span[:, None]).T)
    return stack[-1].copy(), jacobian
