"""Replay by segments: short stretches of a log, each from a state of its own, all in one batch (multiple shooting).

A biped that is replayed from its first sample falls; a segment of a few tenths of a second from a known state does
not. Segments times candidates are the simulations of a batch. The outputs are those of a whole log, each sample
predicted by the segment it lies in, and NaN where there is none.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from sysid_btr._typing import FloatArray, IntArray
from sysid_btr.mujoco_conventions import free_joints, to_quaternion, to_rotation
from sysid_btr.simulation.grid import Grid, step_inputs
from sysid_btr.simulation.replay import Replay
from sysid_btr.simulation.setup import Setup, Values, prepare
from sysid_btr.terms.base import Fields, Outputs

SIMULATIONS = 96
"""Simulations of one batch."""
LEAD = 0.25
"""s of commands before a segment that reach into it when they are delayed, by a bus, whatever the robot's size."""
BASE = 12
"""Numbers of a free base in a state: position, rotation, velocity, angular velocity, three each."""


@dataclass(frozen=True, eq=False)
class Segments:
    """Segments of a log and the states from which they start.

    Attributes
    ----------
    rows : (w, 2) first sample of each segment, and the one after its last.
    position, velocity : (w, 3) of the base in the world.
    quaternion : (w, 4) of the base, scalar first.
    rate : (w, 3) angular velocity in the base's frame.
    joint_position, joint_velocity : (w, j).
    std : (w, 12 + 2 j) standard deviations of base position, rotation (in the base's frame), velocity, angular
        velocity, joint positions and joint velocities.
    """

    rows: IntArray
    position: FloatArray
    quaternion: FloatArray
    velocity: FloatArray
    rate: FloatArray
    joint_position: FloatArray
    joint_velocity: FloatArray
    std: FloatArray

    def __len__(self) -> int:
        return len(self.rows)

    def chosen(self, which: IntArray) -> Segments:
        """Some of the segments."""
        return Segments(*(getattr(self, name)[which] for name in _FIELDS))

    def shifted(self, rows: int) -> Segments:
        """The same segments in a log that begins so many samples later."""
        return replace(self, rows=self.rows - rows)

    def moved(self, change: FloatArray) -> Segments:
        """Starts changed by small amounts in the coordinates of `std`, (w, 12 + 2 j)."""
        from scipy.spatial.transform import Rotation

        j = self.joint_position.shape[1]
        turned = to_rotation(self.quaternion) * Rotation.from_rotvec(change[:, 3:6])
        return replace(
            self,
            position=self.position + change[:, :3],
            quaternion=to_quaternion(turned),
            velocity=self.velocity + change[:, 6:9],
            rate=self.rate + change[:, 9:12],
            joint_position=self.joint_position + change[:, BASE : BASE + j],
            joint_velocity=self.joint_velocity + change[:, BASE + j :],
        )


def on_slope(starts: Segments, level: FloatArray, tilted: FloatArray) -> Segments:
    """Starts on a floor to which gravity is not normal.

    The inertial unit knows the base's attitude to gravity, so where gravity is tilted in the floor's frame the base
    is tilted with it, about the ground below it.

    Parameters
    ----------
    starts : on a level floor.
    level : (3,) gravity normal to the floor.
    tilted : (w, 3) gravity of each start.
    """
    from scipy.spatial.transform import Rotation

    a = level / np.linalg.norm(level)
    b = tilted / np.linalg.norm(tilted, axis=1, keepdims=True)
    axis, cosine = np.cross(a, b), np.clip(b @ a, -1.0, 1.0)
    sine = np.linalg.norm(axis, axis=1)
    turn = Rotation.from_rotvec(axis * (np.arctan2(sine, cosine) / np.where(sine > 0, sine, 1.0))[:, None])
    below = starts.position * [1.0, 1.0, 0.0]
    turned = turn * to_rotation(starts.quaternion)
    return replace(
        starts,
        position=below + turn.apply(starts.position - below),
        quaternion=to_quaternion(turned),
        velocity=turn.apply(starts.velocity),
    )


_FIELDS = ("rows", "position", "quaternion", "velocity", "rate", "joint_position", "joint_velocity", "std")


@dataclass(frozen=True)
class _Frame:
    """Where a segment lies on the log's grid: first border, and its samples relative to that."""

    first: int
    before: IntArray
    after: IntArray
    fraction: FloatArray
    late: float
    """s from the first border to the first sample."""

    @property
    def key(self) -> tuple[bytes, bytes, bytes]:
        return self.before.tobytes(), self.after.tobytes(), np.round(self.fraction, 6).tobytes()


@dataclass(frozen=True)
class SegmentReplay(Replay):
    """A log replayed by segments.

    Attributes
    ----------
    segments : stretches and states; for the joints in the order of `index.joints`.
    """

    segments: Segments | None = None

    @cached_property
    def _segments(self) -> Segments:
        if self.segments is None:
            raise ValueError("a segmented replay needs segments")
        return self.segments

    @cached_property
    def _frames(self) -> list[_Frame]:
        grid = self.grid
        low, high = grid.state[grid.before], grid.state[grid.after]
        frames = []
        for a, b in self._segments.rows:
            first = int(low[a])
            frames.append(
                _Frame(
                    first,
                    low[a:b] - first,
                    high[a:b] - first,
                    grid.fraction[a:b],
                    float(grid.fraction[a] * grid.timestep),
                )
            )
        return frames

    def _run(self, candidates: FloatArray) -> Outputs:
        m, w = len(candidates), len(self._segments)
        n, joints = len(self.log), len(self.index.joints)
        shape = (m, n, joints)
        position, velocity = np.full(shape, np.nan), np.full(shape, np.nan)
        effort = np.full(shape, np.nan) if self.effort else None
        # candidates of one segment side by side: they share its commands
        row, segment = np.tile(np.arange(m), w), np.repeat(np.arange(w), m)
        for sims, part in self._simulate(candidates, row, segment, None):
            for s, i in enumerate(sims):
                a, b = self._segments.rows[segment[i]]
                position[row[i], a:b] = part.position[s]
                velocity[row[i], a:b] = part.velocity[s]
                if effort is not None and part.effort is not None:
                    effort[row[i], a:b] = part.effort[s]
        return Outputs(self.grid.sample_time, position, velocity, effort)

    def respond(self, values: FloatArray, directions: FloatArray) -> Iterator[tuple[int, Outputs]]:
        """Sensors in each segment under changes of its start.

        Parameters
        ----------
        values : (p,) the candidate.
        directions : (d, 12 + 2 j) or (w, d, 12 + 2 j) changes, in the coordinates of `Segments.std`.

        Yields
        ------
        (int, Outputs)
            Segment, and sensors (d, samples of the segment, joints).
        """
        w = len(self._segments)
        wide = np.broadcast_to(directions, (w, *directions.shape[-2:]))
        d = wide.shape[1]
        row, segment = np.zeros(w * d, dtype=np.int64), np.repeat(np.arange(w), d)
        change = wide.reshape(w * d, -1)
        waiting: dict[int, list[tuple[int, Outputs, int]]] = {}
        for sims, part in self._simulate(values[None], row, segment, change):
            for s, i in enumerate(sims):
                own = waiting.setdefault(int(segment[i]), [])
                own.append((int(i), part, s))
                if len(own) == d:
                    own.sort(key=lambda item: item[0])
                    efforts = [p.effort[k] for _, p, k in own if p.effort is not None]
                    yield (
                        int(segment[i]),
                        Outputs(
                            part.time,
                            np.stack([p.position[k] for _, p, k in own]),
                            np.stack([p.velocity[k] for _, p, k in own]),
                            np.stack(efforts) if efforts else None,
                        ),
                    )
                    del waiting[int(segment[i])]

    def _simulate(
        self, candidates: FloatArray, row: IntArray, segment: IntArray, change: FloatArray | None
    ) -> Iterator[tuple[IntArray, Outputs]]:
        """Simulations (candidate, segment, change of its start), in batches of segments with the same sample times."""
        pairs = self._values(candidates)
        # a torque known in advance is known on the log's clock, so its segments cannot share a batch
        alone = any(type(term).overrides("applied_torque") for term, _ in pairs)
        groups: dict[object, list[int]] = {}
        for i, w in enumerate(segment):
            groups.setdefault(int(w) if alone else self._frames[w].key, []).append(i)
        for members in groups.values():
            for first in range(0, len(members), SIMULATIONS):
                sims = np.array(members[first : first + SIMULATIONS])
                yield (
                    sims,
                    self._block(
                        [(term, values[row[sims]]) for term, values in pairs],
                        segment[sims],
                        None if change is None else change[sims],
                    ),
                )

    def _block(self, pairs: Values, segment: IntArray, change: FloatArray | None) -> Outputs:
        """One batch of simulations that share their sample times."""
        frame = self._frames[segment[0]]
        h, steps = self.grid.timestep, max(int(frame.after[-1]), 1)
        local = Grid(
            timestep=h,
            command=np.empty((steps, 0)),
            sample_time=(frame.before + frame.fraction) * h,
            state=np.arange(steps + 1),
            before=frame.before,
            after=frame.after,
            fraction=frame.fraction,
        )
        return self._go(self._setup(pairs, segment, change, steps), pairs, local)

    def _setup(self, pairs: Values, segment: IntArray, change: FloatArray | None, steps: int) -> Setup:
        """Segments from their initial states, with `change` added to these."""
        frame, h = self._frames[segment[0]], self.grid.timestep
        starts = self._segments.chosen(segment)
        if change is not None:
            starts = starts.moved(change[:, : starts.std.shape[1]])
        if frame.late:
            late = np.zeros_like(starts.std)
            joints = starts.joint_position.shape[1]
            late[:, :3], late[:, 3:6] = -frame.late * starts.velocity, -frame.late * starts.rate
            late[:, BASE : BASE + joints] = -frame.late * starts.joint_velocity
            starts = starts.moved(late)
        batch = self.batch(pairs, len(segment))
        if "opt.gravity" in batch.fields:
            starts = on_slope(starts, np.array(self.model.opt.gravity), batch.read("opt.gravity"))
        first = np.array([self._frames[w].first for w in segment])
        lead = round(LEAD / h)
        rows = np.clip(first[:, None] + np.arange(-lead, steps), 0, self.grid.steps - 1)
        setup = prepare(
            batch,
            pairs,
            starts.joint_position.copy(),
            starts.joint_velocity.copy(),
            self.grid.command[rows],
            self.numerics,
            inputs=lambda: {n: values[rows[:, lead:].T] for n, values in step_inputs(self.log, self.grid).items()},
            effort=self.effort,
            first=int(first[0]),
            lead=lead,
            extra=self.grid.extra[rows],
        )
        place, motion = self._free_joint
        qpos, qvel = setup.state["qpos"], setup.state["qvel"]
        qpos[:, place : place + 3], qpos[:, place + 3 : place + 7] = starts.position, starts.quaternion
        qvel[:, motion : motion + 3], qvel[:, motion + 3 : motion + 6] = starts.velocity, starts.rate
        return replace(setup, state={**setup.state, **self.push(segment, change)})

    def push(self, segment: IntArray, change: FloatArray | None) -> Fields:
        """Forces from outside on a batch of segments, as in MjData; none here."""
        return {}

    @cached_property
    def _free_joint(self) -> tuple[int, int]:
        """Addresses of the free joint in qpos and in qvel."""
        joint = int(free_joints(self.model)[0])
        return int(self.model.jnt_qposadr[joint]), int(self.model.jnt_dofadr[joint])
