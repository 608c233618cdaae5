"""What is known of a model: a mean and how far from it the truth may lie, and models drawn from that."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sysid_btr._typing import FloatArray
from sysid_btr.terms.base import Parameter, Term
from sysid_btr.terms.model import Terms

WIDTH = 3.0
"""Standard deviation of a parameter before anything is known, in changes that matter (`Parameter.scale`)."""


@dataclass(frozen=True, eq=False)
class Belief:
    """A normal distribution of a model's parameters, cut off at their bounds.

    Attributes
    ----------
    parameters : what they are, (p,).
    mean, covariance : (p,), (p, p).

    Raises
    ------
    ValueError
        If the shapes do not belong together.
    """

    parameters: tuple[Parameter, ...]
    mean: FloatArray
    covariance: FloatArray

    def __post_init__(self) -> None:
        p = len(self.parameters)
        if self.mean.shape != (p,) or self.covariance.shape != (p, p):
            raise ValueError(f"{p} parameters have a mean {self.mean.shape} and a covariance {self.covariance.shape}")

    @classmethod
    def before(cls, terms: Sequence[Term], width: float = WIDTH) -> Belief:
        """What is believed before any trial: about the nominal values, independently.

        Parameters
        ----------
        terms : of the model.
        width : standard deviation, in the parameters' scales.
        """
        found = Terms(terms)
        return cls(found.parameters, found.nominal, np.diag((width * found.scale) ** 2))

    @property
    def std(self) -> FloatArray:
        """(p,) standard deviations, without regard to the bounds."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))

    def beside(self, other: Belief) -> Belief:
        """Both, independent of each other."""
        p, q = len(self.mean), len(other.mean)
        covariance = np.zeros((p + q, p + q))
        covariance[:p, :p], covariance[p:, p:] = self.covariance, other.covariance
        return Belief((*self.parameters, *other.parameters), np.concatenate([self.mean, other.mean]), covariance)

    def draws(self, rng: np.random.Generator, count: int) -> FloatArray:
        """Models (count, p) within the bounds, spread evenly (a Latin hypercube).

        One parameter after the other, each given those before it and cut off at its bounds (Geweke, Hajivassiliou,
        Keane; doi:10.1016/0304-4076(94)01716-6): exact where they are independent.
        """
        from scipy.linalg import cholesky
        from scipy.special import ndtr, ndtri

        p = len(self.mean)
        lower = np.array([q.lower for q in self.parameters])
        upper = np.array([q.upper for q in self.parameters])
        # a parameter that is known exactly has no spread; the factor needs a little
        root = cholesky(self.covariance + np.diag(1e-24 + 1e-12 * np.diag(self.covariance)), lower=True)
        cells = rng.permuted(np.tile(np.arange(count)[:, None], (1, p)), axis=0)
        even = (cells + rng.random((count, p))) / count
        normal = np.zeros((count, p))
        result = np.empty((count, p))
        for i in range(p):
            middle = self.mean[i] + normal[:, :i] @ root[i, :i]
            low, high = ndtr((lower[i] - middle) / root[i, i]), ndtr((upper[i] - middle) / root[i, i])
            # the mean may lie beyond a bound by many deviations
            normal[:, i] = ndtri(np.clip(low + even[:, i] * (high - low), 1e-16, 1 - 1e-16))
            result[:, i] = np.clip(middle + normal[:, i] * root[i, i], lower[i], upper[i])
        return result
