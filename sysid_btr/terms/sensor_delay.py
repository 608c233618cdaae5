"""Delay between a joint's position and the log of it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from sysid_btr._typing import FloatArray, IntArray
from sysid_btr.interpolation import hermite
from sysid_btr.terms.base import BatchModel, Kind, Outputs
from sysid_btr.terms.effect import Effect, Probe
from sysid_btr.terms.scales import JointScale


@dataclass(frozen=True)
class SensorDelay(Effect):
    """Predicted positions and velocities are read earlier, by cubic interpolation."""

    name: ClassVar[str] = "sensor_delay"
    title: ClassVar[str] = "delay of the sensor"
    kinds: ClassVar[tuple[Kind, ...]] = (Kind("time", "s", 0.0, 0.0, 0.15, 0.004),)
    needs: ClassVar[str] = "position, and a sensor or a coupled joint that is not delayed"
    yields_to: ClassVar[tuple[str, ...]] = ("command_delay",)
    everywhere: ClassVar[bool] = True
    confounders: ClassVar[tuple[tuple[str, str], ...]] = (
        ("command_delay", "a second sensor that is not delayed (current, effort, IMU)"),
    )

    @classmethod
    def probes(cls, scale: JointScale) -> tuple[Probe, ...]:
        return (((0.008,),), ((0.025,),))

    def read_out(self, batch: BatchModel, values: FloatArray, outputs: Outputs) -> None:
        time = outputs.time
        for place, column in enumerate(batch.index.of(self.places)):
            delay = values[:, place, 0]
            if not delay.any():
                continue
            early = np.maximum(time[None, :] - delay[:, None], time[0])
            after = np.clip(np.searchsorted(time, early, side="left"), 1, len(time) - 1)
            span = time[after] - time[after - 1]
            f = (early - time[after - 1]) / span
            p, v = outputs.position[:, :, column], outputs.velocity[:, :, column]

            def take(array: FloatArray, at: IntArray) -> FloatArray:
                return np.take_along_axis(array, at, axis=1)

            v0, v1 = take(v, after - 1), take(v, after)
            outputs.position[:, :, column] = hermite(f, span, take(p, after - 1), take(p, after), v0, v1)
            outputs.velocity[:, :, column] = v0 + f * (v1 - v0)
