"""Walks compared sample by sample with what those before it lead one to expect, whatever the ground does.

A Kalman filter over the chain of a walk (`chain`) says of each sample what it adds to the past. Where the model is
right these innovations are white noise of a known size (Kailath 1968, doi:10.1109/TAC.1968.1099025), and their sum of
squares is minus twice the log likelihood of the log, its states and the forces on its feet integrated out (prediction
error method: Astrom 1980, doi:10.1016/0005-1098(80)90078-3). Gains hardly depend on the numbers that are looked for
but where joints stick and slip, so they stay as they are through a search and follow it from turn to turn: a candidate
costs one step of a sample from every state, and a recursion.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, ClassVar, Self

import numpy as np

from sysid_btr._typing import BoolArray, FloatArray, IntArray
from sysid_btr.errors import LogError, ModelError
from sysid_btr.floating_base.chain import (
    BLIND,
    LATE,
    LEAST,
    LOOSE,
    NUDGE_NUMBER,
    SLACKS,
    Chain,
    Derivatives,
    SampleSteps,
    acting,
    chain_of,
    chainable,
    derivative_step,
    derive,
    difference,
    each_of,
    likeliest,
    linearise_chain,
    measurements,
    moved_chain,
    remembers,
    simulate_chain,
    stale,
    unexplained,
    with_friction,
)
from sysid_btr.floating_base.estimate import BaseState
from sysid_btr.floating_base.reconstruction import MOST_WALKED, reconstruct
from sysid_btr.floating_base.segments import FloatingReplay
from sysid_btr.identify.episode import Episode, Procedure
from sysid_btr.io.log import Log
from sysid_btr.io.noise import NoiseFloor
from sysid_btr.models.robot import Robot, servo_joints
from sysid_btr.objectives.marginal import Projection
from sysid_btr.objectives.problem import BLOCK, Comparison
from sysid_btr.objectives.targets import Target
from sysid_btr.progress import mention, phase
from sysid_btr.simulation.base_states import BASE, BaseStates
from sysid_btr.simulation.numerics import MUJOCO, Numerics
from sysid_btr.simulation.segments import Segments
from sysid_btr.terms.base import Outputs, Term
from sysid_btr.terms.effect import GROUND
from sysid_btr.terms.grammar import parse_parameters
from sysid_btr.terms.model import Terms

FIRST_ROUNDS, ROUNDS = 4, 2
"""Gauss-Newton steps of the states, from reconstructed ones and from those of another candidate."""
SETTLING = 0.3
"""s of a Nao (`BodySize`) after a beginning in which its unknown state, and commands from before it, still show."""


@dataclass(frozen=True)
class Foreseen(SampleSteps):
    """Each sample as it is predicted from the state at the one before; the first is where the chain begins.

    Attributes
    ----------
    filtered : states from which the next samples are predicted, where they are not those of `segments`.
    """

    filtered: Segments | None = None

    @property
    def starts(self) -> Segments:
        return self._segments if self.filtered is None else self.filtered

    def _run(self, candidates: FloatArray) -> Outputs:
        m, w, j = len(candidates), len(self._segments), len(self.index.joints)
        row, segment = np.tile(np.arange(m), w), np.repeat(np.arange(w), m)
        position, velocity = np.empty((m, w + 1, j)), np.empty((m, w + 1, j))
        base, effort = np.empty((m, w + 1, 13)), np.empty((m, w + 1, j))
        starts, free = self.starts, self.starts.free_base
        position[:, 0], velocity[:, 0] = starts.joint_position[0], starts.joint_velocity[0]
        base[:, 0] = np.concatenate([free.position[0], free.quaternion[0], free.velocity[0], free.rate[0]])
        for sims, part in self._simulate(candidates, row, segment, None):
            assert part.base is not None
            at = row[sims], 1 + segment[sims]
            base[at], position[at], velocity[at] = part.base[:, -1], part.position[:, -1], part.velocity[:, -1]
            if part.effort is not None:
                effort[row[sims], segment[sims]] = part.effort[:, 0]
                effort[at] = part.effort[:, -1]
        return Outputs(self.log.time - self.log.time[0], position, velocity, effort if self.effort else None, base)


@dataclass(frozen=True, eq=False)
class Filter:
    """The Kalman filter of a chain, linearised about its states.

    Attributes
    ----------
    states : (n) about which it is linearised: what all samples leave most probable.
    filtered : (n) what each sample and those before it leave most probable, from which the next one is predicted.
    wrench : (n - 1, f, 6) mean forces on the feet, over the weight, of which the same is true, with the sample at their
        end.
    linked : (n - 1,) steps that are replayed; after another one it begins anew.
    carry, push : (n - 1, d, d), (n - 1, d) error of the state that is expected of the next sample, from that of this
        one, and from what this one measures.
    sight, seen : (n, j, d), (n, j) whitened joint innovations: `seen` less what `sight` makes of the expected error.
    share : (n, j) mean square of these where the model is right: less than one by what unknown forces take, and where
        gains allow for a model that errs.
    late : (n - 1, d) what steps do where commands come a second later.
    misfit : mean square of the joint innovations over that where the model is right, of the whole walk.
    """

    states: Segments
    filtered: Segments
    wrench: FloatArray
    linked: BoolArray
    carry: FloatArray
    push: FloatArray
    sight: FloatArray
    seen: FloatArray
    share: FloatArray
    late: FloatArray
    misfit: float

    def part(self, start: int, stop: int) -> Filter:
        """The filter of the samples from `start` to before `stop`."""
        samples, between = slice(start, stop), slice(start, stop - 1)
        return Filter(
            self.states.chosen(np.arange(start, stop)),
            self.filtered.chosen(np.arange(start, stop)),
            self.wrench[between],
            self.linked[between],
            self.carry[between],
            self.push[between],
            self.sight[samples],
            self.seen[samples],
            self.share[samples],
            self.late[between],
            self.misfit,
        )

    def defects(self, outputs: Outputs) -> FloatArray:
        """(m, n - 1, d) by how much the predicted samples miss the states."""
        assert outputs.base is not None
        m, n, j = outputs.position.shape
        base = outputs.base[:, 1:].reshape(-1, 13)
        there = Segments(
            np.zeros((len(base), 2), dtype=np.int64),
            outputs.position[:, 1:].reshape(-1, j),
            outputs.velocity[:, 1:].reshape(-1, j),
            np.zeros((len(base), BASE + 2 * j)),
            BaseStates(base[:, :3], _upright(base[:, 3:7]), base[:, 7:10], base[:, 10:]),
        )
        change = difference(there, self.states.chosen(np.tile(np.arange(1, n), m))).reshape(m, n - 1, -1)
        return np.where(self.linked[:, None], _without_base(change), 0.0)

    def innovations(self, defects: FloatArray) -> FloatArray:
        """(m, n, j) whitened joint innovations."""
        return np.asarray(self.seen - self._shown(defects, self.push))

    def respond(self, defects: FloatArray) -> FloatArray:
        """(m, n, j) their change under a change of the defects."""
        return -self._shown(defects, np.zeros_like(self.push))

    def _shown(self, defects: FloatArray, push: FloatArray) -> FloatArray:
        # one product a candidate: the bits of a product of all would depend on how many there are
        (m, w, d), now = defects.shape, np.zeros((len(defects), defects.shape[2], 1))
        error = np.zeros((m, w + 1, d, 1))
        for k in range(w):
            now = self.carry[k] @ now + (push[k] + defects[:, k])[:, :, None]
            error[:, k + 1] = now
        return np.asarray((self.sight @ error)[..., 0])


def _upright(quaternion: FloatArray) -> FloatArray:
    """Attitudes, upright where a simulation failed: the rest of its state says so."""
    failed = ~np.isfinite(quaternion).all(axis=1, keepdims=True)
    return np.where(failed, [1.0, 0.0, 0.0, 0.0], quaternion)


def _without_base(array: FloatArray) -> FloatArray:
    """The last axis without what is `BLIND`."""
    return np.asarray(np.delete(array, BLIND, axis=-1))


def kalman_filter(chain: Chain, known: Derivatives, defect: FloatArray, late: FloatArray) -> Filter:
    """The filter of a chain.

    A sample is predicted from a state and forces that know nothing of later ones. The chain's own have the noise of
    these in them: what a gain makes of a velocity would go with the very noise it is compared with, and all gains
    and masses come out too small (errors in variables).

    Innovations of the inertial unit come first: unknown forces on the feet show in it. Those of the joints are what
    it leaves of them, whitened by the symmetric root of their covariance, so that each stays that of its joint.

    Parameters
    ----------
    chain, known : walk, and derivatives of its steps.
    defect : (n - 1, d) by how much its steps miss the next state.
    late : (n - 1, d) derivative of the ends of steps by the time that commands come later.
    """
    (n, j), count = chain.states.joint_position.shape, known.mean.shape[2]
    forces, unknown = unexplained(chain, known)
    noise, fair = (
        _without_base(np.delete(total, BLIND, axis=1))
        for total in (unknown, unexplained(replace(chain, slack=1.0), known)[1])
    )
    # what is as good as free: mean forces on the feet, which come first, and what joints hold, which comes last
    mean, beside = (np.delete(part, BLIND, axis=1) for part in np.split(forces, [count, 3 * count], axis=2)[::2])
    steady = np.concatenate([mean, beside], axis=2)
    start = _without_base(np.delete(known.start, BLIND, axis=1))
    sight, left = measurements(chain)
    sight = _without_base(sight)
    d = sight.shape[2]
    prior = np.diag(_without_base(each_of(LOOSE, chain)) ** 2)
    linked = chain.linked[:, None]
    late, defect = (np.where(linked, _without_base(part), 0.0) for part in (late, defect))
    carry, push = np.zeros((n - 1, d, d)), np.zeros((n - 1, d))
    moved, pushed = np.zeros((n, d)), np.zeros((n - 1, count))
    white_sight, white_seen, share = np.zeros((n, j, d)), np.zeros((n, j)), np.ones((n, j))
    cov, error, left_over = prior, np.zeros(d), 0.0
    right = prior  # the error, whatever the gains, where the model is right
    for k in range(n):
        own = sight[k]
        total = own @ cov @ own.T + np.eye(len(own))
        gain = np.linalg.solve(total, own @ cov).T
        by_imu = np.linalg.solve(total[j:, j:], total[j:, :j])
        values, vectors = np.linalg.eigh(total[:j, :j] - total[:j, j:] @ by_imu)
        whiten = (vectors / np.sqrt(values)) @ vectors.T @ np.hstack([np.eye(j), -by_imu.T])
        white_sight[k], white_seen[k] = whiten @ own, -whiten @ left[k]
        left_over += float(np.sum((whiten @ (left[k] + own @ error)) ** 2))
        share[k] = np.einsum("ij,jk,ik->i", whiten, own @ right @ own.T + np.eye(len(own)), whiten)
        if k and chain.linked[k - 1]:
            share[k] -= np.sum((white_sight[k] @ steady[k - 1]) ** 2, axis=1)
            pushed[k - 1] = -mean[k - 1].T @ own.T @ np.linalg.solve(total, left[k] + own @ error)
            push[k - 1] -= mean[k - 1] @ pushed[k - 1]
        keep = np.eye(d) - gain @ own
        moved[k] = keep @ error - gain @ left[k]
        if k == n - 1:
            break
        if not chain.linked[k]:
            cov, right, error = prior, prior, np.zeros(d)
            continue
        # predictions begin where the states have moved to
        carry[k], push[k] = start[k] @ keep, -start[k] @ (gain @ left[k] + moved[k])
        error = start[k] @ moved[k] + defect[k]
        # Joseph's form: what is subtracted is nearly all there is
        cov = start[k] @ (keep @ cov @ keep.T + gain @ gain.T) @ start[k].T + noise[k]
        right = start[k] @ (keep @ right @ keep.T + gain @ gain.T) @ start[k].T + fair[k]
        cov, right = 0.5 * (cov + cov.T), 0.5 * (right + right.T)
    whole = np.zeros((n, d + len(BLIND)))
    whole[:, np.delete(np.arange(d + len(BLIND)), BLIND)] = moved
    assert chain.steps.wrench is not None
    wrench = chain.steps.wrench + acting(chain, pushed)
    filtered = chain.states.moved(whole)
    misfit = left_over / float(share.sum())
    return Filter(
        chain.states, filtered, wrench, chain.linked, carry, push, white_sight, white_seen, share, late, misfit
    )


@dataclass(frozen=True, eq=False)
class Innovations(Comparison):
    """Predicted samples compared through a filter: residuals are its whitened innovations, joint by joint.

    Attributes
    ----------
    filter : of the walk.
    sensor : of each target (k,) noise of its sensors, of which a part goes into what is not known of the forces.
    """

    filter: Filter = field(kw_only=True)
    sensor: tuple[FloatArray, ...] = field(kw_only=True)

    @cached_property
    def projections(self) -> tuple[Projection, ...]:
        """By how much sensors and commands are apart in time is integrated out."""
        moved = self._of_targets(self.filter.respond(self.filter.late[None]))[0] * LATE
        gain = float(np.linalg.norm(moved))
        if not gain > 0:
            return ()
        every = np.arange(len(moved))
        return (Projection(every, (moved / gain)[:, None], np.array([gain]), np.zeros(len(moved)), 1.0),)

    def __getstate__(self) -> dict[str, Any]:
        return {**super().__getstate__(), "filter": self.filter, "sensor": self.sensor}

    def raw(self, outputs: Outputs) -> FloatArray:
        return self._of_targets(self.filter.innovations(self.filter.defects(outputs)))

    def _of_targets(self, white: FloatArray) -> FloatArray:
        """(m, r) of (m, n, j), target by target, each column by how much its noise is inflated."""
        parts = [
            (white[:, :, t.columns] * (noise / t.sigma))[:, t.mask]
            for t, noise in zip(self.targets, self.sensor, strict=True)
        ]
        return np.concatenate(parts, axis=1)


class InnovationsProcedure(Procedure):
    """How a fit goes about innovations: states and parameters in turn; no ground is replayed."""

    demand: ClassVar[int] = 1
    alternations: ClassVar[tuple[int, ...]] = (5, 5)
    last_turns: ClassVar[int] = 8
    coarse_suffices: ClassVar[bool] = True
    refines_step: ClassVar[bool] = False
    holds_out_anywhere: ClassVar[bool] = False
    costly: ClassVar[bool] = True
    no_torque: ClassVar[str] = "its base was floating, and samples are compared one by one"
    unseen: ClassVar[str] = (
        "samples of a walk are compared with their predictions from those before them, in which this changes "
        "nothing. Leave it out, or replay the walk on its ground: --mode segments"
    )

    def cheap(self, numerics: Numerics) -> Numerics:
        """Steps twice as long, which still divide a sample: without contact they err less than those of lower order."""
        return numerics if numerics.exact else replace(numerics, timestep=2 * numerics.timestep)

    def shows(self, term: type[Term]) -> bool:
        """Neither the ground nor what needs a past shows in a step of one sample."""
        return getattr(term, "needs", "") != GROUND and not remembers(term)


@dataclass(frozen=True, eq=False)
class InnovationsEpisode(Episode):
    """A walk whose samples are each compared with what those before it lead one to expect.

    Attributes
    ----------
    base : reconstructed motion, sample by sample of `recording`.
    chain, known, filter : the walk as a chain about its most probable states, once these are known.
    """

    base: BaseState
    chain: Chain | None = None
    known: Derivatives | None = None
    filter: Filter | None = None

    @property
    def procedure(self) -> Procedure:
        return InnovationsProcedure()

    @property
    def base_poses(self) -> FloatArray:
        return self.base.poses[: len(self.log)]

    @staticmethod
    def suits(robot: Robot, log: Log) -> bool:
        """Whether a log can be compared so: samples are regular, and nothing in the model has a memory."""
        return chainable(log, robot.for_log(log).always)

    @classmethod
    def whole(cls, robot: Robot, log: Log, threads: int = 0) -> Self:
        """All of a recording, up to a fall.

        Raises
        ------
        LogError, ModelError
            If the base cannot be reconstructed.
        """
        log, base = reconstruct(robot, log)
        if len(log) < LEAST:
            raise LogError(
                f"log {log.path or ''}: {len(log)} samples of it can be used ({'; '.join(map(str, base.events))}), and "
                f"innovations need {LEAST}: record more walking"
            )
        return cls(robot, log, np.ones(len(log), dtype=bool), base)

    @property
    def compared(self) -> BoolArray:
        """(n,) samples that count: those in which nothing shows of a beginning of the filter."""
        time, usable = self.log.time, self.base.usable[: len(self.log)]
        begun = np.maximum.accumulate(np.where(np.diff(usable, prepend=False) & usable, time, time[0]))
        return np.asarray(super().compared & usable & (time - begun >= self.base.size.time(SETTLING)))

    @property
    def breaks(self) -> IntArray:
        return 1 + np.flatnonzero(np.diff(self.base.usable[: len(self.log)].astype(np.int8)))

    def logged(self, channels: Sequence[str]) -> tuple[str, ...]:
        return tuple(c for c in super().logged(channels) if c == "position")

    def replay(
        self, terms: Sequence[Term], numerics: Numerics, *, effort: bool = False, threads: int = 0
    ) -> FloatingReplay:
        robot, log, n = self.robot.for_log(self.log), self.log, len(self.log)
        base = self.base.rows(0, n)
        if self.chain is None:
            return FloatingReplay(robot, log, tuple(terms), numerics, effort, threads, base=base)
        steps = self.chain.part(0, n).steps
        own = None if self.filter is None else self.filter.part(0, n)
        return Foreseen(
            robot,
            log,
            tuple(terms),
            numerics,
            effort,
            threads,
            segments=steps.segments,
            base=base,
            wrench=steps.wrench if own is None else own.wrench,
            friction=steps.friction,
            filtered=None if own is None else own.filtered.chosen(np.arange(n - 1)),
        )

    def completed(self, plain: Comparison) -> Comparison:
        if self.filter is None:
            return plain
        own = self.filter.part(0, len(self.log))
        return Innovations(
            plain.replay,
            tuple(_of_innovations(target, own) for target in plain.targets),
            stretch=self.base.size.time(BLOCK),
            filter=own,
            sensor=tuple(target.noise for target in plain.targets),
        )

    def shortened(self, seconds: float) -> Self:
        """So many seconds of what is scored, those in which the joints move most."""
        rows, time = np.flatnonzero(self.scored), self.recording.time
        length = int(np.searchsorted(time, time[0] + self.base.size.time(min(seconds, MOST_WALKED) + SETTLING)))
        if len(rows) <= length or self.chain is None or self.known is None or self.filter is None:
            return self
        motion = np.sum(self.chain.states.joint_velocity**2, axis=1)[: rows[-1] + 1]
        moved = np.convolve(motion[rows[0] :], np.ones(length), mode="valid")
        start = int(rows[0] + np.argmax(moved))
        own = slice(start, start + length)
        return replace(
            self,
            recording=self.recording.window(own.start, own.stop),
            scored=self.scored[own],
            base=self.base.rows(own.start, own.stop),
            chain=self.chain.part(own.start, own.stop),
            known=self.known.part(own.start, own.stop),
            filter=self.filter.part(own.start, own.stop),
        )

    def with_initial_states(
        self, compare: Callable[[], Comparison], values: FloatArray, coarse: Numerics, *, anew: bool = True
    ) -> Self:
        """The same about the states that are most probable under a candidate."""
        replay = compare().replay
        found = self if self.chain is not None else self._begun(coarse, replay.threads)
        if len(values) == 0:
            return found
        assert found.chain is not None
        assert found.known is not None
        n = len(self.log)
        chain, known = found.chain.part(0, n), found.known.part(0, n)
        chain = replace(chain, steps=replace(chain.steps, terms=replay.terms, numerics=coarse, threads=replay.threads))
        chain = with_friction(chain, values)
        with phase("states of the base", 0.1):
            chain, known = follow_states(chain, known, values, ROUNDS)
        return replace(found, chain=chain, known=known, filter=filter_at(chain, known, values))

    def _begun(self, numerics: Numerics, threads: int) -> Self:
        """About the most probable states of all of the recording in the plain model."""

        def begin() -> tuple[Chain, Derivatives, Filter]:
            robot = self.robot.for_log(self.recording)
            gains = (f"{g}:*=shared" for g in ("kp", "kv") if servo_joints(robot))
            terms = Terms(parse_parameters(["mass:*", *gains], robot))
            replay = FloatingReplay(robot, self.recording, tuple(terms), numerics, threads=threads, base=self.base)
            chain = with_friction(replace(chain_of(replay), slack=SLACKS[-1]), terms.nominal)
            known = derive(chain, terms.nominal)
            if not known.finite:
                raise diverged(chain.steps)
            with phase("states of the base", 0.9):
                chain, known = follow_states(chain, known, terms.nominal, FIRST_ROUNDS)
            return chain, known, filter_at(chain, known, terms.nominal, fitted=False)

        key = ("innovations", self.robot.fingerprint, self.robot.at, numerics)
        chain, known, own = self.recording.once(key, begin)
        return replace(self, chain=chain, known=known, filter=own)

    def choose_numerics(self, threads: int = 0, simulator: str = MUJOCO) -> tuple[Numerics, float]:
        """Half the longest step for derivatives: from sample to sample nothing happens that needs a finer one."""
        step = derivative_step(float(np.median(np.diff(self.log.time))), self.base.size)
        return Numerics("RK4", step, simulator=simulator).halved(), 0.0

    def facts(self) -> Mapping[str, Any]:
        return {
            "mode": "innovations",
            "why": self.why,
            "summary": f"floating base: {int(self.compared.sum())} samples, each compared with its prediction "
            "from those before it, whatever forces act on the feet",
            "samples": int(self.compared.sum()),
            "events": [str(event) for event in self.base.events],
            "used_until": float(self.log.time[-1]),
            "lost": self.base.lost,
        }


def _of_innovations(target: Target, own: Filter) -> Target:
    """A target whose noise floor is what the right model leaves of its sensors' noise."""
    share = own.share[:, target.columns]
    left = np.sqrt(np.sum(share * target.mask, axis=0) / np.maximum(target.mask.sum(axis=0), 1))
    floor = (NoiseFloor(f.sigma * float(s), f.method, f.step) for f, s in zip(target.floor, left, strict=True))
    return replace(target, floor=tuple(floor))


def follow_states(chain: Chain, known: Derivatives, values: FloatArray, rounds: int) -> tuple[Chain, Derivatives]:
    """A chain about its most probable states under a candidate, and its derivatives there.

    Or about the last states from which all of its steps can be simulated.
    """
    terms = Terms(chain.steps.terms)
    numbers, step = np.arange(len(values)), NUDGE_NUMBER * (terms.upper - terms.lower)
    sound = chain, known
    for k in range(rounds):
        mention(f"round {k + 1} of {rounds}", k / rounds)
        # how large jolts are is told once states have moved, at the numbers that suit them best
        sized = slice(None if k == rounds - 2 else 0)
        ends = simulate_chain(chain, values, numbers[sized], step[sized])
        if k == rounds - 2:
            chain = likeliest(chain, known, ends, SLACKS)
        found = linearise_chain(chain, known, ends)
        if not np.isfinite(found.surprise):
            return sound
        sound = chain, known
        chain = moved_chain(chain, known, found)
        # they hardly depend on numbers or states, but where joints stick and slip they do
        old = stale(chain, known, values, k)
        if old.any():
            known = known.renewed(old, derive(chain, values, np.flatnonzero(old)))
            if not known.finite:
                return sound
    return chain, known


def diverged(steps: SampleSteps) -> ModelError:
    """What to say of a model that no sample of a walk can be predicted with."""
    return ModelError(
        f"model {steps.robot.name}: it diverges within a sample of {steps.log.path or 'the log'}, from states as "
        f"measured, with steps of {1e3 * steps.numerics.timestep:.3g} ms. Check armature and masses: a body without "
        "mass is the usual cause."
    )


def filter_at(chain: Chain, known: Derivatives, values: FloatArray, *, fitted: bool = True) -> Filter:
    """The filter of a chain about its states under a candidate.

    A model that is `fitted` and leaves more than the right one does errs, and its gains allow for it: what it lacks
    would lead all of its numbers astray. Others do not, as what gains allow for is lost for the numbers.

    Raises
    ------
    ModelError
        If it diverges within a sample.
    """
    ends = simulate_chain(chain, values, np.arange(0), np.zeros(0))
    late = ends.by_number[:, :, -1]
    if not (known.finite and np.isfinite(ends.defect[chain.linked]).all() and np.isfinite(late[chain.linked]).all()):
        raise diverged(chain.steps)
    strict = kalman_filter(replace(chain, slack=1.0), known, ends.defect, late)
    if not fitted or strict.misfit <= InnovationsProcedure.tolerated:
        return strict
    return kalman_filter(chain, known, ends.defect, late)
