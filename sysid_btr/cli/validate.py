"""``sysid-btr validate``."""

from __future__ import annotations

import sys
from collections import Counter
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from sysid_btr.cli.groups import JsonOptions, LogOptions, ModelOptions
from sysid_btr.cli.inputs import find_robot
from sysid_btr.cli.options import argument
from sysid_btr.cli.terminal import print_json
from sysid_btr.errors import LogError, UsageError


@dataclass(frozen=True, kw_only=True)
class ValidateOptions(LogOptions, ModelOptions, JsonOptions):
    """Options of `validate`."""

    files: tuple[Path, ...] = argument((), "Logs to check.", metavar="[FILE]...")


def validate(options: ValidateOptions) -> int:
    """List every problem of a log, where it is, and what to do.

    Exit 3 if there are errors; warnings and notes leave a log usable.
    """
    from sysid_btr.io.problem import errors_of
    from sysid_btr.io.validation import validate_file
    from sysid_btr.models.log_checks import check_log

    paths = [*options.files, *options.log]
    if not paths:
        raise UsageError("which log? Give one or more files: sysid-btr validate walk.parquet")
    check = None if options.model is None else partial(check_log, find_robot(options))
    found = {path: validate_file(path, check=check) for path in paths}
    if options.json:
        print_json({str(path): problems for path, problems in found.items()})
    else:
        from sysid_btr.display.text import console, problems_table

        out = console(sys.stdout)
        for path, problems in found.items():
            numbers = Counter(problem.severity for problem in problems)
            counts = [_count(numbers[kind], kind) for kind in ("error", "warning")]
            counts += [_count(numbers["note"], "note")] if numbers["note"] else []
            out.print(f"{path}: {', '.join(counts)}")
            if problems:
                out.print(problems_table(problems))
    return LogError.exit_code if any(errors_of(problems) for problems in found.values()) else 0


def _count(number: int, noun: str) -> str:
    return f"{number} {noun}{'' if number == 1 else 's'}"
