"""Estimators by name, built in or installed by other packages."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import fields, is_dataclass
from typing import Any

from sysid_btr.errors import UsageError
from sysid_btr.estimators.base import Estimator
from sysid_btr.estimators.chain import Chain
from sysid_btr.estimators.cma_es import CmaEs
from sysid_btr.estimators.derivative_free import LOCAL, NLopt
from sysid_btr.estimators.ensemble import Ensemble
from sysid_btr.estimators.ga import GeneticAlgorithm
from sysid_btr.estimators.lsq import LeastSquares
from sysid_btr.plugins import installed, load_installed

ENTRY_POINTS = "sysid_btr.estimators"
"""Entry-point group; each entry is a factory: keyword settings to an `Estimator`.

A factory that also takes a text as first argument is given what follows ``:`` in the name.
"""

Factory = Callable[..., Estimator]

BUILT_IN: Mapping[str, Factory] = {
    "lsq": LeastSquares,
    "ga": GeneticAlgorithm,
    "cmaes": CmaEs,
    "nlopt": NLopt,
    "emcee": Ensemble,
}
_WITH_ARGUMENT = {"nlopt": LOCAL[0]}


def available() -> tuple[str, ...]:
    """Names of the estimators installed; ``nlopt:ALGORITHM`` stands for all of NLopt's."""
    named = (f"{name}:{_WITH_ARGUMENT[name]}" if name in _WITH_ARGUMENT else name for name in BUILT_IN)
    return (*named, *sorted(set(installed(ENTRY_POINTS)) - set(BUILT_IN)))


def get_estimator(name: str, **settings: Any) -> Estimator:
    """The estimator called `name`.

    Parameters
    ----------
    name
        ``lsq``, ``ga``, ``cmaes``, ``nlopt:<algorithm>``, ``emcee``, or one installed under the entry-point
        group `ENTRY_POINTS`; or several joined by ``+``, as in ``cmaes+lsq``: a `Chain`.
    settings
        Fields of the estimator's class, for example ``max_iterations=5``; of a chain, those of `Chain`.

    Raises
    ------
    UsageError
        No such estimator, no such setting, or a value the estimator refuses.
    """
    if "+" in name:
        return _chain(name, settings)
    stem, colon, argument = name.partition(":")
    factory = BUILT_IN.get(stem) or load_installed(ENTRY_POINTS, stem, "estimator")
    if factory is None:
        raise UsageError(_unknown(name))
    if colon and stem in BUILT_IN and stem not in _WITH_ARGUMENT:
        raise UsageError(f"estimator {stem!r} takes no setting after a colon: write {stem!r}, not {name!r}")
    _check_settings(stem, factory, settings)
    estimator: Estimator = factory(argument, **settings) if colon else factory(**settings)
    return estimator


def _chain(name: str, settings: Mapping[str, Any]) -> Estimator:
    stems = name.split("+")
    if not all(stems):
        raise UsageError(f"{name!r} is not a chain of estimators: join their names, as in 'cmaes+lsq'")
    wanted = {key: value for key, value in settings.items() if key != "stages"}
    _check_settings(name, Chain, wanted)
    return Chain(tuple(get_estimator(stem) for stem in stems), **wanted)


def _check_settings(name: str, factory: Factory, settings: Mapping[str, Any]) -> None:
    if not is_dataclass(factory):
        return
    known = [field.name for field in fields(factory)]
    wrong = [key for key in settings if key not in known]
    if wrong:
        raise UsageError(f"estimator {name!r} has no setting {', '.join(wrong)}; it has {', '.join(known)}")


def _unknown(name: str) -> str:
    from difflib import get_close_matches

    names = available()
    close = get_close_matches(name.lower(), names, n=2, cutoff=0.5)
    hint = f" Did you mean {' or '.join(repr(c) for c in close)}?" if close else ""
    return f"there is no estimator {name!r}.{hint} There are {', '.join(names)}, and chains such as cmaes+lsq"
