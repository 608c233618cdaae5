"""Scores of a model on fitted and on held-out data, channel by channel."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from sysid_btr._typing import FloatArray
from sysid_btr.models.modifier import Modifier
from sysid_btr.objectives.targets import COMPARED

if TYPE_CHECKING:
    from sysid_btr.identify.study import Study
    from sysid_btr.objectives.problem import ReplayProblem


@dataclass(frozen=True)
class ChannelScore:
    """Error of one channel over all its joints.

    Attributes
    ----------
    rmse : root-mean-square error, SI.
    nrmse : norm of the error over the norm of the measured signal.
    chi2 : mean square of error over noise floor; 1 at the floor.
    joints : rmse of each joint.
    floor : noise floor in the same unit.
    """

    rmse: float
    nrmse: float
    chi2: float
    joints: Mapping[str, float]
    floor: float


@dataclass(frozen=True)
class Scores:
    """Scores by channel on fitted (`train`) and held-out data."""

    train: Mapping[str, ChannelScore]
    holdout: Mapping[str, ChannelScore]


def score(study: Study, modifiers: Sequence[Modifier], values: FloatArray) -> Scores:
    """Score one candidate on every channel that log and model have, fitted or not."""
    from dataclasses import replace

    wide = replace(study, channels=COMPARED)
    return Scores(
        train=score_problem(wide.train_problem(modifiers), values),
        holdout=score_problem(wide.holdout_problem(modifiers), values),
    )


def score_problem(problem: ReplayProblem, values: FloatArray) -> dict[str, ChannelScore]:
    """Scores of one candidate on one problem's episodes."""
    squares: dict[str, dict[str, float]] = {}
    counts: dict[str, dict[str, int]] = {}
    signal: dict[str, float] = {}
    chi2: dict[str, float] = {}
    floor: dict[str, float] = {}
    for episode in problem.episodes:
        outputs = episode.replay.predict(values[None])
        for target, error in zip(episode.targets, episode.errors(outputs), strict=True):
            for k, joint in enumerate(target.joints):
                good = target.mask[:, k]
                channel = target.channel
                e = error[good, k]
                by_joint = squares.setdefault(channel, {})
                by_joint[joint] = by_joint.get(joint, 0.0) + float(e @ e)
                number = counts.setdefault(channel, {})
                number[joint] = number.get(joint, 0) + len(e)
                measured = target.measured[good, k]
                signal[channel] = signal.get(channel, 0.0) + float(measured @ measured)
                noise = target.noise[k]
                chi2[channel] = chi2.get(channel, 0.0) + float(e @ e) / noise**2
                floor[channel] = floor.get(channel, 0.0) + len(e) * noise**2
    result = {}
    for channel, by_joint in squares.items():
        total, number_all = sum(by_joint.values()), sum(counts[channel].values())
        if number_all == 0:
            continue
        result[channel] = ChannelScore(
            rmse=float(np.sqrt(total / number_all)),
            nrmse=float(np.sqrt(total / signal[channel])) if signal[channel] > 0 else float("inf"),
            chi2=chi2[channel] / number_all,
            joints={j: float(np.sqrt(s / max(counts[channel][j], 1))) for j, s in by_joint.items()},
            floor=float(np.sqrt(floor[channel] / number_all)),
        )
    return result
