"""Interpolation between two states with known velocities."""

from __future__ import annotations

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
