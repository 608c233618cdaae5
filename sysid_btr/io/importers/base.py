"""What an importer is: it reads one source as it is written, in the words of its own format.

Units, names of joints, metadata and checks are the same for all formats, and come after
(`sysid_btr.io.importers.assemble`, `sysid_btr.io.importers.run`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from sysid_btr._typing import FloatArray, IntArray
from sysid_btr.errors import LogError
from sysid_btr.io.importers.mapping import ImportMap
from sysid_btr.io.log import LogMeta


@dataclass(frozen=True, eq=False)
class Signal:
    """One column of the schema, as the source has it.

    Attributes
    ----------
    source : what the source calls it (a column, or a topic and field).
    column : ``<channel>.<name>`` of the schema, joints by the source's own names.
    values : ndarray, shape (n,); NaN where missing.
    unit : the unit that the source or its format states; None if neither does (then SI, unless the user
        says otherwise).
    """

    source: str
    column: str
    values: FloatArray
    unit: str | None = None


@dataclass(frozen=True, eq=False)
class Recording:
    """What an importer found in one source.

    Attributes
    ----------
    path : the source.
    time : ndarray, shape (n,), s, as recorded.
    signals : what was understood.
    foreign : what was not, by the source's own names; kept as it is.
    episode : ndarray of int, shape (n,), or None for one episode.
    meta : what the source says about the robot and itself.
    remarks : what was assumed, left out or not understood, a sentence each.
    """

    path: Path
    time: FloatArray
    signals: tuple[Signal, ...]
    foreign: Mapping[str, np.ndarray[Any, Any]] = field(default_factory=dict)
    episode: IntArray | None = None
    meta: LogMeta = field(default_factory=LogMeta)
    remarks: tuple[str, ...] = ()


class Importer(Protocol):
    """Reads one format.

    Attributes
    ----------
    name : as ``--format`` calls it.
    title : in a sentence: "a NaoQi key CSV".
    """

    @property
    def name(self) -> str: ...

    @property
    def title(self) -> str: ...

    def recognises(self, path: Path, head: bytes) -> bool:
        """Whether the source is of this format, judged by its content.

        Parameters
        ----------
        path : a file or folder that exists.
        head : the file's first bytes (unpacked, if it is packed); empty for a folder.
        """
        ...

    def read(self, path: Path, told: ImportMap) -> Recording:
        """Read a source.

        Parameters
        ----------
        path : a file or folder that exists.
        told : all that the user said by mapping file and flags.

        Raises
        ------
        LogError
            If it cannot be read; all problems at once.
        UsageError
            If what the user said cannot be used, or a package is missing.
        """
        ...


class MappingNeeded(LogError):
    """A source that cannot be understood without a mapping.

    Attributes
    ----------
    propose : makes a mapping file to edit, given the model's joints if there is a model.
    """

    def __init__(self, message: str, propose: Callable[[Sequence[str] | None], str]) -> None:
        super().__init__(message)
        self.propose = propose
