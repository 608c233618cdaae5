"""`python -m benchmarks.btr --seeds 0 1 2 --out out/btr`: Back to Reality on robots that no model is equal to.

The robots are Naos in another engine (Drake; `pip install 'sysid-btr[benchmarks]'`): `contact` differs from its model
in the ground alone, `late` and `rough` in gains, delay, dry friction, masses, payload and ground; `drawn` in one to
three of these at once, another amount in every seed. Each method has the same number of trials of 8 s:

- `loop`: gaits searched in models drawn from what is believed, tried by expected improvement times the chance to stand;
- `learning`: the same, and the model is corrected by the trials (Step 3);
- `fittest`: the paper's, one model corrected by the trials, the fittest gaits tried; `disagreement` those on which
  candidate models disagree; `corrected` leaves the model and corrects its fitness linearly;
- `nominal`: the fittest gaits of the nominal model, searched anew from the best on the robot; `blind` is its first;
- `randomised`: one search over the models believed in before any trial, its best gaits tried in order;
- `cmaes`: CMA-ES on the robot alone.

A run that is finished is read, one that was stopped goes on; the table is of all that are finished, and of
those that it held.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from fnmatch import fnmatchcase
from pathlib import Path
from time import process_time
from typing import Any

import numpy as np

from benchmarks.btr_nao import FREE
from reference_simulator.legged import DrakeRobot, Ground, Truth
from sysid_btr._typing import FloatArray
from sysid_btr.btr.belief import Belief
from sysid_btr.btr.choice import pool_of
from sysid_btr.btr.controllers import Controller, NaoGait
from sysid_btr.btr.learning import model_fit
from sysid_btr.btr.loop import back_to_reality
from sysid_btr.btr.outlook import Imagination
from sysid_btr.btr.problems import Stage
from sysid_btr.btr.robot import Trial
from sysid_btr.btr.robust import Risk, RobustProblem
from sysid_btr.btr.settings import LIKELIHOOD, Settings
from sysid_btr.btr.task import Walk
from sysid_btr.btr.world import make_world
from sysid_btr.estimators import Budget, CmaEs, Journal, silent
from sysid_btr.models.builtin import load_robot
from sysid_btr.result import to_json
from sysid_btr.terms.grammar import parse_parameters

RESULTS = Path(__file__).parent / "results" / "btr.json"
TASK, SPACE, NAO = Walk(8.0), NaoGait(), load_robot("nao")
BODIES = tuple(NAO.model.body(b).name for b in range(1, NAO.model.nbody))
LEGS = tuple(j for j in SPACE.joints if any(part in j for part in ("Hip", "Knee", "Ankle")))
REPORTED = (1, 4, 10, 16, 20)
"""Trials after which the best so far is told; of a run that ended before, its last."""


APART = 0.1
"""Root mean square difference, fraction of the range, of gaits of one search that are tried without learning."""


@dataclass(frozen=True)
class Plan:
    """What a run may spend."""

    iterations: int = 5
    trials: int = 4
    draws: int = 6
    generations: int = 5

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


def spread(names: Sequence[str], low: float, high: float, seed: int) -> dict[str, float]:
    """Amounts drawn evenly, one a place."""
    return dict(zip(names, np.random.default_rng([seed, 50]).uniform(low, high, len(names)).tolist(), strict=True))


def contact(seed: int) -> Truth:
    return Truth()


def late(seed: int) -> Truth:
    return Truth(
        gain=0.88,
        delay=0.03,
        friction=spread(SPACE.joints, 0.05, 0.25, 7),
        mass=spread(BODIES, 0.86, 1.13, 8),
        payload={"Torso": (0.3, (0.0, 0.0, 0.07))},
        ground=Ground(friction=0.7),
    )


def rough(seed: int) -> Truth:
    return Truth(
        gain=0.8,
        delay=0.044,
        friction=spread(SPACE.joints, 0.1, 0.35, 7),
        mass=spread(BODIES, 0.8, 1.2, 8),
        ground=Ground(friction=0.9),
    )


def drawn(seed: int) -> Truth:
    """One to three differences, drawn with their amounts."""
    rng = np.random.default_rng([seed, 60])
    joint, side = str(rng.choice(LEGS)), float(rng.uniform(-0.03, 0.03))
    differences: Sequence[Mapping[str, Any]] = (
        {"mass": spread(BODIES, 0.7, 1.4, seed)},
        {"gain": float(rng.uniform(0.75, 1.2))},
        {"delay": 0.002 * float(rng.integers(5, 24))},
        {"friction": spread(SPACE.joints, 0.05, 0.35, seed)},
        {"payload": {"Torso": (float(rng.uniform(0.2, 0.6)), (side, 0.0, 0.08))}},
        {"kp": {joint: float(rng.uniform(0.4, 0.7))}},
        {"ground": Ground(float(rng.uniform(0.5, 1.0)), float(10 ** rng.uniform(3.7, 5.0)))},
    )
    found: dict[str, Any] = {}
    for i in rng.permutation(len(differences))[: rng.integers(1, 4)]:
        found |= differences[i]
    return Truth(**found)


ROBOTS: Mapping[str, Callable[[int], Truth]] = {"contact": contact, "late": late, "rough": rough, "drawn": drawn}


def in_the_loop(change: Mapping[str, Any]) -> Callable[[DrakeRobot, int, Plan, Path], list[dict[str, Any]]]:
    """A method that is Back to Reality with some settings of its own."""

    def run(robot: DrakeRobot, seed: int, plan: Plan, folder: Path) -> list[dict[str, Any]]:
        outcome = back_to_reality(
            NAO,
            parse_parameters(list(FREE), NAO),
            robot,
            SPACE,
            task=TASK,
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


def randomised(robot: DrakeRobot, seed: int, plan: Plan, folder: Path) -> list[dict[str, Any]]:
    """One search over the prior, as many simulations as the loop's; its best gaits, no two alike, tried in order."""
    terms = parse_parameters(list(FREE), NAO)
    others, unmeasured = Belief.unmeasured(NAO, terms)
    stage = Stage(make_world(NAO, TASK, (*terms, *others), threads=1), TASK, SPACE)
    models = Belief.before(terms).beside(unmeasured).draws(np.random.default_rng([seed, 70]), plan.draws)
    problem = RobustProblem(stage, models, SPACE.start, SPACE.lower, SPACE.upper, Risk(weight=0.0, fall=0.0))
    journal = Journal(folder / "search.jsonl")
    search = replace(plan.search, max_generations=2 * plan.generations * plan.iterations)
    search.fit(problem, rng=np.random.default_rng([seed, 71]), budget=Budget(), journal=journal, progress=silent)
    best = Imagination(stage, models).shortlist(pool_of(journal.records, set()), plan.count, APART)
    return [shot(robot.run(Controller(c)), None, float(e)) for c, e in zip(*vars(best).values(), strict=True)]


@dataclass(frozen=True, eq=False)
class OnTheRobot:
    """The robot as a problem of an estimator; every evaluation is a trial, and is kept."""

    robot: DrakeRobot
    trials: list[Trial]
    names: tuple[str, ...] = SPACE.names

    @property
    def lower(self) -> FloatArray:
        return SPACE.lower

    @property
    def upper(self) -> FloatArray:
        return SPACE.upper

    @property
    def start(self) -> FloatArray:
        return SPACE.start

    def loss(self, candidates: FloatArray) -> FloatArray:
        made = [self.robot.run(Controller(c)) for c in candidates]
        self.trials.extend(made)
        return -np.array([t.fitness for t in made])


def cmaes(robot: DrakeRobot, seed: int, plan: Plan, folder: Path) -> list[dict[str, Any]]:
    problem = OnTheRobot(robot, [])
    CmaEs(sigma=0.2, population=8).fit(
        problem,
        rng=np.random.default_rng([seed, 80]),
        budget=Budget(evaluations=plan.count),
        journal=Journal(),
        progress=silent,
    )
    return [shot(t) for t in problem.trials]


ONE = {"draws": 1, "choice": "fittest"}
METHODS: Mapping[str, Callable[[DrakeRobot, int, Plan, Path], list[dict[str, Any]]]] = {
    "loop": in_the_loop({}),
    "learning": in_the_loop({"learn": True}),
    "fittest": in_the_loop({**ONE, "learn": True}),
    "disagreement": in_the_loop({**ONE, "learn": True, "choice": "disagreement"}),
    "corrected": in_the_loop({**ONE, "correct": True}),
    "nominal": in_the_loop(ONE),
    "randomised": randomised,
    "cmaes": cmaes,
}


OURS = ("loop", "learning")


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; 0 when the table is written."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.btr", description=__doc__)
    parser.add_argument("--robots", nargs="+", choices=ROBOTS, default=list(ROBOTS))
    parser.add_argument("--methods", nargs="+", choices=METHODS, default=list(METHODS))
    parser.add_argument("--seeds", type=int, nargs="*", default=[], help="to run; without, only the table")
    parser.add_argument("--out", type=Path, default=Path("out/btr"), help="folder of the runs")
    for option, value in vars(Plan()).items():
        parser.add_argument(f"--{option}", type=type(value), default=value)
    parser.add_argument("--record", action="store_true", help="write the table beside the other results")
    options = parser.parse_args(argv)
    plan = Plan(**{option: getattr(options, option) for option in vars(Plan())})
    for seed in options.seeds:
        for name in options.robots:
            for method in options.methods:
                run(name, method, seed, plan, options.out)
    found = [json.loads(p.read_text()) for p in sorted(options.out.glob("*/*/summary.json"))]
    rows = {(r["robot"], r["seed"], r["method"]): r for r in json.loads(RESULTS.read_text())["runs"]}
    summary = table([*({**rows, **{(r["robot"], r["seed"], r["method"]): r for r in map(_row, found)}}.values())])
    if found and options.record:
        RESULTS.write_text(to_json(summary))
    print(show(summary))
    return 0


def run(name: str, method: str, seed: int, plan: Plan, out: Path) -> None:
    """One robot under one method, unless that is done."""
    folder = out / f"{name}_{seed:02d}" / method
    done = folder / "summary.json"
    if done.exists():
        return
    folder.mkdir(parents=True, exist_ok=True)
    print(f"{name} {seed} {method}", flush=True)
    spent = folder / "cpu_s.json"
    cpu = (json.loads(spent.read_text()) if spent.exists() else 0.0) - process_time()
    robot = DrakeRobot(NAO, TASK, SPACE, ROBOTS[name](seed), seed=seed)
    try:
        trials = METHODS[method](robot, seed, plan, folder)
    finally:
        cpu += process_time()
        spent.write_text(json.dumps(cpu))
    found = {"robot": name, "method": method, "seed": seed, "plan": vars(plan), "truth": asdict(robot.truth)}
    result = folder / "result.json"
    known = json.loads(result.read_text())["parameters"] if result.exists() and method == "learning" else []
    learnt = {p["name"]: [p["value"], *p["ci95"], truth_of(p["name"], robot.truth)] for p in known}
    done.write_text(to_json({**found, "trials": trials, "cpu_s": cpu, "learnt": learnt}))


def truth_of(name: str, truth: Truth) -> float:
    """What a declared parameter is on the robot: the mean over its places, payloads included."""
    term, _, where = name.partition(":")
    if term == "command_delay":
        return truth.delay
    if term in ("kp", "kv"):
        own = getattr(truth, term)
        return float(np.mean([own.get(j, 1.0) for j in SPACE.joints])) * (truth.gain if term == "kp" else 1.0)
    bodies = [b for b in BODIES if fnmatchcase(b, where)]
    nominal = {b: float(NAO.model.body(b).mass[0]) for b in bodies}
    return float(np.mean([truth.mass.get(b, 1.0) + truth.payload.get(b, (0.0, ()))[0] / nominal[b] for b in bodies]))


def table(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Each run, and each method over all robots that it was run on."""
    methods = [m for m in METHODS if any(r["method"] == m for r in rows)]
    return {
        "command": " ".join(
            ["python -m benchmarks.btr", *(f"--{k}s {_listed(rows, k)}" for k in ("robot", "method", "seed"))]
        ),
        "runs": rows,
        "methods": {m: _over([r for r in rows if r["method"] == m]) for m in methods},
        "ahead_after_10_of_others_at_the_end": {m: _ahead(rows, m) for m in methods if m in OURS},
    }


def _listed(rows: Sequence[Mapping[str, Any]], key: str) -> str:
    return " ".join(map(str, dict.fromkeys(r[key] for r in rows)))


def _ahead(rows: Sequence[Mapping[str, Any]], method: str) -> dict[str, str]:
    """On how many of the robots that both were run on a method's best of 10 trials beats all trials of another."""
    best = {(r["robot"], r["seed"], r["method"]): list(r["best"].values()) for r in rows}
    halfway = {
        key[:2]: r["best"]["10"] for key, r in zip(best, rows, strict=True) if key[2] == method and "10" in r["best"]
    }
    found = {}
    for other, trial, called in [("nominal", 0, "blind"), *((m, -1, m) for m in METHODS if m not in OURS)]:
        pairs = [(own, best[(*robot, other)][trial]) for robot, own in halfway.items() if (*robot, other) in best]
        if pairs:
            found[called] = f"{sum(own > theirs for own, theirs in pairs)} of {len(pairs)}"
    return found


def _row(f: Mapping[str, Any]) -> dict[str, Any]:
    stood = np.array([t["outcome"] == "done" for t in f["trials"]])
    # what fell is no gait that anybody would use
    fitness = np.where(stood, [t["fitness"] for t in f["trials"]], 0.0)
    best = np.maximum.accumulate(fitness)
    told = [(t, t["foreseen"]) for t in f["trials"] if t["foreseen"]]
    first, planned = f["plan"]["trials"], f["plan"]["trials"] * f["plan"]["iterations"]
    return {
        "robot": f["robot"],
        "seed": f["seed"],
        "method": f["method"],
        "trials": len(stood),
        "fell": int(np.sum(~stood)),
        "later": len(stood) - first,
        "fell_later": int(np.sum(~stood[first:])),
        "best": {str(n): float(best[min(n, len(best)) - 1]) for n in REPORTED if n <= max(len(best), planned)},
        "held": sum(s["low"] <= t["fitness"] <= s["high"] for t, s in told),
        "told": len(told),
        "falls_foreseen": float(sum(1 - s["stands"] for _, s in told)),
        "cpu_s": f["cpu_s"],
        "learnt": f.get("learnt", {}),
    }


def _over(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    def share(part: str, whole: str) -> float | None:
        count = sum(r[whole] for r in rows)
        return sum(r[part] for r in rows) / count if count else None

    reached = {n: [r["best"][str(n)] for r in rows if str(n) in r["best"]] for n in REPORTED}
    return {
        "runs": len(rows),
        "fell": share("fell", "trials"),
        "fell_after_the_first_iteration": share("fell_later", "later"),
        "intervals_hold": share("held", "told"),
        "best_median": {str(n): float(np.median(v)) for n, v in reached.items() if v},
        "cpu_s_median": float(np.median([r["cpu_s"] for r in rows])),
    }


def show(summary: Mapping[str, Any]) -> str:
    """The table as text."""
    if not summary["runs"]:
        return "no run is finished; give --seeds"
    lines = ["robot       method      trials  fell  (later)  best m/s after 1, 4, 10, all  in 90 %  CPU s"]
    for r in sorted(summary["runs"], key=lambda r: (r["robot"], r["seed"], list(METHODS).index(r["method"]))):
        best = list(r["best"].values())
        after = "  ".join(f"{b:6.3f}" for b in (best[:3] + best[-1:] if len(best) > 3 else best))
        held = f"{r['held']}/{r['told']}" if r["told"] else "-"
        lines.append(
            f"{r['robot']:8s}{r['seed']:3d}  {r['method']:10s}{r['trials']:7d}{r['fell']:6d}  ({r['fell_later']:2d}/"
            f"{r['later']:2d})  {after:30s}  {held:>6s}  {r['cpu_s']:5.0f}"
        )
    for name, m in summary["methods"].items():
        falls = m["fell_after_the_first_iteration"]
        held = "" if m["intervals_hold"] is None else f"; {m['intervals_hold']:.0%} of trials in their 90 % interval"
        best = ", ".join(f"{b:.3f} after {n}" for n, b in m["best_median"].items())
        fell = "" if falls is None else f", {falls:.0%} after the first iteration"
        lines.append(f"{name}: {m['runs']} runs, {m['fell']:.0%} of trials fell{fell}; median best {best}{held}")
    for r in summary["runs"]:
        known = [low <= truth <= high for _, low, high, truth in r.get("learnt", {}).values()]
        if known:
            lines.append(f"{r['robot']} {r['seed']}: {sum(known)} of {len(known)} 95 % intervals hold the truth")
    for name, ahead in summary["ahead_after_10_of_others_at_the_end"].items():
        lines.append(
            f"{name} after 10 trials ahead of all trials of: " + ", ".join(f"{m} {k}" for m, k in ahead.items())
        )
    return "\n".join(lines)


if __name__ == "__main__":
    sys.exit(main())
