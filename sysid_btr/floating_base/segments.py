"""Cutting logs of a floating base into segments that start from its reconstructed states (multiple shooting)."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from sysid_btr._typing import FloatArray, IntArray
from sysid_btr.errors import LogError
from sysid_btr.floating_base.estimate import BaseState
from sysid_btr.floating_base.feet import touching_bodies, up_to_base
from sysid_btr.floating_base.size import BodySize
from sysid_btr.identify.initial_states import respond
from sysid_btr.io.log import Log
from sysid_btr.io.noise import position_noise
from sysid_btr.models.robot import Robot, servo_joints
from sysid_btr.objectives.problem import Comparison
from sysid_btr.objectives.targets import make_targets
from sysid_btr.simulation.base_states import BASE, BaseStates
from sysid_btr.simulation.numerics import MUJOCO, Numerics
from sysid_btr.simulation.segments import SegmentReplay, Segments, covered, segment_seconds, spread_evenly
from sysid_btr.simulation.silence import silenced
from sysid_btr.terms.grammar import parse_parameters
from sysid_btr.terms.model import Terms

WINDOW = 0.2
"""s of a Nao (`BodySize`), as are all times here: length of a segment where nothing speaks for a better one."""
WIDENED = 2.0
"""Factor on the stated standard deviations of an initial state: the smoother has used the segment's samples as well."""
FASTEST = 0.002
"""s, longest step with contacts, in which legs, servos and impacts move little."""
FEWEST = 4
"""Segments that a fitted log must have."""


@dataclass(frozen=True)
class FloatingReplay(SegmentReplay):
    """A log of a floating base replayed by segments.

    Attributes
    ----------
    base : motion of the base over the whole log, from which the segments were cut.
    """

    base: BaseState | None = None

    def lanes(self) -> list[list[tuple[int, IntArray]]]:
        """Limbs without a foot hang on the base; what happens in one of them hardly moves the others."""
        model, index = self.model, self.index
        joints = len(index.joints)
        everything = np.arange(joints)
        feet = {model.body(f.name).id for f in touching_bodies(model)}
        standing = {up_to_base(model, b)[-1] for b in feet}
        own = [up_to_base(model, int(b))[-1] for b in index.body]
        # where a robot stands and where it looks changes nothing
        lanes = [[(c, everything)] for c in (2, 3, 4, *range(6, BASE))]
        hanging: dict[int, list[int]] = {}
        for j, b in enumerate(own):
            if b in standing:
                lanes += [[(BASE + j, everything)], [(BASE + joints + j, everything)]]
            else:
                hanging.setdefault(b, []).append(j)
        for k in range(max((len(m) for m in hanging.values()), default=0)):
            members = [(m[k], np.array(m)) for m in hanging.values() if k < len(m)]
            lanes += [[(BASE + j, seen) for j, seen in members], [(BASE + joints + j, seen) for j, seen in members]]
        return lanes


def segment_log(
    log: Log, base: BaseState, seconds: float, borders: Sequence[float] = (), *, late: float = 0.0
) -> Segments:
    """Tile the usable parts of a log with segments.

    Parameters
    ----------
    log, base : a log and the motion of its base, sample by sample.
    seconds : length of a segment.
    borders : times (s since the first sample) that no segment crosses.
    late : fraction of a segment by which the first one of every usable part begins later.

    Raises
    ------
    LogError
        If too few fit in.
    """
    time = log.time - log.time[0]
    length = max(round(seconds / float(np.median(np.diff(time)))), 3)
    cuts = {0, len(time), *(int(np.searchsorted(time, b - 1e-9)) for b in borders)}
    cuts |= {int(i) + 1 for i in np.flatnonzero(np.diff(base.usable.astype(np.int8)))}
    edges = sorted(cuts)
    rows = [
        (a, a + length)
        for low, high in itertools.pairwise(edges)
        if base.usable[low]
        for a in range(low + round(late * length), high - length + 1, length)
    ]
    if len(rows) < FEWEST:
        found = "; ".join(map(str, base.events)) or "no event"
        raise LogError(
            f"log {log.path or ''}: only {len(rows)} segments of {seconds:g} s can be used of it ({found}): record "
            "more walking"
        )
    return starts_at(base, np.array(rows, dtype=np.int64))


def starts_at(base: BaseState, rows: IntArray) -> Segments:
    """Segments that start from the reconstructed state."""
    first = rows[:, 0]
    std = WIDENED * np.concatenate(
        [
            base.position_std[first],
            base.rotation_std[first],
            base.velocity_std[first],
            base.rate_std[first],
            base.joint_position_std[first],
            base.joint_velocity_std[first],
        ],
        axis=1,
    )
    # where a robot stands and where it looks changes nothing
    std[:, [0, 1]] = 0.0
    states = BaseStates(base.position[first], base.quaternion[first], base.velocity[first], base.rate[first])
    return Segments(rows, base.joint_position[first], base.joint_velocity[first], std, states)


def whole_step(period: float, longest: float) -> float:
    """The longest step that divides a period, s; 3 % more than the longest that is asked for will do."""
    step = period / max(int(np.ceil(0.97 * period / longest)), 1)
    return longest if abs(step - longest) < 1e-9 * step else step


def segment_numerics(
    robot: Robot, log: Log, segments: Segments, size: BodySize, threads: int = 0, simulator: str = MUJOCO
) -> tuple[Numerics, float]:
    """Integrator and step for a log of a floating base, and the change in noise floors when the step is halved.

    Fourth-order Runge-Kutta, which leaves gains unbiased between impacts. Impacts limit the order of every
    integrator, so the change is that of the middle segment, and the largest step that divides the sample period is
    halved once at most.
    """
    step = float(np.median(np.diff(log.time)))
    numerics = Numerics("RK4", step / round(step / whole_step(step, size.time(FASTEST))), simulator=simulator)
    few = segments.chosen(np.arange(0, len(segments), max(len(segments) // 16, 1)))
    error = np.inf
    for _ in range(2):
        replays = [
            SegmentReplay(robot, log, (), n, threads=threads, segments=few) for n in (numerics, numerics.halved())
        ]
        runs = [replay.predict(np.zeros((1, 0))) for replay in replays]
        change = (runs[1].position - runs[0].position)[0]
        joints = replays[0].index.joints
        sigma = position_noise(log, joints)
        each = [float(np.sqrt(np.mean((change[a:b] / sigma) ** 2))) for a, b in few.rows]
        error = float(np.median(each))
        if error <= TOLERATED:
            break
        numerics = numerics.halved()
    return numerics, error


TOLERATED = 0.2
"""Change of the middle segment under half the step, in noise floors, at which a step is fine enough."""


@dataclass(frozen=True)
class SegmentLength:
    """What one length of segment offers.

    Attributes
    ----------
    seconds : length.
    information : log of the information a second on a typical mass or gain, over that of the best length.
    misfit : chi2 of the middle segment in the plain model, starts integrated out: divergence.
    score : information less what the misfit takes from it.
    """

    seconds: float
    information: float
    misfit: float
    score: float


def choose_length(
    robot: Robot, log: Log, base: BaseState, numerics: Numerics, threads: int = 0
) -> tuple[SegmentLength, ...]:
    """Lengths of segment that a log allows, best first.

    The variance of an estimate is about misfit over information. Longer segments carry more information a second,
    because less of it goes into their starts, until errors of the model and of the starts have grown over it. Both
    are measured, on a few segments spread over the log, for all masses and the common gains.
    """
    gains = (f"{g}:*=shared" for g in ("kp", "kv") if servo_joints(robot))
    terms = Terms(parse_parameters(["mass:*", *gains], robot))
    values, step = terms.nominal, terms.scale
    found: list[tuple[float, FloatArray, float]] = []
    for seconds in map(base.size.time, LENGTHS):
        try:
            segments = segment_log(log, base, seconds)
        except LogError:
            continue
        segments = segments.chosen(spread_evenly(segments, log, TRIED * seconds))
        replay = FloatingReplay(robot.for_log(log), log, tuple(terms), numerics, threads=threads, segments=segments)
        inside = covered(segments, len(log))[:, None]
        targets = tuple(
            replace(t, mask=t.mask & inside) for t in make_targets(log, replay.index.joints, ("position",), 0.0)
        )
        comparison = Comparison(replay, targets, respond(replay, values))
        stencil = np.vstack([values, values + np.diag(step)])
        with silenced():
            white = np.concatenate([comparison.whitened(o) for _, o in replay.chunks(stencil)])
        if not np.isfinite(white).all():
            continue
        change = (white[1:] - white[0]) / step[:, None]
        chi2 = float(np.median([np.mean(white[0, p.columns] ** 2) for p in comparison.projections]))
        own = segment_seconds(segments, log)
        found.append((own, np.sum(change**2, axis=1) / (own * len(segments)), max(chi2, 1.0)))
    if not found:
        return ()
    best = np.max([information for _, information, _ in found], axis=0)
    informed = best > 0
    choices = []
    for seconds, information, chi2 in found:
        gain = float(np.median(np.log(np.maximum(information[informed], 1e-300) / best[informed])))
        choices.append(SegmentLength(seconds, gain, chi2, gain - float(np.log(chi2))))
    return tuple(sorted(choices, key=lambda c: -c.score))


def segment_best(
    robot: Robot, log: Log, base: BaseState, borders: Sequence[float] = (), threads: int = 0
) -> tuple[Segments, tuple[SegmentLength, ...]]:
    """Segments of the length that the part of a log before the first border asks for, and the lengths tried."""
    stop = int(np.searchsorted(log.time - log.time[0], borders[0])) if borders else len(log)
    step = whole_step(float(np.median(np.diff(log.time))), base.size.time(FASTEST))
    numerics = Numerics("implicitfast", step)
    lengths = choose_length(robot, log.window(0, stop), base.rows(0, stop), numerics, threads)
    good = [c.seconds for c in lengths if c.score >= lengths[0].score - NEARLY]
    return segment_log(log, base, min(good, default=base.size.time(WINDOW)), borders), lengths


NEARLY = 0.25
"""A shorter segment is taken whose variance is larger by this fraction at most: starts err less nonlinearly in it."""
LENGTHS = (0.1, 0.2, 0.3, 0.4)
"""s, of segments that are tried: a stride of a small biped is no longer."""
TRIED = 12
"""Segments on which a length is tried."""
