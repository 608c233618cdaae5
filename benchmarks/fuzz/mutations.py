"""Ways to break a file, by its number: as bytes, as words and numbers, as JSON, as a table."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Sequence
from io import BytesIO
from typing import Any
from zlib import crc32

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.random import Generator

WORDS = (
    *("nan", "inf", "-inf", "-1", "0", "1e308", "1e999", "-1e-300", "1" + 400 * "0", "0x1F", "1,5", "--", ""),
    *(
        "\x00",
        "\x1b[31m",
        "\u202e",
        "\U0001f916",
        "'; DROP",
        "../../../../etc/passwd",
        "{",
        "]",
        '"',
        "\\",
        "%s",
        "${HOME}",
    ),
    *("true", "null", "*", "?", "[", "a" * 5000, "\n\n\n", "é", "keyframe:x", "1 2 3", "free", "linear", "1970-01-01"),
)
VALUES: tuple[Any, ...] = (
    *(None, True, False, 0, -1, 1, 2**63, 10**400, 1e308, -1e308, 1e-320, 0.5, "", "x", "nan", "free", "[", "a" * 3000),
    *([], {}, [[]], [None], [1], ["x"], {"": None}, {"a": {"b": []}}, [1e300, -1e300], ["../x.png"], "deg"),
)
NAMES = ("time", "episode", "position.x", "command.", ".", "imu.gyro_x", "enabled.pendulum", "effort.pendulum")
DEEP = 50_000
NUMBER = re.compile(rb"-?\d+(\.\d+)?([eE][-+]?\d+)?")
WORD = re.compile(rb"[A-Za-z_]{2,}")


def broken(name: str, content: bytes, rng: Generator) -> bytes:
    """A file broken in one to three ways."""
    for _ in range(int(rng.choice([1, 1, 1, 2, 3]))):
        ways: list[Callable[[bytes, Generator], bytes]] = [*BYTES]
        if not name.endswith((".parquet", ".mcap", ".db3")):
            ways += [*3 * [_hostile_number, _hostile_word], _twice, _gone, _deep]
        if name.endswith((".json", ".jsonl")):
            ways += 4 * [_journal if name.endswith("l") else _tree]
        if name.endswith(".parquet"):
            ways += [*24 * [_table], *8 * [_metadata]]
        content = ways[int(rng.integers(len(ways)))](content, rng)
    return content


# --- bytes ----------------------------------------------------------------------------------------------------


def _flip(content: bytes, rng: Generator) -> bytes:
    data = bytearray(content)
    for _ in range(int(rng.integers(1, 9)) if data else 0):
        data[int(rng.integers(len(data)))] = int(rng.integers(256))
    return bytes(data)


def _cut(content: bytes, rng: Generator) -> bytes:
    return content[: int(rng.integers(len(content) + 1))]


def _without(content: bytes, rng: Generator) -> bytes:
    first, last = sorted(int(rng.integers(len(content) + 1)) for _ in range(2))
    return content[:first] + content[min(last, first + 200) :]


def _inserted(content: bytes, rng: Generator) -> bytes:
    at = int(rng.integers(len(content) + 1))
    return content[:at] + _word(rng) + content[at:]


BYTES: tuple[Callable[[bytes, Generator], bytes], ...] = (_flip, _cut, _without, _inserted)


# --- text -----------------------------------------------------------------------------------------------------


def _word(rng: Generator) -> bytes:
    return WORDS[int(rng.integers(len(WORDS)))].encode()


def _replaced(pattern: re.Pattern[bytes], content: bytes, rng: Generator) -> bytes:
    found = list(pattern.finditer(content))
    if not found:
        return content
    one = found[int(rng.integers(len(found)))]
    return content[: one.start()] + _word(rng) + content[one.end() :]


def _hostile_number(content: bytes, rng: Generator) -> bytes:
    return _replaced(NUMBER, content, rng)


def _hostile_word(content: bytes, rng: Generator) -> bytes:
    return _replaced(WORD, content, rng)


def _lines(content: bytes, rng: Generator) -> tuple[list[bytes], int]:
    lines = content.split(b"\n")
    return lines, int(rng.integers(len(lines)))


def _twice(content: bytes, rng: Generator) -> bytes:
    lines, at = _lines(content, rng)
    return b"\n".join([*lines[: at + 1], *lines[at:]])


def _gone(content: bytes, rng: Generator) -> bytes:
    lines, at = _lines(content, rng)
    return b"\n".join([*lines[:at], *lines[at + 1 :]])


def _deep(content: bytes, rng: Generator) -> bytes:
    at = int(rng.integers(len(content) + 1))
    return content[:at] + (b"[", b"{", b'{"a":', b"<a>")[int(rng.integers(4))] * DEEP + content[at:]


# --- JSON -----------------------------------------------------------------------------------------------------


def _value(rng: Generator) -> Any:
    return VALUES[int(rng.integers(len(VALUES)))]


def _changed(content: Any, rng: Generator) -> Any:
    """A tree with one of its nodes replaced, removed or renamed."""
    if not isinstance(content, dict | list) or not content or rng.random() < 0.15:
        return _value(rng)
    keys: Sequence[Any] = list(content) if isinstance(content, dict) else range(len(content))
    key = keys[int(rng.integers(len(keys)))]
    copy: Any = dict(content) if isinstance(content, dict) else list(content)
    way = rng.random()
    if way < 0.15:
        del copy[key]
    elif way < 0.25 and isinstance(copy, dict):
        copy[WORDS[int(rng.integers(len(WORDS)))]] = copy.pop(key)
    else:
        copy[key] = _changed(copy[key], rng)
    return copy


def _tree(content: bytes, rng: Generator) -> bytes:
    try:
        return json.dumps(_changed(json.loads(content), rng)).encode()
    except (ValueError, RecursionError):
        return content


def _journal(content: bytes, rng: Generator) -> bytes:
    """A record changed under the right checksum."""
    lines, at = _lines(content, rng)
    text, _, _ = lines[at].rpartition(b" ")
    changed = _tree(text, rng)
    lines[at] = b"%s %08x" % (changed, crc32(changed))
    return b"\n".join(lines)


# --- tables ---------------------------------------------------------------------------------------------------


def _read(content: bytes) -> pa.Table | None:
    try:
        return pq.read_table(BytesIO(content))
    except (OSError, ValueError, NotImplementedError):
        return None


def _written(table: pa.Table, content: bytes) -> bytes:
    sink = BytesIO()
    try:
        pq.write_table(table, sink)
    except (OSError, ValueError, NotImplementedError):
        return content
    return sink.getvalue()


def _metadata(content: bytes, rng: Generator) -> bytes:
    table = _read(content)
    if table is None:
        return content
    own = (table.schema.metadata or {}).get(b"sysid_btr", b"{}")
    return _written(table.replace_schema_metadata({"sysid_btr": _tree(own, rng)}), content)


def _table(content: bytes, rng: Generator) -> bytes:
    table = _read(content)
    if table is None or not table.num_columns:
        return content
    at = int(rng.integers(table.num_columns))
    way = COLUMNS[int(rng.integers(len(COLUMNS)))]
    try:
        return _written(way(table, at, rng), content)
    except (OSError, ValueError, NotImplementedError, TypeError, OverflowError):
        return content


def _set(table: pa.Table, at: int, values: Any) -> pa.Table:
    return table.set_column(at, table.column_names[at], values if isinstance(values, pa.Array) else pa.array(values))


def _numbers(table: pa.Table, at: int) -> Any:
    return np.array(table.column(at).to_numpy(), dtype=np.float64)


def _spoilt(table: pa.Table, at: int, rng: Generator) -> pa.Table:
    """Some values, or all of them, are something else."""
    values = _numbers(table, at)
    which = rng.random(len(values)) < rng.choice([0.01, 0.3, 1.0])
    values[which] = rng.choice([np.nan, np.inf, -np.inf, 0.0, 1e308, -1e308, 1e-320, 1e12, 5.0])
    return _set(table, at, values)


def _noise(table: pa.Table, at: int, rng: Generator) -> pa.Table:
    values = _numbers(table, at)
    noise = rng.choice([1e-6, 0.1, 10.0]) * rng.normal(size=len(values))
    return _set(table, at, rng.choice([0.0, 1.0]) * values + noise)


def _scaled(table: pa.Table, at: int, rng: Generator) -> pa.Table:
    return _set(table, at, rng.choice([-1.0, 0.0, 57.3, 1e3, 1e-3, 1e9]) * _numbers(table, at))


def _whole(table: pa.Table, at: int, rng: Generator) -> pa.Table:
    return _set(table, at, np.round(_numbers(table, at) * rng.choice([1.0, 100.0, 4096.0])).astype(np.int64))


def _shuffled(table: pa.Table, at: int, rng: Generator) -> pa.Table:
    return _set(table, at, rng.permutation(_numbers(table, at)))


def _typed(table: pa.Table, at: int, rng: Generator) -> pa.Table:
    kinds = [pa.string(), pa.int8(), pa.bool_(), pa.float32(), pa.timestamp("ns"), pa.decimal128(20, 5), pa.float16()]
    kinds += [pa.dictionary(pa.int32(), pa.float64()), pa.list_(pa.float64()), pa.null(), pa.binary(), pa.uint64()]
    kind, column = kinds[int(rng.integers(len(kinds)))], table.column(at)
    if pa.types.is_list(kind):
        return _set(table, at, pa.array([[x] for x in column.to_pylist()]))
    if pa.types.is_null(kind):
        return _set(table, at, pa.nulls(table.num_rows))
    if pa.types.is_binary(kind):
        return _set(table, at, pa.array([b"\xff"] * table.num_rows))
    return _set(table, at, pa.array(column.to_pylist()).cast(kind, safe=False))


def _renamed(table: pa.Table, at: int, rng: Generator) -> pa.Table:
    names = [*table.column_names]
    names[at] = str(rng.choice(NAMES)) if rng.random() < 0.6 else _word(rng).decode()
    return table.rename_columns(names)


def _dropped(table: pa.Table, at: int, rng: Generator) -> pa.Table:
    return table.remove_column(at)


def _doubled(table: pa.Table, at: int, rng: Generator) -> pa.Table:
    return table.append_column(table.column_names[at], table.column(at))


def _few(table: pa.Table, at: int, rng: Generator) -> pa.Table:
    return table.slice(0, int(rng.choice([0, 1, 2, 3, 5, 31])))


def _episodes(table: pa.Table, at: int, rng: Generator) -> pa.Table:
    n = table.num_rows
    numbers = [np.arange(n), np.arange(n) // 75, np.full(n, 1e300), np.full(n, np.nan), np.arange(n) / 3]
    return table.append_column("episode", pa.array(numbers[int(rng.integers(len(numbers)))]))


COLUMNS: tuple[Callable[[pa.Table, int, Generator], pa.Table], ...] = (
    *(_spoilt, _noise, _scaled, _whole, _shuffled, _typed, _renamed, _dropped, _doubled, _few, _episodes),
)
