"""Baseline: linear inverse-dynamics regression, on the same filtered signals and the same split as ours.

Every inertial parameter of every link, viscous and dry friction, offset and rotor inertia of every joint, and of
sums of joints that one motor turns, by weighted least squares; base parameters are what the singular values keep
(Gautier 1991, Numerical calculation of the base inertial parameters, doi:10.1002/rob.4620080405).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from sysid_btr._typing import BoolArray, FloatArray

if TYPE_CHECKING:
    import mujoco

    from sysid_btr.identify.inverse import InverseEpisode

KEPT = 1e-7
"""Singular values over the largest, of columns of unit length, that count as base parameters."""


@dataclass(frozen=True)
class Regression:
    """Held-out root-mean-square error of the torques, Nm, and what was fitted.

    Attributes
    ----------
    heldout : over all joints.
    joints : of each.
    base : number of base parameters.
    friction : `viscous`, `coulomb`, `offset` and `rotor` of each joint as far as they are in the columns, by name.
    """

    heldout: float
    joints: dict[str, float]
    base: int
    friction: dict[str, float]


def regress(fitted: InverseEpisode, held: InverseEpisode, sums: Sequence[tuple[str, str]] = ()) -> Regression:
    """Fit what is fitted of a recording, predict what is held out.

    Parameters
    ----------
    fitted, held : parts of one recording.
    sums : pairs of joints whose sum one motor turns.
    """
    motion = fitted.kinematics
    replay = fitted.replay((), fitted.choose_numerics()[0])
    joints, model = replay.index.joints, replay.model
    measured = np.stack([fitted.recording.channels[f"effort.{j}"] for j in joints], axis=1)
    rigid = list(_rigid(model, motion.position, motion.velocity, motion.acceleration, replay.index.dof))
    levers = np.eye(len(joints)).tolist() + [[float(j in pair) for j in joints] for pair in sums]
    own, names = [], []
    for lever, name in zip(np.array(levers), [*joints, *("+".join(pair) for pair in sums)], strict=True):
        kinds = {
            "viscous": motion.velocity @ lever,
            "coulomb": motion.direction_along(lever[None])[:, 0],
            "rotor": motion.acceleration @ lever,
        }
        if name in joints:
            kinds["offset"] = np.ones(len(motion.time))
        for kind, signal in kinds.items():
            own.append(signal[:, None] * lever)
            names.append(f"{kind}:{name}")
    columns = motion.low_passed(np.array([*rigid, *own]))
    train, test = _counted(fitted), _counted(held)
    weight = np.ones(len(joints))
    for _ in range(3):
        values, rank = _solve(columns, measured, train, weight)
        error = measured - np.tensordot(values, columns, 1)
        weight = np.array([1 / np.sqrt(np.mean(error[train[:, k], k] ** 2)) for k in range(len(joints))])
    return Regression(
        heldout=float(np.sqrt(np.mean(error[test] ** 2))),
        joints={j: float(np.sqrt(np.mean(error[test[:, k], k] ** 2))) for k, j in enumerate(joints)},
        base=rank,
        friction=dict(zip(names, map(float, values[len(rigid) :]), strict=True)),
    )


def _counted(episode: InverseEpisode) -> BoolArray:
    """(n, j) samples of the whole recording that the episode compares."""
    counted: BoolArray = np.zeros(episode.kinematics.moving.shape, dtype=bool)
    own = episode.compared
    counted[: len(own)] = own[:, None] & episode.kinematics.moving[: len(own)]
    return counted


def _solve(columns: FloatArray, measured: FloatArray, mask: BoolArray, weight: FloatArray) -> tuple[FloatArray, int]:
    """Values (p,) of least norm, and how many of them the data determine."""
    weighted = (columns * weight)[:, mask].T
    size = np.linalg.norm(weighted, axis=0)
    size[size == 0] = 1.0
    values, _, rank, _ = np.linalg.lstsq(weighted / size, (measured * weight)[mask], rcond=KEPT)
    return values / size, int(rank)


def _rigid(
    model: mujoco.MjModel, position: FloatArray, velocity: FloatArray, acceleration: FloatArray, dof: np.ndarray
) -> Iterator[FloatArray]:
    """Torques (n, j) of ten bodies in the place of each link: together they span what a link can be."""
    import copy

    import mujoco

    bare = copy.copy(model)
    bare.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT) | int(mujoco.mjtDisableBit.mjDSBL_ACTUATION)
    for name in ("dof_damping", "dof_frictionloss", "jnt_stiffness", "body_mass", "body_inertia"):
        getattr(bare, name)[:] = 0.0
    # taken off again: MuJoCo factors the inertia, which must not be singular
    bare.dof_armature[:] = 1.0
    bare.body_ipos[:], bare.body_iquat[:] = 0.0, (1.0, 0.0, 0.0, 0.0)
    data = mujoco.MjData(bare)
    axes = np.eye(3)
    turned = [np.concatenate([[np.cos(np.pi / 8)], np.sin(np.pi / 8) * axis]) for axis in axes]
    # mass, centre of mass, inertia about it, turn of its axes
    bodies: list[tuple[float, FloatArray, FloatArray, FloatArray | None]] = [(1.0, np.zeros(3), np.zeros(3), None)]
    bodies += [(1.0, axis, np.zeros(3), None) for axis in axes]
    bodies += [(0.0, np.zeros(3), axis, None) for axis in axes]
    bodies += [(0.0, np.zeros(3), axes[(k + 1) % 3], turned[k]) for k in range(3)]
    moving = [b for b in range(1, bare.nbody) if bare.body_weldid[b] == b]
    for body in moving:
        for mass, centre, inertia, turn in bodies:
            bare.body_mass[body], bare.body_ipos[body], bare.body_inertia[body] = mass, centre, inertia
            bare.body_iquat[body] = (1.0, 0.0, 0.0, 0.0) if turn is None else turn
            yield _torques(bare, data, position, velocity, acceleration, dof) - acceleration
        bare.body_mass[body], bare.body_ipos[body], bare.body_inertia[body] = 0.0, 0.0, 0.0


def _torques(
    model: mujoco.MjModel, data: mujoco.MjData, q: FloatArray, v: FloatArray, a: FloatArray, dof: np.ndarray
) -> FloatArray:
    import mujoco

    found = np.empty(q.shape)
    for i in range(len(q)):
        data.qpos[:], data.qvel[dof], data.qacc[dof] = model.qpos0, v[i], a[i]
        data.qpos[model.jnt_qposadr[model.dof_jntid[dof]]] = q[i]
        mujoco.mj_inverse(model, data)
        found[i] = data.qfrc_inverse[dof]
    return found
