"""What a log is said to be able to tell, and what it then tells."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import numpy as np
import pytest
from terminal import Cli

import sysid_btr as sb
from sysid_btr.checking import ODDS, LogCheck
from sysid_btr.cli.demo import sample_logs
from sysid_btr.errors import UsageError
from sysid_btr.identify.study import make_study
from sysid_btr.io.log import Log
from sysid_btr.models.robot import Robot
from sysid_btr.simulation.numerics import Numerics
from sysid_btr.terms.model import Model
from tests.toys import LEG, leg, robot_from_xml, swing

SAMPLES = sample_logs()
NOISE = 5e-4
JOINTS = ("hip", "knee", "ankle")
ASKED = ["mass:knee", "kp:*=shared"]


def recorded(robot: Robot, seed: int = 0, seconds: float = 4.0, **changes: float) -> Log:
    """What encoders of a robot show that is as the model but for some changes."""
    commands = swing(JOINTS, seconds=seconds)
    replayed = sb.replay_log(robot, commands, changes, numerics=Numerics("RK4", 0.005), threads=1)
    rng = np.random.default_rng(seed)
    channels = dict(commands.channels)
    for joint in JOINTS:
        own = replayed.channels[f"position.{joint}"]
        channels[f"position.{joint}"] = own + NOISE * rng.normal(size=len(own))
    return replace(commands, channels=channels, meta=replace(commands.meta, noise={"position": NOISE}))


@pytest.fixture(scope="module")
def checked() -> LogCheck:
    robot = leg()
    asked = ["coulomb_friction", "viscous_damping", "armature", "constant_force", "joint_spring", "command_delay"]
    return sb.check(robot, [recorded(robot)], ASKED, effects=asked, threads=1)


def test_parameters_are_known_as_well_as_was_foretold(checked: LogCheck) -> None:
    robot = leg()
    fits = [
        sb.fit(make_study(robot, [recorded(robot, seed)], holdout=[recorded(robot, 99)], threads=1), ASKED)
        for seed in range(4)
    ]
    for k, foretold in enumerate(checked.parameters):
        off = np.array([f.estimates[k].value for f in fits]) - 1.0
        assert foretold.identifiable == "yes"
        assert np.sqrt(np.mean(off**2)) < 3 * foretold.std
        assert np.median([f.estimates[k].std for f in fits]) == pytest.approx(foretold.std, rel=0.5)


@pytest.mark.parametrize("effect", ["coulomb_friction", "command_delay"])
def test_what_would_show_does_and_what_would_not_does_not(checked: LogCheck, effect: str) -> None:
    [one] = [e for e in checked.effects if (e.effect, e.where) == (effect, "knee")]
    assert one.shows_from is not None
    robot = leg()
    log_odds = {}
    for factor in (3.0, 1 / 3):
        logs = [recorded(robot, 1, **{f"{effect}:knee": factor * one.shows_from})]
        study = make_study(robot, logs, holdout=logs, numerics=Numerics("RK4", 0.005), threads=1)
        terms = study.declare([*ASKED, f"{effect}:knee"])
        without, with_it = (sb.fit(study, list(t)) for t in (terms[:2], terms))
        losses = [study.train_problem(f.model).loss(f.values[None])[0] for f in (without, with_it)]
        count = study.train_problem(Model.of(())).count
        log_odds[factor] = 0.5 * (losses[0] - losses[1] - math.log(count))
    assert log_odds[3.0] > math.log(ODDS)
    assert log_odds[1 / 3] < math.log(ODDS)


def test_an_effect_of_several_numbers_is_sized_by_the_one_that_shows() -> None:
    robot = leg()
    asked = ["gravity_tilt", "stribeck_friction", "payload", "com_offset", "kp"]
    found = sb.check(robot, [recorded(robot, seconds=2.0)], ["mass:knee"], effects=asked, threads=1)
    units = {e.effect: e.unit for e in found.effects}
    assert units == {"gravity_tilt": "rad", "stribeck_friction": "Nm", "payload": "kg", "com_offset": "m", "kp": "1"}
    for one in found.effects:
        assert one.size is None or one.size > 0, one
        if one.effect == "kp":  # a factor: what leaves the model as it is is one
            assert one.nominal == 1
            assert one.size == pytest.approx(abs(one.shows_from - 1))


def test_twins_are_said_to_be_confounded(checked: LogCheck) -> None:
    by_name = {(e.effect, e.where): e for e in checked.effects}
    assert {e.where for e in checked.effects} == set(JOINTS)
    for (name, joint), one in by_name.items():
        for other in one.confounded_with:
            assert name in by_name[other, joint].confounded_with
    # under a stiff servo a late command and damping hardly differ; dry friction, which turns with the motion, does
    assert "viscous_damping" in by_name["command_delay", "knee"].confounded_with
    assert by_name["coulomb_friction", "knee"].confounded_with == ()


def test_limits_and_ranges_are_counted() -> None:
    tight = robot_from_xml(
        LEG.replace('name="knee" joint="knee" kp="20"', 'name="knee" joint="knee" forcerange="-.3 .3" kp="20"')
    )
    found = sb.check(tight, [recorded(leg(), seconds=2.0)], ASKED, effects=["armature"], threads=1)
    joints = {j.joint: j for j in found.joints}
    assert joints["knee"].saturated > 0
    assert joints["hip"].saturated == 0
    assert "knee reaches its torque limit" in found.message
    assert joints["hip"].beyond == 0
    assert any("at its limit" in line for line in found.advice)


def test_what_the_log_cannot_tell_comes_with_a_motion_that_would(cli: Cli) -> None:
    asked = (
        "--model",
        SAMPLES / "leg.xml",
        "--log",
        SAMPLES / "leg_clean.parquet",
        "--fit",
        "mass:HipRoll",
        "--threads",
        "1",
    )
    answer = cli("check", *asked, "--effects", "coulomb_friction", "--json")
    assert answer.code == 0, answer.err
    content = json.loads(answer.out)
    [mass] = content["parameters"]
    assert mass["identifiable"] == "no"
    assert "sysid-btr excite" in content["advice"][0]
    assert all(e["shows_from"] < 0.1 for e in content["effects"])


def test_the_verb_prints_joints_parameters_and_effects(cli: Cli) -> None:
    asked = ("--model", SAMPLES / "pendulum.xml", "--log", SAMPLES / "pendulum_clean.parquet", "--threads", "1")
    answer = cli("check", *asked, "--effects", "coulomb_friction,armature", "--budget", "0")
    assert answer.code == 0, answer.err
    for part in ("pendulum", "noise floor", "kp:*", "not tried for lack of time", "coulomb_friction"):
        assert part in answer.out
    assert cli("check", *asked, "--odds", "0.5").code == 2


def test_odds_are_above_one() -> None:
    with pytest.raises(UsageError, match="more than 1"):
        sb.check(leg(), [recorded(leg(), seconds=1.0)], ASKED, odds=1.0)
