"""Orientation of the base from its inertial unit: gyro integrated, tied to the inclinometers, both ways in time."""

from __future__ import annotations

import numpy as np

from sysid_btr._typing import FloatArray
from sysid_btr.identify.smoothing import smooth

PASSES = 3
DRIFT = 0.002
"""rad s^-1/2, of a gyro beyond its white noise."""


def rotation_of(vector: FloatArray) -> FloatArray:
    """Rotation matrices (..., 3, 3) of rotation vectors (..., 3)."""
    from scipy.spatial.transform import Rotation

    flat = Rotation.from_rotvec(np.reshape(vector, (-1, 3))).as_matrix()
    return np.asarray(flat.reshape(*np.shape(vector)[:-1], 3, 3))


def tilt_of(rotation: FloatArray) -> FloatArray:
    """Angles (n,) between the base's vertical and the world's, rad, of rotations (n, 3, 3) of the base."""
    return np.arccos(np.clip(rotation[:, 2, 2], -1.0, 1.0))


def smooth_orientation(
    time: FloatArray, gyro: FloatArray, up: FloatArray, gyro_std: float, up_std: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Orientation of the base in the world, (n, 3, 3), and its standard deviation about the world's axes, (n, 3).

    The error of the integrated gyro is a random walk about the world's axes, driven by the gyro's noise and by
    what its samples miss between them; the measured vertical sees two of its components. Yaw starts at zero.

    Parameters
    ----------
    time : (n,) s.
    gyro : (n, 3) in the base's frame, rad/s.
    up : (n, 3) measured vertical in the base's frame.
    gyro_std : noise of the gyro, rad/s.
    up_std : (n,) noise of the vertical, rad.
    """
    n = len(time)
    step = np.diff(time)
    missed = np.linalg.norm(np.diff(gyro, n=2, axis=0, prepend=gyro[:1], append=gyro[-1:]), axis=1) / 12
    middle = 0.5 * (gyro[1:] + gyro[:-1])
    rate = step * (gyro_std**2 / 2 + np.maximum(missed[1:], missed[:-1]) ** 2) * step + DRIFT**2 * step
    process = np.broadcast_to(rate[:, None, None, None], (n - 1, 3, 1, 1))
    turns = np.tile(np.eye(3), (n, 1, 1))
    correction = np.zeros((n, 3))
    deviation = np.zeros((n, 3))
    for turn in range(PASSES):
        if turn == 0:
            increments = rotation_of(middle * step[:, None])
            turns[0] = _level(up[0])
            for k in range(n - 1):
                turns[k + 1] = turns[k] @ increments[k]
        else:
            turns = rotation_of(correction) @ turns
        seen = np.einsum("nij,nj->ni", turns, up)
        # exp(c) R u = z to first order in c: c_x = seen_y, c_y = -seen_x
        scale = np.maximum(seen[:, 2], 0.1)
        measured = np.stack([seen[:, 1] / scale, -seen[:, 0] / scale, np.full(n, np.nan)], axis=1)
        variance = np.broadcast_to((up_std**2)[:, None], (n, 3)).copy()
        variance[:, 2] = np.inf
        wide = np.array([0.1**2, 0.1**2, 1e-12])[:, None, None]
        found = smooth(
            np.ones((n - 1, 1, 1)),
            process,
            np.zeros((n - 1, 3, 1)),
            np.ones((1, 1)),
            measured[:, :, None],
            variance[:, :, None],
            (np.zeros((3, 1)), wide),
        )
        correction = found.mean[..., 0]
        deviation = np.sqrt(found.cov[..., 0, 0])
    return rotation_of(correction) @ turns, deviation


def _level(up: FloatArray) -> FloatArray:
    """The rotation without yaw that has this vertical."""
    x, y, z = up / np.linalg.norm(up)
    roll, pitch = np.arctan2(y, z), np.arctan2(-x, np.hypot(y, z))
    cr, sr, cp, sp = np.cos(roll), np.sin(roll), np.cos(pitch), np.sin(pitch)
    return np.array([[cp, sp * sr, sp * cr], [0.0, cr, -sr], [-sp, cp * sr, cp * cr]])
