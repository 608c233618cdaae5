"""Covariance of least-squares estimates whose residuals are correlated.

The covariance is the cluster-robust sandwich over half-second stretches of the log (White 1982,
doi:10.2307/1912526; Liang and Zeger 1986, doi:10.1093/biomet/73.1.13), unbiased where residuals are white (Bell and
McCaffrey 2002, "Bias reduction in standard errors for linear regression with multi-stage samples"). A log has few
stretches and many parameters, so that much of it is chance: it is shrunk towards what all directions have in common, by
as much as its own scatter says (Ledoit and Wolf 2004, doi:10.1016/S0047-259X(03)00096-4). It is never smaller than that
of white residuals of the size actually left.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sysid_btr._typing import BoolArray, FloatArray, IntArray

RANK = 1e-9
LEAST_LEFT = 0.05
"""Of a direction of which one stretch of the log knows almost all: its residual there says little."""
FEWEST = 3.0
"""Degrees of freedom that a variance has at least."""


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
        # a stretch that holds most of the information counts for most of the stretches; shares add up to one, but for
        # directions of length zero, of which there are as many stretches as there are
        share = np.einsum("pk,gkl,pl->pg", unit, self.information, unit)
        stretches = np.maximum(1 / np.maximum(np.sum(share**2, axis=1), 1 / len(self.information)) - 1, 1.0)
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
