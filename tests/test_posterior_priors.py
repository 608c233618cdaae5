"""Priors: densities, text, and which parameter a key means."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from sysid_btr.errors import UsageError
from sysid_btr.posterior.priors import LogNormal, Normal, Uniform, choose_priors, log_prior, moments, parse_prior
from sysid_btr.terms.base import Parameter

KNEE = Parameter("mass:Knee", "1", 1.0, 0.3, 3.0, 0.1)
HIP = Parameter("mass:Hip", "1", 1.0, 0.3, 3.0, 0.1)
GAIN = Parameter("kp:*", "1", 1.0, 0.2, 5.0, 0.1)
PARAMETERS = (KNEE, HIP, GAIN)


def test_densities_are_those_of_scipy_up_to_a_constant() -> None:
    x = np.linspace(0.31, 2.9, 50)
    for prior, known in (
        (Normal(1.2, 0.3), stats.norm(1.2, 0.3)),
        (LogNormal(0.9, 0.4), stats.lognorm(s=0.4, scale=0.9)),
        (Uniform(), stats.uniform(0.3, 2.7)),
    ):
        constant = prior.log_density(x) - known.logpdf(x)
        np.testing.assert_allclose(constant, constant[0], atol=1e-12)


def test_moments_within_the_bounds() -> None:
    assert moments(Uniform(), 0.3, 3.0)[1] == pytest.approx(2.7 / np.sqrt(12), rel=1e-3)
    assert moments(Normal(1.5, 0.1), 0.3, 3.0) == pytest.approx((1.5, 0.1), rel=1e-3)
    cut = stats.truncnorm((0.3 - 0.3) / 0.5, (3.0 - 0.3) / 0.5, loc=0.3, scale=0.5)
    assert moments(Normal(0.3, 0.5), 0.3, 3.0) == pytest.approx((float(cut.mean()), float(cut.std())), rel=2e-3)


@pytest.mark.parametrize("text", ["uniform", "normal(1, 0.1)", " LogNormal( 0.9 ,0.25 ) "])
def test_text_is_read_back(text: str) -> None:
    prior = parse_prior(text)
    assert parse_prior(str(prior)) == prior


WRONG = ("", "gauss(1, 2)", "normal", "normal(1)", "normal(a, b)", "normal(1, 0)", "normal(1, inf)", "lognormal(-1, 1)")


@pytest.mark.parametrize("text", WRONG)
def test_what_is_no_prior_is_refused(text: str) -> None:
    with pytest.raises(UsageError):
        parse_prior(text)


def test_a_name_wins_over_a_glob_and_that_over_a_field() -> None:
    given = {"mass:Knee": "normal(1, 0.1)", "mass:*": "normal(1, 0.2)", "mass": "normal(1, 0.3)", "kp": "uniform"}
    assert choose_priors(PARAMETERS, given) == (Normal(1, 0.1), Normal(1, 0.2), Uniform())
    # a name may look like a glob
    assert choose_priors(PARAMETERS, {"kp:*": "normal(2, 1)"})[2] == Normal(2, 1)
    several = choose_priors(PARAMETERS, {"mass:*ee,H*": "normal(1, 0.1)", "mass:Kn*": "normal(1, 0.2)"})
    assert several == (Normal(1, 0.2), Normal(1, 0.1), Uniform())


def test_the_robots_table_gives_way_and_may_name_what_is_not_free() -> None:
    table = {"mass": "normal(1, 0.3)", "armature": "normal(0, 1)"}
    assert choose_priors(PARAMETERS, {"mass:Hip": "uniform"}, table) == (Normal(1, 0.3), Uniform(), Uniform())


def test_all_mistakes_are_told_at_once() -> None:
    with pytest.raises(UsageError) as caught:
        choose_priors(PARAMETERS, {"mass:Ankle": "uniform", "kp": "lognorm(1, 2)", "mass:Hip": "lognormal(1, 0)"})
    message = str(caught.value)
    for said in ("mass:Ankle", "lognorm(1, 2)", "mass:Hip"):
        assert said in message


def test_a_prior_without_anything_in_the_bounds_is_refused() -> None:
    below = Parameter("constant_force:j", "Nm", 0.0, -2.0, -1.0, 0.1)
    with pytest.raises(UsageError, match="no mass within -2 to -1"):
        choose_priors((below,), {"constant_force": "lognormal(1, 1)"})


def test_log_prior_adds_up() -> None:
    x = np.array([[1.0, 1.1, 2.0], [1.3, 0.9, 1.0]])
    total = log_prior((Normal(1, 0.1), Uniform(), LogNormal(1, 0.5)), x)
    np.testing.assert_allclose(total, Normal(1, 0.1).log_density(x[:, 0]) + LogNormal(1, 0.5).log_density(x[:, 2]))
