"""A new user's afternoon, from the README alone: a CSV comes in, a model goes out and is used elsewhere."""

from __future__ import annotations

import json
from pathlib import Path

import mujoco
import numpy as np
import pytest
from browser import BROWSER, browse

import sysid_btr as sb
from sysid_btr.cli import run
from sysid_btr.cli.demo import sample_logs
from sysid_btr.player import Player

SAMPLES = sample_logs()
ROBOT = SAMPLES / "pendulum.xml"
FREED = ["--fit", "mass:*", "--fit", "kp:*"]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two recordings as a spreadsheet would hold them: degrees, milliseconds."""
    home = tmp_path_factory.mktemp("afternoon")
    for name in ("pendulum_friction", "pendulum_clean"):
        table = sb.read_log(SAMPLES / f"{name}.parquet").window(0, 800).to_pandas().reset_index()
        table = table[[c for c in table.columns if c == "time" or c.startswith(("command.", "position."))]]
        for column in table.columns.drop("time"):
            table[column] = np.degrees(table[column])
        table["time"] = 1e3 * table["time"]
        table.to_csv(home / f"{name}.csv", index=False)
    return home


def test_the_afternoon(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def shell(*words: object) -> str:
        code = run([str(word) for word in words])
        out, err = capsys.readouterr()
        assert code == 0, f"{words}: {out}{err}"
        return out

    for name in ("pendulum_friction", "pendulum_clean"):
        units = ["--unit", "position=deg", "--unit", "command=deg", "--unit", "time=ms"]
        shell("import", folder / f"{name}.csv", "--model", ROBOT, *units, "--out", folder / f"{name}.parquet")
    log, later = folder / "pendulum_friction.parquet", folder / "pendulum_clean.parquet"
    shell("validate", log, "--model", ROBOT)
    told = shell("check", "--model", ROBOT, "--log", log, *FREED)
    assert "mass" in told
    shell("fit", "--model", ROBOT, "--log", log, *FREED, "--out", folder / "fitted")
    named = shell(
        "close", "--model", ROBOT, "--log", log, *FREED, "--effects", "coulomb_friction", "--out", folder / "out"
    )
    assert "dry friction" in named
    shell("fit", "--model", ROBOT, "--log", later, *FREED, "--out", folder / "later")
    compared = shell("compare", folder / "out", folder / "later", "--log", later, "--out", folder / "compared")
    assert "coulomb_friction" in compared

    result = json.loads((folder / "out" / "result.json").read_text())
    (friction,) = result["effects"][0]["parameters"]
    drawn = sb.sample(folder / "out", 100)
    spread = drawn.to_pandas()[friction["name"]]
    assert len(spread) == 100
    assert spread.mean() == pytest.approx(friction["value"], abs=friction["std"])
    models = [sb.model(folder / "out", draw) for draw in drawn]
    assert [float(model.dof_frictionloss[0]) for model in models] == pytest.approx(list(spread))

    measured, player = sb.read_log(log), Player.load(folder / "out")
    played = player.play(measured)
    assert isinstance(player.model, mujoco.MjModel)
    joint = measured.joints("position")[0]
    error = played.channels[f"position.{joint}"] - measured.channels[f"position.{joint}"]
    after = result["after"]["holdout"]["position"]["rmse"]
    assert np.sqrt(np.mean(error[len(error) // 10 :] ** 2)) < 2 * after

    tables = sb.tables(folder / "out")
    assert tables["parameters"].loc[friction["name"], "value"] == friction["value"]
    page = (folder / "out" / "report.html").read_text()
    assert "dry friction" in page
    assert "http://" not in page.replace("http://www.w3.org", "")
    shell("report", folder / "out")
    if BROWSER is not None:
        for page in (folder / "out" / "report.html", folder / "compared" / "compare.html"):
            for width in (1200, 400):
                shown = browse(page, folder, width)  # fails on any line in the console
                assert shown["cut"] == []
                assert shown["scrolled"] == 0
        explored = browse(folder / "out" / "explore.html", folder, 1200)
        assert explored["ready"] == "yes"
        assert str(friction["value"])[:10] in explored["saved"][1]
