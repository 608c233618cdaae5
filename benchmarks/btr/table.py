"""The table of runs: each, and each method over all robots that it was run on."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from benchmarks.btr.methods import METHODS

REPORTED = (1, 4, 10, 16, 20, 200)
"""Trials after which the best so far is told; of a run that ended before, its last."""
OURS = ("loop", "learning", "naming")


def table(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Each run, and each method over all robots that it was run on."""
    methods = [m for m in METHODS if any(r["method"] == m for r in rows)]
    return {
        "command": " ".join(
            ["python -m benchmarks.btr", *(f"--{k}s {_listed(rows, k)}" for k in ("robot", "method", "seed"))]
        ),
        "runs": rows,
        "methods": {m: _over([r for r in rows if r["method"] == m]) for m in methods},
        "ahead_after_10_of_others_at_the_end": {m: _ahead(rows, m) for m in methods if m in OURS},
    }


def _listed(rows: Sequence[Mapping[str, Any]], key: str) -> str:
    return " ".join(map(str, dict.fromkeys(r[key] for r in rows)))


def _ahead(rows: Sequence[Mapping[str, Any]], method: str) -> dict[str, str]:
    """On how many of the robots that both were run on a method's best of 10 trials beats all trials of another."""
    best = {(r["robot"], r["seed"], r["method"]): list(r["best"].values()) for r in rows}
    halfway = {
        key[:2]: r["best"]["10"] for key, r in zip(best, rows, strict=True) if key[2] == method and "10" in r["best"]
    }
    found = {}
    for other, trial, called in [("nominal", 0, "blind"), *((m, -1, m) for m in METHODS if m not in OURS)]:
        pairs = [(own, best[(*robot, other)][trial]) for robot, own in halfway.items() if (*robot, other) in best]
        if pairs:
            found[called] = f"{sum(own > theirs for own, theirs in pairs)} of {len(pairs)}"
    return found


def row(f: Mapping[str, Any]) -> dict[str, Any]:
    stood = np.array([t["outcome"] == "done" for t in f["trials"]])
    # what fell is no gait that anybody would use
    fitness = np.where(stood, [t["fitness"] for t in f["trials"]], 0.0)
    best = np.maximum.accumulate(fitness)
    told = [(t, t["foreseen"]) for t in f["trials"] if t["foreseen"]]
    first, planned = f["plan"]["trials"], f["plan"]["trials"] * f["plan"]["iterations"]
    return {
        "robot": f["robot"],
        "seed": f["seed"],
        "method": f["method"],
        "trials": len(stood),
        "draws": f["plan"]["draws"],
        "generations": f["plan"]["generations"],
        "fell": int(np.sum(~stood)),
        "later": len(stood) - first,
        "fell_later": int(np.sum(~stood[first:])),
        "best": {str(n): float(best[min(n, len(best)) - 1]) for n in REPORTED if n <= max(len(best), planned)},
        "held": sum(s["low"] <= t["fitness"] <= s["high"] for t, s in told),
        "told": len(told),
        "falls_foreseen": float(sum(1 - s["stands"] for _, s in told)),
        "cpu_s": f["cpu_s"],
        "learnt": f.get("learnt", {}),
    }


def _over(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    def share(part: str, whole: str) -> float | None:
        count = sum(r[whole] for r in rows)
        return sum(r[part] for r in rows) / count if count else None

    reached = {n: [r["best"][str(n)] for r in rows if str(n) in r["best"]] for n in REPORTED}
    return {
        "runs": len(rows),
        "fell": share("fell", "trials"),
        "fell_after_the_first_iteration": share("fell_later", "later"),
        "intervals_hold": share("held", "told"),
        "best_median": {str(n): float(np.median(v)) for n, v in reached.items() if v},
        "cpu_s_median": float(np.median([r["cpu_s"] for r in rows])),
    }


def show(summary: Mapping[str, Any]) -> str:
    """The table as text."""
    if not summary["runs"]:
        return "no run is finished; give --seeds"
    lines = ["robot       method      trials  fell  (later)  best m/s after 1, 4, 10, all  in 90 %  CPU s"]
    for r in sorted(summary["runs"], key=lambda r: (r["robot"], r["seed"], list(METHODS).index(r["method"]))):
        best = list(r["best"].values())
        after = "  ".join(f"{b:6.3f}" for b in (best[:3] + best[-1:] if len(best) > 3 else best))
        held = f"{r['held']}/{r['told']}" if r["told"] else "-"
        lines.append(
            f"{r['robot']:8s}{r['seed']:3d}  {r['method']:10s}{r['trials']:7d}{r['fell']:6d}  ({r['fell_later']:2d}/"
            f"{r['later']:2d})  {after:30s}  {held:>6s}  {r['cpu_s']:5.0f}"
        )
    for name, m in summary["methods"].items():
        falls = m["fell_after_the_first_iteration"]
        held = "" if m["intervals_hold"] is None else f"; {m['intervals_hold']:.0%} of trials in their 90 % interval"
        best = ", ".join(f"{b:.3f} after {n}" for n, b in m["best_median"].items())
        fell = "" if falls is None else f", {falls:.0%} after the first iteration"
        lines.append(f"{name}: {m['runs']} runs, {m['fell']:.0%} of trials fell{fell}; median best {best}{held}")
    for r in summary["runs"]:
        learnt = r.get("learnt", {}).values()
        known = [low <= truth <= high for _, low, high, truth in learnt if truth is not None]
        if known:
            lines.append(f"{r['robot']} {r['seed']}: {sum(known)} of {len(known)} 95 % intervals hold the truth")
    for name, ahead in summary["ahead_after_10_of_others_at_the_end"].items():
        lines.append(
            f"{name} after 10 trials ahead of all trials of: " + ", ".join(f"{m} {k}" for m, k in ahead.items())
        )
    return "\n".join(lines)
