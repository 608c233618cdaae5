"""Small robots and logs made in memory, for tests of models, replay and effects."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from sysid_btr._typing import FloatArray
from sysid_btr.io.log import Log, LogMeta
from sysid_btr.models.robot import Robot, robot_from_spec
from sysid_btr.simulation.numerics import Numerics
from sysid_btr.simulation.replay import Replay
from sysid_btr.terms.base import Outputs, Term
from sysid_btr.terms.scales import JointScale

if TYPE_CHECKING:
    import mujoco

KP, KV = 12.0, 0.5
MASS, LENGTH, INERTIA = 0.5, 0.2, 0.004
DAMPING, ARMATURE = 0.05, 0.01
GRAVITY = 9.81
TOTAL_INERTIA = INERTIA + MASS * LENGTH**2 + ARMATURE
FINE = Numerics("RK4", 0.005)

PENDULUM = f"""
<mujoco model="pendulum">
  <option gravity="0 0 -{GRAVITY}"/>
  <worldbody>
    <body name="arm">
      <joint name="arm" axis="0 1 0" damping="{DAMPING}" armature="{ARMATURE}"/>
      <inertial pos="0 0 -{LENGTH}" mass="{MASS}" diaginertia="{INERTIA} {INERTIA} {INERTIA}"/>
    </body>
  </worldbody>
  <actuator><position name="arm" joint="arm" kp="{KP}" kv="{KV}"/></actuator>
</mujoco>
"""

LEG = """
<mujoco model="leg">
  <worldbody>
    <geom name="floor" type="plane" size="2 2 .1" pos="0 0 -3"/>
    <body name="hip">
      <joint name="hip" axis="0 1 0" damping=".05" armature=".006" range="-2 2" limited="false"/>
      <geom type="box" size=".04 .03 .07" pos=".01 .004 -.07" mass=".4" contype="0" conaffinity="0"/>
      <body name="knee" pos=".01 0 -.14">
        <joint name="knee" axis="0 1 0" damping=".05" armature=".006" frictionloss="0"/>
        <geom type="box" size=".03 .03 .06" pos="0 0 -.06" mass=".3" contype="0" conaffinity="0"/>
        <body name="ankle" pos="0 0 -.12">
          <joint name="ankle" axis="1 0 0" damping=".05" armature=".006" stiffness=".1"/>
          <geom type="box" size=".08 .04 .01" pos=".03 0 -.03" mass=".15"/>
        </body>
      </body>
    </body>
  </worldbody>
  <actuator>
    <position name="hip" joint="hip" kp="20" kv=".6"/>
    <position name="knee" joint="knee" kp="20" kv=".6"/>
    <position name="ankle" joint="ankle" kp="12" kv=".4"/>
  </actuator>
</mujoco>
"""

SCALE = JointScale(
    torque_rms=0.8, torque_peak=2.5, velocity_rms=2.0, velocity_peak=6.0, acceleration_rms=30.0, span=1.0
)
"""Roughly what the toys do in `swing`."""


def robot_from_xml(xml: str, name: str = "toy") -> Robot:
    def make_spec() -> mujoco.MjSpec:
        import mujoco

        return mujoco.MjSpec.from_string(xml)

    return robot_from_spec(name, make_spec)


def pendulum() -> Robot:
    """One servo joint under gravity, hanging at zero."""
    return robot_from_xml(PENDULUM, "pendulum")


def leg() -> Robot:
    """Hip, knee and ankle on a held base."""
    return robot_from_xml(LEG, "leg")


def with_spec(robot: Robot, edit: Callable[[Any], None]) -> Robot:
    """The robot with its spec edited before compiling."""

    def make_spec() -> mujoco.MjSpec:
        spec = robot.make_spec()
        edit(spec)
        return spec

    return replace(robot, make_spec=make_spec)


def make_log(time: FloatArray, channels: Mapping[str, FloatArray], **meta: Any) -> Log:
    return Log(
        time=np.asarray(time, dtype=np.float64),
        channels={k: np.asarray(v, dtype=np.float64) for k, v in channels.items()},
        meta=LogMeta(**meta),
        episode=np.zeros(len(time), dtype=np.int64),
    )


def held(value: float = 0.0, seconds: float = 2.0, period: float = 0.01, joint: str = "arm") -> Log:
    """A constant command from rest."""
    time = np.arange(round(seconds / period) + 1) * period
    return make_log(time, {f"command.{joint}": np.full(len(time), value)}, sample_period=period)


def swing(joints: Sequence[str] = ("arm",), seconds: float = 2.0, period: float = 0.01, size: float = 0.5) -> Log:
    """Smooth commands that start at rest and then move every joint differently."""
    time = np.arange(round(seconds / period) + 1) * period
    fade = 1 - np.exp(-((time / 0.3) ** 2))
    channels = {
        f"command.{j}": size * fade * np.sin(2 * np.pi * (0.9 + 0.3 * i) * time + 0.5 * i) for i, j in enumerate(joints)
    }
    return make_log(time, channels, sample_period=period)


LEG_JOINTS = ("hip", "knee", "ankle")


def run(
    robot: Robot, log: Log, terms: Sequence[Term] = (), values: Any = None, numerics: Numerics = FINE, **options: Any
) -> Outputs:
    """Predicted sensors under one candidate (numbers) or several (rows)."""
    replay = Replay(robot, log, tuple(terms), numerics, **options)
    if values is None:
        values = [p.nominal for p in replay.parameters]
    candidates = np.atleast_2d(np.asarray(values, dtype=np.float64))
    return replay.predict(candidates)


def position(*arguments: Any, **options: Any) -> FloatArray:
    """(samples, joints) of the first candidate."""
    return run(*arguments, **options).position[0]
