"""Where joints stand that a log does not measure: as told, as the log's metadata say, or as in the model's keyframe."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from sysid_btr._typing import FloatArray
from sysid_btr.errors import ModelError
from sysid_btr.io._text import some
from sysid_btr.io.log import Log, with_hint
from sysid_btr.models.robot import KEYFRAME, Position, Robot, joint_names


def resting(robot: Robot, log: Log, joints: Sequence[str]) -> FloatArray:
    """Positions (j,) of joints where the log does not say them, see `standing`; zero for one that the model lacks."""
    at = standing(robot, log)
    return np.array([at.get(joint, 0.0) for joint in joints])


def standing(robot: Robot, log: Log) -> dict[str, float]:
    """Position of every hinge and slide, rad or m, where the log does not say it.

    The first keyframe of the model, or its zero; over that what the log's metadata say; over that `Robot.at`.

    Raises
    ------
    ModelError
        A joint or a keyframe that the model does not have.
    """
    model, joints = robot.model, joint_names(robot)

    def pose(qpos: FloatArray) -> dict[str, float]:
        return {joint: float(qpos[model.joint(joint).qposadr[0]]) for joint in joints}

    found = pose(model.key_qpos[0] if model.nkey else model.qpos0)
    keys = {model.key(k).name: k for k in range(model.nkey)}
    for origin, entry in (*_told(log), *(("--at", entry) for entry in robot.at)):
        if isinstance(entry, str):
            key = keys.get(entry.removeprefix(KEYFRAME))
            if key is None:
                raise ModelError(f"{origin}: the model has no {entry}; its keyframes: {some(keys) or 'none'}")
            found.update(pose(model.key_qpos[key]))
            continue
        joint, value = entry
        if joint not in found:
            raise ModelError(
                f"{origin}: the model has no joint {with_hint(joint, joints)}; its joints: {some(joints, 12)}"
            )
        found[joint] = value
    return found


def _told(log: Log) -> Iterator[tuple[str, Position]]:
    at, origin = log.meta.at, f'{log.path or "the log"}, metadata "at"'
    if isinstance(at, Mapping):
        for joint, value in at.items():
            yield origin, (joint, float(value))
    elif at:
        yield origin, at
