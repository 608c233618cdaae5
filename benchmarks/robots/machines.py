"""Models of the simulated robots, as MJCF text."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

HEAD = '<compiler angle="radian"/><option timestep="0.002" integrator="implicitfast"/>'
FREE = '<default><geom contype="0" conaffinity="0"/></default>'
"""Nothing touches anything."""


@dataclass(frozen=True)
class Link:
    """A joint and the rod that it moves, which hangs down from it.

    Attributes
    ----------
    joint : name; its body is called after it, with `_link`.
    axis : in the frame of the body.
    length, mass : m, kg.
    armature, damping : kg m2, Nm s/rad.
    more : further attributes of the joint.
    """

    joint: str
    axis: str
    length: float
    mass: float
    armature: float
    damping: float
    more: str = ""


def chain(links: Sequence[Link], actuators: str, more: str = "") -> str:
    """A fixed arm."""
    inner = ""
    for i, link in reversed(list(enumerate(links))):
        above = -links[i - 1].length if i else 1.5
        inner = (
            f'<body name="{link.joint}_link" pos="0 0 {above}">'
            f'<joint name="{link.joint}" axis="{link.axis}" armature="{link.armature}" damping="{link.damping}" '
            f'{link.more}/><geom type="capsule" fromto="0.01 0 0 0.03 0.01 {-link.length}" size="0.02" '
            f'mass="{link.mass}"/>{inner}</body>'
        )
    return f"<mujoco>{HEAD}{FREE}<worldbody>{inner}</worldbody><actuator>{actuators}</actuator>{more}</mujoco>"


def each(links: Sequence[Link], actuator: str) -> str:
    """The same actuator at every joint; `{j}` stands for its name."""
    return "".join(actuator.format(j=link.joint) for link in links)


ARM3 = (
    Link("shoulder", "0 1 0", 0.3, 2.0, 0.05, 0.2),
    Link("elbow", "0 1 0", 0.25, 1.2, 0.03, 0.15),
    Link("wrist", "1 0 0", 0.15, 0.5, 0.01, 0.05),
)
ARM6 = (
    Link("waist", "0 0 1", 0.1, 2.0, 0.1, 0.5),
    Link("shoulder", "0 1 0", 0.3, 2.0, 0.1, 0.4),
    Link("elbow", "0 1 0", 0.25, 1.3, 0.05, 0.2),
    Link("forearm", "0 0 1", 0.1, 0.6, 0.02, 0.1),
    Link("wrist", "0 1 0", 0.1, 0.4, 0.02, 0.1),
    Link("flange", "0 0 1", 0.05, 0.2, 0.01, 0.05),
)
FINGER = (
    Link("mcp", "0 1 0", 0.045, 0.04, 0.0004, 0.004),
    Link("pip", "0 1 0", 0.03, 0.025, 0.0002, 0.002),
    Link("dip", "0 1 0", 0.02, 0.015, 0.0001, 0.001),
)
LEG3 = (
    Link("roll", "1 0 0", 0.05, 0.7, 0.01, 0.05),
    Link("hip", "0 1 0", 0.2, 1.0, 0.01, 0.05),
    Link("knee", "0 1 0", 0.2, 0.3, 0.01, 0.05),
)
PENDULUM = (Link("pendulum", "0 1 0", 0.15, 0.4, 0.004, 0.05),)

TORQUE_ARM = chain(ARM3, each(ARM3, '<motor name="{j}" joint="{j}" gear="40"/>'))
VELOCITY_ARM = chain(ARM3, each(ARM3, '<velocity name="{j}" joint="{j}" kv="6"/>'))
GEARED_ARM = chain(ARM3, each(ARM3, '<position name="{j}_servo" joint="{j}" gear="50" kp="0.06" kv="0.0024"/>'))
SERVO_ARM = chain(ARM3, each(ARM3, '<position name="{j}" joint="{j}" kp="120" kv="5"/>'))
BARE_ARM = chain(ARM3, "")
SIX_JOINTS = chain(ARM6, each(ARM6, '<position name="{j}" joint="{j}" kp="200" kv="8"/>'))
MIT_LEG = chain(LEG3, each(LEG3, '<position name="{j}" joint="{j}" kp="40" kv="1.5"/>'))
HOBBY_SERVO = chain(
    PENDULUM,
    '<general name="pendulum" joint="pendulum" gainprm="8" biastype="affine" biasprm="0 -8 -0.1" dyntype="filterexact" '
    'dynprm="0.03" forcerange="-3 3"/>',
)
STOPS = tuple(
    Link(k.joint, k.axis, k.length, k.mass, k.armature, k.damping, f'limited="true" range="-{r} {r}"')
    for k, r in zip(ARM3, (0.5, 0.6, 0.5), strict=True)
)
LIMITED_ARM = chain(STOPS, each(STOPS, '<position name="{j}" joint="{j}" kp="60" kv="3"/>'))
COUPLED_FINGER = chain(
    FINGER,
    each(FINGER[:2], '<position name="{j}" joint="{j}" kp="0.8" kv="0.02"/>'),
    '<equality><joint joint1="dip" joint2="pip" polycoef="0 0.7 0 0 0"/></equality>',
)

GRIPPER = f"""<mujoco>{HEAD}{FREE}
<worldbody><body name="palm"><geom size="0.03" mass="0.4"/>
<body name="left_pad" pos="0 0.02 -0.1"><joint name="left" type="slide" axis="0 1 0" armature="0.05" damping="2"/>
<geom type="box" size="0.01 0.005 0.03" mass="0.08"/></body>
<body name="right_pad" pos="0 -0.02 -0.1"><joint name="right" type="slide" axis="0 -1 0" armature="0.05" damping="2"/>
<geom type="box" size="0.01 0.005 0.03" mass="0.08"/></body></body></worldbody>
<tendon><fixed name="both"><joint joint="left" coef="0.5"/><joint joint="right" coef="0.5"/></fixed></tendon>
<equality><joint joint1="right" joint2="left" polycoef="0 1 0 0 0"/></equality>
<actuator><general name="grip" tendon="both" gainprm="0.06" biastype="affine" biasprm="0 -300 -8" ctrlrange="0 255"/>
</actuator></mujoco>"""

CART_POLE = f"""<mujoco>{HEAD}{FREE}
<worldbody><body name="cart" pos="0 0 1"><joint name="rail" type="slide" axis="1 0 0" damping="1"/>
<geom type="box" size="0.06 0.04 0.03" mass="1.2"/>
<body name="pole"><joint name="pivot" axis="0 1 0" damping="0.002"/>
<geom type="capsule" fromto="0 0 0 0 0 -0.35" size="0.01" mass="0.25"/></body></body></worldbody>
<actuator><motor name="rail" joint="rail"/></actuator></mujoco>"""


def humanoid() -> str:
    """Two legs with soles and two arms on a trunk that is free, without any IMU."""
    limbs = ""
    for side, y in (("left", 0.07), ("right", -0.07)):
        limbs += (
            f'<body name="{side}_thigh" pos="0 {y} 0"><joint name="{side}_hip" axis="0 1 0"/>'
            '<geom type="capsule" fromto="0 0 0 0 0 -0.15" size="0.03" mass="0.5" contype="0" conaffinity="0"/>'
            f'<body name="{side}_shank" pos="0 0 -0.15"><joint name="{side}_knee" axis="0 1 0"/>'
            '<geom type="capsule" fromto="0 0 0 0 0 -0.15" size="0.025" mass="0.4" contype="0" conaffinity="0"/>'
            f'<body name="{side}_foot" pos="0 0 -0.15"><joint name="{side}_ankle" axis="0 1 0"/>'
            '<geom type="box" pos="0.02 0 -0.03" size="0.08 0.04 0.01" mass="0.2" friction="0.9"/></body></body></body>'
            f'<body name="{side}_arm" pos="0 {2.2 * y} 0.3"><joint name="{side}_shoulder" axis="0 1 0"/>'
            '<geom type="capsule" fromto="0 0 0 0 0 -0.15" size="0.02" mass="0.3" contype="0" conaffinity="0"/>'
            f'<body name="{side}_hand" pos="0 0 -0.15"><joint name="{side}_elbow" axis="0 1 0"/>'
            '<geom type="capsule" fromto="0 0 0 0 0 -0.14" size="0.02" mass="0.25" contype="0" conaffinity="0"/></body>'
            "</body>"
        )
    joints = [f"{side}_{part}" for side in ("left", "right") for part in HUMANOID]
    servos = "".join(f'<position name="{j}" joint="{j}" kp="40" kv="0.8"/>' for j in joints)
    return f"""<mujoco>{HEAD}<default><joint armature="0.008" damping="0.05"/></default>
<worldbody><geom name="floor" type="plane" size="20 20 1" friction="0.9"/>
<body name="trunk" pos="0 0 0.335"><freejoint name="base"/>
<geom type="box" pos="0 0 0.15" size="0.06 0.1 0.15" mass="1.6" contype="0" conaffinity="0"/>{limbs}</body></worldbody>
<actuator>{servos}</actuator></mujoco>"""


HUMANOID = ("hip", "knee", "ankle", "shoulder", "elbow")


def quadruped() -> str:
    """Four legs of two joints under a trunk that is free, with an IMU."""
    legs = ""
    for name, x, y in (("FL", 0.18, 0.1), ("FR", 0.18, -0.1), ("RL", -0.18, 0.1), ("RR", -0.18, -0.1)):
        legs += (
            f'<body name="{name}_thigh" pos="{x} {y} 0"><joint name="{name}_hip" axis="0 1 0"/>'
            '<geom type="capsule" fromto="0 0 0 0 0 -0.2" size="0.02" mass="0.9" contype="0" conaffinity="0"/>'
            f'<body name="{name}_shank" pos="0 0 -0.2"><joint name="{name}_knee" axis="0 1 0"/>'
            '<geom type="capsule" fromto="0 0 0 0 0 -0.2" size="0.012" mass="0.2" contype="0" conaffinity="0"/>'
            f'<geom name="{name}_foot" pos="0 0 -0.2" size="0.02" mass="0.05" friction="0.8"/></body></body>'
        )
    joints = [f"{leg}_{part}" for leg in ("FL", "FR", "RL", "RR") for part in ("hip", "knee")]
    servos = "".join(f'<position name="{j}" joint="{j}" kp="60" kv="2"/>' for j in joints)
    home = " ".join(["0.6 -1.2"] * 4)
    return f"""<mujoco>{HEAD}<default><joint armature="0.01" damping="0.1"/></default>
<worldbody><geom name="floor" type="plane" size="20 20 1" friction="0.8"/>
<body name="trunk" pos="0 0 0.352"><freejoint name="base"/><site name="imu"/>
<geom type="box" size="0.22 0.09 0.05" mass="6" contype="0" conaffinity="0"/>{legs}</body></worldbody>
<actuator>{servos}</actuator>
<sensor><gyro name="gyro" site="imu"/><accelerometer name="acc" site="imu"/></sensor>
<keyframe><key name="home" qpos="0 0 0.352 1 0 0 0 {home}" ctrl="{home}"/></keyframe></mujoco>"""
