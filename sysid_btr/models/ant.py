"""The six-legged ant of the Back-to-Reality paper (Zagal et al. 2009, section 4.1), doi:10.1016/j.robot.2009.03.010.

Six legs of two segments each (femur; tibia and tarsus), three servos a leg, a free base on a floor. The paper gives
no dimensions, masses or gains, so those here are of an animat of hand size; its integral terms are left out of the
servos, because nothing in a walk lasts long enough for them to matter. ``length:BODY`` is the length of a segment
as a factor of the nominal, written into compiled fields.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import cos, pi, sin
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from sysid_btr._typing import FloatArray
from sysid_btr.errors import UsageError
from sysid_btr.models.robot import Robot, robot_from_spec
from sysid_btr.terms.base import BatchModel, Fields, Kind, Scope, Term
from sysid_btr.terms.inertial import allow_any_inertia

if TYPE_CHECKING:
    import mujoco

FEMUR, TIBIA, RADIUS = 0.10, 0.14, 0.012
"""m, nominal lengths of the segments and radius of all of them."""
DENSITY = 1000.0
"""kg/m3, of the segments."""
TRUNK, TRUNK_MASS = (0.14, 0.05, 0.03), 0.8
"""m, half extents of the trunk; kg."""
KP, KV, STALL = 6.0, 0.15, 3.0
"""Nm/rad, Nm s/rad and Nm of every servo."""
ARMATURE, DAMPING = 0.002, 0.02
"""kg m2 and Nm s/rad of every joint."""
FRICTION = 0.9
LIFTED, BENT = 0.35, 1.35
"""rad, femurs above the horizontal and tibias below the femurs, where all joint angles are zero."""

ROWS = {"F": (0.12, 0.6), "M": (0.0, 0.0), "R": (-0.12, -0.6)}
"""Row of legs -> (place along the trunk m, direction forward of sideways rad)."""
LEGS = tuple(side + row for side in "LR" for row in ROWS)
JOINTS = tuple(leg + part for leg in LEGS for part in ("Coxa", "Femur", "Tibia"))
"""Joints by leg: swing about the vertical, lift of the femur, bend of the knee."""
UNKNOWN = ("LFFemur", "RFTibia", "RMFemur", "LRTibia")
"""The four segments whose lengths are to be identified in the paper's experiment."""


@dataclass(frozen=True)
class SegmentLength(Term):
    """Length of a capsule-shaped segment as a factor of the nominal; its mass follows, its radius stays."""

    name: ClassVar[str] = "length"
    scope: ClassVar[Scope] = "body"
    kinds: ClassVar[tuple[Kind, ...]] = (Kind("scale", "1", 1.0, 0.6, 1.4, 0.05),)

    def edit_spec(self, spec: mujoco.MjSpec) -> None:
        allow_any_inertia(spec, self.places)

    def model_fields(self, batch: BatchModel, values: FloatArray) -> Fields:
        model = batch.model
        names = ("geom_pos", "geom_size", "geom_rbound", "geom_aabb", "body_pos", "site_pos")
        fields = {name: batch.read(name) for name in (*names, "body_mass", "body_inertia", "body_ipos")}
        geom_pos, geom_size, rbound, aabb, body_pos, site_pos, mass, inertia, ipos = fields.values()
        for place, name in enumerate(self.places):
            body = model.body(name).id
            geom = _capsule(model, body)
            factor = values[:, place, 0]
            radius, half = model.geom_size[geom, 0], model.geom_size[geom, 1]
            new = half * factor
            geom_pos[:, geom] *= factor[:, None]
            geom_size[:, geom, 1] = new
            rbound[:, geom] = new + radius
            aabb[:, geom, 5] = new + radius
            for child in np.flatnonzero(model.body_parentid == body):
                body_pos[:, child] *= factor[:, None]
            for site in np.flatnonzero(model.site_bodyid == body):
                site_pos[:, site] *= factor[:, None]
            # as a factor, so that it goes together with a factor on the mass
            before, after = _capsule_inertia(radius, half), _capsule_inertia(radius, new)
            mass[:, body] *= after[0] / before[0]
            inertia[:, body] *= np.stack([after[1], after[1], after[2]], axis=-1) / [before[1], before[1], before[2]]
            ipos[:, body] *= factor[:, None]
        return fields


def _capsule(model: mujoco.MjModel, body: int) -> int:
    """The one geom of a segment, which begins at the body's origin."""
    import mujoco

    geoms = np.flatnonzero(model.geom_bodyid == body)
    if len(geoms) != 1 or int(model.geom_type[geoms[0]]) != int(mujoco.mjtGeom.mjGEOM_CAPSULE):
        raise UsageError(f"length:{model.body(body).name}: only a body of one capsule is a segment with a length")
    return int(geoms[0])


def _capsule_inertia(radius: float, half: Any) -> tuple[Any, Any, Any]:
    """Mass, and moments across and along the axis, of a capsule of unit density."""
    cylinder, ball = 2 * pi * radius**2 * half, 4 / 3 * pi * radius**3
    along = cylinder * radius**2 / 2 + ball * 2 * radius**2 / 5
    # hemispheres have their centres 3/8 of the radius beyond the ends of the cylinder
    across = cylinder * (radius**2 / 4 + half**2 / 3) + ball * (2 * radius**2 / 5 + half**2 + 3 * half * radius / 4)
    return cylinder + ball, across, along


def ant() -> Robot:
    """The ant with all segments at their nominal lengths."""
    return robot_from_spec("ant", _make_spec, fields={"length": SegmentLength})


def _make_spec() -> mujoco.MjSpec:
    import mujoco

    spec = mujoco.MjSpec()
    spec.modelname = "ant"
    spec.compiler.degree = False
    spec.option.timestep = 0.005
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.worldbody.add_geom(
        name="floor",
        type=mujoco.mjtGeom.mjGEOM_PLANE,
        size=[20.0, 20.0, 0.1],
        conaffinity=2,
        friction=[FRICTION, 0.005, 0.0001],
    )
    foot = FEMUR * sin(LIFTED) + TIBIA * sin(LIFTED - BENT)
    trunk = spec.worldbody.add_body(name="Trunk", pos=[0.0, 0.0, RADIUS - foot])
    trunk.add_freejoint(name="root")
    body = trunk.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=list(TRUNK), mass=TRUNK_MASS)
    body.contype, body.conaffinity = 2, 1
    trunk.add_site(name="imu")
    for leg in LEGS:
        _add_leg(trunk, leg)
    for joint in JOINTS:
        servo = spec.add_actuator(name=joint, target=joint, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        servo.set_to_position(kp=KP, kv=KV)
        servo.forcelimited = mujoco.mjtLimited.mjLIMITED_TRUE
        servo.forcerange = [-STALL, STALL]
        spec.add_sensor(
            name=f"position_{joint}",
            type=mujoco.mjtSensor.mjSENS_JOINTPOS,
            objtype=mujoco.mjtObj.mjOBJ_JOINT,
            objname=joint,
        )
    site = mujoco.mjtObj.mjOBJ_SITE
    spec.add_sensor(name="gyro", type=mujoco.mjtSensor.mjSENS_GYRO, objtype=site, objname="imu")
    spec.add_sensor(name="acc", type=mujoco.mjtSensor.mjSENS_ACCELEROMETER, objtype=site, objname="imu")
    for leg in LEGS:
        touch = mujoco.mjtSensor.mjSENS_TOUCH
        spec.add_sensor(name=f"force_{leg}Foot", type=touch, objtype=site, objname=f"{leg}Foot")
    return spec


def _add_leg(trunk: Any, leg: str) -> None:
    """One leg in a vertical plane: a coxa that swings, a femur upwards, a tibia down to the foot."""
    import mujoco

    side = 1.0 if leg[0] == "L" else -1.0
    along, ahead = ROWS[leg[1]]
    heading = side * (pi / 2 - ahead)

    def hinge(parent: Any, part: str, axis: list[float], low: float, high: float) -> None:
        parent.add_joint(
            name=leg + part,
            type=mujoco.mjtJoint.mjJNT_HINGE,
            axis=axis,
            range=[low, high],
            limited=mujoco.mjtLimited.mjLIMITED_FALSE,
            armature=ARMATURE,
            damping=[DAMPING, 0.0, 0.0],
        )

    def segment(parent: Any, length: float, angle: float) -> Any:
        end = [length * cos(angle), 0.0, length * sin(angle)]
        geom = parent.add_geom(
            type=mujoco.mjtGeom.mjGEOM_CAPSULE, fromto=[0.0, 0.0, 0.0, *end], size=[RADIUS, 0, 0], density=DENSITY
        )
        geom.contype, geom.conaffinity = 0, 0
        geom.friction = [FRICTION, 0.005, 0.0001]
        return geom, end

    coxa = trunk.add_body(
        name=leg + "Coxa", pos=[along, side * TRUNK[1], 0.0], quat=[cos(heading / 2), 0.0, 0.0, sin(heading / 2)]
    )
    coxa.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[RADIUS, 0, 0], mass=0.02, contype=0, conaffinity=0)
    hinge(coxa, "Coxa", [0.0, 0.0, side], -0.8, 0.8)
    femur = coxa.add_body(name=leg + "Femur")
    hinge(femur, "Femur", [0.0, -1.0, 0.0], -1.2, 1.0)
    _, knee = segment(femur, FEMUR, LIFTED)
    tibia = femur.add_body(name=leg + "Tibia", pos=knee)
    hinge(tibia, "Tibia", [0.0, -1.0, 0.0], -0.8, 1.2)
    geom, end = segment(tibia, TIBIA, LIFTED - BENT)
    geom.contype, geom.conaffinity = 2, 1
    tibia.add_site(name=f"{leg}Foot", type=mujoco.mjtGeom.mjGEOM_SPHERE, pos=end, size=[1.5 * RADIUS, 0, 0])
