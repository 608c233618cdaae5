"""The one contract between problems (what is fitted) and estimators (how)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import Enum
from typing import TYPE_CHECKING, Protocol, Self, TypeGuard, runtime_checkable

import numpy as np

from sysid_btr._typing import BoolArray, FloatArray
from sysid_btr.errors import UsageError

if TYPE_CHECKING:
    from sysid_btr.estimators.journal import Journal


class Problem(Protocol):
    """A loss over a box of ``p`` parameters, evaluated for many candidates at once.

    Bounds are finite, ``lower < upper``, and ``start`` lies within them.
    """

    @property
    def names(self) -> tuple[str, ...]:
        """Parameter names, length ``p``."""
        ...

    @property
    def lower(self) -> FloatArray:
        """Lower bounds, shape ``(p,)``."""
        ...

    @property
    def upper(self) -> FloatArray:
        """Upper bounds, shape ``(p,)``."""
        ...

    @property
    def start(self) -> FloatArray:
        """Where a search begins, shape ``(p,)``."""
        ...

    def loss(self, candidates: FloatArray) -> FloatArray:
        """Losses ``(m,)`` of candidates ``(m, p)``; non-finite marks a candidate that failed."""
        ...


class ResidualProblem(Problem, Protocol):
    """A problem whose loss is a sum of squares."""

    def residuals(self, candidates: FloatArray) -> FloatArray:
        """Whitened residuals ``(m, r)`` of candidates ``(m, p)``; ``loss`` is their sum of squares.

        The row of a failed candidate is all NaN; no other entry is NaN.
        """
        ...


class Derived:
    """Base of a problem that asks another one, `problem`, about the same parameters."""

    problem: Problem

    @property
    def names(self) -> tuple[str, ...]:
        """Those of the other one, as are bounds and start."""
        return self.problem.names

    @property
    def lower(self) -> FloatArray:
        return self.problem.lower

    @property
    def upper(self) -> FloatArray:
        return self.problem.upper

    @property
    def start(self) -> FloatArray:
        return self.problem.start


@dataclass(frozen=True)
class Budget:
    """What a fit may spend; None means no limit.

    Parameters
    ----------
    evaluations
        Candidates simulated, those replayed from a journal included.
    seconds
        Wall time, that of the runs being resumed included. Checked before each batch.
    """

    evaluations: int | None = None
    seconds: float | None = None

    def __post_init__(self) -> None:
        if self.evaluations is not None and self.evaluations < 1:
            raise UsageError(f"a budget of {self.evaluations} evaluations is too small: give at least 1")
        if self.seconds is not None and not self.seconds > 0.0:
            raise UsageError(f"a budget of {self.seconds} s is too small: give a positive time")

    def after(self, evaluations: int) -> Budget:
        """What is left after as many; never nothing, as whoever goes on from a point has to simulate it."""
        return self if self.evaluations is None else replace(self, evaluations=max(self.evaluations - evaluations, 1))


class Progress(Protocol):
    """Called after every batch of evaluations."""

    def __call__(self, *, done: int, total: int | None, best: float, note: str) -> None:
        """Report `done` of `total` candidates (None: no limit), the best loss, and what is going on.

        The loss is what the present search minimises on the data that it fits; NaN between searches.
        """
        ...


def without_loss(progress: Progress) -> Progress:
    """For searches whose loss is not that of the run: with other weights, or of other data."""

    def told(*, done: int, total: int | None, best: float, note: str) -> None:
        progress(done=done, total=total, best=np.nan, note=note)

    return told


def silent(*, done: int, total: int | None, best: float, note: str) -> None:
    """Progress that reports nothing."""


class Termination(Enum):
    """Why a fit ended; each value is a sentence that can be shown to the user."""

    CONVERGED = "Converged: the search finds nothing better within its tolerance."
    BUDGET_SPENT = (
        "The budget was spent before the fit converged: raise it, or resume from the journal with a larger one."
    )
    ITERATION_LIMIT = (
        "The iteration limit was reached while the loss was still falling: raise the limit, "
        "or start from better values."
    )
    INTERRUPTED = "Interrupted: the best parameters so far are returned, and the journal can be resumed."
    STALLED = (
        "Stalled: the derivatives predict a lower loss but no step finds one. The loss is rough near this "
        "point: smooth it (shorter segments, softer contacts) or use an estimator without derivatives."
    )
    GAVE_UP = "The search gave up before it converged: start from better values, or use another estimator."
    NO_FINITE_CANDIDATE = (
        "No candidate could be simulated to a finite loss: check the model and the log at the start values, "
        "or narrow the bounds."
    )


@dataclass(frozen=True, eq=False)
class FitResult:
    """What an estimator found.

    Attributes
    ----------
    x
        Best parameters, shape ``(p,)``; the problem's start if no candidate was finite.
    loss
        Loss at `x`.
    evaluations
        Candidates simulated, those replayed from a journal included.
    termination
        Why the fit ended.
    converged
        Whether the estimator's own criterion of convergence was met.
    at_bound
        Parameters within 1e-6 of their range from a bound, shape ``(p,)``.
    jacobian
        Derivatives of the whitened residuals at `x`, per unit of each parameter, shape ``(r, p)``, or None.
    residual
        Whitened residuals at `x`, shape ``(r,)``, or None.
    history
        ``(evaluations, best loss)`` at each improvement.
    seconds
        Wall time, earlier runs of a resumed journal included.
    names
        Parameter names.
    """

    x: FloatArray
    loss: float
    evaluations: int
    termination: Termination
    converged: bool
    at_bound: BoolArray
    jacobian: FloatArray | None
    residual: FloatArray | None
    history: tuple[tuple[int, float], ...]
    seconds: float
    names: tuple[str, ...] = ()


@runtime_checkable
class Estimator(Protocol):
    """Something that minimises a problem's loss. `sysid_btr.testing.check_estimator` says what that asks."""

    @property
    def name(self) -> str:
        """The name it is registered under."""
        ...

    def fit(
        self, problem: Problem, *, rng: np.random.Generator, budget: Budget, journal: Journal, progress: Progress
    ) -> FitResult:
        """Minimise ``problem.loss`` within its bounds."""
        ...


class ResidualEstimator(Estimator, Protocol):
    """An estimator that minimises squared residuals, and so takes a `ResidualProblem`.

    What least squares need, `identify` does around any of them: columns that the model cannot explain count less, the
    integrator's step is checked at the estimates, and what is not identifiable is fixed at its nominal value.
    """

    @property
    def uses_residuals(self) -> bool:
        """True; an estimator without this attribute needs losses alone."""
        ...

    def for_rough_objective(self, step: float, least_gain: float) -> Self:
        """Itself, for residuals that impacts roughen.

        Parameters
        ----------
        step
            Finite-difference step, fraction of a parameter's range, that is wide against the roughness.
        least_gain
            Decrease of the loss, in mean squared residuals, below which no further step is worth its simulations.
        """
        ...

    def unconfirmed(self) -> Self:
        """Itself, without what it does at the minimum for a Jacobian that nobody will ask for."""
        ...


def uses_residuals(estimator: Estimator) -> TypeGuard[ResidualEstimator]:
    """Whether an estimator minimises squared residuals."""
    return bool(getattr(estimator, "uses_residuals", False))


def has_residuals(problem: Problem) -> TypeGuard[ResidualProblem]:
    """Whether the problem hands out residuals, not only losses."""
    return callable(getattr(problem, "residuals", None))


def require_residuals(problem: Problem, estimator: str) -> ResidualProblem:
    """The problem as one with residuals, or a `UsageError` that names the alternatives."""
    if not has_residuals(problem):
        raise UsageError(
            f"estimator {estimator!r} needs an objective with residuals, and this one gives only a loss: "
            "choose a least-squares objective, or an estimator that needs none "
            "('cmaes', 'nlopt:LN_BOBYQA', 'ga')"
        )
    return problem


@dataclass(frozen=True, eq=False)
class UnitBox:
    """The affine map between a problem's bounds and the unit cube; it makes steps dimensionless."""

    lower: FloatArray
    upper: FloatArray

    @property
    def span(self) -> FloatArray:
        """Width of the bounds, shape ``(p,)``."""
        return self.upper - self.lower

    def enter(self, x: FloatArray) -> FloatArray:
        """Physical values to the unit cube; broadcasts over leading axes."""
        unit: FloatArray = np.clip((x - self.lower) / self.span, 0.0, 1.0)
        return unit

    def leave(self, u: FloatArray) -> FloatArray:
        """Unit cube to physical values; 0 and 1 give the bounds exactly."""
        inside = np.where(u >= 1.0, self.upper, self.lower + u * self.span)
        x: FloatArray = np.clip(inside, self.lower, self.upper)
        return x
