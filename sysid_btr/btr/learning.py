"""Step 3 by a likelihood: what the logs of trials say of the model, whatever the ground does.

Trials are compared as `fit` compares floating-base logs, by innovations. What earlier trials said is the prior of later
ones (a Kalman filter's update of constants), so that each trial counts once and costs once.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from sysid_btr._typing import FloatArray
from sysid_btr.btr.belief import Belief
from sysid_btr.btr.robot import Trial
from sysid_btr.errors import LogError, ModelError, UsageError
from sysid_btr.estimators.base import Budget, Estimator, Progress, Termination
from sysid_btr.estimators.journal import Journal
from sysid_btr.estimators.linearisation import linearise
from sysid_btr.estimators.lsq import LeastSquares
from sysid_btr.identify.mode import Mode
from sysid_btr.identify.prior import MapProblem
from sysid_btr.identify.refit import Fitted, inflate, judge
from sysid_btr.identify.study import Study, make_study
from sysid_btr.io.log import Log
from sysid_btr.models.robot import Robot
from sysid_btr.reading import parse_json
from sysid_btr.run_folder import Folder
from sysid_btr.terms.model import Model, Terms

SECONDS, LOGS = 4.0, 2
"""s from its beginning of a trial that is learnt from, and trials of an iteration: more cost more time than the search
for gaits."""
TURNS, SETTLED = 6, 0.25
"""Times that states and numbers are found in turn, at most, and standard deviations by which the last one moves these.
"""


def model_fit() -> LeastSquares:
    """Least squares for the logs of a few trials."""
    return LeastSquares(confirm=False, max_iterations=4, tolerance=1e-3)


@dataclass(frozen=True, eq=False)
class Learnt:
    """What Step 3 learnt from some trials.

    Attributes
    ----------
    belief : after them; what was believed before where they are not explained.
    before, after : mean square of what is left of them, over their noise.
    explained : whether that is noise. What is left otherwise is about something else, which draws the numbers with it.
    simulations : candidates.
    """

    belief: Belief
    before: float
    after: float
    explained: bool
    simulations: int = 0

    def __str__(self) -> str:
        left = f"of the trials {self.before**0.5:.3g}, then {self.after**0.5:.3g} noise floors are left"
        corrected = "explains them as it is" if self.after == self.before else "is corrected"
        return f"{left}; the model {corrected if self.explained else 'lacks something, and stays as it was'}"


def usable_logs(trials: Sequence[Trial], most: int = LOGS) -> list[Log]:
    """The longest logs of trials up to a fall, of equals the first; their first seconds."""
    logs = [t.log for t in trials if t.log is not None and t.outcome != "crashed"]
    logs = sorted(logs, key=lambda log: -len(log))[:most]
    return [log.window(0, int(np.searchsorted(log.time, log.time[0] + SECONDS + 1e-9))) for log in logs]


def trial_study(robot: Robot, logs: Sequence[Log], held_out: Sequence[Log] = (), threads: int = 0) -> Study:
    """Trials to be fitted, and others to judge by; of a robot on the ground compared by innovations.

    Raises
    ------
    UsageError, LogError, ModelError
        If they cannot be.
    """
    mode = Mode("innovations" if any(log.meta.mount == "free" for log in logs) else "auto")
    return make_study(robot, logs, holdout=held_out, channels=("position",), mode=mode, threads=threads)


def learn(
    study: Study, terms: Terms, belief: Belief, estimator: Estimator, rng: np.random.Generator, progress: Progress
) -> Learnt:
    """What is believed after some trials.

    Parameters
    ----------
    study : of the trials, all of them fitted.
    terms, belief : of the model, and what is known of all of their parameters.
    estimator : of a search for numbers.
    rng, progress : see `sysid_btr.estimators`.

    Raises
    ------
    KeyboardInterrupt
        If the user stopped.
    """
    shown = [term for term in terms if study.shows(type(term))]
    rows = np.concatenate([np.arange(len(belief.mean))[terms.columns(term)] for term in shown])
    own = belief.of(rows)
    model, spent = Model.of(shown, own.mean), 0
    if not np.array_equal(model.values, model.terms.nominal):
        study = study.with_initial_states(model)  # those of a study are the plain model's
    first = _judged(study, model)
    study = inflate(study, first, memory=True)
    reached: list[tuple[Study, Fitted]] = []
    for _ in range(TURNS):
        problem = MapProblem(study.train_problem(model.clipped()), own)
        result = estimator.fit(problem, rng=rng, budget=Budget(), journal=Journal(), progress=progress)
        if result.termination is Termination.INTERRUPTED:
            raise KeyboardInterrupt
        moved = np.abs(result.x - model.values)
        model, spent = model.at(result.x), spent + result.evaluations
        std = np.sqrt(np.diag(_covariance(problem, model)))
        study = study.with_initial_states(model)
        found = _judged(study, model)
        study = inflate(study, found, memory=True)
        reached.append((study, found))
        if np.all(moved <= SETTLED * std):
            break
    study, found = min(reached, key=lambda pair: pair[1].train if np.isfinite(pair[1].train) else np.inf)
    model, explained = found.model, found.train <= study.procedure.tolerated
    if not explained and first.train <= study.procedure.tolerated:
        return Learnt(belief, first.train, first.train, True, spent)
    if explained:
        problem = MapProblem(study.train_problem(model), own)
        # the logs' noise is inflated by what is left of them, and by how long that remembers
        belief = belief.after(rows, model.values, _covariance(problem, model))
    return Learnt(belief, first.train, found.train, explained, spent)


def _covariance(problem: MapProblem, model: Model) -> FloatArray:
    """(p, p) of the numbers of a model by what logs and belief say."""
    jacobian = linearise(problem, model.values)[1]
    return np.asarray(np.linalg.inv(jacobian.T @ jacobian))


def _judged(study: Study, model: Model) -> Fitted:
    """How well a model fits the trials, all of which are fitted."""
    return judge(replace(study, holdout=study.train), model)


def learnt_once(
    kept: Path | None,
    robot: Robot,
    trials: Sequence[Trial],
    terms: Terms,
    belief: Belief,
    estimator: Estimator,
    threads: int,
    progress: Progress,
) -> Learnt | None:
    """`learn` from some trials, unless this was done before the run was stopped; None where none can be learnt from.

    Parameters
    ----------
    kept : file in which it is kept.
    """
    if kept is not None and kept.exists():
        return _read(kept, belief)
    logs = usable_logs(trials)
    if not logs:
        return None
    try:
        study = trial_study(robot, logs, threads=threads)
        found = learn(study, terms, belief, estimator, np.random.default_rng(0), progress)
    except (UsageError, LogError, ModelError):
        return None
    if kept is not None:
        kept.parent.mkdir(parents=True, exist_ok=True)
        content = {
            "before": found.before,
            "after": found.after,
            "explained": found.explained,
            "simulations": found.simulations,
            "mean": found.belief.mean.tolist(),
            "covariance": found.belief.covariance.tolist(),
        }
        Folder(kept.parent).write(kept.name, json.dumps(content) + "\n")
    return found


def _read(path: Path, belief: Belief) -> Learnt:
    """What was kept of an earlier run.

    Raises
    ------
    UsageError
        If it is not what was written.
    """
    try:
        content = parse_json(path.read_text(encoding="utf-8"))
        numbers = {name: content[name] for name in ("before", "after", "explained", "simulations")}
        mean, covariance = (np.array(content[name], dtype=np.float64) for name in ("mean", "covariance"))
        return Learnt(replace(belief, mean=mean, covariance=covariance), **numbers)
    except (KeyError, TypeError, ValueError) as error:
        raise UsageError(f"{path} was changed and cannot be read ({error!r}): start over (--overwrite)") from error
