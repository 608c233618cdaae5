"""What is known of a model's derivatives when a fit of it with something more begins."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from sysid_btr._typing import FloatArray
from sysid_btr.estimators.linearisation import Known, differences
from sysid_btr.identify.prior import MapProblem
from sysid_btr.identify.study import Study
from sysid_btr.objectives.problem import ReplayProblem
from sysid_btr.terms.model import Model


@dataclass(frozen=True, eq=False)
class Beginning:
    """A model to which one thing after another is added, each beside all that it has.

    Its derivatives are simulated once, by the cheap integrator, when first asked for. Whatever joins it changes them
    little to begin with, and least squares measure anew where a step shows otherwise.

    Attributes
    ----------
    study : in which it is fitted.
    model : as it was fitted last.
    """

    study: Study
    model: Model

    @cached_property
    def _problem(self) -> ReplayProblem:
        """With errors over the noise floor."""
        return replace(self.study, inflation={}).train_problem(self.model).with_numerics(self.study.cheap)

    @cached_property
    def _columns(self) -> FloatArray:
        """(p, r) derivatives of errors over the noise floor."""
        return differences(self._problem, self.model.values, self.study.stencil(self.model.terms))

    @cached_property
    def _usable(self) -> bool:
        """Not where starts are uncertain, as whitening then depends on how columns are weighed."""
        return len(self.model.values) > 0 and all(e.marginal is None for e in self._problem.episodes)

    @property
    def evaluations(self) -> int:
        """Candidates that its derivatives take; a resumed run, which may need none, counts them too."""
        return 1 + len(self.model.values) if self._usable else 0

    def known(self, problem: ReplayProblem | MapProblem) -> Known | None:
        """What is known of the derivatives of a problem whose parameters begin with those of the model."""
        if not self._usable:
            return None
        replays = problem.problem if isinstance(problem, MapProblem) else problem
        own, size = len(self.model.values), len(problem.start)

        def columns() -> FloatArray:
            found = np.zeros((size, replays.count))
            found[:own] = self._columns / np.sqrt(replays.inflation)[replays.column_labels]
            return np.hstack([found, _slopes(problem)]) if isinstance(problem, MapProblem) else found

        return Known(np.arange(size) < own, columns)


def _slopes(problem: MapProblem) -> FloatArray:
    """(p, k) derivatives of what a belief adds to the residuals, which is linear."""
    size = len(problem.start)
    points = np.vstack([np.zeros(size), np.eye(size)])
    pull = problem.belief.whitened(points)
    return np.asarray(pull[1:] - pull[0])
