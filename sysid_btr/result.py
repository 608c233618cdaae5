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
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np

from sysid_btr.errors import UsageError
from sysid_btr.reading import parse_json
from sysid_btr.version import __version__

SCHEMA = "sysid_btr.result/1"


def result_schema() -> dict[str, Any]:
    """The JSON schema of result.json (draft 2020-12): every name it may hold, with what it means."""
    text = files("sysid_btr").joinpath("result.schema.json").read_text(encoding="utf-8")
    schema: dict[str, Any] = json.loads(text)
    return schema


def versions() -> dict[str, str]:
    """Versions of what the numbers depend on."""
    import mujoco
    import scipy

    return {
        "sysid_btr": __version__,
        "python": platform.python_version(),
        "mujoco": str(mujoco.__version__),
        "numpy": np.__version__,
        "scipy": scipy.__version__,
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
    if value is None:
        return None
    if isinstance(value, str):  # names of files may hold bytes that are no text
        return value.encode("utf-8", "backslashreplace").decode("utf-8")
    raise TypeError(f"{type(value).__name__} cannot be part of a result: {value!r}")


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
        content = parse_json(file.read_text(encoding="utf-8"))
    except OSError as error:
        began = (file.parent / "journal.jsonl").exists() or (file.parent / "journals").is_dir()
        todo = (
            "the run in this folder has not finished: repeat its command with --resume"
            if began
            else "give the --out folder of a finished run"
        )
        raise UsageError(f"cannot read {file}: {error.strerror}; {todo}") from error
    except UnicodeDecodeError:
        raise UsageError(f"{file} is not a result; give the --out folder of a finished run") from None
    except ValueError as error:
        raise UsageError(f"{file} is not JSON ({error}); give the result.json of a finished run") from error
    schema = content.get("schema") if isinstance(content, dict) else None
    if schema != SCHEMA:
        raise UsageError(f"{file} has schema {schema!r}; this version reads {SCHEMA!r}")
    result: dict[str, Any] = content
    return result


def exit_code(result: Mapping[str, Any]) -> int:
    """0, or 5 where a finished run identified nothing: not converged, or not one parameter or effect identifiable.

    A parameter that is not identifiable beside others that are is a finding, not a failure.
    """
    if result.get("converged") is False:
        return 5
    parameters = result["parameters"]
    identifiable = any(p["identifiable"] != "no" for p in parameters)
    return 5 if parameters and not identifiable and not result["effects"] else 0
