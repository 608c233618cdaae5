"""What `fit`, `posterior` and `close` have in common: a study, a journal, and results that are written and printed."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from sysid_btr.cli.groups import FittingOptions, OutOptions, SearchingOptions
from sysid_btr.cli.inputs import as_stated, check_channels, initial_values, read_holdout, read_logs, warn_of
from sysid_btr.cli.options import deciding
from sysid_btr.cli.terminal import print_result, remark
from sysid_btr.errors import InterruptedRun, LostCluster, UsageError
from sysid_btr.progress import Interrupted, ProgressLine
from sysid_btr.run_folder import EXPLORER, Folder, open_folder
from sysid_btr.saving import as_model, write_all
from sysid_btr.version import __version__

if TYPE_CHECKING:
    from numpy.random import Generator

    from sysid_btr.diagnosis.closing import Closing
    from sysid_btr.estimators.journal import Journal
    from sysid_btr.executors.base import Executor
    from sysid_btr.identify.fit import Fit
    from sysid_btr.identify.study import Study
    from sysid_btr.io.log import Log
    from sysid_btr.models.robot import Robot
    from sysid_btr.posterior.outcome import Posterior
    from sysid_btr.terms.model import Terms

    Job = Callable[[Study, Journal, ProgressLine], Fit | Closing | Posterior]


@dataclass(frozen=True, eq=False)
class Keeper:
    """Where a run keeps what it finds: a folder and its journal, or memory alone."""

    folder: Folder | None
    journal: Journal

    @classmethod
    def open(cls, verb: str, options: OutOptions, robot: Robot) -> Keeper:
        """The journal of this run: a new one, or that of an earlier run with the same fingerprint."""
        from sysid_btr.estimators.journal import Journal

        if options.out is None:
            if options.resume:
                raise UsageError("--resume continues from the journal of an earlier run: give its --out folder")
            return cls(None, Journal())
        folder = open_folder(options.out, resume=options.resume, overwrite=options.overwrite)
        return cls(folder, Journal(folder.journal, fingerprint=fingerprint(verb, options, robot)))

    def interrupted(self, progress: ProgressLine) -> str:
        """What is kept of a run that was interrupted."""
        if self.folder is None:
            return "interrupted; without --out nothing is kept"
        at = f" at loss {progress.best:.4g}" if math.isfinite(progress.best) else ""
        return (
            f"interrupted{at}; {self.journal.evaluations} replays are kept in "
            f"{self.folder.journal}: repeat the command with --resume to continue"
        )


def fingerprint(verb: str, options: OutOptions, robot: Robot) -> str:
    """Digest of all that decides which candidates are evaluated."""
    import hashlib
    import json

    content = {"version": __version__, "verb": verb, **deciding(options), "model": robot.fingerprint}
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


@dataclass(frozen=True, eq=False)
class Run:
    """A fit, posterior or closing that was asked for."""

    verb: str
    options: FittingOptions
    robot: Robot
    logs: list[Log]
    keeper: Keeper

    @classmethod
    def open(cls, verb: str, options: FittingOptions, robot: Robot) -> Run:
        """Read logs and open the journal; nothing is simulated yet."""
        check_channels(options.channels)
        logs = as_stated(read_logs(options.log, robot), options)
        run = cls(verb, options, robot, logs, Keeper.open(verb, options, robot))
        if options.render and run.keeper.folder is None:
            raise UsageError("--render writes pictures: give an --out folder for them")
        return run

    def study(self, executor: Executor, progress: ProgressLine) -> Study:
        """Logs and model laid out; remarks on the logs go to stderr."""
        from sysid_btr.identify.mode import Mode
        from sysid_btr.identify.study import make_study
        from sysid_btr.objectives.targets import FITTED
        from sysid_btr.simulation.numerics import Numerics

        warn_of(self.robot, self.logs)
        return make_study(
            self.robot,
            self.logs,
            holdout=read_holdout(self.options.holdout, self.robot, self.options),
            channels=self.options.channels or FITTED,
            numerics=None if self.options.numerics is None else Numerics.parse(self.options.numerics),
            simulator=self.options.simulator,
            mode=Mode(self.options.mode, self.options.segments),
            threads=self.options.threads,
            executor=executor,
            progress=progress,
        )

    def carry_out(self, job: Job, *, explain: bool = False) -> int:
        """Do the work, write and print what it found, with all that was tried or the best of it; the exit code."""
        from sysid_btr.executors import caution, open_executor
        from sysid_btr.result import exit_code

        if told := caution(self.options.executor):
            remark(f"warning: {told}")
        began = time.perf_counter()
        with ProgressLine(self.verb) as progress, open_executor(self.options.executor) as executor:
            try:
                outcome = job(self.study(executor, progress), self.keeper.journal, progress)
            except Interrupted:
                raise InterruptedRun(self.keeper.interrupted(progress)) from None
            except LostCluster as lost:
                raise InterruptedRun(f"{lost}\n{self.keeper.interrupted(progress)}") from None
        result = outcome.to_dict(seed=self.options.seed, wall_s=time.perf_counter() - began)
        self._write(outcome, result)
        print_result(result, self.options.json, explain=explain)
        return exit_code(result)

    def _write(self, outcome: Fit | Closing | Posterior, result: dict[str, Any]) -> None:
        from sysid_btr.writeback.write import describe_model

        folder = self.keeper.folder
        if folder is None:
            describe_model(as_model(outcome), result)
            return
        report = write_all(folder, outcome, result)
        remark(f"report: {report}{f'; to explore: {folder.path / EXPLORER}' if 'explore' in result else ''}")
        if self.options.render:
            _draw(folder, as_model(outcome), result)


def _draw(folder: Folder, outcome: Fit | Closing, result: dict[str, Any]) -> None:
    from sysid_btr.report.pictures import rewrite
    from sysid_btr.report.render import CannotRenderError, save_pictures

    try:
        pictures = save_pictures(folder, outcome)
    except CannotRenderError as error:
        remark(
            f"no pictures: nothing here draws off-screen ({error}). Install a software driver (Debian, Ubuntu: "
            "libegl1 and libgl1-mesa-dri, or libosmesa6) or name a working one in MUJOCO_GL; everything else is "
            "written."
        )
        return
    remark(f"pictures: {', '.join(map(str, pictures))}")
    rewrite(folder, result, pictures[0].name)


def generator(seed: int) -> Generator:
    """The source of all random numbers of a run."""
    import numpy as np

    return np.random.default_rng(seed)


def search_of(
    options: SearchingOptions, robot: Robot, evaluations: int | None
) -> Callable[[Study, Terms, Generator, Journal, ProgressLine], Fit]:
    """A fit as it was asked for, of whatever study."""
    from sysid_btr.estimators import get_estimator
    from sysid_btr.estimators.base import Budget
    from sysid_btr.identify.fit import check_distance, fit
    from sysid_btr.objectives.distance import get_distance

    estimator, distance = get_estimator(options.estimator), get_distance(options.distance)
    check_distance(estimator, distance)

    def search(study: Study, terms: Terms, rng: Generator, journal: Journal, progress: ProgressLine) -> Fit:
        return fit(
            study,
            terms,
            estimator=estimator,
            rng=rng,
            budget=Budget(evaluations=evaluations),
            journal=journal,
            progress=progress,
            start=initial_values(terms, robot, options.params, options.start),
            distance=distance,
        )

    return search
