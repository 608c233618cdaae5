"""What intervals take as exact: numbers of the model that are not fitted, and what they may be off by.

Estimates answer for such errors to first order: they move by ``-J+ K b``, with the residuals' derivatives J by what is
fitted and K by what is not, and the errors b of the latter. With b normal their covariance adds to that of the
residuals: the covariance of consider parameters (Schmidt 1966, doi:10.1016/B978-1-4831-6716-9.50011-4; Tapley, Schutz
and Born 2004, "Statistical Orbit Determination", chapter 6). The estimates stay where they are.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from sysid_btr._typing import FloatArray
from sysid_btr.errors import UsageError
from sysid_btr.estimators.linearisation import linearise
from sysid_btr.objectives.problem import Conditional
from sysid_btr.terms.grammar import check_expression, parse_parameters
from sysid_btr.terms.model import Model, Terms

if TYPE_CHECKING:
    from sysid_btr.identify.study import Study
    from sysid_btr.models.robot import Robot
    from sysid_btr.terms.base import Term

USUAL = "mass"
"""What every model has, and what is wrong in most."""


def error_of_the_rest(study: Study, model: Model, jacobian: FloatArray) -> FloatArray:
    """Standard deviation (p,) of estimates by what is not fitted, as far as that may be off.

    Parameters
    ----------
    study : with it.
    model : p numbers at the optimum.
    jacobian : (r, p) of the whitened residuals there.

    Raises
    ------
    UsageError
        If a name is of no parameter, or the estimates come from more than these residuals.
    """
    if not _uncertain(study):
        return np.zeros(len(model.values))
    if study.procedure.fuses:
        raise UsageError(
            "--nuisance is not available for a floating-base log in segments, because contact-free estimation does not "
            "allow for it; fit what may be off, or use --mode innovations"
        )
    rest = list(_undeclared(study, model.terms))
    if not rest:
        return np.zeros(len(model.values))
    std = np.concatenate([np.full(len(term.parameters), size) for term, size in rest])
    wide = Model.joined([*model.parts, *((term, term.neutral) for term, _ in rest)])
    free = np.arange(len(wide.values)) >= len(model.values)
    beside = Conditional(study.train_problem(wide), free, wide.values)
    _, other = linearise(beside, beside.start, step=study.stencil(wide.terms))
    moved = np.linalg.lstsq(jacobian, np.nan_to_num(other) * std, rcond=1e-6)[0]
    return np.asarray(np.linalg.norm(moved, axis=1))


def assumptions(study: Study, terms: Terms) -> dict[str, Any]:
    """What a result says of what is not fitted: masses that are taken as exact, and what others may be off by."""
    masses = [term for term in _parsed(study, USUAL) if not _declared(term, terms)]
    allowed = {place for term, _ in _undeclared(study, terms) if term.name == USUAL for place in term.places}
    return {
        "nuisance": dict(_uncertain(study)),
        "taken_as_exact": [f"{USUAL}:{p}" for term in masses for p in term.places if p not in allowed],
    }


def _uncertain(study: Study) -> Mapping[str, float]:
    """What may be off, with its standard deviation: what logs of this kind leave open, and what was stated."""
    return {**study.procedure.uncertain, **study.nuisance}


def _undeclared(study: Study, terms: Terms) -> Iterator[tuple[Term, float]]:
    """Terms that are not fitted, with the standard deviation of each of their numbers."""
    for name, std in _uncertain(study).items():
        yield from ((term, std) for term in _parsed(study, name) if not _declared(term, terms))


def _parsed(study: Study, name: str) -> tuple[Term, ...]:
    return parse_parameters([name if ":" in name else f"{name}:*"], study.robot, study.scales)


def _declared(term: Term, terms: Terms) -> bool:
    return any(own.name == term.name and not set(own.places).isdisjoint(term.places) for own in terms)


def check_nuisance(robot: Robot, nuisance: Mapping[str, float]) -> None:
    """Refuse standard deviations that are none, or of what the robot does not have.

    Raises
    ------
    UsageError
        With all of them.
    """
    low = {name: std for name, std in nuisance.items() if not std > 0}
    problems = [f"{name}={std:g}: a standard deviation must be above zero" for name, std in low.items()]
    for name in nuisance:
        try:
            check_expression(name, robot)
        except UsageError as error:
            problems.append(f"{name}: {error}")
    if problems:
        raise UsageError("\n".join(f"--nuisance {problem}" for problem in problems))
