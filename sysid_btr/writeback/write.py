"""The identified model as the user's own MJCF, reloaded and scored again."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from hashlib import sha256
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from sysid_btr.errors import ModelError, SysidError
from sysid_btr.identify.intervals import Estimate
from sysid_btr.identify.study import Study
from sysid_btr.models.robot import Robot
from sysid_btr.mujoco_conventions import free_joints
from sysid_btr.result import clean, to_json
from sysid_btr.run_folder import MODEL, PARAMS, Folder, make_relative
from sysid_btr.terms.base import Term
from sysid_btr.terms.model import Model
from sysid_btr.version import __version__
from sysid_btr.writeback.changes import SOLVER, Change, acts_at, changes_of, describe, place_of
from sysid_btr.writeback.features import Kind
from sysid_btr.writeback.filed import loss_of, of_file, stands_alone
from sysid_btr.writeback.native import Part
from sysid_btr.writeback.params import PARAMS_SCHEMA
from sysid_btr.writeback.rewrite import CannotWriteError, Compiled, compile_text, rewrite
from sysid_btr.writeback.source import Source, fold_includes, made_source, own_source, relative_assets
from sysid_btr.writeback.target import Target, make_parts, make_target
from sysid_btr.writeback.xmltext import parse

if TYPE_CHECKING:
    from sysid_btr.diagnosis.closing import Closing
    from sysid_btr.identify.fit import Fit

OTHER = "identified.xml"
"""Name beside a user's own model of that name."""
REPRODUCED = 1e-9
"""Relative difference of losses up to which a file moves as the replay did."""


@dataclass(frozen=True, eq=False)
class Identified:
    """A model that was identified, from whatever it came.

    Attributes
    ----------
    study : robot, logs, numerics.
    model : the terms and their values.
    estimates : of its parameters, in order.
    """

    study: Study
    model: Model
    estimates: tuple[Estimate, ...]

    def estimates_of(self, term: Term) -> tuple[Estimate, ...]:
        """Estimates of a term's own parameters; none of a term that is not in the model, or where there are none."""
        return self.estimates[self.model.terms.columns(term)] if term in self.model.terms else ()


def identified(outcome: Fit | Closing) -> Identified:
    """The model that a fit or a closing found; without effects that were tried and not named."""
    from sysid_btr.identify.fit import Fit

    if isinstance(outcome, Fit):
        model, estimates = outcome.model, outcome.estimates
    elif outcome.effects:
        model = outcome.model
        estimates = (*outcome.parameters, *(p for e in outcome.effects for p in e.parameters))
    else:
        model, estimates = outcome.before_model, outcome.parameters
    return Identified(outcome.study, model, estimates)


@dataclass(frozen=True, eq=False)
class Draft:
    """A model as text, before it is on disk.

    Attributes
    ----------
    identified : what was identified.
    robot : as its first log configures it.
    source : what was written into.
    compiled : the text and what it compiles to.
    target : what it had to become.
    changes : in which it differs from the plain model.
    """

    identified: Identified
    robot: Robot
    source: Source
    compiled: Compiled
    target: Target
    changes: tuple[Change, ...]

    @property
    def missing(self) -> tuple[Part, ...]:
        """What the file holds only in part, or not at all."""
        return tuple(p for p in self.target.parts if p.held != "yes")

    def text(self, costs: Sequence[str] = ()) -> bytes:
        """The file: a comment on top, then the text with its includes."""
        body = fold_includes(self.compiled.text, self.source.includes)
        at = parse(body).start
        lines = "\n  ".join(_header(self, costs)).replace("--", "- -")
        return body[:at] + f"<!--\n  {lines}\n-->\n".encode() + body[at:]


def draft(model: Identified) -> Draft:
    """Write an identified model into the user's MJCF, in memory.

    Raises
    ------
    ModelError
        If no MJCF can be made of it.
    """
    study = model.study
    log = study.train[0].log
    robot = study.robot.for_log(log)
    target = make_target(robot, log, _parts(model), study.numerics)
    why = ""
    if robot.path is not None and not robot.remarks and _is_mjcf(robot.path):
        try:
            return _draft_in(own_source(robot.path), model, robot, target)
        except (ValueError, OSError) as error:
            why = f", rewritten without its comments because {error}"
    try:
        return _draft_in(made_source(robot, why), model, robot, target)
    except CannotWriteError as error:
        raise ModelError(
            f"model {robot.name}: the identified model cannot be written as MJCF: {error}. The parameters are in "
            f"{PARAMS}."
        ) from error


def _parts(model: Identified) -> tuple[Part, ...]:
    robot = model.study.robot.for_log(model.study.train[0].log)
    return make_parts(robot, model.model, model.study.numerics)


def _draft_in(source: Source, model: Identified, robot: Robot, target: Target) -> Draft:
    plain = compile_text(source.text)
    changes = changes_of(plain.model, target, [model.estimates_of(part.term) for part in target.parts])
    compiled = rewrite(source.text, target.model, _notes(target, changes))
    return Draft(model, robot, source, compiled, target, changes)


def _is_mjcf(path: Path) -> bool:
    try:
        return parse(path.read_bytes()).tag == "mujoco"
    except (OSError, ValueError):
        return False


def _notes(target: Target, changes: Sequence[Change]) -> dict[tuple[Kind, str], str]:
    """Comments before what effects change or add; a declared parameter needs none where it has its own name."""
    notes: dict[tuple[Kind, str], str] = {}
    places = [place_of(target.model, change) for change in changes]
    for part in target.parts:
        if part.stand_in is None or (part.stand_in is part.term and (part.term.declared or not part.term.kinds)):
            continue
        for change, place in zip(changes, places, strict=True):
            key = (change.kind, change.name)
            if part.term.called not in change.by or change.attribute in SOLVER or change.kind == "geom":
                continue
            if change.kind in ("actuator", "joint") and not acts_at(part, place):
                # another term of that name asks for it
                continue
            words = describe(part, place)
            if words not in notes.get(key, ""):
                notes[key] = f"{notes[key]}; {words}" if key in notes else f"sysid_btr: {words}"
    return notes


def _header(draft: Draft, costs: Sequence[str]) -> list[str]:
    study = draft.identified.study
    logs = ", ".join(dict.fromkeys(e.log.path.name for e in study.train if e.log.path is not None)) or "a log"
    changed = sum(bool(c.attribute) for c in draft.changes)
    added = len(draft.changes) - changed
    lines = [
        f"Written by sysid_btr {__version__} from {draft.source.origin}:",
        f"the model that moves like the robot in {logs}.",
        f"{changed} attributes are changed and {added} elements added; result.json lists them.",
        f"<option> has the integrator and the step of the replay ({study.numerics}); with others it moves differently.",
    ]
    if not draft.source.own:
        lines.append("It is a complete file: there was no MJCF to change.")
    if any(episode.log.meta.mount == "fixed" for episode in study.train) and _floats(draft):
        lines.append("The log is of a fixed base; to replay it, remove the free joint.")
    delayed = [p for p in draft.target.parts if p.stand_in is not None and p.stand_in.name == "delay"]
    if delayed:
        lines.append("Commands are delayed: fill the buffers with the first command (mj_initCtrlHistory).")
    links = [c.name for c in draft.changes if c.kind == "joint" and not c.attribute]
    if links:
        lines.append(f"A joint's sensor shows the sum of the joint and its link side ({', '.join(links)}).")
    for part in draft.missing:
        word = "Not in this file" if part.held == "no" else "Approximate in this file"
        lines.append(f"{word}: {describe(part)}: {part.how}.")
    return [*lines, *costs]


def _floats(draft: Draft) -> bool:
    return bool(len(free_joints(draft.target.model)))


@dataclass(frozen=True)
class Losses:
    """Sums of squared whitened residuals, on fitted and held-out data."""

    train: float
    holdout: float

    def close_to(self, other: Losses) -> bool:
        """Whether both agree to `REPRODUCED`."""
        pairs = ((self.train, other.train), (self.holdout, other.holdout))
        return all(abs(a - b) <= REPRODUCED * abs(b) for a, b in pairs)


def save_model(folder: Folder, made: Draft) -> dict[str, Any]:
    """Write ``model.xml``, load it again, and score it as the fit was scored.

    Returns
    -------
    dict
        ``written`` of a result: path, sha256, loss of the file and of what is reported, and what is not in the
        file, with the loss that leaving it out alone would cost.
    """
    name = MODEL if not _is_own(folder.path / MODEL, made.robot) else OTHER
    path = folder.write(name, relative_assets(made.text(), folder.path))
    reported, (own, alone) = reported_losses(made.identified), file_losses(made.identified, path)
    missing = [_missing(part, made.identified) for part in made.missing]
    if missing or not own.close_to(reported):
        path = folder.write(name, relative_assets(made.text(_costs(own, reported)), folder.path))
    return {
        "path": path.name,
        "sha256": sha256(path.read_bytes()).hexdigest(),
        "from": made.source.origin,
        "loss": asdict(own),
        "reported_loss": asdict(reported),
        "reproduces": alone and own.close_to(reported),
        "not_in_file": missing,
    }


def _is_own(path: Path, robot: Robot) -> bool:
    """Whether a path is the user's own model, which is never overwritten."""
    return robot.path is not None and path.exists() and path.samefile(robot.path)


def reported_losses(model: Identified) -> Losses:
    """Losses of the replays that a result reports."""
    study, values = model.study, model.model.values
    return Losses(
        loss_of(study.train_problem(model.model), values), loss_of(study.holdout_problem(model.model), values)
    )


def describe_model(outcome: Fit | Closing, result: dict[str, Any], folder: Folder | None = None) -> None:
    """Add to a result what changes in the model, and write the model and its parameters if there is a folder.

    A model that cannot be written is no reason to lose a result: ``written`` then says why.
    """
    result.update(changes=[], written=None)
    try:
        model = identified(outcome)
        if folder is not None:
            params = params_of(model)
            make_relative(params, folder.path)
            folder.write(PARAMS, to_json(params))
        made = draft(model)
        result["changes"] = [clean(asdict(change)) for change in made.changes]
        if folder is not None:
            result["written"] = clean(save_model(folder, made))
    except (SysidError, ValueError, LookupError, OSError) as error:
        result["written"] = {"path": None, "why": str(error)}


def params_of(model: Identified) -> dict[str, Any]:
    """Content of ``params.json``: every parameter as it is written, with all that is known of it."""
    held = {id(part.term): part.held for part in _parts(model)}
    entries = []
    for term, own in model.model.parts:
        known = model.estimates_of(term) or (None,) * len(own)
        entries.append(
            {
                "kind": "parameter" if term.declared else "effect",
                "name": term.called,
                "variant": term.variant,
                "where": term.places,
                "shared": term.shared,
                **({"fixed": term.fixed} if term.fixed else {}),
                **({"ranges": term.ranges} if term.ranges else {}),
                "in_file": held.get(id(term), "yes"),
                "parameters": [
                    {
                        "name": p.name,
                        "value": value,
                        "unit": p.unit,
                        "std": None if e is None else e.std,
                        "ci95": None if e is None else e.ci95,
                        "nominal": p.nominal,
                        "bounds": (p.lower, p.upper),
                        "scale": p.scale,
                        "identifiable": None if e is None else e.identifiable,
                    }
                    for p, value, e in zip(term.parameters, own, known, strict=True)
                ],
            }
        )
    return {
        "schema": PARAMS_SCHEMA,
        "model": model.study.robot.to_dict(),
        "numerics": model.study.numerics.to_dict(),
        "modifiers": entries,
    }


def file_losses(model: Identified, path: Path) -> tuple[Losses, bool]:
    """Losses of a model in a file on the same data, and whether MuJoCo alone makes the same model of it."""
    study, none = model.study, np.zeros(0)
    train, holdout = of_file(study.train_problem(()), path), of_file(study.holdout_problem(()), path)
    return Losses(loss_of(train, none), loss_of(holdout, none)), stands_alone(train)


def _missing(part: Part, model: Identified) -> dict[str, Any]:
    """What is not in the file, and the loss with it alone left out."""
    entry: dict[str, Any] = {
        "name": part.term.called,
        "variant": part.term.variant,
        "where": list(part.term.places),
        "held": part.held,
        "how": part.how,
        "text": describe(part),
    }
    if part.term not in model.model.terms:
        return {**entry, "loss_without": None}
    without = replace(model, model=model.model.without(part.term))
    return {**entry, "loss_without": asdict(reported_losses(without))}


def _costs(own: Losses, reported: Losses) -> list[str]:
    """What the file costs, in words."""
    return [
        f"Loss of this file {own.train:.10g} (fitted data), {own.holdout:.10g} (held out);",
        f"with everything {reported.train:.10g} and {reported.holdout:.10g}.",
    ]
