"""Make every file of this folder again: `python -m sample_logs.generate` from the top of the checkout.

Needs Pinocchio (`pip install pin`). Same versions, same numbers: every recording is seeded.
"""

from __future__ import annotations

import argparse
import json
import shutil
import sys
from pathlib import Path

from benchmarks.ground import PERIOD, SECONDS, STEP, Ground, Walker, record
from reference_simulator import Recording, Sensors, parse_effect, save
from reference_simulator.robot import ROBOTS
from sysid_btr.io.parquet import write_log
from sysid_btr.models.gait import Gait

HERE = Path(__file__).parent
MODELS = {"leg.xml": ROBOTS / "six_joint_leg.xml", "pendulum.xml": ROBOTS / "pendulum.xml"}

LEG, NAO, PENDULUM = HERE / "leg.xml", HERE / "nao.xml", HERE / "pendulum.xml"
LEG_MASS = {"HipPitch": 0.9, "KneePitch": 1.2}

SAMPLES: dict[str, Recording] = {
    "leg_clean": Recording(LEG, seed=11, mass=LEG_MASS, kp=0.92),
    "leg_friction": Recording(
        LEG, seed=12, mass=LEG_MASS, kp=0.92, effects=(parse_effect("coulomb_friction:KneePitch:torque=0.3"),)
    ),
    "leg_backlash": Recording(
        LEG, seed=13, mass={"KneePitch": 1.15}, effects=(parse_effect("backlash:KneePitch:play=0.03"),)
    ),
    "leg_dropout": Recording(
        LEG,
        seed=14,
        mass={"KneePitch": 1.15},
        effects=(parse_effect("controller_dropout:KneePitch:duration=0.1,every=1.7"),),
    ),
    "nao_delay": Recording(
        NAO,
        seed=21,
        seconds=12.0,
        mass={"RKneePitch": 1.2, "LHipPitch": 0.85},
        kp=1.05,
        effects=(parse_effect("command_delay:delay=0.025"),),
    ),
    "pendulum_clean": Recording(PENDULUM, seed=31, seconds=10.0, mass={"arm": 1.1}, kp=0.95),
    "pendulum_friction": Recording(
        PENDULUM, seed=32, seconds=10.0, motion="poses", effects=(parse_effect("coulomb_friction:torque=0.2"),)
    ),
    "pendulum_weak": Recording(
        PENDULUM,
        seed=33,
        seconds=10.0,
        motion="steps",
        effects=(parse_effect("speed_torque_limit:stall=1.5,no_load_speed=6"),),
        sensors=Sensors(effort=True),
    ),
}

WALKS: dict[str, Walker] = {
    "nao_walk": Walker(
        gait=Gait(period=1.0, step_length=0.02, step_height=0.015, sway=0.05),
        ground=Ground(stiffness=15e3, damping=0.5, friction=0.8, creep=0.01),
        masses={"RHipPitch": 1.2, "LHipPitch": 1.15, "RKneePitch": 0.85, "LKneePitch": 0.8},
        kp=0.95,
        kv=1.05,
        arms=0.2,
        seed=41,
    )
}


def save_walk(walker: Walker, file: Path) -> None:
    """Write a walk, and its truth beside it.

    Raises
    ------
    RuntimeError
        If the walker falls.
    """
    log = record(walker)
    if log is None:
        raise RuntimeError(f"{file.stem}: the walker falls")
    write_log(log, file, overwrite=True)
    truth = {
        "schema": "sysid_btr.truth/1",
        "robot": "nao",
        "model": "nao",
        "motion": "walk",
        "seed": walker.seed,
        "seconds": SECONDS,
        "rate": 1 / PERIOD,
        "step": STEP,
        "mass": {body: {"scale": factor} for body, factor in walker.masses.items()},
        "kp": {"*": {"scale": walker.kp}},
        "kv": {"*": {"scale": walker.kv}},
        "effects": [],
    }
    file.with_suffix(".truth.json").write_text(json.dumps(truth, indent=2) + "\n")


def main(argv: list[str] | None = None) -> int:
    """Write the models that are copies, then the logs with their truth."""
    parser = argparse.ArgumentParser(prog="python -m sample_logs.generate", description=__doc__)
    every = [*SAMPLES, *WALKS]
    parser.add_argument("names", nargs="*", help=f"which (default: all): {', '.join(every)}")
    names = parser.parse_args(argv).names or every
    unknown = [name for name in names if name not in every]
    if unknown:
        parser.error(f"no sample {', '.join(unknown)}; there are {', '.join(every)}")
    for name, source in MODELS.items():
        shutil.copyfile(source, HERE / name)
    for name in names:
        file = HERE / f"{name}.parquet"
        if name in WALKS:
            save_walk(WALKS[name], file)
        else:
            save(SAMPLES[name], file, overwrite=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
