"""Actuators for models that come without: torque motors, or position servos with stated gains."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from sysid_btr.io._text import some
from sysid_btr.models.robot import Robot
from sysid_btr.mujoco_conventions import SINGLE
from sysid_btr.terms.drives import crowded_joints, joint_drives

if TYPE_CHECKING:
    import mujoco


@dataclass(frozen=True)
class Servo:
    """A position servo: torque = kp (command - position) - kv velocity.

    Attributes
    ----------
    kp, kv : Nm/rad and Nm s/rad (N/m, N s/m).
    """

    kp: float
    kv: float = 0.0

    def put(self, actuator: mujoco.MjsActuator) -> None:
        """Make an actuator one."""
        actuator.set_to_position(kp=self.kp, kv=self.kv)


@dataclass(frozen=True)
class Motor:
    """A motor whose command is its torque."""

    def put(self, actuator: mujoco.MjsActuator) -> None:
        """Make an actuator one."""
        actuator.set_to_motor()


def with_motors(robot: Robot) -> Robot:
    """A robot without any actuator, with a motor on every joint that no coupling moves."""
    if robot.model.nu:
        return robot
    free = _free_joints(robot.model)
    remark = f"it has no actuators: a torque motor is put on {some(free, 12)}; --servo kp=..,kv=.. puts position servos"
    return _with(robot, Motor(), free, remark) if free else robot


def with_servos(robot: Robot, servo: Servo) -> Robot:
    """The robot with position servos where it has none, in the place of motors."""
    model = robot.model
    fed = {drive.joint for drive in joint_drives(model) if drive.kind != "torque"} | set(crowded_joints(model))
    chosen = tuple(joint for joint in _free_joints(model) if joint not in fed)
    remark = f"position servos of kp {servo.kp:g} and kv {servo.kv:g} are put on {some(chosen, 12)}"
    return _with(robot, servo, chosen, remark) if chosen else robot


def _with(robot: Robot, drive: Servo | Motor, joints: tuple[str, ...], remark: str) -> Robot:
    make_spec: Callable[[], mujoco.MjSpec] = robot.make_spec

    def actuated() -> mujoco.MjSpec:
        import mujoco

        spec = make_spec()
        onto = (mujoco.mjtTrn.mjTRN_JOINT, mujoco.mjtTrn.mjTRN_JOINTINPARENT)
        for actuator in [a for a in spec.actuators if a.trntype in onto and a.target in joints]:
            spec.delete(actuator)
        taken = {actuator.name for actuator in spec.actuators}
        for joint in joints:
            name = {} if joint in taken else {"name": joint}
            drive.put(spec.add_actuator(target=joint, trntype=mujoco.mjtTrn.mjTRN_JOINT, **name))
        return spec

    return replace(robot, make_spec=actuated, remarks=(*robot.remarks, remark))


def _free_joints(model: mujoco.MjModel) -> tuple[str, ...]:
    """Hinges and slides that do not follow another joint."""
    import mujoco

    coupled = {
        int(model.eq_obj1id[i])
        for i in range(model.neq)
        if model.eq_type[i] == mujoco.mjtEq.mjEQ_JOINT and model.eq_obj2id[i] >= 0
    }
    return tuple(
        model.joint(i).name for i in range(model.njnt) if int(model.jnt_type[i]) in SINGLE and i not in coupled
    )
