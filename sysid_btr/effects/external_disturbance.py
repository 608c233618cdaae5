"""A push from outside: a torque on a joint between two moments."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from sysid_btr._typing import FloatArray
from sysid_btr.effects.base import Effect, Probe
from sysid_btr.models.modifier import Kind, Rig
from sysid_btr.models.scales import JointScale


@dataclass(frozen=True)
class ExternalDisturbance(Effect):
    """A rectangular pulse, exact in the mean over each step."""

    name: ClassVar[str] = "external_disturbance"
    title: ClassVar[str] = "push from outside"
    held: ClassVar[tuple[str, ...]] = ("start", "duration")
    signed: ClassVar[bool] = True
    kinds: ClassVar[tuple[Kind, ...]] = (
        Kind("torque", "Nm", 0.0, -50.0, 50.0, 0.1),
        Kind("start", "s", 0.0, 0.0, 1e5, 0.02),
        Kind("duration", "s", 0.1, 0.001, 100.0, 0.02),
    )
    confounders: ClassVar[tuple[tuple[str, str], ...]] = (("payload", "a push that is not repeated"),)

    @classmethod
    def sized(cls, scale: JointScale) -> tuple[Kind, ...]:
        peak = max(scale.torque_peak, 1e-9)
        return (
            Kind("torque", scale.unit("Nm"), 0.0, -20 * peak, 20 * peak, 0.1 * scale.torque_rms),
            *cls.kinds[1:],
        )

    @classmethod
    def probes(cls, scale: JointScale) -> tuple[Probe, ...]:
        return ()

    @classmethod
    def probe_at(cls, scale: JointScale, start: float, duration: float) -> Probe:
        """A probe at a time that the residual proposes."""
        return ((0.1 * scale.torque_rms, start, duration),)

    def applied_torque(self, rig: Rig, values: FloatArray, time: FloatArray) -> FloatArray:
        torque = np.zeros((rig.size, len(time) - 1, len(rig.index.joints)))
        for place, column in enumerate(rig.index.of(self.places)):
            amount, start, duration = (values[:, place, k, None] for k in range(3))
            overlap = np.minimum(time[None, 1:], start + duration) - np.maximum(time[None, :-1], start)
            torque[:, :, column] += amount * np.maximum(overlap, 0.0) / rig.timestep
        return torque
