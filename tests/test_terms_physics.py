"""Effects against closed forms, independent models and small simulations of their own."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import brentq
from toys import (
    ARMATURE,
    DAMPING,
    FINE,
    GRAVITY,
    INERTIA,
    KP,
    KV,
    LEG_JOINTS,
    LENGTH,
    MASS,
    PENDULUM,
    SCALE,
    TOTAL_INERTIA,
    held,
    leg,
    make_log,
    pendulum,
    position,
    robot_from_xml,
    run,
    swing,
    with_spec,
)

from sysid_btr.models.robot import Robot
from sysid_btr.simulation.numerics import Numerics
from sysid_btr.terms.contact import FootCompliance, FootFriction
from sysid_btr.terms.disturbance import ConstantForce, ExternalDisturbance
from sysid_btr.terms.effect import Effect
from sysid_btr.terms.friction import (
    CoulombFriction,
    LoadFriction,
    LoadFrictionLarger,
    LoadFrictionPower,
    LoadFrictionStribeck,
    PreslidingFriction,
    QuadraticDamping,
    StribeckFriction,
    ViscousDamping,
)
from sysid_btr.terms.grammar import parse_parameters
from sysid_btr.terms.inertial import Armature, ComOffset, GravityTilt, Payload
from sysid_btr.terms.limits import SlewLimit, SpeedTorqueLimit, TorqueLimit, TorqueLimitSoft
from sysid_btr.terms.power import ThermalDerating, VoltageSag, VoltageSagLoad, VoltageSagLoadStiffness
from sysid_btr.terms.sensing import (
    EncoderCyclicError,
    EncoderOffset,
    EncoderOffsetInLoop,
    EncoderScale,
    EncoderScaleInLoop,
    SensorDelay,
    TorqueOffset,
    TorqueScale,
)
from sysid_btr.terms.servo import BackEmf, CommandDelay, CommandDelaySampled, IntegralGain, sampled
from sysid_btr.terms.spring import JointSpring, JointStop, JointStopBelow, Tether
from sysid_btr.terms.transmission import Backlash, BacklashMotor, Cogging, JointCompliance, JointComplianceMotor

SCALES = {"arm": SCALE}
MGL = MASS * GRAVITY * LENGTH
COMMAND = 0.6


def at_arm(effect: type[Effect]) -> Effect:
    return effect.at(("robot" if effect.scope == "robot" else "arm",), SCALES)


def rest(effect: type[Effect], values: Any, command: float = COMMAND, seconds: float = 4.0) -> float:
    """Measured position in which the pendulum settles under a held command."""
    return float(position(pendulum(), held(command, seconds), [at_arm(effect)], values)[-1, 0])


def gravity(q: float) -> float:
    """Torque of the weight against the motion."""
    return MGL * np.sin(q)


def solve(balance: Any) -> float:
    return float(brentq(balance, -1.5, 1.5, xtol=1e-13))


def loose() -> Robot:
    """A free rotor: no servo, no weight, no damping."""

    def edit(spec: Any) -> None:
        spec.option.gravity = [0, 0, 0]
        spec.joint("arm").damping = [0, 0, 0]
        spec.delete(spec.actuators[0])

    return with_spec(pendulum(), edit)


# --- delays and encoders --------------------------------------------------------------------------------


@pytest.mark.parametrize("samples", [1, 3, 7])
@pytest.mark.parametrize("effect", [CommandDelay, SensorDelay])
def test_a_delay_of_whole_samples_is_an_exact_shift(effect: type[Effect], samples: int) -> None:
    log = swing(seconds=1.5)
    late = position(pendulum(), log, [at_arm(effect)], [samples * 0.01])
    plain = position(pendulum(), log)
    np.testing.assert_allclose(late[samples:], plain[:-samples], rtol=0, atol=1e-10)
    np.testing.assert_allclose(late[:samples], 0, atol=1e-10)


@pytest.mark.parametrize("effect", [CommandDelay, SensorDelay])
def test_a_delay_between_samples_lies_between_the_shifts(effect: type[Effect]) -> None:
    """Against a replay of finer steps and samples, shifted by whole ones."""
    log = swing(seconds=1.5)
    late = position(pendulum(), log, [at_arm(effect)], [0.0137])
    tenth = Numerics("RK4", 0.0001)
    fine_time = np.arange(15001) * 1e-4
    command = log.channels["command.arm"][np.minimum((fine_time + 1e-9) // 0.01, 150).astype(int)]
    fine = position(pendulum(), make_log(fine_time, {"command.arm": command}), numerics=tenth)[:, 0]
    wanted = np.interp(log.time - 0.0137, fine_time, fine, left=0.0)
    assert np.abs(late[:, 0] - wanted).max() < 2e-4
    assert np.abs(position(pendulum(), log)[:, 0] - wanted).max() > 1e-2


def test_a_command_delay_leaves_a_push_where_it_is() -> None:
    push = at_arm(ExternalDisturbance)
    both = position(pendulum(), held(), [at_arm(CommandDelay), push], [0.05, 0.5, 0.2, 0.1])
    np.testing.assert_array_equal(both, position(pendulum(), held(), [push], [0.5, 0.2, 0.1]))


def test_commands_taken_at_intervals_are_those_of_a_log_that_holds_them() -> None:
    """At 7, 57, 107, .. ms: between samples of the log, and between steps of the replay."""
    log = swing(seconds=1.5)
    taken = position(pendulum(), log, [at_arm(CommandDelaySampled)], [0.05, 0.007], numerics=Numerics("RK4", 0.002))
    time = np.arange(1501) * 1e-3
    moment = np.maximum(0.007 + np.floor((time - 0.007) / 0.05 + 1e-9) * 0.05, 0.0)
    command = log.channels["command.arm"][np.floor(moment / 0.01 + 1e-9).astype(int)]
    wanted = position(pendulum(), make_log(time, {"command.arm": command}))[::10]
    assert np.abs(taken - wanted).max() < 1e-4
    assert np.abs(position(pendulum(), log) - wanted).max() > 1e-2


@given(period=st.floats(0.012, 0.19), phase=st.floats(0.0, 1.0), lead=st.integers(0, 40))
def test_what_was_commanded_before_a_replay_begins_is_taken_as_if_it_had_begun_then(
    period: float, phase: float, lead: int
) -> None:
    time = np.arange(401) * 0.005
    command = np.sin(7 * time[:-1])[None]
    whole = sampled(command, time[None], period, phase * period)
    late = sampled(command[:, 100 - lead :], time[None, 100 - lead :], period, phase * period)
    settled = lead + 2 * int(period / 0.005)
    np.testing.assert_allclose(late[:, settled:], whole[:, 100 - lead + settled :], atol=1e-12)


def test_an_encoder_offset_in_the_log_shifts_what_is_seen_and_nothing_else() -> None:
    log = swing()
    np.testing.assert_allclose(
        position(pendulum(), log, [at_arm(EncoderOffset)], [0.03]), position(pendulum(), log) + 0.03
    )


def test_an_encoder_offset_in_the_loop_acts_through_gravity() -> None:
    q = solve(lambda q: KP * (COMMAND - 0.1 - q) - gravity(q))
    assert rest(EncoderOffsetInLoop, [0.1]) == pytest.approx(q + 0.1, abs=1e-9)
    weightless = with_spec(pendulum(), lambda s: setattr(s.option, "gravity", [0, 0, 0]))
    log = swing()
    seen = position(weightless, log, [at_arm(EncoderOffsetInLoop)], [0.1])
    np.testing.assert_allclose(
        seen, position(weightless, log, [], numerics=FINE) + _settling(weightless, 0.1), atol=1e-9
    )


def _settling(robot: Robot, offset: float) -> Any:
    """Start-up of a joint whose encoder shows `offset` less than it is told to be at; linear, so additive."""
    log = held(0.0)
    return position(robot, log, [at_arm(EncoderOffsetInLoop)], [offset]) - position(robot, log)


def test_an_encoder_scale_multiplies_what_is_seen_or_closes_the_loop() -> None:
    log = swing()
    np.testing.assert_allclose(
        position(pendulum(), log, [at_arm(EncoderScale)], [0.07]), 1.07 * position(pendulum(), log)
    )
    q = solve(lambda q: KP * (COMMAND - 1.07 * q) - gravity(q))
    assert rest(EncoderScaleInLoop, [0.07]) == pytest.approx(1.07 * q, abs=1e-9)


@pytest.mark.parametrize(
    ("effect", "value", "seen"), [(TorqueOffset, 0.4, (1.0, 0.4)), (TorqueScale, -0.1, (0.9, 0.0))]
)
def test_a_torque_sensor_changes_what_is_seen_of_the_torque_and_no_motion(
    effect: type[Effect], value: float, seen: tuple[float, float]
) -> None:
    log = swing()
    plain, changed = run(pendulum(), log, effort=True), run(pendulum(), log, [at_arm(effect)], [value], effort=True)
    assert plain.effort is not None
    assert changed.effort is not None
    np.testing.assert_array_equal(changed.position, plain.position)
    np.testing.assert_allclose(changed.effort, seen[0] * plain.effort + seen[1], rtol=0, atol=1e-12)


# --- constant and position-dependent torques ------------------------------------------------------------


def test_a_constant_force_moves_the_rest() -> None:
    for torque in (-0.5, 0.7):
        q = solve(lambda q, t=torque: KP * (COMMAND - q) + t - gravity(q))
        assert rest(ConstantForce, [torque]) == pytest.approx(q, abs=1e-9)


def test_a_spring_pulls_to_its_rest_angle() -> None:
    q = solve(lambda q: KP * (COMMAND - q) - gravity(q) - 2.0 * (q - 0.2))
    assert rest(JointSpring, [2.0, 0.2]) == pytest.approx(q, abs=1e-9)


def test_springs_add_up_with_the_models_own() -> None:
    sprung = with_spec(pendulum(), lambda s: setattr(s.joint("arm"), "stiffness", [1.5, 0, 0]))
    q = solve(lambda q: KP * (COMMAND - q) - gravity(q) - 1.5 * q - 2.0 * (q - 0.2))
    seen = position(sprung, held(COMMAND, 4.0), [at_arm(JointSpring)], [2.0, 0.2])[-1, 0]
    assert seen == pytest.approx(q, abs=1e-9)


@pytest.mark.parametrize(
    ("pull", "stiffness", "distance", "point"),
    [
        ((2.0, 0.0, 1.0), 8.0, 0.5, (0.03, 0.02)),
        ((-1.5, 0.4, 0.0), 0.0, 0.3, (0.0, 0.0)),
        ((0.6, 0.0, 0.0), 40.0, 0.4, (0.0, 0.0)),
    ],
)
def test_a_tether_pulls_a_point_towards_another_and_never_pushes(
    pull: tuple[float, ...], stiffness: float, distance: float, point: tuple[float, float]
) -> None:
    x, z = point[0], point[1] - LENGTH
    tension = float(np.linalg.norm(pull))
    to = distance * np.array(pull) / tension
    anchor = np.array([x, 0.0, z]) + to

    def torque(q: float) -> float:
        held = np.array([x * np.cos(q) + z * np.sin(q), 0.0, z * np.cos(q) - x * np.sin(q)])
        cord = anchor - held
        long = float(np.linalg.norm(cord))
        # one that does not grow is a band so soft that it grows by a thousandth over its length
        growth = max(stiffness, 1e-3 * tension / distance)
        now = max(tension + growth * (long - distance), 0.0)
        return now * float(held[2] * cord[0] - held[0] * cord[2]) / long

    for command in (-0.6, COMMAND):
        q = solve(lambda q, command=command: KP * (command - q) - gravity(q) + torque(q))
        assert rest(Tether, [tension, stiffness, *to, point[0], 0.0, point[1]], command) == pytest.approx(q, abs=1e-6)


@pytest.mark.parametrize(("stop", "way"), [(JointStop, 1.0), (JointStopBelow, -1.0)])
def test_a_soft_stop_pushes_back_beyond_its_onset_and_nowhere_else(stop: type[Effect], way: float) -> None:
    q = solve(lambda q: KP * (way * COMMAND - q) - gravity(q) - 2.0 * (q - way * 0.2))
    assert rest(stop, [2.0, way * 0.2], command=way * COMMAND) == pytest.approx(q, abs=1e-9)
    free = rest(JointSpring, [0.0, 0.0], command=-way * COMMAND)
    assert rest(stop, [2.0, way * 0.2], command=-way * COMMAND) == pytest.approx(free, abs=1e-9)


def test_cogging_is_a_sine_and_a_cosine_of_the_angle() -> None:
    def balance(q: float) -> float:
        return KP * (COMMAND - q) - gravity(q) + 0.15 * np.sin(20 * q) - 0.1 * np.cos(20 * q)

    q = rest(Cogging, [0.15, -0.1, 20.0])
    assert balance(q) == pytest.approx(0, abs=1e-7)
    assert abs(q - solve(lambda q: KP * (COMMAND - q) - gravity(q))) > 1e-3


def test_a_cyclic_error_is_in_what_the_log_shows_alone() -> None:
    log = swing(seconds=1.0)
    plain = run(pendulum(), log, (), [])
    seen = run(pendulum(), log, [at_arm(EncoderCyclicError)], [0.02, -0.01, 9.0])
    q, v = plain.position, plain.velocity
    np.testing.assert_allclose(seen.position, q + 0.02 * np.sin(9 * q) - 0.01 * np.cos(9 * q), atol=1e-12)
    np.testing.assert_allclose(seen.velocity, v * (1 + 9 * (0.02 * np.cos(9 * q) + 0.01 * np.sin(9 * q))), atol=1e-12)


@pytest.mark.parametrize(("x", "y"), [(0.0, 0.2), (0.25, 0.0), (-0.1, 0.15)])
def test_a_tilt_turns_gravity(x: float, y: float) -> None:
    q = solve(lambda q: KP * (COMMAND - q) - MGL * np.cos(x) * np.sin(q - y))
    assert rest(GravityTilt, [x, y]) == pytest.approx(q, abs=1e-9)


def test_a_push_gives_its_impulse_wherever_it_falls_between_steps() -> None:
    for start, duration in ((0.1, 0.05), (0.1033, 0.0041), (0.30001, 0.0007)):
        outputs = run(loose(), held(), [at_arm(ExternalDisturbance)], [0.8, start, duration])
        assert outputs.velocity[0, -1, 0] == pytest.approx(0.8 * duration / TOTAL_INERTIA, rel=1e-9)
        before = outputs.time < start - FINE.timestep
        assert not outputs.velocity[0, before].any()


# --- inertias -------------------------------------------------------------------------------------------


def test_armature_is_inertia_without_weight() -> None:
    push = at_arm(ExternalDisturbance)
    outputs = run(loose(), held(), [at_arm(Armature), push], [0.02, 0.8, 0.1, 0.05])
    assert outputs.velocity[0, -1, 0] == pytest.approx(0.8 * 0.05 / (TOTAL_INERTIA + 0.02), rel=1e-9)
    assert rest(Armature, [0.02], seconds=6.0) == pytest.approx(rest(Armature, [0.0], seconds=6.0), abs=1e-8)


@pytest.mark.parametrize("own", [0.0, 3e-4])
def test_a_payload_is_a_body_that_is_fixed_to_the_link(own: float) -> None:
    where = (0.03, -0.02, -0.08)

    def load(spec: Any) -> None:
        body = spec.body("knee").add_body(name="load", pos=where)
        body.explicitinertial = True
        body.mass = 0.18
        body.ipos = [0.0, 0.0, 0.0]
        body.inertia = [max(own, 1e-12)] * 3

    log = swing(LEG_JOINTS, seconds=0.8)
    effect = Payload.at(("knee",), dict.fromkeys(LEG_JOINTS, SCALE))
    np.testing.assert_allclose(
        position(leg(), log, [effect], [0.18, *where, own]), position(with_spec(leg(), load), log), atol=1e-9
    )


def test_a_payload_hangs_at_its_lever() -> None:
    q = solve(lambda q: KP * (COMMAND - q) - gravity(q) - 0.2 * GRAVITY * (0.15 * np.sin(q) - 0.05 * np.cos(q)))
    assert rest(Payload, [0.2, 0.05, 0.0, -0.15, 0.0], seconds=6.0) == pytest.approx(q, abs=1e-8)


def test_a_shifted_centre_of_mass_changes_the_lever() -> None:
    def balance(q: float) -> float:
        return KP * (COMMAND - q) - MASS * GRAVITY * ((LENGTH + 0.02) * np.sin(q) - 0.03 * np.cos(q))

    assert rest(ComOffset, [0.03, 0.0, -0.02]) == pytest.approx(solve(balance), abs=1e-9)


# --- friction and damping -------------------------------------------------------------------------------


def test_dry_friction_holds_up_to_its_torque_and_no_further() -> None:
    friction = 0.3
    for share, moves in ((0.9, False), (1.3, True)):
        command = share * friction / KP
        q = rest(CoulombFriction, [friction], command)
        assert (abs(q) > 0.1 * command) is moves


def test_dry_friction_stops_a_free_rotor_when_its_impulse_is_used_up() -> None:
    """v(t) = v0 - F t / J, then rest."""
    robot, log = loose(), make_log(np.arange(201) * 0.01, {})
    start = parse_parameters(["qvel0:arm"], robot)
    outputs = run(robot, log, [*start, at_arm(CoulombFriction)], [2.0, 0.05], Numerics("RK4", 0.001))
    time = np.arange(201) * 0.01
    wanted = np.maximum(2.0 - 0.05 * time / TOTAL_INERTIA, 0.0)
    np.testing.assert_allclose(outputs.velocity[0, :, 0], wanted, atol=0.01)


@pytest.mark.parametrize("speed", [2.0, 2.03, 2.07])
def test_dry_friction_turns_round_with_the_joint(speed: float) -> None:
    """Slower under friction and torque, then faster under their difference; a third of a step too early at most."""
    friction, torque, step = 0.05, -0.1, 0.005
    robot, log = loose(), make_log(np.arange(201) * 0.01, {})
    terms = [*parse_parameters(["qvel0:arm"], robot), at_arm(CoulombFriction), at_arm(ConstantForce)]
    outputs = run(robot, log, terms, [speed, friction, torque], Numerics("RK4", step))
    slower, faster = (torque - friction) / TOTAL_INERTIA, (torque + friction) / TOTAL_INERTIA
    left = np.arange(201) * 0.01 - speed / -slower
    wanted = np.where(left < 0, slower, faster) * left
    # what friction does otherwise until then: it has the other sign
    early = 2 * friction / TOTAL_INERTIA * step / 3
    np.testing.assert_allclose(outputs.velocity[0, left > 0.05, 0], wanted[left > 0.05], atol=early)


def test_viscous_damping_decays_a_free_rotor_exponentially() -> None:
    robot, log = loose(), make_log(np.arange(201) * 0.01, {})
    start = parse_parameters(["qvel0:arm"], robot)
    outputs = run(robot, log, [*start, at_arm(ViscousDamping)], [2.0, 0.06])
    wanted = 2.0 * np.exp(-0.06 / TOTAL_INERTIA * np.arange(201) * 0.01)
    np.testing.assert_allclose(outputs.velocity[0, :, 0], wanted, rtol=1e-6)


def test_quadratic_damping_decays_a_free_rotor_as_one_over_time() -> None:
    robot, log = loose(), make_log(np.arange(201) * 0.01, {})
    start = parse_parameters(["qvel0:arm"], robot)
    for sign in (1, -1):
        outputs = run(robot, log, [*start, at_arm(QuadraticDamping)], [sign * 2.0, 0.06])
        wanted = sign * 2.0 / (1 + 2.0 * 0.06 / TOTAL_INERTIA * np.arange(201) * 0.01)
        np.testing.assert_allclose(outputs.velocity[0, :, 0], wanted, rtol=1e-6)


def test_friction_that_bends_takes_a_springs_energy_first_and_gives_some_of_it_back() -> None:
    torque, bend, speed = 0.2, 0.05, 1.5
    robot, log = loose(), make_log(np.arange(201) * 0.01, {})
    start = parse_parameters(["qvel0:arm"], robot)
    numerics = Numerics("RK4", 0.001)
    outputs = run(robot, log, [*start, at_arm(PreslidingFriction)], [speed, torque, bend], numerics)
    q, v = outputs.position[0, :, 0], outputs.velocity[0, :, 0]
    forth = slice(0, int(np.argmax(v <= 0)))
    assert q[forth][-1] > 3 * bend, "far enough to slide"
    lost = torque * (q - bend * -np.expm1(-q / bend))
    np.testing.assert_allclose(
        0.5 * TOTAL_INERTIA * v[forth] ** 2, 0.5 * TOTAL_INERTIA * speed**2 - lost[forth], atol=1e-4
    )
    assert q.max() - q[-1] > 0.1 * bend, "bristles push back"
    sharp = run(robot, log, [*start, at_arm(PreslidingFriction)], [speed, torque, 0.002], numerics)
    dry = run(robot, log, [*start, at_arm(CoulombFriction)], [speed, torque], numerics)
    np.testing.assert_allclose(sharp.position, dry.position, atol=0.004)


def test_stribeck_friction_without_its_static_part_is_dry_friction() -> None:
    log = swing()
    stribeck = position(pendulum(), log, [at_arm(StribeckFriction)], [0.2, 0.0, 0.4])
    np.testing.assert_allclose(stribeck, position(pendulum(), log, [at_arm(CoulombFriction)], [0.2]), atol=1e-12)


def test_stribeck_friction_is_larger_at_rest_than_in_motion() -> None:
    command = 0.25 / KP
    assert abs(rest(StribeckFriction, [0.2, 0.0, 0.4], command)) > 0.1 * command
    assert abs(rest(StribeckFriction, [0.2, 0.1, 0.4], command)) < 0.1 * command
    robot, log = loose(), make_log(np.arange(31) * 0.01, {})
    start = parse_parameters(["qvel0:arm"], robot)
    fast = run(robot, log, [*start, at_arm(StribeckFriction)], [5.0, 0.05, 0.5, 0.2], Numerics("RK4", 0.001))
    wanted = 5.0 - 0.05 * 0.3 / TOTAL_INERTIA
    assert fast.velocity[0, -1, 0] == pytest.approx(wanted, abs=0.01), "far above the Stribeck velocity"


def test_load_friction_holds_what_the_load_presses() -> None:
    """At rest the friction carries what servo and weight differ by, up to its share of the servo's torque."""
    q = rest(LoadFriction, [0.3])
    servo = KP * (COMMAND - q)
    assert abs(servo - gravity(q)) <= 0.3 * abs(servo) * 1.001
    assert abs(servo - gravity(q)) > 0.02, "stuck away from the frictionless rest"
    assert rest(LoadFriction, [0.0]) == pytest.approx(solve(lambda q: KP * (COMMAND - q) - gravity(q)), abs=1e-9)


def test_friction_of_the_larger_load_holds_more_where_the_weight_is_the_larger() -> None:
    """A servo that asks for less than the weight: the friction follows the weight."""
    rate = 0.3
    q = rest(LoadFrictionLarger, [rate])
    servo = KP * (COMMAND - q)
    assert 0.02 < abs(servo - gravity(q)) <= rate * max(abs(servo), abs(gravity(q))) * 1.001
    # let go of a weight that is held up: with no torque of the servo only the larger one has a say
    loose_arm = with_spec(pendulum(), lambda spec: spec.delete(spec.actuators[0]))
    start = parse_parameters(["qpos0:arm"], loose_arm)
    log = make_log(np.arange(101) * 0.01, {"position.arm": np.full(101, 0.4)})
    fallen = {
        kind: run(loose_arm, log, [*start, at_arm(kind)], [0.0, 0.9], FINE).position[0]
        for kind in (LoadFriction, LoadFrictionLarger)
    }
    free = run(loose_arm, log, start, [0.0], FINE).position[0]
    np.testing.assert_allclose(fallen[LoadFriction], free, atol=1e-9)
    assert np.abs(fallen[LoadFrictionLarger] - free).max() > 0.1


@pytest.mark.parametrize("exponent", [0.5, 2 / 3, 2.0])
def test_friction_by_a_power_of_the_load_holds_that_much(exponent: float) -> None:
    q = rest(LoadFrictionPower, [0.2, exponent])
    servo, usual = abs(KP * (COMMAND - q)), SCALES["arm"].torque_rms
    assert 0.02 < abs(servo - abs(gravity(q))) <= 0.2 * (servo / usual) ** exponent * 1.001


def test_friction_by_the_first_power_of_the_load_is_that_per_unit_of_load() -> None:
    log = swing()
    ratio = position(pendulum(), log, [at_arm(LoadFriction)], [0.2])
    power = position(pendulum(), log, [at_arm(LoadFrictionPower)], [0.2 * SCALES["arm"].torque_rms, 1.0])
    np.testing.assert_allclose(power, ratio, atol=1e-9)


def test_load_friction_that_falls_with_speed_is_plain_without_its_falling_part() -> None:
    log = swing()
    plain = position(pendulum(), log, [at_arm(LoadFriction)], [0.2])
    same = position(pendulum(), log, [at_arm(LoadFrictionStribeck)], [0.2, 0.0, 0.3])
    np.testing.assert_array_equal(plain, same)
    slow = position(pendulum(), log, [at_arm(LoadFrictionStribeck)], [0.0, 0.2, 1e6])
    np.testing.assert_allclose(slow, plain, atol=1e-9)


MOTORED = PENDULUM.replace("<position", "<motor").replace(f' kp="{KP}" kv="{KV}"', "")


def test_back_emf_damps_a_driven_joint_as_friction_does_and_a_released_one_not() -> None:
    log = swing()
    for robot in (pendulum(), robot_from_xml(MOTORED)):
        damped = position(robot, log, [at_arm(ViscousDamping)], [0.05])
        np.testing.assert_allclose(position(robot, log, [at_arm(BackEmf)], [0.05]), damped, atol=2e-4)
        assert np.abs(damped - position(robot, log)).max() > 1e-2
    damped = position(pendulum(), log, [at_arm(ViscousDamping)], [0.05])
    released = make_log(log.time, {**log.channels, "enabled.arm": np.zeros(len(log.time))})
    swinging = position(pendulum(), released)
    np.testing.assert_array_equal(position(pendulum(), released, [at_arm(BackEmf)], [0.05]), swinging)
    assert np.abs(swinging - damped).max() > 1e-2


def test_back_emf_moves_the_limits_of_the_torque_with_the_speed() -> None:
    """At full drive a motor stops accelerating at its no-load speed."""
    limited = robot_from_xml(PENDULUM.replace(f'kv="{KV}"', 'kv="0" forcerange="-.3 .3"').replace(f"-{GRAVITY}", "0"))
    outputs = run(limited, held(1e3, 6.0), [at_arm(BackEmf)], [0.1], Numerics("RK4", 0.001))
    damping = 0.1 + float(limited.compile().dof_damping[0])
    assert outputs.velocity[0, -1, 0] == pytest.approx(0.3 / damping, rel=1e-3)


# --- limits of the servo --------------------------------------------------------------------------------


def test_a_torque_limit_is_a_plateau() -> None:
    log = held(2.0)
    outputs = run(pendulum(), log, [at_arm(TorqueLimit)], [0.4], effort=True)
    assert outputs.effort is not None
    assert outputs.effort.max() == pytest.approx(0.4)
    assert np.mean(outputs.effort > 0.4 - 1e-9) > 0.9
    assert outputs.position[0, -1, 0] == pytest.approx(np.arcsin(0.4 / MGL), abs=0.15)


def test_a_torque_limit_never_widens_the_models_own() -> None:
    limited = robot_from_xml(PENDULUM.replace(f'kv="{KV}"', f'kv="{KV}" forcerange="-.3 .3"'))
    log = held(2.0)
    np.testing.assert_array_equal(position(limited, log, [at_arm(TorqueLimit)], [0.4]), position(limited, log))


def test_a_soft_torque_limit_takes_some_of_every_torque_and_is_never_passed() -> None:
    limit = 0.8
    q = rest(TorqueLimitSoft, [limit])
    given = gravity(q)
    assert given == pytest.approx(KP * (COMMAND - q) / np.hypot(1, KP * (COMMAND - q) / limit), abs=1e-6)
    outputs = run(pendulum(), held(50.0, 0.3), [at_arm(TorqueLimitSoft)], [limit], Numerics("RK4", 0.001), effort=True)
    assert outputs.effort is not None
    np.testing.assert_allclose(outputs.effort[0, :, 0], limit, rtol=1e-3)


def test_torque_falls_with_speed_and_is_gone_at_the_no_load_speed() -> None:
    free = with_spec(pendulum(), lambda s: setattr(s.option, "gravity", [0, 0, 0]))
    undamped = with_spec(free, lambda s: setattr(s.joint("arm"), "damping", [0, 0, 0]))
    stall, speed = 0.5, 4.0
    log = held(50.0, 1.0)
    outputs = run(undamped, log, [at_arm(SpeedTorqueLimit)], [stall, speed], Numerics("RK4", 0.001))
    wanted = speed * (1 - np.exp(-stall / speed / TOTAL_INERTIA * log.time))
    np.testing.assert_allclose(outputs.velocity[0, :, 0], wanted, atol=2e-3)


def test_a_speed_torque_limit_does_not_limit_braking() -> None:
    """At 3 rad/s and told to stop hard, the servo may use all of its stall torque."""
    robot = with_spec(pendulum(), lambda s: setattr(s.option, "gravity", [0, 0, 0]))
    log = held(-50.0, 0.1)
    start = parse_parameters(["qvel0:arm"], robot)
    outputs = run(robot, log, [*start, at_arm(SpeedTorqueLimit)], [3.0, 0.5, 4.0], Numerics("RK4", 0.001), effort=True)
    assert outputs.effort is not None
    assert outputs.effort[0, 0, 0] == pytest.approx(-0.5)


def test_a_slew_limit_is_a_ramp_of_the_command() -> None:
    time = np.arange(401) * FINE.timestep
    step = make_log(time, {"command.arm": np.where(time >= 0.5, 1.0, 0.0)})
    ramp = make_log(time, {"command.arm": np.clip(2.0 * (time - 0.5 + 0.5 * FINE.timestep), 0.0, 1.0)})
    np.testing.assert_allclose(
        position(pendulum(), step, [at_arm(SlewLimit)], [2.0]), position(pendulum(), ramp), atol=1e-9
    )


def test_integral_action_removes_the_offset_that_gravity_leaves() -> None:
    assert abs(rest(IntegralGain, [0.0]) - COMMAND) > 0.02
    assert rest(IntegralGain, [20.0], seconds=8.0) == pytest.approx(COMMAND, abs=1e-5)


# --- supply and heat ------------------------------------------------------------------------------------


def test_a_sagging_supply_weakens_the_servo_with_time() -> None:
    q = rest(VoltageSag, [0.05], seconds=6.0)
    at_end = solve(lambda q: 0.7 * KP * (COMMAND - q) - gravity(q))
    assert q == pytest.approx(at_end, abs=1e-3)
    assert at_end < rest(VoltageSag, [0.0], seconds=6.0) - 0.01


@pytest.mark.parametrize("supply", [VoltageSagLoad, VoltageSagLoadStiffness])
def test_a_soft_supply_weakens_the_servo_with_its_own_load(supply: type[Effect]) -> None:
    def balance(q: float) -> float:
        asked, flowing = KP * (COMMAND - q), gravity(q)
        return asked * (1 - 0.3 * abs(flowing)) - flowing

    q = rest(supply, [0.3, 0.0])
    assert balance(q) == pytest.approx(0, abs=1e-8)


@pytest.mark.parametrize("supply", [VoltageSagLoad, VoltageSagLoadStiffness])
def test_a_supply_with_a_lag_rests_where_one_without_does(supply: type[Effect]) -> None:
    early, late, at_once = (
        rest(supply, [0.3, lag], seconds=seconds) for lag, seconds in ((0.5, 0.3), (0.1, 8.0), (0.0, 8.0))
    )
    assert late == pytest.approx(at_once, abs=1e-6)
    assert abs(early - rest(supply, [0.3, 0.0], seconds=0.3)) > 1e-4


def test_heat_weakens_the_servo_until_it_gives_off_what_it_takes() -> None:
    alpha = 1.5
    q = rest(ThermalDerating, [alpha, 1.0], seconds=15.0)
    torque = gravity(q)
    assert torque * (1 + alpha * torque**2) == pytest.approx(KP * (COMMAND - q), abs=1e-4)
    short, long = (rest(ThermalDerating, [alpha, tau], seconds=3.0) for tau in (1.0, 100.0))
    cold = rest(ThermalDerating, [0.0, 1.0], seconds=3.0)
    assert short < long < cold


# --- gears ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("effect", [Backlash, BacklashMotor])
@pytest.mark.parametrize("command", [0.6, -0.6])
def test_play_lets_the_link_fall_to_the_side_where_gravity_pulls(effect: type[Effect], command: float) -> None:
    play, side = 0.06, np.sign(command)
    q = solve(lambda q: KP * (command - (q + side * play / 2)) - gravity(q))
    assert rest(effect, [play, 0.0], command) == pytest.approx(q, abs=1e-3)


@pytest.mark.parametrize("effect", [Backlash, BacklashMotor])
@pytest.mark.parametrize("command", [0.6, -0.6])
def test_teeth_that_meet_give_way_in_proportion_to_the_torque(effect: type[Effect], command: float) -> None:
    play, softness, side = 0.06, 0.02, np.sign(command)
    q = solve(lambda q: KP * (command - (q + side * play / 2 + softness * gravity(q))) - gravity(q))
    assert rest(effect, [play, softness], command, seconds=6.0) == pytest.approx(q, abs=2e-5)


def test_soft_stops_do_not_depend_on_the_step() -> None:
    """What a stop adds to the inertia vanishes with the step."""
    log, fine = swing(), Numerics("RK4", 0.00025)
    exact = position(pendulum(), log, [at_arm(Backlash)], [0.03, 0.004], fine)
    errors = [
        np.abs(position(pendulum(), log, [at_arm(Backlash)], [0.03, 0.004], Numerics("RK4", step)) - exact).max()
        for step in (0.005, 0.00125)
    ]
    assert errors[1] < 0.4 * errors[0]
    assert errors[0] < 1e-3


@pytest.mark.parametrize("integrator", ["RK4", "implicitfast", "Euler"])
@pytest.mark.parametrize("joint", LEG_JOINTS)
def test_a_gear_without_play_is_rigid_and_stable(joint: str, integrator: str) -> None:
    log, numerics = swing(LEG_JOINTS), Numerics(integrator, 0.005)
    effect = Backlash.at((joint,), dict.fromkeys(LEG_JOINTS, SCALE))
    moved, plain = position(leg(), log, [effect], [0.0, 0.0], numerics), position(leg(), log, (), (), numerics)
    assert np.abs(moved - plain).max() < 0.02 * np.ptp(plain)
    assert np.isfinite(position(leg(), log, [effect], [0.03, 0.004], numerics)).all()


@pytest.mark.parametrize("effect", [Backlash, BacklashMotor])
def test_within_its_play_the_link_swings_freely(effect: type[Effect]) -> None:
    """Around the vertical the weight keeps the link still while the housing moves over the dead zone."""
    time = np.arange(601) * 0.01
    log = make_log(time, {"command.arm": 0.01 * np.sin(2 * time)})
    undamped = with_spec(pendulum(), lambda s: setattr(s.joint("arm"), "damping", [0, 0, 0]))
    moved = position(undamped, log, [at_arm(effect)], [0.06, 0.0])
    assert np.abs(moved).max() < 1e-3
    assert np.abs(position(undamped, log)).max() > 8e-3


@pytest.mark.parametrize("effect", [JointCompliance, JointComplianceMotor])
def test_a_soft_gear_twists_in_proportion_to_its_torque(effect: type[Effect]) -> None:
    softness = 0.05
    q = solve(lambda q: KP * (COMMAND - (q + softness * gravity(q))) - gravity(q))
    assert rest(effect, [softness], seconds=6.0) == pytest.approx(q, abs=2e-5)


@pytest.mark.parametrize(("name", "value"), [("damping", 0.4), ("viscous_damping", 0.4 - DAMPING)])
@pytest.mark.parametrize("effect", [Backlash, JointCompliance])
def test_a_fitted_damping_acts_once_when_a_gear_has_two_sides(effect: type[Effect], name: str, value: float) -> None:
    """In place of the joint's own or added to it, it acts where the joint's own does, with and without the effect."""
    log = swing()
    damping = parse_parameters([f"{name}:arm"], pendulum())
    built = with_spec(pendulum(), lambda s: setattr(s.joint("arm"), "damping", [0.4, 0, 0]))
    small = [0.02] * len(effect.kinds)
    np.testing.assert_allclose(
        position(pendulum(), log, [*damping, at_arm(effect)], [value, *small]),
        position(built, log, [at_arm(effect)], small),
        atol=1e-9,
    )


# --- ground ---------------------------------------------------------------------------------------------

GROUND = """
<mujoco><worldbody>
  <geom name="floor" type="plane" size="5 5 .1" friction=".8"/>
  <body name="box" pos="0 0 .05">
    <joint name="x" type="slide" axis="1 0 0"/><joint name="z" type="slide" axis="0 0 1"/>
    <geom type="box" size=".05 .05 .05" mass="1" friction=".8"/>
  </body>
</worldbody></mujoco>
"""


def test_ground_friction_is_a_factor_of_the_deceleration() -> None:
    time = np.arange(31) * 0.01
    channels = {"velocity.x": np.full(31, 3.0), "position.x": np.zeros(31)}
    log = make_log(time, channels)
    scales = {"x": SCALE}
    for factor in (1.0, 0.5):
        outputs = run(robot_from_xml(GROUND), log, [FootFriction.at(("robot",), scales)], [factor])
        assert 3.0 - outputs.velocity[0, -1, 0] == pytest.approx(factor * 0.8 * GRAVITY * 0.3, rel=0.03)


def test_softer_ground_is_pressed_in_further() -> None:
    time = np.arange(201) * 0.01
    effect = FootCompliance.at(("robot",), {"x": SCALE})
    outputs = run(robot_from_xml(GROUND), make_log(time, {}), [effect], [[1.0], [2.0]])
    hard, soft = outputs.position[:, -1, 1]
    assert soft < hard < 0
    assert soft / hard == pytest.approx(4.0, rel=0.1), "depth grows with the square of the time constant"


# --- an independent simulation --------------------------------------------------------------------------


def test_several_effects_at_once_agree_with_an_independent_integration() -> None:
    from scipy.integrate import solve_ivp

    log = swing(seconds=1.5)
    effects = [ViscousDamping, QuadraticDamping, Armature, JointSpring, Cogging, ConstantForce, CommandDelay]
    values = [0.03, 0.02, 0.004, 1.0, 0.3, 0.1, 0.05, 25.0, 0.2, 0.02]

    def command(t: float) -> float:
        row = int(np.floor((t - 0.02) / 0.01 + 1e-9))
        return float(log.channels["command.arm"][np.clip(row, 0, len(log.time) - 1)])

    def rate(t: float, state: Any) -> tuple[float, float]:
        q, v = state
        torque = KP * (command(t) - q) - KV * v - (DAMPING + 0.03) * v - 0.02 * v * abs(v) - gravity(q)
        torque += -1.0 * (q - 0.3) + 0.1 * np.sin(25 * q) + 0.05 * np.cos(25 * q) + 0.2
        return v, torque / (INERTIA + MASS * LENGTH**2 + ARMATURE + 0.004)

    seen = position(pendulum(), log, [at_arm(e) for e in effects], values, Numerics("RK4", 0.0025))
    state, wanted = [0.0, 0.0], [0.0]
    for k in range(len(log.time) - 1):
        middle = solve_ivp(lambda t, s, k=k: rate(log.time[k] + 0.005, s), (0, 0.01), state, rtol=1e-9, atol=1e-11)
        state = [float(middle.y[0, -1]), float(middle.y[1, -1])]
        wanted.append(state[0])
    np.testing.assert_allclose(seen[:, 0], wanted, atol=2e-5)
