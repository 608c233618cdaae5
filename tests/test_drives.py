"""What a command means follows the actuator: replays against plain MuJoCo, told in its own ctrl."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from toys import make_log, robot_from_xml

from sysid_btr._typing import FloatArray
from sysid_btr.diagnosis.close import close
from sysid_btr.errors import ModelError
from sysid_btr.identify.fit import fit
from sysid_btr.identify.mode import Mode, episode_of
from sysid_btr.identify.replay import replay_log
from sysid_btr.identify.study import make_study
from sysid_btr.io.log import Log
from sysid_btr.io.parquet import read_log, write_log
from sysid_btr.io.problem import Problem
from sysid_btr.io.validation import validate_log
from sysid_btr.models.log_checks import check_log
from sysid_btr.models.robot import Robot, joint_names
from sysid_btr.simulation.numerics import Numerics
from sysid_btr.simulation.replay import Replay
from sysid_btr.terms.base import Outputs, Term
from sysid_btr.terms.friction import StribeckFriction
from sysid_btr.terms.grammar import parse_parameters
from sysid_btr.terms.transmission import Backlash

STEP = 0.002
NUMERICS = Numerics("implicitfast", STEP)
TIME = np.arange(401) * 0.004
"""Two steps a sample."""
WAVE = 0.4 * np.sin(7 * TIME) * (1 - np.exp(-((TIME / 0.1) ** 2)))

ARM = """
<mujoco>
  <option timestep="0.002" integrator="implicitfast"/>
  <worldbody>
    <body name="upper">
      <joint name="shoulder" axis="0 1 0" damping="0.1" armature="0.02"/>
      <geom type="capsule" fromto="0 0 0 0 0 -0.2" size="0.02" mass="0.6"/>
      <body name="lower" pos="0 0 -0.2">
        <joint name="elbow" axis="0 1 0" damping="0.1" armature="0.02"/>
        <geom type="capsule" fromto="0 0 0 0 0 -0.2" size="0.02" mass="0.4"/>
      </body>
    </body>
  </worldbody>
  {more}
</mujoco>
"""
ACTUATORS = {
    "torque": '<motor name="{j}" joint="{j}"/>',
    "geared torque": '<motor name="{j}" joint="{j}" gear="-30"/>',
    "scaled torque": '<general name="{j}" joint="{j}" gainprm="2.5" gear="3"/>',
    "position": '<position name="{j}" joint="{j}" kp="30" kv="1"/>',
    "geared position": '<position name="{j}" joint="{j}" kp="0.02" kv="0.001" gear="50"/>',
    "scaled position": '<general name="{j}" joint="{j}" gainprm="0.2" biastype="affine" biasprm="0 -30 -1"/>',
    "velocity": '<velocity name="{j}" joint="{j}" kv="2"/>',
    "geared velocity": '<velocity name="{j}" joint="{j}" kv="0.02" gear="-10"/>',
}
CTRL = {
    "torque": lambda c: c,
    "geared torque": lambda c: -c / 30,
    "scaled torque": lambda c: c / 7.5,
    "position": lambda c: c,
    "geared position": lambda c: 50 * c,
    "scaled position": lambda c: 30 * c / 0.2,
    "velocity": lambda c: c,
    "geared velocity": lambda c: -10 * c,
}
"""Of a command of the joint, by hand."""


def arm(actuator: str, more: str = "") -> Robot:
    """Two joints under gravity with the same kind of actuator."""
    both = "".join(actuator.format(j=j) for j in ("shoulder", "elbow"))
    return robot_from_xml(ARM.format(more=f"<actuator>{both}{more}</actuator>"))


def commands(**channels: FloatArray) -> Log:
    """Commands and a start at rest at zero."""
    return make_log(TIME, {name.replace("__", "."): values for name, values in channels.items()}, sample_period=0.004)


def replayed(robot: Robot, log: Log, terms: tuple[Term, ...] = (), values: Any = (), **options: Any) -> Outputs:
    return Replay(robot, log, terms, NUMERICS, **options).predict(np.atleast_2d(np.asarray(values, dtype=np.float64)))


def stepped(robot: Robot, ctrl: FloatArray, watched: tuple[str, ...] = ("shoulder", "elbow")) -> FloatArray:
    """(n, joints) of plain MuJoCo, with friction as stiff as a replay has it; ctrl (n, nu) held between samples."""
    model = Replay(robot, commands(), (), NUMERICS).model
    data = mujoco.MjData(model)
    adr = [model.joint(j).qposadr[0] for j in watched]
    found = [data.qpos[adr].copy()]
    for row in ctrl[:-1]:
        data.ctrl[:] = row
        mujoco.mj_step(model, data, 2)
        found.append(data.qpos[adr].copy())
    return np.array(found)


def only(log: Log, robot: Robot, joints: tuple[str, ...] = ("shoulder", "elbow")) -> FloatArray:
    replay = Replay(robot, log, (), NUMERICS)
    return replay.predict(np.zeros((1, 0))).position[0][:, replay.index.of(joints)]


@pytest.mark.parametrize("drive", ACTUATORS)
def test_a_command_is_in_units_of_the_joint_whatever_the_actuator(drive: str) -> None:
    robot = arm(ACTUATORS[drive])
    log = commands(command__shoulder=WAVE, command__elbow=-2 * WAVE)
    ctrl = np.column_stack([CTRL[drive](WAVE), CTRL[drive](-2 * WAVE)])
    np.testing.assert_allclose(only(log, robot), stepped(robot, ctrl), rtol=0, atol=1e-10)


@pytest.mark.parametrize("drive", ACTUATORS)
def test_what_steps_in_python_and_what_predicts_the_torque_know_the_same_drive(drive: str) -> None:
    robot = arm(ACTUATORS[drive])
    log = commands(command__shoulder=WAVE, command__elbow=-2 * WAVE)
    whole = replayed(robot, log, effort=True)
    law = StribeckFriction(("elbow",))
    neutral = replayed(robot, log, (law,), law.neutral, effort=True)
    np.testing.assert_allclose(neutral.position, whole.position, rtol=0, atol=1e-10)
    assert whole.effort is not None
    if "torque" in drive:
        np.testing.assert_allclose(whole.effort[0, :-1, 0], WAVE[:-1], rtol=0, atol=1e-12)


def test_a_command_can_be_ctrl_by_the_actuators_name_or_by_what_the_log_says_of_itself() -> None:
    robot = arm('<position name="{j}_servo" joint="{j}" kp="0.02" kv="0.001" gear="50"/>')
    told = only(commands(command__shoulder=WAVE, command__elbow=-2 * WAVE), robot)
    by_name = commands(command__shoulder_servo=50 * WAVE, command__elbow_servo=-100 * WAVE)
    np.testing.assert_allclose(only(by_name, robot), told, rtol=0, atol=1e-12)
    by_space = commands(command__shoulder=50 * WAVE, command__elbow=-100 * WAVE)
    log = make_log(TIME, dict(by_space.channels), command_space="ctrl")
    np.testing.assert_allclose(only(log, robot), told, rtol=0, atol=1e-12)


def test_a_limit_of_the_ctrl_is_one_of_the_torque_too() -> None:
    robot = arm('<motor name="{j}" joint="{j}" gear="2" ctrlrange="-0.1 0.1"/>')
    found = replayed(robot, commands(command__shoulder=WAVE, command__elbow=0 * WAVE), effort=True)
    assert found.effort is not None
    np.testing.assert_allclose(found.effort[0, :-1, 0], np.clip(WAVE, -0.2, 0.2)[:-1], rtol=0, atol=1e-12)


GRIPPER = """
<tendon><fixed name="both"><joint joint="shoulder" coef="0.5"/><joint joint="elbow" coef="0.5"/></fixed></tendon>
<actuator>
  <general name="grip" tendon="both" gainprm="0.2" biastype="affine" biasprm="0 -20 -1" ctrlrange="0 255"/>
</actuator>
"""


@pytest.mark.parametrize("law", [False, True])
def test_an_actuator_of_a_tendon_is_commanded_by_its_name(law: bool) -> None:
    robot = robot_from_xml(ARM.format(more=GRIPPER))
    ctrl = 100 + 100 * WAVE
    terms = (StribeckFriction(("elbow",)),) if law else ()
    values = terms[0].neutral if terms else ()
    found = replayed(robot, commands(command__grip=ctrl), terms, values).position[0]
    np.testing.assert_allclose(found, stepped(robot, ctrl[:, None]), rtol=0, atol=1e-10)
    assert np.abs(found).max() > 0.1


def test_an_actuator_that_is_not_commanded_keeps_what_the_keyframe_says() -> None:
    key = '<keyframe><key ctrl="120" qpos="0 0"/></keyframe>'
    robot = robot_from_xml(ARM.format(more=GRIPPER + key))
    np.testing.assert_allclose(only(commands(), robot), stepped(robot, np.full((401, 1), 120.0)), rtol=0, atol=1e-10)


def test_a_position_is_commanded_with_velocity_and_torque_fed_forward() -> None:
    """torque = kp (q* - q) + kd (v* - v) + tau*, with kp and kd as a candidate has them."""
    robot = arm('<position name="{j}" joint="{j}" kp="0.3" kv="0.02" gear="10"/>')
    speed, push = 2 * WAVE, 0.3 * np.cos(5 * TIME)
    log = commands(command__shoulder=WAVE, command_velocity__shoulder=speed, command_effort__shoulder=push)
    terms = parse_parameters(["kp:shoulder", "kv:shoulder"], robot)
    found = replayed(robot, log, terms, [1.2, 0.7], effort=True)
    kp, kd = 1.2 * 0.3, 0.7 * 0.02
    other = robot_from_xml(
        ARM.format(
            more=f"""<actuator>
            <position name="shoulder" joint="shoulder" kp="{kp}" kv="{kd}" gear="10"/>
            <position name="elbow" joint="elbow" kp="0.3" kv="0.02" gear="10"/>
            </actuator>"""
        )
    )
    # in ctrl: forces before the gear
    ctrl = 10 * WAVE + (kd * 10 * speed + push / 10) / kp
    np.testing.assert_allclose(found.position[0], stepped(other, np.column_stack([ctrl, 0 * ctrl])), rtol=0, atol=1e-10)
    assert found.effort is not None
    q, v = found.position[0, :-1, 0], found.velocity[0, :-1, 0]
    law = 100 * kp * (WAVE[:-1] - q) + 100 * kd * (speed[:-1] - v) + push[:-1]
    np.testing.assert_allclose(found.effort[0, :-1, 0], law, rtol=0, atol=1e-9)


def test_a_replayed_log_keeps_all_of_its_commands() -> None:
    robot = arm('<position name="{j}" joint="{j}" kp="0.3" kv="0.02" gear="10"/>')
    log = commands(command__shoulder=WAVE, command_velocity__shoulder=2 * WAVE, command_effort__shoulder=0.3 * WAVE)
    once = replay_log(robot, log, numerics=NUMERICS)
    again = replay_log(robot, once, numerics=NUMERICS)
    # it starts where its first samples are, which a line through them averages
    np.testing.assert_allclose(again.channels["position.shoulder"], once.channels["position.shoulder"], atol=1e-5)


def test_the_gain_of_a_velocity_servo_is_one_number() -> None:
    robot, log = arm(ACTUATORS["velocity"]), commands(command__shoulder=WAVE, command__elbow=WAVE)
    terms = parse_parameters(["kv:shoulder,elbow=shared"], robot)
    ctrl = np.column_stack([WAVE, WAVE])
    expected = stepped(arm(ACTUATORS["velocity"].replace('"2"', '"3"')), ctrl)
    np.testing.assert_allclose(replayed(robot, log, terms, [1.5]).position[0], expected, rtol=0, atol=1e-10)


@pytest.mark.parametrize("drive", ["torque", "geared torque"])
def test_without_a_command_the_measured_torque_drives_a_motor(drive: str) -> None:
    robot = arm(ACTUATORS[drive])
    log = commands(effort__shoulder=WAVE, effort__elbow=-2 * WAVE)
    ctrl = np.column_stack([CTRL[drive](WAVE), CTRL[drive](-2 * WAVE)])
    np.testing.assert_allclose(only(log, robot), stepped(robot, ctrl), rtol=0, atol=1e-10)


# --- never in silence -------------------------------------------------------------------------------------


def found(robot: Robot, log: Log, severity: str = "error") -> dict[str, Problem]:
    """Problems of the commands by code; a fit and a replay refuse what is an error."""
    problems = [p for p in check_log(robot, log) if p.code.startswith(("command.", "actuator."))]
    told = {p.code: p for p in problems if p.severity == severity}
    for attempt in (replay_log, lambda r, one: make_study(r, [one])):
        if severity == "error" and told:
            with pytest.raises(ModelError) as caught:
                attempt(robot, log)
            assert all(code in str(caught.value) for code in told)
    return told


def moving(log: Log, **columns: FloatArray) -> Log:
    """A log in which both joints move and are measured."""
    sensed = {f"position.{j}": 0.2 * np.sin(3 * TIME + i) for i, j in enumerate(("shoulder", "elbow"))}
    return replace(log, channels={**log.channels, **sensed, **columns})


def test_a_command_of_a_joint_without_an_actuator_is_an_error() -> None:
    robot = robot_from_xml(ARM.format(more='<actuator><motor name="m" joint="elbow"/></actuator>'))
    problem = found(robot, moving(commands(command__shoulder=WAVE, command__elbow=WAVE)))["command.undriven"]
    assert problem.where == "command.shoulder"
    assert "--servo" in problem.remedy


def test_a_command_that_nothing_in_the_model_is_called_after_is_an_error() -> None:
    robot = arm(ACTUATORS["position"])
    assert "command.undriven" in found(robot, moving(commands(command__wrist=WAVE)))


def test_two_actuators_of_a_joint_have_each_a_command_and_the_joint_none() -> None:
    both = '<position name="p" joint="shoulder" kp="20"/><velocity name="v" joint="shoulder" kv="1"/>'
    robot = robot_from_xml(ARM.format(more=f"<actuator>{both}</actuator>"))
    problem = found(robot, moving(commands(command__shoulder=WAVE)))["command.crowded"]
    assert "command.p, command.v" in problem.remedy
    each = commands(command__p=WAVE, command__v=2 * WAVE)
    assert found(robot, moving(each)) == {}
    np.testing.assert_allclose(only(each, robot), stepped(robot, np.column_stack([WAVE, 2 * WAVE])), rtol=0, atol=1e-10)


def test_an_actuator_without_a_unit_of_its_joint_is_commanded_in_ctrl_alone() -> None:
    robot = robot_from_xml(
        ARM.format(more='<actuator><intvelocity name="i" joint="shoulder" kp="20" actrange="-3 3"/></actuator>')
    )
    assert "command.no_meaning" in found(robot, moving(commands(command__shoulder=WAVE)))
    own = commands(command__i=WAVE)
    np.testing.assert_allclose(only(own, robot), stepped(robot, WAVE[:, None]), rtol=0, atol=1e-10)


def test_one_actuator_has_one_command() -> None:
    robot = arm('<position name="{j}_servo" joint="{j}" kp="20"/>')
    log = moving(commands(command__shoulder=WAVE, command__shoulder_servo=WAVE))
    assert "command.twice" in found(robot, log)


def test_what_the_log_says_its_commands_are_must_be_what_the_actuators_take() -> None:
    log = moving(commands(command__shoulder=WAVE, command__elbow=WAVE))
    positions = replace(log, meta=replace(log.meta, drive="position"))
    assert "command.kind" in found(arm(ACTUATORS["torque"]), positions)
    assert found(arm(ACTUATORS["geared position"]), positions) == {}


def test_positions_are_not_taken_for_torques_in_silence() -> None:
    log = moving(commands())
    late = {f"command.{j}": np.roll(log.channels[f"position.{j}"], -5) for j in ("shoulder", "elbow")}
    assert "command.kind" in found(arm(ACTUATORS["torque"]), replace(log, channels={**log.channels, **late}))


def test_what_nothing_commands_is_listed() -> None:
    robot = robot_from_xml(ARM.format(more=GRIPPER))
    log = moving(commands(effort__shoulder=WAVE))
    assert found(robot, log, "note")["actuator.idle"].where == "grip"


def test_ctrl_of_a_gripper_is_neither_degrees_nor_a_joint_that_is_missing(tmp_path: Path) -> None:
    log = moving(commands(command__grip=120 + 100 * WAVE))
    write_log(log, tmp_path / "log.parquet")
    read = read_log(tmp_path / "log.parquet")
    assert [p for p in check_log(robot_from_xml(ARM.format(more=GRIPPER)), read) if p.severity != "note"] == []


def test_torques_are_neither_degrees_nor_late_nor_dead() -> None:
    """15 Nm at a joint of 3 rad, 0 Nm at the other, which swings."""
    log = moving(commands(command__shoulder=15 * np.sin(9 * TIME), command__elbow=0 * TIME))
    assert [p for p in check_log(arm(ACTUATORS["torque"]), log) if p.severity != "note"] == []
    alone = replace(log, meta=replace(log.meta, drive="torque"))
    assert [p for p in validate_log(alone) if p.severity != "note"] == []


# --- joints that are not logged ---------------------------------------------------------------------------

FINGERS = """
<equality><joint joint1="elbow" joint2="shoulder" polycoef="0.1 2 0 0 0"/></equality>
<actuator><position name="shoulder" joint="shoulder" kp="30" kv="1"/></actuator>
<keyframe><key name="closed" qpos="0.3 0.7"/><key name="open" qpos="-0.1 -0.1"/></keyframe>
"""


def start(robot: Robot, log: Log) -> dict[str, float]:
    replay = Replay(robot, log, (), NUMERICS)
    return dict(zip(replay.index.joints, replay.start[0], strict=True))


def test_a_joint_that_is_not_logged_stands_where_it_is_said_to() -> None:
    more = ACTUATORS["position"].format(j="shoulder") + ACTUATORS["position"].format(j="elbow")
    keys = '<keyframe><key name="a" qpos="0.3 0.7"/><key name="b" qpos="0.1 0.2"/></keyframe>'
    robot = robot_from_xml(ARM.format(more=f"<actuator>{more}</actuator>{keys}"))
    log = commands(command__shoulder=0.3 + WAVE, position__shoulder=0.3 + 0 * TIME)
    assert start(robot, log)["elbow"] == 0.7
    in_metadata = replace(log, meta=replace(log.meta, at="keyframe:b"))
    assert start(robot, in_metadata)["elbow"] == 0.2
    assert start(robot, in_metadata)["shoulder"] == pytest.approx(0.3)
    assert start(replace(robot, at=(("elbow", -0.4),)), in_metadata)["elbow"] == -0.4
    (note,) = [p for p in check_log(robot, log) if p.code == "joint.unlogged"]
    assert (note.severity, note.where) == ("note", "elbow at 0.7")
    with pytest.raises(ModelError, match="no joint wrist"):
        start(replace(robot, at=(("wrist", 1.0),)), log)
    with pytest.raises(ModelError, match="its keyframes: a, b"):
        start(replace(robot, at=("keyframe:c",)), log)


def test_an_unlogged_joint_stands_where_it_is_told_to_in_every_mode() -> None:
    """By the same log, of which nothing that was found of it elsewhere may be used again."""
    more = ACTUATORS["position"].format(j="shoulder") + ACTUATORS["position"].format(j="elbow")
    robot = robot_from_xml(ARM.format(more=f"<actuator>{more}</actuator>"))
    log = commands(command__shoulder=WAVE, position__shoulder=WAVE, effort__shoulder=WAVE)
    elbow = joint_names(robot).index("elbow")
    for angle in (0.0, -0.4, 0.7):
        told = replace(robot, at=(("elbow", angle),))
        for episode in (episode_of(told, log, Mode("inverse")), episode_of(told, log, Mode("segments", "0.5"))):
            position = episode.replay((), NUMERICS).predict(np.zeros((1, 0))).position[0]
            assert position[0, elbow] == angle


QUADRUPED = """
<mujoco>
  <worldbody>
    <body name="trunk" pos="0 0 .4"><freejoint/><geom type="box" size=".1 .1 .05" mass="3"/>
      <body name="leg"><joint name="hip" axis="0 1 0"/><geom type="capsule" fromto="0 0 0 0 0 -.2" size=".02"/></body>
    </body>
  </worldbody>
  <actuator><position name="hip" joint="hip" kp="20" kv="1"/><motor name="push" site="tip"/></actuator>
  <keyframe><key name="home" qpos="0 0 .3 1 0 0 0 0.6" ctrl="0.6 0.2"/></keyframe>
</mujoco>
"""


def test_a_keyframe_of_a_floating_robot_holds_for_one_that_hangs_and_for_one_with_play() -> None:
    tip = '<geom type="capsule" fromto="0 0 0 0 0 -.2" size=".02"/><site name="tip" pos="0 0 -.2"/>'
    robot = robot_from_xml(QUADRUPED.replace('<geom type="capsule" fromto="0 0 0 0 0 -.2" size=".02"/>', tip))
    log = commands(command__hip=0.6 + 0 * TIME)
    for terms in ((), (Backlash(("hip",)),)):
        replay = Replay(robot, log, terms, NUMERICS)
        assert replay.start[0].tolist() == [0.6]
        assert replay.idle[1] == {"push": 0.2}
        assert replay.grid.extra[0].tolist() == [0.2]


def test_a_servo_without_a_command_holds_its_joint_where_it_stands() -> None:
    robot = replace(arm(ACTUATORS["position"].replace('kp="30"', 'kp="3000"')), at=(("elbow", 0.5),))
    found = only(commands(command__shoulder=0 * TIME, position__shoulder=0 * TIME), robot)
    assert np.abs(found[:, 1] - 0.5).max() < 2e-3


def test_a_coupled_joint_starts_and_moves_with_the_one_it_follows() -> None:
    robot = robot_from_xml(ARM.format(more=FINGERS))
    log = commands(command__shoulder=0.3 + WAVE, position__shoulder=0.3 + 0.5 * TIME)
    replay = Replay(robot, log, (), NUMERICS)
    (q, v) = replay.start
    assert q[1] == pytest.approx(0.1 + 2 * 0.3, abs=1e-9)
    assert v[1] == pytest.approx(2 * 0.5, abs=1e-6)
    moved = replay.predict(np.zeros((1, 0))).position[0]
    # MuJoCo's couplings are soft
    assert np.abs(moved[:, 1] - 0.1 - 2 * moved[:, 0]).max() < 0.02


# --- filters, switches, currents --------------------------------------------------------------------------

LAG = 0.05
FILTERED = (
    '<general name="{j}" joint="{j}" dyntype="%s" dynprm="0.05" gainprm="30" biastype="affine" biasprm="0 -30 -1"/>'
)


def finely(robot: Robot, ctrl: FloatArray) -> FloatArray:
    """(n, joints) of MuJoCo with the model's own filters, at steps of 20 us; these begin at the first ctrl."""
    model = robot.compile()
    model.opt.timestep = 2e-5
    data = mujoco.MjData(model)
    data.act[:] = ctrl[0]
    found = [data.qpos.copy()]
    for row in ctrl[:-1]:
        data.ctrl[:] = row
        mujoco.mj_step(model, data, 200)
        found.append(data.qpos.copy())
    return np.array(found)


@pytest.mark.parametrize("kind", ["filter", "filterexact"])
def test_a_filter_of_the_model_is_the_same_by_steps_of_either_kind_and_in_the_limit_mujocos(kind: str) -> None:
    robot = arm(FILTERED % kind)
    log = commands(command__shoulder=WAVE, command__elbow=-2 * WAVE)
    fine = Numerics("RK4", STEP)
    whole = Replay(robot, log, (), fine).predict(np.zeros((1, 0))).position[0]
    law = StribeckFriction(("elbow",))
    stepwise = Replay(robot, log, (law,), fine).predict(law.neutral[None]).position[0]
    np.testing.assert_allclose(stepwise, whole, rtol=0, atol=1e-6)
    assert np.abs(whole - finely(robot, np.column_stack([WAVE, -2 * WAVE]))).max() < 2e-4
    assert np.abs(whole - only(log, arm(ACTUATORS["position"]))).max() > 0.02


def test_a_filter_can_be_added_and_the_models_own_be_changed() -> None:
    log = commands(command__shoulder=WAVE, command__elbow=-2 * WAVE)
    own = replayed(arm(FILTERED % "filterexact"), log).position
    plain = arm(FILTERED % "none")
    added = parse_parameters(["actuator_filter:*=shared"], plain)
    np.testing.assert_allclose(replayed(plain, log, added, [LAG]).position, own, rtol=0, atol=1e-12)
    other = arm((FILTERED % "filterexact").replace("0.05", "0.2"))
    instead = parse_parameters(["filter_time:*=shared"], other)
    assert instead[0].parameters[0].nominal == 0.2
    np.testing.assert_allclose(replayed(other, log, instead, [LAG]).position, own, rtol=0, atol=1e-12)
    np.testing.assert_allclose(replayed(other, log, instead, [0.0]).position, only(log, plain)[None], atol=1e-12)


def test_a_filter_of_a_gripper_begins_at_rest() -> None:
    filtered = GRIPPER.replace("gainprm", 'dyntype="filterexact" dynprm="0.1" gainprm')
    log = commands(command__grip=np.full(len(TIME), 120.0))
    np.testing.assert_allclose(
        only(log, robot_from_xml(ARM.format(more=filtered))), only(log, robot_from_xml(ARM.format(more=GRIPPER)))
    )


def test_a_servo_is_off_where_the_log_says_so() -> None:
    on = np.where(TIME < 0.8, 1.0, 0.0)
    robot, moved = arm(ACTUATORS["position"]), {"command.shoulder": WAVE, "command.elbow": -2 * WAVE}
    log = make_log(TIME, {**moved, "enabled.elbow": on})
    found = replayed(robot, log, effort=True)
    model = Replay(robot, commands(), (), NUMERICS).model
    data, rows = mujoco.MjData(model), []
    elbow = model.actuator("elbow").id
    for k in range(len(TIME)):
        rows.append(data.qpos.copy())
        model.actuator_gainprm[elbow, 0], model.actuator_biasprm[elbow, 1:3] = 30 * on[k], [-30 * on[k], -on[k]]
        data.ctrl[:] = [WAVE[k], -2 * WAVE[k]]
        mujoco.mj_step(model, data, 2)
    np.testing.assert_allclose(found.position[0], np.array(rows), rtol=0, atol=1e-9)
    assert found.effort is not None
    assert np.abs(found.effort[0, TIME > 0.81, 1]).max() < 1e-9


def test_a_free_swing_without_a_command_is_a_whole_log() -> None:
    still = {f"{c}.{j}": 0 * TIME for c in ("enabled",) for j in ("shoulder", "elbow")}
    log = moving(make_log(TIME, still))
    assert [p for p in check_log(arm(ACTUATORS["position"]), log) if p.severity == "error"] == []


def test_a_current_times_a_torque_constant_is_a_torque(tmp_path: Path) -> None:
    log = moving(commands(current__shoulder=WAVE, current__elbow=-2 * WAVE))
    log = replace(log, meta=replace(log.meta, torque_constant={"shoulder": 0.1, "elbow": 0.2}))
    write_log(log, tmp_path / "log.parquet")
    read = read_log(tmp_path / "log.parquet")
    np.testing.assert_allclose(read.channels["effort.shoulder"], 0.1 * WAVE)
    np.testing.assert_allclose(read.channels["effort.elbow"], -0.4 * WAVE)
    (note,) = [p for p in validate_log(read) if p.code == "current.torque"]
    assert note.severity == "note"


# --- fits ------------------------------------------------------------------------------------------------


def recorded(robot: Robot, log: Log, parameters: dict[str, float], seed: int = 0) -> Log:
    """What a robot with other parameters shows of commands, with the noise of an encoder."""
    seen = replay_log(robot, log, parameters, numerics=NUMERICS)
    rng = np.random.default_rng(seed)
    noisy = {n: v + rng.normal(0, 2e-4, len(v)) for n, v in seen.channels.items() if n.startswith("position.")}
    return replace(log, channels={**log.channels, **noisy})


@pytest.mark.parametrize("drive", ["geared torque", "geared position", "geared velocity"])
def test_a_mass_is_recovered_through_any_drive(drive: str) -> None:
    robot = arm(ACTUATORS[drive])
    size = 3.0 if "velocity" in drive else 1.0
    log = commands(command__shoulder=size * WAVE, command__elbow=-size * WAVE)
    found = fit(make_study(robot, [recorded(robot, log, {"mass:lower": 1.2})], numerics=NUMERICS), ["mass:lower"])
    (mass,) = found.estimates
    assert mass.std < 0.03
    assert mass.value == pytest.approx(1.2, abs=3 * mass.std)


def test_friction_of_a_joint_that_nothing_drives_is_found() -> None:
    """A shoulder swings the elbow, which has no drive: its sizes are those of what its motion takes."""
    alone = ACTUATORS["position"].format(j="shoulder")
    robot = robot_from_xml(ARM.format(more=f"<actuator>{alone}</actuator>"))
    robot = replace(robot, bounds={"mass": (0.3, 3.0)})
    log = commands(command__shoulder=2 * WAVE)
    study = make_study(robot, [recorded(robot, log, {"coulomb_friction:elbow": 0.03})], numerics=NUMERICS)
    assert 0.01 < study.scales["elbow"].torque_rms < 1.0
    found = close(study, ["mass:lower"], effects=("coulomb_friction", "joint_spring", "payload"))
    assert [(e.effect, e.where) for e in found.effects] == [("coulomb_friction", ("elbow",))], found.message
    (torque,) = found.effects[0].parameters
    # a swing that nothing holds forgets the error of its start slowly
    assert torque.ci95[0] < 0.03 < torque.ci95[1]
    assert torque.std < 0.005


def test_the_torque_that_drives_is_not_compared_with_itself() -> None:
    robot = arm(ACTUATORS["torque"])
    log = recorded(robot, commands(effort__shoulder=WAVE, effort__elbow=-2 * WAVE), {})
    study = make_study(robot, [log], numerics=NUMERICS, mode=Mode("forward"))
    (comparison,) = study.train_problem(()).episodes
    assert [t.channel for t in comparison.targets] == ["position"]


def test_a_range_in_radians_of_a_model_that_is_read_in_degrees_is_told_as_that() -> None:
    log = moving(commands())
    for width, told in ((1.5, False), (np.radians(1.5), True)):
        ranges = dict.fromkeys(("shoulder", "elbow"), (-width, width))
        remedies = [
            p.remedy for p in validate_log(log, joints=tuple(ranges), ranges=ranges) if p.code == "units.degrees"
        ]
        assert [("<compiler" in remedy) for remedy in remedies] == [True] * told


def test_of_two_channels_that_differ_like_degrees_the_range_of_the_joint_says_which_is_wrong() -> None:
    robot = arm(ACTUATORS["position"])
    log = moving(commands())
    small = {f"command.{j}": np.radians(log.channels[f"position.{j}"]) for j in ("shoulder", "elbow")}
    log = replace(log, channels={**log.channels, **small})
    ranges = dict.fromkeys(("shoulder", "elbow"), (-1.5, 1.5))
    told = {p.code: p for p in validate_log(log, joints=tuple(ranges), ranges=ranges)}
    assert told["units.degrees_twice"].where == "command of shoulder, elbow"
    assert "180/pi" in told["units.degrees_twice"].remedy
    assert "units.degrees" not in told
    assert {p.code for p in check_log(robot, log) if p.severity == "error"} == {"units.degrees"}


SERVO = """
<mujoco>
  <compiler angle="radian"/>
  <option timestep="0.001" integrator="implicitfast"/>
  <worldbody>
    <body name="arm">
      <joint name="pendulum" axis="0 -1 0" {joint}/>
      <geom type="sphere" size="0.02" pos="0 0 -0.12" mass="1.13"/>
    </body>
  </worldbody>
  <actuator><position name="pendulum" joint="pendulum" {servo} forcerange="-4.9 4.9"/></actuator>
</mujoco>
"""


def swung(command: FloatArray, time: FloatArray, released: float, seed: int) -> Log:
    """A servo with inertia, damping, friction and a gain of its own, that lets its pendulum go at some moment."""
    servo = {"joint": 'armature="0.0085" damping="0.07" frictionloss="0.03"', "servo": 'kp="22" kv="0.5"'}
    model = mujoco.MjModel.from_xml_string(SERVO.format(**servo))
    data, rng, position = mujoco.MjData(model), np.random.default_rng(seed), np.empty(len(time))
    for k, now in enumerate(time):
        position[k], data.ctrl[0] = data.qpos[0], command[k]
        if now >= released:
            model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_ACTUATION
        mujoco.mj_step(model, data, round(float(time[1]) / model.opt.timestep))
    tick = 2 * np.pi / 4096
    seen = np.round((position + 3e-4 * rng.normal(size=len(time))) / tick) * tick
    channels = {"command.pendulum": command, "position.pendulum": seen, "enabled.pendulum": time < released}
    return make_log(time, channels, source="measured")


def test_a_servo_that_lets_go_shows_inertia_damping_and_friction_and_no_blow() -> None:
    """What is missing shows most where the drive is off; of all that is driven it lacks a gain of its velocity too."""
    time = 0.02 * np.arange(250)
    up = np.clip(time / 2, 0, 1)
    wave = 0.5 * np.pi * np.sin(time) + 0.5 * np.sin(5 * time) * np.sin(2 * time)
    lifted = swung(-0.5 * np.pi * (3 * up**2 - 2 * up**3), time, 2.0, seed=1)
    logs = [swung(wave, time, np.inf, seed=0), lifted, swung(np.sin(time**2), time, np.inf, seed=2)]
    library = [
        *("viscous_damping", "coulomb_friction", "armature", "actuator_filter", "sensor_delay", "command_delay"),
        *("com_offset", "payload", "external_disturbance"),
    ]
    robot = robot_from_xml(SERVO.format(joint="", servo='kp="20"'))
    found = close(make_study(robot, logs, threads=1), ["kp:*"], effects=library)
    amounts = {e.name: e for e in found.estimates}
    truth = {"viscous_damping": 0.07, "armature": 0.0085, "coulomb_friction": 0.03}
    assert {e.effect for e in found.effects} - {*truth} <= {"actuator_filter", "command_delay", "sensor_delay"}
    for name, value in truth.items():
        estimate = amounts[f"{name}:pendulum"]
        assert estimate.ci95[0] < value < estimate.ci95[1], estimate
        assert estimate.std < 0.2 * value
