"""The report of every verb: what it holds, that it can be written again, light and dark, within its size."""

from __future__ import annotations

import json
import shutil
import subprocess
from collections.abc import Iterator
from dataclasses import replace
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from browser import BROWSER
from matplotlib.figure import Figure
from PIL import Image
from terminal import Cli

from sysid_btr.cli import run
from sysid_btr.cli.demo import sample_logs
from sysid_btr.identify.fit import Fit, fit
from sysid_btr.identify.study import make_study
from sysid_btr.io.parquet import read_log
from sysid_btr.models.builtin import load_robot
from sysid_btr.report.figures import correlate, plot_convergence, plot_overlay, plot_residuals
from sysid_btr.report.html import Picture, render
from sysid_btr.report.pictures import write_pages
from sysid_btr.report.style import DARK, LIGHT, ink, new_figure, page
from sysid_btr.report.traces import trace_outcome
from sysid_btr.result import read_result
from sysid_btr.run_folder import Folder

SAMPLES = sample_logs()
PENDULUM = ("--model", str(SAMPLES / "pendulum.xml"), "--threads", "1")
LOG = ("--log", str(SAMPLES / "pendulum_friction.parquet"))
RUNS = {
    "fit": (("fit", *PENDULUM, *LOG, "--fit", "mass:arm", "--profile", "mass:arm"), 0),
    "posterior": (("posterior", *PENDULUM, *LOG, "--fit", "mass:arm", "--fit", "kp:*", "--max-evaluations", "150"), 5),
    "excite": (("excite", *PENDULUM, "--fit", "mass:arm", "--seconds", "3", "--max-evaluations", "5"), 0),
    "btr": (
        ("btr", "--model", "ant", "--fit", "length:LFFemur", "--robot-sim", "ant", "--robot-set", "length:LFFemur=1.2",
         "--iterations", "1", "--trials", "1", "--duration", "1", "--threads", "1", "--choice", "fittest"),
        0,
    ),
}  # fmt: skip


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One finished run of every kind."""
    folder = tmp_path_factory.mktemp("runs")
    for name, (argv, code) in RUNS.items():
        assert run([*argv, "--out", str(folder / name)]) == code
    return folder


@pytest.fixture(scope="module")
def fitted() -> Fit:
    log = read_log(SAMPLES / "pendulum_friction.parquet")
    study = make_study(load_robot(str(SAMPLES / "pendulum.xml")), [log], threads=1)
    return fit(study, ["mass:arm", "kp:*"])


@pytest.mark.parametrize("kind", RUNS)
def test_the_report_can_be_written_again_from_the_folder(cli: Cli, folders: Path, kind: str) -> None:
    file = folders / kind / "report.html"
    before = file.read_bytes()
    file.unlink()
    answer = cli("report", folders / kind)
    assert answer.code == 0, answer.err
    assert str(file) in answer.out
    assert file.read_bytes() == before


@pytest.mark.parametrize("listed", ["/etc/hostname", "../secret.png", "secret.txt", "link.png", "text.png", 7])
def test_a_folder_from_somebody_else_shows_nothing_of_this_machine(
    cli: Cli, folders: Path, tmp_path: Path, listed: object
) -> None:
    theirs = tmp_path / "theirs"
    shutil.copytree(folders / "fit", theirs)
    (theirs / "report.html").unlink()
    (tmp_path / "secret.png").write_text("secret")
    (theirs / "text.png").write_text("secret")
    (theirs / "link.png").symlink_to(tmp_path / "secret.png")
    result = read_result(theirs)
    (theirs / "result.json").write_text(json.dumps({**result, "pictures": [listed]}))
    answer = cli("report", theirs)
    assert answer.code == 2
    assert f"{listed}: pictures are PNG files in the same folder" in answer.err
    assert not (theirs / "report.html").exists()


def test_a_picture_that_cannot_be_drawn_costs_no_more_than_itself(folders: Path, tmp_path: Path) -> None:
    result = read_result(folders / "fit")

    def fails() -> Figure:
        assert read_result(tmp_path)["message"] == result["message"], "written before anything is drawn"
        raise ValueError("no such axis")

    write_pages(Folder(tmp_path), result, [("overlay", fails), ("trace", lambda: new_figure(2, 1))])
    assert read_result(tmp_path)["pictures"] == ["trace.png"]
    assert read_result(tmp_path)["not_drawn"] == ["overlay.png: ValueError: no such axis"]
    assert "no such axis" in (tmp_path / "report.html").read_text()


def test_what_was_fitted_is_what_everything_speaks_of(cli: Cli, tmp_path: Path) -> None:
    asked = ("--model", SAMPLES / "pendulum.xml", "--log", SAMPLES / "pendulum_weak.parquet", "--fit", "kp:*")
    out = tmp_path / "out"
    answer = cli("fit", *asked, "--channels", "effort", "--out", out)
    assert answer.code == 0, answer.err
    result = read_result(out)
    assert "held-out effort error goes from" in result["message"]
    assert "Held-out effort error of each joint" in (out / "report.html").read_text()
    assert "position error" not in (out / "report.html").read_text()


@pytest.mark.parametrize("kind", RUNS)
def test_every_report_is_one_small_offline_file_for_light_and_dark(folders: Path, kind: str) -> None:
    text = (folders / kind / "report.html").read_text()
    assert len(text.encode()) < 5_000_000
    for outside in ("http:", "https:", 'src="/', "@import", "<script", "<link"):
        assert outside not in text
    result = read_result(folders / kind)
    assert result["message"].split("+-")[0] in text.replace("&#39;", "'")
    assert "not_drawn" not in result
    count = len(result["pictures"])
    assert count >= 1
    assert text.count('<img src="data:image/png;base64,') == count
    assert text.count('media="(prefers-color-scheme: dark)"><img') == count
    for name in result["pictures"]:
        for file, theme in ((folders / kind / name, LIGHT), (folders / kind / "dark" / name, DARK)):
            corner = Image.open(BytesIO(file.read_bytes())).convert("RGB").getpixel((1, 1))
            wanted = {"white": (255, 255, 255)}.get(theme["paper"], (13, 17, 23))
            assert np.abs(np.subtract(corner, wanted)).max() <= 3


def test_the_report_of_a_posterior_shows_the_draws_and_whether_to_believe_them(folders: Path) -> None:
    text = (folders / "posterior" / "report.html").read_text()
    for part in ("The posterior<", "Did the draws converge?", "Posterior prediction of held-out data",
                 "How the posterior was drawn", "R-hat", "effective draws", "prior", "uniform",
                 "in the 95 % bands", "The budget was spent"):  # fmt: skip
        assert part in text, part
    assert read_result(folders / "posterior")["pictures"] == [
        "overlay.png", "predictive.png", "corner.png", "trace.png", "residuals.png"
    ]  # fmt: skip


def test_the_report_of_a_fit_shows_its_search_and_profiles(folders: Path) -> None:
    text = (folders / "fit" / "report.html").read_text()
    for part in ("Profile of the likelihood: mass:arm", "Progress of the search", "Is the residual correlated"):
        assert part in text


def test_the_report_of_a_motion_says_what_to_do_with_it(folders: Path) -> None:
    text = (folders / "excite" / "report.html").read_text()
    for part in ("Excitation trajectory", "excite.parquet", "hitting the robot itself", "Cramer-Rao", "identifiable<"):
        assert part in text


def test_the_report_of_back_to_reality_shows_every_iteration(folders: Path) -> None:
    text = (folders / "btr" / "report.html").read_text()
    for part in ("Iterations", "best in the model", "The best controller", "its 36 numbers"):
        assert part in text


def test_a_picture_that_is_gone_is_left_out(cli: Cli, folders: Path, tmp_path: Path) -> None:
    copy = tmp_path / "copy"
    shutil.copytree(folders / "fit", copy)
    (copy / "residuals.png").unlink()
    assert cli("report", copy).code == 0
    text = (copy / "report.html").read_text()
    assert "Is the residual correlated" not in text
    assert "Progress of the search" in text


def test_a_result_of_an_earlier_version_has_its_overlay(cli: Cli, folders: Path, tmp_path: Path) -> None:
    import json

    copy = tmp_path / "copy"
    copy.mkdir()
    result = read_result(folders / "fit")
    del result["pictures"]
    (copy / "result.json").write_text(json.dumps(result))
    (copy / "overlay.png").write_bytes((folders / "fit" / "overlay.png").read_bytes())
    assert cli("report", copy).code == 0
    assert (copy / "report.html").read_text().count("<img ") == 1


def test_a_page_that_would_be_too_large_leaves_out_and_says_what(fitted: Fit) -> None:
    result = {**fitted.to_dict(), "padding": "x" * 1_000_000}
    half = bytes(400_000)
    pictures = [Picture(f"picture {i}", "", half, half) for i in range(12)]
    text = render(result, pictures)
    assert len(text) < 5_000_000
    assert text.count("<img ") == 7
    assert 'prefers-color-scheme: dark)"><img' not in text
    assert "Left out" in text
    assert "picture 11" in text.partition("Left out")[2]
    assert "result.json beside this page" in text
    few = render(fitted.to_dict(), pictures[:2])
    assert few.count("<source") == 2
    assert "Left out" not in few


# --- figures -------------------------------------------------------------------------------------------------


@pytest.fixture
def dark() -> Iterator[None]:
    with page(dark=True):
        yield


def test_figures_follow_the_style_in_force(fitted: Fit, dark: None) -> None:
    assert ink() == DARK["ink"]
    axes = plot_overlay(trace_outcome(fitted))
    lines = {line.get_label(): line.get_color() for line in axes[0][1].get_lines()}
    assert lines["log"] == DARK["ink"]
    assert axes.shape[1] == 3
    assert plot_convergence(fitted).get_lines()[0].get_color() == DARK["ink"]


def test_residuals_of_the_plain_model_follow_the_command_and_those_of_the_fit_do_less(fitted: Fit) -> None:
    traces = trace_outcome(fitted)
    _, right = plot_residuals(traces)[0]
    plain, better = (np.abs(line.get_ydata()).max() for line in right.get_lines())
    assert plain > 0.3
    assert better < plain


def test_correlation_finds_a_late_copy_and_nothing_in_noise() -> None:
    rng = np.random.default_rng(0)
    signal = rng.normal(size=4000)
    late = np.roll(signal, 7) + 0.1 * rng.normal(size=4000)
    found, band = correlate(late, signal, 20)
    assert int(np.argmax(found)) == 7
    assert found[7] > 0.95
    others = np.delete(found, 7)
    assert np.mean(np.abs(others) < band) > 0.8
    holes = late.copy()
    holes[100:400] = np.nan
    again, wider = correlate(holes, signal, 20)
    assert again[7] > 0.9
    assert wider > band
    nothing, _ = correlate(np.full(50, np.nan), signal[:50], 3)
    assert not nothing.any()


def test_a_joint_of_a_fit_without_measurement_is_drawn_all_the_same(fitted: Fit) -> None:
    trace = trace_outcome(fitted)[0]
    empty = replace(trace, measured=np.full(len(trace.time), np.nan), command=np.full(len(trace.time), np.nan))
    assert plot_residuals([empty]).shape == (1, 2)


def test_a_result_is_shown_once_in_a_notebook(fitted: Fit, monkeypatch: pytest.MonkeyPatch) -> None:
    shown: list[object] = []
    monkeypatch.setattr("rich.console._is_jupyter", lambda: True)
    monkeypatch.setattr("rich.jupyter.display", lambda *args: shown.append(args))
    assert "mass:arm" in fitted._repr_html_()
    assert shown == []


def test_results_show_themselves_in_a_notebook(fitted: Fit) -> None:
    from sysid_btr.posterior.draw import posterior
    from sysid_btr.posterior.sampling import Settings

    drawn = posterior(fitted, settings=Settings(draws=50.0, fewest_steps=10), rng=np.random.default_rng(0))
    for outcome in (fitted, drawn):
        text = outcome._repr_html_()
        assert "mass:arm" in text
        assert "95 % interval" in text
    assert "samples" in fitted.study.train[0].log._repr_html_()
    assert "with a drive" in fitted.study.robot._repr_html_()


# --- a real browser -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("dark_page", [False, True], ids=["light", "dark"])
def test_a_browser_shows_the_page_as_the_reader_likes_it(folders: Path, tmp_path: Path, dark_page: bool) -> None:
    if BROWSER is None:
        pytest.skip("no chromium or chrome on this machine")
    shot = tmp_path / "page.png"
    flags = ["--headless", "--no-sandbox", "--disable-gpu", "--hide-scrollbars", "--window-size=900,1200"]
    if dark_page:
        flags += ["--force-dark-mode", "--blink-settings=preferredColorScheme=0"]
    # offline: whatever the page asked for from outside would be missing
    flags += ["--host-resolver-rules=MAP * ~NOTFOUND", f"--user-data-dir={tmp_path / 'profile'}"]
    subprocess.run(
        [BROWSER, *flags, f"--screenshot={shot}", (folders / "fit" / "report.html").as_uri()],
        capture_output=True, check=True, timeout=60,
    )  # fmt: skip
    pixels: Any = np.asarray(Image.open(shot).convert("L"))
    assert (np.median(pixels) > 240) != dark_page
    assert (np.median(pixels) < 40) == dark_page
    assert pixels.std() > 15, "something is drawn"
