"""Ways to find a gait for a robot, each with the same number of trials on it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from reference_simulator.legged import DrakeRobot
from sysid_btr._typing import FloatArray
from sysid_btr.btr.belief import Belief
from sysid_btr.btr.choice import pool_of
from sysid_btr.btr.controllers import Controller
from sysid_btr.btr.learning import model_fit
from sysid_btr.btr.loop import back_to_reality
from sysid_btr.btr.outlook import Imagination
from sysid_btr.btr.problems import Stage
from sysid_btr.btr.robot import Trial
from sysid_btr.btr.robust import Risk, RobustProblem
from sysid_btr.btr.settings import LIKELIHOOD, Settings
from sysid_btr.btr.world import make_world
from sysid_btr.estimators import Budget, CmaEs, Journal, silent
from sysid_btr.result import to_json
from sysid_btr.terms.base import Term

APART = 0.1
"""Root mean square difference, fraction of the range, of gaits of one search that are tried without learning."""
CELLS = 600
"""Of a repertoire of gaits."""
ITS_SHARE = 3
"""Times as many generations as the loop has: where that searches, a candidate runs in 2.75 models in the mean."""
ALONE = 10
"""Times as many trials that a search on the robot alone has."""

Shots = list[dict[str, Any]]


@dataclass(frozen=True)
class Plan:
    """What a run may spend."""

    iterations: int = 5
    trials: int = 4
    draws: int = 12
    generations: int = 20

    @property
    def count(self) -> int:
        return self.iterations * self.trials

    @property
    def search(self) -> CmaEs:
        return CmaEs(sigma=0.3, population=20, max_generations=self.generations)

    @property
    def settings(self) -> Settings:
        return Settings(
            iterations=self.iterations,
            trials=self.trials,
            first=self.search,
            controllers=self.search,
            models=model_fit(),
            distance=LIKELIHOOD,
            choice="improvement",
            draws=self.draws,
            memory=4,
            learn=False,
        )


Method = Callable[[DrakeRobot, Sequence[Term], int, Plan, Path], Shots]
"""Of a robot, what its model declares, a seed, what may be spent, and a folder for what is kept: the trials."""


def in_the_loop(change: Mapping[str, Any]) -> Method:
    """A method that is Back to Reality with some settings of its own."""

    def run(robot: DrakeRobot, terms: Sequence[Term], seed: int, plan: Plan, folder: Path) -> Shots:
        outcome = back_to_reality(
            robot.model,
            terms,
            robot,
            robot.space,
            task=robot.task,
            settings=replace(plan.settings, **change),
            seed=seed,
            folder=folder,
            threads=1,
            say=lambda text: print(f"  {text}", flush=True),
        )
        (folder / "result.json").write_text(to_json(outcome.to_dict()))
        return [shot(t.trial, asdict(t.foreseen) if t.foreseen else None, t.expected) for t in outcome.tried]

    return run


def shot(trial: Trial, foreseen: Mapping[str, Any] | None = None, expected: float | None = None) -> dict[str, Any]:
    return {"fitness": trial.fitness, "outcome": trial.outcome, "expected": expected, "foreseen": foreseen}


def stage_of(robot: DrakeRobot, terms: Sequence[Term]) -> Stage:
    """The robot's model at its task."""
    return Stage(make_world(robot.model, robot.task, terms, threads=1), robot.task, robot.space)


def randomised(robot: DrakeRobot, terms: Sequence[Term], seed: int, plan: Plan, folder: Path) -> Shots:
    """One search over the prior, as many simulations as the loop's; its best gaits, no two alike, tried in order."""
    others, unmeasured = Belief.unmeasured(robot.model, terms)
    stage, space = stage_of(robot, (*terms, *others)), robot.space
    models = Belief.before(terms).beside(unmeasured).draws(np.random.default_rng([seed, 70]), plan.draws)
    problem = RobustProblem(stage, models, space.start, space.lower, space.upper, Risk(weight=0.0, fall=0.0))
    journal = Journal(folder / "search.jsonl")
    search = replace(plan.search, max_generations=plan.generations * plan.iterations)
    search.fit(problem, rng=np.random.default_rng([seed, 71]), budget=Budget(), journal=journal, progress=silent)
    best = Imagination(stage, models).shortlist(pool_of(journal.records, set()), plan.count, APART)
    return [shot(robot.run(Controller(c)), None, float(e)) for c, e in zip(*vars(best).values(), strict=True)]


@dataclass(frozen=True, eq=False)
class OnTheRobot:
    """The robot as a problem of an estimator; every evaluation is a trial, and is kept."""

    robot: DrakeRobot
    trials: list[Trial]

    @property
    def names(self) -> tuple[str, ...]:
        return self.robot.space.names

    @property
    def lower(self) -> FloatArray:
        return self.robot.space.lower

    @property
    def upper(self) -> FloatArray:
        return self.robot.space.upper

    @property
    def start(self) -> FloatArray:
        return self.robot.space.start

    def loss(self, candidates: FloatArray) -> FloatArray:
        made = [self.robot.run(Controller(c)) for c in candidates]
        self.trials.extend(made)
        return -np.array([t.fitness for t in made])


def repertoire(robot: DrakeRobot, terms: Sequence[Term], seed: int, plan: Plan, folder: Path) -> Shots:
    """Intelligent Trial and Error (Cully et al. 2015, doi:10.1038/nature14422).

    MAP-Elites fills a repertoire of gaits, the fastest of each cell of a centroidal Voronoi tessellation of their
    space, in as many simulations of the nominal model as the loop's searches of drawn ones. Of these the one with the
    highest upper confidence bound is tried, by a Gaussian process about the model's speed with the authors' kernel
    (Matern 5/2), noise (0.001) and weight of the deviation (0.05).
    """
    from ribs.archives import CVTArchive
    from ribs.emitters import IsoLineEmitter
    from ribs.schedulers import Scheduler
    from sklearn.gaussian_process import GaussianProcessRegressor
    from sklearn.gaussian_process.kernels import ConstantKernel, Matern

    stage, space, p = stage_of(robot, ()), robot.space, len(robot.space.names)
    unit, width = [(0.0, 1.0)] * p, space.upper - space.lower
    archive = CVTArchive(solution_dim=p, centroids=CELLS, ranges=unit, seed=seed)
    first = (space.start - space.lower) / width
    emitter = IsoLineEmitter(archive, x0=first, bounds=unit, batch_size=plan.search.population, seed=seed)
    scheduler = Scheduler(archive, [emitter])
    for _ in range(ITS_SHARE * plan.generations * plan.iterations):
        asked = scheduler.ask()
        fitness, fell = stage.outcomes(space.lower + asked * width, np.zeros((1, 0)))
        scheduler.tell(np.where(fell | ~np.isfinite(fitness), 0.0, fitness)[0], asked)
    gaits, foreseen = archive.data(["solution", "objective"], return_type="tuple")
    fastest = float(np.abs(foreseen).max())
    kernel = ConstantKernel(1.0, "fixed") * Matern(0.4, "fixed", nu=2.5)
    process = GaussianProcessRegressor(kernel, alpha=0.001, optimizer=None)
    found, tried, off = [], list[int](), list[float]()
    for _ in range(plan.count):
        mean, std = foreseen / fastest, np.ones(len(gaits))
        if tried:
            more, std = process.fit(gaits[tried], np.array(off)).predict(gaits, return_std=True)
            mean = mean + more
        mean[tried] = -np.inf
        row = int(np.argmax(mean + 0.05 * std))
        trial = robot.run(Controller(space.lower + gaits[row] * width))
        real = trial.fitness if trial.outcome == "done" else 0.0
        tried.append(row)
        off.append((real - float(foreseen[row])) / fastest)
        found.append(shot(trial, None, float(foreseen[row])))
    return found


def cmaes(robot: DrakeRobot, terms: Sequence[Term], seed: int, plan: Plan, folder: Path) -> Shots:
    problem = OnTheRobot(robot, [])
    CmaEs(sigma=0.2, population=8).fit(
        problem,
        rng=np.random.default_rng([seed, 80]),
        budget=Budget(evaluations=ALONE * plan.count),
        journal=Journal(),
        progress=silent,
    )
    return [shot(t) for t in problem.trials]


ONE = {"draws": 1, "choice": "fittest"}
METHODS: Mapping[str, Method] = {
    "loop": in_the_loop({}),
    "learning": in_the_loop({"learn": True}),
    "naming": in_the_loop({"learn": True, "close": True}),
    "fittest": in_the_loop({**ONE, "learn": True}),
    "disagreement": in_the_loop({**ONE, "learn": True, "choice": "disagreement"}),
    "corrected": in_the_loop({**ONE, "correct": True}),
    "nominal": in_the_loop(ONE),
    "randomised": randomised,
    "repertoire": repertoire,
    "cmaes": cmaes,
}
