"""The finding in words."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from sysid_btr.diagnosis.closing import NamedEffect, Verdict
from sysid_btr.identify.intervals import Estimate
from sysid_btr.identify.scores import Scores
from sysid_btr.terms.effect import Effect
from sysid_btr.units import after_number, probability, si_all, with_digits_of


def sentence_of(effect: Effect, found: Sequence[Estimate]) -> str:
    """One effect with places and amounts; what follows +- is half of the 95 % interval, and the sentence says so."""
    kinds = len(effect.kinds)
    parts = []
    for i, group in enumerate(effect.groups):
        own = found[i * kinds : (i + 1) * kinds]
        amounts = effect.in_words(group.partition(",")[0], np.array([e.value for e in own])) or ", ".join(
            _amount(e, k.name, kinds > 1) for e, k in zip(own, effect.kinds, strict=True)
        )
        where = "" if effect.scope == "robot" else f" at {_places(group.split(','))}"
        parts.append(f"{where}: {amounts}")
    text = effect.described + ";".join(parts)
    return f"{text} (95 %)" if "+-" in text else text


def _places(names: Sequence[str]) -> str:
    return ", ".join(names) if len(names) < 7 else f"{len(names)} places ({', '.join(names[:3])}, ...)"


def _left(before: Scores, after: Scores, channel: str) -> str:
    """How much of the squared error above the noise floor is left in fitted and in held-out data."""
    parts = {"fitted": (before.train, after.train), "held-out": (before.holdout, after.holdout)}
    shares = {
        name: (new[channel].chi2 - 1) / max(old[channel].chi2 - 1, 1e-12)
        for name, (old, new) in parts.items()
        if channel in old and channel in new
    }
    percent = {name: 100 * max(share, 0.0) for name, share in shares.items()}
    listing = " and ".join(f"{p:{'.0f' if p >= 1 else '.1g'}} % in {name}" for name, p in percent.items())
    return f"{listing} data"


def _amount(estimate: Estimate, kind: str, label: bool) -> str:
    half = 0.5 * (estimate.ci95[1] - estimate.ci95[0])
    unit = after_number(estimate.unit, estimate.nominal)
    text = f"{with_digits_of(estimate.value, half)} +- {with_digits_of(half, half)}{unit}"
    return f"{kind} {text}" if label else text


def message_of(
    verdict: Verdict,
    effects: Sequence[NamedEffect],
    before: Scores,
    nearest: Scores,
    left: Mapping[str, Any] | None,
    channel: str = "position",
    unit: str = "rad",
    doubt: str = "",
) -> str:
    """The verdict in one sentence, with the held-out error; `effects` are the best there are, `nearest` with them.

    `doubt` is what is to be said of the declared parameters alone.
    """
    errors = ""
    if channel in before.holdout and channel in nearest.holdout:
        old, new, floor = si_all(
            [before.holdout[channel].rmse, nearest.holdout[channel].rmse, before.holdout[channel].floor], unit
        )
        change = old if verdict in ("unexplained", "nothing_missing") else f"{old} -> {new}"
        errors = f" Held-out {channel} error {change} (noise floor {floor})."
    if verdict == "nothing_missing":
        if doubt:
            return f"The declared parameters explain the log down to its noise, but {doubt}.{errors}"
        return "Nothing is missing: the declared parameters explain the log down to its noise." + errors
    if verdict == "unexplained":
        hint = "" if not left else f" The residual is {left.get('summary', 'not characterised')}."
        if effects:
            listing = ", ".join(f"{e.effect} at {_places(e.where)}" for e in effects)
            rest = _left(before, nearest, channel)
            hint = (
                f" The nearest, {listing}, leaves {rest} of the squared error above the noise, and is less likely "
                f"right than not.{hint}"
            )
        return "Unexplained: no effect of the library accounts for what the model lacks." + hint + errors
    if verdict == "partly_explained":
        return _partly(effects, _left(before, nearest, channel), left) + errors
    likely = [e for e in effects if e.likely]
    listing = "; ".join(e.sentence for e in likely)
    if left:
        errors += f" A residual remains that no effect accounts for: {left.get('summary', 'not characterised')}."
    if verdict == "ambiguous":
        other = ", ".join(dict.fromkeys(c for e in likely for c in e.confused_with))
        listing += f"; on this log it is confounded with {other}"
    begin = "Ambiguous: the" if verdict == "ambiguous" else "The"
    return f"{begin} model lacks {listing}.{_doubtful(effects)}{errors}"


def _partly(effects: Sequence[NamedEffect], rest: str, left: Mapping[str, Any] | None) -> str:
    """What is likely, what else was added, and what is left."""
    likely = [e for e in effects if e.likely]
    text = "Partly explained: the model lacks " + "; ".join(
        f"{e.sentence}, {e.family} with {probability(e.certainty)} certainty{', its form open' * e.provisional}"
        for e in likely
    )
    text += f".{_doubtful(effects)} Of the squared error above the noise, {rest} is left"
    return text + (f": {left.get('summary', 'not characterised')}." if left else ".")


def _doubtful(effects: Sequence[NamedEffect]) -> str:
    """A sentence on what was added and is no more likely right than not; empty where all is likely."""
    others = [e for e in effects if not e.likely]
    if not others:
        return ""
    added = "; ".join(f"{e.sentence}, {e.family} with {probability(e.certainty)} certainty" for e in others)
    return f" Also added, less likely than not to be what it is called: {added}."
