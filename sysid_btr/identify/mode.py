"""How a log is compared with a model: replayed whole, by segments, or its motion's torques compared.

The kind of episode that a log becomes, by the user's choice or by what the log holds.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from importlib import import_module
from typing import Any

import numpy as np

from sysid_btr.errors import UsageError
from sysid_btr.identify.episode import Episode
from sysid_btr.io.log import Log
from sysid_btr.models.commands import FED_FORWARD
from sysid_btr.models.robot import Robot, joint_names

AUTO = "auto"
KINDS = {
    "forward": "sysid_btr.identify.episode:FixedEpisode",
    "inverse": "sysid_btr.identify.inverse:InverseEpisode",
    "floating": "sysid_btr.floating_base.episode:FloatingEpisode",
}
"""Mode -> its kind of episode, by name: floating bases are a wing above this one."""
MODES = (AUTO, "forward", "inverse")
"""What can be asked for; a floating base has a mode of its own."""


@dataclass(frozen=True)
class Mode:
    """How logs are to be compared with a model.

    Attributes
    ----------
    name : one of `MODES`.

    Raises
    ------
    UsageError
        If there is no such mode.
    """

    name: str = AUTO

    def __post_init__(self) -> None:
        if self.name not in MODES:
            raise UsageError(f"--mode {self.name}: choose one of {', '.join(MODES)}")


AUTOMATIC = Mode()
"""By what the log holds."""


def episode_of(robot: Robot, log: Log, mode: Mode, threads: int = 0) -> Episode:
    """All of a recording as an episode.

    Raises
    ------
    UsageError
        If the log does not suit the mode.
    """
    name, why = _resolve(robot, log, mode)
    whole: Episode = _kind(name).whole(robot, log, threads)
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
    name, why = _resolve(robot, log, mode)
    fitted, held = _kind(name).split(robot, log, holdout, threads)
    return replace(fitted, why=why), replace(held, why=why)


def _resolve(robot: Robot, log: Log, mode: Mode) -> tuple[str, str]:
    """The mode of one log, and why."""
    if log.meta.mount == "free":
        if mode.name not in (AUTO, "forward"):
            raise UsageError(
                f"--mode {mode.name}: {log.path or 'the log'} is of a floating base, which is replayed by segments of "
                "its own"
            )
        return "floating", "its base floats"
    if mode.name != AUTO:
        return mode.name, "as asked for"
    joints = joint_names(robot)
    if not _commanded(log) and any(log.has("effort", j) for j in joints):
        return "inverse", "no command is logged"
    return "forward", ""


def _commanded(log: Log) -> bool:
    """Whether anything was commanded, at a joint or an actuator."""
    return any(
        name.partition(".")[0] in ("command", *FED_FORWARD) and bool(np.isfinite(values).any())
        for name, values in log.channels.items()
    )


def _kind(mode: str) -> Any:
    module, _, name = KINDS[mode].partition(":")
    return getattr(import_module(module), name)
