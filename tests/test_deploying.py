"""What was identified, used elsewhere: compiled, drawn, as ranges, and played in plain MuJoCo."""

from __future__ import annotations

import json
import warnings
from pathlib import Path

import mujoco
import numpy as np
import pytest

import sysid_btr as sb
from sysid_btr.cli.demo import sample_logs
from sysid_btr.deploying import IncompleteModelWarning
from sysid_btr.diagnosis.closing import Closing
from sysid_btr.errors import UsageError
from sysid_btr.identify.study import make_study
from sysid_btr.io.log import Log
from sysid_btr.models.builtin import load_robot
from sysid_btr.player import Player
from sysid_btr.run_folder import Folder
from sysid_btr.simulation.numerics import Numerics
from sysid_btr.terms.grammar import parse_parameters
from sysid_btr.terms.model import Model
from sysid_btr.writeback.write import Identified, draft, save_model
from tests.toys import make_log

SAMPLES = sample_logs()


@pytest.fixture(scope="module")
def closed() -> Closing:
    log = sb.read_log(SAMPLES / "pendulum_friction.parquet").window(0, 500)
    study = sb.make_study(sb.load_robot(str(SAMPLES / "pendulum.xml")), [log], threads=1)
    return sb.close(study, ["mass:*", "kp:*"], effects=["coulomb_friction"])


@pytest.fixture(scope="module")
def folder(closed: Closing, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("run") / "out"
    sb.save(closed, out)
    return out


# --- models and draws ------------------------------------------------------------------------------------------


def test_the_compiled_model_is_the_written_one(closed: Closing, folder: Path) -> None:
    written = mujoco.MjModel.from_xml_path(str(folder / "model.xml"))
    for source in (closed, folder):
        model = sb.model(source)
        for field in ("body_mass", "dof_frictionloss", "actuator_gainprm", "actuator_biasprm", "dof_damping"):
            np.testing.assert_allclose(getattr(model, field), getattr(written, field), rtol=1e-12)
        assert model.opt.timestep == written.opt.timestep
        assert model.opt.integrator == written.opt.integrator


def test_a_draw_is_where_its_numbers_say(closed: Closing) -> None:
    friction = closed.effects[0].parameters[0]
    model = sb.model(closed, {friction.name: 0.5})
    assert model.dof_frictionloss[0] == pytest.approx(0.5)
    assert model.body_mass[1] == pytest.approx(sb.model(closed).body_mass[1])
    with pytest.raises(UsageError, match=r"no parameter mass:leg; the run has mass:arm"):
        sb.model(closed, {"mass:leg": 1.0})


def test_draws_scatter_as_the_estimates_are_known(closed: Closing, folder: Path) -> None:
    for source in (closed, folder):
        drawn = sb.sample(source, 4000, seed=1)
        assert drawn.names == tuple(e.name for e in closed.estimates)
        np.testing.assert_allclose(drawn.values.std(axis=0), [e.std for e in closed.estimates], rtol=0.06)
        np.testing.assert_allclose(np.corrcoef(drawn.values.T), closed.correlation, atol=0.06)
    np.testing.assert_array_equal(sb.sample(closed, 5, seed=3).values, sb.sample(folder, 5, seed=3).values)
    assert sb.sample(closed, 3)[0].keys() == dict.fromkeys(drawn.names).keys()
    assert drawn.to_pandas().shape == (4000, 3)
    assert np.all(drawn.values >= closed.model.terms.lower)


def test_what_is_not_identifiable_stays_and_says_so() -> None:
    log = sb.read_log(SAMPLES / "leg_clean.parquet").window(0, 300)
    study = sb.make_study(sb.load_robot(str(SAMPLES / "leg.xml")), [log], numerics=Numerics("RK4", 0.005), threads=1)
    found = sb.fit(study, ["kp:*=shared", "mass:HipRoll"])
    assert [e.identifiable for e in found.estimates] == ["yes", "no"]
    drawn = sb.sample(found, 20)
    assert drawn.fixed == ("mass:HipRoll",)
    assert np.ptp(drawn.values[:, 1]) == 0
    assert np.ptp(drawn.values[:, 0]) > 0


def test_ranges_hold_the_models_by_the_names_of_mujoco(closed: Closing) -> None:
    content = sb.ranges(closed, n=60)
    assert json.loads(json.dumps(content, allow_nan=False)) == content
    by_field = {(f["field"], f["name"], *f["index"]): f for f in content["fields"]}
    mass, friction = by_field["body_mass", "arm", 1], by_field["dof_frictionloss", "pendulum", 0]
    assert mass["low"] < mass["value"] < mass["high"]
    assert mass["nominal"] == pytest.approx(sb.load_robot(str(SAMPLES / "pendulum.xml")).model.body_mass[1])
    low, high = closed.effects[0].parameters[0].ci95
    assert (friction["low"], friction["high"]) == pytest.approx((low, high), abs=0.3 * (high - low))
    assert friction["nominal"] == 0
    assert all(hasattr(sb.model(closed), f["field"]) for f in content["fields"])
    drawn = [sb.model(closed, draw) for draw in sb.sample(closed, 60)]
    inside = [mass["low"] <= m.body_mass[1] <= mass["high"] for m in drawn]
    assert np.mean(inside) >= 0.9


def test_what_a_run_cannot_give_is_refused(folder: Path, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="give one or more"):
        sb.sample(folder, 0)
    with pytest.raises(UsageError, match="finished run"):
        sb.model(tmp_path)
    content = json.loads((folder / "result.json").read_text())
    content["logs"][0]["path"] = "gone.parquet"
    (tmp_path / "result.json").write_text(
        json.dumps(content | {"model": content["model"] | {"path": str(SAMPLES / "pendulum.xml")}})
    )
    (tmp_path / "params.json").write_text((folder / "params.json").read_text())
    with pytest.raises(UsageError, match=r"no longer at .*gone\.parquet"):
        sb.model(tmp_path)


# --- plain MuJoCo ------------------------------------------------------------------------------------------------

ARM = """
<mujoco model="arm">
  <worldbody>
    <body name="upper">
      <joint name="shoulder_pan_joint" axis="0 1 0" damping=".2" armature=".02"/>
      <geom type="box" size=".03 .03 .15" pos="0 0 -.15" mass=".8" contype="0" conaffinity="0"/>
      <body name="lower" pos="0 0 -.3">
        <joint name="elbow_joint" axis="0 1 0" damping=".2" armature=".02"/>
        <geom type="box" size=".02 .02 .12" pos="0 0 -.12" mass=".5" contype="0" conaffinity="0"/>
        <body name="hand" pos="0 0 -.24">
          <joint name="wrist_joint" axis="0 1 0" damping=".1" armature=".01"/>
          <geom type="box" size=".02 .02 .04" pos="0 0 -.04" mass=".2" contype="0" conaffinity="0"/>
        </body>
      </body>
    </body>
  </worldbody>
  <actuator>
    <position name="shoulder_pan" joint="shoulder_pan_joint" kp="40" kv="2"/>
    <position name="elbow" joint="elbow_joint" kp=".02" kv=".001" gear="40"/>
    <motor name="wrist" joint="wrist_joint" gear="20"/>
  </actuator>
</mujoco>
"""
"""Actuators are called otherwise than joints, as in most models of arms, and two are geared."""


def arm_log(period: float = 0.01) -> Log:
    time = np.arange(150) * period
    swing = np.sin(4 * time) * np.minimum(time, 0.5)
    channels = {
        "command.shoulder_pan_joint": 0.8 * swing,
        "command.elbow_joint": -1.2 * swing,
        "command.wrist_joint": 0.3 * swing,
    }
    channels |= {f"position.{j}": 0.1 + 0 * time for j in ("shoulder_pan_joint", "elbow_joint", "wrist_joint")}
    return make_log(time, channels, sample_period=period)


def identified_arm(tmp_path: Path, expressions: list[str], values: list[float], numerics: Numerics) -> Identified:
    (tmp_path / "arm.xml").write_text(ARM)
    study = make_study(load_robot(str(tmp_path / "arm.xml")), [arm_log()], numerics=numerics, threads=1)
    terms = parse_parameters(expressions, study.robot, study.scales)
    return Identified(study, Model.of(terms, values), ())


def test_an_arm_with_other_names_gears_and_effects_moves_as_replayed(tmp_path: Path) -> None:
    numerics = Numerics("implicitfast", 0.005)
    free = [
        "kp:*",
        "coulomb_friction:elbow_joint",
        "command_delay:shoulder_pan_joint,elbow_joint",
        "backlash:elbow_joint",
    ]
    known = identified_arm(tmp_path, free, [0.9, 1.1, 0.2, 0.013, 0.021, 0.02, 0.002], numerics=numerics)
    save_model(Folder(tmp_path), draft(known))
    predicted = sb.replay_log(known.study.robot, arm_log(), known.model, numerics=numerics, threads=1)
    played = Player.load(tmp_path / "model.xml").play(arm_log())
    moved = 0.0
    for joint in ("shoulder_pan_joint", "elbow_joint", "wrist_joint"):
        name = f"position.{joint}"
        np.testing.assert_allclose(played.channels[name], predicted.channels[name], atol=1e-9)
        moved = max(moved, float(np.ptp(played.channels[name])))
    assert moved > 0.3


def test_commands_are_sent_by_joint_or_by_actuator(tmp_path: Path) -> None:
    (tmp_path / "arm.xml").write_text(ARM)
    by_joint, by_actuator = (Player.load(tmp_path / "arm.xml") for _ in range(2))
    by_joint.reset({"elbow_joint": 0.2})
    by_actuator.reset({"elbow_joint": 0.2})
    assert by_joint.positions["elbow_joint"] == pytest.approx(0.2)
    assert by_joint.data.ctrl[1] == pytest.approx(0.2 * 40)  # the servo holds its joint where it starts
    by_joint.send({"elbow_joint": 0.5, "wrist_joint": 0.1})
    by_actuator.send({"elbow": 0.5 * 40, "wrist": 0.1 / 20})
    by_joint.step(0.3)
    by_actuator.step(0.3)
    assert by_joint.positions == pytest.approx(by_actuator.positions, rel=1e-9)
    assert by_joint.velocities["elbow_joint"] != 0
    with pytest.raises(UsageError, match="did you mean elbow_joint"):
        by_joint.send({"elbow_join": 0.1})


def test_what_is_fed_forward_acts_as_in_a_replay(tmp_path: Path) -> None:
    (tmp_path / "arm.xml").write_text(ARM)
    robot, log = load_robot(str(tmp_path / "arm.xml")), arm_log()
    fed = {
        "command_velocity.elbow_joint": np.cos(4 * log.time),
        "command_effort.shoulder_pan_joint": np.sin(3 * log.time),
    }
    log = make_log(log.time, {**log.channels, **fed}, sample_period=0.01)
    numerics = Numerics("RK4", 0.005)
    predicted = sb.replay_log(robot, log, numerics=numerics, threads=1)
    model = robot.compile()
    model.opt.timestep, model.opt.integrator = 0.005, mujoco.mjtIntegrator.mjINT_RK4
    played = Player.of(model).play(log)
    for name in ("position.elbow_joint", "position.shoulder_pan_joint"):
        np.testing.assert_allclose(played.channels[name], predicted.channels[name], atol=1e-9)


def test_a_player_says_what_of_the_run_it_does_not_play(folder: Path, tmp_path: Path) -> None:
    assert Player.load(folder).missing == ()
    content = json.loads((folder / "result.json").read_text())
    lost = {
        "name": "load_friction",
        "variant": "",
        "where": ["pendulum"],
        "held": "no",
        "how": "a law of every time step",
    }
    content["written"]["not_in_file"] = [{**lost, "text": "load friction at pendulum", "loss_without": None}]
    (tmp_path / "result.json").write_text(json.dumps(content))
    (tmp_path / "model.xml").write_text((folder / "model.xml").read_text())
    assert Player.load(tmp_path).missing == ("load friction at pendulum",)
    content["written"] = {"path": None, "why": "a mesh is gone"}
    (tmp_path / "result.json").write_text(json.dumps(content))
    with pytest.raises(UsageError, match="a mesh is gone"):
        Player.load(tmp_path)
    with pytest.raises(UsageError, match="no such file"):
        Player.load(tmp_path / "nothing.xml")


def test_a_warning_names_what_a_compiled_model_lacks(closed: Closing, monkeypatch: pytest.MonkeyPatch) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        sb.model(closed)
    from sysid_btr.writeback import native

    monkeypatch.setitem(native.NATIVE, type(closed.model.terms[2]), lambda *_: (None, "no", "a law of every time step"))  # type: ignore[index]
    with pytest.warns(IncompleteModelWarning, match="coulomb_friction at pendulum: a law of every time step"):
        sb.model(closed)


# --- for the user's own step -----------------------------------------------------------------------------------------


def test_a_model_for_a_step_fits_best_in_it(tmp_path: Path) -> None:
    log = sb.read_log(SAMPLES / "leg_friction.parquet").window(0, 400)
    robot, coarse = load_robot(str(SAMPLES / "leg.xml")), Numerics.parse("implicitfast:0.01")
    free = ["kp:*=shared", "kv:*=shared", "frictionloss:KneePitch"]
    exact, own = (sb.fit(make_study(robot, [log], numerics=n, threads=1), free) for n in (None, coarse))
    assert own.study.numerics == coarse
    np.testing.assert_array_equal(own.numerics_shift, 0.0)
    there = own.study.train_problem(own.model)
    foreign, native = there.loss(np.stack([exact.values, own.values]))
    assert native < 0.9 * foreign
    written = save_model(Folder(tmp_path), draft(Identified(own.study, own.model, own.estimates)))
    assert written["reproduces"]
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "model.xml"))
    assert (model.opt.timestep, model.opt.integrator) == (0.01, mujoco.mjtIntegrator.mjINT_IMPLICITFAST)
    assert own.to_dict()["numerics"]["stated"] is True


@pytest.mark.parametrize("text", ["implicitfast", "rk45:0.002", "RK4:2 ms", "Euler:0", "Euler:5"])
def test_what_is_no_integrator_and_step_is_refused(text: str) -> None:
    with pytest.raises(UsageError, match=r"implicitfast:0\.002"):
        Numerics.parse(text)
    assert Numerics.parse("rk4:0.005") == Numerics("RK4", 0.005, stated=True)
