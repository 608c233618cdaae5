"""Which controllers are tried on the robot (Step 2)."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from sysid_btr._typing import FloatArray
from sysid_btr.errors import UsageError
from sysid_btr.estimators.journal import Record


@dataclass(frozen=True, eq=False)
class Pool:
    """Controllers that a search came by, best of the last generation first, then those of the one before.

    Attributes
    ----------
    controllers : (n, p), each once.
    expected : (n,) fitness in the model of the search.
    """

    controllers: FloatArray
    expected: FloatArray


def pool_of(records: Sequence[Record], known: set[bytes]) -> Pool:
    """Distinct controllers of a search without those already tried; the best of all is always the first."""
    seen = set(known)
    rows: list[FloatArray] = []
    losses: list[float] = []

    def take(candidates: FloatArray, values: FloatArray) -> None:
        for i in np.argsort(values, kind="stable"):
            key = candidates[i].tobytes()
            if np.isfinite(values[i]) and key not in seen:
                seen.add(key)
                rows.append(candidates[i])
                losses.append(float(values[i]))

    everything = [(r.candidates, r.arrays["loss"]) for r in records]
    best = min(everything, key=lambda pair: float(np.min(pair[1])), default=None)
    if best is not None:
        i = int(np.argmin(best[1]))
        take(best[0][i : i + 1], best[1][i : i + 1])
    for candidates, values in reversed(everything):
        take(candidates, values)
    width = everything[0][0].shape[1] if everything else 0
    return Pool(np.array(rows).reshape(len(rows), width), -np.array(losses))


class Choice(Protocol):
    """How the controllers to be tried are chosen."""

    def __call__(self, pool: Pool, count: int, rivals: Callable[[FloatArray], FloatArray]) -> list[int]:
        """Rows of at most `count` controllers; `rivals` gives their fitness (k, m) in k candidate models."""
        ...


def fittest(pool: Pool, count: int, rivals: Callable[[FloatArray], FloatArray]) -> list[int]:
    """In order of descending expected fitness, generation by generation from the last (the paper)."""
    return list(range(min(count, len(pool.expected))))


SHORTLIST = 4
"""Times as many controllers as are tried are looked at for disagreement."""


def disagreement(pool: Pool, count: int, rivals: Callable[[FloatArray], FloatArray]) -> list[int]:
    """The fittest one, and of the fittest those on whose fitness candidate models disagree most.

    Estimation-Exploration: Bongard and Lipson 2005, doi:10.1109/TEVC.2005.850293.
    """
    order = np.argsort(-pool.expected, kind="stable")[: SHORTLIST * count]
    if len(order) <= count:
        return [int(i) for i in order]
    fitness = rivals(pool.controllers[order])
    spread = np.nan_to_num(np.std(fitness, axis=0), nan=np.inf) if len(fitness) > 1 else np.zeros(len(order))
    spread[0] = np.inf
    return [int(order[i]) for i in np.argsort(-spread, kind="stable")[:count]]


CHOICES: Mapping[str, Choice] = {"fittest": fittest, "disagreement": disagreement}


def get_choice(name: str) -> Choice:
    """A choice by name.

    Raises
    ------
    UsageError
        Listing what there is.
    """
    if name not in CHOICES:
        raise UsageError(f"unknown choice of trials {name!r}; available: {', '.join(CHOICES)}")
    return CHOICES[name]
