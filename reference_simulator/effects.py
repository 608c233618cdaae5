"""What a robot does that its model does not say: effects that a recording can contain, from first principles.

Each effect is a frozen dataclass: `where` names joints or bodies (empty: all of them), the other fields are
its size in SI units. `attach` writes it into an `Assembly`. The names in the library of sysid_btr are used
where there is one; `in_library` is False for those that no library lists, made for negative tests.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from fnmatch import fnmatchcase
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from reference_simulator.plant import Assembly, State, TimeSignal, Transmission

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from reference_simulator.robot import Robot

    Array = NDArray[np.float64]
    Vector = tuple[float, float, float]


@dataclass(frozen=True, kw_only=True)
class Effect:
    """Base of all effects.

    Friction, viscous terms, armature, limits and the servo act on the motor's side.
    """

    where: tuple[str, ...] = ()
    name: ClassVar[str]
    acts_on: ClassVar[str] = "joint"
    in_library: ClassVar[bool] = True

    def attach(self, assembly: Assembly) -> None:
        """Write the effect into `assembly`."""
        raise NotImplementedError

    def resolved(self, robot: Robot) -> Effect:
        """The same effect with the patterns in `where` replaced by names of `robot`.

        Raises ValueError for no match.
        """
        if self.acts_on == "robot":
            return self
        names = robot.joints if self.acts_on == "joint" else tuple(b.name for b in robot.bodies)
        found = tuple(dict.fromkeys(n for p in self.where or ("*",) for n in names if fnmatchcase(n, p)))
        for pattern in self.where:
            if not any(fnmatchcase(n, pattern) for n in names):
                raise ValueError(f"{self.name}: no {self.acts_on} matches {pattern!r}; there are {', '.join(names)}")
        return replace(self, where=found)

    def truth(self) -> dict[str, Any]:
        """Name, place and parameters, as written beside a recording."""
        values = {f.name: getattr(self, f.name) for f in fields(self) if f.name != "where"}
        parameters = {k: list(v) if isinstance(v, tuple) else v for k, v in values.items()}
        place = {"effect": self.name, "in_library": self.in_library, "where": list(self.where)}
        return place | {"parameters": parameters}


def joint_array(assembly: Assembly, where: tuple[str, ...], value: float, elsewhere: float = 0.0) -> Array:
    """A joint array that is `value` at `where` and `elsewhere` otherwise."""
    out = np.full(assembly.robot.n, elsewhere)
    out[assembly.robot.indices(where)] = value
    return out


def joint_signal(assembly: Assembly, where: tuple[str, ...], f: TimeSignal, elsewhere: float) -> TimeSignal:
    """A scalar function of time as a (k, n) signal on the joints `where`."""
    joints, n = assembly.robot.indices(where), assembly.robot.n

    def signal(t: Array) -> Array:
        out = np.full((t.size, n), elsewhere)
        out[:, joints] = f(t)[:, None]
        return out

    return signal


# ---- friction and damping -------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class CoulombFriction(Effect):
    """Constant friction `torque` (N m) against motion, and sticking up to it."""

    torque: float = 0.3
    name = "coulomb_friction"

    def attach(self, assembly: Assembly) -> None:
        robot = assembly.robot
        loss = robot.frictionloss + joint_array(assembly, self.where, self.torque)
        assembly.robot = replace(robot, frictionloss=loss)


@dataclass(frozen=True, kw_only=True)
class ViscousDamping(Effect):
    """Further torque -`coefficient` (N m s/rad) times velocity."""

    coefficient: float = 0.2
    name = "viscous_damping"

    def attach(self, assembly: Assembly) -> None:
        robot = assembly.robot
        assembly.robot = replace(robot, damping=robot.damping + joint_array(assembly, self.where, self.coefficient))


@dataclass(frozen=True, kw_only=True)
class QuadraticDamping(Effect):
    """Torque -`coefficient` (N m s^2/rad^2) v |v|."""

    coefficient: float = 0.05
    name = "quadratic_damping"

    def attach(self, assembly: Assembly) -> None:
        c = joint_array(assembly, self.where, self.coefficient)

        def term(s: State) -> None:
            s.motor -= c * s.vm * np.abs(s.vm)

        assembly.motor.append(term)


@dataclass(frozen=True, kw_only=True)
class StribeckFriction(Effect):
    """Dry friction falling from `static` to `coulomb` (N m) over `velocity` (rad/s).

    F_c + (F_s - F_c) exp(-(v/v_s)^2).
    """

    static: float = 0.4
    coulomb: float = 0.2
    velocity: float = 0.3
    name = "stribeck_friction"

    def attach(self, assembly: Assembly) -> None:
        level = joint_array(assembly, self.where, self.coulomb)
        peak = joint_array(assembly, self.where, self.static - self.coulomb)

        def term(s: State) -> None:
            s.friction += level + peak * np.exp(-((s.vm / self.velocity) ** 2))

        assembly.friction.append(term)


@dataclass(frozen=True, kw_only=True)
class LoadFriction(Effect):
    """Dry friction of `coefficient` (-) times the magnitude of the servo's torque.

    Losses of a loaded gearbox.
    """

    coefficient: float = 0.15
    name = "load_friction"

    def attach(self, assembly: Assembly) -> None:
        k = joint_array(assembly, self.where, self.coefficient)

        def term(s: State) -> None:
            s.friction += k * np.abs(s.drive)

        assembly.friction.append(term)


@dataclass(frozen=True, kw_only=True)
class Armature(Effect):
    """Further rotor inertia `inertia` (kg m^2), seen at the joint."""

    inertia: float = 0.006
    name = "armature"

    def attach(self, assembly: Assembly) -> None:
        robot = assembly.robot
        assembly.robot = replace(robot, armature=robot.armature + joint_array(assembly, self.where, self.inertia))


# ---- time -----------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class CommandDelay(Effect):
    """Commands reach the servo `delay` (s) late."""

    delay: float = 0.025
    name = "command_delay"

    def attach(self, assembly: Assembly) -> None:
        inner, joints = assembly.command, assembly.robot.indices(self.where)

        def delayed(t: Array) -> Array:
            out = inner(t)
            out[:, joints] = inner(t - self.delay)[:, joints]
            return out

        assembly.command = delayed
        assembly.breaks.extend(b + self.delay for b in tuple(assembly.breaks))


@dataclass(frozen=True, kw_only=True)
class SensorDelay(Effect):
    """Logged position and velocity are `delay` (s) old.

    The servo's own loop is not delayed, nor is the logged effort.
    """

    delay: float = 0.02
    name = "sensor_delay"

    def attach(self, assembly: Assembly) -> None:
        late = joint_array(assembly, self.where, self.delay)
        assembly.read_delay = late if assembly.read_delay is None else assembly.read_delay + late


# ---- transmission ---------------------------------------------------------------------------------


def transmit(assembly: Assembly, where: tuple[str, ...], *values: float, smooth: bool = False) -> None:
    """A transmission; `values` are half the play, stiffness, damping, restitution and the motor's share of damping."""
    joints = assembly.robot.indices(where)
    arrays = (np.full(joints.size, x) for x in values)
    assembly.transmissions.append(Transmission(joints, *arrays, smooth=np.full(joints.size, smooth)))


@dataclass(frozen=True, kw_only=True)
class Backlash(Effect):
    """Total play `play` (rad) between motor and link; sensor on the link, servo on the motor.

    The armature is the motor's inertia. Past the play, teeth of `stiffness` (N m/rad) meet. `motor_damping`
    (-) is the share of the joint's declared damping that acts on the motor: with none, the link is damped
    while it is loose.
    """

    play: float = 0.03
    stiffness: float = 500.0
    restitution: float = 5.0
    motor_damping: float = 0.0
    name = "backlash"

    def attach(self, assembly: Assembly) -> None:
        half = 0.5 * self.play
        transmit(assembly, self.where, half, self.stiffness, 0.0, self.restitution, self.motor_damping)


@dataclass(frozen=True, kw_only=True)
class JointCompliance(Effect):
    """A spring `stiffness` (N m/rad) with `damping` (N m s/rad) from motor to link; sensors as for backlash.

    `motor_damping` as for backlash.
    """

    stiffness: float = 60.0
    damping: float = 0.05
    motor_damping: float = 0.0
    name = "joint_compliance"

    def attach(self, assembly: Assembly) -> None:
        transmit(assembly, self.where, 0.0, self.stiffness, self.damping, 0.0, self.motor_damping)


@dataclass(frozen=True, kw_only=True)
class JointSpring(Effect):
    """Torque -`stiffness` (N m/rad) (q - `rest`) on the link."""

    stiffness: float = 2.0
    rest: float = 0.0
    name = "joint_spring"

    def attach(self, assembly: Assembly) -> None:
        k = joint_array(assembly, self.where, self.stiffness)

        def term(s: State) -> None:
            s.link -= k * (s.q - self.rest)

        assembly.link.append(term)


# ---- encoder --------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class EncoderOffset(Effect):
    """The logged position is q + `offset` (rad).

    With `in_loop` the servo closes on the shifted reading too.
    """

    offset: float = 0.03
    in_loop: bool = False
    name = "encoder_offset"

    def attach(self, assembly: Assembly) -> None:
        offset = joint_array(assembly, self.where, self.offset)

        def read(t: Array, q: Array, v: Array) -> None:
            q += offset

        assembly.sensors.append(read)
        if self.in_loop:
            before = np.zeros_like(offset) if assembly.loop_offset is None else assembly.loop_offset
            assembly.loop_offset = before + offset


@dataclass(frozen=True, kw_only=True)
class EncoderScale(Effect):
    """The logged position is `scale` (-) times q, velocity likewise.

    With `in_loop` the servo's position feedback too.
    """

    scale: float = 1.05
    in_loop: bool = False
    name = "encoder_scale"

    def attach(self, assembly: Assembly) -> None:
        scale = joint_array(assembly, self.where, self.scale, 1.0)

        def read(t: Array, q: Array, v: Array) -> None:
            q *= scale
            v *= scale

        assembly.sensors.append(read)
        if self.in_loop:
            assembly.loop_scale = scale if assembly.loop_scale is None else assembly.loop_scale * scale
            if assembly.loop_offset is not None:
                assembly.loop_offset = assembly.loop_offset * scale


# ---- servo ----------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class TorqueLimit(Effect):
    """The servo's torque stays within +-`limit` (N m)."""

    limit: float = 1.0
    name = "torque_limit"

    def attach(self, assembly: Assembly) -> None:
        limit = joint_array(assembly, self.where, self.limit, np.inf)

        def term(s: State) -> None:
            np.clip(s.drive, -limit, limit, out=s.drive)

        assembly.limits.append(term)


@dataclass(frozen=True, kw_only=True)
class SpeedTorqueLimit(Effect):
    """Torque along the motion stays below a line falling with speed.

    The line is `stall` (N m) (1 - |v| / `no_load_speed` (rad/s)); against the motion the bound is `stall`.
    """

    stall: float = 0.8
    no_load_speed: float = 7.0
    name = "speed_torque_limit"

    def attach(self, assembly: Assembly) -> None:
        joints = assembly.robot.indices(self.where)

        def term(s: State) -> None:
            share = s.vm[joints] / self.no_load_speed
            high = self.stall * np.clip(1.0 - share, 0.0, 1.0)
            low = -self.stall * np.clip(1.0 + share, 0.0, 1.0)
            s.drive[joints] = np.clip(s.drive[joints], low, high)

        assembly.limits.append(term)


@dataclass(frozen=True, kw_only=True)
class SlewLimit(Effect):
    """Inside the servo the set-point follows the command at no more than `rate` (rad/s)."""

    rate: float = 2.0
    name = "slew_limit"

    def attach(self, assembly: Assembly) -> None:
        assembly.slew.append(joint_array(assembly, self.where, self.rate, np.inf))


@dataclass(frozen=True, kw_only=True)
class IntegralGain(Effect):
    """The servo adds `ki` (N m/(rad s)) times the integral of its error, clamped to +-`limit` (N m)."""

    ki: float = 20.0
    limit: float = 1.0
    name = "integral_gain"

    def attach(self, assembly: Assembly) -> None:
        joints = assembly.robot.indices(self.where)

        def rate(s: State) -> Array:
            error = self.ki * (s.u[joints] - s.qm[joints])
            torque = s.aux[place]
            return np.where((np.abs(torque) >= self.limit) & (torque * error > 0.0), 0.0, error)

        def term(s: State) -> None:
            s.drive[joints] += np.clip(s.aux[place], -self.limit, self.limit)

        place = assembly.add_state(np.zeros(joints.size), rate)
        assembly.drive.append(term)


@dataclass(frozen=True, kw_only=True)
class VoltageSag(Effect):
    """One battery for all servos at `where`: their torque falls as it empties and sags under load.

    Torque is multiplied by 1 - `rate` (1/s) t - `per_torque` (1/(N m)) x, x being the sum of |torque| over
    these joints through a first-order lag of `lag` (s); never below 0.2.
    """

    rate: float = 0.01
    per_torque: float = 0.0
    lag: float = 0.05
    name = "voltage_sag"

    def attach(self, assembly: Assembly) -> None:
        joints = assembly.robot.indices(self.where)

        def loading(s: State) -> Array:
            return np.array([(np.abs(s.drive[joints]).sum() - s.aux[place][0]) / self.lag])

        def term(s: State) -> None:
            left = 1.0 - self.rate * max(s.t, 0.0) - self.per_torque * s.aux[place][0]
            s.drive[joints] *= max(float(left), 0.2)

        place = assembly.add_state(np.zeros(1), loading)
        assembly.gains.append(term)


@dataclass(frozen=True, kw_only=True)
class ThermalDerating(Effect):
    """Torque falls as the motor heats.

    It is divided by 1 + `alpha` (1/(N m)^2) h, h being torque squared lagged by `time_constant` (s).
    """

    alpha: float = 0.3
    time_constant: float = 10.0
    name = "thermal_derating"

    def attach(self, assembly: Assembly) -> None:
        joints = assembly.robot.indices(self.where)

        def heating(s: State) -> Array:
            return np.asarray((s.drive[joints] ** 2 - s.aux[place]) / self.time_constant)

        def term(s: State) -> None:
            s.drive[joints] /= 1.0 + self.alpha * s.aux[place]

        place = assembly.add_state(np.zeros(joints.size), heating)
        assembly.gains.append(term)


# ---- bodies and forces ----------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class Payload(Effect):
    """A point mass `mass` (kg) at `offset` (m, body frame) on the bodies `where`."""

    mass: float = 0.2
    offset: Vector = (0.0, 0.0, 0.0)
    name = "payload"
    acts_on = "body"

    def attach(self, assembly: Assembly) -> None:
        robot, offset = assembly.robot, np.asarray(self.offset)
        loaded = {name: robot.body(name).with_point_mass(self.mass, offset) for name in self.where}
        assembly.robot = robot.with_bodies(loaded)


@dataclass(frozen=True, kw_only=True)
class ComOffset(Effect):
    """The centre of mass of the bodies `where` is moved by `offset` (m, body frame).

    The inertia about it stays.
    """

    offset: Vector = (0.02, 0.0, 0.0)
    name = "com_offset"
    acts_on = "body"

    def attach(self, assembly: Assembly) -> None:
        robot, offset = assembly.robot, np.asarray(self.offset)
        bodies = [robot.body(name) for name in self.where]
        assembly.robot = robot.with_bodies({b.name: replace(b, com=b.com + offset) for b in bodies})


@dataclass(frozen=True, kw_only=True)
class ConstantForce(Effect):
    """A constant `torque` (N m) on the link."""

    torque: float = 0.2
    name = "constant_force"

    def attach(self, assembly: Assembly) -> None:
        torque = joint_array(assembly, self.where, self.torque)

        def term(s: State) -> None:
            s.link += torque

        assembly.link.append(term)


@dataclass(frozen=True, kw_only=True)
class Cogging(Effect):
    """Torque `amplitude` (N m) sin(`periods` (1/turn of the joint) q + `phase` (rad)) of the motor."""

    amplitude: float = 0.1
    periods: float = 20.0
    phase: float = 0.0
    name = "cogging"

    def attach(self, assembly: Assembly) -> None:
        size = joint_array(assembly, self.where, self.amplitude)

        def term(s: State) -> None:
            s.motor += size * np.sin(self.periods * s.qm + self.phase)

        assembly.motor.append(term)


@dataclass(frozen=True, kw_only=True)
class ExternalDisturbance(Effect):
    """A push: `torque` (N m) on the link from `start` (s) for `duration` (s).

    It comes again every `every` (s) if that is above 0.
    """

    torque: float = 1.0
    start: float = 3.0
    duration: float = 0.2
    every: float = 0.0
    name = "external_disturbance"

    def attach(self, assembly: Assembly) -> None:
        starts = _repeats(self.start, self.every, assembly.duration)

        def pulse(t: Array) -> Array:
            return self.torque * _within(t, starts, self.duration)

        assembly.torque.append(joint_signal(assembly, self.where, pulse, 0.0))
        assembly.breaks.extend([*starts, *(starts + self.duration)])


def _repeats(start: float, every: float, duration: float) -> Array:
    return np.arange(start, duration, every) if every > 0.0 else np.array([start])


def _within(t: Array, starts: Array, length: float) -> Array:
    return ((t[:, None] >= starts) & (t[:, None] < starts + length)).any(axis=1).astype(float)


@dataclass(frozen=True, kw_only=True)
class GravityTilt(Effect):
    """The base stands rolled by `roll` and pitched by `pitch` (rad).

    Gravity is turned the other way in its frame.
    """

    roll: float = 0.0
    pitch: float = 0.05
    name = "gravity_tilt"
    acts_on = "robot"

    def attach(self, assembly: Assembly) -> None:
        cr, sr, cp, sp = np.cos(self.roll), np.sin(self.roll), np.cos(self.pitch), np.sin(self.pitch)
        about_x = np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
        about_y = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
        robot = assembly.robot
        assembly.robot = replace(robot, gravity=(about_y @ about_x).T @ robot.gravity)


# ---- outside any library: for negative tests ------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class GainDrift(Effect):
    """kp wanders: multiplied by 1 + `depth` (-) sin(2 pi t / `period` (s))."""

    depth: float = 0.25
    period: float = 7.0
    name = "gain_drift"
    in_library = False

    def attach(self, assembly: Assembly) -> None:
        def factor(t: Array) -> Array:
            return 1.0 + self.depth * np.sin(2.0 * np.pi * t / self.period)

        assembly.stiffening.append(joint_signal(assembly, self.where, factor, 1.0))


@dataclass(frozen=True, kw_only=True)
class FrictionPatch(Effect):
    """Dry friction only near one angle: `torque` (N m) exp(-((q - `centre`) / `width`)^2), angles in rad."""

    torque: float = 0.6
    centre: float = 0.5
    width: float = 0.08
    name = "friction_patch"
    in_library = False

    def attach(self, assembly: Assembly) -> None:
        size = joint_array(assembly, self.where, self.torque)

        def term(s: State) -> None:
            s.friction += size * np.exp(-(((s.qm - self.centre) / self.width) ** 2))

        assembly.friction.append(term)


@dataclass(frozen=True, kw_only=True)
class ControllerDropout(Effect):
    """The servo gives no torque for `duration` (s) every `every` (s), first at `start` (s)."""

    start: float = 2.0
    duration: float = 0.1
    every: float = 1.7
    name = "controller_dropout"
    in_library = False

    def attach(self, assembly: Assembly) -> None:
        starts = _repeats(self.start, self.every, assembly.duration)

        def on(t: Array) -> Array:
            return 1.0 - _within(t, starts, self.duration)

        assembly.gain.append(joint_signal(assembly, self.where, on, 1.0))
        assembly.breaks.extend([*starts, *(starts + self.duration)])


@dataclass(frozen=True, kw_only=True)
class CableCoupling(Effect):
    """A cable between two joints.

    Torque -`stiffness` (N m/rad) (q1 - q2) on the first, the opposite on the second.
    """

    stiffness: float = 1.0
    name = "cable_coupling"
    in_library = False

    def attach(self, assembly: Assembly) -> None:
        if len(self.where) != 2:
            raise ValueError(f"cable_coupling joins two joints, not {len(self.where)}")
        i, j = assembly.robot.indices(self.where)

        def term(s: State) -> None:
            pull = self.stiffness * (s.q[i] - s.q[j])
            s.link[i] -= pull
            s.link[j] += pull

        assembly.link.append(term)


@dataclass(frozen=True, kw_only=True)
class RandomWalkTorque(Effect):
    """A disturbance on the link that wanders.

    Standard deviation `size` (N m), correlated over `correlation` (s).
    """

    size: float = 0.3
    correlation: float = 2.0
    name = "random_walk_torque"
    in_library = False

    def attach(self, assembly: Assembly) -> None:
        joints, n, dt = assembly.robot.indices(self.where), assembly.robot.n, 0.01
        knots = np.arange(0.0, assembly.duration + 2.0 * dt, dt)
        keep = np.exp(-dt / self.correlation)
        kick = assembly.rng.normal(0.0, self.size * np.sqrt(1.0 - keep**2), (knots.size, joints.size))
        walk = np.zeros_like(kick)
        for k in range(1, knots.size):
            walk[k] = keep * walk[k - 1] + kick[k]

        def signal(t: Array) -> Array:
            out = np.zeros((t.size, n))
            for column, j in enumerate(joints):
                out[:, j] = np.interp(t, knots, walk[:, column])
            return out

        assembly.torque.append(signal)


EFFECTS: dict[str, type[Effect]] = {
    effect.name: effect
    for effect in (
        CoulombFriction,
        ViscousDamping,
        QuadraticDamping,
        StribeckFriction,
        LoadFriction,
        Armature,
        CommandDelay,
        SensorDelay,
        Backlash,
        JointCompliance,
        JointSpring,
        EncoderOffset,
        EncoderScale,
        TorqueLimit,
        SpeedTorqueLimit,
        SlewLimit,
        IntegralGain,
        VoltageSag,
        ThermalDerating,
        Payload,
        ComOffset,
        ConstantForce,
        Cogging,
        ExternalDisturbance,
        GravityTilt,
        GainDrift,
        FrictionPatch,
        ControllerDropout,
        CableCoupling,
        RandomWalkTorque,
    )
}


def parse_effect(text: str) -> Effect:
    """An effect from `NAME[:WHERE[,WHERE...]][:key=value[,key=value...]]`; vectors as x/y/z.

    Raises ValueError saying what is allowed.
    """
    name, *rest = text.split(":")
    if name not in EFFECTS:
        raise ValueError(f"no effect {name!r}; there are {', '.join(EFFECTS)}")
    kind = EFFECTS[name]
    places = [p for p in rest if "=" not in p]
    if len(places) > 1 or len(rest) > 2:
        raise ValueError(f"effect {text!r}: write NAME:WHERE,WHERE:key=value,key=value")
    where = tuple(places[0].split(",")) if places and places[0] else ()
    defaults = {f.name: f.default for f in fields(kind) if f.name != "where"}
    values: dict[str, Any] = {}
    for part in rest:
        if "=" not in part:
            continue
        for item in part.split(","):
            key, _, value = item.partition("=")
            if key not in defaults:
                raise ValueError(f"{name} has no {key!r}; it has {', '.join(defaults)}")
            values[key] = _parsed(value, defaults[key])
    return kind(where=where, **values)


def _parsed(text: str, like: object) -> object:
    if isinstance(like, bool):
        return text.lower() in ("1", "true", "yes")
    if isinstance(like, tuple):
        return tuple(float(x) for x in text.split("/"))
    return float(text)
