"""A recording of a floating base up to a fall, and the motion of its base."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sysid_btr.errors import LogError
from sysid_btr.floating_base.estimate import BaseState, estimate_base
from sysid_btr.floating_base.segments import FASTEST
from sysid_btr.io.log import Log
from sysid_btr.models.robot import Robot
from sysid_btr.simulation.compiling import compile_model, make_index
from sysid_btr.simulation.numerics import Numerics

MOST_WALKED = 8.0
"""s of a Nao (`BodySize`): of a walk on which hypotheses about it are compared."""


def reconstruct(robot: Robot, log: Log) -> tuple[Log, BaseState]:
    """One episode up to where the robot falls, and the motion of its base.

    Raises
    ------
    LogError, ModelError
        If the base cannot be reconstructed.
    """
    return log.once(("base", robot.fingerprint, robot.at), lambda: _reconstruct(robot, log))


def _reconstruct(robot: Robot, log: Log) -> tuple[Log, BaseState]:
    robot = robot.for_log(log)
    model = compile_model(robot, log, robot.always, Numerics("RK4", FASTEST))
    index = make_index(model)
    base = estimate_base(model, log, index.joints, index.qpos)
    stop = len(log)
    if any(e.kind == "fall" for e in base.events):
        stop = int(np.flatnonzero(base.usable)[-1]) + 1 if base.usable.any() else 0
    if stop < 2:
        raise LogError(f"log {log.path or ''}: nothing of it can be used: {', '.join(map(str, base.events))}")
    if stop < len(log):
        # what comes after a fall must not reach back through the smoother
        events = base.events
        base = estimate_base(model, log.window(0, stop), index.joints, index.qpos)
        base = replace(base, events=events)
    return log.window(0, stop), base
