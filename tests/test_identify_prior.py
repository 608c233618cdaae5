"""What a model states of a robot counts where it leaves more than noise, and nowhere else."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import toys
from scipy.stats import chi2

from sysid_btr.display.text import exactness
from sysid_btr.estimators.linearisation import linearise
from sysid_btr.identify.fit import Fit, fit
from sysid_btr.identify.prior import MapProblem, Stated, doubt, is_implausible
from sysid_btr.identify.study import Study, make_study
from sysid_btr.io.log import Log
from sysid_btr.models.builtin import load_robot
from sysid_btr.simulation.numerics import Numerics
from sysid_btr.terms.effect import Effect
from sysid_btr.terms.friction import CoulombFriction
from sysid_btr.terms.grammar import parse_parameters
from sysid_btr.terms.model import Terms

HEAVY = 1.6
FREED = ("mass:knee,ankle", "kp:*=shared")


def recorded(effect: Effect | None = None, size: float = 0.0, heavy: float = HEAVY) -> Log:
    """Eight seconds of the toy leg with a heavy knee, and friction that nobody declares, by another integrator."""
    robot, log = toys.leg(), toys.swing(toys.LEG_JOINTS, seconds=8.0, size=0.35)
    declared = make_study(robot, [log], numerics=toys.FINE).declare(("mass:knee",))
    terms, values = (*declared, *((effect,) if effect else ())), [heavy, *([size] if effect else [])]
    outputs = toys.run(robot, log, terms, values, Numerics("RK4", 0.0025))
    noise = np.random.default_rng(3).normal(0, 5e-4, outputs.position[0].shape)
    shown = {f"position.{j}": outputs.position[0, :, i] + noise[:, i] for i, j in enumerate(toys.LEG_JOINTS)}
    return replace(log, channels={**log.channels, **shown})


def study_of(log: Log) -> Study:
    return make_study(toys.leg(), [log], numerics=toys.FINE, threads=1)


def fitted(log: Log) -> Fit:
    return fit(study_of(log), FREED)


def test_what_a_model_states_of_masses_is_so_many_standard_deviations_off() -> None:
    terms = Terms(parse_parameters(FREED, toys.leg()))
    stated = Stated.of(terms.parameters, redundancy=4.0)
    candidates = np.array([terms.nominal, terms.nominal + np.array([0.2, 0.0, 0.5])])
    np.testing.assert_allclose(stated.whitened(candidates), [[0.0, 0.0], [2.0, 0.0]], atol=1e-12)


def test_who_states_bounds_knows_better_than_the_model() -> None:
    robot = replace(toys.leg(), bounds={"mass:knee": (0.1, 10.0)})
    stated = Stated.of(Terms(parse_parameters(FREED, robot)).parameters)
    np.testing.assert_array_equal(stated.weight > 0, [False, True, False])


@pytest.mark.parametrize(("level", "expected"), [(0.9, True), (1.1, False)])
@pytest.mark.parametrize("count", [1, 3, 22])
def test_numbers_are_implausible_that_one_robot_of_ten_thousand_has(count: int, level: float, expected: bool) -> None:
    """Exactly: the sum of squares of so many standard normal numbers exceeds this one time in ten thousand."""
    far = np.sqrt(chi2.isf(1e-4 * level, count) / count)
    assert is_implausible(np.full(count, far)) is expected
    assert not is_implausible(np.zeros(0))


def test_implausible_masses_are_told_with_what_they_are() -> None:
    parameters = Terms(parse_parameters(FREED, toys.leg())).parameters
    assert doubt(parameters, np.array([1.6, 0.7, 5.0])) == ""
    why = "further from the model than robots are: something that acts like"
    assert doubt(parameters, np.array([2.0, 1.2, 1.0])) == f"mass:knee 2 is {why} it may be missing"
    assert (
        doubt(parameters, np.array([0.3, 1.9, 1.0])) == f"mass:knee 0.3, mass:ankle 1.9 are {why} them may be missing"
    )


def test_a_fit_warns_of_masses_that_robots_do_not_have() -> None:
    plausible, other = (fit(study_of(recorded(heavy=h)), ("mass:knee", "kp:*=shared")) for h in (HEAVY, 2.0))
    assert "further" not in plausible.message
    assert "mass:knee 2 is further from the model than robots are" in other.message


def test_a_right_model_is_fitted_without_it() -> None:
    """A mass three standard deviations off is found where the log is explained by it."""
    found = fitted(recorded())
    assert found.misfit is None
    knee = found.estimates[0]
    assert knee.ci95[0] <= HEAVY <= knee.ci95[1]
    assert knee.std < 0.05
    assert all(one.prior_std is None for one in found.estimates)
    study = found.study
    problem = study.train_problem(found.model)
    assert study.with_belief(problem) is problem


def test_a_wrong_model_holds_its_masses_and_says_so() -> None:
    log = recorded(CoulombFriction(("knee",)), 0.4)
    found = fitted(log)
    assert found.misfit is not None
    assert [one.prior_std for one in found.estimates] == [0.2, 0.2, None]
    words = " ".join(exactness(found.to_dict()))
    assert "mass was taken to be what the model states, give or take 20 %" in words
    study = found.study
    free = study.train_problem(found.model)
    held = study.with_belief(free)
    assert isinstance(held, MapProblem)
    assert held.loss(found.optimum[None])[0] <= 1.01 * held.loss(found.study.declare(FREED).nominal[None])[0]


@pytest.mark.parametrize("expressions", [("mass:RShoulderRoll,LShoulderRoll,Torso",), ("kp:*=shared", "mass:*Roll")])
def test_joints_that_move_apart_are_still_simulated_together(expressions: tuple[str, ...]) -> None:
    """Its rows of a Jacobian are exact whatever is varied in one candidate, and those of the log are what they were."""
    robot = load_robot("nao")
    log = toys.swing(("RShoulderRoll", "LShoulderRoll", "HeadYaw"), seconds=0.6)
    shown = {name.replace("command", "position"): 0.9 * own for name, own in log.channels.items()}
    log = replace(log, channels=log.channels | shown)
    terms = Terms(parse_parameters(expressions, robot))
    study = make_study(robot, [log], holdout=0.3, numerics=Numerics("RK4", 0.01), threads=1)
    problem = study.train_problem(terms)
    belief = Stated.of(terms.parameters)
    goal = MapProblem(problem, belief)
    assert goal.groups == problem.groups
    at = terms.nominal * 1.1
    (residual, jacobian), (own, slopes) = linearise(goal, at), linearise(problem, at)
    count = problem.count
    np.testing.assert_array_equal(residual[:count], own)
    np.testing.assert_allclose(jacobian[:count], slopes, atol=1e-9 * np.abs(slopes).max())
    np.testing.assert_allclose(jacobian[count:], np.diag(belief.weight)[belief.weight > 0], atol=1e-6)
