"""Whether positions follow commands: stuck, swapped, mirrored in sign, late, saturated or dead."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from sysid_btr._typing import FloatArray, IntArray
from sysid_btr.io._check_units import TORQUES, is_linear
from sysid_btr.io._text import at, by_channel, mirror_name, runs, some, spread
from sysid_btr.io._tracking import Tracking, best_lag, driven, moves
from sysid_btr.io.log import Log
from sysid_btr.io.noise import hides_motion
from sysid_btr.io.problem import Problem

_MOVES_RAD = 0.02
_MOVES_M = 0.001
_MAX_LAG = 0.25  # s
_SEARCHED_LAG = 2.0  # s
_STUCK_FOR = 0.3  # s
_UNRELATED = 0.3
"""Correlation with the command, at any lag, below which a position does not follow it. Positions of servos have 0.8 and
more, of one that carries a heavy load or stands against a stop for half of the time about 0.5."""

_STRETCH = 0.5  # s; what a velocity's offset adds up to must stay small
_LEAST = 50
"""Samples from which the lag of a velocity is looked for."""
_TURNS = 4
"""Times that it is found again, from the last one."""
_SAMPLES, _LONGEST = 0.3, 0.2
"""A lag that is worth a word, in samples, and the longest that is one, s."""
_CLEAR = 0.25
"""Of what the integral of a velocity leaves of the position without a lag: what it may leave with it."""


def _threshold(log: Log, joint: str) -> float:
    """Motion worth the name: well above encoder ticks and friction's dead band."""
    return _MOVES_M if is_linear(log, joint) else _MOVES_RAD


def check_motion(log: Log, tracking: Mapping[str, Tracking], kinds: Mapping[str, str]) -> Iterator[Problem]:
    """Problems that show in command and position together, and channels that say nothing.

    A position follows a command of position; a torque or a speed of zero for a whole log is nothing to wonder at.
    """
    positions = [joint for joint, kind in kinds.items() if kind == "position"]
    swapped = _swapped(log, tracking)
    if swapped:
        pairs = some([f"{left} and {right}" for left, right in swapped])
        yield Problem(
            "joint.swapped",
            "error",
            pairs,
            "left and right look swapped: the position of each follows the command of the other, not its own",
            "swap the position columns (or the command columns) of these joints; check the rest of that side",
        )
    explained = {joint for pair in swapped for joint in pair}
    flipped = [joint for joint in tracking if joint not in explained and _flipped(log, joint, tracking[joint])]
    if flipped:
        yield Problem(
            "joint.sign",
            "error",
            some(flipped),
            "the position moves opposite to the command: one of the two has the wrong sign",
            f"negate the column that does not follow the model's joint axis; {TORQUES}",
        )
    yield from _stuck(log, positions)
    left = {j: t for j, t in tracking.items() if j not in explained and j not in flipped}
    yield from _late(log, left)
    yield from _unrelated(log, left)
    yield from _late_velocities(log)
    yield from _dead(log, positions)
    yield from _clipped_sensors(log)


# --- left and right, sign, lag ------------------------------------------------------------------------------


def _misfit(command: Tracking, position: Tracking, lag: int) -> float:
    """Mean square distance of a position to a command, offsets included."""
    a, b = command.at_lag(lag, position)
    return float(np.mean((a - b) ** 2)) if len(a) else np.inf


def _swapped(log: Log, tracking: Mapping[str, Tracking]) -> list[tuple[str, str]]:
    found: list[tuple[str, str]] = []
    for left, a in tracking.items():
        right = mirror_name(left)
        if right is None or right not in tracking:
            continue
        b = tracking[right]
        still = not (moves(a, _threshold(log, left)) or moves(b, _threshold(log, right)))
        # Walking swings both legs alike, half a period apart: a small lag only, and offsets count.
        lags = range(round(0.1 / a.step) + 1)
        own = min(_misfit(a, a, lag) + _misfit(b, b, lag) for lag in lags)
        across = [_misfit(a, b, lag) + _misfit(b, a, lag) for lag in lags]
        lag = int(np.argmin(across))
        follows = min(a.correlation(lag, b), b.correlation(lag, a))
        # Two joints held still can only be told apart by where they are held.
        apart = still and own > 2 * (5 * _threshold(log, left)) ** 2 and across[lag] < 0.02 * own
        if apart or (across[lag] < 0.25 * own and follows > 0.8):
            found.append((left, right))
    return found


def _flipped(log: Log, joint: str, pair: Tracking) -> bool:
    if not moves(pair, _threshold(log, joint)):
        return False
    lags = range(round(0.1 / pair.step) + 1)
    return max(pair.correlation(lag) for lag in lags) < -0.8


def _late(log: Log, tracking: Mapping[str, Tracking]) -> Iterator[Problem]:
    lags: dict[str, float] = {}
    for joint, pair in tracking.items():
        if not moves(pair, _threshold(log, joint)):
            continue
        normal = max(pair.correlation(lag) for lag in range(round(_MAX_LAG / pair.step) + 1))
        if normal > 0.85:
            continue
        duration = len(pair.command) * pair.step
        reach = min(_SEARCHED_LAG, duration / 4)
        lag, r = best_lag(pair, -reach, reach)
        seconds = lag * pair.step
        # What overlaps at that lag must show the whole motion: pieces of two ramps always match somewhere.
        overlap, _ = pair.at_lag(lag)
        whole = spread(overlap) > 0.9 * spread(pair.command[pair.valid])
        if whole and r > max(0.9, normal + 0.1) and not 0 <= seconds <= _MAX_LAG:
            lags[joint] = seconds
    for kind, chosen in (
        ("late", {joint: lag for joint, lag in lags.items() if lag > 0}),
        ("early", {joint: lag for joint, lag in lags.items() if lag < 0}),
    ):
        if not chosen:
            continue
        worst = max(chosen.values(), key=abs)
        text = (
            f"the position follows the command {abs(worst):.2f} s late; a servo takes about 0.1 s"
            if kind == "late"
            else f"the position moves {abs(worst):.2f} s before the command"
        )
        yield Problem(
            f"joint.{kind}",
            "warning",
            some(f"{joint} ({lag:+.2f} s)" for joint, lag in chosen.items()),
            f"{text}: command and position seem to come from different clocks",
            f"if they were started apart: --shift command={worst:.2f}; if the robot moves to each target over a set "
            "time, log the interpolated command instead",
        )


def _late_velocities(log: Log) -> Iterator[Problem]:
    """Velocities that lag behind their positions, as filters and backward differences do."""
    lags = {joint: lag for joint in log.joints("velocity") if (lag := _lag_of_velocity(log, joint))}
    if not lags:
        return
    typical = float(np.median([*lags.values()]))
    yield Problem(
        "velocity.late",
        "note",
        some(f"{joint} ({1e3 * lag:+.1f} ms)" for joint, lag in lags.items()),
        f"the velocity lags {1e3 * typical:.1f} ms behind the position, as a filter or a backward difference does",
        f"nothing where positions alone are fitted; --shift velocity={-typical:.4f} puts it right",
    )


def _lag_of_velocity(log: Log, joint: str) -> float:
    """By how much a velocity comes later than its position moves, s; 0 where that is not clear.

    What the integral of the velocity leaves of the position is, to first order, the lag times the velocity, beside a
    constant in each stretch of time.
    """
    if not log.has("position", joint) or len(log.episodes()) > 1:
        return 0.0
    columns = np.stack([log.time, log.channels[f"position.{joint}"], log.channels[f"velocity.{joint}"]])
    time, position, velocity = columns[:, np.isfinite(columns).all(axis=0)]
    if len(time) < _LEAST or not (np.diff(time) > 0).all() or not np.ptp(position) > _threshold(log, joint):
        return 0.0
    stretch = np.unique(np.floor((time - time[0]) / _STRETCH), return_inverse=True)[1]
    period, lag, left = float(np.median(np.diff(time))), 0.0, list[float]()
    for _ in range(_TURNS):
        moved = np.interp(time + lag, time, velocity)
        moved = np.concatenate([[0.0], np.cumsum(0.5 * np.diff(time) * (moved[1:] + moved[:-1]))])
        off, speed = (x - _means(x, stretch) for x in (position - moved, velocity))
        left.append(float(off @ off))
        lag += float(off @ speed) / max(float(speed @ speed), 1e-300)
    return lag if _SAMPLES * period < lag < _LONGEST and left[-1] < _CLEAR * left[0] else 0.0


def _means(values: FloatArray, label: IntArray) -> FloatArray:
    """(n,) mean of the values that share a label."""
    total, count = np.bincount(label, values), np.bincount(label)
    return np.asarray((total / np.maximum(count, 1))[label])


def _unrelated(log: Log, tracking: Mapping[str, Tracking]) -> Iterator[Problem]:
    found = []
    for joint, pair in tracking.items():
        threshold, within = _threshold(log, joint), min(_SEARCHED_LAG, len(pair.command) * pair.step / 4)
        if not (moves(pair, threshold) and spread(pair.position[pair.valid]) > threshold):
            continue
        alone = hides_motion(log.channels[f"position.{joint}"], log.channels[f"command.{joint}"])
        if not alone and abs(best_lag(pair, -within, within)[1]) < _UNRELATED:
            found.append(joint)
    if found:
        yield Problem(
            "joint.unrelated",
            "warning",
            some(found),
            "the position moves, and at no lag as the command does",
            "check that both columns are of this joint and of one recording; if its servo was off, log `enabled`",
        )


# --- stuck, saturated, dead ---------------------------------------------------------------------------------


def _constant_runs(values: FloatArray) -> IntArray:
    """Runs of equal finite values, rows (start, stop), at least 2 samples long."""
    same = np.diff(values) == 0
    found = runs(same)
    found[:, 1] += 1
    return found


def _tick(values: FloatArray) -> float:
    """Smallest step between different values: the sensor's resolution, or its noise."""
    steps = np.abs(np.diff(values[np.isfinite(values)]))
    steps = steps[steps > 1e-12]
    return float(np.percentile(steps, 5)) if len(steps) else 0.0


def _frozen(log: Log, joint: str, command: FloatArray, start: int, stop: int) -> bool:
    """Whether a constant run is a sensor that stopped, rather than a joint held by friction.

    A joint held by friction comes to rest and leaves smoothly, and shows the sensor's usual noise meanwhile.
    """
    values = log.channels[f"position.{joint}"]
    steps = np.abs(np.diff(values))
    tick = _tick(values)
    outside = np.concatenate((steps[:start], steps[stop:]))
    outside = outside[np.isfinite(outside)]
    # A robot may wait at rest when the log begins, so this says nothing there.
    never_still_otherwise = start > 0 and len(outside) > 10 and np.mean(outside == 0) < 0.05
    before = steps[max(start - 3, 0) : start]
    moving = outside[outside > 0]
    quick = max(5 * tick, float(np.median(moving)) if len(moving) else 0.0)
    in_flight = len(before) == 3 and float(np.median(before)) > quick
    leap = float(steps[stop - 1]) if stop <= len(steps) else 0.0
    usual = float(np.percentile(outside, 99)) if len(outside) else 0.0
    leaps_out = leap > max(5 * tick, 3 * usual)
    velocity = log.channels.get(f"velocity.{joint}")
    speeds = velocity is not None and _speeds_through(velocity, log, values, start, stop)
    within = command[start:stop]
    path = float(np.nansum(np.abs(np.diff(within))))
    whole_cycle = spread(within) > 0.9 * spread(command) and path > 1.8 * spread(command)
    return bool(never_still_otherwise or in_flight or leaps_out or speeds or whole_cycle)


def _speeds_through(velocity: FloatArray, log: Log, values: FloatArray, start: int, stop: int) -> bool:
    """Whether the velocity sensor saw real motion during the run: over a tenth of the position's whole spread."""
    speed = velocity[start:stop]
    if not np.all(np.isfinite(speed)):
        return False
    speed = np.where(np.abs(speed) > 3 * _tick(velocity), speed, 0.0)  # an offset of a tick is no motion
    covered = np.cumsum(speed[:-1] * np.diff(log.time[start:stop]))
    return spread(covered) > 0.1 * spread(values)


def _stuck(log: Log, joints: Sequence[str]) -> Iterator[Problem]:
    dead: list[str] = []
    partly: dict[str, str] = {}
    pinned: dict[str, str] = {}
    for joint in joints:
        column = f"position.{joint}"
        if column not in log.channels:
            continue
        values = log.channels[column]
        on = driven(log, joint)
        command = np.where(on, log.channels[f"command.{joint}"], np.nan)
        motion = spread(command)
        if motion <= _threshold(log, joint) or not np.any(np.isfinite(values)):
            continue
        if spread(values) == 0:
            dead.append(joint)
            continue
        needed = max(_threshold(log, joint), 8 * _tick(values), 0.15 * motion)
        extremes = (np.nanmin(values[np.isfinite(values)]), np.nanmax(values[np.isfinite(values)]))
        longest: tuple[float, int, int] = (0.0, 0, 0)
        for start, stop in _constant_runs(values):
            duration = abs(float(log.time[stop - 1] - log.time[start]))
            if duration < _STUCK_FOR or stop - start < 5 or spread(command[start:stop]) <= needed:
                continue
            if _frozen(log, joint, command, int(start), int(stop)):
                longest = max(longest, (duration, int(start), int(stop)))
        if longest[0] > 0:
            _, start, stop = longest
            moved = spread(command[start:stop])
            text = f"{joint}, {at(log, start, stop)}: the command moves {moved:.3g}"
            (pinned if values[start] in extremes else partly)[joint] = text
    if dead:
        yield Problem(
            "position.stuck",
            "error",
            by_channel([f"position.{joint}" for joint in dead]),
            "the position is one constant value for the whole log while the command moves",
            "check the encoder and its column; if the joint was locked or its servo off, "
            "log `enabled` or leave the joint out",
        )
    if partly:
        yield Problem(
            "position.stuck",
            "error",
            "; ".join(partly.values()),
            "the position repeats exactly one value while the command moves: "
            "the sensor, or the bus it is on, has stopped reporting",
            "cut this stretch out, or set these positions to NaN",
        )
    if pinned:
        yield Problem(
            "position.saturated",
            "warning",
            "; ".join(pinned.values()),
            "the position stays exactly at its largest or smallest value while the command moves on: "
            "a saturated sensor, or a joint at its end stop",
            "set these positions to NaN if the sensor was saturated; give the model the joint's range if it is an end "
            "stop",
        )


def _travel(log: Log, joint: str) -> float:
    """How far the joint moved while its servo was on."""
    position = log.channels.get(f"position.{joint}")
    return 0.0 if position is None else spread(position[driven(log, joint)])


def _dead(log: Log, joints: Sequence[str]) -> Iterator[Problem]:
    silent: list[str] = []
    unmoved: list[str] = []
    forces_vary = any(spread(log.channels[f"force.{site}"]) > 0 for site in log.joints("force"))
    for column, values in log.channels.items():
        if not np.any(np.isfinite(values)) or spread(values) > 0:
            continue
        channel, _, name = column.partition(".")
        if channel in ("velocity", "effort", "current", "duty"):
            if _travel(log, name) > _threshold(log, name):
                silent.append(column)
        elif (channel == "imu" and log.meta.mount == "free") or (channel == "force" and forces_vary):
            silent.append(column)
        elif channel == "command" and name in joints and _travel(log, name) > 15 * _threshold(log, name):
            unmoved.append(name)
    if silent:
        yield Problem(
            "channel.dead",
            "warning",
            by_channel(silent),
            "the column is one constant value while the robot moves: it carries no measurement",
            "leave it out, or check the sensor and the recorder",
        )
    if unmoved:
        yield Problem(
            "command.dead",
            "warning",
            by_channel([f"command.{joint}" for joint in unmoved]),
            "the command never changes while the position moves a lot",
            "check the command column; if the servo was off, log `enabled` or `stiffness`",
        )


def _clipped_sensors(log: Log) -> Iterator[Problem]:
    clipped: list[str] = []
    for column, values in log.channels.items():
        channel = column.partition(".")[0]
        if channel not in ("imu", "force") or spread(values) == 0:
            continue
        finite = values[np.isfinite(values)]
        # A foot in the air reads zero for long: only the upper end of a force is saturation.
        ends = [float(finite.max())] if channel == "force" else [float(finite.max()), float(finite.min())]
        for end in ends:
            at_end = runs(values == end)
            at_end = at_end[at_end[:, 1] - at_end[:, 0] >= 3]
            before = at_end[:, 0] - 1
            jumps = np.abs(end - values[before[before >= 0]])
            held = int(np.sum(at_end[:, 1] - at_end[:, 0]))
            if held >= 10 and len(jumps) and np.median(jumps) > 3 * _tick(values):
                clipped.append(f"{column} at {end:.4g} ({held} samples)")
    if clipped:
        yield Problem(
            "sensor.saturated",
            "warning",
            some(clipped, 8),
            "the sensor is saturated: the true values lie beyond",
            "set these samples to NaN, or choose a larger measuring range",
        )
