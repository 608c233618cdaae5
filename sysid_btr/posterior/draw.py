"""The posterior of a fit: what is known of the parameters once the log has been seen."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from time import perf_counter
from typing import TYPE_CHECKING

import numpy as np

from sysid_btr._typing import FloatArray
from sysid_btr.estimators.base import Budget, Progress, silent
from sysid_btr.estimators.journal import Journal
from sysid_btr.identify.fit import Fit
from sysid_btr.identify.intervals import Estimate, tell
from sysid_btr.identify.scores import Scores, score
from sysid_btr.posterior.likelihood import Likelihood, make_likelihood, settle
from sysid_btr.posterior.predictive import Band, coverage, predict_bands
from sysid_btr.posterior.priors import Prior, choose_priors, moments
from sysid_btr.posterior.sampling import Sample, Settings, sample

if TYPE_CHECKING:
    from numpy.random import Generator

    from sysid_btr.identify.study import Study

BUDGET = Budget(evaluations=20_000)
"""Where nothing is said."""
PREDICTIVE_DRAWS = 48
AT_BOUND = (0.1, 0.04)
"""At its bound: more than this share (second) of the draws within this many standard deviations of it."""


@dataclass(frozen=True, eq=False)
class Posterior:
    """Draws of the posterior of a fit's parameters.

    Attributes
    ----------
    fit : what it began from.
    priors : one a parameter.
    likelihood : what a replay's loss was taken to say.
    sample : draws, and whether they converged.
    estimates : mean, standard deviation and central 95 % of the draws, one a parameter.
    values : (p,) posterior means.
    after : scores at the means, on fitted and held-out data.
    bands : predictions of every held-out sensor.
    coverage : channel -> share of held-out samples inside the 95 % bands.
    replays : candidates simulated, those of the fit included.
    seconds : wall time, that of the fit included.
    """

    fit: Fit
    priors: tuple[Prior, ...]
    likelihood: Likelihood
    sample: Sample
    estimates: tuple[Estimate, ...]
    values: FloatArray
    after: Scores
    bands: tuple[Band, ...]
    coverage: Mapping[str, float]
    replays: int
    seconds: float

    def _repr_html_(self) -> str:
        from sysid_btr.display.html import result_html
        from sysid_btr.result import make_result

        return result_html(make_result(self))

    @property
    def study(self) -> Study:
        """As fitted."""
        return self.fit.study

    @property
    def as_fit(self) -> Fit:
        """The model of the posterior means, where a fit is asked for."""
        return replace(self.fit, model=self.fit.model.at(self.values), estimates=self.estimates, before=self.after)

    @property
    def converged(self) -> bool:
        """Whether the draws can be relied on."""
        return self.sample.converged

    @property
    def learnt(self) -> FloatArray:
        """(p,) posterior over prior standard deviation: 1 where the log says nothing."""
        pairs = zip(self.priors, self.fit.model.terms.parameters, strict=True)
        prior = [moments(prior, p.lower, p.upper)[1] for prior, p in pairs]
        return np.asarray(np.array([e.std for e in self.estimates]) / np.array(prior))


def posterior(
    fit: Fit,
    *,
    priors: Mapping[str, str] | None = None,
    settings: Settings | None = None,
    rng: Generator | None = None,
    budget: Budget | None = None,
    journal: Journal | None = None,
    progress: Progress = silent,
) -> Posterior:
    """Draw the posterior of the parameters of a fit, each draw a real replay of the training data.

    At least two independent ensembles (emcee) start about the fit, wider than the posterior. Each proposal is the
    end of a chain under a quadratic model of the residuals, accepted or rejected by a real replay
    (`posterior.surrogate`), so the draws are exact whatever that model is worth; `Sample.surrogate` says how often
    it was right. The likelihood counts correlated residuals and what the model lacks as the intervals of
    `fit` do (`posterior.likelihood`). Converged when every ensemble is 50 autocorrelation times long and R-hat over
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
    drawn = sample(
        replace(problem, start=x),
        likelihood,
        chosen,
        settings=settings or Settings(),
        rng=np.random.default_rng(0) if rng is None else rng,
        budget=budget or BUDGET,
        journal=Journal() if journal is None else journal,
        progress=progress,
    )
    values = drawn.flat.mean(axis=0)
    bands = predict_bands(fit.study, fit.model.at(values), drawn.thinned(PREDICTIVE_DRAWS))
    return Posterior(
        fit=fit,
        priors=chosen,
        likelihood=likelihood,
        sample=drawn,
        estimates=_estimates(fit, drawn, jacobian),
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
    norm = np.sqrt(np.einsum("ij,ij->j", jacobian, jacobian))
    result = []
    for i, parameter in enumerate(parameters):
        state, reason = tell(i, parameters, std, norm, covariance, parameter.upper - parameter.lower)
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
            )
        )
    return tuple(result)
