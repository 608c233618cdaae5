"""What others may give this program: no defect of theirs is one of this program, and none takes all memory."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from terminal import Cli

from sysid_btr.errors import LogError, UsageError
from sysid_btr.estimators.journal import Record
from sysid_btr.executors import caution
from sysid_btr.io.log import Log
from sysid_btr.io.parquet import write_log
from sysid_btr.io.split import split_episodes
from sysid_btr.io.validation import validate_file
from sysid_btr.machine import VARIABLE, memory_limit, require_memory
from sysid_btr.reading import parse_json, parse_toml

SAMPLES = Path(__file__).resolve().parents[1] / "sample_logs"
PENDULUM = ("-m", SAMPLES / "pendulum.xml")
CLEAN = SAMPLES / "pendulum_clean.parquet"
DEEP = 100_000 * "["


@pytest.fixture(scope="module")
def fitted(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """The result of a fit."""
    from sysid_btr.cli import run

    out = tmp_path_factory.mktemp("fitted") / "out"
    assert run(["fit", *map(str, PENDULUM), "-l", str(CLEAN), "-f", "mass:*", "-o", str(out)]) == 0
    result: dict[str, Any] = json.loads((out / "result.json").read_text())
    return {**result, "pictures": []}


def with_metadata(path: Path, text: str) -> Path:
    table = pq.read_table(CLEAN).replace_schema_metadata({"sysid_btr": text})
    pq.write_table(table, path)
    return path


# --- texts --------------------------------------------------------------------------------------------------


def test_what_is_nested_deeply_is_no_json_and_no_toml() -> None:
    with pytest.raises(ValueError, match="nested too deeply"):
        parse_json(DEEP)
    with pytest.raises(ValueError, match="nested too deeply"):
        parse_toml(b"a = " + DEEP.encode())


@pytest.mark.parametrize("text", [DEEP, '{"schema": 1, "sample_period": 1%s}' % (400 * "0")])
def test_metadata_that_nobody_meant(tmp_path: Path, cli: Cli, text: str) -> None:
    answer = cli("validate", with_metadata(tmp_path / "log.parquet", text))
    assert answer.code == 3
    assert "metadata" in answer.out


@pytest.mark.parametrize(("flags", "name"), [(("--config", "deep"), "deep"), (("--params", "deep.json"), "deep.json")])
def test_files_of_options_that_nobody_meant(tmp_path: Path, cli: Cli, flags: tuple[str, str], name: str) -> None:
    (tmp_path / name).write_text(("a = " if name == "deep" else "") + DEEP)
    answer = cli("fit", *PENDULUM, "-l", CLEAN, "-f", "mass:*", flags[0], tmp_path / flags[1])
    assert (answer.code, "nested too deeply" in answer.err) == (2, True)


EDITS: dict[str, Callable[[dict[str, Any]], Any]] = {
    "deep": lambda r: DEEP,
    "no kind": lambda r: {k: v for k, v in r.items() if k != "kind"},
    "no numerics": lambda r: {k: v for k, v in r.items() if k != "numerics"},
    "parameters are text": lambda r: {**r, "parameters": "mass"},
    "a parameter is a number": lambda r: {**r, "parameters": [1]},
    "a parameter has no value": lambda r: {**r, "parameters": [{"name": "mass:arm"}]},
    "an interval of one": lambda r: {**r, "parameters": [{**r["parameters"][0], "ci95": [1]}]},
    "scores are a list": lambda r: {**r, "nominal": []},
    "effects are null": lambda r: {**r, "effects": None},
    "the model is a number": lambda r: {**r, "model": 3},
    "units are null": lambda r: {**r, "units": None},
    "wall time is text": lambda r: {**r, "wall_s": "long"},
    "identifiable is new": lambda r: {**r, "parameters": [{**r["parameters"][0], "identifiable": "perhaps"}]},
    "profiles are a number": lambda r: {**r, "profiles": 4},
    "pictures are a number": lambda r: {**r, "pictures": 7},
    "walks are text": lambda r: {**r, "walks": ["abc"]},
}


@pytest.mark.parametrize("edit", EDITS)
def test_a_report_of_a_result_that_was_edited(tmp_path: Path, cli: Cli, fitted: dict[str, Any], edit: str) -> None:
    changed = EDITS[edit](fitted)
    (tmp_path / "result.json").write_text(changed if isinstance(changed, str) else json.dumps(changed))
    assert cli("report", tmp_path).code in (0, 2)


def test_a_whole_number_beyond_those_that_can_be_computed_with_is_no_json() -> None:
    assert parse_json(f"[{10**300}]") == [10**300]
    with pytest.raises(ValueError, match="400 digits"):
        parse_json("9" * 400)


def test_a_record_of_a_journal_without_a_loss_is_a_damaged_one() -> None:
    whole = Record("loss", np.zeros((2, 1)), {"loss": np.ones(2)}, 1.0)
    assert Record.from_line(whole.to_line().strip()).kind == "loss"
    for arrays in ({}, {"loss": np.ones(1)}):
        with pytest.raises((KeyError, ValueError)):
            Record.from_line(Record("loss", np.zeros((2, 1)), arrays, 1.0).to_line().strip())


# --- logs ---------------------------------------------------------------------------------------------------


def test_an_episode_for_each_sample(tmp_path: Path, cli: Cli, good_log: Log) -> None:
    from dataclasses import replace

    numbered = replace(good_log, episode=np.arange(len(good_log)))
    with pytest.raises(LogError, match="none of its 800 episodes has two samples"):
        split_episodes(numbered)
    write_log(numbered, tmp_path / "log.parquet")
    assert cli("replay", *PENDULUM, "-l", tmp_path / "log.parquet").code == 3


def test_an_episode_that_no_whole_number_is(tmp_path: Path) -> None:
    table = pq.read_table(CLEAN)
    table = table.append_column("episode", pa.array(np.full(table.num_rows, 1e300)))
    pq.write_table(table, tmp_path / "log.parquet")
    assert "episode.type" in {p.code for p in validate_file(tmp_path / "log.parquet")}


def test_channels_that_a_log_does_not_have_are_named(cli: Cli) -> None:
    answer = cli("fit", *PENDULUM, "-l", CLEAN, "-f", "mass:*", "--channels", "velocity")
    assert answer.code == 4
    assert "it has no velocity of the model's joints to compare; it has position: --channels position" in answer.err


INFO = {"fps": 30, "features": {f: {"shape": [2], "names": ["a", "b"]} for f in ("observation.state", "action")}}


@pytest.mark.parametrize(
    "change",
    [
        {"fps": "30"},
        {"fps": True},
        {"fps": 10**400},
        {"features": {"observation.state": 3, "action": {}}},
        {"features": {"observation.state": {"shape": [99999999999]}, "action": {"shape": [99999999999]}}},
        {"features": {"observation.state": {"shape": "two"}, "action": {"shape": [[2]]}}},
        {"features": {"observation.state": {"shape": [3], "names": ["a", "b", "c"]}, "action": {"names": {"x": 1}}}},
        {"robot_type": ["arm"]},
    ],
)
def test_a_dataset_whose_description_is_of_another_type(tmp_path: Path, cli: Cli, change: dict[str, Any]) -> None:
    n = 60
    lists = pa.array([[0.1 * i, 0.2] for i in range(n)])
    columns = {"observation.state": lists, "action": lists, "episode_index": np.zeros(n, dtype=np.int64)}
    (tmp_path / "data").mkdir()
    (tmp_path / "meta").mkdir()
    pq.write_table(pa.table({**columns, "frame_index": np.arange(n)}), tmp_path / "data" / "file.parquet")
    (tmp_path / "meta" / "info.json").write_text(json.dumps({**INFO, **change}))
    assert cli("import", tmp_path).code in (0, 3)


# --- memory -------------------------------------------------------------------------------------------------


def test_a_limit_can_be_set(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(VARIABLE, "0.25")
    assert memory_limit() == 0.25e9
    require_memory(0.2e9, "a log", "cut it")
    with pytest.raises(UsageError, match=r"a log would take 0.3 GB of memory, and 0.25 GB may be taken: cut it"):
        require_memory(0.3e9, "a log", "cut it")
    monkeypatch.setenv(VARIABLE, "much")
    with pytest.raises(UsageError, match="in GB"):
        memory_limit()
    monkeypatch.delenv(VARIABLE)
    assert memory_limit() > 1e8


def test_what_does_not_fit_into_memory_is_refused_before_it_is_read(
    tmp_path: Path, cli: Cli, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A few kilobytes of one value, repeated 30 million times."""
    path = tmp_path / "large.parquet"
    column = pa.RunEndEncodedArray.from_arrays(pa.array([10_000_000], pa.int32()), pa.array([1.0]))
    chunk = pa.table({"time": pa.compute.run_end_decode(column)})
    with pq.ParquetWriter(path, chunk.schema) as writer:
        for _ in range(3):
            writer.write_table(chunk)
    assert path.stat().st_size < 2e5
    monkeypatch.setenv(VARIABLE, "0.1")
    answer = cli("validate", path)
    assert answer.code == 3
    assert "30000000 rows" in answer.out.replace("\n", "")


def test_a_replay_that_does_not_fit_into_memory_is_refused(monkeypatch: pytest.MonkeyPatch, cli: Cli) -> None:
    monkeypatch.setenv(VARIABLE, "1e-5")
    answer = cli("replay", *PENDULUM, "-l", CLEAN)
    assert answer.code in (2, 3)
    assert "GB may be taken" in answer.err


# --- options, and where output goes -------------------------------------------------------------------------


@pytest.mark.parametrize(
    "flags",
    [
        ("close", "--nuisance", "mass=nan"),
        ("fit", "--bounds", "kp=1e-300:1e300"),
        ("fit", "--bounds", "mass=-5:5"),
        ("excite", "--seconds", "inf", "-o", "x"),
        ("btr", "--duration", "1e9", "--robot-sim", "ant"),
        ("btr", "--duration", "nan", "--robot-sim", "ant"),
    ],
)
def test_numbers_that_cannot_be_meant(cli: Cli, flags: tuple[str, ...]) -> None:
    model = ("-m", "ant") if flags[0] == "btr" else PENDULUM
    log = () if flags[0] == "btr" else ("-l", CLEAN)
    answer = cli(flags[0], *model, *log, "-f", "mass:*", "-f", "kp:*=shared", *flags[1:])
    assert answer.code == 2


def started(*argv: object, **options: Any) -> subprocess.CompletedProcess[bytes]:
    command = [sys.executable, "-m", "sysid_btr.cli", *map(str, argv)]
    return subprocess.run(command, capture_output=True, check=False, **options)


def test_output_that_nobody_reads_or_that_knows_other_letters(tmp_path: Path) -> None:
    ascii_only = {**os.environ, "PYTHONIOENCODING": "ascii", "PYTHONUTF8": "0", "LC_ALL": "C"}
    table = started("validate", SAMPLES / "leg.xml", env=ascii_only)
    assert (table.returncode, b"Traceback" in table.stderr) == (3, False)
    shell = f"{sys.executable} -m sysid_btr.cli validate {CLEAN} {CLEAN}"
    piped = f"{shell} | true; exit ${{PIPESTATUS[0]}}"
    unread = subprocess.run(["bash", "-c", piped], capture_output=True, check=False)
    assert unread.returncode in (0, 141)
    assert unread.stderr == b""
    closed = subprocess.run(["bash", "-c", f"{shell} >&-"], capture_output=True, check=False)
    assert (closed.returncode, closed.stderr) == (0, b"")


def test_a_cluster_beyond_this_machine_is_warned_of() -> None:
    assert "pickles" in caution("tcp://robot:8786")
    assert caution("tls://robot:8786") == caution("local:2") == caution(None) == ""


@pytest.mark.parametrize("message", [{"name": 3, "position": "x"}, [1, 2], 7, {"name": ["a"], "position": [{}]}, {}])
def test_messages_whose_fields_are_of_another_type(tmp_path: Path, cli: Cli, message: Any) -> None:
    writers = pytest.importorskip("mcap.writer")
    path = tmp_path / "log.mcap"
    with path.open("wb") as file:
        writer = writers.Writer(file)
        writer.start()
        schema = writer.register_schema("sensor_msgs/msg/JointState", "jsonschema", b"{}")
        for topic in ("/joint_states", "/joint_commands"):
            channel = writer.register_channel(topic, "json", schema)
            for i in range(60):
                stamp = 10**15 + i * 10**7
                writer.add_message(channel, stamp, json.dumps(message).encode(), stamp)
        writer.finish()
    assert cli("import", path).code == 3
