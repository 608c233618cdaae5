"""What drawing a posterior returns: draws, estimates, predictions, and their result."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from sysid_btr._typing import FloatArray
from sysid_btr.identify.fit import Fit
from sysid_btr.identify.intervals import Estimate
from sysid_btr.identify.outcome import StudyOutcome
from sysid_btr.identify.scores import Scores
from sysid_btr.identify.study import Study
from sysid_btr.posterior.likelihood import Likelihood
from sysid_btr.posterior.predictive import Band
from sysid_btr.posterior.priors import Prior, moments
from sysid_btr.posterior.sampling import Sample
from sysid_btr.terms.model import Model

NOTICEABLE_GAIN = 2.0
"""Log-likelihood of a draw over the fit's beyond which the fit was not the minimum."""


@dataclass(frozen=True, eq=False, repr=False)
class Posterior(StudyOutcome):
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

    @property
    def study(self) -> Study:
        """As fitted."""
        return self.fit.study

    @property
    def model(self) -> Model:
        """The terms at the posterior means."""
        return self.fit.model.at(self.values)

    @property
    def parameters(self) -> tuple[Estimate, ...]:
        """The declared parameters, as in result.json: here these are all `estimates`."""
        return self.estimates

    @property
    def as_fit(self) -> Fit:
        """The model of the posterior means, where a fit is asked for."""
        return replace(self.fit, model=self.model, estimates=self.estimates, before=self.after)

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

    @property
    def message(self) -> str:
        """The outcome in one sentence."""
        told = sum(e.identifiable != "no" for e in self.estimates)
        found = self.sample.convergence
        parts = [
            f"{told} of {len(self.estimates)} parameters are identifiable from this log",
            f"{float(np.min(found.ess)):.0f} effective draws or more, R-hat {float(np.max(found.rhat)):.3f} or less",
            *(
                f"{100 * share:.1f} % of held-out {channel} lie in the 95 % bands"
                for channel, share in self.coverage.items()
            ),
        ]
        if self.sample.gain > NOTICEABLE_GAIN:
            best = self.sample.flat[int(np.argmax(self.sample.log_likelihood))]
            start = " ".join(f"--start '{n}={v:.6g}'" for n, v in zip(self.sample.names, best, strict=True))
            parts.append(
                f"a draw is more likely than the fit by exp({self.sample.gain:.1f}), so the fit had missed the "
                f"minimum: start again with {start}"
            )
        if not self.converged:
            parts.append("the posterior did not converge")
        return "; ".join(parts) + "."

    @property
    def found(self) -> dict[str, Any]:
        """What results of kind ``posterior`` have beside study and cost."""
        drawn = self.sample
        fitted = self.as_fit.found
        return {
            **fitted,
            "kind": "posterior",
            "message": self.message,
            "converged": drawn.converged,
            "termination": drawn.termination,
            "parameters": self._parameters(fitted["parameters"]),
            **_sampling(drawn),
            "likelihood": {
                "method": "Gaussian, adjusted to the covariance of correlated residuals (Chandler and Bate 2007)",
                "independent_share": self.likelihood.share,
            },
            "predictive": {channel: {"coverage95": share} for channel, share in self.coverage.items()},
        }

    def _parameters(self, entries: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
        convergence, draws = self.sample.convergence, self.sample.flat
        return [
            {
                **entry,
                "median": float(np.median(draws[:, i])),
                "prior": str(prior),
                "posterior_over_prior_std": float(learnt),
                "rhat": float(convergence.rhat[i]),
                "autocorrelation_time": float(convergence.tau[i]),
                "ess": float(convergence.ess[i]),
                "least_squares": {"value": own.value, "std": own.std},
            }
            for i, (entry, own, prior, learnt) in enumerate(
                zip(entries, self.fit.estimates, self.priors, self.learnt, strict=True)
            )
        ]


def _sampling(drawn: Sample) -> dict[str, Any]:
    """How the draws were made, and how good they are."""
    found = drawn.convergence
    ensembles, steps, walkers, _ = drawn.draws.shape
    return {
        "sampling": {
            "ensembles": ensembles,
            "walkers": walkers,
            "burn_in": found.burn_in,
            "steps": steps,
            "draws": ensembles * steps * walkers,
            "log_likelihood_gain": drawn.gain,
            "autocorrelation_times": steps / float(np.max(found.tau)),
            "rhat": float(np.max(found.rhat)),
            "ess": float(np.min(found.ess)),
            "replays": drawn.evaluations,
        },
        "surrogate": {
            "method": "quadratic model of the residuals, each proposal judged by a real replay (surrogate transition)",
            "acceptance": drawn.surrogate.acceptance,
            "log_likelihood_error": drawn.surrogate.error,
            "proposals": drawn.surrogate.proposals,
        },
    }
