"""Load-dependent friction: teeth and bearings rub the more, the more they carry (BAM, arXiv:2410.08650).

A gear is loaded from two sides: by its motor, and by the weight and motion of the links.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from sysid_btr._typing import FloatArray, IntArray
from sysid_btr.terms.base import Kind, Step
from sysid_btr.terms.effect import Effect, Probe
from sysid_btr.terms.scales import JointScale


@dataclass(frozen=True)
class LoadFriction(Effect):
    """Law: friction follows the servo's torque at the middle of each step."""

    name: ClassVar[str] = "load_friction"
    title: ClassVar[str] = "friction per unit of load"
    scope: ClassVar = "servo"
    law_acts: ClassVar[tuple[str, ...]] = ("friction",)
    kinds: ClassVar[tuple[Kind, ...]] = (Kind("ratio", "1", 0.0, 0.0, 0.9, 0.08),)
    steps: ClassVar[tuple[float, ...]] = (1.0, 4.0)
    everywhere: ClassVar[bool] = True
    confounders: ClassVar[tuple[tuple[str, str], ...]] = (
        ("coulomb_friction", "the same motion under different loads"),
    )

    def law(self, step: Step, values: FloatArray, memory: Any, index: IntArray) -> None:
        step.friction[:, index] += values[:, :, 0] * np.abs(step.drive[:, index])


@dataclass(frozen=True)
class LoadFrictionLarger(LoadFriction):
    """Law: friction follows the larger of two torques, the servo's and that of the links' weight and motion.

    Which is what enters the gear: the motor's when it drives, the link's when it is driven back.
    """

    title: ClassVar[str] = "friction per unit of the torque that enters the gear"
    variant: ClassVar[str] = "larger"
    label: ClassVar[str] = "load_friction.larger"

    def law(self, step: Step, values: FloatArray, memory: Any, index: IntArray) -> None:
        entering = np.maximum(np.abs(step.drive[:, index]), np.abs(step.load[:, index]))
        step.friction[:, index] += values[:, :, 0] * entering


@dataclass(frozen=True)
class LoadFrictionQuadratic(LoadFriction):
    """Law: friction follows the square of the servo's torque: a gear is less efficient, the harder it is driven."""

    title: ClassVar[str] = "friction per unit of squared load"
    variant: ClassVar[str] = "quadratic"
    label: ClassVar[str] = "load_friction.quadratic"
    kinds: ClassVar[tuple[Kind, ...]] = (Kind("curvature", "1/Nm", 0.0, 0.0, 1.0, 0.1),)

    @classmethod
    def sized(cls, scale: JointScale) -> tuple[Kind, ...]:
        size = 1 / scale.counter_peak
        return (Kind("curvature", f"1/{scale.unit('Nm')}", 0.0, 0.0, 2 * size, 0.1 * size),)

    def law(self, step: Step, values: FloatArray, memory: Any, index: IntArray) -> None:
        step.friction[:, index] += values[:, :, 0] * np.square(step.drive[:, index])


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
        return (
            cls.kinds[0],
            cls.kinds[1],
            Kind("velocity", scale.unit("rad/s"), speed, 0.02 * speed, 20 * speed, 0.5 * speed),
        )

    @classmethod
    def probes(cls, scale: JointScale) -> tuple[Probe, ...]:
        speed = cls.sized(scale)[2].nominal
        return tuple(((0.1, 0.0, f * speed), (0.0, 0.1, f * speed)) for f in (0.3, 1.0, 3.0))

    def law(self, step: Step, values: FloatArray, memory: Any, index: IntArray) -> None:
        falling = np.exp(-np.square(step.qvel[:, index] / values[:, :, 2]))
        step.friction[:, index] += np.abs(step.drive[:, index]) * (values[:, :, 0] + values[:, :, 1] * falling)
