"""Step 2 trusts the robot more than the model: what is foreseen of controllers, given all trials so far.

The real fitness of a controller that stands is a Gaussian process over controllers. Its mean is that over models drawn
from what is believed; it varies as they do (which of them is right holds for all controllers), by a discrepancy that
neighbours share, and by one in proportion to speed (Kennedy and O'Hagan 2001, doi:10.1111/1467-9868.00294; Cully et
al. 2015, doi:10.1038/nature14422, has the discrepancy alone). Whether it stands is a second process, logistic
(Rasmussen and Williams 2006, section 3.4), about the share of drawn models in which it does.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from sysid_btr._typing import BoolArray, FloatArray, IntArray

REACH = (0.1, 0.2, 0.4)
"""Distances, fractions of the range of every number of a controller, over which a discrepancy may hold."""
SIZES = (0.1, 0.2, 0.4, 0.8, 1.6)
"""Standard deviations that a discrepancy may have, over that of the models' fitness between controllers."""
USUAL, SPREAD = 0.4, 1.0
"""Size about which it is expected, and standard deviation of its logarithm."""
ROUGH = 0.4
"""Standard deviation of what no neighbour shares, over that of the discrepancy: impacts roughen fitness."""
PROPORTION = 0.3
"""Standard deviation of the discrepancy in proportion to speed."""
SLIP, LOCAL, LOCAL_REACH = 1.0, 1.5, 0.2
"""Standard deviations of the logit of standing: of all controllers alike, of neighbours alike; and their distance."""
WORD = 0.3
"""Standard deviation of what the models' own logit counts for, 1 if falls on the robot come as often as in them: where
all models agree, a fall says that they are too sure. 200 trials of six robots in another engine, foreseen one by one:
log score 0.453 a trial, 0.506 without it. That is one robot whose models were too sure (0.79, 1.05); the others are
alike within 0.02."""
GRID = 41
"""Points of a distribution at which quantiles are looked for."""


@dataclass(frozen=True, eq=False)
class Drawn:
    """What controllers do in drawn models.

    Attributes
    ----------
    controllers : (n, p), in fractions of their ranges.
    fitness, fell : (k, n) in k models; what diverged fell.
    """

    controllers: FloatArray
    fitness: FloatArray
    fell: BoolArray

    def beside(self, other: Drawn) -> Drawn:
        """These controllers and others, in the same models."""
        return Drawn(
            np.concatenate([self.controllers, other.controllers]),
            np.concatenate([self.fitness, other.fitness], axis=1),
            np.concatenate([self.fell, other.fell], axis=1),
        )

    def models(self, rows: IntArray) -> Drawn:
        """All of them in some of the models."""
        return Drawn(self.controllers, self.fitness[rows], self.fell[rows])

    def of(self, rows: IntArray) -> Drawn:
        """Some of them."""
        return Drawn(self.controllers[rows], self.fitness[:, rows], self.fell[:, rows])


@dataclass(frozen=True)
class Foreseen:
    """What is foreseen of one controller.

    Attributes
    ----------
    fitness, std : if it stands, in the task's unit.
    stands : probability.
    low, high : 90 % interval, falls included.
    """

    fitness: float
    std: float
    stands: float
    low: float
    high: float

    def within(self, least: float, most: float) -> Foreseen:
        """The same where no fitness is below or above some."""
        return replace(self, low=max(self.low, least), high=min(self.high, most))


@dataclass(frozen=True, eq=False)
class Foresight:
    """What is foreseen of some controllers.

    Attributes
    ----------
    mean, std : (n,) fitness of those that stand, in the task's unit.
    stands : (n,) probability.
    """

    mean: FloatArray
    std: FloatArray
    stands: FloatArray

    def improvement(self, best: float) -> FloatArray:
        """Expected gain over the best so far, times the chance to stand, (n,) (Jones et al. 1998)."""
        from scipy.stats import norm

        z = (self.mean - best) / self.std
        return np.asarray(self.stands * self.std * (z * norm.cdf(z) + norm.pdf(z)))

    def of(self, row: int, level: float = 0.9) -> Foreseen:
        """Of one, with an interval: a run that falls ends anywhere, at most as far back as it would have gone ahead."""
        from scipy.stats import norm

        mean, std, stands = float(self.mean[row]), float(self.std[row]), float(self.stands[row])
        part = (np.arange(GRID) + 0.5) / GRID
        normal = mean + std * norm.ppf(part)
        cut = np.outer(2 * part - 1, normal).ravel()
        values = np.concatenate([normal, cut])
        weights = np.concatenate([np.full(GRID, stands / GRID), np.full(GRID**2, (1 - stands) / GRID**2)])
        order = np.argsort(values)
        below = np.cumsum(weights[order]) - weights[order] / 2
        low, high = np.interp([(1 - level) / 2, (1 + level) / 2], below, values[order])
        return Foreseen(mean, std, stands, float(low), float(high))


def foresee(drawn: Drawn, tried: Drawn, real: FloatArray, stood: BoolArray) -> Foresight:
    """What is foreseen of controllers.

    Parameters
    ----------
    drawn : the controllers asked about.
    tried : those that were tried on the robot, in the same models, (t,).
    real, stood : (t,) their fitness there, and whether they stood; of one that fell only that counts.
    """
    everything = tried.beside(drawn)
    t = len(real)
    seen, asked = np.flatnonzero(stood), np.arange(t, len(everything.controllers))
    mean, std = _speed(everything, seen, asked, real[stood])
    return Foresight(mean, std, _standing(everything, t, stood))


def _speed(drawn: Drawn, seen: IntArray, asked: IntArray, real: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Mean and standard deviation of fitness, averaged over the sizes and reaches that a discrepancy may have."""
    upright = np.where(drawn.fell | ~np.isfinite(drawn.fitness), np.nan, drawn.fitness)
    stands = np.isfinite(upright).any(axis=0)
    prior = np.zeros(upright.shape[1])
    prior[stands] = np.nanmean(upright[:, stands], axis=0)
    prior[~stands] = np.nan_to_num(np.where(np.isfinite(drawn.fitness), drawn.fitness, 0.0).mean(axis=0))[~stands]
    away = np.nan_to_num(upright - prior)
    models = away.T @ away / max(len(away) - 1, 1) + PROPORTION**2 * np.outer(prior, prior)
    unit = max(float(np.std(prior)), 0.1 * float(np.abs(prior).max()), 1e-6)
    square = _squares(drawn.controllers)
    results = []
    for size, reach in product(SIZES, REACH):
        own = (size * unit) ** 2
        covariance = models + own * np.exp(-square / (2 * reach**2))
        noise = ROUGH**2 * own
        among = covariance[np.ix_(seen, seen)] + noise * np.eye(len(seen))
        root = np.linalg.cholesky(among + 1e-12 * unit**2 * np.eye(len(seen)))
        across = np.linalg.solve(root, covariance[np.ix_(seen, asked)])
        left = np.linalg.solve(root, real - prior[seen])
        mean = prior[asked] + across.T @ left
        variance = np.diag(covariance)[asked] + noise - np.sum(across**2, axis=0)
        evidence = -0.5 * left @ left - np.sum(np.log(np.diag(root))) - 0.5 * (np.log(size / USUAL) / SPREAD) ** 2
        results.append((evidence, mean, np.maximum(variance, noise)))
    evidence = np.array([r[0] for r in results])
    weight = np.exp(evidence - evidence.max())
    weight /= weight.sum()
    mean = weight @ np.array([r[1] for r in results])
    variance = weight @ np.array([r[2] + (r[1] - mean) ** 2 for r in results])
    return np.asarray(mean), np.asarray(np.sqrt(variance))


def _standing(drawn: Drawn, t: int, stood: BoolArray) -> FloatArray:
    """Chance to stand of what was not tried, by Laplace's approximation."""
    from scipy.special import expit, logit

    share = (np.sum(~drawn.fell, axis=0) + 0.5) / (len(drawn.fell) + 1)
    prior = logit(share)
    near = np.exp(-_squares(drawn.controllers) / (2 * LOCAL_REACH**2))
    covariance = SLIP**2 + LOCAL**2 * near + WORD**2 * np.outer(prior, prior)
    among, across = covariance[:t, :t], covariance[:t, t:]
    latent = np.zeros(t)
    for _ in range(50):
        chance = expit(prior[:t] + latent)
        weight = chance * (1 - chance)
        root = np.sqrt(weight)
        step = weight * latent + stood - chance
        inner = np.eye(t) + root[:, None] * among * root
        wanted = among @ (step - root * np.linalg.solve(inner, root * (among @ step)))
        done = np.max(np.abs(wanted - latent), initial=0.0) < 1e-9
        latent = wanted
        if done:
            break
    chance = expit(prior[:t] + latent)
    root = np.sqrt(chance * (1 - chance))
    inner = np.eye(t) + root[:, None] * among * root
    mean = prior[t:] + across.T @ (stood - chance)
    scaled = root[:, None] * across
    variance = np.diag(covariance)[t:] - np.sum(scaled * np.linalg.solve(inner, scaled), axis=0)
    return np.asarray(expit(mean / np.sqrt(1 + np.pi * np.maximum(variance, 0.0) / 8)))


def _squares(controllers: FloatArray) -> FloatArray:
    """Mean over their numbers of the squared differences of controllers (n, p), (n, n)."""
    return np.asarray(np.mean((controllers[:, None] - controllers[None]) ** 2, axis=2))
