"""Where the candidates of a problem are simulated: in this process, unless somebody gives another place."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, TypeAlias

from sysid_btr._typing import FloatArray

Work: TypeAlias = Callable[[Any, FloatArray], FloatArray]
"""Of a problem and candidates (m, p): one row of numbers for each candidate, which does not depend on the others."""

Divide: TypeAlias = Callable[[int], Sequence[tuple[Any, float]]]
"""Gives at most so many problems whose rows side by side are those of the whole one, bit by bit, and each one's share
of the work."""


class Executor(Protocol):
    """Where candidates are simulated."""

    def run(self, work: Work, problem: Any, candidates: FloatArray, divide: Divide | None = None) -> FloatArray:
        """``work(problem, candidates)``, to the last bit, wherever it is done.

        Parameters
        ----------
        work : a function that another process can import.
        problem : its first argument; values that never change.
        candidates : (m, p).
        divide : cuts the problem, where that can be done.
        """
        ...


@dataclass(frozen=True)
class Here:
    """In this process; the number of threads is the problem's own."""

    def run(self, work: Work, problem: Any, candidates: FloatArray, divide: Divide | None = None) -> FloatArray:
        return work(problem, candidates)


HERE = Here()
