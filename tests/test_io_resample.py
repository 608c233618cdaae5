"""Resampling, commands at arbitrary times, and splits."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from sysid_btr.errors import LogError, UsageError
from sysid_btr.io import Log, LogMeta, command_at, holdout_split, read_log, resample
from sysid_btr.io.split import held_out_all_over, spans_of


def small_log(time: np.ndarray, command: np.ndarray, position: np.ndarray, hold: str = "zoh", **more: object) -> Log:
    n = len(time)
    return Log(
        time=np.asarray(time, dtype=np.float64),
        channels={
            "command.a": np.asarray(command, dtype=np.float64),
            "position.a": np.asarray(position, dtype=np.float64),
        },
        meta=LogMeta(command_hold=hold),  # type: ignore[arg-type]
        episode=np.asarray(more.get("episode", np.zeros(n)), dtype=np.int64),
    )


@st.composite
def logs(draw: st.DrawFn, origin: float = 0.0) -> Log:
    n = draw(st.integers(2, 40))
    # Whole microseconds, and no interval long enough to be a gap.
    steps = draw(st.lists(st.integers(8_000, 12_000), min_size=n - 1, max_size=n - 1))
    values = st.lists(st.floats(-3, 3), min_size=n, max_size=n)
    time = origin + np.concatenate(([0], np.cumsum(steps))) * 1e-6
    return small_log(time, np.array(draw(values)), np.array(draw(values)))


PERIODS = st.integers(500, 30_000).map(lambda us: us * 1e-6)


def away_from_the_tolerance(log: Log, period: float) -> bool:
    """Whether no grid point lies just where it starts to count as the next sample (either answer is right)."""
    grid = log.time[0] + np.arange(int((log.time[-1] - log.time[0]) / period) + 2) * period
    snap = 0.01 * np.median(np.diff(log.time))
    return bool(np.min(np.abs(np.subtract.outer(log.time - snap, grid))) > 1e-9)


@given(log=logs(), period=PERIODS)
@settings(max_examples=80, deadline=None)
def test_grid_is_exact(log: Log, period: float) -> None:
    out = resample(log, period)
    np.testing.assert_array_equal(out.time, log.time[0] + np.arange(len(out)) * period)
    slack = 0.011 * np.median(np.diff(log.time))
    assert out.time[-1] <= log.time[-1] + slack
    assert out.time[-1] + period > log.time[-1] - 1e-9
    assert out.meta.sample_period == period


@given(log=logs(), period=PERIODS)
@settings(max_examples=80, deadline=None)
def test_commands_are_held_and_sensors_interpolated(log: Log, period: float) -> None:
    assume(away_from_the_tolerance(log, period))
    out = resample(log, period)
    snap = 0.01 * np.median(np.diff(log.time))
    for t, command, position in zip(out.time, out.channels["command.a"], out.channels["position.a"], strict=True):
        held = int(np.sum(log.time <= t + snap)) - 1
        assert command == log.channels["command.a"][held]
        expected = np.interp(t, log.time, log.channels["position.a"])
        assert position == pytest.approx(expected, abs=1e-6)


@given(log=logs(), period=PERIODS)
@settings(max_examples=80, deadline=None)
def test_resampling_twice_changes_nothing(log: Log, period: float) -> None:
    once = resample(log, period)
    twice = resample(once, period)
    np.testing.assert_array_equal(once.time, twice.time)
    for name in once.channels:
        np.testing.assert_array_equal(once.channels[name], twice.channels[name])


@given(log=logs(), period=PERIODS)
@settings(max_examples=80, deadline=None)
def test_the_origin_of_time_does_not_matter(log: Log, period: float) -> None:
    assume(away_from_the_tolerance(log, period))
    moved = resample(replace(log, time=log.time + 1000.0), period)
    out = resample(log, period)
    np.testing.assert_allclose(moved.time - 1000.0, out.time, atol=1e-9)
    np.testing.assert_array_equal(moved.channels["command.a"], out.channels["command.a"])
    np.testing.assert_allclose(moved.channels["position.a"], out.channels["position.a"], atol=1e-6)


@pytest.mark.parametrize("origin", [0.0, 1000.0, 1.7e9])
def test_three_milliseconds_are_three_milliseconds(origin: float) -> None:
    time = origin + np.arange(101) * 0.01
    out = resample(small_log(time, np.arange(101), np.arange(101)), 0.003)
    np.testing.assert_array_equal(out.time, origin + np.arange(334) * 0.003)
    # The command of sample k is in force from its own time on, rounding of the stamps notwithstanding.
    np.testing.assert_array_equal(out.channels["command.a"], (np.arange(334) * 3) // 10)


def test_rounded_time_stamps_do_not_delay_commands() -> None:
    time = (np.arange(30_000) * 0.001).astype(np.float32).astype(np.float64)
    k = np.arange(30_000.0)
    log = small_log(time, k, k)
    np.testing.assert_array_equal(resample(log, 0.001).channels["command.a"], k)
    np.testing.assert_array_equal(command_at(log, ["a"], np.arange(30_000) * 0.001)[:, 0], k)


def test_missing_values_and_gaps_stay_missing() -> None:
    time = np.array([0.0, 0.01, 0.02, 0.03, 0.08, 0.09, 0.10])
    position = np.array([0.0, 1.0, np.nan, 3.0, 8.0, 9.0, 10.0])
    command = np.array([0.0, np.nan, 2.0, 3.0, 8.0, 9.0, 10.0])
    out = resample(small_log(time, command, position), 0.005)
    nan = np.nan
    np.testing.assert_allclose(
        out.channels["position.a"],
        [0, 0.5, 1, nan, nan, nan, 3, nan, nan, nan, nan, nan, nan, nan, nan, nan, 8, 8.5, 9, 9.5, 10],
        atol=1e-9,
    )
    np.testing.assert_array_equal(
        out.channels["command.a"],
        [0, 0, nan, nan, 2, 2, 3, nan, nan, nan, nan, nan, nan, nan, nan, nan, 8, 8, 9, 9, 10],
    )


def test_nothing_crosses_episodes() -> None:
    time = np.array([0.0, 0.01, 0.02, 5.0, 5.01, 5.02])
    values = np.array([0.0, 1.0, 2.0, 100.0, 101.0, 102.0])
    log = small_log(time, values, values, episode=[0, 0, 0, 1, 1, 1])
    for shift in (0.0, -5.0):  # the clock may jump, or start again
        log = replace(log, time=np.where(log.episode == 1, time + shift, time))
        out = resample(log, 0.005)
        np.testing.assert_array_equal(out.episode, [0] * 5 + [1] * 5)
        np.testing.assert_allclose(out.time[5:], 5.0 + shift + np.arange(5) * 0.005)
        np.testing.assert_allclose(out.channels["position.a"], [0, 0.5, 1, 1.5, 2, 100, 100.5, 101, 101.5, 102])


def test_linear_commands_and_set_channels() -> None:
    log = small_log(np.array([0.0, 1.0, 2.0]), np.array([0.0, 10.0, 0.0]), np.zeros(3), hold="linear")
    log = replace(log, channels={**log.channels, "enabled.a": np.array([0.0, 1.0, 1.0])})
    out = resample(log, 0.5)
    np.testing.assert_allclose(out.channels["command.a"], [0, 5, 10, 5, 0])
    np.testing.assert_array_equal(out.channels["enabled.a"], [0, 0, 1, 1, 1])
    np.testing.assert_allclose(command_at(log, ["a"], np.array([-1, 0.25, 1.5, 9]))[:, 0], [0, 2.5, 5, 0])


def test_unknown_columns_take_the_last_sample() -> None:
    log = small_log(np.array([0.0, 1.0, 2.0]), np.zeros(3), np.zeros(3))
    out = resample(replace(log, unknown={"state": np.array(["x", "y", "z"])}), 0.5)
    assert out.unknown["state"].tolist() == ["x", "x", "y", "y", "z"]


@pytest.mark.parametrize("period", [0.0, -0.01, np.nan, np.inf, 1e-12])
def test_impossible_periods_are_refused(good_log: Log, period: float) -> None:
    with pytest.raises(UsageError, match="resampling"):
        resample(good_log, period)


def test_a_clock_that_goes_back_is_refused(good_log: Log) -> None:
    time = good_log.time.copy()
    time[7] = time[5]
    with pytest.raises(LogError, match=r"sample 7 \(0\.05 s\)"):
        resample(replace(good_log, time=time), 0.01)
    with pytest.raises(LogError, match="no samples"):
        resample(good_log.window(0, 0), 0.01)


def test_command_at_holds_fills_and_extends() -> None:
    log = small_log(1000 + np.array([0.0, 0.01, 0.02, 0.03]), np.array([np.nan, 1.0, np.nan, 3.0]), np.zeros(4))
    times = 1000 + np.array([-5.0, 0.0, 0.005, 0.0149, 0.025, 0.03, 9.0])
    np.testing.assert_array_equal(command_at(log, ["a"], times)[:, 0], [1, 1, 1, 1, 1, 3, 3])
    shuffled = times[::-1]
    np.testing.assert_array_equal(command_at(log, ["a"], shuffled)[:, 0], [3, 3, 1, 1, 1, 1, 1])
    assert command_at(log, ["a"], np.empty(0)).shape == (0, 1)


def test_command_at_says_what_is_wrong(good_log: Log) -> None:
    with pytest.raises(LogError, match="its command columns: HeadYaw"):
        command_at(good_log, ["nobody"], np.zeros(1))
    silent = replace(good_log, channels={"command.a": np.full(len(good_log), np.nan)})
    with pytest.raises(LogError, match="no command was logged for a"):
        command_at(silent, ["a"], np.zeros(1))
    with pytest.raises(UsageError, match="not a finite number"):
        command_at(good_log, ["HeadYaw"], np.array([np.nan]))
    restarted = replace(good_log, time=np.tile(good_log.time[:400], 2), episode=np.repeat([0, 1], 400))
    with pytest.raises(LogError, match="one episode at a time"):
        command_at(restarted, ["HeadYaw"], np.zeros(1))


@given(n=st.integers(10, 300), holdout=st.floats(0.05, 0.95))
@settings(max_examples=60, deadline=None)
def test_split_is_by_time_and_loses_nothing(n: int, holdout: float) -> None:
    time = 1000 + np.cumsum(np.linspace(0.01, 0.03, n))
    log = small_log(time, np.arange(n), np.arange(n))
    try:
        train, test = holdout_split(log, holdout)
    except LogError:
        assert n * min(holdout, 1 - holdout) < 6
        return
    np.testing.assert_array_equal(np.concatenate((train.time, test.time)), time)
    cut = time[-1] - holdout * (time[-1] - time[0])
    assert train.time[-1] < cut + 1e-9
    assert test.time[0] >= cut - 1e-9


@given(n=st.integers(50, 600), share=st.floats(0.1, 0.5), parts=st.integers(2, 30))
@settings(max_examples=60, deadline=None)
def test_parts_that_are_held_out_lie_all_over(n: int, share: float, parts: int) -> None:
    time = 1000 + np.cumsum(np.linspace(0.01, 0.03, n))
    held = held_out_all_over(time, share, parts)
    spans, since = spans_of(time, held), time - time[0]
    inside = [(since >= begin) & (since <= end) for begin, end in spans]
    np.testing.assert_array_equal(held, np.any(inside, axis=0) if inside else np.zeros(n, dtype=bool))
    every, part = max(round(1 / share), 2), since[-1] / parts
    assert len(spans) == (parts - 1) // every
    for i, (begin, end) in enumerate(spans):
        assert begin == pytest.approx((i * every + every - 1) * part, abs=0.03)
        assert end - begin == pytest.approx(part, abs=0.06)
    if spans:
        assert not held[0]
        assert not held[-1]


def test_split_of_episodes_counts_only_time_within() -> None:
    time = np.concatenate((np.arange(100) * 0.01, np.arange(100) * 0.01 + 50))
    log = small_log(time, np.zeros(200), np.zeros(200), episode=np.repeat([0, 1], 100))
    train, test = holdout_split(log, 0.5)
    assert len(train) == pytest.approx(100, abs=1)
    assert len(train) + len(test) == 200


@pytest.mark.parametrize("holdout", [0.0, 1.0, -0.1, 1.5, np.nan])
def test_impossible_fractions_are_refused(good_log: Log, holdout: float) -> None:
    with pytest.raises(UsageError, match="between 0 and 1"):
        holdout_split(good_log, holdout)


def test_a_log_too_short_to_split(good_log: Log) -> None:
    with pytest.raises(LogError, match="3 samples: too few"):
        holdout_split(good_log.window(0, 3))


def test_measured_clocks_resample(shared_data) -> None:  # type: ignore[no-untyped-def]
    log = read_log(shared_data / "emps" / "emps.parquet")
    out = resample(log, 0.001)
    assert len(out) == len(log)
    np.testing.assert_array_equal(out.channels["command.slider"], log.channels["command.slider"])
    servo = read_log(shared_data / "xl330" / "kp100_sin_sin.parquet")
    assert not np.any(np.isnan(resample(servo, 0.005).channels["position.pendulum"]))
