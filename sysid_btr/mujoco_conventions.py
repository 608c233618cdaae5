"""What MuJoCo counts and orders in its own way: kinds of joints by number, quaternions scalar first."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from sysid_btr._typing import FloatArray, IntArray

if TYPE_CHECKING:
    import mujoco
    from scipy.spatial.transform import Rotation

FREE, SLIDE, HINGE = 0, 2, 3
"""`mjtJoint`, without importing MuJoCo."""
SINGLE = (SLIDE, HINGE)
"""Joints of one coordinate."""


def slides(model: mujoco.MjModel, joint: str) -> bool:
    """Whether a joint is a slide, whose quantities are in m and N."""
    return int(model.jnt_type[model.joint(joint).id]) == SLIDE


def free_joints(model: mujoco.MjModel) -> IntArray:
    """Ids of joints that let a body float."""
    return np.flatnonzero(model.jnt_type == FREE)


def to_rotation(quaternion: FloatArray) -> Rotation:
    """Rotations of quaternions (..., 4), scalar first."""
    from scipy.spatial.transform import Rotation

    return Rotation.from_quat(quaternion[..., [1, 2, 3, 0]])


def to_quaternion(rotation: Rotation) -> FloatArray:
    """Quaternions (..., 4), scalar first, of rotations."""
    return np.asarray(rotation.as_quat()[..., [3, 0, 1, 2]])
