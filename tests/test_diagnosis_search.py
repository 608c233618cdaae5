"""The search: what becomes of effects whose names are not likely."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import toys
from test_diagnosis_close import OTHERWISE, TOY_FIT, Plant, motion, seen_by_encoders
from test_segmented import double_pendulum, driven

from sysid_btr.diagnosis import exchange as exchange_module
from sysid_btr.diagnosis import search as module
from sysid_btr.diagnosis.evidence import Evidence
from sysid_btr.diagnosis.exchange import exchange
from sysid_btr.diagnosis.hypotheses import Hypothesis
from sysid_btr.diagnosis.leads import Library
from sysid_btr.diagnosis.search import search
from sysid_btr.diagnosis.selection import STANDARD, Selection
from sysid_btr.diagnosis.state import State
from sysid_btr.diagnosis.trials import Trial, attempt, of_a_special_case
from sysid_btr.estimators.base import silent
from sysid_btr.identify.fit import fit
from sysid_btr.identify.numerics import TOLERATED
from sysid_btr.identify.refit import Fitted, inflate, judge, refit
from sysid_btr.identify.segmented import SegmentedProcedure
from sysid_btr.identify.study import Study, make_study
from sysid_btr.simulation.numerics import Numerics
from sysid_btr.terms.effect import Effect
from sysid_btr.terms.friction import CoulombFriction, LoadFriction, LoadFrictionPower, QuadraticDamping, ViscousDamping
from sysid_btr.terms.inertial import Armature
from sysid_btr.terms.model import Model

ORDER: tuple[type[Effect], ...] = (CoulombFriction, ViscousDamping, QuadraticDamping, Armature)


@cache
def begun() -> State:
    study = make_study(double_pendulum(), [driven()], numerics=Numerics("RK4", 0.005), threads=1)
    return State.of(fit(study, ["mass:*"]), None)


def found(
    likely: Sequence[bool],
    monkeypatch: pytest.MonkeyPatch,
    rules: Selection = STANDARD,
    known_before: list[list[type[Effect]]] | None = None,
) -> State:
    """A search whose rounds each add the next effect, which is likely or not, and which then ends."""

    def try_next(
        state: State, library: Library, rules: object, say: object, made: Sequence[Trial]
    ) -> tuple[State, list[Trial]]:
        if known_before is not None:
            known_before.append([t.hypothesis.effect for t in made])
        known = {type(effect) for effect in state.effects}
        kind = next((e for e in library if e not in known), None)
        if kind is None:
            return state, []
        now = state.fitted
        better = replace(now, holdout_columns=0.8 * now.holdout_columns, holdout=0.8 * now.holdout)
        return state, [Trial(Hypothesis(kind, ("elbow",), False, np.array([0.1]), 1.0), better)]

    def add(state: State, winner: Trial, trials: object, rules: object) -> State:
        term = winner.hypothesis.term(state.study.scales)
        model = state.fitted.model.with_(term, winner.hypothesis.start)
        state = replace(state, fitted=replace(winner.fitted, model=model), evidence=(*state.evidence, Evidence()))
        return state.step(added=(str(winner.hypothesis),))

    def is_likely(rules: object, now: Fitted, winner: Trial, trials: object) -> bool:
        return likely[ORDER.index(winner.hypothesis.effect)]

    monkeypatch.setattr(module, "_try_promising", try_next)
    monkeypatch.setattr(module, "_is_worthy", lambda *_: True)
    monkeypatch.setattr(module, "choose", lambda rules, now, trials: trials[0] if trials else None)
    monkeypatch.setattr(module, "_add", add)
    monkeypatch.setattr(module, "is_likely", is_likely)
    return search(begun(), ORDER[: len(likely)], rules, silent)


@pytest.mark.parametrize(
    ("likely", "kept"),
    [
        ([True, False, False], 1),  # two in turn
        ([True, False, True], 3),  # the third makes sense of the second
        ([False, False, True], 3),  # beside nothing that is likely there is nothing to keep
        ([True, True, False], 3),
        ([False], 1),
    ],
)
def test_effects_whose_names_are_not_likely_go_where_two_are_added_in_turn(
    likely: list[bool], kept: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    state = found(likely, monkeypatch)
    assert [type(e) for e in state.effects] == list(ORDER[:kept])
    gone = [str(Hypothesis(e, ("elbow",), False, np.zeros(1), 0.0)) for e in ORDER[kept : len(likely)]]
    assert list(state.steps[-1].removed) == gone
    assert sum(len(step.added) for step in state.steps) == len(likely)
    assert len(state.evidence) == kept


def test_the_search_goes_on_without_what_went(monkeypatch: pytest.MonkeyPatch) -> None:
    state = found([True, False, False, True], monkeypatch)
    assert [type(e) for e in state.effects] == [ORDER[0], ORDER[3]]
    assert [step.removed for step in state.steps if step.removed] == [
        tuple(str(Hypothesis(e, ("elbow",), False, np.zeros(1), 0.0)) for e in ORDER[1:3])
    ]
    assert len(state.evidence) == 2


def test_trials_of_the_state_that_the_search_goes_on_from_are_not_made_again(monkeypatch: pytest.MonkeyPatch) -> None:
    known: list[list[type[Effect]]] = []
    found([True, False, False, True], monkeypatch, known_before=known)
    # beside the first effect the second was tried; the search that goes on from there knows it
    assert known == [[], [], [], [ORDER[1]], []]


def test_a_trial_that_was_made_is_taken_as_it_is(monkeypatch: pytest.MonkeyPatch) -> None:
    state = begun()
    now, one = state.fitted, Hypothesis(CoulombFriction, ("elbow",), False, np.array([0.1]), 1.0)
    other = replace(one, start=np.array([0.2]))
    made: list[Hypothesis] = []

    def attempt(study: Study, rest: Model, hypothesis: Hypothesis, rules: Selection, among: object) -> Trial:
        made.append(hypothesis)
        return Trial(hypothesis, now)

    monkeypatch.setattr(module, "leading_hypotheses", lambda state, library, rules: ([one, other], 0))
    monkeypatch.setattr(module, "attempt", attempt)
    for check in ("is_superfluous", "is_outdone", "is_hopeless", "has_law"):
        monkeypatch.setattr(module, check, lambda *_: False)
    known = Trial(replace(one, gain=2.0), replace(now, holdout=0.5))
    _, trials = module._try_promising(state, ORDER, STANDARD, lambda _: None, [known])
    assert trials[0] is known
    assert made == [other]
    assert trials[1].hypothesis is other


def test_it_does_not_go_on_where_it_may_not_or_little_is_left(monkeypatch: pytest.MonkeyPatch) -> None:
    likely = [True, False, False, True]
    assert [type(e) for e in found(likely, monkeypatch, Selection(detours=0)).effects] == [ORDER[0]]
    monkeypatch.setattr(module, "something_left", lambda *_: False)
    assert [type(e) for e in found(likely, monkeypatch).effects] == [ORDER[0]]


def test_patience_says_how_many(monkeypatch: pytest.MonkeyPatch) -> None:
    assert len(found([True, False, False], monkeypatch, Selection(patience=3)).effects) == 3
    assert len(found([True, False, False], monkeypatch, Selection(patience=1)).effects) == 1


def test_where_errors_do_not_grow_all_that_helps_is_added(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(SegmentedProcedure, "wanders", False)
    assert len(found([True, False, False], monkeypatch).effects) == 3


@pytest.mark.parametrize(
    ("likely", "wanders", "taken"), [(True, True, True), (False, True, False), (False, False, True)]
)
def test_nothing_takes_a_place_that_is_unlikely_to_be_what_it_is_called(
    likely: bool, wanders: bool, taken: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where errors grow, much takes up a part of what an effect leaves that is there."""
    state = begun()
    own, other = (Hypothesis(e, ("elbow",), False, np.array([0.1]), 1.0) for e in ORDER[:2])
    now = replace(state.fitted, model=state.fitted.model.with_(own.term(state.study.scales), own.start))
    state = replace(state, fitted=now, evidence=(Evidence(alternatives=(other,)),))

    def attempt(study: Study, rest: Model, hypothesis: Hypothesis, rules: Selection, among: object) -> Trial:
        model = rest.with_(hypothesis.term(study.scales), hypothesis.start)
        return Trial(hypothesis, replace(now, model=model, holdout_columns=0.8 * now.holdout_columns))

    monkeypatch.setattr(exchange_module, "attempt", attempt)
    monkeypatch.setattr(exchange_module, "is_likely", lambda *_: likely)
    monkeypatch.setattr(exchange_module, "is_sized", lambda *_: True)
    monkeypatch.setattr(SegmentedProcedure, "wanders", wanders)
    found = exchange(state, ORDER, STANDARD)
    assert [type(e) for e in found.effects] == [ORDER[1] if taken else ORDER[0]]


# --- a special case first ----------------------------------------------------------------------------------


@cache
def rubbing(exponent: float, spring: float) -> State:
    """A leg whose knee rubs by a power of its load, and whose hip may have a spring too, both undeclared."""
    sprung = toys.with_spec(toys.leg(), lambda spec: setattr(spec.joint("hip"), "stiffness", [spring, 0.0, 0.0]))
    plant = Plant(LoadFrictionPower(("knee",), ranges=((0.0, 1.0),)), (0.15, exponent))
    log = seen_by_encoders(plant, motion(), OTHERWISE, robot=sprung)
    return State.of(fit(make_study(toys.leg(), [log], numerics=toys.FINE, threads=1), TOY_FIT), None)


@pytest.mark.parametrize(
    ("exponent", "spring", "first"),
    [
        (0.0, 1.5, CoulombFriction),  # what the spring leaves no exponent should follow
        (0.3, 1.5, CoulombFriction),
        (1.0, 1.5, LoadFriction),
        (0.5, 0.0, LoadFrictionPower),  # nothing else is missing: the exponent is what the log shows
    ],
)
def test_a_special_case_goes_first_while_more_is_left_than_its_law_would_take(
    exponent: float, spring: float, first: type[Effect]
) -> None:
    state = rubbing(exponent, spring)
    power = Hypothesis(LoadFrictionPower, ("knee",), False, np.array([0.1, 0.8]), 1.0)
    trial = attempt(state.study, state.fitted.model, power, STANDARD)
    library = (CoulombFriction, ViscousDamping, LoadFriction, LoadFrictionPower)
    simple, spent = of_a_special_case(state.study, state.fitted, trial, [trial], library, STANDARD)
    assert simple.hypothesis.effect is first
    assert (spent > 0) == (spring > 0)
    if first is not LoadFrictionPower:
        assert simple.fitted.holdout - trial.fitted.holdout < trial.fitted.holdout - 1
        # what was tried in the round is not tried again
        again, spent = of_a_special_case(state.study, state.fitted, trial, [trial, simple], (first,), STANDARD)
        assert (again, spent) == (simple, 0)


def test_a_special_case_is_not_added_where_it_is_already() -> None:
    state = rubbing(0.0, 1.5)
    rubs = state.fitted.model.with_(CoulombFriction(("knee",)), np.array([0.15]))
    before = judge(state.study, rubs)
    power = Hypothesis(LoadFrictionPower, ("knee",), False, np.array([0.1, 1.0]), 1.0)
    trial = attempt(state.study, rubs, power, STANDARD)
    assert of_a_special_case(state.study, before, trial, [trial], (CoulombFriction,), STANDARD) == (trial, 0)


# --- racing ------------------------------------------------------------------------------------------------


def test_a_hypothesis_far_behind_is_left_where_its_first_iterations_end() -> None:
    state = rubbing(0.5, 0.0)
    power = Hypothesis(LoadFrictionPower, ("knee",), False, np.array([0.1, 0.8]), 1.0)
    elsewhere = Hypothesis(LoadFrictionPower, ("ankle",), False, np.array([0.1, 0.8]), 1.0)
    right = attempt(state.study, state.fitted.model, power, STANDARD, (state.fitted,))
    assert right.fitted.holdout < 1.1
    wrong = [attempt(state.study, state.fitted.model, elsewhere, STANDARD, a) for a in ((), (right.fitted,))]
    assert wrong[1].fitted.evaluations < wrong[0].fitted.evaluations
    assert all(w.fitted.misfit > right.fitted.misfit + STANDARD.outdone for w in wrong)
    # what leads is found as it is without others
    alone = attempt(state.study, state.fitted.model, power, STANDARD)
    assert alone.fitted.model.values == pytest.approx(right.fitted.model.values)


# --- steps as long as what is left allows -------------------------------------------------------------------


def moved(study: Study, model: Model, one: Numerics, other: Numerics) -> float:
    """By how much steps differ: the largest rms over columns, in errors that are left."""
    problem = study.train_problem(model)
    first, second = (problem.with_numerics(n).residuals(model.values[None])[0] for n in (one, other))
    square = np.bincount(problem.column_labels, (first - second) ** 2, len(problem.columns)) / problem.counts
    return float(np.sqrt(square.max()))


def test_steps_are_longer_while_much_is_left_and_end_as_the_parameters_were_fitted() -> None:
    log = seen_by_encoders(Plant(CoulombFriction(("knee",)), (0.3,)), motion(), OTHERWISE)
    study = make_study(toys.leg(), [log], numerics=Numerics("RK4", 0.000625), threads=1)
    state = State.of(fit(study, ["mass:knee"]), None)
    finest = state.study.numerics
    coarse = state.in_longest_steps()
    assert finest.timestep < coarse.study.numerics.timestep <= 0.010
    assert moved(state.study, state.fitted.model, finest, coarse.study.numerics) < 2 * TOLERATED
    assert coarse.fitted.holdout == pytest.approx(state.fitted.holdout, rel=0.02)
    again = coarse.in_first_steps()
    assert again.study.numerics == finest
    assert again.fitted.holdout == state.fitted.holdout
    # the better the model, the shorter its steps
    rubs = refit(state.study, state.fitted.model.with_(CoulombFriction(("knee",)), np.array([0.3])))
    right = replace(state, study=inflate(state.study, rubs), fitted=rubs).in_longest_steps()
    assert right.study.numerics.timestep < coarse.study.numerics.timestep


@pytest.mark.parametrize(
    "numerics", [Numerics("RK4", 0.000625, stated=True), Numerics("Euler", 0.001), Numerics("RK4", 0.001, 0.004)]
)
def test_steps_that_are_part_of_the_model_stay(numerics: Numerics) -> None:
    log = seen_by_encoders(Plant(CoulombFriction(("knee",)), (0.3,)), motion(), OTHERWISE)
    state = State.of(fit(make_study(toys.leg(), [log], numerics=numerics, threads=1), ["mass:knee"]), None)
    assert state.in_longest_steps().study.numerics == numerics
