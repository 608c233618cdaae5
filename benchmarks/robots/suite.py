"""The simulated robots: other drives than a humanoid's servos, each with one effect that its model lacks, or none."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from benchmarks.robots import machines as m
from benchmarks.robots.planted import DryFriction, Lag, Late, Load, Planted, Rotor, SensorOffset, Viscous
from benchmarks.robots.record import Experiment, Impedance, OwnControl, Positions, Torques, Velocities, record

if TYPE_CHECKING:
    from sysid_btr.io.log import Log

ARM3 = ("shoulder", "elbow", "wrist")
ARM6 = ("waist", "shoulder", "elbow", "forearm", "wrist", "flange")
LEG3 = ("roll", "hip", "knee")
HELD = Torques((150.0, 80.0, 15.0), (15.0, 8.0, 1.2), gear=40)
"""A controller of the arm's motors."""
KNEES = tuple(f"{leg}_knee" for leg in ("FL", "FR", "RL", "RR"))
WALKER = tuple(f"{leg}_{part}" for leg in ("FL", "FR", "RL", "RR") for part in ("hip", "knee"))
TROT = tuple(phase for leg in (0.0, np.pi, np.pi, 0.0) for phase in (leg, leg + 0.5 * np.pi))


@dataclass(frozen=True, eq=False)
class Case:
    """A robot, what it does, and what nobody declared.

    Attributes
    ----------
    name, title : of the case; what is special about its drive.
    model : MJCF that is to be diagnosed.
    experiment : what the robot does and what is logged.
    planted : what it has and the model has not.
    heavier : bodies whose mass is another one, as factors; masses are declared free.
    arguments : further ones of `close`.
    robot : MJCF of the robot where it differs from the model otherwise.
    alike : joints that are coupled, so that what is at one may as well be at any of them.
    """

    name: str
    title: str
    model: str
    experiment: Experiment
    planted: tuple[Planted, ...] = ()
    heavier: Mapping[str, float] = field(default_factory=dict)
    arguments: tuple[str, ...] = ()
    robot: str = ""
    alike: frozenset[str] = frozenset()

    def log(self) -> Log:
        """The recording; the same numbers every time."""
        return record(self.robot or self.model, self.experiment, self.planted, self.heavier)

    @property
    def truth(self) -> dict[str, Any]:
        """What is planted, for a file beside the log."""
        effects = [
            {"effect": p.effect, "where": list(p.where), "kind": p.kind, "amount": p.amount} for p in self.planted
        ]
        return {"effects": effects, "mass": dict(self.heavier)}


def arm(drive: Any, size: float = 0.7, **more: Any) -> Experiment:
    """An arm of three joints."""
    return Experiment(drive, ARM3, (0.3, 0.5, 0.0), (size, size, size), **more)


def cases() -> tuple[Case, ...]:
    """All of them."""
    return (
        Case(
            "torque_arm",
            "torque motors behind gears, Nm commanded",
            m.TORQUE_ARM,
            arm(HELD, rate=250, seed=1),
            (DryFriction(("elbow",), 0.5),),
            {"elbow_link": 1.15},
        ),
        Case(
            "torque_arm_clean",
            "the same, nothing missing",
            m.TORQUE_ARM,
            arm(HELD, rate=250, seed=2),
            heavier={"wrist_link": 1.2},
        ),
        Case(
            "velocity_arm",
            "velocity servos, rad/s commanded",
            m.VELOCITY_ARM,
            arm(Velocities(), rate=100, seed=3),
            (Late(ARM3, 0.03),),
        ),
        Case(
            "geared_arm",
            "position servos behind a gear of 50, joint rad commanded",
            m.GEARED_ARM,
            arm(Positions(50), seed=4),
            (DryFriction(("shoulder",), 1.5),),
            {"elbow_link": 1.2},
        ),
        Case(
            "geared_arm_load",
            "the same, with a load that nobody declared; only gains are free",
            m.GEARED_ARM,
            arm(Positions(50), seed=5),
            (Load(("wrist_link",), 0.35, (0.0, 0.0, -0.15)),),
            arguments=("--fit", "kp:*=shared", "--fit", "kv:*=shared"),
        ),
        Case(
            "geared_arm_clean",
            "the same, nothing missing",
            m.GEARED_ARM,
            arm(Positions(50), seed=6),
            heavier={"wrist_link": 1.15},
        ),
        Case(
            "tendon_gripper",
            "two fingers, coupled, closed by a tendon; 0..255 commanded",
            m.GRIPPER,
            Experiment(OwnControl(), ("grip",), (120.0,), (100.0,), seed=7, rate=100),
            (DryFriction(("left", "right"), 0.8, width=0.002),),
            alike=frozenset({"left", "right"}),
        ),
        Case(
            "coupled_finger",
            "last joint coupled to the one before, not logged",
            m.COUPLED_FINGER,
            Experiment(Positions(), ("mcp", "pip"), (0.5, 0.6), (0.5, 0.5), seed=8, rate=200, logged=("mcp", "pip")),
            (DryFriction(("mcp",), 0.02, width=0.02),),
        ),
        Case(
            "quadruped",
            "free base, IMU, no foot sensors",
            m.quadruped(),
            Experiment(
                Positions(),
                WALKER,
                (0.6, -1.2) * 4,
                (0.15, 0.2) * 4,
                seconds=10,
                rate=100,
                seed=9,
                free=True,
                imu=True,
                frequencies=(0.5, 1.6),
                stride=TROT,
            ),
            (DryFriction(KNEES, 0.8, width=0.02),),
        ),
        Case(
            "standing",
            "free base without an IMU, on its feet; 25 Hz",
            m.humanoid(),
            Experiment(
                Positions(),
                tuple(f"{side}_{part}" for side in ("left", "right") for part in m.HUMANOID),
                (-0.25, 0.5, -0.25, 0.2, -0.6) * 2,
                (0.0, 0.0, 0.0, 0.6, 0.5) * 2,
                seconds=30,
                rate=25,
                seed=18,
                free=True,
            ),
            (DryFriction(("left_shoulder",), 0.25),),
        ),
        Case(
            "hobby_servo",
            "a servo with a filter in its drive (dyntype)",
            m.HOBBY_SERVO,
            Experiment(Positions(), ("pendulum",), (0.3,), (0.9,), rate=100, seed=10),
            (DryFriction(("pendulum",), 0.12),),
        ),
        Case(
            "filtered_servos",
            "the robot's drives have a filter, the model's have none",
            m.SERVO_ARM,
            arm(Positions(), seed=11),
            (Lag(ARM3, 0.05),),
        ),
        Case(
            "limited_arm",
            "joints that hit their stops",
            m.LIMITED_ARM,
            Experiment(Positions(), ARM3, (0.0, 0.0, 0.0), (0.8, 0.9, 0.8), seed=12),
            (Viscous(("elbow",), 0.6),),
        ),
        Case(
            "three_of_six",
            "six joints, of which three are logged; the others stand where the log says",
            m.SIX_JOINTS,
            Experiment(
                Positions(),
                ("shoulder", "elbow", "wrist"),
                (0.4, 0.6, 0.3),
                (0.6, 0.6, 0.6),
                seed=13,
                logged=("shoulder", "elbow", "wrist"),
                start={"waist": 0.4, "forearm": 0.7, "flange": -0.5},
                meta={"at": {"waist": 0.4, "forearm": 0.7, "flange": -0.5}},
            ),
            (DryFriction(("elbow",), 1.2),),
        ),
        Case(
            "impedance_leg",
            "kp, kd and a torque fed forward",
            m.MIT_LEG,
            Experiment(
                Impedance(40, 1.5, np.array([2.0, 4.0, -1.5])), LEG3, (0.0, 0.3, -0.8), (0.3, 0.5, 0.6), seed=14
            ),
            (Rotor(("knee",), 0.02),),
        ),
        Case(
            "no_command",
            "positions and torques alone",
            m.BARE_ARM,
            arm(Positions(), seed=15, rate=500, effort=ARM3, silent=True, interpolated=True),
            (DryFriction(("shoulder", "elbow"), 0.8),),
            {"elbow_link": 1.2},
            robot=m.SERVO_ARM,
        ),
        Case(
            "torque_sensor",
            "torque sensors, one of which shows too much",
            m.SERVO_ARM,
            arm(Positions(), seed=16, effort=ARM3),
            (SensorOffset(("elbow",), 0.6),),
            {"elbow_link": 1.1},
        ),
        Case(
            "cart_pole",
            "a force on a cart, and a pole that nothing drives",
            m.CART_POLE,
            Experiment(Torques((40.0,), (10.0,)), ("rail",), (0.0,), (0.3,), seed=17, rate=250),
            (Viscous(("rail",), 2.5),),
        ),
    )
