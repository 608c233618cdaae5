"""What counts as right where no form is exact: the family of each cause and the place where it sits."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from typing import TYPE_CHECKING, Any, Literal

from benchmarks.blind.judge import ALL_BUT, EVERYWHERE
from reference_simulator.forms import Form

if TYPE_CHECKING:
    from reference_simulator.effects import Effect
    from reference_simulator.robot import Robot

Outcome = Literal["yes", "ambiguous", "provisional", "unexplained", "missed", "wrong"]
Places = frozenset[str]

ROBOT_WIDE = frozenset({"supply", "mount"})
"""Families that are of the robot, wherever they are said to sit."""
NAMELESS = frozenset({"", "unknown torque"})
"""Families that name no cause."""
WITHOUT_EFFORT: Mapping[str, Places] = {
    "encoder_filter": frozenset({"delay"}),
    "encoder_drift": frozenset({"disturbance"}),
    "encoder_offset": frozenset({"disturbance"}),
    "constant_force": frozenset({"sensor"}),
}
"""Other families that a log of positions alone cannot tell from an effect's."""
PART_OF: Mapping[str, Places] = {
    "asymmetric_friction": frozenset({"disturbance", "sensor"}),
    "smooth_backlash": frozenset({"compliance"}),
    "greased_backlash": frozenset({"compliance"}),
}
"""Families that an effect has in it beside its own: another level in each direction is a constant torque, too; teeth
that give way are a spring. Named at its place they are not false."""


@dataclass(frozen=True)
class Cause:
    """One planted family.

    Attributes
    ----------
    families : its own, and those no log of this kind can tell from it.
    beside : families that are not false at its places.
    where : places; a body's band reaches all joints that carry the body.
    anywhere : whether any of the places will do.
    """

    families: Places
    beside: Places
    where: Places
    anywhere: bool

    def sits_at(self, where: Places) -> bool:
        """Whether it is named where it is."""
        if self.families & ROBOT_WIDE:
            return True
        if self.anywhere:
            return bool(where) and where <= self.where
        if len(self.where) >= EVERYWHERE:
            return where <= self.where and len(where) >= ALL_BUT * len(self.where)
        return where == self.where


@dataclass(frozen=True)
class Guess:
    """One name of a result.

    Attributes
    ----------
    family, where : as named.
    rivals : families that it may be confused with.
    certainty : that it is right, as stated; nan if it is not.
    evidence : what that was said from, by name.
    """

    family: str
    where: Places
    rivals: Places
    certainty: float
    evidence: Mapping[str, float] = field(compare=False)


@dataclass(frozen=True)
class FamilyJudgement:
    """Outcome, the reason, and each name with its stated certainty and whether it was right."""

    outcome: Outcome
    why: str
    named: tuple[tuple[Guess, bool], ...]


@cache
def families() -> Mapping[str, str]:
    """Family by name of an effect of the library."""
    from sysid_btr.terms.library import effects

    return {cls.name: cls.family or cls.name for cls in effects()}


def family_of(effect: Effect) -> str:
    """Of a planted effect."""
    return effect.family if isinstance(effect, Form) else families().get(effect.name, "")


def causes(effects: Sequence[Effect], robot: Robot, effort: bool) -> tuple[Cause, ...]:
    """The truth, each family once."""
    table: dict[str, list[Effect]] = {}
    for effect in effects:
        table.setdefault(family_of(effect), []).append(effect)
    result = []
    for family, own in table.items():
        alike = frozenset[str]() if effort else frozenset(f for e in own for f in WITHOUT_EFFORT.get(e.name, ()))
        band = any(e.name == "elastic_band" for e in own)
        places = frozenset(p for e in own for w in e.where for p in (_carriers(robot, w) if band else (w,)))
        beside = frozenset(f for e in own for f in PART_OF.get(e.name, ()))
        result.append(Cause(alike | {family}, beside, places, band))
    return tuple(result)


def _carriers(robot: Robot, body: str) -> tuple[str, ...]:
    """A body, those that carry it, and their joints."""
    found: list[str] = []
    number = [b.name for b in robot.bodies].index(body)
    while number >= 0:
        here = robot.bodies[number]
        found += [here.name, *(robot.joints[j] for j in here.joints)]
        number = here.parent
    return tuple(found)


def guesses(entries: Iterable[Mapping[str, Any]]) -> tuple[Guess, ...]:
    """The names of a result, each family once, without those that name no cause."""
    table: dict[str, list[Mapping[str, Any]]] = {}
    for entry in entries:
        table.setdefault(entry.get("family") or families().get(entry["effect"], entry["effect"]), []).append(entry)
    result = []
    for family, own in table.items():
        rivals = frozenset(families().get(n, n) for e in own for n in e["confused_with"]) - {family}
        # of several the least sure
        stated = min((e for e in own if e.get("certainty") is not None), key=lambda e: e["certainty"], default={})
        certainty, evidence = stated.get("certainty", math.nan), stated.get("evidence", {})
        result.append(Guess(family, frozenset(p for e in own for p in e["where"]), rivals, certainty, evidence))
    return tuple(g for g in result if g.family not in NAMELESS)


def judge_families(result: Mapping[str, Any], effects: Sequence[Effect], robot: Robot, effort: bool) -> FamilyJudgement:
    """Compare a result of `close` with what was planted, family by family.

    Parameters
    ----------
    result : content of result.json.
    effects : planted, at names.
    robot : that has them.
    effort : whether torques are logged.
    """
    verdict, true, named = result["verdict"], causes(effects, robot, effort), guesses(result["effects"])
    own = {c: next((g for g in named if _names(g, c, true)), None) for c in true}
    right = frozenset(g for g in own.values() if g is not None)
    false = [g for g in named if g not in right and not _part_of(g, true)]
    marked = tuple((g, g not in false) for g in named)
    if false:
        outcome, why = _false(verdict, false, own, named)
    elif not named:
        outcome, why = ("missed", "nothing seen") if verdict == "nothing_missing" else ("unexplained", "")
    elif len(lacking := [c for c, g in own.items() if g is None]):
        outcome, why = "missed", f"not seen: {', '.join('/'.join(sorted(c.families)) for c in lacking)}"
    else:
        doubts = {r for c, g in own.items() if g is not None for r in g.rivals - c.families}
        doubtful = verdict == "ambiguous" and bool(doubts)
        outcome, why = ("ambiguous", f"or {', '.join(sorted(doubts))}") if doubtful else ("yes", "")
    return FamilyJudgement(outcome, why, marked)


def _names(guess: Guess, cause: Cause, true: Sequence[Cause]) -> bool:
    """Whether a name is that of a cause, at its places; those where it is a part of another one do not count."""
    beside = frozenset[str]().union(*(c.where for c in true if guess.family in c.beside))
    return guess.family in cause.families and (cause.sits_at(guess.where) or cause.sits_at(guess.where - beside))


def _part_of(guess: Guess, true: Sequence[Cause]) -> bool:
    return any(guess.family in c.beside and guess.where <= c.where for c in true)


def _false(
    verdict: str, false: Sequence[Guess], own: Mapping[Cause, Guess | None], named: Sequence[Guess]
) -> tuple[Outcome, str]:
    """A false name is wrong if it is said to be the explanation; the truth among its rivals is ambiguous."""
    rivals = {
        c: g or next((n for n in named if c.families & n.rivals and c.sits_at(n.where)), None) for c, g in own.items()
    }
    if verdict == "ambiguous" and all(rivals.values()) and all(g in rivals.values() for g in false):
        return "ambiguous", "the true family is among the rivals"
    why = "; ".join(f"{g.family} at {', '.join(sorted(g.where)) or 'the robot'}" for g in false)
    return ("wrong" if verdict == "explained" else "provisional"), why
