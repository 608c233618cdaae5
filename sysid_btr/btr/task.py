"""What a robot is to do, and how well it did: walk, follow a motion, reach a point, or a task of one's own."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from hashlib import sha256
from typing import ClassVar

import numpy as np

from sysid_btr._typing import BoolArray, FloatArray
from sysid_btr.btr.own_code import blamed
from sysid_btr.errors import LogError, UsageError
from sysid_btr.io._text import some
from sysid_btr.io.log import Log, with_hint
from sysid_btr.io.resample import command_at, resample
from sysid_btr.models.robot import Robot, joint_names
from sysid_btr.mujoco_conventions import free_joints, place_names
from sysid_btr.units import after_number

TIPPED = 0.5
"""Cosine of the angle between the base's and the world's vertical below which a robot has fallen."""
FASTEST = 100.0
"""m/s, beyond which a speed is a mistake: three times as fast as any animal runs."""


@dataclass(frozen=True, eq=False)
class Motion:
    """What robots did in trials, at the task's samples.

    Attributes
    ----------
    joints, position : names of joints, (j,), and where they were, (m, n, j), rad or m.
    base : (m, n, 13) of a free base as in `Outputs.base`; None of a fixed one.
    places : of what the task watches, (m, n, 3), m in the world, by the name of its body or site.
    """

    joints: tuple[str, ...]
    position: FloatArray
    base: FloatArray | None = None
    places: Mapping[str, FloatArray] = field(default_factory=dict)


@dataclass(frozen=True)
class Task(ABC):
    """Base: what a robot is to do. A task of one's own has `goal`, `unit` and `fitness`, and the rest where it differs.

    The fitness is the larger the better, and about zero for a robot that stays as it is.

    Attributes
    ----------
    duration : of a trial, s (the paper's T_e).
    period : of samples and commands, s.

    Class attributes
    ----------------
    goal, unit : what the fitness is, in words, and its unit; ``1`` for a fraction.
    plausible : lowest and highest fitness that a real robot's trial can have.
    """

    goal: ClassVar[str] = "fitness of the task"
    unit: ClassVar[str] = "1"
    plausible: ClassVar[tuple[float, float]] = (-np.inf, np.inf)

    duration: float = 8.0
    period: float = 0.02

    @cached_property
    def time(self) -> FloatArray:
        """(n,) s."""
        return self.period * np.arange(round(self.duration / self.period) + 1, dtype=np.float64)

    @property
    def watched(self) -> tuple[str, ...]:
        """Bodies or sites whose places the fitness needs."""
        return ()

    @property
    def falls(self) -> bool:
        """Whether there is anything that must not happen."""
        return type(self).fallen is not Task.fallen

    @property
    def fingerprint(self) -> str:
        """All that decides what is asked of a robot."""
        return repr(self)

    def in_words(self, fitness: float, digits: int = 4) -> str:
        """A fitness with its unit."""
        return f"{fitness:.{digits}g}{after_number(self.unit, 0.0)}"

    def check(self, robot: Robot) -> None:
        """Whether a robot can do this at all.

        Raises
        ------
        UsageError
            Naming what it lacks.
        """
        there = place_names(robot.model)
        for name in self.watched:
            if name not in there:
                raise UsageError(
                    f"model {robot.name} has no body or site {with_hint(name, there)}; it has {some(there, 12)}"
                )

    def fallen(self, motion: Motion) -> BoolArray:
        """(m, n) whether a run has fallen by each sample, or done else what must not happen; here none ever has."""
        return np.zeros(motion.position.shape[:2], dtype=bool)

    @abstractmethod
    def fitness(self, motion: Motion) -> FloatArray:
        """(m,) of runs; NaN of one that diverged, all of whose numbers are NaN."""


@dataclass(frozen=True)
class Walk(Task):
    """Walk forward: the fitness is the mean speed along the heading at the start, m/s, up to a fall."""

    goal: ClassVar[str] = "mean forward speed"
    unit: ClassVar[str] = "m/s"
    plausible: ClassVar[tuple[float, float]] = (-FASTEST, FASTEST)

    duration: float = 3.0

    def check(self, robot: Robot) -> None:
        if len(free_joints(robot.model)) != 1:
            raise UsageError(
                f"model {robot.name}: {len(free_joints(robot.model))} free joints; a robot that walks has one, at its "
                "base. One whose base is fixed may reach a point or track a motion (--task)"
            )
        super().check(robot)

    def fallen(self, motion: Motion) -> BoolArray:
        base = _base(motion)
        upright = 1 - 2 * (base[..., 4] ** 2 + base[..., 5] ** 2)
        return np.logical_or.accumulate(upright < TIPPED, axis=1)

    def fitness(self, motion: Motion) -> FloatArray:
        base, down = _base(motion), self.fallen(motion)
        last = np.where(down.any(axis=1), np.argmax(down, axis=1), base.shape[1] - 1)
        rows = np.arange(len(base))
        return np.asarray((base[rows, last, 0] - base[:, 0, 0]) / self.duration)


@dataclass(frozen=True)
class Reach(Task):
    """Bring a body or a site to a point: the fitness is by how much it is nearer in the end, m.

    Attributes
    ----------
    place : the body or site.
    point : where it is to come, m in the world.
    held : fraction of the trial, at its end, whose mean distance counts.
    """

    goal: ClassVar[str] = "distance gained towards the point"
    unit: ClassVar[str] = "m"

    place: str = ""
    point: tuple[float, float, float] = (0.0, 0.0, 0.0)
    held: float = 0.2

    @property
    def watched(self) -> tuple[str, ...]:
        return (self.place,)

    def fitness(self, motion: Motion) -> FloatArray:
        away = np.linalg.norm(motion.places[self.place] - np.array(self.point), axis=2)
        last = max(round(self.held * away.shape[1]), 1)
        return np.asarray(away[:, 0] - away[:, -last:].mean(axis=1))


@dataclass(frozen=True)
class Track(Task):
    """Follow a motion of the joints: the fitness is the share of it that is followed, 1 where nothing is amiss.

    Its error and its size, the way from where it begins, are root mean squares over joints and samples.

    Attributes
    ----------
    joints : that are to follow, (j,).
    wanted : (n, j) at the task's samples, rad or m.
    """

    goal: ClassVar[str] = "share of the motion that is followed"
    plausible: ClassVar[tuple[float, float]] = (-np.inf, 1.0)

    joints: tuple[str, ...] = ()
    wanted: FloatArray = field(default_factory=lambda: np.zeros((0, 0)), repr=False, compare=False)

    @classmethod
    def of_log(cls, log: Log, *, period: float = 0.02) -> Track:
        """The motion that a log commands, or where it commands none the one that it shows.

        Raises
        ------
        LogError
            If it is no single motion, shows a joint not all the time, or nothing moves in it.
        """
        called, even = f"log {log.path or ''}", resample(log, period)
        if len(log.episodes()) > 1:
            raise LogError(
                f"{called}: it holds {len(log.episodes())} episodes, and a trial has one motion; save one of them"
            )
        joints = log.joints("command") or log.joints("position")
        wanted = command_at(log, joints, even.time) if log.joints("command") else even.array("position", joints)
        unknown = [joint for k, joint in enumerate(joints) if not np.isfinite(wanted[:, k]).all()]
        if unknown:
            raise LogError(
                f"{called}: {some(unknown)} has positions missing, or gaps, so that it shows no motion to track"
            )
        if not joints or np.ptp(wanted, axis=0).max() == 0:
            raise LogError(f"{called}: no joint moves in it, so that there is nothing to track")
        return cls(period * (len(even) - 1), period, joints, wanted)

    @property
    def fingerprint(self) -> str:
        return f"{self!r}, {sha256(np.ascontiguousarray(self.wanted).tobytes()).hexdigest()}"

    def check(self, robot: Robot) -> None:
        there = joint_names(robot)
        strange = [joint for joint in self.joints if joint not in there]
        if strange:
            raise UsageError(f"model {robot.name} has no joint {some(strange)}, which the motion moves")
        super().check(robot)

    def fitness(self, motion: Motion) -> FloatArray:
        own = motion.position[:, :, [motion.joints.index(joint) for joint in self.joints]]
        error = np.sqrt(np.mean((own - self.wanted) ** 2, axis=(1, 2)))
        return np.asarray(1 - error / np.sqrt(np.mean((self.wanted - self.wanted[0]) ** 2)))


def judged(task: Task, motion: Motion) -> tuple[FloatArray, BoolArray]:
    """Fitness (m,) of motions, and whether each has fallen by each sample, (m, n).

    A simulation that diverged has no fitness (NaN), whatever the task makes of it.

    Raises
    ------
    UsageError
        If a task fails, or does not give one fitness for each motion.
    """
    with blamed(f"task {type(task).__name__}"):
        found, fallen = np.asarray(task.fitness(motion), dtype=np.float64), task.fallen(motion)
    if found.shape != (len(motion.position),):
        raise UsageError(
            f"task {type(task).__name__}: its fitness of {len(motion.position)} motions has the shape {found.shape}; "
            f"one number for each motion is wanted, ({len(motion.position)},)"
        )
    return np.where(np.isfinite(motion.position).all(axis=(1, 2)), found, np.nan), fallen


def _base(motion: Motion) -> FloatArray:
    if motion.base is None:
        raise ValueError("a robot whose base is fixed does not walk")
    return motion.base
