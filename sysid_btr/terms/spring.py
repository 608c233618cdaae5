"""Springs across a joint, and stops that give way."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from sysid_btr._typing import FloatArray, IntArray
from sysid_btr.terms.base import ANCHOR_SUFFIX, TETHER_SUFFIX, BatchModel, Fields, Kind
from sysid_btr.terms.effect import HELD_BASE, Effect, Probe
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


LEVER = 0.1
"""m, at which a pull makes a torque of the usual size."""
NEAR, FAR = 0.4, 1.2
"""m, to where a tether is held, from which a search begins."""
STIFF = (0.5, 2.0, 8.0)
"""Stiffness, in tensions over the distance, likewise."""


@dataclass(frozen=True)
class Tether(Effect):
    """A cable, hose or band from a point of a body to a fixed one in the world: it pulls, and never pushes.

    Its numbers are what it does in the pose where all joints of the model are at zero: the force on the body, which
    goes towards the fixed point; by how much that grows with its length; how far away the fixed point is; and where it
    holds the body, from the centre of mass, in the body's frame.

    Structure: a tendon between two sites; native `tendon_stiffness`, `tendon_lengthspring`, `site_pos`.
    """

    name: ClassVar[str] = "tether"
    family: ClassVar[str] = "spring"
    title: ClassVar[str] = "pull of a cable or band"
    scope: ClassVar = "body"
    needs: ClassVar[str] = HELD_BASE
    structural: ClassVar[bool] = True
    signed: ClassVar[bool] = True
    main: ClassVar[int] = 3
    kinds: ClassVar[tuple[Kind, ...]] = (
        *(Kind(f"pull_{axis}", "N", 0.0, -200.0, 200.0, 1.0) for axis in "xyz"),
        Kind("stiffness", "N/m", 0.0, 0.0, 1000.0, 5.0),
        Kind("distance", "m", 1.0, 0.05, 5.0, 0.2),
        *(Kind(axis, "m", 0.0, -0.2, 0.2, 0.02) for axis in "xyz"),
    )
    held: ClassVar[tuple[str, ...]] = ("stiffness", "distance", *"xyz")
    details: ClassVar[tuple[str, ...]] = ("distance", *"xyz")
    includes: ClassVar[tuple[str, ...]] = ("constant_force",)
    confounders: ClassVar[tuple[tuple[str, str], ...]] = (
        ("payload", "the same body in another orientation to gravity, or fast motion"),
        ("joint_spring", "motion of other joints, which turns the pull"),
        ("gravity_tilt", "a body that it does not hold"),
    )

    @classmethod
    def sized(cls, scale: JointScale) -> tuple[Kind, ...]:
        pull = scale.torque_rms / LEVER
        return (
            *(Kind(k.name, k.unit, 0.0, -20 * pull, 20 * pull, 0.3 * pull) for k in cls.kinds[:3]),
            Kind("stiffness", "N/m", 0.0, 0.0, 100 * pull / FAR, pull / FAR),
            *cls.kinds[4:],
        )

    @classmethod
    def probes(cls, scale: JointScale) -> tuple[Probe, ...]:
        pull = cls.sized(scale)[0].scale
        return (tuple((*row, 0.0, FAR, 0.0, 0.0, 0.0) for row in (pull * np.eye(3)).tolist()),)

    @classmethod
    def initial_guesses(cls, values: FloatArray) -> FloatArray:
        tension = float(np.linalg.norm(values[:3]))
        ways = [(stiff * tension / far, far) for far in (NEAR, FAR) for stiff in STIFF]
        return np.array([[*values[:3], *way, *values[5:]] for way in ways])

    @property
    def begin(self) -> FloatArray:
        """A small pull: where there is none, nothing responds to where it comes from."""
        kinds = self.numbers * len(self.groups)
        return np.array([p.scale if k.unit == "N" else p.nominal for k, p in zip(kinds, self.parameters, strict=True)])

    def edit_spec(self, spec: mujoco.MjSpec) -> None:
        for name in self.places:
            ends = (
                spec.body(name).add_site(name=name + TETHER_SUFFIX),
                spec.worldbody.add_site(name=name + ANCHOR_SUFFIX),
            )
            tendon = spec.add_tendon(name=name + TETHER_SUFFIX)
            for site in ends:
                tendon.wrap_site(site.name)

    def model_fields(self, batch: BatchModel, values: FloatArray) -> Fields:
        import mujoco

        model, data = batch.model, mujoco.MjData(batch.model)
        data.qpos[:] = model.qpos0
        mujoco.mj_kinematics(model, data)
        fields = {name: batch.read(name) for name in ("site_pos", "tendon_stiffness", "tendon_lengthspring")}
        for place, name in enumerate(self.places):
            own = values[:, place]
            body, tendon = model.body(name).id, model.tendon(name + TETHER_SUFFIX).id
            near, far = (model.site(name + end).id for end in (TETHER_SUFFIX, ANCHOR_SUFFIX))
            point, distance = model.body_ipos[body] + own[:, 5:8], own[:, 4]
            tension = np.linalg.norm(own[:, :3], axis=1)
            way = (
                np.where(tension[:, None] > 0, own[:, :3], [0.0, 0.0, 1.0])
                / np.where(tension > 0, tension, 1.0)[:, None]
            )
            # a pull that does not grow is one that grows by next to nothing
            stiffness = np.maximum(own[:, 3], 1e-3 * tension / distance)
            held = data.xpos[body] + point @ data.xmat[body].reshape(3, 3).T
            fields["site_pos"][:, near], fields["site_pos"][:, far] = point, held + distance[:, None] * way
            fields["tendon_stiffness"][:, tendon] = stiffness
            slack = tension / np.where(stiffness > 0, stiffness, 1.0)
            fields["tendon_lengthspring"][:, tendon] = np.stack(
                [np.minimum(distance - slack, 0.0), distance - slack], axis=1
            )
        return fields
