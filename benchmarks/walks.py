"""`python -m benchmarks.walks`: the recordings of a walking Nao with known truth, at default settings.

`fit_a`: starred masses, kp, kv, contact of the feet. `together`: the same masses and gains from walk_a and a log of the
same robot hanging, each alone and both at once. `close_a`, `close_b`: starred masses, kp and kv declared, `close` is
told nothing else. `fall`: when the robot of walk_fall falls. A case that is finished is read from `--out`, so an
interrupted run goes on.

Reads SYSID_BTR_DATA/nao_walk and nao_gantry, else ../shared/data beside the checkout; says so and ends well if there
are none.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter, process_time
from typing import Any

from benchmarks.gantry import data_folder
from sysid_btr.diagnosis.close import close
from sysid_btr.floating_base.reconstruction import reconstruct
from sysid_btr.identify.fit import fit
from sysid_btr.identify.study import make_study
from sysid_btr.io.parquet import read_log
from sysid_btr.models.builtin import load_robot
from sysid_btr.result import to_json

RESULTS = Path(__file__).parent / "results" / "walks.json"
INERTIAL = ("mass:*KneePitch,*HipPitch,*HipRoll,*ShoulderRoll", "kp:*=shared", "kv:*=shared")
FLOOR = 1.5
"""Held-out position rmse over the noise floor that is allowed."""
LEGS, LEG_ERROR = ("HipPitch", "KneePitch"), 0.10
"""Thigh and shank, and the error of their masses that is allowed."""
FIT_SECONDS = 60.0
"""Wall time of a fit of 30 s of walking on two cores."""
FALL, FALL_ERROR = 9.11, 0.2
"""s, when the recorded robot has fallen: its base is tilted by more than 0.8 rad."""
DELAY, DELAY_ERROR = 0.040, 0.004
MASSES_A = {"mass:RHipPitch": 1.2, "mass:LHipPitch": 1.25, "mass:RKneePitch": 0.85, "mass:LKneePitch": 0.8}
MASSES_B = {"mass:RKneePitch": 1.2}


@dataclass(frozen=True)
class Folders:
    """Where the recordings are, and how many threads may be used."""

    data: Path
    threads: int

    def study(self, *logs: str, model: str = "nao_walk/nominal_free.xml") -> Any:
        robot = load_robot(str(self.data / model))
        return make_study(robot, [read_log(self.data / f"{n}.parquet") for n in logs], threads=self.threads)


def rows(parameters: Sequence[Mapping[str, Any]], masses: Mapping[str, float]) -> list[dict[str, Any]]:
    """One line a parameter: truth, estimate, interval, whether the one lies in the other."""
    result = []
    for p in parameters:
        truth = masses.get(p["name"], 1.0)
        low, high = p["ci95"]
        result.append(
            {
                "name": p["name"],
                "truth": truth,
                "value": p["value"],
                "std": p["std"],
                "ci95": [low, high],
                "identifiable": p["identifiable"],
                "inside": bool(low <= truth <= high),
            }
        )
    return result


def fit_a(folders: Folders) -> dict[str, Any]:
    """Masses and gains from walk_a."""
    result = fit(folders.study("nao_walk/walk_a"), list(INERTIAL)).to_dict()
    found = rows(result["parameters"], MASSES_A)
    ratio = over_floor(result)
    legs = {r["name"]: abs(r["value"] / r["truth"] - 1) for r in found if r["name"].endswith(LEGS)}
    return {
        "parameters": found,
        "over_floor": ratio,
        "missed": [
            *(f"{r['name']} outside its ci95" for r in found if not r["inside"]),
            *(f"{name} {100 * e:.0f} % off" for name, e in legs.items() if e > LEG_ERROR),
            *([f"held-out {ratio:.2f} noise floors"] if ratio > FLOOR else []),
        ],
    }


def over_floor(result: Mapping[str, Any]) -> float:
    """Held-out position rmse over the noise floor."""
    return float(result["after"]["holdout"]["position"]["rmse"] / result["noise_floor"]["position"])


def closing(folders: Folders, log: str, masses: Mapping[str, float]) -> tuple[dict[str, Any], list[str]]:
    result = close(folders.study(log), list(INERTIAL)).to_dict()
    found = rows(result["parameters"], masses)
    content = {
        "verdict": result["verdict"],
        "parameters": found,
        "over_floor": over_floor(result),
        "effects": result["effects"],
        "steps": result["steps"],
    }
    return content, [f"{r['name']} outside its ci95" for r in found if not r["inside"]]


def close_a(folders: Folders) -> dict[str, Any]:
    """Nothing is missing in walk_a but the other engine's contact."""
    content, missed = closing(folders, "nao_walk/walk_a", MASSES_A)
    for effect in content["effects"]:
        name = effect["effect"]
        if not name.startswith("foot_"):
            missed.append(f"{name} named, and there is none")
        elif effect["gain_holdout"] <= 0:
            missed.append(f"{name} named without a held-out gain")
    return {**content, "missed": missed}


def close_b(folders: Folders) -> dict[str, Any]:
    """Every command of walk_b is 40 ms late."""
    content, missed = closing(folders, "nao_walk/walk_b", MASSES_B)
    first = next((s["added"][0] for s in content["steps"] if s["added"]), "nothing")
    delay = next((e for e in content["effects"] if e["effect"] == "command_delay"), None)
    if not first.startswith("command_delay"):
        missed.append(f"{first} found first, not command_delay")
    if delay is None:
        missed.append("command_delay not named")
    else:
        amounts = [p["value"] for p in delay["parameters"]]
        if len(delay["where"]) < 22:
            missed.append(f"command_delay on {len(delay['where'])} joints only")
        if max(abs(a - DELAY) for a in amounts) > DELAY_ERROR:
            missed.append(f"command_delay {1e3 * min(amounts):.1f} to {1e3 * max(amounts):.1f} ms, not 40")
    return {**content, "missed": missed}


def fall(folders: Folders) -> dict[str, Any]:
    """The fall of walk_fall, and how much of the log before it is used."""
    robot = load_robot(str(folders.data / "nao_walk/nominal_free.xml"))
    log, base = reconstruct(robot, read_log(folders.data / "nao_walk/walk_fall.parquet"))
    moments = [e.start for e in base.events if e.kind == "fall"]
    found = moments[0] if moments else None
    used = float(log.time[-1] - log.time[0])
    missed = []
    if found is None or abs(found - FALL) > FALL_ERROR:
        missed.append(f"fall found at {found} s, not {FALL}")
    if found is not None and not found - 1.0 < used < found:
        missed.append(f"{used:.2f} s of the log used")
    return {"found": found, "truth": FALL, "used": used, "missed": missed}


def together(folders: Folders) -> dict[str, Any]:
    """Intervals from a hanging and a walking robot, each log alone and both at once.

    gantry_c holds other masses than walk_a, so the hanging log is recorded with gantry_c's commands and walk_a's
    masses.
    """
    from reference_simulator import Recording, record
    from reference_simulator import load_robot as recorder_robot

    model = folders.data / "nao_gantry/nominal.xml"
    recorded = read_log(folders.data / "nao_gantry/gantry_c.parquet")
    commands = recorded.array("command", recorder_robot(model).joints)
    masses = {name.removeprefix("mass:"): factor for name, factor in MASSES_A.items()}
    hanging, _ = record(Recording(model, seconds=len(commands) / 100, rate=100, mass=masses, commands=commands, seed=3))
    walking = read_log(folders.data / "nao_walk/walk_a.parquet")
    robot = load_robot(str(folders.data / "nao_walk/nominal_free.xml"))
    std: dict[str, dict[str, float]] = {}
    found: list[dict[str, Any]] = []
    for name, logs in {"hanging": [hanging], "walking": [walking], "both": [hanging, walking]}.items():
        result = fit(make_study(robot, logs, threads=folders.threads), list(INERTIAL)).to_dict()
        found = rows(result["parameters"], MASSES_A)
        std[name] = {r["name"]: r["std"] for r in found}
    smaller = {p: s < min(std["hanging"][p], std["walking"][p]) for p, s in std["both"].items()}
    return {
        "parameters": found,
        "std": std,
        "smaller": smaller,
        "missed": [
            *(f"{p}: the interval of both is no smaller" for p, ok in smaller.items() if not ok),
            *(f"{r['name']} outside its ci95" for r in found if not r["inside"]),
        ],
    }


CASES: dict[str, Callable[[Folders], dict[str, Any]]] = {
    "fall": fall,
    "fit_a": fit_a,
    "close_b": close_b,
    "close_a": close_a,
    "together": together,
}


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; 0 also where the data are missing, 1 where a target is missed."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.walks", description=__doc__)
    parser.add_argument("cases", nargs="*", metavar="CASE", help=f"of {', '.join(CASES)} (default: all)")
    parser.add_argument("--out", type=Path, default=Path("out/walks"), help="folder of the cases' results")
    parser.add_argument("--threads", type=int, default=0, help="worker threads, 0 for all cores")
    parser.add_argument("--record", action="store_true", help=f"write {RESULTS.name} beside the other results")
    options = parser.parse_args(argv)
    unknown = set(options.cases) - set(CASES)
    if unknown:
        parser.error(f"no case {', '.join(sorted(unknown))}; there are {', '.join(CASES)}")
    folders = Folders(data_folder(), options.threads)
    if not (folders.data / "nao_walk" / "nominal_free.xml").exists():
        print(f"no recordings in {folders.data / 'nao_walk'}; set SYSID_BTR_DATA. Nothing to do.")
        return 0
    outcomes = {}
    for case in options.cases or CASES:
        outcomes[case] = run_case(case, folders, options.out / f"{case}.json")
        print(show(case, outcomes[case]), flush=True)
    if options.record:
        kept = json.loads(RESULTS.read_text()) if RESULTS.exists() else {}
        RESULTS.write_text(to_json({**kept, **outcomes}))
    right = sum(not o["missed"] for o in outcomes.values())
    print(f"{right} of {len(outcomes)} reach every target")
    return 0 if right == len(outcomes) else 1


def run_case(case: str, folders: Folders, file: Path) -> dict[str, Any]:
    """The result of a case: from its file if it is finished, else by running it."""
    if file.exists():
        content: dict[str, Any] = json.loads(file.read_text())
        return content
    began, cpu = perf_counter(), process_time()
    found = CASES[case](folders)
    content = {**found, "wall_s": perf_counter() - began, "cpu_s": process_time() - cpu, "threads": folders.threads}
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(to_json(content))
    return content


def show(case: str, outcome: Mapping[str, Any]) -> str:
    """One case in a few lines of text."""
    state = "ok" if not outcome["missed"] else "MISSED: " + "; ".join(outcome["missed"])
    facts = [f"{outcome['wall_s']:.0f} s wall, {outcome['cpu_s']:.0f} s CPU"]
    if "over_floor" in outcome:
        facts.insert(0, f"held-out rmse/floor {outcome['over_floor']:.2f} (limit {FLOOR})")
    if "verdict" in outcome:
        facts.insert(0, outcome["verdict"])
    if case == "fall":
        facts.insert(0, f"fall at {outcome['found']:.2f} s (true {FALL}), {outcome['used']:.2f} s used")
    lines = [f"{case:<9} {', '.join(facts)}  {state}"]
    added = (s for s in outcome.get("steps", ()) if s["added"])
    lines += [f"    + {', '.join(s['added'])}: held-out chi2 {s['holdout']:.3f}" for s in added]
    for effect in outcome.get("effects", ()):
        places = f"{len(effect['where'])} places" if len(effect["where"]) > 4 else ", ".join(effect["where"])
        amounts = ", ".join(
            f"{p['value']:.4g} [{p['ci95'][0]:.4g}, {p['ci95'][1]:.4g}] {p['unit']}" for p in effect["parameters"][:3]
        )
        lines.append(f"    {effect['effect']} at {places}: {amounts}; held-out gain {effect['gain_holdout']:.2f}")
    for row in outcome.get("parameters", ()):
        truth = "     -" if row["truth"] is None else f"{row['truth']:6.3f}"
        mark = {True: "", False: "  OUTSIDE", None: ""}[row["inside"]]
        low, high = row["ci95"]
        lines.append(f"    {row['name']:<28} true {truth}  {row['value']:7.4f} [{low:.4f}, {high:.4f}]{mark}")
    for name, table in outcome.get("std", {}).items():
        lines.append(f"    std {name:<9} " + "  ".join(f"{p} {s:.4f}" for p, s in table.items()))
    return "\n".join(lines)


if __name__ == "__main__":
    sys.exit(main())
