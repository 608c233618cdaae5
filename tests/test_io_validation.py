"""Validation: every fault is found, placed and explained; good logs pass without a word."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from sysid_btr.io import Log, LogMeta, Problem, read_log, validate_file, write_log

JOINTS = ("HeadYaw", "LKneePitch", "RKneePitch", "LHipRoll", "RHipRoll")
META = {"schema": 1, "robot": "toy", "mount": "free", "sample_period": 0.01}


@pytest.fixture
def check(tmp_path: Path) -> Callable[..., tuple[Problem, ...]]:
    """Problems of a log once it is written to a file; that made-up signals have no noise is none of them."""

    def run(log: Log, **options: object) -> tuple[Problem, ...]:
        path = tmp_path / "log.parquet"
        write_log(log, path, overwrite=True)
        found = validate_file(path, **options)  # type: ignore[arg-type]
        return tuple(problem for problem in found if problem.code != "noise.filtered")

    return run


def only(problems: Sequence[Problem], code: str, severity: str = "error") -> Problem:
    """The one problem there is; it must be of this kind and say what to do."""
    assert [(p.code, p.severity) for p in problems] == [(code, severity)], "\n".join(map(str, problems))
    assert problems[0].where
    assert problems[0].message
    assert problems[0].remedy
    return problems[0]


def change(log: Log, **columns: np.ndarray | None) -> Log:
    channels = dict(log.channels)
    for key, values in columns.items():
        name = key.replace("__", ".", 1)
        if values is None:
            del channels[name]
        else:
            channels[name] = values
    return replace(log, channels=channels)


def rename(log: Log, **columns: str) -> Log:
    """Rename channels; names outside the schema become unknown columns, as when they are read."""
    names = {key.replace("__", ".", 1): new for key, new in columns.items()}
    return replace(log, channels={names.get(name, name): values for name, values in log.channels.items()})


def write_raw(path: Path, columns: dict[str, object], meta: object = META) -> Path:
    table = pa.table(columns)
    if meta is not None:
        table = table.replace_schema_metadata({"sysid_btr": meta if isinstance(meta, bytes) else json.dumps(meta)})
    pq.write_table(table, path)
    return path


def raw_columns(log: Log) -> dict[str, object]:
    return {"time": log.time, **log.channels}


# --- good logs ----------------------------------------------------------------------------------------------


def test_a_good_log_has_no_problem(good_log: Log, check) -> None:
    assert check(good_log) == ()
    ranges = dict.fromkeys(JOINTS, (-0.6, 0.6))
    assert check(good_log, joints=JOINTS, ranges=ranges) == ()


def test_any_origin_and_an_uneven_clock_are_fine(good_log: Log, check) -> None:
    rng = np.random.default_rng(1)
    uneven = good_log.time + rng.uniform(-0.003, 0.003, len(good_log))
    assert check(replace(good_log, time=uneven + 1000.0)) == ()
    assert check(replace(good_log, time=good_log.time + 1.7e9)) == ()


def test_episodes_may_restart_or_jump_the_clock(good_log: Log, check) -> None:
    episode = np.repeat([0, 1], 400)
    assert check(replace(good_log, episode=episode, time=np.where(episode, good_log.time - 4, good_log.time))) == ()
    assert check(replace(good_log, episode=episode, time=np.where(episode, good_log.time + 60, good_log.time))) == ()


def test_unknown_columns_are_no_problem(good_log: Log, check) -> None:
    n = len(good_log)
    extra = {"comment": np.array(["x"] * n), "score.total": np.zeros(n), "__index_level_0__": np.arange(n)}
    assert check(replace(good_log, unknown=extra)) == ()


def test_recorded_logs_raise_no_false_alarm(shared_data: Path) -> None:
    paths = sorted(shared_data.glob("*/*.parquet"))
    assert len(paths) >= 20
    found = {str(path): [p for p in validate_file(path) if p.severity != "note"] for path in paths}
    assert {path: problems for path, problems in found.items() if problems} == {}


def test_recorded_logs_fit_their_model(shared_data: Path) -> None:
    import mujoco

    for folder, model in (("nao_gantry", "nominal.xml"), ("nao_walk", "nominal_free.xml")):
        loaded = mujoco.MjModel.from_xml_path(str(shared_data / folder / model))
        hinges = [loaded.joint(i) for i in range(loaded.njnt) if loaded.jnt_type[i] != mujoco.mjtJoint.mjJNT_FREE]
        ranges = {j.name: (float(j.range[0]), float(j.range[1])) for j in hinges if loaded.jnt_limited[j.id]}
        for path in sorted((shared_data / folder).glob("*.parquet")):
            assert validate_file(path, joints=[j.name for j in hinges], ranges=ranges) == (), path


# --- the file -----------------------------------------------------------------------------------------------


def test_missing_folder_and_empty_file(tmp_path: Path) -> None:
    only(validate_file(tmp_path / "none.parquet"), "file.missing")
    only(validate_file(tmp_path), "file.not_a_file")
    (tmp_path / "empty.parquet").touch()
    only(validate_file(tmp_path / "empty.parquet"), "file.empty")


def test_truncated(good_log: Log, tmp_path: Path) -> None:
    path = tmp_path / "a.parquet"
    write_log(good_log, path)
    whole = path.read_bytes()
    for size in (4, 20, len(whole) // 2, len(whole) - 1):
        path.write_bytes(whole[:size])
        only(validate_file(path), "file.truncated")


def test_damaged_in_the_middle(good_log: Log, tmp_path: Path) -> None:
    path = tmp_path / "a.parquet"
    write_log(good_log, path)
    whole = bytearray(path.read_bytes())
    footer = int.from_bytes(whole[-8:-4], "little")
    whole[-8 - footer : -8] = b"\xff" * footer
    path.write_bytes(bytes(whole))
    only(validate_file(path), "file.corrupt")


@pytest.mark.parametrize(
    ("content", "kind"),
    [
        (b"time,position.a\n0,1\n", "text or CSV"),
        (b"\x89HDF\r\n\x1a\n" + b"\0" * 20, "HDF5"),
        (b"PK\x03\x04" + b"\0" * 20, "zip"),
        (b"\xff\xfe\0\0" * 10, "something else"),
    ],
)
def test_not_parquet(tmp_path: Path, content: bytes, kind: str) -> None:
    path = tmp_path / "a.parquet"
    path.write_bytes(content)
    problem = only(validate_file(path), "file.not_parquet")
    assert kind in problem.message
    assert "sysid-btr import" in problem.remedy


def test_no_samples(good_log: Log, check) -> None:
    only(check(good_log.window(0, 0)), "log.empty")


def test_too_few_samples(good_log: Log, check) -> None:
    assert "log.short" in {p.code for p in check(good_log.window(0, 2))}


# --- metadata -----------------------------------------------------------------------------------------------


def test_no_metadata(good_log: Log, tmp_path: Path) -> None:
    only(validate_file(write_raw(tmp_path / "a.parquet", raw_columns(good_log), None)), "meta.missing")


@pytest.mark.parametrize("meta", [b"{", b"[1]", b"\xff\xfe"])
def test_metadata_that_is_no_json_object(good_log: Log, tmp_path: Path, meta: bytes) -> None:
    only(validate_file(write_raw(tmp_path / "a.parquet", raw_columns(good_log), meta)), "meta.json")


@pytest.mark.parametrize("version", [2, 0, "1", None, True, 1.5])
def test_wrong_schema_version(good_log: Log, tmp_path: Path, version: object) -> None:
    path = write_raw(tmp_path / "a.parquet", raw_columns(good_log), {**META, "schema": version})
    problem = only(validate_file(path), "meta.schema")
    assert "this release reads version 1" in problem.message
    assert ("update" in problem.remedy) == (version == 2)


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("mount", "floating"),
        ("mount", ["fixed"]),
        ("command_hold", "cubic"),
        ("sample_period", 0),
        ("sample_period", "10 ms"),
        ("servo_period", -1),
        ("robot", 7),
        ("units", ["rad"]),
    ],
)
def test_metadata_values(good_log: Log, tmp_path: Path, key: str, value: object) -> None:
    path = write_raw(tmp_path / "a.parquet", raw_columns(good_log), {**META, key: value})
    problems = validate_file(path)
    problem = only([p for p in problems if p.severity == "error"], f"meta.{key}")
    assert key in problem.where
    assert json.dumps(value) in problem.message


def test_metadata_key_with_a_typo(good_log: Log, check) -> None:
    log = replace(good_log, meta=LogMeta(mount="free", extra={"sample_perod": 0.01, "operator": "me"}))
    problem = only(check(log), "meta.unknown_key", "warning")
    assert "did you mean `sample_period`?" in problem.message


@pytest.mark.parametrize(
    ("key", "unit", "remedy"),
    [
        ("position", "deg", "pi/180"),
        ("velocity", "rpm", "2*pi/60"),
        ("position.HeadYaw", "mm", "divide by 1000"),
        ("imu.acc", "g", "9.80665"),
        ("current", "mA", "divide by 1000"),
        ("time", "ms", "divide by 1000"),
        ("effort", "furlong", "convert"),
    ],
)
def test_wrong_units_in_metadata(good_log: Log, check, key: str, unit: str, remedy: str) -> None:
    problem = only(check(replace(good_log, meta=replace(good_log.meta, units={key: unit}))), "meta.unit")
    assert key in problem.where
    assert unit in problem.message
    assert remedy in problem.remedy


def test_right_units_in_many_spellings(good_log: Log, check) -> None:
    units = {
        "position": "radians",
        "effort": "N·m",
        "imu.acc": "m/s²",
        "imu.gyro": "rad / s",
        "temperature": "degC",
        "duty": "1",
        "time": "s",
    }
    assert check(replace(good_log, meta=replace(good_log.meta, units=units))) == ()


def test_unit_of_nothing(good_log: Log, check) -> None:
    log = replace(good_log, meta=replace(good_log.meta, units={"postion": "rad"}))
    assert "did you mean `position`?" in only(check(log), "meta.units_key", "warning").message


# --- columns ------------------------------------------------------------------------------------------------


def test_misspelled_channel(good_log: Log, check) -> None:
    problem = only(check(rename(good_log, position__LKneePitch="postion.LKneePitch")), "column.misspelled")
    assert problem.where == "postion.LKneePitch"
    assert "did you mean position.LKneePitch?" in problem.message


@pytest.mark.parametrize("wrong", ["Position.LKneePitch", "positions.LKneePitch", "position_LKneePitch"])
def test_channel_in_another_spelling(good_log: Log, check, wrong: str) -> None:
    problems = check(rename(good_log, position__LKneePitch=wrong))
    assert "position.LKneePitch" in only(problems, "column.misspelled").message


def test_misspelled_imu_axis(good_log: Log, check) -> None:
    problem = only(check(rename(good_log, imu__gyro_x="imu.gyroX")), "column.misspelled")
    assert "did you mean imu.gyro_x?" in problem.message


def test_misspelled_joint(good_log: Log, check) -> None:
    log = rename(good_log, position__LKneePitch="position.LKneePich")
    problem = only([p for p in check(log) if p.severity == "error"], "joint.misspelled")
    assert "LKneePich" in problem.where
    assert "LKneePitch" in problem.where


def test_left_and_right_are_not_a_spelling_mistake(good_log: Log, check) -> None:
    log = change(good_log, position__LKneePitch=None, command__RKneePitch=None)
    assert {(p.code, p.severity) for p in check(log)} == {
        ("position.missing", "warning"),
        ("command.missing", "warning"),
    }


def test_a_channel_the_schema_does_not_have(good_log: Log, check) -> None:
    log = replace(good_log, unknown={f"setpoint.{joint}": good_log.time for joint in JOINTS})
    problem = only(check(log), "column.unknown_channel", "warning")
    assert all(joint in problem.where for joint in JOINTS)


def test_command_without_position(good_log: Log, check) -> None:
    log = change(good_log, position__HeadYaw=None)
    assert "HeadYaw" in only(check(log), "position.missing", "warning").where


def test_position_without_command(good_log: Log, check) -> None:
    log = change(good_log, command__HeadYaw=None)
    assert "HeadYaw" in only(check(log), "command.missing", "warning").where


@pytest.mark.parametrize("channel", ["command", "position"])
def test_no_column_of_a_channel_at_all(good_log: Log, check, channel: str) -> None:
    kept = {name: values for name, values in good_log.channels.items() if not name.startswith(f"{channel}.")}
    only(check(replace(good_log, channels=kept)), f"{channel}.missing")


def test_joint_missing_from_the_log(good_log: Log, check) -> None:
    problem = only(check(good_log, joints=[*JOINTS, "Tail", "Ear"]), "joint.unlogged", "note")
    assert problem.where == "Tail, Ear"


def test_no_joint_of_the_model_in_the_log(good_log: Log, check) -> None:
    problem = [p for p in check(good_log, joints=["Tail", "Ear"]) if p.severity == "error"]
    assert [p.code for p in problem] == ["joint.missing"]
    assert "HeadYaw" in problem[0].message


def test_joint_unknown_to_the_model(good_log: Log, check) -> None:
    problem = only(check(good_log, joints=JOINTS[1:]), "joint.unknown", "warning")
    assert problem.where == "HeadYaw"


def test_joint_spelled_otherwise_in_the_model(good_log: Log, check) -> None:
    problem = only(check(good_log, joints=["head_yaw", *JOINTS[1:]]), "joint.misspelled")
    assert "did you mean head_yaw?" in problem.message


def test_joint_and_column_misspelled_are_told_apart(good_log: Log, check) -> None:
    log = rename(good_log, position__LKneePitch="postion.LKneePitch")
    only(check(log, joints=JOINTS), "column.misspelled")


def test_column_of_text(good_log: Log, tmp_path: Path) -> None:
    columns = {**raw_columns(good_log), "effort.HeadYaw": ["1.5"] * len(good_log)}
    problem = only(validate_file(write_raw(tmp_path / "a.parquet", columns)), "column.not_numeric")
    assert "effort.HeadYaw (string)" in problem.where


def test_column_twice(good_log: Log, tmp_path: Path) -> None:
    columns = raw_columns(good_log)
    table = pa.Table.from_arrays(
        [pa.array(v) for v in (*columns.values(), good_log.time)], names=[*columns, "position.HeadYaw"]
    )
    path = tmp_path / "a.parquet"
    pq.write_table(table.replace_schema_metadata({"sysid_btr": json.dumps(META)}), path)
    assert only(validate_file(path), "column.duplicate").where == "position.HeadYaw"


# --- time ---------------------------------------------------------------------------------------------------


def test_time_column_missing_or_named_otherwise(good_log: Log, tmp_path: Path) -> None:
    for name in ("Time", "timestamp", "t"):
        columns = {name: good_log.time, **good_log.channels}
        problem = only(validate_file(write_raw(tmp_path / "a.parquet", columns)), "time.missing")
        assert f"is `{name}` the time?" in problem.message


def test_time_of_another_type(good_log: Log, tmp_path: Path) -> None:
    path = write_raw(tmp_path / "a.parquet", {"time": [f"{t} s" for t in good_log.time], **good_log.channels})
    assert "string" in only(validate_file(path), "time.type").message


@pytest.mark.parametrize(("unit", "tick"), [("ms", 1e-3), ("us", 1e-6), ("ns", 1e-9)])
@pytest.mark.parametrize("dated", [True, False])
def test_a_clock_that_counts_in_whole_units_is_read(
    good_log: Log, tmp_path: Path, unit: str, tick: float, dated: bool
) -> None:
    stamps = np.datetime64("2026-01-01", unit) + np.round(good_log.time / tick).astype(np.int64)
    ticks = stamps if dated else stamps.astype(np.int64)
    path = write_raw(tmp_path / "a.parquet", {"time": ticks, **good_log.channels})
    log = read_log(path)
    np.testing.assert_allclose(log.time, good_log.time - good_log.time[0], atol=1e-9)


def test_time_backwards(good_log: Log, check) -> None:
    time = good_log.time.copy()
    time[300:] -= 1.0
    problem = only(check(replace(good_log, time=time)), "time.backwards")
    assert "sample 300 (2 s)" in problem.where
    assert "0.99 s" in problem.message


def test_time_duplicate(good_log: Log, check) -> None:
    time = good_log.time.copy()
    time[[10, 20]] = time[[9, 19]]
    problem = only(check(replace(good_log, time=time)), "time.duplicate")
    assert "sample 10 (0.09 s)" in problem.where
    assert "2 samples" in problem.message


def test_time_rounded_to_float32(good_log: Log, check) -> None:
    time = (good_log.time + 1.7e5).astype(np.float32).astype(np.float64)
    codes = {p.code: p for p in check(replace(good_log, time=time))}
    assert "rounded" in codes["time.duplicate"].message


def test_time_nan(good_log: Log, check) -> None:
    time = good_log.time.copy()
    time[50:53] = np.nan
    problem = only(check(replace(good_log, time=time)), "time.nan")
    assert "samples 50-52" in problem.where


@pytest.mark.parametrize(("factor", "unit"), [(1e3, "milliseconds"), (1e6, "microseconds"), (1e9, "nanoseconds")])
def test_time_in_another_unit(good_log: Log, check, factor: float, unit: str) -> None:
    problem = next(p for p in check(replace(good_log, time=good_log.time * factor)) if p.code == "time.unit")
    assert problem.severity == "error"
    assert unit in problem.message


def test_gap(good_log: Log, check) -> None:
    keep = np.r_[0:200, 260:500, 520:800]
    log = replace(
        good_log,
        time=good_log.time[keep],
        channels={name: values[keep] for name, values in good_log.channels.items()},
        episode=good_log.episode[keep],
    )
    problem = only(check(log), "time.gap", "warning")
    assert "2 gaps" in problem.message
    assert "80 samples are missing" in problem.message
    assert "samples 199-200 (1.99-2.6 s)" in problem.where


def test_jitter(good_log: Log, check) -> None:
    bursts = good_log.time.copy()
    bursts[1::2] -= 0.009
    problem = only(
        [p for p in check(replace(good_log, time=bursts)) if p.code != "time.period"], "time.jitter", "warning"
    )
    assert "uneven" in problem.message


def test_period_not_as_declared(good_log: Log, check) -> None:
    log = replace(good_log, meta=replace(good_log.meta, sample_period=0.02))
    only(check(log), "time.period", "warning")


def test_rows_of_episodes_mixed(good_log: Log, check) -> None:
    problem = only(check(replace(good_log, episode=np.repeat([0, 1, 0, 2], 200))), "episode.scattered")
    assert "episode 0 appears again" in problem.message


def test_episode_not_whole(good_log: Log, tmp_path: Path) -> None:
    columns = {**raw_columns(good_log), "episode": np.linspace(0, 1, len(good_log))}
    only(validate_file(write_raw(tmp_path / "a.parquet", columns)), "episode.type")


# --- values -------------------------------------------------------------------------------------------------


def test_some_nan(good_log: Log, check) -> None:
    position = good_log.channels["position.HeadYaw"].copy()
    position[100:120] = np.nan
    problem = only(check(change(good_log, position__HeadYaw=position)), "values.missing", "warning")
    assert "position.HeadYaw" in problem.where
    assert "samples 100-119 (1-1.19 s)" in problem.where


def test_mostly_nan(good_log: Log, check) -> None:
    position = good_log.channels["position.HeadYaw"].copy()
    position[100:] = np.nan
    only(check(change(good_log, position__HeadYaw=position)), "values.mostly_missing")


def test_all_nan(good_log: Log, check) -> None:
    empty = np.full(len(good_log), np.nan)
    problem = only(check(change(good_log, position__HeadYaw=empty, position__LHipRoll=empty)), "values.all_missing")
    assert problem.where == "position of HeadYaw, LHipRoll"


def test_infinite(good_log: Log, check) -> None:
    position = good_log.channels["position.HeadYaw"].copy()
    position[[7, 8]] = np.inf, -np.inf
    problem = only(check(change(good_log, position__HeadYaw=position)), "values.infinite")
    assert "samples 7-8" in problem.where


def test_absurd(good_log: Log, check) -> None:
    position = good_log.channels["position.HeadYaw"].copy()
    position[7] = 1e300
    problem = only(check(change(good_log, position__HeadYaw=position)), "values.absurd")
    assert "sample 7" in problem.where


# --- motion -------------------------------------------------------------------------------------------------


def test_dead_position_while_its_command_moves(good_log: Log, check) -> None:
    log = change(good_log, position__HeadYaw=np.full(len(good_log), 0.1), velocity__HeadYaw=None)
    assert only(check(log), "position.stuck").where == "position.HeadYaw"


def test_dead_joint_with_a_dead_command_is_fine(good_log: Log, check) -> None:
    still = np.zeros(len(good_log))
    assert check(change(good_log, position__HeadYaw=still, command__HeadYaw=still, velocity__HeadYaw=still)) == ()


def test_a_servo_switched_off_may_stay(good_log: Log, check) -> None:
    n = len(good_log)
    log = change(
        good_log, position__HeadYaw=np.full(n, 0.1), velocity__HeadYaw=np.zeros(n), enabled__HeadYaw=np.zeros(n)
    )
    assert check(log) == ()


@pytest.mark.parametrize(("start", "stop"), [(200, 300), (450, 520), (650, 800)])
def test_position_stuck_for_a_while(good_log: Log, check, start: int, stop: int) -> None:
    position = good_log.channels["position.RHipRoll"].copy()
    position[start:stop] = position[start]
    problem = only(check(change(good_log, position__RHipRoll=position)), "position.stuck")
    assert f"RHipRoll, samples {start}-{stop - 1}" in problem.where


def test_position_saturated(good_log: Log, check) -> None:
    position = np.clip(good_log.channels["position.HeadYaw"], -0.1, 0.1)
    problem = only(
        check(change(good_log, position__HeadYaw=position, velocity__HeadYaw=None)), "position.saturated", "warning"
    )
    assert "HeadYaw" in problem.where


def test_gyro_saturated(good_log: Log, check) -> None:
    gyro = np.clip(good_log.channels["imu.gyro_x"], -0.25, 0.25)
    problem = only(check(change(good_log, imu__gyro_x=gyro)), "sensor.saturated", "warning")
    assert "imu.gyro_x at 0.25" in problem.where


def test_dead_sensors(good_log: Log, check) -> None:
    n = len(good_log)
    log = change(good_log, effort__HeadYaw=np.zeros(n), imu__gyro_x=np.zeros(n), force__RFoot=np.zeros(n))
    problem = only(check(log), "channel.dead", "warning")
    assert set(problem.where.split("; ")) == {"effort.HeadYaw", "imu.gyro_x", "force.RFoot"}


def test_positions_that_nobody_measured(good_log: Log, check) -> None:
    """Noise alone, a copy of the command, encoder counts, another recording's: each is found and named."""
    rng, command = np.random.default_rng(2), good_log.channels["command.HeadYaw"]
    late = np.concatenate([command[:1], command[:-1]])
    found = {
        "position.noise": 0.3 * rng.normal(size=len(command)),
        "position.copied": late,
        "units.counts": np.round(2000 * good_log.channels["position.HeadYaw"]),
    }
    for code, position in found.items():
        log = change(good_log, position__HeadYaw=position, velocity__HeadYaw=None)
        (problem,) = [p for p in check(log) if p.code == code]
        assert (problem.severity, problem.where) == ("error", "position.HeadYaw")
    other = 0.3 * np.sin(11.7 * good_log.time + 1.0) + 1e-4 * rng.normal(size=len(command))
    log = change(good_log, position__HeadYaw=other, velocity__HeadYaw=None)
    assert only(check(log), "joint.unrelated", "warning").where == "HeadYaw"


def test_noise_that_may_hide_the_motion_is_no_fault(good_log: Log, check) -> None:
    """A joint that is held, and one that is commanded to move by a fraction of its sensor's noise."""
    rng, n = np.random.default_rng(3), len(good_log)
    for command in (np.zeros(n), 1e-3 * good_log.channels["command.HeadYaw"]):
        position = 2e-3 * rng.normal(size=n)
        log = change(good_log, command__HeadYaw=command, position__HeadYaw=position, velocity__HeadYaw=None)
        assert check(log) == ()


def test_too_few_samples_to_see_any_noise(good_log: Log, check) -> None:
    assert "log.short" in {p.code for p in check(good_log.window(0, 5))}
    assert "log.short" in {p.code for p in check(replace(good_log, episode=np.arange(len(good_log))))}


@pytest.mark.parametrize("period", [4, 1e-12])
def test_periods_that_no_servo_has(tmp_path: Path, good_log: Log, period: float) -> None:
    path = write_raw(tmp_path / "log.parquet", raw_columns(good_log), {**META, "servo_period": period})
    assert only(validate_file(path), "meta.servo_period").message.startswith(f"{json.dumps(period)} is not allowed")


def test_dead_command_while_the_position_moves(good_log: Log, check) -> None:
    problem = only(check(change(good_log, command__HeadYaw=np.zeros(len(good_log)))), "command.dead", "warning")
    assert problem.where == "command.HeadYaw"


@pytest.mark.parametrize("pair", [("LKneePitch", "RKneePitch"), ("LHipRoll", "RHipRoll")])
def test_left_and_right_swapped(good_log: Log, check, pair: tuple[str, str]) -> None:
    left, right = pair
    channels = dict(good_log.channels)
    for channel in ("position", "velocity"):
        a, b = f"{channel}.{left}", f"{channel}.{right}"
        channels[a], channels[b] = channels[b], channels[a]
    problem = only(check(replace(good_log, channels=channels)), "joint.swapped")
    assert problem.where == f"{left} and {right}"


def test_swapped_joints_that_are_held_still(good_log: Log, check) -> None:
    rng = np.random.default_rng(5)
    n = len(good_log)
    left, right = np.full(n, 0.2), np.full(n, -0.2)
    log = change(
        good_log,
        command__LHipRoll=left,
        command__RHipRoll=right,
        position__LHipRoll=right + rng.normal(scale=0.002, size=n),
        position__RHipRoll=left + rng.normal(scale=0.002, size=n),
        velocity__LHipRoll=None,
        velocity__RHipRoll=None,
    )
    assert only(check(log), "joint.swapped").where == "LHipRoll and RHipRoll"


def test_swaps_in_a_recorded_log(shared_data: Path, check) -> None:
    from sysid_btr.io import read_log

    for name in ("nao_gantry/gantry_b.parquet", "nao_walk/walk_b.parquet"):
        log = read_log(shared_data / name)
        channels = dict(log.channels)
        a, b = "position.LKneePitch", "position.RKneePitch"
        channels[a], channels[b] = channels[b], channels[a]
        assert only(check(replace(log, channels=channels)), "joint.swapped").where == "LKneePitch and RKneePitch"


def test_wrong_sign(good_log: Log, check) -> None:
    log = change(
        good_log,
        position__HeadYaw=-good_log.channels["position.HeadYaw"],
        velocity__HeadYaw=-good_log.channels["velocity.HeadYaw"],
    )
    assert only(check(log), "joint.sign").where == "HeadYaw"


def chirp(time: np.ndarray) -> np.ndarray:
    return np.asarray(0.4 * np.sin(2 * np.pi * (0.2 + 0.1 * time) * time))


def test_lag_beyond_reason(good_log: Log, check) -> None:
    log = change(
        good_log,
        command__HeadYaw=chirp(good_log.time),
        position__HeadYaw=chirp(np.maximum(good_log.time - 0.5, 0)),
        velocity__HeadYaw=None,
    )
    problem = only(check(log), "joint.late", "warning")
    assert problem.where == "HeadYaw (+0.50 s)"


def test_position_before_its_command(good_log: Log, check) -> None:
    log = change(
        good_log,
        command__HeadYaw=chirp(np.maximum(good_log.time - 0.5, 0)),
        position__HeadYaw=chirp(good_log.time),
        velocity__HeadYaw=None,
    )
    assert only(check(log), "joint.early", "warning").where == "HeadYaw (-0.50 s)"


def test_an_ordinary_lag_is_no_problem(good_log: Log, check) -> None:
    for lag in (0.0, 0.05, 0.1, 0.2):
        position = 0.999 * chirp(np.maximum(good_log.time - lag, 0))
        log = change(
            good_log, command__HeadYaw=chirp(good_log.time), position__HeadYaw=position, velocity__HeadYaw=None
        )
        assert check(log) == (), lag


# --- units by their numbers ---------------------------------------------------------------------------------


@pytest.mark.parametrize("channels", [("position",), ("command",), ("command", "position")])
def test_degrees(good_log: Log, check, channels: tuple[str, ...]) -> None:
    log = replace(
        good_log,
        channels={
            name: np.degrees(values) if name.partition(".")[0] in channels else values
            for name, values in good_log.channels.items()
            if not name.startswith("velocity.")
        },
    )
    problem = only(check(log), "units.degrees")
    for channel in channels:
        assert f"{channel} of HeadYaw, LKneePitch, RKneePitch, LHipRoll, RHipRoll" in problem.where
    assert "pi/180" in problem.remedy


def test_small_degrees_against_the_range(good_log: Log, check) -> None:
    ranges = dict.fromkeys(JOINTS, (-0.6, 0.6))
    small = np.degrees(0.03 * np.sin(good_log.time))
    log = change(good_log, command__HeadYaw=small, position__HeadYaw=0.999 * small, velocity__HeadYaw=None)
    problem = only(check(log, ranges=ranges), "units.degrees")
    assert "position.HeadYaw" in problem.where


def test_a_joint_that_really_turns(good_log: Log, check) -> None:
    turning = 3.0 * good_log.time + np.sin(good_log.time)
    log = change(good_log, command__HeadYaw=turning, position__HeadYaw=0.999 * turning, velocity__HeadYaw=None)
    problem = only(check(log), "units.degrees")
    assert '{"command.HeadYaw": "rad"}' in problem.remedy
    units = {"command.HeadYaw": "rad", "position.HeadYaw": "rad"}
    assert check(replace(log, meta=replace(log.meta, units=units))) == ()


def test_millimetres(good_log: Log, check) -> None:
    log = change(good_log, position__HeadYaw=1000 * good_log.channels["position.HeadYaw"], velocity__HeadYaw=None)
    units = {"command.HeadYaw": "m", "position.HeadYaw": "m"}
    problem = only(check(replace(log, meta=replace(log.meta, units=units))), "units.millimetres")
    assert problem.where == "position.HeadYaw"


def test_encoder_ticks(good_log: Log, check) -> None:
    ticks = good_log.channels["position.HeadYaw"] * 4096 / (2 * np.pi)
    problems = check(change(good_log, position__HeadYaw=ticks, velocity__HeadYaw=None))
    assert "units.scale" in {p.code for p in problems}


@pytest.mark.parametrize(("factor", "unit"), [(180 / np.pi, "deg/s"), (60 / (2 * np.pi), "rpm")])
def test_velocity_in_another_unit(good_log: Log, check, factor: float, unit: str) -> None:
    log = change(good_log, velocity__HeadYaw=good_log.channels["velocity.HeadYaw"] * factor)
    problem = only(check(log), "units.velocity")
    assert problem.where == "velocity.HeadYaw"
    assert unit in problem.message


def test_gyro_in_degrees(good_log: Log, check) -> None:
    log = change(good_log, imu__gyro_x=np.degrees(good_log.channels["imu.gyro_x"]))
    assert only(check(log), "units.degrees").where == "imu.gyro_x"


def test_imu_angle_in_degrees(good_log: Log, check) -> None:
    log = change(good_log, imu__angle_x=np.degrees(good_log.channels["imu.angle_x"]))
    assert only(check(log), "units.degrees").where == "imu.angle_x"


def test_acceleration_in_g(good_log: Log, check) -> None:
    axes = {f"imu__acc_{axis}": good_log.channels[f"imu.acc_{axis}"] / 9.81 for axis in "xyz"}
    only(check(change(good_log, **axes)), "units.g")


def test_outside_the_range(good_log: Log, check) -> None:
    problem = only(check(good_log, ranges={"HeadYaw": (-0.1, 0.3)}), "position.range", "warning")
    assert "allowed -0.1 to 0.3" in problem.where


# --- all at once --------------------------------------------------------------------------------------------


def test_all_faults_in_one_pass(good_log: Log, tmp_path: Path) -> None:
    columns = raw_columns(good_log)
    time = good_log.time.copy()
    time[5] = time[4]
    columns["time"] = time
    columns["command.HeadYaw"] = np.degrees(good_log.channels["command.HeadYaw"])
    columns["position.LHipRoll"] = np.full(len(time), 0.2)
    del columns["velocity.LHipRoll"]
    columns["postion.LKneePitch"] = columns.pop("position.LKneePitch")
    columns["position.RKneePitch"] = np.full(len(time), np.nan)
    path = write_raw(tmp_path / "a.parquet", columns, {**META, "schema": 3, "mount": "wheels", "units": {"duty": "%"}})
    problems = validate_file(path, joints=[*JOINTS, "Tail"])
    assert {p.code for p in problems if p.severity == "error"} == {
        "meta.schema",
        "meta.mount",
        "meta.unit",
        "time.duplicate",
        "units.degrees",
        "position.stuck",
        "column.misspelled",
        "values.all_missing",
    }
    severities = [p.severity for p in problems]
    assert severities == sorted(severities, key=["error", "warning", "note"].index)


def test_validation_never_raises(good_log: Log, tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    junk = (0.0, np.nan, np.inf, -np.inf, 1e300, -1e300, 1e-300)
    path = tmp_path / "a.parquet"
    for n in (1, 2, 3, 5, 40, 200):
        for _ in range(6):
            part = good_log.window(0, n)
            channels = {
                name: np.where(rng.random(n) < 0.3, rng.choice(junk, n), values)
                for name, values in part.channels.items()
            }
            time = np.where(rng.random(n) < 0.1, rng.choice(junk, n), part.time)
            episode = rng.integers(0, 3, n)
            write_log(replace(part, channels=channels, time=time, episode=episode), path, overwrite=True)
            assert validate_file(path, joints=JOINTS, ranges={"HeadYaw": (-1, 1)})
