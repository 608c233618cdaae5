"""Motions of arms as controllers: splines from rest, and a wanted motion fed forward."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from sysid_btr._typing import FloatArray
from sysid_btr.btr.controllers import commanded_joints, rest_of
from sysid_btr.errors import UsageError
from sysid_btr.interpolation import clamped_knots, smooth_step
from sysid_btr.io._text import some
from sysid_btr.models.robot import Robot, joint_ranges

DEGREE = 3
"""Of splines."""
TURN = np.pi
"""rad (m) from rest that a joint goes which has no limits."""
LEAST = 0.05
"""rad (m) by which a joint's command may be shifted however little it travels."""


@dataclass(frozen=True)
class SplineMotion:
    """From rest along a cubic B-spline to where every joint stays: its control points are the numbers.

    A spline does not leave the range of its control points, and begins and ends without velocity (de Boor 1978).

    Attributes
    ----------
    joints, rest : commanded, and where they begin, rad or m.
    lowest, highest : between which control points lie.
    duration : s that it takes.
    points : that are free, of each joint.
    """

    joints: tuple[str, ...]
    rest: tuple[float, ...]
    lowest: tuple[float, ...]
    highest: tuple[float, ...]
    duration: float
    points: int = 3

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(f"point{k}:{joint}" for joint in self.joints for k in range(1, self.points + 1))

    @property
    def lower(self) -> FloatArray:
        return np.repeat(self.lowest, self.points)

    @property
    def upper(self) -> FloatArray:
        return np.repeat(self.highest, self.points)

    @property
    def start(self) -> FloatArray:
        return np.repeat(self.rest, self.points)

    def commands(self, values: FloatArray, time: FloatArray) -> FloatArray:
        from scipy.interpolate import BSpline

        free = values.reshape(len(values), len(self.joints), self.points)
        still = np.broadcast_to(np.array(self.rest)[:, None], (*free.shape[:2], 2))
        points = np.concatenate([still, free, free[:, :, -1:]], axis=2)
        count = points.shape[2]
        shares = BSpline(clamped_knots(count, DEGREE), np.eye(count), DEGREE)(np.clip(time / self.duration, 0.0, 1.0))
        return np.asarray(np.einsum("nk,mjk->mnj", shares, points))


def spline_motion(robot: Robot, duration: float) -> SplineMotion:
    """Splines for every position servo, within the joints' limits.

    Raises
    ------
    UsageError
        If the robot has no position servo.
    """
    joints, ends = commanded_joints(robot), joint_ranges(robot)
    rest = rest_of(robot, joints)
    between = [ends.get(j, (float(x) - TURN, float(x) + TURN)) for j, x in zip(joints, rest, strict=True)]
    low, high = tuple(a for a, _ in between), tuple(b for _, b in between)
    return SplineMotion(joints, tuple(map(float, np.clip(rest, low, high))), low, high, duration)


@dataclass(frozen=True)
class FeedForward:
    """A wanted motion, commanded ahead of time, larger and shifted, by so much for each joint.

    A servo that follows its command late, short of it and below it is led to the motion by these three numbers:
    ``r(t) = w(0) + (1 + gain) (w(t + lead) - w(0)) + offset``, all of which grow from zero.

    Attributes
    ----------
    joints, wanted : commanded, (j,), and the motion, (n, j), rad or m.
    period : of its samples, s.
    lead, gain : largest, s and fraction.
    offset : largest, as a fraction of a joint's travel.
    ramp : s in which they grow.
    """

    joints: tuple[str, ...]
    wanted: FloatArray = field(repr=False, compare=False)
    period: float
    lead: float = 0.2
    gain: float = 0.3
    offset: float = 0.25
    ramp: float = 0.5

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(f"{part}:{joint}" for joint in self.joints for part in ("lead", "gain", "offset"))

    @property
    def lower(self) -> FloatArray:
        return self._ends(0.0, -1.0)

    @property
    def upper(self) -> FloatArray:
        return self._ends(1.0, 1.0)

    def _ends(self, lead: float, way: float) -> FloatArray:
        travel = np.maximum(self.offset * np.ptp(self.wanted, axis=0), LEAST)
        same = np.ones(len(self.joints))
        return np.stack([lead * self.lead * same, way * self.gain * same, way * travel], axis=1).ravel()

    @property
    def start(self) -> FloatArray:
        return np.zeros(3 * len(self.joints))

    def commands(self, values: FloatArray, time: FloatArray) -> FloatArray:
        grown = smooth_step(time / self.ramp)[None, :, None]
        lead, gain, offset = np.moveaxis(values.reshape(len(values), 1, len(self.joints), 3), 3, 0)
        at = np.clip((time[None, :, None] + grown * lead) / self.period, 0.0, len(self.wanted) - 1)
        before = np.minimum(at.astype(np.int64), len(self.wanted) - 2)
        column, first = np.arange(len(self.joints)), self.wanted[0]
        here, there = self.wanted[before, column], self.wanted[before + 1, column]
        ahead = here + (at - before) * (there - here)
        return np.asarray(first + (1 + grown * gain) * (ahead - first) + grown * offset)


def feed_forward(robot: Robot, joints: Sequence[str], wanted: FloatArray, period: float) -> FeedForward:
    """Feed-forward of a motion (n, j) for those of its joints that a position servo drives.

    Raises
    ------
    UsageError
        If none of them does.
    """
    servos = commanded_joints(robot)
    rows = [i for i, joint in enumerate(joints) if joint in servos]
    if not rows:
        raise UsageError(f"model {robot.name}: no position servo drives {some(joints)}, which the motion moves")
    return FeedForward(tuple(joints[i] for i in rows), wanted[:, rows], period)
