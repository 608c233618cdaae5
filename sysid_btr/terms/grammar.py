"""The parameter grammar: ``FIELD:GLOB[,GLOB...][=shared]`` to terms of a robot."""

from __future__ import annotations

import difflib
import fnmatch
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Protocol

from sysid_btr.errors import UsageError
from sysid_btr.terms.base import Parameter, Scope
from sysid_btr.terms.fields import FIELDS, FieldTerm, nominal_value
from sysid_btr.terms.scales import SLIDE_UNITS, JointScale, Scales

if TYPE_CHECKING:
    import mujoco


class Robot(Protocol):
    """What the grammar asks of a robot; `models.robot.Robot` answers."""

    @property
    def name(self) -> str: ...

    @property
    def bounds(self) -> Mapping[str, tuple[float, float]]: ...

    @property
    def tied(self) -> tuple[tuple[str, ...], ...]: ...

    @property
    def fields(self) -> Mapping[str, type[FieldTerm]]: ...

    def compile(self) -> mujoco.MjModel: ...

    def names(self, scope: Scope) -> tuple[str, ...]: ...


def parse_parameters(
    expressions: Sequence[str], robot: Robot, scales: Scales | None = None
) -> tuple[FieldTerm, ...]:
    """Terms for the parameters that a user frees.

    Parameters
    ----------
    expressions : such as ``mass:*Knee*,*HipPitch``, ``kp:*=shared``, ``frictionloss:slider``.
    robot : names, nominal values, bounds and joints that share a motor.
    scales : sizes at each joint, for bounds of absolute fields; without them only factors are bounded.

    Raises
    ------
    UsageError
        Naming what does not match, and what there is; all problems at once.
    """
    problems: list[str] = []
    result: list[FieldTerm] = []
    taken: dict[str, str] = {}
    for expression in expressions:
        try:
            for term in _parse_one(expression, robot, scales):
                for place in term.places:
                    key = f"{term.name}:{place}"
                    if key in taken:
                        raise UsageError(f"{key} is already declared by {taken[key]!r}")
                    taken[key] = expression
                result.append(term)
        except UsageError as error:
            problems.append(f"  --fit {expression}: {error}")
    if problems:
        raise UsageError("parameters that cannot be used:\n" + "\n".join(problems))
    return tuple(result)


def _parse_one(expression: str, robot: Robot, scales: Scales | None) -> list[FieldTerm]:
    field, colon, rest = expression.partition(":")
    if not colon or not rest:
        raise UsageError("expected FIELD:GLOB[,GLOB...][=shared], for example mass:*KneePitch or kp:*=shared")
    fields = _known_fields(field, robot)
    globs, equals, option = rest.partition("=")
    if equals and option != "shared":
        raise UsageError(f"after '=' only 'shared' is allowed, not {option!r}")
    cls = fields[field]
    known = robot.names(cls.scope)
    names: list[str] = []
    for glob in globs.split(","):
        matched = [n for n in known if fnmatch.fnmatchcase(n, glob)]
        if not matched:
            raise UsageError(
                f"{glob!r} matches no {_scope_noun(cls.scope)} of {robot.name}; there are: {', '.join(known)}"
            )
        names += [n for n in matched if n not in names]
    if option == "shared":
        return [_build(cls, tuple(names), robot, scales, label=globs)]
    return [_build(cls, group, robot, scales) for group in _motors(cls.scope, names, robot)]


ALSO_CALLED = {
    "friction": "frictionloss",
    "coulomb_friction": "frictionloss",
    "viscous_damping": "damping",
    "joint_spring": "stiffness",
    "spring": "stiffness",
    "torque_limit": "force_limit",
    "command_delay": "delay",
    "com_offset": "com",
    "p": "kp",
    "d": "kv",
    "kd": "kv",
    "gain": "kp",
}
"""Names that people try -> fields; some are effects, which `close` looks for by itself."""


def _known_fields(field: str, robot: Robot) -> dict[str, type[FieldTerm]]:
    """All fields of a robot, if `field` is one."""
    fields = {**FIELDS, **robot.fields}
    if field not in fields:
        meant = ALSO_CALLED.get(field) or next(iter(difflib.get_close_matches(field, fields, n=1)), None)
        hint = f" (did you mean {meant!r}?)" if meant else ""
        raise UsageError(f"unknown field {field!r}{hint}; fields are {', '.join(fields)}")
    return fields


def check_expression(name: str, robot: Robot) -> None:
    """Check that a field, or a parameter's name, is one that the robot can have.

    Raises
    ------
    UsageError
        Saying what is unknown, and what there is.
    """
    label, colon, places = name.partition(":")
    field, dot, kind = label.partition(".")
    kinds = [k.name for k in _known_fields(field, robot)[field].kinds]
    if dot and kind not in kinds:
        raise UsageError(f"{field} has no {kind!r}; it has {', '.join(kinds)}")
    if colon:
        _parse_one(f"{field}:{places}", robot, None)


def _scope_noun(scope: Scope) -> str:
    return {"body": "body with mass", "servo": "joint with a servo"}.get(scope, scope)


def _motors(scope: Scope, names: list[str], robot: Robot) -> list[tuple[str, ...]]:
    """Names one by one, but joints that one motor drives together."""
    groups: list[tuple[str, ...]] = []
    seen: set[str] = set()
    for name in names:
        if name in seen:
            continue
        tied = next((t for t in robot.tied if name in t), (name,)) if scope == "servo" else (name,)
        groups.append(tuple(t for t in tied if t in names))
        seen.update(groups[-1])
    return groups


def _build(
    cls: type[FieldTerm],
    places: tuple[str, ...],
    robot: Robot,
    scales: Scales | None,
    label: str | None = None,
) -> FieldTerm:
    model = robot.compile()
    bare = cls(places=places, shared=len(places) > 1)
    known = []
    for parameter in bare.parameters:
        limits = _limits(parameter, cls.name, places[0], robot, model, scales)
        if label is not None:
            limits = replace(limits, name=f"{limits.name.partition(':')[0]}:{label}")
        known.append(limits)
    return replace(bare, known=tuple(known))


def _limits(
    parameter: Parameter,
    field: str,
    place: str,
    robot: Robot,
    model: mujoco.MjModel,
    scales: Scales | None,
) -> Parameter:
    """Nominal, bounds, scale and unit of one parameter at one place."""
    scale = None if scales is None else scales.get(place)
    nominal = nominal_value(field, model, place) if math.isnan(parameter.nominal) else parameter.nominal
    size, reach = parameter.scale, math.inf
    if field in SIZES and scale is not None:
        size, reach = SIZES[field](scale)
    if math.isnan(size):
        size = 0.1 * abs(nominal) if nominal and math.isfinite(nominal) else 1.0
    if not math.isfinite(reach):
        reach = 100 * size
    lower = parameter.lower if math.isfinite(parameter.lower) else -reach
    unlimited = not math.isfinite(nominal)
    upper = parameter.upper
    if not math.isfinite(upper):
        upper = reach if unlimited else max(reach, 10 * nominal)
    if unlimited:
        nominal = upper
    lower, upper = _own_bounds(parameter.name, field, place, robot.bounds, (lower, upper))
    unit = SLIDE_UNITS.get(parameter.unit, parameter.unit) if _slides(model, place) else parameter.unit
    return Parameter(parameter.name, unit, nominal, lower, upper, size)


def _slides(model: mujoco.MjModel, place: str) -> bool:
    import mujoco

    slide = int(mujoco.mjtJoint.mjJNT_SLIDE)
    return any(model.joint(i).name == place and model.jnt_type[i] == slide for i in range(model.njnt))


def _own_bounds(
    name: str,
    field: str,
    place: str,
    table: Mapping[str, tuple[float, float]],
    default: tuple[float, float],
) -> tuple[float, float]:
    for key in (name, f"{field}:{place}", field):
        if key in table:
            return table[key]
    return default


SIZES: dict[str, Callable[[JointScale], tuple[float, float]]] = {
    "damping": lambda s: (0.1 * s.damping, 5 * s.damping),
    "quadratic_damping": lambda s: (0.1 * s.damping / s.velocity_rms, 5 * s.damping / s.velocity_rms),
    "frictionloss": lambda s: (0.1 * s.torque_rms, s.counter_peak),
    "armature": lambda s: (0.1 * s.inertia, 5 * s.inertia),
    "stiffness": lambda s: (0.1 * s.torque_rms / s.span, 10 * s.torque_rms / s.span),
    "force_limit": lambda s: (0.1 * s.torque_peak, 2 * s.torque_peak),
    "constant_force": lambda s: (0.1 * s.torque_rms, s.counter_peak),
}
"""Field -> (size that matters, largest sensible value) at a joint."""
