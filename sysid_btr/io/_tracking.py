"""How a joint's position goes with its command, as seen in the log alone."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from sysid_btr._typing import BoolArray, FloatArray
from sysid_btr.io._check_clock import clock_is_sane
from sysid_btr.io._clock import typical_interval
from sysid_btr.io._text import spread
from sysid_btr.io.log import Log

_STEP = 0.01  # s; lags are searched no finer than this
_NORMAL_LAG = 0.25  # s; servo lag, delay and filters together
_MIN_SAMPLES = 30


@dataclass(frozen=True, eq=False)
class Tracking:
    """Command and position of one joint on one regular clock.

    Attributes
    ----------
    step : float
        Interval of the clock, s.
    command, position : ndarray, shape (n,)
        Values; arbitrary where not `valid`.
    valid : ndarray of bool, shape (n,)
        Where both are known and the joint is driven.
    """

    step: float
    command: FloatArray
    position: FloatArray
    valid: BoolArray

    @property
    def slope(self) -> float | None:
        """Scale of position against command, if the two clearly go together."""
        lag, r = best_lag(self, 0.0, _NORMAL_LAG)
        if abs(r) < 0.8:
            return None
        command, position = self.at_lag(lag)
        return float(np.std(position) / np.std(command)) * (1 if r > 0 else -1)

    def at_lag(self, lag: int, other: Tracking | None = None) -> tuple[FloatArray, FloatArray]:
        """Valid pairs of the command and the position (of `other`, if given) `lag` steps later."""
        late = self if other is None else other
        n = min(len(self.command), len(late.position))
        first, last = max(0, -lag), min(n, n - lag)
        if last - first < _MIN_SAMPLES:
            return np.empty(0), np.empty(0)
        good = self.valid[first:last] & late.valid[first + lag : last + lag]
        return self.command[first:last][good], late.position[first + lag : last + lag][good]

    def correlation(self, lag: int, other: Tracking | None = None) -> float:
        """Pearson correlation of `at_lag`; 0 where it is not defined."""
        a, b = self.at_lag(lag, other)
        if len(a) < _MIN_SAMPLES:
            return 0.0
        a, b = a - a.mean(), b - b.mean()
        scale = float(np.sqrt((a @ a) * (b @ b)))
        return float(a @ b) / scale if scale > 1e-12 else 0.0


def best_lag(pair: Tracking, low: float, high: float, other: Tracking | None = None) -> tuple[int, float]:
    """Lag between `low` and `high` seconds, in steps, with the largest |correlation|, and that correlation."""
    lags = range(round(low / pair.step), round(high / pair.step) + 1)
    found = [(lag, pair.correlation(lag, other)) for lag in lags]
    return max(found, key=lambda entry: abs(entry[1]))


_KINDS = {"Nm": "torque", "N": "torque", "rad/s": "velocity", "m/s": "velocity"}
"""Units of commands that are no positions."""


def command_kinds(log: Log, drives: Mapping[str, str]) -> dict[str, str]:
    """What each commanded joint's command is: to the model's drives, by its unit, by the log's account, a position."""
    told = log.meta.drive if log.meta.drive in ("velocity", "torque") else "position"
    return {
        joint: drives.get(joint) or _KINDS.get(log.meta.unit(f"command.{joint}") or "", told)
        for joint in log.joints("command")
    }


def distance(pair: Tracking) -> float:
    """Root mean square distance of position and command at a servo's lag, of the command's standard deviation."""
    lags = range(round(_NORMAL_LAG / pair.step) + 1)
    pairs = [pair.at_lag(lag) for lag in lags]
    found = [float(np.sqrt(np.mean((p - c) ** 2)) / np.std(c)) for c, p in pairs if len(c) and np.ptp(c) > 0]
    return min(found, default=np.inf)


def trackings(log: Log, joints: Sequence[str]) -> Mapping[str, Tracking]:
    """Those joints that have both command and position, on a regular clock of at most 100 Hz."""
    interval = typical_interval(log.time[np.isfinite(log.time)])
    if not np.isfinite(interval * len(log)) or len(log) < _MIN_SAMPLES:
        return {}
    time = _continuous_time(log, interval)
    step = max(interval, _STEP)
    grid = np.arange(0.0, time[-1] + 0.5 * step, step)
    nearest = np.clip(np.searchsorted(time, grid + 0.5 * interval) - 1, 0, len(time) - 1)
    near = np.abs(time[nearest] - grid) <= step
    found: dict[str, Tracking] = {}
    for joint in joints:
        if not log.has("position", joint):
            continue
        command = log.channels[f"command.{joint}"]
        position = log.channels[f"position.{joint}"]
        valid = driven(log, joint) & np.isfinite(command) & np.isfinite(position)
        found[joint] = Tracking(
            step=step, command=command[nearest], position=position[nearest], valid=valid[nearest] & near
        )
    return found


def driven(log: Log, joint: str) -> BoolArray:
    """Where the servo is on, as far as the log says."""
    on: BoolArray = np.ones(len(log), dtype=np.bool_)
    if log.has("enabled", joint):
        on &= ~(log.channels[f"enabled.{joint}"] < 0.5)
    if log.has("stiffness", joint):
        on &= ~(log.channels[f"stiffness.{joint}"] < 0.05)
    return on


def moves(pair: Tracking, threshold: float) -> bool:
    """Whether the valid command moves more than `threshold`."""
    return spread(pair.command[pair.valid]) > threshold


def _continuous_time(log: Log, interval: float) -> FloatArray:
    """Time from 0, episodes one after the other; sample counts where the stamps cannot be trusted."""
    if not clock_is_sane(log):
        return np.arange(len(log), dtype=np.float64) * interval
    steps = np.diff(log.time, prepend=log.time[0])
    steps[np.flatnonzero(np.diff(log.episode)) + 1] = interval
    # A long pause holds nothing to correlate; keep the grid small.
    return np.cumsum(np.minimum(steps, max(1.0, 10 * interval)))
