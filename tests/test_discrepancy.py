"""Intervals under a model that lacks something: they hold the truth, and a right model's stay as they are."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import toys

from sysid_btr._typing import FloatArray
from sysid_btr.display.text import exactness
from sysid_btr.identify.discrepancy import Discrepancy
from sysid_btr.identify.fit import Fit, fit
from sysid_btr.identify.missing_torque import TorqueResponse
from sysid_btr.identify.study import make_study
from sysid_btr.io.log import Log
from sysid_btr.simulation.numerics import Numerics
from sysid_btr.terms.disturbance import ExternalDisturbance
from sysid_btr.terms.effect import Effect
from sysid_btr.terms.friction import CoulombFriction, LoadFriction
from sysid_btr.terms.inertial import Armature, ComOffset, Payload
from sysid_btr.terms.sensing import EncoderScale
from sysid_btr.terms.spring import JointSpring
from sysid_btr.terms.transmission import Backlash

KNEE = ("knee",)
TRUTH = {"mass:knee": 1.15, "kp:*": 0.95}
NOISE = 6e-4


def recorded(effect: Effect | None, values: tuple[float, ...], seed: int) -> Log:
    """Eight seconds of the toy leg with another mass and gain, and what nobody declares, by another integrator."""
    robot, log = toys.leg(), toys.swing(toys.LEG_JOINTS, seconds=8.0, size=0.35)
    declared = make_study(robot, [log], numerics=toys.FINE).declare(("mass:knee", "kp:*=shared"))
    terms = (*declared, *((effect,) if effect else ()))
    outputs = toys.run(robot, log, terms, [*TRUTH.values(), *values], Numerics("RK4", 0.0025))
    noise = np.random.default_rng(seed).normal(0, NOISE, outputs.position[0].shape)
    shown = {f"position.{j}": outputs.position[0, :, i] + noise[:, i] for i, j in enumerate(toys.LEG_JOINTS)}
    return replace(log, channels={**log.channels, **shown})


def fitted(effect: Effect | None, values: tuple[float, ...] = (), seed: int = 0) -> Fit:
    study = make_study(toys.leg(), [recorded(effect, values, seed)], numerics=toys.FINE, threads=1)
    return fit(study, ("mass:knee", "kp:*=shared"))


def inside(found: Fit, plain: bool) -> list[bool]:
    """Whether the intervals hold the truth; `plain` for those that would hold if the model were right."""
    result = []
    for one in found.estimates:
        truth = next(value for name, value in TRUTH.items() if one.name.startswith(name))
        assert one.std_if_right is not None
        half = 2.0 * one.std_if_right
        low, high = (one.value - half, one.value + half) if plain else one.ci95
        result.append(low <= truth <= high)
    return result


HIDDEN: list[tuple[Effect, tuple[float, ...]]] = [
    (CoulombFriction(KNEE), (0.15,)),
    (CoulombFriction(("hip",)), (0.2,)),
    (Backlash(KNEE), (0.02, 0.001)),
    (JointSpring(KNEE), (1.0, 0.3)),
    (Armature(KNEE), (0.008,)),
    (LoadFriction(KNEE), (0.25,)),
    (EncoderScale(KNEE), (0.05,)),
    (Payload(("ankle",)), (0.15, 0.05, 0.0, -0.05, 5e-5)),
    (ComOffset(("ankle",)), (0.05, 0.0, -0.03)),
]


def test_intervals_hold_the_truth_although_an_effect_is_missing() -> None:
    """95 % of intervals should; of those that take the model as right, fewer do."""
    wide, narrow = [], []
    for seed, (effect, values) in enumerate(HIDDEN):
        found = fitted(effect, values, seed)
        assert found.misfit is not None
        wide += inside(found, plain=False)
        narrow += inside(found, plain=True)
    assert np.mean(wide) >= 0.9
    assert np.mean(narrow) < np.mean(wide)


def test_a_right_model_keeps_its_intervals() -> None:
    found = fitted(None)
    assert found.misfit is None
    assert all(one.std_if_right is None for one in found.estimates)


def test_the_result_says_what_its_intervals_hold_for() -> None:
    found = fitted(CoulombFriction(KNEE), (0.15,))
    [words, *_] = exactness(found.to_dict())
    assert "unknown torques at the joints" in words
    assert found.message.startswith("the residual of the position is")


def test_a_torque_shows_as_its_simulation_does() -> None:
    """Convolved with impulse responses, a push at the knee moves what a push that is simulated moves."""
    study = make_study(toys.leg(), [recorded(None, (), 0)], numerics=toys.FINE, threads=1)
    push = ExternalDisturbance(KNEE)
    plain = study.train_problem(fit(study, ("mass:knee",)).model)
    [episode] = plain.episodes
    response = TorqueResponse.of(episode, plain.start, study.scales)
    assert response is not None
    start, duration, size = 3.0, 0.4, 0.05
    wide = replace(episode.replay, terms=(*episode.replay.terms, push))
    values = np.array([[*plain.start, 0.0, start, duration], [*plain.start, size, start, duration]])
    still, pushed = wide.predict(values).position
    time = response.clock.period * np.arange(len(response.error))
    torque = size * ((time >= start) & (time < start + duration)).astype(float)
    at, moved = response.shows("position", response.joints.index("knee"), torque[:, None])
    simulated = (pushed - still)[: len(time), list(at)]
    assert np.abs(moved[:, 0] - simulated).max() < 0.1 * np.abs(simulated).max()


def test_whitening_is_that_of_noise_and_discrepancy_together() -> None:
    rng = np.random.default_rng(0)
    responses: FloatArray = rng.standard_normal((12, 3))
    white = Discrepancy(responses).whiten(np.eye(12))
    np.testing.assert_allclose(white @ (np.eye(12) + responses @ responses.T) @ white.T, np.eye(12), atol=1e-12)


def test_a_rising_error_is_said_to_rise() -> None:
    found = fitted(CoulombFriction(KNEE), (0.15,))
    worse = replace(found, before=found.nominal, nominal=found.before)
    ratio = found.nominal.holdout["position"].rmse / found.before.holdout["position"].rmse
    assert ratio > 1.05
    assert "error rises from" in worse.message
    assert "error goes from" in found.message
