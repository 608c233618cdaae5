"""The verdict, the effects that are named with what is said of them, and the result as a whole."""

from __future__ import annotations

from collections.abc import Sequence

from sysid_btr.diagnosis import certainty
from sysid_btr.diagnosis.closing import Candidate, Closing, NamedEffect, Verdict
from sysid_btr.diagnosis.evidence import Evidence, grounds_of, share_explained
from sysid_btr.diagnosis.messages import message_of, sentence_of
from sysid_btr.diagnosis.selection import Selection, has_size, is_log_explained, something_left, verdict_limit
from sysid_btr.diagnosis.signature import signature
from sysid_btr.diagnosis.state import State
from sysid_btr.diagnosis.trials import ADDED
from sysid_btr.identify.intervals import Estimate
from sysid_btr.identify.prior import doubt
from sysid_btr.identify.refit import Fitted, judge
from sysid_btr.identify.scores import score
from sysid_btr.models.robot import channel_units
from sysid_btr.terms.effect import Effect, family_of
from sysid_btr.terms.library import select_effects

NAMED: tuple[Verdict, ...] = ("explained", "partly_explained", "ambiguous")
"""Verdicts that name effects."""


def verdict_of(
    rules: Selection, before: Fitted, now: Fitted, named: Sequence[NamedEffect], *, floating: bool
) -> Verdict:
    """The verdict on effects that lead from one model to another.

    What an effect took up that is less likely than not what it is called is not explained.
    """
    limit = verdict_limit(rules, before.overall_chance)
    if not named:
        return "nothing_missing" if max(now.holdout, now.train) <= limit else "unexplained"
    likely = [e for e in named if e.likely]
    if not likely:
        return "unexplained"
    if len(likely) == len(named) and is_log_explained(rules, before, now, floating=floating):
        return "ambiguous" if any(e.confused_with for e in likely) else "explained"
    # what predicts data that were not fitted worse than the model without it is no explanation
    return "partly_explained" if now.holdout < before.holdout else "unexplained"


def conclude(state: State, verdict: Verdict, named: Sequence[NamedEffect], rules: Selection, seconds: float) -> Closing:
    """The result of a diagnosis that has come to its verdict."""
    study, first = state.study, state.first
    kept = tuple(named) if verdict in NAMED else ()
    left = None
    if verdict in ("unexplained", "partly_explained") or (kept and something_left(rules, state.before, state.fitted)):
        left = signature(study, state.fitted.model)
    reported = state.reported
    if reported is None:
        reported = judge(study, first.model) if study.procedure.fuses else state.fitted
    nearest = score(study, reported.model)
    # what is reported and written is one state: without a named effect, that of the fit
    after, estimates = (nearest, state.estimates) if kept else (first.before, first.estimates)
    alone = doubt(first.model.terms.parameters, first.values)
    channel = study.leading_channel
    unit = channel_units(study.robot)[channel].partition(",")[0]
    return Closing(
        study=study if kept else first.study,
        verdict=verdict,
        message=message_of(verdict, named, first.before, nearest, left, channel, unit, alone),
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


def named_effects(state: State, rules: Selection) -> tuple[tuple[NamedEffect, ...], int]:
    """Every effect with its parameters, how sure it is, what data lose without it, and what it may be confused with.

    Beside these how many replays that took: what data lose is what is left once all others have done what they can.
    """
    result, spent = [], 0
    for effect, evidence in zip(state.effects, state.evidence, strict=True):
        off = state.refitted_without(effect, rules.refit_seconds)
        spent += off.evaluations
        own = state.estimates[state.fitted.model.terms.columns(effect)]
        result.append(_named(effect, own, evidence, off, state, rules))
    return tuple(result), spent


def _named(
    effect: Effect, own: tuple[Estimate, ...], evidence: Evidence, off: Fitted, state: State, rules: Selection
) -> NamedEffect:
    now = state.fitted
    known = grounds_of(evidence, off, now)
    # what alone explains a log is there, whichever of its numbers it is
    alone = len(state.effects) == 1
    sure = certainty.STANDARD.certainty(known, sized=alone or has_size(own, effect.neutral))
    rest = sum(evidence.others.values())
    otherwise = {name: (1 - sure) * weight / max(rest, evidence.family) for name, weight in evidence.others.items()}
    return NamedEffect(
        effect=effect.name,
        family=family_of(type(effect)),
        variant=effect.variant,
        where=effect.places,
        parameters=own,
        certainty=sure,
        otherwise=otherwise,
        explains={"train": share_explained(off.train, now.train), "holdout": share_explained(off.holdout, now.holdout)},
        provisional=known["left"] > rules.rest,
        gain_holdout=float((off.holdout - now.holdout) / max(off.holdout, 1e-12)),
        confused_with=tuple(dict.fromkeys((*evidence.rivals, *giving_way(effect, state.candidates)))),
        sentence=sentence_of(effect, own),
        evidence=known,
    )


def giving_way(effect: Effect, candidates: Sequence[Candidate]) -> tuple[str, ...]:
    """Effects that did as well at the same locations but give way to this one, by convention."""
    there = [c for c in candidates if c.effect == effect.name and set(c.where) == set(effect.places)]
    # of several forms that were tried there, the one that was added last
    own = [c for c in there if c.why == ADDED][-1:] or there[:1]
    giving = {e.name for e in select_effects(("all",)) if effect.name in e.yields_to}
    return tuple(name for candidate in own for name in candidate.confused_with if name in giving)
