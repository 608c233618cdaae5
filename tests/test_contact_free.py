"""Masses from walks where nothing is known of the ground."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from typing import Any, cast

import numpy as np
import pytest
from walks import record_walk

from benchmarks import ground
from sysid_btr.floating_base import chain as chain_module
from sysid_btr.floating_base.chain import difference
from sysid_btr.floating_base.contact_free import without_ground
from sysid_btr.floating_base.segments import FloatingReplay
from sysid_btr.floating_base.size import NAO
from sysid_btr.identify.intervals import estimates
from sysid_btr.identify.mode import Mode
from sysid_btr.identify.study import Study, make_study
from sysid_btr.models.builtin import load_robot
from sysid_btr.models.gait import Gait
from sysid_btr.objectives.covariance import Known
from sysid_btr.objectives.problem import ReplayProblem
from sysid_btr.simulation.base_states import BASE, BaseStates
from sysid_btr.simulation.segments import Segments

OnSprings = tuple[ground.Walker, Study, ReplayProblem, np.ndarray]
MASSES = ["mass:*KneePitch,*HipPitch,*HipRoll,*ShoulderRoll", "kp:*=shared", "kv:*=shared"]


def random_states(n: int, joints: int, rng: np.random.Generator) -> Segments:
    quaternion = rng.normal(size=(n, 4))
    quaternion /= np.linalg.norm(quaternion, axis=1, keepdims=True)
    rows = np.stack([np.arange(n), np.arange(n) + 2], axis=1)
    three = (rng.normal(size=(n, 3)) for _ in range(3))
    position, velocity, rate = three
    q, dq = rng.normal(size=(2, n, joints))
    base = BaseStates(position, quaternion, velocity, rate)
    return Segments(rows, q, dq, np.ones((n, BASE + 2 * joints)), base)


def problem_of(study: Study, values: dict[str, float] | None = None) -> tuple[ReplayProblem, np.ndarray]:
    terms = study.declare(MASSES)
    problem = study.train_problem(terms)
    begin = np.array([(values or {}).get(p.name, p.nominal) for p in problem.parameters])
    return problem, begin


def test_difference_undoes_a_move() -> None:
    rng = np.random.default_rng(3)
    states = random_states(7, 4, rng)
    change = 0.3 * rng.normal(size=states.std.shape)
    np.testing.assert_allclose(difference(states.moved(change), states), change, atol=1e-12)


def test_knowledge_from_two_sources_is_weighed_by_its_precision() -> None:
    known = Known(np.array([2]), np.array([1.0]), np.array([[0.04]]))
    both = known.joined(np.array([2.0]), np.array([[0.01]]))
    assert both.mean[0] == pytest.approx((1.0 / 0.04 + 2.0 / 0.01) / (1 / 0.04 + 1 / 0.01))
    assert both.covariance[0, 0] == pytest.approx(1 / (1 / 0.04 + 1 / 0.01))
    far = known.joined(np.array([5.0]), np.array([[1e9]]))
    assert far.mean[0] == pytest.approx(1.0, abs=1e-6)


def test_what_is_held_moves_what_is_known_of_the_others() -> None:
    covariance = np.array([[0.04, -0.03, 0.0], [-0.03, 0.09, 0.01], [0.0, 0.01, 0.02]])
    known = Known(np.array([1, 4, 5]), np.array([1.0, 2.0, 3.0]), covariance)
    values = np.array([9.0, 1.0, 9.0, 9.0, 2.5, 3.0])
    beside = known.beside(np.array([0, 4]), values)
    np.testing.assert_allclose(beside, [1.0 - 0.03 / 0.09 * 0.5, 2.5, 3.0 + 0.01 / 0.09 * 0.5])
    np.testing.assert_allclose(known.beside(np.array([0]), values), known.mean)
    low = np.array([0.0, 0.0, 0.0, 0.0, 2.5, 0.0])
    np.testing.assert_allclose(known.within(low, np.full(6, 9.0)), beside)


def test_states_and_forces_are_integrated_out_as_a_dense_solver_does() -> None:
    rng = np.random.default_rng(8)
    n, joints, feet, p = 5, 3, 2, 4
    states = random_states(n, joints, rng)
    d, w = states.std.shape[1], n - 1
    chain = chain_module.Chain(
        steps=cast(Any, None),
        states=states,
        touch=np.ones((w, feet), dtype=bool),
        linked=np.array([True, True, False, True]),
        measured=rng.normal(size=(n, joints + 5)),
        sigma=np.where(rng.random((n, joints + 5)) < 0.2, np.inf, 0.5),
        time=np.arange(n) * 0.02,
        size=replace(NAO, weight=0.01),
        reach=0.01 * (np.eye(6) + 0.1 * rng.normal(size=(w, feet, 6, 6))),
    )
    shapes = [(w, d, d), *[(w, d, 6 * feet)] * 3, (w, d, joints)]
    known = chain_module.Derivatives(*(0.1 * rng.normal(size=s) for s in shapes))
    ends = chain_module.Ends(1e-3 * rng.normal(size=(w, d)), 1e-3 * rng.normal(size=(w, d, p)))
    found = chain_module.linearise_chain(chain, known, ends)

    forces, _ = chain_module.unexplained(chain, known)
    slack, loose = (chain_module.each_of(kinds, chain) for kinds in (chain_module.SLACK, chain_module.LOOSE))
    sight, seen = chain_module.measurements(chain)
    k = forces.shape[2]
    unknown = n * d + w * k
    rows, rests, numbers = [np.zeros((n * d, unknown))], [np.zeros(n * d)], [np.zeros((n * d, p))]
    rows[0][:, : n * d] = np.diag(1 / np.tile(loose, n))
    for i in range(n):
        own = np.zeros((joints + 5, unknown))
        own[:, i * d : (i + 1) * d] = sight[i]
        rows.append(own)
        rests.append(seen[i])
        numbers.append(np.zeros((joints + 5, p)))
    for i in np.flatnonzero(chain.linked):
        own = np.zeros((d + k, unknown))
        own[:d, i * d : (i + 1) * d] = known.start[i] / slack[:, None]
        own[:d, (i + 1) * d : (i + 2) * d] = -np.diag(1 / slack)
        at = n * d + i * k
        own[:d, at : at + k] = forces[i] / slack[:, None]
        own[d:, at : at + k] = np.eye(k)
        rows.append(own)
        rests.append(np.concatenate([ends.defect[i] / slack, np.zeros(k)]))
        numbers.append(np.concatenate([ends.by_number[i] / slack[:, None], np.zeros((k, p))]))
    matrix, rest, by = np.concatenate(rows), np.concatenate(rests), np.concatenate(numbers)
    used = np.abs(matrix).sum(axis=0) > 0
    basis = np.linalg.qr(matrix[:, used])[0]

    def left(x: np.ndarray) -> np.ndarray:
        return x - basis @ (basis.T @ x)

    cost = float(found.left[:, 0] @ found.left[:, 0])
    assert cost == pytest.approx(float(rest @ left(rest)), rel=1e-6)
    own = found.left[:, 1:]
    np.testing.assert_allclose(own.T @ own, by.T @ left(by), rtol=1e-5, atol=1e-8 * np.abs(by.T @ by).max())
    own = own.T @ found.left[:, 0]
    np.testing.assert_allclose(own, by.T @ left(rest), rtol=1e-4, atol=1e-6 * np.abs(by.T @ rest).max())


@pytest.fixture(scope="module")
def on_springs() -> OnSprings:
    """A walk over springs and dampers, with masses far from the model's, and the problem that it poses."""
    walker = ground.draw(5)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ground, "SECONDS", 5.5)
        log = ground.record(walker)
    assert log is not None
    study = make_study(load_robot("nao"), [log], mode=Mode("segments"))
    return walker, study, *problem_of(study)


def test_masses_come_out_whatever_the_ground_is(on_springs: OnSprings) -> None:
    walker, study, problem, begin = on_springs
    found = without_ground(problem, begin)
    assert found is not None
    truth = {f"mass:{name}": factor for name, factor in walker.masses.items()}
    truth |= {"kp:*": walker.kp, "kv:*": walker.kv}
    std = np.sqrt(np.diag(found.covariance))
    error = np.array([m - truth[problem.parameters[i].name] for i, m in zip(found.which, found.mean, strict=True)])
    assert np.all(np.abs(error) < 3 * std), dict(zip(problem.names, zip(error, std, strict=True), strict=True))
    assert np.sqrt(np.mean((error / std) ** 2)) < 1.6
    by_name = dict(zip(problem.names, std, strict=True))
    assert max(by_name[f"mass:{side}KneePitch"] for side in "RL") < 0.15
    assert max(by_name[f"mass:{side}HipPitch"] for side in "RL") < 0.3

    # what a fit with the model's ground tells gives way to it
    rows = np.arange(60)
    jacobian = np.zeros((problem.count, len(begin)))
    jacobian[rows, rows % len(begin)] = 3.0
    weighed = study.fuse(problem, begin, jacobian, np.zeros(problem.count))
    assert weighed is not None
    assert weighed.known is not None
    told = estimates(
        problem.parameters,
        weighed.values,
        weighed.jacobian,
        weighed.residual,
        problem.blocks,
        weighed.error,
        weighed.known,
    )
    for e, mean, own in zip(told, found.mean, std, strict=True):
        assert e.std <= 1.001 * own
        assert abs(e.value - mean) < own


@pytest.mark.parametrize("start", [(1.0, 0.0001), (125.0, 0.009)])
def test_the_likeliest_slack_and_jolts_are_found_from_afar(start: tuple[float, float], on_springs: OnSprings) -> None:
    _, _, problem, values = on_springs
    replay = problem.episodes[0].replay
    assert isinstance(replay, FloatingReplay)
    chain = chain_module.chain_of(replay)
    known = chain_module.derive(chain, values)
    ends = chain_module.simulate_chain(chain, values, np.arange(0), np.zeros(0))
    found = chain_module.linearise_chain(chain, known, ends)
    chain = chain_module.moved_chain(chain, known, found)
    free = np.arange(2)
    ends = chain_module.simulate_chain(chain, values, free, 0.02 * (problem.upper - problem.lower)[free])

    def surprise(slack: float, jolt: float) -> float:
        found = chain_module.linearise_chain(replace(chain, slack=slack, jolt=jolt), known, ends)
        best = np.linalg.lstsq(found.left[:, 1:], found.left[:, 0])[0]
        return found.surprise - float(found.left[:, 0] @ found.left[:, 1:] @ best)

    slack = min(chain_module.SLACKS, key=lambda tried: surprise(tried, start[1]))
    wanted = slack, min(chain_module.JOLTS, key=lambda tried: surprise(slack, tried))
    chain = replace(chain, slack=start[0], jolt=start[1])
    likeliest = chain_module.likeliest(chain, known, ends, chain_module.SLACKS)
    assert (likeliest.slack, likeliest.jolt) == wanted


def test_a_long_walk_tells_them_by_stretches_spread_over_it(on_springs: OnSprings) -> None:
    replay = on_springs[2].episodes[0].replay
    assert isinstance(replay, FloatingReplay)
    chain = chain_module.chain_of(replay)
    assert chain_module.stretches(chain) == [(0, len(chain.time))]
    long = replace(chain, time=np.arange(6001) * 0.02)
    rows = chain_module.stretches(long)
    assert rows[0][0] == 0
    assert rows[-1][1] == len(long.time)
    (length,) = {stop - start for start, stop in rows}
    assert 0.02 * length == pytest.approx(chain.size.time(chain_module.STRETCH), abs=0.02)
    assert all(stop < start for (_, stop), (start, _) in pairwise(rows))
    assert chain_module.SHOWING <= length * len(rows) < chain_module.SHOWING + length


def test_a_model_that_lacks_something_else_is_contradicted() -> None:
    log, _ = record_walk(Gait(), 4.0, delay=0.04, seed=2)
    problem, begin = problem_of(make_study(load_robot("nao"), [log], mode=Mode("segments")))
    assert without_ground(problem, begin) is None


def test_what_weighs_and_drives_more_alike_moves_alike(on_springs: OnSprings) -> None:
    """Positions tell ratios of masses, gains, drag and rotor inertia: the ground bears what a candidate weighs."""
    study = on_springs[1]
    terms = study.declare([f"{name}:*=shared" for name in ("mass", "kp", "kv", "armature", "damping")])
    replay = study.train_problem(terms).episodes[0].replay
    assert isinstance(replay, FloatingReplay)
    chain = chain_module.chain_of(replay)
    own = terms.nominal
    assert own.min() > 0
    every = np.arange(len(chain.touch))

    def ends(values: np.ndarray) -> Segments:
        return chain.steps.ends(values[None], np.zeros(len(every), dtype=np.int64), every, None)

    np.testing.assert_allclose(difference(ends(1.4 * own), ends(own)), 0.0, atol=1e-9)
    heavier = np.where(np.arange(len(own)) == 0, 1.4 * own, own)
    assert np.abs(difference(ends(heavier), ends(own))).max() > 1e-3
    one, other = (chain_module.derive(chain, values) for values in (own, 1.4 * own))
    for field in ("start", "mean", "blow", "last"):
        np.testing.assert_allclose(getattr(one, field), getattr(other, field), rtol=1e-6, atol=1e-8)


def test_logs_that_do_not_suit_are_left_alone(on_springs: OnSprings) -> None:
    replay = on_springs[2].episodes[0].replay
    assert isinstance(replay, FloatingReplay)
    assert chain_module.suits(replay)
    time = replay.log.time.copy()
    time[1::2] += 0.003
    assert not chain_module.suits(replace(replay, log=replace(replay.log, time=time)))
    assert not chain_module.suits(replace(replay, numerics=replace(replay.numerics, servo_period=0.01)))
    short = replay.log.window(0, chain_module.LEAST - 1)
    assert not chain_module.suits(replace(replay, log=short))


@pytest.mark.parametrize("tilt", [0.0, 0.3])
def test_the_ground_presses_on_the_lowest_points_of_a_foot(tilt: float) -> None:
    """Flat on its sole in the middle, give or take its half diagonal; on its edge, give or take half of that."""
    length, width, height = 0.08, 0.04, 0.03
    sole = np.array([[x, y, -height] for x in (-length, length) for y in (-width, width)])
    turn = np.array([[np.cos(tilt), 0, np.sin(tilt)], [0, 1, 0], [-np.sin(tilt), 0, np.cos(tilt)]])
    (reach,) = chain_module.pressed((sole @ turn.T)[None], NAO)
    middle = turn @ [length if tilt else 0.0, 0.0, -height]
    force = np.array([0.1, -0.05, 1.0])
    pushed = reach @ np.append(force, np.zeros(3))
    np.testing.assert_allclose(pushed, np.append(force, np.cross(middle, force)), atol=1e-9)
    beside = np.hypot(width if tilt else np.hypot(length, width), chain_module.BESIDE)
    np.testing.assert_allclose(reach[3:, 3:], beside * np.eye(3), rtol=1e-6)
