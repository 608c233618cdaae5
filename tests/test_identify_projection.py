"""What parameters can do to a residual, to first order."""

from __future__ import annotations

import numpy as np
import pytest

from sysid_btr.identify.projection import explained_by, orthonormal

RNG = np.random.default_rng(0)
JACOBIAN, RESIDUAL = RNG.normal(size=(50, 3)), RNG.normal(size=50)


def test_it_is_the_least_squares_fit() -> None:
    fit = JACOBIAN @ np.linalg.lstsq(JACOBIAN, RESIDUAL, rcond=None)[0]
    np.testing.assert_allclose(explained_by(JACOBIAN, RESIDUAL), fit)


@pytest.mark.parametrize("sizes", [(1.0, 1e-200, 1e200), (1e308, 1.0, 1e-300)])
def test_units_do_not_matter_however_large_derivatives_are(sizes: tuple[float, ...]) -> None:
    jacobian = JACOBIAN / np.abs(JACOBIAN).max() * sizes
    np.testing.assert_allclose(explained_by(jacobian, RESIDUAL), explained_by(JACOBIAN, RESIDUAL))


def test_what_does_nothing_and_what_does_the_same_as_another_spans_nothing_more() -> None:
    alike = np.column_stack([JACOBIAN, 2 * JACOBIAN[:, 0], np.zeros(50)])
    assert orthonormal(alike).shape == (50, 3)
    assert orthonormal(np.zeros((50, 2))).shape == (50, 0)
    assert orthonormal(np.zeros((50, 0))).shape == (50, 0)
