"""What is known of parameters before a log is seen, beside what it says (maximum a posteriori)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from sysid_btr._typing import BoolArray, FloatArray
from sysid_btr.estimators.base import Derived
from sysid_btr.objectives.problem import ReplayProblem
from sysid_btr.simulation.numerics import Numerics
from sysid_btr.terms.base import Parameter
from sysid_btr.terms.model import Terms

SURPRISING = 1e-4
"""Probability, if a model states what robots have, of numbers at least as far off as those that are not believed."""


class Belief(Protocol):
    """What is known of parameters: normal, in independent directions."""

    def whitened(self, candidates: FloatArray) -> FloatArray:
        """(m, k) by how many standard deviations candidates (m, p) are off, in independent directions."""
        ...


@dataclass(frozen=True, eq=False)
class Stated:
    """That robots are about what their models state, each parameter by itself.

    Attributes
    ----------
    nominal : (p,) what the model states.
    weight : (p,) one over the standard deviation of what robots have from it; 0 where a model states nothing.
    """

    nominal: FloatArray
    weight: FloatArray

    @classmethod
    def of(cls, parameters: Sequence[Parameter], redundancy: float = 1.0) -> Stated:
        """Beside residuals of which so many say as much as an independent one."""
        weight = np.array([np.sqrt(redundancy) / p.spread for p in parameters])
        return cls(np.array([p.nominal for p in parameters]), weight)

    def whitened(self, candidates: FloatArray) -> FloatArray:
        """See `Belief.whitened`: one direction for each parameter of which a model states something."""
        known = self.weight > 0
        return np.asarray((candidates[:, known] - self.nominal[known]) * self.weight[known])


def prior_residual(parameters: Sequence[Parameter], values: FloatArray) -> FloatArray:
    """By how many spreads of robots those (s,) of some values (p,) of which a model states something are off that."""
    return np.asarray(Stated.of(parameters).whitened(values[None])[0])


def is_implausible(residual: FloatArray) -> bool:
    """Whether a prior residual (s,) is larger than chance lets it be.

    A prior-data conflict (Evans and Moshonov 2006, doi:10.1214/06-BA129): what asks for such numbers lacks something.
    """
    from scipy.special import gammaincc

    return bool(len(residual) and gammaincc(len(residual) / 2, float(residual @ residual) / 2) < SURPRISING)


def implausible(parameters: Sequence[Parameter], values: FloatArray) -> tuple[str, ...]:
    """Names of parameters whose values (p,) are more than twice as far off as robots are, if all are implausible."""
    residual = prior_residual(parameters, values)
    if not is_implausible(residual):
        return ()
    stated = [p.name for p in parameters if np.isfinite(p.spread)]
    return tuple(name for name, far in zip(stated, np.abs(residual) > 2, strict=True) if far)


def doubt(parameters: Sequence[Parameter], values: FloatArray) -> str:
    """What is to be said of values (p,) that robots do not have; empty where they are plausible."""
    names = implausible(parameters, values)
    if not names:
        return ""
    amounts = dict(zip((p.name for p in parameters), values.tolist(), strict=True))
    listing = ", ".join(f"{name} {amounts[name]:.2g}" for name in names)
    are, them = ("are", "them") if len(names) > 1 else ("is", "it")
    return f"{listing} {are} further from the model than robots are: something that acts like {them} may be missing"


@dataclass(frozen=True, eq=False)
class MapProblem(Derived):
    """Logs together with what was known before them: a problem whose residuals end with those of a belief.

    Attributes
    ----------
    problem : of the logs.
    belief : of the same parameters.
    deviation : see `ReplayProblem.deviation`.
    """

    problem: ReplayProblem
    belief: Belief
    deviation: float = 0.0

    @property
    def terms(self) -> Terms:
        """See `ReplayProblem.terms`."""
        return self.problem.terms

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """See `ReplayProblem.parameters`."""
        return self.problem.parameters

    @property
    def groups(self) -> tuple[tuple[int, ...], ...]:
        """See `ReplayProblem.groups`."""
        return self.problem.groups

    def support(self, parameter: int) -> BoolArray | None:
        """See `ReplayProblem.support`."""
        own = self.problem.support(parameter)
        if own is None:
            return None
        unit = np.zeros((2, len(self.lower)))
        unit[1, parameter] = 1.0
        return np.concatenate([own, np.diff(self.belief.whitened(unit), axis=0)[0] != 0])

    def with_numerics(self, numerics: Numerics) -> MapProblem:
        """See `ReplayProblem.with_numerics`."""
        return replace(self, problem=self.problem.with_numerics(numerics))

    def residuals(self, candidates: FloatArray) -> FloatArray:
        """Whitened residuals (m, r + k) of candidates (m, p); those of the belief come last."""
        residuals = self.problem.residuals(candidates)
        pull = self.belief.whitened(np.atleast_2d(candidates))
        pull[np.isnan(residuals).any(axis=1)] = np.nan
        return np.hstack([residuals, pull])

    def loss(self, candidates: FloatArray) -> FloatArray:
        """Sum of squared residuals (m,); NaN where a candidate diverged."""
        pull = self.belief.whitened(np.atleast_2d(candidates))
        return np.asarray(self.problem.loss(candidates) + np.sum(pull**2, axis=1))
