"""Packages that only some verbs need."""

from __future__ import annotations

from importlib import import_module
from importlib.util import find_spec
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
        raise _missing(error.name, extra, purpose) from None


def require(package: str, extra: str, purpose: str) -> None:
    """Refuse before any work what an optional dependency is needed for; nothing is imported yet.

    Raises
    ------
    UsageError
        It is not installed.
    """
    if find_spec(package) is None:
        raise _missing(package, extra, purpose)


def _missing(package: str, extra: str, purpose: str) -> UsageError:
    return UsageError(
        f"{purpose} needs the package {package!r}, which is not installed: pip install 'sysid-btr[{extra}]'"
    )
