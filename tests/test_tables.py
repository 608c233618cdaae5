"""Data out and in, by habit: pandas, covariances, signatures, and progress that nobody has to ask for."""

from __future__ import annotations

import inspect
import io
import math
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pandas as pd
import pytest
from conftest import make_good_log

import sysid_btr as sb
from sysid_btr.cli.demo import sample_logs
from sysid_btr.diagnosis.closing import Closing
from sysid_btr.diagnosis.selection import Selection
from sysid_btr.display.tables import to_tables
from sysid_btr.errors import LogError, UsageError
from sysid_btr.identify.fit import Fit
from sysid_btr.identify.intervals import correlations
from sysid_btr.io.log import Log
from sysid_btr.progress import ProgressLine, shows_progress, watched
from sysid_btr.units import with_digits_of

SAMPLES = sample_logs()
MODEL = str(SAMPLES / "pendulum.xml")


@pytest.fixture(scope="module")
def fitted() -> Fit:
    log = sb.read_log(SAMPLES / "pendulum_clean.parquet").window(0, 500)
    return sb.fit(sb.make_study(sb.load_robot(MODEL), [log], threads=1), ["mass:*", "kp:*"])


@pytest.fixture(scope="module")
def closed() -> Closing:
    log = sb.read_log(SAMPLES / "pendulum_friction.parquet").window(0, 500)
    study = sb.make_study(sb.load_robot(MODEL), [log], threads=1)
    return sb.close(study, ["mass:*"], effects=["coulomb_friction", "viscous_damping"])


# --- logs ----------------------------------------------------------------------------------------------------


def same(log: Log, other: Log) -> None:
    np.testing.assert_array_equal(log.time, other.time)
    np.testing.assert_array_equal(log.episode, other.episode)
    assert list(log.channels) == list(other.channels)
    for name, values in log.channels.items():
        np.testing.assert_array_equal(values, other.channels[name])


def test_a_log_goes_through_pandas_unchanged() -> None:
    log = make_good_log()
    table = log.to_pandas()
    assert table.index.name == "time"
    back = Log.from_pandas(table)
    same(log, back)
    assert back.meta == log.meta
    same(log, Log.from_pandas(table.reset_index()))
    assert Log.from_pandas(table, sb.LogMeta(robot="other")).meta.robot == "other"


def test_a_clock_of_dates_or_durations_is_one_in_seconds() -> None:
    table = make_good_log(n=50).to_pandas()
    clock = table.index.to_numpy()
    durations = pd.to_timedelta(clock, unit="s")
    for index in (durations, pd.Timestamp("2026-01-01 12:00") + durations):
        np.testing.assert_allclose(Log.from_pandas(table.set_axis(index, axis=0)).time, clock, atol=1e-9)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"position.HeadYaw": "left"}, "position.HeadYaw"),
        ({"time": np.nan}, "no time"),
        ({"episode": 0.5}, "number the episodes"),
    ],
    ids=["text", "time", "episode"],
)
def test_a_table_that_is_no_log_is_refused_with_all_that_is_wrong(change: dict[str, Any], said: str) -> None:
    table = make_good_log(n=50).to_pandas().reset_index().assign(**change)
    with pytest.raises(LogError, match=said) as refused:
        Log.from_pandas(table)
    assert "import_log" in str(refused.value)


def test_a_frame_in_other_words_and_units_is_imported_as_a_file_would_be() -> None:
    log = sb.read_log(SAMPLES / "pendulum_clean.parquet").window(0, 200)
    table = pd.DataFrame({"pendulum_cmd": np.degrees(log.channels["command.pendulum"])})
    table["pendulum_pos"] = np.degrees(log.channels["position.pendulum"])
    table.index = pd.Index(log.time, name="time")
    imported = sb.import_log(table, model=MODEL, units={"command": "deg", "position": "deg"})
    assert imported.usable, imported.problems
    np.testing.assert_allclose(imported.log.channels["position.pendulum"], log.channels["position.pendulum"])
    assert "DataFrame" in imported.log.meta.source


def test_a_log_is_checked_against_a_robot() -> None:
    log, robot = sb.read_log(SAMPLES / "pendulum_clean.parquet"), sb.load_robot(MODEL)
    assert not [p for p in sb.validate_log(log, robot) if p.severity == "error"]
    elsewhere = sb.validate_log(log, sb.load_robot(str(SAMPLES / "leg.xml")))
    assert "joint.missing" in {p.code for p in elsewhere}
    assert "joint.missing" not in {p.code for p in sb.validate_log(log)}


# --- results --------------------------------------------------------------------------------------------------


def test_the_covariance_is_that_of_the_intervals(fitted: Fit, closed: Closing) -> None:
    for outcome in (fitted, closed):
        std = np.array([e.std for e in outcome.estimates])
        np.testing.assert_allclose(np.sqrt(np.diag(outcome.covariance)), std, rtol=1e-9)
        assert np.all(np.linalg.eigvalsh(outcome.covariance) > 0)
        np.testing.assert_allclose(outcome.correlation, outcome.correlation.T)
        assert np.max(np.abs(outcome.correlation)) <= 1
    # a heavier arm and a stiffer servo look alike where the arm is lifted
    assert fitted.correlation[0, 1] > 0.3


def test_nothing_is_said_of_the_correlation_with_what_no_sensor_sees() -> None:
    found = correlations(np.array([[4.0, 1.0, 0.0], [1.0, 1.0, 0.0], [0.0, 0.0, np.inf]]))
    np.testing.assert_allclose(found[:2, :2], [[1.0, 0.5], [0.5, 1.0]])
    assert np.isnan(found[2]).all()
    assert np.isnan(found[:, 2]).all()


def numbers(value: Any) -> Iterator[float]:
    """Every number in a result."""
    if isinstance(value, dict):
        for inner in value.values():
            yield from numbers(inner)
    elif isinstance(value, list | tuple):
        for inner in value:
            yield from numbers(inner)
    elif isinstance(value, int | float) and not isinstance(value, bool):
        yield float(value)


def held(table: pd.DataFrame) -> Iterator[float]:
    """Every number in a table, those in lists in a cell too."""
    for name in table.columns:
        for cell in table[name]:
            yield from numbers(cell.item() if isinstance(cell, np.generic) else cell)


@pytest.mark.parametrize("which", ["fitted", "closed"])
def test_every_number_of_a_result_is_in_a_table(which: str, request: pytest.FixtureRequest) -> None:
    outcome = request.getfixturevalue(which)
    result = outcome.to_dict(seed=7)
    there = {value for table in to_tables(result).values() for value in held(table) if math.isfinite(value)}
    assert not [value for value in numbers(result) if value not in there]


def test_tables_are_indexed_by_what_they_are_of(closed: Closing) -> None:
    found = sb.tables(closed)
    [estimate] = closed.effects[0].parameters
    row = found["parameters"].loc["coulomb_friction:pendulum"]
    assert (row["value"], row["ci95_low"], row["effect"]) == (estimate.value, estimate.ci95[0], "coulomb_friction")
    assert found["correlation"].loc["mass:arm", "mass:arm"] == pytest.approx(1.0)
    errors = found["errors"].set_index(["part", "channel", "model"])["rmse"]
    assert errors["holdout", "position", "after"] == closed.after.holdout["position"].rmse
    assert closed.to_pandas().equals(found["parameters"])
    with pytest.raises(UsageError, match="it has parameters"):
        closed.to_pandas("parameter")


def test_residuals_are_those_that_the_scores_are_of(closed: Closing) -> None:
    table = closed.residuals()
    for part, scores in (("train", closed.after.train), ("holdout", closed.after.holdout)):
        for channel, score in scores.items():
            own = table[(table["part"] == part) & (table["channel"] == channel)]
            for joint, rows in own.groupby("joint"):
                assert np.sqrt(np.mean(rows["residual"] ** 2)) == pytest.approx(score.joints[str(joint)])
    assert (table["measured"] - table["predicted"]).to_numpy() == pytest.approx(table["residual"].to_numpy())


@pytest.mark.parametrize("name", ["fitted", "closed"])
def test_a_line_says_what_a_thing_is(name: str, request: pytest.FixtureRequest) -> None:
    outcome = request.getfixturevalue(name)
    for thing in (outcome, outcome.study, outcome.study.robot, outcome.study.train[0].log):
        assert len(repr(thing)) < 200
        assert "array(" not in repr(thing)
    assert outcome.estimates[0].name == "mass:arm"
    assert str(outcome.estimates[0]) in repr(outcome)


def test_a_line_says_what_was_found(closed: Closing) -> None:
    [effect] = closed.effects
    assert repr(effect) == f"<NamedEffect {effect.sentence}; friction with over 99 % certainty>"
    [friction] = effect.parameters
    value = with_digits_of(friction.value, friction.std)
    assert repr(friction) == f"<Estimate coulomb_friction:pendulum {value} Nm (std {friction.std:.2g})>"
    unseen = replace(friction, identifiable="no", std=math.inf)
    assert repr(unseen) == "<Estimate coulomb_friction:pendulum not identifiable>"


# --- signatures and progress ------------------------------------------------------------------------------------


def test_signatures_are_those_of_what_is_called() -> None:
    from sysid_btr.posterior.draw import posterior

    shown, real = inspect.signature(sb.posterior), inspect.signature(posterior)
    assert list(shown.parameters) == list(real.parameters)
    assert [p.default for p in shown.parameters.values()] == [p.default for p in real.parameters.values()]
    for name in sb.__all__:
        signature = inspect.signature(getattr(sb, name))
        assert "args" not in signature.parameters, name
        # as `help` shows it: no addresses, no defaults of many lines
        assert " at 0x" not in str(signature), name
        assert all(len(str(p)) < 120 for p in signature.parameters.values()), name


def test_thresholds_show_what_was_changed() -> None:
    assert repr(Selection()) == "Selection()"
    assert repr(Selection(rounds=3)) == "Selection(rounds=3)"


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


@shows_progress("inner")
def inner(*, progress: Any = watched) -> None:
    progress(done=1, total=2, best=1.0, note="")


@shows_progress("outer")
def outer(*, progress: Any = watched) -> None:
    progress(done=1, total=2, best=1.0, note="")
    inner()


def test_progress_is_shown_where_somebody_watches_and_once(monkeypatch: pytest.MonkeyPatch) -> None:
    unseen, seen = io.StringIO(), Terminal()
    monkeypatch.setattr("sys.stderr", unseen)
    outer()
    assert unseen.getvalue() == ""
    monkeypatch.setattr("sys.stderr", seen)
    outer()
    assert "outer" in seen.getvalue()
    assert "inner" not in seen.getvalue()
    told: list[int] = []
    silent = Terminal()
    monkeypatch.setattr("sys.stderr", silent)
    outer(progress=lambda **said: told.append(said["done"]))
    assert told == [1]
    assert "outer" not in silent.getvalue()
    assert "inner" in silent.getvalue()
    with ProgressLine("command", Terminal()):  # as the command line shows one
        silent.truncate(0)
        inner()
    assert silent.getvalue().strip("\0") == ""
