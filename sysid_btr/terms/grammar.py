"""The parameter grammar: ``NAME[.KIND]:GLOB[,GLOB...][=shared]`` to terms of a robot."""

from __future__ import annotations

import difflib
import fnmatch
import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Protocol, TypeVar

from sysid_btr.errors import UsageError
from sysid_btr.mujoco_conventions import SLIDE
from sysid_btr.terms.base import Kind, Scope, Term, parameter_of
from sysid_btr.terms.library import declarable
from sysid_btr.terms.scales import Scales, largest_scale

if TYPE_CHECKING:
    import mujoco

T = TypeVar("T")


class Robot(Protocol):
    """What the grammar asks of a robot; `models.robot.Robot` answers."""

    @property
    def name(self) -> str: ...

    @property
    def bounds(self) -> Mapping[str, tuple[float, float]]: ...

    @property
    def tied(self) -> tuple[tuple[str, ...], ...]: ...

    @property
    def fields(self) -> Mapping[str, type[Term]]: ...

    @property
    def model(self) -> mujoco.MjModel: ...

    def names(self, scope: Scope) -> tuple[str, ...]: ...


def parse_parameters(expressions: Sequence[str], robot: Robot, scales: Scales | None = None) -> tuple[Term, ...]:
    """Terms for the parameters that a user frees.

    Parameters
    ----------
    expressions : such as ``mass:*Knee*,*HipPitch``, ``kp:*=shared``, ``frictionloss:slider``, ``backlash.play:*Knee``.
    robot : names, nominal values, bounds and joints that share a motor.
    scales : sizes at each joint, for bounds; without them bounds are the same for every robot.

    Raises
    ------
    UsageError
        Naming what does not match, and what there is; all problems at once.
    """
    problems: list[str] = []
    result: list[Term] = []
    taken: dict[tuple[str, str, str], str] = {}
    table = declarable(robot.fields)
    for expression in expressions:
        try:
            for term in _parse_one(expression, robot, scales, table):
                for place in term.places:
                    for kind in term.numbers:
                        key = (term.name, kind.name, place)
                        if key in taken:
                            raise UsageError(f"{term.called}:{place} is already declared by {taken[key]!r}")
                        taken[key] = expression
                result.append(term)
        except UsageError as error:
            problems.append(f"  --fit {expression}: {error}")
    if problems:
        raise UsageError("parameters that cannot be used:\n" + "\n".join(problems))
    return tuple(result)


def _parse_one(expression: str, robot: Robot, scales: Scales | None, table: Mapping[str, type[Term]]) -> list[Term]:
    label, colon, rest = expression.partition(":")
    if not colon or not rest:
        raise UsageError("expected FIELD:GLOB[,GLOB...][=shared], for example mass:*KneePitch or kp:*=shared")
    bare = _declared(label, table)
    globs, equals, option = rest.partition("=")
    if equals and option != "shared":
        raise UsageError(f"after '=' only 'shared' is allowed, not {option!r}")
    known = robot.names(bare.location)
    names: list[str] = []
    for glob in globs.split(","):
        matched = [n for n in known if fnmatch.fnmatchcase(n, glob)]
        if not matched:
            raise UsageError(
                f"{glob!r} matches no {_scope_noun(bare.location)} of {robot.name}; there are: {', '.join(known)}"
            )
        names += [n for n in matched if n not in names]
    if option == "shared":
        return [make_term(bare, tuple(names), robot, scales, globs)]
    return [make_term(bare, group, robot, scales, ",".join(group)) for group in _motors(bare.location, names, robot)]


ALSO_CALLED = {"friction": "frictionloss", "spring": "stiffness", "p": "kp", "d": "kv", "kd": "kv", "gain": "kp"}
"""Names that people try -> fields."""


def _declared(label: str, table: Mapping[str, type[Term]]) -> Term:
    """The term that a name frees, all of its kinds or, after a point, one; at no place yet."""
    stem, _, last = label.rpartition(".")
    name = label if label in table or stem not in table else stem
    if name not in table:
        meant = ALSO_CALLED.get(name) or next(iter(difflib.get_close_matches(name, table, n=1)), None)
        if meant:
            raise UsageError(
                f"unknown field {name!r} (did you mean {meant!r}?); `sysid-btr fit` with --model alone lists all"
            )
        raise UsageError(f"unknown field {name!r}; fields are {', '.join(n for n in table if '.' not in n)}")
    bare = table[name](places=(), declared=name)
    if name == label:
        return bare
    kinds = [k.name for k in bare.numbers]
    if last not in kinds:
        raise UsageError(f"{name} has no {last!r}; it has {', '.join(kinds)}")
    return replace(bare, fixed=tuple(None if k == last else 0.0 for k in kinds)) if len(kinds) > 1 else bare


def check_expression(name: str, robot: Robot) -> None:
    """Check that a field, or a parameter's name, is one that the robot can have.

    Raises
    ------
    UsageError
        Saying what is unknown, and what there is.
    """
    label, colon, places = name.partition(":")
    table = declarable(robot.fields)
    _declared(label, table)
    if colon:
        _parse_one(f"{label}:{places}", robot, None, table)


SCOPES: Mapping[Scope, str] = {
    "body": "body with mass",
    "joint": "joint",
    "drive": "joint with a drive",
    "feedback": "joint with a servo of position or velocity",
    "servo": "joint with a servo of position",
    "robot": "robot",
}
"""What names of a scope are."""


def _scope_noun(scope: Scope) -> str:
    return SCOPES[scope]


def _motors(scope: Scope, names: list[str], robot: Robot) -> list[tuple[str, ...]]:
    """Names one by one, but joints that one motor drives together."""
    groups: list[tuple[str, ...]] = []
    seen: set[str] = set()
    for name in names:
        if name in seen:
            continue
        tied = (
            next((t for t in robot.tied if name in t), (name,)) if scope in ("drive", "feedback", "servo") else (name,)
        )
        groups.append(tuple(t for t in tied if t in names))
        seen.update(groups[-1])
    return groups


def make_term(bare: Term, places: tuple[str, ...], robot: Robot, scales: Scales | None, label: str) -> Term:
    """The term at some places, which share its numbers; `label` is what they are called by together."""
    kinds = bare.kinds if scales is None else bare.sized(largest_scale(scales, places))
    fixed = tuple(None if v is None else k.nominal for k, v in zip(kinds, bare.fixed, strict=False))
    term = replace(bare, places=places, shared=len(places) > 1, fixed=fixed)
    model = robot.model
    if term.absolute:
        kinds = (term.absolute_kind(kinds[0], term.own_value(model, places[0])),)
    free = [k for k, v in zip(kinds, fixed, strict=True) if v is None] if fixed else kinds
    known = []
    for parameter, kind in zip(term.parameters, free, strict=True):
        stated = closest(robot.bounds, parameter.name, *(f"{term.called}:{place}" for place in places))
        bounds = _possible(parameter.name, kind, stated) if stated else (kind.lower, kind.upper)
        named = f"{parameter.name.partition(':')[0]}:{label}"
        kind = term.in_units_of(kind, slide=_slides(model, places[0]))
        own = parameter_of(replace(kind, lower=bounds[0], upper=bounds[1]), named)
        # who states bounds knows better than the model
        known.append(replace(own, stated=True, spread=math.inf) if stated else own)
    term = replace(term, known=tuple(known))
    return term if scales is None else term.over(scales)


def _slides(model: mujoco.MjModel, place: str) -> bool:
    return any(model.joint(i).name == place and model.jnt_type[i] == SLIDE for i in range(model.njnt))


WIDEST = 1e6
"""Ratio of an upper to a lower bound, both positive, beyond which steps between them mean nothing."""


def _possible(name: str, kind: Kind, stated: tuple[float, float]) -> tuple[float, float]:
    """Stated bounds, if a parameter of this kind can have all that lies between them."""
    lower, upper = stated
    if kind.lower >= 0 > lower:
        raise UsageError(f"bounds {lower:g} .. {upper:g} of {name}: it cannot be negative; give 0 or more")
    if lower > 0 and upper > WIDEST * lower:
        raise UsageError(
            f"bounds {lower:g} .. {upper:g} of {name}: a range of more than {WIDEST:g} to one cannot be searched; give "
            "a narrower one"
        )
    return stated


def closest(table: Mapping[str, T], *names: str) -> T | None:
    """What a table says of a parameter: under its name, else under the last glob that matches, else under its field.

    Parameters
    ----------
    table : keys are names, ``FIELD:GLOB[,GLOB...]`` or ``FIELD``.
    names : all that the parameter is called, ``FIELD:PLACE`` each; the first goes before the others.

    Returns
    -------
    value or None
        None where nothing is said of it.
    """
    globs = [key for key in reversed([*table]) if any(_matches(key, name) for name in names)]
    fields = [name.partition(":")[0] for name in names]
    return next((table[key] for key in (*names, *globs, *fields) if key in table), None)


def _matches(key: str, name: str) -> bool:
    field, colon, globs = key.partition(":")
    return any(fnmatch.fnmatchcase(name, f"{field}{colon}{glob}") for glob in globs.split(","))
