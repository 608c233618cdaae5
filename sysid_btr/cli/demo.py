"""``sysid-btr demo``: a sample log that ships with the package, and a measured one if at hand."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

from sysid_btr.cli.close import CloseOptions, close
from sysid_btr.cli.groups import ThreadOptions
from sysid_btr.cli.options import option
from sysid_btr.cli.terminal import remark
from sysid_btr.errors import UsageError

PACKAGE = Path(__file__).resolve().parents[1]


@dataclass(frozen=True, kw_only=True)
class DemoOptions(ThreadOptions):
    """Options of `demo`."""

    out: Path = option(Path("demo_out"), "Folder of the reports.", short="-o", metavar="DIR", decides=False)


def demo(options: DemoOptions) -> int:
    """Close the loop on a sample log, in about a minute.

    The robot of the sample has something that its model lacks. Where the recordings are at hand (SYSID_BTR_DATA), a
    measured log follows.
    """
    for case in cases():
        remark(f"\n== {case.title}\n$ {case.command(options.out)}")
        code = close(case.options(options))
        if code:
            return code
    return 0


@dataclass(frozen=True)
class Case:
    """One run of the demo: `close` on one log."""

    name: str
    title: str
    model: str
    log: Path
    free: tuple[str, ...]

    def command(self, out: Path) -> str:
        """The same at a shell."""
        free = " ".join(f"--fit '{p}'" for p in self.free)
        return f"sysid-btr close --model {self.model} --log {self.log} {free} --out {out / self.name}"

    def options(self, asked: DemoOptions) -> CloseOptions:
        """The same from Python."""
        return CloseOptions(
            model=self.model,
            log=(self.log,),
            fit=self.free,
            threads=asked.threads,
            out=asked.out / self.name,
            overwrite=True,
        )


def cases() -> tuple[Case, ...]:
    """The sample; and the measured log, if the recordings are there."""
    samples = sample_logs()
    leg = Case(
        name="leg",
        title="a leg, recorded from another simulator: two masses and the gain are off, "
        "and one joint has friction that the model lacks",
        model=str(samples / "leg.xml"),
        log=samples / "leg_friction.parquet",
        free=("mass:HipPitch,KneePitch", "kp:*=shared", "kv:*=shared"),
    )
    measured = recordings() / "emps" / "emps.parquet"
    if not measured.is_file():
        return (leg,)
    axis = Case(
        name="emps",
        title="a ball-screw axis, measured; the model knows its mass and its controller, nothing of friction",
        model="emps",
        log=measured,
        free=("mass:*",),
    )
    return (leg, axis)


def sample_logs() -> Path:
    """The sample logs: in an installed package inside it, in a checkout beside it.

    Raises
    ------
    UsageError
        If they are in neither.
    """
    for folder in (PACKAGE.parent / "sample_logs", PACKAGE / "sample_logs"):
        if (folder / "leg_friction.parquet").is_file():
            return folder
    raise UsageError(f"the sample logs are neither beside nor inside {PACKAGE}: install the package again")


def recordings() -> Path:
    """Recorded logs that do not ship with the package: `SYSID_BTR_DATA`, else beside the checkout."""
    named = os.environ.get("SYSID_BTR_DATA")
    return Path(named) if named else PACKAGE.parents[1] / "shared" / "data"
