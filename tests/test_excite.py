"""Designed motions: within every limit, better than what they are compared with, and honest about what they tell."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest
import toys
from hypothesis import given, settings
from hypothesis import strategies as st

from sysid_btr.cli import run
from sysid_btr.errors import ModelError, UsageError
from sysid_btr.estimators.base import Budget, Termination, silent
from sysid_btr.estimators.journal import Journal
from sysid_btr.estimators.lsq import LeastSquares
from sysid_btr.excite.design import Design, Experiment, design, expect, find_sensors, mean_error, prepare, volume
from sysid_btr.excite.motion import Clock, Family, Limits, as_log, find_motors, window
from sysid_btr.excite.outcome import interrupted
from sysid_btr.excite.settings import MotionSettings
from sysid_btr.identify.fit import fit
from sysid_btr.identify.study import make_study
from sysid_btr.io.log import Log, LogMeta
from sysid_btr.io.noise import NoiseFloor
from sysid_btr.io.parquet import read_log
from sysid_btr.io.validation import validate_file
from sysid_btr.models.builtin import load_robot
from sysid_btr.models.robot import joint_names
from sysid_btr.objectives.problem import Comparison, ReplayProblem

SAMPLES = Path(__file__).resolve().parents[1] / "sample_logs"
LEG, CLEAN = SAMPLES / "leg.xml", SAMPLES / "leg_clean.parquet"
ASKED = ("mass:knee", "kp:*=shared", "kv:*=shared")
NOISE = 5e-4


# --- motions ----------------------------------------------------------------------------------------------


@st.composite
def motors(draw: st.DrawFn) -> Limits:
    low = draw(st.floats(-3, 2.9))
    high = low + draw(st.floats(1e-3, 4))
    home = low + draw(st.sampled_from([0.0, 1.0]) | st.floats(0, 1)) * (high - low)
    return Limits(("a",), min(max(home, low), high), low, high, draw(st.floats(1e-2, 10)), draw(st.floats(1e-1, 200)))


@settings(max_examples=60, deadline=None)
@given(
    motor=motors(),
    seconds=st.floats(2.5, 65),
    rate=st.sampled_from([12.5, 50.0, 100.0, 187.0]),
    seed=st.integers(0, 10_000),
    extreme=st.booleans(),
)
def test_a_motion_keeps_its_limits_and_begins_and_ends_at_rest(
    motor: Limits, seconds: float, rate: float, seed: int, extreme: bool
) -> None:
    family = Family((motor,), Clock.of(seconds, rate))
    row = np.random.default_rng(seed).uniform(-1, 1, len(family.names))
    coefficients = np.sign(row) if extreme else row
    for times in (None, 1):
        time, position = family.commands(coefficients, times)
        q = position[:, 0]
        room = 1e-9 * (motor.high - motor.low)
        assert q.min() >= motor.low - room
        assert q.max() <= motor.high + room
        assert np.abs(np.diff(q)).max() * rate <= motor.velocity * (1 + 1e-9)
        assert np.abs(np.diff(q, 2)).max() * rate**2 <= motor.acceleration * (1 + 1e-9)
        np.testing.assert_allclose(np.diff(time), 1 / rate)
    time, position = family.commands(coefficients)
    np.testing.assert_allclose(position[[0, -1], 0], motor.home, atol=room)
    assert np.abs(position[[1, -2], 0] - motor.home).max() <= motor.acceleration / rate**2
    assert abs(time[-1] - seconds) <= 0.5 / rate + 1e-9


@pytest.mark.parametrize("end", [2.5, 10.0])
def test_the_windows_derivatives_are_its_own(end: float) -> None:
    time = np.linspace(0, end, 20_001)
    value, slope, bend = window(time, end)
    np.testing.assert_allclose(np.gradient(value, time)[2:-2], slope[2:-2], atol=1e-5)
    np.testing.assert_allclose(np.gradient(slope, time)[2:-2], bend[2:-2], atol=1e-2)
    np.testing.assert_allclose([value[0], value[-1], slope[0], slope[-1], bend[0], bend[-1]], 0, atol=1e-9)


def test_a_motion_uses_what_a_limit_allows() -> None:
    for bound, motor in (
        ("velocity", Limits(("a",), 0.0, -9.0, 9.0, 1.0, 1e4)),
        ("acceleration", Limits(("a",), 0.0, -9.0, 9.0, 1e3, 10.0)),
    ):
        family = Family((motor,), Clock.of(10, 200))
        row = np.ones(len(family.names))
        row[0] = 0.0
        q = family.commands(row)[1][:, 0]
        used = np.abs(np.diff(q)).max() * 200 if bound == "velocity" else np.abs(np.diff(q, 2)).max() * 200**2
        assert used == pytest.approx(getattr(motor, bound), rel=0.02)


def test_limits_are_those_of_the_model() -> None:
    robot = load_robot(str(LEG))
    by_name = {m.joints[0]: m for m in find_motors(robot, MotionSettings(margin=0.1))}
    hip = by_name["HipPitch"]
    assert (hip.low, hip.high) == pytest.approx((-1.53 + 0.201, 0.48 - 0.201))
    # the nominal pose lies within the margin: it is allowed all the same
    assert by_name["KneePitch"].low == 0.0

    def weaken(spec: object) -> None:
        servo = spec.actuator("KneePitch")  # type: ignore[attr-defined]
        servo.forcelimited, servo.forcerange = 1, [-0.2, 0.3]
        servo.ctrllimited, servo.ctrlrange = 1, [-0.05, 1.0]

    weak = {m.joints[0]: m for m in find_motors(toys.with_spec(robot, weaken))}["KneePitch"]
    assert weak.high == 1.0
    assert weak.acceleration < 0.5 * by_name["KneePitch"].acceleration
    tied = replace(robot, tied=(("HipRoll", "AnkleRoll"),))
    together = next(m for m in find_motors(tied) if len(m.joints) == 2)
    apart = {m.joints[0]: m for m in find_motors(robot)}
    assert together.high == min(apart["HipRoll"].high, apart["AnkleRoll"].high)


def test_joints_that_are_not_asked_for_stay() -> None:
    robot = toys.leg()
    family = Family(find_motors(robot, MotionSettings(joints=("k*",))), Clock.of(3, 100))
    log = as_log(family, np.ones(len(family.names)), robot)
    assert np.ptp(log.channels["command.knee"]) > 0.1
    for joint in ("hip", "ankle"):
        assert np.all(log.channels[f"command.{joint}"] == 0)
    with pytest.raises(UsageError, match="elbow"):
        find_motors(robot, MotionSettings(joints=("elbow*", "hip")))


def test_a_model_without_servos_cannot_be_excited() -> None:
    bare = toys.PENDULUM.replace("<position", "<motor").replace('kp="12.0" kv="0.5"', "")
    with pytest.raises(ModelError, match="no position servo"):
        find_motors(toys.robot_from_xml(bare))


# --- what a motion tells ----------------------------------------------------------------------------------


def experiment(parameters: tuple[str, ...] = ASKED, seconds: float = 3.0) -> tuple[Experiment, Log]:
    robot = toys.leg()
    family = Family(find_motors(robot), Clock.of(seconds, 100))
    log = as_log(family, np.random.default_rng(3).uniform(-1, 1, len(family.names)), robot)
    return prepare(robot, parameters, find_sensors(robot, noise=NOISE), log, threads=1), log


def noisy(problem: ReplayProblem, truth: np.ndarray, rng: np.random.Generator) -> ReplayProblem:
    """The problem of a robot with other parameters, measured."""
    (episode,) = problem.episodes
    outputs = episode.replay.predict(truth[None])
    targets = tuple(
        replace(t, measured=(clean := t.predicted(outputs)[0]) + t.sigma * rng.standard_normal(clean.shape))
        for t in episode.targets
    )
    return ReplayProblem((Comparison(episode.replay, targets),), problem.start)


def test_predicted_errors_are_those_of_fits() -> None:
    known, log = experiment()
    problem = known.problem(log)
    expected = expect(problem)
    assert [e.identifiable for e in expected.estimates] == ["yes"] * 3
    rng = np.random.default_rng(1)
    repeats = 40
    found = np.array(
        [
            LeastSquares(confirm=False)
            .fit(noisy(problem, problem.start, rng), rng=rng, budget=Budget(), journal=Journal(), progress=silent)
            .x
            for _ in range(repeats)
        ]
    )
    from scipy.stats import chi2

    z = (found - problem.start) / [e.std for e in expected.estimates]
    low, high = chi2.ppf([1e-3, 1 - 1e-3], repeats)
    for column in z.T:
        assert low <= column @ column <= high


def test_predicted_intervals_are_those_that_a_fit_gives() -> None:
    known, log = experiment(seconds=6.0)
    problem = known.problem(log)
    (episode,) = noisy(problem, problem.start, np.random.default_rng(2)).episodes
    (target,) = episode.targets
    channels = {f"position.{j}": target.measured[:, k] for k, j in enumerate(target.joints)}
    measured = replace(log, channels={**log.channels, **channels})
    logs = [measured]
    study = make_study(known.robot, logs, holdout=logs, numerics=known.numerics, threads=1)
    found = fit(study, ASKED)
    for own, foreseen in zip(found.estimates, expect(problem).estimates, strict=True):
        # a fit's standard error also has the spread between stretches of the log, of which there are a dozen
        assert 0.8 * foreseen.std <= own.std <= 1.9 * foreseen.std
        assert abs(own.value - own.nominal) <= 4 * foreseen.std


def test_half_the_noise_is_half_the_error() -> None:
    known, log = experiment()
    sensors = find_sensors(known.robot, noise=NOISE / 2)
    better = expect(replace(known, sensors=sensors).problem(log))
    plain = expect(known.problem(log))
    for a, b in zip(better.estimates, plain.estimates, strict=True):
        assert a.std == pytest.approx(b.std / 2, rel=1e-6)


def test_two_parameters_that_do_the_same_are_told_together_only() -> None:
    # a stiffer servo and a heavier leg cannot be told apart where nothing but one pendulum's balance is seen
    known, log = experiment(("mass:hip,knee,ankle", "kp:*"), seconds=2.5)
    still = replace(log, channels={name: np.zeros(len(log)) for name in log.channels})
    expected = expect(known.problem(still))
    lost = [e for e in expected.estimates if e.identifiable == "no"]
    assert lost
    assert all(e.reason for e in lost)
    # the score stays finite, and sees that any motion is better
    unit = expected.std
    assert np.isfinite(mean_error(expected, unit))
    moving = expect(known.problem(log))
    assert mean_error(moving, unit) < 0.5 * mean_error(expected, unit)
    assert volume(moving, unit) < 0.5 * volume(expected, unit)


# --- the search -------------------------------------------------------------------------------------------


def search(evaluations: int, journal: Journal | None = None, stop_after: int | None = None) -> Design:
    def progress(*, done: int, total: int | None, best: float, note: str) -> None:
        if stop_after is not None and done >= stop_after:
            raise KeyboardInterrupt

    return design(
        toys.leg(),
        ASKED,
        motion=MotionSettings(seconds=3.0),
        noise=NOISE,
        rng=np.random.default_rng(5),
        budget=Budget(evaluations=evaluations),
        journal=journal,
        progress=progress,
        threads=1,
    )


@lru_cache
def against_the_sample() -> Design:
    return design(
        load_robot(str(LEG)),
        ("mass:KneePitch,HipPitch,HipRoll", "kp:*=shared"),
        reference=read_log(CLEAN),
        motion=MotionSettings(seconds=5.0),
        budget=Budget(evaluations=40),
        threads=1,
    )


def test_a_designed_motion_beats_the_reference() -> None:
    found = against_the_sample()
    assert found.compared_with == "leg_clean.parquet"
    assert found.reference.seconds == pytest.approx(found.designed.seconds)
    assert found.mean_ratio < 0.5
    assert found.result.loss < found.result.history[0][1]


def test_what_no_motion_tells_is_said() -> None:
    found = against_the_sample()
    by_name = {e.name: e for e in found.designed.estimates}
    assert by_name["mass:HipRoll"].identifiable == "no"
    assert by_name["mass:HipRoll"].reason
    assert found.identifiable == [True, True, False, True]


def test_an_interrupted_search_gives_its_best_and_can_be_resumed(tmp_path: Path) -> None:
    whole = search(60)
    path = tmp_path / "journal.jsonl"
    stopped = search(60, Journal(path, fingerprint="x"), stop_after=30)
    assert interrupted(stopped)
    assert stopped.result.loss <= stopped.result.history[0][1]
    assert stopped.result.evaluations < 60
    resumed = search(60, Journal(path, fingerprint="x"))
    assert resumed.result.termination is Termination.BUDGET_SPENT
    np.testing.assert_array_equal(resumed.coefficients, whole.coefficients)
    assert resumed.designed.estimates == whole.designed.estimates


# --- the verb ---------------------------------------------------------------------------------------------


def test_the_verb_writes_a_log_to_play(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "out"
    asked = ["excite", "--model", str(LEG), "--fit", "mass:KneePitch", "--fit", "kp:*=shared", "--log", str(CLEAN)]
    asked += ["--seconds", "3", "--max-evaluations", "5", "--threads", "1", "--out", str(out)]
    assert run(asked) == 0
    shown = capsys.readouterr()
    assert "ratio" in shown.out
    assert "hitting the robot itself" in shown.err
    # commands are all that there is before it was played: that is told, and nothing else is wrong with it
    found = validate_file(out / "excite.parquet", joints=joint_names(load_robot(str(LEG))))
    assert [(p.code, p.severity) for p in found] == [("motion.not_recorded", "warning")]
    log = read_log(out / "excite.parquet")
    assert log.is_motion
    assert all(name.startswith("command.") for name in log.channels)
    assert log.time[-1] == pytest.approx(3.0)
    result = json.loads((out / "result.json").read_text())
    assert result["kind"] == "excite"
    for p in result["parameters"]:
        assert p["std"] > 0
        assert p["ratio"] == pytest.approx(p["std"] / p["reference"]["std"])
    assert result["mean_ratio"] == pytest.approx(np.mean([p["ratio"] for p in result["parameters"]]))
    for motor in result["motion"]["motors"]:
        low, high = motor["position"]["limits"]
        assert low <= motor["position"]["used"][0] < motor["position"]["used"][1] <= high
        assert motor["velocity"]["used"] <= motor["velocity"]["limit"]
        assert motor["acceleration"]["used"] <= motor["acceleration"]["limit"]
    assert (out / "excite.png").read_bytes().startswith(b"\x89PNG")
    assert run(asked) == 2  # nothing is overwritten
    assert run([*asked, "--resume"]) == 0
    assert json.loads((out / "result.json").read_text())["parameters"] == result["parameters"]


@pytest.mark.parametrize(
    ("flags", "said"),
    [
        (["--seconds", "1"], "--seconds"),
        (["--rate", "5"], "--rate"),
        (["--noise", "position=-1"], "--noise"),
        (["--noise", "effort=1"], "give position=SIGMA"),
        (["--margin", "0.5"], "--margin"),
        (["--max-velocity", "0"], "velocity"),
        (["--joints", "Elbow*"], "Elbow*"),
        (["--criterion", "best"], "logdet"),
        (["--estimator", "lsq"], "residuals"),
        (["--fit", "mass:Nobody"], "Nobody"),
        (["--log", str(CLEAN), "--log", str(CLEAN)], "once"),
    ],
)
def test_what_cannot_be_used_is_said(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], flags: list[str], said: str
) -> None:
    asked = ["excite", "--model", str(LEG), "--fit", "kp:*=shared", "--threads", "1", "--out", str(tmp_path / "o")]
    assert run([*asked, *flags]) == 2
    assert said in capsys.readouterr().err


def test_a_floating_base_reference_is_refused() -> None:
    log = read_log(CLEAN)
    with pytest.raises(UsageError, match="floating-base log"):
        design(load_robot(str(LEG)), ("kp:*=shared",), reference=replace(log, meta=replace(log.meta, mount="free")))


def test_a_robot_whose_settings_come_from_logs_needs_one() -> None:
    with pytest.raises(UsageError, match="settings of its servos"):
        design(load_robot("xl330"), ("damping:*",), noise=1e-3)
    with pytest.raises(UsageError, match="sliding"):
        find_sensors(load_robot("emps"))


def test_the_motion_carries_what_the_reference_says_of_its_servos() -> None:
    family = Family(find_motors(toys.pendulum()), Clock.of(3, 100))
    like = LogMeta(robot="me", mount="free", servo_period=0.01, source="measured", extra={"kp_register": 200})
    meta = as_log(family, np.ones(len(family.names)), toys.pendulum(), like=like).meta
    assert (meta.robot, meta.servo_period, meta.extra) == ("me", 0.01, {"kp_register": 200})
    assert (meta.mount, meta.source, meta.sample_period) == ("fixed", "designed motion", 0.01)


def test_sensors_are_those_of_the_reference() -> None:
    robot, log = load_robot(str(LEG)), read_log(CLEAN)
    sensors = find_sensors(robot, log)
    assert {channel for channel, _ in sensors.floor} == {"position"}
    assert all(1e-4 < floor < 2e-3 for floor in sensors.floor.values())
    (target,) = sensors.targets(log.time, ["KneePitch"])
    assert isinstance(target.floor[0], NoiseFloor)
    assert set(find_sensors(robot, log, 0.01).floor.values()) == {0.01}
