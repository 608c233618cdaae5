"""Contact between feet and ground."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from sysid_btr._typing import BoolArray, FloatArray
from sysid_btr.terms.base import BatchModel, Fields, Kind, Scope
from sysid_btr.terms.effect import GROUND, Effect, Probe
from sysid_btr.terms.scales import JointScale

if TYPE_CHECKING:
    import mujoco

EVERYWHERE = ("robot",)


def _geoms(model: mujoco.MjModel, place: str) -> BoolArray:
    """Which geoms a place has; those of the robot are all that touch anything, the ground among them."""
    if (place,) == EVERYWHERE:
        return np.asarray((model.geom_contype != 0) | (model.geom_conaffinity != 0))
    return np.asarray(model.geom_bodyid == model.body(place).id)


@dataclass(frozen=True)
class FootFriction(Effect):
    """Sliding friction between feet and ground.

    Native: `geom_friction`. A factor of the nominal on the ground and on what stands on it; declared, the friction of
    a body's geoms, and of the ground where they touch it.
    """

    name: ClassVar[str] = "foot_friction"
    family: ClassVar[str] = "contact"
    field: ClassVar[str] = "foot_friction"
    title: ClassVar[str] = "a change of the ground's friction"
    scope: ClassVar[Scope] = "robot"
    declared_at: ClassVar[Scope | None] = "body"
    needs: ClassVar[str] = GROUND
    signed: ClassVar[bool] = True
    kinds: ClassVar[tuple[Kind, ...]] = (Kind("factor", "1", 1.0, 0.1, 3.0, 0.1),)
    confounders: ClassVar[tuple[tuple[str, str], ...]] = (("gravity_tilt", "motion in several directions"),)

    @classmethod
    def probes(cls, scale: JointScale) -> tuple[Probe, ...]:
        return (((0.8,),), ((0.5,),))

    @classmethod
    def own_value(cls, model: mujoco.MjModel, place: str) -> float:
        # of a contact between the body and the ground, where the larger of the two counts
        geoms = (model.geom_bodyid == 0) | _geoms(model, place)
        return float(model.geom_friction[geoms, 0].max()) if geoms.any() else 1.0

    @classmethod
    def absolute_kind(cls, kind: Kind, own: float) -> Kind:
        return replace(kind, name="mu", nominal=own, lower=0.05, upper=max(2.0, own))

    def model_fields(self, batch: BatchModel, values: FloatArray) -> Fields:
        friction = batch.read("geom_friction")
        sliding = friction[:, :, 0]
        for place, name in enumerate(self.places):
            geoms, value = _geoms(batch.model, name), values[:, place, :1]
            sliding[:, geoms] = value if self.absolute else value * sliding[:, geoms]
        if self.absolute:
            # MuJoCo takes the larger of two geoms' frictions, so the ground must not be the larger one
            ground = batch.model.geom_bodyid == 0
            sliding[:, ground] = np.minimum(sliding[:, ground], values[:, :, 0].min(axis=1)[:, None])
        return {"geom_friction": friction}


@dataclass(frozen=True)
class FootCompliance(Effect):
    """Softness of the contact between feet and ground.

    Native: the time constant of `geom_solref` as a factor of the nominal.
    """

    name: ClassVar[str] = "foot_compliance"
    family: ClassVar[str] = "contact"
    title: ClassVar[str] = "a change of the ground's softness"
    scope: ClassVar[Scope] = "robot"
    declared_at: ClassVar[Scope | None] = "body"
    needs: ClassVar[str] = GROUND
    signed: ClassVar[bool] = True
    kinds: ClassVar[tuple[Kind, ...]] = (Kind("factor", "1", 1.0, 0.2, 10.0, 0.1),)
    confounders: ClassVar[tuple[tuple[str, str], ...]] = (("joint_compliance", "motion in the air"),)

    @classmethod
    def probes(cls, scale: JointScale) -> tuple[Probe, ...]:
        return (((1.5,),), ((3.0,),))

    def model_fields(self, batch: BatchModel, values: FloatArray) -> Fields:
        solref = batch.read("geom_solref")
        standard = batch.model.geom_solref[:, 0] > 0
        for place, name in enumerate(self.places):
            solref[:, _geoms(batch.model, name) & standard, 0] *= values[:, place, :1]
        if self.places != EVERYWHERE:
            # MuJoCo takes the mean of two geoms' time constants
            ground = (batch.model.body_weldid[batch.model.geom_bodyid] == 0) & standard
            solref[:, ground, 0] *= values[:, :, 0].mean(axis=1)[:, None]
        return {"geom_solref": solref}
