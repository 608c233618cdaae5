"""A robot read from MJCF and rebuilt for Pinocchio.

MuJoCo only compiles the file; inertias, placements, axes, servos and passive joint terms are taken from its
arrays. From there on Pinocchio computes the dynamics, and nothing of MuJoCo's integrator, constraint solver
or actuators is used.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    Array = NDArray[np.float64]

ROBOTS = Path(__file__).parent / "robots"


@dataclass(frozen=True)
class Body:
    """A rigid body: where its frame sits in its parent's, its inertia, and its joints in order.

    `placement` is a 4x4 homogeneous matrix; `inertia` (3, 3) is about the centre of mass `com` (3,), in the
    body frame.
    """

    name: str
    parent: int
    placement: Array
    mass: float
    com: Array
    inertia: Array
    joints: tuple[int, ...]

    def scaled(self, factor: float) -> Body:
        """The same body with mass and inertia multiplied by `factor`."""
        return replace(self, mass=self.mass * factor, inertia=self.inertia * factor)

    def with_point_mass(self, mass: float, offset: Array) -> Body:
        """The same body with a point mass (kg) attached at `offset` (m, body frame)."""
        total = self.mass + mass
        com = (self.mass * self.com + mass * offset) / total
        inertia = self.inertia + _point_inertia(self.mass, self.com - com) + _point_inertia(mass, offset - com)
        return replace(self, mass=total, com=com, inertia=inertia)


def _point_inertia(mass: float, lever: Array) -> Array:
    return mass * (float(lever @ lever) * np.eye(3) - np.outer(lever, lever))


@dataclass(frozen=True)
class Robot:
    """What the recorder knows of a robot. Joint arrays have length n and the order of `joints`.

    `kp` (N m/rad), `kv` (N m s/rad) belong to the position servo; `motors` are joints whose drive gives the torque
    that is commanded (N m at the joint) instead; `damping`, `armature`, `frictionloss`, `stiffness`, `rest` are the
    joint's own; `torque_limit` is inf where the file sets none. SI units.
    """

    name: str
    path: Path
    bodies: tuple[Body, ...]
    joints: tuple[str, ...]
    sliding: tuple[bool, ...]
    axes: Array
    anchors: Array
    reference: Array
    range: Array
    kp: Array
    kv: Array
    motors: NDArray[np.bool_]
    damping: Array
    armature: Array
    frictionloss: Array
    stiffness: Array
    rest: Array
    torque_limit: Array
    gravity: Array

    @property
    def n(self) -> int:
        """Number of joints."""
        return len(self.joints)

    def body(self, name: str) -> Body:
        """The body called `name`; KeyError with the names there are."""
        for body in self.bodies:
            if body.name == name:
                return body
        raise KeyError(f"no body {name!r} in {self.path.name}; bodies: {', '.join(b.name for b in self.bodies)}")

    def with_bodies(self, changed: Mapping[str, Body]) -> Robot:
        """The same robot with the named bodies replaced."""
        for name in changed:
            self.body(name)
        return replace(self, bodies=tuple(changed.get(b.name, b) for b in self.bodies))

    def indices(self, names: tuple[str, ...]) -> NDArray[np.intp]:
        """Joint numbers of `names`; all joints when `names` is empty."""
        if not names:
            return np.arange(self.n)
        unknown = [name for name in names if name not in self.joints]
        if unknown:
            raise KeyError(f"no joint {', '.join(unknown)} in {self.path.name}; joints: {', '.join(self.joints)}")
        return np.array([self.joints.index(name) for name in names])


def load_robot(source: str | Path) -> Robot:
    """Read an MJCF file, or one of the recorder's own robots by name (`six_joint_leg`, `pendulum`).

    Raises ValueError for what the recorder cannot hold: free or ball joints, actuators that are neither position
    servos nor motors.
    """
    import mujoco

    path = Path(source)
    if not path.suffix:
        path = ROBOTS / f"{source}.xml"
    if not path.exists():
        known = ", ".join(sorted(p.stem for p in ROBOTS.glob("*.xml")))
        raise FileNotFoundError(f"no robot {source!s}: give an MJCF file or one of {known}")
    m: Any = mujoco.MjModel.from_xml_path(str(path))
    hinge, slide = int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE)
    for j in range(m.njnt):
        if m.jnt_type[j] not in (hinge, slide):
            raise ValueError(f"{path.name}: joint {m.joint(j).name!r} is neither hinge nor slide; hold the torso")
    kp, kv, limit = np.zeros(m.nv), np.zeros(m.nv), np.full(m.nv, np.inf)
    motors = np.zeros(m.nv, dtype=bool)
    for a in range(m.nu):
        j = int(m.actuator_trnid[a, 0])
        gain, bias, gear = m.actuator_gainprm[a], m.actuator_biasprm[a], float(m.actuator_gear[a, 0])
        at_joint = m.actuator_trntype[a] == int(mujoco.mjtTrn.mjTRN_JOINT)
        motor = int(m.actuator_biastype[a]) == int(mujoco.mjtBias.mjBIAS_NONE)
        servo = gear == 1.0 and bias[0] == 0.0 and bias[1] == -gain[0]
        if not at_joint or not (motor or servo):
            name = m.actuator(a).name
            raise ValueError(f"{path.name}: actuator {name!r} is neither a position servo with gear 1 nor a motor")
        motors[j] = motor
        if servo:
            kp[j], kv[j] = gain[0], -bias[2]
        if m.actuator_forcelimited[a]:
            limit[j] = m.actuator_forcerange[a, 1] * gear
    limits = m.jnt_range.copy()
    limits[(limits == 0.0).all(axis=1)] = [-1.0, 1.0]
    return Robot(
        name=_robot_name(path),
        path=path,
        bodies=tuple(_body(m, b) for b in range(1, m.nbody)),
        joints=tuple(m.joint(j).name for j in range(m.njnt)),
        sliding=tuple(bool(t == slide) for t in m.jnt_type),
        axes=m.jnt_axis.copy(),
        anchors=m.jnt_pos.copy(),
        reference=m.qpos0.copy(),
        range=limits,
        kp=kp,
        kv=kv,
        motors=motors,
        damping=m.dof_damping.copy(),
        armature=m.dof_armature.copy(),
        frictionloss=m.dof_frictionloss.copy(),
        stiffness=m.jnt_stiffness.copy(),
        rest=m.qpos_spring.copy(),
        torque_limit=limit,
        gravity=m.opt.gravity.copy(),
    )


def _robot_name(path: Path) -> str:
    import xml.etree.ElementTree as ET

    return ET.parse(path).getroot().get("model") or path.stem


def _body(m: Any, b: int) -> Body:
    import mujoco

    def rotation(quat: Array) -> Array:
        flat = np.zeros(9)
        mujoco.mju_quat2Mat(flat, quat)
        return flat.reshape(3, 3)

    placement = np.eye(4)
    placement[:3, :3] = rotation(m.body_quat[b])
    placement[:3, 3] = m.body_pos[b]
    principal = rotation(m.body_iquat[b])
    first = int(m.body_jntadr[b])
    return Body(
        name=m.body(b).name,
        parent=int(m.body_parentid[b]) - 1,  # -1: the world
        placement=placement,
        mass=float(m.body_mass[b]),
        com=m.body_ipos[b].copy(),
        inertia=principal @ np.diag(m.body_inertia[b]) @ principal.T,
        joints=tuple(range(first, first + int(m.body_jntnum[b]))) if first >= 0 else (),
    )


def build_pinocchio(robot: Robot, armature: Array | None = None) -> Any:
    """The Pinocchio model of `robot`; joint i of one is joint i of the other.

    `armature` (n,) replaces the robot's (used where the rotor is a state of its own). A fixed body is merged
    into the joint that carries it; a joint anchor away from the body's origin becomes a shift of the joint
    frame.
    """
    import pinocchio as pin

    model = pin.Model()
    model.gravity.linear = robot.gravity
    carrier: list[tuple[int, Any]] = []  # for each body: Pinocchio joint, and the body frame in that joint's frame
    for body in robot.bodies:
        parent, frame = (0, pin.SE3.Identity()) if body.parent < 0 else carrier[body.parent]
        frame = frame * pin.SE3(body.placement)
        for j in body.joints:
            axis, anchor, ref = robot.axes[j], robot.anchors[j], robot.reference[j]
            shift = pin.SE3(np.eye(3), anchor)
            if robot.sliding[j]:
                back, kind = pin.SE3(np.eye(3), -ref * axis), pin.JointModelPrismaticUnaligned(axis)
            else:
                back, kind = (pin.SE3(pin.exp3(-ref * axis), np.zeros(3)), pin.JointModelRevoluteUnaligned(axis))
            parent = model.addJoint(parent, kind, frame * shift * back, robot.joints[j])
            if model.joints[parent].idx_v != j:
                raise ValueError(f"joint {robot.joints[j]!r} changed its place in the order of joints")
            frame = shift.inverse()
        model.appendBodyToJoint(parent, pin.Inertia(body.mass, body.com, body.inertia), frame)
        carrier.append((parent, frame))
    model.armature = (robot.armature if armature is None else armature).copy()
    return model
