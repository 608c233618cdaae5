"""Sampling: closed forms, calibration, exactness whatever the surrogate, convergence, and resuming."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import chisquare

from sysid_btr._typing import FloatArray
from sysid_btr.errors import NotConvergedError, UsageError
from sysid_btr.estimators import Budget, Journal, silent
from sysid_btr.estimators.ensemble import autocorrelation_time, bounded, folded, log_jacobian, unbounded
from sysid_btr.estimators.linearisation import linearise
from sysid_btr.estimators.lsq import LeastSquares
from sysid_btr.posterior import sampling
from sysid_btr.posterior.likelihood import Likelihood, make_likelihood, settle
from sysid_btr.posterior.priors import LogNormal, Normal, Prior, Uniform
from sysid_btr.posterior.sampling import Sample, Settings, assess, sample
from sysid_btr.posterior.surrogate import Foretold
from sysid_btr.testing import Killed, ToyProblem, Witness, bound_active, failing_region, linear_gaussian


def plain(toy: ToyProblem, x: FloatArray) -> Likelihood:
    """The likelihood of residuals that are known to be white and of unit size."""
    residual, jacobian = linearise(toy, x)
    return make_likelihood(toy, x, residual, jacobian, None)


# fewer moves between replays than a robot is worth: a toy's replay is no dearer, and its draws are as independent
SUBSTEPS = 10


def draw(
    toy: ToyProblem,
    likelihood: Likelihood | None = None,
    priors: Sequence[Prior] | None = None,
    *,
    seed: int = 1,
    budget: Budget | None = None,
    journal: Journal | None = None,
    problem: object = None,
    substeps: int = SUBSTEPS,
    **settings: object,
) -> Sample:
    return sample(
        toy if problem is None else problem,  # type: ignore[arg-type]
        plain(toy, toy.optimum) if likelihood is None else likelihood,
        priors or [Uniform()] * len(toy.names),
        settings=Settings(substeps=substeps, **settings),  # type: ignore[arg-type]
        rng=np.random.default_rng(seed),
        budget=budget or Budget(),
        journal=Journal() if journal is None else journal,
        progress=silent,
    )


# --- coordinates ------------------------------------------------------------------------------------------


def test_the_walkers_space_is_the_logit_of_the_cube() -> None:
    u = np.array([[0.2, 0.5, 0.999]])
    np.testing.assert_allclose(bounded(unbounded(u)), u, rtol=1e-12)
    v, h = unbounded(u), 1e-6
    slopes = [(bounded(v + h * e) - bounded(v - h * e))[0] / (2 * h) for e in np.eye(3)]
    assert log_jacobian(v)[0] == pytest.approx(np.log(np.prod(np.diag(slopes))), abs=1e-6)
    assert np.all(np.isfinite(unbounded(np.array([[0.0, 1.0]]))))


def test_folding_reflects() -> None:
    np.testing.assert_allclose(folded(np.array([-0.2, 0.3, 1.3, 2.4, -1.9])), [0.2, 0.3, 0.7, 0.4, 0.1])


def test_autocorrelation_time_of_a_known_process() -> None:
    rng = np.random.default_rng(0)
    rho, chain = 0.8, np.zeros((6000, 10, 2))
    for i in range(1, len(chain)):
        chain[i] = rho * chain[i - 1] + rng.standard_normal((10, 2))
    chain[:, :, 1] = rng.standard_normal((6000, 10))
    slow, white = autocorrelation_time(chain)
    assert slow == pytest.approx((1 + rho) / (1 - rho), rel=0.1)
    assert white == pytest.approx(1.0, abs=0.1)
    assert np.isinf(autocorrelation_time(np.ones((50, 8, 1)))[0])


# --- closed forms -----------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def linear() -> tuple[ToyProblem, FloatArray, Sample]:
    toy, design = linear_gaussian(np.random.default_rng(0), p=3)
    return toy, np.linalg.inv(design.T @ design), draw(toy, draws=2500.0)


def test_a_linear_gaussian_posterior_is_the_closed_form(linear: tuple[ToyProblem, FloatArray, Sample]) -> None:
    toy, covariance, found = linear
    std = np.sqrt(np.diag(covariance))
    assert found.converged
    np.testing.assert_array_less(np.abs(found.flat.mean(axis=0) - toy.optimum), 0.1 * std)
    np.testing.assert_allclose(found.flat.std(axis=0), std, rtol=0.05)
    correlation = covariance / np.outer(std, std)
    np.testing.assert_allclose(np.corrcoef(found.flat.T), correlation, atol=0.06)


def test_convergence_is_what_it_says(linear: tuple[ToyProblem, FloatArray, Sample]) -> None:
    found = linear[2]
    ensembles, steps, walkers, p = found.draws.shape
    assert (ensembles, walkers, p) == (2, 8, 3)
    assert steps == found.convergence.steps >= 50 * found.convergence.tau.max()
    assert np.all(found.convergence.rhat < 1.01)
    assert np.all(found.convergence.ess >= 2500)
    # the linear model is the truth here, so that no proposal is ever rejected
    assert found.surrogate.acceptance == 1.0
    assert found.surrogate.error < 1e-6


def test_the_likelihood_of_every_draw_is_that_of_its_replay(linear: tuple[ToyProblem, FloatArray, Sample]) -> None:
    toy, _, found = linear
    losses = toy.loss(found.flat)
    best = float(toy.loss(toy.optimum[None])[0])
    np.testing.assert_allclose(found.log_likelihood.reshape(-1), -0.5 * (losses - best), atol=1e-8)


@pytest.mark.parametrize("prior", [Normal(0.4, 0.02), LogNormal(0.7, 0.03)], ids=str)
def test_a_prior_counts_as_what_it_is(prior: Prior) -> None:
    toy, design = linear_gaussian(np.random.default_rng(0), p=1, r=30, noise=0.2)
    found = draw(toy, priors=[prior], draws=2500.0)
    x = np.linspace(-4, 3, 200_001)[1:]
    log = -0.5 * float(design[:, 0] @ design[:, 0]) * (x - toy.optimum[0]) ** 2 + prior.log_density(x)
    weight = np.exp(log - log.max())
    weight /= weight.sum()
    mean = float(weight @ x)
    std = float(np.sqrt(weight @ (x - mean) ** 2))
    assert found.flat.mean() == pytest.approx(mean, abs=0.1 * std)
    assert found.flat.std() == pytest.approx(std, rel=0.05)


def test_a_posterior_that_is_cut_off_by_its_bounds() -> None:
    toy = bound_active()
    found = draw(toy, draws=2500.0)
    rng = np.random.default_rng(3)
    # importance sampling from the prior is exact, and cheap in three dimensions
    x = rng.uniform(toy.lower, toy.upper, (400_000, 3))
    weight = np.exp(-0.5 * (toy.loss(x) - toy.loss(toy.optimum[None])[0]))
    weight /= weight.sum()
    mean = weight @ x
    std = np.sqrt(weight @ (x - mean) ** 2)
    np.testing.assert_array_less(np.abs(found.flat.mean(axis=0) - mean), 0.1 * std)
    np.testing.assert_allclose(found.flat.std(axis=0), std, rtol=0.05)
    assert np.all((found.flat >= toy.lower) & (found.flat <= toy.upper))


def wrong_by(change: Callable[[Foretold], Foretold], monkeypatch: pytest.MonkeyPatch) -> None:
    right = sampling.regress
    monkeypatch.setattr(sampling, "regress", lambda *given: change(right(*given)))


@pytest.mark.parametrize(
    "change",
    [
        lambda model: replace(model, gram=0.6 * model.gram),
        lambda model: replace(model, gram=1.3 * model.gram),
        lambda model: replace(model, frame=replace(model.frame, centre=model.frame.centre + 0.4 * model.frame.root[0])),
    ],
    ids=["too wide", "too narrow", "elsewhere"],
)
def test_the_draws_are_exact_however_wrong_the_surrogate(
    change: Callable[[Foretold], Foretold], monkeypatch: pytest.MonkeyPatch
) -> None:
    toy, design = linear_gaussian(np.random.default_rng(0), p=2)
    wrong_by(change, monkeypatch)
    found = draw(toy, draws=1500.0, rhat=1.02)
    std = np.sqrt(np.diag(np.linalg.inv(design.T @ design)))
    assert found.surrogate.acceptance < 0.97
    assert found.surrogate.error > 0.1
    np.testing.assert_array_less(np.abs(found.flat.mean(axis=0) - toy.optimum), 0.12 * std)
    np.testing.assert_allclose(found.flat.std(axis=0), std, rtol=0.08)


def test_candidates_that_fail_are_never_drawn() -> None:
    toy = failing_region(np.random.default_rng(20), fraction=0.1)
    best = LeastSquares().fit(toy, rng=np.random.default_rng(0), budget=Budget(), journal=Journal(), progress=silent)
    x, residual, jacobian, _ = settle(toy, best.x)
    found = draw(toy, make_likelihood(toy, x, residual, jacobian, None))
    assert found.converged
    assert np.all(np.isfinite(toy.loss(found.flat)))


def test_a_better_minimum_than_the_fits_is_found_and_told() -> None:
    toy = ToyProblem(
        ("x",),
        np.array([-2.0]),
        np.array([2.0]),
        np.array([-0.9]),
        lambda x: np.stack([4.0 * (x[:, 0] ** 2 - 1.0), 1.5 * (x[:, 0] - 1.0)], axis=1),
        np.array([1.0]),
    )
    worse = LeastSquares().fit(toy, rng=np.random.default_rng(0), budget=Budget(), journal=Journal(), progress=silent)
    assert worse.x[0] < 0
    found = draw(toy, plain(toy, worse.x), draws=500.0, budget=Budget(evaluations=6000))
    assert found.gain == pytest.approx(0.5 * worse.loss, rel=0.05)
    assert np.mean(found.flat > 0) > 0.8
    assert draw(toy, draws=300.0, budget=Budget(evaluations=6000)).gain <= 1e-9


# --- calibration ------------------------------------------------------------------------------------------

DATASETS, THINNED, BINS = 96, 31, 8


def test_ranks_of_the_truth_are_uniform() -> None:
    """Simulation-based calibration (Talts et al. 2018, arXiv:1804.06788) of a decay seen through noise."""
    rng = np.random.default_rng(0)
    t, noise = np.linspace(0.0, 2.0, 12), 0.15
    lower, upper = np.array([0.5, 0.2]), np.array([3.0, 4.0])
    quick = Settings(fewest_steps=12, autocorrelation_times=1.0, draws=50.0, rhat=1.5, substeps=SUBSTEPS)

    def decay(x: FloatArray) -> FloatArray:
        return np.asarray(x[:, :1] * np.exp(-x[:, 1:] * t))

    ranks = []
    for _ in range(DATASETS):
        truth = rng.uniform(lower, upper)
        seen = decay(truth[None])[0] + noise * rng.standard_normal(len(t))

        def residuals(x: FloatArray, seen: FloatArray = seen) -> FloatArray:
            return np.asarray((decay(x) - seen) / noise)

        toy = ToyProblem(("size", "rate"), lower, upper, 0.5 * (lower + upper), residuals, truth)
        best = LeastSquares(confirm=False).fit(toy, rng=rng, budget=Budget(), journal=Journal(), progress=silent)
        x, residual, jacobian, _ = settle(toy, best.x)
        found = sample(
            toy,
            make_likelihood(toy, x, residual, jacobian, None),
            [Uniform()] * 2,
            settings=quick,
            rng=rng,
            budget=Budget(evaluations=4000),
            journal=Journal(),
            progress=silent,
        )
        ranks.append((found.thinned(THINNED) < truth).sum(axis=0))
    for rank in np.array(ranks).T:
        counts = np.bincount(rank * BINS // (THINNED + 1), minlength=BINS)
        assert chisquare(counts).pvalue > 0.005, counts


# --- the adjusted likelihood ------------------------------------------------------------------------------


def correlated(rng: np.random.Generator, blocks: int = 200, length: int = 10) -> tuple[ToyProblem, FloatArray]:
    """A linear problem whose residuals repeat themselves within each block: ten samples tell what one does."""
    label = np.repeat(np.arange(blocks), length)
    design = np.column_stack([np.repeat(rng.standard_normal(blocks), length), rng.standard_normal(blocks * length)])
    target = design @ np.array([0.5, -0.3]) + np.repeat(rng.standard_normal(blocks), length)
    best = np.linalg.lstsq(design, target, rcond=None)[0]
    toy = ToyProblem(
        ("slow", "fast"),
        np.full(2, -2.0),
        np.full(2, 2.0),
        np.zeros(2),
        lambda x: np.einsum("rp,mp->mr", design, x) - target,
        best,
    )
    return toy, label


def test_correlated_residuals_widen_the_direction_that_they_concern() -> None:
    toy, label = correlated(np.random.default_rng(1))
    residual, jacobian = linearise(toy, toy.optimum)
    found = draw(toy, make_likelihood(toy, toy.optimum, residual, jacobian, label), draws=2500.0)
    white = np.sqrt(np.diag(np.linalg.inv(jacobian.T @ jacobian)))
    widened = found.flat.std(axis=0) / white
    assert widened[0] == pytest.approx(np.sqrt(10), rel=0.15)
    # the other one only by what shrinking lends to it: too wide, never too narrow
    assert 0.95 < widened[1] < 1.35


def test_where_the_model_is_linear_the_posterior_has_the_sandwich_covariance() -> None:
    from sysid_btr.objectives.covariance import covariance

    toy, label = correlated(np.random.default_rng(2))
    residual, jacobian = linearise(toy, toy.optimum)
    found = draw(toy, make_likelihood(toy, toy.optimum, residual, jacobian, label), draws=2500.0)
    expected = np.sqrt(np.diag(covariance(jacobian, residual, label)))
    np.testing.assert_allclose(found.flat.std(axis=0), expected, rtol=0.07)


def test_white_residuals_of_the_noise_floor_are_taken_for_what_they_are() -> None:
    rng = np.random.default_rng(3)
    toy, _ = linear_gaussian(rng, p=2, r=4000)
    residual, jacobian = linearise(toy, toy.optimum)
    likelihood = make_likelihood(toy, toy.optimum, residual, jacobian, np.arange(4000) // 10)
    np.testing.assert_allclose(likelihood.share, 1.0, atol=0.1)
    u = rng.random((5, 2))
    np.testing.assert_array_less(likelihood.factor(u), 1.0 + 1e-12)


def test_the_error_of_the_step_widens_its_own_direction() -> None:
    toy, _ = linear_gaussian(np.random.default_rng(4), p=2, r=4000)
    residual, jacobian = linearise(toy, toy.optimum)
    blocks = np.arange(4000) // 10
    shift = np.array([0.01, 0.0])
    wide = make_likelihood(toy, toy.optimum, residual, jacobian, blocks, shift)
    narrow = make_likelihood(toy, toy.optimum, residual, jacobian, blocks)
    span = toy.upper - toy.lower
    flat = np.full(2, 0.5), np.full(2, 1.0 / np.sqrt(12))
    gained = np.diag(wide.expected(*flat)[1] - narrow.expected(*flat)[1]) * span**2
    assert gained[0] == pytest.approx(1e-4, rel=0.05)
    assert gained[1] < 1e-5


def test_settling_frees_what_was_held() -> None:
    toy, _ = linear_gaussian(np.random.default_rng(5), p=3)
    held = toy.optimum.copy()
    held[1] = -2.0
    x, residual, jacobian, replays = settle(toy, held)
    np.testing.assert_allclose(x, toy.optimum, atol=1e-3)
    assert residual @ residual == pytest.approx(float(toy.loss(x[None])[0]))
    assert jacobian.shape == (60, 3)
    assert replays >= 14


# --- convergence and budget -------------------------------------------------------------------------------


def test_ensembles_that_disagree_have_not_converged() -> None:
    rng = np.random.default_rng(6)
    near, far = (rng.standard_normal((400, 10, 1)) + shift for shift in (0.0, 0.5))
    apart, together = assess([near, far]), assess([near, near + 0.0 * far])
    assert apart.rhat[0] > 1.02
    assert not apart.reached(Settings())
    assert together.reached(Settings())


def test_a_chain_that_is_short_for_its_memory_has_not_converged() -> None:
    rng = np.random.default_rng(7)
    steps = np.cumsum(rng.standard_normal((2, 300, 10, 1)), axis=1)
    found = assess(list(steps))
    assert found.tau[0] > 10
    assert not found.reached(Settings(rhat=10.0))


def test_a_budget_that_is_out_gives_draws_that_are_not_called_converged() -> None:
    toy, _ = linear_gaussian(np.random.default_rng(0), p=3)
    found = draw(toy, budget=Budget(evaluations=300))
    assert not found.converged
    assert "budget" in found.termination
    assert found.evaluations == 300
    assert found.draws.shape[1] > 2


def test_a_budget_without_a_single_draw_is_refused() -> None:
    toy, _ = linear_gaussian(np.random.default_rng(0), p=3)
    with pytest.raises(NotConvergedError, match="16 replays a step"):
        draw(toy, budget=Budget(evaluations=30))


@pytest.mark.parametrize(
    ("settings", "said"),
    [({"ensembles": 1}, "at least 2 ensembles"), ({"walkers": 6}, "at least 8 walkers"), ({"walkers": 9}, "even")],
)
def test_settings_that_cannot_be_used(settings: dict[str, int], said: str) -> None:
    toy, _ = linear_gaussian(np.random.default_rng(0), p=3)
    with pytest.raises(UsageError, match=said):
        draw(toy, **settings)


# --- resuming ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("fraction", [0.2, 0.5, 0.8])
def test_killed_and_resumed_it_gives_the_same_draws(fraction: float, tmp_path: Path) -> None:
    toy, _ = linear_gaussian(np.random.default_rng(0), p=2)
    quick: dict[str, object] = {"draws": 200.0, "fewest_steps": 20}
    reference = Witness(toy)
    whole = draw(toy, problem=reference, **quick)
    path = tmp_path / "j"
    broken = Witness(toy, limit=fraction * whole.evaluations, fault=Killed())
    with pytest.raises(Killed):
        draw(toy, problem=broken, journal=Journal(path), **quick)
    again = Witness(toy)
    resumed = draw(toy, problem=again, journal=Journal(path), **quick)
    assert resumed.draws.tobytes() == whole.draws.tobytes()
    assert resumed.log_density.tobytes() == whole.log_density.tobytes()
    assert resumed.evaluations == whole.evaluations
    assert broken.asked() + again.asked() == reference.asked()


def test_an_interruption_returns_the_draws_so_far() -> None:
    toy, _ = linear_gaussian(np.random.default_rng(0), p=2)
    stopped = draw(toy, problem=Witness(toy, limit=400, fault=KeyboardInterrupt()))
    assert not stopped.converged
    assert stopped.termination.startswith("Interrupted")
    assert np.isfinite(stopped.draws).all()


def test_the_seed_decides() -> None:
    toy, _ = linear_gaussian(np.random.default_rng(0), p=2)
    quick: dict[str, object] = {"draws": 100.0, "fewest_steps": 10, "substeps": 5}
    one, same, other = (draw(toy, seed=seed, **quick) for seed in (1, 1, 2))
    assert one.draws.tobytes() == same.draws.tobytes()
    assert one.draws.tobytes() != other.draws.tobytes()
