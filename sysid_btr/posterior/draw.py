"""The posterior of a fit: what is known of the parameters once the log has been seen."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from time import perf_counter
from typing import TYPE_CHECKING

import numpy as np

from sysid_btr._typing import FloatArray
from sysid_btr.estimators.base import Budget, Progress, without_loss
from sysid_btr.estimators.journal import Journal
from sysid_btr.identify.fit import Fit
from sysid_btr.identify.intervals import Estimate, correlations, identifiability
from sysid_btr.identify.scores import score
from sysid_btr.identify.sensitivity import with_sensitivity
from sysid_btr.posterior.likelihood import make_likelihood, settle
from sysid_btr.posterior.outcome import Posterior
from sysid_btr.posterior.predictive import coverage, predict_bands
from sysid_btr.posterior.priors import choose_priors
from sysid_btr.posterior.sampling import Sample, Settings, sample
from sysid_btr.progress import phase, shows_progress, watched

if TYPE_CHECKING:
    from numpy.random import Generator

BUDGET = Budget(evaluations=20_000)
"""Where nothing is said."""
PREDICTIVE_DRAWS = 48
AT_BOUND = (0.1, 0.04)
"""At its bound: more than this share (second) of the draws within this many standard deviations of it."""


@shows_progress("posterior")
def posterior(
    fit: Fit,
    *,
    priors: Mapping[str, str] | None = None,
    settings: Settings | None = None,
    rng: Generator | None = None,
    budget: Budget | None = None,
    journal: Journal | None = None,
    progress: Progress = watched,
) -> Posterior:
    """Draw the posterior of the parameters of a fit, each draw a real replay of the training data.

    At least two independent ensembles (emcee) start about the fit, wider than the posterior. Each proposal is the
    end of a chain under a quadratic model of the residuals, accepted or rejected by a real replay
    (`posterior.surrogate`), so the draws are exact whatever that model is worth; `Sample.surrogate` says how often
    it was right. The likelihood counts correlated residuals as the intervals of `fit` do, but not what the model lacks
    (`posterior.likelihood`). Converged when every ensemble is 50 autocorrelation times long and R-hat over
    the ensembles is below 1.01.

    Parameters
    ----------
    fit : of the study whose parameters are wanted; what it holds at nominal values is freed.
    priors : name, glob or field -> prior as text, such as ``normal(1, 0.1)``; over those of the robot's table.
        Uniform within the bounds where nothing is said.
    settings : ensembles, walkers, criteria of convergence.
    rng : default seed 0.
    budget, journal, progress : see `sysid_btr.estimators`; default 20 000 replays.

    Raises
    ------
    UsageError
        Priors or settings cannot be used, or the packages of the extra ``posterior`` are missing.
    NotConvergedError
        The budget ends before there is a draw.
    """
    began = perf_counter()
    parameters = fit.model.terms.parameters
    chosen = choose_priors(parameters, priors or {}, fit.study.robot.priors)
    problem = fit.study.train_problem(fit.model)
    x, residual, jacobian, extra = settle(problem, fit.model.values, fit.study.stencil(fit.model.terms))
    likelihood = make_likelihood(problem, x, residual, jacobian, problem.blocks, fit.numerics_shift)
    with phase("draws", 0.95):
        drawn = sample(
            replace(problem, start=x),
            likelihood,
            chosen,
            settings=settings or Settings(),
            rng=np.random.default_rng(0) if rng is None else rng,
            budget=budget or BUDGET,
            journal=Journal() if journal is None else journal,
            progress=without_loss(progress),
        )
    values = drawn.flat.mean(axis=0)
    with phase("predictions", 0.9):
        bands = predict_bands(fit.study, fit.model.at(values), drawn.thinned(PREDICTIVE_DRAWS))
    return Posterior(
        fit=fit,
        priors=chosen,
        likelihood=likelihood,
        sample=drawn,
        estimates=with_sensitivity(_estimates(fit, drawn, jacobian), problem, jacobian),
        values=values,
        after=score(fit.study, fit.model.at(values)),
        bands=bands,
        coverage=coverage(bands),
        replays=fit.replays + extra + drawn.evaluations + PREDICTIVE_DRAWS,
        seconds=fit.seconds + perf_counter() - began,
    )


def _estimates(fit: Fit, drawn: Sample, jacobian: FloatArray) -> tuple[Estimate, ...]:
    flat = drawn.flat
    parameters = fit.model.terms.parameters
    mean, std = flat.mean(axis=0), flat.std(axis=0)
    low, high = np.quantile(flat, [0.025, 0.975], axis=0)
    covariance = np.atleast_2d(np.cov(flat.T))
    together = correlations(covariance)
    norm = np.sqrt(np.einsum("ij,ij->j", jacobian, jacobian))
    result = []
    for i, parameter in enumerate(parameters):
        state, reason = identifiability(i, parameters, std, norm, covariance, parameter.upper - parameter.lower)
        near, share = AT_BOUND
        close = [np.mean(np.abs(flat[:, i] - end) < near * std[i]) for end in (parameter.lower, parameter.upper)]
        at_bound = bool(state != "no" and max(close) > share)
        result.append(
            Estimate(
                name=parameter.name,
                unit=parameter.unit,
                nominal=parameter.nominal,
                value=float(mean[i]),
                std=float(std[i]),
                ci95=(float(low[i]), float(high[i])),
                bounds=(parameter.lower, parameter.upper),
                identifiable=state,
                at_bound=at_bound,
                reason=reason or ("the posterior piles up at its bound" if at_bound else ""),
                correlation=tuple(map(float, together[i])),
            )
        )
    return tuple(result)
