"""Honest standard errors: residuals are correlated, numerics are approximate, and some parameters are not identifiable.

The covariance is that of `objectives.covariance`, widened by what halving the step would change.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any, Literal

import numpy as np

from sysid_btr._typing import FloatArray, IntArray
from sysid_btr.objectives.covariance import RANK, Known, spread
from sysid_btr.terms.base import Parameter
from sysid_btr.units import with_digits_of

Identifiable = Literal["yes", "weak", "no"]
NORMAL = 1.96
"""Standard errors that half a 95 % interval has."""
NOT_IDENTIFIABLE = 0.15
"""Standard error, as a fraction of the range of the bounds, beyond which a log says nothing."""
CONFOUNDED = 0.5
"""Correlation from which two parameters are said to be confounded: a quarter of the variance of each is the other's."""
TOGETHER = ("correlation", "change", "moves")
"""Of an estimate, what results have in ``correlation`` and ``sensitivity``."""


@dataclass(frozen=True, repr=False)
class Estimate:
    """One parameter of a result, as result.json has it.

    Attributes
    ----------
    name, unit, nominal, bounds : of the parameter.
    value, std, ci95 : estimate, standard error and 95 % interval.
    identifiable : whether it is, from this log.
    at_bound : whether the estimate lies on a bound.
    reason : why it is not identifiable, or what limits it; empty otherwise.
    std_if_right : standard error if the model were right, where `std` and `ci95` hold for what it lacks too; else None.
    prior_std : standard deviation about the nominal value that it was taken to have whatever the log says, where the
        model leaves more than noise; None where nothing was.
    correlation : of its error with that of each parameter estimated beside it, itself included, in their order; NaN
        where nothing is known. Empty where it was not worked out.
    change, moves : a change of it that matters, and by how many noise floors (root mean square) this moves each sensor
        (``position.knee``), all other parameters fixed. Empty where it was not worked out.
    """

    name: str
    unit: str
    nominal: float
    value: float
    std: float
    ci95: tuple[float, float]
    bounds: tuple[float, float]
    identifiable: Identifiable
    at_bound: bool
    reason: str
    std_if_right: float | None = None
    prior_std: float | None = None
    correlation: tuple[float, ...] = field(default=(), compare=False)
    change: float = field(default=0.0, compare=False)
    moves: Mapping[str, float] = field(default_factory=dict, compare=False)

    def __str__(self) -> str:
        if self.identifiable == "no":
            return f"{self.name} not identifiable"
        unit = "" if self.unit == "1" else f" {self.unit}"
        return f"{self.name} {with_digits_of(self.value, self.std)}{unit} (std {self.std:.2g})"

    def __repr__(self) -> str:
        return f"<Estimate {self}>"

    def to_dict(self) -> dict[str, Any]:
        """As results have it; what is said of all parameters together they have in matrices of their own."""
        return {name: value for name, value in asdict(self).items() if name not in TOGETHER}


def correlations(covariance: FloatArray) -> FloatArray:
    """Correlation matrix (p, p) of a covariance; NaN beside a variance that is infinite."""
    deviation = np.sqrt(np.diag(covariance))
    with np.errstate(invalid="ignore", divide="ignore"):
        found = covariance / np.outer(deviation, deviation)
    found[~np.isfinite(deviation)], found[:, ~np.isfinite(deviation)] = np.nan, np.nan
    return np.asarray(np.clip(found, -1.0, 1.0))


def correlation_matrix(found: Sequence[Estimate]) -> FloatArray:
    """Correlations (p, p) of estimates that were made together; NaN where nothing is known."""
    size = len(found)
    rows = [e.correlation if len(e.correlation) == size else (np.nan,) * size for e in found]
    return np.array(rows, dtype=np.float64).reshape(size, size)


def covariance_matrix(found: Sequence[Estimate]) -> FloatArray:
    """Covariance (p, p) of estimates that were made together: their standard errors and correlations."""
    std = np.array([e.std for e in found], dtype=np.float64)
    return np.asarray(np.outer(std, std) * correlation_matrix(found))


@dataclass(frozen=True, eq=False)
class Profile:
    """The likelihood along one parameter.

    Attributes
    ----------
    name, unit : of the parameter.
    values : (n,) at which it was held, rising.
    deviance : (n,) twice the log-likelihood lost against the best fit, correlated residuals counted.
    others : (n, p) all parameters at each.
    best : value of the best fit.
    std : standard error there, by which a parabola would rise.
    threshold : deviance at the ends of the interval.
    interval : where the deviance crosses it; a bound where it does not, and then `closed` says so.
    closed : whether the lower and the upper end are crossings.
    replays : candidates simulated.
    """

    name: str
    unit: str
    values: FloatArray
    deviance: FloatArray
    others: FloatArray
    best: float
    std: float
    threshold: float
    interval: tuple[float, float]
    closed: tuple[bool, bool]
    replays: int

    def to_dict(self) -> dict[str, Any]:
        """As results have it."""
        return {
            "name": self.name,
            "unit": self.unit,
            "values": self.values,
            "deviance": self.deviance,
            "threshold": self.threshold,
            "ci95": self.interval,
            "closed": self.closed,
            "replays": self.replays,
        }


def responses(normal: FloatArray, index: int) -> FloatArray:
    """Change (p,) of the best values of all parameters with that of one, in a linear model of this information."""
    free = np.arange(len(normal)) != index
    follow = np.zeros(len(normal))
    follow[index] = 1.0
    if free.any():
        size = np.sqrt(np.maximum(np.diag(normal)[free], 1e-300))
        inner = normal[np.ix_(free, free)] / np.outer(size, size)
        follow[free] = -np.linalg.pinv(inner, rcond=RANK, hermitian=True) @ (normal[free, index] / size) / size
    return follow


def estimates(
    parameters: Sequence[Parameter],
    values: FloatArray,
    jacobian: FloatArray,
    residual: FloatArray,
    blocks: IntArray,
    numerics_shift: FloatArray | None = None,
    known: Known | None = None,
) -> tuple[Estimate, ...]:
    """Estimates with intervals and whether each is identifiable.

    Parameters
    ----------
    parameters, values : (p,).
    jacobian, residual, blocks : as for `covariance`.
    numerics_shift : (p,) change of the estimates when the step is halved, if known.
    known : all that is known of some of them, from these residuals and from elsewhere.
    """
    from scipy.special import stdtrit  # quantiles of Student's t; scipy.stats takes a second to import

    cov, dof = spread(jacobian, residual, blocks)
    std = np.sqrt(np.diag(cov))
    if numerics_shift is not None:
        std = np.hypot(std, np.abs(numerics_shift))
    quantile = np.asarray(stdtrit(dof, 0.975))
    if known is not None:
        std[known.which] = np.sqrt(np.diag(known.covariance))
        cov[known.which], cov[:, known.which] = 0.0, 0.0
        cov[np.ix_(known.which, known.which)] = known.covariance
        quantile[known.which] = stdtrit(np.inf, 0.975)
    norm = np.sqrt(np.einsum("ij,ij->j", jacobian, jacobian))
    together = correlations(cov)
    result = []
    for i, (parameter, value) in enumerate(zip(parameters, values, strict=True)):
        span = parameter.upper - parameter.lower
        at_bound = bool(min(value - parameter.lower, parameter.upper - value) <= 1e-6 * span)
        state, reason = identifiability(i, parameters, std, norm, cov, span)
        if at_bound and parameter.stated:
            # the bound that was stated is what is known of it
            state = "weak" if state == "no" else state
            reason = f"the estimate lies on the stated bound {parameter.lower:g} .. {parameter.upper:g}"
        low = max(float(value) - float(quantile[i] * std[i]), parameter.lower)
        high = min(float(value) + float(quantile[i] * std[i]), parameter.upper)
        result.append(
            Estimate(
                name=parameter.name,
                unit=parameter.unit,
                nominal=parameter.nominal,
                value=float(value),
                std=float(min(std[i], span)),
                ci95=(low, high),
                bounds=(parameter.lower, parameter.upper),
                identifiable=state,
                at_bound=at_bound,
                reason=reason or ("the estimate lies on its bound" if at_bound else ""),
                correlation=tuple(map(float, together[i])),
            )
        )
    return tuple(result)


def identifiability(
    i: int, parameters: Sequence[Parameter], std: FloatArray, norm: FloatArray, cov: FloatArray, span: float
) -> tuple[Identifiable, str]:
    """Whether parameter `i` is identifiable, and if not, why.

    Parameters
    ----------
    std, cov : (p,), (p, p) uncertainty of all parameters.
    norm : (p,) norms of the residuals' derivatives.
    span : width of the parameter's bounds.
    """
    parameter = parameters[i]
    if std[i] <= parameter.scale:
        return "yes", ""
    alone = 1 / norm[i] if norm[i] > 0 else np.inf
    state: Identifiable = "no" if std[i] > NOT_IDENTIFIABLE * span else "weak"
    if np.isinf(alone):
        return state, "no sensor of this log responds to it"
    if alone > 0.5 * min(std[i], NOT_IDENTIFIABLE * span):
        return state, (
            "hardly any sensor of this log responds to it: even with all else known, "
            f"its standard error would be {alone:.2g}{'' if parameter.unit == '1' else ' ' + parameter.unit}"
        )
    deviation = np.sqrt(np.diag(cov))
    with np.errstate(invalid="ignore"):
        correlation = cov[i] / (deviation[i] * deviation)
    correlation[i] = 0.0
    correlation[~np.isfinite(correlation)] = 0.0
    partner = int(np.argmax(np.abs(correlation)))
    if abs(correlation[partner]) < CONFOUNDED:
        unit = "" if parameter.unit == "1" else f" {parameter.unit}"
        return state, f"its standard error is more than {parameter.scale:.2g}{unit}, a change that matters"
    sign = "difference" if correlation[partner] > 0 else "sum"
    return state, (
        f"confounded on this log with {parameters[partner].name} (correlation {correlation[partner]:+.2f}); their "
        f"weighted {sign} is identifiable, their {'sum' if sign == 'difference' else 'difference'} is not"
    )


def held_to_model(found: Sequence[Estimate], parameters: Sequence[Parameter]) -> tuple[Estimate, ...]:
    """Estimates that say which of them were held to what the model states."""
    stds = (p.spread if np.isfinite(p.spread) else None for p in parameters)
    return tuple(replace(one, prior_std=std) for one, std in zip(found, stds, strict=True))
