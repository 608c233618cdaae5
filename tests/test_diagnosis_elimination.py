"""Elimination: effects whose names are not likely, and the last turns of initial states and parameters."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from test_diagnosis_search import ORDER, begun

from sysid_btr.diagnosis import elimination as module
from sysid_btr.diagnosis.evidence import Evidence
from sysid_btr.diagnosis.selection import STANDARD
from sysid_btr.diagnosis.state import State
from sysid_btr.identify.refit import Fitted
from sysid_btr.identify.segmented import SegmentedProcedure
from sysid_btr.identify.study import Study
from sysid_btr.terms.effect import Effect
from sysid_btr.terms.model import Model


@pytest.mark.parametrize("wanders", [True, False])
@pytest.mark.parametrize(
    ("sure", "kept"),
    [
        ((0.9, 0.3, 0.8), (0, 2)),
        ((0.3, 0.9, 0.2), (1,)),
        ((0.3, 0.4, 0.2), (0, 1, 2)),  # beside nothing that is likely there is nothing to keep
        ((0.9, 0.5), (0, 1)),
        ((0.3,), (0,)),
    ],
)
def test_beside_a_name_that_is_likely_none_stays_that_is_not_where_errors_grow(
    sure: tuple[float, ...], kept: tuple[int, ...], wanders: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    state = begun()
    for kind, certainty in zip(ORDER, sure, strict=False):
        term = kind.at(("elbow",), state.study.scales)
        fitted = replace(state.fitted, model=state.fitted.model.with_(term, np.array([0.1])))
        state = replace(state, fitted=fitted, evidence=(*state.evidence, Evidence(family=certainty)))

    def without(state: State, effect: Effect, seconds: float) -> Fitted:
        return replace(state.fitted, model=state.fitted.model.without(effect), evaluations=7)

    monkeypatch.setattr(State, "refitted_without", without)
    monkeypatch.setattr(module, "certainty_of", lambda known, without, now: known.family)
    monkeypatch.setattr(SegmentedProcedure, "wanders", wanders)
    end, known = module._without_unlikely(state, STANDARD)
    left = kept if wanders else range(len(sure))
    assert [type(effect) for effect in end.effects] == [ORDER[i] for i in left]
    assert [known.family for known in end.evidence] == [sure[i] for i in left]
    gone = sum(len(step.removed) for step in end.steps) - sum(len(step.removed) for step in state.steps)
    assert gone == len(sure) - len(list(left))
    assert len(known) == (len(list(left)) if wanders and len(list(left)) > 1 else 0)


def test_what_is_known_without_an_effect_is_not_asked_again(monkeypatch: pytest.MonkeyPatch) -> None:
    state = begun()
    for kind in ORDER[:3]:
        term = kind.at(("elbow",), state.study.scales)
        fitted = replace(state.fitted, model=state.fitted.model.with_(term, np.array([0.1])))
        state = replace(state, fitted=fitted, evidence=(*state.evidence, Evidence()))
    asked: list[type[Effect]] = []

    def without(state: State, effect: Effect, seconds: float) -> Fitted:
        asked.append(type(effect))
        return replace(state.fitted, model=state.fitted.model.without(effect), evaluations=7)

    monkeypatch.setattr(State, "refitted_without", without)
    monkeypatch.setattr(module, "_at_fewer_locations", lambda state, effect, rules: (state, ()))
    monkeypatch.setattr(
        module, "is_needed", lambda rules, trial, now, transient: ORDER[0] not in {type(t) for t in trial.model.terms}
    )
    known = [without(state, effect, 1.0) for effect in state.effects]
    asked.clear()
    (kept,) = module._pruned(state, STANDARD, known).effects
    assert type(kept) is ORDER[0]
    # the first two are known of this model; the last one is asked of that without the second
    assert asked == [ORDER[2]]


@pytest.mark.parametrize(
    ("left", "taken"),
    [
        ((1.0, 1.0, 1.0), 3),
        ((0.9, 0.8, 0.7), 3),  # each is better than the one before
        ((0.9, 1.5, 0.8), 1),  # one that leaves more ends it, whatever would follow
        ((1.2, 0.9, 0.9), 0),
        ((float("nan"), 1.0, 1.0), 0),  # it diverges
    ],
)
def test_turns_of_states_and_parameters_end_where_they_leave_more(
    left: tuple[float, ...], taken: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    state = begun()
    state = replace(state, fitted=replace(state.fitted, train=1.0))
    waiting: Iterator[float] = iter(left)

    def refit(study: Study, model: Model) -> Fitted:
        moved = model.at(model.values + 0.01)
        return replace(state.fitted, model=moved, train=next(waiting), evaluations=7)

    monkeypatch.setattr(module, "refit", refit)
    monkeypatch.setattr(module, "_standard_errors", lambda state: np.zeros(len(state.fitted.model.values)))
    monkeypatch.setattr(SegmentedProcedure, "last_turns", len(left))
    monkeypatch.setattr(Study, "with_initial_states", lambda study, *_, **__: study)
    end: State = module._states_in_turn(state)
    moved: Any = end.fitted.model.values - state.fitted.model.values
    np.testing.assert_allclose(moved, 0.01 * taken)
    assert end.replays - state.replays == 7 * min(taken + 1, len(left))
