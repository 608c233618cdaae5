"""Terms of a model, and their numbers: where each term's numbers stand, and what comes and goes with a term."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import accumulate, pairwise
from typing import Any

import numpy as np

from sysid_btr._typing import FloatArray
from sysid_btr.terms.base import Parameter, Term


class Terms(tuple[Term, ...]):
    """What of a model is open, term by term; the numbers of a candidate stand in the same order.

    Examples
    --------
    >>> terms = Terms(study.declare(["mass:*", "kp:*=shared"]))  # doctest: +SKIP
    >>> candidate[terms.columns(terms[0])]  # doctest: +SKIP
    """

    def __reduce__(self) -> tuple[Any, ...]:
        """Terms alone: what was worked out from them must not change the bytes that are sent to other machines."""
        return Terms, (tuple(self),)

    @cached_property
    def parameters(self) -> tuple[Parameter, ...]:
        """Every number's name, unit, nominal value, bounds and scale, (p,)."""
        return tuple(p for term in self for p in term.parameters)

    @property
    def names(self) -> tuple[str, ...]:
        """(p,) names of the parameters."""
        return tuple(p.name for p in self.parameters)

    @property
    def nominal(self) -> FloatArray:
        """(p,) values at which the model is exactly the plain one."""
        return np.array([p.nominal for p in self.parameters], dtype=np.float64)

    @property
    def begin(self) -> FloatArray:
        """(p,) values at which a search begins that is told nothing else."""
        values = np.concatenate([np.zeros(0), *(term.begin for term in self)])
        return np.asarray(np.clip(values, self.lower, self.upper))

    @property
    def lower(self) -> FloatArray:
        """(p,) lower bounds."""
        return np.array([p.lower for p in self.parameters], dtype=np.float64)

    @property
    def upper(self) -> FloatArray:
        """(p,) upper bounds."""
        return np.array([p.upper for p in self.parameters], dtype=np.float64)

    @property
    def scale(self) -> FloatArray:
        """(p,) size of a change that matters."""
        return np.array([p.scale for p in self.parameters], dtype=np.float64)

    @cached_property
    def _columns(self) -> tuple[slice, ...]:
        ends = accumulate((len(term.parameters) for term in self), initial=0)
        return tuple(slice(first, last) for first, last in pairwise(ends))

    def columns(self, term: Term) -> slice:
        """Where a term's numbers stand in a candidate.

        Raises
        ------
        ValueError
            If it is not one of these.
        """
        return self._columns[self.index(term)]

    def split(self, values: FloatArray) -> Iterator[tuple[Term, FloatArray]]:
        """Every term with its own numbers, of one candidate (p,) or of several (m, p)."""
        for term, own in zip(self, self._columns, strict=True):
            yield term, values[..., own]

    @property
    def rough(self) -> bool:
        """Whether any of them makes what a replay leaves rough in its numbers."""
        return any(term.rough for term in self)

    def admit(self, kind: type[Term], places: Iterable[str]) -> bool:
        """Whether a further term may act at these places.

        Not where one of its kind is free already, with numbers of each place's own or at just these places, and not
        where another adds a joint and it does too.
        """
        at = set(places)

        def excludes(term: Term) -> bool:
            own = len(term.groups) == len(term.places) and term.numbers == term.kinds
            return bool(at.intersection(term.places)) and (
                (type(term) is kind and (own or at == set(term.places))) or (term.structural and kind.structural)
            )

        return not any(excludes(term) for term in self)

    @property
    def have_laws(self) -> bool:
        """Whether any of them acts at every step of a replay."""
        return any(type(term).overrides("law") for term in self)


@dataclass(frozen=True, eq=False)
class Model:
    """A robot's terms with a number for each of their parameters.

    Attributes
    ----------
    terms : what differs from the plain model.
    values : (p,) how large, in the order of the terms.

    Raises
    ------
    ValueError
        If there are not as many numbers as parameters.
    """

    terms: Terms
    values: FloatArray

    def __post_init__(self) -> None:
        if len(self.values) != len(self.terms.parameters):
            raise ValueError(f"{len(self.terms.parameters)} parameters have {len(self.values)} numbers")

    @classmethod
    def of(cls, terms: Iterable[Term], values: FloatArray | Sequence[float] | None = None) -> Model:
        """Terms at given values, or at their nominal ones."""
        found = Terms(terms)
        return cls(found, found.nominal if values is None else np.asarray(values, dtype=np.float64))

    @classmethod
    def joined(cls, parts: Iterable[tuple[Term, FloatArray | Sequence[float]]]) -> Model:
        """The model of some terms, each with its own numbers."""
        pairs = [(term, np.asarray(own, dtype=np.float64)) for term, own in parts]
        return cls(Terms(t for t, _ in pairs), np.concatenate([np.zeros(0), *(own for _, own in pairs)]))

    @property
    def parts(self) -> list[tuple[Term, FloatArray]]:
        """Every term with its own numbers."""
        return list(self.terms.split(self.values))

    def own(self, term: Term) -> FloatArray:
        """A term's own numbers, (parameters of the term,)."""
        return self.values[self.terms.columns(term)]

    def at(self, values: FloatArray) -> Model:
        """The same terms at other numbers, (p,)."""
        return Model(self.terms, np.asarray(values))

    def clipped(self) -> Model:
        """The same with every number within its bounds."""
        return self.at(np.clip(self.values, self.terms.lower, self.terms.upper))

    def with_(self, term: Term, start: FloatArray | Sequence[float]) -> Model:
        """The model with a further term, the last one."""
        return Model.joined([*self.parts, (term, start)])

    def without(self, *gone: Term) -> Model:
        """The model without some of its terms."""
        return Model.joined((term, own) for term, own in self.parts if term not in gone)

    def only(self, *kept: Term) -> Model:
        """The model with some of its terms alone."""
        return Model.joined((term, own) for term, own in self.parts if term in kept)

    def replaced(self, term: Term, *others: tuple[Term, FloatArray]) -> Model:
        """The model with others in the place of one term, or with nothing there."""
        at = self.terms.index(term)
        parts = self.parts
        return Model.joined([*parts[:at], *others, *parts[at + 1 :]])


def as_model(model: Model | Iterable[Term]) -> Model:
    """A model as it is; bare terms at their nominal values."""
    return model if isinstance(model, Model) else Model.of(model)
