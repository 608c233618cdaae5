"""Initial states of segments: what their uncertainty does to the sensors, and where the data want them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sysid_btr._typing import FloatArray, IntArray
from sysid_btr.floating_base.feet import touching_bodies, up_to_base
from sysid_btr.objectives.marginal import Marginal, projections, sensitivity
from sysid_btr.objectives.problem import Comparison
from sysid_btr.objectives.targets import Target
from sysid_btr.simulation.numerics import Numerics
from sysid_btr.simulation.segments import BASE, SegmentReplay, Segments
from sysid_btr.simulation.silence import silenced


def update_initial_states(
    replay: SegmentReplay,
    targets: tuple[Target, ...],
    before: Marginal | None,
    values: FloatArray,
    coarse: Numerics,
    *,
    anew: bool = True,
) -> tuple[Segments, Marginal]:
    """Move the initial states of segments to where the data want them, and find what they leave open.

    One Gauss-Newton step for each segment, with the reconstructed state as its prior.

    Parameters
    ----------
    replay, targets, before : of the same episode; what is known of the initial states so far.
    values : (p,) the candidate.
    coarse : integrator and step for derivatives with respect to the initial states.
    anew : whether derivatives that are known are taken again.
    """
    assert replay.segments is not None
    segments, marginal = replay.segments, before
    w, coordinates = segments.std.shape
    if anew or marginal is None:
        marginal = respond(replace(replay, numerics=coarse), values)
        if before is not None:
            marginal = replace(marginal, shift=before.shift)
    # sigma of the noise itself: how well a segment is explained must not depend on what others leave
    plain = tuple(replace(t, sigma=t.noise) for t in targets)
    white = Comparison(replay, plain, marginal).raw(replay.predict(values[None]))[0]
    change = np.zeros((w, coordinates))
    shift = marginal.shift.copy()
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
    segments, marginal = segments.moved(change), replace(marginal, shift=shift)
    return segments, weighed(marginal, replace(replay, segments=segments), plain, values)


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
    lanes = start_lanes(replay)
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


def start_lanes(replay: SegmentReplay) -> list[list[tuple[int, IntArray]]]:
    """Coordinates of an initial state that one simulation can vary together: (coordinate, joints that it moves).

    Limbs without a foot hang on the base; what happens in one of them hardly moves the others.
    """
    model, index = replay.model, replay.index
    joints = len(index.joints)
    everything = np.arange(joints)
    feet = {model.body(f.name).id for f in touching_bodies(model)}

    standing = {up_to_base(model, b)[-1] for b in feet}
    own = [up_to_base(model, int(b))[-1] for b in index.body]
    lanes = [[(c, everything)] for c in (2, 3, 4, *range(6, BASE))]
    hanging: dict[int, list[int]] = {}
    for j, b in enumerate(own):
        if b in standing:
            lanes += [[(BASE + j, everything)], [(BASE + joints + j, everything)]]
        else:
            hanging.setdefault(b, []).append(j)
    for k in range(max((len(m) for m in hanging.values()), default=0)):
        members = [(m[k], np.array(m)) for m in hanging.values() if k < len(m)]
        lanes += [[(BASE + j, seen) for j, seen in members], [(BASE + joints + j, seen) for j, seen in members]]
    return lanes
