"""Reads a Parquet file as far as it can be read, and says everything that stops it at the file level."""

from __future__ import annotations

import json
import sys
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeGuard

import numpy as np

from sysid_btr._typing import FloatArray, IntArray
from sysid_btr.errors import LogError
from sysid_btr.io.log import META_KEYS, SCHEMA_VERSION, Log, LogMeta, closest, is_schema_column, torques_of_currents
from sysid_btr.io.problem import Problem
from sysid_btr.machine import require_memory
from sysid_btr.reading import parse_json

if TYPE_CHECKING:
    import pyarrow as pa
    import pyarrow.parquet as pq

DRIVES = ("position", "velocity", "torque", "mixed", "none")
SERVO_PERIODS = (1e-5, 0.5)
"""s, shortest and longest period of a servo's control law."""
EXACT = 2.0**53
"""Up to which a float holds every whole number."""
NUMBER, OBJECT = 8.0, 64.0
"""Bytes of a float64, and of a Python object in a list."""
METADATA_KEY = b"sysid_btr"
_MAGIC = b"PAR1"
TEXT, UNKNOWN = "a text or CSV file", "something else"
_EXAMPLE_META = '{"schema": 1, "robot": "nao", "mount": "fixed", "source": "measured"}'
_TIME_NAMES = ("t", "timestamp", "stamp", "time_s", "seconds", "sec")
_IMPORT = "convert it with `sysid-btr import`, or write a Parquet log (schema 1) yourself"
_AS_TABLE = "write its columns as CSV or Parquet, and convert that with `sysid-btr import`"
_MODEL = "if it is the robot's model, give it with --model; else " + _AS_TABLE
_ROS1 = "make it a ROS 2 bag with `rosbags-convert`, and convert that with `sysid-btr import`"
# First bytes of what people hand over by mistake, how to call it, and what to do with it.
_SIGNATURES = (
    (b"\x89HDF", "an HDF5 file", _AS_TABLE),
    (b"PK\x03\x04", "a zip archive or .npz file", _AS_TABLE),
    (b"\x93NUMPY", "a .npy file", _AS_TABLE),
    (b"\x1f\x8b", "a gzip file", _IMPORT),
    (b"#ROSBAG", "a ROS 1 bag", _ROS1),
    (b"\x89MCAP", "an MCAP file", _IMPORT),
    (b"SQLite format 3", "a SQLite file or ROS 2 bag", _IMPORT),
    (b"ARROW1", "an Arrow IPC (Feather) file", _AS_TABLE),
    (b"<", "an XML file", _MODEL),
    (b"{", "a JSON file", _AS_TABLE),
)


def load(path: str | Path) -> tuple[Log | None, tuple[Problem, ...]]:
    """Read what can be read of a log.

    Returns
    -------
    log : Log or None
        The log, with defaults in place of metadata that could not be used; None if there is nothing to check.
    problems : tuple of Problem
        Problems of the file itself; the content is left to `sysid_btr.io.validation`.
    """
    path = Path(path)
    unreadable = _unreadable(path)
    if unreadable is not None:
        return None, (unreadable,)
    try:
        table = _read_table(path)
    except LogError as error:
        return None, (Problem("file.large", "error", str(path), str(error), "record fewer samples, or fewer columns"),)
    except (OSError, ValueError, NotImplementedError) as error:  # pyarrow's errors derive from these
        problem = Problem(
            "file.corrupt",
            "error",
            str(path),
            f"the file is Parquet but its content cannot be decoded ({_one_line(error)})",
            "copy or record the file again; compare its checksum with that of the original",
        )
        return None, (problem,)
    problems: list[Problem] = []
    meta = _meta(table.schema.metadata or {}, problems)
    log = _log(table, meta, path, problems)
    return log, tuple(problems)


def _read_table(path: Path) -> pa.Table:
    import pyarrow.parquet as pq

    with pq.ParquetFile(path) as file:
        require_memory(memory_of(file), f"{path}: its {file.metadata.num_rows} rows", "cut the log", LogError)
        return file.read()


def memory_of(file: pq.ParquetFile) -> float:
    """Bytes that a table takes once it is read: numbers as they are and as float64, anything else as objects."""
    schema, rows = file.schema_arrow, float(file.metadata.num_rows)
    cells = sum(2.0 * NUMBER if _is_numeric(field.type) else OBJECT for field in schema)
    packed = sum(file.metadata.row_group(g).total_byte_size for g in range(file.metadata.num_row_groups))
    return rows * cells + float(packed)


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split())[:200]


def _unreadable(path: Path) -> Problem | None:
    """Why the file is no Parquet file at all, judged by its first and last bytes."""

    def problem(code: str, message: str, remedy: str) -> Problem:
        return Problem(code, "error", str(path), message, remedy)

    if not path.exists():
        return problem("file.missing", "the file does not exist", f"check the path; looked in {path.parent.resolve()}")
    if not path.is_file():
        return problem(
            "file.not_a_file",
            "this is a folder, not a log",
            "give one Parquet file, --log once for each; "
            "a ROS 2 bag or a LeRobot dataset is converted with `sysid-btr import`",
        )
    try:
        size = path.stat().st_size
        with path.open("rb") as file:
            head = file.read(512)
            file.seek(max(size - 4, 0))
            tail = file.read(4)
    except OSError as error:
        return problem("file.unreadable", f"the file cannot be read ({_one_line(error)})", "check its permissions")
    if size == 0:
        return problem("file.empty", "the file has 0 bytes", "record or copy it again")
    if head.startswith(_MAGIC) and tail == _MAGIC and size >= 12:
        return None
    if head.startswith(_MAGIC):
        return problem(
            "file.truncated",
            f"the file begins as Parquet but its end (the footer) is missing after {size} bytes: "
            "it was cut short, or the recorder did not close it",
            "copy it again, or close the recorder properly; the footer cannot be rebuilt",
        )
    kind, remedy = looks_like(head)
    return problem("file.not_parquet", f"this is not a Parquet file: it looks like {kind}", remedy)


def looks_like(head: bytes) -> tuple[str, str]:
    """What a file that is not Parquet seems to be, by its first bytes, and what to do with it."""
    for start, name, remedy in _SIGNATURES:
        if head.startswith(start):
            return name, remedy
    return (TEXT, _IMPORT) if _is_text(head) else (UNKNOWN, _AS_TABLE)


def _is_text(head: bytes) -> bool:
    try:
        head.decode("utf-8")
    except UnicodeDecodeError:
        return False
    return b"\x00" not in head


# --- metadata -----------------------------------------------------------------------------------------------


def _meta(metadata: Mapping[bytes, bytes], problems: list[Problem]) -> LogMeta:
    def report(code: str, where: str, message: str, remedy: str) -> None:
        problems.append(Problem(code, "error", where, message, remedy))

    if METADATA_KEY not in metadata:
        report(
            "meta.missing",
            "file metadata",
            "the Parquet metadata key `sysid_btr` is missing, so robot, mount and schema version are unknown",
            f"add it with JSON such as {_EXAMPLE_META}, or convert the file with `sysid-btr import`",
        )
        return LogMeta()
    try:
        raw = parse_json(metadata[METADATA_KEY])
    except ValueError as error:
        report("meta.json", "file metadata `sysid_btr`", f"not valid JSON ({error})", f"write e.g. {_EXAMPLE_META}")
        return LogMeta()
    if not isinstance(raw, dict):
        report("meta.json", "file metadata `sysid_btr`", "not a JSON object", f"write e.g. {_EXAMPLE_META}")
        return LogMeta()
    return parse_meta(raw, problems)


def parse_meta(raw: Mapping[str, Any], problems: list[Problem]) -> LogMeta:
    """Metadata from its JSON object; what cannot be used is reported and replaced by its default."""
    known: dict[str, Any] = {}

    def accept(key: str, good: bool, allowed: str) -> None:
        if key not in raw:
            return
        if good:
            known[key] = raw[key]
        else:
            problems.append(
                Problem(
                    f"meta.{key}",
                    "error",
                    f"file metadata, `{key}`",
                    f"{json.dumps(raw[key])} is not allowed",
                    f"use {allowed}, or leave `{key}` out",
                )
            )

    version = raw.get("schema")
    if version != SCHEMA_VERSION or isinstance(version, bool):
        said = "no schema version is given" if version is None else f"schema version {json.dumps(version)} is unknown"
        newer = isinstance(version, int) and version > SCHEMA_VERSION
        problems.append(
            Problem(
                "meta.schema",
                "error",
                "file metadata, `schema`",
                f"{said}; this release reads version {SCHEMA_VERSION}",
                "update sysid_btr" if newer else f'set "schema": {SCHEMA_VERSION} if the columns follow that schema',
            )
        )
    for key in ("robot", "source", "notes"):
        accept(key, isinstance(raw.get(key), str), "text")
    accept("mount", raw.get("mount") in ("fixed", "free"), '"fixed" (the torso was fixed) or "free"')
    accept("command_hold", raw.get("command_hold") in ("zoh", "linear"), '"zoh" or "linear"')
    accept("recorded", _is_date(raw.get("recorded")), 'ISO 8601, e.g. "2026-11-23T14:05:00+00:00"')
    period, servo = raw.get("sample_period"), raw.get("servo_period")
    accept("sample_period", period is None or _positive(period), "a positive number of seconds")
    quick, slow = SERVO_PERIODS
    accept(
        "servo_period",
        servo is None or (_positive(servo) and quick <= servo <= slow),
        f"seconds from {quick:g} to {slow:g}: control laws of servos run at 2 Hz to 100 kHz",
    )
    for key in ("sample_period", "servo_period"):
        if known.get(key) is not None:
            known[key] = float(known[key])
    accept("drive", raw.get("drive") in DRIVES, ", ".join(f'"{name}"' for name in DRIVES))
    accept("command_space", raw.get("command_space") in ("joint", "ctrl"), '"joint" or "ctrl"')
    constant, at = raw.get("torque_constant"), raw.get("at")
    accept(
        "torque_constant",
        _positive(constant) or _numbers(constant),
        'Nm/A as a number, or by joint, e.g. {"elbow": 0.09}',
    )
    accept(
        "at",
        _numbers(at) or (isinstance(at, str) and at.startswith("keyframe:")),
        'positions by joint, e.g. {"finger": 0.02}, or "keyframe:NAME"',
    )
    units = raw.get("units")
    accept(
        "units",
        isinstance(units, dict) and all(isinstance(unit, str) for unit in units.values()),
        'an object of channel and unit, e.g. {"position": "rad"}',
    )
    noise = raw.get("noise")
    accept(
        "noise",
        isinstance(noise, dict) and all(map(_positive, noise.values())),
        'an object of channel or column and standard deviation (SI), e.g. {"position": 1e-4}',
    )
    extra = {key: value for key, value in raw.items() if key not in META_KEYS}
    problems.extend(_misspelled_keys(extra, raw))
    return LogMeta(**known, extra=extra)


def _misspelled_keys(extra: Iterable[str], raw: Mapping[str, Any]) -> Iterator[Problem]:
    """Keys that this release does not know, and that are nearly one that it does."""
    for key in extra:
        guess = closest(key, META_KEYS)
        if guess and guess not in raw:
            yield Problem(
                "meta.unknown_key",
                "warning",
                f"file metadata, `{key}`",
                f"the schema has no key `{key}`, so it is kept but not used; did you mean `{guess}`?",
                f"rename it to `{guess}` if so",
            )


def _is_date(value: object) -> bool:
    """Whether it is a date, or a date and time, in ISO 8601."""
    try:
        return isinstance(value, str) and bool(datetime.fromisoformat(value))
    except ValueError:
        return False


def _numbers(value: object) -> bool:
    """Whether it is a table of finite numbers."""
    return isinstance(value, dict) and all(map(_finite, value.values()))


def _positive(value: object) -> TypeGuard[float]:
    return _finite(value) and value > 0


def _finite(value: object) -> TypeGuard[float]:
    """Whether it is a number that a float can hold."""
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return False
    return abs(value) <= sys.float_info.max


# --- columns ------------------------------------------------------------------------------------------------


def _log(table: pa.Table, meta: LogMeta, path: Path, problems: list[Problem]) -> Log | None:
    def report(code: str, where: str, message: str, remedy: str) -> None:
        problems.append(Problem(code, "error", where, message, remedy))

    n = table.num_rows
    twice = [name for name, count in Counter(table.column_names).items() if count > 1]
    if twice:
        report(
            "column.duplicate",
            ", ".join(twice),
            "the file has more than one column of this name, and they may differ",
            "keep one of each; joints are matched by name",
        )
    columns: dict[str, pa.ChunkedArray] = {}
    for name, column in zip(table.column_names, table.columns, strict=True):
        columns.setdefault(name, column)
    if n == 0:
        report(
            "log.empty",
            str(path),
            f"the log has {len(columns)} columns and no samples",
            "record again; a log needs some seconds of motion",
        )

    time = _time(columns, meta, n, problems)
    episode = _episode(columns, n, problems)
    channels: dict[str, FloatArray] = {}
    unknown: dict[str, np.ndarray[Any, Any]] = {}
    not_numeric: list[str] = []
    for name, column in columns.items():
        if name in ("time", "episode"):
            continue
        if is_schema_column(name) and _is_numeric(column.type):
            channels[name] = _floats(column)
            continue
        if is_schema_column(name):
            not_numeric.append(f"{name} ({column.type})")
        unknown[name] = _values(column)
    if not_numeric:
        report(
            "column.not_numeric",
            ", ".join(not_numeric),
            "columns of the schema hold numbers (or booleans), these do not",
            "convert them to float64, with null or NaN where a value is missing",
        )
    if time is None or n == 0:
        return None
    channels |= torques_of_currents(channels, meta)
    return Log(time=time, channels=channels, meta=meta, episode=episode, path=path, unknown=unknown)


def _time(columns: Mapping[str, pa.ChunkedArray], meta: LogMeta, n: int, problems: list[Problem]) -> FloatArray | None:
    found = _seconds(columns["time"], meta) if "time" in columns else None
    if found is not None:
        return found
    if "time" in columns:
        message, remedy = (
            f"the column holds {columns['time'].type}, not a number of seconds",
            "write time as float64 seconds; any origin will do",
        )
        problems.append(Problem("time.type", "error", "time", message, remedy))
    else:
        guess = closest("time", columns) or next((c for c in columns if c.casefold() in _TIME_NAMES), None)
        hint = f"; is `{guess}` the time?" if guess else ""
        problems.append(
            Problem(
                "time.missing",
                "error",
                "time",
                f"the log has no column `time`{hint}",
                "add `time`: float64 seconds, strictly increasing, any origin",
            )
        )
    # With the nominal period the other columns can still be checked in the same pass.
    return None if meta.sample_period is None else np.arange(n, dtype=np.float64) * meta.sample_period


def _seconds(column: pa.ChunkedArray, meta: LogMeta) -> FloatArray | None:
    """A clock in seconds: floats as they are, timestamps since the first of them; None for anything else.

    Whole numbers are seconds, too, unless their steps are the sample period in milli-, micro- or nanoseconds.
    """
    import pyarrow as pa

    if pa.types.is_timestamp(column.type):
        ticks, unit = column.cast(pa.int64()), {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}[column.type.unit]
    elif pa.types.is_integer(column.type) and meta.sample_period is not None:
        ticks, unit = column, _unit_of(column, meta.sample_period)
    else:
        return _floats(column) if _is_numeric(column.type) else None
    if ticks.null_count or not len(ticks):
        return _floats(ticks) * unit
    whole = ticks.to_numpy().astype(np.int64)
    # differences of whole numbers are exact, however far away the origin is
    return np.asarray((whole - whole[0]).astype(np.float64) * unit) if unit != 1.0 else _floats(ticks)


def _unit_of(column: pa.ChunkedArray, period: float) -> float:
    """Seconds of one tick: that by which the steps are the sample period; 1 if none is."""
    steps = np.diff(column.drop_null().to_numpy())
    middle = float(np.median(steps)) if len(steps) else 0.0
    return next((unit for unit in (1.0, 1e-3, 1e-6, 1e-9) if 0.5 * period < middle * unit < 2 * period), 1.0)


def _episode(columns: Mapping[str, pa.ChunkedArray], n: int, problems: list[Problem]) -> IntArray:
    if "episode" not in columns:
        return np.zeros(n, dtype=np.int64)
    column = columns["episode"]
    values = _floats(column) if _is_numeric(column.type) else np.full(n, np.nan)
    if not np.all(np.abs(values) < EXACT) or np.any(values != np.round(values)):
        problems.append(
            Problem(
                "episode.type",
                "error",
                "episode",
                f"the column ({column.type}) does not hold a whole number in every row",
                "number the episodes 0, 1, 2, ... or leave the column out",
            )
        )
        return np.zeros(n, dtype=np.int64)
    return values.astype(np.int64)


def _is_numeric(kind: pa.DataType) -> bool:
    from pyarrow import types

    return bool(
        types.is_integer(kind)
        or types.is_floating(kind)
        or types.is_boolean(kind)
        or types.is_decimal(kind)
        or types.is_null(kind)
    )


def _floats(column: pa.ChunkedArray) -> FloatArray:
    """A numeric column as a new float64 array; null becomes NaN."""
    import pyarrow as pa

    if pa.types.is_boolean(column.type):
        column = column.cast(pa.int8())
    values: FloatArray = column.cast(pa.float64(), safe=False).to_numpy().astype(np.float64, copy=True)
    return values


def _values(column: pa.ChunkedArray) -> np.ndarray[Any, Any]:
    """Any column as numpy, such that writing it back gives the same column (null stays null)."""
    import pyarrow as pa

    if pa.types.is_floating(column.type) and column.null_count == 0:
        return np.array(column.to_numpy())
    if (pa.types.is_integer(column.type) or pa.types.is_boolean(column.type)) and column.null_count == 0:
        return np.array(column.to_numpy())
    if pa.types.is_timestamp(column.type) and column.type.tz is None:
        return np.array(column.to_numpy())
    values = np.empty(len(column), dtype=object)
    values[:] = column.to_pylist()
    return values
