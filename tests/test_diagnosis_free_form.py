"""Of what the missing torque is a function, and which function."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from toys import robot_from_xml, swing

from sysid_btr.diagnosis.free_form import FreeForm, free_forms
from sysid_btr.diagnosis.selection import STANDARD
from sysid_btr.diagnosis.trials import attempt
from sysid_btr.identify.missing_torque import MissingTorque, missing_torques
from sysid_btr.identify.study import Study, make_study
from sysid_btr.simulation.numerics import Numerics
from sysid_btr.simulation.replay import Replay
from sysid_btr.terms.free_form import (
    FreeFrictionLoad,
    FreeFrictionPosition,
    FreeGainTime,
    FreeTorqueLoad,
    FreeTorquePeriodic,
    FreeTorquePosition,
    FreeTorqueTime,
)
from sysid_btr.terms.model import Model

XML = """<mujoco><worldbody><body><joint name="RKnee" axis="0 1 0" damping=".1" armature=".01"/>
<geom type="capsule" fromto="0 0 0 0 0 -.2" size=".02" mass=".5"/></body></worldbody>
<actuator><position joint="RKnee" kp="20" kv=".5"/></actuator></mujoco>"""
ROBOT, LOG, NUMERICS = robot_from_xml(XML), swing(("RKnee",), seconds=8.0), Numerics("implicitfast", 0.002)


def study_of(model: Model, logs: int = 1) -> Study:
    """Recordings of the robot with what a model adds."""
    outputs = Replay(ROBOT, LOG, model.terms, NUMERICS).predict(model.values[None])
    positions = (outputs.position[0, :, 0] + np.random.default_rng(k).normal(0.0, 5e-4, len(LOG)) for k in range(logs))
    recordings = [replace(LOG, channels={**LOG.channels, "position.RKnee": p}) for p in positions]
    return make_study(ROBOT, recordings, numerics=NUMERICS, threads=1)


STUDY = study_of(Model.of(()), 2)
PERIOD, COUNT, NOISE = 0.01, 1200, 0.01
Array = np.ndarray


def record(torque: Callable[[MissingTorque], Array], seed: int = 0, **more: object) -> MissingTorque:
    """An estimate of a missing torque along a motion of several sines."""
    rng = np.random.default_rng(seed)
    t = PERIOD * np.arange(COUNT)
    phase = rng.uniform(0, 6.28, 4)
    waves = [(f, a, p) for f, a, p in zip((0.2, 0.45, 0.8, 1.1), (0.3, 0.25, 0.15, 0.1), phase, strict=True)]
    q = sum(a * np.sin(2 * np.pi * f * t + p) for f, a, p in waves)
    v, a = np.gradient(q, PERIOD), np.gradient(np.gradient(q, PERIOD), PERIOD)
    load = 0.8 * np.sin(q) + 0.02 * a + 0.1 * v
    one = MissingTorque(
        joint="RKnee",
        episode=0,
        unit="Nm",
        period=PERIOD,
        time=t,
        torque=np.zeros(COUNT),
        noise=NOISE,
        residual=np.zeros(COUNT),
        chi2=20.0,
        position=q,
        velocity=v,
        acceleration=a,
        command=np.roll(q, -4),
        servo=load,
        servo_measured=load,
        frequency=np.array([0.0, 50.0]),
        gain=np.ones(2),
    )
    one = replace(one, **more)  # type: ignore[arg-type]
    return replace(one, torque=torque(one) + NOISE * rng.normal(size=COUNT))


def best(*missing: MissingTorque) -> FreeForm:
    one = missing[0]
    scale = replace(
        STUDY.scales["RKnee"],
        torque_rms=float(np.std(one.servo)),
        torque_peak=float(np.abs(one.servo).max()),
        velocity_rms=float(np.std(one.velocity)),
        velocity_peak=float(np.abs(one.velocity).max()),
        span=float(np.ptp(one.position)),
        centre=float(0.5 * (one.position.max() + one.position.min())),
        seconds=12.0,
    )
    problem = STUDY.train_problem(())
    return free_forms(problem, np.zeros(0), {"RKnee": scale}, missing)[0]


def test_a_sine_from_outside_is_periodic_in_time_with_its_frequency_also_where_the_drive_answers_it() -> None:
    def wave(m: MissingTorque) -> Array:
        return 0.6 * np.sin(2 * np.pi * 3.7 * m.time + 0.4)

    one = record(wave)
    found = best(replace(one, servo_measured=one.servo - 0.7 * one.torque))
    assert found.hypothesis.effect is FreeTorquePeriodic
    assert found.sentence == "a torque at RKnee that is periodic in time: 0.6 Nm at 3.7 Hz"
    assert found.share > 0.95
    assert found.hypothesis.start[-1] == pytest.approx(3.7, abs=0.01)


CASES = {
    FreeTorqueLoad: lambda m: 0.2 * m.servo * np.abs(m.servo) / np.std(m.servo),
    FreeFrictionLoad: lambda m: -np.sign(m.velocity) * (0.05 + 0.3 * np.abs(m.servo)),
    FreeFrictionPosition: lambda m: -np.sign(m.velocity) * 0.2 * (1 + np.sin(5 * m.position)),
    FreeTorquePosition: lambda m: -1.5 * m.position**3,
    FreeTorqueTime: lambda m: 0.3 / (1 + np.exp(-(m.time - 6.0))),
    FreeGainTime: lambda m: m.servo * (0.15 - 0.3 / (1 + np.exp(-(m.time - 6.0)))),
}


@pytest.mark.parametrize("form", CASES, ids=lambda form: form.label)
def test_what_it_depends_on_is_found_and_its_curve_lies_in_the_interval(form: type) -> None:
    torque = CASES[form]
    found = best(record(torque, seed=1))
    assert found.hypothesis.effect is form
    assert found.share > 0.8
    assert (found.low < found.torque).all()
    assert (found.torque < found.high).all()


def test_a_torque_that_grows_with_load_is_said_so() -> None:
    found = best(record(lambda m: 0.2 * np.maximum(m.servo, 0.0) ** 2 / 0.25))
    assert found.sentence.startswith("a torque at RKnee that depends on load: rises to")


def test_two_logs_agree_on_a_state_and_have_no_clock_in_common() -> None:
    spring = CASES[FreeTorquePosition]
    assert best(record(spring, 1), record(spring, 2, episode=1)).hypothesis.effect is FreeTorquePosition
    logs = [record(lambda m: 0.6 * np.sin(23.0 * m.time), s, episode=s) for s in (0, 1)]
    problem = STUDY.train_problem(())
    found = free_forms(problem, np.zeros(0), STUDY.scales, logs)
    assert FreeTorquePeriodic not in {f.hypothesis.effect for f in found}


def test_noise_is_no_function_of_anything() -> None:
    one = record(lambda m: np.zeros(COUNT), chi2=3.0, noise=0.0)
    assert free_forms(STUDY.train_problem(()), np.zeros(0), STUDY.scales, [one]) == ()


def test_a_quiet_joint_is_not_looked_at() -> None:
    one = record(CASES[FreeTorquePosition], chi2=1.1)
    assert free_forms(STUDY.train_problem(()), np.zeros(0), STUDY.scales, [one]) == ()


def test_a_wave_that_the_model_lacks_is_found_in_a_log_and_a_refit_leaves_the_noise() -> None:
    term = FreeTorquePeriodic.at(("RKnee",), STUDY.scales)
    true = Model.of([term], np.array([0.3, 0.1, 0.0, 0.0, 0.0, 3.7]))
    study = study_of(true)
    problem = study.train_problem(())
    found = free_forms(problem, np.zeros(0), study.scales, missing_torques(problem, np.zeros(0), study.scales))
    assert found[0].sentence.endswith("periodic in time: 0.45 Nm at 3.7 Hz")
    done = attempt(study, Model.of(()), found[0].hypothesis, STANDARD).fitted
    assert done.holdout < 1.3
    assert done.model.values[-1] == pytest.approx(3.7, abs=2e-3)


def test_a_gain_that_falls_and_recovers_is_found_in_a_log_and_a_refit_leaves_the_noise() -> None:
    """Not in the form of the term: the gain drops at once, and comes back."""
    term = FreeGainTime.at(("RKnee",), STUDY.scales)
    x = np.linspace(0.0, STUDY.scales["RKnee"].seconds, 200)
    change = -0.25 * np.exp(-(((x - 3.0) / 1.2) ** 2))
    amounts = np.linalg.lstsq(term.modes_of("RKnee", x), change - change.mean(), rcond=None)[0]
    study = study_of(Model.of([term], amounts))
    problem = study.train_problem(())
    found = free_forms(problem, np.zeros(0), study.scales, missing_torques(problem, np.zeros(0), study.scales))
    assert found[0].hypothesis.effect is FreeGainTime
    assert "a change of gain at RKnee that follows time: from" in found[0].sentence
    done = attempt(study, Model.of(()), found[0].hypothesis, STANDARD).fitted
    assert done.holdout < 1.3
    moving = x[x > 1.0]  # a gain does nothing at a joint at rest
    found_there, there = (term.curve("RKnee", v, moving) for v in (done.model.values, amounts))
    np.testing.assert_allclose(found_there, there, atol=0.02)
