"""``sysid-btr compare``."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

from sysid_btr.cli.groups import JsonOptions, ModelOptions, ReadingOptions, ThreadOptions
from sysid_btr.cli.inputs import as_stated, find_robot, read_logs, warn_of
from sysid_btr.cli.kinds import Names
from sysid_btr.cli.options import argument, option
from sysid_btr.cli.terminal import print_json, remark
from sysid_btr.errors import UsageError

PAGE, CONTENT = "compare.html", "compare.json"
CSV = ("parameters", "effects", "errors")


@dataclass(frozen=True, kw_only=True)
class CompareOptions(ModelOptions, ReadingOptions, ThreadOptions, JsonOptions):
    """Options of `compare`."""

    runs: tuple[Path, ...] = argument((), "The --out folders of two finished runs or more.", metavar="RUN...")
    dates: Names = option(
        (),
        "When each run's log was recorded, ISO 8601.",
        otherwise="as the logs say, if they do",
        metavar="DATE,DATE[,..]",
        decides=False,
    )
    out: Path | None = option(
        None, f"Folder for {PAGE}, {CONTENT} and the tables as CSV.", short="-o", metavar="DIR", decides=False
    )
    overwrite: bool = option(False, "Replace an earlier comparison in --out.", decides=False)


def compare(options: CompareOptions) -> int:
    """Compare finished runs of one robot: what differs, what drifts.

    Parameters side by side, which differences are real, and which effects came or went; with --log also the error of
    every run's model on a common log.
    """
    from sysid_btr.comparing import compare as compare_runs

    if len(options.runs) < 2:
        raise UsageError("which runs? Give the --out folders of two or more: sysid-btr compare monday friday")
    _check_free(options)
    robot = None if options.model is None else find_robot(options)
    logs = as_stated(read_logs(options.log, robot), options) if options.log else []
    if robot is not None:
        warn_of(robot, logs)
    found = compare_runs(options.runs, logs=logs, robot=robot, dates=options.dates or None, threads=options.threads)
    content = found.to_dict()
    if options.json:
        print_json(content)
    else:
        from sysid_btr.display.comparison import show
        from sysid_btr.display.text import console

        out = console(sys.stdout)
        for part in show(content):
            out.print(part)
    if options.out is not None:
        from sysid_btr.display.comparison import page
        from sysid_btr.result import to_json
        from sysid_btr.run_folder import Folder

        folder = Folder(options.out)
        folder.write(CONTENT, to_json(content))
        for table in CSV:
            folder.write(f"{table}.csv", found.to_pandas(table).to_csv(index=False))
        remark(f"comparison: {folder.write(PAGE, page(content))}")
    return 0


def _check_free(options: CompareOptions) -> None:
    """Make the folder; refuse one with an earlier comparison before any work."""
    out = options.out
    if out is None:
        return
    if out.exists() and not out.is_dir():
        raise UsageError(f"--out {out} is a file; give a folder")
    if (out / CONTENT).exists() and not options.overwrite:
        raise UsageError(f"--out {out} already holds a comparison; --overwrite replaces it, or choose another folder")
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UsageError(f"--out {out} cannot be created: {error.strerror}; choose another folder") from error
