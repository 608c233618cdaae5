"""The robot as an interface: something that executes a controller and reports what happened."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, Protocol

import numpy as np

from sysid_btr._typing import FloatArray
from sysid_btr.btr.controllers import Controller, ControllerSpace
from sysid_btr.btr.task import Motion, Task, judged
from sysid_btr.btr.world import World
from sysid_btr.io.log import Log, LogMeta

Outcome = Literal["done", "fallen", "crashed"]
OUTCOMES: tuple[Outcome, ...] = ("done", "fallen", "crashed")


@dataclass(frozen=True, eq=False)
class Trial:
    """What a controller did on the robot.

    Attributes
    ----------
    log : what the sensors said; None where nothing was recorded.
    fitness : as the task has it; of a crash what was reached before, or zero.
    outcome : ``done``, ``fallen`` (up to there it counts), or ``crashed`` (no use can be made of it).
    """

    log: Log | None
    fitness: float
    outcome: Outcome = "done"


class Robot(Protocol):
    """A robot on which controllers are tried."""

    def run(self, controller: Controller) -> Trial:
        """Try a controller; a fall or a crash is a result, not an error."""
        ...


@dataclass(frozen=True)
class Noise:
    """Standard deviations of a hidden robot's sensors: encoders rad, and step of these; fitness."""

    encoder: float = 4e-4
    step: float = 2 * np.pi / 4096
    gyro: float = 0.01
    acc: float = 0.05
    angle: float = 3e-3
    fitness: float = 0.0


SILENT = Noise(0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


@dataclass(frozen=True, eq=False)
class HiddenRobot:
    """A simulation that stands for the robot: the loop sees nothing of it but trials.

    Attributes
    ----------
    world, truth : the robot, and the values (p,) of its terms.
    task, space : what it does, and what controllers it plays.
    noise : of its sensors.
    seed : of the noise; the same controller is seen with the same noise.
    """

    world: World
    truth: FloatArray
    task: Task
    space: ControllerSpace
    noise: Noise = SILENT
    seed: int = 0

    def run(self, controller: Controller) -> Trial:
        """Try a controller in the hidden simulation."""
        world, joints = self.world, self.space.joints
        commands = world.spread(joints, self.space.commands(controller.values[None], self.task.time))
        (_, outputs), *_ = world.run(commands, self.truth[None])
        if not np.isfinite(outputs.position).all():
            return Trial(None, 0.0, "crashed")
        used = [world.index.joints.index(j) for j in joints]
        motion = world.motion(outputs, self.truth[None], self.task.watched)
        played = Played(motion, commands[0][:, used], world.sensors(outputs, commands[0], self.truth))
        return recorded(played, self.task, joints, self.noise, noise_of(self.seed, controller), world.robot.name)


@dataclass(frozen=True, eq=False)
class Played:
    """What a simulated robot did in a trial, at the task's samples.

    Attributes
    ----------
    motion : of one robot, the joints that are commanded among those that it has.
    command : (n, j) of the joints that are commanded.
    sensors : the model's by name, (n, size) each.
    """

    motion: Motion
    command: FloatArray
    sensors: Mapping[str, FloatArray]


def noise_of(seed: int, controller: Controller) -> np.random.Generator:
    """Random numbers of a controller's trial: the same whenever it is tried."""
    return np.random.default_rng([seed, *np.ascontiguousarray(controller.values).view(np.uint32)])


def recorded(
    played: Played, task: Task, joints: Sequence[str], noise: Noise, rng: np.random.Generator, robot: str
) -> Trial:
    """The trial as its noisy sensors tell it; after a fall nothing is recorded.

    Parameters
    ----------
    played : what happened.
    task : which.
    joints : that are commanded, (j,).
    noise, rng : of the sensors.
    robot : its name, for the log.
    """
    (reached,), (down,) = judged(task, played.motion)
    log = _log(played, task, joints, noise, rng, robot)
    fitness = float(reached) + noise.fitness * rng.normal()
    if down.any():
        # what lies on the ground is hardly informative: the recording stops there
        return Trial(log.window(0, max(int(np.argmax(down)), 2)), fitness, "fallen")
    return Trial(log, fitness, "done")


def _log(played: Played, task: Task, joints: Sequence[str], noise: Noise, rng: np.random.Generator, robot: str) -> Log:
    motion, sensors = played.motion, played.sensors
    seen = motion.position[0][:, [motion.joints.index(joint) for joint in joints]]
    n, seen = len(seen), seen + noise.encoder * rng.normal(size=seen.shape)
    if noise.step > 0:
        seen = np.round(seen / noise.step) * noise.step
    channels = {f"command.{joint}": played.command[:, i] for i, joint in enumerate(joints)}
    channels |= {f"position.{joint}": seen[:, i] for i, joint in enumerate(joints)}
    if motion.base is not None:
        for name, sigma in (("gyro", noise.gyro), ("acc", noise.acc)):
            if name in sensors:
                values = sensors[name] + sigma * rng.normal(size=(n, 3))
                channels |= {f"imu.{name}_{axis}": values[:, i] for i, axis in enumerate("xyz")}
        roll, pitch = _tilt(motion.base[0, :, 3:7])
        channels["imu.angle_x"] = roll + noise.angle * rng.normal(size=n)
        channels["imu.angle_y"] = pitch + noise.angle * rng.normal(size=n)
    channels |= {f"force.{k.removeprefix('force_')}": v[:, 0] for k, v in sensors.items() if k.startswith("force_")}
    mount: Literal["fixed", "free"] = "fixed" if motion.base is None else "free"
    meta = LogMeta(robot=robot, mount=mount, sample_period=task.period, source="hidden simulation")
    return Log(task.time, channels, meta, np.zeros(n, dtype=np.int64))


def _tilt(q: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Roll and pitch, (n,) each, of quaternions (n, 4), scalar first."""
    w, x, y, z = q.T
    roll = np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    pitch = np.arcsin(np.clip(2 * (w * y - z * x), -1.0, 1.0))
    return roll, pitch
