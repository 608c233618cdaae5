"""Hypotheses that a scan of the model so far leads to: what may be missing, or stand where something else stands."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from time import perf_counter
from typing import get_args

import numpy as np

from sysid_btr._typing import FloatArray, IntArray
from sysid_btr.diagnosis.free_form import free_forms
from sysid_btr.diagnosis.hypotheses import (
    Hypothesis,
    curves_of_all,
    curves_together,
    form_hypotheses,
    from_arrays,
    to_arrays,
)
from sysid_btr.diagnosis.proposals import proposals
from sysid_btr.diagnosis.scan import Perturbation, Residual, Sensitivity, perturbations, responding, scan
from sysid_btr.diagnosis.selection import Selection, could_gain
from sysid_btr.diagnosis.state import State
from sysid_btr.estimators.journal import Record
from sysid_btr.estimators.linearisation import linearise
from sysid_btr.identify.missing_torque import missing_torques
from sysid_btr.identify.projection import explained_by
from sysid_btr.identify.refit import inflate, judge, shorten
from sysid_btr.identify.study import Study
from sysid_btr.models.robot import alike_joints, body_names, joint_names
from sysid_btr.objectives.problem import ReplayProblem
from sysid_btr.terms.base import LINK_SUFFIX, TETHER_SUFFIX, Scope
from sysid_btr.terms.effect import Effect
from sysid_btr.terms.free_form import FREE_FORMS
from sysid_btr.terms.model import Model

Library = Sequence[type[Effect]]
Linear = tuple[ReplayProblem, FloatArray, FloatArray]
"""A problem, and its residual (r,) and Jacobian (r, p) under a model."""


def leading_hypotheses(state: State, library: Library, rules: Selection) -> tuple[list[Hypothesis], int]:
    """The leading hypotheses of a scan, and how many perturbations were simulated; an interrupted run noted them."""
    study, values = state.study, state.fitted.model.values[None]
    places = (*joint_names(study.robot), *body_names(study.robot), "robot")
    known = None if study.journal is None else study.journal.replay("scan", values, whole=True)
    if known is not None:
        return from_arrays(known.arrays, library, places), int(known.arrays["answers"])
    began = perf_counter()
    found, residuals = _scan(state, [e for e in library if e not in FREE_FORMS], rules)
    hypotheses = form_hypotheses(found, residuals, state.study.scales, rules)
    if could_gain(rules, state.before, state.fitted, learnt=bool(state.effects)):
        scanned = {(h.effect, h.places) for h in hypotheses}
        curves = curves_of(state.study, state.fitted.model, library, rules)
        hypotheses += [h for h in curves if (h.effect, h.places) not in scanned]
    if study.journal is not None:
        arrays = {**to_arrays(hypotheses, library, places), "answers": np.array(len(found)), "loss": np.zeros(1)}
        seconds = study.journal.seconds + perf_counter() - began
        study.journal.append(Record("scan", values, arrays, seconds))
    return hypotheses, len(found)


def curves_of(study: Study, model: Model, library: Library, rules: Selection) -> list[Hypothesis]:
    """Of which variable what a model leaves is a smooth function: tried last, where no law says it more simply."""
    asked = set(library) & set(FREE_FORMS)
    if not asked:
        return []
    problem = study.train_problem(model)
    forms = free_forms(problem, model.values, study.scales, missing_torques(problem, model.values, study.scales))
    own = [f.hypothesis for f in forms if f.hypothesis.effect in asked and f.hypothesis.gain >= rules.candidate_gain]
    return [*curves_of_all(own, library), *curves_together(own, rules), *own][: rules.curves]


def replacements(state: State, library: Library, parts: Sequence[IntArray], rules: Selection) -> list[list[Hypothesis]]:
    """What would explain, to first order, most of what each part of the model does: laws, best first, and curves.

    Parameters
    ----------
    state : with a model of p numbers.
    parts : positions among these of the numbers of each part, which goes.
    """
    study, model = state.study, state.fitted.model
    problem, residual, jacobian = _linear(study, model, rules)
    asked = _perturbations(state, [e for e in library if e not in FREE_FORMS], problem, residual)
    whole, without = Residual.of(residual, jacobian), []
    for part in parts:
        gone = jacobian[:, part] @ (model.terms.nominal[part] - model.values[part])
        without.append(whole.beside(residual + gone, np.delete(jacobian, part, axis=1)))
    found = responding(problem.with_numerics(study.cheap), model.values, without, asked, study.scales, rules)
    result = []
    for part, own, rest in zip(parts, found, without, strict=True):
        least = rules.replaces * float(rest.rest @ rest.rest - whole.rest @ whole.rest)
        laws = [h for h in form_hypotheses(own, len(residual), study.scales, rules) if h.gain >= least]
        bare = model.values.copy()
        bare[part] = model.terms.nominal[part]
        curves = curves_of(study, model.at(bare), library, rules)
        # at one place, the plainest and the best
        result.append([*laws, *(h for h in curves[:2] if h.places == curves[0].places)])
    return result


def hypotheses_at(
    study: Study, model: Model, effects: Library, places: Sequence[str], rules: Selection
) -> list[Hypothesis]:
    """What effects of one scope would explain, to first order, at some of its places beside a model, best first."""
    linear = _linear(study, model, rules)
    asked = perturbations(effects, {effects[0].scope: tuple(places)}, study.scales)
    return form_hypotheses(_scanned(study, model, linear, asked, rules), len(linear[1]), study.scales, rules)


def _linear(study: Study, model: Model, rules: Selection) -> Linear:
    """What is scanned: the problem, and its residual (r,) and Jacobian (r, p) under the model so far."""
    if study.procedure.wanders:
        study = _weighed(study, model)
    problem = shorten(study, rules.scan_seconds).train_problem(model)
    return problem, *linearise(study.with_belief(problem), model.values, step=study.stencil(model.terms))


def _scan(state: State, library: Library, rules: Selection) -> tuple[list[Sensitivity], int]:
    """What every effect would do to the residual, best first, and the number of residuals."""
    study, model = state.study, _simulated(state)
    linear = problem, residual, _ = _linear(study, model, rules)
    asked = _perturbations(state, library, problem, residual)
    if study.procedure.costly and len(asked) > rules.glance_most:
        short = shorten(study, rules.glance_seconds).train_problem(model)
        glance = short, *linearise(study.with_belief(short), model.values, step=study.stencil(model.terms))
        asked = [s.perturbation for s in _scanned(study, model, glance, asked, rules)[: rules.glance_most]]
    return _scanned(study, model, linear, asked, rules), len(residual)


def _scanned(
    study: Study, model: Model, linear: Linear, asked: Sequence[Perturbation], rules: Selection
) -> list[Sensitivity]:
    """What perturbations of a model would explain of its residual, best first."""
    problem, residual, jacobian = linear
    # what is left is the right integrator's; what an effect would change may be a little off
    cheap = problem.with_numerics(study.cheap)
    return scan(cheap, model.values, residual, jacobian, asked, study.scales, rules)


def _simulated(state: State) -> Model:
    """The model in which effects are simulated: as fitted, or, while all is missing, before it was fitted far off.

    What declared parameters can do is taken off to first order, wherever they are.
    """
    model = state.fitted.model
    off = state.study.procedure.wanders and not state.effects
    return model.at(model.terms.nominal) if off else model


def _weighed(study: Study, model: Model) -> Study:
    """The study with columns that count by what the model's own parameters leave in them, to first order."""
    problem = study.train_problem(model)
    residual, jacobian = linearise(problem, model.values, step=study.stencil(model.terms))
    left = residual - explained_by(jacobian, residual)
    return inflate(study, replace(judge(study, model), train_columns=problem.column_chi2(left)))


def _perturbations(state: State, library: Library, problem: ReplayProblem, residual: FloatArray) -> list[Perturbation]:
    """What a scan asks for: a term already at a location is not, as it is refitted with everything else."""
    study = state.study
    # the second joint of a play or a compliance is no place of its own
    places: dict[str, tuple[str, ...]] = {
        scope: tuple(name for name in study.robot.names(scope) if not name.endswith(LINK_SUFFIX))
        for scope in get_args(Scope)
    }
    asked: list[Perturbation] = perturbations(library, places, study.scales, alike_joints(study.robot))
    asked += proposals(study, problem, problem.start, residual[: problem.count], library)
    terms = state.fitted.model.terms
    taken = _with_parts_of_terms(study)
    asked = [q for q in asked if not (q.effect.structural and taken & set(q.places))]
    return [q for q in asked if terms.admit(q.effect, q.places)]


def _with_parts_of_terms(study: Study) -> set[str]:
    """Joints and bodies that the model itself, as an earlier run may have written it, gives what such terms add."""
    model = study.robot.model
    names = [model.joint(i).name for i in range(model.njnt)] + [model.site(i).name for i in range(model.nsite)]
    return {n.removesuffix(end) for n in names for end in (LINK_SUFFIX, TETHER_SUFFIX) if n.endswith(end)}
