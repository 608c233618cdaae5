"""Units that people log in, and how they become those of the schema."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from sysid_btr._typing import FloatArray
from sysid_btr.errors import UsageError
from sysid_btr.io.log import IMU_NAMES, JOINT_CHANNELS, closest

GRAVITY = 9.80665
"""m/s^2; also N per kg, as scales count."""
NORMALISED: Mapping[str, tuple[float, float]] = {"range_m100_100": (-100.0, 100.0), "range_0_100": (0.0, 100.0)}
"""Positions as a share of the joint's calibrated range (LeRobot's names): the values at its two ends."""


@dataclass(frozen=True)
class Unit:
    """A unit: value in `si` = `factor` * value + `shift`.

    Attributes
    ----------
    si : unit of the schema.
    factor, shift : of the conversion.
    turn : value at which a counter of a turn begins anew, in this unit; 0 for what does not count.
    """

    si: str
    factor: float = 1.0
    shift: float = 0.0
    turn: float = 0.0

    def convert(self, values: FloatArray) -> FloatArray:
        """Values in the unit of the schema; exactly the same ones if they are in it already."""
        if self.factor == 1.0 and self.shift == 0.0:
            return values
        return values * self.factor + self.shift


SI: Mapping[str, tuple[str, ...]] = {
    "time": ("s",),
    "command": ("rad", "m", "rad/s", "m/s", "Nm", "N", "A", "V", "1"),
    "command_velocity": ("rad/s", "m/s"),
    "command_effort": ("Nm", "N"),
    "position": ("rad", "m"),
    "velocity": ("rad/s", "m/s"),
    "effort": ("Nm", "N"),
    "current": ("A",),
    "voltage": ("V",),
    "duty": ("1",),
    "temperature": ("degC",),
    "stiffness": ("1",),
    "enabled": ("1",),
    "imu.gyro": ("rad/s",),
    "imu.acc": ("m/s^2",),
    "imu.angle": ("rad",),
    "force": ("N",),
}
"""Units of the schema by kind of column, the usual one first."""

_TURN, _DEGREE = 2 * math.pi, math.pi / 180
_UNITS: Mapping[str, tuple[Unit, ...]] = {
    "s sec secs second seconds": (Unit("s"),),
    "ms millisecond milliseconds": (Unit("s", 1e-3),),
    "us µs usec microsecond microseconds": (Unit("s", 1e-6),),
    "ns nanosecond nanoseconds": (Unit("s", 1e-9),),
    "rad radian radians": (Unit("rad"),),
    "mrad": (Unit("rad", 1e-3),),
    "deg degree degrees °": (Unit("rad", _DEGREE),),
    "turn turns rev revolution revolutions": (Unit("rad", _TURN),),
    "m metre metres meter meters": (Unit("m"),),
    "mm": (Unit("m", 1e-3),),
    "cm": (Unit("m", 1e-2),),
    "rad/s rads-1 radian/s radians/s": (Unit("rad/s"),),
    "deg/s dps °/s degree/s degrees/s degs-1": (Unit("rad/s", _DEGREE),),
    "rpm rev/min": (Unit("rad/s", _TURN / 60),),
    "rev/s turn/s turns/s rps": (Unit("rad/s", _TURN),),
    "m/s ms-1": (Unit("m/s"),),
    "mm/s": (Unit("m/s", 1e-3),),
    "cm/s": (Unit("m/s", 1e-2),),
    "Nm": (Unit("Nm"),),
    "mNm": (Unit("Nm", 1e-3),),
    "Ncm": (Unit("Nm", 1e-2),),
    "kgcm kgfcm": (Unit("Nm", GRAVITY / 100),),
    "N newton newtons": (Unit("N"),),
    "mN": (Unit("N", 1e-3),),
    "kN": (Unit("N", 1e3),),
    "kg kgf": (Unit("N", GRAVITY),),
    "A ampere amperes amps": (Unit("A"),),
    "mA": (Unit("A", 1e-3),),
    "V volt volts": (Unit("V"),),
    "mV": (Unit("V", 1e-3),),
    "degC C celsius °C": (Unit("degC"),),
    "K kelvin": (Unit("degC", 1.0, -273.15),),
    "degF F °F": (Unit("degC", 5 / 9, -160 / 9),),
    "m/s2 m/s/s ms-2": (Unit("m/s^2"),),
    "g": (Unit("m/s^2", GRAVITY),),
    "mg": (Unit("m/s^2", 1e-3 * GRAVITY),),
    "1 fraction ratio bool boolean": (Unit("1"),),
    "% percent": (Unit("1", 1e-2),),
}
_TICKS = re.compile(r"ticks(?P<turn>[1-9]\d*)(?:@(?P<zero>-?\d+(?:\.\d+)?)|(?P<rate>/s))?", re.I)
_MULTIPLE = re.compile(r"(?P<number>\d*\.?\d+(?:e-?\d+)?) *(?P<unit>[^\d\s.].*)", re.I)
_BY_NAME: Mapping[str, tuple[Unit, ...]] = {name: units for names, units in _UNITS.items() for name in names.split()}


def group_of(column: str) -> str:
    """Kind of a schema column: its channel, or for the IMU ``imu.gyro``, ``imu.acc``, ``imu.angle``."""
    channel, _, name = column.partition(".")
    return f"imu.{name.partition('_')[0]}" if channel == "imu" and name else channel


def check_key(key: str) -> str | None:
    """What is wrong with the key of a unit, if anything: it must be a kind of column or a column."""
    channel, _, name = key.partition(".")
    known = group_of(key) in SI and (channel != "imu" or key in SI or name in IMU_NAMES)
    if known and (channel != "time" or not name):
        return None
    guess = closest(channel, (*SI, "imu"))
    hint = f"did you mean {guess}? " if guess else ""
    return f"{key!r} is not a channel or column; {hint}available: {', '.join(SI)}, and columns as position.HeadYaw"


def resolve(unit: str | float, group: str) -> Unit:
    """The unit called so, for a kind of column; a number is a factor to the schema's usual unit.

    Raises
    ------
    UsageError
        If there is no such unit, or it measures something else.
    """
    allowed = SI[group]
    if not isinstance(unit, str):
        return Unit(allowed[0], float(unit))
    candidates = find(unit)
    chosen = next((u for u in candidates if u.si in allowed), None)
    if chosen is None:
        fitting = [names.split()[0] for names, units in _UNITS.items() if units[0].si in allowed]
        what = f"does not measure {group}" if candidates else "is unknown"
        raise UsageError(
            f"unit {unit!r} {what}: {group} may be in {', '.join(fitting)}{_counts_of(allowed)}, a multiple of these "
            f"(0.5 {fitting[0]}), or give a number, the factor to {allowed[0]}"
        )
    return chosen


def find(text: str) -> tuple[Unit, ...]:
    """Units of this name, exactly or but for case; none if it is no unit.

    A name may be a multiple of another (``0.229 rpm``), or speak of an encoder's counts: ``ticks4096`` are 4096 a turn,
    ``ticks4096@2048`` count from the zero at 2048, ``ticks4096/s`` are a speed.
    """
    ticks = _TICKS.fullmatch(text.strip())
    if ticks:
        return (_ticks(ticks),)
    multiple = _MULTIPLE.fullmatch(text.strip())
    if multiple:
        number = float(multiple["number"])
        return tuple(replace(u, factor=number * u.factor) for u in find(multiple["unit"]) if not u.turn)
    for mark in (" ", "·", "*", "^"):
        text = text.replace(mark, "")
    text = text.replace(".", "") if not text.replace(".", "").isdigit() else text
    text = text.replace("²", "2").replace("⁻¹", "-1").replace("⁻²", "-2")
    if text in _BY_NAME:
        return _BY_NAME[text]
    return next((units for name, units in _BY_NAME.items() if name.casefold() == text.casefold()), ())


def _ticks(found: re.Match[str]) -> Unit:
    """Counts of an encoder."""
    turn = float(found["turn"])
    factor = _TURN / turn
    if found["rate"]:
        return Unit("rad/s", factor)
    return Unit("rad", factor, -factor * float(found["zero"] or 0), turn)


def _counts_of(allowed: tuple[str, ...]) -> str:
    return ", ticks4096 (a turn), ticks4096@2048 (its zero)" if "rad" in allowed else ""


def unwrapped(values: FloatArray, turn: float) -> tuple[FloatArray, int]:
    """Counts of a turn that begin anew at its end, counted on; and how often they passed it.

    A step of more than half a turn from one value to the next is taken for the shorter way round. Missing values are
    passed over.

    Parameters
    ----------
    values : ndarray, shape (n,).
    turn : counts in it.
    """
    here = np.flatnonzero(np.isfinite(values))
    steps = np.diff(values[here])
    passed = -np.round(steps / turn)
    # half a turn is no shorter the other way
    passed[np.abs(steps) == turn / 2] = 0
    result = values.copy()
    result[here[1:]] += turn * np.cumsum(passed)
    return result, int(np.count_nonzero(passed))


def signed_with_joint(column: str) -> bool:
    """Whether a column changes its sign when the joint's axis is turned round.

    Currents and supply voltages do not: most drives log their magnitude.
    """
    return column.partition(".")[0] in ("command", "position", "velocity", "effort", "duty")


def is_joint_column(column: str) -> bool:
    """Whether a schema column belongs to a joint."""
    return column.partition(".")[0] in JOINT_CHANNELS
