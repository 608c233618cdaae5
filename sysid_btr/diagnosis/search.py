"""Forward search: scan for what is missing, refit the leading hypotheses, add the best; again until nothing helps."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from math import nan
from time import perf_counter
from typing import get_args

import numpy as np

from sysid_btr._typing import FloatArray
from sysid_btr.diagnosis.elimination import without_dispensable
from sysid_btr.diagnosis.evidence import evidence_of
from sysid_btr.diagnosis.free_form import free_forms
from sysid_btr.diagnosis.hypotheses import Hypothesis, form_hypotheses, from_arrays, to_arrays
from sysid_btr.diagnosis.scan import Perturbation, Sensitivity, explained_by, perturbations, scan
from sysid_btr.diagnosis.selection import Selection, all_explained, at_floor, has_minimum_gain
from sysid_btr.diagnosis.signature import proposals
from sysid_btr.diagnosis.state import State
from sysid_btr.diagnosis.trials import (
    Trial,
    attempt,
    candidates_of,
    choose,
    has_law,
    is_hopeless,
    is_outdone,
    is_superfluous,
)
from sysid_btr.estimators.base import Progress
from sysid_btr.estimators.journal import Record
from sysid_btr.estimators.lsq import linearise
from sysid_btr.identify.missing_torque import missing_torques
from sysid_btr.identify.refit import inflate, judge, refit, robust_refit, shorten
from sysid_btr.identify.study import Study
from sysid_btr.models.robot import body_names, joint_names
from sysid_btr.objectives.problem import ReplayProblem
from sysid_btr.terms.base import Scope
from sysid_btr.terms.effect import Effect
from sysid_btr.terms.free_form import FREE_FORMS
from sysid_btr.terms.model import Model

Library = Sequence[type[Effect]]
Say = Callable[[str], None]


def search(state: State, library: Library, rules: Selection, progress: Progress) -> State:
    """Add effects one at a time until nothing is left to explain, or nothing helps."""
    for number in range(1, rules.rounds + 1):
        if at_floor(rules, state.fitted) or all_explained(rules, state.before, state.fitted):
            break
        now = state.fitted

        def say(note: str, number: int = number, at: State = state) -> None:
            so_far = f"(so far {at.fitted.holdout:.4g})"
            progress(done=at.replays, total=None, best=nan, note=f"round {number}: {note} {so_far}")

        state, trials = _try_promising(state, library, rules, say)
        worthy = [t for t in trials if _is_worthy(rules, state, t)]
        winner = choose(rules, now, worthy)
        told = candidates_of(rules, now, trials, winner, number)
        state = replace(state, candidates=(*state.candidates, *told))
        if winner is None:
            break
        state = _add(state, winner, trials, rules)
    return state


def _is_worthy(rules: Selection, state: State, trial: Trial) -> bool:
    """Whether a trial removes more than a trace; beside others, more than what these leave looks like.

    At one moment that is a push, and of any variable some curve.
    """
    effect, beside = trial.hypothesis.effect, bool(state.effects)
    return has_minimum_gain(
        rules,
        state.before,
        state.fitted,
        trial.fitted,
        transient=effect.transient and beside,
        learnt=effect in FREE_FORMS and beside,
    )


def _try_promising(state: State, library: Library, rules: Selection, say: Say) -> tuple[State, list[Trial]]:
    """Refit the hypotheses of a scan, the most promising first, while they may matter."""
    say("scan for what lowers the held-out chi2")
    hypotheses, answers = leading_hypotheses(state, library, rules)
    state = state.spent(answers)
    trials: list[Trial] = []
    for hypothesis in hypotheses:
        if is_superfluous(rules, hypothesis, trials) or is_outdone(rules, hypothesis, trials):
            continue
        if is_hopeless(rules, hypothesis, hypotheses[0], len(trials)):
            continue
        if has_law(rules, hypothesis, state.fitted, trials):
            continue
        trial = attempt(state.study, state.fitted.model, hypothesis, rules)
        trials.append(trial)
        say(f"with {hypothesis} held-out chi2 {trial.fitted.holdout:.4g}")
        state = state.spent(trial.fitted.evaluations)
    return state, trials


def _add(state: State, winner: Trial, trials: Sequence[Trial], rules: Selection) -> State:
    """The state with the winner of a round, all of it refitted."""
    study = state.study
    if winner.fitted.numerics != study.numerics:
        study = replace(study, numerics=winner.fitted.numerics)
    kept, spent = without_dispensable(study, winner, rules)
    hypothesis, fitted = kept.hypothesis, kept.fitted
    evidence = evidence_of(rules, winner, trials)
    # a more general effect takes the place of the special case it includes
    gone = [
        e
        for e in state.effects
        if (e.label or e.name) in hypothesis.effect.includes and set(e.places) <= set(hypothesis.places)
    ]
    staying = [known for e, known in zip(state.effects, state.evidence, strict=True) if e not in gone]
    if gone:
        rest = fitted.model.without(*gone, fitted.model.terms[-1])
        fitted = refit(study, rest.with_(hypothesis.term(study.scales), hypothesis.start))
    study = study.with_initial_states(fitted.model)
    study, fitted = robust_refit(study, fitted, 1)
    state = replace(state, study=study, fitted=fitted, evidence=(*staying, evidence)).spent(spent + fitted.evaluations)
    return state.step(added=(str(hypothesis),))


def leading_hypotheses(state: State, library: Library, rules: Selection) -> tuple[list[Hypothesis], int]:
    """The leading hypotheses of a scan, and how many perturbations were simulated; an interrupted run noted them."""
    study, values = state.study, state.fitted.model.values[None]
    places = (*joint_names(study.robot), *body_names(study.robot), "robot")
    known = None if study.journal is None else study.journal.replay("scan", values, whole=True)
    if known is not None:
        return from_arrays(known.arrays, library, places), int(known.arrays["answers"])
    began = perf_counter()
    found, residuals = _scan(state, [e for e in library if e not in FREE_FORMS], rules)
    hypotheses = form_hypotheses(found, residuals, rules)
    hypotheses += _curves(state, library, rules)
    if study.journal is not None:
        arrays = {**to_arrays(hypotheses, library, places), "answers": np.array(len(found)), "loss": np.zeros(1)}
        seconds = study.journal.seconds + perf_counter() - began
        study.journal.append(Record("scan", values, arrays, seconds))
    return hypotheses, len(found)


def _curves(state: State, library: Library, rules: Selection) -> list[Hypothesis]:
    """Of which variable what is missing is a smooth function: tried last, where no law says it more simply."""
    asked = set(library) & set(FREE_FORMS)
    if not asked:
        return []
    study, model = state.study, state.fitted.model
    problem = study.train_problem(model)
    forms = free_forms(problem, model.values, study.scales, missing_torques(problem, model.values, study.scales))
    own = [f.hypothesis for f in forms if f.hypothesis.effect in asked]
    return [h for h in own if h.gain >= rules.candidate_gain][: rules.curves]


def _scan(state: State, library: Library, rules: Selection) -> tuple[list[Sensitivity], int]:
    """What every effect would do to the residual, best first, and the number of residuals."""
    study, model = state.study, state.fitted.model
    if study.procedure.shares:
        # what is missing acts in proportion on short segments alone
        study = _weighed(study.with_share(study.procedure.shares[0], model), model)
    problem = shorten(study, rules.scan_seconds).train_problem(model)
    residual, jacobian = linearise(problem, model.values, step=study.stencil(model.terms))
    asked = _perturbations(state, library, problem, residual)
    if study.procedure.costly and len(asked) > rules.glance_most:
        glance = shorten(study, rules.glance_seconds).train_problem(model)
        linear = linearise(glance, model.values, step=study.stencil(model.terms))
        seen = scan(glance, model.values, *linear, asked, study.scales, rules)
        asked = [s.perturbation for s in seen[: rules.glance_most]]
    # what is left is the right integrator's; what an effect would change may be a little off
    cheap = problem.with_numerics(study.cheap)
    found = scan(cheap, model.values, residual, jacobian, asked, study.scales, rules)
    return found, len(residual)


def _weighed(study: Study, model: Model) -> Study:
    """The study with columns that count by what the model's own parameters leave in them, to first order."""
    problem = study.train_problem(model)
    residual, jacobian = linearise(problem, model.values, step=study.stencil(model.terms))
    left = residual - explained_by(jacobian, residual)
    return inflate(study, replace(judge(study, model), train_columns=problem.column_chi2(left)))


def _perturbations(state: State, library: Library, problem: ReplayProblem, residual: FloatArray) -> list[Perturbation]:
    """What a scan asks for: a term already at a location is not, as it is refitted with everything else."""
    study = state.study
    places: dict[str, tuple[str, ...]] = {scope: study.robot.names(scope) for scope in get_args(Scope)}
    asked: list[Perturbation] = perturbations(library, places, study.scales)
    asked += proposals(study, problem, problem.start, residual, library)
    terms = state.fitted.model.terms
    present = {(type(t), p) for t in terms if t.numbers == t.kinds for p in t.places}
    split = {p for t in terms if t.structural for p in t.places}
    return [
        q for q in asked if not any((q.effect, p) in present or (q.effect.structural and p in split) for p in q.places)
    ]
