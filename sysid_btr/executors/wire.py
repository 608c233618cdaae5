"""Problems as they travel: large arrays and compiled models under the hash of their content, so that each goes once."""

from __future__ import annotations

import hashlib
import io
import pickle
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

LARGE = 4096
"""Bytes from which an array travels by itself."""


@dataclass(frozen=True)
class Parcel:
    """A problem taken apart.

    Attributes
    ----------
    key : hash of `content`.
    content : everything but the parts, pickled.
    parts : arrays and models by the hash of their bytes.
    """

    key: str
    content: bytes
    parts: Mapping[str, bytes]


def pack(problem: Any) -> Parcel:
    """Take a problem apart; classes and functions that another process cannot import go along by value."""
    import cloudpickle
    import mujoco

    parts: dict[str, bytes] = {}
    named: dict[int, tuple[Any, object]] = {}

    def part(data: bytes) -> str:
        key = _digest(data)
        parts.setdefault(key, data)
        return key

    def name_of(item: Any) -> object:
        if type(item) is np.ndarray and item.nbytes >= LARGE and not item.dtype.hasobject:
            order: Literal["C", "F"] = "F" if item.flags.f_contiguous and not item.flags.c_contiguous else "C"
            return "array", part(item.tobytes(order)), item.dtype.str, item.shape, order
        if isinstance(item, mujoco.MjModel):
            return "model", part(pickle.dumps(item, pickle.HIGHEST_PROTOCOL))
        return None

    class Packer(cloudpickle.Pickler):  # type: ignore[misc]
        def persistent_id(self, item: Any) -> object:
            if type(item) is not np.ndarray and not isinstance(item, mujoco.MjModel):
                return None
            if id(item) not in named:  # the item is kept, so that no other one gets its id
                named[id(item)] = item, name_of(item)
            return named[id(item)][1]

    stream = io.BytesIO()
    Packer(stream, pickle.HIGHEST_PROTOCOL).dump(problem)
    content = stream.getvalue()
    return Parcel(_digest(content), content, parts)


def unpack(content: bytes, parts: Mapping[str, bytes]) -> Any:
    """The problem again; its arrays are read-only views of the parts."""
    models: dict[str, Any] = {}

    def load(name: tuple[Any, ...]) -> Any:
        kind, key = name[:2]
        if kind == "model":
            if key not in models:
                models[key] = pickle.loads(parts[key])
            return models[key]
        dtype, shape, order = name[2:]
        return np.frombuffer(parts[key], dtype=np.dtype(dtype)).reshape(shape, order=order)

    class Unpacker(pickle.Unpickler):
        def persistent_load(self, name: Any) -> Any:
            return load(name)

    return Unpacker(io.BytesIO(content)).load()


def _digest(data: bytes) -> str:
    return hashlib.blake2b(data, digest_size=20).hexdigest()
