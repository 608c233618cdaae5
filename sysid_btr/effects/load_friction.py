"""Load-dependent friction: proportional to the torque that the gear transmits (BAM, arXiv:2410.08650)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from sysid_btr._typing import FloatArray, IntArray
from sysid_btr.effects.base import Effect
from sysid_btr.models.modifier import Kind, Step


@dataclass(frozen=True)
class LoadFriction(Effect):
    """Law: friction follows the servo's torque at the middle of each step."""

    name: ClassVar[str] = "load_friction"
    title: ClassVar[str] = "friction per unit of load"
    scope: ClassVar = "servo"
    law_acts: ClassVar[tuple[str, ...]] = ("friction",)
    kinds: ClassVar[tuple[Kind, ...]] = (Kind("ratio", "1", 0.0, 0.0, 0.9, 0.08),)
    steps: ClassVar[tuple[float, ...]] = (1.0, 4.0)
    everywhere: ClassVar[bool] = True
    confounders: ClassVar[tuple[tuple[str, str], ...]] = (
        ("coulomb_friction", "the same motion under different loads"),
    )

    def law(self, step: Step, values: FloatArray, memory: Any, index: IntArray) -> None:
        step.friction[:, index] += values[:, :, 0] * np.abs(step.torque[:, index])
