"""What a file states of each object, where that is in the compiled model, and how it is written."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np

from sysid_btr._typing import FloatArray
from sysid_btr.mujoco_conventions import HINGE, SINGLE
from sysid_btr.writeback.xmltext import number, numbers

if TYPE_CHECKING:
    import mujoco

Kind = Literal["option", "body", "joint", "geom", "site", "actuator", "tendon"]
Attributes = dict[str, str | None]
Read = Callable[["mujoco.MjModel", int], FloatArray]
Write = Callable[["mujoco.MjModel", "mujoco.MjModel", int, float], Attributes]
SAME = 1e-13
"""Relative difference below which nothing is written: what an angle in degrees may lose."""


@dataclass(frozen=True)
class Feature:
    """One property of one kind of object.

    Attributes
    ----------
    kind, label : of what, and its name in MJCF.
    fields : compiled fields that hold it.
    read : (model, id) -> its value.
    write : (present model, wanted model, id, angle) -> attributes that state it; `angle` is the unit of angles
        in rad. None where the whole element has to be looked at (`rewrite`).
    """

    kind: Kind
    label: str
    fields: tuple[str, ...]
    read: Read
    write: Write | None = None


def same(a: FloatArray, b: FloatArray, tolerance: float = SAME) -> bool:
    """Whether two values agree, relative to the larger one."""
    if a.shape != b.shape:
        return False
    size = max(float(np.max(np.abs(a), initial=0.0)), float(np.max(np.abs(b), initial=0.0)))
    return bool(np.max(np.abs(a - b), initial=0.0) <= tolerance * size)


def differ(feature: Feature, now: mujoco.MjModel, target: mujoco.MjModel, i: int) -> bool:
    """Whether an object of two models has another value."""
    return not same(feature.read(now, i), feature.read(target, i))


def _at(field: str) -> Read:
    return lambda model, i: np.atleast_1d(getattr(model, field)[i]).astype(np.float64)


# --- bodies ---------------------------------------------------------------------------------------------


def tensor(model: mujoco.MjModel, i: int) -> FloatArray:
    """Inertia (3, 3) of a body about its centre of mass, in the body's frame."""
    from scipy.spatial.transform import Rotation

    rotation = Rotation.from_quat(model.body_iquat[i], scalar_first=True).as_matrix()
    return np.asarray(rotation @ np.diag(model.body_inertia[i]) @ rotation.T)


# --- joints ---------------------------------------------------------------------------------------------


def _dof(field: str, poly: str | None = None) -> Read:
    def read(model: mujoco.MjModel, i: int) -> FloatArray:
        d = int(model.jnt_dofadr[i])
        first = np.atleast_1d(getattr(model, field)[d])
        return np.concatenate([first, getattr(model, poly)[d]]) if poly else np.asarray(first, np.float64)

    return read


def _stiffness(model: mujoco.MjModel, i: int) -> FloatArray:
    return np.concatenate([[model.jnt_stiffness[i]], model.jnt_stiffnesspoly[i]])


def _range(model: mujoco.MjModel, i: int) -> FloatArray:
    limited = bool(model.jnt_limited[i])
    return np.array([limited, *(model.jnt_range[i] if limited else (0.0, 0.0))], dtype=np.float64)


def _qpos(field: str) -> Read:
    """A reference of a hinge or slide; of the others it is no number of the joint's own."""

    def read(model: mujoco.MjModel, i: int) -> FloatArray:
        if model.jnt_type[i] not in SINGLE:
            return np.zeros(1)
        return np.asarray(getattr(model, field)[model.jnt_qposadr[i]][None], dtype=np.float64)

    return read


def _dry(field: str) -> Read:
    """Solver parameters of dry friction, which count only where there is some."""

    def read(model: mujoco.MjModel, i: int) -> FloatArray:
        d = int(model.jnt_dofadr[i])
        value = np.asarray(getattr(model, field)[d], dtype=np.float64)
        return value if model.dof_frictionloss[d] > 0 else np.zeros_like(value)

    return read


def _in(model: mujoco.MjModel, i: int, angle: float) -> float:
    return angle if model.jnt_type[i] == HINGE else 1.0


def _full(read: Read, name: str) -> Write:
    return lambda _, wanted, i, _angle: {name: numbers(read(wanted, i))}


def _short(read: Read, name: str) -> Write:
    """As many numbers as either model has that are not zero."""

    def write(now: mujoco.MjModel, wanted: mujoco.MjModel, i: int, _: float) -> Attributes:
        values = read(wanted, i)
        return {name: numbers(values[: max(significant(values), significant(read(now, i)))])}

    return write


def significant(values: FloatArray) -> int:
    """How many numbers there are before zeros only; at least one."""
    nonzero = np.flatnonzero(values)
    return int(nonzero[-1]) + 1 if len(nonzero) else 1


def _write_range(_: mujoco.MjModel, model: mujoco.MjModel, i: int, angle: float) -> Attributes:
    if not model.jnt_limited[i]:
        return {"limited": "false"}
    return {"limited": "true", "range": numbers(model.jnt_range[i] / _in(model, i, angle))}


def _write_angle(field: str, name: str) -> Write:
    read = _qpos(field)
    return lambda _, model, i, angle: {name: number(float(read(model, i)[0]) / _in(model, i, angle))}


# --- actuators ------------------------------------------------------------------------------------------


def _force_range(model: mujoco.MjModel, i: int) -> FloatArray:
    limited = bool(model.actuator_forcelimited[i])
    low, high = model.actuator_forcerange[i] if limited else (0.0, 0.0)
    return np.array([limited, low, high], dtype=np.float64)


def _write_force_range(_: mujoco.MjModel, model: mujoco.MjModel, i: int, _angle: float) -> Attributes:
    if not model.actuator_forcelimited[i]:
        return {"forcelimited": "false"}
    return {"forcelimited": "true", "forcerange": numbers(model.actuator_forcerange[i])}


INTERPOLATION = ("zoh", "linear", "cubic")


def _delay(model: mujoco.MjModel, i: int) -> FloatArray:
    return np.array([model.actuator_delay[i], *model.actuator_history[i]], dtype=np.float64)


def _write_delay(_: mujoco.MjModel, model: mujoco.MjModel, i: int, _angle: float) -> Attributes:
    samples, interpolation = (int(n) for n in model.actuator_history[i])
    return {
        "delay": number(float(model.actuator_delay[i])),
        "nsample": str(samples),
        "interp": INTERPOLATION[interpolation],
    }


def _gains(model: mujoco.MjModel, i: int) -> FloatArray:
    return np.concatenate([model.actuator_gainprm[i], model.actuator_biasprm[i]])


# --- options --------------------------------------------------------------------------------------------

INTEGRATORS = ("Euler", "RK4", "implicit", "implicitfast")


def _option(name: str) -> Read:
    return lambda model, _: np.atleast_1d(getattr(model.opt, name)).astype(np.float64)


def _write_integrator(_: mujoco.MjModel, model: mujoco.MjModel, _i: int, _angle: float) -> Attributes:
    return {"integrator": INTEGRATORS[int(model.opt.integrator)]}


def _tendon(name: str) -> Read:
    return lambda model, i: np.append(getattr(model, f"tendon_{name}")[i], getattr(model, f"tendon_{name}poly")[i])


def _make_features() -> Iterator[Feature]:
    def stated(kind: Kind, label: str, fields: str, read: Read, write: Callable[[Read, str], Write] = _full) -> Feature:
        return Feature(kind, label, tuple(fields.split()), read, write(read, label))

    yield stated("option", "timestep", "opt.timestep", _option("timestep"))
    yield Feature("option", "integrator", ("opt.integrator",), _option("integrator"), _write_integrator)
    yield stated("option", "gravity", "opt.gravity", _option("gravity"))
    yield Feature("body", "mass", ("body_mass",), _at("body_mass"))
    yield Feature("body", "centre of mass", ("body_ipos",), _at("body_ipos"))
    yield Feature("body", "inertia", ("body_inertia", "body_iquat"), tensor)
    damping = _dof("dof_damping", "dof_dampingpoly")
    yield stated("joint", "damping", "dof_damping dof_dampingpoly", damping, _short)
    yield stated("joint", "frictionloss", "dof_frictionloss", _dof("dof_frictionloss"))
    yield stated("joint", "solreffriction", "dof_solref", _dry("dof_solref"))
    yield stated("joint", "solimpfriction", "dof_solimp", _dry("dof_solimp"))
    yield stated("joint", "armature", "dof_armature", _dof("dof_armature"))
    yield stated("joint", "stiffness", "jnt_stiffness jnt_stiffnesspoly", _stiffness, _short)
    for label, field in (("springref", "qpos_spring"), ("ref", "qpos0")):
        yield Feature("joint", label, (field,), _qpos(field), _write_angle(field, label))
    yield Feature("joint", "range", ("jnt_range", "jnt_limited"), _range, _write_range)
    yield stated("joint", "solreflimit", "jnt_solref", _at("jnt_solref"))
    yield stated("joint", "solimplimit", "jnt_solimp", _at("jnt_solimp"))
    yield stated("geom", "friction", "geom_friction", _at("geom_friction"))
    yield stated("geom", "solref", "geom_solref", _at("geom_solref"))
    yield stated("geom", "solimp", "geom_solimp", _at("geom_solimp"))
    yield stated("site", "pos", "site_pos", _at("site_pos"))
    yield Feature("actuator", "gains", ("actuator_gainprm", "actuator_biasprm"), _gains)
    limits = ("actuator_forcerange", "actuator_forcelimited")
    yield Feature("actuator", "forcerange", limits, _force_range, _write_force_range)
    yield Feature("actuator", "delay", ("actuator_delay", "actuator_history"), _delay, _write_delay)
    for label in ("damping", "stiffness"):
        yield stated("tendon", label, f"tendon_{label} tendon_{label}poly", _tendon(label), _short)
    yield stated("tendon", "springlength", "tendon_lengthspring", _at("tendon_lengthspring"))


FEATURES: tuple[Feature, ...] = tuple(_make_features())
"""All that a term of this package may change, in the order in which it is reported."""

WRITTEN = frozenset(name for feature in FEATURES for name in feature.fields)
"""Compiled fields that a file states."""

COUNTS: Mapping[Kind, str] = {
    "body": "nbody",
    "joint": "njnt",
    "geom": "ngeom",
    "site": "nsite",
    "actuator": "nu",
    "tendon": "ntendon",
}


def count(model: mujoco.MjModel, kind: Kind) -> int:
    """Number of objects of a kind; options are one."""
    return 1 if kind == "option" else int(getattr(model, COUNTS[kind]))


def of_kind(kind: Kind) -> tuple[Feature, ...]:
    """Features of one kind of object."""
    return tuple(f for f in FEATURES if f.kind == kind)
