"""Torques from outside: constant, once, or again and again."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar, Self

import numpy as np

from sysid_btr._typing import FloatArray
from sysid_btr.terms.base import BatchModel, Kind, Parameter
from sysid_btr.terms.effect import Effect, Probe
from sysid_btr.terms.scales import JointScale


@dataclass(frozen=True)
class ConstantForce(Effect):
    """A constant torque on a joint: asymmetric friction, a drive's offset, a pulling cable.

    Torque: on the joint, beside the servo.
    """

    name: ClassVar[str] = "constant_force"
    family: ClassVar[str] = "disturbance"
    title: ClassVar[str] = "constant torque"
    signed: ClassVar[bool] = True
    kinds: ClassVar[tuple[Kind, ...]] = (Kind("torque", "Nm", 0.0, -10.0, 10.0, 0.05),)
    confounders: ClassVar[tuple[tuple[str, str], ...]] = (
        ("encoder_offset", "a logged effort"),
        ("com_offset", "several poses"),
    )

    @classmethod
    def sized(cls, scale: JointScale) -> tuple[Kind, ...]:
        peak = scale.counter_peak
        return (Kind("torque", "Nm", 0.0, -peak, peak, 0.1 * scale.torque_rms),)

    def applied_torque(self, batch: BatchModel, values: FloatArray, time: FloatArray) -> FloatArray:
        torque = np.zeros((batch.size, time.shape[1] - 1, len(batch.index.joints)))
        torque[:, :, batch.index.of(self.places)] = values[:, None, :, 0]
        return torque


@dataclass(frozen=True)
class ExternalDisturbance(Effect):
    """Pushes from outside: a torque on a joint between two moments, once or again and again.

    Torque: a rectangular pulse, exact in the mean over each step.
    """

    name: ClassVar[str] = "external_disturbance"
    family: ClassVar[str] = "disturbance"
    title: ClassVar[str] = "push from outside"
    held: ClassVar[tuple[str, ...]] = ("start", "duration")
    transient: ClassVar[bool] = True
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
        return (Kind("torque", "Nm", 0.0, -20 * peak, 20 * peak, 0.1 * scale.torque_rms), *cls.kinds[1:])

    @classmethod
    def probes(cls, scale: JointScale) -> tuple[Probe, ...]:
        return ()

    @classmethod
    def probe_at(cls, scale: JointScale, start: float, duration: float) -> Probe:
        """A probe at a time that the residual proposes."""
        return ((0.1 * scale.torque_rms, start, duration),)

    def around(self, values: FloatArray) -> Self:
        """The same with times bounded near a guess (parameters,), so that a fit can refine them."""
        return replace(self, known=_near(self.parameters, values, len(self.kinds)))

    def applied_torque(self, batch: BatchModel, values: FloatArray, time: FloatArray) -> FloatArray:
        torque = np.zeros((batch.size, time.shape[1] - 1, len(batch.index.joints)))
        for place, column in enumerate(batch.index.of(self.places)):
            amount, start, duration = (values[:, place, k, None] for k in range(3))
            overlap = np.minimum(time[:, 1:], start + duration) - np.maximum(time[:, :-1], start)
            torque[:, :, column] += amount * np.maximum(overlap, 0.0) / batch.timestep
        return torque


@dataclass(frozen=True)
class ExternalDisturbanceTrain(Effect):
    """The same push again and again.

    Torque: rectangular pulses, exact in the mean over each step.
    """

    name: ClassVar[str] = "external_disturbance"
    family: ClassVar[str] = "disturbance"
    variant: ClassVar[str] = "train"
    title: ClassVar[str] = "push from outside that comes again and again"
    held: ClassVar[tuple[str, ...]] = ("start", "duration", "period")
    signed: ClassVar[bool] = True
    kinds: ClassVar[tuple[Kind, ...]] = (*ExternalDisturbance.kinds, Kind("period", "s", 1.0, 0.01, 1e4, 0.01))
    confounders: ClassVar[tuple[tuple[str, str], ...]] = (
        ("command_delay", "a motion that does not repeat with the pushes"),
    )

    @classmethod
    def sized(cls, scale: JointScale) -> tuple[Kind, ...]:
        return (*ExternalDisturbance.sized(scale), cls.kinds[-1])

    @classmethod
    def probes(cls, scale: JointScale) -> tuple[Probe, ...]:
        return ()

    @classmethod
    def probe_at(cls, scale: JointScale, start: float, duration: float, period: float) -> Probe:
        """A probe at times that the residual proposes."""
        return ((0.1 * scale.torque_rms, start, duration, period),)

    def around(self, values: FloatArray) -> Self:
        """The same with times bounded near a guess (parameters,), so that a fit can refine them."""
        return replace(self, known=_near(self.parameters, values, len(self.kinds)))

    def applied_torque(self, batch: BatchModel, values: FloatArray, time: FloatArray) -> FloatArray | None:
        torque = np.zeros((batch.size, time.shape[1] - 1, len(batch.index.joints)))
        for place, column in enumerate(batch.index.of(self.places)):
            torque[:, :, column] += pulses(values[:, place], time)
        return torque


@dataclass(frozen=True)
class DriveDisturbanceTrain(ExternalDisturbanceTrain):
    """Pulses added to the drive's input: the logged effort holds them, and the drive's limit clips them.

    Command: a position servo feels them as an offset of its command by torque / kp, and that is how they enter.
    """

    variant: ClassVar[str] = "drive_train"
    title: ClassVar[str] = "pulses in the servo's own torque"
    needs: ClassVar[str] = "effort"
    confounders: ClassVar[tuple[tuple[str, str], ...]] = (
        *ExternalDisturbanceTrain.confounders,
        ("external_disturbance", "a logged effort: a push from outside is not in it"),
    )

    def applied_torque(self, batch: BatchModel, values: FloatArray, time: FloatArray) -> FloatArray | None:
        return None

    @property
    def longest_delay(self) -> float:
        return 0.0  # its times say when pulses come; no command is late

    def shape_command(self, batch: BatchModel, values: FloatArray, command: FloatArray) -> FloatArray:
        actuator = batch.index.actuator[batch.index.of(self.places)]
        gains, gears = batch.read("actuator_gainprm"), batch.read("actuator_gear")
        stiffness = gains[:, actuator, 0] * gears[:, actuator, 0] * batch.index.scale[batch.index.of(self.places)]
        time = batch.timestep * np.arange(command.shape[1] + 1, dtype=np.float64)[None]
        shaped = np.array(command)
        for place, column in enumerate(batch.index.of(self.places)):
            if actuator[place] >= 0:
                kp = stiffness[:, place, None]
                offset = np.divide(1.0, kp, out=np.zeros_like(kp), where=kp != 0)
                shaped[:, :, column] += pulses(values[:, place], time) * offset
        return shaped


def pulses(values: FloatArray, time: FloatArray) -> FloatArray:
    """Mean torque over each step, (m, steps), of trains (m, 4) of torque, start, duration, period.

    `time` (m or 1, steps + 1) is that of the borders of the steps.
    """
    amount, start, duration, period = (values[:, k, None] for k in range(4))
    duration = np.minimum(duration, period)

    def elapsed(t: FloatArray) -> FloatArray:
        """Time spent in pulses until t."""
        since = np.maximum(t - start, 0.0)
        whole = np.floor(since / period)
        return whole * duration + np.minimum(since - whole * period, duration)

    return np.asarray(amount * np.diff(elapsed(time), axis=1) / np.diff(time, axis=1))


def _near(parameters: tuple[Parameter, ...], values: FloatArray, kinds: int) -> tuple[Parameter, ...]:
    """Parameters whose bounds on times are as narrow as the guess of a pulse allows.

    A fit takes its finite differences as fractions of the bounds: within bounds of a whole log the start of
    a pulse would be displaced by more than the pulse.
    """
    result = []
    for i, parameter in enumerate(parameters):
        place, kind = divmod(i, kinds)
        duration = float(values[place * kinds + 2])
        value = float(values[i])
        reach = (None, max(0.5 * duration, 0.05), 0.7 * duration, min(0.02 * value, 0.25 * duration))[kind]
        if reach is not None:
            low, high = max(value - reach, parameter.lower), min(value + reach, parameter.upper)
            nominal = min(max(parameter.nominal, low), high)
            parameter = replace(parameter, nominal=nominal, lower=low, upper=high)
        result.append(parameter)
    return tuple(result)
