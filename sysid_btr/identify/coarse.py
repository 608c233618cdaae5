"""First fits: how a digital servo is realised, and how far each column of the log can be explained."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sysid_btr._typing import FloatArray
from sysid_btr.estimators.base import Budget, Progress, silent
from sysid_btr.identify.bounds import fit_beyond
from sysid_btr.identify.numerics import Beginning, converged, held_numerics
from sysid_btr.identify.recorder import as_recorded
from sysid_btr.identify.refit import Fitted, best_start, inflate, judge, nearby, refit, robust_refit, shorten
from sysid_btr.identify.study import Study
from sysid_btr.identify.thresholds import with_reached_limits, without_unreached_limits
from sysid_btr.terms.model import Model

MISFIT = 1.5
"""Chi2 of a column beyond which its error, not its noise, sets its weight."""
ROBUST_ROUNDS = 4
SERVO_SECONDS = 4.0
"""Part of each log on which the realisation of a digital servo is chosen ..."""
SERVO_MARGIN = 0.05
"""... and mean decrease of log chi2 for which the one that takes longer is."""
STIFFER = (0.6, 0.35, 0.25)
"""Contact time constants tried first, as factors of the nominal."""
SHARES = (1.0, 0.5, 0.25, 0.125, 0.0)
"""Of the way to a refitted model, of which the first is gone that leaves no more."""
LEAVES_MORE = 1.01
"""Ratio of what a turn leaves to what the one before left, from which it is not taken."""


def weigh_columns(study: Study, model: Model, budget: Budget, progress: Progress = silent) -> tuple[Study, Fitted]:
    """The study with each column weighed by the error that a first fit from a model leaves in it, and that fit."""
    study, coarse = first_fit(study, model, budget, progress)
    recorded = as_recorded(study, coarse.model)
    if recorded is not study:
        spent = coarse.evaluations
        study, coarse = first_fit(recorded, coarse.model, budget.after(spent), progress)
        coarse = replace(coarse, evaluations=coarse.evaluations + spent)
    if float(coarse.train_columns.max()) > MISFIT:
        coarse = _explained_beyond(study, coarse, budget, progress)
    if float(coarse.train_columns.max()) > MISFIT:
        if not study.procedure.weighs_segments:
            study, coarse = robust_refit(study, coarse, ROBUST_ROUNDS, budget, progress)
        study = inflate(study, coarse, memory=True)
    if not study.procedure.alternations:
        # by errors of the size that the model leaves
        study = study.with_initial_states(coarse.model)
    return study, coarse


def _explained_beyond(study: Study, coarse: Fitted, budget: Budget, progress: Progress) -> Fitted:
    """A first fit, beyond bounds that nobody stated where it explains the log there: no error of the model then."""
    wider = fit_beyond(study, coarse, budget, progress)
    explained = float(wider.train_columns.max()) <= MISFIT
    return wider if explained else replace(coarse, evaluations=wider.evaluations)


def realise_servo(study: Study, model: Model) -> Study:
    """The study with the realisation of a digital servo that fits the log better.

    Held torque under a known velocity, or an Euler step a period, which is a velocity from differences.
    """
    if study.numerics.integrator != "Euler" or study.numerics.stated:
        return study
    robot, log, threads, euler = study.robot, study.train[0].log, study.threads, study.numerics
    held = held_numerics(robot, log, threads, euler.simulator)
    if held is None:
        return study
    short = shorten(study, SERVO_SECONDS)
    misfit, near = nearby(replace(short, numerics=euler), euler, model)
    other, _ = nearby(replace(short, numerics=held), euler, near)
    if not other < misfit - SERVO_MARGIN:
        return study
    part = Beginning.of(log)
    found, _ = converged(held, lambda n: part.positions(robot, n, threads), part.log)
    return replace(study, numerics=found)


def first_fit(study: Study, model: Model, budget: Budget, progress: Progress = silent) -> tuple[Study, Fitted]:
    """First fit: where initial states are uncertain, of them and the parameters in turn, by the coarse integrator."""
    procedure, reference = study.procedure, study.numerics
    model, spent = with_reached_limits(study, model)
    if not procedure.alternations:
        found = refit(study, model, budget=budget.after(spent), progress=progress)
        free, more = without_unreached_limits(study, found.model)
        spent += found.evaluations + more
        return study, judge(study, free, spent) if free is not found.model else replace(found, evaluations=spent)
    study = replace(study, numerics=study.coarse)
    model = model.at(best_start(study, model.terms, contact_starts(model)))
    for turn, iterations in enumerate(procedure.alternations, 1):
        if procedure.shares:
            study = study.with_share(procedure.shares[turn - 1], model)
        found = refit(study, model, iterations=iterations, budget=budget.after(spent), progress=progress)
        spent += found.evaluations
        study, model = _turned(study, model, found.model, last=turn == len(procedure.alternations))
    model, more = without_unreached_limits(study, model)
    study, spent = replace(study, numerics=reference), spent + more
    if all(episode.procedure.coarse_suffices for episode in study.train):
        return study, judge(study, model, spent)
    # what the cheap integrator does wrong is much beside the noise of a robot that hangs, and is no error of its model
    right = refit(study, model, budget=budget.after(spent), progress=progress)
    return study, replace(right, evaluations=right.evaluations + spent)


def _turned(study: Study, model: Model, found: Model, *, last: bool) -> tuple[Study, Model]:
    """The study with the states that a refitted model wants, and that model, or one between it and the one before.

    Each is the best beside what the other was, and both together may leave more than before: where a joint that rubs is
    believed to stick, other states are likely.
    """
    before = _left(study, model)
    for share in SHARES:
        there = model.at(model.values + share * (found.values - model.values))
        turned = study.with_initial_states(there, held_out=last, anew=last)
        if not np.isfinite(before) or _left(turned, there) <= LEAVES_MORE * before:
            break
    return turned, there


def _left(study: Study, model: Model) -> float:
    """Mean square of the fitted error over the noise floor."""
    problem = replace(study, inflation={}).train_problem(model)
    chi2 = problem.column_chi2(problem.residuals(model.values[None])[0])
    return float(np.average(chi2, weights=problem.counts))


def contact_starts(model: Model) -> FloatArray:
    """Starts (k, p) that differ in how stiff the ground is: between a soft and a hard one the loss is not convex."""
    own = [i for i, name in enumerate(model.terms.names) if name.startswith("foot_compliance")]
    starts = np.tile(model.values, (1 + len(STIFFER) * bool(own), 1))
    for row, factor in zip(starts[1:], STIFFER, strict=False):
        row[own] *= factor
    return starts
