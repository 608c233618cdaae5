"""A motor whose largest torque falls with speed: stall torque at rest, none at the no-load speed."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from sysid_btr._typing import FloatArray, IntArray
from sysid_btr.terms.base import Kind, Step
from sysid_btr.terms.effect import Effect, Probe
from sysid_btr.terms.scales import JointScale


@dataclass(frozen=True)
class SpeedTorqueLimit(Effect):
    """Law: -stall (1 + v / w0) <= torque <= stall (1 - v / w0), never beyond +-stall; none at its bound."""

    name: ClassVar[str] = "speed_torque_limit"
    title: ClassVar[str] = "torque limit that falls with speed"
    scope: ClassVar = "servo"
    law_acts: ClassVar[tuple[str, ...]] = ("limit",)
    kinds: ClassVar[tuple[Kind, ...]] = (
        Kind("stall", "Nm", 100.0, 0.01, 100.0, 0.1),
        Kind("no_load_speed", "rad/s", 100.0, 0.1, 100.0, 0.5),
    )
    includes: ClassVar[tuple[str, ...]] = ("torque_limit",)
    held: ClassVar[tuple[str, ...]] = ("stall", "no_load_speed")
    confounders: ClassVar[tuple[tuple[str, str], ...]] = (
        ("torque_limit", "the limit reached at several speeds"),
    )

    @classmethod
    def sized(cls, scale: JointScale) -> tuple[Kind, ...]:
        peak, speed = max(scale.torque_peak, 1e-9), max(scale.velocity_peak, 1e-9)
        return (
            Kind("stall", scale.unit("Nm"), 2 * peak, 0.03 * peak, 2 * peak, 0.05 * peak),
            Kind("no_load_speed", scale.unit("rad/s"), 2 * speed, 0.2 * speed, 20 * speed, 0.2 * speed),
        )

    @classmethod
    def probes(cls, scale: JointScale) -> tuple[Probe, ...]:
        peak, speed = max(scale.torque_peak, 1e-9), max(scale.velocity_peak, 1e-9)
        return tuple(((a * peak, b * speed),) for a in (1.2, 0.8, 0.5) for b in (1.2, 2.5))

    def law(self, step: Step, values: FloatArray, memory: Any, index: IntArray) -> None:
        most = np.array([p.upper for p in self.spread_parameters(0)])
        stall = np.where(values[:, :, 0] >= most, np.inf, values[:, :, 0])
        speed = values[:, :, 1]
        fraction = step.qvel[:, index] / speed
        high = stall * np.maximum(1 - np.maximum(fraction, 0), 1e-9)
        low = -stall * np.maximum(1 + np.minimum(fraction, 0), 1e-9)
        step.limit_high[:, index] = np.minimum(step.limit_high[:, index], high)
        step.limit_low[:, index] = np.maximum(step.limit_low[:, index], low)
