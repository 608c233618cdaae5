"""The nine studies: logs, some of them cut short, and the command that is run on each."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from benchmarks.gantry import FIT, data_folder

SAMPLES = Path(__file__).resolve().parents[2] / "sample_logs"
LEG = ("--fit", "mass:HipPitch,KneePitch", "--fit", "kp:*=shared", "--fit", "kv:*=shared")
INERTIAL = tuple(word for expression in FIT for word in ("--fit", expression))
CONTACT = ("--fit", "foot_compliance:*AnkleRoll=shared", "--fit", "foot_friction:*AnkleRoll=shared")


@dataclass(frozen=True)
class Reference:
    """One study.

    Attributes
    ----------
    name : of the study, and of the file that keeps its numbers.
    verb, model : of the command line.
    arguments : what else it takes.
    log : recording, or None where the study makes its own.
    seconds : part of the recording that is used; None for all of it.
    """

    name: str
    verb: str
    model: str
    arguments: tuple[str, ...]
    log: Path | None = None
    seconds: float | None = None

    @property
    def available(self) -> bool:
        """Whether the recording is on this machine."""
        return self.log is None or self.log.is_file()


def references() -> tuple[Reference, ...]:
    """All nine, quick ones first."""
    data = data_folder()
    leg, gantry, walk = str(SAMPLES / "leg.xml"), data / "nao_gantry", data / "nao_walk"
    hung = str(gantry / "nominal.xml")
    return (
        Reference("fit_leg", "fit", leg, LEG, SAMPLES / "leg_friction.parquet"),
        Reference("close_leg_friction", "close", leg, LEG, SAMPLES / "leg_friction.parquet"),
        Reference("close_leg_backlash", "close", leg, LEG, SAMPLES / "leg_backlash.parquet"),
        Reference(
            "posterior_leg",
            "posterior",
            leg,
            ("--fit", "mass:KneePitch", "--fit", "kp:*=shared", "--max-evaluations", "400"),
            SAMPLES / "leg_clean.parquet",
        ),
        Reference("fit_gantry_c", "fit", hung, INERTIAL, gantry / "gantry_c.parquet", 10.0),
        Reference("close_gantry_d", "close", hung, INERTIAL, gantry / "gantry_d.parquet", 10.0),
        Reference(
            "fit_walk_a",
            "fit",
            str(walk / "nominal_free.xml"),
            (*INERTIAL, *CONTACT, "--mode", "segments"),
            walk / "walk_a.parquet",
            8.0,
        ),
        Reference(
            "btr_ant",
            "btr",
            "ant",
            (
                *("--fit", "length:LFFemur,RFTibia", "--robot-sim", "ant", "--robot-set", "length:LFFemur=1.2"),
                *("--iterations", "2", "--trials", "2", "--duration", "1.2"),
            ),
        ),
        Reference("fit_emps", "fit", "emps", ("--fit", "mass:*", "--fit", "damping:*"), data / "emps" / "emps.parquet"),
    )
