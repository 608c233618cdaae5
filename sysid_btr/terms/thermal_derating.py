"""A motor that weakens as it heats: gain falls with the recent mean of its squared torque."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from sysid_btr._typing import FloatArray, IntArray
from sysid_btr.terms.base import BatchModel, Kind, Step
from sysid_btr.terms.effect import Effect, Probe
from sysid_btr.terms.scales import JointScale


@dataclass(frozen=True)
class ThermalDerating(Effect):
    """Law: T' = (torque^2 - T) / tau, gain = 1 / (1 + alpha T)."""

    name: ClassVar[str] = "thermal_derating"
    title: ClassVar[str] = "loss of torque with heat"
    scope: ClassVar = "servo"
    law_acts: ClassVar[tuple[str, ...]] = ("servo",)
    kinds: ClassVar[tuple[Kind, ...]] = (
        Kind("alpha", "1/Nm2", 0.0, 0.0, 10.0, 0.1),
        Kind("tau", "s", 10.0, 1.0, 200.0, 5.0),
    )
    held: ClassVar[tuple[str, ...]] = ("tau",)
    confounders: ClassVar[tuple[tuple[str, str], ...]] = (
        ("voltage_sag", "a rest in the middle of the log, or a logged temperature"),
    )

    @classmethod
    def sized(cls, scale: JointScale) -> tuple[Kind, ...]:
        size = 0.1 / max(scale.torque_rms, 1e-9) ** 2
        return (
            Kind("alpha", "1/Nm2" if not scale.slide else "1/N2", 0.0, 0.0, 50 * size, size),
            Kind("tau", "s", 10.0, 1.0, 200.0, 5.0),
        )

    @classmethod
    def probes(cls, scale: JointScale) -> tuple[Probe, ...]:
        alpha = cls.sized(scale)[0].scale
        return tuple(((alpha, tau),) for tau in (5.0, 20.0))

    def start_law(self, batch: BatchModel, values: FloatArray) -> FloatArray:
        return np.zeros(values.shape[:2])

    def law(self, step: Step, values: FloatArray, memory: Any, index: IntArray) -> None:
        gain = 1 / (1 + values[:, :, 0] * memory)
        step.gain[:, index] *= gain
        torque = gain * step.torque[:, index]
        memory += step.timestep / values[:, :, 1] * (torque**2 - memory)
