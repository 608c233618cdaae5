"""How sure a name is: what the log prefers among all that was tried, and what is left where the named effect acts.

Models are compared by their predictive density on stretches of the log (pseudo-BMA+ weights, Yao, Vehtari, Simpson and
Gelman 2018, doi:10.1214/17-BA1091). What a model leaves is part of the likelihood: in each column an error of unknown
size, estimated from what is left, that counts with as many independent samples as its autocorrelation leaves it. Many
samples of a wrong model are therefore little evidence.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from sysid_btr._typing import FloatArray
from sysid_btr.diagnosis.certainty import STANDARD
from sysid_btr.diagnosis.hypotheses import Hypothesis
from sysid_btr.diagnosis.selection import Selection
from sysid_btr.diagnosis.trials import Trial, is_rival, may_be_elsewhere
from sysid_btr.identify.refit import Fitted
from sysid_btr.terms.effect import family_of
from sysid_btr.terms.free_form import FREE_FORMS

DRAWS = 400
"""Bayesian bootstrap draws over stretches: a weight is known to 0.025 at worst."""
LEAST_WEIGHT = 1e-3
"""Weight of another family below which it is not mentioned."""


@dataclass(frozen=True)
class Evidence:
    """What speaks for the name of one effect, among what was tried when it was added.

    Attributes
    ----------
    rivals : effects that do nearly as well, and other places at which the same effect does.
    family, place : weight of all trials with an effect of this family, and of all at a place that this one is at.
    others : weight of each other family that was tried.
    alternatives : the best hypothesis of each of these, to be tried again once the model is complete.
    """

    rivals: tuple[str, ...] = ()
    family: float = 1.0
    place: float = 1.0
    others: Mapping[str, float] = field(default_factory=dict)
    alternatives: tuple[Hypothesis, ...] = ()

    def beside(self, present: Sequence[str]) -> Evidence:
        """The same without rivals that are in the model themselves."""
        return replace(self, rivals=tuple(r for r in self.rivals if r not in present))

    def joined(self, other: Evidence) -> Evidence:
        """Of one effect that was added in two rounds: what was said first, with the rivals of both."""
        return replace(self, rivals=tuple(dict.fromkeys((*self.rivals, *other.rivals))))


def evidence_of(rules: Selection, winner: Trial, trials: Sequence[Trial]) -> Evidence:
    """What the log says of the name of the trial that was added, one of `trials`."""
    finite = [t for t in trials if np.isfinite(t.fitted.holdout)]
    share = weights([t.fitted for t in finite], winner.fitted, [t.hypothesis.complexity for t in finite])
    own, places = family_of(winner.hypothesis.effect), set(winner.hypothesis.places)
    tried: dict[str, float] = {}
    others: dict[str, float] = {}
    best: dict[str, tuple[float, Hypothesis]] = {}
    family = place = 0.0
    for trial, weight in zip(finite, share, strict=True):
        name, same = family_of(trial.hypothesis.effect), _is_a_case_of(winner.hypothesis, trial.hypothesis)
        family += weight * (name == own or same)
        place += weight * (same or bool(places & set(trial.hypothesis.places)))
        if name != own:
            tried[name] = tried.get(name, 0.0) + float(weight)
            others[name] = others.get(name, 0.0) + float(weight) * (not same)
            best[name] = max(best.get(name, (0.0, trial.hypothesis)), (weight, trial.hypothesis), key=lambda x: x[0])
    told = dict(sorted(((n, w) for n, w in others.items() if w > LEAST_WEIGHT), key=lambda x: -x[1]))
    likely = sorted((n for n, w in tried.items() if w > LEAST_WEIGHT), key=lambda n: -tried[n])
    alternatives = tuple(best[name][1] for name in likely)
    rivals = [t.hypothesis.effect.name for t in trials if is_rival(rules, winner, t)]
    elsewhere = [str(t.hypothesis) for t in trials if may_be_elsewhere(rules, winner, t)]
    return Evidence(tuple(dict.fromkeys(rivals + elsewhere)), float(family), float(place), told, alternatives)


def _is_a_case_of(one: Hypothesis, other: Hypothesis) -> bool:
    """Whether another law says the same and more, of which the log shows nothing: else that would have been added."""
    return other.effect not in FREE_FORMS and one.effect.name in other.effect.includes


def is_likely(rules: Selection, before: Fitted, winner: Trial, trials: Sequence[Trial]) -> bool:
    """Whether the name of one of `trials`, beside the model `before` it, is more likely right than `rules` ask for."""
    return certainty_of(evidence_of(rules, winner, trials), before, winner.fitted) >= rules.likely


def certainty_of(known: Evidence, without: Fitted, now: Fitted) -> float:
    """Probability, 0 to 1, that a name is right: what speaks for it, and the model without the effect and with it."""
    return STANDARD.certainty(grounds_of(known, without, now))


def grounds_of(known: Evidence, without: Fitted, now: Fitted) -> dict[str, float]:
    """What the certainty of a name follows from: weights of its family and place, and what is left where it acts."""
    return {"family": known.family, "place": known.place, "left": left_where_it_acts(without, now)}


def at_the_likeliest_place(rules: Selection, winner: Trial, trials: Sequence[Trial]) -> Trial:
    """The winner of some trials, or the same effect at that other place of which all data, fitted too, say more."""
    return likeliest([winner, *(t for t in trials if may_be_elsewhere(rules, winner, t))])


def likeliest(trials: Sequence[Trial]) -> Trial:
    """That of some trials of which all data, and what the model states, say most."""
    share = weights([t.fitted for t in trials], trials[0].fitted, [t.hypothesis.complexity for t in trials])
    return trials[int(np.argmax(share))]


def preference(before: Fitted, after: Fitted) -> float:
    """Weight, 0 to 1, of a model against the one before it, on held-out data, which neither was fitted to."""
    pair = np.stack([_heldout_density(model, after) for model in (before, after)])
    return float(_shares(pair, np.zeros(2))[1])


def is_missed(rules: Selection, without: Fitted, now: Fitted) -> bool:
    """Whether data miss what was left out: by more than simplicity is worth, and the model with it is likelier."""
    more = len(now.model.values) - len(without.model.values)
    worth = without.misfit - now.misfit > rules.simpler
    return worth and bool(weights([without, now], now, [0, more])[1] >= rules.evident)


def weights(models: Sequence[Fitted], best: Fitted, parameters: Sequence[int]) -> FloatArray:
    """Pseudo-BMA+ weights (m,) of models of the same data.

    Parameters
    ----------
    models : fitted to the same data, with finite errors.
    best : whose residuals say how many independent samples a column has.
    parameters : (m,) that each has beside what all have; each costs as much as it gains by chance (Akaike 1974).
    """
    density = np.stack([np.concatenate([_fitted_density(m, best), _heldout_density(m, best)]) for m in models])
    believed = (
        [0.5 * float(m.prior_residual @ m.prior_residual) for m in models]
        if all(len(m.prior_residual) for m in models)
        else [0.0]
    )
    return _shares(density, np.asarray(parameters, dtype=np.float64) + np.array(believed))


def _shares(density: FloatArray, parameters: FloatArray) -> FloatArray:
    """Weights (m,) by log densities (m, stretches), less what each gains by its parameters (m,) by chance."""
    stretches = density.shape[1]
    # a fixed seed: the draws are an integral, and the result is the same for the same data
    shares = np.random.default_rng(0).dirichlet(np.ones(stretches), DRAWS)
    total = stretches * shares @ density.T - parameters
    odds = np.exp(total - total.max(axis=1, keepdims=True))
    return np.asarray((odds / odds.sum(axis=1, keepdims=True)).mean(axis=0))


def _fitted_density(model: Fitted, best: Fitted) -> FloatArray:
    return _log_density(model.train_cells, model.train_counts, model.train_columns, best.memory)


def _heldout_density(model: Fitted, best: Fitted) -> FloatArray:
    return _log_density(model.holdout_cells, model.holdout_counts, model.holdout_columns, best.holdout_memory)


def _log_density(cells: FloatArray, counts: FloatArray, chi2: FloatArray, memory: FloatArray) -> FloatArray:
    """Log density (stretches,) under errors of the size that is left in each column, by its independent samples."""
    size = np.maximum(chi2, 1.0)[:, None]
    each = counts * np.log(size) + cells / size
    live = counts.sum(axis=0) > 0
    return np.asarray((-0.5 * each / memory[:, None]).sum(axis=0)[live])


def left_where_it_acts(without: Fitted, now: Fitted) -> float:
    """Share of the excess, in the columns that an effect explains, that is left with it; 0 to 1.

    Columns count by how much the effect improves their predictive density, and so does what the model states.
    """
    stated = len(without.prior_residual) and len(now.prior_residual)
    before, after = (np.append(m.columns, [np.mean(m.prior_residual**2)] if stated else []) for m in (without, now))
    gain = np.maximum(before - after, 0.0)
    left = np.maximum(after - 1, 0.0)
    weight = np.log(np.maximum(before, 1e-300) / np.maximum(after, 1e-300))
    weight = np.maximum(weight, 0.0)
    if not weight.sum() > 0:
        return 1.0
    return float(np.average(left / np.maximum(left + gain, 1e-300), weights=weight))


def share_explained(without: float, now: float) -> float:
    """Share of a chi2's excess over its noise floor that vanishes with an effect, 0 to 1."""
    return float(np.clip((without - now) / max(without - 1, 1e-12), 0.0, 1.0))
