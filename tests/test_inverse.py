"""Inverse dynamics: torques of a measured motion, without commands and without integration."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest

from sysid_btr.cli.commands import run
from sysid_btr.diagnosis.close import close, usable_effects
from sysid_btr.errors import LogError, ModelError, UsageError
from sysid_btr.identify.fit import Fit, fit
from sysid_btr.identify.mode import Mode
from sysid_btr.identify.study import Study, make_study
from sysid_btr.io.log import Log, LogMeta
from sysid_btr.io.noise import channel_noise
from sysid_btr.io.parquet import read_log, write_log
from sysid_btr.models.actuation import with_motors
from sysid_btr.models.robot import Robot, robot_from_file
from sysid_btr.simulation.numerics import Numerics
from sysid_btr.simulation.replay import Replay
from sysid_btr.terms.coupling import DriveCoupling
from sysid_btr.terms.free_form import FREE_FORMS
from sysid_btr.terms.library import select_effects
from sysid_btr.terms.scales import JointScale

ARM = """<mujoco><compiler angle="radian"/><option timestep="0.001"/>
<worldbody><body name="upper" pos="0 0 1"><joint name="shoulder" axis="0 1 0" armature="0.05"/>
<inertial mass="2" pos="0.02 0 -0.15" diaginertia="0.02 0.02 0.002"/>
<body name="lower" pos="0 0 -0.3"><joint name="elbow" axis="0 1 0" armature="0.02"/>
<inertial mass="1" pos="0 0.01 -0.12" diaginertia="0.006 0.006 0.001"/>
<body name="hand" pos="0 0 -0.25"><joint name="wrist" axis="0 0 1" armature="0.004"/>
<inertial mass="0.4" pos="0.05 0 -0.04" diaginertia="0.001 0.001 0.0006"/></body></body></body></worldbody></mujoco>"""
JOINTS = ("shoulder", "elbow", "wrist")
RATE, SECONDS = 500, 12
SIZE = JointScale(1.0, 1.0, 1.0, 1.0, 1.0, 1.0)


@pytest.fixture(scope="module")
def arm(tmp_path_factory: pytest.TempPathFactory) -> Robot:
    path = tmp_path_factory.mktemp("arm") / "arm.xml"
    path.write_text(ARM)
    return robot_from_file(path)


def moved(
    change: dict[str, object] | None = None,
    *,
    seed: int = 0,
    noise: tuple[float, float] = (2e-5, 0.02),
    coupling: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> Log:
    """A log of smooth motions and of the torques that another arm takes for them, by MuJoCo's inverse dynamics.

    `coupling` is dry friction, viscous friction and inertia of a motor that turns with elbow and wrist.
    """
    rng = np.random.default_rng(seed)
    model = mujoco.MjModel.from_xml_string(ARM)
    friction = np.zeros(3)
    for name, values in (change or {}).items():
        if name == "dof_frictionloss":
            friction[:] = values
        else:
            getattr(model, name)[:] = values
    data = mujoco.MjData(model)
    mujoco.mj_setConst(model, data)
    time = np.arange(RATE * SECONDS) / RATE
    frequency = rng.uniform(0.15, 1.1, (3, 5))
    phase, size = rng.uniform(0, 2 * np.pi, (3, 5)), np.array([0.5, 0.7, 0.8])[:, None] / (1 + np.arange(5))
    turns = 2 * np.pi * frequency[:, :, None] * time + phase[:, :, None]
    rate = 2 * np.pi * frequency[:, :, None]
    q, v, a = (
        np.sum(size[:, :, None] * x, axis=1).T
        for x in (np.sin(turns), rate * np.cos(turns), -(rate**2) * np.sin(turns))
    )
    torque = np.empty(q.shape)
    for i in range(len(time)):
        data.qpos[:], data.qvel[:], data.qacc[:] = q[i], v[i], a[i]
        mujoco.mj_inverse(model, data)
        torque[i] = data.qfrc_inverse + friction * np.sign(v[i])
    both = v[:, 1] + v[:, 2]
    shared = coupling[0] * np.sign(both) + coupling[1] * both + coupling[2] * (a[:, 1] + a[:, 2])
    torque[:, 1:] += shared[:, None]
    channels = {f"position.{j}": q[:, i] + noise[0] * rng.normal(size=len(q)) for i, j in enumerate(JOINTS)}
    channels |= {f"effort.{j}": torque[:, i] + noise[1] * rng.normal(size=len(q)) for i, j in enumerate(JOINTS)}
    return Log(time, channels, LogMeta(sample_period=1 / RATE), np.zeros(len(time), dtype=np.int64))


def driven(seconds: float) -> Log:
    """A swing that begins off the vertical, without any motor."""
    time = np.arange(int(RATE * seconds)) / RATE
    start = dict(zip(JOINTS, (0.6, 0.4, 0.2), strict=True))
    channels = {f"position.{j}": np.full(len(time), q) for j, q in start.items()}
    return Log(time, channels, LogMeta(sample_period=1 / RATE), np.zeros(len(time), dtype=np.int64))


def study_of(arm: Robot, log: Log) -> Study:
    return make_study(arm, [log], threads=1)


def test_the_right_model_leaves_noise_alone(arm: Robot) -> None:
    study = study_of(arm, moved())
    assert study.leading_channel == "effort"
    found = close(study, ["mass:hand"])
    assert found.verdict == "nothing_missing", found.message
    # of the noise that is told from the log nothing is left out and nothing is counted twice
    assert 0.7 < found.before.train["effort"].chi2 < 1.3


def outside(found: Fit, truth: dict[str, float]) -> int:
    """How many truths lie outside the 95 % intervals."""
    own = {e.name: e for e in found.estimates}
    return sum(not own[name].ci95[0] <= value <= own[name].ci95[1] for name, value in truth.items())


def test_intervals_hold_what_planted_friction_inertia_and_masses_are(arm: Robot) -> None:
    """From a frictionless start, on eight logs: 95 % intervals of seven numbers each, and errors of a few percent."""
    truth = {f"frictionloss:{j}": f for j, f in zip(JOINTS, (0.4, 0.25, 0.05), strict=True)}
    truth |= {f"damping:{j}": b for j, b in zip(JOINTS, (0.3, 0.1, 0.02), strict=True)} | {"mass:hand": 1.3}
    missed = 0
    for seed in range(8):
        heavier = np.array([0.0, 2.0, 1.0, 0.4 * 1.3])
        inertia = mujoco.MjModel.from_xml_string(ARM).body_inertia.copy()
        inertia[3] *= 1.3
        change = {
            "body_mass": heavier,
            "body_inertia": inertia,
            "dof_damping": (0.3, 0.1, 0.02),
            "dof_frictionloss": (0.4, 0.25, 0.05),
        }
        found = fit(study_of(arm, moved(change, seed=seed)), ["frictionloss:*", "damping:*", "mass:hand"])
        missed += outside(found, truth)
        for e in found.estimates:
            assert e.value == pytest.approx(truth[e.name], rel=0.08), (seed, e.name)
    # of 56 intervals 2.8 miss on average; 9 or more do by chance once in 500
    assert missed <= 8


def test_a_motor_shared_by_two_joints_is_found(arm: Robot) -> None:
    study = study_of(arm, moved(coupling=(0.15, 0.05, 0.01)))
    found = close(study, ["mass:hand"])
    assert found.verdict == "explained", found.message
    assert [(e.effect, e.variant, e.where) for e in found.effects] == [("drive_coupling", "sum", ("elbow",))]
    amounts = [p.value for p in found.effects[0].parameters]
    np.testing.assert_allclose(amounts, (0.15, 0.05, 0.01), rtol=0.08)


def test_a_shared_motor_does_the_same_in_a_replay(arm: Robot, tmp_path: Path) -> None:
    """Forward: both joints of a pair driven by MuJoCo move as with the tendon that a modeller would have written."""
    term = DriveCoupling.at(("elbow", "wrist"), dict.fromkeys(JOINTS, SIZE))
    log = driven(seconds=1.0)
    numerics = Numerics("RK4", 1 / RATE)
    values = np.array([[0.0, 0.05, 0.01, 0.0, 0.0, 0.0]])
    found = Replay(arm, log, (term,), numerics, threads=1).predict(values)
    tendon = ARM.replace(
        "</worldbody>",
        '</worldbody><tendon><fixed damping="0.05" armature="0.01"><joint joint="elbow" coef="1"/>'
        '<joint joint="wrist" coef="1"/></fixed></tendon>',
    )
    path = tmp_path / "with_tendon.xml"
    path.write_text(tendon)
    right = Replay(robot_from_file(path), log, (), numerics, threads=1).predict(np.zeros((1, 0)))
    plain = Replay(arm, log, (), numerics, threads=1).predict(np.zeros((1, 0)))
    np.testing.assert_allclose(found.position, right.position, atol=1e-12)
    assert np.abs(found.position - plain.position).max() > 0.01


def test_friction_that_follows_the_load_is_that_of_the_predicted_torque(arm: Robot) -> None:
    """A gear's friction must not be explained by the measured torque, which holds it."""
    log = moved({"dof_frictionloss": (0.4, 0.25, 0.05)})
    found = close(study_of(arm, log), ["mass:hand"])
    assert found.verdict == "explained", found.message
    assert {e.effect for e in found.effects} == {"coulomb_friction"}
    assert {w for e in found.effects for w in e.where} == set(JOINTS)


@pytest.mark.parametrize("joint", ["shoulder", "elbow"])
def test_a_push_that_nobody_declared_is_found_with_its_time(arm: Robot, joint: str) -> None:
    log = moved()
    push = np.where((log.time > 3) & (log.time < 3.4), -0.6, 0.0)
    pushed = {**log.channels, f"effort.{joint}": log.channels[f"effort.{joint}"] - push}
    found = close(study_of(arm, replace(log, channels=pushed)), ["mass:hand"])
    assert [(e.effect, e.where) for e in found.effects] == [("external_disturbance", (joint,))]
    torque, start, duration = (p.value for p in found.effects[0].parameters)
    assert torque == pytest.approx(-0.6, rel=0.05)
    assert start == pytest.approx(3.0, abs=0.01)
    assert duration == pytest.approx(0.4, abs=0.02)


def test_a_form_that_no_law_has_is_learnt_and_named_by_its_family(arm: Robot) -> None:
    log = moved()
    own = 0.1 * log.channels["position.elbow"] ** 3
    changed = {**log.channels, "effort.elbow": log.channels["effort.elbow"] + own}
    found = close(study_of(arm, replace(log, channels=changed)), ["mass:hand"])
    # the end of the log goes beyond what its beginning shows of the curve: parts of all of it are held out
    assert found.verdict == "explained", found.message
    [spring] = found.effects
    assert (spring.effect, spring.family, spring.where) == ("free_torque", "spring", ("elbow",))
    assert spring.likely
    assert min(spring.explains.values()) > 0.9
    assert "torque that depends on the position at elbow" in found.message


def test_what_a_mode_cannot_do_is_said(arm: Robot) -> None:
    log = moved()
    still = replace(log, channels={n: v for n, v in log.channels.items() if not n.startswith("effort")})
    with pytest.raises(ModelError, match=r"no effort .*--mode forward"):
        make_study(arm, [still], mode=Mode("inverse"))
    rest = replace(log, channels={n: v if n.startswith("effort") else 0 * v for n, v in log.channels.items()})
    with pytest.raises(LogError, match=r"no joint with a torque moves between 0 and"):
        close(study_of(arm, rest), ["mass:hand"])
    with pytest.raises(UsageError, match="choose one of auto, forward"):
        Mode("backwards")


def test_what_no_single_sample_shows_is_refused_and_not_looked_for(arm: Robot) -> None:
    """Play and compliance need a second joint, hysteresis a past: torques of one instant know neither."""
    study = make_study(with_motors(arm), [moved()], mode=Mode("inverse"), threads=1)
    for name in ("backlash", "joint_compliance"):
        with pytest.raises(UsageError, match=rf"{name}: .* --mode forward"):
            study.declare([f"{name}:elbow"])
    sought = {effect.label or effect.name for effect in usable_effects((*select_effects(("all",)), *FREE_FORMS), study)}
    assert sought >= {"coulomb_friction", "free_friction.load"}
    assert not sought & {"backlash", "joint_compliance"}
    # a torque that depends on the very torque that is to be explained explains anything
    assert not sought & {"free_torque.load", "free_torque.command"}


def test_a_log_without_commands_is_fitted_from_the_shell(
    arm: Robot, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_log(moved({"dof_frictionloss": (0.4, 0.25, 0.05)}), tmp_path / "arm.parquet")
    code = run(["fit", "-m", str(arm.path), "-l", str(tmp_path / "arm.parquet"), "-f", "frictionloss:*"])
    shown = capsys.readouterr()
    assert code == 0
    assert "no command is logged" in shown.out
    assert "inverse dynamics" in shown.out
    assert "command.none" in shown.err
    assert "warning:" not in shown.err


def test_a_replay_of_a_log_without_commands_predicts_its_torques(
    arm: Robot, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_log(moved(), tmp_path / "arm.parquet")
    asked = ["replay", "-m", str(arm.path), "-l", str(tmp_path / "arm.parquet"), "--out", str(tmp_path / "out")]
    assert run(asked) == 0
    assert "effort error 3." in capsys.readouterr().out
    predicted = read_log(tmp_path / "out" / "arm.replayed.parquet")
    assert set(predicted.joints("effort")) == set(JOINTS)


def test_a_fit_of_a_model_that_lacks_something_says_so_first(arm: Robot) -> None:
    wrong = fit(study_of(arm, moved({"dof_frictionloss": (0.0, 0.25, 0.0)})), ["mass:hand"])
    assert wrong.misfit is not None
    assert (wrong.misfit.channel, wrong.misfit.joint) == ("effort", "elbow")
    assert wrong.message.startswith("the residual of the effort is ")
    assert wrong.to_dict()["misfit"]["times_noise"] == pytest.approx(wrong.before.train["effort"].chi2 ** 0.5)
    right = fit(study_of(arm, moved()), ["mass:hand"])
    assert right.misfit is None
    assert right.message.startswith("1 of 1 parameters")


def test_bounds_that_nobody_stated_grow_and_stated_ones_are_said(arm: Robot) -> None:
    heavy = mujoco.MjModel.from_xml_string(ARM)
    mass, inertia = heavy.body_mass.copy(), heavy.body_inertia.copy()
    mass[3], inertia[3] = 5 * mass[3], 5 * inertia[3]
    log = moved({"body_mass": mass, "body_inertia": inertia})
    found = fit(study_of(arm, log), ["mass:hand"]).estimates[0]
    assert found.value == pytest.approx(5.0, rel=0.01)
    assert found.bounds[1] == 15.0
    stated = replace(arm, bounds={"mass": (0.5, 3.0)})
    held = fit(study_of(stated, log), ["mass:hand"]).estimates[0]
    assert held.value == pytest.approx(3.0)
    assert held.at_bound
    assert held.identifiable != "no"
    assert held.reason == "the estimate lies on the stated bound 0.5 .. 3"


def test_noise_that_was_filtered_away_is_no_floor_and_can_be_stated(
    arm: Robot, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log = moved({"dof_frictionloss": (0.4, 0.25, 0.05)}, noise=(0.0, 0.0))
    floor = channel_noise(log, "effort.elbow")
    assert floor.method == "assumed"
    assert floor.sigma == pytest.approx(np.ptp(log.channels["effort.elbow"]) / 2**20 / np.sqrt(12))
    write_log(log, tmp_path / "arm.parquet")
    asked = ["fit", "-m", str(arm.path), "-l", str(tmp_path / "arm.parquet"), "-f", "frictionloss:*"]
    assert run([*asked, "--noise", "effort=0.02", "--noise", "position=2e-5"]) == 0
    shown = capsys.readouterr()
    assert "noise.filtered" not in shown.err
    # in the band that is compared a part of the stated noise is left
    assert "noise floor of 3." in shown.out.replace("\n", " ")
    assert run(asked) == 0
    assert "noise.filtered" in capsys.readouterr().err
    assert run([*asked, "--noise", "efort=0.02"]) == 2
    assert "did you mean effort?" in capsys.readouterr().err
    assert run([*asked, "--noise", "effort=0"]) == 2
    assert "above zero" in capsys.readouterr().err


def test_beside_a_torque_that_follows_time_friction_is_found(arm: Robot) -> None:
    """A cable that a robot winds up: parts of all of the log are held out."""
    log = moved({"dof_frictionloss": (0.0, 0.0, 0.08)})
    pulls = 0.6 * -np.expm1(-log.time / 5.0)
    changed = {**log.channels, "effort.elbow": log.channels["effort.elbow"] + pulls}
    found = close(study_of(arm, replace(log, channels=changed)), ["mass:hand"])
    assert found.verdict == "explained", found.message
    assert {(e.effect, e.where) for e in found.effects} == {
        ("free_torque", ("elbow",)),
        ("coulomb_friction", ("wrist",)),
    }
    assert "changes slowly with time at elbow" in found.message
    assert len(found.to_dict()["logs"][0]["held_out"][0]) > 1
