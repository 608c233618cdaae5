"""How far from what has worked a controller may lie: steps grow with success and shrink after falls."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sysid_btr._typing import BoolArray, FloatArray
from sysid_btr.btr.controllers import ControllerSpace
from sysid_btr.btr.trials import Tried

FIRST, LEAST, MOST = 0.2, 0.02, 0.5
"""Half-widths of the region, fractions of the range of every number: at first, at least, at most."""
GROWS, SHRINKS = 1.1, 0.6
"""By what it grows with a trial that stood, and shrinks after one that did not: it stays where one of six falls."""


@dataclass(frozen=True, eq=False)
class Region:
    """Controllers that are near enough to the best one that stood; all of them before any did.

    Attributes
    ----------
    lower, upper : (p,) its bounds.
    centre : (p,) the best that stood; None before.
    radius : half-width, a fraction of the range.
    """

    lower: FloatArray
    upper: FloatArray
    centre: FloatArray | None = None
    radius: float = 1.0

    @classmethod
    def after(cls, tried: Sequence[Tried], space: ControllerSpace) -> Region:
        """The region after some trials."""
        lower, upper = np.asarray(space.lower), np.asarray(space.upper)
        stood = [t for t in tried if t.trial.outcome == "done"]
        if not stood:
            return cls(lower, upper)
        radius, began = FIRST, False
        for t in tried:
            up = t.trial.outcome == "done"
            began = began or up
            if began:
                radius = float(np.clip(radius * (GROWS if up else SHRINKS), LEAST, MOST))
        centre = max(stood, key=lambda t: t.trial.fitness).controller.values
        reach = radius * (upper - lower)
        return cls(np.maximum(lower, centre - reach), np.minimum(upper, centre + reach), centre, radius)

    def contains(self, controllers: FloatArray) -> BoolArray:
        """(n,) whether controllers (n, p) lie in it."""
        slack = 1e-9 * (self.upper - self.lower)
        return np.asarray(((controllers >= self.lower - slack) & (controllers <= self.upper + slack)).all(axis=1))
