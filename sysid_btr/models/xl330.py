"""A pendulum on a Dynamixel XL330-M288 hobby servo.

Declared: the pendulum, the firmware's law and the torque that the data sheet promises for a voltage.
Not declared, and there to be found: back-EMF, friction, armature.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from sysid_btr._typing import FloatArray, IntArray
from sysid_btr.errors import LogError
from sysid_btr.models.robot import Robot, robot_from_spec
from sysid_btr.terms.base import Term
from sysid_btr.terms.law import Step

if TYPE_CHECKING:
    import mujoco

    from sysid_btr.io.log import Log

JOINT = "pendulum"
TICKS = 4096 / (2 * math.pi)
"""Encoder ticks per rad."""
KP_DIVISOR = 256
"""By which the firmware divides its kp register."""
PWM_LIMIT = 885
"""PWM register at full duty."""
TORQUE_PER_VOLT = 0.52 / 5.0
"""Nm/V at stall: 0.52 Nm at 5.0 V (ROBOTIS e-manual, XL330-M288-T, specifications)."""


@dataclass(frozen=True)
class Setup:
    """What a log's metadata states: kp register, pendulum (kg, m) and nominal supply (V)."""

    kp_register: float = 400.0
    mass: float = 0.49
    length: float = 0.10
    supply: float = 7.4

    @property
    def duty_per_rad(self) -> float:
        """Firmware law: duty = clip(duty_per_rad * (command - position), -1, 1)."""
        return self.kp_register * TICKS / KP_DIVISOR / PWM_LIMIT


@dataclass(frozen=True)
class Supply(Term):
    """Servo torque in proportion to the measured supply voltage, and none while the torque is off.

    A log without voltage is taken at the nominal supply, one without flags as always on.
    """

    nominal: float = 7.4

    name: ClassVar[str] = "supply"
    switches: ClassVar[bool] = True

    def law_numbers(self, values: FloatArray) -> FloatArray:
        return np.full((len(values), len(self.places), 1), self.nominal)

    @staticmethod
    def law(step: Step, numbers: FloatArray, memory: FloatArray, places: IntArray) -> None:
        for p, j in enumerate(places):
            logged = not math.isnan(step.voltage[j])
            ratio = (step.voltage[j] / numbers[p, 0] if logged else 1.0) * step.enabled[j]
            step.gain[j] *= ratio
            step.limit_low[j] *= ratio
            step.limit_high[j] *= ratio


def xl330() -> Robot:
    """The pendulum of 0.49 kg at 0.1 m that hangs at zero; `Robot.for_log` reads the log's own set-up."""
    return _robot(Setup())


def _robot(setup: Setup) -> Robot:
    robot = robot_from_spec("xl330", partial(_make_spec, setup))
    return replace(robot, always=(Supply(places=(JOINT,), nominal=setup.supply),), configure=_configure)


def _configure(robot: Robot, log: Log) -> Robot:
    extra = log.meta.extra
    servo, pendulum = _table(log, "servo"), _table(log, "pendulum")
    stated = {
        "kp_register": servo.get("kp_register"),
        "mass": pendulum.get("mass"),
        "length": pendulum.get("length"),
        "supply": extra.get("supply_nominal"),
    }
    numbers: dict[str, float] = {}
    for name, value in stated.items():
        if value is None:
            continue
        if isinstance(value, bool) or not isinstance(value, int | float) or not 0 < value < float("inf"):
            raise LogError(
                f"log {log.path or ''}: metadata {name} is {value!r}; the xl330 needs a positive number "
                "(servo.kp_register, pendulum.mass in kg, pendulum.length in m, supply_nominal in V)"
            )
        numbers[name] = float(value)
    return _robot(Setup(**numbers))


def _table(log: Log, key: str) -> Mapping[str, Any]:
    table = log.meta.extra.get(key, {})
    if not isinstance(table, Mapping):
        raise LogError(f"log {log.path or ''}: metadata {key!r} is {table!r}; expected a table of numbers")
    return table


def _make_spec(setup: Setup) -> mujoco.MjSpec:
    import mujoco

    spec = mujoco.MjSpec()
    spec.modelname = "xl330"
    spec.option.timestep = 0.001
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_RK4
    body = spec.worldbody.add_body(name=JOINT)
    body.add_joint(name=JOINT, type=mujoco.mjtJoint.mjJNT_HINGE, axis=[0.0, 1.0, 0.0])
    radius = 0.02
    body.add_geom(
        type=mujoco.mjtGeom.mjGEOM_SPHERE,
        size=[radius, 0.0, 0.0],
        pos=[0.0, 0.0, -setup.length],
        contype=0,
        conaffinity=0,
    )
    # a point mass, as declared; MuJoCo only wants a moving body's own inertia to be positive
    body.explicitinertial = True
    body.mass = setup.mass
    body.ipos = [0.0, 0.0, -setup.length]
    body.inertia = [1e-9, 1e-9, 1e-9]
    stall = TORQUE_PER_VOLT * setup.supply
    servo = spec.add_actuator(name=JOINT, target=JOINT, trntype=mujoco.mjtTrn.mjTRN_JOINT)
    servo.set_to_position(kp=stall * setup.duty_per_rad)
    servo.forcelimited = mujoco.mjtLimited.mjLIMITED_TRUE
    servo.forcerange = [-stall, stall]
    spec.add_sensor(
        name=f"position_{JOINT}",
        type=mujoco.mjtSensor.mjSENS_JOINTPOS,
        objtype=mujoco.mjtObj.mjOBJ_JOINT,
        objname=JOINT,
    )
    return spec
