"""Torque lost with the supply's voltage and with heat."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

from sysid_btr._typing import FloatArray, IntArray
from sysid_btr.terms.base import Kind, Term
from sysid_btr.terms.effect import Effect, Probe
from sysid_btr.terms.law import Step, used_in_laws
from sysid_btr.terms.scales import JointScale

LAGS = (0.0, 0.1)
"""s, of a supply, that a scan asks for."""


@used_in_laws
def total_torque(step: Step, places: IntArray) -> float:
    """Sum of the servos' torques, whichever their signs: what they take from their supply."""
    total = 0.0
    for j in places:
        total += abs(step.torque[j])
    return total


@used_in_laws
def load_of_supply(step: Step, lag: float, memory: FloatArray, places: IntArray) -> float:
    """Sum of the servos' torques as the supply's voltage follows it, after a lag (s); it begins settled.

    Memory: the load of the last step, and whether there was one.
    """
    total = total_torque(step, places)
    if memory[0, 1] > 0 and lag > 0:
        total += (memory[0, 0] - total) * math.exp(-step.timestep / lag)
    memory[0, 0], memory[0, 1] = total, 1.0
    return total


@dataclass(frozen=True)
class VoltageSag(Effect):
    """A supply that sags: every servo's gain falls, slowly with the battery or at once with the load.

    Law: gain = 1 - rate * time; an empty battery.
    """

    name: ClassVar[str] = "voltage_sag"
    family: ClassVar[str] = "supply"
    title: ClassVar[str] = "loss of supply voltage per second"
    scope: ClassVar = "robot"
    variant: ClassVar[str] = "time"
    law_acts: ClassVar[tuple[str, ...]] = ("servo",)
    kinds: ClassVar[tuple[Kind, ...]] = (Kind("rate", "1/s", 0.0, 0.0, 0.05, 0.002),)
    confounders: ClassVar[tuple[tuple[str, str], ...]] = (
        ("thermal_derating", "a rest in the middle of the log, or a logged temperature"),
    )

    @classmethod
    def probes(cls, scale: JointScale) -> tuple[Probe, ...]:
        return (((0.004,),),)

    @staticmethod
    def law(step: Step, numbers: FloatArray, memory: FloatArray, places: IntArray) -> None:
        left = min(max(1 - numbers[0, 0] * step.time, 0.05), 1.0)
        for j in places:
            step.gain[j] *= left


@dataclass(frozen=True)
class VoltageSagLoad(VoltageSag):
    """Law: gain = 1 - ratio * sum of all servo torques, after a lag; a supply with inner resistance and capacity.

    The torques are those that flow, which the gain has weakened already: gain = 1 / (1 + ratio * those asked for). The
    lag is that of a battery's or a converter's voltage (Chen and Rincon-Mora 2006, doi:10.1109/TEC.2006.874229).
    """

    title: ClassVar[str] = "loss of supply voltage per unit of total torque"
    variant: ClassVar[str] = "load"
    law_memory: ClassVar[int] = 2
    kinds: ClassVar[tuple[Kind, ...]] = (
        Kind("ratio", "1/Nm", 0.0, 0.0, 1.0, 0.01),
        Kind("lag", "s", 0.0, 0.0, 1.0, 0.02),
    )
    held: ClassVar[tuple[str, ...]] = ("lag",)

    @classmethod
    def sized(cls, scale: JointScale) -> tuple[Kind, ...]:
        size = 0.02 / max(scale.torque_rms, 1e-9)
        return (Kind("ratio", "1/Nm", 0.0, 0.0, 20 * size, size), cls.kinds[1])

    @classmethod
    def probes(cls, scale: JointScale) -> tuple[Probe, ...]:
        return tuple(((cls.sized(scale)[0].scale, lag),) for lag in LAGS)

    @staticmethod
    def law(step: Step, numbers: FloatArray, memory: FloatArray, places: IntArray) -> None:
        total = load_of_supply(step, numbers[0, 1], memory, places)
        for j in places:
            step.gain[j] /= 1 + numbers[0, 0] * total


@dataclass(frozen=True)
class VoltageSagLoadStiffness(VoltageSagLoad):
    """Law: stiffness = 1 - ratio * sum of all servo torques, after a lag; damping stays, as firmware limits P alone."""

    title: ClassVar[str] = "loss of stiffness per unit of total torque"
    variant: ClassVar[str] = "load_stiffness"

    @staticmethod
    def law(step: Step, numbers: FloatArray, memory: FloatArray, places: IntArray) -> None:
        lost = 1 - 1 / (1 + numbers[0, 0] * load_of_supply(step, numbers[0, 1], memory, places))
        for j in places:
            step.motor_torque[j] -= lost * step.gain[j] * step.proportional[j]


@dataclass(frozen=True)
class Switch(Term):
    """A drive that gives no torque while the log says that it is off; no effect, and without parameters.

    Law: no torque where `enabled` is false.
    """

    name: ClassVar[str] = "switch"
    law_acts: ClassVar[tuple[str, ...]] = ("servo",)
    switches: ClassVar[bool] = True

    @staticmethod
    def law(step: Step, numbers: FloatArray, memory: FloatArray, places: IntArray) -> None:
        for j in places:
            step.gain[j] *= step.enabled[j]
            step.motor_torque[j] *= step.enabled[j]


@dataclass(frozen=True)
class ThermalDerating(Effect):
    """A motor that weakens as it heats: gain falls with the recent mean of its squared torque.

    Law: T' = (torque^2 - T) / tau, gain = 1 / (1 + alpha T).
    """

    name: ClassVar[str] = "thermal_derating"
    family: ClassVar[str] = "supply"
    title: ClassVar[str] = "loss of torque with heat"
    scope: ClassVar = "drive"
    law_acts: ClassVar[tuple[str, ...]] = ("servo",)
    law_memory: ClassVar[int] = 1
    kinds: ClassVar[tuple[Kind, ...]] = (
        Kind("alpha", "1/Nm2", 0.0, 0.0, 10.0, 0.1),
        Kind("tau", "s", 10.0, 1.0, 200.0, 5.0),
    )
    held: ClassVar[tuple[str, ...]] = ("tau",)
    confounders: ClassVar[tuple[tuple[str, str], ...]] = (
        ("voltage_sag", "a rest in the middle of the log, or a logged temperature"),
    )

    @classmethod
    def sized(cls, scale: JointScale) -> tuple[Kind, ...]:
        size = 0.1 / max(scale.torque_rms, 1e-9) ** 2
        return (Kind("alpha", "1/Nm2", 0.0, 0.0, 50 * size, size), Kind("tau", "s", 10.0, 1.0, 200.0, 5.0))

    @classmethod
    def probes(cls, scale: JointScale) -> tuple[Probe, ...]:
        alpha = cls.sized(scale)[0].scale
        return tuple(((alpha, tau),) for tau in (5.0, 20.0))

    @staticmethod
    def law(step: Step, numbers: FloatArray, memory: FloatArray, places: IntArray) -> None:
        for p, j in enumerate(places):
            heat = memory[p, 0]
            gain = 1 / (1 + numbers[p, 0] * heat)
            step.gain[j] *= gain
            memory[p, 0] = heat + step.timestep / numbers[p, 1] * ((gain * step.torque[j]) ** 2 - heat)
