"""A torque that repeats with the joint's angle: motor cogging, an eccentric gear."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from sysid_btr._typing import FloatArray, IntArray
from sysid_btr.effects.base import Effect, Probe
from sysid_btr.models.modifier import Kind, Step
from sysid_btr.models.scales import JointScale


@dataclass(frozen=True)
class Cogging(Effect):
    """Law: torque = a sin(n q) + b cos(n q)."""

    name: ClassVar[str] = "cogging"
    title: ClassVar[str] = "torque that repeats with the angle"
    held: ClassVar[tuple[str, ...]] = ("number",)
    signed: ClassVar[bool] = True
    law_acts: ClassVar[tuple[str, ...]] = ()
    kinds: ClassVar[tuple[Kind, ...]] = (
        Kind("sine", "Nm", 0.0, -5.0, 5.0, 0.05),
        Kind("cosine", "Nm", 0.0, -5.0, 5.0, 0.05),
        Kind("number", "1/rad", 20.0, 1.0, 400.0, 0.05),
    )
    confounders: ClassVar[tuple[tuple[str, str], ...]] = (
        ("encoder_scale", "a logged effort"),
        ("joint_spring", "motion over several periods"),
    )

    @classmethod
    def sized(cls, scale: JointScale) -> tuple[Kind, ...]:
        peak, size = max(scale.torque_peak, 1e-9), 0.1 * scale.torque_rms
        turn = 2 * np.pi / max(scale.span, 1e-9)
        return (
            Kind("sine", scale.unit("Nm"), 0.0, -peak, peak, size),
            Kind("cosine", scale.unit("Nm"), 0.0, -peak, peak, size),
            Kind("number", "1/rad" if not scale.slide else "1/m", 4 * turn, turn, 200 * turn, 0.05 * turn),
        )

    @classmethod
    def probes(cls, scale: JointScale) -> tuple[Probe, ...]:
        return ()

    @classmethod
    def probe_at(cls, scale: JointScale, number: float) -> Probe:
        """A probe at a spatial frequency that the residual proposes."""
        size = 0.1 * scale.torque_rms
        return ((size, 0.0, number), (0.0, size, number))

    def law(self, step: Step, values: FloatArray, memory: Any, index: IntArray) -> None:
        phase = values[:, :, 2] * step.qpos[:, index]
        step.joint_torque[:, index] += values[:, :, 0] * np.sin(phase) + values[:, :, 1] * np.cos(phase)
