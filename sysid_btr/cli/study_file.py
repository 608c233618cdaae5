"""The study file: every flag of the command line in TOML, so that a study can be kept beside its logs.

Keys are the flags' names, with ``-`` or ``_``. Model, logs and held-out logs are looked for beside the file first,
then where the command runs.
"""

from __future__ import annotations

import difflib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from sysid_btr.cli.options import Option
from sysid_btr.errors import UsageError
from sysid_btr.reading import parse_toml

MAPPING = frozenset({"columns", "meta", "table", "time", "units"})
"""Sections that the mapping file of an import has, and a study file has not."""


def read_study_file(path: Path, known: Mapping[str, Option]) -> dict[str, Any]:
    """What a study file gives instead of the flags of the command line.

    Parameters
    ----------
    path : of the file.
    known : every option that a study file may have, by name.

    Raises
    ------
    UsageError
        If it cannot be read, is not TOML, or holds a key or value that no flag has; all of them at once.
    """
    try:
        content = parse_toml(path.read_bytes())
    except OSError as error:
        raise UsageError(f"--config {path}: {error.strerror}") from error
    except ValueError as error:
        raise UsageError(f"--config {path} is not TOML: {error}") from error
    content = {key.replace("-", "_"): value for key, value in content.items()}
    problems = [problem for key, value in content.items() for problem in _problems(key, value, known)]
    sections = ", ".join(sorted(MAPPING & set(content)))
    if problems and sections:
        raise UsageError(
            f"--config {path} is a mapping for `sysid-btr import` (it has {sections}): give it with --map; "
            "`sysid-btr init LOG --model M` writes a study file"
        )
    if problems:
        listing = "\n".join(f"  {problem}" for problem in problems)
        raise UsageError(f"--config {path}:\n{listing}\nkeys of a study file: {', '.join(known)}")
    return {key: _given(known[key], value, path.parent) for key, value in content.items()}


def _problems(key: str, value: Any, known: Mapping[str, Option]) -> list[str]:
    if key not in known:
        close = difflib.get_close_matches(key, known, n=1)
        return [f"{key}: unknown key{f'; did you mean {close[0]}?' if close else ''}"]
    kind = known[key].kind
    return [f"{key}{place}: {value!r} is not allowed; expected {kind.expected}" for place in kind.wrong(value)]


def _given(option: Option, value: Any, folder: Path) -> Any:
    given = option.kind.given(value)
    if not option.beside:
        return given
    return [_beside(folder, name) for name in given] if isinstance(given, list) else _beside(folder, given)


def _beside(folder: Path, name: str) -> str:
    beside = folder / name
    return str(beside) if beside.exists() else name


def toml(value: Any) -> str:
    """A value of a study file; JSON writes text, numbers and lists alike, but for the character DEL."""
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
