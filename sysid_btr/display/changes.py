"""What a run changes in the model, as lines for a screen."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from itertools import groupby
from typing import Any

FOLLOWS = ("solreffriction", "solimpfriction")
"""Attributes that follow from others."""
TOGETHER = 4
"""Objects whose like changes share a line."""
MOST_NAMES = 8
"""Names in such a line; the result has all."""
Entry = Mapping[str, Any]


def change_lines(changes: Sequence[Entry]) -> list[str]:
    """One line a changed attribute; what follows from another, or is the same for many, is said with it."""
    factors = {c["name"]: _factor(c) for c in changes if c["attribute"] == "mass"}
    shown = [c for c in changes if c["attribute"] not in FOLLOWS and not _follows(c, factors)]
    ordered = sorted(shown, key=lambda c: (_order(shown, c), _key(c)))
    return [line for _, group in groupby(ordered, key=_key) for line in _lines(list(group))]


def _order(shown: Sequence[Entry], change: Entry) -> int:
    """Place of the first change that shares a line with this one."""
    return next(i for i, c in enumerate(shown) if _key(c) == _key(change))


def _key(change: Entry) -> tuple[str, str, str, str]:
    factor = _factor(change)
    return (
        change["kind"],
        change["attribute"],
        change["certainty"],
        f"{factor:.9g}" if factor is not None else f"{change['before']} {change['after']}",
    )


def _lines(group: Sequence[Entry]) -> Iterator[str]:
    first = group[0]
    factor = _factor(first)
    if len(group) < TOGETHER or not first["attribute"]:
        yield from (c["line"] for c in group)
        return
    names = f": {', '.join(c['name'] for c in group)}" if len(group) <= MOST_NAMES else ""
    certainty = first["certainty"] or (f" (x{factor:.4g})" if factor is not None else "")
    span = first["line"].split(f" {first['attribute']} ", 1)[1].removesuffix(first["certainty"])
    yield f"{len(group)} {first['kind']}s {first['attribute']}{certainty}, as {first['name']} {span}{names}"


def _factor(change: Entry) -> float | None:
    """After over before, where both are one number."""
    before, after = change["before"], change["after"]
    if isinstance(before, str) or len(before) != 1 or before[0] == 0:
        return None
    return float(after[0] / before[0])


def _follows(change: Entry, factors: Mapping[str, float | None]) -> bool:
    """Whether an inertia changes by the factor of its body's mass."""
    factor = factors.get(change["name"])
    if change["attribute"] != "inertia" or factor is None:
        return False
    return all(
        abs(after - factor * before) <= 1e-9 * abs(after)
        for before, after in zip(change["before"], change["after"], strict=True)
    )


def model_lines(result: Mapping[str, Any]) -> Iterator[str]:
    """What changes in the model, and what became of the file that holds it."""
    lines = change_lines(result.get("changes") or [])
    written = result.get("written")
    if lines:
        yield "changes in the model (+-: half of the 95 % interval)"
        yield from (f"  {line}" for line in lines)
    if written is None:
        return
    if written["path"] is None:
        yield f"model.xml is not written: {written['why']}"
        return
    yield f"{written['path']}: {fidelity(written)}"
    for part in written["not_in_file"]:
        word = "not in it" if part["held"] == "no" else "not quite in it"
        yield f"  {word}: {part['text']}: {part['how']}{_cost(part, written)}"


def fidelity(written: Mapping[str, Any]) -> str:
    """How the file moves, compared with what is reported."""
    own, reported = (written[k]["holdout"] for k in ("loss", "reported_loss"))
    if written["reproduces"]:
        return "reloaded, it moves as reported"
    if own is None or reported is None or reported == 0:
        return "reloaded, its replay diverges"
    return f"reloaded, its loss on held-out data is {own / reported:.4g} times the reported one"


def _cost(part: Mapping[str, Any], written: Mapping[str, Any]) -> str:
    without, reported = part["loss_without"], written["reported_loss"]["holdout"]
    if without is None or without["holdout"] is None or not reported:
        return ""
    return f"; without it the loss is {without['holdout'] / reported:.4g} times as large"
