"""`python -m benchmarks.fuzz`: broken files and strange command lines, by their numbers; resumable.

Cases run in a process of their own, some thousand at a time, so that one that ends the process is seen and passed over.
The table counts exit codes by format and lists every case that did what no input may make it do: exit 1, a traceback,
more than 1 GB, more than 30 s, the end of the process.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from time import perf_counter
from typing import Any

from benchmarks.fuzz.cases import run_case
from benchmarks.fuzz.examples import make_examples

OUT = Path(__file__).parents[1] / "results" / "fuzz.json"
BATCH = 2000
"""Cases in one process."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; the exit code: 1 if any case did what none may."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.fuzz", description=__doc__)
    parser.add_argument("--cases", type=int, default=100_000, metavar="N", help="cases there are to be in the table")
    parser.add_argument(
        "--seconds", type=float, default=float("inf"), metavar="S", help="begin no more after S seconds"
    )
    parser.add_argument("--out", type=Path, default=OUT, help="table to continue")
    parser.add_argument("--from", dest="first", type=int, help=argparse.SUPPRESS)
    parser.add_argument("--count", type=int, help=argparse.SUPPRESS)
    options = parser.parse_args(argv)
    if options.first is not None:
        _batch(options.first, options.count)
        return 0
    table: dict[str, Any] = {"cases": 0, "codes": {}, "wrong": []}
    if options.out.exists():
        table = json.loads(options.out.read_text())
    began = perf_counter()
    while table["cases"] < options.cases and perf_counter() - began < options.seconds:
        _grow(table, min(BATCH, options.cases - table["cases"]))
        options.out.write_text(json.dumps(table, indent=1) + "\n")
    print(f"{table['cases']} cases, {len(table['wrong'])} that no input may cause")
    for name, codes in table["codes"].items():
        print(f"  {name}: {', '.join(f'exit {code}: {n}' for code, n in sorted(codes.items()))}")
    return 1 if table["wrong"] else 0


def _batch(first: int, count: int) -> None:
    """Cases one after the other, a line each."""
    examples = make_examples()
    for number in range(first, first + count):
        example = examples[number % len(examples)]
        found = run_case(example, number // len(examples))
        print(json.dumps([number, example.name, found.code, found.wrong]), flush=True)


def _grow(table: dict[str, Any], count: int) -> None:
    """Add the next cases to a table, up to one that ends the process."""
    command = [sys.executable, "-m", "benchmarks.fuzz", "--from", str(table["cases"]), "--count", str(count)]
    run = subprocess.run(command, capture_output=True, text=True, check=False)
    lines = [json.loads(line) for line in run.stdout.splitlines() if line.startswith("[")]
    for number, name, code, wrong in lines:
        own = Counter(table["codes"].setdefault(name, {}))
        own[str(code)] += 1
        table["codes"][name] = dict(own)
        if wrong:
            table["wrong"].append({"case": number, "format": name, "what": wrong})
    table["cases"] += len(lines)
    if run.returncode:
        what = f"the process ended with {run.returncode}: {run.stderr[-300:]}"
        table["wrong"].append({"case": table["cases"], "format": "", "what": what})
        table["cases"] += 1


if __name__ == "__main__":
    sys.exit(main())
