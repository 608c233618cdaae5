"""The mapping file (TOML): all that a user can say about a foreign log. Flags of the command line end here too.

An example of all its sections:

    [time]
    column = "t_ms"                  # or: rate = 100, in Hz, where no column holds the time

    [units]                          # of a channel or of one column; a number is a factor to SI
    time = "ms"
    position = "deg"
    "position.slider" = "mm"
    "imu.acc" = "g"
    voltage = "0.1 V"                # a multiple of a unit
    "position.knee" = "ticks4096@2048"    # counts of an encoder: 4096 a turn, 2048 is the zero

    [encoding]                       # registers of servos that were read without their sign
    velocity = "sign15"              # bit 15 is the sign; or int16: two's complement

    [missing]                        # numbers that stand for no value
    command = [2.146e9]

    [channels]                       # where each channel is; {joint}, {axis} or {site} stands for the name,
                                     # * for anything, ? for marks between words (_ . / [ ])
    command = "{joint}_cmd"
    position = ["{joint}_pos", "{joint}_angle"]
    "imu.gyro" = "gyro_{axis}"

    [columns]                        # single columns; they win over the patterns
    "IMU a x" = "imu.acc_x"

    [joints]                         # name in the file = name in the model
    knee_r = "RKneePitch"
    [joints.knee_l]
    to = "LKneePitch"
    sign = -1                        # of command, position, velocity, effort and duty
    offset = 0.02                    # rad or m, added to command and position after unit and sign

    [meta]                           # also: source, notes, command_hold ("zoh", "linear"), servo_period (s)
    robot = "nao"
    mount = "fixed"
    torque_constant = 0.5            # Nm/A; or by joint: {LKneePitch = 0.5}

    [table]                          # of text; what is not said is found out
    missing = ["-9999"]

    [ros]                            # of bags and MCAP files
    state = "/joint_states"
    command = ["/arm/commands"]
    joints = ["hip", "knee"]         # order in arrays without names
    clock = "receive"                # instead of the stamps in the headers

    [lerobot]
    episodes = [0, 3]
    joints = ["pan", "lift"]         # where the dataset has no names
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, Literal, TypeVar

from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator, model_validator

from sysid_btr.errors import UsageError
from sysid_btr.io.importers.encoding import EXAMPLES, is_encoding
from sysid_btr.io.importers.presets import preset_text
from sysid_btr.io.importers.units import NORMALISED, SI, check_key, group_of, resolve
from sysid_btr.io.log import is_schema_column
from sysid_btr.reading import parse_toml

T = TypeVar("T")


class _Part(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)


class TimeRule(_Part):
    """Where the time is.

    Attributes
    ----------
    column : its name.
    rate : Hz, where the rows are evenly spaced and no column holds the time.
    """

    column: str | None = None
    rate: float | None = Field(default=None, gt=0, strict=False)

    @model_validator(mode="after")
    def _one_of_them(self) -> TimeRule:
        if self.column is not None and self.rate is not None:
            raise ValueError("give column or rate, not both")
        return self


class TableRule(_Part):
    """How a text table is written; what is not said is found out.

    Attributes
    ----------
    separator : between fields.
    decimal : ``.`` or ``,``.
    missing : texts that stand for a missing value, besides empty, ``NaN``, ``NA`` and ``null``.
    header : names of the columns, where the file has none.
    """

    separator: str | None = Field(default=None, min_length=1, max_length=1)
    decimal: Literal[".", ","] | None = None
    missing: list[str] = []
    header: list[str] | None = None


class JointRule(_Part):
    """What is to be done with a joint.

    Attributes
    ----------
    to : its name in the model.
    sign : 1 or -1; of command, position, velocity, effort and duty.
    offset : rad or m, added to command and position after unit and sign.
    range : rad or m, the ends of its calibrated range, for normalised positions.
    """

    to: str | None = Field(default=None, min_length=1)
    sign: Literal[1, -1] = 1
    offset: float = Field(default=0.0, allow_inf_nan=False, strict=False)
    range: tuple[float, float] | None = None

    @model_validator(mode="before")
    @classmethod
    def _name_alone(cls, value: Any) -> Any:
        if isinstance(value, str):
            return {"to": value}
        if isinstance(value, dict) and isinstance(value.get("range"), list):
            return {**value, "range": tuple(float(v) if isinstance(v, int) else v for v in value["range"])}
        return value


class MetaRule(_Part):
    """Metadata of the log."""

    robot: str | None = None
    mount: Literal["fixed", "free"] | None = None
    source: str | None = None
    notes: str | None = None
    command_hold: Literal["zoh", "linear"] | None = None
    servo_period: float | None = Field(default=None, gt=0, strict=False)
    torque_constant: float | dict[str, float] | None = None


class RosRule(_Part):
    """Which topics of a bag are what.

    Attributes
    ----------
    state : JointState topics that hold measurements; the rows of the log are the stamps of the first joint.
    command : topics that hold commands.
    imu : the Imu topic.
    joints : order of the joints in arrays without names; for all topics, or by topic.
    clock : ``header`` stamps, or the times at which messages were ``receive``-d.
    """

    state: list[str] = []
    command: list[str] = []
    imu: str | None = None
    joints: list[str] | dict[str, list[str]] = []
    clock: Literal["header", "receive"] | None = None

    @field_validator("state", "command", mode="before")
    @classmethod
    def _one_topic(cls, value: Any) -> Any:
        return [value] if isinstance(value, str) else value

    def order(self, topic: str) -> list[str] | None:
        """Joints of an array without names, if told."""
        given = self.joints.get(topic) if isinstance(self.joints, dict) else self.joints
        return given or None


class LeRobotRule(_Part):
    """What a LeRobot dataset does not say itself.

    Attributes
    ----------
    joints : names of the entries of ``observation.state`` and ``action``, where the dataset has none.
    episodes : which to import; all where empty.
    """

    joints: list[str] = []
    episodes: list[int] = []


class ImportMap(_Part):
    """All that a user said about a foreign log; see the module for an example.

    Attributes
    ----------
    time, table, ros, lerobot : how to read the source.
    episode : column with the number of the recording that a row belongs to.
    partial : whether patterns that match no column, columns and joints that are not there are no mistakes.
    units : by kind of column or column; names, or factors to SI.
    encoding : by kind of column or column; how registers hold their sign, where they were read without it.
    missing : by kind of column or column; numbers that stand for no value.
    channels : patterns of the source's column names by kind of column.
    columns : the source's columns by name -> column of the schema.
    joints : by the source's name.
    ignore : globs of columns to leave out; in bags of columns of the schema, joints by the bag's names.
    meta : metadata.
    """

    time: TimeRule = TimeRule()
    partial: bool = False
    episode: str | None = None
    units: dict[str, str | float] = {}
    encoding: dict[str, str] = {}
    missing: dict[str, list[float]] = {}
    channels: dict[str, list[str]] = {}
    columns: dict[str, str] = {}
    joints: dict[str, JointRule] = {}
    ignore: list[str] = []
    table: TableRule = TableRule()
    meta: MetaRule = MetaRule()
    ros: RosRule = RosRule()
    lerobot: LeRobotRule = LeRobotRule()

    @field_validator("units", mode="before")
    @classmethod
    def _factors_as_floats(cls, value: Any) -> Any:
        if not isinstance(value, dict):
            return value
        return {k: float(v) if isinstance(v, int) and not isinstance(v, bool) else v for k, v in value.items()}

    @field_validator("units")
    @classmethod
    def _units_exist(cls, units: dict[str, str | float]) -> dict[str, str | float]:
        problems = [wrong for key, unit in units.items() if (wrong := _wrong_unit(key, unit))]
        if problems:
            raise ValueError("; ".join(problems))
        return units

    @field_validator("encoding")
    @classmethod
    def _encodings_exist(cls, encoding: dict[str, str]) -> dict[str, str]:
        problems = [wrong for key in encoding if (wrong := check_key(key))]
        problems += [f"{e!r} is not an encoding; use {EXAMPLES}" for e in encoding.values() if not is_encoding(e)]
        if problems:
            raise ValueError("; ".join(problems))
        return encoding

    @field_validator("missing", mode="before")
    @classmethod
    def _one_number(cls, value: Any) -> Any:
        if not isinstance(value, dict):
            return value
        lists = {k: v if isinstance(v, list) else [v] for k, v in value.items()}
        return {k: [float(n) if isinstance(n, int) else n for n in v] for k, v in lists.items()}

    @field_validator("missing")
    @classmethod
    def _missing_of_columns(cls, missing: dict[str, list[float]]) -> dict[str, list[float]]:
        problems = [wrong for key in missing if (wrong := check_key(key))]
        if problems:
            raise ValueError("; ".join(problems))
        return missing

    @field_validator("channels", mode="before")
    @classmethod
    def _one_pattern(cls, value: Any) -> Any:
        if not isinstance(value, dict):
            return value
        return {k: [v] if isinstance(v, str) else v for k, v in value.items()}

    @field_validator("channels")
    @classmethod
    def _channels_exist(cls, channels: dict[str, list[str]]) -> dict[str, list[str]]:
        kinds = [kind for kind in SI if kind != "time"]
        problems = [f"{c!r} is not a channel; available: {', '.join(kinds)}" for c in channels if c not in kinds]
        problems += [
            f"{pattern!r} needs one placeholder, such as {{joint}}"
            for patterns in channels.values()
            for pattern in patterns
            if pattern.count("{") != 1 or pattern.count("}") != 1
        ]
        if problems:
            raise ValueError("; ".join(problems))
        return channels

    @field_validator("columns")
    @classmethod
    def _columns_are_of_the_schema(cls, columns: dict[str, str]) -> dict[str, str]:
        problems = [
            f"{to!r} is not a column of the schema: use <channel>.<name>, such as position.HeadYaw or imu.acc_x"
            for to in columns.values()
            if not is_schema_column(to)
        ]
        if problems:
            raise ValueError("; ".join(problems))
        return columns

    def unit(self, column: str, *names: str) -> str | float | None:
        """What was said about a column's unit: under its own name (or another of `names`), or its kind's."""
        return _said(self.units, column, names)

    def encoded(self, column: str, *names: str) -> str | None:
        """How a column's register holds its sign, if that was said."""
        return _said(self.encoding, column, names)

    def absent(self, column: str, *names: str) -> list[float]:
        """Numbers that stand for no value in a column."""
        return _said(self.missing, column, names) or []

    @property
    def lays_out_columns(self) -> bool:
        """Whether it says which column is what, so that nothing is to be guessed."""
        return bool(self.channels or self.columns)


def _said(table: Mapping[str, T], column: str, names: Iterable[str]) -> T | None:
    """What a table says of a column: under its own name, another of `names`, or its kind's."""
    return next((table[k] for k in (column, *names, group_of(column)) if k in table), None)


def _wrong_unit(key: str, unit: str | float) -> str | None:
    wrong = check_key(key)
    if wrong:
        return wrong
    if unit in NORMALISED:
        return None if group_of(key) in ("command", "position") else f"{key}: only positions are normalised"
    try:
        resolve(unit, group_of(key))
    except UsageError as error:
        return str(error)
    return None


def read_map(path: Path | None, preset: str | None = None) -> ImportMap:
    """The mapping in a file, on top of a preset; an empty one without either.

    Raises
    ------
    UsageError
        If it cannot be read, is not TOML, or says something that cannot be; all of it at once. If there is no such
        preset.
    """
    ground = parse_toml(preset_text(preset).encode()) if preset is not None else {}
    if path is None:
        return _checked(ground, f"--preset {preset}")
    try:
        content = parse_toml(path.read_bytes())
    except OSError as error:
        raise UsageError(f"--map {path}: {error.strerror}") from error
    except ValueError as error:
        raise UsageError(f"--map {path} is not TOML: {error}") from error
    return _checked(_on_top(ground, content), f"--map {path}")


def _on_top(ground: Mapping[str, Any], content: Mapping[str, Any]) -> dict[str, Any]:
    """One mapping over another: entry by entry of their sections."""
    both = {k: {**ground[k], **content[k]} for k in ground if isinstance(ground[k], dict) and _is_table(content, k)}
    return {**ground, **content, **both}


def _is_table(content: Mapping[str, Any], key: str) -> bool:
    return isinstance(content.get(key), dict)


def with_flags(
    told: ImportMap,
    *,
    units: Iterable[tuple[str, str]] = (),
    renames: Iterable[tuple[str, str]] = (),
    meta: Mapping[str, str | None] | None = None,
) -> ImportMap:
    """The mapping with what the command line says on top.

    Parameters
    ----------
    told : of the mapping file.
    units : pairs of kind or column and unit (or a number, as text).
    renames : pairs of the source's joint and the model's.
    meta : metadata; None where nothing is said.

    Raises
    ------
    UsageError
        For a unit or key that does not exist.
    """
    flags = {key: _number_or_name(text) for key, text in units}
    wrong = [f"--unit {key}={unit}: {said}" for key, unit in flags.items() if (said := _wrong_unit(key, unit))]
    mount = (meta or {}).get("mount")
    if mount not in (None, "fixed", "free"):
        wrong.append(f"--mount {mount}: use fixed (fixed base) or free (floating base)")
    if wrong:
        raise UsageError("\n".join(wrong))
    content = told.model_dump(exclude_unset=True)
    # a flag for a channel wins over what the file says of its columns
    kept = {k: u for k, u in content.get("units", {}).items() if group_of(k) not in flags}
    content["units"] = {**kept, **flags}
    joints = content.setdefault("joints", {})
    for name, to in renames:
        joints[name] = {**joints.get(name, {}), "to": to}
    content["meta"] = {
        **content.get("meta", {}),
        **{key: value for key, value in (meta or {}).items() if value is not None},
    }
    return ImportMap.model_validate(content)


def _number_or_name(text: str) -> str | float:
    try:
        return float(text)
    except ValueError:
        return text


def _checked(content: dict[str, Any], where: str) -> ImportMap:
    try:
        return ImportMap.model_validate(content)
    except ValidationError as error:
        lines = [f"  {'.'.join(map(str, e['loc']))}: {_plain(e['msg'])}" for e in error.errors()]
        known = ", ".join(ImportMap.model_fields)
        listing = "\n".join(dict.fromkeys(lines))
        raise UsageError(f"{where}:\n{listing}\nsections: {known}") from error


def _plain(message: str) -> str:
    return message.removeprefix("Value error, ")
