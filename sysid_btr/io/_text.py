"""Words for where a problem is."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence

import numpy as np

from sysid_btr._typing import BoolArray, FloatArray, IntArray
from sysid_btr.io.log import Log

_LIMIT = 30

# Left and right in the names of joints and sites: NaoQi, ROS, and the legs of quadrupeds.
_MIRRORS = (
    (re.compile(r"^L(?=[A-Z])"), "R"),
    (re.compile(r"^l_"), "r_"),
    (re.compile(r"^([FRHB])L(?![a-z])"), r"\1R"),
    (re.compile(r"(?<=[._])L(?=[._]|$)"), "R"),
    (re.compile(r"(?<=[._])l(?=[._]|$)"), "r"),
    (re.compile(r"Left"), "Right"),
    (re.compile(r"left"), "right"),
)


def some(names: Iterable[str], limit: int = _LIMIT) -> str:
    """Names separated by commas, the tail of a long list as a count."""
    names = list(names)
    if len(names) <= limit:
        return ", ".join(names)
    return f"{', '.join(names[:limit])} and {len(names) - limit} more"


def by_channel(columns: Sequence[str]) -> str:
    """Columns grouped: ``position of HeadYaw, HeadPitch; command of HeadYaw``."""
    groups: dict[str, list[str]] = {}
    for column in columns:
        channel, _, name = column.partition(".")
        groups.setdefault(channel, []).append(name)
    return "; ".join(
        f"{channel}.{names[0]}" if len(names) == 1 else f"{channel} of {some(names)}"
        for channel, names in groups.items()
    )


def runs(flags: BoolArray) -> IntArray:
    """Runs of true as rows (start, stop), shape (m, 2), stop exclusive."""
    padded = np.concatenate(([0], flags.astype(np.int8), [0]))
    edges = np.flatnonzero(np.diff(padded))
    return edges.reshape(-1, 2).astype(np.int64)


def at(log: Log, start: int, stop: int | None = None) -> str:
    """``sample 7 (0.07 s)`` or ``samples 7-9 (0.07-0.09 s)``; `stop` is exclusive."""
    last = start if stop is None else stop - 1
    if last <= start:
        return f"sample {start} ({log.time[start]:.6g} s)"
    return f"samples {start}-{last} ({log.time[start]:.6g}-{log.time[last]:.6g} s)"


def places(log: Log, spans: IntArray | Sequence[tuple[int, int]], limit: int = 3) -> str:
    """The first few spans of samples, and how many more."""
    shown = "; ".join(at(log, int(start), int(stop)) for start, stop in spans[:limit])
    return shown if len(spans) <= limit else f"{shown}; and {len(spans) - limit} more"


def mirror_name(name: str) -> str | None:
    """The right-hand partner of a left-hand name, or None."""
    for pattern, replacement in _MIRRORS:
        mirrored, count = pattern.subn(replacement, name, count=1)
        if count:
            return mirrored
    return None


def mirrored(a: str, b: str) -> bool:
    """Whether two names are each other's left and right."""
    return mirror_name(a) == b or mirror_name(b) == a


def spread(values: FloatArray) -> float:
    """Largest minus smallest finite value; 0 if there is none."""
    finite = values[np.isfinite(values)]
    return float(np.ptp(finite)) if len(finite) else 0.0
