"""Initial states of segments: what their uncertainty does to the sensors, and where the data want them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sysid_btr._typing import FloatArray
from sysid_btr.objectives.marginal import Marginal, projections, sensitivity
from sysid_btr.objectives.problem import Comparison
from sysid_btr.objectives.targets import Target
from sysid_btr.simulation.numerics import Numerics
from sysid_btr.simulation.segments import SegmentReplay, Segments
from sysid_btr.simulation.silence import silenced


def update_initial_states(
    replay: SegmentReplay,
    targets: tuple[Target, ...],
    before: Marginal | None,
    values: FloatArray,
    coarse: Numerics,
    *,
    anew: bool = True,
    weigh: bool = False,
    damped: bool = False,
) -> tuple[Segments, Marginal]:
    """Move the initial states of segments to where the data want them, and find what they leave open.

    One Gauss-Newton step for each segment, with the reconstructed state as its prior.

    Parameters
    ----------
    replay, targets, before : of the same episode; what is known of the initial states so far.
    values : (p,) the candidate.
    coarse : integrator and step for derivatives with respect to the initial states.
    anew : whether derivatives that are known are taken again.
    weigh : whether segments count by what is left in them.
    damped : whether a step is taken only as far as it helps: long segments are not linear in their starts.
    """
    assert replay.segments is not None
    segments, marginal = replay.segments, before
    w, coordinates = segments.std.shape
    if anew or marginal is None:
        # scores are of all channels, fitted or not
        effort = replay.effort or any(replay.log.has("effort", j) for j in replay.index.joints)
        marginal = respond(replace(replay, numerics=coarse, effort=effort), values)
        if before is not None:
            marginal = replace(marginal, shift=before.shift)
    # sigma of the noise itself: how well a segment is explained must not depend on what others leave
    plain = tuple(replace(t, sigma=t.noise) for t in targets)
    white = Comparison(replay, plain, marginal).raw(replay.predict(values[None]))[0]
    change = np.zeros((w, coordinates))
    before_shift, shift = marginal.shift, marginal.shift.copy()
    if not np.isfinite(white).all():
        return segments, marginal
    for i in range(w):
        columns, moved = sensitivity(marginal, i, plain)
        information = moved.T @ moved + np.eye(coordinates)
        rest = white[columns] - moved @ shift[i]
        best = -np.linalg.solve(information, moved.T @ rest)
        best = np.clip(best, -FARTHEST, FARTHEST)
        change[i] = (best - shift[i]) * segments.std[i]
        shift[i] = best
    if damped:
        taken = _helpful(replay, plain, values, change, before_shift, shift)[:, None]
        change, shift = taken * change, before_shift + taken * (shift - before_shift)
    segments, marginal = segments.moved(change), replace(marginal, shift=shift)
    if weigh:
        marginal = weighed(marginal, replace(replay, segments=segments), plain, values)
    return segments, marginal


def _helpful(
    replay: SegmentReplay,
    targets: tuple[Target, ...],
    values: FloatArray,
    change: FloatArray,
    before: FloatArray,
    after: FloatArray,
) -> FloatArray:
    """Fraction (w,) of a step of the starts, in `FRACTIONS`, after which data and prior are best together."""
    fractions = np.array(FRACTIONS)
    shifts = before[:, None] + fractions[:, None] * (after - before)[:, None]
    cost = np.sum(shifts**2, axis=2)
    rows = replay._segments.rows
    with silenced():
        for w, outputs in replay.respond(values, fractions[:, None] * change[:, None]):
            a, b = rows[w]
            for target in targets:
                seen: FloatArray = getattr(outputs, target.channel)[:, :, target.columns]
                left = (target.measured[a:b] - seen) / target.noise
                cost[w] += np.sum(np.where(target.mask[a:b], left, 0.0) ** 2, axis=(1, 2))
    return np.asarray(fractions[np.argmin(np.nan_to_num(cost, nan=np.inf), axis=1)])


FRACTIONS = (0.0, 0.03, 0.1, 0.3, 1.0)
"""Of a Gauss-Newton step of the starts that are tried."""
USUAL, LEAST_WEIGHT = 0.3, 0.02
"""Quantile of the segments' chi2 up to which they count in full, and the least that a segment counts."""
FARTHEST = 3.0
"""Standard deviations by which an initial state is moved at most."""


def weighed(marginal: Marginal, replay: SegmentReplay, targets: tuple[Target, ...], values: FloatArray) -> Marginal:
    """Count each segment by the size of the error that is left in it: a missed impact is no evidence.

    Only segments that are worse than most are counted less: an error in all of them is to be found, not hidden.
    """
    plain = replace(marginal, weight=np.ones(len(marginal.rows)))
    white = Comparison(replay, targets, plain).whitened(replay.predict(values[None]))[0]
    chi2 = np.array([np.mean(white[p.columns] ** 2) for p in projections(plain, targets)])
    chi2 = np.nan_to_num(chi2, nan=np.inf)
    usual = max(float(np.quantile(chi2, USUAL)), 1.0)
    return replace(plain, weight=np.clip(np.sqrt(usual / chi2), LEAST_WEIGHT, 1.0))


def respond(replay: SegmentReplay, values: FloatArray) -> Marginal:
    """Derivatives of all sensors with respect to the initial states of all segments."""
    segments = replay.segments
    assert segments is not None
    lanes = replay.lanes()
    w, coordinates = segments.std.shape
    directions = np.zeros((w, len(lanes) + 1, coordinates))
    for k, lane in enumerate(lanes):
        for coordinate, _ in lane:
            directions[:, k, coordinate] = segments.std[:, coordinate]
    responses: list[dict[str, FloatArray]] = [{} for _ in range(w)]
    channels = ("position", "velocity", *(("effort",) if replay.effort else ()))
    with silenced():
        for i, outputs in replay.respond(values, directions):
            for channel in channels:
                array: FloatArray = getattr(outputs, channel)
                change = np.nan_to_num(array[:-1] - array[-1:])
                table = np.zeros((coordinates, *change.shape[1:]))
                for k, lane in enumerate(lanes):
                    for coordinate, seen in lane:
                        table[coordinate][:, seen] = change[k][:, seen]
                responses[i][channel] = table
    return Marginal(segments.rows, tuple(responses), np.ones(w), np.zeros((w, coordinates)))
