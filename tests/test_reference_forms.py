"""The recorder's forms that no library has exactly, and its motors: each in a case with a closed form."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("pinocchio", reason="the recorder needs Pinocchio (pip install pin)", exc_type=ImportError)

from reference_simulator import FORMS, Follow, Recording, Sensors, exact_channels
from reference_simulator import forms as f

Array = np.ndarray
KP, KV, DAMPING = 12.0, 0.3, 0.08  # of pendulum.xml
GRAVITY, MOMENT = 9.81, 0.2 * 0.1 + 0.3 * 0.2
WEIGHT = GRAVITY * MOMENT  # gravity torque is -WEIGHT sin q
SPEED = 0.4
MOTOR = """<mujoco model="motor"><compiler angle="radian"/><worldbody><body name="arm" pos="0 0 0.5">
<joint name="pendulum" axis="0 1 0" armature="0.006" damping="0.08"/>
<geom type="capsule" fromto="0 0 0 0 0 -0.2" size="0.015" mass="0.2"/><geom pos="0 0 -0.2" size="0.03" mass="0.3"/>
</body></worldbody><actuator><motor joint="pendulum" gear="5"/></actuator></mujoco>"""


def seen(effect: f.Form | None, commands: Array, rate: float = 1000.0, **more: object) -> tuple[Array, Array]:
    """Position and the drive's torque of the pendulum."""
    spec = Recording(
        "pendulum",
        commands=commands[:, None],
        rate=rate,
        seconds=len(commands) / rate,
        effects=(effect,) if effect else (),
        sensors=Sensors(effort=True),
        **more,  # type: ignore[arg-type]
    )
    channels = exact_channels(spec)[1]
    return channels["position.pendulum"], channels["effort.pendulum"]


def there_and_back(seconds: float = 3.0) -> Array:
    """A command that goes up and down at one speed."""
    t = np.arange(round(2 * seconds * 1000)) / 1000.0
    return SPEED * np.where(t < seconds, t, 2 * seconds - t)


FRICTION: dict[str, tuple[f.Form, Callable[[Array, Array, float], Array | float]]] = {
    "asymmetric": (f.AsymmetricFriction(forward=0.3, backward=0.1), lambda q, e, v: 0.3 if v > 0 else 0.1),
    "stribeck": (
        f.StretchedStribeck(static=0.4, coulomb=0.2, velocity=0.3, exponent=0.7, viscous=0.05),
        lambda q, e, v: 0.2 + 0.2 * np.exp(-((SPEED / 0.3) ** 0.7)) + 0.05 * SPEED,
    ),
    "presliding": (f.PreslidingFriction(coulomb=0.3, yielding=0.01), lambda q, e, v: 0.3),
    "load": (f.RootLoadFriction(coefficient=0.2), lambda q, e, v: 0.2 * np.sqrt(np.abs(e))),
    "power": (f.PowerDamping(coefficient=0.5, exponent=1.5), lambda q, e, v: 0.5 * SPEED**1.5),
    "cyclic": (
        f.CyclicFriction(torque=0.3, depth=0.5, periods=3.0, phase=0.2),
        lambda q, e, v: 0.3 * (1 + 0.5 * np.sin(3 * q + 0.2)),
    ),
}


@pytest.mark.parametrize("name", FRICTION)
def test_friction_is_what_the_drive_lacks_at_steady_speed(name: str) -> None:
    effect, expected = FRICTION[name]
    q, effort = seen(effect, there_and_back())
    for direction, window in ((1.0, slice(1500, 2900)), (-1.0, slice(4000, 5200))):
        lost = effort[window] - WEIGHT * np.sin(q[window]) - DAMPING * np.gradient(q[window], 1e-3)
        against = direction * expected(q[window], effort[window], direction)
        np.testing.assert_allclose(lost, against + 0 * lost, atol=0.012)


def test_a_bristle_gives_way_before_it_slides() -> None:
    slow = 0.002 * np.arange(2000) / 1000.0  # torque rises by 0.048 Nm, far below the friction
    q, effort = seen(f.PreslidingFriction(coulomb=0.3, yielding=0.02), slow)
    stiffness = (effort[-1] - WEIGHT * np.sin(q[-1])) / q[-1]
    assert stiffness == pytest.approx(0.3 / 0.02, rel=0.1)


@pytest.mark.parametrize(
    ("effect", "late"),
    [
        (f.SmoothedCommand(lag=0.03), 0.06),
        (f.RareCommands(period=0.04), 0.02),
        (f.JitteringDelay(least=0.03, most=0.0301), 0.03),
    ],
)
def test_commands_are_late_by_their_size(effect: f.Form, late: float) -> None:
    command = SPEED * np.arange(3000) / 1000.0
    plain, moved = (seen(e, command)[0][1000:] for e in (None, effect))
    behind = (plain - moved) * (1.0 + WEIGHT / KP * np.cos(plain))  # as far as gravity lets it follow
    assert np.mean(behind) / SPEED == pytest.approx(late, abs=0.0012)
    assert effect.size == pytest.approx(late, abs=0.0002)


def test_commands_that_jitter_are_late_by_different_times() -> None:
    ramp = SPEED * np.arange(300) / 100.0
    even, uneven = (f.JitteringDelay(least=a, most=b) for a, b in ((0.03, 0.0301), (0.0, 0.05)))
    plain = seen(None, ramp, 100.0)[0]
    spread = [np.std((plain - seen(e, ramp, 100.0)[0])[100:]) for e in (even, uneven)]
    assert spread[1] > 2 * spread[0]


HELD = np.concatenate([np.zeros(1), np.full(3999, 0.8)])
BALANCES: dict[str, tuple[f.Form, Callable[[float], float]]] = {
    "ramp": (f.StiffnessRamp(depth=0.3, start=0.5, duration=1.0), lambda q: 0.7 * KP * (0.8 - q)),
    "power": (f.PowerRamp(depth=0.3, start=0.5, duration=1.0), lambda q: 0.7 * KP * (0.8 - q)),
    "soft limit": (f.SoftTorqueLimit(limit=0.7), lambda q: 0.7 * np.tanh(KP * (0.8 - q) / 0.7)),
    "cubic": (f.CubicSpring(stiffness=2.0, rest=-0.2), lambda q: KP * (0.8 - q) - 2.0 * (q + 0.2) ** 3),
    "stop": (f.OneSidedSpring(stiffness=5.0, onset=0.5), lambda q: KP * (0.8 - q) - 5.0 * (q - 0.5)),
    "no stop": (f.OneSidedSpring(stiffness=5.0, onset=0.5, side=-1.0), lambda q: KP * (0.8 - q)),
    "load": (
        f.SolidLoad(mass=0.3, radius=0.05, offset=(0.0, 0.0, -0.15)),
        lambda q: KP * (0.8 - q) - 0.3 * GRAVITY * 0.15 * np.sin(q),
    ),
}


@pytest.mark.parametrize("name", BALANCES)
def test_torques_balance_at_rest(name: str) -> None:
    effect, drive = BALANCES[name]
    q = float(seen(effect, HELD)[0][-1])
    assert drive(q) - WEIGHT * np.sin(q) == pytest.approx(0.0, abs=1e-4)


def test_a_sagging_supply_weakens_the_stiffness_by_the_load() -> None:
    q, effort = (x[-1] for x in seen(f.StiffnessSag(per_torque=0.4, lag=0.05), HELD))
    assert effort == pytest.approx(WEIGHT * np.sin(q), abs=1e-4)
    assert effort == pytest.approx((1 - 0.4 * abs(effort)) * KP * (0.8 - q), abs=1e-4)


@pytest.mark.parametrize("play", [0.02, 0.06])
def test_teeth_without_edges_balance_where_their_law_says(play: float) -> None:
    q = float(seen(f.SmoothBacklash(play=play, stiffness=50.0, damping=0.1), HELD)[0][-1])
    torque = WEIGHT * np.sin(q)
    twist = (0.8 - torque / KP) - q
    assert 50.0 * (twist - 0.5 * play * np.tanh(2.0 * twist / play)) == pytest.approx(torque, abs=1e-4)


def test_grease_makes_the_play_slow() -> None:
    command = np.concatenate([np.zeros(1), np.full(3000, 0.5), np.full(3000, -0.5)])
    quick, slow = (seen(f.GreasedBacklash(play=0.05, damping=d), command)[0] for d in (0.05, 2.0))
    assert abs(quick[-1] - slow[-1]) < 2e-3
    assert np.max(np.abs(quick - slow)) > 5e-3


def test_a_band_pulls_along_its_line() -> None:
    band = f.ElasticBand(where=("arm",), stiffness=8.0, offset=(0.0, 0.0, -0.15), anchor=(0.3, 0.0, 0.1), length=0.2)
    q = float(seen(band, HELD)[0][-1])

    def energy(x: float) -> float:
        end = np.array([0.0, 0.0, 0.5]) + 0.15 * np.array([-np.sin(x), 0.0, -np.cos(x)])
        return 0.5 * 8.0 * max(float(np.linalg.norm(end - [0.3, 0.0, 0.1])) - 0.2, 0.0) ** 2

    pull = -(energy(q + 1e-5) - energy(q - 1e-5)) / 2e-5
    assert abs(pull) > 0.05
    assert KP * (0.8 - q) - WEIGHT * np.sin(q) + pull == pytest.approx(0.0, abs=1e-4)


def test_sensors_show_what_their_law_says() -> None:
    command = 0.5 * np.sin(np.arange(3000) / 500.0)
    t, plain = np.arange(3000) / 1000.0, seen(None, command)[0]
    cyclic = seen(f.EccentricEncoder(amplitude=0.03, periods=5, phase=0.4), command)[0]
    np.testing.assert_allclose(cyclic, plain + 0.03 * np.sin(5 * plain + 0.4), atol=1e-12)
    drift = seen(f.EncoderDrift(drift=0.05, time_constant=2.0), command)[0]
    np.testing.assert_allclose(drift, plain + 0.05 * (1 - np.exp(-t / 2.0)), atol=1e-12)
    late = seen(f.EncoderFilter(lag=0.02), command)[0]
    np.testing.assert_allclose(late[500:], np.interp(t - 0.02, t, plain)[500:], atol=3e-3)


@pytest.mark.parametrize(
    ("effect", "wave"),
    [
        (f.SineTorque(amplitude=0.5, frequency=0.1, phase=1.0), lambda t: 0.5 * np.sin(0.2 * np.pi * t + 1.0)),
        (
            f.RingingTorque(amplitude=0.5, frequency=0.1, decay=3.0, start=1.0, every=20.0),
            lambda t: np.where(t > 1, 0.5 * np.exp(-(t - 1) / 3.0) * np.sin(0.2 * np.pi * (t - 1)), 0.0),
        ),
    ],
)
def test_slow_disturbances_shift_the_balance(effect: f.Form, wave: Callable[[Array], Array]) -> None:
    t = np.arange(8000) / 1000.0
    q = seen(effect, np.zeros(8000))[0]
    left = KP * (0.0 - q) - WEIGHT * np.sin(q) + wave(t)
    assert np.abs(left[1000:]).max() < 0.03


@pytest.mark.parametrize("name", FORMS)
def test_every_form_says_its_family_and_size(name: str) -> None:
    truth = FORMS[name]().truth()
    assert truth["family"]
    assert truth["unit"]
    assert truth["size"] > 0
    assert not truth["in_library"]


@pytest.fixture
def motor(tmp_path: Path) -> Path:
    path = tmp_path / "motor.xml"
    path.write_text(MOTOR)
    return path


def test_a_motor_gives_the_torque_that_is_commanded(motor: Path) -> None:
    spec = Recording(motor, commands=np.full((800, 1), 0.4), seconds=8.0, sensors=Sensors(effort=True))
    channels = exact_channels(spec)[1]
    assert channels["position.pendulum"][0] == 0.0  # hangs at rest until it is told
    assert np.sin(channels["position.pendulum"][-1]) == pytest.approx(0.4 / WEIGHT, abs=2e-3)
    np.testing.assert_allclose(channels["effort.pendulum"], 0.4)


def test_a_host_makes_motors_follow_and_its_commands_give_the_same_motion_again(motor: Path) -> None:
    spec = Recording(motor, motion="multisine", seed=2, seconds=4.0, follow=Follow((8.0,), (0.4,)))
    told = exact_channels(spec)[1]
    commands = told["command.pendulum"]
    assert np.std(commands) > 0.1
    again = exact_channels(Recording(motor, seconds=4.0, commands=commands[:, None]))[1]
    np.testing.assert_allclose(again["position.pendulum"], told["position.pendulum"], atol=1e-9)
