"""What the log and the models did in every held-out episode, for whatever draws it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from sysid_btr._typing import BoolArray, FloatArray
from sysid_btr.io.split import spans_of
from sysid_btr.mujoco_conventions import slides
from sysid_btr.objectives.targets import COMPARED, Target
from sysid_btr.terms.model import Model
from sysid_btr.units import CHANNEL_UNITS

if TYPE_CHECKING:
    from sysid_btr.diagnosis.closing import Closing
    from sysid_btr.identify.episode import Episode
    from sysid_btr.identify.fit import Fit
    from sysid_btr.identify.study import Study
    from sysid_btr.posterior.outcome import Posterior
    from sysid_btr.simulation.replay import Replay
    from sysid_btr.terms.base import Outputs

JOINTS_SHOWN = 3
EPISODES_SEARCHED = 8


@dataclass(frozen=True, eq=False)
class Trace:
    """One joint in one episode.

    Attributes
    ----------
    joint : name, with the log's where there are several.
    channel : what is compared.
    unit : of what is compared.
    time : (n,) s since the first sample.
    command, measured : (n,) NaN where missing; the command is a position whatever is compared.
    predicted : name of the model -> (n,), from the plain model to the final one.
    held_out : (n,) samples that were not fitted.
    noise : noise floor of the sensor.
    errors : name of the model -> root-mean-square error of the samples that are scored, as scores have it.
    """

    joint: str
    channel: str
    unit: str
    time: FloatArray
    command: FloatArray
    measured: FloatArray
    predicted: Mapping[str, FloatArray]
    held_out: BoolArray
    noise: float
    errors: Mapping[str, float]

    @property
    def spans(self) -> tuple[tuple[float, float], ...]:
        """Begin and end, s, of what is held out."""
        return spans_of(self.time, self.held_out)

    def residual(self, name: str) -> FloatArray:
        """(m,) log minus model on what is held out; NaN where nothing was measured."""
        return np.asarray((self.measured - self.predicted[name])[self.held_out])

    def error(self, name: str) -> float:
        """Error of one model on what is held out, in noise floors."""
        return self.errors[name] / self.noise


@dataclass(frozen=True, eq=False)
class PlayedEpisode:
    """A held-out episode as the log and each model have it.

    Attributes
    ----------
    label : name of its log where there are several, or empty.
    episode, replay : what was replayed, and of the plain model.
    outputs : name of the model -> what its sensors show.
    traces : of every sensor; those of the channel that pictures speak of first.
    """

    label: str
    episode: Episode
    replay: Replay
    outputs: Mapping[str, Outputs]
    traces: tuple[Trace, ...]


@dataclass(frozen=True, eq=False)
class Played:
    """Held-out episodes as the log and each model have them.

    Attributes
    ----------
    episodes : `EPISODES_SEARCHED` at most.
    models : their names, from the plain to the final one.
    rank_by : that whose error says which joints are worst.
    """

    episodes: tuple[PlayedEpisode, ...]
    models: tuple[str, ...]
    rank_by: str

    def worst(self, count: int = JOINTS_SHOWN) -> tuple[Trace, ...]:
        """The joints whose leading channel is farthest off, worst first; with their log where there are several."""
        found = [
            replace(trace, joint=f"{trace.joint} ({item.label})" if item.label else trace.joint)
            for item in self.episodes
            for trace in item.traces
            if trace.channel == item.traces[0].channel
        ]
        return tuple(sorted(found, key=lambda trace: -trace.error(self.rank_by))[:count])


def trace_outcome(outcome: Fit | Closing) -> tuple[Trace, ...]:
    """The worst joints of a fit or a closing, worst first.

    They are those where the plain model is farthest off on held-out data, in noise floors; in a closing
    those where the fitted parameters still are.
    """
    return play(outcome).worst()


def play(outcome: Fit | Closing | Posterior) -> Played:
    """Replay the held-out episodes of an outcome under each model, from the plain to the final one."""
    from sysid_btr.diagnosis.closing import Closing
    from sysid_btr.identify.fit import Fit

    if not isinstance(outcome, Closing):
        final = "fitted" if isinstance(outcome, Fit) else "posterior mean"
        models = {"plain model": Model.of(outcome.model.terms), final: outcome.model}
        return _play(outcome.study, models, "plain model")
    models = {"plain model": Model.of(()), "parameters fitted": outcome.before_model}
    if outcome.effects:
        models["effects added"] = outcome.model
    return _play(outcome.study, models, "parameters fitted")


def _play(study: Study, models: Mapping[str, Model], rank_by: str) -> Played:
    wide = replace(study, channels=COMPARED)
    held_out = study.holdout[:EPISODES_SEARCHED]
    under = {name: wide.holdout_problem(model).episodes for name, model in models.items()}
    plain = wide.holdout_problem(()).episodes
    episodes = []
    for i, episode in enumerate(held_out):
        own = {name: under[name][i].replay.predict(model.values[None]) for name, model in models.items()}
        errors = {name: under[name][i].errors(outputs) for name, outputs in own.items()}
        traces = [
            trace
            for t, target in enumerate(plain[i].targets)
            for trace in _traces(episode, plain[i].replay, target, own, {name: e[t] for name, e in errors.items()})
        ]
        traces.sort(key=lambda trace: _rank(trace.channel, study.channels))
        path = episode.log.path
        label = path.stem if len(study.holdout) > 1 and path is not None else ""
        episodes.append(PlayedEpisode(label, episode, plain[i].replay, own, tuple(traces)))
    return Played(tuple(episodes), tuple(models), rank_by)


def _rank(channel: str, fitted: Sequence[str]) -> int:
    return fitted.index(channel) if channel in fitted else len(fitted)


def _traces(
    episode: Episode, replay: Replay, target: Target, outputs: Mapping[str, Outputs], errors: Mapping[str, FloatArray]
) -> Iterator[Trace]:
    log = episode.log
    predicted = {name: target.predicted(own)[0] for name, own in outputs.items()}
    for k, joint in enumerate(target.joints):
        yield Trace(
            joint=joint,
            channel=target.channel,
            unit=CHANNEL_UNITS[target.channel][slides(replay.model, joint)],
            time=log.time - log.time[0],
            command=log.channels.get(f"command.{joint}", np.full(len(log), np.nan)),
            measured=target.measured[:, k],
            predicted={name: p[:, k] for name, p in predicted.items()},
            held_out=episode.scored[: len(log)],
            noise=float(target.noise[k]),
            errors={name: _root_mean_square(error[:, k]) for name, error in errors.items()},
        )


def _root_mean_square(error: FloatArray) -> float:
    """Of what is known; infinite where nothing is, which is of a replay that diverged."""
    known = error[np.isfinite(error)]
    return float(np.sqrt(np.mean(known**2))) if len(known) else float("inf")
