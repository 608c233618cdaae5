"""The command line: exit codes, messages, files; on a pendulum whose log the package made itself."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from terminal import Cli

from sysid_btr.cli import run
from sysid_btr.cli.demo import cases
from sysid_btr.identify.replay import replay_log
from sysid_btr.io.log import Log, LogMeta
from sysid_btr.io.parquet import read_log, write_log
from sysid_btr.models.builtin import load_robot
from sysid_btr.result import read_result
from sysid_btr.simulation.numerics import Numerics

MASS, KP, FRICTION = 1.2, 0.9, 0.1
PENDULUM = """
<mujoco model="pendulum">
  <compiler angle="radian"/>
  <worldbody>
    <body name="arm" pos="0 0 1">
      <joint name="hinge" axis="0 1 0" armature="0.01" damping="0.05" range="-2 2" limited="false"/>
      <geom type="capsule" fromto="0 0 0 0 0 -0.3" size="0.02" mass="0.5" contype="0" conaffinity="0"/>
    </body>
  </worldbody>
  <actuator><position name="hinge" joint="hinge" kp="8" kv="0.4"/></actuator>
</mujoco>
"""


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a model, a log of it with another mass and gain, and logs that cannot be used."""
    folder = tmp_path_factory.mktemp("bench")
    (folder / "arm.xml").write_text(PENDULUM)
    (folder / "other.xml").write_text(PENDULUM.replace('"hinge"', '"wheel"'))
    (folder / "broken.xml").write_text("<mujoco><worldbody>")
    n, period = 1200, 0.01
    time_ = np.arange(n) * period
    command = 0.6 * np.sin(2.0 * time_) + 0.4 * np.sin(5.3 * time_ + 1) - 0.4 * np.sin(1.0)
    meta = LogMeta(robot="arm", sample_period=period, source="test")
    told = Log(time_, {"command.hinge": command}, meta, np.zeros(n, dtype=np.int64))
    truth = replay_log(
        load_robot(str(folder / "arm.xml")), told, {"mass:arm": MASS, "kp:hinge": KP}, numerics=Numerics("RK4", 0.0025)
    )
    sticky = replay_log(
        load_robot(str(folder / "arm.xml")),
        told,
        {"kp:hinge": KP, "frictionloss:hinge": FRICTION},
        numerics=Numerics("RK4", 0.0025),
    )
    rng = np.random.default_rng(7)
    stuck = sticky.channels["position.hinge"] + rng.normal(scale=5e-4, size=n)
    write_log(replace(told, channels={**told.channels, "position.hinge": stuck}), folder / "sticky.parquet")
    position = truth.channels["position.hinge"] + rng.normal(scale=5e-4, size=n)
    log = replace(told, channels={**told.channels, "position.hinge": position})
    write_log(log, folder / "arm.parquet")
    bad = position.copy()
    bad[50:60] = np.inf
    write_log(replace(log, channels={**log.channels, "position.hinge": bad}), folder / "inf.parquet")
    (folder / "text.parquet").write_text("time,position\n")
    return folder


@pytest.fixture
def asked(bench: Path) -> tuple[str, ...]:
    return ("--model", str(bench / "arm.xml"), "--log", str(bench / "arm.parquet"), "--threads", "1")


FREE = ("--fit", "mass:arm", "--fit", "kp:*=shared")


def test_fit_finds_the_truth_and_writes_every_file(cli: Cli, asked: tuple[str, ...], tmp_path: Path) -> None:
    out = tmp_path / "deep" / "out"
    answer = cli("fit", *asked, *FREE, "--out", out)
    assert answer.code == 0, answer.err
    assert {"result.json", "overlay.png", "report.html", "journal.jsonl"} <= {f.name for f in out.iterdir()}
    assert not list(out.glob(".*.part"))
    result = read_result(out)
    found = {p["name"]: p for p in result["parameters"]}
    for name, truth in (("mass:arm", MASS), ("kp:*", KP)):
        low, high = found[name]["ci95"]
        assert low <= truth <= high
        assert high - low < 0.05
    nominal = result["nominal"]["holdout"]["position"]["rmse"]
    fitted = result["before"]["holdout"]["position"]["rmse"]
    assert fitted < 1.1 * 5e-4 < nominal
    assert result["after"] == result["before"]
    assert "mass:arm" in answer.out
    assert (out / "overlay.png").read_bytes().startswith(b"\x89PNG")


def test_without_out_nothing_is_written(
    cli: Cli, asked: tuple[str, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert cli("fit", *asked, "--fit", "mass:arm").code == 0
    assert not list(tmp_path.iterdir())


def test_json_on_stdout_is_the_result_alone(cli: Cli, asked: tuple[str, ...], tmp_path: Path) -> None:
    answer = cli("fit", *asked, *FREE, "--json", "--out", tmp_path / "o")
    printed = json.loads(answer.out, parse_constant=_refuse)
    assert printed == read_result(tmp_path / "o")


def _refuse(constant: str) -> None:
    raise AssertionError(f"{constant} is not JSON")


def test_same_seed_same_numbers_and_the_seed_is_recorded(cli: Cli, asked: tuple[str, ...]) -> None:
    search = ("--estimator", "cmaes", "--max-evaluations", "60", "--seed", "3", "--json")
    first, second = (json.loads(cli("fit", *asked, *FREE, *search).out) for _ in range(2))
    assert first["parameters"] == second["parameters"]
    assert first["seed"] == 3


def test_the_start_does_not_change_the_answer(cli: Cli, asked: tuple[str, ...]) -> None:
    near = json.loads(cli("fit", *asked, *FREE, "--json").out)["parameters"]
    far = json.loads(cli("fit", *asked, *FREE, "--start", "mass:*=0.5", "--start", "kp:*=1.6", "--json").out)
    for a, b in zip(near, far["parameters"], strict=True):
        assert a["value"] == pytest.approx(b["value"], abs=0.1 * a["std"])


def test_existing_results_are_refused_and_untouched(cli: Cli, asked: tuple[str, ...], tmp_path: Path) -> None:
    out = tmp_path / "o"
    assert cli("fit", *asked, "--fit", "mass:arm", "--out", out).code == 0
    before = {f: f.read_bytes() for f in out.rglob("*") if f.is_file()}
    answer = cli("fit", *asked, *FREE, "--out", out)
    assert answer.code == 2
    assert "--overwrite" in answer.err
    assert "--resume" in answer.err
    assert {f: f.read_bytes() for f in out.rglob("*") if f.is_file()} == before
    assert cli("fit", *asked, *FREE, "--out", out, "--overwrite").code == 0
    assert len(read_result(out)["parameters"]) == 2


def test_foreign_files_in_out_are_no_obstacle(cli: Cli, asked: tuple[str, ...], tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("mine")
    assert cli("fit", *asked, "--fit", "mass:arm", "--out", tmp_path).code == 0
    assert (tmp_path / "notes.txt").read_text() == "mine"


def test_resume_needs_the_same_fit(cli: Cli, asked: tuple[str, ...], tmp_path: Path) -> None:
    out = tmp_path / "o"
    first = cli("fit", *asked, *FREE, "--out", out, "--json")
    again = cli("fit", *asked, *FREE, "--out", out, "--resume", "--json")
    assert json.loads(again.out)["parameters"] == json.loads(first.out)["parameters"]
    other = cli("fit", *asked, "--fit", "mass:arm", "--out", out, "--resume")
    assert other.code == 2
    assert "another fit" in other.err


def test_a_budget_too_small_is_written_and_exits_5(cli: Cli, asked: tuple[str, ...], tmp_path: Path) -> None:
    search = ("--estimator", "nlopt:LN_NELDERMEAD", "--max-evaluations", "4")
    answer = cli("fit", *asked, *FREE, *search, "--out", tmp_path / "o")
    assert answer.code == 5
    result = read_result(tmp_path / "o")
    assert result["converged"] is False
    assert "budget" in result["termination"]
    assert "budget" in answer.out


def test_nothing_identifiable_exits_5(cli: Cli, asked: tuple[str, ...], tmp_path: Path) -> None:
    # the arm touches nothing
    answer = cli("fit", *asked, "--fit", "foot_friction:arm", "--out", tmp_path / "o")
    assert answer.code == 5
    [parameter] = read_result(tmp_path / "o")["parameters"]
    assert parameter["identifiable"] == "no"
    assert parameter["reason"]
    assert "not identifiable" in answer.out


def test_one_parameter_that_is_told_is_enough(cli: Cli, asked: tuple[str, ...]) -> None:
    answer = cli("fit", *asked, "--fit", "kp:*", "--fit", "foot_friction:arm")
    assert answer.code == 0
    assert "not identifiable" in answer.out


BASE = ("--model", "{arm}", "--log", "{log}")
FITTING = (*BASE, "--fit", "mass:*")


@pytest.mark.parametrize(
    ("argv", "code", "said"),
    [
        (("fit",), 2, "--model"),
        (("fit", "--model", "{arm}"), 2, "--fit"),
        (("fit", "--model", "{arm}", "--fit", "mass:*"), 2, "--log"),
        (("fit", "--model", "{arm}", "--log", "{log}"), 2, "arm"),
        (("fit", "--model", "nowhere.xml", "--log", "{log}", "--fit", "mass:*"), 4, "nowhere.xml"),
        (("fit", "--model", "{broken}", "--log", "{log}", "--fit", "mass:*"), 4, "broken.xml"),
        (("fit", "--model", "{other}", "--log", "{log}", "--fit", "mass:*"), 4, "hinge"),
        (("fit", "--model", "{arm}", "--log", "missing.parquet", "--fit", "mass:*"), 3, "missing.parquet"),
        (("fit", "--model", "{arm}", "--log", "{text}", "--fit", "mass:*"), 3, "text.parquet"),
        (("fit", "--model", "{arm}", "--log", "{inf}", "--fit", "mass:*"), 3, "position.hinge"),
        (("fit", *BASE, "--fit", "mass:leg"), 2, "arm"),
        (("fit", *BASE, "--fit", "mas:arm"), 2, "'mass'"),
        (("fit", *BASE, "--fit", "mass:*=common"), 2, "shared"),
        (("fit", *FITTING, "--estimator", "lsqq"), 2, "lsq"),
        # said before the log is even looked for
        (("fit", "--model", "{arm}", "--log", "no", "--fit", "mass:*", "--distance", "mse"), 2, "lsq minimises"),
        (("fit", *FITTING, "--estimator", "cmaes+lsq", "--distance", "phi2"), 2, "cmaes+lsq minimises"),
        (("fit", *FITTING, "--holdout", "1.5"), 2, "between 0 and 1"),
        (("fit", *FITTING, "--holdout", "gone"), 3, "gone"),
        (("fit", *FITTING, "--start", "kp:*=1"), 2, "mass:arm"),
        (("fit", *FITTING, "--start", "mass:arm=9"), 2, "bounds"),
        (("fit", *FITTING, "--start", "mass:arm"), 2, "NAME=NUMBER"),
        (("fit", *FITTING, "--bounds", "mass=2:1"), 2, "LOW < HIGH"),
        (("fit", *FITTING, "--channels", "torque"), 2, "effort"),
        (("fit", *FITTING, "--resume"), 2, "--out"),
        (("fit", *FITTING, "--out", "{log}"), 2, "file"),
        (("fit", *FITTING, "--sed", "3"), 2, "--sed"),
        (("close", *BASE, "--effects", "backslash"), 2, "backlash"),
        (("replay", *BASE, "--set", "kp:*=x"), 2, "NAME=NUMBER"),
        (("replay", *BASE, "--set", "leg:*=1"), 2, "unknown field"),
        (("validate",), 2, "which log"),
        (("validate", "{text}", "{inf}"), 3, ""),
        (("report", "{folder}"), 2, "result.json"),
        (("dance",), 2, "dance"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, tuple) else None,
)
def test_mistakes_end_in_one_clear_message(cli: Cli, bench: Path, argv: tuple[str, ...], code: int, said: str) -> None:
    names = {
        "arm": bench / "arm.xml",
        "other": bench / "other.xml",
        "broken": bench / "broken.xml",
        "log": bench / "arm.parquet",
        "text": bench / "text.parquet",
        "inf": bench / "inf.parquet",
        "folder": bench,
    }
    files = set(bench.iterdir())
    answer = cli(*(a.format(**names) for a in argv))
    assert answer.code == code, answer.err
    assert said in answer.err
    assert set(bench.iterdir()) == files


def test_all_bad_logs_are_told_at_once(cli: Cli, bench: Path) -> None:
    logs = ("--log", bench / "text.parquet", "--log", bench / "inf.parquet")
    answer = cli("fit", "--model", bench / "arm.xml", *logs, "--fit", "mass:*")
    assert answer.code == 3
    assert "text.parquet" in answer.err
    assert "inf.parquet" in answer.err


def test_validate_says_where_and_what_to_do(cli: Cli, bench: Path) -> None:
    assert cli("validate", bench / "arm.parquet", "--model", bench / "arm.xml").code == 0
    answer = cli("validate", bench / "arm.parquet", "--model", bench / "other.xml", "--json")
    assert answer.code == 3
    problems = json.loads(answer.out)[str(bench / "arm.parquet")]
    assert any(p["severity"] == "error" and p["remedy"] for p in problems)


def test_replay_with_the_truth_leaves_only_noise(cli: Cli, asked: tuple[str, ...], tmp_path: Path) -> None:
    wrong = json.loads(cli("replay", *asked, "--json").out)
    out = tmp_path / "o"
    answer = cli("replay", *asked, "--set", f"mass:*={MASS}", "--set", f"kp:*={KP}", "--json", "--out", out)
    right = json.loads(answer.out)
    assert right["nominal"]["holdout"]["position"]["chi2"] == pytest.approx(1.0, abs=0.25)
    assert wrong["nominal"]["holdout"]["position"]["chi2"] > 10
    predicted = read_log(out / "arm.replayed.parquet")
    assert np.isfinite(predicted.channels["position.hinge"]).all()
    assert cli("replay", *asked, "--out", out).code == 2


def test_study_file_gives_every_flag_and_the_command_line_wins(cli: Cli, bench: Path, tmp_path: Path) -> None:
    study = tmp_path / "study.toml"
    study.write_text(
        f"""
        model = "{bench / "arm.xml"}"
        log = ["{bench / "arm.parquet"}"]
        fit = ["mass:arm", "kp:*=shared"]
        holdout = 0.2
        seed = 5
        threads = 1
        json = true
        [start]
        "mass:arm" = 0.8
        [bounds]
        "kp" = [0.5, 1.5]
        """
    )
    result = json.loads(cli("fit", "--config", study).out)
    assert result["seed"] == 5
    assert {p["name"]: p["bounds"] for p in result["parameters"]}["kp:*"] == [0.5, 1.5]
    over = json.loads(cli("fit", "--config", study, "--seed", "6", "--fit", "mass:arm").out)
    assert over["seed"] == 6
    assert [p["name"] for p in over["parameters"]] == ["mass:arm"]


@pytest.mark.parametrize(
    ("text", "said"), [("sed = 3", "sed"), ("seed = 'x'", "seed"), ("[[", "not TOML"), ("[bounds]\nkp = 2", "bounds")]
)
def test_study_file_mistakes(cli: Cli, tmp_path: Path, text: str, said: str) -> None:
    study = tmp_path / "study.toml"
    study.write_text(text)
    answer = cli("fit", "--config", study)
    assert answer.code == 2
    assert said in answer.err


def test_close_names_the_effect_and_resumes(cli: Cli, bench: Path, tmp_path: Path) -> None:
    out = tmp_path / "o"
    asked = ("--model", bench / "arm.xml", "--log", bench / "sticky.parquet", "--fit", "kp:*", "--threads", 1)
    asked = (*asked, "--effects", "coulomb_friction,viscous_damping", "--effects", "command_delay")
    answer = cli("close", *asked, "--out", out, "--explain")
    assert answer.code == 0, answer.err
    assert "leaves more than coulomb_friction at hinge" in answer.out.replace("\n", " ")
    result = read_result(out)
    assert result["verdict"] == "explained"
    [effect] = result["effects"]
    assert (effect["effect"], effect["where"]) == ("coulomb_friction", ["hinge"])
    [size] = effect["parameters"]
    assert size["value"] == pytest.approx(FRICTION, rel=0.15)
    assert effect["sentence"] in answer.out.replace("\n", " ")
    errors = [result[stage]["holdout"]["position"]["rmse"] for stage in ("nominal", "before", "after")]
    assert errors[2] < 0.2 * min(errors[:2])
    again = cli("close", *asked, "--out", out, "--resume", "--json")
    assert json.loads(again.out)["effects"] == result["effects"]


def test_what_a_log_calls_its_columns_does_not_reach_the_terminal_as_commands(
    cli: Cli, bench: Path, tmp_path: Path
) -> None:
    log = read_log(bench / "arm.parquet")
    evil = "\x1b]0;owned\x07\x1b[2J\x9b31m"
    columns = {**log.channels, f"position.{evil}": log.channels["position.hinge"]}
    write_log(replace(log, channels=columns), tmp_path / "evil.parquet")
    for verb in (("validate",), ("fit", "--fit", "kp:*", "--log")):
        answer = cli(*verb, tmp_path / "evil.parquet", "--model", bench / "arm.xml")
        shown = answer.out + answer.err
        assert r"\x1b" in shown, "shown as an escape"
        assert not set(shown) & set("\x1b\x07\x9b")


def test_a_journal_is_not_continued_with_a_model_whose_included_file_changed(
    cli: Cli, bench: Path, tmp_path: Path
) -> None:
    whole = (bench / "arm.xml").read_text()
    head, _, body = whole.partition("<worldbody>")
    (tmp_path / "arm.xml").write_text(f'{head}<include file="bodies.xml"/></mujoco>')
    (tmp_path / "bodies.xml").write_text(f"<mujoco><worldbody>{body}")
    asked = ("fit", "--model", tmp_path / "arm.xml", "--log", bench / "arm.parquet", "--fit", "kp:*")
    assert cli(*asked, "--out", tmp_path / "out").code == 0
    assert cli(*asked, "--out", tmp_path / "out", "--resume").code == 0
    (tmp_path / "bodies.xml").write_text(f"<mujoco><worldbody>{body}".replace('mass="', 'mass="1'))
    answer = cli(*asked, "--out", tmp_path / "out", "--resume")
    assert answer.code == 2
    assert "belongs to another fit" in answer.err


def test_the_same_recording_counts_once_whatever_it_is_called(cli: Cli, bench: Path, tmp_path: Path) -> None:
    asked = ("fit", "--model", bench / "arm.xml", "--log", bench / "arm.parquet", "--fit", "kp:*")
    log = read_log(bench / "arm.parquet")
    copy = tmp_path / "copy.parquet"
    write_log(replace(log, time=log.time + 3.0, meta=replace(log.meta, notes="a copy")), copy)
    for again in (("--log", bench / "arm.parquet"), ("--log", copy), ("--holdout", copy)):
        answer = cli(*asked, *again)
        assert answer.code == 2
        assert f"{again[1]} holds the same recording as {bench / 'arm.parquet'}" in answer.err


def test_a_folder_that_another_process_writes_is_refused_until_that_ends(cli: Cli, bench: Path, tmp_path: Path) -> None:
    hold = "import sys, time; from pathlib import Path; from sysid_btr.run_folder import open_folder; "
    hold += "held = open_folder(Path(sys.argv[1])); print('held', flush=True); time.sleep(60)"
    asked = ("fit", "--model", bench / "arm.xml", "--log", bench / "arm.parquet", "--fit", "kp:*", "--out", tmp_path)
    with subprocess.Popen([sys.executable, "-c", hold, str(tmp_path)], stdout=subprocess.PIPE, text=True) as other:
        assert other.stdout is not None
        assert other.stdout.readline() == "held\n"
        answer = cli(*asked)
        other.kill()
    assert answer.code == 2
    assert f"in use by process {other.pid} on" in answer.err
    assert "since 20" in answer.err
    answer = cli(*asked)
    assert answer.code == 0, answer.err


@pytest.mark.parametrize("there", [False, True])
def test_a_run_that_cannot_start_leaves_the_folders_as_they_were(
    cli: Cli, bench: Path, tmp_path: Path, there: bool
) -> None:
    out = tmp_path / "runs" / "first"
    if there:
        out.mkdir(parents=True)
    answer = cli(
        "fit", "--model", bench / "arm.xml", "--log", bench / "arm.parquet", "--fit", "mass:nowhere", "--out", out
    )
    assert answer.code == 2
    assert "nowhere" in answer.err
    assert out.exists() is there


def test_close_without_fit_says_what_it_fits(cli: Cli, bench: Path) -> None:
    asked = ("--model", bench / "arm.xml", "--log", bench / "arm.parquet", "--effects", "coulomb_friction")
    answer = cli("close", *asked)
    assert answer.code == 0
    assert "fitting mass:*, kp:*=shared" in answer.err
    assert "nothing missing" in answer.out


def test_demo_runs_on_logs_that_are_there(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("SYSID_BTR_DATA", str(tmp_path))
    [case] = cases()
    assert case.log.is_file()
    assert Path(case.model).is_file()
    (tmp_path / "emps").mkdir()
    (tmp_path / "emps" / "emps.parquet").touch()
    assert [c.name for c in cases()] == [case.name, "emps"]
    assert "--fit 'kp:*=shared'" in case.command(tmp_path)


def test_report_is_written_again_from_the_result(cli: Cli, asked: tuple[str, ...], tmp_path: Path) -> None:
    out = tmp_path / "o"
    cli("fit", *asked, *FREE, "--out", out)
    (out / "report.html").unlink()
    assert cli("report", out).code == 0
    page = (out / "report.html").read_text()
    assert "mass:arm" in page
    assert "http://" not in page
    assert "https://" not in page


def test_an_internal_error_is_short(cli: Cli, asked: tuple[str, ...], monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object, **__: object) -> None:
        raise ZeroDivisionError("no")

    monkeypatch.setattr("sysid_btr.identify.study.make_study", fail)
    answer = cli("fit", *asked, *FREE)
    assert answer.code == 1
    assert "ZeroDivisionError" in answer.err
    assert "--debug" in answer.err
    with pytest.raises(ZeroDivisionError):
        run(["fit", *asked, *FREE, "--debug"])


def test_ctrl_c_keeps_the_journal_and_resume_gives_the_same_answer(
    asked: tuple[str, ...], tmp_path: Path, cli: Cli
) -> None:
    search = (*asked, *FREE, "--estimator", "ga", "--seed", "1", "--max-evaluations", "600")
    out = tmp_path / "o"
    command = [sys.executable, "-m", "sysid_btr.cli", "fit", *search, "--out", str(out)]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    deadline = time.monotonic() + 60
    journal = out / "journal.jsonl"
    while time.monotonic() < deadline and not (journal.exists() and journal.stat().st_size > 5000):
        time.sleep(0.02)
    process.send_signal(signal.SIGINT)
    _, err = process.communicate(timeout=60)
    assert process.returncode == 130, err
    assert "--resume" in err
    assert "Traceback" not in err
    assert {f.name for f in out.iterdir()} == {"journal.jsonl"}
    resumed = cli("fit", *search, "--out", out, "--resume", "--json")
    straight = cli("fit", *search, "--json")
    assert json.loads(resumed.out)["parameters"] == json.loads(straight.out)["parameters"]


LEVER = """<mujoco><worldbody><body name="lever"><joint name="lever" axis="0 1 0" damping="5"/>
  <geom type="capsule" fromto="0 0 0 0 0 -.5" size=".03" mass="1"/></body></worldbody>
  <actuator><motor joint="lever"/></actuator></mujoco>"""


def test_torques_that_look_like_mirrored_degrees_are_torques_to_a_robot_with_motors(cli: Cli, tmp_path: Path) -> None:
    """A lever that is held against gravity: its torque follows its position, other way round and 60 times as far."""
    model = tmp_path / "lever.xml"
    model.write_text(LEVER)
    clock = np.arange(400) * 0.01
    angle = 0.4 * np.sin(2 * clock) + 0.2 * np.sin(3.1 * clock)
    log = tmp_path / "lever.parquet"
    channels = {"command.lever": -58.0 * angle, "position.lever": angle}
    write_log(Log(clock, channels, LogMeta(robot="lever", sample_period=0.01), np.zeros(400, dtype=np.int64)), log)
    assert cli("replay", "--model", str(model), "--log", str(log)).code == 0
    alone = cli("validate", str(log))
    assert alone.code == 3
    assert 'set "drive": "torque" in the metadata' in " ".join((alone.out + alone.err).split())
