"""Toy problems with known answers, for those who write estimators."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from sysid_btr._typing import FloatArray
from sysid_btr.estimators.base import Derived, Problem


@dataclass(frozen=True, eq=False)
class ToyProblem:
    """A problem from a function that gives residuals ``(m, r)`` for candidates ``(m, p)``.

    Attributes
    ----------
    optimum
        Where the loss is least within the bounds; NaN for a parameter the residuals do not determine.
    """

    names: tuple[str, ...]
    lower: FloatArray
    upper: FloatArray
    start: FloatArray
    function: Callable[[FloatArray], FloatArray]
    optimum: FloatArray

    def residuals(self, candidates: FloatArray) -> FloatArray:
        """Residuals ``(m, r)``."""
        return self.function(candidates)

    def loss(self, candidates: FloatArray) -> FloatArray:
        """Sums of squared residuals ``(m,)``."""
        rows = self.function(candidates)
        total: FloatArray = np.einsum("ij,ij->i", rows, rows)
        return total


@dataclass(frozen=True, eq=False)
class LossOnly(Derived):
    """A problem without residuals."""

    problem: Problem

    def loss(self, candidates: FloatArray) -> FloatArray:
        """Losses of the problem."""
        return self.problem.loss(candidates)


def linear_gaussian(
    rng: np.random.Generator, p: int = 4, r: int = 60, noise: float = 0.1
) -> tuple[ToyProblem, FloatArray]:
    """Residuals ``D x - b`` with unit noise, and the design ``D``, shape ``(r, p)``, size ``1 / noise``."""
    design = rng.standard_normal((r, p)) / noise
    truth = rng.uniform(-1.0, 1.0, p)
    target = design @ truth + rng.standard_normal(r)
    problem = ToyProblem(
        names=tuple(f"x{j}" for j in range(p)),
        lower=np.full(p, -4.0),
        upper=np.full(p, 3.0),
        start=np.full(p, -2.5),
        # einsum: the same bits for a candidate whatever the batch it is in.
        function=lambda x: np.einsum("rp,mp->mr", design, x) - target,
        optimum=np.asarray(np.linalg.lstsq(design, target, rcond=None)[0], dtype=np.float64),
    )
    return problem, design


def rosenbrock() -> ToyProblem:
    """Rosenbrock's curved valley as two residuals; the loss is 0 at (1, 1)."""
    return ToyProblem(
        names=("a", "b"),
        lower=np.full(2, -5.0),
        upper=np.full(2, 5.0),
        start=np.array([-1.2, 1.0]),
        function=lambda x: np.stack([10.0 * (x[:, 1] - x[:, 0] ** 2), 1.0 - x[:, 0]], axis=1),
        optimum=np.ones(2),
    )


def exponential_decay(rng: np.random.Generator, noise: float = 0.0) -> ToyProblem:
    """Amplitude, rate and offset of ``a exp(-k t) + c``; residuals whitened by `noise`, or 0.01."""
    t = np.linspace(0.0, 4.0, 80)
    truth = np.array([2.0, 1.3, -0.4])

    def decay(x: FloatArray) -> FloatArray:
        curve: FloatArray = x[:, :1] * np.exp(-x[:, 1:2] * t) + x[:, 2:]
        return curve

    measured = decay(truth[None])[0] + noise * rng.standard_normal(len(t))
    return ToyProblem(
        names=("amplitude", "rate", "offset"),
        lower=np.array([0.0, 0.05, -3.0]),
        upper=np.array([10.0, 10.0, 3.0]),
        start=np.array([6.0, 4.0, 1.5]),
        function=lambda x: (decay(x) - measured) / (noise or 0.01),
        optimum=truth if noise == 0.0 else np.full(3, np.nan),
    )


def rank_deficient() -> ToyProblem:
    """Only ``gain * load`` and ``offset`` are seen; ``idle`` is not seen at all."""
    t = np.linspace(-1.0, 1.0, 30)
    return ToyProblem(
        names=("gain", "load", "offset", "idle"),
        lower=np.array([0.1, 0.1, -2.0, 0.0]),
        upper=np.array([4.0, 4.0, 2.0, 1.0]),
        start=np.array([1.0, 1.0, 0.0, 0.3]),
        function=lambda x: (x[:, :1] * x[:, 1:2] - 2.0) * t + 0.1 * np.sin(9.0 * t) + x[:, 2:3] - 0.5,
        optimum=np.array([np.nan, np.nan, 0.5, np.nan]),
    )


def bound_active() -> ToyProblem:
    """A linear problem whose free minimum (2, -1, 0.5) lies outside: the answer is not its projection."""
    design = np.array([[3.0, 1.0, 0.0], [1.0, 2.0, 0.5], [0.0, 0.5, 1.0], [1.0, 0.0, 1.0]])
    target = design @ np.array([2.0, -1.0, 0.5])
    # With x0 = 1 and x1 >= 0 active, x2 alone is free.
    rest = target - design[:, 0]
    x2 = float(design[:, 2] @ rest / (design[:, 2] @ design[:, 2]))
    return ToyProblem(
        names=("x0", "x1", "x2"),
        lower=np.array([-1.0, 0.0, -3.0]),
        upper=np.array([1.0, 2.0, 3.0]),
        start=np.array([0.0, 1.0, 0.0]),
        function=lambda x: np.einsum("rp,mp->mr", design, x) - target,
        optimum=np.array([1.0, 0.0, x2]),
    )


def failing_region(rng: np.random.Generator, fraction: float = 0.0) -> ToyProblem:
    """The decay, failing where the rate is above 5, and at a `fraction` of all points scattered about."""
    smooth = exponential_decay(rng, noise=0.01)

    def function(x: FloatArray) -> FloatArray:
        rows = smooth.function(x)
        scattered = np.modf(np.abs(np.sin(1e4 * x.sum(axis=1))) * 1e3)[0] < fraction
        rows[(x[:, 1] > 5.0) | scattered] = np.nan
        return rows

    return ToyProblem(smooth.names, smooth.lower, smooth.upper, smooth.start, function, smooth.optimum)


def hopeless() -> ToyProblem:
    """Every candidate fails."""
    p = 2
    return ToyProblem(
        names=("a", "b"),
        lower=np.zeros(p),
        upper=np.ones(p),
        start=np.full(p, 0.25),
        function=lambda x: np.full((len(x), 3), np.nan),
        optimum=np.full(p, np.nan),
    )


def lone_parameter() -> ToyProblem:
    """One parameter, which starts at its bound."""
    return ToyProblem(
        names=("a",),
        lower=np.array([0.0]),
        upper=np.array([2.0]),
        start=np.array([0.0]),
        function=lambda x: np.stack([x[:, 0] ** 3 - 0.2, x[:, 0] - 0.5], axis=1),
        optimum=np.array([np.nan]),
    )
