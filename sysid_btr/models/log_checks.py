"""What is wrong with a log as recorded from one robot: its content, and what its commands drive."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import TYPE_CHECKING

from sysid_btr.errors import ModelError
from sysid_btr.io._text import some
from sysid_btr.io._tracking import distance, trackings
from sysid_btr.io.log import Log
from sysid_btr.io.problem import Problem, errors_of, explain, worst_first
from sysid_btr.io.validation import validate_log as _of_content
from sysid_btr.models.commands import FED_FORWARD, command_columns, commanded, driven_by_effort
from sysid_btr.models.pose import standing
from sysid_btr.models.robot import Robot, joint_names, joint_ranges
from sysid_btr.models.ties import broken_ties
from sysid_btr.terms.drives import Drive, crowded_joints, drive_kinds, joint_drives, own_controls

if TYPE_CHECKING:
    import mujoco

SERVO_OPTION = "--servo kp=..,kv=.. puts a position servo on every joint without one"
FOLLOWS = 0.1
"""Distance of position and command, of the command's motion, up to which the command was a position. Most servos of a
recorded Nao are within 0.06 to 0.09; the torques of the DFKI double pendulum come no nearer than 0.24, others 0.65."""


def check_log(robot: Robot, log: Log) -> tuple[Problem, ...]:
    """Problems of a log for one robot, worst first: the one list that all verbs have."""
    robot = robot.for_log(log)
    content = _of_content(
        log,
        joints=joint_names(robot),
        ranges=joint_ranges(robot),
        drives=drive_kinds(robot.model),
        controls=tuple(own_controls(robot.model)),
        at=standing(robot, log),
    )
    return worst_first((*content, *command_problems(robot, log), *tie_problems(robot, log)))


def validate_log(log: Log, robot: Robot | None = None) -> tuple[Problem, ...]:
    r"""Everything that is wrong with a log, where it is and what to do, as ``sysid-btr validate`` says it.

    >>> print(*sb.validate_log(log, sb.load_robot("leg.xml")), sep="\n")  # doctest: +SKIP

    Parameters
    ----------
    log : recording.
    robot : model to check it against: joints, ranges, and what the commands drive.

    Returns
    -------
    tuple of Problem
        Errors first; empty for a good log.
    """
    return _of_content(log) if robot is None else check_log(robot, log)


def require_drives(robot: Robot, logs: Iterable[Log]) -> None:
    """Refuse logs with commands that do not drive what they say.

    Raises
    ------
    ModelError
        With every such problem of every log.
    """
    found = {log: errors_of(command_problems(robot.for_log(log), log)) for log in logs}
    told = [explain(log.path or "the log", problems) for log, problems in found.items() if problems]
    if told:
        raise ModelError("\n".join(told))


def tie_problems(robot: Robot, log: Log) -> tuple[Problem, ...]:
    """Joints that the model ties together and that the log shows moving apart."""
    return tuple(
        Problem(
            "joint.tied",
            "warning",
            ", ".join(tie.joints),
            str(tie),
            "check the joints' names and signs; if they are right, the model's equality is wrong for this robot",
        )
        for tie in broken_ties(robot, [log])
    )


def command_problems(robot: Robot, log: Log) -> tuple[Problem, ...]:
    """Commands that drive nothing, or not what they say; and drives that nothing commands."""
    return log.once(("commands", robot.fingerprint), lambda: tuple(_command_problems(log, robot.model)))


def _command_problems(log: Log, model: mujoco.MjModel) -> Iterator[Problem]:
    drives, joints = joint_drives(model), _joints(model)
    yield from _undriven(log, model, drives, joints)
    twice = [", ".join(names) for names in (tuple(command_columns(log, d)) for d in drives) if len(names) > 1]
    if twice:
        yield Problem(
            "command.twice",
            "error",
            some(twice),
            "one actuator, two commands: that of its joint and its own",
            "leave one of the two columns out",
        )
    yield from _of_another_kind(log, model, drives)
    yield from _idle(log, model, drives)


def _joints(model: mujoco.MjModel) -> tuple[str, ...]:
    return tuple(model.joint(i).name for i in range(model.njnt))


def _undriven(log: Log, model: mujoco.MjModel, drives: Sequence[Drive], joints: Sequence[str]) -> Iterator[Problem]:
    crowded, controls = crowded_joints(model), own_controls(model)
    names = {d.joint for d in drives} | {d.name for d in drives} | set(controls)
    columns = [f"command.{n}" for n in log.joints("command") if n not in names and n in joints]
    columns += [f"{c}.{n}" for c in FED_FORWARD for n in log.joints(c) if n in joints and n not in names]
    for joint, actuators in crowded.items():
        listed = some([a or "one without a name" for a in actuators])
        own = [c for c in columns if c.partition(".")[2] == joint]
        columns = [c for c in columns if c not in own]
        if own:
            yield Problem(
                "command.crowded",
                "error",
                some(own),
                f"{len(actuators)} actuators drive this joint ({listed}), "
                "so a command of the joint is that of none of them",
                f"log {some([f'command.{a}' for a in actuators if a]) or 'each'}, MuJoCo's ctrl of each actuator; or "
                "leave one of them in the model",
            )
    acted = {c for c in columns if _has_actuator(model, c.partition(".")[2])}
    if acted:
        yield Problem(
            "command.no_meaning",
            "error",
            some(sorted(acted)),
            "the joint's actuator is neither a motor nor a servo of position or velocity (a muscle, an integrator, a "
            "gain that changes), so a command in units of the joint means nothing to it",
            "log command.<actuator>, MuJoCo's ctrl, under the actuator's own name",
        )
    columns = [c for c in columns if c not in acted]
    if columns:
        yield Problem(
            "command.undriven",
            "error",
            some(columns),
            f"the model has no actuator on {'these joints' if len(columns) > 1 else 'this joint'}: "
            "the command drives nothing",
            f"add an actuator to the model ({SERVO_OPTION}), or leave the column out; actuators of the model: "
            f"{some([model.actuator(a).name or '(without a name)' for a in range(model.nu)], 12) or 'none'}",
        )
    commands = log.joints("command")
    if commands and not any(name in names or name in joints for name in commands):
        yield Problem(
            "command.undriven",
            "error",
            some([f"command.{name}" for name in commands]),
            "the model has no joint and no actuator of these names: the commands drive nothing",
            f"give the model of this robot; or give the columns the names of joints ({some(joints, 12)}) or actuators, "
            "as `sysid-btr import --rename` does",
        )


def _has_actuator(model: mujoco.MjModel, joint: str) -> bool:
    import mujoco

    onto = (int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT))
    number = model.joint(joint).id
    return any(
        int(model.actuator_trntype[a]) in onto and int(model.actuator_trnid[a, 0]) == number for a in range(model.nu)
    )


def _of_another_kind(log: Log, model: mujoco.MjModel, drives: Sequence[Drive]) -> Iterator[Problem]:
    """Commands that are another thing than the model's drive takes, by the log's account or as they look."""
    commands = [d for d in drives if log.has("command", d.joint) and log.meta.command_space == "joint"]
    told = log.meta.drive
    if told in ("position", "velocity", "torque"):
        other = [d for d in commands if d.kind != told]
        if other:
            kinds = ", ".join(sorted({d.kind for d in other}))
            yield Problem(
                "command.kind",
                "error",
                some([f"command.{d.joint}" for d in other]),
                f'the log says that commands are a {told} (metadata "drive"), and to the model\'s actuators they are a '
                f"{kinds}",
                f"give a model with such actuators{f' ({SERVO_OPTION})' if told == 'position' else ''}, or correct the "
                'metadata; "mixed" leaves it to the actuators',
            )
        return
    motors = [d.joint for d in commands if d.kind == "torque"]
    pairs = trackings(commanded(log, model), motors)
    follow = [joint for joint, pair in pairs.items() if distance(pair) < FOLLOWS]
    if follow:
        yield Problem(
            "command.kind",
            "error",
            some([f"command.{joint}" for joint in follow]),
            "the position follows the command, so it was a position, and to the model's actuators it is a torque",
            f'{SERVO_OPTION}, motors among them; or set "drive": "torque" in the metadata if it is one',
        )


def _idle(log: Log, model: mujoco.MjModel, drives: Sequence[Drive]) -> Iterator[Problem]:
    given, stand_ins = commanded(log, model), driven_by_effort(log, model)
    if stand_ins and log.joints("command"):
        yield Problem(
            "command.effort",
            "note",
            some([f"effort.{joint}" for joint in sorted(stand_ins)]),
            "these joints have no command: the measured torque drives the model's motors in a replay",
            "nothing, if that is right",
        )
    idle = [d.name or d.joint for d in drives if not given.has("command", d.joint)]
    idle += [name for name in own_controls(model) if not given.has("command", name)]
    nameless = sum(1 for a in range(model.nu) if not model.actuator(a).name) - sum(not d.name for d in drives)
    if idle:
        yield Problem(
            "actuator.idle",
            "note",
            some(idle),
            "the log does not command these actuators: a position servo holds its joint where it starts, others keep "
            "the ctrl of the model's keyframe, or zero",
            "nothing, if that is right; else log command.<joint>, or command.<actuator> in ctrl",
        )
    if nameless > 0:
        yield Problem(
            "actuator.nameless",
            "note",
            "the model",
            f"{nameless} of its actuators drive no single joint and have no name, so no column can command them",
            "name them in the model",
        )
