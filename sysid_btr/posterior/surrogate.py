"""Proposals that cost no replay: a chain under a foretold density, whose end a real replay accepts or not.

Near a fit the residuals of a replay are almost linear in the parameters. A quadratic model of them is regressed on a
few replays spread over the posterior that is expected; it foretells the loss of any other candidate.

Surrogate transition (Liu 2001, Monte Carlo Strategies in Scientific Computing, sec. 9.4.3; with one step it is
delayed acceptance, Christen and Fox 2005, doi:10.1198/106186005X76983). A walker moves ``substeps`` times under the
foretold density ``g``, with the other half of the ensemble held: each time by a stretch move (Goodman and Weare 2010)
or to an independent draw from a normal distribution, with equal chance. That kernel is reversible with respect to
``g``, so accepting its end ``y`` with probability ``min(1, f(y) g(x) / (f(x) g(y)))`` leaves the true density ``f``,
of real replays, invariant: exactly, however poor the surrogate. How often it is accepted says how good the surrogate
is.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from sysid_btr._typing import BoolArray, FloatArray, IntArray
from sysid_btr.estimators.base import ResidualProblem
from sysid_btr.estimators.ensemble import LogDensity, bounded, folded, log_jacobian, unbounded
from sysid_btr.estimators.evaluator import Evaluator
from sysid_btr.optional import optional

if TYPE_CHECKING:
    from numpy.random import Generator

_STRETCH = 2.0
_WIDER = 1.1
"""Of the independent draws, against the covariance that is expected: their tails must not be the lighter ones."""
_SPREAD = 1.5
"""Of the replays that a model is regressed on, in standard deviations expected."""
_REPLAYS = 2.0
"""For each coefficient of the model."""
_MOST_TERMS = 150
"""Beyond it the model has no mixed terms."""


@dataclass(frozen=True, eq=False)
class Guess:
    """A normal distribution in the unit cube.

    Attributes
    ----------
    centre : (p,) mean.
    root, inverse : (p, p) Cholesky factor of the covariance, and its inverse.
    """

    centre: FloatArray
    root: FloatArray
    inverse: FloatArray

    @classmethod
    def about(cls, centre: FloatArray, covariance: FloatArray, wider: float = _WIDER) -> Guess:
        """Wider than a covariance (p, p) by a factor in every direction."""
        root: FloatArray = wider * np.asarray(np.linalg.cholesky(covariance), dtype=np.float64)
        return cls(centre, root, np.asarray(np.linalg.inv(root), dtype=np.float64))

    def draw(self, count: int, rng: Generator) -> FloatArray:
        """Points (count, p), some of them outside the cube."""
        normal = rng.standard_normal((count, len(self.centre)))
        return np.asarray(self.centre + np.einsum("ij,wj->wi", self.root, normal))

    def whiten(self, u: FloatArray) -> FloatArray:
        """Points (m, p) in standard deviations from the centre."""
        return np.asarray(np.einsum("ij,wj->wi", self.inverse, u - self.centre))

    def walkers(self, count: int, rng: Generator) -> tuple[FloatArray, BoolArray]:
        """Points (count, p) of the walkers' space, and which of them lie in the cube."""
        u = self.draw(count, rng)
        return unbounded(u), np.asarray(np.all((u > 0.0) & (u < 1.0), axis=1))

    def log_density(self, v: FloatArray) -> FloatArray:
        """Log density (m,) of points (m, p) of the walkers' space, up to a constant."""
        return np.asarray(-0.5 * np.sum(self.whiten(bounded(v)) ** 2, axis=1) + log_jacobian(v))


@dataclass(frozen=True, eq=False)
class Foretold:
    """The loss of residuals that are polynomials of second order in the parameters.

    Attributes
    ----------
    frame : coordinates of the polynomials.
    pairs : (2, q) the products that the model has.
    gram : (1 + p + q, 1 + p + q) inner products of the polynomials' coefficients, all residuals together.
    """

    frame: Guess
    pairs: IntArray
    gram: FloatArray

    def loss(self, u: FloatArray) -> FloatArray:
        """Losses (m,) of points (m, p) of the unit cube."""
        terms = polynomial_terms(self.frame.whiten(u), self.pairs)
        # einsum, not BLAS: the same bits whatever the number of threads
        return np.asarray(np.einsum("mi,ij,mj->m", terms, self.gram, terms))


def polynomial_terms(z: FloatArray, pairs: IntArray) -> FloatArray:
    """1, each coordinate, each product: (m, 1 + p + q) of points (m, p)."""
    return np.hstack([np.ones((len(z), 1)), z, z[:, pairs[0]] * z[:, pairs[1]]])


def regress(
    problem: ResidualProblem, evaluator: Evaluator, centre: FloatArray, covariance: FloatArray, rng: Generator
) -> Foretold:
    """A quadratic model of the residuals about a fit, from real replays.

    Parameters
    ----------
    problem, evaluator : replays.
    centre, covariance : (p,), (p, p) mean and covariance of the posterior that is expected, in the unit cube.
    """
    p = len(centre)
    frame = Guess.about(centre, covariance, _SPREAD)
    mixed = 1 + p + p * (p + 1) // 2 <= _MOST_TERMS
    pairs = np.array(np.triu_indices(p) if mixed else (np.arange(p), np.arange(p)))
    count = int(np.ceil(_REPLAYS * (1 + p + pairs.shape[1])))
    design = np.vstack([centre[None], folded(frame.draw(count, rng))])
    terms = polynomial_terms(frame.whiten(design), pairs)

    def reduction(rows: FloatArray) -> tuple[dict[str, FloatArray], None]:
        good = np.isfinite(rows).all(axis=1)
        inverse = np.linalg.pinv(terms[good], rcond=1e-9)
        inner = np.einsum("ar,br->ab", rows[good], rows[good])
        return {"gram": inverse @ inner @ inverse.T}, None

    points, shape = evaluator.box.leave(design), (terms.shape[1],) * 2
    reduced = evaluator.reduce(problem, points, reduction, "learning the residuals", {"gram": shape})
    return Foretold(frame, pairs, np.asarray(reduced.arrays["gram"]))


@dataclass(eq=False)
class Proposal:
    """The end of a chain under a surrogate density, as emcee's red-blue moves ask for it.

    Attributes
    ----------
    surrogate : log density of points (m, p).
    guess : where independent draws come from.
    substeps : moves of each proposal.
    rng : random numbers of these moves.
    made : proposals so far.
    """

    surrogate: LogDensity
    guess: Guess
    substeps: int
    rng: Generator
    made: int = 0

    def __call__(self, half: FloatArray, others: Any, _random: Any) -> tuple[FloatArray, FloatArray]:
        """New points for one half of the ensemble, and ``log g(old) - log g(new)``."""
        partners = np.concatenate(others, axis=0)
        x, begin = half.copy(), self.surrogate(half)
        density = begin.copy()
        for stretch in np.asarray(self.rng.random(self.substeps)) < 0.5:
            trial, factor = self._stretched(x, partners) if stretch else self._guessed(x)
            value = self.surrogate(trial)
            taken = factor + value - density > np.log1p(-self.rng.random(len(half)))
            x[taken], density[taken] = trial[taken], value[taken]
        self.made += len(half)
        return x, begin - density

    def _stretched(self, x: FloatArray, partners: FloatArray) -> tuple[FloatArray, FloatArray]:
        count, p = x.shape
        z = ((_STRETCH - 1.0) * self.rng.random(size=(count,)) + 1.0) ** 2 / _STRETCH
        partner = partners[self.rng.integers(len(partners), size=count)]
        return partner + (x - partner) * z[:, None], (p - 1.0) * np.log(z)

    def _guessed(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        trial, whole = self.guess.walkers(len(x), self.rng)
        return trial, np.where(whole, self.guess.log_density(x) - self.guess.log_density(trial), -np.inf)


def surrogate_move(proposal: Proposal) -> Any:
    """The proposal as a move of emcee, which accepts or rejects it by the true density."""
    move = optional("emcee", "posterior", "ensemble sampling").moves.RedBlueMove()
    move.get_proposal = proposal
    return move
