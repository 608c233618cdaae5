"""Logs on a regular grid, and commands at arbitrary times."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from sysid_btr._typing import BoolArray, FloatArray, IntArray
from sysid_btr.errors import LogError, UsageError
from sysid_btr.io._clock import SNAP, gaps, holding_sample, typical_interval
from sysid_btr.io.log import COMMANDS, Log
from sysid_btr.machine import require_memory

_SET_CHANNELS = ("enabled", "stiffness")
"""Channels that are set and stay, whatever the commands do."""


def resample(log: Log, period: float) -> Log:
    """The log on the exact grid ``t0 + k * period`` of each episode, k = 0, 1, ...

    Commands are held (or interpolated, where the metadata says the robot does), ``enabled`` and ``stiffness``
    are held, sensors are interpolated linearly, other columns take the last sample. A missing value stays
    missing: NaN wherever a neighbouring sample needed is NaN, and in gaps (intervals longer than 2.5
    typical ones). Nothing crosses the border of two episodes. There is no anti-alias filter, because the
    phase it would add looks like a servo delay.

    Parameters
    ----------
    log : Log
        Time strictly increasing in each episode.
    period : float
        Period of the grid, s.

    Returns
    -------
    Log
        With ``meta.sample_period == period``.

    Raises
    ------
    UsageError
        If `period` is not a positive number, or so small that the result would not fit in memory.
    LogError
        If the log is empty or its time does not increase strictly within an episode.
    """
    if not (np.isfinite(period) and period > 0):
        raise UsageError(f"the resampling period must be a positive number of seconds, not {period}")
    _require_increasing(log)
    pieces = [_resample_episode(log.window(rows.start, rows.stop), period) for rows in log.episodes()]

    def join(parts: list[np.ndarray[Any, Any]]) -> np.ndarray[Any, Any]:
        return parts[0] if len(parts) == 1 else np.concatenate(parts)

    return replace(
        log,
        time=join([piece.time for piece in pieces]),
        episode=join([piece.episode for piece in pieces]),
        channels={name: join([piece.channels[name] for piece in pieces]) for name in log.channels},
        unknown={name: join([piece.unknown[name] for piece in pieces]) for name in log.unknown},
        meta=replace(log.meta, sample_period=float(period)),
    )


def command_at(log: Log, names: Sequence[str], times: FloatArray, channel: str = "command") -> FloatArray:
    """The command each joint was under at arbitrary times.

    Parameters
    ----------
    log : Log
        Time strictly increasing; several episodes only if they share one clock.
    names : sequence of str
        Joints.
    times : ndarray, shape (m,)
        Times on the log's own clock, s, in any order.
    channel : str
        Another channel of commands.

    Returns
    -------
    ndarray, shape (m, len(names))
        The last command at or before each time (zero-order hold), or interpolated between samples if
        ``log.meta.command_hold`` is ``"linear"`` (within an episode). A missing command leaves the one
        before it in force. Before the first sample: the first command; after the last: the last.

    Raises
    ------
    LogError
        If a joint has no command column or no command at all, or time does not increase strictly.
    UsageError
        If one of `times` is not finite.
    """
    times = np.asarray(times, dtype=np.float64)
    commands = log.array(channel, names)
    _require_increasing(log, across_episodes=True)
    if len(times) and not np.all(np.isfinite(times)):
        raise UsageError("commands were requested at a time that is not a finite number")
    silent = [name for name, column in zip(names, commands.T, strict=True) if np.all(np.isnan(column))]
    if silent:
        raise LogError(f"no command was logged for {', '.join(silent)}; drop the column or the joint")
    commands = _fill_forward(commands)
    held = holding_sample(log.time, times)
    if log.meta.command_hold == "zoh" or len(log) < 2:
        return commands[held]
    after = np.minimum(held + 1, len(log) - 1)
    after = np.where(log.episode[after] == log.episode[held], after, held)
    width = log.time[after] - log.time[held]
    share = np.divide(times - log.time[held], width, out=np.zeros_like(times), where=width > 0)
    share = np.clip(share, 0.0, 1.0)[:, None]
    blended: FloatArray = (1 - share) * commands[held] + share * commands[after]
    return blended


def holds(log: Log, channel: str) -> bool:
    """Whether a value of a channel stays in force until the next sample."""
    return channel in _SET_CHANNELS or (channel in COMMANDS and log.meta.command_hold == "zoh")


def _require_increasing(log: Log, *, across_episodes: bool = False) -> None:
    if len(log) == 0:
        raise LogError("the log has no samples")
    runs = (slice(0, len(log)),) if across_episodes else log.episodes()
    for rows in runs:
        time = log.time[rows]
        bad = np.flatnonzero(~(np.diff(time) > 0))
        if len(bad) or not np.all(np.isfinite(time)):
            at = rows.start + (int(bad[0]) + 1 if len(bad) else 0)
            more = "; take one episode at a time with `log.episodes()`" if across_episodes else ""
            raise LogError(
                f"time does not increase strictly at sample {at} ({log.time[at]:.6g} s); "
                f"`sysid-btr validate` lists all such places{more}"
            )


def _fill_forward(values: FloatArray) -> FloatArray:
    """Replace each NaN by the last value above it, leading ones by the first value; shape (n, m)."""
    known = ~np.isnan(values)
    rows = np.arange(len(values))[:, None]
    last = np.maximum.accumulate(np.where(known, rows, -1), axis=0)
    filled: FloatArray = np.take_along_axis(values, np.where(last < 0, np.argmax(known, axis=0), last), axis=0)
    return filled


def _resample_episode(log: Log, period: float) -> Log:
    time = log.time
    duration = time[-1] - time[0]
    samples = duration / period
    size = 8 * samples * (2 + len(log.channels) + len(log.unknown))
    require_memory(size, f"resampling {duration:.6g} s every {period:.3g} s", "choose a longer period")
    # The end of the log counts as on the grid despite the rounding of its time stamp.
    interval = typical_interval(time)
    slack = 1e-6 + (SNAP * min(interval / period, 1.0) if len(log) > 1 else 0.0)
    grid = time[0] + np.arange(int(np.floor(duration / period + slack)) + 1) * period
    held = holding_sample(time, grid)
    in_gap = _in_gap(time, grid, held)
    channels = {name: _at(log, name, grid, held, in_gap) for name in log.channels}
    return replace(
        log,
        time=grid,
        channels=channels,
        episode=log.episode[held],
        unknown={name: values[held] for name, values in log.unknown.items()},
    )


def _in_gap(time: FloatArray, grid: FloatArray, held: IntArray) -> BoolArray:
    """Whether each grid point lies inside a gap (its edges do not: they are samples)."""
    after = np.minimum(held + 1, len(time) - 1)
    missing = np.append(gaps(time), False)
    inside: BoolArray = missing[held] & (grid > time[held]) & (grid < time[after])
    if np.any(inside):
        tolerance = SNAP * typical_interval(time)
        inside &= grid - time[held] > tolerance
    return inside


def _at(log: Log, column: str, grid: FloatArray, held: IntArray, in_gap: BoolArray) -> FloatArray:
    time, values = log.time, log.channels[column]
    channel = column.partition(".")[0]
    at_sample = values[held]
    if holds(log, channel) or len(time) < 2:
        return np.where(in_gap, np.nan, at_sample)
    # Interpolation knows no snapping, except where it would lose a sample to a NaN beside it.
    before = np.clip(np.searchsorted(time, grid, side="right") - 1, 0, len(time) - 2)
    share = np.clip((grid - time[before]) / (time[before + 1] - time[before]), 0.0, 1.0)
    between = (1 - share) * values[before] + share * values[before + 1]
    on_sample = np.abs(grid - time[held]) <= SNAP * typical_interval(time)
    between = np.where(on_sample & np.isnan(between), at_sample, between)
    return np.where(grid == time[held], at_sample, np.where(in_gap, np.nan, between))
