"""The law of the servos."""

from __future__ import annotations

from typing import Any

import numpy as np

from sysid_btr._typing import FloatArray
from sysid_btr.terms.base import BatchModel


def servo_torque(
    rig: BatchModel, command: FloatArray, qpos: FloatArray, qvel: FloatArray, rows: slice = slice(None)
) -> FloatArray:
    """Joint torque of the servos by their own law, (m, samples, joints), of some rows; zero without a servo.

    Computed here because MuJoCo's `actuator_force` lags the state by a substep.
    """
    index, model = rig.index, rig.model
    torque = np.zeros(np.broadcast_shapes(command.shape, qpos.shape))
    for j, a in enumerate(index.actuator):
        if a < 0:
            continue

        def values(name: str, a: int = int(a)) -> Any:
            expanded = rig.simulations.expanded(name)
            array = getattr(model, name)[None] if expanded is None else expanded[rows]
            return array[:, a]

        gain, bias = values("actuator_gainprm"), values("actuator_biasprm")
        gear = values("actuator_gear")[:, :1]
        force = (
            gain[:, :1] * command[:, :, j]
            + bias[:, :1]
            + bias[:, 1:2] * gear * qpos[:, :, j]
            + bias[:, 2:3] * gear * qvel[:, :, j]
        )
        limited = values("actuator_forcelimited").astype(bool)[:, None]
        limits = values("actuator_forcerange")
        clipped = np.clip(force, limits[:, :1], np.maximum(limits[:, 1:2], limits[:, :1]))
        torque[:, :, j] = gear * np.where(limited, clipped, force)
    return torque
