"""A study: robot, logs, what is fitted and what is held out, ready for estimators and for diagnosis."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from sysid_btr._typing import FloatArray
from sysid_btr.errors import ModelError
from sysid_btr.estimators.journal import Journal
from sysid_btr.estimators.lsq import LeastSquares
from sysid_btr.executors.base import HERE, Executor
from sysid_btr.floating_base.walk import (
    FASTEST,
    Walk,
    covered,
    cut_up,
    lay_windows,
    make_replay,
    make_walk,
    settle,
    walk_numerics,
)
from sysid_btr.identify.numerics import choose_numerics
from sysid_btr.io.log import Log
from sysid_btr.io.split import holdout_split, split_episodes
from sysid_btr.models.robot import Robot, joint_names
from sysid_btr.mujoco_conventions import slides
from sysid_btr.objectives.problem import Episode, ReplayProblem
from sysid_btr.objectives.targets import COMPARED, FITTED, WARM_UP, Target, make_targets
from sysid_btr.simulation.compiling import make_index
from sysid_btr.simulation.numerics import Numerics
from sysid_btr.simulation.replay import Replay
from sysid_btr.terms.base import Term
from sysid_btr.terms.grammar import parse_parameters
from sysid_btr.terms.model import Model, Terms, as_model
from sysid_btr.terms.scales import JointScale, Scales

TINY = 1e-9
WIDE_STEP = 2e-2
"""Finite-difference step, fraction of the range, that is wide against the roughness of impacts: at a fifth of it a
third of a derivative by a mass is chance, which passes for information, and drags estimates along."""

ROUGH_STEP = 1e-2
"""The same against teeth that meet: from there on, wider ones tell of no less information."""


@dataclass(frozen=True, eq=False)
class Study:
    """Data and model of an identification, before anything is estimated.

    Attributes
    ----------
    robot : the model.
    train, holdout : episodes; a held-out part of a training log keeps the samples before it, so that its
        replay starts where the log does, and scores only what was not fitted.
    split : (s) for each held-out episode the time from which it is scored.
    channels : channels that are fitted.
    numerics : integrator and step; chosen by a convergence check.
    inflation : (mount, channel, joint) -> factor on its noise floor in what is minimised; 1 where silent. Keeps a
        column that the model cannot explain yet from distorting parameters that others tell. What is wrong about
        the ground is no error of a robot that hangs.
    numerics_error : largest change of a predicted sensor when the step is halved, in noise floors.
    executor : where candidates are simulated.
    journal : record of refits, from which an interrupted search goes on; None keeps none.
    """

    robot: Robot
    train: tuple[Log, ...]
    holdout: tuple[Log, ...]
    split: tuple[float, ...]
    channels: tuple[str, ...]
    numerics: Numerics
    numerics_error: float
    threads: int = 0
    inflation: Mapping[tuple[str, str, str], float] = field(default_factory=dict)
    executor: Executor = HERE
    journal: Journal | None = None

    @cached_property
    def scales(self) -> Scales:
        """Sizes of torques and motions at every joint in the plain model on these logs."""
        return measure_scales(self.robot, self.train, self.numerics, self.threads)

    def declare(self, expressions: Sequence[str]) -> Terms:
        """Terms of the parameters that a user frees."""
        return Terms(parse_parameters(expressions, self.robot, self.scales))

    def train_problem(self, model: Model | Iterable[Term]) -> ReplayProblem:
        """What is fitted, by a search that begins at a model; bare terms begin at their nominal values."""
        model = as_model(model)
        episodes = tuple(self._episode(log, model.terms, self.channels, 0.0) for log in self.train)
        return ReplayProblem(episodes, model.values, self.executor)

    def holdout_problem(self, model: Model | Iterable[Term]) -> ReplayProblem:
        """What is predicted without having been fitted."""
        model = as_model(model)
        episodes = tuple(
            self._episode(log, model.terms, self.channels, begin)
            for log, begin in zip(self.holdout, self.split, strict=True)
        )
        return ReplayProblem(episodes, model.values, self.executor)

    def _episode(self, log: Log, terms: Terms, channels: tuple[str, ...], begin: float) -> Episode:
        robot = self.robot.for_log(log)
        present = tuple(c for c in channels if any(log.has(c, j) for j in joint_names(robot)))
        if isinstance(log, Walk):
            log = log.only(begin)
        replay = make_replay(
            robot, log, terms, self.numerics, effort="effort" in present, threads=self.threads
        )
        targets = make_targets(log, replay.index.joints, present, 0.0 if isinstance(log, Walk) else WARM_UP)
        if not targets:
            raise ModelError(f"log {log.path or ''}: none of the channels {', '.join(channels)} can be compared")
        targets = self.with_inflation(log, targets)
        if begin > 0:
            time = log.time - log.time[0]
            targets = tuple(t.window(begin, np.inf, time) for t in targets)
        if isinstance(log, Walk):
            inside = covered(log)[:, None]
            targets = tuple(replace(t, mask=t.mask & inside) for t in targets)
            return Episode(replay, targets, log.marginal)
        return Episode(replay, targets)

    def with_inflation(self, log: Log, targets: tuple[Target, ...]) -> tuple[Target, ...]:
        """Targets of a log with the noise that columns of its mount are given."""
        mount, factor = log.meta.mount, self.inflation
        if not factor:
            return targets
        return tuple(
            replace(t, sigma=t.noise * [factor.get((mount, t.channel, joint), 1.0) for joint in t.joints])
            for t in targets
        )

    def section(self) -> Journal:
        """What the next search keeps its record in."""
        return Journal() if self.journal is None else self.journal.section()

    @property
    def free(self) -> bool:
        """Whether any log is of a free base."""
        return any(isinstance(log, Walk) for log in (*self.train, *self.holdout))

    @property
    def rough(self) -> Numerics:
        """A cheaper integrator for walks: good enough for first fits and for derivatives by the starts."""
        return Numerics("implicitfast", min(self.numerics.timestep, FASTEST)) if self.free else self.numerics

    @property
    def cheap(self) -> Numerics:
        """Integrator and step of derivatives: a fraction of the cost, and as far off as a step of first order is."""
        if self.free:
            return self.rough
        return replace(self.numerics, integrator="implicitfast") if self.numerics.integrator == "RK4" else self.numerics

    def relaid(self) -> Study:
        """The study with the windows of walks half a window later; held-out walks keep theirs."""
        return replace(
            self,
            train=tuple(
                lay_windows(log, log.seconds, late=0.5) if isinstance(log, Walk) else log for log in self.train
            ),
        )

    def stencil(self, terms: Terms) -> float:
        """Finite-difference step, fraction of a parameter's range: wide where impacts roughen the objective."""
        if self.free:
            return WIDE_STEP
        return ROUGH_STEP if terms.structural else LeastSquares.central_step

    def settled(self, model: Model, *, held: bool = True, anew: bool = True) -> Study:
        """The study with the starts of its windows moved to where the data want them under these parameters.

        `held` says whether those of held-out windows too, which only judge; `anew` whether known derivatives with
        respect to starts are taken again.
        """
        def settled(log: Log, begin: float) -> Log:
            if not isinstance(log, Walk):
                return log
            log = log.only(begin)
            episode = self._episode(log, model.terms, self.channels, begin)
            return settle(log, episode.replay, episode.targets, model.values, self.rough, anew=anew)

        return replace(
            self,
            train=tuple(settled(log, 0.0) for log in self.train),
            holdout=tuple(settled(log, begin) for log, begin in zip(self.holdout, self.split, strict=True))
            if held
            else self.holdout,
        )


def make_study(
    robot: Robot,
    logs: Sequence[Log],
    *,
    holdout: float | Sequence[Log] = 0.3,
    channels: Sequence[str] = FITTED,
    numerics: Numerics | None = None,
    threads: int = 0,
    executor: Executor = HERE,
) -> Study:
    """Lay out an identification.

    Parameters
    ----------
    robot : model.
    logs : recordings to fit; each episode is replayed by itself.
    holdout : the last fraction of each log, or other logs.
    channels : channels to fit, of ``position``, ``velocity``, ``effort``.
    numerics : integrator and step; None chooses by a convergence check on the log.
    threads : worker threads, 0 for all cores.
    executor : where candidates are simulated: this process, or what `open_executor` gives.

    Raises
    ------
    ModelError
        If a log and the model have nothing in common.
    UsageError
        If the held-out fraction is not between 0 and 1.
    """
    episodes = [_ready(robot, e) for log in logs for e in split_episodes(log)]
    train: list[Log] = []
    held: list[Log] = []
    split: list[float] = []
    if isinstance(holdout, int | float):
        for episode in episodes:
            fitted, _ = holdout_split(episode, float(holdout))
            cut = float(episode.time[len(fitted)] - episode.time[0])
            if isinstance(episode, Walk):
                episode = cut_up(robot, episode, (cut,), threads)
                fitted = episode.window(0, len(fitted))
            train.append(fitted)
            held.append(episode)
            split.append(cut)
    else:
        train = [cut_up(robot, e, (), threads) if isinstance(e, Walk) else e for e in episodes]
        held = [_ready(robot, e) for log in holdout for e in split_episodes(log)]
        held = [cut_up(robot, e, (), threads) if isinstance(e, Walk) else e for e in held]
        split = [0.0] * len(held)
    study = Study(
        robot=robot,
        train=tuple(train),
        holdout=tuple(held),
        split=tuple(split),
        channels=tuple(c for c in COMPARED if c in channels),
        numerics=Numerics("RK4", 0.005),
        numerics_error=np.nan,
        threads=threads,
        executor=executor,
    )
    if numerics is None:
        walks = [log for log in study.train if isinstance(log, Walk)]
        if walks:
            numerics, error = walk_numerics(robot, walks[0], threads)
        else:
            numerics, error = choose_numerics(robot, study.train[0], threads)
        study = replace(study, numerics_error=error)
    study = replace(study, numerics=numerics)
    return study.settled(Model.of(())) if study.free else study


def _ready(robot: Robot, episode: Log) -> Log:
    """An episode with its base reconstructed, if that was free."""
    return make_walk(robot, episode) if episode.meta.mount == "free" else episode


def measure_scales(
    robot: Robot,
    logs: Sequence[Log],
    numerics: Numerics,
    threads: int = 0,
    replays: Sequence[Replay] | None = None,
) -> Scales:
    """Sizes at every joint, from replays of the plain model; `replays` with efforts, if they are special ones."""
    torque, velocity, acceleration, span = [], [], [], []
    measured: dict[str, list[FloatArray]] = {}
    for i, log in enumerate(logs):
        if replays is None:
            replay: Replay = make_replay(robot.for_log(log), log, (), numerics, effort=True, threads=threads)
        else:
            replay = replays[i]
        outputs = replay.predict(np.zeros((1, 0)))
        joints = replay.index.joints
        assert outputs.effort is not None
        skip = np.searchsorted(outputs.time, min(WARM_UP, 0.1 * outputs.time[-1]))
        t, v, q = outputs.effort[0, skip:], outputs.velocity[0, skip:], outputs.position[0, skip:]
        time = outputs.time[skip:]
        for joint, asked in _torque_asked(robot.for_log(log), log).items():
            measured.setdefault(joint, []).append(asked)
        torque.append(t)
        velocity.append(v)
        acceleration.append(np.gradient(v, time, axis=0))
        span.append(np.nanmax(q, axis=0) - np.nanmin(q, axis=0))
    model = robot.compile()
    t, v, a = (np.concatenate(x) for x in (torque, velocity, acceleration))
    reach = np.max(span, axis=0)

    def rms(x: FloatArray) -> FloatArray:
        return np.asarray(np.sqrt(np.nanmean(np.square(x), axis=0)))

    scales = {}
    for i, joint in enumerate(joints):
        asked = np.concatenate(measured.get(joint, [np.zeros(0)]))
        scales[joint] = JointScale(
            torque_rms=max(float(rms(t)[i]), TINY),
            torque_peak=max(float(np.nanmax(np.abs(t[:, i]))), TINY),
            velocity_rms=max(float(rms(v)[i]), TINY),
            velocity_peak=max(float(np.nanmax(np.abs(v[:, i]))), TINY),
            acceleration_rms=max(float(rms(a)[i]), TINY),
            span=max(float(reach[i]), TINY),
            slide=slides(model, joint),
            measured_rms=float(rms(asked)) if len(asked) else 0.0,
            measured_peak=float(np.max(np.abs(asked), initial=0.0)),
        )
    return scales


def _torque_asked(robot: Robot, log: Log) -> dict[str, FloatArray]:
    """Torque (n,) of each joint's servo for the commands and positions as logged."""
    model = robot.compile()
    index = make_index(model)
    result = {}
    for joint, a in zip(index.joints, index.actuator, strict=True):
        if a < 0 or not (log.has("position", joint) and log.has("command", joint)):
            continue
        command, position = log.channels[f"command.{joint}"], log.channels[f"position.{joint}"]
        gear = float(model.actuator_gear[a, 0])
        bias = model.actuator_biasprm[a]
        force = model.actuator_gainprm[a, 0] * command + bias[0] + bias[1] * gear * position
        if model.actuator_forcelimited[a]:
            force = np.clip(force, *model.actuator_forcerange[a])
        result[joint] = (gear * force)[np.isfinite(force)]
    return result
