"""Tables as columns: CSV in its many dialects, and Parquet files of any content."""

from __future__ import annotations

import csv
import gzip
import io
import re
import zlib
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from sysid_btr._typing import FloatArray
from sysid_btr.errors import LogError
from sysid_btr.io._file import load
from sysid_btr.io.importers.mapping import TableRule
from sysid_btr.io.importers.units import Unit, find
from sysid_btr.io.log import LogMeta
from sysid_btr.io.problem import explain
from sysid_btr.machine import require_memory

if TYPE_CHECKING:
    import pyarrow as pa

PARQUET = b"PAR1"
GZIP = b"\x1f\x8b"
MISSING = ("", "nan", "NaN", "NAN", "-nan", "NA", "N/A", "null", "NULL", "None", "none")
SEPARATORS = (",", ";", "\t", "|")
COMMENTS = ("#", "%", "//")
CLOCKS = (("ms", 1e-3, 1.0, 200.0), ("us", 1e-6, 200.0, 2e5), ("ns", 1e-9, 2e5, np.inf))
"""Unit, factor, and the typical interval from and below which a clock is taken to count in it."""
PIECE, TEXT = 1 << 24, 4.0
"""Bytes that are unpacked at a time, and how often a text lies in memory while its table is read."""
SLOW = 0.2
"""s; a joint log that slow deserves a remark."""
_NUMBER = re.compile(r"\s*[-+]?(\d+([.,]\d*)?|[.,]\d+)([eE][-+]?\d+)?\s*")
_DECIMAL_COMMA = re.compile(r"\s*[-+]?\d+,\d+([eE][-+]?\d+)?\s*")
_DAYS = re.compile(r"\s*\d{4}-\d{2}-\d{2}[ T]\d{2}:\d{2}")


@dataclass(frozen=True, eq=False)
class Table:
    """Columns of a file by name.

    Attributes
    ----------
    columns : ndarray, shape (n,) each, of the file's own type; of objects where not all values are numbers.
    odd : by column of objects, what in it is no number.
    meta : metadata of a log of the schema, if the file is one.
    remarks : what was noticed on reading.
    """

    columns: Mapping[str, np.ndarray[Any, Any]]
    odd: Mapping[str, str] = field(default_factory=dict)
    meta: LogMeta | None = None
    remarks: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(next(iter(self.columns.values()), ()))


def read_table(path: Path, rule: TableRule) -> Table:
    """A CSV (also packed with gzip) or Parquet file.

    Raises
    ------
    LogError
        If it cannot be read as a table.
    """
    head = first_bytes(path)
    table = _read_parquet(path) if head.startswith(PARQUET) else _read_text(path, rule)
    if len(table) == 0:
        raise LogError(f"{path}: the table has {len(table.columns)} columns and no rows; record again")
    return table


def first_bytes(path: Path, count: int = 65536) -> bytes:
    """The beginning of a file, unpacked; empty for a folder.

    Raises
    ------
    LogError
        If it cannot be read.
    """
    if path.is_dir():
        return b""
    try:
        with path.open("rb") as file:
            head = file.read(count)
        if head.startswith(GZIP):
            with gzip.open(path, "rb") as packed:
                head = packed.read(count)
    except (OSError, EOFError, zlib.error) as error:
        reason = getattr(error, "strerror", None) or error
        raise LogError(f"{path}: the file cannot be read ({reason})") from error
    return head


def header_names(path: Path, head: bytes) -> list[str]:
    """Names of the columns of a table whose first bytes these are; none if it is no table."""
    if head.startswith(PARQUET):
        import pyarrow as pa
        import pyarrow.parquet as pq

        try:
            return list(pq.read_schema(path).names)
        except (OSError, ValueError, pa.ArrowException):
            return []
    try:
        lines = _decode(head, strict=False).splitlines()
    except ValueError:
        return []
    start = next((i for i, line in enumerate(lines) if not _skipped(line)), None)
    if start is None:
        return []
    separator = _separator(lines[start])
    return _fields(lines[start], separator)


# --- text ---------------------------------------------------------------------------------------------------


def _read_text(path: Path, rule: TableRule) -> Table:
    text = _text(path)
    lines = text.splitlines()
    first = next((i for i, line in enumerate(lines) if not _skipped(line)), None)
    if first is None:
        raise LogError(f"{path}: the file holds no table")
    separator = rule.separator or _separator(lines[first])
    names, start = _header(path, lines, first, separator, rule)
    body = [(i + 1, line) for i, line in enumerate(lines[start:], start) if not _skipped(line)]
    body, remarks = _whole_rows(path, body, len(names), separator, text.endswith(("\n", "\r")))
    decimal = rule.decimal or _decimal(body, separator)
    table = _columns(path, names, body, separator, decimal, rule)
    return replace(table, remarks=remarks)


def _text(path: Path) -> str:
    try:
        content = path.read_bytes()
        if content.startswith(GZIP):
            content = _unpacked(path)
    except (OSError, EOFError, zlib.error) as error:
        reason = getattr(error, "strerror", None) or error
        raise LogError(f"{path}: the file cannot be read ({reason})") from error
    if not content:
        raise LogError(f"{path}: the file has 0 bytes; record or copy it again")
    try:
        return _decode(content)
    except ValueError as error:
        raise LogError(f"{path}: {error}") from error


def _unpacked(path: Path) -> bytes:
    """The content of a packed file, piece by piece: a small one may hold more than any memory."""
    parts, size = [], 0
    with gzip.open(path, "rb") as packed:
        while part := packed.read(PIECE):
            parts.append(part)
            size += len(part)
            require_memory(TEXT * size, f"{path}: the text packed in it", "cut the log", LogError)
    return b"".join(parts)


def _decode(content: bytes, strict: bool = True) -> str:
    if content.startswith((b"\xff\xfe", b"\xfe\xff")):
        return content.decode("utf-16", "strict" if strict else "ignore")
    if b"\x00" in content:
        raise ValueError("the file is neither text nor Parquet: zero bytes in it; copy or convert it again")
    try:
        return content.decode("utf-8-sig", "strict" if strict else "ignore")
    except UnicodeDecodeError:
        return content.decode("latin-1")


def _skipped(line: str) -> bool:
    return not line.strip() or line.lstrip().startswith(COMMENTS)


def _separator(line: str) -> str:
    """The most frequent separator of a line; blanks if there is none."""
    bare = re.sub(r'"[^"]*"', "", line)
    counts = {s: bare.count(s) for s in SEPARATORS}
    best = max(counts, key=lambda s: counts[s])
    return best if counts[best] else " "


def _fields(line: str, separator: str) -> list[str]:
    if separator == " ":
        return line.split()
    try:
        fields = next(csv.reader([line], delimiter=separator, skipinitialspace=True))
    except csv.Error:  # a field longer than any name
        fields = line.split(separator)
    return [f.strip() for f in fields]


def _header(path: Path, lines: Sequence[str], first: int, separator: str, rule: TableRule) -> tuple[list[str], int]:
    """Names of the columns, and the line at which the values begin."""
    fields = _fields(lines[first], separator)
    numbers = sum(bool(_NUMBER.fullmatch(f)) for f in fields)
    bare = numbers > 0.5 * len(fields)
    if rule.header is not None:
        names = rule.header
        if len(names) != len(fields):
            raise LogError(f"{path}: [table] header names {len(names)} columns, line {first + 1} has {len(fields)}")
        return _unique(path, names), first if bare else first + 1
    if not bare:
        return _unique(path, fields), first + 1
    # some recorders write the header as a comment
    for line in reversed(lines[:first]):
        names = _fields(line.lstrip().lstrip("#%/").strip(), separator)
        if len(names) == len(fields) and not any(_NUMBER.fullmatch(n) for n in names):
            return _unique(path, names), first
    raise LogError(
        f"{path}: no header: line {first + 1} holds numbers, and its {len(fields)} columns have no names; "
        'write the names into the first line, or give them in the mapping: [table] header = ["time", ..]'
    )


def _unique(path: Path, names: Sequence[str]) -> list[str]:
    twice = [name for name, count in Counter(names).items() if count > 1 and name]
    if twice:
        raise LogError(
            f"{path}: more than one column is called {', '.join(twice)}, and they may differ: keep one of each"
        )
    return [name or f"column {i + 1}" for i, name in enumerate(names)]


def _whole_rows(
    path: Path, body: list[tuple[int, str]], width: int, separator: str, ended: bool
) -> tuple[list[tuple[int, str]], tuple[str, ...]]:
    """Rows with a value for each column; a last one that the recorder did not finish is left out."""
    remarks: tuple[str, ...] = ()

    def count(line: str) -> int:
        if separator != " " and '"' not in line:
            return line.count(separator) + 1
        return len(_fields(line, separator))

    wrong = [(number, n) for number, line in body if (n := count(line)) != width]
    if wrong and not ended and wrong[-1][0] == body[-1][0] and wrong[-1][1] < width:
        remarks = (f"line {wrong[-1][0]}, the last, is incomplete and left out",)
        body, wrong = body[:-1], wrong[:-1]
    if wrong:
        shown = ", ".join(f"line {number} ({n})" for number, n in wrong[:5])
        more = f" and {len(wrong) - 5} more" if len(wrong) > 5 else ""
        raise LogError(
            f"{path}: {len(wrong)} of {len(body)} lines have another number of fields than the header "
            f"({width}): {shown}{more}; repair or delete these lines"
            + ("" if separator != " " else ", or say [table] separator in the mapping")
        )
    return body, remarks


def _decimal(body: Sequence[tuple[int, str]], separator: str) -> str:
    if separator == ",":
        return "."
    fields = [f for _, line in body[:50] for f in _fields(line, separator)]
    return "," if any(_DECIMAL_COMMA.fullmatch(f) for f in fields) else "."


def _columns(
    path: Path, names: list[str], body: list[tuple[int, str]], separator: str, decimal: str, rule: TableRule
) -> Table:
    import pandas as pd

    if not body:
        return Table({name: np.empty(0) for name in names})
    try:
        frame = pd.read_csv(
            io.StringIO("\n".join(line for _, line in body)),
            sep=r"\s+" if separator == " " else separator,
            header=None,
            names=names,
            index_col=False,
            skipinitialspace=True,
            decimal=decimal,
            keep_default_na=False,
            na_values=[*MISSING, *rule.missing],
            low_memory=False,
        )
    except (ValueError, csv.Error) as error:
        raise LogError(f"{path}: not a table: {' '.join(str(error).split())}") from error
    columns: dict[str, np.ndarray[Any, Any]] = {}
    odd: dict[str, str] = {}
    for name in names:
        column = frame[name]
        if pd.api.types.is_numeric_dtype(column):
            columns[name] = column.to_numpy()
            continue
        columns[name] = np.array([None if m else v for v, m in zip(column, column.isna(), strict=True)], object)
        bad = np.flatnonzero((pd.to_numeric(column, errors="coerce").isna() & column.notna()).to_numpy())
        where = ", ".join(f"{columns[name][i]!r} in line {body[i][0]}" for i in bad[:3])
        noun = "value is not a number" if len(bad) == 1 else "values are not numbers"
        odd[name] = f"{len(bad)} {noun} ({where}{', ...' if len(bad) > 3 else ''})"
    return Table(columns, odd)


# --- Parquet ------------------------------------------------------------------------------------------------


def _read_parquet(path: Path) -> Table:
    import pyarrow.parquet as pq

    log, problems = load(path)
    stopping = [p for p in problems if p.code.startswith("file.") or p.code == "column.duplicate"]
    if stopping:
        raise LogError(explain(path, stopping))
    with pq.ParquetFile(path) as file:
        table = file.read()
    columns: dict[str, np.ndarray[Any, Any]] = {}
    odd: dict[str, str] = {}
    for name, column in zip(table.column_names, table.columns, strict=True):
        columns[name] = _array(column)
        if columns[name].dtype == object:
            odd[name] = f"the column holds {column.type}, not numbers"
    own = b"sysid_btr" in (table.schema.metadata or {})
    return Table(columns, odd, log.meta if own and log is not None else None)


def _array(column: pa.ChunkedArray) -> np.ndarray[Any, Any]:
    """A column as numpy has it: numbers, booleans and dates as such (NaN where missing), the rest as objects."""
    import pyarrow as pa
    from pyarrow import types

    kind = column.type
    dates = types.is_timestamp(kind) or types.is_duration(kind)
    if dates or (types.is_boolean(kind) and column.null_count == 0):
        return np.array(column.to_numpy())
    if types.is_boolean(kind):
        column = column.cast(pa.int8())
    if types.is_decimal(kind) or types.is_null(kind):
        column = column.cast(pa.float64())
    if types.is_integer(column.type) or types.is_floating(column.type):
        return np.array(column.to_numpy())
    objects = np.empty(len(column), dtype=object)
    objects[:] = column.to_pylist()
    return objects


# --- time ---------------------------------------------------------------------------------------------------


def as_seconds(table: Table, name: str, unit: str | float | None) -> tuple[FloatArray, tuple[str, ...]]:
    """A column of stamps in seconds.

    Parameters
    ----------
    table : of the file.
    name : column.
    unit : as told by the user or by the column's name; None if nothing is known. Then the typical interval
        decides: whole seconds between samples of a robot's joints are no seconds.

    Returns
    -------
    time : ndarray, shape (n,), s.
    remarks : how the unit was found, where nobody said it.

    Raises
    ------
    LogError
        If the column holds neither numbers nor dates.
    """
    values = table.columns[name]
    if values.dtype.kind in "mM":
        zero = np.array(0, dtype=values.dtype)
        return (values - zero) / np.timedelta64(1, "s"), ()
    if values.dtype == object:
        dates = _dates(values)
        if dates is None:
            what = table.odd.get(name, "its values are not numbers")
            raise LogError(
                f"the time in column {name!r} cannot be read: {what}; "
                "repair these lines, or name another column by [time] column in the mapping"
            )
        return dates, (f"time: column {name!r} holds dates; taken as UTC",)
    values = values.astype(np.float64)
    if isinstance(unit, str):
        return next(u for u in find(unit) if u.si == "s").convert(values), ()
    if unit is not None:
        return values * float(unit), ()
    steps = np.diff(values)
    steps = steps[np.isfinite(steps) & (steps > 0)]
    step = float(np.median(steps)) if len(steps) else np.nan
    said = f"time: column {name!r} advances by {step:g} a row, so it is taken as"
    for known, factor, least, below in CLOCKS:
        if least <= step < below:
            return Unit("s", factor).convert(values), (f"{said} {known} (--unit time=UNIT says otherwise)",)
    return values, (f"{said} s (--unit time=UNIT says otherwise)",) if step >= SLOW else ()


def _dates(values: np.ndarray[Any, Any]) -> FloatArray | None:
    import pandas as pd

    if not all(isinstance(v, str) and _DAYS.match(v) for v in values[:3]):
        return None
    try:
        stamps = pd.to_datetime(pd.Series(values), utc=True, format="ISO8601")
    except ValueError:
        return None
    seconds = (stamps - pd.Timestamp(0, tz="UTC")) / pd.Timedelta(seconds=1)
    return np.asarray(seconds.to_numpy(), dtype=np.float64)
