"""What walks tell beside what they get wrong about their ground, alone and beside logs of a robot that hangs."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from sysid_btr._typing import BoolArray, FloatArray
from sysid_btr.estimators.lsq import linearise
from sysid_btr.floating_base.contact_free import without_ground
from sysid_btr.floating_base.walk import GROUND, GROUND_MASS, Walk, of_legs, repeated_error, walked_residuals
from sysid_btr.identify.deferred import corrected
from sysid_btr.identify.study import Study
from sysid_btr.objectives.covariance import RANK, Known, covariance, newton
from sysid_btr.objectives.problem import ReplayProblem
from sysid_btr.terms.model import Model


@dataclass(frozen=True, eq=False)
class Weighed:
    """A linearised fit of walks, and of other logs.

    Attributes
    ----------
    values : (p,) estimates.
    jacobian, residual : (r, p) and (r,) there; of walks among other logs as much as they are believed.
    error : (p,) standard deviation beyond that of pieces of the log that are independent.
    known : all parameters but the ground's as these residuals and motions without a ground tell them, where they do.
    """

    values: FloatArray
    jacobian: FloatArray
    residual: FloatArray
    error: FloatArray
    known: Known | None = None


def weigh_walks(
    study: Study,
    problem: ReplayProblem,
    values: FloatArray,
    jacobian: FloatArray,
    residual: FloatArray,
    *,
    follow: bool = True,
) -> Weighed:
    """What errors that every stride repeats do to estimates; beside other logs, walks count for less by them.

    Weighed by the noise of its sensors alone, a walk would draw what a hanging robot tells better towards the errors
    of its own contact. It counts as much as leaves the estimates most certain; they follow by one Gauss-Newton step.

    Parameters
    ----------
    study, problem : with at least one walk.
    values, jacobian, residual : (p,), (r, p), (r,) at the optimum, whitened.
    follow : whether the estimates may; else all logs count by their noise. What another estimator or distance has found
        stays where it is.
    """
    walked, moved = walked_residuals(problem), _placed_elsewhere(study, Model(problem.terms, values))
    if moved is None:
        return Weighed(values, jacobian, residual, np.full(len(values), np.inf))
    there, residual_there, walked_there = moved
    legs = of_legs(problem)
    # beside a robot that hangs, a walk does as much harm to them as it has a say
    masses = legs & walked.all() & _is_mass(problem)
    span = problem.upper - problem.lower

    def weighed(weight: float) -> Weighed:
        rows = np.where(walked, weight, 1.0)
        j, r = jacobian * rows[:, None], residual * rows
        step = np.zeros(len(values))
        if weight < 1:
            step = np.clip(newton(j, r), problem.lower - values, problem.upper - values)
        r = r + j @ step
        rows = np.where(walked_there, weight, 1.0)
        placed = np.clip(newton(there * rows[:, None], residual_there * rows) - step, -span, span)
        told = np.hypot(placed, repeated_error(problem, j, r))
        # what the ground does wrong everywhere is as much again, and more
        more = np.where(legs, (GROUND**2 - 1) * (told**2 + _noise_of(j, walked) ** 2), 0.0)
        return Weighed(values + step, j, r, np.sqrt(told**2 + np.where(masses, GROUND_MASS**2, more)))

    def doubt(found: Weighed) -> float:
        std = np.sqrt(np.diag(covariance(found.jacobian, found.residual, problem.blocks)))
        return float(np.mean(np.log(np.clip(np.hypot(std, found.error) / span, 1e-12, 1.0))))

    if not follow:
        return weighed(1.0)
    if walked.all():
        return with_motion(problem, weighed(1.0))
    apart = _apart(study, problem, values, jacobian, residual, walked)
    return min(map(weighed, WEIGHTS), key=doubt) if apart is None else apart


def _apart(
    study: Study,
    problem: ReplayProblem,
    values: FloatArray,
    jacobian: FloatArray,
    residual: FloatArray,
    walked: BoolArray,
) -> Weighed | None:
    """What walks and other logs tell, each by themselves, joined by their precision; None where walks are not told so.

    Nothing that a walk gets wrong about its ground then reaches into what a hanging robot tells.
    """
    walks = tuple(i for i, log in enumerate(study.train) if isinstance(log, Walk))
    alone = replace(study, train=tuple(study.train[i] for i in walks))
    part = replace(problem, episodes=tuple(problem.episodes[i] for i in walks))
    own, rest = jacobian[walked], residual[walked]
    step = np.clip(newton(own, rest), problem.lower - values, problem.upper - values)
    found = weigh_walks(alone, part, values + step, own, rest + own @ step)
    if found.known is None:
        return None
    which, others = found.known.which, np.setdiff1d(np.arange(len(values)), found.known.which)
    held, left = jacobian[~walked], residual[~walked]
    step = newton(held, left)
    cov = covariance(held, left + held @ step, problem.blocks[~walked])[np.ix_(which, which)]
    span = (problem.upper - problem.lower)[which]
    joined = found.known.joined((values + step)[which], bounded(cov, span))
    moved = values.copy()
    moved[which] = joined.within(problem.lower, problem.upper)
    moved[others] += newton(own[:, others], rest + own @ (moved - values))
    moved = np.clip(moved, problem.lower, problem.upper)
    return Weighed(moved, jacobian, residual + jacobian @ (moved - values), found.error, joined)


def with_motion(problem: ReplayProblem, weighed: Weighed) -> Weighed:
    """A fit of walks with what their motion tells whatever the ground is.

    Both use the same encoders, so that only masses of legs are joined, which the fit tells so badly that counting its
    part of the noise as its own does no harm. All else is what the motion tells.
    """
    try:
        free = without_ground(problem, weighed.values)
    except np.linalg.LinAlgError:  # a model so wrong that no step finds a better one
        free = None
    if free is None:
        return weighed
    own, others = free.which, np.setdiff1d(np.arange(len(weighed.values)), free.which)
    span = problem.upper - problem.lower
    legs = of_legs(problem) & _is_mass(problem)
    cov = covariance(weighed.jacobian, weighed.residual, problem.blocks)
    cov = np.where(legs & legs[:, None], cov, 0.0) + np.diag(np.where(legs, weighed.error, WIDE * span) ** 2)
    joined = free.joined(weighed.values[own], bounded(cov[np.ix_(own, own)], WIDE * span[own]))
    moved = weighed.values.copy()
    moved[own] = joined.within(problem.lower, problem.upper)
    # those of the ground go where the log wants them beside these
    change = moved - weighed.values
    moved[others] += newton(weighed.jacobian[:, others], weighed.residual + weighed.jacobian @ change)
    moved = np.clip(moved, problem.lower, problem.upper)
    residual = weighed.residual + weighed.jacobian @ (moved - weighed.values)
    return replace(weighed, values=moved, residual=residual, known=joined)


WIDE = 100.0
"""Ranges of the bounds that are the standard deviation of what nothing is known of."""


def bounded(cov: FloatArray, span: FloatArray) -> FloatArray:
    """Covariance (k, k) beside the knowledge that each number lies within so much, (k,)."""
    blind = ~np.isfinite(np.diag(cov))
    cov = np.where(blind | blind[:, None], 0.0, cov) + np.diag(np.where(blind, (WIDE * span) ** 2, 0.0))
    return np.asarray(cov - cov @ np.linalg.solve(cov + np.diag(span**2), cov))


def _is_mass(problem: ReplayProblem) -> BoolArray:
    return np.array([p.name.startswith("mass:") for p in problem.parameters])


WEIGHTS = tuple(np.geomspace(1.0, 0.01, 9).tolist())
"""Factors by which the residuals of walks count beside those of other logs."""


def _noise_of(jacobian: FloatArray, rows: BoolArray) -> FloatArray:
    """Standard deviation (p,) of estimates by white noise of unit size in some rows of the residual."""
    norm = np.linalg.norm(jacobian, axis=0)
    norm = np.where(norm > 0, norm, 1.0)
    unit = jacobian / norm
    inverse = np.linalg.pinv(unit.T @ unit, rcond=RANK, hermitian=True)
    return np.asarray(np.linalg.norm(unit[rows] @ inverse, axis=0) / norm)


def _placed_elsewhere(
    study: Study, model: Model
) -> tuple[FloatArray, FloatArray, BoolArray] | None:
    """Jacobian (r, p), residual (r,) and which of it is of walks, where windows begin elsewhere; None if that fails.

    In the right model the change of the estimates is a part of the noise; in another it is the least that the model's
    error does.
    """
    relaid = study.relaid().settled(model, held=False)
    problem = relaid.train_problem(model)
    rough = corrected(problem, study.rough, model.values)
    residual, jacobian = linearise(rough, model.values, step=study.stencil(model.terms))
    return (jacobian, residual, walked_residuals(problem)) if np.isfinite(jacobian).all() else None
