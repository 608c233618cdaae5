"""`python -m benchmarks.btr_nao --seeds 0 1 --out out/btr_nao`: Back to Reality on a hidden Nao.

The hidden robot has the masses of Aldebaran's V3.2 documentation, 0.9 of the nominal kp, commands 25 ms late and dry
friction, another amount in every joint and in every seed; its step is 2 ms, the model's 5 ms. The model declares all
masses, left and right alike, kp and kv, and neither delay nor friction. 20 real trials of 8 s, in 5 iterations.
The loop must walk farther than what nominal-only search finds, and must name delay and friction on the way.

Nominal-only search has as many simulated walks as the loop in all and begins each of its searches at the fittest
controller on the robot, as the loop does. Of it are told: its last controller transferred blindly, and the best of as
many real trials, chosen as the loop chooses its own.

A seed that is finished is read, one that was stopped goes on; the table is of all seeds that are finished.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from time import process_time
from typing import Any

import numpy as np

from benchmarks.btr_seeds import loop, study
from benchmarks.paper_nao import V32
from sysid_btr.btr.choice import pool_of
from sysid_btr.btr.controllers import Controller
from sysid_btr.btr.gaits import NaoGait
from sysid_btr.btr.learning import model_fit
from sysid_btr.btr.outcome import BackToReality
from sysid_btr.btr.problems import ControllerProblem, Stage
from sysid_btr.btr.robot import HiddenRobot, Noise
from sysid_btr.btr.settings import Settings, cma_controller_searches, controller_search, first_controller_search
from sysid_btr.btr.task import Walk
from sysid_btr.btr.trials import TrialBook
from sysid_btr.btr.world import make_world
from sysid_btr.estimators import Budget, CmaEs, Estimator, Journal, silent
from sysid_btr.identify.replay import set_parameters
from sysid_btr.models.builtin import load_robot
from sysid_btr.models.robot import servo_joints
from sysid_btr.simulation.numerics import Numerics
from sysid_btr.terms.effect import Effect
from sysid_btr.terms.friction import CoulombFriction
from sysid_btr.terms.grammar import parse_parameters
from sysid_btr.terms.servo import CommandDelay

TASK = Walk(8.0)
FREE = (*(f"mass:{place}=shared" for place in V32), "kp:*=shared", "kv:*=shared")
DELAY, GAIN, FRICTION = 0.025, 0.9, (0.1, 0.3)
"""s, of all commands; kp over its nominal; Nm, of each joint."""
HIDDEN = Numerics("implicitfast", 0.002)
CONTROLLERS: Mapping[str, Callable[[int], tuple[Estimator, Estimator]]] = {
    "ga": lambda generations: (
        replace(first_controller_search(), generations=generations),
        replace(controller_search(len(NaoGait().names)), generations=generations),
    ),
    "cmaes": cma_controller_searches,
}
"""Step 1 in the first iteration and in the others, by its generations of 20."""
MODELS: Mapping[str, Estimator] = {"lsq": model_fit(), "cmaes": CmaEs(population=12, max_generations=8, sigma=0.1)}
FRICTIONS = ("coulomb_friction", "stribeck_friction", "load_friction")


@dataclass(frozen=True)
class Plan:
    """How a seed is run."""

    iterations: int = 5
    trials: int = 4
    memory: int = 4
    distance: str = "likelihood"
    choice: str = "fittest"
    models: str = "lsq"
    controllers: str = "cmaes"
    generations: int = 11

    @property
    def settings(self) -> Settings:
        first, controllers = CONTROLLERS[self.controllers](self.generations)
        return Settings(
            iterations=self.iterations,
            trials=self.trials,
            first=first,
            controllers=controllers,
            models=MODELS[self.models],
            distance=self.distance,
            choice=self.choice,
            memory=self.memory,
            close=True,
        )


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; 0 when the table is written."""
    return study("btr_nao", __doc__, Plan, run_seed, table, show, argv)


def hidden_robot(seed: int, threads: int = 1) -> HiddenRobot:
    """The robot of a seed."""
    model = load_robot("nao")
    joints = servo_joints(model)
    friction = np.random.default_rng([seed, 1000]).uniform(*FRICTION, len(joints))
    truth = set_parameters(model, {**{f"mass:{n}": f for n, f in V32.items()}, "kp:*=shared": GAIN})
    truth = truth.with_(CommandDelay(places=joints, shared=True), [DELAY])
    truth = truth.with_(CoulombFriction(places=joints), friction)
    world = replace(make_world(model, TASK, truth.terms, threads=threads), numerics=HIDDEN)
    return HiddenRobot(world, truth.values, TASK, NaoGait(), Noise(), seed)


def run_seed(seed: int, plan: Plan, out: Path, threads: int) -> dict[str, Any]:
    """One hidden Nao: the loop and what it is compared with."""
    cpu = process_time()
    model, robot = load_robot("nao"), hidden_robot(seed, threads)
    terms = parse_parameters(list(FREE), model)
    outcome = loop(model, terms, robot, plan.settings, out, threads)
    loop_s = process_time() - cpu
    stage = Stage(make_world(model, TASK, terms, threads=threads), TASK, robot.space)
    return {**_of_loop(outcome, robot), **nominal_only(stage, robot, outcome, plan, out), "loop_cpu_s": loop_s}


def _of_loop(outcome: BackToReality, robot: HiddenRobot) -> dict[str, Any]:
    effects = [m for m in outcome.stage.world.terms if isinstance(m, Effect)]
    model = dict(zip([p.name for p in outcome.parameters], outcome.model, strict=True))
    amounts = {e.name: [float(v) for n, v in model.items() if n.startswith(f"{e.name}:")] for e in effects}
    return {
        "trials": len(outcome.tried),
        "fell": sum(t.trial.outcome != "done" for t in outcome.tried),
        "best": [i.best for i in outcome.iterations],
        "transfer": [i.transfer for i in outcome.iterations],
        "noise": [i.noise for i in outcome.iterations],
        "closings": {str(i.number): i.joined for i in outcome.iterations if i.joined},
        "effects": amounts,
        "delay": amounts.get("command_delay"),
        "friction": next((amounts[n] for n in FRICTIONS if n in amounts), None),
        "model": model,
        "true_friction": robot.truth[-22:],
        "simulations": outcome.simulations,
        "reason": outcome.reason,
    }


def nominal_only(stage: Stage, robot: HiddenRobot, outcome: BackToReality, plan: Plan, out: Path) -> dict[str, Any]:
    """Controllers searched in the nominal model alone, with as many simulated walks and as many real trials."""
    settings = outcome.settings
    nominal = np.array([p.nominal for p in stage.parameters])
    generations = max(round(outcome.simulations / (settings.iterations * 20)), plan.generations)
    first, others = CONTROLLERS[plan.controllers](generations)
    book = TrialBook(out / "nominal_trials")
    blind = stage.space.start
    best_of_all, spent = -np.inf, 0
    for number in range(1, settings.iterations + 1):
        search = first if number == 1 else others
        start = stage.space.start if book.best is None else book.best.controller.values
        journal = Journal(out / f"nominal_{number:02d}.jsonl")
        found = search.fit(
            ControllerProblem(stage, nominal, start),
            rng=np.random.default_rng([outcome.seed, 3000, number]),
            budget=Budget(),
            journal=journal,
            progress=silent,
        )
        spent += found.evaluations
        if -found.loss > best_of_all:
            best_of_all, blind = -found.loss, found.x
        pool = pool_of(journal.records, book.known)
        for controller, expected in zip(pool.controllers, pool.expected[: settings.trials], strict=False):
            book.add(robot, number, controller, float(expected))
    assert book.best is not None
    transferred = robot.run(Controller(blind))
    return {
        "nominal_blind": transferred.fitness,
        "nominal_blind_outcome": transferred.outcome,
        "nominal_expected": best_of_all,
        "nominal_tried": book.best.trial.fitness,
        "nominal_trials": len(book.made),
        "nominal_simulations": spent,
    }


def table(found: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """What the study says over seeds."""
    return {
        "command": "python -m benchmarks.btr_nao --seeds " + " ".join(str(f["seed"]) for f in found),
        "hidden": {"masses": V32, "kp": GAIN, "delay_s": DELAY, "friction_Nm": FRICTION, "numerics": str(HIDDEN)},
        "seeds": found,
        "farther_than_blind": sum(f["best"][-1] > f["nominal_blind"] for f in found),
        "farther_than_tried": sum(f["best"][-1] > f["nominal_tried"] for f in found),
        "delay_named": sum(f["delay"] is not None for f in found),
        "friction_named": sum(f["friction"] is not None for f in found),
        "over_nominal_blind_median": np.median([f["best"][-1] - f["nominal_blind"] for f in found]),
        "over_nominal_tried_median": np.median([f["best"][-1] - f["nominal_tried"] for f in found]),
        "cpu_s": [f["cpu_s"] for f in found],
    }


def show(found: Sequence[dict[str, Any]]) -> str:
    """The table as text."""
    if not found:
        return "no seed is finished; give --seeds"
    lines = [
        "seed  trials  best m/s  nominal blind  nominal tried  effects (true: delay 0.025 s, friction 0.1 to 0.3 Nm)"
    ]
    for f in found:
        effects = ", ".join(f"{n} {' '.join(f'{v:.3g}' for v in vs[:3])}" for n, vs in f["effects"].items())
        lines.append(
            f"{f['seed']:4d}  {f['trials']:6d}  {f['best'][-1]:8.4f}  {f['nominal_blind']:13.4f}  "
            f"{f['nominal_tried']:13.4f}  {effects or 'none named'}"
        )
    s = table(found)
    lines.append(
        f"farther than nominal-only search blindly {s['farther_than_blind']}/{len(found)} (median "
        f"{s['over_nominal_blind_median']:.3f} m/s), with as many real trials {s['farther_than_tried']}/{len(found)} "
        f"({s['over_nominal_tried_median']:.3f} m/s); delay named {s['delay_named']}, friction "
        f"{s['friction_named']}/{len(found)}; {np.median(s['cpu_s']):.0f} s CPU a seed"
    )
    return "\n".join(lines)


if __name__ == "__main__":
    sys.exit(main())
