"""Fitting: intervals that are honest, held-out data that stay out, and what a log cannot tell."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import toys

from sysid_btr._typing import FloatArray
from sysid_btr.diagnosis.close import close
from sysid_btr.display.text import exactness
from sysid_btr.errors import UsageError
from sysid_btr.estimators.base import Budget, Derived, silent
from sysid_btr.estimators.journal import Journal
from sysid_btr.estimators.linearisation import linearise
from sysid_btr.estimators.lsq import LeastSquares
from sysid_btr.identify.fit import Fit, fit
from sysid_btr.identify.fixing import fewest_to_fix
from sysid_btr.identify.intervals import Estimate, estimates
from sysid_btr.identify.study import Study, make_study
from sysid_btr.io.log import Log
from sysid_btr.io.parquet import read_log
from sysid_btr.models.builtin import load_robot
from sysid_btr.models.robot import Robot
from sysid_btr.objectives.covariance import Scatter, covariance
from sysid_btr.objectives.problem import ReplayProblem
from sysid_btr.run_folder import Folder
from sysid_btr.simulation.numerics import Numerics
from sysid_btr.terms.base import Parameter
from sysid_btr.terms.inertial import Payload
from sysid_btr.writeback.write import draft, identified, save_model

SAMPLES = Path(__file__).resolve().parents[1] / "sample_logs"
GAINS = ("kp:*=shared", "kv:*=shared")
LEG_FIT = ("mass:HipPitch,KneePitch,HipRoll", *GAINS)
QUICK = Numerics("RK4", 0.005)
TICK = 2 * np.pi / 4096

TWO_LIMBS = """
<mujoco model="two">
  <option gravity="0 0 -9.81"/>
  <default><joint damping=".05" armature=".01"/><geom contype="0" conaffinity="0"/></default>
  <worldbody>
    <body name="left">
      <joint name="left" axis="0 1 0"/>
      <geom size=".03" pos=".01 0 -.15" mass=".4"/>
      <body name="left_end" pos="0 0 -.2">
        <joint name="left_end" axis="1 0 0"/>
        <geom size=".02" pos="0 .01 -.1" mass=".2"/>
      </body>
    </body>
    <body name="right" pos="0 1 0">
      <joint name="right" axis="0 1 0"/>
      <geom size=".03" pos="0 .01 -.2" mass=".5"/>
    </body>
  </worldbody>
  <actuator>
    <position name="left" joint="left" kp="14" kv=".5"/>
    <position name="left_end" joint="left_end" kp="8" kv=".3"/>
    <position name="right" joint="right" kp="12" kv=".5"/>
  </actuator>
</mujoco>
"""


def measured(robot: Robot, log: Log, scales: Mapping[str, float] | None = None, seed: int = 0) -> Log:
    """The log with positions of a robot whose parameters differ, through a 12-bit encoder with noise."""
    from sysid_btr.identify.replay import replay_log

    run = replay_log(robot, log, scales or {}, numerics=Numerics("RK4", 0.00125))
    rng = np.random.default_rng(seed)
    channels = dict(log.channels)
    for name, column in run.channels.items():
        if name.startswith("position."):
            channels[name] = np.round((column + rng.normal(0, 4e-4, len(column))) / TICK) * TICK
    return replace(log, channels=channels)


def by_name(found: Fit, prefix: str) -> Estimate:
    """The one estimate whose name starts so."""
    (own,) = [e for e in found.estimates if e.name.startswith(prefix)]
    return own


def covers(estimate: Estimate, truth: float) -> bool:
    return estimate.ci95[0] <= truth <= estimate.ci95[1]


@lru_cache
def sample_study(name: str, model: str = "leg") -> Study:
    return make_study(load_robot(str(SAMPLES / f"{model}.xml")), [read_log(SAMPLES / f"{name}.parquet")])


@lru_cache
def clean_fit() -> Fit:
    return fit(sample_study("leg_clean"), LEG_FIT)


def test_the_budget_bounds_all_searches_of_a_fit() -> None:
    study, free = sample_study("leg_friction"), ("mass:HipPitch,KneePitch", "kp:*=shared")
    whole = fit(study, free)
    assert whole.replays > 60  # the coarse fits before the estimator's, and what follows it, are most of it
    cut = fit(study, free, budget=Budget(evaluations=20))
    assert not cut.result.converged
    assert cut.replays <= 20 + 10  # each search has to simulate where it begins, and its result is judged
    same = fit(study, free, budget=Budget(evaluations=whole.replays))
    assert same.values.tolist() == whole.values.tolist()


# --- what is not fitted -----------------------------------------------------------------------------------


LOADED = toys.PENDULUM.replace(
    "</body>",
    '<body name="load"><inertial pos="0 0 -0.2" mass="0.3" diaginertia="0.0024 0.0024 0.0024"/></body></body>',
)
"""A load at the arm's centre of mass, of three fifths of its mass and inertia: no motion distinguishes the two."""


def test_intervals_hold_for_masses_that_are_not_fitted_where_these_may_be_off() -> None:
    robot, motion = toys.robot_from_xml(LOADED), toys.swing(seconds=4.0)
    for load in (0.85, 1.0, 1.15):
        log = measured(robot, motion, {"mass:arm": 1.2, "mass:load": load})
        study = make_study(robot, [log], numerics=toys.FINE)
        exact = by_name(fit(study, ["mass:arm"]), "mass:arm")
        assert exact.value == pytest.approx(1.2 + 0.6 * (load - 1), abs=0.005)
        assert covers(exact, 1.2) == (load == 1.0)
        found = fit(replace(study, nuisance={"mass": 0.1}), ["mass:arm"])
        allowed = by_name(found, "mass:arm")
        assert covers(allowed, 1.2)
        assert allowed.value == exact.value
        assert allowed.std == pytest.approx(np.hypot(0.06, exact.std), rel=0.02)
    closed = close(found.study, ["mass:arm"], effects=("viscous_damping",))
    assert closed.verdict == "nothing_missing"
    assert closed.parameters[0].std == pytest.approx(allowed.std, rel=0.02)
    assert found.to_dict()["taken_as_exact"] == []
    assert "is off: mass by 0.1" in " ".join(exactness(found.to_dict()))


def test_what_is_taken_as_exact_is_said() -> None:
    study = make_study(toys.leg(), [measured(toys.leg(), toys.swing(toys.LEG_JOINTS))], numerics=toys.FINE)
    result = fit(study, ["mass:knee"]).to_dict()
    assert result["taken_as_exact"] == ["mass:hip", "mass:ankle"]
    assert "the mass of hip, ankle (--nuisance mass=0.1" in " ".join(exactness(result))
    with pytest.raises(
        UsageError, match=r"--nuisance mass=0: a standard deviation must be above zero\n.*did you mean 'mass'"
    ):
        fit(replace(study, nuisance={"mass": 0.0, "mas": 0.1}), ["mass:knee"])


# --- covariance -------------------------------------------------------------------------------------------

BLOCKS, LENGTH = 500, 20


@pytest.mark.parametrize("seed", range(4))
def test_covariance_is_the_closed_form_under_white_noise(seed: int) -> None:
    rng = np.random.default_rng(seed)
    mixing = np.array([[1.0, 0.6, 0.0], [0.0, 1.0, -0.4], [0.0, 0.0, 1e-3]])
    jacobian = rng.standard_normal((BLOCKS * LENGTH, 3)) @ mixing
    blocks = np.repeat(np.arange(BLOCKS), LENGTH)
    found = covariance(jacobian, rng.standard_normal(len(jacobian)), blocks)
    exact = np.linalg.inv(jacobian.T @ jacobian)
    np.testing.assert_allclose(np.sqrt(np.diag(found)), np.sqrt(np.diag(exact)), rtol=0.10)
    np.testing.assert_allclose(found, found.T)


def test_covariance_is_that_of_correlated_residuals() -> None:
    rng = np.random.default_rng(5)
    # both constant within a stretch: every sample repeats the same information, so n samples count as one
    column = np.repeat(rng.standard_normal(BLOCKS), LENGTH)[:, None]
    residual = np.repeat(rng.standard_normal(BLOCKS), LENGTH)
    blocks = np.repeat(np.arange(BLOCKS), LENGTH)
    found = np.sqrt(covariance(column, residual, blocks)[0, 0])
    white = 1 / np.linalg.norm(column)
    assert found / white == pytest.approx(np.sqrt(LENGTH), rel=0.15)


def test_covariance_never_falls_below_that_of_white_noise_of_the_noise_floor() -> None:
    rng = np.random.default_rng(6)
    jacobian = rng.standard_normal((200, 2))
    found = covariance(jacobian, 1e-6 * rng.standard_normal(200), np.arange(200) // 10)
    assert np.all(np.diag(found) >= np.diag(np.linalg.inv(jacobian.T @ jacobian)) * (1 - 1e-9))


def test_covariance_is_infinite_where_nothing_is_seen() -> None:
    rng = np.random.default_rng(7)
    seen = rng.standard_normal((400, 2))
    jacobian = np.column_stack([seen, np.zeros(400)])
    found = np.diag(covariance(jacobian, rng.standard_normal(400), np.arange(400) // 10))
    assert np.isinf(found[2])
    assert np.all(np.isfinite(found[:2]))


def test_degrees_of_freedom_are_no_more_than_there_are_stretches_even_where_nothing_is_seen() -> None:
    known = Scatter(np.eye(2), np.eye(2), common=1.0, shrinkage=0.0, information=np.tile(np.eye(2) / 8, (8, 1, 1)))
    np.testing.assert_allclose(known.degrees_of_freedom(np.array([[1.0, 0.0], [0.6, 0.8]])), 7)
    assert known.degrees_of_freedom(np.zeros((1, 2))) <= 8
    averaged = Scatter(np.eye(2), np.eye(2), common=3.0, shrinkage=0.5, information=known.information)
    assert averaged.degrees_of_freedom(np.zeros((1, 2))) <= 8 * 2


def test_covariance_is_infinite_for_two_parameters_that_do_the_same() -> None:
    rng = np.random.default_rng(8)
    a, b = rng.standard_normal((2, 400))
    jacobian = np.column_stack([a, -3 * a, b])
    found = np.diag(covariance(jacobian, rng.standard_normal(400), np.arange(400) // 10))
    assert np.all(np.isinf(found[:2]))
    assert found[2] == pytest.approx(1 / (b @ b), rel=0.5)


FEW, LONG, MANY = 17, 40, 8


@pytest.mark.parametrize("memory", [1, 20], ids=["white", "correlated"])
def test_intervals_of_short_logs_with_many_parameters_hold_the_truth(memory: int) -> None:
    """Half a log of 17 stretches is chance where 8 parameters are fitted: neither too narrow for it nor too wide."""
    rng = np.random.default_rng(11)
    blocks = np.repeat(np.arange(FEW), LONG)
    parameters = [Parameter(f"mass:{i}", "1", 0.0, -1e3, 1e3, 10.0) for i in range(MANY)]
    inside, width, trials = 0, [], 120
    for _ in range(trials):
        jacobian = rng.standard_normal((FEW * LONG, MANY))
        noise = rng.standard_normal(FEW * LONG)
        if memory > 1:  # neither what moves nor what errs forgets quickly
            jacobian, noise = (
                np.repeat(rng.standard_normal((FEW * LONG // memory, *size)), memory, axis=0) for size in ((MANY,), ())
            )
        left = np.linalg.lstsq(jacobian, noise, rcond=None)[0]
        found = estimates(parameters, left, jacobian, noise - jacobian @ left, blocks)
        inside += sum(covers(e, 0.0) for e in found)
        scale = np.sqrt(memory * np.diag(np.linalg.inv(jacobian.T @ jacobian)))
        width += [(e.ci95[1] - e.ci95[0]) / (2 * 1.96 * s) for e, s in zip(found, scale, strict=True)]
    assert 0.92 <= inside / (trials * MANY) <= 0.98
    assert np.median(width) == pytest.approx(1.0, abs=0.25)


def test_a_direction_that_a_model_gets_wrong_is_not_averaged_away() -> None:
    rng = np.random.default_rng(12)
    blocks = np.repeat(np.arange(FEW), LONG)
    jacobian = rng.standard_normal((FEW * LONG, MANY))
    jacobian[:, 0] = np.repeat(rng.standard_normal(FEW), LONG)
    residual = rng.standard_normal(FEW * LONG) + 1.5 * np.repeat(rng.standard_normal(FEW), LONG)
    residual -= jacobian @ np.linalg.lstsq(jacobian, residual, rcond=None)[0]
    white = np.sqrt(np.diag(np.linalg.inv(jacobian.T @ jacobian)))
    widened = np.sqrt(np.diag(covariance(jacobian, residual, blocks))) / white
    assert widened[0] > 5.0
    assert np.all(widened[1:] < 0.6 * widened[0])


def test_of_what_is_told_only_together_as_few_as_need_be_are_held() -> None:
    rng = np.random.default_rng(13)
    a, b = rng.standard_normal((2, 400))
    jacobian = np.column_stack([a, a + 1e-3 * b, np.zeros(400), 30 * b])
    parameters = [Parameter(f"mass:{n}", "1", 1.0, 0.3, 3.0, 0.1) for n in "abcd"]
    found = estimates(parameters, np.ones(4), jacobian, rng.standard_normal(400), np.arange(400) // 10)
    assert [e.identifiable for e in found] == ["no", "no", "no", "yes"]
    held = fewest_to_fix(jacobian, found)
    assert held[:2].sum() == 1  # the other one is then told
    assert held[2]
    assert not held[3]


def test_an_unseen_parameter_is_not_identifiable_and_says_why() -> None:
    rng = np.random.default_rng(9)
    jacobian = np.column_stack([50 * rng.standard_normal(400), np.zeros(400)])
    parameters = [Parameter(f"mass:{n}", "1", 1.0, 0.3, 3.0, 0.1) for n in "ab"]
    seen, unseen = estimates(parameters, np.ones(2), jacobian, rng.standard_normal(400), np.arange(400) // 10)
    assert (seen.identifiable, unseen.identifiable) == ("yes", "no")
    assert seen.reason == ""
    assert unseen.reason
    assert unseen.ci95 == (0.3, 3.0)


def test_of_two_masses_known_only_together_one_is_nominal_and_the_model_written_holds_what_is_known(
    tmp_path: Path,
) -> None:
    robot = toys.robot_from_xml(LOADED)
    log = measured(robot, toys.swing(seconds=4.0), {"mass:arm": 1.2, "mass:load": 1.1})
    found = fit(make_study(robot, [log], numerics=toys.FINE), ["mass:arm,load"])
    assert [e.identifiable for e in found.estimates] == ["no", "no"]
    arm, load = sorted((by_name(found, "mass:arm"), by_name(found, "mass:load")), key=lambda e: e.name)
    assert 1.0 in (arm.value, load.value)
    assert arm.value + 0.6 * load.value == pytest.approx(1.2 + 0.6 * 1.1, abs=0.005)
    assert save_model(Folder(tmp_path), draft(identified(found)))["reproduces"]


def test_where_nothing_is_identifiable_all_is_nominal() -> None:
    robot, motion = toys.pendulum(), toys.swing(seconds=4.0)
    still = replace(motion, channels={name: np.zeros_like(v) for name, v in motion.channels.items()})
    found = fit(make_study(robot, [measured(robot, still)], numerics=toys.FINE), ["mass:arm"], start=np.array([1.3]))
    (mass,) = found.estimates
    assert (mass.identifiable, mass.value) == ("no", 1.0)


# --- a sample log from another simulator ------------------------------------------------------------------


def test_truth_lies_in_the_intervals() -> None:
    truth = json.loads((SAMPLES / "leg_clean.truth.json").read_text())
    found = clean_fit()
    for body in ("HipPitch", "KneePitch"):
        estimate = by_name(found, f"mass:{body}")
        assert estimate.identifiable == "yes"
        assert covers(estimate, truth["mass"][body]["scale"]), estimate
    for gain in ("kp", "kv"):
        estimate = by_name(found, f"{gain}:")
        assert estimate.identifiable == "yes"
        assert covers(estimate, truth[gain]["KneePitch"]["scale"]), estimate
        assert estimate.std < 0.01


def test_a_mass_that_nothing_responds_to_is_held_at_nominal() -> None:
    hip = by_name(clean_fit(), "mass:HipRoll")
    assert hip.identifiable == "no"
    assert hip.value == hip.nominal == 1.0
    assert "fixed at its nominal value" in hip.reason
    assert hip.ci95 == hip.bounds


def test_a_clean_log_is_predicted_to_its_noise_floor() -> None:
    held_out = clean_fit().before.holdout["position"]
    assert held_out.rmse <= 1.1 * held_out.floor
    assert clean_fit().nominal.holdout["position"].rmse > 3 * held_out.floor


@pytest.mark.parametrize("factor", [0.7, 1.3])
def test_the_optimum_does_not_depend_on_the_start(factor: float) -> None:
    best = clean_fit()
    again = fit(best.study, LEG_FIT, start=np.full(len(best.values), factor))
    for a, b in zip(best.estimates, again.estimates, strict=True):
        assert abs(a.value - b.value) <= 0.1 * a.std, (a, b)


# --- held-out data ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("misfit", [False, True], ids=["clean", "misfit"])
def test_held_out_samples_are_never_fitted(misfit: bool) -> None:
    log = measured(toys.leg(), toys.swing(toys.LEG_JOINTS, seconds=5.0), {"mass:knee": 1.3, "kp:*": 0.9})
    time = log.time - log.time[0]
    if misfit:  # an error no mass explains, so that columns are weighed by its size
        log = changed(log, "position.ankle", 0.03 * np.sin(7 * time))
    other = log
    for joint in toys.LEG_JOINTS:
        other = changed(other, f"position.{joint}", np.where(time > 3.6, 2.0, 0.0))
    first, second = (
        fit(make_study(toys.leg(), [part], numerics=QUICK), ("mass:knee", *GAINS)) for part in (log, other)
    )
    assert first.before.holdout["position"].rmse != second.before.holdout["position"].rmse
    np.testing.assert_array_equal(first.values, second.values)
    assert [(e.std, e.ci95) for e in first.estimates] == [(e.std, e.ci95) for e in second.estimates]


def changed(log: Log, channel: str, by: FloatArray) -> Log:
    return replace(log, channels={**log.channels, channel: log.channels[channel] + by})


# --- Jacobians that share simulations ---------------------------------------------------------------------


@dataclass(frozen=True)
class OneByOne(Derived):
    """The same problem, without saying what moves what."""

    problem: ReplayProblem

    def residuals(self, candidates: FloatArray) -> FloatArray:
        return self.problem.residuals(candidates)

    def loss(self, candidates: FloatArray) -> FloatArray:
        return self.problem.loss(candidates)


def test_coloured_jacobian_is_that_of_plain_differences() -> None:
    robot = toys.robot_from_xml(TWO_LIMBS, "two")
    log = measured(robot, toys.swing(("left", "left_end", "right"), seconds=2.0), {"kp:*": 0.9})
    study = make_study(robot, [log], numerics=QUICK)
    terms = study.declare(["mass:left,right,left_end", "kp:left,right", "kv:*=shared"])
    problem = study.train_problem(terms)
    names = problem.names
    grouped = [tuple(names[i] for i in g) for g in problem.groups]
    assert sorted(i for g in problem.groups for i in g) == list(range(len(names)))
    assert ("mass:left", "mass:right") in grouped
    assert len(grouped) < len(names)
    at = np.array([1.1, 0.9, 1.2, 0.95, 1.05, 1.1])
    residual, jacobian = linearise(problem, at)
    plain_residual, plain = linearise(OneByOne(problem), at)
    np.testing.assert_array_equal(residual, plain_residual)
    np.testing.assert_allclose(jacobian, plain, rtol=1e-9, atol=1e-9 * np.abs(plain).max())
    for i in range(len(names)):
        support = problem.support(i)
        if support is not None:
            assert np.all(plain[~support, i] == 0)
            assert np.any(plain[support, i] != 0)
    shared = names.index(next(n for n in names if n.startswith("kv:")))
    assert all(len(g) == 1 for g in problem.groups if shared in g)


def test_joined_limbs_are_not_varied_together() -> None:
    joined = TWO_LIMBS.replace("<actuator>", '<equality><joint joint1="left" joint2="right"/></equality><actuator>')
    robot = toys.robot_from_xml(joined, "joined")
    log = measured(robot, toys.swing(("left", "left_end", "right"), seconds=1.0))
    study = make_study(robot, [log], numerics=QUICK)
    problem = study.train_problem(study.declare(["mass:left,right"]))
    assert all(len(g) == 1 for g in problem.groups)


# --- one bad column ---------------------------------------------------------------------------------------


def test_one_joint_with_a_gross_error_does_not_move_what_the_others_tell() -> None:
    clean = measured(toys.leg(), toys.swing(toys.LEG_JOINTS, seconds=5.0), {"kp:*": 0.9})
    time = clean.time - clean.time[0]
    # in phase with its own motion, so that it looks like a softer servo; 100 noise floors large
    bad = changed(clean, "position.ankle", -0.25 * clean.channels["position.ankle"] + 0.03 * np.sin(5 * time))
    studies = [make_study(toys.leg(), [log], numerics=QUICK) for log in (clean, bad)]
    good, found = (by_name(fit(s, GAINS), "kp:") for s in studies)
    assert covers(good, 0.9)
    problem = studies[1].train_problem(studies[1].declare(GAINS))
    naive: Any = LeastSquares().fit(
        problem, rng=np.random.default_rng(0), budget=Budget(), journal=Journal(), progress=silent
    )
    assert abs(naive.x[0] - 0.9) > 0.03  # the error is one that does move a fit that trusts all alike
    assert found.value == pytest.approx(0.9, abs=0.003)


def test_one_joint_with_a_gross_error_does_not_move_the_gains_of_others() -> None:
    each = ("kp:*", "kv:*=shared")
    clean = measured(toys.leg(), toys.swing(toys.LEG_JOINTS, seconds=5.0), {"kp:*": 0.9})
    time = clean.time - clean.time[0]
    bad = changed(clean, "position.ankle", 0.1 * np.sin(5 * time))
    found = fit(make_study(toys.leg(), [bad], numerics=QUICK), each)
    for joint in ("hip", "knee"):
        assert by_name(found, f"kp:{joint}").value == pytest.approx(0.9, abs=0.005)


# --- the recorded Nao of known truth ----------------------------------------------------------------------


def test_hanging_nao(shared_data: Path) -> None:
    folder = shared_data / "nao_gantry"
    if not folder.is_dir():
        pytest.skip(f"no nao_gantry in {shared_data}")
    study = make_study(load_robot(str(folder / "nominal.xml")), [read_log(folder / "gantry_c.parquet")])
    found = fit(study, ("mass:*KneePitch,*HipPitch,*HipRoll,*ShoulderRoll", *GAINS))
    assert found.before.holdout["position"].rmse <= 0.605e-3
    assert by_name(found, "kp:").value == pytest.approx(0.9, abs=0.003)
    assert by_name(found, "kv:").value == pytest.approx(1.0, abs=0.01)
    truth = {"RKneePitch": 1.25, "LKneePitch": 0.8, "RHipPitch": 0.9}
    masses = [e for e in found.estimates if e.name.startswith("mass:")]
    assert len(masses) == 8
    wrong = [
        e for e in masses if e.identifiable != "no" and not covers(e, truth.get(e.name.removeprefix("mass:"), 1.0))
    ]
    assert not wrong
    assert {e.name for e in masses if e.identifiable == "no"} == {"mass:RHipRoll", "mass:LHipRoll"}


def test_a_declared_payload_is_found_from_no_payload_at_all() -> None:
    """Without a load nothing responds to its place, and a load at the joint moves nothing either."""
    robot, log, rng = toys.pendulum(), toys.swing(seconds=8.0), np.random.default_rng(3)
    shown = toys.run(robot, log, [Payload(("arm",))], [0.2, 0.0, 0.0, 0.1, 0.0]).position[0, :, 0]
    log = replace(log, channels={**log.channels, "position.arm": shown + 4e-4 * rng.normal(size=len(shown))})
    found = fit(make_study(robot, [log], threads=1), ["payload:arm"])
    mass, _, _, height, _ = (e.value for e in found.estimates)
    assert mass * height == pytest.approx(0.02, rel=0.1)
    assert found.before.holdout["position"].chi2 < 1.3
