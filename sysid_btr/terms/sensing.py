"""What the sensors of a joint show: errors and delay of its encoder, offset and scale of its torque sensor."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from sysid_btr._typing import FloatArray, IntArray
from sysid_btr.interpolation import hermite
from sysid_btr.terms.base import BatchModel, Fields, Kind, Outputs, Scope
from sysid_btr.terms.effect import Effect, Probe
from sysid_btr.terms.scales import JointScale
from sysid_btr.terms.waves import nearby_waves


@dataclass(frozen=True)
class EncoderOffset(Effect):
    """An encoder whose zero is off, either the logged one alone or the one that closes the servo loop too.

    Sensor: the log shows q + b; the servo uses the true q.
    """

    name: ClassVar[str] = "encoder_offset"
    family: ClassVar[str] = "sensor"
    title: ClassVar[str] = "offset of the encoder"
    variant: ClassVar[str] = "log"
    signed: ClassVar[bool] = True
    kinds: ClassVar[tuple[Kind, ...]] = (Kind("offset", "rad", 0.0, -0.3, 0.3, 0.005),)
    confounders: ClassVar[tuple[tuple[str, str], ...]] = (
        ("constant_force", "motion whose stiffness to torque changes, or a logged effort"),
        ("com_offset", "several poses"),
    )

    @classmethod
    def sized(cls, scale: JointScale) -> tuple[Kind, ...]:
        reach = 0.3 if not scale.slide else 0.3 * scale.span
        return (Kind("offset", "rad", 0.0, -reach, reach, reach / 60),)

    def read_out(self, batch: BatchModel, values: FloatArray, outputs: Outputs) -> None:
        outputs.position[:, :, batch.index.of(self.places)] += values[:, None, :, 0]


@dataclass(frozen=True)
class EncoderOffsetInLoop(EncoderOffset):
    """The servo closes its loop on what the log shows, which is seen through gravity only.

    Command: less by b, as an error of q + b is one of the command by -b.
    """

    variant: ClassVar[str] = "loop"
    scope: ClassVar[Scope] = "servo"

    def shape_command(self, batch: BatchModel, values: FloatArray, command: FloatArray, time: FloatArray) -> FloatArray:
        shaped = command.copy()
        shaped[:, :, batch.index.of(self.places)] -= values[:, None, :, 0]
        return shaped


@dataclass(frozen=True)
class EncoderScale(Effect):
    """An encoder whose scale is off, either the logged one alone or the one that closes the servo loop too.

    Sensor: the log shows (1 + e) q; the servo uses the true q.
    """

    name: ClassVar[str] = "encoder_scale"
    family: ClassVar[str] = "sensor"
    title: ClassVar[str] = "error of the encoder's scale"
    variant: ClassVar[str] = "log"
    signed: ClassVar[bool] = True
    kinds: ClassVar[tuple[Kind, ...]] = (Kind("error", "1", 0.0, -0.3, 0.3, 0.01),)
    confounders: ClassVar[tuple[tuple[str, str], ...]] = (
        ("kp", "fast motion, where the servo lags"),
        ("joint_spring", "a logged effort"),
    )

    def read_out(self, batch: BatchModel, values: FloatArray, outputs: Outputs) -> None:
        columns = batch.index.of(self.places)
        outputs.position[:, :, columns] *= 1 + values[:, None, :, 0]
        outputs.velocity[:, :, columns] *= 1 + values[:, None, :, 0]


@dataclass(frozen=True)
class EncoderScaleInLoop(EncoderScale):
    """The servo closes its loop on what the log shows.

    Native: the second and third of `actuator_biasprm`.
    """

    variant: ClassVar[str] = "loop"
    scope: ClassVar[Scope] = "feedback"

    def model_fields(self, batch: BatchModel, values: FloatArray) -> Fields:
        bias = batch.read("actuator_biasprm")
        bias[:, batch.index.actuator[batch.index.of(self.places)], 1:3] *= 1 + values[:, :, :1]
        return {"actuator_biasprm": bias}


@dataclass(frozen=True)
class EncoderCyclicError(Effect):
    """An encoder whose error repeats with the angle: a magnet or a disc off its centre, a gear on its way.

    Sensor: the log shows q + a sin(n q) + b cos(n q); the servo uses the true q.
    """

    name: ClassVar[str] = "encoder_cyclic_error"
    family: ClassVar[str] = "sensor"
    title: ClassVar[str] = "error of the encoder that repeats with the angle"
    held: ClassVar[tuple[str, ...]] = ("number",)
    signed: ClassVar[bool] = True
    kinds: ClassVar[tuple[Kind, ...]] = (
        Kind("sine", "rad", 0.0, -0.3, 0.3, 0.005),
        Kind("cosine", "rad", 0.0, -0.3, 0.3, 0.005),
        Kind("number", "1/rad", 1.0, 0.5, 400.0, 0.05),
    )
    confounders: ClassVar[tuple[tuple[str, str], ...]] = (
        ("cogging", "a logged effort, or fast motion"),
        ("encoder_scale", "motion over a whole period"),
        ("encoder_offset", "motion over a whole period"),
    )

    @classmethod
    def sized(cls, scale: JointScale) -> tuple[Kind, ...]:
        reach = 0.3 if not scale.slide else 0.3 * scale.span
        turn = 2 * np.pi / max(scale.span, 1e-9)
        return (
            Kind("sine", "rad", 0.0, -reach, reach, reach / 60),
            Kind("cosine", "rad", 0.0, -reach, reach, reach / 60),
            Kind("number", "1/rad", 4 * turn, 0.5 * min(turn, 1.0), 200 * turn, 0.05 * turn),
        )

    @classmethod
    def probes(cls, scale: JointScale) -> tuple[Probe, ...]:
        return ()

    @classmethod
    def probe_at(cls, scale: JointScale, number: float) -> Probe:
        """A probe at a spatial frequency that the residual proposes."""
        size = cls.sized(scale)[0].scale
        return ((size, 0.0, number), (0.0, size, number))

    @classmethod
    def initial_guesses(cls, values: FloatArray) -> FloatArray:
        return nearby_waves(values)

    def read_out(self, batch: BatchModel, values: FloatArray, outputs: Outputs) -> None:
        columns = batch.index.of(self.places)
        sine, cosine, number = (values[:, None, :, k] for k in range(3))
        phase = number * outputs.position[:, :, columns]
        slope = number * (sine * np.cos(phase) - cosine * np.sin(phase))
        outputs.position[:, :, columns] += sine * np.sin(phase) + cosine * np.cos(phase)
        outputs.velocity[:, :, columns] *= 1 + slope


@dataclass(frozen=True)
class SensorDelay(Effect):
    """Delay between a joint's position and the log of it.

    Sensor: predicted positions and velocities are read earlier, by cubic interpolation; before the first one the joint
    moved as it does then.
    """

    name: ClassVar[str] = "sensor_delay"
    family: ClassVar[str] = "delay"
    title: ClassVar[str] = "delay of the sensor"
    kinds: ClassVar[tuple[Kind, ...]] = (Kind("time", "s", 0.0, 0.0, 0.15, 0.004),)
    needs: ClassVar[str] = "position, and a sensor or a coupled joint that is not delayed"
    yields_to: ClassVar[tuple[str, ...]] = ("command_delay",)
    everywhere: ClassVar[bool] = True
    confounders: ClassVar[tuple[tuple[str, str], ...]] = (
        ("command_delay", "a second sensor that is not delayed (current, effort, IMU)"),
    )

    @classmethod
    def probes(cls, scale: JointScale) -> tuple[Probe, ...]:
        return (((0.008,),), ((0.025,),))

    def read_out(self, batch: BatchModel, values: FloatArray, outputs: Outputs) -> None:
        time = outputs.time
        for place, column in enumerate(batch.index.of(self.places)):
            delay = values[:, place, 0]
            if not delay.any():
                continue
            early = time[None, :] - delay[:, None]
            unseen, early = np.minimum(early - time[0], 0.0), np.maximum(early, time[0])
            after = np.clip(np.searchsorted(time, early, side="left"), 1, len(time) - 1)
            span = time[after] - time[after - 1]
            f = (early - time[after - 1]) / span
            p, v = outputs.position[:, :, column], outputs.velocity[:, :, column]

            def take(array: FloatArray, at: IntArray) -> FloatArray:
                return np.take_along_axis(array, at, axis=1)

            v0, v1 = take(v, after - 1), take(v, after)
            seen = hermite(f, span, take(p, after - 1), take(p, after), v0, v1)
            outputs.position[:, :, column] = seen + unseen * v0
            outputs.velocity[:, :, column] = v0 + f * (v1 - v0)


@dataclass(frozen=True)
class TorqueOffset(Effect):
    """A torque sensor whose zero is off: a strain gauge that drifted, a current sensor's bias.

    Sensor: the log shows tau + b; what moves the joint is tau.
    """

    name: ClassVar[str] = "torque_offset"
    family: ClassVar[str] = "sensor"
    title: ClassVar[str] = "offset of the torque sensor"
    signed: ClassVar[bool] = True
    kinds: ClassVar[tuple[Kind, ...]] = (Kind("offset", "Nm", 0.0, -10.0, 10.0, 0.05),)
    needs: ClassVar[str] = "effort"
    confounders: ClassVar[tuple[tuple[str, str], ...]] = (
        ("constant_force", "a logged position of a joint that its command moves, or the drive switched off"),
        ("com_offset", "several poses"),
    )

    @classmethod
    def sized(cls, scale: JointScale) -> tuple[Kind, ...]:
        peak = scale.counter_peak
        return (Kind("offset", "Nm", 0.0, -peak, peak, 0.1 * scale.torque_rms),)

    def read_out(self, batch: BatchModel, values: FloatArray, outputs: Outputs) -> None:
        if outputs.effort is not None:
            outputs.effort[:, :, batch.index.of(self.places)] += values[:, None, :, 0]


@dataclass(frozen=True)
class TorqueScale(Effect):
    """A torque sensor whose scale is off: another torque constant, or an efficiency, than the log was written with.

    Sensor: the log shows (1 + e) tau; what moves the joint is tau.
    """

    name: ClassVar[str] = "torque_scale"
    family: ClassVar[str] = "sensor"
    title: ClassVar[str] = "error of the torque sensor's scale"
    signed: ClassVar[bool] = True
    kinds: ClassVar[tuple[Kind, ...]] = (Kind("error", "1", 0.0, -0.5, 1.0, 0.02),)
    needs: ClassVar[str] = "effort"
    confounders: ClassVar[tuple[tuple[str, str], ...]] = (
        ("mass", "a weight that is known"),
        ("torque_constant", "a logged position of a joint that its command moves"),
    )

    def read_out(self, batch: BatchModel, values: FloatArray, outputs: Outputs) -> None:
        if outputs.effort is not None:
            outputs.effort[:, :, batch.index.of(self.places)] *= 1 + values[:, None, :, 0]
