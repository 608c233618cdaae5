"""Where no law of the library fits: of which variable the missing torque is a smooth function, and which one.

The torque that a model lacks is regressed on the curves of every free form (`sysid_btr.terms.free_form`) at its joint,
which costs no replay but for errors of an encoder over segments; stretches of time that a curve did not see say how
much of the torque it predicts. What is returned can be tried and refitted like any other hypothesis.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from sysid_btr._typing import FloatArray
from sysid_btr.diagnosis.hypotheses import Hypothesis
from sysid_btr.diagnosis.signal_features import FOLDS, line_shares, memory
from sysid_btr.identify.intervals import NORMAL
from sysid_btr.identify.missing_torque import MissingTorque
from sysid_btr.objectives.problem import ReplayProblem
from sysid_btr.simulation.segments import SegmentReplay
from sysid_btr.simulation.silence import silenced
from sysid_btr.terms.drives import DriveKind
from sysid_btr.terms.effect import Effect
from sysid_btr.terms.free_form import (
    FREE_FORMS,
    FreeCurve,
    FreeFriction,
    FreeFrictionLoad,
    FreeFrictionPosition,
    FreeFrictionSpeed,
    FreeGainTime,
    FreeReading,
    FreeReadingPosition,
    FreeReadingTime,
    FreeTorqueCommand,
    FreeTorqueLoad,
    FreeTorquePeriodic,
    FreeTorquePosition,
    FreeTorqueTime,
    FreeTorqueVelocity,
)
from sysid_btr.terms.model import Model
from sysid_btr.terms.scales import JointScale, Scales, scale_at

LOUD = 1.3
"""Chi2 of a joint's position from which its torque is looked at, as for the signature."""
WEAK = 0.2
"""Share of the missing torque that a curve must predict, likewise."""
MOSTLY = 0.5
"""Share from which what is missing is a function of time."""
NEARLY = 0.07
"""A form that comes earlier stands before the best one if its share is within this of that one's, likewise."""
STRETCH, SHORT_STRETCH = 2.5, 0.5
"""Seconds that are predicted from the others, for a function of a state, and of time, likewise."""
CYCLES = 3.0
"""Periods that a log must hold for a torque to be periodic."""
LINES = 3
"""Frequencies that are tried."""
FINER = 4
"""Frequencies within one bin of the spectrum."""
OWN_RHYTHM = 0.6
"""Share of the velocity that one frequency explains, from which it is the motion's own."""
MOST = 4096
"""Samples of a regression."""
ROUNDS = 8
"""Of the estimate of how large a curve and its noise are."""

VARIABLES: Mapping[type[FreeCurve], Callable[[MissingTorque], FloatArray]] = {
    FreeFrictionSpeed: lambda m: m.velocity,
    FreeFrictionLoad: lambda m: m.servo_measured,
    FreeFrictionPosition: lambda m: m.position,
    FreeTorquePosition: lambda m: m.position,
    FreeReadingPosition: lambda m: m.position,
    FreeTorqueVelocity: lambda m: m.velocity,
    FreeTorqueLoad: lambda m: m.servo,
    FreeTorqueCommand: lambda m: m.command,
    FreeTorqueTime: lambda m: m.time,
    FreeReadingTime: lambda m: m.time,
    FreeTorquePeriodic: lambda m: m.time,
    FreeGainTime: lambda m: m.time,
}
"""What each form is a function of, as estimated beside the missing torque. Friction follows what the drive really
gave; a torque must not, because a drive answers every disturbance."""
PER_UNIT: Mapping[type[FreeCurve], Callable[[MissingTorque], FloatArray]] = {
    FreeFriction: lambda m: -m.direction,
    FreeGainTime: lambda m: m.servo_measured,
}
"""Torque for a curve of 1, of those that are no torques themselves."""
OF_TIME = (FreeTorqueTime, FreeReadingTime, FreeTorquePeriodic, FreeGainTime)


@dataclass(frozen=True, eq=False)
class FreeForm:
    """A curve that predicts the missing torque of a joint.

    Attributes
    ----------
    hypothesis : the term at its joint, and where its refit begins.
    share : fraction of the missing torque that it predicts on stretches of time that it was not fitted to.
    x : (n,) values of its variable (of one that is periodic: phases).
    torque, low, high : (n,) Nm or N, of an encoder rad or m, with the 95 % interval at each; of friction its level.
    sentence : the finding in words.
    """

    hypothesis: Hypothesis
    share: float
    x: FloatArray
    torque: FloatArray
    low: FloatArray
    high: FloatArray
    sentence: str


def free_forms(
    problem: ReplayProblem, values: FloatArray, scales: Scales, missing: Sequence[MissingTorque]
) -> tuple[FreeForm, ...]:
    """Curves that predict what is missing, by what they explain: first those of each joint that replays are to decide
    between, the plainest that is nearly the best and the best one, then the others.

    Parameters
    ----------
    problem, values : data and terms, and the (p,) numbers that left the torque; what terms have is not asked for again.
    scales : sizes at the joints.
    missing : the torques that they lack, as `missing_torques` estimates them.
    """
    first: list[list[FreeForm]] = []
    others: list[FreeForm] = []
    for found in _by_joint(problem, values, scales, missing):
        first.append(_leading(found))
        others += [f for f in found if f not in first[-1]]
    first.sort(key=lambda own: -own[0].hypothesis.gain)
    return (*(f for own in first for f in own), *sorted(others, key=lambda f: -f.hypothesis.gain))


def follows_time(problem: ReplayProblem, values: FloatArray, scales: Scales, missing: Sequence[MissingTorque]) -> bool:
    """Whether what is missing at a joint is mostly a function of time, and none of anything else predicts it better.

    Parameters
    ----------
    problem, values, scales, missing : as for `free_forms`.
    """
    found = (f for own in _by_joint(problem, values, scales, missing) for f in _leading(own))
    return any(of_time_alone(f.hypothesis.effect) and f.share >= MOSTLY for f in found)


def of_time_alone(effect: type[Effect]) -> bool:
    """Whether a form is a function of time that does not come back, and so is told only between data."""
    return issubclass(effect, OF_TIME) and not effect.periodic


def _by_joint(
    problem: ReplayProblem, values: FloatArray, scales: Scales, missing: Sequence[MissingTorque]
) -> Iterator[list[FreeForm]]:
    """Curves that predict what is missing at each joint where they do, the plainest first."""
    loud = [m for m in missing if m.chi2 >= LOUD]
    known = {(type(term), place) for term in problem.terms for place in term.places}
    drives = {j: d for e in problem.episodes for j, d in zip(e.replay.index.joints, e.replay.index.drive, strict=True)}
    for joint in dict.fromkeys(m.joint for m in loud):
        own = [m for m in loud if m.joint == joint]
        found = [
            form
            for effect in FREE_FORMS
            if (effect, joint) not in known and _can_be_at(effect, drives.get(joint))
            for form in _forms(
                effect, [_evidence(effect, m, problem, values, scales) for m in own], scale_at(scales, joint)
            )
            if form.share >= WEAK
        ]
        if found:
            yield found


def _leading(found: Sequence[FreeForm]) -> list[FreeForm]:
    """Of the curves at a joint the plainest that is nearly the best, and the best one."""
    best = max(found, key=lambda f: f.share)
    plainest = next(f for f in found if f.share >= best.share - NEARLY)
    return [plainest] if plainest is best else [plainest, best]


def _can_be_at(effect: type[FreeCurve], drive: DriveKind | None) -> bool:
    """Whether a joint with such a drive, or none, has the variable of a form."""
    return {"servo": drive == "position", "drive": drive is not None}.get(effect.scope, True)


@dataclass(frozen=True, eq=False)
class _Evidence:
    """What a form is to explain of one estimate.

    Attributes
    ----------
    one : the estimate.
    values, noise : (n,) torques, or errors of position, and their noise.
    columns : what the form's modes do to them, (n, modes), at a frequency where it has one.
    """

    one: MissingTorque
    values: FloatArray
    noise: float
    columns: Callable[..., FloatArray]


def _evidence(
    effect: type[FreeCurve], one: MissingTorque, problem: ReplayProblem, values: FloatArray, scales: Scales
) -> _Evidence:
    ends = effect.range_of(scale_at(scales, one.joint))
    if not issubclass(effect, FreeReading):
        return _Evidence(one, one.torque, one.noise, lambda *more: one.seen(design(effect, one, ends, *more)))
    episode = problem.episodes[one.episode]
    targets = (t for t in episode.targets if one.joint in t.joints)
    noise = next((float(t.noise[t.joints.index(one.joint)]) for t in targets if t.channel == "position"), 0.0)
    # a segment starts from what the sensor shows, and goes where that leads
    started = isinstance(episode.replay, SegmentReplay)

    def columns() -> FloatArray:
        return _replayed_modes(effect, one, problem, values, scales) if started else design(effect, one, ends)

    return _Evidence(one, one.residual * noise, noise, columns)


def _replayed_modes(
    effect: type[FreeCurve], one: MissingTorque, problem: ReplayProblem, values: FloatArray, scales: Scales
) -> FloatArray:
    """(n, modes) change of the position that a joint's sensor shows with each mode, by replays."""
    term = effect.at((one.joint,), scales)
    model = Model(problem.terms, values).with_(term, term.neutral)
    size = np.array([kind.scale for kind in term.numbers])
    changed = np.vstack([np.zeros(len(size)), np.diag(size)])
    candidates = np.hstack([np.tile(values, (len(changed), 1)), changed])
    replay = problem.with_model(model).episodes[one.episode].replay
    with silenced():
        outputs = replay.predict(candidates)
    position = outputs.position[:, :, replay.index.joints.index(one.joint)]
    change = np.nan_to_num(position[1:] - position[0]) / size[:, None]
    return np.column_stack([np.interp(one.time, outputs.time, row) for row in change])


def _forms(effect: type[FreeCurve], own: Sequence[_Evidence], scale: JointScale) -> Iterator[FreeForm]:
    """The form at a joint, if it can be one; of one that is periodic the best frequency."""
    if effect not in OF_TIME:
        yield _form(effect, own, scale, ())
    elif len(own) > 1:
        return  # the clocks of several logs have nothing to do with each other
    elif not effect.periodic:
        yield _form(effect, own, scale, ())
    else:
        lines = [_form(effect, own, scale, (f,)) for f in frequencies(own[0].one)]
        yield from sorted(lines, key=lambda f: -f.share)[:1]


def _form(effect: type[FreeCurve], own: Sequence[_Evidence], scale: JointScale, more: tuple[float, ...]) -> FreeForm:
    joint, ends = own[0].one.joint, effect.range_of(scale)
    kinds = effect.sized(scale)
    count = len(kinds) - len(more)
    relative = np.array([k.upper for k in kinds[:count]]) / kinds[0].upper
    seen, torque = [], []
    for each in own:
        rows = slice(None, None, -(-len(each.values) // MOST))
        seen.append(each.columns(*more)[rows])
        torque.append(each.values[rows])
    block = SHORT_STRETCH if effect in OF_TIME else STRETCH
    curve = _penalised(np.concatenate(torque), np.concatenate(seen), relative)
    shares, weights = [], []
    for each, columns, values in zip(own, seen, torque, strict=True):
        one, power = each.one, float(np.mean(values**2))
        real = max(power - each.noise**2, 0.05 * power, 1e-300)
        samples = block / one.period * len(values) / len(one.torque)
        predicted = _predicted_share(values, columns, curve, max(round(samples), 1))
        shares.append(float(np.clip(predicted * power / real, 0.0, 1.0)))
        weights.append((one.chi2 - 1.0) * len(one.residual))
    share = float(np.average(shares, weights=weights))
    start = np.clip([*curve.amounts, *more], np.array([k.lower for k in kinds]), np.array([k.upper for k in kinds]))
    x = np.linspace(0.0, 1.0, 101) if more else np.linspace(*ends, 101)
    modes = effect.modes_at(x, *ends)
    line = modes @ curve.amounts
    if issubclass(effect, FreeFriction) and line.mean() <= 0:
        share = 0.0  # no friction pushes
    half = NORMAL * np.sqrt(np.einsum("nk,kl,nl->n", modes, curve.covariance, modes))
    hypothesis = Hypothesis(effect, (joint,), False, start, share * float(sum(weights)))
    term = effect.at((joint,), {joint: scale})
    noun, _, rest = term.described.partition(" that ")
    sentence = f"{effect.article}{noun} at {joint} that {rest}: {term.in_words(joint, start)}"
    return FreeForm(hypothesis, share, x, line, line - half, line + half, sentence)


def design(
    effect: type[FreeCurve], one: MissingTorque, ends: tuple[float, float], frequency: float = 1.0
) -> FloatArray:
    """(n, modes) torques of a form's modes along an estimate, each of rms 1 over its range."""
    modes = effect.modes_at(VARIABLES[effect](one) * frequency, *ends)
    acts = next((torque for base, torque in PER_UNIT.items() if issubclass(effect, base)), None)
    return modes if acts is None else np.asarray(acts(one)[:, None] * modes)


@dataclass(frozen=True, eq=False)
class _Curve:
    """Amounts (k,) of modes, their covariance (k, k), and what gave it: the prior's precision (k, k), noise squared."""

    amounts: FloatArray
    covariance: FloatArray
    prior: FloatArray
    noise: float


def _penalised(torque: FloatArray, seen: FloatArray, relative: FloatArray) -> _Curve:
    """Most probable amounts under the prior of the modes, whose size is the most likely one (EM).

    The residual is correlated: its independent samples are fewer by its memory.
    """
    gram, inner = seen.T @ seen, seen.T @ torque
    noise = max(float(np.mean(torque**2)), 1e-300)
    size = noise / max(float(np.mean(seen**2)), 1e-300)
    for _ in range(ROUNDS):
        prior, used = np.diag(1.0 / (relative**2 * max(size, 1e-300))), noise
        covariance = np.linalg.inv(gram / used + prior)
        amounts = covariance @ inner / used
        rest = torque - seen @ amounts
        noise = max(float(np.mean(rest**2)) * memory(rest), 1e-300)
        size = float(np.mean((amounts**2 + np.diag(covariance)) / relative**2))
    return _Curve(np.asarray(amounts), np.asarray(covariance), prior, used)


def _predicted_share(torque: FloatArray, seen: FloatArray, curve: _Curve, block: int) -> float:
    """Share of a torque that a curve predicts on stretches of `block` samples that it was not fitted to."""
    fold = (np.arange(len(torque)) // block * 2) % FOLDS
    left = 0.0
    for k in range(FOLDS):
        test = fold == k
        own, rest = seen[~test], torque[~test]
        amounts = np.linalg.solve(own.T @ own / curve.noise + curve.prior, own.T @ rest / curve.noise)
        left += float(np.sum((torque[test] - seen[test] @ amounts) ** 2))
    return 1.0 - left / max(float(np.sum(torque**2)), 1e-300)


def frequencies(one: MissingTorque) -> tuple[float, ...]:
    """Frequencies (Hz) of the strongest lines of the missing torque that are not the motion's own."""
    from scipy.optimize import minimize_scalar

    n = len(one.torque)
    duration = n * one.period
    if duration <= 0:
        return ()
    window = np.hanning(n)
    spectrum = np.abs(np.fft.rfft((one.torque - one.torque.mean()) * window, FINER * n)) ** 2
    at = np.fft.rfftfreq(FINER * n, one.period)
    inner = np.arange(1, len(at) - 1)
    peak = inner[(spectrum[inner] > spectrum[inner - 1]) & (spectrum[inner] >= spectrum[inner + 1])]
    peak = peak[at[peak] * duration >= CYCLES]
    found = []
    for k in peak[np.argsort(-spectrum[peak])][:LINES]:
        near = (float(at[k]) - 0.5 / duration, float(at[k]) + 0.5 / duration)
        fine = minimize_scalar(lambda f: -_line(one.torque, one.time, f), bounds=near, method="bounded")
        if _line(one.velocity, one.time, float(fine.x)) < OWN_RHYTHM:
            found.append(float(fine.x))
    return tuple(found)


def _line(signal: FloatArray, time: FloatArray, frequency: float) -> float:
    """Share of a signal's variance that a wave explains."""
    angle = 2 * np.pi * frequency * time
    wave = np.column_stack([np.sin(angle), np.cos(angle)])
    return float(line_shares(signal, [wave], np.zeros((len(time), 0)))[0])
