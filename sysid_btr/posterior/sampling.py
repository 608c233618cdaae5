"""Independent ensembles, drawn until they have converged or the budget is out."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from sysid_btr._typing import FloatArray
from sysid_btr.errors import NotConvergedError, UsageError
from sysid_btr.estimators.base import Budget, Progress, ResidualProblem, Termination
from sysid_btr.estimators.ensemble import (
    FAILED,
    autocorrelation_time,
    bounded,
    folded,
    log_jacobian,
    new_sampler,
    seeded,
    unbounded,
    walkers_for,
)
from sysid_btr.estimators.evaluator import Evaluator, Outcome, drive
from sysid_btr.estimators.journal import Journal
from sysid_btr.optional import optional
from sysid_btr.posterior.likelihood import Likelihood
from sysid_btr.posterior.priors import Prior, log_prior, moments
from sysid_btr.posterior.surrogate import Foretold, Guess, Proposal, regress, surrogate_move

if TYPE_CHECKING:
    from numpy.random import Generator

ROUND = 10
"""Steps of every ensemble between two looks at convergence; a tenth of the chain once that is more."""
BURN_IN = 5.0
"""Autocorrelation times dropped from the beginning of every chain."""
SUBSTEPS = 30
"""Moves under the surrogate for each replay: a replay costs more than a thousand of them."""
_REACHES = (1.0, 0.3, 0.1, 0.03, 0.01)
_MESSAGES = {
    Termination.CONVERGED: "Converged: the ensembles agree, and each is long against its autocorrelation.",
    Termination.BUDGET_SPENT: (
        "The budget was spent before the posterior converged: its draws are written, but are not reliable. Resume "
        "with a larger --max-evaluations."
    ),
    Termination.ITERATION_LIMIT: (
        "The posterior had not converged when the limit of steps was reached: its draws are written, but are not "
        "reliable."
    ),
    Termination.INTERRUPTED: "Interrupted: the draws so far are returned, and the journal can be resumed.",
}


@dataclass(frozen=True)
class Settings:
    """How a posterior is drawn.

    Attributes
    ----------
    ensembles : independent ones, at least 2: walkers of one ensemble are not independent chains.
    walkers : of each, even; None: ``2 (p + 1)``, and at least 8.
    overdispersion : spread of the starts, in standard deviations foretold.
    substeps : moves under the surrogate for each replay.
    direct : share of plain stretch moves of the true density, so that no region is shut off because the
        surrogate thinks nothing of it.
    autocorrelation_times : length that every chain must have, after its burn-in.
    rhat : largest rank-normalised split R-hat allowed over the ensembles.
    draws : effective number of draws that each parameter must have, for the tails of its intervals.
    fewest_steps, max_steps : of each ensemble.
    """

    ensembles: int = 2
    walkers: int | None = None
    overdispersion: float = 3.0
    substeps: int = SUBSTEPS
    direct: float = 0.05
    autocorrelation_times: float = 50.0
    rhat: float = 1.01
    draws: float = 1000.0
    fewest_steps: int = 50
    max_steps: int = 20_000

    def __post_init__(self) -> None:
        if self.ensembles < 2:
            raise UsageError("a posterior needs at least 2 ensembles: convergence is judged by whether they agree")
        if not 0.0 <= self.direct <= 1.0 or not self.overdispersion > 0.0 or not self.rhat > 1.0:
            raise UsageError("posterior: direct must lie in [0, 1], overdispersion above 0, rhat above 1")


@dataclass(frozen=True, eq=False)
class Convergence:
    """Whether chains can be relied on.

    Attributes
    ----------
    burn_in, steps : dropped and kept steps of each ensemble.
    tau : (p,) integrated autocorrelation time in steps, the longest over ensembles.
    rhat : (p,) over the ensembles (Vehtari et al. 2021, doi:10.1214/20-BA1221).
    ess : (p,) effective number of draws.
    """

    burn_in: int
    steps: int
    tau: FloatArray
    rhat: FloatArray
    ess: FloatArray

    def reached(self, settings: Settings) -> bool:
        """Whether they are long enough, and agree."""
        return bool(self.steps >= self.needed(settings) and np.all(self.rhat < settings.rhat))

    def needed(self, settings: Settings) -> float:
        """Steps that would be enough with autocorrelation times as found."""
        many = settings.draws * self.steps / max(float(self.ess.min()), 1e-300)
        return max(settings.autocorrelation_times * float(self.tau.max()), many, settings.fewest_steps)


@dataclass(frozen=True, eq=False)
class SurrogateCheck:
    """How good the model of the residuals was that proposals were drawn from; the draws are exact whatever it says.

    Attributes
    ----------
    acceptance : share of its proposals that a real replay accepted; 1 if it were perfect.
    error : standard deviation, over the draws, of true minus foretold log-likelihood.
    proposals : made.
    """

    acceptance: float
    error: float
    proposals: int


@dataclass(frozen=True, eq=False)
class Sample:
    """Draws of a posterior and what is known of their quality.

    Attributes
    ----------
    names : of the parameters.
    draws : (ensembles, steps, walkers, p) after burn-in, in the parameters' units.
    log_density : (ensembles, steps, walkers) of the posterior at them, up to a constant.
    log_likelihood : (ensembles, steps, walkers) adjusted, relative to the fit's.
    convergence, surrogate : checks.
    converged : whether the first is passed.
    termination : why sampling ended, in a sentence.
    evaluations : replays.
    seconds : wall time, earlier runs of a resumed journal included.
    """

    names: tuple[str, ...]
    draws: FloatArray
    log_density: FloatArray
    log_likelihood: FloatArray
    convergence: Convergence
    surrogate: SurrogateCheck
    converged: bool
    termination: str
    evaluations: int
    seconds: float

    @property
    def gain(self) -> float:
        """Log-likelihood by which the best draw exceeds the fit; above 0 the fit was not the best there is."""
        return float(self.log_likelihood.max())

    @property
    def flat(self) -> FloatArray:
        """All draws, (draws, p)."""
        return self.draws.reshape(-1, self.draws.shape[-1])

    def thinned(self, count: int) -> FloatArray:
        """At most `count` draws, (count, p), spread evenly over steps and ensembles."""
        flat = self.flat
        return flat[np.unique(np.linspace(0, len(flat) - 1, min(count, len(flat))).astype(np.int64))]


def sample(
    problem: ResidualProblem,
    likelihood: Likelihood,
    priors: Sequence[Prior],
    *,
    settings: Settings,
    rng: Generator,
    budget: Budget,
    journal: Journal,
    progress: Progress,
) -> Sample:
    """Draw from ``exp(log-likelihood) prior`` within the bounds of a problem.

    Parameters
    ----------
    problem : its residuals are modelled, and its loss is evaluated at every proposal.
    likelihood : what a loss says.
    priors : one a parameter.
    settings : ensembles and convergence.
    rng, budget, journal, progress : as for an estimator; the same seed and journal give the same draws.

    Raises
    ------
    UsageError
        Too few walkers, or emcee or arviz-stats is missing.
    NotConvergedError
        The budget ends before there is one draw of every ensemble.
    """
    optional("arviz_stats.base", "posterior", "the check of convergence")
    p = len(likelihood.centre)
    walkers = walkers_for(p, settings.walkers)
    first, *sources = rng.spawn(settings.ensembles + 1)
    runs: list[_Run] = []

    def search(evaluator: Evaluator) -> Outcome:
        expected = _expected(likelihood, priors)
        target = _Target(evaluator, likelihood, priors, regress(problem, evaluator, *expected, first))
        wide = Guess.about(*expected, settings.overdispersion)
        guess = Guess.about(*expected)
        for source in sources:
            begin = _overdispersed(target, wide, walkers, source)
            runs.append(
                _Run.begin(target, begin, Proposal(target.foretold, guess, settings.substeps, source), settings)
            )
        while runs[0].steps < settings.max_steps:
            for _ in range(max(ROUND, runs[0].steps // ROUND)):
                for i, run in enumerate(runs):
                    target.note = f"ensemble {i + 1} of {len(runs)}, {outlook.said}"
                    run.advance()
            found = assess([run.chain for run in runs])
            outlook.see(found, settings, evaluator.evaluations, runs[0].steps)
            if found.reached(settings):
                return Outcome(Termination.CONVERGED)
        return Outcome(Termination.ITERATION_LIMIT)

    outlook = _Outlook(budget)
    outcome = drive(problem, search, budget=budget, journal=journal, progress=outlook.report(progress))
    done = min((run.steps for run in runs), default=0) if len(runs) == settings.ensembles else 0
    if done < 2:
        raise NotConvergedError(
            f"sampling ended after {outcome.evaluations} replays, before the first draw: "
            f"{settings.ensembles} ensembles of {walkers} walkers need "
            f"{settings.ensembles * walkers} replays a step, and at least {settings.fewest_steps} steps: "
            "raise --max-evaluations, or continue with --resume"
        )
    return _collect(problem.names, runs, likelihood, outcome.termination, outcome.evaluations, outcome.seconds)


def assess(chains: Sequence[FloatArray]) -> Convergence:
    """Convergence of independent ensembles (steps, walkers, p) each; the shortest decides how many steps count.

    An ensemble is one chain of R-hat: all its walkers in the order of their steps, split in two.
    """
    steps = min(len(c) for c in chains)
    p = chains[0].shape[2]
    # the whole chain, with its way from the start: a walker that was long lost out there counts
    longest = float(np.max([autocorrelation_time(c[:steps]) for c in chains]))
    burn_in = int(min(np.ceil(BURN_IN * longest), steps // 2)) if np.isfinite(longest) else steps // 2
    kept = [c[burn_in:steps] for c in chains]
    tau = np.max(np.stack([autocorrelation_time(c) for c in kept]), axis=0)
    rhat = np.full(p, np.inf)
    if steps - burn_in >= 4:
        stacked = np.stack([c.reshape(-1, p) for c in kept])
        stats = optional("arviz_stats.base", "posterior", "the check of convergence").array_stats
        moved = np.ptp(stacked, axis=(0, 1)) > 0
        rhat[moved] = stats.rhat(stacked[:, :, moved], chain_axis=0, draw_axis=1, method="rank")
    count = sum(c.shape[0] * c.shape[1] for c in kept)
    return Convergence(burn_in=burn_in, steps=steps - burn_in, tau=tau, rhat=rhat, ess=count / tau)


@dataclass(eq=False)
class _Target:
    """True and foretold log density in the walkers' space."""

    evaluator: Evaluator
    likelihood: Likelihood
    priors: Sequence[Prior]
    model: Foretold
    note: str = "starting"

    def true(self, v: FloatArray) -> FloatArray:
        """By a real replay of each point (m, p)."""
        u = bounded(v)
        loss = self.evaluator.loss(self.evaluator.box.leave(u), self.note)
        failed = ~np.isfinite(loss)
        value = self.likelihood.log(u, np.where(failed, self.likelihood.loss, loss)) + self._rest(u, v)
        return np.where(failed | ~np.isfinite(value), FAILED, value)

    def foretold(self, v: FloatArray) -> FloatArray:
        """By the model of the residuals."""
        u = bounded(v)
        value = self.likelihood.log(u, self.model.loss(u)) + self._rest(u, v)
        return np.where(np.isfinite(value), value, FAILED)

    def _rest(self, u: FloatArray, v: FloatArray) -> FloatArray:
        return log_prior(self.priors, self.evaluator.box.leave(u)) + log_jacobian(v)

    def log_likelihood(self, v: FloatArray, value: FloatArray) -> FloatArray:
        """The likelihood's part of true log densities."""
        return value - self._rest(bounded(v), v)


@dataclass(eq=False)
class _Run:
    """One ensemble as it goes on."""

    target: _Target
    sampler: Any
    state: Any
    proposal: Proposal
    visited: list[FloatArray] = field(default_factory=list)
    density: list[FloatArray] = field(default_factory=list)
    accepted: int = 0
    proposed: int = 0

    @classmethod
    def begin(
        cls, target: _Target, start: tuple[FloatArray, FloatArray], proposal: Proposal, settings: Settings
    ) -> _Run:
        coordinates, density = start
        moves = [(surrogate_move(proposal), 1.0 - settings.direct), (_stretch(), settings.direct)]
        walkers, p = coordinates.shape
        sampler = new_sampler(walkers, p, target.true, [m for m in moves if m[1] > 0.0])
        state = seeded(coordinates, proposal.rng)
        state.log_prob = density
        return cls(target, sampler, state, proposal)

    @property
    def steps(self) -> int:
        """Finished steps of all walkers."""
        return len(self.visited)

    @property
    def chain(self) -> FloatArray:
        """(steps, walkers, p) in the unit cube."""
        return bounded(np.array(self.visited))

    def advance(self) -> None:
        """One more step of every walker."""
        made, before = self.proposal.made, np.array(self.state.coords)
        for state in self.sampler.sample(self.state, iterations=1, store=False, skip_initial_state_check=True):
            self.state = state
        self.visited.append(np.array(self.state.coords))
        self.density.append(np.array(self.state.log_prob))
        if self.proposal.made > made:
            self.proposed += self.proposal.made - made
            self.accepted += int(np.any(self.visited[-1] != before, axis=1).sum())


def _stretch() -> Any:
    return optional("emcee", "posterior", "ensemble sampling").moves.StretchMove()


def _expected(likelihood: Likelihood, priors: Sequence[Prior]) -> tuple[FloatArray, FloatArray]:
    """Mean (p,) and covariance (p, p) that the posterior would have if it were normal, in the unit cube."""
    box = likelihood.box
    known = np.array([moments(*given) for given in zip(priors, box.lower, box.upper, strict=True)])
    return likelihood.expected(box.enter(known[:, 0]), known[:, 1] / box.span)


def _overdispersed(target: _Target, wide: Guess, walkers: int, rng: Generator) -> tuple[FloatArray, FloatArray]:
    """Walkers (w, p) spread wider than the posterior, and their densities; failed ones are drawn closer."""
    coordinates, density = np.zeros((walkers, len(wide.centre))), np.full(walkers, FAILED)
    for reach in _REACHES:
        missing = density <= FAILED
        if not missing.any():
            break
        near = wide.centre + reach * (wide.draw(int(missing.sum()), rng) - wide.centre)
        coordinates[missing] = unbounded(folded(near))
        density[missing] = target.true(coordinates[missing])
    return coordinates, density


@dataclass(eq=False)
class _Outlook:
    """How far it is: the replays that convergence will have taken, told with the progress."""

    budget: Budget
    total: int | None = None
    said: str = "starting"

    def see(self, found: Convergence, settings: Settings, evaluations: int, steps: int) -> None:
        """Foretell from what was found so far."""
        needed = found.needed(settings)
        self.said = f"{found.steps} steps"
        if needed < 1e9:
            rate = evaluations / max(steps, 1)
            self.total = max(int(rate * (needed + found.burn_in)), evaluations)
            self.said = f"{found.steps} of {needed:.0f} steps, R-hat {float(found.rhat.max()):.3f}"
        if self.budget.evaluations is not None:
            self.total = min(self.total or self.budget.evaluations, self.budget.evaluations)

    def report(self, progress: Progress) -> Progress:
        """The progress with the replays foretold as its total."""

        def told(*, done: int, total: int | None, best: float, note: str) -> None:
            progress(done=done, total=total if self.total is None else max(self.total, done), best=best, note=note)

        return told


def _collect(
    names: Sequence[str],
    runs: Sequence[_Run],
    likelihood: Likelihood,
    termination: Termination,
    evaluations: int,
    seconds: float,
) -> Sample:
    found = assess([run.chain for run in runs])
    window = slice(found.burn_in, found.burn_in + found.steps)

    def stacked(get: Callable[[_Run], FloatArray]) -> FloatArray:
        return np.stack([get(run)[window] for run in runs])

    target = runs[0].target
    v = stacked(lambda run: np.array(run.visited))
    density = stacked(lambda run: np.array(run.density))
    flat, flat_density = v.reshape(-1, v.shape[-1]), density.reshape(-1)
    u = bounded(flat)
    log_likelihood = target.log_likelihood(flat, flat_density)
    good = flat_density > 0.5 * FAILED
    error = (
        float(np.std((log_likelihood - likelihood.log(u, target.model.loss(u)))[good])) if good.any() else float("inf")
    )
    proposed = sum(run.proposed for run in runs)
    return Sample(
        names=tuple(names),
        draws=likelihood.box.leave(u).reshape(v.shape),
        log_density=density,
        log_likelihood=log_likelihood.reshape(density.shape),
        convergence=found,
        surrogate=SurrogateCheck(
            acceptance=sum(run.accepted for run in runs) / max(proposed, 1), error=error, proposals=proposed
        ),
        converged=termination is Termination.CONVERGED,
        termination=_MESSAGES.get(termination, termination.value),
        evaluations=evaluations,
        seconds=seconds,
    )
