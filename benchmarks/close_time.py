"""`python -m benchmarks.close_time`: how long `close` takes on 40 s of 22 joints, by threads and by workers.

Logs come from another rigid-body engine (`reference_simulator`): one with an effect, one without, and four of 10 s with
the effect. Rows are kept as they come, so that they can be measured one at a time; `--again` measures those anew that
are there.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from time import perf_counter, process_time, thread_time
from typing import TYPE_CHECKING, Any

from benchmarks.phases import watched
from benchmarks.replay import HERE, ROOT, machine
from reference_simulator import Recording, save
from reference_simulator.effects import CoulombFriction
from sysid_btr.cli.close import DECLARED
from sysid_btr.diagnosis.close import close
from sysid_btr.executors.base import HERE as IN_PROCESS
from sysid_btr.executors.base import Executor
from sysid_btr.executors.pool import DaskExecutor
from sysid_btr.identify.study import make_study
from sysid_btr.io.parquet import read_log
from sysid_btr.models.builtin import load_robot

if TYPE_CHECKING:
    from sysid_btr._typing import FloatArray
    from sysid_btr.executors.base import Divide, Work
    from sysid_btr.executors.worker import Done

MODEL = ROOT / "sample_logs" / "nao.xml"
CLEAN = Recording(
    robot=MODEL, motion="multisine", seed=5, seconds=40.0, mass={"RKneePitch": 1.2, "LHipPitch": 0.85}, kp=0.92
)
RUBBING = replace(CLEAN, seed=6, effects=(CoulombFriction(where=("LKneePitch", "RKneePitch"), torque=0.25),))
CASES: dict[str, tuple[Recording, ...]] = {
    "effect": (RUBBING,),
    "clean": (CLEAN,),
    "four logs": tuple(replace(RUBBING, seed=seed, seconds=10.0) for seed in range(6, 10)),
}
PLACES = ("1 thread", "2 threads", "1 worker", "2 workers")
TARGET = 1.7
"""What two workers are to be faster than one."""
SECONDS = 60.0
"""What two threads are to take at most."""


class Watched(DaskExecutor):
    """Adds up, batch by batch, what all workers did and what the busiest did: its time is the batch's on free cores."""

    def __init__(self, client: Any) -> None:
        super().__init__(client, patience=60.0)
        self.total = self.longest = 0.0
        self.batches = 0
        self._batch: Counter[str] = Counter()

    def run(self, work: Work, problem: Any, candidates: FloatArray, divide: Divide | None = None) -> FloatArray:
        self._batch.clear()
        result = super().run(work, problem, candidates, divide)
        if self._batch:
            self.batches += 1
            self.total += sum(self._batch.values())
            self.longest += max(self._batch.values())
        return result

    def count(self, done: Done) -> None:
        super().count(done)
        self._batch[done.worker] += done.cpu_seconds  # type: ignore[assignment]


def measure(case: str, place: str) -> dict[str, Any]:
    """`close` on one log in one place."""
    with tempfile.TemporaryDirectory() as folder:
        paths = [Path(folder) / f"{i}.parquet" for i in range(len(CASES[case]))]
        for path, recording in zip(paths, CASES[case], strict=True):
            save(recording, path)
        workers = int(place.partition(" ")[0])
        if "thread" in place:
            return _close(paths, IN_PROCESS, workers)
        import distributed

        cluster = distributed.LocalCluster(n_workers=workers, threads_per_worker=1, dashboard_address=":0")
        with cluster, distributed.Client(cluster, set_as_default=False) as client:
            executor = Watched(client)
            executor.threads()
            started = sum(client.run(process_time).values())
            row = _close(paths, executor)
            pieces = executor.total
            longest = executor.longest + row["main_thread_cpu_s"]
            return row | {
                "workers_cpu_s": round(sum(client.run(process_time).values()) - started, 1),
                "pieces_cpu_s": round(pieces, 1),
                "batches": executor.batches,
                "balance": round(pieces / executor.longest, 3),
                "longest_path_cpu_s": round(longest, 1),
                "candidates_by_worker": sorted(s.candidates for s in executor.shares.values()),
            }


def _close(paths: Sequence[Path], executor: Executor, threads: int = 1) -> dict[str, Any]:
    logs = [read_log(path) for path in paths]
    wall, cpu, main_thread = perf_counter(), process_time(), thread_time()
    with watched() as phases:
        study = make_study(load_robot(str(MODEL)), logs, threads=threads, executor=executor)
        closing = close(study, list(DECLARED))
    wall, cpu, main_thread = perf_counter() - wall, process_time() - cpu, thread_time() - main_thread
    result = closing.to_dict()
    return {
        "logs": len(logs),
        "seconds_of_log": round(sum(float(log.time[-1] - log.time[0]) for log in logs), 2),
        "samples": sum(map(len, logs)),
        "joints": len(logs[0].joints("position")),
        "numerics": str(closing.study.numerics),
        "verdict": result["verdict"],
        "effects": [f"{e['effect']}:{','.join(e['where'])}" for e in result["effects"]],
        "replays": result["replays"],
        "wall_s": round(wall, 1),
        "cpu_s": round(cpu, 1),
        "main_thread_cpu_s": round(main_thread, 1),
        "physics_share_of_cpu": round(phases.physics / cpu, 3),
        "physics_calls": dict(phases.calls),
    }


def ratios(rows: dict[str, dict[str, Any]]) -> dict[str, Any]:
    """Two workers over one, by wall time and by the longest path of CPU time."""
    found = {}
    for case in CASES:
        one, two = (rows.get(f"{case}, {place}") for place in PLACES[2:])
        if one and two:
            found[case] = {
                "wall": round(one["wall_s"] / two["wall_s"], 2),
                "longest_path_cpu": round(one["longest_path_cpu_s"] / two["longest_path_cpu_s"], 2),
                "balance": two["balance"],
                "same_result": all(one[k] == two[k] for k in ("verdict", "effects", "replays")),
                "target": TARGET,
            }
    return found


def on_threads(rows: dict[str, dict[str, Any]]) -> dict[str, Any]:
    """Wall time on two threads."""
    found = {case: rows[f"{case}, {PLACES[1]}"]["wall_s"] for case in CASES if f"{case}, {PLACES[1]}" in rows}
    return found | {"target": SECONDS}


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; the exit code."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.close_time", description=__doc__)
    parser.add_argument("--case", choices=CASES, action="append", help="default: all")
    parser.add_argument("--place", choices=PLACES, action="append", help="default: all")
    parser.add_argument("--again", action="store_true", help="also rows that are there")
    options = parser.parse_args(argv)
    path = HERE / "results" / "close_time.json"
    kept = json.loads(path.read_text()) if path.exists() else {}
    rows: dict[str, dict[str, Any]] = kept.get("rows", {})
    for case in options.case or CASES:
        for place in options.place or PLACES:
            name = f"{case}, {place}"
            if name in rows and not options.again:
                continue
            rows[name] = {**measure(case, place), "seeds": [r.seed for r in CASES[case]], "machine": machine()}
            content = {"rows": rows, "two_workers_over_one": ratios(rows), "seconds_on_two_threads": on_threads(rows)}
            path.write_text(json.dumps(content, indent=1) + "\n")
            print(name, json.dumps(rows[name]), file=sys.stderr, flush=True)
    print(json.dumps({"two_workers_over_one": ratios(rows), "seconds_on_two_threads": on_threads(rows)}, indent=1))
    return 0


if __name__ == "__main__":
    sys.exit(main())
