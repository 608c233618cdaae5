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

LINE_EVERY, PHASE_EVERY = 10.0, 2.0
"""Seconds between progress lines where the terminal cannot redraw one, and before one of another phase; the first one
comes at once."""
USUAL_REPORTS = 10
"""Reports of a phase that foretells no total, after which it counts as half done."""
TOLD_FROM = 0.03
"""Part of a run from which the time left is foretold."""
BAR = "{desc}: {percentage:3.0f} %|{bar:20}| {elapsed}{postfix}"


_SHOWN: ContextVar[ProgressLine | None] = ContextVar("_SHOWN", default=None)
"""The line that is being shown: what runs within that run shows none of its own."""


@contextmanager
def phase(name: str, share: float) -> Iterator[None]:
    """A part of a run, for the line that is shown, if any.

    Parameters
    ----------
    name : what is done; empty where its reports say so.
    share : expected fraction of the time of what encloses it, or of what is left of that.
    """
    line = _SHOWN.get()
    if line is None:
        yield
        return
    with line.phase(name, share):
        yield


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


def mention(note: str, done: float) -> None:
    """Say what is done and which fraction of the phase, on the line that is shown, if any: where no search reports."""
    line = _SHOWN.get()
    if line is not None:
        line.mention(note, done)


@dataclass(frozen=True)
class _Span:
    """A phase, as fractions of the run."""

    name: str
    begin: float
    end: float


@dataclass
class ProgressLine:
    """Progress on stderr: one line that is redrawn, or a line now and then where that is impossible.

    A search that follows another counts on: the count is the sum over the searches of a run. How much of a run is done
    follows from its phases (`phase`), and the time left from that.
    """

    title: str
    stream: TextIO = field(default_factory=lambda: sys.stderr)
    enabled: bool = True
    best: float = float("inf")
    _bar: Any = None
    _before_it: Token[ProgressLine | None] | None = None
    _before: int = 0
    _last: int = 0
    _begun: float = field(default_factory=time.monotonic)
    _spoken: float = float("-inf")
    _spans: list[_Span] = field(default_factory=lambda: [_Span("", 0.0, 1.0)])
    _finished: float = 0.0
    _reports: int = 0
    _fraction: float = 0.0

    def __enter__(self) -> Self:
        self._before_it = _SHOWN.set(self)
        if self.enabled and (self.stream.isatty() or in_notebook()):
            from tqdm import tqdm

            self._bar = tqdm(desc=self.title, total=100, file=self.stream, leave=False, bar_format=BAR)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._bar is not None:
            self._bar.close()
        if self._before_it is not None:
            _SHOWN.reset(self._before_it)

    @contextmanager
    def phase(self, name: str, share: float) -> Iterator[None]:
        """See `progress.phase`."""
        end = self._finished + share * (self._spans[-1].end - self._finished)
        self._spans.append(_Span(name, self._finished, end))
        self._reports = 0
        self._show((), "", PHASE_EVERY)
        try:
            yield
        finally:
            self._spans.pop()
            self._finished, self._reports = end, 0

    def mention(self, note: str, done: float) -> None:
        """See `progress.mention`."""
        self._advance(done)
        self._show((), note, LINE_EVERY)

    def __call__(self, *, done: int, total: int | None, best: float, note: str) -> None:
        """Report; the contract of `sysid_btr.estimators.base.Progress`."""
        if done < self._last:
            self._before += self._last
        self._last = done
        self._reports += 1
        self.best = best if math.isfinite(best) else self.best
        if total or len(self._spans) > 1:
            self._advance(done / total if total else self._reports / (self._reports + USUAL_REPORTS))
        self._show(_loss(best), note, LINE_EVERY)

    def _advance(self, done: float) -> None:
        """Take a fraction of the present phase for done."""
        span = self._spans[-1]
        self._fraction = max(self._fraction, span.begin + min(done, 1.0) * (span.end - span.begin))

    def _show(self, loss: tuple[str, ...], note: str, every: float) -> None:
        count, elapsed = self._before + self._last, time.monotonic() - self._begun
        doing = ": ".join(filter(None, (self._spans[-1].name, note)))
        left: tuple[str, ...] = ()
        if self._fraction >= TOLD_FROM:
            left = (f"about {_duration(elapsed * (1 / self._fraction - 1))} left",)
        if self._bar is not None:
            self._bar.n = round(100 * self._fraction)
            self._bar.set_postfix_str(", ".join((f"{count} replays", *left, *loss, *filter(None, (doing,)))))
        elif self.enabled and time.monotonic() - self._spoken >= every:
            self._spoken = time.monotonic()
            percent = (f"{100 * self._fraction:.0f} %",) if self._fraction else ()
            parts = (*percent, f"{count} replays", f"{elapsed:.0f} s", *left, *loss, *filter(None, (doing,)))
            self.stream.write(f"{self.title}: {', '.join(parts)}\n")
            self.stream.flush()


def _duration(seconds: float) -> str:
    """A time to wait, no more exact than it can be foretold."""
    if seconds < 100:
        return f"{float(f'{seconds:.1g}' if seconds < 10 else f'{seconds:.2g}'):.0f} s"
    return f"{seconds / 60:.0f} min"


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
            if told or _SHOWN.get() is not None or not (_is_terminal(sys.stderr) or in_notebook()):
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
