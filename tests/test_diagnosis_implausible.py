"""Masses that robots do not have, by which a log is explained down to its noise: what is missing is imitated by them.

An arm moves slowly, so that its encoders show gravity and nothing else. A load in its hand, whose mass is not free, is
then the same as two heavier links and a lighter one between them.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import toys

from sysid_btr.diagnosis.close import close
from sysid_btr.diagnosis.closing import Closing
from sysid_btr.identify.study import make_study
from sysid_btr.models.robot import Robot

LINK = """
<body name="{name}" pos="0 0 {z}"><joint name="{name}" axis="0 1 0" damping=".2" armature=".1"/>
<inertial pos="0 0 {c}" mass="{m}" diaginertia=".006 .006 .001"/>"""
LINKS = (("upper", 0.0, -0.15, 1.0), ("lower", -0.3, -0.15, 1.0), ("third", -0.3, -0.1, 0.6))
HAND = '<body name="hand" pos="0 0 -.25"><inertial pos="0 0 -.03" mass=".2" diaginertia="2e-4 2e-4 2e-4"/></body>'
JOINTS = tuple(name for name, *_ in LINKS)
FREED = tuple(f"mass:{name}" for name in JOINTS)
NOISE = 2e-3


def arm() -> Robot:
    bodies = "".join(LINK.format(name=name, z=z, c=c, m=m) for name, z, c, m in LINKS)
    servos = "".join(f'<position name="{j}" joint="{j}" kp="60" kv="3"/>' for j in JOINTS)
    world = f"<worldbody>{bodies}{HAND}{'</body>' * len(LINKS)}</worldbody>"
    return toys.robot_from_xml(f"<mujoco>{world}<actuator>{servos}</actuator></mujoco>", "arm")


def carrying(load: float, masses: tuple[float, ...], seed: int) -> Closing:
    robot, time = arm(), np.arange(0, 20, 0.02)
    waves = zip(JOINTS, (0.8, 0.8, 0.5), (0.1, 0.077, 0.09), (0, 1, 2), (0.3, -0.4, 0.2), strict=True)
    fade = 1 - np.exp(-(time**2))
    moves = {j: fade * (a * np.sin(2 * np.pi * f * time + phase) + b) for j, a, f, phase, b in waves}
    log = toys.make_log(time, {f"command.{j}": own for j, own in moves.items()}, sample_period=0.02)
    terms = make_study(robot, [log], numerics=toys.FINE).declare((*FREED, "payload:hand"))
    seen = toys.position(robot, log, tuple(terms), (*masses, load, 0.0, 0.0, -0.03, 0.0))
    seen = seen + np.random.default_rng(seed).normal(0, NOISE, seen.shape)
    log = replace(log, channels={**log.channels, **{f"position.{j}": seen[:, i] for i, j in enumerate(JOINTS)}})
    return close(make_study(robot, [log], threads=1), FREED)


@pytest.mark.parametrize("seed", range(2))
def test_a_load_that_masses_imitate_is_named_with_what_it_is_confounded_with(seed: int) -> None:
    found = carrying(0.25, (1.0, 1.0, 1.0), seed)
    # alone, the masses explain the log
    assert found.before.holdout["position"].rmse < 1.05 * NOISE
    assert found.verdict == "ambiguous"
    (effect,) = found.effects
    assert (effect.effect, effect.where) == ("payload", ("hand",))
    assert effect.certainty > 0.5
    assert "com_offset" in effect.confused_with
    assert all(one.ci95[0] <= 1.0 <= one.ci95[1] for one in found.parameters), found.parameters


@pytest.mark.parametrize("seed", range(3))
def test_of_masses_that_robots_have_nothing_is_said(seed: int) -> None:
    true = (0.75, 1.25, 0.8)
    found = carrying(0.0, true, seed)
    assert found.verdict == "nothing_missing"
    assert found.message.startswith("Nothing is missing")
    assert all(
        one.ci95[0] - one.std <= m <= one.ci95[1] + one.std for one, m in zip(found.parameters, true, strict=True)
    )


def test_where_nothing_relieves_it_of_them_the_verdict_says_so() -> None:
    """The robot has these masses: no effect of the library does without them."""
    found = carrying(0.0, (1.0, 1.0, 2.2), 0)
    assert found.verdict == "nothing_missing"
    assert "mass:third 2.2 is further from the model than robots are" in found.message
    assert not found.effects
