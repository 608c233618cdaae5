"""What it takes to be tried, added, kept and named: all thresholds of a diagnosis, and the rules that they set.

A rule is a function of the thresholds and of what was measured; it knows nothing of how that was simulated. Rules that
compare hypotheses with one another are in `sysid_btr.diagnosis.trials`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np

from sysid_btr._typing import BoolArray, FloatArray
from sysid_btr.identify.intervals import Estimate
from sysid_btr.identify.prior import is_implausible
from sysid_btr.identify.refit import Fitted, paired_t
from sysid_btr.terms.base import Term


@dataclass(frozen=True, repr=False)
class Selection:
    """Thresholds of a diagnosis, each with what set it.

    Chi2 is the mean square of the error over the noise floor, excess what it has above 1, misfit the sum over columns
    (one joint in one channel) of the logarithm of the held-out chi2.

    What set them: *Time*, what a scan and refits of 40 s of 22 joints may take (benchmarks/close_time); *Judgement*,
    chosen by hand, and held since by the effects planted in tests/test_diagnosis_close.py and by the right and wrong
    names that benchmarks/blind, gantry and walks count for all thresholds together; or what is said.
    """

    # --- how much is looked at ---

    scan_seconds: float = 15.0
    """Part of each log that is scanned; the leading hypotheses are refitted on more. Time."""
    glance_seconds: float = 2.5
    """Part of each log of a floating base on which all perturbations are simulated, each a simulation of its own there.
    Time."""
    glance_most: int = 150
    """Perturbations that are then simulated on the part that is scanned. Time."""
    refit_seconds: float = 20.0
    """Part of each log to which hypotheses are fitted. Time."""
    start_seconds: float = 6.0
    """Part of each log on which initial guesses are compared where they are many. Time."""
    start_few: int = 12
    """Initial guesses that are compared on all that is refitted. Time."""
    rounds: int = 10
    """Effects that are added at most. benchmarks/xl330: a real servo's ladder has up to ten rungs."""
    refits: int = 7
    """Hypotheses that are refitted in a round, at most. Time."""
    curves: int = 3
    """How many more may be curves that no law gives. Time."""
    refits_of_one: int = 3
    """How many of these may be of one effect, so that its rivals get their turn: at one location, at several, and
    alike at all of them."""
    finest_step: float = 5e-4
    """s, shortest step that is tried where a hypothesis diverges, as a stiff spring on a light body does. Time."""
    refinements: int = 1
    """Times that the step may be halved in the end. Time."""

    # --- hypotheses ---

    candidate_gain: float = 40.0
    """Decrease of the sum of squared whitened residuals below which a location is noise. By chance it exceeds 40 in
    one of 4e9 perturbations with one amount, and residuals that are correlated in time make that far more likely."""
    costly_share: float = 0.01
    """Of the best location's gain: below it nothing costly is asked about a location, which is asked about again once
    others are explained. Time."""
    location_gain: float = 0.02
    """A further location must explain this fraction of what its effect explains at all locations so far.
    Judgement."""
    location_rival: float = 0.35
    """A location joins a group only if this effect explains there at least this fraction of what the best one does.
    Judgement."""
    most_parameters: int = 24
    """Parameters that one hypothesis may add: one at each of a Nao's 22 joints. Time."""
    common_spread: float = 0.35
    """Relative spread of scanned amounts within which one amount for all locations is tried too: the scan is linear,
    and no better than that. Judgement."""
    idle: float = 1e-3
    """Amount, relative to the largest, of a location where there is nothing: what an optimiser leaves at a bound."""

    # --- what is tried ---

    least_refits: int = 3
    """Hypotheses that are refitted whatever they promise. Judgement."""
    hopeless: float = 0.5
    """Further ones are not if they promise less than this fraction of the best one's gain. Time."""
    settled: float = 0.8
    """Once a hypothesis explains all there is, others that are no simpler are tried only if they promise this
    fraction of its gain. Time."""
    outdone: float = 1.0
    """Another law of an effect is not tried if the first one's misfit is so much beyond the best: e times chi2 in one
    column. Nor is a hypothesis refitted to the end that is so far behind after its first iterations, nor taken for a
    simpler form of the best. Time."""
    first_iterations: int = 1
    """Iterations of a refit after which it is compared with the best so far. Time."""

    # --- what is added ---

    gain: float = 0.03
    """Fraction of the held-out chi2 that an effect must remove. Above the 0.02 that benchmarks/blind allows of clean
    logs."""
    column_gain: float = 0.15
    """Or this fraction of one column's: the best of tens of columns owes more to chance. Judgement."""
    t: float = 3.0
    """Paired t, over half-second stretches, with which it must: three standard errors, as several are compared."""
    certain: float = 0.3
    """Fraction, of all or of a column, whose loss needs no test: what acts in few stretches (a limit, a push) has a
    small t however large it is there. Judgement."""
    transient_harm: float = 0.05
    """Fraction by which what happens at some moment of the fitted part may worsen held-out data. Judgement."""
    whole_excess: float = 2.0
    """Excess on fitted data from which a column may ask for an effect that held-out data do not show. Judgement."""
    whole_left: float = 0.03
    """Fraction of that excess which the effect may leave: right effects leave less (see `explained`)."""
    whole_harm: float = 0.01
    """Fraction by which it may worsen held-out data. Judgement."""
    minimum_gain: float = 0.002
    """Fraction of some column's first excess that an effect must remove. The shapes of effects that are found are a
    little wrong, and much else would mend that; a smaller fraction (2e-4 in benchmarks/xl330) builds a longer ladder
    for prediction, whose last rungs mean less. Judgement."""
    minimum_gain_transient: float = 0.05
    """The same for what happens at some moment, once other effects are named: what these leave at one moment looks
    like a push. Judgement. A curve that is learnt must then remove more than the right form may leave (`explained`)."""
    least_excess: float = 0.002
    """Excess that a column is taken to have at first, at least: it is divided by."""

    evident: float = 0.5
    """Weight of the model with an effect against that without it on held-out data (`evidence.preference`), from which
    it is added: it must be the more likely of the two."""

    likely: float = 0.5
    """Certainty of its name from which one more is added to effects that explain the log already (`explained`): it must
    be more likely right than not. Over segments, from which one stays beside one that is."""
    patience: int = 2
    """Effects in turn that are added without being so likely, beside one that is, after which these go again. One may
    wait for another that acts where it does. Judgement."""
    detours: int = 1
    """Times that the search then goes on from where it was sure, without them, if much is left (`rest`). Time."""

    # --- which one of several ---

    simpler: float = 0.06
    """A simpler hypothesis wins if its misfit is within this of the best one's: 6 % of chi2 in one column.
    Judgement."""
    law: float = 0.5
    """Fraction of what a curve that is learnt explains, from which a law at its place comes first: most of it. The law
    says more, and a curve can still take up the rest. The same for a law and a special case of it, and for what happens
    once and a law. Judgement."""
    joins: float = 0.5
    """Fraction of what several laws of a family leave at a joint that a curve in their place may leave at most. A cube
    as a stop and a line: 0.1 (toy leg); the friction of a real axis as dry and viscous: 0.95 (EMPS). Judgement."""
    rival: float = 0.15
    """A rival whose misfit is within this of the winner's is confused with it, unless a paired test decides.
    Judgement."""

    # --- when there is nothing more to look for ---

    floor_all: float = 1.03
    """Held-out chi2 up to which there is nothing to look for. Noise floors, read from logs, are known to a few
    percent."""
    floor_column: float = 1.12
    """The same for the worst column, whose floor is known less well. Judgement."""
    floor_chance: float = 3.0
    """Standard deviations of chance that floors allow on top: short logs know their floor less well."""
    enough: float = 0.006
    """Fraction of a column's first excess that may be left: effects have shapes, not only amounts. Judgement."""

    # --- what is kept ---

    largest_group: int = 10
    """Groups up to so many locations are reduced, each by a refit. Time."""
    doubtful: float = 0.5
    """An amount below this fraction of the group's largest is doubted. Judgement."""
    common_amount: float = 0.05
    """Relative spread of amounts that are one amount, whatever their standard errors. Judgement."""

    # --- what is exchanged ---

    replaces: float = 0.7
    """Fraction of what a part of the model explains that something else must promise, to first order, to be tried in
    its place. Time: what promises less hardly ever does more."""
    exchanges: int = 2
    """Laws that are tried in the place of a part, beside a curve and what was weighed when it was added. Time."""

    # --- verdict ---

    explained: float = 0.975
    """Fraction of the excess, held out and fitted, that must be gone for effects to be named. benchmarks/blind: on
    148 logs of another engine the right ones left up to 1.3 % (2.3 % where one of two was missed), and what imitated
    another effect 2.9 % or more. As much a law must explain of a function of time to come before it."""
    explained_most: float = 5.0
    """Chi2 beyond which more than noise is left, however much is gone. benchmarks/blind: on 142 logs that were
    explained, rightly, up to 4.0 was left, on 98 % of them up to 1.3."""
    explained_floating: float = 0.85
    """The same for floating bases: the ground leaves more. Judgement."""
    floor_verdict: float = 1.10
    """Chi2 up to which a log shows nothing more: noise floors are known to a few percent."""
    rest: float = 0.1
    """Fraction of a column's excess that, left behind by effects that explain the rest, is reported. Judgement."""

    # --- what is held out ---

    late: float = 0.5
    """Fraction of the held-out excess in columns that are explained where they are fitted, from which something shows
    only at the end of a log: most of it."""

    def __repr__(self) -> str:
        """What differs from the standard thresholds, so that signatures stay short."""
        values = ((f.name, getattr(self, f.name), f.default) for f in fields(self))
        return f"Selection({', '.join(f'{name}={value!r}' for name, value, usual in values if value != usual)})"


STANDARD = Selection()


# --- the floor -----------------------------------------------------------------------------------------------


def column_limit(rules: Selection, chance: FloatArray) -> FloatArray:
    """Chi2 of each column up to which it shows nothing more; `chance` is its standard deviation at the floor."""
    return rules.floor_column + rules.floor_chance * chance


def at_floor(rules: Selection, now: Fitted) -> bool:
    """Whether neither the whole nor any single column has anything left to explain."""
    return now.holdout <= rules.floor_all + rules.floor_chance * now.overall_chance and bool(
        np.all(now.columns <= column_limit(rules, now.chance))
    )


def all_explained(rules: Selection, first: Fitted, now: Fitted) -> bool:
    """Whether every column is at the floor, or has lost all but a trace of what it had above it at first."""
    if len(first.columns) != len(now.columns):
        return False
    trace = np.minimum(1 + rules.enough * (first.columns - 1), rules.explained_most)
    limit = np.maximum(column_limit(rules, now.chance), trace)
    return bool(np.all(now.columns <= limit))


def something_left(rules: Selection, first: Fitted, now: Fitted) -> bool:
    """Whether some column keeps more of its excess, on all data, than the shape of an effect explains."""
    if len(first.columns) != len(now.columns):
        return False
    above = now.columns > column_limit(rules, now.chance)
    return bool(np.any(above & (now.columns - 1 > rules.rest * (first.columns - 1))))


# --- whether an effect is added, or stays -----------------------------------------------------------------------


def has_minimum_gain(
    rules: Selection, first: Fitted, before: Fitted, after: Fitted, *, transient: bool = False, learnt: bool = False
) -> bool:
    """Whether an effect removes more than a trace of what some column had above its floor at first.

    Or, where that was beyond all measure (what swings for ever without friction), all of what is left above the floor
    of some column: what only mends the shape of another effect leaves more. `transient` says that it happens at some
    moment, `learnt` that its form is learnt, which may fit anything; both beside others that are named.
    """
    if len(first.columns) != len(before.columns):
        return True
    least = max(rules.minimum_gain, rules.minimum_gain_transient * transient, (1 - rules.explained) * learnt)
    gain, excess = before.columns - after.columns, np.maximum(first.columns - 1, rules.least_excess)
    if np.nanmax(gain / excess) >= least:
        return True
    above = before.columns > column_limit(rules, before.chance)
    return not (transient or learnt) and bool(np.any(above & (gain >= rules.explained * (before.columns - 1))))


def could_gain(rules: Selection, first: Fitted, now: Fitted, *, transient: bool = False, learnt: bool = False) -> bool:
    """Whether an effect would remove more than that trace if it left nothing of any column."""
    nothing = replace(now, columns=np.zeros_like(now.columns))
    return has_minimum_gain(rules, first, now, nothing, transient=transient, learnt=learnt)


def improves(rules: Selection, before: Fitted, after: Fitted) -> bool:
    """Whether the improvement on held-out data is large and not by chance, and one of fitted data too."""
    drop = (before.holdout - after.holdout) / before.holdout
    local = float(np.max((before.holdout_columns - after.holdout_columns) / before.holdout_columns))
    certain = paired_t(after, before) > rules.t or max(drop, local) > rules.certain
    # a joint with something of its own must not outweigh all others
    fitted = after.train < before.train or after.misfit_fitted < before.misfit_fitted - rules.simpler
    return (drop > rules.gain or local > rules.column_gain) and certain and fitted


def improves_once(rules: Selection, before: Fitted, after: Fitted) -> bool:
    """Whether what happens once, and so cannot be held out, removes enough where it happened."""
    local = float(np.max((before.train_columns - after.train_columns) / before.train_columns))
    harmless = after.holdout < (1 + rules.transient_harm) * before.holdout
    return bool(np.isfinite(after.holdout)) and local > rules.certain and harmless


def explains_fitted(rules: Selection, before: Fitted, after: Fitted) -> bool:
    """Whether all of a column's excess is gone, where held-out data show neither the excess nor any harm."""
    excess, left = before.train_columns - 1, after.train_columns - 1
    whole = (excess > rules.whole_excess) & (left < rules.whole_left * excess)
    return bool(np.any(whole)) and after.holdout < (1 + rules.whole_harm) * before.holdout


def relieves(rules: Selection, without: Fitted, now: Fitted) -> bool:
    """Whether an effect spares a model implausible numbers, and is none of these itself.

    A load on a body whose mass is free is that mass.
    """
    if not is_implausible(without.prior_residual):
        return False
    stated = {place for t in without.model.terms if _is_stated(t) for place in t.places}
    known = {(t.called, t.places) for t in without.model.terms}
    added = {place for t in now.model.terms if (t.called, t.places) not in known for place in t.places}
    before, after = (float(m.train_cells.sum() + m.prior_residual @ m.prior_residual) for m in (without, now))
    harmless = now.holdout < (1 + rules.whole_harm) * without.holdout
    return harmless and before - after >= rules.candidate_gain and not stated & added


def _is_stated(term: Term) -> bool:
    """Whether a model states something of all that robots have of a term's parameters."""
    return all(np.isfinite(p.spread) for p in term.parameters)


def is_needed(rules: Selection, without: Fitted, now: Fitted, *, transient: bool = False) -> bool:
    """Whether data are predicted worse without an effect, by any of the ways in which one is added.

    `transient` says that it happens at some moment, of which held-out data may hold nothing.
    """
    return (
        improves(rules, without, now)
        or explains_fitted(rules, without, now)
        or relieves(rules, without, now)
        or (transient and improves_once(rules, without, now))
    )


# --- locations and amounts ----------------------------------------------------------------------------------------


def is_small(rules: Selection, size: FloatArray) -> BoolArray:
    """Which locations of a group have a small amount beside the largest, by the size of each, (n,)."""
    return np.asarray(size <= rules.doubtful * size.max())


def doubtful_location(rules: Selection, size: FloatArray) -> int | None:
    """The location with the least amount, of those of a group (n,), if it is small beside the largest."""
    least = int(np.argmin(size))
    return least if is_small(rules, size)[least] else None


def agree(amounts: FloatArray, spread: float) -> bool:
    """Whether amounts (n,) differ from their median by no more than a fraction of it."""
    middle = float(np.median(amounts))
    return bool(np.all(np.abs(amounts - middle) <= spread * abs(middle)))


def distance_from_nothing(found: Estimate, neutral: float) -> float:
    """Standard deviations from the value that does nothing; 0 if not identifiable, infinite if outside its interval."""
    if found.identifiable == "no":
        return 0.0
    if not found.ci95[0] <= neutral <= found.ci95[1]:
        return np.inf
    return abs(found.value - neutral) / max(found.std, 1e-300)


def has_size(found: Sequence[Estimate], neutral: FloatArray) -> bool:
    """Whether some number of an effect is identifiable, with an interval that leaves out the (n,) `neutral` value."""
    pairs = zip(found, neutral, strict=True)
    return any(own.identifiable != "no" and not own.ci95[0] <= nothing <= own.ci95[1] for own, nothing in pairs)


# --- verdict --------------------------------------------------------------------------------------------------


def verdict_limit(rules: Selection, overall_chance: float) -> float:
    """Chi2 up to which a log shows nothing more."""
    return rules.floor_verdict + rules.floor_chance * overall_chance


def is_explained(rules: Selection, first: float, last: float, limit: float, *, floating: bool) -> bool:
    """Whether a chi2 is at its limit, or near it and nearly all of its first excess is gone."""
    share = rules.explained_floating if floating else rules.explained
    return last <= limit or (last <= rules.explained_most and last - limit <= (1 - share) * (first - 1))


def is_log_explained(rules: Selection, first: Fitted, now: Fitted, *, floating: bool) -> bool:
    """Whether nearly all is gone, held out and fitted: what happens in one part alone must be explained there."""
    limit = verdict_limit(rules, first.overall_chance)
    parts = ((first.holdout, now.holdout), (first.train, now.train))
    return all(is_explained(rules, before, after, limit, floating=floating) for before, after in parts)


def shows_late(rules: Selection, now: Fitted) -> bool:
    """Whether most of the held-out excess is in columns that are explained where they are fitted."""
    if len(now.train_columns) != len(now.holdout_columns):
        return False
    limit = column_limit(rules, now.chance)
    late = (now.train_columns <= limit) & (now.holdout_columns > limit)
    above = np.maximum(now.holdout_columns - 1, 0.0)
    return bool(late.any() and above[late].sum() >= rules.late * above.sum())
