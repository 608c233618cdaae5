"""`python -m benchmarks.reference`: run the nine studies and compare every number with the stored ones.

A change that is said to be one of structure leaves all of them the same, to the last digit. Sums of floating-point
numbers depend on the processor, so on another one than `results/reference/machine.json` names, store first what the
code before the change gives (`--store`), and compare with that.

Ends with 1 if a number differs. Studies whose recordings are not on this machine are left out, and said to be.
"""

from __future__ import annotations

import argparse
import json
import platform
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from time import perf_counter
from typing import Any

from benchmarks.reference.compare import differences
from benchmarks.reference.studies import Reference, references

ROOT = Path(__file__).resolve().parents[2]
STORED = ROOT / "benchmarks" / "results" / "reference"
VERB = "import sys; from sysid_btr.cli import main; main(sys.argv[1:])"
FINISHED = (0, 5)
"""Exit codes after which a result is written."""
SHOWN = 12


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line."""
    known = {r.name: r for r in references()}
    parser = argparse.ArgumentParser(prog="python -m benchmarks.reference", description=__doc__)
    parser.add_argument("names", nargs="*", metavar="STUDY", help=f"of {', '.join(known)} (default: all)")
    parser.add_argument("--store", action="store_true", help="keep the numbers instead of comparing them")
    parser.add_argument("--stored", type=Path, default=STORED, help="folder of the kept numbers")
    parser.add_argument("--all", action="store_true", help="print every number that differs")
    options = parser.parse_args(argv)
    unknown = set(options.names) - set(known)
    if unknown:
        parser.error(f"no study {', '.join(sorted(unknown))}; there are {', '.join(known)}")
    options.stored.mkdir(parents=True, exist_ok=True)
    note = options.stored / "machine.json"
    if options.store:
        note.write_text(json.dumps(machine(), indent=1) + "\n")
    elif note.is_file() and json.loads(note.read_text()) != machine():
        print(f"stored on {json.loads(note.read_text())}, this is {machine()}: last digits may differ")
    different = 0
    for reference in (known[n] for n in options.names or known):
        if not reference.available:
            print(f"{reference.name}: no {reference.log}, left out")
            continue
        began = perf_counter()
        result = run(reference)
        seconds = perf_counter() - began
        place = options.stored / f"{reference.name}.json"
        if options.store:
            place.write_text(json.dumps(result, indent=1) + "\n")
            print(f"{reference.name}: stored, {seconds:.1f} s", flush=True)
            continue
        lines = differences(json.loads(place.read_text()), result)
        different += bool(lines)
        print(f"{reference.name}: {f'{len(lines)} differ' if lines else 'the same'}, {seconds:.1f} s", flush=True)
        for line in lines if options.all else lines[:SHOWN]:
            print(f"    {line}")
    return 1 if different else 0


def run(reference: Reference) -> Any:
    """What the study's result.json holds.

    Raises
    ------
    RuntimeError
        If the command fails; with what it said.
    """
    with tempfile.TemporaryDirectory() as folder:
        work = Path(folder)
        log = () if reference.log is None else ("--log", str(cut(reference, work)))
        # a stated number of threads: with it, sums are the same whatever else the machine has
        command = (reference.verb, "--model", reference.model, *log, *reference.arguments)
        command += ("--threads", "2", "--seed", "0", "--out", str(work / "out"))
        done = subprocess.run([sys.executable, "-c", VERB, *command], cwd=ROOT, capture_output=True, text=True)
        if done.returncode not in FINISHED:
            raise RuntimeError(f"{reference.name} ended with {done.returncode}:\n{done.stderr[-3000:]}")
        return json.loads((work / "out" / "result.json").read_text())


def cut(reference: Reference, folder: Path) -> Path:
    """The study's log, or its first seconds in a file of their own."""
    from sysid_btr.io.parquet import read_log, write_log

    assert reference.log is not None
    if reference.seconds is None:
        return reference.log
    log = read_log(reference.log)
    stop = int((log.time < log.time[0] + reference.seconds).sum())
    path = folder / reference.log.name
    write_log(log.window(0, stop), path)
    return path


def machine() -> dict[str, str]:
    """What decides about the last digits."""
    import mujoco
    import numpy as np
    import scipy

    processor = next(
        (line.partition(":")[2].strip() for line in _lines(Path("/proc/cpuinfo")) if line.startswith("model name")),
        platform.processor(),
    )
    return {
        "processor": processor,
        "machine": platform.machine(),
        "python": platform.python_version(),
        "mujoco": mujoco.__version__,
        "numpy": np.__version__,
        "scipy": scipy.__version__,
    }


def _lines(path: Path) -> list[str]:
    return path.read_text().splitlines() if path.is_file() else []


if __name__ == "__main__":
    sys.exit(main())
