"""What a run keeps on disk, and how it reports while it runs."""

from __future__ import annotations

import os
import secrets
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self, TextIO

from sysid_btr.errors import UsageError

if TYPE_CHECKING:
    from sysid_btr.diagnosis.closing import Closing
    from sysid_btr.identify.fit import Fit
    from sysid_btr.posterior.draw import Posterior

RESULT = "result.json"
OVERLAY = "overlay.png"
REPORT = "report.html"
JOURNAL = "journal.jsonl"
MODEL = "model.xml"
PARAMS = "params.json"
DRAWS = "posterior.nc"
LINE_EVERY = 10.0
"""Seconds between progress lines where the terminal cannot redraw one."""


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
            raise UsageError(f"cannot make {inner}: {error.strerror}; choose another folder") from error
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
                f"cannot write {target}: {error.strerror}; make room, or choose a folder that you may write to"
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
        raise UsageError("--resume goes on with what is there and --overwrite drops it: give one of the two")
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
            f"--out {path} already holds results ({', '.join(folder.held)}) and they are not touched: "
            "--resume goes on with an interrupted run, --overwrite replaces them, or choose another folder"
        )
    if overwrite:
        for old in (folder.journal, *path.glob(f"{JOURNAL}.*.npy")):
            try:
                old.unlink(missing_ok=True)
            except OSError as error:
                raise UsageError(f"--overwrite: cannot remove {old}: {error.strerror}; choose another --out") from error
    return folder


def save(
    outcome: Fit | Closing | Posterior, out: str | os.PathLike[str], *, seed: int = 0, overwrite: bool = False
) -> Path:
    """Write result.json, model.xml, params.json, overlay.png and report.html of a fit or a closing, as the command
    line does.

    Parameters
    ----------
    outcome : what `fit` or `close` returned.
    out : folder, created if missing.
    seed : of the generator the estimator was given; recorded.
    overwrite : whether earlier results in the folder may be replaced.

    Returns
    -------
    Path
        The report.
    """
    from sysid_btr.result import make_result

    folder = open_folder(Path(out), overwrite=overwrite)
    return write_all(folder, outcome, make_result(outcome, seed=seed))


def write_all(folder: Folder, outcome: Fit | Closing | Posterior, result: dict[str, Any]) -> Path:
    """Write all files of a run; the result last, because its presence says that the run is complete.

    The result is given what the model became, and what was drawn.
    """
    from sysid_btr.posterior.draw import Posterior
    from sysid_btr.report.pictures import keep, pictures_of, write_report
    from sysid_btr.result import to_json
    from sysid_btr.writeback.write import describe_model

    if isinstance(outcome, Posterior):
        from sysid_btr.posterior.export import netcdf

        folder.write(DRAWS, netcdf(outcome))
    result["pictures"] = keep(folder, pictures_of(outcome))
    describe_model(as_model(outcome), result, folder)
    report = write_report(folder, result)
    folder.write(RESULT, to_json(result))
    return report


def as_model(outcome: Fit | Closing | Posterior) -> Fit | Closing:
    """What stands for an outcome where one model is asked for: a posterior's means."""
    from sysid_btr.posterior.draw import Posterior

    return outcome.as_fit if isinstance(outcome, Posterior) else outcome


class Interrupted(BaseException):
    """Ctrl-C at the command line. No `KeyboardInterrupt`: a search must not take it for its own end."""


@contextmanager
def interruptible() -> Iterator[None]:
    """Turn Ctrl-C into `Interrupted` for the time of a run."""
    import signal

    def stop(_number: int, _frame: object) -> None:
        signal.signal(signal.SIGINT, signal.default_int_handler)
        raise Interrupted

    try:
        previous = signal.signal(signal.SIGINT, stop)
    except ValueError:  # not in the main thread, which alone hears signals
        yield
        return
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, previous)


@dataclass
class ProgressLine:
    """Progress on stderr: one line that is redrawn, or a line now and then where that is impossible.

    A search that follows another counts on: `done` is the sum over the searches of a run.
    """

    title: str
    stream: TextIO = field(default_factory=lambda: sys.stderr)
    enabled: bool = True
    best: float = float("inf")
    _bar: Any = None
    _before: int = 0
    _last: int = 0
    _begun: float = field(default_factory=time.monotonic)
    _spoken: float = field(default_factory=time.monotonic)

    def __enter__(self) -> Self:
        if self.enabled and self.stream.isatty():
            from tqdm import tqdm

            self._bar = tqdm(desc=self.title, unit=" replays", file=self.stream, leave=False, smoothing=0.1)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._bar is not None:
            self._bar.close()

    def __call__(self, *, done: int, total: int | None, best: float, note: str) -> None:
        """Report; the contract of `sysid_btr.estimators.base.Progress`."""
        if done < self._last:
            self._before += self._last
        self._last = done
        self.best = best
        count = self._before + done
        if self._bar is not None:
            self._bar.total = None if total is None else self._before + total
            self._bar.n = count
            self._bar.set_postfix_str(f"loss {best:.4g}{', ' + note if note else ''}")
        elif self.enabled and time.monotonic() - self._spoken >= LINE_EVERY:
            self._spoken = time.monotonic()
            self._say(count, total, best, note)

    def _say(self, count: int, total: int | None, best: float, note: str) -> None:
        elapsed = time.monotonic() - self._begun
        rate = count / elapsed if elapsed > 0 else 0.0
        parts = [f"{self.title}: {count} replays", f"{elapsed:.0f} s", f"loss {best:.4g}"]
        if total is not None and rate > 0:
            left = max(total - self._last, 0) / rate
            parts.insert(2, f"about {left:.0f} s left")
        if note:
            parts.append(note)
        self.stream.write(", ".join(parts) + "\n")
        self.stream.flush()
