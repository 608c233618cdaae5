"""`python -m benchmarks.btr_ant --seeds 0 1 --out out/btr_ant`: Back to Reality on the ant of the paper's section 4.1.

Hidden ants whose four unknown segments are 0.75 to 1.25 of their nominal lengths, encoders with noise and steps.
13 iterations, 11 generations of 20 controllers and of 15 models, 12 trials an iteration. Compared with a GA on the
robot alone with as many trials, and with the best controller of the nominal model, searched as long, transferred
blindly. A seed that is finished is read, one that was stopped goes on; the table is of all seeds that are finished.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.btr_seeds import loop, study
from sysid_btr.btr.controllers import Controller
from sysid_btr.btr.gaits import ant_gait
from sysid_btr.btr.outcome import BackToReality, estimate_model
from sysid_btr.btr.problems import ControllerProblem, Stage
from sysid_btr.btr.robot import HiddenRobot, Noise
from sysid_btr.btr.settings import Settings, model_search, papers_model_search
from sysid_btr.btr.task import Walk
from sysid_btr.btr.world import make_world
from sysid_btr.estimators import Budget, GeneticAlgorithm, Journal, silent
from sysid_btr.models.ant import UNKNOWN
from sysid_btr.models.builtin import load_robot
from sysid_btr.terms.grammar import parse_parameters

RANGE = (0.75, 1.25)
TASK = Walk(3.0)
CLOSE_ENOUGH = 0.05
"""Relative error of a length, median over seeds, that is to be reached."""
MODELS = {"ga": papers_model_search(), "cmaes": model_search()}


@dataclass(frozen=True)
class Plan:
    """How a seed is run."""

    iterations: int = 13
    trials: int = 12
    memory: int = 12
    models: str = "cmaes"
    choice: str = "fittest"

    @property
    def settings(self) -> Settings:
        return Settings(
            iterations=self.iterations,
            trials=self.trials,
            memory=self.memory,
            models=MODELS[self.models],
            choice=self.choice,
        )


def main(argv: Sequence[str] | None = None) -> int:
    return study("btr_ant", __doc__, Plan, run_seed, table, show, argv)


def run_seed(seed: int, plan: Plan, out: Path, threads: int) -> dict[str, Any]:
    """One hidden ant: the loop and what it is compared with."""
    model, space = load_robot("ant"), ant_gait()
    terms = parse_parameters([f"length:{','.join(UNKNOWN)}"], model)
    truth = np.random.default_rng([seed, 1000]).uniform(*RANGE, len(UNKNOWN))
    stage = Stage(make_world(model, TASK, terms, threads=threads), TASK, space)
    robot = HiddenRobot(stage.world, truth, TASK, space, Noise(), seed)
    names = [p.name for p in stage.parameters]
    outcome = loop(model, terms, robot, plan.settings, out, threads, dict(zip(names, truth, strict=True)))
    return {"truth": truth, **_of_loop(outcome, truth), **compare(stage, robot, outcome, out, seed)}


def _of_loop(outcome: BackToReality, truth: np.ndarray) -> dict[str, Any]:
    errors = [np.abs(i.model / truth - 1) for i in outcome.iterations]
    intervals = estimate_model(outcome)
    return {
        "trials": len(outcome.tried),
        "best": [i.best for i in outcome.iterations],
        "never_falls": bool(np.all(np.diff([i.best for i in outcome.iterations]) >= 0)),
        "transfer": [i.transfer for i in outcome.iterations],
        "error": errors,
        "error_at_end": errors[-1],
        "inside_ci95": sum(e.ci95[0] <= t <= e.ci95[1] for e, t in zip(intervals, truth, strict=True)),
        "reason": outcome.reason,
    }


def compare(stage: Stage, robot: HiddenRobot, outcome: BackToReality, out: Path, seed: int) -> dict[str, Any]:
    """A GA with as many trials on the robot alone, and the nominal model's best controller on the robot."""
    settings, space = outcome.settings, stage.space
    rng = np.random.default_rng([seed, 2000])
    trials = len(outcome.tried)
    alone = GeneticAlgorithm(population=20, bits=8, patience=1000).fit(
        ControllerProblem(stage, robot.truth, space.start),
        rng=rng,
        budget=Budget(evaluations=trials),
        journal=Journal(out / "robot_alone.jsonl"),
        progress=silent,
    )
    start, nominal = space.start, np.ones(len(robot.truth))
    for number in range(1, settings.iterations + 1):
        search = settings.first if number == 1 else settings.controllers
        start = search.fit(
            ControllerProblem(stage, nominal, start),
            rng=np.random.default_rng([seed, 3000, number]),
            budget=Budget(),
            journal=Journal(out / f"nominal_{number:02d}.jsonl"),
            progress=silent,
        ).x
    blind = robot.run(Controller(start)).fitness
    best = outcome.best.trial.fitness
    return {
        "robot_alone": -alone.loss,
        "nominal_blind": blind,
        "nominal_expected": float(stage.fitness(start[None], nominal[None])[0, 0]),
        "over_robot_alone": best / -alone.loss,
        "over_nominal_blind": best / blind,
    }


def table(found: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """What the study says over seeds."""
    errors = np.array([f["error_at_end"] for f in found])
    return {
        "seeds": [f["seed"] for f in found],
        "command": "python -m benchmarks.btr_ant --seeds " + " ".join(str(f["seed"]) for f in found),
        "plans": [f["plan"] for f in found],
        "never_falls": all(f["never_falls"] for f in found),
        "trials": max(f["trials"] for f in found),
        "error_median": np.median(errors, axis=0),
        "within_5_percent": bool(np.all(np.median(errors, axis=0) <= CLOSE_ENOUGH)),
        "best": [f["best"][-1] for f in found],
        "robot_alone": [f["robot_alone"] for f in found],
        "nominal_blind": [f["nominal_blind"] for f in found],
        "over_robot_alone_median": np.median([f["over_robot_alone"] for f in found]),
        "over_nominal_blind_median": np.median([f["over_nominal_blind"] for f in found]),
        "inside_ci95": sum(f["inside_ci95"] for f in found) / errors.size,
    }


def show(found: Sequence[dict[str, Any]]) -> str:
    """The table as text."""
    if not found:
        return "no seed is finished; give --seeds"
    lines = ["seed  trials  best m/s  robot alone  blind   x alone  x blind  error of lengths %"]
    for f in found:
        errors = " ".join(f"{100 * e:5.1f}" for e in f["error_at_end"])
        lines.append(
            f"{f['seed']:4d}  {f['trials']:6d}  {f['best'][-1]:8.4f}  {f['robot_alone']:11.4f}  "
            f"{f['nominal_blind']:6.4f}  {f['over_robot_alone']:7.2f}  {f['over_nominal_blind']:7.2f}  {errors}"
        )
    summary = table(found)
    errors = " ".join(f"{100 * e:.1f}" for e in summary["error_median"])
    lines.append(
        f"median error {errors} %; x robot alone {summary['over_robot_alone_median']:.2f}, x nominal blind "
        f"{summary['over_nominal_blind_median']:.2f}; never falls: {summary['never_falls']}; "
        f"{100 * summary['inside_ci95']:.0f} % of lengths in their ci95"
    )
    return "\n".join(lines)


if __name__ == "__main__":
    sys.exit(main())
