"""The replay engine: the grid, the clock, batches, numerics, mounts, starts and failures."""

from __future__ import annotations

import itertools
import tracemalloc
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from toys import (
    FINE,
    KP,
    LEG_JOINTS,
    SCALE,
    held,
    leg,
    make_log,
    pendulum,
    position,
    robot_from_xml,
    run,
    swing,
    with_spec,
)

from sysid_btr.errors import ModelError
from sysid_btr.identify.episode import Procedure
from sysid_btr.identify.numerics import CHECK_SECONDS, choose_numerics
from sysid_btr.io.log import Log
from sysid_btr.simulation import mujoco_batch
from sysid_btr.simulation import replay as replay_module
from sysid_btr.simulation.base_states import BaseStates
from sysid_btr.simulation.batching import batched_chunks, group_replays
from sysid_btr.simulation.grid import ALIGNED, make_grid, mean_commands, mean_over_steps, step_inputs
from sysid_btr.simulation.numerics import Numerics
from sysid_btr.simulation.replay import Replay
from sysid_btr.simulation.segments import SegmentReplay, Segments
from sysid_btr.simulation.start import initial_state
from sysid_btr.terms.friction import CoulombFriction, StribeckFriction
from sysid_btr.terms.grammar import parse_parameters
from sysid_btr.terms.servo import BackEmf, IntegralGain

ARM = ("arm",)
ZERO = np.zeros(1)

intervals = st.lists(st.floats(0.001, 0.05), min_size=1, max_size=30)
levels = st.floats(-2.0, 2.0)


@st.composite
def held_commands(draw: st.DrawFn) -> tuple[np.ndarray, np.ndarray, float]:
    """Sample times, commands, step."""
    time = np.concatenate([[0.0], np.cumsum(draw(intervals))])
    values = np.array(draw(st.lists(levels, min_size=len(time), max_size=len(time))))
    return time, values, draw(st.floats(0.0007, 0.02))


# --- the grid -------------------------------------------------------------------------------------------


@given(held_commands())
def test_the_mean_of_a_held_command_conserves_its_impulse(case: tuple[np.ndarray, np.ndarray, float]) -> None:
    time, values, step = case
    steps = int(np.ceil(time[-1] / step))
    mean = mean_over_steps(time, values[:, None], np.arange(steps + 1) * step)[:, 0]
    ends = np.append(time[1:], max(steps * step, time[-1]))
    assert np.sum(mean) * step == pytest.approx(
        np.sum(values * np.clip(np.minimum(ends, steps * step) - time, 0, None)), abs=1e-9
    )
    assert mean.min() >= values.min() - 1e-9
    assert mean.max() <= values.max() + 1e-9


def test_of_no_steps_there_is_no_mean() -> None:
    """A log may have no segment of a length that is asked for."""
    none = np.zeros((0, 4))
    assert mean_over_steps(np.arange(3.0), np.ones((3, 2)), none).shape == (0, 3, 2)
    command, extra = mean_commands(held(0.0, 0.1), ARM, ZERO, {}, none)
    assert command.shape == (0, 3, 1)
    assert extra.shape == (0, 3, 0)


@given(held_commands())
def test_every_sample_lies_between_its_borders(case: tuple[np.ndarray, np.ndarray, float]) -> None:
    time, values, step = case
    grid = make_grid(make_log(time, {"command.arm": values}), ARM, ZERO, step)
    at = (grid.state[grid.before] + grid.fraction) * step
    np.testing.assert_allclose(at, time, atol=1.001 * ALIGNED * step)
    assert ((grid.fraction >= 0) & (grid.fraction < 1)).all()
    assert (np.diff(grid.state) > 0).all()
    assert grid.steps * step >= time[-1] - ALIGNED * step


def test_a_step_that_divides_the_period_puts_samples_on_borders() -> None:
    grid = make_grid(swing(seconds=3.0), ARM, ZERO, 0.005)
    assert not grid.fraction.any()
    np.testing.assert_array_equal(grid.state, 2 * np.arange(301))
    np.testing.assert_allclose(grid.command[:, 0], np.repeat(swing(seconds=3.0).channels["command.arm"][:-1], 2))


def test_a_linear_command_is_interpolated() -> None:
    time = np.arange(21) * 0.01
    log = make_log(time, {"command.arm": time}, command_hold="linear")
    grid = make_grid(log, ARM, ZERO, 0.005)
    np.testing.assert_allclose(grid.command[:, 0], (np.arange(40) + 0.5) * 0.005)


def test_a_joint_without_a_command_keeps_the_models_position() -> None:
    grid = make_grid(held(), ("other", "arm"), np.array([0.7, 0.0]), 0.005)
    np.testing.assert_array_equal(grid.command[:, 0], 0.7)


# --- clocks ---------------------------------------------------------------------------------------------


def irregular(log: Log, seed: int = 0, keep: float = 0.6) -> tuple[Log, np.ndarray]:
    """Some of the samples of a log whose command does not change where samples are left out."""
    rng = np.random.default_rng(seed)
    rows = np.flatnonzero(rng.random(len(log)) < keep)
    rows = np.union1d(rows, [0, len(log) - 1])
    return (
        replace(
            log, time=log.time[rows], channels={k: v[rows] for k, v in log.channels.items()}, episode=log.episode[rows]
        ),
        rows,
    )


def test_an_irregular_clock_sees_the_same_motion() -> None:
    log = held(0.4, seconds=1.5)
    sparse, rows = irregular(log)
    np.testing.assert_allclose(position(pendulum(), sparse), position(pendulum(), log)[rows], atol=1e-12)


def test_samples_between_steps_are_read_out_to_third_order() -> None:
    log = held(0.4, seconds=1.0, period=0.0071)
    exact = position(pendulum(), log, numerics=Numerics("RK4", 0.0071 / 8))
    errors = [
        np.abs(position(pendulum(), log, numerics=Numerics("RK4", step)) - exact).max() for step in (0.008, 0.004)
    ]
    assert errors[0] < 1e-4
    assert errors[1] < errors[0] / 6


@pytest.mark.parametrize("origin", [1000.0, -3.7, 1.7e9])
def test_the_origin_of_the_clock_does_not_matter(origin: float) -> None:
    log = swing(seconds=1.5)
    moved = replace(log, time=log.time + origin)
    tolerance = 1e-10 if origin < 1e6 else 1e-6
    np.testing.assert_allclose(position(pendulum(), moved), position(pendulum(), log), atol=tolerance)


def test_a_jittered_clock_moves_the_replay_no_more_than_the_jitter() -> None:
    log = swing(seconds=1.5)
    jitter = np.random.default_rng(1).normal(scale=1e-5, size=len(log))
    jitter[0] = 0.0
    moved = replace(log, time=log.time + jitter)
    assert np.abs(position(pendulum(), moved) - position(pendulum(), log)).max() < 2e-4


def test_a_missing_command_leaves_the_last_one_in_force() -> None:
    log = swing(seconds=1.0)
    gaps = log.channels["command.arm"].copy()
    gaps[30:40] = np.nan
    filled = gaps.copy()
    filled[30:40] = gaps[29]
    seen, wanted = (position(pendulum(), replace(log, channels={"command.arm": c})) for c in (gaps, filled))
    np.testing.assert_array_equal(seen, wanted)
    assert np.isfinite(seen).all()


# --- batches --------------------------------------------------------------------------------------------


def candidates(count: int) -> np.ndarray:
    rng = np.random.default_rng(3)
    return np.column_stack([rng.uniform(0.7, 1.3, count), rng.uniform(0.0, 0.3, count)])


LEG_LOG = swing(LEG_JOINTS, seconds=0.5)


@pytest.mark.parametrize("law", [False, True])
def test_chunks_and_threads_give_the_same_bits(law: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    scales = dict.fromkeys(LEG_JOINTS, SCALE)
    friction = StribeckFriction.at(("knee",), scales) if law else CoulombFriction.at(("knee",), scales)
    terms = (*parse_parameters(["mass:knee"], leg()), friction)
    rows = candidates(70)
    if law:
        rows = np.column_stack([rows, np.full(70, 0.1), np.full(70, 0.4)])
    wanted = run(leg(), LEG_LOG, terms, rows, threads=1, effort=True)
    for chunk, threads in ((32, 2), (7, 1), (70, 0)):
        monkeypatch.setattr(replay_module, "CHUNK", chunk)
        monkeypatch.setattr(replay_module, "CHUNK_DOFS", 0)
        monkeypatch.setattr(mujoco_batch, "SEGMENT", 11 * chunk)
        seen = run(leg(), LEG_LOG, terms, rows, threads=threads, effort=True)
        np.testing.assert_array_equal(seen.position, wanted.position)
        np.testing.assert_array_equal(seen.velocity, wanted.velocity)
        np.testing.assert_array_equal(seen.effort, wanted.effort)
    np.testing.assert_array_equal(run(leg(), LEG_LOG, terms, rows[41]).position[0], wanted.position[41])


@pytest.mark.parametrize("law", [False, True])
def test_a_diverging_candidate_costs_only_itself(law: bool, recwarn: pytest.WarningsRecorder) -> None:
    terms: tuple[Any, ...] = tuple(parse_parameters(["kv:arm"], pendulum()))
    extra = []
    if law:
        terms = (*terms, IntegralGain.at(("arm",), {"arm": SCALE}))
        extra = [2.0]
    rows = np.array([[1.0, *extra], [-400.0, *extra], [1.2, *extra]])
    outputs = run(pendulum(), swing(seconds=1.0), terms, rows, effort=True)
    assert outputs.effort is not None
    assert all(np.isnan(a[1]).all() for a in (outputs.position, outputs.velocity, outputs.effort))
    for row in (0, 2):
        alone = run(pendulum(), swing(seconds=1.0), terms, rows[row])
        np.testing.assert_array_equal(outputs.position[row], alone.position[0])
    assert not recwarn.list


def test_candidates_of_the_wrong_width_are_refused() -> None:
    with pytest.raises(ValueError, match="3 numbers, expected 1"):
        run(pendulum(), held(), parse_parameters(["kp:arm"], pendulum()), np.zeros((2, 3)))


def test_memory_does_not_grow_with_the_number_of_candidates() -> None:
    """Held at once: one chunk, not all candidates, when the user iterates over chunks."""
    replay = Replay(leg(), swing(LEG_JOINTS, seconds=2.0), parse_parameters(["mass:knee"], leg()), FINE)

    def peak(count: int) -> int:
        tracemalloc.start()
        for _, outputs in replay.chunks(np.ones((count, 1))):
            assert outputs.position.shape[1:] == (201, 3)
        used = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        return used

    chunk = replay_module.CHUNK_DOFS // len(LEG_JOINTS)
    peak(chunk)
    few, many = peak(chunk), peak(8 * chunk)
    assert many < 1.5 * few + 1e6


# --- numerics -------------------------------------------------------------------------------------------


def convergence(terms: tuple[Any, ...], values: list[float], steps: tuple[float, ...]) -> list[float]:
    """Largest change of the replay at each halving of the step."""
    log = swing(seconds=1.0, period=0.02)
    seen = [position(pendulum(), log, terms, values, Numerics("RK4", s)) for s in steps]
    return [float(np.abs(a - b).max()) for a, b in itertools.pairwise(seen)]


def test_halving_the_step_converges_to_fourth_order_on_a_smooth_motion() -> None:
    changes = convergence((), [], (0.01, 0.005, 0.0025))
    assert changes[0] < 1e-4
    assert changes[1] < changes[0] / 12


def test_laws_that_are_held_over_a_step_converge_to_second_order() -> None:
    law = IntegralGain.at(("arm",), {"arm": SCALE})
    changes = convergence((law,), [20.0], (0.01, 0.005, 0.0025, 0.00125))
    assert changes[1] < changes[0] / 3.4
    assert changes[2] < changes[1] / 3.4


def test_the_step_is_chosen_by_its_effect_on_the_log() -> None:
    log = swing(seconds=3.0)
    q = position(pendulum(), log, numerics=Numerics("RK4", 0.0005))[:, 0]
    for noise, coarse in ((1e-3, True), (1e-8, False)):
        seen = q + np.random.default_rng(0).normal(scale=noise, size=len(q))
        numerics, change = choose_numerics(pendulum(), replace(log, channels={**log.channels, "position.arm": seen}))
        assert change < 0.02
        assert (numerics.timestep >= 0.005) is coarse
        assert 0.01 / numerics.timestep == pytest.approx(round(0.01 / numerics.timestep))


def test_the_step_is_chosen_on_a_short_stretch_in_which_joints_move(monkeypatch: pytest.MonkeyPatch) -> None:
    swinging = swing(seconds=30.0)
    resting = np.full(2000, swinging.channels["command.arm"][0])
    command = np.concatenate([resting, swinging.channels["command.arm"]])
    late = make_log(np.arange(len(command)) * 0.01, {"command.arm": command})
    q = position(pendulum(), late, numerics=Numerics("RK4", 0.0025))[:, 0]
    q = q + np.random.default_rng(0).normal(scale=1e-6, size=len(q))
    late = replace(late, channels={**late.channels, "position.arm": q})
    simulated: list[float] = []
    predict = Replay.predict

    def counted(replay: Replay, candidates: Any) -> Any:
        simulated.append(len(candidates) * float(replay.log.time[-1] - replay.log.time[0]))
        return predict(replay, candidates)

    monkeypatch.setattr(Replay, "predict", counted)
    assert choose_numerics(pendulum(), late.window(0, 2000))[0].timestep == pytest.approx(0.01), "a rest tells nothing"
    assert choose_numerics(pendulum(), late)[0].timestep < 0.006
    assert max(simulated) < 20.0 + CHECK_SECONDS + 1.0


def test_derivatives_of_a_held_servo_come_from_steps_that_the_engine_takes_by_itself() -> None:
    cheap = Procedure().cheap(Numerics("RK4", 0.001, 0.004))
    assert cheap == Numerics("Euler", 0.004)


def test_a_servo_that_no_step_can_hold_is_told() -> None:
    xml = '<mujoco><worldbody><body><joint name="arm"/><geom size=".01" mass="1e-6"/></body></worldbody>'
    xml += '<actuator><general joint="arm" gainprm="1e6" biastype="affine" biasprm="0 -1e6 100"/>'
    xml += "</actuator></mujoco>"
    log = swing(seconds=0.5)
    log = replace(log, channels={**log.channels, "position.arm": 0.9 * log.channels["command.arm"]})
    with pytest.raises(ModelError, match="diverges even with a step"):
        choose_numerics(robot_from_xml(xml), log)


def test_a_digital_servo_computes_its_law_once_a_period() -> None:
    """Against the difference equation of a mass under a sampled, held servo."""
    xml = """<mujoco><option gravity="0 0 0"/><worldbody><body><joint name="arm" type="slide" axis="1 0 0"/>
      <geom size=".1" mass="2"/></body></worldbody>
      <actuator><position joint="arm" kp="800" kv="20"/></actuator></mujoco>"""
    period = 0.004
    time = np.arange(251) * period
    command = 0.1 * np.sin(6 * time)
    log = make_log(time, {"command.arm": command}, servo_period=period)
    numerics, _ = choose_numerics(robot_from_xml(xml), log)
    assert numerics == Numerics("Euler", period)
    seen = run(robot_from_xml(xml), log, (), None, numerics, effort=True)
    q, v, wanted, force = 0.0, 0.0, [], []
    for u in command:
        wanted.append(q)
        force.append(800 * (u - q) - 20 * v)
        v += period * force[-1] / 2
        q += period * v
    np.testing.assert_allclose(seen.position[0, :, 0], wanted, atol=1e-12)
    assert seen.effort is not None
    np.testing.assert_allclose(seen.effort[0, :-1, 0], force[:-1], atol=1e-9)


@pytest.mark.parametrize("numerics", [FINE, Numerics("implicitfast", 0.001), Numerics("Euler", 0.001)])
def test_stepping_through_a_law_that_does_nothing_equals_rolling_out(numerics: Numerics) -> None:
    law = IntegralGain.at(("knee",), dict.fromkeys(LEG_JOINTS, SCALE))
    log = swing(LEG_JOINTS, seconds=0.4)
    rolled = run(leg(), log, (), None, numerics, effort=True)
    stepped = run(leg(), log, [law], [0.0], numerics, effort=True)
    np.testing.assert_allclose(stepped.position, rolled.position, atol=1e-12)
    assert rolled.effort is not None
    assert stepped.effort is not None
    np.testing.assert_allclose(stepped.effort[:, :-1], rolled.effort[:, :-1], atol=1e-9)


# --- torque, start, mount -------------------------------------------------------------------------------


def test_effort_is_the_servos_torque() -> None:
    outputs = run(pendulum(), held(0.3, 4.0), effort=True)
    assert outputs.effort is not None
    assert outputs.effort[0, 0, 0] == pytest.approx(KP * 0.3)
    q = outputs.position[0, -1, 0]
    assert outputs.effort[0, -1, 0] == pytest.approx(0.5 * 9.81 * 0.2 * np.sin(q), abs=1e-6)
    assert run(pendulum(), held()).effort is None


def test_the_start_comes_from_the_first_samples() -> None:
    rng = np.random.default_rng(0)
    time = np.arange(60) * 0.01
    noisy = 0.3 + 0.5 * time + rng.normal(scale=1e-3, size=60)
    qpos, qvel = initial_state(make_log(time, {"position.arm": noisy}), ("arm", "other"), np.array([0.0, 0.4]))
    np.testing.assert_allclose(qpos, [0.3, 0.4], atol=2e-3)
    np.testing.assert_allclose(qvel, [0.5, 0.0], atol=0.05)


def test_the_start_of_an_accelerating_joint_is_not_half_a_window_late() -> None:
    time = np.arange(60) * 0.001
    fast = 0.3 + 0.5 * time + 0.5 * 40.0 * time**2 + np.random.default_rng(0).normal(scale=1e-7, size=60)
    _, qvel = initial_state(make_log(time, {"position.arm": fast}), ARM, ZERO)
    assert qvel[0] == pytest.approx(0.5, abs=2e-3)


def test_a_logged_velocity_is_the_start_and_gaps_are_passed_over() -> None:
    time = np.arange(60) * 0.01
    values = 0.3 + 0.5 * time
    values[[0, 2]] = np.nan
    log = make_log(time, {"position.arm": values, "velocity.arm": np.full(60, 0.6)})
    qpos, qvel = initial_state(log, ARM, ZERO)
    assert (qpos[0], qvel[0]) == pytest.approx((0.3, 0.6))


STANDING = """
<mujoco><worldbody><geom name="floor" type="plane" size="2 2 .1"/>
  <body name="torso" pos="0 0 .25"><freejoint name="root"/><geom type="box" size=".05 .05 .05" mass="1"/>
    <body name="arm" pos="0 0 -.05"><joint name="arm" axis="0 1 0" damping=".3" armature=".01"/>
      <geom type="capsule" fromto="0 0 0 0 0 -.18" size=".02" mass=".3"/></body></body>
</worldbody><actuator><position joint="arm" kp="8" kv=".3"/></actuator></mujoco>
"""


def test_a_held_torso_has_no_free_joint_and_hangs_clear_of_the_ground() -> None:
    robot = robot_from_xml(STANDING)
    log = held(0.8, 4.0)
    fixed = Replay(robot, replace(log, meta=replace(log.meta, mount="fixed")), (), FINE)
    free = Replay(robot, replace(log, meta=replace(log.meta, mount="free")), (), FINE)
    assert (fixed.model.nq, free.model.nq) == (1, 8)
    q = fixed.predict(np.zeros((1, 0))).position[0, -1, 0]
    assert 8 * (0.8 - q) == pytest.approx(0.3 * 9.81 * 0.09 * np.sin(q), abs=1e-6)
    assert abs(free.predict(np.zeros((1, 0))).position[0, -1, 0] - q) > 1e-3


def test_a_joint_starts_where_its_log_does_on_a_free_base_too() -> None:
    log = held(0.2, 0.5)
    channels = {**log.channels, "position.arm": np.full(len(log), 0.2)}
    free = replace(log, channels=channels, meta=replace(log.meta, mount="free"))
    assert run(robot_from_xml(STANDING), free).position[0, 0, 0] == pytest.approx(0.2)


def test_a_model_that_an_effect_makes_impossible_is_told() -> None:
    def spoil(spec: Any) -> None:
        spec.body("arm").mass = -1.0
        spec.body("arm").explicitinertial = True

    with pytest.raises(ModelError, match="pendulum"):
        run(with_spec(pendulum(), spoil), held())


# --- measured drive inputs ------------------------------------------------------------------------------


@settings(max_examples=30)
@given(held_commands())
def test_measured_inputs_are_held_over_gaps(case: tuple[np.ndarray, np.ndarray, float]) -> None:
    time, values, step = case
    grid = make_grid(make_log(time, {"command.arm": values}), ARM, ZERO, step)
    gaps = np.where(np.arange(len(values)) % 3 == 1, np.nan, values)
    inputs = step_inputs(make_log(time, {"voltage.arm": gaps, "duty.arm": gaps}), np.arange(grid.steps + 1) * step)
    assert set(inputs) == {"voltage.arm"}
    assert np.isfinite(inputs["voltage.arm"]).all()
    assert len(inputs["voltage.arm"]) == grid.steps
    known = gaps[np.isfinite(gaps)]
    assert known.min() - 1e-9 <= inputs["voltage.arm"].min()
    assert inputs["voltage.arm"].max() <= known.max() + 1e-9


def test_an_input_without_any_value_is_left_out() -> None:
    log = held(0.0, 0.1)
    empty = replace(log, channels={**log.channels, "voltage.arm": np.full(len(log), np.nan)})
    assert step_inputs(empty, np.arange(3) * 0.005) == {}


def test_a_law_in_a_segment_reads_the_inputs_of_its_own_time() -> None:
    """A segment in the middle of a log moves as one at the beginning of what is left of the log there."""
    log = swing(seconds=0.6)
    enabled = np.repeat([1.0, 0.0, 1.0], [30, 10, 21])
    log = replace(log, channels={**log.channels, "enabled.arm": enabled}, meta=replace(log.meta, mount="free"))
    law = BackEmf.at(("arm",), {"arm": SCALE})

    def segment(log: Log, first: int) -> np.ndarray:
        start, rows = np.array([[0.0, 0.0, 1.0]]), np.array([[first, first + 20]])
        still, joint = np.zeros((1, 3)), np.full((1, 1), 0.5)
        base = BaseStates(start, np.eye(1, 4), still, still)
        segments = Segments(rows, joint, 8 * joint, np.ones((1, 14)), base)
        replay = SegmentReplay(robot_from_xml(STANDING), log, (law,), FINE, segments=segments)
        return replay.predict(np.full((1, 1), 0.5)).position[0, first : first + 20]

    seen = segment(log, 22)
    assert np.isfinite(seen).all()
    np.testing.assert_allclose(seen, segment(log.window(22, 61), 0), atol=1e-12)
    on = replace(log, channels={**log.channels, "enabled.arm": np.ones(61)})
    assert np.abs(seen - segment(on, 22)).max() > 1e-3


@pytest.mark.parametrize("law", [False, True])
def test_an_euler_step_a_period_is_a_held_torque_with_euler_steps(law: bool) -> None:
    """MuJoCo's own servo, read once a step, is one whose torque is held for the step."""
    scales = dict.fromkeys(LEG_JOINTS, SCALE)
    effect = StribeckFriction.at(("knee",), scales) if law else CoulombFriction.at(("knee",), scales)
    rows = np.array([[0.05, 0.0, 0.4], [0.2, 0.0, 0.4]])[:, : len(effect.parameters)]
    own = Replay(leg(), LEG_LOG, (effect,), Numerics("Euler", 0.002), effort=True).predict(rows)
    held = Replay(leg(), LEG_LOG, (effect,), Numerics("Euler", 0.002, 0.002), effort=True).predict(rows)
    np.testing.assert_allclose(held.position, own.position, atol=1e-12)
    assert own.effort is not None
    assert held.effort is not None
    np.testing.assert_allclose(held.effort[:, :-1], own.effort[:, :-1], atol=1e-9)


def test_a_held_torque_does_not_depend_on_the_step_of_the_plant() -> None:
    def position(step: float) -> np.ndarray[Any, Any]:
        return Replay(leg(), LEG_LOG, (), Numerics("RK4", step, 0.004)).predict(np.zeros((1, 0))).position

    assert np.abs(position(0.002) - position(0.001)).max() < 1e-6
    longer = Replay(leg(), LEG_LOG, (), Numerics("RK4", 0.002, 0.002)).predict(np.zeros((1, 0))).position
    assert np.abs(position(0.002) - longer).max() > 1e-5


# --- several logs together --------------------------------------------------------------------------------


def _stiffer(factor: float) -> Any:
    def edit(spec: Any) -> None:
        for actuator in spec.actuators:
            actuator.gainprm[0] *= factor
            actuator.biasprm[1] *= factor

    return edit


@pytest.mark.parametrize("law", [False, True])
def test_logs_simulated_together_move_as_each_does_alone(law: bool) -> None:
    """Of different lengths and clocks, and of robots that differ in numbers."""
    rng = np.random.default_rng(3)
    irregular = np.cumsum(rng.uniform(0.004, 0.013, 200))
    logs = [
        swing(LEG_JOINTS, seconds=2.0),
        swing(LEG_JOINTS, seconds=1.5, size=0.3),
        swing(LEG_JOINTS, seconds=0.4),
        make_log(irregular, {f"command.{j}": np.round(np.sin(3 * irregular), 1) for j in LEG_JOINTS}),
    ]
    robots = [leg(), with_spec(leg(), _stiffer(1.5)), leg(), leg()]
    effect = StribeckFriction(("knee",)) if law else CoulombFriction(("knee",))
    terms = (*parse_parameters(["mass:knee", "delay:hip"], leg()), effect)
    replays = [Replay(r, log, terms, Numerics("RK4", 0.0025), effort=True) for r, log in zip(robots, logs, strict=True)]
    found = group_replays(replays)
    assert sorted(i for party in found for i in party) == [0, 1, 2, 3]
    assert max(len(party) for party in found) == 3, "the short one is not dragged along"
    candidates = np.tile([p.nominal for p in replays[0].parameters], (5, 1))
    candidates += rng.uniform(0, 0.02, candidates.shape)
    for party in found:
        for rows, together in batched_chunks([replays[i] for i in party], candidates):
            for i, outputs in zip(party, together, strict=True):
                alone = replays[i].predict(candidates[rows])
                for name in ("position", "velocity", "effort"):
                    np.testing.assert_array_equal(getattr(outputs, name), getattr(alone, name), err_msg=name)


def test_logs_of_robots_of_another_structure_are_simulated_apart() -> None:
    log = swing(seconds=0.5)
    other = robot_from_xml(
        "<mujoco><worldbody><body name='arm'><joint name='arm' axis='0 1 0'/><geom size='.1' mass='1'/>"
        "<body name='more'><joint name='more' axis='0 1 0'/><geom size='.1' mass='1'/></body></body></worldbody>"
        "<actuator><position name='arm' joint='arm' kp='5'/></actuator></mujoco>"
    )
    slow, fast = Numerics("RK4", 0.005), Numerics("RK4", 0.0025)
    replays = [Replay(r, log, (), n) for r, n in ((pendulum(), slow), (other, slow), (pendulum(), fast))]
    assert group_replays(replays) == [(0,), (1,), (2,)]


def test_a_candidate_that_diverges_in_one_log_does_not_spoil_the_others() -> None:
    wild = make_log(np.arange(101) * 0.01, {"command.arm": np.full(101, 1e9)})
    replays = [Replay(pendulum(), log, (), Numerics("RK4", 0.005)) for log in (swing(seconds=1.0), wild)]
    ((_, (calm, thrown)),) = batched_chunks(replays, np.zeros((1, 0)))
    assert np.isnan(thrown.position).all()
    assert np.isfinite(calm.position).all()
