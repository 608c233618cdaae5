"""Several effects of one family at a joint, of which a curve may say all at once.

Laws are added one at a time, and the next, or a curve, takes up what the form of the one before leaves: a spring that
hardens is a stop, a spring beside it, and more beside these.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import reduce

from sysid_btr.diagnosis.evidence import Evidence
from sysid_btr.diagnosis.leads import Library, curves_of
from sysid_btr.diagnosis.selection import Selection, at_floor
from sysid_btr.diagnosis.state import State
from sysid_btr.diagnosis.trials import attempt
from sysid_btr.identify.refit import Fitted
from sysid_btr.terms.effect import Effect, family_of
from sysid_btr.terms.free_form import FREE_FORMS


def as_curves(state: State, library: Library, rules: Selection) -> State:
    """The state with a curve in the place of effects of its family at a joint, where it leaves little of their error.

    Parameters
    ----------
    state : with effects.
    library : effects that may be named.
    """
    if state.study.procedure.costly:
        return state
    for group in of_one_cause(state.effects):
        if not at_floor(rules, state.fitted):
            state = _as_curve(state, group, library, rules)
    return state


def of_one_cause(effects: Sequence[Effect]) -> list[tuple[Effect, ...]]:
    """Of some effects laws, and curves that took up the rest of them, of one family at one joint and at no other."""
    groups: dict[tuple[str, tuple[str, ...]], list[Effect]] = {}
    for effect in effects:
        if len(effect.places) == 1:
            groups.setdefault((family_of(type(effect)), effect.places), []).append(effect)
    several = (tuple(group) for group in groups.values() if len(group) > 1)
    return [group for group in several if any(type(one) not in FREE_FORMS for one in group)]


def _as_curve(state: State, group: tuple[Effect, ...], library: Library, rules: Selection) -> State:
    family, places = family_of(type(group[0])), group[0].places
    bare = state.fitted.model.without(*group)
    found = curves_of(state.study, bare, library, rules)
    curve = next((h for h in found if family_of(h.effect) == family and h.places == places), None)
    if curve is None or not bare.terms.admit(curve.effect, places):
        return state
    trial = attempt(state.study, bare, curve, rules)
    state = state.spent(trial.fitted.evaluations)
    if not _leaves_little(trial.fitted, state.fitted, rules):
        return state
    known = list(zip(state.effects, state.evidence, strict=True))
    own = reduce(Evidence.joined, (evidence for effect, evidence in known if effect in group))
    # a law that it replaces is no rival
    own = own.beside([effect.name for effect in group])
    staying = tuple(evidence for effect, evidence in known if effect not in group)
    state = replace(state, fitted=trial.fitted, evidence=(*staying, own))
    return state.step(added=(str(curve),), removed=[f"{one.name} at {', '.join(places)}" for one in group])


def _leaves_little(curve: Fitted, several: Fitted, rules: Selection) -> bool:
    """Whether a curve explains most of what several effects leave above the noise, fitted and held out."""
    parts = ((curve.train, several.train), (curve.holdout, several.holdout))
    return all(after - 1 <= rules.joins * (before - 1) for after, before in parts)
