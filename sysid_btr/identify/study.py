"""A study: robot, logs, what is fitted and what is held out, ready for estimators and for diagnosis."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial

import numpy as np

from sysid_btr._typing import FloatArray, IntArray
from sysid_btr.errors import UsageError
from sysid_btr.estimators.base import Progress
from sysid_btr.estimators.journal import Journal
from sysid_btr.executors.base import HERE, Executor
from sysid_btr.identify.episode import Episode, Fused, Inflation, Procedure
from sysid_btr.identify.mode import AUTOMATIC, Mode, episode_of, split_episode
from sysid_btr.identify.prior import MapProblem, Stated
from sysid_btr.identify.segmented import measured_motion
from sysid_btr.io.log import Log
from sysid_btr.io.split import split_episodes
from sysid_btr.models.commands import commanded
from sysid_btr.models.log_checks import require_drives
from sysid_btr.models.robot import Robot, joint_names
from sysid_btr.models.ties import as_logged
from sysid_btr.mujoco_conventions import slides
from sysid_btr.objectives.problem import Comparison, ReplayProblem
from sysid_btr.objectives.targets import COMPARED, FITTED, WARM_UP
from sysid_btr.progress import phase, shows_progress, watched
from sysid_btr.simulation.compiling import make_index
from sysid_btr.simulation.numerics import Numerics
from sysid_btr.simulation.registry import on_simulator
from sysid_btr.simulation.servo import ServoLaw
from sysid_btr.terms.base import BatchModel, Outputs, Term
from sysid_btr.terms.grammar import parse_parameters
from sysid_btr.terms.model import Model, Terms, as_model
from sysid_btr.terms.scales import JointScale, Scales

TINY = 1e-9
FIXED_SHARE, FLOATING_SHARE = 0.05, 0.4
"""Of the time of a fit, what it takes to lay it out: on a floating base states are estimated."""


@dataclass(frozen=True, eq=False, repr=False)
class Study:
    """Data and model of an identification, before anything is estimated.

    Attributes
    ----------
    robot : the model.
    train, holdout : episodes, each with the samples that count; a held-out part of a training log keeps the samples
        before it, so that its replay starts where the log does, and scores only what was not fitted.
    channels : channels that are fitted.
    numerics : integrator and step; chosen by a convergence check.
    inflation : (mount, channel, joint) -> factor on its noise floor in what is minimised; 1 where silent. Keeps a
        column that the model cannot explain yet from distorting parameters about which others are informative. What is
        wrong about the ground is not an error of a robot that hangs.
    numerics_error : largest change of a predicted sensor when the step is halved, in noise floors.
    independent : whether `inflation` lets each column count as its independent samples do.
    redundancy : residuals that say as much as one that is independent of the others, where the model leaves more than
        noise; 0 where it leaves noise alone, beside which what robots have from their models says nothing.
    held : whether that says something beside noise, too: the log alone asks for numbers that robots do not have.
    nuisance : FIELD or FIELD:GLOB -> standard deviation of its numbers where they are not fitted, for the intervals.
    executor : where candidates are simulated.
    journal : record of refits, from which an interrupted search goes on; None keeps none.
    """

    robot: Robot
    train: tuple[Episode, ...]
    holdout: tuple[Episode, ...]
    channels: tuple[str, ...]
    numerics: Numerics
    numerics_error: float
    threads: int = 0
    inflation: Inflation = field(default_factory=dict)
    executor: Executor = HERE
    journal: Journal | None = None
    nuisance: Mapping[str, float] = field(default_factory=dict)
    independent: bool = False
    redundancy: float = 0.0
    held: bool = False

    def __repr__(self) -> str:
        parts = f"{len(self.train)} episodes fitted, {len(self.holdout)} held out"
        return f"<Study of {self.robot.name}: {parts}; {', '.join(self.channels)}; {self.numerics}>"

    def held_to_model(self) -> Study:
        """The same, where what a model states counts beside noise."""
        return replace(self, held=True, redundancy=1.0)

    @property
    def leading_channel(self) -> str:
        """The first channel that is fitted and logged; sentences and pictures speak of it."""
        return next(c for c in self.channels if any(c in e.logged(self.channels) for e in self.train))

    @cached_property
    def scales(self) -> Scales:
        """Sizes of torques and motions at every joint in the plain model on these logs."""
        return measure_scales(self.robot, self.train, self.numerics, self.threads)

    def declare(self, expressions: Sequence[str]) -> Terms:
        """Terms of the parameters that a user frees.

        Raises
        ------
        UsageError
            If one is wrong, or changes nothing in these episodes as they are compared.
        """
        terms = Terms(parse_parameters(expressions, self.robot, self.scales))
        idle = dict.fromkeys(term.called for term in terms if not self.shows(type(term)))
        if idle:
            raise UsageError(f"{', '.join(idle)}: {self.procedure.unseen}")
        return terms

    def shows(self, term: type[Term]) -> bool:
        """Whether a term of this class changes what any episode is compared by, see `Procedure.shows`."""
        return any(episode.procedure.shows(term) for episode in (*self.train, *self.holdout))

    def train_problem(self, model: Model | Iterable[Term]) -> ReplayProblem:
        """What is fitted, by a search that begins at a model; bare terms begin at their nominal values."""
        return self._problem(self.train, as_model(model))

    def with_belief(self, problem: ReplayProblem) -> ReplayProblem | MapProblem:
        """What is minimised: beside a model's error, that a robot is about what its model states."""
        belief = Stated.of(problem.parameters, self.redundancy)
        return MapProblem(problem, belief, problem.deviation) if belief.weight.any() else problem

    def holdout_problem(self, model: Model | Iterable[Term]) -> ReplayProblem:
        """What is predicted without having been fitted."""
        return self._problem(self.holdout, as_model(model))

    def _problem(self, episodes: Iterable[Episode], model: Model) -> ReplayProblem:
        compared = tuple(self._compare(e, model.terms) for e in episodes)
        return ReplayProblem(compared, model.values, self.executor, deviation=float(self.independent))

    def _compare(self, episode: Episode, terms: Terms) -> Comparison:
        return episode.compare(terms, self.channels, self.numerics, inflation=self.inflation, threads=self.threads)

    def section(self) -> Journal:
        """What the next search keeps its record in."""
        return Journal() if self.journal is None else self.journal.section()

    @cached_property
    def procedure(self) -> Procedure:
        """How a fit goes about these episodes: as the most demanding kind among them asks for."""
        return max((e.procedure for e in (*self.train, *self.holdout)), key=lambda p: p.demand)

    @property
    def coarse(self) -> Numerics:
        """See `Procedure.coarse`."""
        return self.procedure.coarse(self.numerics)

    @property
    def cheap(self) -> Numerics:
        """See `Procedure.cheap`."""
        return self.procedure.cheap(self.numerics)

    def stencil(self, terms: Terms) -> float:
        """See `Procedure.stencil`."""
        return self.procedure.stencil(terms)

    def fuse(
        self,
        problem: ReplayProblem,
        values: FloatArray,
        jacobian: FloatArray,
        residual: FloatArray,
        *,
        follow: bool = True,
    ) -> Fused | None:
        """See `Procedure.fuse`."""

        def elsewhere(values: FloatArray) -> ReplayProblem:
            model = Model(problem.terms, values)
            return self.with_later_segments().with_initial_states(model, held_out=False).train_problem(model)

        return self.procedure.fuse(problem, values, jacobian, residual, elsewhere, follow=follow)

    def with_later_segments(self) -> Study:
        """The study with the segments of fitted episodes half a segment later; held-out ones keep theirs."""
        return replace(self, train=tuple(episode.with_later_segments() for episode in self.train))

    def with_share(self, share: float, model: Model) -> Study:
        """The study with segments of a fraction of their length, which start where the data want them."""
        shorter = replace(self, train=tuple(episode.with_share(share) for episode in self.train))
        return self if shorter.train == self.train else shorter.with_initial_states(model, held_out=False)

    def with_initial_states(self, model: Model, *, held_out: bool = True, anew: bool = True) -> Study:
        """The study with the initial states of its segments where the data want them under a model.

        `held_out` says whether those of held-out segments too, which only judge; `anew` whether known derivatives
        with respect to initial states are taken again.
        """

        def updated(episode: Episode) -> Episode:
            compare = partial(self._compare, episode, model.terms)
            return episode.with_initial_states(compare, model.values, self.coarse, anew=anew)

        return replace(
            self,
            train=tuple(map(updated, self.train)),
            holdout=tuple(map(updated, self.holdout)) if held_out else self.holdout,
        )


@shows_progress("study")
def make_study(
    robot: Robot,
    logs: Sequence[Log],
    *,
    holdout: float | Sequence[Log] = 0.3,
    channels: Sequence[str] = FITTED,
    numerics: Numerics | None = None,
    simulator: str | None = None,
    mode: Mode = AUTOMATIC,
    threads: int = 0,
    executor: Executor = HERE,
    nuisance: Mapping[str, float] | None = None,
    progress: Progress = watched,
) -> Study:
    """Set up an identification: what is fitted, what is held out, and how logs and model are compared.

    Parameters
    ----------
    robot : model; joints that it ties together and the logs show moving apart are not tied.
    logs : recordings to fit; each episode is replayed by itself.
    holdout : the last fraction of each log, or other logs; `logs` themselves where nothing will be fitted.
    channels : channels to fit, of ``position``, ``velocity``, ``effort``.
    numerics : integrator and step; None chooses by a convergence check on the log. Stated ones, such as
        ``Numerics.parse("implicitfast:0.002")``, are those in which the model is to be used: nothing refines them.
    simulator : what moves the model, by name; None is that of `numerics`, or the built-in one.
    mode : how the logs are compared with the model.
    threads : worker threads, 0 for all cores.
    executor : where candidates are simulated: this process, or what `open_executor` gives.
    nuisance : FIELD or FIELD:GLOB -> standard deviation of its numbers where they are not fitted, as
        ``{"mass": 0.1}``: intervals then do not take them as exact.
    progress : is told what is going on; by default a line where stderr is a terminal or a notebook.

    Raises
    ------
    ModelError
        If a log and the model have nothing in common, or a command drives nothing, or not what it says.
    UsageError
        If a recording is given twice, the held-out fraction is not between 0 and 1, there is no such simulator, or a
        log does not suit the mode.
    """
    say = partial(progress, done=0, total=None, best=float("inf"))
    say(note="reading the motion")
    require_drives(robot, logs)
    robot = as_logged(robot, logs)
    given = on_simulator(numerics or Numerics("RK4", 0.005), simulator)
    floating = any(log.meta.mount == "free" for log in logs)
    with phase("study", FLOATING_SHARE if floating else FIXED_SHARE):
        recordings = [e for log in logs for e in split_episodes(log)]
        if isinstance(holdout, int | float):
            _refuse_repeats(recordings)
            parts = [split_episode(robot, e, float(holdout), mode, threads) for e in recordings]
            train, held = [fitted for fitted, _ in parts], [left for _, left in parts]
        else:
            judged = [e for log in holdout for e in split_episodes(log)]
            if holdout is not logs:
                _refuse_repeats((*recordings, *judged))
            train = [episode_of(robot, e, mode, threads) for e in recordings]
            held = [episode_of(robot, e, mode, threads) for e in judged]
        study = Study(
            robot=robot,
            train=tuple(train),
            holdout=tuple(held),
            channels=tuple(c for c in COMPARED if c in channels),
            numerics=given,
            numerics_error=np.nan,
            threads=threads,
            executor=executor,
            nuisance=nuisance or {},
        )
        if numerics is None:
            say(note="choosing the integrator's step")
            leading = max(train, key=lambda e: e.procedure.demand)
            chosen, error = leading.choose_numerics(threads, given.simulator)
            study = replace(study, numerics=chosen, numerics_error=error)
        say(note="initial states")
        return study.with_initial_states(Model.of(()))


def _refuse_repeats(recordings: Iterable[Log]) -> None:
    """Refuse data that would count twice, or that would judge what was fitted to them."""
    first: dict[str, Log] = {}
    problems = []
    for log in recordings:
        known = first.setdefault(log.content, log)
        if known is not log:
            problems.append(f"{log.path or 'a log'} holds the same recording as {known.path or 'another log'}")
    if problems:
        raise UsageError(
            "\n".join(problems) + "\nThe same data twice make intervals too narrow, and held out they judge nothing: "
            "give each recording once."
        )


def measure_scales(robot: Robot, episodes: Sequence[Episode], numerics: Numerics, threads: int = 0) -> Scales:
    """Sizes at every joint, from replays of the plain model.

    Of a joint that no drive of its own moves (passive, coupled, pulled by a tendon, or a motor that is asked for
    nothing) torques are those that its own motion takes of its inertia.
    """
    torque, velocity, acceleration, ends, seconds = [], [], [], [], []
    measured: dict[str, list[FloatArray]] = {}
    for episode in episodes:
        log, replay = episode.log, episode.replay((), numerics, effort=True, threads=threads)
        outputs = replay.predict(np.zeros((1, 0)))
        if not np.isfinite(outputs.position).any() and any(log.has("position", j) for j in replay.index.joints):
            outputs = _as_measured(robot.for_log(log), log, outputs)
        joints = replay.index.joints
        skip = np.searchsorted(outputs.time, min(WARM_UP, 0.1 * outputs.time[-1]))
        t, v, q = episode.torque_at_hand(outputs)[skip:], outputs.velocity[0, skip:], outputs.position[0, skip:]
        time = outputs.time[skip:]
        for joint, asked in _torque_asked(robot.for_log(log), log).items():
            measured.setdefault(joint, []).append(asked)
        velocity.append(v)
        acceleration.append(_rate(v, time, episode.breaks - skip))
        idle = ~np.any(np.abs(t) > TINY, axis=0)
        own = replay.model.dof_M0[replay.index.dof] * acceleration[-1]
        torque.append(np.where(idle, own, t))
        ends.append((np.nanmin(q, axis=0), np.nanmax(q, axis=0)))
        seconds.append(float(outputs.time[-1] - outputs.time[0]))
    model = robot.model
    t, v, a = (np.concatenate(x) for x in (torque, velocity, acceleration))
    reach = np.max([high - low for low, high in ends], axis=0)
    centre = 0.5 * (np.min([low for low, _ in ends], axis=0) + np.max([high for _, high in ends], axis=0))

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
            centre=float(centre[i]),
            seconds=max(seconds),
        )
    return scales


def _as_measured(robot: Robot, log: Log, outputs: Outputs) -> Outputs:
    """What sensors show of the measured motion, where the plain model diverges; joints that are not logged rest."""
    tracks, asked = measured_motion(robot, log), _torque_asked(robot, log)
    effort = np.zeros(tracks.position.shape)
    for i, joint in enumerate(joint_names(robot)):
        if joint in asked and len(asked[joint]) == len(log):
            effort[:, i] = asked[joint]
    return replace(outputs, position=tracks.position[None], velocity=tracks.velocity[None], effort=effort[None])


def _rate(values: FloatArray, time: FloatArray, breaks: IntArray) -> FloatArray:
    """Derivative (n, j) of a series that begins anew at some of its samples; NaN next to them."""
    rate = np.gradient(values, time, axis=0)
    inner = breaks[(breaks > 0) & (breaks < len(time))]
    rate[inner], rate[inner - 1] = np.nan, np.nan
    return rate


def _torque_asked(robot: Robot, log: Log) -> dict[str, FloatArray]:
    """Torque (n,) of each joint's servo for the commands and positions as logged."""
    model = robot.model
    index = make_index(model)
    driven = [j for j, a in zip(index.joints, index.actuator, strict=True) if a >= 0]
    blank = np.full(len(log), np.nan)
    given = commanded(log, model)
    command, position = (
        np.column_stack([given.channels.get(f"{channel}.{j}", blank) for j in index.joints])[None]
        for channel in ("command", "position")
    )
    law = ServoLaw.of(BatchModel(model, index, model.opt.timestep, 1))
    torque = law.torque(command, position, np.zeros(position.shape))[0]
    found = {j: torque[:, index.joints.index(j)] for j in driven if log.has("position", j) and given.has("command", j)}
    return {joint: column[np.isfinite(column)] for joint, column in found.items()}
