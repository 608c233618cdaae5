"""Refitting a model with a hypothesis, and judging it on data that it was not fitted to."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from sysid_btr._typing import FloatArray
from sysid_btr.estimators.base import Budget, FitResult, Progress, Termination, silent
from sysid_btr.estimators.evaluator import Evaluator, Stop
from sysid_btr.estimators.journal import Journal
from sysid_btr.estimators.lsq import LeastSquares
from sysid_btr.identify.deferred import LEAST_GAIN, deferred_fit
from sysid_btr.identify.prior import Stated, prior_residual
from sysid_btr.identify.study import Study
from sysid_btr.objectives.problem import ReplayProblem, of_both
from sysid_btr.simulation.numerics import Numerics
from sysid_btr.terms.model import Model, Terms

CORRELATED = 1.5
"""Chi2 of a column beyond which its residual is an error of the model rather than noise."""
TOLERANCE = 1e-3
"""Decrease, a fraction of the loss, for which a hypothesis is not simulated again: all of it in one of 22 columns is a
third of what hypotheses may differ by and count as equal (`Selection.simpler`)."""
NOTICEABLE = 0.99
"""Fraction of a loss that another start must reach."""
RELIEVED = 0.5
"""Ratio of a column's squared error to the one that it was weighed by, from which what a model states counts too much
beside it."""
RELIEFS = 4
"""Times that columns are weighed anew at most."""
CLEAN = 1.02
"""Chi2 of a column below which it counts as explained."""


@dataclass(frozen=True, eq=False)
class Fitted:
    """A model with its parameters refitted.

    Attributes
    ----------
    model : terms and their values.
    train, holdout : mean square of error over noise floor.
    train_columns, holdout_columns, columns : the same for each log column: fitted, held-out, all data.
    memory, holdout_memory : samples that count as one independent sample in each column's residual, fitted and held
        out; 1 if white.
    train_cells, holdout_cells : (columns, stretches) sums of squares over noise floor by stretch of half a
        second.
    train_counts, holdout_counts : (columns, stretches) number of samples.
    evaluations : candidates simulated.
    numerics : with which it was judged.
    prior_residual : (s,) of `sysid_btr.identify.prior`, if what the model states counts; else empty.
    converged : whether its parameters are where least squares lead, as far as that was asked for.
    """

    model: Model
    train: float
    holdout: float
    train_columns: FloatArray
    holdout_columns: FloatArray
    columns: FloatArray
    memory: FloatArray
    holdout_memory: FloatArray
    train_cells: FloatArray
    holdout_cells: FloatArray
    train_counts: FloatArray
    holdout_counts: FloatArray
    evaluations: int
    numerics: Numerics
    prior_residual: FloatArray = field(default_factory=lambda: np.zeros(0))
    converged: bool = False

    @property
    def chance(self) -> FloatArray:
        """Standard deviation of `columns` at the floor, by chance alone."""
        fitted, heldout = self.train_counts.sum(axis=1), self.holdout_counts.sum(axis=1)
        return np.asarray(np.sqrt(2 / np.maximum(_together(fitted, heldout, np.add), 1)))

    @property
    def overall_chance(self) -> float:
        """The same of `holdout`."""
        return float(np.sqrt(2 / max(self.holdout_counts.sum(), 1)))

    @property
    def misfit(self) -> float:
        """Sum over columns of the logarithm of held-out chi2: twice the log-likelihood lost a sample where
        each column's error size is unknown. One bad column cannot drown the others.
        """
        return float(np.sum(np.log(np.maximum(self.holdout_columns, CLEAN))))

    @property
    def misfit_fitted(self) -> float:
        """The same over fitted data."""
        return float(np.sum(np.log(np.maximum(self.train_columns, CLEAN))))

    @property
    def misfit_everywhere(self) -> float:
        """The same over all data, for what happens once and cannot be held out."""
        return float(np.sum(np.log(np.maximum(self.columns, CLEAN))))


def refit(
    study: Study,
    model: Model,
    *,
    polish: bool = False,
    iterations: int = 8,
    budget: Budget | None = None,
    progress: Progress = silent,
    judged: Study | None = None,
) -> Fitted:
    """Least squares that begin at a model; `polish` runs to convergence with central differences.

    `judged` is the study whose data say how good the result is, where that is not the one that is fitted. What a model
    states of its masses counts beside the errors that the study's columns are weighed by; where the model leaves much
    less, it is refitted beside its own.

    Raises
    ------
    KeyboardInterrupt
        The user interrupted; the study's journal, if it has one, holds what was simulated, except to polish.
    """
    budget, spent = budget or Budget(), 0
    for _ in range(RELIEFS):
        result = _minimised(study, model, polish, iterations, budget.after(spent), progress)
        model, spent = model.at(result.x), spent + result.evaluations
        found = replace(judge(judged or study, model, evaluations=spent), converged=result.converged)
        if not Stated.of(model.terms.parameters, study.redundancy).weight.any():
            break
        own = inflate(study, found, memory=study.independent)
        if not _is_relieved(study, own):
            break
        study = own
    return found


def _is_relieved(study: Study, own: Study) -> bool:
    """Whether columns are weighed by errors far beyond those of a model of its own."""
    return any(error**2 < RELIEVED * study.inflation.get(key, 1.0) ** 2 for key, error in own.inflation.items())


def _minimised(
    study: Study, model: Model, polish: bool, iterations: int, budget: Budget, progress: Progress
) -> FitResult:
    """Least squares as the study's columns are weighed."""
    problem = study.with_belief(study.train_problem(model.clipped()))
    estimator = LeastSquares(
        confirm=polish,
        max_iterations=30 if polish else iterations,
        tolerance=1e-6 if polish else TOLERANCE,
        least_gain=LeastSquares.least_gain if polish else LEAST_GAIN,
    )
    rough, step = model.terms.rough, study.stencil(model.terms)
    estimator = study.procedure.suited(estimator)
    if rough:
        estimator = replace(estimator, forward_step=step, central_step=step)
    rng = np.random.default_rng(0)
    # of arrays too large for a journal only the latest is kept, and another fit may still need its own
    journal = Journal() if polish else study.section()
    # play makes the objective rough; of laws that fit badly the corrections take more than they save
    costly = rough or model.terms.have_laws
    cheaper = study.procedure.deferred or not (polish or costly)
    if cheaper and study.numerics != study.cheap:
        result = deferred_fit(
            problem, study.cheap, estimator, rng=rng, budget=budget, journal=journal, progress=progress
        )
    else:
        result = estimator.fit(problem, rng=rng, budget=budget, journal=journal, progress=progress)
    if result.termination is Termination.INTERRUPTED:
        raise KeyboardInterrupt
    return result


def nearby(study: Study, cheap: Numerics, model: Model) -> tuple[float, Model]:
    """Mean log chi2 of fitted columns where a few steps from a model lead, by the derivatives of cheap numerics."""
    problem = study.train_problem(model)
    estimator = LeastSquares(confirm=False, max_iterations=4, tolerance=2e-4, least_gain=LEAST_GAIN)
    rng, journal = np.random.default_rng(0), Journal()
    found = deferred_fit(problem, cheap, estimator, rng=rng, budget=Budget(), journal=journal, progress=silent)
    if found.termination is Termination.INTERRUPTED:
        raise KeyboardInterrupt
    chi2 = problem.column_chi2(problem.residuals(found.x[None])[0])
    return float(np.mean(np.log(chi2))), model.at(found.x)


def best_start(study: Study, terms: Terms, starts: FloatArray) -> FloatArray:
    """The best (p,) of several first guesses (k, p); the first, unless another one is better by more than a trace."""
    starts = np.clip(starts, terms.lower, terms.upper)
    if len(starts) == 1:
        return np.asarray(starts[0])
    problem = study.with_belief(study.train_problem(Model(terms, starts[0])))
    try:
        losses = Evaluator(problem, budget=Budget(), journal=study.section(), progress=silent).loss(starts)
    except Stop:
        raise KeyboardInterrupt from None
    best = int(np.argmin(losses))
    return np.asarray(starts[best if losses[best] < NOTICEABLE * losses[0] else 0])


def judge(study: Study, model: Model, evaluations: int = 0) -> Fitted:
    """Scores of a model on fitted and held-out data."""
    # uncertain starts explain the less, the larger the noise is taken to be
    plain = replace(study, inflation={})
    train = plain.train_problem(model)
    holdout = plain.holdout_problem(model)
    r, s = of_both(train, holdout, lambda problem: np.asarray(problem.residuals(model.values[None])[0]))
    train_columns, holdout_columns = train.column_chi2(r), holdout.column_chi2(s)
    train_cells, train_counts = _by_cell(train, r)
    holdout_cells, holdout_counts = _by_cell(holdout, s)
    a, b = train.counts, holdout.counts
    return Fitted(
        model=model,
        train=float(np.average(train_columns, weights=a)),
        holdout=float(np.average(holdout_columns, weights=b)),
        train_columns=train_columns,
        holdout_columns=holdout_columns,
        columns=_together(train_columns, holdout_columns, lambda x, y: (x * a + y * b) / np.maximum(a + b, 1)),
        memory=_memory(train, r),
        holdout_memory=_memory(holdout, s),
        train_cells=train_cells,
        holdout_cells=holdout_cells,
        train_counts=train_counts,
        holdout_counts=holdout_counts,
        evaluations=evaluations + 1,
        numerics=study.numerics,
        prior_residual=prior_residual(model.terms.parameters, model.values) if study.redundancy else np.zeros(0),
    )


def _together(
    fitted: FloatArray, heldout: FloatArray, join: Callable[[FloatArray, FloatArray], FloatArray]
) -> FloatArray:
    """One number for each column of all data: joined where the same columns are held out, else one after another."""
    return join(fitted, heldout) if len(fitted) == len(heldout) else np.concatenate([fitted, heldout])


def inflate(study: Study, fitted: Fitted, *, memory: bool = False) -> Study:
    """The study with each column's noise inflated to the size of the error that a model leaves in it.

    Iterating fits with this is maximum likelihood where every column's error size is unknown. With `memory`
    each column counts with as many independent samples as its residual's autocorrelation leaves it (batch
    means: Geyer 1992, doi:10.1214/ss/1177011137), which is right for estimates under an error that stays, and
    wrong for finding its cause.
    """
    problem = study.train_problem(fitted.model)
    wrong = fitted.train_columns > CORRELATED
    length = np.where(wrong, fitted.memory, 1.0)
    redundancy = float(study.held) if not wrong.any() else problem.count / float(np.sum(problem.counts / length))
    worst: dict[tuple[str, str, str], float] = {}
    for chi2, own, (i, target, k) in zip(fitted.train_columns, length, problem.columns, strict=True):
        key = (problem.episodes[i].replay.log.meta.mount, target.channel, target.joints[k])
        # noise is white; an error of the model is not, and says as little as its independent samples
        error = chi2 * own if memory else chi2
        worst[key] = max(worst.get(key, 1.0), float(np.sqrt(error)) if np.isfinite(error) else 1.0)
    return replace(
        study, inflation=worst, independent=memory, redundancy=min(redundancy, 1.0) if memory else redundancy
    )


def robust_refit(
    study: Study, fitted: Fitted, rounds: int, budget: Budget | None = None, progress: Progress = silent
) -> tuple[Study, Fitted]:
    """Refit with inflated noise until the columns' errors settle; what `fitted` took is of the budget too."""
    budget = budget or Budget()
    for _ in range(rounds):
        before = fitted.train_columns
        study = inflate(study, fitted)
        again = refit(study, fitted.model, budget=budget.after(fitted.evaluations), progress=progress)
        fitted = replace(again, evaluations=again.evaluations + fitted.evaluations)
        # held-out data must not decide how long is fitted
        if np.all(np.abs(np.log(fitted.train_columns / before)) < 0.02):
            break
    return inflated(study, fitted)


def inflated(study: Study, fitted: Fitted) -> tuple[Study, Fitted]:
    """The study with inflated noise, and what was fitted as it judges that."""
    study = inflate(study, fitted)
    if not study.procedure.weighs_segments:
        return study, fitted
    # scores are in noise floors, but initial states take up more where columns count less
    return study, judge(study, fitted.model, fitted.evaluations)


def _memory(problem: ReplayProblem, residual: FloatArray) -> FloatArray:
    """Samples that count as one independent sample in each column's residual, (columns,).

    The larger of what its mean and what its size have: integrated autocorrelation by batch means over half-second
    stretches, and integrated squared autocorrelation (Bartlett 1946, doi:10.2307/2983611). What swings about nothing
    has no mean, however regular it is.
    """
    columns, blocks = problem.column_labels, problem.blocks
    width = int(blocks.max()) + 1
    cell = columns * width + blocks
    size = len(problem.columns) * width
    count = np.bincount(cell, minlength=size)
    total = np.bincount(cell, np.nan_to_num(residual), size)
    square = np.bincount(columns, np.nan_to_num(residual) ** 2, len(problem.columns))
    means = np.bincount(np.arange(size) // width, total**2 / np.maximum(count, 1), len(problem.columns))
    live = np.bincount(np.arange(size) // width, count > 0, len(problem.columns))
    variance = square / np.maximum(problem.counts, 1)
    ratio: FloatArray = means / np.maximum(live, 1) / np.maximum(variance, 1e-300)
    order = np.argsort(columns, kind="stable")
    series = np.split(np.nan_to_num(residual)[order], np.cumsum(np.bincount(columns))[:-1])
    longest = problem.counts / np.maximum(live, 1)
    swings = [_squared_autocorrelation(own, int(lags)) for own, lags in zip(series, longest, strict=True)]
    return np.maximum(np.maximum(ratio, swings), 1.0)


def _squared_autocorrelation(series: FloatArray, lags: int) -> float:
    """Sum over so many lags of either sign of what squared autocorrelations have beyond those of white noise."""
    n, power = len(series), float(series @ series)
    if n < 2 or lags < 1 or not power > 0:
        return 1.0
    spectrum = np.abs(np.fft.rfft(series, 2 * n)) ** 2
    rho = np.fft.irfft(spectrum)[1 : min(lags, n - 1) + 1] / power
    return 1.0 + 2.0 * float(np.sum(rho**2 - 1.0 / n))


def _by_cell(problem: ReplayProblem, residual: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Sums of squares over noise floor, and numbers of samples, (columns, stretches) each."""
    columns, blocks = problem.column_labels, problem.blocks
    width, height = int(blocks.max()) + 1, len(problem.columns)
    square = np.nan_to_num(residual, nan=1e6) ** 2 * problem.inflation[columns]
    cell = columns * width + blocks
    sums, counts = (np.bincount(cell, w, height * width) for w in (square, np.ones(len(residual))))
    return np.asarray(sums.reshape(-1, width)), np.asarray(counts.reshape(-1, width))


def paired_t(better: Fitted, worse: Fitted) -> float:
    """Paired t statistic, over stretches of time of all data, of the decrease from `worse` to `better`.

    Columns are weighed by what the better one leaves in them: one that it does not explain cannot decide.
    """
    pairs = (
        (better.train_cells, worse.train_cells, better.train_columns),
        (better.holdout_cells, worse.holdout_cells, better.holdout_columns),
    )
    changes = []
    for ours, theirs, chi2 in pairs:
        live = (theirs > 0).any(axis=0) | (ours > 0).any(axis=0)
        changes.append((((theirs - ours) / np.maximum(chi2, 1.0)[:, None]).sum(axis=0))[live])
    difference = np.concatenate(changes)
    if len(difference) < 3:
        return 0.0
    spread = float(np.std(difference, ddof=1))
    return float(np.mean(difference) / spread * np.sqrt(len(difference))) if spread > 0 else 0.0


def shorten(study: Study, seconds: float) -> Study:
    """The same study with at most so many seconds of each training log, and a coarse integrator where that will do."""
    return replace(study, train=tuple(e.shortened(seconds) for e in study.train), numerics=study.coarse)
