"""Refitting a model with a hypothesis, and judging it on data that it was not fitted to."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from sysid_btr._typing import FloatArray
from sysid_btr.estimators.base import Budget, silent
from sysid_btr.estimators.journal import Journal
from sysid_btr.estimators.lsq import LeastSquares
from sysid_btr.identify.study import Study
from sysid_btr.models.modifier import Modifier
from sysid_btr.objectives.problem import ReplayProblem


@dataclass(frozen=True, eq=False)
class Fitted:
    """A model with its parameters refitted.

    Attributes
    ----------
    modifiers, values : the model.
    train, holdout : mean square of error over noise floor.
    holdout_columns, columns : the same for each log column, on held-out and on all data.
    train_blocks, holdout_blocks : sums of squares by stretch of half a second, for paired comparisons.
    count : (train, holdout) number of residuals.
    evaluations : candidates simulated.
    """

    modifiers: tuple[Modifier, ...]
    values: FloatArray
    train: float
    holdout: float
    train_blocks: FloatArray
    holdout_blocks: FloatArray
    holdout_columns: FloatArray
    columns: FloatArray
    count: tuple[int, int]
    evaluations: int


def refit(
    study: Study,
    modifiers: tuple[Modifier, ...],
    start: FloatArray,
    *,
    polish: bool = False,
    iterations: int = 8,
) -> Fitted:
    """Least squares from a first guess; `polish` runs to convergence."""
    problem = study.train_problem(modifiers, np.clip(start, *_bounds(modifiers)))
    estimator = LeastSquares(
        confirm=False,
        max_iterations=30 if polish else iterations,
        tolerance=1e-6 if polish else 2e-4,
    )
    result = estimator.fit(
        problem, rng=np.random.default_rng(0), budget=Budget(), journal=Journal(), progress=silent
    )
    return judge(study, modifiers, result.x, evaluations=result.evaluations)


def judge(study: Study, modifiers: tuple[Modifier, ...], values: FloatArray, evaluations: int = 0) -> Fitted:
    """Scores of given values on fitted and held-out data."""
    train = study.train_problem(modifiers)
    holdout = study.holdout_problem(modifiers)
    r, s = train.residuals(values[None])[0], holdout.residuals(values[None])[0]
    return Fitted(
        modifiers=modifiers,
        values=values,
        train=float(r @ r) / len(r),
        holdout=float(s @ s) / len(s),
        train_blocks=_by_block(train, r),
        holdout_blocks=_by_block(holdout, s),
        holdout_columns=_by_column(holdout, s),
        columns=_pooled(train, r, holdout, s),
        count=(len(r), len(s)),
        evaluations=evaluations + 1,
    )


def _by_column(problem: ReplayProblem, residual: FloatArray) -> FloatArray:
    labels, size = problem.column_labels, len(problem.columns)
    return np.bincount(labels, residual**2, size) / np.maximum(np.bincount(labels, minlength=size), 1)


def _pooled(train: ReplayProblem, r: FloatArray, holdout: ReplayProblem, s: FloatArray) -> FloatArray:
    """Mean square by column over fitted and held-out data, where both have the same columns."""
    if len(train.columns) != len(holdout.columns):
        return np.concatenate([_by_column(train, r), _by_column(holdout, s)])
    a, b = np.bincount(train.column_labels), np.bincount(holdout.column_labels)
    total: FloatArray = (_by_column(train, r) * a + _by_column(holdout, s) * b) / np.maximum(a + b, 1)
    return total


def _by_block(problem: ReplayProblem, residual: FloatArray) -> FloatArray:
    return np.bincount(problem.blocks, weights=np.nan_to_num(residual, nan=1e6) ** 2)


def _bounds(modifiers: tuple[Modifier, ...]) -> tuple[FloatArray, FloatArray]:
    parameters = [p for m in modifiers for p in m.parameters]
    return np.array([p.lower for p in parameters]), np.array([p.upper for p in parameters])


def paired_t(better: FloatArray, worse: FloatArray) -> float:
    """Paired t statistic over stretches of time of the decrease from `worse` to `better`."""
    size = min(len(better), len(worse))
    difference = worse[:size] - better[:size]
    difference = difference[(worse[:size] > 0) | (better[:size] > 0)]
    if len(difference) < 3:
        return 0.0
    spread = float(np.std(difference, ddof=1))
    if spread == 0:
        return 0.0
    return float(np.mean(difference) / spread * np.sqrt(len(difference)))


def shorten(study: Study, seconds: float) -> Study:
    """The same study with at most the first so many seconds of each training log."""
    train = tuple(
        log.window(0, max(int(np.searchsorted(log.time, log.time[0] + seconds)), 2)) for log in study.train
    )
    return replace(study, train=train)
