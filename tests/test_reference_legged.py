"""The robot in another engine: what any engine must agree on. Runs where drake is installed (extra `benchmarks`)."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("pydrake", reason="needs drake: pip install 'sysid-btr[benchmarks]'")

from reference_simulator.legged import DrakeRobot, Truth
from sysid_btr.btr.controllers import Controller
from sysid_btr.btr.gaits import NaoGait, SineGait
from sysid_btr.btr.robot import SILENT, HiddenRobot
from sysid_btr.btr.task import Walk
from sysid_btr.btr.world import make_world
from sysid_btr.models.builtin import load_robot
from sysid_btr.models.gait import ARMS, Gait, gait

NAO, TASK = load_robot("nao"), Walk(2.0)
JOINTS = NaoGait().joints
STANDING = gait(Gait(step_length=0.0, sway=0.0, step_height=0.0), np.zeros(1))
WAVE = SineGait(
    JOINTS,
    tuple(float(STANDING[joint][0]) for joint in JOINTS),
    tuple(0.3 if joint in ARMS else 1e-9 for joint in JOINTS),
    start_amplitude=1.0,
)
WAVING = Controller(WAVE.start)


def waved(truth: Truth = Truth()) -> dict[str, np.ndarray]:  # noqa: B008
    trial = DrakeRobot(NAO, TASK, WAVE, truth, SILENT).run(WAVING)
    assert trial.outcome == "done"
    assert trial.log is not None
    return dict(trial.log.channels)


def lag(late: np.ndarray, reference: np.ndarray) -> float:
    """By how many seconds one motion follows another."""
    speed = np.gradient(reference, TASK.period)
    return float(-(late - reference) @ speed / (speed @ speed))


def test_arms_move_as_in_the_model_and_feet_carry_the_weight() -> None:
    own = waved()
    model = HiddenRobot(make_world(NAO, TASK, (), threads=1), np.zeros(0), TASK, WAVE, SILENT).run(WAVING).log
    assert model is not None
    for joint in ARMS:
        # both engines answer to a command within their steps, 2 and 5 ms
        error = own[f"position.{joint}"] - model.channels[f"position.{joint}"]
        assert np.sqrt(np.mean(error**2)) < 0.03 * np.std(own[f"position.{joint}"])
        assert abs(lag(own[f"position.{joint}"], model.channels[f"position.{joint}"])) < 0.005
    force = sum(values for name, values in own.items() if name.startswith("force."))
    assert np.mean(force[25:]) == pytest.approx(float(NAO.model.body_mass.sum()) * 9.81, rel=0.02)
    assert np.mean(own["imu.acc_z"][25:]) == pytest.approx(9.81, rel=0.02)


def test_what_the_robot_has_beyond_its_model_acts() -> None:
    own, late = waved(), waved(Truth(delay=0.03))
    assert lag(late["position.HeadYaw"], own["position.HeadYaw"]) == pytest.approx(0.03, abs=0.004)
    rough = waved(Truth(friction={"HeadYaw": 0.5}))
    assert np.std(rough["position.HeadYaw"][50:]) < 0.95 * np.std(own["position.HeadYaw"][50:])
    np.testing.assert_allclose(rough["position.LElbowRoll"], own["position.LElbowRoll"], atol=2e-3)
    weak = waved(Truth(limit={"LShoulderPitch": 0.05}))
    assert np.std(weak["position.LShoulderPitch"]) < 0.7 * np.std(own["position.LShoulderPitch"])
    heavy = waved(Truth(payload={"Torso": (0.5, (0.0, 0.0, 0.05))}))
    force = [sum(v for n, v in log.items() if n.startswith("force.")) for log in (own, heavy)]
    assert np.mean(force[1][50:] - force[0][50:]) == pytest.approx(0.5 * 9.81, rel=0.1)
