"""An import from beginning to end: recognise, read, convert, check; writing is the last step, by the caller."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from sysid_btr.errors import LogError, UsageError
from sysid_btr.io._check_columns import log_joints
from sysid_btr.io.importers.assemble import assemble
from sysid_btr.io.importers.base import Importer, MappingNeeded, Recording
from sysid_btr.io.importers.mapping import ImportMap
from sysid_btr.io.importers.names import quoted, suggestions
from sysid_btr.io.importers.registry import get_importer, recognise
from sysid_btr.io.log import JOINT_CHANNELS, Log
from sysid_btr.io.parquet import sha256
from sysid_btr.io.problem import Problem, errors_of
from sysid_btr.io.validation import validate_log


@dataclass(frozen=True)
class KnownModel:
    """What an import wants to know of a model.

    Attributes
    ----------
    name : of the robot.
    joints : in model order.
    ranges : rad or m, where the model states them.
    sliding : joints that slide.
    """

    name: str
    joints: tuple[str, ...]
    ranges: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    sliding: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False, repr=False)
class Imported:
    """A foreign log as one of the schema.

    Attributes
    ----------
    log : in memory; `sysid_btr.io.write_log` writes it.
    formats : importer by source.
    remarks : what was assumed, left out or not understood, a sentence each.
    problems : findings of the validation.
    advice : flags that would put findings right, where flags can.
    """

    log: Log
    formats: Mapping[str, str]
    remarks: tuple[str, ...]
    problems: tuple[Problem, ...]
    advice: tuple[str, ...] = ()

    def __repr__(self) -> str:
        found = f"{len(errors_of(self.problems))} errors, {len(self.problems)} findings, {len(self.remarks)} remarks"
        return f"<Imported {self.log!r}: {found}>"

    @property
    def usable(self) -> bool:
        """Whether nothing stops a fit from using it."""
        return not errors_of(self.problems)


def import_log(
    paths: Sequence[str | os.PathLike[str]],
    *,
    importer: str | Importer = "auto",
    told: ImportMap | None = None,
    model: KnownModel | None = None,
) -> Imported:
    """Read foreign logs as one log; several sources are episodes of it.

    Parameters
    ----------
    paths : files, or folders of bags and datasets.
    importer : name of an importer, one of one's own, or ``"auto"`` to judge each source by its content.
    told : what is known about the source; see `sysid_btr.io.importers.mapping`.
    model : to match joints with, and their ranges.

    Returns
    -------
    Imported
        Also where the validation finds errors.

    Raises
    ------
    LogError
        If a source cannot be read or understood; the problems of all sources at once. A `MappingNeeded` also
        has a mapping file to begin with.
    UsageError
        If what is told does not fit, or a package is missing.
    """
    told = told or ImportMap()
    sources = [Path(p) for p in paths]
    if not sources:
        raise UsageError("which log? Give one or more files: sysid-btr import walk.csv --out walk.parquet")
    recordings: list[Recording] = []
    problems: list[LogError] = []
    formats: dict[str, str] = {}
    for path in sources:
        try:
            chosen = _importer(path, importer)
            formats[str(path)] = chosen.name
            recordings.append(_read(chosen, path, told))
        except LogError as error:
            problems.append(error)
    if len(problems) == 1:
        raise problems[0]
    if problems:
        propose = next((e.propose for e in problems if isinstance(e, MappingNeeded)), None)
        text = "\n".join(map(str, problems))
        raise LogError(text) if propose is None else MappingNeeded(text, propose)
    sliding = {joint: joint in model.sliding for joint in model.joints} if model else {}
    log, assumed = assemble(recordings, told, sliding)
    log = _signed(log, sources, formats, model)
    remarks = [text for r in recordings for text in _with_path(r, len(sources))]
    if len(sources) > 1:
        remarks.append(f"{len(sources)} sources: each becomes an episode")
    found = validate_log(log, joints=model.joints if model else None, ranges=model.ranges if model else None)
    renames = suggestions(log_joints(log), model.joints) if model else {}
    flags = tuple(dict.fromkeys(flag for problem in found for flag in _flags(problem, renames)))
    problems_ = tuple(_with_advice(problem, renames) for problem in found)
    return Imported(log, formats, (*remarks, *assumed), problems_, flags)


def _importer(path: Path, wanted: str | Importer) -> Importer:
    if not isinstance(wanted, str):
        return wanted
    if wanted == "auto":
        return recognise(path)
    if not path.exists():
        raise LogError(f"{path}: no such file or folder; looked in {path.parent.resolve()}")
    return get_importer(wanted)


def _read(importer: Importer, path: Path, told: ImportMap) -> Recording:
    """What a source holds; whatever its content does to the reader is the content's."""
    try:
        return importer.read(path, told)
    except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError, RecursionError) as error:
        raise LogError(
            f"{path}: it is not what {importer.title} holds ({type(error).__name__}: {_one_line(error)}); "
            "record or export it again, or give its columns as CSV"
        ) from error


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split())[:200]


def _with_path(recording: Recording, sources: int) -> Iterator[str]:
    for text in recording.remarks:
        yield text if sources == 1 else f"{recording.path}: {text}"


def _signed(log: Log, sources: Sequence[Path], formats: Mapping[str, str], model: KnownModel | None) -> Log:
    """The log with a note of where it comes from."""
    meta = log.meta
    origin = [
        {"file": path.name, "format": formats[str(path)]} | ({"sha256": sha256(path)} if path.is_file() else {})
        for path in sources
    ]
    return replace(
        log,
        meta=replace(
            meta,
            robot=meta.robot or (model.name if model else ""),
            source=meta.source or f"imported from {', '.join(p.name for p in sources)}",
            extra={**meta.extra, "imported": origin},
        ),
    )


# --- findings, and what puts them right on importing again ---------------------------------------------------


def _flags(problem: Problem, renames: Mapping[str, str]) -> Iterator[str]:
    """Flags that would put a problem right."""
    if problem.code in _UNITS:
        for key, unit in _UNITS[problem.code](problem):
            yield f"--unit {key}={unit}"
    if problem.code in _NAMES:
        for name, meant in renames.items():
            yield f"--rename {quoted(f'{name}={meant}')}"


def _with_advice(problem: Problem, renames: Mapping[str, str]) -> Problem:
    """A problem of a file that can be imported again in another way."""
    if problem.code in _UNITS:
        flags = " ".join(_flags(problem, {}))
        return replace(problem, remedy=f"import with {flags}. Else: {problem.remedy}") if flags else problem
    if problem.code in _NAMES and renames:
        name = problem.where.removeprefix("joint ")
        pair = f"{name}={renames[name]}" if name in renames else "A=B"
        return replace(problem, remedy=f"import with --rename {pair}, if they are the same joint")
    known = _REMEDIES.get(problem.code)
    return problem if known is None else replace(problem, remedy=f"{known}. Else: {problem.remedy}")


def _angles(problem: Problem) -> Iterator[tuple[str, str]]:
    for channel in _channels(problem):
        yield channel, "deg"
    if "angle_" in problem.where:
        yield "imu.angle", "deg"
    if "gyro_" in problem.where:
        yield "imu.gyro", "deg/s"


def _lengths(problem: Problem) -> Iterator[tuple[str, str]]:
    for channel in _channels(problem):
        yield channel, "mm"


def _channels(problem: Problem) -> Iterator[str]:
    """Channels that a problem's place names: ``position.HeadYaw; command of A, B``."""
    for channel in JOINT_CHANNELS:
        if re.search(rf"\b{channel}(\.| of )", problem.where):
            yield channel


def _velocities(problem: Problem) -> Iterator[tuple[str, str]]:
    looks = re.search(r"looks like (\S+)", problem.message)
    if looks:
        yield "velocity", looks[1]


def _clock(problem: Problem) -> Iterator[tuple[str, str]]:
    for word, unit in (("milliseconds", "ms"), ("microseconds", "us"), ("nanoseconds", "ns")):
        if word in problem.message:
            yield "time", unit


def _gravity(_: Problem) -> Iterator[tuple[str, str]]:
    yield "imu.acc", "g"


_UNITS: Mapping[str, Callable[[Problem], Iterator[tuple[str, str]]]] = {
    "units.degrees": _angles,
    "units.millimetres": _lengths,
    "units.velocity": _velocities,
    "units.g": _gravity,
    "time.unit": _clock,
}
"""By code of a finding: the units it speaks for."""
_NAMES = ("joint.misspelled", "joint.missing", "joint.unknown")
_REMEDIES: Mapping[str, str] = {
    "joint.missing": "if the robot does not log these joints, --force writes the log as it is",
    "joint.sign": "reverse the joint's axis in a mapping file ([joints.NAME] sign = -1), or one of its columns "
    '([units] "command.NAME" = -1)',
    "position.range": "correct zero and sign in a mapping file: [joints.NAME] offset = .., sign = -1",
    "units.counts": "state the counts of a turn and the zero, as in --unit position=ticks4096@2048 "
    "--unit command=ticks4096@2048, or use a preset (--show-preset all lists them)",
    "joint.swapped": "swap them: --rename LEFT=RIGHT --rename RIGHT=LEFT, if all of their columns are swapped",
}
