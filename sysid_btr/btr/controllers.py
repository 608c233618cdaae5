"""Controllers: points of a space, each of which says what every joint is commanded at any time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from sysid_btr._typing import FloatArray
from sysid_btr.btr.own_code import blamed
from sysid_btr.errors import UsageError
from sysid_btr.io.log import Log, LogMeta, with_hint
from sysid_btr.models.pose import resting
from sysid_btr.models.robot import Robot, joint_names, servo_joints


class ControllerSpace(Protocol):
    """The space of controllers that is searched (C in the paper).

    Bounds are finite, and `start` lies within them.
    """

    @property
    def names(self) -> tuple[str, ...]:
        """Names of a controller's numbers, length ``p``."""
        ...

    @property
    def lower(self) -> FloatArray:
        """Lower bounds, (p,)."""
        ...

    @property
    def upper(self) -> FloatArray:
        """Upper bounds, (p,)."""
        ...

    @property
    def start(self) -> FloatArray:
        """The controller known beforehand (c_0), (p,)."""
        ...

    @property
    def joints(self) -> tuple[str, ...]:
        """Joints that are commanded."""
        ...

    def commands(self, values: FloatArray, time: FloatArray) -> FloatArray:
        """Commands (m, n, joints) of controllers (m, p) at times (n,) s since the start, rad.

        All NaN for a controller that cannot be played; the first one is a pose in which the robot can stand.
        """
        ...


@dataclass(frozen=True, eq=False)
class Controller:
    """One controller.

    Attributes
    ----------
    values : (p,) of a controller space.
    label : names it on disk.
    """

    values: FloatArray
    label: str = ""


def commanded_joints(robot: Robot) -> tuple[str, ...]:
    """Joints with a position servo, to which commands go.

    Raises
    ------
    UsageError
        If it has none.
    """
    joints = servo_joints(robot)
    if not joints:
        raise UsageError(
            f"model {robot.name} has no position servo, to which a controller's commands would go; --servo puts servos "
            "on its joints"
        )
    return joints


def rest_of(robot: Robot, joints: Sequence[str]) -> FloatArray:
    """(j,) where joints of a robot are before anything is commanded: in `Robot.at`, its first keyframe, or at zero."""
    return resting(robot, Log(np.zeros(1), {}, LogMeta(robot=robot.name), np.zeros(1, dtype=np.int64)), joints)


def check_space(space: ControllerSpace, robot: Robot, time: FloatArray) -> None:
    """Whether a controller space is one, and of this robot.

    Parameters
    ----------
    time : (n,) s, of a trial.

    Raises
    ------
    UsageError
        Naming what is wrong.
    """
    lower, upper, start = (np.asarray(x, dtype=np.float64) for x in (space.lower, space.upper, space.start))
    p, called = len(space.names), f"controllers {type(space).__name__}"
    for name, values in (("lower", lower), ("upper", upper), ("start", start)):
        if values.shape != (p,) or not np.isfinite(values).all():
            raise UsageError(f"{called}: `{name}` is to hold {p} finite numbers, one for each of `names`")
    if not (np.all(lower < upper) and np.all(lower <= start) and np.all(start <= upper)):
        raise UsageError(f"{called}: every lower bound is to be below its upper one, and `start` within them")
    there = joint_names(robot)
    for joint in space.joints:
        if joint not in there:
            raise UsageError(f"{called}: model {robot.name} has no joint {with_hint(joint, there)}")
    with blamed(called):
        found = np.asarray(space.commands(start[None], time))
    if found.shape != (1, len(time), len(space.joints)):
        raise UsageError(
            f"{called}: the commands of one controller at {len(time)} times have the shape {found.shape}; wanted are "
            f"(controllers, times, joints), here {(1, len(time), len(space.joints))}"
        )
    if not np.isfinite(found).all():
        raise UsageError(f"{called}: the commands of `start`, the controller known beforehand, are not all finite")
