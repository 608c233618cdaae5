"""Missing and infinite values."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from sysid_btr._typing import FloatArray
from sysid_btr.io._text import by_channel, places, runs
from sysid_btr.io.log import Log
from sysid_btr.io.noise import ASSUMED_BITS, channel_noise
from sysid_btr.io.problem import Problem

_NEEDED = ("command", "position")
_ABSURD = 1e9  # beyond any encoder count or force; also keeps squares of what follows finite


def plausible(log: Log) -> Log:
    """The log with infinite and absurd values made missing, for checks that look at motion."""
    channels = {name: np.where(np.abs(values) < _ABSURD, values, np.nan) for name, values in log.channels.items()}
    return replace(log, channels=channels)


def check_values(log: Log) -> Iterator[Problem]:
    """Infinite values, empty columns and missing values, one problem a kind."""
    infinite = {name: np.isinf(values) for name, values in log.channels.items() if np.any(np.isinf(values))}
    if infinite:
        flags = np.any(list(infinite.values()), axis=0)
        yield Problem(
            "values.infinite",
            "error",
            f"{by_channel(list(infinite))}, {places(log, runs(flags))}",
            f"{sum(int(np.sum(f)) for f in infinite.values())} values are infinite",
            "a division by zero or an overflow in the recorder: set these values to NaN (missing)",
        )
    absurd = {name: np.isfinite(values) & (np.abs(values) >= _ABSURD) for name, values in log.channels.items()}
    absurd = {name: flags for name, flags in absurd.items() if np.any(flags)}
    if absurd:
        flags = np.any(list(absurd.values()), axis=0)
        yield Problem(
            "values.absurd",
            "error",
            f"{by_channel(list(absurd))}, {places(log, runs(flags))}",
            f"{sum(int(np.sum(f)) for f in absurd.values())} values are larger than {_ABSURD:.0e}",
            "overwritten memory or a decoding error in the recorder: set these values to NaN (missing)",
        )
    missing = {name: _share_missing(values) for name, values in log.channels.items()}
    empty = [name for name, share in missing.items() if share == 1]
    if empty:
        yield Problem(
            "values.all_missing",
            "error",
            by_channel(empty),
            "the column has no values, only NaN",
            "leave the column out, or repair the recorder",
        )
    mostly = [n for n, share in missing.items() if 0.5 <= share < 1 and n.partition(".")[0] in _NEEDED]
    if mostly:
        yield Problem(
            "values.mostly_missing",
            "error",
            by_channel(mostly),
            f"{100 * missing[mostly[0]]:.0f} % of the values are missing: too many to fit a motion to",
            "log commands and positions together, one row a sample; "
            "a slower sensor belongs on the clock of the slowest signal you fit",
        )
    partly = [n for n, share in missing.items() if 0 < share < 1 and n not in mostly]
    if partly:
        flags = np.any([np.isnan(log.channels[n]) for n in partly], axis=0)
        worst = max(partly, key=lambda name: missing[name])
        yield Problem(
            "values.missing",
            "warning",
            f"{by_channel(partly)}, {places(log, runs(flags))}",
            f"values are missing (NaN), at most {100 * missing[worst]:.2g} % of a column ({worst}); "
            "they are not compared, and a missing command is replaced by the previous one (zero-order hold)",
            "nothing, if that is right; else repair the recorder",
        )


def check_noise(log: Log) -> Iterator[Problem]:
    """Channels whose noise was filtered away before they were stored."""
    measured = [name for name in log.channels if name.partition(".")[0] in ("position", "velocity", "effort")]
    floors = {name: channel_noise(log, name) for name in measured}
    filtered = [name for name, floor in floors.items() if floor.method == "assumed"]
    if filtered:
        yield Problem(
            "noise.filtered",
            "note",
            by_channel(filtered),
            f"hardly any noise is left: these values were filtered, computed or simulated; a {ASSUMED_BITS}-bit sensor "
            f"is assumed, for {filtered[0]} a standard deviation of {floors[filtered[0]].sigma:.2g}",
            "log what the sensor says, or state its noise: --noise position=1e-4, or `noise` in the file's metadata",
        )


def _share_missing(values: FloatArray) -> float:
    return float(np.mean(np.isnan(values)))
