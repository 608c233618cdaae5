"""Where a search for a limit begins: at its neutral value it does nothing, and no derivative leads away from there."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from sysid_btr._typing import FloatArray, IntArray
from sysid_btr.identify.refit import NOTICEABLE, best_start
from sysid_btr.identify.study import Study
from sysid_btr.terms.effect import Effect
from sysid_btr.terms.model import Model
from sysid_btr.terms.scales import largest_scale

UNREACHED = 1e-6
"""Fraction of the loss that a limit must prevent to be one that is reached."""


def with_reached_limits(study: Study, model: Model) -> tuple[Model, int]:
    """The model with those limits set that fit the log better than none, and the candidates simulated.

    Parameters
    ----------
    study : whose training data decide.
    model : where a search begins; limits that are not at their neutral value stay.
    """
    tries = list(_tries(study, model))
    if not tries:
        return model, 0
    rows = np.tile(model.values, (len(tries), 1))
    for row, (columns, values) in zip(rows, tries, strict=True):
        row[columns] = values
    loss = study.train_problem(model).loss(np.vstack([model.values, rows]))
    better: dict[int, int] = {}
    for i, (columns, _) in enumerate(tries):
        best = loss[1 + better.get(int(columns[0]), -1)]
        if loss[1 + i] < min(NOTICEABLE * loss[0], best):
            better[int(columns[0])] = i
    if not better:
        return model, len(loss)
    together = model.values.copy()
    for i in better.values():
        together[tries[i][0]] = tries[i][1]
    alone = rows[min(better.values(), key=lambda i: loss[1 + i])]
    start = best_start(study, model.terms, np.stack([model.values, together, alone]))
    return model.at(start), len(loss) + 3


def without_unreached_limits(study: Study, model: Model) -> tuple[Model, int]:
    """The model with limits at their neutral value where this loses nothing, and the candidates simulated.

    Parameters
    ----------
    study : whose training data decide.
    model : fitted, with limits that a search may have left above everything that happens.
    """
    free = model.values.copy()
    rows = []
    for columns, neutral in _limits(model):
        if not np.array_equal(model.values[columns], neutral):
            rows.append(model.values.copy())
            rows[-1][columns] = neutral
    if not rows:
        return model, 0
    loss = study.train_problem(model).loss(np.stack([model.values, *rows]))
    if not (loss[1:] <= loss[0] * (1 + UNREACHED)).any():
        return model, len(loss)
    for row, without in zip(rows, loss[1:], strict=True):
        if without <= loss[0] * (1 + UNREACHED):
            free = np.where(row != model.values, row, free)
    return model.at(free), len(loss)


def _limits(model: Model) -> Iterator[tuple[IntArray, FloatArray]]:
    """Numbers of each limit at each place, by position, and their neutral values."""
    for term in model.terms:
        if isinstance(term, Effect) and term.is_threshold():
            columns = np.arange(len(model.values))[model.terms.columns(term)].reshape(len(term.groups), -1)
            yield from zip(columns, term.neutral.reshape(columns.shape), strict=True)


def _tries(study: Study, model: Model) -> Iterator[tuple[IntArray, FloatArray]]:
    """Numbers of one limit at one place, by position, and values that they may have."""
    for term in model.terms:
        if not isinstance(term, Effect) or not term.is_threshold():
            continue
        columns = np.arange(len(model.values))[model.terms.columns(term)].reshape(len(term.groups), -1)
        neutral = term.neutral.reshape(columns.shape)
        free = [term.kinds.index(kind) for kind in term.numbers]
        for places, own, none in zip(term.grouped, columns, neutral, strict=True):
            if not np.array_equal(model.values[own], none):
                continue
            points = np.array([probe[0] for probe in term.probes(largest_scale(study.scales, places))])
            # the largest closely: one that is reached for a moment alone shows over a narrow range
            yield from ((own, values[free]) for values in (*term.initial_guesses(points[0]), *points[1:]))
