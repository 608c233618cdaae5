"""Every rule of a diagnosis, and what it says on either side of each of its thresholds."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import FrozenInstanceError, fields, replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sysid_btr.diagnosis.closing import Candidate, NamedEffect, Verdict
from sysid_btr.diagnosis.evidence import evidence_of, is_likely
from sysid_btr.diagnosis.hypotheses import Hypothesis, form_hypotheses
from sysid_btr.diagnosis.messages import message_of
from sysid_btr.diagnosis.scan import Perturbation, Residual, Sensitivity
from sysid_btr.diagnosis.selection import (
    Selection,
    agree,
    all_explained,
    at_floor,
    column_limit,
    could_gain,
    distance_from_nothing,
    doubtful_location,
    explains_fitted,
    has_minimum_gain,
    improves,
    improves_once,
    is_explained,
    is_log_explained,
    is_needed,
    relieves,
    shows_late,
    something_left,
    verdict_limit,
)
from sysid_btr.diagnosis.trials import (
    ADDED,
    Trial,
    candidates_of,
    choose,
    has_law,
    is_hopeless,
    is_outdone,
    is_rival,
    is_superfluous,
    may_be_elsewhere,
)
from sysid_btr.diagnosis.verdict import giving_way, verdict_of
from sysid_btr.identify.intervals import Estimate
from sysid_btr.identify.refit import Fitted, paired_t
from sysid_btr.identify.scores import Scores
from sysid_btr.simulation.numerics import Numerics
from sysid_btr.terms.disturbance import ExternalDisturbance
from sysid_btr.terms.effect import Effect
from sysid_btr.terms.free_form import FreeFrictionSpeed, FreeReadingTime, FreeTorqueLoad, FreeTorquePeriodic
from sysid_btr.terms.friction import CoulombFriction, LoadFriction, LoadFrictionLarger, StribeckFriction, ViscousDamping
from sysid_btr.terms.inertial import Mass, Payload
from sysid_btr.terms.model import Model
from sysid_btr.terms.scales import JointScale, Scales
from sysid_btr.terms.sensing import EncoderCyclicError, SensorDelay
from sysid_btr.terms.servo import CommandDelay

RULES = Selection()
Numbers = Sequence[float]


def fitted(
    holdout: Numbers = (1.0,),
    train: Numbers | None = None,
    columns: Numbers | None = None,
    *,
    chance: float = 0.0,
    ahead: float = 0.0,
    model: Model | None = None,
) -> Fitted:
    """Chi2 of each column, held out, fitted (default: the same) and of all data (default: the held-out).

    `ahead` is the paired t by which it is better than what is ahead by 0, if the other is so by 0.
    """
    held_out = np.array(holdout, dtype=np.float64)
    fit = held_out if train is None else np.array(train, dtype=np.float64)
    # four stretches whose differences from 100 have this t: mean / (spread / sqrt(4))
    gains = 0.5 * ahead * np.sqrt(4 / 3) + np.array([-1.0, 1.0, -1.0, 1.0])
    cells = np.zeros((len(held_out), 4))
    cells[0] = 100 - (gains if ahead else 0.0)
    # as many samples in four stretches as make a column's chi2 scatter by so much
    samples = 2 / max(chance, 1e-9) ** 2
    return Fitted(
        model=Model.of(()) if model is None else model,
        train=float(np.mean(fit)),
        holdout=float(np.mean(held_out)),
        train_columns=fit,
        holdout_columns=held_out,
        columns=held_out if columns is None else np.array(columns, dtype=np.float64),
        memory=np.ones(len(fit)),
        holdout_memory=np.ones(len(held_out)),
        train_cells=np.zeros((len(fit), 0)),
        holdout_cells=cells,
        train_counts=np.zeros((len(fit), 0)),
        holdout_counts=np.full(cells.shape, samples / 4),
        evaluations=1,
        numerics=Numerics("RK4", 0.005),
    )


@pytest.mark.parametrize("t", [-4.0, 0.5, 2.9, 3.1])
def test_the_values_of_these_tests_have_the_paired_t_that_they_say(t: float) -> None:
    assert paired_t(fitted(ahead=t), fitted()) == pytest.approx(t)
    assert paired_t(fitted(), fitted(ahead=t)) == pytest.approx(-t)


def test_a_selection_is_a_value_and_its_thresholds_can_be_varied_one_by_one() -> None:
    assert Selection() == RULES
    with pytest.raises(FrozenInstanceError):
        RULES.gain = 0.5  # type: ignore[misc]
    before, after = fitted([10.0]), fitted([9.6], ahead=4)
    assert improves(RULES, before, after)
    assert not improves(Selection(gain=0.05), before, after)
    assert not improves(replace(RULES, t=5.0), before, after)
    assert all(f.default is not None for f in fields(Selection))


# --- the floor -----------------------------------------------------------------------------------------------


def test_the_limit_of_a_column_grows_with_what_chance_does_to_it() -> None:
    np.testing.assert_allclose(column_limit(RULES, np.array([0.0, 0.1])), [1.12, 1.42])


@pytest.mark.parametrize(
    ("now", "expected"),
    [
        (fitted([1.0]), True),
        (fitted([1.02]), True),
        (fitted([1.04]), False),
        (fitted([1.04], chance=0.01), True),
        (fitted([1.07], chance=0.01), False),
        (fitted([1.0, 1.0], columns=[1.0, 1.11]), True),
        (fitted([1.0, 1.0], columns=[1.0, 1.13]), False),
        (fitted([1.0, 1.0], columns=[1.0, 1.13], chance=0.01), True),
        (fitted([1.0, 1.0], columns=[1.0, 1.16], chance=0.01), False),
    ],
)
def test_at_floor(now: Fitted, expected: bool) -> None:
    assert at_floor(RULES, now) is expected


@pytest.mark.parametrize(
    ("first", "now", "expected"),
    [
        ([101.0], [1.59], True),
        ([101.0], [1.61], False),
        ([1.0], [1.11], True),
        ([1.0], [1.13], False),
        ([101.0, 1.0], [1.59, 1.11], True),
        ([101.0, 1.0], [1.11, 1.59], False),
        ([101.0, 101.0], [1.0], False),
    ],
)
def test_all_explained(first: Numbers, now: Numbers, expected: bool) -> None:
    assert all_explained(RULES, fitted(first), fitted(now)) is expected


@pytest.mark.parametrize(
    ("first", "now", "expected"),
    [
        ([11.0], [2.1], True),
        ([11.0], [1.9], False),
        ([1.5], [1.11], False),
        ([1.5], [1.13], True),
        ([11.0, 11.0], [1.0, 2.1], True),
        ([11.0, 1.0], [1.0, 1.0], False),
        ([11.0, 11.0], [2.1], False),
    ],
)
def test_something_left(first: Numbers, now: Numbers, expected: bool) -> None:
    assert something_left(RULES, fitted(first), fitted(now)) is expected


# --- whether an effect is added, or stays -----------------------------------------------------------------------


@pytest.mark.parametrize(
    ("first", "before", "after", "transient", "expected"),
    [
        ([101.0], [101.0], [100.75], False, True),
        ([101.0], [101.0], [100.85], False, False),
        ([101.0], [50.0], [49.75], False, True),
        ([101.0], [101.0], [101.5], False, False),
        ([101.0], [101.0], [97.0], True, False),
        ([101.0], [101.0], [95.0], True, True),
        ([101.0, 2.0], [101.0, 2.0], [101.0, 1.99], False, True),
        ([1.0], [1.0], [1.0 - 3e-6], False, False),
        ([1.0], [1.0], [1.0 - 5e-6], False, True),
        ([101.0, np.nan], [101.0, np.nan], [100.75, np.nan], False, True),
        ([101.0, 101.0], [101.0], [101.0], False, True),
    ],
)
def test_has_minimum_gain(first: Numbers, before: Numbers, after: Numbers, transient: bool, expected: bool) -> None:
    gains = has_minimum_gain(RULES, fitted(first), fitted(before), fitted(after), transient=transient)
    assert gains is expected


@pytest.mark.parametrize(("left", "expected"), [(97.6, False), (97.4, True)])
def test_a_curve_beside_named_effects_removes_more_than_the_right_form_may_leave(left: float, expected: bool) -> None:
    first, after = fitted([101.0]), fitted([1 + left])
    assert has_minimum_gain(RULES, first, first, after)
    assert has_minimum_gain(RULES, first, first, after, learnt=True) is expected


def test_a_longer_ladder_of_effects_is_no_shorter_for_what_happens_at_some_moment() -> None:
    first, after = fitted([101.0]), fitted([95.0])
    assert not has_minimum_gain(Selection(minimum_gain=0.1), first, first, after, transient=True)


LARGE = [10.0, 10.0, 10.0, 10.0, 10.0, 10.0]


@pytest.mark.parametrize(
    ("before", "after", "expected"),
    [
        # of all the held-out data, and not by chance
        (fitted([10.0]), fitted([9.6], ahead=3.1), True),
        (fitted([10.0]), fitted([9.6], ahead=2.9), False),
        (fitted([10.0]), fitted([9.8], ahead=3.1), False),
        (fitted([10.0]), fitted([10.4], ahead=-3.1), False),
        (fitted([10.0]), fitted([10.4], ahead=3.1), False),
        # so much needs no test
        (fitted([10.0]), fitted([6.9]), True),
        (fitted([10.0]), fitted([7.1]), False),
        # of one column
        (fitted(LARGE), fitted([8.4, *LARGE[1:]], ahead=3.1), True),
        (fitted(LARGE), fitted([8.6, *LARGE[1:]], ahead=3.1), False),
        (fitted(LARGE), fitted([8.4, *LARGE[1:]], ahead=2.9), False),
        (fitted(LARGE), fitted([6.9, *LARGE[1:-1], 10.1]), True),
        (fitted(LARGE), fitted([7.1, *LARGE[1:-1], 10.1]), False),
        # of fitted data too, in sum or in most columns
        (fitted([10.0], [10.0]), fitted([6.0], [9.9]), True),
        (fitted([10.0], [10.0]), fitted([6.0], [10.1]), False),
        (fitted([10.0, 10.0], [100.0, 2.0]), fitted([6.0, 6.0], [101.0, 1.8]), True),
        (fitted([10.0, 10.0], [100.0, 2.0]), fitted([6.0, 6.0], [101.0, 1.95]), False),
    ],
)
def test_improves(before: Fitted, after: Fitted, expected: bool) -> None:
    assert improves(RULES, before, after) == expected


@pytest.mark.parametrize(
    ("before", "after", "expected"),
    [
        (fitted([1.0], [10.0]), fitted([1.0], [6.9]), True),
        (fitted([1.0], [10.0]), fitted([1.0], [7.1]), False),
        (fitted([1.0, 1.0], [10.0, 10.0]), fitted([1.0, 1.0], [10.0, 6.9]), True),
        (fitted([1.0], [10.0]), fitted([1.04], [6.9]), True),
        (fitted([1.0], [10.0]), fitted([1.06], [6.9]), False),
        (fitted([1.0], [10.0]), fitted([np.nan], [6.9]), False),
        (fitted([1.0], [10.0]), fitted([1.0], [14.0]), False),
    ],
)
def test_improves_once(before: Fitted, after: Fitted, expected: bool) -> None:
    assert improves_once(RULES, before, after) == expected


@pytest.mark.parametrize(
    ("before", "after", "expected"),
    [
        (fitted([1.0], [11.0]), fitted([1.0], [1.29]), True),
        (fitted([1.0], [11.0]), fitted([1.0], [1.31]), False),
        (fitted([1.0], [3.1]), fitted([1.0], [1.0]), True),
        (fitted([1.0], [2.9]), fitted([1.0], [1.0]), False),
        (fitted([1.0, 1.0], [2.9, 3.1]), fitted([1.0, 1.0], [1.0, 2.0]), False),
        (fitted([1.0, 1.0], [2.9, 3.1]), fitted([1.0, 1.0], [2.9, 1.0]), True),
        (fitted([1.0], [11.0]), fitted([1.009], [1.0]), True),
        (fitted([1.0], [11.0]), fitted([1.011], [1.0]), False),
    ],
)
def test_explains_fitted(before: Fitted, after: Fitted, expected: bool) -> None:
    assert explains_fitted(RULES, before, after) == expected


@pytest.mark.parametrize(
    ("without", "now", "expected"),
    [
        (fitted([10.0]), fitted([5.0]), True),
        (fitted([5.0]), fitted([10.0]), False),
        (fitted([1.0], [11.0]), fitted([1.0], [1.0]), True),
        (fitted([1.0], [1.0]), fitted([1.0], [11.0]), False),
        (fitted([5.0]), fitted([5.0]), False),
    ],
)
def test_is_needed(without: Fitted, now: Fitted, expected: bool) -> None:
    assert is_needed(RULES, without, now) == expected


def test_could_gain() -> None:
    """An excess of 0.3 % of the first one allows a law, which must remove 0.2 %, and no curve, which must 2.5 %."""
    first, now = fitted([1001.0]), fitted([4.0])
    assert could_gain(RULES, first, now)
    assert not could_gain(RULES, first, now, learnt=True)
    # less allows a law that leaves nothing
    assert could_gain(RULES, first, fitted([1.5]))
    assert not could_gain(RULES, first, fitted([1.1]))


def test_what_removes_all_that_is_left_is_no_trace_however_far_off_the_first_model_was() -> None:
    first, now = fitted([1e6]), fitted([201.0])
    assert has_minimum_gain(RULES, first, now, fitted([5.0]))
    # what mends the shape of another effect leaves more
    assert not has_minimum_gain(RULES, first, now, fitted([7.0]))
    for may_fit_anything in ({"learnt": True}, {"transient": True}):
        assert not has_minimum_gain(RULES, first, now, fitted([1.0]), **may_fit_anything)


def far(off: float, loss: float = 1000.0, holdout: float = 1.0, effect: Effect | None = None) -> Fitted:
    """A fit of the mass of a knee that is so many of robots' spreads off, perhaps beside an effect."""
    model = Model.of((Mass(("knee",)), *((effect,) if effect else ())))
    cells = np.full((1, 4), loss / 4)
    return replace(fitted([holdout], model=model), train_cells=cells, prior_residual=np.array([off]))


LOAD = Payload(("hip",))


@pytest.mark.parametrize(
    ("without", "now", "expected"),
    [
        (far(7.0), far(1.0, effect=LOAD), True),  # 49 - 1 for nothing
        (far(7.0), far(1.0, 1015.0, effect=LOAD), False),  # of which the data take too much
        (far(6.0), far(1.0, effect=LOAD), False),
        (far(6.0), far(1.0, 990.0, effect=LOAD), True),
        (far(7.0), far(1.0, holdout=1.02, effect=LOAD), False),
        (far(7.0), far(1.0, effect=Payload(("knee",))), False),  # that is the mass of the knee
        (far(3.0, 1040.0), far(1.0, effect=LOAD), False),  # nothing is wrong with a mass like this
    ],
)
def test_an_effect_relieves_a_model_of_masses_that_robots_do_not_have(
    without: Fitted, now: Fitted, expected: bool
) -> None:
    assert relieves(RULES, without, now) is expected
    assert is_needed(RULES, without, now) is expected


# --- locations and amounts ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("size", "expected"), [([1.0, 0.49], 1), ([0.1, 0.49, 1.0], 0), ([1.0, 0.51], None), ([1.0, 1.0], None)]
)
def test_doubtful_location(size: Numbers, expected: int | None) -> None:
    assert doubtful_location(RULES, np.array(size)) == expected


@pytest.mark.parametrize(
    ("amounts", "expected"),
    [
        ([1.0, 1.04, 1.0], True),
        ([1.0, 1.06, 1.0], False),
        ([1.0, 0.94, 1.0], False),
        ([-1.0, -1.04, -1.0], True),
        ([0.0, 0.0, 0.1], False),
    ],
)
def test_agree(amounts: Numbers, expected: bool) -> None:
    assert agree(np.array(amounts), RULES.common_amount) is expected


def estimate(value: float, std: float, *, identifiable: str = "yes") -> Estimate:
    interval = (value - 2 * std, value + 2 * std)
    return Estimate("a", "Nm", 0.0, value, std, interval, (-9.0, 9.0), identifiable, False, "")  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("found", "neutral", "expected"),
    [
        (estimate(1.0, 0.4), 0.0, np.inf),
        (estimate(1.0, 0.8), 0.0, 1.25),
        (estimate(-1.0, 0.8), 0.0, 1.25),
        (estimate(-1.0, 0.4), 0.0, np.inf),
        (estimate(1.0, 0.4), 0.8, 0.5),
        (estimate(1.0, 0.4, identifiable="no"), 0.0, 0.0),
    ],
)
def test_distance_from_nothing(found: Estimate, neutral: float, expected: float) -> None:
    assert distance_from_nothing(found, neutral) == pytest.approx(expected)


# --- which trials are made, and which one wins ----------------------------------------------------------------------


def hypothesis(effect: type[Effect], *places: str, gain: float = 100.0, shared: bool = False) -> Hypothesis:
    places = places or ("knee",)
    size = len(effect.kinds) * (1 if shared else len(places))
    return Hypothesis(effect, places, shared, np.zeros(size), gain)


def trial(effect: type[Effect], now: Fitted, *places: str, gain: float = 100.0) -> Trial:
    return Trial(hypothesis(effect, *places, gain=gain), now)


SIMPLE, GENERAL, OTHER, EVENT = CoulombFriction, StribeckFriction, ViscousDamping, ExternalDisturbance


def test_the_effects_of_these_tests_are_what_they_are_taken_for() -> None:
    assert SIMPLE.name in GENERAL.includes
    assert hypothesis(GENERAL).complexity > hypothesis(SIMPLE).complexity == hypothesis(OTHER).complexity
    assert EVENT.transient
    assert not SIMPLE.transient
    assert CommandDelay.name in SensorDelay.yields_to
    assert LoadFriction.name == LoadFrictionLarger.name


@pytest.mark.parametrize(
    ("now", "one", "expected"),
    [
        (fitted([1.0]), hypothesis(OTHER, gain=79.0), True),
        (fitted([1.0]), hypothesis(OTHER, gain=81.0), False),
        (fitted([1.04]), hypothesis(OTHER, gain=79.0), False),
        (fitted([1.0]), hypothesis(GENERAL, gain=79.0), True),
    ],
)
def test_what_is_no_simpler_than_a_full_explanation_is_superfluous(
    now: Fitted, one: Hypothesis, expected: bool
) -> None:
    assert is_superfluous(RULES, one, [trial(SIMPLE, now)]) is expected
    assert not is_superfluous(RULES, one, [])


@pytest.mark.parametrize(("gain", "expected"), [(49.0, True), (51.0, False)])
def test_what_is_simpler_than_a_full_explanation_must_promise_less_to_be_superfluous(
    gain: float, expected: bool
) -> None:
    assert is_superfluous(RULES, hypothesis(SIMPLE, gain=gain), [trial(GENERAL, fitted())]) is expected


def of(effect: type[Effect], held_out: float, gain: float = 0.0) -> Trial:
    """A trial at one joint that leaves so much of all; `gain` is what was promised."""
    cells = np.full((1, 1), held_out)
    start = np.zeros(len(effect.kinds))
    return Trial(Hypothesis(effect, ("knee",), False, start, gain), replace(fitted([held_out]), train_cells=cells))


@pytest.mark.parametrize(
    ("curve", "law", "left", "first"),
    [
        (FreeFrictionSpeed, ViscousDamping, 40.0, True),  # most of what the curve does
        (FreeFrictionSpeed, ViscousDamping, 60.0, False),
        (FreeTorqueLoad, ViscousDamping, 40.0, True),
        (FreeTorquePeriodic, ExternalDisturbance, 3.0, True),  # nearly all of it
        (FreeTorquePeriodic, ExternalDisturbance, 4.0, False),
        (FreeTorquePeriodic, ViscousDamping, 2.0, False),  # nothing of the robot has a clock of its own
        (FreeReadingTime, EncoderCyclicError, 10.0, False),
        (FreeReadingTime, EncoderCyclicError, 2.0, True),
    ],
)
def test_a_law_goes_before_a_curve_if_it_explains_enough_of_the_same(
    curve: type[Effect], law: type[Effect], left: float, first: bool
) -> None:
    before = replace(fitted([100.0]), train_cells=np.full((1, 1), 100.0))
    simple, learnt = of(law, left), of(curve, 1.0, gain=99.0)
    assert has_law(RULES, learnt.hypothesis, before, [simple]) is first
    assert choose(RULES, before, [simple, learnt]) is (simple if first else learnt)


@pytest.mark.parametrize(
    ("chi2", "effect", "places", "expected"),
    [
        (6.0, LoadFriction, ("knee",), True),
        (5.0, LoadFriction, ("knee",), False),
        (6.0, LoadFrictionLarger, ("knee",), False),
        (6.0, LoadFriction, ("hip",), False),
        (6.0, SIMPLE, ("knee",), False),
    ],
)
def test_another_law_of_an_effect_that_did_far_worse_than_the_best_is_outdone(
    chi2: float, effect: type[Effect], places: tuple[str, ...], expected: bool
) -> None:
    trials = [trial(OTHER, fitted([2.0])), trial(LoadFrictionLarger, fitted([chi2]))]
    assert is_outdone(RULES, hypothesis(effect, *places), trials) is expected
    assert not is_outdone(RULES, hypothesis(effect, *places), [])


@pytest.mark.parametrize(
    ("gain", "tried", "expected"), [(49.0, 3, True), (51.0, 3, False), (49.0, 2, False), (49.0, 4, True)]
)
def test_is_hopeless(gain: float, tried: int, expected: bool) -> None:
    assert is_hopeless(RULES, hypothesis(OTHER, gain=gain), hypothesis(SIMPLE, gain=100.0), tried) is expected


BEFORE = fitted([10.0])


@pytest.mark.parametrize(
    ("trials", "winner"),
    [
        ([], None),
        ([trial(SIMPLE, fitted([10.0]))], None),
        ([trial(SIMPLE, fitted([5.0]))], 0),
        ([trial(SIMPLE, fitted([np.nan]))], None),
        ([trial(SIMPLE, fitted([5.0])), trial(OTHER, fitted([4.0]))], 1),
        # the simpler one, within 6 %
        ([trial(SIMPLE, fitted([5.25])), trial(GENERAL, fitted([5.0]))], 0),
        ([trial(SIMPLE, fitted([5.35])), trial(OTHER, fitted([5.0]))], 1),
        # a form with more numbers must be better beyond chance
        ([trial(SIMPLE, fitted([5.35])), trial(GENERAL, fitted([5.0]))], 0),
        ([trial(SIMPLE, fitted([5.35])), trial(GENERAL, fitted([5.0], ahead=2.9))], 0),
        ([trial(SIMPLE, fitted([5.35])), trial(GENERAL, fitted([5.0], ahead=3.1))], 1),
        ([trial(SIMPLE, fitted([6.9])), trial(GENERAL, fitted([5.0], ahead=2.9))], 0),
        # ... or far ahead, however little of the log tells the two apart
        ([trial(SIMPLE, fitted([4.0])), trial(GENERAL, fitted([1.5], ahead=2.9))], 0),
        ([trial(SIMPLE, fitted([4.2])), trial(GENERAL, fitted([1.5], ahead=2.9))], 1),
        ([trial(SIMPLE, fitted([5.35]), "hip"), trial(GENERAL, fitted([5.0]))], 1),
        ([trial(GENERAL, fitted([5.0])), trial(SIMPLE, fitted([5.25]))], 1),
        # ... but for another effect that is better beyond chance; a generalisation is none
        ([trial(OTHER, fitted([5.25]), "hip", "knee"), trial(SIMPLE, fitted([5.0]), "hip", "knee", "toe")], 0),
        ([trial(OTHER, fitted([5.25])), trial(GENERAL, fitted([5.0], ahead=3.1))], 1),
        ([trial(OTHER, fitted([5.25])), trial(GENERAL, fitted([5.0], ahead=2.9))], 0),
        ([trial(OTHER, fitted([5.0])), trial(GENERAL, fitted([5.25], ahead=3.1))], 0),
        ([trial(SIMPLE, fitted([5.25])), trial(GENERAL, fitted([5.0], ahead=3.1))], 0),
        # of two that no log can distinguish the one that the other yields to
        ([trial(SensorDelay, fitted([5.0])), trial(CommandDelay, fitted([5.2]))], 1),
        ([trial(SensorDelay, fitted([5.0])), trial(CommandDelay, fitted([5.4]))], 0),
    ],
)
def test_choose_the_simplest_of_the_best(trials: Sequence[Trial], winner: int | None) -> None:
    assert choose(RULES, BEFORE, trials) is (None if winner is None else trials[winner])


@pytest.mark.parametrize(
    ("lasting", "event", "winner"),
    [
        # misfit everywhere decides
        (fitted([5.0], columns=[8.0]), fitted([10.0], [5.0], [4.6]), 1),
        (fitted([5.0], columns=[5.0]), fitted([10.0], [5.0], [4.8]), 0),
        # ... but for a law that explains half of the same: what happens once may follow it
        (fitted([5.0], columns=[7.2]), fitted([10.0], [5.0], [4.6]), 0),
        (fitted([5.0], columns=[7.4]), fitted([10.0], [5.0], [4.6]), 1),
        (fitted([10.0], columns=[5.0]), fitted([10.0], [5.0], [9.0]), 1),
        (fitted([10.0], columns=[5.0]), fitted([10.0], [8.0], [9.0]), None),
        (fitted([10.0], columns=[5.0]), fitted([10.6], [5.0], [9.0]), None),
    ],
)
def test_choose_what_happens_once_where_it_explains_more_of_all_data(
    lasting: Fitted, event: Fitted, winner: int | None
) -> None:
    trials = [trial(SIMPLE, lasting), trial(EVENT, event)]
    assert choose(RULES, BEFORE, trials) is (None if winner is None else trials[winner])


def test_what_lasts_and_shows_in_the_fitted_part_as_if_once_is_no_event() -> None:
    assert choose(RULES, BEFORE, [trial(SIMPLE, fitted([10.0], [5.0], [4.0]))]) is None


@pytest.mark.parametrize(
    ("general", "simple", "winner"),
    [
        (fitted([1.0], [1.1], [5.0]), fitted([1.0], [1.1], [5.25]), 1),
        (fitted([1.0], [1.1], [5.0]), fitted([1.0], [1.1], [5.35]), 0),
        (fitted([1.0], [1.1], [5.0]), fitted([1.0], [2.0], [4.0]), 0),
        (fitted([1.0], [2.0], [5.0]), fitted([1.0], [2.0], [4.0]), None),
    ],
)
def test_choose_what_explains_the_fitted_part_where_held_out_data_want_nothing(
    general: Fitted, simple: Fitted, winner: int | None
) -> None:
    trials = [trial(GENERAL, general), trial(SIMPLE, simple)]
    found = choose(RULES, fitted([1.0], [11.0]), trials)
    assert found is (None if winner is None else trials[winner])


@pytest.mark.parametrize(
    ("winner", "other", "expected"),
    [
        (trial(SIMPLE, fitted([5.0])), trial(OTHER, fitted([5.7])), True),
        (trial(SIMPLE, fitted([5.0])), trial(OTHER, fitted([5.9])), False),
        (trial(SIMPLE, fitted([5.0], ahead=3.1)), trial(OTHER, fitted([5.7])), False),
        (trial(SIMPLE, fitted([5.0], ahead=2.9)), trial(OTHER, fitted([5.7])), True),
        (trial(SIMPLE, fitted([5.0])), trial(SIMPLE, fitted([5.0]), "hip"), False),
        (trial(SIMPLE, fitted([5.0])), trial(GENERAL, fitted([5.0])), False),
        (trial(GENERAL, fitted([5.0])), trial(SIMPLE, fitted([5.0])), True),
        (trial(CommandDelay, fitted([5.0])), trial(SensorDelay, fitted([5.0])), False),
        (trial(SensorDelay, fitted([5.0])), trial(CommandDelay, fitted([5.0])), True),
    ],
)
def test_is_rival(winner: Trial, other: Trial, expected: bool) -> None:
    assert is_rival(RULES, winner, other) is expected


@pytest.mark.parametrize(
    ("other", "expected"),
    [
        (trial(SIMPLE, fitted([5.7]), "hip"), True),
        (trial(SIMPLE, fitted([5.9]), "hip"), False),
        (trial(SIMPLE, fitted([5.0])), False),
        (trial(SIMPLE, fitted([5.0]), "hip", "ankle"), False),
        (trial(OTHER, fitted([5.0]), "hip"), False),
    ],
)
def test_the_same_may_sit_elsewhere(other: Trial, expected: bool) -> None:
    winner = trial(SIMPLE, fitted([5.0]))
    assert may_be_elsewhere(RULES, winner, other) is expected
    sure = trial(SIMPLE, fitted([5.0], ahead=3.1))
    assert not may_be_elsewhere(RULES, sure, other)
    rivals = evidence_of(RULES, winner, [winner, other]).rivals
    assert (str(other.hypothesis) in rivals) is expected


def test_candidates_are_listed_best_first_with_those_that_did_as_well() -> None:
    def weighed(effect: type[Effect], chi2: float, amount: float) -> Trial:
        model = Model.of((effect(("knee",)),), [amount])
        return trial(effect, fitted([chi2], model=model))

    trials = [weighed(SIMPLE, 5.4, 0.3), weighed(OTHER, 5.0, 0.2), weighed(CommandDelay, 5.9, 0.1)]
    found = candidates_of(RULES, fitted([11.0]), trials, trials[1], 2)
    assert [(c.round, c.amounts, c.why) for c in found] == [
        (2, {"knee": 0.2}, "added"),
        (2, {"knee": 0.3}, "leaves more than viscous_damping at knee"),
        (2, {"knee": 0.1}, "leaves more than viscous_damping at knee"),
    ]
    assert [(c.effect, c.amplitude) for c in found] == [
        ("viscous_damping", 0.2),
        ("coulomb_friction", 0.3),
        ("command_delay", 0.1),
    ]
    assert [c.explained for c in found] == pytest.approx([0.6, 0.56, 0.51])
    assert [c.confused_with for c in found] == [
        ("coulomb_friction",),
        ("viscous_damping", "command_delay"),
        ("coulomb_friction",),
    ]
    worse = candidates_of(RULES, fitted([4.0]), trials, None, 1)
    assert {c.why for c in worse} == {"held-out data are predicted no better with it"}
    assert all(c.confused_with == () for c in worse), "what makes it worse is confused with nothing"


@given(st.floats(0.1, 50.0), st.lists(st.floats(0.1, 50.0), min_size=1, max_size=4))
def test_no_candidate_explains_more_than_there_is(before: float, left: list[float]) -> None:
    trials = [trial(SIMPLE, fitted([chi2], model=Model.of((SIMPLE(("knee",)),), [0.1]))) for chi2 in left]
    found = candidates_of(RULES, fitted([before]), trials, None, 1)
    assert all(c.explained <= 1.0 + 1e-9 for c in found)
    assert any(c.explained > 0 for c in found) == (min(left) < before)


# --- what is to be explained ------------------------------------------------------------------------------------------


@given(st.integers(0, 2**32 - 1), st.sets(st.integers(0, 4)), st.sampled_from([0.0, 1e-3, 1.0]))
def test_a_residual_beside_some_of_the_parameters_is_what_they_alone_leave(
    seed: int, gone: set[int], apart: float
) -> None:
    rng = np.random.default_rng(seed)
    jacobian, response = rng.normal(size=(40, 5)) * np.logspace(0, 6, 5), rng.normal(size=(40, 2))
    jacobian[:, 1] = jacobian[:, 0] + apart * jacobian[:, 1]
    residual, other = rng.normal(size=(2, 40))
    kept = np.delete(jacobian, sorted(gone), axis=1)
    whole, alone = Residual.of(residual, jacobian), Residual.of(other, kept)
    beside = whole.beside(other, kept)
    assert np.allclose(beside.rest, alone.rest, atol=1e-6)
    rows = np.arange(40)
    perturbation = Perturbation(CoulombFriction, ("knee",), ((1.0,), (2.0,)))
    explained = [
        Sensitivity(perturbation, r, rows, response, np.ones(2), 1.0, np.ones(1)).explained for r in (beside, alone)
    ]
    assert np.allclose(*explained, atol=1e-6)
    assert np.allclose(kept.T @ explained[0], 0.0, atol=1e-5 * np.linalg.norm(kept, axis=0).max(initial=1.0))


# --- hypotheses -----------------------------------------------------------------------------------------------------


def sensitivity(
    effect: type[Effect], place: str | tuple[str, ...], gain: float, direction: Numbers, amount: float = 1.0
) -> Sensitivity:
    """An answer whose response is one direction of the residual."""
    places = (place,) if isinstance(place, str) else place
    values = np.zeros(len(effect.kinds))
    values[effect.main] = amount
    response = np.sqrt(gain) * np.array(direction, dtype=np.float64)[:, None]
    perturbation = Perturbation(effect, places, ((amount,),))
    # what it explains alone is all that it is asked to
    own = Residual.of(-response[:, 0], np.zeros((len(response), 0)))
    return Sensitivity(perturbation, own, np.arange(len(response)), response, np.ones(1), gain, values)


HIP, KNEE = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0)
LEG: Scales = dict.fromkeys(("hip", "knee"), JointScale(10.0, 20.0, 1.0, 2.0, 1.0, 1.0))


@pytest.mark.parametrize(
    ("found", "expected"),
    [
        ([sensitivity(SIMPLE, "hip", 41.0, HIP)], [("hip",)]),
        ([sensitivity(SIMPLE, "hip", 39.0, HIP)], []),
        ([sensitivity(SIMPLE, ("hip", "knee"), 41.0, HIP)], [("hip", "knee")]),
        ([sensitivity(SIMPLE, ("hip", "knee"), 39.0, HIP)], []),
        # a further location explains something that the first does not
        (
            [sensitivity(SIMPLE, "hip", 3000.0, HIP), sensitivity(SIMPLE, "knee", 61.0, KNEE, 9.0)],
            [("hip", "knee"), ("hip",)],
        ),
        ([sensitivity(SIMPLE, "hip", 3000.0, HIP), sensitivity(SIMPLE, "knee", 59.0, KNEE, 9.0)], [("hip",)]),
        ([sensitivity(SIMPLE, "hip", 3000.0, HIP), sensitivity(SIMPLE, "knee", 61.0, HIP, 9.0)], [("hip",)]),
        ([sensitivity(SIMPLE, "hip", 50.0, HIP), sensitivity(SIMPLE, "knee", 39.0, KNEE, 9.0)], [("hip",)]),
        # ... and is no better explained by another effect
        (
            [
                sensitivity(SIMPLE, "hip", 1000.0, HIP),
                sensitivity(OTHER, "knee", 600.0, KNEE),
                sensitivity(SIMPLE, "knee", 220.0, KNEE, 9.0),
            ],
            [("hip", "knee"), ("hip",), ("knee",)],
        ),
        (
            [
                sensitivity(SIMPLE, "hip", 1000.0, HIP),
                sensitivity(OTHER, "knee", 600.0, KNEE),
                sensitivity(SIMPLE, "knee", 200.0, KNEE, 9.0),
            ],
            [("hip",), ("knee",)],
        ),
    ],
)
def test_locations_of_a_hypothesis(found: Sequence[Sensitivity], expected: Sequence[tuple[str, ...]]) -> None:
    assert [h.places for h in form_hypotheses(found, 3, LEG, RULES)] == list(expected)


@pytest.mark.parametrize(("amount", "shared"), [(1.9, True), (2.1, False)])
def test_amounts_that_nearly_agree_are_tried_as_one_too(amount: float, shared: bool) -> None:
    found = [sensitivity(SIMPLE, "hip", 1000.0, HIP), sensitivity(SIMPLE, "knee", 900.0, KNEE, amount)]
    assert any(h.shared for h in form_hypotheses(found, 3, LEG, RULES)) is shared


@pytest.mark.parametrize(("amount", "named"), [(1.1e-3, True), (0.9e-3, False)])
def test_an_effect_that_includes_another_is_not_tried_where_it_adds_nothing(amount: float, named: bool) -> None:
    one = sensitivity(GENERAL, "hip", 1000.0, HIP)
    values = np.ones(len(GENERAL.kinds))
    values[GENERAL.main] = amount
    found = [replace(one, values=values), sensitivity(SIMPLE, "hip", 900.0, HIP)]
    assert any(h.effect is GENERAL for h in form_hypotheses(found, 3, LEG, RULES)) is named


def test_hypotheses_are_few_and_varied() -> None:
    found = [sensitivity(SIMPLE, (f"a{i}", "b"), 1000.0 - i, HIP) for i in range(5)]
    found += [sensitivity(OTHER, (f"a{i}", "b"), 500.0 - i, HIP) for i in range(5)]
    assert [h.effect for h in form_hypotheses(found, 3, LEG, RULES)] == [SIMPLE] * 3 + [OTHER] * 3
    assert len(form_hypotheses(found, 3, LEG, Selection(refits=2))) == 2
    assert len(form_hypotheses(found, 3, LEG, Selection(refits_of_one=1))) == 2


# --- verdict --------------------------------------------------------------------------------------------------


def test_the_limit_of_a_verdict_grows_with_chance() -> None:
    assert verdict_limit(RULES, 0.0) == pytest.approx(1.1)
    assert verdict_limit(RULES, 0.1) == pytest.approx(1.4)


@pytest.mark.parametrize(
    ("holdout", "train", "expected"), [(3.4, 3.4, True), (3.7, 3.4, False), (3.4, 3.7, False), (1.0, 1.0, True)]
)
def test_a_log_is_explained_where_it_is_fitted_and_where_it_is_not(
    holdout: float, train: float, expected: bool
) -> None:
    now = fitted([holdout], [train])
    assert is_log_explained(RULES, fitted([101.0]), now, floating=False) is expected


@pytest.mark.parametrize(("left", "expected"), [(0.1, True), (0.3, True), (0.4, False), (0.7, False)])
def test_a_name_is_likely_where_hardly_anything_is_left(left: float, expected: bool) -> None:
    """At the least certainty with all the weight that a family can have: 0.34 of the excess is left."""
    winner = trial(SIMPLE, fitted([1 + 99 * left]))
    assert is_likely(RULES, fitted([100.0]), winner, [winner]) is expected
    assert is_likely(Selection(likely=0.0), fitted([100.0]), winner, [winner])


@pytest.mark.parametrize(
    ("last", "floating", "expected"),
    [(3.5, False, True), (3.7, False, False), (4.9, True, True), (5.1, True, False), (1.0, False, True)],
)
def test_is_explained(last: float, floating: bool, expected: bool) -> None:
    assert is_explained(RULES, 101.0, last, 1.1, floating=floating) is expected


def test_what_is_far_above_the_noise_is_not_explained_however_much_is_gone() -> None:
    """A motor's friction of the wrong form took 97.5 % of the error of an arm, and 480 noise floors were left."""
    assert is_explained(RULES, 1e6, 4.9, 1.1, floating=False)
    assert not is_explained(RULES, 1e6, 5.1, 1.1, floating=False)
    assert verdict_of(RULES, fitted([1e6]), fitted([2e4]), (SURE,), floating=False) == "partly_explained"


def a_name(certainty: float, *rivals: str) -> NamedEffect:
    return NamedEffect(
        effect="coulomb_friction",
        family="friction",
        variant="",
        where=("knee",),
        parameters=(),
        certainty=certainty,
        otherwise={},
        explains={},
        provisional=False,
        gain_holdout=0.5,
        confused_with=rivals,
        sentence="",
        evidence={},
    )


SURE, DOUBTFUL, EITHER, NEITHER = a_name(0.9), a_name(0.4), a_name(0.9, "backlash"), a_name(0.4, "backlash")


@pytest.mark.parametrize(
    ("now", "named", "floating", "expected"),
    [
        (fitted([1.09]), (), False, "nothing_missing"),
        (fitted([1.11]), (), False, "unexplained"),
        (fitted([1.0], [1.11]), (), False, "unexplained"),
        (fitted([3.5]), (SURE,), False, "explained"),
        (fitted([3.7]), (SURE,), False, "partly_explained"),
        (fitted([3.7]), (SURE,), True, "explained"),
        (fitted([1.0], [3.7]), (SURE,), False, "partly_explained"),
        (fitted([60.0]), (DOUBTFUL,), False, "unexplained"),
        (fitted([60.0]), (DOUBTFUL, SURE), False, "partly_explained"),
        (fitted([3.5]), (SURE, EITHER), False, "ambiguous"),
        (fitted([3.7]), (EITHER,), False, "partly_explained"),
        (fitted([3.5]), (SURE, NEITHER), False, "partly_explained"),
        (fitted([3.5]), (NEITHER,), False, "unexplained"),
        (fitted([150.0]), (SURE,), False, "unexplained"),
    ],
)
def test_verdict(now: Fitted, named: Sequence[NamedEffect], floating: bool, expected: str) -> None:
    assert verdict_of(RULES, fitted([101.0]), now, named, floating=floating) == expected


@pytest.mark.parametrize("verdict", ["explained", "partly_explained", "ambiguous"])
def test_the_message_tells_what_is_likely_from_what_is_not(verdict: Verdict) -> None:
    sure, doubtful = replace(SURE, sentence="dry friction"), replace(NEITHER, sentence="a load", family="payload")
    nothing = Scores({}, {})
    said, _, added = message_of(verdict, (sure, doubtful), nothing, nothing, None).partition(" Also added, less likely")
    assert "lacks dry friction" in said
    assert "load" not in said
    assert "a load, payload with 40 % certainty" in added
    assert "Also added" not in message_of(verdict, (sure,), nothing, nothing, None)


def test_a_short_log_may_leave_more_by_chance() -> None:
    assert verdict_of(RULES, fitted([2.0], chance=0.1), fitted([1.39]), (), floating=False) == "nothing_missing"


@pytest.mark.parametrize(
    ("candidate", "expected"),
    [
        (Candidate("command_delay", ("hip", "knee"), 0.9, 0.1, ("sensor_delay", "backlash")), ("sensor_delay",)),
        (Candidate("command_delay", ("knee",), 0.9, 0.1, ("sensor_delay",)), ()),
        (Candidate("backlash", ("hip", "knee"), 0.9, 0.1, ("sensor_delay",)), ()),
    ],
)
def test_what_did_as_well_and_gives_way_by_convention_is_confused_with_what_is_named(
    candidate: Candidate, expected: tuple[str, ...]
) -> None:
    assert giving_way(CommandDelay(("knee", "hip")), [candidate]) == expected


def test_what_did_as_well_as_another_form_is_not_confused_with_the_one_that_was_added() -> None:
    pure = Candidate("command_delay", ("hip",), 0.6, 0.1, ("sensor_delay",))
    sampled = Candidate("command_delay", ("hip",), 0.97, 0.1, (), why=ADDED)
    for tried in ([sampled, pure], [pure, sampled]):
        assert giving_way(CommandDelay(("hip",)), tried) == ()


# --- what is held out -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("train", "holdout", "late"),
    [
        ([1.11, 1.0], [5.0, 1.0], True),
        ([1.13, 1.0], [5.0, 1.0], False),
        ([1.0, 1.0], [1.11, 1.0], False),
        ([1.0, 1.0], [1.13, 1.0], True),
        # most of the excess is in columns that are explained where fitted
        ([1.0, 9.0], [5.1, 5.0], True),
        ([1.0, 9.0], [4.9, 5.0], False),
    ],
)
def test_what_shows_only_at_the_end(train: Numbers, holdout: Numbers, late: bool) -> None:
    assert shows_late(RULES, fitted(holdout, train)) == late


RULES_OF_ONE_COLUMN: list[Callable[..., Any]] = [improves, improves_once, explains_fitted, relieves, is_needed]


@pytest.mark.parametrize("rule", RULES_OF_ONE_COLUMN, ids=lambda rule: rule.__name__)
def test_nothing_is_added_that_changes_nothing(rule: Callable[..., Any]) -> None:
    assert not rule(RULES, BEFORE, BEFORE)
