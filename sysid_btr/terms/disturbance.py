"""Torques from outside: constant, once, or again and again."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, Self

import numpy as np

from sysid_btr._typing import FloatArray, IntArray
from sysid_btr.terms.base import BatchModel, Kind, Term
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
class Push(Effect):
    """Base: a torque on a joint whose course begins at some moment, which only the residual can propose.

    Torque: the course times its amount, exact in the mean over each step.
    """

    name: ClassVar[str] = "external_disturbance"
    family: ClassVar[str] = "disturbance"
    signed: ClassVar[bool] = True

    @classmethod
    def sized(cls, scale: JointScale) -> tuple[Kind, ...]:
        peak = max(scale.torque_peak, 1e-9)
        return (Kind("torque", "Nm", 0.0, -20 * peak, 20 * peak, 0.1 * scale.torque_rms), *cls.kinds[1:])

    @classmethod
    def probes(cls, scale: JointScale) -> tuple[Probe, ...]:
        return ()

    @classmethod
    def probe_at(cls, scale: JointScale, *when: float) -> Probe:
        """A probe whose course the residual proposes: all kinds but the amount."""
        return ((0.1 * scale.torque_rms, *when),)

    def around(self, values: FloatArray) -> Self:
        """The same with a course bounded near a guess (parameters,), so that a fit can refine it.

        A fit takes its finite differences as fractions of the bounds: within bounds of a whole log the start of a pulse
        would be displaced by more than the pulse.
        """
        known, count = [], len(self.kinds)
        for i, parameter in enumerate(self.parameters):
            place, kind = divmod(i, count)
            reach = self.reaches(*values[place * count + 1 : (place + 1) * count])[kind - 1] if kind else None
            known.append(parameter if reach is None else parameter.near(float(values[i]), float(reach)))
        return replace(self, known=tuple(known))

    @classmethod
    def reaches(cls, *when: float) -> tuple[float, ...]:
        """How far from a guess a fit may look for each number of the course."""
        raise NotImplementedError

    @classmethod
    def lasts(cls, *when: float) -> float:
        """Seconds after which it is over."""
        raise NotImplementedError

    @classmethod
    def impulse(cls, time: FloatArray, *when: FloatArray) -> FloatArray:
        """Integral of the course until some moment, for an amount of 1."""
        raise NotImplementedError

    def applied_torque(self, batch: BatchModel, values: FloatArray, time: FloatArray) -> FloatArray | None:
        torque = np.zeros((batch.size, time.shape[1] - 1, len(batch.index.joints)))
        for place, column in enumerate(batch.index.of(self.places)):
            torque[:, :, column] += self.mean_torque(values[:, place], time)
        return torque

    @classmethod
    def mean_torque(cls, values: FloatArray, time: FloatArray) -> FloatArray:
        """Mean torque over each step, (m, steps), of pushes (m, kinds) in steps between `time` (m or 1, steps + 1)."""
        amount, *when = values.T[:, :, None]
        return np.asarray(amount * np.diff(cls.impulse(time, *when), axis=1) / np.diff(time, axis=1))


@dataclass(frozen=True)
class ExternalDisturbance(Push):
    """A push from outside: a constant torque on a joint between two moments."""

    title: ClassVar[str] = "push from outside"
    held: ClassVar[tuple[str, ...]] = ("start", "duration")
    transient: ClassVar[bool] = True
    kinds: ClassVar[tuple[Kind, ...]] = (
        Kind("torque", "Nm", 0.0, -50.0, 50.0, 0.1),
        Kind("start", "s", 0.0, 0.0, 1e5, 0.02),
        Kind("duration", "s", 0.1, 0.001, 100.0, 0.02),
    )
    confounders: ClassVar[tuple[tuple[str, str], ...]] = (("payload", "a push that is not repeated"),)

    @classmethod
    def reaches(cls, *when: float) -> tuple[float, ...]:
        duration = when[1]
        return max(0.5 * duration, 0.05), 0.7 * duration

    @classmethod
    def lasts(cls, *when: float) -> float:
        return when[1]

    @classmethod
    def impulse(cls, time: FloatArray, *when: FloatArray) -> FloatArray:
        start, duration = when
        return np.asarray(np.minimum(np.maximum(time - start, 0.0), duration))


@dataclass(frozen=True)
class ExternalDisturbanceTrain(ExternalDisturbance):
    """The same push again and again."""

    variant: ClassVar[str] = "train"
    title: ClassVar[str] = "push from outside that comes again and again"
    held: ClassVar[tuple[str, ...]] = (*ExternalDisturbance.held, "period")
    transient: ClassVar[bool] = False
    kinds: ClassVar[tuple[Kind, ...]] = (*ExternalDisturbance.kinds, Kind("period", "s", 1.0, 0.01, 1e4, 0.01))
    confounders: ClassVar[tuple[tuple[str, str], ...]] = (
        ("command_delay", "a motion that does not repeat with the pushes"),
    )

    @classmethod
    def reaches(cls, *when: float) -> tuple[float, ...]:
        _, duration, period = when
        return *ExternalDisturbance.reaches(*when[:2]), min(0.02 * period, 0.25 * duration)

    @classmethod
    def impulse(cls, time: FloatArray, *when: FloatArray) -> FloatArray:
        return np.asarray(time_in_pulses(time, *when))


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


@dataclass(frozen=True)
class RingingDisturbance(Push):
    """A blow that rings: a torque on a joint that swings and dies away, as of an elastic structure that was struck.

    Torque: exp(-t / decay) sin(2 pi frequency t) from the blow on, the impulse response of a damped oscillator.
    """

    variant: ClassVar[str] = "ringing"
    title: ClassVar[str] = "blow that rings"
    held: ClassVar[tuple[str, ...]] = ("start", "frequency", "decay")
    transient: ClassVar[bool] = True
    kinds: ClassVar[tuple[Kind, ...]] = (
        *ExternalDisturbance.kinds[:2],
        Kind("frequency", "1/s", 3.0, 0.01, 200.0, 0.05),
        Kind("decay", "s", 0.5, 0.005, 100.0, 0.02),
    )
    confounders: ClassVar[tuple[tuple[str, str], ...]] = (
        ("joint_compliance", "blows that do not come with jerks of the motion itself"),
    )

    @classmethod
    def reaches(cls, *when: float) -> tuple[float, ...]:
        _, frequency, decay = when[:3]
        return 0.25 / frequency, min(0.3 * frequency, 0.5 / decay), 0.7 * decay

    @classmethod
    def lasts(cls, *when: float) -> float:
        return 3.0 * when[2]  # to a twentieth

    @classmethod
    def impulse(cls, time: FloatArray, *when: FloatArray) -> FloatArray:
        start, frequency, decay = when
        rate = -1.0 / decay + 2j * np.pi * frequency
        return np.asarray(((np.exp(rate * np.maximum(time - start, 0.0)) - 1.0) / rate).imag)


@dataclass(frozen=True)
class RingingDisturbanceTrain(RingingDisturbance):
    """The same blow again and again; what earlier ones left of their ringing adds up."""

    variant: ClassVar[str] = "ringing_train"
    title: ClassVar[str] = "blow that rings and comes again and again"
    held: ClassVar[tuple[str, ...]] = (*RingingDisturbance.held, "period")
    transient: ClassVar[bool] = False
    kinds: ClassVar[tuple[Kind, ...]] = (*RingingDisturbance.kinds, ExternalDisturbanceTrain.kinds[-1])

    @classmethod
    def reaches(cls, *when: float) -> tuple[float, ...]:
        return *RingingDisturbance.reaches(*when), min(0.02 * when[3], 0.25 / when[1])

    @classmethod
    def impulse(cls, time: FloatArray, *when: FloatArray) -> FloatArray:
        start, frequency, decay, period = when
        rate = -1.0 / decay + 2j * np.pi * frequency
        since = np.maximum(time - start, 0.0)
        before = np.floor(since / period)
        # what the blows so far began, each exp(rate t) since its own, is a geometric series
        fade = np.exp(rate * period)
        together = np.exp(rate * (since - before * period)) * (1.0 - fade ** (before + 1)) / (1.0 - fade)
        return np.asarray(((together - (before + 1)) / rate).imag)


@used_in_laws
def time_in_pulses(time: Any, start: Any, duration: Any, period: Any) -> Any:
    """Time spent in pulses until some moment; arrays or single numbers."""
    since = np.maximum(time - start, 0.0)
    whole = np.floor(since / period)
    each = np.minimum(duration, period)
    return whole * each + np.minimum(since - whole * period, each)
