"""Tables of any layout: CSV, and Parquet with foreign columns.

Columns are what the mapping says; without one, what their names plainly say: the schema's own names
(``command.X``), or a joint with a word for a channel (``X_cmd``, ``pos_X``, ``X/position``, ``goal_position_X``).
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from functools import partial
from pathlib import Path

import numpy as np

from sysid_btr._typing import FloatArray, IntArray
from sysid_btr.errors import LogError
from sysid_btr.io._file import TEXT, UNKNOWN, looks_like
from sysid_btr.io._text import some
from sysid_btr.io.importers.base import MappingNeeded, Recording, Signal
from sysid_btr.io.importers.guess import Guess, guess, proposal
from sysid_btr.io.importers.mapping import ImportMap, read_map
from sysid_btr.io.importers.presets import available_presets
from sysid_btr.io.importers.table import PARQUET, Table, as_seconds, header_names, read_table
from sysid_btr.io.importers.units import SI, Unit, check_key, find, group_of
from sysid_btr.io.log import IMU_NAMES, LogMeta, closest, is_schema_column

_WILD: Mapping[str, str] = {"*": ".*", "?": r"[\W_]+"}
_AXES: Mapping[str, str] = {"0": "x", "1": "y", "2": "z"}
"""Axes of arrays."""


@dataclass(frozen=True)
class TableImporter:
    """CSV and Parquet; what no other importer takes."""

    name: str = "csv"
    title: str = "a table (CSV or Parquet)"

    def recognises(self, path: Path, head: bytes) -> bool:
        # text in an old encoding looks like nothing known
        text = looks_like(head)[0] in (TEXT, UNKNOWN)
        return head.startswith(PARQUET) or (text and len(header_names(path, head)) > 1)

    def read(self, path: Path, told: ImportMap) -> Recording:
        table = read_table(path, told.table)
        table = _without(table, told.ignore)
        if told.lays_out_columns:
            found, problems = _as_told(table, told)
        else:
            found, problems = guess(list(table.columns)), []
        time = told.time.column or (None if told.time.rate else found.time)
        if time is not None and time not in table.columns:
            problems.append(_no_column(time, table, "[time] column"))
        if problems:
            raise LogError("\n".join(f"{path}: {p}" for p in problems))
        if (time is None and told.time.rate is None) or not found.joints("position"):
            raise _needed(path, table, found, time)
        if not told.lays_out_columns and not found.joints("command"):
            raise _needed(path, table, found, time)
        return make_recording(path, table, found, time, told)


def make_recording(path: Path, table: Table, found: Guess, time: str | None, told: ImportMap) -> Recording:
    """A table whose columns are known as a recording.

    Raises
    ------
    LogError
        If columns that are to be used do not hold numbers, or the time cannot be read; all at once.
    """
    problems: list[str] = []
    remarks = list(table.remarks)
    seconds: FloatArray = np.arange(len(table)) / (told.time.rate or 1.0)
    if time is not None:
        unit = told.unit("time", time) or found.units.get(time)
        try:
            seconds, said = as_seconds(table, time, unit)
            remarks += said
        except LogError as error:
            problems.append(str(error))
    number = told.episode or ("episode" if "episode" in table.columns else None)
    episode: IntArray | None = None
    if number is not None:
        episode = _episodes(table, number, problems)
    meta, declared = _declared(table)
    signals = []
    for name, column in found.columns.items():
        if name in (time, number):
            continue
        if name in table.odd:
            problems.append(
                f"column {name!r} ({column}): {table.odd[name]}; repair them, or state how missing values are written "
                "in the mapping: [table] missing = [..]"
            )
            continue
        values = np.asarray(table.columns[name], dtype=np.float64)
        signals.append(Signal(name, column, values, found.units.get(name) or declared.get(column)))
    if problems:
        raise LogError("\n".join(f"{path}: {p}" for p in problems))
    by_name = [name for name, unit in found.units.items() if name in {time, *found.columns} and unit]
    by_name = [name for name in by_name if told.unit(found.columns.get(name, "time"), name) is None]
    if by_name and not found.certain:
        listing = some([f"{name}: {found.units[name]}" for name in by_name], 4)
        remarks.append(f"units as given in the columns' names ({listing})")
    used = {time, number, *found.columns}
    foreign = {name: values for name, values in table.columns.items() if name not in used}
    if foreign:
        remarks.append(
            f"{len(foreign)} column{'s are' if len(foreign) > 1 else ' is'} not recognised, kept and not used: "
            f"{some(foreign, 12)}"
        )
    return Recording(path, seconds, tuple(signals), foreign, episode, meta, tuple(remarks))


def _declared(table: Table) -> tuple[LogMeta, Mapping[str, str]]:
    """Metadata of a file that is a log already, but for units to convert; those, by column."""
    meta = table.meta or LogMeta()
    foreign = {
        key: unit
        for key, unit in meta.units.items()
        if check_key(key) is None and any(u != Unit(u.si) and u.si in SI[group_of(key)] for u in find(unit))
    }
    kept = {key: unit for key, unit in meta.units.items() if key not in foreign}
    by_column = {c: foreign[key] for c in table.columns for key in (c, group_of(c)) if key in foreign}
    return replace(meta, units=kept), by_column


def _without(table: Table, globs: list[str]) -> Table:
    kept = {n: v for n, v in table.columns.items() if not any(fnmatchcase(n, g) for g in globs)}
    return Table(kept, table.odd, table.meta, table.remarks)


def _as_told(table: Table, told: ImportMap) -> tuple[Guess, list[str]]:
    """Columns as the mapping says, and what in it does not fit the table."""
    absent = [] if told.partial else [name for name in told.columns if name not in table.columns]
    problems = [_no_column(name, table, "[columns]") for name in absent]
    named = guess(list(table.columns))
    found: dict[str, str] = {}
    patterns = [(pattern, kind) for kind, own in told.channels.items() for pattern in own]
    for pattern, kind in sorted(patterns, key=lambda p: len(p[0])):  # of two that match the longer says more
        matched = dict(_matches(pattern, kind, table, told))
        found |= matched
        if not matched and not told.partial:
            problems.append(f"[channels] {kind} = {pattern!r} matches no column; available: {some(table.columns, 12)}")
    found |= {name: column for name, column in told.columns.items() if name in table.columns}
    exact = {n: n for n in table.columns if is_schema_column(n) and n not in found}
    found |= {n: c for n, c in exact.items() if c not in found.values()}
    by_column: dict[str, list[str]] = {}
    for name, column in found.items():
        by_column.setdefault(column, []).append(name)
    problems += [
        f"{column} would come from more than one column: {', '.join(names)}"
        for column, names in by_column.items()
        if len(names) > 1
    ]
    return Guess(named.time, found, named.units), problems


def _matches(pattern: str, kind: str, table: Table, told: ImportMap) -> list[tuple[str, str]]:
    before, _, rest = pattern.partition("{")
    _, _, after = rest.partition("}")
    shape = re.compile(f"{_glob(before)}(.+?){_glob(after)}")
    found = []
    for name in table.columns:
        match = shape.fullmatch(name)
        if not match or name in told.columns or name == told.time.column:
            continue
        axis = _AXES.get(match[1], match[1].casefold())
        column = f"{kind}_{axis}" if kind.startswith("imu.") else f"{kind}.{match[1]}"
        if kind.startswith("imu.") and column.partition(".")[2] not in IMU_NAMES:
            continue
        found.append((name, column))
    return found


def _glob(text: str) -> str:
    """A part of a pattern as a regular expression: ``*`` stands for anything, ``?`` for marks between words."""
    return "".join(_WILD.get(part, re.escape(part)) for part in re.split(r"([*?])", text))


def _no_column(name: str, table: Table, where: str) -> str:
    guess_ = closest(name, table.columns)
    hint = f"did you mean {guess_!r}? " if guess_ else ""
    return f"{where}: unknown column {name!r}; {hint}available: {some(table.columns, 20)}"


def _episodes(table: Table, name: str, problems: list[str]) -> IntArray | None:
    values = table.columns.get(name)
    if values is None:
        problems.append(_no_column(name, table, "episode"))
        return None
    if values.dtype.kind not in "iufb":
        # names of recordings are as good as numbers
        known: dict[object, int] = {}
        return np.array([known.setdefault(v, len(known)) for v in values.tolist()], dtype=np.int64)
    if not np.all(np.isfinite(values)) or np.any(values != np.round(values)):
        problems.append(f"column {name!r} does not hold a whole number of the recording in every row")
        return None
    return values.astype(np.int64)


def _needed(path: Path, table: Table, found: Guess, time: str | None) -> MappingNeeded:
    missing = []
    if time is None:
        missing.append("which column holds the time")
    missing += [f"which columns hold {c}s" for c in ("command", "position") if not found.joints(c)]
    said = " and ".join(missing)
    fitting = [name for name in available_presets() if _fits(table, read_map(None, name))]
    preset = f"--preset {' or --preset '.join(fitting)} knows columns of such names. Else: a" if fitting else "A"
    return MappingNeeded(
        f"{path}: the names of its {len(table.columns)} columns do not reveal {said}. {preset} mapping file to fill in "
        "is on standard output: save it (sysid-btr import FILE > mapping.toml), edit it, "
        "and give it by --map mapping.toml",
        partial(proposal, path, table, found),
    )


def _fits(table: Table, told: ImportMap) -> bool:
    """Whether a mapping finds commands and positions in a table."""
    found, _ = _as_told(_without(table, told.ignore), told)
    return bool(found.joints("command") and found.joints("position"))
