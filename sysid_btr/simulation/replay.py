"""CPU replay engine: one log under many candidates on `mujoco.batch.Batch`.

A `Replay` compiles its model once. Candidates are rows of numbers that terms write into expanded
compiled fields; they run in chunks, and a chunk in segments of steps, so that memory stays bounded
whatever the number of candidates and the length of the log.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any

import numpy as np

from sysid_btr._typing import FloatArray, IntArray
from sysid_btr.models.robot import Robot
from sysid_btr.simulation.compiling import compile_model, made_elsewhere, make_index
from sysid_btr.simulation.grid import Grid, at_samples, make_grid, step_inputs
from sysid_btr.simulation.numerics import Numerics
from sysid_btr.simulation.servo import servo_torque
from sysid_btr.simulation.setup import set_out, write_model
from sysid_btr.simulation.silence import silenced
from sysid_btr.simulation.start import initial_state
from sysid_btr.terms.base import BatchModel, JointAddresses, Outputs, Parameter, Step, Term

if TYPE_CHECKING:
    import mujoco

    from sysid_btr.io.log import Log

CHUNK = 32
"""Candidates simulated together, at least; enough to share the cost of a Python step, few enough for the cache."""
CHUNK_DOFS = 704
"""Degrees of freedom simulated together, at least: small models share a step among more candidates."""
SEGMENT = 1024
"""Steps per rollout call; bounds the records that are held at once."""


@dataclass(frozen=True)
class Replay:
    """One episode of a log, a robot and its terms, ready to be run under candidates.

    Attributes
    ----------
    robot, log, terms, numerics : what is replayed and how.
    effort : whether servo torques are predicted too.
    threads : worker threads, 0 for all cores.
    """

    robot: Robot
    log: Log
    terms: tuple[Term, ...]
    numerics: Numerics
    effort: bool = False
    threads: int = 0

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Free numbers of a candidate, in the order of its columns."""
        return tuple(p for term in self.terms for p in term.parameters)

    def __getstate__(self) -> dict[str, Any]:
        """What another process needs to simulate the same: the compiled model in place of what makes it.

        It runs there on one thread: who sends it has many of them run side by side.
        """
        own = {f.name: getattr(self, f.name) for f in fields(self)}
        made = {name: getattr(self, name) for name in ("model", "index", "start", "grid")}
        robot = replace(self.robot, make_spec=made_elsewhere, configure=None)
        return {**own, **made, "robot": robot, "threads": 1}

    @property
    def all_terms(self) -> tuple[Term, ...]:
        return (*self.robot.always, *self.terms)

    @cached_property
    def model(self) -> mujoco.MjModel:
        """The compiled model, with the structure that the terms ask for."""
        return compile_model(self.robot, self.log, self.all_terms, self.numerics)

    @cached_property
    def index(self) -> JointAddresses:
        return make_index(self.model)

    @cached_property
    def start(self) -> tuple[FloatArray, FloatArray]:
        """Initial positions and velocities of the joints, (j,) each."""
        return initial_state(self.log, self.index.joints, self.model.qpos0[self.index.qpos])

    @cached_property
    def grid(self) -> Grid:
        return make_grid(self.log, self.index.joints, self.start[0], self.numerics.timestep)

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
            raise ValueError(
                f"candidates have {candidates.shape[1]} numbers, expected {len(self.parameters)}"
            )
        size = max(CHUNK, CHUNK_DOFS // max(self.model.nv, 1))
        for first in range(0, len(candidates), size):
            rows = slice(first, min(first + size, len(candidates)))
            with silenced():
                outputs = self._run(candidates[rows])
            yield rows, outputs

    def _values(self, candidates: FloatArray) -> list[tuple[Term, FloatArray]]:
        pairs, column = [], 0
        for term in self.all_terms:
            count = len(term.parameters)
            pairs.append((term, term.spread(candidates[:, column : column + count])))
            column += count
        return pairs

    def _run(self, candidates: FloatArray) -> Outputs:
        from mujoco.batch import Batch

        m = len(candidates)
        pairs = self._values(candidates)
        batch = Batch(self.model, m, self.threads)
        rig = BatchModel(self.model, batch, self.index, self.numerics.timestep)
        write_model(rig, pairs)
        qpos = np.tile(self.start[0], (m, 1))
        qvel = np.tile(self.start[1], (m, 1))
        command: FloatArray = np.broadcast_to(self.grid.command, (m, *self.grid.command.shape))
        command, applied = set_out(rig, pairs, qpos, qvel, command, self.grid.steps)
        return self._go(rig, pairs, command, applied, self.grid)

    def _go(
        self,
        rig: BatchModel,
        pairs: list[tuple[Term, FloatArray]],
        command: FloatArray,
        applied: FloatArray | None,
        grid: Grid,
    ) -> Outputs:
        """Simulate from the state that the batch is in, and read the sensors."""
        states = self.integrate(rig, pairs, command, applied, grid, ((self.log, grid),))
        return self.read(rig, slice(None), pairs, states, command, grid)

    def integrate(
        self,
        rig: BatchModel,
        pairs: list[tuple[Term, FloatArray]],
        command: FloatArray,
        applied: FloatArray | None,
        grid: Grid,
        logs: Sequence[tuple[Log, Grid]],
    ) -> States:
        """Simulate from the state that the batch is in; each of the logs owns an equal share of its rows."""
        laws = [(mod, val) for mod, val in pairs if type(mod).overrides("law")]
        run = self._roll_out if self.numerics.servo_period is None else self._hold_through
        if laws:
            # what a servo does comes before what depends on it
            laws.sort(key=lambda law: law[0].law_acts == ("friction",))
            run = partial(self._step_through, laws=laws, inputs=inputs_of(logs, grid.steps, rig.size))
        return run(rig, command=command, applied=applied, grid=grid)

    def read(
        self,
        rig: BatchModel,
        rows: slice,
        pairs: list[tuple[Term, FloatArray]],
        states: States,
        command: FloatArray,
        grid: Grid,
    ) -> Outputs:
        """Sensors in some rows of a batch; values, states and commands are of these rows."""
        position, velocity = at_samples(grid, states.position, states.velocity)
        effort = None
        if self.effort:
            motor, motor_velocity = at_samples(grid, states.motor, states.motor_velocity)
            effort = states.effort
            if effort is None:
                steps = np.minimum(grid.state[grid.before], grid.steps - 1)
                effort = servo_torque(rig, command[:, steps], motor, motor_velocity, rows)
            else:
                effort = effort[:, grid.before]
        base = None if states.base is None else states.base[:, grid.before]
        outputs = Outputs(grid.sample_time, position, velocity, effort, base)
        for term, values in pairs:
            term.read_out(rig, values, outputs)
        warned = rig.simulations.warning[rows, :, 1].sum(axis=1) > 0
        bad = ~np.isfinite(outputs.position).all(axis=(1, 2)) | warned
        for array in (outputs.position, outputs.velocity, outputs.effort, outputs.base):
            if array is not None:
                array[bad] = np.nan
        return outputs

    def _roll_out(self, rig: BatchModel, command: FloatArray, applied: FloatArray | None, grid: Grid) -> States:
        import mujoco

        batch, index, keep = rig.simulations, self.index, grid.state
        states = States.empty(rig.size, len(keep), index)
        states.put(index, np.array([0]), batch.bind("qpos")[:, None], batch.bind("qvel")[:, None])
        spec = int(mujoco.mjtState.mjSTATE_CTRL.value)
        nu, nv = self.model.nu, self.model.nv
        if applied is not None:
            spec |= int(mujoco.mjtState.mjSTATE_QFRC_APPLIED.value)
        driven = index.actuator >= 0
        for first in range(0, grid.steps, SEGMENT):
            last = min(first + SEGMENT, grid.steps)
            control = np.zeros((rig.size, last - first, nu + (0 if applied is None else nv)))
            control[:, :, index.actuator[driven]] = command[:, first:last, driven]
            if applied is not None:
                control[:, :, nu + index.dof] = applied[:, first:last]
            records = batch.rollout(last - first, control, spec, record=("qpos", "qvel"))
            wanted = np.flatnonzero((keep > first) & (keep <= last))
            local = keep[wanted] - first - 1
            states.put(index, wanted, records["qpos"][:, local], records["qvel"][:, local])
        return states

    def _hold_through(
        self, rig: BatchModel, command: FloatArray, applied: FloatArray | None, grid: Grid
    ) -> States:
        """From one tick of digital servos to the next: their torque is computed at the tick and held."""
        batch, index, keep = rig.simulations, self.index, grid.state
        drive = _Drive(rig)
        d, driven = drive.driven, drive.actuators
        qpos, qvel, ctrl = batch.bind("qpos"), batch.bind("qvel"), batch.bind("ctrl")
        qfrc = batch.bind("qfrc_applied")
        low, high = np.sort(np.stack([drive.low[:, d], drive.high[:, d]]) / drive.gear, axis=0)
        asked = drive.base_gain[None, :, :, 0] * np.moveaxis(command[:, :, d], 1, 0) + drive.base_bias[..., 0]
        stiffness = drive.base_bias[..., 1] * drive.gear
        damping = drive.base_bias[..., 2] * drive.gear
        at, speed = index.qpos[d], index.dof[d]
        records_q = np.empty((rig.size, len(keep), self.model.nq))
        records_v = np.empty((rig.size, len(keep), self.model.nv))
        drive.gainprm[:, driven] = 0.0
        drive.gainprm[:, driven, 0] = 1.0
        drive.biasprm[:, driven] = 0.0
        drive.forcelimited[:, driven] = False
        slot, period = 0, self.numerics.held_steps
        for k in range(grid.steps):
            if slot < len(keep) and keep[slot] == k:
                records_q[:, slot], records_v[:, slot] = qpos, qvel
                slot += 1
            if k % period == 0:
                force = asked[k] + stiffness * qpos[:, at] + damping * qvel[:, speed]
                ctrl[:, driven] = np.minimum(np.maximum(force, low), high)
            if applied is not None:
                qfrc[:, index.dof] = applied[:, k]
            batch.step()
        records_q[:, -1], records_v[:, -1] = qpos, qvel
        drive.restore()
        states = States.empty(rig.size, len(keep), index)
        states.put(index, np.arange(len(keep)), records_q, records_v)
        return states

    def _step_through(
        self,
        rig: BatchModel,
        laws: list[tuple[Term, FloatArray]],
        command: FloatArray,
        applied: FloatArray | None,
        grid: Grid,
        inputs: dict[str, FloatArray],
    ) -> States:
        """Step by step, for laws that MuJoCo cannot hold; all candidates of the chunk at once."""
        batch, index = rig.simulations, self.index
        h = grid.timestep
        states = States.empty(rig.size, len(grid.state), index, effort=self.effort)
        drive = _Drive(rig)
        memory = [
            (term, values, term.start_law(rig, values), law_index(index, term))
            for term, values in laws
        ]
        acts = frozenset(name for term, _ in laws for name in term.law_acts)
        held_steps = self.numerics.held_steps
        held: FloatArray | None = None
        # laws that leave the servo alone leave its torque a function of command and state
        measured = states.effort if held_steps or acts & {"servo", "limit"} else None
        qpos_view, qvel_view, ctrl = batch.bind("qpos"), batch.bind("qvel"), batch.bind("ctrl")
        qfrc, bias = batch.bind("qfrc_applied"), batch.bind("qfrc_bias")
        previous = qvel_view[:, index.dof].copy()
        slot = 0
        for k in range(grid.steps):
            q, v = qpos_view[:, index.qpos], qvel_view[:, index.dof]
            if slot < len(grid.state) and grid.state[slot] == k:
                states.store(index, slot, q, v, qpos_view, qvel_view)
                slot += 1
            v_mid = 1.5 * v - 0.5 * previous
            q_mid = q + 0.5 * h * v_mid
            previous = v.copy()
            step = drive.begin(k * h + 0.5 * h, h, command[:, k], q_mid, v_mid)
            step.inputs = {name: values[k] for name, values in inputs.items()}
            step.load = bias[:, index.dof]
            for term, values, state, places in memory:
                term.law(step, values, state, places)
            if held_steps and k % held_steps == 0:
                held = drive.torque(step, command[:, k], q, v)
            drive.write(step, acts, held)
            if measured is not None and slot > 0 and grid.state[slot - 1] == k:
                measured[:, slot - 1] = drive.torque(step, command[:, k], q, v)
            ctrl[:, drive.actuators] = command[:, k][:, drive.driven]
            joint_torque = step.joint_torque if applied is None else step.joint_torque + applied[:, k]
            qfrc[:, index.dof] = joint_torque
            batch.step()
        q, v = qpos_view[:, index.qpos], qvel_view[:, index.dof]
        states.store(index, len(grid.state) - 1, q, v, qpos_view, qvel_view)
        if states.effort is not None and measured is None:
            known = slice(len(grid.state) - 1)
            asked = command[:, grid.state[known]]
            states.effort[:, known] = servo_torque(rig, asked, states.motor[:, known], states.motor_velocity[:, known])
        states.repeat_last_effort()
        return states


@dataclass
class States:
    """States kept at step borders, (m, kept, joints)."""

    position: FloatArray
    velocity: FloatArray
    motor: FloatArray
    motor_velocity: FloatArray
    effort: FloatArray | None = None
    base: FloatArray | None = None

    @classmethod
    def empty(cls, m: int, kept: int, index: JointAddresses, *, effort: bool = False) -> States:
        def new() -> FloatArray:
            return np.empty((m, kept, len(index.joints)))

        motor, motor_velocity = new(), new()
        # without a link side, the sensor sees the motor side
        position, velocity = (new(), new()) if (index.link_qpos >= 0).any() else (motor, motor_velocity)
        base = np.empty((m, kept, 13)) if index.base is not None else None
        return cls(position, velocity, motor, motor_velocity, new() if effort else None, base)

    def of(self, rows: slice, slots: IntArray) -> States:
        """Those of some simulations at some of the borders."""
        linked = self.position is not self.motor
        motor, motor_velocity = self.motor[rows][:, slots], self.motor_velocity[rows][:, slots]
        return States(
            self.position[rows][:, slots] if linked else motor,
            self.velocity[rows][:, slots] if linked else motor_velocity,
            motor,
            motor_velocity,
            None if self.effort is None else self.effort[rows][:, slots],
            None if self.base is None else self.base[rows][:, slots],
        )

    def repeat_last_effort(self) -> None:
        """No step begins at the last border: the servos are taken to do there what they did before."""
        if self.effort is not None:
            self.effort[:, -1] = self.effort[:, -2]

    def put(self, index: JointAddresses, slots: IntArray, qpos: FloatArray, qvel: FloatArray) -> None:
        self.motor[:, slots] = qpos[:, :, index.qpos]
        self.motor_velocity[:, slots] = qvel[:, :, index.dof]
        if self.base is not None and index.base is not None:
            place, motion = index.base
            self.base[:, slots, :7] = qpos[:, :, place : place + 7]
            self.base[:, slots, 7:] = qvel[:, :, motion : motion + 6]
        linked = np.flatnonzero(index.link_qpos >= 0)
        if len(linked):
            self.position[:, slots] = self.motor[:, slots]
            self.velocity[:, slots] = self.motor_velocity[:, slots]
            self.position[:, slots[:, None], linked] += qpos[:, :, index.link_qpos[linked]]
            self.velocity[:, slots[:, None], linked] += qvel[:, :, index.link_dof[linked]]

    def store(
        self, index: JointAddresses, slot: int, q: FloatArray, v: FloatArray, qpos: FloatArray, qvel: FloatArray
    ) -> None:
        """Keep one state: `q` and `v` are the joints' part of `qpos` and `qvel`."""
        if self.position is self.motor and self.base is None:
            self.motor[:, slot], self.motor_velocity[:, slot] = q, v
        else:
            self.put(index, np.array([slot]), qpos[:, None], qvel[:, None])


class _Drive:
    """Per-step access to servos, friction and limits for laws; resets what it added at each step."""

    def __init__(self, rig: BatchModel) -> None:
        index = rig.index
        self.rig = rig
        self.driven = np.flatnonzero(index.actuator >= 0)
        self.actuators = index.actuator[self.driven]
        self.gainprm = rig.array("actuator_gainprm")
        self.biasprm = rig.array("actuator_biasprm")
        self.frictionloss = rig.array("dof_frictionloss")
        self.forcerange = rig.array("actuator_forcerange")
        self.forcelimited = rig.array("actuator_forcelimited")
        self.gear = rig.array("actuator_gear")[:, self.actuators, 0].copy()
        self.base_gain = self.gainprm[:, self.actuators].copy()
        self.base_bias = self.biasprm[:, self.actuators].copy()
        self.base_friction = self.frictionloss[:, index.dof].copy()
        self.base_limited = self.forcelimited[:, self.actuators].copy()
        limited = self.base_limited.astype(bool)
        base = np.sort(self.gear[..., None] * self.forcerange[:, self.actuators], axis=-1)
        shape = (rig.size, len(index.joints))
        self._shape = shape
        self.low, self.high = np.full(shape, -np.inf), np.full(shape, np.inf)
        self.low[:, self.driven] = np.where(limited, base[..., 0], -np.inf)
        self.high[:, self.driven] = np.where(limited, base[..., 1], np.inf)
        self._all = len(self.driven) == len(index.joints)
        gain, bias = self.base_gain, self.base_bias
        self._law = (gain[..., 0], bias[..., 0], bias[..., 1] * self.gear, bias[..., 2] * self.gear)

    def begin(self, time: float, h: float, command: FloatArray, qpos: FloatArray, qvel: FloatArray) -> Step:
        shape = self._shape
        return Step(
            time=time,
            timestep=h,
            command=command,
            qpos=qpos,
            qvel=qvel,
            torque=np.minimum(np.maximum(self._servo(command, qpos, qvel), self.low), self.high),
            gain=np.ones(shape),
            motor_torque=np.zeros(shape),
            joint_torque=np.zeros(shape),
            friction=np.zeros(shape),
            limit_low=self.low.copy(),
            limit_high=self.high.copy(),
            inputs={},
            load=np.zeros(shape),
        )

    def _servo(self, command: FloatArray, qpos: FloatArray, qvel: FloatArray) -> FloatArray:
        kp, constant, stiffness, damping = self._law
        if self._all:
            return np.asarray(self.gear * (kp * command + constant + stiffness * qpos + damping * qvel))
        torque, d = np.zeros(self._shape), self.driven
        torque[:, d] = self.gear * (kp * command[:, d] + constant + stiffness * qpos[:, d] + damping * qvel[:, d])
        return torque

    def torque(self, step: Step, command: FloatArray, qpos: FloatArray, qvel: FloatArray) -> FloatArray:
        """Servo torque at the start of the step, under the step's laws."""
        total = step.gain * self._servo(command, qpos, qvel) + step.motor_torque
        return np.minimum(np.maximum(total, step.limit_low), step.limit_high)

    def restore(self) -> None:
        """Give the servos back what `write` or a held torque took."""
        self.gainprm[:, self.actuators] = self.base_gain
        self.biasprm[:, self.actuators] = self.base_bias
        self.forcelimited[:, self.actuators] = self.base_limited

    def write(self, step: Step, acts: frozenset[str], held: FloatArray | None = None) -> None:
        """Write what the laws changed; `acts` names what they may have, `held` is a servo's held torque."""
        d = self.driven
        if held is not None:
            self.gainprm[:, self.actuators] = 0.0
            self.biasprm[:, self.actuators] = 0.0
            self.biasprm[:, self.actuators, 0] = held[:, d] / self.gear
            self.forcelimited[:, self.actuators] = False
            if "friction" in acts:
                self.frictionloss[:, self.rig.index.dof] = np.maximum(self.base_friction + step.friction, 0.0)
            return
        if "servo" in acts:
            gain = step.gain[:, d, None]
            self.gainprm[:, self.actuators] = self.base_gain * gain
            self.biasprm[:, self.actuators] = self.base_bias * gain
            self.biasprm[:, self.actuators, 0] += step.motor_torque[:, d] / self.gear
        if "friction" in acts:
            self.frictionloss[:, self.rig.index.dof] = np.maximum(self.base_friction + step.friction, 0.0)
        if "limit" not in acts:
            return
        # limits are torques at the joint, MuJoCo's are forces before the gear
        limits = np.stack([step.limit_low[:, d], step.limit_high[:, d]], axis=-1)
        force = np.sort(limits / self.gear[..., None], axis=-1)
        finite = np.isfinite(force).any(axis=-1)
        self.forcelimited[:, self.actuators] = finite
        self.forcerange[:, self.actuators] = np.where(finite[..., None], force, 0.0)


def law_index(index: JointAddresses, term: Term) -> IntArray:
    """Positions of a modifier's places among the joints; every joint for the whole robot."""
    known = set(index.joints)
    if all(place in known for place in term.places):
        return index.of(term.places)
    return np.arange(len(index.joints))


def inputs_of(logs: Sequence[tuple[Log, Grid]], steps: int, rows: int) -> dict[str, FloatArray]:
    """Measured drive inputs, (steps, rows), of logs that each own an equal share of the rows."""
    own = [step_inputs(log, replace(grid, command=np.empty((steps, 0)))) for log, grid in logs]
    share = rows // len(logs)
    return {
        name: np.repeat(np.stack([inputs[name] for inputs in own], axis=1), share, axis=1) for name in own[0]
    }
