"""Patterns in a signal: pulses, what repeats with time or angle, and what a state explains of it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from sysid_btr._typing import BoolArray, FloatArray, IntArray
from sysid_btr.terms.servo import sampled

GROW = 1.25
"""Ratio of neighbouring pulse lengths that are tried."""
FOLDS = 5
BINS = 40
"""Bins of one period when a signal is folded."""
REPEATS = 4
"""Times that a period must fit into a signal."""
MOST_PERIODS = 6000
NEGLIGIBLE = 1e-8
"""Singular value, relative to the largest, of a direction that columns of a design do not have."""
FASTEST, SLOWEST = 0.01, 0.2
"""Seconds between commands that a drive takes: hobby servos to slow buses. What is faster is a delay."""
GLANCE = 8.0
"""Seconds of a log in which these are sought first."""
STARTS, MOST_PEAKS, NEAR, REFINEMENTS = 12, 12, 7, 3
"""Parts of a period in which the first command may be taken; periods that are refined, from how many, how often."""
SHORTER = 0.8
"""A shorter period is preferred if it explains at least this fraction of what the best one does."""


@dataclass(frozen=True)
class Box:
    """A rectangular pulse on a constant: samples [start, stop), height over the rest, share of the variance."""

    start: int
    stop: int
    height: float
    share: float

    def outside(self, count: int) -> BoolArray:
        """Which of so many samples are not in the pulse, (count,)."""
        rows = np.arange(count)
        return np.asarray((rows < self.start) | (rows >= self.stop))


@dataclass(frozen=True)
class Train:
    """Equal rectangular pulses at regular intervals: s, and the share of the variance they explain."""

    start: float
    duration: float
    period: float
    height: float
    share: float


@dataclass(frozen=True)
class Line:
    """A spatial frequency, rad per unit of position, and the share of the variance it explains."""

    number: float
    share: float


def best_box(signal: FloatArray, shortest: int) -> Box | None:
    """The pulse that explains most of a signal in the sense of least squares."""
    n = len(signal)
    total = float(np.sum((signal - signal.mean()) ** 2))
    if n < 8 * shortest or total == 0:
        return None
    sums = np.concatenate([[0.0], np.cumsum(signal - signal.mean())])

    def gains(a: IntArray, b: IntArray) -> FloatArray:
        length = np.maximum(b - a, 1)
        return np.where(b > a, (sums[b] - sums[a]) ** 2 * n / (length * np.maximum(n - length, 1)), 0.0)

    best, at = 0.0, (0, 1)
    length = float(max(shortest, 1))
    while length < n / 3:
        whole = round(length)
        a = np.arange(n - whole + 1, dtype=np.int64)
        gain = gains(a, a + whole)
        k = int(np.argmax(gain))
        if gain[k] > best:
            best, at = float(gain[k]), (k, k + whole)
        length = max(length * GROW, length + 1)
    reach = max((at[1] - at[0]) // 3, 2)
    near_start = np.clip(np.arange(at[0] - reach, at[0] + reach + 1, dtype=np.int64), 0, n - 1)
    near_stop = np.clip(np.arange(at[1] - reach, at[1] + reach + 1, dtype=np.int64), 1, n)
    grid = gains(near_start[:, None], near_stop[None, :])
    row, column = np.unravel_index(int(np.argmax(grid)), grid.shape)
    start, stop = int(near_start[row]), int(near_stop[column])
    height = (sums[stop] - sums[start]) / (stop - start) * n / (n - (stop - start))
    return Box(start, stop, float(height), float(grid[row, column]) / total)


def fold(signal: FloatArray, time: FloatArray, period: float, bins: int = BINS) -> tuple[FloatArray, FloatArray]:
    """Mean of a signal over its phase in a period, and how many samples each mean has; (bins,) each."""
    label = np.floor(time * (bins / period)).astype(np.int64) % bins
    count = np.bincount(label, minlength=bins)
    mean = np.bincount(label, signal, bins) / np.maximum(count, 1)
    return mean, count.astype(float)


def repetition(signal: FloatArray, time: FloatArray, period: float, span: float | None = None) -> float:
    """Share of a signal's variance that repeats with a period, less what a signal as smooth would by chance.

    `span` is the memory of the signal in samples, where known.
    """
    n, step = len(signal), float(time[1] - time[0])
    bins = int(min(BINS, max(period / step, 2)))
    mean, count = fold(signal - signal.mean(), time, period, bins)
    total = float(np.sum((signal - signal.mean()) ** 2))
    share = float(np.sum(count * mean**2)) / max(total, 1e-300)
    span = memory(signal) if span is None else span
    chance = min(bins, period / (span * step)) * span / n
    return (share - chance) / max(1 - chance, 1e-6)


def best_period(signal: FloatArray, time: FloatArray, shortest: float) -> tuple[float, float]:
    """The period that explains most of a signal by folding, not its multiples, and the share it explains."""
    duration = time[-1] - time[0]
    together = max(int(0.5 * shortest / BINS / (time[1] - time[0])), 1)
    whole = len(signal) // together * together
    signal = signal[:whole].reshape(-1, together).mean(axis=1)
    time = time[:whole:together]
    longest = duration / REPEATS
    if longest <= shortest:
        return 0.0, 0.0
    # neighbouring periods drift apart by half a bin over the whole signal
    count = int(2 * BINS * duration * (1 / shortest - 1 / longest)) + 2
    periods = 1 / np.linspace(1 / shortest, 1 / longest, min(count, MOST_PERIODS))
    span = memory(signal)
    shares = np.array([repetition(signal, time, p, span) for p in periods])
    best = int(np.argmax(shares))
    if shares[best] <= 0:
        return 0.0, 0.0
    # a multiple of the period does as well, and only by noise better
    enough = periods[shares >= SHORTER * shares[best]]
    near = np.flatnonzero((periods >= enough.min()) & (periods <= 1.05 * enough.min()))
    at = int(near[np.argmax(shares[near])])
    return float(periods[at]), float(shares[at])


def best_train(signal: FloatArray, time: FloatArray, period: float) -> Train:
    """The pulse train of about this period that explains most of a signal."""
    step = float(time[1] - time[0])
    bins = int(np.clip(period / step, 4, 400))
    mean, count = fold(signal - signal.mean(), time, period, bins)
    start, length = _circular_box(mean * count, count)
    train = np.array([start / bins * period, length / bins * period, period])
    # seen from a pulse in the middle, start and period are independent
    train[0] += np.round((0.5 * (time[0] + time[-1]) - train[0]) / period) * period
    span = time[-1] - time[0]
    scale = np.array([period / bins, period / bins, period / bins * period / span])
    best = _explained(signal, time, train)
    for _ in range(7):
        for i in range(3):
            trials = np.tile(train, (13, 1))
            trials[:, i] += np.linspace(-2, 2, 13) * scale[i]
            trials[:, 1:] = np.maximum(trials[:, 1:], step)
            shares = [_explained(signal, time, trial)[0] for trial in trials]
            k = int(np.argmax(shares))
            if shares[k] > best[0]:
                train, best = trials[k], _explained(signal, time, trials[k])
        scale *= 0.6
    first = float(np.mod(train[0], train[2]))
    return Train(first, float(train[1]), float(train[2]), best[1], best[0])


def best_sampling(
    torque: FloatArray, command: FloatArray, time: FloatArray, seen: Callable[[FloatArray], FloatArray]
) -> tuple[float, float, float] | None:
    """How a drive that takes its command only now and then would leave this torque: period, first moment, share of it.

    Parameters
    ----------
    torque, command : (n,).
    time : (n,) s, at equal intervals, from 0.
    seen : torques (n, k) as an estimate of `torque` would show them.

    Returns
    -------
    tuple or None
        None where no period does.
    """
    step, total = float(time[1] - time[0]), float(torque @ torque)
    count = min(round(GLANCE / step), len(time))
    first = int(np.argmax(np.convolve(np.diff(command, append=command[-1]) ** 2, np.ones(count), "valid")))
    glance = slice(first, first + count, max(int(0.5 * FASTEST / step), 1))
    # neighbouring periods drift apart by a quarter of one over the glance
    rates = np.arange(1 / SLOWEST, 1 / max(2 * step, FASTEST), 0.25 / (count * step))
    if len(rates) < 3 or total == 0:
        return None
    shares = np.array([_sampled_shares(torque[glance], command[glance], time[glance], 1 / r) for r in rates])
    most = shares.max(axis=1)
    peaks = 1 + np.flatnonzero((most[1:-1] > most[:-2]) & (most[1:-1] >= most[2:]))
    peaks = peaks[np.argsort(-most[peaks])[:MOST_PEAKS]]
    borders = np.append(time, time[-1] + step)[None]

    def refined(period: float, start: float, rows: slice) -> tuple[float, float, float]:
        """Share of the torque in some rows, period, and first moment near a guess."""
        many, own = np.broadcast_to(command, (NEAR**2, len(command))), torque[rows]
        # seen from the middle of what is looked at, moments and period are independent
        middle, change = 0.5 * (time[rows][0] + time[rows][-1]), np.linspace(-1, 1, NEAR)
        for _ in range(REFINEMENTS):
            near = start + np.round((middle - start) / period) * period
            wide = 0.25 * period**2 / (step * len(own)), period / STARTS
            periods, nears = (x.ravel() for x in np.meshgrid(period + change * wide[0], near + change * wide[1]))
            starts = np.mod(nears, periods)
            shown = seen((sampled(many, borders, periods[:, None], starts[:, None]) - command).T)[rows]
            size = np.einsum("nk,nk->k", shown, shown) * float(own @ own)
            share = np.maximum(own @ shown, 0.0) ** 2 / np.maximum(size, 1e-300)
            k = int(np.argmax(share))
            period, start, change = float(periods[k]), float(starts[k]), 0.4 * change
        return float(share[k]), period, start

    rows = slice(first, first + count)
    guesses = [(1 / float(rates[p]), int(np.argmax(shares[p])) / STARTS / float(rates[p])) for p in peaks]
    share, period, start = max((refined(*guess, rows) for guess in guesses), default=(0.0, 0.0, 0.0))
    while share > 0 and rows != slice(0, len(time)):
        longer = (rows.stop - rows.start) // 2
        rows = slice(max(rows.start - longer, 0), min(rows.stop + longer, len(time)))
        share, period, start = refined(period, start, rows)
    return (period, start, share) if share > 0 else None


def _sampled_shares(torque: FloatArray, command: FloatArray, time: FloatArray, period: float) -> FloatArray:
    """Share of a torque that commands taken once a period explain, by the first moment in it, (STARTS,)."""
    bins = np.arange(STARTS)
    lag = period / STARTS * (bins[:, None] + 0.5)
    late = np.interp(time - lag, time, command) - command
    label = np.floor(time * (STARTS / period)).astype(np.int64) % STARTS * STARTS + bins[:, None]
    inner, size = (
        np.bincount(label.ravel(), x.ravel(), STARTS**2).reshape(STARTS, STARTS) for x in (torque * late, late**2)
    )
    # in which part of the period a sample is, and how late its command is then if these are taken in another part
    part, taken = bins[:, None], (bins[:, None] - bins) % STARTS
    square = np.maximum(inner[part, taken].sum(axis=0), 0.0) ** 2
    return np.asarray(square / np.maximum(size[part, taken].sum(axis=0) * float(torque @ torque), 1e-300))


def _circular_box(sums: FloatArray, count: FloatArray) -> tuple[int, int]:
    """Start and length of the stretch of a circle that differs most from the rest."""
    bins, n = len(sums), count.sum()
    s = np.concatenate([[0.0], np.cumsum(np.tile(sums, 2))])
    c = np.concatenate([[0.0], np.cumsum(np.tile(count, 2))])
    best, at = -1.0, (0, 1)
    for length in range(1, bins // 2 + 1):
        inside = s[length : bins + length] - s[:bins]
        size = c[length : bins + length] - c[:bins]
        gain = inside**2 * n / np.maximum(size * (n - size), 1)
        k = int(np.argmax(gain))
        if gain[k] > best:
            best, at = float(gain[k]), (k, length)
    return at


def _explained(signal: FloatArray, time: FloatArray, train: FloatArray) -> tuple[float, float]:
    """Share of the variance that a train (start, duration, period) explains, and its height."""
    on = np.mod(time - train[0], train[2]) < train[1]
    inside = int(on.sum())
    if inside in (0, len(on)):
        return 0.0, 0.0
    height = float(signal[on].mean() - signal[~on].mean())
    total = float(np.sum((signal - signal.mean()) ** 2))
    share = height**2 * inside * (len(on) - inside) / len(on) / max(total, 1e-300)
    return share, height


def hats(x: FloatArray, knots: FloatArray) -> FloatArray:
    """Piecewise linear functions of x that are 1 at one knot each, (n, knots)."""
    return np.column_stack([np.interp(x, knots, unit) for unit in np.eye(len(knots))])


def even_knots(x: FloatArray, most: int) -> FloatArray:
    """Knots at quantiles, so that every hat has data."""
    knots = np.unique(np.quantile(x, np.linspace(0, 1, most)))
    return knots if len(knots) > 1 else np.array([x.min(), x.min() + 1.0])


def predicted_share(signal: FloatArray, design: FloatArray, block: int) -> float:
    """Share of a signal's variance that a linear model predicts on stretches it was not fitted to.

    Parameters
    ----------
    signal : (n,).
    design : (n, k); a constant is added.
    block : samples in a stretch; every fifth one is predicted from the others.
    """
    n = len(signal)
    x = np.column_stack([np.ones(n), design])
    size = np.sqrt(np.mean(x**2, axis=0))
    x = x / np.where(size > 0, size, 1.0)
    fold_of = (np.arange(n) // max(block, 1) * 2) % FOLDS
    grams = [x[fold_of == f].T @ x[fold_of == f] for f in range(FOLDS)]
    inner = [x[fold_of == f].T @ signal[fold_of == f] for f in range(FOLDS)]
    gram, target = sum(grams), sum(inner)
    ridge = 1e-4 * n * np.eye(x.shape[1])
    left = total = 0.0
    for f in range(FOLDS):
        test = fold_of == f
        if not test.any() or test.all():
            continue
        weights = np.linalg.solve(gram - grams[f] + ridge, target - inner[f])
        left += float(np.sum((signal[test] - x[test] @ weights) ** 2))
        total += float(np.sum((signal[test] - signal[~test].mean()) ** 2))
    return 1 - left / total if total > 0 else 0.0


def without(signal: FloatArray, design: FloatArray, by: BoolArray | None = None) -> FloatArray:
    """What a linear model and a constant leave of a signal, or of signals (n, k).

    `by` are the samples (n,) that determine the model; None for all.
    """
    rows = slice(None) if by is None else by
    x = _unit_columns(design)
    return np.asarray(signal - x @ np.linalg.lstsq(x[rows], signal[rows], rcond=NEGLIGIBLE)[0])


def line_shares(signal: FloatArray, sines: Sequence[FloatArray], design: FloatArray) -> FloatArray:
    """Share of a signal's variance that each pair of columns explains beyond a design."""
    whole, values, _ = np.linalg.svd(_unit_columns(design), full_matrices=False)
    basis = whole[:, values > NEGLIGIBLE * values[0]]
    base = signal - basis @ (basis.T @ signal)
    total = float(base @ base)
    shares = []
    for pair in sines:
        rest = pair - basis @ (basis.T @ pair)
        gram = rest.T @ rest + 1e-9 * float(np.sum(pair**2)) * np.eye(pair.shape[1])
        inner = rest.T @ base
        shares.append(float(inner @ np.linalg.solve(gram, inner)) / max(total, 1e-300))
    return np.array(shares)


def _unit_columns(design: FloatArray) -> FloatArray:
    """A constant and the columns (n, k) of a design, each of unit length."""
    x = np.column_stack([np.ones(len(design)), design])
    size = np.linalg.norm(x, axis=0)
    return np.asarray(x / np.where(size > 0, size, 1.0))


def memory(signal: FloatArray) -> float:
    """Samples over which a signal resembles itself: the sum of its autocorrelation to the first zero."""
    n = len(signal)
    spectrum = np.abs(np.fft.rfft(signal - signal.mean(), 2 * n)) ** 2
    correlation = np.fft.irfft(spectrum)[: n // 2]
    if correlation[0] <= 0:
        return 1.0
    correlation = correlation / correlation[0]
    below = np.flatnonzero(correlation <= 0)
    end = int(below[0]) if len(below) else len(correlation)
    return float(1 + 2 * np.sum(correlation[1:end]))
