"""From sensitivities to hypotheses: one effect at one location, at several, or the same at all of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from sysid_btr._typing import FloatArray
from sysid_btr.diagnosis.scan import Sensitivity, best_multiples
from sysid_btr.diagnosis.selection import Selection, agree
from sysid_btr.terms.effect import Effect
from sysid_btr.terms.scales import Scales, scale_at


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

    def is_same(self, other: Hypothesis) -> bool:
        """Whether both add the same, from the same first guess."""
        ours, theirs = ((h.effect, h.places, h.shared) for h in (self, other))
        return ours == theirs and np.array_equal(self.start, other.start)

    def initial_guesses(self) -> FloatArray:
        """Amounts (k, parameters) that a refit may begin from, those of the scan first."""
        kinds = len(self.effect.kinds)
        amounts = [self.effect.initial_guesses(a) for a in self.start.reshape(-1, kinds)]
        return np.vstack([self.start, np.hstack(amounts)])

    def term(self, scales: Scales) -> Effect:
        return self.effect.at(self.places, scales, shared=self.shared).around(self.start)

    def __str__(self) -> str:
        return name_at(self.effect, self.places)


def name_at(effect: type[Effect], places: Sequence[str]) -> str:
    """An effect and where it is, as it is told."""
    where = ", ".join(places) if len(places) < 5 else f"{len(places)} places"
    return f"{effect.label or effect.name} at {where}"


def form_hypotheses(found: Sequence[Sensitivity], residuals: int, scales: Scales, rules: Selection) -> list[Hypothesis]:
    """The most promising hypotheses of a scan, best first, of different effects as far as possible.

    Parameters
    ----------
    found : by a scan.
    residuals : length of the residual vector.
    scales : sizes at the joints.
    rules : what a hypothesis needs, and how many to return.
    """
    best_at: dict[str, float] = {}
    single = [s for s in found if len(s.perturbation.places) == 1]
    for one in single:
        place = one.perturbation.place
        best_at[place] = max(best_at.get(place, 0.0), one.gain)
    result: list[Hypothesis] = []
    for one in found:
        if len(one.perturbation.places) > 1 and one.gain >= rules.candidate_gain:
            perturbation = one.perturbation
            result.append(Hypothesis(perturbation.effect, perturbation.places, True, one.values, one.gain))
    for effect in dict.fromkeys(s.perturbation.effect for s in single):
        own = _best_probe_per_place([s for s in single if s.perturbation.effect is effect])
        if own[0].gain < rules.candidate_gain:
            continue
        lead = own[0]
        result.append(Hypothesis(effect, (lead.perturbation.place,), False, lead.values, lead.gain))
        if not effect.everywhere and len(own) > 1 and own[1].gain >= rules.location_rival * lead.gain:
            # what neighbours would do is alike to first order
            result.append(Hypothesis(effect, (own[1].perturbation.place,), False, own[1].values, own[1].gain))
        candidates = [s for s in own if s.gain >= rules.location_rival * best_at[s.perturbation.place]]
        group = _grow(lead, candidates, residuals, rules)
        if len(group.members) > 1:
            values = group.values(scales)
            result.append(Hypothesis(effect, group.places, False, values.ravel(), group.gain))
            if effect.everywhere and agree(values[:, effect.main], rules.common_spread):
                result.append(Hypothesis(effect, group.places, True, np.median(values, axis=0), group.gain))
    result.sort(key=lambda h: -h.gain)
    return _varied(_without_idle(result, rules), rules)


def curves_together(curves: Sequence[Hypothesis], rules: Selection) -> list[Hypothesis]:
    """Curves of one variable at several joints, best first: one cause may act at all of them.

    Parameters
    ----------
    curves : at a joint each; the first of a joint is the best there, and others do not count.
    rules : how much a joint must explain beside the one that explains most, and how many numbers a hypothesis may add.
    """
    result = []
    for effect, own in _best_by_effect(curves).items():
        lead, *others = own
        alike = [lead, *(h for h in others if h.gain >= rules.location_rival * lead.gain)]
        alike = alike[: max(rules.most_parameters // len(effect.kinds), 1)]
        if len(alike) > 1:
            places, start = tuple(h.places[0] for h in alike), np.concatenate([h.start for h in alike])
            result.append(Hypothesis(effect, places, False, start, sum(h.gain for h in alike)))
    return sorted(result, key=lambda h: -h.gain)


def curves_of_all(curves: Sequence[Hypothesis], library: Sequence[type[Effect]]) -> list[Hypothesis]:
    """The curve for which several joints ask as one of all the robot, where the library has it: what all drives share.

    Parameters
    ----------
    curves : as for `curves_together`; how much each joint explains does not matter.
    library : effects that are considered.
    """
    return [
        Hypothesis(kind, ("robot",), False, own[0].start, sum(h.gain for h in own))
        for effect, own in _best_by_effect(curves).items()
        for kind in library
        if len(own) > 1 and kind.scope == "robot" and issubclass(kind, effect)
    ]


def _best_by_effect(curves: Sequence[Hypothesis]) -> dict[type[Effect], list[Hypothesis]]:
    """Of each effect the joints where it is the best curve, those first that explain most."""
    best: dict[str, Hypothesis] = {}
    for curve in curves:
        best.setdefault(curve.places[0], curve)
    result: dict[type[Effect], list[Hypothesis]] = {}
    for curve in sorted(best.values(), key=lambda h: -h.gain):
        result.setdefault(curve.effect, []).append(curve)
    return result


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


def _best_probe_per_place(found: Sequence[Sensitivity]) -> list[Sensitivity]:
    best: dict[str, Sensitivity] = {}
    for one in found:
        place = one.perturbation.place
        if place not in best or one.gain > best[place].gain:
            best[place] = one
    return sorted(best.values(), key=lambda s: -s.gain)


@dataclass(frozen=True, eq=False)
class _Group:
    """One effect at several locations, with amounts that explain most together.

    Attributes
    ----------
    members : what was scanned at each.
    multiples : (k,) of what each explains alone.
    gain : decrease of the sum of squared residuals.
    """

    members: tuple[Sensitivity, ...]
    multiples: FloatArray
    gain: float

    @property
    def places(self) -> tuple[str, ...]:
        return tuple(s.perturbation.place for s in self.members)

    def values(self, scales: Scales) -> FloatArray:
        """(k, kinds) numbers of the effect at each; those that it has alone where others are not legal."""
        rows = []
        for one, multiple in zip(self.members, self.multiples, strict=True):
            effect, scale = one.perturbation.effect, scale_at(scales, one.perturbation.place)
            values = effect.combine(scale, one.perturbation.probe, multiple * one.amounts)
            rows.append(one.values if values is None else values)
        return np.array(rows)


def _grow(lead: Sensitivity, candidates: Sequence[Sensitivity], residuals: int, rules: Selection) -> _Group:
    """Add locations greedily while they explain something that those before do not.

    The amounts of all are found anew with each (orthogonal matching pursuit: Pati, Rezaiifar and Krishnaprasad 1993,
    doi:10.1109/ACSSC.1993.342465): joints of one limb share what each would explain alone.
    """
    offered = [lead, *(one for one in candidates if one is not lead)]
    explained = np.zeros((residuals, len(offered)))
    for k, one in enumerate(offered):
        explained[one.rows, k] = one.explained
    # the residual is measured minus predicted, so what explains it has the opposite sign
    gram, target = explained.T @ explained, np.array([-one.explained @ one.residual.rest[one.rows] for one in offered])
    effect = lead.perturbation.effect
    most = max(rules.most_parameters // len(effect.kinds), 1)
    kept, group = [0], _Group((lead,), np.ones(1), lead.gain)
    for k in range(1, len(offered)):
        if len(kept) == most:
            break
        trial = [*kept, k]
        part, aim = gram[np.ix_(trial, trial)], target[trial]
        multiples = best_multiples(part, aim, signed=effect.signed)
        gain = float(2 * multiples @ aim - multiples @ part @ multiples)
        if gain - group.gain >= max(rules.candidate_gain, rules.location_gain * group.gain):
            kept, group = trial, _Group(tuple(offered[i] for i in trial), multiples, gain)
    return group


def _without_idle(ranked: Sequence[Hypothesis], rules: Selection) -> list[Hypothesis]:
    """Drop an effect that includes a simpler one where all that it adds is zero."""
    named = {h.effect.name for h in ranked}
    return [h for h in ranked if not (named & set(h.effect.includes) and _idle(h, rules))]


def _idle(h: Hypothesis, rules: Selection) -> bool:
    kinds, start = h.effect.kinds, np.abs(h.start.reshape(-1, len(h.effect.kinds)))
    alike = [kind.unit == kinds[h.effect.main].unit for kind in kinds]
    return bool(np.all(start[:, h.effect.main] <= rules.idle * start[:, alike].max()))


def _varied(ranked: Sequence[Hypothesis], rules: Selection) -> list[Hypothesis]:
    """Best first, each once, but only some of one effect class, so that rivals get their turn."""
    taken: dict[type[Effect], int] = {}
    known = set()
    result = []
    for hypothesis in ranked:
        same = (hypothesis.effect, frozenset(hypothesis.places), hypothesis.shared)
        if same in known:
            continue
        known.add(same)
        if taken.get(hypothesis.effect, 0) < rules.refits_of_one:
            taken[hypothesis.effect] = taken.get(hypothesis.effect, 0) + 1
            result.append(hypothesis)
        if len(result) == rules.refits:
            break
    return result
