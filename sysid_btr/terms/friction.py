"""Friction and damping at a joint."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, ClassVar, Self

import numpy as np

from sysid_btr._typing import FloatArray, IntArray
from sysid_btr.terms.base import LINK_SUFFIX, Kind
from sysid_btr.terms.effect import DofEffect, Effect, Probe
from sysid_btr.terms.law import Step, drive
from sysid_btr.terms.scales import JointScale, Scales, middle_scale

if TYPE_CHECKING:
    import mujoco


@dataclass(frozen=True)
class CoulombFriction(DofEffect):
    """Dry friction: a torque of constant size against the motion; it holds the joint still up to that size.

    Native: `dof_frictionloss`.
    """

    name: ClassVar[str] = "coulomb_friction"
    family: ClassVar[str] = "friction"
    field: ClassVar[str] = "frictionloss"
    compiled: ClassVar[str] = "dof_frictionloss"
    title: ClassVar[str] = "dry friction"
    kinds: ClassVar[tuple[Kind, ...]] = (Kind("torque", "Nm", 0.0, 0.0, 10.0, 0.05),)
    everywhere: ClassVar[bool] = True
    confounders: ClassVar[tuple[tuple[str, str], ...]] = (
        ("stribeck_friction", "slow motion below the Stribeck velocity"),
        ("load_friction", "the same motion under different loads"),
        ("backlash", "reversals under a load that does not change sign"),
    )

    @classmethod
    def sized(cls, scale: JointScale) -> tuple[Kind, ...]:
        return (Kind("torque", "Nm", 0.0, 0.0, scale.counter_peak, 0.15 * scale.torque_rms),)

    @classmethod
    def probes(cls, scale: JointScale) -> tuple[Probe, ...]:
        size = cls.sized(scale)[0].scale
        held = 0.7 * scale.measured_rms  # a joint that sticks most of the time
        return tuple(((t,),) for t in (size, 4 * size, *((held,) if held > 6 * size else ())))


@dataclass(frozen=True)
class Damping(DofEffect):
    """A joint's own damping, which acts on both sides together where another term has split the joint."""

    def held_in(self, model: mujoco.MjModel, place: str) -> tuple[str, int]:
        for t in range(model.ntendon):
            if model.tendon(t).name == place + LINK_SUFFIX:
                return self.compiled.replace("dof_", "tendon_"), t
        return super().held_in(model, place)


@dataclass(frozen=True)
class ViscousDamping(Damping):
    """Viscous damping: a torque proportional to velocity, against it.

    Native: `dof_damping`. The same as the servo's kv where only position is logged.
    """

    name: ClassVar[str] = "viscous_damping"
    family: ClassVar[str] = "friction"
    field: ClassVar[str] = "damping"
    compiled: ClassVar[str] = "dof_damping"
    title: ClassVar[str] = "viscous damping"
    kinds: ClassVar[tuple[Kind, ...]] = (Kind("b", "Nm s/rad", 0.0, 0.0, 10.0, 0.05),)
    everywhere: ClassVar[bool] = True
    confounders: ClassVar[tuple[tuple[str, str], ...]] = (
        ("kv", "a logged effort or current; the two are confounded in positions alone"),
        ("quadratic_damping", "motion at several speeds"),
    )

    @classmethod
    def sized(cls, scale: JointScale) -> tuple[Kind, ...]:
        return (Kind("b", "Nm s/rad", 0.0, 0.0, 5 * scale.damping, 0.1 * scale.damping),)


@dataclass(frozen=True)
class DampingFactor(Damping):
    """Viscous damping as a factor of what the model has.

    Native: `dof_damping`. Robots are taken to have it from their models' by six tenths, as where it is drawn evenly in
    its logarithm from 0.3 to 3 (Andrychowicz et al. 2020, doi:10.1177/0278364919887447).
    """

    name: ClassVar[str] = "damping_factor"
    family: ClassVar[str] = "friction"
    compiled: ClassVar[str] = "dof_damping"
    factor: ClassVar[bool] = True
    title: ClassVar[str] = "a change of the damping"
    usual: ClassVar[bool] = False
    signed: ClassVar[bool] = True
    confounders: ClassVar[tuple[tuple[str, str], ...]] = (
        ("kv", "a logged effort or current; the two are confounded in positions alone"),
    )
    kinds: ClassVar[tuple[Kind, ...]] = (Kind("scale", "1", 1.0, 0.0, 10.0, 0.1, spread=0.6),)


@dataclass(frozen=True)
class QuadraticDamping(Damping):
    """Quadratic damping: a torque proportional to velocity times speed, against it.

    Native: the first term of `dof_dampingpoly`.
    """

    name: ClassVar[str] = "quadratic_damping"
    family: ClassVar[str] = "friction"
    field: ClassVar[str] = "quadratic_damping"
    compiled: ClassVar[str] = "dof_dampingpoly"
    title: ClassVar[str] = "quadratic damping"
    kinds: ClassVar[tuple[Kind, ...]] = (Kind("b", "Nm s2/rad2", 0.0, 0.0, 10.0, 0.05),)
    everywhere: ClassVar[bool] = True
    confounders: ClassVar[tuple[tuple[str, str], ...]] = (
        ("viscous_damping", "motion at several speeds"),
        ("speed_torque_limit", "fast motion under low load"),
    )

    @classmethod
    def sized(cls, scale: JointScale) -> tuple[Kind, ...]:
        size = scale.damping / scale.velocity_rms
        return (Kind("b", "Nm s2/rad2", 0.0, 0.0, 5 * size, 0.1 * size),)


SIZES, SHARES, SPEEDS = (0.6, 1.0, 1.6), (0.2, 0.5, 0.8), (0.4, 1.0, 2.5)
"""Multiples of what a linear scan says from which a refit may begin."""


@dataclass(frozen=True)
class StribeckFriction(Effect):
    """Stribeck friction: dry friction that is larger at rest than in motion.

    F(v) = F_c + F_s exp(-(v / v_s)^2) (Armstrong-Helouvry, Dupont, Canudas de Wit 1994,
    doi:10.1016/0005-1098(94)90209-7).

    Law: friction follows the velocity at the middle of each step.
    """

    name: ClassVar[str] = "stribeck_friction"
    family: ClassVar[str] = "friction"
    title: ClassVar[str] = "friction that falls with speed"
    law_acts: ClassVar[tuple[str, ...]] = ("friction",)
    kinds: ClassVar[tuple[Kind, ...]] = (
        Kind("coulomb", "Nm", 0.0, 0.0, 10.0, 0.05),
        Kind("static", "Nm", 0.0, 0.0, 10.0, 0.05),
        Kind("velocity", "rad/s", 0.1, 0.01, 3.0, 0.05),
    )
    includes: ClassVar[tuple[str, ...]] = ("coulomb_friction",)
    main: ClassVar[int] = 1
    held: ClassVar[tuple[str, ...]] = ("velocity",)
    confounders: ClassVar[tuple[tuple[str, str], ...]] = (
        ("coulomb_friction", "slow motion below the Stribeck velocity"),
    )

    @classmethod
    def sized(cls, scale: JointScale) -> tuple[Kind, ...]:
        peak, size = scale.counter_peak, 0.15 * scale.torque_rms
        speed = 0.2 * scale.velocity_rms
        return (
            Kind("coulomb", "Nm", 0.0, 0.0, peak, size),
            Kind("static", "Nm", 0.0, 0.0, peak, size),
            Kind("velocity", "rad/s", speed, 0.02 * speed, 20 * speed, 0.5 * speed),
        )

    @classmethod
    def probes(cls, scale: JointScale) -> tuple[Probe, ...]:
        size, _, speed = cls.sized(scale)
        held = 0.5 * scale.measured_rms  # a joint that sticks most of the time
        amounts = (2 * size.scale, *((held,) if held > 6 * size.scale else ()))
        return tuple(
            ((a, 0.0, factor * speed.nominal), (0.0, a, factor * speed.nominal))
            for a in amounts
            for factor in (0.3, 1.0, 3.0)
        )

    @classmethod
    def initial_guesses(cls, values: FloatArray) -> FloatArray:
        """Sum of both, share of the part that falls, and velocity: stick-slip has many local minima."""
        total = float(values[0] + values[1])
        return np.array(
            [
                (total * size * (1 - share), total * size * share, values[2] * speed)
                for size in SIZES
                for share in SHARES
                for speed in SPEEDS
            ]
        )

    @staticmethod
    def law(step: Step, numbers: FloatArray, memory: FloatArray, places: IntArray) -> None:
        for p, j in enumerate(places):
            falling = math.exp(-((step.qvel[j] / numbers[p, 2]) ** 2))
            step.friction[j] += numbers[p, 0] + numbers[p, 1] * falling


@dataclass(frozen=True)
class PreslidingFriction(Effect):
    """Dry friction that bends before it slides: grease, seals, teeth that give.

    Dahl's model (Canudas de Wit et al. 1995, doi:10.1109/9.376053).

    Law: torque = -torque z / deflection, z' = v - |v| z / deflection from z = 0, in every segment too; exact for the
    velocity of a step.
    """

    name: ClassVar[str] = "coulomb_friction"
    family: ClassVar[str] = "friction"
    variant: ClassVar[str] = "presliding"
    label: ClassVar[str] = "coulomb_friction.presliding"
    title: ClassVar[str] = "pre-sliding friction"
    law_memory: ClassVar[int] = 1
    kinds: ClassVar[tuple[Kind, ...]] = (
        Kind("torque", "Nm", 0.0, 0.0, 10.0, 0.05),
        Kind("deflection", "rad", 0.01, 0.001, 0.3, 0.005),
    )
    includes: ClassVar[tuple[str, ...]] = ("coulomb_friction",)
    held: ClassVar[tuple[str, ...]] = ("deflection",)
    confounders: ClassVar[tuple[tuple[str, str], ...]] = (
        ("coulomb_friction", "small motions about a reversal"),
        ("backlash", "reversals under a load that does not change sign"),
    )

    @classmethod
    def sized(cls, scale: JointScale) -> tuple[Kind, ...]:
        deflection = 0.02 * max(scale.span, 1e-9)
        return (
            Kind("torque", "Nm", 0.0, 0.0, scale.counter_peak, 0.15 * scale.torque_rms),
            Kind("deflection", "rad", deflection, 0.1 * deflection, 10 * deflection, 0.5 * deflection),
        )

    @classmethod
    def probes(cls, scale: JointScale) -> tuple[Probe, ...]:
        size, deflection = cls.sized(scale)
        return tuple(((a * size.scale, f * deflection.nominal),) for a in (1.0, 4.0) for f in (0.3, 1.0, 3.0))

    @staticmethod
    def law(step: Step, numbers: FloatArray, memory: FloatArray, places: IntArray) -> None:
        for p, j in enumerate(places):
            deflection, speed = numbers[p, 1], abs(step.qvel[j])
            slid = math.copysign(deflection, step.qvel[j])  # where bristles go at this velocity
            middle = slid + (memory[p, 0] - slid) * math.exp(-0.5 * speed * step.timestep / deflection)
            step.joint_torque[j] -= numbers[p, 0] * middle / deflection
            memory[p, 0] = slid + (memory[p, 0] - slid) * math.exp(-speed * step.timestep / deflection)


@dataclass(frozen=True)
class LoadFriction(Effect):
    """Load-dependent friction: teeth and bearings rub the more, the more they carry (BAM, arXiv:2410.08650).

    A gear is loaded from two sides: by its motor, and by the weight and motion of the links.

    Law: friction follows the servo's torque at the middle of each step.
    """

    name: ClassVar[str] = "load_friction"
    family: ClassVar[str] = "friction"
    title: ClassVar[str] = "friction per unit of load"
    scope: ClassVar = "drive"
    law_acts: ClassVar[tuple[str, ...]] = ("friction",)
    kinds: ClassVar[tuple[Kind, ...]] = (Kind("ratio", "1", 0.0, 0.0, 0.9, 0.08),)
    steps: ClassVar[tuple[float, ...]] = (1.0, 4.0)
    everywhere: ClassVar[bool] = True
    confounders: ClassVar[tuple[tuple[str, str], ...]] = (
        ("coulomb_friction", "the same motion under different loads"),
    )

    @staticmethod
    def law(step: Step, numbers: FloatArray, memory: FloatArray, places: IntArray) -> None:
        for p, j in enumerate(places):
            step.friction[j] += numbers[p, 0] * abs(drive(step, j))


@dataclass(frozen=True)
class LoadFrictionLarger(LoadFriction):
    """Law: friction follows the larger of two torques, the servo's and that of the links' weight and motion.

    Which is what enters the gear: the motor's when it drives, the link's when it is driven back.
    """

    title: ClassVar[str] = "friction per unit of the torque that enters the gear"
    variant: ClassVar[str] = "larger"
    label: ClassVar[str] = "load_friction.larger"

    @staticmethod
    def law(step: Step, numbers: FloatArray, memory: FloatArray, places: IntArray) -> None:
        for p, j in enumerate(places):
            step.friction[j] += numbers[p, 0] * max(abs(drive(step, j)), abs(step.load[j]))


@dataclass(frozen=True)
class LoadFrictionPower(LoadFriction):
    """Friction that grows with a power of the load, as at contacts that flatten under it.

    Two thirds for a sphere on a plane (Bowden and Tabor 1950, "The Friction and Lubrication of Solids"); two where a
    gear is less efficient, the harder it is driven; zero is dry friction. Its torque is that at a load which is usual
    for the robot, where motion tells it apart from the exponent.

    Law: torque (|T| / L)^exponent, with T the servo's torque at the middle of each step and L the median over joints of
    its rms.
    """

    title: ClassVar[str] = "friction at the robot's usual load that grows with a power of it"
    variant: ClassVar[str] = "power"
    label: ClassVar[str] = "load_friction.power"
    kinds: ClassVar[tuple[Kind, ...]] = (
        Kind("torque", "Nm", 0.0, 0.0, 10.0, 0.1),
        Kind("exponent", "1", 1.0, 0.0, 3.0, 0.1),
    )
    held: ClassVar[tuple[str, ...]] = ("exponent",)
    includes: ClassVar[tuple[str, ...]] = ("coulomb_friction", "load_friction")

    @classmethod
    def sized(cls, scale: JointScale) -> tuple[Kind, ...]:
        return (Kind("torque", "Nm", 0.0, 0.0, scale.counter_peak, 0.08 * scale.torque_rms), cls.kinds[1])

    @classmethod
    def probes(cls, scale: JointScale) -> tuple[Probe, ...]:
        return tuple(((0.16 * scale.torque_rms, exponent),) for exponent in (0.5, 2.0))

    @property
    def described(self) -> str:
        if not self.ranges:
            return super().described
        load = f"{self.ranges[0][1]:.3g} {'N' if self.slides else 'Nm'}"
        return f"friction at a load of {load} that grows with a power of it"

    def over(self, scales: Scales) -> Self:
        usual = middle_scale(list(scales.values())).torque_rms
        return replace(self, ranges=((0.0, usual),) * len(self.places))

    def law_numbers(self, values: FloatArray) -> FloatArray:
        usual = np.array(self.ranges or [(0.0, 1.0)] * len(self.places))[:, 1]
        return np.concatenate([values, np.broadcast_to(usual[:, None], (*values.shape[:2], 1))], axis=2)

    @staticmethod
    def law(step: Step, numbers: FloatArray, memory: FloatArray, places: IntArray) -> None:
        for p, j in enumerate(places):
            step.friction[j] += numbers[p, 0] * (abs(drive(step, j)) / numbers[p, 2]) ** numbers[p, 1]


@dataclass(frozen=True)
class LoadFrictionStribeck(LoadFriction):
    """Law: friction follows the servo's torque, more so at rest: |torque| (ratio + static exp(-(v / v_s)^2))."""

    title: ClassVar[str] = "friction per unit of load that falls with speed"
    variant: ClassVar[str] = "stribeck"
    label: ClassVar[str] = "load_friction.stribeck"
    kinds: ClassVar[tuple[Kind, ...]] = (
        Kind("ratio", "1", 0.0, 0.0, 0.9, 0.08),
        Kind("static", "1", 0.0, 0.0, 0.9, 0.08),
        Kind("velocity", "rad/s", 0.1, 0.01, 3.0, 0.05),
    )
    main: ClassVar[int] = 1
    held: ClassVar[tuple[str, ...]] = ("velocity",)
    everywhere: ClassVar[bool] = False
    includes: ClassVar[tuple[str, ...]] = ("load_friction",)

    @classmethod
    def sized(cls, scale: JointScale) -> tuple[Kind, ...]:
        speed = 0.2 * scale.velocity_rms
        return (cls.kinds[0], cls.kinds[1], Kind("velocity", "rad/s", speed, 0.02 * speed, 20 * speed, 0.5 * speed))

    @classmethod
    def probes(cls, scale: JointScale) -> tuple[Probe, ...]:
        speed = cls.sized(scale)[2].nominal
        return tuple(((0.1, 0.0, f * speed), (0.0, 0.1, f * speed)) for f in (0.3, 1.0, 3.0))

    @staticmethod
    def law(step: Step, numbers: FloatArray, memory: FloatArray, places: IntArray) -> None:
        for p, j in enumerate(places):
            falling = math.exp(-((step.qvel[j] / numbers[p, 2]) ** 2))
            step.friction[j] += abs(drive(step, j)) * (numbers[p, 0] + numbers[p, 1] * falling)
