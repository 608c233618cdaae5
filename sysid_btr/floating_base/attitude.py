"""What a log says of the attitude of a floating base: by its inertial unit, or by the feet on which it stands."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Self

import numpy as np

from sysid_btr._typing import BoolArray, FloatArray, IntArray
from sysid_btr.errors import LogError
from sysid_btr.floating_base.feet import FeetMotion, base_body
from sysid_btr.floating_base.orientation import rotation_of
from sysid_btr.floating_base.size import BodySize
from sysid_btr.identify.smoothing import Tracks, smooth_joints
from sysid_btr.io.log import Log
from sysid_btr.io.noise import noise_floor

if TYPE_CHECKING:
    import mujoco

NEAR = 0.006
"""m above the lowest foot up to which a foot stands where no force sensor says otherwise."""
HEIGHT_STD = 0.0007
"""m, of a standing foot's lowest point: the ground gives, soles are not flat."""
LEANING = 1.0
"""rad, by which the base of a robot that stands leans at most, against that of the model as it is."""
SOLE_STD = 0.01
"""rad, of a sole against level ground, which gives under the load: as long as the robot stands so, and no average
removes it. Simulated walks: 0.015."""
TILT_STD = 0.02
"""rad, of the vertical taken from the accelerometer, at rest."""
FLAT = 0.01
"""m, root of the sum of squared distances of what touches from its longest line, below which it tells no vertical: a
foot on its edge, two points."""


@dataclass(frozen=True, eq=False)
class Attitude:
    """Angular velocity and vertical of the base, sample by sample, in its frame.

    Attributes
    ----------
    turning, turning_std : (n, 3) angular velocity, rad/s, and its standard deviation.
    rates : smoothed angular velocity.
    up, up_std : (n, 3) vertical, and (n,) its standard deviation, rad; infinite where nothing tells it.
    steady : rad, standard deviation of an error of the vertical that no average removes.
    """

    turning: FloatArray
    turning_std: FloatArray
    rates: Tracks
    up: FloatArray
    up_std: FloatArray
    steady: float = 0.0

    def rows(self, start: int, stop: int) -> Self:
        """Samples `start` to `stop` (exclusive)."""
        own = slice(start, stop)
        rates = Tracks(**{name: value[own] for name, value in vars(self.rates).items()})
        turning, turning_std = self.turning[own], self.turning_std[own]
        return type(self)(turning, turning_std, rates, self.up[own], self.up_std[own], self.steady)


# --- by the inertial unit ---------------------------------------------------------------------------------------


def of_inertial_unit(log: Log, size: BodySize, lost: list[str]) -> Attitude:
    """The attitude that gyro, and inclinometers or accelerometer, measure.

    Parameters
    ----------
    log : with ``imu.gyro_x..z``, and ``imu.angle_x``, ``imu.angle_y`` or ``imu.acc_x..z``.
    size : of the robot.
    lost : is told what could not be found out for want of a sensor.

    Raises
    ------
    LogError
        If the log lacks one of them.
    """
    gyro = imu_columns(log, ("gyro_x", "gyro_y", "gyro_z"))
    noise = np.array([noise_floor(c).sigma for c in gyro.T])
    rates = smooth_joints(log.time - log.time[0], gyro, size.time(1.0), derivative=1)
    return Attitude(gyro, np.tile(noise, (len(gyro), 1)), rates, *_vertical(log, size, lost))


def imu_columns(log: Log, names: tuple[str, ...]) -> FloatArray:
    """Columns of the inertial unit, (n, k), with single missing values interpolated.

    Raises
    ------
    LogError
        If one of them is missing or empty.
    """
    missing = [f"imu.{n}" for n in names if not log.has("imu", n)]
    if missing:
        raise LogError(
            f"log {log.path or ''}: a floating-base log with an inertial unit but without {', '.join(missing)}: the "
            "orientation of the base needs imu.gyro_x..z, and imu.angle_x, imu.angle_y or imu.acc_x..z. Of a robot "
            "that stands, leave out all of imu: its feet tell how it stands"
        )
    values = log.array("imu", names)
    index = np.arange(len(values))
    for column in values.T:
        good = np.isfinite(column)
        if not good.any():
            raise LogError(f"log {log.path or ''}: a column of the IMU has no values")
        column[~good] = np.interp(index[~good], index[good], column[good])
    return values


def _vertical(log: Log, size: BodySize, lost: list[str]) -> tuple[FloatArray, FloatArray]:
    """Measured vertical in the base's frame, and its standard deviation."""
    if log.has("imu", "angle_x") and log.has("imu", "angle_y"):
        angles = imu_columns(log, ("angle_x", "angle_y"))
        sigma = float(np.mean([noise_floor(c).sigma for c in np.unwrap(angles, axis=0).T]))
        return up_in_base(angles[:, 0], angles[:, 1]), np.full(len(angles), max(sigma, 1e-4))
    force = imu_columns(log, ("acc_x", "acc_y", "acc_z"))
    felt = np.linalg.norm(force, axis=1)
    lost.append("no inclinometer: the vertical is the accelerometer's, more uncertain while the robot accelerates")
    return force / felt[:, None], TILT_STD + np.abs(felt - size.gravity) / size.gravity + 0.05


def up_in_base(angle_x: FloatArray, angle_y: FloatArray) -> FloatArray:
    """World's vertical in the base's frame, (n, 3), for roll about x after pitch about y after yaw about z."""
    return np.stack([-np.sin(angle_y), np.cos(angle_y) * np.sin(angle_x), np.cos(angle_y) * np.cos(angle_x)], axis=1)


# --- by the feet ------------------------------------------------------------------------------------------------


def of_feet(
    model: mujoco.MjModel, time: FloatArray, feet: FeetMotion, addresses: IntArray, joints: Tracks, size: BodySize
) -> Attitude:
    """The attitude of a robot that stands on level ground, on what of it is lowest, and that does not slip.

    At first it stands as it would come to rest, its centre of mass as low as it gets; from then on it stays on what it
    stood on, or steps onto what is then as low.

    Parameters
    ----------
    model : with a free base.
    time : (n,) s.
    feet : points of what can touch the ground.
    addresses, joints : addresses in qpos, (j,), and smoothed motion of the joints.
    size : of the robot.
    """
    n, step = len(time), np.append(np.diff(time), 0.0)
    up, up_std, turning = np.empty((n, 3)), np.empty(n), np.empty((n, 3))
    every, motion = np.concatenate(feet.points, axis=1), np.concatenate(feet.moving, axis=1)
    radius = np.concatenate([foot.radius for foot in feet.feet])
    now = resting(model, addresses, joints.position[0], every[0], radius)
    for k, (points, moving) in enumerate(zip(every, motion, strict=True)):
        now, up_std[k], low = _levelled(now, points, radius, size)
        up[k], turning[k] = now, turning_over(points[low], moving[low])
        now = now + step[k] * np.cross(now, turning[k])
        now /= np.linalg.norm(now)
    # all joints between the base and the ground err, and others do not count
    off, slow = (np.linalg.norm(s[:, feet.between], axis=1) for s in (joints.position_std, joints.velocity_std))
    up_std, std = np.hypot(up_std, off), np.tile(slow[:, None], (1, 3))
    faster = np.asarray(np.gradient(turning, time, axis=0))
    rates = Tracks(turning, faster, np.zeros((n, 3)), std, np.full((n, 3), np.inf))
    return Attitude(turning, std, rates, up, up_std, SOLE_STD)


def _levelled(
    up: FloatArray, points: FloatArray, radius: FloatArray, size: BodySize
) -> tuple[FloatArray, float, BoolArray]:
    """The vertical (3,) for which what is lowest near another one lies level, its error, and which points these are.

    The error is infinite, and the vertical the other one, where too little touches to tell it.
    """
    std = np.inf
    for _ in range(2):
        height = points @ up - radius
        low = height < height.min() + size.length(NEAR)
        touching = points[low] - radius[low, None] * up
        _, extent, axes = np.linalg.svd(touching - touching.mean(axis=0))
        if len(touching) < 3 or extent[1] < size.length(FLAT):
            break
        up = axes[2] * np.sign(axes[2] @ up)
        std = size.length(HEIGHT_STD) / float(extent[1])
    return up, std, np.asarray(low)


def resting(
    model: mujoco.MjModel, addresses: IntArray, positions: FloatArray, points: FloatArray, radius: FloatArray
) -> FloatArray:
    """The vertical (3,) in the base's frame of a robot that stands still: of the least energy, near the model's.

    Parameters
    ----------
    model : with a free base.
    addresses, positions : addresses in qpos, (j,), and positions of the joints.
    points, radius : (k, 3) in the base's frame and (k,), m, of what can touch the ground.
    """
    import mujoco
    from scipy.optimize import minimize

    data = mujoco.MjData(model)
    data.qpos[:] = model.qpos0
    data.qpos[addresses] = positions
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    base = base_body(model)
    frame = data.xmat[base].reshape(3, 3)
    centre = (data.subtree_com[base] - data.xpos[base]) @ frame

    def up(lean: FloatArray) -> FloatArray:
        return np.asarray(rotation_of(np.array([*lean, 0.0]))[2] @ frame)

    def energy(lean: FloatArray) -> float:
        vertical = up(lean)
        return float(centre @ vertical - np.min(points @ vertical - radius))

    within = [(-LEANING, LEANING)] * 2
    found = minimize(energy, np.zeros(2), method="Nelder-Mead", bounds=within, options={"xatol": 1e-6, "fatol": 1e-9})
    return up(found.x)


def turning_over(points: FloatArray, moving: FloatArray) -> FloatArray:
    """Angular velocity (3,) of a base for which points (m, 3) that move so (m, 3) in its frame are at rest."""
    arm = points - points.mean(axis=0)
    across = np.zeros((len(arm), 3, 3))
    across[:, 0, 1], across[:, 0, 2], across[:, 1, 2] = arm[:, 2], -arm[:, 1], arm[:, 0]
    across -= across.transpose(0, 2, 1)
    drift = moving - moving.mean(axis=0)
    return np.asarray(np.linalg.lstsq(across.reshape(-1, 3), -drift.ravel(), rcond=1e-3)[0])
