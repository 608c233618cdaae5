"""What every outcome of a study puts into result.json, whatever was found."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from sysid_btr._typing import FloatArray
from sysid_btr.errors import UsageError
from sysid_btr.identify.curves import curves_of
from sysid_btr.identify.intervals import Estimate, correlation_matrix, covariance_matrix
from sysid_btr.identify.residuals import residuals
from sysid_btr.identify.scores import ChannelScore, Scores
from sysid_btr.identify.sensitivity import sensitivity_table
from sysid_btr.identify.study import Study
from sysid_btr.io.split import spans_of
from sysid_btr.models.robot import channel_units
from sysid_btr.result import SCHEMA, clean, versions
from sysid_btr.simulation.numerics import MUJOCO
from sysid_btr.terms.model import Model
from sysid_btr.units import si_all

if TYPE_CHECKING:
    import pandas as pd

SHOWN = 4
"""Parameters in a line about an outcome."""


def study_result(
    study: Study, found: Mapping[str, Any], *, seed: int | None, replays: int, wall_s: float
) -> dict[str, Any]:
    """The content of result.json.

    Parameters
    ----------
    study : data and model, as fitted.
    found : ``kind``, ``message`` and what belongs to this kind of result.
    seed : of the generator the estimator was given; None where nothing is drawn.
    replays : candidates simulated.
    wall_s : wall time, s.

    Returns
    -------
    dict
        Ready for `json.dumps(..., allow_nan=False)`.
    """
    plain: dict[str, Any] = clean(
        {"schema": SCHEMA, **found, **_provenance(study), "seed": seed, "replays": replays, "wall_s": wall_s}
    )
    return plain


class StudyOutcome:
    """What was found in a study, as result.json and as a notebook shows it."""

    if TYPE_CHECKING:

        @property
        def study(self) -> Study: ...
        @property
        def model(self) -> Model: ...
        @property
        def estimates(self) -> Sequence[Estimate]: ...
        @property
        def found(self) -> Mapping[str, Any]: ...
        @property
        def replays(self) -> int: ...
        @property
        def seconds(self) -> float: ...

    def to_dict(self, *, seed: int = 0, wall_s: float | None = None) -> dict[str, Any]:
        """The content of result.json.

        Parameters
        ----------
        seed : of the generator that was given.
        wall_s : wall time to record, s; default that of all of it.
        """
        wall_s = self.seconds if wall_s is None else wall_s
        more = {
            "covariance": self.covariance,
            "correlation": self.correlation,
            "sensitivity": list(sensitivity_table(self.estimates)),
            "curves": [curve.to_dict() for curve in curves_of(self.model, self.estimates)],
        }
        return study_result(self.study, {**self.found, **more}, seed=seed, replays=self.replays, wall_s=wall_s)

    @property
    def correlation(self) -> FloatArray:
        """(p, p) correlations of the errors of `estimates`; NaN where nothing is known of a parameter."""
        return correlation_matrix(self.estimates)

    @property
    def covariance(self) -> FloatArray:
        """(p, p) covariance of `estimates`; NaN where nothing is known of a parameter."""
        return covariance_matrix(self.estimates)

    def to_pandas(self, table: str = "parameters") -> pd.DataFrame:
        """One of the tables of `sysid_btr.tables`: ``parameters``, ``effects``, ``candidates``, ``joints``, ``run``...

        Raises
        ------
        UsageError
            If there is no such table; the message lists those that there are.
        """
        from sysid_btr.display.tables import to_tables

        found = to_tables(self.to_dict())
        if table not in found:
            raise UsageError(f"this outcome has no table {table!r}; it has {', '.join(found)}")
        return found[table]

    def residuals(self) -> pd.DataFrame:
        """Every sample that was compared with the model, fitted and held out.

        Returns
        -------
        DataFrame
            ``log``, ``episode``, ``part`` (train, holdout), ``channel``, ``joint``, ``time`` (s since the first
            sample), ``measured``, ``predicted`` by the model found, ``residual`` (their difference) and ``noise`` (its
            floor), SI.
        """
        return residuals(self.study, self.model)

    def __repr__(self) -> str:
        known = [str(estimate) for estimate in self.estimates[:SHOWN]]
        more = [f"{len(self.estimates) - SHOWN} more"] if len(self.estimates) > SHOWN else []
        verdict = f"{self.found['verdict']}: " if "verdict" in self.found else ""
        return f"<{type(self).__name__} of {self.study.robot.name}: {verdict}{', '.join([*known, *more])}>"

    def _repr_html_(self) -> str:
        from sysid_btr.display.html import result_html

        return result_html(self.to_dict())


def replay_result(
    study: Study,
    scores: Mapping[str, ChannelScore],
    parameters: Mapping[str, float],
    wall_s: float,
    whole: Mapping[str, ChannelScore] | None = None,
) -> dict[str, Any]:
    """Content of a result of kind ``replay``: nothing is fitted, so all data counts as held out.

    `whole` are scores open loop, where `scores` are of segments.
    """
    channel = study.leading_channel
    leading = scores.get(channel)
    message = "the replay diverged"
    if leading is not None and math.isfinite(leading.rmse):
        unit = channel_units(study.robot)[channel].partition(",")[0]
        error, floor = si_all([leading.rmse, leading.floor], unit)
        message = f"{channel} error {error}, with a noise floor of {floor}."
    found = {
        "kind": "replay",
        "message": message,
        "noise_floor": {channel: s.floor for channel, s in scores.items()},
        "nominal": Scores({}, scores, whole or {}).to_dict(),
        "set": dict(parameters),
        "parameters": [],
        "effects": [],
    }
    return study_result(study, found, seed=None, replays=len(study.holdout), wall_s=wall_s)


def _provenance(study: Study) -> dict[str, Any]:
    walks, episodes, simulator = _facts(study, "free"), _facts(study, "fixed"), study.numerics.simulator
    return {
        "units": channel_units(study.robot),
        "numerics": {
            "integrator": study.numerics.integrator,
            "timestep": study.numerics.timestep,
            "error_in_noise_floors": study.numerics_error,
            "chosen": str(study.numerics),
            **({} if simulator == MUJOCO else {"simulator": simulator}),
            **({"stated": True} if study.numerics.stated else {}),
            **({"recorded": True} if study.numerics.recorded else {}),
        },
        "channels": study.channels,
        **({"walks": walks} if walks else {}),
        **({"episodes": episodes} if episodes else {}),
        "versions": versions(),
        "logs": _logs(study),
        "model": study.robot.to_dict(),
    }


def _facts(study: Study, mount: str) -> list[dict[str, Any]]:
    """How each log of a mount was segmented or otherwise prepared, and what its base state lacks."""
    return [
        {"path": None if episode.log.path is None else str(episode.log.path), "part": part, **facts}
        for part, episodes in (("train", study.train), ("holdout", study.holdout))
        for episode in episodes
        if episode.log.meta.mount == mount and (facts := episode.facts()) is not None
    ]


def _logs(study: Study) -> list[dict[str, Any]]:
    from sysid_btr.io.parquet import sha256

    dates = {e.log.path: e.recording.recorded for e in (*study.train, *study.holdout)}
    fitted = {episode.log.path for episode in study.train}
    held = {episode.log.path for episode in study.holdout}
    entries = []
    for path in dict.fromkeys((*(e.log.path for e in study.train), *(e.log.path for e in study.holdout))):
        parts = [name for name, paths in (("train", fitted), ("holdout", held)) if path in paths]
        entries.append(
            {
                "path": None if path is None else str(path),
                "sha256": None if path is None else sha256(path),
                "used_for": parts,
                "recorded": dates[path],
                "held_out": [
                    spans_of(episode.recording.time, episode.scored)
                    for episode in study.holdout
                    if episode.log.path == path
                ],
            }
        )
    return entries
