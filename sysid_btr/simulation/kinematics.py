"""Positions, velocities and accelerations of a log on one uniform grid, by a filter that is stated.

Positions are low-passed without phase (Butterworth, forward and backward) and derived by a spline. Torques are
low-passed to the band in which the model is compared with them, and so are those that a model predicts, which makes
filtering harmless for what is linear in the torques. Both bands follow the motion's own: ten times it for positions,
five times for torques (Gautier, Dynamic identification of robots with power model, ICRA 1997; Janot, Vandanjon, Gautier
2014, doi:10.1109/TCST.2013.2246163).
"""

from __future__ import annotations

from collections.abc import Callable, Hashable
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import TypeVar, cast

import numpy as np

from sysid_btr._typing import BoolArray, FloatArray
from sysid_btr.errors import LogError
from sysid_btr.io.log import Log

T = TypeVar("T")

ENERGY = 0.99
"""Fraction of the velocities' energy that lies in the band of the motion."""
KINEMATIC, DYNAMIC = 10.0, 5.0
"""Band of the positions and of the torques, in bands of the motion."""
GRID = 8.0
"""Samples of the grid in a period of the highest frequency of the torques."""
ORDER = 4
"""Of the low-pass, before it is run forward and backward."""
HIGHEST = 0.8
"""Fraction of half the sampling rate up to which a filter makes sense."""
SLIDING = 0.02
"""Fraction of a joint's rms velocity below which it may creep: dry friction takes any value up to its size there
(pre-sliding: Armstrong-Helouvry, Dupont, Canudas de Wit 1994, doi:10.1016/0005-1098(94)90209-7), so that slow samples
are left out of identifications. A hundredth more or less changes no estimate beyond its error."""
REMEMBERED = 32
"""Results that are kept with a motion: a fraction of a megabyte each, and a few for each body of a regressor."""
FEWEST = 64
"""Samples from which a band can be read."""


@dataclass(frozen=True, eq=False)
class Kinematics:
    """Motion of all joints on a uniform grid.

    Attributes
    ----------
    time : (n,) s since the first sample of the log.
    position, velocity, acceleration : (n, j) rad or m, and derivatives; joints that are not logged stand still.
    velocity_noise : (j,) standard deviation of the velocities.
    band : Hz, of the motion.
    """

    time: FloatArray
    position: FloatArray
    velocity: FloatArray
    acceleration: FloatArray
    velocity_noise: FloatArray
    band: float

    @property
    def period(self) -> float:
        """Of the grid, s."""
        return float(self.time[1] - self.time[0])

    @property
    def cutoff(self) -> float:
        """Hz, of the torques that are compared; infinite where the grid is too coarse for a filter."""
        highest = HIGHEST / 2 / self.period
        return DYNAMIC * self.band if DYNAMIC * self.band < highest else np.inf

    @property
    def every(self) -> int:
        """Samples of the grid from one that tells something new to the next: torques are low-passed."""
        return max(int(1 / (2 * self.cutoff * self.period)), 1) if np.isfinite(self.cutoff) else 1

    @property
    def settled(self) -> float:
        """Seconds from either end in which the low-pass still shows."""
        return 2 / self.cutoff if np.isfinite(self.cutoff) else 0.0

    @cached_property
    def direction(self) -> FloatArray:
        """(n, j) expected sign of the velocities, given their noise, over the time that a sample stands for."""
        return self.direction_along(np.eye(self.velocity.shape[1]))

    def direction_along(self, levers: FloatArray) -> FloatArray:
        """(n, k) expected sign of sums of velocities, of levers (k, j)."""
        from scipy.special import erf

        noise = np.sqrt(levers**2 @ self.velocity_noise**2)
        within = np.abs(self.acceleration @ levers.T) * self.period / np.sqrt(12)
        spread = np.maximum(np.hypot(noise, within), 1e-300)
        return np.asarray(erf(self.velocity @ levers.T / (np.sqrt(2) * spread)))

    @property
    def moving(self) -> BoolArray:
        """(n, j) where a joint surely slides, so that dry friction has its size and a known sign."""
        rms = np.sqrt(np.mean(self.velocity**2, axis=0))
        return np.asarray(np.abs(self.velocity) > np.maximum(3 * self.velocity_noise, SLIDING * rms))

    def rows(self, start: int, stop: int) -> Kinematics:
        """Some samples of the grid."""
        names = ("time", "position", "velocity", "acceleration")
        parts = {name: getattr(self, name)[start:stop] for name in names}
        return self.remember(("rows", start, stop), lambda: replace(self, **parts))

    def remember(self, key: Hashable, work: Callable[[], T]) -> T:
        """What `work` finds of this motion: found anew only if the last so many keys did not ask for it."""
        found = self._found.pop(key) if key in self._found else work()
        self._found[key] = found
        while len(self._found) > REMEMBERED:
            self._found.pop(next(iter(self._found)))
        return cast("T", found)

    @cached_property
    def _found(self) -> dict[Hashable, object]:
        return {}

    def __getstate__(self) -> dict[str, object]:
        """The motion itself, without what was found of it."""
        return {f.name: getattr(self, f.name) for f in fields(self)}

    def seen(self, frequency: FloatArray) -> FloatArray:
        """Fraction (f,) of a torque at each frequency (Hz) that is compared."""
        return np.asarray(1 / (1 + (frequency / self.cutoff) ** (2 * ORDER)))

    def low_passed(self, torque: FloatArray) -> FloatArray:
        """Torques (..., n, k) on this grid as they are compared."""
        return low_pass(torque, self.cutoff, self.period)


def low_pass(values: FloatArray, cutoff: float, period: float) -> FloatArray:
    """Values (..., n, k) without what lies above a frequency (Hz), without phase."""
    if not cutoff < HIGHEST / 2 / period:
        return values
    from scipy.signal import butter, sosfiltfilt

    sos = butter(ORDER, cutoff, fs=1 / period, output="sos")
    padding = min(int(3 / (cutoff * period)), values.shape[-2] - 1)
    return np.asarray(sosfiltfilt(sos, values, axis=-2, padlen=padding))


def motion_band(position: FloatArray, noise: FloatArray, period: float) -> float:
    """Frequency (Hz) below which nearly all of the velocities' energy lies, of the fastest joint.

    Parameters
    ----------
    position : (n, k) on a uniform grid.
    noise : (k,) standard deviation of their white noise.
    period : of the grid, s.
    """
    from scipy.signal import detrend, welch

    length = min(len(position), max(len(position) // 4, FEWEST))
    trend = detrend(position, axis=0)
    frequency, power = welch(trend, 1 / period, nperseg=length, axis=0)
    signal = np.maximum(power - 4 * noise**2 * period, 0) * frequency[:, None] ** 2
    total = signal.sum(axis=0)
    moving = total > 1e-6 * total.max(initial=0.0)
    if not moving.any():
        return float(frequency[1])
    share = np.cumsum(signal[:, moving], axis=0) / total[moving]
    return float(frequency[np.argmax(share >= ENERGY, axis=0)].max())


def uniform(log: Log, columns: tuple[str, ...]) -> tuple[FloatArray, float, FloatArray]:
    """Columns at the log's own mean rate: time (n,), its period in s, and values (n, k).

    Missing values and jitter of the clock are bridged by a spline.

    Raises
    ------
    LogError
        If a column holds next to nothing.
    """
    from scipy.interpolate import make_interp_spline

    time = log.time - log.time[0]
    period = float(time[-1] / (len(time) - 1))
    grid = np.asarray(period * np.arange(len(time)), dtype=np.float64)
    even = bool(np.max(np.abs(time - grid)) < 0.01 * period)
    values: FloatArray = np.empty((len(time), len(columns)))
    for k, column in enumerate(columns):
        raw = np.asarray(log.channels[column], dtype=np.float64)
        good = np.isfinite(raw)
        if good.sum() < FEWEST:
            raise LogError(
                f"log {log.path or ''}: {column} has {int(good.sum())} values; velocities and accelerations need at "
                f"least {FEWEST}"
            )
        values[:, k] = raw if even and good.all() else make_interp_spline(time[good], raw[good], k=3)(grid)
    return grid, period, values


def smooth(
    log: Log, joints: tuple[str, ...], defaults: FloatArray, noise: FloatArray, band: float | None = None
) -> Kinematics:
    """Motion of a log's joints, filtered.

    Parameters
    ----------
    log : one episode.
    joints, defaults : (j,) joints, and where those stand that the log does not have.
    noise : (j,) standard deviation of the positions' noise.
    band : of the motion, Hz, where it is known.

    Raises
    ------
    LogError
        If too little is logged.
    """
    from scipy.interpolate import make_interp_spline

    logged = [i for i, joint in enumerate(joints) if log.has("position", joint)]
    time, period, raw = uniform(log, tuple(f"position.{joints[i]}" for i in logged))
    band = motion_band(raw, noise[logged], period) if band is None else band
    cutoff = KINEMATIC * band
    spline = make_interp_spline(time, low_pass(raw, cutoff, period), k=5)
    together = max(int(1 / (GRID * DYNAMIC * band * period)), 1)
    grid = time[::together]
    shape = (len(grid), len(joints))
    position, velocity, acceleration = np.tile(defaults, (len(grid), 1)), np.zeros(shape), np.zeros(shape)
    for order, values in enumerate((position, velocity, acceleration)):
        values[:, logged] = spline(grid, nu=order)
    # white noise up to the cutoff, or all of it
    highest = min(cutoff, 0.5 / period)
    velocity_noise = noise * 2 * np.pi * highest * np.sqrt(highest * 2 * period / 3)
    return Kinematics(grid, position, velocity, acceleration, velocity_noise, band)
