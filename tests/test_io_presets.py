"""Presets and the units of servos: a table as a driver writes it comes in as what really happened."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st
from terminal import Cli

import sysid_btr as sb
from sysid_btr._typing import FloatArray
from sysid_btr.errors import UsageError
from sysid_btr.io.importers import import_log
from sysid_btr.io.importers.base import MappingNeeded
from sysid_btr.io.importers.encoding import decode
from sysid_btr.io.importers.mapping import ImportMap, read_map
from sysid_btr.io.importers.presets import available_presets, preset_text, preset_title
from sysid_btr.io.importers.units import resolve, unwrapped
from sysid_btr.io.log import Log

TIME = np.arange(0.0, 8.0, 0.01)
Columns = dict[str, Any]


def swing(number: int) -> FloatArray:
    """Positions of a joint, rad; another course for each."""
    return 0.6 * np.sin((1.1 + 0.13 * number) * TIME + number) + 0.2 * np.sin(3.7 * TIME)


def rate(number: int) -> FloatArray:
    return np.gradient(swing(number), TIME)


def ticks(angle: FloatArray) -> FloatArray:
    return np.round(angle * 4096 / (2 * math.pi)) + 2048


def two_complement(values: FloatArray, bits: int) -> FloatArray:
    return np.round(values) % 2.0**bits


def sign_magnitude(values: FloatArray, bit: int) -> FloatArray:
    whole = np.round(values)
    return np.where(whole < 0, -whole + 2.0**bit, whole)


def bring(tmp_path: Path, columns: Mapping[str, Any], preset: str | None, own: str = "") -> Log:
    """A table in CSV, imported; what is said on top of the preset is a mapping file."""
    (tmp_path / "own.toml").write_text(own)
    pd.DataFrame(columns).to_csv(tmp_path / "log.csv", index=False)
    return import_log([tmp_path / "log.csv"], told=read_map(tmp_path / "own.toml", preset)).log


# --- formats ----------------------------------------------------------------------------------------------------


def dynamixel(name: Callable[[str, str], str], unsigned: bool) -> Columns:
    """Registers of two servos; read without their signs, or with them."""

    def held(values: FloatArray, bits: int) -> FloatArray:
        return two_complement(values, bits) if unsigned else np.round(values)

    table: Columns = {"timestamp": TIME}
    for i, joint in enumerate(("1", "2")):
        table[name("goal_position", joint)] = ticks(swing(i) + 0.1)
        table[name("present_position", joint)] = ticks(swing(i))
        table[name("present_velocity", joint)] = held(rate(i) / (0.229 * 2 * math.pi / 60), 32)
        table[name("present_current", joint)] = held(np.sin(TIME) / 2.69e-3, 16)
        table[name("present_pwm", joint)] = held(885 * np.sin(TIME), 16)
        table[name("present_input_voltage", joint)] = 120
        table[name("present_temperature", joint)] = 41
        table[name("torque_enable", joint)] = 1
    return table


NAMES: Mapping[str, Callable[[str, str], str]] = {
    "register_1": lambda register, joint: f"{register}_{joint}",
    "1/register": lambda register, joint: f"{joint}/{register}",
    "Register.1": lambda register, joint: f"{_capitals(register)}.{joint}",
}


def _capitals(register: str) -> str:
    return "_".join("PWM" if word == "pwm" else word.capitalize() for word in register.split("_"))


@pytest.mark.parametrize("unsigned", [False, True], ids=["signed", "unsigned"])
@pytest.mark.parametrize("name", NAMES.values(), ids=NAMES)
def test_dynamixel_registers(tmp_path: Path, name: Callable[[str, str], str], unsigned: bool) -> None:
    log = bring(tmp_path, dynamixel(name, unsigned), "dynamixel-x", '[joints]\n1 = "hip"\n2 = "knee"')
    assert not log.unknown
    for i, joint in enumerate(("hip", "knee")):
        np.testing.assert_allclose(log.channels[f"position.{joint}"], swing(i), atol=math.pi / 4096)
        np.testing.assert_allclose(log.channels[f"command.{joint}"], swing(i) + 0.1, atol=math.pi / 4096)
        np.testing.assert_allclose(log.channels[f"velocity.{joint}"], rate(i), atol=0.0121)
        np.testing.assert_allclose(log.channels[f"current.{joint}"], np.sin(TIME), atol=1.36e-3)
        np.testing.assert_allclose(log.channels[f"duty.{joint}"], np.sin(TIME), atol=1.2e-3)
        np.testing.assert_allclose(log.channels[f"voltage.{joint}"], 12.0)
        np.testing.assert_allclose(log.channels[f"temperature.{joint}"], 41.0)
        assert np.all(log.channels[f"enabled.{joint}"] == 1)


def test_an_xl330_measures_in_whole_milliamperes(tmp_path: Path) -> None:
    table = dynamixel(NAMES["register_1"], True)
    log = bring(tmp_path, table, "dynamixel-x", '[units]\ncurrent = "1 mA"')
    np.testing.assert_allclose(log.channels["current.1"], np.sin(TIME) / 2.69, atol=6e-4)


@pytest.mark.parametrize("unsigned", [False, True], ids=["signed", "unsigned"])
def test_feetech_registers(tmp_path: Path, unsigned: bool) -> None:
    def held(values: FloatArray, bit: int) -> FloatArray:
        return sign_magnitude(values, bit) if unsigned else np.round(values)

    table: Columns = {"time": TIME}
    for i, joint in enumerate(("shoulder_pan", "gripper")):
        table[f"Goal_Position_{joint}"] = ticks(swing(i))
        table[f"Present_Position_{joint}"] = ticks(swing(i))
        table[f"Present_Velocity_{joint}"] = held(rate(i) * 4096 / (2 * math.pi), 15)
        table[f"Present_Load_{joint}"] = held(1000 * np.sin(TIME), 10)
        table[f"Present_Current_{joint}"] = held(np.sin(TIME) / 6.5e-3, 15)
        table[f"Present_Voltage_{joint}"] = 74
        table[f"Present_Temperature_{joint}"] = 33
    log = bring(tmp_path, table, "feetech-sts")
    assert not log.unknown
    for i, joint in enumerate(("shoulder_pan", "gripper")):
        np.testing.assert_allclose(log.channels[f"position.{joint}"], swing(i), atol=math.pi / 4096)
        np.testing.assert_allclose(log.channels[f"velocity.{joint}"], rate(i), atol=math.pi / 4096)
        np.testing.assert_allclose(log.channels[f"duty.{joint}"], np.sin(TIME), atol=5.1e-4)
        np.testing.assert_allclose(log.channels[f"current.{joint}"], np.sin(TIME), atol=3.3e-3)
        np.testing.assert_allclose(log.channels[f"voltage.{joint}"], 7.4)
    assert set(log.joints("position")) == {"shoulder_pan", "gripper"}


LEGS = [f"{leg}_{part}_joint" for leg in ("FR", "FL", "RR", "RL") for part in ("hip", "thigh", "calf")]
STYLES: Mapping[str, tuple[str, str, str, str]] = {
    "ROS 2": ("motor_state[{}].{}", "motor_cmd[{}].{}", "imu_state.{}[{}]", "tau_est"),
    "with topics": (
        "/lowstate/motor_state[{}]/{}",
        "/lowcmd/motor_cmd[{}]/{}",
        "/lowstate/imu_state/{}[{}]",
        "tau_est",
    ),
    "dots": ("motor_state.{}.{}", "motor_cmd.{}.{}", "imu_state.{}.{}", "tau_est"),
    "underscores": ("motor_state_{}_{}", "motor_cmd_{}_{}", "imu_state_{}_{}", "tau_est"),
    "legged SDK": ("motorState[{}].{}", "motorCmd[{}].{}", "imu.{}[{}]", "tauEst"),
}


def unitree(style: tuple[str, str, str, str]) -> Columns:
    """LowState and LowCmd of a quadruped: 20 motors in the messages, 12 on the robot."""
    state, command, imu, effort = style
    table: Columns = {"time": TIME}
    for i in range(20):
        there = i < 12
        values: Columns = {
            state.format(i, "q"): swing(i) if there else 0.0,
            state.format(i, "dq"): rate(i) if there else 0.0,
            state.format(i, effort): np.cos(TIME + i) if there else 0.0,
            state.format(i, "temperature"): 35,
            state.format(i, "mode"): 1,
            command.format(i, "q"): np.where(TIME < 0.5, 2.146e9, swing(i) + 0.05) if there else 0.0,
            command.format(i, "dq"): np.where(TIME < 0.5, 16000.0, rate(i)) if there else 0.0,
            command.format(i, "tau"): 0.1 * i if there else 0.0,
            command.format(i, "kp"): 60.0,
            command.format(i, "kd"): 5.0,
        }
        table |= values
    for axis in range(3):
        table[imu.format("gyroscope", axis)] = 0.1 * axis + 0.01 * np.sin(TIME)
        table[imu.format("accelerometer", axis)] = 9.81 * (axis == 2)
        table[imu.format("rpy", axis)] = 0.01 * axis + 0.001 * np.sin(TIME)
    return table


@pytest.mark.parametrize("style", STYLES.values(), ids=STYLES)
def test_a_unitree_quadruped(tmp_path: Path, style: tuple[str, str, str, str]) -> None:
    log = bring(tmp_path, unitree(style), "unitree-lowstate")
    assert set(log.joints("position")) == set(log.joints("command")) == set(LEGS)
    sent = TIME >= 0.5
    for i, joint in enumerate(LEGS):
        np.testing.assert_allclose(log.channels[f"position.{joint}"], swing(i), atol=1e-9)
        np.testing.assert_allclose(log.channels[f"velocity.{joint}"], rate(i), atol=1e-9)
        np.testing.assert_allclose(log.channels[f"effort.{joint}"], np.cos(TIME + i), atol=1e-9)
        np.testing.assert_allclose(log.channels[f"command.{joint}"][sent], swing(i)[sent] + 0.05, atol=1e-9)
        np.testing.assert_allclose(log.channels[f"command_velocity.{joint}"][sent], rate(i)[sent], atol=1e-9)
        np.testing.assert_allclose(log.channels[f"command_effort.{joint}"], 0.1 * i)
        for channel in ("command", "command_velocity"):
            assert np.all(np.isnan(log.channels[f"{channel}.{joint}"][~sent])), "no command was sent"
    np.testing.assert_allclose(log.channels["imu.gyro_y"], 0.1 + 0.01 * np.sin(TIME), atol=1e-9)
    np.testing.assert_allclose(log.channels["imu.acc_z"], 9.81)
    np.testing.assert_allclose(log.channels["imu.angle_x"], 0.001 * np.sin(TIME), atol=1e-9)
    assert {"kp", "kd"} <= {name[-2:] for name in log.unknown}, "gains are kept"
    assert not [name for name in log.unknown if "12" in name or "19" in name], "motors that are not there are not"


@pytest.mark.parametrize("style", STYLES.values(), ids=STYLES)
def test_a_command_of_a_unitree_is_never_taken_for_a_measurement(
    tmp_path: Path, style: tuple[str, str, str, str]
) -> None:
    """Without the preset either: it is a command, or it is not understood."""
    from sysid_btr.io.importers.guess import guess

    found = guess(list(unitree(style))).columns
    sent = {column for name, column in found.items() if "cmd" in name.casefold()}
    assert all(column.startswith("command.") for column in sent)


DEFINITIONS = {
    "unitree_go/msg/MotorState": "uint8 mode\nfloat32 q\nfloat32 dq\nfloat32 ddq\nfloat32 tau_est\n",
    "unitree_go/msg/MotorCmd": "uint8 mode\nfloat32 q\nfloat32 dq\nfloat32 tau\nfloat32 kp\nfloat32 kd\n",
    "unitree_go/msg/IMUState": "float32[4] quaternion\nfloat32[3] gyroscope\n"
    "float32[3] accelerometer\nfloat32[3] rpy\n",
    "unitree_go/msg/LowState": "IMUState imu_state\nMotorState[20] motor_state\nuint32 tick\n",
    "unitree_go/msg/LowCmd": "MotorCmd[20] motor_cmd\nuint32 crc\n",
}
"""The fields of unitree_go's messages that matter."""


@pytest.mark.parametrize("storage", ["SQLITE3", "MCAP"])
def test_a_bag_of_a_unitree_quadruped(tmp_path: Path, storage: str) -> None:
    pytest.importorskip("rosbags", reason="bags need the extra ros")
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS2_JAZZY)
    for kind, definition in DEFINITIONS.items():
        store.register(get_types_from_msg(definition, kind))
    types = {kind.rpartition("/")[2]: store.types[kind] for kind in DEFINITIONS}
    plugin = StoragePlugin[storage]
    with Writer(tmp_path / "bag", version=9, storage_plugin=plugin) as writer:
        topics = {
            kind: writer.add_connection(topic, f"unitree_go/msg/{kind}", typestore=store)
            for topic, kind in (("/lowcmd", "LowCmd"), ("/lowstate", "LowState"))
        }
        three = np.zeros(3, dtype=np.float32)
        for i, t in enumerate(TIME[:200]):
            there = [(swing(k)[i], rate(k)[i]) if k < 12 else (0.0, 0.0) for k in range(20)]
            commands = [
                types["MotorCmd"](mode=1, q=2.146e9 if i < 5 else q + 0.05, dq=dq, tau=0.1, kp=60.0, kd=5.0)
                for q, dq in there
            ]
            states = [types["MotorState"](mode=1, q=q, dq=dq, ddq=0.0, tau_est=1.5) for q, dq in there]
            turning = np.array([0.1, 0.2, 0.3 + 0.01 * i], dtype=np.float32)
            imu = types["IMUState"](
                quaternion=np.zeros(4, dtype=np.float32), gyroscope=turning, accelerometer=9.81 + three, rpy=three
            )
            received = 1_700_000_000_000_000_000 + round(t * 1e9)
            for message in (types["LowCmd"](motor_cmd=commands, crc=0), types["LowState"](imu, states, tick=i)):
                kind = type(message).__name__.rpartition("__")[2]
                data = store.serialize_cdr(message, f"unitree_go/msg/{kind}")
                writer.write(topics[kind], received, data)
    log = import_log([tmp_path / "bag"], told=read_map(None, "unitree-lowstate")).log
    assert set(log.joints("position")) == set(log.joints("command")) == set(LEGS)
    for k, joint in enumerate(LEGS):
        np.testing.assert_allclose(log.channels[f"position.{joint}"], swing(k)[:200], atol=1e-6)
        np.testing.assert_allclose(log.channels[f"velocity.{joint}"], rate(k)[:200], atol=1e-6)
        np.testing.assert_allclose(log.channels[f"effort.{joint}"], 1.5)
        np.testing.assert_allclose(log.channels[f"command.{joint}"][5:], swing(k)[5:200] + 0.05, atol=1e-6)
        np.testing.assert_allclose(log.channels[f"command_velocity.{joint}"], rate(k)[:200], atol=1e-6)
        np.testing.assert_allclose(log.channels[f"command_effort.{joint}"], 0.1, atol=1e-6)
        assert np.all(np.isnan(log.channels[f"command.{joint}"][:5]))
    np.testing.assert_allclose(log.channels["imu.gyro_z"], 0.3 + 0.01 * np.arange(200), atol=1e-6)


UR = ("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3")


@pytest.mark.parametrize("torque", [False, True])
def test_ur_rtde(tmp_path: Path, torque: bool) -> None:
    table: Columns = {"timestamp": 5321.124 + TIME}
    for i in range(6):
        table[f"target_q_{i}"] = swing(i) + 0.01
        table[f"target_qd_{i}"] = rate(i) + 0.02
        table[f"target_qdd_{i}"] = 0.0
        table[f"target_current_{i}"] = 1.0
        table[f"target_moment_{i}"] = 2.0
        table[f"actual_q_{i}"] = swing(i)
        table[f"actual_qd_{i}"] = rate(i)
        table[f"actual_current_{i}"] = np.cos(TIME + i)
        table[f"joint_temperatures_{i}"] = 30.0
        table[f"actual_TCP_pose_{i}"] = 0.0
        if torque:
            table[f"actual_current_as_torque_{i}"] = 10 * np.cos(TIME + i)
    own = "[meta.torque_constant]\n" + "\n".join(f"{name}_joint = {10 + i}" for i, name in enumerate(UR))
    log = bring(tmp_path, table, "ur-rtde", own)
    assert log.joints("position") == log.joints("command") == tuple(f"{name}_joint" for name in UR)
    for i, name in enumerate(UR):
        joint = f"{name}_joint"
        np.testing.assert_allclose(log.channels[f"position.{joint}"], swing(i), atol=1e-9)
        np.testing.assert_allclose(log.channels[f"command.{joint}"], swing(i) + 0.01, atol=1e-9)
        np.testing.assert_allclose(log.channels[f"command_velocity.{joint}"], rate(i) + 0.02, atol=1e-9)
        np.testing.assert_allclose(log.channels[f"velocity.{joint}"], rate(i), atol=1e-9)
        np.testing.assert_allclose(log.channels[f"current.{joint}"], np.cos(TIME + i), atol=1e-9)
        assert (f"effort.{joint}" in log.channels) == torque
        if torque:
            np.testing.assert_allclose(log.channels[f"effort.{joint}"], 10 * np.cos(TIME + i), atol=1e-9)
    assert {"target_moment_0", "target_current_0", "actual_TCP_pose_0"} <= set(log.unknown), "no measurements"
    assert log.meta.torque_constant == {f"{name}_joint": 10 + i for i, name in enumerate(UR)}


def test_joints_that_are_not_in_the_table_are_told(tmp_path: Path) -> None:
    """No error: a preset names more joints than many a table has."""
    table = {"timestamp": TIME} | {f"{c}_q_{i}": swing(i) for i in range(3) for c in ("target", "actual")}
    pd.DataFrame(table).to_csv(tmp_path / "log.csv", index=False)
    imported = import_log([tmp_path / "log.csv"], told=read_map(None, "ur-rtde"))
    assert set(imported.log.joints("position")) == {"shoulder_pan_joint", "shoulder_lift_joint", "elbow_joint"}
    assert [text[:11] for text in imported.remarks if "no such name" in text] == [f"[joints] {i}:" for i in (3, 4, 5)]


# --- counts of a turn ---------------------------------------------------------------------------------------------


@given(
    turn=st.integers(64, 1 << 20),
    zero=st.integers(-5000, 5000),
    angles=st.lists(st.floats(-40, 40), min_size=1, max_size=30),
)
def test_counts_come_back_as_the_angle_to_half_a_count(turn: int, zero: int, angles: list[float]) -> None:
    angle = np.array(angles)
    counts = np.round(angle * turn / (2 * math.pi)) + zero
    back = resolve(f"ticks{turn}@{zero}", "position").convert(counts)
    np.testing.assert_allclose(back, angle, atol=math.pi / turn * (1 + 1e-9))
    speed = resolve(f"ticks{turn}/s", "velocity").convert(counts - zero)
    np.testing.assert_allclose(speed, angle, atol=math.pi / turn * (1 + 1e-9))


@given(
    turn=st.integers(64, 1 << 20),
    steps=st.lists(st.floats(-0.45, 0.45), min_size=1, max_size=60),
    lost=st.sets(st.integers(1, 60)),
)
def test_an_encoder_that_begins_anew_is_counted_on(turn: int, steps: list[float], lost: set[int]) -> None:
    """As long as it moves by less than half a turn from one value to the next."""
    true = np.round(turn * np.cumsum([0.3, *steps]))
    single = true % turn
    here = np.ones(len(true), dtype=bool)
    here[[i for i in lost if i < len(true) and i % 2]] = False
    moved = np.abs(np.diff(true[here]))
    counted, passed = unwrapped(np.where(here, single, np.nan), float(turn))
    assert np.array_equal(np.isfinite(counted), here)
    if np.all(moved < turn / 2):
        np.testing.assert_array_equal(counted[here] - counted[0], true[here] - true[0])
        assert passed == np.count_nonzero(np.diff(true[here] // turn))


@given(values=st.lists(st.integers(-(1 << 10), (1 << 10) - 1), min_size=1), kind=st.sampled_from(["int16", "int32"]))
def test_a_sign_that_was_not_read_comes_back(values: list[int], kind: str) -> None:
    true = np.array(values, dtype=np.float64)
    np.testing.assert_array_equal(decode(two_complement(true, int(kind[3:])), kind), true)
    np.testing.assert_array_equal(decode(true, kind), true)
    np.testing.assert_array_equal(decode(sign_magnitude(true, 15), "sign15"), true)
    np.testing.assert_array_equal(decode(true, "sign15"), true)


def test_a_turn_that_is_passed_is_counted_on_and_told(tmp_path: Path) -> None:
    """In each recording anew: nothing leads from the end of one to the beginning of the next."""
    turning = 2.5 * TIME
    table = {
        "time": np.concatenate([TIME, TIME]),
        "episode": np.repeat([0, 1], len(TIME)),
        "goal_position_1": 2048,
        "present_position_1": np.concatenate([ticks(turning) % 4096, ticks(turning) % 4096]),
    }
    pd.DataFrame(table).to_csv(tmp_path / "log.csv", index=False)
    imported = import_log([tmp_path / "log.csv"], told=read_map(None, "dynamixel-x"))
    for rows in imported.log.episodes():
        np.testing.assert_allclose(imported.log.channels["position.1"][rows], turning, atol=math.pi / 4096)
    assert np.all(imported.log.channels["command.1"] == 0)
    assert any("passed the end of its turn" in text and "position.1" in text for text in imported.remarks)


def test_an_encoder_within_its_turn_is_left_alone(tmp_path: Path) -> None:
    pd.DataFrame(dynamixel(NAMES["register_1"], True)).to_csv(tmp_path / "log.csv", index=False)
    imported = import_log([tmp_path / "log.csv"], told=read_map(None, "dynamixel-x"))
    assert not any("turn" in text for text in imported.remarks)


def test_every_joint_may_have_a_zero_and_a_sign_of_its_own(tmp_path: Path) -> None:
    own = """
    [units]
    "position.1" = "ticks4096@1000"
    "command.1" = "ticks4096@1000"
    [joints.2]
    to = "knee"
    sign = -1
    offset = 0.25
    """
    log = bring(tmp_path, dynamixel(NAMES["register_1"], True), "dynamixel-x", own)
    shift = (2048 - 1000) * 2 * math.pi / 4096
    np.testing.assert_allclose(log.channels["position.1"], swing(0) + shift, atol=math.pi / 4096)
    np.testing.assert_allclose(log.channels["command.1"], swing(0) + 0.1 + shift, atol=math.pi / 4096)
    np.testing.assert_allclose(log.channels["position.knee"], 0.25 - swing(1), atol=math.pi / 4096)
    np.testing.assert_allclose(log.channels["velocity.knee"], -rate(1), atol=0.0121)


# --- presets as files -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", available_presets())
def test_a_preset_that_is_copied_says_the_same(tmp_path: Path, name: str) -> None:
    (tmp_path / "copy.toml").write_text(preset_text(name))
    assert read_map(tmp_path / "copy.toml") == read_map(None, name)
    assert read_map(None, name) != ImportMap()
    assert 20 < len(preset_title(name)) < 100


def test_an_unknown_preset_says_what_there_is() -> None:
    with pytest.raises(UsageError, match=r"did you mean 'dynamixel-x'\? available: .*ur-rtde"):
        read_map(None, "dynamixel")


def test_a_mapping_goes_on_top_of_a_preset_and_flags_on_top_of_both(cli: Cli, tmp_path: Path) -> None:
    table = dynamixel(NAMES["register_1"], True)
    pd.DataFrame(table).to_csv(tmp_path / "log.csv", index=False)
    (tmp_path / "own.toml").write_text('[joints]\n1 = "hip"\n2 = "knee"\n[units]\nvoltage = "1 V"\ncurrent = "1 mA"')
    out = tmp_path / "log.parquet"
    own = ("--map", tmp_path / "own.toml", "--unit", "current=2.69 mA", "--out", out)
    assert cli("import", tmp_path / "log.csv", "--preset", "dynamixel-x", *own).code == 0
    log = sb.read_log(out)
    np.testing.assert_allclose(log.channels["current.knee"], np.sin(TIME), atol=1.36e-3)
    np.testing.assert_allclose(log.channels["voltage.knee"], 120.0)
    np.testing.assert_allclose(log.channels["position.hip"], swing(0), atol=math.pi / 4096)


def test_a_preset_can_be_shown_and_used_from_python(cli: Cli, tmp_path: Path) -> None:
    shown = cli("import", "--show-preset", "ur-rtde")
    assert (shown.code, shown.out) == (0, preset_text("ur-rtde"))
    listed = cli("import", "--show-preset", "all").out.splitlines()
    assert [line.split()[0] for line in listed] == list(available_presets())
    table = dynamixel(NAMES["register_1"], True)
    log = sb.import_log(pd.DataFrame(table), preset="dynamixel-x", rename={"1": "hip"}).log
    np.testing.assert_allclose(log.channels["position.hip"], swing(0), atol=math.pi / 4096)


def test_a_table_that_a_preset_knows_is_told_so(tmp_path: Path) -> None:
    pd.DataFrame(unitree(STYLES["underscores"])).to_csv(tmp_path / "log.csv", index=False)
    with pytest.raises(MappingNeeded, match="--preset unitree-lowstate knows columns of such names"):
        import_log([tmp_path / "log.csv"])
    pd.DataFrame({"a": TIME, "b": TIME}).to_csv(tmp_path / "log.csv", index=False)
    with pytest.raises(MappingNeeded, match=r"hold positions\. A mapping"):
        import_log([tmp_path / "log.csv"])


def test_counts_without_a_unit_are_told_with_the_way_out(tmp_path: Path) -> None:
    pd.DataFrame(dynamixel(NAMES["register_1"], True)).to_csv(tmp_path / "log.csv", index=False)
    imported = import_log([tmp_path / "log.csv"])
    counts = next(p for p in imported.problems if p.code == "units.counts")
    assert "--unit position=ticks4096@2048" in counts.remedy


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ('[encoding]\nvelocity = "sign"', "'sign' is not an encoding; use int16"),
        ('[encoding]\nspeed = "int16"', "'speed' is not a channel"),
        ("[missing]\nspeed = 3", "'speed' is not a channel"),
        ('[units]\nposition = "ticks"', "a multiple of these"),
    ],
)
def test_mistakes_in_the_new_sections_are_told(tmp_path: Path, text: str, said: str) -> None:
    (tmp_path / "own.toml").write_text(text)
    with pytest.raises(UsageError, match=said.replace("(", r"\(")):
        read_map(tmp_path / "own.toml")
