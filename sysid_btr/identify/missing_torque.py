"""The torque that is missing: from what a replay leaves of the measured positions to torques at the joints.

A small torque pulse at each joint, simulated, gives the impulse responses of a subtree; Wiener deconvolution
with them turns position errors into the disturbance torques that would explain them (Wiener 1949,
"Extrapolation, Interpolation, and Smoothing of Stationary Time Series"). Joints of one subtree push each other,
so a subtree is inverted as a whole. Segments are too short for such a response: there it is what the measured motion
takes beyond what the drives give.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import cast

import numpy as np

from sysid_btr._typing import FloatArray
from sysid_btr.errors import LogError
from sysid_btr.identify.inverse import InverseEpisode
from sysid_btr.identify.projection import orthonormal
from sysid_btr.mujoco_conventions import free_joints
from sysid_btr.objectives.problem import Comparison, ReplayProblem
from sysid_btr.objectives.targets import WARM_UP
from sysid_btr.simulation.inverse import InverseReplay
from sysid_btr.simulation.segments import SegmentReplay
from sysid_btr.simulation.subtrees import subtrees
from sysid_btr.terms.base import Outputs, Term
from sysid_btr.terms.disturbance import ExternalDisturbanceTrain
from sysid_btr.terms.scales import Scales, scale_at

MOST_SAMPLES = 8192
"""Longer episodes are averaged down to this many samples."""
LINEAR = 0.02
"""Relative error of a linear response: this fraction of a residual counts as noise on top of the sensor's."""
LONGEST_MEMORY = 2.0
"""Seconds after which a response is taken to be over."""
PULSES = 5
"""Pulses whose responses are averaged, at least."""
EDGE = 0.1
"""Seconds before the end of an episode whose torque shows too late to be known."""
SLOW = 0.05
"""Signal, relative to its rms, below which its sign is a matter of noise."""
NEIGHBOURS = 4
"""Frequencies on either side over which a spectrum is averaged."""
ITERATIONS = 4
"""Of the estimate of how large the torques are."""


@dataclass(frozen=True, eq=False)
class MissingTorque:
    """Torque that would explain the position error of one joint in one episode, and what went with it.

    Attributes
    ----------
    joint, episode : where.
    unit : of the torque.
    period : (s) of the uniform grid.
    time : (n,) s since the first sample.
    torque : (n,) Nm or N; smoothed to what the sensor can resolve.
    noise : standard deviation of what sensor noise makes of it.
    residual : (n,) position error in noise floors.
    chi2 : its mean square; 1 at the noise floor.
    position, velocity, acceleration : (n,) position as measured, derivatives as replayed.
    command : (n,) of the servo.
    servo, servo_measured : (n,) torque of the servo in the state that is replayed and in the one measured.
        The latter is what a failing servo does not give; but it also answers every disturbance.
    frequency, gain : (f,) Hz and fraction of a torque at that frequency that `torque` shows.
    taken : (n, k) orthonormal, what the model's own numbers can do to it, which is taken off; none where that is not
        known.
    """

    joint: str
    episode: int
    unit: str
    period: float
    time: FloatArray
    torque: FloatArray
    noise: float
    residual: FloatArray
    chi2: float
    position: FloatArray
    velocity: FloatArray
    acceleration: FloatArray
    command: FloatArray
    servo: FloatArray
    servo_measured: FloatArray
    frequency: FloatArray
    gain: FloatArray
    taken: FloatArray = field(default_factory=lambda: np.zeros((0, 0)))

    @property
    def direction(self) -> FloatArray:
        """(n,) sign of the velocity, smooth where a measured sign would be a matter of noise."""
        return smooth_sign(self.velocity)

    def seen(self, columns: FloatArray) -> FloatArray:
        """Torques (n, k) or (n,) as this estimate would show them, without noise."""
        mirrored = np.concatenate([columns, columns[::-1]])
        spectrum = np.fft.rfft(mirrored, axis=0)
        at = np.fft.rfftfreq(len(mirrored), self.period)
        gain = np.interp(at, self.frequency, self.gain)
        spectrum *= gain if columns.ndim == 1 else gain[:, None]
        shown = np.fft.irfft(spectrum, len(mirrored), axis=0)[: len(columns)]
        return np.asarray(shown - self.taken @ (self.taken.T @ shown) if self.taken.size else shown)

    def beside(self, columns: FloatArray) -> MissingTorque:
        """The estimate without what torques (n, k), in any amounts, can do to it."""
        basis = orthonormal(self.seen(columns))
        taken = np.hstack([self.taken, basis]) if self.taken.size else basis
        return replace(self, torque=self.torque - basis @ (basis.T @ self.torque), taken=taken)


def smooth_sign(signal: FloatArray) -> FloatArray:
    """Sign of a signal (n,), smooth where it is small beside its rms."""
    size = float(np.sqrt(np.mean(signal**2)))
    return np.asarray(np.tanh(signal / max(SLOW * size, 1e-300)))


def torque_responses(problem: ReplayProblem, values: FloatArray, scales: Scales) -> tuple[TorqueResponse | None, ...]:
    """What each episode shows of torques at its joints; see `TorqueResponse.of`."""
    return tuple(TorqueResponse.of(episode, values, scales) for episode in problem.episodes)


def missing_torques(
    problem: ReplayProblem, values: FloatArray, scales: Scales, responses: Sequence[TorqueResponse | None] | None = None
) -> tuple[MissingTorque, ...]:
    """Torques that a problem's model lacks, at every measured joint of every episode.

    Where torques are compared they are what is left. Position errors are deconvolved into them, or, over segments, what
    the drives give is compared with what the motion takes; the latter is not to be had on a free base.

    Parameters
    ----------
    problem : data and terms.
    values : (p,) of the terms.
    scales : sizes at the joints.
    responses : of each episode, where they are known already.

    Returns
    -------
    tuple of MissingTorque
        Empty where the replay diverges.
    """
    result: list[MissingTorque] = []
    known = torque_responses(problem, values, scales) if responses is None else responses
    for i, (episode, response) in enumerate(zip(problem.episodes, known, strict=True)):
        if isinstance(episode.replay, InverseReplay):
            result += _compared(i, episode, episode.replay, values, scales)
        elif response is not None:
            result += _deconvolve(i, episode, response, scales)
        elif isinstance(episode.replay, SegmentReplay) and not len(free_joints(episode.replay.model)):
            result += _of_motion(i, problem, episode.replay, values, scales)
    return tuple(result)


def _compared(
    number: int, episode: Comparison, replay: InverseReplay, values: FloatArray, scales: Scales
) -> list[MissingTorque]:
    """What is left where torques themselves are compared: what a drive gives too much, something else takes away."""
    motion, outputs = replay.motion, replay.predict(values[None])
    target = next(t for t in episode.targets if t.channel == "effort")
    rows = np.flatnonzero(target.mask.any(axis=1))
    keep = slice(int(rows[0]), int(rows[-1]) + 1)
    predicted = target.predicted(outputs)[0]
    error = target.measured - predicted
    frequency = np.asarray(np.fft.rfftfreq(len(error), motion.period), dtype=np.float64)
    result = []
    for k, joint in enumerate(target.joints):
        column, mask = target.columns[k], target.mask[:, k]
        white = error[:, k] / target.noise[k]
        result.append(
            MissingTorque(
                joint=joint,
                episode=number,
                unit=scale_at(scales, joint).unit("Nm"),
                period=motion.period,
                time=motion.time[keep],
                torque=-error[keep, k],
                noise=float(target.noise[k]),
                residual=white[keep],
                chi2=float(np.mean(white[mask] ** 2)) if mask.any() else 1.0,
                position=motion.position[keep, column],
                velocity=motion.velocity[keep, column],
                acceleration=motion.acceleration[keep, column],
                command=motion.position[keep, column],
                servo=predicted[keep, k],
                servo_measured=target.measured[keep, k],
                frequency=frequency,
                gain=motion.seen(frequency),
            )
        )
    return result


def _of_motion(
    number: int, problem: ReplayProblem, replay: SegmentReplay, values: FloatArray, scales: Scales
) -> list[MissingTorque]:
    """What the measured motion takes beyond what the drives give, whatever the model's own numbers are near these.

    How loud a joint is, its positions say: they are what is compared.
    """
    target = next((t for t in problem.episodes[number].targets if t.channel == "position"), None)
    step = np.where(values + problem.scale <= problem.upper, problem.scale, -problem.scale)
    near = np.vstack([values, values + np.diag(step)])
    outputs = replace(replay, effort=True).predict(near)
    if target is None or outputs.effort is None or not np.isfinite(outputs.effort[0]).all():
        return []
    log = replay.log
    channels = {name: column for name, column in log.channels.items() if not name.startswith("effort.")}
    channels |= {f"effort.{j}": outputs.effort[0][:, k] for j, k in zip(target.joints, target.columns, strict=True)}
    try:
        motion = InverseEpisode.whole(replay.robot, replace(log, channels=channels), replay.threads)
        compared = motion.compare(problem.terms, ("effort",), replay.numerics, threads=replay.threads)
    except LogError:
        return []  # no joint moves, or too little is logged
    inverse = cast("InverseReplay", compared.replay)
    found = _compared(number, compared, inverse, values, scales)
    left = problem.column_chi2(problem.residuals(values[None])[0])
    chi2 = {t.joints[k]: float(left[c]) for c, (i, t, k) in enumerate(problem.columns) if i == number and t is target}
    error = np.nan_to_num((target.measured - target.predicted(outputs)[0]) / target.noise)
    time, commands = log.time - log.time[0], _commands(problem.episodes[number], target.columns)
    taken = inverse.predict(near).effort
    assert taken is not None
    result = []
    for one in found:
        k = target.joints.index(one.joint)
        residual, command = (np.interp(one.time, time, x[:, k]) for x in (error, commands))
        given = outputs.effort[:, :, target.columns[k]]
        shown = replace(one, chi2=chi2[one.joint], residual=residual, command=command)
        more = taken[1:, :, target.columns[k]] - taken[0, :, target.columns[k]]
        for change, driven in zip(more, np.nan_to_num(given[1:] - given[0]), strict=True):
            change -= motion.kinematics.low_passed(np.interp(motion.kinematics.time, time, driven)[:, None])[:, 0]
        first = int(np.searchsorted(motion.kinematics.time, one.time[0]))
        result.append(_quietened(shown).beside(more[:, first : first + len(one.time)].T))
    return result


def _quietened(one: MissingTorque) -> MissingTorque:
    """What is seen of a torque through the noise of accelerations, which grows as the square of the frequency (Wiener).

    Its level is what is left at the highest frequencies that are compared, if that is less than was thought.
    """
    from scipy.ndimage import uniform_filter1d

    count = len(one.torque)
    spectrum = np.fft.rfft(np.concatenate([one.torque, one.torque[::-1]]))
    frequency = np.asarray(np.fft.rfftfreq(2 * count, one.period), dtype=np.float64)
    shown = np.interp(frequency, one.frequency, one.gain)
    power = uniform_filter1d(np.abs(spectrum) ** 2 / (2 * count), 2 * NEIGHBOURS + 1, mode="nearest")
    noise = frequency**4 * shown**2
    noise *= one.noise**2 / max(float(np.mean(noise)), 1e-300)
    fast = (shown > 0.5) & (frequency > 0.5 * np.max(frequency, where=shown > 0.5, initial=0.0))
    noise *= min(float(np.median(power[fast] / np.maximum(noise[fast], 1e-300))), 1.0) if fast.any() else 1.0
    seen = np.clip(1.0 - noise / np.maximum(power, 1e-300), 0.0, 1.0)
    return replace(
        one,
        torque=np.asarray(np.fft.irfft(spectrum * seen, 2 * count)[:count]),
        noise=float(np.sqrt(np.mean(noise * seen**2))),
        frequency=frequency,
        gain=shown * seen,
    )


@dataclass(frozen=True, eq=False)
class _Clock:
    """A uniform grid over the samples of a log, a few of which are averaged into one."""

    time: FloatArray
    fine: float
    together: int

    @classmethod
    def over(cls, time: FloatArray) -> _Clock:
        fine = float(np.median(np.diff(time)))
        samples = int(np.floor((time[-1] - time[0]) / fine + 1e-6)) + 1
        return cls(time - time[0], fine, -(-samples // MOST_SAMPLES))

    @property
    def period(self) -> float:
        return self.fine * self.together

    def uniform(self, values: FloatArray) -> FloatArray:
        """Values (samples, k) on the grid, (n, k); missing ones are interpolated."""
        samples = int(np.floor(self.time[-1] / self.fine + 1e-6)) + 1
        grid = np.arange(samples) * self.fine
        columns = []
        for column in values.T:
            known = np.isfinite(column)
            columns.append(np.interp(grid, self.time[known], column[known]))
        fine = np.column_stack(columns)
        whole = samples // self.together * self.together
        return np.asarray(fine[:whole].reshape(-1, self.together, fine.shape[1]).mean(axis=1))


@dataclass(frozen=True, eq=False)
class TorqueResponse:
    """How what one episode's sensors show answers small torques at its joints, and the state that goes with it.

    Attributes
    ----------
    joints : (k,) at which torques act.
    members : positions, in `joints`, of those of each subtree; joints of one subtree move each other.
    shown : (k,) joints of each channel that is compared, by channel.
    impulses : by channel and subtree, (memory, shown of the subtree, members): response to one sample of unit torque.
    clock : of the uniform grid.
    error : (n, k) position measured minus predicted.
    chi2 : (k,) mean square of the samples of it that count, over the noise floor.
    states : (n, k) each: position as measured, velocity, servo (torque), predicted (position), command.
    """

    joints: tuple[str, ...]
    members: tuple[tuple[int, ...], ...]
    shown: dict[str, tuple[tuple[int, ...], ...]]
    impulses: dict[str, tuple[FloatArray, ...]]
    clock: _Clock
    error: FloatArray
    chi2: FloatArray
    states: dict[str, FloatArray]

    @classmethod
    def of(cls, episode: Comparison, values: FloatArray, scales: Scales) -> TorqueResponse | None:
        """By simulation; None where that diverges, where no positions are compared, or only over short segments."""
        target = next((t for t in episode.targets if t.channel == "position"), None)
        # segments are too short for the memory of a response
        if target is None or episode.marginal is not None or isinstance(episode.replay, InverseReplay):
            return None
        clock, joints = _Clock.over(episode.replay.log.time), target.joints
        where = subtrees(episode.replay.model)
        members: dict[int, list[int]] = {}
        for k, joint in enumerate(joints):
            members.setdefault(where[joint], []).append(k)
        spacing = min(LONGEST_MEMORY, clock.time[-1] / (PULSES + 1))
        memory = int(spacing / clock.period)
        if memory < 4:
            return None
        sizes = np.array([scale_at(scales, j).torque_peak for j in joints])
        width = max(clock.period, episode.replay.numerics.timestep)
        rest = (0.0, clock.period * memory, width, clock.period * memory)
        outputs = _pulsed(
            episode, values, ExternalDisturbanceTrain.at(joints, scales), rest, sizes, [*members.values()]
        )
        if not np.isfinite(outputs.position).all() or outputs.effort is None:
            return None
        shown: dict[str, tuple[tuple[int, ...], ...]] = {}
        impulses: dict[str, tuple[FloatArray, ...]] = {}
        for one in episode.targets:
            predicted = one.predicted(outputs)
            moved = [clock.uniform(p - predicted[0]) for p in predicted[1:]]
            shown[one.channel] = tuple(
                tuple(i for i, joint in enumerate(one.joints) if where[joint] == subtree) for subtree in members
            )
            impulses[one.channel] = tuple(
                np.stack(
                    [
                        _impulse(moved[row][:, seen], memory) / (sizes[k] * width / clock.period)
                        for row, k in enumerate(own)
                    ],
                    axis=2,
                )
                for own, seen in zip(members.values(), shown[one.channel], strict=True)
            )
        predicted, columns = target.predicted(outputs)[0], target.columns
        states = {
            "position": clock.uniform(np.where(np.isfinite(target.measured), target.measured, predicted)),
            "velocity": clock.uniform(outputs.velocity[0][:, columns]),
            "servo": clock.uniform(outputs.effort[0][:, columns]),
            "predicted": clock.uniform(predicted),
            "command": clock.uniform(_commands(episode, columns)),
        }
        error = target.measured - predicted
        white = np.where(target.mask, error / target.noise, 0.0)
        chi2 = (white**2).sum(axis=0) / np.maximum(target.mask.sum(axis=0), 1)
        groups = tuple(map(tuple, members.values()))
        return cls(joints, groups, shown, impulses, clock, clock.uniform(error), chi2, states)

    def shows(self, channel: str, joint: int, torques: FloatArray) -> tuple[tuple[int, ...], FloatArray]:
        """What torques (n, m) at one joint do to a channel: which of its joints, and (n, m, joints)."""
        subtree = next(i for i, own in enumerate(self.members) if joint in own)
        impulse = self.impulses[channel][subtree][:, :, self.members[subtree].index(joint)]
        size = len(torques) + len(impulse)
        spectrum = np.fft.rfft(torques, size, axis=0)[:, :, None] * np.fft.rfft(impulse, size, axis=0)[:, None, :]
        return self.shown[channel][subtree], np.asarray(np.fft.irfft(spectrum, size, axis=0)[: len(torques)])


def _deconvolve(number: int, episode: Comparison, found: TorqueResponse, scales: Scales) -> list[MissingTorque]:
    target = next(t for t in episode.targets if t.channel == "position")
    clock, error, states, joints = found.clock, found.error, found.states, found.joints
    torque = np.empty_like(error)
    noise = np.empty(len(joints))
    gains: dict[int, FloatArray] = {}
    frequency = np.zeros(0)
    for own, response in zip(map(list, found.members), found.impulses["position"], strict=True):
        floor = target.noise[own] / np.sqrt(clock.together)
        inverse = _wiener(error[:, own], response, floor)
        torque[:, own], noise[own] = inverse.torque, inverse.noise
        frequency = inverse.frequency / clock.period
        gains.update({k: inverse.gain[:, i] for i, k in enumerate(own)})
    keep = slice(int(min(WARM_UP, 0.1 * clock.time[-1]) / clock.period), len(error) - int(EDGE / clock.period))
    acceleration = np.gradient(states["velocity"], clock.period, axis=0)
    chi2 = found.chi2
    return [
        MissingTorque(
            joint=joint,
            episode=number,
            unit=scale_at(scales, joint).unit("Nm"),
            period=clock.period,
            time=clock.period * np.arange(len(error), dtype=np.float64)[keep],
            torque=torque[keep, k],
            noise=float(noise[k]),
            residual=(error[:, k] / target.noise[k])[keep],
            chi2=float(chi2[k]),
            position=states["position"][keep, k],
            velocity=states["velocity"][keep, k],
            acceleration=acceleration[keep, k],
            command=states["command"][keep, k],
            servo=states["servo"][keep, k],
            servo_measured=_servo_as_measured({name: s[:, k] for name, s in states.items()}, clock.period)[keep],
            frequency=frequency,
            gain=gains[k],
        )
        for k, joint in enumerate(joints)
    ]


def _pulsed(
    episode: Comparison,
    values: FloatArray,
    train: Term,
    rest: Sequence[float],
    sizes: FloatArray,
    members: Sequence[Sequence[int]],
) -> Outputs:
    """Sensors without a pulse, and with pulses of given sizes at one joint of every subtree at a time.

    `rest` are the numbers of a joint's train of pulses, the size first; `members` the joints of each subtree.
    """
    count = 1 + max(len(own) for own in members)
    pulses = np.tile(np.asarray(rest), (count, len(sizes), 1))
    for own in members:
        for row, k in enumerate(own, start=1):
            pulses[row, k, 0] = sizes[k]
    candidates = np.hstack([np.tile(values, (count, 1)), pulses.reshape(count, -1)])
    return replace(episode.replay, terms=(*episode.replay.terms, train), effort=True).predict(candidates)


def _servo_as_measured(states: dict[str, FloatArray], period: float) -> FloatArray:
    """Torque of the servo in the state that was measured, by the law that it follows in the replay."""
    law = np.column_stack([np.ones(len(states["servo"])), states["command"], states["predicted"], states["velocity"]])
    weights = np.linalg.lstsq(law, states["servo"], rcond=1e-10)[0]
    error = states["position"] - states["predicted"]
    smooth = np.convolve(np.pad(error, 2, mode="edge"), np.full(5, 0.2), mode="valid")
    return np.asarray(states["servo"] + weights[2] * error + weights[3] * np.gradient(smooth, period))


def _commands(episode: Comparison, columns: Sequence[int] | np.ndarray) -> FloatArray:
    grid = episode.replay.grid
    steps = np.minimum(grid.state[grid.before], grid.steps - 1)
    return np.asarray(grid.command[steps][:, columns])


def _impulse(moved: FloatArray, memory: int) -> FloatArray:
    """Median response (memory, k) to pulses that come every `memory` samples, the first after `memory`."""
    onsets = np.arange(memory, len(moved) - memory + 1, memory)
    parts = np.stack([moved[o : o + memory] - moved[o - 1] for o in onsets])
    response = np.median(parts, axis=0) if len(parts) > 2 else parts.mean(axis=0)
    # dry friction may hold what a pulse has moved; a finite memory keeps the inversion stable
    fade = memory // 3
    response[memory - fade :] *= 0.5 * (1 + np.cos(np.linspace(0, np.pi, fade)))[:, None]
    return np.asarray(response)


@dataclass(frozen=True, eq=False)
class _Inverse:
    """Torque (n, k), its noise (k,), and at which frequency (cycles a sample) which fraction (f, k) is seen."""

    torque: FloatArray
    noise: FloatArray
    frequency: FloatArray
    gain: FloatArray


def _wiener(error: FloatArray, response: FloatArray, floor: FloatArray) -> _Inverse:
    """Most probable torques under white priors, whose sizes are those that explain the errors best (EM).

    Parameters
    ----------
    error : (n, k) measured minus predicted positions.
    response : (memory, k, k) of position i to one sample of unit torque j.
    floor : (k,) noise of a sample.
    """
    from scipy.fft import next_fast_len

    n, memory = len(error), len(response)
    size = next_fast_len(n + 2 * memory, real=True)
    # an error that ends abruptly would look like a blow
    tail = error[-1] * (0.5 * (1 + np.cos(np.linspace(0, np.pi, memory))))[:, None]
    padded = np.vstack([error, tail])
    sigma = np.hypot(floor, LINEAR * np.sqrt(np.mean(error**2, axis=0)))
    r = np.fft.rfft(padded / sigma, size, axis=0)
    h = np.fft.rfft(response / sigma[:, None], size, axis=0)
    hermitian = np.conj(np.swapaxes(h, 1, 2))
    gram = hermitian @ h
    inner = (hermitian @ r[:, :, None])[:, :, 0]
    own = np.einsum("fii->fi", gram).real
    prior = np.maximum(np.mean((padded / sigma) ** 2, axis=0) / np.mean(own, axis=0), 1e-300)
    for _ in range(ITERATIONS):
        posterior = np.linalg.inv(gram + np.eye(len(floor)) / prior)
        spectrum = (posterior @ inner[:, :, None])[:, :, 0]
        spread = np.einsum("fii->fi", posterior).real
        prior = np.mean(np.abs(spectrum) ** 2 / size + spread, axis=0)
    torque = np.fft.irfft(spectrum, size, axis=0)[:n]
    seen = posterior @ gram
    filters = np.abs(posterior @ hermitian) ** 2
    noise = np.sqrt(np.mean(filters @ (floor / sigma) ** 2, axis=0))
    gain = np.clip(np.einsum("fii->fi", seen).real, 0.0, 1.0)
    return _Inverse(torque, noise, np.asarray(np.fft.rfftfreq(size), dtype=np.float64), gain)
