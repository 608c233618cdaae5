"""`python -m benchmarks.estimators`: loss against simulations used, for every kind of estimator at equal budgets.

All minimise the sum of squared whitened residuals of one replay problem within the same bounds, one simulation of
one candidate counted as one, whether it is for a loss or for a derivative. Each seed begins at another point, drawn
within a fifth of the range of the bounds about the nominal values; estimators that draw their own first candidates
draw them by that seed. Settings are the package's defaults. A run that ends by itself keeps its loss to the end of the
budget.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Any

import numpy as np

from benchmarks.gantry import FIT, data_folder
from benchmarks.replay import ROOT, machine

if TYPE_CHECKING:
    from sysid_btr.io.log import Log
    from sysid_btr.models.robot import Robot
    from sysid_btr.objectives.problem import ReplayProblem

RESULTS = Path(__file__).parent / "results"
ESTIMATORS = ("lsq", "nlopt:LN_BOBYQA", "cmaes", "nlopt:GN_CRS2_LM", "nlopt:GN_ISRES", "ga")
BUDGETS = (0.1, 0.25, 0.5, 1.0)
NEAR = 0.01
"""Of the best loss anybody found: within this much of it counts as found."""
CURVE = 24
"""Points of a curve that are kept, spread evenly over the logarithm of the simulations."""
FINE = 1e-3
"""Share of a loss by which improvements within reach of the end are told apart."""
AWAY = 0.2
"""Of the range of a parameter's bounds: how far from the nominal value a search begins at most."""


@dataclass(frozen=True)
class Source:
    """What is fitted: log, model, parameters, seconds of the log (all of them are fitted), simulations to spend."""

    log: Path
    model: str
    fit: tuple[str, ...]
    seconds: float
    budget: int

    def problem(self, threads: int) -> ReplayProblem:
        from sysid_btr.identify.study import make_study
        from sysid_btr.io.parquet import read_log
        from sysid_btr.models.builtin import load_robot

        robot: Robot = load_robot(self.model)
        log: Log = read_log(self.log)
        log = log.window(0, int(np.searchsorted(log.time, log.time[0] + self.seconds)) + 1)
        logs = [log]
        study = make_study(robot, logs, holdout=logs, threads=threads)
        return study.train_problem(study.declare(list(self.fit)))


def sources() -> Mapping[str, Source]:
    """Problems by name; the logs of some are only where the shared recordings are."""
    shared, samples = data_folder(), ROOT / "sample_logs"
    return {
        "gantry_c": Source(
            shared / "nao_gantry" / "gantry_c.parquet", str(shared / "nao_gantry" / "nominal.xml"), FIT, 4.0, 600
        ),
        "emps": Source(
            shared / "emps" / "emps.parquet",
            "emps",
            ("mass:*", "damping:*", "frictionloss:*", "constant_force:*"),
            4.0,
            600,
        ),
        "sample": Source(
            samples / "leg_clean.parquet",
            str(samples / "leg.xml"),
            ("mass:HipPitch,KneePitch,AnkleRoll", "kp:*=shared", "kv:*=shared"),
            4.0,
            600,
        ),
    }


@dataclass(frozen=True)
class Run:
    """One estimator from one start.

    Attributes
    ----------
    curve : (simulations, seconds, best loss) at each improvement, thinned.
    simulations, seconds : used, until it ended or was ended.
    ended : why.
    """

    estimator: str
    seed: int
    simulations: int
    seconds: float
    loss: float
    ended: str
    curve: tuple[tuple[int, float, float], ...]

    def at(self, simulations: float) -> float:
        """Best loss after so many simulations."""
        return min((loss for done, _, loss in self.curve if done <= simulations), default=float("inf"))

    def reached(self, loss: float) -> tuple[float, float]:
        """Simulations and seconds until a loss was reached; infinite where it was not."""
        return next(((float(n), t) for n, t, best in self.curve if best <= loss), (float("inf"), float("inf")))

    @classmethod
    def read(cls, entry: Mapping[str, Any]) -> Run:
        return cls(**{**entry, "curve": tuple(tuple(p) for p in entry["curve"])})

    def written(self) -> dict[str, Any]:
        return {**self.__dict__, "curve": [list(p) for p in self.curve]}


def run(problem: ReplayProblem, estimator: str, seed: int, budget: int) -> Run:
    """Minimise from the start that belongs to a seed."""
    from sysid_btr.estimators.base import Budget
    from sysid_btr.estimators.journal import Journal
    from sysid_btr.estimators.registry import get_estimator

    begin = start(problem, seed)
    points: list[tuple[int, float, float]] = []
    began = perf_counter()

    def progress(*, done: int, total: int | None, best: float, note: str) -> None:
        if np.isfinite(best) and (not points or best < points[-1][2]):
            points.append((int(done), perf_counter() - began, float(best)))

    found = get_estimator(estimator).fit(
        replace(problem, start=begin),
        rng=np.random.default_rng([seed, 1]),
        budget=Budget(evaluations=budget),
        journal=Journal(),
        progress=progress,
    )
    seconds = perf_counter() - began
    return Run(
        estimator,
        seed,
        int(found.evaluations),
        _round(seconds),
        _round(points[-1][2], 7) if points else float("inf"),
        found.termination.name.lower(),
        thinned(points, budget),
    )


def start(problem: ReplayProblem, seed: int) -> np.ndarray[Any, np.dtype[np.float64]]:
    """(p,) where a seed begins, alike for all estimators."""
    rng = np.random.default_rng([seed, 0])
    span = problem.upper - problem.lower
    return np.clip(problem.start + AWAY * span * rng.uniform(-1.0, 1.0, len(span)), problem.lower, problem.upper)


def thinned(points: Sequence[tuple[int, float, float]], budget: int) -> tuple[tuple[int, float, float], ...]:
    """The last improvement before each of some numbers of simulations, and near the end each that counts."""
    if not points:
        return ()
    wanted = np.unique(np.concatenate([np.geomspace(10, budget, CURVE), [f * budget for f in BUDGETS]]))
    kept = {max((i for i, p in enumerate(points) if p[0] <= n), default=0) for n in wanted}
    last, end = float("inf"), points[-1][2]
    for i, (_, _, loss) in enumerate(points):
        if loss <= (1 + 1.5 * NEAR) * end and loss < (1 - FINE) * last:
            kept.add(i)
            last = loss
    return tuple((points[i][0], _round(points[i][1]), _round(points[i][2], 7)) for i in sorted(kept))


def table(runs: Sequence[Run], budget: int) -> dict[str, Any]:
    """Medians and quartiles over the seeds of each estimator."""
    best = min(r.loss for r in runs)
    result: dict[str, Any] = {"best_loss": best, "estimators": {}}
    for name in dict.fromkeys(r.estimator for r in runs):
        own = [r for r in runs if r.estimator == name]
        reached = [r.reached((1 + NEAR) * best) for r in own]
        result["estimators"][name] = {
            "seeds": len(own),
            "loss": {f"{f:.0%}": _quartiles([r.at(f * budget) for r in own]) for f in BUDGETS},
            "found": int(sum(np.isfinite(n) for n, _ in reached)),
            "simulations_to_1_percent": _quartiles([n for n, _ in reached]),
            "seconds_to_1_percent": _quartiles([t for _, t in reached]),
            "seconds": _quartiles([r.seconds for r in own]),
        }
    return result


def _quartiles(values: Sequence[float]) -> list[float | None]:
    """Lower quartile, median and upper quartile; None where that one did not get there."""
    found = np.quantile(np.array(values), [0.25, 0.5, 0.75], method="higher")
    return [_round(float(v)) if np.isfinite(v) else None for v in found]


def _round(value: float, digits: int = 5) -> float:
    return float(f"{value:.{digits}g}")


def show(name: str, entry: Mapping[str, Any]) -> str:
    """The table as text."""
    found = entry["table"]
    lines = [
        f"{name}: {entry['parameters']} parameters, {entry['seconds']:g} s of the log, {entry['numerics']}, "
        f"budget {entry['budget']}, best loss {found['best_loss']:.6g}",
        f"{'estimator':<18}{'seeds':>6}"
        + "".join(f"{f'{f:.0%}':>12}" for f in BUDGETS)
        + f"{'to within 1 %':>24} (found)",
    ]
    for estimator, row in found["estimators"].items():
        losses = "".join(f"{_number(row['loss'][f'{f:.0%}'][1]):>12}" for f in BUDGETS)
        n, t = row["simulations_to_1_percent"][1], row["seconds_to_1_percent"][1]
        to = "not by half of them" if n is None else f"{n:.0f} sims, {t:.3g} s"
        lines.append(f"{estimator:<18}{row['seeds']:>6}{losses}{to:>24} ({row['found']})")
    return "\n".join(lines)


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.6g}"


def figure(results: Mapping[str, Any], path: Path) -> None:
    """Median excess of the loss over the best, against simulations; a band between the quartiles."""
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot as plt

    names = list(results)
    figure, axes = plt.subplots(1, len(names), figsize=(4.6 * len(names), 3.8), squeeze=False)
    for axis, name in zip(axes[0], names, strict=True):
        entry = results[name]
        runs = [Run.read(r) for r in entry["runs"]]
        best = entry["table"]["best_loss"]
        at = np.geomspace(10, entry["budget"], 60)
        for k, estimator in enumerate(ESTIMATORS):
            own = [r for r in runs if r.estimator == estimator]
            if not own:
                continue
            excess = np.array([[r.at(n) / best - 1 for n in at] for r in own])
            low, middle, high = np.quantile(np.maximum(excess, 1e-6), [0.25, 0.5, 0.75], axis=0, method="higher")
            axis.plot(at, middle, color=f"C{k}", label=estimator.removeprefix("nlopt:"))
            axis.fill_between(at, low, high, color=f"C{k}", alpha=0.15, linewidth=0)
        axis.axhline(NEAR, color="0.6", linestyle=":", linewidth=1)
        axis.set(xscale="log", yscale="log", title=name, xlabel="simulations", ylim=(1e-6, None))
    axes[0][0].set_ylabel("loss above the best found, as a share of it")
    axes[0][-1].legend(fontsize=7, frameon=False)
    figure.tight_layout()
    figure.savefig(path, dpi=90)
    plt.close(figure)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; the exit code."""
    options = _parser().parse_args(argv)
    path: Path = options.out
    results: dict[str, Any] = json.loads(path.read_text()) if path.exists() else {}
    source = sources()[options.problem]
    if not options.table:
        if not source.log.exists():
            print(f"no log {source.log}; set SYSID_BTR_DATA to the folder that holds it. Nothing to do.")
            return 0
        results = work(results, source, options, lambda found: write(path, found))
        write(path, results)
    for name, entry in results.items():
        print(show(name, entry))
    if results:
        figure(results, path.with_suffix(".png"))
    return 0


def work(
    results: dict[str, Any], source: Source, options: argparse.Namespace, keep: Callable[[dict[str, Any]], None]
) -> dict[str, Any]:
    """Do what the results lack; `keep` is called after each run."""
    budget = options.budget or source.budget
    problem = source.problem(options.threads)
    numerics = str(problem.episodes[0].replay.numerics)
    setting = {
        "parameters": len(problem.parameters),
        "residuals": problem.count,
        "seconds": source.seconds,
        "numerics": numerics,
        "budget": budget,
    }
    entry = results.get(options.problem)
    if entry is None or any(entry[key] != value for key, value in setting.items()):
        entry = {**setting, "machine": machine(), "runs": [], "table": {}}
    runs = [Run.read(r) for r in entry["runs"]]
    done = {(r.estimator, r.seed) for r in runs}
    for seed in range(options.first_seed, options.first_seed + options.seeds):
        for estimator in options.estimator or ESTIMATORS:
            if (estimator, seed) in done:
                continue
            runs.append(run(problem, estimator, seed, budget))
            last = runs[-1]
            sys.stderr.write(
                f"{options.problem} {estimator} seed {seed}: {last.loss:.6g} after {last.simulations} simulations, "
                f"{last.seconds:.1f} s, {last.ended}\n"
            )
            entry = {**entry, "runs": [r.written() for r in runs], "table": table(runs, budget)}
            results = {**results, options.problem: entry}
            keep(results)
    return results


def write(path: Path, results: Mapping[str, Any]) -> None:
    """Replace the results; a line a run, and never half of them."""
    path.parent.mkdir(parents=True, exist_ok=True)
    parts = []
    for name, entry in results.items():
        head = {key: value for key, value in entry.items() if key != "runs"}
        lines = ",\n".join("   " + json.dumps(r, separators=(",", ":")) for r in entry["runs"])
        body = json.dumps(head, indent=1)[1:-2].replace("\n", "\n ")
        parts.append(f' {json.dumps(name)}: {{{body},\n  "runs": [\n{lines}\n  ]\n }}')
    with tempfile.NamedTemporaryFile("w", dir=path.parent, suffix=".part", delete=False) as file:
        file.write("{\n" + ",\n".join(parts) + "\n}\n")
    Path(file.name).chmod(0o644)
    Path(file.name).replace(path)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.estimators", description=__doc__)
    parser.add_argument("--problem", choices=tuple(sources()), default="sample")
    parser.add_argument("--estimator", action="append", help=f"repeatable; default {', '.join(ESTIMATORS)}")
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--seeds", type=int, default=10, help="how many")
    parser.add_argument("--budget", type=int, help="simulations a run; default the problem's")
    parser.add_argument("--threads", type=int, default=1, help="worker threads, 0 for all cores")
    parser.add_argument("--out", type=Path, default=RESULTS / "estimators.json", help="results to continue")
    parser.add_argument("--table", action="store_true", help="only show the table, and draw the figure")
    return parser


if __name__ == "__main__":
    sys.exit(main())
