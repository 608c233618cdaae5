"""Sliding friction between feet and ground."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from sysid_btr._typing import FloatArray
from sysid_btr.terms.base import Kind, Rig
from sysid_btr.terms.effect import Effect, Probe
from sysid_btr.terms.scales import JointScale


@dataclass(frozen=True)
class FootFriction(Effect):
    """Native: `geom_friction` as a factor of the nominal, on the ground and on what stands on it."""

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

    def write_fields(self, rig: Rig, values: FloatArray) -> None:
        touching = (rig.model.geom_contype != 0) | (rig.model.geom_conaffinity != 0)
        rig.array("geom_friction")[:, np.flatnonzero(touching), 0] *= values[:, 0, :1]
