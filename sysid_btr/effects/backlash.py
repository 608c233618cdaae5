"""Backlash: the link moves freely between two stops; sensor on the link, servo on the motor."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from sysid_btr._typing import FloatArray
from sysid_btr.effects.base import Effect, Probe
from sysid_btr.models.modifier import LINK_SUFFIX, Kind, Rig
from sysid_btr.models.scales import JointScale

if TYPE_CHECKING:
    import mujoco

HELD = 1e-7


ROTOR_SHARE = 0.02
"""Inertia of a rotor that the model says nothing of, as a fraction of the joint's."""


@dataclass(frozen=True)
class Backlash(Effect):
    """Structure: a second joint on the link, stopped at +-play / 2; all damping of the joint on the link.

    Friction between housing and link acts on the link, that of motor and gear on the motor; which one the
    model's own damping describes, the log must tell, so the other case is the variant `motor`.
    """

    name: ClassVar[str] = "backlash"
    title: ClassVar[str] = "play in the gear"
    variant: ClassVar[str] = "link"
    scope: ClassVar = "servo"
    structural: ClassVar[bool] = True
    kinds: ClassVar[tuple[Kind, ...]] = (Kind("play", "rad", 0.0, 0.0, 0.2, 0.004),)
    confounders: ClassVar[tuple[tuple[str, str], ...]] = (
        ("joint_compliance", "loads of several sizes"),
        ("coulomb_friction", "reversals under a load that does not change sign"),
    )

    @classmethod
    def probes(cls, scale: JointScale) -> tuple[Probe, ...]:
        return (((0.008,),), ((0.03,),))

    def edit_spec(self, spec: mujoco.MjSpec) -> None:
        step = spec.option.timestep
        for name in self.places:
            joint = spec.joint(name)
            add_link_joint(spec, name, damping_on_link=self.variant == "link")
            link = spec.joint(name + LINK_SUFFIX)
            link.limited = True
            link.range = [-HELD, HELD]
            link.solref_limit = [2 * step, 1.0]
            link.solimp_limit = [0.99, 0.999, 1e-4, 0.5, 2.0]
            del joint

    def write_fields(self, rig: Rig, values: FloatArray) -> None:
        ids = [rig.model.joint(name + LINK_SUFFIX).id for name in self.places]
        half = np.maximum(values[:, :, 0] / 2, HELD)
        ranges = rig.array("jnt_range")
        ranges[:, ids, 0], ranges[:, ids, 1] = -half, half


@dataclass(frozen=True)
class BacklashMotor(Backlash):
    """The joint's own damping stays on the motor."""

    variant: ClassVar[str] = "motor"


def add_link_joint(spec: mujoco.MjSpec, name: str, *, damping_on_link: bool) -> None:
    """Split a joint into a motor side (the joint itself) and a link side (a second one, same axis).

    The rotor's inertia, friction and servo stay on the motor side; a rotor that the model gives no inertia gets a
    trace of the joint's, because a side without any cannot be simulated.
    """
    joint = spec.joint(name)
    if joint.armature == 0:
        plain = spec.copy().compile()
        joint.armature = ROTOR_SHARE * float(plain.dof_M0[plain.joint(name).dofadr[0]])
    link = joint.parent.add_joint(name=name + LINK_SUFFIX, type=joint.type, axis=joint.axis, pos=joint.pos)
    link.damping = [0.0, 0.0, 0.0]
    link.armature = 0.0
    if not damping_on_link:
        return
    damping = np.array(joint.damping)
    joint.damping = [0.0, 0.0, 0.0]
    tendon = spec.add_tendon(name=name + LINK_SUFFIX)
    tendon.damping = damping
    tendon.wrap_joint(name, 1.0)
    tendon.wrap_joint(name + LINK_SUFFIX, 1.0)
