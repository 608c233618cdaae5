"""Streams that were started apart."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sysid_btr.cli.commands import run
from sysid_btr.io.log import Log, LogMeta
from sysid_btr.io.shift import shift_streams
from sysid_btr.io.validation import validate_log


def swinging(late: float, hold: str = "linear") -> Log:
    time = np.arange(1000) / 100
    command = sum(np.sin(2 * np.pi * f * time + 9 * f) for f in (0.23, 0.53, 0.81, 1.13)) / 3
    position = np.interp(time - late - 0.04, time, command)
    meta = LogMeta(sample_period=0.01, command_hold=hold)  # type: ignore[arg-type]
    return Log(time, {"command.knee": command, "position.knee": position}, meta, np.zeros(1000, dtype=np.int64))


def test_validate_says_by_how_much_and_the_shift_mends_it() -> None:
    log = swinging(1.41)
    (late,) = [p for p in validate_log(log) if p.code == "joint.late"]
    assert "--shift command=1.4" in late.remedy
    mended = shift_streams(log, {"command": 1.41})
    assert not [p for p in validate_log(mended) if p.code == "joint.late"]
    inside = log.time > 1.5
    np.testing.assert_allclose(
        mended.channels["command.knee"][inside],
        np.interp(log.time - 1.41, log.time, log.channels["command.knee"])[inside],
    )
    assert mended.channels["position.knee"] is log.channels["position.knee"]


def test_held_commands_stay_steps_and_sensors_end_where_nothing_is_known() -> None:
    log = swinging(0.0, hold="zoh")
    moved = shift_streams(log, {"command": 0.25, "position.knee": -0.1})
    np.testing.assert_array_equal(moved.channels["command.knee"][25:], log.channels["command.knee"][:-25])
    assert (moved.channels["command.knee"][:25] == log.channels["command.knee"][0]).all()
    np.testing.assert_allclose(moved.channels["position.knee"][:-10], log.channels["position.knee"][10:])
    assert np.isnan(moved.channels["position.knee"][-9:]).all()


def test_what_is_fed_forward_is_held_as_the_command_is() -> None:
    log = swinging(0.0, hold="zoh")
    fed = replace(log, channels={**log.channels, "command_velocity.knee": 3 * log.channels["command.knee"]})
    moved = shift_streams(fed, {"command": 0.123, "command_velocity": 0.123}).channels
    np.testing.assert_array_equal(moved["command_velocity.knee"], 3 * moved["command.knee"])


def test_episodes_do_not_flow_into_each_other() -> None:
    log = swinging(0.0)
    two = replace(log, episode=np.repeat([0, 1], 500))
    moved = shift_streams(two, {"command": 0.2}).channels["command.knee"]
    assert moved[500:520] == pytest.approx(log.channels["command.knee"][500])


def test_a_stream_that_no_log_has_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    leg = Path(__file__).parent.parent / "sample_logs"
    asked = ["fit", "-m", str(leg / "leg.xml"), "-l", str(leg / "leg_clean.parquet"), "-f", "mass:*"]
    assert run([*asked, "--shift", "comand=1"]) == 2
    assert "did you mean command?" in capsys.readouterr().err


@pytest.mark.parametrize(("late", "seed"), [(0.02, 0), (0.006, 1), (0.004, 2)])
def test_a_velocity_that_lags_is_noted_with_its_lag_and_the_shift_mends_it(late: float, seed: int) -> None:
    log, rng = swinging(0.0), np.random.default_rng(seed)
    moving = np.interp(log.time - late, log.time, np.gradient(log.channels["position.knee"], 0.01))
    noise = {"position.knee": 5e-4, "velocity.knee": 0.02}
    channels = {**log.channels, "velocity.knee": moving + 0.01}  # a bias is no lag
    channels = {n: c + noise.get(n, 0.0) * rng.normal(size=len(c)) for n, c in channels.items()}
    log = replace(log, channels=channels)
    (told,) = [p for p in validate_log(log) if p.code == "velocity.late"]
    assert told.severity == "note"
    found = -float(told.remedy.partition("velocity=")[2].split()[0])
    assert found == pytest.approx(late, abs=0.001)
    mended = shift_streams(log, {"velocity": -found})
    assert not [p for p in validate_log(mended) if p.code == "velocity.late"]


@pytest.mark.parametrize("scale", [1.0, 1.2, 57.3, -1.0, 0.0])
def test_a_velocity_of_its_time_is_not_called_late_whatever_else_it_is(scale: float) -> None:
    log, rng = swinging(0.0), np.random.default_rng(3)
    moving = scale * np.gradient(log.channels["position.knee"], 0.01) + 0.02 * rng.normal(size=len(log))
    log = replace(log, channels={**log.channels, "velocity.knee": moving})
    assert not [p for p in validate_log(log) if p.code == "velocity.late"]
