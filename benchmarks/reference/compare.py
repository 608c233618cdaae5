"""Numbers of a result, by the path at which they stand, and where two results differ."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

NOT_COMPARED = frozenset({"wall_s", "seconds", "versions", "logs", "model", "message", "warnings", "pictures"})
"""Times, places of files, and sentences."""
NAMES = frozenset({"name", "effect", "verdict", "kind", "variant", "identifiable", "mode", "added", "removed", "where"})
"""Words that are results too."""


def numbers(content: Any, path: str = "", key: str = "") -> Iterator[tuple[str, Any]]:
    """(path, value) of every number, truth value and named choice."""
    if isinstance(content, dict):
        for name, value in content.items():
            if name not in NOT_COMPARED:
                yield from numbers(value, f"{path}/{name}", name)
    elif isinstance(content, list):
        for i, value in enumerate(content):
            yield from numbers(value, f"{path}/{i}", key)
    elif content is None or isinstance(content, bool | int | float) or key in NAMES:
        yield path, content


def differences(was: Any, now: Any) -> list[str]:
    """One line a number that is not the same to the last digit, or that only one side has."""
    old, new = dict(numbers(was)), dict(numbers(now))
    lines = [f"{path}: was {old[path]!r}, gone" for path in old if path not in new]
    lines += [f"{path}: new, {new[path]!r}" for path in new if path not in old]
    lines += [
        f"{path}: {value!r} -> {new[path]!r}" for path, value in old.items() if path in new and new[path] != value
    ]
    return lines
