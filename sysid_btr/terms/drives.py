"""What actuators are: kinds of drive, and what a command in units of a joint is as MuJoCo's ctrl."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal

from sysid_btr.mujoco_conventions import SINGLE

if TYPE_CHECKING:
    import mujoco

DriveKind = Literal["position", "velocity", "torque"]


@dataclass(frozen=True)
class Drive:
    """An actuator that alone drives a joint, with force = gain ctrl + constant + stiffness length + damping velocity.

    A command of the joint is the position, the velocity or the torque that the drive is to have there but for the
    constant, which is a force of its own; rad, rad/s, Nm (m, m/s, N).

    Attributes
    ----------
    actuator, joint : number in the compiled model, name.
    name : of the actuator; empty if it has none, or that of another joint.
    kind : of the command.
    scale : ctrl per command.
    """

    actuator: int
    joint: str
    name: str
    kind: DriveKind
    scale: float


def drive_kinds(model: mujoco.MjModel) -> dict[str, DriveKind]:
    """What the command of each joint with a drive is, by joint."""
    return {drive.joint: drive.kind for drive in joint_drives(model)}


def joint_drives(model: mujoco.MjModel) -> tuple[Drive, ...]:
    """Drives of joints that have one actuator whose command has a meaning, in the order of the actuators."""
    acted = _acted_joints(model)
    several = Counter(acted.values())
    found = (_drive(model, a, joint) for a, joint in acted.items() if several[joint] == 1)
    names = {model.joint(j).name for j in range(model.njnt)}
    return tuple(d if d.name == d.joint or d.name not in names else replace(d, name="") for d in found if d is not None)


def crowded_joints(model: mujoco.MjModel) -> dict[str, tuple[str, ...]]:
    """Joints that several actuators drive, and their names."""
    found: dict[str, tuple[str, ...]] = {}
    for a, joint in _acted_joints(model).items():
        found[joint] = (*found.get(joint, ()), model.actuator(a).name)
    return {joint: names for joint, names in found.items() if len(names) > 1}


def own_controls(model: mujoco.MjModel) -> dict[str, int]:
    """Actuators that are commanded by their own name, in ctrl: all that are not the drive of a joint."""
    drives = joint_drives(model)
    of_joints = {drive.actuator for drive in drives}
    taken = {drive.joint for drive in drives}
    others = ((model.actuator(a).name, a) for a in range(model.nu) if a not in of_joints)
    return {name: a for name, a in others if name and name not in taken}


def _acted_joints(model: mujoco.MjModel) -> dict[int, str]:
    """Actuator -> the hinge or slide on which it acts; the two transmissions to a joint differ only for balls."""
    import mujoco

    onto = (int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT))
    return {
        a: model.joint(int(model.actuator_trnid[a, 0])).name
        for a in range(model.nu)
        if int(model.actuator_trntype[a]) in onto and int(model.jnt_type[model.actuator_trnid[a, 0]]) in SINGLE
    }


def _drive(model: mujoco.MjModel, a: int, joint: str) -> Drive | None:
    import mujoco

    gain, bias = float(model.actuator_gainprm[a, 0]), model.actuator_biasprm[a]
    gear = float(model.actuator_gear[a, 0])
    affine = model.actuator_biastype[a] == mujoco.mjtBias.mjBIAS_AFFINE
    plain = affine or model.actuator_biastype[a] == mujoco.mjtBias.mjBIAS_NONE
    follows = int(model.actuator_dyntype[a]) in _follows()
    if model.actuator_gaintype[a] != mujoco.mjtGain.mjGAIN_FIXED or not plain or not follows or gain * gear == 0:
        return None
    stiffness, damping = (float(b) if affine else 0.0 for b in bias[1:3])
    name = model.actuator(a).name
    if stiffness != 0:
        return Drive(a, joint, name, "position", -stiffness * gear / gain)
    if damping != 0:
        return Drive(a, joint, name, "velocity", -damping * gear / gain)
    return Drive(a, joint, name, "torque", 1 / (gear * gain))


def _follows() -> tuple[int, ...]:
    """Activation dynamics that come to rest at the ctrl."""
    from mujoco import mjtDyn

    return tuple(int(kind) for kind in (mjtDyn.mjDYN_NONE, mjtDyn.mjDYN_FILTER, mjtDyn.mjDYN_FILTEREXACT))
