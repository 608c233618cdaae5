"""How a log is compared with a model: replayed whole, by segments, or its motion's torques compared.

The kind of episode that a log becomes, by the user's choice or by what the log holds.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from importlib import import_module
from typing import Any

import numpy as np

from sysid_btr.errors import UsageError
from sysid_btr.identify.driving import measured_torques
from sysid_btr.identify.episode import Episode
from sysid_btr.identify.horizon import is_held
from sysid_btr.identify.inverse import InverseEpisode
from sysid_btr.identify.segmented import follow
from sysid_btr.io.log import COMMANDS, Log
from sysid_btr.models.commands import drives_nothing
from sysid_btr.models.robot import Robot, joint_names

GIVEN = "driven by the measured torques, with which the plain model moves more like the log than with those commanded"
STANDS = "the plain model keeps standing as the robot does, and errors of its start die out"
FALLS = "its base floats, and the plain model does not keep standing, as the robot must: no inertial unit is logged"
AUTO, WHOLE = "auto", "whole"
KINDS = {
    "forward": "sysid_btr.identify.episode:FixedEpisode",
    "segments": "sysid_btr.identify.segmented:SegmentedEpisode",
    "inverse": "sysid_btr.identify.inverse:InverseEpisode",
    "standing": "sysid_btr.floating_base.standing:StandingEpisode",
    "floating": "sysid_btr.floating_base.episode:FloatingEpisode",
    "innovations": "sysid_btr.floating_base.innovations:InnovationsEpisode",
}
"""Mode -> its kind of episode, by name: floating bases are a wing above this one."""
MODES = (AUTO, "forward", "segments", "inverse", "innovations")
"""What can be asked for; segments of a floating base are a kind of their own."""


@dataclass(frozen=True)
class Mode:
    """How logs are to be compared with a model.

    Attributes
    ----------
    name : one of `MODES`.
    segments : ``whole`` for none, ``auto`` for what the log allows, or the length of one in s; of a fixed base.

    Raises
    ------
    UsageError
        If there is no such mode, or segments do not go with it.
    """

    name: str = AUTO
    segments: str = AUTO

    def __post_init__(self) -> None:
        if self.name not in MODES:
            raise UsageError(f"--mode {self.name}: choose one of {', '.join(MODES)}")
        if self.segments not in (AUTO, WHOLE) and not self.seconds > 0:
            raise UsageError(f"--segments {self.segments}: choose {WHOLE}, {AUTO}, or a length in s")
        if self.segments != AUTO and self.name not in (AUTO, "forward" if self.segments == WHOLE else "segments"):
            raise UsageError(f"--segments {self.segments} does not go with --mode {self.name}")

    @property
    def seconds(self) -> float:
        """Length of a segment that is asked for, s; NaN where none is."""
        try:
            return float(self.segments)
        except ValueError:
            return float("nan")

    @property
    def asked(self) -> str:
        """The mode, where segments say it."""
        if self.segments == AUTO:
            return self.name
        return "forward" if self.segments == WHOLE else "segments"


AUTOMATIC = Mode()
"""By what the log holds."""


def episode_of(robot: Robot, log: Log, mode: Mode, threads: int = 0) -> Episode:
    """All of a recording as an episode.

    Raises
    ------
    UsageError
        If the log does not suit the mode.
    """
    name, why, log = _resolved(robot, log, mode, threads)
    whole: Episode = _kind(name).whole(robot, log, threads, **_length(name, mode))
    return replace(whole, why=why)


def split_episode(robot: Robot, log: Log, holdout: float, mode: Mode, threads: int = 0) -> tuple[Episode, Episode]:
    """A recording whose last fraction is held out: what is fitted, and what is held out.

    Raises
    ------
    UsageError
        If the held-out fraction is not between 0 and 1, or the log does not suit the mode.
    LogError
        If a part would be too short, or the base cannot be reconstructed.
    """
    name, why, log = _resolved(robot, log, mode, threads)
    fitted, held = _kind(name).split(robot, log, holdout, threads, **_length(name, mode))
    return replace(fitted, why=why), replace(held, why=why)


def _length(name: str, mode: Mode) -> dict[str, float]:
    """The length of segments that is asked for, where it is."""
    return {"seconds": mode.seconds} if name == "segments" and mode.seconds > 0 else {}


def _resolved(robot: Robot, log: Log, mode: Mode, threads: int) -> tuple[str, str, Log]:
    """The mode of one log, why, and the log with what moves its drives."""
    name, why = _resolve(robot, log, mode, threads)
    given = measured_torques(robot, log, threads) if name in ("forward", "segments") else None
    if given is None:
        return name, why, log
    return name, "; ".join(filter(None, (why, GIVEN))), given


def _resolve(robot: Robot, log: Log, mode: Mode, threads: int) -> tuple[str, str]:
    """The mode of one log, and why."""
    if log.meta.mount == "free":
        return _of_floating(robot, log, mode, threads)
    if mode.asked != AUTO:
        return mode.asked, "as asked for"
    joints = joint_names(robot)
    if not _commanded(log) and any(log.has("effort", j) for j in joints):
        swinging = log.once(("swinging", robot.fingerprint, robot.at), lambda: _swinging(robot, log, threads))
        if not swinging:
            return "inverse", "no command is logged"
        less = f"at {', '.join(swinging)} they are less than the inertia takes, too little to be compared"
        return "segments", f"no command is logged; the measured torques drive: {less}"
    if is_held(robot, log):
        return "forward", ""
    return "segments", f"open loop, the plain model can be followed for {follow(robot, log, threads):.2g} s"


def _swinging(robot: Robot, log: Log, threads: int) -> tuple[str, ...]:
    """Joints whose measured torque is too little to be compared, where every drive can give what was measured."""
    if not drives_nothing(log, robot.for_log(log).model):
        return ()
    return InverseEpisode.whole(robot, log, threads).swinging(threads)


def _of_floating(robot: Robot, log: Log, mode: Mode, threads: int) -> tuple[str, str]:
    """The mode of a log whose base floats, and why."""
    suited = _kind("innovations").suits(robot, log)
    if mode.asked == "innovations" and not suited:
        raise UsageError(
            f"--mode innovations cannot be used with {log.path or 'the log'}: it needs an inertial unit, samples at "
            "equal intervals and drives without memory. Compare it by segments: --mode segments"
        )
    if mode.asked == "innovations":
        return "innovations", "as asked for"
    if mode.asked == AUTO and suited:
        return "innovations", "its base floats"
    if mode.asked in (AUTO, "forward") and not log.joints("imu") and _kind("standing").suits(robot, log, threads):
        return "standing", STANDS
    if mode.asked == AUTO:
        return "floating", "its base floats" if log.joints("imu") else FALLS
    if mode.asked == "forward" or (mode.asked == "segments" and not mode.seconds > 0):
        return "floating", "as asked for"
    raise UsageError(
        f"--mode {mode.asked}{f', --segments {mode.segments}' if mode.seconds > 0 else ''}: {log.path or 'the log'} is "
        "of a floating base: choose --mode innovations, which does not need the ground, or --mode segments, whose "
        "length it chooses itself"
    )


def _commanded(log: Log) -> bool:
    """Whether anything was commanded, at a joint or an actuator."""
    return any(
        name.partition(".")[0] in COMMANDS and bool(np.isfinite(values).any()) for name, values in log.channels.items()
    )


def _kind(mode: str) -> Any:
    module, _, name = KINDS[mode].partition(":")
    return getattr(import_module(module), name)
