"""Time stamps: order, duplicates, gaps, jitter, unit, and the rows of episodes."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from sysid_btr._typing import BoolArray
from sysid_btr.io._clock import gaps, typical_interval
from sysid_btr.io._text import at, places, runs
from sysid_btr.io.log import Log
from sysid_btr.io.problem import Problem

_MAX_IRREGULAR = 0.05
_SLOWEST_SAMPLE = 1.0  # s; no joint log is slower, a clock in ms, us or ns always is
_PERIOD_TOLERANCE = 0.05
_LATEST = 1e19  # s; more than nanoseconds since 1970 would give: not a time in any unit


def _is_time(log: Log) -> BoolArray:
    plausible: BoolArray = np.abs(log.time) < _LATEST
    return plausible


def clock_is_sane(log: Log) -> bool:
    """Whether time is finite and increases strictly within each episode."""
    return bool(np.all(_is_time(log))) and all(np.all(np.diff(log.time[rows]) > 0) for rows in log.episodes())


def check_clock(log: Log) -> Iterator[Problem]:
    """Problems of the time and episode columns.

    Time must increase strictly within an episode; where a new episode begins the clock may jump or restart.
    """
    if len(log) < 3:
        yield Problem(
            "log.short",
            "error",
            "time",
            f"the log has {len(log)} sample{'s' if len(log) > 1 else ''}: too few to show any motion",
            "record some seconds",
        )
    numbers = [int(log.episode[rows.start]) for rows in log.episodes()]
    scattered = sorted({number for number in numbers if numbers.count(number) > 1}) if len(numbers) < 10_000 else []
    if scattered or len(numbers) >= 10_000:
        which = f"episode {scattered[0]} appears again" if scattered else "the number changes all the time"
        yield Problem(
            "episode.scattered",
            "error",
            "episode",
            f"the rows of an episode must follow one another, but {which} after another one",
            "sort the rows by episode, then by time",
        )
    if not np.all(_is_time(log)):
        bad = runs(~_is_time(log))
        yield Problem(
            "time.nan",
            "error",
            f"time, {places(log, bad)}",
            f"{int(np.sum(~_is_time(log)))} of {len(log)} time stamps are missing, infinite or out of any range",
            "drop these rows, or restore their time stamps from the recorder",
        )
        return
    yield from _order(log)
    yield from _rate(log)


def _within_episodes(log: Log) -> BoolArray:
    same: BoolArray = np.diff(log.episode) == 0
    return same


def _order(log: Log) -> Iterator[Problem]:
    within = _within_episodes(log)
    steps = np.diff(log.time)
    backwards = np.flatnonzero((steps < 0) & within) + 1
    if len(backwards):
        worst = float(steps[backwards - 1].min())
        yield Problem(
            "time.backwards",
            "error",
            f"time, {places(log, [(int(i), int(i) + 1) for i in backwards])}",
            f"time goes backwards {len(backwards)} time{'s' if len(backwards) > 1 else ''}, by up to {-worst:.6g} s",
            "sort the rows by time if they were written out of order; "
            "if the clock was restarted, number the recordings in a column `episode`",
        )
    duplicate = np.flatnonzero((steps == 0) & within) + 1
    if len(duplicate):
        rounded = len(duplicate) > 0.1 * len(log)
        why = "; so many that the stamps seem to be rounded (float32, or whole ms)" if rounded else ""
        yield Problem(
            "time.duplicate",
            "error",
            f"time, {places(log, [(int(i), int(i) + 1) for i in duplicate])}",
            f"{len(duplicate)} sample{'s have' if len(duplicate) > 1 else ' has'} "
            f"the time stamp of the one before{why}",
            "write time as float64 with full resolution" if rounded else "keep one row of each time stamp",
        )


def _rate(log: Log) -> Iterator[Problem]:
    within = _within_episodes(log)
    steps = np.diff(log.time)
    steps = steps[within & (steps > 0)]
    if len(steps) < 2:
        return
    interval = float(np.median(steps))
    nominal = log.meta.sample_period
    if interval >= _SLOWEST_SAMPLE:
        exponent = 3 * round(np.log10(interval / (nominal or 0.01)) / 3)
        unit = {3: "milliseconds", 6: "microseconds", 9: "nanoseconds"}.get(exponent, "some other unit")
        remedy = (
            f"divide time by 1e{exponent}"
            if exponent in (3, 6, 9)
            else "write time in seconds; or, if the samples really are so far apart, record at a higher rate"
        )
        yield Problem(
            "time.unit",
            "error",
            "time",
            f"samples are {interval:.6g} s apart: the time looks like {unit}, not seconds",
            remedy,
        )
        return
    if nominal is not None and abs(interval / nominal - 1) > _PERIOD_TOLERANCE:
        yield Problem(
            "time.period",
            "warning",
            "time",
            f"samples are typically {interval:.6g} s apart, but the metadata says sample_period {nominal:.6g} s; "
            "the time stamps are used",
            "correct `sample_period`, or leave it out for an irregular clock",
        )
    irregular = float(np.mean((steps < 0.5 * interval) | (steps > 1.9 * interval)))
    if irregular > _MAX_IRREGULAR:
        low, high = np.percentile(steps, [5, 95])
        yield Problem(
            "time.jitter",
            "warning",
            "time",
            f"the clock is uneven: {100 * irregular:.0f} % of the intervals are less than half or about twice the "
            f"typical {interval:.4g} s (5-95 %: {low:.3g}-{high:.3g} s)",
            "check that time is when a sample was taken, not when it was received or written",
        )
        return
    found: list[tuple[int, int]] = []
    for rows in log.episodes():
        time = log.time[rows]
        found += [(rows.start + int(i), rows.start + int(i) + 2) for i in np.flatnonzero(gaps(time))]
    if found:
        lengths = [log.time[stop - 1] - log.time[start] for start, stop in found]
        lost = sum(round(float(length) / typical_interval(log.time)) - 1 for length in lengths)
        start, stop = found[int(np.argmax(lengths))]
        longest = f"; the longest is {max(lengths):.4g} s, from {at(log, start, stop)}" if len(found) > 1 else ""
        yield Problem(
            "time.gap",
            "warning",
            f"time, {places(log, found)}",
            f"{len(found)} gap{'s' if len(found) > 1 else ''} in a clock of typically {interval:.4g} s: about {lost} "
            f"samples are missing{longest}",
            "nothing, if it is short; else cut the log there, or number the parts in a column `episode`",
        )
