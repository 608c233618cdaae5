"""Declared parameters: one small term for every useful compiled field.

Masses and gains are scale factors of the nominal, everything else is in SI units.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar, Literal

import numpy as np

from sysid_btr._typing import FloatArray, IntArray
from sysid_btr.terms.base import LINK_SUFFIX, Kind, Rig, Scope, Term

if TYPE_CHECKING:
    import mujoco


@dataclass(frozen=True)
class FieldTerm(Term):
    """A parameter of the grammar; `scope` says which names its globs match."""


def _bodies(rig: Rig, places: tuple[str, ...]) -> list[int]:
    return [rig.model.body(name).id for name in places]


def _dofs(rig: Rig, places: tuple[str, ...]) -> IntArray:
    result: IntArray = rig.index.dof[rig.index.of(places)]
    return result


def _damper(rig: Rig, name: str) -> tuple[Literal["dof", "tendon"], int]:
    """Where a joint's own damping sits: on both of its sides together, where an effect has split it."""
    model = rig.model
    for t in range(model.ntendon):
        if model.tendon(t).name == name + LINK_SUFFIX:
            return "tendon", t
    return "dof", int(model.jnt_dofadr[model.joint(name).id])


def _servos(rig: Rig, places: tuple[str, ...]) -> IntArray:
    result: IntArray = rig.index.actuator[rig.index.of(places)]
    return result


def allow_any_inertia(spec: mujoco.MjSpec, places: tuple[str, ...]) -> None:
    """Tell MuJoCo that these bodies' centres of mass will move: no short cuts for symmetric bodies."""
    for name in places:
        spec.body(name).simple = 0


@dataclass(frozen=True)
class Mass(FieldTerm):
    """Mass of a body as a factor of the nominal; the inertia follows."""

    name: ClassVar[str] = "mass"
    scope: ClassVar[Scope] = "body"
    kinds: ClassVar[tuple[Kind, ...]] = (Kind("scale", "1", 1.0, 0.3, 3.0, 0.1),)

    def write_fields(self, rig: Rig, values: FloatArray) -> None:
        ids = _bodies(rig, self.places)
        rig.array("body_mass")[:, ids] *= values[:, :, 0]
        rig.array("body_inertia")[:, ids] *= values[:, :, :1]


@dataclass(frozen=True)
class Inertia(FieldTerm):
    """Rotational inertia of a body about its centre of mass, as a factor; the mass stays."""

    name: ClassVar[str] = "inertia"
    scope: ClassVar[Scope] = "body"
    kinds: ClassVar[tuple[Kind, ...]] = (Kind("scale", "1", 1.0, 0.1, 10.0, 0.2),)

    def write_fields(self, rig: Rig, values: FloatArray) -> None:
        rig.array("body_inertia")[:, _bodies(rig, self.places)] *= values[:, :, :1]


@dataclass(frozen=True)
class Com(FieldTerm):
    """Shift of a body's centre of mass in the body's frame."""

    name: ClassVar[str] = "com"
    scope: ClassVar[Scope] = "body"
    kinds: ClassVar[tuple[Kind, ...]] = tuple(Kind(axis, "m", 0.0, -0.05, 0.05, 0.005) for axis in "xyz")

    def edit_spec(self, spec: mujoco.MjSpec) -> None:
        allow_any_inertia(spec, self.places)

    def write_fields(self, rig: Rig, values: FloatArray) -> None:
        rig.array("body_ipos")[:, _bodies(rig, self.places)] += values


@dataclass(frozen=True)
class Kp(FieldTerm):
    """Proportional gain of a position servo, as a factor."""

    name: ClassVar[str] = "kp"
    scope: ClassVar[Scope] = "servo"
    kinds: ClassVar[tuple[Kind, ...]] = (Kind("scale", "1", 1.0, 0.2, 3.0, 0.05),)

    def write_fields(self, rig: Rig, values: FloatArray) -> None:
        ids = _servos(rig, self.places)
        rig.array("actuator_gainprm")[:, ids, 0] *= values[:, :, 0]
        rig.array("actuator_biasprm")[:, ids, 1] *= values[:, :, 0]


@dataclass(frozen=True)
class Kv(FieldTerm):
    """Derivative gain of a position servo, as a factor."""

    name: ClassVar[str] = "kv"
    scope: ClassVar[Scope] = "servo"
    kinds: ClassVar[tuple[Kind, ...]] = (Kind("scale", "1", 1.0, 0.0, 5.0, 0.1),)

    def write_fields(self, rig: Rig, values: FloatArray) -> None:
        rig.array("actuator_biasprm")[:, _servos(rig, self.places), 2] *= values[:, :, 0]


@dataclass(frozen=True)
class TorqueConstant(FieldTerm):
    """Torque that a servo makes, its gains and its limits alike, as a factor: motor constant over resistance."""

    name: ClassVar[str] = "torque_constant"
    scope: ClassVar[Scope] = "servo"
    kinds: ClassVar[tuple[Kind, ...]] = (Kind("scale", "1", 1.0, 0.2, 3.0, 0.05),)

    def write_fields(self, rig: Rig, values: FloatArray) -> None:
        ids = _servos(rig, self.places)
        rig.array("actuator_gainprm")[:, ids, 0] *= values[:, :, 0]
        rig.array("actuator_biasprm")[:, ids, :3] *= values[:, :, :1]
        rig.array("actuator_forcerange")[:, ids] *= values[:, :, :1]


@dataclass(frozen=True)
class Damping(FieldTerm):
    """Viscous damping of a joint."""

    name: ClassVar[str] = "damping"
    kinds: ClassVar[tuple[Kind, ...]] = (Kind("b", "Nm s/rad", np.nan, 0.0, np.inf, np.nan),)

    def write_fields(self, rig: Rig, values: FloatArray) -> None:
        for place, name in enumerate(self.places):
            kind, where = _damper(rig, name)
            rig.array(f"{kind}_damping")[:, where] = values[:, place, 0]


@dataclass(frozen=True)
class QuadraticDamping(FieldTerm):
    """Damping torque proportional to velocity times speed."""

    name: ClassVar[str] = "quadratic_damping"
    kinds: ClassVar[tuple[Kind, ...]] = (Kind("b", "Nm s2/rad2", np.nan, 0.0, np.inf, np.nan),)

    def write_fields(self, rig: Rig, values: FloatArray) -> None:
        for place, name in enumerate(self.places):
            kind, where = _damper(rig, name)
            rig.array(f"{kind}_dampingpoly")[:, where, 0] = values[:, place, 0]


@dataclass(frozen=True)
class Frictionloss(FieldTerm):
    """Dry (Coulomb) friction of a joint."""

    name: ClassVar[str] = "frictionloss"
    kinds: ClassVar[tuple[Kind, ...]] = (Kind("torque", "Nm", np.nan, 0.0, np.inf, np.nan),)

    def write_fields(self, rig: Rig, values: FloatArray) -> None:
        rig.array("dof_frictionloss")[:, _dofs(rig, self.places)] = values[:, :, 0]


@dataclass(frozen=True)
class Armature(FieldTerm):
    """Rotor inertia seen at the joint."""

    name: ClassVar[str] = "armature"
    kinds: ClassVar[tuple[Kind, ...]] = (Kind("inertia", "kg m2", np.nan, 0.0, np.inf, np.nan),)

    def write_fields(self, rig: Rig, values: FloatArray) -> None:
        rig.array("dof_armature")[:, _dofs(rig, self.places)] = values[:, :, 0]


@dataclass(frozen=True)
class Stiffness(FieldTerm):
    """Spring of a joint about its spring reference."""

    name: ClassVar[str] = "stiffness"
    kinds: ClassVar[tuple[Kind, ...]] = (Kind("k", "Nm/rad", np.nan, 0.0, np.inf, np.nan),)

    def write_fields(self, rig: Rig, values: FloatArray) -> None:
        ids = [rig.model.joint(name).id for name in self.places]
        rig.array("jnt_stiffness")[:, ids] = values[:, :, 0]


@dataclass(frozen=True)
class ForceLimit(FieldTerm):
    """Largest torque of a servo, both signs; in place of the model's own limit."""

    name: ClassVar[str] = "force_limit"
    scope: ClassVar[Scope] = "servo"
    kinds: ClassVar[tuple[Kind, ...]] = (Kind("torque", "Nm", np.nan, 0.0, np.inf, np.nan),)

    def write_fields(self, rig: Rig, values: FloatArray) -> None:
        ids = _servos(rig, self.places)
        bound = values[:, :, 0] / np.abs(rig.model.actuator_gear[ids, 0])
        rig.array("actuator_forcelimited")[:, ids] = True
        ranges = rig.array("actuator_forcerange")
        ranges[:, ids, 0], ranges[:, ids, 1] = -bound, bound


def narrow_force_limit(rig: Rig, places: tuple[str, ...], limit: FloatArray) -> None:
    """Clip servo torques to +-limit too, (m, places); an infinite limit leaves the servo as it was."""
    ids = _servos(rig, places)
    limited, ranges = rig.array("actuator_forcelimited"), rig.array("actuator_forcerange")
    finite = np.isfinite(limit)
    bound = np.where(finite, limit, 0.0)
    gear = np.abs(rig.model.actuator_gear[ids, 0])
    was = limited[:, ids].astype(bool)
    low = np.where(finite, -bound / gear, ranges[:, ids, 0])
    high = np.where(finite, bound / gear, ranges[:, ids, 1])
    ranges[:, ids, 0] = np.where(was & finite, np.maximum(low, ranges[:, ids, 0]), low)
    ranges[:, ids, 1] = np.where(was & finite, np.minimum(high, ranges[:, ids, 1]), high)
    limited[:, ids] = was | finite


@dataclass(frozen=True)
class ConstantForce(FieldTerm):
    """Constant torque (hinge) or force (slide) on a joint."""

    name: ClassVar[str] = "constant_force"
    kinds: ClassVar[tuple[Kind, ...]] = (Kind("torque", "Nm", 0.0, -np.inf, np.inf, np.nan),)

    def applied_torque(self, rig: Rig, values: FloatArray, time: FloatArray) -> FloatArray:
        torque = np.zeros((rig.size, len(time) - 1, len(rig.index.joints)))
        torque[:, :, rig.index.of(self.places)] = values[:, None, :, 0]
        return torque


@dataclass(frozen=True)
class Delay(FieldTerm):
    """Delay between the logged command and the servo."""

    name: ClassVar[str] = "delay"
    kinds: ClassVar[tuple[Kind, ...]] = (Kind("time", "s", 0.0, 0.0, 0.2, 0.005),)

    def shape_command(self, rig: Rig, values: FloatArray, command: FloatArray) -> FloatArray:
        return delay_command(command, rig.index.of(self.places), values[:, :, 0] / rig.timestep)


def delay_command(command: FloatArray, columns: IntArray, steps: FloatArray) -> FloatArray:
    """Shift held commands by a possibly fractional number of steps, (m, places); the past is the first one.

    Between whole steps the mean over the step is mixed, which is exact for a held command.
    """
    shifted = np.array(np.broadcast_to(command, (len(steps), *command.shape[1:])))
    rows = np.arange(command.shape[1])
    for place, column in enumerate(columns):
        whole = np.floor(steps[:, place]).astype(np.int64)
        part = (steps[:, place] - whole)[:, None]
        late = np.maximum(rows[None, :] - whole[:, None], 0)
        later = np.maximum(late - 1, 0)
        later[rows[None, :] - whole[:, None] <= 0] = 0
        source = np.broadcast_to(command[:, :, column], (len(steps), command.shape[1]))
        near = np.take_along_axis(source, late, axis=1)
        far = np.take_along_axis(source, later, axis=1)
        shifted[:, :, column] = (1 - part) * near + part * far
    return shifted


@dataclass(frozen=True)
class FootFriction(FieldTerm):
    """Sliding friction of a body's geoms, and of the ground where they touch it."""

    name: ClassVar[str] = "foot_friction"
    scope: ClassVar[Scope] = "body"
    kinds: ClassVar[tuple[Kind, ...]] = (Kind("mu", "1", np.nan, 0.05, 2.0, 0.1),)

    def write_fields(self, rig: Rig, values: FloatArray) -> None:
        friction = rig.array("geom_friction")
        bodies = _bodies(rig, self.places)
        for place, body in enumerate(bodies):
            friction[:, rig.model.geom_bodyid == body, 0] = values[:, place, :1]
        # MuJoCo takes the larger of two geoms' frictions, so the ground must not be the larger one
        ground = rig.model.geom_bodyid == 0
        friction[:, ground, 0] = np.minimum(friction[:, ground, 0], values[:, :, 0].min(axis=1)[:, None])


@dataclass(frozen=True)
class FootCompliance(FieldTerm):
    """Time constant of the contact between a body's geoms and the ground, as a factor of the nominal."""

    name: ClassVar[str] = "foot_compliance"
    scope: ClassVar[Scope] = "body"
    kinds: ClassVar[tuple[Kind, ...]] = (Kind("scale", "1", 1.0, 0.2, 10.0, 0.1),)

    def write_fields(self, rig: Rig, values: FloatArray) -> None:
        solref = rig.array("geom_solref")
        geoms, constant = rig.model.geom_bodyid, rig.model.geom_solref[:, 0]
        for place, body in enumerate(_bodies(rig, self.places)):
            solref[:, (geoms == body) & (constant > 0), 0] *= values[:, place, :1]
        # MuJoCo takes the mean of two geoms' time constants
        ground = (rig.model.body_weldid[geoms] == 0) & (constant > 0)
        solref[:, ground, 0] *= values[:, :, 0].mean(axis=1)[:, None]


@dataclass(frozen=True)
class StartPosition(FieldTerm):
    """Correction of the position at which the replay starts."""

    name: ClassVar[str] = "qpos0"
    kinds: ClassVar[tuple[Kind, ...]] = (Kind("offset", "rad", 0.0, -0.1, 0.1, 0.002),)

    def initial_state(self, rig: Rig, values: FloatArray, qpos: FloatArray, qvel: FloatArray) -> None:
        qpos[:, rig.index.of(self.places)] += values[:, :, 0]


@dataclass(frozen=True)
class StartVelocity(FieldTerm):
    """Correction of the velocity at which the replay starts."""

    name: ClassVar[str] = "qvel0"
    kinds: ClassVar[tuple[Kind, ...]] = (Kind("offset", "rad/s", 0.0, -5.0, 5.0, 0.05),)

    def initial_state(self, rig: Rig, values: FloatArray, qpos: FloatArray, qvel: FloatArray) -> None:
        qvel[:, rig.index.of(self.places)] += values[:, :, 0]


FIELDS: dict[str, type[FieldTerm]] = {
    cls.name: cls
    for cls in (
        Mass,
        Com,
        Inertia,
        Kp,
        Kv,
        TorqueConstant,
        Damping,
        QuadraticDamping,
        Frictionloss,
        Armature,
        Stiffness,
        ForceLimit,
        ConstantForce,
        Delay,
        FootFriction,
        FootCompliance,
        StartPosition,
        StartVelocity,
    )
}


def nominal_value(field: str, model: mujoco.MjModel, name: str) -> float:
    """Nominal of a field that is not a factor, read from the compiled model."""
    joint = {
        "damping": lambda i: model.dof_damping[model.jnt_dofadr[i]],
        "quadratic_damping": lambda i: model.dof_dampingpoly[model.jnt_dofadr[i], 0],
        "frictionloss": lambda i: model.dof_frictionloss[model.jnt_dofadr[i]],
        "armature": lambda i: model.dof_armature[model.jnt_dofadr[i]],
        "stiffness": lambda i: model.jnt_stiffness[i],
    }
    if field in joint:
        return float(joint[field](model.joint(name).id))
    if field == "foot_friction":
        # of a contact between the body and the ground, where the larger of the two counts
        geoms = np.isin(model.geom_bodyid, (0, model.body(name).id))
        return float(model.geom_friction[geoms, 0].max()) if geoms.any() else 1.0
    if field == "force_limit":
        joint_id = model.joint(name).id
        for a in range(model.nu):
            if model.actuator_trnid[a, 0] == joint_id and model.actuator_forcelimited[a]:
                return float(model.actuator_forcerange[a, 1] * abs(model.actuator_gear[a, 0]))
        return float("inf")
    return 0.0
