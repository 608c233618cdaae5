"""`python -m benchmarks.replay`: the replay engine against bare MuJoCo, its threads, and its memory.

Every speed is a ratio whose two sides alternate, chunk by chunk, in one process.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import resource
import subprocess
import sys
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from importlib.metadata import version
from pathlib import Path
from time import perf_counter, process_time
from typing import Any

import numpy as np

import sysid_btr
from sysid_btr._typing import FloatArray
from sysid_btr.identify.numerics import choose_numerics
from sysid_btr.identify.study import Study, make_study
from sysid_btr.io.log import Log
from sysid_btr.io.parquet import read_log
from sysid_btr.io.split import split_episodes
from sysid_btr.models.builtin import load_robot
from sysid_btr.models.robot import Robot
from sysid_btr.simulation.numerics import Numerics
from sysid_btr.simulation.replay import CHUNK, Replay

HERE = Path(__file__).parent
ROOT = HERE.parent
STARRED = tuple(f"{side}{part}" for side in "RL" for part in ("ShoulderRoll", "HipRoll", "HipPitch", "KneePitch"))
"""Bodies whose masses the Back-to-Reality paper identifies."""
MASSES = (f"mass:{','.join(STARRED)}", "kp:*=shared", "kv:*=shared")
CANDIDATES = 64
SECONDS = 10.0
MEMORY_CANDIDATES = 1000
MEMORY_SECONDS = 60.0
SEED = 0


@dataclass(frozen=True)
class Case:
    """A robot, one log of it, and how it is replayed."""

    robot: Robot
    log: Log
    numerics: Numerics

    def study(self, threads: int) -> Study:
        return make_study(self.robot, [self.log], numerics=self.numerics, threads=threads)

    def first(self, seconds: float) -> Case:
        """The same, on the first seconds of the log."""
        stop = int(np.searchsorted(self.log.time, self.log.time[0] + seconds + 1e-6))
        return replace(self, log=self.log.window(0, stop))


def load_case() -> Case:
    """gantry_c where the recorded logs are at hand, else the sample Nao; numerics chosen by the convergence check."""
    folder = Path(os.environ.get("SYSID_BTR_DATA", ROOT.parent / "shared" / "data")) / "nao_gantry"
    if folder.is_dir():
        model, path = folder / "nominal.xml", folder / "gantry_c.parquet"
    else:
        model, path = ROOT / "sample_logs" / "nao.xml", ROOT / "sample_logs" / "nao_delay.parquet"
    robot, log = load_robot(str(model)), read_log(path)
    return Case(robot, log, choose_numerics(robot, log)[0])


def machine() -> dict[str, Any]:
    """What a figure depends on besides the code."""
    cpu = Path("/proc/cpuinfo")
    names = [line.partition(":")[2].strip() for line in cpu.read_text().splitlines() if line.startswith("model name")]
    return {
        "cpu": names[0] if names else platform.processor(),
        "cores": os.cpu_count(),
        "load_average_1_min": round(os.getloadavg()[0], 2),
        "system": f"{platform.system()} {platform.machine()}",
        "python": platform.python_version(),
        "sysid-btr": sysid_btr.__version__,
        **{name: version(name) for name in ("mujoco", "numpy", "scipy")},
    }


def draw(replay: Replay, count: int) -> FloatArray:
    """Candidates (count, p) around the nominal values."""
    rng = np.random.default_rng(SEED)
    nominal = np.array([p.nominal for p in replay.parameters])
    return nominal * rng.uniform(0.8, 1.2, (count, len(nominal)))


def throughput(case: Case, repeats: int) -> dict[str, Any]:
    """Replay, bare `mj_step` and `mujoco.rollout`, on one thread and on two; chunk by chunk in turn."""
    case = case.first(SECONDS)
    replays = {threads: _replay(case, threads) for threads in (1, 2)}
    candidates = draw(replays[1], CANDIDATES)
    chunks = [candidates[i : i + CHUNK] for i in range(0, len(candidates), CHUNK)]
    runs: dict[str, Callable[[FloatArray], None]] = {
        "bare": lambda rows: _bare(replays[1], len(rows)),
        "rollout": lambda rows: _rollout(replays[1], len(rows)),
        "still": lambda rows: _still(replays[1], len(rows)),
        "one": lambda rows: _drain(replays[1], rows),
        "two": lambda rows: _drain(replays[2], rows),
        "bare_two": lambda rows: _bare_threads(replays[1], len(rows), 2),
    }
    for run in runs.values():
        run(candidates[:1])
    wall: dict[str, list[float]] = {name: [] for name in runs}
    cpu: dict[str, list[float]] = {name: [] for name in runs}
    for repeat in range(repeats):
        for chunk in chunks:
            # each side goes first as often as the others
            for name in np.roll(list(runs), repeat).tolist():
                w, c = perf_counter(), process_time()
                runs[name](chunk)
                wall[name].append(perf_counter() - w)
                cpu[name].append(process_time() - c)
    steps = len(chunks[0]) * replays[1].grid.steps
    bare, one, two, bare_two = (np.array(wall[name]) for name in ("bare", "one", "two", "bare_two"))

    def over(name: str) -> dict[str, float]:
        """Speed of a replay over that of a reference: medians of chunks by wall and CPU time, and of the fastest."""
        theirs, spent = np.array(wall[name]), np.array(cpu[name])
        return {
            "median": _round(np.median(theirs / one)),
            "best": _round(theirs.min() / one.min()),
            "cpu_time": _round(np.median(spent / np.array(cpu["one"]))),
            "target": 0.95,
        }

    return {
        "candidates": CANDIDATES,
        "seconds": SECONDS,
        "numerics": str(case.numerics),
        "repeats": repeats,
        "steps_per_s": {name: round(steps / min(times)) for name, times in wall.items()},
        "per_thread_over_bare": over("bare"),
        "per_thread_over_rollout": over("rollout"),
        "per_thread_over_a_robot_that_stands_still": over("still"),
        "two_threads_over_one": {
            "median": _round(np.median(one / two)),
            "best": _round(one.min() / two.min()),
            "cores_it_got": _round(np.median(np.array(cpu["two"]) / two)),
            "bare_median": _round(np.median(bare / bare_two)),
            "bare_cores_it_got": _round(np.median(np.array(cpu["bare_two"]) / bare_two)),
            "extra_cpu_time": _round(np.median(np.array(cpu["two"]) / np.array(cpu["one"])) - 1),
            "target": 1.6,
        },
    }


def memory() -> dict[str, Any]:
    """Peak resident memory of many long candidates, each way of using them in a process of its own."""
    result: dict[str, Any] = {"candidates": MEMORY_CANDIDATES, "seconds": MEMORY_SECONDS, "target_mb": 1000}
    for way in ("nothing", "loss", "chunks"):
        command = [sys.executable, "-m", "benchmarks.replay", "--measure-memory", way]
        result[way] = json.loads(subprocess.run(command, cwd=ROOT, check=True, capture_output=True, text=True).stdout)
    return result


def measure_memory(way: str) -> dict[str, Any]:
    """Peak memory in MB of this process after one way of replaying."""
    case = load_case()
    # the same arrays as with the chosen integrator, at a quarter of the time
    case = replace(case, numerics=Numerics("implicitfast", case.numerics.timestep))
    log = _as_long_as(case.log, MEMORY_SECONDS)
    study = make_study(case.robot, [log], holdout=[], numerics=case.numerics)
    problem = study.train_problem(study.declare(MASSES))
    replay = problem.episodes[0].replay
    candidates = draw(replay, MEMORY_CANDIDATES)
    began = perf_counter()
    if way == "loss":
        assert np.isfinite(problem.loss(candidates)).all()
    elif way == "chunks":
        for _, outputs in replay.chunks(candidates):
            assert np.isfinite(outputs.position).all()
    return {
        "peak_mb": round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024),
        "wall_s": _round(perf_counter() - began),
        "samples": len(log),
        "joints": len(replay.index.joints),
        "numerics": str(case.numerics),
    }


def _as_long_as(log: Log, seconds: float) -> Log:
    """The log over and over, until it is as long: memory does not ask whether the motion is smooth."""
    period = float(np.median(np.diff(log.time)))
    rows = np.arange(round(seconds / period) + 1) % len(log)
    return replace(
        log,
        time=np.arange(len(rows)) * period,
        channels={name: column[rows] for name, column in log.channels.items()},
        episode=np.zeros(len(rows), dtype=np.int64),
    )


def _replay(case: Case, threads: int) -> Replay:
    study = case.study(threads)
    return Replay(case.robot, case.log, study.declare(MASSES), case.numerics, threads=threads)


def _drain(replay: Replay, candidates: FloatArray) -> None:
    for _, outputs in replay.chunks(candidates):
        assert np.isfinite(outputs.position).all()


def _bare(replay: Replay, count: int) -> None:
    """The same steps of the same model from the same state: `mj_step` for as long as a command is held."""
    import mujoco

    model, data, controls = replay.model, _at_start(replay), _controls(replay)
    borders = np.flatnonzero(np.diff(controls, axis=0).any(axis=1)) + 1
    held = list(zip(np.split(controls, borders), np.diff([0, *borders, len(controls)]).tolist(), strict=True))
    for _ in range(count):
        _at_start(replay, data)
        for rows, steps in held:
            data.ctrl[:] = rows[0]
            mujoco.mj_step(model, data, steps)


def _rollout(replay: Replay, count: int) -> None:
    """The same by `mujoco.rollout`."""
    import mujoco
    from mujoco.rollout import rollout

    model, data, kind = replay.model, _at_start(replay), mujoco.mjtState.mjSTATE_FULLPHYSICS
    state = np.empty(mujoco.mj_stateSize(model, kind))
    mujoco.mj_getState(model, data, state, kind)
    controls = np.tile(_controls(replay), (count, 1, 1))
    rollout(model, data, initial_state=np.tile(state, (count, 1)), control=controls)


def _still(replay: Replay, count: int) -> None:
    """As many steps, controls held: the solver has least to do where nothing moves."""
    import mujoco

    data, controls = _at_start(replay), _controls(replay)
    for _ in range(count):
        _at_start(replay, data)
        data.ctrl[:] = controls[0]
        mujoco.mj_step(replay.model, data, replay.grid.steps)


def bare_seconds(model: str, path: Path, numerics: Numerics, seconds: float) -> float:
    """CPU seconds of one bare `mj_step` along the first seconds of a log, the fastest of three times."""
    robot, log = load_robot(model), read_log(path)
    case = Case(robot, split_episodes(log)[0], numerics).first(seconds)
    replay = Replay(robot.for_log(case.log), case.log, (), numerics, threads=1)
    spent = []
    for _ in range(4):
        began = process_time()
        _bare(replay, 1)
        spent.append(process_time() - began)
    return min(spent[1:]) / replay.grid.steps


def _at_start(replay: Replay, data: Any = None) -> Any:
    import mujoco

    data = mujoco.MjData(replay.model) if data is None else data
    mujoco.mj_resetData(replay.model, data)
    data.qpos[replay.index.qpos], data.qvel[replay.index.dof] = replay.start
    return data


def _controls(replay: Replay) -> FloatArray:
    """(steps, nu)."""
    driven = replay.index.actuator >= 0
    result = np.zeros((replay.grid.steps, replay.model.nu))
    result[:, replay.index.actuator[driven]] = replay.grid.command[:, driven]
    return result


def _bare_threads(replay: Replay, count: int, threads: int) -> None:
    """The same on several threads: what the machine, busy as it is, gives at that moment."""
    with ThreadPoolExecutor(threads) as pool:
        list(pool.map(lambda _: _bare(replay, 1), range(count)))


def _round(value: float) -> float:
    return float(f"{value:.3g}")


def save(name: str, result: dict[str, Any]) -> None:
    """Write a result and show it."""
    text = json.dumps(result, indent=1)
    path = HERE / "results" / f"{name}.json"
    path.parent.mkdir(exist_ok=True)
    path.write_text(text + "\n")
    print(text)
    print(f"written to {path.relative_to(ROOT)}", file=sys.stderr)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; the exit code."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.replay", description=__doc__)
    parser.add_argument("--repeats", type=int, default=2, help="times that each chunk runs on each side")
    part = parser.add_mutually_exclusive_group()
    part.add_argument("--no-memory", action="store_true", help="speed only")
    part.add_argument("--memory-only", action="store_true", help="memory only; the speeds of before are kept")
    parser.add_argument("--measure-memory", choices=("nothing", "loss", "chunks"), help=argparse.SUPPRESS)
    options = parser.parse_args(argv)
    if options.measure_memory:
        print(json.dumps(measure_memory(options.measure_memory)))
        return 0
    if options.memory_only:
        kept = json.loads((HERE / "results" / "replay.json").read_text())
        save("replay", kept | {"memory": {"machine": machine(), **memory()}})
        return 0
    case = load_case()
    result: dict[str, Any] = {"machine": machine(), "seed": SEED, "model": case.robot.name, "log": case.log.meta.robot}
    result["throughput"] = throughput(case, options.repeats)
    if not options.no_memory:
        result["memory"] = memory()
    save("replay", result)
    return 0


if __name__ == "__main__":
    sys.exit(main())
