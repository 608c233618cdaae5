"""Distances between a log and a replay that need not be sums of squares: MSE, phi1, phi2, Wasserstein.

phi1 and phi2 are those of Zagal, Delpiano, Ruiz-del-Solar, Self-modeling in humanoid soccer robots, Robotics
and Autonomous Systems 57 (2009), equations 4 to 6, doi:10.1016/j.robot.2009.03.010; the information distance
d(X, Y) = H(X|Y) + H(Y|X) is Crutchfield's (1990).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Literal, Protocol

import numpy as np

from sysid_btr._typing import BoolArray, FloatArray, IntArray
from sysid_btr.errors import UsageError
from sysid_btr.objectives.problem import ReplayProblem
from sysid_btr.objectives.targets import Target

DEFAULT_BINS = 20


class Distance(Protocol):
    """Distance of predictions to one measured channel."""

    def __call__(self, target: Target, predicted: FloatArray) -> FloatArray:
        """Distances (m,) of predictions (m, n, k) to a target; non-finite where a candidate failed."""
        ...


@dataclass(frozen=True)
class MeanSquare:
    """Mean squared error over all samples that count, SI units squared, not whitened."""

    def __call__(self, target: Target, predicted: FloatArray) -> FloatArray:
        error = np.ascontiguousarray((target.measured - predicted)[:, target.mask])
        return np.asarray(np.mean(error**2, axis=1))


@dataclass(frozen=True)
class Phi2:
    """Information distance summed over joints, bits; the motor term is zero for replayed commands.

    Attributes
    ----------
    bins : intervals of equal width over the measured range of each joint; never finer than the encoder's step.
    correction : ``miller-madow`` removes the first-order bias of plug-in entropies
        (doi:10.1162/089976603321780272), ``none`` leaves it.

    Notes
    -----
    Joints that stand still (measured range below two encoder steps) only add a constant and are left out. The
    distance is blind to any one-to-one relabelling of bins: an offset or a gain of a sensor may go unnoticed.
    """

    bins: int = DEFAULT_BINS
    correction: Literal["miller-madow", "none"] = "miller-madow"

    def __post_init__(self) -> None:
        if self.bins < 2:
            raise UsageError(f"phi2 needs at least 2 bins, not {self.bins}")

    def __call__(self, target: Target, predicted: FloatArray) -> FloatArray:
        total = np.zeros(len(predicted))
        for k, floor in enumerate(target.floor):
            good = target.mask[:, k]
            measured = target.measured[good, k]
            low, high = float(measured.min()), float(measured.max())
            if high - low <= 2 * max(floor.step, floor.sigma):
                continue
            count = self.bins
            if floor.step > 0:
                count = max(2, min(count, int((high - low) / floor.step)))
            x = _label(measured, low, high, count)
            for m, row in enumerate(predicted[:, good, k]):
                total[m] += (
                    information_distance(x, _label(row, low, high, count), self.correction)
                    if np.isfinite(row).all()
                    else np.inf
                )
        return total


@dataclass(frozen=True)
class Wasserstein:
    """1-Wasserstein distance between the distributions of measured and predicted values, one joint at a time.

    Summed over joints, SI units: ``integral |F(x) - G(x)| dx`` of the two empirical distribution functions, as
    `scipy.stats.wasserstein_distance` has it; for equally many samples the mean of ``|sort(a) - sort(b)|``.

    Notes
    -----
    It ignores time altogether: any reordering of the samples, and with it delay, phase and speed, goes
    unnoticed, and so does what joints do together. It sees where and how far a joint moves and how long it
    stays there: offsets, gains, limits, the share of time at rest. The sensor's noise widens the measured
    distribution; below the noise floor a difference means nothing.
    """

    def __call__(self, target: Target, predicted: FloatArray) -> FloatArray:
        total = np.zeros(len(predicted))
        for k in range(target.mask.shape[1]):
            good = target.mask[:, k]
            if not good.any():
                continue
            measured = np.sort(target.measured[good, k])
            # NaN sorts to the end and stays: a failed candidate is not near anything
            total += np.mean(np.abs(np.sort(_motion(predicted, good, k), axis=1) - measured), axis=1)
        return total


Fitness = Callable[[FloatArray], FloatArray]
"""Fitness (m,) of one joint's motion (m, samples) in m runs."""


def amplitude(motion: FloatArray) -> FloatArray:
    """Standard deviation over time, (m,), of motions (m, samples): how far a joint swings."""
    return np.asarray(np.std(motion, axis=1))


@dataclass(frozen=True)
class Phi1:
    """phi1 over the episodes of a log: each is the run of one controller, judged by the fitness of its motion.

    The sum over episodes and channels of ``|fitness(log) - fitness(replay)|``, fitness being the mean over
    joints; divided by the number of episodes it is `phi1`.

    Attributes
    ----------
    fitness : of one joint's motion. A log of joints knows no task, so the default is how far they swing; give
        your own for a task.

    Notes
    -----
    One number an episode: no more parameters are identifiable than there are episodes.
    """

    fitness: Fitness = amplitude

    def __call__(self, target: Target, predicted: FloatArray) -> FloatArray:
        real, simulated = 0.0, np.zeros(len(predicted))
        joints = target.mask.shape[1]
        for k in range(joints):
            good = target.mask[:, k]
            real += float(self.fitness(target.measured[None, good, k])[0]) / joints
            simulated += self.fitness(_motion(predicted, good, k)) / joints
        return phi1(np.array([real]), simulated[:, None])


def _motion(predicted: FloatArray, good: BoolArray, joint: int) -> FloatArray:
    """Motions (m, samples) of one joint, row by row in memory: sums over a row have the same bits beside any others."""
    return np.ascontiguousarray(predicted[:, good, joint])


def phi1(real: FloatArray, simulated: FloatArray) -> FloatArray:
    """Mean absolute difference of fitness over controllers (equation 4).

    Parameters
    ----------
    real : (controllers,) fitness on the robot.
    simulated : (m, controllers) fitness of the same controllers in m candidate simulations.

    Returns
    -------
    ndarray
        (m,) in the unit of the fitness.
    """
    return np.asarray(np.mean(np.abs(np.atleast_2d(simulated) - real), axis=1))


def information_distance(x: IntArray, y: IntArray, correction: Literal["miller-madow", "none"] = "none") -> float:
    """d(X, Y) = H(X|Y) + H(Y|X) = 2 H(X, Y) - H(X) - H(Y) of two series of labels, bits."""
    joint = x.astype(np.int64) * (int(y.max()) + 1) + y
    corrected = correction == "miller-madow"
    return max(0.0, 2 * _entropy(joint, corrected) - _entropy(x, corrected) - _entropy(y, corrected))


def _label(values: FloatArray, low: float, high: float, bins: int) -> IntArray:
    """Bins of equal width over a range; what lies outside goes to a bin of its own on either side."""
    inside = np.floor((values - low) / (high - low) * bins).astype(np.int64)
    inside[values == high] = bins - 1
    return np.clip(inside, -1, bins) + 1


def _entropy(labels: IntArray, corrected: bool) -> float:
    counts = np.unique(labels, return_counts=True)[1]
    p = counts / len(labels)
    plain = -float(np.sum(p * np.log2(p)))
    return plain + ((len(counts) - 1) / (2 * len(labels) * np.log(2)) if corrected else 0.0)


@dataclass(frozen=True, eq=False)
class DistanceProblem:
    """A replay problem scored by a distance instead of a likelihood; it has no residuals.

    Attributes
    ----------
    whole : replays and targets.
    distance : summed over the targets of all episodes.
    """

    whole: ReplayProblem
    distance: Distance

    @property
    def names(self) -> tuple[str, ...]:
        return self.whole.names

    @property
    def lower(self) -> FloatArray:
        return self.whole.lower

    @property
    def upper(self) -> FloatArray:
        return self.whole.upper

    @property
    def start(self) -> FloatArray:
        return self.whole.start

    def loss(self, candidates: FloatArray) -> FloatArray:
        """Distances (m,) of candidates (m, p)."""
        return self.whole.executor.run(DistanceProblem._loss, self, np.atleast_2d(candidates))

    def _loss(self, candidates: FloatArray) -> FloatArray:
        total = np.zeros(len(candidates))
        for episode in self.whole.episodes:
            for rows, outputs in episode.replay.chunks(candidates):
                for target in episode.targets:
                    total[rows] += self.distance(target, target.predicted(outputs))
        return total


def get_distance(name: str) -> Distance | None:
    """A distance by name: ``likelihood`` (None), ``mse``, ``phi1``, ``phi2``, ``phi2:BINS`` or ``wasserstein``.

    Raises
    ------
    UsageError
        Listing what there is.
    """
    base, _, bins = name.partition(":")
    if name == "likelihood":
        return None
    if name in _PLAIN:
        return _PLAIN[name]()
    if base == "phi2" and (not bins or bins.isdigit()):
        return Phi2(int(bins)) if bins else Phi2()
    raise UsageError(
        f"unknown distance {name!r}; available: likelihood, {', '.join(_PLAIN)}, phi2 and phi2:BINS (such as phi2:20)"
    )


_PLAIN: Mapping[str, Callable[[], Distance]] = {"mse": MeanSquare, "phi1": Phi1, "wasserstein": Wasserstein}
