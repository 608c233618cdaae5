"""Exchange: every part of a model is compared once more with what else it may be, now that the others are known.

What was added first was chosen while the others were still missing, and a part of it, at one place, may stand for
something at another. (Floating search: Pudil, Novovicova and Kittler 1994, doi:10.1016/0167-8655(94)90127-9.)
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from sysid_btr._typing import IntArray
from sysid_btr.diagnosis.evidence import evidence_of, is_likely, is_missed, likeliest
from sysid_btr.diagnosis.hypotheses import Hypothesis, name_at
from sysid_btr.diagnosis.leads import Library, hypotheses_at, replacements
from sysid_btr.diagnosis.selection import Selection
from sysid_btr.diagnosis.state import State
from sysid_btr.diagnosis.trials import Trial, attempt, near_best
from sysid_btr.diagnosis.uncertainty import is_sized
from sysid_btr.identify.study import Study
from sysid_btr.terms.effect import Effect, family_of
from sysid_btr.terms.free_form import FREE_FORMS
from sysid_btr.terms.model import Model


@dataclass(frozen=True, eq=False)
class _Part:
    """An effect of the model, or that at one of its places."""

    effect: Effect
    places: tuple[str, ...]

    @property
    def whole(self) -> bool:
        return self.places == self.effect.places

    def columns(self, model: Model) -> IntArray:
        """Positions of its numbers among the model's."""
        every = np.arange(len(model.values))[model.terms.columns(self.effect)]
        return every if self.whole else every.reshape(len(self.effect.places), -1)[self._kept(gone=True)].ravel()

    def without(self, model: Model, state: State) -> Model:
        """The model without it."""
        if self.whole:
            return model.without(self.effect)
        kept = self._kept()
        amounts = model.own(self.effect).reshape(len(self.effect.places), -1)[kept].ravel()
        places = [self.effect.places[i] for i in kept]
        fewer = type(self.effect).at(places, state.study.scales).around(amounts)
        return model.replaced(self.effect, (fewer, amounts))

    def hypothesis(self, model: Model) -> Hypothesis:
        """It, as what it is compared with is given."""
        return Hypothesis(
            type(self.effect), self.places, self.whole and self.effect.shared, model.values[self.columns(model)], 0.0
        )

    def _kept(self, *, gone: bool = False) -> list[int]:
        return [i for i, place in enumerate(self.effect.places) if (place in self.places) is gone]

    def __str__(self) -> str:
        return name_at(type(self.effect), self.places)


def exchange(state: State, library: Library, rules: Selection) -> State:
    """The model in which each part is what explains most in its place, beside all others.

    Parameters
    ----------
    state : with effects.
    library : effects that may stand in their places.
    """
    parts = _parts(state, rules)
    # a single part was compared with all others when it was added
    rescanned = len(parts) > 1 and not state.study.procedure.costly
    columns = [part.columns(state.fitted.model) for part in parts]
    leads = replacements(state, library, columns, rules) if rescanned else [[] for _ in parts]
    for part, others in zip(parts, leads, strict=True):
        if part.effect in state.effects:
            split = _split_otherwise(state, part, library, rules) if rescanned else []
            state = _compared(state, part, others, split, rules)
    return state


def _parts(state: State, rules: Selection) -> list[_Part]:
    """Every effect, and then every place of those at a few: what stands for one thing goes as one."""
    whole = [_Part(effect, effect.places) for effect in state.effects]
    several = [e for e in state.effects if not e.shared and 1 < len(e.places) <= rules.largest_group]
    return whole + [_Part(effect, (place,)) for effect in several for place in effect.places]


def _split_otherwise(state: State, part: _Part, library: Library, rules: Selection) -> list[Hypothesis]:
    """What else may split the model where a part does: as two cannot, none was asked for beside it."""
    effect = part.effect
    kinds = [e for e in library if e.structural and e.scope == effect.scope and e is not type(effect)]
    if not effect.structural or not kinds:
        return []
    return hypotheses_at(state.study, part.without(state.fitted.model, state), kinds, part.places, rules)


def _compared(
    state: State, part: _Part, others: Sequence[Hypothesis], split: Sequence[Hypothesis], rules: Selection
) -> State:
    """The state with a part as it is, or with what predicts better, or as well and is simpler, in its place."""
    model, at = state.fitted.model, state.effects.index(part.effect)
    others = [h for h in others if not _says_the_same(h, part, model)]
    hypotheses = [h for h in others if h.effect not in FREE_FORMS][: rules.exchanges]
    hypotheses += [h for h in others if h.effect in FREE_FORMS]
    if part.whole:
        known = [h for h in state.evidence[at].alternatives if not _refines_a_law(h, model)]
        # what happens once took second place to what lasts, and is added beside it where it is missed
        known = [h for h in known if part.effect.transient or not h.effect.transient]
        hypotheses += [h for h in known if not _among(h, hypotheses)]
        hypotheses += [h for h in _at_fewer(part, model) if not _among(h, hypotheses)]
    hypotheses += [h for h in split if not _among(h, hypotheses)]
    rest = part.without(model, state)
    hypotheses = [h for h in hypotheses if rest.terms.admit(h.effect, h.places)]
    if not hypotheses:
        return state
    trials = [Trial(part.hypothesis(model), state.fitted)]
    for hypothesis in hypotheses:
        trials.append(attempt(state.study, rest, hypothesis, rules, [t.fitted for t in trials]))
    state = state.spent(sum(t.fitted.evaluations for t in trials[1:]))
    believed = trials
    if state.study.procedure.wanders:
        believed = [t for t in trials if t is trials[0] or is_believed(rules, state.study, t, trials)]
    # where the model states what decides, data show next to nothing of it
    winner = likeliest(believed) if state.study.held else preferred(rules, believed)
    evidence = evidence_of(rules, winner, trials)
    if winner is trials[0]:
        if not part.whole:
            return state
        return replace(state, evidence=(*state.evidence[:at], evidence, *state.evidence[at + 1 :]))
    left = state.without_evidence_of(part.effect) if part.whole else state.evidence
    state = replace(state, fitted=winner.fitted, evidence=(*left, evidence))
    return state.step(added=(str(winner.hypothesis),), removed=(str(part),))


def _says_the_same(hypothesis: Hypothesis, part: _Part, model: Model) -> bool:
    """Whether a hypothesis is what is there, more generally or of more places: the search would have taken it."""
    if part.effect.name in hypothesis.effect.includes or _said_of_more(hypothesis, part, model):
        return True
    return _refines_a_law(hypothesis, model)


def _refines_a_law(hypothesis: Hypothesis, model: Model) -> bool:
    """Whether a hypothesis is a curve of a cause of which the model has a law there, to which it would be added."""
    if hypothesis.effect not in FREE_FORMS:
        return False
    laws = [t for t in model.terms if isinstance(t, Effect) and type(t) not in FREE_FORMS]
    family, places = family_of(hypothesis.effect), set(hypothesis.places)
    return any(family_of(type(law)) == family and places & set(law.places) for law in laws)


def _others(kind: type[Effect], places: Sequence[str], model: Model) -> set[tuple[str, ...]]:
    """Where else the same can be said: at the other places of a term that is free for all alike."""
    alike = [t for t in model.terms if type(t) is kind and len(t.groups) == 1 and set(places) < set(t.places)]
    return {tuple(place for place in term.places if place not in places) for term in alike}


def _at_fewer(part: _Part, model: Model) -> list[Hypothesis]:
    """The same said of fewer places: what most have is what all have."""
    nominal, own = (v.reshape(-1, len(part.effect.kinds)) for v in (part.effect.neutral, model.own(part.effect)))
    kind, there = type(part.effect), 2 * nominal[0] - np.median(own, axis=0)
    fewer = [places for places in _others(kind, part.places, model) if len(places) < len(part.places)]
    return [Hypothesis(kind, places, False, np.tile(there, len(places)), 0.0) for places in fewer]


def _said_of_more(hypothesis: Hypothesis, part: _Part, model: Model) -> bool:
    """Whether a hypothesis is the same as a part, said of more places."""
    if hypothesis.effect is not type(part.effect) or len(hypothesis.places) <= len(part.places):
        return False
    return any(set(places) == set(hypothesis.places) for places in _others(hypothesis.effect, part.places, model))


def _among(hypothesis: Hypothesis, others: Sequence[Hypothesis]) -> bool:
    return any(h.effect is hypothesis.effect and set(h.places) == set(hypothesis.places) for h in others)


def is_believed(rules: Selection, study: Study, trial: Trial, trials: Sequence[Trial]) -> bool:
    """Whether a trial may take the place of the first one also where what is left grows in a replay.

    Much would take that up, see `search`: it must be likely, or predict no worse with fewer numbers, and some number of
    it must not be nothing (`certainty.UNSIZED`).
    """
    own = trials[0]
    simpler = trial.hypothesis.complexity < own.hypothesis.complexity
    believed = simpler and trial.fitted.misfit <= own.fitted.misfit
    believed = believed or is_likely(rules, own.fitted, trial, trials)
    return believed and is_sized(study, trial.fitted)


def preferred(rules: Selection, trials: Sequence[Trial]) -> Trial:
    """The first of several trials, unless another predicts held-out data better, or as well and is simpler.

    One with more numbers must be missed: by more than these are worth.
    """
    own = trials[0]
    near = near_best(rules, [t for t in trials if np.isfinite(t.fitted.holdout)])
    if own in near:
        near = [t for t in near if t is own or t.hypothesis.complexity < own.hypothesis.complexity]
    best = min(near, key=lambda t: (t.hypothesis.complexity, t is not own, t.fitted.misfit))
    wider = best.hypothesis.complexity > own.hypothesis.complexity
    return own if wider and not is_missed(rules, own.fitted, best.fitted) else best
