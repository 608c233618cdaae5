"""What a log says about parameters as a distribution: priors, sampling with real replays, checks, export.

>>> import sysid_btr as sb
>>> drawn = sb.posterior(sb.fit(study, ["mass:*Knee*", "kp:*=shared"]))  # doctest: +SKIP

This package is called like the function of its name::

    posterior(fit, *, priors=None, settings=None, rng=None, budget=None, journal=None, progress=watched) -> Posterior

    fit : the fit whose parameters are wanted.
    priors : name, glob or field -> prior as text, such as ``{"kp:*": "normal(1, 0.1)"}``.
    settings : ensembles, walkers, criteria of convergence (`Settings`).
    rng, budget, journal, progress : as of `sysid_btr.fit`; by default seed 0 and 20 000 replays.

`sysid_btr.posterior.draw.posterior` has all of it.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from importlib import import_module
from types import ModuleType
from typing import TYPE_CHECKING, Any

from sysid_btr.progress import watched

if TYPE_CHECKING:
    from numpy.random import Generator

    from sysid_btr.estimators.base import Budget, Progress
    from sysid_btr.estimators.journal import Journal
    from sysid_btr.identify.fit import Fit
    from sysid_btr.posterior.draw import posterior
    from sysid_btr.posterior.export import to_datatree
    from sysid_btr.posterior.outcome import Posterior
    from sysid_btr.posterior.sampling import Settings

_HOME = {"Posterior": "outcome", "posterior": "draw", "to_datatree": "export", "Settings": "sampling"}

__all__ = ["Posterior", "Settings", "posterior", "to_datatree"]


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}; it offers {', '.join(__all__)}")
    return getattr(import_module(f"{__name__}.{_HOME[name]}"), name)


class _Package(ModuleType):
    """A package that is called like its function, so that ``sb.posterior`` means one thing in whatever order the
    two were imported.
    """

    def __call__(
        self,
        fit: Fit,
        *,
        priors: Mapping[str, str] | None = None,
        settings: Settings | None = None,
        rng: Generator | None = None,
        budget: Budget | None = None,
        journal: Journal | None = None,
        progress: Progress = watched,
    ) -> Posterior:
        """Draw the posterior of the parameters of a fit, see `sysid_btr.posterior.posterior`."""
        from sysid_btr.posterior.draw import posterior

        return posterior(
            fit, priors=priors, settings=settings, rng=rng, budget=budget, journal=journal, progress=progress
        )


sys.modules[__name__].__class__ = _Package
