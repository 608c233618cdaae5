"""LeRobot datasets, format v3.0 (and v2.x, whose tables hold the same columns).

Layout (LeRobotDataset v3.0, huggingface.co/docs/lerobot/lerobot-dataset-v3): ``meta/info.json`` with ``fps`` and
``features``, frames in ``data/chunk-*/file-*.parquet``: ``observation.state`` and ``action`` are lists whose
entries ``features`` names (``shoulder_pan.pos``), ``episode_index``, ``frame_index``, ``timestamp`` (s, from the
begin of the episode) are scalars. The format states no units: they are the robot's driver's.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from sysid_btr._typing import FloatArray
from sysid_btr.errors import LogError
from sysid_btr.io._file import load, memory_of
from sysid_btr.io._text import some
from sysid_btr.io.importers.base import MappingNeeded, Recording, Signal
from sysid_btr.io.importers.mapping import ImportMap
from sysid_btr.io.log import LogMeta
from sysid_btr.io.problem import explain
from sysid_btr.machine import require_memory
from sysid_btr.reading import parse_json

INFO = Path("meta") / "info.json"
STATE, ACTION = "observation.state", "action"
_FEATURES: Mapping[str, str] = {
    STATE: "position",
    ACTION: "command",
    "observation.velocity": "velocity",
    "observation.effort": "effort",
    "observation.current": "current",
}
_SUFFIXES: Mapping[str, str] = {
    "pos": "position",
    "position": "position",
    "vel": "velocity",
    "velocity": "velocity",
    "effort": "effort",
    "torque": "effort",
    "current": "current",
}
_INDEX = ("timestamp", "frame_index", "episode_index", "index")
_LISTS = ("motors", "axes")
MOST = 10_000
"""Entries of a list, at most: joints of a robot."""
FASTEST = 1e6
"""Frames a second, at most."""
_TOLERANCE = 1e-3
"""s; stamps within it are frame / fps, rounded to float32."""


@dataclass(frozen=True)
class LeRobotImporter:
    """Folders of LeRobot datasets."""

    name: str = "lerobot"
    title: str = "a LeRobot dataset"

    def recognises(self, path: Path, head: bytes) -> bool:
        return _root(path) is not None

    def read(self, path: Path, told: ImportMap) -> Recording:
        root = _root(path)
        if root is not None and root != path:
            raise LogError(
                f"{path} is part of the LeRobot dataset {root}: give that folder; select episodes by [lerobot] "
                "episodes = [..] in a mapping"
            )
        if not (path / INFO).is_file():
            raise LogError(f"{path}: it has no {INFO}: give the folder of the dataset that holds meta/ and data/")
        info = _info(path)
        features = info["features"]
        names = {f: _names(path, features, f, told) for f in _FEATURES if f in features}
        columns, remarks = _frames(path, features, told)
        time, said = _time(columns, float(info["fps"]))
        entries = [e for f, entry in names.items() if f in columns for e in _entries(f, entry, columns[f])]
        signals = tuple(s for s in entries if s.column)
        remarks += said
        if not any(s.column.startswith("position.") for s in signals):
            raise LogError(f"{path}: {STATE} names no position: {some(names.get(STATE, []))}")
        foreign = {
            column: values
            for f, content in columns.items()
            if f not in (*names, *_INDEX)
            for column, values in _foreign(f, features.get(f, {}), content)
        } | {s.source: s.values for s in entries if not s.column}
        if foreign:
            remarks.append(f"kept and not used: {some(foreign, 12)}")
        if not any(told.unit(s.column) for s in signals if s.column.startswith("position.")):
            remarks.append(
                "the dataset states no units, and positions and actions are taken as rad. If the driver worked in "
                "degrees: --unit position=deg --unit command=deg; if it normalised: range_m100_100 or range_0_100, "
                "with the calibrated range of each joint in a mapping: [joints.NAME] range = [low, high], rad"
            )
        robot = info.get("robot_type")
        meta = LogMeta(robot=robot if isinstance(robot, str) else "", sample_period=1 / float(info["fps"]))
        return Recording(path, time, signals, foreign, columns["episode_index"].astype(np.int64), meta, tuple(remarks))


def _root(path: Path) -> Path | None:
    """The folder of the dataset that a path is, or that one of its tables or folders lies in."""
    if path.is_file() and path.suffix != ".parquet":
        return None
    nearest = [path, *path.absolute().parents[:3]]
    return next((folder for folder in nearest if (folder / INFO).is_file()), None)


def _info(path: Path) -> dict[str, Any]:
    try:
        info = parse_json((path / INFO).read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise LogError(f"{path / INFO}: cannot be read ({error}); download or record the dataset again") from error
    fps = info.get("fps") if isinstance(info, dict) else None
    if not isinstance(info, dict) or not isinstance(info.get("features"), dict) or not isinstance(fps, int | float):
        raise LogError(f"{path / INFO}: not the info.json of a LeRobot dataset: it needs `fps` and `features`")
    wrong = [f for f, content in info["features"].items() if not _is_feature(content)]
    if wrong:
        raise LogError(f"{path / INFO}: not a feature of a LeRobot dataset: {some(wrong)}")
    missing = [f for f in (STATE, ACTION) if f not in info["features"]]
    if missing or not 0 < fps < FASTEST:
        what = f"no feature {' and no feature '.join(missing)}" if missing else f"fps is {fps}"
        raise LogError(f"{path / INFO}: {what}; features: {some(info['features'], 20)}")
    storage = info.get("storage_format", "parquet")
    if storage != "parquet":
        raise LogError(f"{path}: the dataset is stored as {storage!r}; convert it to Parquet first")
    return info


def _is_feature(content: object) -> bool:
    """Whether it says of what shape entries are, as far as it says so."""
    if not isinstance(content, dict):
        return False
    shape = content.get("shape") or []
    return isinstance(shape, list) and all(isinstance(n, int) and not isinstance(n, bool) for n in shape)


def _names(path: Path, features: Mapping[str, Any], feature: str, told: ImportMap) -> list[str]:
    """Names of the entries of a list; of ``observation.state`` where only that one has names."""
    shape = features[feature].get("shape") or [1]
    size = math.prod(shape)
    if not 0 < size <= MOST:
        raise LogError(f"{path}: {feature} has the shape {shape}; a robot has up to {MOST} joints")
    for source in (feature, STATE, ACTION):
        names = features.get(source, {}).get("names")
        if isinstance(names, dict):
            names = next((names[key] for key in _LISTS if key in names), next(iter(names.values()), None))
        if isinstance(names, list) and len(names) == size and all(isinstance(n, str) for n in names):
            return names
    if len(told.lerobot.joints) == size:
        return told.lerobot.joints
    given = f", [lerobot] joints names {len(told.lerobot.joints)}" if told.lerobot.joints else ""
    raise MappingNeeded(
        f"{path}: the {size} entries of {feature} have no names{given}; name them in a mapping file (--map FILE): "
        '[lerobot] joints = ["..", ..], in their order; one to fill in is on standard output',
        lambda joints: _proposal(path, size, joints),
    )


def _proposal(path: Path, size: int, joints: Sequence[str] | None) -> str:
    names = [f"joint_{i}" for i in range(size)]
    lines = [
        f"# Mapping of the LeRobot dataset {path.name}. Fill in the names, then:",
        f"#   sysid-btr import {path.name} --map FILE --out {path.name}.parquet",
        "[lerobot]",
        f"joints = {json.dumps(names)}",
        "",
        "[units]",
        '# position = "deg"   # or range_m100_100, range_0_100 with [joints.NAME] range = [low, high]',
        '# command = "deg"',
    ]
    if joints:
        lines.insert(3, f"# the model's joints: {', '.join(joints)}")
    return "\n".join(lines) + "\n"


def _frames(
    path: Path, features: Mapping[str, Any], told: ImportMap
) -> tuple[dict[str, np.ndarray[Any, Any]], list[str]]:
    """Columns of all frames wanted, lists as matrices (n, k)."""
    import pyarrow as pa
    import pyarrow.compute as pc
    import pyarrow.parquet as pq

    files = sorted((path / "data").rglob("*.parquet"))
    if not files:
        raise LogError(f"{path}: no Parquet file under data/; download the whole dataset")
    broken = [explain(f, p) for f in files if (p := [q for q in load(f)[1] if q.code.startswith("file.")])]
    if broken:
        raise LogError("\n".join(broken))
    tables = []
    for file in files:
        with pq.ParquetFile(file) as opened:
            require_memory(
                memory_of(opened), f"{file}: its {opened.metadata.num_rows} rows", "choose episodes", LogError
            )
            names = [n for n in opened.schema_arrow.names if not _is_picture(opened.schema_arrow.field(n).type)]
            tables.append(opened.read(columns=names))
    missing = [n for n in (STATE, ACTION, "episode_index") if any(n not in t.column_names for t in tables)]
    if missing:
        raise LogError(f"{path}: {', '.join(missing)} not in the tables under data/")
    table = pa.concat_tables(tables, promote_options="default")
    if told.lerobot.episodes:
        table = table.filter(pc.is_in(table["episode_index"], pa.array(told.lerobot.episodes)))
    if table.num_rows == 0:
        raise LogError(f"{path}: no frames" + (" of these episodes" if told.lerobot.episodes else ""))
    columns = {name: _array(table[name]) for name in table.column_names}
    seen = [f for f, content in features.items() if content.get("dtype") in ("video", "image")]
    remarks = [f"pictures are left out: {some(seen, 6)}"] if seen else []
    return {name: values for name, values in columns.items() if values is not None}, remarks


def _is_picture(kind: Any) -> bool:
    from pyarrow import types

    return bool(types.is_struct(kind) or types.is_binary(kind))


def _array(column: Any) -> np.ndarray[Any, Any] | None:
    """A column of numbers as (n,), of lists of one length as (n, k), of anything else as objects."""
    from pyarrow import types

    kind = column.type
    if types.is_list(kind) or types.is_fixed_size_list(kind) or types.is_large_list(kind):
        rows = column.to_pylist()
        if len({len(r) for r in rows if r is not None}) != 1 or any(r is None for r in rows):
            return None
        try:
            return np.array(rows, dtype=np.float64)
        except (TypeError, ValueError):
            return None
    if types.is_integer(kind) or types.is_floating(kind) or types.is_boolean(kind):
        return np.array(column.to_numpy(), dtype=np.float64)
    return np.array(column.to_pylist(), dtype=object)


def _time(columns: Mapping[str, np.ndarray[Any, Any]], fps: float) -> tuple[FloatArray, list[str]]:
    """Time from the begin of each episode: frame / fps, unless the stamps say that the clock was another."""
    nominal: FloatArray | None = None
    for name in ("frame_index", "timestamp"):
        if name in columns and columns[name].size != len(columns[name]):
            raise LogError(f"{name}: several numbers in a frame, where one is expected; record or download again")
    if "frame_index" in columns:
        nominal = columns["frame_index"].ravel() / fps
    stamps = columns.get("timestamp")
    if stamps is None:
        if nominal is None:
            raise LogError("the dataset has neither timestamp nor frame_index")
        return nominal, []
    stamps = stamps.ravel()
    if nominal is not None and np.allclose(nominal, stamps, rtol=0, atol=_TOLERANCE):
        said = "times are frame / fps, as in the dataset: when a sample was really taken is not recorded"
        return nominal, [said]
    return stamps, []


def _entries(feature: str, names: Sequence[str], values: FloatArray) -> Iterator[Signal]:
    """Entries of a list as signals; those that are of no channel have no column."""
    usual = _FEATURES[feature]
    for i, entry in enumerate(names):
        stem, _, suffix = entry.rpartition(".")
        joint, channel = (stem, _SUFFIXES[suffix]) if stem and suffix in _SUFFIXES else (entry, usual)
        if feature == ACTION and channel != usual:
            # an action on anything but a position is no command that a position servo follows
            channel = "command" if channel == "position" else ""
        column = f"{channel}.{joint}" if channel else ""
        yield Signal(f"{feature}.{entry}", column, values.reshape(len(values), -1)[:, i])


def _foreign(
    feature: str, content: Mapping[str, Any], values: np.ndarray[Any, Any]
) -> Iterator[tuple[str, np.ndarray[Any, Any]]]:
    if values.ndim == 1:
        yield feature, values
        return
    names = content.get("names")
    flat = values.reshape(len(values), -1)
    if isinstance(names, dict):
        names = next((names[key] for key in _LISTS if key in names), None)
    if not isinstance(names, list) or len(names) != flat.shape[1]:
        names = [str(i) for i in range(flat.shape[1])]
    for i, name in enumerate(names):
        yield f"{feature}.{name}", flat[:, i]
