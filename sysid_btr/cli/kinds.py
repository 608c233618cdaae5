"""What an option can hold: how it is given at the command line, how in a study file, and what a verb gets."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from sysid_btr.errors import UsageError

Names = Annotated[tuple[str, ...], "may hold several, with commas"]
Numbers = Mapping[str, float]
Ranges = Mapping[str, tuple[float, float]]
Texts = Mapping[str, str]
Holdout = float | tuple[Path, ...]
"""The last fraction of each log, or logs of their own."""


@dataclass(frozen=True)
class Kind:
    """How the values of one type are written.

    Attributes
    ----------
    typed : type at the command line.
    expected : what a study file may hold, in words.
    allowed : whether a study file may hold this value; for a table, this entry of it.
    given : what is equivalent at the command line to a value, of a study file or a default.
    value : what a verb gets, from the flag and what it was given.
    table : whether a study file has a table of named entries.
    """

    typed: Any
    expected: str
    allowed: Callable[[Any], bool]
    given: Callable[[Any], Any] = lambda value: value
    value: Callable[[str, Any], Any] = lambda _, given: given
    table: bool = False

    def wrong(self, value: Any) -> list[str]:
        """Where in a study file's value something is that may not be there: ``""`` for itself, or names of entries."""
        if not self.table:
            return [] if self.allowed(value) else [""]
        if not isinstance(value, dict):
            return [""]
        return [f".{name}" for name, entry in value.items() if not self.allowed(entry)]


def number(text: str) -> float | None:
    """A finite number, or None."""
    try:
        value = float(text)
    except ValueError:
        return None
    return value if math.isfinite(value) else None


# --- from the command line ----------------------------------------------------------------------------------


def _table(flag: str, given: list[str], expected: str, read: Callable[[str], Any]) -> dict[str, Any]:
    """``NAME=...`` texts as a table; of a name that is given twice the last counts, and comes last."""
    table: dict[str, Any] = {}
    problems = []
    for text in given:
        name, _, right = text.rpartition("=")
        value = read(right) if name else None
        if value is None:
            problems.append(f"{flag} {text}: expected {expected}")
        else:
            table.pop(name, None)
            table[name] = value
    if problems:
        raise UsageError("\n".join(problems))
    return table


def _numbers(flag: str, given: list[str]) -> Numbers:
    return _table(flag, given, "NAME=NUMBER", number)


def _range(text: str) -> tuple[float, float] | None:
    low, _, high = text.partition(":")
    lower, upper = number(low), number(high)
    return None if lower is None or upper is None or not lower < upper else (lower, upper)


def _ranges(flag: str, given: list[str]) -> Ranges:
    return _table(flag, given, "NAME=LOW:HIGH with LOW < HIGH", _range)


def _texts(flag: str, given: list[str]) -> Texts:
    table = {}
    problems = []
    for text in given:
        left, _, right = text.partition("=")
        if left and right:
            table[left] = right
        else:
            problems.append(f"{flag} {text}: expected A=B")
    if problems:
        raise UsageError("\n".join(problems))
    return table


def _names(_flag: str, given: list[str]) -> tuple[str, ...]:
    return tuple(name for text in given for name in text.split(",") if name)


def _holdout(flag: str, given: list[str]) -> Holdout:
    numbers = [number(text) for text in given]
    if len(given) == 1 and numbers[0] is not None:
        return numbers[0]
    if any(n is not None for n in numbers):
        raise UsageError(f"{flag} takes one fraction or log files, not both: {', '.join(given)}")
    return tuple(map(Path, given))


def _tuple(_flag: str, given: list[Any]) -> tuple[Any, ...]:
    return tuple(given)


# --- from a study file --------------------------------------------------------------------------------------


def _is_number(value: Any) -> bool:
    if isinstance(value, bool) or not isinstance(value, int | float):
        return False
    return abs(value) <= sys.float_info.max


def _is_text(value: Any) -> bool:
    return isinstance(value, str) and "\0" not in value


def _is_list(value: Any) -> bool:
    return _is_text(value) or (isinstance(value, list) and all(map(_is_text, value)))


def _is_range(value: Any) -> bool:
    return isinstance(value, list) and len(value) == 2 and all(map(_is_number, value))


def _list(value: Any) -> list[str]:
    return [str(v) for v in value] if isinstance(value, list | tuple) else [str(value)]


TEXT = Kind(str, "text", _is_text)
MOST = 2**63
WHOLE = Kind(int, "a whole number", lambda v: _is_number(v) and isinstance(v, int) and abs(v) < MOST)
NUMBER = Kind(float, "a number", _is_number)
FILE = Kind(Path, "text", _is_text)
KINDS: dict[Any, Kind] = {
    str: TEXT,
    str | None: TEXT,
    int: WHOLE,
    int | None: WHOLE,
    float: NUMBER,
    float | None: NUMBER,
    bool: Kind(bool, "true or false", lambda v: isinstance(v, bool)),
    Path: FILE,
    Path | None: FILE,
    tuple[str, ...]: Kind(list[str], "text or a list of texts", _is_list, _list, _tuple),
    tuple[Path, ...]: Kind(list[Path], "text or a list of texts", _is_list, _list, _tuple),
    Names: Kind(list[str], "text or a list of texts", _is_list, _list, _names),
    Numbers: Kind(
        list[str],
        "a table of name = number",
        _is_number,
        lambda table: [f"{name}={float(value)!r}" for name, value in table.items()],
        _numbers,
        table=True,
    ),
    Ranges: Kind(
        list[str],
        "a table of name = [low, high]",
        _is_range,
        lambda table: [f"{name}={float(low)!r}:{float(high)!r}" for name, (low, high) in table.items()],
        _ranges,
        table=True,
    ),
    Texts: Kind(
        list[str],
        "a table of name = text",
        _is_text,
        lambda table: [f"{name}={text}" for name, text in table.items()],
        _texts,
        table=True,
    ),
    Holdout: Kind(
        list[str], "a fraction, a file or a list of files", lambda v: _is_number(v) or _is_list(v), _list, _holdout
    ),
}
"""By the type of an option."""
