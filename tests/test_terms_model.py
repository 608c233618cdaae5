"""Terms and their numbers: what comes and goes with a term, whatever the others are."""

from __future__ import annotations

import pickle
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sysid_btr.terms.base import Parameter, Term
from sysid_btr.terms.friction import CoulombFriction
from sysid_btr.terms.inertial import ComOffset, Mass
from sysid_btr.terms.model import Model, Terms, as_model
from sysid_btr.terms.servo import Kp
from sysid_btr.terms.transmission import Backlash, JointCompliance

KINDS = (Mass, ComOffset, Kp, CoulombFriction)


@st.composite
def models(draw: st.DrawFn) -> Model:
    """Models of one to four terms at one to three places each, with numbers that are all different."""
    kinds = draw(st.permutations(KINDS))[: draw(st.integers(1, len(KINDS)))]
    terms: list[Term] = []
    for kind in kinds:
        places = ("a", "b", "c")[: draw(st.integers(1, 3))]
        terms.append(kind(places=places, shared=draw(st.booleans())))
    return Model.of(terms, np.arange(len(Terms(terms).parameters)) + 1.0)


@given(models())
def test_the_numbers_of_a_term_stand_where_its_parameters_do(model: Model) -> None:
    names = np.array(model.terms.names)
    for term, own in model.parts:
        assert names[model.terms.columns(term)].tolist() == [p.name for p in term.parameters]
        assert own.tolist() == model.own(term).tolist() == model.values[model.terms.columns(term)].tolist()
    assert np.concatenate([own for _, own in model.parts]).tolist() == model.values.tolist()


@given(models(), st.data())
def test_taking_a_term_away_and_putting_it_back_leaves_the_others_alone(model: Model, data: st.DataObject) -> None:
    term = data.draw(st.sampled_from(model.terms))
    own, rest = model.own(term), model.without(term)
    assert term not in rest.terms
    for other in rest.terms:
        assert rest.own(other).tolist() == model.own(other).tolist()
    again = rest.with_(term, own)
    assert again.terms[-1] is term
    assert again.own(term).tolist() == own.tolist()
    assert model.only(term).values.tolist() == own.tolist()
    assert model.replaced(term).values.tolist() == rest.values.tolist()
    assert model.replaced(term, (term, own)).values.tolist() == model.values.tolist()


@given(models())
def test_split_gives_the_same_of_one_candidate_and_of_many(model: Model) -> None:
    many = np.stack([model.values, 2 * model.values])
    for (_, one), (_, both) in zip(model.terms.split(model.values), model.terms.split(many), strict=True):
        assert both.tolist() == [one.tolist(), (2 * one).tolist()]


def test_numbers_that_do_not_fit_are_refused() -> None:
    with pytest.raises(ValueError, match="2 parameters have 3 numbers"):
        Model.of((Mass(places=("a", "b")),), [1.0, 2.0, 3.0])
    with pytest.raises(ValueError, match="not in"):
        Terms((Mass(places=("a",)),)).columns(Kp(places=("a",)))


def test_bare_terms_are_nominal_and_bounds_hold() -> None:
    terms = (Mass(places=("a",)), CoulombFriction(places=("b",)))
    assert as_model(terms).values.tolist() == [1.0, 0.0]
    model = Model.of(terms, [99.0, -1.0])
    assert as_model(model) is model
    assert model.clipped().values.tolist() == [3.0, 0.0]


def test_what_was_worked_out_of_terms_is_not_sent() -> None:
    terms = Terms((Mass(places=("a",)),))
    bare = pickle.dumps(terms)
    assert terms.parameters
    assert pickle.dumps(terms) == bare
    assert pickle.loads(bare) == terms


def test_what_is_free_for_all_places_alike_leaves_each_its_own() -> None:
    alike, own = Terms([Kp(("a", "b"), shared=True)]), Terms([Kp(("a", "b"))])
    assert alike.admit(Kp, ("a",))
    assert not alike.admit(Kp, ("b", "a"))
    assert not own.admit(Kp, ("b", "c"))
    assert own.admit(Kp, ("c",))


def test_a_joint_is_split_once() -> None:
    play = Terms([Backlash(("a",))])
    assert not play.admit(JointCompliance, ("b", "a"))
    assert play.admit(JointCompliance, ("b",))
    assert play.admit(CoulombFriction, ("a",))


def test_a_bound_grows_until_it_holds_what_was_found_unless_it_is_stated_or_physical() -> None:
    free = Parameter("coulomb_friction:a", "Nm", 0.0, 0.0, 0.5, 0.1)
    assert free.holding(0.4) == free
    assert free.holding(3.0).upper == pytest.approx(12.5)
    assert free.holding(-1.0) == free
    assert replace(free, stated=True).holding(3.0).upper == 0.5
    assert Parameter("voltage_sag", "1", 0.0, 0.0, 0.9, 0.1).holding(1.2).upper == 0.9
    assert Parameter("encoder_offset:a", "rad", 0.0, -0.1, 0.1, 0.01).holding(-0.2).lower == pytest.approx(-0.5)
    assert Parameter("mass:a", "1", 1.0, 0.3, 3.0, 0.1).holding(0.2).lower == pytest.approx(0.06)
