"""``sysid-btr report``."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

from sysid_btr.cli.options import Options, argument


@dataclass(frozen=True, kw_only=True)
class ReportOptions(Options):
    """Options of `report`."""

    folder: Path = argument(..., "The --out folder of a finished run.", metavar="DIR")


def report(options: ReportOptions) -> int:
    """Write report.html again from result.json and the pictures of a finished run of any verb."""
    from sysid_btr.report.pictures import write_report
    from sysid_btr.result import read_result
    from sysid_btr.run_folder import Folder

    sys.stdout.write(f"{write_report(Folder(options.folder), read_result(options.folder))}\n")
    return 0
