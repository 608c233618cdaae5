"""The two searches as problems of the estimators: controllers in a model (Step 1), models of trials (Step 3)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Protocol

import numpy as np

from sysid_btr._typing import BoolArray, FloatArray
from sysid_btr.btr.controllers import ControllerSpace
from sysid_btr.btr.own_code import blamed
from sysid_btr.btr.robot import Trial
from sysid_btr.btr.task import Task, judged
from sysid_btr.btr.world import World
from sysid_btr.estimators.base import Problem
from sysid_btr.io.log import Log
from sysid_btr.objectives.distance import Distance, get_distance, phi1
from sysid_btr.objectives.targets import Target, make_targets
from sysid_btr.terms.base import Parameter

FITNESS = "phi1"
"""The distance that compares fitness; all others compare sensors."""


@dataclass(frozen=True, eq=False)
class Stage:
    """What runs controllers: a space of them, a task, and the world of a model.

    Attributes
    ----------
    world : of the model; its modifiers' parameters are a candidate's numbers.
    task, space : what is done, and by which controllers.
    """

    world: World
    task: Task
    space: ControllerSpace

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        return self.world.parameters

    def commands(self, controllers: FloatArray) -> FloatArray:
        """Commands (m, n, j) of controllers (m, p) for all joints of the model."""
        with blamed(f"controllers {type(self.space).__name__}"):
            commands = self.space.commands(controllers, self.task.time)
        return self.world.spread(self.space.joints, commands)

    def fitness(self, controllers: FloatArray, models: FloatArray) -> FloatArray:
        """Fitness (k, m) of controllers (m, p) in models (k, q); NaN where the simulation diverged."""
        return self.outcomes(controllers, models)[0]

    def outcomes(self, controllers: FloatArray, models: FloatArray) -> tuple[FloatArray, BoolArray]:
        """Fitness and whether they fell, (k, m) each, of controllers (m, p) in models (k, q).

        All in as few batches as memory allows. What diverged has no fitness (NaN), and fell.
        """
        k, m = len(models), len(controllers)
        commands = self.commands(controllers)
        which, model = np.tile(np.arange(m), k), np.repeat(np.arange(k), m)
        fitness, fell = np.empty(k * m), np.empty(k * m, dtype=bool)
        for rows in _blocks(k * m):
            values = models[model[rows]]
            for part, outputs in self.world.run(commands[which[rows]], values):
                motion = self.world.motion(outputs, values[part], self.task.watched)
                fitness[rows][part], fallen = judged(self.task, motion)
                fell[rows][part] = fallen[:, -1]
        return fitness.reshape(k, m), fell.reshape(k, m) | np.isnan(fitness).reshape(k, m)


def _blocks(count: int, size: int = 256) -> list[slice]:
    """Slices of so many rows; bounds the commands that are held at once."""
    return [slice(first, min(first + size, count)) for first in range(0, count, size)]


class SearchProblem(Problem, Protocol):
    """A problem of Step 1 or 3."""

    @property
    def runs(self) -> float:
        """Whole trials that are simulated for one candidate."""
        ...


@dataclass(frozen=True, eq=False)
class ControllerProblem:
    """Step 1: the loss of a controller is its negative fitness in one model.

    Attributes
    ----------
    stage, model : where it runs, and the candidate (q,).
    start : (p,) controller that is the seed.
    correction : (m, p) controllers -> (m,) what is added to their fitness.
    """

    stage: Stage
    model: FloatArray
    start: FloatArray
    correction: Callable[[FloatArray], FloatArray] | None = None

    @property
    def runs(self) -> float:
        return 1

    @property
    def names(self) -> tuple[str, ...]:
        return self.stage.space.names

    @property
    def lower(self) -> FloatArray:
        return self.stage.space.lower

    @property
    def upper(self) -> FloatArray:
        return self.stage.space.upper

    def loss(self, candidates: FloatArray) -> FloatArray:
        """Negative fitness (m,) of controllers (m, p); NaN where the simulation diverged."""
        fitness = self.stage.fitness(candidates, self.model[None])[0]
        correction = 0.0 if self.correction is None else self.correction(candidates)
        return np.asarray(-(fitness + correction))


@dataclass(frozen=True, eq=False)
class ModelProblem:
    """Step 3: the loss of a model is its distance to trials of the robot.

    Attributes
    ----------
    stage : the model.
    controllers : (c, p) that were tried.
    trials : (c,) what they did.
    distance : ``phi1``, or a distance of sensors by name.
    start : (q,) the last model.
    """

    stage: Stage
    controllers: FloatArray
    trials: Sequence[Trial]
    distance: str
    start: FloatArray

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(p.name for p in self.stage.parameters)

    @property
    def runs(self) -> float:
        return len(self.trials)

    @cached_property
    def lower(self) -> FloatArray:
        return np.array([p.lower for p in self.stage.parameters])

    @cached_property
    def upper(self) -> FloatArray:
        return np.array([p.upper for p in self.stage.parameters])

    @cached_property
    def targets(self) -> tuple[tuple[int, tuple[Target, ...]], ...]:
        """Trials with a log, and what the replay is compared with."""
        joints, time = self.stage.world.index.joints, self.stage.task.time
        return tuple(
            (i, make_targets(on_clock(t.log, time), joints, ("position",), 0.0))
            for i, t in enumerate(self.trials)
            if t.log is not None and t.outcome != "crashed"
        )

    def loss(self, candidates: FloatArray) -> FloatArray:
        """Distances (m,) of models (m, q); infinite or NaN where a simulation failed."""
        if self.distance == FITNESS:
            usable = [i for i, t in enumerate(self.trials) if t.outcome != "crashed"]
            real = np.array([self.trials[i].fitness for i in usable])
            return phi1(real, self.stage.fitness(self.controllers[usable], candidates))
        return self._sensors(get_distance(self.distance) or SumOfSquares(), candidates)

    def noise(self, candidate: FloatArray) -> float:
        """Root mean square of the position error over the noise floor: one for a model that misses nothing."""
        squares = self._sensors(SumOfSquares(), candidate[None])[0]
        count = sum(int(t.mask.sum()) for _, targets in self.targets for t in targets)
        return float(np.sqrt(squares / max(count, 1)))

    def _sensors(self, distance: Distance, candidates: FloatArray) -> FloatArray:
        """Sum of a distance over trials, for each candidate."""
        total = np.zeros(len(candidates))
        for i, targets in self.targets:
            command = self.stage.commands(self.controllers[i : i + 1])
            for rows, outputs in self.stage.world.run(np.repeat(command, len(candidates), axis=0), candidates):
                for target in targets:
                    total[rows] += distance(target, target.predicted(outputs))
        return total


@dataclass(frozen=True)
class SumOfSquares:
    """Squared errors over the noise floor: twice the negative Gaussian log-likelihood up to a constant."""

    def __call__(self, target: Target, predicted: FloatArray) -> FloatArray:
        error = ((target.measured - predicted) / target.sigma)[:, target.mask]
        return np.asarray(np.sum(error**2, axis=1))


def on_clock(log: Log, time: FloatArray) -> Log:
    """A recorded trial at the task's sample times, up to its own end; both clocks start with the trial."""
    own = log.time - log.time[0]
    count = int(np.searchsorted(time, own[-1] + 1e-6, side="right"))
    wanted = time[:count]
    if len(own) == count and np.allclose(own, wanted, atol=1e-9):
        return log
    channels = {name: np.interp(wanted, own, values) for name, values in log.channels.items()}
    return replace(log, time=wanted, channels=channels, episode=np.zeros(count, dtype=np.int64), unknown={})
