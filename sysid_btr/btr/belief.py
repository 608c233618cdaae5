"""What is known of a model: a mean and how far from it the truth may lie, and models drawn from that."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from sysid_btr._typing import FloatArray, IntArray
from sysid_btr.floating_base.size import measure_size
from sysid_btr.models.robot import Robot, servo_drives
from sysid_btr.mujoco_conventions import free_joints
from sysid_btr.terms.base import Parameter, Term
from sysid_btr.terms.effect import GROUND, DofEffect, Effect
from sysid_btr.terms.friction import DampingFactor
from sysid_btr.terms.inertial import ArmatureFactor
from sysid_btr.terms.library import select_effects
from sysid_btr.terms.model import Terms

DRY, LOADED = "coulomb_friction", "com_offset"
UNMEASURED: Mapping[str, float] = {
    "foot_compliance": 0.5,
    "foot_friction": 0.2,
    "command_delay": 0.02,
    DRY: 0.01,
    LOADED: 0.01,
    ArmatureFactor.name: ArmatureFactor.kinds[0].spread,
    DampingFactor.name: DampingFactor.kinds[0].spread,
}
"""What no trial measures by itself, or nobody declares: effect -> standard deviation about its neutral value.

A ground is as soft as nobody knows; grass, carpet and tiles under rubber differ by tens of percent in friction; a bus
and a servo's own cycle take a few periods of 10 to 20 ms; and gears rub, so that servos stop half a degree off (rad:
times their stiffness, that is a torque). Cables, batteries and loads leave the centre of what carries most a centimetre
off, on a robot of the Nao's size (m): whether a gait falls depends on it, and a mass that is learnt says nothing of it.
Positions tell ratios of all that makes torque: rotor inertia and damping, taken as exact, would tell how large masses
and gains are to a few percent (the two effects have the sources).
"""
WIDTH = 2.0
"""Standard deviation of a parameter before anything is known, in changes that matter (`Parameter.scale`)."""

ACCEPTED = 3.0
"""Noise floors of a residual at which half of what a fit says is believed; up to there nothing is looked for
(`closing.EXPLAINED`)."""


@dataclass(frozen=True, eq=False)
class Belief:
    """A normal distribution of a model's parameters, cut off at their bounds.

    Attributes
    ----------
    parameters : what they are, (p,).
    mean, covariance : (p,), (p, p).

    Raises
    ------
    ValueError
        If the shapes do not belong together.
    """

    parameters: tuple[Parameter, ...]
    mean: FloatArray
    covariance: FloatArray

    def __post_init__(self) -> None:
        p = len(self.parameters)
        if self.mean.shape != (p,) or self.covariance.shape != (p, p):
            raise ValueError(f"{p} parameters have a mean {self.mean.shape} and a covariance {self.covariance.shape}")

    @classmethod
    def before(cls, terms: Sequence[Term], width: float = WIDTH) -> Belief:
        """What is believed before any trial: about the nominal values, independently.

        Parameters
        ----------
        terms : of the model.
        width : standard deviation, in the parameters' scales.
        """
        found = Terms(terms)
        return cls(found.parameters, found.nominal, np.diag((width * found.scale) ** 2))

    @classmethod
    def unmeasured(cls, robot: Robot, terms: Sequence[Term], ground: bool = True) -> tuple[tuple[Term, ...], Belief]:
        """What may differ beside the terms of a model, and how much: the ground, late commands, gears that rub.

        Parameters
        ----------
        robot : that has it.
        terms : of the model; what is among them is not there twice.
        ground : whether the ground is asked for, too.
        """
        there = {term.name for term in terms}
        written = {term.compiled for term in terms if isinstance(term, DofEffect)}
        found: list[Term] = []
        for effect in select_effects([name for name in UNMEASURED if name not in there] or ["all"]):
            places = _places(robot, effect, ground)
            known = effect.name in there or (issubclass(effect, DofEffect) and effect.compiled in written)
            if effect.name in UNMEASURED and not effect.variant and not known and places:
                found.append(effect(places=places, shared=len(places) > 1))
        sized = {DRY: _stiffness, LOADED: _length}
        std = [UNMEASURED[term.name] * sized.get(term.name, lambda _: 1.0)(robot) for term in found]
        variance = np.repeat(np.square(std), [len(term.parameters) for term in found])
        listed = Terms(found)
        return tuple(found), cls(listed.parameters, listed.nominal, np.diag(variance))

    def towards(self, found: FloatArray, noise: float) -> Belief:
        """The belief where a fit found other values that leave a residual of so many noise floors.

        What leaves more than noise is, for all that anybody knows, about something else than these parameters: it
        moves the mean the less the more it leaves, and does not narrow the belief.
        """
        share = ACCEPTED**2 / (ACCEPTED**2 + noise**2) if np.isfinite(noise) else 1.0
        return replace(self, mean=self.mean + share * (found - self.mean))

    @property
    def std(self) -> FloatArray:
        """(p,) standard deviations, without regard to the bounds."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))

    def of(self, rows: IntArray) -> Belief:
        """Of some of the parameters, by position (k,), whatever the others are."""
        return Belief(tuple(self.parameters[i] for i in rows), self.mean[rows], self.covariance[np.ix_(rows, rows)])

    def after(self, rows: IntArray, mean: FloatArray, covariance: FloatArray) -> Belief:
        """The belief once more is known of some of the parameters, (k,) and (k, k): of the others by what ties them."""
        gain = np.linalg.solve(self.covariance[np.ix_(rows, rows)], self.covariance[rows]).T
        moved = self.mean + gain @ (mean - self.mean[rows])
        spread = self.covariance + gain @ (covariance - self.covariance[np.ix_(rows, rows)]) @ gain.T
        # to the bit: rounding must not take a mean beyond its bound
        moved[rows], spread[np.ix_(rows, rows)] = mean, covariance
        return replace(self, mean=moved, covariance=0.5 * (spread + spread.T))

    def whitened(self, candidates: FloatArray) -> FloatArray:
        """(m, p) by how many standard deviations candidates (m, p) are off, in independent directions."""
        root = np.linalg.cholesky(self.covariance)
        return np.asarray(np.linalg.solve(root, (candidates - self.mean).T).T)

    def beside(self, other: Belief) -> Belief:
        """Both, independent of each other."""
        p, q = len(self.mean), len(other.mean)
        covariance = np.zeros((p + q, p + q))
        covariance[:p, :p], covariance[p:, p:] = self.covariance, other.covariance
        return Belief((*self.parameters, *other.parameters), np.concatenate([self.mean, other.mean]), covariance)

    def draws(self, rng: np.random.Generator, count: int) -> FloatArray:
        """Models (count, p) within the bounds, spread evenly (a Latin hypercube).

        One parameter after the other, each given those before it and cut off at its bounds (Geweke, Hajivassiliou,
        Keane; doi:10.1016/0304-4076(94)01716-6): exact where they are independent.
        """
        from scipy.linalg import cholesky
        from scipy.special import ndtr, ndtri

        p = len(self.mean)
        lower = np.array([q.lower for q in self.parameters])
        upper = np.array([q.upper for q in self.parameters])
        # a parameter that is known exactly has no spread; the factor needs a little
        root = cholesky(self.covariance + np.diag(1e-24 + 1e-12 * np.diag(self.covariance)), lower=True)
        cells = rng.permuted(np.tile(np.arange(count)[:, None], (1, p)), axis=0)
        even = (cells + rng.random((count, p))) / count
        normal = np.zeros((count, p))
        result = np.empty((count, p))
        for i in range(p):
            middle = self.mean[i] + normal[:, :i] @ root[i, :i]
            low, high = ndtr((lower[i] - middle) / root[i, i]), ndtr((upper[i] - middle) / root[i, i])
            # the mean may lie beyond a bound by many deviations
            normal[:, i] = ndtri(np.clip(low + even[:, i] * (high - low), 1e-16, 1 - 1e-16))
            result[:, i] = np.clip(middle + normal[:, i] * root[i, i], lower[i], upper[i])
        return result


def _places(robot: Robot, effect: type[Effect], ground: bool) -> tuple[str, ...]:
    """Where something may differ; nowhere on a robot whose base is fixed what only one that may fall has."""
    floats = len(free_joints(robot.model)) > 0
    if effect.needs == GROUND and not (ground and floats):
        return ()
    if issubclass(effect, DofEffect) and effect.factor:  # of what there is
        return tuple(j for j in robot.names(effect.scope) if effect.own_value(robot.model, j) > 0)
    if effect.name != LOADED:
        return robot.names(effect.scope)
    heaviest = int(np.argmax(robot.model.body_mass))
    return (robot.model.body(heaviest).name,) if floats else ()


def _length(robot: Robot) -> float:
    """Of a robot that may fall, over the Nao's."""
    return measure_size(robot.model).length(1.0)


def _stiffness(robot: Robot) -> float:
    """Of a servo at its joint, Nm/rad: the median of those that the robot has."""
    model = robot.model
    found = [
        float(model.actuator_gear[drive.actuator, 0] * model.actuator_gainprm[drive.actuator, 0]) * drive.scale
        for drive in servo_drives(model)
    ]
    return float(np.median(found)) if found else 1.0
