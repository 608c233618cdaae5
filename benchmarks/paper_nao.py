"""`python -m benchmarks.paper_nao`: the identification of Nao that section 4.2 of the Back-to-Reality paper sets up.

Zagal, Delpiano, Ruiz-del-Solar (2009), doi:10.1016/j.robot.2009.03.010: 4024 samples of 22 joints every 55 ms, 7 steps
of the simulation between two of them, 8 masses within +-50 % of the nominal ones, a genetic algorithm, the distance
phi2; here the mean squared error as well, and least squares, which the paper does not have. The real robot is replaced
by a hidden one: the same geometry with the masses of Aldebaran's V3.2 documentation, those of the 14 bodies that are
not searched for among them, encoders of 12 bits and their noise. It walks open loop.

A search that was stopped goes on from its journal in `--out`. Writes a table and Fig. 5 of the paper, redrawn:
how three joints follow their references before and after.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np

from sysid_btr.estimators import Budget, GeneticAlgorithm, Journal, silent
from sysid_btr.estimators.linearisation import linearise
from sysid_btr.estimators.lsq import LeastSquares
from sysid_btr.identify.intervals import estimates
from sysid_btr.identify.replay import replay_log
from sysid_btr.io.log import Log, LogMeta
from sysid_btr.models.builtin import load_robot
from sysid_btr.models.gait import Gait, gait
from sysid_btr.models.nao import PAPER_BOUNDS, STARRED
from sysid_btr.models.robot import Robot
from sysid_btr.objectives.distance import Distance, DistanceProblem, MeanSquare, Phi2
from sysid_btr.objectives.problem import Comparison, ReplayProblem
from sysid_btr.objectives.targets import make_targets
from sysid_btr.result import to_json
from sysid_btr.simulation.numerics import Numerics
from sysid_btr.simulation.replay import Replay
from sysid_btr.terms.grammar import parse_parameters

RESULTS = Path(__file__).parent / "results"
SAMPLES, PERIOD, STEPS = 4024, 0.055, 7
NUMERICS = Numerics("implicitfast", PERIOD / STEPS)
V32 = {
    "Torso": 0.84,
    "HeadPitch": 1.36,
    "?ShoulderRoll": 1.11,
    "?ElbowYaw": 1.99,
    "?ElbowRoll": 3.17,
    "?HipYawPitch": 0.72,
    "?HipRoll": 0.97,
    "?HipPitch": 1.36,
    "?KneePitch": 0.70,
    "?AnklePitch": 2.40,
    "?AnkleRoll": 1.63,
}
"""Masses of Aldebaran's V3.2 documentation over those of Table 1."""
TRUTH = np.array([V32[f"?{name[1:]}"] for name in STARRED])
TICK, NOISE = 2 * np.pi / 4096, 4e-4
"""rad, of the encoders."""
SIGMA = float(np.hypot(NOISE, TICK / 12**0.5))
"""rad, of both together: at 55 ms a log does not tell its own noise, motion passes for it."""
WALK = Gait()
GENERATIONS, POPULATION, BITS = 11, 15, 10
"""Of the search for a simulation in Fig. 3; the paper ends before it says those of Nao's."""
METRICS: dict[str, Distance] = {"phi2": Phi2(), "mse": MeanSquare()}
PROBE = 0.25
"""Change of one mass under which a metric is probed."""
NEAR = 0.1
"""Error of a mass up to which it counts as identified."""
SHOWN = ("RAnklePitch", "RKneePitch", "RHipRoll")
WINDOW = (60.0, 63.0)
"""s of the walk that the figure shows."""


@dataclass(frozen=True)
class Experiment:
    """The hidden robot's log, and candidates compared with it."""

    log: Log
    threads: int

    @cached_property
    def problem(self) -> ReplayProblem:
        """Whole replays from the first sample, as in the paper."""
        robot = replace(load_robot("nao"), bounds=PAPER_BOUNDS)
        terms = parse_parameters([f"mass:{','.join(STARRED)}"], robot)
        run = Replay(robot, self.log, terms, NUMERICS, threads=self.threads)
        episode = Comparison(run, make_targets(self.log, run.index.joints, ("position",)))
        return ReplayProblem((episode,), np.ones(len(run.parameters)))

    @cached_property
    def names(self) -> tuple[str, ...]:
        return tuple(n.removeprefix("mass:") for n in self.problem.names)

    @cached_property
    def truth(self) -> np.ndarray:
        return np.array([V32[f"?{name[1:]}"] for name in self.names])


def hidden_log(seed: int, threads: int) -> Log:
    """What the hidden robot's encoders show."""
    time = PERIOD * np.arange(SAMPLES)
    commands = {f"command.{j}": c for j, c in gait(WALK, time).items()}
    first = {f"position.{n.removeprefix('command.')}": np.full(SAMPLES, c[0]) for n, c in commands.items()}
    meta = LogMeta(robot="nao", mount="free", sample_period=PERIOD, source="simulated: Nao with V3.2 masses")
    asked = Log(time, {**commands, **first}, meta, np.zeros(SAMPLES, dtype=np.int64))
    robot: Robot = load_robot("nao")
    walked = replay_log(robot, asked, {f"mass:{n}": f for n, f in V32.items()}, numerics=NUMERICS, threads=threads)
    rng = np.random.default_rng(seed)
    seen = dict(commands)
    for name in (n for n in walked.channels if n.startswith("position.")):
        seen[name] = np.round((walked.channels[name] + NOISE * rng.normal(size=SAMPLES)) / TICK) * TICK
    return replace(asked, channels=seen)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; 0 when the table is complete."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.paper_nao", description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("out/paper_nao"), help="folder of the journals")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--generations", type=int, default=GENERATIONS)
    parser.add_argument("--population", type=int, default=POPULATION)
    parser.add_argument("--threads", type=int, default=0, help="worker threads, 0 for all cores")
    parser.add_argument("--record", action="store_true", help="write table and figure to benchmarks/results")
    options = parser.parse_args(argv)
    options.out.mkdir(parents=True, exist_ok=True)
    experiment = Experiment(hidden_log(options.seed, options.threads), options.threads)
    found = {name: search(experiment, name, options) for name in METRICS}
    found["lsq"] = least_squares(experiment, options.out / "lsq.json")
    size = {"generations": options.generations, "population": options.population, "seed": options.seed}
    command = "python -m benchmarks.paper_nao " + " ".join(f"--{name} {value}" for name, value in size.items())
    content = {"command": command, **table(experiment, found)}
    picture = draw(experiment, {name: np.array(f["values"]) for name, f in found.items()})
    for folder in (options.out, *([RESULTS] if options.record else [])):
        (folder / "paper_nao.json").write_text(to_json(content))
        (folder / "paper_nao_fig5.png").write_bytes(picture)
    print(show(content))
    return 0


def search(experiment: Experiment, metric: str, options: argparse.Namespace) -> dict[str, Any]:
    """Step 3 of the algorithm with one metric, and how much that metric sees of each mass."""
    label = f"{metric}_{options.seed}_{options.population}x{options.generations}"
    done = options.out / f"{label}.json"
    if done.exists():
        content: dict[str, Any] = json.loads(done.read_text())
        return content
    began = perf_counter()
    problem = DistanceProblem(experiment.problem, METRICS[metric])
    result = GeneticAlgorithm(population=options.population, generations=options.generations, bits=BITS).fit(
        problem,
        rng=np.random.default_rng([options.seed, 1]),
        budget=Budget(),
        journal=Journal(options.out / f"{label}.jsonl", fingerprint=label),
        progress=silent,
    )
    # the metric under a change of each mass about the truth of the searched ones
    size = len(experiment.names)
    change = PROBE * np.vstack([np.zeros(size), np.eye(size), -np.eye(size)])
    about = problem.loss(np.clip(result.x + change, problem.lower, problem.upper))
    nominal, truth = problem.loss(np.vstack([np.ones(size), experiment.truth]))
    content = {
        "values": result.x,
        "loss": {"nominal": nominal, "starred_true": truth, "found": result.loss},
        "rise": np.maximum(about[1 : 1 + size], about[1 + size :]) - about[0],
        "evaluations": result.evaluations,
        "seconds": perf_counter() - began,
    }
    done.write_text(to_json(content))
    return content


def least_squares(experiment: Experiment, done: Path) -> dict[str, Any]:
    """Maximum likelihood on the same replays, with intervals."""
    if done.exists():
        content: dict[str, Any] = json.loads(done.read_text())
        return content
    began, problem = perf_counter(), experiment.problem
    step = 4e-3
    result = LeastSquares(confirm=False, forward_step=step, max_iterations=6, tolerance=1e-4).fit(
        problem, rng=np.random.default_rng(0), budget=Budget(), journal=Journal(), progress=silent
    )
    residual, jacobian = linearise(problem, result.x, step=step)
    found = estimates(problem.parameters, result.x, jacobian, residual, problem.blocks)
    content = {
        "values": result.x,
        "ci95": [e.ci95 for e in found],
        "chi2": float(np.mean(residual**2)),
        "evaluations": result.evaluations,
        "seconds": perf_counter() - began,
    }
    done.write_text(to_json(content))
    return content


def table(experiment: Experiment, found: dict[str, dict[str, Any]]) -> dict[str, Any]:
    """What each metric identifies."""
    rows = []
    for i, name in enumerate(experiment.names):
        row: dict[str, Any] = {"mass": name, "truth": experiment.truth[i]}
        for metric, f in found.items():
            row[metric] = f["values"][i]
            row[f"{metric}_near"] = bool(abs(f["values"][i] - experiment.truth[i]) <= NEAR)
        rows.append(row)
    following = {}
    candidates = np.vstack([np.ones(len(experiment.names)), *(f["values"] for f in found.values())])
    outputs = experiment.problem.episodes[0].replay.predict(candidates)
    (target,) = experiment.problem.episodes[0].targets
    error = (target.measured - target.predicted(outputs))[:, target.mask]
    for label, e in zip(("nominal", *found), error, strict=True):
        following[label] = {"rmse": float(np.sqrt(np.mean(e**2)))}
    whole = {name: {k: v for k, v in f.items() if k != "values"} for name, f in found.items()}
    return {
        "samples": SAMPLES,
        "period": PERIOD,
        "steps": STEPS,
        "bounds": PAPER_BOUNDS,
        "hidden": V32,
        "noise_floor": SIGMA,
        "masses": rows,
        "following": following,
        "searches": whole,
    }


def show(content: dict[str, Any]) -> str:
    """The table as text."""
    metrics = list(content["searches"])
    lines = ["mass           true   " + "  ".join(f"{m:>7}" for m in metrics)]
    for row in content["masses"]:
        cells = "  ".join(f"{row[m]:6.3f}{'*' if row[f'{m}_near'] else ' '}" for m in metrics)
        lines.append(f"{row['mass']:<14} {row['truth']:5.2f}   {cells}")
    lines.append(f"* within {NEAR:g} of the truth")
    for label, f in content["following"].items():
        lines.append(f"{label:<8} rmse {1e3 * f['rmse']:.3f} mrad (noise {1e3 * content['noise_floor']:.3f})")
    for metric, s in content["searches"].items():
        losses = "  ".join(f"{k} {v:.6g}" for k, v in s.get("loss", {}).items())
        lines.append(f"{metric:<6} {s['evaluations']} evaluations, {s['seconds']:.0f} s  {losses}")
    return "\n".join(lines)


def draw(experiment: Experiment, found: dict[str, np.ndarray]) -> bytes:
    """Fig. 5 of the paper: references and how three joints follow them, before (left) and after (right)."""
    import io

    from matplotlib.figure import Figure

    replay = experiment.problem.episodes[0].replay
    outputs = replay.predict(np.vstack([np.ones(len(experiment.names)), found["phi2"]]))
    time = experiment.log.time
    part = (time >= WINDOW[0]) & (time <= WINDOW[1])
    figure = Figure(figsize=(8.0, 6.0), layout="constrained")
    axes = figure.subplots(len(SHOWN), 2, sharex=True, sharey="row")
    for row, joint in zip(axes, SHOWN, strict=True):
        column = replay.index.joints.index(joint)
        for axis, position, title in zip(
            row, outputs.position, ("nominal masses", "after phi2 and the GA"), strict=True
        ):
            axis.step(
                time[part],
                experiment.log.channels[f"command.{joint}"][part],
                where="post",
                color="0.7",
                label="reference",
            )
            axis.plot(time[part], experiment.log.channels[f"position.{joint}"][part], "k.", ms=3, label="hidden robot")
            axis.plot(time[part], position[part, column], color="C0", lw=1.2, label="simulation")
            if joint == SHOWN[0]:
                axis.set_title(title, fontsize=9)
        row[0].set_ylabel(f"{joint} / rad", fontsize=8)
    for axis in axes[-1]:
        axis.set_xlabel("time / s", fontsize=8)
    figure.legend(*axes[0, 0].get_legend_handles_labels(), fontsize=7, loc="outside upper center", ncols=3)
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=110)
    return buffer.getvalue()


if __name__ == "__main__":
    sys.exit(main())
