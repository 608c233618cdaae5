"""Forms that were learnt, as curves over what they depend on: what their many numbers say together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from sysid_btr._typing import FloatArray
from sysid_btr.identify.intervals import NORMAL, Estimate, correlation_matrix
from sysid_btr.terms.free_form import FreeCurve
from sysid_btr.terms.model import Model

POINTS = 201


@dataclass(frozen=True, eq=False)
class Curve:
    """Something at a joint whose form was learnt.

    Attributes
    ----------
    effect, where : which effect, and its joint.
    title, words : what it is, and where it goes.
    variable, amount : of the two axes, with units.
    x : (n,) values of the variable.
    value, low, high : (n,) of the amount, with the 95 % interval at each.
    parameters : names of the numbers that give it.
    """

    effect: str
    where: str
    title: str
    words: str
    variable: str
    amount: str
    x: FloatArray
    value: FloatArray
    low: FloatArray
    high: FloatArray
    parameters: tuple[str, ...]

    def to_dict(self) -> dict[str, Any]:
        """As results have it."""
        return dict(vars(self))


def curves_of(model: Model, estimates: Sequence[Estimate]) -> tuple[Curve, ...]:
    """The curves in a model whose numbers were estimated, with intervals from their standard errors and correlations.

    The modes of a curve are orthogonal over its range: where no correlation is known, they are taken as independent.
    """
    at = {e.name: i for i, e in enumerate(estimates)}
    std = np.array([e.std if np.isfinite(e.std) else 0.0 for e in estimates])
    correlation = np.nan_to_num(correlation_matrix(estimates))
    np.fill_diagonal(correlation, 1.0)
    covariance = np.outer(std, std) * correlation
    found = []
    for term, own in model.parts:
        if not isinstance(term, FreeCurve):
            continue
        names = np.reshape([p.name for p in term.parameters], (-1, len(term.numbers)))
        names = np.broadcast_to(names, (len(term.places), names.shape[1]))
        kinds = [term.kinds.index(kind) for kind in term.numbers]
        for place, values, mine in zip(term.places, term.spread(own[None])[0], names, strict=True):
            if not at.keys() & set(mine):
                continue
            x = np.linspace(*term.drawn_over(place), POINTS)
            line, modes = term.curve(place, values, x), term.modes_of(place, x)
            pairs = zip(mine, kinds, strict=True)
            free = [(at[name], kind) for name, kind in pairs if name in at and kind < modes.shape[1]]
            rows, columns = [row for row, _ in free], [kind for _, kind in free]
            known, seen = covariance[np.ix_(rows, rows)], modes[:, columns]
            half = NORMAL * np.sqrt(np.maximum(np.einsum("nk,kl,nl->n", seen, known, seen), 0.0))
            variable, amount = term.axes
            found.append(
                Curve(
                    effect=term.label or term.name,
                    where=place,
                    title=f"{place}: {term.described}",
                    words=term.in_words(place, values),
                    variable=variable,
                    amount=amount,
                    x=x,
                    value=line,
                    low=line - half,
                    high=line + half,
                    parameters=tuple(map(str, mine)),
                )
            )
    return tuple(found)
