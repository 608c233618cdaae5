"""How far each sensor moves with each parameter: what the log says of it, and where."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from sysid_btr._typing import FloatArray
from sysid_btr.identify.intervals import Estimate
from sysid_btr.objectives.problem import ReplayProblem


def with_sensitivity(found: Sequence[Estimate], problem: ReplayProblem, jacobian: FloatArray) -> tuple[Estimate, ...]:
    """Estimates that say how far they move each sensor.

    Parameters
    ----------
    problem : what was fitted.
    jacobian : (r, p) of its whitened residuals; where initial states are uncertain, without what these make up for.
    """
    sensors = [f"{target.channel}.{target.joints[k]}" for _, target, k in problem.columns]
    names = tuple(dict.fromkeys(sensors))
    of = np.array([names.index(sensor) for sensor in sensors])
    # in noise floors, however the column was weighed
    square = jacobian**2 * problem.inflation[problem.column_labels][:, None]
    count = np.bincount(of, problem.counts, len(names))
    result = []
    for i, (estimate, scale) in enumerate(zip(found, problem.scale, strict=True)):
        total = np.bincount(of[problem.column_labels], square[:, i], len(names))
        moves = scale * np.sqrt(total / np.maximum(count, 1))
        result.append(replace(estimate, change=float(scale), moves=dict(zip(names, map(float, moves), strict=True))))
    return tuple(result)


def sensitivity_table(found: Sequence[Estimate]) -> Iterator[dict[str, Any]]:
    """The same as results have it, one entry a parameter."""
    yield from ({"name": e.name, "unit": e.unit, "change": e.change, "moves": dict(e.moves)} for e in found if e.moves)
