"""Least squares against closed forms, active bounds, lost rank, failing regions, and its own thrift."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sysid_btr._typing import FloatArray
from sysid_btr.errors import SysidError, UsageError
from sysid_btr.estimators import LeastSquares, Termination, get_estimator, linearise
from sysid_btr.testing import (
    LossOnly,
    ToyProblem,
    bound_active,
    exponential_decay,
    failing_region,
    hopeless,
    linear_gaussian,
    rank_deficient,
    rosenbrock,
    run,
)


@pytest.mark.parametrize("seed", range(4))
def test_linear_problem_is_solved_exactly(seed: int) -> None:
    problem, design = linear_gaussian(np.random.default_rng(seed), p=6)
    result = run(LeastSquares(), problem)
    assert result.termination is Termination.CONVERGED
    np.testing.assert_allclose(result.x, problem.optimum, atol=1e-7)
    assert result.jacobian is not None
    assert result.residual is not None
    np.testing.assert_allclose(result.jacobian, design, rtol=1e-7, atol=1e-8)
    np.testing.assert_allclose(result.residual, problem.residuals(result.x[None])[0], rtol=1e-12)
    assert result.loss == pytest.approx(result.residual @ result.residual, rel=1e-12)
    # One Jacobian and one ladder find it; one of each confirm; the final one has two candidates a parameter.
    assert result.evaluations <= 1 + 3 * (6 + 1 + 5) + (2 * 6 + 1)


def test_rosenbrock_is_followed_to_its_zero() -> None:
    result = run(LeastSquares(max_iterations=100), rosenbrock(), evaluations=None)
    assert result.converged
    np.testing.assert_allclose(result.x, 1.0, atol=1e-5)


def test_noise_free_decay_is_recovered_from_far_away() -> None:
    problem = exponential_decay(np.random.default_rng(0))
    result = run(LeastSquares(), problem)
    assert result.converged
    np.testing.assert_allclose(result.x, problem.optimum, rtol=1e-6)


def test_noisy_decay_errs_as_its_jacobian_says() -> None:
    """Over many noises, errors divided by the std from the Jacobian have unit variance."""
    pulls = []
    for seed in range(60):
        problem = exponential_decay(np.random.default_rng(seed), noise=0.02)
        result = run(LeastSquares(), problem)
        assert result.converged
        assert result.jacobian is not None
        std = np.sqrt(np.diag(np.linalg.inv(result.jacobian.T @ result.jacobian)))
        pulls.append((result.x - np.array([2.0, 1.3, -0.4])) / std)
    # 180 pulls (60 independent): the mean square of unit normals lies in [0.65, 1.45] but once in a thousand.
    assert 0.65 < np.mean(np.square(pulls)) < 1.45
    assert np.max(np.abs(pulls)) < 4.5


def test_answer_does_not_depend_on_the_start() -> None:
    """Wherever it starts, it ends within a tenth of a standard deviation of the same point."""
    problem = exponential_decay(np.random.default_rng(3), noise=0.05)
    rng = np.random.default_rng(4)
    ends = []
    for _ in range(8):
        start = problem.lower + rng.uniform(0.1, 0.6, 3) * (problem.upper - problem.lower)
        result = run(LeastSquares(n_starts=3), replace(problem, start=start), evaluations=None)
        assert result.converged
        assert result.jacobian is not None
        ends.append(result.x)
    std = np.sqrt(np.diag(np.linalg.inv(result.jacobian.T @ result.jacobian)))
    assert np.max(np.ptp(ends, axis=0) / std) < 0.1


def test_active_bounds_satisfy_kkt() -> None:
    problem = bound_active()
    result = run(LeastSquares(), problem)
    assert result.converged
    np.testing.assert_allclose(result.x, problem.optimum, atol=1e-7)
    assert result.x[0] == 1.0
    assert result.x[1] == 0.0
    assert list(result.at_bound) == [True, True, False]
    assert result.jacobian is not None
    gradient = result.jacobian.T @ result.residual
    assert gradient[0] < 0.0 < gradient[1]  # the loss falls only out of the box
    assert abs(gradient[2]) < 1e-6


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), p=st.integers(1, 6))
def test_box_constrained_linear_problems_match_scipy(seed: int, p: int) -> None:
    from scipy.optimize import lsq_linear

    rng = np.random.default_rng(seed)
    design, target = rng.standard_normal((12, p)), 3.0 * rng.standard_normal(12)
    lower, upper = -rng.uniform(0.1, 1.0, p), rng.uniform(0.1, 1.0, p)
    problem = ToyProblem(
        names=tuple(f"x{j}" for j in range(p)),
        lower=lower,
        upper=upper,
        start=rng.uniform(lower, upper),
        function=lambda x: np.einsum("rp,mp->mr", design, x) - target,
        optimum=np.full(p, np.nan),
    )
    result = run(LeastSquares(), problem, evaluations=None)
    best = lsq_linear(design, target, bounds=(lower, upper), method="bvls", tol=1e-14)
    assert result.converged
    assert result.loss <= 2.0 * best.cost * (1.0 + 1e-6)
    assert np.all((result.x >= lower) & (result.x <= upper))


def test_what_the_residuals_do_not_see_stays_where_it_was() -> None:
    problem = rank_deficient()
    result = run(LeastSquares(), problem)
    assert result.converged
    gain, load, offset, idle = result.x
    assert gain * load == pytest.approx(result.x[0] * result.x[1])
    assert offset == pytest.approx(0.5, abs=1e-6)
    assert idle == 0.3
    # gain and load started equal and act alike: the least step changes them alike.
    assert gain == pytest.approx(load, rel=1e-3)
    t = np.linspace(-1.0, 1.0, 30)
    slope = 2.0 - 0.1 * (t @ np.sin(9.0 * t)) / (t @ t)
    assert gain * load == pytest.approx(slope, rel=1e-5)
    assert result.jacobian is not None
    assert np.all(result.jacobian[:, 3] == 0.0)


def test_an_idle_parameter_at_a_bound_is_harmless() -> None:
    problem = rank_deficient()
    start = problem.start.copy()
    start[3] = 1.0
    result = run(LeastSquares(), replace(problem, start=start))
    assert result.converged
    assert result.x[3] == 1.0


def test_scale_of_parameters_does_not_matter() -> None:
    """The same problem in micrometres and in kilometres takes the same path."""
    problem = exponential_decay(np.random.default_rng(5), noise=0.02)
    scale = np.array([1e-6, 1e3, 1.0])
    scaled = ToyProblem(
        problem.names,
        problem.lower * scale,
        problem.upper * scale,
        problem.start * scale,
        lambda x: problem.function(x / scale),
        problem.optimum,
    )
    a, b = run(LeastSquares(), problem), run(LeastSquares(), scaled)
    assert a.evaluations == b.evaluations
    np.testing.assert_allclose(a.x * scale, b.x, rtol=1e-6)
    assert a.jacobian is not None
    assert b.jacobian is not None
    np.testing.assert_allclose(a.jacobian / scale, b.jacobian, rtol=1e-5, atol=1e-9 * np.abs(b.jacobian).max())


def test_failing_neighbours_and_steps_are_survived() -> None:
    for seed in range(6):
        rng = np.random.default_rng(seed)
        clean = exponential_decay(np.random.default_rng(seed), noise=0.01)
        problem = failing_region(rng, fraction=0.05)
        result = run(LeastSquares(), problem, evaluations=None)
        wanted = run(LeastSquares(), clean)
        assert result.loss == pytest.approx(wanted.loss, rel=1e-3), seed


def test_a_start_that_fails_is_left_behind() -> None:
    problem = failing_region(np.random.default_rng(0))
    result = run(LeastSquares(), replace(problem, start=np.array([6.0, 9.0, 1.5])))
    assert result.converged
    assert result.x[1] == pytest.approx(1.3, abs=0.05)


def test_minimum_at_the_edge_of_failure_keeps_the_jacobian() -> None:
    """Neighbours on one side fail: the other side gives the derivative."""
    t = np.linspace(0.0, 1.0, 20)

    def function(x: np.ndarray) -> np.ndarray:
        rows = (x[:, :1] - 0.7) * t + 0.1 * np.cos(9.0 * t) * (1.0 + 0.1 * x[:, 1:2])
        rows[x[:, 0] > 0.6] = np.nan
        return rows

    lower, upper = np.zeros(2), np.ones(2)
    problem = ToyProblem(("a", "b"), lower, upper, np.array([0.6, 0.5]), function, np.full(2, np.nan))
    residual, jacobian = linearise(problem, problem.start)
    np.testing.assert_allclose(jacobian[:, 0], t, atol=1e-9)
    np.testing.assert_allclose(jacobian[:, 1], 0.01 * np.cos(9.0 * t), atol=1e-9)
    np.testing.assert_allclose(residual, function(problem.start[None])[0])


def test_a_parameter_that_cannot_be_moved_is_not_called_converged() -> None:
    """All neighbours in one parameter fail: its derivative is unknown, and the result says so."""
    smooth = exponential_decay(np.random.default_rng(0), noise=0.01)

    def function(x: np.ndarray) -> np.ndarray:
        rows = smooth.function(x)
        rows[x[:, 1] != 4.0] = np.nan
        return rows

    # Bounds of zero offset and a binary range, so that 4.0 survives the way through the unit cube.
    lower, upper = np.array([0.0, 0.0, -4.0]), np.array([16.0, 16.0, 4.0])
    result = run(LeastSquares(), replace(smooth, lower=lower, upper=upper, function=function))
    assert result.termination is Termination.STALLED
    assert result.x[1] == 4.0
    assert result.jacobian is not None
    assert np.all(np.isnan(result.jacobian[:, 1]))
    assert np.all(np.isfinite(result.jacobian[:, [0, 2]]))


def test_rough_loss_stalls_or_converges_but_does_not_wander() -> None:
    """Steps of the loss finer than the differences see: it ends soon and near the minimum."""
    smooth = exponential_decay(np.random.default_rng(0), noise=0.02)

    def function(x: np.ndarray) -> np.ndarray:
        return smooth.function(np.round(x, 3))

    result = run(LeastSquares(), replace(smooth, function=function), evaluations=None)
    wanted = run(LeastSquares(), smooth)
    assert result.evaluations < 400
    assert result.loss < 1.1 * wanted.loss


def test_residuals_that_count_for_less_than_one_end_at_a_tenth_of_a_standard_deviation() -> None:
    """Copies of one residual, weighed so that together they are one: no sharper end than for that one."""
    copies = 400
    once = exponential_decay(np.random.default_rng(0), noise=0.02)

    @dataclass(frozen=True, eq=False)
    class Correlated(ToyProblem):
        deviation: ClassVar[float] = 1.0

    def function(x: FloatArray) -> FloatArray:
        return np.tile(once.function(np.round(x, 3)) / np.sqrt(copies), copies)

    correlated = Correlated(once.names, once.lower, once.upper, once.start, function, once.optimum)
    result = run(LeastSquares(), correlated, evaluations=None)
    assert result.termination is Termination.CONVERGED
    assert result.loss < run(LeastSquares(), once).loss + 0.1


def test_several_starts_escape_a_local_minimum() -> None:
    t = np.linspace(0.0, 6.0, 120)
    problem = ToyProblem(
        names=("frequency",),
        lower=np.array([0.5]),
        upper=np.array([9.0]),
        start=np.array([1.0]),
        function=lambda x: 5.0 * (np.sin(x[:, :1] * t) - np.sin(5.0 * t)),
        optimum=np.array([5.0]),
    )
    assert run(LeastSquares(), problem).x[0] != pytest.approx(5.0, abs=0.1)
    several = run(LeastSquares(n_starts=4, prescreen=16), problem, evaluations=None)
    assert several.x[0] == pytest.approx(5.0, abs=1e-6)
    told = run(LeastSquares(n_starts=2, starts=((5.2,),)), problem)
    assert told.x[0] == pytest.approx(5.0, abs=1e-6)


def test_forty_parameters_are_fitted_frugally() -> None:
    """A mildly non-linear problem, 30 % off: within a hundredth of a std at the price of seven Jacobians."""
    from scipy.optimize import least_squares

    p, r = 40, 1000
    rng = np.random.default_rng(1)
    linear = rng.standard_normal((r, p)) * np.geomspace(1.0, 0.05, p)
    bent = 0.5 * rng.standard_normal((r, p)) * linear
    truth = rng.uniform(0.3, 0.7, p)

    def model(x: np.ndarray) -> np.ndarray:
        return 20.0 * (np.sin(np.einsum("rp,mp->mr", linear, x)) + 0.3 * np.einsum("rp,mp->mr", bent, x) ** 2)

    measured = model(truth[None])[0] + rng.standard_normal(r)
    problem = ToyProblem(
        names=tuple(f"x{j}" for j in range(p)),
        lower=np.zeros(p),
        upper=np.ones(p),
        start=np.clip(truth * rng.uniform(0.7, 1.3, p), 0.0, 1.0),
        function=lambda x: model(x) - measured,
        optimum=truth,
    )
    result = run(LeastSquares(), problem, evaluations=None)
    assert result.converged
    assert result.evaluations <= 7 * (p + 1)
    assert result.jacobian is not None
    reference = least_squares(
        lambda x: problem.residuals(x[None])[0], problem.start, bounds=(0.0, 1.0), xtol=1e-12, ftol=1e-12
    )
    std = np.sqrt(np.diag(np.linalg.inv(result.jacobian.T @ result.jacobian)))
    assert np.max(np.abs(result.x - reference.x) / std) < 0.02


def test_linearise_matches_the_result() -> None:
    problem = exponential_decay(np.random.default_rng(2), noise=0.02)
    result = run(LeastSquares(), problem)
    residual, jacobian = linearise(problem, result.x)
    assert result.jacobian is not None
    np.testing.assert_allclose(jacobian, result.jacobian, rtol=1e-6, atol=1e-6 * np.abs(jacobian).max())
    np.testing.assert_allclose(residual, result.residual)
    amplitude, rate, _ = result.x
    t = np.linspace(0.0, 4.0, 80)
    exact = np.stack([np.exp(-rate * t), -amplitude * t * np.exp(-rate * t), np.ones(80)], axis=1) / 0.02
    np.testing.assert_allclose(jacobian, exact, atol=2e-5 * np.abs(exact).max())


def test_linearise_at_bounds_is_second_order() -> None:
    problem = exponential_decay(np.random.default_rng(2))
    t = np.linspace(0.0, 4.0, 80)
    for x in (problem.lower, problem.upper):
        _, jacobian = linearise(problem, x)
        a, k, _ = x
        exact = np.stack([np.exp(-k * t), -a * t * np.exp(-k * t), np.ones(80)], axis=1) / 0.01
        np.testing.assert_allclose(jacobian, exact, atol=1e-4 * np.abs(exact).max())


def test_linearise_where_the_simulation_fails_is_refused() -> None:
    with pytest.raises(UsageError, match="not finite"):
        linearise(hopeless(), hopeless().start)


def test_losses_alone_are_refused() -> None:
    with pytest.raises(UsageError, match=r"'lsq' needs an objective with residuals.*cmaes"):
        run(LeastSquares(), LossOnly(rosenbrock()))


def test_a_loss_that_is_not_the_sum_of_squares_is_caught() -> None:
    class Inconsistent(ToyProblem):
        def loss(self, candidates: np.ndarray) -> np.ndarray:
            return 1.01 * super().loss(candidates)

    toy = rosenbrock()
    problem = Inconsistent(toy.names, toy.lower, toy.upper, toy.start, toy.function, toy.optimum)
    with pytest.raises(SysidError, match="inconsistent"):
        run(LeastSquares(), problem)


@pytest.mark.parametrize(
    "setting",
    [
        {"max_iterations": 0},
        {"n_starts": 0},
        {"damping": ()},
        {"damping": (-1.0,)},
        {"forward_step": 0.0},
        {"central_step": 0.5},
    ],
)
def test_bad_settings_are_refused(setting: dict[str, object]) -> None:
    with pytest.raises(UsageError, match="lsq"):
        get_estimator("lsq", **setting)


def test_starts_outside_are_refused() -> None:
    with pytest.raises(UsageError, match="outside"):
        run(LeastSquares(starts=((9.0, 9.0),)), rosenbrock())
    with pytest.raises(UsageError, match="2 numbers"):
        run(LeastSquares(starts=((1.0,),)), rosenbrock())


def test_a_rough_objective_is_left_where_steps_keep_little_of_what_they_promise() -> None:
    """A sawtooth in one parameter: its slopes mislead; following them gains next to nothing."""
    spent = 0
    for seed in range(3):
        smooth, _ = linear_gaussian(np.random.default_rng(seed), p=4, r=4000)

        def rough(x: FloatArray, smooth: ToyProblem = smooth) -> FloatArray:
            tooth = x.copy()
            tooth[:, 0] -= 0.7 * 3e-3 * np.floor(x[:, 0] / 3e-3)
            return smooth.residuals(tooth)

        result = run(LeastSquares(), replace(smooth, function=rough), evaluations=None)
        spent += result.evaluations
        assert result.loss < 1.1 * 4000
    assert spent < 500


def test_a_narrow_valley_that_bends_is_followed_in_steps_as_long_as_it_allows() -> None:
    """Masses and gains in common are hardly seen, their ratios well: short steps keep what little they promise."""
    drawn = 1e-4 * np.random.default_rng(0).standard_normal(400)

    def residuals(x: FloatArray) -> FloatArray:
        mass, stiffness, damping = x.T[:, :, None]
        t = np.linspace(0, 1, 400)
        seen = (stiffness / mass) * np.sin(9 * t) + (damping / mass) * np.cos(7 * t) + 3e-3 * mass * np.sin(23 * t)
        return (seen - np.sin(9 * t) - np.cos(7 * t) - 3e-3 * np.sin(23 * t) - drawn) / 1e-4

    names, one = ("mass", "stiffness", "damping"), np.ones(3)
    problem = ToyProblem(names, 0.2 * one, 4 * one, np.array([2.6, 2.5, 2.7]), residuals, one)
    result = run(LeastSquares(max_iterations=15), problem, evaluations=300)
    assert result.converged
    np.testing.assert_allclose(result.x, 1.0, rtol=0.01)
