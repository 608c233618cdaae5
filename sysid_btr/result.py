"""result.json: what a run found, with all that is needed to judge and to repeat it.

Strict JSON: a number that is not finite (an unknown noise floor, an infinite bound) is null.
"""

from __future__ import annotations

import json
import math
import os
import platform
from collections.abc import Mapping, Sequence
from dataclasses import asdict, is_dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from sysid_btr.errors import UsageError
from sysid_btr.units import CHANNEL_UNITS, si_all

if TYPE_CHECKING:
    from sysid_btr.diagnosis.closing import Candidate, Closing, NamedEffect, StepRecord
    from sysid_btr.identify.fit import Fit
    from sysid_btr.identify.intervals import Estimate, Profile
    from sysid_btr.identify.scores import ChannelScore, Scores
    from sysid_btr.identify.study import Study
    from sysid_btr.models.robot import Robot
    from sysid_btr.posterior.draw import Posterior

SCHEMA = "sysid_btr.result/1"
NOTICEABLE_GAIN = 2.0
"""Log-likelihood of a draw over the fit's beyond which the fit was not the minimum."""


def make_result(outcome: Fit | Closing | Posterior, *, seed: int = 0, wall_s: float | None = None) -> dict[str, Any]:
    """The content of result.json.

    Parameters
    ----------
    outcome : what `fit`, `close` or `posterior` returned.
    seed : of the generator the estimator was given.
    wall_s : wall time to record, s; default that of the outcome.

    Returns
    -------
    dict
        Ready for `json.dumps(..., allow_nan=False)`. In a fit, where no effect is added, ``after`` equals
        ``before``.
    """
    from sysid_btr.identify.fit import Fit
    from sysid_btr.posterior.draw import Posterior

    if isinstance(outcome, Posterior):
        found = _of_posterior(outcome)
    else:
        found = _of_fit(outcome) if isinstance(outcome, Fit) else _of_closing(outcome)
    study = outcome.study
    plain: dict[str, Any] = clean(
        {
            "schema": SCHEMA,
            **found,
            **_provenance(study),
            "seed": seed,
            "replays": outcome.replays,
            "wall_s": outcome.seconds if wall_s is None else wall_s,
        }
    )
    return plain


def _provenance(study: Study) -> dict[str, Any]:
    return {
        "units": channel_units(study),
        "numerics": {
            "integrator": study.numerics.integrator,
            "timestep": study.numerics.timestep,
            "error_in_noise_floors": study.numerics_error,
            "chosen": str(study.numerics),
        },
        "channels": study.channels,
        **({"walks": _walks(study)} if study.free else {}),
        "versions": versions(),
        "logs": _logs(study),
        "model": model_entry(study.robot),
    }


def _walks(study: Study) -> list[dict[str, Any]]:
    """How each log of a free base was cut up, and what its base state lacks."""
    from sysid_btr.floating_base.walk import Walk

    return [
        {
            "path": None if log.path is None else str(log.path),
            "part": part,
            "window": log.seconds,
            "windows": len(log.windows),
            "counted_less": int(np.sum(log.marginal.weight < COUNTED_LESS)) if log.marginal is not None else 0,
            "windows_tried": [asdict(choice) for choice in log.choices],
            "events": [str(event) for event in log.base.events],
            "used_until": float(log.time[-1]),
            "lost": log.base.lost,
        }
        for part, logs in (("train", study.train), ("holdout", study.holdout))
        for log in logs
        if isinstance(log, Walk) and log.windows is not None and log.base is not None
    ]


COUNTED_LESS = 0.9
"""Weight below which a window of a walk counts as one that the model does not explain."""


def _of_fit(fit: Fit) -> dict[str, Any]:
    before = scores_entry(fit.before)
    return {
        "kind": "fit",
        "message": fit_message(fit),
        "converged": fit.result.converged,
        "termination": fit.result.termination.value,
        "noise_floor": _floors(fit.before),
        "nominal": scores_entry(fit.nominal),
        "before": before,
        "after": before,
        "parameters": [
            {**estimate_entry(e), "numerics_shift": float(shift)}
            for e, shift in zip(fit.estimates, fit.numerics_shift, strict=True)
        ],
        "effects": [],
        "candidates": [],
        "steps": [],
        "signature": None,
        **({"profiles": [_profile(p) for p in fit.profiles]} if fit.profiles else {}),
    }


def _profile(profile: Profile) -> dict[str, Any]:
    return {
        "name": profile.name,
        "unit": profile.unit,
        "values": profile.values,
        "deviance": profile.deviance,
        "threshold": profile.threshold,
        "ci95": profile.interval,
        "closed": profile.closed,
        "replays": profile.replays,
    }


def _of_posterior(posterior: Posterior) -> dict[str, Any]:
    drawn, found = posterior.sample, posterior.sample.convergence
    ensembles, steps, walkers, _ = drawn.draws.shape
    parameters = []
    for i, (entry, own, prior) in enumerate(
        zip(_of_fit(posterior.as_fit)["parameters"], posterior.fit.estimates, posterior.priors, strict=True)
    ):
        parameters.append(
            {
                **entry,
                "median": float(np.median(drawn.flat[:, i])),
                "prior": str(prior),
                "posterior_over_prior_std": float(posterior.learnt[i]),
                "rhat": float(found.rhat[i]),
                "autocorrelation_time": float(found.tau[i]),
                "ess": float(found.ess[i]),
                "least_squares": {"value": own.value, "std": own.std},
            }
        )
    return {
        **_of_fit(posterior.as_fit),
        "kind": "posterior",
        "message": posterior_message(posterior),
        "converged": drawn.converged,
        "termination": drawn.termination,
        "parameters": parameters,
        "sampling": {
            "ensembles": ensembles,
            "walkers": walkers,
            "burn_in": found.burn_in,
            "steps": steps,
            "draws": ensembles * steps * walkers,
            "log_likelihood_gain": drawn.gain,
            "autocorrelation_times": steps / float(np.max(found.tau)),
            "rhat": float(np.max(found.rhat)),
            "ess": float(np.min(found.ess)),
            "replays": drawn.evaluations,
        },
        "surrogate": {
            "method": "quadratic model of the residuals, each proposal judged by a real replay (surrogate transition)",
            "acceptance": drawn.surrogate.acceptance,
            "log_likelihood_error": drawn.surrogate.error,
            "proposals": drawn.surrogate.proposals,
        },
        "likelihood": {
            "method": "Gaussian, adjusted to the covariance of correlated residuals (Chandler and Bate 2007)",
            "independent_share": posterior.likelihood.share,
        },
        "predictive": {channel: {"coverage95": share} for channel, share in posterior.coverage.items()},
    }


def posterior_message(posterior: Posterior) -> str:
    """The outcome of a posterior in one sentence."""
    told = sum(e.identifiable != "no" for e in posterior.estimates)
    found = posterior.sample.convergence
    parts = [
        f"{told} of {len(posterior.estimates)} parameters can be told from this log",
        f"{float(np.min(found.ess)):.0f} effective draws or more, R-hat {float(np.max(found.rhat)):.3f} or less",
        *(
            f"{100 * share:.1f} % of held-out {channel} lie in the 95 % bands"
            for channel, share in posterior.coverage.items()
        ),
    ]
    if posterior.sample.gain > NOTICEABLE_GAIN:
        best = posterior.sample.flat[int(np.argmax(posterior.sample.log_likelihood))]
        start = " ".join(f"--start '{n}={v:.6g}'" for n, v in zip(posterior.sample.names, best, strict=True))
        parts.append(
            f"a draw is more likely than the fit by exp({posterior.sample.gain:.1f}), so the fit had missed the "
            f"minimum: begin again with {start}"
        )
    if not posterior.converged:
        parts.append("the posterior did not converge")
    return "; ".join(parts) + "."


def _of_closing(closing: Closing) -> dict[str, Any]:
    return {
        "kind": "close",
        "verdict": closing.verdict,
        "message": closing.message,
        "noise_floor": dict(closing.noise_floor),
        "nominal": scores_entry(closing.nominal),
        "before": scores_entry(closing.before),
        "after": scores_entry(closing.after),
        "parameters": [estimate_entry(e) for e in closing.parameters],
        "effects": [_effect(e) for e in closing.effects],
        "candidates": [_candidate(c) for c in closing.candidates],
        "steps": [_step(s) for s in closing.steps],
        "signature": closing.signature,
    }


def replay_result(
    study: Study, scores: Mapping[str, ChannelScore], parameters: Mapping[str, float], wall_s: float
) -> dict[str, Any]:
    """Content of a result of kind ``replay``: nothing is fitted, so all data counts as held out."""
    unit = channel_units(study)
    position = scores.get("position")
    message = "the replay diverged"
    if position is not None and math.isfinite(position.rmse):
        error, floor = si_all([position.rmse, position.floor], unit["position"].partition(",")[0])
        message = f"position error {error}, where the sensor's own noise is {floor}."
    plain: dict[str, Any] = clean(
        {
            "schema": SCHEMA,
            "kind": "replay",
            "message": message,
            "noise_floor": {channel: s.floor for channel, s in scores.items()},
            "nominal": {"train": {}, "holdout": channel_entries(scores)},
            "set": dict(parameters),
            "parameters": [],
            "effects": [],
            **_provenance(study),
            "seed": None,
            "replays": len(study.holdout),
            "wall_s": wall_s,
        }
    )
    return plain


def estimate_entry(estimate: Estimate) -> dict[str, Any]:
    """One parameter of a result."""
    return asdict(estimate)


def _effect(effect: NamedEffect) -> dict[str, Any]:
    return {**asdict(effect), "parameters": [estimate_entry(e) for e in effect.parameters]}


def _candidate(candidate: Candidate) -> dict[str, Any]:
    return asdict(candidate)


def _step(step: StepRecord) -> dict[str, Any]:
    return asdict(step)


def scores_entry(scores: Scores) -> dict[str, Any]:
    """Scores by part and channel."""
    return {"train": channel_entries(scores.train), "holdout": channel_entries(scores.holdout)}


def channel_entries(part: Mapping[str, ChannelScore]) -> dict[str, dict[str, Any]]:
    """Scores by channel: rmse, nrmse, chi2, and the rmse of each joint."""
    return {
        channel: {"rmse": s.rmse, "nrmse": s.nrmse, "chi2": s.chi2, "joints": dict(s.joints)}
        for channel, s in part.items()
    }


def _floors(scores: Scores) -> dict[str, float]:
    return {channel: s.floor for channel, s in (scores.holdout or scores.train).items()}


def fit_message(fit: Fit) -> str:
    """The outcome of a fit in one sentence."""
    unit = channel_units(fit.study)["position"].partition(",")[0]
    told = sum(e.identifiable != "no" for e in fit.estimates)
    parts = [f"{told} of {len(fit.estimates)} parameters can be told from this log"]
    if "position" in fit.before.holdout:
        nominal, before = fit.nominal.holdout["position"], fit.before.holdout["position"]
        first, last, floor = si_all([nominal.rmse, before.rmse, before.floor], unit)
        parts.append(
            f"the held-out position error goes from {first} to {last}, "
            f"where the sensor's own noise is {floor}"
        )
    if not fit.result.converged:
        parts.append("the fit did not converge")
    return "; ".join(parts) + "."


def channel_units(study: Study) -> dict[str, str]:
    """Unit of each channel on this robot; both where it has hinges and slides."""
    from sysid_btr.models.robot import joint_names

    model = study.robot.compile()
    slides = {int(model.joint(j).type[0]) == 2 for j in joint_names(study.robot)}
    kinds = [k for k, there in ((0, False in slides), (1, True in slides)) if there]
    return {channel: ", ".join(units[k] for k in kinds) for channel, units in CHANNEL_UNITS.items()}


def versions() -> dict[str, str]:
    """Versions of what the numbers depend on."""
    import mujoco
    import scipy

    from sysid_btr.version import __version__

    return {
        "sysid_btr": __version__,
        "python": platform.python_version(),
        "mujoco": str(mujoco.__version__),
        "numpy": np.__version__,
        "scipy": scipy.__version__,
    }


def _logs(study: Study) -> list[dict[str, Any]]:
    from sysid_btr.io.parquet import sha256

    fitted = {log.path for log in study.train}
    held = {log.path for log in study.holdout}
    entries = []
    for path in dict.fromkeys(log.path for log in (*study.train, *study.holdout)):
        parts = [name for name, paths in (("train", fitted), ("holdout", held)) if path in paths]
        entries.append(
            {
                "path": None if path is None else str(path),
                "sha256": None if path is None else sha256(path),
                "used_for": parts,
            }
        )
    return entries


def model_entry(robot: Robot) -> dict[str, Any]:
    """Name, file and digest of a model."""
    return {
        "name": robot.name,
        "path": None if robot.path is None else str(robot.path),
        "sha256": robot.digest,
    }


def clean(value: Any) -> Any:
    """Plain JSON types; numbers that are not finite become None."""
    if isinstance(value, Mapping):
        return {str(k): clean(v) for k, v in value.items()}
    if isinstance(value, np.ndarray):
        return clean(value.tolist())
    if isinstance(value, Sequence) and not isinstance(value, str | bytes):
        return [clean(v) for v in value]
    if isinstance(value, bool | np.bool_):
        return bool(value)
    if isinstance(value, int | np.integer):
        return int(value)
    if isinstance(value, float | np.floating):
        return float(value) if math.isfinite(value) else None
    if is_dataclass(value) and not isinstance(value, type):
        return clean(asdict(value))
    if value is None or isinstance(value, str):
        return value
    raise TypeError(f"{type(value).__name__} has no place in a result: {value!r}")


def to_json(result: Mapping[str, Any]) -> str:
    """Text of result.json; strict JSON that reads back to the same numbers."""
    return json.dumps(clean(result), indent=2, allow_nan=False, ensure_ascii=False) + "\n"


def read_result(path: str | os.PathLike[str]) -> dict[str, Any]:
    """Read result.json, or the one in a folder.

    Raises
    ------
    UsageError
        If there is none, or it is not a result of this schema.
    """
    file = Path(path)
    if file.is_dir():
        file = file / "result.json"
    try:
        content = json.loads(file.read_text(encoding="utf-8"))
    except OSError as error:
        began = (file.parent / "journal.jsonl").exists() or (file.parent / "journals").is_dir()
        todo = (
            "the run in this folder has not ended: its command with --resume goes on with it"
            if began
            else "give the --out folder of a finished run"
        )
        raise UsageError(f"cannot read {file}: {error.strerror}; {todo}") from error
    except UnicodeDecodeError:
        raise UsageError(f"{file} is no result; give the --out folder of a finished run") from None
    except ValueError as error:
        raise UsageError(f"{file} is not JSON ({error}); give the result.json of a finished run") from error
    schema = content.get("schema") if isinstance(content, dict) else None
    if schema != SCHEMA:
        raise UsageError(f"{file} has schema {schema!r}; this version reads {SCHEMA!r}")
    result: dict[str, Any] = content
    return result


def exit_code(result: Mapping[str, Any]) -> int:
    """0, or 5 where a finished run told nothing: not converged, or not one parameter or effect identifiable.

    A parameter that the log cannot tell beside others that it can is a finding, not a failure.
    """
    if result.get("converged") is False:
        return 5
    parameters = result["parameters"]
    told = any(p["identifiable"] != "no" for p in parameters)
    return 5 if parameters and not told and not result["effects"] else 0
