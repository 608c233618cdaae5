"""A torque that repeats with the joint's angle: motor cogging, an eccentric gear."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from sysid_btr._typing import FloatArray, IntArray
from sysid_btr.terms.base import Kind, Step
from sysid_btr.terms.effect import Effect, Probe
from sysid_btr.terms.scales import JointScale

PHASES, SIZES, SHIFTS = 8, (1.0, 1.7), (-0.04, -0.02, 0.0, 0.02, 0.04)
"""From which a refit may begin, relative to what a linear scan says."""


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
        peak, size = 2 * scale.counter_peak, 0.1 * scale.torque_rms
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

    @classmethod
    def ladder(cls, values: FloatArray) -> FloatArray:
        """Nearby numbers of teeth in all phases: a period off over the range of motion is a minimum of its own."""
        sine, cosine, number = values
        size, phase = np.hypot(sine, cosine), np.arctan2(cosine, sine)
        turns = phase + 2 * np.pi * np.arange(PHASES) / PHASES
        return np.array(
            [
                (size * larger * np.cos(turn), size * larger * np.sin(turn), number * (1 + shift))
                for larger in SIZES
                for shift in SHIFTS
                for turn in turns
            ]
        )

    def law(self, step: Step, values: FloatArray, memory: Any, index: IntArray) -> None:
        phase = values[:, :, 2] * step.qpos[:, index]
        step.joint_torque[:, index] += values[:, :, 0] * np.sin(phase) + values[:, :, 1] * np.cos(phase)
