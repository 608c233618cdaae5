"""The Back-to-Reality loop (section 3.3 of the paper).

The loop has no state of its own on disk. Every random number follows from the seed, the iteration and the step;
every simulation is answered by the journal of its step, and every trial by its file, if there is one. So a run that
was killed is begun again, and comes to where it was, to the bit, without repeating anything.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from time import perf_counter

import numpy as np

from sysid_btr._typing import FloatArray, IntArray
from sysid_btr.btr.belief import Belief
from sysid_btr.btr.choice import Offer, Pool, get_choice, pool_of
from sysid_btr.btr.closing import EXPLAINED, Joined, join_effects
from sysid_btr.btr.controllers import ControllerSpace, check_space
from sysid_btr.btr.correction import linear_correction
from sysid_btr.btr.exchange import quiet
from sysid_btr.btr.foresight import Foreseen
from sysid_btr.btr.learning import SECONDS, Learnt, learnt_once
from sysid_btr.btr.outcome import BackToReality, Iteration
from sysid_btr.btr.outlook import Cloud, Imagination, Outlook
from sysid_btr.btr.problems import FITNESS, ControllerProblem, ModelProblem, SearchProblem, Stage
from sysid_btr.btr.robot import Robot
from sysid_btr.btr.robust import RobustProblem
from sysid_btr.btr.settings import Settings
from sysid_btr.btr.task import Task
from sysid_btr.btr.trials import TrialBook, Tried
from sysid_btr.btr.trust import Region
from sysid_btr.btr.world import make_world
from sysid_btr.errors import InterruptedRun, UsageError
from sysid_btr.estimators.base import Budget, Estimator, FitResult, Progress, Termination, silent
from sysid_btr.estimators.journal import Journal
from sysid_btr.models.robot import Robot as RobotModel
from sysid_btr.models.ties import as_logged
from sysid_btr.progress import phase
from sysid_btr.terms.base import Term
from sysid_btr.terms.model import Terms
from sysid_btr.units import probability
from sysid_btr.version import __version__

PATIENCE = 3
"""Iterations without progress after which disengagement is looked for."""
UNCORRELATED = 0.2
"""Rank correlation of expected and real fitness up to which the model does not predict which controller is better."""
HELD = 0.5
"""Share of trials within their 90 % interval from which what was foreseen is not lost, whatever the order."""

STEPS = {"models_drawn": 0, "controllers": 1, "outlook": 2, "models": 3}
"""Searches of an iteration by the paper's numbers."""
SHORTLIST = 3
"""Times as many controllers as are tried, the fittest of Step 1, among which Step 2 chooses."""
ASSESSED = 2
"""Times as many drawn models as Step 1 has in which the fittest are looked at once more: chosen for what they do in the
first few, they do it less well in others."""
MANY = 6
"""Times as many models are drawn as controllers are searched in; those that do as the robot did are chosen."""


def back_to_reality(
    model: RobotModel,
    terms: Sequence[Term],
    robot: Robot,
    space: ControllerSpace,
    *,
    task: Task,
    settings: Settings | None = None,
    seed: int = 0,
    folder: Path | None = None,
    threads: int = 0,
    progress: Progress = silent,
    say: Callable[[str], None] = quiet,
    fingerprint: str = "",
) -> BackToReality:
    """Find a controller that works on the robot, and a model that says so.

    Parameters
    ----------
    model, terms : the model, and what of it is unknown.
    robot : on which controllers are tried.
    space, task : controllers, and what they are for.
    settings : default those of the paper's ant.
    seed : of all random numbers.
    folder : where journals and trials are kept; a run that finds its own goes on with them. None keeps nothing.
    threads : worker threads, 0 for all cores.
    progress, say : called after evaluations, and with what was found.
    fingerprint : of what else decides which simulations are run: the robot, of which nothing is known here.

    Raises
    ------
    InterruptedRun
        If the user stopped a search; what was done is kept.
    UsageError
        If the folder holds another run's work, or the model cannot do the task or play the controllers.
    """
    if not terms:
        raise UsageError("no parameter is declared: name what the trials may correct (--fit)")
    check_space(space, model, task.time)
    settings = Settings() if settings is None else settings
    loop = _Loop(model, robot, space, task, settings, seed, folder, threads, progress, say, tuple(terms), fingerprint)
    return loop.go()


@dataclass(eq=False)
class _Loop:
    """The loop while it runs: the model so far, the trials, the rounds."""

    model: RobotModel
    robot: Robot
    space: ControllerSpace
    task: Task
    settings: Settings
    seed: int
    folder: Path | None
    threads: int
    progress: Progress
    say: Callable[[str], None]
    terms: tuple[Term, ...]
    fingerprint: str = ""
    simulations: int = 0

    def __post_init__(self) -> None:
        self.book = TrialBook(None if self.folder is None else self.folder / "trials")
        self.stage = self._stage(self.terms)
        self.values = np.array([p.nominal for p in self.stage.parameters])
        self.rounds: list[Iteration] = []
        self.rivals = self.values[None]
        self.belief = Belief.before(self.terms)
        self.cloud: Cloud | None = None
        self.picked: IntArray = np.arange(0)
        self._print = self._fingerprint()

    def _stage(self, terms: tuple[Term, ...]) -> Stage:
        return Stage(make_world(self.model, self.task, terms, threads=self.threads), self.task, self.space)

    def _fingerprint(self) -> str:
        """Digest of all that decides which simulations are run; not of how long the loop goes on."""
        settings = replace(self.settings, iterations=1, requirement=None, worthwhile=None)
        parameters = [(p.name, p.nominal, p.lower, p.upper) for p in self.stage.parameters]
        bounds = [self.space.lower.tolist(), self.space.upper.tolist(), self.space.start.tolist()]
        own = [self.model.fingerprint, self.task.fingerprint, self.fingerprint]
        content = [__version__, *own, parameters, bounds, repr(settings), self.seed]
        return hashlib.sha256(json.dumps(content).encode()).hexdigest()

    def go(self) -> BackToReality:
        began, told = perf_counter(), self.task.in_words
        reason, finished = "", True
        for number in range(1, self.settings.iterations + 1):
            self.progress(done=0, total=None, best=np.inf, note=f"iteration {number}")
            with phase("", 1 / (self.settings.iterations - number + 1)):
                self.rounds.append(self._round(number))
            self.say(_line(self.rounds[-1], self.task))
            best = self.rounds[-1].best
            if self.settings.requirement is not None and best >= self.settings.requirement:
                reason = f"The requirement is met: {told(best)} on the robot after {len(self.book.made)} trials."
                break
            promise = self.rounds[-1].promise
            if promise is not None and self._not_worthwhile(promise):
                reason = f"Another trial is worth {told(promise, 2)}, less than {self.settings.worthwhile:.2g}."
                break
            away = disengaged(self.rounds)
            if away:
                reason, finished = away, False
                break
        else:
            reason = f"All {self.settings.iterations} iterations are done."
        best_tried = self.book.best
        assert best_tried is not None
        return BackToReality(
            stage=self.stage,
            model=self.values,
            iterations=tuple(self.rounds),
            best=best_tried,
            reason=reason,
            finished=finished,
            settings=self.settings,
            seed=self.seed,
            simulations=self.simulations,
            seconds=perf_counter() - began,
            belief=self.belief if self.settings.by_likelihood else None,
        )

    def _round(self, number: int) -> Iteration:
        drawn = None if self.settings.draws == 1 else self._imagine(number)
        found, journal = self._search_controllers(number, drawn)
        promise = self._try(number, pool_of(journal.records, self.book.known), drawn)
        tried = self.book.of(number)
        untied = self._untie()
        last = journal.records[-1].arrays["loss"] if journal.records else np.full(1, np.nan)
        transfer = _mean([abs(t.expected - t.trial.fitness) for t in tried if t.trial.outcome != "crashed"])
        joined, before = "", self.values
        names = tuple(p.name for p in self.stage.parameters)
        if self.settings.by_likelihood:
            learnt, joined = self._learn(number)
            problem = self._model_problem(self._remembered(), self.values)
            report = self._report(number, found, last, tried, transfer, problem, None, joined)
            if learnt is not None:
                report = replace(report, loss_before=learnt.before, loss=learnt.after, learnt=learnt)
            return replace(report, population_names=problem.names, promise=promise, untied=untied)
        problem = self._model_problem(self._remembered(), before)
        searched = self._search_model(number, problem) if self.settings.learn else None
        if searched is not None and problem.targets and self._lacking(problem.noise(self.values)):
            joined = self._close(number, before)
            if joined:
                problem = self._model_problem(self._remembered(), self.values)
        report = self._report(number, found, last, tried, transfer, problem, searched, joined)
        if self.settings.learn:
            self.belief = Belief.before(self.terms).towards(self.values, report.noise)
        return replace(report, population_names=names, promise=promise, untied=untied)

    def _learn(self, number: int) -> tuple[Learnt | None, str]:
        """Step 3 by a likelihood, and what `close` says, once, where too little is explained."""
        learnt = self._learnt(number, "learnt")
        if learnt is None or learnt.explained or not self._lacking(np.inf):
            return learnt, ""
        before = self.terms, self.stage, self.values, self.belief
        joined = self._close(number, self.values)
        if self.stage is before[1]:
            return learnt, joined
        # what was declared comes first, and is known as it was
        rows = np.arange(len(before[2]), len(self.values))
        self.belief = before[3].beside(replace(Belief.before(self.terms).of(rows), mean=self.values[rows]))
        again = self._learnt(number, "learnt_again")
        if again is None or not again.explained:
            self.terms, self.stage, self.values, self.belief = before
            self.rivals, joined = self.values[None], f"not {joined}, as it explains too little"
        return again, joined

    def _learnt(self, number: int, label: str) -> Learnt | None:
        """What is believed after the trials of an iteration, late commands included."""
        others, more = Belief.unmeasured(self.model, self.terms, ground=False)
        terms = Terms((*self.terms, *others))
        learnt = learnt_once(
            None if self.folder is None else self.folder / "learnt" / f"{number:02d}_{label}.json",
            self.model,
            [t.trial for t in self.book.of(number)],
            terms,
            self.belief.beside(more),
            self.settings.models,
            self.threads,
            _noted(self.progress, f"iteration {number}, {label}"),
        )
        if learnt is not None:
            self.simulations += round(learnt.simulations * self._looked_at)
        if learnt is not None and learnt.explained:
            self.terms, self.belief = tuple(terms), learnt.belief
            self.values = np.clip(learnt.belief.mean, terms.lower, terms.upper)
            self.stage = self._stage(self.terms)
            self.rivals = self.values[None]
        return learnt

    @property
    def _looked_at(self) -> float:
        """What of a trial its logs are compared for."""
        return min(SECONDS / self.task.duration, 1.0)

    def _imagine(self, number: int) -> Imagination:
        """Models drawn from what is believed after the iterations before, and chosen by what was tried."""
        others, unmeasured = Belief.unmeasured(self.model, self.terms)
        rng = np.random.default_rng([self.seed, STEPS["models_drawn"]])
        belief = self.belief.beside(unmeasured)
        models = np.vstack([belief.mean, belief.draws(rng, MANY * self.settings.draws - 1)])
        if self.cloud is None or not np.array_equal(models, self.cloud.drawn.models):
            self.cloud = Cloud(Imagination(self._stage((*self.terms, *others)), models))
            self.say(_believed(self.cloud.drawn, self.settings, self.task))
        self.simulations += self.cloud.learn(self.book.made, self._journal(number, "models_drawn"))
        rng = np.random.default_rng([self.seed, number, STEPS["models_drawn"]])
        self.picked = self.cloud.pick(ASSESSED * self.settings.draws, rng)
        return self.cloud.drawn.only(self.picked)

    def _search_controllers(self, number: int, drawn: Imagination | None) -> tuple[FitResult, Journal]:
        """Step 1."""
        estimator = self.settings.first if number == 1 else self.settings.controllers
        if drawn is not None:
            region, models = Region.after(self.book.made, self.space), drawn.models[: self.settings.draws]
            start = self.space.start if region.centre is None else region.centre
            robust = RobustProblem(drawn.stage, models, start, region.lower, region.upper, self.settings.risk)
            return self._search(number, "controllers", estimator, robust)
        best = self.book.best
        start = self.space.start if best is None else best.controller.values
        correction = linear_correction(self.stage, self.values, self.book.made) if self.settings.correct else None
        problem = ControllerProblem(self.stage, self.values, start, correction)
        return self._search(number, "controllers", estimator, problem)

    def _try(self, number: int, pool: Pool, drawn: Imagination | None) -> float | None:
        """Step 2: try controllers, each chosen by all that was tried before; what the first promised, as fitness."""
        choose, count = get_choice(self.settings.choice), self.settings.trials
        disagreeing: dict[bytes, FloatArray] = {}

        def rivals(some: FloatArray) -> FloatArray:
            key = some.tobytes()
            if key not in disagreeing:
                disagreeing[key] = self.stage.fitness(some, self.rivals)
            return disagreeing[key]

        look = None
        if drawn is not None:
            pool = drawn.shortlist(pool, SHORTLIST * count)
            look = self._outlook(number, pool, drawn)
        taken: list[int] = []
        promise: float | None = None
        while len(taken) < count:
            made = self.book.made
            best = max((t.trial.fitness for t in made if t.trial.outcome == "done"), default=0.0)
            foresight = None if look is None else look.foresee(made)
            near = None if look is None else Region.after(made, self.space).contains(pool.controllers)
            row = choose(Offer(pool, rivals, foresight, near, best), taken, count)
            if row is None:
                break
            if foresight is not None and promise is None:
                promise = float(foresight.improvement(best)[row])
                if self._not_worthwhile(promise):
                    break
            taken.append(row)
            foreseen = None if foresight is None else foresight.of(row).within(*self.task.plausible)
            expected = float(pool.expected[row]) if foreseen is None else foreseen.fitness
            tried = self.book.add(self.robot, number, pool.controllers[row], expected, foreseen)
            if foreseen is not None:
                self.say(_told(tried, foreseen, self.task))
        return promise

    def _not_worthwhile(self, promise: float | None) -> bool:
        least = self.settings.worthwhile
        return least is not None and promise is not None and promise < least and bool(self.book.made)

    def _outlook(self, number: int, pool: Pool, drawn: Imagination) -> Outlook:
        """What controllers of a pool, and all that were tried, do in drawn models; kept in a journal."""
        assert self.cloud is not None
        found = drawn.outcomes(pool.controllers, self._journal(number, "outlook"))
        self.simulations += len(pool.controllers) * len(drawn.models)
        before = [t.controller.values for t in self.cloud.tried]
        if self.cloud.done is not None:
            found = self.cloud.done.models(self.picked).beside(found)
        controllers = np.reshape([*before, *pool.controllers], (-1, len(self.space.names)))
        return Outlook(controllers, found, np.arange(len(before), len(controllers)), self.task.falls)

    def _untie(self) -> tuple[str, ...]:
        """Leave out ties of the model that the trials contradict, in all that comes; a remark on each."""
        known = self.model.remarks
        logs = [t.trial.log for t in self.book.made if t.trial.log is not None and t.trial.outcome != "crashed"]
        model = as_logged(self.model, logs)
        if model is self.model:
            return ()
        self.model, self.cloud = model, None
        self.stage = self._stage(self.terms)
        return model.remarks[len(known) :]

    def _remembered(self) -> list[Tried]:
        """Trials that Step 3 explains: half of them the newest, the others from all before, evenly."""
        usable = [t for t in self.book.made if t.trial.outcome != "crashed"]
        count = self.settings.memory
        if len(usable) <= count:
            return usable
        newest = usable[len(usable) - (count + 1) // 2 :]
        earlier = usable[: len(usable) - len(newest)]
        rows = np.unique(np.linspace(0, len(earlier) - 1, count - len(newest)).astype(np.int64))
        return [*(earlier[i] for i in rows), *newest]

    def _model_problem(self, tried: Sequence[Tried], start: FloatArray) -> ModelProblem:
        width = len(self.space.names)
        controllers = np.array([t.controller.values for t in tried]).reshape(len(tried), width)
        return ModelProblem(self.stage, controllers, [t.trial for t in tried], self.settings.distance, start)

    def _search_model(self, number: int, problem: ModelProblem) -> tuple[FloatArray, Journal] | None:
        """Step 3; None where there is nothing to explain, or the model stays as it is."""
        if self.settings.correct or not problem.trials:
            return None
        if problem.distance != FITNESS and not problem.targets:
            return None
        found, journal = self._search(number, "models", self.settings.models, problem)
        if not np.isfinite(found.loss):
            return None
        self.values = found.x
        candidates, losses = _all_of(journal)
        order = np.argsort(losses, kind="stable")
        order = order[np.isfinite(losses[order])]
        self.rivals = _distinct(candidates[order])[: self.settings.rivals]
        return found.x, journal

    def _search(
        self, number: int, step: str, estimator: Estimator, problem: SearchProblem
    ) -> tuple[FitResult, Journal]:
        journal = self._journal(number, step)
        rng = np.random.default_rng([self.seed, number, STEPS[step]])
        noted = _noted(self.progress, f"iteration {number}, {step}")
        found = estimator.fit(problem, rng=rng, budget=Budget(), journal=journal, progress=noted)
        if found.termination is Termination.INTERRUPTED:
            raise InterruptedRun(f"interrupted in iteration {number}, {step}; finished work is kept")
        self.simulations += round(found.evaluations * problem.runs)
        return found, journal

    def _journal(self, number: int, step: str) -> Journal:
        label = f"{number:02d}_{STEPS[step]}_{step}"
        path = None if self.folder is None else self.folder / "journals" / f"{label}.jsonl"
        return Journal(path, fingerprint=f"{self._print}/{label}")

    def _lacking(self, noise: float) -> bool:
        """Whether what is missing is looked for: once, where so many noise floors are left. It takes minutes."""
        return self.settings.close and not any(r.joined for r in self.rounds) and noise > EXPLAINED

    def _close(self, number: int, values: FloatArray) -> str:
        """Name missing effects and add them to the model; what was found, in words.

        It begins where Step 3 began: what that found without the effects is spoilt by them.
        """
        kept = None if self.folder is None else self.folder / "closings" / f"{number:02d}.json"
        noted = _noted(self.progress, f"iteration {number}, closing")
        joined: Joined = join_effects(self.stage, values, self.book.made, kept, self.threads, noted)
        self.simulations += round(self._looked_at * joined.simulations)
        if joined.model is not None:
            self.terms = joined.model.terms
            self.stage = self._stage(self.terms)
            self.values = joined.model.clipped().values
            self.rivals = self.values[None]
        return joined.message

    def _report(
        self,
        number: int,
        found: FitResult,
        last: FloatArray,
        tried: list[Tried],
        transfer: float,
        problem: ModelProblem,
        searched: tuple[FloatArray, Journal] | None,
        joined: str,
    ) -> Iteration:
        candidates, losses = (self.values[None], np.full(1, np.nan)) if searched is None else _all_of(searched[1])
        own = self._model_problem([t for t in tried if t.trial.outcome != "crashed"], self.values)
        delta = float(replace(own, distance=FITNESS).loss(self.values[None])[0]) if own.trials else float("nan")
        latest = losses if searched is None else searched[1].records[-1].arrays["loss"]
        best = self.book.best
        return Iteration(
            number=number,
            controller=found.x,
            expected=-found.loss,
            expected_mean=-_mean(last[np.isfinite(last)]),
            tried=tuple(tried),
            transfer=transfer,
            names=problem.names,
            model=self.values,
            loss=float(np.min(losses)),
            loss_before=float(losses[0]),
            loss_mean=_mean(latest[np.isfinite(latest)]),
            population=candidates,
            losses=losses,
            delta=delta,
            noise=own.noise(self.values) if own.targets else float("nan"),
            best=float("nan") if best is None else best.trial.fitness,
            joined=joined,
        )


def disengaged(rounds: Sequence[Iteration]) -> str:
    """Why the two searches have lost hold of each other, if they have; else nothing.

    In the last `PATIENCE` iterations nothing better was found on the robot, and the order in which the model puts
    controllers says nothing of the order in which the robot does: selection in one has no influence in the other.
    """
    if len(rounds) <= PATIENCE or rounds[-1].best > rounds[-1 - PATIENCE].best:
        return ""
    tried = [t for r in rounds[-PATIENCE:] for t in r.tried if t.trial.outcome != "crashed"]
    expected = np.array([t.expected for t in tried])
    real = np.array([t.trial.fitness for t in tried])
    if not tried and rounds[-1].tried:
        return f"Disengaged: every trial of the last {PATIENCE} iterations crashed."
    if not tried:
        return f"Disengaged: the last {PATIENCE} iterations found no controller that had not been tried before."
    if len(tried) < 2 * PATIENCE or np.ptp(real) == 0:
        return ""
    held = [t.foreseen.low <= t.trial.fitness <= t.foreseen.high for t in tried if t.foreseen is not None]
    if held and np.mean(held) >= HELD:
        return ""
    correlation = _rank_correlation(expected, real)
    if correlation > UNCORRELATED:
        return ""
    return (
        f"Disengaged: nothing better was found on the robot in {PATIENCE} iterations, and the model does not "
        f"predict which controller is better there (rank correlation {correlation:.2f} over {len(tried)} trials). "
        "The model lacks something that the robot has, which was not found: declare other parameters (--fit)."
    )


def _rank_correlation(a: FloatArray, b: FloatArray) -> float:
    from scipy.stats import rankdata

    x, y = rankdata(a), rankdata(b)
    if np.ptp(x) == 0 or np.ptp(y) == 0:
        return 0.0
    return float(np.corrcoef(x, y)[0, 1])


def _all_of(journal: Journal) -> tuple[FloatArray, FloatArray]:
    """All candidates of a search and their losses, in order."""
    records = journal.records
    return np.concatenate([r.candidates for r in records]), np.concatenate([r.arrays["loss"] for r in records])


def _distinct(rows: FloatArray) -> FloatArray:
    """Rows without repetitions, in order."""
    first = np.unique(rows, axis=0, return_index=True)[1]
    return np.asarray(rows[np.sort(first)])


def _noted(progress: Progress, where: str) -> Progress:
    def report(*, done: int, total: int | None, best: float, note: str) -> None:
        progress(done=done, total=total, best=best, note=f"{where}, {note}" if note else where)

    return report


def _mean(values: FloatArray | list[float]) -> float:
    return float(np.mean(values)) if len(values) else float("nan")


def _believed(drawn: Imagination, settings: Settings, task: Task) -> str:
    called = dict.fromkeys(p.name.partition(":")[0].partition(".")[0] for p in drawn.stage.parameters)
    risk = settings.risk
    fall = f", and a fall as {task.in_words(-risk.fall)}" if task.falls else ""
    return (
        f"controllers are searched for in {settings.draws} of {len(drawn.models)} models that differ in "
        f"{', '.join(called)}; what counts is the mean fitness in them ({task.goal}), by {100 * risk.weight:.0f} % that"
        f" in the worst {100 * risk.share:.0f} %{fall}"
    )


def _told(t: Tried, foreseen: Foreseen, task: Task) -> str:
    falls = f"; falls with {probability(1 - foreseen.stands)}" if task.falls else ""
    ended = {"done": ", stood" if task.falls else "", "fallen": ", fell", "crashed": ", crashed"}[t.trial.outcome]
    return (
        f"trial {t.controller.label}: foreseen {task.in_words(foreseen.fitness, 3)} ({foreseen.low:.2g} to "
        f"{foreseen.high:.2g}{falls}); {task.in_words(t.trial.fitness, 3)}{ended}"
    )


def _line(r: Iteration, task: Task) -> str:
    fell = sum(t.trial.outcome != "done" for t in r.tried)
    model = "after correction of the model" if r.corrected else "in the model as it is"
    parts = [
        f"iteration {r.number}: {len(r.tried)} trials" + (f" ({fell} fell or crashed)" if fell else ""),
        f"best on the robot {task.in_words(r.best)}",
        f"expected {r.expected:.4g}",
        f"fitness differs by {r.transfer:.2g} from what was foreseen, by {r.delta:.2g} {model}",
    ]
    if r.promise is not None:
        parts.append(f"a trial promised {task.in_words(r.promise, 2)}")
    return "; ".join(
        [", ".join(parts), *r.untied, *([r.joined] if r.joined else []), *([] if r.learnt is None else [str(r.learnt)])]
    )
