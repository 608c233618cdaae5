"""One thing that is wrong with a log, and how several are told to a person."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, get_args

Severity = Literal["error", "warning", "note"]


@dataclass(frozen=True)
class Problem:
    """Something wrong with a log.

    Attributes
    ----------
    code : str
        Stable name of the kind of problem, e.g. ``"time.duplicate"``.
    severity : {"error", "warning", "note"}
        An error makes the log unusable as it is; a warning is worth looking into; a note says how the log is read.
    where : str
        Column, sample range or time.
    message : str
        What is wrong.
    remedy : str
        What to do next.
    """

    code: str
    severity: Severity
    where: str
    message: str
    remedy: str

    def __str__(self) -> str:
        return f"{self.severity} [{self.code}] {self.where}: {self.message}\n    -> {self.remedy}"


def worst_first(problems: Sequence[Problem]) -> tuple[Problem, ...]:
    """Errors, then warnings, then notes, each in the order in which they were found."""
    return tuple(sorted(problems, key=lambda problem: get_args(Severity).index(problem.severity)))


def errors_of(problems: Sequence[Problem]) -> tuple[Problem, ...]:
    """The problems that make the log unusable."""
    return tuple(problem for problem in problems if problem.severity == "error")


def explain(path: object, problems: Sequence[Problem]) -> str:
    """Text that lists `problems` of the log at `path`, one numbered entry each."""
    count = "1 problem" if len(problems) == 1 else f"{len(problems)} problems"
    lines = [f"{path} cannot be used: {count}"]
    lines += [f"  {i}. {problem}" for i, problem in enumerate(problems, start=1)]
    return "\n".join(lines)
