"""Random effects of realistic size, and the motions on which each of them can show."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from reference_simulator import effects as planted

if TYPE_CHECKING:
    from numpy.random import Generator
    from numpy.typing import NDArray

    from reference_simulator.effects import Effect
    from reference_simulator.robot import Robot

    Array = NDArray[np.float64]
    Names = tuple[str, ...]


@dataclass(frozen=True)
class Stage:
    """The robot without the effect, on one motion.

    Attributes
    ----------
    robot : nominal.
    seconds : length of the log.
    torque_rms, torque_peak, speed_peak : of each joint (n,), SI.
    centre, spread : mean and standard deviation of each joint's position (n,), rad.
    """

    robot: Robot
    seconds: float
    torque_rms: Array
    torque_peak: Array
    speed_peak: Array
    centre: Array
    spread: Array

    def least(self, values: Array, where: Names) -> float:
        """Smallest of `values` at a few joints; the median of many."""
        own = values[self.robot.indices(where)]
        return float(own.min() if own.size < 4 else np.median(own))


Draw = Callable[["Generator", Stage, "Names"], "Effect"]


@dataclass(frozen=True)
class Recipe:
    """How one effect is drawn.

    Attributes
    ----------
    draw : size at given places.
    motions : on which it can show.
    everywhere : whether it may sit at all joints.
    scope : ``joint``, ``body``, ``robot``, or ``two`` joints.
    effort : whether a log of positions alone cannot tell it from something else: effort is logged half the time.
    drive : ``servo`` or ``motor`` if it can only be on a robot with such drives.
    """

    draw: Draw
    motions: Names
    everywhere: bool = False
    scope: str = "joint"
    effort: bool = False
    drive: str = ""


def log_uniform(rng: Generator, low: float, high: float) -> float:
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def either_sign(rng: Generator, low: float, high: float) -> float:
    return float(rng.choice([-1.0, 1.0]) * rng.uniform(low, high))


def _stribeck(rng: Generator, stage: Stage, where: Names) -> Effect:
    coulomb = rng.uniform(0.05, 0.2)
    static = coulomb + rng.uniform(0.1, 0.3)
    return planted.StribeckFriction(where=where, coulomb=coulomb, static=static, velocity=rng.uniform(0.1, 0.6))


def _speed_torque(rng: Generator, stage: Stage, where: Names) -> Effect:
    stall = rng.uniform(0.6, 0.95) * stage.least(stage.torque_peak, where)
    speed = rng.uniform(1.0, 1.8) * stage.least(stage.speed_peak, where)
    return planted.SpeedTorqueLimit(where=where, stall=stall, no_load_speed=speed)


def _sag(rng: Generator, stage: Stage, where: Names) -> Effect:
    if rng.random() < 0.5:
        return planted.VoltageSag(rate=rng.uniform(0.01, 0.03))
    share = rng.uniform(0.15, 0.3) / float(stage.torque_rms.sum())
    return planted.VoltageSag(rate=0.0, per_torque=share, lag=0.01)


def _thermal(rng: Generator, stage: Stage, where: Names) -> Effect:
    alpha = rng.uniform(0.15, 0.4) / stage.least(stage.torque_rms, where) ** 2
    return planted.ThermalDerating(where=where, alpha=alpha, time_constant=rng.uniform(4.0, 20.0))


def across(rng: Generator, stage: Stage, body: str, length: float) -> tuple[float, float, float]:
    """A random lever across the axis of the body's joint: along the axis it shows little or nothing."""
    axis = stage.robot.axes[stage.robot.body(body).joints[0]]
    direction = rng.normal(size=3)
    direction -= axis * (direction @ axis)
    x, y, z = length * direction / np.linalg.norm(direction)
    return float(x), float(y), float(z)


def _payload(rng: Generator, stage: Stage, where: Names) -> Effect:
    offset = across(rng, stage, where[0], rng.uniform(0.03, 0.08))
    return planted.Payload(where=where, mass=rng.uniform(0.08, 0.3), offset=offset)


def _com_offset(rng: Generator, stage: Stage, where: Names) -> Effect:
    return planted.ComOffset(where=where, offset=across(rng, stage, where[0], rng.uniform(0.01, 0.03)))


def _push(rng: Generator, stage: Stage, where: Names) -> Effect:
    start = rng.uniform(0.2, 0.6) * stage.seconds
    return planted.ExternalDisturbance(
        where=where, torque=either_sign(rng, 0.5, 2.0), start=start, duration=rng.uniform(0.1, 0.4)
    )


def _patch(rng: Generator, stage: Stage, where: Names) -> Effect:
    j = stage.robot.indices(where)[0]
    centre = stage.centre[j] + rng.uniform(-0.8, 0.8) * stage.spread[j]
    return planted.FrictionPatch(
        where=where, torque=rng.uniform(0.4, 0.9), centre=float(centre), width=rng.uniform(0.05, 0.12)
    )


SMOOTH = ("multisine", "poses", "gait")
SHARP = ("steps", "chirp", "multisine")
TIMED = ("multisine", "poses", "steps", "chirp")

LIBRARY: dict[str, Recipe] = {
    "coulomb_friction": Recipe(
        lambda r, s, w: planted.CoulombFriction(where=w, torque=log_uniform(r, 0.08, 0.35)),
        ("multisine", "poses", "triangles", "gait"),
    ),
    "viscous_damping": Recipe(
        lambda r, s, w: planted.ViscousDamping(where=w, coefficient=log_uniform(r, 0.05, 0.3)),
        ("multisine", "chirp", "steps"),
        effort=True,
    ),
    "quadratic_damping": Recipe(
        lambda r, s, w: planted.QuadraticDamping(where=w, coefficient=log_uniform(r, 0.02, 0.12)), SHARP
    ),
    "stribeck_friction": Recipe(_stribeck, ("triangles", "poses", "multisine")),
    "load_friction": Recipe(
        lambda r, s, w: planted.LoadFriction(where=w, coefficient=r.uniform(0.1, 0.35)), SMOOTH, everywhere=True
    ),
    "armature": Recipe(
        lambda r, s, w: planted.Armature(where=w, inertia=log_uniform(r, 0.004, 0.02)), SHARP, everywhere=True
    ),
    "command_delay": Recipe(
        lambda r, s, w: planted.CommandDelay(where=w, delay=r.uniform(0.01, 0.04)), TIMED, everywhere=True
    ),
    "sensor_delay": Recipe(
        lambda r, s, w: planted.SensorDelay(where=w, delay=r.uniform(0.008, 0.03)), TIMED, everywhere=True, effort=True
    ),
    "backlash": Recipe(
        lambda r, s, w: planted.Backlash(where=w, play=r.uniform(0.01, 0.05), motor_damping=float(r.integers(2))),
        ("triangles", "multisine", "poses", "gait"),
    ),
    "joint_compliance": Recipe(
        lambda r, s, w: planted.JointCompliance(
            where=w, stiffness=log_uniform(r, 15.0, 120.0), motor_damping=float(r.integers(2))
        ),
        SHARP,
    ),
    "joint_spring": Recipe(
        lambda r, s, w: planted.JointSpring(where=w, stiffness=log_uniform(r, 0.5, 4.0), rest=r.uniform(-0.5, 0.5)),
        ("multisine", "poses"),
    ),
    "encoder_offset": Recipe(
        lambda r, s, w: planted.EncoderOffset(where=w, offset=either_sign(r, 0.01, 0.06)),
        ("multisine", "poses", "steps"),
        effort=True,
    ),
    "encoder_scale": Recipe(
        lambda r, s, w: planted.EncoderScale(where=w, scale=1.0 + either_sign(r, 0.02, 0.08)),
        ("multisine", "poses", "steps"),
    ),
    "torque_limit": Recipe(
        lambda r, s, w: planted.TorqueLimit(where=w, limit=r.uniform(0.4, 0.75) * s.least(s.torque_peak, w)), SHARP
    ),
    "speed_torque_limit": Recipe(_speed_torque, SHARP),
    "slew_limit": Recipe(
        lambda r, s, w: planted.SlewLimit(where=w, rate=r.uniform(0.3, 0.7) * s.least(s.speed_peak, w)),
        SHARP,
        everywhere=True,
    ),
    "integral_gain": Recipe(
        lambda r, s, w: planted.IntegralGain(where=w, ki=log_uniform(r, 5.0, 40.0), limit=100.0),
        ("poses", "steps", "multisine"),
        everywhere=True,
    ),
    "voltage_sag": Recipe(_sag, ("multisine", "steps", "chirp"), scope="robot"),
    "thermal_derating": Recipe(_thermal, ("steps", "multisine", "gait")),
    "payload": Recipe(_payload, SMOOTH, scope="body"),
    "com_offset": Recipe(_com_offset, SMOOTH, scope="body"),
    "constant_force": Recipe(
        lambda r, s, w: planted.ConstantForce(where=w, torque=either_sign(r, 0.08, 0.3)), SMOOTH, effort=True
    ),
    "cogging": Recipe(
        lambda r, s, w: planted.Cogging(
            where=w, amplitude=r.uniform(0.05, 0.2), periods=r.uniform(8.0, 40.0), phase=r.uniform(0.0, 6.28)
        ),
        ("triangles", "multisine", "poses"),
    ),
    "external_disturbance": Recipe(_push, SMOOTH),
    "gravity_tilt": Recipe(
        lambda r, s, w: planted.GravityTilt(roll=either_sign(r, 0.02, 0.08), pitch=either_sign(r, 0.02, 0.08)),
        SMOOTH,
        scope="robot",
    ),
}

OUTSIDE: dict[str, Recipe] = {
    "gain_drift": Recipe(
        lambda r, s, w: planted.GainDrift(where=w, depth=r.uniform(0.15, 0.3), period=r.uniform(3.0, 9.0)),
        ("multisine", "gait", "chirp"),
    ),
    "friction_patch": Recipe(_patch, SMOOTH),
    "controller_dropout": Recipe(
        lambda r, s, w: planted.ControllerDropout(
            where=w, start=r.uniform(1.0, 2.0), duration=r.uniform(0.06, 0.15), every=r.uniform(1.2, 2.5)
        ),
        SMOOTH,
    ),
    "cable_coupling": Recipe(
        lambda r, s, w: planted.CableCoupling(where=w, stiffness=r.uniform(0.5, 2.0)),
        ("multisine", "poses"),
        scope="two",
    ),
    "random_walk_torque": Recipe(
        lambda r, s, w: planted.RandomWalkTorque(where=w, size=r.uniform(0.15, 0.4), correlation=r.uniform(0.5, 2.0)),
        SMOOTH,
    ),
}

ALIKE: tuple[frozenset[str], ...] = (
    frozenset({"command_delay", "sensor_delay"}),
    frozenset({"voltage_sag", "thermal_derating"}),
    frozenset({"gravity_tilt", "com_offset"}),
)
"""Two effects that are not planted together: the second would take its size from the first."""
