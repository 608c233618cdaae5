"""Replay: one log under many candidates, on whatever simulator its numerics name.

A `Replay` compiles its model once. Candidates are rows of numbers that terms turn into compiled fields, initial
states, commands and laws; they run in chunks, so that memory stays bounded whatever their number.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from sysid_btr._typing import BoolArray, FloatArray, IntArray
from sysid_btr.machine import memory_limit, require_memory
from sysid_btr.models.commands import commanded
from sysid_btr.models.pose import resting
from sysid_btr.models.robot import Robot
from sysid_btr.simulation.base_states import BaseStates, free_addresses, place_base
from sysid_btr.simulation.compiling import compile_model, made_elsewhere, make_index
from sysid_btr.simulation.grid import Grid, at_samples, even_borders, make_grid, mean_commands, step_inputs
from sysid_btr.simulation.numerics import Numerics
from sysid_btr.simulation.registry import get_simulator
from sysid_btr.simulation.servo import ServoLaw
from sysid_btr.simulation.setup import Setup, Values, prepare, write_terms
from sysid_btr.simulation.silence import silenced
from sysid_btr.simulation.simulator import States
from sysid_btr.simulation.start import Start, behind_sensors, coupled_state, initial_state
from sysid_btr.terms.base import BatchModel, JointAddresses, Outputs, Parameter, Term
from sysid_btr.terms.drives import joint_drives
from sysid_btr.terms.power import Switch

if TYPE_CHECKING:
    import mujoco

    from sysid_btr.io.log import Log

CHUNK = 32
"""Candidates simulated together, at least; enough to share the cost of a Python step, few enough for the cache."""
CHUNK_DOFS = 704
"""Degrees of freedom simulated together, at least: small models share a step among more candidates."""


@dataclass(frozen=True)
class Replay:
    """One episode of a log, a robot and its terms, ready to be run under candidates.

    Attributes
    ----------
    robot, log, terms, numerics : what is replayed and how.
    effort : whether servo torques are predicted too.
    threads : worker threads, 0 for all cores.
    begun : state from which it starts; None for that of the log's first samples.
    base_start : state, one, from which a free base starts, whose motion is then recorded; None for the model's own.
    """

    robot: Robot
    log: Log
    terms: tuple[Term, ...]
    numerics: Numerics
    effort: bool = False
    threads: int = 0
    begun: Start | None = field(default=None, kw_only=True)
    base_start: BaseStates | None = field(default=None, kw_only=True)

    made: ClassVar[tuple[str, ...]] = ("model", "index", "start", "grid", "switched")
    """What is made of the robot's source, and of all of the log: another process is sent it."""

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Free numbers of a candidate, in the order of its columns."""
        return tuple(p for term in self.terms for p in term.parameters)

    def __getstate__(self) -> dict[str, Any]:
        """What another process needs to simulate the same: the compiled model in place of what makes it.

        It runs there on one thread: who sends it has many of them run side by side.
        """
        own = {f.name: getattr(self, f.name) for f in fields(self)}
        made = {name: getattr(self, name) for name in self.made}
        robot = replace(self.robot, make_spec=made_elsewhere, configure=None)
        return {**own, **made, "robot": robot, "threads": 1}

    @property
    def all_terms(self) -> tuple[Term, ...]:
        return (*self.robot.always, *self.terms, *self.switched)

    @cached_property
    def switched(self) -> tuple[Term, ...]:
        """What turns drives off where the log says that they are, unless the robot's own terms do."""
        own = {place for term in self.robot.always if term.switches for place in term.places}
        joints = (drive.joint for drive in joint_drives(self.robot.model))
        enabled = {j: self.log.channels[f"enabled.{j}"] for j in joints if self.log.has("enabled", j) and j not in own}
        off = tuple(joint for joint, values in enabled.items() if np.any(values == 0))
        return (Switch(off),) if off else ()

    @cached_property
    def model(self) -> mujoco.MjModel:
        """The compiled model, with the structure that the terms ask for."""
        return compile_model(self.robot, self.log, self.all_terms, self.numerics)

    @cached_property
    def index(self) -> JointAddresses:
        index = make_index(self.model)
        return index if self.base_start is None else replace(index, base=free_addresses(self.model))

    @cached_property
    def start(self) -> tuple[FloatArray, FloatArray]:
        """Initial positions and velocities of the joints, (j,) each."""
        joints = self.index.joints
        if self.begun is None:
            start = initial_state(self.log, joints, resting(self.robot, self.log, joints))
        else:
            start = self.begun.position.copy(), self.begun.velocity.copy()
        return coupled_state(self.model, self.index, *start, ~self._logged)

    @cached_property
    def _logged(self) -> BoolArray:
        """(j,) which joints have their position in the log."""
        return np.array([self.log.has("position", joint) for joint in self.index.joints], dtype=bool)

    @cached_property
    def shown(self) -> BoolArray:
        """(j,) which joints start where a sensor's error leaves them, and not where the log says.

        None that others follow by an equality, or that a servo without commands holds where it starts.
        """
        if self.model.neq and not self._logged.all():
            return np.zeros(len(self.index.joints), dtype=bool)
        commanded = np.array([self.log.has("command", joint) for joint in self.index.joints], dtype=bool)
        return self._logged & (commanded | ~self.index.driven_by("position"))

    @cached_property
    def idle(self) -> tuple[FloatArray, dict[str, float]]:
        """Commands (j,) of joints and ctrl of actuators that the log does not command.

        A position servo holds its joint where it starts; others do what the model's keyframe says, or nothing.
        """
        index, plain = self.index, self.robot.model
        ctrl = plain.key_ctrl[0] if plain.nkey else np.zeros(plain.nu)
        driven = index.actuator >= 0
        kept = np.zeros(len(index.joints))
        kept[driven] = ctrl[index.actuator[driven]]
        commands = np.where(index.driven_by("torque", "velocity"), kept / index.scale, self.start[0])
        return commands, {name: float(ctrl[a]) for name, a in zip(index.controls, index.control, strict=True)}

    @cached_property
    def grid(self) -> Grid:
        commands, (defaults, controls) = commanded(self.log, self.model), self.idle
        return make_grid(commands, self.index.joints, defaults, self.numerics.timestep, controls)

    @property
    def steps(self) -> int:
        """That one candidate takes."""
        return self.grid.steps

    def commands_between(self, borders: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Commands over steps of one's own, see `mean_commands`."""
        commands, (defaults, controls) = commanded(self.log, self.model), self.idle
        return mean_commands(commands, self.index.joints, defaults, controls, borders)

    def predict(self, candidates: FloatArray) -> Outputs:
        """All predicted sensors at once; for many candidates iterate over `chunks` instead."""
        parts = [outputs for _, outputs in self.chunks(candidates)]
        if len(parts) == 1:
            return parts[0]
        return Outputs(
            time=parts[0].time,
            position=np.concatenate([p.position for p in parts]),
            velocity=np.concatenate([p.velocity for p in parts]),
            effort=None
            if parts[0].effort is None
            else np.concatenate([p.effort for p in parts if p.effort is not None]),
        )

    def chunks(self, candidates: FloatArray) -> Iterator[tuple[slice, Outputs]]:
        """Predicted sensors, a chunk of candidates at a time.

        Parameters
        ----------
        candidates : (m, parameters).

        Yields
        ------
        (slice, Outputs)
            Rows of the chunk, and sensors (rows, samples, joints). A diverged candidate is all NaN.
        """
        candidates = np.atleast_2d(np.asarray(candidates, dtype=np.float64))
        if candidates.shape[1] != len(self.parameters):
            raise ValueError(f"candidates have {candidates.shape[1]} numbers, expected {len(self.parameters)}")
        size = self.chunk_size
        for first in range(0, len(candidates), size):
            rows = slice(first, min(first + size, len(candidates)))
            with silenced():
                outputs = self._run(candidates[rows])
            yield rows, outputs

    @property
    def chunk_size(self) -> int:
        """Candidates that are simulated together, as memory allows.

        Raises
        ------
        UsageError
            If there is not enough for one.
        """
        seconds = float(self.log.time[-1] - self.log.time[0])
        inputs = self.model.nu + 2 * len(self.index.joints)
        one = 8 * (seconds / self.numerics.timestep * inputs + 6 * len(self.log) * len(self.index.joints))
        what = f"simulating {seconds:.6g} s in steps of {self.numerics.timestep:.3g} s"
        require_memory(one, what, "use a shorter log")
        usual = max(CHUNK, CHUNK_DOFS // max(self.model.nv, 1))
        return int(min(usual, max(memory_limit() / max(one, 1.0), 1.0)))

    def _values(self, candidates: FloatArray) -> list[tuple[Term, FloatArray]]:
        pairs, column = [], 0
        for term in self.all_terms:
            count = len(term.parameters)
            pairs.append((term, term.spread(candidates[:, column : column + count])))
            column += count
        return pairs

    def _run(self, candidates: FloatArray) -> Outputs:
        pairs, m, grid = self._values(candidates), len(candidates), self.grid
        command, extra = (np.broadcast_to(x, (m, *x.shape)) for x in (grid.command, grid.extra))
        batch = self.batch(pairs, m)
        qpos, qvel = behind_sensors(batch, pairs, self.shown, *(np.tile(start, (m, 1)) for start in self.start))
        setup = self._prepare(batch, pairs, qpos, qvel, command, ((self.log, grid),), extra)
        if self.base_start is not None:
            place_base(setup, self.base_start)
        return self._go(setup, pairs, grid)

    def batch(self, pairs: Values, size: int) -> BatchModel:
        """The models of some candidates."""
        return write_terms(BatchModel(self.model, self.index, self.numerics.timestep, size), pairs)

    def _prepare(
        self,
        batch: BatchModel,
        pairs: Values,
        qpos: FloatArray,
        qvel: FloatArray,
        command: FloatArray,
        logs: Sequence[tuple[Log, Grid]],
        extra: FloatArray | None = None,
    ) -> Setup:
        """A rollout of logs that each own an equal share of the candidates, see `prepare`."""
        return prepare(
            batch,
            pairs,
            qpos,
            qvel,
            command,
            self.numerics,
            inputs=lambda: _inputs_of(logs, command.shape[1], batch.size),
            effort=self.effort,
            extra=extra,
        )

    def simulate(self, setup: Setup, borders: IntArray) -> States:
        """Roll out on the simulator of these numerics."""
        return get_simulator(self.numerics.simulator).rollout(setup, borders, threads=self.threads)

    def _go(self, setup: Setup, pairs: Values, grid: Grid) -> Outputs:
        """Simulate, and read the sensors."""
        return self.read(setup, slice(None), pairs, self.simulate(setup, grid.state), grid)

    def read(self, setup: Setup, rows: slice, pairs: Values, states: States, grid: Grid) -> Outputs:
        """Sensors in some rows of a rollout; values and states are of these rows."""
        position, velocity = at_samples(grid, states.position, states.velocity)
        effort = None
        if self.effort and states.effort is not None:
            effort = states.effort[:, grid.before]
        elif self.effort:
            motor, motor_velocity = at_samples(grid, states.motor, states.motor_velocity)
            steps = np.minimum(grid.state[grid.before], grid.steps - 1)
            effort = ServoLaw.of(setup.batch, rows).torque(setup.command[rows][:, steps], motor, motor_velocity)
        base = None if states.base is None else states.base[:, grid.before]
        began = np.broadcast_to(setup.began, setup.size)[rows]
        outputs = Outputs(grid.sample_time, position, velocity, effort, base, began)
        for term, values in pairs:
            term.read_out(setup.batch, values, outputs)
        bad = ~np.isfinite(outputs.position).all(axis=(1, 2)) | states.failed
        for array in (outputs.position, outputs.velocity, outputs.effort, outputs.base):
            if array is not None:
                array[bad] = np.nan
        return outputs


def _inputs_of(logs: Sequence[tuple[Log, Grid]], steps: int, rows: int) -> dict[str, FloatArray]:
    """Measured drive inputs, (steps, rows), of logs that each own an equal share of the rows."""
    own = [step_inputs(log, even_borders(steps, grid.timestep)) for log, grid in logs]
    share = rows // len(logs)
    return {name: np.repeat(np.stack([inputs[name] for inputs in own], axis=1), share, axis=1) for name in own[0]}
