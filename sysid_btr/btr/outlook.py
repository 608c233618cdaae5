"""What controllers do in drawn models, and what is foreseen of them from that and from the trials."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sysid_btr._typing import FloatArray, IntArray
from sysid_btr.btr.choice import Pool
from sysid_btr.btr.foresight import Drawn, Foresight, foresee
from sysid_btr.btr.problems import Stage
from sysid_btr.btr.trials import Tried
from sysid_btr.estimators.journal import Journal, Record

ASKED = "outcomes"
"""Kind of a journal's record."""
APART = 0.01
"""Root mean square difference, fraction of the range, from which controllers are two."""


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

    def shortlist(self, pool: Pool, count: int) -> Pool:
        """So many of a pool, those worth most, none of which is nearly another one."""
        rows: list[int] = []
        unit = self.unit(pool.controllers)
        for i in np.argsort(-pool.expected, kind="stable"):
            if len(rows) < count and all(np.sqrt(np.mean((unit[i] - unit[j]) ** 2)) > APART for j in rows):
                rows.append(int(i))
        return Pool(pool.controllers[rows], pool.expected[rows])


@dataclass(frozen=True, eq=False)
class Outlook:
    """What was tried, and what may be tried next, in the same drawn models.

    Attributes
    ----------
    controllers : (n, p) of both.
    drawn : what they do.
    asked : (m,) rows of those that may be tried next.
    """

    controllers: FloatArray
    drawn: Drawn
    asked: IntArray

    def foresee(self, made: Sequence[Tried]) -> Foresight:
        """What is foreseen of the next ones, given trials; those of other controllers are passed over."""
        rows = {row.tobytes(): i for i, row in enumerate(self.controllers)}
        known = [(rows[t.controller.values.tobytes()], t) for t in made if t.controller.values.tobytes() in rows]
        real = np.array([t.trial.fitness for _, t in known], dtype=np.float64)
        stood = np.array([t.trial.outcome == "done" for _, t in known], dtype=bool)
        seen = np.array([i for i, _ in known], dtype=np.int64)
        return foresee(self.drawn.of(self.asked), self.drawn.of(seen), real, stood)
