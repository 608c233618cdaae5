"""Importers: every format round-trips, nothing is understood in silence, nothing wrong passes for right."""

from __future__ import annotations

import gzip
import json
import math
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from conftest import GOOD_JOINTS, make_good_log
from hypothesis import given
from hypothesis import strategies as st

from sysid_btr.errors import LogError, UsageError
from sysid_btr.io._check_units import _CONVERSIONS
from sysid_btr.io.importers import KnownModel, get_importer, import_log
from sysid_btr.io.importers.align import Series, on_clock
from sysid_btr.io.importers.base import MappingNeeded
from sysid_btr.io.importers.guess import guess
from sysid_btr.io.importers.mapping import ImportMap, read_map, with_flags
from sysid_btr.io.importers.names import suggestions
from sysid_btr.io.importers.registry import ENTRY_POINTS, recognise
from sysid_btr.io.importers.topics import plain_type
from sysid_btr.io.importers.units import SI, find, resolve
from sysid_btr.io.log import Log
from sysid_btr.io.parquet import write_log
from sysid_btr.io.validation import validate_log
from sysid_btr.testing import check_importer

MODEL = KnownModel("toy", GOOD_JOINTS, dict.fromkeys(GOOD_JOINTS, (-1.0, 1.0)))


def told(**sections: Any) -> ImportMap:
    return ImportMap.model_validate(sections)


def same(log: Log, expected: Log, columns: Sequence[str], atol: float = 1e-12) -> None:
    for column in columns:
        np.testing.assert_allclose(log.channels[column], expected.channels[column], atol=atol, err_msg=column)


# --- units ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("unit", "group", "value", "expected"),
    [
        ("deg", "position", 180.0, math.pi),
        ("rpm", "velocity", 60.0, 2 * math.pi),
        ("mA", "current", 250.0, 0.25),
        ("ms", "time", 1500.0, 1.5),
        ("kg", "force", 2.0, 19.6133),
        ("kg cm", "effort", 10.0, 0.980665),
        ("g", "imu.acc", 1.0, 9.80665),
        ("K", "temperature", 300.0, 26.85),
        ("degF", "temperature", 212.0, 100.0),
        ("%", "stiffness", 80.0, 0.8),
        ("mm", "position", 5.0, 0.005),
        ("m/s^2", "imu.acc", 9.8, 9.8),
        ("rad/s", "imu.gyro", 1.0, 1.0),
        ("DEG", "position", 90.0, math.pi / 2),
        (0.001534, "position", 1000.0, 1.534),
        ("ticks4096", "position", 1024.0, math.pi / 2),
        ("ticks4096@2048", "command", 1024.0, -math.pi / 2),
        ("Ticks1000@-250", "position", 250.0, math.pi),
        ("ticks4096/s", "velocity", 4096.0, 2 * math.pi),
        ("0.229 rpm", "velocity", 100.0, 22.9 * 2 * math.pi / 60),
        ("2.69 mA", "current", 10.0, 0.0269),
        ("0.1V", "voltage", 74.0, 7.4),
        (".1 %", "duty", 1000.0, 1.0),
        ("0.1 K", "temperature", 3000.0, 26.85),
    ],
)
def test_units_convert(unit: str | float, group: str, value: float, expected: float) -> None:
    assert resolve(unit, group).convert(np.array([value]))[0] == pytest.approx(expected, rel=1e-12)


def test_every_unit_the_validation_speaks_of_can_be_imported() -> None:
    for unit, words in _CONVERSIONS.items():
        if unit == "ticks":
            continue
        verb, _, number = words.partition(" by ")
        value = eval(number, {"pi": math.pi})
        factor = value if verb == "multiply" else 1 / value
        assert any(u.factor == pytest.approx(factor, rel=1e-12) for u in find(unit)), unit


@pytest.mark.parametrize(
    ("unit", "group"),
    [
        ("deg", "effort"),
        ("furlong", "position"),
        ("g", "force"),
        ("ticks4096/s", "position"),
        ("ticks4096", "velocity"),
        ("ticks0", "position"),
        ("ticks", "position"),
        ("ticks4096@", "position"),
        ("2 ticks4096", "position"),
        ("0.229 furlong", "velocity"),
    ],
)
def test_a_unit_that_measures_something_else_is_refused(unit: str, group: str) -> None:
    with pytest.raises(UsageError, match=group):
        resolve(unit, group)


# --- names of columns and joints --------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "column"),
    [
        ("command.RKneePitch", "command.RKneePitch"),
        ("knee_cmd", "command.knee"),
        ("cmd_knee", "command.knee"),
        ("knee_target_position", "command.knee"),
        ("goal_position_3", "command.3"),
        ("desired.knee", "command.knee"),
        ("RKneePitchCmd", "command.RKneePitch"),
        ("knee_r_pos", "position.knee_r"),
        ("posKnee", "position.Knee"),
        ("present_position_3", "position.3"),
        ("knee_actual", "position.knee"),
        ("q1", "position.1"),
        ("dq1", "velocity.1"),
        ("tau_1", "effort.1"),
        ("/joint_states/knee/position", "position.knee"),
        ("/joint_states/position[2]", "position.2"),
        ("knee current", "current.knee"),
        ("current_position_knee", "position.knee"),
        ("knee_temp", "temperature.knee"),
        ("imu_gyro_x", "imu.gyro_x"),
        ("accel_z", "imu.acc_z"),
        ("imu/roll", "imu.angle_x"),
        ("force.LFoot", "force.LFoot"),
        ("motorState[0].q", "position.0"),
        ("motor_state[0].dq", "velocity.0"),
        ("motorCmd[0].q", "command.0"),
        ("motor_cmd.0.q", "command.0"),
        ("motor_cmd", "command.motor"),
        ("motor_cmd_0_q", None),
        ("motorCmd[0].dq", None),
        ("motorCmd[0].tau", None),
        ("motorCmd[0].Kp", None),
        ("knee", None),
        ("act_1", None),
        ("target_velocity_knee", None),
        ("battery", None),
        ("HeadYaw", None),
        ("HeadPitch", None),
    ],
)
def test_names_are_taken_for_what_they_plainly_say(name: str, column: str | None) -> None:
    assert guess([name]).columns.get(name) == column


def test_a_name_of_brackets_alone_is_seen_through_at_once() -> None:
    """An expression of nested repeats takes hours for it."""
    assert guess(["a" + "[ " * 10_000 + "]", "[" * 10_000 + "deg]"]).columns == {}


def test_units_in_names_are_read_but_not_put_into_the_joint() -> None:
    found = guess(["time_ms", "knee_pos_deg", "velocity (rpm)", "knee_vel [rpm]", "knee_current [mA]"])
    assert found.time == "time_ms"
    assert found.columns["knee_pos_deg"] == "position.knee"
    assert found.columns["knee_vel [rpm]"] == "velocity.knee"
    assert dict(found.units) == {
        "time_ms": "ms",
        "knee_pos_deg": "deg",
        "knee_vel [rpm]": "rpm",
        "knee_current [mA]": "mA",
    }


def test_two_columns_for_one_thing_are_neither() -> None:
    assert guess(["knee_pos", "pos_knee"]).columns == {}


def test_suggestions_never_take_left_for_right() -> None:
    model = ["LKneePitch", "RKneePitch", "HeadYaw"]
    assert suggestions(["l_knee_pitch", "r_knee_pitch_joint", "head-yaw"], model) == {
        "l_knee_pitch": "LKneePitch",
        "r_knee_pitch_joint": "RKneePitch",
        "head-yaw": "HeadYaw",
    }
    assert suggestions(["l_knee"], ["RKneePitch"]) == {}
    assert suggestions(["r_knee_ptich"], model) == {"r_knee_ptich": "RKneePitch"}
    assert suggestions(["HeadYaw"], model) == {}


# --- tables -----------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def good() -> Log:
    return make_good_log()


def plain_frame(log: Log) -> pd.DataFrame:
    """The log as people write tables: names of their own, SI units."""
    columns = {"time": log.time}
    for joint in GOOD_JOINTS:
        columns[f"{joint}_cmd"] = log.channels[f"command.{joint}"]
        columns[f"{joint}_pos"] = log.channels[f"position.{joint}"]
    return pd.DataFrame(columns)


JOINT_COLUMNS = [f"{c}.{j}" for c in ("command", "position") for j in GOOD_JOINTS]


def as_csv(frame: pd.DataFrame, **options: Any) -> bytes:
    return frame.to_csv(index=False, **options).encode()


@pytest.mark.parametrize(
    "write",
    [
        as_csv,
        lambda f: as_csv(f, sep=";", decimal=","),
        lambda f: as_csv(f, sep="\t"),
        lambda f: as_csv(f, sep=" "),
        lambda f: b"\xef\xbb\xbf" + as_csv(f),
        lambda f: f.to_csv(index=False).encode("utf-16"),
        lambda f: as_csv(f).replace(b"\n", b"\r\n"),
        lambda f: b"# recorded on Monday\n\n" + as_csv(f),
        lambda f: b"# " + b",".join(c.encode() for c in f.columns) + b"\n" + as_csv(f, header=False),
        lambda f: gzip.compress(as_csv(f)),
        lambda f: as_csv(f, quoting=1),
        lambda f: "# 20 °C\n".encode("latin-1") + as_csv(f),
    ],
    ids=[
        *("comma", "semicolon", "tab", "blank", "bom", "utf16"),
        *("crlf", "comments", "bare", "gzip", "quotes", "latin"),
    ],
)
def test_a_table_needs_no_mapping_in_any_dialect(
    tmp_path: Path, good: Log, write: Callable[[pd.DataFrame], bytes]
) -> None:
    path = tmp_path / "log.csv"
    path.write_bytes(write(plain_frame(good)))
    imported = import_log([path], model=MODEL)
    assert imported.formats == {str(path): "csv"}
    assert imported.usable, imported.problems
    same(imported.log, good, JOINT_COLUMNS)
    assert imported.log.meta.sample_period == good.meta.sample_period
    assert imported.log.meta.robot == "toy"


def test_a_parquet_file_with_foreign_columns(tmp_path: Path, good: Log) -> None:
    path = tmp_path / "log.parquet"
    plain_frame(good).to_parquet(path)
    same(import_log([path]).log, good, JOINT_COLUMNS)


def test_a_log_of_the_schema_comes_out_as_it_was(tmp_path: Path, good: Log) -> None:
    write_log(good, tmp_path / "log.parquet")
    log = import_log([tmp_path / "log.parquet"]).log
    same(log, good, list(good.channels))
    assert replace(log.meta, extra={}) == replace(good.meta, extra={})


def test_a_mapping_says_it_all(tmp_path: Path, good: Log) -> None:
    frame = pd.DataFrame({"T": good.time * 1e3})
    for joint in GOOD_JOINTS:
        sign = -1 if joint == "HeadYaw" else 1
        frame[f"{joint.lower()} soll"] = np.degrees(sign * good.channels[f"command.{joint}"] - 0.02 * (sign < 0))
        frame[f"{joint.lower()} ist"] = np.degrees(sign * good.channels[f"position.{joint}"] - 0.02 * (sign < 0))
    frame["gx"] = np.degrees(good.channels["imu.gyro_x"])
    frame["I1"] = 1500.0
    frame.loc[7, "headyaw ist"] = -9999
    frame["batt"] = 12.6
    frame["text"] = "x"
    frame["noise"] = 0.0
    frame.to_csv(tmp_path / "log.csv", index=False)
    (tmp_path / "map.toml").write_text(
        """
        ignore = ["noi*"]
        [time]
        column = "T"
        [table]
        missing = ["-9999.0"]
        [units]
        time = "ms"
        command = "deg"
        position = "deg"
        current = "mA"
        "imu.gyro" = "deg/s"
        [channels]
        command = "{joint} soll"
        position = ["{joint} ist"]
        [columns]
        gx = "imu.gyro_x"
        I1 = "current.headyaw"
        [joints]
        lkneepitch = "LKneePitch"
        rkneepitch = "RKneePitch"
        lhiproll = "LHipRoll"
        rhiproll = "RHipRoll"
        [joints.headyaw]
        to = "HeadYaw"
        sign = -1
        offset = -0.02
        [meta]
        robot = "me"
        mount = "free"
        servo_period = 0.01
        notes = "of old"
        """
    )
    imported = import_log([tmp_path / "log.csv"], told=read_map(tmp_path / "map.toml"), model=MODEL)
    log = imported.log
    expected = good.channels["position.HeadYaw"].copy()
    expected[7] = np.nan
    np.testing.assert_allclose(log.channels["position.HeadYaw"], expected, atol=1e-12)
    same(log, good, [c for c in JOINT_COLUMNS if c != "position.HeadYaw"])
    same(log, good, ["imu.gyro_x"])
    assert np.all(log.channels["current.HeadYaw"] == 1.5)  # a current has no direction
    assert (log.meta.robot, log.meta.mount, log.meta.servo_period) == ("me", "free", 0.01)
    assert set(log.unknown) == {"batt", "text"}
    assert any("batt, text" in r for r in imported.remarks)
    assert imported.usable


def test_a_command_in_other_units_keeps_its_unit_and_gets_no_offset(tmp_path: Path) -> None:
    frame = pd.DataFrame({"time": np.arange(100) * 0.01, "a_cmd": 1.0, "a_pos": 0.5})
    frame.to_csv(tmp_path / "log.csv", index=False)
    rules = told(units={"command": "mNm", "position": "mm"}, joints={"a": {"offset": 1.0}})
    log = import_log([tmp_path / "log.csv"], told=rules).log
    assert log.channels["command.a"][0] == pytest.approx(1e-3)
    assert log.channels["position.a"][0] == pytest.approx(1.0005)
    assert log.meta.units == {"command": "Nm", "position": "m"}


def test_a_sliding_joint_of_the_model_is_in_metres(tmp_path: Path) -> None:
    frame = pd.DataFrame({"time": np.arange(100) * 0.01, "x_cmd": 0.1, "x_pos": 0.1, "h_cmd": 0.1, "h_pos": 0.1})
    frame.to_csv(tmp_path / "log.csv", index=False)
    log = import_log([tmp_path / "log.csv"], model=KnownModel("cart", ("x", "h"), sliding=("x",))).log
    assert log.meta.units == {"command.x": "m", "position.x": "m"}


def test_a_unit_that_does_not_suit_the_models_joint_is_refused(tmp_path: Path) -> None:
    (tmp_path / "log.csv").write_text(LINES)
    rules = with_flags(ImportMap(), units=[("position", "deg")])
    with pytest.raises(LogError, match=r"slides in the model: .*--unit position\.a=UNIT"):
        import_log([tmp_path / "log.csv"], told=rules, model=KnownModel("cart", ("a",), sliding=("a",)))
    rules = with_flags(ImportMap(), units=[("position", "deg"), ("position.a", "mm")])
    with pytest.raises(LogError, match="turns in the model"):
        import_log([tmp_path / "log.csv"], told=rules, model=KnownModel("arm", ("a",)))


@pytest.mark.parametrize(("factor", "unit"), [(1e3, "ms"), (1e6, "us"), (1e9, "ns")])
def test_a_clock_without_a_unit_is_recognised_and_told(tmp_path: Path, good: Log, factor: float, unit: str) -> None:
    frame = plain_frame(good)
    frame["time"] *= factor
    frame.to_csv(tmp_path / "log.csv", index=False)
    imported = import_log([tmp_path / "log.csv"])
    np.testing.assert_allclose(imported.log.time, good.time, atol=1e-9)
    assert any(f"taken as {unit}" in r for r in imported.remarks)


def test_dates_are_a_clock_too(tmp_path: Path, good: Log) -> None:
    frame = plain_frame(good)
    frame["time"] = [f"2026-03-01 12:00:{s:09.6f}" for s in good.time]
    frame.to_csv(tmp_path / "log.csv", index=False)
    log = import_log([tmp_path / "log.csv"]).log
    np.testing.assert_allclose(log.time - log.time[0], good.time, atol=1e-6)
    assert log.meta.sample_period == good.meta.sample_period


def test_a_rate_stands_for_a_clock(tmp_path: Path, good: Log) -> None:
    plain_frame(good).drop(columns="time").to_csv(tmp_path / "log.csv", index=False)
    log = import_log([tmp_path / "log.csv"], told=told(time={"rate": 100})).log
    np.testing.assert_allclose(log.time, good.time, atol=1e-12)


def test_foreign_columns_keep_their_types(tmp_path: Path, good: Log) -> None:
    big = np.arange(len(good), dtype=np.int64) + 2**60 + 1
    when = pd.date_range("2026-01-01", periods=len(good), freq="10ms")
    foreign = {"count": big, "ok": big % 2 == 0, "when": when, "why": [None, *["x"] * (len(good) - 1)]}
    plain_frame(good).assign(**foreign).to_parquet(tmp_path / "log.parquet")
    log = import_log([tmp_path / "log.parquet"]).log
    assert log.unknown["count"].dtype == np.int64
    np.testing.assert_array_equal(log.unknown["count"], big)
    assert log.unknown["ok"].dtype == np.bool_
    write_log(log, tmp_path / "out.parquet")
    again = pd.read_parquet(tmp_path / "out.parquet")
    assert (again["when"] == when).all()
    assert pd.isna(again["why"][0])
    plain_frame(good).assign(why=foreign["why"]).to_csv(tmp_path / "log.csv", index=False)
    log = import_log([tmp_path / "log.csv"]).log
    write_log(log, tmp_path / "out.parquet", overwrite=True)
    assert list(log.unknown["why"][:2]) == [None, "x"]


def test_stamps_of_a_parquet_file_are_a_clock(tmp_path: Path, good: Log) -> None:
    frame = plain_frame(good)
    frame["time"] = pd.Timestamp("2026-01-01") + pd.to_timedelta(good.time, unit="s")
    frame.to_parquet(tmp_path / "log.parquet")
    log = import_log([tmp_path / "log.parquet"]).log
    np.testing.assert_allclose(log.time - log.time[0], good.time, atol=1e-6)


def test_a_log_that_declares_degrees_is_converted(tmp_path: Path, good: Log) -> None:
    degrees = {c: np.degrees(v) if c.startswith("position.") else v for c, v in good.channels.items()}
    meta = replace(good.meta, units={"position": "deg", "command": "rad", "position.HeadYaw": "deg"})
    write_log(replace(good, channels=degrees, meta=meta), tmp_path / "log.parquet")
    imported = import_log([tmp_path / "log.parquet"])
    assert imported.usable, imported.problems
    same(imported.log, good, list(good.channels))
    assert imported.log.meta.units == {"command": "rad"}


def test_several_files_are_episodes(tmp_path: Path, good: Log) -> None:
    frame = plain_frame(good)
    frame.iloc[:300].to_csv(tmp_path / "a.csv", index=False)
    frame.iloc[300:].assign(batt=12.0).to_csv(tmp_path / "b.csv", index=False)
    imported = import_log([tmp_path / "a.csv", tmp_path / "b.csv"])
    log = imported.log
    assert [rows.stop - rows.start for rows in log.episodes()] == [300, len(good) - 300]
    same(log, good, JOINT_COLUMNS)
    assert np.isnan(log.unknown["batt"][:300]).all()
    assert any("becomes an episode" in r for r in imported.remarks)


def test_an_episode_column_is_kept(tmp_path: Path, good: Log) -> None:
    plain_frame(good).assign(run=(good.time > 4).astype(int)).to_csv(tmp_path / "log.csv", index=False)
    log = import_log([tmp_path / "log.csv"], told=told(episode="run")).log
    assert len(log.episodes()) == 2


def test_foreign_columns_never_take_the_place_of_the_schemas(tmp_path: Path, good: Log) -> None:
    frame = plain_frame(good).rename(columns={"time": "t"}).assign(time="noon")
    frame.to_csv(tmp_path / "log.csv", index=False)
    imported = import_log([tmp_path / "log.csv"], told=told(time={"column": "t"}))
    np.testing.assert_allclose(imported.log.time, good.time)
    assert set(imported.log.unknown) == {"foreign.time"}
    assert any("foreign.time" in r for r in imported.remarks)
    write_log(imported.log, tmp_path / "log.parquet")


LINES = "time,a_cmd,a_pos\n" + "".join(f"{i / 100},0.1,0.1\n" for i in range(5))


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ("", "0 bytes"),
        ("time,a_cmd,a_pos\n", "no rows"),
        ("# nothing\n", "no importer|no table"),
        (LINES + "0.05,0.1\n0.06,1,2\n", "line 7"),
        (LINES + "0.05,0.1,0.1,0.1\n", "line 7"),
        (LINES.replace("0.03,0.1", "0.03,ERR"), "'ERR' in line 5"),
        (LINES.replace("0.03,", "late,"), "'late' in line 5"),
        (LINES.replace("a_cmd", "a_pos"), "a_pos"),
        (LINES.partition("\n")[2], "header"),
        ("PK\x03\x04zip", "zip archive"),
        ('{"time": 1}', "JSON"),
        ("#ROSBAG V2.0\n", "rosbags-convert"),
    ],
    ids=["empty", "header", "comment", "short", "long", "word", "clock", "twice", "bare", "zip", "json", "ros1"],
)
def test_a_table_that_cannot_be_read_says_where(tmp_path: Path, content: str, said: str) -> None:
    path = tmp_path / "log.csv"
    path.write_text(content)
    with pytest.raises(LogError, match=said) as caught:
        import_log([path])
    assert str(path) in str(caught.value)


def test_a_line_that_the_recorder_did_not_finish_is_left_out_and_told(tmp_path: Path) -> None:
    (tmp_path / "log.csv").write_text(LINES + "0.05,0.")
    imported = import_log([tmp_path / "log.csv"])
    assert len(imported.log) == 5
    assert any("line 7" in r for r in imported.remarks)


def test_a_truncated_parquet_file_is_told(tmp_path: Path, good: Log) -> None:
    path = tmp_path / "log.parquet"
    plain_frame(good).to_parquet(path)
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(LogError, match="footer"):
        import_log([path])


def test_problems_of_all_files_are_told_at_once(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("")
    (tmp_path / "b.csv").write_text(LINES + "1\n2\n")
    with pytest.raises(LogError) as caught:
        import_log([tmp_path / "a.csv", tmp_path / "b.csv", tmp_path / "c.csv"])
    assert all(name in str(caught.value) for name in ("a.csv", "b.csv", "c.csv"))


def test_a_table_that_cannot_be_guessed_comes_with_a_mapping_to_edit(tmp_path: Path, good: Log) -> None:
    frame = plain_frame(good)
    frame.columns = ["s", *(f"c{i}" for i in range(len(frame.columns) - 1))]
    frame.to_csv(tmp_path / "log.csv", index=False)
    with pytest.raises(MappingNeeded, match="commands and which columns hold positions") as caught:
        import_log([tmp_path / "log.csv"])
    text = caught.value.propose(GOOD_JOINTS)
    assert "HeadYaw" in text
    (tmp_path / "map.toml").write_text(text)
    assert read_map(tmp_path / "map.toml").time.column == "s"
    # as an editor would: the comment marks go, the columns get their names
    lines = text.splitlines()
    for i, name in enumerate(frame.columns[1:]):
        channel, joint = ("command", "position")[i % 2], GOOD_JOINTS[i // 2]
        at = next(k for k, line in enumerate(lines) if line.startswith(f'# "{name}"'))
        lines[at] = f'"{name}" = "{channel}.{joint}"'
    (tmp_path / "map.toml").write_text("\n".join(lines))
    log = import_log([tmp_path / "log.csv"], told=read_map(tmp_path / "map.toml"), model=MODEL).log
    same(log, good, JOINT_COLUMNS)


@given(names=st.lists(st.text(min_size=1).filter(lambda t: t.strip() == t), min_size=2, max_size=6, unique=True))
def test_any_names_make_a_mapping_that_is_toml(names: list[str]) -> None:
    import tomllib

    from sysid_btr.io.importers.guess import proposal
    from sysid_btr.io.importers.table import Table

    table = Table({name: np.arange(3.0) for name in names})
    tomllib.loads(proposal(Path("log.csv"), table, guess(names), ["HeadYaw"]))


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("[[", "not TOML"),
        ("[tme]\ncolumn = 't'", "tme"),
        ("[units]\nposition = 'furlong'", "furlong"),
        ("[units]\npostion = 'deg'", "did you mean position"),
        ("[units]\n'imu' = 'g'", "imu.acc"),
        ("[units]\nforce = 'range_0_100'", "normalised"),
        ("[columns]\na = 'angle.knee'", "angle.knee"),
        ("[channels]\nposition = 'pos'", "placeholder"),
        ("[channels]\nangle = '{joint}'", "angle"),
        ("[joints.a]\nsign = 2", "sign"),
        ("[time]\ncolumn = 't'\nrate = 10", "not both"),
        ("[meta]\nmount = 'up'", "mount"),
    ],
)
def test_mistakes_in_a_mapping_are_told(tmp_path: Path, text: str, said: str) -> None:
    (tmp_path / "map.toml").write_text(text)
    with pytest.raises(UsageError, match=said):
        read_map(tmp_path / "map.toml")


@pytest.mark.parametrize(
    ("rules", "said"),
    [
        ({"columns": {"b_pos": "position.a"}}, "did you mean 'a_pos'"),
        ({"channels": {"position": ["{joint}_angle"]}}, "matches no column"),
        ({"channels": {"position": ["{joint}_pos"]}, "columns": {"a_cmd": "position.a"}}, "more than one column"),
        ({"time": {"column": "clock"}}, "clock"),
        ({"joints": {"knee": {"to": "Knee"}}}, "no such name"),
        ({"joints": {"a": {"range": [0, 1]}}, "units": {"command": "range_0_100"}}, None),
        ({"units": {"position": "range_0_100"}}, r"joints\.a\] range"),
    ],
)
def test_a_mapping_that_does_not_fit_the_file_is_told(tmp_path: Path, rules: dict[str, Any], said: str | None) -> None:
    (tmp_path / "log.csv").write_text(LINES)
    if said is None:
        assert import_log([tmp_path / "log.csv"], told=told(**rules)).log.channels["command.a"][0] == 0.001
        return
    with pytest.raises(LogError, match=said):
        import_log([tmp_path / "log.csv"], told=told(**rules))


def test_flags_win_over_the_file() -> None:
    rules = told(units={"position": "mm", "position.a": "cm", "effort": "mNm"}, joints={"a": {"to": "b", "sign": -1}})
    merged = with_flags(rules, units=[("position", "deg")], renames=[("a", "c")], meta={"mount": "free"})
    assert merged.units == {"position": "deg", "effort": "mNm"}
    assert (merged.joints["a"].to, merged.joints["a"].sign, merged.meta.mount) == ("c", -1, "free")


# --- findings and what to do about them -------------------------------------------------------------------------


def test_degrees_are_found_against_the_models_ranges_with_the_flags_that_help(tmp_path: Path, good: Log) -> None:
    frame = plain_frame(good)
    frame.iloc[:, 1:] = np.degrees(frame.iloc[:, 1:])
    frame.to_csv(tmp_path / "log.csv", index=False)
    wrong = import_log([tmp_path / "log.csv"], model=MODEL)
    assert not wrong.usable
    assert set(wrong.advice) == {"--unit command=deg", "--unit position=deg"}
    right = with_flags(ImportMap(), units=[("command", "deg"), ("position", "deg")])
    assert import_log([tmp_path / "log.csv"], told=right, model=MODEL).usable


def test_a_joint_that_really_turns_far_can_be_vouched_for(tmp_path: Path) -> None:
    time = np.arange(600) * 0.01
    frame = pd.DataFrame({"time": time, "wheel_cmd": 9 * time, "wheel_pos": 9 * (time - 0.02)})
    frame.to_csv(tmp_path / "log.csv", index=False)
    assert not import_log([tmp_path / "log.csv"]).usable
    vouched = with_flags(ImportMap(), units=[("command.wheel", "rad"), ("position.wheel", "rad")])
    assert import_log([tmp_path / "log.csv"], told=vouched).usable


def test_foreign_joint_names_are_told_with_the_flags_that_help(tmp_path: Path, good: Log) -> None:
    names = {"HeadYaw": "head_yaw", "LKneePitch": "l_knee_pitch", "RKneePitch": "r_knee_pitch"}
    frame = plain_frame(good)
    frame.columns = [names.get(c[:-4], c[:-4]) + c[-4:] for c in frame.columns]
    frame.to_csv(tmp_path / "log.csv", index=False)
    wrong = import_log([tmp_path / "log.csv"], model=MODEL)
    assert not wrong.usable
    renames = {flag.partition(" ")[2] for flag in wrong.advice}
    assert renames == {f"{foreign}={own}" for own, foreign in names.items()}
    rules = with_flags(ImportMap(), renames=[tuple(r.split("=")) for r in renames])
    right = import_log([tmp_path / "log.csv"], told=rules, model=MODEL)
    assert right.usable
    same(right.log, good, JOINT_COLUMNS)


# --- NaoQi ------------------------------------------------------------------------------------------------------

KEY = "Device/SubDeviceList/"


def nao_frame(log: Log) -> pd.DataFrame:
    columns: dict[str, Any] = {"DCM/Time": np.round(log.time * 1000 + 123456).astype(int)}
    for joint in GOOD_JOINTS:
        columns[f"{KEY}{joint}/Position/Actuator/Value"] = log.channels[f"command.{joint}"]
        columns[f"{KEY}{joint}/Position/Sensor/Value"] = log.channels[f"position.{joint}"]
        columns[f"{KEY}{joint}/ElectricCurrent/Sensor/Value"] = 0.3
        columns[f"{KEY}{joint}/Temperature/Sensor/Value"] = 38.0
        columns[f"{KEY}{joint}/Hardness/Actuator/Value"] = 0.9
    columns[f"{KEY}InertialSensor/AngleX/Sensor/Value"] = log.channels["imu.angle_x"]
    columns[f"{KEY}InertialSensor/GyroscopeX/Sensor/Value"] = log.channels["imu.gyro_x"]
    for axis in "XYZ":
        columns[f"{KEY}InertialSensor/Accelerometer{axis}/Sensor/Value"] = log.channels[f"imu.acc_{axis.lower()}"]
    columns[f"{KEY}LFoot/FSR/FrontLeft/Sensor/Value"] = log.channels["force.LFoot"] / 9.80665
    columns[f"{KEY}LFoot/FSR/TotalWeight/Sensor/Value"] = 1.0
    columns[f"{KEY}LHand/Position/Sensor/Value"] = 0.5
    return pd.DataFrame(columns)


def test_naoqi_keys(tmp_path: Path, good: Log) -> None:
    path = tmp_path / "log.csv"
    nao_frame(good).to_csv(path, index=False)
    imported = import_log([path], model=MODEL)
    log = imported.log
    assert imported.formats == {str(path): "naoqi"}
    assert imported.usable, imported.problems
    np.testing.assert_allclose(log.time, good.time + 123.456, atol=1e-9)
    same(log, good, [*JOINT_COLUMNS, "imu.angle_x", "imu.gyro_x", "imu.acc_z"])
    np.testing.assert_allclose(log.channels["force.LFootFrontLeft"], good.channels["force.LFoot"])
    assert log.channels["current.HeadYaw"][0] == 0.3
    assert log.channels["stiffness.HeadYaw"][0] == 0.9
    assert (log.meta.robot, log.meta.command_hold) == ("nao", "zoh")
    assert {c.rpartition("SubDeviceList/")[2].split("/")[0] for c in log.unknown} == {"LFoot", "LHand"}
    text = " ".join(imported.remarks)
    assert "taken as ms" in text
    assert "TotalWeight" in text
    assert "LHand" in text
    assert "mount" in text


def test_naoqi_keys_in_a_parquet_file(tmp_path: Path, good: Log) -> None:
    nao_frame(good).to_parquet(tmp_path / "log.parquet")
    imported = import_log([tmp_path / "log.parquet"])
    assert set(imported.formats.values()) == {"naoqi"}
    same(imported.log, good, JOINT_COLUMNS)


def test_naoqis_raw_counts_are_not_taken_for_si(tmp_path: Path, good: Log) -> None:
    frame = nao_frame(good)
    frame.columns = [c.replace("Accelerometer", "Acc").replace("GyroscopeX", "GyrX") for c in frame.columns]
    raw = [c for c in frame.columns if "/Acc" in c]
    frame[raw] *= 6
    frame[f"{KEY}InertialSensor/GyrX/Sensor/Value"] *= 1000
    frame.to_csv(tmp_path / "log.csv", index=False)
    imported = import_log([tmp_path / "log.csv"])
    assert not [c for c in imported.log.channels if c.startswith(("imu.acc", "imu.gyro"))]
    assert set(raw) < set(imported.log.unknown)
    assert sum("raw counts" in r for r in imported.remarks) == 2


def test_naoqis_older_keys_are_used_where_they_are_si(tmp_path: Path, good: Log) -> None:
    frame = nao_frame(good)
    frame.columns = [c.replace("Accelerometer", "Acc").replace("GyroscopeX", "GyrX") for c in frame.columns]
    frame.to_csv(tmp_path / "log.csv", index=False)
    same(import_log([tmp_path / "log.csv"]).log, good, ["imu.gyro_x", "imu.acc_z"])


def test_gravity_that_points_down_is_told_and_turned_by_a_flag(tmp_path: Path, good: Log) -> None:
    frame = nao_frame(good)
    acc = [c for c in frame.columns if "Accelerometer" in c]
    frame[acc] *= -1
    frame.to_csv(tmp_path / "log.csv", index=False)
    assert any("--unit imu.acc=-1" in r for r in import_log([tmp_path / "log.csv"]).remarks)
    rules = with_flags(ImportMap(), units=[("imu.acc", "-1")])
    same(import_log([tmp_path / "log.csv"], told=rules).log, good, ["imu.acc_z"])


def test_both_hip_yaws_are_on_one_motor(tmp_path: Path, good: Log) -> None:
    frame = nao_frame(good)
    frame.columns = [c.replace("HeadYaw", "LHipYawPitch") for c in frame.columns]
    frame[f"{KEY}RHipYawPitch/Position/Sensor/Value"] = good.channels["position.HeadYaw"]
    frame.to_csv(tmp_path / "log.csv", index=False)
    imported = import_log([tmp_path / "log.csv"])
    np.testing.assert_allclose(
        imported.log.channels["command.RHipYawPitch"], good.channels["command.HeadYaw"], atol=1e-12
    )
    assert any("motor of LHipYawPitch" in r for r in imported.remarks)


# --- one clock --------------------------------------------------------------------------------------------------

stamps = st.lists(st.integers(0, 2000), min_size=2, max_size=40, unique=True).map(
    lambda t: np.sort(np.array(t)) / 100.0
)


@given(sent=stamps, clock=stamps)
def test_a_held_command_is_never_interpolated_and_never_early(sent: np.ndarray, clock: np.ndarray) -> None:
    values = np.arange(len(sent)) ** 2.0
    shown = on_clock(Series("/c", "command.a", sent, values, held=True), clock)
    for t, value in zip(clock, shown, strict=True):
        before = sent <= t
        assert (np.isnan(value) and not before.any()) or value == values[before][-1]


@given(sent=stamps, clock=stamps)
def test_a_sensor_on_another_clock_stays_between_its_neighbours(sent: np.ndarray, clock: np.ndarray) -> None:
    values = 3.0 * sent - 1.0
    shown = on_clock(Series("/s", "imu.gyro_x", sent, values), clock)
    known = ~np.isnan(shown)
    np.testing.assert_allclose(shown[known], 3.0 * clock[known] - 1.0, atol=1e-9)
    assert not known[(clock < sent[0]) | (clock > sent[-1])].any()
    assert known[np.isin(clock, sent)].all()


def test_a_sensor_is_missing_inside_its_own_gaps() -> None:
    sent = np.array([0.0, 0.1, 0.2, 0.3, 2.0, 2.1])
    shown = on_clock(Series("/s", "imu.gyro_x", sent, sent), np.array([0.25, 1.0, 2.05]))
    assert np.isnan(shown).tolist() == [False, True, False]


# --- bags -------------------------------------------------------------------------------------------------------

ORIGIN = 1_700_000_000_000_000_000
ORDER = {"ros": {"joints": list(GOOD_JOINTS)}}


def ns(seconds: float) -> int:
    return ORIGIN + round(seconds * 1e9)


class Ros:
    """Messages by the format's own library."""

    def __init__(self) -> None:
        from rosbags.typesys import Stores, get_typestore

        self.store = get_typestore(Stores.ROS2_JAZZY)

    def __call__(self, kind: str, **fields: Any) -> Any:
        return self.store.types[kind](**fields)

    def header(self, stamp: int | None) -> Any:
        stamp = stamp or 0
        time = self("builtin_interfaces/msg/Time", sec=stamp // 10**9, nanosec=stamp % 10**9)
        return self("std_msgs/msg/Header", stamp=time, frame_id="")

    def joint_state(self, stamp: int | None, names: Sequence[str], position: Any, velocity: Any = ()) -> Any:
        return self(
            "sensor_msgs/msg/JointState",
            header=self.header(stamp),
            name=list(names),
            position=np.array(position, dtype=np.float64),
            velocity=np.array(velocity, dtype=np.float64),
            effort=np.array([], dtype=np.float64),
        )

    def array(self, values: Any) -> Any:
        layout = self("std_msgs/msg/MultiArrayLayout", dim=[], data_offset=0)
        return self("std_msgs/msg/Float64MultiArray", layout=layout, data=np.array(values, dtype=np.float64))

    def trajectory(self, stamp: int | None, names: Sequence[str], points: Sequence[tuple[float, Any]]) -> Any:
        empty = np.array([], dtype=np.float64)
        return self(
            "trajectory_msgs/msg/JointTrajectory",
            header=self.header(stamp),
            joint_names=list(names),
            points=[
                self(
                    "trajectory_msgs/msg/JointTrajectoryPoint",
                    positions=np.array(p, dtype=np.float64),
                    velocities=empty,
                    accelerations=empty,
                    effort=empty,
                    time_from_start=self(
                        "builtin_interfaces/msg/Duration", sec=int(t), nanosec=round((t - int(t)) * 1e9)
                    ),
                )
                for t, p in points
            ],
        )

    def imu(self, stamp: int, gyro: Any, acc: Any, quaternion: Any = (0.0, 0.0, 0.0, 1.0)) -> Any:
        vector = lambda v: self("geometry_msgs/msg/Vector3", **dict(zip("xyz", map(float, v), strict=True)))  # noqa: E731
        return self(
            "sensor_msgs/msg/Imu",
            header=self.header(stamp),
            orientation=self("geometry_msgs/msg/Quaternion", **dict(zip("xyzw", quaternion, strict=True))),
            orientation_covariance=np.zeros(9),
            angular_velocity=vector(gyro),
            angular_velocity_covariance=np.zeros(9),
            linear_acceleration=vector(acc),
            linear_acceleration_covariance=np.zeros(9),
        )


@pytest.fixture(scope="module")
def ros() -> Ros:
    pytest.importorskip("rosbags", reason="bags need the extra ros")
    return Ros()


@dataclass(frozen=True)
class Sent:
    topic: str
    received: int
    message: Any


def write_bag(ros: Ros, path: Path, sent: Sequence[Sent], storage: str = "SQLITE3") -> Path:
    from rosbags import rosbag2

    plugin = rosbag2.StoragePlugin[storage]
    with rosbag2.Writer(path, version=9, storage_plugin=plugin) as writer:
        topics: dict[str, Any] = {}
        for one in sent:
            kind = one.message.__msgtype__
            if one.topic not in topics:
                topics[one.topic] = writer.add_connection(one.topic, kind, typestore=ros.store)
            writer.write(topics[one.topic], one.received, ros.store.serialize_cdr(one.message, kind))
    return path


def conversation(ros: Ros, log: Log, early: float = 0.0) -> list[Sent]:
    """States with header stamps, received 1 ms later; commands without, `early` s before the state that shows them."""
    sent = []
    for i, t in enumerate(log.time):
        command = [log.channels[f"command.{j}"][i] for j in GOOD_JOINTS]
        position = [log.channels[f"position.{j}"][i] for j in GOOD_JOINTS]
        velocity = [log.channels[f"velocity.{j}"][i] for j in GOOD_JOINTS]
        sent.append(Sent("/leg/commands", ns(t - early), ros.array(command)))
        state = ros.joint_state(ns(t), GOOD_JOINTS, position, velocity)
        sent.append(Sent("/joint_states", ns(t + 0.001), state))
    return sent


BAG_COLUMNS = [*JOINT_COLUMNS, *(f"velocity.{j}" for j in GOOD_JOINTS)]


@pytest.mark.parametrize("storage", ["SQLITE3", "MCAP"])
@pytest.mark.parametrize("whole", [True, False], ids=["folder", "file"])
def test_a_ros2_bag(tmp_path: Path, ros: Ros, good: Log, storage: str, whole: bool) -> None:
    folder = write_bag(ros, tmp_path / "bag", conversation(ros, good), storage)
    path = folder if whole else next(p for p in folder.iterdir() if p.suffix in (".db3", ".mcap"))
    imported = import_log([path], told=told(**ORDER), model=MODEL)
    expected = "mcap" if storage == "MCAP" and not whole else "ros2"
    assert imported.formats == {str(path): expected}
    assert imported.usable, imported.problems
    np.testing.assert_allclose(imported.log.time, good.time, atol=1e-9)
    same(imported.log, good, BAG_COLUMNS)
    assert imported.log.meta.sample_period == good.meta.sample_period


def test_commands_between_states_show_up_with_the_next_and_this_is_told(tmp_path: Path, ros: Ros, good: Log) -> None:
    path = write_bag(ros, tmp_path / "bag", conversation(ros, good, early=0.004))
    imported = import_log([path], told=told(**ORDER))
    same(imported.log, good, JOINT_COLUMNS)
    assert any("4 ms late" in r for r in imported.remarks)
    assert "4 ms late" in imported.log.meta.notes


def test_arrays_without_names_ask_for_their_order(tmp_path: Path, ros: Ros, good: Log) -> None:
    path = write_bag(ros, tmp_path / "bag", conversation(ros, good)[:40])
    with pytest.raises(LogError, match=r"\[ros\] joints .* with 5 names"):
        import_log([path])
    with pytest.raises(LogError, match=r"holds 5 numbers, .* names 2"):
        import_log([path], told=told(ros={"joints": ["a", "b"]}))


def test_joint_states_may_be_commands_and_an_imu_has_its_own_clock(tmp_path: Path, ros: Ros, good: Log) -> None:
    half = math.sin(0.15), math.cos(0.15)
    sent = []
    for i, t in enumerate(good.time):
        command = [good.channels[f"command.{j}"][i] for j in GOOD_JOINTS]
        position = [good.channels[f"position.{j}"][i] for j in GOOD_JOINTS]
        # the command names the joints in another order
        sent.append(Sent("/joint_command", ns(t), ros.joint_state(ns(t), GOOD_JOINTS[::-1], command[::-1])))
        sent.append(Sent("/joint_states", ns(t), ros.joint_state(ns(t), GOOD_JOINTS, position)))
    for k in range(1600):
        t = 0.005 * k + 0.002
        imu = ros.imu(ns(t), (2 * t, 0, 0), (0, 0, 9.81), (half[0], 0.0, 0.0, half[1]))
        sent.append(Sent("/imu", ns(t), imu))
    sent.sort(key=lambda s: s.received)
    sent.append(Sent("/chatter", ns(9), ros("std_msgs/msg/String", data="hello")))
    sent.append(Sent("/battery", ns(1), ros("std_msgs/msg/Float64", data=12.5)))
    imported = import_log([write_bag(ros, tmp_path / "bag", sent, "MCAP")])
    log = imported.log
    same(log, good, JOINT_COLUMNS)
    known = np.isfinite(log.channels["imu.gyro_x"])
    assert known.sum() > 790
    np.testing.assert_allclose(log.channels["imu.gyro_x"][known], 2 * log.time[known], atol=1e-6)
    np.testing.assert_allclose(log.channels["imu.angle_x"][known], 0.3, atol=1e-12)
    assert log.unknown["/battery"][-1] == 12.5
    text = " ".join(imported.remarks)
    assert "/chatter (std_msgs/String)" in text
    assert "interpolated onto these stamps: /imu" in text
    assert "/battery" in text


def test_a_trajectory_is_steps_that_the_next_one_replaces(tmp_path: Path, ros: Ros) -> None:
    names = ["a"]
    sent = [Sent("/states", ns(t), ros.joint_state(ns(t), names, [t])) for t in np.arange(0, 1, 0.01)]
    first = ros.trajectory(None, names, [(0.0, [1.0]), (0.2, [2.0]), (0.6, [3.0])])
    second = ros.trajectory(ns(0.5), names, [(0.0, [5.0]), (0.1, [6.0])])
    sent += [Sent("/trajectory", ns(0.1), first), Sent("/trajectory", ns(0.5), second)]
    sent.sort(key=lambda s: s.received)
    imported = import_log([write_bag(ros, tmp_path / "bag", sent)], told=told(ros={"clock": "receive"}))
    log = imported.log
    # the rows begin with the first command
    assert log.channels["position.a"][0] == pytest.approx(0.1)
    at = dict(zip(np.round(log.channels["position.a"], 2), log.channels["command.a"], strict=True))
    assert [at[t] for t in (0.1, 0.29, 0.3, 0.49, 0.5, 0.59, 0.6, 0.75, 0.99)] == [1, 1, 2, 2, 5, 5, 6, 6, 6]
    text = " ".join(imported.remarks)
    assert "interpolates between them" in text
    assert "0.1 s before the first command are left out" in text


@pytest.mark.parametrize("states", [True, False], ids=["with joint states", "alone"])
@pytest.mark.parametrize(
    ("sent_on", "seen", "left"),
    [("reference", "feedback", ()), ("desired", "actual", ()), ("reference", "feedback", ("desired", "actual"))],
    ids=["Humble", "Foxy", "both"],
)
@pytest.mark.parametrize("storage", ["SQLITE3", "MCAP"])
def test_a_controllers_own_state_is_the_command_and_its_type_comes_with_the_bag(
    tmp_path: Path, good: Log, storage: str, sent_on: str, seen: str, left: tuple[str, ...], states: bool
) -> None:
    """ros2_control before and after Humble; fields that are there for old readers only are empty."""
    pytest.importorskip("rosbags", reason="bags need the extra ros")
    from rosbags.typesys import get_types_from_msg

    own = Ros()
    kind = "control_msgs/msg/JointTrajectoryControllerState"
    point = "trajectory_msgs/JointTrajectoryPoint"
    fields = "".join(f"{point} {name}\n" for name in (sent_on, seen, *left))
    definition = f"std_msgs/Header header\nstring[] joint_names\n{fields}"
    own.store.register(get_types_from_msg(definition, kind))
    sent = []
    for i, t in enumerate(good.time[:100]):
        values = {c: [good.channels[f"{c}.{j}"][i] for j in GOOD_JOINTS] for c in ("command", "position")}
        points = {c: own.trajectory(None, GOOD_JOINTS, [(0.0, v)]).points[0] for c, v in values.items()}
        empty = own.trajectory(None, GOOD_JOINTS, [(0.0, [])]).points[0]
        filled = {sent_on: points["command"], seen: points["position"], **dict.fromkeys(left, empty)}
        state = own(kind, header=own.header(ns(t)), joint_names=list(GOOD_JOINTS), **filled)
        sent.append(Sent("/controller/state", ns(t), state))
        if not states:
            continue
        sent.append(Sent("/joint_states", ns(t), own.joint_state(ns(t), GOOD_JOINTS, values["position"])))
    folder = write_bag(own, tmp_path / "bag", sent, storage)
    for path in (folder, *folder.glob("*.mcap")):
        same(import_log([path]).log, good.window(0, 100), JOINT_COLUMNS)


def test_publishers_that_share_a_topic_are_put_together(tmp_path: Path, ros: Ros, good: Log) -> None:
    sent = []
    for i, t in enumerate(good.time):
        for k, joint in enumerate(GOOD_JOINTS):
            state = ros.joint_state(ns(t), [joint], [good.channels[f"position.{joint}"][i]])
            sent.append(Sent("/joint_states", ns(t) + k, state))
        command = [good.channels[f"command.{j}"][i] for j in GOOD_JOINTS]
        sent.append(Sent("/commands", ns(t), ros.array(command)))
    log = import_log([write_bag(ros, tmp_path / "bag", sent)], told=told(**ORDER)).log
    same(log, good, JOINT_COLUMNS)
    assert len(log) == len(good)


def test_clocks_that_are_not_the_same_are_not_mixed(tmp_path: Path, ros: Ros, good: Log) -> None:
    sent = []
    for one in conversation(ros, good):
        if one.topic == "/joint_states":
            simulated = one.message.header.stamp
            stamp = ros("builtin_interfaces/msg/Time", sec=simulated.sec - 1_700_000_000 + 5, nanosec=simulated.nanosec)
            one = replace(one, message=replace(one.message, header=replace(one.message.header, stamp=stamp)))
        sent.append(one)
    imported = import_log([write_bag(ros, tmp_path / "bag", sent)], told=told(**ORDER))
    same(imported.log, good, JOINT_COLUMNS)
    assert any("receipt are used for all" in r for r in imported.remarks)


Make = Callable[[Ros, list[Sent]], list[Sent]]
UNUSABLE: dict[str, tuple[Make, dict[str, Any], str]] = {
    "no commands": (lambda _, sent: [s for s in sent if "states" in s.topic], {}, "no topic with commands"),
    "no states": (lambda _, sent: [s for s in sent if "command" in s.topic], {}, "no topic with joint states"),
    "twice": (
        lambda _, sent: [*sent, *(replace(s, topic="/other") for s in sent if "states" in s.topic)],
        {},
        "both hold",
    ),
    "no stamps": (lambda _, sent: sent, {"clock": "header"}, "no header stamps on /leg/commands"),
    "absent": (lambda _, sent: sent, {"state": "/nowhere"}, "not a topic of the bag"),
    "wrong": (lambda _, sent: sent, {"command": ["/joint_states"], "state": ["/leg/commands"]}, "cannot be used there"),
    "empty": (
        lambda ros, sent: [
            replace(s, message=ros.joint_state(None, ["a"], [])) if "states" in s.topic else s for s in sent
        ],
        {},
        "no message with joint positions",
    ),
}


@pytest.mark.parametrize(("make", "rules", "said"), UNUSABLE.values(), ids=UNUSABLE)
def test_bags_that_cannot_be_used_say_why(
    tmp_path: Path, ros: Ros, good: Log, make: Make, rules: Any, said: str
) -> None:
    sent = make(ros, conversation(ros, good)[:100])
    path = write_bag(ros, tmp_path / "bag", sent)
    with pytest.raises((LogError, UsageError), match=said):
        import_log([path], told=told(ros={**ORDER["ros"], **rules}))


def test_a_clock_that_jumps_back_is_no_recording(tmp_path: Path, ros: Ros, good: Log) -> None:
    sent = conversation(ros, good)[:400]
    late = [replace(s, received=s.received + 10**10) for s in sent[:100]]
    path = write_bag(ros, tmp_path / "bag", [*sent, *late])
    with pytest.raises(LogError, match=r"jump back by 1\.99 s"):
        import_log([path], told=told(**ORDER))


@pytest.mark.parametrize("storage", ["SQLITE3", "MCAP"])
@pytest.mark.parametrize("cut", [0.3, 0.9])
def test_a_bag_that_was_cut_short_is_one_message(tmp_path: Path, ros: Ros, good: Log, storage: str, cut: float) -> None:
    folder = write_bag(ros, tmp_path / "bag", conversation(ros, good), storage)
    [file] = [p for p in folder.iterdir() if p.suffix in (".db3", ".mcap")]
    file.write_bytes(file.read_bytes()[: int(cut * file.stat().st_size)])
    for path in (folder, file):
        with pytest.raises(LogError, match="cannot be read") as caught:
            import_log([path], told=told(**ORDER))
        assert str(path) in str(caught.value)


def test_a_bag_that_was_not_closed_says_what_to_do(tmp_path: Path, ros: Ros, good: Log) -> None:
    folder = write_bag(ros, tmp_path / "bag", conversation(ros, good)[:20])
    (folder / "metadata.yaml").unlink()
    with pytest.raises(LogError, match="reindex"):
        import_log([folder])


@pytest.mark.parametrize(
    ("module", "storage", "whole"), [("rosbags", "SQLITE3", True), ("mcap", "MCAP", False), ("rosbags", "MCAP", False)]
)
def test_a_missing_package_is_named_with_its_extra(
    tmp_path: Path, ros: Ros, good: Log, monkeypatch: pytest.MonkeyPatch, module: str, storage: str, whole: bool
) -> None:
    folder = write_bag(ros, tmp_path / "bag", conversation(ros, good)[:20], storage)
    path = folder if whole else next(folder.glob("*.mcap"))
    for name in [n for n in sys.modules if n.partition(".")[0] == module]:
        monkeypatch.setitem(sys.modules, name, None)
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(UsageError, match=rf"{module}.*sysid-btr\[ros\]"):
        import_log([path], told=told(**ORDER))


def json_mcap(path: Path, log: Log, encoding: str = "json") -> Path:
    """By MCAP's own writer."""
    from mcap.writer import Writer

    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        schema = writer.register_schema("sensor_msgs/msg/JointState", "jsonschema", b"{}")
        state = writer.register_channel("/joint_states", encoding, schema)
        command = writer.register_channel("/joint_commands", encoding, schema)
        for i, t in enumerate(log.time):
            stamp = {"sec": ns(t) // 10**9, "nsec": ns(t) % 10**9}
            for channel, kind in ((command, "command"), (state, "position")):
                values = [log.channels[f"{kind}.{j}"][i] for j in GOOD_JOINTS]
                message = {"header": {"stamp": stamp}, "name": list(GOOD_JOINTS), "position": values}
                if i == 3 and kind == "position":
                    message["position"][0] = None
                writer.add_message(channel, ns(t), json.dumps(message).encode(), ns(t))
        writer.finish()
    return path


def test_a_plain_mcap_file_with_json(tmp_path: Path, good: Log) -> None:
    pytest.importorskip("mcap")
    imported = import_log([json_mcap(tmp_path / "log.mcap", good)], model=MODEL)
    assert set(imported.formats.values()) == {"mcap"}
    assert np.isnan(imported.log.channels["position.HeadYaw"][3])
    same(imported.log, good, [c for c in JOINT_COLUMNS if c != "position.HeadYaw"])


def test_an_mcap_file_in_another_encoding_is_not_silently_empty(tmp_path: Path, good: Log) -> None:
    pytest.importorskip("mcap")
    with pytest.raises(LogError, match="protobuf"):
        import_log([json_mcap(tmp_path / "log.mcap", good, "protobuf")])


def test_names_of_types_in_all_spellings() -> None:
    names = ("sensor_msgs/msg/JointState", "sensor_msgs/JointState", "sensor_msgs::msg::dds_::JointState_")
    assert {plain_type(n) for n in names} == {"sensor_msgs/JointState"}


# --- LeRobot ----------------------------------------------------------------------------------------------------


def write_lerobot(
    folder: Path, log: Log, *, scale: float = 1.0, names: Any = None, version: str = "v3.0", **info: Any
) -> Path:
    """A dataset in the published layout of v3.0, written here because LeRobot's own library needs torch."""
    features = {
        feature: {"dtype": "float32", "shape": [len(GOOD_JOINTS)], "names": names}
        for feature in ("action", "observation.state")
    }
    features["observation.images.front"] = {"dtype": "video", "shape": [480, 640, 3], "names": None}
    features["next.done"] = {"dtype": "bool", "shape": [1], "names": None}
    half = len(log) // 2
    files = {"v3.0": ["file-000", "file-001"], "v2.1": ["episode_000000", "episode_000001"]}[version]
    (folder / "data" / "chunk-000").mkdir(parents=True)
    (folder / "meta").mkdir()
    for episode, rows in enumerate((slice(0, half), slice(half, len(log)))):
        n = rows.stop - rows.start
        columns = {
            feature: pa.array(
                [scale * np.array([log.channels[f"{channel}.{j}"][i] for j in GOOD_JOINTS]) for i in range(len(log))][
                    rows
                ],
                type=pa.list_(pa.float32(), len(GOOD_JOINTS)),
            )
            for feature, channel in (("action", "command"), ("observation.state", "position"))
        }
        columns["next.done"] = pa.array(np.arange(n) == n - 1)
        columns["timestamp"] = pa.array((np.arange(n) / 100).astype(np.float32))
        columns["frame_index"] = pa.array(np.arange(n))
        columns["episode_index"] = pa.array(np.full(n, episode))
        columns["index"] = pa.array(np.arange(rows.start, rows.stop))
        columns["task_index"] = pa.array(np.zeros(n, dtype=np.int64))
        pq.write_table(pa.table(columns), folder / "data" / "chunk-000" / f"{files[episode]}.parquet")
    content = {"codebase_version": version, "robot_type": "toy", "fps": 100, "features": features, **info}
    (folder / "meta" / "info.json").write_text(json.dumps(content))
    return folder


LEROBOT_NAMES = [f"{j}.pos" for j in GOOD_JOINTS]


@pytest.mark.parametrize(("names", "version"), [(LEROBOT_NAMES, "v3.0"), ({"motors": list(GOOD_JOINTS)}, "v2.1")])
def test_a_lerobot_dataset(tmp_path: Path, good: Log, names: Any, version: str) -> None:
    folder = write_lerobot(tmp_path / "set", good, names=names, version=version)
    imported = import_log([folder], model=MODEL)
    log = imported.log
    assert set(imported.formats.values()) == {"lerobot"}
    assert imported.usable, imported.problems
    same(log, good, JOINT_COLUMNS, atol=1e-6)  # float32
    assert [rows.stop - rows.start for rows in log.episodes()] == [400, 400]
    assert log.meta.sample_period == 0.01
    np.testing.assert_allclose(np.diff(log.time[:400]), 0.01, atol=1e-12)
    assert {"next.done", "task_index"} == set(log.unknown)
    text = " ".join(imported.remarks)
    assert "observation.images.front" in text
    assert "states no units" in text
    one = import_log([folder], told=told(lerobot={"episodes": [1]})).log
    assert len(one) == 400


def test_a_table_out_of_a_dataset_names_the_dataset(tmp_path: Path, good: Log) -> None:
    folder = write_lerobot(tmp_path / "set", good, names=LEROBOT_NAMES)
    with pytest.raises(LogError, match="part of the LeRobot dataset"):
        import_log([next(folder.rglob("*.parquet"))])


def test_lerobots_actions_on_something_else_are_kept_and_told(tmp_path: Path, good: Log) -> None:
    names = [*LEROBOT_NAMES[:4], "x.vel"]
    imported = import_log([write_lerobot(tmp_path / "set", good, names=names)])
    assert imported.log.joints("command") == GOOD_JOINTS[:4]
    assert imported.log.joints("velocity") == ("x",)
    assert "action.x.vel" in imported.log.unknown
    assert any("action.x.vel" in r for r in imported.remarks)


def test_lerobots_units_are_told_by_flag(tmp_path: Path, good: Log) -> None:
    folder = write_lerobot(tmp_path / "set", good, scale=180 / math.pi, names=LEROBOT_NAMES)
    wrong = import_log([folder], model=MODEL)
    assert not wrong.usable
    assert "--unit position=deg" in wrong.advice
    rules = with_flags(ImportMap(), units=[("position", "deg"), ("command", "deg")])
    same(import_log([folder], told=rules, model=MODEL).log, good, JOINT_COLUMNS, atol=1e-5)


def test_lerobots_normalised_positions_need_the_calibrated_range(tmp_path: Path, good: Log) -> None:
    folder = write_lerobot(tmp_path / "set", good, scale=100.0, names=LEROBOT_NAMES)
    rules: dict[str, Any] = {"units": {"position": "range_m100_100", "command": "range_m100_100"}}
    with pytest.raises(LogError, match="range = ") as caught:
        import_log([folder], told=told(**rules))
    assert all(joint in str(caught.value) for joint in GOOD_JOINTS)
    rules["joints"] = {joint: {"range": [-1.0, 1.0]} for joint in GOOD_JOINTS}
    same(import_log([folder], told=told(**rules)).log, good, JOINT_COLUMNS, atol=1e-6)


def test_lerobot_entries_without_names(tmp_path: Path, good: Log) -> None:
    folder = write_lerobot(tmp_path / "set", good)
    with pytest.raises(MappingNeeded, match=r"5 entries of observation\.state have no names") as caught:
        import_log([folder])
    assert "[lerobot]" in caught.value.propose(GOOD_JOINTS)
    log = import_log([folder], told=told(lerobot={"joints": list(GOOD_JOINTS)})).log
    same(log, good, JOINT_COLUMNS, atol=1e-6)


@pytest.mark.parametrize(
    ("break_", "said"),
    [
        (lambda f: (f / "meta" / "info.json").write_text("{"), "info.json"),
        (lambda f: (f / "meta" / "info.json").write_text("{}"), "needs `fps`"),
        (lambda f: (f / "meta" / "info.json").write_text('{"fps": 30, "features": {"action": {}}}'), "no feature obs"),
        (lambda f: [p.unlink() for p in f.rglob("*.parquet")], "no Parquet file"),
        (lambda f: next(f.rglob("*.parquet")).write_bytes(b"PAR1cut"), "footer"),
    ],
    ids=["json", "empty", "features", "data", "cut"],
)
def test_a_broken_dataset_is_told(tmp_path: Path, good: Log, break_: Callable[[Path], Any], said: str) -> None:
    folder = write_lerobot(tmp_path / "set", good, names=LEROBOT_NAMES)
    break_(folder)
    with pytest.raises(LogError, match=said):
        import_log([folder])


# --- registry ---------------------------------------------------------------------------------------------------


def written(kind: str, tmp_path: Path, good: Log) -> tuple[Path, ImportMap]:
    """A source of a format, and what has to be said about it."""
    if kind in ("ros2", "ros2 file"):
        folder = write_bag(Ros(), tmp_path / "bag", conversation(Ros(), good))
        return (folder if kind == "ros2" else next(folder.glob("*.db3"))), told(**ORDER)
    if kind == "mcap":
        return json_mcap(tmp_path / "log.mcap", good), told()
    if kind == "lerobot":
        return write_lerobot(tmp_path / "set", good, names=LEROBOT_NAMES), told()
    frame = nao_frame(good) if kind == "naoqi" else plain_frame(good)
    path = tmp_path / ("log.parquet" if kind == "parquet" else "log.csv")
    if kind == "parquet":
        frame.to_parquet(path)
    else:
        frame.to_csv(path, index=False)
    return path, told()


@pytest.mark.parametrize("kind", ["naoqi", "ros2", "ros2 file", "mcap", "lerobot", "csv", "parquet"])
def test_every_importer_keeps_the_contract(tmp_path: Path, good: Log, kind: str) -> None:
    pytest.importorskip("rosbags")
    source, said = written(kind, tmp_path, good)
    check_importer(recognise(source), source, said)


def test_one_that_cannot_be_loaded_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    from importlib.metadata import EntryPoint

    entry = EntryPoint("diary", "nowhere_at_all:Diary", ENTRY_POINTS)
    monkeypatch.setattr("importlib.metadata.entry_points", lambda *, group: [entry] if group == ENTRY_POINTS else [])
    with pytest.raises(UsageError, match="nowhere_at_all"):
        get_importer("diary")


def test_an_unknown_format_says_what_there_is() -> None:
    with pytest.raises(UsageError, match=r"Did you mean 'naoqi'.*lerobot"):
        get_importer("naoki")


def test_a_folder_of_nothing_known_is_told(tmp_path: Path) -> None:
    (tmp_path / "x.txt").write_text("x")
    with pytest.raises(LogError, match=r"holds x\.txt"):
        recognise(tmp_path)


def test_every_kind_of_column_has_a_unit() -> None:
    from sysid_btr.io.log import CHANNELS, IMU_NAMES

    kinds = {c for c in CHANNELS if c != "imu"} | {f"imu.{n.partition('_')[0]}" for n in IMU_NAMES} | {"time"}
    assert set(SI) == kinds


def test_what_is_imported_stays_good(good: Log) -> None:
    assert validate_log(good) == ()
