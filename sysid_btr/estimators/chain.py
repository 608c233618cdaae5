"""Estimators in a row: a search that finds the right valley, then one that finds its bottom."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from sysid_btr._typing import FloatArray
from sysid_btr.errors import UsageError
from sysid_btr.estimators.base import (
    Budget,
    Derived,
    Estimator,
    FitResult,
    Problem,
    Progress,
    Termination,
    require_residuals,
    uses_residuals,
)
from sysid_btr.estimators.journal import Journal

if TYPE_CHECKING:
    from numpy.random import Generator


@dataclass(frozen=True)
class Chain:
    """Several estimators one after the other, each from the best point so far.

    The budget is shared and the journal is one, so a chain is resumed like any estimator.

    Parameters
    ----------
    stages
        Estimators in their order.
    patience
        Evaluations, times the number of parameters plus one, after which a stage that is not the last hands
        over whether it has converged or not.

    Notes
    -----
    The patience of a stage does not depend on the budget: a run resumed with a larger one would otherwise
    differ from a run that had it from the beginning.
    """

    stages: tuple[Estimator, ...]
    patience: int = 100

    def __post_init__(self) -> None:
        if len(self.stages) < 2:
            raise UsageError("a chain of estimators needs at least two, for example 'cmaes+lsq'")
        if self.patience < 1:
            raise UsageError("chain: patience must be at least 1")

    @property
    def name(self) -> str:
        """The stages' names, joined by ``+``."""
        return "+".join(stage.name for stage in self.stages)

    def fit(
        self, problem: Problem, *, rng: Generator, budget: Budget, journal: Journal, progress: Progress
    ) -> FitResult:
        """Minimise the loss of `problem`; residual and Jacobian are those of the last stage, if it has them.

        Raises
        ------
        UsageError
            A stage cannot take the problem; said before the first begins.
        """
        if needs_residuals(self):
            require_residuals(problem, self.name)
        return self._run(len(self.stages), problem, rng, budget, journal, progress)

    def explore(
        self, problem: Problem, *, rng: Generator, budget: Budget, journal: Journal, progress: Progress
    ) -> tuple[FitResult, Estimator, Budget]:
        """The result of all stages but the last, what goes on from it, and the budget left for that.

        For those who do something between the search and its last stage, with ``journal.section()``. Where there is
        nothing to go on with, because of an interruption or an empty budget, it is an estimator that just answers
        with the result.
        """
        found = self._run(len(self.stages) - 1, problem, rng, budget, journal, progress)
        left = None if budget.evaluations is None else budget.evaluations - found.evaluations
        if found.termination is Termination.INTERRUPTED or left == 0:
            return found, Finished(found if left else _unfinished(found)), budget
        return found, self.stages[-1], replace(budget, evaluations=left)

    def _run(
        self, count: int, problem: Problem, rng: Generator, budget: Budget, journal: Journal, progress: Progress
    ) -> FitResult:
        journal.rewind()
        spent: FitResult | None = None
        for i in range(count):
            left = None if budget.evaluations is None else budget.evaluations - (spent.evaluations if spent else 0)
            share = self._share(i, len(problem.lower), left)
            if spent is not None and share == 0:
                return _unfinished(spent)
            part = self._stage(i).fit(
                problem if spent is None else _From(problem, spent.x),
                rng=rng,
                budget=replace(budget, evaluations=share),
                journal=journal.section(),
                progress=self._report(i, spent, budget, progress),
            )
            spent = part if spent is None else _joined(spent, part)
            # a stage that its own patience ended hands over; one that the budget ended does not
            out_of_budget = part.termination is Termination.BUDGET_SPENT and share == left
            if out_of_budget or part.termination is Termination.INTERRUPTED:
                break
        assert spent is not None
        return spent

    def _stage(self, i: int) -> Estimator:
        stage = self.stages[i]
        # nobody asks for the Jacobian of one that is not the last, and a journal keeps only the latest
        return stage.unconfirmed() if i + 1 < len(self.stages) and uses_residuals(stage) else stage

    def _share(self, i: int, p: int, left: int | None) -> int | None:
        if i + 1 == len(self.stages):
            return left
        patience = self.patience * (p + 1)
        return patience if left is None else min(left, patience)

    def _report(self, i: int, spent: FitResult | None, budget: Budget, progress: Progress) -> Progress:
        before, floor = (0, float("inf")) if spent is None else (spent.evaluations, spent.loss)
        name = self.stages[i].name

        def report(*, done: int, total: int | None, best: float, note: str) -> None:
            del total
            noted = f"{name}: {note}" if note else name
            progress(done=before + done, total=budget.evaluations, best=min(best, floor), note=noted)

        return report


def needs_residuals(estimator: Estimator) -> bool:
    """Whether an estimator, or a stage of it, minimises squared residuals."""
    return any(map(needs_residuals, estimator.stages)) if isinstance(estimator, Chain) else uses_residuals(estimator)


@dataclass(frozen=True)
class Finished:
    """An estimator that knows the answer already."""

    result: FitResult
    name: str = "finished"

    def fit(
        self, problem: Problem, *, rng: Generator, budget: Budget, journal: Journal, progress: Progress
    ) -> FitResult:
        """The answer."""
        del problem, rng, budget, journal, progress
        return self.result


def _unfinished(spent: FitResult) -> FitResult:
    """The result of a chain whose last stages the budget cannot pay for."""
    if spent.termination is Termination.NO_FINITE_CANDIDATE:
        return spent
    return replace(spent, termination=Termination.BUDGET_SPENT, converged=False)


def _joined(before: FitResult, after: FitResult) -> FitResult:
    """The result of a search and of the one that went on from its best point."""
    better = tuple((before.evaluations + n, v) for n, v in after.history if v < before.loss)
    return replace(
        after if after.loss <= before.loss else before,
        evaluations=before.evaluations + after.evaluations,
        termination=after.termination,
        converged=after.converged,
        history=(*before.history, *better),
        seconds=after.seconds,
    )


@dataclass(frozen=True, eq=False)
class _From(Derived):
    """A problem with another start; whatever else it offers is passed on."""

    problem: Problem
    point: FloatArray

    @property
    def start(self) -> FloatArray:
        return self.point

    def loss(self, candidates: FloatArray) -> FloatArray:
        return self.problem.loss(candidates)

    def __getattr__(self, name: str) -> Any:
        return getattr(self.problem, name)
