"""From a robot to the compiled model of one log, and where the log's joints live in it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from sysid_btr.errors import ModelError
from sysid_btr.models.robot import Robot
from sysid_btr.mujoco_conventions import SINGLE
from sysid_btr.simulation.numerics import Numerics
from sysid_btr.terms.base import LINK_SUFFIX, JointAddresses, Term
from sysid_btr.terms.drives import joint_drives, own_controls

if TYPE_CHECKING:
    import mujoco

    from sysid_btr.io.log import Log

LIFT = 1.0
"""m, by which a robot that is held is lifted from where its model stands."""


def made_elsewhere() -> mujoco.MjSpec:
    """In the place of a model's source, where only the compiled model was sent."""
    raise ModelError("this model was compiled in another process, and cannot be compiled again here")


def compile_model(robot: Robot, log: Log, terms: Sequence[Term], numerics: Numerics) -> mujoco.MjModel:
    """Compile the robot for a log: mount, integrator, step, friction numerics, added structure."""
    import mujoco

    spec = robot.make_spec()
    spec.option.timestep = numerics.timestep
    spec.option.integrator = getattr(mujoco.mjtIntegrator, f"mjINT_{numerics.integrator.upper()}")
    if log.meta.mount == "fixed":
        for joint in list(spec.joints):
            if joint.type == mujoco.mjtJoint.mjJNT_FREE:
                # a robot that is held hangs clear of the ground it would otherwise stand on
                joint.parent.pos = np.add(joint.parent.pos, (0.0, 0.0, LIFT))
                spec.delete(joint)
    elif not numerics.recorded:
        # the pyramid that MuJoCo has for a cone by default slides easier along one direction than another
        spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    if not numerics.recorded:
        # friction as stiff as the step allows: the default creeps and blurs reversals
        reference = _stiffest_friction(numerics)
        for joint in spec.joints:
            joint.solref_friction = reference
            joint.solimp_friction = [0.99, 0.999, 0.001, 0.5, 2.0]
    for key in list(spec.keys):
        # the plain model's say where joints stand; of another structure they would be invalid
        spec.delete(key)
    _plain_drives(spec)
    for term in terms:
        term.edit_spec(spec)
    try:
        return spec.compile()
    except ValueError as error:
        raise ModelError(f"model {robot.name}: MuJoCo cannot compile it: {error}") from error


def _stiffest_friction(numerics: Numerics) -> list[float]:
    """MuJoCo's solref of dry friction as stiff as an integrator allows.

    Friction takes a joint's velocity away at a rate, and turns round before the joint does, the earlier the lower that
    rate is. In units of one over the step, Runge-Kutta's fourth order is stable up to 2.8 and damps most at 1.6, Euler
    up to 2 and at 1; a time constant, which is what MuJoCo usually has, goes no further than 1.
    """
    if numerics.integrator == "RK4":
        return [-1.0, -1.6 / numerics.timestep]
    return [max(2 * numerics.timestep, 0.002), 1.0]


def _plain_drives(spec: mujoco.MjSpec) -> None:
    """Take the filters out of drives of joints, and give those without a bias one of nothing.

    Their commands come filtered (`lagged`), however they are simulated; the time constant stays where MuJoCo has it,
    zero where there is no filter. Laws that act on a drive's torque change its bias.
    """
    import mujoco

    onto = (mujoco.mjtTrn.mjTRN_JOINT, mujoco.mjtTrn.mjTRN_JOINTINPARENT)
    drives = [actuator for actuator in spec.actuators if actuator.trntype in onto]
    several = Counter(actuator.target for actuator in drives)
    for actuator in (a for a in drives if several[a.target] == 1):
        if actuator.dyntype in (mujoco.mjtDyn.mjDYN_FILTER, mujoco.mjtDyn.mjDYN_FILTEREXACT):
            actuator.dyntype = mujoco.mjtDyn.mjDYN_NONE
        elif actuator.dyntype == mujoco.mjtDyn.mjDYN_NONE:
            actuator.dynprm = [0.0, *actuator.dynprm[1:]]
        if actuator.biastype == mujoco.mjtBias.mjBIAS_NONE:
            actuator.biastype, actuator.biasprm = mujoco.mjtBias.mjBIAS_AFFINE, np.zeros(len(actuator.biasprm))


def make_index(model: mujoco.MjModel) -> JointAddresses:
    """Addresses of every hinge and slide joint of the model."""
    ids = {model.joint(i).name: i for i in range(model.njnt) if int(model.jnt_type[i]) in SINGLE}
    joints = tuple(name for name in ids if not name.endswith(LINK_SUFFIX))
    drives = {drive.joint: drive for drive in joint_drives(model)}
    own_drives = [drives.get(joint) for joint in joints]
    controls = own_controls(model)
    own = np.array([ids[j] for j in joints], dtype=np.int64)
    link = np.array([ids.get(j + LINK_SUFFIX, -1) for j in joints], dtype=np.int64)
    return JointAddresses(
        joints=joints,
        qpos=model.jnt_qposadr[own].astype(np.int64),
        dof=model.jnt_dofadr[own].astype(np.int64),
        actuator=np.array([-1 if d is None else d.actuator for d in own_drives], dtype=np.int64),
        body=model.jnt_bodyid[own].astype(np.int64),
        link_qpos=np.where(link >= 0, model.jnt_qposadr[link], -1).astype(np.int64),
        link_dof=np.where(link >= 0, model.jnt_dofadr[link], -1).astype(np.int64),
        drive=tuple(None if d is None else d.kind for d in own_drives),
        scale=np.array([1.0 if d is None else d.scale for d in own_drives]),
        controls=tuple(controls),
        control=np.array(list(controls.values()), dtype=np.int64),
    )
