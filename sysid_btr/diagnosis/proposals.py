"""Proposals for effects whose place in time or angle only the residual shows."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import numpy as np

from sysid_btr._typing import FloatArray
from sysid_btr.diagnosis.patterns import LOUD, blame, pulse_train, sampling, single_pulse, spatial_lines
from sysid_btr.diagnosis.ringing import blows
from sysid_btr.diagnosis.scan import Perturbation
from sysid_btr.identify.missing_torque import MissingTorque, missing_torques
from sysid_btr.identify.study import Study
from sysid_btr.objectives.problem import ReplayProblem
from sysid_btr.terms.disturbance import (
    DriveDisturbanceTrain,
    ExternalDisturbance,
    ExternalDisturbanceTrain,
    Push,
    RingingDisturbance,
    RingingDisturbanceTrain,
)
from sysid_btr.terms.effect import Effect, Probe
from sysid_btr.terms.scales import JointScale
from sysid_btr.terms.sensing import EncoderCyclicError
from sysid_btr.terms.servo import CommandDelaySampled
from sysid_btr.terms.transmission import Cogging

SMALL = 0.01
"""Excess, relative to the worst joint's, below which a joint has to wait."""
WORST = 3
"""Joints in whose torque intervals between commands and blows that ring are sought. Time."""
ONCE_AND_TWICE = (1.0, 2.0)
"""1/rad; an encoder off its centre errs once a turn, one that is bent twice, whatever part of a turn is seen."""

SAME_PERIOD = 0.01
"""Part of it by which the period of drives may differ that is taken for one: estimates of one differ less."""

Found = Iterator[tuple[type[Effect], Probe]]


def proposals(
    study: Study, problem: ReplayProblem, values: FloatArray, residual: FloatArray, library: Sequence[type[Effect]]
) -> list[Perturbation]:
    """Perturbations at effects whose place in time or angle only the residual shows.

    Parameters
    ----------
    study : robot and logs.
    problem, values : data, terms and their parameters.
    residual : (r,) whitened, there.
    library : effects that may be asked for.
    """
    wanted = [(finder, most) for effects, finder, most in FINDERS if set(effects) & set(library)]
    if not wanted or not np.any(problem.column_chi2(residual) >= LOUD):
        return []
    torques = missing_torques(problem, values, study.scales)
    worst = max((blame(t) for t in torques), default=0.0)
    loud = sorted((t for t in torques if t.chi2 >= LOUD and blame(t) >= SMALL * worst), key=blame, reverse=True)
    found = [
        Perturbation(effect, (one.joint,), probe)
        for finder, most in wanted
        for one in loud[:most]
        for effect, probe in finder(one, study.scales[one.joint])
        if effect in library and not _within_train(problem, values, one.joint, effect, probe)
    ]
    step = max((one.period for one in loud), default=0.0)
    return [*found, *by_one_clock(found, study.robot.names(CommandDelaySampled.scope), step)]


def by_one_clock(found: Sequence[Perturbation], drives: Sequence[str], step: float) -> list[Perturbation]:
    """Drives that seem to take their commands at equal intervals, and all drives, by one clock: one bus may serve them.

    Commands that are held over a `step`, s, are nearly the same at moments that are so far apart, and where a joint
    alone is looked at, another of these may look better.
    """
    own = [q for q in found if q.effect is CommandDelaySampled]
    if len(own) < 2:
        return []
    periods, starts = np.array([q.probe[0] for q in own]).T
    period = float(np.median(periods))
    alike = np.abs(periods / period - 1) < SAME_PERIOD
    agree = {q.place for q, same in zip(own, alike, strict=True) if same}
    groups = [tuple(drive for drive in drives if drive in agree)]
    if alike.all():
        groups.append(tuple(drives))
    later = step * np.arange(math.ceil(period / step))
    moments = np.mod(starts[alike, None] + later, period).ravel().tolist()
    several = [group for group in dict.fromkeys(groups) if len(group) > 1]
    return [Perturbation(CommandDelaySampled, group, ((period, at),)) for group in several for at in moments]


def _lines(one: MissingTorque, scale: JointScale) -> Found:
    yield from ((Cogging, Cogging.probe_at(scale, line.number)) for line in spatial_lines(one))


def _errors_of_reading(one: MissingTorque, scale: JointScale) -> Found:
    # the error of the position in the place of the torque that would explain it
    error = replace(one, torque=one.residual, noise=1.0, gain=np.ones_like(one.gain))
    numbers = (*ONCE_AND_TWICE, *(line.number for line in spatial_lines(error)))
    yield from ((EncoderCyclicError, EncoderCyclicError.probe_at(scale, number)) for number in numbers)


def _samplings(one: MissingTorque, scale: JointScale) -> Found:
    moments = sampling(one)
    if moments is not None:
        yield CommandDelaySampled, CommandDelaySampled.probe_at(scale, *moments)


def _pulses(one: MissingTorque, scale: JointScale) -> Found:
    pulse, train = single_pulse(one), pulse_train(one)
    if pulse is not None:
        yield ExternalDisturbance, ExternalDisturbance.probe_at(scale, *pulse)
    if train is not None:
        probe = ExternalDisturbanceTrain.probe_at(scale, *train)
        yield from ((ExternalDisturbanceTrain, probe), (DriveDisturbanceTrain, probe))


def _blows(one: MissingTorque, scale: JointScale) -> Found:
    once, again = blows(one)
    if once is not None:
        yield RingingDisturbance, RingingDisturbance.probe_at(scale, *once.when)
    if again is not None:
        yield RingingDisturbanceTrain, RingingDisturbanceTrain.probe_at(scale, *again.when)


FINDERS: tuple[tuple[tuple[type[Effect], ...], Callable[[MissingTorque, JointScale], Found], int | None], ...] = (
    ((Cogging,), _lines, None),
    ((EncoderCyclicError,), _errors_of_reading, None),
    ((CommandDelaySampled,), _samplings, WORST),
    ((ExternalDisturbance, ExternalDisturbanceTrain, DriveDisturbanceTrain), _pulses, None),
    ((RingingDisturbance, RingingDisturbanceTrain), _blows, WORST),
)
"""Which effects each finds, and at how many joints it looks, the worst first."""


def _within_train(problem: ReplayProblem, values: FloatArray, joint: str, effect: type[Effect], probe: Probe) -> bool:
    """Whether a push is at the time of one of those that the model already has at this joint: these differ, then."""
    if not issubclass(effect, Push) or not effect.transient:
        return False
    when = probe[0][1:]
    for term, own in problem.terms.split(values):
        if isinstance(term, Push) and not term.transient and joint in term.places:
            known = term.spread(own[None])[0, term.places.index(joint), 1:]
            # since the train's push that began last before this one ends
            lasts = effect.lasts(*when)
            if (when[0] + lasts - known[0]) % known[-1] < lasts + term.lasts(*known):
                return True
    return False
