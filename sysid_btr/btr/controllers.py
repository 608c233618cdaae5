"""Controllers: points of a space, each of which says what every joint is commanded at any time."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields
from functools import cached_property
from typing import Protocol

import numpy as np

from sysid_btr._typing import FloatArray
from sysid_btr.errors import UsageError
from sysid_btr.models.ant import JOINTS
from sysid_btr.models.gait import ARMS, Gait, gait


class ControllerSpace(Protocol):
    """The space of controllers that is searched (C in the paper).

    Bounds are finite, and `start` lies within them.
    """

    @property
    def names(self) -> tuple[str, ...]:
        """Names of a controller's numbers, length ``p``."""
        ...

    @property
    def lower(self) -> FloatArray:
        """Lower bounds, (p,)."""
        ...

    @property
    def upper(self) -> FloatArray:
        """Upper bounds, (p,)."""
        ...

    @property
    def start(self) -> FloatArray:
        """The controller known beforehand (c_0), (p,)."""
        ...

    @property
    def joints(self) -> tuple[str, ...]:
        """Joints that are commanded."""
        ...

    def commands(self, values: FloatArray, time: FloatArray) -> FloatArray:
        """Commands (m, n, joints) of controllers (m, p) at times (n,) s since the start, rad.

        All NaN for a controller that cannot be played; the first one is a pose in which the robot can stand.
        """
        ...


@dataclass(frozen=True, eq=False)
class Controller:
    """One controller.

    Attributes
    ----------
    values : (p,) of a controller space.
    label : names it on disk.
    """

    values: FloatArray
    label: str = ""


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
        share = np.clip(time / self.ramp, 0.0, 1.0)
        grown = share * share * (3 - 2 * share)
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


SPACES: Mapping[str, Callable[[], ControllerSpace]] = {"ant": ant_gait, "nao": NaoGait, "nao:table1": NaoGait}
"""Controller space of each built-in robot that walks."""


def get_space(robot: str) -> ControllerSpace:
    """The controller space of a robot.

    Raises
    ------
    UsageError
        Naming the robots that have one.
    """
    if robot not in SPACES:
        raise UsageError(
            f"model {robot}: there are no built-in controllers for it, only for {', '.join(SPACES)}. From Python, "
            "pass any controller space to sysid_btr.btr.loop.back_to_reality"
        )
    return SPACES[robot]()
