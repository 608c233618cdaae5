"""Runs side by side: what differs, what drifts, and what cannot be compared."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from terminal import Cli

import sysid_btr as sb
from sysid_btr.cli.demo import sample_logs
from sysid_btr.comparing import CHANCE, Row, _tested, holm
from sysid_btr.errors import UsageError
from sysid_btr.result import to_json
from sysid_btr.run_folder import make_relative, open_folder
from sysid_btr.writeback.write import describe_model

SAMPLES = sample_logs()
MODEL = str(SAMPLES / "pendulum.xml")


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two runs of the pendulum: clean, and with friction."""
    folder = tmp_path_factory.mktemp("runs")
    for name, source in (("new", "clean"), ("worn", "friction")):
        log = sb.read_log(SAMPLES / f"pendulum_{source}.parquet").window(0, 500)
        sb.write_log(log, folder / f"{name}.parquet")
        study = sb.make_study(sb.load_robot(MODEL), [sb.read_log(folder / f"{name}.parquet")], threads=1)
        free = ["mass:*", "kp:*"]
        outcome = sb.fit(study, free) if name == "new" else sb.close(study, free, effects=["coulomb_friction"])
        result = outcome.to_dict()
        run = open_folder(folder / name)
        describe_model(outcome, result, run)
        make_relative(result, run.path)
        run.write("result.json", to_json(result))
    return folder


def variant(source: Path, target: Path, change: Any) -> Path:
    """A run whose result.json is changed."""
    content = json.loads((source / "result.json").read_text())
    change(content)
    target.mkdir()
    (target / "result.json").write_text(to_json(content))
    return target


def moved(by: float, date: str = "", sha: str = "") -> Any:
    """A change of the first parameter by some standard errors, as from another log."""

    def change(content: dict[str, Any]) -> None:
        entry = content["parameters"][0]
        entry["value"] += by * entry["std"]
        content["logs"][0] |= {"sha256": sha or f"{by}{date}", "recorded": date or None}

    return change


def test_holm_is_the_published_example() -> None:
    # four hypotheses at 0.05 (Holm 1979): the two smallest are rejected
    np.testing.assert_allclose(holm([0.01, 0.04, 0.03, 0.005]), [0.03, 0.06, 0.06, 0.02])
    assert holm([]) == []


@pytest.mark.parametrize("count", [2, 4])
def test_of_runs_that_do_not_differ_few_are_said_to(count: int) -> None:
    rng = np.random.default_rng(1)
    said = []
    for _ in range(300):
        std = rng.uniform(0.01, 0.1, (8, count))
        values = 1.0 + std * rng.normal(size=std.shape)
        sides = [[{"value": v, "std": s} for v, s in zip(*pair, strict=True)] for pair in zip(values, std, strict=True)]
        rows = _tested([Row(str(k), "1", tuple(side)) for k, side in enumerate(sides)])
        said.append(any(row.real for row in rows))
    assert np.mean(said) <= CHANCE + 3 * np.sqrt(CHANCE * (1 - CHANCE) / len(said))


def test_what_differs_is_told_from_what_does_not(runs: Path, tmp_path: Path) -> None:
    far = variant(runs / "new", tmp_path / "far", moved(6.0))
    found = sb.compare([runs / "new", far])
    mass, kp = found.parameters
    assert mass.times == pytest.approx(6 / np.sqrt(2))
    assert (mass.real, kp.real) == (True, False)
    assert found.message == "1 of 2 parameters differ between the runs: mass:arm."
    near = variant(runs / "new", tmp_path / "near", moved(1.0))
    assert not any(row.real for row in sb.compare([runs / "new", near]).parameters)


def test_a_parameter_that_wears_drifts(runs: Path, tmp_path: Path) -> None:
    days = [variant(runs / "new", tmp_path / f"d{k}", moved(3.0 * k, f"2026-01-{1 + 10 * k:02d}")) for k in range(4)]
    mass, kp = sb.compare(list(reversed(days))).parameters  # in the order of their dates
    std = json.loads((runs / "new" / "result.json").read_text())["parameters"][0]["std"]
    assert mass.drift == pytest.approx(0.3 * std)
    assert mass.drift_p is not None
    assert mass.drift_p < CHANCE
    assert kp.drift == pytest.approx(0.0, abs=1e-12)
    undated = sb.compare([variant(d, tmp_path / f"u{d.name}", moved(0, "", d.name)) for d in days])
    assert undated.parameters[0].drift is None
    dated = sb.compare([r.folder for r in undated.runs], dates=["2026-01-01", "2026-01-11", "2026-01-21", "2026-01-31"])
    assert dated.parameters[0].drift == pytest.approx(mass.drift)


def test_errors_are_compared_on_a_common_log(runs: Path) -> None:
    common = sb.read_log(runs / "worn.parquet")
    found = sb.compare([runs / "new", runs / "worn"], logs=[common], threads=1)
    [row] = [e for e in found.errors if e.data == "worn.parquet" and e.channel == "position"]
    new, worn = row.rmse
    assert new is not None
    assert worn is not None
    assert worn < 0.5 * new
    assert any("worn was fitted to" in remark for remark in found.remarks)


def test_effects_come_and_go(runs: Path) -> None:
    [row] = sb.compare([runs / "new", runs / "worn"]).effects
    assert (row.effect, row.where, row.became) == ("coulomb_friction", "pendulum", "came")
    assert (
        "coulomb_friction at pendulum is no longer found"
        in sb.compare([runs / "worn", runs / "new"], dates=["2026-01-01", "2026-01-02"]).message
    )


def test_the_verb_prints_and_writes_the_same_numbers(cli: Cli, runs: Path, tmp_path: Path) -> None:
    answer = cli("compare", runs / "new", runs / "worn", "--out", tmp_path / "both")
    assert answer.code == 0, answer.err
    assert "mass:arm" in answer.out
    assert "Holm" in answer.out
    content = json.loads((tmp_path / "both" / "compare.json").read_text())
    table = pd.read_csv(tmp_path / "both" / "parameters.csv").set_index("name")
    for row in content["parameters"]:
        for run, side in zip(content["runs"], row["values"], strict=True):
            if side is not None:
                assert table.loc[row["name"], f"{run['label']}.value"] == pytest.approx(side["value"])
    page = (tmp_path / "both" / "compare.html").read_text()
    assert "mass:arm" in page
    assert "http" not in page
    assert cli("compare", runs / "new", runs / "worn", "--out", tmp_path / "both").code == 2
    assert json.loads(cli("compare", runs / "new", runs / "worn", "--json").out)["parameters"] == content["parameters"]


def test_runs_of_one_log_are_shown_and_not_tested(runs: Path, tmp_path: Path) -> None:
    digest = json.loads((runs / "new" / "result.json").read_text())["logs"][0]["sha256"]
    found = sb.compare([runs / "new", variant(runs / "new", tmp_path / "same", moved(9.0, "", digest))])
    assert all(row.real is None and row.times is None for row in found.parameters)
    assert any("fitted to the same log" in remark for remark in found.remarks)


def test_what_cannot_be_compared_is_refused(runs: Path, tmp_path: Path) -> None:
    def robot(content: dict[str, Any]) -> None:
        content["model"] |= {"name": "leg", "sha256": "other"}

    def names(content: dict[str, Any]) -> None:
        for p in content["parameters"]:
            p["name"] = f"damping:{p['name']}"

    def kind(content: dict[str, Any]) -> None:
        content["kind"] = "replay"

    for name, change, said in (
        ("r", robot, "different robots"),
        ("p", names, "no parameter in common"),
        ("k", kind, "replay"),
    ):
        other = variant(runs / "new", tmp_path / name, change)
        with pytest.raises(UsageError, match=said):
            sb.compare([runs / "new", other])
    with pytest.raises(UsageError, match="finished run"):
        sb.compare([runs / "new", tmp_path])
    with pytest.raises(UsageError, match="two different runs"):
        sb.compare([runs / "new", runs / "new"])
    with pytest.raises(UsageError, match="not a date"):
        sb.compare([runs / "new", runs / "worn"], dates=["monday", "friday"])
