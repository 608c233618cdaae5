"""MSE, phi1 and phi2: closed forms, metric properties, and what each can see."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import wasserstein_distance
from toys import FINE, pendulum, position, swing

from sysid_btr.errors import UsageError
from sysid_btr.estimators import get_estimator
from sysid_btr.identify.fit import fit
from sysid_btr.identify.study import make_study
from sysid_btr.io.noise import NoiseFloor
from sysid_btr.objectives.distance import (
    DistanceProblem,
    MeanSquare,
    Phi1,
    Phi2,
    Wasserstein,
    get_distance,
    information_distance,
    phi1,
)
from sysid_btr.objectives.problem import Comparison, ReplayProblem
from sysid_btr.objectives.targets import Target, make_targets
from sysid_btr.simulation.replay import Replay
from sysid_btr.terms.grammar import parse_parameters

LABELS = st.lists(st.integers(0, 4), min_size=30, max_size=30)


@given(LABELS, LABELS, LABELS)
def test_information_distance_is_a_metric(a: list[int], b: list[int], c: list[int]) -> None:
    x, y, z = np.array(a), np.array(b), np.array(c)
    d = information_distance
    assert d(x, x) == pytest.approx(0, abs=1e-12)
    assert d(x, y) == pytest.approx(d(y, x))
    assert d(x, z) <= d(x, y) + d(y, z) + 1e-9


def test_information_distance_of_independent_fair_bits_is_two() -> None:
    x = np.tile([0, 0, 1, 1], 100)
    y = np.tile([0, 1, 0, 1], 100)
    assert information_distance(x, y) == pytest.approx(2.0)


def test_information_distance_does_not_see_a_relabelling() -> None:
    x = np.random.default_rng(0).integers(0, 5, 500)
    assert information_distance(x, 4 - x) == pytest.approx(0, abs=1e-12)


def target(values: np.ndarray) -> Target:
    n = len(values)
    floor = (NoiseFloor(1e-3, "high-frequency", 0.0),)
    return Target("position", ("a",), np.array([0]), values[:, None], floor, np.array([1e-3]), np.ones((n, 1), bool))


def test_phi2_grows_with_lag_and_leaves_out_joints_that_stand_still() -> None:
    t = np.arange(4000) * 0.01
    moving = target(np.sin(t))
    late = [np.sin(t - lag)[:, None] for lag in (0.0, 0.05, 0.2)]
    values = Phi2(20)(moving, np.array(late))
    assert values[0] < values[1] < values[2]
    still = target(1e-4 * np.sin(t))
    assert Phi2(20)(still, np.zeros((1, 4000, 1)))[0] == 0


def test_a_failed_candidate_is_infinitely_far() -> None:
    t = np.arange(400) * 0.01
    predicted = np.array([np.sin(t)[:, None], np.full((400, 1), np.nan)])
    assert not np.isfinite(Phi2()(target(np.sin(t)), predicted)[1])
    assert not np.isfinite(MeanSquare()(target(np.sin(t)), predicted)[1])


def test_mean_square_and_phi1_closed_forms() -> None:
    values = MeanSquare()(target(np.zeros(50)), np.full((2, 50, 1), 0.3))
    assert values == pytest.approx([0.09, 0.09])
    assert phi1(np.array([1.0, 2.0]), np.array([[1.5, 2.5], [1.0, 0.0]])) == pytest.approx([0.5, 1.0])


def test_wasserstein_is_that_of_scipy_joint_by_joint() -> None:
    rng = np.random.default_rng(0)
    measured = rng.standard_normal((200, 2))
    predicted = rng.standard_normal((3, 200, 2)) * 1.3 + 0.2
    mask = rng.random((200, 2)) < 0.9
    floor = (NoiseFloor(1e-3, "high-frequency", 0.0),) * 2
    both = Target("position", ("a", "b"), np.array([0, 1]), measured, floor, np.full(2, 1e-3), mask)
    expected = [
        sum(wasserstein_distance(measured[mask[:, k], k], row[mask[:, k], k]) for k in range(2)) for row in predicted
    ]
    assert Wasserstein()(both, predicted) == pytest.approx(expected)


def test_wasserstein_sees_an_offset_and_a_gain_but_not_time() -> None:
    t = np.arange(4000) * 0.01
    moving = target(np.sin(t))
    shown = [np.sin(t), np.sin(t) + 0.1, 0.8 * np.sin(t), np.sin(t)[::-1]]
    same, offset, gain, reversed_ = Wasserstein()(moving, np.array(shown)[:, :, None])
    assert same == 0
    assert offset == pytest.approx(0.1)
    assert gain == pytest.approx(0.2 * np.mean(np.abs(np.sin(t))), rel=0.01)
    assert reversed_ == pytest.approx(0, abs=1e-12)
    failed = np.full((1, 4000, 1), np.nan)
    assert not np.isfinite(Wasserstein()(moving, failed)[0])


def test_phi1_compares_the_fitness_of_motions() -> None:
    t = np.arange(4000) * 0.01
    moving = target(np.sin(t))
    shown = np.array([np.sin(t), 0.8 * np.sin(t), np.full(4000, np.nan)])[:, :, None]
    same, weaker, failed = Phi1()(moving, shown)
    assert same == pytest.approx(0)
    assert weaker == pytest.approx(0.2 * np.std(np.sin(t)))
    assert not np.isfinite(failed)
    farthest = Phi1(lambda motion: np.asarray(np.max(np.abs(motion), axis=1)))
    assert farthest(moving, shown)[1] == pytest.approx(0.2, rel=1e-3)


@pytest.mark.parametrize("estimator", ["lsq", "cmaes+lsq", "emcee"])
@pytest.mark.parametrize("name", ["mse", "phi1", "phi2", "wasserstein"])
def test_estimators_that_need_residuals_refuse_a_distance(estimator: str, name: str) -> None:
    robot, log = pendulum(), swing(seconds=3.0)
    recorded = replace(log, channels={**log.channels, "position.arm": position(robot, log)[:, 0]})
    study = make_study(robot, [recorded], numerics=FINE)
    with pytest.raises(UsageError, match=r"cmaes|residuals"):
        fit(study, ["kp:arm"], estimator=get_estimator(estimator), distance=get_distance(name))


@pytest.mark.parametrize("name", ["mse", "phi1", "phi2:15", "wasserstein"])
def test_the_true_gain_is_nearest(name: str) -> None:
    robot, log = pendulum(), swing(seconds=6.0)
    terms = parse_parameters(["kp:arm"], robot)
    truth = position(robot, log, terms, [0.9])
    recorded = replace(log, channels={**log.channels, "position.arm": truth[:, 0]})
    replay = Replay(robot, recorded, terms, FINE)
    episode = Comparison(replay, make_targets(recorded, replay.index.joints, ("position",)))
    distance = get_distance(name)
    assert distance is not None
    losses = DistanceProblem(ReplayProblem((episode,), np.array([1.0])), distance).loss(
        np.array([[0.7], [0.8], [0.9], [1.0], [1.1]])
    )
    assert int(np.argmin(losses)) == 2
    assert losses[2] < 0.5 * losses[1]


def test_an_unknown_distance_lists_those_there_are() -> None:
    with pytest.raises(UsageError, match="phi2:BINS"):
        get_distance("phi3")


def test_one_bin_says_nothing() -> None:
    with pytest.raises(UsageError, match="at least 2 bins"):
        Phi2(1)
