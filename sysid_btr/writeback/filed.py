"""Replaying a written file: MuJoCo compiles it, and nothing is added to what it says."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from sysid_btr._typing import FloatArray
from sysid_btr.models.robot import Robot
from sysid_btr.objectives.problem import ReplayProblem
from sysid_btr.simulation.compiling import LIFT
from sysid_btr.simulation.segments import LEAD, SegmentReplay
from sysid_btr.simulation.silence import silenced
from sysid_btr.terms.base import BatchModel, Term
from sysid_btr.writeback.rewrite import unequal

if TYPE_CHECKING:
    import mujoco


@dataclass(frozen=True)
class FilledBuffers(Term):
    """Delayed actuators begin with the commands before the start as their past, instead of with zeros.

    Attributes
    ----------
    lead : how many of the commands are from before the start; the first one stands for all before it.
    """

    lead: int = 0

    name: ClassVar[str] = "filled_buffers"

    def shape_command(self, batch: BatchModel, values: FloatArray, command: FloatArray, time: FloatArray) -> FloatArray:
        import mujoco

        model, h = batch.model, batch.timestep
        sizes = [int(model.actuator_history[a, 0]) if a >= 0 else 0 for a in batch.index.actuator]
        if not any(sizes):
            return command
        data = mujoco.MjData(model)
        history = batch.state["history"] = np.tile(data.history, (batch.size, 1))
        for s in range(batch.size):
            for joint, size in enumerate(sizes):
                if size:
                    rows = np.maximum(self.lead + np.arange(-size, 0), 0)
                    past = np.ascontiguousarray(command[min(s, len(command) - 1), rows, joint, None])
                    times = h * np.arange(-size, 0, dtype=np.float64)
                    mujoco.mj_initCtrlHistory(model, data, int(batch.index.actuator[joint]), times[:, None], past)
            history[s] = data.history
        return command


def robot_of_file(path: Path) -> Robot:
    """The robot in a file, as a replay takes it."""
    import mujoco

    return Robot(name=path.stem, make_spec=lambda: mujoco.MjSpec.from_file(str(path)), path=path)


def of_file(problem: ReplayProblem, path: Path) -> ReplayProblem:
    """The same logs and targets, replayed by the model in a file: no parameters, no laws of the robot's own."""
    robot = robot_of_file(path)
    episodes = []
    for episode in problem.episodes:
        was = episode.replay
        lead = round(LEAD / was.numerics.timestep) if isinstance(was, SegmentReplay) else 0
        replay = replace(was, robot=robot, terms=(FilledBuffers(places=(), lead=lead),))
        episodes.append(replace(episode, replay=replay))
    return ReplayProblem(tuple(episodes), np.zeros(0))


def stands_alone(problem: ReplayProblem) -> bool:
    """Whether plain MuJoCo compiles the files of these replays to just what is replayed."""
    return all(
        not unequal(load_model(e.replay.robot.path, held=e.replay.log.meta.mount == "fixed"), e.replay.model)
        for e in problem.episodes
        if e.replay.robot.path is not None
    )


def load_model(path: Path, *, held: bool) -> mujoco.MjModel:
    """Compile a file with MuJoCo alone; `held` takes its free joints away and lifts it clear of the ground.

    Raises
    ------
    ValueError
        If MuJoCo cannot compile it.
    """
    import mujoco

    with silenced(), warnings.catch_warnings(action="ignore"):
        if not held:
            return mujoco.MjModel.from_xml_path(str(path))
        spec = mujoco.MjSpec.from_file(str(path))
        for joint in list(spec.joints):
            if joint.type == mujoco.mjtJoint.mjJNT_FREE:
                joint.parent.pos = np.add(joint.parent.pos, (0.0, 0.0, LIFT))
                spec.delete(joint)
        for key in list(spec.keys):  # of the robot with its free joint
            spec.delete(key)
        return spec.compile()


def loss_of(problem: ReplayProblem, values: FloatArray) -> float:
    """Sum of squared whitened residuals of one candidate."""
    return float(problem.loss(values[None])[0])
