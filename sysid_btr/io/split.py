"""Training and held-out parts of a log."""

from __future__ import annotations

import numpy as np

from sysid_btr._typing import BoolArray, FloatArray
from sysid_btr.errors import LogError, UsageError
from sysid_btr.io._clock import typical_interval
from sysid_btr.io.log import Log


def holdout_split(log: Log, holdout: float = 0.3) -> tuple[Log, Log]:
    """Split a log in time: the first part to fit, the last to judge the fit.

    Parameters
    ----------
    log : Log
        One or more episodes; their durations add up, jumps of the clock between them do not count.
    holdout : float
        Fraction of the time to hold out, between 0 and 1 (both excluded).

    Returns
    -------
    train, holdout : Log
        All samples, in order, none in both. The cut may fall inside an episode.

    Raises
    ------
    UsageError
        If `holdout` is not between 0 and 1.
    LogError
        If a part would have fewer than 2 samples.
    """
    if not 0 < holdout < 1:
        raise UsageError(f"the held-out fraction must lie between 0 and 1 (both excluded), not {holdout}")
    cut = 0
    if len(log) >= 4:
        steps = np.diff(log.time)
        borders = np.flatnonzero(np.diff(log.episode))
        steps[borders] = typical_interval(log.time)
        elapsed = np.concatenate(([0.0], np.cumsum(steps)))
        cut = int(np.searchsorted(elapsed, (1 - holdout) * elapsed[-1] * (1 - 1e-12)))
    if cut < 2 or len(log) - cut < 2:
        raise LogError(
            f"the log has {len(log)} samples: too few to hold out {holdout:g} of it (each part needs 2); "
            "record more, or give a second log to hold out"
        )
    return log.window(0, cut), log.window(cut, len(log))


def held_out_all_over(time: FloatArray, share: float, parts: int) -> BoolArray:
    """Samples to hold out where all of a recording is to be seen: every n-th of its parts, but not the last one.

    Parameters
    ----------
    time : (n,) s.
    share : about the fraction of the time to hold out.
    parts : of equal duration, into which it is cut.

    Returns
    -------
    BoolArray
        (n,) samples that are held out; none where there are too few parts.
    """
    every = max(round(1 / share), 2)
    part = np.minimum(parts * (time - time[0]) / (time[-1] - time[0]), parts - 1).astype(np.int64)
    return np.asarray((part % every == every - 1) & (part < parts - 1))


def spans_of(time: FloatArray, samples: BoolArray) -> tuple[tuple[float, float], ...]:
    """First and last time, s since the first sample, of each run of samples, (n,), that follow one another."""
    ends = np.flatnonzero(np.diff(samples, prepend=False, append=False)).reshape(-1, 2)
    since = time - time[0]
    return tuple((float(since[begin]), float(since[end - 1])) for begin, end in ends)


def split_episodes(log: Log) -> tuple[Log, ...]:
    """Each episode of a log as a log of its own; those of a single sample are left out.

    Asked again they are the same logs, so that what was found of them is not sought anew.

    Raises
    ------
    LogError
        If none is left.
    """
    long = [rows for rows in log.episodes() if rows.stop - rows.start > 1]
    if not long:
        raise LogError(
            f"log {log.path or ''}: none of its {len(log.episodes())} episodes has two samples; leave `episode` out if "
            "it numbers the samples"
        )
    return log.once(("episodes",), lambda: tuple(log.window(rows.start, rows.stop) for rows in long))
