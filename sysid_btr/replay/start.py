"""Where a replay starts: positions and velocities of the joints at the first sample."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from sysid_btr._typing import FloatArray

if TYPE_CHECKING:
    from sysid_btr.io.log import Log

FIT_SAMPLES = 7
"""Samples of the straight line whose value and slope are the start."""


def initial_state(log: Log, joints: tuple[str, ...], defaults: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Filtered positions and velocities at the first sample, (j,) each.

    A line through the first samples averages the encoder's noise; a joint without a position channel
    starts at the model's default.
    """
    qpos, qvel = defaults.copy(), np.zeros(len(joints))
    for i, joint in enumerate(joints):
        if not log.has("position", joint):
            continue
        values = log.channels[f"position.{joint}"][: 4 * FIT_SAMPLES]
        good = np.flatnonzero(np.isfinite(values))[:FIT_SAMPLES]
        if len(good) == 0:
            continue
        time = log.time[good] - log.time[0]
        if len(good) < 3:
            qpos[i] = values[good[0]]
            continue
        slope, intercept = np.polyfit(time, values[good], 1)
        qpos[i], qvel[i] = intercept, slope
        if log.has("velocity", joint) and np.isfinite(log.channels[f"velocity.{joint}"][0]):
            qvel[i] = log.channels[f"velocity.{joint}"][0]
    return qpos, qvel
