"""Torques of candidates, put together of parts, are those that MuJoCo finds of each candidate's model."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path

import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sysid_btr.io.log import Log, LogMeta
from sysid_btr.models.actuation import with_motors
from sysid_btr.models.robot import robot_from_file
from sysid_btr.simulation.inverse import InverseReplay
from sysid_btr.simulation.kinematics import Kinematics
from sysid_btr.simulation.numerics import Numerics
from sysid_btr.simulation.setup import Values
from sysid_btr.terms.base import BatchModel, Fields
from sysid_btr.terms.grammar import parse_parameters
from sysid_btr.terms.model import Terms

SAMPLES = 24
LINE = """<mujoco><compiler angle="radian"/><option timestep="0.001"{option}/><worldbody>
<body name="rail" quat="0.9 0.1 0.3 -0.2"><joint name="slide" type="slide" axis="1 0 0.2" armature="0.7"/>
<inertial mass="2" pos="0.1 0 0.05" quat="0.8 0.6 0 0" diaginertia="0.05 0.04 0.03"/>
<body name="arm" pos="0 0.1 0.3" quat="0.7 0 0.7 0.1"><joint name="hinge" axis="0 1 0" stiffness="2" springref="0.3"/>
<inertial mass="1" pos="0 0.02 0.2" diaginertia="0.02 0.02 0.004"/>
<body name="hand" pos="0.05 0 0.4"{hand}><joint name="wrist" axis="0 0.6 0.8" damping="0.2" armature="0.01"/>
<geom type="box" size="0.02 0.03 0.05" mass="0.4"/></body></body></body>
<body name="cart" pos="1 0 0"><joint name="cart" type="slide" axis="0 0 1" armature="2"/><geom size="0.1" mass="3"/>
</body></worldbody>
<tendon><fixed name="sum" damping="0.1" armature="0.02" stiffness="0.5"><joint joint="hinge" coef="1"/>
<joint joint="wrist" coef="-2"/></fixed></tendon></mujoco>"""
LEG = """<mujoco><compiler angle="radian"/><option timestep="0.001"/><worldbody>
<site name="wall" pos="0.5 0 0"/>
<body name="thigh"><joint name="hip" axis="0 1 0" armature="0.1"/><joint name="turn" axis="0 0 1"/>
<inertial mass="4" pos="0 0.03 -0.2" diaginertia="0.05 0.05 0.01"/>
<body name="shin" pos="0 0 -0.4"><joint name="knee" axis="0 1 0"/><inertial mass="2" pos="0 0 -0.2"
 diaginertia="0.02 0.02 0.002"/><site name="heel" pos="0.02 0 -0.4"/></body></body></worldbody>
<tendon><spatial name="rope" stiffness="30" damping="2" armature="0.3"><site site="wall"/><site site="heel"/></spatial>
</tendon></mujoco>"""
PLAIN, HELD, WET = (
    LINE.format(option="", hand=""),
    LINE.format(option="", hand=' gravcomp="0.7"'),
    LINE.format(option=' density="900" viscosity="0.5"', hand=""),
)
SPRINGS = ("jnt_stiffness", "jnt_stiffnesspoly", "qpos_spring", "dof_damping", "dof_dampingpoly", "dof_armature")
TENDONS = ("tendon_armature", "tendon_damping", "tendon_dampingpoly", "tendon_stiffness")


@dataclass(frozen=True)
class Changed(InverseReplay):
    """Candidates with any fields."""

    changes: Fields = field(default_factory=dict)

    def batch(self, pairs: Values, size: int) -> BatchModel:
        batch = super().batch(pairs, size)
        batch.write(self.changes)
        return batch


@pytest.fixture(scope="module")
def replay_of(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Changed]:
    """Of a robot by its text, on a motion of nothing but noise."""
    made: dict[str, Changed] = {}

    def make(text: str) -> Changed:
        if text not in made:
            path = tmp_path_factory.mktemp("robot") / "robot.xml"
            path.write_text(text)
            robot = robot_from_file(path)
            joints = tuple(robot.model.joint(i).name for i in range(robot.model.njnt))
            motion = noise(len(joints))
            channels = {f"position.{j}": motion.position[:, k] for k, j in enumerate(joints)}
            log = Log(motion.time, channels, LogMeta(sample_period=0.01), np.zeros(SAMPLES, dtype=np.int64))
            numerics = Numerics("implicitfast", 0.001)
            made[text] = Changed(robot, log, (), numerics, effort=True, threads=1, kinematics=motion)
        return made[text]

    return make


def noise(joints: int) -> Kinematics:
    rng = np.random.default_rng(0)
    position, velocity, acceleration = rng.normal(size=(3, SAMPLES, joints)) * np.array([0.7, 2.0, 9.0])[:, None, None]
    time = 0.01 * np.arange(SAMPLES)
    return Kinematics(time, position, velocity, acceleration, np.full(joints, 1e-6), band=1e3)


def asked(replay: Changed, changes: Fields) -> np.ndarray:
    """Torques (m, n, j) of candidates."""
    found = replace(replay, changes=changes).predict(np.zeros((len(next(iter(changes.values()))), 0))).effort
    assert found is not None
    return found


def by_mujoco(replay: Changed, changes: Fields, candidate: int) -> np.ndarray:
    """Torques (n, j) by MuJoCo's inverse dynamics."""
    model = BatchModel(replay.model, replay.index, 0.001, candidate + 1, changes).candidate(candidate)
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    data, motion, torque = mujoco.MjData(model), replay.motion, []
    for q, v, a in zip(motion.position, motion.velocity, motion.acceleration, strict=True):
        data.qpos[:], data.qvel[:], data.qacc[:] = q, v, a
        mujoco.mj_inverse(model, data)
        torque.append(data.qfrc_inverse.copy())
    return np.array(torque)


def changed(replay: Changed, rng: np.random.Generator, names: tuple[str, ...], size: int = 3) -> Fields:
    """Fields of candidates, inertial ones of some bodies and any of springs, dampers and rotors by name."""
    model, batch = replay.model, BatchModel(replay.model, replay.index, 0.001, size)
    some = rng.random((size, model.nbody)) < 0.6
    scale = np.where(some, rng.uniform(0.2, 3.0, (size, model.nbody)), 1.0)
    free = some & (model.body_simple == 0)
    turned = rng.normal(size=(size, model.nbody, 4))
    turned /= np.linalg.norm(turned, axis=2, keepdims=True)
    fields = {
        "body_mass": batch.read("body_mass") * scale,
        "body_inertia": batch.read("body_inertia") * rng.uniform(0.5, 2.0, (size, model.nbody, 3)),
        "body_ipos": batch.read("body_ipos") + free[:, :, None] * rng.normal(0, 0.1, (size, model.nbody, 3)),
        "body_iquat": np.where(free[:, :, None], turned, batch.read("body_iquat")),
    }
    for name in names:
        own = batch.read(name)
        fields[name] = own + rng.uniform(0, 1, own.shape) * (rng.random(own.shape) < 0.5)
    return fields


def assert_alike(replay: Changed, changes: Fields) -> None:
    found = asked(replay, changes)
    for i, torque in enumerate(found):
        right = by_mujoco(replay, changes, i)
        np.testing.assert_allclose(torque, right, rtol=1e-10, atol=1e-11 * np.abs(right).max())


@pytest.mark.parametrize("text", [PLAIN, LEG, HELD, WET], ids=["line", "leg", "gravity compensated", "in water"])
@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 10**6), names=st.sets(st.sampled_from((*SPRINGS, *TENDONS))))
def test_torques_are_those_of_each_candidates_own_model(
    replay_of: Callable[[str], Changed], text: str, seed: int, names: set[str]
) -> None:
    replay = replay_of(text)
    assert_alike(replay, changed(replay, np.random.default_rng(seed), tuple(sorted(names))))


@pytest.mark.parametrize("name", ["body_pos", "body_quat", "opt.gravity", "jnt_axis"])
def test_bodies_that_hang_together_otherwise_are_computed_anew(replay_of: Callable[[str], Changed], name: str) -> None:
    replay, rng = replay_of(LEG), np.random.default_rng(1)
    changes = changed(replay, rng, ())
    own = BatchModel(replay.model, replay.index, 0.001, 3).read(name)
    changes[name] = own + np.array([0.0, 0.1, -0.2]).reshape(-1, *(1,) * (own.ndim - 1)) * rng.normal(size=own.shape)
    if name in ("body_quat", "jnt_axis"):
        changes[name] /= np.linalg.norm(changes[name], axis=-1, keepdims=True)
    assert_alike(replay, changes)


def test_candidates_with_other_masses_ask_mujoco_of_one_model(
    replay_of: Callable[[str], Changed], monkeypatch: pytest.MonkeyPatch
) -> None:
    replay, calls = replay_of(PLAIN), []
    original = InverseReplay._of_one
    replay = replace(replay, kinematics=noise(len(replay.index.joints)))
    monkeypatch.setattr(InverseReplay, "_of_one", lambda self, model: calls.append(1) or original(self, model))
    rng = np.random.default_rng(2)
    asked(replay, changed(replay, rng, SPRINGS, size=8))
    first = len(calls)
    asked(replay, changed(replay, rng, (*SPRINGS, "tendon_armature", "tendon_damping"), size=8))
    # the model itself, and the probes of four bodies of which one is simple
    assert first <= 1 + 3 * 11 + 5
    assert len(calls) == first


def test_a_candidate_does_not_depend_on_those_beside_it(replay_of: Callable[[str], Changed]) -> None:
    replay = replay_of(PLAIN)
    changes = changed(replay, np.random.default_rng(3), (*SPRINGS, *TENDONS), size=5)
    together = asked(replay, changes)
    for i, torque in enumerate(together):
        np.testing.assert_array_equal(asked(replay, {name: v[i : i + 1] for name, v in changes.items()})[0], torque)


@pytest.mark.parametrize("bit", ["mjDSBL_DAMPER", "mjDSBL_SPRING"])
def test_what_a_model_turns_off_takes_nothing(replay_of: Callable[[str], Changed], bit: str) -> None:
    word = {"mjDSBL_DAMPER": "damper", "mjDSBL_SPRING": "spring"}[bit]
    replay = replay_of(PLAIN.replace('timestep="0.001"/>', f'timestep="0.001"><flag {word}="disable"/></option>'))
    assert replay.model.opt.disableflags & int(getattr(mujoco.mjtDisableBit, bit))
    assert_alike(replay, changed(replay, np.random.default_rng(4), (*SPRINGS, *TENDONS)))


@pytest.mark.parametrize("expression", ["load_friction", "load_friction.larger", "load_friction.power"])
def test_friction_that_follows_a_torque_is_that_of_the_torque_which_it_makes(tmp_path: Path, expression: str) -> None:
    """Found for all samples at once; beside a law that joins drives, sample by sample."""
    (tmp_path / "robot.xml").write_text(LEG.split("<tendon>")[0] + "</mujoco>")
    robot = with_motors(robot_from_file(tmp_path / "robot.xml"))
    joints = ("hip", "turn", "knee")
    motion = noise(3)
    channels = {f"position.{j}": motion.position[:, k] for k, j in enumerate(joints)}
    log = Log(motion.time, channels, LogMeta(sample_period=0.01), np.zeros(SAMPLES, dtype=np.int64))

    def torque(*expressions: str, values: list[float]) -> np.ndarray:
        terms = Terms(parse_parameters(list(expressions), robot))
        numerics = Numerics("implicitfast", 0.001)
        replay = InverseReplay(robot, log, tuple(terms), numerics, effort=True, threads=1, kinematics=motion)
        found = replay.predict(np.array([values])).effort
        assert found is not None
        return found[0]

    smooth = torque("damping:*=shared", values=[0.0])
    power = expression.endswith("power")
    amounts = [0.4, 0.6] if power else [0.3]
    found = torque(f"{expression}:*=shared", values=amounts)
    load = np.abs(found) ** amounts[-1] if power else np.abs(found)
    if expression.endswith("larger"):
        load = np.maximum(load, np.abs(smooth))
    made = smooth + amounts[0] * load * motion.direction
    # where friction turns a torque round, several torques are right, and none may be found
    clear = np.abs(smooth) > 1.0
    assert clear.mean() > 0.5
    np.testing.assert_allclose(found[clear], made[clear], rtol=1e-5)
    assert np.abs(found - smooth).max() > 0.1
    beside = torque(f"{expression}:*=shared", "voltage_sag.time:robot", values=[*amounts, 0.0])
    np.testing.assert_allclose(beside[clear], found[clear], rtol=1e-6)
