"""How far from what has worked a controller may lie: steps grow with success and shrink after falls.

As in a trust region (Conn, Gould and Toint 2000, doi:10.1137/1.9780898719857, section 6.1), which is the larger the
better what was tried went as foreseen.
"""

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
FORESEEN, GROWS_FAST, LOST = 0.9, 1.5, 0.5
"""Share of the expected fitness, or its inverse, from which a trial went as foreseen, and by what the region grows with
it; share below which a model is no guide there, so that the region shrinks although the robot stood."""


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
            began = began or t.trial.outcome == "done"
            if began:
                radius = float(np.clip(radius * _factor(t), LEAST, MOST))
        centre = max(stood, key=lambda t: t.trial.fitness).controller.values
        reach = radius * (upper - lower)
        return cls(np.maximum(lower, centre - reach), np.minimum(upper, centre + reach), centre, radius)

    def contains(self, controllers: FloatArray) -> BoolArray:
        """(n,) whether controllers (n, p) lie in it."""
        slack = 1e-9 * (self.upper - self.lower)
        return np.asarray(((controllers >= self.lower - slack) & (controllers <= self.upper + slack)).all(axis=1))


def _factor(tried: Tried) -> float:
    """By what a trial widens the region."""
    real, expected = tried.trial.fitness, tried.expected
    if tried.trial.outcome != "done" or real < LOST * expected:
        return SHRINKS
    return GROWS_FAST if FORESEEN * expected <= real <= expected / FORESEEN else GROWS
