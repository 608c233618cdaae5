"""Command lines that nobody means: options of every verb with words of every kind."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.random import Generator

from benchmarks.fuzz.examples import LOG, MODEL, Example
from benchmarks.fuzz.mutations import WORDS
from sysid_btr.cli.commands import VERBS, options_class
from sysid_btr.cli.options import Option, options_of

WHOLE = {
    "validate": (LOG, "-m", MODEL),
    "init": (LOG, "-m", MODEL, "-o", "study.toml"),
    "replay": ("-m", MODEL, "-l", LOG),
    "fit": ("-m", MODEL, "-l", LOG, "-f", "mass:*", "--max-evaluations", "3"),
}
"""Command lines of verbs that take no time."""
SAID = (
    *("mass:*", "kp:*=shared", "mass", ":", "mass:", "mass:*=", "kp:*=other", "backlash.play:*", "mass:*,*"),
    *("mass=0.5:2", "mass=2:0.5", "mass=nan:1", "mass:*=1.1", "position=1e-4", "command=0.5", "pendulum=0.3"),
    *("auto", "forward", "segments", "inverse", "0.3", "2", "1e-9", "log.parquet", "lsq", "ga", "kp=5,kv=1"),
)
"""Words that some option takes."""
UNSAFE = ("out", "exchange", "executor", "config", "threads", "simulator")
"""Options whose words would write anywhere, or wait for somebody."""


def strange_command(base: Example, rng: Generator) -> Example:
    """An example whose command has one to three options more."""
    verb = list(WHOLE)[int(rng.integers(len(WHOLE)))]
    own: Callable[[Any], int] = next(v for v in VERBS if v.__name__ == verb)
    known = [o for n, o in options_of(options_class(own)).items() if n not in UNSAFE and not o.positional]
    more = [word for _ in range(int(rng.integers(1, 4))) for word in _said(known, rng)]
    return Example("options", {}, (verb, *WHOLE[verb], *more), base.beside)


def _said(known: list[Option], rng: Generator) -> tuple[str, ...]:
    one = known[int(rng.integers(len(known)))]
    if one.kind.typed is bool:
        return (one.flag,)
    words = SAID if rng.random() < 0.7 else tuple(w for w in WORDS if "\x00" not in w)
    return one.flag, str(np.array(words, dtype=object)[int(rng.integers(len(words)))])
