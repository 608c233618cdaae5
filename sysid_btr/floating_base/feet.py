"""What of a robot can stand on the ground, where it is for given joint angles, and which force sensors are on it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from sysid_btr._typing import BoolArray, FloatArray, IntArray
from sysid_btr.identify.smoothing import Tracks
from sysid_btr.mujoco_conventions import free_joints

if TYPE_CHECKING:
    import mujoco

RING = 12
"""Points that stand for the rim of a cylinder."""


@dataclass(frozen=True, eq=False)
class Foot:
    """A body that can touch the ground.

    Attributes
    ----------
    name : of the body.
    points : (k, 3) the outermost points of what touches, in the body's frame, m.
    radius : (k,) by which the surface lies beyond each point (spheres, capsules), m.
    """

    name: str
    points: FloatArray
    radius: FloatArray


@dataclass(frozen=True, eq=False)
class FeetMotion:
    """Where the points of the feet are, and how they move, in the frame of the base.

    Attributes
    ----------
    feet : whose points they are.
    points, moving : (n, k, 3) of each foot, m, and m/s.
    between : (j,) whether a joint lies between the base and a foot.
    """

    feet: tuple[Foot, ...]
    points: list[FloatArray]
    moving: list[FloatArray]
    between: BoolArray


def touching_bodies(model: mujoco.MjModel) -> tuple[Foot, ...]:
    """Bodies whose geoms can collide with what is fixed to the world, in model order."""
    ground = [g for g in range(model.ngeom) if model.body_weldid[model.geom_bodyid[g]] == 0]
    result: dict[int, list[tuple[FloatArray, FloatArray]]] = {}
    for g in range(model.ngeom):
        body = int(model.geom_bodyid[g])
        if model.body_weldid[body] == 0 or not any(_collide(model, g, other) for other in ground):
            continue
        result.setdefault(body, []).append(_outline(model, g))
    return tuple(
        Foot(model.body(b).name, np.vstack([p for p, _ in parts]), np.concatenate([r for _, r in parts]))
        for b, parts in sorted(result.items())
    )


def _collide(model: mujoco.MjModel, a: int, b: int) -> bool:
    return bool(
        (model.geom_contype[a] & model.geom_conaffinity[b]) | (model.geom_contype[b] & model.geom_conaffinity[a])
    )


def _outline(model: mujoco.MjModel, g: int) -> tuple[FloatArray, FloatArray]:
    """Outermost points of a geom in its body's frame, and how far the surface lies beyond them."""
    import mujoco

    kind, size = int(model.geom_type[g]), model.geom_size[g]
    signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], dtype=np.float64)
    angle = np.arange(RING) * 2 * np.pi / RING
    radius = 0.0
    if kind == mujoco.mjtGeom.mjGEOM_SPHERE:
        local, radius = np.zeros((1, 3)), float(size[0])
    elif kind == mujoco.mjtGeom.mjGEOM_CAPSULE:
        local, radius = np.array([[0.0, 0.0, -size[1]], [0.0, 0.0, size[1]]]), float(size[0])
    elif kind == mujoco.mjtGeom.mjGEOM_CYLINDER:
        rim = np.stack([size[0] * np.cos(angle), size[0] * np.sin(angle), np.full(RING, size[1])], axis=1)
        local = np.vstack([rim, rim * [1, 1, -1]])
    elif kind == mujoco.mjtGeom.mjGEOM_MESH:
        mesh = int(model.geom_dataid[g])
        first = int(model.mesh_vertadr[mesh])
        local = np.asarray(model.mesh_vert[first : first + int(model.mesh_vertnum[mesh])], dtype=np.float64)
        extreme = {int(np.argmax(local @ d)) for d in _directions()}
        local = local[sorted(extreme)]
    else:  # boxes, and ellipsoids by their box
        local = signs * size
    rotation = np.empty(9)
    mujoco.mju_quat2Mat(rotation, model.geom_quat[g])
    points = local @ rotation.reshape(3, 3).T + model.geom_pos[g]
    return points, np.full(len(points), radius)


def _directions() -> FloatArray:
    grid = np.array([[x, y, z] for x in (-2, -1, 0, 1, 2) for y in (-2, -1, 0, 1, 2) for z in (-2, -1, 0, 1, 2)])
    return np.asarray(grid[np.any(grid != 0, axis=1)], dtype=np.float64)


def points_in_base(
    model: mujoco.MjModel, feet: Sequence[Foot], addresses: IntArray, positions: FloatArray
) -> list[FloatArray]:
    """Points of the feet in the frame of the base, (n, k, 3) for each foot.

    Parameters
    ----------
    model : with a free base as its first joint.
    addresses : (j,) in qpos.
    positions : (n, j) of these joints.
    """
    import mujoco

    data = mujoco.MjData(model)
    base = base_body(model)
    ids = [model.body(f.name).id for f in feet]
    result = [np.empty((len(positions), len(f.points), 3)) for f in feet]
    data.qpos[:] = model.qpos0
    for k, row in enumerate(positions):
        data.qpos[addresses] = row
        mujoco.mj_kinematics(model, data)
        origin, frame = data.xpos[base], data.xmat[base].reshape(3, 3)
        for points, foot, body in zip(result, feet, ids, strict=True):
            world = foot.points @ data.xmat[body].reshape(3, 3).T + data.xpos[body]
            points[k] = (world - origin) @ frame
    return result


def feet_motion(
    model: mujoco.MjModel, feet: Sequence[Foot], addresses: IntArray, joints: Tracks, moment: float
) -> FeetMotion:
    """The motion of the feet that the joints make.

    Parameters
    ----------
    model : with a free base as its first joint.
    addresses, joints : addresses in qpos, (j,), and motion of the joints.
    moment : s, over which velocities are differences.
    """
    here = points_in_base(model, feet, addresses, joints.position)
    ahead = points_in_base(model, feet, addresses, joints.position + moment * joints.velocity)
    moving = [(later - points) / moment for points, later in zip(here, ahead, strict=True)]
    bodies = {body for foot in feet for body in up_to_base(model, model.body(foot.name).id)}
    bearing = [model.jnt_qposadr[j] for j in range(model.njnt) if model.jnt_bodyid[j] in bodies]
    return FeetMotion(tuple(feet), here, moving, np.isin(addresses, bearing))


def base_body(model: mujoco.MjModel) -> int:
    """Id of the body that the free joint moves, or -1."""
    free = free_joints(model)
    return int(model.jnt_bodyid[free[0]]) if len(free) else -1


def force_columns(model: mujoco.MjModel, feet: Sequence[Foot], sites: Sequence[str]) -> list[list[str]]:
    """Force sensors on each foot: by the model's site of that name, else by the longest common name start."""
    result: list[list[str]] = [[] for _ in feet]
    of_site = {model.site(i).name: int(model.site_bodyid[i]) for i in range(model.nsite)}
    ids = [model.body(f.name).id for f in feet]
    for site in sites:
        if site in of_site:
            if of_site[site] in ids:
                result[ids.index(of_site[site])].append(site)
            continue
        common = [_same_start(site.lower(), f.name.lower()) for f in feet]
        best = int(np.argmax(common)) if common else 0
        if common and common[best] > 0 and common.count(common[best]) == 1:
            result[best].append(site)
    return result


def _same_start(a: str, b: str) -> int:
    """Number of leading characters that two names share."""
    return next((k for k, (x, y) in enumerate(zip(a, b, strict=False)) if x != y), min(len(a), len(b)))


def up_to_base(model: mujoco.MjModel, body: int) -> list[int]:
    """A body and those between it and the base, outermost first."""
    base, chain = base_body(model), [body]
    while int(model.body_parentid[chain[-1]]) not in (base, 0):
        chain.append(int(model.body_parentid[chain[-1]]))
    return chain
