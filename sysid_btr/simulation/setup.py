"""Putting a batch where its rollout begins."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sysid_btr._typing import FloatArray
from sysid_btr.terms.base import BatchModel, Term


def write_model(rig: BatchModel, pairs: Sequence[tuple[Term, FloatArray]]) -> None:
    """Write the model fields of every candidate, and what MuJoCo derives from them."""
    for term, values in pairs:
        rig.write(term.model_fields(rig, values))
    if rig.touched & set(_setconst_inputs()):
        rig.simulations.set_const()


def set_out(
    rig: BatchModel,
    pairs: Sequence[tuple[Term, FloatArray]],
    qpos: FloatArray,
    qvel: FloatArray,
    command: FloatArray,
    steps: int,
) -> tuple[FloatArray, FloatArray | None]:
    """Put the batch where its replay begins: commands as they reach the servos, and torques known in advance.

    `qpos` and `qvel` are (m, joints), `command` is (m, steps, joints); terms may change all of them.
    """
    applied: FloatArray | None = None
    border_time = rig.timestep * np.arange(steps + 1, dtype=np.float64)
    for term, values in pairs:
        term.initial_state(rig, values, qpos, qvel)
        command = term.shape_command(rig, values, command)
        torque = term.applied_torque(rig, values, border_time)
        if torque is not None:
            applied = torque if applied is None else applied + torque
    rig.simulations.bind("qpos")[:, rig.index.qpos] = qpos
    rig.simulations.bind("qvel")[:, rig.index.dof] = qvel
    return command, applied


def _setconst_inputs() -> Sequence[str]:
    import mujoco

    return tuple(mujoco.MjModel._setconst_inputs)
