"""Replay by segments, uncertain starts, and identification on walks."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache, lru_cache
from pathlib import Path
from typing import Any, cast

import mujoco
import numpy as np
import pytest
from toys import pendulum, swing
from walks import Scale, Truth, heavier, plain_walk, record_walk

from sysid_btr.errors import LogError
from sysid_btr.estimators import Budget, Journal, silent
from sysid_btr.estimators.linearisation import linearise
from sysid_btr.estimators.lsq import LeastSquares
from sysid_btr.floating_base import segments as segments_module
from sysid_btr.floating_base.contact_free import without_ground
from sysid_btr.floating_base.episode import FloatingEpisode
from sysid_btr.floating_base.estimate import BaseState
from sysid_btr.floating_base.reconstruction import reconstruct
from sysid_btr.floating_base.segments import FloatingReplay, SegmentLength, segment_best, segment_log
from sysid_btr.floating_base.size import measure_size
from sysid_btr.floating_base.strides import of_legs, repeated_error, stride
from sysid_btr.identify.deferred import deferred_fit
from sysid_btr.identify.fit import Fit, fit
from sysid_btr.identify.intervals import estimates
from sysid_btr.identify.mode import Mode
from sysid_btr.identify.replay import replay_log
from sysid_btr.identify.scores import score
from sysid_btr.identify.study import Study, make_study
from sysid_btr.io.log import Log
from sysid_btr.io.noise import NoiseFloor
from sysid_btr.io.parquet import read_log
from sysid_btr.models.builtin import load_robot
from sysid_btr.models.gait import Gait, gait
from sysid_btr.objectives.marginal import Marginal, projections
from sysid_btr.objectives.targets import Target
from sysid_btr.simulation.base_states import BASE, BaseStates, on_slope
from sysid_btr.simulation.numerics import Numerics
from sysid_btr.simulation.segments import Segments, covered, segment_seconds
from sysid_btr.terms.contact import FootCompliance, FootFriction
from sysid_btr.terms.disturbance import ConstantForce
from sysid_btr.terms.effect import Effect
from sysid_btr.terms.grammar import parse_parameters
from sysid_btr.terms.inertial import GravityTilt
from sysid_btr.terms.model import Model
from sysid_btr.terms.servo import CommandDelay
from sysid_btr.testing.problems import ToyProblem

FINE = Numerics("RK4", 0.001)
WINDOWS = Mode("forward")
"""Walks by segments on the model's ground, and what hangs whole."""
LENGTH = 10


def true_segments(
    log: Log, truth: Truth, replay_joints: tuple[str, ...], first: int = 60, length: int = LENGTH
) -> Segments:
    """Segments that start from the true states."""
    rows = np.array([(a, a + length) for a in range(first, len(log) - length, length)])
    order = [truth.joints.index(j) for j in replay_joints]
    quaternion = np.empty((len(rows), 4))
    for k, a in enumerate(rows[:, 0]):
        mujoco.mju_mat2Quat(quaternion[k], truth.rotation[a].ravel())
    a = rows[:, 0]
    return Segments(
        rows,
        truth.joint_position[a][:, order],
        truth.joint_velocity[a][:, order],
        np.full((len(rows), BASE + 2 * len(order)), 1e-3),
        BaseStates(truth.position[a], quaternion, truth.velocity[a], truth.rate[a]),
    )


def window_replay(log: Log, truth: Truth, *terms: object, **kwargs: object) -> FloatingReplay:
    robot = load_robot("nao")
    bare = FloatingReplay(robot, log, tuple(terms), FINE, threads=1)  # type: ignore[arg-type]
    return replace(bare, segments=true_segments(log, truth, bare.index.joints, **kwargs))  # type: ignore[arg-type]


def joint_truth(truth: Truth, replay: FloatingReplay) -> np.ndarray:
    return truth.joint_position[:, [truth.joints.index(j) for j in replay.index.joints]]


@cache
def quiet_walk() -> tuple[Log, Truth]:
    return record_walk(Gait(), 4.0, noise=0.0)


# --- segments --------------------------------------------------------------------------------------------


def test_windows_from_true_states_reproduce_the_whole_walk() -> None:
    log, truth = quiet_walk()
    replay = window_replay(log, truth)
    outputs = replay.predict(np.zeros((1, 0)))
    assert outputs.position.shape == (1, len(log), 22)
    inside = np.zeros(len(log), dtype=bool)
    for a, b in replay.segments.rows:  # type: ignore[union-attr]
        inside[a:b] = True
    assert np.isnan(outputs.position[0, ~inside]).all()
    error = outputs.position[0, inside] - joint_truth(truth, replay)[inside]
    assert np.abs(error).max() < 1e-6


def test_a_window_does_not_depend_on_the_others_nor_on_the_candidates_beside_it() -> None:
    log, truth = quiet_walk()
    terms = parse_parameters(["mass:RKneePitch"], load_robot("nao"))
    replay = window_replay(log, truth, *terms)
    whole = replay.predict(np.array([[0.8], [1.0], [1.3]])).position
    assert replay.segments is not None
    alone = replace(replay, segments=replay.segments.chosen(np.array([3])))
    a, b = replay.segments.rows[3]
    assert np.array_equal(alone.predict(np.array([[1.3]])).position[0, a:b], whole[2, a:b])


def test_a_delayed_command_reaches_into_the_window_from_before_it() -> None:
    log, truth = record_walk(Gait(), 4.0, noise=0.0, delay=0.04)
    joints = tuple(truth.joints)
    delay = CommandDelay(joints, shared=True)
    replay = window_replay(log, truth, delay)
    outputs = replay.predict(np.array([[0.0], [0.04]]))
    inside = np.isfinite(outputs.position[0, :, 0])
    error = [np.abs(p[inside] - joint_truth(truth, replay)[inside]).max() for p in outputs.position]
    assert error[1] < 1e-6
    assert error[0] > 1e-3


def test_a_torque_known_in_advance_acts_in_every_window() -> None:
    log, truth = quiet_walk()
    push = ConstantForce(("HeadYaw",))
    replay = window_replay(log, truth, push)
    plain, pushed = replay.predict(np.array([[0.0], [0.2]])).position
    column = replay.index.joints.index("HeadYaw")
    assert replay.segments is not None
    for _, b in replay.segments.rows:
        assert pushed[b - 1, column] - plain[b - 1, column] > 1e-3


def test_a_change_of_the_start_moves_its_window_as_a_simulation_from_there_does() -> None:
    log, truth = quiet_walk()
    replay = window_replay(log, truth)
    assert replay.segments is not None
    joints = len(replay.index.joints)
    change = np.zeros((2, BASE + 2 * joints))
    change[0, 4], change[1, BASE + 3] = 0.01, 0.01
    for w, outputs in replay.respond(np.zeros(0), change):
        for k in range(2):
            moved = replace(replay, segments=replay.segments.chosen(np.array([w])).moved(change[k : k + 1]))
            a, b = replay.segments.rows[w]
            assert np.array_equal(moved.predict(np.zeros((1, 0))).position[0, a:b], outputs.position[k])


def test_samples_between_steps_are_read_where_they_are() -> None:
    log, truth = quiet_walk()
    late = replace(log, time=log.time + 0.0004 * (np.arange(len(log)) % 3))  # a clock that jitters
    replay = window_replay(late, truth)
    outputs = replay.predict(np.zeros((1, 0))).position[0]
    inside = np.isfinite(outputs[:, 0])
    # the states are those of the regular clock, so only the jitter's motion may differ
    assert np.abs(outputs[inside] - joint_truth(truth, replay)[inside]).max() < 0.02


def test_coordinates_of_a_start_share_simulations_only_in_limbs_without_a_foot() -> None:
    log, truth = quiet_walk()
    replay = window_replay(log, truth)
    lanes = replay.lanes()
    seen = [c for lane in lanes for c, _ in lane]
    joints = len(replay.index.joints)
    assert sorted(seen) == sorted({2, 3, 4, *range(6, BASE + 2 * joints)})  # all but place and yaw
    assert len(lanes) < 45
    for lane in lanes:
        if len(lane) > 1:
            moved = np.concatenate([columns for _, columns in lane])
            assert len(moved) == len(set(moved.tolist()))
            names = {replay.index.joints[i] for i in moved}
            assert not any("Hip" in n or "Knee" in n or "Ankle" in n for n in names)


def test_on_a_slope_gravity_and_the_base_tilt_together() -> None:
    tilt = (0.03, -0.02)

    def slope(spec: mujoco.MjSpec) -> None:
        x, y = tilt
        spec.option.gravity = 9.81 * np.array([-np.sin(y) * np.cos(x), np.sin(x), -np.cos(y) * np.cos(x)])

    log, truth = record_walk(Gait(), 4.0, noise=0.0, edit=slope)
    effect = GravityTilt(("robot",))
    replay = window_replay(log, truth, effect)
    assert replay.segments is not None
    # what an inertial unit knows: the attitude to gravity, as if the floor were level
    unit = np.array([[0.0, 0.0, -9.81]])
    x, y = tilt
    own = 9.81 * np.array([-np.sin(y) * np.cos(x), np.sin(x), -np.cos(y) * np.cos(x)])
    back = on_slope(replay.segments.free_base, own, np.repeat(unit, len(replay.segments), axis=0))
    outputs = replace(replay, segments=replace(replay.segments, base=back)).predict(np.array([[0.0, 0.0], tilt]))
    inside = np.isfinite(outputs.position[0, :, 0])
    flat, sloped = (np.sqrt(np.mean((p[inside] - joint_truth(truth, replay)[inside]) ** 2)) for p in outputs.position)
    assert sloped < 0.3 * flat


@pytest.mark.parametrize(("effect", "value"), [(FootFriction, 0.3), (FootCompliance, 3.0)])
def test_contact_effects_show_on_a_walk(effect: type[Effect], value: float) -> None:
    log, truth = quiet_walk()
    replay = window_replay(log, truth, effect(("robot",)))
    plain, changed = replay.predict(np.array([[1.0], [value]])).position
    inside = np.isfinite(plain[:, 0])
    legs = [i for i, j in enumerate(replay.index.joints) if "Ankle" in j or "Hip" in j]
    assert np.abs(plain[inside] - joint_truth(truth, replay)[inside]).max() < 1e-6  # neutral
    assert np.abs((changed - plain)[inside][:, legs]).max() > 1e-3


# --- uncertain starts -----------------------------------------------------------------------------------


def toy_marginal(rng: np.random.Generator) -> tuple[Marginal, Target, np.ndarray]:
    n, d = 12, 3
    response = rng.normal(size=(d, n, 1))
    marginal = Marginal(np.array([[0, n]]), ({"position": response},), np.ones(1), np.zeros((1, d)))
    target = Target(
        "position", ("a",), np.array([0]), np.zeros((n, 1)), (NoiseFloor(0.5, "unknown", 0.0),), np.array([0.5]),
        np.ones((n, 1), dtype=bool),
    )  # fmt: skip
    return marginal, target, response[:, :, 0].T


def test_whitening_is_that_of_the_gaussian_with_the_start_integrated_out() -> None:
    rng = np.random.default_rng(0)
    marginal, target, response = toy_marginal(rng)
    (projection,) = projections(marginal, (target,))
    covariance = np.eye(12) + (response / 0.5) @ (response / 0.5).T
    residual = rng.normal(size=(5, 12))
    white = projection.whiten(residual)
    expected = np.einsum("mi,ij,mj->m", residual, np.linalg.inv(covariance), residual)
    assert np.sum(white**2, axis=1) == pytest.approx(expected)
    draws = rng.normal(size=(4000, 12)) + rng.normal(size=(4000, 3)) @ (response / 0.5).T
    assert np.cov(projection.whiten(draws).T) == pytest.approx(np.eye(12), abs=0.12)


def test_a_start_moved_within_its_uncertainty_leaves_the_likelihood_as_it_was() -> None:
    rng = np.random.default_rng(2)
    marginal, target, response = toy_marginal(rng)
    residual = rng.normal(size=(1, 12))
    shift = rng.normal(size=(1, 3))
    (before,) = projections(marginal, (target,))
    (after,) = projections(replace(marginal, shift=shift), (target,))
    moved = residual - shift @ (response / 0.5).T  # simulated from the new start
    assert after.whiten(moved) == pytest.approx(before.whiten(residual))


def test_an_uncertain_start_costs_information_and_never_invents_any() -> None:
    marginal, target, _ = toy_marginal(np.random.default_rng(3))
    (projection,) = projections(marginal, (target,))
    signal = np.random.default_rng(4).normal(size=(20, 12))
    assert np.all(np.linalg.norm(projection.whiten(signal), axis=1) <= np.linalg.norm(signal, axis=1))


# --- walks ----------------------------------------------------------------------------------------------


@cache
def reconstructed() -> tuple[Log, BaseState]:
    return reconstruct(load_robot("nao"), plain_walk()[0])


def test_segments_tile_a_walk_and_do_not_cross_the_border_of_what_is_held_out() -> None:
    log, base = reconstructed()
    segments = segment_log(log, base, 0.2, (7.0,))
    rows = segments.rows
    assert np.all(rows[:, 1] - rows[:, 0] == 10)
    assert np.all(rows[1:, 0] >= rows[:-1, 1])
    assert not np.any((log.time[rows[:, 0]] < 6.99) & (log.time[rows[:, 1] - 1] > 7.0))
    assert covered(segments, len(log)).mean() > 0.95


def test_the_fitted_and_the_held_out_part_of_a_walk_have_the_segments_that_lie_in_them(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(segments_module, "LENGTHS", (0.2,))
    monkeypatch.setattr(segments_module, "TRIED", 4)
    fitted, held_out = FloatingEpisode.split(load_robot("nao"), plain_walk()[0], 0.3, threads=2)
    assert len(fitted.log) < len(held_out.log) == len(plain_walk()[0])
    assert np.array_equal(fitted.scored, ~held_out.scored)
    assert held_out.begin == pytest.approx(7.0, abs=0.03)
    assert len(fitted.base.time) == len(fitted.log)
    every = segment_log(held_out.log, held_out.base, 0.2, (held_out.begin,))
    assert np.array_equal(np.concatenate([fitted.segments.rows, held_out.segments.rows]), every.rows)
    assert np.array_equal(
        np.concatenate([fitted.segments.free_base.position, held_out.segments.free_base.position]),
        every.free_base.position,
    )
    assert not np.any(fitted.compared & held_out.compared[: len(fitted.log)])
    assert fitted.compared[fitted.segments.rows[:, 0]].all()
    assert held_out.compared[held_out.segments.rows[:, 0]].all()


def test_a_fall_ends_a_walk() -> None:
    log, _ = record_walk(Gait(), 5.0, push=lambda t: np.array([0.0, 25.0 * (3.0 < t < 3.4), 0.0]))
    walked, base = reconstruct(load_robot("nao"), log)
    assert any(e.kind == "fall" for e in base.events)
    assert 2.5 < walked.time[-1] < 3.6
    assert len(base.time) == len(walked)


@cache
def best_segments() -> tuple[Segments, tuple[SegmentLength, ...]]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(segments_module, "LENGTHS", (0.1, 0.2))
        patch.setattr(segments_module, "TRIED", 4)
        return segment_best(load_robot("nao"), *reconstructed(), (7.0,), threads=2)


def test_the_length_of_segments_weighs_information_against_misfit() -> None:
    segments, lengths = best_segments()
    assert [c.seconds for c in lengths] == pytest.approx([0.2, 0.1])  # the model is right: longer is better
    longer, shorter = lengths
    assert longer.information > shorter.information
    assert longer.misfit < 2.0
    assert longer.score == pytest.approx(longer.information - np.log(longer.misfit))
    assert segment_seconds(segments, reconstructed()[0]) == pytest.approx(0.2)


def test_a_log_with_too_little_walking_is_refused() -> None:
    log, _ = plain_walk()
    with pytest.raises(LogError, match="record more walking"):
        segment_log(*reconstruct(load_robot("nao"), log.window(0, 30)), 0.2)


# --- fits -----------------------------------------------------------------------------------------------


def nao_study(*logs: Log, numerics: Numerics | None = None) -> Study:
    """A study of the Nao whose segments have one of two lengths; what chooses among more is tested above."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(segments_module, "LENGTHS", (0.2, 0.3))
        patch.setattr(segments_module, "TRIED", 4)
        return make_study(load_robot("nao"), logs, numerics=numerics, mode=WINDOWS, threads=2)


@cache
def heavy_walk() -> Log:
    return record_walk(Gait(), 8.0, edit=heavier("LKneePitch", 1.4))[0]


@cache
def heavy_study() -> Study:
    return nao_study(heavy_walk())


HEAVY = {"mass:RKneePitch": 1.0, "mass:LKneePitch": 1.4, "kp:*": 1.0}


@lru_cache
def heavy_fit() -> Fit:
    return fit(heavy_study(), ["mass:LKneePitch,RKneePitch", "kp:*=shared"])


def test_masses_are_found_on_a_walk() -> None:
    found = heavy_fit()
    assert {e.name for e in found.estimates} == set(HEAVY)
    for estimate in found.estimates:
        assert abs(estimate.value - HEAVY[estimate.name]) < 0.06, estimate
        assert estimate.std < 0.1
    before, nominal = found.before.holdout["position"], found.nominal.holdout["position"]
    assert before.chi2 < nominal.chi2
    assert before.rmse < 1.5 * before.floor


def test_masses_on_a_walk_lie_within_their_intervals() -> None:
    for estimate in heavy_fit().estimates:
        low, high = estimate.ci95
        assert low <= HEAVY[estimate.name] <= high, estimate


def test_the_plain_model_is_judged_from_the_initial_states_that_it_wants_itself() -> None:
    found, given = heavy_fit(), heavy_study()
    alone = score(replace(given, numerics=found.study.numerics), Model.of(()))
    for part, own in ((found.nominal.train, alone.train), (found.nominal.holdout, alone.holdout)):
        assert own["position"].chi2 == pytest.approx(part["position"].chi2, rel=1e-6)


def test_the_ground_reaches_the_bodies_that_carry_the_base() -> None:
    study = heavy_study()
    masses, gains = ["mass:LKneePitch,RShoulderRoll,Torso", "mass:*HipRoll=shared"], ["kp:LKneePitch"]
    problem = study.train_problem(study.declare([*masses, *gains, "foot_compliance:*AnkleRoll=shared"]))
    told = dict(zip((p.name for p in problem.parameters), of_legs(problem), strict=True))
    assert {name for name, own in told.items() if own} == {
        "mass:LKneePitch",
        "foot_compliance:*AnkleRoll",
        "mass:*HipRoll",
    }


def test_a_robot_that_walks_and_hangs_is_known_better_than_from_either_log() -> None:
    walked = heavy_walk()
    held = replace(walked.window(0, 200), meta=replace(walked.meta, mount="fixed"))
    run = replay_log(load_robot("nao"), held, {"mass:LKneePitch": 1.4}, numerics=Numerics("RK4", 0.0025))
    rng = np.random.default_rng(2)
    seen = {n: c + rng.normal(scale=4e-4, size=len(c)) for n, c in run.channels.items() if n.startswith("position")}
    hanging = replace(held, channels={n: c for n, c in held.channels.items() if n.startswith("command")} | seen)
    free = ["mass:LKneePitch,RKneePitch", "kp:*=shared"]
    alone = fit(nao_study(hanging), free)
    both = fit(nao_study(hanging, walked), free)
    for estimate, hung, walking in zip(both.estimates, alone.estimates, heavy_fit().estimates, strict=True):
        assert abs(estimate.value - HEAVY[estimate.name]) < 3 * estimate.std, estimate
        # a standard error is itself known to a few percent
        assert estimate.std < 1.05 * min(hung.std, walking.std), (hung, walking)


def test_the_stride_is_the_time_after_which_the_commands_of_a_walk_repeat() -> None:
    size = reconstructed()[1].size
    for period in (0.8, 1.3, 2.4):
        time = np.arange(0.0, 12.0, 0.02)
        commands = {f"command.{j}": c for j, c in gait(Gait(period=period), time).items()}
        log = replace(plain_walk()[0], time=time, channels=commands, episode=np.zeros(len(time), dtype=np.int64))
        assert stride(log, size) == pytest.approx(period, abs=0.03)
    rng = np.random.default_rng(1)
    for scale in (Scale(3.0), Scale(1 / 3)):
        found = stride(scale.log(log), measure_size(scale.robot.compile()))
        assert found == pytest.approx(scale.time * period, abs=0.06)
    wandering = {name: np.cumsum(rng.normal(size=len(time))) for name in commands}
    assert stride(replace(log, channels=wandering), size) is None


@cache
def small_study(length: float) -> Study:
    """Of the same walk of a Nao so many times as long."""
    scale = Scale(length)
    with pytest.MonkeyPatch.context() as patch, scale.sensors():
        patch.setattr(segments_module, "LENGTHS", (0.1, 0.2))
        patch.setattr(segments_module, "TRIED", 2)
        return make_study(scale.robot, [scale.log(plain_walk()[0].window(50, 150))], mode=WINDOWS, threads=2)


@pytest.mark.slow
@pytest.mark.parametrize("length", [3.0, 1 / 3])
def test_a_walk_of_another_size_poses_the_same_problem(length: float) -> None:
    problems, deviations = [], []
    pace = Scale(length).time
    own, other = small_study(1.0), small_study(length)
    for study in (own, other):
        problem = study.train_problem(study.declare(["mass:LKneePitch,Torso", "kp:*=shared"]))
        residual, jacobian = linearise(problem, problem.start, step=study.stencil(problem.terms))
        problems.append((residual, jacobian, problem.blocks))
        deviations.append(estimates(problem.parameters, problem.start, jacobian, residual, problem.blocks))
    for mine, theirs in zip(*problems, strict=True):
        assert np.abs(mine - theirs).max() < 1e-6 * np.abs(mine).max()
    assert [e.std for e in deviations[1]] == pytest.approx([e.std for e in deviations[0]])
    for mine, theirs in zip((*own.train, *own.holdout), (*other.train, *other.holdout), strict=True):
        assert isinstance(mine, FloatingEpisode)
        assert isinstance(theirs, FloatingEpisode)
        assert np.array_equal(mine.segments.rows, theirs.segments.rows)
        assert len(mine.shortened(0.5).segments) == len(theirs.shortened(0.5).segments) < len(mine.segments)
        for a, b in zip(mine.lengths, theirs.lengths, strict=True):
            assert (b.seconds, b.information, b.misfit) == pytest.approx((pace * a.seconds, a.information, a.misfit))
    steps = [(s.numerics.timestep, s.coarse.timestep, s.cheap.timestep) for s in (own, other)]
    assert steps[1] == pytest.approx(pace * np.array(steps[0]))


@pytest.mark.slow
def test_the_motion_of_a_robot_of_another_size_tells_as_much_of_its_masses() -> None:
    found = []
    for scale in (Scale(1.0), Scale(3.0)):
        study = small_study(scale.length)
        problem = study.train_problem(study.declare(["mass:LKneePitch,LShoulderRoll"]))
        with scale.sensors():
            known = without_ground(problem, problem.start)
        assert known is not None
        found.append(known)
    own, other = found
    assert np.abs(other.mean - own.mean).max() < 1e-4 * np.sqrt(np.diag(own.covariance)).min()
    np.testing.assert_allclose(other.covariance, own.covariance, rtol=1e-4)


def test_an_error_that_every_stride_repeats_is_not_averaged_away() -> None:
    study = heavy_study()
    problem = study.train_problem(study.declare(["mass:LKneePitch"]))
    (episode,) = problem.episodes
    (target,) = episode.targets
    rng = np.random.default_rng(0)
    sample, _ = np.nonzero(target.mask)
    # a parameter that every sample tells alike
    jacobian = np.ones((len(sample), 1))
    noise = rng.normal(size=len(sample))
    phase = np.mod(episode.replay.log.time[sample], 1.0)
    systematic = 0.5 * np.sin(2 * np.pi * phase)
    clean = repeated_error(problem, jacobian, noise)[0]
    dirty = repeated_error(problem, jacobian, noise + systematic)[0]
    white = 1 / np.linalg.norm(jacobian)
    assert clean < 2.0 * white
    assert dirty > 3.0 * white


def test_a_fit_by_deferred_correction_is_that_of_the_right_integrator() -> None:
    log = swing(("arm",), seconds=4.0)
    robot = pendulum()
    measured = replay_log(robot, log, {"mass:arm": 1.3, "kp:arm": 0.9}, numerics=Numerics("RK4", 0.005))
    study = make_study(robot, [measured], numerics=Numerics("RK4", 0.005))
    problem = study.train_problem(study.declare(["mass:arm", "kp:arm"]))
    settings = {"rng": np.random.default_rng(0), "budget": Budget(), "journal": Journal(), "progress": silent}
    cheap = Numerics("implicitfast", 0.005)
    wrong = LeastSquares().fit(problem.with_numerics(cheap), **settings).x
    found = deferred_fit(problem, cheap, LeastSquares(), step=1e-3, **{**settings, "journal": Journal()})
    assert np.abs(found.x - [1.3, 0.9]).max() < 1e-3
    assert np.abs(wrong - [1.3, 0.9]).max() > 5 * np.abs(found.x - [1.3, 0.9]).max()
    assert found.residual is not None
    assert found.residual == pytest.approx(problem.residuals(found.x[None])[0], abs=1e-6)


@dataclass(frozen=True, eq=False)
class Misled(ToyProblem):
    """A problem whose cheap integrator says the opposite of what a parameter does."""

    deviation = 0.0

    def with_numerics(self, numerics: Numerics) -> Misled:
        return replace(self, function=lambda x: -self.function(x))


def test_where_cheap_derivatives_lead_astray_the_right_integrator_goes_on_alone() -> None:
    around = np.array([-1.0, 0.0, 1.0])
    problem = Misled(
        names=("x",),
        lower=np.full(1, -10.0),
        upper=np.full(1, 10.0),
        start=np.zeros(1),
        function=lambda x: x - 3.0 + around,
        optimum=np.full(1, 3.0),
    )
    settings = {"rng": np.random.default_rng(0), "budget": Budget(), "journal": Journal(), "progress": silent}
    found = deferred_fit(cast(Any, problem), Numerics("implicitfast", 0.005), LeastSquares(), step=1e-3, **settings)
    assert found.x == pytest.approx(problem.optimum, abs=1e-6)
    assert found.residual == pytest.approx(around, abs=1e-6)
    assert found.jacobian == pytest.approx(np.ones((3, 1)), abs=1e-6)


def test_a_free_and_a_held_log_are_fitted_together() -> None:
    log, _ = record_walk(Gait(), 5.0)
    held = replace(log.window(0, 200), meta=replace(log.meta, mount="fixed"))
    study = make_study(load_robot("nao"), [log, held], numerics=Numerics("RK4", 0.005), threads=2)
    problem = study.train_problem(study.declare(["mass:LKneePitch", "mass:RShoulderRoll"]))
    walk, gantry = (e.replay for e in problem.episodes)
    assert isinstance(walk, FloatingReplay)
    assert not isinstance(gantry, FloatingReplay)
    assert walk.model.nq == gantry.model.nq + 7
    # a free base lets every parameter reach every joint
    assert all(len(group) == 1 for group in problem.groups)
    assert np.isfinite(problem.residuals(problem.start[None])).all()


def test_a_walk_and_a_held_log_together_tell_more_than_either() -> None:
    robot = load_robot("nao")
    walked, _ = record_walk(Gait(), 4.0)
    held = replay_log(robot, replace(walked, meta=replace(walked.meta, mount="fixed")), numerics=Numerics("RK4", 0.005))
    rng = np.random.default_rng(5)
    noisy = {k: v for k, v in held.channels.items() if k.startswith("command")}
    for name in held.joints("position"):
        noisy[f"position.{name}"] = held.channels[f"position.{name}"] + rng.normal(scale=5e-4, size=len(held))
    held = replace(held, channels=noisy)

    def deviations(*logs: Log) -> np.ndarray:
        study = nao_study(*logs, numerics=Numerics("RK4", 0.005))
        problem = study.train_problem(study.declare(["mass:LKneePitch", "mass:LHipPitch"]))
        residual, jacobian = linearise(problem, problem.start, step=study.stencil(problem.terms))
        found = estimates(problem.parameters, problem.start, jacobian, residual, problem.blocks)
        return np.array([e.std for e in found])

    together, alone = deviations(walked, held), (deviations(walked), deviations(held))
    assert np.all(together < 1.02 * np.minimum(*alone)), (together, alone)
    assert together.sum() < 0.95 * np.minimum(*alone).sum()


def test_the_recorded_fall_is_not_scored(shared_data: Path) -> None:
    folder = shared_data / "nao_walk"
    robot = load_robot(str(folder / "nominal_free.xml"))
    study = make_study(robot, [read_log(folder / "walk_fall.parquet")], threads=2)
    assert study.train[0].log.time[-1] < 9.0
    assert all(episode.log.time[-1] < 9.0 for episode in study.holdout)
