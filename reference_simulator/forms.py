"""Effects of families that every library knows, in forms that no library has exactly.

On a robot nothing has exactly the form that a textbook gives it. Each of these says which `family` it belongs to and
how large it is in physical terms (`size`), which is what a diagnosis can be asked for.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from reference_simulator.effects import Effect, joint_array, joint_signal, transmit
from reference_simulator.robot import build_pinocchio

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from reference_simulator.effects import Vector
    from reference_simulator.plant import Assembly, State

    Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class Form(Effect):
    """Base: an effect of a known family in a form of its own."""

    in_library = False
    family: ClassVar[str]
    unit: ClassVar[str]

    @property
    def size(self) -> float:
        """How large it is, in `unit`."""
        raise NotImplementedError

    def truth(self) -> dict[str, Any]:
        return super().truth() | {"family": self.family, "size": self.size, "unit": self.unit}


# ---- friction -------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class AsymmetricFriction(Form):
    """Dry friction of another level in each direction: `forward`, `backward` (N m).

    The same as their mean and a constant torque of half their difference, sticking included.
    """

    forward: float = 0.3
    backward: float = 0.1
    name = "asymmetric_friction"
    family = "friction"
    unit = "Nm"

    @property
    def size(self) -> float:
        return 0.5 * (self.forward + self.backward)

    def attach(self, assembly: Assembly) -> None:
        robot = assembly.robot
        mean = joint_array(assembly, self.where, self.size)
        bias = joint_array(assembly, self.where, 0.5 * (self.forward - self.backward))
        assembly.robot = replace(robot, frictionloss=robot.frictionloss + mean)

        def term(s: State) -> None:
            s.motor -= bias

        assembly.motor.append(term)


@dataclass(frozen=True, kw_only=True)
class StretchedStribeck(Form):
    """Dry friction F_c + (F_s - F_c) exp(-|v / v_s|^`exponent`), and `viscous` (N m s/rad) v beside it."""

    static: float = 0.4
    coulomb: float = 0.2
    velocity: float = 0.2
    exponent: float = 0.7
    viscous: float = 0.05
    name = "stretched_stribeck"
    family = "friction"
    unit = "Nm"

    @property
    def size(self) -> float:
        return self.static

    def attach(self, assembly: Assembly) -> None:
        level = joint_array(assembly, self.where, self.coulomb)
        peak = joint_array(assembly, self.where, self.static - self.coulomb)
        viscous = joint_array(assembly, self.where, self.viscous)

        def term(s: State) -> None:
            speed = np.abs(s.vm)
            s.friction += level + peak * np.exp(-((speed / self.velocity) ** self.exponent)) + viscous * speed

        assembly.friction.append(term)


@dataclass(frozen=True, kw_only=True)
class PreslidingFriction(Form):
    """Friction that first bends: LuGre's bristles (Canudas de Wit et al. 1995).

    z' = v - |v| z / (`yielding` (rad) g(v)), torque `coulomb` (N m) z / `yielding`, g(v) = 1 + (`stiction` - 1)
    exp(-(v / 0.1 rad/s)^2). With `stiction` 1 this is Dahl's model.
    """

    coulomb: float = 0.3
    yielding: float = 0.01
    stiction: float = 1.0
    name = "presliding_friction"
    family = "friction"
    unit = "Nm"

    @property
    def size(self) -> float:
        return self.coulomb

    def attach(self, assembly: Assembly) -> None:
        joints = assembly.robot.indices(self.where)

        def rate(s: State) -> Array:
            v = s.vm[joints]
            bound = self.yielding * (1.0 + (self.stiction - 1.0) * np.exp(-((v / 0.1) ** 2)))
            return np.asarray(v - np.abs(v) * s.aux[place] / bound)

        def term(s: State) -> None:
            s.motor[joints] -= self.coulomb * s.aux[place] / self.yielding

        place = assembly.add_state(np.zeros(joints.size), rate)
        assembly.motor.append(term)


@dataclass(frozen=True, kw_only=True)
class RootLoadFriction(Form):
    """Dry friction of `coefficient` (sqrt(N m)) times the root of the drive's torque."""

    coefficient: float = 0.2
    name = "root_load_friction"
    family = "friction"
    unit = "Nm at 1 Nm"

    @property
    def size(self) -> float:
        return self.coefficient

    def attach(self, assembly: Assembly) -> None:
        k = joint_array(assembly, self.where, self.coefficient)

        def term(s: State) -> None:
            s.friction += k * np.sqrt(np.abs(s.drive))

        assembly.friction.append(term)


@dataclass(frozen=True, kw_only=True)
class PowerDamping(Form):
    """Torque against the motion, `coefficient` (N m at 1 rad/s) |v|^`exponent`."""

    coefficient: float = 0.15
    exponent: float = 1.5
    name = "power_damping"
    family = "friction"
    unit = "Nm at 1 rad/s"

    @property
    def size(self) -> float:
        return self.coefficient

    def attach(self, assembly: Assembly) -> None:
        c = joint_array(assembly, self.where, self.coefficient)

        def term(s: State) -> None:
            s.motor -= c * np.sign(s.vm) * np.abs(s.vm) ** self.exponent

        assembly.motor.append(term)


@dataclass(frozen=True, kw_only=True)
class CyclicFriction(Form):
    """Dry friction that a bent shaft makes come and go: `torque` (N m) (1 + `depth` sin(`periods` q + `phase`))."""

    torque: float = 0.3
    depth: float = 0.7
    periods: float = 6.0
    phase: float = 0.0
    name = "cyclic_friction"
    family = "friction"
    unit = "Nm"

    @property
    def size(self) -> float:
        return self.torque

    def attach(self, assembly: Assembly) -> None:
        size = joint_array(assembly, self.where, self.torque)

        def term(s: State) -> None:
            s.friction += size * (1.0 + self.depth * np.sin(self.periods * s.qm + self.phase))

        assembly.friction.append(term)


# ---- time -----------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class SmoothedCommand(Form):
    """Commands pass two lags of `lag` (s) each before they act."""

    lag: float = 0.012
    name = "smoothed_command"
    family = "delay"
    unit = "s"

    @property
    def size(self) -> float:
        return 2.0 * self.lag

    def attach(self, assembly: Assembly) -> None:
        joints = assembly.robot.indices(self.where)
        start = np.zeros(1) if assembly.host is not None else assembly.command(np.zeros(1))[0, joints]
        told = np.zeros(joints.size)

        def term(s: State) -> None:
            told[:] = s.u[joints]
            s.u[joints] = s.aux[place][joints.size :]

        def rate(s: State) -> Array:
            first, second = np.split(s.aux[place], 2)
            return np.concatenate([told - first, first - second]) / self.lag

        place = assembly.add_state(np.tile(np.broadcast_to(start, joints.shape), 2), rate)
        assembly.inputs.append(term)


@dataclass(frozen=True, kw_only=True)
class JitteringDelay(Form):
    """Each command arrives late by a time of its own, evenly drawn from `least` to `most` (s), in order."""

    least: float = 0.005
    most: float = 0.05
    name = "jittering_delay"
    family = "delay"
    unit = "s"

    @property
    def size(self) -> float:
        return 0.5 * (self.least + self.most)

    def attach(self, assembly: Assembly) -> None:
        inner, joints = assembly.command, assembly.robot.indices(self.where)
        sent = np.asarray(sorted(b for b in assembly.breaks if 0.0 <= b <= assembly.duration))
        arrival = np.maximum.accumulate(sent + assembly.rng.uniform(self.least, self.most, sent.size))

        def late(t: Array) -> Array:
            out = inner(t)
            newest = np.maximum(np.searchsorted(arrival, t, side="right") - 1, 0)
            out[:, joints] = inner(sent[newest] + 1e-7)[:, joints]
            return out

        assembly.command = late
        assembly.breaks.extend(float(t) for t in arrival)


@dataclass(frozen=True, kw_only=True)
class RareCommands(Form):
    """The servo looks for a new command only every `period` (s), first at `phase` of it."""

    period: float = 0.04
    phase: float = 0.3
    name = "rare_commands"
    family = "delay"
    unit = "s"

    @property
    def size(self) -> float:
        return 0.5 * self.period

    def attach(self, assembly: Assembly) -> None:
        inner, joints = assembly.command, assembly.robot.indices(self.where)

        def looked(t: Array) -> Array:
            out = inner(t)
            at = (np.floor((t - 1e-9) / self.period - self.phase) + self.phase) * self.period
            out[:, joints] = inner(np.maximum(at, 0.0) + 1e-7)[:, joints]
            return out

        assembly.command = looked
        assembly.breaks.extend(np.arange(self.phase * self.period, assembly.duration, self.period).tolist())


# ---- power ----------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class StiffnessRamp(Form):
    """From `start` (s) a weak supply takes `depth` (-) of kp within `duration` (s); the damping stays."""

    depth: float = 0.3
    start: float = 2.0
    duration: float = 4.0
    name = "stiffness_ramp"
    acts_on = "robot"
    family = "supply"
    unit = "-"

    @property
    def size(self) -> float:
        return self.depth

    def attach(self, assembly: Assembly) -> None:
        def factor(t: Array) -> Array:
            return np.asarray(1.0 - self.depth * np.clip((t - self.start) / self.duration, 0.0, 1.0))

        assembly.stiffening.append(joint_signal(assembly, (), factor, 1.0))
        assembly.breaks.extend([self.start, self.start + self.duration])


@dataclass(frozen=True, kw_only=True)
class StiffnessSag(Form):
    """Under load the supply weakens kp alone.

    By `per_torque` (1/(N m)) of the sum of all servos' |torque|, which passes a lag of `lag` (s).
    """

    per_torque: float = 0.02
    lag: float = 0.05
    name = "stiffness_sag"
    acts_on = "robot"
    family = "supply"
    unit = "1/Nm"

    @property
    def size(self) -> float:
        return self.per_torque

    def attach(self, assembly: Assembly) -> None:
        kp = assembly.robot.kp

        def loading(s: State) -> Array:
            return np.array([(np.abs(s.drive).sum() - s.aux[place][0]) / self.lag])

        def term(s: State) -> None:
            s.drive -= min(self.per_torque * float(s.aux[place][0]), 0.8) * kp * (s.u - s.qm)

        place = assembly.add_state(np.zeros(1), loading)
        assembly.drive.append(term)


@dataclass(frozen=True, kw_only=True)
class PowerRamp(Form):
    """From `start` (s) a weak supply takes `depth` (-) of every drive's torque within `duration` (s)."""

    depth: float = 0.3
    start: float = 2.0
    duration: float = 4.0
    name = "power_ramp"
    acts_on = "robot"
    family = "supply"
    unit = "-"

    @property
    def size(self) -> float:
        return self.depth

    def attach(self, assembly: Assembly) -> None:
        def factor(t: Array) -> Array:
            return np.asarray(1.0 - self.depth * np.clip((t - self.start) / self.duration, 0.0, 1.0))

        assembly.gain.append(joint_signal(assembly, (), factor, 1.0))
        assembly.breaks.extend([self.start, self.start + self.duration])


@dataclass(frozen=True, kw_only=True)
class SoftTorqueLimit(Form):
    """The drive's torque saturates gently: `limit` (N m) tanh(torque / `limit`)."""

    limit: float = 2.0
    name = "soft_torque_limit"
    family = "saturation"
    unit = "Nm"

    @property
    def size(self) -> float:
        return self.limit

    def attach(self, assembly: Assembly) -> None:
        joints = assembly.robot.indices(self.where)

        def term(s: State) -> None:
            s.drive[joints] = self.limit * np.tanh(s.drive[joints] / self.limit)

        assembly.limits.append(term)


# ---- transmission ---------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class SmoothBacklash(Form):
    """Play without edges: teeth that meet gently, `stiffness` (N m/rad) (x - h tanh(x / h)), h = `play` / 2 (rad)."""

    play: float = 0.03
    stiffness: float = 300.0
    damping: float = 0.02
    name = "smooth_backlash"
    family = "backlash"
    unit = "rad"

    @property
    def size(self) -> float:
        return self.play

    def attach(self, assembly: Assembly) -> None:
        transmit(assembly, self.where, 0.5 * self.play, self.stiffness, self.damping, 2.0, 0.5, smooth=True)


@dataclass(frozen=True, kw_only=True)
class GreasedBacklash(Form):
    """Play `play` (rad) full of grease, `damping` (N m s/rad) in it, so that the way back differs from the way out."""

    play: float = 0.03
    stiffness: float = 200.0
    damping: float = 0.3
    name = "greased_backlash"
    family = "backlash"
    unit = "rad"

    @property
    def size(self) -> float:
        return self.play

    def attach(self, assembly: Assembly) -> None:
        transmit(assembly, self.where, 0.5 * self.play, self.stiffness, self.damping, 0.0, 1.0)


# ---- sensors --------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class EccentricEncoder(Form):
    """The logged position is q + `amplitude` (rad) sin(`periods` q + `phase`): the disc's centre is off the shaft's."""

    amplitude: float = 0.02
    periods: float = 4.0
    phase: float = 0.0
    name = "eccentric_encoder"
    family = "sensor"
    unit = "rad"

    @property
    def size(self) -> float:
        return self.amplitude

    def attach(self, assembly: Assembly) -> None:
        amplitude = joint_array(assembly, self.where, self.amplitude)

        def read(t: Array, q: Array, v: Array) -> None:
            angle = self.periods * q + self.phase
            v *= 1.0 + amplitude * self.periods * np.cos(angle)
            q += amplitude * np.sin(angle)

        assembly.sensors.append(read)


@dataclass(frozen=True, kw_only=True)
class EncoderDrift(Form):
    """The logged position wanders off by `drift` (rad), as exp(-t / `time_constant` (s)) fades."""

    drift: float = 0.04
    time_constant: float = 6.0
    name = "encoder_drift"
    family = "sensor"
    unit = "rad"

    @property
    def size(self) -> float:
        return abs(self.drift)

    def attach(self, assembly: Assembly) -> None:
        drift = joint_array(assembly, self.where, self.drift)

        def read(t: Array, q: Array, v: Array) -> None:
            q += drift * (1.0 - np.exp(-t / self.time_constant))[:, None]

        assembly.sensors.append(read)


@dataclass(frozen=True, kw_only=True)
class EncoderFilter(Form):
    """The logged position has passed a lag of `lag` (s)."""

    lag: float = 0.02
    name = "encoder_filter"
    family = "sensor"
    unit = "s"

    @property
    def size(self) -> float:
        return self.lag

    def attach(self, assembly: Assembly) -> None:
        from scipy.signal import lfilter

        joints = assembly.robot.indices(self.where)

        def read(t: Array, q: Array, v: Array) -> None:
            keep = float(np.exp(-(t[1] - t[0]) / self.lag))
            for values in (q, v):
                own = values[:, joints]
                values[:, joints] = lfilter([1.0 - keep], [1.0, -keep], own, axis=0, zi=keep * own[:1])[0]

        assembly.sensors.append(read)


# ---- springs, loads, disturbances -----------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class CubicSpring(Form):
    """Torque -`stiffness` (N m/rad^3) (q - `rest`)^3 on the link."""

    stiffness: float = 1.5
    rest: float = 0.0
    name = "cubic_spring"
    family = "spring"
    unit = "Nm/rad^3"

    @property
    def size(self) -> float:
        return self.stiffness

    def attach(self, assembly: Assembly) -> None:
        k = joint_array(assembly, self.where, self.stiffness)

        def term(s: State) -> None:
            s.link -= k * (s.q - self.rest) ** 3

        assembly.link.append(term)


@dataclass(frozen=True, kw_only=True)
class OneSidedSpring(Form):
    """A cable or stop that pulls back only beyond `onset` (rad): `stiffness` (N m/rad) times the excess.

    With `side` -1 below `onset` instead.
    """

    stiffness: float = 3.0
    onset: float = 0.2
    side: float = 1.0
    name = "one_sided_spring"
    family = "spring"
    unit = "Nm/rad"

    @property
    def size(self) -> float:
        return self.stiffness

    def attach(self, assembly: Assembly) -> None:
        k = joint_array(assembly, self.where, self.stiffness)

        def term(s: State) -> None:
            s.link -= k * self.side * np.maximum(self.side * (s.q - self.onset), 0.0)

        assembly.link.append(term)


@dataclass(frozen=True, kw_only=True)
class ElasticBand(Form):
    """A band from the point `offset` (m, body frame) of a body to the fixed point `anchor` (m, world).

    It pulls with `stiffness` (N/m) times what it is longer than `length` (m).
    """

    stiffness: float = 20.0
    offset: Vector = (0.0, 0.0, 0.0)
    anchor: Vector = (0.0, 0.0, 0.0)
    length: float = 0.1
    name = "elastic_band"
    acts_on = "body"
    family = "spring"
    unit = "N/m"

    @property
    def size(self) -> float:
        return self.stiffness

    def attach(self, assembly: Assembly) -> None:
        import pinocchio as pin

        model = build_pinocchio(assembly.robot)
        data, body = model.createData(), assembly.robot.body(self.where[0])
        joint, offset, anchor = body.joints[-1] + 1, np.asarray(self.offset), np.asarray(self.anchor)

        def term(s: State) -> None:
            jacobian = pin.computeJointJacobian(model, data, s.q, joint)
            pin.forwardKinematics(model, data, s.q)
            placement = data.oMi[joint]
            away = anchor - placement.act(offset)
            far = float(np.linalg.norm(away))
            if far > self.length:
                force = placement.rotation.T @ away * (self.stiffness * (far - self.length) / far)
                s.link += jacobian[:3].T @ force + jacobian[3:].T @ np.cross(offset, force)

        assembly.link.append(term)


@dataclass(frozen=True, kw_only=True)
class SolidLoad(Form):
    """A solid ball of `mass` (kg) and `radius` (m), welded to a body with its centre at `offset` (m, body frame)."""

    mass: float = 0.2
    radius: float = 0.06
    offset: Vector = (0.0, 0.0, 0.0)
    name = "solid_load"
    acts_on = "body"
    family = "payload"
    unit = "kg"

    @property
    def size(self) -> float:
        return self.mass

    def attach(self, assembly: Assembly) -> None:
        robot, own = assembly.robot, 0.4 * self.mass * self.radius**2 * np.eye(3)
        loaded = {n: robot.body(n).with_point_mass(self.mass, np.asarray(self.offset)) for n in self.where}
        assembly.robot = robot.with_bodies({n: replace(b, inertia=b.inertia + own) for n, b in loaded.items()})


@dataclass(frozen=True, kw_only=True)
class SineTorque(Form):
    """A torque on the link that swings: `amplitude` (N m) sin(2 pi `frequency` (Hz) t + `phase`)."""

    amplitude: float = 0.6
    frequency: float = 3.7
    phase: float = 0.0
    name = "sine_torque"
    family = "disturbance"
    unit = "Nm"

    @property
    def size(self) -> float:
        return self.amplitude

    def attach(self, assembly: Assembly) -> None:
        def wave(t: Array) -> Array:
            return np.asarray(self.amplitude * np.sin(2.0 * np.pi * self.frequency * t + self.phase))

        assembly.torque.append(joint_signal(assembly, self.where, wave, 0.0))


@dataclass(frozen=True, kw_only=True)
class RingingTorque(Form):
    """Blows that ring, the first at `start` (s), then every `every` (s).

    Torque `amplitude` (N m) exp(-t / `decay` (s)) sin(2 pi `frequency` (Hz) t).
    """

    amplitude: float = 1.0
    frequency: float = 3.0
    decay: float = 0.4
    start: float = 1.5
    every: float = 3.0
    name = "ringing_torque"
    family = "disturbance"
    unit = "Nm"

    @property
    def size(self) -> float:
        return abs(self.amplitude)

    def attach(self, assembly: Assembly) -> None:
        def ring(t: Array) -> Array:
            since = np.where(t > self.start, (t - self.start) % self.every, 0.0)
            return np.asarray(self.amplitude * np.exp(-since / self.decay) * np.sin(2 * np.pi * self.frequency * since))

        assembly.torque.append(joint_signal(assembly, self.where, ring, 0.0))


FORMS: dict[str, type[Form]] = {
    form.name: form
    for form in (
        AsymmetricFriction,
        StretchedStribeck,
        PreslidingFriction,
        RootLoadFriction,
        PowerDamping,
        CyclicFriction,
        SmoothedCommand,
        JitteringDelay,
        RareCommands,
        StiffnessRamp,
        StiffnessSag,
        PowerRamp,
        SoftTorqueLimit,
        SmoothBacklash,
        GreasedBacklash,
        EccentricEncoder,
        EncoderDrift,
        EncoderFilter,
        CubicSpring,
        OneSidedSpring,
        ElasticBand,
        SolidLoad,
        SineTorque,
        RingingTorque,
    )
}
