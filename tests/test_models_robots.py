"""The built-in robots: geometry and data of the Nao, the declared laws of emps and xl330."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from toys import make_log, position, run, with_spec

from sysid_btr.errors import LogError, ModelError
from sysid_btr.identify.numerics import PAPER_TIMING, choose_numerics
from sysid_btr.io.log import Log
from sysid_btr.io.parquet import read_log
from sysid_btr.models.ant import ant
from sysid_btr.models.builtin import load_robot
from sysid_btr.models.emps import emps
from sysid_btr.models.nao import FEET, STARRED, nao, nao_table1
from sysid_btr.models.robot import Robot, alike_joints, joint_names, joint_ranges, servo_joints
from sysid_btr.models.xl330 import TORQUE_PER_VOLT, xl330
from sysid_btr.simulation.numerics import Numerics
from sysid_btr.simulation.replay import Replay
from sysid_btr.terms.grammar import parse_parameters

TABLE1 = """
Torso          1.22  0.00  0.07 -0.02 0     1      0  0.10 0.18 0.10
HeadYaw        0.05  0.00  0.16 -0.02 0     1      0  0.01 0.08 0.00
HeadPitch      0.35  0.00  0.22  0.00 1     0      0  0.07 0.00 0.00
RShoulderPitch 0.05 -0.09  0.14 -0.02 1     0      0  0.01 0.00 0.00
RShoulderRoll  0.11 -0.10  0.14  0.00 0     1      0  0.07 0.06 0.08
RElbowYaw      0.03 -0.10  0.15  0.07 0     0      1  0.01 0.00 0.00
RElbowRoll     0.06 -0.10  0.15  0.12 0     1      0  0.05 0.05 0.11
LShoulderPitch 0.05  0.09  0.14 -0.02 1     0      0  0.01 0.00 0.00
LShoulderRoll  0.11  0.10  0.14  0.00 0     1      0  0.07 0.06 0.08
LElbowYaw      0.03  0.10  0.15  0.07 0     0      1  0.01 0.00 0.00
LElbowRoll     0.06  0.10  0.15  0.12 0     1      0  0.05 0.05 0.11
RHipYawPitch   0.10 -0.06 -0.04 -0.03 0.707 0.707  0  0.01 0.00 0.00
RHipRoll       0.14 -0.06 -0.04 -0.03 0     0      1  0.01 0.00 0.00
RHipPitch      0.29 -0.06 -0.09 -0.02 1     0      0  0.07 0.14 0.07
RKneePitch     0.42 -0.06 -0.13 -0.01 1     0      0  0.08 0.11 0.07
RAnklePitch    0.06 -0.06 -0.23 -0.01 1     0      0  0.01 0.00 0.00
RAnkleRoll     0.10 -0.06 -0.27  0.02 0     0      1  0.08 0.02 0.16
LHipYawPitch   0.10  0.06 -0.04 -0.03 0.707 -0.707 0  0.01 0.00 0.00
LHipRoll       0.14  0.06 -0.04 -0.03 0     0      1  0.01 0.00 0.00
LHipPitch      0.29  0.06 -0.09 -0.02 1     0      0  0.07 0.14 0.07
LKneePitch     0.42  0.06 -0.13 -0.01 1     0      0  0.08 0.11 0.07
LAnklePitch    0.06  0.06 -0.23 -0.01 1     0      0  0.01 0.00 0.00
LAnkleRoll     0.10  0.06 -0.27  0.02 0     1      0  0.08 0.02 0.16
"""
"""Mass, centre of the geometry, joint axis and size, in the paper's frame."""
PAPER_TO_WORLD = [2, 0, 1]
"""x left, y up, z forward as x forward, y left, z up."""


SAME_FIELDS = (
    *("body_mass", "body_inertia", "body_ipos", "dof_damping", "dof_armature", "jnt_limited"),
    *("geom_size", "geom_pos", "geom_friction", "geom_contype", "geom_conaffinity"),
    *("actuator_gainprm", "actuator_biasprm"),
)
LOWER_LEG = {"KneePitch": -0.210, "AnklePitch": -0.265, "AnkleRoll": -0.305}
"""Heights of geometries in the corrected model; the table left out the thigh."""


def placed(robot_name: str) -> tuple[Any, Any, Any]:
    """Model and data at zero pose, and the height of the paper's origin."""
    import mujoco

    model = load_robot(robot_name).compile()
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    torso = model.body("Torso").id
    geom = int(model.body_geomadr[torso])
    origin = data.geom_xpos[geom] - np.array([-0.02, 0.0, 0.07])
    return model, data, origin


def test_table1_is_the_table_as_printed() -> None:
    model, data, origin = placed("nao:table1")
    rows = [line.split() for line in TABLE1.strip().splitlines()]
    assert len(rows) == 23 == model.nbody - 1
    for name, *cells in rows:
        numbers = np.array(cells, dtype=float)
        body = model.body(name).id
        geom = int(model.body_geomadr[body])
        assert model.body_mass[body] == pytest.approx(numbers[0])
        centre = (data.geom_xpos[geom] - origin)[np.argsort(PAPER_TO_WORLD)]
        np.testing.assert_allclose(centre, numbers[1:4], atol=1e-9, err_msg=name)
        if name != "Torso":
            axis = data.xaxis[model.joint(name).id][np.argsort(PAPER_TO_WORLD)]
            np.testing.assert_allclose(axis, numbers[4:7], atol=2e-4, err_msg=name)
        kind, size = int(model.geom_type[geom]), model.geom_size[geom]
        printed = numbers[7:]
        if kind == 6:
            np.testing.assert_allclose(2 * size[np.argsort(PAPER_TO_WORLD)], printed, atol=1e-9)
        else:
            np.testing.assert_allclose([size[0], 2 * size[1] if kind == 5 else 0, 0], printed, atol=1e-9)
    assert model.body_mass.sum() == pytest.approx(4.34)


def test_the_corrected_nao_rounds_to_the_table_where_that_is_right() -> None:
    """Everything above the knee agrees to the table's two decimals; below it the thigh was left out."""
    model, data, origin = placed("nao")
    for line in TABLE1.strip().splitlines():
        name, *cells = line.split()
        numbers = np.array(cells, dtype=float)
        body = model.body(name).id
        geom = int(model.body_geomadr[body])
        assert model.body_mass[body] == pytest.approx(numbers[0], abs=0.0051)
        centre = (data.geom_xpos[geom] - origin)[np.argsort(PAPER_TO_WORLD)]
        if name[1:] in LOWER_LEG:
            assert centre[1] == pytest.approx(LOWER_LEG[name[1:]])
            continue
        expected = numbers[1:4].copy()
        if name == "HeadPitch":
            expected[2] = -0.02
        np.testing.assert_allclose(centre, expected, atol=0.0101, err_msg=name)
    np.testing.assert_allclose(data.xaxis[model.joint("LAnkleRoll").id], [1, 0, 0])


@pytest.mark.parametrize("make", [nao, nao_table1])
def test_both_naos_are_one_robot(make: Callable[[], Robot]) -> None:
    robot = make()
    model = robot.compile()
    assert len(joint_names(robot)) == len(servo_joints(robot)) == model.nu == 22
    assert model.nq == 29
    assert robot.tied == (("LHipYawPitch", "RHipYawPitch"),)
    assert len(STARRED) == 8
    assert model.sensor("position_LKneePitch").id >= 0
    assert model.sensor("gyro").id >= 0
    assert model.sensor("acc").id >= 0
    left = {n[1:]: r for n, r in joint_ranges(robot).items() if n[0] == "L"}
    right = {n[1:]: r for n, r in joint_ranges(robot).items() if n[0] == "R"}
    for name, (low, high) in left.items():
        mirrored = (-high, -low) if "Roll" in name or name == "ElbowYaw" else (low, high)
        assert right[name] == pytest.approx(mirrored)


@pytest.mark.parametrize("make", [nao, nao_table1])
def test_a_nao_is_its_own_mirror_image(make: Callable[[], Robot]) -> None:
    model = make().compile()
    for i in range(model.nbody):
        name = model.body(i).name
        if name.startswith("L"):
            other = model.body("R" + name[1:]).id
            assert model.body_mass[i] == model.body_mass[other]
            np.testing.assert_allclose(model.body_pos[i], model.body_pos[other] * [1, -1, 1], atol=1e-12)
            np.testing.assert_allclose(model.body_ipos[i], model.body_ipos[other] * [1, -1, 1], atol=1e-12)


def test_table1_is_the_model_that_the_recordings_were_made_with(shared_data: Path) -> None:
    """Except for the axis that the paper misprints, and for the shared motor."""
    import mujoco

    recorded = mujoco.MjModel.from_xml_path(str(shared_data / "nao_walk" / "nominal_free.xml"))
    ours = nao_table1().compile()
    for name in SAME_FIELDS:
        np.testing.assert_allclose(getattr(ours, name), getattr(recorded, name), atol=1e-12, err_msg=name)
    np.testing.assert_allclose(ours.body_pos[2:], recorded.body_pos[2:], atol=1e-12)
    wrong = ours.joint("LAnkleRoll").id
    axes = np.abs(ours.jnt_axis - recorded.jnt_axis).max(axis=1)
    assert np.flatnonzero(axes > 1e-6).tolist() == [wrong]


@pytest.mark.parametrize("make", [nao, nao_table1])
def test_a_standing_nao_weighs_on_its_feet_what_it_weighs(make: Callable[[], Robot]) -> None:
    import mujoco

    model = make().compile()
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, 600)
    force = sum(
        data.sensor(f"force_{side}Foot{corner}").data[0]
        for side in "RL"
        for corner in ("FrontLeft", "FrontRight", "RearLeft", "RearRight")
    )
    assert force == pytest.approx(9.81 * model.body_mass.sum(), rel=2e-3)
    assert abs(data.sensor("acc").data[2]) == pytest.approx(9.81, rel=2e-2)
    assert all(model.geom_contype[int(model.body_geomadr[model.body(f).id])] for f in FEET)


def nao_log(seconds: float = 2.0) -> Log:
    """Different commands everywhere; the two hip joints on one motor get the same."""
    joints = servo_joints(nao())
    time = np.arange(round(seconds / 0.01) + 1) * 0.01
    fade = 1 - np.exp(-time / 0.3)
    channels = {f"command.{j}": 0.2 * fade * np.sin(5 * time + i) for i, j in enumerate(joints)}
    channels["command.LHipYawPitch"] = channels["command.RHipYawPitch"]
    return make_log(time, channels, mount="fixed")


def test_joints_on_one_motor_move_as_one() -> None:
    log = nao_log()
    index = Replay(nao(), log, (), Numerics("RK4", 0.005)).index.joints
    tied = [index.index(n) for n in ("LHipYawPitch", "RHipYawPitch")]
    loose = with_spec(nao(), lambda s: s.delete(s.equalities[0]))
    for step in (0.005, 0.00125):
        numerics = Numerics("RK4", step)
        apart = np.ptp(position(nao(), log, numerics=numerics)[:, tied], axis=1).max()
        assert apart < 1e-4, "far below an encoder step of 1.5 mrad"
        assert np.ptp(position(loose, log, numerics=numerics)[:, tied], axis=1).max() > 1e-3
    coarse = position(nao(), log, numerics=Numerics("RK4", 0.005))
    fine = position(nao(), log, numerics=Numerics("RK4", 0.0025))
    assert np.abs(coarse - fine).max() < 1e-5


def test_the_papers_timing_is_seven_steps_between_references() -> None:
    assert 7 * PAPER_TIMING.timestep == pytest.approx(0.055)
    time = np.arange(40) * 0.055
    channels = {f"command.{j}": 0.2 * np.sin(3 * time + i) for i, j in enumerate(servo_joints(nao()))}
    replay = Replay(nao(), make_log(time, channels), (), PAPER_TIMING)
    assert replay.grid.steps == 7 * 39
    assert np.isfinite(replay.predict(np.zeros((1, 0))).position).all()


def test_unknown_models_are_told_what_there_is() -> None:
    with pytest.raises(ModelError, match="emps, nao, nao:table1, xl330"):
        load_robot("nap")


PUBLISHED = (203.5034, 20.3935, 3.1648)
"""Viscous, Coulomb and constant force of emps; the constant is published as a friction, so against motion."""


def emps_scores(log: Log, values: tuple[float, ...], numerics: Numerics) -> tuple[float, float, float]:
    """Position rmse in um; relative force error in %, of the whole log and after the first 0.3 s."""
    robot = emps()
    terms = parse_parameters(["damping:slider", "frictionloss:slider", "constant_force:slider"], robot)
    outputs = run(robot, log, terms, values, numerics, effort=True)
    q, force = log.channels["position.slider"], log.channels["effort.slider"]
    assert outputs.effort is not None
    wrong = outputs.effort[0, :, 0] - force
    rmse = 1e6 * float(np.sqrt(np.mean((outputs.position[0, :, 0] - q) ** 2)))
    after = log.time - log.time[0] >= 0.3
    return (
        rmse,
        100 * float(np.linalg.norm(wrong) / np.linalg.norm(force)),
        100 * float(np.linalg.norm(wrong[after]) / np.linalg.norm(force[after])),
    )


def test_emps_replays_as_published(shared_data: Path) -> None:
    log = read_log(shared_data / "emps" / "emps.parquet")
    numerics, _ = choose_numerics(emps(), log)
    assert numerics == Numerics("Euler", 0.001), "the servo is digital, so its period is the step"
    full = emps_scores(log, PUBLISHED, numerics)
    alone = emps_scores(log, (0.0, 0.0, 0.0), numerics)
    assert full[0] == pytest.approx(2.15, abs=0.02)
    assert full[2] == pytest.approx(4.96, abs=0.02)
    assert full[1] < 5.05
    assert alone[0] == pytest.approx(27.5, abs=0.2)
    assert alone[1] == pytest.approx(69.7, abs=0.5)
    faster = emps_scores(log, PUBLISHED, Numerics("Euler", 0.0005))
    assert faster[0] == pytest.approx(22.3, abs=0.5)
    assert faster[1] == pytest.approx(57.5, abs=1.0)


def test_the_drive_of_emps_saturates_at_ten_volts() -> None:
    time = np.arange(200) * 0.001
    log = make_log(time, {"command.slider": np.full(200, 0.1)}, servo_period=0.001)
    outputs = run(emps(), log, (), None, Numerics("Euler", 0.001), effort=True)
    assert outputs.effort is not None
    assert np.abs(outputs.effort).max() == pytest.approx(351.507)
    q = outputs.position[0, :50, 0]
    np.testing.assert_allclose(q, 0.5 * 351.507 / 95.1089 * time[:50] ** 2, atol=1e-4)


def pendulum_log(seconds: float = 1.0, **channels: Any) -> Log:
    time = np.arange(round(seconds / 0.005) + 1) * 0.005
    columns = {"command.pendulum": np.zeros(len(time))} | {k.replace("_", "."): v for k, v in channels.items()}
    filled = {k: np.broadcast_to(np.asarray(v, dtype=float), time.shape).copy() for k, v in columns.items()}
    return make_log(time, filled, extra={"servo": {"kp_register": 400}})


def test_the_firmware_law_is_what_the_servo_logged(shared_data: Path) -> None:
    for path in sorted((shared_data / "xl330").glob("*.parquet")):
        log = read_log(path)
        robot = xl330().for_log(log)
        model = robot.compile()
        per_volt = float(model.actuator_gainprm[0, 0]) / 7.4 / TORQUE_PER_VOLT
        error = log.channels["command.pendulum"] - log.channels["position.pendulum"]
        duty = np.clip(per_volt * error, -1, 1) * log.channels["enabled.pendulum"]
        assert np.sqrt(np.mean((duty - log.channels["duty.pendulum"]) ** 2)) < 0.006, path.name
        assert np.polyfit(duty, log.channels["duty.pendulum"], 1)[0] == pytest.approx(1.0, abs=0.01)


def test_xl330_replays_every_log_with_a_converged_step(shared_data: Path) -> None:
    path = shared_data / "xl330" / "kp100_sin_sin.parquet"
    log = read_log(path)
    robot = xl330().for_log(log)
    numerics, change = choose_numerics(robot, log)
    assert change < 0.02
    assert numerics.timestep > 0.001, "measured supply and flags must not force small steps"
    terms = parse_parameters(["armature:*", "damping:*", "frictionloss:*"], robot)
    outputs = run(robot, log, terms, [[0, 0, 0], [0.0043, 0.06, 0.04]], numerics)
    rmse = np.sqrt(np.mean((outputs.position[:, :, 0] - log.channels["position.pendulum"]) ** 2, axis=1))
    assert rmse[0] == pytest.approx(0.1345, abs=0.002)
    assert rmse[1] < 0.05


def test_supply_voltage_scales_the_torque_and_torque_off_ends_it() -> None:
    robot = xl330()
    pull = np.linspace(0, 0.2, 201)
    hang = pendulum_log(position_pendulum=np.full(201, 1.0), enabled_pendulum=0.0, command_pendulum=pull)
    free = run(robot.for_log(hang), hang, (), None, Numerics("RK4", 0.001), effort=True)
    np.testing.assert_allclose(free.effort, 0, atol=1e-15)
    q, v = free.position[0, :, 0], free.velocity[0, :, 0]
    energy = 0.5 * 0.1 * v**2 - 9.81 * np.cos(q)
    assert np.ptp(energy) < 1e-5, "a free pendulum keeps its energy"

    log = pendulum_log(6.0, command_pendulum=0.5, voltage_pendulum=6.0, position_pendulum=np.full(1201, 0.3))
    damped = parse_parameters(["damping:*"], robot)
    rest = run(robot.for_log(log), log, damped, [0.3], Numerics("RK4", 0.0025), effort=True)
    q = rest.position[0, -1, 0]
    duty = 400 * 4096 / (2 * np.pi) / 256 / 885 * (0.5 - q)
    assert 0.49 * 9.81 * 0.1 * np.sin(q) == pytest.approx(0.104 * 6.0 * duty, rel=1e-6)


def test_the_duty_saturates_at_the_supply() -> None:
    robot = xl330()
    log = pendulum_log(0.2, command_pendulum=1.5, voltage_pendulum=5.0)
    outputs = run(robot.for_log(log), log, (), None, Numerics("RK4", 0.001), effort=True)
    assert outputs.effort is not None
    assert outputs.effort[0, 0, 0] == pytest.approx(0.52)


@pytest.mark.parametrize(
    "extra", [{"servo": {"kp_register": "high"}}, {"pendulum": {"mass": -1.0}}, {"servo": 400}, {"supply_nominal": 0}]
)
def test_metadata_that_cannot_be_used_is_told(extra: dict[str, object]) -> None:
    log = make_log(np.arange(10) * 0.01, {"command.pendulum": np.zeros(10)}, extra=extra)
    with pytest.raises(LogError, match="metadata"):
        xl330().for_log(log)


def test_limbs_of_one_kind_have_joints_in_common() -> None:
    legs = [f"{side}{part}" for side in "LR" for part in "FMR"]
    assert alike_joints(ant()) == tuple(tuple(leg + part for leg in legs) for part in ("Coxa", "Femur", "Tibia"))
    assert alike_joints(nao()) == (), "two legs are not many"
