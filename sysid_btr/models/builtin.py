"""Robots by name: the built-in ones, and any file."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from sysid_btr.errors import ModelError
from sysid_btr.models.actuation import Servo, with_motors, with_servos
from sysid_btr.models.ant import ant
from sysid_btr.models.emps import emps
from sysid_btr.models.nao import nao, nao_table1
from sysid_btr.models.robot import Robot, robot_from_file
from sysid_btr.models.xl330 import xl330

BUILTIN: dict[str, Callable[[], Robot]] = {
    "nao": nao,
    "nao:table1": nao_table1,
    "ant": ant,
    "emps": emps,
    "xl330": xl330,
}


def load_robot(name: str, servo: Servo | None = None) -> Robot:
    """A built-in robot by name, or any MJCF or URDF by path.

    Parameters
    ----------
    name : of a robot or a file.
    servo : for every joint without a servo of position or velocity; None leaves joints as they are, and those of a URDF
        without actuators get torque motors.

    Raises
    ------
    ModelError
        Unknown name, missing file, or a file that MuJoCo cannot read.
    """
    robot = _found(name)
    if servo is not None:
        return with_servos(robot, servo)
    return robot if robot.drives_stated else with_motors(robot)


def _found(name: str) -> Robot:
    if name in BUILTIN:
        return BUILTIN[name]()
    path = Path(name)
    if not path.is_file():
        listing = ", ".join(sorted(BUILTIN))
        raise ModelError(
            f"model {name!r}: neither a built-in model ({listing}) nor an existing file. "
            "Give one of these names, or the path of an MJCF or URDF file."
        )
    return robot_from_file(path)
