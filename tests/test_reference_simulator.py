"""The recorder of logs: its dynamics, its numerics, and every effect in a case with a closed form."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pin = pytest.importorskip("pinocchio", reason="the recorder needs Pinocchio (pip install pin)", exc_type=ImportError)

from reference_simulator import (  # noqa: E402
    EFFECTS,
    MOTIONS,
    Recording,
    Sensors,
    exact_channels,
    load_robot,
    parse_effect,
    record,
    save,
)
from reference_simulator.__main__ import main  # noqa: E402
from reference_simulator.robot import build_pinocchio  # noqa: E402

NAO = Path(__file__).parents[1] / "sample_logs" / "nao.xml"
ROBOTS = [NAO, "six_joint_leg", "pendulum"]
KP, KV, DAMPING, ARMATURE = 12.0, 0.3, 0.08, 0.006  # of pendulum.xml
MASS, MOMENT = 0.5, 0.2 * 0.1 + 0.3 * 0.2  # kg, kg m
GRAVITY = 9.81
WEIGHT = GRAVITY * MOMENT  # gravity torque is -WEIGHT sin q

ODD_ROBOT = """
<mujoco model="odd">
  <compiler angle="radian"/>
  <worldbody>
    <body name="cart" pos="0.1 0 1" euler="0.2 0.1 -0.3">
      <joint name="rail" type="slide" axis="1 0.2 0" ref="0.1" armature="0.02"/>
      <joint name="swing" axis="0 1 0.3" pos="0.02 -0.01 0.05" ref="0.3" armature="0.01"/>
      <geom type="box" size="0.05 0.03 0.02" pos="0.01 0.02 0" mass="0.4"/>
      <body name="bracket" pos="0 0 0.1" euler="0.4 0 0">
        <geom type="box" size="0.02 0.06 0.03" mass="0.2"/>
        <body name="tip" pos="0.1 0 0">
          <joint name="bend" axis="0 0 1" pos="-0.03 0 0"/>
          <geom type="capsule" size="0.02 0.05" mass="0.1" pos="0.03 0.01 0"/>
        </body>
      </body>
    </body>
  </worldbody>
  <actuator>
    <position joint="rail" kp="100"/>
    <position joint="swing" kp="10"/>
    <position joint="bend" kp="5"/>
  </actuator>
</mujoco>
"""


def hold(level: float, seconds: float = 4.0, rate: float = 100.0, **changes: Any) -> Recording:
    """The pendulum told to go to `level` and stay there."""
    commands = np.full((round(seconds * rate), 1), level)
    commands[0] = 0.0
    return Recording("pendulum", commands=commands, seconds=seconds, rate=rate, **changes)


def ramp(speed: float, seconds: float = 4.0, **changes: Any) -> Recording:
    """The pendulum led at constant speed, in commands so frequent that they are nearly a line."""
    rate = 1000.0
    commands = speed * np.arange(round(seconds * rate))[:, None] / rate
    return Recording("pendulum", commands=commands, seconds=seconds, rate=rate, **changes)


def position(spec: Recording) -> np.ndarray:
    return exact_channels(spec)[1]["position.pendulum"]


def planted(spec: Recording, *effects: str) -> Recording:
    return replace(spec, effects=tuple(parse_effect(text) for text in effects))


EXAMPLES = {
    "payload": ":AnkleRoll",
    "com_offset": ":KneePitch",
    "cable_coupling": ":KneePitch,AnklePitch",
    "torque_limit": ":limit=0.5",
    "voltage_sag": ":rate=0.05,per_torque=0.05",
    "thermal_derating": ":alpha=5,time_constant=1",
    "external_disturbance": ":start=0.4",
    "controller_dropout": ":start=0.4",
}
"""What makes an effect fit the six-joint leg and show within a second; the others do with their defaults."""


# ---- dynamics and numerics -----------------------------------------------------------------------


@pytest.mark.parametrize("source", [*ROBOTS, "odd"])
def test_dynamics_are_those_of_the_compiled_model(source: str | Path, tmp_path: Path) -> None:
    mujoco = pytest.importorskip("mujoco")
    if source == "odd":
        source = tmp_path / "odd.xml"
        source.write_text(ODD_ROBOT)
    robot = load_robot(source)
    reference = mujoco.MjModel.from_xml_path(str(robot.path))
    data = mujoco.MjData(reference)
    model = build_pinocchio(robot)
    work = model.createData()
    rng = np.random.default_rng(0)
    for _ in range(20):
        q, v = rng.normal(size=robot.n), 3.0 * rng.normal(size=robot.n)
        data.qpos[:], data.qvel[:] = q, v
        mujoco.mj_forward(reference, data)
        columns = []
        for unit in np.eye(robot.n):
            column = np.zeros(robot.n)
            mujoco.mj_mulM(reference, data, column, unit)
            columns.append(column)
        mass = np.triu(pin.crba(model, work, q))
        mass += np.triu(mass, 1).T
        np.testing.assert_allclose(mass, np.array(columns), atol=1e-10)
        np.testing.assert_allclose(pin.nonLinearEffects(model, work, q, v), data.qfrc_bias, atol=1e-10)


def halving(spec: Recording) -> float:
    """Largest change of an exact position when the plant's step is halved, rad."""
    coarse, fine = exact_channels(spec)[1], exact_channels(replace(spec, step=spec.step / 2.0))[1]
    return max(float(np.abs(coarse[k] - fine[k]).max()) for k in coarse if k.startswith("position"))


def test_half_the_step_leaves_the_nao_where_it_is() -> None:
    assert halving(Recording(NAO, seconds=2.0, seed=1)) < 1e-8


@pytest.mark.parametrize("name", EFFECTS)
def test_half_the_step_leaves_every_effect_far_below_the_noise(name: str) -> None:
    spec = planted(Recording("six_joint_leg", seconds=1.0, seed=2), name + EXAMPLES.get(name, ""))
    assert halving(spec) < 2e-5  # the encoder and its noise are 6e-4


def test_stiff_teeth_are_resolved(monkeypatch: pytest.MonkeyPatch) -> None:
    spec = planted(Recording("six_joint_leg", seconds=2.0, seed=3), "backlash:KneePitch")
    usual = exact_channels(spec)[1]["position.KneePitch"]
    monkeypatch.setattr("reference_simulator.plant.MAX_PHASE", 0.08)
    np.testing.assert_allclose(exact_channels(spec)[1]["position.KneePitch"], usual, atol=5e-5)


@pytest.mark.parametrize("name", EFFECTS)
def test_every_effect_changes_the_log(name: str) -> None:
    plain = Recording("six_joint_leg", seconds=1.0, seed=4)
    moved = exact_channels(planted(plain, name + EXAMPLES.get(name, "")))[1]
    before = exact_channels(plain)[1]
    joints = [k for k in before if k.startswith("position")]
    assert max(np.abs(moved[k] - before[k]).max() for k in joints) > 3e-4


def test_a_log_of_the_same_robot_is_reproduced(shared_data: Path) -> None:
    from sysid_btr.io.parquet import read_log

    folder = shared_data / "nao_gantry"
    log = read_log(folder / "gantry_a.parquet")
    joints = load_robot(folder / "nominal.xml").joints
    spec = Recording(
        folder / "nominal.xml",
        seconds=6.0,
        commands=log.array("command", joints)[:600],
        mass={"RHipPitch": 1.2, "LHipPitch": 1.15, "RKneePitch": 0.85, "LKneePitch": 0.8},
        kp=0.92,
        effects=(
            parse_effect("coulomb_friction:?AnklePitch:torque=0.25"),
            parse_effect("coulomb_friction:?HipRoll:torque=0.3"),
        ),
    )
    exact = exact_channels(spec)[1]
    error = log.array("position", joints)[:600] - np.stack([exact[f"position.{j}"] for j in joints], axis=1)
    assert np.sqrt(np.mean(error**2)) < 6.1e-4


# ---- effects at rest: the torques must balance ---------------------------------------------------

Balance = Callable[[float, float], float]
"""Sum of torques at command u and recorded position q; zero at rest."""

BALANCES: dict[str, Balance] = {
    "armature:inertia=0.01": lambda u, q: KP * (u - q) - WEIGHT * np.sin(q),
    "payload:mass=0.3,offset=0/0/-0.15": lambda u, q: KP * (u - q) - (WEIGHT + 0.3 * GRAVITY * 0.15) * np.sin(q),
    "com_offset:offset=0.03/0/0": lambda u, q: KP * (u - q) + GRAVITY * (MASS * 0.03 * np.cos(q) - MOMENT * np.sin(q)),
    "constant_force:torque=0.25": lambda u, q: KP * (u - q) - WEIGHT * np.sin(q) + 0.25,
    "joint_spring:stiffness=3,rest=-0.2": lambda u, q: KP * (u - q) - WEIGHT * np.sin(q) - 3.0 * (q + 0.2),
    "cogging:amplitude=0.1,periods=9,phase=0.4": lambda u, q: (
        KP * (u - q) - WEIGHT * np.sin(q) + 0.1 * np.sin(9.0 * q + 0.4)
    ),
    "external_disturbance:torque=0.4,start=0.5,duration=9": lambda u, q: KP * (u - q) - WEIGHT * np.sin(q) + 0.4,
    "gravity_tilt:pitch=0.1": lambda u, q: KP * (u - q) - WEIGHT * np.sin(q + 0.1),
    "integral_gain:ki=40,limit=5": lambda u, q: u - q,
    "integral_gain:ki=40,limit=0.2": lambda u, q: KP * (u - q) - WEIGHT * np.sin(q) + 0.2,
    "torque_limit:limit=0.3": lambda u, q: 0.3 - WEIGHT * np.sin(q),
    "joint_compliance:stiffness=30": lambda u, q: u - WEIGHT * np.sin(q) / KP - WEIGHT * np.sin(q) / 30.0 - q,
    "backlash:play=0.04,stiffness=800": lambda u, q: (
        u - WEIGHT * np.sin(q) / KP - 0.02 - WEIGHT * np.sin(q) / 800.0 - q
    ),
    "encoder_offset:offset=0.05": lambda u, q: KP * (u - q + 0.05) - WEIGHT * np.sin(q - 0.05),
    "encoder_offset:offset=0.05,in_loop=1": lambda u, q: KP * (u - q) - WEIGHT * np.sin(q - 0.05),
    "encoder_scale:scale=1.1": lambda u, q: KP * (u - q / 1.1) - WEIGHT * np.sin(q / 1.1),
    "encoder_scale:scale=1.1,in_loop=1": lambda u, q: KP * (u - q) - WEIGHT * np.sin(q / 1.1),
    "thermal_derating:alpha=2,time_constant=0.1": lambda u, q: (
        KP * (u - q) - WEIGHT * np.sin(q) * (1.0 + 2.0 * (WEIGHT * np.sin(q)) ** 2)
    ),
    "voltage_sag:rate=0,per_torque=0.5": lambda u, q: (
        KP * (u - q) * (1.0 - 0.5 * WEIGHT * np.sin(q)) - WEIGHT * np.sin(q)
    ),
    "slew_limit:rate=1": lambda u, q: KP * (u - q) - WEIGHT * np.sin(q),
    "command_delay:delay=0.3": lambda u, q: KP * (u - q) - WEIGHT * np.sin(q),
}


@pytest.mark.parametrize("effect", BALANCES)
def test_torques_balance_at_rest(effect: str) -> None:
    u = 0.6
    q = float(position(planted(hold(u, seconds=6.0), effect))[-1])
    assert BALANCES[effect](u, q) == pytest.approx(0.0, abs=2e-6)


def test_voltage_falls_with_time() -> None:
    t, q = 5.0, position(planted(hold(0.6, seconds=5.01), "voltage_sag:rate=0.02"))[-1]
    assert KP * (1.0 - 0.02 * t) * (0.6 - q) == pytest.approx(WEIGHT * np.sin(q), rel=2e-3)


# ---- effects in motion ---------------------------------------------------------------------------


def drag(*effects: str, speed: float = 0.5) -> tuple[float, float]:
    """Torque (N m) that slows a pendulum led to u = 1 rad, beyond its own damping; and its speed (rad/s)."""
    spec = planted(ramp(speed, seconds=1.0 / speed, sensors=Sensors(velocity=True)), *effects)
    exact = exact_channels(spec)[1]
    q, v = exact["position.pendulum"][-1], exact["velocity.pendulum"][-1]
    drive = KP * (spec.commands[-1, 0] - q) - KV * v
    return float(drive - WEIGHT * np.sin(q) - DAMPING * v), float(v)


def test_friction_and_damping_drag_with_their_torque() -> None:
    base = drag()[0]
    assert base == pytest.approx(0.0, abs=4e-3)  # half a millisecond of command and the pendulum's inertia
    torque, v = drag("viscous_damping:coefficient=0.4")
    assert torque - base == pytest.approx(0.4 * v, rel=0.01)
    torque, v = drag("quadratic_damping:coefficient=0.8")
    assert torque - base == pytest.approx(0.8 * v**2, rel=0.01)
    assert drag("coulomb_friction:torque=0.3")[0] - base == pytest.approx(0.3, rel=0.01)
    faded = "stribeck_friction:static=0.5,coulomb=0.2,velocity=0.1"
    assert drag(faded)[0] - base == pytest.approx(0.2, rel=0.01)
    near, far = (f"friction_patch:torque=0.4,centre={x},width=0.05" for x in (0.94, 0.2))
    assert drag(far)[0] - base == pytest.approx(0.0, abs=2e-3)
    assert drag(near)[0] - base > 0.2


def test_load_friction_is_a_share_of_the_torque() -> None:
    speed = 0.05
    q = position(planted(ramp(speed, seconds=16.0), "load_friction:coefficient=0.2"))[-1]
    drive = KP * (speed * 15.999 - q) - KV * speed
    assert drive * (1.0 - 0.2) == pytest.approx(WEIGHT * np.sin(q) + DAMPING * speed, rel=0.01)


@pytest.mark.parametrize(
    ("effect", "breakaway"),
    [("coulomb_friction:torque=0.3", 0.3), ("stribeck_friction:static=0.5,coulomb=0.2,velocity=0.1", 0.5)],
)
def test_stuck_until_the_torque_exceeds_friction(effect: str, breakaway: float) -> None:
    speed = 0.05
    q = position(planted(ramp(speed, seconds=1.2 * breakaway / KP / speed), effect))
    moved = int(np.argmax(np.abs(q) > 0.0))
    assert np.all(q[: moved - 1] == 0.0)
    assert speed * moved / 1000.0 == pytest.approx(breakaway / KP, abs=3.0 * speed / 1000.0)


def test_friction_keeps_the_side_from_which_rest_was_reached() -> None:
    friction = "coulomb_friction:torque=0.3"
    rise, fall, rest = np.linspace(0.0, 0.5, 200), np.linspace(0.9, 0.5, 200), np.full(200, 0.5)
    up = np.concatenate([rise, rest])[:, None]
    down = np.concatenate([1.8 * rise, fall, rest])[:, None]
    at = [
        float(position(planted(Recording("pendulum", commands=u, seconds=len(u) / 100.0), friction))[-1])
        for u in (up, down)
    ]
    torques = [KP * (0.5 - q) - WEIGHT * np.sin(q) for q in at]
    assert torques[0] > 0.0 > torques[1]
    assert all(abs(torque) <= 0.3 + 1e-9 for torque in torques)


@pytest.mark.parametrize("delay", [0.03, 0.0253])
def test_a_delay_is_an_exact_shift(delay: float) -> None:
    plain = Recording("pendulum", seconds=3.0, seed=5)  # starts at rest in balance: nothing happens before 0
    late_command = position(planted(plain, f"command_delay:delay={delay}"))
    late_sensor = position(planted(plain, f"sensor_delay:delay={delay}"))
    np.testing.assert_allclose(late_command, late_sensor, atol=1e-8)
    if delay == 0.03:
        np.testing.assert_allclose(late_command[3:], position(plain)[:-3], atol=1e-10)


def test_armature_adds_to_the_inertia() -> None:
    inertia = KP * 0.1 * 0.5 * 0.001**2 / position(hold(0.1, seconds=0.01, rate=1000.0))[2]
    more = (
        KP * 0.1 * 0.5 * 0.001**2 / position(planted(hold(0.1, seconds=0.01, rate=1000.0), "armature:inertia=0.02"))[2]
    )
    assert more - inertia == pytest.approx(0.02, rel=0.02)


def test_torque_limits_are_kept_and_reached() -> None:
    sensors = Sensors(velocity=True, effort=True)
    swing = hold(1.2, seconds=2.0, sensors=sensors)
    effort = exact_channels(planted(swing, "torque_limit:limit=0.9"))[1]["effort.pendulum"]
    assert np.abs(effort).max() == 0.9
    exact = exact_channels(planted(swing, "speed_torque_limit:stall=1.5,no_load_speed=5"))[1]
    effort, speed = exact["effort.pendulum"], exact["velocity.pendulum"]
    line = 1.5 * np.clip(1.0 - np.sign(effort) * speed / 5.0, 0.0, 1.0)
    assert np.all(np.abs(effort) <= line + 1e-12)
    assert np.count_nonzero(np.isclose(np.abs(effort), line) & (np.abs(speed) > 0.5)) > 10


def test_slew_limit_sets_the_speed_of_a_long_step() -> None:
    q = position(planted(hold(1.5, seconds=3.0), "slew_limit:rate=0.5"))
    setpoint = q + WEIGHT * np.sin(q) / KP  # up to a constant
    assert setpoint[250] - setpoint[150] == pytest.approx(0.5, rel=0.01)


def test_backlash_is_a_loop_as_wide_as_the_play() -> None:
    level = np.concatenate([np.full(300, 0.4), np.full(300, -0.4)])[:, None]
    level[0] = 0.0
    spec = Recording("pendulum", commands=level, seconds=6.0)
    wide = position(planted(spec, "backlash:play=0.04,stiffness=800"))
    rigid = position(planted(spec, "backlash:play=0,stiffness=800"))
    slack = (rigid[299] - wide[299]) + (wide[599] - rigid[599])
    assert slack == pytest.approx(0.04 / (1.0 + WEIGHT * np.cos(0.4) * (1 / KP + 1 / 800)), rel=0.01)


def test_gain_drift_and_dropout_and_cable() -> None:
    q = position(planted(hold(0.6, seconds=40.0, rate=20.0), "gain_drift:depth=0.3,period=40"))
    assert KP * 1.3 * (0.6 - q[200]) == pytest.approx(WEIGHT * np.sin(q[200]), rel=1e-2)
    sensors = Sensors(effort=True)
    spec = planted(hold(0.6, sensors=sensors), "controller_dropout:start=2,duration=0.1,every=1")
    effort = exact_channels(spec)[1]["effort.pendulum"]
    assert np.all(effort[200:210] == 0.0)
    assert np.all(effort[150:200] > 0.0)
    leg = Recording("six_joint_leg", seconds=4.0, commands=np.tile([0, 0, 0, 0.5, 0.0, 0], (400, 1)))
    with_cable = exact_channels(planted(leg, "cable_coupling:KneePitch,AnklePitch:stiffness=2"))[1]
    before = exact_channels(leg)[1]
    assert with_cable["position.KneePitch"][-1] < before["position.KneePitch"][-1] - 0.01
    assert with_cable["position.AnklePitch"][-1] > before["position.AnklePitch"][-1] + 0.01


def test_mass_and_gains_scale_what_they_name() -> None:
    q = position(hold(0.6, mass={"arm": 1.4}, kp={"pend*": 0.8}))[-1]
    assert 0.8 * KP * (0.6 - q) == pytest.approx(1.4 * WEIGHT * np.sin(q), abs=1e-6)


def test_digital_servo_holds_its_torque() -> None:
    spec = hold(0.6, seconds=0.2, rate=1000.0, sensors=Sensors(effort=True), servo_period=0.01)
    effort = exact_channels(spec)[1]["effort.pendulum"].reshape(-1, 10)
    assert np.all(effort == effort[:, :1])
    assert np.unique(effort[:, 0]).size > 15


def test_preroll_starts_the_log_in_balance() -> None:
    commands = np.full((100, 1), 0.6)
    q = position(Recording("pendulum", commands=commands, seconds=1.0, preroll=3.0))
    assert np.ptp(q) < 1e-8
    assert KP * (0.6 - q[0]) == pytest.approx(WEIGHT * np.sin(q[0]), abs=1e-6)


# ---- motions, sensors, files ---------------------------------------------------------------------


@pytest.mark.parametrize("motion", MOTIONS)
@pytest.mark.parametrize("source", ROBOTS)
def test_motions_stay_within_limits_and_start_at_home(motion: str, source: str | Path) -> None:
    robot = load_robot(source)
    time = np.arange(1500) * 0.01
    commands = [MOTIONS[motion](robot, time, np.random.default_rng(seed)) for seed in (0, 0, 1)]
    assert np.array_equal(commands[0], commands[1])
    assert not np.array_equal(commands[0], commands[2])
    assert np.all(commands[0] >= robot.range[:, 0] - 1e-12)
    assert np.all(commands[0] <= robot.range[:, 1] + 1e-12)
    np.testing.assert_allclose(commands[0][0], np.clip(0.0, *robot.range.T), atol=1e-12)
    assert np.ptp(commands[0], axis=0).min() > 0.02


def test_noise_floor_is_that_of_a_gantry_encoder() -> None:
    log, truth = record(Recording("pendulum", seconds=10.0, seed=6))
    assert truth["noise_floor"]["position.pendulum"] == pytest.approx(5.97e-4, rel=0.05)
    tick = 2.0 * np.pi / 4096.0
    ticks = log.channels["position.pendulum"] / tick
    np.testing.assert_allclose(ticks, np.round(ticks), atol=1e-9)
    assert log.meta.source == "recorded"
    assert log.meta.mount == "fixed"


def test_imu_of_a_tilted_base_agrees_with_its_accelerometer() -> None:
    sensors = Sensors(imu=True)
    exact = exact_channels(planted(hold(0.0, seconds=0.1, sensors=sensors), "gravity_tilt:roll=0.1,pitch=0.2"))[1]
    acc = [exact[f"imu.acc_{axis}"][0] for axis in "xyz"]
    assert np.linalg.norm(acc) == pytest.approx(GRAVITY)
    assert exact["imu.angle_x"][0] == pytest.approx(0.1)
    assert exact["imu.angle_y"][0] == pytest.approx(0.2)


def test_same_recording_same_numbers_and_a_valid_file(tmp_path: Path) -> None:
    from sysid_btr.io.parquet import read_log

    spec = planted(Recording("pendulum", seconds=1.0, seed=7), "random_walk_torque", "coulomb_friction")
    truth = save(spec, tmp_path / "a.parquet")
    save(spec, tmp_path / "b.parquet")
    assert (tmp_path / "a.parquet").read_bytes() == (tmp_path / "b.parquet").read_bytes()
    assert json.loads((tmp_path / "a.truth.json").read_text()) == truth
    assert [e["effect"] for e in truth["effects"]] == ["random_walk_torque", "coulomb_friction"]
    assert read_log(tmp_path / "a.parquet").joints("position") == ("pendulum",)
    other, _ = record(replace(spec, seed=8))
    assert not np.array_equal(
        read_log(tmp_path / "a.parquet").channels["position.pendulum"], other.channels["position.pendulum"]
    )


def test_an_effect_does_not_change_the_motion_or_the_noise() -> None:
    plain = Recording("pendulum", seconds=1.0, seed=9, sensors=Sensors(bits=0))
    specs = [plain, planted(plain, "random_walk_torque")]
    logs = [record(spec)[0].channels for spec in specs]
    exact = [exact_channels(spec)[1] for spec in specs]
    assert np.array_equal(logs[0]["command.pendulum"], logs[1]["command.pendulum"])
    noise = [log["position.pendulum"] - ideal["position.pendulum"] for log, ideal in zip(logs, exact, strict=True)]
    np.testing.assert_allclose(noise[0], noise[1], atol=1e-12)


@pytest.mark.parametrize("name", ["pendulum_friction", "pendulum_weak"])
def test_sample_logs_are_what_their_generator_makes(name: str) -> None:
    from sample_logs.generate import HERE, MODELS, SAMPLES
    from sysid_btr.io.parquet import read_log

    log, truth = record(SAMPLES[name])
    stored = read_log(HERE / f"{name}.parquet")
    assert list(stored.channels) == list(log.channels)
    for channel, values in log.channels.items():
        np.testing.assert_allclose(stored.channels[channel], values, atol=1e-9)
    assert json.loads((HERE / f"{name}.truth.json").read_text())["effects"] == truth["effects"]
    for copy, source in MODELS.items():
        assert (HERE / copy).read_bytes() == source.read_bytes()


def test_command_line_writes_log_and_truth(tmp_path: Path) -> None:
    out = tmp_path / "leg.parquet"
    words = "--robot six_joint_leg --seconds 0.5 --seed 3 --mass KneePitch=1.2 --kp 0.9 --kv *Hip*=1.1"
    effects = ["--effect", "coulomb_friction:Knee*,AnkleRoll:torque=0.3", "--effect", "gravity_tilt:pitch=0.02"]
    assert main([*words.split(), *effects, "--log", "effort", "--out", str(out)]) == 0
    truth = json.loads((tmp_path / "leg.truth.json").read_text())
    assert truth["mass"]["KneePitch"] == {"scale": 1.2, "value": pytest.approx(1.2 * 0.42)}
    assert truth["kp"]["AnkleRoll"]["value"] == pytest.approx(0.9 * 22.0)
    assert truth["kv"]["HipRoll"]["scale"] == 1.1
    assert truth["effects"][0]["where"] == ["KneePitch", "AnkleRoll"]
    assert "effort.KneePitch" in truth["noise_floor"]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("friction", "no effect 'friction'"),
        ("backlash:KneePitch:gap=1", "has no 'gap'"),
        ("backlash:a:b:c", "NAME:WHERE"),
    ],
)
def test_wrong_effects_are_explained(text: str, said: str) -> None:
    with pytest.raises(ValueError, match=said):
        parse_effect(text)


def test_wrong_places_are_explained() -> None:
    with pytest.raises(ValueError, match="no joint matches 'Knie'"):
        exact_channels(planted(Recording("six_joint_leg", seconds=0.1), "backlash:Knie"))
    with pytest.raises(ValueError, match="nothing matches 'Knie'"):
        exact_channels(Recording("six_joint_leg", seconds=0.1, mass={"Knie": 1.2}))
