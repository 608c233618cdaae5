"""ROS 2 bags: folders with ``metadata.yaml``, or single ``.db3`` files; sqlite3 and MCAP storage.

Read by `rosbags <https://ternaris.gitlab.io/rosbags>`_, which needs no ROS: rosbag2 format, versions 1 to 9.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sysid_btr.errors import LogError
from sysid_btr.io.importers.base import Recording
from sysid_btr.io.importers.mapping import ImportMap
from sysid_btr.io.importers.topics import read_bag
from sysid_btr.optional import optional

if TYPE_CHECKING:
    from rosbags.rosbag2 import Reader
    from rosbags.typesys.store import Typestore

EXTRA = "ros"
_STORAGE = (".db3", ".mcap")
SQLITE = b"SQLite format 3\x00"


@dataclass(frozen=True)
class Ros2Importer:
    """ROS 2 bags."""

    name: str = "ros2"
    title: str = "a ROS 2 bag"

    def recognises(self, path: Path, head: bytes) -> bool:
        if path.is_dir():
            return (path / "metadata.yaml").is_file() or any(_storage(path))
        return head.startswith(SQLITE)

    def read(self, path: Path, told: ImportMap) -> Recording:
        reader_class: type[Reader] = need("rosbags.rosbag2").Reader
        if path.is_dir() and not (path / "metadata.yaml").is_file():
            files = ", ".join(str(p) for p in _storage(path))
            raise LogError(
                f"{path}: the bag has no metadata.yaml: its recorder did not close it. "
                f"Import its file by itself ({files}), or run `ros2 bag reindex`"
            )
        if path.is_file() and path.suffix not in _STORAGE:
            raise LogError(f"{path}: give the bag's folder, or its storage with a name in {' or '.join(_STORAGE)}")
        try:
            reader = reader_class(path)
            reader.open()
        except Exception as error:
            raise LogError(_broken(path, error)) from error
        try:
            return read_bag(path, _Ros2Bag(path, reader), told)
        finally:
            reader.close()


@dataclass(frozen=True, eq=False)
class _Ros2Bag:
    path: Path
    reader: Reader

    @property
    def topics(self) -> Mapping[str, str]:
        return {c.topic: c.msgtype for c in self.reader.connections}

    def messages(self, topics: Collection[str]) -> Iterator[tuple[str, int, Any]]:
        chosen = [c for c in self.reader.connections if c.topic in topics]
        store = Decoder()
        try:
            for connection in chosen:
                store.learn(connection.msgtype, connection.msgdef.format.name, connection.msgdef.data)
            for connection, received, data in self.reader.messages(connections=chosen):
                yield connection.topic, received, store.decode(data, connection.msgtype)
        except Exception as error:  # whatever broken bytes make of the reader
            raise LogError(_broken(self.path, error)) from error


class Decoder:
    """Decodes CDR messages: types that ROS 2 ships, and those that a recording defines itself."""

    def __init__(self) -> None:
        types = need("rosbags.typesys")
        self._store: Typestore = types.get_typestore(types.Stores.ROS2_JAZZY)

    def learn(self, name: str, language: str, definition: str) -> None:
        """Take in a definition (``MSG`` or ``IDL``) of a type that is not known."""
        from rosbags.typesys import get_types_from_idl, get_types_from_msg

        if name in self._store.fielddefs or not definition:
            return
        found = get_types_from_idl(definition) if language == "IDL" else get_types_from_msg(definition, name)
        self._store.register({k: v for k, v in found.items() if k not in self._store.fielddefs})

    def decode(self, data: bytes | memoryview, name: str) -> Any:
        """A message as an object with its fields."""
        return self._store.deserialize_cdr(data, name)


def need(module: str) -> Any:
    """A module that reads bags.

    Raises
    ------
    UsageError
        If it is not installed; the message names the extra that brings it.
    """
    return optional(module, EXTRA, "reading bags (it takes no ROS)")


def _storage(folder: Path) -> list[Path]:
    return sorted(p for p in folder.iterdir() if p.suffix in _STORAGE)


def _broken(path: Path, error: Exception) -> str:
    reason = " ".join(str(error).split())[:200] or type(error).__name__
    return (
        f"{path}: the bag cannot be read ({reason}): it was cut short, or its recorder did not close it; "
        "copy it again, or repair it by `ros2 bag reindex` (sqlite3) or `mcap recover` (MCAP)"
    )
