"""A constant torque on a joint: asymmetric friction, a drive's offset, a pulling cable."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from sysid_btr._typing import FloatArray
from sysid_btr.terms.base import BatchModel, Kind
from sysid_btr.terms.effect import Effect
from sysid_btr.terms.scales import JointScale


@dataclass(frozen=True)
class ConstantForce(Effect):
    """Applied to the joint, beside the servo."""

    name: ClassVar[str] = "constant_force"
    title: ClassVar[str] = "constant torque"
    signed: ClassVar[bool] = True
    kinds: ClassVar[tuple[Kind, ...]] = (Kind("torque", "Nm", 0.0, -10.0, 10.0, 0.05),)
    confounders: ClassVar[tuple[tuple[str, str], ...]] = (
        ("encoder_offset", "a logged effort"),
        ("com_offset", "several poses"),
    )

    @classmethod
    def sized(cls, scale: JointScale) -> tuple[Kind, ...]:
        peak = scale.counter_peak
        return (Kind("torque", scale.unit("Nm"), 0.0, -peak, peak, 0.1 * scale.torque_rms),)

    def applied_torque(self, batch: BatchModel, values: FloatArray, time: FloatArray) -> FloatArray:
        torque = np.zeros((batch.size, len(time) - 1, len(batch.index.joints)))
        torque[:, :, batch.index.of(self.places)] = values[:, None, :, 0]
        return torque
