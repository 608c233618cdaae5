"""Intervals at their ends: as far as the likelihood goes, and limits that a fit finds from where they do nothing."""

from __future__ import annotations

import json
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sysid_btr._typing import FloatArray
from sysid_btr.estimators.linearisation import linearise
from sysid_btr.identify.ends import followed
from sysid_btr.identify.fit import Fit, fit
from sysid_btr.identify.intervals import Estimate, estimates
from sysid_btr.identify.study import make_study
from sysid_btr.identify.thresholds import with_reached_limits
from sysid_btr.io.parquet import read_log
from sysid_btr.models.builtin import load_robot
from sysid_btr.terms.base import Parameter
from sysid_btr.terms.grammar import parse_parameters
from sysid_btr.terms.model import Model
from sysid_btr.testing import ToyProblem, linear_gaussian

SAMPLES = Path(__file__).resolve().parents[1] / "sample_logs"


def checked(toy: ToyProblem, scale: float = 0.1) -> tuple[tuple[Estimate, ...], tuple[Estimate, ...], int]:
    """Estimates at the optimum by curvature, and as far as the likelihood goes."""
    parameters = [
        Parameter(name, "Nm", 0.0, float(low), float(high), scale)
        for name, low, high in zip(toy.names, toy.lower, toy.upper, strict=True)
    ]
    residual, jacobian = linearise(toy, toy.optimum)
    found = estimates(parameters, toy.optimum, jacobian, residual, np.arange(len(residual)) // 5)
    ends, spent = followed(parameters, found, toy, toy.optimum, jacobian)
    return found, ends, spent


def saturating(
    function: Callable[[FloatArray], FloatArray], best: float, upper: float = 8.0, noise: float = 1.0
) -> ToyProblem:
    """A line of unit noise, as steep as a function of the parameter says."""
    t = np.linspace(0, 1, 200)
    drawn = noise * np.random.default_rng(6).standard_normal(200)
    drawn -= (1 + t) * ((1 + t) @ drawn) / ((1 + t) @ (1 + t))  # so that the optimum is exactly there

    def residuals(x: FloatArray) -> FloatArray:
        return 0.3 * (function(x[:, :1]) - function(np.array([[best]]))) * (1 + t) - drawn

    return ToyProblem(("size",), np.zeros(1), np.array([upper]), np.array([best]), residuals, np.array([best]))


@settings(deadline=None)
@given(seed=st.integers(0, 50), p=st.integers(1, 5))
def test_where_the_model_is_linear_nothing_moves(seed: int, p: int) -> None:
    toy, _ = linear_gaussian(np.random.default_rng(seed), p=p, r=300)
    found, ends, spent = checked(toy)
    assert ends == found
    assert spent <= 4 * p + 1


def test_an_effect_that_saturates_is_bounded_from_below_alone() -> None:
    found, ends, _ = checked(saturating(np.tanh, 1.2))
    assert found[0].ci95[1] < 2.5  # the curvature knows nothing of what is farther away
    assert ends[0].ci95 == (found[0].ci95[0], 8.0)
    assert ends[0].identifiable == "weak"
    assert "at least" in ends[0].reason
    assert "Nm" in ends[0].reason


def test_an_end_lies_where_as_much_is_lost_as_a_parabola_would_lose() -> None:
    found, ends, _ = checked(saturating(np.log1p, 1.0, upper=50.0))
    low, high = ends[0].ci95
    assert low == found[0].ci95[0]  # towards zero the likelihood falls faster
    toy = saturating(np.log1p, 1.0, upper=50.0)
    half = found[0].ci95[1] - 1.0
    _, jacobian = linearise(toy, toy.optimum)
    goal = half**2 * float(jacobian[:, 0] @ jacobian[:, 0])
    rise = toy.loss(np.array([[high], [1.0]]))
    assert high > found[0].ci95[1]
    assert rise[0] - rise[1] == pytest.approx(goal, rel=0.12)


def test_where_the_replay_diverges_the_likelihood_ends() -> None:
    toy = saturating(lambda x: np.where(x > 1.4, np.nan, np.tanh(x)), 1.2)
    found, ends, _ = checked(toy)
    assert np.isfinite(ends[0].ci95).all()
    assert ends[0].ci95[1] == found[0].ci95[1]


def test_the_others_follow_where_parameters_are_confounded() -> None:
    """Two amounts of which the log sees the sum, and that of the second hardly at all beyond some size."""
    t = np.linspace(0, 1, 400)
    drawn = np.random.default_rng(3).standard_normal(400)
    design = np.column_stack([1 + t, 1 + t + 0.3 * np.sin(20 * t)])
    drawn -= design @ np.linalg.lstsq(design, drawn, rcond=None)[0]

    def residuals(x: FloatArray) -> FloatArray:
        bent = np.tanh(x - 1.0)  # the same slope as x at 1
        return np.einsum("rp,mp->mr", design, bent) - drawn

    toy = ToyProblem(("a", "b"), np.full(2, -9.0), np.full(2, 11.0), np.ones(2), residuals, np.ones(2))
    found, ends, _ = checked(toy)
    for before, after in zip(found, ends, strict=True):
        assert after.ci95[0] < before.ci95[0]
        assert after.ci95[1] > before.ci95[1]


# --- limits that do nothing where a search begins -----------------------------------------------------------


@lru_cache
def weak_fit() -> Fit:
    study = make_study(
        load_robot(str(SAMPLES / "pendulum.xml")), [read_log(SAMPLES / "pendulum_weak.parquet")], threads=1
    )
    return fit(study, ["mass:*", "kp:*", "speed_torque_limit:*"])


def test_a_declared_limit_is_found_from_its_neutral_value() -> None:
    """No derivative leads away from there: the gain took its part, and the limit was called not identifiable."""
    truth = {"mass:arm": 1.0, "kp:pendulum": 1.0}
    truth |= {"speed_torque_limit.stall:pendulum": 1.5, "speed_torque_limit.no_load_speed:pendulum": 6.0}
    for one in weak_fit().estimates:
        assert one.identifiable == "yes", one
        assert abs(one.value - truth[one.name]) < 3 * one.std, one
        assert one.std < 0.02 * one.value, one


def test_a_limit_that_is_not_reached_is_not_made_up() -> None:
    study = make_study(
        load_robot(str(SAMPLES / "pendulum.xml")), [read_log(SAMPLES / "pendulum_clean.parquet")], threads=1
    )
    found = fit(study, ["mass:*", "kp:*", "torque_limit:*"])
    limit = found.estimates[-1]
    assert (limit.identifiable, limit.value) == ("no", limit.nominal)
    truth = json.loads((SAMPLES / "pendulum_clean.truth.json").read_text())["kp"]["pendulum"]["scale"]
    assert found.estimates[1].ci95[0] < truth < found.estimates[1].ci95[1]


def test_a_limit_that_is_told_stays() -> None:
    study = weak_fit().study
    terms = parse_parameters(["torque_limit:*"], study.robot, study.scales)
    told = Model(Model.of(terms).terms, np.array([1.0]))
    assert with_reached_limits(study, told) == (told, 0)
    found, spent = with_reached_limits(study, Model.of(terms))
    assert found.values[0] < 0.5 * Model.of(terms).values[0]
    assert spent > 5
