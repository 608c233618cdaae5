"""Which controllers are tried on the robot (Step 2)."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from sysid_btr._typing import BoolArray, FloatArray
from sysid_btr.btr.foresight import Foresight
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


@dataclass(frozen=True, eq=False)
class Offer:
    """Controllers that may be tried next, and what is known of them.

    Attributes
    ----------
    pool : of the search, best of the last generation first.
    rivals : gives the fitness (k, m) of controllers (m, p) in k candidate models.
    foresight : of the pool, given all trials so far; None where there is one model only.
    near : (n,) whether a controller is near enough to what has worked.
    best : largest fitness of a trial that stood; zero before, for a robot that stays as it is.
    """

    pool: Pool
    rivals: Callable[[FloatArray], FloatArray]
    foresight: Foresight | None = None
    near: BoolArray | None = None
    best: float = 0.0


class Choice(Protocol):
    """How the controllers to be tried are chosen, one after the other."""

    def __call__(self, offer: Offer, taken: Sequence[int], count: int) -> int | None:
        """Row of the next controller, not one of those `taken` in this iteration, of `count`; None if none is left."""
        ...


def fittest(offer: Offer, taken: Sequence[int], count: int) -> int | None:
    """In order of descending expected fitness, generation by generation from the last (the paper)."""
    return next((i for i in range(len(offer.pool.expected)) if i not in taken), None)


SHORTLIST = 4
"""Times as many controllers as are tried are looked at for disagreement."""


def disagreement(offer: Offer, taken: Sequence[int], count: int) -> int | None:
    """The fittest one, and of the fittest those on whose fitness candidate models disagree most.

    Estimation-Exploration: Bongard and Lipson 2005, doi:10.1109/TEVC.2005.850293.
    """
    order = np.argsort(-offer.pool.expected, kind="stable")[: SHORTLIST * count]
    fitness = offer.rivals(offer.pool.controllers[order])
    spread = np.nan_to_num(np.std(fitness, axis=0), nan=np.inf) if len(fitness) > 1 else np.zeros(len(order))
    spread[:1] = np.inf
    return next((int(i) for i in order[np.argsort(-spread, kind="stable")] if i not in taken), None)


SAFE = 0.7
"""Chance to stand that a controller should have, if there is one that does."""


def improvement(offer: Offer, taken: Sequence[int], count: int) -> int | None:
    """The largest expected improvement times the chance to stand, of what is near enough to what has worked.

    Bayesian optimisation under a constraint (Gelbart et al. 2014, arXiv 1403.5607).
    """
    if offer.foresight is None:
        raise UsageError("btr: the choice 'improvement' compares drawn models: take at least 2 draws")
    free = np.ones(len(offer.pool.expected), dtype=bool)
    free[list(taken)] = False
    stands = offer.foresight.stands
    for wish in (offer.near, stands >= min(SAFE, float(np.max(stands[free], initial=0.0)))):
        if wish is not None and (free & wish).any():
            free &= wish
    if not free.any():
        return None
    return int(np.argmax(np.where(free, offer.foresight.improvement(offer.best), -np.inf)))


CHOICES: Mapping[str, Choice] = {"fittest": fittest, "disagreement": disagreement, "improvement": improvement}


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
