"""Segments whose starts are known within an uncertainty: what that uncertainty explains does not count.

With residuals r + J d, d the start's error in standard deviations and r white, the residual's covariance is
S = I + J J'. Whitening by the symmetric root of its inverse is the likelihood with the start integrated out
(to first order), and leaves each sample recognisable.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from sysid_btr._typing import FloatArray, IntArray

if TYPE_CHECKING:
    from sysid_btr.objectives.targets import Target


@dataclass(frozen=True, eq=False)
class Marginal:
    """What the starts of segments can do to the sensors.

    Attributes
    ----------
    rows : (w, 2) first sample of each segment, and the one after its last.
    responses : for each segment, channel -> (d, samples, joints of the replay): change of the sensors under one
        standard deviation of each coordinate of the start.
    weight : (w,) how much a segment counts; below one where the model cannot explain it.
    shift : (w, d) where the starts lie already, in standard deviations from the mean of what is known of them.
    """

    rows: IntArray
    responses: tuple[Mapping[str, FloatArray], ...]
    weight: FloatArray
    shift: FloatArray

    def chosen(self, which: IntArray) -> Marginal:
        """Some of the segments."""
        return Marginal(
            self.rows[which], tuple(self.responses[i] for i in which), self.weight[which], self.shift[which]
        )

    def shifted(self, rows: int) -> Marginal:
        """The same segments in a log that begins so many samples later."""
        return Marginal(self.rows - rows, self.responses, self.weight, self.shift)


@dataclass(frozen=True, eq=False)
class Projection:
    """The whitening of one segment's part of a residual vector.

    Attributes
    ----------
    columns : (k,) positions in the residual vector.
    basis : (k, d) orthonormal directions that the start moves.
    gain : (d,) standard deviation along them, in noise.
    offset : (k,) change of the residual from the start as simulated to the one expected beforehand.
    weight : of the segment.
    """

    columns: IntArray
    basis: FloatArray
    gain: FloatArray
    offset: FloatArray
    weight: float

    def whiten(self, part: FloatArray) -> FloatArray:
        """Residuals (m, k) with the start integrated out."""
        # one product a candidate: the bits of a product of all would depend on how many there are
        expected = np.ascontiguousarray(part + self.offset)[:, None]
        shrink = 1 - 1 / np.sqrt(1 + self.gain**2)
        known = ((expected @ self.basis) * shrink) @ self.basis.T
        return np.asarray(self.weight * (expected - known)[:, 0])


def sensitivity(marginal: Marginal, segment: int, targets: Sequence[Target]) -> tuple[IntArray, FloatArray]:
    """Positions of a segment's samples in the residual vector, (k,), and their whitened responses, (k, d)."""
    a, b = marginal.rows[segment]
    columns, parts, offset = [], [], 0
    for target in targets:
        sample, joint = np.nonzero(target.mask)
        own = np.flatnonzero((sample >= a) & (sample < b))
        response = marginal.responses[segment][target.channel]
        columns.append(own + offset)
        # a residual is measured minus predicted
        moved = -response[:, sample[own] - a, target.columns[joint[own]]] / target.sigma[joint[own]]
        parts.append(moved.T)
        offset += len(sample)
    return np.concatenate(columns), np.concatenate(parts)


def projections(marginal: Marginal, targets: Sequence[Target]) -> tuple[Projection, ...]:
    """Whitening of every segment, for given noise levels."""
    result = []
    for w in range(len(marginal.rows)):
        columns, moved = sensitivity(marginal, w, targets)
        values, vectors = np.linalg.eigh(moved.T @ moved)
        keep = values > 1e-9 * max(float(values[-1]), 1e-300)
        gain = np.sqrt(values[keep])
        basis = moved @ vectors[:, keep] / gain
        result.append(Projection(columns, basis, gain, -moved @ marginal.shift[w], float(marginal.weight[w])))
    return tuple(result)
