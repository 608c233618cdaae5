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


def place_names(model: mujoco.MjModel) -> tuple[str, ...]:
    """Names of bodies, but for the world, and of sites."""
    bodies = (model.body(i).name for i in range(1, model.nbody))
    return tuple(name for name in (*bodies, *(model.site(i).name for i in range(model.nsite))) if name)


def find_place(model: mujoco.MjModel, name: str) -> tuple[str, int]:
    """Field of mjData with the places of its kind, and its row, of a site or else a body."""
    import mujoco

    site = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_SITE, name)
    return ("site_xpos", site) if site >= 0 else ("xpos", model.body(name).id)


def to_rotation(quaternion: FloatArray) -> Rotation:
    """Rotations of quaternions (..., 4), scalar first."""
    from scipy.spatial.transform import Rotation

    return Rotation.from_quat(quaternion[..., [1, 2, 3, 0]])


def to_quaternion(rotation: Rotation) -> FloatArray:
    """Quaternions (..., 4), scalar first, of rotations."""
    return np.asarray(rotation.as_quat()[..., [3, 0, 1, 2]])
