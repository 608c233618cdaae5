"""Compliance between motor and link: a gear or shaft that twists; sensor on the link, servo on the motor."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from sysid_btr._typing import FloatArray
from sysid_btr.terms.backlash import add_link_joint
from sysid_btr.terms.base import LINK_SUFFIX, BatchModel, Fields, Kind
from sysid_btr.terms.effect import Effect, Probe
from sysid_btr.terms.scales import JointScale

if TYPE_CHECKING:
    import mujoco

RELAXATION = 0.004
"""Ratio of the spring's damping to its stiffness, s: well damped, as gears are."""


@dataclass(frozen=True)
class JointCompliance(Effect):
    """Structure: a second joint on the link with a stiff spring."""

    name: ClassVar[str] = "joint_compliance"
    title: ClassVar[str] = "softness of the gear"
    variant: ClassVar[str] = "link"
    scope: ClassVar = "servo"
    structural: ClassVar[bool] = True
    kinds: ClassVar[tuple[Kind, ...]] = (Kind("softness", "rad/Nm", 0.0, 0.0, 0.2, 0.005),)
    confounders: ClassVar[tuple[tuple[str, str], ...]] = (
        ("backlash", "loads of several sizes"),
        ("kp", "a logged effort, or fast motion"),
    )

    @classmethod
    def sized(cls, scale: JointScale) -> tuple[Kind, ...]:
        size = 0.004 * max(scale.span, 1e-9) / max(scale.torque_rms, 1e-9)
        return (Kind("softness", scale.unit("rad/Nm"), 0.0, 0.0, 100 * size, size),)

    @classmethod
    def probes(cls, scale: JointScale) -> tuple[Probe, ...]:
        size = cls.sized(scale)[0].scale
        return (((2 * size,),), ((8 * size,),))

    def edit_spec(self, spec: mujoco.MjSpec) -> None:
        for name in self.places:
            add_link_joint(spec, name, damping_on_link=self.variant == "link")
            spec.joint(name + LINK_SUFFIX).stiffness = [1.0, 0.0, 0.0]
            spec.joint(name + LINK_SUFFIX).damping = [1.0, 0.0, 0.0]

    def model_fields(self, batch: BatchModel, values: FloatArray) -> Fields:
        ids = np.array([batch.model.joint(name + LINK_SUFFIX).id for name in self.places])
        dofs = batch.model.jnt_dofadr[ids]
        mobility = batch.model.dof_invweight0[dofs]
        # the stiffest spring that stays stable, with a margin of 2 (Euler) or 4 (RK4) for other poses:
        # (omega h)^2 = 2
        stiffest = 2.0 / (mobility * batch.timestep**2)
        stiffness = 1 / np.maximum(values[:, :, 0], 1 / stiffest)
        most = 0.5 / (mobility * batch.timestep)
        springs, damping = batch.read("jnt_stiffness"), batch.read("dof_damping")
        springs[:, ids], damping[:, dofs] = stiffness, np.minimum(RELAXATION * stiffness, most)
        return {"jnt_stiffness": springs, "dof_damping": damping}


@dataclass(frozen=True)
class JointComplianceMotor(JointCompliance):
    """The joint's own damping stays on the motor."""

    variant: ClassVar[str] = "motor"
