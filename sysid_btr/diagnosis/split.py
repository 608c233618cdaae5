"""What is held out, where the end of a log is no fair judge of what its beginning shows."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sysid_btr._typing import BoolArray
from sysid_btr.diagnosis.free_form import follows_time, of_time_alone
from sysid_btr.diagnosis.selection import Selection, at_floor, shows_late
from sysid_btr.diagnosis.state import State
from sysid_btr.identify.missing_torque import missing_torques
from sysid_btr.identify.study import Study
from sysid_btr.io.split import held_out_all_over
from sysid_btr.objectives.problem import BLOCK
from sysid_btr.terms.model import Model

PARTS = 20
"""Of a log, at most; none is shorter than the stretches by which models are compared. A curve of time bends five times
along it, and what is held out is then short beside a bend."""


def held_out_elsewhere(state: State, rules: Selection) -> Study | None:
    """The study with parts held out all over its logs, where their ends alone would judge amiss; None elsewhere.

    A function of time is known between data, not beyond them, and what shows only at the end is not in what is before.
    Blocked cross-validation: Burman, Chow and Nolan 1994, doi:10.1093/biomet/81.2.351.

    Parameters
    ----------
    state : a model, before effects are sought or after.
    rules : what counts as explained.
    """
    study = state.study
    at_the_end = all(_is_the_end(held.scored) for held in study.holdout)
    if not at_the_end or not study.procedure.holds_out_anywhere or at_floor(rules, state.fitted):
        return None
    if not shows_late(rules, state.fitted) and not _of_time(state):
        return None
    train, holdout = list(study.train), list(study.holdout)
    for i, held in enumerate(study.holdout):
        time = held.recording.time
        many = min(PARTS, int((time[-1] - time[0]) / BLOCK))
        scored = held_out_all_over(time, float(np.mean(held.scored)), many)
        if scored.any():
            train[i], holdout[i] = train[i].scoring(~scored), held.scoring(scored)
    if holdout == list(study.holdout):
        return None
    # as it was before anything was fitted
    plain = replace(state.first.study, inflation={}, independent=False, redundancy=0.0, held=False, journal=None)
    return replace(plain, train=tuple(train), holdout=tuple(holdout)).with_initial_states(Model.of(()))


def _is_the_end(scored: BoolArray) -> bool:
    """Whether the samples that count are the last ones, and not all."""
    return not scored[0] and bool(np.all(np.diff(scored.astype(np.int8)) >= 0))


def _of_time(state: State) -> bool:
    """Whether a model has a function of time, or lacks one."""
    if any(of_time_alone(type(effect)) for effect in state.effects):
        return True
    study, model = state.study, state.fitted.model
    problem = study.train_problem(model)
    return follows_time(problem, model.values, study.scales, missing_torques(problem, model.values, study.scales))
