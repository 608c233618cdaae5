"""The Nao humanoid of the Back-to-Reality paper, from one table.

``nao`` has the geometry that Table 1 of the paper was rounded from; ``nao:table1`` has the table as it was
printed: two decimals, the lower legs without the thigh's offset, LAnkleRoll about the wrong axis. The table
gives centres of geometries only, so there a joint sits at the centre of its own geometry, except that the
joints of one shoulder, elbow, hip or ankle share one point.

Vectors in the table are in the paper's frame: x left, y up, z forward, m.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from sysid_btr._typing import FloatArray
from sysid_btr.models.robot import Robot, robot_from_spec

if TYPE_CHECKING:
    import mujoco

Vector = tuple[float, float, float]
Shape = Literal["box", "cylinder", "sphere"]

X, Y, Z = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)
ORIGIN = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Servo:
    """Position servo, Nm/rad and Nm s/rad."""

    kp: float
    kv: float


HEAD, SHOULDER, ELBOW = Servo(5.0, 0.1), Servo(8.0, 0.16), Servo(6.0, 0.12)
HIP, KNEE, ANKLE = Servo(30.0, 0.6), Servo(30.0, 0.6), Servo(22.0, 0.44)
ARMATURE = 0.006
"""kg m2, of every joint."""
DAMPING = 0.08
"""Nm s/rad, of every joint."""
FOOT_FRICTION = 0.8
EDGE = 0.002
"""m, by which force sensors reach beyond the sole."""


@dataclass(frozen=True)
class Printed:
    """What Table 1 prints for a body: mass, centre of the geometry in the root's frame, size."""

    mass: float
    centre: Vector
    size: Vector


@dataclass(frozen=True)
class Part:
    """One body and the hinge it hangs on.

    Attributes
    ----------
    name, parent : bodies; a joint is called as its body.
    anchor : joint in the frame of the parent's joint.
    axis : of the joint.
    limits : rad (Aldebaran documentation, H21 and H25 V3); stated, not enforced.
    servo : gains.
    mass : kg.
    shape, size : box with full extents, cylinder or sphere with radius (and height).
    offset : centre of the geometry in the joint's frame.
    printed : the row of Table 1.
    """

    name: str
    parent: str
    anchor: Vector
    axis: Vector
    limits: tuple[float, float]
    servo: Servo | None
    mass: float
    shape: Shape
    size: Vector
    offset: Vector
    printed: Printed


BALL = (0.01, 0.0, 0.0)
TORSO = Part(
    "Torso", "", ORIGIN, ORIGIN, (0, 0), None, 1.2171, "box", (0.10, 0.18, 0.10), (0, 0.07, -0.02),
    Printed(1.22, (0, 0.07, -0.02), (0.10, 0.18, 0.10)),
)  # fmt: skip
NECK = (
    Part("HeadYaw", "Torso", (0, 0.16, -0.02), Y, (-2.0857, 2.0857), HEAD,
         0.050, "cylinder", (0.015, 0.08, 0), ORIGIN,
         Printed(0.05, (0, 0.16, -0.02), (0.01, 0.08, 0))),
    Part("HeadPitch", "HeadYaw", (0, 0.06, 0), X, (-0.672, 0.515), HEAD,
         0.351, "sphere", (0.065, 0, 0), (0, 0.005, 0),
         Printed(0.35, (0, 0.22, 0), (0.07, 0, 0))),
)  # fmt: skip
LEFT = (
    Part("ShoulderPitch", "Torso", (0.085, 0.145, -0.02), X, (-2.0857, 2.0857), SHOULDER,
         0.053, "sphere", BALL, ORIGIN,
         Printed(0.05, (0.09, 0.14, -0.02), BALL)),
    Part("ShoulderRoll", "ShoulderPitch", ORIGIN, Y, (0.0087, 1.649), SHOULDER,
         0.110, "box", (0.07, 0.06, 0.08), (0.01, 0, 0.02),
         Printed(0.11, (0.10, 0.14, 0), (0.07, 0.06, 0.08))),
    Part("ElbowYaw", "ShoulderRoll", (0.006, 0.009, 0.09), Z, (-2.0857, 2.0857), ELBOW,
         0.030, "sphere", BALL, ORIGIN,
         Printed(0.03, (0.10, 0.15, 0.07), BALL)),
    Part("ElbowRoll", "ElbowYaw", ORIGIN, Y, (-1.562, -0.0087), ELBOW,
         0.057, "box", (0.05, 0.05, 0.11), (0, 0, 0.05),
         Printed(0.06, (0.10, 0.15, 0.12), (0.05, 0.05, 0.11))),
    Part("HipYawPitch", "Torso", (0.055, -0.045, -0.03), (0.5**0.5, -(0.5**0.5), 0), (-1.145, 0.741), HIP,
         0.100, "sphere", BALL, ORIGIN,
         Printed(0.10, (0.06, -0.04, -0.03), BALL)),
    Part("HipRoll", "HipYawPitch", ORIGIN, Z, (-0.379, 0.790), HIP,
         0.140, "sphere", BALL, ORIGIN,
         Printed(0.14, (0.06, -0.04, -0.03), BALL)),
    Part("HipPitch", "HipRoll", ORIGIN, X, (-1.536, 0.484), HIP,
         0.293, "box", (0.07, 0.14, 0.07), (0, -0.04, 0.01),
         Printed(0.29, (0.06, -0.09, -0.02), (0.07, 0.14, 0.07))),
    Part("KneePitch", "HipPitch", (0, -0.12, 0.005), X, (-0.092, 2.113), KNEE,
         0.423, "box", (0.08, 0.11, 0.07), (0, -0.045, 0.01),
         Printed(0.42, (0.06, -0.13, -0.01), (0.08, 0.11, 0.07))),
    Part("AnklePitch", "KneePitch", (0, -0.10, 0), X, (-1.189, 0.923), ANKLE,
         0.058, "sphere", BALL, ORIGIN,
         Printed(0.06, (0.06, -0.23, -0.01), BALL)),
    Part("AnkleRoll", "AnklePitch", ORIGIN, Z, (-0.398, 0.769), ANKLE,
         0.100, "box", (0.08, 0.02, 0.16), (0, -0.04, 0.03),
         Printed(0.10, (0.06, -0.27, 0.02), (0.08, 0.02, 0.16))),
)  # fmt: skip
"""The left limbs; the right ones are their mirror image."""
MISPRINTED_AXES = {"LAnkleRoll": Y}
"""Joint axes that Table 1 states wrongly."""

FEET = ("RAnkleRoll", "LAnkleRoll")
TIED = (("LHipYawPitch", "RHipYawPitch"),)
"""Joints on one motor."""
STARRED = tuple(side + part for part in ("ShoulderRoll", "HipRoll", "HipPitch", "KneePitch") for side in "RL")
"""Bodies whose masses span the paper's search space."""
PAPER_BOUNDS = {f"mass:{name}": (0.5, 1.5) for name in STARRED}
"""The paper's search space, +-50 % of the nominal masses: ``replace(nao(), bounds=PAPER_BOUNDS)``."""


def nao() -> Robot:
    """Nao with the geometry that the paper's table was rounded from."""
    return robot_from_spec("nao", partial(_make_spec, _parts()), tied=TIED)


def nao_table1() -> Robot:
    """Nao as printed in Table 1."""
    return robot_from_spec("nao:table1", partial(_make_spec, _as_printed(_parts())), tied=TIED)


def _parts() -> tuple[Part, ...]:
    """All bodies with their geometry as designed, parents first."""
    right = tuple(_named(_mirrored(part), "R") for part in LEFT)
    left = tuple(_named(part, "L") for part in LEFT)
    return (TORSO, *NECK, *right, *left)


def _named(part: Part, side: str) -> Part:
    parent = part.parent if part.parent == "Torso" else side + part.parent
    return replace(part, name=side + part.name, parent=parent)


def _mirrored(part: Part) -> Part:
    """The right side: x changes its sign, and angles about y and z theirs."""
    turns = part.axis[0] == 0
    low, high = part.limits
    printed = part.printed
    return replace(
        part,
        anchor=_flip(part.anchor),
        axis=(part.axis[0], -part.axis[1], part.axis[2]) if part.axis[0] else part.axis,
        limits=(-high, -low) if turns else part.limits,
        offset=_flip(part.offset),
        printed=replace(printed, centre=_flip(printed.centre)),
    )


def _flip(vector: Vector) -> Vector:
    return (-vector[0], vector[1], vector[2])


def _as_printed(parts: tuple[Part, ...]) -> tuple[Part, ...]:
    """The same bodies as Table 1 has them; a joint that shares its parent's point keeps doing so."""
    joints: dict[str, FloatArray] = {}
    result = []
    for part in parts:
        centre = np.array(part.printed.centre)
        shares = part.parent != "" and part.anchor == ORIGIN
        joint = joints[part.parent] if shares else centre
        joints[part.name] = joint
        anchor = joint - joints[part.parent] if part.parent else joint
        result.append(
            replace(
                part,
                anchor=_vector(anchor),
                axis=MISPRINTED_AXES.get(part.name, part.axis),
                mass=part.printed.mass,
                size=part.printed.size,
                offset=_vector(centre - joint),
            )
        )
    return tuple(result)


def _vector(array: FloatArray) -> Vector:
    x, y, z = (round(float(v), 9) + 0.0 for v in array)
    return (x, y, z)


def _world(vector: Vector) -> list[float]:
    """From the paper's frame to x forward, y left, z up."""
    x, y, z = vector
    return [z, x, y]


def _make_spec(parts: tuple[Part, ...]) -> mujoco.MjSpec:
    import mujoco

    spec = mujoco.MjSpec()
    spec.modelname = "nao"
    spec.compiler.degree = False
    spec.option.timestep = 0.005
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_RK4
    spec.worldbody.add_geom(
        name="floor",
        type=mujoco.mjtGeom.mjGEOM_PLANE,
        size=[5.0, 5.0, 0.1],
        conaffinity=2,
        friction=[FOOT_FRICTION, 0.005, 0.0001],
    )
    bodies: dict[str, Any] = {}
    heights: dict[str, float] = {"": 0.0}
    for part in parts:
        heights[part.name] = heights[part.parent] + part.anchor[1]
        parent = bodies[part.parent] if part.parent else spec.worldbody
        bodies[part.name] = _add_body(parent, part)
    sole = min(heights[p.name] + p.offset[1] - p.size[1] / 2 for p in parts if p.name in FEET)
    torso = next(p for p in parts if not p.parent)
    root = bodies[torso.name]
    root.pos = _world((torso.anchor[0], torso.anchor[1] - sole, torso.anchor[2]))
    root.add_freejoint(name="root")
    for pair in TIED:
        tie = spec.add_equality(name="_".join(pair), type=mujoco.mjtEq.mjEQ_JOINT, objtype=mujoco.mjtObj.mjOBJ_JOINT)
        tie.name1, tie.name2 = pair
        tie.data[:5] = [0.0, 1.0, 0.0, 0.0, 0.0]
        tie.solref = [0.01, 1.0]
        tie.solimp = [0.99, 0.999, 0.001, 0.5, 2.0]
    for part in parts:
        if part.servo is not None:
            servo = spec.add_actuator(name=part.name, target=part.name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
            servo.set_to_position(kp=part.servo.kp, kv=part.servo.kv)
    _add_sensors(spec, parts, bodies)
    return spec


def _add_body(parent: Any, part: Part) -> Any:
    import mujoco

    body = parent.add_body(name=part.name, pos=_world(part.anchor))
    if part.parent:
        body.add_joint(
            name=part.name,
            type=mujoco.mjtJoint.mjJNT_HINGE,
            axis=_world(part.axis),
            range=list(part.limits),
            limited=mujoco.mjtLimited.mjLIMITED_FALSE,
            armature=ARMATURE,
            damping=[DAMPING, 0.0, 0.0],
        )
    kinds = {
        "box": (mujoco.mjtGeom.mjGEOM_BOX, [s / 2 for s in _world(part.size)]),
        "cylinder": (mujoco.mjtGeom.mjGEOM_CYLINDER, [part.size[0], part.size[1] / 2, 0.0]),
        "sphere": (mujoco.mjtGeom.mjGEOM_SPHERE, [part.size[0], 0.0, 0.0]),
    }
    kind, size = kinds[part.shape]
    geom = body.add_geom(type=kind, size=size, pos=_world(part.offset), mass=part.mass)
    geom.contype, geom.conaffinity = (2, 1) if part.name in FEET else (0, 0)
    if part.name in FEET:
        geom.friction = [FOOT_FRICTION, 0.005, 0.0001]
    return body


def _add_sensors(spec: mujoco.MjSpec, parts: tuple[Part, ...], bodies: dict[str, Any]) -> None:
    """Encoders, the inertial unit in the middle of the torso, and the forces under the feet."""
    import mujoco

    joint, site = mujoco.mjtObj.mjOBJ_JOINT, mujoco.mjtObj.mjOBJ_SITE
    for part in parts:
        if part.servo is not None:
            spec.add_sensor(
                name=f"position_{part.name}", type=mujoco.mjtSensor.mjSENS_JOINTPOS, objtype=joint, objname=part.name
            )
    torso = next(p for p in parts if not p.parent)
    bodies[torso.name].add_site(name="imu", pos=_world(torso.offset))
    inertial = {"gyro": mujoco.mjtSensor.mjSENS_GYRO, "acc": mujoco.mjtSensor.mjSENS_ACCELEROMETER}
    for name, kind in inertial.items():
        spec.add_sensor(name=name, type=kind, objtype=site, objname="imu")
    for part in parts:
        if part.name in FEET:
            _add_foot_sensors(spec, part, bodies[part.name])


def _add_foot_sensors(spec: mujoco.MjSpec, part: Part, body: Any) -> None:
    """One force sensor for each quarter of the sole."""
    import mujoco

    width, height, length = part.size
    x, y, z = part.offset
    for row, forward in (("Front", 1), ("Rear", -1)):
        for column, leftward in (("Left", 1), ("Right", -1)):
            name = f"{part.name[0]}Foot{row}{column}"
            body.add_site(
                name=name,
                type=mujoco.mjtGeom.mjGEOM_BOX,
                pos=_world((x + leftward * width / 4, y - height / 2, z + forward * length / 4)),
                # contacts lie on the very edge of the sole, and a little below it
                size=[length / 4 + EDGE, width / 4 + EDGE, EDGE],
            )
            spec.add_sensor(
                name=f"force_{name}", type=mujoco.mjtSensor.mjSENS_TOUCH, objtype=mujoco.mjtObj.mjOBJ_SITE, objname=name
            )
