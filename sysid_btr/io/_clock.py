"""What the time stamps of a log mean: its typical interval, what counts as a gap, which sample holds when."""

from __future__ import annotations

import numpy as np

from sysid_btr._typing import BoolArray, FloatArray, IntArray

GAP_FACTOR = 2.5
"""An interval longer than this many typical ones is a gap: samples are missing, nothing is known inside."""

SNAP = 0.01
"""Fraction of the typical interval within which a time counts as the sample's own.

Time stamps are rounded (to float32, to microseconds), so ``k * period`` may fall a hair before the stamp of
sample k; without this tolerance a held command would then be late by a whole sample.
"""


def typical_interval(time: FloatArray) -> float:
    """Median positive interval, s; NaN if there is none."""
    intervals = np.diff(time)
    intervals = intervals[intervals > 0]
    return float(np.median(intervals)) if len(intervals) else float("nan")


def gaps(time: FloatArray) -> BoolArray:
    """For each interval, shape (n - 1,): whether samples are missing in it."""
    if len(time) < 3:
        return np.zeros(max(len(time) - 1, 0), dtype=np.bool_)
    found: BoolArray = np.diff(time) > GAP_FACTOR * typical_interval(time)
    return found


def holding_sample(time: FloatArray, times: FloatArray) -> IntArray:
    """Index of the last sample at or before each of `times`; the first sample before the log begins.

    `time` is strictly increasing, shape (n,), n > 0; `times` has any order.
    """
    interval = typical_interval(time)
    snap = SNAP * interval if np.isfinite(interval) else 0.0
    # Never reach past half of a short interval, whatever the typical one.
    index = np.searchsorted(time, times, side="right") - 1
    after = np.clip(index + 1, 0, len(time) - 1)
    before = np.clip(index, 0, len(time) - 1)
    near = (time[after] - times <= snap) & (time[after] - times < times - time[before]) & (after > index)
    held: IntArray = np.clip(np.where(near, after, index), 0, len(time) - 1).astype(np.int64)
    return held
