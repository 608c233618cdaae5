"""What the residual looks like: proposals for effects with a place in time or angle, and words for the rest."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from sysid_btr._typing import FloatArray
from sysid_btr.diagnosis.scan import Question
from sysid_btr.effects.base import Effect
from sysid_btr.identify.study import Study
from sysid_btr.models.modifier import Modifier
from sysid_btr.objectives.problem import ReplayProblem


def proposals(
    study: Study,
    problem: ReplayProblem,
    values: FloatArray,
    residual: FloatArray,
    library: Sequence[type[Effect]],
) -> list[Question]:
    return []


def signature(study: Study, modifiers: Sequence[Modifier], values: FloatArray) -> dict[str, Any]:
    return {"summary": "not characterised"}
