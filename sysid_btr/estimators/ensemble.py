"""Ensemble sampling with emcee (Foreman-Mackey et al. 2013, doi:10.1086/670067), behind the estimators' contract.

Walkers live in an unbounded space, the logit of the unit cube of the bounds, so that no proposal is ever outside
and a parameter at its bound is only a long tail. Densities carry the Jacobian of that change of variables.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from sysid_btr._typing import FloatArray
from sysid_btr.errors import UsageError
from sysid_btr.estimators.base import Budget, FitResult, Problem, Progress, Termination, require_residuals
from sysid_btr.estimators.evaluator import Evaluator, Outcome, drive
from sysid_btr.estimators.journal import Journal
from sysid_btr.estimators.starting import finite_start
from sysid_btr.optional import optional

if TYPE_CHECKING:
    from numpy.random import Generator

FAILED = -1e300
"""Log density of a candidate that failed: as good as none, but differences of it are numbers."""
_EDGE = 1e-12
_FIRST_CHECK = 40
_CHECK_GROWTH = 1.2

LogDensity = Callable[[FloatArray], FloatArray]


def unbounded(u: FloatArray) -> FloatArray:
    """The unit cube to the unbounded space of the walkers: the logit."""
    inside = np.clip(u, _EDGE, 1.0 - _EDGE)
    return np.asarray(np.log(inside) - np.log1p(-inside))


def bounded(v: FloatArray) -> FloatArray:
    """The walkers' space back to the unit cube."""
    return np.asarray(0.5 * (1.0 + np.tanh(0.5 * v)))


def log_jacobian(v: FloatArray) -> FloatArray:
    """``log |du/dv|`` of points (m, p), summed over parameters, (m,)."""
    return -np.asarray(np.sum(np.logaddexp(0.0, v) + np.logaddexp(0.0, -v), axis=1))


def folded(u: FloatArray) -> FloatArray:
    """Points reflected at the faces of the unit cube until they are inside."""
    inside = np.mod(u, 2.0)
    return np.where(inside > 1.0, 2.0 - inside, inside)


def walkers_for(p: int, asked: int | None) -> int:
    """Number of walkers for `p` parameters: even, and enough that each half of them spans the space.

    Raises
    ------
    UsageError
        Fewer are asked for.
    """
    least = max(2 * (p + 1), 8)
    if asked is None:
        return least
    if asked < least or asked % 2:
        raise UsageError(f"{p} parameters need an even number of at least {least} walkers, not {asked}")
    return asked


def new_sampler(walkers: int, p: int, log_density: LogDensity, moves: Any = None) -> Any:
    """An emcee sampler of a vectorised density of points (m, p).

    Raises
    ------
    UsageError
        emcee is not installed.
    """
    emcee = optional("emcee", "posterior", "ensemble sampling")
    sampler = emcee.EnsembleSampler(walkers, p, log_density, vectorize=True, moves=moves)
    # not emcee's wrapper, which prints whatever passes through it, the end of a search included
    sampler.log_prob_fn = log_density
    return sampler


def seeded(coordinates: FloatArray, rng: Generator) -> Any:
    """A start for a sampler: coordinates (walkers, p), and random numbers that follow from `rng`."""
    emcee = optional("emcee", "posterior", "ensemble sampling")
    twister = np.random.MT19937(int(rng.integers(2**63)))
    state: Any = twister.state["state"]
    return emcee.State(coordinates, random_state=("MT19937", state["key"], state["pos"], 0, 0.0))


def autocorrelation_time(chain: FloatArray) -> FloatArray:
    """Integrated autocorrelation time (p,) in steps of a chain (steps, walkers, p); at least 1.

    Goodman and Weare 2010, doi:10.2140/camcos.2010.5.65; the estimator with Sokal's window is emcee's. Infinite
    where nothing moved.
    """
    emcee = optional("emcee", "posterior", "ensemble sampling")
    if len(chain) < 2:
        return np.full(chain.shape[2], np.inf)
    moving = np.ptp(chain, axis=0) > 0
    tau = np.full(chain.shape[2], np.inf)
    for j in np.flatnonzero(moving.any(axis=0)):
        series = chain[:, moving[:, j], j]
        # a walker that never moved is as correlated as can be
        stuck = float(np.mean(~moving[:, j]))
        measured = float(emcee.autocorr.integrated_time(series, tol=0, quiet=True)[0])
        tau[j] = max(1.0, measured) * (1.0 - stuck) + stuck * len(chain)
    return tau


@dataclass(frozen=True)
class Ensemble:
    """The affine-invariant ensemble sampler as an estimator: it answers with the best point that it saw.

    It draws from ``exp(-loss / 2)``, uniform within the bounds, and ends when it has explored that: after so many
    autocorrelation times. For the distribution itself, with priors, several ensembles and checks, see
    `sysid_btr.posterior`.

    Parameters
    ----------
    walkers
        Even, at least ``2 (p + 1)``; None: that, and at least 8.
    spread
        Standard deviation of the walkers' start about the problem's, fraction of the range.
    autocorrelation_times
        Converged when the second half of the chain is that long.
    max_steps
        Moves of every walker at most.
    """

    walkers: int | None = None
    spread: float = 0.1
    autocorrelation_times: float = 50.0
    max_steps: int = 5000

    def __post_init__(self) -> None:
        if not 0.0 < self.spread <= 1.0:
            raise UsageError("emcee: spread is a fraction of the range in (0, 1]")
        if self.max_steps < 1 or not self.autocorrelation_times > 0.0:
            raise UsageError("emcee: max_steps must be at least 1, and autocorrelation_times positive")

    @property
    def name(self) -> str:
        """``emcee``."""
        return "emcee"

    def fit(
        self, problem: Problem, *, rng: Generator, budget: Budget, journal: Journal, progress: Progress
    ) -> FitResult:
        """Explore ``exp(-loss / 2)`` of `problem` from its start.

        Raises
        ------
        UsageError
            The problem has no residuals, so that its loss is no likelihood; too few walkers; emcee is missing.
        """
        likelihood = require_residuals(problem, self.name)

        def search(evaluator: Evaluator) -> Outcome:
            return self._search(evaluator, rng)

        return drive(likelihood, search, budget=budget, journal=journal, progress=progress)

    def _search(self, evaluator: Evaluator, rng: Generator) -> Outcome:
        p = len(evaluator.start)
        walkers = walkers_for(p, self.walkers)
        found = finite_start(evaluator, rng)
        if found is None:
            return Outcome(Termination.NO_FINITE_CANDIDATE)
        steps = 0

        def log_density(v: FloatArray) -> FloatArray:
            loss = evaluator.loss(evaluator.box.leave(bounded(v)), f"step {steps}")
            return np.where(np.isfinite(loss), -0.5 * loss, FAILED) + log_jacobian(v)

        begin = folded(found[0] + self.spread * rng.standard_normal((walkers, p)))
        sampler = new_sampler(walkers, p, log_density)
        check = _FIRST_CHECK
        for _ in sampler.sample(seeded(unbounded(begin), rng), iterations=self.max_steps):
            steps += 1
            if steps >= check:
                check = int(np.ceil(_CHECK_GROWTH * check))
                half = bounded(sampler.get_chain(discard=steps // 2))
                if len(half) >= self.autocorrelation_times * float(autocorrelation_time(half).max()):
                    return Outcome(Termination.CONVERGED)
        return Outcome(Termination.ITERATION_LIMIT)
