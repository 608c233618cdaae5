"""A legged robot in Drake, which stands for the real one: `python -m benchmarks.btr` tries controllers on it.

MuJoCo only compiles the model; bodies, joints and servos are taken from its arrays. Drake steps them (SAP, discrete
time) with implicit position servos and point contact between a level ground and small spheres: one in each lowest
corner of a sole that is a box (a box on a plane would touch it at one point), and a foot's own where that is a sphere.
Needs `pip install drake`, which nothing else asks for.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import mujoco
import numpy as np
from pydrake.common.eigen_geometry import Quaternion
from pydrake.geometry import AddContactMaterial, Box, ProximityProperties, Sphere
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph, CoulombFriction, DiscreteContactApproximation
from pydrake.multibody.tree import (
    FixedOffsetFrame,
    PdControllerGains,
    RevoluteJoint,
    RotationalInertia,
    SpatialInertia,
    default_model_instance,
)
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder

from sysid_btr._typing import FloatArray
from sysid_btr.btr.controllers import Controller, ControllerSpace
from sysid_btr.btr.robot import Noise, Played, Trial, noise_of, recorded
from sysid_btr.btr.task import Motion, Walk
from sysid_btr.btr.world import feet_geoms
from sysid_btr.models.robot import Robot
from sysid_btr.mujoco_conventions import free_joints

STEP = 0.002
"""s, of Drake's steps, unless told: of first order, they act like a latency of half of one (kv 5 % high on the Nao)."""
CORNER = 0.005
"""m, radius of the spheres in the corners of a sole."""
WIDE, DEEP = 40.0, 1.0
"""m, of the block of ground."""
STICKING = 0.005
"""rad/s, up to which a joint with dry friction creeps."""


@dataclass(frozen=True)
class Ground:
    """What feet stand on: sliding friction, stiffness of one contact point in N/m, dissipation in s/m."""

    friction: float = 0.8
    stiffness: float = 1e5
    dissipation: float = 10.0


@dataclass(frozen=True)
class Truth:
    """In what the robot differs from its model; places are names of joints (drives) and bodies.

    Attributes
    ----------
    mass : body -> factor of mass and inertia.
    payload : body -> kg and where it sits in the body's frame, m.
    kp, kv : joint -> factor; `gain` is one of all kp.
    friction : joint -> dry friction, Nm.
    limit : joint -> largest torque of its servo, Nm.
    delay : of all commands, s.
    """

    mass: Mapping[str, float] = field(default_factory=dict)
    payload: Mapping[str, tuple[float, tuple[float, float, float]]] = field(default_factory=dict)
    gain: float = 1.0
    kp: Mapping[str, float] = field(default_factory=dict)
    kv: Mapping[str, float] = field(default_factory=dict)
    friction: Mapping[str, float] = field(default_factory=dict)
    limit: Mapping[str, float] = field(default_factory=dict)
    delay: float = 0.0
    ground: Ground = field(default_factory=Ground)


@dataclass(frozen=True, eq=False)
class DrakeRobot:
    """The robot of a model in Drake, on which controllers are tried (`sysid_btr.btr.robot.Robot`).

    Attributes
    ----------
    model : whose bodies and servos it has.
    task, space : what it does, and what controllers it plays.
    truth : in what it differs from the model.
    noise : of its sensors.
    seed : of the noise; the same controller is seen with the same noise.
    step : s, of Drake's, see `STEP`.
    """

    model: Robot
    task: Walk
    space: ControllerSpace
    truth: Truth = field(default_factory=Truth)
    noise: Noise = field(default_factory=Noise)
    seed: int = 0
    step: float = STEP

    def run(self, controller: Controller) -> Trial:
        """Try a controller."""
        commands = self.space.commands(controller.values[None], self.task.time)[0]
        if not np.isfinite(commands).all():
            return Trial(None, 0.0, "crashed")
        rng = noise_of(self.seed, controller)
        return recorded(self.play(commands), self.task, self.space.joints, self.noise, rng, self.model.name)

    def play(self, commands: FloatArray) -> Played:
        """What happens while commands (n, j) of the space's joints are played."""
        return self._machine.play(commands)

    @cached_property
    def _machine(self) -> _Machine:
        return _Machine(self)


class _Machine:
    """The plant of a robot, built once."""

    def __init__(self, robot: DrakeRobot) -> None:
        self.robot, model, truth = robot, robot.model.model, robot.truth
        self.joints = robot.space.joints
        builder = DiagramBuilder()
        plant, _ = AddMultibodyPlantSceneGraph(builder, time_step=robot.step)
        plant.set_discrete_contact_approximation(DiscreteContactApproximation.kLagged)
        self.bodies = {0: plant.world_body()}
        for b in range(1, model.nbody):
            self.bodies[b] = plant.AddRigidBody(model.body(b).name, self._inertia(model, b, truth))
        base = int(model.jnt_bodyid[free_joints(model)[0]])
        self.base = self.bodies[base]
        for b in range(1, model.nbody):
            if b != base:
                self._joint(plant, model, b)
        plant.mutable_gravity_field().set_gravity_vector(model.opt.gravity)
        self.drives = []
        for name in self.joints:
            actuator = model.actuator(int(np.flatnonzero(model.actuator_trnid[:, 0] == model.joint(name).id)[0]))
            kp = actuator.gainprm[0] * truth.gain * truth.kp.get(name, 1.0)
            kv = -actuator.biasprm[2] * truth.kv.get(name, 1.0)
            drive = plant.AddJointActuator(name, plant.GetJointByName(name), truth.limit.get(name, np.inf))
            drive.set_controller_gains(PdControllerGains(p=kp, d=kv))
            drive.set_default_rotor_inertia(float(model.dof_armature[model.joint(name).dofadr[0]]))
            drive.set_default_gear_ratio(1.0)
            self.drives.append(plant.GetJointByName(name))
        for first, second in _tied(model):
            plant.AddCouplerConstraint(plant.GetJointByName(first), plant.GetJointByName(second), 1.0)
        self.points = self._ground(plant, model, truth.ground)
        plant.Finalize()
        self.plant, self.model = plant, model
        self.port = plant.get_desired_state_input_port(default_model_instance())
        self.diagram = builder.Build()

    def _pose(self, place: FloatArray, quaternion: FloatArray) -> Any:
        return RigidTransform(RotationMatrix(Quaternion(quaternion)), place)

    def _inertia(self, model: Any, body: int, truth: Truth) -> Any:
        """Of a body with what it carries, about its frame's origin."""
        name = model.body(body).name
        factor = truth.mass.get(name, 1.0)
        turn = self._pose(np.zeros(3), model.body_iquat[body]).rotation().matrix()
        parts = [(factor * float(model.body_mass[body]), model.body_ipos[body])]
        moments = factor * turn @ np.diag(model.body_inertia[body]) @ turn.T
        if name in truth.payload:
            parts.append((truth.payload[name][0], np.array(truth.payload[name][1])))
        mass = sum(part for part, _ in parts)
        centre = sum(part * place for part, place in parts) / mass
        for part, place in parts:
            lever = place - centre
            moments = moments + part * (lever @ lever * np.eye(3) - np.outer(lever, lever))
        central = RotationalInertia(*np.diag(moments), moments[0, 1], moments[0, 2], moments[1, 2])
        return SpatialInertia.MakeFromCentralInertia(mass, centre, central)

    def _joint(self, plant: Any, model: Any, body: int) -> Any:
        """The hinge of a body, or a weld where it has none."""
        parent = self.bodies[int(model.body_parentid[body])]
        pose = self._pose(model.body_pos[body], model.body_quat[body])
        count, first = int(model.body_jntnum[body]), int(model.body_jntadr[body])
        if count == 0:
            return plant.WeldFrames(parent.body_frame(), self.bodies[body].body_frame(), pose)
        if count > 1 or model.jnt_type[first] != 3:
            raise ValueError(f"body {model.body(body).name}: the robot in Drake has one hinge a body")
        anchor = self._pose(model.jnt_pos[first], np.array([1.0, 0, 0, 0]))
        name, dof = model.joint(first).name, int(model.jnt_dofadr[first])
        return plant.AddJoint(
            RevoluteJoint(
                name,
                plant.AddFrame(FixedOffsetFrame(f"{name}_in", parent, pose @ anchor)),
                plant.AddFrame(FixedOffsetFrame(f"{name}_out", self.bodies[body], anchor)),
                model.jnt_axis[first],
                float(model.dof_damping[dof]),
            )
        )

    def _ground(self, plant: Any, model: Any, ground: Ground) -> dict[Any, str]:
        """The floor and what touches it; geometry -> name of the force sensor there."""
        friction = CoulombFriction(ground.friction, ground.friction)
        material = ProximityProperties()
        AddContactMaterial(
            dissipation=ground.dissipation, point_stiffness=2 * ground.stiffness, friction=friction, properties=material
        )  # of two alike in series
        floor = RigidTransform([0.0, 0.0, -DEEP / 2])
        plant.RegisterCollisionGeometry(plant.world_body(), floor, Box(WIDE, WIDE, DEEP), "floor", material)
        points = {}
        for g in feet_geoms(model):
            body = int(model.geom_bodyid[g])
            for i, (place, radius) in enumerate(_spheres(model, int(g))):
                found = plant.RegisterCollisionGeometry(
                    self.bodies[body],
                    RigidTransform(place),
                    Sphere(radius),
                    f"{model.body(body).name}_{g}_{i}",
                    material,
                )
                points[found] = _sensor(model, body, place)
        return points

    def play(self, commands: FloatArray) -> Played:
        robot, plant = self.robot, self.plant
        task, friction = robot.task, np.array([robot.truth.friction.get(j, 0.0) for j in self.joints])
        simulator = Simulator(self.diagram)
        root = simulator.get_mutable_context()
        context = plant.GetMyMutableContextFromRoot(root)
        for joint, angle in zip(self.drives, commands[0], strict=True):
            joint.set_angle(context, angle)
        self._stand(context)
        own = np.array([joint.default_damping() for joint in self.drives])
        rough = np.flatnonzero(friction > 0)
        indices = np.array([joint.velocity_start() for joint in self.drives])
        angles = np.array([joint.position_start() for joint in self.drives])
        n, each, late = len(commands), round(task.period / robot.step), round(robot.truth.delay / robot.step)
        base, position = np.empty((n, 13)), np.empty((n, len(self.joints)))
        sensors = {name: np.zeros((n, 1)) for name in self.points.values() if name}
        sensors |= {"gyro": np.zeros((n, 3)), "acc": np.zeros((n, 3))}
        still, last = np.zeros(len(self.joints)), -1
        simulator.Initialize()
        for tick in range((n - 1) * each + 1):
            wanted = max(tick - late, 0) // each
            if wanted != last:
                self.port.FixValue(context, np.concatenate([commands[wanted], still]))
                last = wanted
            if len(rough):
                # dry friction as damping that follows the speed, which Drake solves implicitly
                speed = np.abs(plant.GetVelocities(context)[indices[rough]])
                for j, value in zip(rough, friction[rough] / np.maximum(speed, STICKING), strict=True):
                    self.drives[j].SetDamping(context, own[j] + value)
            if tick % each == 0:
                i = tick // each
                self._read(context, base[i], {name: values[i] for name, values in sensors.items()})
                position[i] = plant.GetPositions(context)[angles]
            simulator.AdvanceTo((tick + 1) * robot.step)
        return Played(Motion(self.joints, position[None], base[None]), commands, sensors)

    def _stand(self, context: Any) -> None:
        """Put the base so that the lowest point touches the floor."""
        plant, model = self.plant, self.model
        at = int(model.jnt_bodyid[free_joints(model)[0]])
        plant.SetFreeBodyPose(context, self.base, self._pose(np.zeros(3), model.body_quat[at]))
        lowest = np.inf
        for g in feet_geoms(model):
            pose = plant.EvalBodyPoseInWorld(context, self.bodies[int(model.geom_bodyid[g])])
            for place, radius in _spheres(model, int(g)):
                lowest = min(lowest, (pose @ np.asarray(place))[2] - radius)
        plant.SetFreeBodyPose(context, self.base, self._pose(np.array([0.0, 0.0, -lowest]), model.body_quat[at]))

    def _read(self, context: Any, base: FloatArray, sensors: dict[str, FloatArray]) -> None:
        plant, model = self.plant, self.model
        pose = plant.EvalBodyPoseInWorld(context, self.base)
        speed = plant.EvalBodySpatialVelocityInWorld(context, self.base)
        turn = pose.rotation().matrix()
        base[:3], base[3:7] = pose.translation(), pose.rotation().ToQuaternion().wxyz()
        base[7:10], base[10:] = speed.translational(), turn.T @ speed.rotational()
        site = model.site("imu") if "imu" in [model.site(s).name for s in range(model.nsite)] else None
        if site is not None:
            pull = plant.get_body_spatial_accelerations_output_port().Eval(context)[self.base.index()]
            lever, spin = turn @ site.pos, speed.rotational()
            acc = pull.translational() + np.cross(pull.rotational(), lever) + np.cross(spin, np.cross(spin, lever))
            sensors["gyro"][:], sensors["acc"][:] = turn.T @ spin, turn.T @ (acc - model.opt.gravity)
        contacts = plant.get_contact_results_output_port().Eval(context)
        for c in range(contacts.num_point_pair_contacts()):
            info = contacts.point_pair_contact_info(c)
            pair = info.point_pair()
            name = self.points.get(pair.id_A) or self.points.get(pair.id_B)
            if name:
                sensors[name][0] += abs(info.contact_force()[2])


def _tied(model: Any) -> list[tuple[str, str]]:
    """Joints that the model ties to one another."""
    joint = mujoco.mjtEq.mjEQ_JOINT
    return [
        (model.joint(int(model.eq_obj1id[e])).name, model.joint(int(model.eq_obj2id[e])).name)
        for e in range(model.neq)
        if model.eq_type[e] == joint
    ]


def _spheres(model: Any, geom: int) -> list[tuple[FloatArray, float]]:
    """Centre in its body's frame and radius of the spheres that stand for a foot."""
    kind, size, place = int(model.geom_type[geom]), model.geom_size[geom], model.geom_pos[geom]
    turn = np.empty(9)
    mujoco.mju_quat2Mat(turn, model.geom_quat[geom])
    axes = turn.reshape(3, 3)
    if kind == mujoco.mjtGeom.mjGEOM_SPHERE:
        return [(place, float(size[0]))]
    if kind == mujoco.mjtGeom.mjGEOM_CAPSULE:
        return [(place + axes @ [0, 0, end * size[1]], float(size[0])) for end in (-1, 1)]
    inner = size - CORNER
    corners = [place + axes @ (inner * [a, b, c]) for a in (-1, 1) for b in (-1, 1) for c in (-1, 1)]
    return [(corner, CORNER) for corner in sorted(corners, key=lambda corner: corner[2])[:4]]


def _sensor(model: Any, body: int, place: FloatArray) -> str:
    """Name of the force sensor whose site is nearest; empty where the body has none."""
    own = [
        (float(np.linalg.norm((model.site_pos[s] - place)[:2])), model.sensor(k).name)
        for k in range(model.nsensor)
        for s in [int(model.sensor_objid[k])]
        if model.sensor(k).name.startswith("force_") and model.site_bodyid[s] == body
    ]
    return min(own)[1] if own else ""
