"""Trials as a study: what `close` needs to look for what the model lacks.

A trial begins from standing still in a known pose. So its early part is replayed from there as in Step 3, and needs
no reconstruction of the base, as segments of a walk do; those cost many times the simulations.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import numpy as np

from sysid_btr._typing import FloatArray
from sysid_btr.btr.problems import Stage, on_clock
from sysid_btr.btr.trials import Tried
from sysid_btr.btr.world import World
from sysid_btr.floating_base.episode import FloatingProcedure
from sysid_btr.identify.episode import Episode, Procedure
from sysid_btr.identify.study import Study
from sysid_btr.io.log import Log
from sysid_btr.simulation.numerics import Numerics
from sysid_btr.terms.base import Outputs, Term
from sysid_btr.terms.model import Model

CHANNELS = ("position",)
PLAIN = Model.of(())
SECONDS = 2.0
"""s, from its beginning, of a trial that is looked at. Then the base has hardly moved; later an error of it drags all
joints along, and what a whole replay shows is chaos more and more, whatever the model."""


@dataclass(frozen=True)
class TrialReplay(World):
    """The world as a replay of one trial: the commands are those of its log.

    Attributes
    ----------
    fixed : what is not as nominal, beside what a candidate changes.
    """

    fixed: Model = PLAIN

    @property
    def all_terms(self) -> tuple[Term, ...]:
        return (*self.robot.always, *self.fixed.terms, *self.terms)

    def _values(self, candidates: FloatArray) -> list[tuple[Term, FloatArray]]:
        return super()._values(np.column_stack([np.tile(self.fixed.values, (len(candidates), 1)), candidates]))

    @cached_property
    def played(self) -> FloatArray:
        """Commands (1, n, j) for all joints of the model."""
        joints = self.log.joints("command")
        return self.spread(joints, self.log.array("command", joints)[None])

    def _run(self, candidates: FloatArray) -> Outputs:
        return self._walk(np.repeat(self.played, len(candidates), axis=0), candidates)


class TrialProcedure(FloatingProcedure):
    """How a fit goes about trials: as about any floating base, but where they began is known, and they are cheap."""

    coarse_suffices: ClassVar[bool] = False

    def coarse(self, numerics: Numerics) -> Numerics:
        return numerics


@dataclass(frozen=True, eq=False)
class TrialEpisode(Episode):
    """A trial, replayed whole from where it began.

    Attributes
    ----------
    fixed : as of `TrialReplay`.
    """

    fixed: Model = PLAIN

    @property
    def procedure(self) -> Procedure:
        return TrialProcedure()

    def replay(
        self, terms: Sequence[Term], numerics: Numerics, *, effort: bool = False, threads: int = 0
    ) -> TrialReplay:
        return TrialReplay(
            self.robot, self.log, tuple(terms), numerics, effort=effort, threads=threads, fixed=self.fixed
        )


def trial_study(
    stage: Stage, logs: Sequence[Log], held_out: Sequence[Log], threads: int = 0, fixed: Model = PLAIN
) -> Study:
    """Some trials to fit, and others to judge by.

    Parameters
    ----------
    stage : the model so far.
    logs, held_out : of trials; at least one each.
    threads : worker threads.
    fixed : terms that stay at given values.
    """
    time, robot = early(stage), stage.world.robot

    def episode(log: Log) -> TrialEpisode:
        log = on_clock(log, time)
        return TrialEpisode(robot, log, np.ones(len(log), dtype=bool), fixed)

    return Study(
        robot=robot,
        train=tuple(map(episode, logs)),
        holdout=tuple(map(episode, held_out)),
        channels=CHANNELS,
        numerics=stage.world.numerics,
        numerics_error=np.nan,
        threads=threads,
    )


def early(stage: Stage) -> FloatArray:
    """Sample times (n,) of the part of a trial that is looked at."""
    time = stage.task.time
    return time[: int(np.searchsorted(time, SECONDS + 1e-9))]


def early_logs(stage: Stage, tried: Sequence[Tried], most: int) -> list[Log]:
    """Logs of the newest trials of which the early part is whole; a fall that comes later is no matter."""
    end = float(early(stage)[-1])
    logs = [t.trial.log for t in tried if t.trial.log is not None and t.trial.outcome != "crashed"]
    return [log for log in logs if log.time[-1] - log.time[0] >= end - 1e-6][-most:]
