"""One log: recorded, closed, judged."""

from __future__ import annotations

import math
import sys
import traceback
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Any

from benchmarks.blind.families import FamilyJudgement, judge_families
from benchmarks.blind.judge import Context, Judgement, judge, signature_fits
from benchmarks.blind.recorded import Recorded, recipe_state, record
from benchmarks.blind.table import Row, append

if TYPE_CHECKING:
    from reference_simulator.effects import Effect

JUDGED = ("single", "pair", "shape")
"""Parts whose families are judged."""


@dataclass(frozen=True)
class Job:
    """One log that is to be recorded or closed; `code` is empty where it is only recorded."""

    part: str
    number: int
    series: int
    code: str
    out: Path
    threads: int


def work(job: Job) -> None:
    """Record a log, or close the loop on it and add a row to the table."""
    recorded = record(job.part, job.number, job.series)
    if not job.code:
        say(f"{recorded.id:<12}{recorded.bench.name:<16}{planted_text(recorded.effects) or 'nothing'}")
        return
    row = examine(recorded, job.code, recipe_state(job.part), job.out, job.threads)
    append(job.out, row)
    say(
        f"{row.id:<12}{row.robot:<16} {row.seconds:5.0f} s  {row.correct:<12}"
        f"{row.planted or 'nothing'} -> {row.named or row.verdict}{f'  ({row.why})' if row.why else ''}"
    )


def say(line: str) -> None:
    sys.stderr.write(f"{line}\n")
    sys.stderr.flush()


def examine(case: Recorded, code: str, recipe: str, out: Path, threads: int = 0) -> Row:
    """Close, judge. `close` sees the Parquet file and nothing else."""
    from reference_simulator import load_robot
    from sysid_btr.diagnosis.close import close
    from sysid_btr.identify.study import make_study
    from sysid_btr.io.parquet import read_log
    from sysid_btr.models.builtin import load_robot as load_model
    from sysid_btr.result import to_json

    kept = out.parent / "results" / f"{case.id.replace('/', '_')}.json"
    kept.parent.mkdir(parents=True, exist_ok=True)
    began = perf_counter()
    try:
        study = make_study(load_model(str(case.bench.model)), [read_log(case.path)], threads=threads)
        result = close(study, list(case.bench.fit)).to_dict()
    except Exception:
        text = traceback.format_exc()
        sys.stderr.write(text)
        kept.with_suffix(".error.txt").write_text(text)
        failure = Judgement("error", text.strip().splitlines()[-1], float("nan"), 0, 0)
        return _row(case, code, recipe, {}, failure, None, perf_counter() - began)
    seconds = perf_counter() - began
    kept.with_suffix(".error.txt").unlink(missing_ok=True)
    kept.write_text(to_json(result))
    robot = load_robot(case.bench.model)
    family = judge_families(result, case.effects, robot, case.effort) if case.part in JUDGED else None
    if case.part == "shape" and family is not None:
        judgement = Judgement(family.outcome, family.why, float("nan"), 0, 0)
    else:
        judgement = judge(result, case.effects, robot.joints, Context(case.effort, frozenset(case.bench.free)))
    return _row(case, code, recipe, result, judgement, family, seconds)


def _row(
    case: Recorded,
    code: str,
    recipe: str,
    result: dict[str, Any],
    found: Judgement,
    family: FamilyJudgement | None,
    seconds: float,
) -> Row:
    fits = signature_fits(case.effects, result.get("signature")) if case.part == "outside" else None
    return Row(
        id=case.id,
        part=case.part,
        series=case.series,
        number=case.number,
        code=code,
        recipe=recipe,
        robot=case.bench.name,
        motion=case.motion,
        seed=case.seed,
        effort=int(case.effort),
        planted=planted_text(case.effects),
        verdict=result.get("verdict", ""),
        named="; ".join(named(e) for e in result.get("effects", ())),
        correct=found.outcome,
        why=found.why,
        amplitude_error=_text(found.amplitude_error),
        in_ci95=f"{found.inside}/{found.told}" if found.told else "",
        chi2_before=_text(_chi2(result, "before")),
        chi2_after=_text(_chi2(result, "after")),
        signature=str((result.get("signature") or {}).get("summary", "")),
        signature_fits="" if fits is None else ("yes" if fits else "no"),
        seconds=round(seconds, 1),
        replays=int(result.get("replays", 0)),
        family_correct="" if family is None else family.outcome,
        families="" if family is None else "; ".join(_placed(g.family, sorted(g.where), "") for g, _ in family.named),
        certainties="" if family is None else _certainties(family),
        excess_gone=_text(_excess_gone(result)),
        evidence="" if family is None else _evidence(family),
    )


def _certainties(family: FamilyJudgement) -> str:
    """Of each name, followed by + where it is right."""
    return ";".join(f"{g.certainty:.3f}{'+' if right else '-'}" for g, right in family.named)


def _evidence(family: FamilyJudgement) -> str:
    """Of each name, what its certainty was said from: numbers by name."""
    return ";".join(" ".join(f"{k}={v:.4g}" for k, v in g.evidence.items()) for g, _ in family.named)


def _excess_gone(result: dict[str, Any]) -> float:
    """Share of the held-out error above the noise floor that the effects explain."""
    before, after = _chi2(result, "before") - 1.0, _chi2(result, "after") - 1.0
    return 1.0 - max(after, 0.0) / before if before > 0.0 else math.nan


def _chi2(result: dict[str, Any], when: str) -> float:
    """Held-out chi2 over all channels that were fitted; each channel has as many samples."""
    channels = result.get(when, {}).get("holdout", {})
    known = [s["chi2"] for s in channels.values() if s["chi2"] is not None]
    return sum(known) / len(known) if known else float("nan")


def _text(value: float) -> str:
    return "" if value != value else f"{value:.4g}"


def planted_text(effects: Sequence[Effect]) -> str:
    return "; ".join(_placed(e.name, e.where, _sizes(e.truth()["parameters"])) for e in effects)


def _sizes(parameters: dict[str, Any]) -> str:
    def text(value: Any) -> str:
        return "/".join(f"{v:.3g}" for v in value) if isinstance(value, list) else f"{value:.3g}"

    return ",".join(f"{k}={text(v)}" for k, v in parameters.items())


def named(entry: dict[str, Any]) -> str:
    """One effect of a result: name, places, amounts, and what it may be confused with."""
    labels = [p["name"].partition(":")[0].partition(".")[2] or "size" for p in entry["parameters"]]
    values = [p["value"] for p in entry["parameters"]]
    sizes = ",".join(f"{k}={v:.3g}" for k, v in list(zip(labels, values, strict=True))[:6])
    other = f" or {'/'.join(entry['confused_with'])}" if entry["confused_with"] else ""
    return _placed(entry["effect"], entry["where"], sizes) + other


def _placed(name: str, where: Sequence[str], sizes: str) -> str:
    place = ",".join(where) if len(where) < 6 else f"{len(where)} places"
    return f"{name}@{place} {sizes}" if place else f"{name} {sizes}"
