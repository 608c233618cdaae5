"""``sysid-btr excite``."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from typing import TYPE_CHECKING

from sysid_btr.cli.fitting import Keeper, generator
from sysid_btr.cli.groups import (
    JsonOptions,
    LogOptions,
    ModelOptions,
    OutOptions,
    ParameterOptions,
    SeedOptions,
    ThreadOptions,
)
from sysid_btr.cli.inputs import check_freed, find_robot, read_logs
from sysid_btr.cli.kinds import Names, Numbers
from sysid_btr.cli.options import option
from sysid_btr.cli.terminal import print_json, remark
from sysid_btr.errors import InterruptedRun, UsageError
from sysid_btr.excite.settings import MotionSettings
from sysid_btr.progress import Interrupted, ProgressLine
from sysid_btr.run_folder import Folder

if TYPE_CHECKING:
    from sysid_btr.excite.design import Design
    from sysid_btr.io.log import Log
    from sysid_btr.models.robot import Robot


@dataclass(frozen=True, kw_only=True)
class ExciteOptions(ModelOptions, LogOptions, ParameterOptions, SeedOptions, ThreadOptions, OutOptions, JsonOptions):
    """Options of `excite`."""

    seconds: float = option(MotionSettings.seconds, "Length of the motion.", metavar="S", decides=True)
    rate: float = option(MotionSettings.rate, "Samples per second.", metavar="HZ", decides=True)
    noise: Numbers = option(
        {},
        "Standard deviation of the position sensors' noise (rad, m): position=1e-4.",
        otherwise="the log's, else that of a 12-bit encoder",
        metavar="position=SIGMA",
        decides=True,
    )
    joints: Names = option((), "Joints that move.", otherwise="all with a servo", metavar="GLOB[,GLOB..]", decides=True)
    margin: float = option(
        MotionSettings.margin,
        "Fraction of each joint's range that is left free at either end.",
        metavar="FRACTION",
        decides=True,
    )
    max_velocity: float | None = option(
        None, "Maximum velocity of every joint.", otherwise="6 rad/s; slides 0.3 m/s", metavar="V", decides=True
    )
    max_acceleration: float | None = option(
        None,
        "Maximum acceleration of every joint; less where the model limits a servo's torque.",
        otherwise="60 rad/s^2; slides 3 m/s^2",
        metavar="A",
        decides=True,
    )
    criterion: str = option(
        "mean",
        "What is minimised: mean (of the standard errors) or logdet (volume of the confidence ellipsoid).",
        metavar="NAME",
        decides=True,
    )
    estimator: str = option(
        "cmaes", "How the motion is searched for: cmaes, ga, nlopt:ALGORITHM.", metavar="NAME", decides=True
    )
    max_evaluations: int = option(400, "Maximum number of motions that are tried.", metavar="N", least=1, decides=False)


def excite(options: ExciteOptions) -> int:
    """Design a motion that makes chosen parameters identifiable.

    Writes excite.parquet, a log of commands to play on the robot (its torso fixed), result.json and a figure, and says
    which intervals to expect. The motion is compared with that of --log, which also gives the noise of the sensors, or
    else with the first motion of the search. Collisions are not checked: only the joints' limits keep the robot from
    hitting itself or the ground.
    """
    from sysid_btr.excite import outcome
    from sysid_btr.result import exit_code
    from sysid_btr.saving import save_motion

    robot = find_robot(options, options.bounds)
    check_freed(robot, options.fit)
    if options.out is None:
        raise UsageError("--out DIR is required: the folder for the motion")
    if len(options.log) > 1:
        raise UsageError("a motion is compared with one reference: give --log once")
    reference = read_logs(options.log, robot)[0] if options.log else None
    found, folder = _search(options, robot, reference)
    result = outcome.make_result(found, seed=options.seed)
    remark(f"report: {save_motion(folder, found, result)}")
    if options.json:
        print_json(result)
    else:
        from sysid_btr.display.text import console

        screen = console(sys.stdout)
        for part in outcome.show(result):
            screen.print(part)
    remark(f"motion: {folder.path / outcome.MOTION}. {outcome.WARNING}")
    if outcome.interrupted(found):
        raise InterruptedRun(
            "interrupted; the best motion so far is written, repeat the command with --resume to continue the search"
        )
    return exit_code(result)


def _search(options: ExciteOptions, robot: Robot, reference: Log | None) -> tuple[Design, Folder]:
    from sysid_btr.estimators.base import Budget
    from sysid_btr.excite import outcome
    from sysid_btr.excite.design import design, find_criterion, find_estimator

    estimator, criterion = find_estimator(options.estimator), find_criterion(options.criterion)
    motion = MotionSettings(
        seconds=options.seconds,
        rate=options.rate,
        joints=options.joints,
        margin=options.margin,
        velocity=options.max_velocity,
        acceleration=options.max_acceleration,
    )
    keeper = Keeper.open("excite", options, robot)
    assert keeper.folder is not None
    with ProgressLine("excite") as progress:
        try:
            found = design(
                robot,
                options.fit,
                reference=reference,
                motion=motion,
                noise=_position_noise(options.noise),
                criterion=criterion,
                estimator=estimator,
                rng=generator(options.seed),
                budget=Budget(evaluations=options.max_evaluations),
                journal=keeper.journal,
                progress=progress,
                threads=options.threads,
                search_context=outcome.first_interrupt_ends_the_search,
            )
        except Interrupted:
            raise InterruptedRun(keeper.interrupted(progress)) from None
    return found, keeper.folder


def _position_noise(given: Numbers) -> float | None:
    other = [name for name in given if name != "position"]
    if other:
        raise UsageError(f"--noise {other[0]}: excite plans by the positions alone; give position=SIGMA")
    return given.get("position")
