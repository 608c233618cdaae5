"""Torques, friction, gains, encoder errors of a form that is learnt: smooth functions of what a joint does, or of time.

Where no law of the library fits, a curve does: cubic B-splines over the range of the variable (de Boor 1978, "A
Practical Guide to Splines"), whose numbers are the amounts of the modes of their roughness, the integral of the
curve's squared second derivative, as in penalised splines (Eilers and Marx 1996, doi:10.1214/ss/1038425655). The
first modes are a constant and a slope; each further one bends more, and its bounds are narrower in proportion to the
root of its roughness. So the penalty is a prior, and any estimator can use it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import TYPE_CHECKING, Any, ClassVar, Self

import numpy as np

from sysid_btr._typing import FloatArray, IntArray
from sysid_btr.interpolation import clamped_knots
from sysid_btr.terms.base import BatchModel, Kind, Outputs, Parameter, Scope
from sysid_btr.terms.effect import COMMANDS, Effect, Probe
from sysid_btr.terms.law import Step, drive, used_in_laws
from sysid_btr.terms.scales import SLIDE_UNITS, JointScale, Scales, scale_at

if TYPE_CHECKING:
    from scipy.interpolate import BSpline

SPLINES, PERIODIC = 8, 6
"""Splines over a range, and over a period."""
DEGREE = 3
WAVES = (1, 2, 3)
"""Sines and cosines in a period; of the last one splines have the cosine alone."""
PERIODIC_BOUNDS = (1.0, 1.0, 1 / 4, 1 / 4, 1 / 9)
"""Their bounds: the roughness of a wave's curve goes with the fourth power of its number."""
EVEN = (np.arange(1000) + 0.5) / 1000
WIDE = 3.0
"""Range of a torque or a velocity, times its rms: peaks are too rare to tell a curve."""
CREEP = 0.05
"""Fraction of the fastest velocity below which velocities are told apart evenly, above by ratios."""
FLAT = 0.15
"""Change, relative to the whole, that is not worth a word."""
FAMILY = "unknown torque"


@cache
def smooth_modes() -> BSpline:
    """Modes over 0 .. 1, of rms 1 each: the least rough curve, the least rough that is orthogonal to it, and so on.

    A call gives (..., SPLINES).
    """
    from scipy.interpolate import BSpline
    from scipy.linalg import eigh

    knots = clamped_knots(SPLINES, DEGREE)
    splines = BSpline(knots, np.eye(SPLINES), DEGREE)
    even, bent = splines(EVEN), splines(EVEN, nu=2)
    gram = even.T @ even / len(even)
    modes = eigh(bent.T @ bent / len(even) + 1e-3 * _slope(splines(EVEN, nu=1)), gram)[1]
    return BSpline(knots, modes * np.where(modes[-1] < 0, -1.0, 1.0), DEGREE)


def _slope(first: FloatArray) -> FloatArray:
    """Roughness of slopes, which tells a slope from a constant."""
    return np.asarray(first.T @ first / len(first))


@cache
def periodic_modes() -> BSpline:
    """The same over a period of 1 and without the constant: (..., PERIODIC - 1), sines and cosines of splines."""
    from scipy.interpolate import BSpline

    turn = 2 * np.pi * np.arange(PERIODIC) / PERIODIC
    waves = np.column_stack([f(n * turn) for n in WAVES for f in (np.sin, np.cos)][: PERIODIC - 2])
    waves = np.column_stack([waves, np.cos(WAVES[-1] * turn)])
    knots = np.arange(-DEGREE, PERIODIC + DEGREE + 1) / PERIODIC
    whole = BSpline(knots, waves[np.arange(PERIODIC + DEGREE) % PERIODIC], DEGREE)
    size = np.sqrt(np.mean(whole(EVEN) ** 2, axis=0))
    return BSpline(knots, whole.c / size, DEGREE)


def modal_bounds(count: int) -> tuple[float, ...]:
    """Bounds of the modes over a range, relative to those of a constant and a slope: a free beam's, bent by its energy.

    The roots of the roughness of a beam's modes are as the squares of 3, 5, 7, ... (within half a per cent).
    """
    return (1.0, 1.0, *((3.0 / (2 * k + 3)) ** 2 for k in range(count - 2)))


def modal_sum(values: FloatArray, modes: FloatArray) -> FloatArray:
    """Sum over the last axis, one by one: the same bits whatever candidates are beside."""
    total = values[..., 0] * modes[..., 0]
    for k in range(1, modes.shape[-1]):
        total = total + values[..., k] * modes[..., k]
    return np.asarray(total)


@used_in_laws
def spline(coefficients: FloatArray, x: float) -> float:
    """Value at x of the splines of `smooth_modes` with coefficients (SPLINES,), by de Boor's recursion."""
    pieces = len(coefficients) - DEGREE
    # no index follows from what is not a number
    x = min(x, 1.0) if x > 0 else 0.0
    k = min(int(x * pieces), pieces - 1)
    a, b, c, d = coefficients[k], coefficients[k + 1], coefficients[k + 2], coefficients[k + 3]
    d = c + _share(x, k + 3, 1, pieces) * (d - c)
    c = b + _share(x, k + 2, 1, pieces) * (c - b)
    b = a + _share(x, k + 1, 1, pieces) * (b - a)
    d = c + _share(x, k + 3, 2, pieces) * (d - c)
    c = b + _share(x, k + 2, 2, pieces) * (c - b)
    value: float = c + _share(x, k + 3, 3, pieces) * (d - c)
    return value


@used_in_laws
def _share(x: float, k: int, turn: int, pieces: int) -> float:
    """Where x is between the knots between which a turn of the recursion mixes coefficient k with the one before."""
    low, high = max(k - DEGREE, 0) / pieces, min(k + 1 - turn, pieces) / pieces
    return (x - low) / (high - low)


@used_in_laws
def in_range(x: Any, low: Any, high: Any) -> Any:
    """Where in its range a variable is, 0 .. 1 within; arrays or single numbers, as of the following."""
    return (x - low) / (high - low)


@used_in_laws
def in_velocities(x: Any, high: Any) -> Any:
    """The same of a velocity of either sign; slow ones are told apart more finely."""
    return 0.5 + 0.5 * np.arcsinh(np.minimum(np.maximum(x / high, -1.0), 1.0) / CREEP) / np.arcsinh(1.0 / CREEP)


@used_in_laws
def in_speeds(x: Any, high: Any) -> Any:
    """The same of a velocity whatever its sign."""
    return np.arcsinh(np.minimum(np.abs(x) / high, 1.0) / CREEP) / np.arcsinh(1.0 / CREEP)


@used_in_laws
def gain_at(time: float, numbers: FloatArray) -> float:
    """Gain of a drive whose change is a curve over time; `numbers` are the ends of its range, and its splines."""
    return max(1.0 + spline(numbers[2:], in_range(time, numbers[0], numbers[1])), 0.0)


def _kinds(bounds: Sequence[float], peak: float, size: float, unit: str = "Nm") -> tuple[Kind, ...]:
    return tuple(Kind(f"c{k}", unit, 0.0, -w * peak, w * peak, w * size) for k, w in enumerate(bounds, start=1))


def _amount_in_words(amount: float, unit: str) -> str:
    return f"{100 * amount:.2g} %" if unit == "1" else f"{amount:.2g} {unit}"


def curve_in_words(x: FloatArray, y: FloatArray, across: str, unit: str) -> str:
    """What a curve does: where it goes, if it goes one way, else what it lies between."""

    def at(i: int) -> str:
        return f"{_amount_in_words(y[i], unit)} at {x[i]:.2g} {across}"

    size, last = float(np.ptp(y)), len(y) - 1
    if size <= FLAT * float(np.max(np.abs(y))):
        return f"about {_amount_in_words(float(np.mean(y)), unit)} everywhere"
    way = 1.0 if y[-1] > y[0] else -1.0
    if float(np.sum(np.maximum(-way * np.diff(y), 0.0))) > FLAT * size:
        low, high = sorted((int(np.argmin(y)), int(np.argmax(y))))
        return f"from {at(low)} to {at(high)}, and back"
    verb = "rises" if way > 0 else "falls"
    if abs(y[0]) < FLAT * size:
        return f"{verb} to {at(last)}"
    return f"{verb} from {at(0)} to {at(last)}"


@dataclass(frozen=True)
class FreeCurve(Effect):
    """Base: something at a joint that is a smooth function of one variable, of no form in particular.

    Class attributes
    ----------------
    variable, variable_unit : in a sentence, and on an axis.
    amount, article : what the curve gives, and how a sentence about it begins.
    periodic : whether it repeats in time, with a frequency of its own as its last number.
    """

    usual: ClassVar[bool] = False
    signed: ClassVar[bool] = True
    law_acts: ClassVar[tuple[str, ...]] = ()
    variable: ClassVar[str] = ""
    variable_unit: ClassVar[str] = ""
    amount: ClassVar[str] = "torque"
    article: ClassVar[str] = "a "
    periodic: ClassVar[bool] = False
    first_mode: ClassVar[int] = 0
    """Which of the modes over a range is the first that it has."""

    @classmethod
    def range_of(cls, scale: JointScale) -> tuple[float, float]:
        """What the variable covers at a joint."""
        raise NotImplementedError

    @staticmethod
    def position_in(x: FloatArray, low: FloatArray | float, high: FloatArray | float) -> FloatArray:
        """Where in its range the variable is, 0 .. 1; the curve stays what it is at the ends beyond them."""
        return np.asarray(in_range(x, low, high))

    @classmethod
    def modes_at(cls, x: FloatArray, low: FloatArray | float, high: FloatArray | float) -> FloatArray:
        """(..., modes) of the curve at values of the variable."""
        inside = np.minimum(np.maximum(cls.position_in(x, low, high), 0.0), 1.0)
        return np.asarray(smooth_modes()(inside)[..., cls.first_mode :])

    def law_numbers(self, values: FloatArray) -> FloatArray:
        """The ends of the range, and the coefficients of the splines: (m, places, 2 + SPLINES)."""
        ends = np.broadcast_to(np.stack(self._bounds, axis=1), (*values.shape[:2], 2))
        modes = smooth_modes().c[:, self.first_mode :]
        return np.concatenate([ends, modal_sum(values[:, :, None, :], modes)], axis=2)

    @classmethod
    def probes(cls, scale: JointScale) -> tuple[Probe, ...]:
        """All modes; the response is linear in them."""
        kinds = cls.sized(scale)
        return (tuple(tuple(k.scale if i == j else 0.0 for j, k in enumerate(kinds)) for i in range(len(kinds))),)

    def curve(self, place: str, values: FloatArray, x: FloatArray) -> FloatArray:
        """(n,) what is given at values (n,) of the variable, from the numbers (kinds,) of a place."""
        return modal_sum(np.broadcast_to(values, (len(x), len(values))), self.modes_of(place, x))

    def modes_of(self, place: str, x: FloatArray) -> FloatArray:
        """(n, modes) at values (n,) of the variable at a place."""
        return self.modes_at(x, *self.ranges[self.places.index(place)])

    def drawn_over(self, place: str) -> tuple[float, float]:
        """Between which values of the variable the curve is drawn."""
        return self.ranges[self.places.index(place)]

    @property
    def axes(self) -> tuple[str, str]:
        """What is across and upwards in a drawing of the curve, with units."""
        unit, across = self._units
        variable = self.variable if across == "1" else f"{self.variable} ({across})"
        amount = self.amount.replace("torque", "force") if self.slides else self.amount
        return variable, amount if unit == "1" else f"{amount} ({unit})"

    @property
    def _units(self) -> tuple[str, str]:
        """Of what is given, and of the variable."""
        own, across = self.parameters[0].unit, self.variable_unit
        return own, SLIDE_UNITS.get(across, across) if self.slides else across

    def in_words(self, place: str, values: FloatArray) -> str:
        unit, across = self._units
        x = np.linspace(*self.drawn_over(place), 101)
        return curve_in_words(x, self.curve(place, values, x), across, unit)

    def over(self, scales: Scales) -> Self:
        return replace(self, ranges=tuple(self.range_of(scale_at(scales, place)) for place in self.places))

    @property
    def _bounds(self) -> tuple[FloatArray, FloatArray]:
        """(places,) ends of the ranges."""
        table = np.array(self.ranges or [(-1.0, 1.0)] * len(self.places))
        return table[:, 0], table[:, 1]


@dataclass(frozen=True)
class FreeTorque(FreeCurve):
    """Base: a torque on a joint."""

    name: ClassVar[str] = "free_torque"
    family: ClassVar[str] = FAMILY
    kinds: ClassVar[tuple[Kind, ...]] = _kinds(modal_bounds(SPLINES), 10.0, 0.05)

    @classmethod
    def sized(cls, scale: JointScale) -> tuple[Kind, ...]:
        return _kinds(modal_bounds(SPLINES), 2 * scale.counter_peak, 0.1 * scale.torque_rms)


@dataclass(frozen=True)
class FreeTorquePosition(FreeTorque):
    """A torque on a joint that is a smooth function of its position: a spring, a cable, a hose of any form.

    Law: the curve at the position at the middle of each step.
    """

    family: ClassVar[str] = "spring"
    variant: ClassVar[str] = "position"
    label: ClassVar[str] = "free_torque.position"
    title: ClassVar[str] = "torque that depends on the position"
    variable: ClassVar[str] = "position"
    variable_unit: ClassVar[str] = "rad"
    includes: ClassVar[tuple[str, ...]] = ("joint_spring", "constant_force")
    confounders: ClassVar[tuple[tuple[str, str], ...]] = (
        ("joint_spring", "its line is straight"),
        ("payload", "motion of other joints, which turns the weight and not the spring"),
    )

    @classmethod
    def range_of(cls, scale: JointScale) -> tuple[float, float]:
        return scale.centre - 0.5 * scale.span, scale.centre + 0.5 * scale.span

    @staticmethod
    def law(step: Step, numbers: FloatArray, memory: FloatArray, places: IntArray) -> None:
        for p, j in enumerate(places):
            own = numbers[p]
            step.joint_torque[j] += spline(own[2:], in_range(step.qpos[j], own[0], own[1]))


@dataclass(frozen=True)
class FreeTorqueVelocity(FreeTorque):
    """A torque on a joint that is a smooth function of its velocity: friction of any form but sticking.

    Law: the curve at the velocity at the middle of each step; slow ones are told apart more finely.
    """

    family: ClassVar[str] = "friction"
    variant: ClassVar[str] = "velocity"
    label: ClassVar[str] = "free_torque.velocity"
    title: ClassVar[str] = "torque that depends on the velocity"
    variable: ClassVar[str] = "velocity"
    variable_unit: ClassVar[str] = "rad/s"
    includes: ClassVar[tuple[str, ...]] = ("viscous_damping", "quadratic_damping", "constant_force")
    confounders: ClassVar[tuple[tuple[str, str], ...]] = (
        ("coulomb_friction", "reversals: it holds the joint still, a curve does not"),
        ("kv", "a logged effort or current"),
    )

    @classmethod
    def range_of(cls, scale: JointScale) -> tuple[float, float]:
        fastest = min(scale.velocity_peak, WIDE * scale.velocity_rms)
        return -fastest, fastest

    @staticmethod
    def position_in(x: FloatArray, low: FloatArray | float, high: FloatArray | float) -> FloatArray:
        return np.asarray(in_velocities(x, high))

    @staticmethod
    def law(step: Step, numbers: FloatArray, memory: FloatArray, places: IntArray) -> None:
        for p, j in enumerate(places):
            own = numbers[p]
            step.joint_torque[j] += spline(own[2:], in_velocities(step.qvel[j], own[1]))


@dataclass(frozen=True)
class FreeTorqueLoad(FreeTorque):
    """A torque on a joint that is a smooth function of its drive's torque, which gives more or less than it says.

    Law: the curve at the drive's torque at the middle of each step.
    """

    scope: ClassVar = "drive"
    needs: ClassVar[str] = COMMANDS
    variant: ClassVar[str] = "load"
    label: ClassVar[str] = "free_torque.load"
    title: ClassVar[str] = "torque that depends on load"
    variable: ClassVar[str] = "load"
    variable_unit: ClassVar[str] = "Nm"
    includes: ClassVar[tuple[str, ...]] = ("torque_limit", "constant_force")
    confounders: ClassVar[tuple[tuple[str, str], ...]] = (
        ("kp", "a load that is large against the constant and the slope"),
        ("torque_limit", "its corner"),
    )

    @classmethod
    def range_of(cls, scale: JointScale) -> tuple[float, float]:
        largest = min(scale.torque_peak, WIDE * scale.torque_rms)
        return -largest, largest

    @staticmethod
    def law(step: Step, numbers: FloatArray, memory: FloatArray, places: IntArray) -> None:
        for p, j in enumerate(places):
            own = numbers[p]
            step.joint_torque[j] += spline(own[2:], in_range(drive(step, j), own[0], own[1]))


@dataclass(frozen=True)
class FreeTorqueCommand(FreeTorque):
    """A torque on a joint that is a smooth function of its command.

    Law: the curve at the command of each step.
    """

    scope: ClassVar = "servo"
    needs: ClassVar[str] = COMMANDS
    variant: ClassVar[str] = "command"
    label: ClassVar[str] = "free_torque.command"
    title: ClassVar[str] = "torque that depends on the command"
    variable: ClassVar[str] = "command"
    variable_unit: ClassVar[str] = "rad"
    includes: ClassVar[tuple[str, ...]] = ("constant_force",)
    confounders: ClassVar[tuple[tuple[str, str], ...]] = (("joint_spring", "fast motion, which parts both"),)

    @classmethod
    def range_of(cls, scale: JointScale) -> tuple[float, float]:
        return FreeTorquePosition.range_of(scale)

    @staticmethod
    def law(step: Step, numbers: FloatArray, memory: FloatArray, places: IntArray) -> None:
        for p, j in enumerate(places):
            own = numbers[p]
            step.joint_torque[j] += spline(own[2:], in_range(step.command[j], own[0], own[1]))


@dataclass(frozen=True)
class FreeTorqueTime(FreeTorque):
    """A torque on a joint that is a smooth function of time: something from outside that comes and goes slowly.

    Torque: the curve at the middle of each step.
    """

    family: ClassVar[str] = "disturbance"
    variant: ClassVar[str] = "time"
    label: ClassVar[str] = "free_torque.time"
    title: ClassVar[str] = "torque that changes slowly with time"
    variable: ClassVar[str] = "time"
    variable_unit: ClassVar[str] = "s"
    includes: ClassVar[tuple[str, ...]] = ("constant_force",)
    confounders: ClassVar[tuple[tuple[str, str], ...]] = (("voltage_sag", "a load that is not always the same"),)

    @classmethod
    def range_of(cls, scale: JointScale) -> tuple[float, float]:
        return 0.0, scale.seconds

    def applied_torque(self, batch: BatchModel, values: FloatArray, time: FloatArray) -> FloatArray:
        torque = np.zeros((batch.size, time.shape[1] - 1, len(batch.index.joints)))
        middle, (low, high) = 0.5 * (time[:, 1:] + time[:, :-1]), self._bounds
        for place, column in enumerate(batch.index.of(self.places)):
            modes = self.modes_at(middle, low[place], high[place])
            torque[:, :, column] += modal_sum(values[:, None, place], modes)
        return torque


@dataclass(frozen=True)
class FreeTorquePeriodic(FreeTorque):
    """A torque on a joint that repeats in time with a frequency of its own, in any smooth form.

    The first two numbers are those of one wave, the root of two smaller than its amplitude.

    Torque: the curve at the phase in the middle of each step.
    """

    family: ClassVar[str] = "disturbance"
    variant: ClassVar[str] = "periodic"
    label: ClassVar[str] = "free_torque.periodic"
    title: ClassVar[str] = "torque that is periodic in time"
    variable: ClassVar[str] = "phase"
    variable_unit: ClassVar[str] = "1"
    periodic: ClassVar[bool] = True
    held: ClassVar[tuple[str, ...]] = ("frequency",)
    confounders: ClassVar[tuple[tuple[str, str], ...]] = (("external_disturbance", "its edges"),)
    kinds: ClassVar[tuple[Kind, ...]] = (
        *_kinds(PERIODIC_BOUNDS, 10.0, 0.05),
        Kind("frequency", "1/s", 1.0, 0.01, 100.0, 0.01),
    )

    @classmethod
    def sized(cls, scale: JointScale) -> tuple[Kind, ...]:
        return (*_kinds(PERIODIC_BOUNDS, 2 * scale.counter_peak, 0.1 * scale.torque_rms), cls.kinds[-1])

    @classmethod
    def range_of(cls, scale: JointScale) -> tuple[float, float]:
        return 0.0, scale.seconds

    @classmethod
    def probes(cls, scale: JointScale) -> tuple[Probe, ...]:
        """None: only a residual says with which frequency."""
        return ()

    @classmethod
    def modes_at(cls, x: FloatArray, low: FloatArray | float, high: FloatArray | float) -> FloatArray:
        return np.asarray(periodic_modes()(np.mod(x, 1.0)))

    def curve(self, place: str, values: FloatArray, x: FloatArray) -> FloatArray:
        return super().curve(place, values[:-1], x)

    def drawn_over(self, place: str) -> tuple[float, float]:
        return 0.0, 1.0

    def in_words(self, place: str, values: FloatArray) -> str:
        y = self.curve(place, values, np.linspace(0.0, 1.0, 101))
        wave = float(np.sqrt(2.0) * np.hypot(values[0], values[1]))
        form = "" if abs(0.5 * float(np.ptp(y)) - wave) < FLAT * wave else ", not a sine"
        return f"{0.5 * float(np.ptp(y)):.2g} {self.parameters[0].unit} at {float(values[-1]):.3g} Hz{form}"

    def around(self, values: FloatArray) -> Self:
        """The same with the frequency bounded near a guess: elsewhere are minima of its own."""
        return replace(self, known=_near_frequency(self.parameters, values, len(self.kinds), self.ranges[0][1]))

    def applied_torque(self, batch: BatchModel, values: FloatArray, time: FloatArray) -> FloatArray:
        torque = np.zeros((batch.size, time.shape[1] - 1, len(batch.index.joints)))
        middle = 0.5 * (time[:, 1:] + time[:, :-1])
        for place, column in enumerate(batch.index.of(self.places)):
            modes = periodic_modes()(np.mod(values[:, place, -1, None] * middle, 1.0))
            torque[:, :, column] += modal_sum(values[:, None, place], modes)
        return torque


@dataclass(frozen=True)
class FreeGainTime(FreeCurve):
    """A change of a drive's gain that is a smooth function of time, zero on average: a supply, heat, a grip that wears.

    Law: gain = 1 + the curve at each step, and never below 0.
    """

    name: ClassVar[str] = "free_gain"
    family: ClassVar[str] = "supply"
    scope: ClassVar[Scope] = "drive"
    needs: ClassVar[str] = COMMANDS
    variant: ClassVar[str] = "time"
    label: ClassVar[str] = "free_gain.time"
    title: ClassVar[str] = "change of gain that follows time"
    variable: ClassVar[str] = "time"
    variable_unit: ClassVar[str] = "s"
    amount: ClassVar[str] = "change of gain"
    law_acts: ClassVar[tuple[str, ...]] = ("servo",)
    first_mode: ClassVar[int] = 1
    """The constant is the gain itself."""
    kinds: ClassVar[tuple[Kind, ...]] = _kinds(modal_bounds(SPLINES)[1:], 1.0, 0.05, "1")
    includes: ClassVar[tuple[str, ...]] = ("thermal_derating",)
    confounders: ClassVar[tuple[tuple[str, str], ...]] = (
        ("free_torque.time", "a load that changes its sign"),
        ("voltage_sag", "the same at every joint"),
    )

    @classmethod
    def sized(cls, scale: JointScale) -> tuple[Kind, ...]:
        return cls.kinds

    @classmethod
    def range_of(cls, scale: JointScale) -> tuple[float, float]:
        return 0.0, scale.seconds

    @staticmethod
    def law(step: Step, numbers: FloatArray, memory: FloatArray, places: IntArray) -> None:
        for p, j in enumerate(places):
            step.gain[j] *= gain_at(step.time, numbers[p])


@dataclass(frozen=True)
class FreeGainOfAll(FreeGainTime):
    """A change of the gain of all drives together that is a smooth function of time: the supply that they share.

    Law: gain = 1 + the curve at each step, and never below 0.
    """

    usual: ClassVar[bool] = True
    scope: ClassVar[Scope] = "robot"
    variant: ClassVar[str] = "all"
    label: ClassVar[str] = "free_gain.all"
    title: ClassVar[str] = "change of all gains that follows time"
    includes: ClassVar[tuple[str, ...]] = ("voltage_sag",)
    confounders: ClassVar[tuple[tuple[str, str], ...]] = (("thermal_derating", "the same at every joint"),)

    @staticmethod
    def law(step: Step, numbers: FloatArray, memory: FloatArray, places: IntArray) -> None:
        gain = gain_at(step.time, numbers[0])
        for j in places:
            step.gain[j] *= gain


@dataclass(frozen=True)
class FreeGainStiffness(FreeGainOfAll):
    """A change of the stiffness of all servos together, and not of their damping, that is a smooth function of time.

    Law: stiffness = 1 + the curve at each step, and never below 0.
    """

    variant: ClassVar[str] = "stiffness"
    label: ClassVar[str] = "free_gain.stiffness"
    title: ClassVar[str] = "change of all servos' stiffness that follows time"
    includes: ClassVar[tuple[str, ...]] = ()

    @staticmethod
    def law(step: Step, numbers: FloatArray, memory: FloatArray, places: IntArray) -> None:
        change = gain_at(step.time, numbers[0]) - 1
        for j in places:
            step.motor_torque[j] += change * step.gain[j] * step.proportional[j]


def _near_frequency(
    parameters: Sequence[Parameter], values: FloatArray, kinds: int, seconds: float
) -> tuple[Parameter, ...]:
    """Parameters whose frequencies may shift by half a cycle over the log."""
    result = []
    for i, parameter in enumerate(parameters):
        if i % kinds == kinds - 1:
            low, high = values[i] - 0.5 / seconds, values[i] + 0.5 / seconds
            low = max(float(low), parameter.lower)
            nominal = min(max(parameter.nominal, low), float(high))
            parameter = replace(parameter, nominal=nominal, lower=low, upper=float(high), scale=0.05 / seconds)
        result.append(parameter)
    return tuple(result)


@dataclass(frozen=True)
class FreeFriction(FreeTorque):
    """Base: dry friction whose level is a smooth function of one variable; what is below zero of it is none."""

    name: ClassVar[str] = "free_friction"
    family: ClassVar[str] = "friction"
    article: ClassVar[str] = ""
    law_acts: ClassVar[tuple[str, ...]] = ("friction",)
    includes: ClassVar[tuple[str, ...]] = ("coulomb_friction",)

    def curve(self, place: str, values: FloatArray, x: FloatArray) -> FloatArray:
        return np.maximum(super().curve(place, values, x), 0.0)


@dataclass(frozen=True)
class FreeFrictionSpeed(FreeFriction):
    """Dry friction that is a smooth function of speed: Stribeck's of any form, viscous, quadratic, or saturating.

    Law: the level at the speed at the middle of each step; slow ones are told apart more finely.
    """

    variant: ClassVar[str] = "speed"
    label: ClassVar[str] = "free_friction.speed"
    title: ClassVar[str] = "friction that depends on speed"
    variable: ClassVar[str] = "speed"
    variable_unit: ClassVar[str] = "rad/s"
    includes: ClassVar[tuple[str, ...]] = ("coulomb_friction", "viscous_damping", "stribeck_friction")
    confounders: ClassVar[tuple[tuple[str, str], ...]] = (("kv", "a logged effort or current"),)

    @classmethod
    def range_of(cls, scale: JointScale) -> tuple[float, float]:
        return 0.0, min(scale.velocity_peak, WIDE * scale.velocity_rms)

    @staticmethod
    def position_in(x: FloatArray, low: FloatArray | float, high: FloatArray | float) -> FloatArray:
        return np.asarray(in_speeds(x, high))

    @staticmethod
    def law(step: Step, numbers: FloatArray, memory: FloatArray, places: IntArray) -> None:
        for p, j in enumerate(places):
            own = numbers[p]
            step.friction[j] += max(spline(own[2:], in_speeds(step.qvel[j], own[1])), 0.0)


@dataclass(frozen=True)
class FreeFrictionLoad(FreeFriction):
    """Dry friction that is a smooth function of the size of the drive's torque: a gear's, of any form.

    Law: the level at the drive's torque at the middle of each step.
    """

    scope: ClassVar = "drive"
    variant: ClassVar[str] = "load"
    label: ClassVar[str] = "free_friction.load"
    title: ClassVar[str] = "friction that depends on load"
    variable: ClassVar[str] = "load"
    variable_unit: ClassVar[str] = "Nm"
    includes: ClassVar[tuple[str, ...]] = ("coulomb_friction", "load_friction")
    confounders: ClassVar[tuple[tuple[str, str], ...]] = (
        ("coulomb_friction", "the same motion under different loads"),
    )

    @classmethod
    def range_of(cls, scale: JointScale) -> tuple[float, float]:
        return 0.0, min(scale.torque_peak, WIDE * scale.torque_rms)

    @staticmethod
    def position_in(x: FloatArray, low: FloatArray | float, high: FloatArray | float) -> FloatArray:
        return np.asarray(np.abs(x) / high)

    @staticmethod
    def law(step: Step, numbers: FloatArray, memory: FloatArray, places: IntArray) -> None:
        for p, j in enumerate(places):
            own = numbers[p]
            step.friction[j] += max(spline(own[2:], abs(drive(step, j)) / own[1]), 0.0)


@dataclass(frozen=True)
class FreeFrictionPosition(FreeFriction):
    """Dry friction that is a smooth function of the position: a bent shaft, a worn tooth, a seal.

    Law: the level at the position at the middle of each step.
    """

    variant: ClassVar[str] = "position"
    label: ClassVar[str] = "free_friction.position"
    title: ClassVar[str] = "friction that depends on the position"
    variable: ClassVar[str] = "position"
    variable_unit: ClassVar[str] = "rad"
    confounders: ClassVar[tuple[tuple[str, str], ...]] = (("coulomb_friction", "motion over the whole range"),)

    @classmethod
    def range_of(cls, scale: JointScale) -> tuple[float, float]:
        return FreeTorquePosition.range_of(scale)

    @staticmethod
    def law(step: Step, numbers: FloatArray, memory: FloatArray, places: IntArray) -> None:
        for p, j in enumerate(places):
            own = numbers[p]
            step.friction[j] += max(spline(own[2:], in_range(step.qpos[j], own[0], own[1])), 0.0)


@dataclass(frozen=True)
class FreeReading(FreeCurve):
    """Base: an error of the logged position; the servo uses the true one."""

    name: ClassVar[str] = "free_reading"
    family: ClassVar[str] = "sensor"
    amount: ClassVar[str] = "error"
    article: ClassVar[str] = "an "
    kinds: ClassVar[tuple[Kind, ...]] = _kinds(modal_bounds(SPLINES), 0.3, 0.005, "rad")
    includes: ClassVar[tuple[str, ...]] = ("encoder_offset",)

    @classmethod
    def sized(cls, scale: JointScale) -> tuple[Kind, ...]:
        reach = 0.3 * scale.span if scale.slide else 0.3
        return _kinds(modal_bounds(SPLINES), reach, reach / 60, "rad")

    @staticmethod
    def seen(outputs: Outputs, columns: IntArray) -> FloatArray:
        """The variable at each sample and place, (..., places)."""
        raise NotImplementedError

    def read_out(self, batch: BatchModel, values: FloatArray, outputs: Outputs) -> None:
        columns = batch.index.of(self.places)
        modes = self.modes_at(self.seen(outputs, columns), *self._bounds)
        outputs.position[:, :, columns] += modal_sum(values[:, None], modes)


@dataclass(frozen=True)
class FreeReadingPosition(FreeReading):
    """An error of the logged position that is a smooth function of the position: an eccentric disc, a worn track.

    Sensor: the log shows q and the curve at q.
    """

    variant: ClassVar[str] = "position"
    label: ClassVar[str] = "free_reading.position"
    title: ClassVar[str] = "error of the encoder that depends on the position"
    variable: ClassVar[str] = "position"
    variable_unit: ClassVar[str] = "rad"
    includes: ClassVar[tuple[str, ...]] = ("encoder_offset", "encoder_scale")
    confounders: ClassVar[tuple[tuple[str, str], ...]] = (
        ("free_torque", "a logged effort, or motion whose stiffness to torque changes"),
    )

    @classmethod
    def range_of(cls, scale: JointScale) -> tuple[float, float]:
        return FreeTorquePosition.range_of(scale)

    @staticmethod
    def seen(outputs: Outputs, columns: IntArray) -> FloatArray:
        return outputs.position[:, :, columns]


@dataclass(frozen=True)
class FreeReadingTime(FreeReading):
    """An error of the logged position that changes slowly with time: a drift with warmth, a disc that slips.

    Sensor: the log shows q and the curve at its time.
    """

    variant: ClassVar[str] = "time"
    label: ClassVar[str] = "free_reading.time"
    title: ClassVar[str] = "error of the encoder that changes slowly with time"
    variable: ClassVar[str] = "time"
    variable_unit: ClassVar[str] = "s"
    confounders: ClassVar[tuple[tuple[str, str], ...]] = (
        ("free_torque.time", "a logged effort, or motion whose stiffness to torque changes"),
    )

    @classmethod
    def range_of(cls, scale: JointScale) -> tuple[float, float]:
        return 0.0, scale.seconds

    @staticmethod
    def seen(outputs: Outputs, columns: IntArray) -> FloatArray:
        return (np.reshape(outputs.began, (-1, 1)) + outputs.time)[:, :, None]


FREE_FORMS: tuple[type[FreeCurve], ...] = (
    FreeFrictionSpeed,
    FreeFrictionLoad,
    FreeFrictionPosition,
    FreeTorquePosition,
    FreeReadingPosition,
    FreeTorqueVelocity,
    FreeTorquePeriodic,
    FreeTorqueTime,
    FreeReadingTime,
    FreeGainTime,
    FreeTorqueCommand,
    FreeTorqueLoad,
)
"""All of them, in the order in which they are preferred where they explain as much. The last two may be the answer of a
controller to something else: a drive, or a host that commands torques."""
