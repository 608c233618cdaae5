"""Step 1 under what is not known: controllers are searched for in models drawn from what is believed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sysid_btr._typing import BoolArray, FloatArray, IntArray
from sysid_btr.btr.problems import Stage
from sysid_btr.errors import UsageError


@dataclass(frozen=True)
class Risk:
    """What a controller is worth that does different things in different models.

    The mean over models and the mean of the worst of them (conditional value at risk; Rockafellar and Uryasev 2000,
    doi:10.21314/JOR.2000.038) count by weight; where it falls, a controller is worth what a fall costs.

    Attributes
    ----------
    weight : of the worst models, 0 to 1.
    share : of models that are the worst.
    fall : what a fall costs, in the task's unit.
    """

    weight: float = 0.25
    share: float = 0.25
    fall: float = 0.05

    def __post_init__(self) -> None:
        if not (0 <= self.weight <= 1 and 0 < self.share <= 1 and np.isfinite(self.fall)):
            raise UsageError("btr: the weight of the worst models is 0 to 1, their share above 0 and at most 1")

    def worth(self, fitness: FloatArray, fell: BoolArray) -> FloatArray:
        """What controllers are worth, (m,), of fitness and falls (k, m) in k models; NaN where none can be played.

        A simulation that diverged counts as a fall.
        """
        values = np.where(fell | ~np.isfinite(fitness), -self.fall, fitness)
        worst = np.sort(values, axis=0)[: int(np.ceil(self.share * len(values)))]
        worth = (1 - self.weight) * values.mean(axis=0) + self.weight * worst.mean(axis=0)
        return np.where(np.isnan(fitness).all(axis=0), np.nan, worth)


@dataclass(frozen=True, eq=False)
class RobustProblem:
    """Step 1: the loss of a controller is what it is worth in drawn models, negative.

    All controllers of a generation run in the same models, so that they are compared by what they do. Most runs go to
    those that are worth them: after 1, 2, 4, .. models the better half goes on to as many more (successive halving;
    Jamieson and Talwalkar 2016, arXiv 1502.07943); the others keep what they were worth so far, and no more than those
    that went on.

    Attributes
    ----------
    stage, models : where controllers run, and the drawn candidates (k, q), the likeliest first.
    start : (p,) controller that is the seed.
    lower, upper : (p,) of the controllers that are searched.
    risk : how falls and the worst models count.
    """

    stage: Stage
    models: FloatArray
    start: FloatArray
    lower: FloatArray
    upper: FloatArray
    risk: Risk

    @property
    def names(self) -> tuple[str, ...]:
        return self.stage.space.names

    @property
    def runs(self) -> float:
        """Of one controller, in the mean over many."""
        return float(sum((last - first) * share for first, last, share in self._stages))

    @property
    def _stages(self) -> list[tuple[int, int, float]]:
        """First and last model of each stage, and the share of controllers that run in them."""
        stages, first, last, share = [], 0, 1, 1.0
        while first < len(self.models):
            stages.append((first, min(last, len(self.models)), share))
            first, last, share = last, 2 * last, share / 2
        return stages

    def loss(self, candidates: FloatArray) -> FloatArray:
        """What controllers (m, p) are worth, negative, (m,); NaN where they cannot be played."""
        m = len(candidates)
        fitness = np.full((len(self.models), m), np.nan)
        fell = np.zeros((len(self.models), m), dtype=bool)
        worth = np.full(m, np.nan)
        running: IntArray = np.arange(m)
        left: list[IntArray] = []
        for first, last, share in self._stages:
            if first:
                order = running[np.argsort(-np.nan_to_num(worth[running], nan=-np.inf), kind="stable")]
                kept = int(np.ceil(share * m))
                left.append(order[kept:])
                running = np.sort(order[:kept])
            fitness[first:last, running], fell[first:last, running] = self.stage.outcomes(
                candidates[running], self.models[first:last]
            )
            worth[running] = self.risk.worth(fitness[:last, running], fell[:last, running])
        for rows in reversed(left):
            least = np.nanmin(worth[running]) if np.isfinite(worth[running]).any() else np.inf
            worth[rows] = np.minimum(worth[rows], least)
            running = np.concatenate([running, rows])
        return -worth
