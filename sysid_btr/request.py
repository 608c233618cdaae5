"""What the command line was asked for, from text to robot, logs, start and bounds."""

from __future__ import annotations

import math
import sys
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sysid_btr.errors import LogError, UsageError
from sysid_btr.run_folder import Folder, open_folder
from sysid_btr.version import __version__

if TYPE_CHECKING:
    from sysid_btr._typing import FloatArray
    from sysid_btr.estimators.journal import Journal
    from sysid_btr.executors.base import Executor
    from sysid_btr.identify.study import Study
    from sysid_btr.io.log import Log
    from sysid_btr.models.robot import Robot
    from sysid_btr.simulation.numerics import Numerics
    from sysid_btr.terms.base import Parameter
    from sysid_btr.terms.model import Model

DECLARED = ("mass:*", "kp:*=shared", "kv:*=shared")
"""What `close` frees where nothing is said: a wrong mass or gain must not pass for an effect."""
HOLDOUT = 0.3


def remark(text: str) -> None:
    """Tell the user something that is no result."""
    sys.stderr.write(text + "\n")
    sys.stderr.flush()


@dataclass(frozen=True, eq=False)
class Request:
    """What a fit or a closing was asked for."""

    kind: str
    robot: Robot
    logs: list[Log]
    holdout: list[str] | None
    free: list[str]
    channels: list[str] | None
    threads: int
    seed: int
    settings: dict[str, Any]
    executor: str | None = None

    def study(self, executor: Executor) -> Study:
        """Logs and model laid out; remarks on the logs go to stderr."""
        from sysid_btr.identify.study import make_study
        from sysid_btr.objectives.targets import FITTED

        chosen = chosen_channels(self.channels) or FITTED
        for log in self.logs:
            _warn(self.robot, log)
        return make_study(
            self.robot,
            self.logs,
            holdout=_holdout(self.holdout),
            channels=chosen,
            threads=self.threads,
            executor=executor,
        )

    def fingerprint(self) -> str:
        """Digest of all that decides which candidates are evaluated."""
        import hashlib
        import json

        from sysid_btr.io.parquet import sha256

        held = [sha256(p) if Path(p).is_file() else p for p in self.holdout or []]
        content = {
            "version": __version__,
            "kind": self.kind,
            "model": self.robot.digest,
            "logs": [sha256(log.path) for log in self.logs if log.path is not None],
            "holdout": held,
            "fit": self.free,
            "channels": chosen_channels(self.channels),
            "seed": self.seed,
            **self.settings,
        }
        return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


@dataclass(frozen=True, eq=False)
class Keeper:
    """Where a run keeps what it finds: a folder and its journal, or memory alone."""

    folder: Folder | None
    journal: Journal

    @classmethod
    def open(cls, out: Path | None, resume: bool, overwrite: bool, request: Request) -> Keeper:
        from sysid_btr.estimators.journal import Journal

        if out is None:
            if resume:
                raise UsageError("--resume goes on with the journal of an earlier run: give its --out folder")
            return cls(None, Journal())
        folder = open_folder(out, resume=resume, overwrite=overwrite)
        return cls(folder, Journal(folder.journal, fingerprint=request.fingerprint()))


def find_robot(name: str | None, bounds: list[str] | None) -> Robot:
    """The robot called for, with the bounds given to its parameters."""
    from dataclasses import replace

    from sysid_btr.models.builtin import BUILTIN, load_robot

    if name is None:
        built_in = f" ({', '.join(sorted(BUILTIN))})" if BUILTIN else ""
        raise UsageError(f"which robot? Give --model: a built-in name{built_in} or an MJCF or URDF file")
    robot = load_robot(name)
    table = dict(bounds_table(bounds))
    _check_names(robot, table)
    return replace(robot, bounds={**robot.bounds, **table}) if table else robot


def read_logs(paths: Iterable[Path] | None, *, motions: bool = False) -> list[Log]:
    """All logs, or one error that lists what is wrong with each of them.

    A motion that nobody has recorded yet counts as wrong, unless `motions` are wanted.
    """
    from sysid_btr.io.parquet import read_log

    logs, problems = [], []
    for path in paths or ():
        try:
            log = read_log(path)
        except LogError as error:
            problems.append(str(error))
            continue
        if log.is_motion and not motions:
            problems.append(
                f"{path} is a motion to be played, not a recording: play it on the robot, and give the log of what its "
                "sensors said"
            )
        logs.append(log)
    if problems:
        raise LogError("\n".join(problems))
    if not logs:
        raise UsageError("which log? Give --log FILE, once for each log")
    return logs


def _warn(robot: Robot, log: Log) -> None:
    """Remarks of the validation on a log that can be used all the same."""
    from sysid_btr.io.validation import validate_log
    from sysid_btr.models.robot import joint_names, joint_ranges

    for problem in validate_log(log, joints=joint_names(robot), ranges=joint_ranges(robot)):
        remark(f"warning: {log.path}: {problem.where}: {problem.message} [{problem.code}]\n    -> {problem.remedy}")


def _holdout(given: list[str] | None) -> float | list[Log]:
    if not given:
        return HOLDOUT
    numbers = [number(text) for text in given]
    if len(given) == 1 and numbers[0] is not None:
        return numbers[0]
    if any(n is not None for n in numbers):
        raise UsageError(f"--holdout takes one fraction or log files, not both: {', '.join(given)}")
    return read_logs([Path(text) for text in given])


def chosen_channels(given: list[str] | None) -> tuple[str, ...]:
    """Channels to fit; none if nothing is said."""
    from sysid_btr.objectives.targets import COMPARED

    names = split_names(given)
    unknown = [name for name in names if name not in COMPARED]
    if unknown:
        raise UsageError(f"--channels: unknown {', '.join(unknown)}; a replay predicts {', '.join(COMPARED)}")
    return tuple(names)


def declared(robot: Robot, free: list[str] | None) -> list[str]:
    """What `close` frees."""
    from sysid_btr.models.robot import servo_joints

    if free:
        return free
    declared = [p for p in DECLARED if p.startswith("mass") or servo_joints(robot)]
    remark(f"freeing {', '.join(declared)} (--fit says otherwise)")
    return declared


def what_can_be_freed(robot: Robot) -> str:
    """Every field of the grammar with the names it can be freed at, for those who gave none."""
    from sysid_btr.models.robot import body_names, joint_names, servo_joints
    from sysid_btr.terms.fields import FIELDS

    fields: dict[str, list[str]] = {}
    for name, cls in {**FIELDS, **robot.fields}.items():
        fields.setdefault(cls.scope, []).append(name)
    lines = [
        f"what shall be fitted? Give --fit FIELD:GLOB[,GLOB..][=shared], once or more. {robot.name} has",
    ]
    for scope, names in (
        ("body", body_names(robot)),
        ("joint", joint_names(robot)),
        ("servo", servo_joints(robot)),
    ):
        noun = {"body": "bodies", "joint": "joints", "servo": "joints with a servo"}[scope]
        lines.append(f"  {', '.join(fields.get(scope, []))}\n    of {noun}: {', '.join(names) or 'none'}")
    lines.append("for example: --fit 'mass:*' --fit 'kp:*=shared'")
    return "\n".join(lines)


def start_values(parameters: Sequence[Parameter], given: list[str] | None) -> FloatArray:
    """Where the search begins: the nominal values, but for those given by name or glob.

    Raises
    ------
    UsageError
        For names that no free parameter has, and values outside the bounds; all of them at once.
    """
    from fnmatch import fnmatchcase

    import numpy as np

    values = np.array([p.nominal for p in parameters])
    problems = []
    for name, value in assignments("--start", given):
        chosen = [i for i, p in enumerate(parameters) if p.name == name] or [
            i for i, p in enumerate(parameters) if fnmatchcase(p.name, name)
        ]
        if not chosen:
            problems.append(
                f"{name} is not a free parameter; there are {', '.join(p.name for p in parameters)}"
            )
        for i in chosen:
            p = parameters[i]
            if not p.lower <= value <= p.upper:
                problems.append(f"{p.name}={value:g} is outside its bounds {p.lower:g} to {p.upper:g}")
            values[i] = value
    if problems:
        raise UsageError("--start: " + "\n  ".join(problems))
    return values


def params_digest(path: Path | None) -> str | None:
    """Digest of a parameter file that a search begins from."""
    from sysid_btr.io.parquet import sha256
    from sysid_btr.run_folder import PARAMS

    if path is None:
        return None
    file = path / PARAMS if path.is_dir() else path
    return sha256(file) if file.is_file() else None


def known_starts(path: Path | None, robot: Robot, parameters: Sequence[Parameter]) -> list[str]:
    """``NAME=VALUE`` texts from a parameter file, for what is free; says which of its values are not used."""
    if path is None:
        return []
    from sysid_btr.writeback.params import read_params, starts_from

    given, unused = starts_from(read_params(path, robot), parameters)
    if unused:
        remark(f"--params: not free here, and so not used: {', '.join(unused)}")
    return given


def with_params(path: Path, robot: Robot, model: Model) -> tuple[Model, Numerics]:
    """A model of an earlier run, further changed by the terms of another; and its numerics."""
    from sysid_btr.terms.model import Model
    from sysid_btr.writeback.params import read_params

    params = read_params(path, robot)
    taken = {(m.name, place) for m in params.model.terms for place in m.places}
    twice = [f"{m.name}:{place}" for m in model.terms for place in m.places if (m.name, place) in taken]
    if twice:
        raise UsageError(f"given by --set and by --params: {', '.join(twice)}; give one of the two")
    return Model.joined([*params.model.parts, *model.parts]), params.numerics


def assignments(flag: str, given: list[str] | None) -> list[tuple[str, float]]:
    """``NAME=NUMBER`` texts of a flag as pairs."""
    pairs, problems = [], []
    for text in given or ():
        name, equals, right = text.rpartition("=")
        value = number(right)
        if not equals or not name or value is None:
            problems.append(f"{flag} {text}: expected NAME=NUMBER")
        else:
            pairs.append((name, value))
    if problems:
        raise UsageError("\n".join(problems))
    return pairs


def bounds_table(given: list[str] | None) -> list[tuple[str, tuple[float, float]]]:
    """``NAME=LOW:HIGH`` texts as pairs."""
    pairs, problems = [], []
    for text in given or ():
        name, _, right = text.rpartition("=")
        low, _, high = right.partition(":")
        lower, upper = number(low), number(high)
        if not name or lower is None or upper is None or not lower < upper:
            problems.append(f"--bounds {text}: expected NAME=LOW:HIGH with LOW < HIGH")
        else:
            pairs.append((name, (lower, upper)))
    if problems:
        raise UsageError("\n".join(problems))
    return pairs


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


def number(text: str) -> float | None:
    """A finite number, or None."""
    try:
        value = float(text)
    except ValueError:
        return None
    return value if math.isfinite(value) else None


def split_names(given: list[str] | None) -> list[str]:
    """Names of a repeatable flag that may also hold several, with commas."""
    return [name for text in given or () for name in text.split(",") if name]


def replay_targets(out: Path | None, logs: Sequence[Log], overwrite: bool) -> list[Path]:
    """Where the predicted logs go; refused before any work if something is in the way."""
    if out is None:
        return []
    targets = [out / f"{log.path.stem if log.path else 'log'}.replayed.parquet" for log in logs]
    if len(set(targets)) < len(targets):
        raise UsageError("two logs have the same file name, and so would their replays: run them one by one")
    there = [str(path) for path in targets if path.exists()]
    if there and not overwrite:
        raise UsageError(f"{', '.join(there)} exists; --overwrite replaces it, or choose another --out")
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UsageError(f"--out {out} cannot be created: {error.strerror}; choose another folder") from error
    return targets


def pairs(flag: str, given: list[str] | None) -> list[tuple[str, str]]:
    """``A=B`` texts of a flag as pairs."""
    split = [text.partition("=") for text in given or ()]
    wrong = [
        f"{flag} {text}: expected A=B" for text, (a, _, b) in zip(given or (), split, strict=True) if not (a and b)
    ]
    if wrong:
        raise UsageError("\n".join(wrong))
    return [(a, b) for a, _, b in split]


def output_file(out: Path | None, sources: Sequence[Path], overwrite: bool) -> Path | None:
    """The one file that a verb writes; refused before any work if something is in the way."""
    if out is None:
        return None
    if out.is_dir():
        raise UsageError(f"--out {out} is a folder; give the name of a file in it")
    if any(out.exists() and source.exists() and out.samefile(source) for source in sources):
        raise UsageError(f"--out {out} is also read, and is not overwritten; choose another name")
    if out.exists() and not overwrite:
        raise UsageError(f"--out {out} exists; --overwrite replaces it, or choose another name")
    if not out.parent.is_dir():
        raise UsageError(f"--out {out}: the folder {out.parent} does not exist; create it first")
    return out


def warn_of(robot: Robot, logs: Iterable[Log]) -> None:
    """Remarks of the validation on logs that can be used all the same."""
    for log in logs:
        _warn(robot, log)
