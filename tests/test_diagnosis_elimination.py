"""Elimination: the last turns of initial states and parameters."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from test_diagnosis_search import begun

from sysid_btr.diagnosis import elimination as module
from sysid_btr.diagnosis.state import State
from sysid_btr.identify.refit import Fitted
from sysid_btr.identify.segmented import SegmentedProcedure
from sysid_btr.identify.study import Study
from sysid_btr.terms.model import Model


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
