"""The checks that every simulator must pass: closed forms, and promises about batches."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np

from sysid_btr._typing import FloatArray, IntArray
from sysid_btr.simulation.compiling import make_index
from sysid_btr.simulation.mujoco_batch import MujocoBatch
from sysid_btr.simulation.setup import Law, Setup
from sysid_btr.simulation.silence import silenced
from sysid_btr.simulation.simulator import Simulator, States
from sysid_btr.terms.base import BatchModel, Fields, Kind, Term
from sysid_btr.terms.law import Step, drive
from sysid_btr.testing.require import require

MASS, STEP, STEPS = 2.0, 0.01, 40
EXACT = 1e-9
"""Rounding, in m or rad, beside motions of about one."""

SLIDERS = """<mujoco><option gravity="0 0 -9.81" timestep="{step}" integrator="{integrator}"/><worldbody>
  <body name="a"><joint name="a" type="slide" axis="1 0 0"/><geom size=".1" mass="2" contype="0"/></body>
  <body name="b"><joint name="b" type="slide" axis="0 0 1"/><geom size=".1" mass="2" contype="0"/></body></worldbody>
  <actuator><motor joint="b"/><motor joint="a"/></actuator></mujoco>"""
"""Two masses that feel nothing but gravity and their motors, which are not in the order of the joints."""

GEARED = SLIDERS.replace(
    '<actuator><motor joint="b"/><motor joint="a"/>',
    """<tendon><fixed name="sum"><joint joint="a" coef="1"/><joint joint="b" coef="2"/></fixed></tendon>
  <actuator><motor joint="b" gear="-4"/><motor name="sum" tendon="sum"/><general joint="a" gainprm="5"/>""",
)
"""The same with a gear and a gain, and an actuator that pulls at both."""

SPRING = """<mujoco><option gravity="0 0 0" timestep="{step}" integrator="{integrator}"/><worldbody>
  <body><joint name="a" type="slide" stiffness="200"/><geom size=".1" mass="2"/></body></worldbody></mujoco>"""
"""A mass on a spring, at 10 rad/s."""

ARM = """<mujoco><option timestep="{step}" integrator="{integrator}"/><worldbody>
  <body name="upper"><joint name="shoulder" axis="0 1 0" damping=".1" armature=".01" frictionloss=".1"/>
    <geom type="capsule" fromto="0 0 0 0 0 -.3" size=".03" mass=".6"/>
    <body name="lower" pos="0 0 -.3"><joint name="elbow" axis="0 1 0" damping=".1" armature=".01"/>
      <geom type="capsule" fromto="0 0 0 0 0 -.3" size=".03" mass=".4"/></body></body></worldbody>
  <actuator><position joint="shoulder" kp="5" kv=".3" gear="2" forcerange="-2 3"/>
    <position joint="elbow" kp="8" kv=".4"/></actuator></mujoco>"""
"""Two links under servos, one of them with a gear and a limited force."""


@dataclass(frozen=True)
class _Push(Term):
    """A law with a memory: a torque that grows from step to step."""

    name: ClassVar[str] = "push"
    kinds: ClassVar[tuple[Kind, ...]] = (Kind("rate", "N/step", 0.0, -10.0, 10.0, 1.0),)
    law_acts: ClassVar[tuple[str, ...]] = ()
    law_memory: ClassVar[int] = 1

    @staticmethod
    def law(step: Step, numbers: FloatArray, memory: FloatArray, places: IntArray) -> None:
        for p, j in enumerate(places):
            memory[p, 0] += numbers[p, 0]
            step.joint_torque[j] += memory[p, 0]


@dataclass(frozen=True)
class _Tired(Term):
    """A law that does all that a law may: it weakens servos, pushes, narrows limits and adds friction, by the load."""

    name: ClassVar[str] = "tired"
    kinds: ClassVar[tuple[Kind, ...]] = (Kind("size", "1", 0.0, 0.0, 1.0, 0.1),)

    @staticmethod
    def law(step: Step, numbers: FloatArray, memory: FloatArray, places: IntArray) -> None:
        for p, j in enumerate(places):
            size = numbers[p, 0]
            step.gain[j] *= 1 - 0.5 * size
            step.motor_torque[j] += 0.3 * size * step.voltage[j]
            step.limit_high[j] = min(step.limit_high[j], 4 - 2 * size)
            step.friction[j] += size * abs(0.1 * step.load[j] + 0.05 * drive(step, j))


def check_simulator(simulator: Simulator) -> None:
    """Run every check of `SIMULATOR_CHECKS` on a simulator.

    Raises
    ------
    AssertionError
        The simulator breaks a promise; the message says which.
    """
    for check in SIMULATOR_CHECKS:
        check(simulator)


def check_order(simulator: Simulator) -> None:
    """Half the step moves a mass on a spring to its closed form as fast as the order of the integrator says."""
    for integrator, order in (("RK4", 4), ("implicitfast", 1)):
        errors = []
        for halvings in (0, 1):
            steps = STEPS * 2**halvings
            batch = _batch(SPRING, 1, integrator, 0.4 / steps)
            setup = _setup(batch, steps, state={"qpos": np.ones((1, 1))})
            found = _run(simulator, setup, np.array([0, steps]))
            errors.append(abs(found.position[0, -1, 0] - np.cos(4.0)))
        require(
            errors[0] < 0.1**order and 0.7 * 2**order < errors[0] / errors[1] < 1.4 * 2**order,
            f"{integrator}: a mass on a spring is {errors[0]:.3g} m from its closed form, by half the step "
            f"{errors[1]:.3g} m; the order is {order}",
        )


def check_commands(simulator: Simulator) -> None:
    """Every row of commands, at every step, reaches the motor of its own joint, in units of the joint.

    Actuators that are commanded by their own name get their ctrl.
    """
    force = np.random.default_rng(0).uniform(-1, 1, (3, STEPS, 2))
    _fly(simulator, _setup(_batch(SLIDERS, 3), STEPS, command=force), force, "commands")
    control = np.random.default_rng(1).uniform(-1, 1, (3, STEPS, 1))
    setup = _setup(_batch(GEARED, 3), STEPS, command=force, control=control)
    _fly(simulator, setup, force + control * [1.0, 2.0], "commands by gears, and of other actuators")


def check_applied(simulator: Simulator) -> None:
    """Torques known in advance act at their joints, at their steps, beside commands."""
    command, applied = np.random.default_rng(1).uniform(-1, 1, (2, 3, STEPS, 2))
    setup = _setup(_batch(SLIDERS, 3), STEPS, command=command, applied=applied)
    _fly(simulator, setup, command + applied, "torques known in advance")


def check_fields(simulator: Simulator) -> None:
    """Every candidate moves with its own numbers, options among them, and with what MuJoCo derives from them."""
    batch, mass = _batch(SLIDERS, 3), np.array([1.0, 2.0, 3.0])
    masses, gravity = batch.read("body_mass"), batch.read("opt.gravity")
    masses[:, 1:], gravity[:, 2] = mass[:, None], [-1.0, 0.0, -9.81]
    batch.write({"body_mass": masses, "opt.gravity": gravity})
    command = np.random.default_rng(2).uniform(-1, 1, (3, STEPS, 2))
    _fly(simulator, _setup(batch, STEPS, command=command), command, "fields", mass, gravity[:, 2])
    arm = _arm(3)
    inertia = arm.batch.read("body_mass")
    inertia[:, 1:] *= mass[:, None]
    arm.batch.write({"body_mass": inertia})
    _agree(simulator, arm, "masses of the arm")


def check_states(simulator: Simulator) -> None:
    """Every candidate starts where it is said to, under the forces from outside that are part of its state."""
    start, speed = np.random.default_rng(3).uniform(-1, 1, (2, 3, 2))
    push = np.zeros((3, 3, 6))
    push[:, 1, 0] = [1.0, 0.0, -2.0]
    setup = _setup(_batch(SLIDERS, 3), STEPS, state={"qpos": start, "qvel": speed, "xfrc_applied": push})
    force = np.zeros((3, STEPS, 2))
    force[:, :, 0] = push[:, 1, 0, None]
    _fly(simulator, setup, force, "initial states and forces from outside")


def check_laws(simulator: Simulator) -> None:
    """Laws act at every step, with the values of their candidate and a memory that begins anew."""
    rate = np.array([[[0.1]], [[-0.2]], [[0.0]]])
    laws = (Law(_Push(("b",)), rate, np.array([1])),)
    force = np.zeros((3, STEPS, 2))
    force[:, :, 1] = rate[:, 0] * np.arange(1, STEPS + 1)
    for again in ("", ", the second time"):
        _fly(simulator, _setup(_batch(SLIDERS, 3), STEPS, laws=laws), force, f"a law with a memory{again}")
    for integrator in ("RK4", "implicitfast"):
        _agree(simulator, _under_laws(4, integrator), f"laws under {integrator}")


def check_held_servos(simulator: Simulator) -> None:
    """Servos that hold their torque compute it at their own ticks, within their limits, with laws and without."""
    for setup in (_arm(3), _under_laws(3)):
        _agree(simulator, replace(setup, held_steps=2), "servos that hold their torque")


def check_neighbours(simulator: Simulator) -> None:
    """What a candidate gets does not depend, to the last bit, on those beside it, nor on the number of threads."""
    for make in (_arm, _under_laws):
        whole = _run(simulator, make(5), _every())
        for threads in (1, 3):
            alone = _run(simulator, _rows(make(5), slice(3, 4)), _every(), threads)
            require(
                np.array_equal(alone.position[0], whole.position[3])
                and np.array_equal(alone.velocity[0], whole.velocity[3]),
                f"candidate 3 of 5 moves otherwise when it is simulated alone on {threads} threads",
            )


def check_borders(simulator: Simulator) -> None:
    """States are those at the borders asked for, whichever these are."""
    for make in (_arm, _under_laws):
        setup, some = replace(make(2), effort=True), np.array([0, 3, 4, STEPS])
        few, all_of_them = _run(simulator, setup, some), _run(simulator, setup, _every())
        require(
            np.array_equal(few.position, all_of_them.position[:, some]), "states depend on which borders are asked for"
        )
        require(few.position.shape == (2, len(some), 2), f"states have the shape {few.position.shape}")
        require((few.effort is None) == (all_of_them.effort is None), "torques depend on which borders are asked for")


def check_reproducible(simulator: Simulator) -> None:
    """The same setup gives the same bits again, and is left as it was."""
    setup = _under_laws(3)
    before = [a.copy() for a in _arrays(setup)]
    first, second = _run(simulator, setup, _every()), _run(simulator, setup, _every())
    require(np.array_equal(first.position, second.position), "the same setup moves otherwise the second time")
    same = all(np.array_equal(a, b) for a, b in zip(before, _arrays(setup), strict=True))
    require(same, "the simulator wrote into the setup that it was given")


def check_divergence(simulator: Simulator) -> None:
    """A candidate that diverges is said to have failed, and does no harm to the others."""
    for make in (_arm, _under_laws):
        setup, wild = make(3), make(3)
        command = wild.command.copy()
        command[1] = np.nan
        found, calm = _run(simulator, replace(wild, command=command), _every()), _run(simulator, setup, _every())
        lost = found.failed | ~np.isfinite(found.position).all(axis=(1, 2))
        require(not calm.failed.any(), "candidates are said to have failed that did not")
        require(bool(lost[1]), "a candidate whose commands are not numbers is not said to have failed")
        for row in (0, 2):
            require(
                not lost[row] and np.array_equal(found.position[row], calm.position[row]),
                "a candidate that diverges changes how the others move",
            )


SIMULATOR_CHECKS: tuple[Callable[[Simulator], None], ...] = (
    check_order,
    check_commands,
    check_applied,
    check_states,
    check_fields,
    check_laws,
    check_held_servos,
    check_reproducible,
    check_neighbours,
    check_borders,
    check_divergence,
)


def _batch(xml: str, size: int, integrator: str = "RK4", step: float = STEP) -> BatchModel:
    import mujoco

    model = mujoco.MjModel.from_xml_string(xml.format(integrator=integrator, step=step))
    return BatchModel(model, make_index(model), step, size)


def _setup(batch: BatchModel, steps: int, *, state: Fields | None = None, **given: Any) -> Setup:
    """A setup that begins at rest at zero without commands, up to what is given."""
    begin = {"qpos": np.zeros((batch.size, batch.model.nq)), "qvel": np.zeros((batch.size, batch.model.nv))}
    given.setdefault("command", np.zeros((batch.size, steps, len(batch.index.joints))))
    return Setup(batch, {**begin, **(state or {})}, **given)


def _arm(size: int, integrator: str = "RK4") -> Setup:
    """Arms that wave, each from another pose and under other commands."""
    rng = np.random.default_rng(4)
    time = STEP * np.arange(STEPS)[:, None]
    phase = rng.uniform(0, 6, (size, 1, 2))
    command = 0.8 * np.sin(5 * time + phase)
    state = {"qpos": rng.uniform(-0.5, 0.5, (size, 2)), "qvel": rng.uniform(-1, 1, (size, 2))}
    return _setup(_batch(ARM, size, integrator), STEPS, state=state, command=command)


def _under_laws(size: int, integrator: str = "RK4") -> Setup:
    """The same under a law that does all that a law may."""
    sizes = np.linspace(0.2, 0.8, size)[:, None, None] * np.ones((1, 2, 1))
    voltage = np.sin(0.2 * np.arange(STEPS))[:, None] * np.ones((1, size))
    laws = (Law(_Tired(("shoulder", "elbow")), sizes, np.arange(2)),)
    return replace(_arm(size, integrator), laws=laws, inputs={"voltage.shoulder": voltage, "voltage.elbow": voltage})


def _rows(setup: Setup, rows: slice) -> Setup:
    """Some of the candidates of a setup."""
    batch, size = setup.batch, len(range(*rows.indices(setup.size)))
    return replace(
        setup,
        batch=replace(batch, size=size, fields={name: values[rows] for name, values in batch.fields.items()}),
        state={name: values[rows] for name, values in setup.state.items()},
        command=setup.command[rows],
        laws=tuple(law._replace(values=law.values[rows]) for law in setup.laws),
        inputs={name: values[:, rows] for name, values in setup.inputs.items()},
    )


def _arrays(setup: Setup) -> list[FloatArray]:
    return [setup.command, *setup.state.values(), *setup.batch.fields.values(), *(law.values for law in setup.laws)]


def _every() -> IntArray:
    return np.arange(STEPS + 1)


def _run(simulator: Simulator, setup: Setup, borders: IntArray, threads: int = 1) -> States:
    with silenced():
        return simulator.rollout(setup, borders, threads=threads)


def _fly(
    simulator: Simulator,
    setup: Setup,
    force: FloatArray,
    what: str,
    mass: FloatArray | float = MASS,
    gravity: FloatArray | float = -9.81,
) -> None:
    """Two sliders under forces (m, steps, 2) that are constant over each step, which Runge-Kutta integrates exactly."""
    acceleration = force / np.reshape(mass, (-1, 1, 1))
    acceleration[:, :, 1] += np.reshape(gravity, (-1, 1))
    q, v = [setup.state["qpos"].copy()], [setup.state["qvel"].copy()]
    for a in np.moveaxis(acceleration, 1, 0):
        q.append(q[-1] + STEP * v[-1] + STEP**2 / 2 * a)
        v.append(v[-1] + STEP * a)
    found = _run(simulator, setup, _every())
    error = max(np.abs(found.position - np.stack(q, 1)).max(), np.abs(found.velocity - np.stack(v, 1)).max())
    require(bool(error < EXACT), f"{what}: sliding masses are {error:.3g} m or m/s from their closed form")


def _agree(simulator: Simulator, setup: Setup, what: str) -> None:
    """It moves an arm as the built-in simulator does, up to what rounding makes of 40 steps."""
    setup = replace(setup, effort=True)
    wanted, found = _run(MujocoBatch(), setup, _every()), _run(simulator, setup, _every())
    require(not found.failed.any(), f"{what}: the arm is said to have failed")
    error = np.abs(found.position - wanted.position).max()
    require(bool(error < EXACT), f"{what}: {error:.3g} rad from what the built-in simulator gives")
    require((found.effort is None) == (wanted.effort is None), f"{what}: torques of the servos are not as asked for")
    if found.effort is not None and wanted.effort is not None:
        error = np.abs(found.effort - wanted.effort).max()
        require(bool(error < 1e3 * EXACT), f"{what}: torques {error:.3g} Nm from those of the built-in simulator")
