"""Profile likelihood: parabolas give the interval of the standard error, and everything else shows."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from sysid_btr.errors import UsageError
from sysid_btr.estimators.linearisation import linearise
from sysid_btr.identify.fit import fit
from sysid_btr.identify.intervals import estimates
from sysid_btr.identify.profile import chosen_names, profile, profile_curve
from sysid_btr.identify.study import make_study
from sysid_btr.io.parquet import read_log
from sysid_btr.models.builtin import load_robot
from sysid_btr.terms.base import Parameter
from sysid_btr.testing import ToyProblem, linear_gaussian

SAMPLES = Path(__file__).resolve().parents[1] / "sample_logs"


def parameters_of(toy: ToyProblem) -> list[Parameter]:
    return [
        Parameter(name, "1", 0.0, float(low), float(high), 0.1)
        for name, low, high in zip(toy.names, toy.lower, toy.upper, strict=True)
    ]


@pytest.mark.parametrize("p", [1, 3])
def test_on_a_linear_problem_the_profile_is_the_interval(p: int) -> None:
    rng = np.random.default_rng(3)
    toy, _ = linear_gaussian(rng, p=p, r=600)
    blocks = np.arange(600) // 20
    residual, jacobian = linearise(toy, toy.optimum)
    known = estimates(parameters_of(toy), toy.optimum, jacobian, residual, blocks)
    for index in range(p):
        found = profile_curve(toy, blocks, index)
        assert found.closed == (True, True)
        width = known[index].ci95[1] - known[index].ci95[0]
        np.testing.assert_allclose(found.interval, known[index].ci95, atol=1e-3 * width)
        parabola = ((found.values - toy.optimum[index]) / known[index].std) ** 2
        np.testing.assert_allclose(found.deviance, parabola, atol=1e-3 * found.threshold)
        assert 11 <= len(found.values) <= 19


def test_the_others_are_fitted_anew() -> None:
    toy, design = linear_gaussian(np.random.default_rng(4), p=3)
    found = profile_curve(toy, np.arange(60) // 5, 1)
    free = [0, 2]
    for x in found.others:
        rest = -(toy.residuals(np.where(np.arange(3) == 1, x, 0.0)[None])[0])
        best = np.linalg.lstsq(design[:, free], rest, rcond=None)[0]
        np.testing.assert_allclose(x[free], best, atol=1e-4)


def test_correlated_residuals_widen_it_as_they_widen_the_interval() -> None:
    rng = np.random.default_rng(5)
    label = np.repeat(np.arange(150), 10)
    design = np.column_stack([np.repeat(rng.standard_normal(150), 10), rng.standard_normal(1500)])
    target = np.repeat(rng.standard_normal(150), 10)
    toy = ToyProblem(
        ("slow", "fast"),
        np.full(2, -2.0),
        np.full(2, 2.0),
        np.zeros(2),
        lambda x: np.einsum("rp,mp->mr", design, x) - target,
        np.linalg.lstsq(design, target, rcond=None)[0],
    )
    residual, jacobian = linearise(toy, toy.optimum)
    known = estimates(parameters_of(toy), toy.optimum, jacobian, residual, label)
    found = profile_curve(toy, label, 0)
    np.testing.assert_allclose(found.interval, known[0].ci95, rtol=2e-3)
    assert found.std > 2.0 / np.linalg.norm(design[:, 0])


def test_a_flat_side_is_told() -> None:
    """A saturating effect: beyond some size nothing changes any more, which no standard error shows."""
    rng = np.random.default_rng(6)
    t = np.linspace(0, 1, 200)
    noise = rng.standard_normal(200)

    def residuals(x: np.ndarray) -> np.ndarray:
        return 0.3 * (np.tanh(x[:, :1]) - np.tanh(1.2)) * (1 + t) - noise

    toy = ToyProblem(("limit",), np.array([0.0]), np.array([8.0]), np.array([1.2]), residuals, np.array([1.2]))
    found = profile_curve(toy, np.arange(200) // 5, 0)
    assert found.closed == (True, False)
    assert 0.2 < found.interval[0] < 1.2
    assert found.interval[1] == 8.0
    assert found.deviance[-1] < found.threshold


def test_an_interval_ends_at_the_bound() -> None:
    toy, design = linear_gaussian(np.random.default_rng(7), p=2)
    near = toy.optimum[0] - 0.5 / np.linalg.norm(design[:, 0])
    cut = ToyProblem(toy.names, np.array([near, -4.0]), toy.upper, np.array([0.5, 0.5]), toy.function, toy.optimum)
    found = profile_curve(cut, np.arange(60) // 5, 0)
    assert found.closed == (False, True)
    assert found.interval[0] == near
    assert found.values[0] == near


def test_a_sample_log() -> None:
    study = make_study(
        load_robot(str(SAMPLES / "pendulum.xml")), [read_log(SAMPLES / "pendulum_clean.parquet")], threads=1
    )
    best = fit(study, ("mass:*", "kp:*", "kv:*"))
    found = profile(best, "kp:pendulum", 9)
    own = best.estimates[1]
    width = own.ci95[1] - own.ci95[0]
    np.testing.assert_allclose(found.interval, own.ci95, atol=0.15 * width)
    with pytest.raises(UsageError, match="kv:pendulum"):
        profile(best, "ki:pendulum")


def test_names_by_glob() -> None:
    names = ("mass:Hip", "mass:Knee", "kp:*")
    assert chosen_names(names, ["mass:*"]) == names[:2]
    assert chosen_names(names, ["kp:*", "mass:Hip"]) == ("mass:Hip", "kp:*")
    with pytest.raises(UsageError, match="mass:Toe"):
        chosen_names(names, ["mass:Toe", "kp:*"])
