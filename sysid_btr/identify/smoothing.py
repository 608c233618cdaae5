"""Fixed-interval smoothing of small linear Gaussian models, many series at once.

Forward Kalman filter with scalar updates, backward pass of Rauch, Tung and Striebel (1965,
doi:10.2514/3.3166).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sysid_btr._typing import FloatArray
from sysid_btr.io.noise import noise_floor

JERKS = np.logspace(0.5, 6.5, 13)
"""Root of the spectral density of a joint's jerk that is tried, rad s^-2.5 with the s of a Nao:
from still to impacts."""
STRETCH = 1000
"""Samples on which the intensity is chosen."""


@dataclass(frozen=True, eq=False)
class Smoothed:
    """Smoothed states.

    Attributes
    ----------
    mean : (n, b, d).
    cov : (n, b, d, d).
    loglik : (b,) log-likelihood of the measurements, up to a constant.
    """

    mean: FloatArray
    cov: FloatArray
    loglik: FloatArray


def smooth(
    transition: FloatArray,
    process: FloatArray,
    drive: FloatArray,
    rows: FloatArray,
    measured: FloatArray,
    variance: FloatArray,
    prior: tuple[FloatArray, FloatArray],
) -> Smoothed:
    """Smooth b series of d-dimensional states with the same dynamics.

    Parameters
    ----------
    transition : (n-1, d, d) from one sample to the next.
    process : (n-1, b, d, d) covariance added on the way.
    drive : (n-1, b, d) known change on the way.
    rows : (o, d) what each scalar measurement sees.
    measured : (n, b, o).
    variance : (n, b, o); infinite where there is no measurement.
    prior : (b, d) mean and (b, d, d) covariance before the first sample.
    """
    n, b, observed = measured.shape
    d = rows.shape[1]
    mean, cov = prior[0].copy(), prior[1].copy()
    loglik = np.zeros(b)
    filtered = np.empty((n, b, d))
    filtered_cov = np.empty((n, b, d, d))
    ahead = np.empty((n, b, d))
    ahead_cov = np.empty((n, b, d, d))
    used = np.isfinite(variance) & np.isfinite(measured)
    for k in range(n):
        if k:
            f = transition[k - 1]
            mean = mean @ f.T + drive[k - 1]
            cov = f @ cov @ f.T + process[k - 1]
        ahead[k], ahead_cov[k] = mean, cov
        for i in range(observed):
            live = used[k, :, i]
            if not live.any():
                continue
            row = rows[i]
            gain = cov @ row
            spread = gain @ row + np.where(live, variance[k, :, i], 1.0)
            error = np.where(live, measured[k, :, i] - mean @ row, 0.0)
            step = np.where(live, 1 / spread, 0.0)
            loglik -= np.where(live, 0.5 * (error**2 / spread + np.log(spread)), 0.0)
            mean = mean + gain * (step * error)[:, None]
            cov = cov - gain[:, :, None] * gain[:, None, :] * step[:, None, None]
        filtered[k], filtered_cov[k] = mean, cov
    result, result_cov = filtered.copy(), filtered_cov.copy()
    for k in range(n - 2, -1, -1):
        f = transition[k]
        # (P F' A^-1)' = A^-1 F P
        back = np.linalg.solve(ahead_cov[k + 1], f @ filtered_cov[k]).transpose(0, 2, 1)
        change = (result[k + 1] - ahead[k + 1])[:, :, None]
        result[k] = filtered[k] + (back @ change)[:, :, 0]
        result_cov[k] = filtered_cov[k] + back @ (result_cov[k + 1] - ahead_cov[k + 1]) @ back.transpose(0, 2, 1)
    return Smoothed(result, result_cov, loglik)


@dataclass(frozen=True, eq=False)
class Tracks:
    """Joint motions with standard deviations, (n, j) each."""

    position: FloatArray
    velocity: FloatArray
    acceleration: FloatArray
    position_std: FloatArray
    velocity_std: FloatArray


def smooth_joints(time: FloatArray, measured: FloatArray, second: float = 1.0, *, derivative: int = 0) -> Tracks:
    """Smoothed joint positions and velocities from encoders alone, or those of what a gyro measures.

    The model is a motion of white jerk, whose intensity is chosen for each joint by maximum likelihood.

    Parameters
    ----------
    time : (n,) s.
    measured : (n, j) rad or m, or their derivatives; NaN where missing.
    second : s, in which the robot does what a Nao does in one.
    derivative : order of the one that is measured.
    """
    time, measured = time / second, measured * float(second**derivative)
    joints, grid = measured.shape[1], len(JERKS)
    sigma = np.array([max(noise_floor(column).sigma, 1e-7) for column in measured.T])
    step = np.diff(time)
    transition = np.tile(np.eye(3), (len(step), 1, 1))
    transition[:, 0, 1] = transition[:, 1, 2] = step
    transition[:, 0, 2] = step**2 / 2
    power = np.array([[20.0, 8.0, 6.0], [8.0, 3.0, 2.0], [6.0, 2.0, 1.0]])
    order = np.array([[5, 4, 3], [4, 3, 2], [3, 2, 1]])
    unit = step[:, None, None] ** order / power  # integral of a white jerk over the step
    first = np.array([c[np.isfinite(c)][0] if np.isfinite(c).any() else 0.0 for c in measured.T])

    def run(columns: FloatArray, noise: FloatArray, start: FloatArray, jerk: FloatArray) -> Smoothed:
        n, b = columns.shape
        mean = np.zeros((b, 3))
        mean[:, 0] = start
        return smooth(
            transition[: n - 1],
            unit[: n - 1, None] * (jerk**2)[None, :, None, None],
            np.zeros((n - 1, b, 3)),
            np.array([[1.0, 0.0, 0.0]]),
            columns[:, :, None],
            np.broadcast_to(noise[:, None] ** 2, (n, b, 1)),
            (mean, np.tile(np.diag([0.1**2, 5.0**2, 100.0**2]), (b, 1, 1))),
        )

    # the intensity is a property of the motion, which a stretch of it shows
    part = np.tile(measured[:STRETCH], (1, grid))
    trial = run(part, np.tile(sigma, grid), np.tile(first, grid), np.repeat(JERKS, joints))
    best = np.argmax(trial.loglik.reshape(grid, joints), axis=0)
    found = run(measured, sigma, first, JERKS[best])
    deviation = np.sqrt(np.maximum(np.diagonal(found.cov, axis1=2, axis2=3), 0.0))
    # an angle's derivative, in the robot's own s
    value = float(second**-derivative)
    mean, std = found.mean * value, deviation * value
    return Tracks(mean[..., 0], mean[..., 1] / second, mean[..., 2] / second**2, std[..., 0], std[..., 1] / second)
