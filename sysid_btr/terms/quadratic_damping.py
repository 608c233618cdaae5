"""Quadratic damping: a torque proportional to velocity times speed, against it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from sysid_btr._typing import FloatArray
from sysid_btr.terms.base import BatchModel, Fields, Kind
from sysid_btr.terms.effect import Effect
from sysid_btr.terms.scales import JointScale


@dataclass(frozen=True)
class QuadraticDamping(Effect):
    """Native: the first term of `dof_dampingpoly`."""

    name: ClassVar[str] = "quadratic_damping"
    title: ClassVar[str] = "quadratic damping"
    kinds: ClassVar[tuple[Kind, ...]] = (Kind("b", "Nm s2/rad2", 0.0, 0.0, 10.0, 0.05),)
    everywhere: ClassVar[bool] = True
    confounders: ClassVar[tuple[tuple[str, str], ...]] = (
        ("viscous_damping", "motion at several speeds"),
        ("speed_torque_limit", "fast motion under low load"),
    )

    @classmethod
    def sized(cls, scale: JointScale) -> tuple[Kind, ...]:
        size = scale.damping / scale.velocity_rms
        return (Kind("b", scale.unit("Nm s2/rad2"), 0.0, 0.0, 5 * size, 0.1 * size),)

    def model_fields(self, batch: BatchModel, values: FloatArray) -> Fields:
        damping = batch.read("dof_dampingpoly")
        damping[:, batch.index.dof[batch.index.of(self.places)], 0] += values[:, :, 0]
        return {"dof_dampingpoly": damping}
