"""Pictures of log, model before and model after; and what happens where nothing can draw."""

from __future__ import annotations

from dataclasses import replace
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from sysid_btr.cli import run
from sysid_btr.cli.demo import sample_logs
from sysid_btr.identify.fit import fit
from sysid_btr.identify.study import make_study
from sysid_btr.io.parquet import read_log, write_log
from sysid_btr.models.builtin import load_robot
from sysid_btr.report import render
from sysid_btr.report.render import PANEL, CannotRenderError, backends, draw, save_pictures, scene_of
from sysid_btr.run_folder import Folder

SAMPLES = sample_logs()


@pytest.fixture(scope="module")
def fitted() -> Any:
    log = read_log(SAMPLES / "pendulum_friction.parquet")
    study = make_study(load_robot(str(SAMPLES / "pendulum.xml")), [log], threads=1)
    return fit(study, ["frictionloss:pendulum"])


def needs_a_driver(fitted: Any) -> None:
    """Skip where this machine draws nothing."""
    scene = scene_of(fitted)
    try:
        draw(scene, [[0]], np.array([0, 0, 0.5, 1, 90, 0.0]), [(16, 16)])
    except CannotRenderError as error:
        pytest.skip(f"nothing draws off-screen here: {error}")


def test_moments_are_where_the_models_differ_most(fitted: Any) -> None:
    scene = scene_of(fitted)
    held_out = scene.time >= fitted.study.holdout[0].begin
    assert all(held_out[i] for i in scene.moments)
    assert list(scene.moments) == sorted(set(scene.moments))
    before, after = scene.apart["model before"], scene.apart["model after"]
    assert max(before[list(scene.moments)]) > 0.9 * before[held_out].max()
    assert after[list(scene.moments)].mean() < 0.3 * before[list(scene.moments)].mean()
    assert not scene.apart["log"].any()


def test_poses_are_those_of_log_and_replay(fitted: Any) -> None:
    scene, log = scene_of(fitted), fitted.study.holdout[0].log
    np.testing.assert_array_equal(scene.poses["log"][:, 0], log.channels["position.pendulum"])
    replay = fitted.study.holdout_problem(fitted.model).episodes[0].replay
    np.testing.assert_array_equal(
        scene.poses["model after"][:, 0], replay.predict(fitted.values[None]).position[0, :, 0]
    )


def test_missing_samples_are_bridged(fitted: Any) -> None:
    [episode] = fitted.study.holdout
    log = episode.log
    holes = log.channels["position.pendulum"].copy()
    holes[100:120] = np.nan
    patched = replace(log, channels={**log.channels, "position.pendulum": holes})
    scene = scene_of(replace(fitted, study=replace(fitted.study, holdout=(replace(episode, recording=patched),))))
    assert np.isfinite(scene.poses["log"]).all()


def test_pictures_show_the_robot(fitted: Any, tmp_path: Path) -> None:
    needs_a_driver(fitted)
    still, film = save_pictures(Folder(tmp_path), fitted)
    sheet = Image.open(BytesIO(still.read_bytes()))
    assert sheet.width == 3 * PANEL[1]
    assert sheet.height > 3 * PANEL[0]
    pixels = np.asarray(sheet.convert("RGB"), dtype=float)
    log, before = pixels[22 : PANEL[0], : PANEL[1]], pixels[22 : PANEL[0], PANEL[1] : 2 * PANEL[1]]
    assert np.ptp(log.mean(axis=2)) > 60, "the robot stands out of the backdrop"
    assert np.abs(log - before).max() > 30, "the model is drawn in another pose, and with the log's in red"
    animation = Image.open(BytesIO(film.read_bytes()))
    assert getattr(animation, "n_frames", 1) > 20
    assert film.stat().st_size < 3_000_000


def test_the_users_driver_is_the_only_one_tried(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MUJOCO_GL", "osmesa")
    assert backends() == ["osmesa"]
    monkeypatch.delenv("MUJOCO_GL")
    assert "egl" in backends()


def test_without_a_driver_nothing_is_lost(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("MUJOCO_GL", "no_such_driver")
    log = read_log(SAMPLES / "pendulum_friction.parquet")
    path = tmp_path / "short.parquet"
    write_log(log.window(0, 300), path)
    flags = ["--model", SAMPLES / "pendulum.xml", "--log", path, "--fit", "mass:arm", "--threads", 1]
    code = run(["fit", *map(str, flags), "--out", str(tmp_path / "out"), "--render"])
    told = capsys.readouterr().err
    assert code == 0
    assert "no pictures: nothing here draws off-screen (no_such_driver: " in told
    assert "Traceback" not in told
    assert (tmp_path / "out" / "result.json").is_file()
    assert not list((tmp_path / "out").glob("render.*"))


def test_a_driver_that_hangs_is_given_up(fitted: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(render, "PATIENCE", 0.01)
    monkeypatch.setenv("MUJOCO_GL", "egl")
    with pytest.raises(CannotRenderError, match=r"egl: .* timed out"):
        draw(scene_of(fitted), [[0]], np.zeros(6), [(16, 16)])


def test_pictures_need_a_folder(capsys: pytest.CaptureFixture[str]) -> None:
    code = run(["fit", "--model", str(SAMPLES / "pendulum.xml"), "--log", str(SAMPLES / "pendulum_friction.parquet"),
                "--fit", "mass:arm", "--render"])  # fmt: skip
    assert code == 2
    assert "--render writes pictures: give an --out folder" in capsys.readouterr().err
