"""Exciting motions: windowed finite Fourier series that keep within the limits of every joint.

Each motor moves as ``q(t) = q0 + w(t) (o + sum_k s_k sin(2 pi f_k t) + c_k cos(2 pi f_k t))``, a finite Fourier
series as in Swevers et al. 1997 (doi:10.1109/70.631234) about a pose of its own, under a window ``w`` that rises
from zero and falls back to it with two continuous derivatives. So a motion begins and ends at rest in the nominal
pose, and needs no filter before it is sent to a robot. Amplitudes are in units of what the limits of position,
velocity and acceleration allow. Limits of joints are all that keeps a robot from hitting itself or the ground.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from sysid_btr._typing import FloatArray
from sysid_btr.errors import ModelError, UsageError
from sysid_btr.excite.settings import MotionSettings
from sysid_btr.mujoco_conventions import slides

if TYPE_CHECKING:
    from sysid_btr.io.log import Log, LogMeta
    from sysid_btr.models.robot import Robot

VELOCITY = {False: 6.0, True: 0.3}
"""rad/s of hinges, m/s of slides, where nothing is said: what small servos do with ease."""
ACCELERATION = {False: 60.0, True: 3.0}
"""rad/s^2 of hinges, m/s^2 of slides, where nothing is said."""
TORQUE_SHARE = 0.5
"""Share of a servo's torque that its own inertia may take; the rest is for gravity, friction and other joints."""
REACH = {False: 0.5, True: 0.05}
"""rad or m, to either side, of a joint whose range neither model nor log states."""
PERIOD = 10.0
"""s after which a motion repeats; it is as long as it shall be, the search is not."""
RAMP = 1.0
"""s in which the window rises, and falls."""
SLOWEST, FASTEST = 0.2, 3.0
"""Hz of the lowest and of the highest harmonic, about."""
HARMONICS = 2
FINENESS = 40
"""Points a period of the highest harmonic at which limits are checked: they err by 0.3 % there."""
SAFETY = 0.995
RISE_SHARE = 0.9
"""Share of the velocity and acceleration limits that the way to the pose may take; the rest is for the series."""


@dataclass(frozen=True)
class Limits:
    """What one motor's command may do.

    Attributes
    ----------
    joints : driven by the motor; more than one where a motor drives several.
    home : nominal position, within ``low`` and ``high``.
    low, high : position, rad or m.
    velocity, acceleration : largest magnitudes, per s and per s^2.
    """

    joints: tuple[str, ...]
    home: float
    low: float
    high: float
    velocity: float
    acceleration: float

    def __post_init__(self) -> None:
        if not self.low <= self.home <= self.high or not self.low < self.high:
            raise UsageError(
                f"{', '.join(self.joints)}: no room to move: positions {self.low:g} to {self.high:g}, "
                f"nominal {self.home:g}"
            )
        if not (self.velocity > 0 and self.acceleration > 0):
            raise UsageError(f"{', '.join(self.joints)}: velocity and acceleration limits must be positive")


@dataclass(frozen=True)
class Clock:
    """Sampling rate (Hz), repetition (s) and number of repetitions of a motion."""

    rate: float
    period: float
    times: int = 1

    @classmethod
    def of(cls, seconds: float, rate: float) -> Clock:
        """A motion of so many seconds, in whole samples, that repeats itself after about `PERIOD`.

        Raises
        ------
        UsageError
            If it is too short to rise from rest and fall back, or sampled too slowly for what moves in it.
        """
        if not 2.5 * RAMP <= seconds <= 3600:
            raise UsageError(f"--seconds {seconds:g}: a motion must last {2.5 * RAMP:g} to 3600 s")
        if not 4 * FASTEST <= rate <= 10_000:
            raise UsageError(
                f"--rate {rate:g}: a motion of up to {FASTEST:g} Hz is sampled at {4 * FASTEST:g} to 10000 Hz"
            )
        times = max(round(seconds / PERIOD), 1)
        return cls(rate, round(seconds * rate) / rate / times, times)

    @property
    def seconds(self) -> float:
        return self.times * self.period

    def repeated(self, times: int) -> Clock:
        """The same motion, so many times on end."""
        return replace(self, times=times)

    @cached_property
    def time(self) -> FloatArray:
        """(n,) s of the samples."""
        return np.arange(round(self.seconds * self.rate) + 1, dtype=np.float64) / self.rate

    @cached_property
    def frequencies(self) -> FloatArray:
        """(k,) Hz, harmonics of the period, evenly spread over the logarithm."""
        wanted = np.round(np.geomspace(SLOWEST, FASTEST, HARMONICS) * self.period).astype(np.int64)
        return np.asarray(np.unique(np.maximum(wanted, 1)) / self.period)


@dataclass(frozen=True, eq=False)
class Family:
    """All motions of some motors; one of them is a row of coefficients in [-1, 1].

    Attributes
    ----------
    motors : what moves, and within what.
    clock : when.
    """

    motors: tuple[Limits, ...]
    clock: Clock

    @property
    def names(self) -> tuple[str, ...]:
        """Of the coefficients: for each motor its pose, then sine and cosine of each harmonic."""
        waves = [f"{part}{k + 1}" for k in range(len(self.clock.frequencies)) for part in ("sin", "cos")]
        return tuple(f"{motor.joints[0]}.{what}" for motor in self.motors for what in ("pose", *waves))

    def commands(self, coefficients: FloatArray, times: int | None = None) -> tuple[FloatArray, FloatArray]:
        """Time (n,) and positions (n, motors) of one motion, of coefficients in the order of `names`.

        Parameters
        ----------
        times : repetitions, if not as many as the clock's; amplitudes are the same.
        """
        clock = self.clock if times is None else self.clock.repeated(times)
        rows = coefficients.reshape(len(self.motors), -1)
        rise = window(clock.time, clock.seconds)[0]
        sine, cosine = self._basis(clock.time)
        columns = []
        for motor, row in zip(self.motors, rows, strict=True):
            pose, wave = self._amplitudes(motor, row)
            position = motor.home + rise * (pose + wave[0::2] @ sine + wave[1::2] @ cosine)
            columns.append(np.clip(position, motor.low, motor.high))  # rounding alone can pass them
        return clock.time, np.stack(columns, axis=1)

    def _amplitudes(self, motor: Limits, row: FloatArray) -> tuple[float, FloatArray]:
        """Pose, from the nominal one, and amplitudes (2k,) of one motor, in its unit, within its limits.

        The pose is where between the bounds the coefficient says; an amplitude is a fraction of what its
        harmonic may do alone; where all of them together are too much, all are reduced alike.
        """
        omega = 2 * np.pi * self.clock.frequencies
        middle, half = 0.5 * (motor.high + motor.low) - motor.home, 0.5 * (motor.high - motor.low)
        alone = np.minimum(half, np.minimum(motor.velocity / omega, motor.acceleration / omega**2))
        wave = row[1:] * np.repeat(alone, 2)
        (w, dw, ddw), (sine, cosine) = self._check
        s, c = wave[0::2], wave[1::2]
        x, dx = s @ sine + c @ cosine, (s * omega) @ cosine - (c * omega) @ sine
        ddx = -(s * omega**2) @ sine - (c * omega**2) @ cosine
        rise = float(np.abs(dw).max()) / motor.velocity, float(np.abs(ddw).max()) / motor.acceleration
        asked = float(middle + row[0] * half)
        pose = float(np.sign(asked)) * min(abs(asked), SAFETY * RISE_SHARE / max(rise))
        fast, sharp = SAFETY * motor.velocity, SAFETY * motor.acceleration
        low, high = motor.low - motor.home, motor.high - motor.home
        # on the way under the window from the nominal position to one within bounds all are within bounds
        share = min(
            1.0,
            SAFETY * _largest(x, np.full(1, pose), low, high),
            _largest(dw * x + w * dx, dw * pose, -fast, fast),
            _largest(ddw * x + 2 * dw * dx + w * ddx, ddw * pose, -sharp, sharp),
        )
        return pose, share * wave

    @cached_property
    def _check(self) -> tuple[tuple[FloatArray, ...], tuple[FloatArray, FloatArray]]:
        """Window and series where limits are checked; three repetitions hold all that more of them do."""
        clock = self.clock.repeated(min(self.clock.times, 3))
        step = min(1 / clock.rate, 1 / (FINENESS * clock.frequencies[-1]))
        time = np.linspace(0.0, clock.seconds, int(np.ceil(clock.seconds / step)) + 1)
        return window(time, clock.seconds), self._basis(time)

    def _basis(self, time: FloatArray) -> tuple[FloatArray, FloatArray]:
        angle = np.outer(2 * np.pi * self.clock.frequencies, time)
        return np.sin(angle), np.cos(angle)


def window(time: FloatArray, end: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Window and its two derivatives: 0 at time 0 and at the end, 1 between the ramps."""
    ramp = min(RAMP, 0.4 * end)
    u = np.clip(np.minimum(time, end - time) / ramp, 0.0, 1.0)
    sign = np.where(time < 0.5 * end, 1.0, -1.0)
    value = u**3 * (10 - 15 * u + 6 * u**2)
    slope = sign * 30 * u**2 * (1 - u) ** 2 / ramp
    bend = 60 * u * (1 - u) * (1 - 2 * u) / ramp**2
    return value, slope, bend


def _largest(wave: FloatArray, rest: FloatArray, low: float, high: float) -> float:
    """Largest factor b for which ``low <= rest + b wave <= high`` at all times; `rest` is within."""
    rest = np.broadcast_to(rest, wave.shape)
    room = np.where(wave > 0, high - rest, rest - low)
    size = np.abs(wave)
    there = size > 1e-12 * (high - low)
    return float(max(np.min(room[there] / size[there], initial=np.inf), 0.0))


def find_motors(robot: Robot, motion: MotionSettings | None = None, reference: Log | None = None) -> tuple[Limits, ...]:
    """Motors of a robot and what their commands may do.

    Position: the joint's range in the model less a margin at either end, and the servo's control range; where the
    model states none, what the reference log commanded, else `REACH` about the nominal pose. A nominal position
    outside of this extends it as far. Velocity and acceleration as given; where a servo's torque is limited,
    acceleration is no more than what `TORQUE_SHARE` of it gives to the joint's inertia in the nominal pose.

    Parameters
    ----------
    robot : model.
    motion : its joints and limits; joints that are not asked for are commanded to their nominal position. Where it has
        none, `VELOCITY` and `ACCELERATION` are those of every joint.
    reference : log of a motion that the robot is known to survive.

    Raises
    ------
    UsageError
        A glob that matches no joint with a servo, or limits without room.
    ModelError
        A model without servos.
    """
    import mujoco

    from sysid_btr.models.robot import joint_ranges, servo_drives

    motion = motion or MotionSettings()
    if not 0 <= motion.margin < 0.5:
        raise UsageError(f"--margin {motion.margin:g}: a fraction of each joint's range, 0 to less than 0.5")
    model = robot.model
    drives = {drive.joint: drive for drive in servo_drives(model)}
    known = tuple(drives)
    if not known:
        raise ModelError(f"model {robot.name} has no position servo, so no joint can be commanded")
    chosen = _chosen(known, motion.joints)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    inertia = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, inertia)
    ranges = joint_ranges(robot)
    motors = []
    done: set[str] = set()
    for name in chosen:
        if name in done:
            continue
        together = next((t for t in robot.tied if name in t), (name,))
        done.update(together)
        low, high, fast, sharp = -np.inf, np.inf, np.inf, np.inf
        home = float(model.qpos0[model.joint(name).qposadr[0]])
        for joint in together:
            drive, dof = drives[joint], int(model.joint(joint).dofadr[0])
            a = drive.actuator
            sliding = slides(model, joint)
            least, most = _room(joint, home, ranges, reference, motion.margin, sliding)
            if model.actuator_ctrllimited[a]:
                reach = np.sort(model.actuator_ctrlrange[a] / drive.scale)
                least, most = max(least, reach[0]), min(most, reach[1])
            low, high = max(low, least), min(high, most)
            fast = min(fast, VELOCITY[sliding] if motion.velocity is None else motion.velocity)
            sharp = min(sharp, ACCELERATION[sliding] if motion.acceleration is None else motion.acceleration)
            if model.actuator_forcelimited[a]:
                torque = abs(model.actuator_gear[a, 0]) * float(np.abs(model.actuator_forcerange[a]).min())
                sharp = min(sharp, TORQUE_SHARE * torque / float(inertia[dof, dof]))
        motors.append(Limits(together, home, min(low, home), max(high, home), fast, sharp))
    return tuple(motors)


def _chosen(known: Sequence[str], globs: Sequence[str]) -> list[str]:
    if not globs:
        return list(known)
    wrong = [glob for glob in globs if not any(fnmatchcase(name, glob) for name in known)]
    if wrong:
        raise UsageError(f"--joints {', '.join(wrong)}: not joints with a servo; available: {', '.join(known)}")
    return [name for name in known if any(fnmatchcase(name, glob) for glob in globs)]


def _room(
    joint: str,
    home: float,
    ranges: Mapping[str, tuple[float, float]],
    reference: Log | None,
    margin: float,
    sliding: bool,
) -> tuple[float, float]:
    if joint in ranges:
        low, high = ranges[joint]
        free = margin * (high - low)
        return low + free, high - free
    if reference is not None and reference.has("command", joint):
        sent = reference.channels[f"command.{joint}"]
        low, high = float(np.nanmin(sent)), float(np.nanmax(sent))
        if high > low:
            return low, high
    return home - REACH[sliding], home + REACH[sliding]


def as_log(
    family: Family, coefficients: FloatArray, robot: Robot, times: int | None = None, like: LogMeta | None = None
) -> Log:
    """The motion as a log of commands; joints that do not move are commanded to their nominal position.

    Parameters
    ----------
    times : repetitions, if not as many as the family's.
    like : metadata of a log of this robot, from which the servos' period and settings are taken.
    """
    from sysid_btr.io.log import MOTION, Log, LogMeta
    from sysid_btr.models.robot import servo_joints

    model = robot.model
    time, moving = family.commands(coefficients, times)
    channels = {
        f"command.{name}": np.full(len(time), float(model.qpos0[model.joint(name).qposadr[0]]))
        for name in servo_joints(robot)
    }
    for motor, column in zip(family.motors, moving.T, strict=True):
        channels.update({f"command.{joint}": column for joint in motor.joints})
    like = LogMeta(robot=robot.name) if like is None else like
    meta = LogMeta(
        robot=like.robot,
        mount="fixed",
        sample_period=1 / family.clock.rate,
        source=MOTION,
        servo_period=like.servo_period,
        extra=like.extra,
    )
    return Log(time=time, channels=channels, meta=meta, episode=np.zeros(len(time), dtype=np.int64))
