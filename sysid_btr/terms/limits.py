"""Limits of a drive: torque, torque over speed, rate of the command."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from sysid_btr._typing import FloatArray, IntArray
from sysid_btr.terms.base import BatchModel, Fields, Kind
from sysid_btr.terms.drives import joint_drives
from sysid_btr.terms.effect import Effect, Probe
from sysid_btr.terms.law import Step
from sysid_btr.terms.scales import JointScale

if TYPE_CHECKING:
    import mujoco


@dataclass(frozen=True)
class LimitedTorque(Effect):
    """Base: a drive that cannot give more than a certain torque."""

    name: ClassVar[str] = "torque_limit"
    family: ClassVar[str] = "saturation"
    scope: ClassVar = "drive"
    kinds: ClassVar[tuple[Kind, ...]] = (Kind("limit", "Nm", 100.0, 0.01, 100.0, 0.1),)
    held: ClassVar[tuple[str, ...]] = ("limit",)
    confounders: ClassVar[tuple[tuple[str, str], ...]] = (
        ("speed_torque_limit", "the limit reached at several speeds"),
        ("slew_limit", "slow motion under a large load"),
    )


@dataclass(frozen=True)
class TorqueLimit(LimitedTorque):
    """A servo that cannot give more than a certain torque.

    Native: `actuator_forcerange`. No limit at the neutral value. A further limit stays within the model's own; as the
    model's own, of both signs, it takes that one's place.
    """

    field: ClassVar[str] = "force_limit"
    title: ClassVar[str] = "limit of the torque"

    @classmethod
    def sized(cls, scale: JointScale) -> tuple[Kind, ...]:
        peak = max(scale.torque_peak, 1e-9)
        return (Kind("limit", "Nm", 2 * peak, 0.03 * peak, 2 * peak, 0.05 * peak),)

    @classmethod
    def probes(cls, scale: JointScale) -> tuple[Probe, ...]:
        return tuple(((f * max(scale.torque_peak, 1e-9),),) for f in (0.85, 0.65, 0.45, 0.28))

    @classmethod
    def own_value(cls, model: mujoco.MjModel, place: str) -> float:
        for drive in joint_drives(model):
            if drive.joint == place and model.actuator_forcelimited[drive.actuator]:
                return float(model.actuator_forcerange[drive.actuator, 1] * abs(model.actuator_gear[drive.actuator, 0]))
        return float("inf")

    def model_fields(self, batch: BatchModel, values: FloatArray) -> Fields:
        ids = batch.index.actuator[batch.index.of(self.places)]
        limited, ranges = batch.read("actuator_forcelimited"), batch.read("actuator_forcerange")
        bound = values[:, :, 0] / np.abs(batch.model.actuator_gear[ids, 0])
        was, low, high = limited[:, ids].astype(bool), ranges[:, ids, 0], ranges[:, ids, 1]
        inside = was & (not self.absolute)
        none = self.neutral_of(0)
        on = was | (values[:, :, 0] != none) if self.absolute else values[:, :, 0] < none
        ranges[:, ids, 0] = np.where(on, np.where(inside, np.maximum(-bound, low), -bound), low)
        ranges[:, ids, 1] = np.where(on, np.where(inside, np.minimum(bound, high), bound), high)
        limited[:, ids] = was | on
        return {"actuator_forcelimited": limited, "actuator_forcerange": ranges}


@dataclass(frozen=True)
class TorqueLimitSoft(LimitedTorque):
    """A drive that gives the less of what it is asked for, the nearer that comes to a limit: iron that saturates.

    Law: torque = asked / sqrt(1 + (asked / limit)^2); none at its neutral value.
    """

    variant: ClassVar[str] = "soft"
    title: ClassVar[str] = "soft limit of the torque"
    law_acts: ClassVar[tuple[str, ...]] = ("servo",)

    @classmethod
    def sized(cls, scale: JointScale) -> tuple[Kind, ...]:
        peak = max(scale.torque_peak, 1e-9)
        return (Kind("limit", "Nm", 10 * peak, 0.1 * peak, 10 * peak, 0.05 * peak),)

    @classmethod
    def probes(cls, scale: JointScale) -> tuple[Probe, ...]:
        return tuple(((f * max(scale.torque_peak, 1e-9),),) for f in (2.0, 1.0, 0.5, 0.25))

    def law_numbers(self, values: FloatArray) -> FloatArray:
        return np.where(values >= self.neutral_of(0)[:, None], np.inf, values)

    @staticmethod
    def law(step: Step, numbers: FloatArray, memory: FloatArray, places: IntArray) -> None:
        for p, j in enumerate(places):
            share = step.gain[j] * step.torque[j] / numbers[p, 0]
            step.gain[j] /= np.sqrt(1 + share * share)


@dataclass(frozen=True)
class SpeedTorqueLimit(Effect):
    """A motor whose largest torque falls with speed: stall torque at rest, none at the no-load speed.

    Law: -stall (1 + v / w0) <= torque <= stall (1 - v / w0), never beyond +-stall; none at its neutral value.
    """

    name: ClassVar[str] = "speed_torque_limit"
    family: ClassVar[str] = "saturation"
    title: ClassVar[str] = "torque limit that falls with speed"
    scope: ClassVar = "drive"
    law_acts: ClassVar[tuple[str, ...]] = ("limit",)
    kinds: ClassVar[tuple[Kind, ...]] = (
        Kind("stall", "Nm", 100.0, 0.01, 100.0, 0.1),
        Kind("no_load_speed", "rad/s", 100.0, 0.1, 100.0, 0.5),
    )
    includes: ClassVar[tuple[str, ...]] = ("torque_limit",)
    held: ClassVar[tuple[str, ...]] = ("stall", "no_load_speed")
    confounders: ClassVar[tuple[tuple[str, str], ...]] = (("torque_limit", "the limit reached at several speeds"),)

    @classmethod
    def sized(cls, scale: JointScale) -> tuple[Kind, ...]:
        peak, speed = max(scale.torque_peak, 1e-9), max(scale.velocity_peak, 1e-9)
        return (
            Kind("stall", "Nm", 2 * peak, 0.03 * peak, 2 * peak, 0.05 * peak),
            Kind("no_load_speed", "rad/s", 2 * speed, 0.2 * speed, 20 * speed, 0.2 * speed),
        )

    @classmethod
    def probes(cls, scale: JointScale) -> tuple[Probe, ...]:
        peak, speed = max(scale.torque_peak, 1e-9), max(scale.velocity_peak, 1e-9)
        return tuple(((a * peak, b * speed),) for a in (1.2, 0.8, 0.5) for b in (1.2, 2.5))

    def law_numbers(self, values: FloatArray) -> FloatArray:
        none = values[:, :, :1] >= self.neutral_of(0)[:, None]
        return np.concatenate([np.where(none, np.inf, values[:, :, :1]), values[:, :, 1:]], axis=2)

    @staticmethod
    def law(step: Step, numbers: FloatArray, memory: FloatArray, places: IntArray) -> None:
        for p, j in enumerate(places):
            stall, fraction = numbers[p, 0], step.qvel[j] / numbers[p, 1]
            high = stall * max(1 - max(fraction, 0.0), 1e-9)
            low = -stall * max(1 + min(fraction, 0.0), 1e-9)
            step.limit_high[j] = min(step.limit_high[j], high)
            step.limit_low[j] = max(step.limit_low[j], low)


@dataclass(frozen=True)
class SlewLimit(Effect):
    """A servo that follows its command no faster than a certain rate.

    Command: limited in its rate before the replay, by its mean over each step; neutral above every rate of the log.
    """

    name: ClassVar[str] = "slew_limit"
    family: ClassVar[str] = "saturation"
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
        return (Kind("rate", "rad/s", 3 * speed, 0.05 * speed, 3 * speed, 0.05 * speed),)

    @classmethod
    def probes(cls, scale: JointScale) -> tuple[Probe, ...]:
        return tuple(((f * max(scale.velocity_peak, 1e-9),),) for f in (0.9, 0.7, 0.5, 0.3))

    def shape_command(self, batch: BatchModel, values: FloatArray, command: FloatArray, time: FloatArray) -> FloatArray:
        shaped = np.array(command)
        columns = batch.index.of(self.places)
        wanted = shaped[:, :, columns]
        # at the neutral value there is no limit: a held command jumps faster than the motion it describes
        off = values[:, :, 0] >= self.neutral_of(0)
        most = np.where(off, np.inf, values[:, :, 0] * batch.timestep)
        if off.all():
            return shaped
        now = wanted[:, 0]
        for k in range(wanted.shape[1]):
            far = wanted[:, k] - now
            step = np.where(off, far, np.clip(far, -most, most))
            # of a step in which it is on its way the drive sees the mean
            on_its_way = np.minimum(np.abs(far) / most, 1.0)
            shaped[:, k, columns] = now + step * (1 - 0.5 * on_its_way)
            now = now + step
        return shaped
