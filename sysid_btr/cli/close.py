"""``sysid-btr close``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from sysid_btr.cli.fitting import Run, generator
from sysid_btr.cli.groups import FittingOptions, NuisanceOptions
from sysid_btr.cli.inputs import find_robot, initial_values
from sysid_btr.cli.kinds import Names
from sysid_btr.cli.options import option
from sysid_btr.cli.terminal import remark

if TYPE_CHECKING:
    from sysid_btr.diagnosis.closing import Closing
    from sysid_btr.estimators.journal import Journal
    from sysid_btr.identify.study import Study
    from sysid_btr.models.robot import Robot
    from sysid_btr.progress import ProgressLine

DECLARED = ("mass:*", "kp:*=shared", "kv:*=shared")
"""What is fitted where nothing is said: a wrong mass or gain must not pass for an effect."""


@dataclass(frozen=True, kw_only=True)
class CloseOptions(NuisanceOptions, FittingOptions):
    """Options of `close`."""

    effects: Names = option(("all",), "Effects that may be named.", metavar="all|NAME[,NAME..]", decides=True)
    explain: bool = option(False, "Print all that was tried, and what became of it.", decides=False)


def close(options: CloseOptions) -> int:
    """Find what the model is missing, and add it.

    Fits the parameters, traces what is left to an effect, adds it and fits again, and shows the held-out error
    before and after. Without --fit all masses and the common servo gains are fitted, so that a wrong mass does
    not pass for an effect.
    """
    from sysid_btr.diagnosis.close import close as close_loop
    from sysid_btr.terms.library import select_effects

    robot = find_robot(options, options.bounds)
    select_effects(options.effects)
    options = replace(options, fit=declared(robot, options.fit))

    def job(study: Study, journal: Journal, progress: ProgressLine) -> Closing:
        study = replace(study, nuisance=options.nuisance)
        terms = study.declare(options.fit)
        return close_loop(
            study,
            terms,
            start=initial_values(terms, study.robot, options.params),
            effects=options.effects,
            rng=generator(options.seed),
            journal=journal,
            progress=progress,
        )

    return Run.open("close", options, robot).carry_out(job, explain=options.explain)


def declared(robot: Robot, fit: Sequence[str]) -> tuple[str, ...]:
    """What is fitted beside the effects."""
    from sysid_btr.models.robot import servo_joints

    if fit:
        return tuple(fit)
    chosen = tuple(p for p in DECLARED if p.startswith("mass") or servo_joints(robot))
    remark(f"fitting {', '.join(chosen)} (choose others by --fit)")
    return chosen
