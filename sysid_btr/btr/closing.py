"""The paper's self-organising re-parametrisation: effects that the robot's logs call for join the model."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from sysid_btr._typing import FloatArray
from sysid_btr.btr.problems import Stage
from sysid_btr.btr.trials import Tried
from sysid_btr.errors import SysidError
from sysid_btr.estimators.base import Progress, silent
from sysid_btr.io._text import some
from sysid_btr.models.robot import Robot
from sysid_btr.reading import parse_json
from sysid_btr.run_folder import Folder
from sysid_btr.terms.base import Term
from sysid_btr.terms.model import Model
from sysid_btr.units import after_number

if TYPE_CHECKING:
    from sysid_btr.identify.study import Study

FEWEST = 2
"""Trials that are looked at, at least: what is named must hold for one that was not fitted."""
EXPLAINED = 3.0
"""Position error, in noise floors, of trials up to which nothing is looked for where a model is fitted to them as
wholes."""
EXPLAINING = ("explained", "ambiguous")
"""Verdicts with which effects join: if several explain the same, any of them foresees it."""


@dataclass(frozen=True, eq=False)
class Joined:
    """What `close` found in the robot's logs.

    Attributes
    ----------
    message : in words.
    model : with the effects; None where none was named.
    simulations : of trials' samples, that it took.
    """

    message: str
    model: Model | None = None
    simulations: int = 0


def join_effects(
    stage: Stage,
    values: FloatArray,
    tried: Sequence[Tried],
    kept: Path | None,
    threads: int = 0,
    progress: Progress = silent,
) -> Joined:
    """Look for what the model lacks, unless this was done before the run was stopped.

    Parameters
    ----------
    stage, values : the model so far.
    tried : all trials.
    kept : file in which the finding is kept.
    threads : worker threads.
    progress : see `sysid_btr.estimators`.
    """
    params = None if kept is None else kept.with_name(f"{kept.stem}_params.json")
    if kept is not None and params is not None and kept.exists():
        return _read(parse_json(kept.read_text(encoding="utf-8")), params, stage.world.robot)
    joined, study = _look(stage, values, tried, threads, progress)
    if kept is None or params is None:
        return joined
    kept.parent.mkdir(parents=True, exist_ok=True)
    folder = Folder(kept.parent)
    if joined.model is not None and study is not None:
        from sysid_btr.result import to_json
        from sysid_btr.writeback.write import Identified, params_of

        folder.write(params.name, to_json(params_of(Identified(study, joined.model, ()))))
    summary = {"message": joined.message, "named": joined.model is not None, "simulations": joined.simulations}
    folder.write(kept.name, json.dumps(summary, indent=1) + "\n")
    return _read(summary, params, stage.world.robot)


def _look(
    stage: Stage, values: FloatArray, tried: Sequence[Tried], threads: int, progress: Progress
) -> tuple[Joined, Study | None]:
    """What `close` says of the longest trials, half of them held out; what it names joins if it explains them."""
    from sysid_btr.btr.learning import trial_study, usable_logs
    from sysid_btr.diagnosis.close import close

    logs = usable_logs([t.trial for t in tried])
    if len(logs) < FEWEST:
        return Joined("missing effects were not searched for: fewer than two trials have a log"), None
    declared = Model.of(stage.world.terms, values)
    try:
        study = trial_study(stage.world.robot, logs[::2], logs[1::2], threads)
        seen = declared.only(*(term for term in declared.terms if study.shows(type(term))))
        closing = close(study, seen.terms, start=seen.values, progress=progress)
    except SysidError as error:
        return Joined(f"missing effects could not be searched for: {error}"), None
    spent = closing.replays * len(logs)
    joining = closing.model.without(*seen.terms)
    if not joining.terms or closing.verdict not in EXPLAINING:
        return Joined(closing.message, simulations=spent), None
    fitted = [(term, closing.model.own(term) if term in seen.terms else own) for term, own in declared.parts]
    added = "; ".join(f"{m.called} at {some(m.places, 4)}: {_amounts(m, v)}" for m, v in joining.parts)
    return Joined(f"added to the model: {added}", Model.joined([*fitted, *joining.parts]), spent), study


def _amounts(term: Term, values: FloatArray) -> str:
    """Values in words: each kind's, and where it has several places their range."""
    own = np.reshape(values, (-1, len(term.numbers)))
    units = [after_number(p.unit, p.nominal) for p in term.parameters]
    return ", ".join(
        f"{low:.3g}{unit}" if low == high else f"{low:.3g} to {high:.3g}{unit}"
        for low, high, unit in zip(own.min(axis=0), own.max(axis=0), units, strict=False)
    )


def _read(summary: dict[str, Any], params: Path, robot: Robot) -> Joined:
    spent = int(summary.get("simulations", 0))
    if not summary["named"]:
        return Joined(summary["message"], simulations=spent)
    from sysid_btr.writeback.params import read_params

    return Joined(summary["message"], read_params(params, robot).model, spent)
