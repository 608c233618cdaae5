"""Whether `close` found what was planted."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

from benchmarks.robots.planted import Planted

AMOUNT = 0.15
"""Largest relative error of an amount that is right."""

EVERYWHERE = frozenset({"robot"})
"""Place of what is no joint's own."""

Answer = Literal["right", "not right", "wrong"]


@dataclass(frozen=True)
class Judgement:
    """The answer, and why it is not right.

    Attributes
    ----------
    error : worst relative error of the amounts that were found, nan where none was.
    """

    answer: Answer
    why: str
    error: float


def judge(result: Mapping[str, Any], planted: Sequence[Planted], alike: frozenset[str] = frozenset()) -> Judgement:
    """Compare a result of `close` with what was planted.

    An effect that is not there, or at another place, is wrong. What is not named, or named with a doubt or another
    amount, is not right.

    Parameters
    ----------
    result : content of result.json.
    planted : what there is.
    alike : joints that are coupled, so that what is at one may as well be at any of them.
    """
    named = [Name.of(entry) for entry in result["effects"] if is_likely(entry)]
    used: set[int] = set()
    errors, missing = [], []
    for one in planted:
        own = [i for i, n in enumerate(named) if n.is_of(one, alike)]
        used.update(own)
        where = frozenset().union(*(named[i].where for i in own))
        if not own or not (where in (EVERYWHERE, set(one.where)) or where <= alike):
            missing.append(f"{one.effect} at {', '.join(one.where)}")
            continue
        errors.append(max(named[i].error(one, alike) for i in own))
    extra = [str(n) for i, n in enumerate(named) if i not in used]
    error = max(errors, default=math.nan)
    if extra:
        return Judgement("wrong", f"{'; '.join(extra)}: not there", error)
    if missing:
        return Judgement("not right", f"{result['verdict']}: not named: {'; '.join(missing)}", error)
    expected = "explained" if planted else "nothing_missing"
    if result["verdict"] != expected:
        doubt = sorted({c for e in result["effects"] for c in e["confused_with"]})
        return Judgement("not right", f"{result['verdict']} {'(or ' + ', '.join(doubt) + ')' if doubt else ''}", error)
    if error > AMOUNT:
        return Judgement("not right", f"amount {100 * error:.0f} % off", error)
    return Judgement("right", "", error)


def is_likely(entry: Mapping[str, Any]) -> bool:
    """Whether a result holds an effect's name for more likely than not; it stands in the model in either case."""
    return bool(entry.get("certainty", 1.0) > 0.5)


@dataclass(frozen=True)
class Name:
    """An effect that was named."""

    effect: str
    where: frozenset[str]
    amounts: Mapping[str, Mapping[str, float]]
    """Place -> kind -> value."""

    @classmethod
    def of(cls, entry: Mapping[str, Any]) -> Name:
        """An entry of a result."""
        amounts: dict[str, dict[str, float]] = {}
        for parameter in entry["parameters"]:
            label, _, places = parameter["name"].partition(":")
            kind = label.rpartition(".")[2] if "." in label else ""
            for place in places.split(","):
                amounts.setdefault(place, {})[kind] = parameter["value"]
        return cls(entry["effect"], frozenset(entry["where"]), amounts)

    def __str__(self) -> str:
        return f"{self.effect} at {', '.join(sorted(self.where))}"

    def kind(self, planted: Planted) -> str | None:
        """Which of its parameters is the planted amount; None if this is another physics."""
        return {planted.effect: planted.kind, **planted.also}.get(self.effect)

    def is_of(self, planted: Planted, alike: frozenset[str]) -> bool:
        """Whether this is the planted effect, at its places or some of them."""
        places = set(planted.where) | (alike if alike & set(planted.where) else set())
        return self.kind(planted) is not None and (self.where <= places or self.where == EVERYWHERE)

    def error(self, planted: Planted, alike: frozenset[str]) -> float:
        """Worst relative error of the amounts; of their sum where places are alike."""
        kind = self.kind(planted)
        found = [kinds.get(str(kind), next(iter(kinds.values()))) for kinds in self.amounts.values()]
        if set(planted.where) <= alike:
            total = planted.amount * len(planted.where)
            return abs(sum(found) / total - 1)
        return max((abs(f / planted.amount - 1) for f in found), default=math.inf)
