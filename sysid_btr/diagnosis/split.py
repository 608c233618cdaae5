"""Moving the end of the fitted part, where an effect shows only in what was to be held out."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sysid_btr._typing import FloatArray
from sysid_btr.diagnosis.selection import Selection, hidden_columns
from sysid_btr.identify.refit import Fitted
from sysid_btr.identify.study import Study
from sysid_btr.objectives.problem import BLOCK


def later_split(study: Study, fitted: Fitted, rules: Selection) -> Study | None:
    """The study with half of the held-out excess moved to the fitted part; None where that is no help.

    Parameters
    ----------
    study : as laid out.
    fitted : a model that explains the fitted part, but not the held-out one.
    rules : what counts as explained, and how much may move.

    Returns
    -------
    Study or None
        None if every column that is above its limit when held out is so when fitted, or if the logs held
        out are others than those fitted.
    """
    others = all(episode.scored[0] for episode in study.holdout)
    if others or not study.procedure.moves_split or len(fitted.train_columns) != len(fitted.holdout_columns):
        return None
    hidden = hidden_columns(rules, fitted)
    if hidden is None:
        return None
    problem = study.holdout_problem(fitted.model)
    residual = problem.residuals(fitted.model.values[None])[0]
    labels = problem.column_labels
    excess = np.where(hidden[labels], residual**2 * problem.inflation[labels] - 1, 0.0)
    by_block = np.bincount(problem.blocks, np.nan_to_num(excess))
    train, holdout, first = list(study.train), list(study.holdout), 0
    for i, episode in enumerate(study.holdout):
        time = episode.log.time - episode.log.time[0]
        count = int(time[-1] / BLOCK) + 1
        cut = cut_time(np.maximum(by_block[first : first + count], 0.0), episode.begin, float(time[-1]), rules)
        first += count
        if cut > episode.begin:
            fitted_now = np.arange(len(episode.scored)) < np.searchsorted(time, cut)
            train[i], holdout[i] = train[i].scoring(fitted_now), episode.scoring(~fitted_now)
    if holdout == list(study.holdout):
        return None
    return replace(study, train=tuple(train), holdout=tuple(holdout))


def cut_time(excess: FloatArray, now: float, end: float, rules: Selection) -> float:
    """Time (s) that halves the excess, or that follows all of it where it is brief."""
    total = float(excess.sum())
    latest = end - rules.least_holdout * end
    if total == 0 or now >= latest:
        return now
    share = np.cumsum(excess) / total
    begin, half, nearly = (int(np.searchsorted(share, s)) for s in (1 - rules.nearly, 0.5, rules.nearly))
    last = nearly if nearly - begin < rules.brief else half
    return min((last + 1) * BLOCK, latest)
