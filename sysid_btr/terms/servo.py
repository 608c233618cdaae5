"""The drive's own law: gains, integral action, back-EMF, delay of commands."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, ClassVar, Self

import numpy as np

from sysid_btr._typing import FloatArray, IntArray
from sysid_btr.terms.base import BatchModel, Fields, Kind, Scope
from sysid_btr.terms.drives import joint_drives
from sysid_btr.terms.effect import COMMANDS, Effect, Probe
from sysid_btr.terms.law import Step
from sysid_btr.terms.scales import JointScale

if TYPE_CHECKING:
    import mujoco


def servos(batch: BatchModel, places: tuple[str, ...]) -> IntArray:
    """Actuators of some joints with a drive."""
    result: IntArray = batch.index.actuator[batch.index.of(places)]
    return result


@dataclass(frozen=True)
class Kp(Effect):
    """Proportional gain of a position servo, as a factor.

    Native: the first of `actuator_gainprm`, the second of `actuator_biasprm`.
    """

    name: ClassVar[str] = "kp"
    family: ClassVar[str] = "gain"
    title: ClassVar[str] = "a change of the servo's stiffness"
    signed: ClassVar[bool] = True
    everywhere: ClassVar[bool] = True
    confounders: ClassVar[tuple[tuple[str, str], ...]] = (
        ("torque_constant", "a logged effort or current"),
        ("joint_compliance", "a logged effort, or fast motion"),
    )
    scope: ClassVar[Scope] = "servo"
    kinds: ClassVar[tuple[Kind, ...]] = (Kind("scale", "1", 1.0, 0.2, 3.0, 0.05),)

    def model_fields(self, batch: BatchModel, values: FloatArray) -> Fields:
        ids = servos(batch, self.places)
        gain, bias = batch.read("actuator_gainprm"), batch.read("actuator_biasprm")
        gain[:, ids, 0] *= values[:, :, 0]
        bias[:, ids, 1] *= values[:, :, 0]
        return {"actuator_gainprm": gain, "actuator_biasprm": bias}


@dataclass(frozen=True)
class Kv(Effect):
    """Derivative gain of a position servo, or the gain of a velocity servo, as a factor.

    Native: the third of `actuator_biasprm`; of a velocity servo also the first of `actuator_gainprm`.
    """

    name: ClassVar[str] = "kv"
    title: ClassVar[str] = "a change of the servo's damping"
    usual: ClassVar[bool] = False
    signed: ClassVar[bool] = True
    confounders: ClassVar[tuple[tuple[str, str], ...]] = (
        ("viscous_damping", "a logged effort or current; the two are confounded in positions alone"),
    )
    scope: ClassVar[Scope] = "feedback"
    kinds: ClassVar[tuple[Kind, ...]] = (Kind("scale", "1", 1.0, 0.0, 5.0, 0.1),)

    def model_fields(self, batch: BatchModel, values: FloatArray) -> Fields:
        ids = servos(batch, self.places)
        gain, bias = batch.read("actuator_gainprm"), batch.read("actuator_biasprm")
        bias[:, ids, 2] *= values[:, :, 0]
        velocity = batch.index.driven_by("velocity")[batch.index.of(self.places)]
        if not velocity.any():
            return {"actuator_biasprm": bias}
        gain[:, ids[velocity], 0] *= values[:, velocity, 0]
        return {"actuator_gainprm": gain, "actuator_biasprm": bias}


@dataclass(frozen=True)
class TorqueConstant(Effect):
    """Torque that a servo makes, its gains and its limits alike, as a factor: motor constant over resistance.

    Native: `actuator_gainprm`, `actuator_biasprm` and `actuator_forcerange`.
    """

    name: ClassVar[str] = "torque_constant"
    title: ClassVar[str] = "a change of the servo's torque"
    usual: ClassVar[bool] = False
    signed: ClassVar[bool] = True
    confounders: ClassVar[tuple[tuple[str, str], ...]] = (
        ("kp", "motion in which the drive saturates"),
        ("mass", "motion of several loads"),
    )
    scope: ClassVar[Scope] = "drive"
    kinds: ClassVar[tuple[Kind, ...]] = (Kind("scale", "1", 1.0, 0.2, 3.0, 0.05),)

    def model_fields(self, batch: BatchModel, values: FloatArray) -> Fields:
        ids = servos(batch, self.places)
        gain, bias, limits = (batch.read(f"actuator_{name}") for name in ("gainprm", "biasprm", "forcerange"))
        gain[:, ids, 0] *= values[:, :, 0]
        bias[:, ids, :3] *= values[:, :, :1]
        limits[:, ids] *= values[:, :, :1]
        return {"actuator_gainprm": gain, "actuator_biasprm": bias, "actuator_forcerange": limits}


@dataclass(frozen=True)
class IntegralGain(Effect):
    """A servo with integral action: torque grows while the error lasts.

    Law: torque += ki * integral of (command - position).
    """

    name: ClassVar[str] = "integral_gain"
    family: ClassVar[str] = "servo law"
    title: ClassVar[str] = "integral action of the servo"
    scope: ClassVar = "servo"
    law_acts: ClassVar[tuple[str, ...]] = ("servo",)
    law_memory: ClassVar[int] = 1
    kinds: ClassVar[tuple[Kind, ...]] = (Kind("ki", "Nm/(rad s)", 0.0, 0.0, 200.0, 1.0),)
    everywhere: ClassVar[bool] = True
    confounders: ClassVar[tuple[tuple[str, str], ...]] = (("joint_spring", "long holds"), ("payload", "long holds"))

    @classmethod
    def sized(cls, scale: JointScale) -> tuple[Kind, ...]:
        size = scale.torque_rms / (0.02 * max(scale.span, 1e-9))
        return (Kind("ki", "Nm/(rad s)", 0.0, 0.0, 10 * size, 0.1 * size),)

    @staticmethod
    def law(step: Step, numbers: FloatArray, memory: FloatArray, places: IntArray) -> None:
        for p, j in enumerate(places):
            error = step.command[j] - step.qpos[j]
            # the integral at the middle of the step
            step.motor_torque[j] += numbers[p, 0] * (memory[p, 0] + 0.5 * step.timestep * error)
            memory[p, 0] += step.timestep * error


@dataclass(frozen=True)
class BackEmf(Effect):
    """Back-EMF: a torque against the motion that a motor makes while it is driven, and not while it is switched off.

    With its terminals held at a voltage u a motor gives k (u - k w) / R: damping by k^2 / R that is in no friction, and
    by which the largest torque of either sign moves too. A bridge that is off breaks the current, and the damping is
    gone.

    Law: torque - b v while the drive is on, of which the limits of the torque are those without it, less b v.
    """

    name: ClassVar[str] = "back_emf"
    family: ClassVar[str] = "friction"
    title: ClassVar[str] = "damping by back-EMF"
    scope: ClassVar = "drive"
    law_acts: ClassVar[tuple[str, ...]] = ("servo", "limit")
    kinds: ClassVar[tuple[Kind, ...]] = (Kind("b", "Nm s/rad", 0.0, 0.0, 10.0, 0.05),)
    needs: ClassVar[str] = "enabled"
    yields_to: ClassVar[tuple[str, ...]] = ("viscous_damping",)
    confounders: ClassVar[tuple[tuple[str, str], ...]] = (
        ("viscous_damping", "free motion with the drive switched off, or a logged effort"),
        ("kv", "motion in which the drive saturates"),
    )

    @classmethod
    def sized(cls, scale: JointScale) -> tuple[Kind, ...]:
        return (Kind("b", "Nm s/rad", 0.0, 0.0, 5 * scale.damping, 0.1 * scale.damping),)

    @staticmethod
    def law(step: Step, numbers: FloatArray, memory: FloatArray, places: IntArray) -> None:
        for p, j in enumerate(places):
            change = numbers[p, 0] * step.qvel[j] * step.enabled[j]
            step.motor_torque[j] -= change
            step.limit_low[j] -= change
            step.limit_high[j] -= change


@dataclass(frozen=True)
class ActuatorFilter(Effect):
    """A drive that follows its command through a first-order filter: T u' + u = command.

    Native: the first of `actuator_dynprm`, the time constant of the model's own filter.
    """

    name: ClassVar[str] = "actuator_filter"
    family: ClassVar[str] = "delay"
    field: ClassVar[str] = "filter_time"
    title: ClassVar[str] = "filter of the command"
    scope: ClassVar[Scope] = "drive"
    kinds: ClassVar[tuple[Kind, ...]] = (Kind("time", "s", 0.0, 0.0, 0.5, 0.005),)
    everywhere: ClassVar[bool] = True
    yields_to: ClassVar[tuple[str, ...]] = ("command_delay",)
    confounders: ClassVar[tuple[tuple[str, str], ...]] = (
        ("command_delay", "motion at several frequencies: a filter also weakens the fast ones"),
        ("viscous_damping", "motion at several frequencies"),
    )

    @classmethod
    def probes(cls, scale: JointScale) -> tuple[Probe, ...]:
        return (((0.01,),), ((0.04,),))

    @classmethod
    def own_value(cls, model: mujoco.MjModel, place: str) -> float:
        import mujoco

        filters = (int(mujoco.mjtDyn.mjDYN_FILTER), int(mujoco.mjtDyn.mjDYN_FILTEREXACT))
        actuator = next(drive.actuator for drive in joint_drives(model) if drive.joint == place)
        filtered = int(model.actuator_dyntype[actuator]) in filters
        return float(model.actuator_dynprm[actuator, 0]) if filtered else 0.0

    def model_fields(self, batch: BatchModel, values: FloatArray) -> Fields:
        ids, constant = servos(batch, self.places), batch.read("actuator_dynprm")
        constant[:, ids, 0] = np.maximum(self.changed(constant[:, ids, 0], values[:, :, 0]), 0.0)
        return {"actuator_dynprm": constant}


@dataclass(frozen=True)
class CommandDelay(Effect):
    """Delay between the logged command and the servo that obeys it.

    Command: shifted before the replay, exactly, by any fraction of a step.
    """

    name: ClassVar[str] = "command_delay"
    family: ClassVar[str] = "delay"
    also: ClassVar[tuple[str, ...]] = ("delay",)
    title: ClassVar[str] = "delay of the command"
    scope: ClassVar = "drive"
    kinds: ClassVar[tuple[Kind, ...]] = (Kind("time", "s", 0.0, 0.0, 0.15, 0.004),)
    everywhere: ClassVar[bool] = True
    confounders: ClassVar[tuple[tuple[str, str], ...]] = (
        ("sensor_delay", "a second sensor that is not delayed (current, effort, IMU)"),
        ("viscous_damping", "motion at several frequencies"),
    )

    @classmethod
    def probes(cls, scale: JointScale) -> tuple[Probe, ...]:
        return (((0.008,),), ((0.025,),))

    def shape_command(self, batch: BatchModel, values: FloatArray, command: FloatArray, time: FloatArray) -> FloatArray:
        return delay_command(command, batch.index.of(self.places), values[:, :, 0] / batch.timestep)


@dataclass(frozen=True)
class CommandDelaySampled(Effect):
    """A servo that takes its command only now and then, at equal intervals, and holds it between: late by half of one.

    Command: that of the last moment `start` + k `period` in each step; exact for commands that are held over steps.
    """

    name: ClassVar[str] = "command_delay"
    family: ClassVar[str] = "delay"
    variant: ClassVar[str] = "sampled"
    title: ClassVar[str] = "commands taken only at intervals"
    scope: ClassVar = "drive"
    includes: ClassVar[tuple[str, ...]] = ("command_delay",)
    held: ClassVar[tuple[str, ...]] = ("period", "start")
    kinds: ClassVar[tuple[Kind, ...]] = (
        Kind("period", "s", 0.0, 0.0, 0.2, 0.004),
        Kind("start", "s", 0.0, -0.2, 0.4, 0.004),
    )
    needs: ClassVar[str] = COMMANDS
    confounders: ClassVar[tuple[tuple[str, str], ...]] = (
        ("command_delay", "samples that come more often than the servo takes its commands"),
    )

    @classmethod
    def probes(cls, scale: JointScale) -> tuple[Probe, ...]:
        return ()

    @classmethod
    def probe_at(cls, scale: JointScale, period: float, start: float) -> Probe:
        """A probe at moments that the residual proposes."""
        return ((period, start),)

    @classmethod
    def is_threshold(cls) -> bool:
        return False  # though a scan takes its moments as they are proposed

    @classmethod
    def initial_guesses(cls, values: FloatArray) -> FloatArray:
        return values[None]

    def around(self, values: FloatArray) -> Self:
        """The same with times bounded near a guess (parameters,): elsewhere the moments are those of other commands."""
        reach = np.outer(values[:: len(self.kinds)], (0.02, 0.25)).ravel()
        near = (p.near(float(v), float(r)) for p, v, r in zip(self.parameters, values, reach, strict=True))
        return replace(self, known=tuple(near))

    def shape_command(self, batch: BatchModel, values: FloatArray, command: FloatArray, time: FloatArray) -> FloatArray:
        shaped = np.array(np.broadcast_to(command, (len(values), *command.shape[1:])))
        for place, column in enumerate(batch.index.of(self.places)):
            rows = np.flatnonzero(values[:, place, 0] > batch.timestep)
            period, start = values[rows, place, 0, None], values[rows, place, 1, None]
            borders = np.broadcast_to(time, (len(values), time.shape[1]))[rows]
            shaped[rows, :, column] = sampled(shaped[rows, :, column], borders, period, start)
        return shaped


def sampled(command: FloatArray, time: FloatArray, period: FloatArray | float, start: FloatArray | float) -> FloatArray:
    """What a servo makes of held commands (m, n) that takes one at `start` + k `period`: means over the steps, (m, n).

    `time` (m or 1, n + 1) is that of the borders of the steps. Before it has taken one it has the first.
    """
    begin, end = time[:, :-1], time[:, 1:]
    last = start + np.floor((end - start) / period) * period
    newest = np.clip((end - last) / (end - begin), 0.0, 1.0)

    def at(moment: FloatArray) -> FloatArray:
        step = np.floor((moment - begin[:, :1]) / (end - begin)[:, :1] + 1e-9).astype(np.int64)
        rows = np.broadcast_to(np.clip(step, 0, command.shape[1] - 1), command.shape)
        return np.asarray(np.take_along_axis(command, rows, axis=1))

    return np.asarray(newest * at(last) + (1 - newest) * at(last - period))


def delay_command(command: FloatArray, columns: IntArray, steps: FloatArray) -> FloatArray:
    """Shift held commands by a possibly fractional number of steps, (m, places); the past is the first one.

    Between whole steps the mean over the step is mixed, which is exact for a held command.
    """
    shifted = np.array(np.broadcast_to(command, (len(steps), *command.shape[1:])))
    time = np.arange(command.shape[1])
    for place, column in enumerate(columns):
        # most of many candidates delay nothing
        rows = np.flatnonzero(steps[:, place])
        if not len(rows):
            continue
        whole = np.floor(steps[rows, place]).astype(np.int64)
        part = (steps[rows, place] - whole)[:, None]
        late = np.maximum(time[None, :] - whole[:, None], 0)
        later = np.maximum(late - 1, 0)
        later[time[None, :] - whole[:, None] <= 0] = 0
        source = shifted[rows, :, column]
        near = np.take_along_axis(source, late, axis=1)
        far = np.take_along_axis(source, later, axis=1)
        shifted[rows, :, column] = (1 - part) * near + part * far
    return shifted
