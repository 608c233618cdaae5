"""Quadratic damping: a torque proportional to velocity times speed, against it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from sysid_btr._typing import FloatArray
from sysid_btr.terms.base import Kind, Rig
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

    def write_fields(self, rig: Rig, values: FloatArray) -> None:
        rig.array("dof_dampingpoly")[:, rig.index.dof[rig.index.of(self.places)], 0] += values[:, :, 0]
