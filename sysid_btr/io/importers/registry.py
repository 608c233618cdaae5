"""Importers by name or by what a source looks like, built in or installed by other packages."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

from sysid_btr.errors import LogError, UsageError
from sysid_btr.io._file import looks_like
from sysid_btr.io.importers.base import Importer
from sysid_btr.io.importers.generic import TableImporter
from sysid_btr.io.importers.lerobot import LeRobotImporter
from sysid_btr.io.importers.naoqi import NaoQiImporter
from sysid_btr.io.importers.plain_mcap import McapImporter
from sysid_btr.io.importers.ros2 import Ros2Importer
from sysid_btr.io.importers.table import first_bytes
from sysid_btr.plugins import installed, load_installed

ENTRY_POINTS = "sysid_btr.importers"
"""Entry-point group; each entry is a factory without arguments of an `Importer`."""

Factory = Callable[[], Importer]

BUILT_IN: Mapping[str, Factory] = {
    "naoqi": NaoQiImporter,
    "ros2": Ros2Importer,
    "mcap": McapImporter,
    "lerobot": LeRobotImporter,
    "csv": TableImporter,
}
"""By name; the most particular first, because the first that recognises a source takes it."""


def available() -> tuple[str, ...]:
    """Names of the importers installed."""
    return (*BUILT_IN, *sorted(set(installed(ENTRY_POINTS)) - set(BUILT_IN)))


def get_importer(name: str) -> Importer:
    """The importer called `name`.

    Raises
    ------
    UsageError
        No such importer, or one that cannot be loaded.
    """
    factory = BUILT_IN.get(name) or load_installed(ENTRY_POINTS, name, "format")
    if factory is None:
        from difflib import get_close_matches

        close = get_close_matches(name.lower(), available(), n=1, cutoff=0.5)
        hint = f" Did you mean {close[0]!r}?" if close else ""
        raise UsageError(f"unknown format {name!r}.{hint} Available: auto, {', '.join(available())}")
    return factory()


def recognise(path: Path) -> Importer:
    """The importer for a source, judged by its content. Installed importers are asked before those built in.

    Raises
    ------
    LogError
        If there is no such source, or no importer for it.
    """
    if not path.exists():
        raise LogError(f"{path}: no such file or folder; looked in {path.parent.resolve()}")
    head = first_bytes(path)
    for name in (*sorted(set(installed(ENTRY_POINTS)) - set(BUILT_IN)), *BUILT_IN):
        importer = get_importer(name)
        if importer.recognises(path, head):
            return importer
    raise LogError(f"{path}: {_unrecognised(path, head)}")


def _unrecognised(path: Path, head: bytes) -> str:
    if path.is_dir():
        inner = ", ".join(sorted(p.name for p in path.iterdir())[:8]) or "nothing"
        return (
            f"the folder is neither a ROS 2 bag nor a LeRobot dataset: it holds {inner}. "
            "Give the folder that holds metadata.yaml or meta/, or files"
        )
    if not head:
        return "the file has 0 bytes; record or copy it again"
    kind, remedy = looks_like(head)
    return f"it looks like {kind}, which no importer reads; {remedy}. Formats: {', '.join(available())}"
