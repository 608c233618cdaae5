"""Replay by segments where the base is fixed: robots that open loop does not hold."""

from __future__ import annotations

from dataclasses import astuple, replace
from functools import cache

import mujoco
import numpy as np
import pytest
from toys import PENDULUM, SCALE, pendulum, robot_from_xml, swing

from sysid_btr.diagnosis.close import close
from sysid_btr.diagnosis.leads import leading_hypotheses
from sysid_btr.diagnosis.selection import STANDARD
from sysid_btr.diagnosis.state import State
from sysid_btr.errors import LogError, UsageError
from sysid_btr.identify.episode import FixedEpisode
from sysid_btr.identify.fit import Fit, fit
from sysid_btr.identify.horizon import CURVED, is_held
from sysid_btr.identify.missing_torque import missing_torques
from sysid_btr.identify.mode import Mode
from sysid_btr.identify.refit import judge
from sysid_btr.identify.scores import score
from sysid_btr.identify.segmented import SegmentedEpisode, follow, measured_motion
from sysid_btr.identify.study import make_study
from sysid_btr.io.log import Log, LogMeta
from sysid_btr.io.split import held_out_all_over
from sysid_btr.models.robot import Robot
from sysid_btr.simulation.numerics import Numerics
from sysid_btr.simulation.replay import Replay
from sysid_btr.simulation.segments import SegmentReplay, Segments
from sysid_btr.terms.disturbance import DriveDisturbanceTrain, ExternalDisturbanceTrain
from sysid_btr.terms.effect import Effect
from sysid_btr.terms.free_form import FreeGainTime, FreeReadingPosition, FreeReadingTime, FreeTorquePeriodic
from sysid_btr.terms.friction import CoulombFriction, LoadFriction, ViscousDamping
from sysid_btr.terms.inertial import Armature, Payload
from sysid_btr.terms.model import Model
from sysid_btr.terms.sensing import (
    EncoderCyclicError,
    EncoderOffset,
    EncoderOffsetInLoop,
    EncoderScale,
    EncoderScaleInLoop,
    SensorDelay,
    TorqueScale,
)
from sysid_btr.terms.servo import CommandDelay
from sysid_btr.terms.spring import JointSpring

TWO = """<mujoco><worldbody>
<body name="upper"><joint name="shoulder" axis="0 1 0" armature=".002" {dry}/>
<inertial pos="0 0 -.2" mass="{upper}" diaginertia=".004 .004 .004"/>
<body name="lower" pos="0 0 -.2"><joint name="elbow" axis="0 1 0" armature=".002" {dry}/>
<inertial pos="0 0 -.2" mass=".5" diaginertia=".004 .004 .004"/></body></body></worldbody>
<actuator><motor name="shoulder" joint="shoulder"/><motor name="elbow" joint="elbow"/></actuator></mujoco>"""
JOINTS = ("shoulder", "elbow")
FRICTION, MASS = 0.08, 0.55
NOISE = 1e-3
WILD, QUIET = 0.7, 0.25
"""Nm, of torques that swing the arms round, and of such that do not."""


def double_pendulum(dry: str = "", upper: float = 0.5) -> Robot:
    """Two links that motors drive; as nominal without friction."""
    return robot_from_xml(TWO.format(dry=dry, upper=upper), "double")


# as stiff as the step allows: MuJoCo's own friction creeps
STIFF = 'solreffriction="0.001 1" solimpfriction="0.99 0.999 0.001 0.5 2"'
DRY = f'frictionloss="{FRICTION}" {STIFF}'


@cache
def driven(
    seed: int = 0,
    *,
    torque: float = WILD,
    seconds: float = 4.0,
    jitter: float = 0.0,
    dry: str = DRY,
    upper: float = MASS,
) -> Log:
    """A log of the double pendulum with dry friction at both joints and a heavier link, by MuJoCo alone."""
    rng = np.random.default_rng(seed)
    model = mujoco.MjModel.from_xml_string(TWO.format(dry=dry, upper=upper))
    model.opt.timestep, model.opt.integrator = 0.0005, mujoco.mjtIntegrator.mjINT_RK4
    data = mujoco.MjData(model)
    ticks, n = 10, round(seconds / 0.005)
    at = np.arange(n) * ticks + np.round(jitter * ticks * rng.uniform(size=n)).astype(int)
    frequency, phase = rng.uniform(0.3, 1.5, size=(2, 3, 2)), rng.uniform(0, 6, size=(3, 2))
    now = at * model.opt.timestep
    command = torque / 3 * np.sin(2 * np.pi * frequency[0] * now[:, None, None] + phase).sum(axis=1)
    position = np.empty((n, 2))
    for k in range(n):
        position[k] = data.qpos
        data.ctrl[:] = command[k]
        for _ in range(at[k + 1] - at[k] if k + 1 < n else 0):
            mujoco.mj_step(model, data)
    position += rng.normal(scale=NOISE, size=position.shape)
    channels = {
        f"{c}.{j}": x[:, i] for c, x in (("command", command), ("position", position)) for i, j in enumerate(JOINTS)
    }
    meta = LogMeta(robot="double", mount="fixed", source="simulated", extra={"drive": "torque"})
    return Log(time=now, channels=channels, meta=meta, episode=np.zeros(n, dtype=np.int64))


FREED = ["mass:*", "frictionloss:*"]
TRUTH = (MASS / 0.5, 1.0, FRICTION, FRICTION)


@cache
def fitted(seed: int = 0) -> Fit:
    return fit(make_study(double_pendulum(), [driven(seed)], numerics=Numerics("RK4", 0.0025), threads=1), FREED)


def test_torques_that_swing_a_double_pendulum_round_ask_for_segments() -> None:
    robot = double_pendulum()
    study = make_study(robot, [driven()], threads=1)
    assert all(isinstance(e, SegmentedEpisode) for e in (*study.train, *study.holdout))
    assert 0.2 < follow(robot, driven()) < 4.0
    facts = study.train[0].facts()
    assert facts is not None
    assert facts["mode"] == "segments"
    assert "can be followed for" in facts["why"]


@pytest.mark.parametrize("seed", [0, 3])
def test_torques_alone_drive_what_swings(seed: int) -> None:
    """Compared with those that the motion takes, they would make masses and friction too small, and sure of it."""
    log = driven(seed)
    torques = {name.replace("command.", "effort."): values for name, values in log.channels.items()}
    study = make_study(double_pendulum(), [replace(log, channels=torques)], threads=1)
    assert isinstance(study.train[0], SegmentedEpisode)
    assert "less than the inertia takes" in study.train[0].facts()["why"]
    found = fit(study, FREED)
    for estimate, truth in zip(found.estimates, TRUTH, strict=True):
        assert abs(estimate.value - truth) < 4 * estimate.std + 0.01 * truth
        assert estimate.value == pytest.approx(truth, rel=0.05)
    compared = fit(
        make_study(double_pendulum(), [replace(log, channels=torques)], mode=Mode("inverse"), threads=1), FREED
    )
    assert max(abs(e.value / truth - 1) for e, truth in zip(compared.estimates, TRUTH, strict=True)) > 0.2


def test_a_servo_takes_errors_back_so_that_the_log_is_replayed_whole() -> None:
    robot = pendulum()
    assert is_held(robot, swing())
    assert not is_held(double_pendulum(), driven())
    assert isinstance(make_study(robot, [swing()], threads=1).train[0], FixedEpisode)


def test_friction_and_masses_are_found_from_a_start_without_friction() -> None:
    """The frictionless pendulum goes its own way within seconds, and is survived."""
    found = fitted()
    for estimate, truth in zip(found.estimates, TRUTH, strict=True):
        assert estimate.identifiable == "yes"
        assert estimate.value == pytest.approx(truth, rel=0.05)
        assert abs(estimate.value - truth) < 4 * estimate.std + 0.01 * truth
    before, after = (s.holdout["position"] for s in (found.nominal, found.before))
    assert np.isfinite(before.chi2)
    assert after.rmse < 0.05 * before.rmse


def test_sizes_at_the_joints_are_those_of_the_motion_that_was_measured() -> None:
    study = make_study(double_pendulum(), [driven()], threads=1)
    tracks = measured_motion(double_pendulum(), driven())
    for i, joint in enumerate(JOINTS):
        scale = study.scales[joint]
        rms = float(np.sqrt(np.mean(tracks.velocity[:, i] ** 2)))
        assert 0.5 < scale.velocity_rms / rms < 2.0
        assert scale.acceleration_rms < 100 * scale.velocity_rms


def test_sizes_at_the_joints_are_finite_where_the_plain_model_diverges() -> None:
    stiff = robot_from_xml(PENDULUM.replace('kp="12.0"', 'kp="1e9"'))
    log = swing()
    log = replace(log, channels={**log.channels, "position.arm": 0.9 * log.channels["command.arm"]})
    study = make_study(stiff, [log], numerics=Numerics("RK4", 0.01), threads=1)
    replay = study.train[0].replay((), study.numerics)
    assert np.isnan(replay.predict(np.zeros((1, 0))).position).all()
    assert np.isfinite(astuple(study.scales["arm"])).all()
    assert study.scales["arm"].span == pytest.approx(np.ptp(log.channels["position.arm"]), rel=0.4)


def test_the_step_is_judged_on_segments_that_errors_do_not_outgrow() -> None:
    study = make_study(double_pendulum(), [driven()], threads=1)
    assert study.numerics.timestep >= 0.001


def test_a_clock_that_jitters_does_not_make_the_step_short() -> None:
    """A start between two borders of steps is an error of the start, which is integrated out."""
    log = driven(jitter=0.4)
    square = {f"command.{j}": 0.3 * np.sign(log.channels[f"command.{j}"]) for j in JOINTS}
    episode = SegmentedEpisode.whole(double_pendulum(), replace(log, channels=log.channels | square), 1, seconds=0.4)
    _, change = episode.choose_numerics(1)
    assert change <= 0.02


def test_friction_is_bounded_by_the_motion_where_the_motor_is_asked_for_nothing() -> None:
    log = driven(torque=QUIET, seconds=2.0)
    still = replace(log, channels=log.channels | {"command.elbow": np.zeros(len(log))})
    scales = make_study(double_pendulum(), [still], numerics=Numerics("RK4", 0.005), threads=1).scales
    assert scales["elbow"].counter_peak > FRICTION


def test_columns_count_in_a_scan_by_what_is_left_in_them_on_its_short_segments() -> None:
    """Sensors that show 0.8 of the torque must not hide the friction that both joints lack."""
    log = driven()
    rng = np.random.default_rng(1)
    shown = {f"effort.{j}": 0.8 * log.channels[f"command.{j}"] + rng.normal(scale=1e-3, size=len(log)) for j in JOINTS}
    with_effort = replace(log, channels=log.channels | shown)
    study = make_study(double_pendulum(), [with_effort], numerics=Numerics("RK4", 0.005), threads=1)
    state = State.of(fit(study, ["mass:*"]), None)
    found, _ = leading_hypotheses(state, (CoulombFriction, TorqueScale), STANDARD)
    gain = {effect: max(h.gain for h in found if h.effect is effect) for effect in (CoulombFriction, TorqueScale)}
    assert gain[CoulombFriction] > STANDARD.hopeless * gain[TorqueScale]


def test_what_is_missing_is_looked_for_before_masses_make_up_for_it() -> None:
    """Masses that are fitted without friction lie at their bounds, and amounts that are found there are far off."""
    unknown = replace(double_pendulum(), bounds={"mass": (0.3, 3.0)})
    study = make_study(unknown, [driven()], numerics=Numerics("RK4", 0.005), threads=1)
    state = State.of(fit(study, ["mass:*"]), None)
    assert state.fitted.model.values.max() > 2.0
    found, _ = leading_hypotheses(state, (CoulombFriction,), STANDARD)
    start = next(h.start for h in found if set(h.places) == set(JOINTS))
    assert start == pytest.approx(np.full_like(start, FRICTION), rel=0.35)


@pytest.mark.parametrize("torque", [QUIET, WILD])
def test_a_model_that_lacks_something_is_followed_until_its_error_is_half_of_the_motion(torque: float) -> None:
    log = driven(torque=torque)
    lacking, right = (follow(double_pendulum(dry), log) for dry in ("", f'frictionloss="{FRICTION}"'))
    assert lacking <= right
    study = make_study(double_pendulum(), [log], numerics=Numerics("RK4", 0.005), threads=1)
    error = score(study, Model.of(())).train["position"].rmse
    assert error < CURVED * float(np.hypot(*(log.channels[f"position.{j}"].std() for j in JOINTS)))


def test_friction_shortens_segments_of_a_quiet_log() -> None:
    log = driven(torque=QUIET)
    lacking, right = (follow(double_pendulum(dry), log) for dry in ("", f'frictionloss="{FRICTION}"'))
    assert lacking < 0.7 * right


def test_errors_over_the_whole_log_are_told_where_they_stay_bounded() -> None:
    """Without friction the arms go their own way; with it they can be followed to the end."""
    log = driven(torque=QUIET, seconds=3.0)
    study = make_study(double_pendulum(), [log], numerics=Numerics("RK4", 0.005), mode=Mode("segments", "0.5"))
    terms = study.declare(FREED)
    assert score(study, Model.of(terms, np.array([1.0, 1.0, 0.0, 0.0]))).whole == {}
    right = Model.of(terms, np.array(TRUTH))
    whole = score(study, right).to_dict()["whole"]["position"]
    replay = FixedEpisode.whole(study.robot, log).compare(terms, ("position",), study.numerics)
    error = replay.errors(replay.replay.predict(right.values[None]))[0]
    assert whole["rmse"] == pytest.approx(float(np.sqrt(np.nanmean(error**2))))


def test_where_open_loop_holds_segments_give_the_same_answer() -> None:
    """Below the friction that holds it at its lower end, the pendulum forgets its start."""
    robot = double_pendulum(dry=f'damping="{FRICTION}"')
    log = driven(torque=QUIET, seconds=2.5)
    whole, cut = (
        fit(
            make_study(robot, [log], numerics=Numerics("RK4", 0.005), threads=1, mode=Mode(segments=s)), FREED
        ).estimates
        for s in ("whole", "0.8")
    )
    for a, b in zip(whole, cut, strict=True):
        assert abs(a.value - b.value) < 4 * np.hypot(a.std, b.std) + 0.01 * abs(a.value)


@pytest.mark.parametrize("jitter", [0.0, 0.4])
def test_segments_from_the_states_of_a_whole_replay_give_that_replay(jitter: float) -> None:
    """Commands from long before a segment reach into it, pushes and laws keep the log's time, and clocks that jitter
    share a batch."""
    robot, log = double_pendulum(dry='damping=".05"'), driven(jitter=jitter, seconds=2.0, torque=QUIET)
    scales = dict.fromkeys(JOINTS, replace(SCALE, seconds=2.0))
    late = CommandDelay(("shoulder",))
    fading = FreeGainTime.at(("elbow",), scales)
    late = replace(late, known=tuple(replace(p, upper=0.6) for p in late.parameters))
    pushed, jolting = ExternalDisturbanceTrain(("elbow",)), DriveDisturbanceTrain(("shoulder",))
    terms, numerics = (late, pushed, jolting, fading), Numerics("RK4", 0.0025)
    gain = np.linspace(0.2, 0.05, len(fading.parameters))
    pulses = ((0.1, 0.05, 0.06, 0.31), (-0.2, 0.25, 0.1, 0.7))
    values = np.array([[0.4, *pulses[0], *pulses[1], *gain], [0.113, *pulses[1], *pulses[0], *-gain]])
    whole = Replay(robot, log, terms, numerics).predict(values)
    rows = np.array([[120, 220], [220, 321], [321, 399]])
    for k, value in enumerate(values):
        first = rows[:, 0]
        rate = np.gradient(whole.velocity[k], log.time, axis=0)[first]
        starts = Segments(rows, whole.position[k, first], whole.velocity[k, first], np.ones((3, 4)), None, rate)
        segments = SegmentReplay(robot, log, terms, numerics, segments=starts).predict(values)
        np.testing.assert_allclose(segments.position[k, 120:399], whole.position[k, 120:399], atol=2e-4)
        alone = SegmentReplay(robot, log, terms, numerics, segments=starts.chosen(np.array([1]))).predict(value[None])
        assert np.array_equal(alone.position[0, 220:321], segments.position[k, 220:321])


def test_where_a_clock_puts_the_start_of_a_segment_costs_no_accuracy() -> None:
    """Samples lie anywhere between the borders of a log's own steps; those of a segment begin with its first sample."""
    robot, log = double_pendulum(dry='damping=".05"'), driven(jitter=0.4, seconds=2.0, torque=QUIET)
    exact = Replay(robot, log, (), Numerics("RK4", 0.0003125)).predict(np.zeros((1, 0)))
    rows = np.array([[k, k + 40] for k in range(100, 380, 40)])
    first = rows[:, 0]
    starts = Segments(rows, exact.position[0, first], exact.velocity[0, first], np.ones((len(rows), 4)))
    fine, coarse = (
        SegmentReplay(robot, log, (), Numerics("RK4", step), segments=starts).predict(np.zeros((1, 0)))
        for step in (0.0025, 0.005)
    )
    worst = [float(np.abs(p.position - exact.position)[0, 100:380].max()) for p in (fine, coarse)]
    moved = float(np.ptp(exact.position[0, 100:380], axis=0).max())
    assert worst[1] < 1e-4 * moved, worst
    assert worst[0] < worst[1], worst


READERS = {
    EncoderOffset: (0.04,),
    EncoderOffsetInLoop: (-0.04,),
    EncoderScale: (0.1,),
    EncoderScaleInLoop: (-0.05,),
    EncoderCyclicError: (0.02, -0.01, 5.0),
    SensorDelay: (0.012,),
    FreeReadingTime: (0.03, 0.02, 0.01),
    FreeReadingPosition: (0.02, 0.02, 0.01),
}


@pytest.mark.parametrize("effect", READERS)
def test_a_segment_starts_where_the_joint_is_and_not_where_its_sensor_says(effect: type[Effect]) -> None:
    """... and a sensor's error keeps the log's time: segments show what the whole replay shows."""
    robot, log = double_pendulum(dry='damping=".05"'), driven(seconds=2.0, torque=QUIET)
    term = effect.at(("shoulder",), dict.fromkeys(JOINTS, replace(SCALE, seconds=2.0)))
    values = term.neutral.copy()
    values[: len(READERS[effect])] = READERS[effect]
    numerics = Numerics("RK4", 0.0025)
    whole = Replay(robot, log, (term,), numerics).predict(values[None])
    rows = np.array([[120, 220], [220, 321], [321, 399]])
    first, shown = rows[:, 0], whole.position[0]
    velocity = np.gradient(shown, log.time, axis=0)
    rate = np.gradient(velocity, log.time, axis=0)
    starts = Segments(rows, shown[first], velocity[first], np.ones((3, 4)), None, rate[first])
    segments = SegmentReplay(robot, log, (term,), numerics, segments=starts).predict(values[None])
    np.testing.assert_allclose(segments.position[0, 120:399], shown[120:399], atol=2e-3)
    plain = Replay(robot, log, (), numerics).predict(np.zeros((1, 0)))
    assert np.abs(plain.position - whole.position)[0, 120:399].max() > 5e-3, "an error that shows"


def test_the_right_model_leaves_noise_alone_however_long_a_robot_remembers_its_start() -> None:
    """Damped arms can be followed to the end of the log, and what is unknown of a start lasts for seconds."""
    damped = 'damping=".02"'
    log = driven(torque=QUIET, dry=damped, upper=0.5)
    study = make_study(double_pendulum(damped), [log], numerics=Numerics("RK4", 0.005), threads=1)
    scores = score(study, Model.of(()))
    for part in (scores.train, scores.holdout):
        assert part["position"].chi2 == pytest.approx(1.0, abs=0.15)


def test_scores_do_not_depend_on_how_large_the_noise_is_taken_to_be() -> None:
    """Starts that a wrong model moved away are taken back by what is known of them, not by less."""
    damped = 'damping=".02"'
    log = driven(torque=QUIET, dry=damped, upper=0.5)
    plain = make_study(double_pendulum(damped), [log], numerics=Numerics("RK4", 0.005), threads=1)
    doubtful = replace(plain, inflation={("fixed", "position", joint): 100.0 for joint in JOINTS})
    model = Model.of(())
    assert score(doubtful, model).train["position"].chi2 == score(plain, model).train["position"].chi2
    assert judge(doubtful, model).train == judge(plain, model).train


def test_the_torque_at_the_last_sample_of_a_segment_is_that_of_its_own_command() -> None:
    robot, log = double_pendulum(), driven(seconds=1.0)
    rows, still = np.array([[0, 90], [90, 150], [150, 200]]), np.zeros((3, 2))
    segments = Segments(rows, still, still, np.ones((3, 4)))
    seen = SegmentReplay(robot, log, (), Numerics("RK4", 0.005), effort=True, segments=segments).predict(
        np.zeros((1, 0))
    )
    assert seen.effort is not None
    wanted = np.column_stack([log.channels[f"command.{j}"] for j in JOINTS])
    # what is commanded at the last sample of a log is not replayed
    np.testing.assert_allclose(seen.effort[0, :-1], wanted[:-1], atol=1e-12)


def test_segments_tile_what_is_fitted_and_what_is_held_out() -> None:
    log = driven()
    fitted_part, held = SegmentedEpisode.split(double_pendulum(), log, 0.3, seconds=0.4)
    rows = np.concatenate([fitted_part.segments.rows, held.segments.rows])
    assert rows[0, 0] == 0
    assert rows[-1, 1] == len(log)
    assert np.array_equal(rows[1:, 0], rows[:-1, 1])
    assert np.array_equal(fitted_part.compared, fitted_part.scored[: len(fitted_part.log)])
    assert not (fitted_part.scored & held.scored).any()


def test_segments_go_on_through_what_is_held_out_between() -> None:
    log = driven()
    fitted_part, held = SegmentedEpisode.split(double_pendulum(), log, 0.3, seconds=0.4)
    scored = held_out_all_over(log.time, 0.3, 8)
    for part, own in ((fitted_part.scoring(~scored), ~scored), (held.scoring(scored), scored)):
        rows, counted = part.segments.rows, np.flatnonzero(own)
        assert (rows[0, 0], rows[-1, 1]) == (counted[0], counted[-1] + 1)
        assert np.array_equal(rows[1:, 0], rows[:-1, 1])
        assert np.array_equal(part.compared, own[: len(part.log)])
        assert np.diff(rows) == pytest.approx(0.4 / np.median(np.diff(log.time)), rel=0.2)


def test_a_joint_that_is_not_logged_starts_where_the_model_has_it() -> None:
    log = driven()
    channels = {n: x for n, x in log.channels.items() if n != "position.elbow"}
    tracks = measured_motion(double_pendulum(), replace(log, channels=channels))
    assert not tracks.position[:, 1].any()
    assert not tracks.position_std[:, 1].any()
    none = {n: x for n, x in log.channels.items() if not n.startswith("position.")}
    with pytest.raises(LogError, match="measured positions"):
        measured_motion(double_pendulum(), replace(log, channels=none))


@pytest.mark.parametrize(
    ("name", "segments", "words"),
    [
        ("auto", "0", "a length in s"),
        ("auto", "some", "a length in s"),
        ("inverse", "0.5", "does not go with"),
        ("segments", "whole", "does not go with"),
    ],
)
def test_what_segments_can_be(name: str, segments: str, words: str) -> None:
    with pytest.raises(UsageError, match=words):
        Mode(name, segments)


@pytest.mark.parametrize("mode", ["segments", "inverse"])
def test_friction_that_is_missing_acts_against_the_motion_and_known_friction_leaves_nothing(mode: str) -> None:
    """What motors give is compared with what the motion takes, whether segments or torques are compared."""
    log, rng = driven(torque=QUIET, seconds=8.0), np.random.default_rng(1)
    efforts = {f"effort.{j}": log.channels[f"command.{j}"] + rng.normal(scale=1e-3, size=len(log)) for j in JOINTS}
    log = replace(log, channels={**log.channels, **(efforts if mode == "inverse" else {})})
    study = make_study(double_pendulum(upper=MASS), [log], numerics=Numerics("RK4", 0.0025), threads=1, mode=Mode(mode))
    dry = CoulombFriction.at(JOINTS, study.scales)

    def levels(model: Model) -> dict[str, float]:
        found = missing_torques(study.train_problem(model), model.values, study.scales)
        return {one.joint: -float(np.mean(one.torque * one.direction)) for one in found}

    missing, known = levels(Model.of(())), levels(Model.of((dry,)).at(np.array([FRICTION, FRICTION])))
    for joint in JOINTS:
        assert missing[joint] == pytest.approx(FRICTION, rel=0.2)
        assert abs(known[joint]) < 0.1 * FRICTION


HIDDEN = (
    (CoulombFriction(("elbow",)), (0.02,)),
    (ViscousDamping(("elbow",)), (0.02,)),
    (JointSpring(("elbow",)), (0.1, 0.3)),
    (Armature(("elbow",)), (0.004,)),
    (LoadFriction(("elbow",)), (0.2,)),
    (Payload(("lower",)), (0.05, 0.02, 0.0, -0.1, 1e-5)),
    (CommandDelay(("elbow",)), (0.02,)),
    (ExternalDisturbanceTrain(("elbow",)), (0.1, 0.3, 0.2, 0.9)),
)
HEAVIER, LIGHTER = 1.15, 0.9


def test_intervals_over_segments_hold_the_truth_although_an_effect_is_missing() -> None:
    """95 % of intervals should; of those that take the model as right, fewer do."""
    robot, numerics, wide, narrow = double_pendulum('damping=".02"'), Numerics("RK4", 0.005), [], []
    for seed, (effect, amounts) in enumerate(HIDDEN):
        log, rng = driven(seed, torque=QUIET, seconds=8.0, dry='damping=".02"', upper=0.5), np.random.default_rng(seed)
        declared = make_study(robot, [log], numerics=numerics, threads=1).declare(["mass:upper", "mass:lower"])
        terms, values = (*declared, effect), np.array([[HEAVIER, LIGHTER, *amounts]])
        moved = Replay(robot, log, terms, Numerics("RK4", 0.0025)).predict(values).position[0]
        noisy = moved + rng.normal(scale=NOISE, size=moved.shape)
        shown = {f"position.{j}": x for j, x in zip(JOINTS, noisy.T, strict=True)}
        log = replace(log, channels={**log.channels, **shown})
        found = fit(make_study(robot, [log], numerics=numerics, threads=1), ["mass:upper", "mass:lower"])
        for one, truth in zip(found.estimates, (HEAVIER, LIGHTER), strict=True):
            wide.append(one.ci95[0] <= truth <= one.ci95[1])
            narrow.append(abs(one.value - truth) <= 2.0 * (one.std_if_right or one.std))
    assert np.mean(wide) >= 0.9
    assert np.mean(narrow) < np.mean(wide)


def test_an_encoder_that_drifts_is_named_where_motors_drive() -> None:
    robot, rng = double_pendulum('damping=".02"'), np.random.default_rng(5)
    log = driven(3, torque=QUIET, seconds=8.0, dry='damping=".02"', upper=0.5)
    moved = np.column_stack([log.channels[f"position.{j}"] for j in JOINTS])
    moved[:, 0] += 0.05 * -np.expm1(-log.time / 4.0)
    shown = {
        f"position.{j}": x for j, x in zip(JOINTS, (moved + rng.normal(scale=NOISE, size=moved.shape)).T, strict=True)
    }
    found = close(make_study(robot, [replace(log, channels={**log.channels, **shown})], threads=1), ["mass:*"])
    (effect,) = found.effects
    assert (effect.effect, effect.variant, effect.where) == ("free_reading", "time", ("shoulder",))
    assert effect.certainty > 0.5
    assert found.after.train["position"].chi2 < 1.2
    for estimate in found.parameters[:2]:
        assert abs(estimate.value - 1.0) < 4 * estimate.std + 0.01


def test_a_wave_from_outside_is_named_where_motors_drive_and_nothing_where_there_is_none() -> None:
    robot, rng = double_pendulum('damping=".02"'), np.random.default_rng(3)
    log = driven(3, torque=QUIET, seconds=8.0, dry='damping=".02"', upper=0.5)
    scales = make_study(robot, [log], numerics=Numerics("RK4", 0.005), threads=1).scales
    wave = FreeTorquePeriodic.at(("elbow",), scales)
    numbers = np.zeros(len(wave.kinds))
    for size, named in ((0.0, ()), (0.05, ("free_torque",))):
        numbers[0], numbers[-1] = size, 2.3
        moved = Replay(robot, log, (wave,), Numerics("RK4", 0.0025)).predict(numbers[None]).position[0]
        noisy = moved + rng.normal(scale=NOISE, size=moved.shape)
        shown = {f"position.{j}": x for j, x in zip(JOINTS, noisy.T, strict=True)}
        study = make_study(robot, [replace(log, channels={**log.channels, **shown})], threads=1)
        found = close(study, ["mass:*"])
        assert tuple(e.effect for e in found.effects) == named
    (effect,) = found.effects
    assert effect.where == ("elbow",)
    assert found.verdict == "explained"
    assert effect.parameters[-1].value == pytest.approx(2.3, abs=0.02)
