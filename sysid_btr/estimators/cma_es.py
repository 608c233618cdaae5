"""CMA-ES in the unit cube of the bounds (Hansen 2016, arXiv:1604.00772), on the library `cmaes`."""

from __future__ import annotations

from dataclasses import dataclass
from importlib import import_module
from typing import TYPE_CHECKING, Protocol

import numpy as np

from sysid_btr._typing import FloatArray
from sysid_btr.errors import UsageError
from sysid_btr.estimators.base import Budget, FitResult, Problem, Progress, Termination
from sysid_btr.estimators.evaluator import Evaluator, Outcome, drive
from sysid_btr.estimators.journal import Journal
from sysid_btr.estimators.starting import finite_start

if TYPE_CHECKING:
    from numpy.random import Generator

_HOPELESS = 10  # generations without a finite candidate


class _Optimiser(Protocol):
    """What is used of the library's CMA and SepCMA."""

    @property
    def population_size(self) -> int: ...

    def ask(self) -> FloatArray: ...

    def tell(self, solutions: list[tuple[FloatArray, float]]) -> None: ...

    def should_stop(self) -> bool: ...


@dataclass(frozen=True)
class CmaEs:
    """Covariance matrix adaptation; needs only losses.

    Parameters
    ----------
    sigma
        First standard deviation of the search, fraction of the range.
    population
        Candidates a generation; None: ``4 + floor(3 ln p)``. Doubled at each restart (IPOP, Auger and Hansen
        2005, doi:10.1109/CEC.2005.1554902).
    restarts
        Searches from random points after the first has converged.
    separable
        Adapt only the diagonal of the covariance: for many parameters.
    max_generations
        Of one search.
    """

    sigma: float = 0.2
    population: int | None = None
    restarts: int = 0
    separable: bool = False
    max_generations: int = 2000

    def __post_init__(self) -> None:
        if not 0.0 < self.sigma <= 1.0:
            raise UsageError("cmaes: sigma is a fraction of the range in (0, 1]")
        if self.population is not None and self.population < 5:
            raise UsageError("cmaes: population must be at least 5")
        if self.restarts < 0 or self.max_generations < 1:
            raise UsageError("cmaes: restarts must not be negative, and max_generations at least 1")

    @property
    def name(self) -> str:
        """``cmaes``."""
        return "cmaes"

    def fit(
        self, problem: Problem, *, rng: Generator, budget: Budget, journal: Journal, progress: Progress
    ) -> FitResult:
        """Minimise the loss of `problem`, from its start."""

        def search(evaluator: Evaluator) -> Outcome:
            return self._search(evaluator, rng)

        return drive(problem, search, budget=budget, journal=journal, progress=progress)

    def _search(self, evaluator: Evaluator, rng: Generator) -> Outcome:
        p = len(evaluator.start)
        found = finite_start(evaluator, rng)
        mean = evaluator.box.enter(evaluator.start) if found is None else found[0]
        population = self.population or 4 + int(3 * np.log(max(p, 2)))
        termination = Termination.CONVERGED
        for restart in range(self.restarts + 1):
            optimiser = self._optimiser(mean, population * 2**restart, rng)
            termination = self._run(evaluator, optimiser, p, f"search {restart + 1}")
            mean = rng.random(p)
        return Outcome(termination)

    def _optimiser(self, mean: FloatArray, population: int, rng: Generator) -> _Optimiser:
        # The library needs two dimensions: a lone parameter gets an idle companion.
        padded = np.append(mean, 0.5) if len(mean) == 1 else mean
        bounds = np.tile([0.0, 1.0], (len(padded), 1))
        library = import_module("cmaes")
        kind = library.SepCMA if self.separable else library.CMA
        seed = int(rng.integers(2**32))
        optimiser: _Optimiser = kind(padded, self.sigma, bounds=bounds, population_size=population, seed=seed)
        return optimiser

    def _run(self, evaluator: Evaluator, optimiser: _Optimiser, p: int, note: str) -> Termination:
        failures = 0
        for generation in range(1, self.max_generations + 1):
            asked = np.array([optimiser.ask() for _ in range(optimiser.population_size)])
            losses = evaluator.loss(evaluator.box.leave(asked[:, :p]), f"{note}, generation {generation}")
            failures = 0 if np.isfinite(losses).any() else failures + 1
            if failures == _HOPELESS:
                return Termination.GAVE_UP
            optimiser.tell(list(zip(asked, _rankable(losses), strict=True)))
            if optimiser.should_stop():
                return Termination.CONVERGED
        return Termination.ITERATION_LIMIT


def _rankable(losses: FloatArray) -> list[float]:
    """Finite stand-ins for failed candidates, the worst of all: only ranks matter, but `inf` gives NaN."""
    finite = losses[np.isfinite(losses)]
    worst = 1.0 if not len(finite) else float(np.nextafter(2.0 * abs(finite.max()) + finite.max(), np.inf))
    return [float(value) for value in np.where(np.isfinite(losses), losses, worst)]
