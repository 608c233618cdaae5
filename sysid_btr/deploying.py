"""What was identified, for use elsewhere: compiled MuJoCo models, models drawn from what is known, and ranges.

>>> drawn = sb.sample("out", 100)  # doctest: +SKIP
>>> models = [sb.model("out", draw) for draw in drawn]  # doctest: +SKIP
>>> json.dump(sb.ranges("out"), file)  # doctest: +SKIP
"""

from __future__ import annotations

import os
import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from sysid_btr._typing import FloatArray
from sysid_btr.errors import UsageError
from sysid_btr.io.log import Log
from sysid_btr.models.robot import Robot
from sysid_btr.result import clean, read_result
from sysid_btr.run_folder import DRAWS
from sysid_btr.simulation.numerics import Numerics
from sysid_btr.terms.model import Model

if TYPE_CHECKING:
    import mujoco
    import pandas as pd

    from sysid_btr.diagnosis.closing import Closing
    from sysid_btr.identify.fit import Fit
    from sysid_btr.posterior.outcome import Posterior
    from sysid_btr.writeback.target import Target

    Source = Fit | Closing | Posterior | str | os.PathLike[str]

SCHEMA = "sysid_btr.ranges/1"
CENTRAL = (0.025, 0.975)
"""Quantiles of the draws that a range reaches to: the central 95 %."""
TRIES = 200
"""Rounds in which draws beyond a bound are drawn again."""
OBJECTS = {
    "body": "body", "dof": "joint", "jnt": "joint", "actuator": "actuator", "geom": "geom", "qpos": "joint",
    "site": "site", "tendon": "tendon",
}  # fmt: skip
"""First word of a field of MjModel -> what has a row there."""
DERIVED = (
    "subtree",
    "invweight",
    "_M0",
    "acc0",
    "_length",
    "simple",
    "sameframe",
    "bvh",
    "poscom",
    "_pos0",
    "D_",
    "efm0",
)
"""Parts of names of fields that MuJoCo works out from others."""


class IncompleteModelWarning(UserWarning):
    """A compiled model lacks what no MuJoCo model can hold."""


@dataclass(frozen=True, eq=False, repr=False)
class Samples(Sequence[Mapping[str, float]]):
    """Sets of parameters drawn from what a run knows of them; each is a mapping of name to value.

    Attributes
    ----------
    names : (p,) parameters, those of effects too.
    values : (n, p).
    fixed : names of those that are not identifiable, and that stay at the model's own value.
    """

    names: tuple[str, ...]
    values: FloatArray
    fixed: tuple[str, ...]

    def __len__(self) -> int:
        return len(self.values)

    def __getitem__(self, row: Any) -> Any:
        if isinstance(row, slice):
            return Samples(self.names, self.values[row], self.fixed)
        return dict(zip(self.names, map(float, self.values[row]), strict=True))

    def to_pandas(self) -> pd.DataFrame:
        """One row a draw, one column a parameter."""
        import pandas as pd

        return pd.DataFrame(self.values, columns=list(self.names))

    def __repr__(self) -> str:
        return f"<Samples: {len(self)} draws of {', '.join(self.names)}>"


def model(source: Source, draw: Mapping[str, float] | None = None) -> mujoco.MjModel:
    """The identified model, compiled: what ``model.xml`` holds, without a file.

    Parameters
    ----------
    source : an outcome of `fit`, `close` or `posterior`, or the folder of a finished run.
    draw : values by parameter, as `sample` gives them; those that are not named keep their estimates.

    Returns
    -------
    MjModel
        With the integrator and the step of the replay, and with its free joint where it has one.

    Raises
    ------
    UsageError
        For names that are no parameters of the run; where a folder's model or log is gone.

    Warns
    -----
    IncompleteModelWarning
        Names what MuJoCo has no element for (a law of every step, a change of what a sensor shows).
    """
    found = _Found.of(source)
    target = found.target(draw or {})
    lacking = [f"{p.term.called} at {', '.join(p.term.places)}: {p.how}" for p in target.parts if p.held == "no"]
    if lacking:
        warnings.warn(f"not in this model: {'; '.join(lacking)}", IncompleteModelWarning, stacklevel=2)
    return target.model


def sample(source: Source, n: int, *, seed: int = 0) -> Samples:
    """Draw sets of parameters, those of effects included, from what is known of them.

    Parameters
    ----------
    source : a posterior or the folder of one: its draws. A fit or a closing: normally distributed with the covariance
        of the estimates, within their bounds.
    n : how many.
    seed : of the random numbers.

    Raises
    ------
    UsageError
        If `n` is below one, or the folder holds no finished run.
    """
    if n < 1:
        raise UsageError(f"{n} draws: give one or more")
    return _Found.of(source).sample(n, np.random.default_rng(seed))


def ranges(source: Source, *, n: int = 200, seed: int = 0) -> dict[str, Any]:
    """Ranges, for domain randomisation, of parameters and of MuJoCo's own fields: the central 95 % of drawn models.

    Parameters
    ----------
    source, seed : as for `sample`.
    n : draws.

    Returns
    -------
    dict
        Ready for JSON. ``parameters``: name, unit, nominal, value, low, high, fixed. ``fields``: one entry a number of
        MjModel that varies: field (``body_mass``, ``dof_frictionloss``, ``actuator_gainprm``, ... as MuJoCo, MJX,
        MuJoCo Playground and mjlab name them), object, name, index, nominal, value, low, high. ``correlation`` of the
        draws: to draw each range by itself is wider than what is known. ``not_in_model``: effects without a field.
    """
    found = _Found.of(source)
    drawn = found.sample(n, np.random.default_rng(seed))
    low, high = np.quantile(drawn.values, CENTRAL, axis=0)
    with np.errstate(invalid="ignore"):
        correlation = np.atleast_2d(np.corrcoef(drawn.values.T)) if n > 1 else np.full((len(low), len(low)), np.nan)
    entries = [
        {
            **{k: p[k] for k in ("name", "unit", "nominal", "value")},
            "low": a,
            "high": b,
            "fixed": p["name"] in drawn.fixed,
        }
        for p, a, b in zip(found.parameters, low, high, strict=True)
    ]
    here = found.target({})
    plain = found.target({p["name"]: p["nominal"] for p in found.parameters}).model
    fields = list(_varied(plain, here.model, [found.target(draw).model for draw in drawn]))
    content: dict[str, Any] = clean(
        {
            "schema": SCHEMA,
            "robot": found.robot.name,
            "draws": n,
            "seed": seed,
            "numerics": found.numerics.to_dict(),
            "parameters": entries,
            "correlation": correlation,
            "fields": fields,
            "not_in_model": [p.term.called for p in here.parts if p.held == "no"],
        }
    )
    return content


@dataclass(frozen=True, eq=False)
class _Found:
    """A run's model, ready to be compiled at other values."""

    robot: Robot
    log: Log
    model: Model
    numerics: Numerics
    parameters: tuple[Mapping[str, Any], ...]
    covariance: FloatArray
    draws: FloatArray | None

    @classmethod
    def of(cls, source: Source) -> _Found:
        return _of_folder(Path(source)) if isinstance(source, str | os.PathLike) else _of_outcome(source)

    @cached_property
    def fixed(self) -> tuple[str, ...]:
        return tuple(p["name"] for p in self.parameters if p["identifiable"] == "no")

    def sample(self, n: int, rng: np.random.Generator) -> Samples:
        """Draws, with what is not identifiable at its value."""
        names = tuple(p["name"] for p in self.parameters)
        at = self.model.values
        values = np.tile(at, (n, 1))
        free = np.array([name not in self.fixed for name in names], dtype=bool)
        if self.draws is not None:
            values[:, free] = self.draws[rng.choice(len(self.draws), n, replace=n > len(self.draws))][:, free]
        elif free.any():
            values[:, free] = self._normal(at, free, n, rng)
        return Samples(names, values, self.fixed)

    def _normal(self, at: FloatArray, free: FloatArray, n: int, rng: np.random.Generator) -> FloatArray:
        """Normal draws within the bounds, (n, free)."""
        std = np.array([p["std"] or 0.0 for p in self.parameters])[free]
        matrix = self.covariance[np.ix_(free, free)]
        # where no correlation is known the errors are taken as independent
        matrix = np.where(np.isfinite(matrix), matrix, np.diag(std**2))
        lower, upper = self.model.terms.lower[free], self.model.terms.upper[free]
        drawn = rng.multivariate_normal(at[free], matrix, n, method="eigh")
        for _ in range(TRIES):
            beyond = np.any((drawn < lower) | (drawn > upper), axis=1)
            if not beyond.any():
                break
            drawn[beyond] = rng.multivariate_normal(at[free], matrix, int(beyond.sum()), method="eigh")
        return np.asarray(np.clip(drawn, lower, upper))

    def target(self, draw: Mapping[str, float]) -> Target:
        """The model at the estimates, or at the values of a draw, as MuJoCo can hold it."""
        from sysid_btr.writeback.target import make_parts, make_target

        names = self.model.terms.names
        unknown = [name for name in draw if name not in names]
        if unknown:
            raise UsageError(f"no parameter {', '.join(unknown)}; the run has {', '.join(names)}")
        values = np.array([draw.get(n, v) for n, v in zip(names, self.model.values, strict=True)], dtype=np.float64)
        parts = make_parts(self.robot, self.model.at(values), self.numerics)
        return make_target(self.robot, self.log, parts, self.numerics)


def _of_outcome(outcome: Fit | Closing | Posterior) -> _Found:
    from sysid_btr.posterior.outcome import Posterior
    from sysid_btr.saving import as_model
    from sysid_btr.writeback.write import identified

    known = identified(as_model(outcome))
    log = known.study.train[0].log
    draws = outcome.sample.flat if isinstance(outcome, Posterior) else None
    entries = tuple(clean(e.to_dict()) for e in outcome.estimates)
    return _Found(
        known.study.robot.for_log(log), log, known.model, known.study.numerics, entries, outcome.covariance, draws
    )


def _of_folder(folder: Path) -> _Found:
    from sysid_btr.io.parquet import read_log
    from sysid_btr.models.builtin import load_robot
    from sysid_btr.writeback.params import read_params

    result = read_result(folder)
    if result["kind"] not in ("fit", "close", "posterior"):
        raise UsageError(f"{folder} is a run of {result['kind']}: give one of fit, close or posterior")
    model = result["model"]
    path = None if model["path"] is None else folder / model["path"]
    if path is not None and not path.is_file():
        raise UsageError(f"{folder}: its model is no longer at {path}; put it back, or run again")
    robot = load_robot(model["name"] if path is None else str(path))
    fitted = next((entry for entry in result["logs"] if "train" in entry["used_for"] and entry["path"]), None)
    if fitted is None or not (folder / fitted["path"]).is_file():
        where = "of a log in memory" if fitted is None else f"of a log that is no longer at {folder / fitted['path']}"
        raise UsageError(f"{folder} is {where}; put it back, or give the outcome itself instead of its folder")
    log = read_log(folder / fitted["path"])
    params = read_params(folder, robot)
    effects = (p for e in result["effects"] for p in e["parameters"])
    by_name = {p["name"]: p for p in (*result["parameters"], *effects)}
    entries = tuple(by_name[name] for name in params.model.terms.names)
    order = [list(by_name).index(name) for name in params.model.terms.names]
    matrix = np.array(result["covariance"], dtype=np.float64).reshape(len(by_name), len(by_name))
    draws = _stored(folder / DRAWS, params.model.terms.names) if result["kind"] == "posterior" else None
    return _Found(robot.for_log(log), log, params.model, params.numerics, entries, matrix[np.ix_(order, order)], draws)


def _stored(path: Path, names: Sequence[str]) -> FloatArray:
    """Draws (n, p) of posterior.nc."""
    from sysid_btr.optional import optional
    from sysid_btr.posterior.export import variable_name

    xarray = optional("xarray", "posterior", DRAWS)
    with xarray.open_datatree(path, engine="h5netcdf") as tree:
        return np.stack([np.ravel(tree["posterior"][variable_name(name)].values) for name in names], axis=1)


def _varied(plain: mujoco.MjModel, here: mujoco.MjModel, drawn: Sequence[mujoco.MjModel]) -> Iterator[dict[str, Any]]:
    """Numbers of MjModel that the draws vary, but for those that follow from others."""
    for field in (name for name in dir(here) if name.partition("_")[0] in OBJECTS):
        own = getattr(here, field)
        derived = any(part in field for part in DERIVED)
        if derived or not isinstance(own, np.ndarray) or own.dtype != np.float64 or own.size == 0:
            continue
        stack = np.stack([getattr(other, field) for other in drawn])
        for index in np.argwhere(np.ptp(stack, axis=0) > 0):
            at = tuple(int(i) for i in index)
            low, high = np.quantile([getattr(other, field)[at] for other in drawn], CENTRAL)
            before = getattr(plain, field)
            yield {
                "field": field,
                "object": OBJECTS[field.partition("_")[0]],
                "name": _name(here, field, at[0]),
                "index": list(at),
                "nominal": float(before[at]) if before.shape == own.shape else None,
                "value": float(own[at]),
                "low": float(low),
                "high": float(high),
            }


def _name(model: mujoco.MjModel, field: str, row: int) -> str:
    """What has this row of a field."""
    kind = field.partition("_")[0]
    if kind == "dof":
        row = int(model.dof_jntid[row])
    elif kind == "qpos":
        row = int(np.searchsorted(model.jnt_qposadr, row, side="right") - 1)
    return str(getattr(model, OBJECTS[kind])(row).name)
