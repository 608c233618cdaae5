"""`python -m benchmarks.btr --seeds 0 1 2 --out out/btr`: Back to Reality on robots that no model is equal to.

The robots are Naos in another engine (Drake; `pip install 'sysid-btr[benchmarks]'`): `contact` differs from its model
in the ground alone, `late` and `rough` in gains, delay, dry friction, masses, payload and ground; `drawn` in one to
three of these at once, another amount in every seed, as does `quadruped`, which has four legs of two joints. Each
method has the same number of trials of 8 s:

- `loop`: gaits searched in models drawn from what is believed, tried by expected improvement times the chance to stand;
- `learning`: the same, and the model is corrected by the trials (Step 3); `naming` adds what it lacks, too;
- `fittest`: the paper's, one model corrected by the trials, the fittest gaits tried; `disagreement` those on which
  candidate models disagree; `corrected` leaves the model and corrects its fitness linearly;
- `nominal`: the fittest gaits of the nominal model, searched anew from the best on the robot; `blind` is its first;
- `randomised`: one search over the models believed in before any trial, its best gaits tried in order;
- `repertoire`: Intelligent Trial and Error (Cully et al. 2015, doi:10.1038/nature14422), a repertoire of the nominal
  model's gaits by pyribs and a Gaussian process over them;
- `cmaes`: CMA-ES on the robot alone, with ten times as many trials.

A run that is finished is read, one that was stopped goes on; the table is of all that are finished, and of
those that it held.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from dataclasses import asdict
from fnmatch import fnmatchcase
from pathlib import Path
from time import process_time

import numpy as np

from benchmarks.btr.methods import METHODS, Plan
from benchmarks.btr.robots import ROBOTS, TASK, Machine
from benchmarks.btr.table import OURS, row, show, table
from reference_simulator.legged import DrakeRobot, Truth
from sysid_btr.result import to_json
from sysid_btr.terms.grammar import parse_parameters

RESULTS = Path(__file__).parents[1] / "results" / "btr.json"


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
    summary = table([*({**rows, **{(r["robot"], r["seed"], r["method"]): r for r in map(row, found)}}.values())])
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
    machine, truth = ROBOTS[name]
    robot = DrakeRobot(machine.model, TASK, machine.space, truth(seed), seed=seed)
    terms = parse_parameters(list(machine.free), machine.model)
    try:
        trials = METHODS[method](robot, terms, seed, plan, folder)
    finally:
        cpu += process_time()
        spent.write_text(json.dumps(cpu))
    found = {"robot": name, "method": method, "seed": seed, "plan": vars(plan), "truth": asdict(robot.truth)}
    result = folder / "result.json"
    known = json.loads(result.read_text())["parameters"] if result.exists() and method in OURS else []
    learnt = {p["name"]: [p["value"], *p["ci95"], truth_of(p["name"], robot.truth, machine)] for p in known}
    done.write_text(to_json({**found, "trials": trials, "cpu_s": cpu, "learnt": learnt}))


def truth_of(name: str, truth: Truth, machine: Machine) -> float | None:
    """What a parameter is on the robot: of most of its joints, in the mean over its bodies; None if this cannot say."""
    term, _, where = name.partition(":")
    if term == "command_delay":
        return truth.delay
    if term in ("kp", "kv"):
        own = getattr(truth, term)
        factors = [own.get(j, 1.0) for j in machine.space.joints if fnmatchcase(j, where)]
        return float(np.median(factors)) * (truth.gain if term == "kp" and where == "*" else 1.0)
    bodies = [b for b in machine.bodies if fnmatchcase(b, where)] if term == "mass" else []
    if not bodies:
        return None
    nominal = {b: float(machine.model.model.body(b).mass[0]) for b in bodies}
    return float(np.mean([truth.mass.get(b, 1.0) + truth.payload.get(b, (0.0, ()))[0] / nominal[b] for b in bodies]))


if __name__ == "__main__":
    sys.exit(main())
