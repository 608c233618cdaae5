"""What the columns of a table may be, judged by their names; and a mapping file to begin with."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from sysid_btr.io.importers.names import suggestions
from sysid_btr.io.importers.table import Table
from sysid_btr.io.importers.units import SI, find, group_of
from sysid_btr.io.log import JOINT_CHANNELS, is_schema_column

_COMMAND = "command commanded cmd target goal desired des ref reference setpoint demand"
_MEASURED = "actual measured meas present now feedback fb"
_FILLING = "act state obs observed real sensor"
_QUANTITY: Mapping[str, str] = {
    "position": "position positions pos angle angles q theta encoder enc",
    "velocity": "velocity velocities vel speed dq qd qdot omega rate",
    "effort": "effort efforts torque trq tau",
    "current": "current cur curr amps",
    "voltage": "voltage volt volts",
    "temperature": "temperature temp",
    "duty": "duty pwm",
    "stiffness": "stiffness hardness",
    "enabled": "enabled enable",
}
_WORDS: Mapping[str, str] = {
    **dict.fromkeys(_COMMAND.split(), "command"),
    **dict.fromkeys(_MEASURED.split(), "measured"),
    **dict.fromkeys(_FILLING.split(), "filling"),
    **{word: channel for channel, words in _QUANTITY.items() for word in words.split()},
}
_PATHS = ("joint_states", "joint_state", "joints", "joint", "states", "robot", "motor", "motors")
_TIME = re.compile(r"(time|t|timestamp|time_?stamp|stamp|clock|secs?|seconds|elapsed(_time)?|__time)", re.I)
_IMU: Mapping[str, str] = {
    r"(gyro(scope)?|gyr|angular_?velocity|angvel|omega)[_./ ]?([xyz])": "imu.gyro_",
    r"(acc(el(eration|erometer)?)?|linear_?acceleration)[_./ ]?([xyz])": "imu.acc_",
    r"(angle)[_./ ]?([xy])": "imu.angle_",
}
_TILT = {"roll": "imu.angle_x", "pitch": "imu.angle_y"}


@dataclass(frozen=True)
class Guess:
    """What the columns of a table are taken for.

    Attributes
    ----------
    time : the column of stamps, if one was found.
    columns : by the table's names -> column of the schema, joints by the table's own names.
    units : by the table's names -> unit that the name states; also of the time.
    certain : whether a format defines all this, so that none of it is a guess.
    """

    time: str | None
    columns: Mapping[str, str] = field(default_factory=dict)
    units: Mapping[str, str] = field(default_factory=dict)
    certain: bool = False

    def joints(self, channel: str) -> set[str]:
        """Names with a column in a channel."""
        return {
            name for kind, _, name in (column.partition(".") for column in self.columns.values()) if kind == channel
        }


def guess(names: Sequence[str]) -> Guess:
    """Take names of columns for what they say; only where they say it plainly, and no two say the same."""
    found: dict[str, str] = {}
    units: dict[str, str] = {}
    times: list[str] = []
    for name in names:
        bare, unit = _without_unit(name)
        if _TIME.fullmatch(bare) and (unit is None or any(u.si == "s" for u in find(unit))):
            times.append(name)
            if unit is not None:
                units[name] = unit
            continue
        column = bare if is_schema_column(bare) else (_imu(bare) or _joint_column(bare))
        if column is None:
            continue
        if unit is not None:
            if not any(u.si in SI[group_of(column)] for u in find(unit)):
                continue
            units[name] = unit
        found[name] = column
    taken = list(found.values())
    single = {name: column for name, column in found.items() if taken.count(column) == 1}
    return Guess(times[0] if times else None, single, units)


def _without_unit(name: str) -> tuple[str, str | None]:
    """A name and the unit that it ends with: ``pos [deg]``, ``pos_deg``, ``time_ms``, ``temperature (C)``."""
    name = name.strip()
    if name.endswith(("]", ")")):
        at = max(name.rfind("["), name.rfind("("), 0)
        bare, unit = name[:at].strip(), name[at + 1 : -1].strip()
        if bare and find(unit):
            return bare, unit
    tail = re.fullmatch(r"(.+?)[_ .]([A-Za-z]{2,4})", name)
    if tail and find(tail[2]) and tail[2].casefold() not in _WORDS:
        return tail[1], tail[2]
    short = re.fullmatch(r"(t|time|timestamp|stamp)[_ ]?(s|ms|us|ns)", name, re.I)
    return (short[1], short[2]) if short else (name, None)


def _imu(name: str) -> str | None:
    bare = re.sub(r"^/?(imu|torso|body|base)[_./ ]+", "", name.strip(), flags=re.I)
    if bare.casefold() in _TILT and bare != name:
        return _TILT[bare.casefold()]
    for pattern, column in _IMU.items():
        match = re.fullmatch(pattern, bare, re.I)
        if match:
            return column + match.groups()[-1].casefold()
    return None


def _joint_column(name: str) -> str | None:
    """``<channel>.<joint>`` that a name stands for, if it says both."""
    name = re.sub(r"\[\s*(\w+)\s*\]", r"/\1/", name)
    parts = [p for p in re.split(r"[/.]", name) if p and p.casefold() not in _PATHS]
    words: list[str] = []
    rest: list[str] = []
    for part in parts:
        taken, joint = _strip_words(part)
        words += taken
        rest += [joint] if joint else []
    if len(rest) > 1:
        rest = [joint for joint in rest if joint.casefold() not in _PATHS]
    channel = _channel(words)
    if channel is None or len(rest) != 1 or (channel != "command" and _speaks_of_commands(rest[0])):
        return None
    return f"{channel}.{rest[0]}"


def _speaks_of_commands(joint: str) -> bool:
    """Whether a word for a command stands inside a name: ``motor_cmd_0_q`` is no measurement."""
    return any(_WORDS.get(word.casefold()) == "command" for word in re.split(r"[_\- ]+", joint))


def _strip_words(text: str) -> tuple[list[str], str]:
    """Words of the table above at both ends of a name, and what is left."""
    words: list[str] = []
    while text:
        for stripped, word in _ends(text):
            kind = _WORDS.get(word.casefold())
            if kind is not None:
                words.append(kind)
                text = stripped
                break
        else:
            break
    return words, text


def _ends(text: str) -> Iterator[tuple[str, str]]:
    """Ways to part a name into a rest and a word at its end, its beginning, or the whole."""
    yield "", text
    for pattern in (
        r"(?P<rest>.+)[_\- ]+(?P<word>[A-Za-z]+)",
        r"(?P<word>[A-Za-z]+)[_\- ]+(?P<rest>.+)",
        r"(?P<rest>.*[a-z0-9])(?P<word>[A-Z][a-z]+)",
        r"(?P<word>[a-z]+)(?P<rest>[A-Z].*)",
        r"(?P<word>[A-Za-z]+)(?P<rest>\d+)",
    ):
        match = re.fullmatch(pattern, text)
        if match:
            yield match["rest"], match["word"]


def _channel(words: Sequence[str]) -> str | None:
    kinds = set(words) - {"measured", "filling"}
    if "current" in kinds and kinds & {"position", "velocity"}:
        kinds.remove("current")  # in the sense of "now"
    if kinds in ({"command"}, {"command", "position"}):
        return "command"
    if "command" in kinds or len(kinds) > 1:
        return None
    if not kinds:
        return "position" if "measured" in words else None
    return kinds.pop()


# --- a mapping file to begin with ---------------------------------------------------------------------------


def proposal(path: Path, table: Table, found: Guess, joints: Sequence[str] | None = None) -> str:
    """A mapping file (TOML) for a table that could not be understood: what is known filled in, the rest listed.

    Parameters
    ----------
    path : of the table.
    table : its columns.
    found : what could be guessed.
    joints : names of the model's joints, if there is one.
    """
    names = list(table.columns)
    time = found.time or _advancing(table)
    rest = [name for name in names if name not in found.columns and name != time]
    lines = [
        f"# Mapping of the columns of {path.name}. Fill in what is missing, then:",
        f"#   sysid-btr import {path.name} --map FILE --out {path.stem}.parquet",
        "",
        "[time]",
        f"column = {_text(time)}" if time else '# column = "?"        # which column holds the time?',
        "# rate = 100        # Hz, instead, if no column holds the time",
        "",
        "[units]              # everything else is in SI: s, rad, rad/s, Nm, A, V, degC, N",
        f"{'' if time and found.time in found.units else '# '}time = {_text(found.units.get(found.time or '', 'ms'))}",
        '# position = "deg"',
        '# command = "deg"',
        "",
        "[meta]",
        'mount = "fixed"      # "free" for a floating base',
        "",
        "# Shorter, by patterns; {joint} stands for the joint's name:",
        "# [channels]",
        '# command = "{joint}_cmd"',
        '# position = "{joint}_pos"',
        "",
        f"# Channels of a joint: {', '.join(JOINT_CHANNELS)}.",
        "# Also: imu.gyro_x, imu.acc_x, imu.angle_x (and y, z), force.<site>.",
        "# Columns that are not listed are kept under their own name, and not used.",
        "[columns]",
        *(f"{_text(name)} = {_text(column)}" for name, column in found.columns.items()),
        *(f"# {_text(name)} = {_text(_hint(name))}   # {_sample(table, name)}" for name in rest),
        "",
        "[joints]             # name in the file = name in the model",
    ]
    own = sorted({c.partition(".")[2] for c in found.columns.values() if group_of(c) in JOINT_CHANNELS})
    meant = suggestions(own, joints) if joints else {}
    lines += [f"{_text(name)} = {_text(meant[name])}" for name in own if name in meant]
    if joints:
        lines.append(f"# the model's joints: {', '.join(joints)}")
    else:
        lines += [f"# {_text(name)} = {_text(name)}" for name in own[:3]]
    return "\n".join(lines) + "\n"


def _advancing(table: Table) -> str | None:
    """The first column that only grows."""
    for name, values in table.columns.items():
        if values.dtype.kind in "iuf" and len(values) > 2 and bool(np.all(np.diff(values) > 0)):
            return name
    return None


def _hint(name: str) -> str:
    words, joint = _strip_words(name)
    return f"{_channel(words) or 'position'}.{joint or name}"


def _sample(table: Table, name: str) -> str:
    values = table.columns[name][:3]
    return ", ".join(f"{v:.6g}" if isinstance(v, float | np.floating) else str(v)[:20] for v in values)


def _text(text: str) -> str:
    """A TOML string; JSON has the same escapes, but for DEL."""
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")
