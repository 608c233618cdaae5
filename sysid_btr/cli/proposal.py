"""The study file to begin with: what a log holds, and which parameters of the model may be identifiable."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from textwrap import wrap
from typing import TYPE_CHECKING

import numpy as np

from sysid_btr._typing import FloatArray
from sysid_btr.cli.fit import FitOptions
from sysid_btr.cli.options import Option, options_of
from sysid_btr.cli.study_file import toml
from sysid_btr.errors import ModelError, UsageError
from sysid_btr.io.log import CHANNELS, Log
from sysid_btr.io.noise import NoiseFloor, noise_floor
from sysid_btr.models.robot import Robot, joint_names, servo_drives
from sysid_btr.mujoco_conventions import FREE, slides
from sysid_btr.objectives.targets import COMPARED, FITTED
from sysid_btr.terms.grammar import parse_parameters
from sysid_btr.terms.model import Terms
from sysid_btr.units import si

if TYPE_CHECKING:
    import mujoco

OPTIONS = options_of(FitOptions)
MOVED = {"rad": 0.02, "m": 0.001}
"""Less motion than this is within friction's dead band and a few encoder steps."""
WIDTH = 34


@dataclass(frozen=True)
class JointSeen:
    """What a log shows of a joint.

    Attributes
    ----------
    name : of the joint.
    unit : ``rad`` or ``m``.
    moved, commanded : distance between the extremes of position and command; NaN where not logged.
    noise : of the position.
    """

    name: str
    unit: str
    moved: float
    commanded: float
    noise: NoiseFloor

    @property
    def moves(self) -> bool:
        """Whether it moved enough to be informative."""
        return bool(max(np.nan_to_num(self.moved), np.nan_to_num(self.commanded)) > MOVED[self.unit])


def study_file(robot: Robot, logs: Sequence[Log], model: str, out: Path | None = None) -> str:
    """A commented study file (TOML) that `fit` and `close` run as it is.

    Parameters
    ----------
    robot : the model.
    logs : recordings, from files.
    model : how the user called the model.
    out : where the file will be; paths in it are relative to its folder where that is near.

    Returns
    -------
    str
        The file's text.

    Raises
    ------
    ModelError
        If no joint of the model has a position in the logs.
    """
    compiled = robot.model
    seen = [_joints_seen(log, robot, compiled) for log in logs]
    if not any(seen):
        there = ", ".join(dict.fromkeys(j for log in logs for j in log.joints("position"))) or "none"
        raise ModelError(
            f"no joint of {robot.name} has a position in the log. Positions: {there}. Joints of the model: "
            f"{', '.join(joint_names(robot))}. Import the log again with --rename, or give its robot's model"
        )
    moving = [name for name in joint_names(robot) if any(s.moves for one in seen for s in one if s.name == name)]
    folder = None if out is None else out.parent
    lines = [
        f"# Study of {', '.join(map(_file, logs))} with the model {robot.name}, proposed by `sysid-btr init`.",
        f"#   sysid-btr fit   --config {_shown(out)}     # fits the parameters listed under `fit`",
        f"#   sysid-btr close --config {_shown(out)}     # the same, then names what the model is missing",
        "# Every line may be changed; a flag at the command line wins over its line here.",
        "# Files are looked for beside this file first.",
    ]
    for log, joints in zip(logs, seen, strict=True):
        lines += ["", *_what_the_log_holds(log, joints)]
    free = any(log.meta.mount == "free" for log in logs)
    lines += ["", *_settings(robot, logs, model, folder), "", *_parameters(robot, compiled, moving, free), ""]
    return "\n".join(lines)


# --- what the log holds --------------------------------------------------------------------------------------


def _joints_seen(log: Log, robot: Robot, model: mujoco.MjModel) -> list[JointSeen]:
    found = []
    for name in joint_names(robot):
        if not log.has("position", name):
            continue
        sliding = slides(model, name)
        position = log.channels[f"position.{name}"]
        command = log.channels.get(f"command.{name}")
        found.append(
            JointSeen(
                name,
                "m" if sliding else "rad",
                _spread(position),
                np.nan if command is None else _spread(command),
                noise_floor(position),
            )
        )
    return found


def _spread(values: FloatArray) -> float:
    finite = values[np.isfinite(values)]
    return float(np.ptp(finite)) if len(finite) else np.nan


def _what_the_log_holds(log: Log, joints: Sequence[JointSeen]) -> Iterator[str]:
    rows = log.episodes()
    seconds = sum(float(log.time[r.stop - 1] - log.time[r.start]) for r in rows)
    steps = np.concatenate([np.diff(log.time[r]) for r in rows])
    period = log.meta.sample_period or (float(np.median(steps)) if len(steps) else np.nan)
    parts = f"{len(rows)} episodes" if len(rows) > 1 else "1 episode"
    torso = "fixed" if log.meta.mount == "fixed" else "free to move"
    yield f"# --- {_file(log)}: {seconds:.4g} s in {parts}, {len(log)} samples every {si(period, 's')}; torso {torso}"
    yield f"# {'joint':{WIDTH}}{'moved by':>12}{'command':>12}{'noise':>14}"
    for joint in joints:
        command = "-" if np.isnan(joint.commanded) else si(joint.commanded, joint.unit)
        note = "" if joint.moves else "   hardly moved: this log says little about it"
        if joint.noise.method == "quantisation":
            note = f"   (encoder step {si(joint.noise.step, joint.unit)}){note}"
        yield (
            f"# {joint.name:{WIDTH}}{si(joint.moved, joint.unit):>12}{command:>12}"
            f"{si(joint.noise.sigma, joint.unit):>14}{note}"
        )
    for channel in CHANNELS:
        names = log.joints(channel)
        if names and channel != "position":
            yield f"# {channel}: {len(names)} logged; {_use(log, channel)}"
    if not log.joints("effort"):
        yield "# no effort is logged: measured torques would separate masses from gains"


def _use(log: Log, channel: str) -> str:
    if channel == "command":
        how = "zero-order hold" if log.meta.command_hold == "zoh" else "interpolated"
        return f"drives the replay, {how}"
    if channel in FITTED:
        floors = [noise_floor(log.channels[f"{channel}.{n}"]).sigma for n in log.joints(channel)]
        return f"fitted, because it is measured (noise {np.median(floors):.2g})"
    if channel in COMPARED:
        return "compared with the replay, and not fitted: it is usually the position's, filtered"
    return "used by the models and effects that need it"


# --- what to run -----------------------------------------------------------------------------------------------


def _settings(robot: Robot, logs: Sequence[Log], model: str, folder: Path | None) -> Iterator[str]:
    named = _near(Path(model), folder) if robot.path is not None else model
    paths = [_near(log.path, folder) for log in logs if log.path is not None]
    channels = [c for c in FITTED if any(log.has(c, j) for log in logs for j in joint_names(robot))]
    proposed = {"model": named, "log": paths, "channels": channels}
    for name in ("model", "log", "holdout", "channels", "seed", "estimator", "out"):
        option = OPTIONS[name]
        yield from _comment(option)
        value = proposed.get(name, option.default)
        yield f"# {name} = {toml(name)}" if value is None else f"{name} = {toml(value)}"


def _comment(option: Option) -> list[str]:
    return wrap(option.help, 116, initial_indent="# ", subsequent_indent="# ")


def _parameters(robot: Robot, model: mujoco.MjModel, moving: Sequence[str], free: bool) -> Iterator[str]:
    yield from _comment(OPTIONS["fit"])
    yield "# Masses and gains are factors of the model's own value; =shared is one common value. The result says which"
    yield "# parameters are not identifiable, and why."
    chosen = list(_from_table(robot)) or [*_masses(model, moving, free), *_gains(model, moving)]
    if not chosen:
        chosen = [("mass:*", "all masses: no joint moved enough to choose among them")]
    yield "fit = ["
    for expression, reason in chosen:
        yield f"    {toml(expression) + ',':{WIDTH}}  # {reason}"
    yield "]"
    yield "# Also possible, one line each in the list above:"
    for expression, reason in _others(moving):
        yield f"#     {toml(expression) + ',':{WIDTH - 2}}  # {reason}"
    yield ""
    yield from _comment(OPTIONS["bounds"])
    yield "[bounds]"
    terms = Terms(parse_parameters([expression for expression, _ in chosen], robot))
    shown = {}
    for parameter in terms.parameters:
        shown[parameter.name.partition(":")[0]] = (parameter.lower, parameter.upper)
    for field, (low, high) in shown.items():
        yield f"# {toml(field)} = [{low:g}, {high:g}]"


def _from_table(robot: Robot) -> Iterator[tuple[str, str]]:
    """What the robot's own table of bounds says is in question."""
    for key, (low, high) in robot.bounds.items():
        expression = key if ":" in key else f"{key}:*"
        try:
            parse_parameters([expression], robot)
        except UsageError:
            continue
        yield expression, f"the model's table bounds it by {low:g} and {high:g}"


def _masses(model: mujoco.MjModel, moving: Sequence[str], free: bool) -> Iterator[tuple[str, str]]:
    """Masses of the bodies that hang on a joint that moved; a fixed base says nothing of its own."""
    for b in range(1, model.nbody):
        first, count = int(model.body_jntadr[b]), int(model.body_jntnum[b])
        own = [model.joint(j) for j in range(first, first + count)] if count else []
        if model.body_mass[b] <= 0 or not own:
            continue
        name, kilograms = model.body(b).name, float(model.body_mass[b])
        if any(int(j.type[0]) == FREE for j in own):
            if free:
                yield f"mass:{name}", f"{kilograms:.3g} kg in the model; the free base"
            continue
        moved = [j.name for j in own if j.name in moving]
        if moved:
            yield f"mass:{name}", f"{kilograms:.3g} kg in the model; moved by {', '.join(moved)}"


def _gains(model: mujoco.MjModel, moving: Sequence[str]) -> Iterator[tuple[str, str]]:
    """Gains of the servos of joints that moved, as one factor each."""
    servos = {drive.joint: drive.actuator for drive in servo_drives(model)}
    for field, column, what in (("kp", 1, "stiffness of the servos"), ("kv", 2, "damping of the servos")):
        own = [n for n, a in servos.items() if n in moving and model.actuator_biasprm[a, column] != 0]
        if not own:
            continue
        glob = "*" if len(own) == len(servos) else ",".join(own)
        shared = "=shared" if len(own) > 1 else ""
        common = ", one factor for all" if shared else ""
        yield f"{field}:{glob}{shared}", f"{what}{common}"


def _others(moving: Sequence[str]) -> Iterator[tuple[str, str]]:
    glob = ",".join(moving[:2]) or "*"
    yield f"kp:{glob}", "each servo by itself"
    yield f"frictionloss:{glob}", "dry friction, Nm (N); `close` finds by itself whether it is missing"
    yield f"damping:{glob}", "viscous friction, Nm s/rad (N s/m)"
    yield f"armature:{glob}", "inertia of the rotor behind the gear, kg m2 (kg)"


# --- words ----------------------------------------------------------------------------------------------------


def _file(log: Log) -> str:
    return log.path.name if log.path else "a log"


def _shown(out: Path | None) -> str:
    return "FILE" if out is None else str(out)


def _near(path: Path, folder: Path | None) -> str:
    """A path relative to the study file's folder, if it is in or beside it; else as it is."""
    if folder is None:
        return str(path)
    relative = os.path.relpath(path.resolve(), folder.resolve())
    return relative if relative.count("..") <= 1 else str(path.resolve())
