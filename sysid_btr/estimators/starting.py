"""Where a search begins when it may choose, or must because its start cannot be simulated."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from sysid_btr._typing import FloatArray
from sysid_btr.estimators.evaluator import Evaluator

if TYPE_CHECKING:
    from numpy.random import Generator

_POINTS = 8
_REACHES = (1.0, 0.3, 0.1, 0.03)


def latin_hypercube(rng: Generator, n: int, p: int) -> FloatArray:
    """``n`` points, one in each of ``n`` slices of every axis (doi:10.1080/00401706.1979.10489755)."""
    slices = np.array([rng.permutation(n) for _ in range(p)], dtype=np.float64).T.reshape(n, p)
    points: FloatArray = (slices + rng.random((n, p))) / max(n, 1)
    return points


def finite_start(evaluator: Evaluator, rng: Generator) -> tuple[FloatArray, float] | None:
    """The problem's start, or, if it fails, a point in ever smaller neighbourhoods of it that does not.

    Returns
    -------
    u, loss
        A point of the unit cube, shape ``(p,)``, and its loss; None if no candidate was finite. `rng` is
        drawn from only if the start fails.
    """
    u = evaluator.box.enter(evaluator.start)
    loss = float(evaluator.loss(evaluator.box.leave(u)[None], "start")[0])
    return (u, loss) if np.isfinite(loss) else finite_near(evaluator, u, rng)


def finite_near(evaluator: Evaluator, u: FloatArray, rng: Generator) -> tuple[FloatArray, float] | None:
    """The best finite point of the widest neighbourhood of `u`, in the unit cube, that has one."""
    for reach in _REACHES:
        near = u + reach * (latin_hypercube(rng, _POINTS, len(u)) - u)
        losses = evaluator.loss(evaluator.box.leave(near), "searching for a start that can be simulated")
        i = int(np.argmin(losses))
        if np.isfinite(losses[i]):
            return near[i], float(losses[i])
    return None
