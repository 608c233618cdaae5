"""Noise floor of each sensor, stated or from the log itself: what no model can explain.

Two estimates, the larger wins. High-frequency content: the motion of a robot is smooth on the scale of a
few samples, so high-order differences of a sensor hold its white noise alone; cutting them at a multiple of
their median keeps impacts and reversals out (Hall, Kay, Titterington 1990, doi:10.1093/biomet/77.3.521). Quantisation:
the smallest step between values, over the square root of 12, for sensors that stand still.

Channels that were filtered before they were stored have next to no noise left, which says nothing of their error: where
it is below what any converter resolves, that of a good sensor is assumed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import comb, sqrt
from typing import Literal

import numpy as np

from sysid_btr._typing import FloatArray
from sysid_btr.io.log import Log

ORDERS = (3, 4, 5)
"""Orders of difference tried; the smallest estimate has the least motion left in it."""
MAD_TO_STD = 1.4826
CLIP = 4.0
"""Differences beyond so many robust standard deviations are impacts or reversals, and are cut to that."""
MIN_SAMPLES = 30
FINEST_BITS = 24
"""Over the range of its values in the log no sensor resolves more: the finest converters for drives have 24 bits."""
ASSUMED_BITS = 20
"""Resolution that is assumed of one whose noise was filtered away: that of a good encoder, so that nothing real hides
below it."""
WHITE = 3.0
"""Standard errors of the first autocorrelation up to which samples count as independent."""


@dataclass(frozen=True)
class NoiseFloor:
    """Standard deviation of one sensor's noise, how it was found, and the sensor's step (0 if none)."""

    sigma: float
    method: Literal["high-frequency", "quantisation", "unknown", "assumed", "stated"]
    step: float


def channel_noise(log: Log, column: str) -> NoiseFloor:
    """Noise of a log's column: as the log's metadata state it, else from its values."""
    stated, values = log.meta.stated_noise(column), log.channels[column]
    return noise_floor(values) if stated is None else NoiseFloor(float(stated), "stated", quantisation_step(values))


def position_noise(log: Log, joints: Sequence[str]) -> FloatArray:
    """(j,) noise floors of the positions of joints, infinite where the log has none."""
    return np.array([channel_noise(log, f"position.{j}").sigma if log.has("position", j) else np.inf for j in joints])


def noise_floor(values: FloatArray) -> NoiseFloor:
    """Noise of one sensor channel.

    Parameters
    ----------
    values : (n,) samples in time order; NaN where missing.

    Returns
    -------
    NoiseFloor
        ``unknown`` with a tiny sigma where there are too few samples.
    """
    step = quantisation_step(values)
    finite = values[np.isfinite(values)]
    if len(finite) < MIN_SAMPLES:
        spread = float(np.std(finite)) if len(finite) else 0.0
        return NoiseFloor(max(step / sqrt(12), 1e-6 * spread, 1e-12), "unknown", step)
    estimates = []
    for order in ORDERS:
        gain = sqrt(comb(2 * order, order))
        difference = np.diff(values, n=order)
        difference = difference[np.isfinite(difference)]
        if len(difference) < MIN_SAMPLES // 2:
            continue
        moving = np.abs(difference)
        spread = MAD_TO_STD * float(np.median(moving))
        # a coarse encoder makes most differences zero or one step: the median alone says nothing
        most = max(CLIP * spread, 2 * step * gain / sqrt(6))
        estimates.append(float(np.sqrt(np.mean(np.minimum(moving, most) ** 2))) / gain)
    sigma = min(estimates) if estimates else 0.0
    if max(sigma, step / sqrt(12)) < float(np.ptp(finite)) * 2.0**-FINEST_BITS:
        return assumed_floor(values)
    if sigma <= step / sqrt(12):
        return NoiseFloor(max(step / sqrt(12), 1e-12), "quantisation", step)
    return NoiseFloor(sigma, "high-frequency", step)


def assumed_floor(values: FloatArray) -> NoiseFloor:
    """Noise of a good sensor over the range of its values, where these say nothing of it."""
    finite = values[np.isfinite(values)]
    reach = float(np.ptp(finite)) if len(finite) else 0.0
    return NoiseFloor(max(reach * 2.0**-ASSUMED_BITS / sqrt(12), 1e-12), "assumed", quantisation_step(values))


def is_white(values: FloatArray) -> bool:
    """Whether no sample of a sensor (n,) says anything of the next: noise alone, or nothing at all.

    By their first autocorrelation, whose standard error for white noise is one over the root of the number of pairs
    (Bartlett 1946, doi:10.2307/2983611).
    """
    return _persistence(values)[0] <= WHITE * _persistence(values)[1]


def hides_motion(values: FloatArray, motion: FloatArray) -> bool:
    """Whether a sensor (n,) shows noise alone, though a motion (n,) that it should show would stand out of it."""
    own, error = _persistence(values)
    expected, _ = _persistence(motion)
    finite = values[np.isfinite(values)]
    if own > WHITE * error or not len(finite) > MIN_SAMPLES or not np.ptp(finite) > 0:
        return False
    share = min(float(np.nanvar(motion) / np.var(finite)), 1.0)
    return bool(share * expected > 2 * WHITE * error)


def _persistence(values: FloatArray) -> tuple[float, float]:
    """First autocorrelation of samples, and its standard error where there is none."""
    centred = values - np.nanmean(values) if np.isfinite(values).any() else values
    products = centred[1:] * centred[:-1]
    pairs = np.isfinite(products)
    power = float(np.nanmean(centred**2)) if np.isfinite(centred).any() else 0.0
    if not pairs.any() or not power > 0:
        return 0.0, 1.0
    return float(np.mean(products[pairs])) / power, 1 / sqrt(int(pairs.sum()))


def quantisation_step(values: FloatArray) -> float:
    """Smallest step of a quantised sensor, or 0 where its values are continuous."""
    finite = values[np.isfinite(values)]
    distinct = np.unique(finite)
    if len(distinct) < 2:
        return 0.0
    # a continuous sensor repeats almost no value
    if len(distinct) > 0.9 * len(finite):
        return 0.0
    gaps = np.diff(distinct)
    gaps = gaps[gaps > 1e-9 * max(abs(distinct[0]), abs(distinct[-1]), 1e-300)]
    return float(np.quantile(gaps, 0.05)) if len(gaps) else 0.0
