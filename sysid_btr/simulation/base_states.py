"""States of a free base, and where simulations begin with them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING

import numpy as np

from sysid_btr._typing import FloatArray, IntArray
from sysid_btr.mujoco_conventions import free_joints, to_quaternion, to_rotation
from sysid_btr.simulation.setup import Setup

if TYPE_CHECKING:
    import mujoco

BASE = 12
"""Numbers of a free base in a state: position, rotation, velocity, angular velocity, three each."""


@dataclass(frozen=True, eq=False)
class BaseStates:
    """States of a free base.

    Attributes
    ----------
    position, velocity : (w, 3) in the world, m and m/s.
    quaternion : (w, 4), scalar first.
    rate : (w, 3) angular velocity in the base's frame, rad/s.
    """

    position: FloatArray
    quaternion: FloatArray
    velocity: FloatArray
    rate: FloatArray

    @classmethod
    def joined(cls, parts: Sequence[BaseStates]) -> BaseStates:
        """All states of some, in their order."""
        return cls(*(np.concatenate([getattr(part, f.name) for part in parts]) for f in fields(cls)))

    def chosen(self, which: IntArray) -> BaseStates:
        """Some of the states."""
        return BaseStates(self.position[which], self.quaternion[which], self.velocity[which], self.rate[which])

    def moved(self, change: FloatArray) -> BaseStates:
        """Changed by small amounts, (w, 12), in position, rotation in the base's frame, velocity and rate."""
        from scipy.spatial.transform import Rotation

        turned = to_rotation(self.quaternion) * Rotation.from_rotvec(change[:, 3:6])
        return BaseStates(
            self.position + change[:, :3],
            to_quaternion(turned),
            self.velocity + change[:, 6:9],
            self.rate + change[:, 9:12],
        )


def on_slope(base: BaseStates, level: FloatArray, tilted: FloatArray) -> BaseStates:
    """A base on a floor to which gravity is not normal.

    The inertial unit knows the base's attitude to gravity, so where gravity is tilted in the floor's frame the base
    is tilted with it, about the ground below it.

    Parameters
    ----------
    base : on a level floor.
    level : (3,) gravity normal to the floor.
    tilted : (w, 3) gravity of each start.
    """
    from scipy.spatial.transform import Rotation

    a = level / np.linalg.norm(level)
    b = tilted / np.linalg.norm(tilted, axis=1, keepdims=True)
    axis, cosine = np.cross(a, b), np.clip(b @ a, -1.0, 1.0)
    sine = np.linalg.norm(axis, axis=1)
    turn = Rotation.from_rotvec(axis * (np.arctan2(sine, cosine) / np.where(sine > 0, sine, 1.0))[:, None])
    below = base.position * [1.0, 1.0, 0.0]
    turned = turn * to_rotation(base.quaternion)
    return replace(
        base,
        position=below + turn.apply(base.position - below),
        quaternion=to_quaternion(turned),
        velocity=turn.apply(base.velocity),
    )


def place_base(setup: Setup, base: BaseStates) -> None:
    """Have candidates begin with a base in these states, m or one for all, each on its own slope."""
    place, motion = free_addresses(setup.model)
    if "opt.gravity" in setup.batch.fields:
        base = on_slope(base, np.array(setup.model.opt.gravity), setup.batch.read("opt.gravity"))
    qpos, qvel = setup.state["qpos"], setup.state["qvel"]
    qpos[:, place : place + 3], qpos[:, place + 3 : place + 7] = base.position, base.quaternion
    qvel[:, motion : motion + 3], qvel[:, motion + 3 : motion + 6] = base.velocity, base.rate


def free_addresses(model: mujoco.MjModel) -> tuple[int, int]:
    """Addresses of the free joint in qpos and in qvel."""
    joint = int(free_joints(model)[0])
    return int(model.jnt_qposadr[joint]), int(model.jnt_dofadr[joint])
