"""Logs: schema, Parquet files, validation, resampling and splits."""

from __future__ import annotations

from sysid_btr.io.log import Log, LogMeta
from sysid_btr.io.parquet import read_log, sha256, write_log
from sysid_btr.io.resample import command_at, resample
from sysid_btr.io.split import holdout_split
from sysid_btr.io.validation import Problem, validate_file, validate_log

__all__ = [
    "Log",
    "LogMeta",
    "Problem",
    "command_at",
    "holdout_split",
    "read_log",
    "resample",
    "sha256",
    "validate_file",
    "validate_log",
    "write_log",
]
