"""Where a replay starts: positions and velocities of the joints at the first sample."""

from __future__ import annotations

import copy
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from sysid_btr._typing import BoolArray, FloatArray
from sysid_btr.terms.base import Outputs

if TYPE_CHECKING:
    import mujoco

    from sysid_btr.io.log import Log
    from sysid_btr.simulation.setup import Values
    from sysid_btr.terms.base import BatchModel, JointAddresses

FIT_SAMPLES = 7
"""Samples of the polynomial whose value and slope are the start."""

ROUNDS, CLOSED = 30, 1e-10
"""Iterations that close loops of joints, and the error in m or rad at which they are closed."""


COURSE = np.array([-1.0, -0.001, 0.0, 0.001])
"""s about a start, at which it is asked what sensors show: those with a delay look back."""
NUDGE, TIMES, FLATTEST = 1e-4, 4, 0.3
"""rad, by which the slope of a sensor is found; steps of Newton's method; slope below which none is believed."""


@dataclass(frozen=True, eq=False)
class Start:
    """A state of the joints of a log, (j,) each, as its sensors show it."""

    position: FloatArray
    velocity: FloatArray


def initial_state(log: Log, joints: tuple[str, ...], defaults: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Filtered positions and velocities at the first sample, (j,) each.

    A line through the first samples averages the encoder's noise, a parabola where their curvature stands
    out of it; a joint without a position channel starts at the model's default.
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
        qpos[i], qvel[i] = _value_and_slope(time, values[good])
        if log.has("velocity", joint) and np.isfinite(log.channels[f"velocity.{joint}"][0]):
            qvel[i] = log.channels[f"velocity.{joint}"][0]
    return qpos, qvel


def behind_sensors(
    batch: BatchModel,
    pairs: Values,
    shown: BoolArray,
    qpos: FloatArray,
    qvel: FloatArray,
    acceleration: FloatArray | None = None,
    began: FloatArray | float = 0.0,
) -> tuple[FloatArray, FloatArray]:
    """States which the sensors, with the errors that terms give them, show as these: `Term.read_out` undone.

    Parameters
    ----------
    batch, pairs : the candidates, and the terms they differ in.
    shown : (j,) or (m, j) joints of which that is so; others start where the log says.
    qpos, qvel : (m, j) as the sensors show them.
    acceleration : (m, j), by which the motion about the start bends.
    began : s on the clock of the log at the start, (m,) or of all.

    Returns
    -------
    tuple
        Positions and velocities (m, j), arrays of their own.
    """
    position, velocity = qpos.copy(), qvel.copy()
    readers = [(term, values) for term, values in pairs if type(term).overrides("read_out")]
    if not readers:
        return position, velocity
    bend = np.zeros_like(qpos) if acceleration is None else acceleration
    time = COURSE[:, None]

    def seen(position: FloatArray) -> tuple[FloatArray, FloatArray]:
        course = position[:, None] + time * velocity[:, None] + 0.5 * time**2 * bend[:, None]
        outputs = Outputs(COURSE, course, velocity[:, None] + time * bend[:, None], None, began=began)
        for term, values in readers:
            term.read_out(batch, values, outputs)
        _, before, now, after = np.moveaxis(outputs.position, 1, 0)
        return now, (after - before) / (COURSE[3] - COURSE[1])

    for _ in range(TIMES):
        now, rate = seen(position)
        slope = np.maximum((seen(position + NUDGE)[0] - now) / NUDGE, FLATTEST)
        position -= np.where(shown, (now - qpos) / slope, 0.0)
        velocity -= np.where(shown, (rate - qvel) / slope, 0.0)
    return position, velocity


def start_error(log: Log, joint: str, noise: float) -> tuple[float, float]:
    """How far off a joint's initial state may be, by the noise of its position and by how much its motion bends.

    Standard deviations of position and velocity; nothing is known of fewer than three samples.
    """
    values = log.channels[f"position.{joint}"][: 4 * FIT_SAMPLES]
    good = np.flatnonzero(np.isfinite(values))[:FIT_SAMPLES]
    if len(good) < 3:
        return np.inf, np.inf
    time = log.time[good] - log.time[0]
    design = np.vander(time, 3, increasing=True)
    inverse = np.linalg.pinv(design)
    position, velocity, _ = noise * np.linalg.norm(inverse, axis=1)
    bend, span = float(inverse[2] @ values[good]), float(time[-1])
    return float(np.hypot(position, bend * span**2)), float(np.hypot(velocity, 2 * bend * span))


def coupled_state(
    model: mujoco.MjModel, index: JointAddresses, qpos: FloatArray, qvel: FloatArray, moved: BoolArray
) -> tuple[FloatArray, FloatArray]:
    """Positions and velocities (j,) of the joints with those that are `moved` as the model's equalities want them.

    Gauss-Newton on MuJoCo's own equality constraints, which hold couplings of joints and tendons and closed loops; of
    joints that no equality reaches nothing changes.
    """
    import mujoco

    if not model.neq or not moved.any():
        return qpos, qvel
    own = copy.copy(model)
    own.opt.jacobian = mujoco.mjtJacobian.mjJAC_DENSE
    data, own_dof = mujoco.MjData(own), index.dof[moved]
    data.qpos[index.qpos], data.qvel[index.dof] = qpos, qvel
    for _ in range(ROUNDS):
        mujoco.mj_fwdPosition(own, data)
        rows = data.efc_type == int(mujoco.mjtConstraint.mjCNSTR_EQUALITY)
        jacobian, violation = data.efc_J.reshape(-1, own.nv)[rows], data.efc_pos[rows]
        if not np.any(np.abs(violation) > CLOSED):
            break
        data.qpos[index.qpos[moved]] += np.linalg.lstsq(jacobian[:, own_dof], -violation, rcond=None)[0]
    data.qvel[own_dof] = 0.0
    speed = np.linalg.lstsq(jacobian[:, own_dof], -jacobian @ data.qvel, rcond=None)[0]
    reached = np.any(jacobian[:, own_dof] != 0, axis=0)
    data.qvel[own_dof] = np.where(reached, speed, qvel[moved])
    return data.qpos[index.qpos].copy(), data.qvel[index.dof].copy()


def _value_and_slope(time: FloatArray, values: FloatArray) -> tuple[float, float]:
    """At time zero, by the lowest polynomial that the noise leaves room for (F test, 1 %)."""
    from numpy.polynomial.polynomial import polyfit, polyval
    from scipy.special import fdtri

    line, bent = (polyfit(time, values, degree) for degree in (1, 2))
    free = len(values) - 3
    if free > 0:
        rest = [float(np.sum((polyval(time, c) - values) ** 2)) for c in (line, bent)]
        if rest[0] - rest[1] > fdtri(1, free, 0.99) * rest[1] / free:
            return float(bent[0]), float(bent[1])
    return float(line[0]), float(line[1])
