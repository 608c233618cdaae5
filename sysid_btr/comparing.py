"""Finished runs side by side: which differences are real, what drifts, and whose model predicts a common log best.

A parameter is tested for being the same in all runs by the weighted sum of squared deviations from its weighted mean
(Cochran 1954, doi:10.2307/3001666), which for two runs is the square of their difference over its joint standard
error. Many parameters are tested at once, so the probabilities are those of Holm (1979, Scandinavian Journal of
Statistics 6, 65-70): the chance that even one of the differences that are called real is none is `CHANCE` at most.
Where there are dates of three runs or more, a line is fitted over time, its standard error widened where the runs
scatter about it by more than theirs (Birge 1932, doi:10.1103/PhysRev.40.207).
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from datetime import datetime, timedelta
from itertools import combinations
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from sysid_btr._typing import FloatArray
from sysid_btr.display.comparison import BECAME
from sysid_btr.errors import UsageError
from sysid_btr.result import clean, read_result

if TYPE_CHECKING:
    import pandas as pd

    from sysid_btr.io.log import Log
    from sysid_btr.models.robot import Robot

SCHEMA = "sysid_btr.comparison/1"
CHANCE = 0.05
"""Probability that any difference that is called real is none."""
KINDS = ("fit", "posterior", "close", "btr")
"""Runs that identify parameters."""
DAY = timedelta(days=1)


@dataclass(frozen=True)
class Run:
    """A finished run.

    Attributes
    ----------
    label : of its column.
    folder : where it is.
    result : content of its result.json.
    date : when its first fitted log was recorded, ISO 8601.
    """

    label: str
    folder: Path
    result: Mapping[str, Any]
    date: str | None

    @property
    def parameters(self) -> dict[str, Mapping[str, Any]]:
        """All estimates by name, those of effects too."""
        effects = self.result.get("effects", ())
        return {p["name"]: p for p in (*self.result["parameters"], *(p for e in effects for p in e["parameters"]))}

    @property
    def fitted(self) -> frozenset[str]:
        """Digests of the logs it was fitted to."""
        logs = self.result.get("logs", ())
        return frozenset(e["sha256"] for e in logs if "train" in e["used_for"] and e["sha256"])


@dataclass(frozen=True)
class Row:
    """One parameter in all runs.

    Attributes
    ----------
    name, unit : of the parameter.
    values : estimate of each run; None where a run does not have it or it is not identifiable.
    change, change_std : from the first run that has it to the last, and its joint standard error.
    times : change over its standard error.
    p : probability of such differences if there are none, for this parameter alone and for all of them (Holm).
    real : whether the runs differ; None where that cannot be tested.
    drift, drift_std, drift_p : change a day, its standard error, and probability (Holm); None without three dates.
    """

    name: str
    unit: str
    values: tuple[Mapping[str, Any] | None, ...]
    change: float | None = None
    change_std: float | None = None
    times: float | None = None
    p: float | None = None
    p_holm: float | None = None
    real: bool | None = None
    drift: float | None = None
    drift_std: float | None = None
    drift_p: float | None = None


@dataclass(frozen=True)
class EffectRow:
    """One effect at one place: its certainty in each run, None where it is not named; and what became of it."""

    effect: str
    where: str
    certainty: tuple[float | None, ...]
    became: str


@dataclass(frozen=True)
class ErrorRow:
    """Error of each run's model (rmse, SI) on one channel of its own held-out data, or of a common log."""

    data: str
    channel: str
    unit: str
    nominal: tuple[float | None, ...]
    rmse: tuple[float | None, ...]
    noise_floor: float | None


@dataclass(frozen=True, eq=False, repr=False)
class Comparison:
    """Runs side by side.

    Attributes
    ----------
    runs : in the order of their dates, or as given.
    parameters, effects, errors : rows of the three tables.
    remarks : what makes the runs less comparable.
    """

    runs: tuple[Run, ...]
    parameters: tuple[Row, ...]
    effects: tuple[EffectRow, ...]
    errors: tuple[ErrorRow, ...]
    remarks: tuple[str, ...]

    @property
    def message(self) -> str:
        """The outcome in one sentence."""
        tested = [row for row in self.parameters if row.real is not None]
        real = [row.name for row in tested if row.real]
        drifting = [row.name for row in self.parameters if row.drift_p is not None and row.drift_p < CHANCE]
        parts = [
            f"{len(real)} of {len(tested)} parameters differ between the runs{': ' if real else ''}{', '.join(real)}"
            if tested
            else "no difference could be tested"
        ]
        parts += [f"{', '.join(drifting)} drift with time"] if drifting else []
        changed = [f"{e.effect} at {e.where} is {BECAME[e.became]}" for e in self.effects if e.became != "stayed"]
        return "; ".join([*parts, *changed]) + "."

    def to_dict(self) -> dict[str, Any]:
        """As JSON: every number of the tables."""
        content: dict[str, Any] = clean(
            {
                "schema": SCHEMA,
                "message": self.message,
                "chance": CHANCE,
                "runs": [
                    {"label": r.label, "folder": str(r.folder), "kind": r.result["kind"], "date": r.date}
                    for r in self.runs
                ],
                "parameters": [asdict(row) for row in self.parameters],
                "effects": [asdict(row) for row in self.effects],
                "errors": [asdict(row) for row in self.errors],
                "remarks": self.remarks,
            }
        )
        return content

    def to_pandas(self, table: str = "parameters") -> pd.DataFrame:
        """``parameters``, ``effects`` or ``errors``, with columns ``RUN.value``, ``RUN.std``, ... of each run.

        Raises
        ------
        UsageError
            If there is no such table.
        """
        import pandas as pd

        from sysid_btr.display.comparison import flat_rows

        content = self.to_dict()
        if table not in ("parameters", "effects", "errors"):
            raise UsageError(f"a comparison has no table {table!r}; it has parameters, effects, errors")
        return pd.DataFrame(list(flat_rows(content, table)))

    def __repr__(self) -> str:
        return f"<Comparison of {', '.join(r.label for r in self.runs)}: {self.message}>"

    def _repr_html_(self) -> str:
        from sysid_btr.display.comparison import page

        return page(self.to_dict(), whole=False)


def compare(
    runs: Sequence[str | os.PathLike[str]],
    *,
    logs: Sequence[Log] = (),
    robot: Robot | None = None,
    dates: Sequence[str] | None = None,
    threads: int = 0,
) -> Comparison:
    """Compare finished runs of one robot.

    >>> sb.compare(["monday", "friday"], logs=[sb.read_log("walk.parquet")]).to_pandas()  # doctest: +SKIP

    Parameters
    ----------
    runs : two or more folders of finished runs of `fit`, `posterior`, `close` or `btr`.
    logs : on which every run's model is scored; best such that none was fitted to.
    robot : model for that; default the one the runs name.
    dates : ISO 8601, one a run; default when its first fitted log was recorded, if the log says so.
    threads : worker threads for `logs`, 0 for all cores.

    Returns
    -------
    Comparison
        Parameters, effects and errors side by side, and remarks on what makes the runs less comparable.

    Raises
    ------
    UsageError
        A folder holds no finished run, or none that identifies; the runs are of different robots, or have no
        parameter in common.
    """
    found = _with_labels([Path(run) for run in runs], dates)
    if len({r.folder.resolve() for r in found}) < 2:
        raise UsageError("a comparison takes two different runs or more: give their --out folders")
    _check_kinds(found)
    remarks = list(_check_models(found))
    if all(r.date for r in found):
        found = sorted(found, key=lambda r: _when(r.date))
    rows = _rows(found)
    shared = [(a, b) for a, b in combinations(found, 2) if a.fitted & b.fitted]
    if shared:
        pairs = "; ".join(f"{a.label} and {b.label}" for a, b in shared)
        remarks.append(
            f"fitted to the same log, so that their errors are not independent and no difference is tested: {pairs}"
        )
    else:
        rows = _with_drift(_tested(rows), [r.date for r in found])
    errors = [*_own_errors(found), *(_common_errors(found, logs, robot, threads, remarks) if logs else ())]
    return Comparison(tuple(found), tuple(rows), tuple(_effects(found)), tuple(errors), tuple(remarks))


# --- reading -------------------------------------------------------------------------------------------------


def _with_labels(folders: Sequence[Path], dates: Sequence[str] | None) -> list[Run]:
    if dates is not None and len(dates) != len(folders):
        raise UsageError(f"{len(dates)} dates for {len(folders)} runs: give one for each, in their order")
    for date in dates or ():
        _when(date)
    names = [f.parent.name if f.name == "result.json" else f.resolve().name for f in folders]
    labels = [name if names.count(name) == 1 else str(f) for name, f in zip(names, folders, strict=True)]
    runs = []
    for k, (folder, label) in enumerate(zip(folders, labels, strict=True)):
        result = read_result(folder)
        runs.append(
            Run(label, folder if folder.is_dir() else folder.parent, result, dates[k] if dates else _date(result))
        )
    return runs


def _date(result: Mapping[str, Any]) -> str | None:
    known = [e["recorded"] for e in result.get("logs", ()) if "train" in e["used_for"] and e.get("recorded")]
    return min(known, default=None)


def _when(date: str | None) -> datetime:
    try:
        when = datetime.fromisoformat(date or "")
    except ValueError:
        raise UsageError(f"{date!r} is not a date: give ISO 8601, such as 2026-11-23 or 2026-11-23T14:05") from None
    return when if when.tzinfo else when.astimezone()


def _check_kinds(runs: Sequence[Run]) -> None:
    wrong = [f"{r.folder} is a run of {r.result['kind']}" for r in runs if r.result["kind"] not in KINDS]
    if wrong:
        raise UsageError(f"{'; '.join(wrong)}: only runs of {', '.join(KINDS)} identify parameters")


def _check_models(runs: Sequence[Run]) -> Iterator[str]:
    """Remarks on models that differ.

    Raises
    ------
    UsageError
        For different robots.
    """
    models = [r.result["model"] for r in runs]
    digests, names = {m["sha256"] for m in models}, {m["name"] for m in models}
    common = set.intersection(*(set(r.parameters) for r in runs))
    if len(digests) > 1 and len(names) > 1:
        told = "; ".join(f"{r.label}: {r.result['model']['name']}" for r in runs)
        raise UsageError(f"the runs are of different robots ({told}): compare runs with one model")
    if not set.union(*(set(a.parameters) & set(b.parameters) for a, b in combinations(runs, 2))):
        told = "\n".join(f"  {r.label}: {', '.join(r.parameters) or 'none'}" for r in runs)
        raise UsageError(
            f"the runs have no parameter in common:\n{told}\nFit the same ones to both logs (--fit), and compare again"
        )
    if len(digests) > 1:
        yield "the model file changed between the runs: factors are of different values"
    if len({str(r.result["numerics"]["chosen"]) for r in runs}) > 1:
        told = ", ".join(f"{r.label}: {r.result['numerics']['chosen']}" for r in runs)
        yield f"simulated with different integrators or steps ({told})"
    for run in runs:
        more = [name for name in run.parameters if name not in common and ":" in name]
        if more:
            yield f"{run.label} has parameters that not all runs have: {', '.join(more)}"
        if run.result.get("converged") is False:
            yield f"{run.label} did not converge"


# --- parameters ----------------------------------------------------------------------------------------------


def _rows(runs: Sequence[Run]) -> list[Row]:
    units = {name: p["unit"] for run in runs for name, p in run.parameters.items()}
    return [Row(name, unit, tuple(_side(run.parameters.get(name)) for run in runs)) for name, unit in units.items()]


def _side(parameter: Mapping[str, Any] | None) -> Mapping[str, Any] | None:
    if parameter is None or parameter["identifiable"] == "no" or not parameter["std"]:
        return None
    return {name: parameter[name] for name in ("value", "std", "ci95")}


def _known(row: Row) -> tuple[FloatArray, FloatArray, list[int]]:
    """Values and standard errors of the runs that have them, and which these are."""
    which = [k for k, side in enumerate(row.values) if side is not None]
    pairs = [(side["value"], side["std"]) for side in row.values if side is not None]
    table = np.array(pairs, dtype=np.float64).reshape(-1, 2)
    return table[:, 0], table[:, 1], which


def _tested(rows: Sequence[Row]) -> list[Row]:
    """The rows with changes and how likely these are by chance."""
    from scipy.stats import chi2

    found = []
    for row in rows:
        value, std, _ = _known(row)
        if len(value) < 2:
            found.append(row)
            continue
        mean = np.sum(value / std**2) / np.sum(1 / std**2)
        p = float(chi2.sf(np.sum(((value - mean) / std) ** 2), len(value) - 1))
        change, joint = float(value[-1] - value[0]), float(np.hypot(std[0], std[-1]))
        found.append(replace(row, change=change, change_std=joint, times=change / joint, p=p))
    adjusted = iter(holm([row.p for row in found if row.p is not None]))
    return [row if row.p is None else _judged(row, next(adjusted)) for row in found]


def _judged(row: Row, p: float) -> Row:
    return replace(row, p_holm=p, real=p < CHANCE)


def holm(p: Sequence[float]) -> list[float]:
    """Probabilities adjusted for their number (Holm 1979), in the same order."""
    order = np.argsort(p)
    raised = np.asarray(p)[order] * np.arange(len(p), 0, -1)
    result = np.empty(len(p))
    result[order] = np.minimum(np.maximum.accumulate(raised), 1.0)
    return [float(one) for one in result]


def _with_drift(rows: Sequence[Row], dates: Sequence[str | None]) -> list[Row]:
    """The rows with a line over the days."""
    from scipy.stats import norm

    days = np.array([np.nan if d is None else (_when(d) - _when(dates[0] or d)) / DAY for d in dates])
    slopes: dict[str, tuple[float, float]] = {}
    for row in rows:
        value, std, which = _known(row)
        at = days[which]
        if len(np.unique(at)) < 3 or not np.isfinite(at).all():
            continue
        weight = 1 / std**2
        middle = np.average(at, weights=weight)
        spread = float(np.sum(weight * (at - middle) ** 2))
        slope = float(np.sum(weight * (at - middle) * value) / spread)
        left = (value - np.average(value, weights=weight) - slope * (at - middle)) / std
        birge = max(1.0, float(np.sqrt(np.sum(left**2) / (len(at) - 2))))
        slopes[row.name] = slope, birge / np.sqrt(spread)
    adjusted = holm([float(2 * norm.sf(abs(a / b))) for a, b in slopes.values()])
    found = dict(zip(slopes, adjusted, strict=True))
    return [
        replace(row, drift=slopes[row.name][0], drift_std=slopes[row.name][1], drift_p=found[row.name])
        if row.name in slopes
        else row
        for row in rows
    ]


# --- effects and errors ----------------------------------------------------------------------------------------


def _effects(runs: Sequence[Run]) -> Iterator[EffectRow]:
    sides = [
        {(e["effect"], place): e["certainty"] for e in run.result.get("effects", ()) for place in e["where"]}
        for run in runs
    ]
    for effect, place in dict.fromkeys(key for side in sides for key in side):
        certainty = tuple(side.get((effect, place)) for side in sides)
        first, last = certainty[0] is not None, certainty[-1] is not None
        became = "stayed" if all(c is not None for c in certainty) else "came and went"
        if first != last:
            became = "came" if last else "went"
        yield EffectRow(effect, place, certainty, became)


def _own_errors(runs: Sequence[Run]) -> Iterator[ErrorRow]:
    """Of each run's own held-out data."""
    parts = [(run.result.get("nominal") or {}, run.result.get("after") or {}) for run in runs]
    channels = dict.fromkeys(c for _, after in parts for c in after.get("holdout", {}))
    for channel in channels:
        nominal, rmse = (
            tuple((side[k].get("holdout", {}).get(channel) or {}).get("rmse") for side in parts) for k in (0, 1)
        )
        floors = [f for run in runs if (f := run.result.get("noise_floor", {}).get(channel)) is not None]
        unit = next((u for run in runs if (u := run.result.get("units", {}).get(channel))), "").partition(",")[0]
        yield ErrorRow("held out by each run", channel, unit, nominal, rmse, min(floors, default=None))


def _common_errors(
    runs: Sequence[Run], logs: Sequence[Log], robot: Robot | None, threads: int, remarks: list[str]
) -> Iterator[ErrorRow]:
    """Of logs that all runs' models are played against."""
    from sysid_btr.identify.scores import score_problem
    from sysid_btr.identify.study import make_study
    from sysid_btr.io.parquet import sha256
    from sysid_btr.models.robot import channel_units
    from sysid_btr.objectives.targets import COMPARED
    from sysid_btr.terms.model import Model
    from sysid_btr.writeback.params import read_params

    robot = _robot_of(runs) if robot is None else robot
    known = {sha256(log.path) for log in logs if log.path is not None and log.path.exists()}
    seen = [run.label for run in runs if known & run.fitted]
    if seen:
        remarks.append(f"the common log is one that {', '.join(seen)} {'was' if len(seen) == 1 else 'were'} fitted to")
    study = make_study(robot, logs, holdout=logs, channels=COMPARED, threads=threads)
    found = []
    for run in runs:
        params = read_params(run.folder, robot)
        own = replace(study, numerics=params.numerics)
        none = Model.of(())
        plain, fitted = (score_problem(own.train_problem(m), m.values) for m in (none, params.model))
        found.append((plain, fitted))
    names = ", ".join(log.path.name for log in logs if log.path is not None) or "the common log"
    units = channel_units(robot)
    for channel in found[0][1]:
        nominal, rmse = (_rmse(side[k][channel].rmse for side in found) for k in (0, 1))
        floor = found[0][1][channel].floor
        yield ErrorRow(names, channel, units[channel].partition(",")[0], nominal, rmse, floor)


def _rmse(values: Iterable[float]) -> tuple[float | None, ...]:
    return tuple(float(v) if np.isfinite(v) else None for v in values)


def _robot_of(runs: Sequence[Run]) -> Robot:
    """The robot that the runs name."""
    from sysid_btr.models.builtin import load_robot

    model, folder = runs[0].result["model"], runs[0].folder
    if model["path"] is None:
        return load_robot(model["name"])
    path = folder / model["path"]
    if not path.is_file():
        raise UsageError(f"the model of {runs[0].label} is no longer at {path}: give it with --model")
    return load_robot(str(path))
