"""Trying hypotheses: the model with one of them added, refitted; and which of several trials is the best."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from operator import attrgetter

import numpy as np

from sysid_btr.diagnosis.closing import Candidate
from sysid_btr.diagnosis.free_form import OF_TIME
from sysid_btr.diagnosis.hypotheses import Hypothesis
from sysid_btr.diagnosis.selection import Selection, at_floor, explains_fitted, improves, improves_once, is_needed
from sysid_btr.identify.refit import Fitted, best_start, paired_t, refit, shorten
from sysid_btr.identify.study import Study
from sysid_btr.terms.effect import Effect, family_of
from sysid_btr.terms.free_form import FREE_FORMS
from sysid_btr.terms.model import Model
from sysid_btr.terms.scales import scale_at

ADDED = "added"
"""What became of the trial that won its round, see `fate`."""


@dataclass(frozen=True, eq=False)
class Trial:
    """A hypothesis, and the model that it was added to, as its last term, and that was refitted."""

    hypothesis: Hypothesis
    fitted: Fitted


def attempt(study: Study, rest: Model, hypothesis: Hypothesis, rules: Selection, among: Sequence[Fitted] = ()) -> Trial:
    """The model with a hypothesis added, refitted from the best of its initial guesses.

    What was fitted without it may have taken its part, so the others' nominal values are tried too. One that is far
    behind the best `among` others once it has moved stays there (racing: Maron and Moore 1997,
    doi:10.1023/A:1006556606079).
    """
    guesses = hypothesis.initial_guesses()
    terms = rest.with_(hypothesis.term(study.scales), guesses[0]).terms
    fitted, nominal = (np.tile(v, (len(guesses), 1)) for v in (rest.values, rest.terms.nominal))
    starts = np.vstack([np.hstack([fitted, guesses]), np.hstack([nominal, guesses])])
    seconds = rules.refit_seconds if len(starts) <= rules.start_few else rules.start_seconds
    spent = 0
    while True:
        start = best_start(shorten(study, seconds), terms, starts)
        short = shorten(study, rules.refit_seconds)
        found = refit(short, Model(terms, start), judged=study, iterations=rules.first_iterations)
        spent += found.evaluations + len(starts)
        floor = at_floor(rules, found) and not study.held
        if not (found.converged or floor or _is_behind(rules, found, among)):
            found = refit(short, found.model, judged=study)
            spent += found.evaluations
        finer = study.numerics.halved()
        given_up = not study.procedure.refines_step or finer.exact or finer.timestep < rules.finest_step
        if np.isfinite(found.holdout) or given_up:
            return Trial(hypothesis, replace(found, evaluations=spent))
        # a stiff spring on a light body can be too fast for the step
        study = replace(study, numerics=finer)


def _is_behind(rules: Selection, found: Fitted, among: Sequence[Fitted]) -> bool:
    """Whether a model leaves far more than the best of others does, held out and everywhere."""
    return bool(among) and all(
        measure(found) > min(map(measure, among)) + rules.outdone
        for measure in (attrgetter("misfit"), attrgetter("misfit_everywhere"))
    )


# --- what is worth a refit ---------------------------------------------------------------------------------


def is_superfluous(rules: Selection, hypothesis: Hypothesis, trials: Sequence[Trial]) -> bool:
    """Whether another trial explains all there is and this one, which is no simpler, promises much less."""
    for other in trials:
        enough = rules.settled if hypothesis.complexity >= other.hypothesis.complexity else rules.hopeless
        if at_floor(rules, other.fitted) and hypothesis.gain < enough * other.hypothesis.gain:
            return True
    return False


def is_outdone(rules: Selection, hypothesis: Hypothesis, trials: Sequence[Trial]) -> bool:
    """Whether another law of the same effect at the same locations did far worse than the best hypothesis."""
    best = min((t.fitted.misfit for t in trials), default=np.inf)
    return any(
        t.fitted.misfit > best + rules.outdone
        for t in trials
        if t.hypothesis.effect is not hypothesis.effect
        and t.hypothesis.effect.name == hypothesis.effect.name
        and set(t.hypothesis.places) == set(hypothesis.places)
    )


def has_law(rules: Selection, hypothesis: Hypothesis, before: Fitted, trials: Sequence[Trial]) -> bool:
    """Whether a curve is not needed yet: a law there explains a good part of what it promises, and harms nothing."""
    if hypothesis.effect not in FREE_FORMS:
        return False
    laws, enough = _laws_beside(rules, hypothesis, trials)
    return any(
        float(before.train_cells.sum() - t.fitted.train_cells.sum()) >= enough * hypothesis.gain
        and t.fitted.holdout < (1 + rules.transient_harm) * before.holdout
        for t in laws
    )


def _laws_beside(rules: Selection, other: Hypothesis, trials: Sequence[Trial]) -> tuple[list[Trial], float]:
    """Laws among several trials that go before a curve, or what happens once, and what part of it they must explain.

    Functions of a robot's state resemble one another along a motion. A function of time resembles no law of another
    family, and one of its own must explain as much as right effects do: pulses at its frequency explain 81 % of a sine,
    a very slow cyclic error of an encoder 91 % of a drift, and what they leave asks for others beside.
    """
    places = set(other.places)
    laws = [t for t in trials if t.hypothesis.effect not in FREE_FORMS and places & set(t.hypothesis.places)]
    if issubclass(other.effect, OF_TIME):
        return [t for t in laws if family_of(t.hypothesis.effect) == family_of(other.effect)], rules.explained
    return laws, rules.law


def is_hopeless(rules: Selection, hypothesis: Hypothesis, best: Hypothesis, tried: int) -> bool:
    """Whether a hypothesis promises much less than the most promising one, when some were tried."""
    return tried >= rules.least_refits and hypothesis.gain < rules.hopeless * best.gain


# --- which one wins ---------------------------------------------------------------------------------------


def choose(rules: Selection, before: Fitted, trials: Sequence[Trial]) -> Trial | None:
    """The simplest of the best hypotheses, if data want one at all.

    What happens once, and cannot be held out, wins where it explains more of all data than what lasts; what shows only
    in the fitted part wins where held-out data want nothing.
    """
    lasting = [t for t in trials if np.isfinite(t.fitted.holdout) and improves(rules, before, t.fitted)]
    once = [t for t in trials if t.hypothesis.effect.transient and improves_once(rules, before, t.fitted)]
    if once:
        event = min(once, key=_misfit_everywhere)
        others = [t for t in lasting if not t.hypothesis.effect.transient]
        if _misfit_everywhere(event) < min(map(_misfit_everywhere, others), default=np.inf) - rules.simpler:
            return _lasting_first(rules, before, others, event)
    if lasting:
        return _law_first(rules, before, lasting, _simplest(rules, lasting))
    fitted = [t for t in trials if explains_fitted(rules, before, t.fitted)]
    if not fitted:
        return None
    best = min(_misfit_everywhere(t) for t in fitted)
    near = [t for t in fitted if _misfit_everywhere(t) <= best + rules.simpler]
    return min(near, key=lambda t: (t.hypothesis.complexity, _misfit_everywhere(t)))


def _misfit_everywhere(trial: Trial) -> float:
    return trial.fitted.misfit_everywhere


def _simplest(rules: Selection, trials: Sequence[Trial]) -> Trial:
    """The simplest of those near the best, or what beats it beyond chance and is no refinement of it."""

    def order(trial: Trial) -> tuple[int, float]:
        return trial.hypothesis.complexity, trial.fitted.misfit

    near = near_best(rules, trials)
    named = {t.hypothesis.effect.name for t in near}
    near = [t for t in near if not named & set(t.hypothesis.effect.yields_to)]
    simplest = min(near, key=order)
    others = [t for t in near if _is_another(t.hypothesis, simplest.hypothesis)]
    better = [t for t in others if t.fitted.misfit < simplest.fitted.misfit]
    return min([t for t in better if paired_t(t.fitted, simplest.fitted) > rules.t] or [simplest], key=order)


def near_best(rules: Selection, trials: Sequence[Trial]) -> list[Trial]:
    """Of several trials those that predict about as well as the best, and simpler forms that it beats as chance may."""
    best = min(trials, key=lambda t: t.fitted.misfit)
    return [t for t in trials if t.fitted.misfit <= best.fitted.misfit + rules.simpler or _is_refined(rules, t, best)]


def _is_refined(rules: Selection, simple: Trial, best: Trial) -> bool:
    """Whether the best form of a family has more numbers than another at its locations, and beats it as chance may.

    Not what is far behind: where little of a log tells the two apart, chance may do anything. Curves have a rule of
    their own, see `has_law`.
    """
    ours, theirs = simple.hypothesis, best.hypothesis
    return (
        theirs.effect not in FREE_FORMS
        and family_of(ours.effect) == family_of(theirs.effect)
        and set(ours.places) == set(theirs.places)
        and ours.complexity < theirs.complexity
        and simple.fitted.misfit <= best.fitted.misfit + rules.outdone
        and paired_t(best.fitted, simple.fitted) < rules.t
    )


def _law_first(rules: Selection, before: Fitted, trials: Sequence[Trial], winner: Trial) -> Trial:
    """Instead of a curve, a law at its place that explains a good part of the same: the curve may follow it."""
    if winner.hypothesis.effect not in FREE_FORMS:
        return winner
    laws, enough = _laws_beside(rules, winner.hypothesis, trials)
    gain = before.holdout - winner.fitted.holdout
    laws = [t for t in laws if before.holdout - t.fitted.holdout >= enough * gain]
    return _simplest(rules, laws) if laws else winner


def _lasting_first(rules: Selection, before: Fitted, trials: Sequence[Trial], event: Trial) -> Trial:
    """Instead of what happens once, a law at its place that explains a good part of the same: it may follow.

    A push predicts nothing, and what a model lacks shows at some moment the most: where a drive is switched off, where
    a motion is fast.
    """
    laws, enough = _laws_beside(rules, event.hypothesis, trials)
    laws = [t for t in laws if _explained(before, t.fitted) >= enough * _explained(before, event.fitted)]
    return _simplest(rules, laws) if laws else event


def _explained(before: Fitted, after: Fitted) -> float:
    """Decrease of the columns' chi2, of all data."""
    return float((before.columns - after.columns).sum())


def of_a_special_case(
    study: Study,
    before: Fitted,
    trial: Trial,
    others: Sequence[Trial],
    library: Sequence[type[Effect]],
    rules: Selection,
) -> tuple[Trial, int]:
    """A trial with a simpler law that its own includes, if that will do for now; and what that took.

    What is still missing is left by a simple law, and one with more numbers takes up some of it: while more is left
    than the two differ by, the simple one goes first. Where it is not enough the other follows it.
    """
    effect, places = trial.hypothesis.effect, trial.hypothesis.places
    if effect in FREE_FORMS or at_floor(rules, trial.fitted):
        return trial, 0
    spent, simpler = 0, list[Trial]()
    for kind in library:
        if (kind.label or kind.name) not in effect.includes or len(kind.kinds) >= len(effect.kinds):
            continue
        there = tuple(p for p in places if p in study.robot.names(kind.scope) and before.model.terms.admit(kind, [p]))
        if not there:
            continue
        own = (t for t in others if t.hypothesis.effect is kind and not t.hypothesis.shared)
        found = next((t for t in own if set(t.hypothesis.places) == set(there)), None)
        if found is None:
            start = np.concatenate([kind.probes(scale_at(study.scales, p))[0][0] for p in there])
            found = attempt(study, before.model, Hypothesis(kind, there, False, start, trial.hypothesis.gain), rules)
            spent += found.fitted.evaluations
        lost, gain = found.fitted.holdout - trial.fitted.holdout, before.holdout - trial.fitted.holdout
        if lost < min(trial.fitted.holdout - 1, (1 - rules.law) * gain):
            simpler.append(found)
    return min(simpler, key=lambda t: t.fitted.misfit, default=trial), spent


def _is_another(hypothesis: Hypothesis, simple: Hypothesis) -> bool:
    """Whether a hypothesis is of another effect than a simple one, and no generalisation of it."""
    return hypothesis.effect.name != simple.effect.name and simple.effect.name not in hypothesis.effect.includes


def is_rival(rules: Selection, winner: Trial, other: Trial) -> bool:
    """Whether another effect does nearly as well, and held-out data cannot decide."""
    effect, rival = winner.hypothesis.effect, other.hypothesis.effect
    if rival.name == effect.name or effect.name in (*rival.includes, *rival.yields_to):
        return False
    return _does_as_well(rules, winner, other)


def may_be_elsewhere(rules: Selection, winner: Trial, other: Trial) -> bool:
    """Whether an effect at one place does nearly as well at another, and held-out data cannot decide.

    What sits on a body that hardly moves against its neighbour may as well sit on that.
    """
    ours, theirs = winner.hypothesis, other.hypothesis
    single = len(ours.places) == len(theirs.places) == 1 and ours.places != theirs.places
    return single and ours.effect is theirs.effect and _does_as_well(rules, winner, other)


def _does_as_well(rules: Selection, winner: Trial, other: Trial) -> bool:
    near = other.fitted.misfit <= winner.fitted.misfit + rules.rival
    return near and paired_t(winner.fitted, other.fitted) < rules.t


def candidates_of(
    rules: Selection, before: Fitted, trials: Sequence[Trial], winner: Trial | None, number: int
) -> list[Candidate]:
    """What was weighed in a round, best first, with the fraction of the held-out excess that it removes.

    That is over the noise floor, or over the least that any leaves: a floor may be taken for too high.
    """
    ordered = sorted(trials, key=lambda t: t.fitted.misfit)
    excess = before.holdout - min([1.0, *(t.fitted.holdout for t in trials if np.isfinite(t.fitted.holdout))])
    result = []
    for trial in ordered:
        effect, fitted = trial.hypothesis.effect, trial.fitted
        gain = (before.holdout - fitted.holdout) / excess if excess > 0 else 0.0
        alike = (
            other.hypothesis.effect.name
            for other in ordered
            if other.hypothesis.effect.name != effect.name
            and gain > 0
            and abs(other.fitted.misfit - fitted.misfit) < rules.rival
        )
        term = fitted.model.terms[-1]
        amounts = term.spread(fitted.model.own(term)[None])[0][:, effect.main]
        result.append(
            Candidate(
                effect=effect.name,
                where=trial.hypothesis.places,
                explained=gain,
                amplitude=float(amounts[0]),
                confused_with=tuple(dict.fromkeys(alike)),
                round=number,
                amounts=dict(zip(trial.hypothesis.places, map(float, amounts), strict=True)),
                why=fate(rules, before, trial, winner),
            )
        )
    return result


def fate(rules: Selection, before: Fitted, trial: Trial, winner: Trial | None) -> str:
    """What became of a trial in its round, and why, in words."""
    if trial is winner:
        return ADDED
    if not np.isfinite(trial.fitted.holdout):
        return "its replay diverges"
    if not is_wanted(rules, before, trial):
        return "held-out data are predicted no better with it"
    if winner is None:
        return "removes too little of the first error"
    best = winner.hypothesis
    if trial.fitted.misfit > winner.fitted.misfit + rules.simpler:
        return f"leaves more than {best}"
    if trial.hypothesis.complexity > best.complexity:
        return f"predicts no better than {best}, which is simpler"
    return f"predicts as well as {best}, which was added"


def is_wanted(rules: Selection, before: Fitted, trial: Trial) -> bool:
    """Whether any of the ways to be added is open to a trial."""
    return is_needed(rules, before, trial.fitted, transient=trial.hypothesis.effect.transient)
