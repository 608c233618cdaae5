"""Logs of a free base made ready for identification: base state, windows, and what their starts leave open."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from sysid_btr._typing import BoolArray, FloatArray, IntArray
from sysid_btr.errors import LogError
from sysid_btr.floating_base.estimate import BaseState, estimate_base
from sysid_btr.floating_base.feet import base_body, touching_bodies
from sysid_btr.io.log import Log
from sysid_btr.models.robot import Robot, servo_joints
from sysid_btr.objectives.covariance import covariance, spread
from sysid_btr.objectives.marginal import Marginal, projections, sensitivity
from sysid_btr.objectives.noise import noise_floor
from sysid_btr.objectives.problem import Episode, ReplayProblem
from sysid_btr.objectives.targets import Target, make_targets
from sysid_btr.simulation.compiling import compile_model, make_index
from sysid_btr.simulation.numerics import Numerics
from sysid_btr.simulation.replay import Replay
from sysid_btr.simulation.segments import BASE, WindowReplay, Windows
from sysid_btr.simulation.silence import silenced
from sysid_btr.terms.base import Term
from sysid_btr.terms.grammar import parse_parameters
from sysid_btr.terms.model import Terms

if TYPE_CHECKING:
    import mujoco

WINDOW = 0.2
"""s, length of a window where nothing tells a better one."""
WIDENED = 2.0
"""Factor on the stated standard deviations of a start: the smoother has used samples of the window as well."""
FASTEST = 0.002
"""s, longest step with contacts: MuJoCo holds the time constant of a contact above twice the step."""
FEWEST = 4
"""Windows that a fitted log must have."""


@dataclass(frozen=True, eq=False)
class Walk(Log):
    """One episode of a log whose base was free, up to a fall.

    Attributes
    ----------
    base : reconstructed motion, sample by sample.
    windows : stretches that are replayed, and their starts.
    marginal : what the uncertainty of the starts can do, once known.
    choices : the lengths of window that were weighed, best first.
    """

    base: BaseState | None = None
    windows: Windows | None = None
    marginal: Marginal | None = None
    choices: tuple[WindowChoice, ...] = ()

    def window(self, start: int, stop: int) -> Walk:
        """Samples `start` to `stop` (exclusive), with the windows that lie within."""
        bare = Log.window(self, start, stop)
        assert isinstance(bare, Walk)
        if self.base is None:
            return bare
        stop = min(stop, len(self))
        if self.windows is None:
            return replace(bare, base=self.base.rows(start, stop))
        inside = np.flatnonzero((self.windows.rows[:, 0] >= start) & (self.windows.rows[:, 1] <= stop))
        marginal = None if self.marginal is None else self.marginal.chosen(inside).shifted(start)
        return replace(
            bare,
            base=self.base.rows(start, stop),
            windows=self.windows.chosen(inside).shifted(start),
            marginal=marginal,
        )

    @property
    def seconds(self) -> float:
        """Length of a window, s."""
        if self.windows is None or len(self.windows) == 0:
            return 0.0
        a, b = self.windows.rows[0]
        return float((self.time[b - 1] - self.time[a]) * (b - a) / max(b - a - 1, 1))

    def thinned(self, seconds: float) -> Walk:
        """The same samples with windows of no more than so many seconds, spread evenly over the walk."""
        if self.windows is None or len(self.windows) == 0:
            return self
        count = int(np.clip(round(seconds / self.seconds), 1, len(self.windows)))
        which = np.unique(np.linspace(0, len(self.windows) - 1, count).astype(np.int64))
        marginal = None if self.marginal is None else self.marginal.chosen(which)
        return replace(self, windows=self.windows.chosen(which), marginal=marginal)

    def only(self, begin: float) -> Walk:
        """The same samples with the windows from `begin` (s since the first sample) on."""
        if self.windows is None:
            return self
        time = self.time - self.time[0]
        which = np.flatnonzero(time[self.windows.rows[:, 0]] >= begin - 1e-9)
        marginal = None if self.marginal is None else self.marginal.chosen(which)
        return replace(self, windows=self.windows.chosen(which), marginal=marginal)


def make_walk(robot: Robot, log: Log) -> Walk:
    """Reconstruct the base of one episode, which is cut where the robot falls.

    Raises
    ------
    LogError, ModelError
        If the base cannot be reconstructed.
    """
    robot = robot.for_log(log)
    model = compile_model(robot, log, robot.always, Numerics("RK4", FASTEST))
    index = make_index(model)
    base = estimate_base(model, log, index.joints, index.qpos)
    stop = len(log)
    if any(e.kind == "fall" for e in base.events):
        stop = int(np.flatnonzero(base.usable)[-1]) + 1 if base.usable.any() else 0
    if stop < 2:
        raise LogError(f"log {log.path or ''}: nothing of it can be used: {', '.join(map(str, base.events))}")
    if stop < len(log):
        # what comes after a fall must not reach back through the smoother
        events = base.events
        base = estimate_base(model, log.window(0, stop), index.joints, index.qpos)
        base = replace(base, events=events)
    cut = log.window(0, stop)
    fields = {name: getattr(cut, name) for name in ("time", "channels", "meta", "episode", "path", "unknown")}
    return Walk(**fields, base=base)


def lay_windows(walk: Walk, seconds: float, borders: Sequence[float] = (), *, late: float = 0.0) -> Walk:
    """Tile the usable parts of a walk with windows.

    Parameters
    ----------
    walk : with a base state.
    seconds : length of a window.
    borders : times (s since the first sample) that no window crosses.
    late : fraction of a window by which the first one of every usable part begins later.

    Raises
    ------
    LogError
        If too few fit in.
    """
    base = walk.base
    assert base is not None
    time = walk.time - walk.time[0]
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
            f"log {walk.path or ''}: only {len(rows)} windows of {seconds:g} s can be used of it ({found}): record "
            "more walking"
        )
    table = np.array(rows, dtype=np.int64)
    return replace(walk, windows=starts_at(base, table), marginal=None)


def starts_at(base: BaseState, rows: IntArray) -> Windows:
    """Windows that start from the reconstructed state."""
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
    return Windows(
        rows,
        base.position[first],
        base.quaternion[first],
        base.velocity[first],
        base.rate[first],
        base.joint_position[first],
        base.joint_velocity[first],
        std,
    )


def make_replay(
    robot: Robot,
    log: Log,
    terms: Sequence[Term],
    numerics: Numerics,
    *,
    effort: bool = False,
    threads: int = 0,
) -> Replay:
    """The replay that suits a log: by windows where its base was free and is known."""
    if isinstance(log, Walk) and log.windows is not None:
        return WindowReplay(robot, log, tuple(terms), numerics, effort, threads, windows=log.windows)
    return Replay(robot, log, tuple(terms), numerics, effort, threads)


def walk_numerics(robot: Robot, walk: Walk, threads: int = 0) -> tuple[Numerics, float]:
    """Integrator and step for a walk, and the change in noise floors when the step is halved.

    Fourth-order Runge-Kutta, which leaves gains unbiased between impacts. Impacts limit the order of every
    integrator, so the change is that of the middle window, and the largest step that divides the sample period is
    halved once at most.
    """
    step = float(np.median(np.diff(walk.time)))
    numerics = Numerics("RK4", step / max(int(np.ceil(step / FASTEST - 1e-9)), 1))
    if walk.windows is None:
        return numerics, float("nan")
    few = walk.windows.chosen(np.arange(0, len(walk.windows), max(len(walk.windows) // 16, 1)))
    error = np.inf
    for _ in range(2):
        runs = [
            make_replay(robot, replace(walk, windows=few), (), n, threads=threads).predict(np.zeros((1, 0)))
            for n in (numerics, numerics.halved())
        ]
        change = (runs[1].position - runs[0].position)[0]
        joints = make_replay(robot, walk, (), numerics).index.joints
        sigma = np.array(
            [noise_floor(walk.channels[f"position.{j}"]).sigma if walk.has("position", j) else np.inf for j in joints]
        )
        each = [float(np.sqrt(np.mean((change[a:b] / sigma) ** 2))) for a, b in few.rows]
        error = float(np.median(each))
        if error <= TOLERATED:
            break
        numerics = numerics.halved()
    return numerics, error


TOLERATED = 0.2
"""Change of the middle window under half the step, in noise floors, at which a step is fine enough."""


@dataclass(frozen=True)
class WindowChoice:
    """What one length of window offers.

    Attributes
    ----------
    seconds : length.
    information : log of the information a second on a typical mass or gain, over that of the best length.
    misfit : chi2 of the middle window in the plain model, starts integrated out: divergence.
    score : information less what the misfit takes from it.
    """

    seconds: float
    information: float
    misfit: float
    score: float


def choose_window(robot: Robot, walk: Walk, numerics: Numerics, threads: int = 0) -> tuple[WindowChoice, ...]:
    """Lengths of window that a walk allows, best first.

    The variance of an estimate is about misfit over information. Longer windows carry more information a second,
    because less of it goes into their starts, until errors of the model and of the starts have grown over it. Both
    are measured, on a few windows spread over the walk, for all masses and the common gains.
    """
    gains = (f"{g}:*=shared" for g in ("kp", "kv") if servo_joints(robot))
    terms = Terms(parse_parameters(["mass:*", *gains], robot))
    values, step = terms.nominal, terms.scale
    found: list[tuple[float, FloatArray, float]] = []
    for seconds in LENGTHS:
        try:
            laid = lay_windows(walk, seconds)
        except LogError:
            continue
        laid = laid.thinned(TRIED * seconds)
        replay = make_replay(robot.for_log(walk), laid, terms, numerics, threads=threads)
        assert isinstance(replay, WindowReplay)
        inside = covered(laid)[:, None]
        targets = tuple(
            replace(t, mask=t.mask & inside) for t in make_targets(laid, replay.index.joints, ("position",), 0.0)
        )
        episode = Episode(replay, targets, respond(replay, values))
        stencil = np.vstack([values, values + np.diag(step)])
        with silenced():
            white = np.concatenate([episode.whitened(o) for _, o in replay.chunks(stencil)])
        if not np.isfinite(white).all():
            continue
        change = (white[1:] - white[0]) / step[:, None]
        chi2 = float(np.median([np.mean(white[0, p.columns] ** 2) for p in episode.projections]))
        assert laid.windows is not None
        found.append((laid.seconds, np.sum(change**2, axis=1) / (laid.seconds * len(laid.windows)), max(chi2, 1.0)))
    if not found:
        return ()
    best = np.max([information for _, information, _ in found], axis=0)
    told = best > 0
    choices = []
    for seconds, information, chi2 in found:
        gain = float(np.median(np.log(np.maximum(information[told], 1e-300) / best[told])))
        choices.append(WindowChoice(seconds, gain, chi2, gain - float(np.log(chi2))))
    return tuple(sorted(choices, key=lambda c: -c.score))


def cut_up(robot: Robot, walk: Walk, borders: Sequence[float] = (), threads: int = 0) -> Walk:
    """Tile a walk with windows of the length that its part before the first border asks for."""
    stop = int(np.searchsorted(walk.time - walk.time[0], borders[0])) if borders else len(walk)
    choices = choose_window(robot, walk.window(0, stop), Numerics("implicitfast", FASTEST), threads)
    good = [c.seconds for c in choices if c.score >= choices[0].score - NEARLY]
    return replace(lay_windows(walk, min(good, default=WINDOW), borders), choices=choices)


NEARLY = 0.25
"""A shorter window is taken whose variance is larger by this fraction at most: starts err less nonlinearly in it."""
LENGTHS = (0.1, 0.2, 0.3, 0.4)
"""s, of windows that are tried: a stride of a small biped is no longer."""
TRIED = 12
"""Windows on which a length is tried."""


def covered(walk: Walk) -> BoolArray:
    """(n,) whether a sample lies in a window."""
    result = np.zeros(len(walk), dtype=bool)
    for a, b in walk.windows.rows if walk.windows is not None else ():
        result[a:b] = True
    return result


def settle(
    walk: Walk,
    replay: Replay,
    targets: tuple[Target, ...],
    values: FloatArray,
    rough: Numerics,
    *,
    anew: bool = True,
) -> Walk:
    """Move the starts of a walk's windows to where the data want them, and find what they leave open.

    One Gauss-Newton step for each window, with the reconstructed state as its prior.

    Parameters
    ----------
    walk, replay, targets : of the same episode.
    values : (p,) the candidate.
    rough : integrator and step for derivatives with respect to the starts.
    anew : whether derivatives that are known are taken again.
    """
    assert isinstance(replay, WindowReplay)
    assert walk.windows is not None
    windows = walk.windows
    w, coordinates = windows.std.shape
    before = walk.marginal
    marginal = before
    if anew or marginal is None:
        marginal = respond(replace(replay, numerics=rough), values)
        if before is not None:
            marginal = replace(marginal, shift=before.shift)
    # sigma of the noise itself: how well a window is explained must not depend on what others leave
    plain = tuple(replace(t, sigma=t.noise) for t in targets)
    episode = Episode(replay, plain, marginal)
    white = episode.raw(replay.predict(values[None]))[0]
    change = np.zeros((w, coordinates))
    shift = marginal.shift.copy()
    if not np.isfinite(white).all():
        return replace(walk, marginal=marginal)
    for i in range(w):
        columns, moved = sensitivity(marginal, i, plain)
        information = moved.T @ moved + np.eye(coordinates)
        rest = white[columns] - moved @ shift[i]
        best = -np.linalg.solve(information, moved.T @ rest)
        best = np.clip(best, -FARTHEST, FARTHEST)
        change[i] = (best - shift[i]) * windows.std[i]
        shift[i] = best
    moved_walk = replace(walk, windows=windows.moved(change), marginal=replace(marginal, shift=shift))
    return weigh(moved_walk, replace(replay, windows=moved_walk.windows), plain, values)


USUAL, LEAST_WEIGHT = 0.3, 0.02
"""Quantile of the windows' chi2 up to which they count in full, and the least that a window counts."""
FARTHEST = 3.0
"""Standard deviations by which a start is moved at most."""


def weigh(walk: Walk, replay: Replay, targets: tuple[Target, ...], values: FloatArray) -> Walk:
    """Count each window by the size of the error that is left in it: a missed impact is no evidence.

    Only windows that are worse than most are counted less: an error in all of them is to be found, not hidden.
    """
    assert walk.marginal is not None
    plain = replace(walk.marginal, weight=np.ones(len(walk.marginal.rows)))
    episode = Episode(replay, targets, plain)
    white = episode.whitened(replay.predict(values[None]))[0]
    chi2 = np.array([np.mean(white[p.columns] ** 2) for p in projections(plain, targets)])
    chi2 = np.nan_to_num(chi2, nan=np.inf)
    usual = max(float(np.quantile(chi2, USUAL)), 1.0)
    return replace(walk, marginal=replace(plain, weight=np.clip(np.sqrt(usual / chi2), LEAST_WEIGHT, 1.0)))


def repeated_error(problem: ReplayProblem, jacobian: FloatArray, residual: FloatArray) -> FloatArray:
    """Standard deviation of estimates, (p,), from errors that come back with every stride, beyond that of noise.

    Every stride repeats what the model of the contact does wrong, and what the reconstruction of the base does: the
    stretches of a walk are no independent pieces, however long it is. Independent are the phases of the gait, and the
    joints: where they disagree on a parameter, more walking does not settle it. Added to a covariance over stretches
    of time this is clustering several ways (Cameron, Gelbach, Miller 2011, doi:10.1198/jbes.2010.07136). Few pieces
    know their own spread badly: each part is scaled to the normal distribution.

    Parameters
    ----------
    problem : in which at least one log is a walk.
    jacobian, residual : (r, p) and (r,), whitened.
    """
    from scipy.stats import norm, t

    walked = walked_residuals(problem)
    # other logs have no such errors; what they know holds the estimates all the same
    residual = np.where(walked, residual, 0.0)
    noise = np.diag(covariance(jacobian, residual, np.arange(len(residual)) // SHORT))
    total = np.zeros(len(noise))
    for pieces in (problem.column_labels, _phases(problem)):
        if pieces is None or len(np.unique(pieces[walked])) < FEWEST:
            continue
        pieces = np.where(walked, pieces, pieces.max() + 1 + problem.blocks)
        cov, dof = spread(jacobian, residual, pieces)
        with np.errstate(invalid="ignore"):
            beyond = np.nan_to_num(np.diag(cov) - noise, posinf=0.0, neginf=0.0)
        total += np.maximum(beyond, 0.0) * (t.ppf(0.975, dof) / norm.ppf(0.975)) ** 2
    return np.asarray(np.sqrt(total))


SHORT = 8
"""Residuals in a row that make a piece where all are taken for independent."""


def of_legs(problem: ReplayProblem) -> BoolArray:
    """(p,) whether a parameter is of a body between the base and the ground of a walk, or of the ground itself."""
    walk = next((e.replay for e in problem.episodes if isinstance(e.replay.log, Walk)), None)
    if walk is None:
        return np.zeros(len(problem.parameters), dtype=bool)
    model = walk.model
    feet = [model.body(foot.name).id for foot in touching_bodies(model)]
    legs = {model.body(b).name for foot in feet for b in _up_to_base(model, foot)} - {model.body(base_body(model)).name}
    result: list[bool] = []
    for term in problem.terms:
        for places in term.grouped:
            own = term.scope == "body" and not legs.isdisjoint(places)
            result += [own or term.name.startswith("foot_")] * len(term.kinds)
    return np.array(result)


GROUND, GROUND_MASS = 4.0, 0.5
"""Root-mean-square error of what belongs to legs and feet over what the strides of one log tell of it by the model's
ground, and for masses of legs (as factors of the nominal) that error itself: on 11 own walks over another ground it was
0.31 of a shank, 0.60 of a thigh, 0.51 of a hip, whatever the strides told (`benchmarks.ground`). No part of a log
disagrees with what its ground does everywhere. Arms and gains need nothing: 0.6 to 0.9 of what they are told."""


def walked_residuals(problem: ReplayProblem) -> BoolArray:
    """(r,) whether a residual is of a log of a free base."""
    free = [problem.episodes[i].replay.log.meta.mount == "free" for i, _, _ in problem.columns]
    return np.array(free)[problem.column_labels]


def _phases(problem: ReplayProblem) -> IntArray | None:
    """(r,) phase of the gait of the window that each residual belongs to; None where no gait repeats."""
    labels, found, first = [], False, 0
    for episode in problem.episodes:
        log = episode.replay.log
        length = stride(log) if isinstance(log, Walk) else None
        # what repeats in no stride is in pieces of its own
        phase = (log.time - log.time[0]).astype(np.int64)
        if length is not None and isinstance(log, Walk) and log.windows is not None:
            found = True
            count = max(round(length / log.seconds), FEWEST)
            for a, b in log.windows.rows:
                middle = 0.5 * (log.time[a] + log.time[b - 1]) - log.time[0]
                phase[a:b] = int(count * np.mod(middle / length, 1.0))
        labels += [(first + np.broadcast_to(phase[:, None], t.mask.shape))[t.mask] for t in episode.targets]
        first += int(phase.max()) + 1
    return np.concatenate(labels) if found else None


def stride(walk: Log) -> float | None:
    """Time after which the commands of a walk repeat, s; None where they do not."""
    step = float(np.median(np.diff(walk.time)))
    moving = np.stack([c for n, c in walk.channels.items() if n.startswith("command.")], axis=1)
    moving = np.nan_to_num(moving - np.nanmean(moving, axis=0))
    moving = moving[:, np.std(moving, axis=0) > STILL]
    lags = np.arange(round(STRIDES[0] / step), min(round(STRIDES[1] / step), len(moving) // 2))
    if len(lags) < 3 or moving.shape[1] == 0:
        return None
    moving = moving / np.std(moving, axis=0)
    alike = np.array([np.mean(moving[:-k] * moving[k:]) for k in lags])
    inner = alike[1:-1]
    peaks = np.flatnonzero((inner >= alike[:-2]) & (inner >= alike[2:]) & (inner > max(ALIKE, 0.95 * alike.max()))) + 1
    return float(lags[peaks[0]] * step) if len(peaks) else None


STRIDES = (0.3, 3.0)
"""s, between which a stride lasts."""
STILL = 0.01
"""rad, standard deviation of a command below which a joint stands still."""
ALIKE = 0.8
"""Autocorrelation of commands that repeat."""


def respond(replay: WindowReplay, values: FloatArray) -> Marginal:
    """Derivatives of all sensors with respect to the starts of all windows."""
    windows = replay.windows
    assert windows is not None
    lanes = start_lanes(replay)
    w, coordinates = windows.std.shape
    directions = np.zeros((w, len(lanes) + 1, coordinates))
    for k, lane in enumerate(lanes):
        for coordinate, _ in lane:
            directions[:, k, coordinate] = windows.std[:, coordinate]
    responses: list[dict[str, FloatArray]] = [{} for _ in range(w)]
    channels = ("position", "velocity", *(("effort",) if replay.effort else ()))
    with silenced():
        for i, outputs in replay.respond(values, directions):
            for channel in channels:
                array: FloatArray = getattr(outputs, channel)
                change = np.nan_to_num(array[:-1] - array[-1:])
                table = np.zeros((coordinates, *change.shape[1:]))
                for k, lane in enumerate(lanes):
                    for coordinate, seen in lane:
                        table[coordinate][:, seen] = change[k][:, seen]
                responses[i][channel] = table
    return Marginal(windows.rows, tuple(responses), np.ones(w), np.zeros((w, coordinates)))


def start_lanes(replay: WindowReplay) -> list[list[tuple[int, IntArray]]]:
    """Coordinates of a start that one simulation can vary together: (coordinate, joints that it moves).

    Limbs without a foot hang on the base; what happens in one of them hardly moves the others.
    """
    model, index = replay.model, replay.index
    joints = len(index.joints)
    everything = np.arange(joints)
    feet = {model.body(f.name).id for f in touching_bodies(model)}

    standing = {_up_to_base(model, b)[-1] for b in feet}
    own = [_up_to_base(model, int(b))[-1] for b in index.body]
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


def _up_to_base(model: mujoco.MjModel, body: int) -> list[int]:
    """A body and those between it and the base, outermost first."""
    base, chain = base_body(model), [body]
    while int(model.body_parentid[chain[-1]]) not in (base, 0):
        chain.append(int(model.body_parentid[chain[-1]]))
    return chain
