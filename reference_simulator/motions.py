"""Commands that excite a robot: functions of a robot, a time axis and a random generator.

Every motion starts at the pose nearest to zero that the joint limits allow, and stays inside the limits.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from reference_simulator.robot import Robot

    Array = NDArray[np.float64]

MAX_AMPLITUDE = 1.0  # rad about the middle of a joint's range


def home(robot: Robot) -> Array:
    """Zero, moved inside the joint limits."""
    return np.clip(np.zeros(robot.n), robot.range[:, 0], robot.range[:, 1])


def _middle_and_amplitude(robot: Robot) -> tuple[Array, Array]:
    low, high = robot.range.T
    amplitude = np.minimum(0.48 * (high - low), MAX_AMPLITUDE)
    margin = np.minimum(amplitude, 0.5 * (high - low))
    middle = np.clip(home(robot) + 0.0, low + margin, high - margin)  # as near to home as the limits allow
    return middle, amplitude


def _blend(x: Array) -> Array:
    """Minimum-jerk blend from 0 to 1 (Flash and Hogan 1985)."""
    x = np.clip(x, 0.0, 1.0)
    return x**3 * (10.0 - 15.0 * x + 6.0 * x**2)


def _enter(robot: Robot, time: Array, motion: Array, seconds: float = 1.5) -> Array:
    start = home(robot)
    return start + _blend(time / seconds)[:, None] * (motion - start)


def multisine(robot: Robot, time: Array, rng: np.random.Generator) -> Array:
    """Five sines a joint between 0.1 Hz and a top frequency of its own (0.4 to 1.3 Hz), random phases."""
    middle, amplitude = _middle_and_amplitude(robot)
    out = np.empty((time.size, robot.n))
    for j in range(robot.n):
        top = rng.uniform(0.4, 1.3)
        frequency = np.sort(rng.uniform(0.1, top, size=5))
        weight = rng.uniform(0.4, 1.0, size=5)
        phase = rng.uniform(0.0, 2.0 * np.pi, size=5)
        wave = np.sin(2.0 * np.pi * frequency * time[:, None] + phase) @ weight
        out[:, j] = middle[j] + 0.8 * amplitude[j] * wave / np.abs(wave).max()
    return _enter(robot, time, out)


def poses(robot: Robot, time: Array, rng: np.random.Generator) -> Array:
    """Minimum-jerk moves (0.5 to 1.2 s) between random poses, each held 0.2 to 0.8 s."""
    middle, amplitude = _middle_and_amplitude(robot)
    out = np.empty((time.size, robot.n))
    pose, begin = home(robot), float(time[0]) if time.size else 0.0
    out[:] = pose
    while begin < time[-1]:
        goal = middle + 0.8 * amplitude * rng.uniform(-1.0, 1.0, robot.n)
        move, hold = rng.uniform(0.5, 1.2), rng.uniform(0.2, 0.8)
        after = time >= begin
        out[after] = pose + _blend((time[after] - begin) / move)[:, None] * (goal - pose)
        pose, begin = goal, begin + move + hold
    return out


def gait(robot: Robot, time: Array, rng: np.random.Generator) -> Array:
    """Walking in the air: two harmonics a joint at one step frequency, left and right half a period apart.

    Leg joints are known by the end of their names; any other joint swings a little at the same frequency.
    """
    frequency = rng.uniform(0.7, 1.1)
    omega = 2.0 * np.pi * frequency * time
    lift = rng.uniform(0.35, 0.6)
    stride = rng.uniform(0.2, 0.35)
    sway = rng.uniform(0.08, 0.14)
    out = np.empty((time.size, robot.n))
    for j, name in enumerate(robot.joints):
        phase = omega + (np.pi if name.startswith("L") else 0.0)
        swing = np.maximum(np.sin(phase), 0.0) ** 2
        if name.endswith("HipPitch"):
            wave = -0.35 - stride * np.cos(phase) - 0.5 * lift * swing
        elif name.endswith("KneePitch"):
            wave = 0.7 + lift * swing
        elif name.endswith("AnklePitch"):
            wave = -0.35 + stride * np.cos(phase) - 0.4 * lift * swing
        elif name.endswith("HipRoll"):
            wave = sway * np.sin(omega)
        elif name.endswith("AnkleRoll"):
            wave = -sway * np.sin(omega)
        elif name.endswith("ShoulderPitch"):
            wave = 0.9 + 0.4 * np.cos(phase)
        else:
            middle, amplitude = _middle_and_amplitude(robot)
            wave = middle[j] + 0.15 * amplitude[j] * np.sin(phase + rng.uniform(0.0, 2.0 * np.pi))
        out[:, j] = np.clip(wave, *robot.range[j])
    return _enter(robot, time, out)


def steps(robot: Robot, time: Array, rng: np.random.Generator) -> Array:
    """Jumps of up to 0.4 of the usual amplitude to levels held 0.5 to 1.5 s, joints at their own instants."""
    middle, amplitude = _middle_and_amplitude(robot)
    out = np.tile(home(robot), (time.size, 1))
    for j in range(robot.n):
        begin = rng.uniform(0.2, 1.0)
        while begin < time[-1]:
            out[time >= begin, j] = middle[j] + 0.4 * amplitude[j] * rng.uniform(-1.0, 1.0)
            begin += rng.uniform(0.5, 1.5)
    return out


def triangles(robot: Robot, time: Array, rng: np.random.Generator) -> Array:
    """Slow constant speeds (0.1 to 0.3 rad/s) back and forth: what dry friction and backlash show best on."""
    middle, amplitude = _middle_and_amplitude(robot)
    out = np.empty((time.size, robot.n))
    for j in range(robot.n):
        reach = 0.6 * amplitude[j]
        period = 4.0 * reach / rng.uniform(0.1, 0.3)
        phase = np.mod(time / period + rng.uniform(), 1.0)
        out[:, j] = middle[j] + reach * (4.0 * np.abs(phase - 0.5) - 1.0)
    return _enter(robot, time, out)


def chirp(robot: Robot, time: Array, rng: np.random.Generator) -> Array:
    """A sine sweeping from 0.1 to 2 Hz, amplitude falling with frequency."""
    middle, amplitude = _middle_and_amplitude(robot)
    rate = (2.0 / 0.1) ** (time / time[-1])
    phase = 2.0 * np.pi * 0.1 * time[-1] * (rate - 1.0) / np.log(20.0)
    size = 0.7 * amplitude / np.sqrt(rate)[:, None]
    out = middle + size * np.sin(phase[:, None] + rng.uniform(0.0, 2.0 * np.pi, robot.n))
    return _enter(robot, time, out)


Motion = Callable[["Robot", "Array", np.random.Generator], "Array"]
MOTIONS: dict[str, Motion] = {f.__name__: f for f in (multisine, poses, gait, steps, triangles, chirp)}
