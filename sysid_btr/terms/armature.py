"""Rotor inertia seen at the joint through the gear: ratio squared times the rotor's."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from sysid_btr._typing import FloatArray
from sysid_btr.terms.base import BatchModel, Fields, Kind
from sysid_btr.terms.effect import Effect
from sysid_btr.terms.scales import JointScale


@dataclass(frozen=True)
class Armature(Effect):
    """Native: `dof_armature`."""

    name: ClassVar[str] = "armature"
    title: ClassVar[str] = "rotor inertia"
    kinds: ClassVar[tuple[Kind, ...]] = (Kind("inertia", "kg m2", 0.0, 0.0, 1.0, 0.001),)
    everywhere: ClassVar[bool] = True
    confounders: ClassVar[tuple[tuple[str, str], ...]] = (
        ("payload", "poses in which gravity pulls at the joint"),
        ("command_delay", "motion at several frequencies"),
    )

    @classmethod
    def sized(cls, scale: JointScale) -> tuple[Kind, ...]:
        return (Kind("inertia", scale.unit("kg m2"), 0.0, 0.0, 5 * scale.inertia, 0.05 * scale.inertia),)

    def model_fields(self, batch: BatchModel, values: FloatArray) -> Fields:
        armature = batch.read("dof_armature")
        armature[:, batch.index.dof[batch.index.of(self.places)]] += values[:, :, 0]
        return {"dof_armature": armature}
