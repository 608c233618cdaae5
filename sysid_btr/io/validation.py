"""Everything that is wrong with a log, in one pass, with where it is and what to do about it."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from sysid_btr.io._check_clock import check_clock
from sysid_btr.io._check_columns import check_columns
from sysid_btr.io._check_motion import check_motion
from sysid_btr.io._check_signal import check_signal
from sysid_btr.io._check_units import check_declared_units, check_scale
from sysid_btr.io._check_values import check_noise, check_values, plausible
from sysid_btr.io._file import load
from sysid_btr.io._tracking import command_kinds, trackings
from sysid_btr.io.log import Log
from sysid_btr.io.problem import Problem, worst_first

__all__ = ["Problem", "validate_file", "validate_log"]


def validate_log(
    log: Log,
    *,
    joints: Sequence[str] | None = None,
    ranges: Mapping[str, tuple[float, float]] | None = None,
    drives: Mapping[str, str] | None = None,
    controls: Sequence[str] = (),
    at: Mapping[str, float] | None = None,
) -> tuple[Problem, ...]:
    """Problems of a log's content.

    An irregular clock, a clock of any origin, short dropouts and several episodes are no errors. Time must
    increase strictly within an episode; from one episode to the next the clock may jump or restart.

    Parameters
    ----------
    log : Log
        The log, as read.
    joints : sequence of str, optional
        Joints of the model: the log must have them, and those it has besides are pointed out.
    ranges : mapping of str to (low, high), optional
        Range of each joint where known, rad or m.
    drives : mapping of str to {"position", "velocity", "torque"}, optional
        What a command of a joint is to the model; without it, what the log's metadata say, else a position.
    controls : sequence of str
        Actuators of the model that are commanded by their own name.
    at : mapping of str to float, optional
        Where joints of the model start that are not logged, rad or m.

    Returns
    -------
    tuple of Problem
        Errors first; empty for a good log. Problems of one kind in many columns are one entry.
    """
    if len(log) == 0:
        return (Problem("log.empty", "error", "time", "the log has no samples", "record some seconds of motion"),)
    motion = plausible(log)
    kinds = command_kinds(log, drives or {})
    tracking = trackings(motion, [joint for joint, kind in kinds.items() if kind == "position"])
    found = [
        *check_columns(log, joints, drives, controls, at),
        *check_clock(log),
        *check_values(log),
        *check_noise(motion),
        *check_declared_units(log),
        *check_scale(motion, tracking, ranges, kinds),
        *check_motion(motion, tracking, kinds),
        *check_signal(motion, tracking),
    ]
    return worst_first(found)


def validate_file(
    path: str | os.PathLike[str],
    *,
    joints: Sequence[str] | None = None,
    ranges: Mapping[str, tuple[float, float]] | None = None,
    check: Callable[[Log], Sequence[Problem]] | None = None,
) -> tuple[Problem, ...]:
    """Problems of a log file: those of the file and, as far as it can be read, those of its content.

    Parameters
    ----------
    path : path-like
        The file; one that is missing or unreadable is a problem too, never an exception.
    joints, ranges
        As for `validate_log`.
    check : callable, optional
        Finds the problems of its content in the place of `validate_log`, as one that knows the model does.

    Returns
    -------
    tuple of Problem
        Errors first; empty for a good log.
    """
    log, problems = load(Path(path))
    if log is not None:
        problems += tuple(check(log) if check else validate_log(log, joints=joints, ranges=ranges))
    return worst_first(problems)
