"""Declared parameters: one small term for every useful compiled field.

Masses and gains are scale factors of the nominal, everything else is in SI units.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar, Literal

import numpy as np

from sysid_btr._typing import FloatArray, IntArray
from sysid_btr.terms.base import LINK_SUFFIX, BatchModel, Fields, Kind, Scope, Term

if TYPE_CHECKING:
    import mujoco


@dataclass(frozen=True)
class FieldTerm(Term):
    """A parameter of the grammar; `scope` says which names its globs match."""


def _bodies(batch: BatchModel, places: tuple[str, ...]) -> list[int]:
    return [batch.model.body(name).id for name in places]


def _dofs(batch: BatchModel, places: tuple[str, ...]) -> IntArray:
    result: IntArray = batch.index.dof[batch.index.of(places)]
    return result


def _damper(batch: BatchModel, name: str) -> tuple[Literal["dof", "tendon"], int]:
    """Where a joint's own damping sits: on both of its sides together, where an effect has split it."""
    model = batch.model
    for t in range(model.ntendon):
        if model.tendon(t).name == name + LINK_SUFFIX:
            return "tendon", t
    return "dof", int(model.jnt_dofadr[model.joint(name).id])


def _servos(batch: BatchModel, places: tuple[str, ...]) -> IntArray:
    result: IntArray = batch.index.actuator[batch.index.of(places)]
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

    def model_fields(self, batch: BatchModel, values: FloatArray) -> Fields:
        ids = _bodies(batch, self.places)
        mass, inertia = batch.read("body_mass"), batch.read("body_inertia")
        mass[:, ids] *= values[:, :, 0]
        inertia[:, ids] *= values[:, :, :1]
        return {"body_mass": mass, "body_inertia": inertia}


@dataclass(frozen=True)
class Inertia(FieldTerm):
    """Rotational inertia of a body about its centre of mass, as a factor; the mass stays."""

    name: ClassVar[str] = "inertia"
    scope: ClassVar[Scope] = "body"
    kinds: ClassVar[tuple[Kind, ...]] = (Kind("scale", "1", 1.0, 0.1, 10.0, 0.2),)

    def model_fields(self, batch: BatchModel, values: FloatArray) -> Fields:
        inertia = batch.read("body_inertia")
        inertia[:, _bodies(batch, self.places)] *= values[:, :, :1]
        return {"body_inertia": inertia}


@dataclass(frozen=True)
class Com(FieldTerm):
    """Shift of a body's centre of mass in the body's frame."""

    name: ClassVar[str] = "com"
    scope: ClassVar[Scope] = "body"
    kinds: ClassVar[tuple[Kind, ...]] = tuple(Kind(axis, "m", 0.0, -0.05, 0.05, 0.005) for axis in "xyz")

    def edit_spec(self, spec: mujoco.MjSpec) -> None:
        allow_any_inertia(spec, self.places)

    def model_fields(self, batch: BatchModel, values: FloatArray) -> Fields:
        centre = batch.read("body_ipos")
        centre[:, _bodies(batch, self.places)] += values
        return {"body_ipos": centre}


@dataclass(frozen=True)
class Kp(FieldTerm):
    """Proportional gain of a position servo, as a factor."""

    name: ClassVar[str] = "kp"
    scope: ClassVar[Scope] = "servo"
    kinds: ClassVar[tuple[Kind, ...]] = (Kind("scale", "1", 1.0, 0.2, 3.0, 0.05),)

    def model_fields(self, batch: BatchModel, values: FloatArray) -> Fields:
        ids = _servos(batch, self.places)
        gain, bias = batch.read("actuator_gainprm"), batch.read("actuator_biasprm")
        gain[:, ids, 0] *= values[:, :, 0]
        bias[:, ids, 1] *= values[:, :, 0]
        return {"actuator_gainprm": gain, "actuator_biasprm": bias}


@dataclass(frozen=True)
class Kv(FieldTerm):
    """Derivative gain of a position servo, as a factor."""

    name: ClassVar[str] = "kv"
    scope: ClassVar[Scope] = "servo"
    kinds: ClassVar[tuple[Kind, ...]] = (Kind("scale", "1", 1.0, 0.0, 5.0, 0.1),)

    def model_fields(self, batch: BatchModel, values: FloatArray) -> Fields:
        bias = batch.read("actuator_biasprm")
        bias[:, _servos(batch, self.places), 2] *= values[:, :, 0]
        return {"actuator_biasprm": bias}


@dataclass(frozen=True)
class TorqueConstant(FieldTerm):
    """Torque that a servo makes, its gains and its limits alike, as a factor: motor constant over resistance."""

    name: ClassVar[str] = "torque_constant"
    scope: ClassVar[Scope] = "servo"
    kinds: ClassVar[tuple[Kind, ...]] = (Kind("scale", "1", 1.0, 0.2, 3.0, 0.05),)

    def model_fields(self, batch: BatchModel, values: FloatArray) -> Fields:
        ids = _servos(batch, self.places)
        gain, bias, limits = (batch.read(f"actuator_{name}") for name in ("gainprm", "biasprm", "forcerange"))
        gain[:, ids, 0] *= values[:, :, 0]
        bias[:, ids, :3] *= values[:, :, :1]
        limits[:, ids] *= values[:, :, :1]
        return {"actuator_gainprm": gain, "actuator_biasprm": bias, "actuator_forcerange": limits}


@dataclass(frozen=True)
class Damping(FieldTerm):
    """Viscous damping of a joint."""

    name: ClassVar[str] = "damping"
    kinds: ClassVar[tuple[Kind, ...]] = (Kind("b", "Nm s/rad", np.nan, 0.0, np.inf, np.nan),)

    def model_fields(self, batch: BatchModel, values: FloatArray) -> Fields:
        fields: dict[str, FloatArray] = {}
        for place, name in enumerate(self.places):
            kind, where = _damper(batch, name)
            damping = fields.setdefault(f"{kind}_damping", batch.read(f"{kind}_damping"))
            damping[:, where] = values[:, place, 0]
        return fields


@dataclass(frozen=True)
class QuadraticDamping(FieldTerm):
    """Damping torque proportional to velocity times speed."""

    name: ClassVar[str] = "quadratic_damping"
    kinds: ClassVar[tuple[Kind, ...]] = (Kind("b", "Nm s2/rad2", np.nan, 0.0, np.inf, np.nan),)

    def model_fields(self, batch: BatchModel, values: FloatArray) -> Fields:
        fields: dict[str, FloatArray] = {}
        for place, name in enumerate(self.places):
            kind, where = _damper(batch, name)
            damping = fields.setdefault(f"{kind}_dampingpoly", batch.read(f"{kind}_dampingpoly"))
            damping[:, where, 0] = values[:, place, 0]
        return fields


@dataclass(frozen=True)
class Frictionloss(FieldTerm):
    """Dry (Coulomb) friction of a joint."""

    name: ClassVar[str] = "frictionloss"
    kinds: ClassVar[tuple[Kind, ...]] = (Kind("torque", "Nm", np.nan, 0.0, np.inf, np.nan),)

    def model_fields(self, batch: BatchModel, values: FloatArray) -> Fields:
        friction = batch.read("dof_frictionloss")
        friction[:, _dofs(batch, self.places)] = values[:, :, 0]
        return {"dof_frictionloss": friction}


@dataclass(frozen=True)
class Armature(FieldTerm):
    """Rotor inertia seen at the joint."""

    name: ClassVar[str] = "armature"
    kinds: ClassVar[tuple[Kind, ...]] = (Kind("inertia", "kg m2", np.nan, 0.0, np.inf, np.nan),)

    def model_fields(self, batch: BatchModel, values: FloatArray) -> Fields:
        armature = batch.read("dof_armature")
        armature[:, _dofs(batch, self.places)] = values[:, :, 0]
        return {"dof_armature": armature}


@dataclass(frozen=True)
class Stiffness(FieldTerm):
    """Spring of a joint about its spring reference."""

    name: ClassVar[str] = "stiffness"
    kinds: ClassVar[tuple[Kind, ...]] = (Kind("k", "Nm/rad", np.nan, 0.0, np.inf, np.nan),)

    def model_fields(self, batch: BatchModel, values: FloatArray) -> Fields:
        ids = [batch.model.joint(name).id for name in self.places]
        stiffness = batch.read("jnt_stiffness")
        stiffness[:, ids] = values[:, :, 0]
        return {"jnt_stiffness": stiffness}


@dataclass(frozen=True)
class ForceLimit(FieldTerm):
    """Largest torque of a servo, both signs; in place of the model's own limit."""

    name: ClassVar[str] = "force_limit"
    scope: ClassVar[Scope] = "servo"
    kinds: ClassVar[tuple[Kind, ...]] = (Kind("torque", "Nm", np.nan, 0.0, np.inf, np.nan),)

    def model_fields(self, batch: BatchModel, values: FloatArray) -> Fields:
        ids = _servos(batch, self.places)
        bound = values[:, :, 0] / np.abs(batch.model.actuator_gear[ids, 0])
        limited, ranges = batch.read("actuator_forcelimited"), batch.read("actuator_forcerange")
        limited[:, ids] = True
        ranges[:, ids, 0], ranges[:, ids, 1] = -bound, bound
        return {"actuator_forcelimited": limited, "actuator_forcerange": ranges}


def narrow_force_limit(batch: BatchModel, places: tuple[str, ...], limit: FloatArray) -> Fields:
    """Clip servo torques to +-limit too, (m, places); an infinite limit leaves the servo as it was."""
    ids = _servos(batch, places)
    limited, ranges = batch.read("actuator_forcelimited"), batch.read("actuator_forcerange")
    finite = np.isfinite(limit)
    bound = np.where(finite, limit, 0.0)
    gear = np.abs(batch.model.actuator_gear[ids, 0])
    was = limited[:, ids].astype(bool)
    low = np.where(finite, -bound / gear, ranges[:, ids, 0])
    high = np.where(finite, bound / gear, ranges[:, ids, 1])
    ranges[:, ids, 0] = np.where(was & finite, np.maximum(low, ranges[:, ids, 0]), low)
    ranges[:, ids, 1] = np.where(was & finite, np.minimum(high, ranges[:, ids, 1]), high)
    limited[:, ids] = was | finite
    return {"actuator_forcelimited": limited, "actuator_forcerange": ranges}


@dataclass(frozen=True)
class ConstantForce(FieldTerm):
    """Constant torque (hinge) or force (slide) on a joint."""

    name: ClassVar[str] = "constant_force"
    kinds: ClassVar[tuple[Kind, ...]] = (Kind("torque", "Nm", 0.0, -np.inf, np.inf, np.nan),)

    def applied_torque(self, batch: BatchModel, values: FloatArray, time: FloatArray) -> FloatArray:
        torque = np.zeros((batch.size, len(time) - 1, len(batch.index.joints)))
        torque[:, :, batch.index.of(self.places)] = values[:, None, :, 0]
        return torque


@dataclass(frozen=True)
class Delay(FieldTerm):
    """Delay between the logged command and the servo."""

    name: ClassVar[str] = "delay"
    kinds: ClassVar[tuple[Kind, ...]] = (Kind("time", "s", 0.0, 0.0, 0.2, 0.005),)

    def shape_command(self, batch: BatchModel, values: FloatArray, command: FloatArray) -> FloatArray:
        return delay_command(command, batch.index.of(self.places), values[:, :, 0] / batch.timestep)


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

    def model_fields(self, batch: BatchModel, values: FloatArray) -> Fields:
        friction = batch.read("geom_friction")
        bodies = _bodies(batch, self.places)
        for place, body in enumerate(bodies):
            friction[:, batch.model.geom_bodyid == body, 0] = values[:, place, :1]
        # MuJoCo takes the larger of two geoms' frictions, so the ground must not be the larger one
        ground = batch.model.geom_bodyid == 0
        friction[:, ground, 0] = np.minimum(friction[:, ground, 0], values[:, :, 0].min(axis=1)[:, None])
        return {"geom_friction": friction}


@dataclass(frozen=True)
class FootCompliance(FieldTerm):
    """Time constant of the contact between a body's geoms and the ground, as a factor of the nominal."""

    name: ClassVar[str] = "foot_compliance"
    scope: ClassVar[Scope] = "body"
    kinds: ClassVar[tuple[Kind, ...]] = (Kind("scale", "1", 1.0, 0.2, 10.0, 0.1),)

    def model_fields(self, batch: BatchModel, values: FloatArray) -> Fields:
        solref = batch.read("geom_solref")
        geoms, constant = batch.model.geom_bodyid, batch.model.geom_solref[:, 0]
        for place, body in enumerate(_bodies(batch, self.places)):
            solref[:, (geoms == body) & (constant > 0), 0] *= values[:, place, :1]
        # MuJoCo takes the mean of two geoms' time constants
        ground = (batch.model.body_weldid[geoms] == 0) & (constant > 0)
        solref[:, ground, 0] *= values[:, :, 0].mean(axis=1)[:, None]
        return {"geom_solref": solref}


@dataclass(frozen=True)
class StartPosition(FieldTerm):
    """Correction of the position at which the replay starts."""

    name: ClassVar[str] = "qpos0"
    kinds: ClassVar[tuple[Kind, ...]] = (Kind("offset", "rad", 0.0, -0.1, 0.1, 0.002),)

    def initial_state(self, batch: BatchModel, values: FloatArray, qpos: FloatArray, qvel: FloatArray) -> None:
        qpos[:, batch.index.of(self.places)] += values[:, :, 0]


@dataclass(frozen=True)
class StartVelocity(FieldTerm):
    """Correction of the velocity at which the replay starts."""

    name: ClassVar[str] = "qvel0"
    kinds: ClassVar[tuple[Kind, ...]] = (Kind("offset", "rad/s", 0.0, -5.0, 5.0, 0.05),)

    def initial_state(self, batch: BatchModel, values: FloatArray, qpos: FloatArray, qvel: FloatArray) -> None:
        qvel[:, batch.index.of(self.places)] += values[:, :, 0]


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
