"""From names and files to robots, logs and initial values; what cannot be used is refused before any work."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from sysid_btr.cli.groups import ModelOptions, ReadingOptions
from sysid_btr.cli.kinds import Holdout, Ranges, number
from sysid_btr.cli.terminal import remark
from sysid_btr.errors import LogError, ModelError, UsageError

if TYPE_CHECKING:
    from sysid_btr._typing import FloatArray
    from sysid_btr.io.log import Log
    from sysid_btr.models.actuation import Servo
    from sysid_btr.models.robot import Position, Robot
    from sysid_btr.terms.base import Parameter
    from sysid_btr.terms.model import Terms


def find_robot(options: ModelOptions, bounds: Ranges | None = None) -> Robot:
    """The robot called for, with the bounds given to its parameters; what was changed of its file is told."""
    from dataclasses import replace

    from sysid_btr.models.builtin import BUILTIN, load_robot

    name = options.model

    if name is None:
        built_in = f" ({', '.join(sorted(BUILTIN))})" if BUILTIN else ""
        raise UsageError(f"which robot? Give --model: a built-in name{built_in} or an MJCF or URDF file")
    servo = _servo(options.servo) if options.servo else None
    robot = replace(load_robot(name, servo), at=_positions(options.at))
    for said in robot.remarks:
        remark(f"note: {name}: {said}")
    if not bounds:
        return robot
    _check_names(robot, bounds)
    return replace(robot, bounds={**robot.bounds, **bounds})


def _positions(given: Sequence[str]) -> tuple[Position, ...]:
    """Joints and where they stand, and keyframes."""
    from sysid_btr.models.robot import KEYFRAME

    return tuple(text if text.startswith(KEYFRAME) else _equation("--at", text) for text in given)


def _servo(given: Sequence[str]) -> Servo:
    from sysid_btr.models.actuation import Servo

    gains = dict(_equation("--servo", text) for text in given)
    if not {"kp"} <= gains.keys() <= {"kp", "kv"} or min(gains.values()) < 0 or gains["kp"] == 0:
        raise UsageError(f"--servo {','.join(given)}: give kp above zero, and kv, as in --servo kp=100,kv=5")
    return Servo(**gains)


def _equation(flag: str, text: str) -> tuple[str, float]:
    name, equals, value = text.partition("=")
    found = number(value)
    if not (name and equals) or found is None:
        raise UsageError(f"{flag} {text}: expected NAME=NUMBER")
    return name, found


def _check_names(robot: Robot, bounds: Iterable[str]) -> None:
    """Refuse bounds of what no parameter of the robot is called."""
    from sysid_btr.terms.grammar import check_expression

    problems = []
    for name in bounds:
        try:
            check_expression(name, robot)
        except UsageError as error:
            problems.append(f"--bounds {name}: {error}")
    if problems:
        raise UsageError("\n".join(problems))


def read_logs(paths: Iterable[Path], robot: Robot | None = None, *, motions: bool = False) -> list[Log]:
    """All logs, or one error that lists what is wrong with each of them, whatever the robot.

    What their commands are follows the robot's drives, where it is known. A motion that nobody has recorded yet counts
    as wrong, unless `motions` are wanted.
    """
    from sysid_btr.io.parquet import read_log
    from sysid_btr.terms.drives import drive_kinds

    drives = None if robot is None else drive_kinds(robot.model)
    logs, problems = [], []
    for path in paths:
        try:
            log = read_log(path, drives=drives)
        except LogError as error:
            problems.append(str(error))
            continue
        if log.is_motion and not motions:
            problems.append(
                f"{path} is an excitation trajectory, not a recording: execute it on the robot, and give the log of "
                "its sensors"
            )
        logs.append(log)
    if problems:
        raise LogError("\n".join(problems))
    if not logs:
        raise UsageError("which log? Give --log FILE, once for each log")
    return logs


def read_holdout(given: Holdout, robot: Robot, options: ReadingOptions) -> float | list[Log]:
    """The fraction, or the logs, that are not fitted."""
    return as_stated(read_logs(given, robot), options) if isinstance(given, tuple) else given


def as_stated(logs: list[Log], options: ReadingOptions) -> list[Log]:
    """The logs with the noise and on the clocks that the user states, over what they state themselves.

    Raises
    ------
    UsageError
        For a channel or column that no log has, and a noise of nothing.
    """
    from dataclasses import replace

    from sysid_btr.io.shift import shift_streams

    wrong = [f"{name}={value:g}" for name, value in options.noise.items() if not value > 0]
    if wrong:
        raise UsageError(f"--noise {', '.join(wrong)}: a standard deviation must be above zero")
    _check_streams("--noise", options.noise, logs)
    _check_streams("--shift", options.shift, logs)
    shifted = (shift_streams(log, options.shift) for log in logs)
    return [replace(log, meta=replace(log.meta, noise={**log.meta.noise, **options.noise})) for log in shifted]


def _check_streams(flag: str, given: Iterable[str], logs: Sequence[Log]) -> None:
    from sysid_btr.io.log import with_hint

    known = {part for log in logs for column in log.channels for part in (column, column.partition(".")[0])}
    unknown = [name for name in given if name not in known]
    if unknown:
        raise UsageError(f"{flag}: no log has {', '.join(with_hint(name, known) for name in unknown)}")


def warn_of(robot: Robot, logs: Iterable[Log]) -> None:
    """Say what the validation finds of logs for a robot.

    Raises
    ------
    ModelError
        If there are errors among it, with all of them: a log that was read has none of its own.
    """
    from sysid_btr.io.problem import errors_of, explain
    from sysid_btr.models.log_checks import check_log

    refused = []
    for log in logs:
        problems = check_log(robot, log)
        errors = errors_of(problems)
        if errors:
            refused.append(explain(log.path, errors))
        for problem in problems[len(errors) :]:
            told = f"{problem.where}: {problem.message} [{problem.code}]\n    -> {problem.remedy}"
            remark(f"{problem.severity}: {log.path}: {told}")
    if refused:
        raise ModelError("\n".join(refused))


def check_channels(names: Sequence[str]) -> None:
    """Refuse channels that a replay does not predict."""
    from sysid_btr.objectives.targets import COMPARED

    unknown = [name for name in names if name not in COMPARED]
    if unknown:
        raise UsageError(f"--channels: unknown {', '.join(unknown)}; a replay predicts {', '.join(COMPARED)}")


def check_freed(robot: Robot, fit: Sequence[str]) -> None:
    """Refuse a fit of nothing, with every field of the grammar and the names it can be freed at."""
    if not fit:
        raise UsageError(_what_can_be_freed(robot))


def _what_can_be_freed(robot: Robot) -> str:
    from sysid_btr.terms.grammar import SCOPES
    from sysid_btr.terms.library import declarable

    fields: dict[str, list[str]] = {}
    for name, cls in declarable(robot.fields).items():
        fields.setdefault(cls(places=(), declared=name).location, []).append(name)
    lines = [f"no parameters to fit: give --fit FIELD:GLOB[,GLOB..][=shared], once or more. {robot.name} has"]
    for scope, noun in SCOPES.items():
        names = robot.names(scope)
        if names:
            lines.append(f"  {', '.join(fields.get(scope, []))}\n    of a {noun}: {', '.join(names)}")
    lines.append("for example: --fit 'mass:*' --fit 'kp:*=shared'")
    return "\n".join(lines)


def initial_values(
    terms: Terms, robot: Robot, params: Path | None, start: Mapping[str, float] | None = None
) -> FloatArray:
    """Where a search begins: as the terms have it, but for values of an earlier run, and those given by name or glob.

    Raises
    ------
    UsageError
        For names that no free parameter has, and values outside the bounds; all of them at once.
    """
    from fnmatch import fnmatchcase

    values, parameters, problems = terms.begin, terms.parameters, []
    for name, value in [*_known(params, robot, parameters).items(), *(start or {}).items()]:
        chosen = [i for i, p in enumerate(parameters) if p.name == name] or [
            i for i, p in enumerate(parameters) if fnmatchcase(p.name, name)
        ]
        if not chosen:
            problems.append(f"{name} is not a fitted parameter; available: {', '.join(p.name for p in parameters)}")
        for i in chosen:
            p = parameters[i]
            if not p.lower <= value <= p.upper:
                problems.append(f"{p.name}={value:g} is outside its bounds {p.lower:g} to {p.upper:g}")
            values[i] = value
    if problems:
        raise UsageError("--start: " + "\n  ".join(problems))
    return values


def _known(path: Path | None, robot: Robot, parameters: Sequence[Parameter]) -> Mapping[str, float]:
    """Values of a parameter file, for what is free; says which of its values are not used."""
    if path is None:
        return {}
    from sysid_btr.writeback.params import read_params, starts_from

    given, unused = starts_from(read_params(path, robot), parameters)
    if unused:
        remark(f"--params: not fitted here, so not used: {', '.join(unused)}")
    return given


def output_file(out: Path | None, sources: Sequence[Path], overwrite: bool) -> Path | None:
    """The one file that a verb writes; refused before any work if something is in the way."""
    if out is None:
        return None
    if out.is_dir():
        raise UsageError(f"--out {out} is a folder; give the name of a file in it")
    if any(out.exists() and source.exists() and out.samefile(source) for source in sources):
        raise UsageError(f"--out {out} is also an input, and is not overwritten; choose another name")
    if out.exists() and not overwrite:
        raise UsageError(f"--out {out} exists; --overwrite replaces it, or choose another name")
    if not out.parent.is_dir():
        raise UsageError(f"--out {out}: the folder {out.parent} does not exist; create it first")
    return out
