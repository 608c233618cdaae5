"""Walks of the built-in Nao, recorded from MuJoCo with what the sensors would show, and with the truth."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cache

import mujoco
import numpy as np
import pytest

from sysid_btr.floating_base import innovations, orientation
from sysid_btr.io.log import Log, LogMeta
from sysid_btr.models.builtin import load_robot
from sysid_btr.models.gait import Gait, gait
from sysid_btr.models.robot import Robot

TICK = 2 * np.pi / 4096
PERIOD = 0.02
STEP = 0.001


@dataclass(frozen=True)
class Truth:
    """True motion at the samples: base (n, 3), rotation (n, 3, 3), joints (n, j), and the model."""

    position: np.ndarray
    velocity: np.ndarray
    rotation: np.ndarray
    rate: np.ndarray
    joint_position: np.ndarray
    joint_velocity: np.ndarray
    joints: tuple[str, ...]
    model: mujoco.MjModel


def record_walk(
    parameters: Gait,
    seconds: float,
    *,
    seed: int = 0,
    noise: float = 1.0,
    edit: Callable[[mujoco.MjSpec], None] | None = None,
    push: Callable[[float], np.ndarray] | None = None,
    delay: float = 0.0,
) -> tuple[Log, Truth]:
    """A log of a walk, and the truth.

    Parameters
    ----------
    noise : factor on the sensors' noise.
    edit : changes the robot that walks.
    push : time -> force on the torso, (3,) N.
    delay : of the commands, s, a multiple of the step.
    """
    spec = load_robot("nao").make_spec()
    spec.option.timestep = STEP
    # a truth of first order in the step would pass for a servo with another damping
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_RK4
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    if edit is not None:
        edit(spec)
    model = spec.compile()
    data = mujoco.MjData(model)
    rng = np.random.default_rng(seed)
    joints = tuple(model.actuator(i).name for i in range(model.nu))
    address = [model.jnt_qposadr[model.joint(j).id] for j in joints]
    dof = [model.jnt_dofadr[model.joint(j).id] for j in joints]
    time = np.arange(0, seconds - 1e-9, PERIOD)
    commands = np.stack([gait(parameters, time)[j] for j in joints], axis=1)
    data.qpos[address] = commands[0]
    mujoco.mj_forward(model, data)
    data.qpos[2] -= min(data.body(f"{s}AnkleRoll").xpos[2] - 0.05 for s in "LR")
    sensors = [model.sensor(i).name for i in range(model.nsensor) if not model.sensor(i).name.startswith("position_")]
    rows: dict[str, list[np.ndarray | float]] = {}
    inner = round(PERIOD / STEP)
    late = round(delay / STEP)
    history = [commands[0]] * late
    for k in range(len(time)):
        mujoco.mj_forward(model, data)
        rotation = data.body("Torso").xmat.reshape(3, 3).copy()
        state = {
            "position": data.qpos[:3].copy(),
            "velocity": data.qvel[:3].copy(),
            "rotation": rotation,
            "rate": data.qvel[3:6].copy(),
            "joint_position": data.qpos[address].copy(),
            "joint_velocity": data.qvel[dof].copy(),
        }
        for name, value in {**state, **{s: data.sensor(s).data.copy() for s in sensors}}.items():
            rows.setdefault(name, []).append(value)
        for _ in range(inner):
            history.append(commands[k])
            data.ctrl[:] = history.pop(0)
            if push is not None:
                data.body("Torso").xfrc_applied[:3] = push(data.time)
            mujoco.mj_step(model, data)
    table = {name: np.array(values) for name, values in rows.items()}
    channels = {f"command.{j}": commands[:, i] for i, j in enumerate(joints)}
    seen = table["joint_position"] + noise * rng.normal(scale=4e-4, size=table["joint_position"].shape)
    if noise:
        seen = np.round(seen / TICK) * TICK
    channels |= {f"position.{j}": seen[:, i] for i, j in enumerate(joints)}
    n = len(time)
    for i, axis in enumerate("xyz"):
        channels[f"imu.gyro_{axis}"] = table["gyro"][:, i] + noise * rng.normal(scale=0.01, size=n)
        channels[f"imu.acc_{axis}"] = table["acc"][:, i] + noise * rng.normal(scale=0.05, size=n)
    turn = table["rotation"]
    channels["imu.angle_x"] = np.arctan2(turn[:, 2, 1], turn[:, 2, 2]) + noise * rng.normal(scale=3e-3, size=n)
    channels["imu.angle_y"] = -np.arcsin(turn[:, 2, 0]) + noise * rng.normal(scale=3e-3, size=n)
    for name in sensors:
        if name.startswith("force_"):
            channels[f"force.{name.removeprefix('force_')}"] = table[name][:, 0]
    log = Log(
        time=time,
        channels=channels,
        meta=LogMeta(robot="nao", mount="free", sample_period=PERIOD, source="simulated"),
        episode=np.zeros(n, dtype=np.int64),
    )
    motion = {name: table[name] for name in Truth.__dataclass_fields__ if name in table}
    return log, Truth(**motion, joints=joints, model=model)


def heavier(name: str, factor: float) -> Callable[[mujoco.MjSpec], None]:
    """A change of a robot by which one of its bodies has another mass."""

    def edit(spec: mujoco.MjSpec) -> None:
        geom = next(g for g in spec.body(name).geoms if g.mass > 0)
        geom.mass *= factor

    return edit


@cache
def plain_walk() -> tuple[Log, Truth]:
    """Ten seconds of the default walk."""
    return record_walk(Gait(), 10.0)


@dataclass(frozen=True)
class Scale:
    """A Nao so many times as long, of the same density, under the same gravity.

    What it does is what the Nao does, in units of its length, its mass and the time that a fall of its length takes.
    """

    length: float

    @property
    def time(self) -> float:
        return float(np.sqrt(self.length))

    @property
    def mass(self) -> float:
        return self.length**3

    @property
    def torque(self) -> float:
        return self.mass * self.length

    @property
    def robot(self) -> Robot:
        nao = load_robot("nao")
        return replace(nao, name=f"nao of {self.length:g}", digest=str(self.length), make_spec=self._spec)

    def _spec(self) -> mujoco.MjSpec:
        spec = load_robot("nao").make_spec()
        # where MuJoCo's solver stops is in nobody's units: far beyond what is compared
        spec.option.tolerance = 1e-13
        for part in (*spec.bodies, *spec.geoms, *spec.sites):
            part.pos = np.multiply(part.pos, self.length)
        for part in (*spec.geoms, *spec.sites):
            part.size = np.multiply(part.size, self.length)
        for geom in spec.geoms:
            geom.mass *= self.mass
            geom.solref = np.multiply(geom.solref, [self.time, 1.0])
            geom.solimp = np.multiply(geom.solimp, [1.0, 1.0, self.length, 1.0, 1.0])
        for joint in spec.joints:
            joint.armature *= self.torque * self.time**2
            joint.damping = np.multiply(joint.damping, self.torque * self.time)
        for servo in spec.actuators:
            servo.gainprm = np.multiply(servo.gainprm, self.torque)
            servo.biasprm = np.multiply(servo.biasprm, self.torque)
            servo.biasprm[2] *= self.time
        for tie in spec.equalities:
            tie.solref = np.multiply(tie.solref, [self.time, 1.0])
        return spec

    @contextmanager
    def sensors(self) -> Iterator[None]:
        """Sensors and a bus that are worse by as much as everything is slower: theirs are not the robot's times."""
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(orientation, "DRIFT", orientation.DRIFT / np.sqrt(self.time))
            patch.setattr(innovations, "LATE", innovations.LATE * self.time)
            yield

    def log(self, log: Log) -> Log:
        """What the sensors of this robot would have shown of a Nao's walk, their noise as large beside the motion."""
        units = {"imu.gyro": 1 / self.time, "force": self.mass}
        channels = {
            name: column * next((unit for start, unit in units.items() if name.startswith(start)), 1.0)
            for name, column in log.channels.items()
        }
        meta = replace(log.meta, sample_period=PERIOD * self.time)
        return replace(log, time=log.time * self.time, channels=channels, meta=meta)
