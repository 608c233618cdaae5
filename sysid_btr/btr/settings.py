"""What the loop may spend, and how it searches and decides."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

from sysid_btr.btr.choice import get_choice
from sysid_btr.btr.problems import FITNESS
from sysid_btr.btr.robust import Risk
from sysid_btr.errors import UsageError
from sysid_btr.estimators.base import Estimator
from sysid_btr.estimators.chain import needs_residuals
from sysid_btr.estimators.cma_es import CmaEs
from sysid_btr.estimators.ga import GeneticAlgorithm
from sysid_btr.objectives.distance import get_distance

LIKELIHOOD = "likelihood"
"""The distance by which Step 3 compares the sensors sample by sample, whatever the ground does."""
FLIPS, BITS = 4.3, 8
"""Bits by which a controller's children differ from it on average, and bits of each of its numbers."""


def controller_search(numbers: int = 36) -> GeneticAlgorithm:
    """Step 1 as in the paper's Fig. 3: 11 generations of 20, by a few mutations of the last controller.

    Parameters
    ----------
    numbers : of a controller.
    """
    mutation = min(max(round(FLIPS / (BITS * numbers), 3), 0.001), 0.5)
    return GeneticAlgorithm(population=20, generations=11, bits=BITS, mutation=mutation)


def first_controller_search() -> GeneticAlgorithm:
    """Step 1 of the first iteration: far from the controller known beforehand, which may not move at all."""
    return GeneticAlgorithm(population=20, generations=11, bits=BITS)


def cma_controller_searches(generations: int = 20) -> tuple[CmaEs, CmaEs]:
    """Step 1 by CMA-ES, in the first iteration and in the others: about twice as long as in the paper's Fig. 3."""
    far = CmaEs(sigma=0.3, population=20, max_generations=generations)
    return far, replace(far, sigma=0.1)


def model_search() -> CmaEs:
    """Step 3 with as many models as in the paper's Fig. 3, 11 generations of 15, but distinguished more finely."""
    return CmaEs(population=15, max_generations=11, sigma=0.15)


def papers_model_search() -> GeneticAlgorithm:
    """Step 3 as in the paper's Fig. 3: 11 generations of 15."""
    return GeneticAlgorithm(population=15, generations=11, bits=10)


@dataclass(frozen=True)
class Settings:
    """What the loop may spend and how it decides.

    Attributes
    ----------
    iterations : at most.
    trials : controllers tried in each (m in the paper); with a distance of sensors one or two will do.
    first, controllers : Step 1 in the first iteration and in the others.
    models : Step 3; least squares needs a likelihood.
    distance : of Step 3: ``phi1``, ``phi2[:BINS]``, ``mse`` or ``wasserstein`` of whole trials, or the ``likelihood``
        of their logs whatever the ground does; what earlier trials said is its prior.
    choice : of trials, ``fittest``, ``disagreement`` or ``improvement``.
    draws : models that Step 1 runs controllers in, drawn from what is believed, the ground's softness and friction and
        late commands among it; 1 is the believed model alone, as in the paper.
    risk : how falls and the worst of these models count.
    worthwhile : fitness that another trial must promise for the loop to go on; None goes on.
    memory : trials that Step 3 explains, the newest first; those before are taken evenly.
    rivals : candidate models that may disagree.
    requirement : real fitness with which the work is done.
    close : look for missing effects where Step 3 cannot explain the robot's logs.
    correct : leave the model as it is and correct its fitness linearly instead (a baseline).
    learn : let Step 3 correct the model; without, trials count in what is foreseen alone.
    """

    iterations: int = 13
    trials: int = 12
    first: Estimator = field(default_factory=first_controller_search)
    controllers: Estimator = field(default_factory=controller_search)
    models: Estimator = field(default_factory=model_search)
    distance: str = FITNESS
    choice: str = "fittest"
    draws: int = 1
    risk: Risk = field(default_factory=Risk)
    worthwhile: float | None = None
    memory: int = 12
    rivals: int = 5
    requirement: float | None = None
    close: bool = False
    correct: bool = False
    learn: bool = True

    def __post_init__(self) -> None:
        if min(self.iterations, self.trials, self.memory, self.rivals, self.draws) < 1:
            raise UsageError("btr: iterations, trials, memory, rivals and draws must be at least 1")
        if self.draws == 1 and (self.choice == "improvement" or self.worthwhile is not None):
            raise UsageError("btr: what another trial may gain is computed in drawn models: take at least 2 draws")
        if self.draws > 1 and self.correct:
            raise UsageError("btr: the linear correction is of one model's fitness; take 1 draw")
        if self.close and (self.correct or not self.learn):
            raise UsageError(
                "btr: effects are added only to a model that the trials correct: not with a linear correction, nor "
                "without Step 3"
            )
        if needs_residuals(self.models) and self.distance != LIKELIHOOD:
            raise UsageError(f"btr: least squares minimises a likelihood; give --distance {LIKELIHOOD}, or cmaes or ga")
        get_choice(self.choice)
        if self.distance != FITNESS:
            get_distance(self.distance)

    @property
    def by_likelihood(self) -> bool:
        """Whether the model is corrected by a likelihood."""
        return self.distance == LIKELIHOOD and self.learn and not self.correct
