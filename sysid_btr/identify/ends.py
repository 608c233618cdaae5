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

from sysid_btr._typing import BoolArray, FloatArray
from sysid_btr.estimators.base import ResidualProblem
from sysid_btr.estimators.linearisation import Pattern
from sysid_btr.identify.intervals import NORMAL, Estimate, responses
from sysid_btr.terms.base import Parameter

NEARLY = 0.9
"""Of the loss that a parabola promises at an end, what is taken for it: the end would move by five percent."""
AMONG_OTHERS = 2.0
"""Ratio of a parameter's conditional to its marginal information from which both ways out are looked at."""
HELD = 1 << 24
"""Residuals that are held at once."""
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
    rows : (r,) residuals that can change on it; None for all.
    """

    index: int
    side: int
    direction: FloatArray
    half: float
    rise: float
    rows: BoolArray | None


def followed(
    parameters: Sequence[Parameter],
    found: Sequence[Estimate],
    problem: ResidualProblem,
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
    ways = _ways(found, jacobian, Pattern.of(problem))
    if not ways:
        return tuple(found), 0
    reach, spent = _reach(ways, problem, values)
    result = list(found)
    for i in sorted({way.index for way in ways}):
        far = {s: max((r for w, r in zip(ways, reach, strict=True) if (w.index, w.side) == (i, s)), default=0.0)
               for s in (-1, 1)}  # fmt: skip
        result[i] = _moved(found[i], parameters[i].scale, far[-1], far[1])
    return tuple(result), spent


def _ways(found: Sequence[Estimate], jacobian: FloatArray, pattern: Pattern) -> list[_Way]:
    """The ways out of every interval that ends within its bounds."""
    from scipy.sparse.csgraph import connected_components

    normal = jacobian.T @ jacobian
    _, part = connected_components(normal != 0)
    ways = []
    for i, one in enumerate(found):
        if not normal[i, i] > 0:
            continue
        along = np.where(part == part[i], responses(normal, i), 0.0)
        rise = max(float(along @ normal @ along), 0.0)  # rounding may make less of nothing
        alone = np.eye(len(found))[i]
        directions = [alone] if rise > 0 else [along]
        if rise > 0 and normal[i, i] > AMONG_OTHERS * rise:
            directions.append(along)
        rows = [_rows(pattern, d) for d in directions]
        for side, end, bound in ((-1, one.ci95[0], one.bounds[0]), (1, one.ci95[1], one.bounds[1])):
            if end != bound and end != one.value:
                half = abs(end - one.value)
                ways += [
                    _Way(i, side, side * d, half, half**2 * rise, own) for d, own in zip(directions, rows, strict=True)
                ]
    return ways


def _rows(pattern: Pattern, direction: FloatArray) -> BoolArray | None:
    """Residuals (r,) that a change (p,) of parameters can move; None for all."""
    own = [pattern.support(int(j)) for j in np.flatnonzero(direction)]
    known = [rows for rows in own if rows is not None]
    return np.logical_or.reduce(known) if len(known) == len(own) else None


def _reach(ways: Sequence[_Way], problem: ResidualProblem, values: FloatArray) -> tuple[list[float], int]:
    """How far each way goes until the loss has risen as far as it should, infinite where it does not; candidates."""
    most = [
        (problem.upper[w.index] - values[w.index]) if w.side > 0 else (values[w.index] - problem.lower[w.index])
        for w in ways
    ]
    far = [min(w.half, float(m)) for w, m in zip(ways, most, strict=True)]
    reach, inner = [0.0] * len(ways), [(0.0, 0.0)] * len(ways)
    going, spent = list(range(len(ways))), 1
    best = problem.residuals(values[None])[0] ** 2
    for _ in range(_ROUNDS):
        if not going:
            break
        rises, taken = _rises(problem, values, best, [(ways[k], far[k]) for k in going])
        spent += taken
        still = []
        for k, rise in zip(going, rises, strict=True):
            way = ways[k]
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


def _rises(
    problem: ResidualProblem, values: FloatArray, best: FloatArray, steps: Sequence[tuple[_Way, float]]
) -> tuple[list[float], int]:
    """Rise of the loss above its squares `best` (r,) so far along each way, and the candidates simulated.

    Ways that move different residuals share a candidate, unless it fails.
    """
    shared: list[tuple[list[int], BoolArray | None]] = []
    for k, (way, _) in enumerate(steps):
        for at, (party, rows) in enumerate(shared):
            if rows is not None and way.rows is not None and not np.any(rows & way.rows):
                shared[at] = [*party, k], rows | way.rows
                break
        else:
            shared.append(([k], way.rows))
    points = np.tile(values, (len(shared), 1))
    for point, (party, _) in zip(points, shared, strict=True):
        for k in party:
            point += steps[k][1] * steps[k][0].direction
    points, rises = np.clip(points, problem.lower, problem.upper), [np.nan] * len(steps)
    size = max(HELD // len(best), 2)
    for first in range(0, len(points), size):
        block = problem.residuals(points[first : first + size])
        for squares, (party, _) in zip(block**2 - best, shared[first : first + size], strict=True):
            for k in party:
                rows = steps[k][0].rows
                rises[k] = float(np.sum(squares if rows is None else squares[rows]))
    spent = len(points)
    for k in (k for party, _ in shared if len(party) > 1 for k in party if not np.isfinite(rises[k])):
        (rises[k],), _ = _rises(problem, values, best, [steps[k]])
        spent += 1
    return rises, spent


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
