"""Every declared parameter, written into a compiled model, equals a model built with that value."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from toys import LEG, LEG_JOINTS, leg, make_log, position, robot_from_xml, run, swing, with_spec

from sysid_btr.terms.effect import DofEffect
from sysid_btr.terms.friction import CoulombFriction, QuadraticDamping, ViscousDamping
from sysid_btr.terms.grammar import parse_parameters
from sysid_btr.terms.inertial import Armature

LOG = swing(LEG_JOINTS, seconds=0.6)
EXACT = 1e-9


def scale_mass(spec: Any, factor: float) -> None:
    spec.body("knee").geoms[0].mass *= factor


def shift_com(spec: Any, shift: tuple[float, ...]) -> None:
    geom = spec.body("knee").geoms[0]
    geom.pos = np.array(geom.pos) + shift


def set_joint(spec: Any, name: str, value: Any) -> None:
    setattr(spec.joint("knee"), name, value)


def scale_kp(spec: Any, factor: float) -> None:
    servo = spec.actuator("knee")
    gain, bias = np.array(servo.gainprm), np.array(servo.biasprm)
    gain[0] *= factor
    bias[1] *= factor
    servo.gainprm, servo.biasprm = gain, bias


def scale_kv(spec: Any, factor: float) -> None:
    servo = spec.actuator("knee")
    bias = np.array(servo.biasprm)
    bias[2] *= factor
    servo.biasprm = bias


def limit_force(spec: Any, limit: float) -> None:
    servo = spec.actuator("knee")
    servo.forcelimited = True
    servo.forcerange = [-limit, limit]


CASES: dict[str, tuple[str, list[float], Callable[[Any], None]]] = {
    "mass": ("mass:knee", [1.3], lambda s: scale_mass(s, 1.3)),
    "com": ("com:knee", [0.01, -0.02, 0.03], lambda s: shift_com(s, (0.01, -0.02, 0.03))),
    "damping": ("damping:knee", [0.31], lambda s: set_joint(s, "damping", [0.31, 0, 0])),
    "quadratic_damping": ("quadratic_damping:knee", [0.04], lambda s: set_joint(s, "damping", [0.05, 0.04, 0])),
    "frictionloss": ("frictionloss:knee", [0.2], lambda s: set_joint(s, "frictionloss", 0.2)),
    "armature": ("armature:knee", [0.02], lambda s: set_joint(s, "armature", 0.02)),
    "damping_factor": ("damping_factor:knee", [2.4], lambda s: set_joint(s, "damping", [0.12, 0, 0])),
    "armature_factor": ("armature_factor:knee", [0.4], lambda s: set_joint(s, "armature", 0.0024)),
    "stiffness": ("stiffness:knee", [1.7], lambda s: set_joint(s, "stiffness", [1.7, 0, 0])),
    "kp": ("kp:knee", [0.7], lambda s: scale_kp(s, 0.7)),
    "kv": ("kv:knee", [2.1], lambda s: scale_kv(s, 2.1)),
    "force_limit": ("force_limit:knee", [0.4], lambda s: limit_force(s, 0.4)),
}


@pytest.mark.parametrize("name", CASES)
def test_a_parameter_equals_the_model_recompiled_with_its_value(name: str) -> None:
    expression, values, edit = CASES[name]
    robot = leg()
    terms = parse_parameters([expression], robot)
    written = position(robot, LOG, terms, values)
    compiled = position(with_spec(robot, edit), LOG)
    np.testing.assert_allclose(written, compiled, rtol=0, atol=EXACT)
    assert np.abs(written - position(robot, LOG)).max() > 1e-4, "the case would not notice a missing write"


def test_mass_takes_the_inertia_along_and_inertia_leaves_the_mass() -> None:
    robot = leg()
    both = parse_parameters(["mass:knee", "inertia:knee"], robot)
    as_one = position(robot, LOG, parse_parameters(["mass:knee"], robot), [1.3])
    apart = position(robot, LOG, both, [1.3, 1.0])
    point = position(robot, LOG, both, [1.0, 3.0])
    np.testing.assert_allclose(as_one, apart, atol=1e-12)
    assert np.abs(point - position(robot, LOG)).max() > 1e-4


@pytest.mark.parametrize(
    ("field", "place", "value"),
    [("damping", "knee", 0.05), ("armature", "hip", 0.006), ("stiffness", "ankle", 0.1), ("frictionloss", "knee", 0)],
)
def test_absolute_fields_start_from_the_model(field: str, place: str, value: float) -> None:
    assert parse_parameters([f"{field}:{place}"], leg())[0].parameters[0].nominal == pytest.approx(value)


@pytest.mark.parametrize("cls", [CoulombFriction, ViscousDamping, QuadraticDamping, Armature])
def test_a_models_own_value_is_the_value_that_a_change_leads_to(cls: type[DofEffect]) -> None:
    (own,) = parse_parameters([f"{cls.field}:knee"], leg())
    value = own.parameters[0].nominal + 0.03
    changed = position(leg(), LOG, [cls(places=("knee",))], [0.03])
    np.testing.assert_allclose(position(leg(), LOG, [own], [value]), changed, rtol=0, atol=1e-12)
    assert np.abs(changed - position(leg(), LOG)).max() > 1e-4


def test_a_gear_does_not_change_what_a_force_limit_is() -> None:
    """The limit is a torque at the joint, whatever the transmission."""
    servo = '<position name="knee" joint="knee" kp="20" kv=".6"/>'
    assert servo in LEG
    geared = robot_from_xml(
        LEG.replace(
            servo,
            '<general name="knee" joint="knee" gear="5" gainprm="4" biastype="affine" biasprm="0 -.8 -.024"'
            ' forcerange="-.3 .3"/>',
        )
    )
    terms = parse_parameters(["force_limit:knee"], geared)
    assert terms[0].parameters[0].nominal == pytest.approx(1.5)
    np.testing.assert_allclose(position(geared, LOG, terms), position(geared, LOG), atol=1e-12)
    plain = position(leg(), LOG, parse_parameters(["force_limit:knee"], leg()), [0.4])
    np.testing.assert_allclose(position(geared, LOG, terms, [0.4]), plain, atol=EXACT)


def test_a_force_limit_can_be_above_the_nominal_one() -> None:
    robot = with_spec(leg(), lambda s: limit_force(s, 0.4))
    terms = parse_parameters(["force_limit:knee"], robot)
    np.testing.assert_allclose(position(robot, LOG, terms, [0.8]), position(leg(), LOG, terms, [0.8]))


def test_a_limit_is_none_at_its_neutral_value_and_one_within_bounds_that_a_user_gives() -> None:
    robot = replace(leg(), bounds={"force_limit": (0.1, 0.4)})
    (limit,) = parse_parameters(["force_limit:knee"], robot)
    np.testing.assert_array_equal(position(robot, LOG, [limit]), position(robot, LOG))
    most = position(robot, LOG, [limit], [limit.parameters[0].upper])
    np.testing.assert_allclose(most, position(with_spec(robot, lambda s: limit_force(s, 0.4)), LOG), atol=EXACT)
    (speed,) = parse_parameters(["speed_torque_limit.no_load_speed:knee"], robot)
    np.testing.assert_array_equal(position(robot, LOG, [speed], [0.5]), position(robot, LOG))


def test_constant_force_acts_in_the_direction_of_the_joint() -> None:
    robot = leg()
    terms = parse_parameters(["constant_force:knee"], robot)

    def push(spec: Any) -> None:
        servo = spec.actuator("knee")
        bias = np.array(servo.biasprm)
        bias[0] = 0.37
        servo.biasprm = bias

    np.testing.assert_allclose(position(robot, LOG, terms, [0.37]), position(with_spec(robot, push), LOG), atol=EXACT)


def test_start_corrections_change_the_start_only_where_they_are() -> None:
    robot = leg()
    outputs = run(robot, LOG, parse_parameters(["qpos0:knee", "qvel0:hip"], robot), [0.05, 0.4])
    np.testing.assert_allclose(outputs.position[0, 0], [0, 0.05, 0])
    np.testing.assert_allclose(outputs.velocity[0, 0], [0.4, 0, 0])


FOOT = """
<mujoco><worldbody>
  <geom name="floor" type="plane" size="5 5 .1" friction="{floor}"/>
  <body name="a" pos="0 0 .05">
    <joint name="ax" type="slide" axis="1 0 0"/><joint name="az" type="slide" axis="0 0 1"/>
    <geom type="box" size=".05 .05 .05" mass="1" friction="{foot}"/></body>
  <body name="b" pos="0 1 .05">
    <joint name="bx" type="slide" axis="1 0 0"/><joint name="bz" type="slide" axis="0 0 1"/>
    <geom type="box" size=".05 .05 .05" mass="1" friction="{foot}"/></body>
</worldbody></mujoco>
"""


@pytest.mark.parametrize(("floor", "foot"), [(1.0, 0.8), (0.3, 0.8)])
def test_foot_friction_sets_the_deceleration_of_each_sliding_body(floor: float, foot: float) -> None:
    robot = robot_from_xml(FOOT.format(floor=floor, foot=foot))
    time = np.arange(31) * 0.01
    names = ("ax", "az", "bx", "bz")
    channels = {f"position.{n}": np.zeros(31) for n in names} | {f"velocity.{n}": np.zeros(31) for n in names}
    for name in ("ax", "bx"):
        channels[f"velocity.{name}"] = np.full(31, 3.0)
    log = make_log(time, channels)
    terms = parse_parameters(["foot_friction:a", "foot_friction:b"], robot)
    assert [p.nominal for m in terms for p in m.parameters] == [max(floor, foot)] * 2
    outputs = run(robot, log, terms, [[0.4, 0.7], [max(floor, foot)] * 2])
    stopped = 3.0 - outputs.velocity[0, -1, [0, 2]]
    np.testing.assert_allclose(stopped, 9.81 * 0.3 * np.array([0.4, 0.7]), rtol=0.03)
    np.testing.assert_allclose(outputs.position[1], run(robot, log).position[0], atol=1e-9)
