"""Rollouts step by step, for what an engine cannot do by itself: servos that hold their torque, laws of terms.

All of it is compiled, and in one file: machine code is kept beside its source, and made anew when that changes and not
when another file does. See `laws` for how a law becomes machine code.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numba
import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from sysid_btr._typing import BoolArray, FloatArray, IntArray
from sysid_btr.simulation.laws import Laws, compiled, table_of
from sysid_btr.simulation.servo import ServoLaw
from sysid_btr.simulation.setup import Setup
from sysid_btr.simulation.simulator import States
from sysid_btr.terms.law import ROWS, Step

COMMAND, QPOS, QVEL, TORQUE, PROPORTIONAL, LOAD, VOLTAGE, ENABLED, GAIN, MOTOR, JOINT, FRICTION, LOW, HIGH = range(ROWS)
"""Rows of a step's arrays, in the order of `Step`."""


class Plan(NamedTuple):
    """What is the same for all candidates of a setup; attributes as of `Setup` and `JointAddresses`.

    Attributes
    ----------
    servo, limit, friction : whether a law changes these.
    driven : (d,) positions among the joints of those with a drive.
    """

    laws: Laws
    timestep: float
    steps: int
    held_steps: int
    servo: bool
    limit: bool
    friction: bool
    qpos: IntArray
    dof: IntArray
    scale: FloatArray
    driven: IntArray
    actuator: IntArray
    control: IntArray


class Candidates(NamedTuple):
    """What candidates (m,) differ in.

    Attributes
    ----------
    command, command_of : (u, steps, j), and which of them each has, (m,).
    awake : (m, laws) which laws do anything.
    voltage, enabled, applied, control : (m, steps, j or c), or (0, 0, 0) where there are none.
    gear, gain, constant, stiffness, damping, least, most : (m, d) of the servos, see `ServoLaw`.
    low, high : (m, j).
    began : (m,) s on the clock of the log at the first step.
    numbers : (m, n) of the laws.
    own_gain, own_bias, own_friction : actuator_gainprm and actuator_biasprm (m, d, 10), dof_frictionloss (m, j), as
        they are without laws.
    """

    command: FloatArray
    command_of: IntArray
    awake: BoolArray
    voltage: FloatArray
    enabled: FloatArray
    applied: FloatArray
    control: FloatArray
    gear: FloatArray
    gain: FloatArray
    constant: FloatArray
    stiffness: FloatArray
    damping: FloatArray
    least: FloatArray
    most: FloatArray
    low: FloatArray
    high: FloatArray
    began: FloatArray
    numbers: FloatArray
    own_gain: FloatArray
    own_bias: FloatArray
    own_friction: FloatArray


class Engine(NamedTuple):
    """One candidate's arrays in a simulator, by MuJoCo's names, which are read and written in place."""

    qpos: FloatArray
    qvel: FloatArray
    ctrl: FloatArray
    qfrc_applied: FloatArray
    qfrc_bias: FloatArray
    actuator_gainprm: FloatArray
    actuator_biasprm: FloatArray
    actuator_forcelimited: BoolArray
    actuator_forcerange: FloatArray
    actuator_ctrllimited: BoolArray
    dof_frictionloss: FloatArray


STATE = Engine._fields[:5]
"""Arrays of an engine that are of MjData, those after them of MjModel."""


class Memory(NamedTuple):
    """What is remembered of a candidate from step to step: arrays of `Step`, velocities, held torques, laws' memory."""

    step: FloatArray
    q: FloatArray
    v: FloatArray
    before: FloatArray
    held: FloatArray
    laws: FloatArray


def plan_of(setup: Setup) -> tuple[Plan, Candidates]:
    """A setup as compiled code takes it."""
    batch, index = setup.batch, setup.index
    law, acts = ServoLaw.of(batch), setup.acts
    laws, numbers, awake = table_of(setup.laws, setup.size)
    actuator = index.actuator[law.driven]
    command, command_of = _apart(setup.command)
    plan = Plan(
        laws,
        batch.timestep,
        setup.steps,
        setup.held_steps,
        "servo" in acts,
        "limit" in acts,
        "friction" in acts,
        np.ascontiguousarray(index.qpos),
        np.ascontiguousarray(index.dof),
        np.ascontiguousarray(index.scale),
        np.ascontiguousarray(law.driven),
        np.ascontiguousarray(actuator),
        np.ascontiguousarray(index.control),
    )
    shape = (setup.size, len(law.driven))
    none = np.zeros((0, 0, 0))
    floats = (
        *_inputs(setup),
        *(none if x is None else x for x in (setup.applied, setup.control)),
        *(law.gear, law.gain, law.constant, law.stiffness, law.damping),
        *(np.broadcast_to(x, shape) for x in (law.least, law.most)),
        *(law.low, law.high, np.broadcast_to(setup.began, setup.size), numbers),
        *(batch.read(name)[:, actuator] for name in ("actuator_gainprm", "actuator_biasprm")),
        batch.read("dof_frictionloss")[:, index.dof],
    )
    rest = [np.ascontiguousarray(x, dtype=np.float64) for x in floats]
    return plan, Candidates(command, command_of, awake, *rest)


def written(setup: Setup) -> tuple[str, ...]:
    """Fields of the model that the steps of a setup write, beside those that candidates differ in."""
    acts, held = setup.acts, bool(setup.held_steps)
    names = {
        "dof_frictionloss": "friction" in acts,
        "actuator_gainprm": held or "servo" in acts,
        "actuator_biasprm": held or "servo" in acts,
        "actuator_forcelimited": held or "limit" in acts,
        "actuator_forcerange": "limit" in acts,
        "actuator_ctrllimited": held,
    }
    return tuple(name for name, is_written in names.items() if is_written)


def _apart(values: FloatArray) -> tuple[FloatArray, IntArray]:
    """(u, ...) the different ones among values (m, ...), and which of them each is; equal ones are one broadcast."""
    if values.strides[0] == 0:
        return np.array(values[:1], dtype=np.float64, order="C"), np.zeros(len(values), dtype=np.int64)
    return np.ascontiguousarray(values, dtype=np.float64), np.arange(len(values))


def _inputs(setup: Setup) -> tuple[FloatArray, FloatArray]:
    """Voltages and flags of the drives, (m, steps, j) each; (0, 0, 0) where none are logged."""
    joints, found = setup.index.joints, []
    for kind, missing in (("voltage", np.nan), ("enabled", 1.0)):
        given = {j: setup.inputs[name] for j, joint in enumerate(joints) if (name := f"{kind}.{joint}") in setup.inputs}
        values = np.full((setup.size, setup.steps, len(joints)) if given else (0, 0, 0), missing)
        for j, own in given.items():
            values[:, :, j] = own.T
        found.append(values)
    return found[0], found[1]


def _call_law(typing: Any, address: Any, step: Any, numbers: Any, memory: Any, places: Any) -> Any:
    """Call a law by its address."""

    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        kinds = [context.get_value_type(kind) for kind in signature.args[1:]]
        code = builder.inttoptr(values[0], ir.FunctionType(context.get_value_type(types.none), kinds).as_pointer())
        builder.call(code, values[1:])
        return context.get_dummy_value()

    return types.void(address, step, numbers, memory, places), generate


call_law = intrinsic(_call_law)


def _step(time: float, timestep: float, rows: Any) -> Step:
    """A step whose arrays are rows (ROWS, j)."""
    return Step(
        time,
        timestep,
        rows[COMMAND],
        rows[QPOS],
        rows[QVEL],
        rows[TORQUE],
        rows[PROPORTIONAL],
        rows[LOAD],
        rows[VOLTAGE],
        rows[ENABLED],
        rows[GAIN],
        rows[MOTOR],
        rows[JOINT],
        rows[FRICTION],
        rows[LOW],
        rows[HIGH],
    )


step_of = compiled(_step)


def _apply(laws: Laws, numbers: Any, awake: Any, memory: Any, step: Step) -> None:
    """Let laws act on a step of one candidate, whose numbers and memory they are."""
    for n in range(len(laws.address)):
        if not awake[n]:
            continue
        own = numbers[laws.number[n] : laws.number[n + 1]].reshape(laws.rows[n], laws.width[n])
        kept = memory[laws.memory[n] : laws.memory[n + 1]].reshape(laws.rows[n], laws.kept[n])
        call_law(laws.address[n], step, own, kept, laws.places[laws.place[n] : laws.place[n + 1]])


apply_laws = compiled(_apply)


def _commanded(i: int, d: int, own: Candidates, command: float) -> float:
    """What a servo makes of its command, within its range."""
    return float(own.gain[i, d] * min(max(command, own.least[i, d]), own.most[i, d]))


commanded_of = compiled(_commanded)


def _torque(i: int, plan: Plan, own: Candidates, command: Any, q: Any, v: Any, torque: Any) -> None:
    """Torques (j,) that the servos would like to give."""
    torque[:] = 0.0
    for d in range(len(plan.driven)):
        j = plan.driven[d]
        total = commanded_of(i, d, own, command[j]) + own.constant[i, d]
        total = total + own.stiffness[i, d] * q[j] + own.damping[i, d] * v[j]
        torque[j] = total * own.gear[i, d]


torque_of = compiled(_torque)


def _proportional(i: int, plan: Plan, own: Candidates, step: Any) -> None:
    """Write the part of the servos' torques that position servos give by their stiffness."""
    for d in range(len(plan.driven)):
        j = plan.driven[d]
        if own.stiffness[i, d] != 0.0:
            total = commanded_of(i, d, own, step[COMMAND, j])
            step[PROPORTIONAL, j] = (total + own.stiffness[i, d] * step[QPOS, j]) * own.gear[i, d]


write_proportional = compiled(_proportional)


def _given(i: int, plan: Plan, own: Candidates, memory: Memory, torque: Any) -> None:
    """Torques (j,) of the servos at the start of the present step, under its laws."""
    step = memory.step
    torque_of(i, plan, own, step[COMMAND], memory.q, memory.v, torque)
    for j in range(len(torque)):
        asked = step[GAIN, j] * torque[j] + step[MOTOR, j]
        torque[j] = min(max(asked, step[LOW, j]), step[HIGH, j])


given_torque = compiled(_given)


def _begin(i: int, plan: Plan, own: Candidates, engine: Engine) -> Memory:
    """Memory of a candidate at the start, and a model whose actuators give the torque that is asked of them."""
    joints = len(plan.dof)
    if plan.held_steps > 0:
        for a in plan.actuator:
            engine.actuator_gainprm[a] = 0.0
            engine.actuator_gainprm[a, 0] = 1.0
            engine.actuator_biasprm[a] = 0.0
            engine.actuator_forcelimited[a] = False
            engine.actuator_ctrllimited[a] = False
    step = np.zeros((ROWS, joints))
    step[VOLTAGE], step[ENABLED] = np.nan, 1.0
    q, v, before, held = np.zeros(joints), np.zeros(joints), np.zeros(joints), np.zeros(len(plan.driven))
    return Memory(step, q, v, before, held, np.zeros(plan.laws.memory[-1]))


begin = compiled(_begin)


def _act(k: int, i: int, plan: Plan, own: Candidates, engine: Engine, memory: Memory) -> None:
    """Write what acts on candidate i during step k: servos, laws and known torques."""
    step, q, v, laws = memory.step, memory.q, memory.v, len(plan.laws.address) > 0
    step[COMMAND] = own.command[own.command_of[i], k]
    step[GAIN], step[MOTOR], step[JOINT], step[FRICTION] = 1.0, 0.0, 0.0, 0.0
    step[LOW], step[HIGH] = own.low[i], own.high[i]
    for j in range(len(q)):
        q[j], v[j] = engine.qpos[plan.qpos[j]], engine.qvel[plan.dof[j]]
    if laws:
        h = plan.timestep
        for j in range(len(q)):
            step[QVEL, j] = 1.5 * v[j] - 0.5 * (v[j] if k == 0 else memory.before[j])
            step[QPOS, j] = q[j] + 0.5 * h * step[QVEL, j]
            memory.before[j] = v[j]
            step[LOAD, j] = engine.qfrc_bias[plan.dof[j]]
        if own.voltage.size:
            step[VOLTAGE] = own.voltage[i, k]
        if own.enabled.size:
            step[ENABLED] = own.enabled[i, k]
        torque_of(i, plan, own, step[COMMAND], step[QPOS], step[QVEL], step[TORQUE])
        step[TORQUE] = np.minimum(np.maximum(step[TORQUE], step[LOW]), step[HIGH])
        write_proportional(i, plan, own, step)
        now = step_of(own.began[i] + (k * h + 0.5 * h), h, step)
        apply_laws(plan.laws, own.numbers[i], own.awake[i], memory.laws, now)
        if plan.friction:
            for j in range(len(q)):
                engine.dof_frictionloss[plan.dof[j]] = max(own.own_friction[i, j] + step[FRICTION, j], 0.0)
    if plan.held_steps > 0:
        if k % plan.held_steps == 0:
            torque = np.empty(len(q))
            given_torque(i, plan, own, memory, torque)
            for d in range(len(plan.driven)):
                memory.held[d] = torque[plan.driven[d]] / own.gear[i, d]
        for d in range(len(plan.driven)):
            engine.ctrl[plan.actuator[d]] = memory.held[d]
    else:
        for d in range(len(plan.driven)):
            a, j = plan.actuator[d], plan.driven[d]
            engine.ctrl[a] = step[COMMAND, j] * plan.scale[j]
            if plan.servo:
                engine.actuator_gainprm[a] = own.own_gain[i, d] * step[GAIN, j]
                engine.actuator_biasprm[a] = own.own_bias[i, d] * step[GAIN, j]
                engine.actuator_biasprm[a, 0] += step[MOTOR, j] / own.gear[i, d]
            if plan.limit:
                # limits are torques at the joint, MuJoCo's are forces before the gear, which may turn the other way
                low, high = step[LOW, j] / own.gear[i, d], step[HIGH, j] / own.gear[i, d]
                low, high = min(low, high), max(low, high)
                engine.actuator_forcelimited[a] = np.isfinite(low) or np.isfinite(high)
                engine.actuator_forcerange[a, 0] = low if np.isfinite(low) else 0.0
                engine.actuator_forcerange[a, 1] = high if np.isfinite(high) else 0.0
    if own.control.size:
        for c in range(len(plan.control)):
            engine.ctrl[plan.control[c]] = own.control[i, k, c]
    if laws or own.applied.size:
        for j in range(len(q)):
            known = own.applied[i, k, j] if own.applied.size else 0.0
            engine.qfrc_applied[plan.dof[j]] = step[JOINT, j] + known


act = compiled(_act)


class Calls(NamedTuple):
    """Addresses of MuJoCo's functions, and of a model and data of a thread's own."""

    reset: int
    step: int
    model: int
    data: int


class Copies(NamedTuple):
    """What is copied before a candidate's rollout: where to, from where, and bytes of each row, (n,)."""

    target: IntArray
    source: IntArray
    size: IntArray


class Thread(NamedTuple):
    """What a thread simulates with; `warnings` are MuJoCo's counts."""

    calls: Calls
    copies: Copies
    engine: Engine
    warnings: Any


class Kept(NamedTuple):
    """What is kept of candidates: states (m, k, ...) at borders (k,), torques (m, k, j) or none; who failed, (m,)."""

    borders: IntArray
    qpos: FloatArray
    qvel: FloatArray
    effort: FloatArray
    failed: Any


def _pointer(typing: Any, address: Any) -> Any:
    """An address as a pointer to bytes."""

    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        return builder.inttoptr(values[0], context.get_value_type(signature.return_type))

    return types.CPointer(types.uint8)(address), generate


def _call(typing: Any, address: Any, one: Any, other: Any) -> Any:
    """Call a C function of two pointers, all by their addresses."""

    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        kind = ir.FunctionType(ir.VoidType(), [values[1].type, values[2].type])
        builder.call(builder.inttoptr(values[0], kind.as_pointer()), values[1:])
        return context.get_dummy_value()

    return types.void(address, one, other), generate


pointer, call = intrinsic(_pointer), intrinsic(_call)


def _roll(first: int, last: int, plan: Plan, own: Candidates, thread: Thread, kept: Kept, stop: IntArray) -> None:
    """Roll out the candidates from `first` to before `last`, unless told to stop."""
    calls, copies, engine = thread.calls, thread.copies, thread.engine
    for i in range(first, last):
        if stop[0]:
            return
        call(calls.reset, calls.model, calls.data)
        for c in range(len(copies.size)):
            size = copies.size[c]
            target = numba.carray(pointer(copies.target[c]), (size,))
            target[:] = numba.carray(pointer(copies.source[c] + i * size), (size,))
        memory, slot = begin(i, plan, own, engine), 0
        for k in range(plan.steps + 1):
            wanted = slot < len(kept.borders) and kept.borders[slot] == k
            if wanted:
                kept.qpos[i, slot], kept.qvel[i, slot] = engine.qpos, engine.qvel
            if k == plan.steps:
                break
            act(k, i, plan, own, engine, memory)
            if wanted:
                if kept.effort.size:
                    given_torque(i, plan, own, memory, kept.effort[i, slot])
                slot += 1
            call(calls.step, calls.model, calls.data)
            # MuJoCo has reset the state of one that diverges, which it could not have collided
            if thread.warnings.any():
                kept.failed[i] = True
                break


roll = compiled(_roll)


SETTLED = 1e-7
"""Relative change of a torque under laws that follow it, from which it has settled; the last step leaves less."""
STEEPEST = -0.1
"""Slope of what laws make of a torque less that torque itself, up to which a secant is followed: where laws add as much
as they are given, it is 0 and there is no one solution."""


class Samples(NamedTuple):
    """Samples (n, j) of a motion, and what it takes.

    Attributes
    ----------
    position, velocity, direction : the last as dry friction has it.
    smooth, load : torques without dry friction and laws, and those that load the joints.
    """

    position: FloatArray
    velocity: FloatArray
    direction: FloatArray
    smooth: FloatArray
    load: FloatArray


def _on_samples(
    laws: Laws,
    numbers: FloatArray,
    awake: BoolArray,
    period: float,
    rounds: int,
    samples: Samples,
    dry: FloatArray,
    torque: FloatArray,
) -> None:
    """Find the torques (n, j) of drives under laws without memory, which may follow them, from those that are there.

    `rounds` is how often laws are asked at most; `dry` is the friction (j,) that there is without laws.
    """
    rows, memory = np.zeros((ROWS, len(dry))), np.zeros(0)
    rows[VOLTAGE], rows[ENABLED] = np.nan, 1.0
    step, before, excess = step_of(0.0, period, rows), np.zeros(len(dry)), np.zeros(len(dry))
    for i in range(len(torque)):
        rows[COMMAND], rows[QPOS], rows[QVEL] = samples.position[i], samples.position[i], samples.velocity[i]
        rows[LOAD] = samples.load[i]
        for k in range(rounds):
            rows[TORQUE], rows[GAIN], rows[LOW], rows[HIGH] = torque[i], 1.0, -np.inf, np.inf
            rows[MOTOR], rows[JOINT], rows[FRICTION] = 0.0, 0.0, 0.0
            apply_laws(laws, numbers, awake, memory, step)
            settled = True
            for j in range(len(dry)):
                rubbed = max(dry[j] + rows[FRICTION, j], 0.0) * samples.direction[i, j]
                now, own = torque[i, j], samples.smooth[i, j] + rubbed - rows[JOINT, j]
                beyond = own - now
                settled = settled and abs(beyond) <= SETTLED * abs(own)
                # the secant through the last two, joint by joint; the first step goes to what the laws give
                slope = (beyond - excess[j]) / (now - before[j]) if k > 0 and now != before[j] else -1.0
                before[j], excess[j] = now, beyond
                torque[i, j] = now - beyond / slope if slope < STEEPEST else own
            if settled:
                break


on_samples = compiled(_on_samples)


def step_through(setup: Setup, borders: IntArray, arrays: Callable[[str], Any], advance: Callable[[], None]) -> States:
    """Roll out by steps of a simulator, between which servos and laws act on its arrays.

    For simulators that are not built in; `mujoco_steps` has a loop that is compiled as a whole.

    Parameters
    ----------
    setup, borders : as of `Simulator.rollout`.
    arrays : MuJoCo's name of one of the arrays of an `Engine` -> it with all candidates, (m, ...): compiled fields with
        the candidates' numbers in them, and data in the initial state.
    advance : takes one step of all candidates, from these arrays to these arrays.
    """
    plan, own = plan_of(setup)
    whole = [arrays(name) for name in Engine._fields]
    engines = [Engine(*(array[i] for array in whole)) for i in range(setup.size)]
    memories = [begin(i, plan, own, engine) for i, engine in enumerate(engines)]
    positions, velocities = (np.empty((setup.size, len(borders), array.shape[1])) for array in whole[:2])
    states = States.empty(setup.size, len(borders), setup.index, effort=gives_effort(setup))
    slots = {int(border): slot for slot, border in enumerate(borders)}
    for k in range(setup.steps + 1):
        slot = slots.get(k)
        if slot is not None:
            positions[:, slot], velocities[:, slot] = whole[0], whole[1]
        if k == setup.steps:
            break
        for i, (engine, memory) in enumerate(zip(engines, memories, strict=True)):
            act(k, i, plan, own, engine, memory)
            if slot is not None and states.effort is not None:
                given_torque(i, plan, own, memory, states.effort[i, slot])
        advance()
    states.put(setup.index, np.arange(len(borders)), positions, velocities)
    states.repeat_last_effort()
    return states


def gives_effort(setup: Setup) -> bool:
    """Whether torques are asked for that are others than those of the servos' own law in the present state."""
    alters = setup.held_steps > 0 or not setup.acts.isdisjoint({"servo", "limit"})
    return setup.effort and bool(setup.laws) and alters
