"""What a model leaves, in words: where and when, and on what it depends.

It looks at the torque that would explain the position error (`sysid_btr.identify.missing_torque`), because a torque
is local in time where a position error is smeared out by the servo.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from sysid_btr._typing import FloatArray
from sysid_btr.diagnosis import signal_features
from sysid_btr.diagnosis.patterns import (
    LOUD,
    SHORTEST_PERIOD,
    TRAIN_SHARE,
    blame,
    is_own_rhythm,
    of_motion,
    scaled,
    spatial_lines,
    upright,
)
from sysid_btr.diagnosis.signal_features import hats, predicted_share, without
from sysid_btr.identify.missing_torque import MissingTorque, missing_torques
from sysid_btr.identify.study import Study
from sysid_btr.terms.model import Model

OUTLIER = 3.0
"""Times the usual size from which a torque of either sign counts as an event."""
STRETCH, SHORT_STRETCH = 2.5, 0.5
"""Seconds that are predicted from the others when a dependence on a state, and on time, is weighed."""
MOSTLY = 0.5
"""Share of the excess in one second from which the residual is an event, which a state hardly predicts."""
NEARLY = 0.07
"""A simpler dependence is preferred if its share is within this of the best one's."""
WEAK = 0.2
"""Share of the missing torque below which a dependence is none."""
DESCRIBED = 3
"""Joints that are described."""


def signature(study: Study, model: Model) -> dict[str, Any]:
    """Describe what a model leaves of the training data, as missing torque at the joints.

    Parameters
    ----------
    study : robot and logs.
    model : what is left is what this does not explain.

    Returns
    -------
    dict
        JSON-able: ``summary`` in words; ``joints``, the worst first, each with ``chi2``, ``share`` of the
        excess over the noise floor, rms of the missing torque, where it is ``localised`` in time,
        ``periodic`` or None, and ``dependence``: the share of the missing torque that is predicted from a
        state of the robot on stretches of time left out (a correlation ratio free of the bias of its bins).
    """
    torques = missing_torques(study.train_problem(model), model.values, study.scales)
    if not torques:
        return {"summary": f"not characterised: {study.procedure.no_torque}", "joints": []}
    loud = sorted((t for t in torques if t.chi2 >= LOUD), key=lambda t: -blame(t))
    if not loud:
        return {"summary": "no torque at any joint: positions are at their noise floor", "joints": []}
    # one episode a joint: the one that shows most
    chosen = list({t.joint: t for t in reversed(loud)}.values())[::-1]
    total = sum(blame(t) for t in chosen)
    entries: list[dict[str, Any]] = []
    for one in chosen[:DESCRIBED]:
        share = blame(one) / max(total, 1e-300)
        if entries and share < 0.05:
            break
        entries.append({"joint": one.joint, "share": share, **_describe(one, torques)})
    return {"summary": "; ".join(e.pop("words") for e in entries), "joints": entries}


@dataclass(frozen=True, eq=False)
class _Feature:
    """Something a missing torque may depend on: a name, words, functions of it (n, k), whether it is time."""

    name: str
    words: str
    design: FloatArray
    of_time: bool = False


def _describe(one: MissingTorque, torques: Sequence[MissingTorque]) -> dict[str, Any]:
    rms = float(np.std(one.torque))
    real = max(rms**2 - one.noise**2, 0.05 * rms**2)
    periodic = _periodic(one)
    together = -(-len(one.torque) // 4096)
    rows = slice(None, None, together)
    features = list(_features(one, torques, periodic))
    shares = []
    for feature in features:
        seen = one.seen(feature.design)[rows]
        block = (SHORT_STRETCH if feature.of_time else STRETCH) / (one.period * together)
        share = predicted_share(one.torque[rows], seen, max(round(block), 1))
        shares.append(float(np.clip(share * rms**2 / real, 0.0, 1.0)))
    best = max(shares)
    chosen = next(i for i, s in enumerate(shares) if s >= best - NEARLY)
    localised = _localised(one)
    known = best >= (MOSTLY if localised["share"] > MOSTLY else WEAK)
    drift = _gain_rhythm(one) if known and features[chosen].name == "torque_and_time" else None
    words = _words(one, rms, localised, periodic, features[chosen] if known else None, drift)
    return {
        "chi2": one.chi2,
        "torque_rms": rms,
        "torque_noise": one.noise,
        "unit": one.unit,
        "localised": localised,
        "periodic": periodic,
        "gain_period": drift,
        "dependence": [
            {"on": f.name, "share": s} for s, f in sorted(zip(shares, features, strict=True), key=lambda x: -x[0])
        ],
        "best": features[chosen].name if known else "none",
        "words": words,
    }


def _localised(one: MissingTorque) -> dict[str, float]:
    """The second that holds most of the excess, and its share of it."""
    excess = one.residual**2 - 1
    width = min(max(round(1.0 / one.period), 1), len(excess))
    sums = np.concatenate([[0.0], np.cumsum(excess)])
    window = sums[width:] - sums[:-width]
    at = int(np.argmax(window))
    return {"share": float(np.clip(window[at] / max(sums[-1], 1e-300), 0, 1)), "start": float(one.time[at])}


def _periodic(one: MissingTorque) -> dict[str, Any] | None:
    """How the missing torque repeats in time: itself, or only its size."""
    rest = without(one.torque, of_motion(one))
    # whether there is a torque rather than how large it is: a pulse depends on the load of its moment
    size = (np.abs(rest) > OUTLIER * 1.4826 * float(np.median(np.abs(rest)))).astype(float)
    options = []
    for signal, same_sign in ((rest, True), (size, False)):
        period, share = signal_features.best_period(signal, one.time, SHORTEST_PERIOD)
        if share > 0 and not is_own_rhythm(one, period):
            options.append((share, same_sign, period, signal))
    if not options:
        return None
    # pulses of either sign may happen to alternate: then the shorter period is the true one
    share, same_sign, period, signal = options[0]
    if len(options) > 1 and (options[1][0] > share or options[1][2] < 0.6 * period):
        share, same_sign, period, signal = options[1]
    if share < TRAIN_SHARE:
        return None
    train = signal_features.best_train(signal, one.time, period)
    train = upright(one, train) if same_sign else train
    on = np.mod(one.time - train.start, train.period) < train.duration
    inside = rest[on] if on.any() else rest
    return {
        "period": train.period,
        "start": train.start,
        "duration": train.duration,
        "amplitude": train.height if same_sign else float(np.sqrt(np.mean(inside**2))),
        "same_sign": same_sign,
        "share": share,
    }


def _features(
    one: MissingTorque, torques: Sequence[MissingTorque], periodic: dict[str, Any] | None
) -> Iterator[_Feature]:
    """What is tried, from simple to complicated."""
    sign, load, q = one.direction, one.servo, one.position

    def of(x: FloatArray, count: int) -> FloatArray:
        return hats(x, signal_features.even_knots(x, count))

    yield _Feature("direction", "the sign of the velocity", sign[:, None])
    yield _Feature("load", "the load and the sign of the velocity", np.column_stack([sign, np.abs(load) * sign]))
    yield _Feature("torque", "the servo's torque", of(load, 8))
    yield _Feature("velocity", "the velocity", of(one.velocity, 10))
    yield _Feature("position", "the position", of(q, 10))
    yield _Feature("acceleration", "the acceleration", of(one.acceleration, 6))
    yield _Feature("command_rate", "the rate of the command", of(np.gradient(one.command, one.period), 7))
    patch = hats(q, np.linspace(q.min(), q.max(), 14))
    yield _Feature("position_and_direction", "the position and the direction of motion", sign[:, None] * patch)
    for other in torques:
        if other.episode == one.episode and other.joint != one.joint:
            own = np.column_stack([scaled(q), of(other.position, 5)])
            yield _Feature(f"position:{other.joint}", f"the position of {other.joint}", own)
    if periodic is not None:
        phase = np.mod((one.time - periodic["start"]) / periodic["period"] + 0.25, 1.0)
        count = int(np.clip(2 * periodic["period"] / max(periodic["duration"], one.period), 10, 40))
        beat = hats(phase, np.linspace(0, 1, count))
        again = f"the phase of a period of {periodic['period']:.3g} s"
        yield _Feature("phase", again, beat, True)
        yield _Feature("torque_and_phase", f"the servo's torque and {again}", beat * one.servo_measured[:, None], True)
    knots = np.linspace(one.time[0], one.time[-1], int(np.clip((one.time[-1] - one.time[0]) / 1.5, 3, 25)))
    slow = hats(one.time, knots)
    yield _Feature("time", "time alone, a slow drift", slow, True)
    yield _Feature("torque_and_time", "the servo's torque, with a gain that drifts", slow * load[:, None], True)
    # the frequency is chosen on all data: it has to beat time as well
    for line in spatial_lines(one)[:1]:
        pair = np.column_stack([np.sin(line.number * q), np.cos(line.number * q)])
        length = f"{2 * np.pi / line.number:.3g} {'m' if one.unit == 'N' else 'rad'}"
        yield _Feature("fine_position", f"the position, repeating every {length}", pair)


def _gain_rhythm(one: MissingTorque) -> float | None:
    """Period of a gain that comes and goes, s; None where it only drifts."""
    duration = float(one.time[-1] - one.time[0])
    periods = 1 / np.linspace(1 / duration, 1.0, 80)
    load = one.servo
    pairs = []
    for period in periods:
        angle = 2 * np.pi * one.time / period
        pairs.append(one.seen(np.column_stack([load * np.sin(angle), load * np.cos(angle)])))
    shares = signal_features.line_shares(one.torque, pairs, one.seen(load[:, None]))
    best = int(np.argmax(shares))
    return float(periods[best]) if shares[best] > 0.5 else None


def _words(
    one: MissingTorque,
    rms: float,
    localised: dict[str, float],
    periodic: dict[str, Any] | None,
    feature: _Feature | None,
    drift: float | None,
) -> str:
    text = f"a torque at {one.joint} of {rms:.2g} {one.unit} rms"
    if one.unit == "N":
        text = text.replace("torque", "force")
    beats = feature is not None and feature.name.endswith("phase")
    if localised["share"] > MOSTLY and not beats:
        text += f", {100 * localised['share']:.0f} % of its power in the second after t = {localised['start']:.3g} s"
    elif periodic is not None and (feature is None or beats):
        kind = "" if periodic["same_sign"] else " of both signs"
        text += (
            f", in pulses{kind} of {periodic['amplitude']:.2g} {one.unit} and {periodic['duration']:.2g} s"
            f" every {periodic['period']:.4g} s (one at {periodic['start']:.3g} s)"
        )
    if feature is None:
        return text + ", independent of the robot's state"
    text += f", a function of {feature.words}"
    return text if drift is None else text + f" with a period of {drift:.2g} s"
