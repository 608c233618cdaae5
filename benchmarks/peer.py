"""`python -m benchmarks.peer`: fits against `mujoco.sysid`, same log, parameters, start, step, weights and loss.

Needs `pip install "mujoco[sysid]"`. Both sides get RK4 at the replay's step, the same initial state, the mean of the
held command over each step (given to the peer at its steps, where its interpolation returns it unchanged), and all
cores. The peer minimises our whitened residual through its `modify_residual` hook, and its parameters are written into
the spec by the cheapest possible terms, so its time holds nothing but its own way of working.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from io import StringIO
from time import perf_counter, process_time
from typing import Any

import numpy as np

from benchmarks.replay import MASSES, SEED, Case, _round, load_case, machine, save
from benchmarks.scaling import FINE, comb, log_of
from sysid_btr._typing import FloatArray
from sysid_btr.estimators.base import Budget, silent
from sysid_btr.estimators.journal import Journal
from sysid_btr.estimators.lsq import LeastSquares
from sysid_btr.identify.fit import fit
from sysid_btr.identify.study import Study
from sysid_btr.objectives.problem import ReplayProblem
from sysid_btr.simulation.numerics import Numerics

PARAMETERS = {"arm": ("mass:*", "kp:*=shared", "kv:*=shared"), "masses": MASSES, "kp": ("kp:*",)}
JOINTS = 6
"""Of the arm."""
TOLD = 1e-4
"""Step tolerance of the peer, as chosen by someone who has seen where its loss stops falling."""
SLACK = 0.1
"""Sum of squared whitened residuals above the smallest found: 0.3 standard deviations of one parameter."""


@dataclass
class Trace:
    """Losses of one fit as they came."""

    began: float = field(default_factory=perf_counter)
    cpu_began: float = field(default_factory=process_time)
    points: list[tuple[float, float]] = field(default_factory=list)
    simulations: int = 0

    def add(self, loss: float) -> None:
        self.points.append((perf_counter() - self.began, loss))

    def reached(self, loss: float) -> float:
        return next((t for t, value in self.points if value <= loss), float("nan"))


@dataclass(frozen=True)
class Run:
    """One fit: what it took, and the loss that our replay gives its parameters."""

    x: FloatArray
    loss: float
    wall: float
    cpu: float
    trace: Trace


def run_estimator(problem: ReplayProblem, *, confirm: bool) -> Run:
    """Our least squares; with `confirm` also the central differences that intervals need."""
    trace = Trace()

    def progress(*, done: int, total: int | None, best: float, note: str) -> None:
        trace.add(best)

    result = LeastSquares(confirm=confirm).fit(
        problem, rng=np.random.default_rng(SEED), budget=Budget(), journal=Journal(), progress=progress
    )
    wall, cpu = perf_counter() - trace.began, process_time() - trace.cpu_began
    trace.simulations = result.evaluations
    return Run(result.x, _loss(problem, result.x), wall, cpu, trace)


def run_fit(study: Study, problem: ReplayProblem, expressions: Sequence[str]) -> Run:
    """The whole of `fit`: intervals, check of the numerics, scores on fitted and held-out data as well."""
    trace = Trace()
    result = fit(study, expressions, progress=silent)
    wall, cpu = perf_counter() - trace.began, process_time() - trace.cpu_began
    trace.simulations = result.replays
    return Run(result.values, _loss(problem, result.values), wall, cpu, trace)


def peer(
    problem: ReplayProblem, judge: ReplayProblem, threads: int, *, own_residual: bool = False, **options: float
) -> Callable[[], Run]:
    """A fit by `mujoco.sysid` with `options` of its optimiser; `judge` gives the loss that is reported.

    `own_residual` leaves its default residual in place: linear resampling, its own weights.
    """
    from mujoco import sysid

    replay = problem.episodes[0].replay
    (target,) = problem.episodes[0].targets
    index, grid = replay.index, replay.grid
    spec = replay.robot.make_spec()
    spec.option.timestep = replay.model.opt.timestep
    spec.option.integrator = replay.model.opt.integrator
    plain = spec.compile()
    assert not replay.model.dof_frictionloss.any(), "friction numerics would differ"

    names = [replay.model.joint(int(plain.actuator_trnid[a, 0])).name for a in range(plain.nu)]
    columns = [index.joints.index(name) for name in names]
    # a hair short: the peer rounds the number of its steps up, and would stretch the commands by one
    times = grid.timestep * np.arange(grid.steps + 1) * (1 - 1e-12)
    control = sysid.TimeSeries.from_control_names(
        times, np.vstack([grid.command, grid.command[-1:]])[:, columns], plain
    )
    qpos, qvel = plain.qpos0.copy(), np.zeros(plain.nv)
    qpos[index.qpos], qvel[index.dof] = replay.start
    keep = grid.state[1:] - 1
    observed = [(name, sysid.SignalType.MjStateQPos) for name in target.joints]
    measured = sysid.TimeSeries.from_names(grid.sample_time, target.measured, plain, observed)
    qpos_columns = 1 + index.qpos[target.columns]
    mask = target.mask.copy()
    assert not grid.fraction.any(), "samples must fall on steps"
    assert not mask[0].any(), "the start is not scored"

    def whitened(
        params: Any, predicted: Any, measured: Any, model: Any, everything: bool, *, state: FloatArray
    ) -> tuple[FloatArray, Any, Any]:
        white = (target.measured[1:] - state[keep][:, qpos_columns]) / target.sigma
        return white[mask[1:]], measured, measured

    state = sysid.create_initial_state(plain, qpos, qvel)
    sequences = sysid.ModelSequences("robot", spec, "log", state, control, measured)
    residual = sysid.build_residual_fn(
        models_sequences=[sequences],
        n_threads=threads,
        **({} if own_residual else {"modify_residual": whitened, "resample_true": False}),
    )

    def run() -> Run:
        # nominal masses from a fresh spec: a run leaves its last candidate in the one it uses
        params = _peer_parameters(problem, replay.robot.make_spec(), plain)
        trace = Trace()
        talk = StringIO()

        def traced(x: FloatArray, given: Any, **more: Any) -> Any:
            result = residual(x, given, **more)
            trace.simulations += 1 if x.ndim == 1 else x.shape[1]
            if x.ndim == 1 or x.shape[1] == 1:
                trace.add(float(np.sum(np.square(result[0][0]))))
            return result

        _, result = sysid.optimize(params, traced, verbose=False, output=talk, **options)
        wall, cpu = perf_counter() - trace.began, process_time() - trace.cpu_began
        x = np.ravel(result.x)
        return Run(x, _loss(judge, x), wall, cpu, trace)

    return run


def _loss(problem: ReplayProblem, x: FloatArray) -> float:
    return float(problem.loss(x[None])[0])


def _peer_parameters(problem: ReplayProblem, spec: Any, plain: Any) -> Any:
    from mujoco import sysid

    params = sysid.ParameterDict()
    for term in problem.terms:
        write = {"mass": _write_mass, "kp": _write_kp, "kv": _write_kv}[term.name](spec, plain, term.places)
        (p,) = term.parameters

        def modify(spec: Any, parameter: Any, write: Callable[[Any, float], None] = write) -> None:
            write(spec, parameter.value[0])

        params.add(sysid.Parameter(p.name, p.nominal, p.lower, p.upper, modifier=modify))
    return params


def _write_mass(spec: Any, plain: Any, places: tuple[str, ...]) -> Callable[[Any, float], None]:
    (name,) = places
    nominal = {i: g.mass for i, g in enumerate(spec.body(name).geoms)}

    def write(spec: Any, factor: float) -> None:
        for i, geom in enumerate(spec.body(name).geoms):
            geom.mass = factor * nominal[i]

    return write


def _actuators(plain: Any, places: tuple[str, ...]) -> dict[str, int]:
    joints = {plain.joint(int(plain.actuator_trnid[a, 0])).name: a for a in range(plain.nu)}
    return {plain.actuator(joints[place]).name: joints[place] for place in places}


def _write_kp(spec: Any, plain: Any, places: tuple[str, ...]) -> Callable[[Any, float], None]:
    nominal = {name: float(plain.actuator_gainprm[a, 0]) for name, a in _actuators(plain, places).items()}

    def write(spec: Any, factor: float) -> None:
        for name, gain in nominal.items():
            actuator = spec.actuator(name)
            actuator.gainprm[0] = factor * gain
            actuator.biasprm[1] = -factor * gain

    return write


def _write_kv(spec: Any, plain: Any, places: tuple[str, ...]) -> Callable[[Any, float], None]:
    nominal = {name: float(plain.actuator_biasprm[a, 2]) for name, a in _actuators(plain, places).items()}

    def write(spec: Any, factor: float) -> None:
        for name, gain in nominal.items():
            spec.actuator(name).biasprm[2] = factor * gain

    return write


def compare(case: Case, expressions: Sequence[str], *, threads: int, repeats: int, whole: bool) -> dict[str, Any]:
    """Both sides in turn on one problem."""
    import mujoco

    study = case.study(threads)
    problem = study.train_problem(study.declare(expressions))
    # as its user would run it: the model's own integrator and step, its own residual
    option = case.robot.compile().opt
    own = Numerics(mujoco.mjtIntegrator(option.integrator).name.removeprefix("mjINT_").lower(), option.timestep)
    shipped = problem.with_numerics(own)
    sides: dict[str, Callable[[], Run]] = {
        "estimator": lambda: run_estimator(problem, confirm=False),
        "estimator_and_jacobian": lambda: run_estimator(problem, confirm=True),
        "peer": peer(problem, problem, threads),
        # with its step tolerance, 1e-8, relaxed by hand to where nothing changes any more
        "peer_told_when_to_stop": peer(problem, problem, threads, xtol=TOLD),
    }
    if whole:
        sides["peer_as_shipped"] = peer(shipped, problem, threads, own_residual=True)
        sides["whole_fit"] = lambda: run_fit(study, problem, expressions)
    runs: dict[str, list[Run]] = {name: [] for name in sides}
    for repeat in range(repeats):
        for name in np.roll(list(sides), repeat).tolist():
            runs[name].append(sides[name]())
    enough = min(run.loss for side in runs.values() for run in side) + SLACK

    def ratio(name: str, other: str, of: Callable[[Run], float]) -> float:
        return _round(float(np.median([of(a) / of(b) for a, b in zip(runs[name], runs[other], strict=True)])))

    ours = [name for name in runs if not name.startswith("peer")]

    return {
        "seconds_fitted": round(float(study.train[0].log.time[-1] - study.train[0].log.time[0]), 2),
        "parameters": len(problem.parameters),
        "threads": threads,
        "numerics": str(case.numerics),
        "residuals": problem.count,
        "loss_at_start": round(_loss(problem, problem.start), 2),
        "sides": {
            name: {
                "loss": round(side[-1].loss, 3),
                **(
                    {"numerics": str(own), "loss_under_its_numerics": round(_loss(shipped, side[-1].x), 3)}
                    if name == "peer_as_shipped"
                    else {}
                ),
                "wall_s": [_round(r.wall) for r in side],
                "cpu_s": [_round(r.cpu) for r in side],
                **(
                    {"wall_s_to_the_loss": [_round(r.trace.reached(enough)) for r in side]}
                    if name not in ("peer_as_shipped", "whole_fit")
                    else {}
                ),
                "simulations": side[-1].trace.simulations,
            }
            for name, side in runs.items()
        },
        **{
            f"wall_over_{other}": {name: ratio(name, other, lambda r: r.wall) for name in ours}
            for other in runs
            if other not in ours
        },
        "cpu_over_peer": {name: ratio(name, "peer", lambda r: r.cpu) for name in ours},
        "wall_to_the_loss_over_peer": ratio("estimator", "peer", lambda r: r.trace.reached(enough)),
        "largest_difference": _round(float(np.max(np.abs(runs["estimator"][-1].x - runs["peer"][-1].x)))),
        "target": 0.333,
    }


def load_arm(seconds: float) -> Case:
    """An arm of our own and a log of it with weaker servos."""
    robot = comb(JOINTS, JOINTS)
    return Case(robot, log_of(robot, seconds), FINE)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; the exit code."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.peer", description=__doc__.partition("\n")[0])
    parser.add_argument("cases", nargs="*", default=[], help=f"any of {', '.join(PARAMETERS)}; default all")
    parser.add_argument("--seconds", type=float, default=20.0, help="of the log; 0.7 of them are fitted")
    parser.add_argument("--repeats", type=int, default=2)
    parser.add_argument("--threads", type=int, default=2, help="on either side")
    parser.add_argument("--whole", action="store_true", help="also the whole of `fit`, scores and checks included")
    options = parser.parse_args(argv)
    case = load_case().first(options.seconds)
    result: dict[str, Any] = {"machine": machine(), "seed": SEED, "model": case.robot.name}
    for name in options.cases or PARAMETERS:
        result[name] = compare(
            load_arm(options.seconds) if name == "arm" else case,
            PARAMETERS[name],
            threads=options.threads,
            repeats=options.repeats,
            whole=options.whole,
        )
    save("peer", result)
    return 0


if __name__ == "__main__":
    sys.exit(main())
