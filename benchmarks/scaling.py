"""`python -m benchmarks.scaling`: how the cost of replays and fits grows with the log, the robot and the question.

Costs are CPU time of one thread over that of a reference replay timed just before, because other work on the machine
changes the speed of a core. An exponent is the slope of log cost over log size: 1 is in proportion.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from time import process_time
from typing import Any

import numpy as np

from benchmarks.replay import ROOT, SEED, machine, save
from sysid_btr.estimators import get_estimator
from sysid_btr.estimators.base import Budget, silent
from sysid_btr.estimators.journal import Journal
from sysid_btr.identify.fit import fit
from sysid_btr.identify.replay import replay_log
from sysid_btr.identify.study import Study, make_study
from sysid_btr.io.log import Log, LogMeta
from sysid_btr.models.builtin import load_robot
from sysid_btr.models.robot import Robot, joint_names, robot_from_spec, servo_joints
from sysid_btr.objectives.problem import ReplayProblem
from sysid_btr.simulation.numerics import Numerics
from sysid_btr.terms.library import select_effects

NUMERICS = Numerics("implicitfast", 0.005)
FINE = Numerics("RK4", 0.005)
"""Of fits: fine enough that none of them ends with a check that asks for a smaller step."""
PERIOD = 0.01
SECONDS, CANDIDATES = 10.0, 32
LIMB = 4
"""Joints of each limb of the robots that grow."""
TRUE_GAIN = 0.9

Job = Callable[[], float | None]
"""What is timed; may return the number of its replays."""


@dataclass(frozen=True)
class Axis:
    """What grows.

    Attributes
    ----------
    name, unit : of the size.
    sizes : rising.
    prepare : of a size, what is timed.
    expected : exponent that theory gives for large sizes.
    """

    name: str
    unit: str
    sizes: tuple[float, ...]
    prepare: Callable[[float], Job]
    expected: str


@cache
def nao() -> Robot:
    return load_robot(str(ROOT / "sample_logs" / "nao.xml"))


@cache
def comb(joints: int, limb: int = LIMB) -> Robot:
    """A held body with limbs of so many joints each, until there are as many as asked for."""
    import mujoco

    def link(k: int) -> str:
        axis = ("0 1 0", "1 0 0")[k % 2]
        inner = link(k + 1) if (k + 1) % limb and k + 1 < joints else ""
        return (
            f'<body name="b{k}" pos="0 {0.05 * (k // limb) if k % limb == 0 else 0} -.1">'
            f'<joint name="j{k}" axis="{axis}" damping=".05" armature=".008"/>'
            f'<geom type="box" size=".02 .02 .04" pos="0 0 -.05" mass=".1" contype="0" conaffinity="0"/>{inner}</body>'
        )

    limbs = "".join(link(k) for k in range(0, joints, limb))
    servos = "".join(f'<position name="j{k}" joint="j{k}" kp="12" kv=".4"/>' for k in range(joints))
    sensors = "".join(f'<jointpos name="position_j{k}" joint="j{k}"/>' for k in range(joints))
    xml = (
        f'<mujoco model="comb"><worldbody>{limbs}</worldbody><actuator>{servos}</actuator>'
        f"<sensor>{sensors}</sensor></mujoco>"
    )
    return robot_from_spec(f"comb{joints}", lambda: mujoco.MjSpec.from_string(xml))


def log_of(robot: Robot, seconds: float, number: int = 0) -> Log:
    """Noisy positions of the robot with weaker servos, under smooth commands."""
    rng = np.random.default_rng([SEED, number])
    time = np.arange(round(seconds / PERIOD) + 1) * PERIOD
    fade = 1 - np.exp(-((time / 0.3) ** 2))
    commands = {
        f"command.{j}": 0.3 * fade * np.sin(2 * np.pi * rng.uniform(0.3, 1.2) * time + rng.uniform(0, 6))
        for j in joint_names(robot)
    }
    meta = LogMeta(robot=robot.name, sample_period=PERIOD)
    plain = Log(time=time, channels=commands, meta=meta, episode=np.zeros(len(time), dtype=np.int64))
    run = replay_log(robot, plain, {f"kp:{j}": TRUE_GAIN for j in servo_joints(robot)}, numerics=NUMERICS, threads=1)
    noisy = {n: c + rng.normal(scale=1e-3, size=len(c)) for n, c in run.channels.items() if n.startswith("position")}
    return Log(time=time, channels={**commands, **noisy}, meta=meta, episode=plain.episode)


def study_of(robot: Robot, seconds: float = SECONDS, logs: int = 1, numerics: Numerics = NUMERICS) -> Study:
    own = [log_of(robot, seconds, i) for i in range(logs)]
    return make_study(robot, own, numerics=numerics, threads=1)


def replay_job(problem: ReplayProblem, candidates: int) -> Job:
    rng = np.random.default_rng(SEED)
    rows = problem.start * rng.uniform(0.8, 1.2, (candidates, len(problem.start)))
    problem.loss(rows[:1])

    def job() -> None:
        assert np.isfinite(problem.loss(rows)).all()

    return job


def gains(robot: Robot, seconds: float = SECONDS, candidates: int = CANDIDATES, logs: int = 1) -> Job:
    """Replays under other gains: all in MuJoCo's own loop."""
    study = study_of(robot, seconds, logs)
    return replay_job(study.train_problem(study.declare(["kp:*=shared", "kv:*=shared"])), candidates)


def law(candidates: int) -> Job:
    """Replays with a friction that MuJoCo does not know: a step in Python for all candidates at once."""
    study = study_of(nao(), 2.0)
    (effect,) = [e for e in select_effects(["stribeck_friction"]) if e.overrides("law")][:1]
    terms = (*study.declare(["kp:*=shared"]), effect.at(joint_names(nao())[:4], study.scales))
    problem = study.train_problem(terms)
    middle = problem.start + 0.1 * np.minimum(problem.upper - problem.start, 5 * problem.scale)
    rows = np.tile(middle, (candidates, 1))
    problem.loss(rows[:1])

    def job() -> None:
        assert np.isfinite(problem.loss(rows)).all()

    return job


def fit_job(robot: Robot, expressions: Sequence[str], seconds: float = SECONDS, logs: int = 1) -> Job:
    """A whole fit: search, derivatives, intervals, check of the numerics."""
    study = study_of(robot, seconds, logs, FINE)
    study.scales  # noqa: B018 - measured once, before the clock starts

    def job() -> float:
        found = fit(
            study,
            study.declare(expressions),
            estimator=get_estimator("lsq"),
            rng=np.random.default_rng(SEED),
            budget=Budget(),
            journal=Journal(),
            progress=silent,
        )
        return float(found.replays)

    return job


def single_gains(count: int) -> list[str]:
    """One stiffness for each of some joints, spread over the limbs."""
    names = servo_joints(nao())
    return [f"kp:{names[i]}" for i in np.linspace(0, len(names) - 1, count).round().astype(int)]


AXES = (
    Axis("replay, length of the log", "s", (5, 10, 20, 40, 60), lambda x: gains(nao(), x), "1"),
    Axis("replay, joints", "joints", (4, 8, 16, 32, 64), lambda x: gains(comb(int(x))), "1"),
    Axis("replay, candidates", "candidates", (1, 4, 16, 64, 256), lambda x: gains(nao(), 5.0, int(x)), "1"),
    Axis("replay with a law, candidates", "candidates", (1, 4, 16, 64, 256), lambda x: law(int(x)), "1"),
    Axis("replay, logs", "logs", (1, 2, 4, 8, 16), lambda x: gains(nao(), 5.0, 8, int(x)), "1"),
    Axis("fit, length of the log", "s", (5, 10, 20, 40), lambda x: fit_job(nao(), single_gains(4), x), "1"),
    Axis("fit, joints", "joints", (4, 8, 16, 32), lambda x: fit_job(comb(int(x)), ["kp:*"]), "1 to 2"),
    Axis(
        "fit, parameters", "parameters", (1, 2, 4, 8, 16, 22), lambda x: fit_job(nao(), single_gains(int(x))), "0 to 1"
    ),
    Axis("fit, logs", "logs", (1, 2, 4, 8), lambda x: fit_job(nao(), single_gains(4), 5.0, int(x)), "1"),
)


def cpu(job: Job, repeats: int) -> tuple[float, float | None]:
    """Least CPU seconds of some runs, and replays."""
    times, count = [], None
    for _ in range(repeats):
        began = process_time()
        count = job()
        times.append(process_time() - began)
    return min(times), count


def measure(axis: Axis, reference: Job, repeats: int) -> dict[str, Any]:
    """Cost at every size, and its exponents."""
    points = []
    for size in axis.sizes:
        job = axis.prepare(size)
        before, _ = cpu(reference, repeats)
        cost, replays = cpu(job, repeats)
        point = {"size": size, "cpu_s": _round(cost), "over_reference": _round(cost / before)}
        points.append(point if replays is None else point | {"replays": int(replays)})
        print(f"{axis.name}: {point}", file=sys.stderr, flush=True)
    x = np.log([p["size"] for p in points])
    y = np.log([p["over_reference"] for p in points])
    slopes = np.diff(y) / np.diff(x)
    return {
        "unit": axis.unit,
        "points": points,
        "exponent": _round(float(np.polyfit(x, y, 1)[0])),
        "exponent_of_the_last_two": _round(float(slopes[-1])),
        "largest_between_two": _round(float(slopes.max())),
        "expected": axis.expected,
    }


def _round(value: float) -> float:
    return float(f"{value:.3g}")


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; the exit code."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.scaling", description=__doc__)
    parser.add_argument("--repeats", type=int, default=2, help="runs of which the cheapest counts")
    parser.add_argument("--only", metavar="TEXT", help="axes with this in their name; the result is only shown")
    options = parser.parse_args(argv)
    chosen = [a for a in AXES if options.only is None or options.only in a.name]
    reference = gains(nao())
    result = {
        "machine": machine(),
        "seed": SEED,
        "numerics": {"replay": str(NUMERICS), "fit": str(FINE)},
        "reference": f"{CANDIDATES} candidates, {SECONDS:g} s, {nao().name}, {len(joint_names(nao()))} joints",
        "reference_cpu_s": _round(cpu(reference, options.repeats)[0]),
        "axes": {axis.name: measure(axis, reference, options.repeats) for axis in chosen},
    }
    if options.only is None:
        save("scaling", result)
    else:
        print(result)
    return 0


if __name__ == "__main__":
    sys.exit(main())
