"""The same said of other places: what most joints have, beside a term that is free for all alike, is what all have."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from test_diagnosis_search import begun
from test_diagnosis_selection import fitted, trial
from test_segmented import double_pendulum, driven

from sysid_btr.diagnosis import exchange as module
from sysid_btr.diagnosis.exchange import _at_fewer, _Part, _said_of_more, is_believed, preferred
from sysid_btr.diagnosis.hypotheses import Hypothesis
from sysid_btr.diagnosis.selection import STANDARD
from sysid_btr.diagnosis.uncertainty import is_sized
from sysid_btr.identify.refit import refit
from sysid_btr.identify.study import make_study
from sysid_btr.simulation.numerics import Numerics
from sysid_btr.terms.friction import CoulombFriction
from sysid_btr.terms.model import Model
from sysid_btr.terms.servo import Kp
from sysid_btr.terms.spring import JointSpring

COMMON = Kp(("hip", "knee", "ankle"), shared=True)


def part_of(*places: str, amount: float) -> tuple[_Part, Model]:
    effect = Kp(places)
    return _Part(effect, places), Model.of((COMMON, effect), [0.9, *np.full(len(places), amount)])


def test_a_gain_of_most_joints_may_be_one_of_the_others() -> None:
    (found,) = _at_fewer(*part_of("hip", "knee", amount=1.25))
    assert found.places == ("ankle",)
    assert found.start == pytest.approx([0.75])
    assert not _at_fewer(*part_of("hip", amount=1.25))


def test_a_gain_of_one_joint_is_not_said_of_the_others() -> None:
    part, model = part_of("ankle", amount=0.8)
    other = Hypothesis(Kp, ("knee", "hip"), False, np.full(2, 1.25), 1.0)
    assert _said_of_more(other, part, model)
    assert not _said_of_more(Hypothesis(CoulombFriction, ("knee", "hip"), False, np.ones(2), 1.0), part, model)
    assert not _said_of_more(Hypothesis(Kp, ("knee",), False, np.ones(1), 1.0), part, model)


def test_without_a_term_for_all_places_are_what_they_are() -> None:
    effect = Kp(("hip", "knee"))
    alone = Model.of((CoulombFriction(("hip", "knee", "ankle"), shared=True), effect), [0.1, 1.25, 1.25])
    assert not _at_fewer(_Part(effect, effect.places), alone)


@pytest.mark.parametrize(("chance", "replaced"), [(1.0, False), (0.05, True)])
def test_what_has_more_numbers_takes_a_place_where_data_miss_them(chance: float, replaced: bool) -> None:
    """By 10 % of chi2: of two samples that is chance, of 800 it is not."""
    own = trial(CoulombFriction, fitted([5.5], chance=chance))
    wider = trial(JointSpring, fitted([5.0], chance=chance))
    numbers = np.arange(3.0)
    wider = replace(
        wider, fitted=replace(wider.fitted, model=Model.of((CoulombFriction(("hip",)), JointSpring(("hip",))), numbers))
    )
    assert preferred(STANDARD, [own, wider]) is (wider if replaced else own)


@pytest.mark.parametrize("sized", [True, False])
@pytest.mark.parametrize(("left", "believed"), [(4.9, True), (5.1, False)])
def test_where_errors_grow_what_predicts_no_worse_with_fewer_numbers_is_believed(
    left: float, believed: bool, sized: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A band of eight numbers stood for a constant torque, and a name that is not likely took no place.

    Nor does what has numbers that may all be nothing: beside it nothing else has an amount.
    """
    monkeypatch.setattr(module, "is_sized", lambda *_: sized)
    study = begun().study
    band, simple = trial(JointSpring, fitted([5.0])), trial(CoulombFriction, fitted([left]))
    assert is_believed(STANDARD, study, simple, [band, simple]) is (believed and sized)
    assert not is_believed(STANDARD, study, band, [simple, band])


@pytest.mark.parametrize(("planted", "sized"), [("0.05", True), ("0", False)])
def test_what_may_be_nothing_has_no_size(planted: str, sized: bool) -> None:
    log = driven(dry=f'frictionloss="{planted}"')
    study = make_study(double_pendulum(), [log], numerics=Numerics("RK4", 0.005), threads=1)
    term = CoulombFriction(("shoulder", "elbow"))
    found = refit(study, Model.of((*study.declare(["mass:*"]), term), [1.0, 1.0, 0.02, 0.02]))
    assert is_sized(study, found) is sized
