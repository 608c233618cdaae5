"""Every trial on the robot, kept: a log (Parquet) and what came of it (JSON) each."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from sysid_btr._typing import FloatArray
from sysid_btr.btr.controllers import Controller
from sysid_btr.btr.foresight import Foreseen
from sysid_btr.btr.robot import OUTCOMES, Robot, Trial
from sysid_btr.errors import UsageError
from sysid_btr.io.parquet import read_log, write_log
from sysid_btr.reading import parse_json
from sysid_btr.result import clean
from sysid_btr.run_folder import Folder

SCHEMA = "sysid_btr.trial/1"


@dataclass(frozen=True, eq=False)
class Tried:
    """A controller that was tried, and what it did.

    Attributes
    ----------
    iteration : in which.
    controller : as it was played.
    expected : its fitness in the model that chose it.
    trial : on the robot.
    foreseen : of it, before; None where one model chose.
    """

    iteration: int
    controller: Controller
    expected: float
    trial: Trial
    foreseen: Foreseen | None = None


@dataclass(eq=False)
class TrialBook:
    """Trials in the order in which they were made; those on disk are not made again.

    Attributes
    ----------
    folder : where they are kept; None keeps them in memory.
    made : all so far.
    """

    folder: Path | None = None
    made: list[Tried] = field(default_factory=list)

    @property
    def known(self) -> set[bytes]:
        """Controllers that were tried."""
        return {t.controller.values.tobytes() for t in self.made}

    @property
    def best(self) -> Tried | None:
        """The fittest of those that stood, of all only where none did; of equals the first."""
        return max(self.made, key=lambda t: (t.trial.outcome == "done", t.trial.fitness), default=None)

    def of(self, iteration: int) -> list[Tried]:
        """The trials of one iteration."""
        return [t for t in self.made if t.iteration == iteration]

    def add(
        self, robot: Robot, iteration: int, values: FloatArray, expected: float, foreseen: Foreseen | None = None
    ) -> Tried:
        """Try a controller, or read what came of it when it was tried before this run was stopped.

        Raises
        ------
        UsageError
            If the trial on disk is damaged, or of another controller.
        """
        controller = Controller(values, f"{len(self.made) + 1:04d}")
        trial = self._read(controller)
        if trial is None:
            trial = robot.run(controller)
            self._write(controller, iteration, expected, trial)
        tried = Tried(iteration, controller, expected, trial, foreseen)
        self.made.append(tried)
        return tried

    def _paths(self, controller: Controller) -> tuple[Path, Path]:
        assert self.folder is not None
        stem = self.folder / f"trial_{controller.label}"
        return stem.with_suffix(".json"), stem.with_suffix(".parquet")

    def _read(self, controller: Controller) -> Trial | None:
        if self.folder is None:
            return None
        entry, path = self._paths(controller)
        if not entry.exists():
            return None
        try:
            content = parse_json(entry.read_text(encoding="utf-8"))
            values = np.array(content["controller"], dtype=np.float64)
            fitness, outcome, logged = float(content["fitness"]), content["outcome"], bool(content["logged"])
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise UsageError(f"{entry} cannot be read ({error!r}); restore it, or start over (--overwrite)") from None
        if values.tobytes() != controller.values.tobytes() or outcome not in OUTCOMES:
            raise UsageError(
                f"{entry} is of another controller than this run's: the seed, the settings or a library version "
                "differ from the run that wrote it. Resume with the same ones, or start over (--overwrite)"
            )
        return Trial(read_log(path, check=False) if logged else None, fitness, outcome)

    def _write(self, controller: Controller, iteration: int, expected: float, trial: Trial) -> None:
        if self.folder is None:
            return
        self.folder.mkdir(parents=True, exist_ok=True)
        entry, path = self._paths(controller)
        if trial.log is not None:
            write_log(trial.log, path, overwrite=True)
        content = {
            "schema": SCHEMA,
            "number": len(self.made) + 1,
            "iteration": iteration,
            "controller": controller.values.tolist(),
            "expected": expected,
            "fitness": trial.fitness,
            "outcome": trial.outcome,
            "logged": trial.log is not None,
        }
        # last, because its presence says that the trial is complete
        Folder(self.folder).write(entry.name, json.dumps(clean(content), indent=1) + "\n")
