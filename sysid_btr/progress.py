"""How a run reports while it works, and how Ctrl-C ends it."""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar, Token
from dataclasses import dataclass, field
from functools import wraps
from types import TracebackType
from typing import Any, ParamSpec, Self, TextIO, TypeVar

P = ParamSpec("P")
T = TypeVar("T")

LINE_EVERY = 10.0
"""Seconds between progress lines where the terminal cannot redraw one; the first one comes at once."""


_SHOWN = ContextVar("_SHOWN", default=False)
"""Whether a line is being shown: what runs within that run shows none of its own."""


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
    _before_it: Token[bool] | None = None
    _before: int = 0
    _last: int = 0
    _begun: float = field(default_factory=time.monotonic)
    _spoken: float = float("-inf")

    def __enter__(self) -> Self:
        self._before_it = _SHOWN.set(True)
        if self.enabled and (self.stream.isatty() or in_notebook()):
            from tqdm import tqdm

            self._bar = tqdm(desc=self.title, unit=" replays", file=self.stream, leave=False, smoothing=0.1)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._bar is not None:
            self._bar.close()
        if self._before_it is not None:
            _SHOWN.reset(self._before_it)

    def __call__(self, *, done: int, total: int | None, best: float, note: str) -> None:
        """Report; the contract of `sysid_btr.estimators.base.Progress`."""
        if done < self._last:
            self._before += self._last
        self._last = done
        self.best = best if math.isfinite(best) else self.best
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


class Watched:
    """Progress where nothing is said: a line on stderr if that is a terminal or a notebook, else nothing."""

    def __call__(self, *, done: int, total: int | None, best: float, note: str) -> None:
        """Report nothing; `shows_progress` puts a line in its place."""

    def __repr__(self) -> str:
        return "watched"


watched = Watched()
"""The default of functions that show their progress."""


def shows_progress(title: str) -> Callable[[Callable[P, T]], Callable[P, T]]:
    """Make a function, called without `progress`, show a line where somebody watches and none is shown yet."""

    def decorate(function: Callable[P, T]) -> Callable[P, T]:
        @wraps(function)
        def call(*args: P.args, **kwargs: P.kwargs) -> T:
            told = kwargs.get("progress", watched) is not watched
            if told or _SHOWN.get() or not (_is_terminal(sys.stderr) or in_notebook()):
                return function(*args, **kwargs)
            with ProgressLine(title) as line:
                kwargs["progress"] = line
                return function(*args, **kwargs)

        return call

    return decorate


def in_notebook() -> bool:
    """Whether this is a kernel of Jupyter."""
    module = sys.modules.get("IPython")
    shell = None if module is None else module.get_ipython()
    return shell is not None and hasattr(shell, "kernel")


def _is_terminal(stream: TextIO | None) -> bool:
    return stream is not None and stream.isatty()


def _loss(best: float) -> tuple[str, ...]:
    """What is said of the best loss; nothing before there is one."""
    return (f"loss {best:.4g}",) if math.isfinite(best) else ()
