"""Scores of a model on fitted and on held-out data, channel by channel."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from sysid_btr._typing import FloatArray
from sysid_btr.objectives.problem import ReplayProblem, of_both
from sysid_btr.objectives.targets import COMPARED
from sysid_btr.simulation.silence import silenced
from sysid_btr.terms.model import Model

if TYPE_CHECKING:
    from sysid_btr.identify.study import Study


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
    """Scores by channel.

    Attributes
    ----------
    train, holdout : of fitted and of held-out data, as they are compared with the model.
    whole : of logs that are compared by segments, replayed open loop from the first sample to the last; empty where
        that does not stay bounded.
    """

    train: Mapping[str, ChannelScore]
    holdout: Mapping[str, ChannelScore]
    whole: Mapping[str, ChannelScore] = field(default_factory=dict)

    @property
    def floors(self) -> dict[str, float]:
        """Noise floor of each channel."""
        return {channel: s.floor for channel, s in (self.holdout or self.train).items()}

    def to_dict(self) -> dict[str, Any]:
        """By part and channel, as results have them."""
        whole = {"whole": channel_entries(self.whole)} if self.whole else {}
        return {"train": channel_entries(self.train), "holdout": channel_entries(self.holdout), **whole}


@dataclass(frozen=True)
class Misfit:
    """What a model leaves of data that it was fitted to, where that is more than noise.

    Attributes
    ----------
    channel, joint : where, and at which joint most.
    times_noise : root-mean-square error over the noise floor.
    """

    channel: str
    joint: str
    times_noise: float

    @property
    def words(self) -> str:
        """In a sentence."""
        return (
            f"the residual of the {self.channel} is {self.times_noise:.2g} times its noise, largest at {self.joint}: "
            "the model lacks something (`sysid-btr close` looks for what is missing)"
        )


def misfit_of(part: Mapping[str, ChannelScore], channel: str, tolerated: float) -> Misfit | None:
    """The misfit in one channel of fitted data; None up to a tolerated chi2."""
    one = part.get(channel)
    if one is None or not one.chi2 > tolerated:
        return None
    worst = max(one.joints, key=lambda joint: one.joints[joint])
    return Misfit(channel, worst, float(np.sqrt(one.chi2)))


def channel_entries(part: Mapping[str, ChannelScore]) -> dict[str, dict[str, Any]]:
    """Scores by channel: rmse, nrmse, chi2, and the rmse of each joint."""
    return {
        channel: {"rmse": s.rmse, "nrmse": s.nrmse, "chi2": s.chi2, "joints": dict(s.joints)}
        for channel, s in part.items()
    }


def score(study: Study, model: Model) -> Scores:
    """Score a model on every channel that log and model have, fitted or not."""
    wide = replace(study, channels=COMPARED)
    fitted, heldout = wide.train_problem(model), wide.holdout_problem(model)
    errors = of_both(fitted, heldout, lambda problem: problem.errors(model.values))
    return Scores(_scores(fitted, errors[0]), _scores(heldout, errors[1]), open_loop_scores(wide, model))


def open_loop_scores(study: Study, model: Model) -> dict[str, ChannelScore]:
    """Scores of whole recordings that are compared by segments; empty where one does not stay bounded.

    It does where no joint is predicted worse than by its mean.
    """
    recordings = {id(e.recording): e for e in (*study.train, *study.holdout)}.values()
    whole = tuple(open_loop for e in recordings if (open_loop := e.open_loop) is not None)
    if not whole:
        return {}
    problem = replace(study, train=whole).train_problem(model)
    with silenced():
        error = problem.errors(model.values)
    for i, (_, target, k) in enumerate(problem.columns):
        if target.channel != "position":
            continue
        own, measured = error[problem.column_labels == i], target.measured[target.mask[:, k], k]
        if not np.sqrt(np.mean(own**2)) <= np.std(measured):
            return {}
    return _scores(problem, error)


def score_problem(problem: ReplayProblem, values: FloatArray) -> dict[str, ChannelScore]:
    """Scores of one candidate on one problem's episodes."""
    return _scores(problem, problem.errors(values))


def _scores(problem: ReplayProblem, error: FloatArray) -> dict[str, ChannelScore]:
    """Scores of errors (r,), channel by channel, over all episodes."""
    labels, columns = problem.column_labels, problem.columns
    measured = np.concatenate([t.measured[t.mask] for e in problem.episodes for t in e.targets])
    count, square, signal = (
        np.bincount(labels, weights, len(columns)) for weights in (np.ones(len(error)), error**2, measured**2)
    )
    noise = np.array([t.noise[k] ** 2 for _, t, k in columns])
    result = {}
    for channel in dict.fromkeys(t.channel for _, t, _ in columns):
        own = np.array([t.channel == channel for _, t, _ in columns])
        number = count[own].sum()
        if number == 0:
            continue
        total, size = float(square[own].sum()), float(signal[own].sum())
        joints: dict[str, tuple[float, float]] = {}
        for i in np.flatnonzero(own):
            _, target, k = columns[i]
            before = joints.get(target.joints[k], (0.0, 0.0))
            joints[target.joints[k]] = before[0] + float(square[i]), before[1] + float(count[i])
        result[channel] = ChannelScore(
            rmse=float(np.sqrt(total / number)),
            nrmse=float(np.sqrt(total / size)) if size > 0 else float("inf"),
            chi2=float((square / noise)[own].sum() / number),
            joints={joint: float(np.sqrt(s / max(n, 1.0))) for joint, (s, n) in joints.items()},
            floor=float(np.sqrt((count * noise)[own].sum() / number)),
        )
    return result
