"""Logs of MuJoCo itself: where they start, and in which steps they were recorded."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from itertools import product

import mujoco
import numpy as np
import pytest
import toys

from sysid_btr._typing import FloatArray
from sysid_btr.diagnosis.close import close
from sysid_btr.identify.fit import fit
from sysid_btr.identify.recorder import as_recorded, own_steps
from sysid_btr.identify.refit import refit
from sysid_btr.identify.starting import wanted_start
from sysid_btr.identify.study import make_study
from sysid_btr.io.log import Log
from sysid_btr.simulation.numerics import INTEGRATORS, Numerics
from sysid_btr.terms.friction import ViscousDamping
from sysid_btr.terms.grammar import parse_parameters
from sysid_btr.terms.model import Model

GAINS = ("kp:*=shared", "kv:*=shared")
NOISE, PERIOD = 5e-5, 0.01
FINE = Numerics("RK4", 0.0005)


@lru_cache
def stepped(
    integrator: str, timestep: float, seconds: float, friction: float, gain: float = 1.0
) -> tuple[FloatArray, ...]:
    """Time, commands, positions and velocities (n, 3) of the leg in MuJoCo, with a factor of the knee's kp."""
    spec = toys.leg().make_spec()
    spec.joint("knee").frictionloss = friction
    servo = next(a for a in spec.actuators if a.target == "knee")
    servo.gainprm[0] *= gain
    servo.biasprm[1] *= gain
    model = spec.compile()
    model.opt.timestep, model.opt.integrator = timestep, INTEGRATORS.index(integrator)
    data, time = mujoco.MjData(model), PERIOD * np.arange(round(seconds / PERIOD))
    command = np.stack([0.4 * np.sin(2 * np.pi * f * time) for f in (0.61, 0.83, 1.07)], axis=1)
    position, velocity = np.empty((len(time), 3)), np.empty((len(time), 3))
    for i, wanted in enumerate(command):
        position[i], velocity[i], data.ctrl[:] = data.qpos, data.qvel, wanted
        for _ in range(round(PERIOD / timestep)):
            mujoco.mj_step(model, data)
    return time, command, position, velocity


def mujoco_log(
    integrator: str,
    timestep: float,
    skipped: float = 0.0,
    friction: float = 0.0,
    gain: float = 1.0,
    noise: float = NOISE,
    seed: int = 2,
) -> Log:
    """What anybody records who steps the leg in MuJoCo; `skipped` s of it come before the log."""
    time, command, position, _ = stepped(integrator, timestep, 8.0 + skipped, friction, gain)
    seen = position + np.random.default_rng(seed).normal(0, noise, position.shape)
    first = round(skipped / PERIOD)
    channels = {}
    for k, joint in enumerate(toys.LEG_JOINTS):
        channels |= {f"command.{joint}": command[first:, k], f"position.{joint}": seen[first:, k]}
    return toys.make_log(time[first:] - time[first], channels)


@pytest.mark.parametrize(("integrator", "timestep"), [("Euler", 0.002), ("implicitfast", 0.002), ("Euler", 0.005)])
def test_a_log_is_replayed_in_the_steps_in_which_mujoco_recorded_it(integrator: str, timestep: float) -> None:
    found = fit(make_study(toys.leg(), [mujoco_log(integrator, timestep)]), GAINS)
    numerics = found.study.numerics
    assert (numerics.integrator, numerics.timestep, numerics.recorded) == (integrator, timestep, True)
    for one in found.estimates:
        assert one.ci95[0] <= 1 <= one.ci95[1], one
    assert found.before.holdout["position"].rmse <= 1.05 * NOISE


def test_nothing_is_missing_in_a_log_of_mujoco_that_starts_in_motion() -> None:
    found = close(make_study(toys.leg(), [mujoco_log("Euler", 0.002, skipped=0.77)]), ("mass:knee", *GAINS))
    assert found.verdict == "nothing_missing", found.message


def test_friction_hides_the_steps_until_it_is_found() -> None:
    log = mujoco_log("Euler", 0.002, friction=0.1)
    found = close(make_study(toys.leg(), [log]), GAINS, effects=("coulomb_friction", "viscous_damping", "armature"))
    (effect,) = found.effects
    assert (effect.effect, effect.where, found.study.numerics.recorded) == ("coulomb_friction", ("knee",), True)
    assert effect.parameters[0].value == pytest.approx(0.1, rel=0.01)


def test_the_steps_are_found_far_from_the_nominal_gains() -> None:
    found = fit(make_study(toys.leg(), [mujoco_log("Euler", 0.002, gain=0.6)]), ("mass:knee", "kp:*", "kv:*"))
    assert found.study.numerics.recorded
    for one in found.estimates:
        truth = 0.6 if one.name == "kp:knee" else 1.0
        assert one.ci95[0] <= truth <= one.ci95[1], one


@pytest.mark.parametrize("seed", range(3))
def test_steps_whose_error_noise_hides_are_found_by_the_likelihood(seed: int) -> None:
    study = make_study(toys.leg(), [mujoco_log("Euler", 0.002, noise=8 * NOISE, seed=seed)])
    model = Model.of(parse_parameters(["mass:*", "kp:*", "kv:*"], study.robot))
    assert np.all(refit(study, model).train_columns < 1.2)
    numerics = as_recorded(study, model).numerics
    assert (numerics.integrator, numerics.timestep, numerics.recorded) == ("Euler", 0.002, True)


def test_one_joints_gain_is_found_beside_those_that_are_fitted_alike() -> None:
    log = mujoco_log("Euler", 0.002, gain=0.7)
    found = close(make_study(toys.leg(), [log]), ("mass:*", *GAINS), effects=("kp", "viscous_damping", "armature"))
    (effect,) = found.effects
    assert (effect.effect, effect.where, found.verdict) == ("kp", ("knee",), "explained")
    assert effect.parameters[0].value == pytest.approx(0.7, rel=0.002)
    shared = next(one for one in found.parameters if one.name == "kp:*")
    assert shared.ci95[0] <= 1 <= shared.ci95[1]


@pytest.mark.parametrize(("damping", "noise"), [*product((0.0, 0.02, 0.2), (1.0,)), (0.0, 8.0), (0.002, 8.0)])
def test_a_robot_that_lacks_something_is_not_taken_for_a_simulator(damping: float, noise: float) -> None:
    """Steps of Euler's method resemble damping that is not there."""
    motion = toys.swing(toys.LEG_JOINTS, seconds=6.0)
    shown = toys.run(toys.leg(), motion, (ViscousDamping(("hip", "knee", "ankle")),), [damping] * 3, FINE).position[0]
    noisy = shown + np.random.default_rng(0).normal(0, noise * NOISE, shown.shape)
    channels = {f"position.{joint}": noisy[:, k] for k, joint in enumerate(toys.LEG_JOINTS)}
    study = make_study(toys.leg(), [replace(motion, channels={**motion.channels, **channels})])
    model = Model.of(parse_parameters(["kp:*=shared", "kv:*=shared"], study.robot))
    assert as_recorded(study, model) is study


def test_a_measured_robot_is_never_a_simulator() -> None:
    log = mujoco_log("Euler", 0.005)
    log = replace(log, meta=replace(log.meta, source="measured"))
    study = make_study(toys.leg(), [log])
    assert as_recorded(study, Model.of(parse_parameters(["kp:*=shared"], study.robot))) is study


def test_a_model_files_own_steps_are_tried_where_they_show() -> None:
    log = mujoco_log("Euler", 0.002)
    study = make_study(toys.leg(), [log])
    own = own_steps(study)
    option = study.robot.model.opt
    assert own is not None
    assert (own.timestep, INTEGRATORS.index(own.integrator), own.recorded) == (option.timestep, option.integrator, True)
    assert own_steps(replace(study, numerics=own)) is None
    measured = replace(log, meta=replace(log.meta, source="measured"))
    assert own_steps(make_study(toys.leg(), [measured])) is None
    coarse = replace(log, meta=replace(log.meta, noise={"position": 0.01}))
    assert own_steps(make_study(toys.leg(), [coarse])) is None


def test_a_replay_starts_where_its_first_second_wants_it() -> None:
    log, numerics = mujoco_log("Euler", 0.002, skipped=0.77), Numerics("Euler", 0.002, recorded=True)
    study = make_study(toys.leg(), [log], numerics=numerics)
    model = Model.of(parse_parameters(["kp:*=shared"], study.robot))
    (comparison,) = study.train_problem(model).episodes
    found = wanted_start(comparison, model.values)
    _, _, position, velocity = stepped("Euler", 0.002, 8.77, 0.0)
    np.testing.assert_allclose(found.position, position[77], atol=4 * NOISE)
    np.testing.assert_allclose(found.velocity, velocity[77], atol=0.01)
    assert np.abs(comparison.replay.start[1] - velocity[77]).max() > 0.02
