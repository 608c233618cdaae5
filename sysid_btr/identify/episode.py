"""Episodes: recordings of one run each, with the samples that count, as the kind of their base wants them replayed.

`Log` is data and never changes. What a fit adds to it is an episode's: segments, initial states, and which samples are
scored. Kinds differ in how they are replayed (`Episode`), and in how a fit goes about them (`Procedure`).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from types import MappingProxyType
from typing import Any, ClassVar, Self, TypeVar

import numpy as np

from sysid_btr._typing import BoolArray, FloatArray, IntArray
from sysid_btr.errors import ModelError
from sysid_btr.estimators.base import ResidualEstimator
from sysid_btr.estimators.lsq import LeastSquares
from sysid_btr.identify.numerics import choose_numerics
from sysid_btr.identify.starting import wanted_start
from sysid_btr.io.log import Log
from sysid_btr.io.noise import assumed_floor, hides_motion
from sysid_btr.io.split import holdout_split
from sysid_btr.models.commands import commanded, driven_by_effort
from sysid_btr.models.robot import Robot, joint_names
from sysid_btr.objectives.covariance import Known
from sysid_btr.objectives.problem import Comparison, ReplayProblem
from sysid_btr.objectives.targets import COMPARED, WARM_UP, Target, make_targets
from sysid_btr.simulation.numerics import MUJOCO, Numerics
from sysid_btr.simulation.replay import Replay
from sysid_btr.simulation.start import Start
from sysid_btr.terms.base import Outputs, Term
from sysid_btr.terms.model import Terms

E = TypeVar("E", bound=ResidualEstimator)

ROUGH_STEP = 1e-2
"""Finite-difference step, fraction of the range, against teeth that meet: from there on, wider ones see no less
information."""

Inflation = Mapping[tuple[str, str, str], float]
"""(mount, channel, joint) -> factor on its noise floor in what is minimised; 1 where silent."""


@dataclass(frozen=True, eq=False)
class Fused:
    """A linearised fit together with what else its episodes are informative about.

    Attributes
    ----------
    values : (p,) estimates.
    jacobian, residual : (r, p) and (r,) there, each episode weighed by how much it is believed.
    error : (p,) standard deviation beyond that of pieces of the log that are independent.
    known : parameters as these residuals and contact-free estimation give them together, where they do.
    """

    values: FloatArray
    jacobian: FloatArray
    residual: FloatArray
    error: FloatArray
    known: Known | None = None


class Procedure:
    """How a fit goes about episodes of one kind; here those whose base is fixed, replayed whole.

    Attributes
    ----------
    demand : of several kinds in one study the most demanding one's procedure is followed.
    alternations : iterations of the first fits by the coarse integrator, after each of which the initial states are
        updated.
    shares : lengths of segment in these, as fractions of the whole one.
    last_turns : times at most that initial states and parameters are updated in turn once all effects are known.
    coarse_suffices : whether a fit by the coarse integrator need not be repeated by the reference one before its
        errors are judged.
    deferred : whether derivatives are always taken by a cheaper integrator.
    refines_step : whether half the step, where that moves an estimate, is nearer to the truth.
    weighs_segments : whether segments are weighed one by one, by what is left in them under the columns' noise.
    holds_out_anywhere : whether what is held out may lie all over a recording.
    wanders : whether parameters may be fitted far from where they belong where something is missing, as errors of the
        model grow in a replay.
    fuses : whether `fuse` has more to say than the residuals.
    costly : whether each candidate is a simulation of its own, so that fewer are asked for.
    on_ground : whether the ground of the model carries it, and shows.
    leaves_ground_error : whether the right model leaves an error that no effect explains: that of its ground.
    tolerated : chi2 of fitted data up to which the model counts as right: noise floors are read from logs.
    replayed : whether its commands are replayed at all.
    no_torque : why the missing torque cannot be characterised, where it cannot.
    uncertain : what is not fitted and may be off, as in `Study.nuisance`.
    unseen : why a term that it does not show changes nothing, and the way out.
    """

    demand: ClassVar[int] = 0
    alternations: ClassVar[tuple[int, ...]] = ()
    shares: ClassVar[tuple[float, ...]] = ()
    last_turns: ClassVar[int] = 0
    coarse_suffices: ClassVar[bool] = False
    deferred: ClassVar[bool] = False
    refines_step: ClassVar[bool] = True
    weighs_segments: ClassVar[bool] = False
    holds_out_anywhere: ClassVar[bool] = True
    wanders: ClassVar[bool] = False
    fuses: ClassVar[bool] = False
    costly: ClassVar[bool] = False
    on_ground: ClassVar[bool] = False
    leaves_ground_error: ClassVar[bool] = False
    tolerated: ClassVar[float] = 1.5
    replayed: ClassVar[bool] = True
    no_torque: ClassVar[str] = "the replay fails or is too short"
    unseen: ClassVar[str] = ""
    uncertain: Mapping[str, float] = MappingProxyType({})

    def shows(self, term: type[Term]) -> bool:
        """Whether a term of this class changes what is compared."""
        return True

    def coarse(self, numerics: Numerics) -> Numerics:
        """Integrator and step that are good enough for first fits, and for derivatives by the initial states."""
        return numerics

    def cheap(self, numerics: Numerics) -> Numerics:
        """Integrator and step of derivatives: a fraction of the cost, and as far off as a step of first order is."""
        if numerics.servo_period:
            # the engine takes these steps by itself
            return replace(numerics, integrator="Euler", timestep=numerics.servo_period, servo_period=None)
        return replace(numerics, integrator="implicitfast") if numerics.integrator == "RK4" else numerics

    def stencil(self, terms: Terms) -> float:
        """Finite-difference step, fraction of a parameter's range: wide where the objective is rough."""
        return ROUGH_STEP if terms.rough else LeastSquares.central_step

    def suited(self, estimator: E) -> E:
        """An estimator with settings that suit the objective."""
        return estimator

    def fuse(
        self,
        problem: ReplayProblem,
        values: FloatArray,
        jacobian: FloatArray,
        residual: FloatArray,
        elsewhere: Callable[[FloatArray], ReplayProblem],
        *,
        follow: bool = True,
    ) -> Fused | None:
        """What the episodes hold beside the residuals, and get wrong in them; None where these say it all.

        Parameters
        ----------
        problem : what was fitted.
        values, jacobian, residual : (p,), (r, p), (r,) at the optimum, whitened.
        elsewhere : candidate (p,) -> the same problem with segments that begin elsewhere.
        follow : whether the estimates may move.
        """
        return None


@dataclass(frozen=True, eq=False)
class Episode(ABC):
    """A recording, and which of its samples count.

    Attributes
    ----------
    robot : the model, before what the log's metadata say about it.
    recording : all of the episode.
    scored : (n,) samples that count: those that are fitted, or those that are held out.
    why : why it is compared with a model in this way, where that is not what is usually done.
    """

    robot: Robot
    recording: Log
    scored: BoolArray
    why: str = field(default="", kw_only=True)

    warm_up: ClassVar[float] = 0.0
    """s after its beginning that are not scored."""

    @classmethod
    @abstractmethod
    def whole(cls, robot: Robot, log: Log, threads: int = 0) -> Self:
        """All of a recording."""

    @classmethod
    def split(cls, robot: Robot, log: Log, holdout: float, threads: int = 0) -> tuple[Self, Self]:
        """A recording whose last fraction is held out, as what is fitted and as what is held out."""
        return cls.whole(robot, log, threads).with_end_held_out(holdout)

    def with_end_held_out(self, holdout: float) -> tuple[Self, Self]:
        """The same with its last fraction held out: what is fitted, and what is held out."""
        fitted = np.arange(len(self.recording)) < len(holdout_split(self.recording, holdout)[0])
        return self.scoring(fitted), self.scoring(~fitted)

    @property
    def procedure(self) -> Procedure:
        """How a fit goes about it."""
        return Procedure()

    @cached_property
    def log(self) -> Log:
        """The recording up to the last sample that counts: what comes later is not replayed."""
        stop = int(np.flatnonzero(self.scored)[-1]) + 1 if self.scored.any() else 0
        if stop == len(self.recording):
            return self.recording
        return self.recording.once(("begin", stop), lambda: self.recording.window(0, stop))

    @property
    def begin(self) -> float:
        """Time of the first sample that counts, s since the first of all."""
        return float(self.log.time[int(np.argmax(self.scored))] - self.log.time[0])

    @property
    def compared(self) -> BoolArray:
        """(n,) samples of `log` that count and are replayed."""
        return self.scored[: len(self.log)]

    @property
    def base_poses(self) -> FloatArray | None:
        """Position and quaternion (n, 7) of a free base at the samples of `log`; None of a fixed one."""
        return None

    def logged(self, channels: Sequence[str]) -> tuple[str, ...]:
        """Those of the channels that the log has of any joint of the model."""
        joints = joint_names(self.robot.for_log(self.log))
        return tuple(c for c in channels if any(self.log.has(c, j) for j in joints))

    @abstractmethod
    def replay(self, terms: Sequence[Term], numerics: Numerics, *, effort: bool = False, threads: int = 0) -> Replay:
        """Its replay under some terms."""

    def compare(
        self,
        terms: Terms,
        channels: Sequence[str],
        numerics: Numerics,
        *,
        inflation: Inflation | None = None,
        threads: int = 0,
    ) -> Comparison:
        """Its replay, and what that is compared with.

        Raises
        ------
        ModelError
            If there is nothing to compare.
        """
        log, present = self.log, self.logged(channels)
        others = self.logged([c for c in COMPARED if c not in channels])
        if others and not present:
            raise ModelError(
                f"log {log.path or ''}: it has no {' and no '.join(channels)} of the model's joints to compare; "
                f"it has {', '.join(others)}: --channels {','.join(others)}"
            )
        replay = self.replay(terms, numerics, effort="effort" in present, threads=threads)
        targets = make_targets(log, replay.index.joints, present, self.warm_up)
        targets = tuple(_doubting(target, replay) for target in targets)
        predicted = self.predicts_torque(replay)
        if not predicted.all():
            targets = tuple(t.only(predicted[t.columns]) if t.channel == "effort" else t for t in targets)
            targets = tuple(t for t in targets if t.joints)
        if not targets:
            raise ModelError(f"log {log.path or ''}: none of the channels {', '.join(channels)} can be compared")
        inside = self.compared[:, None]
        inflated = (_with_noise(target, log.meta.mount, inflation or {}) for target in targets)
        return self.completed(Comparison(replay, tuple(replace(t, mask=t.mask & inside) for t in inflated)))

    def completed(self, plain: Comparison) -> Comparison:
        """A comparison with what else is known of an episode of this kind."""
        return plain

    def predicts_torque(self, replay: Replay) -> BoolArray:
        """(j,) joints of a replay whose torque is predicted: those with a drive that is not given its torque."""
        index, given = replay.index, driven_by_effort(self.log, replay.robot.model)
        return np.asarray((index.actuator >= 0) & [joint not in given for joint in index.joints])

    @property
    def breaks(self) -> IntArray:
        """Samples of `log` at which its replay begins anew."""
        return np.zeros(0, dtype=np.int64)

    def scoring(self, scored: BoolArray) -> Self:
        """The same with other samples that count."""
        return replace(self, scored=scored)

    def torque_at_hand(self, outputs: Outputs) -> FloatArray:
        """Torques (n, j) by which sizes are judged: those of the servos in a replay of the plain model."""
        assert outputs.effort is not None
        return np.asarray(outputs.effort[0])

    def shortened(self, seconds: float) -> Self:
        """So many seconds of it at most."""
        time = self.log.time
        stop = max(int(np.searchsorted(time, time[0] + seconds)), 2)
        return self.scoring(self.scored & (np.arange(len(self.scored)) < stop))

    def with_initial_states(
        self, compare: Callable[[], Comparison], values: FloatArray, coarse: Numerics, *, anew: bool = True
    ) -> Self:
        """The same with its initial states where the data want them under a candidate (p,), unless those are known.

        Parameters
        ----------
        compare : makes the comparison of this episode.
        coarse : integrator and step for derivatives with respect to the initial states.
        anew : whether derivatives that are known are taken again.
        """
        return self

    def with_share(self, share: float) -> Self:
        """The same with segments of a fraction of their length, if that can be chosen."""
        return self

    def with_later_segments(self) -> Self:
        """The same with segments that begin half a segment later, if it has any."""
        return self

    def choose_numerics(self, threads: int = 0, simulator: str = MUJOCO) -> tuple[Numerics, float]:
        """Integrator and step to begin with, and the change in noise floors when the step is halved."""
        return choose_numerics(self.robot, self.log, threads, simulator)

    @property
    def open_loop(self) -> Episode | None:
        """All of its recording replayed from the first sample, where it is not compared so itself but could be."""
        return None

    def facts(self) -> Mapping[str, Any] | None:
        """What a result says about how it was segmented, and what its base state lacks; None where it is not."""
        return None


def _doubting(target: Target, replay: Replay) -> Target:
    """A target whose floors do not take a position for noise that hides the motion which its servo was commanded."""
    if target.channel != "position":
        return target
    commands, servo = commanded(replay.log, replay.robot.model), replay.index.driven_by("position")
    floor = list(target.floor)
    for k, joint in enumerate(target.joints):
        if floor[k].method != "high-frequency" or not servo[target.columns[k]] or not commands.has("command", joint):
            continue
        if hides_motion(target.measured[:, k], commands.channels[f"command.{joint}"]):
            floor[k] = assumed_floor(target.measured[:, k])
    return replace(target, floor=tuple(floor), sigma=np.array([f.sigma for f in floor]))


def _with_noise(target: Target, mount: str, inflation: Inflation) -> Target:
    """A target with the noise that columns of its mount are given."""
    if not inflation:
        return target
    factors = [inflation.get((mount, target.channel, joint), 1.0) for joint in target.joints]
    return replace(target, sigma=target.noise * factors)


@dataclass(frozen=True, eq=False)
class FixedEpisode(Episode):
    """One whose base is fixed: it is replayed whole, as one segment, from its first sample.

    Attributes
    ----------
    begun : state from which it is replayed, see `Replay`.
    """

    begun: Start | None = None

    warm_up: ClassVar[float] = WARM_UP

    @classmethod
    def whole(cls, robot: Robot, log: Log, threads: int = 0) -> Self:
        return cls(robot, log, np.ones(len(log), dtype=bool))

    def replay(self, terms: Sequence[Term], numerics: Numerics, *, effort: bool = False, threads: int = 0) -> Replay:
        robot = self.robot.for_log(self.log)
        return Replay(robot, self.log, tuple(terms), numerics, effort, threads, begun=self.begun)

    def with_initial_states(
        self, compare: Callable[[], Comparison], values: FloatArray, coarse: Numerics, *, anew: bool = True
    ) -> FixedEpisode:
        # a model of which nothing was fitted yet would move it by its own errors
        return replace(self, begun=wanted_start(compare(), values)) if len(values) else self
