"""The baseline of the paper's reference [5]: the model stays, and its fitness is corrected linearly."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np

from sysid_btr._typing import FloatArray

if TYPE_CHECKING:
    from sysid_btr.btr.problems import Stage
    from sysid_btr.btr.trials import Tried

RIDGE = 1.0
"""Weight of a unit slope over a parameter's whole range, in trials."""


def linear_correction(
    stage: Stage, model: FloatArray, tried: Sequence[Tried]
) -> Callable[[FloatArray], FloatArray] | None:
    """Discrepancy of real and simulated fitness as a linear function of the controller, by ridge regression.

    None while there is no trial to learn from.
    """
    usable = [t for t in tried if t.trial.outcome != "crashed"]
    if not usable:
        return None
    lower, span = stage.space.lower, stage.space.upper - stage.space.lower
    controllers = np.array([t.controller.values for t in usable])
    discrepancy = np.array([t.trial.fitness for t in usable]) - stage.fitness(controllers, model[None])[0]
    good = np.isfinite(discrepancy)
    unit = (controllers[good] - lower) / span
    centre, offset = unit.mean(axis=0), float(discrepancy[good].mean())
    design = unit - centre
    # fewer trials than parameters: in the space of trials
    weight = np.linalg.solve(design @ design.T + RIDGE * np.eye(len(design)), discrepancy[good] - offset)
    slope = design.T @ weight

    def correct(candidates: FloatArray) -> FloatArray:
        return np.asarray(offset + ((candidates - lower) / span - centre) @ slope)

    return correct
