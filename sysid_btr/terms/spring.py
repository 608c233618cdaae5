"""Springs across a joint, and stops that give way."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from sysid_btr._typing import FloatArray, IntArray
from sysid_btr.terms.base import BatchModel, Fields, Kind
from sysid_btr.terms.effect import Effect, Probe
from sysid_btr.terms.law import Step
from sysid_btr.terms.scales import JointScale

if TYPE_CHECKING:
    import mujoco


@dataclass(frozen=True)
class JointSpring(Effect):
    """A spring across a joint: a cable, a rubber stop, gravity compensation.

    Native: `jnt_stiffness` and `qpos_spring`; stiffness zero is the plain model at any rest angle. As the model's own
    stiffness it keeps the model's own rest angle.
    """

    name: ClassVar[str] = "joint_spring"
    family: ClassVar[str] = "spring"
    field: ClassVar[str] = "stiffness"
    title: ClassVar[str] = "spring across the joint"
    signed: ClassVar[bool] = True
    kinds: ClassVar[tuple[Kind, ...]] = (
        Kind("stiffness", "Nm/rad", 0.0, 0.0, 10.0, 0.1),
        Kind("rest", "rad", 0.0, -3.0, 3.0, 0.1),
    )
    includes: ClassVar[tuple[str, ...]] = ("constant_force",)
    confounders: ClassVar[tuple[tuple[str, str], ...]] = (
        ("payload", "the same joint angle in another orientation to gravity"),
        ("encoder_scale", "a logged effort"),
    )

    @classmethod
    def sized(cls, scale: JointScale) -> tuple[Kind, ...]:
        k, reach = scale.torque_rms / scale.span, 3 * max(scale.span, 1.0)
        return (
            Kind("stiffness", "Nm/rad", 0.0, 0.0, 30 * k, 0.3 * k),
            Kind("rest", "rad", 0.0, -reach, reach, 0.2 * scale.span),
        )

    @classmethod
    def probes(cls, scale: JointScale) -> tuple[Probe, ...]:
        k = cls.sized(scale)[0].scale
        return (((k, 0.0), (k, scale.span)),)

    @classmethod
    def combine(cls, scale: JointScale, probe: Probe, amounts: FloatArray) -> FloatArray | None:
        """The probe's directions are equal springs at several places: amounts add, places average."""
        total = float(np.sum(amounts))
        if total <= 0.05 * float(np.sum(np.abs(amounts))):
            return None
        kinds = cls.sized(scale)
        values = np.array([np.dot(amounts, [d[i] for d in probe]) / total for i in range(len(kinds))])
        values[0] *= total
        return np.array([np.clip(v, k.lower, k.upper) for v, k in zip(values, kinds, strict=True)])

    @classmethod
    def own_value(cls, model: mujoco.MjModel, place: str) -> float:
        return float(model.jnt_stiffness[model.joint(place).id])

    def model_fields(self, batch: BatchModel, values: FloatArray) -> Fields:
        ids = [batch.model.joint(name).id for name in self.places]
        qpos = batch.model.jnt_qposadr[ids]
        stiffness, rest = batch.read("jnt_stiffness"), batch.read("qpos_spring")
        before = stiffness[:, ids].copy()
        stiffness[:, ids] = total = self.changed(before, values[:, :, 0])
        if self.absolute:
            return {"jnt_stiffness": stiffness}
        moment = before * rest[:, qpos] + values[:, :, 0] * values[:, :, 1]
        rest[:, qpos] = np.where(total > 0, moment / np.where(total > 0, total, 1.0), rest[:, qpos])
        return {"jnt_stiffness": stiffness, "qpos_spring": rest}


ONSETS = (-0.3, -0.1, 0.1, 0.3)
"""Where a scan looks for a stop, from the middle of the motion in spans of it."""


@dataclass(frozen=True)
class JointStop(Effect):
    """A stop that gives way: a spring that is met at an angle and pushes back beyond it; a bumper, a cable run taut.

    Law: torque = -stiffness * (q - onset) beyond the onset at the middle of each step; nothing before it.
    """

    name: ClassVar[str] = "joint_stop"
    family: ClassVar[str] = "spring"
    title: ClassVar[str] = "soft stop above an angle"
    variant: ClassVar[str] = "above"
    law_acts: ClassVar[tuple[str, ...]] = ()
    kinds: ClassVar[tuple[Kind, ...]] = (
        Kind("stiffness", "Nm/rad", 0.0, 0.0, 30.0, 0.3),
        Kind("onset", "rad", 0.0, -3.0, 3.0, 0.05),
    )
    held: ClassVar[tuple[str, ...]] = ("onset",)
    confounders: ClassVar[tuple[tuple[str, str], ...]] = (
        ("joint_spring", "motion on both sides of the onset"),
        ("encoder_cyclic_error", "a logged effort"),
    )

    @classmethod
    def sized(cls, scale: JointScale) -> tuple[Kind, ...]:
        k, reach = scale.torque_rms / scale.span, 0.6 * scale.span
        return (
            Kind("stiffness", "Nm/rad", 0.0, 0.0, 300 * k, 0.5 * k),
            Kind("onset", "rad", scale.centre, scale.centre - reach, scale.centre + reach, 0.05 * scale.span),
        )

    @classmethod
    def probes(cls, scale: JointScale) -> tuple[Probe, ...]:
        k = cls.sized(scale)[0].scale
        return tuple(((k, scale.centre + share * scale.span),) for share in ONSETS)

    @staticmethod
    def law(step: Step, numbers: FloatArray, memory: FloatArray, places: IntArray) -> None:
        for p, j in enumerate(places):
            step.joint_torque[j] -= numbers[p, 0] * max(step.qpos[j] - numbers[p, 1], 0.0)


@dataclass(frozen=True)
class JointStopBelow(JointStop):
    """Law: torque = stiffness * (onset - q) beyond the onset."""

    title: ClassVar[str] = "soft stop below an angle"
    variant: ClassVar[str] = "below"

    @staticmethod
    def law(step: Step, numbers: FloatArray, memory: FloatArray, places: IntArray) -> None:
        for p, j in enumerate(places):
            step.joint_torque[j] += numbers[p, 0] * max(numbers[p, 1] - step.qpos[j], 0.0)
