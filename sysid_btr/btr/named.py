"""Tasks and controllers by name, and those of the user's own modules (``module:name``)."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from sysid_btr.btr.arm_motions import feed_forward, spline_motion
from sysid_btr.btr.controllers import ControllerSpace
from sysid_btr.btr.gaits import NaoGait, ant_gait, sine_gait
from sysid_btr.btr.own_code import load_own
from sysid_btr.btr.task import Reach, Task, Track, Walk
from sysid_btr.errors import UsageError
from sysid_btr.io.parquet import read_log
from sysid_btr.models.robot import Robot

DURATIONS, LONG, REACHING = {"ant": 3.0}, 8.0, 4.0
"""s of a walk by robot, and of any other; and of a trial that reaches a point."""
LONGEST = 3600.0
"""s of a trial."""
MOVING = 0.7
"""Share of a trial in which a spline comes to its end."""


@dataclass(frozen=True)
class Ready:
    """A task or controllers that the library has.

    Attributes
    ----------
    form : as it is asked for.
    make : of what follows the name, the robot, and the duration that was asked for (a task) or the task (controllers).
    """

    form: str
    make: Callable[[str, Robot, Any], Any]


def get_task(text: str, robot: Robot, duration: float | None = None) -> Task:
    """A task by name; empty is the walk.

    Parameters
    ----------
    text : ``walk``, ``reach:PLACE=X,Y,Z``, ``track:LOG``, or ``module:name``.
    robot : that is to do it.
    duration : of a trial, s; default the task's own.

    Raises
    ------
    UsageError
        If there is no such task, or the robot cannot do it.
    """
    if duration is not None and not 1 <= duration <= LONGEST:
        raise UsageError(f"--duration {duration:g}: a trial takes 1 to {LONGEST:g} s")
    kind, _, rest = (text or "walk").partition(":")
    if kind in TASKS:
        task: Task = TASKS[kind].make(rest, robot, duration)
    else:
        task = load_own(f"--task {text}", text, robot, _available(TASKS))
        if not isinstance(task, Task):
            raise UsageError(f"--task {text}: that is no task; derive it from sysid_btr.btr.task.Task")
        task = task if duration is None else replace(task, duration=duration)
    task.check(robot)
    return task


def get_space(text: str, robot: Robot, task: Task) -> ControllerSpace:
    """Controllers by name; empty are those of a built-in robot that walks, else what suits the task.

    Parameters
    ----------
    text : ``sine``, ``spline``, ``feedforward``, ``ant``, ``nao``, or ``module:name``.
    robot, task : for which.

    Raises
    ------
    UsageError
        If there are no such controllers, or they do not suit the robot.
    """
    name = text or _suiting(robot, task)
    kind, _, rest = name.partition(":")
    if kind in CONTROLLERS:
        found: ControllerSpace = CONTROLLERS[kind].make(rest, robot, task)
        return found
    own = load_own(f"--controllers {text}", text, robot, _available(CONTROLLERS))
    lacking = [part for part in ("names", "lower", "upper", "start", "joints", "commands") if not hasattr(own, part)]
    if lacking:
        raise UsageError(
            f"--controllers {text}: that is no controller space, it lacks {', '.join(lacking)}; see "
            "sysid_btr.btr.controllers.ControllerSpace"
        )
    space: ControllerSpace = own
    return space


def _suiting(robot: Robot, task: Task) -> str:
    """Controllers for a robot and a task where none are named."""
    walks = robot.name.partition(":")[0]
    if isinstance(task, Walk) and walks in CONTROLLERS:
        return walks
    return next((name for kind, name in SUITING if isinstance(task, kind)), "spline")


def _available(ready: Mapping[str, Ready]) -> str:
    return f"{', '.join(r.form for r in ready.values())}, or MODULE:NAME of your own"


def _walk(_rest: str, robot: Robot, duration: float | None) -> Task:
    return Walk(DURATIONS.get(robot.name, LONG) if duration is None else duration)


def _reach(rest: str, _robot: Robot, duration: float | None) -> Task:
    place, _, numbers = rest.rpartition("=")
    try:
        x, y, z = (float(number) for number in numbers.split(","))
    except ValueError:
        x = y = z = np.nan
    if not place or not np.isfinite([x, y, z]).all():
        raise UsageError(f"--task reach:{rest}: give a body or site, and where it is to come, m: reach:PLACE=X,Y,Z")
    return Reach(REACHING if duration is None else duration, place=place, point=(x, y, z))


def _track(rest: str, _robot: Robot, duration: float | None) -> Task:
    if not rest:
        raise UsageError("--task track: give the log whose motion is to be followed: track:FILE")
    log = read_log(Path(rest), check=False)  # commands alone will do
    if duration is not None:
        log = log.window(0, max(int(np.searchsorted(log.time, log.time[0] + duration + 1e-9)), 2))
    return Track.of_log(log)


def _feed_forward(_rest: str, robot: Robot, task: Task) -> ControllerSpace:
    if not isinstance(task, Track):
        raise UsageError("--controllers feedforward: these follow a motion; --task track:FILE names it")
    return feed_forward(robot, task.joints, task.wanted, task.period)


TASKS: Mapping[str, Ready] = {
    "walk": Ready("walk", _walk),
    "reach": Ready("reach:PLACE=X,Y,Z", _reach),
    "track": Ready("track:FILE", _track),
}
CONTROLLERS: Mapping[str, Ready] = {
    "sine": Ready("sine", lambda _rest, robot, _task: sine_gait(robot)),
    "spline": Ready("spline", lambda _rest, robot, task: spline_motion(robot, MOVING * task.duration)),
    "feedforward": Ready("feedforward", _feed_forward),
    "ant": Ready("ant", lambda _rest, _robot, _task: ant_gait()),
    "nao": Ready("nao", lambda _rest, _robot, _task: NaoGait()),
}
SUITING: tuple[tuple[type[Task], str], ...] = ((Walk, "sine"), (Track, "feedforward"))
"""Controllers for a task, where none are named; splines for any other."""
