"""Robots of other drives than a humanoid's servos come to the right answer; the suite's judge and its baseline."""

from __future__ import annotations

import functools
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks.robots.judge import judge
from benchmarks.robots.planted import DryFriction, Late, Planted
from benchmarks.robots.regression import regress
from benchmarks.robots.suite import Case, cases
from sysid_btr.diagnosis.close import close
from sysid_btr.floating_base.standing import StandingEpisode
from sysid_btr.identify.inverse import InverseEpisode
from sysid_btr.identify.study import make_study
from sysid_btr.io.log import Log
from sysid_btr.models.robot import Robot, robot_from_file

SUITE = {case.name: case for case in cases()}


@functools.cache
def short(name: str) -> tuple[Case, Log]:
    """A case of the suite with six seconds of its log."""
    case = SUITE[name]
    case = replace(case, experiment=replace(case.experiment, seconds=6.0))
    return case, case.log()


def nominal(case: Case, folder: Path) -> Robot:
    place = folder / f"{case.name}.xml"
    place.write_text(case.model)
    return robot_from_file(place)


@pytest.mark.parametrize("name", ["no_command", "impedance_leg", "torque_sensor"])
def test_another_drive_comes_to_the_right_answer(name: str, tmp_path: Path) -> None:
    """Friction without a command, a rotor behind kp, kd and tau, a torque sensor's offset; few rivals, short logs."""
    case, log = short(name)
    study = make_study(nominal(case, tmp_path), [log], threads=1)
    rivals = ("coulomb_friction", "viscous_damping", "armature", "command_delay", "torque_offset", "encoder_offset")
    found = close(study, ["mass:*"], effects=rivals)
    answer = judge(found.to_dict(), case.planted, case.alike)
    assert answer.answer == "right", (answer, found.message)


def test_a_robot_that_stands_needs_no_inertial_unit(tmp_path: Path) -> None:
    """It stands on its soles and waves its arms."""
    case, log = short("standing")
    study = make_study(nominal(case, tmp_path), [log], threads=1)
    (episode,) = study.train
    assert isinstance(episode, StandingEpisode)
    assert any("no inertial unit" in text for text in episode.base.lost)
    # its trunk leans by what hips, knees and ankles give, not more
    assert episode.base.tilt.max() < 0.15
    arms = ["mass:*_hand", "kp:*=shared"]
    found = close(study, arms, effects=("coulomb_friction", "viscous_damping", "armature"))
    answer = judge(found.to_dict(), case.planted, case.alike)
    assert answer.answer == "right", (answer, found.message)


def test_friction_beyond_the_torque_of_the_plain_model_is_found(tmp_path: Path) -> None:
    """A tendon closes two fingers: what holds them is more than the plain model's drive ever gives at a finger."""
    case, log = short("tendon_gripper")
    study = make_study(nominal(case, tmp_path), [log], threads=1)
    found = close(study, ["mass:*"], effects=("coulomb_friction", "viscous_damping", "command_delay"))
    assert found.verdict in ("explained", "partly_explained"), found.message
    # names and amounts: the friction that was planted is smooth, and a trace of that is left
    answer = judge(found.to_dict() | {"verdict": "explained"}, case.planted, case.alike)
    assert answer.answer == "right", (answer, found.message)
    held = study.scales["left"].counter_peak + study.scales["right"].counter_peak
    assert sum(p.value for e in found.effects for p in e.parameters) > held


def test_the_suite_has_what_it_says() -> None:
    assert len(SUITE) >= 12
    assert sum(not case.planted for case in SUITE.values()) >= 2
    case = replace(SUITE["cart_pole"], experiment=replace(SUITE["cart_pole"].experiment, seconds=0.4))
    first, again = case.log(), case.log()
    assert first.content == again.content
    assert set(first.channels) == {"command.rail", "position.rail", "position.pivot"}


def named(effect: str, *places: str, kind: str, value: float, verdict: str = "explained") -> dict[str, Any]:
    entry = {
        "effect": effect,
        "where": list(places),
        "parameters": [{"name": f"{effect}.{kind}:{place}", "value": value} for place in places],
        "confused_with": [],
    }
    return {"verdict": verdict, "effects": [entry]}


NOTHING: dict[str, Any] = {"verdict": "nothing_missing", "effects": []}
FRICTION = DryFriction(("a",), 0.5)
PAIR = DryFriction(("a", "b"), 0.5)


@pytest.mark.parametrize(
    ("result", "planted", "alike", "answer"),
    [
        (NOTHING, (), (), "right"),
        (NOTHING, (FRICTION,), (), "not right"),
        (NOTHING | {"verdict": "unexplained"}, (), (), "not right"),
        (named("coulomb_friction", "a", kind="torque", value=0.55), (FRICTION,), (), "right"),
        (named("coulomb_friction", "a", kind="torque", value=0.6), (FRICTION,), (), "not right"),
        (named("coulomb_friction", "a", kind="torque", value=0.5, verdict="ambiguous"), (FRICTION,), (), "not right"),
        (named("coulomb_friction", "b", kind="torque", value=0.5), (FRICTION,), (), "wrong"),
        (named("coulomb_friction", "a", "b", kind="torque", value=0.5), (FRICTION,), (), "wrong"),
        (named("viscous_damping", "a", kind="b", value=0.5), (FRICTION,), (), "wrong"),
        (named("coulomb_friction", "a", kind="torque", value=0.5), (), (), "wrong"),
        (named("coulomb_friction", "a", kind="torque", value=0.5), (PAIR,), (), "not right"),
        (named("coulomb_friction", "a", kind="torque", value=1.0), (PAIR,), ("a", "b"), "right"),
        (named("coulomb_friction", "a", "b", kind="torque", value=0.5), (PAIR,), ("a", "b"), "right"),
        (named("command_delay", "robot", kind="time", value=0.03), (Late(("a", "b"), 0.03),), (), "right"),
    ],
)
def test_what_counts_as_right(
    result: dict[str, Any], planted: tuple[Planted, ...], alike: tuple[str, ...], answer: str
) -> None:
    assert judge(result, planted, frozenset(alike)).answer == answer


def test_the_regression_knows_friction_and_predicts_to_the_noise(tmp_path: Path) -> None:
    case, log = short("no_command")
    fitted, held = InverseEpisode.split(nominal(case, tmp_path), log, 0.3)
    found = regress(fitted, held)
    for joint in ("shoulder", "elbow"):
        assert found.friction[f"coulomb:{joint}"] == pytest.approx(0.8, rel=0.1)
    rms = {j: float(np.sqrt(np.mean(log.channels[f"effort.{j}"] ** 2))) for j in found.joints}
    assert all(error < 0.01 * rms[j] for j, error in found.joints.items() if j != "wrist"), found.joints
