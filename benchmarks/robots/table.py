"""The table: one JSON a case in the work folder, all of them in one file, and as text."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

SHOWN = 110


def read(work: Path, name: str) -> dict[str, Any] | None:
    """The row of a case that is done."""
    place = work / f"{name}.json"
    return json.loads(place.read_text()) if place.is_file() else None


def keep(work: Path, row: Mapping[str, Any]) -> None:
    """Write the row of a case."""
    work.mkdir(parents=True, exist_ok=True)
    part = work / f"{row['name']}.json.part"
    part.write_text(json.dumps(row, indent=1) + "\n")
    part.replace(work / f"{row['name']}.json")


def line(row: Mapping[str, Any]) -> str:
    """One case in a few lines of text."""
    cost = f"{row['seconds']:.0f} s ({row['cpu_seconds']:.0f} CPU-s)"
    head = f"{row['name']:<18} {row['answer']:<10} {row['verdict']:<16} {cost}"
    if row["kind"] == "simulated":
        error = "" if row["amount_error"] is None else f", {100 * row['amount_error']:.1f} % off"
        lines = [head, f"    {row['title']}: {row['planted']}; found {row['found']}{error}"]
    else:
        lines = [head, f"    {row['title']}; {row['found']}"]
        lines += [f"    {_figure(f)}" for f in row["figures"]]
    if row["why"]:
        lines.append(f"    {row['why'][: 3 * SHOWN]}")
    return "\n".join(lines)


def _figure(figure: Mapping[str, Any]) -> str:
    state = {True: "ok", False: "MISSED", None: ""}[figure["reached"]]
    own = _number(figure["ours"])
    if figure["interval"]:
        own += f" ({_number(figure['interval'][0])} to {_number(figure['interval'][1])})"
    others = [f"{w} {_number(figure[w])}" for w in ("published", "hand", "regression") if figure[w] is not None]
    return f"{figure['what']:<44} {own:<30} {'; '.join(others):<50} {state}".rstrip()


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.4g}"


def summary(rows: Iterable[Mapping[str, Any]]) -> str:
    """How many simulated robots came to which answer."""
    own = [r for r in rows if r["kind"] == "simulated"]
    count = {a: sum(r["answer"] == a for r in own) for a in ("right", "not right", "wrong", "no result")}
    return f"{len(own)} simulated robots: " + ", ".join(f"{n} {a}" for a, n in count.items())
