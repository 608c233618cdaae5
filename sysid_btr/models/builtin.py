"""Built-in robots by name."""

from __future__ import annotations

from collections.abc import Callable

from sysid_btr.models.robot import Robot


BUILTIN: dict[str, Callable[[], Robot]] = {}
