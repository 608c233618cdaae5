"""The plant: rigid bodies, servos, transmissions and dry friction, integrated in time.

Smooth dynamics take classical Runge-Kutta steps (order 4) between the instants at which an input switches.
Dry friction is not regularised: a joint either slips, with friction opposing its velocity, or sticks, with
whatever torque keeps its acceleration at zero while that torque is within the friction available. A reversal
is located inside the step.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from reference_simulator.robot import build_pinocchio

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from reference_simulator.robot import Robot

    Array = NDArray[np.float64]

EDGE = 1e-10  # s; inputs that jump at a step's border are read this far inside the step
MAX_PHASE = 0.25  # rad; largest (natural frequency x step) of a transmission spring


class State:
    """What the terms of the equations see at one evaluation. Arrays have length n.

    q, v: joint (link side) position and velocity; qm, vm: the motor's, in joint units; u: the command after
    delay and slew; drive: the servo's torque; motor, link: sums of torques on either side of the
    transmission; friction: dry friction available; aux: extra states.
    """

    t: float
    q: Array
    v: Array
    qm: Array
    vm: Array
    u: Array
    drive: Array
    motor: Array
    link: Array
    friction: Array
    aux: Array


Term = Callable[[State], None]
TimeSignal = Callable[["Array"], "Array"]
Host = Callable[[int, "Array", "Array"], None]
"""Called at a sample with its number, and q and v; writes the commands that `Assembly.command` gives from then on."""


@dataclass
class Transmission:
    """Springs between motor and link: free for |twist| < half play, then `stiffness` with damping.

    `damping` is linear (N m s/rad); `restitution` is the Hunt-Crossley factor (s/rad): damping in proportion
    to the elastic torque, so that torque is continuous when the gap closes. `motor_share` is the part of the
    joint's own damping that acts on the motor; the rest acts on the link. Where `smooth`, the gap has no edges:
    the torque is stiffness (x - h tanh(x / h)), h being half the play.
    """

    joints: NDArray[np.intp]
    half_play: Array
    stiffness: Array
    damping: Array
    restitution: Array
    motor_share: Array
    smooth: NDArray[np.bool_]


@dataclass
class Auxiliary:
    """An extra state of an effect: its place in `State.aux` and its time derivative."""

    place: slice
    derivative: Callable[[State], Array]


@dataclass
class Assembly:
    """What effects change before the plant is built. Lists of terms are applied in order."""

    robot: Robot
    command: TimeSignal
    duration: float
    rng: np.random.Generator
    host: Host | None = None  # gives the commands of motors, sample by sample
    inputs: list[Term] = field(default_factory=list)  # change s.u
    friction: list[Term] = field(default_factory=list)  # add to s.friction
    drive: list[Term] = field(default_factory=list)  # change s.drive: servo terms
    gains: list[Term] = field(default_factory=list)  # scale s.drive
    limits: list[Term] = field(default_factory=list)  # clip s.drive
    motor: list[Term] = field(default_factory=list)  # add to s.motor
    link: list[Term] = field(default_factory=list)  # add to s.link
    torque: list[TimeSignal] = field(default_factory=list)  # exogenous, on the link
    gain: list[TimeSignal] = field(default_factory=list)  # exogenous factor of the servo's torque
    stiffening: list[TimeSignal] = field(default_factory=list)  # exogenous factor of kp alone
    slew: list[Array] = field(default_factory=list)  # rad/s, inf where there is none
    transmissions: list[Transmission] = field(default_factory=list)
    auxiliaries: list[Auxiliary] = field(default_factory=list)
    aux_start: list[float] = field(default_factory=list)
    breaks: list[float] = field(default_factory=list)  # s; instants at which an input switches
    loop_scale: Array | None = None  # the servo sees loop_scale * q + loop_offset
    loop_offset: Array | None = None
    sensors: list[Callable[[Array, Array, Array], None]] = field(default_factory=list)  # change t, q, v as read
    read_delay: Array | None = None

    def add_state(self, start: Array, derivative: Callable[[State], Array]) -> slice:
        """Reserve extra states starting at `start`; `derivative` gives their rates."""
        place = slice(len(self.aux_start), len(self.aux_start) + len(start))
        self.aux_start.extend(float(x) for x in start)
        self.auxiliaries.append(Auxiliary(place, derivative))
        return place


@dataclass(frozen=True)
class Trajectory:
    """States at the borders of the steps: time (k,), q, v and servo torque (k, n).

    The servo's torque is that after a command has switched, and is known at the sampling instants only.
    """

    time: Array
    q: Array
    v: Array
    effort: Array


class Plant:
    """An assembled robot, ready to run once from rest at `start` (n,)."""

    def __init__(
        self, assembly: Assembly, *, start: Array, grid: Array, sample_period: float, servo_period: float | None
    ) -> None:
        import pinocchio as pin

        self.pin = pin
        robot = assembly.robot
        n = self.n = robot.n
        self.assembly = assembly
        self.gap = _merge(assembly.transmissions)
        g = self.gap.joints
        armature = robot.armature.copy()
        if g.size and not (armature[g] > 0.0).all():
            raise ValueError("a joint with backlash or compliance needs an armature: it is the motor's inertia")
        self.rotor = armature[g]
        armature[g] = 0.0
        self.model = build_pinocchio(robot, armature)
        self.data = self.model.createData()
        self.grid = refined(grid, self._substeps(start, grid))
        self.kp, self.kv = robot.kp, robot.kv
        self.feed = robot.motors.astype(float) if robot.motors.any() else None
        self.period = sample_period
        self.damping = robot.damping.copy()  # on the motor
        self.damping[g] *= self.gap.motor_share
        self.link_damping = robot.damping[g] - self.damping[g]
        self.stiffness = robot.stiffness if robot.stiffness.any() else None
        self.dry = bool(robot.frictionloss.any() or assembly.friction)

        sizes = np.cumsum([0, n, n, g.size, g.size, len(assembly.aux_start)])
        self.y = np.zeros(sizes[-1])
        self.w = np.zeros(sizes[-1])  # the point at which derivative() is taken
        self.dy = np.zeros((4, sizes[-1]))
        self.parts = [slice(int(a), int(b)) for a, b in itertools.pairwise(sizes)]
        self.y[self.parts[0]], self.y[self.parts[2]] = start, start[g]
        self.y[self.parts[4]] = assembly.aux_start
        self.direction = np.zeros(n)
        self.stuck = np.full(n, self.dry)
        self.holding = np.zeros(n)  # friction torque that a stuck joint needs
        self._set_stuck()

        s = self.s = State()
        s.q, s.v, self.theta, self.omega, s.aux = (self.w[p] for p in self.parts)
        s.qm, s.vm = (np.zeros(n), np.zeros(n)) if g.size else (s.q, s.v)
        s.drive, s.motor, s.link, s.friction = (np.zeros(n) for _ in range(4))
        self.scratch = np.zeros(n)
        self._schedule()
        self.held = np.zeros(n) if servo_period else None
        self.ticks = _ticks(self.grid, servo_period)
        self.samples = _ticks(self.grid, sample_period)
        self.smooth = np.flatnonzero(self.gap.smooth) if self.gap.smooth.any() else None
        self.limited = bool(np.isfinite(robot.torque_limit).any())

    # ---- inputs -----------------------------------------------------------------------------------

    def _schedule(self) -> None:
        """Exogenous inputs at the start, middle and end of every step: (steps, 3, n)."""
        a = self.assembly
        t0, t1 = self.grid[:-1], self.grid[1:]
        points = np.stack([t0 + EDGE, 0.5 * (t0 + t1), t1 - EDGE], axis=1)
        shape = (*points.shape, self.n)

        def sample(signals: list[TimeSignal], combine: Any) -> Array | None:
            if not signals:
                return None
            return np.ascontiguousarray(combine.reduce([f(points.ravel()).reshape(shape) for f in signals]))

        self.points = points
        self.command = np.ascontiguousarray(a.command(points.ravel()).reshape(shape))
        if a.host is not None and a.slew:
            raise ValueError("a set-point that is followed at a limited rate belongs to a position servo")
        for rate in a.slew:
            self.command = _slewed(self.command, t1 - t0, rate)
        self.torque = sample(a.torque, np.add)
        self.gain = sample(a.gain, np.multiply)
        self.kp_factor = sample(a.stiffening, np.multiply)

    def _input(self, table: Array, k: int, fraction: float) -> Array:
        start, middle, end = table[k]
        known: Array | None = {0.0: start, 0.5: middle, 1.0: end}.get(fraction)
        if known is not None:
            return known
        if fraction < 0.5:
            return np.asarray(start + 2.0 * fraction * (middle - start))
        return np.asarray(middle + (2.0 * fraction - 1.0) * (end - middle))

    def _substeps(self, start: Array, grid: Array) -> int:
        """How many times to split a step so that the stiffest transmission spring is resolved."""
        g = self.gap.joints
        if not g.size:
            return 1
        inertia = np.full(g.size, np.inf)
        for q in (start, 0.5 * self.assembly.robot.range.sum(axis=1)):
            inverse = np.diag(self.pin.computeMinverse(self.model, self.data, q))
            inertia = np.minimum(inertia, 1.0 / inverse[g])
        rate = np.sqrt(self.gap.stiffness * (1.0 / self.rotor + 1.0 / inertia)).max()
        return max(1, int(np.ceil(float(np.diff(grid).max()) * rate / MAX_PHASE)))

    # ---- equations of motion ----------------------------------------------------------------------

    def _set_stuck(self) -> None:
        geared = np.zeros(self.n, dtype=bool)
        geared[self.gap.joints] = True
        self.locked = np.flatnonzero(self.stuck & ~geared)  # joints whose acceleration is held at zero
        self.free = np.flatnonzero(~(self.stuck & ~geared))
        self.locked_rotors = np.flatnonzero(self.stuck[self.gap.joints])

    def _told(self, k: int, fraction: float) -> None:
        """The commands at the current point, into s.u."""
        self.s.u = self._input(self.command, k, fraction)
        if self.assembly.inputs:
            self.s.u = self.s.u.copy()
            for term in self.assembly.inputs:
                term(self.s)

    def _drive(self, k: int, fraction: float) -> None:
        """The servo's torque at the current point, into s.drive."""
        s, a = self.s, self.assembly
        measured = s.qm
        if a.loop_scale is not None:
            measured = measured * a.loop_scale
        if a.loop_offset is not None:
            measured = measured + a.loop_offset
        np.subtract(s.u, measured, out=s.drive)
        s.drive *= self.kp
        if self.kp_factor is not None:
            s.drive *= self._input(self.kp_factor, k, fraction)
        s.drive -= np.multiply(self.kv, s.vm, out=self.scratch)
        if self.feed is not None:
            s.drive += np.multiply(self.feed, s.u, out=self.scratch)
        for term in a.drive:
            term(s)
        if self.gain is not None:
            s.drive *= self._input(self.gain, k, fraction)
        for term in a.gains:
            term(s)
        for term in a.limits:
            term(s)
        if self.limited:
            limit = a.robot.torque_limit
            np.clip(s.drive, -limit, limit, out=s.drive)

    def _derivative(self, k: int, fraction: float, dy: Array) -> None:
        s, a, pin = self.s, self.assembly, self.pin
        s.t = float(self.points[k, 0] + fraction * (self.points[k, 2] - self.points[k, 0]))
        self._told(k, fraction)
        g = self.gap.joints
        if g.size:
            s.qm[:], s.vm[:] = s.q, s.v
            s.qm[g], s.vm[g] = self.theta, self.omega
        if self.held is None:
            self._drive(k, fraction)
        else:
            s.drive[:] = self.held
        np.multiply(self.damping, s.vm, out=self.scratch)
        np.subtract(s.drive, self.scratch, out=s.motor)
        for term in a.motor:
            term(s)
        if self.dry:
            s.friction[:] = a.robot.frictionloss
            for term in a.friction:
                term(s)
            s.motor -= np.multiply(s.friction, self.direction, out=self.scratch)
        s.link[:] = s.motor
        if g.size:
            twist = self._twist_torque()
            s.link[g] = twist - self.link_damping * s.v[g]
            rotor = s.motor[g] - twist
            self.holding[g] = -rotor
            rotor /= self.rotor
            rotor[self.locked_rotors] = 0.0
            dy[self.parts[2]], dy[self.parts[3]] = self.omega, rotor
        if self.stiffness is not None:
            s.link -= self.stiffness * (s.q - a.robot.rest)
        if self.torque is not None:
            s.link += self._input(self.torque, k, fraction)
        for term in a.link:
            term(s)
        dy[self.parts[0]] = s.v
        if self.locked.size:
            dy[self.parts[1]] = self._locked_acceleration()
        else:
            dy[self.parts[1]] = pin.aba(self.model, self.data, s.q, s.v, s.link)
        for auxiliary in a.auxiliaries:
            dy[self.parts[4]][auxiliary.place] = auxiliary.derivative(s)

    def _twist_torque(self) -> Array:
        g, s = self.gap, self.s
        twist = self.theta - s.q[g.joints]
        rate = self.omega - s.v[g.joints]
        free = np.clip(twist, -g.half_play, g.half_play)
        if self.smooth is not None:
            free[self.smooth] = (g.half_play * np.tanh(twist / g.half_play))[self.smooth]
        elastic = g.stiffness * (twist - free)
        damped = np.maximum(1.0 + g.restitution * rate * np.sign(elastic), 0.0)
        return elastic * damped + g.damping * rate

    def _locked_acceleration(self) -> Array:
        """Accelerations with the stuck joints held; what holds them goes to `holding`."""
        s, pin, locked, free = self.s, self.pin, self.locked, self.free
        mass = np.triu(pin.crba(self.model, self.data, s.q))
        mass += np.triu(mass, 1).T
        bias = pin.nonLinearEffects(self.model, self.data, s.q, s.v)
        acceleration = np.zeros(self.n)
        if free.size:
            acceleration[free] = np.linalg.solve(mass[np.ix_(free, free)], s.link[free] - bias[free])
        self.holding[locked] = mass[locked] @ acceleration + bias[locked] - s.link[locked]
        return acceleration

    # ---- integration ------------------------------------------------------------------------------

    def _runge_kutta(self, k: int, a: float, b: float) -> Array:
        """State after going from fraction `a` to `b` of step k with friction's directions as they are."""
        h = (b - a) * (self.grid[k + 1] - self.grid[k])
        k1, k2, k3, k4 = self.dy
        y, w = self.y, self.w
        half = 0.5 * (a + b)
        w[:] = y
        self._derivative(k, a, k1)
        np.multiply(k1, 0.5 * h, out=w)
        w += y
        self._derivative(k, half, k2)
        np.multiply(k2, 0.5 * h, out=w)
        w += y
        self._derivative(k, half, k3)
        np.multiply(k3, h, out=w)
        w += y
        self._derivative(k, b, k4)
        k2 += k3
        k2 *= 2.0
        k1 += k2
        k1 += k4
        k1 *= h / 6.0
        return np.asarray(y + k1)

    def _motor_velocity(self, y: Array) -> Array:
        velocity = y[self.parts[1]].copy()
        velocity[self.gap.joints] = y[self.parts[3]]
        return velocity

    def _stop(self, joints: NDArray[np.intp]) -> None:
        """Bring the motors of `joints` to rest and let them stick."""
        place = {int(j): i for i, j in enumerate(self.gap.joints)}
        for j in joints:
            if int(j) in place:
                self.y[self.parts[3]][place[int(j)]] = 0.0
            else:
                self.y[self.parts[1]][j] = 0.0
        self.stuck[joints] = True
        self.direction[joints] = 0.0
        self._set_stuck()

    def _release(self, k: int, fraction: float, barred: NDArray[np.bool_]) -> None:
        """Let go every stuck joint that needs more than the friction there is, the worst one first."""
        while True:
            self.w[:] = self.y
            self._derivative(k, fraction, self.dy[0])
            excess = np.where(self.stuck & ~barred, np.abs(self.holding) - self.s.friction, -1.0)
            worst = int(excess.argmax())
            if excess[worst] <= 0.0:
                return
            self.stuck[worst] = False
            self.direction[worst] = -np.sign(self.holding[worst])
            self._set_stuck()

    def _step(self, k: int) -> None:
        if not self.dry:
            self.y = self._runge_kutta(k, 0.0, 1.0)
            return
        done, tries = 0.0, 0
        barred = np.zeros(self.n, dtype=bool)
        while done < 1.0:
            if self.stuck.any():
                self._release(k, done, barred)
            before = self._motor_velocity(self.y)
            after_y = self._runge_kutta(k, done, 1.0)
            after = self._motor_velocity(after_y)
            turned = np.flatnonzero(after * self.direction < 0.0)
            if not turned.size:
                self.y = after_y
                return
            tries += 1
            travel = np.maximum(before[turned] * self.direction[turned], 0.0)
            share = travel / (travel - after[turned] * self.direction[turned])
            first = float(share.min())
            if tries > 4 * self.n + 8:  # joints that keep each other slipping and sticking: hold them to the border
                barred[turned] = True
            if first > 1e-6:
                reached = done + first * (1.0 - done)
                self.y = self._runge_kutta(k, done, reached)
                done = reached
            self._stop(turned[share <= first + 1e-9])

    def run(self) -> Trajectory:
        """Integrate over the grid. Raises FloatingPointError when the state is no longer finite."""
        grid, n = self.grid, self.n
        q, v, effort = (np.zeros((grid.size, n)) for _ in range(3))
        for k in range(grid.size - 1):
            q[k], v[k] = self.y[:n], self.y[n : 2 * n]
            if self.assembly.host is not None:
                if self.samples[k]:
                    self.assembly.host(round(grid[k] / self.period), q[k], v[k])
                self.command[k] = self.assembly.command(self.points[k])
            if self.ticks[k]:
                self.held = self._servo_torque(k)
            if self.samples[k]:
                effort[k] = self._servo_torque(k) if self.held is None else self.held
            self._step(k)
            if k % 1000 == 0 and not np.isfinite(self.y).all():
                raise FloatingPointError(f"the recording diverged before t = {grid[k + 1]:.3f} s")
        q[-1], v[-1] = self.y[:n], self.y[n : 2 * n]
        if not np.isfinite(self.y).all():
            raise FloatingPointError("the recording diverged")
        return Trajectory(grid, q, v, effort)

    def _servo_torque(self, k: int) -> Array:
        """The servo's torque at the start of step k."""
        s, g = self.s, self.gap.joints
        self.w[:] = self.y
        s.t = float(self.grid[k])
        self._told(k, 0.0)
        if g.size:
            s.qm[:], s.vm[:] = s.q, s.v
            s.qm[g], s.vm[g] = self.theta, self.omega
        self._drive(k, 0.0)
        return s.drive.copy()


def _merge(parts: list[Transmission]) -> Transmission:
    joints = np.concatenate([p.joints for p in parts]) if parts else np.zeros(0, dtype=np.intp)
    if np.unique(joints).size != joints.size:
        raise ValueError("a joint can have one transmission: backlash or compliance, once")

    def cat(name: str) -> Array:
        return np.concatenate([getattr(p, name) for p in parts]) if parts else np.zeros(0)

    names = ("half_play", "stiffness", "damping", "restitution", "motor_share", "smooth")
    return Transmission(joints, *(cat(name) for name in names))


def _slewed(command: Array, lengths: Array, rate: Array) -> Array:
    """`command` (steps, 3, n) followed at no more than `rate` (n,) rad/s."""
    out = np.empty_like(command)
    now = command[0, 0].copy()
    for k, length in enumerate(lengths):
        out[k, 0] = now
        for point in (1, 2):
            reach = 0.5 * length * rate
            now = now + np.clip(command[k, point] - now, -reach, reach)
            out[k, point] = now
    return out


def _ticks(grid: Array, period: float | None) -> NDArray[np.bool_]:
    if period is None:
        return np.zeros(grid.size, dtype=bool)
    phase = grid / period
    return np.abs(phase - np.round(phase)) * period < 1e-7


def refined(grid: Array, parts: int) -> Array:
    """`grid` with every interval split into `parts` equal ones."""
    if parts == 1:
        return grid
    fractions = np.arange(parts) / parts
    inner = grid[:-1, None] + np.diff(grid)[:, None] * fractions
    return np.append(inner.ravel(), grid[-1])


def step_grid(first: float, last: float, step: float, breaks: Array) -> Array:
    """Borders of the steps: multiples of `step` from `first` to `last`, and every break inside."""
    count = int(np.ceil((last - first) / step - 1e-9))
    even = first + step * np.arange(count + 1)
    inside = breaks[(breaks > first) & (breaks < even[-1])]
    merged = np.sort(np.concatenate([even, inside]))
    keep = np.append(True, np.diff(merged) > 1e-8)
    return np.asarray(merged[keep])
