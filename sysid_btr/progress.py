"""How a run reports while it works, and how Ctrl-C ends it."""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from types import TracebackType
from typing import Any, Self, TextIO

LINE_EVERY = 10.0
"""Seconds between progress lines where the terminal cannot redraw one; the first one comes at once."""


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
    _spoken: float = float("-inf")

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
            self._bar.set_postfix_str(", ".join((*_loss(best), *((note,) if note else ()))))
        elif self.enabled and time.monotonic() - self._spoken >= LINE_EVERY:
            self._spoken = time.monotonic()
            self._say(count, total, best, note)

    def _say(self, count: int, total: int | None, best: float, note: str) -> None:
        elapsed = time.monotonic() - self._begun
        rate = count / elapsed if elapsed > 0 else 0.0
        parts = [f"{self.title}: {count} replays", f"{elapsed:.0f} s", *_loss(best)]
        if total is not None and rate > 0:
            left = max(total - self._last, 0) / rate
            parts.insert(2, f"about {left:.0f} s left")
        if note:
            parts.append(note)
        self.stream.write(", ".join(parts) + "\n")
        self.stream.flush()


def _loss(best: float) -> tuple[str, ...]:
    """What is said of the best loss; nothing before there is one."""
    return (f"loss {best:.4g}",) if math.isfinite(best) else ()
