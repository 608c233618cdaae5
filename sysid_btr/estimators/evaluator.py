"""The one door between an estimator and its problem."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np

from sysid_btr._typing import FloatArray
from sysid_btr.errors import SysidError, UsageError
from sysid_btr.estimators.base import Budget, FitResult, Problem, Progress, ResidualProblem, Termination, UnitBox
from sysid_btr.estimators.journal import Journal, Record

AT_BOUND = 1e-6
"""A parameter closer than this fraction of its range to a bound is reported as at the bound."""


class Stop(BaseException):
    """Raised by the evaluator to end a search; `drive` turns it into the result.

    No `Exception`, like `KeyboardInterrupt`: code that catches errors of a search must not catch its end.
    """

    def __init__(self, termination: Termination) -> None:
        super().__init__(termination.value)
        self.termination = termination


@dataclass(frozen=True, eq=False)
class Reduced:
    """What a reduction kept of a batch of residuals.

    Attributes
    ----------
    loss
        Shape ``(m,)``; ``inf`` where the candidate failed.
    arrays
        Small arrays, journalled.
    attachment
        Gives the large array the reduction asked to keep.
    """

    loss: FloatArray
    arrays: Mapping[str, FloatArray]
    attachment: Callable[[], FloatArray]


Reduction = Callable[[FloatArray], tuple[dict[str, FloatArray], FloatArray | None]]
"""Residuals ``(m, r)`` to small arrays and, where wanted, one large array to keep."""


class Evaluator:
    """Owns bounds, failed candidates, budget, best-so-far, journal, progress and interruption.

    Candidates are clipped to the bounds before they are simulated, recorded or remembered as the best, so
    nothing outside is ever simulated or returned. Non-finite losses become ``inf``. A batch that the budget
    of evaluations cannot pay for is cut, and ends the search.

    Parameters
    ----------
    problem, budget, journal, progress
        As given to `Estimator.fit`. The journal is rewound.

    Raises
    ------
    UsageError
        Bounds or start of the problem cannot be used; names the parameters.
    """

    def __init__(self, problem: Problem, *, budget: Budget, journal: Journal, progress: Progress) -> None:
        _check_problem(problem)
        self.problem = problem
        self.box = UnitBox(problem.lower.copy(), problem.upper.copy())
        self.start = problem.start.astype(np.float64, copy=True)
        self.budget = budget
        self.evaluations = 0
        self.best_x = self.start
        self.best_loss = np.inf
        self.history: list[tuple[int, float]] = []
        self._journal = journal
        self._journal.rewind()
        self._progress = progress
        self._earlier_seconds = journal.seconds
        self._begun = time.monotonic()

    @property
    def seconds(self) -> float:
        """Wall time of the fit, earlier runs of the journal included."""
        return self._earlier_seconds + time.monotonic() - self._begun

    @property
    def remaining(self) -> int | None:
        """Evaluations the budget still pays for; None if unlimited."""
        return None if self.budget.evaluations is None else self.budget.evaluations - self.evaluations

    def loss(self, candidates: FloatArray, note: str = "") -> FloatArray:
        """Losses ``(m,)`` of candidates ``(m, p)``; ``inf`` where a candidate failed.

        Raises
        ------
        Stop
            The budget is spent (best-so-far includes what it paid for), or the user interrupted.
        """
        asked = self._admit(candidates)
        paid = asked if self.remaining is None else asked[: self.remaining]
        losses = np.empty(0)
        while len(losses) < len(paid):
            rest = paid[len(losses) :]
            record = self._journal.replay("loss", rest, whole=False)
            if record is None:
                self._check_time(losses, paid, note)
                record = self._simulate_loss(rest)
                self._journal.append(record)
            losses = np.append(losses, record.arrays["loss"][: len(rest)])
        self._account(paid, losses, note)
        if len(paid) < len(asked):
            raise Stop(Termination.BUDGET_SPENT)
        return losses

    def reduce(
        self,
        problem: ResidualProblem,
        candidates: FloatArray,
        reduction: Reduction,
        note: str = "",
        shapes: Mapping[str, tuple[int, ...]] = MappingProxyType({}),
    ) -> Reduced:
        """Residuals of candidates ``(m, p)``, reduced to what the estimator needs of them: arrays of given `shapes`.

        Residuals are large; only what `reduction` returns is kept and journalled. It is called only for
        batches that are simulated now, not for replayed ones. A batch the budget cannot pay for in full is
        not begun.

        Raises
        ------
        UsageError
            The journal holds other arrays.
        """
        asked = self._admit(candidates)
        if self.remaining is not None and len(asked) > self.remaining:
            raise Stop(Termination.BUDGET_SPENT)
        record = self._journal.replay("residuals", asked, whole=True)
        if record is None:
            self._check_time(np.empty(0), asked, note)
            rows = self._simulate(problem.residuals, asked)
            if rows.ndim != 2 or len(rows) != len(asked):
                raise SysidError(f"the problem returned residuals of shape {rows.shape} for {len(asked)} candidates")
            with np.errstate(over="ignore", invalid="ignore"):
                loss = _finite_or_inf(np.einsum("ij,ij->i", rows, rows))
            arrays, large = reduction(rows)
            record = Record("residuals", asked, {**arrays, "loss": loss}, self.seconds)
            self._journal.append(record, large)
        elif any(name not in record.arrays or record.arrays[name].shape != shape for name, shape in shapes.items()):
            raise UsageError(
                f"record {self._journal.position} of the journal does not hold what this search keeps: the file was "
                "changed. Start over (--overwrite)"
            )
        number = self._journal.position - 1
        self._account(asked, record.arrays["loss"], note)
        return Reduced(record.arrays["loss"], record.arrays, lambda: self._journal.attachment(number))

    def again(self, function: Callable[[FloatArray], FloatArray], candidates: FloatArray) -> FloatArray:
        """What a function gives for candidates that were accounted for before; not journalled.

        For arrays that a journal does not hold.
        """
        return self._simulate(function, self._admit(candidates))

    def _admit(self, candidates: FloatArray) -> FloatArray:
        asked = np.ascontiguousarray(candidates, dtype=np.float64)
        if asked.ndim != 2 or asked.shape[1] != len(self.start) or not np.all(np.isfinite(asked)):
            raise ValueError(f"candidates must be finite and of shape (m, {len(self.start)}), not {asked.shape}")
        return np.clip(asked, self.box.lower, self.box.upper)

    def _check_time(self, losses: FloatArray, paid: FloatArray, note: str) -> None:
        if self.budget.seconds is not None and self.seconds >= self.budget.seconds:
            self._account(paid[: len(losses)], losses, note)
            raise Stop(Termination.BUDGET_SPENT)

    def _simulate(self, function: Callable[[FloatArray], FloatArray], candidates: FloatArray) -> FloatArray:
        try:
            # A copy, so that a problem that writes into its argument cannot falsify the journal.
            return np.asarray(function(candidates.copy()), dtype=np.float64)
        except KeyboardInterrupt:
            raise Stop(Termination.INTERRUPTED) from None

    def _simulate_loss(self, candidates: FloatArray) -> Record:
        losses = self._simulate(self.problem.loss, candidates)
        if losses.shape != (len(candidates),):
            raise SysidError(f"the problem returned losses of shape {losses.shape} for {len(candidates)} candidates")
        return Record("loss", candidates, {"loss": _finite_or_inf(losses)}, self.seconds)

    def _account(self, candidates: FloatArray, losses: FloatArray, note: str) -> None:
        if not len(losses):
            return
        self.evaluations += len(losses)
        i = int(np.argmin(losses))
        if losses[i] < self.best_loss:
            self.best_x, self.best_loss = candidates[i].copy(), float(losses[i])
            self.history.append((self.evaluations, self.best_loss))
        self._progress(done=self.evaluations, total=self.budget.evaluations, best=self.best_loss, note=note)


@dataclass(frozen=True, eq=False)
class Outcome:
    """How a search ended; without `x` the best candidate seen is the answer."""

    termination: Termination
    x: FloatArray | None = None
    loss: float = np.inf
    jacobian: FloatArray | None = None
    residual: FloatArray | None = None


def drive(
    problem: Problem, search: Callable[[Evaluator], Outcome], *, budget: Budget, journal: Journal, progress: Progress
) -> FitResult:
    """Run a search to its end, a spent budget or an interruption, and make the result.

    Parameters
    ----------
    search
        Searches through the evaluator it is given; may be left at any evaluation by `Stop`.
    """
    evaluator = Evaluator(problem, budget=budget, journal=journal, progress=progress)
    try:
        outcome = search(evaluator)
    except Stop as stop:
        outcome = Outcome(stop.termination)
    except KeyboardInterrupt:
        outcome = Outcome(Termination.INTERRUPTED)
    x, loss = outcome.x, outcome.loss
    if x is None:
        x, loss = evaluator.best_x, evaluator.best_loss
    termination = outcome.termination
    if not np.isfinite(loss) and termination is not Termination.INTERRUPTED:
        termination = Termination.NO_FINITE_CANDIDATE
    u = evaluator.box.enter(x)
    return FitResult(
        x=x,
        loss=float(loss),
        evaluations=evaluator.evaluations,
        termination=termination,
        converged=termination is Termination.CONVERGED,
        at_bound=(u < AT_BOUND) | (u > 1.0 - AT_BOUND),
        jacobian=outcome.jacobian,
        residual=outcome.residual,
        history=tuple(evaluator.history),
        seconds=evaluator.seconds,
        names=tuple(problem.names),
    )


def _finite_or_inf(losses: FloatArray) -> FloatArray:
    return np.where(np.isfinite(losses), losses, np.inf)


def _check_problem(problem: Problem) -> None:
    names, lower, upper, start = problem.names, problem.lower, problem.upper, problem.start
    p = len(names)
    if p == 0:
        raise UsageError("there is nothing to fit: name at least one parameter (--fit)")
    if not (lower.shape == upper.shape == start.shape == (p,)):
        raise UsageError(
            f"{p} parameters are named, but the shapes of lower, upper and start are "
            f"{lower.shape}, {upper.shape} and {start.shape}"
        )
    faults = []
    for name, low, high, value in zip(names, lower, upper, start, strict=True):
        if not (np.isfinite(low) and np.isfinite(high) and low < high):
            faults.append(f"{name}: bounds [{low:g}, {high:g}] must be finite and lower < upper")
        elif not low <= value <= high:
            faults.append(f"{name}: start {value:g} is outside its bounds [{low:g}, {high:g}]")
    if faults:
        raise UsageError("the parameters cannot be fitted:\n  " + "\n  ".join(faults))
