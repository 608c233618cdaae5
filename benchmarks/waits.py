"""`python -m benchmarks.waits`: how long people wait, case by case, and where the time goes.

Each case is a command line in a process of its own. A row has its CPU and wall time, CPU time over that of bare
`mj_step` for as many steps, the time until the first line of progress, what was found (so that "the same answers" can
be checked), and the shares of the CPU time by part (`benchmarks.phases`). Rows of single candidates compare one replay
whose model has a law of every step with bare `mj_step` over the same steps.

Rows are kept in results/waits.json as they come: a run that is stopped goes on where it was; `--again` measures anew
and keeps the earlier row as `before`. Recordings come from SYSID_BTR_DATA, else ../shared/data beside the checkout;
cases whose recordings are missing are left out.
"""

from __future__ import annotations

import argparse
import io
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks.close_time import CLEAN, MODEL, RUBBING
from benchmarks.gantry import data_folder
from benchmarks.phases import Phases, watched
from benchmarks.replay import MASSES, ROOT, bare_seconds, machine
from reference_simulator import Recording, save

RESULTS = Path(__file__).parent / "results" / "waits.json"
LEFT_OUT = "left out"
LIMIT = 1800.0
"""s of CPU time after which a case has no end."""
BARE_SECONDS = 4.0
"""Part of a log over which bare steps are timed."""
SAMPLES = ROOT / "sample_logs"
SMALL = 0.1
"""Amount of a law, as a fraction of its range."""
WALK = ("--model", "nao_walk/nominal_free.xml", "--log", "nao_walk/walk_a.parquet")
GANTRY = ("--model", "nao_gantry/nominal.xml", "--log", "nao_gantry/gantry_c.parquet")
FREE = tuple(text for free in MASSES for text in ("--fit", free))


@dataclass(frozen=True)
class Case:
    """One wait.

    Attributes
    ----------
    goal : s of wall time on two idle cores, or a ratio.
    argv : command line; paths of recordings are below the folder of the data.
    recording : made by the reference simulator, as the log of `argv`.
    law : parameters of laws of every step, under which one candidate is compared with bare steps instead.
    """

    goal: float
    argv: tuple[str, ...] = ()
    recording: Recording | None = None
    law: tuple[str, ...] = ()

    def needs(self, data: Path) -> list[Path]:
        """Recordings that are missing."""
        return [data / a for a in self.argv if a.endswith(".parquet") and not (data / a).is_file()]


def _xl330() -> tuple[str, ...]:
    logs = sorted((data_folder() / "xl330").glob("*.parquet"))
    return tuple(text for log in logs for text in ("--log", f"xl330/{log.name}"))


LADDER = ("back_emf:*", "stribeck_friction:*", "load_friction:*", "voltage_sag:*")
"""What `close` finds first on a hobby servo."""
XL330 = ("--model", "xl330", "--fit", "torque_constant:pendulum")
CASES: dict[str, Case] = {
    "close_friction": Case(20.0, ("close", "--model", str(MODEL)), RUBBING),
    "close_clean": Case(4.0, ("close", "--model", str(MODEL)), CLEAN),
    "close_emps": Case(10.0, ("close", "--model", "emps", "--log", "emps/emps.parquet", "--fit", "mass:*")),
    "close_xl330_nine": Case(120.0, ("close", *XL330, *_xl330())),
    "close_xl330_one": Case(15.0, ("close", *XL330, "--log", "xl330/kp200_sin_sin.parquet")),
    "close_walk": Case(120.0, ("close", *WALK, *FREE)),
    "fit_walk": Case(25.0, ("fit", *WALK, *FREE)),
    "close_tx40": Case(30.0, ("close", "--model", "tx40/tx40_with_servos.xml", "--log", "tx40/logs/tx40.parquet")),
    "posterior_gantry_c": Case(90.0, ("posterior", *GANTRY, *FREE)),
    "law_22_joints": Case(1.3, GANTRY, law=("stribeck_friction:*",)),
    "law_pendulum": Case(
        1.6,
        ("--model", str(SAMPLES / "pendulum.xml"), "--log", str(SAMPLES / "pendulum_clean.parquet")),
        law=("stribeck_friction:*",),
    ),
    "law_xl330": Case(1.6, ("--model", "xl330", "--log", "xl330/kp200_sin_sin.parquet"), law=LADDER),
    "demo": Case(20.0, ("demo",)),
}


def measure(case: Case, data: Path, limit: float) -> dict[str, Any]:
    """A row of the table: the case in a process of its own."""
    with tempfile.TemporaryDirectory() as folder:
        argv = [str(data / a) if (data / a).is_file() else a for a in case.argv]
        if case.recording is not None:
            log = Path(folder) / "log.parquet"
            save(case.recording, log)
            argv += ["--log", str(log)]
        into = Path(folder) / "row.json"
        task = {"argv": argv, "law": case.law, "out": str(Path(folder) / "out"), "into": str(into)}
        began = time.time()
        command = [sys.executable, "-m", "benchmarks.waits", "--measure", json.dumps(task | {"began": began})]
        process = subprocess.Popen(command, cwd=ROOT)
        while process.poll() is None:
            time.sleep(0.2)
            if _cpu_of(process.pid) > limit:
                process.kill()
                process.wait()
                return {"no_end_in_cpu_s": limit}
        if not into.is_file():
            return {"failed": process.returncode}
        row: dict[str, Any] = json.loads(into.read_text())
        return row


def _cpu_of(pid: int) -> float:
    """CPU seconds of a process that runs; 0 once it has ended, or where the system does not say."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return 0.0
    return (int(fields[11]) + int(fields[12])) / float(os.sysconf("SC_CLK_TCK"))


class Heard(io.TextIOBase):
    """stderr, which remembers when the first line of progress came."""

    def __init__(self, began: float) -> None:
        self.began = began
        self.first: dict[str, Any] = {}

    def write(self, text: str) -> int:
        if not self.first and " replays, " in text:
            self.first = {"wall_s": round(time.time() - self.began, 2), "cpu_s": round(time.process_time(), 2)}
            self.first["line"] = text.strip()
        return sys.__stderr__.write(text) if sys.__stderr__ else len(text)

    def isatty(self) -> bool:
        return False


def carry_out(task: Mapping[str, Any]) -> dict[str, Any]:
    """What a case takes, in this process."""
    argv = list(task["argv"])
    if task["law"]:
        return one_candidate(argv[1], Path(argv[3]), task["law"])
    from sysid_btr.cli import run

    out, heard = Path(task["out"]), Heard(task["began"])
    sys.stderr, shown = heard, sys.stderr
    sys.stdout, printed = io.StringIO(), sys.stdout
    try:
        with watched() as phases:
            code = run([*argv, "--out", str(out)])
    finally:
        sys.stderr, sys.stdout = shown, printed
    cpu, wall = time.process_time(), time.time() - task["began"]
    results = {path.parent.name: json.loads(path.read_text()) for path in sorted(out.rglob("result.json"))}
    row = {"exit": code, "cpu_s": round(cpu, 1), "wall_s": round(wall, 1), "first_line": heard.first}
    row |= {"shares": phases.to_dict(), "steps": dict(phases.steps), "calls": dict(phases.calls)}
    if len(results) == 1:
        (result,) = results.values()
        bare = bare_time(argv, result, phases)
        return row | {"over_bare": round(cpu / bare, 2), "replays": result["replays"], "found": found_in(result)}
    return row | {"found": {name: found_in(result) for name, result in results.items()}}


def found_in(result: Mapping[str, Any]) -> dict[str, Any]:
    """Verdict, numbers with their standard deviations, and held-out errors."""

    def numbers(parameters: Sequence[Mapping[str, Any]]) -> dict[str, list[float | None]]:
        return {p["name"]: [_short(p["value"]), _short(p["std"])] for p in parameters}

    return {
        "verdict": result.get("verdict"),
        "numerics": result["numerics"]["chosen"],
        "parameters": numbers(result["parameters"]),
        "effects": [
            {"effect": e["effect"], "where": e["where"], **numbers(e["parameters"])} for e in result["effects"]
        ],
        "held_out": {c: _short(s["rmse"]) for c, s in result["after"]["holdout"].items() if s["rmse"] is not None},
    }


def _short(value: float | None) -> float | None:
    return None if value is None else float(f"{value:.5g}")


def bare_time(argv: Sequence[str], result: Mapping[str, Any], phases: Phases) -> float:
    """CPU seconds of bare `mj_step` for as many steps as were taken, on the first seconds of the first log."""
    from sysid_btr.simulation.numerics import Numerics

    model, log = (argv[argv.index(name) + 1] for name in ("--model", "--log"))
    step = float(result["numerics"]["timestep"])
    return sum(
        count * bare_seconds(model, Path(log), Numerics(name, step), BARE_SECONDS)
        for name, count in phases.steps.items()
    )


def one_candidate(model: str, path: Path, law: Sequence[str]) -> dict[str, Any]:
    """CPU time of a replay with a law of every step, over bare `mj_step`."""
    from sysid_btr.identify.numerics import choose_numerics
    from sysid_btr.io.parquet import read_log
    from sysid_btr.models.builtin import load_robot
    from sysid_btr.simulation.replay import Replay
    from sysid_btr.terms.grammar import parse_parameters
    from sysid_btr.terms.model import Terms

    robot, log = load_robot(model), read_log(path)
    numerics, _ = choose_numerics(robot, log)
    terms = Terms(parse_parameters(list(law), robot))
    replay = Replay(robot.for_log(log), log, tuple(terms), numerics, threads=1)
    candidate = (terms.lower + SMALL * (terms.upper - terms.lower))[None]
    replay.predict(candidate)
    spent = []
    for _ in range(3):
        began = time.process_time()
        replay.predict(candidate)
        spent.append(time.process_time() - began)
    ours = min(spent) / replay.grid.steps
    bare = bare_seconds(model, path, numerics, float(log.time[-1] - log.time[0]))
    figures = {"law_us_a_step": 1e6 * ours, "bare_us_a_step": 1e6 * bare, "over_bare": ours / bare}
    return {"numerics": str(numerics), **{name: _short(value) for name, value in figures.items()}}


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; the exit code."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.waits", description=__doc__)
    parser.add_argument("cases", nargs="*", metavar="CASE", help=f"of {', '.join(CASES)} (default: all)")
    parser.add_argument("--again", action="store_true", help="also rows that are there")
    parser.add_argument("--limit", type=float, default=LIMIT, metavar="S", help="CPU time of a case at most")
    parser.add_argument("--measure", help=argparse.SUPPRESS)
    options = parser.parse_args(argv)
    if options.measure:
        task = json.loads(options.measure)
        Path(task["into"]).write_text(json.dumps(carry_out(task)))
        return 0
    unknown = set(options.cases) - set(CASES)
    if unknown:
        parser.error(f"no case {', '.join(sorted(unknown))}; there are {', '.join(CASES)}")
    rows: dict[str, dict[str, Any]] = json.loads(RESULTS.read_text()) if RESULTS.exists() else {}
    data = data_folder()
    for name in options.cases or CASES:
        case, known = CASES[name], rows.get(name)
        if missing := case.needs(data):
            print(f"{name}: {LEFT_OUT}, no {missing[0]}", file=sys.stderr)
            continue
        if known is None or options.again:
            row = {"goal": case.goal, **measure(case, data, options.limit), "machine": machine()}
            before = {} if known is None else {"before": {k: v for k, v in known.items() if k != "before"}}
            rows[name] = row | before
            RESULTS.write_text(json.dumps(rows, indent=1) + "\n")
        print(text_of(name, rows[name]), flush=True)
    return 0


def text_of(name: str, row: Mapping[str, Any]) -> str:
    """One line of the table."""
    figures = {k: row[k] for k in ("goal", "cpu_s", "wall_s", "over_bare", "no_end_in_cpu_s", "failed") if k in row}
    shares = ", ".join(f"{part} {100 * share:.0f} %" for part, share in row.get("shares", {}).items() if share >= 0.01)
    return f"{name}: {', '.join(f'{k} {v}' for k, v in figures.items())}{f'; {shares}' if shares else ''}"


if __name__ == "__main__":
    sys.exit(main())
