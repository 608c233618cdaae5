"""What floating-base logs are informative about beside the errors of their ground, alone and with fixed-base logs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from sysid_btr._typing import BoolArray, FloatArray
from sysid_btr.estimators.linearisation import linearise
from sysid_btr.floating_base.contact_free import without_ground
from sysid_btr.floating_base.segments import FloatingReplay
from sysid_btr.floating_base.strides import GROUND, GROUND_MASS, of_legs, repeated_error, walked_residuals
from sysid_btr.identify.deferred import corrected
from sysid_btr.identify.episode import Fused
from sysid_btr.objectives.covariance import RANK, covariance, newton
from sysid_btr.objectives.problem import ReplayProblem
from sysid_btr.simulation.numerics import Numerics

WIDE_STEP = 2e-2
"""Finite-difference step, fraction of the range, that is wide against the roughness of impacts: at a fifth of it a
third of a derivative by a mass is chance, which passes for information, and drags estimates along."""


def fuse(
    problem: ReplayProblem,
    values: FloatArray,
    jacobian: FloatArray,
    residual: FloatArray,
    elsewhere: Callable[[FloatArray], ReplayProblem],
    coarse: Numerics,
    *,
    follow: bool = True,
) -> Fused:
    """What errors that every stride repeats do to estimates; beside other logs, walks count for less by them.

    Weighed by the noise of its sensors alone, a walk would draw what a fixed-base log knows better towards the errors
    of its own contact. It counts as much as leaves the estimates most certain; they follow by one Gauss-Newton step.

    Parameters
    ----------
    problem : with at least one walk.
    values, jacobian, residual : (p,), (r, p), (r,) at the optimum, whitened.
    elsewhere : candidate (p,) -> the same problem with segments that begin elsewhere.
    coarse : integrator and step for derivatives there.
    follow : whether the estimates may; else all logs count by their noise. What another estimator or distance has found
        stays where it is.
    """
    walked, moved = walked_residuals(problem), _linearised(elsewhere(values), coarse, values)
    if moved is None:
        return Fused(values, jacobian, residual, np.full(len(values), np.inf))
    there, residual_there, walked_there = moved
    legs = of_legs(problem)
    # beside a robot that hangs, a walk does as much harm to them as it has a say
    masses = legs & walked.all() & _is_mass(problem)
    span = problem.upper - problem.lower

    def weighed(weight: float) -> Fused:
        rows = np.where(walked, weight, 1.0)
        j, r = jacobian * rows[:, None], residual * rows
        step = np.zeros(len(values))
        if weight < 1:
            step = np.clip(newton(j, r), problem.lower - values, problem.upper - values)
        r = r + j @ step
        rows = np.where(walked_there, weight, 1.0)
        placed = np.clip(newton(there * rows[:, None], residual_there * rows) - step, -span, span)
        known = np.hypot(placed, repeated_error(problem, j, r))
        # what the ground does wrong everywhere is as much again, and more
        more = np.where(legs, (GROUND**2 - 1) * (known**2 + _noise_of(j, walked) ** 2), 0.0)
        return Fused(values + step, j, r, np.sqrt(known**2 + np.where(masses, GROUND_MASS**2, more)))

    def doubt(found: Fused) -> float:
        std = np.sqrt(np.diag(covariance(found.jacobian, found.residual, problem.blocks)))
        return float(np.mean(np.log(np.clip(np.hypot(std, found.error) / span, 1e-12, 1.0))))

    if not follow:
        return weighed(1.0)
    if walked.all():
        return with_motion(problem, weighed(1.0))
    apart = _apart(problem, values, jacobian, residual, walked, elsewhere, coarse)
    return min(map(weighed, WEIGHTS), key=doubt) if apart is None else apart


def _apart(
    problem: ReplayProblem,
    values: FloatArray,
    jacobian: FloatArray,
    residual: FloatArray,
    walked: BoolArray,
    elsewhere: Callable[[FloatArray], ReplayProblem],
    coarse: Numerics,
) -> Fused | None:
    """Estimates from walks and from other logs, each by themselves, fused by their precision; None where these are not
    to be had.

    Nothing that a walk gets wrong about its ground then reaches into what a fixed-base log knows.
    """
    part = _of_walks(problem)
    own, rest = jacobian[walked], residual[walked]
    step = np.clip(newton(own, rest), problem.lower - values, problem.upper - values)
    found = fuse(part, values + step, own, rest + own @ step, lambda at: _of_walks(elsewhere(at)), coarse)
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
    return Fused(moved, jacobian, residual + jacobian @ (moved - values), found.error, joined)


def _of_walks(problem: ReplayProblem) -> ReplayProblem:
    """The problem in its walks alone."""
    return replace(problem, episodes=tuple(e for e in problem.episodes if isinstance(e.replay, FloatingReplay)))


def with_motion(problem: ReplayProblem, weighed: Fused) -> Fused:
    """A fit of walks with what their motion gives whatever the ground is.

    Both use the same encoders, so that only masses of legs are fused, about which the fit is so uninformative that
    counting its part of the noise as its own does no harm. All else is what the motion gives.
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


def _linearised(
    problem: ReplayProblem, coarse: Numerics, values: FloatArray
) -> tuple[FloatArray, FloatArray, BoolArray] | None:
    """Jacobian (r, p), residual (r,) and which of it is of walks; None if that fails.

    Where segments begin elsewhere the change of the estimates is a part of the noise in the right model; in another it
    is the least that the model's error does.
    """
    residual, jacobian = linearise(corrected(problem, coarse, values), values, step=WIDE_STEP)
    return (jacobian, residual, walked_residuals(problem)) if np.isfinite(jacobian).all() else None
