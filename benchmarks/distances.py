"""`python -m benchmarks.distances --robots 30 --out out/distances`: which distance identifies a robot?

The Back-to-Reality paper compares simulations with the robot by phi1 and phi2 and leaves open which is better. Here
phi1, phi2, mean squared error, likelihood and Wasserstein distance are minimised by the same estimator (CMA-ES) with
the same budget of simulations, from the same start with the same random numbers, on the same logs of hidden robots.

Robots: the six-joint leg of `sample_logs`. Free are, as in the paper, starred masses: three, 0.7 to 1.3 of the nominal
in each hidden leg. It plays four motions of 1.2 seconds; two more are held out. It is simulated
by RK4 with a step of 1 ms, the candidates with `NUMERICS`. Encoders have 12 bits and noise.

Conditions: `clean`; `offset`, every encoder shifted by a constant; `lag`, everything recorded late; `masses`, the
other three bodies 0.7 to 1.3 of their stated masses. Errors that the models cannot express, as on a real robot.

Measured: the mean relative error of the masses; the error of the held-out motions, against what the hidden leg really
did; and how a controller transfers: the held-out references are commanded as much earlier and higher, joint by joint,
as the identified model is late and low; on the hidden leg the joints are then off the references by so much. A robot
that is finished is read from `--out`; the table is of all that are finished.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from time import process_time
from typing import Any

import numpy as np

from sysid_btr.estimators import Budget, CmaEs, Journal, silent
from sysid_btr.identify.replay import set_parameters
from sysid_btr.io.log import Log, LogMeta
from sysid_btr.models.builtin import load_robot
from sysid_btr.models.robot import Robot
from sysid_btr.objectives.distance import Distance, DistanceProblem, MeanSquare, Phi1, Phi2, Wasserstein
from sysid_btr.objectives.problem import Comparison, ReplayProblem
from sysid_btr.objectives.targets import make_targets
from sysid_btr.result import to_json
from sysid_btr.simulation.numerics import Numerics
from sysid_btr.simulation.replay import Replay
from sysid_btr.terms.base import Term
from sysid_btr.terms.grammar import parse_parameters
from sysid_btr.terms.model import Model

HERE = Path(__file__).parent
RESULTS = HERE / "results" / "distances.json"
MODEL = HERE.parent / "sample_logs" / "leg.xml"
STARRED, OTHERS = ("HipPitch", "KneePitch", "AnkleRoll"), ("HipYawPitch", "HipRoll", "AnklePitch")
FREE = (f"mass:{','.join(STARRED)}",)
SPREAD = (0.7, 1.3)
NUMERICS, HIDDEN = Numerics("RK4", 0.01), Numerics("RK4", 0.001)
PERIOD, SECONDS, TRAIN, HELD = 0.02, 1.2, 4, 2
REACH = 0.5
"""rad, of a motion at most, about the middle of the joint's range."""
TICK, NOISE = 2 * np.pi / 4096, 4e-4
OFFSET, LAG = 0.02, 0.03
"""rad, standard deviation of encoders' offsets; s by which everything is recorded late."""
CONDITIONS = ("clean", "offset", "lag", "masses")
POPULATION, BUDGET = 8, 160
"""Of the search: candidates a generation, and in all."""
DISTANCES: Mapping[str, Distance | None] = {
    "phi1": Phi1(),
    "phi2": Phi2(),
    "mse": MeanSquare(),
    "likelihood": None,
    "wasserstein": Wasserstein(),
}
GROWN = 0.3
"""s in which a motion, and what is added to it, grows from rest."""
LEADS = 0.002 * np.arange(75)
"""s by which a controller may be early."""
DRAWS, LEVEL = 2000, 0.95
"""Of the bootstrap over robots."""


@dataclass(frozen=True)
class Hidden:
    """One hidden leg under one condition."""

    number: int
    condition: str

    @cached_property
    def robot(self) -> Robot:
        return load_robot(str(MODEL))

    def draw(self, what: int) -> np.random.Generator:
        """Random numbers of one purpose: the same robot under every condition."""
        return np.random.default_rng([20091, self.number, what])

    @cached_property
    def truth(self) -> np.ndarray:
        """(3,) of the free parameters."""
        return self.draw(0).uniform(*SPREAD, len(STARRED))

    @cached_property
    def free(self) -> tuple[Term, ...]:
        return parse_parameters(list(FREE), self.robot)

    @cached_property
    def motions(self) -> list[Log]:
        """What was really done, and with which commands: `TRAIN` and `HELD` episodes."""
        rng = self.draw(2)
        return [self.play(commands(self.robot, rng)) for _ in range(TRAIN + HELD)]

    def play(self, asked: Log) -> Log:
        """What the leg does when commands are played on it."""
        model = Model.of(self.free, self.truth)
        if self.condition == "masses":
            factors = self.draw(1).uniform(*SPREAD, len(OTHERS))
            others = {f"mass:{b}": float(f) for b, f in zip(OTHERS, factors, strict=True)}
            model = Model.joined([*model.parts, *set_parameters(self.robot, others).parts])
        return moved(Replay(self.robot, asked, model.terms, HIDDEN, threads=1), model.values)

    @cached_property
    def logs(self) -> list[Log]:
        """What the encoders show of the first `TRAIN` of them."""
        rng, offsets = self.draw(3), self.draw(4).normal(0.0, OFFSET, 6)
        result = []
        for log in self.motions[:TRAIN]:
            seen = dict(log.channels)
            for i, name in enumerate(n for n in log.channels if n.startswith("position.")):
                x = log.channels[name]
                if self.condition == "lag":
                    x = np.interp(log.time - LAG, log.time, x)
                if self.condition == "offset":
                    x = x + offsets[i]
                seen[name] = np.round((x + NOISE * rng.normal(size=len(x))) / TICK) * TICK
            result.append(replace(log, channels=seen))
        return result

    def problem(self, logs: Sequence[Log]) -> ReplayProblem:
        """Candidates against logs."""
        episodes = []
        for log in logs:
            run = Replay(self.robot, log, self.free, NUMERICS, threads=1)
            episodes.append(Comparison(run, make_targets(log, run.index.joints, ("position",))))
        return ReplayProblem(tuple(episodes), np.ones(len(STARRED)))


def moved(run: Replay, values: np.ndarray) -> Log:
    """The log of a replay with the positions that it predicts."""
    position = run.predict(values[None]).position[0]
    own = {f"position.{j}": position[:, i] for i, j in enumerate(run.index.joints)}
    return replace(run.log, channels={**run.log.channels, **own})


def transfer(hidden: Hidden, values: np.ndarray) -> float:
    """rad, rms, by which the hidden leg is off held-out references under commands made for an identified model."""
    errors = []
    for wanted in hidden.motions[TRAIN:]:
        names = [n.removeprefix("command.") for n in wanted.channels if n.startswith("command.")]
        reference = wanted.array("command", names)
        done = moved(Replay(hidden.robot, wanted, hidden.free, NUMERICS, threads=1), values).array("position", names)
        time, own = wanted.time, {}
        for i, n in enumerate(names):
            late = np.array([np.interp(time + lead, time, done[:, i]) for lead in LEADS])
            error = reference[:, i] - late
            best = int(np.argmin(np.var(error, axis=1)))
            sag = np.mean(error[best]) * np.clip(time / GROWN, 0.0, 1.0) ** 2
            own[f"command.{n}"] = np.interp(time + LEADS[best], time, reference[:, i]) + sag
        played = replace(wanted, channels={**wanted.channels, **own})
        errors.append(hidden.play(played).array("position", names) - reference)
    return float(np.sqrt(np.mean(np.concatenate(errors) ** 2)))


def commands(robot: Robot, rng: np.random.Generator) -> Log:
    """One motion: three sines a joint, growing from rest."""
    time = PERIOD * np.arange(round(SECONDS / PERIOD) + 1)
    grown = np.clip(time / GROWN, 0.0, 1.0) ** 2
    model, channels = robot.compile(), {}
    for j in range(model.njnt):
        low, high = model.jnt_range[j]
        middle, reach = 0.5 * (low + high), min(0.4 * (high - low), REACH)
        share = rng.dirichlet(np.ones(3))
        speed, phase = rng.uniform(0.4, 3.0, 3), rng.uniform(0.0, 2 * np.pi, 3)
        wave = share @ (np.sin(2 * np.pi * speed[:, None] * time + phase[:, None]))
        name = model.joint(j).name
        channels[f"command.{name}"] = middle + reach * grown * wave
        channels[f"position.{name}"] = np.full(len(time), channels[f"command.{name}"][0])
    meta = LogMeta(robot="leg", mount="fixed", sample_period=PERIOD, source="simulated")
    return Log(time, channels, meta, np.zeros(len(time), dtype=np.int64))


def identify(hidden: Hidden, name: str) -> dict[str, Any]:
    """One search."""
    began = process_time()
    whole = hidden.problem(hidden.logs)
    distance = DISTANCES[name]
    found = CmaEs(sigma=0.25, population=POPULATION).fit(
        whole if distance is None else DistanceProblem(whole, distance),
        rng=hidden.draw(5),
        budget=Budget(evaluations=BUDGET),
        journal=Journal(),
        progress=silent,
    )
    held = hidden.problem(hidden.motions[TRAIN:])
    errors = [
        e.replay.predict(found.x[None]).position[0] - e.replay.log.array("position", e.replay.index.joints)
        for e in held.episodes
    ]
    return {
        "values": found.x,
        "parameter": float(np.mean(np.abs(found.x / hidden.truth - 1))),
        "held_out": float(np.sqrt(np.mean(np.concatenate(errors) ** 2))),
        "transfer": transfer(hidden, found.x),
        "evaluations": found.evaluations,
        "cpu_s": process_time() - began,
    }


def run_robot(number: int, out: Path) -> dict[str, Any]:
    """All searches of one hidden robot."""
    done = out / f"robot_{number:03d}.json"
    if done.exists():
        content: dict[str, Any] = json.loads(done.read_text())
        return content
    began = process_time()
    rows = [
        {"condition": c, "distance": name, **identify(hidden, name)}
        for c in CONDITIONS
        for hidden in [Hidden(number, c)]
        for name in DISTANCES
    ]
    content = {
        "robot": number,
        "truth": Hidden(number, "clean").truth,
        "rows": rows,
        "nominal": {c: transfer(Hidden(number, c), np.ones(len(STARRED))) for c in CONDITIONS},
        "cpu_s": process_time() - began,
    }
    out.mkdir(parents=True, exist_ok=True)
    done.write_text(to_json(content))
    return content


MEASURES = ("parameter", "held_out", "transfer")


def table(found: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Medians over robots with bootstrap intervals, and how often each distance is the best one."""
    rng = np.random.default_rng(0)
    cells: dict[str, Any] = {}
    for condition in CONDITIONS:
        rows = {n: [_row(f, condition, n) for f in found] for n in DISTANCES}
        cells[condition] = {
            n: {m: interval(np.array([r[m] for r in own]), rng) for m in MEASURES} for n, own in rows.items()
        }
        for m in MEASURES:
            errors = np.array([[r[m] for r in rows[n]] for n in DISTANCES])
            for n, share in zip(DISTANCES, np.bincount(np.argmin(errors, axis=0), minlength=5), strict=True):
                cells[condition][n][m]["best"] = int(share)
            # pairs of the same robot: how much larger than the likelihood's, whatever the robot
            ratio = np.log(np.maximum(errors, 1e-12) / np.maximum(errors[list(DISTANCES).index("likelihood")], 1e-12))
            for n, r in zip(DISTANCES, ratio, strict=True):
                cells[condition][n][m]["over_likelihood"] = {k: float(np.exp(v)) for k, v in interval(r, rng).items()}
    return {
        "command": f"python -m benchmarks.distances --robots {len(found)}",
        "robots": len(found),
        "budget": BUDGET,
        "numerics": {"candidates": str(NUMERICS), "hidden": str(HIDDEN)},
        "cpu_s": sum(f["cpu_s"] for f in found),
        "units": {"parameter": "relative", "held_out": "rad", "transfer": "rad"},
        "transfer_of_the_nominal_model": {
            c: interval(np.array([f["nominal"][c] for f in found]), rng) for c in CONDITIONS
        },
        "table": cells,
    }


def _row(found: dict[str, Any], condition: str, distance: str) -> dict[str, Any]:
    rows: list[dict[str, Any]] = found["rows"]
    return next(r for r in rows if (r["condition"], r["distance"]) == (condition, distance))


def interval(values: np.ndarray, rng: np.random.Generator) -> dict[str, Any]:
    """Median and percentile bootstrap interval over robots."""
    draws = np.median(values[rng.integers(0, len(values), (DRAWS, len(values)))], axis=1)
    low, high = np.quantile(draws, [(1 - LEVEL) / 2, (1 + LEVEL) / 2])
    return {"median": float(np.median(values)), "low": float(low), "high": float(high)}


def show(content: dict[str, Any]) -> str:
    """The table as text."""
    lines = [f"{content['robots']} robots, {content['budget']} simulations a search, {content['cpu_s']:.0f} s CPU"]
    formats: Mapping[str, Callable[[float], str]] = {
        "parameter": lambda x: f"{100 * x:5.1f}",
        "held_out": lambda x: f"{1e3 * x:5.2f}",
        "transfer": lambda x: f"{1e3 * x:5.2f}",
    }
    lines.append(f"{'':20}" + "".join(f"{m + (' %' if m == 'parameter' else ' mrad'):>26}" for m in MEASURES))
    for condition, own in content["table"].items():
        for name, cell in own.items():
            text = "".join(
                f"{formats[m](c['median'])} [{formats[m](c['low'])},{formats[m](c['high'])}] {c['best']:3d}x".rjust(26)
                for m, c in cell.items()
            )
            lines.append(f"{condition:<8} {name:<11}{text}")
    for condition, cell in content["transfer_of_the_nominal_model"].items():
        lines.append(f"{condition:<8} transfer of the nominal model {1e3 * cell['median']:.2f} mrad")
    return "\n".join(lines)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; 0 when the table is complete."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.distances", description=__doc__)
    parser.add_argument("--robots", type=int, default=30, help="hidden robots, from the first")
    parser.add_argument("--out", type=Path, default=Path("out/distances"), help="folder of finished robots")
    parser.add_argument("--record", action="store_true", help=f"write {RESULTS.name} beside the other results")
    options = parser.parse_args(argv)
    found = []
    for number in range(options.robots):
        found.append(run_robot(number, options.out))
        print(f"robot {number}: {found[-1]['cpu_s']:.1f} s CPU", flush=True)
    content = table(found)
    if options.record:
        RESULTS.write_text(to_json(content))
    print(show(content))
    return 0


if __name__ == "__main__":
    sys.exit(main())
