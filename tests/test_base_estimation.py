"""Base state against simulated truth; falls, pick-ups and slips; what a missing sensor costs."""

from __future__ import annotations

from dataclasses import astuple, replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from walks import Scale, Truth, plain_walk, record_walk

from sysid_btr.errors import LogError, ModelError
from sysid_btr.floating_base.attitude import resting, turning_over
from sysid_btr.floating_base.estimate import BaseState, estimate_base, find_contacts
from sysid_btr.floating_base.events import FALLEN, Event, find_fall, find_pickups, find_slips, usable
from sysid_btr.floating_base.feet import force_columns, points_in_base, touching_bodies
from sysid_btr.floating_base.size import NAO, BodySize, measure_size
from sysid_btr.identify.smoothing import smooth_joints
from sysid_btr.io.log import Log
from sysid_btr.io.parquet import read_log
from sysid_btr.models.builtin import load_robot
from sysid_btr.models.gait import Gait
from sysid_btr.models.robot import Robot
from sysid_btr.simulation.compiling import compile_model, make_index
from sysid_btr.simulation.numerics import Numerics

INNER = slice(10, -10)
Vector = tuple[float, float, float]


def estimate(log: Log, truth: Truth) -> BaseState:
    addresses = np.array([truth.model.jnt_qposadr[truth.model.joint(j).id] for j in truth.joints])
    return estimate_base(truth.model, log, truth.joints, addresses)


@cache
def plain_state() -> BaseState:
    return estimate(*plain_walk())


def without(log: Log, prefix: str) -> Log:
    return replace(log, channels={k: v for k, v in log.channels.items() if not k.startswith(prefix)})


def errors(state: BaseState, truth: Truth) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Error and stated standard deviation of everything that a replay starts from."""
    turn = Rotation.from_matrix(state.rotation @ truth.rotation.transpose(0, 2, 1)).as_rotvec()
    pairs = {
        "tilt": (turn[:, :2], state.rotation_std[:, :2]),
        "height": ((state.position - truth.position)[:, 2:], state.position_std[:, 2:]),
        "velocity": (state.velocity - truth.velocity, state.velocity_std),
        "rate": (state.rate - truth.rate, state.rate_std),
        "joint position": (state.joint_position - truth.joint_position, state.joint_position_std),
        "joint velocity": (state.joint_velocity - truth.joint_velocity, state.joint_velocity_std),
    }
    return {name: (e[INNER], s[INNER]) for name, (e, s) in pairs.items()}


def rms(x: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(x))))


def test_the_base_is_found_within_what_walking_needs() -> None:
    found = errors(plain_state(), plain_walk()[1])
    limits = {"tilt": 2e-3, "height": 1e-3, "velocity": 0.015, "rate": 0.02, "joint position": 5e-4}
    for name, limit in limits.items():
        assert rms(found[name][0]) < limit, name


def test_stated_deviations_cover_the_errors() -> None:
    for name, (error, std) in errors(plain_state(), plain_walk()[1]).items():
        inside = np.mean(np.abs(error) < 1.96 * std)
        assert inside > 0.88, name
        # and they are no blank cheque
        assert rms(std) < 4 * rms(error), name


def test_smoothing_beats_the_sensors() -> None:
    log, truth = plain_walk()
    state = plain_state()
    raw = np.diff(log.array("position", truth.joints), axis=0) / 0.02
    assert rms(state.joint_velocity - truth.joint_velocity) < 0.75 * rms(raw - truth.joint_velocity[1:])
    roll = np.arctan2(truth.rotation[:, 2, 1], truth.rotation[:, 2, 2])
    assert rms(errors(state, truth)["tilt"][0][:, 0]) < 0.5 * rms(log.channels["imu.angle_x"] - roll)


def test_feet_stand_when_they_carry_the_robot() -> None:
    log, _truth = plain_walk()
    state = plain_state()
    assert state.feet == ("RAnkleRoll", "LAnkleRoll")
    load = np.stack([sum(v for k, v in log.channels.items() if k.startswith(f"force.{s}")) for s in "RL"], axis=1)
    assert np.mean(state.contact == (load > 2.0)) > 0.95
    assert 0.5 < state.contact.mean() < 0.98  # there are steps
    assert state.usable.all()
    assert state.events == ()


def test_without_force_sensors_it_works_and_says_what_is_lost() -> None:
    log, truth = plain_walk()
    state = estimate(without(log, "force."), truth)
    assert any("pick-ups" in text for text in state.lost)
    found = errors(state, truth)
    assert rms(found["tilt"][0]) < 2e-3
    assert rms(found["height"][0]) < 1e-3
    assert rms(found["velocity"][0]) < 0.025
    assert plain_state().lost == ()


def test_without_inclinometers_the_accelerometer_gives_the_vertical() -> None:
    log, truth = plain_walk()
    state = estimate(without(log, "imu.angle"), truth)
    assert any("inclinometer" in text for text in state.lost)
    error, std = errors(state, truth)["tilt"]
    assert rms(error) < 0.02
    assert rms(std) > rms(plain_state().rotation_std[:, :2])


def test_without_gyro_it_refuses_and_names_what_is_missing() -> None:
    log, truth = plain_walk()
    with pytest.raises(LogError, match=r"imu\.gyro_x, imu\.gyro_y, imu\.gyro_z"):
        estimate(without(log, "imu.gyro"), truth)


def test_without_an_inertial_unit_the_feet_say_how_the_robot_stands() -> None:
    log, truth = plain_walk()
    state = estimate(without(without(log, "imu."), "force."), truth)
    assert any("no inertial unit" in text for text in state.lost)
    found = errors(state, truth)
    # steps of a walk tilt the soles; a robot that stands does not
    assert rms(found["tilt"][0]) < 0.025
    assert rms(found["height"][0]) < 1e-3
    assert rms(found["velocity"][0]) < 0.1
    for name in ("tilt", "height", "velocity", "rate"):
        error, std = found[name]
        assert np.mean(np.abs(error) < 1.96 * std) > 0.8, name
        assert rms(std) < 4 * rms(error), name


@given(rate=st.tuples(*[st.floats(-3, 3)] * 3), drift=st.tuples(*[st.floats(-1, 1)] * 3), seed=st.integers(0, 99))
def test_the_base_turns_as_points_at_rest_seem_to_turn_about_it(rate: Vector, drift: Vector, seed: int) -> None:
    points = np.random.default_rng(seed).uniform(-0.1, 0.1, (5, 3))
    found = turning_over(points, -np.asarray(drift) - np.cross(rate, points))
    assert found == pytest.approx(np.asarray(rate), abs=1e-6)


@pytest.mark.parametrize("lean", [0.0, 0.2, -0.1])
def test_a_robot_at_rest_stands_on_its_soles(lean: float) -> None:
    _log, truth = plain_walk()
    addresses = np.array([truth.model.jnt_qposadr[truth.model.joint(j).id] for j in truth.joints])
    stance = np.zeros(len(truth.joints))
    for side in "LR":
        stance[truth.joints.index(f"{side}HipPitch")] = lean
    feet = touching_bodies(truth.model)
    points = np.concatenate([p[0] for p in points_in_base(truth.model, feet, addresses, stance[None])])
    radius = np.concatenate([f.radius for f in feet])
    up = resting(truth.model, addresses, stance, points, radius)
    # the hips turn about y: what is up for the soles is turned by as much in the trunk
    assert up == pytest.approx(np.array([np.sin(lean), 0.0, np.cos(lean)]), abs=2e-3)


def test_a_held_model_is_refused_for_a_free_log() -> None:
    log, _truth = plain_walk()
    held = replace(log, meta=replace(log.meta, mount="fixed"))
    model = compile_model(load_robot("nao"), held, (), Numerics("RK4", 0.005))
    index = make_index(model)
    with pytest.raises(ModelError, match="no free joint"):
        estimate_base(model, log, index.joints, index.qpos)


@cache
def pushed_over() -> tuple[Log, Truth]:
    return record_walk(Gait(), 6.0, push=lambda t: np.array([0.0, 25.0 * (3.0 < t < 3.4), 0.0]))


@cache
def lifted() -> tuple[Log, Truth]:
    return record_walk(Gait(), 6.0, push=lambda t: np.array([0.0, 0.0, 60.0 * (3.0 < t < 3.3)]))


def test_a_push_over_is_a_fall_and_nothing_after_it_is_used() -> None:
    log, truth = pushed_over()
    state = estimate(log, truth)
    tilt = np.arccos(np.clip(truth.rotation[:, 2, 2], -1, 1))
    first = log.time[np.argmax(tilt > FALLEN)]
    assert tilt.max() > 1.2
    (fall,) = [e for e in state.events if e.kind == "fall"]
    assert fall.start == pytest.approx(first, abs=0.04)
    assert not state.usable[log.time > fall.start - 0.2].any()
    assert state.usable[log.time < 2.9].all()


def test_a_lifted_robot_is_found() -> None:
    kinds = {e.kind: e for e in estimate(*lifted()).events}
    assert "pick-up" in kinds
    assert 2.9 < kinds["pick-up"].start < 3.3


def test_events_leave_out_what_surrounds_them() -> None:
    time = np.arange(0, 10, 0.02)
    keep = usable(time, (Event("slip", 2.0, 2.2), Event("fall", 8.0, 10.0)), NAO)
    assert not keep[(time > 1.95) & (time < 2.25)].any()
    assert keep[(time > 2.4) & (time < 7.6)].all()
    assert not keep[time > 7.8].any()


def test_a_walk_that_leans_far_is_no_fall() -> None:
    time = np.arange(0, 3, 0.02)
    assert find_fall(time, 0.5 * np.abs(np.sin(time))) is None
    fall = find_fall(time, time)
    assert fall is not None
    assert fall.start == pytest.approx(FALLEN)


def test_short_flights_and_still_feet_are_no_events() -> None:
    time = np.arange(0, 3, 0.02)
    load = np.full(len(time), 40.0)
    load[50:54] = 0.0
    assert find_pickups(time, load, NAO) == ()
    load[100:120] = 0.0
    (event,) = find_pickups(time, load, NAO)
    assert (event.start, event.stop) == (pytest.approx(2.0), pytest.approx(2.38))
    speed = np.full((len(time), 1), 0.02)
    loaded = np.ones((len(time), 1), dtype=bool)
    std = np.full((len(time), 1), 0.01)
    assert find_slips(time, speed, std, loaded, NAO) == ()
    speed[30:40] = 0.3
    (slip,) = find_slips(time, speed, std, loaded, NAO)
    assert slip.kind == "slip"
    assert find_slips(time, speed, 10 * std, loaded, NAO) == ()  # it could be noise


def test_a_dropped_force_sample_does_not_lift_a_foot() -> None:
    load = np.tile([20.0, 20.0], (9, 1))
    load[4, 0] = 0.0
    bottom = np.full((9, 2), -0.3)
    assert find_contacts(bottom, load, NAO).all()
    load[3:6, 0] = 0.0
    assert not find_contacts(bottom, load, NAO)[4, 0]
    assert not find_contacts(bottom - [[0.0, 0.05]], None, NAO)[:, 0].any()


def test_points_of_the_feet_follow_the_joints() -> None:
    _, truth = plain_walk()
    model = truth.model
    feet = touching_bodies(model)
    addresses = np.array([model.jnt_qposadr[model.joint(j).id] for j in truth.joints])
    points = points_in_base(model, feet, addresses, truth.joint_position[:3])
    # the lowest points of the standing robot are the floor's height below its base
    world = np.einsum("nij,nkj->nki", truth.rotation[:3], points[0]) + truth.position[:3, None]
    assert world[..., 2].min(axis=1) == pytest.approx(0.0, abs=1e-3)


def test_force_sensors_find_their_foot_by_site_or_by_name() -> None:
    _, truth = plain_walk()
    feet = touching_bodies(truth.model)
    by_site = force_columns(truth.model, feet, ["LFootFrontLeft", "RFootRearRight"])
    assert by_site == [["RFootRearRight"], ["LFootFrontLeft"]]
    by_name = force_columns(truth.model, feet, ["LFootX", "RSole", "chest"])
    assert by_name == [["RSole"], ["LFootX"]]


def test_joint_tracks_follow_a_sine_within_their_deviation() -> None:
    rng = np.random.default_rng(1)
    time = np.arange(0, 8, 0.02)
    truth = 0.3 * np.sin(4 * time)
    tracks = smooth_joints(time, (truth + rng.normal(scale=1e-3, size=len(time)))[:, None])
    velocity = 1.2 * np.cos(4 * time)
    z = (tracks.velocity[INNER, 0] - velocity[INNER]) / tracks.velocity_std[INNER, 0]
    assert 0.5 < rms(z) < 1.5
    assert rms(tracks.position[INNER, 0] - truth[INNER]) < 7e-4


@pytest.mark.parametrize("name", ["walk_a", "walk_b"])
def test_recorded_walks_stay_up(name: str, shared_data: Path) -> None:
    state = recorded(shared_data, name)
    assert all(e.kind != "fall" for e in state.events)
    assert state.usable.mean() > 0.95
    assert 0.29 < state.position[:, 2].min() < state.position[:, 2].max() < 0.37


def test_the_recorded_fall_is_found_in_time(shared_data: Path) -> None:
    state = recorded(shared_data, "walk_fall")
    (fall,) = [e for e in state.events if e.kind == "fall"]
    # the inclinometer passes 0.6 rad at 9.03 s and a right angle at 9.27 s
    assert fall.start == pytest.approx(9.12, abs=0.2)
    assert state.usable[state.time < 8.7].all()
    assert not state.usable[state.time > fall.start].any()


def recorded(folder: Path, name: str) -> BaseState:
    log = read_log(folder / "nao_walk" / f"{name}.parquet")
    robot = load_robot(str(folder / "nao_walk" / "nominal_free.xml"))
    model = compile_model(robot, log, (), Numerics("RK4", 0.005))
    index = make_index(model)
    return estimate_base(model, log, index.joints, index.qpos)


# --- robots of other sizes ------------------------------------------------------------------------------


def test_the_size_of_a_robot_is_that_of_its_longest_leg() -> None:
    def size(robot: Robot) -> BodySize:
        return measure_size(robot.compile())

    assert astuple(size(load_robot("nao:table1"))) == pytest.approx(astuple(NAO), rel=1e-12)
    # coxa, femur and tibia of the outer legs, and the ball at their end
    assert size(load_robot("ant")).leg == pytest.approx(0.13 + 0.1 + 0.14 + 0.012)
    own, large = size(load_robot("nao")), size(Scale(3.0).robot)
    assert large.leg == pytest.approx(3 * own.leg)
    assert large.weight == pytest.approx(27 * own.weight)
    assert large.time(0.2) == pytest.approx(np.sqrt(3) * own.time(0.2))
    assert large.speed(0.2) == pytest.approx(np.sqrt(3) * own.speed(0.2))


def test_under_less_gravity_a_robot_moves_more_slowly() -> None:
    moon = replace(NAO, gravity=NAO.gravity / 6)
    assert moon.time(1.0) == pytest.approx(np.sqrt(6))
    assert moon.length(1.0) == NAO.length(1.0)
    assert moon.speed(1.0) == pytest.approx(1 / np.sqrt(6))


def test_what_has_no_weight_does_not_walk() -> None:
    spec = load_robot("nao").make_spec()
    spec.option.gravity = [0.0, 0.0, 0.0]
    with pytest.raises(ModelError, match="no weight"):
        measure_size(spec.compile())


@pytest.mark.parametrize("length", [1.0, 3.0, 1 / 3])
def test_what_counts_as_a_flight_a_slip_and_a_stance_grows_with_the_robot(length: float) -> None:
    pace, size = Scale(length).time, replace(NAO, leg=length * NAO.leg)
    time = pace * np.arange(0, 3, 0.01)
    load = np.full(len(time), 40.0)
    load[50:64] = 0.0  # 0.13 s
    load[100:118] = 0.0
    assert [e.start for e in find_pickups(time, load, size)] == pytest.approx([pace * 1.0])
    speed = np.full((len(time), 1), 0.11 * pace)
    speed[50:54] = 0.13 * pace  # for 0.03 s
    speed[100:108] = 0.13 * pace
    slips = find_slips(time, speed, np.full((len(time), 1), 1e-3), np.ones((len(time), 1), dtype=bool), size)
    assert [e.start for e in slips] == pytest.approx([pace * 1.0])
    bottom = length * np.array([[-0.3, -0.287], [-0.3, -0.283]])  # 13 and 17 mm above the other
    assert find_contacts(bottom, np.full((2, 2), 20.0), size).tolist() == [[True, True], [True, False]]


WALKS = {
    "walk": plain_walk,
    "fall": pushed_over,
    "pick-up": lifted,
    "no force sensors": lambda: (without(plain_walk()[0], "force."), plain_walk()[1]),
    "no inclinometers": lambda: (without(plain_walk()[0], "imu.angle"), plain_walk()[1]),
    "no accelerometer": lambda: (without(plain_walk()[0], "imu.acc"), plain_walk()[1]),
}


@cache
def estimated(walk: str) -> BaseState:
    return estimate(*WALKS[walk]())


@pytest.mark.slow
@pytest.mark.parametrize("length", [3.0, 1 / 3])
@pytest.mark.parametrize("walk", WALKS)
def test_the_base_of_a_robot_of_another_size_is_found_as_well(walk: str, length: float) -> None:
    (log, truth), own, scale = WALKS[walk](), estimated(walk), Scale(length)
    with scale.sensors():
        other = estimate(scale.log(log), replace(truth, model=scale.robot.compile()))
    units = {"position": length, "velocity": length / scale.time, "rate": 1 / scale.time}
    units |= {"joint_velocity": 1 / scale.time, "rotation": 1.0, "joint_position": 1.0}
    for name in (*units, *(f"{name}_std" for name in units)):
        expected = units[name.removesuffix("_std")] * getattr(own, name)
        assert np.abs(getattr(other, name) - expected).max() < 1e-7 * np.abs(expected).max(), name
    assert np.array_equal(other.contact, own.contact)
    assert np.array_equal(other.usable, own.usable)
    assert [e.kind for e in other.events] == [e.kind for e in own.events]
    assert [e.start for e in other.events] == pytest.approx([scale.time * e.start for e in own.events])
