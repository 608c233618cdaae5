"""What is known of a model, and the models that are drawn from it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sysid_btr.btr.belief import Belief
from sysid_btr.floating_base.size import measure_size
from sysid_btr.models.builtin import load_robot
from sysid_btr.terms.base import Parameter
from sysid_btr.terms.grammar import parse_parameters


def parameter(name: str, lower: float, upper: float) -> Parameter:
    return Parameter(name, "1", 1.0, lower, upper, 0.1)


def belief(bounds: float, covariance: list[list[float]], mean: float = 1.0) -> Belief:
    names = [chr(97 + i) for i in range(len(covariance))]
    parameters = tuple(parameter(name, 1 - bounds, 1 + bounds) for name in names)
    return Belief(parameters, np.full(len(covariance), mean), np.array(covariance))


def test_draws_have_the_mean_and_covariance_that_are_believed() -> None:
    covariance = [[0.04, 0.03], [0.03, 0.09]]
    drawn = belief(50.0, covariance).draws(np.random.default_rng(0), 4096)
    np.testing.assert_allclose(drawn.mean(axis=0), 1.0, atol=0.02)
    np.testing.assert_allclose(np.cov(drawn.T), covariance, atol=0.005)


@pytest.mark.parametrize("mean", [1.0, 1.4, 9.0])
def test_draws_stay_within_the_bounds(mean: float) -> None:
    drawn = belief(0.3, [[1.0, 0.9], [0.9, 1.0]], mean).draws(np.random.default_rng(1), 64)
    assert np.all((drawn >= 0.7) & (drawn <= 1.3))


def test_what_is_known_exactly_does_not_vary() -> None:
    drawn = belief(0.5, [[0.01, 0.0], [0.0, 0.0]]).draws(np.random.default_rng(2), 32)
    np.testing.assert_allclose(drawn[:, 1], 1.0, atol=1e-9)
    assert np.std(drawn[:, 0]) > 0.05


def test_beliefs_beside_each_other_are_independent() -> None:
    both = belief(0.5, [[0.04]]).beside(belief(0.5, [[0.09]], 1.2))
    np.testing.assert_array_equal(both.mean, [1.0, 1.2])
    np.testing.assert_array_equal(both.covariance, [[0.04, 0.0], [0.0, 0.09]])


def test_what_is_learnt_of_some_parameters_moves_those_that_are_tied_to_them() -> None:
    rng = np.random.default_rng(4)
    root = rng.normal(size=(3, 3))
    known = replace(belief(50.0, (root @ root.T).tolist()), mean=rng.normal(size=3))
    rows = np.array([0, 2])
    own = known.of(rows)
    np.testing.assert_array_equal(own.covariance, known.covariance[np.ix_(rows, rows)])
    same = known.after(rows, own.mean, own.covariance)
    np.testing.assert_allclose(same.mean, known.mean)
    assert np.array_equal(known.after(rows, np.zeros(2), own.covariance).mean[rows], [0.0, 0.0])
    np.testing.assert_allclose(same.covariance, known.covariance, atol=1e-12)
    # as by Bayes' rule with a measurement of those two
    noise, seen = np.diag([0.5, 0.2]), rng.normal(size=2)
    gain = known.covariance[:, rows] @ np.linalg.inv(own.covariance + noise)
    mean = known.mean + gain @ (seen - own.mean)
    cov = known.covariance - gain @ known.covariance[rows]
    after = known.after(rows, mean[rows], cov[np.ix_(rows, rows)])
    np.testing.assert_allclose(after.mean, mean)
    np.testing.assert_allclose(after.covariance, cov, atol=1e-12)
    np.testing.assert_allclose(
        np.sum(known.whitened(mean[None]) ** 2),
        (mean - known.mean) @ np.linalg.solve(known.covariance, mean - known.mean),
    )


def test_numbers_that_do_not_belong_to_the_parameters_are_refused() -> None:
    with pytest.raises(ValueError, match="1 parameters"):
        Belief((parameter("a", 0.0, 2.0),), np.ones(2), np.eye(2))


def test_gears_are_expected_to_rub_by_half_a_degree_of_a_servo() -> None:
    nao = load_robot("nao")
    belief = Belief.unmeasured(nao, parse_parameters(["mass:Torso"], nao), ground=False)[1]
    std = {p.name.partition(":")[0]: s for p, s in zip(belief.parameters, belief.std, strict=True)}
    assert std["coulomb_friction"] == pytest.approx(0.01 * np.median(nao.model.actuator_gainprm[:, 0]))
    assert std["command_delay"] == pytest.approx(0.02)


@pytest.mark.parametrize(("gear", "kp"), [(1, 20.0), (10, 0.2)])
def test_how_much_gears_rub_is_counted_at_the_joint(gear: int, kp: float, tmp_path: Path) -> None:
    path = tmp_path / "arm.xml"
    path.write_text(
        '<mujoco><worldbody><body><joint name="elbow" axis="0 1 0"/><geom size="0.1" mass="1"/></body></worldbody>'
        f'<actuator><position joint="elbow" gear="{gear}" kp="{kp}"/></actuator></mujoco>'
    )
    terms, belief = Belief.unmeasured(load_robot(str(path)), (), ground=False)
    assert dict(zip((t.name for t in terms), belief.std, strict=True))["coulomb_friction"] == pytest.approx(0.2)


@pytest.mark.parametrize("name", ["nao", "ant"])
def test_what_carries_most_may_have_its_centre_a_little_off(name: str) -> None:
    robot = load_robot(name)
    terms, belief = Belief.unmeasured(robot, ())
    (moved,) = [term for term in terms if term.name == "com_offset"]
    heaviest = max(range(1, robot.model.nbody), key=lambda b: float(robot.model.body_mass[b]))
    assert moved.places == (robot.model.body(heaviest).name,)
    std = dict(zip((p.name for p in belief.parameters), belief.std, strict=True))
    along = {std[p.name] for p in moved.parameters}
    assert along == {0.01 * measure_size(robot.model).length(1.0)}
    declared = parse_parameters([f"com_offset:{moved.places[0]}"], robot)
    assert "com_offset" not in {term.name for term in Belief.unmeasured(robot, declared)[0]}


def test_rotor_inertia_and_damping_are_as_uncertain_as_models_are_unless_they_are_declared() -> None:
    nao = load_robot("nao")

    def asked(*declared: str) -> dict[str, tuple[str, ...]]:
        terms = Belief.unmeasured(nao, parse_parameters(list(declared), nao))[0]
        return {term.name: term.places for term in terms if term.name.endswith("_factor")}

    assert asked("mass:*").keys() == {"armature_factor", "damping_factor"}
    # a factor of nothing is nothing
    has = nao.model.dof_armature > 0
    assert len(asked()["armature_factor"]) == int(has.sum())
    assert asked("armature:*").keys() == {"damping_factor"}
    assert asked("viscous_damping:*=shared", "armature_factor:*") == {}
