"""A body whose centre of mass is not where the model has it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

from sysid_btr._typing import FloatArray
from sysid_btr.terms.base import BatchModel, Fields, Kind
from sysid_btr.terms.effect import Effect, Probe
from sysid_btr.terms.fields import allow_any_inertia
from sysid_btr.terms.scales import JointScale

if TYPE_CHECKING:
    import mujoco


@dataclass(frozen=True)
class ComOffset(Effect):
    """Native: `body_ipos`."""

    name: ClassVar[str] = "com_offset"
    title: ClassVar[str] = "shift of the centre of mass"
    scope: ClassVar = "body"
    signed: ClassVar[bool] = True
    kinds: ClassVar[tuple[Kind, ...]] = tuple(Kind(axis, "m", 0.0, -0.06, 0.06, 0.005) for axis in "xyz")
    confounders: ClassVar[tuple[tuple[str, str], ...]] = (
        ("payload", "a body on a free base, or fast motion"),
        ("encoder_offset", "several poses"),
    )

    @classmethod
    def probes(cls, scale: JointScale) -> tuple[Probe, ...]:
        d = 0.01
        return (((d, 0.0, 0.0), (0.0, d, 0.0), (0.0, 0.0, d)),)

    def edit_spec(self, spec: mujoco.MjSpec) -> None:
        allow_any_inertia(spec, self.places)

    def model_fields(self, batch: BatchModel, values: FloatArray) -> Fields:
        ids = [batch.model.body(name).id for name in self.places]
        centre = batch.read("body_ipos")
        centre[:, ids] += values
        return {"body_ipos": centre}
