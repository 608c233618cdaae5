"""A real robot behind a folder: a command log to play goes in, a recorded log and what happened come out.

For each trial a folder ``trial_NNNN`` appears with ``command.parquet`` (log schema, commands only) and
``request.json``. Whoever runs the robot plays the commands and puts beside them ``recorded.parquet`` (log schema, its
first sample at the start of the commands) and, last, ``outcome.json``: ``{"outcome": "done", "fitness": 0.12}``, or
``fallen`` with the fitness up to the fall, or ``crashed``, which needs neither fitness nor log. A reply that cannot be
used is answered by ``problems.txt`` and waited for again. Nothing is lost if either side is stopped for a day.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from sysid_btr._typing import FloatArray
from sysid_btr.btr.controllers import Controller, ControllerSpace
from sysid_btr.btr.robot import OUTCOMES, Trial
from sysid_btr.btr.task import Task
from sysid_btr.errors import InterruptedRun, LogError, UsageError
from sysid_btr.io._text import some
from sysid_btr.io.log import MOTION, Log, LogMeta
from sysid_btr.io.parquet import read_log, write_log
from sysid_btr.io.problem import errors_of
from sysid_btr.io.resample import command_at
from sysid_btr.io.validation import validate_log
from sysid_btr.reading import parse_json
from sysid_btr.run_folder import Folder

SCHEMA = "sysid_btr.exchange/1"
REQUEST, COMMAND, RECORDED, REPLY, PROBLEMS = (
    "request.json",
    "command.parquet",
    "recorded.parquet",
    "outcome.json",
    "problems.txt",
)
APART, LATE = 0.01, 0.5
"""rad (m), and fraction of a command's standard deviation, by which what was played may differ from what was asked for:
a recorder notes a command some samples late, and another motion of the same size is 1.4 deviations away."""
SHORTEST = 0.9
"""Fraction of a trial that the recording of a run that did not fall must have."""


def quiet(_text: str) -> None:
    """Say nothing."""


@dataclass(frozen=True, eq=False)
class FolderExchange:
    """A robot that somebody runs, on another machine or by hand.

    Attributes
    ----------
    folder : of the exchange; created if missing.
    task, space : what is asked for.
    robot, mount : name of the robot, and whether its base is free or fixed, for the log.
    poll : s between looks for a reply.
    patience : s after which `InterruptedRun` is raised; None waits for ever.
    say : called with what is waited for.
    """

    folder: Path
    task: Task
    space: ControllerSpace
    robot: str = ""
    poll: float = 1.0
    patience: float | None = None
    say: Callable[[str], None] = quiet
    mount: Literal["fixed", "free"] = "free"

    def run(self, controller: Controller) -> Trial:
        """Ask for a trial, unless it was asked for before, and wait for what came of it.

        Raises
        ------
        UsageError
            If the folder holds another run's request, or cannot be written.
        InterruptedRun
            If nobody answers in time; the same run goes on from there.
        """
        place = self.folder / f"trial_{controller.label}"
        self._ask(place, controller)
        began = time.monotonic()
        refused: tuple[float, ...] = ()
        said = False
        while True:
            reply = place / REPLY
            state = _stamps(reply, place / RECORDED)
            if reply.exists() and state != refused:
                trial, problems = self._read(place)
                if trial is not None:
                    (place / PROBLEMS).unlink(missing_ok=True)
                    return trial
                refused = state
                Folder(place).write(PROBLEMS, "\n".join(problems) + "\n")
                self.say(f"{place}: the reply cannot be used:\n  " + "\n  ".join(problems))
            if not said:
                self.say(f"execute {place / COMMAND}, then put {RECORDED} and, last, {REPLY} next to it")
                said = True
            if self.patience is not None and time.monotonic() - began >= self.patience:
                raise InterruptedRun(
                    f"{place}: no usable reply after {self.patience:g} s; everything is kept, and the same command "
                    "with --resume continues to wait"
                )
            time.sleep(self.poll)

    def _ask(self, place: Path, controller: Controller) -> None:
        request = place / REQUEST
        content = {
            "schema": SCHEMA,
            "trial": controller.label,
            "robot": self.robot,
            "duration": self.task.duration,
            "sample_period": self.task.period,
            "fitness": _fitness(self.task),
            "parameters": dict(zip(self.space.names, map(float, controller.values), strict=True)),
        }
        if request.exists():
            try:
                there = parse_json(request.read_text(encoding="utf-8"))
            except (OSError, ValueError) as error:
                raise UsageError(f"{request} cannot be read ({error}); restore it or clear --exchange") from None
            if there != content:
                raise UsageError(
                    f"{request} is for another trial than this run's: it belongs to another run. Give another "
                    "--exchange folder, or --resume the run that it belongs to"
                )
            return
        try:
            place.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise UsageError(f"--exchange {place} cannot be created: {error.strerror}") from error
        write_log(self._command_log(controller.values), place / COMMAND, overwrite=True)
        Folder(place).write(REQUEST, json.dumps(content, indent=1) + "\n")

    def _command_log(self, values: FloatArray) -> Log:
        commands = self.space.commands(values[None], self.task.time)[0]
        return Log(
            time=self.task.time,
            channels={f"command.{joint}": commands[:, i] for i, joint in enumerate(self.space.joints)},
            meta=LogMeta(robot=self.robot, mount=self.mount, sample_period=self.task.period, source=MOTION),
            episode=np.zeros(len(self.task.time), dtype=np.int64),
        )

    def _read(self, place: Path) -> tuple[Trial | None, list[str]]:
        """A reply, or all that is wrong with it."""
        try:
            content: Any = parse_json((place / REPLY).read_text(encoding="utf-8"))
        except (OSError, ValueError) as error:
            return None, [f"{REPLY}: not JSON ({error})"]
        if not isinstance(content, dict) or content.get("outcome") not in OUTCOMES:
            return None, [
                f'{REPLY}: expected {{"outcome": one of {", ".join(OUTCOMES)}, "fitness": {_fitness(self.task)}}}'
            ]
        outcome = content["outcome"]
        fitness: Any = content.get("fitness", 0.0 if outcome == "crashed" else None)
        problems, (least, most) = [], self.task.plausible
        number = isinstance(fitness, int | float) and not isinstance(fitness, bool) and np.isfinite(fitness)
        if not number or not least <= fitness <= most:
            ends = f", {most:g} at most" if np.isfinite(most) else ""
            problems.append(f"{REPLY}: fitness is {fitness!r}; expected the {_fitness(self.task)}{ends}")
        log: Log | None = None
        if (place / RECORDED).exists() or outcome != "crashed":
            log, wrong = self._log(place / RECORDED, outcome)
            # a crash counts whatever state its recording is in
            problems += [] if outcome == "crashed" else wrong
        return (None, problems) if problems else (Trial(log, float(fitness), outcome), [])

    def _log(self, path: Path, outcome: str) -> tuple[Log | None, list[str]]:
        try:
            log = read_log(path, check=False)
        except LogError as error:
            return None, [str(error)]
        found = validate_log(log, joints=self.space.joints)
        # a robot that falls at once leaves a short log, and that of one that does not is judged by its seconds
        problems = [f"{RECORDED}: {p.where}: {p.message}" for p in errors_of(found) if p.code != "log.short"]
        problems += self._other_commands(path.with_name(COMMAND), log)
        missing = [j for j in self.space.joints if not log.has("position", j)]
        if missing:
            problems.append(f"{RECORDED}: no position of {', '.join(missing)}")
        if len(log) > 1 and outcome == "done":
            seconds = float(log.time[-1] - log.time[0])
            if seconds < SHORTEST * self.task.duration:
                problems.append(f"{RECORDED}: {seconds:.2f} s of a trial of {self.task.duration:g} s that did not fall")
        return (None, problems) if problems else (log, [])

    def _other_commands(self, asked: Path, played: Log) -> list[str]:
        """Joints whose recorded commands are not those that were asked for."""
        wanted = read_log(asked, check=False)
        wrong = []
        for joint in self.space.joints:
            if not played.has("command", joint) or len(played) < 2:
                continue
            time = np.clip(played.time - played.time[0], 0.0, wanted.time[-1] - wanted.time[0])
            own = command_at(wanted, (joint,), wanted.time[0] + time)[:, 0]
            difference = played.channels[f"command.{joint}"] - own
            if np.sqrt(np.nanmean(difference**2)) > APART + LATE * np.std(own):
                wrong.append(joint)
        return [f"{RECORDED}: its commands of {some(wrong)} are not those of {COMMAND}"] if wrong else []


def _fitness(task: Task) -> str:
    """What a task's fitness is, with its unit."""
    return task.goal + ("" if task.unit == "1" else f", {task.unit}")


def _stamps(*paths: Path) -> tuple[float, ...]:
    """When files were last changed; what a reply is recognised by."""
    return tuple(p.stat().st_mtime_ns if p.exists() else -1 for p in paths)
