"""Torques of what joints and tendons have of their own: rotors, dampers, springs, dry friction.

They follow from the motion of a joint, or of a sum of joints, alone, so that candidates which differ in them, as many
do, have the bodies in common.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from sysid_btr._typing import FloatArray, IntArray
from sysid_btr.simulation.kinematics import Kinematics
from sysid_btr.terms.base import BatchModel

if TYPE_CHECKING:
    import mujoco

JOINT = 1
"""Kind of a tendon's part (mjtWrap)."""
DAMPING, STIFFNESS = ("damping", "dampingpoly"), ("stiffness", "stiffnesspoly")
"""Of fields that make a damper and a spring."""


class Sum(NamedTuple):
    """Motion of a sum of joints.

    Attributes
    ----------
    lever : (j,) what each joint adds.
    velocity, direction, acceleration : (n,) as of a joint.
    """

    lever: FloatArray
    velocity: FloatArray
    direction: FloatArray
    acceleration: FloatArray


class Own(NamedTuple):
    """Torques (n, j) that joints and sums of joints take by themselves.

    Attributes
    ----------
    rotors : of inertia.
    others : of dampers and springs, and the dry friction of tendons; that of joints, which laws change, is not in it.
    """

    rotors: FloatArray
    others: FloatArray


def without_own(batch: BatchModel) -> BatchModel:
    """The same candidates, whose joints and sums of joints have nothing of what `own_torques` gives."""
    model, index = batch.model, batch.index
    joints, sums = model.dof_jntid[index.dof], sums_of_joints(model)
    places = {
        **dict.fromkeys(("dof_armature", "dof_damping", "dof_dampingpoly"), index.dof),
        **dict.fromkeys(("jnt_stiffness", "jnt_stiffnesspoly"), joints),
        "qpos_spring": index.qpos,
        **dict.fromkeys(("tendon_armature", "tendon_damping", "tendon_dampingpoly"), sums),
    }
    bare = replace(batch, fields=dict(batch.fields))
    for name, at in places.items():
        values = batch.read(name)
        values[:, at] = 0.0
        bare.write({name: values})
    return bare


def own_torques(batch: BatchModel, motion: Kinematics) -> Iterator[Own]:
    """What joints and sums of joints take in each candidate."""
    from mujoco import mjtDisableBit

    model, index = batch.model, batch.index
    tendons = sums_of_joints(model)
    sums = [_along(motion, fixed_tendon(model, int(t))[index.dof]) for t in tendons]
    of_tendons = [batch.read(f"tendon_{name}")[:, tendons] for name in ("armature", *DAMPING, "frictionloss")]
    armature, *damping = (batch.read(f"dof_{name}")[:, index.dof] for name in ("armature", *DAMPING))
    stiffness = [batch.read(f"jnt_{name}")[:, model.dof_jntid[index.dof]] for name in STIFFNESS]
    rest = batch.read("qpos_spring")[:, index.qpos]
    off = model.opt.disableflags
    if off & int(mjtDisableBit.mjDSBL_DAMPER):
        damping, of_tendons[1:3] = ([np.zeros_like(x) for x in values] for values in (damping, of_tendons[1:3]))
    if off & int(mjtDisableBit.mjDSBL_SPRING):
        stiffness = [np.zeros_like(x) for x in stiffness]
    for i in range(batch.size):
        rotors = armature[i] * motion.acceleration
        others = damper(motion.velocity, *(x[i] for x in damping))
        if any(x[i].any() for x in stiffness):
            others += spring(motion.position - rest[i], *(x[i] for x in stiffness))
        for along, inertia, linear, poly, dry in zip(sums, *(x[i] for x in of_tendons), strict=True):
            rotors += np.multiply.outer(inertia * along.acceleration, along.lever)
            force = damper(along.velocity, linear, poly) + dry * along.direction
            others += np.multiply.outer(force, along.lever)
        yield Own(rotors, others)


def damper(velocity: FloatArray, linear: FloatArray, poly: FloatArray) -> FloatArray:
    """MuJoCo's torque (..., k) against velocities: linear (k,), and by their speed and its square, poly (k, 2)."""
    if not poly.any():
        return linear * velocity
    speed = np.abs(velocity)
    return velocity * (linear + speed * (poly[..., 0] + speed * poly[..., 1]))


def spring(stretch: FloatArray, linear: FloatArray, poly: FloatArray) -> FloatArray:
    """MuJoCo's torque (..., k) against deflections: linear (k,), and by them and their squares, poly (k, 2)."""
    return stretch * (linear + stretch * (poly[..., 0] + stretch * poly[..., 1]))


def sums_of_joints(model: mujoco.MjModel) -> IntArray:
    """Tendons whose length is a sum of joints."""
    return np.flatnonzero(model.wrap_type[model.tendon_adr] == JOINT)


def fixed_tendon(model: mujoco.MjModel, tendon: int) -> FloatArray:
    """(nv,) length of a tendon per motion of each joint; zero where it is no sum of joints."""
    first = int(model.tendon_adr[tendon])
    rows = slice(first, first + int(model.tendon_num[tendon]))
    lever = np.zeros(model.nv)
    joint = model.wrap_type[rows] == JOINT
    lever[model.jnt_dofadr[model.wrap_objid[rows][joint]]] = model.wrap_prm[rows][joint]
    return lever


def _along(motion: Kinematics, lever: FloatArray) -> Sum:
    direction = motion.direction_along(lever[None])[:, 0]
    return Sum(lever, motion.velocity @ lever, direction, motion.acceleration @ lever)
