"""What is believed of a parameter before the log is seen; always cut off at its bounds."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from sysid_btr._typing import FloatArray
from sysid_btr.errors import UsageError
from sysid_btr.terms.base import Parameter
from sysid_btr.terms.grammar import closest

_POINTS = 4001


class Prior(Protocol):
    """Belief about one parameter."""

    def log_density(self, x: FloatArray) -> FloatArray:
        """Log density (m,) at values (m,) within the bounds, up to a constant."""
        ...

    def __str__(self) -> str:
        """As it is written in a study file."""
        ...


@dataclass(frozen=True)
class Uniform:
    """Any value within the bounds alike."""

    def log_density(self, x: FloatArray) -> FloatArray:
        return np.zeros(len(x))

    def __str__(self) -> str:
        return "uniform"


@dataclass(frozen=True)
class Normal:
    """Normal with a mean and a standard deviation, in the parameter's unit."""

    mean: float
    std: float

    def __post_init__(self) -> None:
        _check(math.isfinite(self.mean), self)
        _check(math.isfinite(self.std) and self.std > 0, self)

    def log_density(self, x: FloatArray) -> FloatArray:
        return np.asarray(-0.5 * ((x - self.mean) / self.std) ** 2)

    def __str__(self) -> str:
        return f"normal({self.mean:g}, {self.std:g})"


@dataclass(frozen=True)
class LogNormal:
    """Lognormal: the logarithm is normal about that of the median, with standard deviation `spread`."""

    median: float
    spread: float

    def __post_init__(self) -> None:
        _check(math.isfinite(self.median) and self.median > 0, self)
        _check(math.isfinite(self.spread) and self.spread > 0, self)

    def log_density(self, x: FloatArray) -> FloatArray:
        with np.errstate(divide="ignore", invalid="ignore"):
            log = np.log(x)
        density = -0.5 * ((log - math.log(self.median)) / self.spread) ** 2 - log
        return np.where(x > 0, density, -np.inf)

    def __str__(self) -> str:
        return f"lognormal({self.median:g}, {self.spread:g})"


KINDS: Mapping[str, Callable[..., Prior]] = {"uniform": Uniform, "normal": Normal, "lognormal": LogNormal}
_ARGUMENTS = {"uniform": 0, "normal": 2, "lognormal": 2}
_FORMS = "uniform, normal(MEAN, STD), lognormal(MEDIAN, SPREAD OF THE LOGARITHM)"


def parse_prior(text: str) -> Prior:
    """A prior from its text, such as ``normal(1, 0.1)``.

    Raises
    ------
    UsageError
        It is none; the message lists the forms there are.
    """
    match = re.fullmatch(r"\s*(\w+)\s*(?:\(([^()]*)\))?\s*", text)
    kind = match.group(1).lower() if match else ""
    if match is None or kind not in KINDS:
        raise UsageError(f"{text!r} is not a prior; priors are {_FORMS}")
    given = [a for a in (match.group(2) or "").split(",") if a.strip()]
    try:
        numbers = [float(a) for a in given]
    except ValueError:
        raise UsageError(f"{text!r}: {', '.join(given)} are not numbers; priors are {_FORMS}") from None
    if len(numbers) != _ARGUMENTS[kind]:
        raise UsageError(f"{text!r}: {kind} takes {_ARGUMENTS[kind]} numbers; priors are {_FORMS}")
    return KINDS[kind](*numbers)


def choose_priors(
    parameters: Sequence[Parameter], given: Mapping[str, str], table: Mapping[str, str] | None = None
) -> tuple[Prior, ...]:
    """The prior of each parameter: named by itself, by a glob, or by its field; uniform otherwise.

    Parameters
    ----------
    parameters : what is estimated.
    given : name, glob or ``FIELD`` -> prior as text. Of several that match, the name wins over the glob, and
        that over the field; of several globs the last.
    table : the same, of the robot; gives way to `given`, and may name what is not free.

    Raises
    ------
    UsageError
        A key matches nothing, a text is not a prior, or a prior leaves nothing within the bounds; all at once.
    """
    problems = []
    parsed: dict[str, Prior] = {}
    for key, text in given.items():
        try:
            parsed[key] = parse_prior(text)
        except UsageError as error:
            problems.append(f"{key}: {error}")
        if all(closest({key: text}, p.name) is None for p in parameters):
            names = ", ".join(p.name for p in parameters)
            problems.append(f"{key} is not a fitted parameter; available: {names}")
    own = {key: parse_prior(text) for key, text in (table or {}).items()}
    chosen: list[Prior] = []
    for parameter in parameters:
        prior = closest(parsed, parameter.name) or closest(own, parameter.name) or Uniform()
        if not np.isfinite(_on_grid(prior, parameter.lower, parameter.upper)[1]).any():
            problems.append(f"{parameter.name}: {prior} has no mass within {parameter.lower:g} to {parameter.upper:g}")
        chosen.append(prior)
    if problems:
        raise UsageError("priors that cannot be used:\n  " + "\n  ".join(problems))
    return tuple(chosen)


def moments(prior: Prior, lower: float, upper: float) -> tuple[float, float]:
    """Mean and standard deviation of a prior within bounds."""
    x, density = _on_grid(prior, lower, upper)
    weight = np.exp(density - density.max())
    weight /= weight.sum()
    mean = float(weight @ x)
    return mean, float(np.sqrt(weight @ (x - mean) ** 2))


def log_prior(priors: Sequence[Prior], x: FloatArray) -> FloatArray:
    """Log density (m,) of candidates (m, p), up to a constant."""
    total = np.zeros(len(x))
    for j, prior in enumerate(priors):
        total += prior.log_density(x[:, j])
    return total


def _on_grid(prior: Prior, lower: float, upper: float) -> tuple[FloatArray, FloatArray]:
    x = np.linspace(lower, upper, _POINTS)
    return x, prior.log_density(x)


def _check(good: bool, prior: Prior) -> None:
    if not good:
        raise UsageError(f"{prior} is not a prior: means and medians must be finite, spreads positive")
