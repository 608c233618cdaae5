"""What a written model changes, attribute by attribute, and which parameter says so."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from sysid_btr._typing import FloatArray
from sysid_btr.identify.intervals import Estimate
from sysid_btr.terms.base import ANCHOR_SUFFIX, LINK_SUFFIX, TETHER_SUFFIX
from sysid_btr.units import with_digits_of
from sysid_btr.writeback.features import INTEGRATORS, Feature, Kind, count, differ, of_kind
from sysid_btr.writeback.native import Part
from sysid_btr.writeback.rewrite import KINDS
from sysid_btr.writeback.target import Target

if TYPE_CHECKING:
    import mujoco

SOLVER = ("solreffriction", "solimpfriction")
"""Attributes that follow from others."""
MOST_NAMES = 6
"""Places that are called by name in a sentence."""


@dataclass(frozen=True)
class Change:
    """One attribute of one object.

    Attributes
    ----------
    kind, name, attribute : which; a servo's gains are ``kp``, ``kv``, ``gain`` and ``bias``.
    before, after : numbers, or the word of an option; empty before for what was added.
    by : terms that ask for it.
    certainty : half of the 95 % interval of what it was estimated from, in brackets; empty where unknown.
    line : the change in one line.
    """

    kind: Kind
    name: str
    attribute: str
    before: tuple[float, ...] | str
    after: tuple[float, ...] | str
    by: tuple[str, ...]
    certainty: str
    line: str


@dataclass(frozen=True)
class Stated:
    """A term with the estimates of its parameters."""

    part: Part
    fields: frozenset[str]
    estimates: tuple[Estimate, ...]

    @property
    def structural(self) -> bool:
        """Whether it adds or rearranges elements."""
        return self.part.stand_in is not None and type(self.part.stand_in).overrides("edit_spec")

    def of(self, place: str) -> tuple[Estimate, ...]:
        """Estimates at a place."""
        term = self.part.term
        kinds = len(term.numbers)
        if not self.estimates or not kinds:
            return ()
        group = 0 if len(term.groups) == 1 else term.places.index(place)
        return self.estimates[group * kinds : (group + 1) * kinds]


def acts_at(part: Part, place: str) -> bool:
    """Whether a place is one of a term's own."""
    return place in part.term.places or part.term.places == ("robot",)


def changes_of(before: mujoco.MjModel, target: Target, estimates: Sequence[tuple[Estimate, ...]]) -> tuple[Change, ...]:
    """Everything in which the written model differs from the plain one.

    Parameters
    ----------
    before : the plain model, compiled from the text before it was changed.
    target : what was written.
    estimates : of each part's parameters; empty where unknown.
    """
    stated = [
        Stated(part, fields, own) for part, fields, own in zip(target.parts, target.fields, estimates, strict=True)
    ]
    return tuple(change for kind in KINDS for change in _of_kind(kind, before, target.model, stated))


def _of_kind(kind: Kind, before: mujoco.MjModel, after: mujoco.MjModel, stated: Sequence[Stated]) -> Iterator[Change]:
    if kind == "option":
        pairs: list[tuple[int | None, int]] = [(0, 0)]
    else:
        names = {getattr(before, kind)(i).name: i for i in range(count(before, kind))}
        alike = count(before, kind) == count(after, kind)
        pairs = []
        for j in range(count(after, kind)):
            name = getattr(after, kind)(j).name
            pairs.append((names.get(name) if name else (j if alike else None), j))
    for i, j in pairs:
        if i is None:
            name, place = _place(after, kind, j)
            if name:
                by = [s for s in stated if s.structural and acts_at(s.part, place)]
                yield _added(kind, name, place, by)
            continue
        for feature in of_kind(kind):
            if not _differ(feature, before, i, after, j):
                continue
            name, place = _place(after, kind, j)
            by = [s for s in stated if acts_at(s.part, place) and s.fields & set(feature.fields)]
            by = by or [s for s in stated if acts_at(s.part, place) and s.structural and kind != "option"]
            for attribute, old, new in _values(feature, before, i, after, j):
                called = [s for s in by if s.part.term.called == attribute]
                yield _change(kind, name, place, attribute, old, new, called or by, set(feature.fields))


def _differ(feature: Feature, before: mujoco.MjModel, i: int, after: mujoco.MjModel, j: int) -> bool:
    if i == j:
        return differ(feature, before, after, i)
    return not np.array_equal(feature.read(before, i), feature.read(after, j))


def _place(model: mujoco.MjModel, kind: Kind, i: int) -> tuple[str, str]:
    """Name for people, and the joint or body that a term would call it by."""
    if kind == "option":
        return "", "robot"
    name = str(getattr(model, kind)(i).name)
    if kind == "geom":
        body = model.body(int(model.geom_bodyid[i])).name
        return name or f"{i} of {body}", body
    if kind == "actuator":
        joint = model.joint(int(model.actuator_trnid[i, 0])).name if model.actuator_trntype[i] == 0 else ""
        return name or joint, joint
    if kind == "body":
        return name, name.removeprefix("payload_")
    place = name
    for added in (LINK_SUFFIX, TETHER_SUFFIX, ANCHOR_SUFFIX):
        place = place.removesuffix(added)
    return name, place


def place_of(model: mujoco.MjModel, change: Change) -> str:
    """The joint or body that a term would call what is changed by."""
    found = (_place(model, change.kind, i) for i in range(count(model, change.kind)))
    return next((place for name, place in found if name == change.name), change.name)


def _values(
    feature: Feature, before: mujoco.MjModel, i: int, after: mujoco.MjModel, j: int
) -> Iterator[tuple[str, tuple[float, ...] | str, tuple[float, ...] | str]]:
    if feature.label == "gains":
        old, new = _gains(before, i), _gains(after, j)
        yield from ((name, (old[name],), (new[name],)) for name in old if old[name] != new[name])
    elif feature.label == "inertia":
        yield "inertia", _tuple(before.body_inertia[i]), _tuple(after.body_inertia[j])
    elif feature.label == "delay":
        yield "delay", (float(before.actuator_delay[i]),), (float(after.actuator_delay[j]),)
    elif feature.label == "integrator":
        yield "integrator", INTEGRATORS[int(before.opt.integrator)], INTEGRATORS[int(after.opt.integrator)]
    else:
        old_value, new_value = feature.read(before, i), feature.read(after, j)
        size = max(_size(old_value), _size(new_value))
        yield feature.label, _tuple(old_value[:size]), _tuple(new_value[:size])


def _gains(model: mujoco.MjModel, i: int) -> dict[str, float]:
    gain, bias = float(model.actuator_gainprm[i, 0]), model.actuator_biasprm[i]
    named = {"kp": -float(bias[1]) + 0.0, "kv": -float(bias[2]) + 0.0, "bias": float(bias[0])}
    # a position servo's gain is its kp, said once
    return named | ({"gain": gain} if gain != named["kp"] else {"gain": 0.0})


def _tuple(values: FloatArray) -> tuple[float, ...]:
    return tuple(float(v) for v in np.ravel(values))


def _size(values: FloatArray) -> int:
    nonzero = np.flatnonzero(values)
    return int(nonzero[-1]) + 1 if len(nonzero) else 1


def _added(kind: Kind, name: str, place: str, by: Sequence[Stated]) -> Change:
    names = tuple(s.part.term.called for s in by)
    why = "; ".join(describe(s.part, place) for s in by)
    return Change(kind, name, "", "", "", names, "", f"{kind} {name} added" + (f": {why}" if why else ""))


def _change(
    kind: Kind,
    name: str,
    place: str,
    attribute: str,
    before: tuple[float, ...] | str,
    after: tuple[float, ...] | str,
    by: Sequence[Stated],
    fields: set[str],
) -> Change:
    # where another element stands in for a parameter, or makes room for it, its numbers are not the parameter's
    others = [s for s in by if s.part.stand_in is not s.part.term or not s.fields & fields]
    known = by[0].of(place) if len(by) == 1 else ()
    tail = _stands_for(others[0].part, place) if others else _certainty(known, before, after)
    what = " ".join(part for part in (kind, name, attribute) if part)
    line = f"{what} {_text(before)} -> {_text(after)}{tail}"
    return Change(kind, name, attribute, before, after, tuple(s.part.term.called for s in by), tail, line)


def _stands_for(part: Part, place: str) -> str:
    at = place if place in part.term.places else part.term.places[0]
    return f" ({called(part)}: {amounts(part, at)})"


def _text(values: tuple[float, ...] | str) -> str:
    if isinstance(values, str):
        return values
    words = " ".join(f"{v:.5g}" for v in values)
    return words if len(values) == 1 else f"({words})"


def _certainty(estimates: tuple[Estimate, ...], before: tuple[float, ...] | str, after: tuple[float, ...] | str) -> str:
    """Half the 95 % interval of what a change was estimated from, in brackets."""
    halves = [0.5 * (e.ci95[1] - e.ci95[0]) for e in estimates]
    if len(estimates) == 1 and estimates[0].unit == "1":
        if estimates[0].nominal != 1:
            return ""
        return f" (x{with_digits_of(estimates[0].value, halves[0])} +- {halves[0]:.2g})"
    if not estimates or isinstance(after, str) or len(estimates) != len(after):
        return ""
    units = {e.unit for e in estimates}
    return f" (+- {', '.join(f'{h:.2g}' for h in halves)} {units.pop()})" if len(units) == 1 else ""


def describe(part: Part, place: str | None = None) -> str:
    """A term with its values, at one of its places or at all of them."""
    term = part.term
    places = (place,) if place in term.places else term.places
    groups: dict[str, list[str]] = {}
    for at in places:
        groups.setdefault(amounts(part, at), []).append(at)
    listed = [", ".join(names) if len(names) <= MOST_NAMES else f"{len(names)} places" for names in groups.values()]
    groups_named = [f"{names}: {words}" if words else names for names, words in zip(listed, groups, strict=True)]
    return f"{called(part)} of {'; '.join(groups_named)}"


def called(part: Part) -> str:
    """Name of a term, with its variant."""
    name, variant = part.term.called, part.term.variant
    return f"{name} ({variant})" if variant and not name.endswith(f".{variant}") else name


def amounts(part: Part, place: str) -> str:
    """Values of a term at a place, with units."""
    term = part.term
    if not term.kinds:
        return ""
    row = part.values[0, term.places.index(place)]
    if words := term.in_words(place, row):
        return words
    units = {k.name: p.unit for k, p in zip(term.numbers, term.parameters, strict=False)}
    return ", ".join(
        f"{kind.name} {value:.6g}" + ("" if unit == "1" else f" {unit}")
        for kind, value in zip(term.kinds, row, strict=False)
        for unit in (units.get(kind.name, kind.unit),)
    )
