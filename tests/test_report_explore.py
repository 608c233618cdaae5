"""The page to explore: what it holds without a browser, and what it does in one."""

from __future__ import annotations

import gzip
import json
import re
import shutil
from base64 import b64decode
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from browser import browse
from terminal import Cli

from sysid_btr.cli import run
from sysid_btr.cli.demo import sample_logs
from sysid_btr.identify.episode import FixedEpisode
from sysid_btr.identify.fit import Fit, fit
from sysid_btr.identify.study import make_study
from sysid_btr.io.log import Log, LogMeta
from sysid_btr.io.parquet import read_log
from sysid_btr.models.builtin import load_robot
from sysid_btr.models.robot import joint_names
from sysid_btr.objectives.targets import COMPARED
from sysid_btr.report.bodies import MOST_FACES, bodies_of, placed
from sysid_btr.report.explore import MOST_NUMBERS, NEXT, explorable, explorer, next_step
from sysid_btr.report.guide import about_verdict
from sysid_btr.report.pictures import write_pages
from sysid_btr.report.style import DARK, LIGHT
from sysid_btr.report.traces import Played, PlayedEpisode, Trace
from sysid_btr.result import read_result, result_schema
from sysid_btr.run_folder import Folder
from sysid_btr.simulation.numerics import Numerics
from sysid_btr.terms.base import Outputs

SAMPLES = sample_logs()
LEG, LOG = SAMPLES / "leg.xml", SAMPLES / "leg_friction.parquet"
LARGEST = 8_000_000
EMPTY = {"kind": "fit", "message": "", "model": {"name": ""}, "parameters": [], "effects": []}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A leg, fitted."""
    out = tmp_path_factory.mktemp("explored") / "leg"
    asked = ["fit", "--model", str(LEG), "--log", str(LOG), "--fit", "kp:*", "--fit", "mass:KneePitch"]
    assert run([*asked, "--threads", "1", "--out", str(out)]) == 0
    return out


@pytest.fixture(scope="module")
def pendulum() -> Fit:
    log = read_log(SAMPLES / "pendulum_clean.parquet")
    study = make_study(load_robot(str(SAMPLES / "pendulum.xml")), [log], threads=1)
    return fit(study, ["mass:arm", "kp:*"])


def series(folder: Path) -> Any:
    return json.loads(gzip.decompress((folder / "explore.json.gz").read_bytes()))


def unpacked(entry: dict[str, Any]) -> Any:
    return np.frombuffer(b64decode(entry["data"]), f"<{entry['type']}").reshape(entry["shape"])


# --- what it holds -------------------------------------------------------------------------------------------


def test_every_joint_is_there_as_logged_and_as_scored(folder: Path) -> None:
    log, result, content = read_log(LOG), read_result(folder), series(folder)
    (episode,) = content["episodes"]
    assert content["models"] == ["plain model", "fitted"]
    assert content["stride"] == 1
    assert f'"{content["schema"]}"' in (folder / "explore.html").read_text(), "the page knows what it reads"
    joints = [sensor["joint"] for sensor in episode["sensors"] if sensor["channel"] == "position"]
    assert set(joints) == set(log.joints("position"))
    plain = [s["errors"][0] / s["noise"] for s in episode["sensors"] if s["channel"] == "position"]
    assert plain == sorted(plain, reverse=True), "worst first"
    assert unpacked(episode["time"]) == pytest.approx(log.time - log.time[0], abs=1e-5)
    ((begin, end),) = episode["held_out"]
    assert 0.65 < begin / (log.time[-1] - log.time[0]) < 0.75
    assert end == pytest.approx(log.time[-1] - log.time[0])
    for sensor in episode["sensors"]:
        name = f"{sensor['channel']}.{sensor['joint']}"
        assert unpacked(sensor["log"]) == pytest.approx(log.channels[name], abs=1e-6)
        assert unpacked(sensor["command"]) == pytest.approx(log.channels[f"command.{sensor['joint']}"], abs=1e-6)
        scored = [
            result[stage]["holdout"][sensor["channel"]]["joints"][sensor["joint"]] for stage in ("nominal", "after")
        ]
        assert sensor["errors"] == pytest.approx(scored, rel=1e-9), "both pages say the same"
        held = unpacked(episode["time"]) >= begin
        residual = [(unpacked(sensor["log"]) - unpacked(p))[held] for p in sensor["predicted"]]
        assert [float(np.sqrt(np.mean(r**2))) for r in residual] == pytest.approx(scored, rel=0.02)


def test_bodies_stand_where_mujoco_puts_them(folder: Path) -> None:
    content = series(folder)
    (episode,) = content["episodes"]
    scene, log = episode["scene"], read_log(LOG)
    model = mujoco.MjModel.from_xml_path(str(LEG))
    data = mujoco.MjData(model)
    poses = unpacked(scene["poses"]) / 32767
    times = unpacked(scene["time"])
    assert 2 <= len(times) <= 600
    for frame in (0, len(times) // 2, len(times) - 1):
        row = int(np.argmin(np.abs(log.time - log.time[0] - times[frame])))
        for joint in log.joints("position"):
            data.qpos[model.joint(joint).qposadr[0]] = log.channels[f"position.{joint}"][row]
        mujoco.mj_kinematics(model, data)
        for k, body in enumerate(content["bodies"]):
            assert poses[frame, 0, k, :3] * scene["extent"] == pytest.approx(data.body(body["name"]).xpos, abs=1e-4)
            assert poses[frame, 0, k, 3:] == pytest.approx(data.body(body["name"]).xquat, abs=1e-4)


SHAPES = """
<mujoco>
  <asset><mesh name="wedge" vertex="0 0 0  1 0 0  0 1 0  0 0 1"/></asset>
  <worldbody>
    <geom type="plane" size="1 1 1"/>
    <body name="box"><freejoint/><geom type="box" size="0.1 0.2 0.3" pos="1 0 0" euler="0 0 90"/></body>
    <body name="ball"><freejoint/><geom type="sphere" size="0.5"/></body>
    <body name="pill"><freejoint/><geom type="capsule" size="0.1 0.4"/></body>
    <body name="can"><freejoint/><geom type="cylinder" size="0.1 0.4"/></body>
    <body name="egg"><freejoint/><geom type="ellipsoid" size="0.1 0.2 0.3"/></body>
    <body name="wedge"><freejoint/><geom type="mesh" mesh="wedge"/></body>
    <body name="empty"><freejoint/><inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/></body>
  </worldbody>
</mujoco>
"""


def test_shapes_are_closed_and_as_large_as_they_should_be() -> None:
    model = mujoco.MjModel.from_xml_string(SHAPES)
    found = {body.name: body for body in bodies_of(model)}
    assert set(found) == {"box", "ball", "pill", "can", "egg", "wedge"}
    exact = {
        "box": 8 * 0.1 * 0.2 * 0.3,
        "ball": 4 / 3 * np.pi * 0.5**3,
        "pill": np.pi * 0.1**2 * 0.8 + 4 / 3 * np.pi * 0.1**3,
        "can": np.pi * 0.1**2 * 0.8,
        "egg": 4 / 3 * np.pi * 0.1 * 0.2 * 0.3,
        "wedge": 1 / 6,
    }
    for name, body in found.items():
        a, b, c = (body.vertices[body.faces[:, k]] for k in range(3))
        volume = float(np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6)  # positive only if faces look outward
        assert 0.75 * exact[name] < volume <= exact[name] * 1.0001, name
        assert len(body.faces) < 120
    box = found["box"].vertices
    assert box.min(axis=0) == pytest.approx([0.8, -0.1, -0.3])
    assert box.max(axis=0) == pytest.approx([1.2, 0.1, 0.3])


def test_a_robot_of_many_parts_is_drawn_coarser() -> None:
    parts = "".join(f'<geom size="{0.1 + 0.01 * k}" pos="{k} 0 0"/>' for k in range(60))
    (body,) = bodies_of(mujoco.MjModel.from_xml_string(f"<mujoco><worldbody><body>{parts}</body></worldbody></mujoco>"))
    assert 60 * 10 < len(body.faces) <= MOST_FACES


def test_bodies_are_placed_by_every_kind_of_joint() -> None:
    model = mujoco.MjModel.from_xml_string(SHAPES)
    pose = np.zeros((1, model.nq))
    pose[0, 3::7] = 1.0
    pose[0, 7:14] = [1, 2, 3, 0, 1, 0, 0]
    bodies = bodies_of(model)
    there = placed(model, bodies, pose)[0, [body.name for body in bodies].index("ball")]
    assert there == pytest.approx([1, 2, 3, 0, 1, 0, 0])


def test_sensitivities_are_what_a_small_change_of_each_parameter_does(pendulum: Fit) -> None:
    problem = pendulum.study.train_problem(pendulum.model)
    small = 1e-2
    for i, entry in enumerate(pendulum.to_dict()["sensitivity"]):
        moved = pendulum.model.values.copy()
        moved[i] += small * entry["change"]
        candidates = np.stack([pendulum.model.values, moved])
        (episode,) = problem.episodes
        outputs = episode.replay.predict(candidates)
        for target in episode.targets:
            plain, other = target.predicted(outputs)
            for k, joint in enumerate(target.joints):
                rows = target.mask[:, k]
                change = (other - plain)[rows, k] / small / target.noise[k]
                wanted = float(np.sqrt(np.mean(change**2)))
                assert entry["moves"][f"{target.channel}.{joint}"] == pytest.approx(wanted, rel=0.02)


def test_the_search_is_in_the_result_as_the_estimator_had_it(pendulum: Fit) -> None:
    history = pendulum.to_dict()["history"]
    assert [(h["replays"], h["loss"]) for h in history] == list(pendulum.result.history)
    assert pendulum.to_pandas("history")["loss"].is_monotonic_decreasing


# --- the file ------------------------------------------------------------------------------------------------


def test_it_is_one_offline_file_that_can_be_written_again(cli: Cli, folder: Path) -> None:
    page = folder / "explore.html"
    before = page.read_bytes()
    assert len(before) < LARGEST
    assert read_result(folder)["explore"] == "explore.json.gz"
    text = re.sub(r'<script type="application/gzip"[^<]*</script>', "", before.decode())
    for outside in ("http:", "https:", 'src="', "@import", "<link", "url("):
        assert outside not in text
    for name in ("report.html", "model.xml", "params.json", "result.json"):
        assert f'<a href="{name}">' in text
        assert (folder / name).is_file()
    assert '<a href="explore.html">' in (folder / "report.html").read_text()
    page.unlink()
    assert cli("report", folder).code == 0
    assert page.read_bytes() == before


def test_a_log_that_is_too_long_is_thinned_and_the_page_says_so() -> None:
    """Noise, which nothing compresses, in every sensor of 22 joints at 500 Hz for 40 s, under three models."""
    rng = np.random.default_rng(0)
    time = np.arange(20_000) / 500
    robot = load_robot(str(SAMPLES / "nao.xml"))
    joints = joint_names(robot)
    names = [f"{channel}.{joint}" for channel in ("command", *COMPARED) for joint in joints]
    channels = {name: 0.3 * rng.normal(size=len(time)) for name in names}
    episode = FixedEpisode.whole(robot, Log(time, channels, LogMeta(), np.zeros(len(time), dtype=np.int64)))
    replay = episode.replay((), Numerics("RK4", 0.002))
    traces = [
        Trace(joint, channel, "rad", time, channels[f"command.{joint}"], channels[f"{channel}.{joint}"],
              {name: 0.3 * rng.normal(size=len(time)) for name in "abc"}, time >= 28.0, 1e-3, dict.fromkeys("abc", 1.0))
        for channel in COMPARED
        for joint in joints
    ]  # fmt: skip
    shape = (1, len(time), len(joints))
    outputs = {n: Outputs(time, 0.3 * rng.normal(size=shape), np.zeros(shape), None) for n in "abc"}
    long = explorable(Played((PlayedEpisode("", episode, replay, outputs, tuple(traces)),), ("a", "b", "c"), "a"))
    content = json.loads(gzip.decompress(long))
    stride = content["stride"]
    assert stride > 1
    assert unpacked(content["episodes"][0]["time"]) == pytest.approx(time[::stride], abs=1e-5)
    numbers = sum(unpacked(s["log"]).size * (2 + len(s["predicted"])) for s in content["episodes"][0]["sensors"])
    assert 0.5 * MOST_NUMBERS < numbers <= 1.01 * MOST_NUMBERS
    assert len(explorer({**EMPTY, "padding": "x" * 1_000_000}, long, set())) < LARGEST


def test_names_from_somebody_else_are_shown_and_not_run(folder: Path) -> None:
    evil = "</script><script>alert(1)</script>"
    result = {**read_result(folder), "message": evil}
    result["parameters"][0]["name"] = evil
    assert evil not in explorer(result, b"", {evil})


def test_series_from_outside_the_folder_are_not_read(cli: Cli, folder: Path, tmp_path: Path) -> None:
    theirs = tmp_path / "theirs"
    shutil.copytree(folder, theirs)
    (theirs / "explore.html").unlink()
    (tmp_path / "secret").write_bytes(gzip.compress(b"secret"))
    (theirs / "explore.json.gz").unlink()
    (theirs / "explore.json.gz").symlink_to(tmp_path / "secret")
    assert cli("report", theirs).code == 0
    assert not (theirs / "explore.html").exists()
    assert "explore.html" not in (theirs / "report.html").read_text()


@pytest.mark.parametrize("verdict", sorted(NEXT))
def test_the_page_says_what_its_verdict_means_as_the_guide_does(folder: Path, verdict: str) -> None:
    about = about_verdict(verdict)
    assert about.count("<p>") >= 2
    assert "<i>Do</i>" in about
    assert not re.search(r"[`*|]|\]\(", re.sub("<code>.*?</code>", "", about)), "no Markdown is left"
    assert about in explorer({**read_result(folder), "verdict": verdict}, b"", set())
    assert about_verdict("") == about_verdict("no verdict") == ""


def test_a_page_of_an_earlier_run_does_not_stay_beside_another(folder: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    shutil.copytree(folder, out)
    result = {name: value for name, value in read_result(folder).items() if name != "explore"}
    write_pages(Folder(out), result, [])
    assert not {"explore.html", "explore.json.gz"} & {file.name for file in out.iterdir()}
    assert "explore.html" not in (out / "report.html").read_text()


def test_a_page_that_cannot_be_made_costs_no_more_than_itself(folder: Path, tmp_path: Path) -> None:
    def fails() -> bytes:
        raise ValueError("no such body")

    write_pages(Folder(tmp_path), read_result(folder), [], fails)
    assert read_result(tmp_path)["not_drawn"] == ["explore.html: ValueError: no such body"]
    assert not (tmp_path / "explore.html").exists()


def test_what_comes_next_is_said_of_every_outcome(folder: Path) -> None:
    result = read_result(folder)
    verdicts = result_schema()["properties"]["verdict"]["enum"]
    assert set(NEXT) == set(verdicts)
    said = {next_step({**result, "verdict": verdict}) for verdict in verdicts}
    assert len(said) == len(verdicts)
    assert "--resume" in next_step({**result, "converged": False})
    assert "sysid-btr close" in next_step({**result, "misfit": {"joint": "knee"}})
    known = [{**p, "identifiable": "yes"} for p in result["parameters"]]
    assert "Use model.xml" in next_step({**result, "misfit": None, "parameters": known})
    known[0]["identifiable"] = "no"
    assert known[0]["name"] in next_step({**result, "misfit": None, "parameters": known})


# --- a real browser -----------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("dark", [False, True], ids=["light", "dark"])
@pytest.mark.parametrize("width", [1200, 400])
def test_a_browser_shows_one_cursor_over_everything(folder: Path, tmp_path: Path, width: int, dark: bool) -> None:
    found = browse(folder / "explore.html", tmp_path, width, dark=dark)
    assert found["ready"] == "yes"
    assert found["width"][1] <= found["width"][0] == width, "nothing to scroll sideways"
    assert found["cut"] == []
    assert found["scrolled"] == 0, "no table is cut"
    assert all(found["plots"])
    early, late, played = (found[name] for name in ("early", "late", "played"))
    for view, time in ((early, 2.0), (late, 12.5)):
        assert [cursor[:2] for cursor in view["cursors"]] == [[time, "block"]] * 2
        assert view["now"] == f"{time:.2f} s"
    assert all(b[2] > a[2] for a, b in zip(early["cursors"], late["cursors"], strict=True))
    for part in ("readout", "robots"):
        assert early[part] != late[part]
    assert played["cursors"][0][0] != 12.5
    assert played["cursors"][0][0] == played["cursors"][1][0]
    whole, half, again = found["spans"]
    assert [2 * half, again] == pytest.approx([whole, whole])
    first, second, back = found["joint"]
    assert first != second
    assert back == first
    assert all(joint in title for joint, title in found["joint"])
    assert found["lines"][:2] == ["command", "log"]
    theme = DARK if dark else LIGHT
    assert found["ink"][1] == theme["ink"]
    assert found["ink"][0] == "rgb({}, {}, {})".format(*bytes.fromhex(theme["ink"][1:]))
    errors, parameters = found["saved"]
    result = read_result(folder)
    assert f"{result['after']['holdout']['position']['joints'][first[0]]!r}"[:12] in errors
    assert all(p["name"] in parameters and f"{p['value']!r}"[:12] in parameters for p in result["parameters"])


@pytest.mark.slow
def test_no_table_of_a_comparison_is_cut(folder: Path, tmp_path: Path) -> None:
    other = tmp_path / "other"
    shutil.copytree(folder, other)
    assert run(["compare", str(folder), str(other), "--out", str(tmp_path / "both")]) == 0
    found = browse(tmp_path / "both" / "compare.html", tmp_path, 400)
    assert found["width"][1] <= found["width"][0] == 400
    assert found["cut"] == []
    assert found["scrolled"] == 0


@pytest.mark.slow
@pytest.mark.parametrize("width", [1200, 400])
@pytest.mark.parametrize("page", ["report.html", "explore.html"])
def test_no_table_is_cut_however_long_its_names(cli: Cli, folder: Path, tmp_path: Path, page: str, width: int) -> None:
    out = tmp_path / "out"
    shutil.copytree(folder, out)
    result = read_result(out)
    result["parameters"][0]["name"] = "command_delay:" + ",".join(joint_names(load_robot("nao")))
    (out / "result.json").write_text(json.dumps(result))
    assert cli("report", out).code == 0
    found = browse(out / page, tmp_path, width)
    assert found["width"][1] <= found["width"][0] == width
    assert found["cut"] == []
    assert found["scrolled"] == 0
