"""Forward search: scan for what is missing, refit the leading hypotheses, add the best; again until nothing helps."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from math import nan

import numpy as np

from sysid_btr.diagnosis.elimination import without_dispensable
from sysid_btr.diagnosis.evidence import at_the_likeliest_place, evidence_of, is_likely, likeliest, preference, weights
from sysid_btr.diagnosis.hypotheses import Hypothesis
from sysid_btr.diagnosis.leads import Library, leading_hypotheses
from sysid_btr.diagnosis.scan import is_special_case
from sysid_btr.diagnosis.selection import (
    Selection,
    all_explained,
    at_floor,
    could_gain,
    has_minimum_gain,
    improves,
    is_log_explained,
    relieves,
    something_left,
)
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
    of_a_special_case,
)
from sysid_btr.estimators.base import Budget, Progress
from sysid_btr.identify.bounds import fit_beyond
from sysid_btr.identify.prior import is_implausible, prior_residual
from sysid_btr.identify.recorder import as_recorded, own_steps
from sysid_btr.identify.refit import refit, robust_refit
from sysid_btr.progress import phase
from sysid_btr.simulation.numerics import Numerics
from sysid_btr.terms.free_form import FREE_FORMS
from sysid_btr.terms.model import Model

Say = Callable[[str], None]
OWN_STEPS_FROM = 3
"""Round from which more would be named, and before which the model file's own steps are tried. Time."""
ROUND_SHARE = 0.35
"""Expected fraction of a round in what is left of a search."""


def search(state: State, library: Library, rules: Selection, progress: Progress, made: Sequence[Trial] = ()) -> State:
    """Add effects one at a time until nothing is left to explain, or nothing helps.

    What a form that is not quite right leaves, much would take up: nothing joins effects that explain the log already
    unless it is likely to be what it is called. Where errors of the model grow in a replay, what such a form leaves
    grows too. There an effect beside fewer that is not likely may become so once another is known; where the next is
    not likely either, both go (early stopping with patience: Prechelt 1998, doi:10.1007/3-540-49430-8_3). Where much is
    left, the search goes on without them, so many times (limited discrepancy search: Harvey and Ginsberg 1995); trials
    that were `made` of the state it goes on from are not made again.
    """
    sure, doubtful, beside_sure = state, list[Hypothesis](), made
    for number in range(1, rules.rounds + 1):
        from_sure, state = state is sure, _held_to_model(state)
        enough = at_floor(rules, state.fitted) or all_explained(rules, state.before, state.fitted)
        enough = enough and not is_implausible(state.fitted.prior_residual)
        if enough or not could_gain(rules, state.before, state.fitted):
            break
        if number == OWN_STEPS_FROM:
            tried = _in_own_steps(state, library, rules, progress)
            if tried.study.numerics != state.study.numerics:
                return tried
            state = tried
        state = state.in_longest_steps()
        now = state.fitted

        def say(note: str, number: int = number, at: State = state) -> None:
            so_far = f"(so far {at.fitted.holdout:.4g})"
            progress(done=at.replays, total=None, best=nan, note=f"round {number}: {note} {so_far}")

        with phase("", ROUND_SHARE):
            state, trials = _try_promising(state, library, rules, say, beside_sure if from_sure else ())
            recorded = _recorded(state, trials, rules)
        beside_sure = trials if from_sure else beside_sure
        if recorded is not None:
            state = recorded
            continue
        winner = _best(state, trials, rules)
        if winner is not None:
            state, winner, trials = _simplified(state, winner, trials, library, rules)
        floating = state.study.procedure.leaves_ground_error
        explained = bool(state.effects) and is_log_explained(rules, state.before, now, floating=floating)
        if explained and winner is not None and not is_likely(rules, now, winner, trials):
            winner = None
        likely = _is_likely(state, winner, trials, rules)
        told = candidates_of(rules, now, trials, winner, number)
        state = replace(state, candidates=(*state.candidates, *told))
        if winner is None:
            break
        state = _add(state, winner, trials, rules)
        doubtful = [] if likely else [*doubtful, winner.hypothesis]
        if likely:
            sure, beside_sure = state, ()
        if sure.effects and len(doubtful) == rules.patience:
            sure = replace(sure, candidates=state.candidates, replays=state.replays, steps=state.steps)
            sure = sure.step(removed=[str(h) for h in doubtful])
            if not rules.detours or not something_left(rules, sure.before, sure.fitted):
                return sure
            others = tuple(effect for effect in library if effect not in {h.effect for h in doubtful})
            return search(sure, others, replace(rules, detours=rules.detours - 1), progress, beside_sure)
    return state


def _held_to_model(state: State) -> State:
    """The state held to what the model states of its masses, where the log alone asks for some that robots do not have.

    What is missing may be imitated by these down to the noise.
    """
    model = state.fitted.model
    if state.study.redundancy or not is_implausible(prior_residual(model.terms.parameters, model.values)):
        return state
    study = state.study.held_to_model()
    fitted = refit(study, model)
    held = replace(state, study=study, fitted=fitted) if is_implausible(fitted.prior_residual) else state
    return held.spent(fitted.evaluations)


def _is_worthy(rules: Selection, state: State, trial: Trial) -> bool:
    """Whether a trial removes more than a trace, and beside others more than what these leave looks like.

    At one moment that is a push, and of any variable some curve. And whether the log says so, under errors as
    correlated as those that are left: a part of a wrong model's error vanishes with almost anything. Held-out data are
    asked alone, if they show anything of it; what happens once they cannot know.
    """
    if relieves(rules, state.fitted, trial.fitted):
        return True
    effect, beside = trial.hypothesis.effect, bool(state.effects)
    more = has_minimum_gain(
        rules,
        state.before,
        state.fitted,
        trial.fitted,
        transient=effect.transient and beside,
        learnt=effect in FREE_FORMS and beside,
    )
    if not more:
        return False
    now, then = state.fitted, trial.fitted
    if improves(rules, now, then):
        return preference(now, then) >= rules.evident
    return bool(weights([now, then], then, [0, trial.hypothesis.complexity])[1] >= rules.evident)


def _best(state: State, trials: Sequence[Trial], rules: Selection) -> Trial | None:
    worthy = [t for t in trials if _is_worthy(rules, state, t)]
    if state.study.held:
        # data show next to nothing of it
        sparing = [t for t in worthy if relieves(rules, state.fitted, t.fitted)]
        if sparing:
            return likeliest(sparing)
    winner = choose(rules, state.fitted, worthy)
    return None if winner is None else at_the_likeliest_place(rules, winner, worthy)


def _simplified(
    state: State, winner: Trial, trials: list[Trial], library: Library, rules: Selection
) -> tuple[State, Trial, list[Trial]]:
    """The winner of a round as the special case of its law that will do for now, one of all trials."""
    simple, spent = of_a_special_case(state.study, state.fitted, winner, trials, library, rules)
    return state.spent(spent), simple, trials if simple in trials else [*trials, simple]


def _is_likely(state: State, winner: Trial | None, trials: Sequence[Trial], rules: Selection) -> bool:
    """Whether a round has a winner that is what it is called; where nothing wanders, what wins is."""
    if winner is None:
        return False
    return not state.study.procedure.wanders or is_likely(rules, state.fitted, winner, trials)


def _try_promising(
    state: State, library: Library, rules: Selection, say: Say, made: Sequence[Trial]
) -> tuple[State, list[Trial]]:
    """Refit the hypotheses of a scan, the most promising first, while they may matter.

    Curves for which there is a law come last, and only where no law is likely. Trials of this state that were `made`
    before are taken as they are.
    """
    say("scan for what lowers the held-out chi2")
    hypotheses, answers = leading_hypotheses(state, library, rules)
    state = state.spent(answers)
    trials: list[Trial] = []
    waiting: list[Hypothesis] = []

    def tried(hypothesis: Hypothesis) -> State:
        again = next((t for t in made if t.hypothesis.is_same(hypothesis)), None)
        if again is not None:
            trials.append(again)
            return state
        others = (state.fitted, *(t.fitted for t in trials))
        trial = attempt(state.study, state.fitted.model, hypothesis, rules, others)
        trials.append(trial)
        say(f"with {hypothesis} held-out chi2 {trial.fitted.holdout:.4g}")
        return state.spent(trial.fitted.evaluations)

    for hypothesis in hypotheses:
        if is_superfluous(rules, hypothesis, trials) or is_outdone(rules, hypothesis, trials):
            continue
        if is_hopeless(rules, hypothesis, hypotheses[0], len(trials)):
            continue
        if has_law(rules, hypothesis, state.fitted, trials):
            waiting.append(hypothesis)
            continue
        state = tried(hypothesis)
    while waiting and not _is_likely(state, _best(state, trials, rules), trials, rules):
        state = tried(waiting.pop(0))
    return state, trials


def _recorded(state: State, trials: Sequence[Trial], rules: Selection) -> State | None:
    """The state in the steps of a recorder that the best of some trials show, which the effect hid; None where none."""
    if any(at_floor(rules, trial.fitted) for trial in trials):
        return None
    finite = [t for t in trials if np.isfinite(t.fitted.misfit)]
    for trial in sorted(finite, key=lambda t: t.fitted.misfit)[: rules.least_refits]:
        recorded = as_recorded(state.study, trial.fitted.model)
        if recorded is not state.study:
            return _in_steps(state, recorded.numerics, state.fitted.model)
    return None


def _in_own_steps(state: State, library: Library, rules: Selection, progress: Progress) -> State:
    """What is found in the model file's own steps, if that is no more and leaves nothing; else the state as it is."""
    own, declared = own_steps(state.study), state.first.model
    if own is None:
        return state
    plain = replace(state, evidence=(), steps=state.steps[:1])
    there = _in_steps(plain, own, declared.at(declared.terms.begin))
    found = search(there, library, replace(rules, rounds=OWN_STEPS_FROM - 1), progress)
    return found if at_floor(rules, found.fitted) else state.spent(found.replays - state.replays)


def _in_steps(state: State, numerics: Numerics, model: Model) -> State:
    """The state in other steps, with a model that is fitted again."""
    study = replace(state.study, numerics=numerics)
    study, fitted = robust_refit(study, refit(study, model), 1)
    return replace(state, study=study, fitted=fitted).spent(fitted.evaluations)


def _add(state: State, winner: Trial, trials: Sequence[Trial], rules: Selection) -> State:
    """The state with the winner of a round, all of it refitted."""
    study = state.study
    if winner.fitted.numerics != study.numerics:
        study = replace(study, numerics=winner.fitted.numerics)
    kept, spent = without_dispensable(study, winner, rules)
    hypothesis, fitted = kept.hypothesis, kept.fitted
    evidence = evidence_of(rules, winner, trials)
    # a more general effect takes the place of the special case it includes
    gone = [e for e in state.effects if is_special_case(e, hypothesis.effect, hypothesis.places)]
    staying = [known for e, known in zip(state.effects, state.evidence, strict=True) if e not in gone]
    if gone:
        rest = fitted.model.without(*gone, fitted.model.terms[-1])
        fitted = refit(study, rest.with_(hypothesis.term(study.scales), hypothesis.start))
    study = study.with_initial_states(fitted.model)
    study, fitted = robust_refit(study, fitted, 1)
    # how large an effect can be follows from the plain model's motion, which is not the robot's
    fitted = fit_beyond(study, fitted, Budget(), first=len(state.first.model.values))
    state = replace(state, study=study, fitted=fitted, evidence=(*staying, evidence)).spent(spent + fitted.evaluations)
    if at_floor(rules, fitted) and (recorded := as_recorded(study, fitted.model)) is not study:
        state = _in_steps(state, recorded.numerics, fitted.model)
    return state.step(added=(str(hypothesis),))
