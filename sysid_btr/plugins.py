"""What other installed packages add, by entry points."""

from __future__ import annotations

from typing import Any

from sysid_btr.errors import UsageError


def installed(group: str) -> dict[str, Any]:
    """Entry points of a group, by name."""
    from importlib.metadata import entry_points

    return {entry.name: entry for entry in entry_points(group=group)}


def load_installed(group: str, name: str, kind: str) -> Any | None:
    """What the entry point `name` of a group stands for; None where there is none.

    Raises
    ------
    UsageError
        It is installed but cannot be loaded; `kind` says what it is.
    """
    entry = installed(group).get(name)
    if entry is None:
        return None
    try:
        return entry.load()
    except Exception as error:
        raise UsageError(f"{kind} {name!r} is installed ({entry.value}) but cannot be loaded: {error}") from error
