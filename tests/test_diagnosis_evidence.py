"""How sure a name is: closed forms of the weights, and what certainty must follow."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sysid_btr.diagnosis.certainty import STANDARD
from sysid_btr.diagnosis.elimination import _merged
from sysid_btr.diagnosis.evidence import (
    Evidence,
    at_the_likeliest_place,
    evidence_of,
    is_missed,
    left_where_it_acts,
    preference,
    share_explained,
    weights,
)
from sysid_btr.diagnosis.hypotheses import Hypothesis
from sysid_btr.diagnosis.selection import STANDARD as RULES
from sysid_btr.diagnosis.state import State
from sysid_btr.diagnosis.trials import Trial
from sysid_btr.diagnosis.verdict import named_effects
from sysid_btr.identify.intervals import Estimate
from sysid_btr.identify.refit import Fitted
from sysid_btr.simulation.numerics import Numerics
from sysid_btr.terms.disturbance import ConstantForce
from sysid_btr.terms.effect import Effect
from sysid_btr.terms.friction import CoulombFriction
from sysid_btr.terms.model import Model
from sysid_btr.terms.scales import JointScale
from sysid_btr.terms.spring import JointSpring, Tether

RUBS = {"knee": 0.1, "hip": 0.3}
COUNT = 50.0
"""Samples in a stretch."""


def left(chi2: np.ndarray, memory: float = 1.0) -> Fitted:
    """What a model leaves that was held out: chi2 (columns, stretches) of samples with some autocorrelation."""
    columns, counts = chi2.mean(axis=1), np.full(chi2.shape, COUNT)
    nothing = np.zeros((len(chi2), 0))
    return Fitted(
        model=Model.of(()),
        train=1.0,
        holdout=float(columns.mean()),
        train_columns=np.ones(len(chi2)),
        holdout_columns=columns,
        columns=columns,
        memory=np.ones(len(chi2)),
        holdout_memory=np.full(len(chi2), memory),
        train_cells=nothing,
        holdout_cells=chi2 * COUNT,
        train_counts=nothing,
        holdout_counts=counts,
        evaluations=1,
        numerics=Numerics("RK4", 0.005),
    )


def even(chi2: float, stretches: int = 20) -> np.ndarray:
    return np.full((1, stretches), chi2)


def test_a_cause_of_no_size_is_not_more_likely_than_not() -> None:
    """A pendulum's payload of any mass at a place anywhere predicts better: that names nothing."""
    known = {"family": 0.999, "place": 1.0, "left": 0.01}
    assert STANDARD.certainty(known) > 0.9
    assert STANDARD.certainty(known, sized=False) == 0.5
    doubtful = known | {"left": 0.9}
    assert STANDARD.certainty(doubtful, sized=False) == STANDARD.certainty(doubtful) < 0.5


class Known(State):
    """A diagnosis at its end, in which all others leave a hundred times the noise without an effect."""

    def refitted_without(self, effect: Effect, seconds: float) -> Fitted:
        return left(even(100.0))


def told(*effects: CoulombFriction) -> list[float]:
    """How sure names are of which the log does not tell the size."""
    model = Model.joined((effect, np.array([0.1])) for effect in effects)
    nothing: Any = SimpleNamespace(model=Model.of(()))
    now = replace(left(even(1.1)), model=model)
    size = Estimate("size", "Nm", 0.0, 0.1, 1.0, (-1.9, 2.1), (0.0, 5.0), "weakly", False, "")
    evidence = (Evidence(),) * len(effects)
    state = Known(nothing, nothing, now, now, evidence, (), (), 0, (size,) * len(effects))
    return [e.certainty for e in named_effects(state, RULES)[0]]


def test_what_alone_explains_a_log_is_there_whichever_of_its_numbers_it_is() -> None:
    knee, hip = CoulombFriction(places=("knee",)), CoulombFriction(places=("hip",))
    assert told(knee)[0] > 0.9
    assert told(knee, hip) == [0.5, 0.5]


def test_an_effect_is_not_confused_with_itself_where_it_is() -> None:
    model = Model.joined((CoulombFriction(places=(place,)), np.array([size])) for place, size in RUBS.items())
    study: Any = SimpleNamespace(scales=dict.fromkeys(RUBS, JointScale(10.0, 20.0, 1.0, 2.0, 1.0, 1.0)))
    nothing: Any = SimpleNamespace(model=Model.of(()))
    now = replace(left(even(1.1)), model=model)
    evidence = tuple(Evidence((f"coulomb_friction at {place}", "backlash")) for place in ("hip", "ankle"))
    state = _merged(Known(study, nothing, now, now, evidence, (), (), 0, ()), RULES)
    assert [e.places for e in state.effects] == [("knee", "hip")]
    # what each was taken for: the other, which is there, and friction at the ankle, which is not
    assert state.evidence[0].rivals == ("backlash", "coulomb_friction at ankle")


def test_models_that_leave_alike_weigh_alike_and_a_parameter_costs_what_it_gains_by_chance() -> None:
    same = [left(even(2.0)), left(even(2.0))]
    np.testing.assert_allclose(weights(same, same[0], [1, 1]), [0.5, 0.5])
    np.testing.assert_allclose(weights(same, same[0], [1, 2]), [1 / (1 + np.exp(-1)), 1 / (1 + np.e)])


def test_what_holds_a_name_as_a_special_case_says_it_too() -> None:
    """A spring so soft, or a band so long, that its torque is constant: no evidence against a constant torque."""

    def trial(effect: type[Effect], place: str) -> Trial:
        return Trial(Hypothesis(effect, (place,), False, np.zeros(len(effect.kinds)), 1.0), left(even(2.0)))

    constant = trial(ConstantForce, "knee")
    wider = [trial(JointSpring, "knee"), trial(Tether, "shank")]
    known = evidence_of(RULES, constant, [constant, *wider])
    assert (known.family, known.place) == (pytest.approx(1.0), pytest.approx(1.0))
    assert not known.others
    assert {h.effect for h in known.alternatives} <= {JointSpring, Tether}
    assert known.alternatives
    rubbing = evidence_of(RULES, constant, [constant, trial(CoulombFriction, "knee")])
    assert rubbing.family == pytest.approx(0.5, abs=0.05)
    assert set(rubbing.others) == {"friction"}
    # and not the other way round
    assert evidence_of(RULES, wider[0], [constant, wider[0]]).family < 0.6


def test_the_weight_of_a_clear_difference_is_that_of_the_likelihood() -> None:
    # an error of unknown size: half the number of independent samples times the logarithm of the ratio of chi2
    a, b = left(even(2.0), memory=100.0), left(even(2.1), memory=100.0)
    odds = 0.5 * 20 * COUNT / 100 * np.log(2.1 / 2.0)
    np.testing.assert_allclose(weights([a, b], a, [1, 1])[0], 1 / (1 + np.exp(-odds)), rtol=1e-6)


@pytest.mark.parametrize(
    ("without", "expected"),
    [(4.2, False), (4.4, True), (3.8, False)],
    ids=["worth no place", "missed", "better without"],
)
def test_what_is_left_out_is_missed_where_it_is_worth_a_place(without: float, expected: bool) -> None:
    assert is_missed(RULES, left(even(without)), left(even(4.0))) == expected


def test_many_samples_of_a_wrong_model_are_little_evidence() -> None:
    white, correlated = ([left(even(4.0), m), left(even(4.2), m)] for m in (1.0, 200.0))
    assert weights(white, white[0], [1, 1])[0] > 0.999
    assert weights(correlated, correlated[0], [1, 1])[0] < 0.6


def test_a_lead_that_one_stretch_decides_is_less_sure_than_one_of_all_stretches() -> None:
    steady, lucky = even(2.0), even(2.2)
    lucky[0, 0] = 2.2 - 0.2 * 20  # the same chi2 as the steady one
    other = left(even(2.2), memory=20.0)
    firm = weights([left(steady, 20.0), other], other, [1, 1])[0]
    chance = weights([left(np.maximum(lucky, 0.0), 20.0), other], other, [1, 1])[0]
    assert firm > chance > 0.5


def test_a_model_is_preferred_that_predicts_held_out_data_better_in_most_columns() -> None:
    before = left(np.vstack([even(20.0), even(30.0)]), memory=COUNT)
    assert preference(before, before) == pytest.approx(0.5)
    better = left(np.vstack([even(10.0), even(29.0)]), memory=COUNT)
    assert preference(before, better) > 0.95
    assert preference(better, before) < 0.05
    harmful = left(np.vstack([even(15.0), even(60.0)]), memory=COUNT)  # helps one column, and spoils another
    assert preference(before, harmful) < 0.1


def at(place: str, fitted: float, heldout: float) -> Trial:
    """Dry friction at a joint, and what it leaves of both parts."""
    chi2 = even(fitted)
    now = replace(
        left(even(heldout)),
        train_columns=chi2.mean(axis=1),
        train_cells=chi2 * COUNT,
        train_counts=np.full(chi2.shape, COUNT),
    )
    return Trial(Hypothesis(CoulombFriction, (place,), False, np.ones(1), 1.0), now)


@pytest.mark.parametrize(
    ("hip", "moves"),
    [
        (at("hip", 1.5, 2.01), True),  # held-out data hardly tell the two apart, fitted ones do
        (at("hip", 1.7, 2.01), False),
        (at("hip", 1.5, 2.6), False),  # held-out data tell
        (at("hip", 1.6, 2.0), False),  # alike
    ],
)
def test_of_places_at_which_an_effect_does_as_well_it_goes_where_all_data_say_more(hip: Trial, moves: bool) -> None:
    knee = at("knee", 1.6, 2.0)
    assert at_the_likeliest_place(RULES, knee, [hip, knee]) is (hip if moves else knee)


@given(st.lists(st.floats(1.0, 50.0), min_size=2, max_size=6), st.integers(0, 5))
def test_weights_are_a_distribution_and_do_not_depend_on_the_order(chi2: list[float], turn: int) -> None:
    models = [left(even(c)) for c in chi2]
    share = weights(models, models[0], [1] * len(models))
    assert share.sum() == pytest.approx(1)
    turned = models[turn % len(models) :] + models[: turn % len(models)]
    np.testing.assert_allclose(np.roll(share, -(turn % len(models))), weights(turned, models[0], [1] * len(models)))


def test_what_a_model_states_is_evidence_beside_the_data() -> None:
    alike = left(even(1.0))
    far, near = replace(alike, prior_residual=np.array([2.0, 2.0])), replace(alike, prior_residual=np.array([0.0, 2.0]))
    odds = np.exp(-0.5 * np.array([8.0, 4.0]))
    np.testing.assert_allclose(weights([far, near], alike, [0, 0]), odds / odds.sum())
    assert left_where_it_acts(far, near) == pytest.approx(1 / 3)  # of a mean square of 4, 2 is left: 1 of 3 above 1
    assert (
        left_where_it_acts(
            replace(alike, prior_residual=np.array([5.0])), replace(alike, prior_residual=np.array([0.5]))
        )
        == 0.0
    )
    # where it counts beside one model and not beside another they cannot be compared by it
    np.testing.assert_allclose(weights([far, alike], alike, [0, 0]), 0.5)
    assert left_where_it_acts(far, alike) == 1.0


def test_what_is_left_counts_where_the_effect_acts() -> None:
    without = left(np.array([[101.0], [3.0], [1.0]]))
    assert left_where_it_acts(without, left(np.array([[1.0], [3.0], [1.0]]))) == pytest.approx(0)
    assert left_where_it_acts(without, left(np.array([[51.0], [3.0], [1.0]]))) == pytest.approx(0.5)
    assert left_where_it_acts(without, without) == 1.0
    assert share_explained(101.0, 51.0) == pytest.approx(0.5)
    assert share_explained(1.0, 1.0) == 0.0
    assert share_explained(2.0, 3.0) == 0.0


KNOWN = {"family": 0.9, "place": 0.99, "left": 0.05}


@pytest.mark.parametrize(("name", "better"), [("family", 0.99), ("left", 0.01)])
def test_certainty_grows_with_what_speaks_for_a_name(name: str, better: float) -> None:
    assert STANDARD.certainty({**KNOWN, name: better}) > STANDARD.certainty(KNOWN)
    for extreme in (0.0, 1.0):
        assert 0 < STANDARD.certainty({**KNOWN, name: extreme}) < 1


def test_a_calibration_is_logistic() -> None:
    flat = replace(STANDARD, constant=np.log(3.0), family=0.0, place=0.0, explained=0.0)
    assert flat.certainty(KNOWN) == pytest.approx(0.75)
