"""What controllers do in drawn models, and what is foreseen of them from that and from the trials."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from sysid_btr._typing import BoolArray, FloatArray, IntArray
from sysid_btr.btr.choice import Pool
from sysid_btr.btr.foresight import Drawn, Foresight, foresee
from sysid_btr.btr.problems import Stage
from sysid_btr.btr.trials import Tried
from sysid_btr.estimators.journal import Journal, Record

ASKED = "outcomes"
"""Kind of a journal's record."""
APART = 0.01
"""Root mean square difference, fraction of the range, from which controllers are two."""
OTHERWISE = 0.1
"""Probability that a trial on the robot goes another way than in the right model: it falls, stands or loses its step
where that does not. So no single trial decides which models are believed."""
OFF = 0.2
"""Standard deviation of real fitness about that of the right model, over the fitness of trials."""
LEFT = 0.25
"""Share of the models that must go on to count: a few trials do not single out one of many."""


@dataclass(frozen=True, eq=False)
class Imagination:
    """Models that are believed in.

    Attributes
    ----------
    stage : what runs them; its parameters are all that is not known.
    models : (k, q) drawn ones, the likeliest first.
    """

    stage: Stage
    models: FloatArray

    def unit(self, controllers: FloatArray) -> FloatArray:
        """Controllers (n, p) in fractions of their ranges."""
        space = self.stage.space
        return np.asarray((controllers - space.lower) / (space.upper - space.lower))

    def outcomes(self, controllers: FloatArray, journal: Journal) -> Drawn:
        """What controllers (n, p) do in all models, unless the journal knows."""
        record = journal.replay(ASKED, controllers, whole=True)
        if record is None:
            fitness, fell = self.stage.outcomes(controllers, self.models)
            found = {"loss": -fitness.mean(axis=0), "fitness": fitness.T, "fell": fell.T.astype(np.float64)}
            record = Record(ASKED, controllers, found, 0.0)
            journal.append(record)
        return Drawn(self.unit(controllers), record.arrays["fitness"].T, record.arrays["fell"].T > 0)

    def only(self, rows: IntArray) -> Imagination:
        """Some of the models."""
        return Imagination(self.stage, self.models[rows])

    def shortlist(self, pool: Pool, count: int, apart: float = APART) -> Pool:
        """So many of a pool, those worth most, none of which is nearly another one."""
        rows: list[int] = []
        unit = self.unit(pool.controllers)
        for i in np.argsort(-pool.expected, kind="stable"):
            if len(rows) < count and all(np.sqrt(np.mean((unit[i] - unit[j]) ** 2)) > apart for j in rows):
                rows.append(int(i))
        return Pool(pool.controllers[rows], pool.expected[rows])


def log_weights(tried: Drawn, real: FloatArray, stood: BoolArray) -> FloatArray:
    """How much the trials speak for each model, (k,), by fitness and falls (the paper's phi1 as a likelihood).

    The models are samples of what was believed before (importance sampling); the weights are tempered so far that
    enough of them count (Neal 2001, doi:10.1023/A:1008923215028).

    Parameters
    ----------
    tried : what the controllers of trials do in the models, (k, t).
    real, stood : (t,) what they did on the robot; of one that fell only that counts.
    """
    up = ~tried.fell & np.isfinite(tried.fitness)
    scale = OFF * float(np.sqrt(np.mean(real[stood] ** 2))) if stood.any() else 0.0
    off = np.where(up & stood, tried.fitness - real, 0.0) / (scale or 1.0)
    alike = np.where(up == stood, np.exp(-0.5 * off**2), 0.0)
    evidence = np.sum(np.log((1 - OTHERWISE) * alike + OTHERWISE), axis=1)
    evidence = evidence - evidence.max()
    temper = 1.0
    while _count(temper * evidence) < LEFT * len(evidence):
        temper *= 0.9
    return np.asarray(temper * evidence)


def _count(evidence: FloatArray) -> float:
    """Effective number of models with these logarithmic weights."""
    weight = np.exp(evidence)
    return float(weight.sum() ** 2 / (weight @ weight))


@dataclass(eq=False)
class Cloud:
    """Many models drawn from what is believed, and what was tried on the robot in all of them.

    Attributes
    ----------
    drawn : the models.
    tried : trials whose controllers ran in them.
    done : what these do there, (k, t).
    """

    drawn: Imagination
    tried: list[Tried] = field(default_factory=list)
    done: Drawn | None = None

    def learn(self, made: Sequence[Tried], journal: Journal) -> int:
        """Run the controllers of trials that are new; the number of simulations."""
        new = made[len(self.tried) :]
        if not new:
            return 0
        found = self.drawn.outcomes(np.array([t.controller.values for t in new]), journal)
        self.done = found if self.done is None else self.done.beside(found)
        self.tried.extend(new)
        return len(new) * len(self.drawn.models)

    def pick(self, count: int, rng: np.random.Generator) -> IntArray:
        """So many of the models, by the weight that the trials give them; the likeliest first."""
        if self.done is None:
            return np.arange(count)
        real = np.array([t.trial.fitness for t in self.tried])
        weights = log_weights(self.done, real, np.array([t.trial.outcome == "done" for t in self.tried]))
        # without replacement (Efraimidis and Spirakis 2006, doi:10.1016/j.ipl.2005.11.003)
        rows = np.argsort(-(weights + rng.gumbel(size=len(weights))), kind="stable")[:count]
        return np.asarray(rows[np.argsort(-weights[rows], kind="stable")])


@dataclass(frozen=True, eq=False)
class Outlook:
    """What was tried, and what may be tried next, in the same drawn models.

    Attributes
    ----------
    controllers : (n, p) of both.
    drawn : what they do.
    asked : (m,) rows of those that may be tried next.
    falls : whether a trial can fail.
    """

    controllers: FloatArray
    drawn: Drawn
    asked: IntArray
    falls: bool

    def foresee(self, made: Sequence[Tried]) -> Foresight:
        """What is foreseen of the next ones, given trials; those of other controllers are passed over."""
        rows = {row.tobytes(): i for i, row in enumerate(self.controllers)}
        known = [(rows[t.controller.values.tobytes()], t) for t in made if t.controller.values.tobytes() in rows]
        real = np.array([t.trial.fitness for _, t in known], dtype=np.float64)
        stood = np.array([t.trial.outcome == "done" for _, t in known], dtype=bool)
        seen = np.array([i for i, _ in known], dtype=np.int64)
        found = foresee(self.drawn.of(self.asked), self.drawn.of(seen), real, stood)
        return found if self.falls else replace(found, stands=np.ones(len(found.stands)))
