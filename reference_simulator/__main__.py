"""`python -m reference_simulator`: one log from the command line."""

from __future__ import annotations

import argparse
import sys
from dataclasses import fields
from pathlib import Path

from reference_simulator.effects import EFFECTS, parse_effect
from reference_simulator.motions import MOTIONS
from reference_simulator.record import Recording, Sensors, save

EPILOG = """\
examples:
  python -m reference_simulator --robot six_joint_leg --motion multisine --seed 3 --out leg.parquet \\
      --effect coulomb_friction:KneePitch:torque=0.3 --mass KneePitch=1.2 --kp 0.9
  python -m reference_simulator --robot nao.xml --motion gait --seconds 12 --out walk.parquet \\
      --effect 'backlash:?KneePitch:play=0.03' --effect command_delay:delay=0.025 --kv '*Hip*=1.1'

An effect is NAME[:WHERE[,WHERE...]][:key=value[,key=value...]]: WHERE are globs over joints (bodies for
payload and com_offset; all when left out), vectors are written x/y/z. `--list` prints every effect with its
parameters.
"""


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m reference_simulator",
        description="Record a log of a robot whose every parameter is known.",
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--robot", help="MJCF file, or six_joint_leg, or pendulum")
    parser.add_argument("--out", type=Path, help="Parquet file; the truth goes to <stem>.truth.json beside it")
    parser.add_argument("--overwrite", action="store_true", help="replace existing files")
    parser.add_argument("--motion", default="multisine", choices=sorted(MOTIONS))
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--rate", type=float, default=100.0, help="commands and samples a second")
    parser.add_argument("--effect", action="append", default=[], metavar="EFFECT", help="repeatable; see below")
    parser.add_argument("--mass", action="append", default=[], metavar="BODY=FACTOR", help="repeatable, globs")
    parser.add_argument("--kp", action="append", default=[], metavar="[JOINT=]FACTOR", help="repeatable, globs")
    parser.add_argument("--kv", action="append", default=[], metavar="[JOINT=]FACTOR", help="repeatable, globs")
    parser.add_argument("--step", type=float, default=5.0e-4, help="step of the plant, s")
    parser.add_argument("--servo-period", type=float, help="digital servo of this period, s (default: continuous)")
    parser.add_argument("--preroll", type=float, default=0.0, help="seconds spent at the first command before 0")
    parser.add_argument("--log", default="", metavar="velocity,effort,imu", help="channels besides position")
    parser.add_argument("--list", action="store_true", help="print the effects and their parameters, and stop")
    return parser


def _scales(items: list[str]) -> dict[str, float]:
    out: dict[str, float] = {}
    for item in items:
        name, _, factor = item.rpartition("=")
        out[name or "*"] = float(factor)
    return out


def _listing() -> str:
    lines = []
    for name, kind in EFFECTS.items():
        values = ", ".join(f"{f.name}={f.default}" for f in fields(kind) if f.name != "where")
        lines.append(f"{name:<21}{'' if kind.in_library else '(in no library) '}{kind.acts_on}: {values}")
    return "\n".join(lines)


def main(argv: list[str] | None = None) -> int:
    """Run the command line; the exit code."""
    parser = _parser()
    options = parser.parse_args(argv)
    if options.list:
        sys.stdout.write(_listing() + "\n")
        return 0
    if not (options.robot and options.out):
        parser.error("--robot and --out are needed")
    extra = set(filter(None, options.log.split(",")))
    if not extra <= {"velocity", "effort", "imu"}:
        parser.error(f"--log takes velocity, effort, imu; not {options.log}")
    try:
        spec = Recording(
            robot=options.robot,
            motion=options.motion,
            seed=options.seed,
            seconds=options.seconds,
            rate=options.rate,
            mass=_scales(options.mass),
            kp=_scales(options.kp),
            kv=_scales(options.kv),
            effects=tuple(parse_effect(text) for text in options.effect),
            sensors=Sensors(**dict.fromkeys(extra, True)),
            step=options.step,
            servo_period=options.servo_period,
            preroll=options.preroll,
        )
        save(spec, options.out, overwrite=options.overwrite)
    except (ValueError, KeyError, FileNotFoundError, FloatingPointError) as error:
        parser.error(str(error))
    return 0


if __name__ == "__main__":
    sys.exit(main())
