"""`python -m benchmarks.unknown_ground`: what is missing in a walk over a ground that is not the model's.

A Nao in Drake (`reference_simulator.legged`), with other masses of its legs, another kp and hard contacts in the
corners of its soles, has one thing that nobody declares: a load on the torso or on a leg, a delay, friction, or a weak
joint. Walks are drawn by number and kept in the table when they are done; one that falls is drawn anew. `close` is told
which masses and gains are free, and nothing else; the mass of a leg's body with a load is not, which would be the load.

A walk is right if every name that is more likely right than not is of the family and at the place of what is missing,
apart from names of the contact; `wrong` if another is and the verdict is `explained`.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from time import process_time
from typing import TYPE_CHECKING, Any

import numpy as np

from benchmarks.ground import commands_of, draw
from reference_simulator.legged import DrakeRobot, Ground, Truth
from sysid_btr.btr.gaits import NaoGait
from sysid_btr.btr.robot import Noise, recorded
from sysid_btr.btr.task import Walk
from sysid_btr.diagnosis.close import close
from sysid_btr.identify.study import make_study
from sysid_btr.models.builtin import load_robot
from sysid_btr.result import to_json

if TYPE_CHECKING:
    from numpy.random import Generator

    from sysid_btr.io.log import Log

RESULTS = Path(__file__).parent / "results" / "unknown_ground.json"
BODIES = tuple(side + part for part in ("HipPitch", "KneePitch") for side in "RL")
GAINS = ("kp:*=shared", "kv:*=shared")
TASK, NAO = Walk(16.0), load_robot("nao")
PARTS = ("HipRoll", "HipPitch", "KneePitch", "AnklePitch", "AnkleRoll")
STEP = 2.5e-4
"""s, of Drake's steps, which are of first order and act like a latency of half of one."""
DAMPING_TIME = float(np.median(-NAO.model.actuator_biasprm[:, 2] / NAO.model.actuator_gainprm[:, 0]))
"""s, kv over kp of the servos, of all the same."""
CONTACT = "contact"
TRIES = 50


@dataclass(frozen=True)
class Missing:
    """What nobody declares: its family, its places, and how the robot has it."""

    family: str
    where: frozenset[str]
    truth: Mapping[str, Any]


def torso_load(rng: Generator) -> Missing:
    place = tuple(rng.uniform([-0.06, -0.03, -0.02], [0.06, 0.03, 0.1]).tolist())
    return Missing("payload", frozenset({"Torso"}), {"payload": {"Torso": (float(rng.uniform(0.2, 0.6)), place)}})


def leg_load(rng: Generator) -> Missing:
    body = str(rng.choice(BODIES))
    place = tuple(rng.uniform([0.0, -0.04, -0.1], [0.06, 0.04, 0.0]).tolist())
    return Missing("payload", frozenset({body}), {"payload": {body: (float(rng.uniform(0.1, 0.3)), place)}})


def late_commands(rng: Generator) -> Missing:
    return Missing("delay", frozenset(NaoGait().joints), {"delay": 0.002 * float(rng.integers(6, 24))})


def rubbing(rng: Generator) -> Missing:
    parts = rng.choice(PARTS, int(rng.integers(1, 3)), replace=False)
    joints = [side + str(part) for part in parts for side in "RL"]
    return Missing("friction", frozenset(joints), {"friction": dict.fromkeys(joints, float(rng.uniform(0.1, 0.3)))})


def weak_joint(rng: Generator) -> Missing:
    joint = str(rng.choice(list("RL"))) + str(rng.choice(PARTS))
    return Missing("gain", frozenset({joint}), {"kp": {joint: float(rng.uniform(0.5, 0.75))}})


KINDS: tuple[Callable[[Generator], Missing], ...] = (torso_load, leg_load, late_commands, rubbing, weak_joint)


@dataclass(frozen=True)
class Walker:
    """A robot by number that does not fall, what it lacks, and what its sensors tell."""

    missing: Missing
    truth: Truth
    log: Log


def walker(number: int) -> Walker:
    """The first walker of a number that stays upright.

    Raises
    ------
    RuntimeError
        All that were tried fell.
    """
    joints = NaoGait().joints
    for attempt in range(TRIES):
        rng = np.random.default_rng([23, number, attempt])
        missing = KINDS[number % len(KINDS)](rng)
        factors = dict(zip(BODIES, rng.uniform(0.85, 1.2, len(BODIES)).tolist(), strict=True))
        truth = Truth(
            mass={body: factor for body, factor in factors.items() if body not in missing.truth.get("payload", ())},
            gain=float(rng.uniform(0.88, 1.1)),
            ground=Ground(float(rng.uniform(0.6, 1.0)), float(10 ** rng.uniform(4.0, 5.0))),
            **missing.truth,
        )
        moves = draw(int(rng.integers(1 << 30)))
        commands = commands_of(replace(moves, arms=0.5 * moves.arms), TASK.time, joints)
        played = DrakeRobot(NAO, TASK, NaoGait(), truth, step=STEP).play(commands)
        if not TASK.fallen(played.motion).any():
            log = recorded(played, TASK, joints, Noise(), rng, "nao").log
            assert log is not None
            return Walker(missing, truth, log)
    raise RuntimeError(f"walk {number}: {TRIES} robots fell")


def examine(number: int, threads: int) -> dict[str, Any]:
    """Close the loop on a walk."""
    one = walker(number)
    began = process_time()
    declared = [*(f"mass:{body}" for body in one.truth.mass), *GAINS]
    result = close(make_study(NAO, [one.log], threads=threads), declared).to_dict()
    seconds = process_time() - began
    told = [e for e in result["effects"] if e["certainty"] > 0.5 and e["family"] != CONTACT]
    true = {f"mass:{body}": factor for body, factor in one.truth.mass.items()} | {
        "kp:*": one.truth.gain,
        "kv:*": 1.0 + one.truth.gain * STEP / 2 / DAMPING_TIME,
    }
    return {
        "walk": number,
        "lacks": one.missing.truth,
        "verdict": result["verdict"],
        "answer": judged(one.missing, told, result["verdict"]),
        "effects": [
            {
                "effect": e["effect"],
                "family": e["family"],
                "where": e["where"],
                "certainty": round(e["certainty"], 3),
                "amounts": {p["name"]: [p["value"], *p["ci95"]] for p in e["parameters"]},
            }
            for e in result["effects"]
        ],
        "parameters": {
            p["name"]: {
                "truth": true[p["name"]],
                "value": p["value"],
                "ci95": p["ci95"],
                "inside": bool(p["ci95"][0] <= true[p["name"]] <= p["ci95"][1]),
            }
            for p in result["parameters"]
        },
        "over_floor": [
            result[when]["holdout"]["position"]["rmse"] / result["noise_floor"]["position"]
            for when in ("before", "after")
        ],
        "cpu_s": round(seconds),
    }


def judged(missing: Missing, told: Sequence[Mapping[str, Any]], verdict: str) -> str:
    """Right, or what it is instead."""
    places = {
        family: frozenset(p for e in told if e["family"] == family for p in e["where"])
        for family in dict.fromkeys(e["family"] for e in told)
    }
    false = [f for f, where in places.items() if f != missing.family or not where <= missing.where]
    if false:
        return "wrong" if verdict == "explained" else "provisional"
    found = frozenset().union(*places.values())
    return "right" if found == missing.where else ("some of its places" if found else "not named")


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.unknown_ground", description=__doc__)
    parser.add_argument("walks", nargs="*", type=int, default=range(10), help="by number (default: the first ten)")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--out", type=Path, default=RESULTS)
    options = parser.parse_args(argv)
    rows = json.loads(options.out.read_text())["walks"] if options.out.exists() else []
    for number in options.walks:
        if any(row["walk"] == number for row in rows):
            continue
        rows.append(examine(number, options.threads))
        options.out.write_text(to_json({"walks": rows}))
    for row in sorted(rows, key=lambda row: row["walk"]):
        named = "; ".join(f"{e['effect']} at {', '.join(e['where'][:4])} {e['certainty']:.2f}" for e in row["effects"])
        print(f"{row['walk']:3d} {row['cpu_s']:5d} s  {row['answer']}, {row['verdict']}: {row['lacks']} -> {named}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
