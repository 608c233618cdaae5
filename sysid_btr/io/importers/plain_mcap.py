"""MCAP files, with or without a bag's folder around them: ROS 2 messages (CDR), or the same in JSON.

Format: mcap.dev/spec, version 0. JSON messages have the fields of the ROS message that their schema is named after.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import IO, TYPE_CHECKING, Any

from sysid_btr.errors import LogError
from sysid_btr.io.importers.base import Recording
from sysid_btr.io.importers.mapping import ImportMap
from sysid_btr.io.importers.ros2 import Decoder, need
from sysid_btr.io.importers.topics import read_bag
from sysid_btr.reading import parse_json

if TYPE_CHECKING:
    from mcap.reader import McapReader
    from mcap.records import Schema

MAGIC = b"\x89MCAP"
READ = ("cdr", "json")
"""Encodings of messages that are read."""
_IDL = ("ros2idl", "omgidl")
_EMPTY: Mapping[str, Any] = {
    "header": None,
    "name": (),
    "position": (),
    "velocity": (),
    "effort": (),
    "joint_names": (),
    "points": (),
    "positions": (),
    "data": (),
}
"""Fields that JSON messages may leave out."""


@dataclass(frozen=True)
class McapImporter:
    """Single MCAP files."""

    name: str = "mcap"
    title: str = "an MCAP file"

    def recognises(self, path: Path, head: bytes) -> bool:
        return head.startswith(MAGIC)

    def read(self, path: Path, told: ImportMap) -> Recording:
        make_reader = need("mcap.reader").make_reader
        try:
            opened = path.open("rb")
        except OSError as error:
            raise LogError(f"{path}: the file cannot be read ({error.strerror})") from error
        with opened as file:
            try:
                reader: McapReader = make_reader(file, validate_crcs=True)
                schemas = _schemas(file, reader)
            except Exception as error:  # whatever broken bytes make of the reader
                raise LogError(_broken(path, error)) from error
            return read_bag(path, _McapBag(path, reader, schemas), told)


@dataclass(frozen=True, eq=False)
class _McapBag:
    """An open file; `schemas` is topic -> encoding of its messages, schema."""

    path: Path
    reader: McapReader
    schemas: Mapping[str, tuple[str, Schema | None]]

    @property
    def topics(self) -> Mapping[str, str]:
        """Topics by type; an encoding that is not read is told with it."""
        return {
            topic: (schema.name if schema else "no schema") + ("" if encoding in READ else f", {encoding}")
            for topic, (encoding, schema) in self.schemas.items()
        }

    def messages(self, topics: Collection[str]) -> Iterator[tuple[str, int, Any]]:
        decoder = self._decoder(topics)
        try:
            for schema, channel, message in self.reader.iter_messages(topics=list(topics)):
                if decoder is None or channel.message_encoding == "json":
                    content = parse_json(message.data, object_hook=_fields)
                else:
                    content = decoder.decode(message.data, _long_name(schema.name if schema else ""))
                yield channel.topic, message.log_time, content
        except Exception as error:  # whatever broken bytes make of the reader
            raise LogError(_broken(self.path, error)) from error

    def _decoder(self, topics: Collection[str]) -> Decoder | None:
        """What decodes CDR; None if there is none of it."""
        binary = [s for t in topics for encoding, s in (self.schemas[t],) if encoding == "cdr"]
        if not binary:
            return None
        decoder = Decoder()
        for schema in binary:
            if schema is not None:
                language = "IDL" if schema.encoding in _IDL else "MSG"
                decoder.learn(_long_name(schema.name), language, schema.data.decode())
        return decoder


def _schemas(file: IO[bytes], reader: McapReader) -> Mapping[str, tuple[str, Schema | None]]:
    summary = reader.get_summary()
    if summary is None or not summary.channels:
        # a file without an index: look through all of it
        found = {c.topic: (c.message_encoding, s) for s, c, _ in reader.iter_messages()}
        file.seek(0)
        return found
    return {c.topic: (c.message_encoding, summary.schemas.get(c.schema_id)) for c in summary.channels.values()}


def _broken(path: Path, error: Exception) -> str:
    reason = " ".join(str(error).split())[:200] or type(error).__name__
    return (
        f"{path}: the MCAP file cannot be read ({reason}): it was cut short, or its recorder did not close it; "
        "copy it again, or repair it by `mcap recover`"
    )


def _long_name(name: str) -> str:
    """``sensor_msgs/JointState`` -> ``sensor_msgs/msg/JointState``."""
    package, _, rest = name.replace("::", "/").partition("/")
    return name if rest.startswith("msg/") else f"{package}/msg/{rest}"


def _fields(content: dict[str, Any]) -> SimpleNamespace:
    return SimpleNamespace(**{**_EMPTY, **content})
