"""What the loop found, as result.json (kind ``btr``) and with intervals."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import numpy as np

from sysid_btr._typing import FloatArray
from sysid_btr.btr.loop import BackToReality, Iteration
from sysid_btr.btr.trials import Tried
from sysid_btr.identify.intervals import Estimate, estimates
from sysid_btr.result import SCHEMA, clean, versions

if TYPE_CHECKING:
    from sysid_btr.btr.problems import Stage

DIFFERENCE = 1.0
"""Finite-difference step, in the parameters' scales: wide against the roughness that contacts give the fitness."""
MOST_TRIALS = 60
"""Trials, the newest, from which intervals are made."""


def btr_result(outcome: BackToReality, *, wall_s: float | None = None) -> dict[str, Any]:
    """The content of result.json.

    Parameters
    ----------
    outcome : what `back_to_reality` returned.
    wall_s : wall time to record, s; default that of the outcome.
    """
    stage, world = outcome.stage, outcome.stage.world
    nominal = np.array([p.nominal for p in outcome.parameters])
    counted = [t for t in outcome.tried if t.trial.outcome != "crashed"]
    last = {id(t) for t in next((i.tried for i in reversed(outcome.iterations) if i.tried), ())}
    rows = np.array([id(t) in last for t in counted], dtype=bool)
    real = np.array([t.trial.fitness for t in counted])
    plain, final = _predicted(stage, counted, np.stack([nominal, outcome.model]))
    foreseen = np.array([t.expected for t in counted])
    best = outcome.best
    found: dict[str, Any] = clean(
        {
            "schema": SCHEMA,
            "kind": "btr",
            "message": _message(outcome),
            "converged": outcome.finished,
            "termination": outcome.reason,
            "noise_floor": {"fitness": None},
            "nominal": {"train": _score(plain, real), "holdout": _score(plain[rows], real[rows])},
            "before": {"train": _score(plain, real), "holdout": _score(plain[rows], real[rows])},
            # held out: what was foreseen of the last trials before the model had seen them
            "after": {"train": _score(final, real), "holdout": _score(foreseen[rows], real[rows])},
            "parameters": [asdict(e) for e in estimate_model(outcome)],
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
            "iterations": [_iteration(i) for i in outcome.iterations],
            "trials": [_tried(t) for t in outcome.tried],
            "settings": {
                "iterations": outcome.settings.iterations,
                "trials": outcome.settings.trials,
                "distance": outcome.settings.distance,
                "choice": outcome.settings.choice,
                "memory": outcome.settings.memory,
                "controllers": repr(outcome.settings.controllers),
                "models": repr(outcome.settings.models),
            },
            "intervals": "linearised fitness of the newest trials, widened by the step to the optimum that is left",
            "units": {"fitness": "m/s"},
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
            "seed": outcome.seed,
            "replays": outcome.simulations,
            "wall_s": outcome.seconds if wall_s is None else wall_s,
        }
    )
    return found


def estimate_model(outcome: BackToReality) -> tuple[Estimate, ...]:
    """The model's parameters with intervals, from the derivatives of the newest trials' fitness.

    The search that ended here may not have converged, so the step to the optimum of the linearised problem widens
    the intervals. They assume that the model is right but for what the fitness differs by.
    """
    stage, values = outcome.stage, outcome.model
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
    best, first = outcome.best, outcome.iterations[0]
    fell = sum(t.trial.outcome != "done" for t in outcome.tried)
    started = max((t.trial.fitness for t in first.tried), default=float("nan"))
    return (
        f"{best.trial.fitness:.4g} m/s on the robot (trial {best.controller.label}; {started:.4g} in the first "
        f"iteration) after {len(outcome.tried)} trials{f', {fell} of which fell or crashed' if fell else ''}; the "
        f"model foresees fitness within {outcome.iterations[-1].transfer:.2g} m/s, {first.transfer:.2g} at first. "
        f"{outcome.reason}"
    )


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
    }


def _tried(t: Tried) -> dict[str, Any]:
    return {
        "trial": t.controller.label,
        "iteration": t.iteration,
        "expected": t.expected,
        "fitness": t.trial.fitness,
        "outcome": t.trial.outcome,
        "controller": t.controller.values,
    }
