"""The drive's own law: gains, integral action, back-EMF, delay of commands."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from sysid_btr._typing import FloatArray, IntArray
from sysid_btr.terms.base import BatchModel, Kind, Step
from sysid_btr.terms.effect import Effect, Probe
from sysid_btr.terms.fields import delay_command
from sysid_btr.terms.scales import JointScale


@dataclass(frozen=True)
class IntegralGain(Effect):
    """A servo with integral action: torque grows while the error lasts.

    Law: torque += ki * integral of (command - position).
    """

    name: ClassVar[str] = "integral_gain"
    title: ClassVar[str] = "integral action of the servo"
    scope: ClassVar = "servo"
    law_acts: ClassVar[tuple[str, ...]] = ("servo",)
    kinds: ClassVar[tuple[Kind, ...]] = (Kind("ki", "Nm/(rad s)", 0.0, 0.0, 200.0, 1.0),)
    everywhere: ClassVar[bool] = True
    confounders: ClassVar[tuple[tuple[str, str], ...]] = (
        ("joint_spring", "long holds"),
        ("payload", "long holds"),
    )

    @classmethod
    def sized(cls, scale: JointScale) -> tuple[Kind, ...]:
        size = scale.torque_rms / (0.02 * max(scale.span, 1e-9))
        return (Kind("ki", scale.unit("Nm/(rad s)"), 0.0, 0.0, 10 * size, 0.1 * size),)

    def start_law(self, batch: BatchModel, values: FloatArray) -> FloatArray:
        return np.zeros(values.shape[:2])

    def law(self, step: Step, values: FloatArray, memory: Any, index: IntArray) -> None:
        error = step.command[:, index] - step.qpos[:, index]
        # the integral at the middle of the step
        step.motor_torque[:, index] += values[:, :, 0] * (memory + 0.5 * step.timestep * error)
        memory += step.timestep * error


@dataclass(frozen=True)
class BackEmf(Effect):
    """Back-EMF: a torque against the motion that a motor makes while it is driven, and not while it is switched off.

    With its terminals held at a voltage u a motor gives k (u - k w) / R: damping by k^2 / R that is in no friction, and
    by which the largest torque of either sign moves too. A bridge that is off breaks the current, and the damping is
    gone.

    Law: torque - b v while the drive is on, of which the limits of the torque are those without it, less b v.
    """

    name: ClassVar[str] = "back_emf"
    title: ClassVar[str] = "damping by back-EMF"
    scope: ClassVar = "servo"
    law_acts: ClassVar[tuple[str, ...]] = ("servo", "limit")
    kinds: ClassVar[tuple[Kind, ...]] = (Kind("b", "Nm s/rad", 0.0, 0.0, 10.0, 0.05),)
    needs: ClassVar[str] = "enabled"
    yields_to: ClassVar[tuple[str, ...]] = ("viscous_damping",)
    confounders: ClassVar[tuple[tuple[str, str], ...]] = (
        ("viscous_damping", "free motion with the drive switched off, or a logged effort"),
        ("kv", "motion in which the drive saturates"),
    )

    @classmethod
    def sized(cls, scale: JointScale) -> tuple[Kind, ...]:
        return (Kind("b", scale.unit("Nm s/rad"), 0.0, 0.0, 5 * scale.damping, 0.1 * scale.damping),)

    def law(self, step: Step, values: FloatArray, memory: Any, index: IntArray) -> None:
        for place, column in enumerate(index):
            on = step.inputs.get(f"enabled.{self.places[place]}", np.float64(1.0))
            change = values[:, place, 0] * step.qvel[:, column] * on
            step.motor_torque[:, column] -= change
            step.limit_low[:, column] -= change
            step.limit_high[:, column] -= change


@dataclass(frozen=True)
class CommandDelay(Effect):
    """Delay between the logged command and the servo that obeys it.

    Held commands are shifted before the replay, exactly, by any fraction of a step.
    """

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
