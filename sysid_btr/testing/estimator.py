"""The checks that every estimator must pass."""

from __future__ import annotations

import tempfile
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from sysid_btr._typing import FloatArray
from sysid_btr.errors import UsageError
from sysid_btr.estimators.base import (
    Budget,
    Derived,
    Estimator,
    FitResult,
    Problem,
    Progress,
    ResidualProblem,
    Termination,
    silent,
    uses_residuals,
)
from sysid_btr.estimators.chain import needs_residuals
from sysid_btr.estimators.journal import Journal
from sysid_btr.testing.problems import (
    LossOnly,
    ToyProblem,
    bound_active,
    exponential_decay,
    failing_region,
    hopeless,
    linear_gaussian,
    lone_parameter,
    rank_deficient,
    rosenbrock,
)
from sysid_btr.testing.require import require

_SEED = 20
_EVALUATIONS = 240
_SLACK = 1e-5  # a converged estimator may answer with a point this much worse than a neighbour it looked at


class Killed(BaseException):
    """What a power cut looks like from inside a simulation."""


@dataclass(eq=False)
class Witness(Derived):
    """A problem that remembers what it was asked, and may raise instead of answering.

    Attributes
    ----------
    answered
        Candidates simulated so far, in order.
    losses
        Their losses.
    limit
        A batch that would exceed this number of candidates raises `fault`.
    """

    problem: ResidualProblem
    limit: float = np.inf
    fault: BaseException | None = None
    answered: list[FloatArray] = field(default_factory=list)
    losses: list[float] = field(default_factory=list)

    def loss(self, candidates: FloatArray) -> FloatArray:
        """Losses, remembered."""
        self._admit(candidates)
        losses = self.problem.loss(candidates)
        self._remember(candidates, losses)
        return losses

    def residuals(self, candidates: FloatArray) -> FloatArray:
        """Residuals, remembered."""
        self._admit(candidates)
        rows = self.problem.residuals(candidates)
        self._remember(candidates, (rows**2).sum(axis=1))
        return rows

    def _admit(self, candidates: FloatArray) -> None:
        if self.fault is not None and len(self.answered) + len(candidates) > self.limit:
            raise self.fault

    def _remember(self, candidates: FloatArray, losses: FloatArray) -> None:
        self.answered += list(candidates.copy())
        self.losses += [float(value) if np.isfinite(value) else np.inf for value in losses]

    def asked(self) -> bytes:
        """All candidates, bit by bit."""
        return b"".join(candidate.tobytes() for candidate in self.answered)

    def goes_on(self, earlier: Witness, kept: int, whole: Witness, *, again: int) -> bool:
        """Whether `earlier` began as `whole` did, and this was asked the rest, in order.

        Parameters
        ----------
        earlier, kept : what was asked before, and how many of these candidates the journal holds.
        whole : what is asked without interruption.
        again : how often each of those that it holds may be asked again in between: an estimator of residuals may
            need arrays of them, which a journal does not hold.
        """
        had, every = ([c.tobytes() for c in part] for part in (earlier.answered, whole.answered))
        if had != every[: len(had)]:
            return False
        rest = every[kept:]
        repeated = Counter({candidate: again * count for candidate, count in Counter(had[:kept]).items()})
        for candidate in (c.tobytes() for c in self.answered):
            if rest and candidate == rest[0]:
                rest = rest[1:]
            elif repeated[candidate] > 0:
                repeated[candidate] -= 1
            else:
                return False
        return not rest


def check_estimator(estimator: Estimator) -> None:
    """Run every check of `ESTIMATOR_CHECKS` on an estimator.

    Raises
    ------
    AssertionError
        The first promise of the contract that is not kept.
    """
    for check in ESTIMATOR_CHECKS:
        check(estimator)


def run(
    estimator: Estimator,
    problem: Problem,
    *,
    evaluations: int | None = _EVALUATIONS,
    journal: Journal | None = None,
    progress: Progress = silent,
    seed: int = _SEED,
) -> FitResult:
    """Fit with a fresh generator of the given seed."""
    return estimator.fit(
        problem,
        rng=np.random.default_rng(seed),
        budget=Budget(evaluations=evaluations),
        journal=Journal() if journal is None else journal,
        progress=progress,
    )


def _problems() -> tuple[ToyProblem, ...]:
    rng = np.random.default_rng(_SEED)
    return (
        linear_gaussian(rng)[0],
        rosenbrock(),
        exponential_decay(rng, noise=0.01),
        rank_deficient(),
        bound_active(),
        failing_region(rng, fraction=0.05),
        lone_parameter(),
    )


def _decay() -> ToyProblem:
    return exponential_decay(np.random.default_rng(_SEED), noise=0.01)


def _same(a: FitResult, b: FitResult) -> bool:
    def same(x: FloatArray | None, y: FloatArray | None) -> bool:
        return (x is None) == (y is None) and (x is None or y is None or x.tobytes() == y.tobytes())

    return (
        same(a.x, b.x)
        and same(a.jacobian, b.jacobian)
        and same(a.residual, b.residual)
        and (a.loss, a.evaluations, a.termination, a.history) == (b.loss, b.evaluations, b.termination, b.history)
    )


def check_result(estimator: Estimator) -> None:
    """Bounds, budget, best-so-far, counts, history and flags are right on every toy problem."""
    for problem in _problems():
        witness = Witness(problem)
        result = run(estimator, witness)
        where = f"{estimator.name} on {', '.join(problem.names)}: "
        answered, losses = np.array(witness.answered), np.array(witness.losses)
        inside = np.all((answered >= problem.lower) & (answered <= problem.upper))
        require(bool(inside), where + "a candidate outside the bounds was simulated")
        require(bool(np.all(np.isfinite(answered))), where + "a candidate that is not a number was simulated")
        require(len(answered) <= _EVALUATIONS, where + "the budget of evaluations was overrun")
        require(result.evaluations == len(answered), where + "result.evaluations is not the candidates simulated")
        require(bool(np.all((result.x >= problem.lower) & (result.x <= problem.upper))), where + "x is out of bounds")
        require(np.isfinite(result.loss), where + "the loss of the result is not finite")
        at_x = float(problem.loss(result.x[None])[0])
        require(abs(at_x - result.loss) <= 1e-9 * at_x, where + "result.loss is not the loss at result.x")
        start = float(problem.loss(problem.start[None])[0])
        best = float(losses.min())
        require(result.loss <= best * (1.0 + _SLACK) + 1e-9 * start, where + "a clearly better candidate was seen")
        require(result.loss < start, where + "the result is no better than the start")
        require(result.converged is (result.termination is Termination.CONVERGED), where + "converged is wrong")
        near = np.minimum(result.x - problem.lower, problem.upper - result.x) / (problem.upper - problem.lower)
        require(bool(np.all(result.at_bound == (near < 1e-6))), where + "at_bound is wrong")
        require(result.names == problem.names, where + "names are wrong")
        running = np.minimum.accumulate(losses)
        counts, values = np.array([n for n, _ in result.history]), np.array([v for _, v in result.history])
        require(bool(np.all(np.diff(counts) > 0) and np.all(np.diff(values) < 0)), where + "history is not falling")
        agree = np.allclose(values, running[counts - 1], rtol=1e-9, atol=1e-9 * start)
        require(bool(agree), where + "history is not the best loss so far")


def check_budget(estimator: Estimator) -> None:
    """Small budgets are kept to the candidate, and a journal can be resumed with a larger one."""
    whole = run(estimator, _decay())
    for evaluations in (1, 2, 7, 50):
        witness, journal = Witness(_decay()), Journal()
        result = run(estimator, witness, evaluations=evaluations, journal=journal)
        require(len(witness.answered) <= evaluations, f"{estimator.name}: a budget of {evaluations} was overrun")
        if whole.evaluations > evaluations:
            require(
                result.termination is Termination.BUDGET_SPENT and not result.converged,
                f"{estimator.name}: a spent budget is not reported ({result.termination.name})",
            )
        require(
            _same(run(estimator, _decay(), journal=journal), whole),
            f"{estimator.name}: resumed with a larger budget, the answer is not that of one run",
        )
    witness = Witness(_decay())
    timed = estimator.fit(
        witness, rng=np.random.default_rng(_SEED), budget=Budget(seconds=1e-9), journal=Journal(), progress=silent
    )
    require(not timed.converged, f"{estimator.name}: a spent time budget is not reported")
    require(not witness.answered, f"{estimator.name}: simulated after the time budget was spent")


def check_reproducible(estimator: Estimator) -> None:
    """The same seed gives the same bits; neither global random numbers nor the inputs are touched."""
    problem = _decay()
    before = (problem.lower.tobytes(), problem.upper.tobytes(), problem.start.tobytes())
    legacy_state = vars(np.random)["get_state"]  # by name: looked at here, used by nobody
    state = legacy_state()[1]
    first, second = Witness(problem), Witness(problem)
    a, b = run(estimator, first), run(estimator, second)
    require(_same(a, b), f"{estimator.name}: the same seed gave two answers")
    require(first.asked() == second.asked(), f"{estimator.name}: the same seed asked for other candidates")
    require(bool(np.all(state == legacy_state()[1])), f"{estimator.name}: draws from numpy's global random numbers")
    untouched = before == (problem.lower.tobytes(), problem.upper.tobytes(), problem.start.tobytes())
    require(untouched, f"{estimator.name}: wrote into the problem's arrays")


def check_failing_candidates(estimator: Estimator) -> None:
    """Failed candidates never win; where all fail, the result says so."""
    result = run(estimator, hopeless())
    require(
        result.termination is Termination.NO_FINITE_CANDIDATE and not result.converged,
        f"{estimator.name}: all candidates failed, and it ended with {result.termination.name}",
    )
    require(not np.isfinite(result.loss), f"{estimator.name}: a finite loss where there is none")
    require(
        result.x.tobytes() == hopeless().start.tobytes(), f"{estimator.name}: without an answer, x must be the start"
    )


def check_progress(estimator: Estimator) -> None:
    """Progress rises to the evaluations of the result, and never forgets the best."""
    calls: list[tuple[int, int | None, float]] = []

    def progress(*, done: int, total: int | None, best: float, note: str) -> None:
        del note
        calls.append((done, total, best))

    result = run(estimator, _decay(), progress=progress)
    require(len(calls) > 1, f"{estimator.name}: progress was not reported")
    done, best = [call[0] for call in calls], [call[2] for call in calls]
    require(done == sorted(done) and done[-1] == result.evaluations, f"{estimator.name}: progress miscounts")
    require(best == sorted(best, reverse=True), f"{estimator.name}: progress forgets the best")
    require({call[1] for call in calls} == {_EVALUATIONS}, f"{estimator.name}: progress does not tell the budget")


def check_interruption(estimator: Estimator) -> None:
    """Ctrl-C returns the best so far and keeps the journal; resumed, the fit ends as if uninterrupted."""
    reference = Witness(_decay())
    whole = run(estimator, reference)
    for limit in (0, whole.evaluations // 2):
        witness = Witness(_decay(), limit=limit, fault=KeyboardInterrupt())
        journal = Journal()
        result = run(estimator, witness, journal=journal)
        require(
            result.termination is Termination.INTERRUPTED and not result.converged,
            f"{estimator.name}: interrupted, it ended with {result.termination.name}",
        )
        best = min(witness.losses, default=np.inf)
        kept = result.loss == best or abs(result.loss - best) <= 1e-9 * best
        require(kept, f"{estimator.name}: interrupted, it lost the best so far")
        require(journal.evaluations == len(witness.answered), f"{estimator.name}: interrupted, it lost evaluations")
        again = Witness(_decay())
        resumed = run(estimator, again, journal=journal)
        require(_same(resumed, whole), f"{estimator.name}: resumed after Ctrl-C, the answer changed")
        require(
            again.goes_on(witness, len(witness.answered), reference, again=_repeats(estimator)),
            f"{estimator.name}: resumed after Ctrl-C, evaluations were repeated or skipped",
        )


def check_resume(estimator: Estimator) -> None:
    """Killed at 20, 50 and 80 %, with and without a torn last record, it resumes to the same bits."""
    for problem in (_decay(), failing_region(np.random.default_rng(_SEED), fraction=0.05)):
        reference = Witness(problem)
        whole = run(estimator, reference)
        for fraction in (0.2, 0.5, 0.8):
            for torn in (0, 9):
                with tempfile.TemporaryDirectory() as folder:
                    _check_one_resume(estimator, reference, whole, fraction, torn, Path(folder) / "fit.journal")
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "fit.journal"
        whole = run(estimator, _decay(), journal=Journal(path, fingerprint="a"))
        idle = Witness(_decay())
        resumed = run(estimator, idle, journal=Journal(path, fingerprint="a"))
        require(_same(resumed, whole), f"{estimator.name}: read from a finished journal, the answer changed")
        require(not idle.answered, f"{estimator.name}: simulated what a finished journal already holds")


def _check_one_resume(
    estimator: Estimator, reference: Witness, whole: FitResult, fraction: float, torn: int, path: Path
) -> None:
    where = f"{estimator.name}, killed at {fraction:.0%}: "
    witness = Witness(reference.problem, limit=fraction * whole.evaluations, fault=Killed())
    try:
        run(estimator, witness, journal=Journal(path))
    except Killed:
        pass
    else:
        raise AssertionError(where + "it swallowed an exception that was not its own")
    if torn and path.exists():
        path.write_bytes(path.read_bytes()[:-torn])
    again, kept = Witness(reference.problem), Journal(path).evaluations
    resumed = run(estimator, again, journal=Journal(path))
    require(_same(resumed, whole), where + "resumed, the answer changed")
    went_on = again.goes_on(witness, kept, reference, again=_repeats(estimator))
    require(went_on, where + "evaluations were repeated or skipped")


def _repeats(estimator: Estimator) -> int:
    """How often a resumed fit may simulate again what it had simulated."""
    return 1 if needs_residuals(estimator) else 0


def check_refusals(estimator: Estimator) -> None:
    """A problem it cannot take, or one that is malformed, is refused with a `UsageError`."""
    with suppress(UsageError):
        run(estimator, LossOnly(_decay()))
    toy = _decay()
    for lower, start in ((toy.upper, toy.start), (toy.lower, toy.upper + 1.0), (toy.lower - np.inf, toy.start)):
        bad = ToyProblem(toy.names, lower, toy.upper, start, toy.function, toy.optimum)
        try:
            run(estimator, bad)
        except UsageError:
            continue
        raise AssertionError(f"{estimator.name}: bounds or a start that cannot be used were not refused")


def check_by_residuals(estimator: Estimator) -> None:
    """One that minimises residuals takes no mere loss, and has variants that find the minimum well enough."""
    if not uses_residuals(estimator):
        return
    try:
        run(estimator, LossOnly(_decay()))
    except UsageError:
        pass
    else:
        raise AssertionError(f"{estimator.name}: uses_residuals, and takes a problem that has none")
    whole, gain = run(estimator, _decay()), 0.5
    allowed = whole.loss * (1.0 + 2.0 * gain / len(_decay().residuals(whole.x[None])[0]))
    for variant in (estimator.for_rough_objective(1e-2, gain), estimator.unconfirmed()):
        require(uses_residuals(variant), f"{estimator.name}: a variant of it does not use residuals")
        found = run(variant, _decay()).loss
        # settings under which the estimator itself stops on the way say nothing of where its variants end
        near = found <= allowed if whole.converged else found < float(_decay().loss(_decay().start[None])[0])
        require(near, f"{estimator.name}: a variant of it stops far from the minimum")


ESTIMATOR_CHECKS: tuple[Callable[[Estimator], None], ...] = (
    check_result,
    check_budget,
    check_reproducible,
    check_failing_candidates,
    check_progress,
    check_interruption,
    check_resume,
    check_refusals,
    check_by_residuals,
)
"""What `check_estimator` runs; usable one by one."""
