"""First fits: initial states and parameters in turn."""

from __future__ import annotations

import numpy as np
import pytest
from test_diagnosis_search import begun

from sysid_btr.identify import coarse as module
from sysid_btr.identify.study import Study
from sysid_btr.terms.model import Model


@pytest.mark.parametrize(
    ("left", "share"),
    [
        ({0.0: float("nan"), 1.0: float("nan")}, 1.0),  # what diverges where it begins may go anywhere
        ({1.0: 0.9}, 1.0),
        ({1.0: 1.005}, 1.0),  # no more than the numerics make of it
        ({1.0: 3.0, 0.5: 0.9}, 0.5),
        ({1.0: float("nan"), 0.5: 1.2, 0.25: 0.7}, 0.25),  # it diverges
        ({1.0: 3.0, 0.5: 2.5, 0.25: 2.0, 0.125: 1.5}, 0.0),
    ],
)
def test_a_turn_goes_as_far_as_states_and_numbers_leave_no_more(
    left: dict[float, float], share: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    study, model = begun().study, begun().fitted.model
    step = np.linspace(0.1, 0.2, len(model.values))

    def chi2(study: Study, there: Model) -> float:
        return left.get(float(np.round(np.mean((there.values - model.values) / step), 6)), 1.0)

    monkeypatch.setattr(module, "_left", chi2)
    monkeypatch.setattr(Study, "with_initial_states", lambda study, *_, **__: study)
    _, found = module._turned(study, model, model.at(model.values + step), last=True)
    np.testing.assert_allclose(found.values, model.values + share * step)
