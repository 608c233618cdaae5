"""NaoQi: tables whose columns are ALMemory keys, as ``ALMemory.getListData`` recorders write them.

Keys and units: Aldebaran documentation, "NAO - Actuator & Sensor list" (NaoQi 1.14 and 2.x). ``Position/Actuator``
is the last value that the DCM sent to the motor board, so the servo held it until the next.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from sysid_btr.errors import LogError
from sysid_btr.io._text import some
from sysid_btr.io.importers.base import MappingNeeded, Recording, Signal
from sysid_btr.io.importers.generic import make_recording
from sysid_btr.io.importers.guess import Guess, guess, proposal
from sysid_btr.io.importers.mapping import ImportMap
from sysid_btr.io.importers.table import Table, header_names, read_table

_JOINT = re.compile(
    r"(?:.*/)?(?P<joint>\w+)/(?P<what>Position/Actuator|Position/Sensor|ElectricCurrent/Sensor|Temperature/Sensor|"
    r"Hardness/Actuator)/Value"
)
_CHANNEL: Mapping[str, tuple[str, str]] = {
    "Position/Actuator": ("command", "rad"),
    "Position/Sensor": ("position", "rad"),
    "ElectricCurrent/Sensor": ("current", "A"),
    "Temperature/Sensor": ("temperature", "degC"),
    "Hardness/Actuator": ("stiffness", "1"),
}
_INERTIAL = re.compile(
    r"(?:.*/)?InertialSensor/(?P<kind>Angle|Gyroscope|Gyr|Accelerometer|Acc)(?P<axis>[XYZ])/Sensor/Value"
)
_KIND: Mapping[str, tuple[str, str]] = {
    "Angle": ("angle", "rad"),
    "Gyroscope": ("gyro", "rad/s"),
    "Accelerometer": ("acc", "m/s^2"),
    "Gyr": ("gyro", "rad/s"),
    "Acc": ("acc", "m/s^2"),
}
_RAW: Mapping[str, str] = {"Gyr": "Gyroscope", "Acc": "Accelerometer"}
"""Keys of NaoQi before 1.14, whose scale depends on the release; the newer key of the same sensor."""
_FSR = re.compile(r"(?:.*/)?(?P<foot>[LR]Foot)/FSR/(?P<cell>(?:Front|Rear)(?:Left|Right))/Sensor/Value")
_HANDS = ("LHand", "RHand")
_ONE_MOTOR = ("LHipYawPitch", "RHipYawPitch")
_TIME = ("DCM/Time", "DCM/RealTime")
_GYRO_FULL_SCALE = 20.0
"""rad/s; twice what the sensor can show (500 deg/s)."""
_GRAVITY = (8.0, 12.0)
"""m/s^2; what the accelerometer's norm typically is on a robot that is not thrown."""


@dataclass(frozen=True)
class NaoQiImporter:
    """CSV with ALMemory keys as column names."""

    name: str = "naoqi"
    title: str = "a table of NaoQi keys"

    def recognises(self, path: Path, head: bytes) -> bool:
        return sum(bool(_JOINT.fullmatch(name)) for name in header_names(path, head)) >= 2

    def read(self, path: Path, told: ImportMap) -> Recording:
        table = read_table(path, told.table)
        columns, units, remarks = _understood(table)
        time = told.time.column or (None if told.time.rate else _time(table))
        found = Guess(time, columns, units, certain=True)
        if time is not None and time not in table.columns:
            raise LogError(f"{path}: [time] column: unknown column {time!r}")
        if (time is None and told.time.rate is None) or not found.joints("position"):
            what = "no column holds the time" if time is None else "no key is a Position/Sensor"
            raise MappingNeeded(
                f"{path}: {what}; name it in a mapping, or state the sampling rate ([time] rate = 100); a mapping to "
                "fill in is on standard output",
                lambda joints: proposal(path, table, found, joints),
            )
        recording = make_recording(path, table, found, time, told)
        recording = replace(
            recording, meta=replace(recording.meta, robot="nao"), remarks=(*recording.remarks, *remarks)
        )
        return _shared_motor(recording)


def _time(table: Table) -> str | None:
    known = [n for n in table.columns if n in _TIME or n.endswith(tuple(f"/{t}" for t in _TIME))]
    return guess(list(table.columns)).time or next(iter(known), None)


def _understood(table: Table) -> tuple[dict[str, str], dict[str, str], list[str]]:
    """Columns of the schema and units by key, and remarks on what is left out."""
    columns: dict[str, str] = {}
    units: dict[str, str] = {}
    remarks: list[str] = []
    for key, column, unit in _keys(table):
        if column.partition(".")[2] in _HANDS:
            continue
        columns[key] = column
        units[key] = unit
    hands = [key for key in table.columns if any(f"{hand}/" in key for hand in _HANDS)]
    if hands:
        remarks.append(f"hands are commanded by a fraction, not an angle: {some(hands, 4)} kept and not used")
    for raw, newer in _RAW.items():
        keys = {k: c for k, c in columns.items() if f"InertialSensor/{raw}" in k and newer not in k}
        wrong = _not_si(table, raw, newer, keys, columns)
        if wrong:
            remarks.append(f"{some(keys, 3)}: {wrong}; kept and not used")
            for key in keys:
                del columns[key]
    remarks += _gravity(table, columns)
    return columns, units, remarks


def _keys(table: Table) -> Iterator[tuple[str, str, str]]:
    """Key, column of the schema, unit."""
    for key in table.columns:
        if match := _JOINT.fullmatch(key):
            channel, unit = _CHANNEL[match["what"]]
            yield key, f"{channel}.{match['joint']}", unit
        elif match := _INERTIAL.fullmatch(key):
            kind, unit = _KIND[match["kind"]]
            column = f"imu.{kind}_{match['axis'].lower()}"
            if column != "imu.angle_z":
                yield key, column, unit
        elif match := _FSR.fullmatch(key):
            yield key, f"force.{match['foot']}{match['cell']}", "kg"


def _not_si(table: Table, raw: str, newer: str, keys: Mapping[str, str], columns: Mapping[str, str]) -> str | None:
    """Why an older inertial key cannot be used, if so."""
    if not keys:
        return None
    if any(f"InertialSensor/{newer}" in k for k in columns):
        return f"the same sensor as {newer}, in raw counts"
    values = [table.columns[k] for k in keys if k not in table.odd]
    if not values:
        return None
    if raw == "Gyr":
        peak = max(float(np.nanpercentile(np.abs(v), 99)) if np.any(np.isfinite(v)) else 0.0 for v in values)
        return f"they reach {peak:.4g}: raw counts, not rad/s" if peak > _GYRO_FULL_SCALE else None
    typical = float(np.nanmedian(np.linalg.norm(values, axis=0))) if len(values) == 3 else np.nan
    if _GRAVITY[0] < typical < _GRAVITY[1]:
        return None
    return f"their norm is {typical:.4g}, not 9.81: raw counts of an older NaoQi, not m/s^2"


def _gravity(table: Table, columns: Mapping[str, str]) -> list[str]:
    """A remark where the accelerometer shows gravity downwards, as some releases have it."""
    upright = [k for k, c in columns.items() if c == "imu.acc_z" and k not in table.odd]
    if not upright or not np.nanmedian(table.columns[upright[0]]) < -_GRAVITY[0]:
        return []
    return [
        f"{upright[0]} is about -9.8: this NaoQi reports gravity pointing down, the schema requires specific force "
        '(+9.8 upright); if the robot was upright, use --unit imu.acc=-1, or [units] "imu.acc_z" = -1 for one axis'
    ]


def _shared_motor(recording: Recording) -> Recording:
    """One motor drives both hip yaws: where only one of them has a command, it is the other's too."""
    commands = {s.column: s for s in recording.signals if s.column.startswith("command.")}
    positions = {s.column.partition(".")[2] for s in recording.signals if s.column.startswith("position.")}
    for joint, twin in (_ONE_MOTOR, _ONE_MOTOR[::-1]):
        known = commands.get(f"command.{twin}")
        if known is None or joint not in positions or f"command.{joint}" in commands:
            continue
        copy = Signal(known.source, f"command.{joint}", known.values, known.unit)
        said = f"{joint} shares the motor of {twin} and has no command of its own: that of {twin} is used"
        return replace(recording, signals=(*recording.signals, copy), remarks=(*recording.remarks, said))
    return recording
