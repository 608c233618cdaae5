"""Honest standard errors: residuals are correlated, numerics are approximate, and some numbers cannot be told.

The covariance is the cluster-robust sandwich over half-second stretches of the log (White 1982,
doi:10.2307/1912526; Liang and Zeger 1986, doi:10.1093/biomet/73.1.13), unbiased where residuals are white (Bell and
McCaffrey 2002, "Bias reduction in standard errors for linear regression with multi-stage samples"). A log has few
stretches and many parameters, so that much of it is chance: it is shrunk towards what all directions have in common, by
as much as its own scatter says (Ledoit and Wolf 2004, doi:10.1016/S0047-259X(03)00096-4). It is never smaller than that
of white residuals of the size actually left, and widened by what halving the step would change.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from sysid_btr._typing import BoolArray, FloatArray, IntArray
from sysid_btr.terms.base import Parameter

Identifiable = Literal["yes", "weak", "no"]
NOT_IDENTIFIABLE = 0.15
"""Standard error, as a fraction of the range of the bounds, beyond which a log says nothing."""
RANK = 1e-9
LEAST_LEFT = 0.05
"""Of a direction of which one stretch of the log knows almost all: its residual there says little."""
FEWEST = 3.0
"""Degrees of freedom that a variance has at least."""


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


@dataclass(frozen=True, eq=False)
class Known:
    """What is known of some parameters from elsewhere: normally distributed.

    Attributes
    ----------
    which : (k,) positions among the parameters.
    mean, covariance : (k,), (k, k).
    """

    which: IntArray
    mean: FloatArray
    covariance: FloatArray

    def beside(self, held: IntArray, values: FloatArray) -> FloatArray:
        """Mean, (k,), where some parameters, by position among all, are held at what they are in `values` (p,)."""
        return self._pulled(np.isin(self.which, held), values[self.which])

    def within(self, lower: FloatArray, upper: FloatArray) -> FloatArray:
        """Mean, (k,), where those beyond their bounds, (p,), lie on them."""
        low, high = lower[self.which], upper[self.which]
        return np.clip(self._pulled((self.mean < low) | (self.mean > high), np.clip(self.mean, low, high)), low, high)

    def _pulled(self, fixed: BoolArray, values: FloatArray) -> FloatArray:
        if not fixed.any():
            return self.mean
        own = self.covariance[np.ix_(fixed, fixed)]
        pull = np.linalg.solve(own, values[fixed] - self.mean[fixed])
        return np.asarray(self.mean + self.covariance[:, fixed] @ pull)

    def joined(self, mean: FloatArray, covariance: FloatArray) -> Known:
        """With other knowledge of the same parameters, (k,) and (k, k), that is independent of this."""
        gain = np.linalg.solve(self.covariance + covariance, covariance).T
        return Known(self.which, mean + gain @ (self.mean - mean), covariance - gain @ covariance)


@dataclass(frozen=True, eq=False)
class Scatter:
    """How far estimates scatter, in coordinates in which white noise of unit size scatters them by the identity.

    Attributes
    ----------
    matrix : (k, k) covariance.
    raw, common : (k, k) the same from the stretches alone, and its mean over all directions.
    shrinkage : how far `matrix` goes from `raw` to the common mean, 0 to 1.
    information : (stretches, k, k) share of each stretch in what is known; the sum is the identity.
    """

    matrix: FloatArray
    raw: FloatArray
    common: float
    shrinkage: float
    information: FloatArray

    def degrees_of_freedom(self, directions: FloatArray) -> FloatArray:
        """Of the variance in some directions (p, k) (Satterthwaite 1946, doi:10.2307/3002019)."""
        unit = directions / np.maximum(np.linalg.norm(directions, axis=1), np.finfo(float).tiny)[:, None]
        # a stretch that holds most of the information counts for most of the stretches
        share = np.einsum("pk,gkl,pl->pg", unit, self.information, unit)
        stretches = np.maximum(1 / np.maximum(np.sum(share**2, axis=1), np.finfo(float).tiny) - 1, 1.0)
        own = (1 - self.shrinkage) * np.einsum("pk,kl,pl->p", unit, self.raw, unit)
        common = self.shrinkage * self.common
        spread = (own**2 + common**2 / max(len(self.matrix), 1)) / stretches
        return np.asarray(np.maximum((own + common) ** 2 / np.maximum(spread, np.finfo(float).tiny), FEWEST))


def scatter(basis: FloatArray, residual: FloatArray, blocks: IntArray, parameters: int) -> Scatter:
    """Scatter of estimates whose Jacobian spans an orthonormal basis.

    Parameters
    ----------
    basis : (r, k) orthonormal columns.
    residual : (r,) whitened.
    blocks : (r,) label of the stretch each residual belongs to; residuals of two stretches are independent.
    parameters : number of parameters fitted, at least k.
    """
    k = basis.shape[1]
    order = np.argsort(blocks, kind="stable")
    ends = np.flatnonzero(np.diff(blocks[order])) + 1
    parts = np.split(order, ends)
    information, scores = np.empty((len(parts), k, k)), np.empty((len(parts), k))
    for g, rows in enumerate(parts):
        own = basis[rows]
        information[g] = own.T @ own
        values, vectors = np.linalg.eigh(information[g])
        # a stretch draws the fit towards itself by as much as it knows
        left = np.sqrt(np.maximum(1 - values, LEAST_LEFT))
        scores[g] = vectors @ ((vectors.T @ (own.T @ residual[rows])) / left)
    raw = scores.T @ scores
    common = float(np.trace(raw)) / max(k, 1)
    far = float(np.sum((raw - common * np.eye(k)) ** 2))
    chance = float(np.sum(np.sum(scores**2, axis=1) ** 2) - np.sum(raw**2) / max(len(parts), 1))
    shrinkage = max(chance, 0.0) / far if chance < far else 1.0
    white = max(float(residual @ residual) / max(len(residual) - parameters, 1), 1.0)
    values, vectors = np.linalg.eigh((1 - shrinkage) * raw + shrinkage * common * np.eye(k))
    matrix = (vectors * np.maximum(values, white)) @ vectors.T
    return Scatter(matrix, raw, common, shrinkage, information)


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
    return spread(jacobian, residual, blocks)[0]


def newton(jacobian: FloatArray, residual: FloatArray) -> FloatArray:
    """Change of the estimates, (p,), that a Gauss-Newton step makes; none in directions that no residual sees."""
    return -np.asarray(np.linalg.lstsq(jacobian, residual, rcond=1e-6)[0])


def spread(jacobian: FloatArray, residual: FloatArray, blocks: IntArray) -> tuple[FloatArray, FloatArray]:
    """Covariance (p, p) as `covariance` has it, and the degrees of freedom (p,) of its variances."""
    p = jacobian.shape[1]
    norm = np.sqrt(np.einsum("ij,ij->j", jacobian, jacobian))
    safe = np.where(norm > 0, norm, 1.0)
    scaled = jacobian / safe
    values, vectors = np.linalg.eigh(scaled.T @ scaled)
    seen = values > RANK * max(values[-1], 1e-300)
    back = vectors[:, seen] / np.sqrt(values[seen])
    found = scatter(scaled @ back, residual, blocks, p)
    result = np.asarray(back @ found.matrix @ back.T / np.outer(safe, safe))
    blind = np.abs(vectors[:, ~seen]).max(axis=1, initial=0.0) > 0.1
    blind |= norm == 0
    result[blind, blind] = np.inf
    return result, found.degrees_of_freedom(back)


def estimates(
    parameters: Sequence[Parameter],
    values: FloatArray,
    jacobian: FloatArray,
    residual: FloatArray,
    blocks: IntArray,
    numerics_shift: FloatArray | None = None,
    known: Known | None = None,
) -> tuple[Estimate, ...]:
    """Estimates with intervals and a verdict on what this log can tell.

    Parameters
    ----------
    parameters, values : (p,).
    jacobian, residual, blocks : as for `covariance`.
    numerics_shift : (p,) change of the estimates when the step is halved, if known.
    known : all that is known of some of them, from these residuals and from elsewhere.
    """
    from scipy.stats import t as student

    cov, dof = spread(jacobian, residual, blocks)
    std = np.sqrt(np.diag(cov))
    if numerics_shift is not None:
        std = np.hypot(std, np.abs(numerics_shift))
    quantile = np.asarray(student.ppf(0.975, dof))
    if known is not None:
        std[known.which] = np.sqrt(np.diag(known.covariance))
        cov[known.which], cov[:, known.which] = 0.0, 0.0
        cov[np.ix_(known.which, known.which)] = known.covariance
        quantile[known.which] = student.ppf(0.975, np.inf)
    norm = np.sqrt(np.einsum("ij,ij->j", jacobian, jacobian))
    result = []
    for i, (parameter, value) in enumerate(zip(parameters, values, strict=True)):
        span = parameter.upper - parameter.lower
        at_bound = bool(min(value - parameter.lower, parameter.upper - value) <= 1e-6 * span)
        state, reason = tell(i, parameters, std, norm, cov, span)
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
