"""The paper's self-organising re-parametrisation: effects that the robot's logs call for join the model."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from sysid_btr._typing import FloatArray
from sysid_btr.btr.problems import Stage
from sysid_btr.btr.trials import Tried
from sysid_btr.errors import SysidError
from sysid_btr.estimators.base import Budget, Progress, Termination, silent
from sysid_btr.estimators.journal import Journal
from sysid_btr.models.robot import Robot
from sysid_btr.reading import parse_json
from sysid_btr.run_folder import Folder
from sysid_btr.terms.base import Term
from sysid_btr.terms.model import Model

if TYPE_CHECKING:
    from sysid_btr.identify.study import Study

LOGS, FEWEST = 4, 2
"""Trials that are looked at, half of them held out, at most and at least."""
EXPLAINED = 3.0
"""Position error, in noise floors, of trials, and of their beginnings, up to which nothing is looked for."""
SAME = ("sensor_delay",)
"""Effects not asked for: commands that are played from rest do not distinguish a late encoder from a late command."""
MINIMUM_GAIN, ROUNDS = 0.05, 2
"""Fraction of some joint's error that an effect must explain to join the model, and effects that join at once."""
LEFT = 0.75
"""Fraction of the held-out mean squared error that effects may leave, to join, and that amounts of their own at every
place may leave of what one for all leaves."""


@dataclass(frozen=True, eq=False)
class Joined:
    """What `close` found in the robot's logs.

    Attributes
    ----------
    message : in words.
    model : with the effects; None where none was named.
    simulations : of beginnings of trials, that it took.
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

        folder.write(params.name, to_json(params_of(Identified(study, joined.model, (), ()))))
    summary = {"message": joined.message, "named": joined.model is not None, "simulations": joined.simulations}
    folder.write(kept.name, json.dumps(summary, indent=1) + "\n")
    return _read(summary, params, stage.world.robot)


def _look(
    stage: Stage, values: FloatArray, tried: Sequence[Tried], threads: int, progress: Progress
) -> tuple[Joined, Study | None]:
    """Look for effects that are the same all over the robot, with bodies as they are and drives free.

    Few trials of one gait do not distinguish masses or lengths from anything else: free, they take the place of what
    is missing. Step 3 corrects them afterwards. An effect joins if trials that were not fitted say so, even if more is
    missing.
    """
    from sysid_btr.btr.study import early_logs, trial_study
    from sysid_btr.diagnosis.close import close
    from sysid_btr.diagnosis.selection import Selection
    from sysid_btr.identify.refit import judge
    from sysid_btr.terms.library import select_effects

    logs = early_logs(stage, tried, LOGS)
    logs = logs[len(logs) % 2 :]  # as many fitted as held out
    if len(logs) < FEWEST:
        message = "missing effects were not searched for: fewer than two trials have a log of their first seconds"
        return Joined(message), None
    declared = Model.of(stage.world.terms, values)
    drives = [term for term in declared.terms if term.location != "body"] or list(declared.terms)
    free = declared.only(*drives)
    effects = tuple(dict.fromkeys(e.name for e in select_effects(("all",)) if e.name not in SAME))
    try:
        study = trial_study(stage, logs[::2], logs[1::2], threads, declared.without(*drives))
        now = judge(study, free)
        error = float(np.sqrt(max(now.train, now.holdout)))
        if error <= EXPLAINED:
            message = (
                "missing effects were not searched for: the model predicts the beginning of the trials within "
                f"{error:.2g} noise floors"
            )
            return Joined(message, simulations=now.evaluations * len(logs)), None
        closing = close(
            study,
            free.terms,
            effects=effects,
            start=free.values,
            selection=Selection(alike=True, minimum_gain=MINIMUM_GAIN, rounds=ROUNDS),
            progress=progress,
        )
    except SysidError as error:
        return Joined(f"missing effects could not be searched for: {error}"), None
    first, last = closing.steps[0].holdout, closing.steps[-1].holdout
    spent = closing.replays * len(logs)
    if len(closing.model.terms) == len(free.terms) or last > LEFT * first:
        message = f"no effect improves the prediction enough to be added; {_score(first, last)}"
        return Joined(message, simulations=spent), None
    found, last, apart = _tell_apart(study, closing.model, len(free.terms), last)
    joining, spent = found.without(*free.terms), spent + apart * len(logs)
    fitted = [(term, found.own(term) if term in found.terms else own) for term, own in declared.parts]
    added = "; ".join(f"{m.called} at {len(m.places)} places: {_amounts(m, v)}" for m, v in joining.parts)
    message = f"added to the model: {added}; {_score(first, last)}"
    return Joined(message, Model.joined([*fitted, *joining.parts]), spent), study


def _tell_apart(study: Study, found: Model, declared: int, left: float) -> tuple[Model, float, int]:
    """The model with amounts of their own at every place for effects where held-out trials want that.

    The first `declared` terms stay; `left` is the mean squared held-out error so far. Returned with that of the model,
    and the candidates that it took.
    """
    from sysid_btr.btr.map_problem import MapProblem, model_fit
    from sysid_btr.identify.refit import judge

    spent = 0
    for effect in found.terms[declared:]:
        if not effect.shared:
            continue
        trying = found.replaced(effect, (_own_amounts(effect), np.tile(found.own(effect), len(effect.places))))
        problem = MapProblem(study.train_problem(trying))
        estimate = model_fit().fit(
            problem, rng=np.random.default_rng(0), budget=Budget(), journal=Journal(), progress=silent
        )
        if estimate.termination is Termination.INTERRUPTED:
            raise KeyboardInterrupt
        judged = judge(study, trying.at(estimate.x), estimate.evaluations)
        spent += judged.evaluations
        if judged.holdout < LEFT * left:
            found, left = judged.model, judged.holdout
    return found, left, spent


def _own_amounts(effect: Term) -> Term:
    """The effect with an amount for every place, within the bounds of the one for all."""
    bare = replace(effect, shared=False, known=())
    known = (*effect.parameters,) * len(effect.places)
    return replace(bare, known=tuple(replace(k, name=p.name) for k, p in zip(known, bare.parameters, strict=True)))


def _amounts(term: Term, values: FloatArray) -> str:
    """Values in words: each kind's, and where it has several places their range."""
    own = np.reshape(values, (-1, len(term.numbers)))
    units = [p.unit for p in term.parameters]
    return ", ".join(
        f"{low:.3g} {unit}" if low == high else f"{low:.3g} to {high:.3g} {unit}"
        for low, high, unit in zip(own.min(axis=0), own.max(axis=0), units, strict=False)
    )


def _score(before: float, after: float) -> str:
    """Mean squares over noise floors, in words."""
    return f"held-out position error {np.sqrt(before):.3g} -> {np.sqrt(after):.3g} noise floors"


def _read(summary: dict[str, Any], params: Path, robot: Robot) -> Joined:
    spent = int(summary.get("simulations", 0))
    if not summary["named"]:
        return Joined(summary["message"], simulations=spent)
    from sysid_btr.writeback.params import read_params

    return Joined(summary["message"], read_params(params, robot).model, spent)
