"""The study file: every flag of the command line in TOML, so that a study can be kept beside its logs."""

from __future__ import annotations

import difflib
import tomllib
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator

from sysid_btr.errors import UsageError

MAPPING = frozenset({"columns", "meta", "table", "time", "units"})
"""Sections that the mapping file of an import has, and a study file has not."""


class StudyFile(BaseModel):
    """What a study file may hold; keys are the flags' names, with ``-`` or ``_``.

    Paths of model, logs and held-out logs are looked for beside the file first, then where the command runs.
    """

    model_config = ConfigDict(extra="forbid", strict=True)

    model: str | None = None
    log: str | list[str] | None = None
    holdout: float | str | list[str] | None = None
    fit: str | list[str] | None = None
    effects: str | list[str] | None = None
    start: dict[str, float] | None = None
    params: str | None = None
    bounds: dict[str, tuple[float, float]] | None = Field(default=None)
    priors: dict[str, str] | None = None
    set: dict[str, float] | None = None
    channels: str | list[str] | None = None
    estimator: str | None = None
    distance: str | None = None
    max_evaluations: int | None = None
    ensembles: int | None = None
    walkers: int | None = None
    profile: str | list[str] | None = None
    robot_sim: str | None = None
    robot_set: dict[str, float] | None = None
    exchange: str | None = None
    wait: float | None = None
    iterations: int | None = None
    trials: int | None = None
    duration: float | None = None
    choice: str | None = None
    search: str | None = None
    model_search: str | None = None
    requirement: float | None = None
    close: bool | None = None
    seconds: float | None = None
    rate: float | None = None
    noise: float | None = None
    joints: str | list[str] | None = None
    margin: float | None = None
    max_velocity: float | None = None
    max_acceleration: float | None = None
    criterion: str | None = None
    seed: int | None = None
    threads: int | None = None
    executor: str | None = None
    out: str | None = None
    json_: bool | None = Field(default=None, alias="json")
    resume: bool | None = None
    overwrite: bool | None = None
    render: bool | None = None

    @field_validator("bounds", mode="before")
    @classmethod
    def _as_pair(cls, value: Any) -> Any:
        """TOML has lists only; strict mode wants tuples."""
        if not isinstance(value, dict):
            return value
        return {k: tuple(map(float, v)) if _two_numbers(v) else v for k, v in value.items()}

    def flags(self, folder: Path) -> dict[str, Any]:
        """Defaults for the command line's parameters, as text where the command line takes text."""
        flags: dict[str, Any] = {
            "log": [_beside(folder, p) for p in _listed(self.log)],
            "holdout": [_beside(folder, p) for p in _listed(self.holdout)],
            "free": _listed(self.fit),
            "effects": _listed(self.effects),
            "channels": _listed(self.channels),
            "start": [f"{name}={value!r}" for name, value in (self.start or {}).items()],
            "set_": [f"{name}={value!r}" for name, value in (self.set or {}).items()],
            "robot_set": [f"{name}={value!r}" for name, value in (self.robot_set or {}).items()],
            "robot_sim": None if self.robot_sim is None else _beside(folder, self.robot_sim),
            "bounds": [f"{name}={low!r}:{high!r}" for name, (low, high) in (self.bounds or {}).items()],
            "priors": [f"{name}={prior}" for name, prior in (self.priors or {}).items()],
            "profile": _listed(self.profile),
            "joints": _listed(self.joints),
            "model": None if self.model is None else _beside(folder, self.model),
            "params": None if self.params is None else _beside(folder, self.params),
            **{
                name: getattr(self, name)
                for name in (
                    "estimator",
                    "distance",
                    "max_evaluations",
                    "ensembles",
                    "walkers",
                    "exchange",
                    "wait",
                    "iterations",
                    "trials",
                    "duration",
                    "choice",
                    "search",
                    "model_search",
                    "requirement",
                    "close",
                    "seconds",
                    "rate",
                    "noise",
                    "margin",
                    "max_velocity",
                    "max_acceleration",
                    "criterion",
                    "seed",
                    "threads",
                    "executor",
                    "out",
                )
            },
            "as_json": self.json_,
            "resume": self.resume,
            "overwrite": self.overwrite,
            "render": self.render,
        }
        return {name: value for name, value in flags.items() if value is not None and value != []}


def read_study_file(path: Path) -> dict[str, Any]:
    """Defaults that a study file gives to the command line.

    Raises
    ------
    UsageError
        If it cannot be read, is not TOML, or holds a key or value that no flag has; all of them at once.
    """
    try:
        with path.open("rb") as file:
            content = tomllib.load(file)
    except OSError as error:
        raise UsageError(f"--config {path}: {error.strerror}") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise UsageError(f"--config {path} is not TOML: {error}") from error
    try:
        study = StudyFile.model_validate({key.replace("-", "_"): value for key, value in content.items()})
    except ValidationError as error:
        known = [f.alias or name for name, f in StudyFile.model_fields.items()]
        listing = "\n".join(dict.fromkeys(f"  {_in_words(e, content, known)}" for e in error.errors()))
        sections = ", ".join(sorted(MAPPING & set(content)))
        if sections:
            raise UsageError(
                f"--config {path} is a mapping for `sysid-btr import` (it has {sections}): give it with --map; "
                "`sysid-btr init LOG --model M` writes a study file"
            ) from error
        raise UsageError(f"--config {path}:\n{listing}\nkeys of a study file: {', '.join(known)}") from error
    return study.flags(path.parent)


def _in_words(error: Any, content: dict[str, Any], known: list[str]) -> str:
    """One finding of the validation."""
    key = str(error["loc"][0])
    if error["type"] == "extra_forbidden":
        close = difflib.get_close_matches(key, known, n=1)
        return f"{key}: no such key{f'; did you mean {close[0]}?' if close else ''}"
    given = content.get(key, content.get(key.replace("_", "-")))
    # a part of the place only says which alternative of a type was tried
    inner = [str(part) for part in error["loc"][1:] if isinstance(given, dict) and part in given]
    allowed = str(StudyFile.model_fields.get(key, StudyFile.model_fields["json_"]).annotation)
    wanted = next((words for kind, words in KINDS if kind in allowed), "true or false")
    return f"{'.'.join([key, *inner])}: {given!r} is not allowed; expected {wanted}"


KINDS = (
    ("tuple[float", "a table of name = [low, high]"),
    ("dict[str, float]", "a table of name = number"),
    ("dict[str, str]", "a table of name = text"),
    ("float | str | list", "a fraction, a file or a list of files"),
    ("list[str]", "text or a list of texts"),
    ("bool", "true or false"),
    ("int", "a whole number"),
    ("float", "a number"),
    ("str", "text"),
)
"""Type of a key -> what may be written there."""


def _two_numbers(value: Any) -> bool:
    return (
        isinstance(value, list)
        and len(value) == 2
        and all(isinstance(v, int | float) and not isinstance(v, bool) for v in value)
    )


def _listed(value: float | str | list[str] | None) -> list[str]:
    if value is None:
        return []
    return value if isinstance(value, list) else [str(value)]


def _beside(folder: Path, name: str) -> str:
    beside = folder / name
    return str(beside) if beside.exists() else name
