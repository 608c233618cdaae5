"""A replay as a log: what the sensors would have shown."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from sysid_btr.errors import UsageError
from sysid_btr.identify.numerics import choose_numerics
from sysid_btr.io.log import COMMANDS, Log
from sysid_btr.io.split import split_episodes
from sysid_btr.models.log_checks import require_drives
from sysid_btr.simulation.numerics import MUJOCO, Numerics
from sysid_btr.simulation.registry import on_simulator
from sysid_btr.simulation.replay import Replay
from sysid_btr.terms.grammar import parse_parameters
from sysid_btr.terms.model import Model

if TYPE_CHECKING:
    from sysid_btr._typing import FloatArray
    from sysid_btr.identify.episode import Episode
    from sysid_btr.models.robot import Robot
    from sysid_btr.terms.base import Outputs


def replay_log(
    robot: Robot,
    log: Log,
    parameters: Mapping[str, float] | Model | None = None,
    *,
    numerics: Numerics | None = None,
    simulator: str | None = None,
    threads: int = 0,
) -> Log:
    """Give the log's commands to the model, and record its sensors at the log's own times.

    Parameters
    ----------
    robot : the model.
    log : commands, times and initial state; each episode starts anew.
    parameters : expression of the grammar -> value, for example ``{"mass:*Knee*": 1.1, "kp:*": 0.9}``; or
        a model.
    numerics : integrator and step; None chooses by a convergence check on the log.
    simulator : what moves the model, by name; None is that of `numerics`, or the built-in one.
    threads : worker threads, 0 for all cores.

    Returns
    -------
    Log
        The same commands; position, velocity and effort (SI) of every joint of the model as predicted, NaN
        where the replay diverged.

    Raises
    ------
    ModelError
        If a command drives nothing, or not what it says.
    UsageError
        A parameter that the model does not have, a value that is not finite, or an unknown simulator.
    """
    require_drives(robot, [log])
    model = parameters if isinstance(parameters, Model) else set_parameters(robot, parameters or {})
    episodes = split_episodes(log)
    if numerics is None:
        numerics, _ = choose_numerics(robot.for_log(log), episodes[0], threads, simulator or MUJOCO)
    chosen = on_simulator(numerics, simulator)
    parts: dict[str, list[FloatArray]] = {}
    for episode in episodes:
        run = Replay(robot.for_log(episode), episode, model.terms, chosen, effort=True, threads=threads)
        outputs = run.predict(model.values[None])
        for name, column in _sensors(run.index.joints, outputs).items():
            parts.setdefault(name, []).append(column)
    commands = {name: column for name, column in log.channels.items() if name.partition(".")[0] in COMMANDS}
    rows = [i for s in log.episodes() if s.stop - s.start > 1 for i in range(s.start, s.stop)]
    return replace(
        log,
        time=log.time[rows],
        channels={
            **{name: column[rows] for name, column in commands.items()},
            **{name: np.concatenate(columns) for name, columns in parts.items()},
        },
        episode=log.episode[rows],
        meta=replace(log.meta, source=f"replayed: {robot.name}, {chosen}", units={}),
        path=None,
        unknown={},
    )


def predicted_log(episodes: Sequence[Episode], model: Model, numerics: Numerics, *, threads: int = 0) -> Log:
    """What the sensors would have shown, as these episodes are compared with a model.

    Parameters
    ----------
    episodes : of one recording.
    model, numerics : terms with values; integrator and step.

    Returns
    -------
    Log
        On the episodes' own clocks; NaN where nothing is predicted.
    """
    parts = []
    for number, episode in enumerate(episodes):
        run = episode.replay(model.terms, numerics, effort=True, threads=threads)
        channels = _sensors(run.index.joints, run.predict(model.values[None]))
        own = replace(episode.log.meta, source=f"predicted: {episode.robot.name}", units={})
        parts.append(Log(episode.log.time, channels, own, np.full(len(episode.log), number)))
    return replace(
        parts[0],
        time=np.concatenate([part.time for part in parts]),
        channels={name: np.concatenate([part.channels[name] for part in parts]) for name in parts[0].channels},
        episode=np.concatenate([part.episode for part in parts]),
    )


def _sensors(joints: Sequence[str], outputs: Outputs) -> dict[str, FloatArray]:
    """Columns of a log, (n,) each, with what one candidate's sensors show."""
    parts = (("position", outputs.position), ("velocity", outputs.velocity), ("effort", outputs.effort))
    shown = [(channel, array[0].T) for channel, array in parts if array is not None]
    return {f"{c}.{joint}": column for c, columns in shown for joint, column in zip(joints, columns, strict=True)}


def set_parameters(robot: Robot, parameters: Mapping[str, float]) -> Model:
    """The model with parameters at given values.

    Raises
    ------
    UsageError
        Naming every expression that matches nothing, and every value that is not finite.
    """
    wrong = [f"{name}={value}" for name, value in parameters.items() if not np.isfinite(value)]
    if wrong:
        raise UsageError(f"values must be finite numbers, not {', '.join(wrong)}")
    parse_parameters(list(parameters), robot)  # all problems at once, places freed twice among them
    declared = [(term, value) for name, value in parameters.items() for term in parse_parameters([name], robot)]
    return Model.joined((term, [value] * len(term.parameters)) for term, value in declared)
