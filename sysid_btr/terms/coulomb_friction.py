"""Dry friction: a torque of constant size against the motion; it holds the joint still up to that size."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from sysid_btr._typing import FloatArray
from sysid_btr.terms.base import BatchModel, Fields, Kind
from sysid_btr.terms.effect import Effect, Probe
from sysid_btr.terms.scales import JointScale


@dataclass(frozen=True)
class CoulombFriction(Effect):
    """Native: `dof_frictionloss`."""

    name: ClassVar[str] = "coulomb_friction"
    title: ClassVar[str] = "dry friction"
    kinds: ClassVar[tuple[Kind, ...]] = (Kind("torque", "Nm", 0.0, 0.0, 10.0, 0.05),)
    everywhere: ClassVar[bool] = True
    confounders: ClassVar[tuple[tuple[str, str], ...]] = (
        ("stribeck_friction", "slow motion below the Stribeck velocity"),
        ("load_friction", "the same motion under different loads"),
        ("backlash", "reversals under a load that does not change sign"),
    )

    @classmethod
    def sized(cls, scale: JointScale) -> tuple[Kind, ...]:
        unit, size = scale.unit("Nm"), 0.15 * scale.torque_rms
        return (Kind("torque", unit, 0.0, 0.0, scale.counter_peak, size),)

    @classmethod
    def probes(cls, scale: JointScale) -> tuple[Probe, ...]:
        size = cls.sized(scale)[0].scale
        held = 0.7 * scale.measured_rms  # a joint that sticks most of the time
        return tuple(((t,),) for t in (size, 4 * size, *((held,) if held > 6 * size else ())))

    def model_fields(self, batch: BatchModel, values: FloatArray) -> Fields:
        friction = batch.read("dof_frictionloss")
        friction[:, batch.index.dof[batch.index.of(self.places)]] += values[:, :, 0]
        return {"dof_frictionloss": friction}
