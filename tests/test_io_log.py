"""Logs in memory and on disk."""

from __future__ import annotations

import json
import pickle
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from sysid_btr.errors import LogError, UsageError
from sysid_btr.io import Log, LogMeta, read_log, sha256, write_log
from sysid_btr.io.split import split_episodes


def assert_same(a: Log, b: Log) -> None:
    assert a.meta == b.meta
    assert list(a.channels) == list(b.channels)
    np.testing.assert_array_equal(a.time, b.time)
    np.testing.assert_array_equal(a.episode, b.episode)
    for name, values in a.channels.items():
        np.testing.assert_array_equal(values, b.channels[name], err_msg=name)
    assert list(a.unknown) == list(b.unknown)
    for name, values in a.unknown.items():
        assert b.unknown[name].dtype == values.dtype
        np.testing.assert_array_equal(values, b.unknown[name], err_msg=name)


def test_joints_are_listed_in_column_order(good_log: Log) -> None:
    assert good_log.joints("command") == ("HeadYaw", "LKneePitch", "RKneePitch", "LHipRoll", "RHipRoll")
    assert good_log.joints("imu") == ("angle_x", "gyro_x", "acc_x", "acc_y", "acc_z")
    assert good_log.joints("duty") == ()
    assert good_log.has("position", "HeadYaw")
    assert not good_log.has("position", "Head")


def test_array_follows_the_names_asked_for(good_log: Log) -> None:
    matrix = good_log.array("position", ["RKneePitch", "HeadYaw"])
    assert matrix.shape == (len(good_log), 2)
    np.testing.assert_array_equal(matrix[:, 0], good_log.channels["position.RKneePitch"])
    np.testing.assert_array_equal(matrix[:, 1], good_log.channels["position.HeadYaw"])
    assert good_log.array("position", []).shape == (len(good_log), 0)


def test_array_of_a_missing_joint_lists_what_there_is(good_log: Log) -> None:
    with pytest.raises(LogError, match=r"no position for HeadYaww \(did you mean HeadYaw\?\).*RHipRoll"):
        good_log.array("position", ["HeadYaww"])


def test_window_cuts_every_column(good_log: Log) -> None:
    log = replace(good_log, unknown={"note": np.arange(len(good_log))})
    part = log.window(10, 15)
    assert len(part) == 5
    np.testing.assert_array_equal(part.time, log.time[10:15])
    np.testing.assert_array_equal(part.unknown["note"], [10, 11, 12, 13, 14])


def test_columns_of_another_length_are_refused(good_log: Log) -> None:
    with pytest.raises(LogError, match=r"command\.HeadYaw \(3,\)"):
        replace(good_log, channels={"command.HeadYaw": np.zeros(3)})


def test_what_is_found_of_an_episode_is_found_once(good_log: Log) -> None:
    first, again = split_episodes(good_log), split_episodes(good_log)
    assert all(one is other for one, other in zip(first, again, strict=True))
    sought: list[int] = []
    for (episode,) in (first, again):
        episode.once(("test",), lambda: sought.append(1))
    assert sought == [1]
    # what is found goes neither into another process nor into a log that is made of this one
    other: Log = pickle.loads(pickle.dumps(good_log))
    for elsewhere in (other, good_log.window(0, len(good_log))):
        assert split_episodes(elsewhere)[0] is not first[0]


def test_episodes_are_runs_of_the_number(good_log: Log) -> None:
    log = replace(good_log.window(0, 6), episode=np.array([4, 4, 4, 7, 7, 1]))
    assert log.episodes() == (slice(0, 3), slice(3, 5), slice(5, 6))
    assert good_log.window(0, 0).episodes() == ()


def test_round_trip_keeps_everything(good_log: Log, tmp_path: Path) -> None:
    n = len(good_log)
    odd = np.empty(n, dtype=object)
    odd[:] = [None if i % 3 else f"state {i}" for i in range(n)]
    counts = np.empty(n, dtype=object)
    counts[:] = [None if i == 5 else i for i in range(n)]
    nested = np.empty(n, dtype=object)
    nested[:] = [{"x": [i, i + 1]} for i in range(n)]
    log = replace(
        good_log,
        time=good_log.time + 1000.0,
        channels={
            **good_log.channels,
            "enabled.HeadYaw": np.where(np.arange(n) < 50, 0.0, 1.0),
            "current.HeadYaw": np.where(np.arange(n) == 7, np.nan, 0.1),
        },
        episode=np.arange(n) // 100,
        unknown={
            "state": odd,
            "count": counts,
            "nested": nested,
            "flag": np.arange(n) % 2 == 0,
            "tick": np.arange(n, dtype=np.int32),
            "half": np.linspace(0, 1, n).astype(np.float32),
            "wall": np.datetime64("2020-01-01", "us") + np.arange(n),
        },
        meta=LogMeta(
            robot="nao",
            mount="free",
            sample_period=0.01,
            source="measured",
            command_hold="linear",
            servo_period=0.001,
            units={"position": "rad"},
            notes="ü",
            extra={"servo": {"kp": 100}, "list": [1, None]},
        ),
    )
    path = tmp_path / "a.parquet"
    write_log(log, path)
    back = read_log(path, check=False)
    assert_same(log, back)
    assert back.path == path
    assert pq.read_schema(path).field("enabled.HeadYaw").type == pa.bool_()
    write_log(back, tmp_path / "b.parquet")
    assert sha256(path) == sha256(tmp_path / "b.parquet")


@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data(), n=st.integers(1, 20))
def test_round_trip_of_any_numbers(data: st.DataObject, n: int, tmp_path: Path) -> None:
    numbers = hnp.arrays(np.float64, n, elements=st.floats(width=64))
    names = data.draw(st.lists(st.text("abcXYZ_ ü", min_size=1, max_size=8), max_size=3, unique=True))
    log = Log(
        time=data.draw(numbers),
        channels={f"position.{name}": data.draw(numbers) for name in names},
        meta=LogMeta(extra=data.draw(st.dictionaries(st.sampled_from(["k1", "k2"]), st.integers()))),
        episode=data.draw(hnp.arrays(np.int64, n, elements=st.integers(0, 5))),
    )
    write_log(log, tmp_path / "any.parquet", overwrite=True)
    assert_same(log, read_log(tmp_path / "any.parquet", check=False))


def test_existing_files_are_not_overwritten(good_log: Log, tmp_path: Path) -> None:
    path = tmp_path / "a.parquet"
    path.write_text("precious")
    with pytest.raises(UsageError, match="exists and is not overwritten"):
        write_log(good_log, path)
    assert path.read_text() == "precious"
    write_log(good_log, path, overwrite=True)
    assert len(read_log(path)) == len(good_log)
    assert [p.name for p in tmp_path.iterdir()] == ["a.parquet"]


def test_a_failed_write_leaves_what_was_there(good_log: Log, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "a.parquet"
    path.write_text("precious")

    def full(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(pq, "write_table", full)
    with pytest.raises(UsageError, match="No space left"):
        write_log(good_log, path, overwrite=True)
    assert path.read_text() == "precious"
    assert [p.name for p in tmp_path.iterdir()] == ["a.parquet"]


def test_a_missing_folder_is_named(good_log: Log, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="does not exist"):
        write_log(good_log, tmp_path / "no" / "a.parquet")


def test_values_parquet_cannot_hold_are_refused(good_log: Log, tmp_path: Path) -> None:
    strange = np.empty(len(good_log), dtype=object)
    strange[:] = [object()] * len(good_log)
    with pytest.raises(LogError, match="column strange"):
        write_log(replace(good_log, unknown={"strange": strange}), tmp_path / "a.parquet")
    assert not list(tmp_path.iterdir())


def test_integers_booleans_and_nulls_are_read_as_numbers(tmp_path: Path) -> None:
    table = pa.table(
        {
            "time": pa.array([0, 1, 2], pa.int64()),
            "position.a": pa.array([1, None, 3], pa.int32()),
            "enabled.a": pa.array([True, None, False]),
            "command.a": pa.array([1.5, 2.5, 3.5], pa.float32()),
        }
    )
    path = tmp_path / "a.parquet"
    pq.write_table(table.replace_schema_metadata({"sysid_btr": json.dumps({"schema": 1})}), path)
    log = read_log(path, check=False)
    assert log.time.dtype == np.float64
    np.testing.assert_array_equal(log.channels["position.a"], [1, np.nan, 3])
    np.testing.assert_array_equal(log.channels["enabled.a"], [1, np.nan, 0])
    np.testing.assert_array_equal(log.channels["command.a"], [1.5, 2.5, 3.5])


def test_read_log_lists_all_errors_at_once(good_log: Log, tmp_path: Path) -> None:
    channels = dict(good_log.channels)
    channels["position.HeadYaw"] = np.full(len(good_log), np.nan)
    channels["command.LHipRoll"] = np.degrees(channels["command.LHipRoll"])
    time = good_log.time.copy()
    time[5] = time[4]
    path = tmp_path / "bad.parquet"
    write_log(replace(good_log, time=time, channels=channels), path)
    with pytest.raises(LogError) as caught:
        read_log(path)
    text = str(caught.value)
    assert text.startswith(f"{path} cannot be used: 3 problems")
    for code in ("time.duplicate", "values.all_missing", "units.degrees"):
        assert code in text
    assert caught.value.exit_code == 3
    assert len(read_log(path, check=False)) == len(good_log)


def test_sha256_of_a_missing_file(tmp_path: Path) -> None:
    with pytest.raises(LogError, match="cannot read"):
        sha256(tmp_path / "none.parquet")


def test_units_are_looked_up_by_column_then_channel() -> None:
    meta = LogMeta(units={"position": "rad", "position.slider": "m", "imu.gyro": "rad/s"})
    assert meta.unit("position.slider") == "m"
    assert meta.unit("position.slider_two") == "rad"
    assert meta.unit("imu.gyro_x") == "rad/s"
    assert meta.unit("imu.acc_x") is None
