"""Bounds that nobody stated grow while an estimate presses against them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sysid_btr._typing import FloatArray
from sysid_btr.estimators.base import Budget, Progress, silent
from sysid_btr.estimators.journal import Journal
from sysid_btr.estimators.linearisation import linearise
from sysid_btr.estimators.lsq import LeastSquares
from sysid_btr.identify.refit import Fitted, judge
from sysid_btr.identify.step_check import Optimum
from sysid_btr.identify.study import Study
from sysid_btr.terms.model import Model, Terms

MOST = 3
"""Times that bounds grow at most."""
PRESSING = 3.0
"""Standard errors by which the loss must fall beyond a bound."""
AT = 1e-6
"""Of the range: an estimate nearer to a bound lies on it."""


def grow_bounds(study: Study, at: Optimum, budget: Budget, progress: Progress, first: int = 0) -> tuple[Optimum, int]:
    """The optimum within bounds that are wide enough, and the evaluations that took.

    A bound that the user or the robot states stays, and so does one that physics sets, and those of parameters before
    the `first`.
    """
    spent, rng = 0, np.random.default_rng(0)
    for _ in range(MOST):
        side = pressing(at)
        side[:first] = 0.0
        terms = grown(at.problem.terms, side)
        if terms is None:
            break
        problem = study.train_problem(Model(terms, at.values))
        goal, left = study.with_belief(problem), budget.after(spent)
        found = LeastSquares().fit(goal, rng=rng, budget=left, journal=Journal(), progress=progress)
        spent += found.evaluations
        at = Optimum.of(problem, found, study.stencil(terms))
    return at, spent


def fit_beyond(study: Study, fitted: Fitted, budget: Budget, progress: Progress = silent, first: int = 0) -> Fitted:
    """A fitted model, fitted again where parameters from the `first` on lie on bounds that can grow and data press."""
    model, spent = fitted.model, fitted.evaluations
    side = on_bounds(model)
    side[:first] = 0.0
    if grown(model.terms, side) is None:
        return fitted
    problem, step = study.train_problem(model), study.stencil(model.terms)
    residual, jacobian = linearise(problem, model.values, step=step)
    spent += 2 * len(model.values) + 1
    at = Optimum(problem, model.values, jacobian, residual)
    at, more = grow_bounds(study, at, budget.after(spent), progress, first)
    spent += more
    return judge(study, at.problem.model.at(at.values), spent) if more else replace(fitted, evaluations=spent)


def on_bounds(model: Model) -> FloatArray:
    """(p,) -1 and 1 where a value lies on its lower and upper bound; else 0."""
    values, lower, upper = model.values, model.terms.lower, model.terms.upper
    near = AT * (upper - lower)
    return np.where(values >= upper - near, 1.0, np.where(values <= lower + near, -1.0, 0.0))


def pressing(at: Optimum) -> FloatArray:
    """(p,) -1 and 1 where an estimate lies on its lower and upper bound and data want it beyond; else 0.

    That is where the mean pull of stretches of time is many of its standard errors, however few stretches there are.
    """
    blocks, side = at.problem.blocks, on_bounds(Model(at.problem.terms, at.values))
    for i in np.flatnonzero(side):
        pull = -at.jacobian[:, i] * at.residual
        each = np.bincount(blocks, pull)[np.bincount(blocks) > 0]
        error = np.sqrt(len(each)) * np.std(each, ddof=1) if len(each) > 1 else np.inf
        if not side[i] * pull.sum() > PRESSING * error:
            side[i] = 0.0
    return side


def grown(terms: Terms, side: FloatArray) -> Terms | None:
    """Terms with wider bounds where estimates press against them, (p,) as by `pressing`; None where none can grow."""
    wider, changed = [], False
    for term, own in terms.split(side):
        known = tuple(p.wider(s) if s else p for p, s in zip(term.parameters, own, strict=True))
        changed |= known != term.parameters
        wider.append(replace(term, known=known) if known != term.parameters else term)
    return Terms(wider) if changed else None
