"""Where a replay starts."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from sysid_btr._typing import FloatArray
from sysid_btr.terms.base import BatchModel, Kind, Term


@dataclass(frozen=True)
class StartPosition(Term):
    """Correction of the position at which the replay starts.

    Start: the log's first position plus this.
    """

    name: ClassVar[str] = "qpos0"
    kinds: ClassVar[tuple[Kind, ...]] = (Kind("offset", "rad", 0.0, -0.1, 0.1, 0.002),)

    def initial_state(self, batch: BatchModel, values: FloatArray, qpos: FloatArray, qvel: FloatArray) -> None:
        qpos[:, batch.index.of(self.places)] += values[:, :, 0]


@dataclass(frozen=True)
class StartVelocity(Term):
    """Correction of the velocity at which the replay starts.

    Start: the log's first velocity plus this.
    """

    name: ClassVar[str] = "qvel0"
    kinds: ClassVar[tuple[Kind, ...]] = (Kind("offset", "rad/s", 0.0, -5.0, 5.0, 0.05),)

    def initial_state(self, batch: BatchModel, values: FloatArray, qpos: FloatArray, qvel: FloatArray) -> None:
        qvel[:, batch.index.of(self.places)] += values[:, :, 0]
