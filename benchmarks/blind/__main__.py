"""`python -m benchmarks.blind`: draw logs, close the loop on them, compare with the truth."""

from __future__ import annotations

import argparse
import hashlib
import importlib
import pkgutil
import subprocess
import sys
import traceback
from collections.abc import Sequence
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Any

from benchmarks.blind.draw import PARTS, Case, draw
from benchmarks.blind.judge import Context, Judgement, judge, signature_fits
from benchmarks.blind.summary import latest, summarise
from benchmarks.blind.table import Row, append, read_rows

if TYPE_CHECKING:
    from reference_simulator.effects import Effect

HERE = Path(__file__).parent
ROOT = HERE.parents[1]


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; the exit code."""
    options = _parser().parse_args(argv)
    if options.list:
        for case in _chosen(options):
            print(f"{case.id:<12}{case.bench.name:<4} {case.spec.motion:<10}{_planted(case.spec.effects) or 'nothing'}")
        return 0
    if not options.summary:
        _run(options)
    rows = [r for r in latest(read_rows(options.out), options.code) if r.series == options.series]
    print(summarise(rows), end="")
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.blind", description=__doc__)
    parser.add_argument("--part", choices=(*PARTS, "all"), default="all")
    parser.add_argument("--only", metavar="N,N", help="numbers within the part, from 1; a-b for a range")
    parser.add_argument("--count", type=int, metavar="N", help="stop after N logs")
    parser.add_argument("--seconds-budget", type=float, metavar="S", help="start no further log after S seconds")
    parser.add_argument(
        "--series", type=int, default=0, help="another draw of everything, for logs that nobody has tuned on"
    )
    parser.add_argument("--out", type=Path, default=HERE / "results.csv", help="table to continue")
    parser.add_argument("--threads", type=int, default=0, help="worker threads, 0 for all cores")
    parser.add_argument("--again", action="store_true", help="also logs that the table has for this code")
    parser.add_argument("--list", action="store_true", help="show what would be planted, and stop")
    parser.add_argument("--summary", action="store_true", help="only sum up the table")
    parser.add_argument("--code", help="sum up rows of this state of the code only")
    return parser


def _numbers(options: argparse.Namespace, part: str) -> list[int]:
    if not options.only:
        return list(range(1, PARTS[part] + 1))
    chosen: list[int] = []
    for item in options.only.split(","):
        first, _, last = item.partition("-")
        chosen += range(int(first), int(last or first) + 1)
    return [n for n in chosen if 1 <= n <= PARTS[part]]


def _parts(options: argparse.Namespace) -> list[str]:
    return list(PARTS) if options.part == "all" else [options.part]


def _chosen(options: argparse.Namespace) -> list[Case]:
    return [draw(part, n, options.series) for part in _parts(options) for n in _numbers(options, part)]


def _run(options: argparse.Namespace) -> None:
    code, recipe = code_state(), recipe_state()
    done = set() if options.again else {row.key for row in read_rows(options.out)}
    began, count = perf_counter(), 0
    for part in _parts(options):
        for number in _numbers(options, part):
            if (_id(part, number, options.series), recipe, code) in done:
                continue
            if options.count is not None and count >= options.count:
                return
            if options.seconds_budget is not None and perf_counter() - began > options.seconds_budget:
                return
            case = draw(part, number, options.series)
            row = examine(case, code, recipe, options.out, options.threads)
            append(options.out, row)
            count += 1
            sys.stderr.write(
                f"{row.id:<12}{row.robot:<4} {row.seconds:5.0f} s  {row.correct:<12}"
                f"{row.planted or 'nothing'} -> {row.named or row.verdict}{f'  ({row.why})' if row.why else ''}\n"
            )
            sys.stderr.flush()


def _id(part: str, number: int, series: int) -> str:
    return f"{f'{series}/' if series else ''}{part}-{number:02d}"


def examine(case: Case, code: str, recipe: str, out: Path, threads: int = 0) -> Row:
    """Record, close, judge. A log is recorded once; `close` sees the Parquet file and nothing else."""
    from reference_simulator import load_robot, save
    from sysid_btr.diagnosis.close import close
    from sysid_btr.identify.study import make_study
    from sysid_btr.io.parquet import read_log
    from sysid_btr.models.builtin import load_robot as load_model
    from sysid_btr.result import to_json

    path = HERE / "logs" / recipe / f"{case.id.replace('/', '_')}.parquet"
    if not path.with_suffix(".truth.json").exists():
        path.parent.mkdir(parents=True, exist_ok=True)
        save(case.spec, path, overwrite=True)
    kept = out.parent / "results" / f"{case.id.replace('/', '_')}.json"
    kept.parent.mkdir(parents=True, exist_ok=True)
    began = perf_counter()
    try:
        study = make_study(load_model(str(case.bench.model)), [read_log(path)], threads=threads)
        result = close(study, list(case.bench.fit)).to_dict()
    except Exception:
        text = traceback.format_exc()
        sys.stderr.write(text)
        kept.with_suffix(".error.txt").write_text(text)
        failure = Judgement("error", text.strip().splitlines()[-1], float("nan"), 0, 0)
        return _row(case, code, recipe, {}, failure, perf_counter() - began)
    seconds = perf_counter() - began
    kept.with_suffix(".error.txt").unlink(missing_ok=True)
    kept.write_text(to_json(result))
    context = Context(case.spec.sensors.effort, frozenset(case.bench.free))
    judgement = judge(result, case.spec.effects, load_robot(case.bench.model).joints, context)
    return _row(case, code, recipe, result, judgement, seconds)


def _row(case: Case, code: str, recipe: str, result: dict[str, Any], found: Judgement, seconds: float) -> Row:
    fits = signature_fits(case.spec.effects, result.get("signature"))
    return Row(
        id=case.id,
        part=case.part,
        series=case.series,
        number=case.number,
        code=code,
        recipe=recipe,
        robot=case.bench.name,
        motion=case.spec.motion,
        seed=case.spec.seed,
        effort=int(case.spec.sensors.effort),
        planted=_planted(case.spec.effects),
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
    )


def _chi2(result: dict[str, Any], when: str) -> float:
    """Held-out chi2 over all channels that were fitted; each channel has as many samples."""
    channels = result.get(when, {}).get("holdout", {})
    known = [s["chi2"] for s in channels.values() if s["chi2"] is not None]
    return sum(known) / len(known) if known else float("nan")


def _text(value: float) -> str:
    return "" if value != value else f"{value:.4g}"


def _planted(effects: Sequence[Effect]) -> str:
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


def code_state() -> str:
    """Commit of the package, with a digest of its sources where they differ from it; loads all of it first."""
    import sysid_btr

    for module in pkgutil.walk_packages(sysid_btr.__path__, "sysid_btr."):
        if not module.name.endswith("__main__"):
            importlib.import_module(module.name)
    folder = Path(sysid_btr.__file__).parent

    def git(*arguments: str) -> str:
        run = subprocess.run(["git", *arguments], cwd=folder, capture_output=True, text=True, check=False)
        return run.stdout.strip() if run.returncode == 0 else ""

    commit = git("rev-parse", "--short", "HEAD")
    changed = not commit or git("status", "--porcelain", "--", ".")
    name = f"{sysid_btr.__version__}-{commit}" if commit else sysid_btr.__version__
    return f"{name}+{_digest(sorted(folder.rglob('*.py')))}" if changed else name


def recipe_state() -> str:
    """Digest of what makes the logs."""
    sources = [HERE / "draw.py", HERE / "sizes.py", *sorted((ROOT / "reference_simulator").glob("*.py"))]
    return _digest([*sources, ROOT / "sample_logs" / "nao.xml", ROOT / "sample_logs" / "leg.xml"])


def _digest(files: Sequence[Path]) -> str:
    whole = hashlib.sha256()
    for file in files:
        whole.update(file.read_bytes())
    return whole.hexdigest()[:8]


if __name__ == "__main__":
    sys.exit(main())
