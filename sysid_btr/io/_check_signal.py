"""Positions that are no measurement: noise alone, a copy of the command, counts of an encoder, or next to none."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np

from sysid_btr._typing import FloatArray
from sysid_btr.io._text import by_channel, spread
from sysid_btr.io.log import Log
from sysid_btr.io.noise import MIN_SAMPLES, hides_motion
from sysid_btr.io.problem import Problem

_COPIED_WITHIN = 3
"""Samples by which a copy of the command may be late."""
_COUNTS = 8
"""Whole values, at least, that make a column one of counts; a joint that is stepped through 0, 1, 2 rad has fewer."""


def check_signal(log: Log, tracked: Iterable[str]) -> Iterator[Problem]:
    """Problems of positions that cannot have been measured at these joints.

    Parameters
    ----------
    log : with absurd values made missing.
    tracked : joints that are commanded a position, and are logged.
    """
    longest = max((rows.stop - rows.start for rows in log.episodes()), default=0)
    if longest < MIN_SAMPLES:
        yield Problem(
            "log.short",
            "error",
            "time",
            f"no episode has more than {longest} samples; the noise of a sensor shows in {MIN_SAMPLES} at least",
            "record some seconds of motion; if every row has an episode number of its own, leave `episode` out",
        )
    joints = tuple(tracked)
    copied = [joint for joint in joints if _copied(log, joint)]
    if copied:
        yield Problem(
            "position.copied",
            "error",
            by_channel([f"position.{joint}" for joint in copied]),
            "the position is a copy of the command, to the last digit: no encoder measured it",
            "log what the encoder says; some drivers echo the target where they have no position",
        )
    noise = [joint for joint in joints if _noise_alone(log, joint)]
    if noise:
        yield Problem(
            "position.noise",
            "error",
            by_channel([f"position.{joint}" for joint in noise]),
            "the position is noise alone: each sample is independent of the one before, while the command moves by "
            "more than would stay hidden in it",
            "check the sensor, its cable and its column, or leave the joint's position out",
        )
    counts = [joint for joint in log.joints("position") if _counts(log.channels[f"position.{joint}"])]
    if counts:
        yield Problem(
            "units.counts",
            "error",
            by_channel([f"position.{joint}" for joint in counts]),
            "every value is a whole number: these are counts of an encoder, not rad (or m)",
            "multiply by the angle of a count, 2 pi / (counts per turn), and subtract the zero",
        )


def _copied(log: Log, joint: str) -> bool:
    command, position = log.channels[f"command.{joint}"], log.channels[f"position.{joint}"]
    if spread(position) == 0:
        return False
    return any(
        np.array_equal(command[: len(command) - late], position[late:], equal_nan=True)
        for late in range(min(_COPIED_WITHIN + 1, len(command)))
    )


def _noise_alone(log: Log, joint: str) -> bool:
    return hides_motion(log.channels[f"position.{joint}"], log.channels[f"command.{joint}"])


def _counts(values: FloatArray) -> bool:
    finite = values[np.isfinite(values)]
    return bool(np.all(finite == np.round(finite))) and len(np.unique(finite)) >= _COUNTS
