"""What parameters can do to a residual, to first order."""

from __future__ import annotations

import numpy as np

from sysid_btr._typing import FloatArray


def explained_by(jacobian: FloatArray, residual: FloatArray) -> FloatArray:
    """The part (r,) of a residual that parameters explain, to first order, whatever their bounds."""
    basis = orthonormal(jacobian)
    return np.asarray(basis @ (basis.T @ residual))


def orthonormal(jacobian: FloatArray) -> FloatArray:
    """Orthonormal basis (r, k) of what parameters with these derivatives (r, p) can do."""
    # derivatives of what is about to diverge are finite, and their squares are not
    largest = np.abs(jacobian).max(axis=0, initial=0.0)
    live = jacobian[:, largest > 0] / largest[largest > 0]
    live /= np.linalg.norm(live, axis=0)
    if live.shape[1] == 0:
        return np.zeros((len(jacobian), 0))
    u, s, _ = np.linalg.svd(live, full_matrices=False)
    return np.asarray(u[:, s > 1e-6 * s[0]])
