"""A supply that sags: every servo's gain falls, slowly with the battery or at once with the load."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from sysid_btr._typing import FloatArray, IntArray
from sysid_btr.terms.base import Kind, Step
from sysid_btr.terms.effect import Effect, Probe
from sysid_btr.terms.scales import JointScale


@dataclass(frozen=True)
class VoltageSag(Effect):
    """Law: gain = 1 - rate * time; an empty battery."""

    name: ClassVar[str] = "voltage_sag"
    title: ClassVar[str] = "loss of supply voltage per second"
    scope: ClassVar = "robot"
    variant: ClassVar[str] = "time"
    law_acts: ClassVar[tuple[str, ...]] = ("servo",)
    kinds: ClassVar[tuple[Kind, ...]] = (Kind("rate", "1/s", 0.0, 0.0, 0.05, 0.002),)
    confounders: ClassVar[tuple[tuple[str, str], ...]] = (
        ("thermal_derating", "a rest in the middle of the log, or a logged temperature"),
    )

    @classmethod
    def probes(cls, scale: JointScale) -> tuple[Probe, ...]:
        return (((0.004,),),)

    def law(self, step: Step, values: FloatArray, memory: Any, index: IntArray) -> None:
        step.gain *= np.clip(1 - values[:, 0, :1] * step.time, 0.05, 1.0)


@dataclass(frozen=True)
class VoltageSagLoad(VoltageSag):
    """Law: gain = 1 - ratio * sum of all servo torques; a supply with inner resistance.

    The torques are those that flow, which the gain has weakened already: gain = 1 / (1 + ratio * those asked for).
    """

    title: ClassVar[str] = "loss of supply voltage per unit of total torque"
    variant: ClassVar[str] = "load"
    kinds: ClassVar[tuple[Kind, ...]] = (Kind("ratio", "1/Nm", 0.0, 0.0, 1.0, 0.01),)

    @classmethod
    def sized(cls, scale: JointScale) -> tuple[Kind, ...]:
        size = 0.02 / max(scale.torque_rms, 1e-9)
        return (Kind("ratio", "1/Nm" if not scale.slide else "1/N", 0.0, 0.0, 20 * size, size),)

    @classmethod
    def probes(cls, scale: JointScale) -> tuple[Probe, ...]:
        return (((cls.sized(scale)[0].scale,),),)

    def law(self, step: Step, values: FloatArray, memory: Any, index: IntArray) -> None:
        total = np.abs(step.torque).sum(axis=1, keepdims=True)
        step.gain /= 1 + values[:, 0, :1] * total
