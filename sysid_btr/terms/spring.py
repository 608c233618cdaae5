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
NEAREST, NEAR, FAR = 0.1, 0.4, 1.2
"""m, to where a tether is held, from which a search begins."""
STIFF = (0.5, 2.0, 8.0)
"""Stiffness, in tensions over the distance, likewise."""
SHORTEST, SOFTEST = 0.01, 1e-3
"""m, of a tether at least; stiffness of one whose pull does not grow, in tensions over its length."""


@dataclass(frozen=True)
class Tether(Effect):
    """A cable, hose or band from a point of a body to a fixed one in the world: it pulls, and never pushes.

    Its numbers are what it is in the pose where the model's joints are at their reference: its tension; by how much
    that grows with its length; where the fixed point is, from the one that it holds, in the world; and where it holds
    the body, from the centre of mass, in the body's frame.

    Structure: a tendon between two sites; native `tendon_stiffness`, `tendon_lengthspring`, `site_pos`.
    """

    name: ClassVar[str] = "tether"
    family: ClassVar[str] = "spring"
    title: ClassVar[str] = "pull of a cable or band"
    scope: ClassVar = "body"
    needs: ClassVar[str] = HELD_BASE
    structural: ClassVar[bool] = True
    signed: ClassVar[bool] = True
    kinds: ClassVar[tuple[Kind, ...]] = (
        Kind("tension", "N", 0.0, 0.0, 200.0, 1.0),
        Kind("stiffness", "N/m", 0.0, 0.0, 1000.0, 5.0),
        *(Kind(f"to_{axis}", "m", at, -5.0, 5.0, 0.2) for axis, at in zip("xyz", (0.0, 0.0, FAR), strict=True)),
        *(Kind(axis, "m", 0.0, -0.2, 0.2, 0.02) for axis in "xyz"),
    )
    details: ClassVar[tuple[str, ...]] = ("to_x", "to_y", "to_z", *"xyz")
    includes: ClassVar[tuple[str, ...]] = ("constant_force",)
    confounders: ClassVar[tuple[tuple[str, str], ...]] = (
        ("payload", "the same body in another orientation to gravity, or fast motion"),
        ("joint_spring", "motion of other joints, which turns the pull"),
        ("gravity_tilt", "a body that it does not hold"),
    )

    @classmethod
    def sized(cls, scale: JointScale) -> tuple[Kind, ...]:
        pull = scale.torque_rms / (1.0 if scale.slide else LEVER)
        return (
            Kind("tension", "N", 0.0, 0.0, 20 * pull, 0.3 * pull),
            Kind("stiffness", "N/m", 0.0, 0.0, 100 * pull / FAR, pull / FAR),
            *cls.kinds[2:],
        )

    @classmethod
    def probes(cls, scale: JointScale) -> tuple[Probe, ...]:
        """The same tension along each axis, and a spring to where the body is held at the reference."""
        pull = cls.sized(scale)[0].scale
        pulls = tuple((pull, 0.0, *way, 0.0, 0.0, 0.0) for way in (FAR * np.eye(3)).tolist())
        return ((*pulls, (0.0, pull / NEAR, 0.0, 0.0, SHORTEST, 0.0, 0.0, 0.0)),)

    @classmethod
    def combine(cls, scale: JointScale, probe: Probe, amounts: FloatArray) -> FloatArray | None:
        """The probe's directions are pulls, which add, whatever their signs, and how they turn and grow.

        A spring without a length of its own, whose pull is a force at the reference, is held as far away as its
        stiffness says.
        """
        *pulls, growth = np.asarray(amounts, dtype=np.float64)
        force, stiffness = np.array(pulls) * probe[0][0], max(growth, 0.0) * probe[-1][1]
        tension = float(np.linalg.norm(force))
        if tension == 0:
            return None
        most, stiffest = (kind.upper for kind in cls.sized(scale)[:2])
        far = max(tension / stiffness, NEAREST) if stiffness * FAR > tension else FAR
        return np.array([min(tension, most), min(stiffness, stiffest), *(far * force / tension), 0.0, 0.0, 0.0])

    @classmethod
    def initial_guesses(cls, values: FloatArray) -> FloatArray:
        tension, way = float(values[0]), values[2:5] / max(float(np.linalg.norm(values[2:5])), SHORTEST)
        return np.array(
            [[tension, stiff * tension / far, *(far * way), *values[5:]] for far in (NEAR, FAR) for stiff in STIFF]
        )

    @property
    def begin(self) -> FloatArray:
        """A small pull: where there is none, nothing responds to where it comes from."""
        kinds = self.numbers * len(self.groups)
        return np.array([p.scale if k.unit == "N" else p.nominal for k, p in zip(kinds, self.parameters, strict=True)])

    def edit_spec(self, spec: mujoco.MjSpec) -> None:
        for name in self.places:
            spec.body(name).add_site(name=name + TETHER_SUFFIX)
            spec.worldbody.add_site(name=name + ANCHOR_SUFFIX)
            tendon = spec.add_tendon(name=name + TETHER_SUFFIX)
            for end in (TETHER_SUFFIX, ANCHOR_SUFFIX):
                tendon.wrap_site(name + end)

    def model_fields(self, batch: BatchModel, values: FloatArray) -> Fields:
        model = batch.model
        fields = {name: batch.read(name) for name in ("site_pos", "tendon_stiffness", "tendon_lengthspring")}
        for place, name in enumerate(self.places):
            body, tendon = model.body(name).id, model.tendon(name + TETHER_SUFFIX).id
            near, anchor = (model.site(name + end).id for end in (TETHER_SUFFIX, ANCHOR_SUFFIX))
            origin, turn = _placed(batch, body)
            centre = batch.read("body_ipos")[:, body]
            tension, stiffness, to, point = np.split(values[:, place], (1, 2, 5), axis=1)
            length = np.maximum(np.linalg.norm(to, axis=1, keepdims=True), SHORTEST)
            stiffness = np.maximum(stiffness, SOFTEST * tension / length)
            rest = length - tension / np.where(stiffness > 0, stiffness, 1.0)
            fields["site_pos"][:, near] = centre + point
            fields["site_pos"][:, anchor] = origin + np.einsum("mij,mj->mi", turn, centre + point) + to
            fields["tendon_stiffness"][:, tendon] = stiffness[:, 0]
            # equal ends below zero would ask for a length of MuJoCo's own
            fields["tendon_lengthspring"][:, tendon] = np.hstack([np.where(rest < 0, rest - 1, 0.0), rest])
        return fields


def _placed(batch: BatchModel, body: int) -> tuple[FloatArray, FloatArray]:
    """Where a body's frame is in the world at the reference pose, (m, 3), and how it is turned, (m, 3, 3)."""
    import mujoco

    # joints' places differ where logs differ, and in no term
    differing = [batch.fields[name] for name in ("body_pos", "body_quat", "qpos0") if name in batch.fields]
    origin, turn = np.empty((batch.size, 3)), np.empty((batch.size, 3, 3))
    known: dict[bytes, tuple[FloatArray, FloatArray]] = {}
    for i in range(batch.size):
        own = b"".join(rows[i].tobytes() for rows in differing)
        if own not in known:
            data = mujoco.MjData(model := batch.candidate(i) if differing else batch.model)
            mujoco.mj_kinematics(model, data)
            known[own] = data.xpos[body].copy(), data.xmat[body].reshape(3, 3).copy()
        origin[i], turn[i] = known[own]
    return origin, turn
