"""Viscous damping: a torque proportional to velocity, against it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from sysid_btr._typing import FloatArray
from sysid_btr.terms.base import BatchModel, Fields, Kind
from sysid_btr.terms.effect import Effect
from sysid_btr.terms.scales import JointScale


@dataclass(frozen=True)
class ViscousDamping(Effect):
    """Native: `dof_damping`. The same as the servo's kv where only position is logged."""

    name: ClassVar[str] = "viscous_damping"
    title: ClassVar[str] = "viscous damping"
    kinds: ClassVar[tuple[Kind, ...]] = (Kind("b", "Nm s/rad", 0.0, 0.0, 10.0, 0.05),)
    everywhere: ClassVar[bool] = True
    confounders: ClassVar[tuple[tuple[str, str], ...]] = (
        ("kv", "a logged effort or current; position alone cannot tell the two apart"),
        ("quadratic_damping", "motion at several speeds"),
    )

    @classmethod
    def sized(cls, scale: JointScale) -> tuple[Kind, ...]:
        return (Kind("b", scale.unit("Nm s/rad"), 0.0, 0.0, 5 * scale.damping, 0.1 * scale.damping),)

    def model_fields(self, batch: BatchModel, values: FloatArray) -> Fields:
        damping = batch.read("dof_damping")
        damping[:, batch.index.dof[batch.index.of(self.places)]] += values[:, :, 0]
        return {"dof_damping": damping}
