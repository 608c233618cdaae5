"""`python -m benchmarks.gantry`: the six recordings of a hanging Nao with known truth, at default settings.

Reads SYSID_BTR_DATA/nao_gantry, else ../shared/data/nao_gantry beside the checkout; says so and ends well if
there is none. Starred masses each, kp and kv shared; `close` is told nothing else.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Any

from benchmarks.blind.judge import Context, Judgement, judge
from benchmarks.blind.run import named
from reference_simulator.effects import Backlash, CommandDelay, CoulombFriction, Payload, SpeedTorqueLimit

if TYPE_CHECKING:
    from reference_simulator.effects import Effect

FIT = ("mass:*KneePitch,*HipPitch,*HipRoll,*ShoulderRoll", "kp:*=shared", "kv:*=shared")
SECONDS = 120.0
AMPLITUDE = 0.15


@dataclass(frozen=True)
class Truth:
    """What one log holds; how near the noise floor the held-out rmse must come; true scale factors."""

    effects: tuple[Effect, ...]
    floor: float
    declared: dict[str, float]


def _pair(joint: str) -> tuple[str, str]:
    return f"R{joint}", f"L{joint}"


GANTRY: dict[str, Truth] = {
    "a": Truth(
        (CoulombFriction(where=_pair("AnklePitch"), torque=0.25), CoulombFriction(where=_pair("HipRoll"), torque=0.3)),
        1.1,
        {"RHipPitch": 1.2, "LHipPitch": 1.15, "RKneePitch": 0.85, "LKneePitch": 0.8, "kp": 0.92},
    ),
    "b": Truth((CommandDelay(delay=0.025),), 1.1, {"RShoulderRoll": 1.25, "LShoulderRoll": 0.85, "kp": 1.08}),
    "c": Truth((), 1.1, {"RKneePitch": 1.25, "LKneePitch": 0.8, "RHipPitch": 0.9, "kp": 0.9}),
    "d": Truth((Backlash(where=_pair("KneePitch"), play=0.03),), 1.3, {"LHipPitch": 1.2}),
    "e": Truth((Payload(where=("RElbowRoll",), mass=0.18, offset=(0.06, 0.0, 0.0)),), 1.1, {"RKneePitch": 1.2}),
    "f": Truth((SpeedTorqueLimit(where=_pair("ShoulderPitch"), stall=0.8, no_load_speed=7.0),), 1.3, {"kp": 1.05}),
}


@dataclass(frozen=True)
class Outcome:
    """One line of the table."""

    letter: str
    result: dict[str, Any]
    found: Judgement
    seconds: float

    @property
    def over_floor(self) -> float:
        """Held-out position rmse over the noise floor."""
        return float(self.result["after"]["holdout"]["position"]["rmse"] / self.result["noise_floor"]["position"])

    @property
    def problems(self) -> list[str]:
        """What falls short of the target."""
        found = self.found
        checks = {
            f"{found.outcome} {found.why}".strip(): found.outcome != "yes",
            "amount": found.amplitude_error > AMPLITUDE and found.inside < found.told,
            "held-out error": self.over_floor > GANTRY[self.letter].floor,
            "time": self.seconds > SECONDS,
        }
        return [what for what, wrong in checks.items() if wrong]


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; 0 also where the data are missing, 1 where a target is missed."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.gantry", description=__doc__)
    parser.add_argument("letters", nargs="*", metavar="LETTER", help=f"of {', '.join(GANTRY)} (default: all)")
    parser.add_argument("--out", type=Path, help="folder for one result.json a log")
    parser.add_argument("--threads", type=int, default=0, help="worker threads, 0 for all cores")
    options = parser.parse_args(argv)
    unknown = set(options.letters) - set(GANTRY)
    if unknown:
        parser.error(f"no recording {', '.join(sorted(unknown))}; there are {', '.join(GANTRY)}")
    folder = data_folder() / "nao_gantry"
    if not (folder / "nominal.xml").exists():
        print(f"no recordings in {folder}; set SYSID_BTR_DATA to the folder that holds nao_gantry. Nothing to do.")
        return 0
    outcomes = []
    for letter in options.letters or GANTRY:
        outcomes.append(examine(folder, letter, options.threads, options.out))
        print(line(outcomes[-1]), flush=True)
    right = sum(not o.problems for o in outcomes)
    print(f"{right} of {len(outcomes)} reach every target")
    return 0 if right == len(outcomes) else 1


def data_folder() -> Path:
    """Where the shared recordings are, or would be."""
    given = os.environ.get("SYSID_BTR_DATA")
    return Path(given) if given else Path(__file__).parents[2] / "shared" / "data"


def examine(folder: Path, letter: str, threads: int, out: Path | None) -> Outcome:
    """Close the loop on one recording."""
    from reference_simulator import load_robot as recorder_robot
    from sysid_btr.diagnosis.close import close
    from sysid_btr.identify.study import make_study
    from sysid_btr.io.parquet import read_log
    from sysid_btr.models.builtin import load_robot
    from sysid_btr.result import to_json

    model = folder / "nominal.xml"
    began = perf_counter()
    log = read_log(folder / f"gantry_{letter}.parquet")
    study = make_study(load_robot(str(model)), [log], threads=threads)
    result = close(study, list(FIT)).to_dict()
    seconds = perf_counter() - began
    if out is not None:
        out.mkdir(parents=True, exist_ok=True)
        (out / f"gantry_{letter}.json").write_text(to_json(result))
    robot = recorder_robot(model)
    planted = tuple(e.resolved(robot) for e in GANTRY[letter].effects)
    found = judge(result, planted, robot.joints, _context(log, planted))
    return Outcome(letter, result, found, seconds)


def _context(log: Any, planted: Sequence[Effect]) -> Context:
    free = {s + b for b in ("KneePitch", "HipPitch", "HipRoll", "ShoulderRoll") for s in "RL"}
    return Context(effort=any(c.startswith("effort.") for c in log.channels), free=frozenset(free))


def line(o: Outcome) -> str:
    """One recording in a few lines of text."""
    found, result = o.found, o.result
    names = "; ".join(named(e) for e in result["effects"]) or "nothing"
    error = f"{100 * found.amplitude_error:.1f} % off" if found.told else "-"
    inside = f", {found.inside} of {found.told} in ci95" if found.told else ""
    state = "ok" if not o.problems else "MISSED: " + ", ".join(o.problems)
    return (
        f"gantry_{o.letter}  {result['verdict']:<16} held-out rmse/floor {o.over_floor:.3f} "
        f"(limit {GANTRY[o.letter].floor})  {o.seconds:.0f} s  {state}\n"
        f"          {names}\n          amounts {error}{inside}; declared: {_declared(o)}"
    )


def _declared(o: Outcome) -> str:
    """Scale factors that are not one, found and true."""
    true = GANTRY[o.letter].declared
    parts = []
    for p in o.result["parameters"]:
        field, _, place = p["name"].partition(":")
        key = place if field == "mass" else field
        if key in true and (field == "mass" or field == "kp"):
            parts.append(f"{key} {p['value']:.3f} (true {true[key]:g})")
    return ", ".join(parts) or "-"


if __name__ == "__main__":
    sys.exit(main())
