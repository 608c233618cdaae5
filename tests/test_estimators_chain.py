"""Chains of estimators: the contract, the hand-over, and least squares that do in a fit what they always do."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from sysid_btr.errors import UsageError
from sysid_btr.estimators import Budget, FitResult, Journal, Problem, Progress, Termination, get_estimator, silent
from sysid_btr.estimators.chain import Chain
from sysid_btr.identify.fit import fit
from sysid_btr.identify.study import make_study
from sysid_btr.io.parquet import read_log
from sysid_btr.models.builtin import load_robot
from sysid_btr.testing import LossOnly, Witness, check_estimator, exponential_decay, rosenbrock, run

SAMPLES = Path(__file__).resolve().parents[1] / "sample_logs"
CHAINS = ("cmaes+lsq", "ga+nlopt:LN_BOBYQA", "lsq+cmaes", "lsq+lsq", "nlopt:GN_CRS2_LM+lsq+nlopt:LN_COBYLA")


@pytest.mark.parametrize("patience", [100, 15])
@pytest.mark.parametrize("name", CHAINS)
def test_conformance(name: str, patience: int) -> None:
    check_estimator(get_estimator(name, patience=patience))


@dataclass(frozen=True)
class Remembering:
    """An estimator that only notes where it began and what it may spend."""

    seen: list[tuple[np.ndarray, int | None]]
    name: str = "remembering"

    def fit(
        self, problem: Problem, *, rng: np.random.Generator, budget: Budget, journal: Journal, progress: Progress
    ) -> FitResult:
        self.seen.append((problem.start.copy(), budget.evaluations))
        return get_estimator("nlopt:LN_NELDERMEAD").fit(
            problem, rng=rng, budget=budget, journal=journal, progress=progress
        )


def test_each_stage_begins_at_the_best_so_far_and_shares_the_budget() -> None:
    seen: list[tuple[np.ndarray, int | None]] = []
    chain = Chain((Remembering(seen), get_estimator("cmaes"), Remembering(seen)), patience=10)
    witness = Witness(rosenbrock())
    result = run(chain, witness, evaluations=200)
    (_, first), (begin, last) = seen
    assert first == 10 * 3
    losses = np.array(witness.losses)
    spent = 200 - (last or 0)
    best = int(np.argmin(losses[:spent]))
    np.testing.assert_array_equal(begin, witness.answered[best])
    assert result.evaluations == len(losses) <= 200
    assert result.loss == losses.min()


def test_least_squares_end_what_a_search_began() -> None:
    toy = exponential_decay(np.random.default_rng(1))
    result = run(get_estimator("cmaes+lsq"), toy, evaluations=None)
    assert result.termination is Termination.CONVERGED
    np.testing.assert_allclose(result.x, toy.optimum, atol=1e-4)
    assert result.jacobian is not None


def test_a_stage_that_needs_residuals_is_refused_before_the_first_begins() -> None:
    witness = Witness(rosenbrock())
    with pytest.raises(UsageError, match=r"cmaes\+lsq"):
        run(get_estimator("cmaes+lsq"), LossOnly(witness))
    assert not witness.answered


@pytest.mark.parametrize("name", ["cmaes+", "+lsq", "cmaes++lsq", "cmaes+lsqq"])
def test_what_is_no_chain_is_refused(name: str) -> None:
    with pytest.raises(UsageError, match="cmaes"):
        get_estimator(name)


def test_settings_of_a_chain() -> None:
    with pytest.raises(UsageError, match="patience"):
        get_estimator("cmaes+lsq", sigma=0.3)
    with pytest.raises(UsageError, match="at least 1"):
        get_estimator("cmaes+lsq", patience=0)
    with pytest.raises(UsageError, match="at least two"):
        Chain((get_estimator("lsq"),))


def test_a_fit_by_a_chain_is_one_by_least_squares_from_a_better_start(tmp_path: Path) -> None:
    study = make_study(
        load_robot(str(SAMPLES / "pendulum.xml")), [read_log(SAMPLES / "pendulum_clean.parquet")], threads=1
    )
    free = ("mass:*", "kp:*", "kv:*")
    plain = fit(study, free)
    path = tmp_path / "journal"
    chain = replace_patience(get_estimator("cmaes+lsq"))
    found = fit(study, free, estimator=chain, start=np.array([2.5, 0.5, 2.0]), journal=Journal(path))
    for a, b in zip(plain.estimates, found.estimates, strict=True):
        assert a.value == pytest.approx(b.value, abs=0.02 * a.std)
        assert a.std == pytest.approx(b.std, rel=0.02)
    held = Journal(path)
    again = fit(study, free, estimator=chain, start=np.array([2.5, 0.5, 2.0]), journal=held)
    np.testing.assert_array_equal(again.values, found.values)
    assert len(held) == len(Journal(path))


def replace_patience(chain: object) -> Chain:
    assert isinstance(chain, Chain)
    return replace(chain, patience=10)


def test_a_budget_that_ends_in_the_search_is_told() -> None:
    study = make_study(
        load_robot(str(SAMPLES / "pendulum.xml")), [read_log(SAMPLES / "pendulum_clean.parquet")], threads=1
    )
    found = fit(study, ("mass:*", "kp:*"), estimator=get_estimator("cmaes+lsq"), budget=Budget(evaluations=9))
    assert found.result.termination is Termination.BUDGET_SPENT
    assert not found.result.converged


def test_sections_of_a_journal_follow_each_other(tmp_path: Path) -> None:
    journal = Journal(tmp_path / "j")
    toy = rosenbrock()

    def two_searches(journal: Journal) -> tuple[FitResult, FitResult]:
        journal.rewind()
        first = run(get_estimator("cmaes"), toy, evaluations=50, journal=journal.section(), progress=silent)
        return first, run(get_estimator("ga"), toy, evaluations=60, journal=journal.section())

    a = two_searches(journal)
    count = len(journal)
    b = two_searches(Journal(tmp_path / "j"))
    assert len(journal) == count
    for one, other in zip(a, b, strict=True):
        assert one.x.tobytes() == other.x.tobytes()
        assert one.history == other.history
