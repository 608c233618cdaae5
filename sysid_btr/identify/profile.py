"""Profile likelihood: how well the log can be explained with one parameter held, all others fitted anew.

An interval from the curvature at the best fit is a parabola's; the profile shows what the likelihood really does
away from it: a flat side, a bound, a second valley. Its deviance counts correlated residuals and what the model lacks
exactly as the standard errors do: it is scaled so that a parabola gives the interval of `fit`.
(Venzon and Moolgavkar 1988, doi:10.2307/2347496; Raue et al. 2009, doi:10.1093/bioinformatics/btp358.)
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from fnmatch import fnmatchcase
from typing import TYPE_CHECKING

import numpy as np

from sysid_btr._typing import FloatArray, IntArray
from sysid_btr.errors import UsageError
from sysid_btr.estimators.base import Budget, FitResult, Problem, Progress, silent
from sysid_btr.estimators.journal import Journal
from sysid_btr.estimators.lsq import LeastSquares
from sysid_btr.identify.intervals import Profile, responses
from sysid_btr.objectives.covariance import RANK, spread
from sysid_btr.objectives.problem import Conditional
from sysid_btr.progress import shows_progress, watched

if TYPE_CHECKING:
    from sysid_btr.estimators.base import ResidualProblem
    from sysid_btr.identify.fit import Fit

POINTS = 15
BEYOND = 1.3
"""Deviance, in thresholds, up to which a side is followed."""
_MOST = 3
"""Times the points of a side that are spent before it is called open."""
_ITERATIONS = 6


@shows_progress("profile")
def profile(fit: Fit, name: str, points: int = POINTS, *, progress: Progress = watched) -> Profile:
    """The likelihood of a fit along one of its parameters.

    Parameters
    ----------
    fit : by least squares, or any other; the likelihood is that of its whitened residuals.
    name : of a free parameter.
    points : across the interval; more where a side is flat.
    progress : called after every fit.

    Raises
    ------
    UsageError
        `name` is not free; the message lists what is.
    """
    parameters = fit.model.terms.parameters
    names = [p.name for p in parameters]
    if name not in names:
        raise UsageError(f"--profile {name} is not a fitted parameter; available: {', '.join(names)}")
    problem = fit.study.train_problem(fit.model)
    index = names.index(name)
    return profile_curve(
        problem,
        problem.blocks,
        index,
        points,
        estimator=fit.study.procedure.suited(LeastSquares()),
        shift=float(fit.numerics_shift[index]),
        unit=parameters[index].unit,
        progress=progress,
    )


def with_profiles(fit: Fit, names: Sequence[str], progress: Progress = silent) -> Fit:
    """The fit with the profiles of some of its parameters."""
    profiles = tuple(profile(fit, name, progress=progress) for name in names)
    return replace(fit, profiles=profiles, replays=fit.replays + sum(p.replays for p in profiles))


def chosen_names(names: Sequence[str], wanted: Sequence[str]) -> tuple[str, ...]:
    """Names that are wanted by themselves or by a glob, in their order.

    Raises
    ------
    UsageError
        One that is wanted is not there.
    """
    missing = [w for w in wanted if not any(n == w or fnmatchcase(n, w) for n in names)]
    if missing:
        raise UsageError(f"--profile {', '.join(missing)}: not a fitted parameter; available: {', '.join(names)}")
    return tuple(n for n in names if any(n == w or fnmatchcase(n, w) for w in wanted))


def profile_curve(
    problem: ResidualProblem,
    blocks: IntArray,
    index: int,
    points: int = POINTS,
    *,
    estimator: LeastSquares | None = None,
    shift: float = 0.0,
    unit: str = "1",
    progress: Progress = silent,
) -> Profile:
    """The likelihood of a problem along parameter `index`, from the minimum near its start.

    Parameters
    ----------
    problem : with residuals.
    blocks : (r,) stretch of time of each residual, as for `covariance`.
    points : across the interval.
    estimator : of the others' values; default least squares as they come.
    shift : change of the parameter when the replay's step is halved; widens the interval.
    """
    from scipy.stats import t as student

    if points < 5:
        raise UsageError(f"a profile needs at least 5 points, not {points}")
    estimator = LeastSquares() if estimator is None else estimator
    top = _fit(estimator, problem, progress)
    jacobian, residual = top.jacobian, top.residual
    if jacobian is None or residual is None:
        raise UsageError("no profile without converged least squares: fit the parameters first")
    jacobian = np.nan_to_num(jacobian)
    normal = jacobian.T @ jacobian
    span = float(problem.upper[index] - problem.lower[index])
    size = np.sqrt(np.maximum(np.diag(normal), 1e-300))
    inverse = np.linalg.pinv(normal / np.outer(size, size), rcond=RANK, hermitian=True)
    white = float(inverse[index, index] / size[index] ** 2)
    covariance, dof = spread(jacobian, residual, blocks)
    std = float(np.hypot(np.sqrt(covariance[index, index]), shift))
    known = np.isfinite(std) and std < span
    # a parabola of width std must give the interval of the standard error
    share = white / std**2 if known else 1.0
    threshold = float(student.ppf(0.975, dof[index])) ** 2
    step = np.sqrt(BEYOND * threshold) * min(std, span) / (points // 2) if known else span / (points - 1)
    follow = responses(normal, index)
    quick = replace(estimator, confirm=False, max_iterations=_ITERATIONS, tolerance=1e-5)
    low = list(_side(problem, quick, top.x, top.loss, index, -step, follow, share, threshold, points, progress))
    high = list(_side(problem, quick, top.x, top.loss, index, step, follow, share, threshold, points, progress))
    rows = [*reversed(low), (top.x, top.loss, top.evaluations), *high]
    others = np.array([x for x, _, _ in rows])
    loss = np.array([value for _, value, _ in rows])
    deviance = share * (loss - loss.min())
    values = others[:, index]
    ends = [_crossing(values, deviance, threshold, side) for side in (-1, 1)]
    limits = (float(problem.lower[index]), float(problem.upper[index]))
    return Profile(
        name=problem.names[index],
        unit=unit,
        values=values,
        deviance=deviance,
        others=others,
        best=float(values[int(np.argmin(loss))]),
        std=min(std, span),
        threshold=threshold,
        interval=(limits[0] if ends[0] is None else ends[0], limits[1] if ends[1] is None else ends[1]),
        closed=(ends[0] is not None, ends[1] is not None),
        replays=sum(n for _, _, n in rows),
    )


Row = tuple[FloatArray, float, int]


def _side(
    problem: ResidualProblem,
    quick: LeastSquares,
    x: FloatArray,
    best: float,
    index: int,
    step: float,
    follow: FloatArray,
    share: float,
    threshold: float,
    points: int,
    progress: Progress,
) -> Iterator[Row]:
    """Fits with the parameter held ever farther from the best one, until the deviance is past the threshold."""
    limit = float(problem.upper[index] if step > 0 else problem.lower[index])
    free = np.arange(len(x)) != index
    last = x
    for k in range(1, _MOST * points + 1):
        value = float(x[index] + k * step)
        ended = value >= limit if step > 0 else value <= limit
        value = limit if ended else value
        if value == last[index]:
            return
        begin = np.clip(last + follow * (value - last[index]), problem.lower, problem.upper)
        begin[index] = value
        if free.any():
            held = Conditional(problem, free, begin)  # type: ignore[arg-type]
            found = _fit(quick, held, progress)
            last, loss, spent = held.complete(found.x[None])[0], found.loss, found.evaluations
        else:
            last, loss, spent = begin, float(problem.loss(begin[None])[0]), 1
        if not np.isfinite(loss):
            return
        yield last, loss, spent
        if ended or share * (loss - best) > BEYOND * threshold:
            return


def _fit(estimator: LeastSquares, problem: Problem, progress: Progress) -> FitResult:
    return estimator.fit(problem, rng=np.random.default_rng(0), budget=Budget(), journal=Journal(), progress=progress)


def _crossing(values: FloatArray, deviance: FloatArray, threshold: float, side: int) -> float | None:
    """Where a side of the deviance first passes the threshold; between two points its root is a straight line."""
    top = int(np.argmin(deviance))
    order = range(top, len(values) - 1) if side > 0 else range(top, 0, -1)
    root, goal = np.sqrt(np.maximum(deviance, 0.0)), np.sqrt(threshold)
    for i in order:
        j = i + side
        if root[i] <= goal < root[j]:
            return float(values[i] + (values[j] - values[i]) * (goal - root[i]) / (root[j] - root[i]))
    return None
