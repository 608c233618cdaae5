"""One simulated robot: its log, `close` on it, and the judgement."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from benchmarks.robots.judge import judge
from benchmarks.robots.run import Run, run
from benchmarks.robots.suite import Case


def examine(case: Case, work: Path, limit: float) -> dict[str, Any]:
    """Row of the table; the model, the log, its truth and all that the run writes stay in the work folder."""
    from sysid_btr.io.parquet import write_log

    folder = work / case.name
    folder.mkdir(parents=True, exist_ok=True)
    model, log = folder / "model.xml", folder / "log.parquet"
    model.write_text(case.model)
    write_log(case.log(), log, overwrite=True)
    (folder / "truth.json").write_text(json.dumps(case.truth, indent=1) + "\n")
    done = run(("close", "--model", str(model), "--log", str(log), *case.arguments), folder / "out", limit)
    return {
        "kind": "simulated",
        "name": case.name,
        "title": case.title,
        "planted": planted(case),
        **verdict(case, done),
    }


def planted(case: Case) -> str:
    """What is planted, in a few words."""
    return "; ".join(f"{p.effect} {p.amount:g} at {', '.join(p.where)}" for p in case.planted) or "nothing"


def verdict(case: Case, done: Run) -> dict[str, Any]:
    """What came out, and whether it is right."""
    cost = {"seconds": round(done.seconds, 1), "cpu_seconds": round(done.cpu, 1)}
    if not done.came_to_a_result:
        why = "time was up" if done.code is None else f"exit {done.code}: {done.said}"
        return {"answer": "no result", "verdict": "", "found": "", "amount_error": None, "why": why, **cost}
    found = judge(done.result, case.planted, case.alike)
    named = "; ".join(_named(e) for e in done.result["effects"]) or "nothing"
    error = None if found.error != found.error else round(found.error, 4)
    return {
        "answer": found.answer,
        "verdict": done.result["verdict"],
        "found": named,
        "amount_error": error,
        "why": found.why,
        **cost,
    }


def _named(entry: dict[str, Any]) -> str:
    values = ", ".join(f"{p['value']:.3g}" for p in entry["parameters"])
    return f"{entry['effect']} {values} at {', '.join(entry['where'])}"
