"""What moves a torque drive in a replay: what it was asked for, or what it was measured to give."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import mujoco
import numpy as np
import pytest
from test_segmented import FRICTION, JOINTS, NOISE, TWO, WILD, double_pendulum

from sysid_btr.diagnosis.close import OF_DRIVES, usable_effects
from sysid_btr.identify.driving import measured_torques
from sysid_btr.identify.mode import GIVEN, Mode
from sysid_btr.identify.study import make_study
from sysid_btr.io.log import Log, LogMeta
from sysid_btr.models.commands import as_measured, drives_nothing
from sysid_btr.simulation.numerics import Numerics
from sysid_btr.terms.effect import family_of
from sysid_btr.terms.library import select_effects

SHOWN = 2e-3
"""Nm, noise of the torques that are logged."""


@cache
def recorded(given: float, shown: float) -> Log:
    """A log of motors that give a fraction of what they are asked for, whose sensors show one: by MuJoCo alone."""
    rng = np.random.default_rng(5)
    model = mujoco.MjModel.from_xml_string(TWO.format(dry=f'frictionloss="{FRICTION}"', upper=0.5))
    model.opt.timestep, model.opt.integrator = 0.0005, mujoco.mjtIntegrator.mjINT_RK4
    data = mujoco.MjData(model)
    now = 0.005 * np.arange(600, dtype=np.float64)
    phase = rng.uniform(0, 6, size=(3, 2))
    asked = WILD / 3 * np.sin(2 * np.pi * np.array([0.4, 0.8, 1.3])[:, None] * now[:, None, None] + phase).sum(axis=1)
    position = np.empty((len(now), 2))
    for k, torque in enumerate(given * asked):
        position[k], data.ctrl[:] = data.qpos, torque
        mujoco.mj_step(model, data, 10)
    position += rng.normal(scale=NOISE, size=position.shape)
    effort = shown * asked + rng.normal(scale=SHOWN, size=asked.shape)
    columns = {"command": asked, "position": position, "effort": effort}
    channels = {f"{c}.{j}": x[:, i] for c, x in columns.items() for i, j in enumerate(JOINTS)}
    meta = LogMeta(robot="double", mount="fixed", source="simulated", extra={"drive": "torque"})
    return Log(time=now, channels=channels, meta=meta, episode=np.zeros(len(now), dtype=np.int64))


def test_motors_that_give_less_than_they_are_asked_for_move_the_model_by_what_they_gave() -> None:
    log = recorded(0.6, 0.6)
    found = measured_torques(double_pendulum(), log)
    assert found is not None
    assert not any(name.startswith("command.") for name in found.channels)
    study = make_study(double_pendulum(), [log], numerics=Numerics("RK4", 0.005), threads=1)
    for episode in (*study.train, *study.holdout):
        assert GIVEN in episode.why
        replay = episode.replay((), study.numerics)
        assert np.isfinite(replay.grid.command).all()
        assert replay.grid.command[0] == pytest.approx([episode.log.channels[f"effort.{j}"][0] for j in JOINTS])
    # a torque that is given is not predicted
    assert [t.channel for t in study.train_problem(()).episodes[0].targets] == ["position"]


def test_sensors_that_show_less_than_the_motors_gave_do_not_move_the_model() -> None:
    assert measured_torques(double_pendulum(), recorded(1.0, 0.6)) is None


@pytest.mark.parametrize("without", ["command", "effort"])
def test_with_one_of_both_there_is_nothing_to_choose(without: str) -> None:
    log = recorded(0.6, 0.6)
    one = replace(log, channels={n: v for n, v in log.channels.items() if not n.startswith(without)})
    assert measured_torques(double_pendulum(), one) is None


def test_torques_that_differ_by_noise_alone_leave_the_commands_in_place() -> None:
    assert measured_torques(double_pendulum(), recorded(1.0, 1.0)) is None


def test_the_rule_holds_for_whole_replays_too() -> None:
    study = make_study(
        double_pendulum(), [recorded(0.6, 0.6)], numerics=Numerics("RK4", 0.005), mode=Mode("forward"), threads=1
    )
    assert GIVEN in study.train[0].why


def test_nothing_that_a_drive_makes_of_its_command_is_looked_for_where_its_torque_is_given() -> None:
    library = select_effects(("all",))
    asked, given = recorded(1.0, 0.6), recorded(0.6, 0.6)
    names = []
    for log in (asked, given):
        study = make_study(double_pendulum(), [log], numerics=Numerics("RK4", 0.005), threads=1)
        names.append({e for e in usable_effects(library, study) if e.scope != "joint" and family_of(e) in OF_DRIVES})
    assert names[0]
    assert not names[1]


def test_what_is_no_command_is_not_replaced() -> None:
    log, model = recorded(0.6, 0.6), double_pendulum().model
    assert drives_nothing(as_measured(log, model), model)
    assert not drives_nothing(log, model)
    stated = replace(log, meta=replace(log.meta, drive="none"))
    assert as_measured(stated, model).channels.keys() == log.channels.keys()
