"""The checks that every importer must pass."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np

from sysid_btr.errors import SysidError
from sysid_btr.io.importers.base import Importer, Recording
from sysid_btr.io.importers.mapping import ImportMap
from sysid_btr.io.importers.table import first_bytes
from sysid_btr.io.importers.units import group_of, resolve
from sysid_btr.io.log import is_schema_column
from sysid_btr.testing.require import require

_STRANGERS: tuple[bytes, ...] = (
    b"",
    b"\x89PNG\r\n\x1a\n" + bytes(range(256)) * 8,
    b"%PDF-1.7\n%\xe2\xe3\xcf\xd3\n" + bytes(range(256)) * 8,
)
"""First bytes of files that are no recording."""
_CUTS = (0.9, 0.5, 0.001)
"""Fractions of a source that is cut short; the last leaves hardly a header."""


def check_importer(importer: Importer, source: Path, told: ImportMap | None = None) -> None:
    """Check every promise of `sysid_btr.io.importers.base.Importer` on a source of its format.

    Parameters
    ----------
    importer : the one to check.
    source : a file or folder of its format, whole and well formed.
    told : what a user has to say about it; nothing if None.

    Raises
    ------
    AssertionError
        Naming the promise that is broken.
    """
    for check in IMPORTER_CHECKS:
        check(importer, source, ImportMap() if told is None else told)


def check_recognition(importer: Importer, source: Path, told: ImportMap) -> None:
    """The source is recognised by content whatever it is called, and what is no recording is not."""
    with tempfile.TemporaryDirectory() as folder:
        copy = _copied(source, Path(folder) / "renamed")
        require(importer.recognises(copy, first_bytes(copy)), f"{importer.name}: does not recognise {source.name}")
        for i, content in enumerate(_STRANGERS):
            stranger = Path(folder) / f"stranger{i}{source.suffix}"
            stranger.write_bytes(content)
            taken = importer.recognises(stranger, content)
            require(not taken, f"{importer.name}: takes for its own a file that begins with {content[:12]!r}")
        empty = Path(folder) / "empty"
        empty.mkdir()
        require(not importer.recognises(empty, b""), f"{importer.name}: takes an empty folder for its own")


def check_recording(importer: Importer, source: Path, told: ImportMap) -> None:
    """What is read is a recording: columns of the schema and of one length, units that exist, nothing twice."""
    recording, name = importer.read(source, told), importer.name
    n = len(recording.time)
    require(recording.path == source, f"{name}: the recording's path is not that of the source")
    require(recording.time.shape == (n,) and n > 0, f"{name}: time must be (n,), with a sample at least")
    require(bool(recording.signals), f"{name}: nothing was understood, and this was not an error")
    columns = [signal.column for signal in recording.signals]
    require(len(set(columns)) == len(columns), f"{name}: a column stands twice")
    for signal in recording.signals:
        where = f"{name}: {signal.source}"
        require(is_schema_column(signal.column), f"{where}: {signal.column!r} is not a column of the schema")
        require(np.shape(signal.values) == (n,), f"{where}: values must be ({n},)")
        if signal.unit is not None:
            _known_unit(where, signal.unit, signal.column)
    for key, values in recording.foreign.items():
        require(len(values) == n, f"{name}: foreign column {key!r} is not of the recording's length")
        require(key not in columns, f"{name}: foreign column {key!r} takes a signal's place")
    if recording.episode is not None:
        require(recording.episode.shape == (n,), f"{name}: episode must be ({n},)")
    require(all(isinstance(r, str) and r for r in recording.remarks), f"{name}: a remark is a sentence")


def check_same_again(importer: Importer, source: Path, told: ImportMap) -> None:
    """Reading twice gives the same, and leaves the source as it was."""
    before = _content(source)
    first, second = importer.read(source, told), importer.read(source, told)
    require(_content(source) == before, f"{importer.name}: reading changed the source")
    require(_equal(first, second), f"{importer.name}: reading twice gives different recordings")


def check_cut_short(importer: Importer, source: Path, told: ImportMap) -> None:
    """A source that was cut short is a `SysidError`, or a shorter recording; never an empty one, or another error."""
    whole = len(importer.read(source, told).time)
    for fraction in _CUTS:
        with tempfile.TemporaryDirectory() as folder:
            copy = _copied(source, Path(folder) / source.name)
            largest = max((p for p in (copy, *copy.rglob("*")) if p.is_file()), key=lambda p: p.stat().st_size)
            largest.write_bytes(largest.read_bytes()[: int(fraction * largest.stat().st_size)])
            try:
                left = len(importer.read(copy, told).time)
            except SysidError:
                continue
            require(0 < left <= whole, f"{importer.name}: cut to {fraction:.1%}, a source gives {left} samples")


IMPORTER_CHECKS: tuple[Callable[[Importer, Path, ImportMap], None], ...] = (
    check_recognition,
    check_recording,
    check_same_again,
    check_cut_short,
)
"""What `check_importer` runs; usable one by one."""


def _known_unit(where: str, unit: str, column: str) -> None:
    try:
        resolve(unit, group_of(column))
    except SysidError as error:
        raise AssertionError(f"{where}: {error}") from error


def _copied(source: Path, target: Path) -> Path:
    if source.is_dir():
        return Path(shutil.copytree(source, target))
    return Path(shutil.copyfile(source, target))


def _content(source: Path) -> dict[str, bytes]:
    return {str(p): p.read_bytes() for p in (source, *sorted(source.rglob("*"))) if p.is_file()}


def _equal(a: Recording, b: Recording) -> bool:
    pairs = zip(a.signals, b.signals, strict=False)
    return (
        len(a.signals) == len(b.signals)
        and np.array_equal(a.time, b.time)
        and all(p.column == q.column and np.array_equal(p.values, q.values, equal_nan=True) for p, q in pairs)
        and list(a.foreign) == list(b.foreign)
        and (a.meta, a.remarks) == (b.meta, b.remarks)
    )
