"""``sysid-btr btr``: from names to robots, and from what was found to files."""

from __future__ import annotations

import shutil
from dataclasses import dataclass, replace
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Any

from sysid_btr.cli.fitting import fingerprint
from sysid_btr.cli.groups import JsonOptions, ModelOptions, OutOptions, ParameterOptions, SeedOptions, ThreadOptions
from sysid_btr.cli.inputs import check_freed, find_robot
from sysid_btr.cli.kinds import Numbers
from sysid_btr.cli.options import option
from sysid_btr.cli.terminal import print_result, remark
from sysid_btr.errors import InterruptedRun, UsageError
from sysid_btr.progress import Interrupted, ProgressLine
from sysid_btr.run_folder import OVERLAY, Folder, open_folder

if TYPE_CHECKING:
    from sysid_btr.btr.controllers import ControllerSpace
    from sysid_btr.btr.robot import Robot
    from sysid_btr.btr.settings import Settings
    from sysid_btr.btr.task import Task
    from sysid_btr.estimators.base import Estimator
    from sysid_btr.models.robot import Robot as Model

KEPT = ("journals", "trials", "closings", "learnt")
"""Folders of a run beside its results."""
DRAWS = 12
"""Models that controllers are searched in: the longer the search, the more it finds what suits these few alone."""
BY_FITNESS, BY_SENSORS = 12, 4
"""Trials of an iteration where models are judged by fitness (the paper's m), and where by sensors."""


@dataclass(frozen=True, kw_only=True)
class BtrOptions(ModelOptions, ParameterOptions, SeedOptions, ThreadOptions, OutOptions, JsonOptions):
    """Options of `btr`."""

    robot_sim: str | None = option(
        None,
        "Simulation that stands for the robot; the search does not see it.",
        metavar="NAME|FILE",
        beside=True,
        decides=True,
    )
    robot_set: Numbers = option(
        {}, "Change that simulation, e.g. 'mass:*=1.1'.", metavar="PARAMETERS=VALUE", decides=True
    )
    exchange: Path | None = option(
        None,
        "Folder to exchange files with a real robot: commands to play appear in it, recordings are waited for.",
        metavar="DIR",
        decides=False,
    )
    wait: float | None = option(
        None, "Maximum time to wait for a recording.", otherwise="no limit", metavar="S", decides=False
    )
    task: str = option(
        "walk",
        "What the robot is to do: walk, reach:PLACE=X,Y,Z (a body or site, m), track:FILE (the motion of a log), or a "
        "task of your own.",
        metavar="NAME|MODULE:NAME",
        decides=True,
    )
    controllers: str | None = option(
        None,
        "Controllers that are searched: sine (a gait), spline, feedforward (of a motion), ant, nao, or your own.",
        otherwise="those of a built-in robot that walks, else what suits the task",
        metavar="NAME|MODULE:NAME",
        decides=True,
    )
    iterations: int = option(5, "Maximum number of iterations; 13 in the paper.", metavar="N", least=1, decides=False)
    trials: int | None = option(
        None,
        "Number of trials on the robot in each iteration.",
        otherwise="4; 12 with phi1",
        metavar="N",
        least=1,
        decides=True,
    )
    duration: float | None = option(
        None,
        "Length of a trial.",
        otherwise="of a walk 8, of the ant's 3; 4 to reach a point; the log's, or your task's, own",
        metavar="S",
        decides=True,
    )
    distance: str = option(
        "likelihood",
        "How models are compared with the robot: by the likelihood of the trials' logs, whatever the ground does; by "
        "phi1 (fitness, the paper); or by phi2[:BINS], mse, wasserstein of whole trials.",
        metavar="NAME",
        decides=True,
    )
    choice: str = option(
        "improvement",
        "How trials are chosen: improvement (expected, times the chance to stand), fittest (the paper), disagreement.",
        metavar="NAME",
        decides=True,
    )
    draws: int | None = option(
        None,
        "Number of models in which controllers are searched for, drawn from the distribution of the parameters; 1 is "
        "the model alone.",
        otherwise=f"{DRAWS} for the choice improvement, else 1",
        metavar="N",
        least=1,
        decides=True,
    )
    risk: float = option(
        0.25, "Weight of the worst quarter of these models beside their mean, 0 to 1.", metavar="WEIGHT", decides=True
    )
    fall_cost: float = option(0.05, "What a fall costs in the search for controllers.", metavar="FITNESS", decides=True)
    worthwhile: float | None = option(
        None, "Stop once another trial promises less than this.", metavar="FITNESS", decides=False
    )
    search: str = option(
        "cmaes", "How controllers are searched for: cmaes, or ga (the paper).", metavar="NAME", decides=True
    )
    model_search: str | None = option(
        None,
        "How models are searched for: cmaes, ga (the paper), or lsq, for a likelihood.",
        otherwise="lsq for a likelihood, else cmaes",
        metavar="NAME",
        decides=True,
    )
    requirement: float | None = option(None, "Stop once the robot does it this well.", metavar="FITNESS", decides=False)
    close: bool = option(
        True,
        "Look for missing effects, once, where no model explains the robot's logs: minutes, on two cores.",
        decides=True,
    )


def btr(options: BtrOptions) -> int:
    """Back to Reality: find a controller that works on the robot.

    Search for one in the model, try it on the robot, correct the model by the trial, and repeat. The robot is a
    simulation that the search does not see (--robot-sim), or a real one behind a folder (--exchange). Exit 5 if
    the model no longer predicts which controller is better on the robot; the results are written all the same.
    """
    from sysid_btr.btr.loop import back_to_reality
    from sysid_btr.btr.named import get_space, get_task
    from sysid_btr.result import exit_code
    from sysid_btr.terms.grammar import parse_parameters

    model = find_robot(options, options.bounds)
    check_freed(model, options.fit)
    if options.resume and options.out is None:
        raise UsageError("--resume continues from the journals of an earlier run: give its --out folder")
    task = get_task(options.task, model, options.duration)
    space = get_space(options.controllers or "", model, task)
    settings = settings_of(options, space)
    terms, robot = parse_parameters(options.fit, model), robot_of(options, model, task, space)
    folder = None if options.out is None else _open(options.out, options.resume, options.overwrite)
    began = perf_counter()
    with ProgressLine("btr") as progress:
        try:
            outcome = back_to_reality(
                model,
                terms,
                robot,
                space,
                task=task,
                settings=settings,
                seed=options.seed,
                folder=None if folder is None else folder.path,
                threads=options.threads,
                progress=progress,
                say=remark,
                fingerprint=fingerprint("btr", options, model),
            )
        except Interrupted:
            where = "without --out nothing is kept" if folder is None else f"finished work is kept in {folder.path}"
            more = "" if folder is None else ": repeat the command with --resume to continue"
            raise InterruptedRun(f"interrupted; {where}{more}") from None
    result = outcome.to_dict(wall_s=perf_counter() - began)
    if folder is not None:
        _write(folder, result)
    print_result(result, options.json)
    return exit_code(result)


def settings_of(options: BtrOptions, space: ControllerSpace) -> Settings:
    """How the loop searches."""
    from sysid_btr.btr.learning import model_fit
    from sysid_btr.btr.robust import Risk
    from sysid_btr.btr.settings import (
        LIKELIHOOD,
        Settings,
        cma_controller_searches,
        controller_search,
        model_search,
        papers_model_search,
    )

    models: dict[str, Estimator] = {"cmaes": model_search(), "ga": papers_model_search(), "lsq": model_fit()}
    by_distance = "lsq" if options.distance == LIKELIHOOD else "cmaes"
    search = by_distance if options.model_search is None else options.model_search
    if options.search not in ("ga", "cmaes"):
        raise UsageError(f"--search {options.search}: use ga or cmaes")
    if search not in models:
        raise UsageError(f"--model-search {search}: available: {', '.join(models)}")
    trials = options.trials or (BY_FITNESS if options.distance == "phi1" else BY_SENSORS)
    settings = Settings(
        iterations=options.iterations,
        trials=trials,
        controllers=controller_search(len(space.names)),
        models=models[search],
        distance=options.distance,
        choice=options.choice,
        draws=options.draws or (DRAWS if options.choice == "improvement" else 1),
        risk=Risk(weight=options.risk, fall=options.fall_cost),
        worthwhile=options.worthwhile,
        memory=max(trials, 4),
        requirement=options.requirement,
        close=options.close,
    )
    if options.search == "cmaes":
        first, controllers = cma_controller_searches()
        settings = replace(settings, first=first, controllers=controllers)
    return settings


def robot_of(options: BtrOptions, model: Model, task: Task, space: ControllerSpace) -> Robot:
    """What the controllers are tried on."""
    from sysid_btr.btr.exchange import FolderExchange
    from sysid_btr.btr.robot import HiddenRobot, Noise
    from sysid_btr.btr.world import make_world, mount_of
    from sysid_btr.identify.replay import set_parameters
    from sysid_btr.models.builtin import load_robot

    if (options.robot_sim is None) == (options.exchange is None):
        raise UsageError(
            "which robot? Give --robot-sim with a simulation that stands for it, or --exchange with the folder of "
            "a real one"
        )
    if options.exchange is not None:
        if options.robot_set:
            raise UsageError("--robot-set applies to --robot-sim only")
        return FolderExchange(
            options.exchange, task, space, model.name, patience=options.wait, say=remark, mount=mount_of(model)
        )
    hidden = load_robot(str(options.robot_sim))
    truth = set_parameters(hidden, options.robot_set)
    world = make_world(hidden, task, truth.terms, threads=1)
    return HiddenRobot(world, truth.values, task, space, Noise(), options.seed)


def _write(folder: Folder, result: dict[str, Any]) -> None:
    """Write result.json, figures and report."""
    from sysid_btr.report.btr import plot_btr
    from sysid_btr.report.figures import figure_of
    from sysid_btr.report.pictures import write_pages

    remark(f"report: {write_pages(folder, result, [(Path(OVERLAY).stem, lambda: figure_of(plot_btr(result)))])}")


def _open(out: Path, resume: bool, overwrite: bool) -> Folder:
    there = [out / name for name in KEPT if (out / name).is_dir()]
    if there and not (resume or overwrite):
        raise UsageError(
            f"--out {out} holds another run ({', '.join(p.name for p in there)}) which is not touched: --resume "
            "continues it, --overwrite replaces it, or choose another folder"
        )
    folder = open_folder(out, resume=resume, overwrite=overwrite)
    if overwrite:
        for path in there:
            shutil.rmtree(path)
    return folder
