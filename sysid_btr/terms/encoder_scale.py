"""An encoder whose scale is off, either the logged one alone or the one that closes the servo loop too."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from sysid_btr._typing import FloatArray
from sysid_btr.terms.base import BatchModel, Fields, Kind, Outputs
from sysid_btr.terms.effect import Effect


@dataclass(frozen=True)
class EncoderScale(Effect):
    """The log shows (1 + e) q; the servo uses the true q."""

    name: ClassVar[str] = "encoder_scale"
    title: ClassVar[str] = "error of the encoder's scale"
    variant: ClassVar[str] = "log"
    signed: ClassVar[bool] = True
    kinds: ClassVar[tuple[Kind, ...]] = (Kind("error", "1", 0.0, -0.3, 0.3, 0.01),)
    confounders: ClassVar[tuple[tuple[str, str], ...]] = (
        ("kp", "fast motion, where the servo lags"),
        ("joint_spring", "a logged effort"),
    )

    def read_out(self, batch: BatchModel, values: FloatArray, outputs: Outputs) -> None:
        columns = batch.index.of(self.places)
        outputs.position[:, :, columns] *= 1 + values[:, None, :, 0]
        outputs.velocity[:, :, columns] *= 1 + values[:, None, :, 0]


@dataclass(frozen=True)
class EncoderScaleInLoop(EncoderScale):
    """The log shows (1 + e) q, and the servo closes its loop on it."""

    variant: ClassVar[str] = "loop"

    def model_fields(self, batch: BatchModel, values: FloatArray) -> Fields:
        ids = batch.index.actuator[batch.index.of(self.places)]
        bias = batch.read("actuator_biasprm")
        bias[:, ids, 1:3] *= 1 + values[:, :, :1]
        return {"actuator_biasprm": bias}

    def initial_state(self, batch: BatchModel, values: FloatArray, qpos: FloatArray, qvel: FloatArray) -> None:
        columns = batch.index.of(self.places)
        qpos[:, columns] /= 1 + values[:, :, 0]
        qvel[:, columns] /= 1 + values[:, :, 0]
