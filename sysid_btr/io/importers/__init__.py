"""Logs that others wrote: NaoQi, CSV and Parquet tables, ROS 2 bags, MCAP, LeRobot datasets.

>>> from sysid_btr.io.importers import import_log
>>> imported = import_log(["walk.csv"])  # doctest: +SKIP
>>> imported.log, imported.remarks, imported.problems  # doctest: +SKIP
"""

from __future__ import annotations

from sysid_btr.io.importers.base import Importer, Recording, Signal
from sysid_btr.io.importers.mapping import ImportMap
from sysid_btr.io.importers.registry import ENTRY_POINTS, available, get_importer
from sysid_btr.io.importers.run import Imported, KnownModel, import_log

__all__ = [
    "ENTRY_POINTS",
    "ImportMap",
    "Imported",
    "Importer",
    "KnownModel",
    "Recording",
    "Signal",
    "available",
    "get_importer",
    "import_log",
]
