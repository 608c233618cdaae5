"""Make every file of this folder again: `python -m sample_logs.generate` from the top of the checkout.

Needs Pinocchio (`pip install pin`). Same versions, same numbers: every recording is seeded.
"""

from __future__ import annotations

import argparse
import shutil
import sys
from pathlib import Path

from reference_simulator import Recording, Sensors, parse_effect, save
from reference_simulator.robot import ROBOTS

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


def main(argv: list[str] | None = None) -> int:
    """Write the models that are copies, then the logs with their truth."""
    parser = argparse.ArgumentParser(prog="python -m sample_logs.generate", description=__doc__)
    parser.add_argument("names", nargs="*", help=f"which (default: all): {', '.join(SAMPLES)}")
    names = parser.parse_args(argv).names or list(SAMPLES)
    unknown = [name for name in names if name not in SAMPLES]
    if unknown:
        parser.error(f"no sample {', '.join(unknown)}; there are {', '.join(SAMPLES)}")
    for name, source in MODELS.items():
        shutil.copyfile(source, HERE / name)
    for name in names:
        save(SAMPLES[name], HERE / f"{name}.parquet", overwrite=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
