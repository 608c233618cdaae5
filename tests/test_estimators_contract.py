"""Every built-in estimator keeps every promise of the contract; a broken one is caught."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import pytest

from sysid_btr.errors import SysidError, UsageError
from sysid_btr.estimators import (
    Budget,
    Estimator,
    FitResult,
    Journal,
    Problem,
    Progress,
    Termination,
    get_estimator,
    silent,
)
from sysid_btr.estimators.derivative_free import ALGORITHMS
from sysid_btr.testing import (
    ESTIMATOR_CHECKS,
    ToyProblem,
    check_estimator,
    exponential_decay,
    linear_gaussian,
    rosenbrock,
    run,
)

NAMES = ("lsq", "ga", "cmaes", "emcee", *(f"nlopt:{algorithm}" for algorithm in ALGORITHMS))


@pytest.mark.parametrize("check", ESTIMATOR_CHECKS, ids=lambda check: check.__name__)
@pytest.mark.parametrize("name", NAMES)
def test_conformance(name: str, check: Callable[[Estimator], None]) -> None:
    check(get_estimator(name))


@pytest.mark.parametrize(
    ("name", "settings"),
    [
        ("lsq", {"n_starts": 3, "prescreen": 4, "max_iterations": 6}),
        ("lsq", {"damping": (1.0,), "rescue": ()}),
        ("ga", {"population": 12, "elite": 3, "bits": 9, "mutation": 0.05}),
        ("cmaes", {"restarts": 2, "population": 8}),
        ("cmaes", {"separable": True}),
        ("emcee", {"walkers": 12, "spread": 0.5}),
    ],
)
def test_conformance_with_settings(name: str, settings: dict[str, object]) -> None:
    check_estimator(get_estimator(name, **settings))


@dataclass(frozen=True)
class Careless:
    """Breaks the contract: no evaluator, no journal, walks out of the box."""

    name: str = "careless"

    def fit(
        self, problem: Problem, *, rng: np.random.Generator, budget: Budget, journal: Journal, progress: Progress
    ) -> FitResult:
        del budget, journal, progress
        x = problem.start + rng.standard_normal((500, len(problem.start))) * (problem.upper - problem.lower)
        losses = problem.loss(x)
        i = int(np.argmin(losses))
        flags = np.zeros(len(problem.start), dtype=bool)
        return FitResult(x[i], float(losses[i]), 500, Termination.CONVERGED, True, flags, None, None, (), 0.0)


@dataclass(frozen=True)
class Tampered:
    """A good estimator whose result is falsified by `change`."""

    change: Callable[[FitResult], FitResult]
    name: str = "tampered"

    def fit(
        self, problem: Problem, *, rng: np.random.Generator, budget: Budget, journal: Journal, progress: Progress
    ) -> FitResult:
        result = get_estimator("cmaes").fit(problem, rng=rng, budget=budget, journal=journal, progress=progress)
        return self.change(result)


def test_kit_rejects_a_careless_estimator() -> None:
    with pytest.raises(AssertionError, match="outside the bounds"):
        check_estimator(Careless())


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda result: replace(result, loss=0.5 * result.loss), "not the loss at result.x"),
        (lambda result: replace(result, evaluations=result.evaluations - 1), "candidates simulated"),
        (lambda result: replace(result, converged=not result.converged), "converged is wrong"),
        (lambda result: replace(result, at_bound=~result.at_bound), "at_bound is wrong"),
        (lambda result: replace(result, history=((1, 0.0),)), "history"),
        (lambda result: replace(result, termination=Termination.CONVERGED, converged=True), "budget is not"),
    ],
)
def test_kit_rejects_falsified_results(change: Callable[[FitResult], FitResult], message: str) -> None:
    with pytest.raises(AssertionError, match=message):
        check_estimator(Tampered(change))


@dataclass(frozen=True)
class Unseeded:
    """Ignores the generator it is given."""

    name: str = "unseeded"

    def fit(
        self, problem: Problem, *, rng: np.random.Generator, budget: Budget, journal: Journal, progress: Progress
    ) -> FitResult:
        del rng
        fresh = np.random.default_rng()
        return get_estimator("ga").fit(problem, rng=fresh, budget=budget, journal=journal, progress=progress)


def test_kit_rejects_an_estimator_that_ignores_its_seed() -> None:
    # Resuming meets the journal's own refusal, or another answer, whichever check comes first.
    with pytest.raises((AssertionError, UsageError)):
        check_estimator(Unseeded())


def test_malformed_problems_are_refused_by_name() -> None:
    toy = rosenbrock()
    bad = replace(toy, upper=np.array([5.0, np.inf]), start=np.array([-6.0, 0.0]))
    with pytest.raises(UsageError) as caught:
        run(get_estimator("lsq"), bad)
    assert "a: start -6 is outside its bounds [-5, 5]" in str(caught.value)
    assert "b: bounds [-5, inf]" in str(caught.value)


def test_nothing_to_fit_is_refused() -> None:
    empty = np.empty(0)
    nothing = ToyProblem((), empty, empty, empty, lambda x: x, empty)
    with pytest.raises(UsageError, match="nothing to fit"):
        run(get_estimator("ga"), nothing)


@pytest.mark.parametrize("name", ["lsq", "cmaes"])
def test_wrong_shapes_from_a_problem_are_reported(name: str) -> None:
    toy = rosenbrock()

    class Wrong(ToyProblem):
        def loss(self, candidates: np.ndarray) -> np.ndarray:
            return super().loss(candidates)[:, None]

    wrong = Wrong(toy.names, toy.lower, toy.upper, toy.start, toy.function, toy.optimum)
    with pytest.raises(SysidError, match="shape"):
        run(get_estimator(name), wrong)


def test_budget_refuses_nothing_worth_having() -> None:
    with pytest.raises(UsageError, match="at least 1"):
        Budget(evaluations=0)
    with pytest.raises(UsageError, match="positive"):
        Budget(seconds=0.0)


def test_errors_of_the_simulation_pass_through_and_keep_the_journal() -> None:
    toy = exponential_decay(np.random.default_rng(0))
    calls = 0

    def function(x: np.ndarray) -> np.ndarray:
        nonlocal calls
        calls += 1
        if calls == 4:
            raise SysidError("the simulator is gone")
        return toy.function(x)

    for name in ("ga", "cmaes", "nlopt:LN_BOBYQA"):
        calls, journal = 0, Journal()
        with pytest.raises(SysidError, match="simulator is gone"):
            run(get_estimator(name), replace(toy, function=function), journal=journal)
        assert len(journal) == 3


def test_time_budget_ends_a_fit() -> None:
    problem, _ = linear_gaussian(np.random.default_rng(1))
    result = get_estimator("ga", patience=10**9).fit(
        problem, rng=np.random.default_rng(1), budget=Budget(seconds=0.05), journal=Journal(), progress=silent
    )
    assert result.termination is Termination.BUDGET_SPENT
    assert 0.05 <= result.seconds < 5.0


def test_every_termination_is_a_sentence() -> None:
    assert all(t.value.endswith(".") and " " in t.value for t in Termination)
