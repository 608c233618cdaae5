"""Delay between the logged command and the servo that obeys it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from sysid_btr._typing import FloatArray
from sysid_btr.terms.base import BatchModel, Kind
from sysid_btr.terms.effect import Effect, Probe
from sysid_btr.terms.fields import delay_command
from sysid_btr.terms.scales import JointScale


@dataclass(frozen=True)
class CommandDelay(Effect):
    """Held commands are shifted before the replay, exactly, by any fraction of a step."""

    name: ClassVar[str] = "command_delay"
    title: ClassVar[str] = "delay of the command"
    scope: ClassVar = "servo"
    kinds: ClassVar[tuple[Kind, ...]] = (Kind("time", "s", 0.0, 0.0, 0.15, 0.004),)
    everywhere: ClassVar[bool] = True
    confounders: ClassVar[tuple[tuple[str, str], ...]] = (
        ("sensor_delay", "a second sensor that is not delayed (current, effort, IMU)"),
        ("viscous_damping", "motion at several frequencies"),
    )

    @classmethod
    def probes(cls, scale: JointScale) -> tuple[Probe, ...]:
        return (((0.008,),), ((0.025,),))

    def shape_command(self, batch: BatchModel, values: FloatArray, command: FloatArray) -> FloatArray:
        return delay_command(command, batch.index.of(self.places), values[:, :, 0] / batch.timestep)
