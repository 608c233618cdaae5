"""Make a log of a robot whose every parameter is known."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from fnmatch import fnmatchcase
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from reference_simulator.motions import MOTIONS, home
from reference_simulator.plant import Assembly, Host, Plant, Trajectory, step_grid
from reference_simulator.robot import Robot, load_robot

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from reference_simulator.effects import Effect
    from sysid_btr.io.log import Log

    Array = NDArray[np.float64]

Truth = dict[str, Any]


@dataclass(frozen=True)
class Sensors:
    """What is logged and how well.

    `bits` 0: no quantisation. Noise is Gaussian, one standard deviation, SI units.
    """

    bits: int = 12
    position_noise: float = 4.0e-4
    velocity: bool = False
    velocity_noise: float = 0.02
    effort: bool = False
    effort_noise: float = 0.02
    imu: bool = False
    gyro_noise: float = 5.0e-3
    acc_noise: float = 0.05
    angle_noise: float = 2.0e-3

    @property
    def tick(self) -> float:
        """One encoder step, rad."""
        return 2.0 * np.pi / 2**self.bits if self.bits else 0.0


@dataclass(frozen=True)
class Follow:
    """A controller on the host, which sends motors the torques that make them follow a motion.

    At each sample kp (q* - q) + kd (v* - v): N m/rad and N m s/rad of all joints, held until the next.
    """

    kp: tuple[float, ...]
    kd: tuple[float, ...]


@dataclass(frozen=True)
class Recording:
    """Everything that makes a log: same recording, same versions, same numbers.

    `mass` scales bodies (inertia follows), `kp` and `kv` scale the servos' gains: one factor, or factors by
    name or glob. `commands` (k, n) overrides `motion`. `step` is the plant's, s; `servo_period` makes the
    servo digital (its torque is computed once a period and held); None leaves it continuous. `preroll` s are
    spent at the first command before time 0. The robot starts at rest at its first command, a joint with a motor
    at zero; `follow` makes motors do what `motion` asks (`commands` are torques of theirs).
    """

    robot: str | Path
    motion: str = "multisine"
    seed: int = 0
    seconds: float = 20.0
    rate: float = 100.0
    mass: Mapping[str, float] = field(default_factory=dict)
    kp: float | Mapping[str, float] = 1.0
    kv: float | Mapping[str, float] = 1.0
    effects: tuple[Effect, ...] = ()
    sensors: Sensors = Sensors()
    commands: Array | None = None
    step: float = 5.0e-4
    servo_period: float | None = None
    preroll: float = 0.0
    follow: Follow | None = None
    notes: str = ""


def record(spec: Recording) -> tuple[Log, Truth]:
    """Run `spec`; the log, and the truth behind it.

    Raises ValueError or KeyError for what `spec` gets wrong.
    """
    time, channels, exact, truth = _measure(spec)
    truth["noise_floor"] = {
        name: float(np.sqrt(np.mean((channels[name] - value) ** 2))) for name, value in exact.items()
    }
    return _as_log(spec, truth["robot"], time, channels), truth


def exact_channels(spec: Recording) -> tuple[Array, dict[str, Array]]:
    """Time and what perfect sensors would have logged: no noise, no quantisation."""
    time, _, exact, _ = _measure(spec)
    return time, exact


def save(spec: Recording, path: str | Path, *, overwrite: bool = False) -> Truth:
    """Record `spec` into `path` (Parquet), the truth beside it in `<stem>.truth.json`; returns the truth."""
    from sysid_btr.io.parquet import write_log

    path = Path(path)
    log, truth = record(spec)
    write_log(log, path, overwrite=overwrite)
    path.with_suffix(".truth.json").write_text(json.dumps(truth, indent=2) + "\n")
    return truth


def _measure(spec: Recording) -> tuple[Array, dict[str, Array], dict[str, Array], Truth]:
    # Independent streams: the motion does not change when an effect draws numbers, nor the noise when a
    # motion does.
    motion_rng, effect_rng, noise_rng = (np.random.default_rng([spec.seed, i]) for i in range(3))
    nominal = load_robot(spec.robot)
    robot, factors = _true_robot(nominal, spec)
    period = 1.0 / spec.rate
    time: Array = np.arange(round(spec.seconds * spec.rate), dtype=np.float64) * period
    commands = _commands(spec, nominal, time, motion_rng)
    effects = tuple(effect.resolved(nominal) for effect in spec.effects)
    start = np.where(robot.motors, home(robot), commands[0])
    host = None
    if spec.follow is not None and spec.commands is None:
        commands, host = _following(spec.follow, robot, time, commands)

    def held(t: Array) -> Array:
        now = np.clip(np.floor(t / period + 1e-9).astype(int), 0, len(commands) - 1)
        return np.asarray(commands[now])

    first = -spec.preroll
    last = float(time[-1]) + spec.step  # one step past the last sample, whose effort belongs to its own command
    assembly = Assembly(robot=robot, command=held, duration=last, rng=effect_rng, breaks=list(time), host=host)
    for effect in effects:
        effect.attach(assembly)
    late = assembly.read_delay
    reads = [time] if late is None else [time, *(time - d for d in np.unique(late))]
    breaks = [np.asarray(assembly.breaks), *reads]
    if spec.servo_period:
        breaks.append(np.arange(0.0, last, spec.servo_period))
    grid = step_grid(first, last, spec.step, np.concatenate(breaks))
    plant = Plant(assembly, start=start, grid=grid, sample_period=period, servo_period=spec.servo_period)
    exact = _readings(spec.sensors, assembly, plant.run(), time, commands)
    channels = {name: value.copy() for name, value in exact.items()}
    for name, value in channels.items():
        _spoil(name, value, spec.sensors, noise_rng)
    return time, channels, exact, _truth(spec, nominal, robot, factors, effects)


def _following(follow: Follow, robot: Robot, time: Array, motion: Array) -> tuple[Array, Host]:
    """Commands (k, n), those of motors empty, and what writes them."""
    commands, on = np.where(robot.motors, 0.0, motion), robot.motors
    rate = np.gradient(motion, time, axis=0)
    kp, kd = np.asarray(follow.kp), np.asarray(follow.kd)

    def tell(sample: int, q: Array, v: Array) -> None:
        now = min(max(sample, 0), len(commands) - 1)
        torque = kp * (motion[now] - q) + kd * (rate[now] - v)
        commands[now, on] = torque[on]

    return commands, tell


def _commands(spec: Recording, robot: Robot, time: Array, rng: np.random.Generator) -> Array:
    if spec.commands is not None:
        if spec.commands.shape != (time.size, robot.n):
            raise ValueError(f"commands have shape {spec.commands.shape}, not {(time.size, robot.n)}")
        return spec.commands
    if spec.motion not in MOTIONS:
        raise ValueError(f"no motion {spec.motion!r}; there are {', '.join(MOTIONS)}")
    return MOTIONS[spec.motion](robot, time, rng)


def _factors(given: float | Mapping[str, float], names: tuple[str, ...], what: str) -> Array:
    out = np.ones(len(names))
    if not isinstance(given, Mapping):
        return out * given
    for pattern, factor in given.items():
        hits = [i for i, name in enumerate(names) if fnmatchcase(name, pattern)]
        if not hits:
            raise ValueError(f"{what}: nothing matches {pattern!r}; there are {', '.join(names)}")
        out[hits] *= factor
    return out


def _true_robot(nominal: Robot, spec: Recording) -> tuple[Robot, dict[str, Array]]:
    names = tuple(b.name for b in nominal.bodies)
    factors = {
        "mass": _factors(spec.mass, names, "mass"),
        "kp": _factors(spec.kp, nominal.joints, "kp"),
        "kv": _factors(spec.kv, nominal.joints, "kv"),
    }
    bodies = tuple(b.scaled(float(f)) for b, f in zip(nominal.bodies, factors["mass"], strict=True))
    robot = replace(nominal, bodies=bodies, kp=nominal.kp * factors["kp"], kv=nominal.kv * factors["kv"])
    return robot, factors


def _readings(sensors: Sensors, assembly: Assembly, path: Trajectory, time: Array, commands: Array) -> dict[str, Array]:
    """What perfect sensors log: commands, positions and the optional channels, by column name."""
    joints = assembly.robot.joints
    late = np.zeros(len(joints)) if assembly.read_delay is None else assembly.read_delay

    def border(t: Array) -> NDArray[np.intp]:
        return np.clip(np.searchsorted(path.time, t - 1e-7), 0, path.time.size - 1)

    q, v = np.empty_like(commands), np.empty_like(commands)
    for j, delay in enumerate(late):
        q[:, j], v[:, j] = path.q[border(time - delay), j], path.v[border(time - delay), j]
    for read in assembly.sensors:
        read(time, q, v)
    out = {f"command.{name}": commands[:, j] for j, name in enumerate(joints)}
    out |= {f"position.{name}": q[:, j] for j, name in enumerate(joints)}
    if sensors.velocity:
        out |= {f"velocity.{name}": v[:, j] for j, name in enumerate(joints)}
    if sensors.effort:
        effort = path.effort[border(time)]
        out |= {f"effort.{name}": effort[:, j] for j, name in enumerate(joints)}
    if sensors.imu:
        up = -assembly.robot.gravity  # a held base feels the reaction to gravity and nothing else
        angle = {"x": np.arctan2(up[1], up[2]), "y": np.arctan2(-up[0], np.hypot(up[1], up[2]))}
        out |= {f"imu.gyro_{a}": np.zeros(time.size) for a in "xyz"}
        out |= {f"imu.acc_{a}": np.full(time.size, up[i]) for i, a in enumerate("xyz")}
        out |= {f"imu.angle_{a}": np.full(time.size, value) for a, value in angle.items()}
    return out


def _spoil(name: str, value: Array, sensors: Sensors, rng: np.random.Generator) -> None:
    """Noise and quantisation of one channel, in place."""
    sizes = {
        "position": sensors.position_noise,
        "velocity": sensors.velocity_noise,
        "effort": sensors.effort_noise,
        "imu.gyro": sensors.gyro_noise,
        "imu.acc": sensors.acc_noise,
        "imu.angle": sensors.angle_noise,
    }
    kind = name.split("_")[0] if name.startswith("imu.") else name.split(".")[0]
    if kind not in sizes:
        return
    value += rng.normal(0.0, 1.0, value.size) * sizes[kind]
    if kind == "position" and sensors.tick:
        value[:] = np.round(value / sensors.tick) * sensors.tick


def _truth(
    spec: Recording, nominal: Robot, robot: Robot, factors: Mapping[str, Array], effects: tuple[Effect, ...]
) -> Truth:
    def table(names: tuple[str, ...], factor: Array, value: Array) -> dict[str, dict[str, float]]:
        rows = zip(names, factor, value, strict=True)
        return {name: {"scale": float(f), "value": float(x)} for name, f, x in rows}

    bodies = tuple(b.name for b in nominal.bodies)
    return {
        "schema": "sysid_btr.truth/1",
        "robot": nominal.name,
        "model": nominal.path.name,
        "motion": spec.motion if spec.commands is None else "given",
        "seed": spec.seed,
        "seconds": spec.seconds,
        "rate": spec.rate,
        "step": spec.step,
        "servo_period": spec.servo_period,
        "mass": table(bodies, factors["mass"], np.array([b.mass for b in robot.bodies])),
        "kp": table(nominal.joints, factors["kp"], robot.kp),
        "kv": table(nominal.joints, factors["kv"], robot.kv),
        "effects": [effect.truth() for effect in effects],
    }


def _as_log(spec: Recording, robot: str, time: Array, channels: dict[str, Array]) -> Log:
    from sysid_btr.io.log import Log, LogMeta

    meta = LogMeta(
        robot=robot,
        mount="fixed",
        sample_period=1.0 / spec.rate,
        source="recorded",
        command_hold="zoh",
        servo_period=spec.servo_period,
        notes=spec.notes,
    )
    return Log(time=time, channels=channels, meta=meta, episode=np.zeros(time.size, dtype=np.int64))
