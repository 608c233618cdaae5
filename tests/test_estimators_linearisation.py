"""What differences and steps tell of derivatives."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sysid_btr._typing import FloatArray
from sysid_btr.estimators import Budget, Evaluator, Journal, LeastSquares, silent
from sysid_btr.estimators.linearisation import LinearModel, Scheme, Stencil, linear_model
from sysid_btr.testing import ToyProblem, run

FORWARD = Scheme(Stencil.forward, central=False, rank_tolerance=1e-4)


def bent(rng: np.random.Generator, p: int, size: int = 60) -> ToyProblem:
    """Residuals that are quadratic in parameters of very different scales."""
    slope, curve = rng.standard_normal((2, size, p))
    span = 10.0 ** rng.uniform(-3, 3, p)
    target = rng.standard_normal(size)

    def function(x: FloatArray) -> FloatArray:
        u = x / span
        return u @ slope.T + 0.2 * u**2 @ curve.T - target

    names = tuple(f"x{j}" for j in range(p))
    return ToyProblem(names, -span, span, span * rng.uniform(-0.5, 0.5, p), function, np.full(p, np.nan))


def about(problem: ToyProblem) -> tuple[Evaluator, FloatArray, LinearModel]:
    evaluator = Evaluator(problem, budget=Budget(), journal=Journal(), progress=silent)
    u = evaluator.box.enter(problem.start)
    return evaluator, u, linear_model(problem, evaluator, u, np.full(len(u), 1e-4), FORWARD, "")[0]


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), p=st.integers(1, 7))
def test_a_step_is_explained_by_derivatives_that_change_no_more_than_they_must(seed: int, p: int) -> None:
    rng = np.random.default_rng(seed)
    problem = bent(rng, p)
    evaluator, u, model = about(problem)
    to = np.clip(u + 0.3 * rng.standard_normal(p), 0.0, 1.0)
    (neighbour,) = model.neighbours(evaluator, problem, to[None], "")
    moved = model.moved(u, neighbour)
    assert moved is not None
    assert not moved.measured
    before, after = model.stack(), moved.stack()
    # what the journal's few numbers say is what the arrays say
    np.testing.assert_allclose(moved.normal, after[:-1] @ after[:-1].T, rtol=1e-7, atol=1e-9)
    np.testing.assert_allclose(moved.gradient, after[:-1] @ after[-1], rtol=1e-7, atol=1e-9)
    assert moved.loss == pytest.approx(after[-1] @ after[-1])
    # the secant holds, and what is at right angles to the step, in what parameters move, is as before
    np.testing.assert_allclose((to - u) @ after[:-1], after[-1] - before[-1], atol=1e-8)
    across = rng.standard_normal(p)
    weight = np.diag(model.normal) * (to - u)
    across -= (across @ weight) / (weight @ (to - u)) * (to - u)
    np.testing.assert_allclose(across @ after[:-1], across @ before[:-1], atol=1e-7)


def test_a_step_from_where_a_neighbour_failed_tells_nothing_of_it() -> None:
    problem = bent(np.random.default_rng(0), 3)
    evaluator, u, model = about(problem)
    (neighbour,) = model.neighbours(evaluator, problem, u[None] + 0.01, "")
    assert replace(model, failed=np.array([False, True, False])).moved(u, neighbour) is None


def test_many_parameters_of_a_bent_problem_take_a_stencil_and_some_steps() -> None:
    """Twenty parameters, eight seeds; a stencil an iteration takes four, and 91 evaluations."""
    spent = 0
    for seed in range(8):
        problem = bent(np.random.default_rng(seed), 20, 200)
        problem = replace(problem, start=0.8 * problem.upper)
        found = run(LeastSquares(confirm=False), problem, evaluations=None)
        exact = run(LeastSquares(), replace(problem, start=found.x), evaluations=None)
        assert found.converged
        assert found.loss <= exact.loss * (1 + 1e-4)
        spent += found.evaluations
    assert spent < 0.8 * 8 * 91
