"""Back to Reality: the ant, trials, both searches, the loop and its resumption, the exchange of folders, the verb."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest

from sysid_btr.btr.belief import Belief
from sysid_btr.btr.choice import Choice, Offer, Pool, disagreement, fittest, pool_of
from sysid_btr.btr.closing import Joined
from sysid_btr.btr.controllers import Controller
from sysid_btr.btr.correction import linear_correction
from sysid_btr.btr.exchange import FolderExchange
from sysid_btr.btr.gaits import NaoGait, SineGait, ant_gait
from sysid_btr.btr.learning import Learnt, model_fit
from sysid_btr.btr.loop import back_to_reality, disengaged
from sysid_btr.btr.outcome import BackToReality, Iteration, estimate_model
from sysid_btr.btr.problems import ControllerProblem, ModelProblem, Stage
from sysid_btr.btr.robot import HiddenRobot, Noise, Robot, Trial
from sysid_btr.btr.settings import Settings
from sysid_btr.btr.task import Motion, Walk
from sysid_btr.btr.trials import TrialBook, Tried
from sysid_btr.btr.world import make_world
from sysid_btr.cli import run
from sysid_btr.errors import InterruptedRun, UsageError
from sysid_btr.estimators import CmaEs, GeneticAlgorithm, Record
from sysid_btr.identify.episode import FixedEpisode
from sysid_btr.identify.study import Study
from sysid_btr.io.log import Log, LogMeta
from sysid_btr.io.parquet import read_log, write_log
from sysid_btr.io.validation import validate_log
from sysid_btr.models import ant as ant_module
from sysid_btr.models.ant import SegmentLength
from sysid_btr.models.builtin import load_robot
from sysid_btr.models.robot import Robot as RobotModel
from sysid_btr.report.btr import draw_btr
from sysid_btr.result import to_json
from sysid_btr.simulation.compiling import make_index
from sysid_btr.simulation.replay import Replay
from sysid_btr.terms.base import BatchModel, Term
from sysid_btr.terms.grammar import parse_parameters
from sysid_btr.terms.model import Model, Terms
from sysid_btr.terms.servo import CommandDelay

MODEL = load_robot("ant")
TASK = Walk(1.0)
SPACE = replace(ant_gait(), frequency=2.0, ramp=0.25)
FREE = ["length:LFFemur,RFTibia"]
TRUTH = np.array([1.25, 0.8])


def terms() -> tuple[Term, ...]:
    return parse_parameters(FREE, MODEL)


def stage(task: Walk = TASK) -> Stage:
    return Stage(make_world(MODEL, task, terms(), threads=1), task, SPACE)


def hidden(noise: Noise = Noise()) -> HiddenRobot:  # noqa: B008
    return HiddenRobot(make_world(MODEL, TASK, terms(), threads=1), TRUTH, TASK, SPACE, noise)


def some_controllers(count: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(SPACE.lower, SPACE.upper, (count, len(SPACE.names)))


TINY = Settings(
    iterations=2,
    trials=2,
    first=GeneticAlgorithm(population=4, generations=2, bits=8),
    controllers=GeneticAlgorithm(population=4, generations=2, bits=8, mutation=0.02),
    models=GeneticAlgorithm(population=4, generations=2, bits=8),
    memory=3,
)


def tiny(robot: Robot, folder: Path | None = None, settings: Settings = TINY, **more: object) -> BackToReality:
    return back_to_reality(
        MODEL,
        terms(),
        robot,
        SPACE,
        task=TASK,
        settings=settings,
        folder=folder,
        threads=1,
        **more,  # type: ignore[arg-type]
    )


class Killed(BaseException):
    """The process dies."""


@dataclass(eq=False)
class Counting:
    """A robot that counts its trials, and dies in one of them."""

    robot: Robot
    dies_in: int = -1
    count: int = 0
    seen: list[bytes] = field(default_factory=list)

    def run(self, controller: Controller) -> Trial:
        self.count += 1
        self.seen.append(controller.values.tobytes())
        if self.count == self.dies_in:
            raise Killed
        return self.robot.run(controller)


# --- the ant ------------------------------------------------------------------------------------------------


def test_the_ant_has_six_legs_eighteen_servos_and_stands() -> None:
    model = MODEL.compile()
    assert (model.nu, model.nv) == (18, 24)
    assert len(SPACE.names) == 36
    world = make_world(MODEL, TASK, threads=1)
    still = np.zeros((1, len(SPACE.names)))
    ((_, outputs),) = world.run(world.spread(SPACE.joints, SPACE.commands(still, TASK.time)), np.zeros((1, 0)))
    motion = world.motion(outputs, np.zeros((1, 0)))
    assert motion.base is not None
    height = motion.base[0, :, 2]
    assert abs(height[-1] - height[0]) < 0.01
    assert not TASK.fallen(motion).any()
    assert abs(TASK.fitness(motion)[0]) < 0.01


def test_a_length_written_into_fields_is_the_model_that_a_compiler_makes(monkeypatch: pytest.MonkeyPatch) -> None:
    term = SegmentLength(places=("LFFemur", "RMTibia"))
    spec = MODEL.make_spec()
    term.edit_spec(spec)
    model = spec.compile()
    models = BatchModel(model, make_index(model), 0.005, 1)
    models.write(term.model_fields(models, np.array([[[1.3], [0.8]]])))
    written = models.candidate(0)
    femur, tibia, add_leg = ant_module.FEMUR, ant_module.TIBIA, ant_module._add_leg
    trunk = MODEL.compile().body_pos[1]

    def longer(body: object, leg: str) -> None:
        monkeypatch.setattr(ant_module, "FEMUR", femur * (1.3 if leg == "LF" else 1))
        monkeypatch.setattr(ant_module, "TIBIA", tibia * (0.8 if leg == "RM" else 1))
        add_leg(body, leg)

    monkeypatch.setattr(ant_module, "_add_leg", longer)
    compiled = ant_module._make_spec().compile()
    np.testing.assert_allclose(compiled.body_pos[1], trunk)
    for name in ("body_pos", "body_mass", "body_inertia", "body_ipos", "body_invweight0", "body_subtreemass",
                 "geom_size", "geom_pos", "geom_rbound", "geom_aabb", "site_pos", "dof_invweight0", "dof_M0",
                 "actuator_acc0"):  # fmt: skip
        np.testing.assert_allclose(getattr(written, name), getattr(compiled, name), rtol=1e-8, atol=1e-12, err_msg=name)


def test_only_a_segment_has_a_length() -> None:
    world = make_world(MODEL, TASK, parse_parameters(["length:Trunk"], MODEL), threads=1)
    with pytest.raises(UsageError, match="Trunk"):
        list(world.run(np.zeros((1, len(TASK.time), 18)), np.ones((1, 1))))
    with pytest.raises(UsageError, match="unknown field 'length'"):
        parse_parameters(["length:*"], load_robot("nao"))


# --- controllers, task, trials ----------------------------------------------------------------------------------


def test_sine_references_are_those_of_the_paper() -> None:
    space = SineGait(("a", "b"), (0.1, -0.2), (0.5, 0.5), frequency=1.5, ramp=0.2)
    time = np.array([0.0, 0.5, 0.8])
    values = np.array([[0.3, 0.4, 0.2, -1.0]])
    got = space.commands(values, time)[0]
    np.testing.assert_allclose(got[0], [0.1, -0.2])
    np.testing.assert_allclose(got[1:, 0], 0.1 + 0.3 * np.sin(2 * np.pi * 1.5 * time[1:] + 0.4))
    np.testing.assert_allclose(got[1:, 1], -0.2 + 0.2 * np.sin(2 * np.pi * 1.5 * time[1:] - 1.0))


def test_a_gait_that_legs_cannot_reach_is_a_controller_that_failed() -> None:
    space = NaoGait()
    values = np.stack([space.start, space.start])
    values[1, space.names.index("crouch")] = 0.2
    commands = space.commands(values, np.arange(5) * 0.02)
    assert np.isfinite(commands[0]).all()
    assert np.isnan(commands[1]).all()
    nao, task = load_robot("nao"), Walk(0.2)
    fitness = Stage(make_world(nao, task, threads=1), task, space).fitness(values, np.zeros((1, 0)))
    assert np.isfinite(fitness[0, 0])
    assert np.isnan(fitness[0, 1])


def test_fitness_is_the_speed_up_to_the_fall() -> None:
    base = np.zeros((2, len(TASK.time), 13))
    base[:, :, 0] = 0.4 * TASK.time
    base[:, :, 3] = 1.0
    over = TASK.time >= 0.5
    base[1, over, 3:5] = [np.cos(np.pi / 4), np.sin(np.pi / 4)]
    motion = Motion((), np.zeros((2, len(TASK.time), 0)), base)
    np.testing.assert_allclose(TASK.fitness(motion), [0.4, 0.2], atol=0.01)
    assert TASK.fallen(motion)[1].sum() == over.sum()


def test_runs_do_not_depend_on_what_else_is_in_the_batch() -> None:
    own = stage()
    controllers, models = some_controllers(3), np.array([[1.0, 1.0], [1.2, 0.9]])
    together = own.fitness(controllers, models)
    assert together.shape == (2, 3)
    assert len(np.unique(together)) == 6
    for k in range(2):
        for m in range(3):
            assert own.fitness(controllers[m : m + 1], models[k : k + 1])[0, 0] == together[k, m]


def test_a_trial_is_a_valid_log_whose_replay_it_is() -> None:
    controller = some_controllers(1)[0]
    trial = hidden(Noise(0, 0, 0, 0, 0, 0)).run(Controller(controller))
    assert trial.log is not None
    assert trial.outcome == "done"
    assert [p for p in validate_log(trial.log, joints=SPACE.joints) if p.severity == "error"] == []
    assert trial.log.has("imu", "gyro_x")
    assert trial.log.has("force", "LFFoot")
    # at rest an accelerometer shows gravity, and the feet carry the weight
    weight = 9.81 * float(MODEL.compile().body_mass.sum())
    still = hidden(Noise(0, 0, 0, 0, 0, 0)).run(Controller(np.zeros(36)))
    assert still.log is not None
    feet = still.log.array("force", still.log.joints("force"))[-5:].sum(axis=1)
    np.testing.assert_allclose(feet, weight, rtol=0.1)
    np.testing.assert_allclose(still.log.channels["imu.acc_z"][-5:], 9.81, rtol=0.05)
    own = stage()
    problem = ModelProblem(own, controller[None], [trial], "phi1", np.ones(2))
    assert problem.loss(TRUTH[None])[0] == 0
    assert problem.loss(np.ones((1, 2)))[0] > 1e-4
    # commands are what the engine replays, sample by sample
    replay = Replay(MODEL, trial.log, (), own.world.numerics, threads=1)
    np.testing.assert_allclose(
        replay.grid.command, np.repeat(own.commands(controller[None])[0, :-1], 4, axis=0), atol=1e-12
    )


@pytest.mark.parametrize("distance", ["phi1", "phi2:10", "mse", "wasserstein"])
def test_every_distance_prefers_the_true_model(distance: str) -> None:
    controllers = some_controllers(3)
    trials = [hidden().run(Controller(c)) for c in controllers]
    problem = ModelProblem(stage(), controllers, trials, distance, np.ones(2))
    losses = problem.loss(np.array([TRUTH, np.ones(2), TRUTH + np.array([0.1, 0.0])]))
    assert np.isfinite(losses).all()
    assert np.argmin(losses) == 0


def test_the_noise_of_the_true_model_is_that_of_the_sensors() -> None:
    controllers = some_controllers(2)
    problem = ModelProblem(stage(), controllers, [hidden().run(Controller(c)) for c in controllers], "mse", np.ones(2))
    # the floor of a log as short as this holds some of the motion
    assert 0.2 < problem.noise(TRUTH) < 1.4
    assert problem.noise(np.ones(2)) > 3


# --- choice of trials --------------------------------------------------------------------------------------------


def records(*generations: Sequence[tuple[float, float]]) -> list[Record]:
    return [
        Record("loss", np.array([[x] for x, _ in g]), {"loss": np.array([v for _, v in g])}, 0.0) for g in generations
    ]


def test_trials_come_from_the_last_generation_first_and_never_twice() -> None:
    found = records([(1.0, -5.0), (2.0, -1.0)], [(3.0, -2.0), (4.0, -4.0), (5.0, np.inf), (4.0, -4.0)])
    pool = pool_of(found, {np.array([2.0]).tobytes()})
    assert pool.controllers[:, 0].tolist() == [1.0, 4.0, 3.0]
    assert pool.expected.tolist() == [5.0, 4.0, 2.0]


def chosen_by(choice: Choice, offer: Offer, count: int) -> list[int]:
    taken: list[int] = []
    while len(taken) < count and (row := choice(offer, taken, count)) is not None:
        taken.append(row)
    return taken


def test_disagreement_takes_the_fittest_and_those_that_tell_models_apart() -> None:
    pool = Pool(np.arange(10.0)[:, None], np.arange(10.0)[::-1])

    def rivals(some: np.ndarray) -> np.ndarray:
        return np.stack([np.zeros(len(some)), np.where(some[:, 0] == 5, 3.0, 0.01 * some[:, 0])])

    offer = Offer(pool, rivals)
    assert chosen_by(fittest, offer, 3) == [0, 1, 2]
    assert chosen_by(disagreement, offer, 3)[:2] == [0, 5]
    assert sorted(chosen_by(disagreement, offer, 20)) == list(range(10))


def test_the_linear_correction_learns_a_linear_discrepancy() -> None:
    own, controllers = stage(), some_controllers(30)
    model = np.ones(2)
    plain = own.fitness(controllers, model[None])[0]
    unit = (controllers - SPACE.lower) / (SPACE.upper - SPACE.lower)
    real = plain + 0.3 + 0.2 * unit[:, 0]
    tried = [
        Tried(1, Controller(c), 0.0, Trial(None, float(f))) for c, f in zip(controllers[:25], real[:25], strict=True)
    ]
    correct = linear_correction(own, model, tried)
    assert correct is not None
    corrected = -ControllerProblem(own, model, SPACE.start, correct).loss(controllers[25:])
    assert np.abs(corrected - real[25:]).max() < 0.1
    assert linear_correction(own, model, []) is None


# --- the loop ----------------------------------------------------------------------------------------------------


def test_the_loop_improves_the_gait_and_finds_the_model() -> None:
    settings = Settings(
        iterations=3,
        trials=4,
        first=GeneticAlgorithm(population=12, generations=3, bits=8),
        controllers=GeneticAlgorithm(population=10, generations=4, bits=8, mutation=0.015),
        models=CmaEs(population=8, max_generations=8, sigma=0.2),
        memory=6,
    )
    outcome = tiny(hidden(), settings=settings, seed=3)
    best = [i.best for i in outcome.iterations]
    assert best == sorted(best)
    assert best[-1] > 1.1 * best[0] > 0
    before, after = np.abs(1 / TRUTH - 1), np.abs(outcome.model / TRUTH - 1)
    assert np.all(after < before)
    assert after.mean() < 0.5 * before.mean()
    assert outcome.iterations[-1].transfer < outcome.iterations[0].transfer
    assert len(outcome.tried) == 12
    assert len({t.controller.values.tobytes() for t in outcome.tried}) == 12
    found = estimate_model(outcome)
    assert [e.name for e in found] == ["length:LFFemur", "length:RFTibia"]
    assert all(abs(e.value - t) < 4 * e.std for e, t in zip(found, TRUTH, strict=True))
    assert all(e.std < 0.3 for e in found)


@pytest.fixture(scope="module")
def whole() -> BackToReality:
    """A tiny run that nothing disturbed."""
    return tiny(hidden())


def same(a: BackToReality, b: BackToReality) -> bool:
    strip = {"wall_s": 0.0}
    return to_json({**a.to_dict(), **strip}) == to_json({**b.to_dict(), **strip})


@pytest.mark.parametrize("where", ["1, controllers", "1, models", "2, controllers", "2, models", "trial 1", "trial 3"])
def test_killed_in_any_step_it_goes_on_to_the_same_end(where: str, tmp_path: Path, whole: BackToReality) -> None:
    dies_in = int(where.removeprefix("trial ")) if where.startswith("trial") else -1

    def progress(*, done: int, total: int | None, best: float, note: str) -> None:
        if f"iteration {where}" in note:
            raise Killed

    first = Counting(hidden(), dies_in)
    with pytest.raises(Killed):
        tiny(first, tmp_path, progress=progress)
    second = Counting(hidden())
    resumed = tiny(second, tmp_path)
    assert same(resumed, whole)
    done = first.count - (dies_in > 0)
    assert done + second.count == len(whole.tried)
    again = Counting(hidden())
    assert same(tiny(again, tmp_path), whole)
    assert again.count == 0


IMPROVING = replace(TINY, choice="improvement", draws=2)


@pytest.fixture(scope="module")
def improved() -> BackToReality:
    """A tiny run whose trials are chosen one after the other."""
    return tiny(hidden(), settings=IMPROVING)


LEAST = replace(IMPROVING, models=model_fit(), distance="likelihood")
BESIDE = Terms(Belief.unmeasured(MODEL, (), ground=False)[0])
"""What is learnt although nobody declared it."""
LEARNT = [*TRUTH, *(BESIDE.nominal + 0.01 * BESIDE.scale)]


@pytest.mark.parametrize("settings", [LEAST, replace(LEAST, draws=1, choice="fittest")], ids=["drawn", "one model"])
@pytest.mark.parametrize("explained", [True, False])
def test_the_model_is_what_a_likelihood_says_where_that_explains_the_trials(
    settings: Settings, explained: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[tuple[Any, ...]] = []

    def learn(kept: Path, robot: RobotModel, trials: list[Trial], known: Terms, belief: Belief, *_: object) -> Learnt:
        asked.append((trials, known.names, belief))
        found = replace(belief, mean=np.array(LEARNT), covariance=0.25 * belief.covariance)
        return Learnt(found if explained else belief, 4.0, 1.0 if explained else 3.9, explained, 10)

    monkeypatch.setattr("sysid_btr.btr.loop.learnt_once", learn)
    said: list[str] = []
    outcome = tiny(hidden(), tmp_path, settings, say=said.append)
    assert [len(trials) for trials, *_ in asked] == [2, 2]
    assert asked[0][1] == ("length:LFFemur", "length:RFTibia", *BESIDE.names)
    # each trial once; what was learnt from those before is what is believed of them
    assert not {id(t) for t in asked[0][0]} & {id(t) for t in asked[1][0]}
    content = outcome.to_dict()
    assert same(tiny(hidden(), tmp_path, settings), outcome)
    if explained:
        np.testing.assert_array_equal(asked[1][2].mean, LEARNT)
        np.testing.assert_array_equal(outcome.model, LEARNT)
        assert content["parameters"][0]["value"] == TRUTH[0]
        assert content["parameters"][0]["std"] == pytest.approx(0.25 * asked[0][2].std[0])
        assert sum("after correction of the model" in text for text in said) == 2
    else:
        np.testing.assert_array_equal(asked[1][2].mean, asked[0][2].mean)
        np.testing.assert_array_equal(outcome.model, [1.0, 1.0])
        assert sum("in the model as it is" in text for text in said) == 2
    assert len(draw_btr(content)) > 10_000


def test_least_squares_minimise_a_likelihood() -> None:
    with pytest.raises(UsageError, match="likelihood"):
        replace(LEAST, distance="phi1")


@pytest.mark.parametrize("dies_in", [2, 3])
def test_a_run_that_improves_goes_on_to_the_same_end(dies_in: int, tmp_path: Path, improved: BackToReality) -> None:
    with pytest.raises(Killed):
        tiny(Counting(hidden(), dies_in), tmp_path, IMPROVING)
    second = Counting(hidden())
    assert same(tiny(second, tmp_path, IMPROVING), improved)
    assert dies_in - 1 + second.count == len(improved.tried)


def test_what_was_foreseen_is_said_beside_what_happened(improved: BackToReality) -> None:
    said: list[str] = []
    tiny(hidden(), settings=replace(IMPROVING, iterations=1), say=said.append)
    result = json.loads(to_json(improved.to_dict()))
    differ = ["length", *dict.fromkeys(term.name for term in Belief.unmeasured(MODEL, ())[0])]
    assert len(differ) == 8
    assert f"models that differ in {', '.join(differ)}" in said[0]
    for trial, line in zip(result["trials"][:2], said[1:], strict=False):
        foreseen = trial["foreseen"]
        assert foreseen["low"] < foreseen["fitness"] < foreseen["high"]
        assert 0 < foreseen["stands"] < 1
        assert line.startswith(f"trial {trial['trial']}: foreseen")
        assert line.endswith(f"{trial['fitness']:.3g} m/s, stood")
    held = sum(t["foreseen"]["low"] <= t["fitness"] <= t["foreseen"]["high"] for t in result["trials"])
    assert f"Of 4 trials {held} lay in their 90 % interval" in result["message"]
    assert all(i["promise"] >= 0 for i in result["iterations"])


def test_the_loop_ends_before_a_trial_that_promises_too_little() -> None:
    outcome = tiny(hidden(), settings=replace(IMPROVING, worthwhile=1e3))
    assert len(outcome.tried) == 2
    assert outcome.finished
    assert "Another trial is worth" in outcome.reason
    with pytest.raises(UsageError, match="2 draws"):
        replace(TINY, worthwhile=0.1)


def test_more_iterations_go_on_from_where_fewer_ended(tmp_path: Path, whole: BackToReality) -> None:
    tiny(hidden(), tmp_path, replace(TINY, iterations=1))
    counting = Counting(hidden())
    assert [i.best for i in tiny(counting, tmp_path).iterations] == [i.best for i in whole.iterations]
    assert counting.count == 2


def test_work_of_another_run_is_not_gone_on_with(tmp_path: Path) -> None:
    tiny(hidden(), tmp_path, replace(TINY, iterations=1))
    with pytest.raises(UsageError, match="belongs to another fit"):
        tiny(hidden(), tmp_path, seed=1)
    with pytest.raises(UsageError, match="unknown"):
        Settings(choice="best")


@dataclass(eq=False)
class Fragile:
    """A robot that crashes on its first controllers, and falls in the next."""

    robot: Robot
    count: int = 0

    def run(self, controller: Controller) -> Trial:
        self.count += 1
        if self.count <= 2:
            return Trial(None, 0.0, "crashed")
        trial = self.robot.run(controller)
        assert trial.log is not None
        return Trial(trial.log.window(0, 30), 0.3 * trial.fitness, "fallen") if self.count == 3 else trial


@pytest.mark.parametrize("distance", ["phi1", "mse"])
def test_a_crash_is_a_result(distance: str, tmp_path: Path) -> None:
    outcome = tiny(Fragile(hidden()), tmp_path, replace(TINY, distance=distance))
    assert [t.trial.outcome for t in outcome.tried] == ["crashed", "crashed", "fallen", "done"]
    assert np.isnan(outcome.iterations[0].transfer)
    assert np.isfinite(outcome.iterations[1].transfer)
    assert np.array_equal(outcome.iterations[0].model, [1.0, 1.0])
    content = json.loads((tmp_path / "trials" / "trial_0001.json").read_text())
    assert content["outcome"] == "crashed"
    json.loads(to_json(outcome.to_dict()))


def test_the_requirement_ends_the_loop() -> None:
    outcome = tiny(hidden(), settings=replace(TINY, requirement=-10.0))
    assert len(outcome.iterations) == 1
    assert "requirement is met" in outcome.reason


def test_a_run_may_disagree_or_correct_linearly() -> None:
    for settings in (replace(TINY, choice="disagreement"), replace(TINY, correct=True)):
        outcome = tiny(hidden(), settings=settings)
        assert len(outcome.tried) == 4
    assert np.array_equal(outcome.model, [1.0, 1.0])


@pytest.mark.parametrize("disk", [True, False])
def test_an_effect_that_is_named_joins_the_model(disk: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    declared = terms()
    delay = CommandDelay(places=tuple(SPACE.joints), shared=True)
    asked: list[int] = []

    def look(own: Stage, values: np.ndarray, tried: Sequence[Tried], n: int, progress: object) -> object:
        asked.append(len(tried))
        log = tried[0].trial.log
        assert log is not None
        seen = FixedEpisode(MODEL, log, np.ones(len(log), dtype=bool))
        study = Study(MODEL, (seen,), (), ("position",), own.world.numerics, np.nan)
        return Joined("20 ms of delay", Model.of((*declared, delay), [1.1, 0.9, 0.02])), study

    monkeypatch.setattr("sysid_btr.btr.closing._look", look)
    monkeypatch.setattr("sysid_btr.btr.loop.EXPLAINED", 0.0)
    settings = replace(TINY, close=True)
    outcome = tiny(hidden(), tmp_path if disk else None, settings)
    assert asked == [2]
    first, second = outcome.iterations
    assert first.joined == "20 ms of delay"
    assert second.names == ("length:LFFemur", "length:RFTibia", f"command_delay:{','.join(SPACE.joints)}")
    assert first.model.tolist() == [1.1, 0.9, 0.02]
    assert len(second.model) == 3
    assert first.population.shape[1] == len(first.population_names) == 2
    assert len(draw_btr(outcome.to_dict())) > 10_000
    if disk:
        assert same(tiny(hidden(), tmp_path, settings), outcome)
        assert len(asked) == 1


def tied() -> RobotModel:
    """The ant with two hips that mirror each other, which those of `hidden` do not."""

    def spec() -> mujoco.MjSpec:
        made = MODEL.make_spec()
        made.add_equality(type=mujoco.mjtEq.mjEQ_JOINT, name1="LFCoxa", name2="LMCoxa").data[1] = -1
        return made

    return replace(MODEL, make_spec=spec)


@pytest.mark.parametrize("settings", [TINY, IMPROVING], ids=["one model", "drawn models"])
def test_a_tie_that_the_robot_lacks_is_left_out_once_trials_show_it(settings: Settings, tmp_path: Path) -> None:
    said: list[str] = []
    outcome = back_to_reality(
        tied(), terms(), hidden(), SPACE, task=TASK, settings=settings, threads=1, folder=tmp_path, say=said.append
    )
    first, *later = outcome.iterations
    assert outcome.stage.world.model.neq == 0
    assert len(first.untied) == 1
    assert not any(i.untied for i in later)
    assert all("are not tied" in text for text in (*first.untied, outcome.to_dict()["message"], "".join(said)))
    # from then on gaits run, and the trials are explained, in a model without it
    plain = Stage(make_world(MODEL, TASK, terms(), threads=1), TASK, SPACE)
    controllers = np.array([t.controller.values for t in outcome.tried])
    np.testing.assert_array_equal(
        outcome.stage.fitness(controllers, outcome.model[None]), plain.fitness(controllers, outcome.model[None])
    )
    again = back_to_reality(tied(), terms(), hidden(), SPACE, task=TASK, settings=settings, threads=1, folder=tmp_path)
    assert same(outcome, again)


def test_a_tie_that_the_robot_has_stays() -> None:
    robot = HiddenRobot(make_world(tied(), TASK, terms(), threads=1), TRUTH, TASK, SPACE, Noise())
    outcome = back_to_reality(tied(), terms(), robot, SPACE, task=TASK, settings=TINY, threads=1)
    assert outcome.stage.world.model.neq == 1
    assert not any(i.untied for i in outcome.iterations)


def rounds(best: Sequence[float], real: Callable[[float], float]) -> list[Iteration]:
    result = []
    for n, b in enumerate(best, start=1):
        tried = tuple(Tried(n, Controller(np.zeros(1)), e, Trial(None, real(e))) for e in (0.1 * n, 0.2 * n, 0.3 * n))
        nothing = np.zeros(0)
        result.append(Iteration(n, nothing, 0, 0, tried, 0, (), nothing, 0, 0, 0, nothing[None], nothing, 0, 0, best=b))
    return result


def test_disengagement_is_found_and_said() -> None:
    assert disengaged(rounds([1, 1, 1], lambda e: -e)) == ""
    assert "rank correlation -1.00" in disengaged(rounds([1, 1, 1, 1], lambda e: -e))
    assert disengaged(rounds([1, 1, 1, 1], lambda e: e)) == ""
    assert disengaged(rounds([1, 1, 1, 2], lambda e: -e)) == ""


def test_a_gait_that_fell_is_the_best_only_where_none_stood() -> None:
    fast = Tried(1, Controller(np.zeros(1)), 0.0, Trial(None, 2.0, "fallen"))
    slow = Tried(1, Controller(np.ones(1)), 0.0, Trial(None, 0.5))
    assert TrialBook(made=[fast]).best is fast
    assert TrialBook(made=[fast, slow, fast]).best is slow
    assert TrialBook(made=[slow, replace(slow)]).best is slow


@pytest.mark.parametrize(("learn", "words"), [(True, "after correction of"), (False, "in the model as it is")])
def test_a_model_that_stays_is_not_said_to_be_corrected(learn: bool, words: str) -> None:
    said: list[str] = []
    tiny(hidden(), settings=replace(TINY, iterations=1, learn=learn), say=said.append)
    assert words in said[-1]
    assert ("correct" in said[-1]) is learn


def test_a_damaged_trial_is_not_passed_over(tmp_path: Path) -> None:
    book = TrialBook(tmp_path)
    values = SPACE.start
    book.add(hidden(), 1, values, 0.0)
    with pytest.raises(UsageError, match="another controller"):
        TrialBook(tmp_path).add(hidden(), 1, values + 0.01, 0.0)
    (tmp_path / "trial_0001.json").write_text("{")
    with pytest.raises(UsageError, match="cannot be read"):
        TrialBook(tmp_path).add(hidden(), 1, values, 0.0)


# --- the exchange of folders ------------------------------------------------------------------------------------


def exchange(folder: Path) -> FolderExchange:
    return FolderExchange(folder, TASK, SPACE, "ant", poll=0.0, patience=0.0)


def play(folder: Path) -> None:
    """What whoever runs the robot does."""
    for place in sorted(folder.iterdir()):
        if (place / "outcome.json").exists():
            continue
        asked = json.loads((place / "request.json").read_text())
        trial = hidden().run(Controller(np.array(list(asked["parameters"].values()))))
        commands = read_log(place / "command.parquet", check=False)
        assert trial.log is not None
        for joint in SPACE.joints:
            assert np.array_equal(commands.channels[f"command.{joint}"], trial.log.channels[f"command.{joint}"])
        write_log(trial.log, place / "recorded.parquet")
        (place / "outcome.json").write_text(json.dumps({"outcome": trial.outcome, "fitness": trial.fitness}))


def test_a_real_robot_behind_a_folder_may_be_stopped_at_every_trial(tmp_path: Path, whole: BackToReality) -> None:
    folder, out = tmp_path / "exchange", tmp_path / "out"
    for _ in range(len(whole.tried)):
        with pytest.raises(InterruptedRun, match="resume"):
            tiny(exchange(folder), out)
        play(folder)
    assert same(tiny(exchange(folder), out), whole)


def ask(folder: Path) -> Path:
    with pytest.raises(InterruptedRun):
        exchange(folder).run(Controller(SPACE.start, "0001"))
    return folder / "trial_0001"


def test_a_bad_reply_is_answered_and_waited_for_again(tmp_path: Path) -> None:
    place = ask(tmp_path)
    short = Log(np.arange(5) * 0.02, {"position.nothing": np.zeros(5)}, LogMeta(robot="ant"), np.zeros(5, dtype=int))
    write_log(short, place / "recorded.parquet")
    (place / "outcome.json").write_text('{"outcome": "done"}')
    ask(tmp_path)
    told = (place / "problems.txt").read_text()
    assert "fitness is None" in told
    assert "LFCoxa" in told
    (place / "outcome.json").write_text("{")
    ask(tmp_path)
    (place / "recorded.parquet").unlink()
    (place / "outcome.json").unlink()
    play(tmp_path)
    trial = exchange(tmp_path).run(Controller(SPACE.start, "0001"))
    assert trial.outcome == "done"
    assert not (place / "problems.txt").exists()


def test_a_reply_that_no_robot_can_have_given_is_refused(tmp_path: Path) -> None:
    place = ask(tmp_path)
    play(tmp_path)
    reply, recorded = place / "outcome.json", read_log(place / "recorded.parquet", check=False)
    reply.write_text('{"outcome": "done", "fitness": 1e308}')
    ask(tmp_path)
    assert "fitness is 1e+308" in (place / "problems.txt").read_text()
    joint = f"command.{SPACE.joints[0]}"
    other = {**recorded.channels, joint: 0.5 * np.sin(7 * recorded.time)}
    write_log(replace(recorded, channels=other), place / "recorded.parquet", overwrite=True)
    reply.write_text('{"outcome": "done", "fitness": 0.1}')
    ask(tmp_path)
    assert f"its commands of {SPACE.joints[0]} are not those of command.parquet" in (place / "problems.txt").read_text()


def test_a_crash_needs_no_log(tmp_path: Path) -> None:
    place = ask(tmp_path)
    (place / "outcome.json").write_text('{"outcome": "crashed"}')
    trial = exchange(tmp_path).run(Controller(SPACE.start, "0001"))
    assert (trial.log, trial.fitness, trial.outcome) == (None, 0.0, "crashed")


def test_a_folder_of_another_run_is_refused(tmp_path: Path) -> None:
    ask(tmp_path)
    with pytest.raises(UsageError, match="another run"):
        exchange(tmp_path).run(Controller(SPACE.start + 0.01, "0001"))


def test_a_recording_on_another_clock_is_read_on_the_tasks(tmp_path: Path) -> None:
    controller = some_controllers(1)[0]
    trial = hidden(Noise(0, 0, 0, 0, 0, 0)).run(Controller(controller))
    assert trial.log is not None
    time = np.arange(0, 0.95, 0.003)
    channels = {n: np.interp(time, trial.log.time, v) for n, v in trial.log.channels.items()}
    late = replace(trial.log, time=time + 100, channels=channels, episode=np.zeros(len(time), dtype=np.int64))
    losses = [
        ModelProblem(stage(), controller[None], [replace(trial, log=log)], "mse", np.ones(2)).loss(
            np.array([TRUTH, [1.0, 1.0]])
        )
        for log in (trial.log, late)
    ]
    assert losses[0][0] < 1e-12
    assert losses[1][0] < 0.01 * losses[1][1]


# --- the verb ---------------------------------------------------------------------------------------------------


COMMAND = (
    *("btr", "--model", "ant", "--fit", "length:LFFemur", "--robot-sim", "ant", "--robot-set", "length:LFFemur=1.2"),
    *("--iterations", "1", "--trials", "1", "--duration", "1", "--threads", "1", "--draws", "2"),
    *("--search", "ga", "--distance", "phi1"),
)


def test_the_verb_writes_result_figure_and_report(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "out"
    assert run([*COMMAND, "--out", str(out)]) == 0
    text = capsys.readouterr()
    assert "m/s on the robot" in text.out
    assert "iteration 1: 1 trials" in text.err
    result = json.loads((out / "result.json").read_text())
    assert result["kind"] == "btr"
    assert [t["iteration"] for t in result["trials"]] == [1]
    assert result["parameters"][0]["name"] == "length:LFFemur"
    assert (out / "overlay.png").stat().st_size > 10_000
    report = (out / "report.html").read_text()
    assert "m/s on the robot" in report
    assert "its 90 % interval with falls" in report
    assert (out / "trials" / "trial_0001.parquet").exists()
    assert run(["report", str(out)]) == 0
    assert run([*COMMAND, "--out", str(out)]) == 2
    assert run([*COMMAND, "--out", str(out), "--resume"]) == 0
    again = json.loads((out / "result.json").read_text())
    assert {**again, "wall_s": 0} == {**result, "wall_s": 0}


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (("--robot-sim", "ant"), "which robot"),
        (("--fit", "length:LFFemur"), "no parameters to fit"),
        (("--model", "ant"), "which robot"),
    ],
)
def test_the_verb_says_what_is_missing(change: tuple[str, str], told: str, capsys: pytest.CaptureFixture[str]) -> None:
    argv = list(COMMAND)
    at = argv.index(change[0])
    del argv[at : at + 2]
    if change[0] == "--robot-sim":
        at = argv.index("--robot-set")
        del argv[at : at + 2]
    assert run(argv) == 2
    assert told in capsys.readouterr().err


def test_the_verb_refuses_what_it_does_not_have(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    assert run([*COMMAND, "--choice", "best"]) == 2
    assert run([*COMMAND, "--distance", "phi9"]) == 2
    assert run([*COMMAND, "--search", "lsq"]) == 2
    assert run([*COMMAND, "--model-search", "lsq"]) == 2
    assert run([*COMMAND, "--exchange", str(tmp_path)]) == 2
    emps = ["emps" if a == "ant" else a for a in COMMAND]
    assert run(emps) == 2
    assert "a robot that walks has one, at its base" in capsys.readouterr().err
