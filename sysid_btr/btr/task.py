"""What a robot is to do, and how well it did."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from sysid_btr._typing import BoolArray, FloatArray

TIPPED = 0.5
"""Cosine of the angle between the base's and the world's vertical below which a robot has fallen."""


@dataclass(frozen=True)
class Walk:
    """Walk forward: the fitness is the mean speed along the heading at the start, m/s, up to a fall.

    Attributes
    ----------
    duration : of a trial, s (the paper's T_e).
    period : of samples and commands, s.
    """

    duration: float = 3.0
    period: float = 0.02

    @cached_property
    def time(self) -> FloatArray:
        """(n,) s."""
        return self.period * np.arange(round(self.duration / self.period) + 1, dtype=np.float64)

    def fallen(self, base: FloatArray) -> BoolArray:
        """(m, n) whether a run has fallen by each sample; base is (m, n, 13) as in `Outputs.base`."""
        upright = 1 - 2 * (base[..., 4] ** 2 + base[..., 5] ** 2)
        return np.logical_or.accumulate(upright < TIPPED, axis=1)

    def fitness(self, base: FloatArray) -> FloatArray:
        """(m,) of runs (m, n, 13); NaN where a run diverged."""
        down = self.fallen(base)
        last = np.where(down.any(axis=1), np.argmax(down, axis=1), base.shape[1] - 1)
        rows = np.arange(len(base))
        return np.asarray((base[rows, last, 0] - base[:, 0, 0]) / self.duration)
