"""Contact between feet and ground."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from sysid_btr._typing import FloatArray
from sysid_btr.terms.base import BatchModel, Fields, Kind
from sysid_btr.terms.effect import Effect, Probe
from sysid_btr.terms.scales import JointScale


@dataclass(frozen=True)
class FootFriction(Effect):
    """Sliding friction between feet and ground.

    Native: `geom_friction` as a factor of the nominal, on the ground and on what stands on it.
    """

    name: ClassVar[str] = "foot_friction"
    title: ClassVar[str] = "change of the ground's friction"
    scope: ClassVar = "robot"
    needs: ClassVar[str] = "a free base on the ground"
    signed: ClassVar[bool] = True
    kinds: ClassVar[tuple[Kind, ...]] = (Kind("factor", "1", 1.0, 0.1, 3.0, 0.1),)
    confounders: ClassVar[tuple[tuple[str, str], ...]] = (("gravity_tilt", "motion in several directions"),)

    @classmethod
    def probes(cls, scale: JointScale) -> tuple[Probe, ...]:
        return (((0.8,),), ((0.5,),))

    def model_fields(self, batch: BatchModel, values: FloatArray) -> Fields:
        touching = (batch.model.geom_contype != 0) | (batch.model.geom_conaffinity != 0)
        friction = batch.read("geom_friction")
        friction[:, np.flatnonzero(touching), 0] *= values[:, 0, :1]
        return {"geom_friction": friction}


@dataclass(frozen=True)
class FootCompliance(Effect):
    """Softness of the contact between feet and ground.

    Native: the time constant of `geom_solref` as a factor of the nominal.
    """

    name: ClassVar[str] = "foot_compliance"
    title: ClassVar[str] = "change of the ground's softness"
    scope: ClassVar = "robot"
    needs: ClassVar[str] = "a free base on the ground"
    signed: ClassVar[bool] = True
    kinds: ClassVar[tuple[Kind, ...]] = (Kind("factor", "1", 1.0, 0.2, 10.0, 0.2),)
    confounders: ClassVar[tuple[tuple[str, str], ...]] = (("joint_compliance", "motion in the air"),)

    @classmethod
    def probes(cls, scale: JointScale) -> tuple[Probe, ...]:
        return (((1.5,),), ((3.0,),))

    def model_fields(self, batch: BatchModel, values: FloatArray) -> Fields:
        touching = (batch.model.geom_contype != 0) | (batch.model.geom_conaffinity != 0)
        solref = batch.read("geom_solref")
        standard = touching & (batch.model.geom_solref[:, 0] > 0)
        solref[:, np.flatnonzero(standard), 0] *= values[:, 0, :1]
        return {"geom_solref": solref}
