"""From traces to hypotheses: one effect at one place, at several places, or the same at all of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from sysid_btr._typing import FloatArray
from sysid_btr.diagnosis.scan import Trace
from sysid_btr.terms.effect import Effect
from sysid_btr.terms.scales import Scales

NEW_PLACE = 0.02
"""A further place must explain this fraction of what its effect explains at all places so far."""
WORTH_TRYING = 40.0
"""Decrease of the sum of squared whitened residuals below which a place is noise (a scan asks many questions)."""
MOST_NUMBERS = 24
"""Parameters that one hypothesis may add."""
EVEN = 0.35
"""Relative spread of amounts within which places may share one."""
RIVAL = 0.35
"""A place joins a group only if this effect explains there at least this fraction of what the best effect does."""


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """An effect at some places, and where its refit begins.

    Attributes
    ----------
    effect, places, shared : what is added.
    start : (parameters,) first guess.
    gain : decrease of the sum of squares that the linear scan promises.
    """

    effect: type[Effect]
    places: tuple[str, ...]
    shared: bool
    start: FloatArray
    gain: float

    @property
    def size(self) -> int:
        """Number of parameters."""
        return len(self.start)

    @property
    def complexity(self) -> int:
        """Number of parameters but for those that such an effect never goes without."""
        kinds = len(self.effect.kinds)
        return self.size // kinds * (kinds - len(self.effect.details))

    def ladder(self) -> FloatArray:
        """Amounts (k, parameters) that a refit may begin from, those of the scan first."""
        kinds = len(self.effect.kinds)
        amounts = [self.effect.ladder(a) for a in self.start.reshape(-1, kinds)]
        return np.vstack([self.start, np.hstack(amounts)])

    def term(self, scales: Scales) -> Effect:
        return self.effect.at(self.places, scales, shared=self.shared).around(self.start)

    def __str__(self) -> str:
        places = ", ".join(self.places) if len(self.places) < 5 else f"{len(self.places)} places"
        return f"{self.effect.label or self.effect.name} at {places}"


def form_hypotheses(traces: Sequence[Trace], residuals: int, most: int) -> list[Hypothesis]:
    """The most promising hypotheses of a scan, best first, of different effects as far as possible.

    Parameters
    ----------
    traces : of a scan.
    residuals : length of the residual vector.
    most : how many to return.
    """
    best_at: dict[str, float] = {}
    single = [t for t in traces if len(t.question.places) == 1]
    for trace in single:
        place = trace.question.place
        best_at[place] = max(best_at.get(place, 0.0), trace.gain)
    result: list[Hypothesis] = []
    for trace in traces:
        if len(trace.question.places) > 1 and trace.gain >= WORTH_TRYING:
            question = trace.question
            result.append(Hypothesis(question.effect, question.places, True, trace.values, trace.gain))
    for effect in dict.fromkeys(t.question.effect for t in single):
        own = _best_probe_per_place([t for t in single if t.question.effect is effect])
        if own[0].gain < WORTH_TRYING:
            continue
        lead = own[0]
        result.append(Hypothesis(effect, (lead.question.place,), False, lead.values, lead.gain))
        candidates = [t for t in own if t.gain >= RIVAL * best_at[t.question.place]]
        group, gain = _grow(lead, candidates, residuals)
        group = group[: max(MOST_NUMBERS // len(effect.kinds), 1)]
        if len(group) > 1:
            places = tuple(t.question.place for t in group)
            values = np.array([t.values for t in group])
            result.append(Hypothesis(effect, places, False, values.ravel(), gain))
            main = values[:, effect.main]
            middle = float(np.median(main))
            if np.all(np.abs(main - middle) <= EVEN * abs(middle)):
                result.append(Hypothesis(effect, places, True, np.median(values, axis=0), gain))
    result.sort(key=lambda h: -h.gain)
    return _varied(_without_idle(result), most)


def to_arrays(
    hypotheses: Sequence[Hypothesis], effects: Sequence[type[Effect]], places: Sequence[str]
) -> dict[str, FloatArray]:
    """Hypotheses as numbers, for a journal: effects and places by their position in the given lists."""
    wide = max((len(h.places) for h in hypotheses), default=0)
    long = max((h.size for h in hypotheses), default=0)
    where, start = np.full((len(hypotheses), wide), np.nan), np.full((len(hypotheses), long), np.nan)
    for row, h in enumerate(hypotheses):
        where[row, : len(h.places)] = [places.index(p) for p in h.places]
        start[row, : h.size] = h.start
    return {
        "effect": np.array([effects.index(h.effect) for h in hypotheses], dtype=np.float64),
        "places": where,
        "shared": np.array([h.shared for h in hypotheses], dtype=np.float64),
        "start": start,
        "gain": np.array([h.gain for h in hypotheses]),
    }


def from_arrays(
    arrays: Mapping[str, FloatArray], effects: Sequence[type[Effect]], places: Sequence[str]
) -> list[Hypothesis]:
    """The inverse of `to_arrays`."""
    rows = zip(*(arrays[name] for name in ("effect", "places", "shared", "start", "gain")), strict=True)
    return [
        Hypothesis(
            effects[int(effect)],
            tuple(places[int(p)] for p in where[~np.isnan(where)]),
            bool(shared),
            start[~np.isnan(start)],
            float(gain),
        )
        for effect, where, shared, start, gain in rows
    ]


def _best_probe_per_place(traces: Sequence[Trace]) -> list[Trace]:
    best: dict[str, Trace] = {}
    for trace in traces:
        place = trace.question.place
        if place not in best or trace.gain > best[place].gain:
            best[place] = trace
    return sorted(best.values(), key=lambda t: -t.gain)


def _grow(lead: Trace, candidates: Sequence[Trace], residuals: int) -> tuple[list[Trace], float]:
    """Add places greedily while they explain something that those before do not (orthogonal matching)."""
    group = [lead]
    basis = _unit(lead, residuals, None)
    target_gain = lead.gain
    for trace in candidates:
        if trace is lead:
            continue
        vector = _unit(trace, residuals, basis)
        if vector is None or basis is None:
            continue
        # gain that is left after what the group explains, to first order
        kept = float(np.linalg.norm(vector[:, -1])) if vector.size else 0.0
        share = kept**2 if kept < 1 else 1.0
        left = trace.gain * share
        if left >= max(WORTH_TRYING, NEW_PLACE * target_gain):
            group.append(trace)
            target_gain += left
            basis = np.column_stack([basis, vector[:, -1] / max(kept, 1e-300)])
    return group, target_gain


def _unit(trace: Trace, residuals: int, basis: FloatArray | None) -> FloatArray | None:
    """The trace's own explanation as a unit vector, less what a basis spans; (residuals, 1)."""
    full = np.zeros(residuals)
    full[trace.rows] = trace.response @ trace.amounts
    norm = float(np.linalg.norm(full))
    if norm == 0:
        return None
    full /= norm
    if basis is not None:
        full = full - basis @ (basis.T @ full)
    return full[:, None]


def _without_idle(ranked: Sequence[Hypothesis]) -> list[Hypothesis]:
    """Drop an effect that includes a simpler one where all that it adds is zero."""
    named = {h.effect.name for h in ranked}
    return [h for h in ranked if not (named & set(h.effect.includes) and _idle(h))]


def _idle(h: Hypothesis) -> bool:
    main = h.start[h.effect.main :: len(h.effect.kinds)]
    size = np.abs(h.start).max()
    return bool(np.all(np.abs(main) <= 1e-3 * size))


def _varied(ranked: Sequence[Hypothesis], most: int) -> list[Hypothesis]:
    """Best first, but at most three hypotheses of one effect class, so that rivals get their turn."""
    taken: dict[type[Effect], int] = {}
    result = []
    for hypothesis in ranked:
        if taken.get(hypothesis.effect, 0) < 3:
            taken[hypothesis.effect] = taken.get(hypothesis.effect, 0) + 1
            result.append(hypothesis)
        if len(result) == most:
            break
    return result
