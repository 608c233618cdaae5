"""The robot as an interface: something that executes a controller and reports what happened."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, Protocol

import numpy as np

from sysid_btr._typing import FloatArray
from sysid_btr.btr.controllers import Controller, ControllerSpace
from sysid_btr.btr.task import Walk
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
    """Standard deviations of a hidden robot's sensors: encoders rad, and step of these; the base's speed m/s."""

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
    task: Walk
    space: ControllerSpace
    noise: Noise = SILENT
    seed: int = 0

    def run(self, controller: Controller) -> Trial:
        """Try a controller in the hidden simulation."""
        world = self.world
        commands = world.spread(self.space.joints, self.space.commands(controller.values[None], self.task.time))
        (_, outputs), *_ = world.run(commands, self.truth[None])
        assert outputs.base is not None
        if not np.isfinite(outputs.base).all():
            return Trial(None, 0.0, "crashed")
        rng = np.random.default_rng([self.seed, *np.ascontiguousarray(controller.values).view(np.uint32)])
        down = self.task.fallen(outputs.base)[0]
        sensors = world.sensors(outputs, commands[0], self.truth)
        log = self._log(outputs.base[0], outputs.position[0], commands[0], sensors, rng)
        fitness = float(self.task.fitness(outputs.base)[0]) + self.noise.fitness * rng.normal()
        if down.any():
            # what lies on the ground is hardly informative: the recording stops there
            return Trial(log.window(0, max(int(np.argmax(down)), 2)), fitness, "fallen")
        return Trial(log, fitness, "done")

    def _log(
        self,
        base: FloatArray,
        position: FloatArray,
        command: FloatArray,
        sensors: dict[str, FloatArray],
        rng: np.random.Generator,
    ) -> Log:
        world, noise, n = self.world, self.noise, len(position)
        joints = world.index.joints
        seen = position + noise.encoder * rng.normal(size=position.shape)
        if noise.step > 0:
            seen = np.round(seen / noise.step) * noise.step
        used = [joints.index(j) for j in self.space.joints]
        channels = {f"command.{joints[i]}": command[:, i] for i in used}
        channels |= {f"position.{joints[i]}": seen[:, i] for i in used}
        for name, sigma in (("gyro", noise.gyro), ("acc", noise.acc)):
            if name in sensors:
                values = sensors[name] + sigma * rng.normal(size=(n, 3))
                channels |= {f"imu.{name}_{axis}": values[:, i] for i, axis in enumerate("xyz")}
        roll, pitch = _tilt(base[:, 3:7])
        channels["imu.angle_x"] = roll + noise.angle * rng.normal(size=n)
        channels["imu.angle_y"] = pitch + noise.angle * rng.normal(size=n)
        channels |= {f"force.{k.removeprefix('force_')}": v[:, 0] for k, v in sensors.items() if k.startswith("force_")}
        meta = LogMeta(robot=world.robot.name, mount="free", sample_period=self.task.period, source="hidden simulation")
        return Log(self.task.time, channels, meta, np.zeros(n, dtype=np.int64))


def _tilt(q: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Roll and pitch, (n,) each, of quaternions (n, 4), scalar first."""
    w, x, y, z = q.T
    roll = np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    pitch = np.arcsin(np.clip(2 * (w * y - z * x), -1.0, 1.0))
    return roll, pitch
