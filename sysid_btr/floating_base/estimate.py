"""State of a floating base from a log: orientation from the IMU, height and velocity from the feet that stand.

The base's velocity follows the accelerometer and is tied to the ground by feet that carry load: the point
of such a foot that touches does not move, and lies at the floor's height (Bloesch et al. 2012,
doi:10.15607/RSS.2012.VIII.003, as a fixed-interval smoother with the orientation found beforehand).
Lengths, speeds and accelerations below are the Nao's; `BodySize` makes them those of the robot.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from sysid_btr._typing import BoolArray, FloatArray, IntArray
from sysid_btr.errors import ModelError
from sysid_btr.floating_base.attitude import HEIGHT_STD, NEAR, Attitude, imu_columns, of_feet, of_inertial_unit
from sysid_btr.floating_base.events import Event, find_fall, find_pickups, find_slips, usable
from sysid_btr.floating_base.feet import (
    FeetMotion,
    Foot,
    base_body,
    feet_motion,
    force_columns,
    points_in_base,
    touching_bodies,
)
from sysid_btr.floating_base.orientation import smooth_orientation, tilt_of
from sysid_btr.floating_base.size import BodySize, measure_size
from sysid_btr.identify.smoothing import Tracks, smooth, smooth_joints
from sysid_btr.io.noise import noise_floor
from sysid_btr.mujoco_conventions import to_quaternion

if TYPE_CHECKING:
    import mujoco

    from sysid_btr.io.log import Log

LOADED = 0.08
"""Fraction of the weight on a foot above which it stands."""
LOWEST = 0.015
"""m above the lowest foot up to which a loaded foot can stand."""
EDGE = 0.002
"""m over which the points of a foot share its contact."""
SLIDE_STD = 0.005
"""m/s, of the point of a standing foot that touches, beyond what encoders and gyro explain."""
OUTLIER = 2.5
"""Standard errors beyond which a foot's velocity is given less weight (Huber)."""
ROUNDS = 3
SUNK = 0.0005
"""m, by which a loaded sole may lie lower than the floor: the same all the time, so no average removes it."""
UNSTEADY = 1.6
"""Factor on the standard deviations of velocities: motions jerk at impacts and rest between them, where the smoother
takes them for alike. Calibrated on simulated walks."""
UNKNOWN = 5.0
"""m/s2, of the base's acceleration where nothing measures it."""


@dataclass(frozen=True, eq=False)
class BaseState:
    """Motion of the base and the joints, sample by sample, with standard deviations.

    Attributes
    ----------
    time : (n,) s.
    rotation : (n, 3, 3) base to world; yaw starts at zero.
    position, velocity : (n, 3) of the base's origin in the world, m and m/s; x and y start at zero.
    rate : (n, 3) angular velocity in the base's frame, rad/s.
    attitude : what the log says of it and of the vertical.
    joints : (j,) names.
    joint_position, joint_velocity : (n, j).
    rotation_std : (n, 3) about the world's axes, rad; the other `_std` are in the unit of what they belong to.
    feet : (f,) bodies that touch the ground.
    contact : (n, f) whether a foot stands.
    events : falls, pick-ups, slips.
    usable : (n,) samples outside of events.
    lost : what could not be found out for want of a sensor, in words.
    size : of the robot.
    """

    time: FloatArray
    rotation: FloatArray
    position: FloatArray
    velocity: FloatArray
    rate: FloatArray
    attitude: Attitude
    joints: tuple[str, ...]
    joint_position: FloatArray
    joint_velocity: FloatArray
    rotation_std: FloatArray
    position_std: FloatArray
    velocity_std: FloatArray
    rate_std: FloatArray
    joint_position_std: FloatArray
    joint_velocity_std: FloatArray
    feet: tuple[str, ...]
    contact: BoolArray
    events: tuple[Event, ...]
    usable: BoolArray
    lost: tuple[str, ...]
    size: BodySize

    @property
    def tilt(self) -> FloatArray:
        """(n,) angle between the base's and the world's vertical, rad."""
        return tilt_of(self.rotation)

    @property
    def quaternion(self) -> FloatArray:
        """(n, 4) orientation as MuJoCo has it, scalar first."""
        from scipy.spatial.transform import Rotation

        return to_quaternion(Rotation.from_matrix(self.rotation))

    @property
    def poses(self) -> FloatArray:
        """(n, 7) position and quaternion."""
        return np.column_stack([self.position, self.quaternion])

    def rows(self, start: int, stop: int) -> BaseState:
        """Samples `start` to `stop` (exclusive)."""
        n = len(self.time)
        cut: dict[str, Any] = {
            name: value[start:stop]
            for name, value in vars(self).items()
            if isinstance(value, np.ndarray) and len(value) == n
        }
        return replace(self, attitude=self.attitude.rows(start, stop), **cut)


def estimate_base(model: mujoco.MjModel, log: Log, joints: Sequence[str], addresses: IntArray) -> BaseState:
    """Reconstruct the state of the base in one episode of a log.

    Parameters
    ----------
    model : with a free base.
    log : joint positions; ``imu.gyro_x..z``, and ``imu.angle_x``, ``imu.angle_y`` or ``imu.acc_x..z``, unless the robot
        only stands; ``force.*`` under the feet if there are any.
    joints, addresses : joints of the model and their addresses in qpos, (j,).

    Raises
    ------
    LogError
        If the log lacks what the orientation of the base needs.
    ModelError
        If the model has no free base, or nothing that could touch the ground.
    """
    lost: list[str] = []
    time = log.time - log.time[0]
    feet, size = _feet(model), measure_size(model)
    tracks = smooth_joints(time, _measured(model, log, joints, addresses), size.time(1.0))
    motion = feet_motion(model, feet, addresses, tracks, size.time(1e-4))
    attitude = _attitude(model, log, motion, addresses, tracks, size, lost)
    rates = attitude.rates
    rotation, rotation_std = smooth_orientation(
        time, attitude.turning, attitude.up, float(np.mean(attitude.turning_std)), attitude.up_std
    )
    soles = _soles(motion, tracks, rates, rotation, size)
    load = foot_loads(model, feet, log, lost)
    contact = find_contacts(soles.bottom, load, size)
    force = _specific_force(model, log, rates, lost)
    position, velocity = _follow(time, rotation, force, contact, soles, size)
    tilt = tilt_of(rotation)
    events = _events(log.time, tilt, load, contact, soles, velocity, size)
    return BaseState(
        time=log.time,
        rotation=rotation,
        position=position[0],
        velocity=velocity[0],
        rate=rates.position,
        attitude=attitude,
        joints=tuple(joints),
        joint_position=tracks.position,
        joint_velocity=tracks.velocity,
        rotation_std=np.hypot(rotation_std, attitude.steady),
        position_std=np.hypot(position[1], [0.0, 0.0, size.length(SUNK)]),
        velocity_std=UNSTEADY * velocity[1],
        rate_std=UNSTEADY * rates.position_std,
        joint_position_std=tracks.position_std,
        joint_velocity_std=UNSTEADY * tracks.velocity_std,
        feet=tuple(f.name for f in feet),
        contact=contact,
        events=events,
        usable=usable(log.time, events, size),
        lost=tuple(lost),
        size=size,
    )


def _attitude(
    model: mujoco.MjModel,
    log: Log,
    feet: FeetMotion,
    addresses: IntArray,
    joints: Tracks,
    size: BodySize,
    lost: list[str],
) -> Attitude:
    """What the log says of the base's attitude: by its inertial unit, or by the feet where there is none."""
    if log.joints("imu"):
        return of_inertial_unit(log, size, lost)
    lost.append(
        "no inertial unit: the robot is taken to stand on level ground, on what of it is lowest; falls and slips are "
        "not found"
    )
    return of_feet(model, log.time, feet, addresses, joints, size)


def _measured(model: mujoco.MjModel, log: Log, joints: Sequence[str], addresses: IntArray) -> FloatArray:
    """(n, j) joint positions; where the log has none, as the model stands."""
    columns = [
        log.channels[f"position.{j}"] if log.has("position", j) else np.full(len(log), model.qpos0[a])
        for j, a in zip(joints, addresses, strict=True)
    ]
    return np.stack(columns, axis=1)


@dataclass(frozen=True, eq=False)
class _Soles:
    """What encoders, gyro and orientation say of the point of each foot that touches if the foot stands.

    Attributes
    ----------
    bottom : (n, f) height above the base's origin, m (negative down).
    moving : (n, f, 3) velocity against the base's origin, m/s in the world's axes.
    std : (n, f) of that velocity, and of the foot over the ground.
    """

    bottom: FloatArray
    moving: FloatArray
    std: FloatArray


def _soles(feet: FeetMotion, tracks: Tracks, rates: Tracks, rotation: FloatArray, size: BodySize) -> _Soles:
    noise = np.mean(tracks.velocity_std, axis=1) * 2 + np.mean(rates.position_std, axis=1)
    bottom, moving, std = [], [], []
    for foot, points, own in zip(feet.feet, feet.points, feet.moving, strict=True):
        world = np.einsum("nij,nkj->nki", rotation, points)
        height = world[..., 2] - foot.radius
        share = np.exp(-(height - height.min(axis=1, keepdims=True)) / size.length(EDGE))
        share /= share.sum(axis=1, keepdims=True)
        relative = own + np.cross(rates.position[:, None], points)
        motion = np.einsum("nij,nkj->nki", rotation, relative)
        bottom.append(np.sum(share * height, axis=1))
        moving.append(np.einsum("nk,nki->ni", share, motion))
        arm = np.linalg.norm(np.einsum("nk,nki->ni", share, world), axis=1)
        std.append(np.hypot(size.speed(SLIDE_STD), arm * noise))
    return _Soles(np.stack(bottom, axis=1), np.stack(moving, axis=1), np.stack(std, axis=1))


def _events(
    time: FloatArray,
    tilt: FloatArray,
    load: FloatArray | None,
    contact: BoolArray,
    soles: _Soles,
    velocity: tuple[FloatArray, FloatArray],
    size: BodySize,
) -> tuple[Event, ...]:
    """Falls, pick-ups and slips in their order, none after a fall."""
    events: list[Event] = []
    fall = find_fall(time, tilt)
    if load is not None:
        events += find_pickups(time, load.sum(axis=1), size)
        speed = np.linalg.norm(velocity[0][:, None] + soles.moving, axis=2)
        std = np.hypot(soles.std, velocity[1].mean(axis=1)[:, None])
        events += find_slips(time, speed, std, contact, size)
    if fall is not None:
        events = [*(e for e in events if e.start < fall.start), fall]
    return tuple(sorted(events, key=lambda e: e.start))


def find_contacts(bottom: FloatArray, load: FloatArray | None, size: BodySize) -> BoolArray:
    """Which feet stand, (n, f).

    Parameters
    ----------
    bottom : (n, f) height of each foot's lowest point below the base, m (negative down).
    load : (n, f) force on each foot, any unit, or None.
    size : of the robot.
    """
    above = bottom - bottom.min(axis=1, keepdims=True)
    if load is None:
        return np.asarray(above < size.length(NEAR))
    weight = float(np.median(load.sum(axis=1)))
    # single samples of a force sensor drop out while the foot stands
    padded = np.pad(load, ((1, 1), (0, 0)), mode="edge")
    held = np.maximum(padded[1:-1], np.minimum(padded[:-2], padded[2:]))
    return np.asarray((held > LOADED * weight) & (above < size.length(LOWEST)))


def foot_surfaces(model: mujoco.MjModel, feet: Sequence[Foot], base: BaseState) -> list[FloatArray]:
    """Undersides of the outermost points of each foot, (n, k, 3), m from the base's origin in the world's axes."""
    addresses = np.array([model.jnt_qposadr[model.joint(j).id] for j in base.joints], dtype=np.int64)
    result = []
    for foot, points in zip(feet, points_in_base(model, feet, addresses, base.joint_position), strict=True):
        surface = np.einsum("nij,nkj->nki", base.rotation, points)
        surface[:, :, 2] -= foot.radius
        result.append(surface)
    return result


def _feet(model: mujoco.MjModel) -> tuple[Foot, ...]:
    if base_body(model) < 0:
        raise ModelError("the log is a floating-base log, and the model has no free joint: give one that has")
    feet = touching_bodies(model)
    if not feet:
        raise ModelError(
            "the log is a floating-base log, and nothing of the model can touch the ground: give the model a "
            "floor, and contacts (contype, conaffinity) between it and the feet"
        )
    return feet


def foot_loads(model: mujoco.MjModel, feet: Sequence[Foot], log: Log, lost: list[str]) -> FloatArray | None:
    """Force on each foot, (n, f); None, and what that means in `lost`, where nothing measures it."""
    columns = force_columns(model, feet, log.joints("force"))
    if not any(columns):
        lost.append(
            "no force sensors under the feet: a foot stands where it is the lowest; pick-ups and slips are not found, "
            "and the uncertainty is larger while both feet are near the ground"
        )
        return None
    return np.stack(
        [np.nan_to_num(log.array("force", c)).sum(axis=1) if c else np.zeros(len(log)) for c in columns], axis=1
    )


def _specific_force(model: mujoco.MjModel, log: Log, rates: Tracks, lost: list[str]) -> tuple[FloatArray, float] | None:
    """Specific force at the base's origin in its frame, (n, 3), and its noise; None without accelerometer."""
    names = ("acc_x", "acc_y", "acc_z")
    if not all(log.has("imu", a) for a in names):
        if log.joints("imu"):
            lost.append("no accelerometer: the velocity between two stances is interpolated")
        return None
    force = imu_columns(log, names)
    noise = float(np.mean([noise_floor(c).sigma for c in force.T]))
    base = base_body(model)
    for s in range(model.nsite):
        if model.site(s).name == "imu" and model.site_bodyid[s] == base:
            # the unit sits beside the origin, and feels the turning of the base there
            arm = model.site_pos[s]
            turning = np.cross(rates.velocity, arm) + np.cross(rates.position, np.cross(rates.position, arm))
            noise = float(np.hypot(noise, np.linalg.norm(arm) * np.median(rates.velocity_std)))
            return force - turning, noise
    return force, noise


def _follow(
    time: FloatArray,
    rotation: FloatArray,
    force: tuple[FloatArray, float] | None,
    contact: BoolArray,
    soles: _Soles,
    size: BodySize,
) -> tuple[tuple[FloatArray, FloatArray], tuple[FloatArray, FloatArray]]:
    """Position and velocity of the base, each with its standard deviation, (n, 3)."""
    n, feet = soles.bottom.shape
    step = np.diff(time)
    if force is None:
        push, doubt = np.zeros((n - 1, 3)), np.full((n - 1, 3), size.acceleration(UNKNOWN))
    else:
        world = np.einsum("nij,nj->ni", rotation, force[0]) - [0.0, 0.0, size.gravity]
        doubt = np.hypot(force[1], 0.5 * np.abs(np.diff(world, axis=0)))
        push = 0.5 * (world[1:] + world[:-1])
    transition = np.tile(np.eye(2), (n - 1, 1, 1))
    transition[:, 0, 1] = step
    drive = np.stack([0.5 * push * step[:, None] ** 2, push * step[:, None]], axis=2)
    reach = np.stack([0.5 * step**2, step], axis=1)
    process = doubt[:, :, None, None] ** 2 * (reach[:, None, :, None] * reach[:, None, None, :])
    process = process + 1e-12 * np.diag([size.length(1.0) ** 2, size.speed(1.0) ** 2])
    # measurements: for each foot the height of the base, and its velocity
    rows = np.array([[1.0, 0.0]] * feet + [[0.0, 1.0]] * feet)
    measured = np.zeros((n, 3, 2 * feet))
    variance = np.full((n, 3, 2 * feet), np.inf)
    measured[:, 2, :feet] = -soles.bottom
    variance[:, 2, :feet] = np.where(contact, size.length(HEIGHT_STD) ** 2, np.inf)
    measured[:, :, feet:] = -np.swapaxes(soles.moving, 1, 2)
    variance[:, :, feet:] = np.where(contact[:, None], soles.std[:, None] ** 2, np.inf)
    start = np.zeros((3, 2))
    start[2, 0] = -soles.bottom[0].min()
    wide = np.tile(np.diag([size.length(0.05) ** 2, size.speed(1.0) ** 2]), (3, 1, 1))
    wide[:2, 0, 0] = 1e-10 * size.length(1.0) ** 2
    weighted = variance.copy()
    for _ in range(ROUNDS):
        found = smooth(transition, process, drive, rows, measured, weighted, (start, wide))
        predicted = found.mean @ rows.T
        with np.errstate(invalid="ignore"):
            beyond = np.abs(measured - predicted) / np.sqrt(variance)
        weighted = variance * np.maximum(np.nan_to_num(beyond) / OUTLIER, 1.0) ** 2
    deviation = np.sqrt(np.maximum(np.diagonal(found.cov, axis1=2, axis2=3), 0.0))
    return (found.mean[..., 0], deviation[..., 0]), (found.mean[..., 1], deviation[..., 1])
