"""What of a log commands which drive: its columns in units of the joints, whatever they were logged in."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import TYPE_CHECKING

from sysid_btr._typing import FloatArray
from sysid_btr.io.log import COMMANDS, Log
from sysid_btr.terms.drives import Drive, joint_drives, own_controls

if TYPE_CHECKING:
    import mujoco

MEASURED = "effort"
"""Channel that stands in for the command of a torque drive: what the motor gave is what it was asked for."""
FED_FORWARD = COMMANDS[1:]
"""Channels that are commanded beside a position, as in torque = kp (q* - q) + kd (v* - v) + tau*."""
OWN_CHANNEL = dict(zip(("position", "velocity", "torque"), COMMANDS, strict=True))
"""Kind of drive -> channel of the same meaning, for a log that says of each command what it is."""


def commanded(log: Log, model: mujoco.MjModel) -> Log:
    """The log with `command.<joint>` of every drive in units of its joint, and `command.<actuator>` of others in ctrl.

    A column of an actuator that drives a joint is that joint's, and so is, for a torque drive that nothing commands,
    its measured torque. What is fed forward stays in its own channels where it is beside a command.
    """
    given = log.channels
    channels = {name: values for name, values in given.items() if name.partition(".")[0] not in COMMANDS}
    for name in own_controls(model):
        if f"command.{name}" in given:
            channels[f"command.{name}"] = given[f"command.{name}"]
    for drive in joint_drives(model):
        column, used = _command(log, drive)
        if column is not None:
            channels[f"command.{drive.joint}"] = column
        for channel in FED_FORWARD:
            name = f"{channel}.{drive.joint}"
            if name in given and name != used:
                channels[name] = given[name]
    return replace(log, channels=channels)


def driven_by_effort(log: Log, model: mujoco.MjModel) -> frozenset[str]:
    """Joints whose measured torque stands in for a command."""
    return frozenset(d.joint for d in joint_drives(model) if _command(log, d)[1] == f"{MEASURED}.{d.joint}")


def as_measured(log: Log, model: mujoco.MjModel) -> Log:
    """The log without commands of torque drives whose torque was measured, which then stands in for them."""
    dropped: set[str] = set()
    for drive in joint_drives(model):
        if drive.kind == "torque" and log.meta.drive != "none" and log.has(MEASURED, drive.joint):
            dropped |= {*command_columns(log, drive), f"{OWN_CHANNEL['torque']}.{drive.joint}"}
    return replace(log, channels={name: values for name, values in log.channels.items() if name not in dropped})


def drives_nothing(log: Log, model: mujoco.MjModel) -> bool:
    """Whether the torque of every drive was measured and is given, so that no drive makes it of a command."""
    drives = joint_drives(model)
    return bool(drives) and not own_controls(model) and driven_by_effort(log, model) >= {d.joint for d in drives}


def command_columns(log: Log, drive: Drive) -> Iterator[str]:
    """Columns that command a drive: by its joint, by itself; more than one is one too many."""
    yield from (f"command.{name}" for name in dict.fromkeys((drive.joint, drive.name)) if log.has("command", name))


def _command(log: Log, drive: Drive) -> tuple[FloatArray | None, str]:
    """A drive's command in units of its joint, and the column it is from."""
    own = next(command_columns(log, drive), None)
    if own is not None:
        values = log.channels[own]
        in_ctrl = own != f"command.{drive.joint}" or log.meta.command_space == "ctrl"
        return values / drive.scale if in_ctrl else values, own
    stand_ins = [OWN_CHANNEL[drive.kind]]
    if drive.kind == "torque" and log.meta.drive != "none":
        stand_ins.append(MEASURED)
    name = next((f"{c}.{drive.joint}" for c in stand_ins if log.has(c, drive.joint)), None)
    return (None, "") if name is None else (log.channels[name], name)
