"""The verdict, the effects that are named with what is said of them, and the result as a whole."""

from __future__ import annotations

from collections.abc import Sequence

from sysid_btr.diagnosis.closing import Candidate, Closing, NamedEffect, Verdict
from sysid_btr.diagnosis.messages import message_of, sentence_of
from sysid_btr.diagnosis.selection import Selection, is_explained, something_left, verdict_limit
from sysid_btr.diagnosis.signature import signature
from sysid_btr.diagnosis.state import State
from sysid_btr.identify.refit import Fitted, judge
from sysid_btr.identify.scores import score
from sysid_btr.models.robot import channel_units
from sysid_btr.terms.effect import Effect
from sysid_btr.terms.library import select_effects


def verdict_of(
    rules: Selection, before: Fitted, now: Fitted, rivals: Sequence[Sequence[str]], *, floating: bool
) -> Verdict:
    """The verdict on effects, one entry of `rivals` each, that lead from one model to another."""
    limit = verdict_limit(rules, before.overall_chance)
    if not rivals:
        return "nothing_missing" if max(now.holdout, now.train) <= limit else "unexplained"
    # what happens in the fitted part alone must be explained there
    for first, last in ((before.holdout, now.holdout), (before.train, now.train)):
        if not is_explained(rules, first, last, limit, floating=floating):
            return "unexplained"
    return "ambiguous" if any(rivals) else "explained"


def conclude(state: State, verdict: Verdict, rules: Selection, seconds: float) -> Closing:
    """The result of a diagnosis that has come to its verdict."""
    study, first = state.study, state.first
    named = _named(state)
    kept = named if verdict in ("explained", "ambiguous") else ()
    left = None
    if verdict == "unexplained" or (kept and something_left(rules, state.before, state.fitted)):
        left = signature(study, state.fitted.model)
    reported = state.reported
    if reported is None:
        reported = judge(study, first.model) if study.procedure.fuses else state.fitted
    nearest = score(study, reported.model)
    # what is reported and written is one state: without a named effect, that of the fit
    after, estimates = (nearest, state.estimates) if kept else (first.before, first.estimates)
    channel = study.leading_channel
    unit = channel_units(study.robot)[channel].partition(",")[0]
    return Closing(
        study=study if kept else first.study,
        verdict=verdict,
        message=message_of(verdict, named, first.before, nearest, left, channel, unit),
        noise_floor={c: s.floor for c, s in first.before.holdout.items()},
        nominal=first.nominal,
        before=first.before,
        after=after,
        parameters=estimates[: len(first.model.values)],
        effects=kept,
        candidates=tuple(sorted(state.candidates, key=lambda c: -c.explained)),
        steps=state.steps,
        signature=left,
        before_model=first.model,
        model=reported.model,
        replays=state.replays,
        seconds=seconds,
    )


def _named(state: State) -> tuple[NamedEffect, ...]:
    """Every effect with its parameters, what held-out data lose without it, and what it may be confused with."""
    result, model = [], state.fitted.model
    for effect, confused in zip(state.effects, state.rivals, strict=True):
        columns = model.terms.columns(effect)
        own = state.estimates[columns]
        without = model.values.copy()
        without[columns] = effect.neutral
        off = judge(state.study, model.at(without))
        gain = (off.holdout - state.fitted.holdout) / max(off.holdout, 1e-12)
        confused = (*confused, *(n for n in giving_way(effect, state.candidates) if n not in confused))
        result.append(
            NamedEffect(
                effect=effect.name,
                variant=effect.variant,
                where=effect.places,
                parameters=own,
                gain_holdout=float(gain),
                confused_with=confused,
                sentence=sentence_of(effect, own),
            )
        )
    return tuple(result)


def giving_way(effect: Effect, candidates: Sequence[Candidate]) -> tuple[str, ...]:
    """Effects that did as well at the same locations but give way to this one, by convention."""
    own = next((c for c in candidates if c.effect == effect.name and set(c.where) == set(effect.places)), None)
    giving = {e.name for e in select_effects(("all",)) if effect.name in e.yields_to}
    return tuple(name for name in (own.confused_with if own else ()) if name in giving)
