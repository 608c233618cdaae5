"""``sysid-btr import``."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from sysid_btr.cli.groups import ModelOptions
from sysid_btr.cli.inputs import output_file
from sysid_btr.cli.kinds import Texts
from sysid_btr.cli.options import argument, option
from sysid_btr.cli.terminal import print_json, remark
from sysid_btr.errors import LogError

if TYPE_CHECKING:
    from sysid_btr.io.importers.run import Imported


@dataclass(frozen=True, kw_only=True)
class ImportOptions(ModelOptions):
    """Options of `import`."""

    files: tuple[Path, ...] = argument((), "Logs of other formats, or folders of bags and datasets.", metavar="FILE...")
    format: str = option(
        "auto",
        "Format of the files: auto (by content), naoqi, ros2, mcap, lerobot, csv (also Parquet), or an installed one.",
        metavar="NAME",
        decides=False,
    )
    preset: str | None = option(
        None, "Mapping that comes with the package; --map and flags go on top of it.", metavar="NAME", decides=False
    )
    show_preset: str | None = option(
        None,
        "Print a preset, to copy and edit, and do nothing else; `all` lists all presets.",
        metavar="NAME",
        decides=False,
    )
    map: Path | None = option(
        None, "Mapping (TOML): columns, units, joints, topics, metadata.", metavar="FILE", decides=False
    )
    rename: Texts = option({}, "Joint A of the file is joint B of the model.", metavar="A=B", decides=False)
    unit: Texts = option(
        {},
        "Unit of a channel or column, e.g. position=deg, time=ms, velocity.knee=rpm.",
        metavar="CHANNEL=UNIT",
        decides=False,
    )
    mount: str | None = option(
        None, "Whether the torso was fixed or free to move.", metavar="fixed|free", decides=False
    )
    out: Path | None = option(
        None, "Log to write (Parquet); without it nothing is written.", short="-o", metavar="FILE", decides=False
    )
    overwrite: bool = option(False, "Replace the file at --out.", decides=False)
    force: bool = option(False, "Write the log even if it has errors, e.g. to repair it.", decides=False)
    json: bool = option(False, "Print what was found as JSON.", decides=False)


def import_(options: ImportOptions) -> int:
    """Convert logs of other formats, and check them.

    Several files are episodes of one log. Every unrecognised column or topic is reported. For a table whose
    columns cannot be guessed, a mapping file to fill in is printed. A log with errors is not written (exit 3),
    unless --force is given.
    """
    if options.show_preset is not None:
        sys.stdout.write(_preset(options.show_preset))
        return 0
    from sysid_btr.importing import known_model
    from sysid_btr.io.importers.base import MappingNeeded
    from sysid_btr.io.importers.mapping import read_map, with_flags
    from sysid_btr.io.importers.run import import_log

    target = output_file(options.out, options.files, options.overwrite)
    known = known_model(options.model)
    told = with_flags(
        read_map(options.map, options.preset),
        units=options.unit.items(),
        renames=options.rename.items(),
        meta={"mount": options.mount},
    )
    try:
        imported = import_log(options.files, importer=options.format, told=told, model=known)
    except MappingNeeded as error:
        proposed = error.propose(known.joints if known else None)
        if options.json:
            print_json({"mapping": proposed})
        else:
            sys.stdout.write(proposed)
        raise
    for text in imported.remarks:
        remark(text)
    written = target if imported.usable or options.force else None
    if written is not None:
        from sysid_btr.io.parquet import write_log

        write_log(imported.log, written, overwrite=options.overwrite)
    _show(imported, written, options.json)
    _say_what_was_done(imported, target, written)
    return 0 if imported.usable else LogError.exit_code


def _preset(name: str) -> str:
    """The text of a preset; ``all``: a line for each."""
    from sysid_btr.io.importers.presets import available_presets, preset_text, preset_title

    if name != "all":
        return preset_text(name)
    return "".join(f"{known:18} {preset_title(known)}\n" for known in available_presets())


def _show(imported: Imported, written: Path | None, as_json: bool) -> None:
    from sysid_btr.display.text import console, problems_table
    from sysid_btr.report.imported import as_json as to_dict
    from sysid_btr.report.imported import summary

    if as_json:
        print_json(to_dict(imported, written))
        return
    screen = console(sys.stdout)
    for line in summary(imported):
        screen.print(line)
    if imported.problems:
        screen.print(problems_table(imported.problems))


def _say_what_was_done(imported: Imported, target: Path | None, written: Path | None) -> None:
    if written is not None:
        remark(f"log: {written}")
    elif target is None:
        remark("nothing is written without --out")
    if imported.advice:
        remark(f"what may put it right (check each): {' '.join(imported.advice)}")
    if not imported.usable:
        remark("the log has errors" + (", and is written all the same" if written else ": it is not written"))
