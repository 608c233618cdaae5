"""Step 3 by a likelihood: the trials' first seconds, biased by the last model."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from sysid_btr._typing import FloatArray
from sysid_btr.estimators.base import Derived
from sysid_btr.estimators.chain import Chain
from sysid_btr.estimators.lsq import LeastSquares
from sysid_btr.objectives.problem import ReplayProblem

PULL = 0.3
"""Standard deviation, fraction of its last value, within which a parameter is expected to lie."""
FAR = 5e-2
"""Finite-difference step, fraction of the range, that sees over what impacts do to a trial."""


@dataclass(frozen=True, eq=False)
class MapProblem(Derived):
    """Step 3 by a likelihood: the beginnings of the trials, biased by the last model (maximum a posteriori).

    The bias is a Gaussian prior about the last model: parameters about which a few trials are not informative stay
    where they were.

    Attributes
    ----------
    problem : the fitted trials of a study; it begins at the last model.
    share : of a whole trial that is simulated.
    """

    problem: ReplayProblem
    share: float = 1.0

    @property
    def runs(self) -> float:
        return self.share * len(self.problem.episodes)

    @cached_property
    def width(self) -> FloatArray:
        """(p,) standard deviation of the prior."""
        return np.maximum(PULL * np.abs(self.start), self.problem.scale)

    def residuals(self, candidates: FloatArray) -> FloatArray:
        """Whitened residuals (m, r + p) of candidates (m, p); those of the prior come last."""
        residuals = self.problem.residuals(candidates)
        pull = (np.atleast_2d(candidates) - self.start) / self.width
        pull[np.isnan(residuals).any(axis=1)] = np.nan
        return np.hstack([residuals, pull])

    def loss(self, candidates: FloatArray) -> FloatArray:
        """Sum of squared residuals (m,); NaN where a candidate diverged."""
        return np.asarray(np.sum(self.residuals(candidates) ** 2, axis=1))


def model_fit() -> Chain:
    """Least squares for the beginnings of trials of a robot that walks.

    Impacts roughen them: differences over wide steps find the valley, fine ones what of its bottom can be found.
    """
    fine = LeastSquares(confirm=False, max_iterations=8, tolerance=1e-4)
    return Chain((replace(fine, forward_step=FAR), fine))
