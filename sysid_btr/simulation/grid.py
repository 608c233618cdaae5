"""The simulation grid of one log: steps, mean commands over each step, and where the samples fall."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from sysid_btr._typing import FloatArray, IntArray
from sysid_btr.interpolation import hermite
from sysid_btr.machine import require_memory
from sysid_btr.models.commands import FED_FORWARD

if TYPE_CHECKING:
    from sysid_btr.io.log import Log

ALIGNED = 1e-2
"""A sample this close to a step border, in steps, is taken to lie on it: clocks are written in few digits."""


@dataclass(frozen=True)
class Grid:
    """Uniform simulation steps and the log's samples on them.

    Attributes
    ----------
    timestep : s.
    command : (steps, joints) mean of the held command over each step, in units of the joints.
    extra : (steps, ...) what else is commanded: ctrl of actuators by their own name, then, where the log has any,
        velocities and torques that are fed forward, each for all joints.
    sample_time : (n,) s since the first sample.
    state : (k,) indices of the step borders whose state is kept, increasing; 0 is the start.
    before, after : (n,) positions in `state` of the borders around each sample.
    fraction : (n,) of a step from `before` to the sample.
    """

    timestep: float
    command: FloatArray
    sample_time: FloatArray
    state: IntArray
    before: IntArray
    after: IntArray
    fraction: FloatArray
    extra: FloatArray = field(default_factory=lambda: np.zeros((0, 0)))

    @property
    def steps(self) -> int:
        return len(self.command)


def make_grid(
    log: Log,
    joints: tuple[str, ...],
    defaults: FloatArray,
    timestep: float,
    controls: Mapping[str, float] | None = None,
) -> Grid:
    """Lay simulation steps over one episode of a log.

    Parameters
    ----------
    log : one episode.
    joints : (j,) joints in the order of the outputs.
    defaults : (j,) command of a joint that the log does not command.
    timestep : s.
    controls : actuators commanded by their own name, and the ctrl of those that the log does not command.
    """
    time = log.time - log.time[0]
    # commands of joints and actuators at every step, and what it takes to find them
    size = 8 * time[-1] / timestep * (4 + 3 * len(joints) + len(controls or {}))
    what = f"replaying {time[-1]:.6g} s in steps of {timestep:.3g} s"
    require_memory(size, what, "replay a part of the log, or take a longer step (servo_period of the log)")
    low, high, fraction = on_steps(time, timestep)
    state = np.unique(np.concatenate([low, high]))
    borders = even_borders(max(int(state[-1]), 1), timestep)
    command, extra = mean_commands(log, joints, defaults, controls or {}, borders)
    return Grid(
        timestep=timestep,
        command=command,
        extra=extra,
        sample_time=time,
        state=state,
        before=np.searchsorted(state, low),
        after=np.searchsorted(state, high),
        fraction=fraction,
    )


def even_borders(steps: int, timestep: float) -> FloatArray:
    """(steps + 1,) borders, s, of so many steps."""
    return np.asarray(np.arange(steps + 1) * timestep, dtype=np.float64)


def on_steps(time: FloatArray, timestep: float) -> tuple[IntArray, IntArray, FloatArray]:
    """Borders before and after times (n,) since the first one, and fractions of a step from the former, (n,) each."""
    exact = time / timestep
    rounded = np.round(exact)
    aligned = np.abs(exact - rounded) < ALIGNED
    low = np.where(aligned, rounded, np.floor(exact)).astype(np.int64)
    fraction = np.where(aligned, 0.0, exact - low)
    return low, np.where(fraction > 0, low + 1, low), fraction


def mean_commands(
    log: Log, joints: tuple[str, ...], defaults: FloatArray, controls: Mapping[str, float], borders: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Commands of joints, (..., steps, j), and of what else there is, as in `Grid`, over steps between borders.

    Parameters
    ----------
    log, joints, defaults, controls : see `make_grid`.
    borders : (..., steps + 1) s since the first sample, at equal distances. Before a log its first command holds.
    """
    borders = _at_samples_near(log.time - log.time[0], borders)
    still, own = np.zeros(len(joints)), dict(controls)
    extra = [_mean_command(log, tuple(own), np.array(list(own.values())), borders)]
    if any(log.joints(channel) for channel in FED_FORWARD):
        extra += [_mean_command(log, joints, still, borders, channel) for channel in FED_FORWARD]
    return _mean_command(log, joints, defaults, borders), np.concatenate(extra, axis=-1)


def at_samples(grid: Grid, position: FloatArray, velocity: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Cubic Hermite read-out at the sample times of states kept at step borders, (m, k, j) each."""
    if not np.any(grid.fraction):
        if len(grid.state) == len(grid.before):
            return position, velocity
        return position[:, grid.before], velocity[:, grid.before]
    f = grid.fraction[None, :, None]
    h = grid.timestep
    p0, p1 = position[:, grid.before], position[:, grid.after]
    v0, v1 = velocity[:, grid.before], velocity[:, grid.after]
    return hermite(f, h, p0, p1, v0, v1), v0 + f * (v1 - v0)


def _mean_command(
    log: Log, joints: tuple[str, ...], defaults: FloatArray, borders: FloatArray, channel: str = "command"
) -> FloatArray:
    """Mean over each step of the command as the servo sees it; exact for a held command.

    A held step function enters the dynamics through its impulse, which the mean conserves.
    """
    from sysid_btr.io.resample import command_at

    result = np.tile(defaults, (*borders.shape[:-1], borders.shape[-1] - 1, 1))
    named = [j for j in joints if log.has(channel, j)]
    if not named:
        return result
    columns = [joints.index(j) for j in named]
    if log.meta.command_hold == "linear":
        middle = 0.5 * (borders[..., :-1] + borders[..., 1:])
        result[..., columns] = command_at(log, named, log.time[0] + middle.ravel(), channel).reshape(*middle.shape, -1)
    else:
        held = command_at(log, named, log.time, channel)
        result[..., columns] = mean_over_steps(log.time - log.time[0], held, borders)
    return result


def mean_over_steps(time: FloatArray, held: FloatArray, borders: FloatArray) -> FloatArray:
    """Mean over each step of values held from one sample to the next.

    Parameters
    ----------
    time : (n,) s since the first sample, increasing.
    held : (n, k); the first one is there before, the last one stays.
    borders : (..., steps + 1) s since the first sample, increasing.

    Returns
    -------
    (..., steps, k) array.
    """
    span = np.diff(time, append=float(np.max(borders, initial=time[-1])) + 1.0)
    # relative to the first value, so that the cumulative sum keeps its digits
    change = held - held[0]
    integral = np.vstack([np.zeros(held.shape[1]), np.cumsum(change * span[:, None], axis=0)])
    knots, width = np.append(time, time[-1] + span[-1]), np.diff(borders)
    result = np.empty((*width.shape, held.shape[1]))
    for k in range(held.shape[1]):
        result[..., k] = held[0, k] + np.diff(np.interp(borders, knots, integral[:, k])) / width
    return result


def _at_samples_near(time: FloatArray, borders: FloatArray) -> FloatArray:
    """Borders, at the samples that are `ALIGNED` with them: no part of a command goes into the step before its own."""
    near = np.clip(np.round(np.interp(borders, time, np.arange(len(time)))).astype(np.int64), 0, len(time) - 1)
    there = time[near]
    return np.where(np.abs(there - borders) < ALIGNED * np.min(np.diff(borders), initial=np.inf), there, borders)


def step_inputs(log: Log, borders: FloatArray) -> dict[str, FloatArray]:
    """Measured drive inputs a law may use, (..., steps) each: means of supply voltage and enabled flags.

    `borders` of steps are those of `mean_over_steps`. A missing value leaves the one before it in force; a column
    without any value is left out.
    """
    inputs: dict[str, FloatArray] = {}
    for name, values in log.channels.items():
        known = np.flatnonzero(np.isfinite(values))
        if name.split(".")[0] not in ("voltage", "enabled") or len(known) == 0:
            continue
        last = np.maximum(np.searchsorted(known, np.arange(len(values)), side="right") - 1, 0)
        held = np.asarray(values, dtype=np.float64)[known[last], None]
        inputs[name] = mean_over_steps(log.time - log.time[0], held, borders)[..., 0]
    return inputs
