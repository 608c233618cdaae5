"""Logs on disk: Parquet, schema 1."""

from __future__ import annotations

import hashlib
import json
import os
import secrets
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from sysid_btr._typing import FloatArray
from sysid_btr.errors import LogError, UsageError
from sysid_btr.io._file import METADATA_KEY, load
from sysid_btr.io.log import Log, meta_to_json
from sysid_btr.io.problem import errors_of, explain
from sysid_btr.io.validation import validate_log

if TYPE_CHECKING:
    import pyarrow as pa


def read_log(path: str | os.PathLike[str], *, check: bool = True, drives: Mapping[str, str] | None = None) -> Log:
    """Read a log.

    Parameters
    ----------
    path : path-like
        A Parquet file that follows the log schema.
    check : bool
        Also validate the content, and refuse a log with an error in it. Warnings never refuse a log;
        see `sysid_btr.io.validate_file` for all findings.
    drives : mapping of str to {"position", "velocity", "torque"}, optional
        What a command of a joint is to the robot's drives, as of `validate_log`.

    Returns
    -------
    Log
        With SI units, NaN for missing values, and unknown columns and metadata kept.

    Raises
    ------
    LogError
        If the file is missing, not Parquet, truncated, of another schema version, empty or without
        metadata, or, with `check`, if its content has errors. The message lists all of them at once.
    """
    log, problems = load(Path(path))
    if check and log is not None:
        problems += validate_log(log, drives=drives)
    errors = errors_of(problems)
    if errors or log is None:
        raise LogError(explain(path, errors))
    return log


def write_log(log: Log, path: str | os.PathLike[str], *, overwrite: bool = False) -> None:
    """Write a log, all or nothing: the file appears complete or not at all.

    Parameters
    ----------
    log : Log
        The log; unknown columns and metadata are written too, ``episode`` only where it is not all zeros.
    path : path-like
        Where to; the folder must exist.
    overwrite : bool
        Whether an existing file may be replaced.

    Raises
    ------
    UsageError
        If the file exists and `overwrite` is false, or the folder does not exist or cannot be written.
    LogError
        If an unknown column holds values Parquet cannot store.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    path = Path(path)
    if path.exists() and not overwrite:
        raise UsageError(f"{path} exists and is not overwritten; choose another name or allow overwriting")
    if not path.parent.is_dir():
        raise UsageError(f"cannot write {path}: the folder {path.parent} does not exist; create it first")
    columns: dict[str, pa.Array] = {"time": pa.array(np.asarray(log.time, dtype=np.float64))}
    if np.any(log.episode != 0):
        columns["episode"] = pa.array(np.asarray(log.episode, dtype=np.int64))
    for name, values in log.channels.items():
        columns[name] = _column(name, values)
    for name, values in log.unknown.items():
        try:
            columns[name] = pa.array(values)
        except (pa.ArrowException, TypeError) as error:
            raise LogError(f"cannot write {path}: column {name} cannot be stored as Parquet ({error})") from error
    table = pa.table(columns).replace_schema_metadata({METADATA_KEY: json.dumps(meta_to_json(log.meta)).encode()})

    part = path.with_name(f".{path.name}.{secrets.token_hex(4)}.part")
    try:
        with part.open("xb") as file:
            pq.write_table(table, file)
            file.flush()
            os.fsync(file.fileno())
        part.replace(path)
    except OSError as error:
        reason = error.strerror or error
        raise UsageError(f"cannot write {path}: {reason}; choose a writable folder with enough space") from error
    finally:
        part.unlink(missing_ok=True)


def sha256(path: str | os.PathLike[str]) -> str:
    """SHA-256 of a file's bytes, in hexadecimal.

    Raises
    ------
    LogError
        If the file cannot be read.
    """
    try:
        with Path(path).open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise LogError(f"cannot read {path}: {error.strerror}") from error


def _column(name: str, values: FloatArray) -> pa.Array:
    import pyarrow as pa

    values = np.asarray(values, dtype=np.float64)
    if name.startswith("enabled.") and np.all((values == 0) | (values == 1) | np.isnan(values)):
        return pa.array(values == 1, mask=np.isnan(values))
    return pa.array(values)
