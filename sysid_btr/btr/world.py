"""Robots given commands from rest, on the ground or fixed to it: controllers times models in one batch."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Literal

import numpy as np

from sysid_btr._typing import BoolArray, FloatArray, IntArray
from sysid_btr.btr.task import Motion, Task
from sysid_btr.errors import ModelError
from sysid_btr.io.log import Log, LogMeta
from sysid_btr.models.pose import resting
from sysid_btr.models.robot import Robot
from sysid_btr.mujoco_conventions import find_place, free_joints
from sysid_btr.simulation.base_states import free_addresses
from sysid_btr.simulation.compiling import make_index
from sysid_btr.simulation.mujoco_batch import POSITION, evaluate
from sysid_btr.simulation.numerics import Numerics
from sysid_btr.simulation.replay import CHUNK, Replay
from sysid_btr.simulation.setup import as_ctrl
from sysid_btr.simulation.silence import silenced
from sysid_btr.terms.base import BatchModel, Fields, JointAddresses, Outputs, Term

if TYPE_CHECKING:
    import mujoco

STEP = 0.005
"""s, longest step: MuJoCo's contacts have time constants of 20 ms."""


@dataclass(frozen=True)
class World(Replay):
    """A replay whose commands are those of many controllers, from rest; records a free base.

    Joints begin where the first command wants them, or where the model keeps them if motors drive them by torque. A
    robot whose base is free stands with its lowest point on the floor at z = 0.
    """

    @cached_property
    def index(self) -> JointAddresses:
        model = self.model
        free = free_joints(model)
        if len(free) > 1:
            raise ModelError(f"model {self.robot.name}: {len(free)} free joints; a robot has one, at its base, or none")
        return make_index(model) if not len(free) else replace(make_index(model), base=free_addresses(model))

    @cached_property
    def rest(self) -> FloatArray:
        """(j,) where joints are that nothing commands."""
        return resting(self.robot, self.log, self.index.joints)

    def spread(self, joints: Sequence[str], commands: FloatArray) -> FloatArray:
        """Commands (m, n, joints given) for all joints of the model, (m, n, j); the others stay where they are."""
        others = np.where(self.index.driven_by("torque", "velocity"), 0.0, self.rest)
        result = np.tile(others, (*commands.shape[:2], 1))
        result[:, :, self.index.of(joints)] = commands
        return np.asarray(result)

    def run(self, commands: FloatArray, values: FloatArray) -> Iterator[tuple[slice, Outputs]]:
        """Motions, a chunk at a time.

        Parameters
        ----------
        commands : (m, n, j) at the samples of the log, for all joints of the model, held until the next one.
        values : (m, p) candidate of each run.

        Yields
        ------
        (slice, Outputs)
            Rows, and motions with their base. A run that diverged, or whose commands are not finite, is all NaN.
        """
        for first in range(0, len(commands), CHUNK):
            rows = slice(first, min(first + CHUNK, len(commands)))
            good: BoolArray = np.asarray(np.isfinite(commands[rows]).all(axis=(1, 2)))
            with silenced():
                outputs = self._move(np.where(good[:, None, None], commands[rows], 0.0), values[rows])
            for array in (outputs.position, outputs.velocity, outputs.base):
                if array is not None:
                    array[~good] = np.nan
            yield rows, outputs

    def _move(self, commands: FloatArray, values: FloatArray) -> Outputs:
        m, grid, index = len(commands), self.grid, self.index
        pairs = self._values(values)
        held = np.repeat(commands[:, :-1], grid.steps // (commands.shape[1] - 1), axis=1)
        led = self.index.driven_by("torque", "velocity")
        qpos, qvel = np.where(led, self.rest, commands[:, 0]), np.zeros((m, len(index.joints)))
        setup = self._prepare(self.batch(pairs, m), pairs, qpos, qvel, held, ((self.log, grid),))
        if index.base is not None:
            setup.state["qpos"][:, index.base[0] + 2] -= lowest(setup.batch, setup.state, self.threads)
        return self._go(setup, pairs, grid)

    def motion(self, outputs: Outputs, values: FloatArray, watched: Sequence[str] = ()) -> Motion:
        """What a task judges of motions (m, ...) of candidates (m, p), with the places of what it watches."""
        places = {name: np.empty((*outputs.position.shape[:2], 3)) for name in watched}
        for row, value in enumerate(values if watched else ()):
            state = self._states(outputs, row)
            batch = self.batch(self._values(np.tile(value, (len(outputs.time), 1))), len(outputs.time))
            with silenced():
                found = evaluate(batch, state, ("xpos", "site_xpos"), stage=POSITION, threads=self.threads)
            for name, place in places.items():
                kind, number = find_place(self.model, name)
                place[row] = found[kind][:, number]
        bad = ~np.isfinite(outputs.position).all(axis=(1, 2))
        for place in places.values():
            place[bad] = np.nan
        return Motion(tuple(self.index.joints), outputs.position, outputs.base, places)

    def _states(self, outputs: Outputs, row: int) -> dict[str, FloatArray]:
        """The engine's positions and velocities, (n, ...), along one of some motions."""
        n, index, model = outputs.position.shape[1], self.index, self.model
        qpos, qvel = np.tile(model.qpos0, (n, 1)), np.zeros((n, model.nv))
        if index.base is not None and outputs.base is not None:
            (place, motion), base = index.base, outputs.base[row]
            qpos[:, place : place + 7], qvel[:, motion : motion + 6] = base[:, :7], base[:, 7:]
        qpos[:, index.qpos], qvel[:, index.dof] = outputs.position[row], outputs.velocity[row]
        return {"qpos": np.nan_to_num(qpos), "qvel": np.nan_to_num(qvel)}

    def sensors(self, outputs: Outputs, command: FloatArray, values: FloatArray) -> dict[str, FloatArray]:
        """The model's own sensors by name, (n, size) each, along the first of some motions.

        Parameters
        ----------
        outputs : motions with their base.
        command : (n, j) of that motion.
        values : (p,) its candidate.
        """
        n, index, model = len(command), self.index, self.model
        ctrl = np.zeros((n, model.nu))
        driven = np.flatnonzero(index.actuator >= 0)
        ctrl[:, index.actuator[driven]] = as_ctrl(index, driven, command[:, driven])
        batch = self.batch(self._values(np.tile(values, (n, 1))), n)
        state = {**self._states(outputs, 0), "ctrl": ctrl}
        data = evaluate(batch, state, ("sensordata",), threads=self.threads)["sensordata"]
        first = model.sensor_adr
        return {model.sensor(s).name: data[:, first[s] : first[s] + model.sensor_dim[s]] for s in range(model.nsensor)}


def lowest(batch: BatchModel, state: Fields, threads: int = 0) -> FloatArray:
    """Height (m,) of the lowest point of what can touch the ground, in each candidate's pose."""
    found = evaluate(batch, state, ("geom_xpos", "geom_xmat"), stage=POSITION, threads=threads)
    place, up = found["geom_xpos"], found["geom_xmat"].reshape(batch.size, -1, 9)[:, :, 6:]
    kinds, sizes = batch.model.geom_type, batch.read("geom_size")
    heights = [place[:, g, 2] - _reach(int(kinds[g]), sizes[:, g], up[:, g]) for g in feet_geoms(batch.model)]
    return np.min(heights, axis=0) if heights else np.zeros(batch.size)


def feet_geoms(model: mujoco.MjModel) -> IntArray:
    """Geoms of moving bodies that can collide with what is fixed to the world."""
    still = model.body_weldid[model.geom_bodyid] == 0
    types, affinities = model.geom_contype[still], model.geom_conaffinity[still]
    meets = (model.geom_contype[:, None] & affinities) | (types & model.geom_conaffinity[:, None])
    return np.flatnonzero(~still & meets.any(axis=1))


def _reach(kind: int, size: FloatArray, up: FloatArray) -> FloatArray:
    """How far a geom extends below its centre, (m,); `up` is the world's vertical in its frame, (m, 3)."""
    import mujoco

    types = mujoco.mjtGeom
    along = np.abs(up[:, 2])
    if kind == types.mjGEOM_SPHERE:
        return size[:, 0]
    if kind == types.mjGEOM_CAPSULE:
        return np.asarray(size[:, 0] + size[:, 1] * along)
    if kind == types.mjGEOM_CYLINDER:
        return np.asarray(size[:, 1] * along + size[:, 0] * np.sqrt(np.maximum(1 - along**2, 0.0)))
    return np.asarray(np.sum(size * np.abs(up), axis=1))  # boxes, and others by their box


def mount_of(robot: Robot) -> Literal["fixed", "free"]:
    """How a robot stands: on its base, or on the ground."""
    return "free" if len(free_joints(robot.model)) else "fixed"


def make_world(robot: Robot, task: Task, terms: Sequence[Term] = (), *, halvings: int = 0, threads: int = 0) -> World:
    """The world of a robot and a task.

    Parameters
    ----------
    robot, terms : the model and what of it a candidate changes.
    task : length and sampling of a trial.
    halvings : times the step is halved below the one that the model states (at most `STEP`).
    threads : worker threads, 0 for all cores.

    Raises
    ------
    UsageError
        If the robot cannot do the task.
    """
    task.check(robot)
    own = float(robot.model.opt.timestep)
    step = task.period / np.ceil(task.period / min(own, STEP) - 1e-9) / 2**halvings
    log = Log(
        time=task.time,
        channels={},
        meta=LogMeta(robot=robot.name, mount=mount_of(robot), sample_period=task.period),
        episode=np.zeros(len(task.time), dtype=np.int64),
    )
    return World(robot, log, tuple(terms), Numerics("implicitfast", float(step)), threads=threads)
