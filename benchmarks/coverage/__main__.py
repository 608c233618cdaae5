"""`python -m benchmarks.coverage`: do 95 % intervals hold the truth 95 times in a hundred?"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from time import perf_counter

from benchmarks.coverage.draw import BENCHES, draw, recipe_state
from benchmarks.coverage.examine import ESTIMATORS, code_state, examine
from benchmarks.coverage.gantry import GANTRY, examine_gantry, recordings
from benchmarks.coverage.summary import Count, summarise
from benchmarks.coverage.table import Key, Row, append, read_rows

OUT = Path(__file__).parents[1] / "results" / "coverage.csv"


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; the exit code."""
    options = _parser().parse_args(argv)
    if not options.summary:
        if options.robot == "gantry" and recordings() is None:
            print("no recordings nao_gantry; set SYSID_BTR_DATA to the folder that holds them. Nothing to do.")
            return 0
        _run(options)
    rows = read_rows(options.out)
    print(summarise([r for r in rows if options.code in (None, r.code)]), end="")
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.coverage", description=__doc__)
    parser.add_argument("--robot", choices=(*BENCHES, "gantry"), default="leg")
    parser.add_argument("--estimator", choices=tuple(ESTIMATORS), default="lsq")
    parser.add_argument(
        "--plant",
        choices=("other", "own"),
        default="other",
        help="who makes the logs: another engine, or the replay itself (white noise; for the width of intervals)",
    )
    parser.add_argument("--first", type=int, default=1, metavar="N", help="number of the first log")
    parser.add_argument("--count", type=int, default=10, metavar="N", help="how many logs")
    parser.add_argument("--seconds-budget", type=float, metavar="S", help="start no further log after S seconds")
    parser.add_argument("--out", type=Path, default=OUT, help="table to continue")
    parser.add_argument("--threads", type=int, default=1, help="worker threads, 0 for all cores")
    parser.add_argument(
        "--any-code", action="store_true", help="do not repeat logs that another state of the code has done"
    )
    parser.add_argument("--summary", action="store_true", help="only sum up the table")
    parser.add_argument("--code", help="sum up rows of this state of the code only")
    return parser


def _run(options: argparse.Namespace) -> None:
    gantry = options.robot == "gantry"
    plant = "recorded" if gantry else options.plant
    last = min(options.first + options.count, len(GANTRY) + 1) if gantry else options.first + options.count
    recipe, code = recipe_state(), code_state()
    done = {_shown(r.key, options.any_code) for r in read_rows(options.out)}
    began = perf_counter()
    work: Callable[[int], list[Row]] = (
        (lambda number: examine_gantry(number, options.estimator, options.threads))
        if gantry
        else lambda number: examine(draw(BENCHES[options.robot], number), options.estimator, plant, options.threads)
    )
    for number in range(options.first, last):
        key = (options.robot, options.estimator, plant, number, recipe, code)
        if _shown(key, options.any_code) in done:
            continue
        if options.seconds_budget is not None and perf_counter() - began > options.seconds_budget:
            return
        rows = work(number)
        append(options.out, rows)
        _tell(rows)


def _shown(key: Key, any_code: bool) -> tuple[object, ...]:
    return key[:-1] if any_code else key


def _tell(rows: Sequence[Row]) -> None:
    first, count = rows[0], Count.of(rows)
    missed = ", ".join(
        f"{r.parameter} {r.value:.4g} (true {r.true:g}, {abs(r.value - r.true) / r.std:.1f} std)"
        for r in rows
        if r.identifiable != "no" and not r.covered
    )
    sys.stderr.write(
        f"{first.robot} {first.estimator} {first.number:>4} {first.motion:<10} chi2 {first.chi2:.3f} "
        f"{count.inside}/{count.told} {first.seconds:.1f} s {missed}\n"
    )
    sys.stderr.flush()


if __name__ == "__main__":
    sys.exit(main())
