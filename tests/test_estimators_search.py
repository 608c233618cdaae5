"""The estimators that need only losses, and the names all are found under."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sysid_btr.errors import UsageError
from sysid_btr.estimators import (
    CmaEs,
    Estimator,
    GeneticAlgorithm,
    LeastSquares,
    NLopt,
    Termination,
    available,
    get_estimator,
)
from sysid_btr.estimators.derivative_free import ALGORITHMS, GLOBAL, LOCAL
from sysid_btr.estimators.ga import _Genome
from sysid_btr.testing import (
    LossOnly,
    Witness,
    bound_active,
    exponential_decay,
    failing_region,
    linear_gaussian,
    lone_parameter,
    rosenbrock,
    run,
)


def _decay() -> LossOnly:
    return LossOnly(exponential_decay(np.random.default_rng(0)))


DECAY = np.array([2.0, 1.3, -0.4])


def test_cmaes_finds_minima_from_afar() -> None:
    for problem, optimum in ((_decay(), DECAY), (rosenbrock(), np.ones(2)), (bound_active(), bound_active().optimum)):
        result = run(CmaEs(), problem, evaluations=None)
        assert result.converged
        np.testing.assert_allclose(result.x, optimum, atol=1e-3)
        assert result.jacobian is None


def test_cmaes_restarts_with_twice_the_population() -> None:
    once, thrice = Witness(rosenbrock()), Witness(rosenbrock())
    a = run(CmaEs(population=6), once, evaluations=None)
    b = run(CmaEs(population=6, restarts=2), thrice, evaluations=None)
    assert b.evaluations > 2 * a.evaluations
    assert thrice.asked().startswith(once.asked())
    assert b.loss <= a.loss


def test_cmaes_takes_one_parameter() -> None:
    result = run(CmaEs(), lone_parameter(), evaluations=None)
    grid = np.linspace(0.0, 2.0, 200_001)[:, None]
    assert result.x[0] == pytest.approx(grid[np.argmin(lone_parameter().loss(grid)), 0], abs=1e-4)


@pytest.mark.parametrize("algorithm", LOCAL)
def test_local_nlopt_algorithms_find_the_minimum_near(algorithm: str) -> None:
    problem, _ = linear_gaussian(np.random.default_rng(0), p=3)
    result = run(NLopt(algorithm), problem, evaluations=None)
    scale = problem.loss(problem.start[None])[0] - problem.loss(problem.optimum[None])[0]
    assert result.loss - problem.loss(problem.optimum[None])[0] < 1e-4 * scale


@pytest.mark.parametrize("algorithm", GLOBAL)
def test_global_nlopt_algorithms_search_until_told_to_stop(algorithm: str) -> None:
    result = run(NLopt(algorithm, max_evaluations=400), rosenbrock(), evaluations=None)
    assert result.termination is Termination.ITERATION_LIMIT
    assert 395 <= result.evaluations <= 401
    assert result.loss < 0.2 * rosenbrock().loss(rosenbrock().start[None])[0]


def test_bobyqa_survives_failing_candidates() -> None:
    problem = failing_region(np.random.default_rng(0), fraction=0.05)
    result = run(NLopt(), problem, evaluations=None)
    assert result.loss < 2.0 * problem.loss(DECAY[None])[0]


@pytest.mark.parametrize("name", ["ga", "cmaes", "nlopt:GN_CRS2_LM"])
def test_a_failing_region_is_left_out(name: str) -> None:
    problem = failing_region(np.random.default_rng(0))
    result = run(get_estimator(name), replace(problem, start=np.array([6.0, 9.0, 1.5])), evaluations=2000)
    assert result.x[1] <= 5.0
    assert result.loss < 10.0 * problem.loss(DECAY[None])[0]


def test_another_seed_is_another_search() -> None:
    for name in ("ga", "cmaes", "nlopt:GN_ESCH", "nlopt:GN_CRS2_LM", "nlopt:GN_ISRES"):
        a, b = Witness(rosenbrock()), Witness(rosenbrock())
        run(get_estimator(name), a, seed=1)
        run(get_estimator(name), b, seed=2)
        assert a.asked() != b.asked(), name


# The genetic algorithm


def test_ga_improves_every_toy_by_far() -> None:
    for problem in (_decay(), rosenbrock(), bound_active()):
        result = run(GeneticAlgorithm(), problem, evaluations=None)
        optimum = float(problem.loss(getattr(problem, "optimum", DECAY)[None])[0])
        start = float(problem.loss(problem.start[None])[0])
        assert result.converged
        assert result.loss - optimum < 0.01 * (start - optimum)


def test_ga_first_population_is_the_start_mutated() -> None:
    witness = Witness(rosenbrock())
    run(GeneticAlgorithm(population=200, mutation=0.01), witness, evaluations=200)
    first = np.array(witness.answered)
    assert first[0].tobytes() == rosenbrock().start.tobytes()
    # 32 bits, each flipped with probability 0.01: 72 % of the copies have none flipped.
    same = np.mean(np.all(first == rosenbrock().start, axis=1))
    assert same == pytest.approx(0.99**32, abs=0.13)


def test_ga_never_loses_its_best_and_does_not_simulate_it_again() -> None:
    witness = Witness(rosenbrock())
    result = run(GeneticAlgorithm(population=10, elite=2, generations=5), witness, evaluations=None)
    assert result.evaluations == 10 + 4 * 8
    assert result.loss == min(witness.losses)
    assert result.termination is Termination.ITERATION_LIMIT


@given(bits=st.integers(1, 20), start=st.floats(0.0, 1.0), genes=st.lists(st.booleans(), min_size=20, max_size=20))
def test_genome_decodes_within_bounds_and_start_exactly(bits: int, start: float, genes: list[bool]) -> None:
    lower, upper = np.array([-3.0]), np.array([7.0])
    genome = _Genome(lower, upper, np.clip(lower + start * 10.0, lower, upper), bits)
    assert genome.decode(genome.encode_start()[None])[0].tobytes() == genome.start.tobytes()
    x = genome.decode(np.array(genes)[None, :bits])
    assert lower <= x[0] <= upper


def test_gray_neighbours_are_one_bit_apart() -> None:
    genome = _Genome(np.zeros(1), np.ones(1), np.zeros(1), 6)
    bits = (np.arange(64)[:, None] >> np.arange(6)) & 1
    values = genome.decode(bits.astype(bool))[:, 0]
    order = np.argsort(values)
    np.testing.assert_allclose(values[order], np.arange(64) / 63)
    assert np.all(np.abs(np.diff(bits[order], axis=0)).sum(axis=1) == 1)


# Names


def test_names_give_their_estimators() -> None:
    assert get_estimator("lsq") == LeastSquares()
    assert get_estimator("lsq", max_iterations=5) == LeastSquares(max_iterations=5)
    assert get_estimator("nlopt") == NLopt("LN_BOBYQA")
    for name in ("lsq", "ga", "cmaes", *(f"nlopt:{algorithm}" for algorithm in ALGORITHMS)):
        estimator = get_estimator(name)
        assert isinstance(estimator, Estimator)
        assert estimator.name == name
    assert {"lsq", "ga", "cmaes", "nlopt:LN_BOBYQA"} <= set(available())


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("lqs", "Did you mean 'lsq'"),
        ("cma-es", "Did you mean 'cmaes'"),
        ("annealing", "There are lsq, ga, cmaes, nlopt:LN_BOBYQA"),
        ("lsq:fast", "takes no setting after a colon"),
        ("nlopt:CMAES", r"no CMA-ES.*'cmaes', 'nlopt:GN_CRS2_LM', 'nlopt:GN_ISRES', 'nlopt:GN_ESCH'"),
        ("nlopt:cma", "no CMA-ES"),
        ("nlopt:LN_BOBQA", "Did you mean LN_BOBYQA"),
        ("nlopt:LD_LBFGS", "needs gradients"),
        ("nlopt:", "There are LN_BOBYQA"),
    ],
)
def test_unknown_names_are_refused_with_what_there_is(name: str, expected: str) -> None:
    with pytest.raises(UsageError, match=expected):
        get_estimator(name)


def test_unknown_settings_are_refused_with_what_there_is() -> None:
    with pytest.raises(UsageError, match="'ga' has no setting size; it has population"):
        get_estimator("ga", size=3)


@pytest.mark.parametrize(
    ("name", "setting"),
    [
        ("ga", {"population": 2, "elite": 2}),
        ("ga", {"bits": 60}),
        ("ga", {"crossover": 1.5}),
        ("ga", {"mutation": 0.0}),
        ("ga", {"patience": 0}),
        ("cmaes", {"sigma": 0.0}),
        ("cmaes", {"population": 2}),
        ("cmaes", {"restarts": -1}),
        ("nlopt", {"initial_step": 2.0}),
        ("nlopt", {"max_evaluations": 0}),
    ],
)
def test_bad_settings_are_refused(name: str, setting: dict[str, object]) -> None:
    with pytest.raises(UsageError, match=name):
        get_estimator(name, **setting)


def test_installed_estimators_are_found(monkeypatch: pytest.MonkeyPatch) -> None:
    class Entry:
        value = "elsewhere:Thing"

        def __init__(self, name: str, loaded: object) -> None:
            self.name, self.loaded = name, loaded

        def load(self) -> object:
            if isinstance(self.loaded, Exception):
                raise self.loaded
            return self.loaded

    found = [Entry("other", CmaEs), Entry("broken", ImportError("no torch"))]
    monkeypatch.setattr("importlib.metadata.entry_points", lambda *, group: found)
    assert get_estimator("other", sigma=0.1) == CmaEs(sigma=0.1)
    assert available()[-2:] == ("broken", "other")
    with pytest.raises(UsageError, match=r"'broken' is installed .* no torch"):
        get_estimator("broken")


def test_importing_the_package_imports_no_optimiser() -> None:
    code = (
        "import sys, sysid_btr.estimators, sysid_btr.testing; "
        "print([m for m in ('scipy', 'cmaes', 'nlopt', 'pandas', 'mujoco') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
