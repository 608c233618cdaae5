"""What a replay is compared with: measured channels of one episode, their noise, and which samples count."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from sysid_btr._typing import BoolArray, FloatArray, IntArray
from sysid_btr.errors import ModelError
from sysid_btr.io.noise import NoiseFloor, channel_noise
from sysid_btr.terms.base import Outputs

if TYPE_CHECKING:
    from sysid_btr.io.log import Log

COMPARED = ("position", "velocity", "effort")
"""Channels a replay can predict."""
FITTED = ("position", "effort")
"""Channels fitted by default. A logged velocity is usually the encoder's, filtered: compared, not fitted."""
WARM_UP = 0.3
"""Seconds after the start in which the estimated initial state still shows; not scored."""


@dataclass(frozen=True, eq=False)
class Target:
    """One channel of one episode.

    Attributes
    ----------
    channel : ``position``, ``velocity`` or ``effort``.
    joints : (k,) names.
    columns : (k,) their positions among the joints of the replay.
    measured : (n, k), NaN where missing.
    floor : (k,) noise floor of each column.
    sigma : (k,) standard deviation that whitens the residual; at least the noise floor.
    mask : (n, k) samples that count.
    """

    channel: str
    joints: tuple[str, ...]
    columns: IntArray
    measured: FloatArray
    floor: tuple[NoiseFloor, ...]
    sigma: FloatArray
    mask: BoolArray

    @property
    def noise(self) -> FloatArray:
        """(k,) noise floor."""
        return np.array([f.sigma for f in self.floor])

    def predicted(self, outputs: Outputs) -> FloatArray:
        """(m, n, k) of this channel in a replay's outputs."""
        array: FloatArray | None = getattr(outputs, self.channel)
        if array is None:
            raise ValueError(f"the replay predicts no {self.channel}")
        return array[:, : len(self.measured), self.columns]

    def residual(self, outputs: Outputs) -> FloatArray:
        """(m, n, k) measured minus predicted, zero where a sample does not count."""
        difference = self.measured - self.predicted(outputs)
        difference[:, ~self.mask] = 0.0
        return difference

    def only(self, keep: BoolArray) -> Target:
        """The same target of some of its columns, (k,)."""
        return replace(
            self,
            joints=tuple(j for j, kept in zip(self.joints, keep, strict=True) if kept),
            columns=self.columns[keep],
            measured=self.measured[:, keep],
            floor=tuple(f for f, kept in zip(self.floor, keep, strict=True) if kept),
            sigma=self.sigma[keep],
            mask=self.mask[:, keep],
        )

    def window(self, start: float, stop: float, time: FloatArray) -> Target:
        """The same target, scored only in start <= time < stop (s since the first sample)."""
        inside = (time >= start) & (time < stop)
        return replace(self, mask=self.mask & inside[:, None])


def make_targets(
    log: Log, joints: tuple[str, ...], channels: tuple[str, ...], warm_up: float = WARM_UP
) -> tuple[Target, ...]:
    """Targets of one episode for every channel that both the log and the model have.

    Raises
    ------
    ModelError
        If the log shares no measured joint with the model.
    """
    return log.once(("targets", joints, channels, warm_up), lambda: _make_targets(log, joints, channels, warm_up))


def _make_targets(log: Log, joints: tuple[str, ...], channels: tuple[str, ...], warm_up: float) -> tuple[Target, ...]:
    time = log.time - log.time[0]
    targets = []
    for channel in channels:
        names = tuple(j for j in joints if log.has(channel, j))
        if not names:
            continue
        measured = log.array(channel, names)
        floor = tuple(channel_noise(log, f"{channel}.{name}") for name in names)
        mask = np.isfinite(measured) & (time >= min(warm_up, 0.1 * time[-1]))[:, None]
        if channel == "effort":
            mask[-1] = False  # the replay ends here: the command of this sample is not replayed
        columns = np.array([joints.index(n) for n in names], dtype=np.int64)
        sigma = np.array([f.sigma for f in floor])
        targets.append(Target(channel, names, columns, measured, floor, sigma, mask).only(mask.any(axis=0)))
    if not targets and log.is_motion:
        raise ModelError(
            f"log {log.path or ''} is an excitation trajectory, not a recording: it has only commands, and nothing to "
            "compare a replay with. Give the log that was recorded while the robot executed it."
        )
    if not targets:
        have = ", ".join(log.joints("position")) or "none"
        raise ModelError(
            f"log {log.path or ''}: no measured position belongs to a joint of the model. "
            f"Positions in the log: {have}. Joints of the model: {', '.join(joints)}. "
            "Rename the log's columns, or give the model of this robot."
        )
    return tuple(targets)
