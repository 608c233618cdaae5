"""EMPS: one linear ball-screw axis on a digital position and velocity cascade.

Janot, Gautier, Brunot: Data set and reference models of EMPS (Workshop on Nonlinear System Identification
Benchmarks, 2019). The controller is declared; mass, friction and offset are what there is to identify.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from sysid_btr.models.robot import Robot, robot_from_spec

if TYPE_CHECKING:
    import mujoco

MASS = 95.1089
"""Published estimate, kg."""
DRIVE_GAIN = 35.1507
"""N/V, from the drive's input to the force on the carriage."""
VELOCITY_GAIN = 243.45
"""V/(m/s), of the inner loop."""
POSITION_GAIN = 160.18
"""1/s, of the outer loop."""
DRIVE_LIMIT = 10.0
"""V, at which the drive saturates."""
TRAVEL = (-0.05, 0.30)
"""m; stated for the validation of logs, not enforced."""


def emps() -> Robot:
    """A mass on a slide, driven by force = gain * (position gain * (command - q) - velocity)."""
    return robot_from_spec("emps", _make_spec)


def _make_spec() -> mujoco.MjSpec:
    import mujoco

    spec = mujoco.MjSpec()
    spec.modelname = "emps"
    spec.option.gravity = [0.0, 0.0, 0.0]
    spec.option.timestep = 0.001
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_EULER
    carriage = spec.worldbody.add_body(name="carriage")
    carriage.add_joint(
        name="slider",
        type=mujoco.mjtJoint.mjJNT_SLIDE,
        axis=[1.0, 0.0, 0.0],
        range=list(TRAVEL),
        limited=mujoco.mjtLimited.mjLIMITED_FALSE,
    )
    carriage.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=[0.1, 0.1, 0.05], mass=MASS, contype=0, conaffinity=0)
    damping = DRIVE_GAIN * VELOCITY_GAIN
    servo = spec.add_actuator(name="slider", target="slider", trntype=mujoco.mjtTrn.mjTRN_JOINT)
    servo.set_to_position(kp=damping * POSITION_GAIN, kv=damping)
    servo.forcelimited = mujoco.mjtLimited.mjLIMITED_TRUE
    servo.forcerange = [-DRIVE_LIMIT * DRIVE_GAIN, DRIVE_LIMIT * DRIVE_GAIN]
    spec.add_sensor(
        name="position_slider",
        type=mujoco.mjtSensor.mjSENS_JOINTPOS,
        objtype=mujoco.mjtObj.mjOBJ_JOINT,
        objname="slider",
    )
    return spec
