"""Sizes that matter at each joint, read from a log: bounds and steps follow from them, for any robot."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np


@dataclass(frozen=True)
class JointScale:
    """How large things get at one joint (rad, Nm; or m, N for a slide).

    Attributes
    ----------
    torque_rms, torque_peak : of the servo in the plain model.
    velocity_rms, velocity_peak, acceleration_rms : of the motion in the plain model.
    span : of the motion.
    slide : whether the joint is a slide.
    measured_rms, measured_peak : torque that the servo's law gives for the command and the measured position;
        far more than `torque_rms` where something holds the joint back. 0 where no position is logged.
    centre : in the middle of the motion.
    seconds : length of the longest log.
    """

    torque_rms: float
    torque_peak: float
    velocity_rms: float
    velocity_peak: float
    acceleration_rms: float
    span: float
    slide: bool = False
    measured_rms: float = 0.0
    measured_peak: float = 0.0
    centre: float = 0.0
    seconds: float = 10.0

    @property
    def damping(self) -> float:
        """Viscous coefficient whose torque is the servo's rms torque."""
        return self.torque_rms / self.velocity_rms

    @property
    def counter_peak(self) -> float:
        """Largest torque that the servo can have worked against."""
        return max(self.torque_peak, self.measured_peak, 1e-9)

    @property
    def inertia(self) -> float:
        """Inertia whose torque is the servo's rms torque."""
        return self.torque_rms / self.acceleration_rms

    def unit(self, hinge: str) -> str:
        """Unit of a hinge quantity, or its counterpart for a slide."""
        return SLIDE_UNITS.get(hinge, hinge) if self.slide else hinge


Scales = Mapping[str, JointScale]

SLIDE_UNITS = {
    "Nm": "N",
    "1/Nm": "1/N",
    "1/Nm2": "1/N2",
    "1/rad": "1/m",
    "Nm/(rad s)": "N/(m s)",
    "Nm s/rad": "N s/m",
    "Nm s2/rad2": "N s2/m2",
    "kg m2": "kg",
    "Nm/rad": "N/m",
    "rad": "m",
    "rad/s": "m/s",
    "rad/Nm": "m/N",
}


def scale_at(scales: Scales, place: str) -> JointScale:
    """Size at a joint; for a body that of the joint it hangs on; for the robot the largest of all."""
    if place in scales:
        return scales[place]
    return _combined(list(scales.values()), max, slide=False)


def largest_scale(scales: Scales, places: Sequence[str]) -> JointScale:
    """Size at the one of several places that has the largest torques."""
    return max((scale_at(scales, p) for p in places), key=lambda s: s.torque_peak)


def middle_scale(scales: Sequence[JointScale]) -> JointScale:
    """Median size of several joints."""
    return _combined(scales, np.median, slide=scales[0].slide)


def _combined(scales: Sequence[JointScale], how: Callable[[list[float]], Any], *, slide: bool) -> JointScale:
    names = [f.name for f in fields(JointScale) if f.name != "slide"]
    return JointScale(slide=slide, **{name: float(how([getattr(s, name) for s in scales])) for name in names})
