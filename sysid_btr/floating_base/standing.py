"""Episodes of a robot that stands without an inertial unit: replayed whole, from where it stands at first.

What stands on its feet is held as one whose base is fixed is: servos take errors of the start back, and the ground
those of the base. A replay of all of the log needs no measured state of the base then but a first one, soon forgotten.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, Self

import numpy as np

from sysid_btr._typing import BoolArray, FloatArray
from sysid_btr.floating_base.estimate import BaseState
from sysid_btr.floating_base.events import find_fall
from sysid_btr.floating_base.orientation import tilt_of
from sysid_btr.floating_base.reconstruction import reconstruct
from sysid_btr.floating_base.segments import FASTEST, whole_step
from sysid_btr.identify.episode import ROUGH_STEP, E, FixedEpisode, Procedure
from sysid_btr.identify.horizon import is_held
from sysid_btr.identify.numerics import choose_numerics
from sysid_btr.io.log import Log
from sysid_btr.io.noise import position_noise
from sysid_btr.models.robot import Robot
from sysid_btr.mujoco_conventions import to_rotation
from sysid_btr.objectives.problem import Comparison
from sysid_btr.objectives.targets import Target
from sysid_btr.simulation.base_states import BaseStates, free_addresses
from sysid_btr.simulation.numerics import MUJOCO, Numerics
from sysid_btr.simulation.replay import Replay
from sysid_btr.simulation.silence import silenced
from sysid_btr.terms.base import Term
from sysid_btr.terms.contact import EVERYWHERE, FootCompliance
from sysid_btr.terms.inertial import GravityTilt
from sysid_btr.terms.model import Terms

DROPPED = 0.005
"""m of a Nao (`BodySize`), from which a robot is dropped to see whether it forgets how it began."""
SETTLING, HEAVY = 1.0, 1e6
"""s of a Nao that a base is given to come to rest, and inertia of its joints then, in those of the robot."""
SLOPE, USUAL, SHOWS = 0.002, 1.5, 0.5
"""rad, a small slope of the ground; how many times what it usually does to a joint is too much; and noise floors up to
which that does not matter. Of six simulated humanoids, 20 s each, errors of the right model where it did three times as
much were 10 to 21 noise floors, root mean square, elsewhere 1.7 to 2.9."""
WORTH = 1.0
"""Decrease of the sum of squares, in their mean, worth another step: with less no estimate moves by its deviation."""
SOFTER = 1.5
"""Factor on the time constant of the contact that nobody can exclude: models have it from no measurement."""


@dataclass(frozen=True, eq=False)
class GroundSensitivity:
    """What the ground does to the joints of a robot that stands, as far as it is not known.

    Attributes
    ----------
    steady : (n, j) samples and joints at which it matters about as much as it usually does.
    softness : (j,) rad, root mean square over these of what another softness does.
    """

    steady: BoolArray
    softness: FloatArray

    def discounted(self, target: Target) -> Target:
        """A target without the other samples, whose floors of positions hold for what the ground does."""
        n, columns = len(target.mask), target.columns
        mask = target.mask.copy()
        mask[: len(self.steady)] &= self.steady[:n, columns]
        if target.channel != "position":
            return replace(target, mask=mask)
        sigma = np.hypot(target.noise, self.softness[columns])
        floor = tuple(replace(f, sigma=float(s)) for f, s in zip(target.floor, sigma, strict=True))
        return replace(target, mask=mask, floor=floor, sigma=target.sigma * (sigma / target.noise))


@dataclass(frozen=True)
class StandingProcedure(Procedure):
    """How a fit goes about robots that stand: as where the base is fixed, but soles that stick and slip leave a little
    roughness under any step of the integrator.
    """

    uncertain: Mapping[str, float] = field(default_factory=dict)

    demand: ClassVar[int] = 1
    refines_step: ClassVar[bool] = False
    on_ground: ClassVar[bool] = True

    def cheap(self, numerics: Numerics) -> Numerics:
        # by a cruder integrator it rocks at other times
        return numerics

    def stencil(self, terms: Terms) -> float:
        return ROUGH_STEP

    def suited(self, estimator: E) -> E:
        return estimator.for_rough_objective(ROUGH_STEP, WORTH)


@dataclass(frozen=True, eq=False)
class StandingEpisode(FixedEpisode):
    """One whose base is free and stands all the time: it is replayed whole, from where it stands at first.

    Attributes
    ----------
    base : reconstructed motion of the base, sample by sample of `recording`.
    ground : what the ground does to the joints, once known.
    """

    base: BaseState = field(kw_only=True)
    ground: GroundSensitivity | None = None

    @property
    def procedure(self) -> Procedure:
        model = self.robot.model
        feet = [foot for foot in self.base.feet if model.body(foot).mass[0] > 0]
        softness = f"foot_compliance:{','.join(feet)}=shared"
        return StandingProcedure({softness: SOFTER - 1} if feet else {})

    @classmethod
    def whole(cls, robot: Robot, log: Log, threads: int = 0) -> Self:
        """All of a recording up to a fall."""
        log, base = reconstruct(robot, log)
        return cls(robot, log, np.ones(len(log), dtype=bool), base=base)

    @staticmethod
    def suits(robot: Robot, log: Log, threads: int = 0) -> bool:
        """Whether the plain model keeps standing where the log's robot does, and forgets from where it began."""
        return log.once(("stands", robot.fingerprint, robot.at), lambda: _stands(robot, log, threads))

    @property
    def base_start(self) -> BaseStates:
        """State of the base at the first sample."""
        return _begin(self.robot, self.recording, self.base)

    @property
    def base_poses(self) -> FloatArray:
        return self.base.poses[: len(self.log)]

    def replay(self, terms: Sequence[Term], numerics: Numerics, *, effort: bool = False, threads: int = 0) -> Replay:
        return replace(super().replay(terms, numerics, effort=effort, threads=threads), base_start=self.base_start)

    def completed(self, plain: Comparison) -> Comparison:
        if self.ground is None:
            return plain
        return replace(plain, targets=tuple(map(self.ground.discounted, plain.targets)))

    def with_initial_states(
        self, compare: Callable[[], Comparison], values: FloatArray, coarse: Numerics, *, anew: bool = True
    ) -> StandingEpisode:
        comparison = compare()
        found = super().with_initial_states(lambda: comparison, values, coarse, anew=anew)
        assert isinstance(found, StandingEpisode)
        if found.ground is not None and not anew:
            return found
        replay = replace(comparison.replay, begun=found.begun, effort=False)
        known = ground_sensitivity(replay, values)
        return found if known is None else replace(found, ground=known)

    def choose_numerics(self, threads: int = 0, simulator: str = MUJOCO) -> tuple[Numerics, float]:
        return choose_numerics(self.robot, self.log, threads, simulator, self.base_start)

    def facts(self) -> Mapping[str, Any]:
        rocking = 0.0 if self.ground is None else float(np.mean(~self.ground.steady))
        more = f"; {rocking:.0%} of all positions, while it rocks on its soles, do not count" if rocking >= 0.01 else ""
        return {
            "mode": "forward",
            "why": self.why,
            "summary": f"floating base: replayed whole, from where it stands at first{more}",
            "events": [str(event) for event in self.base.events],
            "used_until": float(self.log.time[-1]),
            "lost": self.base.lost,
        }


def ground_sensitivity(replay: Replay, values: FloatArray) -> GroundSensitivity | None:
    """What the ground does to the joints; None where the replay fails.

    On the edges of its soles a robot is an upside-down pendulum, and whatever little the model has wrong of the ground
    and the soles grows: a slope shows where.

    Parameters
    ----------
    replay, values : of a robot that stands, and the candidate (p,).
    """
    varied = replace(replay, terms=(*replay.terms, GravityTilt(EVERYWHERE), FootCompliance(EVERYWHERE)))
    changes = [(0, 0, 1), (SLOPE, 0, 1), (-SLOPE, 0, 1), (0, SLOPE, 1), (0, -SLOPE, 1), (0, 0, SOFTER)]
    with silenced():
        seen = varied.predict(np.column_stack([np.tile(values, (len(changes), 1)), changes])).position
    if not np.isfinite(seen).all():
        return None
    seen = seen[1:] - seen[0]
    moved = np.sqrt(np.mean(seen[:-1] ** 2, axis=0)) / position_noise(replay.log, replay.index.joints)
    steady = moved <= np.maximum(USUAL * np.median(moved, axis=0), SHOWS)
    return GroundSensitivity(steady, np.sqrt(np.mean(seen[-1] ** 2, axis=0, where=steady)))


def _begin(robot: Robot, log: Log, base: BaseState) -> BaseStates:
    """State of the base at the first sample: where it comes to rest on joints that are held, moving as the feet say."""
    return log.once(("begin on feet", robot.fingerprint, robot.at), lambda: _settled(robot.for_log(log), log, base))


def _settled(robot: Robot, log: Log, base: BaseState) -> BaseStates:
    import mujoco

    step = base.size.time(FASTEST)
    replay = Replay(robot, log, (), Numerics("implicitfast", step))
    model = copy.copy(replay.model)
    place, _ = free_addresses(model)
    model.dof_armature[replay.index.dof] = HEAVY * base.size.weight / base.size.gravity * base.size.leg**2
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_ACTUATION
    data = mujoco.MjData(model)
    data.qpos[replay.index.qpos] = replay.start[0]
    data.qpos[place : place + 7] = base.poses[0]
    mujoco.mj_step(model, data, round(base.size.time(SETTLING) / step))
    pose = data.qpos[None, place : place + 7] if np.isfinite(data.qpos).all() else base.poses[:1]
    return BaseStates(pose[:, :3].copy(), pose[:, 3:].copy(), base.velocity[:1], base.rate[:1])


def _stands(robot: Robot, log: Log, threads: int) -> bool:
    if not is_held(robot, log):
        return False
    log, base = reconstruct(robot, log)
    start = _begin(robot, log, base)
    numerics = Numerics("implicitfast", whole_step(float(np.median(np.diff(log.time))), base.size.time(FASTEST)))
    higher = replace(start, position=start.position + np.array([0.0, 0.0, base.size.length(DROPPED)]))
    configured = robot.for_log(log)
    with silenced():
        here, there = (
            Replay(configured, log, (), numerics, threads=threads, base_start=s).predict(np.zeros((1, 0)))
            for s in (start, higher)
        )
    if here.base is None or not (np.isfinite(here.position).all() and np.isfinite(there.position).all()):
        return False
    tilt = tilt_of(to_rotation(here.base[0, :, 3:7]).as_matrix())
    apart = (there.position - here.position)[0, len(log) // 2 :] / position_noise(log, base.joints)
    forgotten = np.sqrt(np.mean(apart**2, axis=0)) < 1.0
    return bool(forgotten.all()) and find_fall(log.time, tilt) is None
