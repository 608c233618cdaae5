"""URDF as it is found: what is missing is told and does without, what contradicts itself is refused."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from terminal import Cli

from sysid_btr.errors import ModelError
from sysid_btr.models.actuation import Servo, with_servos
from sysid_btr.models.builtin import load_robot
from sysid_btr.models.robot import Robot, driven_joints, servo_joints

INERTIA = '<mass value="1.5"/><inertia ixx="0.02" iyy="0.03" izz="0.04" ixy="0" ixz="0" iyz="0"/>'
MESH = '<visual><geometry><mesh filename="package://arm_description/meshes/upper.stl"/></geometry></visual>'
URDF = """<?xml version="1.0"?>
<robot name="arm">
  <link name="base"/>
  <link name="upper">{mesh}<inertial><origin xyz="0 0 -0.1"/>{inertia}</inertial></link>
  <link name="lower"><inertial><origin xyz="0 0 -0.1"/>{inertia}</inertial></link>
  <joint name="shoulder" type="revolute"><parent link="base"/><child link="upper"/><axis xyz="0 1 0"/>{origin}
    <limit lower="-2" upper="2" effort="0" velocity="5"/></joint>
  <joint name="elbow" type="continuous"><origin xyz="0 0 -0.2"/><parent link="upper"/><child link="lower"/>
    <axis xyz="0 1 0"/>{mimic}</joint>
  <transmission name="t"><type>SimpleTransmission</type></transmission>
</robot>
"""

Write = Callable[..., Path]


@pytest.fixture
def write(tmp_path: Path) -> Write:
    def written(name: str = "arm.urdf", **parts: str) -> Path:
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        given = {"mesh": MESH, "inertia": INERTIA, "origin": "", "mimic": "", **parts}
        path.write_text(URDF.format(**given))
        return path

    return written


def test_a_mesh_that_is_missing_is_left_out_and_the_stated_masses_count(write: Write) -> None:
    robot = load_robot(str(write()))
    assert robot.model.body("upper").mass[0] == 1.5
    assert "upper.stl" in robot.remarks[0]
    assert robot.to_dict()["remarks"] == list(robot.remarks)


def test_a_mesh_of_a_package_is_found_in_the_folders_around(write: Write, tmp_path: Path) -> None:
    mesh = tmp_path / "arm_description" / "meshes" / "upper.stl"
    mesh.parent.mkdir(parents=True)
    corners = np.array([[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0], [0, 0, 0.1]], dtype="<f4")
    faces = corners[[[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]]
    rows = np.zeros(4, dtype=[("normal", "<f4", 3), ("corner", "<f4", (3, 3)), ("more", "<u2")])
    rows["corner"] = faces
    mesh.write_bytes(bytes(80) + np.uint32(4).tobytes() + rows.tobytes())
    shape = MESH.replace("visual", "collision")
    robot = load_robot(str(write("arm_description/urdf/arm.urdf", mesh=shape)))
    assert robot.model.nmesh == 1
    assert not any("mesh" in remark for remark in robot.remarks)


@pytest.mark.parametrize(
    "inertia", ["", '<mass value="0.2"/><inertia ixx="0" iyy="0" izz="0" ixy="0" ixz="0" iyz="0"/>']
)
def test_moving_links_without_inertia_are_points_and_that_is_told(write: Write, inertia: str) -> None:
    robot = load_robot(str(write(mesh="", inertia=inertia)))
    assert robot.model.body("lower").mass[0] == pytest.approx(0.2 if inertia else 1e-6)
    assert any("upper, lower" in remark for remark in robot.remarks)


def test_an_element_that_stands_twice_and_differs_is_refused_by_name(write: Write) -> None:
    path = write(origin='<origin xyz="0 0 1"/><origin xyz="0 0 0"/>')
    with pytest.raises(ModelError, match=r"<origin> of joint 'shoulder' stands 2 times(.|\n)*Delete"):
        load_robot(str(path))
    same = load_robot(str(write(origin='<origin xyz="0 0 1"/><origin xyz="0 0 1"/>')))
    assert any("'shoulder'" in remark for remark in same.remarks)


def test_the_ending_of_the_name_may_be_in_capitals(write: Write, tmp_path: Path) -> None:
    assert load_robot(str(write("ARM.URDF"))).model.njnt == 2
    (tmp_path / "ARM.XML").write_text("<mujoco><worldbody/></mujoco>")
    with pytest.raises(ModelError, match=r"rename the file to end in \.xml"):
        load_robot(str(tmp_path / "ARM.XML"))


def test_without_actuators_there_are_motors_and_that_is_told(write: Write) -> None:
    robot = load_robot(str(write()))
    assert driven_joints(robot) == ("shoulder", "elbow")
    assert servo_joints(robot) == ()
    assert any("torque motor" in remark and "--servo" in remark for remark in robot.remarks)


def test_a_joint_that_mimics_another_has_no_motor(write: Write) -> None:
    mimic = '<mimic joint="shoulder" multiplier="2" offset="0.1"/>'
    assert driven_joints(load_robot(str(write(mimic=mimic)))) == ("shoulder",)


def test_servos_take_the_place_of_motors_with_the_gains_that_are_stated(write: Write) -> None:
    robot = load_robot(str(write(mesh=MESH.replace("upper.stl", "torque motor.stl"))), Servo(kp=80, kv=3))
    assert servo_joints(robot) == ("shoulder", "elbow")
    assert robot.model.nu == 2
    np.testing.assert_array_equal(robot.model.actuator_biasprm[:, 1:3], [[-80, -3]] * 2)
    left_out, put = robot.remarks
    assert "torque motor.stl" in left_out
    assert put == "position servos of kp 80 and kv 3 are put on shoulder, elbow"
    assert _gains(with_servos(robot, Servo(kp=1))) == [80, 80]


def _gains(robot: Robot) -> list[float]:
    return [float(g) for g in robot.model.actuator_gainprm[:, 0]]


def test_the_command_line_says_what_was_changed(write: Write, cli: Cli) -> None:
    answer = cli("fit", "--model", str(write()), "--servo", "kp=80,kv=3")
    assert "upper.stl" in answer.err
    assert "position servos of kp 80 and kv 3" in answer.err
    wrong = cli("fit", "--model", str(write()), "--servo", "kv=3")
    assert wrong.code == 2
    assert "--servo kp=100,kv=5" in wrong.err
