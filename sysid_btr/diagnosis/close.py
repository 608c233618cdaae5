"""Closing the loop: find the residual, trace it to an effect the model lacks, add it, report before and after.

Fit what is declared; scan every effect at every place; refit the leading hypotheses; let held-out data
decide; add the winner; repeat; prune. An effect is named only if held-out data say so, and only if in the
end nearly all of the excess error is explained.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from time import perf_counter
from typing import TYPE_CHECKING

import numpy as np

from sysid_btr._typing import FloatArray
from sysid_btr.diagnosis.closing import Candidate, Closing, NamedEffect, StepRecord, Verdict
from sysid_btr.diagnosis.hypotheses import Hypothesis, form_hypotheses, from_arrays, to_arrays
from sysid_btr.diagnosis.messages import message_of, sentence_of
from sysid_btr.diagnosis.scan import Question, Trace, questions, scan
from sysid_btr.diagnosis.signature import proposals, signature
from sysid_btr.diagnosis.split import later_split
from sysid_btr.estimators.base import Progress, silent
from sysid_btr.estimators.journal import Journal, Record
from sysid_btr.estimators.lsq import linearise
from sysid_btr.identify.fit import fit
from sysid_btr.identify.fixing import fix_unidentifiable
from sysid_btr.identify.fusion import weigh_walks
from sysid_btr.identify.intervals import Estimate, estimates
from sysid_btr.identify.refit import (
    Fitted,
    best_start,
    inflate,
    inflated,
    judge,
    paired_t,
    refit,
    robust_refit,
    shorten,
)
from sysid_btr.identify.scores import score
from sysid_btr.identify.step_check import SHIFT_TOLERATED, numerics_shift
from sysid_btr.identify.study import Study
from sysid_btr.models.robot import body_names, joint_names, servo_joints
from sysid_btr.terms.base import Term
from sysid_btr.terms.effect import Effect
from sysid_btr.terms.library import select_effects
from sysid_btr.terms.model import Model

if TYPE_CHECKING:
    from numpy.random import Generator

    from sysid_btr.io.log import Log

SCAN_SECONDS = 15.0
"""Part of each log that is scanned; the leading hypotheses are refitted on more."""
GLANCE_SECONDS, GLANCED = 2.5, 150
"""Part of each walk on which all questions are asked, and how many of them then on the part that is scanned: on a free
base every question is a simulation of its own."""
REFIT_SECONDS = 20.0
LADDER_SECONDS = 6.0
"""Part of each log on which it is decided where a refit begins, if there are more than ..."""
FEW_STARTS = 12
MAX_ROUNDS = 10
MAX_REFINEMENTS = 1
"""Times the step may be halved in the end."""
REFITS = 7
"""Hypotheses refitted in each round."""
SIMPLER = 0.06
"""A simpler hypothesis wins if its misfit is within this of the best one's: 6 % of chi2 in one column."""
NEAR = 0.15
"""A rival whose misfit is within this of the winner's is confused with it, unless a paired test decides."""
OUTDONE = 1.0
"""Another law of an effect is not tried if the first one's misfit is so much beyond the best: e times chi2 in one
column."""
SETTLED = 0.8
"""Once a hypothesis explains all there is, others are tried only if they promise this fraction of its gain."""
MOST_THINNED, SMALL = 10, 0.5
"""Groups up to this size are thinned; an amount below this fraction of the largest is doubted."""
IDLE = 1e-3
"""Amount, relative to the largest, of a place where there is nothing."""
HOPELESS = 0.5
"""After three trials, hypotheses that promise less than this fraction of the best are not tried."""
ENOUGH = 0.006
"""Fraction of a column's excess that may be left: effects have shapes, not only amounts."""
REST = 0.1
"""Fraction of a column's excess that, left behind by effects that explain the rest, is told."""
TRACE = 0.002
"""Fraction of a column's first excess that is not worth an effect."""
PUSH = 0.05
"""The same for what happens at some moment, once other effects are named."""
FINEST = 5e-4
"""s, shortest step that is tried where a hypothesis diverges."""
STEP_GAIN = 0.03
"""An effect must remove this fraction of the held-out chi2, and of the excess at its joints."""
STEP_T = 3.0
"""... with this paired t over half-second stretches of held-out data."""
STEP_CERTAIN = 0.3
"""Fraction of the held-out chi2 of a column whose loss needs no test."""
WHOLE_EXCESS, WHOLE_LEFT, WHOLE_HARM = 2.0, 0.03, 0.01
"""Excess of a column's chi2 on fitted data of which an effect must leave less than this fraction, without harm to
held-out data, to be added although these do not show it."""
EXPLAINED, EXPLAINED_WALKING = 0.975, 0.85
"""Fraction of the excess, held out and fitted, that must be gone for effects to be named. On 148 logs of another engine
the right ones left up to 1.3 % (2.3 % where one of two was missed), and what imitated another effect 2.9 % or more. Of
walks the ground leaves more."""
AT_FLOOR = 1.10
"""Held-out chi2 up to which a log shows nothing more: noise floors are known to a few percent."""
FLOOR_ALL, FLOOR_COLUMN = 1.03, 1.12
"""Chi2 of all columns and of the worst one at which there is nothing to look for."""
CHANCE = 3.0
"""Standard deviations of chance that these allow on top: short logs know their floor less well."""
EVEN_SPREAD = 0.05
"""Relative spread of amounts that are one amount, whatever their standard errors."""


@dataclass(frozen=True, eq=False)
class _State:
    """The model so far: its first terms are `declared`, and each effect may be confused with its `rivals`."""

    fitted: Fitted
    declared: int
    rivals: tuple[tuple[str, ...], ...] = ()

    @property
    def effects(self) -> tuple[Effect, ...]:
        """The terms that were added."""
        return tuple(term for term in self.fitted.model.terms[self.declared :] if isinstance(term, Effect))


def close(
    study: Study,
    parameters: Sequence[str] | Sequence[Term],
    *,
    effects: Sequence[str] = ("all",),
    rng: Generator | None = None,
    journal: Journal | None = None,
    progress: Progress = silent,
    start: FloatArray | None = None,
    worth: float = TRACE,
    alike: bool = False,
    rounds: int = MAX_ROUNDS,
) -> Closing:
    """Name the effects that a model lacks.

    Parameters
    ----------
    study : robot and logs.
    parameters : what is declared free, as for `fit`.
    effects : names of the effects to consider, or ``all``.
    rng : for estimators that draw; not used by the default ones.
    journal, progress : see `sysid_btr.estimators`.
    start : (p,) where the declared parameters begin; default the nominal values.
    worth : fraction of some column's first excess over the floor that an effect must remove. The shapes of effects
        that are found are a little wrong, and much else would mend that; a smaller fraction builds a longer ladder
        for prediction, whose last rungs mean less.
    alike : ask only for effects of the whole robot, and for those that are the same at all their places: few short
        logs tell no more, and it takes a small part of the simulations.
    rounds : how many effects are added at most.

    Returns
    -------
    Closing
        Verdict, effects with intervals, candidates, steps.
    """
    began = perf_counter()
    library = usable_effects(select_effects(effects), study)
    first = fit(study, parameters, rng=rng, journal=journal, progress=progress, start=start)
    study = replace(first.study, journal=None if journal is None else journal.section())
    declared = first.model.terms
    # hypotheses are compared where each fits best
    study, before = inflated(study, judge(study, first.model.at(first.optimum), first.replays))
    state = _State(before, len(declared))
    steps = [StepRecord((), (), before.train, before.holdout)]
    replays = first.replays
    candidates: list[Candidate] = []
    note = "scan"
    for round_number in range(1, rounds + 1):
        if _at_floor(state.fitted) or _good_enough(before, state.fitted):
            break
        progress(done=round_number, total=None, best=state.fitted.holdout, note=f"round {round_number}: {note}")
        hypotheses, answers = _promising(study, state, library, alike)
        replays += answers
        trials: list[tuple[Hypothesis, Fitted]] = []
        for hypothesis in hypotheses:
            if any(_settled(hypothesis, h, f) for h, f in trials) or _outdone(hypothesis, trials):
                continue
            if len(trials) >= 3 and hypothesis.gain < HOPELESS * hypotheses[0].gain:
                break
            trials.append((hypothesis, _try(study, state.fitted.model, hypothesis)))
            progress(
                done=round_number,
                total=None,
                best=state.fitted.holdout,
                note=f"round {round_number}: with {hypothesis} held-out chi2 {trials[-1][1].holdout:.4g}",
            )
            replays += trials[-1][1].evaluations
        if not candidates or state.effects:
            candidates += _candidates(state.fitted, trials)
        worthy = [
            (h, f)
            for h, f in trials
            # what others leave unexplained at some moment looks like a push
            if _worth(before, state.fitted, f, max(worth, PUSH) if h.effect.passing and state.effects else worth)
        ]
        winner = _choose(state.fitted, worthy)
        if winner is None:
            break
        hypothesis, fitted = winner
        if fitted.numerics != study.numerics:
            study = replace(study, numerics=fitted.numerics)
        hypothesis, fitted, spent = _thin(study, hypothesis, fitted)
        replays += spent
        rivals = tuple(
            dict.fromkeys(h.effect.name for h, f in trials if _rivals(state.fitted, winner, (h, f)))
        )
        # a more general effect takes the place of the special case it includes
        staying = tuple(
            e
            for e in state.effects
            if (e.label or e.name) not in hypothesis.effect.includes or not set(e.places) <= set(hypothesis.places)
        )
        staying_rivals = tuple(r for e, r in zip(state.effects, state.rivals, strict=True) if e in staying)
        if len(staying) < len(state.effects):
            gone = [e for e in state.effects if e not in staying]
            rest = fitted.model.without(*gone, fitted.model.terms[-1])
            fitted = refit(study, rest.with_(hypothesis.term(study.scales), hypothesis.start))
        if study.free:
            study = study.settled(fitted.model)
        study, fitted = robust_refit(study, fitted, 1)
        replays += fitted.evaluations
        state = _State(fitted, state.declared, (*staying_rivals, rivals))
        steps.append(StepRecord((str(hypothesis),), (), fitted.train, fitted.holdout))
    state, removed, spent = _prune(study, state)
    replays += spent
    if removed:
        steps.append(StepRecord((), removed, state.fitted.train, state.fitted.holdout))
    if state.effects:
        state = _merge(study, state)
        study = inflate(study, state.fitted, memory=True)
        progress(done=MAX_ROUNDS, total=None, best=state.fitted.holdout, note="final fit")
        polished = refit(study, state.fitted.model, polish=True, progress=progress)
        replays += polished.evaluations
        state = replace(state, fitted=polished)
    final_estimates: tuple[Estimate, ...] = first.estimates
    last = state.fitted
    if not state.effects and study.free:
        last = judge(study, first.model)
    if state.effects:
        progress(done=MAX_ROUNDS, total=None, best=state.fitted.holdout, note="intervals")
        final_estimates, study, state, last = _estimates(study, state)
        real = _told_apart_from_nothing(study, state, final_estimates)
        if real is not None:
            steps.append(StepRecord((), _named_only_in(state, real), real.fitted.train, real.fitted.holdout))
            final_estimates, study, state, last = _estimates(study, real)
    count = len(declared.parameters)
    verdict = _verdict(study, before, state)
    later = later_split(study, state.fitted, _column_limit(state.fitted)) if verdict == "unexplained" else None
    if later is not None:
        # what is missing shows only after the fitted part: fit more of the log, hold out what is left
        again = replace(later, numerics=first.study.numerics, inflation={})
        return close(
            again,
            parameters,
            effects=effects,
            rng=rng,
            journal=study.journal and study.journal.section(),
            progress=progress,
            start=start,
            worth=worth,
            alike=alike,
            rounds=rounds,
        )
    named = _named(study, state, final_estimates, candidates) if state.effects else ()
    kept = named if verdict in ("explained", "ambiguous") else ()
    left = None
    if verdict == "unexplained" or (kept and _something_left(before, state.fitted)):
        left = signature(study, state.fitted.model)
    state = replace(state, fitted=last)
    after = score(study, state.fitted.model)
    unit = "m" if all(s.slide for s in study.scales.values()) else "rad"
    return Closing(
        study=study,
        verdict=verdict,
        message=message_of(verdict, named, first.before, after, left, unit),
        noise_floor={c: s.floor for c, s in first.before.holdout.items()},
        nominal=first.nominal,
        before=first.before,
        after=after,
        parameters=final_estimates[:count],
        effects=kept,
        candidates=tuple(sorted(candidates, key=lambda c: -c.explained)),
        steps=tuple(steps),
        signature=left,
        before_model=first.model,
        model=state.fitted.model,
        replays=replays,
        seconds=perf_counter() - began,
    )


def usable_effects(effects: Sequence[type[Effect]], study: Study) -> tuple[type[Effect], ...]:
    """Effects that these logs could show at all, given mount and channels."""
    free = any(log.meta.mount == "free" for log in study.train)
    result = []
    for effect in effects:
        if effect.name.startswith("foot_") and not free:
            continue
        if effect.needs == "enabled" and not any(_switched(log) for log in study.train):
            continue
        result.append(effect)
    return tuple(result)


def _switched(log: Log) -> bool:
    """Whether a drive is off for a part of the log."""
    return any(bool(np.any(v == 0)) for name, v in log.channels.items() if name.startswith("enabled."))


def _promising(
    study: Study, state: _State, library: Sequence[type[Effect]], alike: bool
) -> tuple[list[Hypothesis], int]:
    """The leading hypotheses of a scan, and how many questions were answered; an interrupted run noted them."""
    values = state.fitted.model.values[None]
    places = (*joint_names(study.robot), *body_names(study.robot), "robot")
    known = None if study.journal is None else study.journal.replay("scan", values, whole=True)
    if known is not None:
        return from_arrays(known.arrays, library, places), int(known.arrays["answers"])
    began = perf_counter()
    traces, residual = _scan(study, state, library, alike)
    hypotheses = form_hypotheses(traces, len(residual), REFITS)
    if study.journal is not None:
        arrays = {**to_arrays(hypotheses, library, places), "answers": np.array(len(traces)), "loss": np.zeros(1)}
        seconds = study.journal.seconds + perf_counter() - began
        study.journal.append(Record("scan", values, arrays, seconds))
    return hypotheses, len(traces)


def _scan(
    study: Study, state: _State, library: Sequence[type[Effect]], alike: bool
) -> tuple[list[Trace], FloatArray]:
    model = state.fitted.model
    values = model.values
    problem = shorten(study, SCAN_SECONDS).train_problem(model)
    residual, jacobian = linearise(problem, values, step=study.stencil(model.terms))
    places = {
        "joint": joint_names(study.robot),
        "servo": servo_joints(study.robot),
        "body": body_names(study.robot),
        "robot": ("robot",),
    }
    asked: list[Question] = questions(library, places, study.scales)
    if alike:
        asked = [q for q in asked if len(q.places) > 1 or q.effect.scope == "robot"]
    else:
        asked += proposals(study, problem, values, residual, library)
    # an effect already at a place is not asked for again; it is refitted with everything else
    present = {(type(e), p) for e in state.effects for p in e.places}
    split = {p for e in state.effects if e.structural for p in e.places}
    asked = [
        q
        for q in asked
        if not any((q.effect, p) in present or (q.effect.structural and p in split) for p in q.places)
    ]
    if study.free and len(asked) > GLANCED:
        glance = shorten(study, GLANCE_SECONDS).train_problem(model)
        linear = linearise(glance, values, step=study.stencil(model.terms))
        seen = scan(glance, values, *linear, asked, study.scales)
        asked = [t.question for t in seen[:GLANCED]]
    # what is left is the right integrator's; what an effect would change may be a little off
    traces = scan(problem.with_numerics(study.cheap), values, residual, jacobian, asked, study.scales)
    if alike:
        # one hypothesis an effect, begun at its best working point: a refit's ladder holds other amounts
        best: dict[type[Effect], Trace] = {}
        for trace in traces:
            best.setdefault(trace.question.effect, trace)
        traces = list(best.values())
    return traces, residual


def _try(study: Study, rest: Model, hypothesis: Hypothesis) -> Fitted:
    """The model with a hypothesis added, refitted."""
    ladder = hypothesis.ladder()
    terms = rest.with_(hypothesis.term(study.scales), ladder[0]).terms
    starts = np.column_stack([np.tile(rest.values, (len(ladder), 1)), ladder])
    seconds = REFIT_SECONDS if len(starts) <= FEW_STARTS else LADDER_SECONDS
    spent = 0
    while True:
        start = best_start(shorten(study, seconds), terms, starts)
        found = refit(shorten(study, REFIT_SECONDS), Model(terms, start), judged=study)
        spent += found.evaluations + len(starts)
        finer = study.numerics.halved()
        given_up = study.free or finer.integrator == "Euler" or finer.timestep < FINEST
        if np.isfinite(found.holdout) or given_up:
            return replace(found, evaluations=spent)
        # a stiff spring on a light body can be too fast for the step
        study = replace(study, numerics=finer)


def _at_floor(fitted: Fitted) -> bool:
    """Whether neither the whole nor any single column has anything left to explain."""
    return fitted.holdout <= FLOOR_ALL + CHANCE * fitted.overall_chance and bool(
        np.all(fitted.columns <= _column_limit(fitted))
    )


def _column_limit(fitted: Fitted) -> FloatArray:
    """Chi2 of each column up to which it shows nothing more."""
    return FLOOR_COLUMN + CHANCE * fitted.chance


def _good_enough(before: Fitted, now: Fitted) -> bool:
    """Whether every column is at the floor, or has lost all but a trace of what it had above it."""
    if len(before.columns) != len(now.columns):
        return False
    limit = np.maximum(_column_limit(now), 1 + ENOUGH * (before.columns - 1))
    return bool(np.all(now.columns <= limit))


def _something_left(before: Fitted, now: Fitted) -> bool:
    """Whether some column keeps more of its excess, on all data, than the shape of an effect explains."""
    if len(before.columns) != len(now.columns):
        return False
    return bool(np.any((now.columns > _column_limit(now)) & (now.columns - 1 > REST * (before.columns - 1))))


def _thin(study: Study, hypothesis: Hypothesis, fitted: Fitted) -> tuple[Hypothesis, Fitted, int]:
    """Drop places of a group, the model's last term, whose small amounts held-out data do not miss."""
    spent = 0
    kinds = len(hypothesis.effect.kinds)
    main = hypothesis.effect.main
    neutral = hypothesis.term(study.scales).neutral[main]
    once = hypothesis.effect.passing
    waiting = True
    while waiting and not hypothesis.shared and 1 < len(hypothesis.places) <= MOST_THINNED:
        waiting = False
        group = fitted.model.terms[-1]
        amounts = fitted.model.own(group).reshape(-1, kinds)
        size = np.abs(amounts[:, main] - neutral)
        least = int(np.argmin(size))
        if size[least] > SMALL * size.max():
            break
        rest = np.delete(np.arange(len(size)), least)
        smaller = replace(
            hypothesis,
            places=tuple(hypothesis.places[i] for i in rest),
            start=amounts[rest].ravel(),
        )
        trial = _try(study, fitted.model.without(group), smaller)
        spent += trial.evaluations
        loss = trial.misfit_everywhere - fitted.misfit_everywhere if once else trial.misfit - fitted.misfit
        if size[least] <= IDLE * size.max() or loss <= SIMPLER:
            hypothesis, fitted, waiting = smaller, trial, True
    return hypothesis, fitted, spent


def _settled(hypothesis: Hypothesis, other: Hypothesis, fitted: Fitted) -> bool:
    """Whether another one explains all there is and this one, which is no simpler, promises much less."""
    enough = SETTLED if hypothesis.complexity >= other.complexity else HOPELESS
    return _at_floor(fitted) and hypothesis.gain < enough * other.gain


def _outdone(hypothesis: Hypothesis, trials: Sequence[tuple[Hypothesis, Fitted]]) -> bool:
    """Whether another law of the same effect at the same places did far worse than the best hypothesis."""
    best = min((f.misfit for _, f in trials), default=np.inf)
    return any(
        f.misfit > best + OUTDONE
        for h, f in trials
        if h.effect is not hypothesis.effect
        and h.effect.name == hypothesis.effect.name
        and set(h.places) == set(hypothesis.places)
    )


def _gain(before: Fitted, after: Fitted) -> float:
    """Fraction of the held-out excess over the floor that is gone."""
    excess = max(before.holdout - 1.0, 1e-9)
    return (before.holdout - after.holdout) / excess


def _choose(
    before: Fitted, trials: Sequence[tuple[Hypothesis, Fitted]]
) -> tuple[Hypothesis, Fitted] | None:
    """The simplest of the best hypotheses, if held-out data want one at all."""
    sound = [(h, f) for h, f in trials if np.isfinite(f.holdout) and _accepted(before, f)]
    passing = [(h, f) for h, f in trials if h.effect.passing and _accepted_once(before, f)]
    if passing:
        event = min(passing, key=lambda t: t[1].misfit_everywhere)
        lasting = [f.misfit_everywhere for h, f in sound if not h.effect.passing]
        if event[1].misfit_everywhere < min(lasting, default=np.inf) - SIMPLER:
            return event
    if not sound:
        return _choose_once(before, trials)
    best = min(f.misfit for _, f in sound)
    near = [(h, f) for h, f in sound if f.misfit <= best + SIMPLER]
    named = {h.effect.name for h, _ in near}
    near = [(h, f) for h, f in near if not named & set(h.effect.yields_to)]
    simplest = min(near, key=lambda t: (t[0].complexity, t[1].misfit))
    # what is no refinement of the simplest one may still beat it beyond chance
    others = [(h, f) for h, f in near if _another(h, simplest[0]) and f.misfit < simplest[1].misfit]
    beyond = [(h, f) for h, f in others if paired_t(f, simplest[1]) > STEP_T]
    return min(beyond or [simplest], key=lambda t: (t[0].complexity, t[1].misfit))


def _choose_once(
    before: Fitted, trials: Sequence[tuple[Hypothesis, Fitted]]
) -> tuple[Hypothesis, Fitted] | None:
    """The simplest hypothesis that leaves nothing of what a column shows in its fitted part alone."""
    whole = [(h, f) for h, f in trials if _accepted_wholly(before, f)]
    if not whole:
        return None
    best = min(f.misfit_everywhere for _, f in whole)
    near = [(h, f) for h, f in whole if f.misfit_everywhere <= best + SIMPLER]
    return min(near, key=lambda t: (t[0].complexity, t[1].misfit_everywhere))


def _another(hypothesis: Hypothesis, simple: Hypothesis) -> bool:
    """Whether a hypothesis is of another kind than a simple one, and no generalisation of it."""
    return hypothesis.effect.name != simple.effect.name and simple.effect.name not in hypothesis.effect.includes


def _worth(first: Fitted, before: Fitted, after: Fitted, least: float) -> bool:
    """Whether an effect removes more than a trace of what some column had above its floor at first.

    Where effects of a real robot have been found, their shapes are a little wrong, and much else would help.
    """
    if len(first.columns) != len(before.columns):
        return True
    excess = np.maximum(first.columns - 1, TRACE)
    return bool(np.nanmax((before.columns - after.columns) / excess) >= least)


def _accepted(before: Fitted, after: Fitted) -> bool:
    """Whether the improvement on held-out data is large and not by chance."""
    drop = (before.holdout - after.holdout) / before.holdout
    local = float(np.max((before.holdout_columns - after.holdout_columns) / before.holdout_columns))
    t = paired_t(after, before)
    # an effect that acts in few stretches (a limit, a push) has a small t however large it is there
    certain = t > STEP_T or max(drop, local) > STEP_CERTAIN
    # a joint with something of its own must not outweigh all others
    fitted = after.train < before.train or after.misfit_fitted < before.misfit_fitted - SIMPLER
    return (drop > STEP_GAIN or local > 5 * STEP_GAIN) and certain and fitted


def _accepted_once(before: Fitted, after: Fitted) -> bool:
    """Whether what happens once, and so cannot be held out, removes enough where it happened."""
    local = float(np.max((before.train_columns - after.train_columns) / before.train_columns))
    return bool(np.isfinite(after.holdout)) and local > STEP_CERTAIN and after.holdout < 1.05 * before.holdout


def _accepted_wholly(before: Fitted, after: Fitted) -> bool:
    """Whether all of a column's excess is gone, where held-out data show neither the excess nor any harm."""
    excess, left = before.train_columns - 1, after.train_columns - 1
    whole = (excess > WHOLE_EXCESS) & (left < WHOLE_LEFT * excess)
    return bool(np.any(whole)) and after.holdout < (1 + WHOLE_HARM) * before.holdout


def _rivals(
    before: Fitted, winner: tuple[Hypothesis, Fitted], other: tuple[Hypothesis, Fitted]
) -> bool:
    """Whether another effect does nearly as well at the same joints, and held-out data cannot decide."""
    hypothesis, fitted = winner
    rival, alternative = other
    if rival.effect.name == hypothesis.effect.name:
        return False
    if hypothesis.effect.name in (*rival.effect.includes, *rival.effect.yields_to):
        return False
    if alternative.misfit > fitted.misfit + NEAR:
        return False
    return paired_t(fitted, alternative) < STEP_T


def _candidates(
    before: Fitted, trials: Sequence[tuple[Hypothesis, Fitted]]
) -> list[Candidate]:
    ordered = sorted(trials, key=lambda t: t[1].misfit)
    result = []
    for h, f in ordered:
        gain = _gain(before, f)
        same = tuple(
            dict.fromkeys(
                o.effect.name
                for o, g in ordered
                if o.effect.name != h.effect.name and gain > 0 and abs(g.misfit - f.misfit) < NEAR
            )
        )
        amplitude = float(f.model.own(f.model.terms[-1])[h.effect.main])
        result.append(Candidate(h.effect.name, h.places, gain, amplitude, same))
    return result


def _prune(study: Study, state: _State) -> tuple[_State, tuple[str, ...], int]:
    """Backward pass: drop effects without which held-out data are predicted as well."""
    removed: list[str] = []
    spent = 0
    for effect in state.effects[:-1] if len(state.effects) > 1 else ():
        at = state.effects.index(effect)
        trial = refit(shorten(study, REFIT_SECONDS), state.fitted.model.without(effect), judged=study)
        spent += trial.evaluations
        if not (_accepted(trial, state.fitted) or _accepted_wholly(trial, state.fitted)):
            removed.append(f"{effect.name} at {', '.join(effect.places)}")
            state = _State(trial, state.declared, state.rivals[:at] + state.rivals[at + 1 :])
    for effect in state.effects if len(state.effects) > 1 else ():
        thinner, dropped, cost = _thin_again(study, state, effect)
        spent += cost
        if dropped:
            state = thinner
            removed.append(f"{effect.name} at {', '.join(dropped)}")
    return state, tuple(removed), spent


def _thin_again(study: Study, state: _State, effect: Effect) -> tuple[_State, tuple[str, ...], int]:
    """Drop places of an effect that were in demand only until a later effect was found."""
    if effect.shared:
        return state, (), 0
    at = state.effects.index(effect)
    amounts = state.fitted.model.own(effect)
    whole = Hypothesis(type(effect), effect.places, False, amounts, 0.0)
    now = replace(state.fitted, model=state.fitted.model.without(effect).with_(effect, amounts))
    left, fitted, spent = _thin(study, whole, now)
    rivals = (*state.rivals[:at], *state.rivals[at + 1 :], state.rivals[at])
    dropped = tuple(p for p in effect.places if p not in left.places)
    return _State(fitted, state.declared, rivals), dropped, spent


def _merge(study: Study, state: _State) -> _State:
    """Effects of one kind found in several rounds become one; amounts that agree become one amount."""
    pieces: dict[type[Effect], list[tuple[str, FloatArray]]] = {}
    confused: dict[type[Effect], tuple[str, ...]] = {}
    for effect, rivals in zip(state.effects, state.rivals, strict=True):
        amounts = effect.spread(state.fitted.model.own(effect)[None])[0]
        pieces.setdefault(type(effect), []).extend(zip(effect.places, amounts, strict=True))
        confused[type(effect)] = tuple(dict.fromkeys((*confused.get(type(effect), ()), *rivals)))
    model = state.fitted.model.without(*state.effects)
    for kind, found in pieces.items():
        places = tuple(p for p, _ in found)
        amounts = np.array([a for _, a in found])
        main = amounts[:, kind.main]
        middle = float(np.median(main))
        even = len(found) > 2 and bool(np.all(np.abs(main - middle) <= EVEN_SPREAD * abs(middle)))
        values = np.median(amounts, axis=0) if even else amounts.ravel()
        model = model.with_(kind.at(places, study.scales, shared=even).around(values), values)
    fitted = replace(state.fitted, model=model)
    # what is in the model beside an effect is not its rival
    present = {kind.name for kind in pieces}
    kept = tuple(tuple(name for name in names if name not in present) for names in confused.values())
    return _State(fitted, state.declared, kept)


def _estimates(study: Study, state: _State) -> tuple[tuple[Estimate, ...], Study, _State, Fitted]:
    """Intervals in the final model, the study and state they are of, and the model as it is reported.

    The step is halved while it moves an estimate by more than its error. The state stays where the residuals are least,
    also where the motion of walks tells more than these do.
    """
    for refinement in range(MAX_REFINEMENTS + 1):
        model = state.fitted.model
        problem = study.train_problem(model)
        if refinement == 0:
            residual, jacobian = linearise(problem, model.values, step=study.stencil(model.terms))
            jacobian = np.nan_to_num(jacobian)
        else:  # what half the step changes in the derivatives is far less than what is known of them
            residual = problem.residuals(model.values[None])[0]
        shift, known = numerics_shift(problem, model.values, jacobian, residual), None
        if study.free:
            weighed = weigh_walks(study, problem, model.values, jacobian, residual)
            jacobian, residual = weighed.jacobian, weighed.residual
            shift, known = np.hypot(shift, weighed.error), weighed.known
            model = model.at(weighed.values)
        found = estimates(problem.parameters, model.values, jacobian, residual, problem.blocks, shift, known)
        bare = estimates(problem.parameters, model.values, jacobian, residual, problem.blocks)
        told = np.array([e.identifiable != "no" for e in bare])
        worst = np.max(np.abs(shift[told]) / np.maximum([e.std for e in bare], 1e-300)[told], initial=0.0)
        settled = worst <= SHIFT_TOLERATED or study.numerics.integrator == "Euler" or study.free
        if settled or refinement == MAX_REFINEMENTS:
            break
        study = replace(study, numerics=study.numerics.halved())
        state = replace(state, fitted=refit(study, model, iterations=4))
    values, found, _ = fix_unidentifiable(problem, model.values, found, jacobian, known)
    last = judge(study, model.at(values))
    return found, study, replace(state, fitted=last) if known is None else state, last


def _told_apart_from_nothing(study: Study, state: _State, found: Sequence[Estimate]) -> _State | None:
    """The model without effects, and places of effects, whose amounts may be nothing; None where there are none.

    Only what held-out data do not miss is dropped: of two effects that a log tells together but not apart, one stays.
    """
    doubtful: list[tuple[float, Effect, list[int]]] = []
    for effect in state.effects:
        own, main = found[state.fitted.model.terms.columns(effect)], slice(effect.main, None, len(effect.kinds))
        pairs = zip(own[main], effect.neutral[main], strict=True)
        sure = [
            0.0 if e.identifiable == "no" else abs(e.value - n) / max(e.std, 1e-300)
            if e.ci95[0] <= n <= e.ci95[1]
            else np.inf
            for e, n in pairs
        ]
        kept = [i for i, s in enumerate(sure) if np.isinf(s)]
        if len(kept) < len(sure):
            doubtful.append((min(sure), effect, kept))
    result: _State | None = None
    now = state
    for _, effect, kept in sorted(doubtful, key=lambda item: item[0]):
        if not kept and len(now.effects) == 1:
            break
        at = now.effects.index(effect)
        amounts = now.fitted.model.own(effect).reshape(-1, len(effect.kinds))[kept].ravel()
        left: tuple[Effect, ...] = ()
        if kept:
            places = [effect.places[i] for i in kept]
            left = (type(effect).at(places, study.scales).around(amounts),)
        model = now.fitted.model.replaced(effect, *((e, amounts) for e in left))
        fitted = refit(study, model, polish=True)
        if fitted.misfit <= state.fitted.misfit + NEAR:
            rivals = (*now.rivals[:at], *((now.rivals[at],) if left else ()), *now.rivals[at + 1 :])
            result = now = _State(fitted, now.declared, rivals)
    return result


def _named_only_in(before: _State, after: _State) -> tuple[str, ...]:
    staying = {(e.name, e.variant, p) for e in after.effects for p in e.places}
    gone = [(e, [p for p in e.places if (e.name, e.variant, p) not in staying]) for e in before.effects]
    return tuple(f"{e.name} at {', '.join(places)}" for e, places in gone if places)


def _verdict(study: Study, before: Fitted, state: _State) -> Verdict:
    at_floor = AT_FLOOR + CHANCE * before.overall_chance
    now, least = state.fitted, EXPLAINED_WALKING if study.free else EXPLAINED
    if not state.effects:
        return "nothing_missing" if max(now.holdout, now.train) <= at_floor else "unexplained"
    # what happens in the fitted part alone must be explained there
    for first, last in ((before.holdout, now.holdout), (before.train, now.train)):
        if last - at_floor > (1 - least) * (first - 1):
            return "unexplained"
    return "ambiguous" if any(state.rivals) else "explained"


def _named(
    study: Study, state: _State, found: Sequence[Estimate], candidates: Sequence[Candidate]
) -> tuple[NamedEffect, ...]:
    result, model = [], state.fitted.model
    for effect, confused in zip(state.effects, state.rivals, strict=True):
        columns = model.terms.columns(effect)
        own = tuple(found[columns])
        without = model.values.copy()
        without[columns] = effect.neutral
        off = judge(study, model.at(without))
        gain = (off.holdout - state.fitted.holdout) / max(off.holdout, 1e-12)
        confused = (*confused, *(n for n in _alike(effect, candidates) if n not in confused))
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


def _alike(effect: Effect, candidates: Sequence[Candidate]) -> tuple[str, ...]:
    """Effects that did as well at the same places but give way to this one, by convention."""
    own = next((c for c in candidates if c.effect == effect.name and set(c.where) == set(effect.places)), None)
    giving = {e.name for e in select_effects(("all",)) if effect.name in e.yields_to}
    return tuple(name for name in (own.confused_with if own else ()) if name in giving)
