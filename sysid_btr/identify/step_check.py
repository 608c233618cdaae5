"""Whether the integrator's step is short enough: for the estimates, and for what a model leaves."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from sysid_btr._typing import FloatArray
from sysid_btr.estimators.base import Budget, FitResult, Progress
from sysid_btr.estimators.journal import Journal
from sysid_btr.estimators.linearisation import linearise
from sysid_btr.estimators.lsq import LeastSquares
from sysid_btr.identify.intervals import estimates
from sysid_btr.identify.numerics import TOLERATED, largest_step
from sysid_btr.identify.study import Study
from sysid_btr.objectives.covariance import newton
from sysid_btr.objectives.problem import ReplayProblem
from sysid_btr.simulation.numerics import Numerics
from sysid_btr.terms.model import Model

if TYPE_CHECKING:
    from numpy.random import Generator

SHIFT_TOLERATED = 0.3
"""Shift of an estimate under half the step, in standard errors, beyond which the step is halved."""
MAX_REFINEMENTS = 3
ABOUT = 1.01
"""Step over the largest one of a log that is still that: clocks jitter."""
FAR = 3.0
"""Mean squared whitened residual beyond which a model is too wrong for its step to matter."""


@dataclass(frozen=True, eq=False)
class Optimum:
    """What an estimator found, linearised.

    Attributes
    ----------
    problem : that was solved.
    values, jacobian, residual : (p,), (r, p), (r,) there, whitened.
    """

    problem: ReplayProblem
    values: FloatArray
    jacobian: FloatArray
    residual: FloatArray

    @classmethod
    def of(cls, problem: ReplayProblem, result: FitResult, step: float) -> Optimum:
        """Linearised with a finite-difference step, fraction of the range, where the estimator has not done so.

        Data alone, whatever else the estimator was told.
        """
        if result.jacobian is None or result.residual is None:
            residual, jacobian = linearise(problem, result.x, step=step)
        else:
            residual, jacobian = result.residual[: problem.count], result.jacobian[: problem.count]
        return cls(problem, result.x, jacobian, residual)

    @property
    def shift(self) -> FloatArray:
        """(p,) change of the estimates when the integrator's step is halved."""
        return numerics_shift(self.problem, self.values, self.jacobian, self.residual)


def with_short_steps(
    study: Study, model: Model, at: Optimum, rng: Generator, budget: Budget, progress: Progress
) -> tuple[Study, Optimum, FloatArray, int]:
    """Halve the integrator's step until it moves no estimate by much.

    Returns
    -------
    study, optimum : with that step; as given where it is part of the model (a digital servo), where impacts leave a
        little chaos under any step, which widens the intervals instead, and where the model is too wrong for it to
        matter.
    shift : (p,) change of the estimates when the step is halved once more.
    evaluations : candidates simulated.
    """
    spent = 0
    for _ in range(MAX_REFINEMENTS):
        shift = at.shift
        if not study.procedure.refines_step or study.numerics.exact or _short_enough(at, shift):
            break
        study = replace(study, numerics=study.numerics.halved())
        problem = study.train_problem(model.at(at.values))
        left = budget.after(spent)
        goal = study.with_belief(problem)
        polished = LeastSquares().fit(goal, rng=rng, budget=left, journal=Journal(), progress=progress)
        spent += polished.evaluations
        at = Optimum.of(problem, polished, study.stencil(model.terms))
    return study, at, shift, spent


def longest_step(study: Study, model: Model, finest: Numerics) -> Numerics:
    """The longest step whose error is as small beside what a model leaves as is asked of it beside the noise.

    While a model is far from a log a step that suits the noise is a waste: what is missing is sought in longer ones.

    Parameters
    ----------
    study : with columns that are weighed by what the model leaves in them.
    finest : numerics with which it was fitted.
    """
    if finest.exact or finest.servo_period or not study.procedure.refines_step or study.procedure.costly:
        return finest
    most = ABOUT * max(largest_step(e.log).timestep for e in study.train)
    problem, chosen = study.train_problem(model), finest
    now = problem.with_numerics(chosen).residuals(model.values[None])[0]
    while True:
        longer = replace(chosen, timestep=2 * chosen.timestep)
        if longer.timestep > most:
            return chosen
        there = problem.with_numerics(longer).residuals(model.values[None])[0]
        change = problem.column_chi2(there - now) / problem.inflation
        if not np.sqrt(np.max(change)) <= TOLERATED:
            return chosen
        chosen, now = longer, there


def _short_enough(at: Optimum, shift: FloatArray) -> bool:
    found = estimates(at.problem.parameters, at.values, at.jacobian, at.residual, at.problem.blocks)
    std = np.array([e.std for e in found])
    worst = np.max(np.abs(shift) / np.maximum(std, 1e-300), initial=0.0)
    return bool(worst <= SHIFT_TOLERATED) or _mean_chi2(at.problem, at.residual) > FAR


def _mean_chi2(problem: ReplayProblem, residual: FloatArray) -> float:
    """Mean square of error over noise floor, however the residual was whitened."""
    return float(np.mean(residual**2 * problem.inflation[problem.column_labels]))


def numerics_shift(
    problem: ReplayProblem, values: FloatArray, jacobian: FloatArray, residual: FloatArray
) -> FloatArray:
    """Change of the estimates, (p,), to first order, when the step is halved.

    Zero where the step is part of the model.
    """
    numerics = problem.episodes[0].replay.numerics
    if numerics.exact:
        return np.zeros(len(values))
    fine = problem.with_numerics(numerics.halved()).residuals(values[None])[0]
    if not np.isfinite(fine).all():
        return np.full(len(values), np.inf)
    return newton(jacobian, fine - residual)
