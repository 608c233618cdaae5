"""What an import found, as text for a terminal and as JSON."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from sysid_btr.io.log import CHANNELS

if TYPE_CHECKING:
    from sysid_btr.io.importers.run import Imported
    from sysid_btr.io.log import Log


def as_json(imported: Imported, out: Path | None) -> dict[str, Any]:
    """An import for programs; `out` is the file written, if any."""
    log = imported.log
    return {
        "out": None if out is None else str(out),
        "formats": dict(imported.formats),
        "samples": len(log),
        "episodes": len(log.episodes()),
        "duration": duration(log),
        "sample_period": log.meta.sample_period,
        "mount": log.meta.mount,
        "robot": log.meta.robot,
        "channels": {channel: list(names) for channel, names in channels(log).items()},
        "foreign": list(log.unknown),
        "remarks": list(imported.remarks),
        "problems": imported.problems,
        "advice": list(imported.advice),
    }


def summary(imported: Imported) -> Iterator[str]:
    """Lines that say what was understood."""
    log = imported.log
    for path, name in imported.formats.items():
        yield f"{path}: {name}"
    period = log.meta.sample_period
    clock = f"every {1e3 * period:.6g} ms" if period else "on an uneven clock"
    parts = len(log.episodes())
    episodes = f" in {parts} episodes" if parts > 1 else ""
    yield f"{len(log)} samples{episodes}, {duration(log):.6g} s, {clock}; torso {log.meta.mount}"
    for channel, names in channels(log).items():
        yield f"  {channel:16} {', '.join(names)}"
    if log.unknown:
        yield f"  kept as it is: {len(log.unknown)} column{'s' if len(log.unknown) > 1 else ''}"


def channels(log: Log) -> Mapping[str, Sequence[str]]:
    """Names by channel, channels in the order of the schema."""
    return {channel: names for channel in CHANNELS if (names := log.joints(channel))}


def duration(log: Log) -> float:
    """Time that the episodes last together, s."""
    lengths = (log.time[rows] for rows in log.episodes())
    return float(np.sum([times[-1] - times[0] for times in lengths if len(times)]))
