"""One effect at several locations: what it explains at all of them together, and with which amounts."""

from __future__ import annotations

import numpy as np
import pytest

from sysid_btr._typing import FloatArray
from sysid_btr.diagnosis.hypotheses import Hypothesis, curves_of_all, curves_together, form_hypotheses
from sysid_btr.diagnosis.scan import Perturbation, Residual, Sensitivity, perturbations
from sysid_btr.diagnosis.selection import STANDARD
from sysid_btr.terms.free_form import (
    FreeCurve,
    FreeFrictionSpeed,
    FreeGainOfAll,
    FreeGainTime,
    FreeTorquePeriodic,
    FreeTorquePosition,
)
from sysid_btr.terms.friction import CoulombFriction
from sysid_btr.terms.scales import JointScale, Scales
from sysid_btr.terms.spring import JointSpring

ROWS = 400
JOINTS = ("shoulder", "elbow")
SCALES: Scales = dict.fromkeys(JOINTS, JointScale(1.0, 2.0, 1.0, 2.0, 1.0, 1.0))


def scanned(response: FloatArray, residual: FloatArray) -> list[Sensitivity]:
    """What a scan finds of dry friction at each joint alone, of responses (rows, joints) to its probe."""
    result = []
    whole = Residual.of(residual, np.zeros((ROWS, 0)))
    for joint, column in zip(JOINTS, response.T, strict=True):
        probe = CoulombFriction.probes(SCALES[joint])[0]
        amount = float(-column @ residual / (column @ column))
        gain = amount**2 * float(column @ column)
        one = Perturbation(CoulombFriction, (joint,), probe)
        values = CoulombFriction.combine(SCALES[joint], probe, np.array([amount]))
        assert values is not None
        result.append(Sensitivity(one, whole, np.arange(ROWS), column[:, None], np.array([amount]), gain, values))
    return sorted(result, key=lambda s: -s.gain)


def both(response: FloatArray, residual: FloatArray) -> Hypothesis:
    """The hypothesis of dry friction at both joints, each with its amount."""
    found = form_hypotheses(scanned(response, residual), ROWS, SCALES, STANDARD)
    return next(h for h in found if len(h.places) == 2 and not h.shared)


@pytest.mark.parametrize("alike", [0.0, 0.5, 0.9])
def test_amounts_at_joints_that_move_each_other_are_found_together(alike: float) -> None:
    """Alone each joint would take what the other one explains as well."""
    rng = np.random.default_rng(1)
    first, other = rng.normal(size=(2, ROWS))
    response = np.column_stack([first, alike * first + np.sqrt(1 - alike**2) * other])
    probe = np.array([CoulombFriction.probes(SCALES[j])[0][0][0] for j in JOINTS])
    truth = np.array([0.3, 0.2])
    residual = -response @ (truth / probe) + 0.05 * rng.normal(size=ROWS)
    found = both(response, residual)
    amounts = dict(zip(found.places, found.start, strict=True))
    assert [amounts[j] for j in JOINTS] == pytest.approx(truth, rel=0.05)


@pytest.mark.parametrize("alike", [0.0, 0.9])
def test_no_hypothesis_promises_more_than_there_is(alike: float) -> None:
    rng = np.random.default_rng(2)
    first, other = 20 * rng.normal(size=(2, ROWS))
    response = np.column_stack([first, alike * first + np.sqrt(1 - alike**2) * other])
    residual = -response @ np.array([1.0, 1.5]) + rng.normal(size=ROWS)
    found = form_hypotheses(scanned(response, residual), ROWS, SCALES, STANDARD)
    assert {len(h.places) for h in found} == {1, 2}
    assert all(h.gain <= float(residual @ residual) for h in found)


def test_a_joint_that_adds_nothing_is_not_joined() -> None:
    rng = np.random.default_rng(3)
    first = rng.normal(size=ROWS)
    response = np.column_stack([first, 0.99 * first + 0.01 * rng.normal(size=ROWS)])
    residual = -5 * first + 0.1 * rng.normal(size=ROWS)
    found = form_hypotheses(scanned(response, residual), ROWS, SCALES, STANDARD)
    assert {h.places for h in found} == {("shoulder",)}


def test_one_amount_at_all_places_is_tried_once() -> None:
    """Simulated alike at all places, and found alike at each, it is one hypothesis."""
    rng = np.random.default_rng(4)
    response = rng.normal(size=(ROWS, 2))
    residual = -5 * response.sum(axis=1) + 0.1 * rng.normal(size=ROWS)
    single = scanned(response, residual)
    together = single[0].perturbation
    alike = Perturbation(together.effect, JOINTS, together.probe)
    column = response.sum(axis=1, keepdims=True)
    amounts = np.array([5.0])
    gain = float(residual @ residual)
    everywhere = Sensitivity(alike, single[0].residual, np.arange(ROWS), column, amounts, gain, single[0].values)
    found = form_hypotheses([everywhere, *single], ROWS, SCALES, STANDARD)
    assert sum(h.shared for h in found) == 1


def test_curves_that_are_the_best_of_several_joints_are_one_hypothesis_with_the_numbers_of_each() -> None:
    def curve(form: type[FreeCurve], joint: str, gain: float) -> Hypothesis:
        return Hypothesis(form, (joint,), False, np.full(len(form.kinds), gain), gain)

    found = [
        curve(FreeTorquePeriodic, "left", 900.0),
        curve(FreeTorquePeriodic, "right", 700.0),
        curve(FreeFrictionSpeed, "hip", 600.0),
        curve(FreeTorquePeriodic, "head", 200.0),  # too little beside the first
        curve(FreeTorquePosition, "right", 650.0),  # not the best of its joint
        curve(FreeFrictionSpeed, "left", 800.0),
    ]
    (one,) = curves_together(found, STANDARD)
    assert one.effect is FreeTorquePeriodic
    assert one.places == ("left", "right")
    assert one.gain == 1600.0
    np.testing.assert_array_equal(one.start, np.repeat([900.0, 700.0], len(FreeTorquePeriodic.kinds)))
    assert curves_together(found[2:3], STANDARD) == []


def test_a_gain_that_several_drives_ask_for_is_asked_of_all_where_it_is_sought() -> None:
    found = [
        Hypothesis(effect, (joint,), False, np.full(len(effect.kinds), gain), gain)
        for effect, joint, gain in (
            (FreeGainTime, "left", 900.0),
            (FreeTorquePosition, "right", 500.0),
            (FreeGainTime, "right", 400.0),  # not the best of its joint
            (FreeGainTime, "middle", 60.0),
        )
    ]
    (one,) = curves_of_all(found, (CoulombFriction, FreeGainOfAll))
    assert (one.effect, one.places, one.gain) == (FreeGainOfAll, ("robot",), 960.0)
    np.testing.assert_array_equal(one.start, found[0].start)
    assert curves_of_all(found, (CoulombFriction, FreeGainTime)) == []
    assert curves_of_all(found[:2], (FreeGainOfAll,)) == [], "one drive alone"


def test_what_may_be_alike_everywhere_is_asked_at_joints_that_limbs_have_in_common() -> None:
    """Over a base that moves, friction of all knees need not look like that of any one."""
    legs = ("a", "b", "c")
    joints = tuple(leg + part for leg in legs for part in ("hip", "knee"))
    alike = (tuple(leg + "hip" for leg in legs), tuple(leg + "knee" for leg in legs))
    scales = dict.fromkeys(joints, SCALES["elbow"])
    asked = perturbations((CoulombFriction, JointSpring), {"joint": joints}, scales, alike)
    together = {(q.effect, q.places) for q in asked if len(q.places) > 1}
    assert together == {(CoulombFriction, places) for places in (joints, *alike)}
    assert {q.places for q in asked if q.effect is JointSpring} == {(joint,) for joint in joints}
