"""`python -m benchmarks.blind`: draw logs, close the loop on them, compare with the truth."""

from __future__ import annotations

import argparse
import importlib
import multiprocessing
import os
import pkgutil
import subprocess
import sys
import traceback
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from time import perf_counter

from benchmarks.blind.draw import PARTS, Case, draw
from benchmarks.blind.recorded import HERE, digest, identify, is_recorded, recipe_state
from benchmarks.blind.run import Job, planted_text, say, work
from benchmarks.blind.summary import latest, summarise
from benchmarks.blind.table import read_rows


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; the exit code."""
    options = _parser().parse_args(argv)
    if options.list:
        for case in _chosen(options):
            planted = planted_text(case.spec.effects) or "nothing"
            print(f"{case.id:<12}{case.bench.name:<16}{case.spec.motion:<10}{planted}")
        return 0
    if not options.summary:
        _run(options)
    if options.record:
        return 0
    rows = [r for r in latest(read_rows(options.out), options.code) if r.series == options.series]
    print(summarise(rows), end="")
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.blind", description=__doc__)
    parser.add_argument("--part", choices=(*PARTS, "all"), default="all")
    parser.add_argument("--only", metavar="N,N", help="numbers within the part, from 1; a-b for a range")
    parser.add_argument("--count", type=int, metavar="N", help="stop after N logs")
    parser.add_argument("--seconds-budget", type=float, metavar="S", help="start no further log after S seconds")
    parser.add_argument(
        "--series", type=int, default=0, help="another draw of everything, for logs that nobody has tuned on"
    )
    parser.add_argument("--out", type=Path, default=HERE / "results.csv", help="table to continue")
    parser.add_argument("--threads", type=int, default=0, help="worker threads of each log, 0 for all cores")
    parser.add_argument("--workers", type=int, default=1, metavar="N", help="logs at a time, each in a process")
    parser.add_argument("--record", action="store_true", help="only record logs, for a machine without Pinocchio")
    parser.add_argument("--again", action="store_true", help="also logs that the table has for this code")
    parser.add_argument("--list", action="store_true", help="show what would be planted, and stop")
    parser.add_argument("--summary", action="store_true", help="only sum up the table")
    parser.add_argument("--code", help="sum up rows of this state of the code only")
    return parser


def _numbers(options: argparse.Namespace, part: str) -> list[int]:
    if not options.only:
        return list(range(1, PARTS[part] + 1))
    chosen: list[int] = []
    for item in options.only.split(","):
        first, _, last = item.partition("-")
        chosen += range(int(first), int(last or first) + 1)
    return [n for n in chosen if 1 <= n <= PARTS[part]]


def _parts(options: argparse.Namespace) -> list[str]:
    return list(PARTS) if options.part == "all" else [options.part]


def _chosen(options: argparse.Namespace) -> list[Case]:
    return [draw(part, n, options.series) for part in _parts(options) for n in _numbers(options, part)]


def _run(options: argparse.Namespace) -> None:
    began = perf_counter()
    jobs = _jobs(options)
    if options.workers > 1:
        os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # of the processes to come

    def begin(job: Job) -> None:
        if options.seconds_budget is not None and perf_counter() - began > options.seconds_budget:
            return
        if options.workers == 1:
            try:
                work(job)
            except Exception:  # the others are still to be done
                say(traceback.format_exc())
            return
        process = multiprocessing.get_context("spawn").Process(target=work, args=(job,))
        process.start()
        process.join()
        if process.exitcode:
            say(f"{identify(job.part, job.number, job.series)}: its process ended with {process.exitcode}")

    with ThreadPoolExecutor(options.workers) as pool:
        list(pool.map(begin, jobs))


def _jobs(options: argparse.Namespace) -> list[Job]:
    """What the table (or the folder of logs) lacks."""
    code = "" if options.record else code_state()
    done = set() if options.again or options.record else {row.key for row in read_rows(options.out)}
    threads = options.threads if options.workers == 1 else 1
    jobs = [
        Job(part, number, options.series, code, options.out, threads)
        for part in _parts(options)
        for number in _numbers(options, part)
        if (identify(part, number, options.series), recipe_state(part), code) not in done
        and not (options.record and is_recorded(part, number, options.series))
    ]
    return jobs[: options.count]


def code_state() -> str:
    """Commit of the package, with a digest of its sources where they differ from it; loads all of it first."""
    import sysid_btr

    for module in pkgutil.walk_packages(sysid_btr.__path__, "sysid_btr."):
        if not module.name.endswith("__main__"):
            importlib.import_module(module.name)
    folder = Path(sysid_btr.__file__).parent

    def git(*arguments: str) -> str:
        run = subprocess.run(["git", *arguments], cwd=folder, capture_output=True, text=True, check=False)
        return run.stdout.strip() if run.returncode == 0 else ""

    commit = git("rev-parse", "--short", "HEAD")
    changed = not commit or git("status", "--porcelain", "--", ".")
    name = f"{sysid_btr.__version__}-{commit}" if commit else sysid_btr.__version__
    return f"{name}+{digest(sorted(folder.rglob('*.py')))}" if changed else name


if __name__ == "__main__":
    sys.exit(main())
