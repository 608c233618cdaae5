"""Progress: a line at once, one now and then, and what is going on before anything is fitted."""

from __future__ import annotations

import io
import math
import re
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mujoco.batch import Batch
from terminal import Cli
from toys import make_log, pendulum, run, swing

from sysid_btr.diagnosis.close import close
from sysid_btr.identify.fit import fit
from sysid_btr.identify.study import make_study
from sysid_btr.progress import ProgressLine, mention, phase
from sysid_btr.simulation.numerics import Numerics
from sysid_btr.terms.grammar import parse_parameters


def test_the_first_report_is_a_line_at_once_and_the_next_ones_wait() -> None:
    stream = io.StringIO()
    with ProgressLine("close", stream) as progress:
        progress(done=0, total=None, best=float("inf"), note="reading the motion")
        progress(done=3, total=None, best=2.0, note="iteration 1")
    assert stream.getvalue() == "close: 0 replays, 0 s, reading the motion\n"


def test_a_study_and_the_first_fits_say_what_they_do() -> None:
    """They take minutes for a floating base, before the search itself begins."""
    notes: list[str] = []

    def note(**said: Any) -> None:
        notes.append(said["note"])

    commanded = swing()
    position = run(pendulum(), commanded).position[0]
    noisy = position + np.random.default_rng(0).normal(scale=1e-3, size=position.shape)
    log = make_log(commanded.time, {**commanded.channels, "position.arm": noisy[:, 0]})
    study = make_study(pendulum(), [log], numerics=Numerics("RK4", 0.005), threads=1, progress=note)
    assert notes == ["reading the motion", "initial states"]
    fit(study, ["kp:*"], progress=note)
    assert notes.count("choosing starts") > 1


SAMPLES = Path(__file__).resolve().parents[1] / "sample_logs"
LEG = ("--model", SAMPLES / "leg.xml", "--log", SAMPLES / "leg_clean.parquet")
WALK = ("--model", "nao", "--log", SAMPLES / "nao_walk.parquet")


@pytest.mark.parametrize(
    "argv",
    [
        ("fit", *LEG, "--fit", "kp:*=shared"),
        ("fit", *WALK, "--fit", "kp:*=shared"),
        ("close", *LEG),
        ("posterior", *LEG, "--fit", "kp:*=shared"),
        ("replay", *LEG),
        ("replay", *WALK),
        ("check", *LEG),
        ("excite", "--model", SAMPLES / "leg.xml", "--fit", "kp:*=shared", "--out", "motion"),
        ("btr", "--model", "ant", "--robot-sim", "ant", "--fit", "mass:*"),
    ],
    ids=lambda argv: f"{argv[0]}{' of a walk' if WALK[-1] in argv else ''}",
)
def test_the_first_line_comes_before_anything_is_simulated(
    argv: tuple[object, ...], cli: Cli, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def simulate(*_: Any, **__: Any) -> None:
        raise RuntimeError("a simulation")

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(Batch, "__init__", simulate)
    answer = cli(*argv)
    assert "a simulation" in answer.err, "none was begun"
    assert f"{argv[0]}: 0 replays, " in answer.err


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """The time that progress lines see, to be set."""
    now = [0.0]
    monkeypatch.setattr(time, "monotonic", lambda: now[0])
    return now


def test_what_is_done_of_a_run_follows_from_its_phases_and_never_falls(clock: list[float]) -> None:
    stream = io.StringIO()
    with ProgressLine("fit", stream, _begun=clock[0]) as progress:
        for name, share in (("study", 0.2), ("search", 0.5), ("intervals", 0.9)):
            with phase(name, share):
                for k in range(1, 21):
                    clock[0] += 11.0
                    progress(done=k, total=None, best=1.0, note=f"iteration {k}")
    lines = stream.getvalue().splitlines()
    done = [int(percent) for line in lines for percent in re.findall(r"(\d+) %", line)]
    assert done == sorted(done)
    assert "search: iteration 20" in lines[-21]
    assert 20 < done[-21] <= 20 + 0.5 * 80
    assert done[-1] > 80
    elapsed, left = re.findall(r"([\d.]+) (?:s|min)", lines[-1])
    assert float(left) * 60 == pytest.approx(float(elapsed) * (100 / done[-1] - 1), abs=31)


def test_a_total_that_is_known_says_how_much_of_a_phase_is_done(clock: list[float]) -> None:
    stream = io.StringIO()
    with ProgressLine("posterior", stream, _begun=clock[0]) as progress, phase("draws", 0.8):
        clock[0] = 40.0
        progress(done=50, total=100, best=math.nan, note="")
    assert stream.getvalue().splitlines()[-1] == "posterior: 40 %, 50 replays, 40 s, about 60 s left, draws"


def test_long_work_without_a_search_says_how_far_it_is(clock: list[float]) -> None:
    stream = io.StringIO()
    mention("nobody listens", 0.5)
    with ProgressLine("fit", stream, _begun=clock[0]) as progress:
        progress(done=0, total=None, best=math.inf, note="reading the motion")
        with phase("states of the base", 0.4):
            clock[0] = 30.0
            mention("round 3 of 4", 0.5)
    assert stream.getvalue().splitlines()[-1] == (
        "fit: 20 %, 0 replays, 30 s, about 2 min left, states of the base: round 3 of 4"
    )


def test_a_loss_means_the_same_all_through_a_run() -> None:
    """Where something is missing, columns are weighed anew on the way: losses under other weights are not shown."""
    commanded = swing(seconds=4.0)
    position = run(pendulum(), commanded, parse_parameters(["frictionloss:arm"], pendulum()), [0.1]).position[0]
    noisy = position + np.random.default_rng(0).normal(scale=1e-3, size=position.shape)
    log = make_log(commanded.time, {**commanded.channels, "position.arm": noisy[:, 0]})
    study = make_study(pendulum(), [log], numerics=Numerics("RK4", 0.005), threads=1)
    shown: list[float] = []

    def note(*, best: float, **_: Any) -> None:
        if math.isfinite(best):
            shown.append(best)

    found = close(study, ["kp:*"], effects=("coulomb_friction",), progress=note)
    assert found.verdict == "explained"
    assert len(shown) > 3
    assert max(shown) < 1.5 * min(shown), "the first fits have found where it is least"
