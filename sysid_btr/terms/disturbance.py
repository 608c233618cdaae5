"""Torques from outside: constant, once, or again and again."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, Self

import numpy as np

from sysid_btr._typing import FloatArray, IntArray
from sysid_btr.terms.base import BatchModel, Kind, Parameter, Term
from sysid_btr.terms.effect import Effect, Probe
from sysid_btr.terms.law import Step, used_in_laws
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


@dataclass(frozen=True, eq=False)
class KnownTorque(Term):
    """Torques on joints whose course is known, in amounts of each: what such torques would do, not a thing to free.

    Torque: the courses at the middle of each step, each times its amount.

    Attributes
    ----------
    time : (t,) s since the first sample of the log.
    torque : (places, t, c) Nm or N for an amount of one.
    """

    time: FloatArray = field(default_factory=lambda: np.zeros(1))
    torque: FloatArray = field(default_factory=lambda: np.zeros((1, 1, 0)))

    name: ClassVar[str] = "known_torque"

    @property
    def numbers(self) -> tuple[Kind, ...]:
        return tuple(Kind(f"c{k}", "1", 0.0, -np.inf, np.inf, 1.0) for k in range(1, self.torque.shape[2] + 1))

    def applied_torque(self, batch: BatchModel, values: FloatArray, time: FloatArray) -> FloatArray:
        torque = np.zeros((batch.size, time.shape[1] - 1, len(batch.index.joints)))
        middle = np.broadcast_to(0.5 * (time[:, 1:] + time[:, :-1]), torque.shape[:2])
        columns = batch.index.of(self.places)
        for i, place, course in zip(*np.nonzero(values), strict=True):
            now = np.interp(middle[i], self.time, self.torque[place, :, course])
            torque[i, :, columns[place]] += values[i, place, course] * now
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

    Law: torque of the drive + the mean of the pulses over the step.
    """

    variant: ClassVar[str] = "drive_train"
    title: ClassVar[str] = "pulses in the servo's own torque"
    needs: ClassVar[str] = "effort"
    law_acts: ClassVar[tuple[str, ...]] = ("servo",)
    confounders: ClassVar[tuple[tuple[str, str], ...]] = (
        *ExternalDisturbanceTrain.confounders,
        ("external_disturbance", "a logged effort: a push from outside is not in it"),
    )

    def applied_torque(self, batch: BatchModel, values: FloatArray, time: FloatArray) -> FloatArray | None:
        return None

    @staticmethod
    def law(step: Step, numbers: FloatArray, memory: FloatArray, places: IntArray) -> None:
        begin, end = step.time - 0.5 * step.timestep, step.time + 0.5 * step.timestep
        for p, j in enumerate(places):
            start, duration, period = numbers[p, 1], numbers[p, 2], numbers[p, 3]
            spent = time_in_pulses(end, start, duration, period) - time_in_pulses(begin, start, duration, period)
            step.motor_torque[j] += numbers[p, 0] * spent / step.timestep


def pulses(values: FloatArray, time: FloatArray) -> FloatArray:
    """Mean torque over each step, (m, steps), of trains (m, 4) of torque, start, duration, period.

    `time` (m or 1, steps + 1) is that of the borders of the steps.
    """
    amount, start, duration, period = (values[:, k, None] for k in range(4))
    spent = time_in_pulses(time, start, duration, period)
    return np.asarray(amount * np.diff(spent, axis=1) / np.diff(time, axis=1))


@used_in_laws
def time_in_pulses(time: Any, start: Any, duration: Any, period: Any) -> Any:
    """Time spent in pulses until some moment; arrays or single numbers."""
    since = np.maximum(time - start, 0.0)
    whole = np.floor(since / period)
    each = np.minimum(duration, period)
    return whole * each + np.minimum(since - whole * period, each)


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
        result.append(parameter if reach is None else parameter.near(value, reach))
    return tuple(result)
