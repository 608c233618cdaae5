"""Walks compared sample by sample with what those before it lead one to expect."""

from __future__ import annotations

import pickle
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import mujoco
import numpy as np
import pytest
from test_contact_free import random_states
from walks import heavier, record_walk

import sysid_btr as sb
from benchmarks import ground
from sysid_btr.errors import ModelError, UsageError
from sysid_btr.floating_base import chain as chain_module
from sysid_btr.floating_base import innovations
from sysid_btr.floating_base.chain import Chain, Derivatives, derive, stale
from sysid_btr.floating_base.episode import FloatingEpisode
from sysid_btr.floating_base.innovations import Innovations, InnovationsEpisode, filter_at, follow_states, kalman_filter
from sysid_btr.floating_base.size import NAO
from sysid_btr.identify.fit import Fit, fit
from sysid_btr.identify.mode import Mode
from sysid_btr.identify.study import Study, make_study
from sysid_btr.io.log import Log
from sysid_btr.models.builtin import load_robot
from sysid_btr.models.gait import Gait
from sysid_btr.objectives.problem import ReplayProblem
from sysid_btr.simulation.numerics import Numerics
from sysid_btr.terms.model import Model, Terms


def random_chain(rng: np.random.Generator, linked: Sequence[bool]) -> tuple[Chain, Derivatives]:
    """A chain of two joints and a foot, and steps that are linear."""
    joints, feet = 2, 1
    w, n = len(linked), len(linked) + 1
    states = random_states(n, joints, rng)
    d = states.std.shape[1]
    chain = Chain(
        steps=cast(Any, SimpleNamespace(wrench=np.zeros((w, feet, 6)))),
        states=states,
        touch=np.ones((w, feet), dtype=bool),
        linked=np.array(linked),
        measured=rng.normal(size=(n, joints + 5)),
        sigma=np.where(rng.random((n, joints + 5)) < 0.2, np.inf, 0.5),
        time=np.arange(n) * 0.02,
        size=replace(NAO, weight=0.01),
        reach=0.01 * (np.eye(6) + 0.1 * np.random.default_rng(0).normal(size=(w, feet, 6, 6))),
    )
    shapes = [(w, d, d), *[(w, d, 6 * feet)] * 3, (w, d, joints)]
    return chain, Derivatives(*(0.3 * rng.normal(size=shape) for shape in shapes))


def by_noise(
    chain: Chain, known: Derivatives, monkeypatch: pytest.MonkeyPatch, slack: float = 1.0
) -> tuple[np.ndarray, innovations.Filter]:
    """Innovations (n j, r) of every unit of noise where the model is right, under gains that allow for so much slack;
    and the filter."""
    states, linked = chain.states, chain.linked
    (n, joints), (w, d) = states.joint_position.shape, known.start.shape[:2]
    keep = np.setdiff1d(np.arange(d), chain_module.BLIND)
    sight = chain_module.measurements(chain)[0]
    total = chain_module.unexplained(chain, known)[1][:, keep][:, :, keep]
    prior = chain_module.each_of(chain_module.LOOSE, chain)[keep]

    def shown(start: np.ndarray, moved: np.ndarray, noise: np.ndarray) -> np.ndarray:
        """Innovations of states and measurements that are off by so many of their standard deviations."""
        error, seen = prior * start[0], []
        for k in range(n):
            seen.append(-(sight[k][:, keep] @ error + noise[k]))
            if k < w and linked[k]:
                error = known.start[k][np.ix_(keep, keep)] @ error + np.linalg.cholesky(total[k]) @ moved[k]
            elif k < w:
                error = prior * start[1]
        monkeypatch.setattr(innovations, "measurements", lambda _: (sight, np.array(seen)))
        own = kalman_filter(replace(chain, slack=slack), known, *np.zeros((2, w, d)))
        # what steps that are linear miss of the states, from where they begin and under the forces they have
        moved_by, force = chain_module.difference(own.filtered, states)[:-1], own.wrench.reshape(w, -1)
        missed = np.einsum("kij,kj->ki", known.start, moved_by) + np.einsum("kij,kj->ki", known.mean, force)
        return own.innovations(np.where(linked[:, None], missed[:, keep], 0.0)[None]).ravel()

    sizes = [(2, len(keep)), (w, len(keep)), (n, joints + 5)]
    count = sum(a * b for a, b in sizes)
    columns = []
    for unit in np.eye(count):
        parts = np.split(unit, np.cumsum([a * b for a, b in sizes])[:-1])
        columns.append(shown(*(part.reshape(size) for part, size in zip(parts, sizes, strict=True))))
    return np.column_stack(columns), kalman_filter(replace(chain, slack=slack), known, *np.zeros((2, w, d)))


def test_innovations_are_white_where_the_model_is_right(monkeypatch: pytest.MonkeyPatch) -> None:
    shown, own = by_noise(*random_chain(np.random.default_rng(4), [True, True, False, True]), monkeypatch)
    np.testing.assert_allclose(shown @ shown.T, np.eye(own.share.size), atol=1e-7)


def test_what_the_right_model_leaves_is_known_under_gains_that_allow_for_a_wrong_one(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    chain, known = random_chain(np.random.default_rng(4), [True, True, False, True])
    known = replace(known, mean=np.zeros_like(known.mean))  # whose share is not the noise's
    shown, own = by_noise(chain, known, monkeypatch, slack=125.0)
    np.testing.assert_allclose(np.sum(shown**2, axis=1), own.share.ravel(), rtol=1e-6)
    assert own.share.min() < 0.98


def test_a_sample_is_predicted_from_what_was_before_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """The states about which a filter is linearised know later samples; from where it predicts must not show them."""
    rng = np.random.default_rng(5)
    chain, known = random_chain(rng, [True] * 6)
    sight, left = chain_module.measurements(chain)
    (w, d), defect = known.start.shape[:2], 0.01 * rng.normal(size=known.start.shape[:2])
    other = np.concatenate([np.zeros((1, d)), 0.1 * rng.normal(size=(w, d))])
    other[:, list(chain_module.BLIND)] = 0.0

    def found(states: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Filtered states and forces of the same samples, linearised about other states."""
        seen = left + np.einsum("kmd,kd->km", sight, states)
        missed = defect + np.einsum("kij,kj->ki", known.start, states[:-1]) - states[1:]
        monkeypatch.setattr(innovations, "measurements", lambda _: (sight, seen))
        own = kalman_filter(chain, known, missed, np.zeros((w, d)))
        return chain_module.difference(own.filtered, chain.states) + states, own.wrench

    for one, same in zip(found(np.zeros((w + 1, d))), found(other), strict=True):
        np.testing.assert_allclose(one, same, atol=1e-9)
    assert np.abs(found(other)[1]).max() > 1e-4  # forces that nobody knew are found


@cache
def walk(delay: float = 0.0) -> Log:
    return record_walk(Gait(), 4.6, edit=heavier("LKneePitch", 1.4), delay=delay)[0]


@cache
def study(delay: float = 0.0) -> Study:
    return make_study(load_robot("nao"), [walk(delay)], threads=2)


def fitted_part() -> tuple[Chain, Derivatives, np.ndarray]:
    """The chain of what is fitted of the walk, its derivatives, and the numbers of the plain model."""
    episode = study().train[0]
    assert isinstance(episode, InnovationsEpisode)
    assert episode.chain is not None
    assert episode.known is not None
    n = len(episode.log)
    chain, known = episode.chain.part(0, n), episode.known.part(0, n)
    return chain, known, Terms(chain.steps.terms).nominal


@cache
def found() -> Fit:
    return fit(study(), ["mass:LKneePitch,RKneePitch", "kp:*=shared"])


def test_a_walk_is_compared_by_its_innovations() -> None:
    fitted, held = study().train[0], study().holdout[0]
    assert isinstance(fitted, InnovationsEpisode)
    assert isinstance(held, InnovationsEpisode)
    assert not np.any(fitted.compared & held.compared[: len(fitted.log)])
    facts = fitted.facts()
    assert (facts["mode"], facts["why"]) == ("innovations", "its base floats")
    assert facts["samples"] == fitted.compared.sum() > 0


def test_masses_and_gains_lie_within_their_intervals_and_only_noise_is_left() -> None:
    truth = {"mass:LKneePitch": 1.4, "mass:RKneePitch": 1.0, "kp:*": 1.0}
    for estimate in found().estimates:
        assert abs(estimate.value - truth[estimate.name]) < 2.5 * estimate.std, estimate
        assert estimate.std < 0.1
    columns = study().train_problem(found().study.declare(["mass:LKneePitch,RKneePitch", "kp:*=shared"]))
    chi2 = columns.column_chi2(columns.residuals(found().optimum[None])[0])
    assert 0.5 < np.median(chi2) < 1.2
    assert chi2.max() < 1.7
    assert found().misfit is None


def _rough(spec: mujoco.MjSpec) -> None:
    for joint in spec.joints:
        if joint.type == mujoco.mjtJoint.mjJNT_HINGE:
            joint.frictionloss = 0.2


@pytest.mark.slow
def test_innovations_are_white_where_joints_stick_and_slip() -> None:
    log = record_walk(Gait(), 4.0, edit=_rough)[0]
    begun = make_study(load_robot("nao"), [log], threads=2)
    terms = begun.declare(["coulomb_friction:*=shared"])
    followed = begun
    for _ in range(2):
        followed = followed.with_initial_states(Model(terms, np.array([0.2])), held_out=False)

    def chi2(study: Study, friction: float) -> float:
        problem = study.train_problem(terms)
        return float(np.mean(problem.column_chi2(problem.residuals(np.array([[friction]]))[0])))

    # about the states, and by the derivatives, of a model without friction, friction only disturbs
    right = chi2(followed, 0.2)
    assert 0.5 < right < 1.4
    assert chi2(begun, 0.2) > 1.5 * right
    assert all(chi2(followed, other) > 1.02 * right for other in (0.1, 0.15, 0.25, 0.3))


@pytest.mark.slow
def test_dry_friction_of_a_walk_is_found_from_none_and_leaves_the_gains_alone() -> None:
    log = record_walk(Gait(), 4.0, edit=_rough)[0]
    told = fit(make_study(load_robot("nao"), [log], threads=2), ["coulomb_friction:*=shared", "kp:*=shared"])
    for estimate, truth in zip(told.estimates, (0.2, 1.0), strict=True):
        assert abs(estimate.value - truth) < 3 * estimate.std, estimate
        assert estimate.std < 0.25 * truth, estimate
    assert told.misfit is None


def test_what_a_joint_holds_that_stands_still_is_not_known_and_does_not_depend_on_the_candidate() -> None:
    log = record_walk(Gait(), 2.0, edit=_rough)[0]
    begun = make_study(load_robot("nao"), [log], threads=2)
    terms = begun.declare(["coulomb_friction:*=shared"])
    episode = begun.with_initial_states(Model(terms, np.array([0.2])), held_out=False).train[0]
    assert isinstance(episode, InnovationsEpisode)
    assert episode.chain is not None
    chain, steps = episode.chain, episode.chain.steps
    still = steps.still
    speed = np.abs(chain.states.joint_velocity[:-1])
    assert np.all(still[speed < 0.05])
    assert 0.05 < still.mean() < 1.0
    every = np.arange(len(still))
    less, more = (
        steps.ends(np.array([[friction]]), np.zeros(len(every), dtype=np.int64), every, None) for friction in (0.1, 0.3)
    )
    same = np.all(less.joint_velocity == more.joint_velocity, axis=1)
    assert np.array_equal(same, still.all(axis=1))


def test_derivatives_are_kept_where_they_foretell_what_a_step_does() -> None:
    chain, known, values = fitted_part()
    assert np.mean(stale(chain, known, values, 0)) < 0.05
    other = replace(known, start=2.0 * known.start)
    assert np.all(stale(chain, other, values, 0)[chain.linked])
    some = np.arange(len(chain.linked)) % 3 == 0
    mended = other.renewed(some, derive(chain, values, np.flatnonzero(some)))
    assert np.mean(stale(chain, mended, values, 1)[some]) < 0.05
    np.testing.assert_array_equal(mended.start[~some], other.start[~some])


def test_states_from_which_simulations_fail_are_not_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    chain, known, values = fitted_part()

    def wild(chain: Chain, known: Derivatives, found: object) -> Chain:
        change = np.zeros_like(chain.states.std)
        change[len(change) // 2, -1] = 1e12
        states = chain.states.moved(change)
        starts = states.chosen(np.arange(len(change) - 1))
        return replace(chain, states=states, steps=replace(chain.steps, segments=starts))

    monkeypatch.setattr(innovations, "moved_chain", wild)
    left, there = follow_states(chain, known, values, 2)
    np.testing.assert_array_equal(left.states.joint_velocity, chain.states.joint_velocity)
    assert np.isfinite(filter_at(left, there, values).misfit)
    with pytest.raises(ModelError, match="diverges within a sample"):
        filter_at(wild(chain, known, None), known, values)


def test_where_nothing_rubs_small_changes_to_one_side_give_the_derivatives_of_both() -> None:
    episode = study().train[0]
    assert isinstance(episode, InnovationsEpisode)
    assert episode.chain is not None
    chain = episode.chain.part(0, 40)
    assert chain.steps.friction is None
    values = Terms(chain.steps.terms).nominal
    none = replace(chain, steps=replace(chain.steps, friction=np.zeros(len(chain.steps.index.dof))))
    one, both = derive(chain, values), derive(none, values)
    for name in ("start", "mean"):
        side, middle = getattr(one, name), getattr(both, name)
        assert np.linalg.norm(side - middle) < 0.02 * np.linalg.norm(middle)


def test_predictions_are_right_to_a_thousandth_of_the_noise_and_derivatives_to_a_hundredth() -> None:
    terms = study().declare(["mass:LKneePitch", "kp:*=shared"])
    problem = study().with_initial_states(Model.of(terms)).train_problem(Model.of(terms))
    nominal = Terms(terms).nominal
    near = np.array([nominal, nominal * [1.3, 1.0], nominal * [1.0, 0.8]])

    def residuals(numerics: Numerics) -> np.ndarray:
        return problem.with_numerics(numerics).residuals(near)

    right, ours, cheap = map(residuals, (Numerics("RK4", 0.001), study().numerics, study().cheap))
    assert (study().numerics.timestep, study().cheap.timestep) == pytest.approx((0.005, 0.01))
    assert np.sqrt(np.mean((ours - right) ** 2)) < 2e-3
    change = right[1:] - right[0]
    assert np.all(np.linalg.norm(cheap[1:] - cheap[0] - change, axis=1) < 0.02 * np.linalg.norm(change, axis=1))


def test_where_a_law_may_make_joints_stick_derivatives_are_of_both_sides() -> None:
    episode = study().train[0]
    assert isinstance(episode, InnovationsEpisode)
    assert episode.chain is not None
    steps = episode.chain.steps
    assert steps.smooth
    sticking = study().declare(["stribeck_friction:LKneePitch"])
    assert not replace(steps, terms=sticking).smooth


@pytest.mark.slow
def test_masses_are_right_on_a_ground_that_the_model_does_not_know() -> None:
    walker = ground.draw(5)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ground, "SECONDS", 6.0)
        log = ground.record(walker)
    assert log is not None
    freed = ["mass:*KneePitch,*HipPitch,*HipRoll,*ShoulderRoll", "kp:*=shared", "kv:*=shared"]
    told = fit(make_study(load_robot("nao"), [log], threads=2), freed)
    truth = {f"mass:{name}": factor for name, factor in walker.masses.items()} | {"kp:*": walker.kp, "kv:*": walker.kv}
    error = np.array([(e.value - truth[e.name]) / e.std for e in told.estimates])
    assert np.abs(error).max() < 3.5, dict(zip((e.name for e in told.estimates), error, strict=True))
    assert np.sqrt(np.mean(error**2)) < 1.6


@pytest.mark.slow
def test_masses_of_a_walk_in_another_engine_lie_within_their_intervals(shared_data: Path) -> None:
    log = sb.read_log(shared_data / "nao_walk_soles" / "logs" / "soles_a.parquet")
    part = log.window(0, int(np.searchsorted(log.time, log.time[0] + 9.0)))
    told = fit(make_study(load_robot("nao"), [part], threads=2), ["mass:*HipPitch,*KneePitch", "kp:*=shared"])
    truth = {
        "mass:RHipPitch": 1.2,
        "mass:LHipPitch": 1.25,
        "mass:RKneePitch": 0.85,
        "mass:LKneePitch": 0.8,
        "kp:*": 1.0,
    }
    for estimate in told.estimates:
        assert abs(estimate.value - truth[estimate.name]) < 3 * estimate.std, estimate
        assert estimate.std < 0.1


@pytest.mark.slow
def test_a_delay_is_named_with_its_amount_and_nothing_on_a_clean_walk() -> None:
    effects, freed = ["command_delay", "coulomb_friction"], ["mass:LKneePitch,RKneePitch", "kp:*=shared"]
    late = sb.close(study(0.03), freed, effects=effects)
    assert late.verdict == "explained"
    (delay,) = (e for e in late.estimates if e.name.startswith("command_delay"))
    assert delay.value == pytest.approx(0.03, abs=0.0015)
    assert next(e.value for e in late.estimates if e.name == "mass:LKneePitch") == pytest.approx(1.4, abs=0.15)
    assert sb.close(study(), freed, effects=effects).verdict == "nothing_missing"


def test_a_candidate_has_the_same_bits_whatever_is_beside_it_and_in_another_process() -> None:
    problem = study().train_problem(study().declare(["mass:LKneePitch", "kp:*=shared"]))
    assert isinstance(problem.episodes[0], Innovations)
    candidates = np.array([[0.8, 1.0], [1.3, 0.9], [1.0, 1.1]])
    together = problem.residuals(candidates)
    assert np.array_equal(problem.residuals(candidates[1:2])[0], together[1])
    elsewhere: ReplayProblem = pickle.loads(pickle.dumps(problem))
    assert np.array_equal(elsewhere._residuals(candidates), together)


def test_fewer_seconds_are_those_that_move_most() -> None:
    (whole,) = study().train
    assert isinstance(whole, InnovationsEpisode)
    short = whole.shortened(1.0)
    assert 0.9 < short.log.time[-1] - short.log.time[0] - innovations.SETTLING < 1.1
    plain = replace(study(), train=(short,)).train_problem(())
    assert 0 < plain.count < study().train_problem(()).count
    # the filter of a part is the filter: once its beginning is forgotten it shows the same
    start = int(np.searchsorted(whole.log.time, short.log.time[0]))
    ours, all_of_it = (p.residuals(np.zeros((1, 0)))[0].reshape(-1, 22) for p in (plain, study().train_problem(())))
    first = int(np.argmax(short.compared)) + start - int(np.argmax(whole.compared))
    np.testing.assert_allclose(ours[-10:], all_of_it[first : first + len(ours)][-10:], atol=0.3)


def test_what_needs_the_ground_or_a_past_is_refused_with_the_way_out() -> None:
    for expression in ("foot_compliance:*AnkleRoll=shared", "backlash:LKneePitch"):
        with pytest.raises(UsageError, match="--mode segments"):
            study().declare([expression])


def test_a_walk_that_does_not_suit_is_replayed_by_segments() -> None:
    log = walk()
    time = log.time.copy()
    time[1::2] += 0.003
    uneven = replace(log, time=time)
    assert isinstance(make_study(load_robot("nao"), [uneven], threads=2).train[0], FloatingEpisode)
    with pytest.raises(UsageError, match="equal intervals"):
        make_study(load_robot("nao"), [uneven], mode=Mode("innovations"), threads=2)
    with pytest.raises(UsageError, match="--mode segments"):
        make_study(load_robot("nao"), [log], mode=Mode("inverse"), threads=2)
