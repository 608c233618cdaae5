"""Honest standard errors: residuals are correlated, numerics are approximate, and some numbers cannot be told.

The covariance is the cluster-robust sandwich over half-second stretches of the log (White 1982,
doi:10.2307/1912526; Liang and Zeger 1986, doi:10.1093/biomet/73.1.13), never smaller than that of white
residuals of the size actually left, and widened by what halving the step would change.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from sysid_btr._typing import FloatArray, IntArray
from sysid_btr.models.modifier import Parameter

Identifiable = Literal["yes", "weak", "no"]
NOT_IDENTIFIABLE = 0.15
"""Standard error, as a fraction of the range of the bounds, beyond which a log says nothing."""
RANK = 1e-9


@dataclass(frozen=True)
class Estimate:
    """One parameter of a result, as result.json has it.

    Attributes
    ----------
    name, unit, nominal, bounds : of the parameter.
    value, std, ci95 : estimate, standard error and 95 % interval.
    identifiable : whether this log tells it.
    at_bound : whether the estimate lies on a bound.
    reason : why it is not identifiable, or what limits it; empty otherwise.
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


def covariance(jacobian: FloatArray, residual: FloatArray, blocks: IntArray) -> FloatArray:
    """Covariance (p, p) of least-squares estimates from whitened residuals.

    Parameters
    ----------
    jacobian : (r, p) derivative of the residuals.
    residual : (r,).
    blocks : (r,) label of the stretch each residual belongs to; residuals of two stretches are independent.

    Returns
    -------
    ndarray
        Infinite variance in directions that no residual sees.
    """
    p = jacobian.shape[1]
    norm = np.sqrt(np.einsum("ij,ij->j", jacobian, jacobian))
    safe = np.where(norm > 0, norm, 1.0)
    scaled = jacobian / safe
    hessian = scaled.T @ scaled
    bread = np.linalg.pinv(hessian, rcond=RANK, hermitian=True)
    count = int(blocks.max()) + 1 if len(blocks) else 1
    scores = np.zeros((count, p))
    np.add.at(scores, blocks, scaled * residual[:, None])
    stretches = max(len(np.unique(blocks)), 2)
    # few stretches underestimate their own spread
    correction = stretches / max(stretches - min(p, stretches // 2), 1)
    sandwich = correction * bread @ (scores.T @ scores) @ bread
    white = max(float(residual @ residual) / max(len(residual) - p, 1), 1.0) * bread
    variance = np.maximum(np.diag(sandwich), np.diag(white))
    shape = sandwich if np.trace(sandwich) > np.trace(white) else white
    deviation = np.sqrt(np.maximum(np.diag(shape), np.finfo(float).tiny))
    correlation = shape / np.outer(deviation, deviation)
    result = correlation * np.sqrt(np.outer(variance, variance)) / np.outer(safe, safe)
    values, vectors = np.linalg.eigh(hessian)
    blind = np.abs(vectors[:, values <= RANK * max(values[-1], 1e-300)]).max(axis=1, initial=0.0) > 0.1
    blind |= norm == 0
    result[blind, blind] = np.inf
    return np.asarray(result)


def estimates(
    parameters: Sequence[Parameter],
    values: FloatArray,
    jacobian: FloatArray,
    residual: FloatArray,
    blocks: IntArray,
    numerics_shift: FloatArray | None = None,
) -> tuple[Estimate, ...]:
    """Estimates with intervals and a verdict on what this log can tell.

    Parameters
    ----------
    parameters, values : (p,).
    jacobian, residual, blocks : as for `covariance`.
    numerics_shift : (p,) change of the estimates when the step is halved, if known.
    """
    from scipy.stats import t as student

    cov = covariance(jacobian, residual, blocks)
    std = np.sqrt(np.diag(cov))
    if numerics_shift is not None:
        std = np.hypot(std, np.abs(numerics_shift))
    dof = max(len(np.unique(blocks)) - 1, 5)
    quantile = float(student.ppf(0.975, dof))
    norm = np.sqrt(np.einsum("ij,ij->j", jacobian, jacobian))
    result = []
    for i, (parameter, value) in enumerate(zip(parameters, values, strict=True)):
        span = parameter.upper - parameter.lower
        at_bound = bool(min(value - parameter.lower, parameter.upper - value) <= 1e-6 * span)
        state, reason = tell(i, parameters, std, norm, cov, span)
        low = max(float(value) - quantile * float(std[i]), parameter.lower)
        high = min(float(value) + quantile * float(std[i]), parameter.upper)
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
            )
        )
    return tuple(result)


def tell(
    i: int,
    parameters: Sequence[Parameter],
    std: FloatArray,
    norm: FloatArray,
    cov: FloatArray,
    span: float,
) -> tuple[Identifiable, str]:
    """Whether a log tells parameter `i`, and if not, why.

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
    sign = "difference" if correlation[partner] > 0 else "sum"
    return state, (
        f"this log tells it only together with {parameters[partner].name} "
        f"(correlation {correlation[partner]:+.2f}); their weighted "
        f"{'sum' if sign == 'difference' else 'difference'} is not told, their {sign} is"
    )
