"""What the model lacks, as far as it could be mistaken for the parameters: torques at the joints that nobody declared.

A model that leaves more than noise is wrong, and its parameters may have taken up a part of what it lacks; nothing of
that part is left in the residual. So the likelihood gets a discrepancy (Kennedy and O'Hagan 2001,
doi:10.1111/1467-9868.00294) that knows physics (Brynjarsdottir and O'Hagan 2014, doi:10.1088/0266-5611/30/11/114007):
at each joint a torque that is a smooth function of its state, of unknown amounts as large as the torque that is left.
The parameters are then known as well as this leaves them.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from sysid_btr._typing import FloatArray
from sysid_btr.identify.intervals import NORMAL, Estimate, correlations
from sysid_btr.identify.missing_torque import (
    MissingTorque,
    TorqueResponse,
    missing_torques,
    smooth_sign,
    torque_responses,
)
from sysid_btr.identify.prior import Stated
from sysid_btr.objectives.covariance import newton, spread
from sysid_btr.objectives.problem import Comparison, ReplayProblem
from sysid_btr.simulation.segments import SegmentReplay
from sysid_btr.terms.disturbance import KnownTorque
from sysid_btr.terms.scales import Scales

SHARE = 0.5
"""Rms of each unknown torque, of what is left over at its joint: about as much a fit has taken up. With it 116 of 120
intervals of a leg hold the truth, and estimates scatter by 0.95 standard errors; without a discrepancy 83 hold it (15
effects that nobody declared, four seeds)."""
MOST_JOINTS = 12
"""Joints that leave most, at which a discrepancy is assumed; each costs eight columns."""


@dataclass(frozen=True, eq=False)
class Discrepancy:
    """Unknown torques, each with a standard normal amount.

    Attributes
    ----------
    responses : (r, m) change of the whitened residual for each of unit amount.
    """

    responses: FloatArray

    def whiten(self, columns: FloatArray) -> FloatArray:
        """Rows (r, k) such that discrepancy and noise together are white: (1 + R R')^-1/2 times them."""
        left, size, _ = np.linalg.svd(self.responses, full_matrices=False)
        shrink = 1 - 1 / np.sqrt(1 + size**2)
        return np.asarray(columns - left @ (shrink[:, None] * (left.T @ columns)))


def discrepancy(problem: ReplayProblem, values: FloatArray, scales: Scales) -> Discrepancy | None:
    """The torques that could hide in a fit.

    Parameters
    ----------
    problem : data and terms, as fitted.
    values : (p,) the optimum.
    scales : sizes at the joints.

    Returns
    -------
    Discrepancy or None
        None where torques cannot be traced: on a free base, or where the replay diverges.
    """
    responses = torque_responses(problem, values, scales)
    left = missing_torques(problem, values, scales, responses)
    if not left:
        return None
    worst = sorted({one.joint for one in left}, key=lambda j: -max(o.chi2 for o in left if o.joint == j))
    joints = worst[:MOST_JOINTS]
    size = {j: _size([one for one in left if one.joint == j]) for j in joints}
    unit = {j: _units([one for one in left if one.joint == j]) for j in joints}
    parts = []
    amounts = {j: SHARE * size[j] / unit[j] for j in joints}
    for number, (episode, response) in enumerate(zip(problem.episodes, responses, strict=True)):
        own = {one.joint: one for one in left if one.episode == number}
        if not own:
            parts.append(np.zeros((_count(episode), len(joints) * FEATURES)))
        elif response is None and isinstance(episode.replay, SegmentReplay):
            parts.append(_simulated(episode, values, own, amounts))
        else:
            parts.append(_responses(episode, response, own, amounts))
    return Discrepancy(np.concatenate(parts))


def _count(episode: Comparison) -> int:
    return int(sum(t.mask.sum() for t in episode.targets))


def features(one: MissingTorque) -> FloatArray:
    """What a torque at a joint may follow, (n, FEATURES), SI."""
    return np.column_stack(
        [
            np.ones(len(one.torque)),
            one.position - one.position.mean(),
            one.velocity,
            one.direction,
            one.acceleration,
            one.servo,
            smooth_sign(one.servo),
            np.gradient(one.command, one.period),
        ]
    )


FEATURES = 8
"""Of them."""


def _size(ones: Sequence[MissingTorque]) -> float:
    """Rms torque of one joint in all episodes that is more than noise."""
    square = [max(float(np.mean(one.torque**2)) - one.noise**2, 0.0) for one in ones]
    return float(np.sqrt(np.mean(square)))


def _units(ones: Sequence[MissingTorque]) -> FloatArray:
    """Rms of each feature, (FEATURES,), over all episodes."""
    square = np.mean([np.mean(features(one) ** 2, axis=0) for one in ones], axis=0)
    return np.asarray(np.sqrt(np.maximum(square, 1e-300)))


def _responses(
    episode: Comparison, response: TorqueResponse | None, own: dict[str, MissingTorque], amounts: dict[str, FloatArray]
) -> FloatArray:
    """Change of an episode's whitened residual, (r, joints FEATURES), for torques of these amounts."""
    columns = []
    for joint, amount in amounts.items():
        changes = [np.zeros((*t.mask.shape, FEATURES)) for t in episode.targets]
        if joint in own:
            torque = features(own[joint]) * amount
            for target, change in zip(episode.targets, changes, strict=True):
                shown: Iterable[tuple[int, FloatArray]]
                if response is None:
                    shown = [(target.joints.index(joint), torque)] if joint in target.joints else []
                else:
                    at, moved = response.shows(target.channel, response.joints.index(joint), torque)
                    shown = [(k, moved[:, :, i]) for i, k in enumerate(at)]
                time = episode.replay.log.time[: len(target.mask)] - episode.replay.log.time[0]
                for k, signal in shown:
                    change[:, k] = _at(time, own[joint].time, signal) / target.sigma[k]
        columns.append(np.concatenate([c[t.mask] for c, t in zip(changes, episode.targets, strict=True)]))
    return np.concatenate(columns, axis=1)


def _simulated(
    episode: Comparison, values: FloatArray, own: dict[str, MissingTorque], amounts: dict[str, FloatArray]
) -> FloatArray:
    """The same by simulation, whose segments start anew where data want them: (r, joints FEATURES)."""
    time = next(iter(own.values())).time
    torque = np.zeros((len(amounts), len(time), FEATURES))
    for k, (joint, amount) in enumerate(amounts.items()):
        if joint in own:
            torque[k] = features(own[joint]) * amount
    known = KnownTorque(tuple(amounts), time=time, torque=torque)
    each = np.vstack([np.zeros(torque.shape[0] * FEATURES), np.eye(torque.shape[0] * FEATURES)])
    wide = replace(episode.replay, terms=(*episode.replay.terms, known))
    white = episode.whitened(wide.predict(np.hstack([np.tile(values, (len(each), 1)), each])))
    return np.asarray(np.nan_to_num((white[1:] - white[0]).T))


def _at(time: FloatArray, known: FloatArray, signal: FloatArray) -> FloatArray:
    """Signals (n, m) at other times, (t, m)."""
    return np.column_stack([np.interp(time, known, column) for column in signal.T])


def widened(
    found: Sequence[Estimate],
    problem: ReplayProblem,
    values: FloatArray,
    jacobian: FloatArray,
    residual: FloatArray,
    scales: Scales,
) -> tuple[Estimate, ...]:
    """Estimates whose intervals hold although the model lacks something, as far as that is torques at joints.

    Parameters
    ----------
    found : (p,) with intervals that hold if the model is right.
    problem, values : data and terms, and the optimum (p,).
    jacobian, residual : (r, p) and (r,) there, whitened.
    scales : sizes at the joints.

    Returns
    -------
    tuple of Estimate
        As they are where nothing can be said: on a free base.
    """
    doubt = discrepancy(problem, values, scales)
    if doubt is None:
        return tuple(found)
    parameters, blocks = problem.parameters, problem.blocks
    white = doubt.whiten(np.column_stack([jacobian, residual]))
    stated = Stated.of(parameters)
    slopes, off = np.diag(stated.weight), (values - stated.nominal) * stated.weight
    steep, rest = np.vstack([white[:, :-1], slopes]), np.concatenate([white[:, -1], off])
    # unknown torques may fit in the place of an effect of the model; beyond what was assumed of them that is no doubt
    beside = np.pad(doubt.responses, ((0, len(slopes)), (0, 0)))
    most = np.linalg.norm(newton(np.vstack([jacobian, slopes]), beside), axis=1)
    shift = np.clip(newton(steep, rest), -most, most)
    apart = blocks.max() + 1 + np.arange(len(parameters))
    cov, _ = spread(steep, rest + steep @ shift, np.concatenate([blocks, apart]))
    std, together = np.sqrt(np.diag(cov)), correlations(cov)
    result = []
    for i, (one, parameter) in enumerate(zip(found, parameters, strict=True)):
        own = max(one.std, float(np.hypot(shift[i], std[i])))
        half = NORMAL * own
        low, high = max(one.value - half, parameter.lower), min(one.value + half, parameter.upper)
        span = parameter.upper - parameter.lower
        result.append(
            replace(
                one,
                std=min(own, span),
                std_if_right=one.std,
                correlation=tuple(map(float, together[i])),
                ci95=(min(low, one.ci95[0]), max(high, one.ci95[1])),
                identifiable="weak" if one.identifiable == "yes" and own > parameter.scale else one.identifiable,
                reason=one.reason
                or ("what the model lacks could be mistaken for a change of it" if own > parameter.scale else ""),
            )
        )
    return tuple(result)
