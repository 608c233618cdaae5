"""Intervals of all parameters in the final model."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sysid_btr._typing import FloatArray
from sysid_btr.diagnosis.selection import Selection, has_size
from sysid_btr.diagnosis.state import State
from sysid_btr.estimators.linearisation import linearise
from sysid_btr.identify.deferred import cheaper
from sysid_btr.identify.discrepancy import widened
from sysid_btr.identify.ends import followed
from sysid_btr.identify.fixing import fix_unidentifiable
from sysid_btr.identify.intervals import estimates, held_to_model
from sysid_btr.identify.nuisance import error_of_the_rest
from sysid_btr.identify.refit import Fitted, judge, refit
from sysid_btr.identify.sensitivity import with_sensitivity
from sysid_btr.identify.step_check import SHIFT_TOLERATED, numerics_shift
from sysid_btr.identify.study import Study
from sysid_btr.objectives.problem import ReplayProblem
from sysid_btr.terms.model import Model


def with_discrepancy(state: State) -> State:
    """The state with intervals that hold although something is left, where that is more than noise."""
    study, model = state.study, state.fitted.model
    if state.reported is None or not state.fitted.train > study.procedure.tolerated:
        return state
    problem, residual, jacobian = linearised(study, model)
    found = widened(state.estimates, problem, model.values, jacobian, residual, study.scales)
    return replace(state, estimates=found)


def with_intervals(state: State, rules: Selection) -> State:
    """The state with estimates of all parameters, and with the model as it is reported.

    The step is halved while it moves an estimate by more than its error. The fitted model stays where the residuals are
    least, also where the motion of walks is more informative than these are.
    """
    study = state.study
    for refinement in range(rules.refinements + 1):
        model = state.fitted.model
        if refinement == 0:
            problem, residual, jacobian = linearised(study, model)
        else:  # what half the step changes in the derivatives is far less than what is known of them
            problem = study.train_problem(model)
            residual = problem.residuals(model.values[None])[0]
        slopes, shift, known = jacobian, numerics_shift(problem, model.values, jacobian, residual), None
        rest = error_of_the_rest(study, model, jacobian)
        fused = study.fuse(problem, model.values, jacobian, residual)
        if fused is not None:
            jacobian, residual = fused.jacobian, fused.residual
            shift, known = np.hypot(shift, fused.error), fused.known
            model = model.at(fused.values)
        beyond = np.hypot(shift, rest)
        found = estimates(problem.parameters, model.values, jacobian, residual, problem.blocks, beyond, known)
        bare = estimates(problem.parameters, model.values, jacobian, residual, problem.blocks)
        clear = np.array([e.identifiable != "no" for e in bare])
        worst = np.max(np.abs(shift[clear]) / np.maximum([e.std for e in bare], 1e-300)[clear], initial=0.0)
        final = study.numerics.exact or not study.procedure.refines_step
        if final or worst <= SHIFT_TOLERATED or refinement == rules.refinements:
            break
        study = replace(study, numerics=study.numerics.halved())
        state = replace(state, fitted=refit(study, model, iterations=4))
    if known is None:
        near = cheaper(problem, study.cheap, model.values)
        found, _ = followed(problem.parameters, found, near, model.values, jacobian)
    values, found, _ = fix_unidentifiable(study.with_belief(problem), model.values, found, jacobian, known)
    if known is None and study.redundancy:
        found = held_to_model(found, problem.parameters)
    found = with_sensitivity(found, problem, slopes)
    last = judge(study, model.at(values))
    fitted = last if known is None else state.fitted
    return replace(state, study=study, fitted=fitted, estimates=found, reported=last)


def is_sized(study: Study, fitted: Fitted) -> bool:
    """Whether the last term of a model has a size, see `has_size`, whatever torques could leave what it leaves."""
    model, term = fitted.model, fitted.model.terms[-1]
    problem, residual, jacobian = linearised(study, model)
    found = estimates(problem.parameters, model.values, jacobian, residual, problem.blocks)
    if study.redundancy:
        found = held_to_model(found, problem.parameters)
    if fitted.train > study.procedure.tolerated:
        found = widened(found, problem, model.values, jacobian, residual, study.scales)
    return has_size(found[model.terms.columns(term)], term.neutral)


def linearised(study: Study, model: Model) -> tuple[ReplayProblem, FloatArray, FloatArray]:
    """What a study fits, and residual (r,) and Jacobian (r, p) of it in a model; no slope where a simulation fails."""
    problem = study.train_problem(model)
    residual, jacobian = linearise(problem, model.values, step=study.stencil(model.terms))
    return problem, residual, np.nan_to_num(jacobian)
