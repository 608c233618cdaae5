"""Gaits as controllers: sines at every joint, the paper's ant, the Nao's walk."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from functools import cached_property

import numpy as np

from sysid_btr._typing import FloatArray
from sysid_btr.btr.controllers import commanded_joints, rest_of
from sysid_btr.errors import UsageError
from sysid_btr.interpolation import smooth_step
from sysid_btr.models.ant import JOINTS
from sysid_btr.models.gait import ARMS, Gait, gait
from sysid_btr.models.robot import Robot, joint_ranges

ROOM = 0.05
"""rad (m) of travel to each side of where it rests, below which a joint takes no part in a gait."""


@dataclass(frozen=True)
class SineGait:
    """``r_i = theta_i + a_i sin(omega t + psi_i)`` for every joint (section 4.1.1); amplitudes grow from zero.

    Attributes
    ----------
    joints : commanded.
    centre : theta, rad, of each joint.
    amplitude : largest, rad, of each joint.
    frequency : Hz.
    ramp : s in which the amplitudes grow.
    start_amplitude : of the controller known beforehand, as a fraction of the largest.
    """

    joints: tuple[str, ...]
    centre: tuple[float, ...]
    amplitude: tuple[float, ...]
    frequency: float = 1.0
    ramp: float = 0.5
    start_amplitude: float = 0.1

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(f"{part}:{joint}" for joint in self.joints for part in ("amplitude", "phase"))

    @property
    def lower(self) -> FloatArray:
        return np.tile([0.0, -np.pi], len(self.joints))

    @property
    def upper(self) -> FloatArray:
        return np.stack([np.array(self.amplitude), np.full(len(self.joints), np.pi)], axis=1).ravel()

    @property
    def start(self) -> FloatArray:
        start = np.zeros(2 * len(self.joints))
        start[::2] = self.start_amplitude * np.array(self.amplitude)
        return start

    def commands(self, values: FloatArray, time: FloatArray) -> FloatArray:
        grown = smooth_step(time / self.ramp)
        angle = 2 * np.pi * self.frequency * time[None, :, None] + values[:, None, 1::2]
        return np.asarray(np.array(self.centre) + values[:, None, ::2] * grown[None, :, None] * np.sin(angle))


@dataclass(frozen=True)
class NaoGait:
    """The walk of `sysid_btr.models.gait` in some of its parameters, the others at their defaults.

    Attributes
    ----------
    bounds : parameter of the gait -> (lower, upper).
    """

    bounds: Mapping[str, tuple[float, float]] = field(
        default_factory=lambda: {
            "step_length": (0.0, 0.06),
            "step_height": (0.005, 0.03),
            "period": (0.6, 1.6),
            "sway": (0.02, 0.08),
            "crouch": (0.008, 0.04),
            "lean": (-0.02, 0.02),
        }
    )

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(self.bounds)

    @property
    def lower(self) -> FloatArray:
        return np.array([low for low, _ in self.bounds.values()])

    @property
    def upper(self) -> FloatArray:
        return np.array([high for _, high in self.bounds.values()])

    @property
    def start(self) -> FloatArray:
        defaults = {f.name: f.default for f in fields(Gait)}
        start = np.array([defaults[name] for name in self.bounds], dtype=np.float64)
        return np.clip(start, self.lower, self.upper)

    @cached_property
    def joints(self) -> tuple[str, ...]:
        return (*ARMS, *(side + joint for side in "LR" for joint in _LEG))

    def commands(self, values: FloatArray, time: FloatArray) -> FloatArray:
        result = np.full((len(values), len(time), len(self.joints)), np.nan)
        for row, own in enumerate(values):
            try:
                angles = gait(Gait(**dict(zip(self.bounds, map(float, own), strict=True))), time)
            except UsageError:  # legs too short for it
                continue
            result[row] = np.stack([angles[joint] for joint in self.joints], axis=1)
        return result


_LEG = ("HipYawPitch", "HipRoll", "HipPitch", "KneePitch", "AnklePitch", "AnkleRoll")


def ant_gait() -> SineGait:
    """The 36 parameters of the paper's ant."""
    reach = {"Coxa": 0.5, "Femur": 0.35, "Tibia": 0.35}
    amplitude = tuple(next(r for part, r in reach.items() if joint.endswith(part)) for joint in JOINTS)
    return SineGait(JOINTS, (0.0,) * len(JOINTS), amplitude)


def sine_gait(robot: Robot, frequency: float = 1.0, reach: float = 0.5) -> SineGait:
    """Sines about the pose in which a robot stands, for every position servo that has room for them.

    Parameters
    ----------
    robot : any, with legs.
    frequency : Hz.
    reach : rad, largest amplitude.

    Raises
    ------
    UsageError
        If no servo has.
    """
    joints, ends = commanded_joints(robot), joint_ranges(robot)
    centre = dict(zip(joints, rest_of(robot, joints), strict=True))
    room = {j: min([reach, *(abs(end - centre[j]) for end in ends.get(j, ()))]) for j in joints}
    free = tuple(j for j in joints if room[j] >= ROOM)
    if not free:
        raise UsageError(
            f"model {robot.name}: no position servo has room for a gait about the pose in which the model stands (its "
            "first keyframe, or zero). Another pose is chosen by --at; servos are put on joints by --servo"
        )
    return SineGait(free, tuple(float(centre[j]) for j in free), tuple(float(room[j]) for j in free), frequency)
