"""``sysid-btr init``."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

from sysid_btr.cli.groups import ModelOptions
from sysid_btr.cli.inputs import find_robot, output_file, read_logs, warn_of
from sysid_btr.cli.options import argument, option
from sysid_btr.cli.terminal import remark


@dataclass(frozen=True, kw_only=True)
class InitOptions(ModelOptions):
    """Options of `init`."""

    files: tuple[Path, ...] = argument((), "Logs of one robot.", metavar="LOG...")
    out: Path | None = option(
        None, "Study file to write; without it, standard output.", short="-o", metavar="FILE", decides=False
    )
    overwrite: bool = option(False, "Replace the file at --out.", decides=False)


def init(options: InitOptions) -> int:
    """Write a commented study file for a log, ready to run.

    It says line by line what the log holds and which parameters it may identify. Run it with sysid-btr fit
    --config FILE, or close --config FILE.
    """
    from sysid_btr.cli.proposal import study_file
    from sysid_btr.run_folder import Folder

    robot = find_robot(options)
    logs = read_logs(options.files, robot)
    target = output_file(options.out, options.files, options.overwrite)
    warn_of(robot, logs)
    text = study_file(robot, logs, options.model or robot.name, target)
    if target is None:
        sys.stdout.write(text)
        return 0
    Folder(target.parent).write(target.name, text)
    remark(f"study file: {target}; next: sysid-btr close --config {target}")
    return 0
