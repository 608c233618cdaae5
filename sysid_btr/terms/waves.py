"""Waves over the angle of a joint: sine, cosine and how many radians of phase a radian of the angle is."""

from __future__ import annotations

import numpy as np

from sysid_btr._typing import FloatArray

PHASES, SIZES, SHIFTS = 8, (1.0, 1.7), (-0.04, -0.02, 0.0, 0.02, 0.04)
"""From which a refit may begin, relative to what a linear scan says."""


def nearby_waves(values: FloatArray) -> FloatArray:
    """Nearby numbers of periods in all phases: a period off over the range of motion is a minimum of its own.

    Parameters
    ----------
    values : (3,) sine, cosine and number.

    Returns
    -------
    ndarray
        (k, 3) the same of each.
    """
    sine, cosine, number = values
    size, phase = np.hypot(sine, cosine), np.arctan2(cosine, sine)
    turns = phase + 2 * np.pi * np.arange(PHASES) / PHASES
    return np.array(
        [
            (size * larger * np.cos(turn), size * larger * np.sin(turn), number * (1 + shift))
            for larger in SIZES
            for shift in SHIFTS
            for turn in turns
        ]
    )
