"""`python -m benchmarks.robots`: robots of any drive, simulated with known truth and measured ones, through `close`.

Simulated: steps of 0.25 ms of an integrator of our own, held commands, encoder ticks and noise; each model lacks one
thing that nobody declares, or nothing. `right`: that thing, at its place, within 15 %, and nothing else; `wrong`:
something is named that is not there; `not right`: all else that has a result. Measured (SYSID_BTR_DATA, else
../shared/data beside the checkout; left out where there are none): our figures beside published ones, those made by
hand, and a linear regression's on the same split and signals.

Each case is kept when it is done, as one JSON in the work folder, so that an interrupted run goes on.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from benchmarks.gantry import data_folder
from benchmarks.robots import measured, simulated, table
from benchmarks.robots.suite import cases

RESULTS = Path(__file__).resolve().parents[1] / "results" / "robots.json"
WORK = Path("out") / "robots"
LIMIT = 600.0


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; 1 where a simulated robot is told something wrong, or comes to no result."""
    every = _everything()
    parser = argparse.ArgumentParser(prog="python -m benchmarks.robots", description=__doc__)
    parser.add_argument("--only", nargs="+", metavar="NAME", choices=list(every), help=f"of {', '.join(every)}")
    parser.add_argument("--work", type=Path, default=WORK, help="folder of logs, runs and rows")
    parser.add_argument("--out", type=Path, default=RESULTS, help="the table")
    parser.add_argument("--limit", type=float, default=LIMIT, help="seconds for a run")
    parser.add_argument("--again", action="store_true", help="also cases that are done")
    options = parser.parse_args(argv)
    work = options.work.resolve()
    for name in options.only or every:
        row = None if options.again else table.read(work, name)
        if row is None:
            row = every[name](work, options.limit)
            if row is None:
                continue
            table.keep(work, row)
        print(table.line(row), flush=True)
    rows = [row for row in (table.read(work, name) for name in every) if row is not None]
    options.out.write_text(json.dumps(rows, indent=1) + "\n")
    print(table.summary(rows))
    own = [r for r in rows if r["kind"] == "simulated"]
    return 0 if all(r["answer"] in ("right", "not right") for r in own) else 1


def _everything() -> Mapping[str, Callable[[Path, float], dict[str, Any] | None]]:
    """Cases by name, simulated ones first."""
    found: dict[str, Callable[[Path, float], dict[str, Any] | None]] = {}
    for case in cases():
        found[case.name] = partial(simulated.examine, case)
    for one in measured.measured():
        found[one.name] = partial(_measure, one)
    return found


def _measure(one: measured.Measured, work: Path, limit: float) -> dict[str, Any] | None:
    missing = one.missing(data_folder())
    if missing:
        print(f"{one.name}: {missing}. Left out.")
        return None
    row = one.examine(data_folder(), work / one.name, limit)
    return {"kind": "measured", "name": one.name, "title": one.title, **row}


if __name__ == "__main__":
    sys.exit(main())
