"""Step 3 by a likelihood: trials on a ground that is not the model's, what is not explained, each trial once."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import chi2

from sysid_btr.btr import learning
from sysid_btr.btr.belief import Belief
from sysid_btr.btr.closing import join_effects
from sysid_btr.btr.controllers import Controller
from sysid_btr.btr.gaits import NaoGait
from sysid_btr.btr.learning import Learnt, learn, learnt_once, model_fit, trial_study, usable_logs
from sysid_btr.btr.problems import Stage
from sysid_btr.btr.robot import HiddenRobot, Noise, Trial
from sysid_btr.btr.task import Walk
from sysid_btr.btr.trials import Tried
from sysid_btr.btr.world import make_world
from sysid_btr.errors import UsageError
from sysid_btr.estimators.base import silent
from sysid_btr.identify.prior import MapProblem
from sysid_btr.models.builtin import load_robot
from sysid_btr.models.robot import servo_joints
from sysid_btr.simulation.numerics import Numerics
from sysid_btr.terms.base import Term
from sysid_btr.terms.contact import FootCompliance, FootFriction
from sysid_btr.terms.friction import CoulombFriction
from sysid_btr.terms.grammar import parse_parameters
from sysid_btr.terms.model import Model, Terms

NAO, TASK, SPACE = load_robot("nao"), Walk(3.0), NaoGait()
JOINTS = servo_joints(NAO)
DECLARED = parse_parameters(["mass:Torso", "kp:*=shared"], NAO)
TERMS = Terms((*DECLARED, *Belief.unmeasured(NAO, DECLARED, ground=False)[0]))
DIFFERS = {"mass": 1.35, "kp": 0.85, "command_delay": 0.02}
TRUTH = np.array([DIFFERS.get(p.name.partition(":")[0], p.nominal) for p in TERMS.parameters])


def robot(*beside: tuple[Term, list[float]]) -> HiddenRobot:
    """A Nao that differs from its model, on a softer ground and a slippery one, with a step of its own."""
    ground = (FootCompliance(places=("robot",)), [3.0]), (FootFriction(places=("robot",)), [0.6])
    truth = Model.joined([*Model.of(TERMS, TRUTH).parts, *ground, *beside])
    world = replace(make_world(NAO, TASK, truth.terms, threads=1), numerics=Numerics("RK4", 0.002))
    return HiddenRobot(world, truth.values, TASK, SPACE, Noise())


@cache
def trials(count: int = 2) -> list[Trial]:
    rng = np.random.default_rng(5)
    near = SPACE.start + 0.05 * (SPACE.upper - SPACE.lower) * rng.normal(size=(count, len(SPACE.names)))
    return [robot().run(Controller(np.clip(c, SPACE.lower, SPACE.upper))) for c in near]


def before() -> Belief:
    return Belief.before(DECLARED).beside(Belief.unmeasured(NAO, DECLARED, ground=False)[1])


def from_trials(some: list[Trial], belief: Belief) -> Learnt:
    study = trial_study(NAO, usable_logs(some), threads=1)
    return learn(study, TERMS, belief, model_fit(), np.random.default_rng(0), silent)


def far_from(values: np.ndarray, belief: Belief) -> float:
    """Square of how many standard deviations of a belief values are off."""
    off = values - belief.mean
    return float(off @ np.linalg.solve(belief.covariance, off))


@pytest.mark.slow
def test_a_mass_a_gain_and_a_delay_are_learnt_on_a_ground_that_is_not_the_models() -> None:
    first = from_trials(trials()[:1], before())
    second = from_trials(trials()[1:], first.belief)
    # what one trial said explains the next
    assert first.before > 2 > 1.5 > max(first.after, second.before)
    for learnt in (first, second):
        assert learnt.explained
        assert np.all(np.abs(learnt.belief.mean - TRUTH) < 3 * learnt.belief.std)
        # the truth is among what is believed, and the model's own numbers are not
        assert far_from(TRUTH, learnt.belief) < chi2.ppf(0.999, len(TRUTH)) < far_from(TERMS.nominal, learnt.belief)
    # every trial adds to what is known; of the torso's mass hardly, as its centre may be anywhere and joints may rub
    assert np.all(second.belief.std < first.belief.std)
    kinds = [p.name.partition(":")[0] for p in TERMS.parameters]
    left = dict(zip(kinds, second.belief.std / before().std, strict=True))
    # rotor inertia and damping have a say in how stiff servos are
    assert left["kp"] < 0.6
    assert max(left["coulomb_friction"], left["command_delay"]) < 0.1
    rows = [kinds.index("kp"), kinds.index("command_delay")]
    assert np.all(np.abs(second.belief.mean - TRUTH)[rows] < 0.5 * np.abs(TERMS.nominal - TRUTH)[rows])


@pytest.mark.slow
def test_what_the_model_cannot_explain_does_not_move_it() -> None:
    rubs = CoulombFriction(places=JOINTS), [0.3] * len(JOINTS)
    study = trial_study(NAO, usable_logs([robot(rubs).run(Controller(SPACE.start))]), threads=1)
    smooth = Terms(term for term in TERMS if not isinstance(term, CoulombFriction))
    belief = before().of(np.flatnonzero([p in smooth.parameters for p in TERMS.parameters]))
    learnt = learn(study, smooth, belief, model_fit(), np.random.default_rng(0), silent)
    assert not learnt.explained
    np.testing.assert_array_equal(learnt.belief.mean, belief.mean)
    np.testing.assert_array_equal(learnt.belief.covariance, belief.covariance)
    assert "stays" in str(learnt)


def test_a_search_that_ends_where_less_is_explained_leaves_the_belief_as_it_was(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    judged, left = learning._judged, iter([1.2, 9.0])
    monkeypatch.setattr(learning, "TURNS", 1)
    monkeypatch.setattr(learning, "_judged", lambda study, model: replace(judged(study, model), train=next(left)))
    study = trial_study(NAO, [log.window(0, 51) for log in usable_logs(trials()[:1])], threads=1)
    right = replace(before(), mean=TRUTH)
    kept = learn(study, TERMS, right, model_fit(), np.random.default_rng(0), silent)
    assert kept.explained
    assert kept.after == kept.before == 1.2
    assert kept.belief is right
    assert "explains them as it is" in str(kept)


@pytest.mark.slow
def test_close_names_what_is_missing_on_a_ground_that_is_not_the_models() -> None:
    stage = Stage(make_world(NAO, TASK, DECLARED, threads=1), TASK, SPACE)
    tried = [Tried(1, Controller(SPACE.start), 0.0, trial) for trial in trials()]
    joined = join_effects(stage, np.ones(2), tried, None, 1)
    assert joined.model is not None
    assert [term.name for term in joined.model.terms] == ["mass", "kp", "command_delay"]
    assert np.all(np.abs(joined.model.values - [*DIFFERS.values()]) < [0.1, 0.05, 0.002])
    assert join_effects(stage, np.ones(2), tried[:1], None, 1).model is None


def test_what_was_believed_counts_as_much_as_it_is_known() -> None:
    class Line:
        def residuals(self, x: np.ndarray) -> np.ndarray:
            return np.where(np.isnan(x).any(axis=1, keepdims=True), np.nan, x[:, :1] - 3.0)

        def loss(self, x: np.ndarray) -> np.ndarray:
            return np.asarray(self.residuals(x)[:, 0] ** 2)

    rng = np.random.default_rng(0)
    root = rng.normal(size=(len(TRUTH), len(TRUTH)))
    mixed = root @ root.T
    belief = replace(before(), mean=TRUTH, covariance=mixed)
    problem = MapProblem(Line(), belief)  # type: ignore[arg-type]
    x = np.array([TRUTH + rng.normal(size=len(TRUTH)), TRUTH])
    np.testing.assert_allclose(problem.residuals(x)[1], [TRUTH[0] - 3.0, *np.zeros(len(TRUTH))], atol=1e-12)
    off = x[0] - belief.mean
    assert problem.loss(x)[0] == pytest.approx((x[0, 0] - 3.0) ** 2 + off @ np.linalg.solve(mixed, off))
    assert np.isnan(problem.residuals(np.full((1, len(TRUTH)), np.nan))).all()


def test_the_longest_trials_are_learnt_from() -> None:
    trial, other = trials()
    assert trial.log is not None
    assert other.log is not None
    fallen, short = replace(trial, outcome="fallen"), replace(trial, log=trial.log.window(0, 60), outcome="fallen")
    crashed, silent_one = replace(trial, outcome="crashed"), Trial(None, 0.0)
    assert [len(log) for log in usable_logs([short, crashed, silent_one, fallen])] == [151, 60]
    assert [log.content for log in usable_logs([short, fallen, other])] == [trial.log.content, other.log.content]
    assert usable_logs([crashed]) == []
    long = replace(trial, log=replace(trial.log, time=2 * trial.log.time))
    assert len(usable_logs([long])[0]) == 101


def test_what_was_learnt_is_not_learnt_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    belief, asked = before(), []

    def once(*given: object) -> Learnt:
        asked.append(given)
        return Learnt(replace(belief, mean=TRUTH, covariance=0.1 * belief.covariance), 4.0, 1.01, True, 7)

    monkeypatch.setattr(learning, "learn", once)
    monkeypatch.setattr(learning, "trial_study", lambda *_, **__: None)
    given = NAO, trials(), TERMS, belief, model_fit(), 1, silent
    path = tmp_path / "learnt" / "01.json"
    first, again = learnt_once(path, *given), learnt_once(path, *given)
    assert first is not None
    assert again is not None
    assert len(asked) == 1
    np.testing.assert_array_equal(again.belief.mean, TRUTH)
    np.testing.assert_array_equal(again.belief.covariance, 0.1 * belief.covariance)
    assert (str(again), again.simulations) == (str(first), 7)
    path.write_text('{"before": 4.0, "mean": [1.0]}')
    with pytest.raises(UsageError, match=r"01\.json was changed"):
        learnt_once(path, *given)


def test_without_a_log_nothing_is_learnt() -> None:
    given = TERMS, before(), model_fit(), 1, silent
    assert learnt_once(None, NAO, [Trial(None, 0.0, "crashed")], *given) is None
    short = replace(trials()[0], log=usable_logs(trials())[0].window(0, 20))
    assert learnt_once(None, NAO, [short], *given) is None
