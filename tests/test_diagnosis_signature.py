"""The missing torque is what was planted; what stands out in it is proposed; words for it are the right ones."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import toys
from hypothesis import given, settings
from hypothesis import strategies as st

from sysid_btr._typing import FloatArray
from sysid_btr.diagnosis import signal_features
from sysid_btr.diagnosis.close import usable_effects
from sysid_btr.diagnosis.proposals import by_one_clock, proposals
from sysid_btr.diagnosis.ringing import blows
from sysid_btr.diagnosis.scan import Perturbation
from sysid_btr.diagnosis.signature import signature
from sysid_btr.identify.missing_torque import MissingTorque, missing_torques
from sysid_btr.identify.refit import refit
from sysid_btr.identify.study import Study, make_study
from sysid_btr.io.log import Log
from sysid_btr.io.parquet import read_log
from sysid_btr.models.builtin import load_robot
from sysid_btr.models.emps import emps
from sysid_btr.terms.disturbance import (
    DriveDisturbanceTrain,
    ExternalDisturbance,
    ExternalDisturbanceTrain,
    Push,
    RingingDisturbance,
    RingingDisturbanceTrain,
)
from sysid_btr.terms.effect import Effect
from sysid_btr.terms.friction import CoulombFriction
from sysid_btr.terms.library import select_effects
from sysid_btr.terms.model import Model
from sysid_btr.terms.servo import CommandDelaySampled, sampled
from sysid_btr.terms.transmission import Cogging

NOISE = 4e-4
"""rad, of a position sensor."""
NOTHING = np.zeros(0)


def leg_log(
    effect: type[Effect] | None = None,
    place: str = "knee",
    values: Sequence[float] = (),
    *,
    seconds: float = 9.0,
    irregular: bool = False,
    effort: bool = False,
) -> Log:
    """What the toy leg's sensors show of an effect while it swings."""
    rng = np.random.default_rng(5)
    log = toys.swing(toys.LEG_JOINTS, seconds=seconds)
    if irregular:
        time = log.time + np.append(0.0, rng.uniform(-0.3, 0.3, len(log.time) - 1) * 0.01)
        log = replace(log, time=time)
    scales = dict.fromkeys(toys.LEG_JOINTS, toys.SCALE)
    terms = () if effect is None else (effect.at((place,), scales),)
    outputs = toys.run(toys.leg(), log, terms, np.array(values), effort=True)
    channels = dict(log.channels)
    for i, joint in enumerate(toys.LEG_JOINTS):
        channels[f"position.{joint}"] = outputs.position[0, :, i] + rng.normal(0, NOISE, len(log.time))
        if effort:
            assert outputs.effort is not None
            channels[f"effort.{joint}"] = outputs.effort[0, :, i] + rng.normal(0, 0.02, len(log.time))
    return replace(log, channels=channels)


def study_of(log: Log) -> Study:
    return make_study(toys.leg(), [log], holdout=0.2, numerics=toys.FINE)


def torques_of(log: Log) -> dict[str, MissingTorque]:
    study = study_of(log)
    return {t.joint: t for t in missing_torques(study.train_problem(()), NOTHING, study.scales)}


def asked(log: Log, library: Sequence[type[Effect]] = select_effects(["all"])) -> list[Perturbation]:
    study = study_of(log)
    problem = study.train_problem(())
    return proposals(study, problem, NOTHING, problem.residuals(np.zeros((1, 0)))[0], library)


def torque_of(torque: FloatArray) -> MissingTorque:
    """A torque as it would be missing at a joint whose own motion has nothing to do with it."""
    knee = torques_of(leg_log())["knee"]
    n = len(torque)
    state = {name: np.resize(getattr(knee, name), n) for name in ("position", "velocity", "acceleration", "residual")}
    return replace(knee, **state, time=knee.period * np.arange(n), torque=torque, gain=np.ones_like(knee.gain))


def described(log: Log) -> dict[str, Any]:
    found = signature(study_of(log), Model.of(()))
    json.dumps(found)
    return found


# --- missing torque ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("irregular", [False, True], ids=["even clock", "uneven clock"])
def test_a_push_is_recovered_as_a_torque_at_its_joint_only(irregular: bool) -> None:
    found = torques_of(leg_log(ExternalDisturbance, values=(0.6, 3.0, 0.3), irregular=irregular))
    knee = found["knee"]
    during = (knee.time > 3.03) & (knee.time < 3.26)
    far = np.abs(knee.time - 3.15) > 0.4
    # the noise floor takes an uneven clock for noise, and what may be noise is smoothed away
    assert np.mean(knee.torque[during]) == pytest.approx(0.6, rel=0.2 if irregular else 0.05)
    assert np.std(knee.torque[far]) < 0.08
    assert knee.chi2 > (1.3 if irregular else 3)
    for other in ("hip", "ankle"):
        assert np.abs(found[other].torque[during]).mean() < 0.1


def test_without_a_torque_there_is_only_the_noise_that_is_stated() -> None:
    for one in torques_of(leg_log()).values():
        assert one.chi2 == pytest.approx(1.0, abs=0.25)
        assert np.std(one.torque) < 2 * one.noise
        assert one.noise < 0.1


def test_a_constant_torque_keeps_its_size() -> None:
    plain = leg_log()
    pushed = leg_log(ExternalDisturbance, values=(0.3, 0.0, 100.0))
    assert np.mean(torques_of(plain)["knee"].torque) == pytest.approx(0.0, abs=0.02)
    assert np.mean(torques_of(pushed)["knee"].torque) == pytest.approx(0.3, rel=0.05)


def test_what_an_estimate_shows_of_a_torque_is_smoothed_and_not_scaled() -> None:
    knee = torques_of(leg_log(ExternalDisturbance, values=(0.6, 3.0, 0.3)))["knee"]
    step = (knee.time > 4.0).astype(float)
    shown = knee.seen(np.column_stack([step, np.ones_like(step)]))
    assert shown[:, 1] == pytest.approx(np.ones(len(step)), rel=0.05)
    assert np.abs(shown[:, 0] - step).mean() < 0.05
    assert knee.seen(step) == pytest.approx(shown[:, 0])


# --- proposals --------------------------------------------------------------------------------------------


def test_nothing_is_proposed_where_nothing_stands_out() -> None:
    assert asked(leg_log()) == []


def test_a_push_is_proposed_when_it_was() -> None:
    found = asked(leg_log(ExternalDisturbance, values=(0.5, 3.21, 0.27)))
    (push,) = (q for q in found if q.effect is ExternalDisturbance)
    assert push.places == ("knee",)
    assert push.probe[0][1:] == pytest.approx((3.21, 0.27), abs=0.03)
    assert not any(q.effect.variant for q in found)


def test_pushes_at_regular_intervals_are_proposed_as_a_train() -> None:
    found = asked(leg_log(ExternalDisturbanceTrain, "ankle", (0.4, 0.55, 0.15, 0.73)))
    (train,) = (q for q in found if q.effect is ExternalDisturbanceTrain)
    assert train.places == ("ankle",)
    _, start, duration, period = train.probe[0]
    assert (start, duration, period) == pytest.approx((0.55, 0.15, 0.73), abs=0.025)
    assert period == pytest.approx(0.73, abs=0.004)


def test_cogging_is_proposed_at_its_spatial_frequency() -> None:
    found = asked(leg_log(Cogging, "hip", (0.2, 0.1, 31.0)))
    numbers = [q.probe[0][2] for q in found if q.effect is Cogging and q.places == ("hip",)]
    assert numbers
    assert numbers[0] == pytest.approx(31.0, rel=0.03)


@pytest.mark.parametrize(
    ("clocks", "groups"),
    [
        ({"hip": (0.0304, 0.0203), "knee": (0.0305, 0.0101)}, [("hip", "knee"), ("hip", "knee", "ankle")]),
        ({"hip": (0.0304, 0.0203), "knee": (0.0305, 0.0101), "ankle": (0.041, 0.005)}, [("hip", "knee")]),
        ({"hip": (0.0304, 0.0203), "knee": (0.041, 0.0203)}, []),
        ({"hip": (0.0304, 0.0203)}, []),
    ],
)
def test_drives_that_take_commands_at_equal_intervals_are_proposed_together(
    clocks: dict[str, tuple[float, float]], groups: list[tuple[str, ...]]
) -> None:
    """Of commands that are held, moments so far apart are nearly the same: all of them are asked for."""
    found = [Perturbation(CommandDelaySampled, (joint,), (clock,)) for joint, clock in clocks.items()]
    together = by_one_clock(found, toys.LEG_JOINTS, step=0.01)
    assert list(dict.fromkeys(q.places for q in together)) == groups
    for group in groups:
        moments = [q.probe[0][1] for q in together if q.places == group]
        assert {q.probe[0][0] for q in together} == {np.median([period for period, _ in clocks.values()])}
        for _, start in (clocks["hip"], clocks["knee"]):
            assert min(abs(start - at) for at in moments) < 1e-9
            assert min(abs(start + 0.01 - at) for at in moments) < 1e-9 or start + 0.01 > 0.0304


def test_only_effects_of_the_library_are_proposed() -> None:
    log = leg_log(ExternalDisturbance, values=(0.5, 3.21, 0.27))
    assert asked(log, (CoulombFriction,)) == []
    assert all(q.effect is Cogging for q in asked(log, (CoulombFriction, Cogging)))


@pytest.mark.parametrize("effort", [False, True])
def test_pulses_in_the_drive_are_asked_for_only_where_an_effort_could_show_them(effort: bool) -> None:
    log = leg_log(DriveDisturbanceTrain, "knee", (0.5, 0.3, 0.2, 0.9), effort=effort)
    trains = usable_effects((ExternalDisturbanceTrain, DriveDisturbanceTrain), study_of(log))
    assert {q.effect for q in asked(log, trains)} == set(trains)
    assert (DriveDisturbanceTrain in trains) is effort


def test_a_blow_that_rings_is_proposed_when_and_as_it_was() -> None:
    found = asked(leg_log(RingingDisturbance, values=(0.6, 3.21, 2.7, 0.4)))
    rings = [q for q in found if issubclass(q.effect, RingingDisturbance)]
    assert [(q.effect, q.places) for q in rings] == [(RingingDisturbance, ("knee",))]
    assert rings[0].probe[0][1:] == pytest.approx((3.21, 2.7, 0.4), rel=0.1, abs=0.02)


@pytest.mark.parametrize(
    ("start", "period"), [(0.9, 1.9), (2.6, 2.1)], ids=["from the beginning", "first later than a period"]
)
def test_blows_that_come_again_are_proposed_as_a_train(start: float, period: float) -> None:
    found = asked(leg_log(RingingDisturbanceTrain, "ankle", (-0.4, start, 3.4, 0.3, period)))
    (train,) = (q for q in found if q.effect is RingingDisturbanceTrain)
    assert train.places == ("ankle",)
    assert train.probe[0][1:] == pytest.approx((start, 3.4, 0.3, period), rel=0.1, abs=0.02)
    assert train.probe[0][4] == pytest.approx(period, abs=0.01)


@pytest.mark.parametrize("frequency", [1.3, 4.1])
def test_what_never_dies_away_is_no_blow(frequency: float) -> None:
    wave = np.sin(2 * np.pi * frequency * 0.01 * np.arange(900))
    assert blows(torque_of(wave)) == (None, None)


@pytest.mark.parametrize("seed", range(5))
def test_noise_of_any_colour_does_not_ring(seed: int) -> None:
    white = noise(900, seed)
    smooth = np.convolve(white, np.ones(20) / 20, "same")
    assert [blows(torque_of(x)) for x in (white, smooth)] == [(None, None)] * 2


# --- pulse trains as effects ------------------------------------------------------------------------------


@settings(max_examples=50, deadline=None)
@given(
    start=st.floats(0.0, 1.0),
    duration=st.floats(0.001, 0.5),
    period=st.floats(0.05, 2.0),
    step=st.sampled_from([0.001, 0.004, 0.01]),
)
def test_a_train_gives_the_impulse_of_its_pulses(start: float, duration: float, period: float, step: float) -> None:
    time = step * np.arange(round(3.0 / step) + 1)
    given_torque = ExternalDisturbanceTrain.mean_torque(np.array([[2.0, start, duration, period]]), time[None])[0]
    begins = start + period * np.arange(200)
    ends = begins + min(duration, period)
    exact = 2.0 * np.sum(np.clip(np.minimum(ends, time[-1]) - np.minimum(begins, time[-1]), 0, None))
    assert np.sum(given_torque) * step == pytest.approx(exact, abs=1e-9)
    assert given_torque.min() >= -1e-9
    assert given_torque.max() <= 2.0 + 1e-9


def test_a_train_of_one_pulse_is_a_push() -> None:
    log = toys.swing(toys.LEG_JOINTS)
    scales = dict.fromkeys(toys.LEG_JOINTS, toys.SCALE)
    one = toys.position(toys.leg(), log, (ExternalDisturbance.at(("knee",), scales),), (0.7, 0.4, 0.1))
    train = toys.position(toys.leg(), log, (ExternalDisturbanceTrain.at(("knee",), scales),), (0.7, 0.4, 0.1, 50.0))
    assert train == pytest.approx(one, abs=1e-12)


def test_a_pulse_in_the_drive_moves_like_a_push_and_shows_in_the_effort() -> None:
    log = toys.swing(toys.LEG_JOINTS)
    scales = dict.fromkeys(toys.LEG_JOINTS, toys.SCALE)
    values = (0.5, 0.4, 0.2, 0.6)
    outside = toys.run(toys.leg(), log, (ExternalDisturbanceTrain.at(("knee",), scales),), values, effort=True)
    inside = toys.run(toys.leg(), log, (DriveDisturbanceTrain.at(("knee",), scales),), values, effort=True)
    assert inside.position == pytest.approx(outside.position, abs=1e-9)
    assert inside.effort is not None
    assert outside.effort is not None
    knee = toys.LEG_JOINTS.index("knee")
    on = np.mod(log.time - 0.4 + 0.005, 0.6) < 0.2
    on &= log.time > 0.39
    difference = (inside.effort - outside.effort)[0, :-1, knee]
    assert difference == pytest.approx(0.5 * on[:-1], abs=1e-6)


@settings(max_examples=50, deadline=None)
@given(
    start=st.floats(0.0, 1.0),
    frequency=st.floats(0.2, 15.0),
    decay=st.floats(0.02, 2.0),
    period=st.floats(0.1, 2.0),
    step=st.sampled_from([0.001, 0.004, 0.01]),
)
def test_a_train_of_blows_gives_the_sum_of_what_each_rings(
    start: float, frequency: float, decay: float, period: float, step: float
) -> None:
    time = step * np.arange(round(3.0 / step) + 1)
    given_torque = RingingDisturbanceTrain.mean_torque(np.array([[2.0, start, frequency, decay, period]]), time[None])
    each = [
        RingingDisturbance.mean_torque(np.array([[2.0, start + k * period, frequency, decay]]), time[None])
        for k in range(int(3.0 / period) + 1)
    ]
    assert given_torque == pytest.approx(np.sum(each, axis=0), abs=1e-9)


def test_a_blow_rings_as_a_damped_oscillator_that_was_struck() -> None:
    frequency, decay, start, step = 2.5, 0.4, 0.3, 1e-4
    time = step * np.arange(20001)
    torque = RingingDisturbance.mean_torque(np.array([[0.7, start, frequency, decay]]), time[None])[0]
    since = time[:-1] + 0.5 * step - start
    rings = 0.7 * np.exp(-since / decay) * np.sin(2 * np.pi * frequency * since)
    assert torque == pytest.approx(np.where(since > 0, rings, 0.0), abs=1e-6)


@pytest.mark.parametrize(
    ("effect", "truth", "guess"),
    [
        (ExternalDisturbance, (0.6, 1.013, 0.204), (0.5, 1.03, 0.18)),
        (ExternalDisturbanceTrain, (0.6, 1.013, 0.204, 1.3), (0.5, 1.03, 0.18, 1.302)),
        (RingingDisturbance, (0.6, 1.013, 2.7, 0.41), (0.5, 1.05, 2.5, 0.3)),
        (RingingDisturbanceTrain, (0.6, 1.013, 2.7, 0.41, 1.7), (0.5, 1.05, 2.5, 0.3, 1.71)),
    ],
)
def test_bounds_around_a_guess_let_a_fit_refine_its_times(
    effect: type[Push], truth: tuple[float, ...], guess: tuple[float, ...]
) -> None:
    guess, truth = np.array(guess), np.array(truth)
    study = study_of(leg_log(effect, values=truth))
    pulse = effect.at(("knee",), study.scales).around(guess)
    assert all(p.lower <= g <= p.upper for p, g in zip(pulse.parameters, guess, strict=True))
    assert pulse.neutral[0] == 0
    found = refit(study, Model.of((pulse,), guess)).model.values
    assert found == pytest.approx(truth, abs=0.01, rel=0.03)
    assert found[1] == pytest.approx(truth[1], abs=0.004)


# --- signature --------------------------------------------------------------------------------------------


def test_nothing_is_described_at_the_noise_floor() -> None:
    found = described(leg_log())
    assert found["joints"] == []
    assert "noise floor" in found["summary"]


def test_a_single_push_is_localised_and_depends_on_nothing() -> None:
    found = described(leg_log(ExternalDisturbance, values=(0.6, 3.0, 0.2)))
    (knee,) = found["joints"]
    assert knee["joint"] == "knee"
    assert knee["localised"]["share"] > 0.9
    assert 2.0 <= knee["localised"]["start"] <= 3.2
    assert knee["best"] == "none"
    assert "independent of" in found["summary"]


def test_pulses_are_described_by_period_and_amplitude() -> None:
    found = described(leg_log(ExternalDisturbanceTrain, values=(0.5, 0.55, 0.15, 0.73)))
    knee = found["joints"][0]
    assert knee["best"] == "phase"
    assert knee["periodic"]["period"] == pytest.approx(0.73, abs=0.005)
    assert knee["periodic"]["duration"] == pytest.approx(0.15, abs=0.04)
    assert knee["periodic"]["amplitude"] == pytest.approx(0.5, rel=0.2)
    assert "every 0.73" in found["summary"]


def test_friction_depends_on_the_sign_of_the_velocity() -> None:
    found = described(leg_log(CoulombFriction, "hip", (0.3,)))
    assert found["joints"][0]["joint"] == "hip"
    assert found["joints"][0]["best"] in ("direction", "load")


LEG = str(Path(__file__).resolve().parents[1] / "sample_logs" / "leg.xml")


def unexplained(effect: str) -> dict[str, Any]:
    """Signature of something that is in no library, in a log from another engine."""
    pytest.importorskip("pinocchio", reason="the recorder needs Pinocchio (pip install pin)")
    from reference_simulator import Recording, parse_effect, record

    spec = Recording(LEG, seed=3, seconds=16, mass={"KneePitch": 1.1}, effects=(parse_effect(effect),))
    study = make_study(load_robot(LEG), [record(spec)[0]], holdout=0.1)
    terms = study.declare(["mass:*Knee*", "kp:*=shared"])
    return signature(study, refit(study, Model.of(terms, np.ones(2))).model)


@pytest.mark.parametrize(
    ("effect", "best"),
    [
        ("gain_drift:KneePitch", "torque_and_time"),
        ("friction_patch:KneePitch:centre=0.8", "position_and_direction"),
        ("controller_dropout:KneePitch", "torque_and_phase"),
        ("cable_coupling:HipPitch,KneePitch", "position:HipPitch"),
        ("random_walk_torque:KneePitch", "time"),
    ],
)
def test_what_is_in_no_library_is_described_as_what_it_is(effect: str, best: str) -> None:
    found = unexplained(effect)
    worst = found["joints"][0]
    assert worst["joint"] == "KneePitch"
    assert worst["best"] == best, worst["dependence"]
    if effect.startswith("controller_dropout"):
        assert worst["periodic"]["period"] == pytest.approx(1.7, abs=0.01)
    if effect.startswith("gain_drift"):
        assert worst["gain_period"] == pytest.approx(7.0, rel=0.1)


def test_the_recorded_dropout_is_periodic_with_its_period() -> None:
    study = make_study(load_robot(LEG), [read_log(Path(LEG).with_name("leg_dropout.parquet"))])
    terms = study.declare(["mass:*Knee*", "kp:*=shared"])
    found = signature(study, refit(study, Model.of(terms, np.ones(2))).model)
    knee = found["joints"][0]
    assert (knee["joint"], knee["best"]) == ("KneePitch", "torque_and_phase")
    assert knee["periodic"]["period"] == pytest.approx(1.7, abs=0.01)


def test_the_measured_pulses_of_emps_are_found(shared_data: Path) -> None:
    log = read_log(shared_data / "emps" / "emps_pulses.parquet").window(0, 9001)
    study = make_study(emps(), [log], holdout=0.1)
    terms = study.declare(["mass:*", "damping:*", "frictionloss:*", "constant_force:*"])
    values = np.array([1.0, 203.5, 20.4, 3.16])
    problem = study.train_problem(Model.of(terms, values))
    residual = problem.residuals(values[None])[0]
    found = proposals(study, problem, values, residual, (ExternalDisturbanceTrain, DriveDisturbanceTrain))
    assert [q.effect for q in found] == [ExternalDisturbanceTrain, DriveDisturbanceTrain]
    assert found[0].probe[0][1:] == pytest.approx((0.344, 0.5, 1.0), abs=0.004)
    (slider,) = signature(study, problem.model)["joints"]
    assert slider["periodic"]["amplitude"] == pytest.approx(178, rel=0.03)
    assert slider["best"] == "phase"


# --- patterns ---------------------------------------------------------------------------------------------


def noise(n: int, seed: int = 0) -> FloatArray:
    return np.random.default_rng(seed).normal(size=n)


def test_states_that_have_nothing_to_do_with_a_signal_predict_nothing_of_it() -> None:
    state = np.cumsum(noise(2000, 1))
    many = signal_features.hats(state, signal_features.even_knots(state, 30))
    assert abs(signal_features.predicted_share(noise(2000), many, 50)) < 0.05


def test_a_state_predicts_what_it_causes() -> None:
    state = np.sin(0.01 * np.arange(2000)) + 0.3 * np.sin(0.037 * np.arange(2000))
    signal = state**2 + 0.1 * noise(2000)
    hats = signal_features.hats(state, signal_features.even_knots(state, 12))
    assert signal_features.predicted_share(signal, hats, 50) > 0.9


@settings(max_examples=25, deadline=None)
@given(start=st.integers(30, 700), length=st.integers(20, 200), seed=st.integers(0, 99))
def test_a_pulse_is_found_in_noise(start: int, length: int, seed: int) -> None:
    signal = noise(1000, seed)
    signal[start : start + length] += 5.0
    box = signal_features.best_box(signal, 2)
    assert box is not None
    assert abs(box.start - start) <= 2
    assert abs(box.stop - start - length) <= 2


@pytest.mark.parametrize("seconds", [6.0, 40.0])
@pytest.mark.parametrize(("period", "start"), [(0.0484, 0.032), (0.03, 0.009), (0.11, 0.1)])
def test_intervals_between_commands_are_seen_in_the_torque(seconds: float, period: float, start: float) -> None:
    """Between samples of the log, in noise, and beside a delay of any size."""
    fine = np.arange(round(seconds * 1000) + 1) * 1e-3
    time = fine[:-1:10]
    rng = np.random.default_rng(1)
    waves = rng.normal(size=4) * np.sin(2 * np.pi * np.outer(time, [0.3, 0.7, 1.1, 1.9]) + rng.uniform(0, 6, 4))
    command = waves.sum(axis=1)
    taken = sampled(np.repeat(command, 10)[None], fine[None], period, start)[0].reshape(-1, 10).mean(axis=1)
    rate = np.gradient(command) / np.linalg.norm(np.gradient(command))

    def beside_a_delay(x: FloatArray) -> FloatArray:
        return np.asarray(x - rate[:, None] * (rate @ x))

    torque = beside_a_delay((taken - command)[:, None])[:, 0]
    torque = torque + 0.3 * torque.std() * rng.normal(size=len(time))
    found = signal_features.best_sampling(torque, command, time, beside_a_delay)
    assert found is not None
    assert found[0] == pytest.approx(period, abs=0.1 * period**2 / seconds)
    assert found[1] == pytest.approx(start, abs=0.05 * period)
    assert found[2] > 0.85


def test_no_intervals_between_commands_are_seen_in_noise() -> None:
    time = np.arange(900) * 0.01
    found = signal_features.best_sampling(noise(900), np.sin(3 * time), time, lambda x: x)
    assert found is None or found[2] < 0.05


@settings(max_examples=15, deadline=None)
@given(period=st.floats(0.4, 2.2), phase=st.floats(0.0, 1.0), seed=st.integers(0, 99))
def test_a_period_is_found_and_not_its_multiple(period: float, phase: float, seed: int) -> None:
    time = 0.01 * np.arange(1400)
    on = np.mod(time / period - phase, 1.0) < 0.25
    found, share = signal_features.best_period(on + 0.2 * noise(1400, seed), time, 0.3)
    assert found == pytest.approx(period, rel=0.01)
    assert share > 0.5


def test_noise_has_no_period_and_no_memory() -> None:
    time = 0.01 * np.arange(1400)
    assert signal_features.best_period(noise(1400), time, 0.3)[1] < 0.15
    assert signal_features.memory(noise(5000)) == pytest.approx(1.0, abs=0.3)
