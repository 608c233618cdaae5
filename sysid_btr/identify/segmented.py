"""Episodes of a fixed base by segments: for robots whose replay from the first sample alone goes its own way.

What torques drive, and gravity, has no servo to hold it: errors of the start and of the model grow as they do in the
robot itself. Segments start from measured states, whose uncertainty is integrated out (multiple shooting: Bock 1983,
doi:10.1007/978-1-4684-7324-7_7; with errors in the measured states, Voss, Timmer and Kurths 2004,
doi:10.1142/S0218127404010345). First fits take short ones, on which the objective is smooth, and longer ones as the
model gets better (Ribeiro et al. 2020, doi:10.1016/j.automatica.2020.109158).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Self

import numpy as np

from sysid_btr._typing import BoolArray, FloatArray, IntArray
from sysid_btr.errors import LogError, ModelError
from sysid_btr.identify.episode import Episode, FixedEpisode, Procedure
from sysid_btr.identify.horizon import linear_seconds
from sysid_btr.identify.initial_states import respond, update_initial_states
from sysid_btr.identify.numerics import choose_numerics, converged, largest_step
from sysid_btr.identify.smoothing import Tracks, smooth_joints
from sysid_btr.io.log import Log
from sysid_btr.models.pose import resting
from sysid_btr.models.robot import Robot, joint_names
from sysid_btr.objectives.marginal import Marginal
from sysid_btr.objectives.problem import BLOCK, Comparison
from sysid_btr.simulation.numerics import MUJOCO, Numerics
from sysid_btr.simulation.segments import SegmentReplay, Segments, covered, segment_seconds, spread_evenly
from sysid_btr.simulation.silence import silenced
from sysid_btr.terms.base import Term
from sysid_btr.terms.model import Terms

WIDENED = 2.0
"""Factor on the smoother's standard deviations: it has used the segment's own samples as well."""
CHECKED = 16
"""Segments on which the step is chosen."""
STARTS = 5
"""Samples of a log from which it is asked how long a replay can be followed."""
LATEST = 0.8
"""Fraction of a log before which they lie: what is left after them must be long enough to tell."""
KEPT = 0.25
"""Fraction of the time over which replays are linear that a segment lasts at most: a fit tries changes that are larger
than those. Thin: on one simulated log (friction undeclared) the worst estimate was off by 1.5 % over all of that time
and by 1.0 % over a quarter; on two measured logs together the former did not converge."""
SHARES = (1 / 4, 1.0, 1.0)
"""Lengths of segment in first fits, as fractions of the one that is chosen."""
MOVES = 3
"""Steps of the initial states towards where the data want them, each time the model changed."""
FEWEST = 4
"""Samples of a segment, at least: as many as states of a joint and two more."""


@dataclass(frozen=True)
class SegmentedProcedure(Procedure):
    """How a fit goes about segments of a fixed base: initial states and parameters in turn."""

    demand: ClassVar[int] = 1
    alternations: ClassVar[tuple[int, ...]] = (5, 5, 5)
    shares: ClassVar[tuple[float, ...]] = SHARES
    wanders: ClassVar[bool] = True
    no_torque: ClassVar[str] = "the replay fails, or too little of it moves"


@dataclass(frozen=True, eq=False)
class SegmentedEpisode(Episode):
    """One whose base is fixed, replayed by segments from measured states.

    Attributes
    ----------
    tracks : measured motion of the joints of the model, sample by sample of `recording`, with standard deviations.
    segments : stretches of `recording` that are replayed, and their initial states.
    seconds : length of segment that was chosen.
    marginal : what the uncertainty of the initial states can do, once known.
    """

    tracks: Tracks
    segments: Segments
    seconds: float
    marginal: Marginal | None = None

    @property
    def procedure(self) -> Procedure:
        return SegmentedProcedure()

    @classmethod
    def whole(cls, robot: Robot, log: Log, threads: int = 0, *, seconds: float | None = None) -> Self:
        """All of a recording, in segments of about so many seconds; None for what `follow` finds.

        Raises
        ------
        LogError
            If no joint's position is logged.
        """
        tracks = measured_motion(robot, log)
        length = follow(robot, log, threads) if seconds is None else seconds
        every = np.ones(len(log), dtype=bool)
        return cls(robot, log, every, tracks, _cut(log, tracks, length, every), length)

    @classmethod
    def split(
        cls, robot: Robot, log: Log, holdout: float, threads: int = 0, *, seconds: float | None = None
    ) -> tuple[Self, Self]:
        """A recording whose last fraction is held out, as what is fitted and as what is held out.

        Raises
        ------
        LogError
            If no joint's position is logged, or a part would be too short.
        """
        return cls.whole(robot, log, threads, seconds=seconds).with_end_held_out(holdout)

    def scoring(self, scored: BoolArray) -> Self:
        """The same with other samples that count, and with segments that start anew from measured states."""
        cut = _cut(self.recording, self.tracks, self.seconds, scored)
        return replace(self, scored=scored, segments=cut, marginal=None)

    def with_share(self, share: float) -> SegmentedEpisode:
        cut = _cut(self.recording, self.tracks, share * self.seconds, self.scored)
        return replace(self, segments=cut, marginal=None)

    @property
    def compared(self) -> BoolArray:
        return super().compared & covered(self.segments, len(self.log))

    @property
    def breaks(self) -> IntArray:
        return self.segments.rows[:, 0]

    def replay(
        self, terms: Sequence[Term], numerics: Numerics, *, effort: bool = False, threads: int = 0
    ) -> SegmentReplay:
        robot = self.robot.for_log(self.log)
        return SegmentReplay(robot, self.log, tuple(terms), numerics, effort, threads, segments=self.segments)

    def completed(self, plain: Comparison) -> Comparison:
        # what is left in one segment is correlated all along it
        seconds = segment_seconds(self.segments, self.log)
        return replace(plain, marginal=self.marginal, stretch=seconds * np.ceil(BLOCK / seconds))

    def shortened(self, seconds: float) -> SegmentedEpisode:
        """The same samples with few segments, spread evenly over them."""
        which = spread_evenly(self.segments, self.log, seconds)
        marginal = None if self.marginal is None else self.marginal.chosen(which)
        return replace(self, segments=self.segments.chosen(which), marginal=marginal)

    def with_initial_states(
        self, compare: Callable[[], Comparison], values: FloatArray, coarse: Numerics, *, anew: bool = True
    ) -> SegmentedEpisode:
        found = self
        # a model that was not fitted yet must not move them: its errors are larger than theirs
        for _ in range(1 if self.marginal is None else MOVES):
            comparison = replace(compare(), marginal=found.marginal)
            assert isinstance(comparison.replay, SegmentReplay)
            replay = replace(comparison.replay, segments=found.segments, numerics=coarse)
            if found.marginal is None:
                return replace(found, marginal=respond(replay, values))
            segments, marginal = update_initial_states(
                replay, comparison.targets, found.marginal, values, coarse, anew=anew, damped=True
            )
            found = replace(found, segments=segments, marginal=marginal)
        return found

    def choose_numerics(self, threads: int = 0, simulator: str = MUJOCO) -> tuple[Numerics, float]:
        """As for a whole replay, judged over segments as short as those of first fits, their starts integrated out.

        What a step does wrong grows along long ones as every other error does, which a fit answers for (`step_check`).
        It is small beside what the plain model leaves, or beside the noise where that leaves none.
        """
        if self.log.meta.servo_period:
            return choose_numerics(self.robot, self.log, threads, simulator)
        first, plain = largest_step(self.log, simulator), np.zeros((1, 0))
        short = self.with_share(SHARES[0])
        which = np.unique(np.linspace(0, len(short.segments) - 1, CHECKED).astype(np.int64))
        few = replace(short, segments=short.segments.chosen(which))
        few = replace(few, marginal=respond(few.replay((), first, threads=threads), plain[0]))

        def errors(numerics: Numerics) -> dict[str, FloatArray]:
            compared = few.compare(Terms(()), ("position",), numerics, threads=threads)
            target = compared.targets[0]
            with silenced():
                found = compared.errors(compared.replay.predict(plain))[0]
            white = {j: found[target.mask[:, k], k] / target.noise[k] for k, j in enumerate(target.joints)}
            # the size of what is left, once and for all steps
            left.update({j: max(float(np.sqrt(np.mean(x**2))), 1.0) for j, x in white.items() if j not in left})
            return {j: target.noise[k] * white[j] / left[j] for k, j in enumerate(target.joints)}

        left: dict[str, float] = {}
        chosen, error = converged(first, errors, self.log)
        if not np.isfinite(error):
            raise ModelError(
                f"model {self.robot.name}: segments of {segment_seconds(few.segments, self.log):.3g} s of "
                f"{self.log.path or 'the log'} diverge even with a step of {1e3 * chosen.timestep:g} ms. Check "
                "armature and masses of the model: a body without mass is the usual cause."
            )
        return chosen, error

    @property
    def open_loop(self) -> Episode | None:
        return FixedEpisode.whole(self.robot, self.recording)

    def facts(self) -> Mapping[str, Any]:
        seconds = segment_seconds(self.segments, self.log)
        return {
            "mode": "segments",
            "why": self.why,
            "summary": f"replayed in {len(self.segments)} segments of {seconds:.3g} s, from measured states",
            "window": seconds,
            "windows": len(self.segments),
        }


def follow(robot: Robot, log: Log, threads: int = 0) -> float:
    """For how long replays by the plain model can be followed, s.

    For so long half of those from different samples are well within what is linear, and near the log: `linear_seconds`.
    """
    return log.once(("followed", robot.fingerprint, robot.at), lambda: _follow(robot, log, threads))


def _follow(robot: Robot, log: Log, threads: int) -> float:
    tracks, n = measured_motion(robot, log), len(log)
    first = np.linspace(0, LATEST * n, STARTS).astype(np.int64)
    linear, near = linear_seconds(
        robot, log, _starts_at(tracks, np.stack([first, np.full(STARTS, n)], axis=1)), threads
    )
    least = FEWEST * float(np.median(np.diff(log.time)))
    return max(float(np.median(np.minimum(KEPT * linear, near))), least)


def measured_motion(robot: Robot, log: Log) -> Tracks:
    """Positions and velocities of the model's joints, (n, j), from what the log has of their positions.

    From positions alone: a logged velocity is the encoder's, filtered, and no second measurement. A joint whose
    position is not logged stays where it rests.

    Raises
    ------
    LogError
        If no joint's position is logged.
    """
    configured = robot.for_log(log)
    joints = joint_names(configured)
    rest = resting(configured, log, joints)
    known = [k for k, j in enumerate(joints) if log.has("position", j)]
    if not known:
        raise LogError(f"log {log.path or ''}: segments start from measured positions, and it has none of this model")
    return log.once(("tracks", joints, tuple(rest)), lambda: _smoothed(log, joints, known, rest))


def _smoothed(log: Log, joints: Sequence[str], known: Sequence[int], rest: FloatArray) -> Tracks:
    shape = (len(log), len(joints))
    position, velocity = np.tile(rest, (len(log), 1)), np.zeros(shape)
    acceleration, position_std, velocity_std = np.zeros(shape), np.zeros(shape), np.zeros(shape)
    found = smooth_joints(log.time - log.time[0], log.array("position", [joints[k] for k in known]))
    position[:, known], velocity[:, known] = found.position, found.velocity
    acceleration[:, known] = found.acceleration
    position_std[:, known], velocity_std[:, known] = found.position_std, found.velocity_std
    return Tracks(position, velocity, acceleration, position_std, velocity_std)


def _cut(log: Log, tracks: Tracks, seconds: float, scored: BoolArray) -> Segments:
    """Segments of about so many seconds that tile the samples (n,) from the first that counts to the last."""
    period = float(np.median(np.diff(log.time)))
    rows = np.flatnonzero(scored)
    begin, end = int(rows[0]), int(rows[-1]) + 1
    most = max((end - begin) // FEWEST, 1)
    count = int(np.clip(round((end - begin) * period / seconds), 1, most))
    borders = np.linspace(begin, end, count + 1).round().astype(np.int64)
    return _starts_at(tracks, np.stack([borders[:-1], borders[1:]], axis=1))


def _starts_at(tracks: Tracks, rows: IntArray) -> Segments:
    """Segments that start from the measured state."""
    first = rows[:, 0]
    std = WIDENED * np.concatenate([tracks.position_std[first], tracks.velocity_std[first]], axis=1)
    rate = tracks.acceleration[first]
    return Segments(rows, tracks.position[first], tracks.velocity[first], std, joint_acceleration=rate)
