"""Streams of a log that were started apart, put onto one clock."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from sysid_btr._typing import FloatArray
from sysid_btr.io.log import COMMANDS, Log
from sysid_btr.io.resample import holds


def shift_streams(log: Log, seconds: Mapping[str, float]) -> Log:
    """The log with some of its streams later, each episode by itself.

    Parameters
    ----------
    log : as read.
    seconds : channel or column -> s by which its values come later; negative for earlier.

    Returns
    -------
    Log
        Commands before the first, or after the last, known one keep that; sensors are missing (NaN) there. Between
        samples commands are held, or interpolated where the robot does, and sensors are interpolated.
    """
    channels = dict(log.channels)
    for column, values in log.channels.items():
        channel = column.partition(".")[0]
        late = seconds.get(column, seconds.get(channel, 0.0))
        if late:
            moved = values.copy()
            for rows in log.episodes():
                moved[rows] = _later(log, channel, log.time[rows], values[rows], late)
            channels[column] = moved
    return replace(log, channels=channels)


def _later(log: Log, channel: str, time: FloatArray, values: FloatArray, late: float) -> FloatArray:
    wanted = time - late
    if holds(log, channel):
        at = np.clip(np.searchsorted(time, wanted + 1e-9, side="right") - 1, 0, len(time) - 1)
        return np.asarray(values[at])
    good = np.isfinite(values)
    if not good.any():
        return values
    found = np.interp(wanted, time[good], values[good])
    if channel not in COMMANDS:
        found[(wanted < time[0]) | (wanted > time[-1])] = np.nan
    return np.asarray(found)
