"""Logs of other formats, as ``sysid-btr import`` reads them, for use from Python."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:
    import pandas as pd

    from sysid_btr.io.importers.base import Importer
    from sysid_btr.io.importers.run import Imported, KnownModel
    from sysid_btr.models.robot import Robot

    PathLike = str | os.PathLike[str]


def import_log(
    source: PathLike | Sequence[PathLike] | pd.DataFrame,
    *,
    model: str | Robot | None = None,
    preset: str | None = None,
    mapping: PathLike | None = None,
    units: Mapping[str, str] | None = None,
    rename: Mapping[str, str] | None = None,
    mount: Literal["fixed", "free"] | None = None,
    importer: str | Importer = "auto",
) -> Imported:
    """Read a log of another format, and check it.

    >>> imported = import_log("walk.csv", model="leg.xml", units={"position": "deg"})  # doctest: +SKIP
    >>> study = make_study(load_robot("leg.xml"), [imported.log])  # doctest: +SKIP

    Parameters
    ----------
    source : a file, a folder of a bag or dataset, or several of them, which become episodes of one log; or a
        DataFrame, whose index may be the clock.
    model : built-in name, file, or robot: its joints are matched by name, and their ranges checked.
    preset : mapping that comes with the package, as ``--preset``; `sysid_btr.io.importers.presets` has them.
    mapping : mapping file (TOML), on top of the preset; `sysid_btr.io.importers.mapping` describes it.
    units : channel or column -> unit, as ``--unit``; wins over the mapping.
    rename : joint of the file -> joint of the model, as ``--rename``.
    mount : whether the base was fixed or free to move.
    importer : name of an importer, one of one's own, or ``"auto"`` to judge by the content.

    Returns
    -------
    Imported
        ``log``; ``remarks`` on what was assumed or left out; ``problems`` of the validation; ``usable``, which is
        False where a problem is an error.

    Raises
    ------
    LogError
        If a source cannot be read or understood.
    UsageError
        If what is said does not fit, or a package is missing.
    """
    from sysid_btr.io.importers.mapping import read_map, with_flags
    from sysid_btr.io.importers.run import import_log as read

    told = with_flags(
        read_map(None if mapping is None else Path(mapping), preset),
        units=list((units or {}).items()),
        renames=list((rename or {}).items()),
        meta={"mount": mount},
    )
    known = known_model(model)
    if isinstance(source, str | os.PathLike):
        return read([source], importer=importer, told=told, model=known)
    if isinstance(source, Sequence):
        return read(list(source), importer=importer, told=told, model=known)
    with TemporaryDirectory() as folder:
        return read([_as_file(source, Path(folder))], importer=importer, told=told, model=known)


def _as_file(table: pd.DataFrame, folder: Path) -> Path:
    """A table as a file, which importers read."""
    from sysid_btr.errors import LogError
    from sysid_btr.io.frames import with_time

    path = folder / "DataFrame"
    try:
        with_time(table).to_parquet(path, index=False)
    except (TypeError, ValueError) as error:  # pyarrow's errors derive from the latter
        raise LogError(
            f"the DataFrame cannot be read as a table: {error}; give every column one name and type"
        ) from error
    return path


def known_model(wanted: str | Robot | None) -> KnownModel | None:
    """What an import wants to know of the robot called for by name or file, or given, if one is."""
    if wanted is None:
        return None
    from sysid_btr.io.importers.run import KnownModel
    from sysid_btr.models.builtin import load_robot
    from sysid_btr.models.robot import joint_names, joint_ranges
    from sysid_btr.mujoco_conventions import slides

    robot = load_robot(wanted) if isinstance(wanted, str) else wanted
    model = robot.model
    joints = joint_names(robot)
    sliding = tuple(joint for joint in joints if slides(model, joint))
    return KnownModel(robot.name, joints, joint_ranges(robot), sliding)
