"""Which columns a log has, and which it should have."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from sysid_btr.io._text import mirrored, some
from sysid_btr.io.log import CHANNELS, COMMANDS, IMU_NAMES, JOINT_CHANNELS, Log, closest
from sysid_btr.io.problem import Problem

MOVERS = (*COMMANDS[1:], "effort", "current")
"""Channels that say what moved a joint where no command does."""


def check_columns(
    log: Log,
    joints: Sequence[str] | None,
    drives: Mapping[str, str] | None = None,
    controls: Sequence[str] = (),
    at: Mapping[str, float] | None = None,
) -> Iterator[Problem]:
    """Names of columns: misspelled, of no channel, without their partner, missing or unknown to the model.

    `drives` has the joints that the model drives, where it is known, `controls` its actuators of other things, and `at`
    where joints start that are not logged.
    """
    misspelled = _misspelled(log, joints or ())
    for column, meant in misspelled.items():
        yield Problem(
            "column.misspelled",
            "error",
            column,
            f"the schema has no such column and the log has no {meant}: did you mean {meant}?",
            f"rename {column} to {meant}; if it is something else, choose a name that differs more",
        )
    yield from _strange_channels(log, misspelled)
    yield from _pairs(log, misspelled, drives, controls)
    if joints is not None:
        yield from _against_model(log, joints, misspelled, controls, at or {})


def log_joints(log: Log) -> tuple[str, ...]:
    """Names with a column in any joint channel, in column order."""
    return tuple(dict.fromkeys(name for channel in JOINT_CHANNELS for name in log.joints(channel)))


def _misspelled(log: Log, joints: Sequence[str]) -> dict[str, str]:
    """Columns not of the schema that look like one that is missing."""
    names = dict.fromkeys((*log_joints(log), *joints))
    expected = [f"{channel}.{name}" for channel in JOINT_CHANNELS for name in names]
    expected += [f"imu.{name}" for name in IMU_NAMES]
    expected += [f"force.{name}" for name in log.joints("force")]
    expected = [column for column in expected if column not in log.channels and column not in log.unknown]
    found: dict[str, str] = {}
    for column in log.unknown:
        channel, dot, name = column.partition(".")
        guess = None
        if dot and (meant := closest(channel, CHANNELS)):
            # The channel is nearly right: with it put right, is the name one that is known?
            known = IMU_NAMES if meant == "imu" else tuple(names)
            same = closest(name, known, cutoff=0.85)
            guess = f"{meant}.{same or name}"
            if guess in log.channels or guess in log.unknown:
                guess = None
        if guess is None and not dot:
            guess = closest(column.replace("/", ".", 1), expected, cutoff=0.9)
        if guess is not None and guess != column and not _other_side(column, guess):
            found[column] = guess
    return found


def _other_side(a: str, b: str) -> bool:
    return mirrored(a.partition(".")[2], b.partition(".")[2])


def _strange_channels(log: Log, misspelled: dict[str, str]) -> Iterator[Problem]:
    names = set(log_joints(log))
    strange: dict[str, list[str]] = {}
    for column in log.unknown:
        channel, _, name = column.partition(".")
        if name in names and channel not in CHANNELS and column not in misspelled:
            strange.setdefault(channel, []).append(name)
    for channel, owners in strange.items():
        guess = closest(channel, CHANNELS, cutoff=0.6)
        hint = f"; did you mean `{guess}`?" if guess else ""
        yield Problem(
            "column.unknown_channel",
            "warning",
            f"{channel}.* of {some(owners)}",
            f"`{channel}` is not a channel of the schema, so it is kept but not used{hint}",
            f"if it should be used, rename it to one of {', '.join(CHANNELS)}",
        )


def _pairs(
    log: Log, misspelled: dict[str, str], drives: Mapping[str, str] | None, controls: Sequence[str]
) -> Iterator[Problem]:
    meant = set(misspelled.values())
    commands = dict.fromkeys((*log.joints("command"), *_names_of(meant, "command")))
    positions = dict.fromkeys((*log.joints("position"), *_names_of(meant, "position")))
    if log.is_motion and commands and not positions:
        yield Problem(
            "motion.not_recorded",
            "warning",
            "the whole file",
            "this is an excitation trajectory, not a recording: it holds only commands, and nothing can be fitted to "
            "it",
            "execute it on the robot, record the sensors, and give that log; how a model moves with it: "
            "`sysid-btr replay --model M --log FILE --out DIR`",
        )
        return
    torques = dict.fromkeys((*(j for c in MOVERS for j in log.joints(c)), *_names_of(meant, "effort")))
    switches = [log.channels[f"enabled.{joint}"] for joint in log.joints("enabled")]
    moved = bool(torques) or log.meta.drive == "none" or (bool(switches) and not np.any(switches))
    for channel, names, purpose in (
        ("command", commands or moved, "nothing says what the joints were commanded to do, or what torques they had"),
        ("position", positions, "without it a replay cannot be compared with anything"),
    ):
        if not names:
            yield Problem(
                f"{channel}.missing",
                "error",
                f"{channel}.*",
                f"the log has no {channel} column at all: {purpose}",
                f"add `{channel}.<joint>` for each joint; the columns there are: {some(_all_columns(log), 12)}",
            )
    yield from _instead_of_commands(log, bool(torques) and not commands)
    if not commands or not positions:
        return
    only_command = [name for name in commands if name not in positions and name not in controls]
    unknown = [name for name in positions if name not in commands and name not in torques]
    only_position = [name for name in unknown if drives is None or name in drives]
    for name in list(only_position):
        twin = closest(name, only_command, cutoff=0.8)
        if twin is not None and not mirrored(name, twin):
            only_position.remove(name)
            only_command.remove(twin)
            yield Problem(
                "joint.misspelled",
                "error",
                f"command.{twin}, position.{name}",
                f"{twin} has a command but no position, {name} a position but no command: one joint, two spellings?",
                "give both columns the joint's name in the model",
            )
    if only_command:
        yield Problem(
            "position.missing",
            "warning",
            some(only_command),
            "these joints have a command but no position: they can be driven but not compared",
            f"add {some([f'position.{name}' for name in only_command], 3)} if it was measured",
        )
    if only_position:
        yield Problem(
            "command.missing",
            "warning",
            some(only_position),
            "these joints have a position but no command: what drove them is unknown",
            f"add {some([f'command.{name}' for name in only_position], 3)}, unless the joints are passive",
        )


def _instead_of_commands(log: Log, torques_alone: bool) -> Iterator[Problem]:
    """What is read in the place of commands, and of efforts."""
    if torques_alone:
        yield Problem(
            "command.none",
            "note",
            "command.*",
            "no command is logged: the measured torques are compared with those that the measured motion takes, or, "
            "where something swings by its weight, drive the model",
            "nothing, if none was recorded; what limits, delays or gains of servos do cannot be found without it",
        )
    currents = [] if log.meta.torque_constant is None else [j for j in log.joints("current") if log.has("effort", j)]
    if currents:
        yield Problem(
            "current.torque",
            "note",
            some([f"current.{joint}" for joint in currents]),
            "the metadata state a torque constant: where no effort was logged, current times that constant is one",
            "nothing, if that is right",
        )


def _names_of(columns: set[str], channel: str) -> list[str]:
    return [column.partition(".")[2] for column in sorted(columns) if column.startswith(f"{channel}.")]


def _all_columns(log: Log) -> list[str]:
    return [*log.channels, *log.unknown] or ["none"]


def _against_model(
    log: Log, joints: Sequence[str], misspelled: dict[str, str], controls: Sequence[str], at: Mapping[str, float]
) -> Iterator[Problem]:
    there = log_joints(log)
    meant = {column.partition(".")[2] for column in misspelled.values()}
    usable = {*log.joints("command"), *log.joints("position"), *meant}
    missing = [name for name in joints if name not in usable]
    unknown = [name for name in there if name not in joints and name not in controls]
    for name in list(unknown):
        guess = closest(name, missing, cutoff=0.8)
        if guess is not None and not mirrored(name, guess):
            unknown.remove(name)
            missing.remove(guess)
            yield Problem(
                "joint.misspelled",
                "error",
                f"joint {name}",
                f"the model has no joint {name}, and the log has nothing for {guess}: did you mean {guess}?",
                f"rename the columns of {name} to {guess}; joints are matched by name, exactly",
            )
    if missing and len(missing) == len(joints):
        yield Problem(
            "joint.missing",
            "error",
            some(missing),
            "the log has neither command nor position for any joint of the model; "
            f"its joints: {some(there, 12) or 'none'}",
            "give the model of this robot, or rename the columns",
        )
    elif missing:
        yield Problem(
            "joint.unlogged",
            "note",
            some(f"{name} at {at[name]:.4g}" if name in at else name for name in missing),
            "these joints of the model are not logged: they start where the keyframe, --at or the metadata say, at "
            "zero otherwise, and move with what couples them to others",
            "nothing, if they are passive, coupled or idle; else log them too",
        )
    if unknown:
        yield Problem(
            "joint.unknown",
            "warning",
            some(unknown),
            "the log has joints that the model does not have; they are ignored. Joints of the model: "
            f"{some(joints, 12)}",
            "nothing, if they are irrelevant (fingers, say); else use a model that has them",
        )
