"""The output folder of a run, and the files in it."""

from __future__ import annotations

import os
import secrets
from dataclasses import dataclass
from pathlib import Path

from sysid_btr.errors import UsageError

RESULT = "result.json"
OVERLAY = "overlay.png"
REPORT = "report.html"
JOURNAL = "journal.jsonl"
MODEL = "model.xml"
PARAMS = "params.json"
DRAWS = "posterior.nc"


@dataclass(frozen=True)
class Folder:
    """The output folder of a run; its files appear complete or not at all."""

    path: Path

    @property
    def journal(self) -> Path:
        """Where the evaluations are recorded."""
        return self.path / JOURNAL

    @property
    def held(self) -> tuple[str, ...]:
        """Names of what an earlier run left here."""
        return tuple(n for n in (RESULT, REPORT, OVERLAY, JOURNAL, MODEL, PARAMS) if (self.path / n).exists())

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


def open_folder(path: Path, *, resume: bool = False, overwrite: bool = False) -> Folder:
    """Make or reuse an output folder.

    Parameters
    ----------
    path : folder; created with its parents.
    resume : go on with the journal of an earlier run.
    overwrite : replace what an earlier run left: its journal now, its results once there are new ones.

    Raises
    ------
    UsageError
        If it holds results and neither is asked for, or it cannot be used.
    """
    if resume and overwrite:
        raise UsageError("--resume continues the run that is there and --overwrite deletes it: give one of the two")
    if path.exists() and not path.is_dir():
        raise UsageError(f"--out {path} is a file; give a folder")
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UsageError(
            f"--out {path} cannot be created: {error.strerror}; choose another folder"
        ) from error
    folder = Folder(path)
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
