"""Joints that share a part of their drive train."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

from sysid_btr._typing import FloatArray
from sysid_btr.terms.base import BatchModel, Fields, Kind
from sysid_btr.terms.effect import Effect, Probe
from sysid_btr.terms.scales import JointScale

if TYPE_CHECKING:
    import mujoco

COUPLING_SUFFIX = "__coupling"
"""Name ending of the tendon that moves with two joints."""


@dataclass(frozen=True)
class DriveCoupling(Effect):
    """A motor that turns with a joint and the next one together, as the last motor of many wrists does.

    Its rotor's inertia and its friction act on the sum of both joints' motions, so on both joints alike (Staubli TX40:
    Janot, Vandanjon, Gautier 2014, doi:10.1109/TCST.2013.2246163). The place is the first of the two joints.

    Native: armature, damping and dry friction of a fixed tendon over both joints.
    """

    name: ClassVar[str] = "drive_coupling"
    family: ClassVar[str] = "coupling"
    title: ClassVar[str] = "drive shared with the next joint"
    needs: ClassVar[str] = "effort"
    variant: ClassVar[str] = "sum"
    with_next: ClassVar[float] = 1.0
    kinds: ClassVar[tuple[Kind, ...]] = (
        Kind("coulomb", "Nm", 0.0, 0.0, 10.0, 0.05),
        Kind("viscous", "Nm s/rad", 0.0, 0.0, 10.0, 0.05),
        Kind("inertia", "kg m2", 0.0, 0.0, 1.0, 0.001),
    )
    confounders: ClassVar[tuple[tuple[str, str], ...]] = (
        ("coulomb_friction", "motion of both joints against and with each other"),
    )

    @classmethod
    def sized(cls, scale: JointScale) -> tuple[Kind, ...]:
        return (
            Kind("coulomb", "Nm", 0.0, 0.0, scale.counter_peak, 0.15 * scale.torque_rms),
            Kind("viscous", "Nm s/rad", 0.0, 0.0, 5 * scale.damping, 0.1 * scale.damping),
            Kind("inertia", "kg m2", 0.0, 0.0, 5 * scale.inertia, 0.05 * scale.inertia),
        )

    @classmethod
    def probes(cls, scale: JointScale) -> tuple[Probe, ...]:
        sizes = [kind.scale for kind in cls.sized(scale)]
        return (tuple(tuple(s if i == k else 0.0 for i, s in enumerate(sizes)) for k in range(len(sizes))),)

    def edit_spec(self, spec: mujoco.MjSpec) -> None:
        for place in self.places:
            following = _next_joint(spec, place)
            if following is None or spec.tendon(place + COUPLING_SUFFIX) is not None:
                continue
            tendon = spec.add_tendon(name=place + COUPLING_SUFFIX)
            tendon.wrap_joint(place, 1.0)
            tendon.wrap_joint(following, self.with_next)
            # dry friction is a row of the solver only where the compiled model has some
            tendon.solref_friction = spec.joint(place).solref_friction
            tendon.solimp_friction = spec.joint(place).solimp_friction

    def model_fields(self, batch: BatchModel, values: FloatArray) -> Fields:
        names = {batch.model.tendon(t).name: t for t in range(batch.model.ntendon)}
        fields: Fields = {}
        for kind, compiled in enumerate(("tendon_frictionloss", "tendon_damping", "tendon_armature")):
            fields[compiled] = batch.read(compiled)
            for place, name in enumerate(self.places):
                if name + COUPLING_SUFFIX in names:
                    row = (slice(None), names[name + COUPLING_SUFFIX], 0)[: fields[compiled].ndim]
                    fields[compiled][row] += values[:, place, kind]
        return fields


@dataclass(frozen=True)
class DriveCouplingDifference(DriveCoupling):
    """The motor turns with the difference of both joints' motions."""

    variant: ClassVar[str] = "difference"
    label: ClassVar[str] = "drive_coupling.difference"
    with_next: ClassVar[float] = -1.0


def _next_joint(spec: mujoco.MjSpec, joint: str) -> str | None:
    """The first joint of the only body that is moved by a joint's body; None where there is no such joint."""
    import mujoco

    single = (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE)
    own = spec.joint(joint).parent
    joints = [j for j in own.joints if j.type in single]
    names = [j.name for j in joints]
    if names.index(joint) + 1 < len(names):
        return str(names[names.index(joint) + 1])
    children = [body for body in own.bodies if body.joints]
    if len(children) != 1 or children[0].joints[0].type not in single:
        return None
    return str(children[0].joints[0].name)
