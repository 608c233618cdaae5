"""Logs of simulated robots: MuJoCo's forces, short steps of our own, held commands, encoders that count, noise."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from benchmarks.robots.planted import Planted
from sysid_btr._typing import FloatArray
from sysid_btr.io.log import Log, LogMeta

if TYPE_CHECKING:
    import mujoco

STEP = 0.00025
"""s, of the simulation, by a method of third order where fits take one of fourth. First order adds a step's length of
damping to every inertia, second order some microseconds of lag in stiff servos, and `close` finds them."""
KUTTA = ((0.5,), (-1.0, 2.0), (1 / 6, 4 / 6, 1 / 6))
"""Weights of the slopes so far, with which to go from the start of a step."""
TICK = 2 * math.pi / 2**14
"""rad (m for slides, times `SLIDE`), of an encoder."""
SLIDE = 0.05
REMEMBERED = 4000
"""Steps, 1 s, of commands that delays and filters can reach back."""
NOISE = {"position": 2e-4, "effort": 0.02, "imu.gyro": 0.005, "imu.acc": 0.05, "imu.angle": 0.002}
"""Standard deviations; of the effort as a fraction of its rms."""


@dataclass(frozen=True, eq=False)
class Motion:
    """What joints are to do: (n, j) positions and velocities of named joints at the samples of a log."""

    joints: tuple[str, ...]
    time: FloatArray
    position: FloatArray
    velocity: FloatArray


class Drive(Protocol):
    """What is sent to the actuators at a sample, and which columns of the log say so."""

    def ctrl(self, motion: Motion, sample: int, model: mujoco.MjModel, data: mujoco.MjData) -> FloatArray: ...

    def channels(self, motion: Motion, ctrl: FloatArray) -> dict[str, FloatArray]: ...


@dataclass(frozen=True)
class Positions:
    """Joint positions, before a gear."""

    gear: float = 1.0

    def ctrl(self, motion: Motion, sample: int, model: mujoco.MjModel, data: mujoco.MjData) -> FloatArray:
        return np.asarray(self.gear * motion.position[sample])

    def channels(self, motion: Motion, ctrl: FloatArray) -> dict[str, FloatArray]:
        return {f"command.{j}": motion.position[:, i] for i, j in enumerate(motion.joints)}


@dataclass(frozen=True)
class Velocities:
    """Joint velocities, corrected by the measured positions as a trajectory controller does."""

    correction: float = 2.0

    def ctrl(self, motion: Motion, sample: int, model: mujoco.MjModel, data: mujoco.MjData) -> FloatArray:
        here = np.array([data.joint(j).qpos[0] for j in motion.joints])
        return np.asarray(motion.velocity[sample] + self.correction * (motion.position[sample] - here))

    def channels(self, motion: Motion, ctrl: FloatArray) -> dict[str, FloatArray]:
        return {f"command.{j}": ctrl[:, i] for i, j in enumerate(motion.joints)}


@dataclass(frozen=True)
class Torques:
    """Joint torques of a controller that follows the motion and knows the weight; behind a gear."""

    kp: tuple[float, ...]
    kd: tuple[float, ...]
    gear: float = 1.0

    def ctrl(self, motion: Motion, sample: int, model: mujoco.MjModel, data: mujoco.MjData) -> FloatArray:
        torque = np.empty(len(motion.joints))
        for i, name in enumerate(motion.joints):
            joint = data.joint(name)
            error = self.kp[i] * (motion.position[sample, i] - joint.qpos[0])
            torque[i] = error + self.kd[i] * (motion.velocity[sample, i] - joint.qvel[0]) + joint.qfrc_bias[0]
        return torque / self.gear

    def channels(self, motion: Motion, ctrl: FloatArray) -> dict[str, FloatArray]:
        return {f"command.{j}": self.gear * ctrl[:, i] for i, j in enumerate(motion.joints)}


@dataclass(frozen=True)
class Impedance:
    """Position, velocity and torque together, kp (q* - q) + kd (v* - v) + tau*, into position servos with kp and kd."""

    kp: float
    kd: float
    fed: FloatArray
    """(j,) torque that is fed forward, Nm per rad of the commanded position."""

    def ctrl(self, motion: Motion, sample: int, model: mujoco.MjModel, data: mujoco.MjData) -> FloatArray:
        q, v = motion.position[sample], motion.velocity[sample]
        return np.asarray(q + (self.kd * v + self.fed * q) / self.kp)

    def channels(self, motion: Motion, ctrl: FloatArray) -> dict[str, FloatArray]:
        found = {}
        for i, j in enumerate(motion.joints):
            found[f"command.{j}"] = motion.position[:, i]
            found[f"command_velocity.{j}"] = motion.velocity[:, i]
            found[f"command_effort.{j}"] = self.fed[i] * motion.position[:, i]
        return found


@dataclass(frozen=True)
class OwnControl:
    """Controls of actuators that drive no joint alone; the motion's columns are actuators."""

    def ctrl(self, motion: Motion, sample: int, model: mujoco.MjModel, data: mujoco.MjData) -> FloatArray:
        return np.asarray(motion.position[sample])

    def channels(self, motion: Motion, ctrl: FloatArray) -> dict[str, FloatArray]:
        return {f"command.{j}": ctrl[:, i] for i, j in enumerate(motion.joints)}


@dataclass(frozen=True, eq=False)
class Experiment:
    """What a robot does and what is logged of it.

    Attributes
    ----------
    drive : how it is driven.
    joints : joints (or actuators) that are commanded.
    centre, size : of their motion, in units of the joints.
    seconds, rate, seed : of the log; Hz.
    logged : joints whose position is logged; None: all.
    effort : joints whose torque is logged.
    silent : commands are not logged.
    interpolated : drives go from one command to the next, and do not hold it (of commands that no sensor changes). A
        torque that is read as a held command jumps is not the one that moved the robot.
    start : positions at rest, by joint; those of the keyframe, or zero, of others.
    free, imu : the base is free; and has an inertial unit.
    frequencies : Hz, between which the motion has its sines.
    stride : (j,) phases of a motion of one frequency; None: several sines.
    meta : what the log says of itself.
    """

    drive: Drive
    joints: tuple[str, ...]
    centre: tuple[float, ...]
    size: tuple[float, ...]
    seconds: float = 10.0
    rate: float = 100.0
    seed: int = 0
    logged: tuple[str, ...] | None = None
    effort: tuple[str, ...] = ()
    silent: bool = False
    interpolated: bool = False
    start: Mapping[str, float] = field(default_factory=dict)
    free: bool = False
    imu: bool = False
    frequencies: tuple[float, float] = (0.15, 1.2)
    stride: tuple[float, ...] | None = None
    meta: Mapping[str, Any] = field(default_factory=dict)

    def motion(self, rng: np.random.Generator) -> Motion:
        """Sums of sines that begin at rest."""
        n = int(self.seconds * self.rate)
        time = np.arange(n) / self.rate
        begin = (1.0 - np.exp(-((time / 0.6) ** 2)))[:, None]
        if self.stride is not None:
            wave = np.sin(2 * np.pi * self.frequencies[1] * time[:, None] + np.asarray(self.stride))
        else:
            frequency = rng.uniform(*self.frequencies, (5, 1, len(self.joints)))
            phase = rng.uniform(0, 2 * np.pi, frequency.shape)
            weight = (frequency[:1] / frequency) ** 0.5
            wave = (weight * np.sin(2 * np.pi * frequency * time[:, None] + phase)).sum(axis=0)
            wave = wave / np.abs(wave).max(axis=0)
        position = np.asarray(self.centre) + np.asarray(self.size) * begin * wave
        return Motion(self.joints, time, position, np.gradient(position, 1 / self.rate, axis=0))


def record(xml: str, experiment: Experiment, planted: Sequence[Planted], heavier: Mapping[str, float]) -> Log:
    """A log of a robot that has what is planted; bodies `heavier` by factors."""
    import mujoco

    rng = np.random.default_rng(experiment.seed)
    model = _robot(xml, planted, heavier)
    data = mujoco.MjData(model)
    if model.nkey:
        mujoco.mj_resetDataKeyframe(model, data, 0)
    motion = experiment.motion(rng)
    for joint, value in {**dict(zip(motion.joints, experiment.centre, strict=True)), **experiment.start}.items():
        if any(model.joint(i).name == joint for i in range(model.njnt)):
            data.joint(joint).qpos[0] = value
    steps = round(1 / experiment.rate / STEP)
    n, idle = len(motion.time), data.ctrl.copy()
    driven = [a for a in range(model.nu) if _driven(model, a) in motion.joints]
    for a in set(range(model.nu)) - set(driven):
        idle[a] = experiment.start.get(_driven(model, a), idle[a])
    _settle(model, data, experiment, motion, driven, idle, planted)
    ctrl, seen = np.tile(idle, (n, 1)), []
    history = np.empty((0, model.nu))
    for i in range(n):
        ctrl[i, driven] = experiment.drive.ctrl(motion, i, model, data)
        ahead = experiment.drive.ctrl(motion, min(i + 1, n - 1), model, data) if experiment.interpolated else None
        history = np.concatenate([history[-REMEMBERED:], _within(ctrl[i], driven, ahead, steps)])
        sent = _sent(history, planted)[-steps:]
        data.ctrl[:] = ctrl[i] if experiment.interpolated else sent[0]
        mujoco.mj_forward(model, data)
        seen.append(_sensed(model, data))
        _advance(model, data, sent, planted)
    channels = {} if experiment.silent else experiment.drive.channels(motion, ctrl[:, driven])
    channels |= _columns(model, experiment, seen)
    _spoil(channels, model, rng)
    for one in planted:
        one.read(channels)
    meta = LogMeta(
        mount="free" if experiment.free else "fixed",
        sample_period=1 / experiment.rate,
        source="simulated",
        **experiment.meta,
    )
    return Log(motion.time, channels, meta, np.zeros(n, dtype=np.int64))


def _within(ctrl: FloatArray, driven: list[int], ahead: FloatArray | None, steps: int) -> FloatArray:
    """(steps, nu) ctrl until the next sample: held, or on the way to what is commanded then."""
    rows = np.tile(ctrl, (steps, 1))
    if ahead is not None:
        rows[:, driven] += (ahead - ctrl[driven]) * ((np.arange(steps) + 0.5) / steps)[:, None]
    return rows


def _robot(xml: str, planted: Sequence[Planted], heavier: Mapping[str, float]) -> mujoco.MjModel:
    import mujoco

    spec = mujoco.MjSpec.from_string(xml)
    for one in planted:
        one.build(spec)
    model = spec.compile()
    model.opt.timestep = STEP
    for body, factor in heavier.items():
        model.body(body).mass[:] *= factor
        model.body(body).inertia[:] *= factor
    mujoco.mj_setConst(model, mujoco.MjData(model))
    return model


def _driven(model: mujoco.MjModel, actuator: int) -> str:
    """The joint that an actuator drives, or its own name."""
    import mujoco

    if int(model.actuator_trntype[actuator]) == int(mujoco.mjtTrn.mjTRN_JOINT):
        return str(model.joint(int(model.actuator_trnid[actuator, 0])).name)
    return str(model.actuator(actuator).name)


def _settle(
    model: mujoco.MjModel,
    data: mujoco.MjData,
    experiment: Experiment,
    motion: Motion,
    driven: list[int],
    idle: FloatArray,
    planted: Sequence[Planted],
) -> None:
    """Two seconds at the first command, so that the log begins at rest."""
    import mujoco

    steps = round(1 / experiment.rate / STEP)
    for _ in range(int(2.0 * experiment.rate)):
        mujoco.mj_forward(model, data)
        row = idle.copy()
        row[driven] = experiment.drive.ctrl(motion, 0, model, data)
        _advance(model, data, np.tile(row, (steps, 1)), planted)


def _sent(history: FloatArray, planted: Sequence[Planted]) -> FloatArray:
    for one in planted:
        history = one.sent(history, STEP)
    return history


def _advance(model: mujoco.MjModel, data: mujoco.MjData, ctrl: FloatArray, planted: Sequence[Planted]) -> None:
    for row in ctrl:
        data.ctrl[:] = row
        _kutta(model, data, planted)


def _kutta(model: mujoco.MjModel, data: mujoco.MjData, planted: Sequence[Planted]) -> None:
    """One step of Kutta's method of third order, with what is planted as a force among the others."""
    import mujoco

    position, velocity, activation = data.qpos.copy(), data.qvel.copy(), data.act.copy()
    slopes: list[tuple[FloatArray, FloatArray, FloatArray]] = []
    for weights in KUTTA:
        at = data.qvel.copy()
        _derive(model, data, planted)
        slopes.append((at, data.qacc.copy(), data.act_dot.copy()))
        pairs = list(zip(weights, slopes, strict=True))
        data.qpos[:] = position
        mujoco.mj_integratePos(model, data.qpos, sum(w * s[0] for w, s in pairs), STEP)
        data.qvel[:] = velocity + STEP * sum(w * s[1] for w, s in pairs)
        data.act[:] = activation + STEP * sum(w * s[2] for w, s in pairs)
    data.time += STEP


def _derive(model: mujoco.MjModel, data: mujoco.MjData, planted: Sequence[Planted]) -> None:
    import mujoco

    data.qfrc_applied[:] = 0.0
    for one in planted:
        one.torque(model, data)
    mujoco.mj_forward(model, data)


def _sensed(model: mujoco.MjModel, data: mujoco.MjData) -> dict[str, FloatArray]:
    seen = {"qpos": data.qpos.copy(), "effort": data.qfrc_actuator.copy(), "sensors": data.sensordata.copy()}
    if model.nsensor:
        seen["up"] = data.xmat[1].reshape(3, 3)[2].copy()
    return seen


def _columns(
    model: mujoco.MjModel, experiment: Experiment, seen: Sequence[Mapping[str, FloatArray]]
) -> dict[str, FloatArray]:
    channels = {}
    single = [model.joint(i).name for i in range(model.njnt) if int(model.jnt_type[i]) >= 2]
    for joint in single if experiment.logged is None else experiment.logged:
        adr = model.joint(joint).qposadr[0]
        channels[f"position.{joint}"] = np.array([s["qpos"][adr] for s in seen])
    for joint in experiment.effort:
        dof = model.joint(joint).dofadr[0]
        channels[f"effort.{joint}"] = np.array([s["effort"][dof] for s in seen])
    if experiment.imu:
        read, up = np.array([s["sensors"] for s in seen]), np.array([s["up"] for s in seen])
        for k, axis in enumerate("xyz"):
            channels[f"imu.gyro_{axis}"], channels[f"imu.acc_{axis}"] = read[:, k], read[:, 3 + k]
        channels["imu.angle_x"] = np.arctan2(up[:, 1], up[:, 2])
        channels["imu.angle_y"] = np.arctan2(-up[:, 0], np.hypot(up[:, 1], up[:, 2]))
    return {name: values.copy() for name, values in channels.items()}


def _spoil(channels: dict[str, FloatArray], model: mujoco.MjModel, rng: np.random.Generator) -> None:
    """Noise, and encoders that count; in place."""
    for name, values in channels.items():
        channel, _, joint = name.partition(".")
        kind = name.partition("_")[0] if channel == "imu" else channel
        if kind not in NOISE:
            continue
        scale = float(np.sqrt(np.mean(values**2))) if kind == "effort" else 1.0
        slide = channel == "position" and int(model.joint(joint).type[0]) == 2
        scale *= SLIDE if slide else 1.0
        values += NOISE[kind] * scale * rng.normal(size=len(values))
        if channel == "position":
            values[:] = np.round(values / (TICK * scale)) * (TICK * scale)
