"""`sysid-btr import` and `sysid-btr init`, as somebody meets them who has never used the program."""

from __future__ import annotations

import errno
import json
import os
import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from terminal import Answer, Cli

from sysid_btr.cli import run
from sysid_btr.io.log import Log
from sysid_btr.io.parquet import read_log, write_log
from sysid_btr.io.validation import validate_file

SAMPLES = Path(__file__).resolve().parents[1] / "sample_logs"
LEG, PENDULUM = SAMPLES / "leg.xml", SAMPLES / "pendulum.xml"
THEIRS = {
    "HipYawPitch": "hip_yaw",
    "HipRoll": "hip_roll",
    "HipPitch": "hip_pitch",
    "KneePitch": "knee",
    "AnklePitch": "ankle_pitch",
    "AnkleRoll": "ankle_roll",
}
MAPPING = """
[time]
column = "t"
[units]
time = "ms"
command = "deg"
position = "deg"
[channels]
command = "{joint} goal"
position = "{joint} now"
[joints]
hip_yaw = "HipYawPitch"
hip_roll = "HipRoll"
hip_pitch = "HipPitch"
knee = "KneePitch"
ankle_pitch = "AnklePitch"
ankle_roll = "AnkleRoll"
"""


@pytest.fixture
def cli(cli: Cli) -> Cli:
    """As everywhere; nothing here may be a defect of the program either."""

    def call(*argv: object) -> Answer:
        answer = cli(*argv)
        assert "internal error" not in answer.err
        return answer

    return call


@pytest.fixture(scope="module")
def leg() -> Log:
    return read_log(SAMPLES / "leg_clean.parquet")


@pytest.fixture
def desk(tmp_path: Path, leg: Log) -> Path:
    """A folder with a recording in degrees, ms and names of somebody's own, and a mapping for it."""
    frame = pd.DataFrame({"t": leg.time * 1e3 + 12_000})
    for joint, name in THEIRS.items():
        frame[f"{name} goal"] = np.degrees(leg.channels[f"command.{joint}"])
        frame[f"{name} now"] = np.degrees(leg.channels[f"position.{joint}"])
    frame["battery"] = 24.1
    frame.to_csv(tmp_path / "walk.csv", index=False)
    (tmp_path / "mapping.toml").write_text(MAPPING)
    return tmp_path


def test_a_new_user_gets_a_log_that_equals_the_original(cli: Cli, desk: Path, leg: Log) -> None:
    out = desk / "walk.parquet"
    asked = (desk / "walk.csv", "--map", desk / "mapping.toml", "--model", LEG, "--mount", "fixed")
    answer = cli("import", *asked, "--out", out)
    assert answer.code == 0, answer.err
    assert "battery" in answer.err
    assert "2000 samples, 19.99 s, every 10 ms; torso fixed" in answer.out
    assert validate_file(out) == ()
    log = read_log(out)
    assert set(log.channels) == set(leg.channels)
    for column, values in leg.channels.items():
        np.testing.assert_allclose(log.channels[column], values, atol=1e-12)
    np.testing.assert_allclose(log.time - log.time[0], leg.time - leg.time[0], atol=1e-9)
    assert log.meta.sample_period == leg.meta.sample_period
    assert log.meta.mount == leg.meta.mount
    assert log.meta.robot == "leg"
    assert np.all(log.unknown["battery"] == 24.1)
    [origin] = log.meta.extra["imported"]
    assert (origin["file"], origin["format"]) == ("walk.csv", "csv")
    fitted = cli("fit", "--log", out, "--model", LEG, "--fit", "kp:*=shared", "--threads", 1, "--json")
    assert fitted.code == 0, fitted.err


def test_the_way_there_without_a_mapping_is_told_step_by_step(cli: Cli, desk: Path, leg: Log) -> None:
    # first: the file as it is; the names say enough, but not the units and whose joints these are
    asked = ("import", desk / "walk.csv", "--model", LEG, "--out", desk / "walk.parquet")
    first = cli(*asked)
    assert first.code == 3
    # second: what the message proposes, as it is
    [line] = [line for line in first.err.splitlines() if line.startswith("what may put it right")]
    flags = line.partition(": ")[2].split()
    assert {"command=deg", "position=deg", "hip_roll=HipRoll"} < set(flags)
    assert not (desk / "walk.parquet").exists()
    second = cli(*asked, *flags, "--rename", "knee=KneePitch", "--rename", "hip_yaw=HipYawPitch")
    assert second.code == 0, second.err
    log = read_log(desk / "walk.parquet")
    for column, values in leg.channels.items():
        np.testing.assert_allclose(log.channels[column], values, atol=1e-12)


def test_without_out_nothing_is_written(cli: Cli, desk: Path) -> None:
    before = sorted(desk.iterdir())
    answer = cli("import", desk / "walk.csv", "--map", desk / "mapping.toml", "--json")
    assert answer.code == 0
    assert sorted(desk.iterdir()) == before
    found = json.loads(answer.out)
    assert found["out"] is None
    assert found["samples"] == 2000
    assert found["channels"]["position"] == list(THEIRS)
    assert found["foreign"] == ["battery"]
    assert "nothing is written without --out" in answer.err


def test_a_mapping_to_edit_comes_on_standard_output(cli: Cli, desk: Path) -> None:
    frame = pd.read_csv(desk / "walk.csv")
    frame.columns = [f"c{i}" for i in range(len(frame.columns))]
    frame.to_csv(desk / "odd.csv", index=False)
    answer = cli("import", desk / "odd.csv", "--model", LEG)
    assert answer.code == 3
    assert "mapping.toml" in answer.err
    proposed = tomllib.loads(answer.out)
    assert proposed["time"]["column"] == "c0"
    assert "HipYawPitch" in answer.out


def test_wrong_units_are_refused_with_the_flag_that_helps(cli: Cli, desk: Path) -> None:
    (desk / "mapping.toml").write_text(MAPPING.replace('position = "deg"', "").replace('command = "deg"', ""))
    asked = ("import", desk / "walk.csv", "--map", desk / "mapping.toml", "--model", LEG)
    answer = cli(*asked, "--out", desk / "walk.parquet")
    assert answer.code == 3
    assert "--unit command=deg --unit position=deg" in answer.err
    assert "it is not written" in answer.err
    assert not (desk / "walk.parquet").exists()
    forced = cli(*asked, "--out", desk / "walk.parquet", "--force")
    assert forced.code == 3
    assert "written all the same" in forced.err
    assert (desk / "walk.parquet").exists()


def test_a_joint_that_is_not_logged_is_named(cli: Cli, desk: Path) -> None:
    frame = pd.read_csv(desk / "walk.csv").drop(columns=["knee goal", "knee now"])
    frame.to_csv(desk / "walk.csv", index=False)
    (desk / "mapping.toml").write_text(MAPPING.replace('knee = "KneePitch"\n', ""))
    answer = cli("import", desk / "walk.csv", "--map", desk / "mapping.toml", "--model", LEG, "--json")
    assert answer.code == 0
    [problem] = [p for p in json.loads(answer.out)["problems"] if p["code"] == "joint.unlogged"]
    assert problem["severity"] == "note"
    assert problem["where"].startswith("KneePitch")


BASE = ("{desk}/walk.csv", "--map", "{desk}/mapping.toml")


@pytest.mark.parametrize(
    ("argv", "code", "said"),
    [
        ((), 2, "which log"),
        (("{desk}/gone.csv",), 3, "no such file"),
        ((str(SAMPLES),), 3, "neither a ROS 2 bag nor a LeRobot dataset"),
        ((str(LEG),), 3, "XML"),
        (("{desk}/mapping.toml",), 3, "no importer|fields"),
        (("{desk}/cut.parquet",), 3, "footer"),
        (("{desk}/cut.mcap",), 3, "cannot be read"),
        (("{desk}/cut.db3",), 3, "cannot be read"),
        (("{desk}/walk.csv", "--format", "naoki"), 2, "naoqi"),
        (("{desk}/walk.csv", "--format", "naoqi"), 3, "Position/Sensor"),
        (("{desk}/walk.csv", "--map", "{desk}/gone.toml"), 2, "gone.toml"),
        (("{desk}/walk.csv", "--map", "{desk}/walk.csv"), 2, "not TOML"),
        ((*BASE, "--unit", "position=furlong"), 2, "rad, mrad, deg"),
        ((*BASE, "--unit", "postion=deg"), 2, "did you mean position"),
        ((*BASE, "--unit", "deg"), 2, "A=B"),
        ((*BASE, "--rename", "kne=Knee"), 3, "did you mean knee"),
        ((*BASE, "--rename", "knee=HipRoll"), 3, "second source of command.HipRoll"),
        ((*BASE, "--mount", "wall"), 2, "fixed .* or free"),
        ((*BASE, "--model", "robot"), 4, "neither a built-in model"),
        ((*BASE, "--out", "{desk}/there.parquet"), 2, "--overwrite"),
        ((*BASE, "--out", "{desk}/walk.csv", "--overwrite"), 2, "also an input"),
        ((*BASE, "--out", "{desk}"), 2, "is a folder"),
        ((*BASE, "--out", "{desk}/no/walk.parquet"), 2, "create it first"),
        ((*BASE, "--colour", "red"), 2, "--colour"),
    ],
    ids=lambda value: " ".join(value)[-60:] if isinstance(value, tuple) else None,
)
def test_every_mistake_is_one_clear_message(cli: Cli, desk: Path, argv: tuple[str, ...], code: int, said: str) -> None:
    import re

    (desk / "there.parquet").write_text("mine")
    (desk / "cut.parquet").write_bytes((SAMPLES / "leg_clean.parquet").read_bytes()[:5000])
    (desk / "cut.mcap").write_bytes(b"\x89MCAP0\r\n\x01")
    (desk / "cut.db3").write_bytes(b"SQLite format 3\x00" + bytes(80))
    files = {path: path.read_bytes() for path in desk.iterdir()}
    answer = cli("import", *(a.format(desk=desk) for a in argv))
    assert answer.code == code, answer.err
    assert re.search(said, answer.err), answer.err
    assert {path: path.read_bytes() for path in desk.iterdir()} == files


@pytest.mark.parametrize(("number", "said"), [(errno.ENOSPC, "No space left"), (errno.EACCES, "Permission denied")])
def test_no_space_and_no_permission_are_told_and_leave_nothing(
    cli: Cli, desk: Path, monkeypatch: pytest.MonkeyPatch, number: int, said: str
) -> None:
    files = set(desk.iterdir())

    def fail(_: int) -> None:
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(os, "fsync", fail)
    answer = cli("import", desk / "walk.csv", "--map", desk / "mapping.toml", "--out", desk / "w.parquet")
    assert answer.code == 2
    assert said in answer.err
    assert "choose a writable folder" in answer.err
    assert set(desk.iterdir()) == files


def test_overwriting_has_to_be_asked_for(cli: Cli, desk: Path) -> None:
    asked = ("import", desk / "walk.csv", "--map", desk / "mapping.toml", "--out", desk / "walk.parquet")
    assert cli(*asked).code == 0
    before = (desk / "walk.parquet").read_bytes()
    assert cli(*asked).code == 2
    assert (desk / "walk.parquet").read_bytes() == before
    assert cli(*asked, "--overwrite", "--mount", "free").code == 0
    assert read_log(desk / "walk.parquet").meta.mount == "free"


def test_what_validate_says_of_foreign_files_is_true(cli: Cli, desk: Path) -> None:
    told = cli("validate", desk / "walk.csv")
    assert told.code == 3
    assert "sysid-btr" in told.out
    assert "import" in told.out
    pd.read_csv(desk / "walk.csv").to_parquet(desk / "foreign.parquet")
    assert "import" in cli("validate", desk / "foreign.parquet").out
    for name in ("walk.csv", "foreign.parquet"):
        answer = cli("import", desk / name, "--map", desk / "mapping.toml", "--out", desk / f"{name}.log")
        assert answer.code == 0
        assert cli("validate", desk / f"{name}.log", "--model", LEG).code == 0


# --- init -------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def swinging(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a model and a log, and a study proposed for them."""
    folder = tmp_path_factory.mktemp("study")
    for name in ("pendulum.xml", "pendulum_clean.parquet"):
        (folder / name).write_bytes((SAMPLES / name).read_bytes())
    asked = ("init", folder / "pendulum_clean.parquet", "--model", folder / "pendulum.xml")
    assert run([*map(str, asked), "--out", str(folder / "study.toml")]) == 0
    return folder


@pytest.mark.parametrize("verb", ["fit", "close"])
def test_the_study_file_runs_as_it_is(
    cli: Cli, swinging: Path, verb: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.chdir(tmp_path)
    answer = cli(verb, "--config", swinging / "study.toml", "--json")
    assert answer.code == 0, answer.err
    found = {p["name"]: p["ci95"] for p in json.loads(answer.out)["parameters"]}
    truth = json.loads((SAMPLES / "pendulum_clean.truth.json").read_text())
    low, high = found["mass:arm"]
    assert low <= truth["mass"]["arm"]["scale"] <= high
    assert not list(tmp_path.iterdir())


def test_the_study_file_says_what_the_log_holds(swinging: Path) -> None:
    text = (swinging / "study.toml").read_text()
    study = tomllib.loads(text)
    assert study["model"] == "pendulum.xml"
    assert study["log"] == ["pendulum_clean.parquet"]
    assert study["channels"] == ["position"]
    assert "mass:arm" in study["fit"]
    assert "kp:*" in study["fit"]
    assert "9.99 s in 1 episode, 1000 samples every 10 ms; torso fixed" in text
    log = read_log(SAMPLES / "pendulum_clean.parquet")
    assert f"{np.ptp(log.channels['position.pendulum']):.3g} rad" in text
    assert "no effort is logged" in text
    for line in text.splitlines():
        assert not line or line.startswith(("#", "[", "]", "    ")) or " = " in line


def test_only_what_moved_is_proposed_to_be_freed(cli: Cli, tmp_path: Path, leg: Log) -> None:
    still = {f"{c}.{j}": np.zeros(len(leg)) for c in ("command", "position") for j in ("HipYawPitch", "HipRoll")}
    noise = np.random.default_rng(0).normal(scale=1e-4, size=(2, len(leg)))
    still["position.HipYawPitch"], still["position.HipRoll"] = noise
    write_log(replace(leg, channels={**leg.channels, **still}), tmp_path / "log.parquet")
    answer = cli("init", tmp_path / "log.parquet", "--model", LEG)
    assert answer.code == 0, answer.err
    study = tomllib.loads(answer.out)
    masses = [p for p in study["fit"] if p.startswith("mass:")]
    assert masses == ["mass:HipPitch", "mass:KneePitch", "mass:AnklePitch", "mass:AnkleRoll"]
    assert "kp:HipPitch,KneePitch,AnklePitch,AnkleRoll=shared" in study["fit"]
    assert answer.out.count("hardly moved") == 2


def test_effort_is_fitted_where_it_is_logged_and_a_built_in_robot_needs_no_path(cli: Cli) -> None:
    answer = cli("init", SAMPLES / "pendulum_weak.parquet", "--model", PENDULUM)
    assert tomllib.loads(answer.out)["channels"] == ["position", "effort"]
    answer = cli("init", SAMPLES / "nao_delay.parquet", "--model", "nao")
    study = tomllib.loads(answer.out)
    assert study["model"] == "nao"
    assert "mass:Torso" not in study["fit"]  # it was held
    assert "mass:RKneePitch" in study["fit"]


def test_several_logs_make_one_study(cli: Cli) -> None:
    answer = cli("init", SAMPLES / "leg_clean.parquet", SAMPLES / "leg_friction.parquet", "--model", LEG)
    assert answer.code == 0
    assert len(tomllib.loads(answer.out)["log"]) == 2
    assert answer.out.count("# --- ") == 2


@pytest.mark.parametrize(
    ("argv", "code", "said"),
    [
        ((), 2, "--model"),
        (("--model", str(LEG)), 2, "which log"),
        (("{desk}/walk.csv", "--model", str(LEG)), 3, "sysid-btr import"),
        ((str(SAMPLES / "leg_clean.parquet"), "--model", str(PENDULUM)), 4, "--rename"),
        ((str(SAMPLES / "leg_clean.parquet"), "--model", str(LEG), "--out", "{desk}/mapping.toml"), 2, "--overwrite"),
        ((str(SAMPLES / "leg_clean.parquet"), "--model", str(LEG), "--out", "{desk}/no/s.toml"), 2, "create it"),
    ],
    ids=["nothing", "no log", "foreign", "other robot", "there", "no folder"],
)
def test_mistakes_of_init_are_told(cli: Cli, desk: Path, argv: tuple[str, ...], code: int, said: str) -> None:
    files = {path: path.read_bytes() for path in desk.iterdir()}
    answer = cli("init", *(a.format(desk=desk) for a in argv))
    assert answer.code == code, answer.err
    assert said in answer.err
    assert {path: path.read_bytes() for path in desk.iterdir()} == files
