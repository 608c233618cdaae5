"""JSON and TOML of others: whatever is wrong with a text is a `ValueError`."""

from __future__ import annotations

import json
import tomllib
from typing import Any


def parse_json(text: str | bytes, **options: Any) -> Any:
    """The content of a JSON text; `options` are those of `json.loads`.

    Raises
    ------
    ValueError
        If it is not JSON, or nested so deeply that nobody meant it, or a whole number in it is beyond any that can be
        computed with.
    """
    try:
        return json.loads(text, **{"parse_int": _whole, **options})
    except RecursionError:
        raise ValueError("it is nested too deeply") from None


def _whole(digits: str) -> int:
    value = int(digits)
    try:
        float(value)
    except OverflowError:
        raise ValueError(f"it holds a whole number of {len(digits)} digits") from None
    return value


def parse_toml(content: bytes) -> dict[str, Any]:
    """The content of a TOML file.

    Raises
    ------
    ValueError
        If it is not TOML in UTF-8, or nested so deeply that nobody meant it.
    """
    try:
        return tomllib.loads(content.decode("utf-8"))
    except RecursionError:
        raise ValueError("it is nested too deeply") from None
