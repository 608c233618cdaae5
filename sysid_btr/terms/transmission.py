"""What lies between a motor and its link: backlash, compliance, cogging."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from sysid_btr._typing import FloatArray, IntArray
from sysid_btr.terms.base import LINK_SUFFIX, BatchModel, Fields, Kind
from sysid_btr.terms.effect import Effect, Probe
from sysid_btr.terms.law import Step
from sysid_btr.terms.scales import JointScale
from sysid_btr.terms.waves import nearby_waves

if TYPE_CHECKING:
    import mujoco


HELD = 1e-7
RIGID = 0.999
"""Impedance of a stop that gives way no further."""
GIVES = 1e-3
"""Fraction of the joint's motion by which its torque presses into soft stops, at which a scan looks for play."""

ROTOR_SHARE = 0.02
"""Inertia of a rotor that the model says nothing of, as a fraction of the joint's."""


@dataclass(frozen=True)
class Backlash(Effect):
    """Backlash: the link moves freely between two stops; sensor on the link, servo on the motor.

    Teeth in contact give way like a spring: a dead zone with a stiffness beyond it (Nordin and Gutman 2002,
    doi:10.1016/S0005-1098(02)00047-X). Taken for rigid, what they give way is taken for play.

    Structure: a second joint on the link, between soft stops at +-play / 2; all damping of the joint on the link.

    Friction between housing and link acts on the link, that of motor and gear on the motor; which one the
    model's own damping describes, the log must show, so the other case is the variant `motor`.
    """

    name: ClassVar[str] = "backlash"
    family: ClassVar[str] = "backlash"
    title: ClassVar[str] = "play in the gear"
    variant: ClassVar[str] = "link"
    scope: ClassVar = "drive"
    structural: ClassVar[bool] = True
    rough: ClassVar[bool] = True
    kinds: ClassVar[tuple[Kind, ...]] = (
        Kind("play", "rad", 0.0, 0.0, 0.2, 0.004),
        Kind("softness", "rad/Nm", 0.0, 0.0, 0.02, 0.0005),
    )
    held: ClassVar[tuple[str, ...]] = ("softness",)
    details: ClassVar[tuple[str, ...]] = held
    confounders: ClassVar[tuple[tuple[str, str], ...]] = (
        ("joint_compliance", "loads of several sizes"),
        ("coulomb_friction", "reversals under a load that does not change sign"),
    )

    @classmethod
    def sized(cls, scale: JointScale) -> tuple[Kind, ...]:
        soft = GIVES * max(scale.span, 1e-9) / max(scale.torque_rms, 1e-9)
        return (cls.kinds[0], Kind("softness", "rad/Nm", 0.0, 0.0, 20 * soft, soft))

    @classmethod
    def probes(cls, scale: JointScale) -> tuple[Probe, ...]:
        soft = cls.sized(scale)[1].scale
        return (((0.008, soft),), ((0.03, soft),))

    def edit_spec(self, spec: mujoco.MjSpec) -> None:
        for name in self.places:
            add_link_joint(spec, name, damping_on_link=self.variant == "link")
            link = spec.joint(name + LINK_SUFFIX)
            link.limited = True
            link.range = [-HELD, HELD]

    def model_fields(self, batch: BatchModel, values: FloatArray) -> Fields:
        """Stops as MuJoCo's soft limits: of stiffness k / R, where R = (1 - d) / d times the joint's mobility.

        k is the largest that the integrator bears, and the impedance d follows. What the limit adds to the inertia
        vanishes with the square of the step.
        """
        import mujoco

        ids = np.array([batch.model.joint(name + LINK_SUFFIX).id for name in self.places])
        half = np.maximum(values[:, :, 0] / 2, HELD)
        ranges = batch.read("jnt_range")
        ranges[:, ids, 0], ranges[:, ids, 1] = -half, half
        mobility = batch.model.dof_invweight0[batch.model.jnt_dofadr[ids]]
        steps = 1.0 if batch.model.opt.integrator == mujoco.mjtIntegrator.mjINT_RK4 else 2.0
        rate = 1 / (steps * batch.timestep) ** 2
        impedance = np.minimum(1 / (1 + rate * values[:, :, 1] / mobility), RIGID)
        solref, solimp = batch.read("jnt_solref"), batch.read("jnt_solimp")
        solref[:, ids, 0], solref[:, ids, 1] = -rate * impedance, -2 * np.sqrt(rate * impedance)
        solimp[:, ids, 0], solimp[:, ids, 1] = impedance, impedance
        return {"jnt_range": ranges, "jnt_solref": solref, "jnt_solimp": solimp}


@dataclass(frozen=True)
class BacklashMotor(Backlash):
    """The joint's own damping stays on the motor."""

    variant: ClassVar[str] = "motor"


@dataclass(frozen=True)
class BacklashGreased(Backlash):
    """Grease fills the play: the link drags along while it crosses, so that the way back is not the way out.

    Structure: as without, and native `dof_damping` of the second joint; the joint's own damping stays on the motor, as
    grease damps the link.
    """

    variant: ClassVar[str] = "greased"
    title: ClassVar[str] = "greased play in the gear"
    kinds: ClassVar[tuple[Kind, ...]] = (*Backlash.kinds, Kind("grease", "Nm s/rad", 0.0, 0.0, 10.0, 0.1))
    held: ClassVar[tuple[str, ...]] = ("softness", "grease")
    details: ClassVar[tuple[str, ...]] = ("softness",)
    includes: ClassVar[tuple[str, ...]] = ("backlash",)

    @classmethod
    def sized(cls, scale: JointScale) -> tuple[Kind, ...]:
        grease = 0.3 * scale.damping
        return (*super().sized(scale), Kind("grease", "Nm s/rad", 0.0, 0.0, 20 * grease, 0.5 * grease))

    @classmethod
    def probes(cls, scale: JointScale) -> tuple[Probe, ...]:
        grease = 0.3 * scale.damping
        return tuple(((*p, f * grease),) for (p,) in super().probes(scale) for f in (0.3, 1.0, 3.0))

    def model_fields(self, batch: BatchModel, values: FloatArray) -> Fields:
        links = [batch.model.joint(name + LINK_SUFFIX).id for name in self.places]
        damping = batch.read("dof_damping")
        damping[:, batch.model.jnt_dofadr[links]] += values[:, :, 2]
        return {**super().model_fields(batch, values), "dof_damping": damping}


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


RELAXATION = 0.004
"""Ratio of the spring's damping to its stiffness, s: well damped, as gears are."""


@dataclass(frozen=True)
class JointCompliance(Effect):
    """Compliance between motor and link: a gear or shaft that twists; sensor on the link, servo on the motor.

    Structure: a second joint on the link with a stiff spring.
    """

    name: ClassVar[str] = "joint_compliance"
    family: ClassVar[str] = "compliance"
    title: ClassVar[str] = "softness of the gear"
    variant: ClassVar[str] = "link"
    scope: ClassVar = "drive"
    structural: ClassVar[bool] = True
    kinds: ClassVar[tuple[Kind, ...]] = (Kind("softness", "rad/Nm", 0.0, 0.0, 0.2, 0.005),)
    confounders: ClassVar[tuple[tuple[str, str], ...]] = (
        ("backlash", "loads of several sizes"),
        ("kp", "a logged effort, or fast motion"),
    )

    @classmethod
    def sized(cls, scale: JointScale) -> tuple[Kind, ...]:
        size = 0.004 * max(scale.span, 1e-9) / max(scale.torque_rms, 1e-9)
        return (Kind("softness", "rad/Nm", 0.0, 0.0, 100 * size, size),)

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


@dataclass(frozen=True)
class Cogging(Effect):
    """A torque that repeats with the joint's angle: motor cogging, an eccentric gear.

    Law: torque = a sin(n q) + b cos(n q).
    """

    name: ClassVar[str] = "cogging"
    family: ClassVar[str] = "cogging"
    title: ClassVar[str] = "torque that repeats with the angle"
    held: ClassVar[tuple[str, ...]] = ("number",)
    signed: ClassVar[bool] = True
    law_acts: ClassVar[tuple[str, ...]] = ()
    kinds: ClassVar[tuple[Kind, ...]] = (
        Kind("sine", "Nm", 0.0, -5.0, 5.0, 0.05),
        Kind("cosine", "Nm", 0.0, -5.0, 5.0, 0.05),
        Kind("number", "1/rad", 20.0, 1.0, 400.0, 0.05),
    )
    confounders: ClassVar[tuple[tuple[str, str], ...]] = (
        ("encoder_cyclic_error", "a logged effort, or fast motion"),
        ("encoder_scale", "a logged effort"),
        ("joint_spring", "motion over several periods"),
    )

    @classmethod
    def sized(cls, scale: JointScale) -> tuple[Kind, ...]:
        peak, size = 2 * scale.counter_peak, 0.1 * scale.torque_rms
        turn = 2 * np.pi / max(scale.span, 1e-9)
        return (
            Kind("sine", "Nm", 0.0, -peak, peak, size),
            Kind("cosine", "Nm", 0.0, -peak, peak, size),
            Kind("number", "1/rad", 4 * turn, turn, 200 * turn, 0.05 * turn),
        )

    @classmethod
    def probes(cls, scale: JointScale) -> tuple[Probe, ...]:
        return ()

    @classmethod
    def probe_at(cls, scale: JointScale, number: float) -> Probe:
        """A probe at a spatial frequency that the residual proposes."""
        size = 0.1 * scale.torque_rms
        return ((size, 0.0, number), (0.0, size, number))

    @classmethod
    def initial_guesses(cls, values: FloatArray) -> FloatArray:
        return nearby_waves(values)

    @staticmethod
    def law(step: Step, numbers: FloatArray, memory: FloatArray, places: IntArray) -> None:
        for p, j in enumerate(places):
            phase = numbers[p, 2] * step.qpos[j]
            step.joint_torque[j] += numbers[p, 0] * math.sin(phase) + numbers[p, 1] * math.cos(phase)
