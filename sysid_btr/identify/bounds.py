"""Bounds that nobody stated grow while an estimate presses against them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from sysid_btr._typing import FloatArray
from sysid_btr.estimators.base import Budget, Progress
from sysid_btr.estimators.journal import Journal
from sysid_btr.estimators.lsq import LeastSquares
from sysid_btr.identify.step_check import Optimum
from sysid_btr.identify.study import Study
from sysid_btr.terms.base import Parameter
from sysid_btr.terms.model import Model, Terms

GROWTH = 5.0
"""Factor by which a bound grows ..."""
MOST = 3
"""... so many times at most."""
PRESSING = 3.0
"""Standard errors by which the loss must fall beyond a bound."""
AT = 1e-6
"""Of the range: an estimate nearer to a bound lies on it."""


def grow_bounds(study: Study, at: Optimum, budget: Budget, progress: Progress) -> tuple[Optimum, int]:
    """The optimum within bounds that are wide enough, and the evaluations that took.

    A bound that the user or the robot states stays, and so does one that physics sets.
    """
    spent, rng = 0, np.random.default_rng(0)
    for _ in range(MOST):
        terms = grown(at.problem.terms, pressing(at))
        if terms is None:
            break
        problem = study.train_problem(Model(terms, at.values))
        goal, left = study.with_belief(problem), budget.after(spent)
        found = LeastSquares().fit(goal, rng=rng, budget=left, journal=Journal(), progress=progress)
        spent += found.evaluations
        at = Optimum.of(problem, found, study.stencil(terms))
    return at, spent


def on_bounds(model: Model) -> FloatArray:
    """(p,) -1 and 1 where a value lies on its lower and upper bound; else 0."""
    values, lower, upper = model.values, model.terms.lower, model.terms.upper
    near = AT * (upper - lower)
    return np.where(values >= upper - near, 1.0, np.where(values <= lower + near, -1.0, 0.0))


def pressing(at: Optimum) -> FloatArray:
    """(p,) -1 and 1 where an estimate lies on its lower and upper bound and data want it beyond; else 0."""
    blocks, side = at.problem.blocks, on_bounds(Model(at.problem.terms, at.values))
    for i in np.flatnonzero(side):
        pull = -at.jacobian[:, i] * at.residual
        error = np.sqrt(np.sum(np.bincount(blocks, pull) ** 2))
        if not side[i] * pull.sum() > PRESSING * error:
            side[i] = 0.0
    return side


def grown(terms: Terms, side: FloatArray) -> Terms | None:
    """Terms with wider bounds where estimates press against them, (p,) as by `pressing`; None where none can grow."""
    wider, changed = [], False
    for term, own in terms.split(side):
        known = _grown(term.parameters, own)
        changed |= known != term.parameters
        wider.append(replace(term, known=known) if known != term.parameters else term)
    return Terms(wider) if changed else None


def _grown(parameters: Sequence[Parameter], side: FloatArray) -> tuple[Parameter, ...]:
    return tuple(_wider(p, s) if s and not p.stated else p for p, s in zip(parameters, side, strict=True))


def _wider(parameter: Parameter, side: float) -> Parameter:
    if side > 0:
        # a ratio stays below one, whatever the data want
        physical = parameter.unit == "1" and parameter.upper <= 1
        return parameter if physical else replace(parameter, upper=GROWTH * parameter.upper)
    if parameter.lower < 0:
        return replace(parameter, lower=GROWTH * parameter.lower)
    return replace(parameter, lower=parameter.lower / GROWTH)
