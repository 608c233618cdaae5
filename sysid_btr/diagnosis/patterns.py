"""Patterns in a missing torque: pulses, what repeats with time or angle, commands that are taken now and then.

The torque that would explain a position error (`sysid_btr.identify.missing_torque`) is local in time where the error is
smeared out by the servo.
"""

from __future__ import annotations

import numpy as np

from sysid_btr._typing import FloatArray
from sysid_btr.diagnosis import signal_features
from sysid_btr.diagnosis.signal_features import Line, Train, best_sampling, without
from sysid_btr.identify.missing_torque import MissingTorque

LOUD = 1.3
"""Chi2 of a joint's position from which its error is looked at."""
CLEAR = 50.0
"""A pulse stands out if it explains this many times what noise of the same colour would."""
SHORTEST_PULSE = 0.02
SHORTEST_PERIOD = 0.3
"""Seconds."""
EVEN = 0.3
"""Difference, relative to a pulse, below which pulses and gaps are equally far from no torque."""
TRAIN_SHARE = 0.15
"""Share of the variance that a pulse train, or intervals between commands, must explain to be proposed."""
LINE_SHARE, LINE_CLEAR = 0.03, 8.0
"""Share of the variance that a spatial frequency must explain, alone and relative to the median one."""
LINES = 2
OWN_RHYTHM = 0.6
"""Share of the velocity that repeats with a period, from which that period is the motion's own."""


def blame(one: MissingTorque) -> float:
    """Excess over the noise floor, as far as a torque at this joint, not at others, explains it."""
    power = float(np.mean(one.torque**2))
    return (one.chi2 - 1) * max(power - one.noise**2, 0.0) / max(power, 1e-300)


def scaled(x: FloatArray) -> FloatArray:
    """Centred, with a largest value of one."""
    centred = x - x.mean()
    return np.asarray(centred / max(float(np.abs(centred).max()), 1e-300))


def of_motion(one: MissingTorque, degree: int = 3) -> FloatArray:
    """What friction, inertia, springs and gravity explain, to be set aside before searching; (n, 3 + degree)."""
    q = scaled(one.position)
    powers = [q**k for k in range(1, degree + 1)]
    columns = (one.direction, one.velocity, one.acceleration, *powers)
    return one.seen(np.column_stack([scaled(c) for c in columns]))


def spatial_lines(one: MissingTorque) -> list[Line]:
    """Spatial frequencies at which the torque repeats with the joint's angle, best first, at most two."""
    span = float(np.ptp(one.position))
    if span <= 0:
        return []
    together = -(-len(one.torque) // 4096)
    rows = slice(None, None, together)
    turn = 2 * np.pi / span
    # a line faster than the sensor resolves leaves nothing, whatever its spatial frequency
    fastest = 0.5 / (together * one.period) / max(float(np.median(np.abs(one.velocity))), 1e-300) * 2 * np.pi
    numbers = np.arange(turn, min(200 * turn, max(fastest, 4 * turn)), 0.4 * turn)
    motion = of_motion(one, 1)[rows]

    def shares(at: FloatArray) -> FloatArray:
        pairs = [one.seen(np.column_stack([np.sin(n * one.position), np.cos(n * one.position)]))[rows] for n in at]
        return signal_features.line_shares(one.torque[rows], pairs, motion)

    found = shares(numbers)
    if len(found) < 5:
        return []
    clear = max(LINE_SHARE, LINE_CLEAR * float(np.median(found)))
    inner = np.flatnonzero((found[1:-1] >= found[:-2]) & (found[1:-1] >= found[2:]) & (found[1:-1] > clear)) + 1
    lines = []
    for k in inner[np.argsort(-found[inner])][:LINES]:
        near = numbers[k] + turn * np.linspace(-0.4, 0.4, 17)
        sharper = shares(near)
        at = int(np.argmax(sharper))
        lines.append(Line(float(near[at]), float(sharper[at])))
    return lines


def sampling(one: MissingTorque) -> tuple[float, float] | None:
    """Period and first moment at which a drive takes its command, where that would explain what a delay leaves."""
    rest = one.beside(np.gradient(one.command)[:, None])
    found = best_sampling(rest.torque, rest.command, rest.time, rest.seen)
    return found[:2] if found is not None and found[2] >= TRAIN_SHARE else None


def single_pulse(one: MissingTorque) -> tuple[float, float] | None:
    """Start (s since the first sample) and duration of the clearest pulse, or None."""
    motion, shortest = of_motion(one), max(round(SHORTEST_PULSE / one.period), 2)
    first = signal_features.best_box(without(one.torque, motion), shortest)
    if first is None:
        return None
    # what the motion explains is determined by the rest of the log, else it takes a part of the pulse
    rest = without(one.torque, motion, by=first.outside(len(motion)))
    box = signal_features.best_box(rest, shortest)
    if box is None:
        return None
    length = box.stop - box.start
    if not stands_out(one, box.height**2 * length, rest[box.outside(len(rest))], length):
        return None
    return float(one.time[box.start]), length * one.period


def stands_out(one: MissingTorque, explained: float, rest: FloatArray, length: float) -> bool:
    """Whether an event of so many samples explains far more, in squares, than noise of the colour of the rest would."""
    others = rest - np.median(rest)
    noise = max(1.4826 * float(np.median(np.abs(others))), one.noise)
    return bool(explained >= CLEAR * noise**2 * max(min(signal_features.memory(others), length), 1.0))


def pulse_train(one: MissingTorque) -> tuple[float, float, float] | None:
    """Start, duration and period of equal pulses at regular intervals that are not the motion's own, or None."""
    rest = without(one.torque, of_motion(one))
    period, share = signal_features.best_period(rest, one.time, SHORTEST_PERIOD)
    if share < TRAIN_SHARE or is_own_rhythm(one, period):
        return None
    train = upright(one, signal_features.best_train(rest, one.time, period))
    return (train.start, train.duration, train.period) if train.share >= TRAIN_SHARE else None


def upright(one: MissingTorque, train: Train) -> Train:
    """The train or the gaps between its pulses: whichever leaves nothing where it is off.

    Where a fitted constant torque has taken its share of both, the one that comes first.
    """
    gaps = Train(
        start=(train.start + train.duration) % train.period,
        duration=train.period - train.duration,
        period=train.period,
        height=-train.height,
        share=train.share,
    )
    on = np.mod(one.time - train.start, train.period) < train.duration
    if on.all() or not on.any():
        return train
    off, inside = abs(float(np.median(one.torque[~on]))), abs(float(np.median(one.torque[on])))
    if abs(off - inside) < EVEN * abs(train.height):
        return min(train, gaps, key=lambda t: t.start)
    return train if off < inside else gaps


def is_own_rhythm(one: MissingTorque, period: float) -> bool:
    """Whether a period is one of the motion."""
    return signal_features.repetition(one.velocity, one.time, period) > OWN_RHYTHM
