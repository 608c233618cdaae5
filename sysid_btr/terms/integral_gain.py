"""A servo with integral action: torque grows while the error lasts."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from sysid_btr._typing import FloatArray, IntArray
from sysid_btr.terms.base import BatchModel, Kind, Step
from sysid_btr.terms.effect import Effect
from sysid_btr.terms.scales import JointScale


@dataclass(frozen=True)
class IntegralGain(Effect):
    """Law: torque += ki * integral of (command - position)."""

    name: ClassVar[str] = "integral_gain"
    title: ClassVar[str] = "integral action of the servo"
    scope: ClassVar = "servo"
    law_acts: ClassVar[tuple[str, ...]] = ("servo",)
    kinds: ClassVar[tuple[Kind, ...]] = (Kind("ki", "Nm/(rad s)", 0.0, 0.0, 200.0, 1.0),)
    everywhere: ClassVar[bool] = True
    confounders: ClassVar[tuple[tuple[str, str], ...]] = (
        ("joint_spring", "long holds"),
        ("payload", "long holds"),
    )

    @classmethod
    def sized(cls, scale: JointScale) -> tuple[Kind, ...]:
        size = scale.torque_rms / (0.02 * max(scale.span, 1e-9))
        return (Kind("ki", scale.unit("Nm/(rad s)"), 0.0, 0.0, 10 * size, 0.1 * size),)

    def start_law(self, batch: BatchModel, values: FloatArray) -> FloatArray:
        return np.zeros(values.shape[:2])

    def law(self, step: Step, values: FloatArray, memory: Any, index: IntArray) -> None:
        error = step.command[:, index] - step.qpos[:, index]
        # the integral at the middle of the step
        step.motor_torque[:, index] += values[:, :, 0] * (memory + 0.5 * step.timestep * error)
        memory += step.timestep * error
