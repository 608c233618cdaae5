"""Curves: a cubic between two states with known velocities, a smooth step, the knots of a spline."""

from __future__ import annotations

import numpy as np

from sysid_btr._typing import FloatArray


def hermite(
    f: FloatArray, h: FloatArray | float, p0: FloatArray, p1: FloatArray, v0: FloatArray, v1: FloatArray
) -> FloatArray:
    """Cubic through two positions with their velocities, at the fraction f of an interval h."""
    f2, f3 = f * f, f * f * f
    result: FloatArray = (
        (2 * f3 - 3 * f2 + 1) * p0 + (f3 - 2 * f2 + f) * h * v0 + (3 * f2 - 2 * f3) * p1 + (f3 - f2) * h * v1
    )
    return result


def smooth_step(x: FloatArray) -> FloatArray:
    """0 up to x = 0, 1 from x = 1 on, and a cubic between them that has no slope at either."""
    share = np.clip(x, 0.0, 1.0)
    return np.asarray(share * share * (3 - 2 * share))


def clamped_knots(count: int, degree: int) -> FloatArray:
    """Knots over 0 .. 1 of so many B-splines, even, the ends as often as the curve shall meet them (de Boor 1978)."""
    inner = np.linspace(0.0, 1.0, count - degree + 1)
    return np.concatenate([np.zeros(degree), inner, np.ones(degree)])
