"""Errors that come back with every stride: more walking does not average them away."""

from __future__ import annotations

import numpy as np

from sysid_btr._typing import BoolArray, FloatArray, IntArray
from sysid_btr.floating_base.feet import base_body, touching_bodies, up_to_base
from sysid_btr.floating_base.segments import FEWEST, FloatingReplay
from sysid_btr.floating_base.size import BodySize, measure_size
from sysid_btr.io.log import Log
from sysid_btr.objectives.covariance import covariance, spread
from sysid_btr.objectives.problem import ReplayProblem
from sysid_btr.simulation.segments import segment_seconds


def repeated_error(problem: ReplayProblem, jacobian: FloatArray, residual: FloatArray) -> FloatArray:
    """Standard deviation of estimates, (p,), from errors that come back with every stride, beyond that of noise.

    Every stride repeats what the model of the contact does wrong, and what the reconstruction of the base does: the
    stretches of a walk are no independent pieces, however long it is. Independent are the phases of the gait, and the
    joints: where they disagree on a parameter, more walking does not settle it. Added to a covariance over stretches
    of time this is clustering several ways (Cameron, Gelbach, Miller 2011, doi:10.1198/jbes.2010.07136). Few pieces
    know their own spread badly: each part is scaled to the normal distribution.

    Parameters
    ----------
    problem : in which at least one log is a walk.
    jacobian, residual : (r, p) and (r,), whitened.
    """
    from scipy.stats import norm, t

    walked = walked_residuals(problem)
    # other logs have no such errors; what they know holds the estimates all the same
    residual = np.where(walked, residual, 0.0)
    noise = np.diag(covariance(jacobian, residual, np.arange(len(residual)) // SHORT))
    total = np.zeros(len(noise))
    for pieces in (problem.column_labels, _phases(problem)):
        if pieces is None or len(np.unique(pieces[walked])) < FEWEST:
            continue
        pieces = np.where(walked, pieces, pieces.max() + 1 + problem.blocks)
        cov, dof = spread(jacobian, residual, pieces)
        with np.errstate(invalid="ignore"):
            beyond = np.nan_to_num(np.diag(cov) - noise, posinf=0.0, neginf=0.0)
        total += np.maximum(beyond, 0.0) * (t.ppf(0.975, dof) / norm.ppf(0.975)) ** 2
    return np.asarray(np.sqrt(total))


SHORT = 8
"""Residuals in a row that make a piece where all are taken for independent."""


def of_legs(problem: ReplayProblem) -> BoolArray:
    """(p,) whether a parameter is of a body between the base and the ground of a walk, or of the ground itself."""
    walk = next((e.replay for e in problem.episodes if isinstance(e.replay, FloatingReplay)), None)
    if walk is None:
        return np.zeros(len(problem.parameters), dtype=bool)
    model = walk.model
    feet = [model.body(foot.name).id for foot in touching_bodies(model)]
    legs = {model.body(b).name for foot in feet for b in up_to_base(model, foot)} - {model.body(base_body(model)).name}
    result: list[bool] = []
    for term in problem.terms:
        for places in term.grouped:
            own = term.location == "body" and not legs.isdisjoint(places)
            result += [own or term.name.startswith("foot_")] * len(term.numbers)
    return np.array(result)


GROUND, GROUND_MASS = 4.0, 0.5
"""Root-mean-square error of what belongs to legs and feet over its standard error from the strides of one log by the
model's ground, and for masses of legs (as factors of the nominal) that error itself: on 11 own walks over another
ground it was 0.31 of a shank, 0.60 of a thigh, 0.51 of a hip, whatever the strides gave (`benchmarks.ground`). No part
of a log disagrees with what its ground does everywhere. Arms and gains need nothing: 0.6 to 0.9 of that standard
error."""


def walked_residuals(problem: ReplayProblem) -> BoolArray:
    """(r,) whether a residual is of a log of a free base."""
    free = [problem.episodes[i].replay.log.meta.mount == "free" for i, _, _ in problem.columns]
    return np.array(free)[problem.column_labels]


def _phases(problem: ReplayProblem) -> IntArray | None:
    """(r,) phase of the gait of the segment that each residual belongs to; None where no gait repeats."""
    labels, found, first = [], False, 0
    for comparison in problem.episodes:
        replay, log = comparison.replay, comparison.replay.log
        length = stride(log, measure_size(replay.model)) if isinstance(replay, FloatingReplay) else None
        # what repeats in no stride is in pieces of its own
        phase = ((log.time - log.time[0]) / (2 * comparison.stretch)).astype(np.int64)
        if length is not None and isinstance(replay, FloatingReplay) and replay.segments is not None:
            found = True
            count = max(round(length / segment_seconds(replay.segments, log)), FEWEST)
            for a, b in replay.segments.rows:
                middle = 0.5 * (log.time[a] + log.time[b - 1]) - log.time[0]
                phase[a:b] = int(count * np.mod(middle / length, 1.0))
        labels += [(first + np.broadcast_to(phase[:, None], t.mask.shape))[t.mask] for t in comparison.targets]
        first += int(phase.max()) + 1
    return np.concatenate(labels) if found else None


def stride(log: Log, size: BodySize) -> float | None:
    """Time after which the commands of a walk repeat, s; None where they do not."""
    step = float(np.median(np.diff(log.time)))
    moving = np.stack([c for n, c in log.channels.items() if n.startswith("command.")], axis=1)
    moving = np.nan_to_num(moving - np.nanmean(moving, axis=0))
    moving = moving[:, np.std(moving, axis=0) > STILL]
    shortest, longest = (round(size.time(s) / step) for s in STRIDES)
    lags = np.arange(shortest, min(longest, len(moving) // 2))
    if len(lags) < 3 or moving.shape[1] == 0:
        return None
    moving = moving / np.std(moving, axis=0)
    alike = np.array([np.mean(moving[:-k] * moving[k:]) for k in lags])
    inner = alike[1:-1]
    peaks = np.flatnonzero((inner >= alike[:-2]) & (inner >= alike[2:]) & (inner > max(ALIKE, 0.95 * alike.max()))) + 1
    return float(lags[peaks[0]] * step) if len(peaks) else None


STRIDES = (0.3, 3.0)
"""s of a Nao (`BodySize`), between which a stride lasts."""
STILL = 0.01
"""rad, standard deviation of a command below which a joint stands still."""
ALIKE = 0.8
"""Autocorrelation of commands that repeat."""
