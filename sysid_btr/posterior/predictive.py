"""What the posterior predicts of held-out data, and whether the data lie where it says."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from sysid_btr._typing import BoolArray, FloatArray
from sysid_btr.mujoco_conventions import slides
from sysid_btr.units import CHANNEL_UNITS

if TYPE_CHECKING:
    import mujoco

    from sysid_btr.identify.study import Study
    from sysid_btr.objectives.problem import ReplayProblem
    from sysid_btr.terms.model import Model

WIDTH = 1.959963984540054
"""Standard deviations of a 95 % band."""


@dataclass(frozen=True, eq=False)
class Band:
    """Prediction of one sensor on one held-out episode.

    Attributes
    ----------
    channel, joint : what is predicted; the joint with the log's name where there are several.
    unit : of both.
    time : (n,) s since the first sample.
    measured : (n,) NaN where missing.
    mean, spread : (n,) of the replays under draws of the posterior: what is not known of the parameters.
    error : standard deviation of the fitted model's error on the data it was fitted to, at least the noise floor.
    held_out : (n,) samples that count.
    draws : (m, n) the replays under draws of the posterior; NaN where one diverges.
    """

    channel: str
    joint: str
    unit: str
    time: FloatArray
    measured: FloatArray
    mean: FloatArray
    spread: FloatArray
    error: float
    held_out: BoolArray
    draws: NDArray[np.float32]

    @property
    def half_width(self) -> FloatArray:
        """(n,) half the 95 % band of what the sensor will show."""
        return np.asarray(WIDTH * np.hypot(self.spread, self.error))

    @property
    def inside(self) -> BoolArray:
        """(held-out samples,) whether each lies in the band."""
        off = np.abs(self.measured - self.mean)[self.held_out]
        return np.asarray(off <= self.half_width[self.held_out])

    @property
    def surprise(self) -> float:
        """Root-mean-square of the held-out error over the band's standard deviation; 1 is as it should be."""
        off = (self.measured - self.mean)[self.held_out] / np.hypot(self.spread, self.error)[self.held_out]
        return float(np.sqrt(np.mean(off**2))) if len(off) else 0.0


def predict_bands(study: Study, model: Model, draws: FloatArray) -> tuple[Band, ...]:
    """Bands of every fitted sensor on every held-out episode.

    Parameters
    ----------
    study : as fitted.
    model : whose error on the fitted data is taken for that of its predictions.
    draws : (m, p) of the posterior; those that diverge are left out.
    """
    error = _fitted_error(study.train_problem(model), model.values)
    bands = []
    several = len(study.holdout) > 1
    for episode in study.holdout_problem(model).episodes:
        log = episode.replay.log
        sums = [np.zeros((3, *t.mask.shape)) for t in episode.targets]
        kept = [np.empty((len(draws), *t.mask.shape), dtype=np.float32) for t in episode.targets]
        for rows, outputs in episode.replay.chunks(draws):
            for total, all_shown, target in zip(sums, kept, episode.targets, strict=True):
                shown = target.predicted(outputs)
                all_shown[rows] = shown
                shown = shown[np.isfinite(shown[:, target.mask]).all(axis=1)]
                # about the measured signal: sums of squares of small numbers lose no digits
                off = np.nan_to_num(shown) - np.nan_to_num(target.measured)
                total += np.stack([np.full(target.mask.shape, float(len(off))), off.sum(0), (off**2).sum(0)])
        label = f" ({log.path.stem})" if several and log.path is not None else ""
        for (count, first, second), all_shown, target in zip(sums, kept, episode.targets, strict=True):
            safe = np.maximum(count, 1.0)
            mean, square = first / safe, second / safe
            spread = np.sqrt(np.maximum(square - mean**2, 0.0))
            center = mean + np.nan_to_num(target.measured)
            for k, joint in enumerate(target.joints):
                bands.append(
                    Band(
                        channel=target.channel,
                        joint=joint + label,
                        unit=_unit(target.channel, episode.replay.model, joint),
                        time=(log.time - log.time[0])[: len(target.measured)],
                        measured=target.measured[:, k],
                        mean=center[:, k],
                        spread=spread[:, k],
                        error=max(error.get((target.channel, joint), 0.0), float(target.noise[k])),
                        held_out=target.mask[:, k],
                        draws=all_shown[:, :, k],
                    )
                )
    return tuple(bands)


def coverage(bands: Sequence[Band]) -> dict[str, float]:
    """Share of held-out samples inside the 95 % bands, by channel."""
    inside: dict[str, list[BoolArray]] = {}
    for band in bands:
        inside.setdefault(band.channel, []).append(band.inside)
    joined = {channel: np.concatenate(parts) for channel, parts in inside.items()}
    return {channel: float(np.mean(all_)) for channel, all_ in joined.items() if len(all_)}


def _fitted_error(problem: ReplayProblem, values: FloatArray) -> Mapping[tuple[str, str], float]:
    """Root-mean-square error of every column on the data that was fitted."""
    squares: dict[tuple[str, str], list[FloatArray]] = {}
    for episode in problem.episodes:
        outputs = episode.replay.predict(values[None])
        for target in episode.targets:
            off = target.measured - target.predicted(outputs)[0]
            for k, joint in enumerate(target.joints):
                squares.setdefault((target.channel, joint), []).append(off[target.mask[:, k], k] ** 2)
    return {key: float(np.sqrt(np.mean(np.concatenate(parts)))) for key, parts in squares.items()}


def _unit(channel: str, model: mujoco.MjModel, joint: str) -> str:
    return CHANNEL_UNITS[channel][slides(model, joint)]
