"""Experiment design: the motion after which the chosen parameters are known best.

What a motion is worth is its Fisher information under the sensors' noise floors, ``J' J`` of the whitened predicted
sensors (Walter and Pronzato 1997, Identification of Parametric Models, chapter 6). A motion is scored by the mean
of the standard errors that follow from it (A-optimal), each in a unit of its own, or by the volume of the
confidence ellipsoid (D-optimal). Directions that are not identifiable from a motion are bounded by the
parameters' own bounds, so that a blind direction costs much, not infinitely much.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, replace
from functools import cached_property
from time import perf_counter
from typing import TYPE_CHECKING

import numpy as np

from sysid_btr._typing import FloatArray
from sysid_btr.errors import UsageError
from sysid_btr.estimators.base import Budget, Estimator, FitResult, Progress
from sysid_btr.estimators.cma_es import CmaEs
from sysid_btr.estimators.journal import Journal
from sysid_btr.estimators.linearisation import linearise
from sysid_btr.estimators.registry import get_estimator
from sysid_btr.excite.motion import Clock, Family, as_log, find_motors
from sysid_btr.excite.settings import MotionSettings
from sysid_btr.identify.episode import FixedEpisode
from sysid_btr.identify.intervals import NOT_IDENTIFIABLE, Estimate, estimates
from sysid_btr.identify.numerics import choose_numerics
from sysid_btr.identify.study import measure_scales
from sysid_btr.io.log import Log, LogMeta
from sysid_btr.io.noise import NoiseFloor
from sysid_btr.io.split import split_episodes
from sysid_btr.models.robot import Robot
from sysid_btr.mujoco_conventions import slides
from sysid_btr.objectives.problem import Comparison, ReplayProblem
from sysid_btr.objectives.targets import FITTED, WARM_UP, Target, make_targets
from sysid_btr.progress import shows_progress, watched
from sysid_btr.simulation.numerics import Numerics
from sysid_btr.simulation.replay import Replay
from sysid_btr.terms.base import Parameter
from sysid_btr.terms.grammar import parse_parameters
from sysid_btr.terms.model import Terms

if TYPE_CHECKING:
    from numpy.random import Generator

ENCODER = 2 * np.pi / 4096 / np.sqrt(12)
"""rad; noise floor of a 12-bit encoder, assumed where nothing is said."""
EVALUATIONS = 400
"""Motions tried by default."""
SEARCH = CmaEs(sigma=0.3, separable=True)
"""Default search: there are more coefficients than a full covariance can be learnt for."""
SETTLE = 2.0
"""s for which the nominal pose is held before a motion begins, so that it begins at rest under gravity."""
COARSE = 0.010
COARSE_ERROR = 0.05
"""Step (s) of the search, and relative change of the initial motion's score for which the search may use it."""


@dataclass(frozen=True)
class Sensors:
    """What will be measured: (channel, joint) -> noise floor, SI; `source` says where they come from."""

    floor: Mapping[tuple[str, str], float]
    source: str

    @property
    def effort(self) -> bool:
        return any(channel == "effort" for channel, _ in self.floor)

    def targets(self, time: FloatArray, joints: Sequence[str]) -> tuple[Target, ...]:
        """Channels to predict at the given times; nothing is measured yet."""
        targets = []
        for channel in dict.fromkeys(channel for channel, _ in self.floor):
            names = tuple(j for j in joints if (channel, j) in self.floor)
            sigma = np.array([self.floor[channel, j] for j in names])
            mask = np.repeat((time >= min(WARM_UP, 0.1 * time[-1]))[:, None], len(names), axis=1)
            if channel == "effort":
                mask[-1] = False
            targets.append(
                Target(
                    channel=channel,
                    joints=names,
                    columns=np.array([list(joints).index(n) for n in names], dtype=np.int64),
                    measured=np.zeros((len(time), len(names))),
                    floor=tuple(NoiseFloor(float(s), "unknown", 0.0) for s in sigma),
                    sigma=sigma,
                    mask=mask,
                )
            )
        return tuple(targets)


def find_sensors(robot: Robot, reference: Log | None = None, noise: float | None = None) -> Sensors:
    """Sensors of a reference log with their noise floors, or position encoders at every joint.

    Parameters
    ----------
    noise : floor (rad, m) of all positions, instead of the log's or of a 12-bit encoder's.
    """
    from sysid_btr.models.robot import joint_names

    if noise is not None and not (np.isfinite(noise) and noise > 0):
        raise UsageError(f"--noise {noise:g}: the standard deviation of a position sensor must be positive")
    joints = joint_names(robot)
    if reference is None:
        if noise is None and any(slides(robot.model, j) for j in joints):
            raise UsageError(
                f"model {robot.name} has sliding joints, and the noise of their sensors is unknown: give --log, or "
                "--noise in m"
            )
        said = "as given" if noise is not None else "of a 12-bit encoder, assumed"
        return Sensors({("position", j): ENCODER if noise is None else noise for j in joints}, said)
    found: dict[tuple[str, str], list[float]] = {}
    for episode in split_episodes(reference):
        for target in make_targets(episode, joints, FITTED):
            for joint, floor in zip(target.joints, target.noise, strict=True):
                found.setdefault((target.channel, joint), []).append(float(floor))
    floors = {key: float(np.median(values)) for key, values in found.items()}
    if noise is not None:
        floors.update({key: noise for key in floors if key[0] == "position"})
    return Sensors(floors, "of the reference log" if noise is None else "as given")


@dataclass(frozen=True, eq=False)
class Expected:
    """What a motion will make identifiable.

    Attributes
    ----------
    seconds : length.
    parameters : (p,) what is asked.
    information : (p, p) Fisher information per unit of the parameters.
    estimates : one a parameter, as a fit of a log of this motion to the nominal model is expected to give them:
        standard error (the Cramer-Rao bound), 95 % interval, whether it is identifiable, and if not, with what it is
        confounded.
    """

    seconds: float
    parameters: tuple[Parameter, ...]
    information: FloatArray
    estimates: tuple[Estimate, ...]

    @cached_property
    def covariance(self) -> FloatArray:
        """(p, p), regularised: a parameter that is known so badly that it counts as not identifiable is not
        known at all, and whether by little or by much is no matter.
        """
        span = NOT_IDENTIFIABLE * np.array([p.upper - p.lower for p in self.parameters])
        scaled = self.information * np.outer(span, span) + np.eye(len(span))
        return np.asarray(np.linalg.inv(scaled) * np.outer(span, span))

    @property
    def std(self) -> FloatArray:
        """(p,) regularised standard errors."""
        return np.sqrt(np.diag(self.covariance))


def expect(problem: ReplayProblem) -> Expected:
    """How informative a motion is about the parameters of a problem, at its start values."""
    at = problem.start
    _, jacobian = linearise(problem, at)
    jacobian = np.where(np.isfinite(jacobian), jacobian, 0.0)
    return Expected(
        seconds=float(sum(e.replay.log.time[-1] - e.replay.log.time[0] for e in problem.episodes)),
        parameters=problem.parameters,
        information=np.einsum("ri,rj->ij", jacobian, jacobian),
        estimates=tuple(
            # a nominal value on its bound is no finding
            replace(e, at_bound=False, reason="" if e.identifiable == "yes" else e.reason)
            for e in estimates(problem.parameters, at, jacobian, np.zeros(len(jacobian)), problem.blocks)
        ),
    )


Criterion = Callable[[Expected, FloatArray], float]
"""Score of a motion, smaller is better, given the size (p,) in which each standard error is counted."""


def mean_error(expected: Expected, unit: FloatArray) -> float:
    """Mean standard error, each in its unit (A-optimal on relative scales)."""
    return float(np.mean(expected.std / unit))


def volume(expected: Expected, unit: FloatArray) -> float:
    """Geometric mean of the half axes of the standard ellipsoid, in the units (D-optimal)."""
    _, log_det = np.linalg.slogdet(expected.covariance / np.outer(unit, unit))
    return float(np.exp(log_det / (2 * len(unit))))


CRITERIA: Mapping[str, Criterion] = {"mean": mean_error, "logdet": volume}
"""By name."""


def find_criterion(name: str) -> Criterion:
    """A criterion by name.

    Raises
    ------
    UsageError
        Listing what there is.
    """
    if name not in CRITERIA:
        raise UsageError(f"unknown criterion {name!r}; available: {', '.join(CRITERIA)}")
    return CRITERIA[name]


def find_estimator(name: str) -> Estimator:
    """An estimator by name, with settings for many coefficients and few motions.

    Raises
    ------
    UsageError
        No such estimator, or one that needs residuals, which a motion's score does not have.
    """
    if name == "cmaes":
        return SEARCH
    chosen = get_estimator(name)
    if "lsq" in name.split("+"):
        raise UsageError("lsq needs residuals, and the score of a motion has none: choose cmaes, ga or nlopt:ALGORITHM")
    return chosen


@dataclass(frozen=True, eq=False)
class Experiment:
    """The robot, what shall be known about it, and how it will be measured.

    Attributes
    ----------
    robot, terms : the model and its free parameters, at their nominal values.
    sensors : what is measured.
    numerics, threads : of the simulation.
    rest : (j,) positions of all joints in which the model rests under the nominal commands.
    """

    robot: Robot
    terms: Terms
    sensors: Sensors
    numerics: Numerics
    threads: int
    rest: Mapping[str, float]

    def problem(self, log: Log) -> ReplayProblem:
        """The replay problem that a log of these commands will pose."""
        channels = {**log.channels, **{f"position.{j}": np.full(len(log), q) for j, q in self.rest.items()}}
        replay = Replay(
            self.robot,
            replace(log, channels=channels),
            self.terms,
            self.numerics,
            effort=self.sensors.effort,
            threads=self.threads,
        )
        targets = self.sensors.targets(log.time, replay.index.joints)
        return ReplayProblem((Comparison(replay, targets),), self.terms.nominal)

    def of_reference(self, log: Log, seconds: float) -> ReplayProblem:
        """The problem that a reference log poses, as far as `seconds` of it."""
        episodes, left = [], seconds
        for part in split_episodes(log):
            count = int(np.searchsorted(part.time, part.time[0] + left + 1e-9, side="right"))
            if count < 2:
                break
            part = part.window(0, count)
            left -= float(part.time[-1] - part.time[0])
            replay = Replay(
                self.robot.for_log(part),
                part,
                self.terms,
                self.numerics,
                effort=self.sensors.effort,
                threads=self.threads,
            )
            targets = self.sensors.targets(part.time - part.time[0], replay.index.joints)
            episodes.append(Comparison(replay, targets))
        return ReplayProblem(tuple(episodes), self.terms.nominal)


def prepare(robot: Robot, parameters: Sequence[str], sensors: Sensors, log: Log, *, threads: int = 0) -> Experiment:
    """An experiment with the numerics that a motion like `log` needs, and the pose from which it starts."""
    numerics, _ = choose_numerics(robot, log, threads)
    count = int(np.ceil(SETTLE / float(log.time[1] - log.time[0]))) + 1
    held = replace(
        log,
        time=np.arange(count, dtype=np.float64) * float(log.time[1] - log.time[0]),
        channels={name: np.full(count, column[0]) for name, column in log.channels.items()},
        episode=np.zeros(count, dtype=np.int64),
    )
    replay = Replay(robot, held, (), numerics, threads=threads)
    last = replay.predict(np.zeros((1, 0))).position[0, -1]
    rest = dict(zip(replay.index.joints, map(float, last), strict=True))
    scales = measure_scales(robot, (FixedEpisode.whole(robot, log),), numerics, threads)
    terms = Terms(parse_parameters(parameters, robot, scales))
    return Experiment(robot, terms, sensors, numerics, threads, rest)


@dataclass(frozen=True, eq=False)
class Excitation:
    """Choosing a motion as a `Problem` of the estimators: its coefficients are what is searched.

    Attributes
    ----------
    experiment, family : what is asked, and the motions to choose from.
    criterion, unit : the score, and the sizes (p,) in which standard errors are counted.
    start : coefficients of the initial motion.
    """

    experiment: Experiment
    family: Family
    criterion: Criterion
    unit: FloatArray
    start: FloatArray

    @property
    def names(self) -> tuple[str, ...]:
        return self.family.names

    @cached_property
    def lower(self) -> FloatArray:
        return np.full(len(self.names), -1.0)

    @cached_property
    def upper(self) -> FloatArray:
        return np.full(len(self.names), 1.0)

    def loss(self, candidates: FloatArray) -> FloatArray:
        """Scores (m,) of motions (m, coefficients), each of one period; infinite where the model diverges."""
        return np.array([self._score(row) for row in np.atleast_2d(candidates)])

    def _score(self, row: FloatArray) -> float:
        log = as_log(self.family, row, self.experiment.robot, times=1)
        try:
            return self.criterion(expect(self.experiment.problem(log)), self.unit)
        except UsageError:  # no Jacobian where the simulation fails
            return float("inf")


@dataclass(frozen=True, eq=False)
class Design:
    """A designed motion.

    Attributes
    ----------
    experiment, family, coefficients, log : the motion, and what it is for.
    reference, designed : how informative the reference motion is, and this one.
    compared_with : what the reference motion is.
    result : what the estimator returned; its losses are of one repetition.
    beyond : joint -> rad or m by which the nominal model's position leaves the joint's range and nominal pose.
    seconds : wall time.
    """

    experiment: Experiment
    family: Family
    coefficients: FloatArray
    log: Log
    reference: Expected
    designed: Expected
    compared_with: str
    result: FitResult
    beyond: Mapping[str, float]
    seconds: float

    @property
    def identifiable(self) -> list[bool]:
        """(p,) which parameters are identifiable from either motion."""
        both = zip(self.reference.estimates, self.designed.estimates, strict=True)
        return [a.identifiable != "no" or b.identifiable != "no" for a, b in both]

    @property
    def ratios(self) -> FloatArray:
        """(p,) standard error after this motion over that after the reference."""
        after, before = ([e.std for e in x.estimates] for x in (self.designed, self.reference))
        return np.asarray(np.array(after) / np.array(before))

    @property
    def mean_ratio(self) -> float:
        """Mean of `ratios` over the parameters that are identifiable; 1 where none is."""
        return float(np.mean(self.ratios[self.identifiable])) if any(self.identifiable) else 1.0


@shows_progress("excite")
def design(
    robot: Robot,
    parameters: Sequence[str],
    *,
    motion: MotionSettings | None = None,
    reference: Log | None = None,
    noise: float | None = None,
    criterion: Criterion = mean_error,
    estimator: Estimator | None = None,
    rng: Generator | None = None,
    budget: Budget | None = None,
    journal: Journal | None = None,
    progress: Progress = watched,
    threads: int = 0,
    search_context: Callable[[], AbstractContextManager[object]] = nullcontext,
) -> Design:
    """Find a motion after which parameters are known well.

    Parameters
    ----------
    robot : model, with its torso held.
    parameters : expressions of the grammar.
    motion : its length, sampling and limits.
    reference : log of a motion to compare with, as far as the new one lasts; its sensors and their noise are
        assumed for the new one. None: the initial motion of the search, and position encoders.
    noise : see `find_sensors`.
    criterion : score of a motion.
    estimator, rng, budget, journal, progress : of the search; default `CmaEs`, seed 0, `EVALUATIONS` motions.
    threads : worker threads, 0 for all cores.
    search_context : entered for the time of the search; an interrupted search gives the best motion so far.

    Raises
    ------
    UsageError
        What is asked cannot be used, or the reference log is a floating-base log.
    ModelError
        The model has no servo, or diverges.
    """
    began = perf_counter()
    progress(done=0, total=None, best=np.inf, note="first motion")
    robot = configured(robot, reference)
    rng = np.random.default_rng(0) if rng is None else rng
    motion = motion or MotionSettings()
    family = Family(find_motors(robot, motion, reference), Clock.of(motion.seconds, motion.rate))
    start = rng.uniform(-1.0, 1.0, len(family.names))
    meta = LogMeta(robot=robot.name) if reference is None else reference.meta
    first = as_log(family, start, robot, times=1, like=meta)
    experiment = prepare(robot, parameters, find_sensors(robot, reference, noise), first, threads=threads)
    before = expect(
        experiment.problem(as_log(family, start, robot))
        if reference is None
        else experiment.of_reference(reference, family.clock.seconds)
    )
    choice = Excitation(cheap(experiment, first), family, criterion, before.std, start)
    with search_context():
        result = (estimator or SEARCH).fit(
            choice,
            rng=rng,
            budget=budget or Budget(evaluations=EVALUATIONS),
            journal=Journal() if journal is None else journal,
            progress=progress,
        )
    log = as_log(family, result.x, robot, like=meta)
    problem = experiment.problem(log)
    return Design(
        experiment=experiment,
        family=family,
        coefficients=result.x,
        log=log,
        reference=before,
        designed=expect(problem),
        compared_with=_called(reference),
        result=result,
        beyond=_beyond(robot, problem.episodes[0].replay),
        seconds=perf_counter() - began,
    )


def _called(reference: Log | None) -> str:
    if reference is None:
        return "the initial motion"
    return reference.path.name if reference.path else "the reference log"


def configured(robot: Robot, reference: Log | None) -> Robot:
    """The robot with the settings of the reference log.

    Raises
    ------
    UsageError
        If it has none but needs them, or the log is a floating-base log.
    """
    if reference is None:
        if robot.configure is not None:
            raise UsageError(f"model {robot.name} takes the settings of its servos from a log: give one with --log")
        return robot
    if reference.meta.mount == "free":
        raise UsageError(
            f"{reference.path or 'the reference log'} is a floating-base log; motions are designed for a fixed "
            "base: give a fixed-base log, or none and --noise"
        )
    return robot.for_log(reference)


def cheap(experiment: Experiment, log: Log) -> Experiment:
    """The experiment with a coarser step, where that hardly changes how informative a motion is."""
    period = log.meta.sample_period or COARSE
    step = period / max(int(np.ceil(period / COARSE - 1e-9)), 1)
    coarse = replace(experiment, numerics=Numerics("RK4", step))
    if step <= experiment.numerics.timestep or experiment.numerics.integrator != "RK4":
        return experiment
    fine, rough = expect(experiment.problem(log)).std, expect(coarse.problem(log)).std
    return coarse if np.all(np.abs(np.log(rough / fine)) < COARSE_ERROR) else experiment


def _beyond(robot: Robot, replay: Replay) -> dict[str, float]:
    from sysid_btr.models.robot import joint_ranges

    plain = replace(replay, terms=())
    position = plain.predict(np.zeros((1, 0))).position[0]
    ranges = joint_ranges(robot)
    beyond = {}
    for joint, q, home in zip(replay.index.joints, position.T, replay.model.qpos0[replay.index.qpos], strict=True):
        low, high = ranges.get(joint, (-np.inf, np.inf))
        # a nominal pose outside of its range is the model's, not the motion's
        most = max(float(min(low, home) - q.min()), float(q.max() - max(high, home)))
        if most > 0:
            beyond[joint] = most
    return beyond
