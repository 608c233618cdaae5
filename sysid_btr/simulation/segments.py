"""Replay by segments: short stretches of a log, each from a state of its own, all in one batch (multiple shooting).

A biped that is replayed from its first sample falls, and a pendulum driven by torques goes its own way; a segment of a
few tenths of a second from a known state does not. Segments times candidates are the simulations of a batch. The
outputs are those of a whole log, each sample predicted by the segment it lies in, and NaN where there is none.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from sysid_btr._typing import BoolArray, FloatArray, IntArray
from sysid_btr.simulation.base_states import BASE, BaseStates, place_base
from sysid_btr.simulation.grid import Grid, on_steps, step_inputs
from sysid_btr.simulation.replay import CHUNK_DOFS, Replay
from sysid_btr.simulation.setup import Setup, Values, prepare
from sysid_btr.simulation.start import behind_sensors
from sysid_btr.simulation.subtrees import subtrees
from sysid_btr.terms.base import BatchModel, Fields, Outputs

if TYPE_CHECKING:
    from sysid_btr.io.log import Log

SIMULATIONS = 96
"""Simulations of one batch, at least ..."""
STEPS = 4096
"""... and their steps: where each takes a few, more of them share what a batch costs."""
WORTH = 0.8
"""Length of a segment, as a fraction of the longest of a batch, from which it shares the batch."""
LEAD = 0.25
"""s of commands before a segment that reach into it when they are delayed, by a bus, whatever the robot's size; more
where a term can delay them longer."""


@dataclass(frozen=True, eq=False)
class Segments:
    """Segments of a log and the states from which they start.

    Attributes
    ----------
    rows : (w, 2) first sample of each segment, and the one after its last.
    joint_position, joint_velocity : (w, j).
    std : (w, b + 2 j) standard deviations: of the base's position, rotation (in its frame), velocity and angular
        velocity where it floats, b = 12, else b = 0; of joint positions and joint velocities.
    base : of the base where it floats.
    joint_acceleration : (w, j), by which the motion about a start bends; None for none.
    """

    rows: IntArray
    joint_position: FloatArray
    joint_velocity: FloatArray
    std: FloatArray
    base: BaseStates | None = None
    joint_acceleration: FloatArray | None = None

    def __len__(self) -> int:
        return len(self.rows)

    @property
    def base_numbers(self) -> int:
        """Numbers of a state that are the base's; those of the joints follow."""
        return 0 if self.base is None else BASE

    @property
    def free_base(self) -> BaseStates:
        """States of the base, which floats."""
        if self.base is None:
            raise ValueError("segments of a fixed base")
        return self.base

    def chosen(self, which: IntArray) -> Segments:
        """Some of the segments."""
        base = None if self.base is None else self.base.chosen(which)
        rate = None if self.joint_acceleration is None else self.joint_acceleration[which]
        return Segments(
            self.rows[which], self.joint_position[which], self.joint_velocity[which], self.std[which], base, rate
        )

    def shifted(self, rows: int) -> Segments:
        """The same segments in a log that begins so many samples later."""
        return replace(self, rows=self.rows - rows)

    def moved(self, change: FloatArray) -> Segments:
        """Starts changed by small amounts in the coordinates of `std`, (w, b + 2 j)."""
        b, j = self.base_numbers, self.joint_position.shape[1]
        return replace(
            self,
            joint_position=self.joint_position + change[:, b : b + j],
            joint_velocity=self.joint_velocity + change[:, b + j :],
            base=None if self.base is None else self.base.moved(change[:, :b]),
        )


def segment_seconds(segments: Segments, log: Log) -> float:
    """Length of a segment, s; 0 where there is none."""
    if len(segments) == 0:
        return 0.0
    a, b = segments.rows[0]
    return float((log.time[b - 1] - log.time[a]) * (b - a) / max(b - a - 1, 1))


def spread_evenly(segments: Segments, log: Log, seconds: float) -> IntArray:
    """Which segments (k,) to take for no more than so many seconds of them, spread evenly over the log."""
    if len(segments) == 0:
        return np.arange(0)
    count = int(np.clip(round(seconds / segment_seconds(segments, log)), 1, len(segments)))
    return np.unique(np.linspace(0, len(segments) - 1, count).astype(np.int64))


def covered(segments: Segments, samples: int) -> BoolArray:
    """(n,) whether a sample of a log lies in a segment."""
    result = np.zeros(samples, dtype=bool)
    for a, b in segments.rows:
        result[a:b] = True
    return result


@dataclass(frozen=True)
class _Frame:
    """Where the samples of a segment lie on steps that begin with its first one."""

    before: IntArray
    after: IntArray
    fraction: FloatArray
    steps: int
    """Steps to its last sample, and the one after it where torques are predicted."""

    @cached_property
    def size(self) -> int:
        """The same for segments that are worth simulating to the longest one's end."""
        return int(np.ceil(np.log(self.steps) / np.log(1 / WORTH)))

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

    made: ClassVar[tuple[str, ...]] = ("model", "index", "start", "given", "switched")

    @cached_property
    def lead(self) -> float:
        """How long before a segment commands may still reach into it, s: as long as any term can delay them."""
        return max([LEAD, *(term.longest_delay for term in self.all_terms)])

    @cached_property
    def _segments(self) -> Segments:
        if self.segments is None:
            raise ValueError("a segmented replay needs segments")
        return self.segments

    @property
    def starts(self) -> Segments:
        """States from which segments are simulated."""
        return self._segments

    @cached_property
    def _frames(self) -> list[_Frame]:
        time, frames = self.log.time, []
        for a, b in self._segments.rows:
            low, high, fraction = on_steps(time[a:b] - time[a], self.numerics.timestep)
            # the torque at a sample is that of the step that begins there
            end = int(low[-1]) + 1 if self.effort else int(high[-1])
            frames.append(_Frame(low, high, fraction, max(end, 1)))
        return frames

    @property
    def steps(self) -> int:
        return sum(frame.steps for frame in self._frames)

    @cached_property
    def _began(self) -> FloatArray:
        """(w,) s on the clock of the log at which segments begin."""
        return np.asarray(self.log.time[self._segments.rows[:, 0]] - self.log.time[0])

    @cached_property
    def _leading(self) -> int:
        """Steps before a segment whose commands may still reach into it."""
        return round(self.lead / self.numerics.timestep)

    @cached_property
    def borders(self) -> FloatArray:
        """(w, ...) borders, s on the clock of the log, of the steps of segments and of those that lead to them."""
        steps = np.arange(-self._leading, max((frame.steps for frame in self._frames), default=0) + 1)
        return np.asarray(self._began[:, None] + steps * self.numerics.timestep)

    @cached_property
    def given(self) -> tuple[FloatArray, FloatArray]:
        """Commands of joints and of what else there is over the steps between `borders`, (w, lead + steps, ...)."""
        return self.commands_between(self.borders)

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
        return Outputs(self.log.time - self.log.time[0], position, velocity, effort)

    def respond(self, values: FloatArray, directions: FloatArray) -> Iterator[tuple[int, Outputs]]:
        """Sensors in each segment under changes of its start.

        Parameters
        ----------
        values : (p,) the candidate.
        directions : (d, b + 2 j) or (w, d, b + 2 j) changes, in the coordinates of `Segments.std`.

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
        """Simulations (candidate, segment, change of its start), in batches; parts have the same sample times."""
        pairs = self._values(candidates)
        order = np.argsort(self._clock[segment], kind="stable")
        label = np.array([frame.size for frame in self._frames])[segment]
        labels, begins = np.unique(label[order], return_index=True)
        for own_label in labels[np.argsort(begins)]:
            members = order[label[order] == own_label]
            steps = max(self._frames[w].steps for w in np.unique(segment[members]))
            most = max(SIMULATIONS, CHUNK_DOFS // max(self.model.nv, 1), STEPS // steps)
            for first in range(0, len(members), most):
                sims = members[first : first + most]
                own = [(term, values[row[sims]]) for term, values in pairs]
                yield from self._block(own, sims, segment[sims], None if change is None else change[sims])

    @cached_property
    def _clock(self) -> IntArray:
        """Of each segment, the first one with the same sample times."""
        first: dict[object, int] = {}
        return np.array([first.setdefault(frame.key, w) for w, frame in enumerate(self._frames)], dtype=np.int64)

    def _block(
        self, pairs: Values, sims: IntArray, segment: IntArray, change: FloatArray | None
    ) -> Iterator[tuple[IntArray, Outputs]]:
        """One batch of simulations, read where they share their sample times."""
        h, steps = self.numerics.timestep, max(self._frames[w].steps for w in segment)
        setup = self._setup(pairs, segment, change, steps)
        states = self.simulate(setup, np.arange(steps + 1))
        borders = np.flatnonzero(np.diff(self._clock[segment], prepend=-1, append=-1))
        for a, b in pairwise(borders):
            frame, rows = self._frames[segment[a]], slice(int(a), int(b))
            local = Grid(
                timestep=h,
                command=np.empty((frame.steps, 0)),
                sample_time=(frame.before + frame.fraction) * h,
                state=np.arange(frame.steps + 1),
                before=frame.before,
                after=frame.after,
                fraction=frame.fraction,
            )
            own = states
            if len(borders) > 2:
                own = states.of(rows, local.state)
                if frame.steps < steps:
                    own.repeat_last_effort()
            yield sims[rows], self.read(setup, rows, [(term, values[rows]) for term, values in pairs], own, local)

    def _setup(self, pairs: Values, segment: IntArray, change: FloatArray | None, steps: int) -> Setup:
        """Segments from their initial states, with `change` added to these."""
        starts, began, lead = self.starts.chosen(segment), self._began[segment], self._leading
        if change is not None:
            starts = starts.moved(change[:, : starts.std.shape[1]])
        batch = self.batch(pairs, len(segment))
        course = starts.joint_position, starts.joint_velocity, starts.joint_acceleration
        qpos, qvel = behind_sensors(batch, pairs, self.shown, *course, began)
        command, extra = (values[segment, : lead + steps] for values in self.given)
        setup = prepare(
            batch,
            pairs,
            qpos,
            qvel,
            command,
            self.numerics,
            inputs=lambda: {n: values[segment, :steps].T for n, values in self._inputs.items()},
            effort=self.effort,
            began=began,
            lead=lead,
            extra=extra,
        )
        if starts.base is not None:
            place_base(setup, starts.base)
        return replace(setup, state={**setup.state, **self.push(batch, segment, change)})

    @cached_property
    def _inputs(self) -> dict[str, FloatArray]:
        """Measured inputs of the drives over the steps of segments, (w, steps) each."""
        return step_inputs(self.log, self.borders[:, self._leading :])

    def lanes(self) -> list[list[tuple[int, IntArray]]]:
        """Numbers of a start that one simulation can vary together: (position in `Segments.std`, joints it moves).

        Of joints of different subtrees, one each.
        """
        where, joints = subtrees(self.model), self.index.joints
        members: dict[int, list[int]] = {}
        for j, name in enumerate(joints):
            members.setdefault(where[name], []).append(j)
        lanes = []
        for k in range(max(map(len, members.values()))):
            own = [(m[k], np.array(m)) for m in members.values() if k < len(m)]
            lanes += [[(j, seen) for j, seen in own], [(len(joints) + j, seen) for j, seen in own]]
        return lanes

    def push(self, batch: BatchModel, segment: IntArray, change: FloatArray | None) -> Fields:
        """Forces from outside on a batch of segments, as in MjData; none here."""
        return {}
