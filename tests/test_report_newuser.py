"""What a new user meets: motions that were not played yet, names from Python, and mistakes of every kind."""

from __future__ import annotations

import errno
import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from terminal import Cli

import sysid_btr as sb
from sysid_btr.cli.demo import sample_logs
from sysid_btr.errors import ModelError, UsageError
from sysid_btr.estimators.journal import Journal, Record
from sysid_btr.io.importers.names import suggestions
from sysid_btr.io.log import MOTION, Log, LogMeta

SAMPLES = sample_logs()
MODEL, RECORDED = str(SAMPLES / "pendulum.xml"), str(SAMPLES / "pendulum_clean.parquet")
ASKED = ("--model", MODEL, "--log", RECORDED, "--fit", "mass:arm", "--threads", "1")


# --- motions ---------------------------------------------------------------------------------------------------


@pytest.fixture
def motion(tmp_path: Path) -> Path:
    """Commands that nobody has played yet."""
    time = np.arange(300) * 0.01
    channels = {"command.pendulum": 0.4 * np.sin(3 * time)}
    log = Log(time, channels, LogMeta(sample_period=0.01, source=MOTION), np.zeros(300, dtype=np.int64))
    sb.write_log(log, tmp_path / "motion.parquet")
    return tmp_path / "motion.parquet"


def test_a_motion_is_readable_and_says_what_it_is(cli: Cli, motion: Path) -> None:
    answer = cli("validate", motion, "--model", MODEL)
    assert answer.code == 0
    assert "motion.not_recorded" in answer.out
    assert sb.read_log(motion).is_motion


@pytest.mark.parametrize("verb", ["fit", "close", "posterior"])
def test_nothing_is_fitted_to_a_motion(cli: Cli, motion: Path, verb: str) -> None:
    answer = cli(verb, "--model", MODEL, "--log", motion, "--fit", "mass:arm")
    assert answer.code == 3
    assert "an excitation trajectory, not a recording" in answer.err
    with pytest.raises(ModelError, match="excitation trajectory"):
        sb.make_study(sb.load_robot(MODEL), [sb.read_log(motion)], threads=1).train_problem(())


def test_a_motion_is_replayed_and_its_reach_is_told(cli: Cli, motion: Path, tmp_path: Path) -> None:
    answer = cli("replay", "--model", MODEL, "--log", motion, "--threads", "1", "--out", tmp_path / "played")
    assert answer.code == 0, answer.err
    assert "pendulum" in answer.out
    assert "-0.400 .. 0.400" in answer.out
    predicted = sb.read_log(tmp_path / "played" / "motion.replayed.parquet")
    assert not predicted.is_motion
    assert np.ptp(predicted.channels["position.pendulum"]) > 0.5
    mixed = cli("replay", "--model", MODEL, "--log", motion, "--log", RECORDED, "--threads", "1")
    assert mixed.code == 2
    assert "not both" in mixed.err


@pytest.mark.parametrize("more", [{"source": "measured"}, {"channel": "velocity.pendulum"}], ids=["source", "sensors"])
def test_a_recording_without_positions_is_refused_whatever_it_calls_itself(
    cli: Cli, motion: Path, more: dict[str, str], tmp_path: Path
) -> None:
    log = sb.read_log(motion)
    channels = dict(log.channels)
    if "channel" in more:
        channels[more["channel"]] = np.cos(log.time)
    meta = replace(log.meta, source=more.get("source", MOTION))
    sb.write_log(replace(log, channels=channels, meta=meta), tmp_path / "recorded.parquet")
    answer = cli("validate", tmp_path / "recorded.parquet")
    assert answer.code == 3
    assert "position.missing" in answer.out


# --- from Python -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "before", ["", "import sysid_btr.posterior.sampling", "from sysid_btr.posterior import posterior"]
)
def test_the_posterior_can_be_called_whatever_was_imported_before(before: str) -> None:
    code = "import sysid_btr as sb\nassert callable(sb.posterior)\nassert sb.posterior.Settings().ensembles == 2"
    subprocess.run([sys.executable, "-c", f"{before}\n{code}"], check=True)


def test_a_table_in_degrees_is_imported_from_python(tmp_path: Path) -> None:
    log = sb.read_log(RECORDED)
    table = {"t": log.time, "arm goal": np.degrees(log.channels["command.pendulum"])}
    table["arm now"] = np.degrees(log.channels["position.pendulum"])
    pd.DataFrame(table).to_csv(tmp_path / "swing.csv", index=False)
    (tmp_path / "map.toml").write_text('[channels]\ncommand = "{joint} goal"\nposition = "{joint} now"\n')
    known = {"mapping": tmp_path / "map.toml", "model": MODEL, "rename": {"arm": "pendulum"}, "mount": "fixed"}
    wrong = sb.import_log(tmp_path / "swing.csv", **known)  # type: ignore[arg-type]
    assert not wrong.usable
    right = sb.import_log([tmp_path / "swing.csv"], units={"command": "deg", "position": "deg"}, **known)  # type: ignore[arg-type]
    assert right.usable, right.problems
    for name, values in log.channels.items():
        np.testing.assert_allclose(right.log.channels[name], values, atol=1e-12)
    same = sb.import_log(tmp_path / "swing.csv", **{**known, "model": sb.load_robot(MODEL)})  # type: ignore[arg-type]
    assert same.log.joints("position") == ("pendulum",)


# --- mistakes ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("argv", "code", "said"),
    [
        ((*ASKED, "--bounds", "kpp=0.5:2"), 2, "did you mean 'kp'"),
        ((*ASKED, "--bounds", "mass:leg=0.5:2"), 2, "arm"),
        ((*ASKED, "--bounds", "com.w:arm=0:1"), 2, "it has x, y, z"),
        ((*ASKED, "--fit", "friction:pendulum"), 2, "did you mean 'frictionloss'"),
        (("--model", RECORDED, "--log", RECORDED, "--fit", "mass:*"), 4, "a log with --log"),
        (("--model", MODEL, "--log", MODEL, "--fit", "mass:*"), 3, "give it with --model"),
        (("--config", "{mapping}"), 2, "a mapping for `sysid-btr import`"),
        (("--config", "{study}"), 2, "log: 3 is not allowed; expected text or a list of texts"),
        (("--config", "{study}"), 2, "sed: unknown key; did you mean seed?"),
    ],
    ids=lambda value: " ".join(value)[-60:] if isinstance(value, tuple) else None,
)
def test_a_mistake_is_told_with_what_to_do(
    cli: Cli, tmp_path: Path, argv: tuple[str, ...], code: int, said: str
) -> None:
    files = {"mapping": '[time]\ncolumn = "t"\n', "study": "log = 3\nsed = 4\n"}
    for name, text in files.items():
        (tmp_path / f"{name}.toml").write_text(text)
    answer = cli("fit", *(a.format(**{n: tmp_path / f"{n}.toml" for n in files}) for a in argv))
    assert answer.code == code, answer.err
    assert said in answer.err
    assert "internal error" not in answer.err


def test_bounds_of_fields_and_parameters_that_exist_are_taken(cli: Cli) -> None:
    for bounds in ("mass=0.5:2", "mass:arm=0.5:2", "mass:*=0.5:2", "com.x:arm=-0.1:0.1"):
        answer = cli("fit", *ASKED, "--bounds", bounds, "--json")
        assert answer.code == 0
        if bounds.startswith("mass"):
            assert {tuple(p["bounds"]) for p in json.loads(answer.out)["parameters"]} == {(0.5, 2.0)}


def test_a_file_that_is_no_result_and_a_run_that_has_not_ended_are_told_apart(cli: Cli, tmp_path: Path) -> None:
    assert "is not a result" in cli("report", RECORDED).err
    assert "give the --out folder of a finished run" in cli("report", tmp_path).err
    (tmp_path / "journal.jsonl").touch()
    answer = cli("report", tmp_path)
    assert answer.code == 2
    assert "repeat its command with --resume" in answer.err


def test_a_warning_says_what_to_do(cli: Cli, tmp_path: Path) -> None:
    log = sb.read_log(RECORDED)
    channels = {**log.channels, "command.finger": np.sin(log.time), "position.finger": np.sin(log.time - 0.02)}
    sb.write_log(replace(log, channels=channels), tmp_path / "log.parquet")
    answer = cli("replay", "--model", MODEL, "--log", tmp_path / "log.parquet", "--threads", "1")
    fitted = cli("fit", "--model", MODEL, "--log", tmp_path / "log.parquet", "--fit", "mass:arm", "--threads", "1")
    assert answer.code == fitted.code == 0
    assert "finger" in fitted.err
    assert "-> nothing, if they are irrelevant" in fitted.err


def test_joints_are_suggested_by_their_words_where_only_one_has_them() -> None:
    model = ("HipYawPitch", "HipRoll", "HipPitch", "KneePitch")
    assert suggestions(("hip_yaw", "knee"), model) == {"hip_yaw": "HipYawPitch", "knee": "KneePitch"}
    assert suggestions(("hip",), model) == {}
    assert suggestions(("l_knee",), ("LKneePitch", "RKneePitch")) == {"l_knee": "LKneePitch"}
    assert suggestions(("knee",), ("LKneePitch", "RKneePitch")) == {}


# --- disks that are full or closed -------------------------------------------------------------------------------


def full(*_: object, **__: object) -> None:
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def test_a_disk_that_is_full_is_told_and_the_run_can_go_on(
    cli: Cli, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "out"
    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", full)
        answer = cli("fit", *ASKED, "--out", out)
    assert answer.code == 2
    assert "No space left on device" in answer.err
    assert "--resume" in answer.err
    assert not list(out.glob("*.part"))
    assert cli("fit", *ASKED, "--out", out, "--resume").code == 0


def test_a_record_that_went_to_disk_in_part_is_an_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    journal = Journal(tmp_path / "journal.jsonl", fingerprint="x")
    record = Record("loss", np.zeros((1, 1)), {"loss": np.zeros(1)}, 0.0)
    journal.append(record)
    opened = Path.open

    class Cut:
        """A file on a disk that takes only so much."""

        def __init__(self, path: Path) -> None:
            self.file = opened(path, "ab", buffering=0)

        def __enter__(self) -> Cut:
            return self

        def __exit__(self, *_: object) -> None:
            self.file.close()

        def write(self, data: bytes) -> int:
            return self.file.write(data[:5]) or 0

        def fileno(self) -> int:
            return self.file.fileno()

    with monkeypatch.context() as patch:
        patch.setattr(Path, "open", lambda path, *_, **__: Cut(path))
        with pytest.raises(UsageError, match="No space left"):
            journal.append(record)
    again = Journal(tmp_path / "journal.jsonl", fingerprint="x")
    assert len(again) == 1


def test_whatever_else_cannot_be_written_is_no_defect(
    cli: Cli, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def closed(*_: object, **__: object) -> None:
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), "somewhere")

    monkeypatch.setattr("sysid_btr.saving.write_all", closed)
    monkeypatch.setattr("sysid_btr.cli.fitting.write_all", closed)
    answer = cli("fit", *ASKED, "--out", tmp_path / "out")
    assert answer.code == 2
    assert "cannot write somewhere: Permission denied" in answer.err
    assert "internal error" not in answer.err


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write anywhere")
def test_a_folder_that_may_not_be_written_to(cli: Cli, tmp_path: Path) -> None:
    tmp_path.chmod(0o555)
    answer = cli("fit", *ASKED, "--out", tmp_path / "out")
    tmp_path.chmod(0o755)
    assert answer.code == 2
    assert "Permission denied" in answer.err
