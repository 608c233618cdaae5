"""``sysid-btr report``."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

from sysid_btr.cli.options import Options, argument
from sysid_btr.errors import UsageError


@dataclass(frozen=True, kw_only=True)
class ReportOptions(Options):
    """Options of `report`."""

    folder: Path = argument(..., "The --out folder of a finished run.", metavar="DIR")


def report(options: ReportOptions) -> int:
    """Write the reports of a finished run again.

    report.html and explore.html, from the result.json, pictures and series that the run left in its folder.
    """
    from jinja2 import TemplateError

    from sysid_btr.report.pictures import write_report
    from sysid_btr.result import read_result
    from sysid_btr.run_folder import RESULT, Folder

    result = read_result(options.folder)
    folder = options.folder if options.folder.is_dir() else options.folder.parent
    try:
        page = write_report(Folder(folder), result)
    except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError, TemplateError) as error:
        raise UsageError(
            f"{folder / RESULT} was changed and cannot be shown ({type(error).__name__}: {error}); give the "
            "--out folder of a finished run as it was written"
        ) from error
    sys.stdout.write(f"{page}\n")
    return 0
