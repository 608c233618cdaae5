"""Signals with clocks of their own, brought onto one.

A command is held until the next one, never interpolated; a sensor is interpolated between two samples that are
neighbours on its own clock, and missing where they are too far apart.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sysid_btr._typing import FloatArray
from sysid_btr.io._clock import gaps


@dataclass(frozen=True, eq=False)
class Series:
    """One quantity as it was sent.

    Attributes
    ----------
    source : topic and field.
    column : of the schema; empty for what is kept and not used.
    time : ndarray, shape (k,), s, strictly increasing.
    values : ndarray, shape (k,).
    held : whether a value is in force until the next.
    unit : as the message defines it.
    """

    source: str
    column: str
    time: FloatArray
    values: FloatArray
    held: bool = False
    unit: str | None = None


def on_clock(series: Series, clock: FloatArray) -> FloatArray:
    """Values at the stamps of a clock.

    Parameters
    ----------
    series : k samples.
    clock : ndarray, shape (n,), s, strictly increasing.

    Returns
    -------
    ndarray, shape (n,)
        Exactly the values sent where the stamps are the same; NaN where nothing is known.
    """
    time, values = series.time, series.values
    if len(time) == len(clock) and np.array_equal(time, clock):
        return values
    if len(time) == 0:
        return np.full(len(clock), np.nan)
    before = np.searchsorted(time, clock, side="right") - 1
    known = before >= 0
    before = np.maximum(before, 0)
    if series.held:
        return np.where(known, values[before], np.nan)
    exact = known & (time[before] == clock)
    after = np.minimum(before + 1, len(time) - 1)
    apart = np.append(gaps(time), True)[before]
    width = np.where(after > before, time[after] - time[before], 1.0)
    share = (clock - time[before]) / width
    between = (1 - share) * values[before] + share * values[after]
    return np.where(exact, values[before], np.where(known & (after > before) & ~apart, between, np.nan))


def lateness(series: Series, clock: FloatArray) -> float:
    """Mean time from a held value's stamp to the first row that shows it, s; NaN if no row shows any."""
    inside = series.time[(series.time >= clock[0]) & (series.time <= clock[-1])] if len(clock) else series.time
    if not len(inside) or not len(clock):
        return float("nan")
    shown = clock[np.minimum(np.searchsorted(clock, inside, side="left"), len(clock) - 1)]
    return float(np.mean(shown - inside))
