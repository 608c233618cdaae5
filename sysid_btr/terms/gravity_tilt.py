"""A mount that is not level: gravity is tilted for the whole robot."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from sysid_btr._typing import FloatArray
from sysid_btr.terms.base import BatchModel, Fields, Kind
from sysid_btr.terms.effect import Effect, Probe
from sysid_btr.terms.scales import JointScale


@dataclass(frozen=True)
class GravityTilt(Effect):
    """Native: `opt.gravity`, turned by the angle `x` about the world's x axis, then `y` about its y axis."""

    name: ClassVar[str] = "gravity_tilt"
    title: ClassVar[str] = "tilt of the mount"
    scope: ClassVar = "robot"
    signed: ClassVar[bool] = True
    kinds: ClassVar[tuple[Kind, ...]] = (
        Kind("x", "rad", 0.0, -0.3, 0.3, 0.01),
        Kind("y", "rad", 0.0, -0.3, 0.3, 0.01),
    )
    confounders: ClassVar[tuple[tuple[str, str], ...]] = (("com_offset", "an IMU, or several limbs"),)

    @classmethod
    def probes(cls, scale: JointScale) -> tuple[Probe, ...]:
        return (((0.02, 0.0), (0.0, 0.02)),)

    def model_fields(self, batch: BatchModel, values: FloatArray) -> Fields:
        gravity = batch.read("opt.gravity")
        x, y = values[:, 0, 0], values[:, 0, 1]
        gx, gy, gz = gravity[:, 0].copy(), gravity[:, 1].copy(), gravity[:, 2].copy()
        gy, gz = np.cos(x) * gy - np.sin(x) * gz, np.sin(x) * gy + np.cos(x) * gz
        gravity[:, 0] = np.cos(y) * gx + np.sin(y) * gz
        gravity[:, 1] = gy
        gravity[:, 2] = -np.sin(y) * gx + np.cos(y) * gz
        return {"opt.gravity": gravity}
