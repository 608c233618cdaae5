"""Packages that only some verbs need."""

from __future__ import annotations

from importlib import import_module
from typing import Any

from sysid_btr.errors import UsageError


def optional(module: str, extra: str, purpose: str) -> Any:
    """A module of an optional dependency.

    Raises
    ------
    UsageError
        It is not installed; the message names the extra that brings it.
    """
    try:
        return import_module(module)
    except ModuleNotFoundError as error:
        if error.name is None or error.name.partition(".")[0] != module.partition(".")[0]:
            raise
        raise UsageError(
            f"{purpose} needs the package {error.name!r}, which is not installed: pip install 'sysid-btr[{extra}]'"
        ) from None
