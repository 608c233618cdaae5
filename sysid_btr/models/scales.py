"""Sizes that matter at each joint, read from a log: bounds and steps follow from them, for any robot."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass


@dataclass(frozen=True)
class JointScale:
    """How large things get at one joint (rad, Nm; or m, N for a slide).

    Attributes
    ----------
    torque_rms, torque_peak : of the servo in the plain model.
    velocity_rms, velocity_peak, acceleration_rms : of the motion in the plain model.
    span : of the motion.
    slide : whether the joint is a slide.
    """

    torque_rms: float
    torque_peak: float
    velocity_rms: float
    velocity_peak: float
    acceleration_rms: float
    span: float
    slide: bool = False

    @property
    def damping(self) -> float:
        """Viscous coefficient whose torque is the servo's rms torque."""
        return self.torque_rms / self.velocity_rms

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
    "Nm s/rad": "N s/m",
    "Nm s2/rad2": "N s2/m2",
    "kg m2": "kg",
    "Nm/rad": "N/m",
    "rad": "m",
    "rad/s": "m/s",
    "rad/Nm": "m/N",
}
