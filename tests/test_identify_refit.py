"""How many samples of a residual count as one."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from sysid_btr._typing import FloatArray
from sysid_btr.identify.refit import _memory

PERIOD, STRETCH, SAMPLES = 0.02, 0.5, 2000


def memory(*series: FloatArray) -> FloatArray:
    """Of residuals, each a column, sampled at 50 Hz."""
    stretch = (PERIOD * np.arange(SAMPLES) / STRETCH + 1e-9).astype(np.int64)
    problem = SimpleNamespace(
        column_labels=np.tile(np.arange(len(series)), SAMPLES),
        blocks=np.repeat(stretch, len(series)),
        columns=series,
        counts=np.full(len(series), float(SAMPLES)),
    )
    return _memory(cast(Any, problem), np.stack(series, axis=1).ravel())


@pytest.mark.parametrize("seed", range(5))
def test_every_sample_of_white_noise_counts(seed: int) -> None:
    assert memory(np.random.default_rng(seed).normal(size=SAMPLES))[0] < 1.4


@pytest.mark.parametrize("carry", [0.5, 0.8])
def test_what_fades_counts_by_its_autocorrelation(carry: float) -> None:
    rng, slow = np.random.default_rng(1), np.zeros(SAMPLES)
    for k in range(1, SAMPLES):
        slow[k] = carry * slow[k - 1] + rng.normal()
    assert memory(slow)[0] == pytest.approx((1 + carry) / (1 - carry), rel=0.35)


@pytest.mark.parametrize("frequency", [2.0, 4.0, 10.0])
def test_what_swings_is_hardly_more_than_one_sample_a_stretch_although_its_mean_vanishes(frequency: float) -> None:
    rng, time = np.random.default_rng(2), PERIOD * np.arange(SAMPLES)
    swing, noise = np.sin(2 * np.pi * frequency * time + 0.3), rng.normal(size=SAMPLES)
    found = memory(swing, noise, 100.0 * swing)
    assert found[0] > 0.8 * STRETCH / PERIOD
    assert found[1] < 1.4  # each column for itself
    assert found[2] == pytest.approx(found[0])
