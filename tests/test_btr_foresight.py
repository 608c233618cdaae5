"""What is foreseen of controllers, the search in many models, the choice of trials, and steps from what has worked."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from sysid_btr.btr.choice import Offer, Pool, improvement
from sysid_btr.btr.controllers import Controller, ControllerSpace
from sysid_btr.btr.foresight import Drawn, Foresight, foresee
from sysid_btr.btr.outlook import Cloud, log_weights
from sysid_btr.btr.robot import Trial
from sysid_btr.btr.robust import Risk, RobustProblem
from sysid_btr.btr.trials import Tried
from sysid_btr.btr.trust import Region
from sysid_btr.errors import UsageError


def world(seed: int, tried: int = 12, models: int = 12) -> tuple[Drawn, np.ndarray, np.ndarray]:
    """Controllers in drawn models, and on a robot that none of them is equal to."""
    rng = np.random.default_rng(seed)
    controllers = rng.random((tried + 40, 3))

    def speed(gain: np.ndarray, tilt: np.ndarray) -> np.ndarray:
        return 0.05 * np.outer(gain, controllers[:, 0]) + 0.02 * np.outer(tilt, np.sin(3 * controllers[:, 1]))

    fitness = speed(rng.normal(1.0, 0.2, models), rng.normal(0.0, 1.0, models))
    own = speed(np.array([0.8]), np.array([0.5]))[0] + 0.006 * np.cos(4 * controllers[:, 2])
    fell = controllers[:, 0] + rng.normal(0.0, 0.1, (models, 1)) > 0.9
    return Drawn(controllers, fitness, fell), own, controllers[:, 0] < 0.7


def ahead(seed: int, tried: int) -> tuple[Foresight, np.ndarray, np.ndarray]:
    """What is foreseen of 40 controllers after some trials, and what they do."""
    drawn, own, stands = world(seed)
    seen, rest = np.arange(tried), np.arange(12, len(own))
    return foresee(drawn.of(rest), drawn.of(seen), own[seen], stands[seen]), own[rest], stands[rest]


def test_trials_bring_what_is_foreseen_near_to_what_happens() -> None:
    before, after, held = [], [], []
    for seed in range(8):
        for tried, errors in ((0, before), (12, after)):
            foresight, own, stands = ahead(seed, tried)
            errors.append(np.mean(np.abs(foresight.mean - own)[stands]))
            if tried:
                held += [abs(m - o) < 1.645 * s for m, o, s in zip(foresight.mean, own, foresight.std, strict=True)]
    assert np.mean(after) < 0.5 * np.mean(before)
    assert 0.75 < np.mean(held) <= 1.0


def test_falls_that_no_model_foresaw_are_learnt() -> None:
    chances = np.array(
        [[f.stands[~s].mean() for f, _, s in [ahead(seed, tried)]] for tried in (0, 12) for seed in range(8)]
    )
    never, learnt = chances[:8], chances[8:]
    assert learnt.mean() < never.mean() - 0.1
    sure = np.concatenate([f.stands[s] for f, _, s in [ahead(seed, 12) for seed in range(8)]])
    assert sure.mean() > 0.7


def test_falls_where_all_models_agree_say_that_they_are_too_sure() -> None:
    controllers = np.linspace(0.0, 1.0, 6)[:, None] * np.ones(6)

    def loss_of_faith(models_that_fell: int) -> float:
        fell = np.zeros((12, 6), dtype=bool)
        fell[:models_that_fell, :5] = True
        drawn = Drawn(controllers, np.full((12, 6), 0.05), fell)
        far, real = drawn.of(np.array([5])), np.zeros(4)
        never, always = (foresee(far, drawn.of(np.arange(4)), real, np.full(4, up)) for up in (True, False))
        return float(never.stands[0] - always.stands[0])

    # of a controller that stands in all models and is near to none that was tried
    assert loss_of_faith(0) > 2 * loss_of_faith(6)


def test_an_interval_holds_what_a_fall_leaves() -> None:
    sure = Foresight(np.array([0.05]), np.array([0.001]), np.array([0.999])).of(0)
    risky = Foresight(np.array([0.05]), np.array([0.001]), np.array([0.5])).of(0)
    assert (sure.low, sure.high) == pytest.approx((0.05 - 0.00164, 0.05 + 0.00164), abs=2e-4)
    # it may have staggered backwards before
    assert risky.low == pytest.approx(-0.04, abs=2e-3)
    assert risky.high == pytest.approx(sure.high, abs=1e-3)


def test_what_stands_everywhere_is_worth_more_than_what_is_faster_and_falls_somewhere() -> None:
    fitness = np.array([[0.06, 0.04]] * 8)
    fell = np.zeros((8, 2), dtype=bool)
    assert np.argmax(Risk().worth(fitness, fell)) == 0
    fell[3, 0] = True
    assert np.argmax(Risk().worth(fitness, fell)) == 1
    assert np.argmax(Risk(weight=0.0, fall=0.0).worth(fitness, fell)) == 0
    np.testing.assert_allclose(Risk(weight=0.0, fall=0.1).worth(fitness, fell), [(7 * 0.06 - 0.1) / 8, 0.04])
    assert np.isnan(Risk().worth(np.full((2, 1), np.nan), np.ones((2, 1), dtype=bool))).all()
    with pytest.raises(UsageError, match="share"):
        Risk(share=0.0)


@dataclass
class Table:
    """A stage whose controllers do in model q what a table says; counts what was run."""

    fitness: np.ndarray
    ran: int = 0

    def outcomes(self, controllers: np.ndarray, models: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        self.ran += len(controllers) * len(models)
        rows = self.fitness[np.ix_(models[:, 0].astype(int), controllers[:, 0].astype(int))]
        return rows, rows < 0


def test_the_search_gives_most_runs_to_the_best_and_none_of_the_others_passes_them() -> None:
    rng = np.random.default_rng(0)
    table = Table(rng.normal(0.05, 0.02, 20) + rng.normal(0.0, 0.002, (8, 20)))
    bounds = np.zeros(1), np.full(1, 20.0)
    problem = RobustProblem(table, np.arange(8.0)[:, None], np.zeros(1), *bounds, Risk())  # type: ignore[arg-type]
    loss = problem.loss(np.arange(20.0)[:, None])
    assert table.ran == 20 + 10 + 5 * 2 + 3 * 4
    assert problem.runs == pytest.approx(table.ran / 20, rel=0.05)
    whole = Risk().worth(table.fitness, table.fitness < 0)
    best = int(np.argmax(whole))
    assert np.argmin(loss) == best
    assert -loss[best] == pytest.approx(whole[best])
    assert np.sum(loss <= loss[best]) == 1
    alone = RobustProblem(table, np.arange(8.0)[:, None], np.zeros(1), *bounds, Risk())  # type: ignore[arg-type]
    assert alone.loss(np.array([[float(best)]]))[0] == pytest.approx(-whole[best])


def test_models_that_do_as_the_robot_did_count_and_others_still_do() -> None:
    drawn, own, stands = world(3, models=48)
    likest = drawn.beside(Drawn(np.zeros((0, 3)), np.zeros((48, 0)), np.zeros((48, 0), dtype=bool)))
    likest.fitness[17], likest.fell[17] = own, ~stands
    seen = np.arange(12)
    tried, real, stood = likest.of(seen), own[seen], stands[seen]
    weights = log_weights(tried, real, stood)
    assert np.argmax(weights) == 17
    share = np.exp(weights)
    assert share.sum() ** 2 / (share @ share) >= 12
    trials = [
        Tried(1, Controller(c), 0.0, Trial(None, float(f), "done" if s else "fallen"))
        for c, f, s in zip(tried.controllers, real, stood, strict=True)
    ]
    cloud = Cloud(None, trials, tried)  # type: ignore[arg-type]
    rows = [cloud.pick(8, np.random.default_rng(seed)) for seed in range(40)]
    assert all(len(set(r.tolist())) == 8 for r in rows)
    assert all(np.all(np.diff(weights[r]) <= 0) for r in rows)
    assert np.mean([17 in r for r in rows]) > 2 * 8 / 48
    untried = log_weights(tried.of(np.arange(0)), np.zeros(0), np.zeros(0, dtype=bool))
    np.testing.assert_array_equal(untried, np.zeros(48))


@pytest.mark.parametrize("seed", range(4))
def test_a_trial_that_loses_its_step_does_not_decide_which_models_count(seed: int) -> None:
    drawn, own, stands = world(seed, models=48)
    drawn.fitness[17], drawn.fell[17] = own, ~stands
    seen = np.arange(12)
    real, stood = own[seen], stands[seen]
    real[np.flatnonzero(stood)[:2]] -= 1.0
    assert np.argmax(log_weights(drawn.of(seen), real, stood)) == 17


def offer(mean: list[float], stands: list[float], near: list[bool]) -> Offer:
    n = len(mean)
    foresight = Foresight(np.array(mean), np.full(n, 0.01), np.array(stands))
    return Offer(Pool(np.zeros((n, 1)), np.zeros(n)), lambda _: np.zeros((1, n)), foresight, np.array(near), 0.04)


def test_the_next_trial_promises_most_and_stands_near_what_has_worked() -> None:
    assert improvement(offer([0.05, 0.06, 0.09], [0.9, 0.9, 0.9], [True, True, False]), [], 3) == 1
    assert improvement(offer([0.05, 0.06, 0.09], [0.9, 0.9, 0.9], [True, True, False]), [1], 3) == 0
    assert improvement(offer([0.05, 0.06], [0.9, 0.2], [True, True]), [], 3) == 0
    assert improvement(offer([0.05, 0.06], [0.2, 0.1], [False, False]), [], 3) == 0
    assert improvement(offer([0.05], [0.9], [True]), [0], 3) is None
    with pytest.raises(UsageError, match="draws"):
        improvement(Offer(Pool(np.zeros((1, 1)), np.zeros(1)), lambda _: np.zeros((1, 1))), [], 1)


@dataclass(frozen=True)
class Box:
    lower: tuple[float, ...] = (0.0, -1.0)
    upper: tuple[float, ...] = (1.0, 1.0)


def trials(*outcomes: str) -> list[Tried]:
    return [
        Tried(1, Controller(np.full(2, 0.1 * i)), 0.0, Trial(None, 0.01 * i, outcome))  # type: ignore[arg-type]
        for i, outcome in enumerate(outcomes)
    ]


def test_steps_grow_with_success_and_shrink_after_falls() -> None:
    space: ControllerSpace = Box()  # type: ignore[assignment]
    everywhere = Region.after(trials("fallen", "crashed"), space)
    assert everywhere.centre is None
    assert everywhere.contains(np.array([[0.0, -1.0], [1.0, 1.0]])).all()
    stood = Region.after(trials("done", "done", "done"), space)
    assert stood.centre is not None
    np.testing.assert_allclose(stood.centre, 0.2)
    fell = Region.after(trials("done", "done", "done", "fallen"), space)
    np.testing.assert_allclose(fell.centre, stood.centre)
    assert fell.radius < stood.radius < Region.after(trials("done", "done", "done", "done"), space).radius
    assert stood.contains(np.array([[0.2 + 0.9 * stood.radius, 0.2], [0.2, 0.2 + 3 * stood.radius]])).tolist() == [
        True,
        False,
    ]
