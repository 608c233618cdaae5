"""Where joints stand that a log does not measure: as told, as the log's metadata say, or as in the model's keyframe."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

from sysid_btr._typing import FloatArray
from sysid_btr.errors import ModelError
from sysid_btr.io._text import some
from sysid_btr.io.log import Log, with_hint
from sysid_btr.models.robot import Robot, joint_names

KEYFRAME = "keyframe:"
"""Begins the name of a pose of the model."""


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
    for origin, name, value in (*_told(log), *(("--at", *entry) for entry in robot.at)):
        if name.startswith(KEYFRAME):
            key = keys.get(name.removeprefix(KEYFRAME))
            if key is None:
                raise ModelError(f"{origin}: the model has no {name}; its keyframes: {some(keys) or 'none'}")
            found.update(pose(model.key_qpos[key]))
        elif name in found:
            found[name] = value
        else:
            raise ModelError(
                f"{origin}: the model has no joint {with_hint(name, joints)}; its joints: {some(joints, 12)}"
            )
    return found


def _told(log: Log) -> Iterator[tuple[str, str, float]]:
    at, origin = log.meta.at, f'{log.path or "the log"}, metadata "at"'
    if isinstance(at, Mapping):
        for joint, value in at.items():
            yield origin, joint, float(value)
    elif at:
        yield origin, at, 0.0
