"""The loop as the command line asks for it: from names to robots, and from what was found to files."""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Any

from sysid_btr.errors import InterruptedRun, UsageError
from sysid_btr.progress import Interrupted, ProgressLine
from sysid_btr.request import remark, what_can_be_freed
from sysid_btr.run_folder import OVERLAY, RESULT, Folder, open_folder

if TYPE_CHECKING:
    from sysid_btr.btr.controllers import ControllerSpace
    from sysid_btr.btr.loop import Settings
    from sysid_btr.btr.robot import Robot
    from sysid_btr.btr.task import Walk
    from sysid_btr.estimators.base import Estimator
    from sysid_btr.models.robot import Robot as Model

KEPT = ("journals", "trials", "closings")
"""Folders of a run beside its results."""
DURATIONS, LONG = {"ant": 3.0}, 8.0
"""s of a trial by robot, and of any other."""
BY_FITNESS, BY_SENSORS = 12, 2
"""Trials of an iteration where models are judged by fitness, and where by sensors (the paper's m)."""


@dataclass(frozen=True, eq=False)
class Asked:
    """What ``sysid-btr btr`` was asked for; see its help."""

    model: Model
    free: list[str]
    robot_sim: str | None
    robot_set: Mapping[str, float]
    exchange: Path | None
    wait: float | None
    iterations: int
    trials: int | None
    duration: float | None
    distance: str
    choice: str
    search: str
    model_search: str | None
    requirement: float | None
    close: bool
    seed: int
    threads: int

    def settings(self, space: ControllerSpace) -> Settings:
        """How the loop searches."""
        from sysid_btr.btr.loop import (
            LIKELIHOOD,
            Settings,
            cma_controller_searches,
            controller_search,
            model_search,
            papers_model_search,
        )
        from sysid_btr.btr.map_problem import model_fit

        models: dict[str, Estimator] = {"cmaes": model_search(), "ga": papers_model_search(), "lsq": model_fit()}
        by_distance = "lsq" if self.distance == LIKELIHOOD else "cmaes"
        search = by_distance if self.model_search is None else self.model_search
        if self.search not in ("ga", "cmaes"):
            raise UsageError(f"--search {self.search}: there are ga and cmaes")
        if search not in models:
            raise UsageError(f"--model-search {search}: there are {', '.join(models)}")
        trials = self.trials or (BY_FITNESS if self.distance == "phi1" else BY_SENSORS)
        settings = Settings(
            iterations=self.iterations,
            trials=trials,
            controllers=controller_search(len(space.names)),
            models=models[search],
            distance=self.distance,
            choice=self.choice,
            memory=max(trials, 4),
            requirement=self.requirement,
            close=self.close,
        )
        if self.search == "cmaes":
            first, controllers = cma_controller_searches()
            settings = replace(settings, first=first, controllers=controllers)
        return settings

    def robot(self, task: Walk, space: ControllerSpace) -> Robot:
        """What the controllers are tried on."""
        from sysid_btr.btr.exchange import FolderExchange
        from sysid_btr.btr.robot import HiddenRobot, Noise
        from sysid_btr.btr.world import make_world
        from sysid_btr.identify.replay import set_parameters
        from sysid_btr.models.builtin import load_robot

        if (self.robot_sim is None) == (self.exchange is None):
            raise UsageError(
                "which robot? Give --robot-sim with a simulation that stands for it, or --exchange with the folder of "
                "a real one"
            )
        if self.exchange is not None:
            if self.robot_set:
                raise UsageError("--robot-set changes a --robot-sim; a real robot is what it is")
            return FolderExchange(self.exchange, task, space, self.model.name, patience=self.wait, say=remark)
        hidden = load_robot(str(self.robot_sim))
        truth = set_parameters(hidden, self.robot_set)
        world = make_world(hidden, task, truth.terms, threads=1)
        return HiddenRobot(world, truth.values, task, space, Noise(), self.seed)


def run_btr(asked: Asked, out: Path | None, resume: bool, overwrite: bool) -> dict[str, Any]:
    """Run the loop, write what it found, and give the content of result.json.

    Raises
    ------
    InterruptedRun
        With what is kept and how to go on.
    """
    from sysid_btr.btr.controllers import get_space
    from sysid_btr.btr.loop import back_to_reality
    from sysid_btr.btr.result import btr_result
    from sysid_btr.btr.task import Walk
    from sysid_btr.terms.grammar import parse_parameters

    if not asked.free:
        raise UsageError(what_can_be_freed(asked.model))
    if resume and out is None:
        raise UsageError("--resume goes on with the journals of an earlier run: give its --out folder")
    space = get_space(asked.model.name)
    duration = DURATIONS.get(asked.model.name, LONG) if asked.duration is None else asked.duration
    if not duration >= 1:
        raise UsageError(f"--duration {duration:g}: a trial needs a second at least")
    task, settings = Walk(duration), asked.settings(space)
    terms, robot = parse_parameters(asked.free, asked.model), asked.robot(task, space)
    folder = None if out is None else _open(out, resume, overwrite)
    began = perf_counter()
    with ProgressLine("btr") as progress:
        try:
            outcome = back_to_reality(
                asked.model,
                terms,
                robot,
                space,
                task=task,
                settings=settings,
                seed=asked.seed,
                folder=None if folder is None else folder.path,
                threads=asked.threads,
                progress=progress,
                say=remark,
            )
        except Interrupted:
            where = "nothing is kept without --out" if folder is None else f"what is done is kept in {folder.path}"
            more = "" if folder is None else ": the same command with --resume goes on from there"
            raise InterruptedRun(f"interrupted; {where}{more}") from None
    result = btr_result(outcome, wall_s=perf_counter() - began)
    if folder is not None:
        write_btr(folder, result)
    return result


def write_btr(folder: Folder, result: dict[str, Any]) -> None:
    """Write figures, report and, last, result.json."""
    from sysid_btr.report.btr import plot_btr
    from sysid_btr.report.figures import figure_of
    from sysid_btr.report.pictures import keep, write_report
    from sysid_btr.result import to_json

    result["pictures"] = keep(folder, [(Path(OVERLAY).stem, lambda: figure_of(plot_btr(result)))])
    remark(f"report: {write_report(folder, result)}")
    folder.write(RESULT, to_json(result))


def _open(out: Path, resume: bool, overwrite: bool) -> Folder:
    there = [out / name for name in KEPT if (out / name).is_dir()]
    if there and not (resume or overwrite):
        raise UsageError(
            f"--out {out} holds another run ({', '.join(p.name for p in there)}) and it is not touched: --resume goes "
            "on with it, --overwrite replaces it, or choose another folder"
        )
    folder = open_folder(out, resume=resume, overwrite=overwrite)
    if overwrite:
        for path in there:
            shutil.rmtree(path)
    return folder
