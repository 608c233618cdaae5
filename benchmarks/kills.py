"""`python -m benchmarks.kills`: every verb killed at random moments, with a full disk, and with two writers; resumable.

A command is killed (SIGKILL) at a moment that is drawn between its start and its usual end, and then given again: with
--resume where the verb has it, else with --overwrite. What it then writes must be what it writes undisturbed, to the
bit, but for the time it took. A disk is full where no file may grow beyond some size, drawn too: the command must end
with 2 and one message. Of two that write to one place at the same time one works, and the other is refused or writes
the same. What a verb prints and does not write is kept in a file by the shell.
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

SAMPLES = Path(__file__).resolve().parents[1] / "sample_logs"
OUT = Path(__file__).parent / "results" / "kills.json"
MODEL, LOG = str(SAMPLES / "pendulum.xml"), str(SAMPLES / "pendulum_friction.parquet")
STUDY = ("-m", MODEL, "-l", LOG, "-f", "mass:*", "-f", "kp:*", "--threads", "1")
WALK = ("--robot-sim", "ant", "--robot-set", "mass:*=1.1", "--iterations", "2", "--trials", "2", "--duration", "1")
FIT = ("fit", *STUDY, "-o", "out")
STIFF = ("-m", MODEL, "-l", LOG, "-f", "kp:*", "--threads", "1")
PRINTED = "printed"
"""File for what a command prints to stdout."""
TIMED = ("wall_s",)
"""What a result says of the time it took."""


@dataclass(frozen=True)
class Command:
    """A command, in a folder of its own.

    Attributes
    ----------
    words : of the command line.
    written : file that holds what it found.
    again : flag with which it is given again after a kill.
    first : of commands that come before it.
    """

    words: tuple[str, ...]
    written: str
    again: str = "--overwrite"
    first: tuple[tuple[str, ...], ...] = ()


COMMANDS = {
    "fit": Command(("fit", *STUDY, "-o", "out"), "out/result.json", "--resume"),
    "close": Command(("close", *STUDY, "--effects", "viscous_damping", "-o", "out"), "out/result.json", "--resume"),
    "posterior": Command(("posterior", *STUDY, "--max-evaluations", "600", "-o", "out"), "out/result.json", "--resume"),
    "excite": Command(
        ("excite", "-m", MODEL, "-f", "mass:*", "--seconds", "5", "--max-evaluations", "40", "-o", "out"),
        "out/result.json",
        "--resume",
    ),
    "replay": Command(("replay", "-m", MODEL, "-l", LOG, "-o", "out"), "out/pendulum_friction.replayed.parquet"),
    "import": Command(("import", LOG, "-o", "out.parquet"), "out.parquet"),
    "init": Command(("init", LOG, "-m", MODEL, "-o", "out.toml"), "out.toml"),
    "report": Command(("report", "out"), "out/report.html", "", (FIT,)),
    "check": Command(("check", *STUDY, "--effects", "viscous_damping", "--json"), PRINTED, ""),
    "compare": Command(
        ("compare", "out", "stiff", "-o", "both"), "both/compare.json", first=(FIT, ("fit", *STIFF, "-o", "stiff"))
    ),
    "btr": Command(
        ("btr", "-m", "ant", *WALK, "-f", "mass:Trunk", "--threads", "1", "-o", "out"), "out/result.json", "--resume"
    ),
    "validate": Command(("validate", LOG, "-m", MODEL, "--json"), PRINTED, ""),
    "demo": Command(("demo", "--threads", "1", "-o", "out"), "out/leg/result.json", ""),
}


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; the exit code: 1 if anything was lost, or not the same."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.kills", description=__doc__)
    parser.add_argument("--kills", type=int, default=100, metavar="N", help="kills there are to be in the table")
    parser.add_argument(
        "--seconds", type=float, default=float("inf"), metavar="S", help="begin no more after S seconds"
    )
    parser.add_argument("--out", type=Path, default=OUT, help="table to continue")
    options = parser.parse_args(argv)
    table: dict[str, Any] = {"kills": 0, "verbs": {}, "wrong": []}
    if options.out.exists():
        table = json.loads(options.out.read_text())
    began, whole = time.monotonic(), {}
    while table["kills"] < options.kills and time.monotonic() - began < options.seconds:
        number = table["kills"]
        verb = list(COMMANDS)[number % len(COMMANDS)]
        if verb not in whole:
            whole[verb] = undisturbed(COMMANDS[verb])
        own = table["verbs"].setdefault(verb, {"kills": 0, "before its end": 0, "full disks": 0, "two writers": 0})
        rng = np.random.default_rng(number)
        killed, found = after_a_kill(COMMANDS[verb], whole[verb], float(rng.random()))
        own["kills"] += 1
        own["before its end"] += killed
        problems = [found]
        if own["full disks"] < 2:
            problems.append(on_a_full_disk(COMMANDS[verb], int(10 ** rng.uniform(0, 4))))
            own["full disks"] += 1
        if own["two writers"] < 1:
            problems.append(with_another(COMMANDS[verb], whole[verb]))
            own["two writers"] += 1
        table["wrong"] += [{"kill": number, "verb": verb, "what": what} for what in problems if what]
        table["kills"] += 1
        options.out.write_text(json.dumps(table, indent=1) + "\n")
    print(json.dumps(table, indent=1))
    return 1 if table["wrong"] else 0


@dataclass(frozen=True)
class Whole:
    """What a command writes undisturbed, and the seconds it takes."""

    content: Any
    seconds: float


def undisturbed(command: Command) -> Whole:
    """Run a command in peace."""
    with TemporaryDirectory() as folder:
        _prepare(command, folder)
        began = time.monotonic()
        done = _run(command.words, folder)
        if done.returncode not in (0, 5):
            raise RuntimeError(f"{command.words}: exit {done.returncode}: {done.stderr[-500:]}")
        return Whole(_content(Path(folder, command.written)), time.monotonic() - began)


def after_a_kill(command: Command, whole: Whole, share: float) -> tuple[bool, str]:
    """Kill a command after a share of its time and give it again: whether it was killed, and what is wrong."""
    with TemporaryDirectory() as folder:
        _prepare(command, folder)
        process = subprocess.Popen(
            _words(command.words), cwd=folder, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )
        time.sleep(share * whole.seconds)
        process.kill()
        early = process.wait() < 0
        target = Path(folder, command.written)
        if early and target.exists() and command.again == "--overwrite" and _content(target) != whole.content:
            return early, f"half of {command.written} is there after a kill at {share:.3f}"
        flags = (
            (command.again,) if command.again and (Path(folder) / command.written.partition("/")[0]).exists() else ()
        )
        done = _run((*command.words, *flags), folder)
        return early, _judged(done, target, whole, f"after a kill at {share:.3f}")


def on_a_full_disk(command: Command, size: int) -> str:
    """What is wrong where no file may grow beyond a size, bytes."""
    with TemporaryDirectory() as folder:
        _prepare(command, folder)
        limit = partial(resource.setrlimit, resource.RLIMIT_FSIZE, (size, size))
        done = _run(command.words, folder, limit)
        if done.returncode in (0, 5):
            return ""  # what it writes is smaller
        if done.returncode != 2 or "Traceback" in done.stderr or "cannot" not in done.stderr:
            return f"files of {size} bytes at most: exit {done.returncode}: {done.stderr[-400:]}"
        return ""


def with_another(command: Command, whole: Whole) -> str:
    """What is wrong after two at the same place at the same time."""
    with TemporaryDirectory() as folder:
        _prepare(command, folder)
        pipe: dict[str, Any] = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
        both = [subprocess.Popen(_words(command.words), cwd=folder, **pipe) for _ in range(2)]
        printed, said = zip(*(process.communicate() for process in both), strict=True)
        Path(folder, PRINTED).write_text(printed[0])
        codes = [process.returncode for process in both]
        if not set(codes) <= {0, 2, 5} or set(codes) == {2}:
            return f"two writers: exits {codes}: {said}"
        same = _content(Path(folder, command.written)) == whole.content
        return "" if same else "two writers: what was written is another"


def _judged(done: subprocess.CompletedProcess[str], target: Path, whole: Whole, when: str) -> str:
    if done.returncode not in (0, 5):
        return f"{when}: exit {done.returncode}: {done.stderr[-400:]}"
    return "" if _content(target) == whole.content else f"{when}: {target.name} is another"


def _prepare(command: Command, folder: str) -> None:
    for words in command.first:
        _run(words, folder)


def _words(words: Sequence[str]) -> list[str]:
    return [sys.executable, "-m", "sysid_btr.cli", *words]


def _run(words: Sequence[str], folder: str, before: Any = None) -> subprocess.CompletedProcess[str]:
    done = subprocess.run(_words(words), cwd=folder, capture_output=True, text=True, check=False, preexec_fn=before)
    Path(folder, PRINTED).write_text(done.stdout)
    return done


def _content(path: Path) -> Any:
    """What a file holds, but for the time it took."""
    if path.suffix == ".json":
        return {name: value for name, value in json.loads(path.read_text()).items() if name not in TIMED}
    content = path.read_bytes()
    if path.suffix == ".html":  # which says in several places how long the fit took
        return content.count(b"<tr>"), content.count(b"<img"), content.rstrip().endswith(b"</html>")
    return content


if __name__ == "__main__":
    sys.exit(main())
