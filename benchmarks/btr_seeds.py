"""Back to Reality on hidden robots, a seed each: what the studies of the ant and the Nao share."""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from time import perf_counter, process_time
from typing import Any

from sysid_btr.btr.loop import back_to_reality
from sysid_btr.btr.outcome import BackToReality
from sysid_btr.btr.robot import HiddenRobot
from sysid_btr.btr.settings import Settings
from sysid_btr.models.robot import Robot
from sysid_btr.report.btr import draw_btr
from sysid_btr.result import to_json
from sysid_btr.terms.base import Term

RESULTS = Path(__file__).parent / "results"


def study(
    name: str,
    doc: str | None,
    plan: type[Any],
    run: Callable[[int, Any, Path, int], dict[str, Any]],
    table: Callable[[Sequence[dict[str, Any]]], dict[str, Any]],
    show: Callable[[Sequence[dict[str, Any]]], str],
    argv: Sequence[str] | None,
) -> int:
    """The command line of a study.

    A seed that is finished is read from the folder of the runs; the table is of all that are finished.

    Parameters
    ----------
    name, doc : of the study's module.
    plan : frozen dataclass with defaults; each field is an option.
    run : of seed, plan, folder and threads, what is found.
    table, show : what the study says over seeds, and as text.
    """
    parser = argparse.ArgumentParser(prog=f"python -m benchmarks.{name}", description=doc)
    parser.add_argument("--seeds", type=int, nargs="*", default=[], help="to run; without, only the table")
    parser.add_argument("--out", type=Path, default=Path("out") / name, help="folder of the runs")
    parser.add_argument("--threads", type=int, default=1)
    for option, value in vars(plan()).items():
        parser.add_argument(f"--{option}", type=type(value), default=value)
    parser.add_argument("--record", action="store_true", help="write the table beside the other results")
    options = parser.parse_args(argv)
    chosen = plan(**{option: getattr(options, option) for option in vars(plan())})
    for seed in options.seeds:
        folder = options.out / f"seed_{seed:02d}"
        done = folder / "summary.json"
        if done.exists():
            continue
        folder.mkdir(parents=True, exist_ok=True)
        began, cpu = perf_counter(), process_time()
        found = run(seed, chosen, folder, options.threads)
        spent = {"cpu_s": process_time() - cpu, "wall_s": perf_counter() - began}
        done.write_text(to_json({"seed": seed, "plan": vars(chosen), **found, **spent}))
    finished = [json.loads(p.read_text()) for p in sorted(options.out.glob("seed_*/summary.json"))]
    if finished:
        (options.out / "table.json").write_text(to_json(table(finished)))
        if options.record:
            (RESULTS / f"{name}.json").write_text(to_json(table(finished)))
    print(show(finished))
    return 0


def loop(
    model: Robot,
    terms: Sequence[Term],
    robot: HiddenRobot,
    settings: Settings,
    folder: Path,
    threads: int,
    truth: Mapping[str, float] | None = None,
) -> BackToReality:
    """Back to Reality on one hidden robot; its result and figure are left in the folder, where it also resumes."""
    cpu = process_time()
    outcome = back_to_reality(
        model,
        terms,
        robot,
        robot.space,
        task=robot.task,
        settings=settings,
        seed=robot.seed,
        folder=folder,
        threads=threads,
        say=lambda text: print(f"seed {robot.seed} ({process_time() - cpu:.0f} s CPU): {text}", flush=True),
    )
    result = outcome.to_dict()
    (folder / "result.json").write_text(to_json(result))
    (folder / "fig3.png").write_bytes(draw_btr(result, truth=truth))
    return outcome
