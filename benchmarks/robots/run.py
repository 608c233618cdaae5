"""Runs of the command line, each in a process of its own with a time limit."""

from __future__ import annotations

import json
import resource
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
VERB = "import sys; from sysid_btr.cli import main; main(sys.argv[1:])"
FINISHED = (0, 5)
"""Exit codes after which there is a result; 5: a verdict that asks for more."""


@dataclass(frozen=True)
class Run:
    """What a run left.

    Attributes
    ----------
    code : exit code; None where the time was up.
    result : content of result.json, or what `--json` printed, or empty.
    said : the end of its messages.
    seconds, cpu : wall and processor time.
    """

    code: int | None
    result: dict[str, Any]
    said: str
    seconds: float
    cpu: float

    @property
    def came_to_a_result(self) -> bool:
        """Whether it ended by itself and wrote its result."""
        return self.code in FINISHED and bool(self.result)


def run(arguments: Sequence[str], out: Path, limit: float) -> Run:
    """One verb with its arguments; results go to `out`, which is replaced."""
    command = [sys.executable, "-c", VERB, *arguments, "--threads", "2", "--out", str(out), "--overwrite"]
    began, cpu = perf_counter(), _cpu()
    try:
        done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=limit)
        code, said, printed = done.returncode, done.stderr, done.stdout
    except subprocess.TimeoutExpired as late:
        code, said, printed = None, _text(late.stderr), ""
    seconds = perf_counter() - began
    written = out / "result.json"
    # an earlier result is not this run's
    text = written.read_text() if written.is_file() else printed if "--json" in arguments else "{}"
    result = json.loads(text) if code in FINISHED else {}
    lines = [line.strip() for line in said.replace("\r", "\n").splitlines() if line.strip()]
    return Run(code, result, " ".join(lines[-4:])[-600:], seconds, _cpu() - cpu)


def _cpu() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def _text(said: bytes | str | None) -> str:
    return said.decode(errors="replace") if isinstance(said, bytes) else said or ""
