"""The paper's self-organising re-parametrisation: effects that the robot's logs call for join the model."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from sysid_btr._typing import FloatArray
from sysid_btr.btr.trials import Tried
from sysid_btr.errors import SysidError
from sysid_btr.models.modifier import Modifier
from sysid_btr.models.robot import Robot
from sysid_btr.session import Folder

LOGS = 3
"""Trials whose logs are looked at: the fittest that did not fall, which move most."""


@dataclass(frozen=True, eq=False)
class Joined:
    """What `close` found in the robot's logs.

    Attributes
    ----------
    message : in words.
    modifiers, values : the model with the effects; empty where none was named.
    """

    message: str
    modifiers: tuple[Modifier, ...] = ()
    values: FloatArray | tuple[float, ...] = ()


def join_effects(
    robot: Robot,
    modifiers: Sequence[Modifier],
    values: FloatArray,
    tried: Sequence[Tried],
    kept: Path | None,
    threads: int = 0,
) -> Joined:
    """Look for what the model lacks, unless this was done before the run was stopped.

    Parameters
    ----------
    robot, modifiers, values : the model so far.
    tried : all trials.
    kept : file in which the finding is kept.
    threads : worker threads.
    """
    params = None if kept is None else kept.with_name(f"{kept.stem}_params.json")
    if kept is not None and params is not None and kept.exists():
        return _read(json.loads(kept.read_text(encoding="utf-8")), params, robot)
    found = _look(robot, modifiers, values, tried, threads)
    if kept is None or params is None:
        return _direct(found)
    kept.parent.mkdir(parents=True, exist_ok=True)
    folder = Folder(kept.parent)
    if found["params"] is not None:
        from sysid_btr.result import to_json

        folder.write(params.name, to_json(found["params"]))
    summary = {"message": found["message"], "named": found["params"] is not None}
    folder.write(kept.name, json.dumps(summary, indent=1) + "\n")
    return _read(summary, params, robot)


def _look(
    robot: Robot, modifiers: Sequence[Modifier], values: FloatArray, tried: Sequence[Tried], threads: int
) -> dict[str, Any]:
    from sysid_btr.diagnosis.close import close
    from sysid_btr.effects.base import Effect
    from sysid_btr.identify.study import make_study
    from sysid_btr.writeback.write import identified, params_of

    standing = [t for t in tried if t.trial.log is not None and t.trial.outcome == "done"]
    logs = [t.trial.log for t in sorted(standing, key=lambda t: -t.trial.fitness)[:LOGS] if t.trial.log is not None]
    if not logs:
        return {"message": "no trial with a log that did not fall: nothing can be looked for", "params": None}
    declared = [m for m in modifiers if not isinstance(m, Effect)]
    count = sum(len(m.parameters) for m in declared)
    try:
        study = make_study(robot, logs, threads=threads)
        closing = close(study, declared, start=np.asarray(values[:count]))
    except SysidError as error:
        return {"message": f"missing effects could not be looked for: {error}", "params": None}
    if not closing.effects:
        return {"message": f"{closing.verdict.replace('_', ' ')}: {closing.message}", "params": None}
    model = identified(closing)
    return {
        "message": f"{closing.verdict}: {closing.message}",
        "params": params_of(model),
        "modifiers": model.modifiers,
        "values": model.written,
    }


def _direct(found: dict[str, Any]) -> Joined:
    if found["params"] is None:
        return Joined(found["message"])
    return Joined(found["message"], tuple(found["modifiers"]), np.asarray(found["values"]))


def _read(summary: dict[str, Any], params: Path, robot: Robot) -> Joined:
    if not summary["named"]:
        return Joined(summary["message"])
    from sysid_btr.writeback.params import read_params

    own = read_params(params, robot)
    return Joined(summary["message"], own.modifiers, own.values)
