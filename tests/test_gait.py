"""The built-in walk: it keeps Nao on its feet, goes where it is told to, and its legs close."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sysid_btr.errors import UsageError
from sysid_btr.models.builtin import load_robot
from sysid_btr.models.gait import Gait, gait, leg_angles

PERIOD = 0.02


def walk(parameters: Gait, seconds: float) -> tuple[np.ndarray, np.ndarray]:
    """Tilt (n,) and position (n, 3) of the torso of the built-in Nao on its floor."""
    spec = load_robot("nao").make_spec()
    spec.option.timestep = 0.005
    model = spec.compile()
    data = mujoco.MjData(model)
    time = np.arange(0, seconds, PERIOD)
    commands = gait(parameters, time)
    names = [model.actuator(i).name for i in range(model.nu)]
    for name in names:
        data.qpos[model.jnt_qposadr[model.joint(name).id]] = commands[name][0]
    mujoco.mj_forward(model, data)
    soles = [data.body(f"{s}AnkleRoll").xpos[2] - 0.05 for s in "LR"]
    data.qpos[2] -= min(soles)
    tilt, position = np.empty(len(time)), np.empty((len(time), 3))
    for k in range(len(time)):
        data.ctrl[:] = [commands[n][k] for n in names]
        mujoco.mj_step(model, data, round(PERIOD / model.opt.timestep))
        tilt[k] = np.arccos(np.clip(data.body("Torso").xmat[8], -1, 1))
        position[k] = data.body("Torso").xpos
    return tilt, position


def test_the_default_walk_goes_forward_and_stays_upright() -> None:
    tilt, position = walk(Gait(), 15.0)
    assert tilt.max() < 0.15
    assert position[-1, 0] > 0.15
    assert np.ptp(position[:, 2]) < 0.03


def test_a_negative_step_goes_backward() -> None:
    tilt, position = walk(Gait(step_length=-0.02), 10.0)
    assert tilt.max() < 0.15
    assert position[-1, 0] < -0.1


def test_it_commands_every_joint_of_nao_smoothly_and_within_its_limits() -> None:
    model = load_robot("nao").compile()
    time = np.arange(0, 6, 0.005)
    commands = gait(Gait(), time)
    assert set(commands) == {model.actuator(i).name for i in range(model.nu)}
    for name, values in commands.items():
        low, high = model.jnt_range[model.joint(name).id]
        assert values.shape == time.shape
        assert low - 0.02 <= values.min() <= values.max() <= high + 0.02, name
        assert np.abs(np.diff(values)).max() / 0.005 < 6.4, name  # no-load speed of the leg motors


def test_it_begins_from_standing_still() -> None:
    for values in gait(Gait(), np.linspace(0, 0.9, 10)).values():
        assert np.ptp(values) == 0


@given(st.floats(-0.04, 0.04), st.floats(-0.05, 0.05), st.floats(-0.2, -0.15))
def test_leg_angles_put_the_ankle_where_it_was_asked_for(x: float, y: float, z: float) -> None:
    model = load_robot("nao").compile()
    data = mujoco.MjData(model)
    for name, angle in leg_angles(np.array(x), np.array(y), np.array(z)).items():
        data.qpos[model.jnt_qposadr[model.joint("L" + name).id]] = angle
    mujoco.mj_kinematics(model, data)
    ankle = data.body("LAnkleRoll").xpos - data.body("LHipPitch").xpos
    assert ankle == pytest.approx([x, y, z], abs=1e-9)
    assert data.body("LAnkleRoll").xmat.reshape(3, 3)[2, 2] == pytest.approx(1, abs=1e-12)


@pytest.mark.parametrize("wrong", [{"period": 0.1}, {"crouch": 0.0}, {"step_height": -0.01}, {"sway": -0.1}])
def test_impossible_parameters_are_refused(wrong: dict[str, float]) -> None:
    with pytest.raises(UsageError, match="gait"):
        Gait(**wrong)


def test_a_step_longer_than_the_legs_is_refused() -> None:
    with pytest.raises(UsageError, match="shorter steps"):
        gait(Gait(step_length=0.3), np.arange(0, 5, 0.02))
