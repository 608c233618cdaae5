"""Torques of a form that is learnt: curves by modes of splines, as terms, in files, in words and in a picture."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from toys import robot_from_xml, swing

from sysid_btr.display.text import curve_lines, tabled_estimates
from sysid_btr.identify.curves import curves_of
from sysid_btr.identify.intervals import Estimate
from sysid_btr.identify.study import make_study
from sysid_btr.report.curves import plot_curves
from sysid_btr.report.figures import figure_of
from sysid_btr.simulation.numerics import Numerics
from sysid_btr.simulation.replay import Replay
from sysid_btr.terms.base import Parameter, Term
from sysid_btr.terms.disturbance import ConstantForce
from sysid_btr.terms.free_form import (
    EVEN,
    FREE_FORMS,
    FreeCurve,
    FreeFrictionSpeed,
    FreeGainOfAll,
    FreeGainStiffness,
    FreeGainTime,
    FreeReadingPosition,
    FreeReadingTime,
    FreeTorqueLoad,
    FreeTorquePeriodic,
    FreeTorquePosition,
    FreeTorqueTime,
    FreeTorqueVelocity,
    curve_in_words,
    modal_bounds,
    periodic_modes,
    smooth_modes,
)
from sysid_btr.terms.friction import CoulombFriction
from sysid_btr.terms.model import Model
from sysid_btr.terms.power import VoltageSag
from sysid_btr.terms.sensing import EncoderScale
from sysid_btr.terms.spring import JointSpring
from sysid_btr.writeback.params import read_params
from sysid_btr.writeback.write import Identified, draft, params_of

XML = """<mujoco model="toy"><worldbody><body name="shank"><joint name="knee" axis="0 1 0" damping=".1" armature=".01"/>
<geom type="capsule" fromto="0 0 0 0 0 -.2" size=".02" mass=".5"/></body></worldbody>
<actuator><position joint="knee" kp="20" kv=".5"/></actuator></mujoco>"""
ROBOT, LOG = robot_from_xml(XML), swing(("knee",), seconds=2.0)
STUDY = make_study(ROBOT, [LOG], numerics=Numerics("implicitfast", 0.002), threads=1)


def moved(term: Term, values: object) -> np.ndarray:
    """Position under a term."""
    replay = Replay(ROBOT, LOG, (term,), STUDY.numerics)
    return np.asarray(replay.predict(np.atleast_2d(np.asarray(values, dtype=float))).position[0, :, 0])


def fitted(term: FreeCurve, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Amounts whose curve is nearest to y(x)."""
    return np.asarray(np.linalg.lstsq(term.modes_of(term.places[0], x), y, rcond=None)[0])


def at_knee(cls: type[FreeCurve]) -> FreeCurve:
    return cls.at(("knee",), STUDY.scales)


def test_modes_are_orthonormal_and_each_bends_more_than_the_one_before() -> None:
    modes = smooth_modes()(EVEN)
    np.testing.assert_allclose(modes.T @ modes / len(EVEN), np.eye(8), atol=1e-9)
    np.testing.assert_allclose(modes[:, 0], 1.0, atol=1e-6)
    np.testing.assert_allclose(modes[:, 1], np.sqrt(12) * (EVEN - 0.5), atol=1e-4)
    bent = np.sqrt(np.mean(smooth_modes()(EVEN, nu=2) ** 2, axis=0))
    assert (np.diff(bent) > -1e-9).all()
    np.testing.assert_allclose(np.array(modal_bounds(6))[2:] * bent[2:6], bent[2], rtol=0.05)  # as a free beam's


def test_periodic_modes_close_and_the_first_two_are_one_wave() -> None:
    modes = periodic_modes()
    for order in (0, 1, 2):
        np.testing.assert_allclose(modes(1e-12, nu=order), modes(1 - 1e-12, nu=order), atol=1e-6)
    seen = modes(EVEN)
    np.testing.assert_allclose(seen.T @ seen / len(EVEN), np.eye(5), atol=1e-9)
    waves = np.column_stack([np.sin(2 * np.pi * EVEN), np.cos(2 * np.pi * EVEN)])
    for target in waves.T:
        near = seen[:, :2] @ (seen[:, :2].T @ target) / len(EVEN)
        assert np.abs(near - target).max() < 0.02


@pytest.mark.parametrize("cls", [FreeTorquePosition, FreeTorqueVelocity, FreeTorqueLoad, FreeTorqueTime])
def test_a_flat_curve_is_a_constant_torque(cls: type[FreeCurve]) -> None:
    flat = moved(at_knee(cls), [0.3, *[0.0] * 7])
    np.testing.assert_allclose(flat, moved(ConstantForce.at(("knee",), STUDY.scales), [0.3]), atol=1e-6)


def test_a_straight_curve_of_the_position_is_a_spring_and_beyond_its_range_it_stays() -> None:
    term = at_knee(FreeTorquePosition)
    ((low, high),) = term.ranges
    x = np.linspace(low, high, 50)
    amounts = fitted(term, x, -1.5 * (x - 0.1))
    spring = JointSpring.at(("knee",), STUDY.scales)
    values = [{"stiffness": 1.5, "rest": 0.1}[k.name] for k in spring.kinds]
    np.testing.assert_allclose(moved(term, amounts), moved(spring, values), atol=1e-3)
    beyond = term.curve("knee", amounts, np.array([high, high + 1.0]))
    assert beyond[0] == beyond[1]


def test_a_straight_error_of_the_encoder_is_one_of_its_scale() -> None:
    term = at_knee(FreeReadingPosition)
    x = np.linspace(*term.ranges[0], 50)
    scale = EncoderScale.at(("knee",), STUDY.scales)
    np.testing.assert_allclose(moved(term, fitted(term, x, 0.05 * x)), moved(scale, [0.05]), atol=1e-3)
    assert term.axes == ("position (rad)", "error (rad)")


def test_an_error_of_the_encoder_over_time_is_in_what_the_log_shows_alone() -> None:
    term = at_knee(FreeReadingTime)
    drift = 0.03 * np.minimum(LOG.time, term.ranges[0][1])
    amounts = fitted(term, LOG.time, drift)
    np.testing.assert_allclose(moved(term, amounts) - moved(term, term.neutral), drift, atol=1e-4)


def test_level_friction_that_does_not_depend_on_speed_is_dry_friction() -> None:
    dry = moved(CoulombFriction.at(("knee",), STUDY.scales), [0.2])
    np.testing.assert_allclose(moved(at_knee(FreeFrictionSpeed), [0.2, *[0.0] * 7]), dry, atol=1e-5)


@pytest.mark.parametrize(("cls", "place"), [(FreeGainTime, "knee"), (FreeGainOfAll, "robot")])
def test_a_gain_that_falls_evenly_is_a_supply_that_sags(cls: type[FreeCurve], place: str) -> None:
    term, rate = cls.at((place,), STUDY.scales), 0.05
    x = np.linspace(*term.ranges[0], 50)
    middle = 1.0 - rate * float(np.mean(term.ranges[0]))
    weaker = robot_from_xml(XML.replace('kp="20" kv=".5"', f'kp="{20 * middle}" kv="{0.5 * middle}"'))
    amounts = fitted(term, x, (1.0 - rate * x) / middle - 1.0)
    within = LOG.time <= term.ranges[0][1]
    sagging, plain = moved(VoltageSag.at(("robot",), STUDY.scales), [rate])[within], moved(term, term.neutral)[within]
    falling = Replay(weaker, LOG, (term,), STUDY.numerics).predict(amounts[None]).position[0, :, 0][within]
    assert np.abs(falling - sagging).max() < 0.01 * np.abs(plain - sagging).max()


def test_where_stiffness_falls_the_damping_stays() -> None:
    """As in a servo without damping at a joint that has all of it."""
    bare = robot_from_xml(XML.replace('damping=".1"', 'damping=".6"').replace('kv=".5"', 'kv="0"'))
    stiffness, gain = (cls.at(("robot",), STUDY.scales) for cls in (FreeGainStiffness, FreeGainOfAll))
    amounts = fitted(stiffness, np.linspace(0, 2, 50), np.linspace(0.3, -0.3, 50))
    replays = [
        (bare, gain, amounts),
        (ROBOT, gain, amounts),
        (ROBOT, stiffness, amounts),
        (ROBOT, stiffness, 0 * amounts),
    ]
    wanted, whole, falling, plain = (
        Replay(robot, LOG, (term,), Numerics("RK4", 0.0005)).predict(values[None]).position[0, :, 0]
        for robot, term, values in replays
    )
    assert np.abs(falling - wanted).max() < 0.01 * np.abs(whole - wanted).max()
    assert np.abs(falling - wanted).max() < 0.01 * np.abs(plain - wanted).max()


def test_a_gain_never_changes_its_sign() -> None:
    term = at_knee(FreeGainTime)
    most = np.array([p.upper for p in term.parameters])
    assert np.isfinite(moved(term, most)).all()
    assert np.isfinite(moved(term, -most)).all()


def test_friction_never_drives() -> None:
    term = at_knee(FreeFrictionSpeed)
    np.testing.assert_array_equal(moved(term, [-0.2, *[0.0] * 7]), moved(term, term.neutral))


def test_a_periodic_torque_is_that_wave_at_its_frequency() -> None:
    term = at_knee(FreeTorquePeriodic)
    time = np.arange(0.0, 2.0, 0.001)
    amounts = np.array([0.3, 0.3, 0.0, 0.0, 0.0, 3.7])
    y = term.curve("knee", amounts, np.mod(3.7 * time, 1.0))
    wave = np.column_stack([np.sin(2 * np.pi * 3.7 * time), np.cos(2 * np.pi * 3.7 * time)])
    assert np.abs(y - wave @ np.linalg.lstsq(wave, y, rcond=None)[0]).max() < 0.02
    assert term.in_words("knee", amounts) == "0.6 Nm at 3.7 Hz"
    narrow = term.around(amounts).parameters[-1]
    assert narrow.lower == pytest.approx(3.7 - 0.5 / STUDY.scales["knee"].seconds)


def test_the_grammar_frees_a_curve_at_a_joint_over_what_the_joint_does() -> None:
    (term,) = STUDY.declare(["free_torque.load:knee"])
    assert isinstance(term, FreeTorqueLoad)
    assert [p.name for p in term.parameters][:2] == ["free_torque.load.c1:knee", "free_torque.load.c2:knee"]
    scale = STUDY.scales["knee"]
    largest = min(scale.torque_peak, 3 * scale.torque_rms)
    assert term.ranges == ((-largest, largest),)


@pytest.mark.parametrize("cls", FREE_FORMS)
def test_a_parameter_file_holds_the_range_of_a_curve(cls: type[FreeCurve], tmp_path: Path) -> None:
    term = at_knee(cls)
    model = Model.of([term], term.neutral + 0.1 * term.parameters[0].scale)
    (tmp_path / "params.json").write_text(json.dumps(params_of(Identified(STUDY, model, ()))))
    read = read_params(tmp_path / "params.json", ROBOT).model
    assert read.terms[0].ranges == term.ranges
    np.testing.assert_array_equal(read.values, model.values)


def test_a_model_file_says_in_words_which_curve_it_does_not_hold() -> None:
    term = at_knee(FreeTorquePosition)
    x = np.linspace(*term.ranges[0], 50)
    amounts = fitted(term, x, 0.2 + 0.0 * x)
    text = draft(Identified(STUDY, Model.of([term], amounts), ())).text().decode()
    assert (
        "Not in this file: free_torque (position) of knee: about 0.2 Nm everywhere: a law of every time step." in text
    )


@pytest.mark.parametrize(
    ("y", "words"),
    [
        (lambda x: 0.1 * x**2, "rises to 0.4 Nm at 2 rad"),
        (lambda x: 0.1 + 0.2 * x, "rises from 0.1 Nm at 0 rad to 0.5 Nm at 2 rad"),
        (lambda x: -0.2 * x, "falls to -0.4 Nm at 2 rad"),
        (lambda x: 0.3 + 0 * x, "about 0.3 Nm everywhere"),
        (lambda x: x * (2 - x), "from 0 Nm at 0 rad to 1 Nm at 1 rad, and back"),
    ],
)
def test_words_say_where_a_curve_goes(y: Callable[[np.ndarray], np.ndarray], words: str) -> None:
    x = np.linspace(0.0, 2.0, 101)
    assert curve_in_words(x, y(x), "rad", "Nm") == words


def uncertain(p: Parameter, std: float) -> Estimate:
    """A number of a curve, zero give or take its standard error."""
    bounds = (p.lower, p.upper)
    return Estimate(p.name, p.unit, 0.0, 0.0, std, (0.0, 0.0), bounds, "yes", at_bound=False, reason="")


def test_a_report_draws_the_curve_with_its_interval_at_every_point() -> None:
    term = at_knee(FreeTorqueTime)
    values = np.array([0.2, 0.1, *[0.0] * 6])
    known = [replace(uncertain(p, 0.01), value=v) for p, v in zip(term.parameters, values, strict=True)]
    (curve,) = curves_of(Model.of([term], values), known)
    np.testing.assert_allclose(curve.value, term.curve("knee", values, curve.x))
    size = 1.96 * 0.01 * np.sqrt(np.sum(term.modes_of("knee", curve.x) ** 2, axis=1))
    np.testing.assert_allclose(curve.high - curve.value, size)
    axes = plot_curves([curve])
    assert axes[0, 0].get_xlabel() == "time (s)"
    assert figure_of(axes) is not None


def test_numbers_that_err_together_make_a_curve_as_uncertain_as_their_sum() -> None:
    """A constant and a slope that err against each other: known where they cancel, doubly unknown where they add."""
    term = at_knee(FreeTorqueTime)
    rows = np.eye(8)
    rows[0, 1] = rows[1, 0] = -1.0
    known = [
        replace(uncertain(p, 0.01 * (i < 2)), correlation=tuple(row))
        for i, (p, row) in enumerate(zip(term.parameters, rows, strict=True))
    ]
    (curve,) = curves_of(Model.of([term], np.zeros(8)), known)
    first, second = term.modes_of("knee", curve.x)[:, :2].T
    np.testing.assert_allclose(curve.high, 1.96 * 0.01 * np.abs(first - second), atol=1e-12)
    assert curve.parameters == tuple(p.name for p in term.parameters)
    assert curves_of(Model.of([term], np.zeros(8)), ()) == ()


def test_numbers_of_a_curve_are_a_line_of_a_result_and_no_rows_of_its_table() -> None:
    term = at_knee(FreeTorqueTime)
    values = np.array([0.2, 0.1, *[0.0] * 6])
    names = [p.name for p in term.parameters]
    known = [
        Estimate(name, "Nm", 0.0, 0.0, 0.01, (0.0, 0.0), (-1.0, 1.0), "yes", at_bound=False, reason="")
        for name in ("mass:shank", *names)
    ]
    result = {
        "parameters": [e.to_dict() for e in known],
        "curves": [c.to_dict() for c in curves_of(Model.of([term], values), known)],
    }
    assert [p["name"] for p in tabled_estimates(result)] == ["mass:shank"]
    (line,) = curve_lines(result)
    assert line.startswith("knee: torque that changes slowly with time: ")


def test_position_of_the_toy_is_finite_under_every_form() -> None:
    for cls in FREE_FORMS:
        term = at_knee(cls)
        assert np.isfinite(moved(term, term.neutral + [p.scale for p in term.parameters])).all()
