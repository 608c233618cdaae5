"""An encoder whose zero is off, either the logged one alone or the one that closes the servo loop too."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from sysid_btr._typing import FloatArray
from sysid_btr.terms.base import BatchModel, Kind, Outputs
from sysid_btr.terms.effect import Effect
from sysid_btr.terms.scales import JointScale


@dataclass(frozen=True)
class EncoderOffset(Effect):
    """The log shows q + b; the servo uses the true q."""

    name: ClassVar[str] = "encoder_offset"
    title: ClassVar[str] = "offset of the encoder"
    variant: ClassVar[str] = "log"
    signed: ClassVar[bool] = True
    kinds: ClassVar[tuple[Kind, ...]] = (Kind("offset", "rad", 0.0, -0.3, 0.3, 0.005),)
    confounders: ClassVar[tuple[tuple[str, str], ...]] = (
        ("constant_force", "motion whose stiffness to torque changes, or a logged effort"),
        ("com_offset", "several poses"),
    )

    @classmethod
    def sized(cls, scale: JointScale) -> tuple[Kind, ...]:
        reach = 0.3 if not scale.slide else 0.3 * scale.span
        return (Kind("offset", scale.unit("rad"), 0.0, -reach, reach, reach / 60),)

    def read_out(self, batch: BatchModel, values: FloatArray, outputs: Outputs) -> None:
        outputs.position[:, :, batch.index.of(self.places)] += values[:, None, :, 0]


@dataclass(frozen=True)
class EncoderOffsetInLoop(EncoderOffset):
    """The log shows q + b, and the servo closes its loop on it: seen through gravity only."""

    variant: ClassVar[str] = "loop"

    def shape_command(self, batch: BatchModel, values: FloatArray, command: FloatArray) -> FloatArray:
        shaped = command.copy()
        shaped[:, :, batch.index.of(self.places)] -= values[:, None, :, 0]
        return shaped

    def initial_state(self, batch: BatchModel, values: FloatArray, qpos: FloatArray, qvel: FloatArray) -> None:
        qpos[:, batch.index.of(self.places)] -= values[:, :, 0]
