"""The shape of a robot in few triangles, and where its bodies are in each pose."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from itertools import product
from typing import TYPE_CHECKING

import numpy as np

from sysid_btr._typing import FloatArray, IntArray

if TYPE_CHECKING:
    import mujoco

ROUND, RING, DETAIL = 40, 14, 80
"""Points of a ball, points of a cylinder's rim, and directions in which a mesh keeps its outermost point, at most."""
MOST_FACES, FEWEST_POINTS = 3000, 14
"""Of all bodies together, which a browser draws 20 times a second, and of one geometry, however many there are."""
SHOWN_GROUPS = 3
"""Groups of geometry that MuJoCo's viewer shows: those below this one."""


@dataclass(frozen=True, eq=False)
class Body:
    """One body.

    Attributes
    ----------
    number : in the model.
    name : of it.
    vertices : (v, 3) in its frame, m.
    faces : (f, 3) of vertices, counterclockwise as seen from outside.
    """

    number: int
    name: str
    vertices: FloatArray
    faces: IntArray


def bodies_of(model: mujoco.MjModel) -> tuple[Body, ...]:
    """Moving bodies that have a shape, as convex hulls of their geometry."""
    moving = np.flatnonzero((model.geom_bodyid > 0) & (model.geom_rgba[:, 3] > 0))
    shown = moving[model.geom_group[moving] < SHOWN_GROUPS]
    chosen = shown if len(shown) else moving
    # a hull of n points has 2 n - 4 triangles
    points = int(max(MOST_FACES / (2 * max(len(chosen), 1)), FEWEST_POINTS))
    found = []
    for number in np.unique(model.geom_bodyid[chosen]):
        hulls = [
            h for g in chosen[model.geom_bodyid[chosen] == number] if (h := _hull(model, int(g), points)) is not None
        ]
        if hulls:
            starts = np.cumsum([0, *(len(vertices) for vertices, _ in hulls)])
            vertices = np.concatenate([vertices for vertices, _ in hulls])
            faces = np.concatenate([faces + start for (_, faces), start in zip(hulls, starts, strict=False)])
            found.append(Body(int(number), model.body(int(number)).name, vertices, faces))
    return tuple(found)


def placed(model: mujoco.MjModel, bodies: tuple[Body, ...], poses: FloatArray) -> FloatArray:
    """Positions (m) and quaternions (n, bodies, 7) of bodies in poses (n, nq)."""
    import mujoco

    data, numbers = mujoco.MjData(model), [body.number for body in bodies]
    result = np.empty((len(poses), len(numbers), 7))
    for row, pose in zip(result, poses, strict=True):
        data.qpos[:] = pose
        mujoco.mj_kinematics(model, data)
        row[:, :3], row[:, 3:] = data.xpos[numbers], data.xquat[numbers]
    return result


def filled(column: FloatArray | None, instead: FloatArray) -> FloatArray:
    """A column without gaps; another one where it has nothing at all."""
    if column is None or not np.isfinite(column).any():
        return instead
    good = np.flatnonzero(np.isfinite(column))
    return np.interp(np.arange(len(column)), good, column[good])


def _hull(model: mujoco.MjModel, geom: int, most: int) -> tuple[FloatArray, IntArray] | None:
    """At most so many vertices in the body's frame, and faces; None of what has no volume."""
    import mujoco
    from scipy.spatial import ConvexHull, QhullError

    points = _points(model, geom, most)
    if points is None:
        return None
    try:
        hull = ConvexHull(points)
    except QhullError:
        return None
    a, b, c = (points[hull.simplices[:, k]] for k in range(3))
    inward = np.einsum("ij,ij->i", np.cross(b - a, c - a), hull.equations[:, :3]) < 0
    faces = np.where(inward[:, None], hull.simplices[:, ::-1], hull.simplices)
    used, faces = np.unique(faces, return_inverse=True)
    turn = np.empty(9)
    mujoco.mju_quat2Mat(turn, model.geom_quat[geom])
    return points[used] @ turn.reshape(3, 3).T + model.geom_pos[geom], faces.reshape(-1, 3)


def _points(model: mujoco.MjModel, geom: int, most: int) -> FloatArray | None:
    """Points (n, 3) whose hull a geometry nearly is, in its own frame; None of what is not bounded."""
    import mujoco

    kind, size, ball = mujoco.mjtGeom, model.geom_size[geom], _ball(min(ROUND, most - most % 2))
    match model.geom_type[geom]:
        case kind.mjGEOM_SPHERE:
            return np.asarray(ball * size[0])
        case kind.mjGEOM_ELLIPSOID:
            return np.asarray(ball * size)
        case kind.mjGEOM_CAPSULE:
            return np.asarray(ball * size[0] + np.sign(ball[:, 2:]) * (0.0, 0.0, size[1]))
        case kind.mjGEOM_CYLINDER:
            ring = min(RING, most // 2)
            angle = np.arange(ring) * 2 * np.pi / ring
            rim = np.column_stack([np.cos(angle), np.sin(angle), np.ones(ring)])
            return np.asarray(np.concatenate([rim, rim * (1, 1, -1)]) * (size[0], size[0], size[1]))
        case kind.mjGEOM_BOX:
            return np.asarray(size * np.array(list(product((-1, 1), repeat=3))))
        case kind.mjGEOM_MESH:
            mesh = int(model.geom_dataid[geom])
            first = int(model.mesh_vertadr[mesh])
            vertices = model.mesh_vert[first : first + int(model.mesh_vertnum[mesh])].astype(np.float64)
            return np.asarray(vertices[np.unique(np.argmax(vertices @ _ball(min(DETAIL, most)).T, axis=0))])
    return None


@cache
def _ball(count: int) -> FloatArray:
    """Points (count, 3) spread evenly over a ball of radius one, by the golden angle."""
    height = 1 - (2 * np.arange(count) + 1) / count
    angle = np.pi * (3 - np.sqrt(5)) * np.arange(count)
    radius = np.sqrt(1 - height**2)
    return np.column_stack([radius * np.cos(angle), radius * np.sin(angle), height])
