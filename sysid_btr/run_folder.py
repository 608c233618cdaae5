"""The output folder of a run, and the files in it."""

from __future__ import annotations

import os
import secrets
import socket
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import IO, Any
from weakref import finalize

from sysid_btr.errors import UsageError

RESULT = "result.json"
OVERLAY = "overlay.png"
REPORT = "report.html"
EXPLORER, SERIES = "explore.html", "explore.json.gz"
JOURNAL = "journal.jsonl"
MODEL = "model.xml"
PARAMS = "params.json"
DRAWS = "posterior.nc"
LOCK = ".lock"


class Lock:
    """A folder held by this process, for as long as this object lives; the system frees it if the process dies."""

    def __init__(self, folder: Path, file: IO[str], made: bool) -> None:
        self._free = finalize(self, _free, folder / LOCK, file, made)

    @classmethod
    def take(cls, folder: Path, *, made: bool = False) -> Lock | None:
        """Hold a folder; None where the system has no such locks, or this process holds it already.

        Parameters
        ----------
        folder : that exists.
        made : whether it was made for this, so that it goes again where nothing was written to it.

        Raises
        ------
        UsageError
            If another process holds it; says which, and since when.
        """
        try:
            import fcntl
        except ImportError:
            return None
        file = (folder / LOCK).open("a+", encoding="utf-8")
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            file.seek(0)
            holder = file.read()
            file.close()
            if holder.startswith(_process()):
                return None
            raise UsageError(
                f"--out {folder} is in use by {holder or 'another process'}: wait until that has ended, or choose "
                "another folder"
            ) from None
        except OSError:  # a network folder without locks
            file.close()
            return None
        if not _is_there(folder / LOCK, file):  # its holder ended between the two calls above
            file.close()
            return cls.take(folder, made=made)
        file.truncate(0)
        file.write(f"{_process()} since {datetime.now():%Y-%m-%d %H:%M:%S}")
        file.flush()
        return cls(folder, file, made)


def _process() -> str:
    return f"process {os.getpid()} on {socket.gethostname()}"


def _is_there(path: Path, file: IO[str]) -> bool:
    try:
        return os.path.samestat(path.stat(), os.fstat(file.fileno()))
    except FileNotFoundError:
        return False


def _free(path: Path, file: IO[str], made: bool) -> None:
    path.unlink(missing_ok=True)
    file.close()
    if made:
        with suppress(OSError):  # it holds something
            path.parent.rmdir()


def relative(path: str | Path, folder: Path) -> str:
    """A path as seen from a folder, with slashes, so that both can be moved together; as it is on another drive."""
    try:
        return Path(os.path.relpath(Path(path).resolve(), folder.resolve())).as_posix()
    except ValueError:
        return str(path)


def make_relative(content: dict[str, Any], folder: Path) -> None:
    """Make the paths of logs and model in a result, or in params.json, relative to the folder it is written to."""
    for entry in _with_paths(content):
        if entry.get("path") is not None:
            entry["path"] = relative(entry["path"], folder)


def _with_paths(content: dict[str, Any]) -> Iterator[dict[str, Any]]:
    for name in ("logs", "walks", "episodes"):
        yield from content.get(name, ())
    if "model" in content:
        yield content["model"]


@dataclass(frozen=True)
class Folder:
    """The output folder of a run; its files appear complete or not at all.

    Attributes
    ----------
    path : where it is.
    lock : what keeps other processes from writing there, if it was opened by `open_folder`.
    """

    path: Path
    lock: Lock | None = field(default=None, compare=False, repr=False)

    @property
    def journal(self) -> Path:
        """Where the evaluations are recorded."""
        return self.path / JOURNAL

    @property
    def held(self) -> tuple[str, ...]:
        """Names of what an earlier run left here."""
        return tuple(n for n in (RESULT, REPORT, EXPLORER, OVERLAY, JOURNAL, MODEL, PARAMS) if (self.path / n).exists())

    def within(self, name: str) -> Folder:
        """A folder in this one, made if it is missing.

        Raises
        ------
        UsageError
            If it cannot be made.
        """
        inner = self.path / name
        try:
            inner.mkdir(exist_ok=True)
        except OSError as error:
            raise UsageError(f"cannot create {inner}: {error.strerror}; choose another folder") from error
        return Folder(inner)

    def write(self, name: str, content: str | bytes) -> Path:
        """Write one file, all or nothing.

        Raises
        ------
        UsageError
            If it cannot be written.
        """
        data = content.encode() if isinstance(content, str) else content
        target = self.path / name
        part = self.path / f".{name}.{secrets.token_hex(4)}.part"
        try:
            with part.open("xb") as file:
                file.write(data)
                file.flush()
                os.fsync(file.fileno())
            part.replace(target)
        except OSError as error:
            raise UsageError(
                f"cannot write {target}: {error.strerror}; free some space, or choose a writable folder"
            ) from error
        finally:
            part.unlink(missing_ok=True)
        return target


def _locked(path: Path, *, made: bool) -> Lock | None:
    try:
        return Lock.take(path, made=made)
    except OSError as error:
        raise UsageError(f"--out {path} cannot be written: {error.strerror}; choose another folder") from error


def open_folder(path: Path, *, resume: bool = False, overwrite: bool = False) -> Folder:
    """Make or reuse an output folder.

    Parameters
    ----------
    path : folder; created with its parents, and removed again if the run ends before it has written anything there.
    resume : go on with the journal of an earlier run.
    overwrite : replace what an earlier run left: its journal now, its results once there are new ones.

    Raises
    ------
    UsageError
        If it holds results and neither is asked for, another process writes there, or it cannot be used.
    """
    if resume and overwrite:
        raise UsageError("--resume continues the run that is there and --overwrite deletes it: give one of the two")
    if path.exists() and not path.is_dir():
        raise UsageError(f"--out {path} is a file; give a folder")
    made = not path.exists()
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UsageError(f"--out {path} cannot be created: {error.strerror}; choose another folder") from error
    folder = Folder(path, _locked(path, made=made))
    if folder.held and not (resume or overwrite):
        raise UsageError(
            f"--out {path} already holds results ({', '.join(folder.held)}), which are not touched: --resume "
            "continues an interrupted run, --overwrite replaces them, or choose another folder"
        )
    if overwrite:
        for old in (folder.journal, *path.glob(f"{JOURNAL}.*.npy")):
            try:
                old.unlink(missing_ok=True)
            except OSError as error:
                raise UsageError(f"--overwrite: cannot remove {old}: {error.strerror}; choose another --out") from error
    return folder
