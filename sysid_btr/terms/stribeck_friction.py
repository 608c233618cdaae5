"""Stribeck friction: dry friction that is larger at rest than in motion.

F(v) = F_c + F_s exp(-(v / v_s)^2) (Armstrong-Helouvry, Dupont, Canudas de Wit 1994,
doi:10.1016/0005-1098(94)90209-7).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from sysid_btr._typing import FloatArray, IntArray
from sysid_btr.terms.base import Kind, Step
from sysid_btr.terms.effect import Effect, Probe
from sysid_btr.terms.scales import JointScale

SIZES, SHARES, SPEEDS = (0.6, 1.0, 1.6), (0.2, 0.5, 0.8), (0.4, 1.0, 2.5)
"""Multiples of what a linear scan says from which a refit may begin."""


@dataclass(frozen=True)
class StribeckFriction(Effect):
    """Law: friction follows the velocity at the middle of each step."""

    name: ClassVar[str] = "stribeck_friction"
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
            Kind("coulomb", scale.unit("Nm"), 0.0, 0.0, peak, size),
            Kind("static", scale.unit("Nm"), 0.0, 0.0, peak, size),
            Kind("velocity", scale.unit("rad/s"), speed, 0.02 * speed, 20 * speed, 0.5 * speed),
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
    def ladder(cls, values: FloatArray) -> FloatArray:
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

    def law(self, step: Step, values: FloatArray, memory: Any, index: IntArray) -> None:
        speed = step.qvel[:, index] / values[:, :, 2]
        step.friction[:, index] += values[:, :, 0] + values[:, :, 1] * np.exp(-np.square(speed))
