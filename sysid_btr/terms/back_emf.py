"""Back-EMF: a torque against the motion that a motor makes while it is driven, and not while it is switched off.

With its terminals held at a voltage u a motor gives k (u - k w) / R: damping by k^2 / R that is in no friction, and by
which the largest torque of either sign moves too. A bridge that is off breaks the current, and the damping is gone.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from sysid_btr._typing import FloatArray, IntArray
from sysid_btr.terms.base import Kind, Step
from sysid_btr.terms.effect import Effect
from sysid_btr.terms.scales import JointScale


@dataclass(frozen=True)
class BackEmf(Effect):
    """Law: torque - b v while the drive is on, of which the limits of the torque are those without it, less b v."""

    name: ClassVar[str] = "back_emf"
    title: ClassVar[str] = "damping by back-EMF"
    scope: ClassVar = "servo"
    law_acts: ClassVar[tuple[str, ...]] = ("servo", "limit")
    kinds: ClassVar[tuple[Kind, ...]] = (Kind("b", "Nm s/rad", 0.0, 0.0, 10.0, 0.05),)
    needs: ClassVar[str] = "enabled"
    yields_to: ClassVar[tuple[str, ...]] = ("viscous_damping",)
    confounders: ClassVar[tuple[tuple[str, str], ...]] = (
        ("viscous_damping", "free motion with the drive switched off, or a logged effort"),
        ("kv", "motion in which the drive saturates"),
    )

    @classmethod
    def sized(cls, scale: JointScale) -> tuple[Kind, ...]:
        return (Kind("b", scale.unit("Nm s/rad"), 0.0, 0.0, 5 * scale.damping, 0.1 * scale.damping),)

    def law(self, step: Step, values: FloatArray, memory: Any, index: IntArray) -> None:
        for place, column in enumerate(index):
            on = step.inputs.get(f"enabled.{self.places[place]}", np.float64(1.0))
            change = values[:, place, 0] * step.qvel[:, column] * on
            step.motor_torque[:, column] -= change
            step.limit_low[:, column] -= change
            step.limit_high[:, column] -= change
