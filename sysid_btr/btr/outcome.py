"""What the loop ended with: its rounds, the best model with intervals, and the result (kind ``btr``)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from sysid_btr._typing import FloatArray
from sysid_btr.btr.belief import Belief
from sysid_btr.btr.learning import Learnt
from sysid_btr.btr.problems import Stage
from sysid_btr.btr.settings import Settings
from sysid_btr.btr.trials import Tried
from sysid_btr.identify.intervals import Estimate, estimates
from sysid_btr.objectives.covariance import Known
from sysid_btr.result import SCHEMA, clean, versions
from sysid_btr.terms.base import Parameter

DIFFERENCE = 1.0
"""Finite-difference step, in the parameters' scales: wide against the roughness that contacts give the fitness."""
MOST_TRIALS = 60
"""Trials, the newest, from which intervals are made."""


@dataclass(frozen=True, eq=False)
class Iteration:
    """One round of the loop.

    Attributes
    ----------
    number : from 1.
    controller, expected : the fittest of Step 1, (p,), and its fitness in the model.
    expected_mean : mean fitness of the last generation.
    tried : on the robot.
    transfer : mean absolute difference of expected and real fitness of these, before the model was corrected.
    names : of the model's parameters, which `close` may add to.
    model : (q,) the model after Step 3.
    loss, loss_before, loss_mean : distance of this model, of the last one, and mean of the last generation, to the
        trials that Step 3 explains.
    population, losses : all models that Step 3 looked at, (k, q) and (k,).
    population_names : of their parameters, before `close` added to them.
    delta : mean absolute difference of fitness between this model and the robot on the trials of this iteration.
    noise : position error of this model in noise floors on them; NaN where nothing was logged.
    best : largest real fitness so far of a trial that stood; of any where none did.
    joined : what `close` said, if it ran.
    promise : what the first trial was worth beforehand: the gain in fitness to be expected, times the chance to stand;
        None where one model chose. Nothing is tried where that is less than is worthwhile.
    untied : a remark on each tie of joints that the trials so far contradict, and that is left out of the model.
    learnt : what Step 3 learnt by a likelihood, if that was asked for.
    """

    number: int
    controller: FloatArray
    expected: float
    expected_mean: float
    tried: tuple[Tried, ...]
    transfer: float
    names: tuple[str, ...]
    model: FloatArray
    loss: float
    loss_before: float
    loss_mean: float
    population: FloatArray
    losses: FloatArray
    delta: float
    noise: float
    best: float
    joined: str = ""
    promise: float | None = None
    population_names: tuple[str, ...] = ()
    untied: tuple[str, ...] = ()
    learnt: Learnt | None = None

    @property
    def corrected(self) -> bool:
        """Whether Step 3 corrected the model."""
        return bool(np.isfinite(self.loss)) if self.learnt is None else self.learnt.explained


@dataclass(frozen=True, eq=False)
class BackToReality:
    """What the loop ended with.

    Attributes
    ----------
    stage, model : the best model: what runs it, and its numbers (q,).
    iterations : all rounds.
    best : the fittest controller on the robot, of those that stood if any did.
    reason : why it ended, a sentence.
    finished : whether it ended because the requirement was met or the iterations done.
    settings, seed : as given.
    simulations : of whole trials, in Steps 1 and 3 and where effects were looked for.
    seconds : wall time of this run.
    belief : of the best model, where it was corrected by a likelihood.
    """

    stage: Stage
    model: FloatArray
    iterations: tuple[Iteration, ...]
    best: Tried
    reason: str
    finished: bool
    settings: Settings
    seed: int
    simulations: int
    seconds: float
    belief: Belief | None = None

    @property
    def tried(self) -> tuple[Tried, ...]:
        """All trials, in order."""
        return tuple(t for i in self.iterations for t in i.tried)

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Of the best model."""
        return self.stage.parameters

    def to_dict(self, *, wall_s: float | None = None) -> dict[str, Any]:
        """The content of result.json.

        Parameters
        ----------
        wall_s : wall time to record, s; default that of the loop.
        """
        best, stage, world = self.best, self.stage, self.stage.world
        found: dict[str, Any] = clean(
            {
                "schema": SCHEMA,
                "kind": "btr",
                "message": _message(self),
                "converged": self.finished,
                "termination": self.reason,
                "noise_floor": {"fitness": None},
                **self._errors(),
                "parameters": [e.to_dict() for e in estimate_model(self)],
                "effects": [],
                "candidates": [],
                "steps": [],
                "signature": None,
                "best": {
                    "trial": best.controller.label,
                    "iteration": best.iteration,
                    "fitness": best.trial.fitness,
                    "expected": best.expected,
                    "controller": dict(zip(stage.space.names, best.controller.values, strict=True)),
                },
                "iterations": [_iteration(i) for i in self.iterations],
                "trials": [_tried(t) for t in self.tried],
                "settings": {
                    "iterations": self.settings.iterations,
                    "trials": self.settings.trials,
                    "distance": self.settings.distance,
                    "choice": self.settings.choice,
                    "draws": self.settings.draws,
                    "risk": asdict(self.settings.risk),
                    "memory": self.settings.memory,
                    "controllers": repr(self.settings.controllers),
                    "models": repr(self.settings.models),
                },
                "intervals": "linearised fitness of the newest trials, widened by the remaining step to the optimum"
                if self.belief is None
                else "what was believed beforehand and the likelihood of the trials' logs, linearised",
                "units": {"fitness": stage.task.unit},
                "task": {"fitness": stage.task.goal, "duration": stage.task.duration},
                "numerics": {
                    "integrator": world.numerics.integrator,
                    "timestep": world.numerics.timestep,
                    "error_in_noise_floors": None,
                    "chosen": str(world.numerics),
                },
                "channels": ["position"],
                "versions": versions(),
                "logs": [],
                "model": world.robot.to_dict(),
                "seed": self.seed,
                "replays": self.simulations,
                "wall_s": self.seconds if wall_s is None else wall_s,
            }
        )
        return found

    def _errors(self) -> dict[str, Any]:
        """Errors of the fitness that the plain model and the corrected one predict."""
        nominal = np.array([p.nominal for p in self.parameters])
        counted = [t for t in self.tried if t.trial.outcome != "crashed"]
        last = {id(t) for t in next((i.tried for i in reversed(self.iterations) if i.tried), ())}
        rows = np.array([id(t) in last for t in counted], dtype=bool)
        real = np.array([t.trial.fitness for t in counted])
        plain, final = _predicted(self.stage, counted, np.stack([nominal, self.model]))
        foreseen = np.array([t.expected for t in counted])
        before = {"train": _score(plain, real), "holdout": _score(plain[rows], real[rows])}
        # held out: what was foreseen of the last trials before the model had seen them
        after = {"train": _score(final, real), "holdout": _score(foreseen[rows], real[rows])}
        return {"nominal": before, "before": before, "after": after}

    def _repr_html_(self) -> str:
        from sysid_btr.display.html import result_html

        return result_html(self.to_dict())


def estimate_model(outcome: BackToReality) -> tuple[Estimate, ...]:
    """The model's parameters with intervals: as they are believed, or from the newest trials' fitness.

    The search that ended here may not have converged, so the step to the optimum of the linearised problem widens
    the intervals. They assume that the model is right but for what the fitness differs by.
    """
    stage, values = outcome.stage, outcome.model
    if outcome.belief is not None:
        spread, every = outcome.belief.covariance, np.arange(len(values))
        root = np.linalg.inv(np.linalg.cholesky(spread))
        return estimates(
            stage.parameters, values, root, np.zeros(len(values)), every, known=Known(every, values, spread)
        )
    tried = [t for t in outcome.tried if t.trial.outcome != "crashed"][-MOST_TRIALS:]
    step = np.array([DIFFERENCE * p.scale for p in stage.parameters])
    lower = np.array([p.lower for p in stage.parameters])
    upper = np.array([p.upper for p in stage.parameters])
    low = np.maximum(values - np.diag(step), lower)
    high = np.minimum(values + np.diag(step), upper)
    fitness = _predicted(stage, tried, np.concatenate([values[None], low, high]))
    real = np.array([t.trial.fitness for t in tried])
    good = np.isfinite(fitness).all(axis=0)
    q = len(values)
    jacobian = -((fitness[1 + q :] - fitness[1 : 1 + q]) / np.diag(high - low)[:, None]).T[good]
    residual = (real - fitness[0])[good]
    sigma = float(np.sqrt(np.sum(residual**2) / max(len(residual) - q, 1))) if len(residual) else 0.0
    sigma = max(sigma, 1e-9)
    left = np.linalg.lstsq(jacobian, residual, rcond=1e-6)[0] if len(residual) else np.zeros(q)
    return estimates(
        stage.parameters, values, jacobian / sigma, residual / sigma, np.arange(len(residual)), np.asarray(left)
    )


def _predicted(stage: Stage, tried: Sequence[Tried], models: FloatArray) -> FloatArray:
    """Fitness (k, trials) of all that was tried in some models."""
    if not tried:
        return np.zeros((len(models), 0))
    return stage.fitness(np.array([t.controller.values for t in tried]), models)


def _score(predicted: FloatArray, real: FloatArray) -> dict[str, Any]:
    good = np.isfinite(predicted)
    if not good.any():
        return {}
    rmse = float(np.sqrt(np.mean((predicted - real)[good] ** 2)))
    size = float(np.sqrt(np.mean(real[good] ** 2)))
    return {"fitness": {"rmse": rmse, "nrmse": rmse / size if size > 0 else None, "chi2": None, "joints": {}}}


def _message(outcome: BackToReality) -> str:
    best, first, told = outcome.best, outcome.iterations[0], outcome.stage.task.in_words
    fell = sum(t.trial.outcome != "done" for t in outcome.tried)
    started = max((t.trial.fitness for t in first.tried), default=float("nan"))
    return (
        f"{told(best.trial.fitness)} on the robot (trial {best.controller.label}; {started:.4g} in the first "
        f"iteration) after {len(outcome.tried)} trials{f', {fell} of which fell or crashed' if fell else ''}; the "
        f"model predicts fitness within {told(outcome.iterations[-1].transfer, 2)}, {first.transfer:.2g} at first. "
        f"{_foreseen(outcome)}{_untied(outcome)}{outcome.reason}"
    )


def _foreseen(outcome: BackToReality) -> str:
    """How what was foreseen came out, in words."""
    task = outcome.stage.task
    told = [(t, t.foreseen) for t in outcome.tried if t.foreseen is not None]
    if not told:
        return ""
    held = sum(f.low <= t.trial.fitness <= f.high for t, f in told)
    falls, fell = sum(1 - f.stands for _, f in told), sum(t.trial.outcome != "done" for t, _ in told)
    last = outcome.iterations[-1].promise
    worth = "" if last is None else f" The last iteration's trials promised {task.in_words(last, 2)}."
    counted = f"; {falls:.1f} falls were foreseen, {fell} happened" if task.falls else ""
    return f"Of {len(told)} trials {held} lay in their 90 % interval{counted}.{worth} "


def _untied(outcome: BackToReality) -> str:
    return "".join(f"After iteration {i.number}: {remark}. " for i in outcome.iterations for remark in i.untied)


def _iteration(i: Iteration) -> dict[str, Any]:
    real = [t.trial.fitness for t in i.tried]
    return {
        "number": i.number,
        "trials": [t.controller.label for t in i.tried],
        "fitness": {
            "best": i.best,
            "max": max(real, default=None),
            "mean": float(np.mean(real)) if real else None,
            "expected": i.expected,
            "expected_mean": i.expected_mean,
        },
        "delta_fitness": {"transfer": i.transfer, "corrected": i.delta},
        "distance": {"before": i.loss_before, "after": i.loss, "mean": i.loss_mean},
        "position_error_in_noise_floors": i.noise,
        "model": dict(zip(i.names, i.model, strict=True)),
        "models": {"names": i.population_names, "values": i.population, "losses": i.losses},
        "closing": i.joined or None,
        "learnt": None if i.learnt is None else str(i.learnt),
        "promise": i.promise,
    }


def _tried(t: Tried) -> dict[str, Any]:
    return {
        "trial": t.controller.label,
        "iteration": t.iteration,
        "expected": t.expected,
        "fitness": t.trial.fitness,
        "outcome": t.trial.outcome,
        "controller": t.controller.values,
        "foreseen": None if t.foreseen is None else asdict(t.foreseen),
    }
