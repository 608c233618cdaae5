"""Intervals checked at their ends: whether the likelihood has fallen there as far as its curvature says.

The curvature at the best fit knows nothing of what is farther away: dry friction at a joint that hardly moves holds it
whatever its size, so that the likelihood falls below some size of it and is flat above. The profile likelihood at a
value is at least that of any point with this value, so a point where less is lost than at the end of an interval lies
inside the interval of the profile (Venzon and Moolgavkar 1988, doi:10.2307/2347496): the end moves out until as much is
lost there as a parabola would lose at the end it had. Ends only move outwards; `identify.profile` fits all others anew.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from sysid_btr._typing import FloatArray
from sysid_btr.estimators.base import Problem
from sysid_btr.identify.intervals import NORMAL, Estimate, responses
from sysid_btr.terms.base import Parameter

NEARLY = 0.9
"""Of the loss that a parabola promises at an end, what is taken for it: the end would move by five percent."""
AMONG_OTHERS = 2.0
"""Ratio of a parameter's conditional to its marginal information from which both ways out are looked at."""
_ROUNDS = 12


@dataclass(frozen=True, eq=False)
class _Way:
    """From the best fit outwards: one parameter goes, and the others with it or not.

    Attributes
    ----------
    index, side : of the parameter, and -1 or 1.
    direction : (p,) change of all parameters, of this one by `side`.
    half : how far its interval goes.
    rise : loss that a parabola gains there.
    """

    index: int
    side: int
    direction: FloatArray
    half: float
    rise: float


def followed(
    parameters: Sequence[Parameter],
    found: Sequence[Estimate],
    problem: Problem,
    values: FloatArray,
    jacobian: FloatArray,
) -> tuple[tuple[Estimate, ...], int]:
    """Estimates whose intervals reach as far as the likelihood allows, and the candidates simulated.

    Parameters
    ----------
    parameters, found : (p,) with intervals of the curvature.
    problem, values : whose loss is a sum of squares, and its optimum (p,).
    jacobian : (r, p) of the whitened residuals there.
    """
    ways = _ways(found, jacobian)
    if not ways:
        return tuple(found), 0
    best = float(problem.loss(values[None])[0])
    reach, spent = _reach(ways, problem, values, best)
    result = list(found)
    for i in sorted({way.index for way in ways}):
        far = {s: max((r for w, r in zip(ways, reach, strict=True) if (w.index, w.side) == (i, s)), default=0.0)
               for s in (-1, 1)}  # fmt: skip
        result[i] = _moved(found[i], parameters[i].scale, far[-1], far[1])
    return tuple(result), spent + 1


def _ways(found: Sequence[Estimate], jacobian: FloatArray) -> list[_Way]:
    """The ways out of every interval that ends within its bounds."""
    normal = jacobian.T @ jacobian
    ways = []
    for i, one in enumerate(found):
        if not normal[i, i] > 0:
            continue
        along = responses(normal, i)
        rise = float(along @ normal @ along)
        alone = np.eye(len(found))[i]
        directions = [along] if rise <= 0 else [alone]
        if rise > 0 and normal[i, i] > AMONG_OTHERS * rise:
            directions.append(along)
        for side, end, bound in ((-1, one.ci95[0], one.bounds[0]), (1, one.ci95[1], one.bounds[1])):
            if end != bound and end != one.value:
                half = abs(end - one.value)
                ways += [_Way(i, side, side * d, half, half**2 * rise) for d in directions]
    return ways


def _reach(ways: Sequence[_Way], problem: Problem, values: FloatArray, best: float) -> tuple[list[float], int]:
    """How far each way goes until the loss has risen as far as it should, infinite where it does not; candidates."""
    most = [
        (problem.upper[w.index] - values[w.index]) if w.side > 0 else (values[w.index] - problem.lower[w.index])
        for w in ways
    ]
    far = [min(w.half, float(m)) for w, m in zip(ways, most, strict=True)]
    reach, inner = [0.0] * len(ways), [(0.0, 0.0)] * len(ways)
    going, spent = list(range(len(ways))), 0
    for _ in range(_ROUNDS):
        if not going:
            break
        points = np.array([np.clip(values + far[k] * ways[k].direction, problem.lower, problem.upper) for k in going])
        loss = problem.loss(points)
        spent += len(points)
        still = []
        for k, value in zip(going, loss, strict=True):
            rise, way = float(value) - best, ways[k]
            if not np.isfinite(rise) or rise >= NEARLY * way.rise:
                reach[k] = _crossing(inner[k], (far[k], rise), way.rise)
            elif far[k] >= most[k]:
                reach[k] = np.inf
            else:
                inner[k] = (far[k], max(rise, 0.0))
                far[k] = min(2 * far[k], float(most[k]))
                still.append(k)
        going = still
    for k in going:
        reach[k] = inner[k][0]
    return reach, spent


def _crossing(near: tuple[float, float], far: tuple[float, float], goal: float) -> float:
    """Where the loss has risen by `goal` between two points (distance, rise); its root is nearly a straight line."""
    if not np.isfinite(far[1]):
        return near[0]
    low, high, root = np.sqrt(near[1]), np.sqrt(max(far[1], goal)), np.sqrt(goal)
    return float(near[0] + (far[0] - near[0]) * (root - low) / (high - low)) if high > low else far[0]


def _moved(one: Estimate, scale: float, below: float, above: float) -> Estimate:
    """An estimate whose interval reaches at least so far below and above it."""
    low = max(min(one.ci95[0], one.value - below), one.bounds[0])
    high = min(max(one.ci95[1], one.value + above), one.bounds[1])
    if (low, high) == one.ci95:
        return one
    std = max(one.std, max(one.value - low, high - one.value) / NORMAL)
    weak = one.identifiable == "yes" and std > scale
    return replace(
        one,
        ci95=(low, high),
        std=min(std, one.bounds[1] - one.bounds[0]),
        identifiable="weak" if weak else one.identifiable,
        reason=_open_side(one, low, high) or one.reason or (FLATTER if weak else ""),
    )


FLATTER = "the likelihood is flatter away from the estimate than its curvature there says"


def _open_side(one: Estimate, low: float, high: float) -> str:
    """What to say of an interval that goes to one of its bounds and did not before; else empty."""
    unit = "" if one.unit == "1" else f" {one.unit}"
    if high == one.bounds[1] > one.ci95[1] and low > one.bounds[0]:
        return f"this log bounds it only from below: it is at least {low:.3g}{unit}"
    if low == one.bounds[0] < one.ci95[0] and high < one.bounds[1]:
        return f"this log bounds it only from above: it is at most {high:.3g}{unit}"
    return ""
