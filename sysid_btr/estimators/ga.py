"""The genetic algorithm of Back-to-Reality: binary genomes, seeded by the best solution known.

Zagal and Ruiz-del-Solar describe it in section 3.3 of "Self-modeling in humanoid soccer robots" (2009): a
population of about 30 is made by mutating a given solution, each bit with probability ``p_m``, and evolves by
selection in order of descending fitness. Fitness is the negative loss here.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from sysid_btr._typing import BoolArray, FloatArray, IntArray
from sysid_btr.errors import UsageError
from sysid_btr.estimators.base import Budget, FitResult, Problem, Progress, Termination
from sysid_btr.estimators.evaluator import Evaluator, Outcome, drive
from sysid_btr.estimators.journal import Journal

if TYPE_CHECKING:
    from numpy.random import Generator


@dataclass(frozen=True, eq=False)
class _Genome:
    """Gray-coded numbers of `bits` bits, on a grid over the bounds that passes through the start."""

    lower: FloatArray
    upper: FloatArray
    start: FloatArray
    bits: int

    @property
    def _cell(self) -> FloatArray:
        cell: FloatArray = (self.upper - self.lower) / (2**self.bits - 1)
        return cell

    @property
    def _start_code(self) -> IntArray:
        code: IntArray = np.rint((self.start - self.lower) / self._cell).astype(np.int64)
        return code

    def encode_start(self) -> BoolArray:
        """The start's genome, shape ``(p * bits,)``; it decodes to the start exactly."""
        code = self._start_code
        gray = code ^ (code >> 1)
        genes: BoolArray = ((gray[:, None] >> np.arange(self.bits)) & 1).astype(bool).ravel()
        return genes

    def decode(self, genes: BoolArray) -> FloatArray:
        """Parameters ``(m, p)`` of genomes ``(m, p * bits)``, within the bounds."""
        gray = genes.reshape(len(genes), len(self.start), self.bits).astype(np.int64)
        # Undo the Gray code: each bit is the parity of itself and all higher ones.
        binary = np.cumsum(gray[..., ::-1], axis=-1)[..., ::-1] % 2
        code = (binary << np.arange(self.bits)).sum(axis=-1)
        x: FloatArray = np.clip(self.start + (code - self._start_code) * self._cell, self.lower, self.upper)
        return x


@dataclass(frozen=True)
class GeneticAlgorithm:
    """Binary genetic algorithm with rank selection, uniform crossover, bit mutation and elitism.

    Parameters
    ----------
    population
        Individuals in a generation (M).
    generations
        Generations at most; None leaves it to `patience` and the budget.
    mutation
        Probability that a bit flips (p_m), in the first population and in every child. None: one flip per
        parameter on average in the first population, one per genome in a child.
    crossover
        Probability that a child has two parents.
    survivors
        Fraction of the population that may become parents, best first.
    elite
        Best individuals carried over as they are, and not simulated again.
    bits
        Resolution of a parameter: its range in ``2**bits - 1`` steps.
    patience
        Converged when the best has not improved for this many generations. The algorithm cannot know more: it
        may be a local minimum.
    """

    population: int = 30
    generations: int | None = None
    mutation: float | None = None
    crossover: float = 0.7
    survivors: float = 0.6
    elite: int = 2
    bits: int = 16
    patience: int = 25

    def __post_init__(self) -> None:
        if not 0 < self.elite < self.population:
            raise UsageError("ga: population must be larger than elite, and elite at least 1")
        if not 1 <= self.bits <= 48:
            raise UsageError("ga: bits must be in 1..48")
        if not (0.0 <= self.crossover <= 1.0 and 0.0 < self.survivors <= 1.0):
            raise UsageError("ga: crossover must be in [0, 1] and survivors in (0, 1]")
        if self.mutation is not None and not 0.0 < self.mutation < 1.0:
            raise UsageError("ga: mutation is a probability in (0, 1)")
        if self.patience < 1 or (self.generations is not None and self.generations < 1):
            raise UsageError("ga: patience and generations must be at least 1")

    @property
    def name(self) -> str:
        """``ga``."""
        return "ga"

    def fit(
        self, problem: Problem, *, rng: Generator, budget: Budget, journal: Journal, progress: Progress
    ) -> FitResult:
        """Minimise the loss of `problem`, from its start."""

        def search(evaluator: Evaluator) -> Outcome:
            return self._evolve(evaluator, rng)

        return drive(problem, search, budget=budget, journal=journal, progress=progress)

    def _evolve(self, evaluator: Evaluator, rng: Generator) -> Outcome:
        genome = _Genome(evaluator.box.lower, evaluator.box.upper, evaluator.start, self.bits)
        length = len(evaluator.start) * self.bits
        # The first individual is the start itself.
        genes = np.tile(genome.encode_start(), (self.population, 1))
        genes[1:] ^= rng.random((self.population - 1, length)) < (self.mutation or 1.0 / self.bits)
        losses = evaluator.loss(genome.decode(genes), "generation 1")
        generation, waited = 1, 0
        while waited < self.patience:
            if generation == self.generations:
                return Outcome(Termination.ITERATION_LIMIT)
            generation += 1
            before = evaluator.best_loss
            order = np.argsort(losses, kind="stable")
            elite = order[: self.elite]
            children = self._children(genes[order], rng)
            child_losses = evaluator.loss(genome.decode(children), f"generation {generation}")
            genes = np.concatenate([genes[elite], children])
            losses = np.concatenate([losses[elite], child_losses])
            waited = 0 if evaluator.best_loss < before else waited + 1
        return Outcome(Termination.CONVERGED)

    def _children(self, ranked: BoolArray, rng: Generator) -> BoolArray:
        """Children of the population, best first; linear ranking among the survivors."""
        n, length = self.population - self.elite, ranked.shape[1]
        parents = max(1, round(self.survivors * self.population))
        weights = np.arange(parents, 0, -1, dtype=np.float64)
        pairs = rng.choice(parents, size=(2, n), p=weights / weights.sum())
        from_second = (rng.random((n, length)) < 0.5) & (rng.random((n, 1)) < self.crossover)
        children: BoolArray = np.where(from_second, ranked[pairs[1]], ranked[pairs[0]])
        return children ^ (rng.random((n, length)) < (self.mutation or 1.0 / length))
