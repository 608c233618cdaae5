"""The record of every finished evaluation, from which a seeded estimator resumes bit-identically.

An estimator is deterministic given its generator and what its evaluations returned. So resuming needs no
estimator state: the estimator runs again from the beginning, and the journal answers the evaluations that
were finished before. Each record holds the candidates themselves, compared bit by bit when replayed.
"""

from __future__ import annotations

import errno
import json
import os
import re
import time
from collections.abc import Mapping
from copy import copy
from dataclasses import dataclass, field, replace
from pathlib import Path
from tokenize import TokenError
from zlib import crc32

import numpy as np

from sysid_btr._typing import FloatArray
from sysid_btr.errors import UsageError
from sysid_btr.reading import parse_json

SCHEMA = "sysid_btr.journal/2"
_SYNC_PERIOD = 1.0  # s; a power cut loses at most the evaluations of this time


@dataclass(frozen=True, eq=False)
class Record:
    """One finished evaluation of a batch.

    Attributes
    ----------
    kind
        What was asked of the candidates; a replay must ask the same.
    candidates
        Shape ``(m, p)``.
    arrays
        What the estimator needs to know of the outcome; ``loss``, shape ``(m,)``, always.
    seconds
        Wall time spent on the fit up to this record.
    attached
        CRC-32 of the attachment that came with it; None without one.
    """

    kind: str
    candidates: FloatArray
    arrays: Mapping[str, FloatArray]
    seconds: float
    attached: int | None = None

    def to_line(self) -> bytes:
        """One line of JSON and its CRC-32; floats as the shortest text that reads back to the same bits."""
        content = {
            "kind": self.kind,
            "seconds": self.seconds,
            "candidates": self.candidates.tolist(),
            "arrays": {name: values.tolist() for name, values in self.arrays.items()},
            "attached": self.attached,
        }
        text = json.dumps(content).encode()
        return b"%s %08x\n" % (text, crc32(text))

    @classmethod
    def from_line(cls, line: bytes) -> Record:
        """Read a line; raises ValueError, KeyError or TypeError if it is damaged."""
        text, _, checksum = line.rpartition(b" ")
        if crc32(text) != int(checksum, 16):
            raise ValueError("the checksum is that of another text")
        content = parse_json(text)
        if len(content["arrays"]["loss"]) != len(content["candidates"]):
            raise ValueError("every candidate has a loss")
        return cls(
            kind=str(content["kind"]),
            candidates=_numbers(content["candidates"]),
            arrays={name: _numbers(v) for name, v in content["arrays"].items()},
            seconds=float(content["seconds"]),
            attached=content["attached"],
        )


def _numbers(values: object) -> FloatArray:
    """An array of numbers alone: numpy would take null for one."""
    found = np.array(values)
    if found.dtype.kind not in "fi":
        raise ValueError("what should be numbers is not")
    return found.astype(np.float64)


@dataclass
class _Tape:
    """What a journal and its sections share: the records, where replay stands, the latest attachment."""

    records: list[Record] = field(default_factory=list)
    cursor: int = 0
    attachment: tuple[int, FloatArray] | None = None
    last_sync: float = -np.inf


class Journal:
    """Append-only record of evaluations, in memory or in a JSON-lines file.

    Beside the records it keeps the latest *attachment* of each search: one array too large for text (a Jacobian), in
    ``<path>.<record number>.npy``, replaced when a later record of the search brings its own.

    Parameters
    ----------
    path
        File to append to, created with its first record; None keeps the journal in memory.
    fingerprint
        Identifies problem, estimator settings and seed. A file with another fingerprint is refused.

    Raises
    ------
    UsageError
        The file is not a journal, belongs to another fit, or is damaged elsewhere than in its last record (a
        last record cut short by a crash is dropped).
    """

    def __init__(self, path: str | os.PathLike[str] | None = None, *, fingerprint: str = "") -> None:
        self.path = None if path is None else Path(path)
        self.fingerprint = fingerprint
        self._tape = _Tape()
        self._origin = 0
        if self.path is not None and self.path.exists():
            self._load(self.path)

    def __len__(self) -> int:
        return len(self._tape.records)

    @property
    def records(self) -> tuple[Record, ...]:
        """All finished evaluations, in order."""
        return tuple(self._tape.records)

    @property
    def evaluations(self) -> int:
        """Candidates recorded."""
        return sum(len(record.candidates) for record in self._tape.records)

    @property
    def seconds(self) -> float:
        """Wall time of the fit up to the last record."""
        return self._tape.records[-1].seconds if self._tape.records else 0.0

    def rewind(self) -> None:
        """Replay from the first record on; a fit begins with this."""
        self._tape.cursor = self._origin

    def section(self) -> Journal:
        """The same journal for a search that follows another: its first record is the next one of this.

        Records, position and file are shared, so one file holds, and resumes, several searches in a row.
        """
        rest = copy(self)
        rest._origin = self._tape.cursor
        return rest

    def replay(self, kind: str, candidates: FloatArray, *, whole: bool) -> Record | None:
        """The next record if one is left, else None.

        Unless `whole`, a record may hold fewer candidates than asked for (its batch was cut by a budget), or
        more (this run's budget cuts it): the common leading candidates must agree bit by bit.

        Raises
        ------
        UsageError
            The record is of other candidates: the journal was written with other settings.
        """
        if self._tape.cursor == len(self._tape.records):
            return None
        record = self._tape.records[self._tape.cursor]
        common = min(len(record.candidates), len(candidates))
        other_size = whole and len(record.candidates) != len(candidates)
        same = record.candidates[:common].tobytes() == candidates[:common].tobytes()
        if record.kind != kind or other_size or not same:
            raise UsageError(
                f"{self._label}: record {self._tape.cursor + 1} of {len(self._tape.records)} was made for other "
                "candidates than this fit asks for. The seed, the estimator's settings or a library version "
                "differ from the run that wrote it: resume with the same ones, or begin anew with another "
                "journal (--overwrite)"
            )
        self._tape.cursor += 1
        return record

    @property
    def position(self) -> int:
        """Number of records replayed or appended since the last rewind."""
        return self._tape.cursor

    def append(self, record: Record, attachment: FloatArray | None = None) -> None:
        """Add a finished evaluation. Only legal when nothing is left to replay.

        Raises
        ------
        UsageError
            It cannot be written.
        """
        if self._tape.cursor != len(self._tape.records):
            raise ValueError("a journal is appended to only after its last record was replayed")
        number = len(self._tape.records)
        try:
            if attachment is not None:
                # Written before its record: a record on disk never lacks its attachment.
                self._save_attachment(number, attachment)
                record = replace(record, attached=crc32(attachment.tobytes()))
            self._write(record.to_line(), sync=attachment is not None)
            if attachment is not None:
                self._drop_older_attachments(number)
        except OSError as error:
            raise UsageError(
                f"{self._label} cannot be written: {error.strerror or 'no space is left'}. Earlier work is kept in "
                "it: free some space or grant write permission, and continue with --resume"
            ) from error
        self._tape.records.append(record)
        self._tape.cursor = len(self._tape.records)

    def attachment(self, number: int) -> FloatArray:
        """The attachment of record `number` (from 0), which must be the latest of its search that has one.

        Raises
        ------
        UsageError
            Its file is missing or damaged.
        """
        if self._tape.attachment is not None and self._tape.attachment[0] == number:
            return self._tape.attachment[1]
        try:
            if self.path is None:
                raise FileNotFoundError("it was replaced by a later one")
            values: FloatArray = np.load(self._attachment_path(self.path, number), allow_pickle=False)
            if crc32(values.tobytes()) != self._tape.records[number].attached:
                raise ValueError("it is not what was written")
        # numpy parses the head of a file as Python
        except (OSError, EOFError, ValueError, SyntaxError, TokenError) as error:
            raise UsageError(
                f"{self._label}: the array that belongs to record {number + 1} cannot be read ({error}). "
                "Start over with another journal (--overwrite)"
            ) from None
        return values

    @property
    def _label(self) -> str:
        return "the journal in memory" if self.path is None else f"journal {self.path}"

    @staticmethod
    def _attachment_path(path: Path, number: int) -> Path:
        return path.with_name(f"{path.name}.{number}.npy")

    def _save_attachment(self, number: int, values: FloatArray) -> None:
        self._tape.attachment = (number, values)
        if self.path is None:
            return
        self.path.parent.mkdir(parents=True, exist_ok=True)
        target = self._attachment_path(self.path, number)
        partial = target.with_suffix(".part")
        try:
            with partial.open("wb") as file:
                np.save(file, values, allow_pickle=False)
                file.flush()
                os.fsync(file.fileno())
            partial.replace(target)
        finally:
            partial.unlink(missing_ok=True)

    def _drop_older_attachments(self, number: int) -> None:
        if self.path is None:
            return
        keep = self._attachment_path(self.path, number)
        own = re.compile(re.escape(self.path.name) + r"\.(\d+)\.npy")
        for old in self.path.parent.iterdir():
            found = own.fullmatch(old.name)
            if found and old != keep and int(found[1]) >= self._origin:
                old.unlink(missing_ok=True)

    def _write(self, line: bytes, *, sync: bool) -> None:
        if self.path is None:
            return
        self.path.parent.mkdir(parents=True, exist_ok=True)
        if not self.path.exists() or self.path.stat().st_size == 0:
            header = {"journal": SCHEMA, "fingerprint": self.fingerprint}
            line = json.dumps(header).encode() + b"\n" + line
        with self.path.open("ab", buffering=0) as file:
            if file.write(line) != len(line):  # a disk that fills up takes a part without an error
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            if sync or time.monotonic() - self._tape.last_sync >= _SYNC_PERIOD:
                os.fsync(file.fileno())
                self._tape.last_sync = time.monotonic()

    def _load(self, path: Path) -> None:
        data = path.read_bytes()
        lines = data.split(b"\n")
        whole, tail = lines[:-1], lines[-1]
        if not whole:  # not even the header was finished
            if data and not data.startswith(b'{"journal"'[: len(data)]):
                raise UsageError(f"{path} is not a journal of this program: give another path")
            self._truncate(path, 0)
            return
        self._check_header(path, whole[0])
        good = len(whole[0]) + 1
        for i, line in enumerate(whole[1:], start=2):
            try:
                self._tape.records.append(Record.from_line(line))
            except (ValueError, KeyError, TypeError, AttributeError):
                if i == len(whole) and not tail:
                    break  # the last record, cut short and closed by blocks the disk never wrote
                raise UsageError(
                    f"{path}, line {i}: damaged, and later records depend on it. "
                    "Restore the file, or start over with another journal (--overwrite)"
                ) from None
            good += len(line) + 1
        if good < len(data):
            self._truncate(path, good)

    def _check_header(self, path: Path, line: bytes) -> None:
        try:
            header = parse_json(line)
            schema, fingerprint = header["journal"], header["fingerprint"]
        except (ValueError, KeyError, TypeError):
            raise UsageError(f"{path} is not a journal of this program: give another path") from None
        if schema != SCHEMA:
            raise UsageError(f"{path} is a journal of schema {schema!r}; this version reads {SCHEMA!r}")
        if fingerprint != self.fingerprint:
            raise UsageError(
                f"journal {path} belongs to another fit (its fingerprint is {fingerprint!r}, this fit's is "
                f"{self.fingerprint!r}): resume with the model, logs, parameters, estimator and seed it "
                "was written with, or start over (--overwrite)"
            )

    @staticmethod
    def _truncate(path: Path, size: int) -> None:
        with path.open("r+b") as file:
            file.truncate(size)
