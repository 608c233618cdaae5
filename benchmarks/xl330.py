"""`python -m benchmarks.xl330`: the ladder of effects that `close` builds for a hobby servo that swings a pendulum.

From an ideal position servo on a rigid pendulum, of which only the torque constant is declared free. Nine recordings
(kp registers 100, 200 and 400; three motions each) in SYSID_BTR_DATA/xl330, else ../shared/data/xl330 beside the
checkout; says so and ends well if there is none. Each fold holds the logs of one kp register out (`none`: nothing), and
is kept in the table when it is done, so that the study can be stopped and goes on where it was.

The error is the mean absolute position error of a full-length open-loop replay, averaged over logs. After `close` has
found the effects, all numbers are refitted rung by rung with every log counting alike.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Any

import numpy as np

from benchmarks.gantry import data_folder
from sysid_btr.terms.model import Model

if TYPE_CHECKING:
    from sysid_btr.diagnosis.closing import Closing
    from sysid_btr.identify.study import Study

FOLDS = ("none", "kp100", "kp200", "kp400")
DECLARED = ("torque_constant:pendulum",)
EFFECTS = (
    "coulomb_friction",
    "viscous_damping",
    "stribeck_friction",
    "load_friction",
    "back_emf",
    "armature",
    "command_delay",
    "constant_force",
    "encoder_offset",
    "torque_limit",
    "voltage_sag",
    "joint_spring",
)
"""Friction, drive and mounting: what a servo on a bench can have. `--effects all` considers the whole library."""
MINIMUM_GAIN = 2e-4
"""As many rungs as help to predict."""
SEARCH, FINAL = 0.005, 0.0025
"""Steps, s, of the search and of the final fit."""
PUBLISHED = "0.050 rad with its simplest and 0.021 rad with its richest model: BAM, refitted to the same nine logs"


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.xl330", description=__doc__)
    parser.add_argument("folds", nargs="*", metavar="FOLD", help=f"of {', '.join(FOLDS)} (default: all)")
    parser.add_argument("--effects", default=",".join(EFFECTS), help="names, or all")
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results" / "xl330.json")
    parser.add_argument("--again", action="store_true", help="also folds that the table has")
    options = parser.parse_args(argv)
    folds = tuple(options.folds) or FOLDS
    unknown = set(folds) - set(FOLDS)
    if unknown:
        parser.error(f"no fold {', '.join(sorted(unknown))}; there are {', '.join(FOLDS)}")
    folder = data_folder() / "xl330"
    if not list(folder.glob("*.parquet")):
        print(f"no recordings in {folder}; set SYSID_BTR_DATA to the folder that holds xl330. Nothing to do.")
        return 0
    table = json.loads(options.out.read_text()) if options.out.exists() else {}
    for fold in folds:
        if fold not in table or options.again:
            table[fold] = examine(folder, fold, options.effects.split(","))
            options.out.parent.mkdir(parents=True, exist_ok=True)
            options.out.write_text(json.dumps(table, indent=1) + "\n")
        print(text_of(fold, table[fold]), flush=True)
    print(f"hand-built: {PUBLISHED}")
    return 0


def examine(folder: Path, fold: str, effects: Sequence[str]) -> dict[str, Any]:
    """Close the loop on the logs that are not held out, then refit rung by rung."""
    from sysid_btr.diagnosis.close import close
    from sysid_btr.diagnosis.selection import Selection
    from sysid_btr.identify.study import make_study
    from sysid_btr.io.parquet import read_log
    from sysid_btr.models.xl330 import xl330
    from sysid_btr.simulation.numerics import Numerics

    began = perf_counter()
    logs = [read_log(path) for path in sorted(folder.glob("*.parquet"))]
    kept = [log for log in logs if not Path(str(log.path)).name.startswith(fold)]

    def tell(*, done: int, total: int | None, best: float, note: str) -> None:
        sys.stderr.write(f"{perf_counter() - began:6.0f} s  {fold}: {note}\n")

    study = make_study(xl330(), kept, channels=("position",), numerics=Numerics("RK4", SEARCH), threads=1)
    found = close(study, list(DECLARED), effects=effects, progress=tell, selection=Selection(minimum_gain=MINIMUM_GAIN))
    # every log in full, and all alike
    whole = make_study(xl330(), logs, channels=("position",), numerics=Numerics("RK4", FINAL), threads=1)
    names = [Path(str(log.path)).stem for log in logs]
    whole = replace(whole, train=tuple(logs), inflation={})
    fitted = replace(whole, train=tuple(kept))
    rungs = climb(found, fitted)
    return {
        "verdict": found.verdict,
        "found": [
            {"effect": e.effect, "variant": e.variant, "sentence": e.sentence, "confused_with": list(e.confused_with)}
            for e in found.effects
        ],
        "steps": [" ".join((*s.added, *(f"- {r}" for r in s.removed))) for s in found.steps],
        "rungs": [
            {
                "added": added,
                "numbers": dict(zip(model.terms.names, map(float, model.values), strict=True)),
                "error": dict(zip(names, errors(whole, model), strict=True)),
            }
            for added, model in rungs
        ],
        "held_out": [n for n in names if n.startswith(fold)],
        "seconds": round(perf_counter() - began),
    }


def climb(found: Closing, study: Study) -> list[tuple[str, Model]]:
    """Least squares with the first effect, the first two, and so on, in the order in which they were found."""
    from sysid_btr.identify.refit import refit

    order = [label.split(" at ")[0] for step in found.steps for label in step.added]
    declared = found.before_model.terms
    effects = sorted(
        found.model.terms[len(declared) :],
        key=lambda m: order.index(m.label or m.name) if (m.label or m.name) in order else len(order),
    )
    result = []
    for count in range(len(effects) + 1):
        start = Model.joined((term, found.model.own(term)) for term in (*declared, *effects[:count]))
        fitted = refit(study, start, iterations=20)
        added = (effects[count - 1].label or effects[count - 1].name) if count else "torque constant alone"
        result.append((added, fitted.model))
    return result


def errors(study: Study, model: Model) -> list[float]:
    """Mean absolute position error of every log, rad."""
    problem = study.train_problem(model)
    result = []
    for episode in problem.episodes:
        outputs = episode.replay.predict(model.values[None])
        (target,) = episode.targets
        result.append(float(np.nanmean(np.abs(target.measured - target.predicted(outputs)[0]))))
    return result


def text_of(fold: str, entry: dict[str, Any]) -> str:
    """The ladder of a fold."""
    held = entry["held_out"]
    lines = [f"held out: {fold}   ({entry['seconds']} s, {entry['verdict']})"]
    for rung in entry["rungs"]:
        seen = [v for n, v in rung["error"].items() if n not in held]
        unseen = [v for n, v in rung["error"].items() if n in held]
        line = f"  {len(rung['numbers']):2d} numbers  fitted {np.mean(seen):.4f} rad"
        lines.append(f"{line}{f'  held out {np.mean(unseen):.4f} rad' if unseen else ''}  + {rung['added']}")
    return "\n".join(lines)


if __name__ == "__main__":
    sys.exit(main())
