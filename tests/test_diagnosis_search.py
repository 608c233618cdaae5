"""The search: what becomes of effects whose names are not likely."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from test_segmented import double_pendulum, driven

from sysid_btr.diagnosis import exchange as exchange_module
from sysid_btr.diagnosis import search as module
from sysid_btr.diagnosis.evidence import Evidence
from sysid_btr.diagnosis.exchange import exchange
from sysid_btr.diagnosis.hypotheses import Hypothesis
from sysid_btr.diagnosis.search import search
from sysid_btr.diagnosis.selection import STANDARD, Selection
from sysid_btr.diagnosis.state import State
from sysid_btr.diagnosis.trials import Trial
from sysid_btr.estimators.base import silent
from sysid_btr.identify.fit import fit
from sysid_btr.identify.refit import Fitted
from sysid_btr.identify.segmented import SegmentedProcedure
from sysid_btr.identify.study import Study, make_study
from sysid_btr.simulation.numerics import Numerics
from sysid_btr.terms.effect import Effect
from sysid_btr.terms.friction import CoulombFriction, QuadraticDamping, ViscousDamping
from sysid_btr.terms.model import Model

ORDER: tuple[type[Effect], ...] = (CoulombFriction, ViscousDamping, QuadraticDamping)


@cache
def begun() -> State:
    study = make_study(double_pendulum(), [driven()], numerics=Numerics("RK4", 0.005), threads=1)
    return State.of(fit(study, ["mass:*"]), None)


def found(likely: Sequence[bool], monkeypatch: pytest.MonkeyPatch, rules: Selection = STANDARD) -> State:
    """A search whose rounds each add the next effect, which is likely or not, and which then ends."""

    def try_next(state: State, library: object, rules: object, say: object) -> tuple[State, list[Trial]]:
        k = len(state.effects)
        if k == len(likely):
            return state, []
        now = state.fitted
        better = replace(now, holdout_columns=0.8 * now.holdout_columns, holdout=0.8 * now.holdout)
        return state, [Trial(Hypothesis(ORDER[k], ("elbow",), False, np.array([0.1]), 1.0), better)]

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
    return search(begun(), ORDER, rules, silent)


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

    def attempt(study: Study, rest: Model, hypothesis: Hypothesis, rules: Selection) -> Trial:
        model = rest.with_(hypothesis.term(study.scales), hypothesis.start)
        return Trial(hypothesis, replace(now, model=model, holdout_columns=0.8 * now.holdout_columns))

    monkeypatch.setattr(exchange_module, "attempt", attempt)
    monkeypatch.setattr(exchange_module, "is_likely", lambda *_: likely)
    monkeypatch.setattr(SegmentedProcedure, "wanders", wanders)
    found = exchange(state, ORDER, STANDARD)
    assert [type(e) for e in found.effects] == [ORDER[1] if taken else ORDER[0]]
