"""Everything that result.json holds, as pandas DataFrames."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import pandas as pd

STAGES = ("nominal", "before", "after")
"""Models that a result compares."""
MATRICES = ("covariance", "correlation")
LISTS = ("parameters", "effects", "candidates", "steps", "changes")
"""Tables that every result of a fit has, empty where there is nothing."""
ENDS = ("ci95", "bounds")
"""Pairs that become two columns."""


def to_tables(result: Mapping[str, Any]) -> dict[str, pd.DataFrame]:
    """A result as DataFrames, by name.

    Parameters
    ----------
    result : content of result.json.

    Returns
    -------
    dict of str to DataFrame
        ``parameters``: one row a parameter, by name, those of effects too (column ``effect``); intervals as
        ``ci95_low`` and ``ci95_high``. ``effects``, ``candidates``, ``steps``, ``changes``: as in result.json.
        ``errors``: rmse, nrmse and chi2 by part of the data, channel and model (nominal, before, after), with the noise
        floor. ``joints``: rmse of each joint. ``covariance``, ``correlation``: by name of parameter. ``run``: one row
        with all that is a single value. Further lists of a result are tables of their own name.
    """
    import pandas as pd

    parameters = pd.DataFrame([_flat(p) | {"effect": effect} for effect, p in _parameters(result)])
    found = {"parameters": parameters.set_index("name") if len(parameters) else parameters}
    found |= {"errors": pd.DataFrame(_errors(result)), "joints": pd.DataFrame(_joints(result))}
    for name in MATRICES:
        if result.get(name) is not None:
            names = list(parameters.get("name", ()))
            found[name] = pd.DataFrame(result[name], index=names, columns=names, dtype=float)
    rest: dict[str, Any] = {}
    for name, value in result.items():
        if name in (*found, *STAGES):
            continue
        if name in LISTS or _is_table(value):
            found[name] = pd.DataFrame([_flat(entry, without=("parameters",)) for entry in value or ()])
        else:
            rest[name] = value
    return {**found, "run": pd.DataFrame([_flat(rest)])}


def _parameters(result: Mapping[str, Any]) -> Iterator[tuple[str | None, Mapping[str, Any]]]:
    """Every parameter, with the effect that it is of."""
    yield from ((None, p) for p in result.get("parameters", ()))
    for effect in result.get("effects", ()):
        yield from ((effect["effect"], p) for p in effect["parameters"])


def _errors(result: Mapping[str, Any]) -> Iterator[dict[str, Any]]:
    for model, part, channel, score in _scores(result):
        numbers = {name: value for name, value in score.items() if name != "joints"}
        floor = result.get("noise_floor", {}).get(channel)
        yield {"part": part, "channel": channel, "model": model, **numbers, "noise_floor": floor}


def _joints(result: Mapping[str, Any]) -> Iterator[dict[str, Any]]:
    for model, part, channel, score in _scores(result):
        for joint, rmse in score.get("joints", {}).items():
            yield {"part": part, "channel": channel, "model": model, "joint": joint, "rmse": rmse}


def _scores(result: Mapping[str, Any]) -> Iterator[tuple[str, str, str, Mapping[str, Any]]]:
    """Model, part of the data, channel and scores."""
    for model in STAGES:
        for part, channels in (result.get(model) or {}).items():
            yield from ((model, part, channel, score) for channel, score in channels.items())


def _is_table(value: Any) -> bool:
    return isinstance(value, list) and bool(value) and all(isinstance(entry, Mapping) for entry in value)


def _flat(entry: Mapping[str, Any], prefix: str = "", without: Sequence[str] = ()) -> dict[str, Any]:
    """An entry's values by name, those of inner tables as ``outer.inner``; lists of texts joined."""
    flat: dict[str, Any] = {}
    for key, value in entry.items():
        name = f"{prefix}{key}"
        if key in without:
            continue
        if isinstance(value, Mapping):
            flat |= _flat(value, f"{name}.")
        elif key in ENDS and isinstance(value, list | tuple) and len(value) == 2:
            flat |= {f"{name}_low": value[0], f"{name}_high": value[1]}
        elif isinstance(value, list) and all(isinstance(item, str) for item in value):
            flat[name] = ", ".join(value)
        else:
            flat[name] = value
    return flat
