"""Episodes of a floating base: segments that start from reconstructed states, known within an uncertainty."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, ClassVar, Self

import numpy as np

from sysid_btr._typing import BoolArray, FloatArray, IntArray
from sysid_btr.floating_base.estimate import BaseState
from sysid_btr.floating_base.fusion import WIDE_STEP, fuse
from sysid_btr.floating_base.reconstruction import MOST_WALKED, reconstruct
from sysid_btr.floating_base.segments import (
    FASTEST,
    FloatingReplay,
    SegmentLength,
    segment_best,
    segment_log,
    segment_numerics,
    whole_step,
)
from sysid_btr.identify.deferred import LEAST_GAIN
from sysid_btr.identify.episode import E, Episode, Fused, Procedure
from sysid_btr.identify.initial_states import update_initial_states
from sysid_btr.io.log import Log
from sysid_btr.io.split import holdout_split
from sysid_btr.models.robot import Robot
from sysid_btr.objectives.marginal import Marginal
from sysid_btr.objectives.problem import BLOCK, Comparison, ReplayProblem
from sysid_btr.simulation.numerics import MUJOCO, Numerics
from sysid_btr.simulation.segments import Segments, covered, segment_seconds, spread_evenly
from sysid_btr.terms.base import Term
from sysid_btr.terms.model import Terms

COUNTED_LESS = 0.9
"""Weight below which a segment counts as one that the model does not explain."""


@dataclass(frozen=True)
class FloatingProcedure(Procedure):
    """How a fit goes about episodes of a floating base: impacts roughen the objective, and no step is fine enough.

    Attributes
    ----------
    longest_step : of the coarse integrator, s.
    """

    longest_step: float = np.inf

    demand: ClassVar[int] = 1
    alternations: ClassVar[tuple[int, ...]] = (5, 3)
    coarse_suffices: ClassVar[bool] = True
    deferred: ClassVar[bool] = True
    refines_step: ClassVar[bool] = False
    weighs_segments: ClassVar[bool] = True
    holds_out_anywhere: ClassVar[bool] = False
    fuses: ClassVar[bool] = True
    costly: ClassVar[bool] = True
    on_ground: ClassVar[bool] = True
    leaves_ground_error: ClassVar[bool] = True
    tolerated: ClassVar[float] = 4.0
    no_torque: ClassVar[str] = "its base was floating, and segments are too short"

    def coarse(self, numerics: Numerics) -> Numerics:
        step = whole_step(numerics.timestep, self.longest_step)
        return replace(numerics, integrator="implicitfast", timestep=step, servo_period=None)

    def cheap(self, numerics: Numerics) -> Numerics:
        return self.coarse(numerics)

    def stencil(self, terms: Terms) -> float:
        return WIDE_STEP

    def suited(self, estimator: E) -> E:
        return estimator.for_rough_objective(WIDE_STEP, LEAST_GAIN)

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
        coarse = self.coarse(problem.episodes[0].replay.numerics)
        return fuse(problem, values, jacobian, residual, elsewhere, coarse, follow=follow)


@dataclass(frozen=True, eq=False)
class FloatingEpisode(Episode):
    """An episode whose base was free, up to a fall.

    Attributes
    ----------
    base : reconstructed motion, sample by sample of `log`.
    segments : stretches of `log` that are replayed, and their initial states.
    marginal : what the uncertainty of the initial states can do, once known.
    lengths : lengths of segment that were tried, best first.
    """

    base: BaseState
    segments: Segments
    marginal: Marginal | None = None
    lengths: tuple[SegmentLength, ...] = ()

    @property
    def procedure(self) -> Procedure:
        return FloatingProcedure(self.base.size.time(FASTEST))

    @property
    def base_poses(self) -> FloatArray:
        return self.base.poses[: len(self.log)]

    @classmethod
    def whole(cls, robot: Robot, log: Log, threads: int = 0) -> Self:
        """All of a recording, up to a fall.

        Raises
        ------
        LogError, ModelError
            If the base cannot be reconstructed, or too few segments fit in.
        """
        log, base = reconstruct(robot, log)
        segments, lengths = segment_best(robot, log, base, (), threads)
        return cls(robot, log, np.ones(len(log), dtype=bool), base, segments, None, lengths)

    @classmethod
    def split(cls, robot: Robot, log: Log, holdout: float, threads: int = 0) -> tuple[Self, Self]:
        """A recording whose last fraction before a fall is held out; the fitted part says how long segments are."""
        log, base = reconstruct(robot, log)
        count = len(holdout_split(log, holdout)[0])
        segments, lengths = segment_best(robot, log, base, (float(log.time[count] - log.time[0]),), threads)
        fitted = np.arange(len(log)) < count
        inside = fitted[segments.rows[:, 0]]
        return (
            cls(robot, log, fitted, base.rows(0, count), segments.chosen(np.flatnonzero(inside)), None, lengths),
            cls(robot, log, ~fitted, base, segments.chosen(np.flatnonzero(~inside)), None, lengths),
        )

    @property
    def compared(self) -> BoolArray:
        return super().compared & covered(self.segments, len(self.log))

    def replay(
        self, terms: Sequence[Term], numerics: Numerics, *, effort: bool = False, threads: int = 0
    ) -> FloatingReplay:
        robot = self.robot.for_log(self.log)
        return FloatingReplay(
            robot, self.log, tuple(terms), numerics, effort, threads, segments=self.segments, base=self.base
        )

    def completed(self, plain: Comparison) -> Comparison:
        return replace(plain, marginal=self.marginal, stretch=self.base.size.time(BLOCK))

    def shortened(self, seconds: float) -> FloatingEpisode:
        """The same samples with few segments, so many seconds of a Nao's, spread evenly over them."""
        return self._with(spread_evenly(self.segments, self.log, self.base.size.time(min(seconds, MOST_WALKED))))

    def _with(self, which: IntArray) -> FloatingEpisode:
        marginal = None if self.marginal is None else self.marginal.chosen(which)
        return replace(self, segments=self.segments.chosen(which), marginal=marginal)

    def with_initial_states(
        self, compare: Callable[[], Comparison], values: FloatArray, coarse: Numerics, *, anew: bool = True
    ) -> FloatingEpisode:
        comparison = compare()
        assert isinstance(comparison.replay, FloatingReplay)
        segments, marginal = update_initial_states(
            comparison.replay, comparison.targets, self.marginal, values, coarse, anew=anew, weigh=True
        )
        return replace(self, segments=segments, marginal=marginal)

    def with_later_segments(self) -> FloatingEpisode:
        segments = segment_log(self.log, self.base, segment_seconds(self.segments, self.log), late=0.5)
        return replace(self, segments=segments, marginal=None)

    def choose_numerics(self, threads: int = 0, simulator: str = MUJOCO) -> tuple[Numerics, float]:
        return segment_numerics(self.robot, self.log, self.segments, self.base.size, threads, simulator)

    def facts(self) -> Mapping[str, Any]:
        weight = np.ones(0) if self.marginal is None else self.marginal.weight
        seconds = segment_seconds(self.segments, self.log)
        return {
            "mode": "segments",
            "summary": f"floating base: {len(self.segments)} segments of {seconds:.2g} s fitted, each from an "
            "estimated state",
            "window": seconds,
            "windows": len(self.segments),
            "counted_less": int(np.sum(weight < COUNTED_LESS)),
            "windows_tried": [asdict(length) for length in self.lengths],
            "events": [str(event) for event in self.base.events],
            "used_until": float(self.log.time[-1]),
            "lost": self.base.lost,
        }
