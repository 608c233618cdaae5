"""The coverage benchmark: one log from end to end, resuming, and the arithmetic of its summary."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("pinocchio", reason="the recorder needs pin (pip install pin)", exc_type=ImportError)

from benchmarks.coverage import __main__ as command
from benchmarks.coverage.draw import BENCHES, SPREAD, draw
from benchmarks.coverage.summary import Count, latest, over_logs, summarise, width_ratio
from benchmarks.coverage.table import Row, append, read_rows

ROW = Row(
    robot="leg",
    estimator="lsq",
    plant="other",
    number=1,
    motion="gait",
    bits=12,
    noise=4e-4,
    parameter="kp:*",
    true=1.1,
    value=1.09,
    std=0.01,
    low=1.07,
    high=1.11,
    identifiable="yes",
    at_bound=0,
    converged=1,
    chi2=1.0,
    seconds=2.0,
    recipe="r",
    code="c",
)


@pytest.fixture
def short(monkeypatch: pytest.MonkeyPatch) -> None:
    """Logs of four seconds."""
    monkeypatch.setitem(BENCHES, "leg", replace(BENCHES["leg"], seconds=4.0))  # type: ignore[arg-type]


def call(out: Path, *more: str) -> int:
    return command.main(["--robot", "leg", "--count", "1", "--out", str(out), *more])


@pytest.mark.usefixtures("short")
def test_one_log_from_end_to_end_and_no_row_twice(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    table = tmp_path / "coverage.csv"
    assert call(table) == 0
    rows = read_rows(table)
    case = draw(BENCHES["leg"], 1)
    assert [r.parameter for r in rows] == ["mass:HipPitch", "mass:KneePitch", "mass:AnkleRoll", "kp:*", "kv:*"]
    assert [r.true for r in rows] == [case.true(r.parameter) for r in rows]
    for row in rows:
        assert row.low <= row.value <= row.high
        # nothing of the truth is off by more than a wild guess: the fit is of this log
        assert abs(row.value - row.true) < 6 * row.std
    assert f"{sum(r.covered for r in rows)}/5" in capsys.readouterr().out

    def never(*_: object) -> list[Row]:
        raise AssertionError("done already")

    monkeypatch.setattr(command, "examine", never)
    assert call(table) == 0
    assert read_rows(table) == rows
    with pytest.raises(AssertionError, match="done already"):
        call(table, "--first", "2")


@pytest.mark.parametrize("robot", BENCHES)
def test_a_draw_is_the_same_log_again_and_another_number_another(robot: str) -> None:
    bench = BENCHES[robot]
    assert draw(bench, 3) == draw(bench, 3)
    first, second = draw(bench, 3), draw(bench, 4)
    assert first.spec.seed != second.spec.seed
    factors = [first.true(f"mass:{b}") for b in bench.free] + [first.true("kp:*"), first.true("kv:*")]
    assert all(SPREAD[0] <= f <= SPREAD[1] for f in factors)
    assert len(set(factors)) > len(factors) // 2


@pytest.mark.usefixtures("short")
def test_the_replays_own_log_has_the_same_motion_and_white_noise_of_equal_size() -> None:
    from sysid_btr.simulation.numerics import Numerics

    case = draw(BENCHES["leg"], 9)
    assert case.spec.sensors.bits == 0
    other, own = case.log(), case.log(Numerics("RK4", 0.005))
    size = case.spec.sensors.position_noise
    for joint in ("HipPitch", "AnkleRoll"):
        np.testing.assert_array_equal(own.channels[f"command.{joint}"], other.channels[f"command.{joint}"])
        difference = (own.channels[f"position.{joint}"] - other.channels[f"position.{joint}"])[50:]
        assert np.std(difference) == pytest.approx(np.sqrt(2) * size, rel=0.15)


def some(covered: Sequence[bool], **fields: object) -> list[Row]:
    """One row a log; the truth inside its interval or not."""
    return [
        replace(ROW, number=i, true=1.1 if inside else 1.2, **fields)  # type: ignore[arg-type]
        for i, inside in enumerate(covered)
    ]


def test_what_a_result_does_not_tell_is_counted_apart() -> None:
    rows = some([True] * 95 + [False] * 5) + some([True, False], identifiable="no")
    count = Count.of(rows)
    assert (count.inside, count.told, count.untold, count.untold_inside) == (95, 100, 2, 1)
    assert count.share == pytest.approx(0.95)
    # Clopper and Pearson's, as tabulated
    assert count.interval == pytest.approx((0.8872, 0.9836), abs=1e-4)


def test_logs_count_as_one_where_their_parameters_stand_and_fall_together() -> None:
    alone = some([True] * 90 + [False] * 10)
    together = [replace(r, parameter=p) for r in alone for p in ("kp:*", "kv:*", "mass:a", "mass:b")]
    low, high = over_logs(together)
    assert (low, high) == pytest.approx(over_logs(alone))
    assert low == pytest.approx(0.9 - 1.96 * 0.03, abs=2e-3)


def test_the_width_is_against_the_same_logs() -> None:
    rows = some([True] * 3)
    own = [replace(r, plant="own", low=1.08, high=1.10) for r in rows[:2]]
    assert width_ratio(rows, own)["kp:*"] == (pytest.approx(2.0), 2)
    assert width_ratio(rows, []) == {}


def test_only_the_last_state_of_the_code_counts() -> None:
    old, new = some([False] * 3, code="old"), some([True] * 2, code="new")
    assert {(r.number, r.code) for r in latest([*old, *new])} == {(0, "new"), (1, "new"), (2, "old")}
    text = summarise([*old, *new])
    assert "2/3" in text
    assert "197 logs to go" in text


def test_a_row_reads_back_and_half_a_row_is_left_out(tmp_path: Path) -> None:
    table = tmp_path / "t.csv"
    append(table, [ROW, replace(ROW, parameter="mass:a,b")])
    append(table, [replace(ROW, number=2)])
    assert read_rows(table) == [ROW, replace(ROW, parameter="mass:a,b"), replace(ROW, number=2)]
    table.write_text(table.read_text() + "leg,lsq,other,3,ga")
    assert [r.number for r in read_rows(table)] == [1, 1, 2]
    append(table, [replace(ROW, number=4)])
    assert [r.number for r in read_rows(table)] == [1, 1, 2, 4]


def test_another_versions_table_is_not_touched(tmp_path: Path) -> None:
    table = tmp_path / "t.csv"
    table.write_text("a,b\n1,2\n")
    with pytest.raises(ValueError, match="other columns"):
        read_rows(table)
