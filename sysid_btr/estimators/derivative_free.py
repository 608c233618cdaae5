"""The derivative-free algorithms of NLopt (Johnson, https://nlopt.readthedocs.io), in the unit cube."""

from __future__ import annotations

from dataclasses import dataclass
from importlib import import_module
from typing import TYPE_CHECKING, Any

import numpy as np

from sysid_btr._typing import FloatArray
from sysid_btr.errors import UsageError
from sysid_btr.estimators.base import Budget, FitResult, Problem, Progress, Termination
from sysid_btr.estimators.evaluator import Evaluator, Outcome, drive
from sysid_btr.estimators.journal import Journal
from sysid_btr.estimators.starting import finite_start

if TYPE_CHECKING:
    from numpy.random import Generator

LOCAL = ("LN_BOBYQA", "LN_COBYLA", "LN_NELDERMEAD", "LN_PRAXIS", "LN_SBPLX")
GLOBAL = ("GN_CRS2_LM", "GN_DIRECT", "GN_DIRECT_L", "GN_DIRECT_L_RAND", "GN_ESCH", "GN_ISRES", "GN_MLSL_LDS")
ALGORITHMS = LOCAL + GLOBAL
_INSTEAD_OF_CMA = "'cmaes', 'nlopt:GN_CRS2_LM', 'nlopt:GN_ISRES', 'nlopt:GN_ESCH'"


@dataclass(frozen=True)
class NLopt:
    """One algorithm of NLopt; candidates are simulated one at a time.

    Parameters
    ----------
    algorithm
        One of `ALGORITHMS`: ``LN_`` finds the minimum near the start; ``GN_`` searches the whole box until
        budget or `max_evaluations` end it, and never calls itself converged.
    tolerance
        Relative change of the loss at which a local search has converged.
    step_tolerance
        Step, fraction of the range, at which a local search has converged.
    initial_step
        First step of a local search, fraction of the range.
    max_evaluations
        Evaluations at most. None leaves it to the budget, or is ``500 (p + 1)`` where that sets no number.

    Raises
    ------
    UsageError
        Unknown algorithm; the message names the nearest ones.
    """

    algorithm: str = "LN_BOBYQA"
    tolerance: float = 1e-8
    step_tolerance: float = 1e-7
    initial_step: float = 0.1
    max_evaluations: int | None = None

    def __post_init__(self) -> None:
        if self.algorithm not in ALGORITHMS:
            raise UsageError(_refusal(self.algorithm))
        if not 0.0 < self.initial_step <= 1.0:
            raise UsageError("nlopt: initial_step is a fraction of the range in (0, 1]")
        if self.max_evaluations is not None and self.max_evaluations < 1:
            raise UsageError("nlopt: max_evaluations must be at least 1")

    @property
    def name(self) -> str:
        """``nlopt:`` and the algorithm."""
        return f"nlopt:{self.algorithm}"

    def fit(
        self, problem: Problem, *, rng: Generator, budget: Budget, journal: Journal, progress: Progress
    ) -> FitResult:
        """Minimise the loss of `problem`.

        Notes
        -----
        NLopt's own random numbers belong to the process: they are seeded from `rng` here, so two fits in
        threads of one process disturb each other's reproducibility.
        """

        def search(evaluator: Evaluator) -> Outcome:
            return self._search(evaluator, rng)

        return drive(problem, search, budget=budget, journal=journal, progress=progress)

    def _search(self, evaluator: Evaluator, rng: Generator) -> Outcome:
        nlopt = import_module("nlopt")
        p = len(evaluator.start)
        nlopt.srand(int(rng.integers(1, 2**31)))
        found = finite_start(evaluator, rng)
        if found is None:
            return Outcome(Termination.NO_FINITE_CANDIDATE)
        u, loss = found
        objective = _Objective(evaluator, loss)
        optimiser = self._optimiser(nlopt, self.algorithm, p)
        limit = self.max_evaluations or (0 if evaluator.budget.evaluations else 500 * (p + 1))
        optimiser.set_maxeval(limit)  # 0: none
        objective.attach(optimiser)
        try:
            optimiser.optimize(u)
            code = optimiser.last_optimize_result()
        except (nlopt.RoundoffLimited, nlopt.roundoff_limited):
            code = nlopt.XTOL_REACHED  # the search is as fine as floats are: as good as it gets
        except (nlopt.ForcedStop, nlopt.exception, RuntimeError, ValueError):
            code = nlopt.FAILURE
        # What ended the search inside an evaluation is raised here: NLopt loses exceptions.
        if objective.raised is not None:
            raise objective.raised
        if code == nlopt.MAXEVAL_REACHED:
            return Outcome(Termination.ITERATION_LIMIT)
        return Outcome(Termination.CONVERGED if code > 0 else Termination.GAVE_UP)

    def _optimiser(self, nlopt: Any, algorithm: str, p: int) -> Any:
        optimiser = nlopt.opt(getattr(nlopt, algorithm), p)
        optimiser.set_lower_bounds(np.zeros(p))
        optimiser.set_upper_bounds(np.ones(p))
        optimiser.set_initial_step(self.initial_step)
        if algorithm in LOCAL:  # two close points say nothing about the rest of the box
            optimiser.set_ftol_rel(self.tolerance)
            optimiser.set_xtol_abs(np.full(p, self.step_tolerance))
        if algorithm == "GN_MLSL_LDS":
            optimiser.set_local_optimizer(self._optimiser(nlopt, "LN_BOBYQA", p))
        return optimiser


class _Objective:
    """The loss as NLopt calls it: one candidate, always finite, and an exception kept until NLopt is left."""

    def __init__(self, evaluator: Evaluator, start_loss: float) -> None:
        self._evaluator = evaluator
        self._optimiser: Any = None
        self.raised: BaseException | None = None
        self._worst = start_loss

    def attach(self, optimiser: Any) -> None:
        """Become the objective of `optimiser`."""
        self._optimiser = optimiser
        optimiser.set_min_objective(self)

    def __call__(self, u: FloatArray, _gradient: FloatArray) -> float:
        if not np.all(np.isfinite(u)):  # the algorithm lost its way
            self._optimiser.force_stop()
            return self._penalty
        try:
            loss = float(self._evaluator.loss(self._evaluator.box.leave(u)[None])[0])
        except BaseException as error:
            self.raised = error
            self._optimiser.force_stop()
            return self._penalty
        if not np.isfinite(loss):
            return self._penalty
        self._worst = max(self._worst, loss)
        return loss

    @property
    def _penalty(self) -> float:
        """Worse than all seen, yet finite: models of the loss survive it."""
        return 2.0 * abs(self._worst) + self._worst + 1.0


def _refusal(algorithm: str) -> str:
    if algorithm.upper().startswith("CMA"):
        return (
            f"NLopt has no CMA-ES, so 'nlopt:{algorithm}' does not exist. Use {_INSTEAD_OF_CMA}, "
            "or 'cmaes' and from its result 'nlopt:LN_BOBYQA'"
        )
    if "D_" in algorithm[:3].upper():
        return (
            f"'nlopt:{algorithm}' needs gradients, which a simulation does not give: use 'lsq', which takes "
            "differences, or 'nlopt:LN_BOBYQA'"
        )
    from difflib import get_close_matches

    close = get_close_matches(algorithm.upper(), ALGORITHMS, n=3, cutoff=0.4)
    hint = f" Did you mean {' or '.join(close)}?" if close else ""
    return f"there is no derivative-free algorithm 'nlopt:{algorithm}'.{hint} There are {', '.join(ALGORITHMS)}"
