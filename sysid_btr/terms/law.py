"""Laws of terms: what acts at every step of a simulation, for one candidate, in the Python that numba compiles.

A law is a static method of its term. It runs between the steps of compiled code, so it may use numbers, arrays, `math`,
numpy's functions of scalars, and plain functions of its own module that are marked by `used_in_laws`. Machine code is
kept beside a law's source: after a change of this file, which all of them use, `make clean`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple, TypeVar

from sysid_btr._typing import FloatArray, IntArray

Function = TypeVar("Function", bound=Callable[..., object])


class Step(NamedTuple):
    """What a law sees, and adds to, at one step of one candidate; arrays are (joints of the log,).

    Attributes
    ----------
    time : s since the first sample of the log, in the middle of the step.
    timestep : s.
    command : as it reaches the drives.
    qpos, qvel : of the motor side, extrapolated to the middle of the step, which makes a law that is held over the step
        second-order accurate.
    torque : of the plain servo there.
    proportional : the part of it that a position servo's stiffness gives.
    load : torque by which gravity and the motion of the links load the joint, as of the last step.
    voltage, enabled : measured inputs of the drive; a voltage that is not logged is not a number, and a drive without
        flags is enabled.
    gain, motor_torque, joint_torque, friction : 1 and 0 at first. Laws multiply the gain and add to the others.
    limit_low, limit_high : of the servo's torque, which laws narrow.
    """

    time: float
    timestep: float
    command: FloatArray
    qpos: FloatArray
    qvel: FloatArray
    torque: FloatArray
    proportional: FloatArray
    load: FloatArray
    voltage: FloatArray
    enabled: FloatArray
    gain: FloatArray
    motor_torque: FloatArray
    joint_torque: FloatArray
    friction: FloatArray
    limit_low: FloatArray
    limit_high: FloatArray


ROWS = len(Step._fields) - 2
"""Arrays of a step."""

Law = Callable[[Step, FloatArray, FloatArray, IntArray], None]
"""Acts on a step by its numbers (rows, n), its memory (rows, kept) and the positions of its places among the joints.

With a row for each place it acts on each by what is there alone.
"""


def used_in_laws(function: Function) -> Function:
    """Mark a plain function as one that laws of its module may call."""
    function.used_in_laws = True  # type: ignore[attr-defined]
    return function


@used_in_laws
def drive(step: Step, joint: int) -> float:
    """The servo's torque at a joint under what other laws have done to it so far."""
    total = step.gain[joint] * step.torque[joint] + step.motor_torque[joint]
    return float(min(max(total, step.limit_low[joint]), step.limit_high[joint]))
