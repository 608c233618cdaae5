"""A servo that follows its command no faster than a certain rate."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from sysid_btr._typing import FloatArray
from sysid_btr.terms.base import BatchModel, Kind
from sysid_btr.terms.effect import Effect, Probe
from sysid_btr.terms.scales import JointScale


@dataclass(frozen=True)
class SlewLimit(Effect):
    """The command is rate-limited before the replay; neutral above every rate of the log."""

    name: ClassVar[str] = "slew_limit"
    title: ClassVar[str] = "limit of the commanded rate"
    scope: ClassVar = "servo"
    kinds: ClassVar[tuple[Kind, ...]] = (Kind("rate", "rad/s", 1000.0, 0.05, 1000.0, 0.2),)
    held: ClassVar[tuple[str, ...]] = ("rate",)
    everywhere: ClassVar[bool] = True
    confounders: ClassVar[tuple[tuple[str, str], ...]] = (
        ("torque_limit", "slow motion under a large load"),
        ("speed_torque_limit", "slow motion under a large load"),
    )

    @classmethod
    def sized(cls, scale: JointScale) -> tuple[Kind, ...]:
        speed = max(scale.velocity_peak, 1e-9)
        return (Kind("rate", scale.unit("rad/s"), 3 * speed, 0.05 * speed, 3 * speed, 0.05 * speed),)

    @classmethod
    def probes(cls, scale: JointScale) -> tuple[Probe, ...]:
        return tuple(((f * max(scale.velocity_peak, 1e-9),),) for f in (0.9, 0.7, 0.5, 0.3))

    def shape_command(self, batch: BatchModel, values: FloatArray, command: FloatArray) -> FloatArray:
        shaped = np.array(command)
        columns = batch.index.of(self.places)
        wanted = shaped[:, :, columns]
        # at the upper bound there is no limit: a held command jumps faster than the motion it describes
        off = values[:, :, 0] >= np.array([p.upper for p in self.spread_parameters(0)])
        most = np.where(off, np.inf, values[:, :, 0] * batch.timestep)
        if off.all():
            return shaped
        now = wanted[:, 0].copy()
        for k in range(wanted.shape[1]):
            now += np.clip(wanted[:, k] - now, -most, most)
            shaped[:, k, columns] = now
        return shaped
