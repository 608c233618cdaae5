"""A servo that cannot give more than a certain torque."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from sysid_btr._typing import FloatArray
from sysid_btr.terms.base import BatchModel, Fields, Kind
from sysid_btr.terms.effect import Effect, Probe
from sysid_btr.terms.fields import narrow_force_limit
from sysid_btr.terms.scales import JointScale


@dataclass(frozen=True)
class TorqueLimit(Effect):
    """Native: `actuator_forcerange`. Neutral at the upper bound."""

    name: ClassVar[str] = "torque_limit"
    title: ClassVar[str] = "limit of the torque"
    scope: ClassVar = "servo"
    kinds: ClassVar[tuple[Kind, ...]] = (Kind("limit", "Nm", 100.0, 0.01, 100.0, 0.1),)
    held: ClassVar[tuple[str, ...]] = ("limit",)
    confounders: ClassVar[tuple[tuple[str, str], ...]] = (
        ("speed_torque_limit", "the limit reached at several speeds"),
        ("slew_limit", "slow motion under a large load"),
    )

    @classmethod
    def sized(cls, scale: JointScale) -> tuple[Kind, ...]:
        peak = max(scale.torque_peak, 1e-9)
        return (Kind("limit", scale.unit("Nm"), 2 * peak, 0.03 * peak, 2 * peak, 0.05 * peak),)

    @classmethod
    def probes(cls, scale: JointScale) -> tuple[Probe, ...]:
        return tuple(((f * max(scale.torque_peak, 1e-9),),) for f in (0.85, 0.65, 0.45, 0.28))

    def model_fields(self, batch: BatchModel, values: FloatArray) -> Fields:
        most = np.array([p.upper for p in self.spread_parameters(0)])
        return narrow_force_limit(batch, self.places, np.where(values[:, :, 0] >= most, np.inf, values[:, :, 0]))
