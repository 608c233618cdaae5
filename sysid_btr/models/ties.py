"""Joints that a model ties together and that a log shows moving apart: then the robot's are not tied."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from sysid_btr._typing import FloatArray
from sysid_btr.io.log import Log
from sysid_btr.io.noise import channel_noise
from sysid_btr.models.robot import Robot
from sysid_btr.mujoco_conventions import slides
from sysid_btr.units import si

if TYPE_CHECKING:
    import mujoco

APART = 0.5
"""Motion against each other, of the larger motion, beyond which a tie explains less than three quarters of it. Play and
compliance of a real tie are a small part of the motion."""
SURE = 5.0
"""... and in noise floors, so that joints that stand still break no tie."""


@dataclass(frozen=True)
class BrokenTie:
    """Two joints of which a model makes one follow the other, and a log does not.

    Attributes
    ----------
    joints : their names.
    apart : standard deviation of what one does beyond following the other, rad or m.
    unit : of that.
    """

    joints: tuple[str, str]
    apart: float
    unit: str

    def __str__(self) -> str:
        a, b = self.joints
        return (
            f"the model ties {a} to {b}, and the log shows them moving {si(self.apart, self.unit)} (rms) against each "
            "other: on this robot they are not tied, and the tie is left out"
        )


def broken_ties(robot: Robot, logs: Sequence[Log]) -> tuple[BrokenTie, ...]:
    """Equalities of two logged joints that any of the logs contradicts; a constant difference is an encoder's."""
    model = robot.model
    found = []
    for first, second, curve in _ties(model):
        rest = float(model.joint(second).qpos0[0])
        for log in logs:
            broken = _in_log(log, first, second, curve, rest)
            if broken is not None:
                found.append(BrokenTie((first, second), broken, "m" if slides(model, first) else "rad"))
                break
    return tuple(found)


def as_logged(robot: Robot, logs: Sequence[Log]) -> Robot:
    """The robot without the ties that its logs contradict, and with a remark on each."""
    broken = broken_ties(robot, logs)
    if not broken:
        return robot
    pairs, plain = {tie.joints for tie in broken}, robot.make_spec

    def untied() -> mujoco.MjSpec:
        spec = plain()
        for equality in list(spec.equalities):
            if (equality.name1, equality.name2) in pairs:
                spec.delete(equality)
        return spec

    kept = tuple(group for group in robot.tied if not any(set(pair) <= set(group) for pair in pairs))
    return replace(robot, make_spec=untied, tied=kept, remarks=(*robot.remarks, *map(str, broken)))


def _ties(model: mujoco.MjModel) -> Iterator[tuple[str, str, FloatArray]]:
    """Active equalities of two joints: the first is a polynomial (5,) of how far the second is from its zero."""
    import mujoco

    for i in range(model.neq):
        if model.eq_type[i] == mujoco.mjtEq.mjEQ_JOINT and model.eq_obj2id[i] >= 0 and model.eq_active0[i]:
            first, second = (model.joint(int(joint[i])).name for joint in (model.eq_obj1id, model.eq_obj2id))
            yield first, second, np.array(model.eq_data[i][:5])


def _in_log(log: Log, first: str, second: str, curve: FloatArray, rest: float) -> float | None:
    """How far two joints move against each other, if that breaks their tie."""
    if not (log.has("position", first) and log.has("position", second)):
        return None
    own, other = (log.channels[f"position.{joint}"] for joint in (first, second))
    followed = np.polynomial.polynomial.polyval(other - rest, curve)
    seen = np.isfinite(own) & np.isfinite(followed)
    if seen.sum() < 2:
        return None
    apart, motion = float(np.std((own - followed)[seen])), float(max(np.std(own[seen]), np.std(followed[seen])))
    noise = max(channel_noise(log, f"position.{joint}").sigma for joint in (first, second))
    return apart if apart > APART * motion and apart > SURE * noise else None
