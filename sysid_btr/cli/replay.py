"""``sysid-btr replay``."""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import zip_longest
from pathlib import Path
from typing import TYPE_CHECKING

from sysid_btr.cli.groups import (
    JsonOptions,
    ModelOptions,
    ModeOptions,
    ParamsOptions,
    ReadingOptions,
    SimulatorOptions,
    ThreadOptions,
)
from sysid_btr.cli.inputs import as_stated, find_robot, read_logs, warn_of
from sysid_btr.cli.kinds import Numbers
from sysid_btr.cli.options import option
from sysid_btr.cli.terminal import print_json, remark
from sysid_btr.errors import UsageError
from sysid_btr.progress import ProgressLine

if TYPE_CHECKING:
    from sysid_btr.io.log import Log
    from sysid_btr.models.robot import Robot
    from sysid_btr.simulation.numerics import Numerics
    from sysid_btr.terms.model import Model


@dataclass(frozen=True, kw_only=True)
class ReplayOptions(
    ModelOptions, ReadingOptions, ParamsOptions, ModeOptions, SimulatorOptions, ThreadOptions, JsonOptions
):
    """Options of `replay`."""

    set: Numbers = option({}, "Change the model first, e.g. 'kp:*=0.9'.", metavar="PARAMETERS=VALUE", decides=False)
    out: Path | None = option(None, "Folder for the predicted logs.", short="-o", metavar="DIR", decides=False)
    overwrite: bool = option(False, "Replace earlier results in --out.", decides=False)


def replay(options: ReplayOptions) -> int:
    """Replay a log in the model, and compare their sensors.

    The model gets the log's commands, and nothing is fitted. A motion that was not recorded yet (excite.parquet)
    is only played, which shows where every joint goes; --out keeps the predicted log.
    """
    began = time.perf_counter()
    robot = find_robot(options)
    logs = as_stated(read_logs(options.log, robot, motions=True), options)
    model, numerics = _changed(robot, options)
    targets = _targets(options.out, logs, options.overwrite)
    warn_of(robot, [one for one in logs if not one.is_motion])
    if any(one.is_motion for one in logs):
        _rehearse(robot, model, numerics, logs, targets, options)
    else:
        _compare(robot, model, numerics, logs, targets, options, began)
    for path in targets:
        remark(f"predicted log: {path}")
    return 0


def _changed(robot: Robot, options: ReplayOptions) -> tuple[Model, Numerics | None]:
    """What ``--params`` and ``--set`` make of the model; and the numerics of the run that found the former."""
    from sysid_btr.identify.replay import set_parameters
    from sysid_btr.terms.model import Model
    from sysid_btr.writeback.params import read_params

    model = set_parameters(robot, options.set)
    if options.params is None:
        return model, None
    params = read_params(options.params, robot)
    taken = {(m.called, place) for m in params.model.terms for place in m.places}
    twice = [f"{m.called}:{place}" for m in model.terms for place in m.places if (m.called, place) in taken]
    if twice:
        raise UsageError(f"given by --set and by --params: {', '.join(twice)}; give one of the two")
    return Model.joined([*params.model.parts, *model.parts]), params.numerics


def _compare(
    robot: Robot,
    model: Model,
    numerics: Numerics | None,
    logs: list[Log],
    targets: Sequence[Path],
    options: ReplayOptions,
    began: float,
) -> None:
    """Compare the model's sensors with the logs'."""
    from sysid_btr.display.text import console, joints_table, show
    from sysid_btr.identify.mode import Mode
    from sysid_btr.identify.outcome import replay_result
    from sysid_btr.identify.replay import predicted_log, replay_log
    from sysid_btr.identify.scores import open_loop_scores, score_problem
    from sysid_btr.identify.study import make_study
    from sysid_btr.io.parquet import write_log
    from sysid_btr.objectives.targets import COMPARED

    threads = options.threads
    with ProgressLine("replay") as progress:
        study = make_study(
            robot,
            logs,
            holdout=logs,
            channels=COMPARED,
            numerics=numerics,
            simulator=options.simulator,
            mode=Mode(options.mode, options.segments),
            threads=threads,
            progress=progress,
        )
        with progress.phase("replay of the logs", 0.6):
            scores, whole = score_problem(study.train_problem(model), model.values), open_loop_scores(study, model)
        for number, (path, one) in enumerate(zip(targets, logs, strict=False)):
            progress(done=number, total=len(targets), best=math.inf, note=f"prediction of {one.path}")
            own = [episode for episode in study.train if episode.log.path == one.path]
            if all(episode.procedure.replayed for episode in own):
                predicted = replay_log(robot, one, model, numerics=study.numerics, threads=threads)
            else:
                predicted = predicted_log(own, model, study.numerics, threads=threads)
            write_log(predicted, path, overwrite=options.overwrite)
    result = replay_result(study, scores, dict(options.set), time.perf_counter() - began, whole)
    if options.json:
        print_json(result)
        return
    screen = console(sys.stdout)
    show(result, screen)
    channel = study.leading_channel
    if channel in scores:
        unit = result["units"][channel].partition(",")[0]
        screen.print(joints_table(scores[channel].joints, channel, unit))


def _rehearse(
    robot: Robot,
    model: Model,
    numerics: Numerics | None,
    motions: Sequence[Log],
    targets: Sequence[Path],
    options: ReplayOptions,
) -> None:
    """Play motions in the model; say how far every joint goes."""
    from sysid_btr.display.text import console
    from sysid_btr.identify.replay import replay_log
    from sysid_btr.io.parquet import write_log
    from sysid_btr.report.motion import reach, reach_table

    if not all(one.is_motion for one in motions):
        raise UsageError("--log: give either excitation trajectories or recordings, not both")
    found = {}
    for path, one in zip_longest(targets, motions):
        predicted = replay_log(
            robot, one, model, numerics=numerics, simulator=options.simulator, threads=options.threads
        )
        found[str(one.path)] = reach(robot, one, predicted)
        if path is not None:
            write_log(predicted, path, overwrite=options.overwrite)
    if options.json:
        print_json(found)
        return
    screen = console(sys.stdout)
    for name, joints in found.items():
        screen.print(f"{name}: an excitation trajectory: simulated, with no recording to compare with")
        screen.print(reach_table(joints))


def _targets(out: Path | None, logs: Sequence[Log], overwrite: bool) -> list[Path]:
    """Where the predicted logs go; refused before any work if something is in the way."""
    if out is None:
        return []
    targets = [out / f"{log.path.stem if log.path else 'log'}.replayed.parquet" for log in logs]
    if len(set(targets)) < len(targets):
        raise UsageError("two logs have the same file name, so their replays would, too: run them one by one")
    there = [str(path) for path in targets if path.exists()]
    if there and not overwrite:
        raise UsageError(f"{', '.join(there)} exists; --overwrite replaces it, or choose another --out")
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UsageError(f"--out {out} cannot be created: {error.strerror}; choose another folder") from error
    return targets
