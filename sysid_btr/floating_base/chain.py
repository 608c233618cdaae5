"""A walk as a chain of steps of one sample each, without contact.

Forces and torques that nobody knows act on the feet that may touch; the states at the samples and these are what the
encoders, the gyro and the vertical of the log leave most probable (simultaneous estimation of inputs and states:
Gillijns and De Moor 2007, doi:10.1016/j.automatica.2006.08.002; as one sparse least-squares problem over the walk).
Lengths, times and speeds below are the Nao's; `BodySize` makes them those of the robot.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from functools import cache, cached_property
from typing import TYPE_CHECKING

import numpy as np

from sysid_btr._typing import BoolArray, FloatArray, IntArray
from sysid_btr.floating_base.attitude import NEAR
from sysid_btr.floating_base.estimate import foot_loads, foot_surfaces
from sysid_btr.floating_base.feet import Foot, touching_bodies
from sysid_btr.floating_base.segments import FloatingReplay, starts_at, whole_step
from sysid_btr.floating_base.size import BodySize
from sysid_btr.io.log import Log
from sysid_btr.io.noise import noise_floor
from sysid_btr.mujoco_conventions import to_rotation
from sysid_btr.simulation.base_states import BASE, BaseStates, free_addresses
from sysid_btr.simulation.compiling import compile_model, make_index
from sysid_btr.simulation.segments import SegmentReplay, Segments
from sysid_btr.simulation.setup import Setup, Values
from sysid_btr.simulation.silence import silenced
from sysid_btr.terms.friction import CoulombFriction
from sysid_btr.terms.model import Terms

if TYPE_CHECKING:
    import mujoco

    from sysid_btr.terms.base import BatchModel, Fields, JointAddresses, Term

LONGEST = 0.010
"""s, longest step of the fourth-order integrator for derivatives, which it gets right to 1 %: tests. Predictions take
half of it, and are right to a thousandth of the noise."""
ROUGH_ERROR, CHECKED, CHECKS = 0.05, 16, 4
"""Fraction by which changes with that step may differ from those with half of it, on so many samples, each changed so
often."""
BLIND = (0, 1, 2, 6, 7, 8)
"""Of a state: position and velocity of the base, on which without contact nothing else depends."""
STEADY = 20.0
"""Standard deviation of the mean force on a foot over a sample, in weights of the robot: as good as free."""
KINDS = (STEADY, STEADY, STEADY, 1.0, 1.0, 1.0)
"""The same of what `Chain.reach` has, force and torque: how far off the middle one weight acts."""
LOW, BESIDE = 0.005, 0.01
"""m, height above a foot's lowest point within which others of its points press on the ground too, and standard
deviation of where the force acts beside the middle of these and their own spread: soles give, feet roll."""
JOLTS = (0.0001, 0.0003, 0.001, 0.003, 0.009)
"""The same of what the force does beside its mean, at either end of a sample, in weights times seconds: the likeliest
of these, as a loose one lets noise pass for motion."""
SLACK = (2e-5, 2e-5, 1e-3, 1e-3, 2e-5, 1e-3)
"""By which a step may err for other reasons in base position, rotation, velocity, angular velocity, joint positions and
joint velocities."""
SLACKS = (1.0, 5.0, 25.0, 125.0)
"""Factors on it that are tried: a model that lacks something errs by more, and must not draw the states with it."""
LOOSE = (0.1, 0.3, 1.0, 3.0, 0.1, 5.0)
"""Standard deviations by which a round may move the same: what nothing measures must stay somewhere."""
NUDGE = (0.01, 0.001, 0.01, 0.01, 0.001, 0.1)
"""Changes of the same, either way, by which derivatives are taken: about as large as what is not known of them, so
that a joint which sticks or slips within it has the slope that serves both (statistical linearisation: Garcia-Fernandez
et al. 2017, doi:10.1109/TAC.2016.2592681)."""
NUDGE_FORCE, NUDGE_TORQUE = 0.12, 0.012
"""... and of forces and torques, m, over the weight."""
SMALL = 0.1
"""... where nothing sticks: fractions of these, so that what bends within them does not count."""
STRETCH, SHOWING = 4.0, 800
"""s of each of the stretches of a walk that tell how large slack and jolts are, and samples of all of them together.
Sizes are some times one another: less than a long log tells them."""
STALE = 0.2
"""Error of a change of state that derivatives may predict, fractions of `NUDGE`."""
NUDGE_NUMBER = 0.02
"""Changes of the numbers by which derivatives are taken, fractions of their ranges."""
FRICTION = CoulombFriction.compiled
HOLD = 5.0
"""Standard deviation of the torque over a sample that a joint holds which may stand still, beside what its friction
makes of it, in multiples of the friction that it may have: `HOLD` squared samples (0.25 s at 100 Hz) under all of that
count as one deviation. Reasoned, not calibrated.
"""
LATE = 0.001
"""s, standard deviation of what sensors and commands may be apart in time beyond the model: a tick of a loop at 1 kHz.
A gain and a fraction of a millisecond look much alike. Of the bus, whatever the size of the robot."""
TOGETHER = 256
"""Steps whose derivatives are taken together: memory stays bounded whatever the length of the log."""
LEAST = 50
"""Samples that a walk must have."""


@dataclass(frozen=True)
class SampleSteps(FloatingReplay):
    """Steps of one sample each, all from states of their own, without contact.

    Attributes
    ----------
    wrench : (w, f, 6) force and torque (m), in the world's axes, on the centre of mass of each foot, over the weight
        that the candidate has: what is heavier is borne by more, in the same place.
    late : steps of the integrator by which commands come later than the log has them.
    friction : (j,) dry friction, Nm, of joints while they may stand still, whatever candidates say: a joint that stands
        holds any torque up to it, and does not show it. None: that of the candidate, always.
    """

    wrench: FloatArray | None = None
    late: int = 0
    friction: FloatArray | None = None

    @cached_property
    def model(self) -> mujoco.MjModel:
        import mujoco

        model = compile_model(self.robot, self.log, self.all_terms, self.numerics)
        model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
        # friction and limits of joints are left: projected Gauss-Seidel is within 2e-6 of Newton's, in half the time
        model.opt.solver = mujoco.mjtSolver.mjSOL_PGS
        return model

    @cached_property
    def index(self) -> JointAddresses:
        return replace(make_index(self.model), base=free_addresses(self.model))

    @cached_property
    def given(self) -> tuple[FloatArray, FloatArray]:
        return self.commands_between(self.borders - self.late * self.numerics.timestep)

    @cached_property
    def feet(self) -> list[int]:
        """Bodies that touch the ground."""
        return [self.model.body(foot.name).id for foot in touching_bodies(self.model)]

    def push(self, batch: BatchModel, segment: IntArray, change: FloatArray | None) -> Fields:
        assert self.wrench is not None
        wrench = self.wrench[segment]
        if change is not None:
            wrench = wrench + change[:, -wrench[0].size :].reshape(wrench.shape)
        pushed = np.zeros((len(segment), self.model.nbody, 6))
        pushed[:, self.feet] = wrench * weights(batch)[:, None, None]
        return {"xfrc_applied": pushed}

    @property
    def smooth(self) -> bool:
        """Whether no joint may stick and slip: nothing rubs, and no law acts, which may."""
        return self.friction is None and not Terms(self.all_terms).have_laws

    @cached_property
    def still(self) -> BoolArray:
        """(w, j) whether a joint may stand still in a step: it begins or ends so slowly, or turns round."""
        assert self.base is not None
        first = self._segments.joint_velocity
        last = np.concatenate([first[1:], first[-1:]])
        slowest = np.minimum(np.abs(first), np.abs(last)) * (np.sign(first) == np.sign(last))
        return np.asarray(slowest <= self.base.size.state(NUDGE)[5])

    def _setup(self, pairs: Values, segment: IntArray, change: FloatArray | None, steps: int) -> Setup:
        setup = super()._setup(pairs, segment, change, steps)
        if self.friction is not None:
            friction, dof = setup.batch.read(FRICTION), self.index.dof
            friction[:, dof] = np.where(self.still[segment], self.friction, friction[:, dof])
            setup.batch.write({FRICTION: friction})
        return setup

    def ends(self, candidates: FloatArray, row: IntArray, segment: IntArray, change: FloatArray | None) -> Segments:
        """States at the ends of steps: of candidate `row`, in step `segment`, from a start with a `change`."""
        size, j = len(row), len(self.index.joints)
        base, q, dq = np.empty((size, 13)), np.empty((size, j)), np.empty((size, j))
        with silenced():
            for sims, part in self._simulate(candidates, row, segment, change):
                assert part.base is not None
                base[sims], q[sims], dq[sims] = part.base[:, -1], part.position[:, -1], part.velocity[:, -1]
        # a simulation that failed has no attitude; the rest of it says so
        failed = ~(np.linalg.norm(base[:, 3:7], axis=1) > 0.5)
        base[failed] = np.nan
        base[failed, 3:7] = 1.0, 0.0, 0.0, 0.0
        std = np.zeros((size, BASE + 2 * j))
        rows = np.asarray(self._segments.rows[segment])
        return Segments(rows, q, dq, std, BaseStates(base[:, :3], base[:, 3:7], base[:, 7:10], base[:, 10:]))


def weights(batch: BatchModel) -> FloatArray:
    """(m,) N, of the robot under each candidate."""
    gravity = float(np.linalg.norm(batch.model.opt.gravity))
    return np.asarray(gravity * batch.read("body_mass").sum(axis=1))


@dataclass(frozen=True, eq=False)
class Derivatives:
    """Of the end of each step: by its start (w, d, d), by the mean wrench and by blows at its start and its end.

    These are (w, d, 6 f) each, by forces and blows over the robot's weight; those of blows on the joints at its start
    are (w, d, j).
    """

    start: FloatArray
    mean: FloatArray
    blow: FloatArray
    last: FloatArray
    joint: FloatArray

    def renewed(self, which: BoolArray, found: Derivatives) -> Derivatives:
        """The same with those of some steps found anew."""
        mixed = {f.name: getattr(self, f.name).copy() for f in fields(self)}
        for name, values in mixed.items():
            values[which] = getattr(found, name)
        return Derivatives(**mixed)

    @property
    def finite(self) -> bool:
        """Whether no simulation failed."""
        return all(bool(np.isfinite(getattr(self, f.name)).all()) for f in fields(self))

    def part(self, start: int, stop: int) -> Derivatives:
        """Those of the steps between the samples from `start` to before `stop`."""
        own = slice(start, stop - 1)
        return Derivatives(**{f.name: getattr(self, f.name)[own] for f in fields(self)})


@dataclass(frozen=True, eq=False)
class Chain:
    """One walk: its steps, states and what was measured.

    Attributes
    ----------
    steps : replay from every state but the last.
    states : (n) of the robot at the samples.
    touch : (n - 1, f) whether a foot may touch during a step.
    linked : (n - 1,) whether a step is replayed: both of its samples are usable.
    measured, sigma : (n, j + 5) joint positions, gyro, and x and y of the vertical in the base's frame; sigma is
        infinite where there is no value.
    time : (n,) s since the first sample.
    size : of the robot.
    jolt, slack : one of `JOLTS`, and factor on `SLACK`, one of `SLACKS`.
    reach : (n - 1, f, 6, 6) force and torque (m) on a foot's centre of mass, over the weight, by a force in the middle
        of where it may touch, of one weight, and by the torque that this has as the ground may press beside that:
        standard deviations.
    held : (j,) size, Nms, of the unknown blow in a step in which a joint may stand still; None where nothing rubs.
    """

    steps: SampleSteps
    states: Segments
    touch: BoolArray
    linked: BoolArray
    measured: FloatArray
    sigma: FloatArray
    time: FloatArray
    size: BodySize
    reach: FloatArray
    jolt: float = JOLTS[2]
    slack: float = 1.0
    held: FloatArray | None = None

    def part(self, start: int, stop: int) -> Chain:
        """The chain of the samples from `start` to before `stop`."""
        steps, samples, between = self.steps, slice(start, stop), slice(start, stop - 1)
        assert steps.wrench is not None
        assert steps.base is not None
        assert steps.segments is not None
        which = np.arange(start, stop)
        return replace(
            self,
            steps=replace(
                steps,
                log=steps.log.window(start, stop),
                segments=steps.segments.chosen(which[:-1]).shifted(start),
                base=steps.base.rows(start, stop),
                wrench=steps.wrench[between],
            ),
            states=self.states.chosen(which).shifted(start),
            touch=self.touch[between],
            linked=self.linked[between],
            measured=self.measured[samples],
            sigma=self.sigma[samples],
            time=self.time[samples] - self.time[start],
            reach=self.reach[between],
        )


@dataclass(frozen=True, eq=False)
class Ends:
    """By how much steps miss the next state, (w, d), and how that depends on the numbers, (w, d, p)."""

    defect: FloatArray
    by_number: FloatArray

    def part(self, start: int, stop: int) -> Ends:
        """Those of the steps between the samples from `start` to before `stop`."""
        return Ends(self.defect[start : stop - 1], self.by_number[start : stop - 1])


@dataclass(frozen=True, eq=False)
class Round:
    """A chain linearised about its states: what a change of the numbers does to it, states and forces at their best.

    Attributes
    ----------
    left : (r, 1 + p) whitened residuals for the numbers as they are, and their derivatives.
    surprise : minus twice the log likelihood, states and forces integrated out.
    move : (n d,) what the states do.
    ends : from which this was made.
    """

    left: FloatArray
    surprise: float
    move: FloatArray
    ends: Ends


def suits(replay: FloatingReplay) -> bool:
    """Whether a walk and its terms can be a chain."""
    return (
        replay.base is not None
        and chainable(replay.log, replay.all_terms)
        and replay.numerics.servo_period is None
        and replay.numerics.integrator != "Euler"
        and not any(name.startswith("opt.") for name in _written(replay, _nominal(replay)).fields)
    )


def chainable(log: Log, terms: Sequence[Term]) -> bool:
    """Whether the base's turning is measured, samples are regular and enough, and no term needs more than a state."""
    time = log.time
    return (
        bool(log.joints("imu"))
        and len(time) >= LEAST
        and float(np.ptp(np.diff(time))) < 1e-4 * float(time[1] - time[0])
        and not any(remembers(type(term)) for term in terms)
    )


def remembers(term: type[Term]) -> bool:
    """Whether a term of this class takes more than a step from one state to the next: memory, clocks, sensors."""
    return term.structural or term.law_memory > 0 or any(term.overrides(hook) for hook in BEYOND)


BEYOND = ("applied_torque", "initial_state", "read_out")
"""Stages of such a term."""


def _nominal(replay: SegmentReplay) -> FloatArray:
    return np.array([p.nominal for p in replay.parameters])


def _written(replay: SegmentReplay, values: FloatArray) -> BatchModel:
    """The models of one candidate."""
    return replay.batch(replay._values(values[None]), 1)


def chain_of(replay: FloatingReplay) -> Chain:
    """A walk with its states as they were reconstructed, and the weight shared out evenly among what touches."""
    walk, base = replay.log, replay.base
    assert base is not None
    n = len(walk)
    states = starts_at(base, np.stack([np.arange(n), np.arange(n) + 2], axis=1))
    own = {f.name: getattr(replay, f.name) for f in fields(replay)} | {"effort": False}
    steps = SampleSteps(**{**own, "segments": states.chosen(np.arange(n - 1))})
    feet = touching_bodies(steps.model)
    centres = [Foot(f.name, steps.model.body(f.name).ipos[None], np.zeros(1)) for f in feet]
    surfaces = foot_surfaces(steps.model, [*feet, *centres], base)
    surfaces, middles = surfaces[: len(feet)], surfaces[len(feet) :]
    low = np.stack([surface[:, :, 2].min(axis=1) for surface in surfaces], axis=1)
    near = _touching(low, foot_loads(steps.model, feet, walk, []), base.size)
    touch = near[:-1] | near[1:]
    share = touch / np.maximum(touch.sum(axis=1, keepdims=True), 1)
    arms = (surface - middle for surface, middle in zip(surfaces, middles, strict=True))
    reach = np.stack([pressed(arm, base.size) for arm in arms], axis=1)
    reach = 0.5 * (reach[:-1] + reach[1:])
    force = np.zeros((n - 1, touch.shape[1], 6))
    force[:, :, 2] = share
    wrench = np.einsum("wfij,wfj->wfi", reach, force)
    attitude = base.attitude
    joints = [walk.channels[f"position.{j}"] if walk.has("position", j) else np.full(n, np.nan) for j in base.joints]
    measured = np.column_stack([*joints, attitude.turning, attitude.up[:, :2]])
    noise = np.array([noise_floor(c).sigma if np.isfinite(c).any() else np.inf for c in joints])
    # a joint that stands still shows no noise, and is known no better than the others
    noise = np.maximum(noise, 0.5 * np.median(noise))
    sigma = np.column_stack([np.tile(noise, (n, 1)), attitude.turning_std, attitude.up_std, attitude.up_std])
    sigma[~np.isfinite(measured) | ~base.usable[:, None]] = np.inf
    return Chain(
        steps=replace(steps, wrench=wrench),
        states=states,
        touch=touch,
        linked=base.usable[:-1] & base.usable[1:],
        measured=np.nan_to_num(measured),
        sigma=sigma,
        time=walk.time - walk.time[0],
        size=base.size,
        reach=reach,
    )


def pressed(arm: FloatArray, size: BodySize) -> FloatArray:
    """(n, 6, 6) as `Chain.reach`, of a foot with its outermost points at (n, k, 3) from its centre of mass.

    Where the ground presses is known to be within the foot: in the middle of its lowest points, give or take how far
    they are apart. So torques on it are no more free than that, which tells gains and masses from forces.
    """
    above = arm[:, :, 2] - arm[:, :, 2].min(axis=1, keepdims=True)
    share = np.exp(-0.5 * (above / size.length(LOW)) ** 2)
    share /= share.sum(axis=1, keepdims=True)
    middle = np.einsum("nk,nki->ni", share, arm)
    spread = np.einsum("nk,nki->n", share, (arm - middle[:, None]) ** 2)
    result = np.zeros((len(arm), 6, 6))
    result[:, [0, 1, 2], [0, 1, 2]] = 1.0
    result[:, 3:, :3] = np.cross(middle[:, None], np.eye(3)).transpose(0, 2, 1)
    result[:, [3, 4, 5], [3, 4, 5]] = np.sqrt(spread + size.length(BESIDE) ** 2)[:, None]
    return result


def _touching(low: FloatArray, load: FloatArray | None, size: BodySize) -> BoolArray:
    """Which feet may touch, (n, f): rather too often than too seldom, by a sample either way.

    By the height (n, f) of their lowest points, m, and the force on them, N, where that is measured.
    """
    above = low - low.min(axis=1, keepdims=True)
    if load is None:
        near = above < size.length(NEAR)
    else:
        near = (above < size.length(LOWEST_LOADED)) | (load > LIGHTEST * float(np.median(load.sum(axis=1))))
    wide: BoolArray = near.copy()
    wide[1:] |= near[:-1]
    wide[:-1] |= near[1:]
    return wide


LOWEST_LOADED, LIGHTEST = 0.002, 0.01
"""m above the lowest foot up to which one may touch whatever its force sensors say, and fraction of the weight on it
beyond which it does."""


def derive(chain: Chain, values: FloatArray, which: IntArray | None = None) -> Derivatives:
    """How the end of each step depends on its start and the forces in it, about its states under a candidate.

    `which` steps (k,) are asked for; without it all.
    """
    which = np.arange(len(chain.touch)) if which is None else which
    size, kinds, felt = each_of(NUDGE, chain), _nudged_forces(chain), _felt(chain)
    up = np.diag(np.concatenate([size, kinds]))[None, np.concatenate([felt, len(size) + np.arange(len(kinds))])]
    rough = _roughly(chain)
    fine = replace(rough, numerics=rough.numerics.halved())
    some = which[np.unique(np.linspace(0, len(which) - 1, CHECKED).astype(np.int64))]
    tried = np.stack([_half_nudges(chain, number)[some] for number in range(CHECKS)], axis=1)
    wanted, got = (_responses(chain, steps, values, some, tried) / size for steps in (fine, rough))
    close = np.linalg.norm(got - wanted) < ROUGH_ERROR * np.linalg.norm(wanted)
    found = _responses(chain, rough if close else fine, values, which, up)
    start = np.tile(np.eye(len(size)), (len(which), 1, 1))
    start[:, [0, 1, 2], [6, 7, 8]] = np.diff(chain.steps.log.time)[which, None]
    start[:, :, felt] = np.moveaxis(found[:, : len(felt)], 1, 2) / size[felt]
    mean = np.moveaxis(found[:, len(felt) :], 1, 2) / kinds
    on = np.repeat(chain.touch[which], 6, axis=1)[:, None]
    samples, place = np.unique([which, 1 + which], return_inverse=True)
    first, last = _blows(chain, values, samples)[place.reshape(2, -1)]
    first, feet = start @ first, on.shape[2]
    return Derivatives(start, mean * on, first[:, :, :feet] * on, last[:, :, :feet] * on, first[:, :, feet:])


def stale(chain: Chain, known: Derivatives, values: FloatArray, number: int) -> BoolArray:
    """Steps (w,) of which the derivatives do not predict the change under random changes of their start and forces.

    `number` says which of these.
    """
    size, felt, every = each_of(NUDGE, chain), _felt(chain), np.arange(len(chain.touch))
    change = _half_nudges(chain, number)
    found = _responses(chain, _roughly(chain), values, every, change[:, None])[:, 0]
    predicted = (np.concatenate([known.start, known.mean], axis=2) @ change[:, :, None])[:, :, 0]
    off = np.abs(found - predicted)[:, felt] / size[felt]
    return np.asarray(chain.linked & ~(off.max(axis=1) < STALE))


def _half_nudges(chain: Chain, number: int) -> FloatArray:
    """(w, d + 6 f) half of each nudge of start and forces, with a random sign; `number` says which."""
    size, kinds, felt = each_of(NUDGE, chain), _nudged_forces(chain), _felt(chain)
    on = np.zeros(len(size))
    on[felt] = size[felt]
    touch = np.repeat(chain.touch, 6, axis=1)
    sign = np.random.default_rng(number).choice(np.array([-0.5, 0.5]), size=len(size) + len(kinds))
    return np.asarray(sign * np.hstack([np.tile(on, (len(touch), 1)), kinds * touch]))


def _felt(chain: Chain) -> IntArray:
    """Coordinates of a state on which the end of a step depends, beside the base's own way."""
    return np.delete(np.arange(chain.states.std.shape[1]), BLIND)


def _nudged_forces(chain: Chain) -> FloatArray:
    """(6 f,) changes of forces and torques by which derivatives are taken."""
    return np.tile([NUDGE_FORCE] * 3 + [chain.size.length(NUDGE_TORQUE)] * 3, chain.touch.shape[1])


def _responses(chain: Chain, steps: SampleSteps, values: FloatArray, which: IntArray, up: FloatArray) -> FloatArray:
    """(k, l, d) what changes `up` (k or 1, l, d + 6 f) make to the ends of some steps.

    Half the difference to what the opposite changes make, where joints stick and slip; elsewhere nothing is gained by
    it, and a small part of the change, from the states as they are, tells the same.
    """
    size, smooth = up.shape[1], steps.smooth
    wide = np.broadcast_to(up, (len(which), *up.shape[1:]))
    count = 1 + size if smooth else 2 * size
    result = np.empty((len(which), size, chain.states.std.shape[1]))
    for first in range(0, len(which), TOGETHER):
        own = which[first : first + TOGETHER]
        segment, lane = np.repeat(own, count), np.tile(np.arange(count), len(own))
        part = wide[first : first + TOGETHER]
        others = np.zeros_like(part[:, :1]) if smooth else -part
        nudges = np.concatenate([SMALL * part if smooth else part, others], axis=1).reshape(len(segment), -1)
        ends = steps.ends(values[None], np.zeros(len(segment), dtype=np.int64), segment, nudges)
        raised = np.flatnonzero(lane < size)
        beside = np.repeat(np.flatnonzero(lane == size), size) if smooth else raised + size
        change = difference(ends.chosen(raised), ends.chosen(beside)) / (SMALL if smooth else 2.0)
        result[first : first + TOGETHER] = change.reshape(len(own), size, -1)
    return result


def with_friction(chain: Chain, values: FloatArray) -> Chain:
    """The chain with joints that may stand still as they rub under a candidate, and hold what nobody knows.

    What they may rub is a scale of the numbers more, so that a joint which does not yet rub can come to.
    """
    terms, dof = Terms(chain.steps.terms), chain.steps.index.dof
    more = np.minimum(values + terms.scale, terms.upper)
    friction, most = (_written(chain.steps, v).read(FRICTION)[0, dof] for v in (values, more))
    if not most.any():
        return replace(chain, steps=replace(chain.steps, friction=None), held=None)
    held = HOLD * float(chain.time[1]) * most
    return replace(chain, steps=replace(chain.steps, friction=friction), held=held)


def _roughly(chain: Chain) -> SampleSteps:
    """Steps of a sample with the longest steps of the fourth-order integrator that divide it."""
    step = derivative_step(float(chain.time[1]), chain.size)
    return replace(chain.steps, numerics=replace(chain.steps.numerics, integrator="RK4", timestep=step))


def derivative_step(period: float, size: BodySize) -> float:
    """The longest step, s, for derivatives that divides the period of samples of a robot of some size."""
    return whole_step(period, size.time(LONGEST))


def _blows(chain: Chain, values: FloatArray, samples: IntArray) -> FloatArray:
    """Change of the states at some samples under unit blows on the feet (over the weight) and the joints (Nms).

    It is (k, d, 6 f + j).
    """
    import mujoco

    steps, states = chain.steps, chain.states
    batch = _written(steps, values)
    model, index = batch.candidate(0), steps.index
    data = mujoco.MjData(model)
    place, motion = free_addresses(steps.model)
    order = np.concatenate([motion + np.arange(6), index.dof])
    joints = len(index.joints)
    rows = np.concatenate([np.arange(6, BASE), BASE + joints + np.arange(joints)])
    where = np.zeros((6 * len(steps.feet) + joints, model.nv))
    where[6 * len(steps.feet) + np.arange(joints), index.dof] = 1.0
    unit = np.repeat([float(weights(batch)[0]), 1.0], [6 * len(steps.feet), joints])
    jacobian, blow = where[: 6 * len(steps.feet)].reshape(-1, 6, model.nv), np.zeros_like(where)
    result = np.zeros((len(samples), states.std.shape[1], len(blow)))
    for own_result, k in zip(result, samples, strict=True):
        data.qpos[place : place + 3] = states.free_base.position[k]
        data.qpos[place + 3 : place + 7] = states.free_base.quaternion[k]
        data.qpos[index.qpos] = states.joint_position[k]
        mujoco.mj_fwdPosition(model, data)
        for own, body in zip(jacobian, steps.feet, strict=True):
            mujoco.mj_jacBodyCom(model, data, own[:3], own[3:], body)
        mujoco.mj_solveM(model, data, blow, where)
        own_result[rows] = blow.T[order] * unit
    return result


def difference(a: Segments, b: Segments) -> FloatArray:
    """(w, d) change that takes states `b` to `a`, in the coordinates of `Segments.std`."""
    there, here = a.free_base, b.free_base
    turned, from_here = (to_rotation(base.quaternion) for base in (there, here))
    return np.concatenate(
        [
            there.position - here.position,
            (from_here.inv() * turned).as_rotvec(),
            there.velocity - here.velocity,
            there.rate - here.rate,
            a.joint_position - b.joint_position,
            a.joint_velocity - b.joint_velocity,
        ],
        axis=1,
    )


def simulate_chain(chain: Chain, values: FloatArray, free: IntArray, step: FloatArray) -> Ends:
    """Replay every step of a chain under a candidate and its neighbours."""
    steps, states, w = chain.steps, chain.states, len(chain.touch)
    every = np.arange(w)
    ends = steps.ends(values[None], np.zeros(w, dtype=np.int64), every, None)
    candidates = np.tile(values, (1 + len(free), 1))
    candidates[1 + np.arange(len(free)), free] += step
    count = len(candidates)
    row, segment = np.tile(np.arange(count), w), np.repeat(every, count)
    around = _roughly(chain).ends(candidates, row, segment, None)
    plain = around.chosen(every * count)
    by_number = difference(around, plain.chosen(segment)).reshape(w, count, -1)[:, 1:] / step[:, None]
    late = replace(steps, late=1).ends(values[None], np.zeros(w, dtype=np.int64), every, None)
    by_time = difference(late, ends) / steps.numerics.timestep
    by_number = np.concatenate([by_number, by_time[:, None]], axis=1)
    return Ends(difference(ends, states.chosen(1 + every)), np.moveaxis(by_number, 1, 2))


def likeliest(chain: Chain, known: Derivatives, ends: Ends, slacks: Sequence[float] = (1.0,)) -> Chain:
    """The chain with the slack, and then the size of jolts, that make its log likeliest, as parts of it show."""
    parts = [(chain.part(*rows), known.part(*rows), ends.part(*rows)) for rows in stretches(chain)]

    @cache
    def surprise(slack: float, jolt: float) -> float:
        rounds = [linearise_chain(replace(c, slack=slack, jolt=jolt), d, e) for c, d, e in parts]
        left = np.concatenate([r.left for r in rounds])
        # at the numbers that suit it best: those of the start may be far off
        best = np.linalg.lstsq(left[:, 1:], left[:, 0], rcond=1e-9)[0]
        return sum(r.surprise for r in rounds) - float(left[:, 0] @ (left[:, 1:] @ best))

    slack, jolt = chain.slack, chain.jolt
    if len(slacks) > 1:
        slack = _lowest(slacks, slack, lambda tried: surprise(tried, jolt))
    return replace(chain, slack=slack, jolt=_lowest(JOLTS, jolt, lambda tried: surprise(slack, tried)))


def _lowest(sizes: Sequence[float], start: float, surprise: Callable[[float], float]) -> float:
    """Where a descent from one size to its neighbours ends: a likelihood has one peak over a scale."""
    at = sizes.index(start)
    while True:
        near = [at, *(k for k in (at - 1, at + 1) if 0 <= k < len(sizes))]
        best = min(near, key=lambda k: surprise(sizes[k]))
        if best == at:
            return sizes[at]
        at = best


def stretches(chain: Chain) -> list[tuple[int, int]]:
    """Stretches spread evenly over a chain, each from a sample to before another; one of all where that is no more."""
    n, period = len(chain.time), float(chain.time[1])
    length = max(round(chain.size.time(STRETCH) / period), 2)
    number, wanted = n // length, -(-SHOWING // length)
    if number <= wanted:
        return [(0, n)]
    first = np.linspace(0, n - length, wanted).astype(np.int64).tolist()
    return [(start, start + length) for start in first]


def linearise_chain(chain: Chain, known: Derivatives, ends: Ends) -> Round:
    """Cost of a chain to second order in the free numbers, its states and forces at their best."""
    from scipy.linalg import cho_solve_banded, cholesky_banded

    (n, d), w, p = chain.states.std.shape, len(chain.touch), ends.by_number.shape[2]
    right = np.concatenate(
        [known.start, np.tile(np.eye(d), (w, 1, 1)), ends.by_number, ends.defect[:, :, None]], axis=2
    )
    linked = chain.linked[:, None, None]
    right = np.where(linked, right, 0.0)
    failed = Round(np.zeros((1, 1 + p)), np.inf, np.zeros(n * d), ends)
    if not np.isfinite(right).all():  # a simulation failed
        return failed
    try:
        factor = np.linalg.cholesky(np.where(linked, unexplained(chain, known)[1], np.eye(d)))
        white = np.linalg.solve(factor, right)
        before, after, sides = white[:, :, :d], -white[:, :, d : 2 * d], white[:, :, 2 * d :]
        # what the candidate as it is leaves comes first, then a unit of each number
        sides = np.roll(sides, 1, axis=2)
        sight, seen = measurements(chain)
        diagonal = sight.transpose(0, 2, 1) @ sight + np.diag(each_of(LOOSE, chain) ** -2.0)
        diagonal[:-1] += before.transpose(0, 2, 1) @ before
        diagonal[1:] += after.transpose(0, 2, 1) @ after
        linear = np.zeros((n, d, 1 + p))
        linear[:, :, 0] = np.einsum("nmd,nm->nd", sight, seen)
        linear[:-1] += before.transpose(0, 2, 1) @ sides
        linear[1:] += after.transpose(0, 2, 1) @ sides
        band = cholesky_banded(_band(diagonal, after.transpose(0, 2, 1) @ before), lower=True)
    except (np.linalg.LinAlgError, ValueError):
        return failed
    solved = cho_solve_banded((band, True), linear.reshape(n * d, 1 + p))
    states = solved.reshape(n, d, 1 + p)
    missed = sides - before @ states[:-1] - after @ states[1:]
    stated = -sight @ states
    stated[:, :, 0] += seen
    kept = -states / each_of(LOOSE, chain)[:, None]
    left = np.concatenate([part.reshape(-1, 1 + p) for part in (missed, stated, kept)])
    volume = np.log(np.diagonal(factor, axis1=1, axis2=2))[chain.linked].sum() + np.log(band[0]).sum()
    surprise = float(left[:, 0] @ left[:, 0]) + 2 * float(volume)
    return Round(left, surprise, solved[:, 0], ends)


def unexplained(chain: Chain, known: Derivatives) -> tuple[FloatArray, FloatArray]:
    """What unknown forces of their size do, (w, d, 18 f), and the covariance of all that they and the slack do.

    Mean forces come first, then blows at the start and at the end; last, (w, d, 18 f + j), what joints hold that may
    stand still.
    """
    kinds, jolt = np.tile(KINDS, chain.touch.shape[1]), chain.size.time(chain.jolt)
    mean, blow, last = (_at_contact(chain, part) for part in (known.mean, known.blow, known.last))
    parts = [mean * kinds, blow * jolt, last * jolt]
    if chain.held is not None:
        parts.append(known.joint * (chain.held * chain.steps.still)[:, None])
    forces = np.concatenate(parts, axis=2)
    slack = (chain.slack * each_of(SLACK, chain)) ** 2
    return forces, forces @ forces.transpose(0, 2, 1) + np.diag(slack)


def _at_contact(chain: Chain, part: FloatArray) -> FloatArray:
    """(w, d, 6 f) what forces and torques do where feet touch, in the units of `Chain.reach`."""
    w, d, _ = part.shape
    feet = part.reshape(w, d, -1, 6).transpose(0, 2, 1, 3)
    return np.asarray((feet @ chain.reach).transpose(0, 2, 1, 3).reshape(part.shape))


def acting(chain: Chain, pushed: FloatArray) -> FloatArray:
    """(w, f, 6) forces and torques on the feet of (w, 6 f) unknown ones of the size of their own."""
    w, f = chain.touch.shape
    return np.asarray(np.einsum("wfij,wfj->wfi", chain.reach, pushed.reshape(w, f, 6) * KINDS))


def each_of(kinds: Sequence[float], chain: Chain) -> FloatArray:
    """(d,) one number for every coordinate of a state from a Nao's for every kind."""
    joints = chain.states.joint_position.shape[1]
    return np.repeat(chain.size.state(kinds), [3, 3, 3, 3, joints, joints])


def measurements(chain: Chain) -> tuple[FloatArray, FloatArray]:
    """Whitened derivatives (n, m, d) of what is measured by the states, and what they leave of it, (n, m)."""
    states = chain.states
    n, j = states.joint_position.shape
    up = to_rotation(states.free_base.quaternion).as_matrix()[:, 2]
    sight = np.zeros((n, j + 5, states.std.shape[1]))
    sight[:, np.arange(j), BASE + np.arange(j)] = 1.0
    sight[:, j + np.arange(3), 9 + np.arange(3)] = 1.0
    # a small turn r of the base moves the vertical in its frame by up x r
    sight[:, j + 3, 4], sight[:, j + 3, 5] = -up[:, 2], up[:, 1]
    sight[:, j + 4, 3], sight[:, j + 4, 5] = up[:, 2], -up[:, 0]
    left = np.concatenate([states.joint_position, states.free_base.rate, up[:, :2]], axis=1) - chain.measured
    return sight / chain.sigma[:, :, None], left / chain.sigma


def _band(diagonal: FloatArray, below: FloatArray) -> FloatArray:
    """Lower band (2 d, n d) of a symmetric matrix of blocks: (n, d, d), and (n - 1, d, d) below them."""
    n, d, _ = diagonal.shape
    band = np.zeros((2 * d, n, d))
    for k in range(d):
        band[k, :, : d - k] = np.diagonal(diagonal, -k, 1, 2)
        band[d + k, :-1, : d - k] = np.diagonal(below, -k, 1, 2)
        band[d - k, :-1, k:] = np.diagonal(below, k, 1, 2)
    return band.reshape(2 * d, n * d)


def moved_chain(chain: Chain, known: Derivatives, found: Round) -> Chain:
    """A chain with its states, and the mean forces in its steps, where they are best."""
    n, d = chain.states.std.shape
    move = -found.move.reshape(n, d)
    rest = found.ends.defect + np.einsum("nij,nj->ni", known.start, move[:-1]) - move[1:]
    # least-norm forces, each in its own size, that explain what the steps leave open
    forces, total = unexplained(chain, known)
    linked = chain.linked[:, None, None]
    forces, total = np.where(linked, forces, 0.0), np.where(linked, total, np.eye(d))
    rest = np.where(linked[:, :, 0], rest, 0.0)
    own = forces[:, :, : chain.reach[0, :, 0].size]
    pushed = -np.einsum("ndm,nd->nm", own, np.linalg.solve(total, rest[:, :, None])[:, :, 0])
    wrench = chain.steps.wrench
    assert wrench is not None
    # torques beside the middle of a contact stay what is not known
    pushed = pushed.reshape(*wrench.shape) * [1, 1, 1, 0, 0, 0]
    mean = acting(chain, pushed)
    states = chain.states.moved(move)
    steps = replace(chain.steps, segments=states.chosen(np.arange(n - 1)), wrench=wrench + mean)
    return replace(chain, steps=steps, states=states)
