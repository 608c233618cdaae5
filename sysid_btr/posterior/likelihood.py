"""The likelihood of a replay that is neither perfect nor white.

The residuals of a replay are correlated and hold what the model lacks, so the product of independent Gaussians is
far too sure of itself. Least squares answers with the sandwich covariance (`identify.intervals`); the posterior
answers with the likelihood adjusted to match it (Chandler and Bate 2007, doi:10.1093/biomet/asm015; for its use in
a posterior: Ribatet, Cooley, Davison 2012, doi:10.5705/ss.2009.248):

    log L(x) = -1/2 k(x) (loss(x) - loss(x0)),    k(x) = d' G d / d' H d,    d = x - x0,

with the loss of a real replay at ``x``, the fit ``x0``, ``H = J'J`` and ``G`` the inverse of the sandwich covariance.
In each direction the loss counts as much as the independent information in it, never more than white noise of the
size that is left would allow. Where residuals are white and of the size of the noise floor ``k`` is 1; where the
model is linear the posterior's covariance is the sandwich. (The intervals of `fit` are a few per cent wider than the
quantiles of such draws: by Student's t they also count that ``G`` is estimated.)
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sysid_btr._typing import FloatArray, IntArray
from sysid_btr.estimators.base import Problem, UnitBox
from sysid_btr.estimators.linearisation import linearise
from sysid_btr.estimators.lsq import LeastSquares
from sysid_btr.objectives.covariance import scatter

RANK = 1e-9
"""Directions of `H` below this fraction of the largest are not seen by any residual."""
PRIOR_PRECISION = 12.0
"""Of a uniform distribution over the unit interval."""
SETTLED = 0.1
"""Standard deviations within which the fit must be the minimum of its own linear model."""
_ROUNDS = 4


@dataclass(frozen=True, eq=False)
class Likelihood:
    """The adjusted likelihood about a fit, in the unit cube of the bounds.

    Attributes
    ----------
    box : bounds.
    centre : (p,) the fit.
    loss : at the centre.
    frame : (k, p) directions in which information is counted, as rows; ``J'J`` is ``frame' frame``.
    share : (k,) independent share of the information in each, at most 1.
    """

    box: UnitBox
    centre: FloatArray
    loss: float
    frame: FloatArray
    share: FloatArray

    def log(self, u: FloatArray, loss: FloatArray) -> FloatArray:
        """Log-likelihood (m,) of points (m, p) whose replays gave these losses (m,)."""
        return np.asarray(-0.5 * self.factor(u) * (loss - self.loss))

    def factor(self, u: FloatArray) -> FloatArray:
        """``k`` (m,): the share of the change of loss that counts."""
        # einsum, not BLAS: the same bits whatever the number of threads
        z = np.einsum("ki,mi->mk", self.frame, u - self.centre) ** 2
        total = z.sum(axis=1)
        weighted = np.einsum("mk,k->m", z, self.share)
        return np.asarray(np.divide(weighted, total, out=np.ones_like(total), where=total > 0))

    def expected(self, mean: FloatArray, std: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Mean (p,) and covariance (p, p) of a posterior that is normal, in the unit cube.

        Parameters
        ----------
        mean, std : (p,) of the priors there.
        """
        information = np.einsum("ki,k,kj->ij", self.frame, self.share, self.frame)
        covariance = np.linalg.inv(information + np.diag(1.0 / std**2))
        centre = covariance @ (information @ self.centre + mean / std**2)
        return np.clip(centre, 0.0, 1.0), np.asarray(covariance)


def make_likelihood(
    problem: Problem,
    x: FloatArray,
    residual: FloatArray,
    jacobian: FloatArray,
    blocks: IntArray | None,
    shift: FloatArray | None = None,
) -> Likelihood:
    """The adjusted likelihood about a fit.

    Parameters
    ----------
    problem : bounds.
    x : (p,) the fit.
    residual, jacobian : (r,), (r, p) whitened residuals there and their derivatives.
    blocks : (r,) label of the stretch of time each residual belongs to; residuals of two stretches are
        independent. None for residuals that are known to be white and of unit size.
    shift : (p,) change of the fit when the replay's step is halved; widens the likelihood in its direction.
    """
    box = UnitBox(problem.lower, problem.upper)
    scaled = np.nan_to_num(jacobian) * box.span
    normal = np.einsum("ri,rj->ij", scaled, scaled)
    values, vectors = np.linalg.eigh(normal)
    seen = values > RANK * max(values[-1], np.finfo(float).tiny)
    root = np.sqrt(values[seen])
    whitening = root[:, None] * vectors[:, seen].T
    if blocks is None:
        share = np.ones(len(root))
        frame = whitening
    else:
        spread = scatter(scaled @ (vectors[:, seen] / root), residual, blocks, len(x)).matrix
        if shift is not None:
            moved = whitening @ (np.nan_to_num(shift) / box.span)
            spread = spread + np.outer(moved, moved)
        inflation, turn = np.linalg.eigh(spread)
        share = 1.0 / inflation
        frame = turn.T @ whitening
    return Likelihood(box=box, centre=box.enter(x), loss=float(residual @ residual), frame=frame, share=share)


def settle(
    problem: Problem, x: FloatArray, step: float = LeastSquares.central_step
) -> tuple[FloatArray, FloatArray, FloatArray, int]:
    """The minimum near a fit, with what it holds at nominal values freed: x, residual, Jacobian, replays.

    Gauss-Newton from `x` until its step is below `SETTLED` standard deviations; directions that the residuals do
    not see stay where they are. `step` is that of the differences, fraction of the range.
    """
    from scipy.optimize import lsq_linear

    box = UnitBox(problem.lower, problem.upper)
    x = np.clip(x, box.lower, box.upper)
    residual, jacobian = linearise(problem, x, step=step)
    replays = 2 * len(x) + 1
    for _ in range(_ROUNDS):
        scaled = np.nan_to_num(jacobian) * box.span
        u = box.enter(x)
        root = np.linalg.cholesky(scaled.T @ scaled + PRIOR_PRECISION * np.eye(len(x))).T
        goal = -np.linalg.solve(root.T, scaled.T @ residual)
        move = np.asarray(lsq_linear(root, goal, bounds=(-u - 1e-15, 1.0 - u + 1e-15), method="bvls").x)
        if float(np.linalg.norm(root @ move)) < SETTLED:
            break
        other = box.leave(np.clip(u + move, 0.0, 1.0))
        other_residual, other_jacobian = linearise(problem, other, step=step)
        replays += 2 * len(x) + 1
        if not float(other_residual @ other_residual) < float(residual @ residual):
            break
        x, residual, jacobian = other, other_residual, other_jacobian
    return x, residual, jacobian, replays
