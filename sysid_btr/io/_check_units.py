"""Units: what the metadata declares, and what the numbers look like."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping

import numpy as np

from sysid_btr._typing import FloatArray
from sysid_btr.io._text import by_channel, some
from sysid_btr.io._tracking import Tracking
from sysid_btr.io.log import Log, closest
from sysid_btr.io.problem import Problem

DEGREES = 180 / math.pi
TORQUES = 'commands that are torques: set "drive": "torque" in the metadata'
"""What to do about commands that are no positions, where the robot is not known."""
NARROW = 0.1
"""rad, range of a joint that is rather one in radians of a model that was read in degrees."""
RADIANS = 'ranges of the model so narrow are rather radians read as degrees: <compiler angle="radian"/> in it'

# Accepted spellings, the schema's own first; blanks, dots and ^ are ignored, case is not.
_ALLOWED: Mapping[str, tuple[str, ...]] = {
    "time": ("s", "sec", "second", "seconds"),
    "command": ("rad", "radian", "radians", "m", "metre", "meter", "1", "A", "V", "Nm", "N", "rad/s", "m/s"),
    "command_velocity": ("rad/s", "m/s"),
    "command_effort": ("Nm", "N"),
    "position": ("rad", "radian", "radians", "m", "metre", "meter"),
    "velocity": ("rad/s", "rads-1", "radian/s", "m/s", "ms-1"),
    "effort": ("Nm", "N"),
    "current": ("A", "ampere"),
    "voltage": ("V", "volt"),
    "duty": ("1", "", "-", "fraction", "ratio"),
    "temperature": ("degC", "C", "celsius", "K"),
    "stiffness": ("1", "", "-", "fraction", "ratio"),
    "enabled": ("bool", "boolean", "1", "", "-"),
    "imu.gyro": ("rad/s", "rads-1", "radian/s"),
    "imu.acc": ("m/s2", "m/s/s", "ms-2", "m/s**2"),
    "imu.angle": ("rad", "radian", "radians"),
    "force": ("N", "newton"),
}

# Units people use instead, and the factor to the SI unit.
_CONVERSIONS: Mapping[str, str] = {
    "deg": "multiply by pi/180",
    "degree": "multiply by pi/180",
    "degrees": "multiply by pi/180",
    "°": "multiply by pi/180",
    "deg/s": "multiply by pi/180",
    "dps": "multiply by pi/180",
    "°/s": "multiply by pi/180",
    "degrees/s": "multiply by pi/180",
    "rpm": "multiply by 2*pi/60",
    "rev/min": "multiply by 2*pi/60",
    "mm": "divide by 1000",
    "mm/s": "divide by 1000",
    "cm": "divide by 100",
    "ms": "divide by 1000",
    "us": "divide by 1e6",
    "ns": "divide by 1e9",
    "mA": "divide by 1000",
    "mV": "divide by 1000",
    "mNm": "divide by 1000",
    "kgcm": "multiply by 0.0980665",
    "kg": "multiply by 9.80665",
    "g": "multiply by 9.80665",
    "G": "multiply by 9.80665",
    "%": "divide by 100",
    "percent": "divide by 100",
    "ticks": "multiply by 2*pi / (ticks per turn)",
}


def _normal(unit: str) -> str:
    for mark in (" ", "·", "*", ".", "^"):
        unit = unit.replace(mark, "")
    return unit.replace("²", "2").replace("⁻¹", "-1").replace("**2", "2")


def _group(key: str) -> str:
    channel, _, name = key.partition(".")
    return f"imu.{name.partition('_')[0]}" if channel == "imu" and name else channel


def check_declared_units(log: Log) -> Iterator[Problem]:
    """Units in the metadata that are not those of the schema."""
    for key, unit in log.meta.units.items():
        group = _group(key)
        where = f"file metadata, `units`, `{key}`"
        if group == "imu":
            yield Problem(
                "meta.units_key",
                "warning",
                where,
                "the IMU has three channels, so this entry is not used",
                "use the keys imu.gyro (rad/s), imu.acc (m/s^2) and imu.angle (rad)",
            )
        elif group not in _ALLOWED:
            guess = closest(group, _ALLOWED)
            hint = f"; did you mean `{guess}`?" if guess else ""
            named = any(column.startswith(f"{key}.") or column == key for column in log.unknown)
            if not named:
                yield Problem(
                    "meta.units_key",
                    "warning",
                    where,
                    f"the log has no such channel or column, so this entry is not used{hint}",
                    f"use a channel ({', '.join(_ALLOWED)}) or a full column name",
                )
        elif _normal(unit) not in {_normal(allowed) for allowed in _ALLOWED[group]}:
            conversion = _CONVERSIONS.get(_normal(unit))
            shown = [allowed for allowed in ("rad", "m") if group in ("command", "position")] or [_ALLOWED[group][0]]
            if group == "velocity":
                shown = ["rad/s", "m/s"]
            wanted = " or ".join(shown)
            yield Problem(
                "meta.unit",
                "error",
                where,
                f'the unit "{unit}" is not that of the schema, which is {wanted}; values are never converted silently',
                f"convert the column ({conversion}) and set the unit to {wanted}"
                if conversion
                else f"convert the column to {wanted} and set the unit so",
            )


def is_linear(log: Log, joint: str) -> bool:
    """Whether the metadata says the joint slides (its position is in metres)."""
    units = (log.meta.unit(f"{channel}.{joint}") for channel in ("position", "command"))
    return any(unit is not None and _normal(unit) in ("m", "metre", "meter") for unit in units)


def _not_radians(log: Log, column: str) -> bool:
    """Whether another unit is declared, or radians are declared for this very column."""
    unit = log.meta.unit(column)
    return column in log.meta.units or (unit is not None and _normal(unit) not in ("rad", "radian", "radians"))


def _peak(values: FloatArray) -> float:
    finite = np.abs(values[np.isfinite(values)])
    return float(np.percentile(finite, 99)) if len(finite) else 0.0


def check_scale(
    log: Log,
    tracking: Mapping[str, Tracking],
    ranges: Mapping[str, tuple[float, float]] | None,
    kinds: Mapping[str, str],
) -> Iterator[Problem]:
    """Degrees for radians, millimetres for metres, g for m/s^2, and ranges that do not fit."""
    degrees = _degrees_by_magnitude(log, ranges or {}, kinds)
    milli: dict[str, str] = {}
    shrunk: dict[str, str] = {}
    odd: dict[str, float] = {}
    for joint, pair in tracking.items():
        slope = pair.slope
        if slope is None:
            continue
        factor = max(abs(slope), 1 / abs(slope))
        larger, smaller = ("position", "command") if abs(slope) > 1 else ("command", "position")
        reason = f"{larger}.{joint} moves {factor:.0f} times as far as {smaller}.{joint}"
        if not is_linear(log, joint) and 0.6 * DEGREES < factor < 1.6 * DEGREES:
            if _fits(log, f"{larger}.{joint}", joint, ranges or {}):
                shrunk[f"{smaller}.{joint}"] = reason
            else:
                degrees.setdefault(f"{larger}.{joint}", reason)
        elif is_linear(log, joint) and 600 < factor < 1600:
            milli[f"{larger}.{joint}"] = reason
        elif factor > 20:
            odd[joint] = slope
    degrees |= _degrees_by_derivative(log)
    if degrees:
        column, reason = next(iter(degrees.items()))
        example = reason if len(degrees) == 1 else f"for example {reason}"
        yield Problem(
            "units.degrees",
            "error",
            by_channel(list(degrees)),
            f"{'these values look' if len(degrees) > 1 else 'the values look'} like degrees, not radians: {example}",
            f"multiply by pi/180 (check every joint of the channel); a joint that really turns so far: "
            f'set "units": {{"{column}": "rad"}} in the metadata'
            + (f"; {TORQUES}" if column.startswith("command.") else "")
            + (f"; {RADIANS}" if any(_is_narrow(ranges or {}, c.partition(".")[2]) for c in degrees) else ""),
        )
    if shrunk:
        yield Problem(
            "units.degrees_twice",
            "error",
            by_channel(list(shrunk)),
            "the values look as if degrees had been converted to radians twice: "
            f"{next(iter(shrunk.values()))}, and that fits the joint's range in the model",
            "multiply by 180/pi",
        )
    if milli:
        yield Problem(
            "units.millimetres",
            "error",
            by_channel(list(milli)),
            f"the values look like millimetres, not metres: {next(iter(milli.values()))}",
            "divide by 1000",
        )
    if odd:
        worst = ", ".join(f"{joint}: {slope:.4g}" for joint, slope in list(odd.items())[:6])
        yield Problem(
            "units.scale",
            "error",
            some(odd),
            f"command and position move together but on different scales (position / command = {worst})",
            "convert both to rad (or m); encoder ticks are 2*pi / (ticks per turn) rad each",
        )
    yield from _outside_range(log, ranges or {}, set(degrees) | set(milli))
    yield from _velocity_unit(log, set(degrees))
    yield from _acceleration_in_g(log)


def _is_narrow(ranges: Mapping[str, tuple[float, float]], joint: str) -> bool:
    """Whether a joint can hardly move, if the model's range is what it seems."""
    return joint in ranges and max(map(abs, ranges[joint])) < NARROW


def _degrees_by_magnitude(
    log: Log, ranges: Mapping[str, tuple[float, float]], kinds: Mapping[str, str]
) -> dict[str, str]:
    found: dict[str, str] = {}
    for channel in ("command", "position"):
        for joint in log.joints(channel):
            column = f"{channel}.{joint}"
            if _not_radians(log, column) or (channel == "command" and kinds.get(joint) != "position"):
                continue
            peak = _peak(log.channels[column])
            limit = 2 * math.pi
            known = "one turn is 6.28 rad"
            if joint in ranges:
                limit = 1.5 * max(abs(ranges[joint][0]), abs(ranges[joint][1]), 0.1)
                known = f"the joint's range is {ranges[joint][0]:.3g} to {ranges[joint][1]:.3g} rad"
            # Degrees put back into radians must fit; something wilder is left to the range check. A command beside a
            # position that is plausible in radians is no angle, unless the two go together, which is checked too.
            beside = log.channels.get(f"position.{joint}") if channel == "command" else None
            if beside is not None and 0 < _peak(beside) <= limit:
                continue
            # what has no position among others that have one is no joint's, unless the model says so: ctrl of a gripper
            if channel == "command" and beside is None and joint not in ranges and log.joints("position"):
                continue
            if peak > limit and (joint not in ranges or peak / DEGREES <= limit):
                found[column] = f"{column} reaches {peak:.4g}, and {known}"
    for axis in ("angle_x", "angle_y"):
        column = f"imu.{axis}"
        if column in log.channels and not _not_radians(log, column):
            peak = _peak(log.channels[column])
            if peak > 2 * math.pi:
                found[column] = f"{column} reaches {peak:.4g}, and one turn is 6.28 rad"
    return found


def _fits(log: Log, column: str, joint: str, ranges: Mapping[str, tuple[float, float]]) -> bool:
    """Whether the model says where a joint may be, and a column that is moved as far stays there."""
    if joint not in ranges:
        return False
    values = log.channels[column]
    values = values[np.isfinite(values)]
    low, high = ranges[joint]
    margin = 0.05 * (high - low)
    return bool(np.all((values > low - margin) & (values < high + margin)))


def _rate_ratio(log: Log, position: str, rate: str) -> float | None:
    """Slope of a rate column against the derivative of its position column; None if they do not go together."""
    time, x, v = log.time, log.channels[position], log.channels[rate]
    span = max(1, min(5, len(time) // 20))
    if len(time) < 50:
        return None
    step = time[2 * span :] - time[: -2 * span]
    same = log.episode[2 * span :] == log.episode[: -2 * span]
    with np.errstate(all="ignore"):
        derivative = (x[2 * span :] - x[: -2 * span]) / step
    # The mean over the same interval sees the same motion as the difference quotient.
    total = np.concatenate(([0.0], np.cumsum(np.where(np.isfinite(v), v, 0.0))))
    mean = (total[2 * span + 1 :] - total[: -2 * span - 1]) / (2 * span + 1)
    good = np.isfinite(derivative) & (step > 0) & same
    if good.sum() < 50:
        return None
    a, b = derivative[good] - derivative[good].mean(), mean[good] - mean[good].mean()
    aa, bb = float(a @ a), float(b @ b)
    if aa <= 0 or bb <= 0 or float(a @ b) / math.sqrt(aa * bb) < 0.8:
        return None
    return math.sqrt(bb / aa)


def _degrees_by_derivative(log: Log) -> dict[str, str]:
    found: dict[str, str] = {}
    for axis in ("x", "y"):
        angle, gyro = f"imu.angle_{axis}", f"imu.gyro_{axis}"
        if angle not in log.channels or gyro not in log.channels:
            continue
        ratio = _rate_ratio(log, angle, gyro)
        if ratio is None:
            continue
        if 0.6 * DEGREES < ratio < 1.6 * DEGREES and not _not_radians(log, gyro):
            found[gyro] = f"{gyro} is {ratio:.0f} times the rate of {angle}"
        elif 0.6 < ratio * DEGREES < 1.6 and not _not_radians(log, angle):
            found[angle] = f"{angle} changes {1 / ratio:.0f} times as fast as {gyro} says"
    return found


def _velocity_unit(log: Log, degrees: set[str]) -> Iterator[Problem]:
    wrong: dict[str, tuple[float, str]] = {}
    for joint in log.joints("velocity"):
        column, position = f"velocity.{joint}", f"position.{joint}"
        if position not in log.channels or position in degrees:
            continue
        ratio = _rate_ratio(log, position, column)
        if ratio is None:
            continue
        for factor, name, remedy in (
            (DEGREES, "deg/s", "multiply by pi/180"),
            (60 / (2 * math.pi), "rpm", "multiply by 2*pi/60"),
            (1000.0, "mm/s", "divide by 1000"),
        ):
            if 0.8 * factor < ratio < 1.25 * factor:
                wrong[column] = (ratio, f"looks like {name}: {remedy}")
    if wrong:
        column, (ratio, what) = next(iter(wrong.items()))
        yield Problem(
            "units.velocity",
            "error",
            by_channel(list(wrong)),
            f"the velocity is {ratio:.3g} times the rate of change of the position; {what.split(':')[0]}",
            f"{what.split(': ')[1]}; the schema requires rad/s (or m/s)",
        )


def _acceleration_in_g(log: Log) -> Iterator[Problem]:
    axes = [f"imu.acc_{axis}" for axis in "xyz"]
    if any(column not in log.channels for column in axes):
        return
    norm = np.linalg.norm([log.channels[column] for column in axes], axis=0)
    norm = norm[np.isfinite(norm)]
    typical = float(np.median(norm)) if len(norm) else 0.0
    if 0.8 < typical < 1.25:
        yield Problem(
            "units.g",
            "error",
            "imu.acc_x, imu.acc_y, imu.acc_z",
            f"the specific force is typically {typical:.3g}: it looks like g, not m/s^2 (9.81 at rest)",
            "multiply by 9.80665",
        )


def _outside_range(log: Log, ranges: Mapping[str, tuple[float, float]], explained: set[str]) -> Iterator[Problem]:
    outside: list[str] = []
    for joint, (low, high) in ranges.items():
        column = f"position.{joint}"
        if column not in log.channels or column in explained or not high > low:
            continue
        values = log.channels[column]
        values = values[np.isfinite(values)]
        margin = 0.05 * (high - low)
        if len(values) and (values.min() < low - margin or values.max() > high + margin):
            outside.append(f"{joint} {values.min():.3g} to {values.max():.3g} (allowed {low:.3g} to {high:.3g})")
    if outside:
        yield Problem(
            "position.range",
            "warning",
            some(outside, 8),
            "the position leaves the joint's range in the model",
            "check the model's range, the encoder's zero and sign, and that the joint has the right name",
        )
