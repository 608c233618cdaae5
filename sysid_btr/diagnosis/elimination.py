"""Backward elimination: what data do not miss goes; what stays is merged, fitted to the end, and given intervals."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from math import nan

import numpy as np

from sysid_btr._typing import BoolArray, FloatArray
from sysid_btr.diagnosis.evidence import Evidence, certainty_of, is_missed
from sysid_btr.diagnosis.exchange import exchange
from sysid_btr.diagnosis.hypotheses import Hypothesis, name_at
from sysid_btr.diagnosis.joining import as_curves
from sysid_btr.diagnosis.leads import Library
from sysid_btr.diagnosis.selection import (
    Selection,
    agree,
    distance_from_nothing,
    doubtful_location,
    is_needed,
    is_small,
)
from sysid_btr.diagnosis.state import State
from sysid_btr.diagnosis.trials import Trial, attempt, is_wanted
from sysid_btr.diagnosis.uncertainty import linearised, with_intervals
from sysid_btr.estimators.base import Progress, without_loss
from sysid_btr.identify.coarse import LEAVES_MORE
from sysid_btr.identify.refit import Fitted, inflate, refit
from sysid_btr.identify.study import Study
from sysid_btr.objectives.covariance import covariance
from sysid_btr.terms.effect import Effect

Wanted = Callable[[Selection, Fitted, Fitted], bool]
"""Whether data want what the first model lacks of the second."""
SETTLED = 0.5
"""Standard errors by which a turn of initial states and parameters moves these when it is the last."""


def eliminate(state: State, library: Library, rules: Selection, progress: Progress) -> State:
    """The model with only those effects that data want, at the optimum and with intervals."""
    state, without = _without_unlikely(state.in_longest_steps(), rules)
    state = _pruned(state, rules, without)
    if not state.effects:
        return state.in_first_steps()
    state = _pruned_where_changed(state, as_curves(state, library, rules), rules)
    progress(done=state.replays, total=None, best=nan, note="each effect against what else it may be")
    state = _pruned_where_changed(state, exchange(state, library, rules), rules)
    state = _merged(state, rules).in_first_steps()
    state = _states_in_turn(state)
    study = inflate(state.study, state.fitted, memory=True)
    progress(done=state.replays, total=None, best=nan, note="final fit")
    polished = refit(study, state.fitted.model, polish=True, progress=without_loss(progress))
    state = replace(state, study=study, fitted=polished).spent(polished.evaluations)
    progress(done=state.replays, total=None, best=nan, note="intervals")
    state = with_intervals(state, rules)
    real = _distinguishable_from_nothing(state, library, rules)
    if real is not None:
        state = with_intervals(real.step(removed=_gone(state, real)), rules)
    return state


def _states_in_turn(state: State) -> State:
    """Initial states, which were those of a model that lacked its last effect, and parameters in turn.

    Turns minimise nothing together: they may wander off to where friction is at one joint what it was at two.
    """
    for _ in range(state.study.procedure.last_turns):
        study = inflate(state.study.with_initial_states(state.fitted.model, anew=False), state.fitted)
        again, before = refit(study, state.fitted.model), state.fitted
        state = state.spent(again.evaluations)
        if not again.train < LEAVES_MORE * before.train:
            break
        state = replace(state, study=study, fitted=again)
        if np.all(np.abs(again.model.values - before.model.values) <= SETTLED * _standard_errors(state)):
            break
    return state


def _standard_errors(state: State) -> FloatArray:
    """(p,) of the parameters of a fitted model."""
    problem, residual, jacobian = linearised(state.study, state.fitted.model)
    return np.asarray(np.sqrt(np.diag(covariance(jacobian, residual, problem.blocks))))


def without_dispensable(study: Study, trial: Trial, rules: Selection) -> tuple[Trial, int]:
    """A trial at fewer locations: one body that will do alone, none whose small amounts data do not miss; its cost."""
    trial, spent = _at_one_body(study, trial, rules)
    effect = trial.hypothesis.effect
    neutral = trial.hypothesis.term(study.scales).neutral[effect.main]
    while _is_reducible(trial.hypothesis, rules):
        places, model = trial.hypothesis.places, trial.fitted.model
        group = model.terms[-1]
        amounts = model.own(group).reshape(-1, len(effect.kinds))
        size = np.abs(amounts[:, effect.main] - neutral)
        least = doubtful_location(rules, size)
        if least is None:
            break
        rest = np.delete(np.arange(len(size)), least)
        smaller = replace(trial.hypothesis, places=tuple(places[i] for i in rest), start=amounts[rest].ravel())
        fewer = attempt(study, model.without(group), smaller, rules)
        spent += fewer.fitted.evaluations
        missed = (
            is_wanted(rules, fewer.fitted, trial) if effect.transient else is_missed(rules, fewer.fitted, trial.fitted)
        )
        if missed and size[least] > rules.idle * size.max():
            break
        trial = fewer
    return trial, spent


def _is_reducible(hypothesis: Hypothesis, rules: Selection) -> bool:
    """Whether its locations have amounts of their own, and are few enough to be tried one by one."""
    return not hypothesis.shared and 1 < len(hypothesis.places) <= rules.largest_group


def _at_one_body(study: Study, trial: Trial, rules: Selection) -> tuple[Trial, int]:
    """A trial with its effect at that one body of a group which will do alone, if one does; and what that took.

    What acts on one body moves those that carry it, and several of them together imitate it: how large each one's part
    is says nothing of which it is.
    """
    hypothesis, model = trial.hypothesis, trial.fitted.model
    places, effect = hypothesis.places, hypothesis.effect
    if effect.scope != "body" or not _is_reducible(hypothesis, rules):
        return trial, 0
    group = model.terms[-1]
    rest, amounts = model.without(group), model.own(group).reshape(len(places), -1)
    pairs = zip(places, amounts, strict=True)
    alone = [attempt(study, rest, replace(hypothesis, places=(p,), start=own), rules) for p, own in pairs]
    best = min(alone, key=lambda t: t.fitted.misfit)
    spent = sum(t.fitted.evaluations for t in alone)
    return (trial if is_missed(rules, best.fitted, trial.fitted) else best), spent


def _without_unlikely(state: State, rules: Selection) -> tuple[State, list[Fitted]]:
    """The state without effects that are not likely to be what they are called, beside one that is, the least first.

    Where errors of the model grow in a replay, what a form that is not quite right leaves grows too, and much takes it
    up: it would move the amounts of what is right. Beside the state, what it comes to without each of its effects,
    where that was asked.
    """
    removed, without = list[str](), list[Fitted]()
    while state.study.procedure.wanders and len(state.effects) > 1:
        without = [state.refitted_without(effect, rules.refit_seconds) for effect in state.effects]
        state = state.spent(sum(trial.evaluations for trial in without))
        sure = [certainty_of(e, trial, state.fitted) for e, trial in zip(state.evidence, without, strict=True)]
        least = int(np.argmin(sure))
        if max(sure) < rules.likely or sure[least] >= rules.likely:
            break
        effect = state.effects[least]
        removed.append(name_at(type(effect), effect.places))
        state, without = replace(state, fitted=without[least], evidence=state.without_evidence_of(effect)), []
    return (state.step(removed=removed) if removed else state), without


def _pruned(state: State, rules: Selection, without: Sequence[Fitted] = ()) -> State:
    """The state without effects, and then locations of effects, in demand only until a later effect was found.

    The last one too: with it others may have come to values at which it is not missed. What the state comes to
    `without` each of its effects need not be known.
    """
    removed: list[str] = []
    found = state.effects if len(state.effects) > 1 else ()
    for i, effect in enumerate(found):
        if without and not removed:
            trial = without[i]
        else:
            trial = state.refitted_without(effect, rules.refit_seconds)
            state = state.spent(trial.evaluations)
        if not is_needed(rules, trial, state.fitted, transient=effect.transient):
            removed.append(name_at(type(effect), effect.places))
            state = replace(state, fitted=trial, evidence=state.without_evidence_of(effect))
    for effect in state.effects if found else ():
        state, dropped = _at_fewer_locations(state, effect, rules)
        if dropped:
            removed.append(name_at(type(effect), dropped))
    return state.step(removed=removed) if removed else state


def _pruned_where_changed(before: State, state: State, rules: Selection) -> State:
    """The state pruned again if its effects are others than before: what took up the errors of those goes with them."""
    return state if state.effects == before.effects else _pruned(state, rules)


def _at_fewer_locations(state: State, effect: Effect, rules: Selection) -> tuple[State, tuple[str, ...]]:
    """The state with an effect at fewer locations, and those that are dropped."""
    if effect.shared:
        return state, ()
    amounts = state.fitted.model.own(effect)
    whole = Hypothesis(type(effect), effect.places, False, amounts, 0.0)
    now = replace(state.fitted, model=state.fitted.model.without(effect).with_(effect, amounts))
    left, spent = without_dispensable(state.study, Trial(whole, now), rules)
    state = state.spent(spent)
    dropped = tuple(p for p in effect.places if p not in left.hypothesis.places)
    if not dropped:
        return state, ()
    own = state.evidence[state.effects.index(effect)]
    return replace(state, fitted=left.fitted, evidence=(*state.without_evidence_of(effect), own)), dropped


def _merged(state: State, rules: Selection) -> State:
    """Effects of one kind found in several rounds become one; amounts that agree become one amount."""
    pieces: dict[type[Effect], list[tuple[str, FloatArray]]] = {}
    known: dict[type[Effect], Evidence] = {}
    for effect, own in zip(state.effects, state.evidence, strict=True):
        amounts = effect.spread(state.fitted.model.own(effect)[None])[0]
        pieces.setdefault(type(effect), []).extend(zip(effect.places, amounts, strict=True))
        before = known.get(type(effect))
        known[type(effect)] = own if before is None else before.joined(own)
    model = state.fitted.model.without(*state.effects)
    for kind, found in pieces.items():
        places = tuple(p for p, _ in found)
        amounts = np.array([a for _, a in found])
        even = len(found) > 2 and agree(amounts[:, kind.main], rules.common_amount)
        values = np.median(amounts, axis=0) if even else amounts.ravel()
        model = model.with_(kind.at(places, state.study.scales, shared=even).around(values), values)
    # what is in the model beside an effect is not its rival, nor is the effect itself where it is
    there = [name_at(kind, (place,)) for kind, found in pieces.items() for place, _ in found]
    kept = tuple(own.beside([*(kind.name for kind in pieces), *there]) for own in known.values())
    return replace(state, fitted=replace(state.fitted, model=model), evidence=kept)


def _distinguishable_from_nothing(state: State, library: Library, rules: Selection) -> State | None:
    """The model without what may be nothing, and locations with a small amount; None where all of it is wanted.

    Only what data do not miss is dropped: of two effects that a log shows together but cannot distinguish, one stays.
    Of what they do miss a special case may be enough: friction that falls with speed by nothing is dry friction.
    """
    doubts = [doubt for effect in state.effects if (doubt := _doubt(effect, state, rules)).fewer]
    result: State | None = None
    now = state
    for doubt in sorted(doubts, key=lambda doubt: doubt.distance):
        effect, others = doubt.effect, len(now.effects) > 1
        at = now.effects.index(effect)
        simpler = [(_at_locations(effect, kept, now), wanted) for kept, wanted in doubt.fewer if kept or others]
        simpler += [(case, is_missed) for case in _special_cases(effect, library, now)]
        for left, wanted in simpler:
            fitted = refit(now.study, now.fitted.model.replaced(effect, *left), polish=True)
            if not wanted(rules, fitted, state.fitted):
                known = (*now.evidence[:at], *((now.evidence[at],) if left else ()), *now.evidence[at + 1 :])
                result = now = replace(now, fitted=fitted, evidence=known)
                break
    return result


@dataclass(frozen=True, eq=False)
class _Doubt:
    """An effect of which less may do.

    Attributes
    ----------
    effect : of the model.
    distance : standard deviations from nothing of its least amount.
    fewer : locations, by position, at which alone it may do, fewest first, and what must not hold for that.
    """

    effect: Effect
    distance: float
    fewer: tuple[tuple[list[int], Wanted], ...]


def _doubt(effect: Effect, state: State, rules: Selection) -> _Doubt:
    """What there is to doubt of an effect; nothing where all of its amounts are large and differ from nothing.

    At a location where the amount may be nothing it is wanted as an effect is that is added; where it is small, as what
    others left while they were unknown is by now, if the log misses it.
    """
    own = state.estimates[state.fitted.model.terms.columns(effect)]
    main = slice(effect.main, None, len(effect.kinds))
    pairs = list(zip(own[main], effect.neutral[main], strict=True))
    distance = np.array([distance_from_nothing(found, nothing) for found, nothing in pairs])
    size = np.array([abs(found.value - nothing) for found, nothing in pairs])
    real = np.isinf(distance)
    large = real & ~is_small(rules, size)
    asked: list[tuple[BoolArray, Wanted]] = [] if np.array_equal(large, real) else [(large, is_missed)]
    asked.append((real, is_needed))
    fewer = tuple((np.flatnonzero(kept).tolist(), wanted) for kept, wanted in asked if not kept.all())
    return _Doubt(effect, float(distance.min()), fewer)


def _special_cases(effect: Effect, library: Library, state: State) -> list[list[tuple[Effect, FloatArray]]]:
    """Effects of one number that an effect includes, at its places, with its first number there."""
    first = state.fitted.model.own(effect).reshape(-1, len(effect.kinds))[:, 0]
    kinds = [kind for kind in library if kind.name in effect.includes and len(kind.kinds) == 1 and effect.main > 0]
    made = (kind.at(effect.places, state.study.scales, shared=effect.shared) for kind in kinds)
    return [[(one.around(first), first)] for one in made]


def _at_locations(effect: Effect, kept: Sequence[int], state: State) -> list[tuple[Effect, FloatArray]]:
    """An effect at some of its locations alone, with its amounts there; nothing of none."""
    if not kept:
        return []
    amounts = state.fitted.model.own(effect).reshape(-1, len(effect.kinds))[kept].ravel()
    places = [effect.places[i] for i in kept]
    return [(type(effect).at(places, state.study.scales).around(amounts), amounts)]


def _gone(before: State, after: State) -> tuple[str, ...]:
    """What is named before and not after."""
    staying = {(e.name, e.variant, p) for e in after.effects for p in e.places}
    gone = [(e, [p for p in e.places if (e.name, e.variant, p) not in staying]) for e in before.effects]
    return tuple(f"{e.name} at {', '.join(places)}" for e, places in gone if places)
