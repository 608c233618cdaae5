"""One case: files, one of them broken, and what the command that reads them does."""

from __future__ import annotations

import os
import resource
import signal
import sys
import warnings
from collections.abc import Iterator, Sequence
from contextlib import chdir, contextmanager, redirect_stderr, redirect_stdout
from dataclasses import dataclass
from io import StringIO
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from benchmarks.fuzz.examples import Example
from benchmarks.fuzz.mutations import broken
from benchmarks.fuzz.options import strange_command
from sysid_btr.cli import run
from sysid_btr.machine import VARIABLE

ALLOWED = (0, 2, 3, 4, 5)
"""Exit codes: done, usage, log, model, nothing identified."""
MOST_MEMORY = 1e9
"""Bytes that a process may take, with all its libraries."""
LIMIT = "0.3"
"""GB that the program is told it may take."""
SLOWEST = 30
"""s for one case: its files hold a second and a half of one joint."""


class TooSlow(BaseException):
    """A case that would not end."""


@dataclass(frozen=True)
class Ending:
    """How a command ended.

    Attributes
    ----------
    code : its exit code; -1 where it did not end as it should.
    wrong : what it did that no input may make it do; empty if nothing.
    """

    code: int
    wrong: str


def run_case(example: Example, number: int) -> Ending:
    """The case of a number: the same files on every machine."""
    rng = np.random.default_rng([number, *example.name.encode()])
    files = {**example.beside, **example.files}
    if example.files:
        name = sorted(example.files)[int(rng.integers(len(example.files)))]
        files[name] = broken(name, example.files[name], rng)
    else:
        example = strange_command(example, rng)
    with TemporaryDirectory() as folder:
        for path, content in files.items():
            place = Path(folder, path)
            place.parent.mkdir(parents=True, exist_ok=True)
            place.write_bytes(content)
        with chdir(folder):
            return ending(example.command)


def ending(command: Sequence[str]) -> Ending:
    """What a command does, in this process."""
    out, said, before = StringIO(), StringIO(), _peak()
    try:
        with _timed(), _limited(), warnings.catch_warnings(), redirect_stdout(out), redirect_stderr(said):
            warnings.simplefilter("ignore")
            code = run(list(command))
    except TooSlow:
        return Ending(-1, f"more than {SLOWEST} s")
    except Exception as error:
        return Ending(-1, f"{type(error).__name__}: {error}"[:300])
    text, grown = said.getvalue(), _peak() - before
    if code not in ALLOWED or "Traceback" in text:
        return Ending(code, f"exit {code}: {text[-300:]}")
    if grown > MOST_MEMORY:
        return Ending(code, f"{grown / 1e9:.2f} GB of memory")
    return Ending(code, "")


@contextmanager
def _timed() -> Iterator[None]:
    def stop(_number: int, _frame: object) -> None:
        raise TooSlow

    before = signal.signal(signal.SIGALRM, stop)
    signal.alarm(SLOWEST)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)


@contextmanager
def _limited() -> Iterator[None]:
    before = os.environ.get(VARIABLE)
    os.environ[VARIABLE] = LIMIT
    try:
        yield
    finally:
        os.environ.pop(VARIABLE)
        if before is not None:
            os.environ[VARIABLE] = before


def _peak() -> float:
    """Most bytes that this process has taken."""
    unit = 1 if sys.platform == "darwin" else 1024
    return float(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss) * unit
