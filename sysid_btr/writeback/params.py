"""Reading ``params.json``: the parameters of a finished run, to start from or to replay at."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

from sysid_btr.errors import UsageError
from sysid_btr.reading import parse_json
from sysid_btr.run_folder import PARAMS
from sysid_btr.terms.base import Parameter, Scope, Term
from sysid_btr.terms.model import Model

if TYPE_CHECKING:
    from sysid_btr.models.robot import Robot
    from sysid_btr.simulation.numerics import Numerics

PARAMS_SCHEMA = "sysid_btr.params/1"


@dataclass(frozen=True, eq=False)
class Params:
    """What a run found, ready to be replayed.

    Attributes
    ----------
    model : effects included.
    numerics : with which it was replayed.
    """

    model: Model
    numerics: Numerics

    @property
    def by_name(self) -> dict[str, float]:
        """Parameter name -> value."""
        return dict(zip(self.model.terms.names, (float(v) for v in self.model.values), strict=True))


def read_params(path: Path, robot: Robot) -> Params:
    """Read ``params.json``, or the one in a folder.

    Raises
    ------
    UsageError
        If it cannot be read, or names what this robot or this version does not have; all of it at once.
    """
    from sysid_btr.simulation.numerics import MUJOCO, Numerics

    file = path / PARAMS if path.is_dir() else path
    try:
        content = parse_json(file.read_text(encoding="utf-8"))
    except OSError as error:
        raise UsageError(f"--params {file}: {error.strerror}; give the params.json of a finished run") from error
    except ValueError as error:
        raise UsageError(f"--params {file} is not JSON ({error}); give the params.json of a finished run") from error
    if not isinstance(content, dict) or content.get("schema") != PARAMS_SCHEMA:
        raise UsageError(f"--params {file} is not a parameter file ({PARAMS_SCHEMA}); give the params.json of a run")
    problems: list[str] = []
    parts: list[tuple[Term, list[float]]] = []
    try:
        places = {scope: robot.names(scope) for scope in get_args(Scope)}
        for entry in content["modifiers"]:
            term = _term(entry, places, problems, robot)
            if term is not None:
                parts.append((term, [float(p["value"]) for p in entry["parameters"]]))
        own = {"servo_period": None, "simulator": MUJOCO, "stated": False, "recorded": False, **content["numerics"]}
        period = None if own["servo_period"] is None else float(own["servo_period"])
        numerics = Numerics(
            str(own["integrator"]),
            float(own["timestep"]),
            period,
            str(own["simulator"]),
            bool(own["stated"]),
            bool(own["recorded"]),
        )
    except (KeyError, TypeError, ValueError) as error:
        raise UsageError(
            f"--params {file} was changed and cannot be read: {error!r}; give one as it was written"
        ) from error
    if problems:
        raise UsageError(f"--params {file}:\n" + "\n".join(f"  {p}" for p in problems))
    return Params(Model.joined(parts), numerics)


def _term(
    entry: Mapping[str, Any], places: Mapping[str, Sequence[str]], problems: list[str], robot: Robot
) -> Term | None:
    from sysid_btr.terms.library import all_terms, declarable

    name, variant, where = str(entry["name"]), str(entry["variant"]), tuple(entry["where"])
    declared = name if entry["kind"] == "parameter" else ""
    if declared:
        found = declarable(robot.fields).get(name)
    else:
        found = next((t for t in all_terms() if (t.name, t.variant) == (name, variant)), None)
    if found is None:
        problems.append(f"this version has no {entry['kind']} {name} {variant}".rstrip())
        return None
    fixed = tuple(None if v is None else float(v) for v in entry.get("fixed", ()))
    ranges = tuple((float(low), float(high)) for low, high in entry.get("ranges", ()))
    bare = found(places=where, shared=bool(entry["shared"]), declared=declared, fixed=fixed, ranges=ranges)
    unknown = [p for p in where if p not in places[bare.location]]
    if unknown:
        problems.append(f"{name}: the model has no {bare.location} {', '.join(unknown)}")
        return None
    known = tuple(_parameter(p) for p in entry["parameters"])
    if len(known) != len(bare.parameters):
        kinds = ", ".join(k.name for k in bare.numbers)
        problems.append(
            f"{name} at {', '.join(where)}: {len(known)} numbers, where this version has {len(bare.parameters)} "
            f"({kinds} each); the file is of another version: identify again with this one"
        )
        return None
    return replace(bare, known=known)


def _parameter(entry: Mapping[str, Any]) -> Parameter:
    low, high = (math.nan if b is None else float(b) for b in entry["bounds"])
    return Parameter(
        name=str(entry["name"]),
        unit=str(entry["unit"]),
        nominal=float(entry["nominal"]),
        lower=-math.inf if math.isnan(low) else low,
        upper=math.inf if math.isnan(high) else high,
        scale=float(entry["scale"]),
    )


def starts_from(params: Params, parameters: Sequence[Parameter]) -> tuple[dict[str, float], list[str]]:
    """Values of the parameters that are free here, and the names of those that are not."""
    free = {p.name: p for p in parameters}
    given: dict[str, float] = {}
    unused = []
    for name, value in params.by_name.items():
        if name in free:
            p = free[name]
            given[name] = min(max(value, p.lower), p.upper)
        else:
            unused.append(name)
    return given, unused
