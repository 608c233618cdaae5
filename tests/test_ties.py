"""Joints that a model ties together and a log shows apart."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from toys import robot_from_xml

from sysid_btr.identify.fit import fit
from sysid_btr.identify.study import make_study
from sysid_btr.io.log import Log, LogMeta
from sysid_btr.models.log_checks import check_log
from sysid_btr.models.ties import as_logged, broken_ties
from sysid_btr.simulation.numerics import Numerics
from sysid_btr.simulation.replay import Replay

JOINTS = ("left", "right")
BODY = """<body pos="0 {y} 0"><joint name="{name}" axis="0 1 0" damping=".1" armature=".01"/>
<geom type="capsule" fromto="0 0 0 0 0 -.2" size=".02" mass=".5"/></body>"""
SERVO = '<position name="{name}" joint="{name}" kp="8" kv=".5"/>'
TIE = '<equality><joint joint1="left" joint2="right" polycoef="{offset} {ratio} 0 0 0"/></equality>'


def legs(ratio: float | None, offset: float = 0.0) -> str:
    bodies = "".join(BODY.format(name=name, y=k) for k, name in enumerate(JOINTS))
    servos = "".join(SERVO.format(name=name) for name in JOINTS)
    tie = "" if ratio is None else TIE.format(ratio=ratio, offset=offset)
    return f"<mujoco><worldbody>{bodies}</worldbody><actuator>{servos}</actuator>{tie}</mujoco>"


def recorded(ratio: float | None, offset: float = 0.0, seed: int = 0) -> Log:
    """Two legs with different commands, tied or not."""
    time = np.arange(800) * 0.01
    swing = [0.3 * np.sin(4 * time), 0.25 * np.sin(5 * time + 1)]
    channels = {f"command.{name}": c for name, c in zip(JOINTS, swing, strict=True)}
    still = {f"position.{name}": c for name, c in zip(JOINTS, swing, strict=True)}
    log = Log(time, channels | still, LogMeta(sample_period=0.01), np.zeros(len(time), dtype=np.int64))
    seen = Replay(robot_from_xml(legs(ratio, offset)), log, (), Numerics("RK4", 0.002)).predict(np.zeros((1, 0)))
    noise = np.random.default_rng(seed).normal(0.0, 5e-4, seen.position[0].shape)
    positions = seen.position[0] + noise
    return replace(log, channels=channels | {f"position.{n}": positions[:, k] for k, n in enumerate(JOINTS)})


@pytest.mark.parametrize(("ratio", "offset"), [(1.0, 0.0), (-0.6, 0.1)])
def test_a_tie_that_the_log_keeps_stays(ratio: float, offset: float) -> None:
    robot, log = robot_from_xml(legs(ratio, offset)), recorded(ratio, offset)
    assert broken_ties(robot, [log]) == ()
    assert as_logged(robot, [log]) is robot
    # nor is a constant error of one encoder a broken tie
    shifted = replace(log, channels={**log.channels, "position.left": log.channels["position.left"] + 0.2})
    assert broken_ties(robot, [shifted]) == ()


@pytest.mark.parametrize("seed", range(3))
def test_a_tie_that_the_log_breaks_is_left_out_and_said(seed: int) -> None:
    robot, log = robot_from_xml(legs(1.0)), recorded(None, seed=seed)
    (tie,) = broken_ties(robot, [log])
    assert tie.joints == JOINTS
    assert tie.unit == "rad"
    (problem,) = (p for p in check_log(robot, log) if p.code == "joint.tied")
    assert problem.severity == "warning"
    assert "are not tied" in problem.message
    free = as_logged(robot, [log])
    assert (robot.model.neq, free.model.neq) == (1, 0)
    assert "not tied" in free.remarks[-1]
    assert free.fingerprint != robot.fingerprint


def test_a_fit_is_not_spoilt_by_a_tie_that_the_robot_lacks() -> None:
    study = make_study(robot_from_xml(legs(1.0)), [recorded(None)], threads=1)
    found = fit(study, ["kp:left", "kp:right"])
    assert study.robot.model.neq == 0
    for estimate in found.estimates:
        assert estimate.ci95[0] < 1.0 < estimate.ci95[1]
        assert estimate.std < 0.01


def test_joints_that_stand_still_break_no_tie() -> None:
    log = recorded(None)
    still = {f"position.{n}": np.random.default_rng(k).normal(0, 5e-4, len(log)) for k, n in enumerate(JOINTS)}
    assert broken_ties(robot_from_xml(legs(1.0)), [replace(log, channels=log.channels | still)]) == ()
