"""Topics of a robot's middleware as one log: which topic is what, and all of them on one clock.

The rows are the stamps of the measured joint states. Commands are held until the next one; IMU and further joint
states are interpolated between their own neighbouring samples. What a message holds: common_interfaces
(sensor_msgs, trajectory_msgs, std_msgs), ros2_control (control_msgs), and unitree_ros2 (unitree_go, unitree_hg), whose
motors have numbers and no names.
"""

from __future__ import annotations

import itertools
import json
import math
import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from sysid_btr._typing import BoolArray, IntArray
from sysid_btr.errors import LogError, UsageError
from sysid_btr.io._text import some
from sysid_btr.io.importers.align import Series, lateness, on_clock
from sysid_btr.io.importers.base import MappingNeeded, Recording, Signal
from sysid_btr.io.importers.mapping import ImportMap, RosRule
from sysid_btr.io.log import LogMeta

JOINT_STATE = "sensor_msgs/JointState"
IMU = "sensor_msgs/Imu"
TRAJECTORY = "trajectory_msgs/JointTrajectory"
ARRAYS = ("std_msgs/Float64MultiArray", "std_msgs/Float32MultiArray")
CONTROLLER = "control_msgs/JointTrajectoryControllerState"
MOTOR_STATES = ("unitree_go/LowState", "unitree_hg/LowState")
MOTOR_COMMANDS = ("unitree_go/LowCmd", "unitree_hg/LowCmd")
COMMANDS = (JOINT_STATE, TRAJECTORY, CONTROLLER, *MOTOR_COMMANDS, *ARRAYS)
STATES = (JOINT_STATE, CONTROLLER, *MOTOR_STATES)
_SCALAR = re.compile(r"std_msgs/(Float(32|64)|U?Int(8|16|32|64)|Bool)")
_COMMAND_WORDS = re.compile(r"(^|[/_])(commands?|cmds?|desired|target|goal|reference|setpoints?)([/_]|$)")
_OTHER_QUANTITY = re.compile(r"(^|[/_])(effort|torque|velocity|vel|current)")
_SAME_CLOCK = 1.0
"""s; header stamps and receive times that differ by less come from one clock."""
_RESET = 1.0
"""s; a clock that jumps back further was set, and not merely overtaken."""
_BILLION = 1_000_000_000

Values = Mapping[str, float]


class Bag(Protocol):
    """A recording of topics.

    Attributes
    ----------
    topics : by name -> type as ``package/Name``.
    """

    @property
    def topics(self) -> Mapping[str, str]: ...

    def messages(self, topics: Collection[str]) -> Iterator[tuple[str, int, Any]]:
        """Topic, time of receipt (ns) and decoded message, in the order received."""
        ...


@dataclass(frozen=True)
class Roles:
    """Which topics are what."""

    state: tuple[str, ...]
    command: tuple[str, ...]
    imu: tuple[str, ...]
    scalars: tuple[str, ...]
    unknown: tuple[str, ...] = ()
    remarks: tuple[str, ...] = ()

    @property
    def all(self) -> tuple[str, ...]:
        """Topics to read."""
        return tuple(dict.fromkeys((*self.state, *self.command, *self.imu, *self.scalars)))


@dataclass(eq=False)
class _Rows:
    """Messages of one topic: stamps of header (0 if none) and receipt, ns, and values by column."""

    header: list[int] = field(default_factory=list)
    receive: list[int] = field(default_factory=list)
    ahead: list[int] = field(default_factory=list)
    values: list[Values] = field(default_factory=list)
    interpolates: bool = False


def plain_type(name: str) -> str:
    """``sensor_msgs/msg/JointState``, also with dots or ``::`` -> ``sensor_msgs/JointState``."""
    parts = [p for p in re.split(r"[/.]|::", name) if p not in ("msg", "dds_")]
    return "/".join(p.strip("_") for p in parts)


def read_bag(path: Path, bag: Bag, told: ImportMap) -> Recording:
    """A bag as one recording.

    Raises
    ------
    LogError
        If it holds no joint states or no commands, or they cannot be told apart or brought onto one clock.
    UsageError
        If the mapping names a topic that is not there or of no use.
    """
    roles = choose_roles(path, bag.topics, told.ros)
    rows: dict[str, _Rows] = {topic: _Rows() for topic in roles.all}
    for topic, received, message in bag.messages(roles.all):
        for ahead, values in _read(topic, plain_type(bag.topics[topic]), message, roles, told.ros):
            kept = rows[topic]
            kept.header.append(_header(message))
            kept.receive.append(received)
            kept.ahead.append(ahead)
            kept.values.append(values)
            kept.interpolates |= ahead > 0
    empty = [t for t in (*roles.state, *roles.command) if not any(rows[t].values)]
    if empty:
        raise LogError(f"{path}: no message with joint positions on {', '.join(empty)}")
    use_header, remarks = _clock_of(rows, roles, told.ros)
    series, origin, more = _all_series(path, rows, roles, use_header)
    series = [s for s in series if not any(fnmatchcase(s.column, glob) for glob in told.ignore)]
    meta = LogMeta(extra={"time_origin_ns": origin})
    return _on_one_clock(path, series, roles, meta, (*roles.remarks, *remarks, *more))


# --- which topic is what -------------------------------------------------------------------------------------


def choose_roles(path: Path, topics: Mapping[str, str], rule: RosRule) -> Roles:
    """Which topics are measurements, commands, the IMU."""
    types = {topic: plain_type(kind) for topic, kind in topics.items()}
    absent = [t for t in (*rule.state, *rule.command, *([rule.imu] if rule.imu else [])) if t not in types]
    wrong = [t for t in rule.command if t in types and types[t] not in COMMANDS]
    wrong += [t for t in rule.state if t in types and types[t] not in STATES]
    wrong += [rule.imu] if rule.imu and types.get(rule.imu, IMU) != IMU else []
    if absent or wrong:
        listing = [f"[ros] {t}: not a topic of the bag" for t in absent]
        listing += [f"[ros] {t}: messages of type {types[t]} cannot be used there" for t in wrong]
        raise UsageError("\n".join([f"{path}:", *listing, f"topics: {_listing(types)}"]))
    command = tuple(rule.command) or tuple(
        t for t, kind in types.items() if _is_command(t, kind) and t not in rule.state
    )
    measured = tuple(t for t, kind in types.items() if kind in (JOINT_STATE, *MOTOR_STATES) and t not in command)
    # a controller says what it measures, too
    state = tuple(rule.state) or measured or tuple(t for t in command if types[t] == CONTROLLER)
    imus = [rule.imu] if rule.imu else [t for t, kind in types.items() if kind == IMU]
    remarks = []
    if len(imus) > 1:
        remarks.append(f"more than one Imu topic, none is used: select one by [ros] imu = {imus[0]!r}")
        imus = []
    if not state or not command:
        missing = "joint states (sensor_msgs/JointState)" if not state else "commands"
        raise MappingNeeded(
            f"{path}: no topic with {missing} was recognised among {_listing(types) or 'no topics at all'}. "
            "Name them in a mapping, --map FILE; one to fill in is on standard output",
            lambda _: proposal(path, types, state, command),
        )
    scalars = tuple(t for t, kind in types.items() if _SCALAR.fullmatch(kind) and t not in command)
    roles = Roles(state, command, tuple(imus), scalars)
    unknown = tuple(t for t in types if t not in roles.all)
    if unknown:
        some_ = some([f"{t} ({types[t]})" for t in unknown], 12)
        count = "1 topic is" if len(unknown) == 1 else f"{len(unknown)} topics are"
        remarks.append(f"{count} not recognised and not kept: {some_}")
    if scalars:
        remarks.append(f"single values are kept and not used: {some(scalars, 12)}")
    return replace(roles, unknown=unknown, remarks=tuple(remarks))


def _is_command(topic: str, kind: str) -> bool:
    if kind in (TRAJECTORY, CONTROLLER, *MOTOR_COMMANDS):
        return True
    named = bool(_COMMAND_WORDS.search(topic)) and not _OTHER_QUANTITY.search(topic)
    return named and (kind == JOINT_STATE or kind in ARRAYS)


def _listing(types: Mapping[str, str]) -> str:
    return some([f"{topic} ({kind})" for topic, kind in types.items()], 20)


def proposal(path: Path, types: Mapping[str, str], state: Sequence[str] = (), command: Sequence[str] = ()) -> str:
    """A mapping file for a bag whose topics could not be told apart."""
    joint_states = list(state) or [t for t, kind in types.items() if kind == JOINT_STATE]
    commands = list(command) or [t for t, kind in types.items() if kind in COMMANDS and t not in joint_states]
    return "\n".join(
        [
            f"# Topics of {path.name}. Fill in what is missing, then:",
            f"#   sysid-btr import {path.name} --map FILE --out {path.stem}.parquet",
            *(f"#   {topic}   {kind}" for topic, kind in types.items()),
            "[ros]",
            f"{'' if joint_states else '# '}state = {json.dumps(joint_states or ['/joint_states'])}",
            f"{'' if commands else '# '}command = {json.dumps(commands or ['/joint_commands'])}"
            "   # JointTrajectory, JointState, Float64MultiArray, or a controller's state",
            '# joints = ["hip", "knee"]   # order of the joints in arrays without names',
            '# imu = "/imu"',
            "",
            "[meta]",
            'mount = "fixed"      # "free" for a floating base',
            "",
            "[joints]             # name in the bag = name in the model",
            "",
        ]
    )


# --- what a message says -------------------------------------------------------------------------------------


def _read(topic: str, kind: str, message: Any, roles: Roles, rule: RosRule) -> Iterator[tuple[int, Values]]:
    """Values by column, each with the time (ns) from the message's stamp to when they apply."""
    if kind == TRAJECTORY:
        for point in message.points:
            values = _by_name("command", message.joint_names, point.positions)
            yield _nanoseconds(point.time_from_start), values
    elif kind == CONTROLLER:
        yield 0, _controller(message, measured=topic in roles.state)
    elif kind in MOTOR_COMMANDS:
        yield 0, _motors(message.motor_cmd, {"q": "command", "dq": "command_velocity", "tau": "command_effort"})
    elif kind in MOTOR_STATES:
        yield 0, {**_motors(message.motor_state, _MOTOR_STATE), **_motor_imu(message.imu_state)}
    elif kind in ARRAYS and topic in roles.command:
        yield 0, _by_name("command", _order(topic, len(message.data), rule), message.data)
    elif kind == JOINT_STATE and topic in roles.command:
        yield 0, _by_name("command", message.name, message.position)
    elif kind == JOINT_STATE:
        yield (
            0,
            {
                **_by_name("position", message.name, message.position),
                **_by_name("velocity", message.name, message.velocity),
                **_by_name("effort", message.name, message.effort),
            },
        )
    elif kind == IMU:
        yield 0, _imu(message)
    else:
        yield 0, {"": float(message.data)}


_MOTOR_STATE: Mapping[str, str] = {"q": "position", "dq": "velocity", "tau_est": "effort"}


def _motors(motors: Sequence[Any], fields: Mapping[str, str]) -> Values:
    """Values of motors by their numbers."""
    return {
        f"{channel}.{number}": _number(getattr(motor, name))
        for number, motor in enumerate(motors)
        for name, channel in fields.items()
    }


def _motor_imu(imu: Any) -> Values:
    rates = {f"imu.gyro_{axis}": _number(v) for axis, v in zip("xyz", imu.gyroscope, strict=True)}
    forces = {f"imu.acc_{axis}": _number(v) for axis, v in zip("xyz", imu.accelerometer, strict=True)}
    angles = {f"imu.angle_{axis}": _number(v) for axis, v in zip("xy", imu.rpy[:2], strict=True)}
    return {**rates, **forces, **angles}


def _controller(message: Any, measured: bool) -> Values:
    """What a controller sends on, and what it measures; called `desired` and `actual` before ROS 2 Humble."""
    names = message.joint_names
    sent, seen = _point(message, "reference", "desired"), _point(message, "feedback", "actual")
    values = dict(_by_name("command", names, getattr(sent, "positions", ())))
    if measured and seen is not None:
        fields = {"position": seen.positions, "velocity": seen.velocities, "effort": seen.effort}
        values |= {k: v for channel, numbers in fields.items() for k, v in _by_name(channel, names, numbers).items()}
    return values


def _point(message: Any, *names: str) -> Any:
    """The first of these fields that holds positions; None if none does."""
    points = (getattr(message, name, None) for name in names)
    return next((point for point in points if point is not None and len(point.positions)), None)


def _by_name(channel: str, names: Sequence[str], values: Sequence[float]) -> Values:
    """Values of a channel; none where the message leaves it out."""
    if len(values) != len(names):
        return {}
    return {f"{channel}.{name}": _number(v) for name, v in zip(names, values, strict=True)}


def _number(value: float | None) -> float:
    """JSON has no NaN and says null."""
    return math.nan if value is None else float(value)


def _order(topic: str, count: int, rule: RosRule) -> Sequence[str]:
    names = rule.order(topic)
    if names is None:
        raise LogError(
            f"{topic} holds {count} numbers without names: name them in a mapping file (--map FILE): "
            f'[ros] joints = ["..", ..] with {count} names, in their order'
        )
    if len(names) != count:
        raise LogError(f"{topic} holds {count} numbers, [ros] joints names {len(names)}: {', '.join(names)}")
    return names


def _imu(message: Any) -> Values:
    found: dict[str, float] = {}
    for name, field_ in (("gyro", "angular_velocity"), ("acc", "linear_acceleration")):
        vector = getattr(message, field_, None)
        if vector is not None and not _left_out(message, f"{field_}_covariance"):
            found |= {f"imu.{name}_{axis}": _number(getattr(vector, axis)) for axis in "xyz"}
    q = getattr(message, "orientation", None)
    if q is None or _left_out(message, "orientation_covariance"):
        return found
    if abs(math.sqrt(q.x**2 + q.y**2 + q.z**2 + q.w**2) - 1) < 0.01:
        roll = math.atan2(2 * (q.w * q.x + q.y * q.z), 1 - 2 * (q.x**2 + q.y**2))
        pitch = math.asin(max(-1.0, min(1.0, 2 * (q.w * q.y - q.z * q.x))))
        found |= {"imu.angle_x": roll, "imu.angle_y": pitch}
    return found


def _left_out(message: Any, covariance: str) -> bool:
    """By the definition of sensor_msgs/Imu, a covariance that begins with -1 marks an estimate that is not made."""
    values: Sequence[float] = getattr(message, covariance, ())
    return len(values) > 0 and values[0] == -1


def _header(message: Any) -> int:
    """The header's stamp, ns; 0 if there is none."""
    header = getattr(message, "header", None)
    return 0 if header is None else _nanoseconds(header.stamp)


def _nanoseconds(stamp: Any) -> int:
    fine = next((getattr(stamp, n) for n in ("nanosec", "nsec", "nsecs") if hasattr(stamp, n)), 0)
    whole = next((getattr(stamp, n) for n in ("sec", "secs") if hasattr(stamp, n)), 0)
    return int(whole) * _BILLION + int(fine)


# --- clocks ---------------------------------------------------------------------------------------------------


def _clock_of(rows: Mapping[str, _Rows], roles: Roles, rule: RosRule) -> tuple[Mapping[str, bool], tuple[str, ...]]:
    """For each topic whether header stamps are used, and remarks. All topics must share one clock."""
    stamped = {
        t: bool(r.header) and min(r.header) > 0 and (len(r.header) < 2 or len(set(r.header)) > 1)
        for t, r in rows.items()
    }
    if rule.clock is not None:
        bare = [t for t in (*roles.state, *roles.command) if rule.clock == "header" and not stamped[t]]
        if bare:
            raise UsageError(f'[ros] clock = "header": no header stamps on {", ".join(bare)}')
        return {t: rule.clock == "header" and stamped[t] for t in rows}, ()
    if not all(stamped[t] for t in roles.state):
        said = f"{some([t for t in roles.state if not stamped[t]])}: no header stamps"
        return dict.fromkeys(rows, False), (f"{said}, so times of receipt are used for all topics",)
    bare = [t for t in (*roles.command, *roles.imu) if not stamped[t] and rows[t].values]
    if not bare and not any(not stamped[t] for t in roles.scalars):
        return stamped, ()
    lag = np.median(np.concatenate([np.subtract(rows[t].receive, rows[t].header) for t in roles.state]) / _BILLION)
    if abs(lag) > _SAME_CLOCK:
        said = f"header stamps and times of receipt differ by {lag:.3g} s, and {some(bare or roles.scalars)} has no"
        return dict.fromkeys(rows, False), (f"{said} header stamps, so times of receipt are used for all",)
    if not bare:
        return stamped, ()
    return stamped, (
        f"{some(bare)}: no header stamps, times of receipt are used "
        f"(joint states were received {1e3 * lag:.2g} ms after their stamps)",
    )


def _all_series(
    path: Path, rows: Mapping[str, _Rows], roles: Roles, use_header: Mapping[str, bool]
) -> tuple[list[Series], int, list[str]]:
    """One series for each column of each topic, in s since the first joint state, because a double holds no
    nanoseconds since 1970; the stamp (ns) of that; remarks.
    """
    found: list[Series] = []
    remarks: list[str] = []
    owner: dict[str, str] = {}
    conflicts: dict[tuple[str, str], list[str]] = {}
    ordered = {t: _in_order(path, t, rows[t], use_header[t]) for t in roles.all if rows[t].values}
    origin = min(int(ordered[topic][0][0]) for topic in roles.state)
    for topic, (stamps, values, said) in ordered.items():
        remarks += said
        for column in dict.fromkeys(name for v in values for name in v):
            if column and owner.setdefault(column, topic) != topic:
                conflicts.setdefault((owner[column], topic), []).append(column)
                continue
            at = np.array([i for i, v in enumerate(values) if column in v], dtype=np.int64)
            series = np.array([values[i][column] for i in at], dtype=np.float64)
            found.append(
                Series(
                    topic,
                    column,
                    (stamps[at] - origin) / _BILLION,
                    series,
                    held=topic in (*roles.command, *roles.scalars),
                )
            )
    if conflicts:
        listing = "; ".join(f"{a} and {b} both hold {some(c, 4)}" for (a, b), c in conflicts.items())
        key = "command" if any(c[0].startswith("command.") for c in conflicts.values()) else "state"
        raise LogError(f"{path}: {listing}; select by [ros] {key} = [..] in a mapping file (--map FILE)")
    return found, origin, remarks


def _in_order(path: Path, topic: str, rows: _Rows, header: bool) -> tuple[IntArray, list[Values], list[str]]:
    """Stamps (ns, strictly increasing) and values of a topic."""
    sent = np.array(rows.header if header else rows.receive, dtype=np.int64)
    remarks = []
    back = np.diff(sent)
    if len(back) and back.min() < -_RESET * _BILLION:
        worst = int(np.argmin(back))
        raise LogError(
            f"{path}: the stamps of {topic} jump back by {-back[worst] / _BILLION:.4g} s at message {worst + 1}: the "
            'clock was set while recording; cut the bag there, or use times of receipt by [ros] clock = "receive"'
        )
    stamps = sent + np.array(rows.ahead, dtype=np.int64)
    kept = np.flatnonzero(stamps < _superseded(sent)) if rows.interpolates else np.arange(len(sent))
    order = kept[np.argsort(stamps[kept], kind="stable")]
    if np.any(np.diff(order) < 0) and not rows.interpolates:
        remarks.append(f"{topic}: messages came out of order and were sorted by their stamps")
    stamps = stamps[order]
    last = np.append(np.diff(stamps) > 0, True)
    if not np.all(last) and not _complementary(rows, order, last):
        remarks.append(f"{topic}: {int(np.sum(~last))} messages repeat a stamp; the last of each is kept")
        order, stamps = order[last], stamps[last]
    elif not np.all(last):
        merged: dict[int, dict[str, float]] = {}
        for i, stamp in zip(order, stamps, strict=True):
            merged.setdefault(int(stamp), {}).update(rows.values[i])
        return np.array(list(merged), dtype=np.int64), list(merged.values()), remarks
    if rows.interpolates:
        remarks.append(
            f"{topic}: its points are taken as steps, but a controller interpolates between them; record what it sent "
            "to the servos (the controller's state topic) to have the true command"
        )
    return stamps, [rows.values[i] for i in order], remarks


def _superseded(sent: IntArray) -> IntArray:
    """When each point of a trajectory is replaced by the next trajectory, ns."""
    until = np.full(len(sent), np.iinfo(np.int64).max)
    begins = np.flatnonzero(np.diff(sent, prepend=sent[0] - 1))
    for begin, end in itertools.pairwise(begins):
        until[begin:end] = sent[end]
    return until


def _complementary(rows: _Rows, order: IntArray, last: BoolArray) -> bool:
    """Whether messages with one stamp speak of different joints, as several publishers on one topic do."""
    first = np.flatnonzero(~last)[0]
    a, b = rows.values[order[first]], rows.values[order[first + 1]]
    return not set(a) & set(b)


def _on_one_clock(
    path: Path, series: Sequence[Series], roles: Roles, meta: LogMeta, remarks: Sequence[str]
) -> Recording:
    positions = [s for s in series if s.column.startswith("position.")]
    commands = [s for s in series if s.column.startswith("command.")]
    if not positions or not commands:
        which = "joint states" if not positions else "commands"
        topics = roles.state if not positions else roles.command
        raise LogError(f"{path}: the {which} ({', '.join(topics)}) hold no positions")
    lead = max(positions, key=lambda s: len(s.time))
    begin = min(s.time[0] for s in commands)
    clock = lead.time[lead.time >= begin]
    said = [*remarks]
    if len(clock) == 0:
        raise LogError(f"{path}: the first command came after the last joint state; nothing to compare")
    if len(clock) < len(lead.time):
        waited = clock[0] - lead.time[0]
        said.append(f"{waited:.3g} s before the first command are left out: the joints' commands are unknown")
    said.append(f"rows are the {len(clock)} stamps of {lead.source}")
    other = {s.source for s in series if not s.held and not np.array_equal(s.time, lead.time)}
    if other:
        said.append(f"interpolated onto these stamps: {some(sorted(other))}")
    notes = ""
    period = float(np.median(np.diff(clock))) if len(clock) > 1 else 0.0
    late = float(np.nanmean([lateness(s, clock) for s in commands]))
    if late > 0.05 * period > 0:
        notes = (
            f"commands were sent between the joint states and are logged with the next, {1e3 * late:.2g} ms late on "
            "average; the servos appear faster than they are by that much"
        )
        said.append(notes)
    later = [s.column for s in commands if s.time[0] > begin + 2 * period]
    if later:
        said.append(f"start later than the first command and have no values until then: {some(later, 8)}")
    signals = tuple(Signal(f"{s.source} {s.column}", s.column, on_clock(s, clock), s.unit) for s in series if s.column)
    foreign = {s.source: on_clock(s, clock) for s in series if not s.column}
    return Recording(path, clock, signals, foreign, None, replace(meta, notes=notes), tuple(said))
