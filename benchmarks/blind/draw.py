"""From a number to a recording: robot, motion, masses, gains, effects that the log can show."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from benchmarks.blind.shapes import SHAPES
from benchmarks.blind.sizes import ALIKE, LIBRARY, OUTSIDE, Recipe, Stage
from reference_simulator import FORMS, MOTIONS, Follow, Recording, Sensors, exact_channels, load_robot

if TYPE_CHECKING:
    from numpy.random import Generator
    from numpy.typing import NDArray

    from reference_simulator.effects import Effect
    from reference_simulator.robot import Robot

    Array = NDArray[np.float64]
    Names = tuple[str, ...]

SAMPLE_LOGS = Path(__file__).parents[2] / "sample_logs"
MODELS = Path(__file__).parent / "models"
PARTS: dict[str, int] = {"single": 60, "pair": 20, "outside": 10, "clean": 20, "shape": 120}
"""Logs in each part."""
VISIBLE = 2.0
"""What an effect must add to an exact sensor at each of its joints, in noise floors (rms over the log) ..."""
VISIBLE_EVERYWHERE, MOST = 1.5, 0.85
"""... and at this fraction of them where it sits at all joints."""
TOO_MUCH = 0.12
"""Rms change of position (rad) beyond which the robot would have been repaired, not identified."""
TRIES_A_MOTION = 6
GIVE_UP = 3 * TRIES_A_MOTION
"""Draws after which a log of forms takes other ones."""
ROUGH = 2.0e-3
"""Step (s) of the recordings that only judge a draw."""
NUDGE = 0.05


@dataclass(frozen=True)
class Bench:
    """One robot of the benchmark: the model, what is declared free, and where masses are wrong.

    With `follow` it has motors, which a controller on the host makes follow the motion; then a torque may well move
    it by more than `too_much` (rad, rms) that would be repaired elsewhere.
    """

    name: str
    model: Path
    seconds: float
    fit: Names
    free: Names
    wrong: Names
    loadable: Names
    follow: Follow | None = None
    too_much: float = TOO_MUCH


BENCHES: dict[str, Bench] = {
    "nao": Bench(
        name="nao",
        model=SAMPLE_LOGS / "nao.xml",
        seconds=12.0,
        fit=("mass:*KneePitch,*HipPitch,*HipRoll,*ShoulderRoll", "kp:*=shared", "kv:*=shared"),
        free=tuple(s + b for b in ("KneePitch", "HipPitch", "HipRoll", "ShoulderRoll") for s in "RL"),
        wrong=tuple(s + b for b in ("KneePitch", "HipPitch", "ShoulderRoll") for s in "RL"),
        loadable=(
            *("RElbowRoll", "LElbowRoll", "RAnkleRoll", "LAnkleRoll", "HeadPitch"),
            *("RShoulderRoll", "LShoulderRoll", "RHipPitch", "LHipPitch", "RKneePitch", "LKneePitch"),
        ),
    ),
    "leg": Bench(
        name="leg",
        model=SAMPLE_LOGS / "leg.xml",
        seconds=15.0,
        fit=("mass:HipPitch,KneePitch", "kp:*=shared", "kv:*=shared"),
        free=("HipPitch", "KneePitch"),
        wrong=("HipPitch", "KneePitch"),
        loadable=("AnkleRoll", "KneePitch", "HipPitch"),
    ),
    "torque_arm": Bench(
        name="torque_arm",
        model=MODELS / "torque_arm.xml",
        seconds=15.0,
        fit=("mass:elbow_link,wrist_link",),
        free=("elbow_link", "wrist_link"),
        wrong=("elbow_link", "wrist_link"),
        loadable=("elbow_link", "wrist_link"),
        follow=Follow((40.0, 10.0, 3.0), (4.0, 0.8, 0.2)),
        too_much=0.4,
    ),
    "double_pendulum": Bench(
        name="double_pendulum",
        model=MODELS / "double_pendulum.xml",
        seconds=15.0,
        fit=("mass:upper_link,lower_link",),
        free=("upper_link", "lower_link"),
        wrong=("upper_link", "lower_link"),
        loadable=("upper_link", "lower_link"),
        follow=Follow((15.0, 5.0), (1.5, 0.35)),
        too_much=0.4,
    ),
    "servo_arm": Bench(
        name="servo_arm",
        model=MODELS / "servo_arm.xml",
        seconds=15.0,
        fit=("mass:elbow_link,wrist_link", "kp:*=shared", "kv:*=shared"),
        free=("elbow_link", "wrist_link"),
        wrong=("elbow_link", "wrist_link"),
        loadable=("elbow_link", "wrist_link"),
    ),
}
OTHERS = ("torque_arm", "double_pendulum", "servo_arm")
"""The robots of every third log of `shape`; the others are on the Nao and on the leg in turn."""


@dataclass(frozen=True)
class Case:
    """One log of the benchmark.

    Attributes
    ----------
    series, part, number : which one; another series is another draw of everything.
    bench : robot.
    spec : the recording, its effects resolved to names.
    draws : how many draws it took until the log could show the effects.
    """

    series: int
    part: str
    number: int
    bench: Bench
    spec: Recording
    draws: int

    @property
    def id(self) -> str:
        prefix = f"{self.series}/" if self.series else ""
        return f"{prefix}{self.part}-{self.number:02d}"


def draw(part: str, number: int, series: int = 0) -> Case:
    """The log `number` (from 1) of a part; the same arguments give the same log."""
    rng = np.random.default_rng([20260, series, list(PARTS).index(part), number])
    bench = BENCHES[_robot(part, number)]
    if part == "clean":
        return Case(series, part, number, bench, _clean(rng, bench, number), 1)
    names = _names(rng, part, number)
    draws = 0
    for _ in count():
        if draws > 40 * TRIES_A_MOTION:
            raise RuntimeError(f"{part} {number}: no draw of {', '.join(names)} shows on this robot")
        if part == "shape" and draws % GIVE_UP == 0:
            names = _forms(rng, bench, number, draws // GIVE_UP)
        recipes = [(LIBRARY | OUTSIDE | SHAPES)[name] for name in names]
        effort = any(r.effort for r in recipes) and number % 2 == 0
        if part == "single":  # the second log of an effect lacks what the first has
            effort = recipes[0].effort and _round(number) % 2 == 0
        plain = _plain(rng, bench, str(rng.choice(_motions(recipes))), Sensors(effort=effort))
        view = View.of(plain, bench)
        for _ in range(TRIES_A_MOTION):
            draws += 1
            effects = _effects(rng, bench, recipes, view.stage)
            if view.shows(effects, bench.too_much):
                return Case(series, part, number, bench, replace(plain, effects=effects), draws)
    raise AssertionError


def cases(part: str, series: int = 0) -> Iterator[Case]:
    """All logs of a part."""
    yield from (draw(part, number, series) for number in range(1, PARTS[part] + 1))


def _robot(part: str, number: int) -> str:
    """Two in five are on the Nao; each effect gets its turn on either robot. Of the forms it is one in three."""
    if part == "shape":
        return ("nao", "leg", OTHERS[number // 3 % len(OTHERS)])[number % 3]
    return "nao" if (number + _round(number)) % 5 in (0, 2) else "leg"


def _round(number: int) -> int:
    """How often each effect of the library has had its turn before."""
    return (number - 1) // len(LIBRARY)


def _forms(rng: Generator, bench: Bench, number: int, skipped: int) -> Names:
    """One to three forms of different families: the one whose turn it is (or a later one), and others at random."""
    fit = [n for n, r in SHAPES.items() if r.drive in ("", "servo" if bench.follow is None else "motor")]
    names = [fit[(number - 1 + (number - 1) // len(fit) + skipped) % len(fit)]]
    wanted = 1 + int(rng.choice(3, p=(0.55, 0.3, 0.15))) if skipped < 4 else 1
    for name in (str(n) for n in rng.permutation(fit)):
        families = {FORMS[n].family for n in names}
        common = _motions([SHAPES[n] for n in (*names, name)])
        if len(names) < wanted and FORMS[name].family not in families and common:
            names.append(name)
    return tuple(names)


def _names(rng: Generator, part: str, number: int) -> Names:
    if part == "shape":
        return ()
    if part == "single":
        return (list(LIBRARY)[(number - 1) % len(LIBRARY)],)
    if part == "outside":
        return (list(OUTSIDE)[(number - 1) % len(OUTSIDE)],)
    while True:
        first, second = (str(n) for n in rng.choice(list(LIBRARY), 2, replace=False))
        common = set(LIBRARY[first].motions) & set(LIBRARY[second].motions)
        if common and not any({first, second} <= pair for pair in ALIKE):
            return first, second


def _motions(recipes: list[Recipe]) -> list[str]:
    return [m for m in recipes[0].motions if all(m in r.motions for r in recipes)]


def _plain(rng: Generator, bench: Bench, motion: str, sensors: Sensors) -> Recording:
    """The robot with wrong masses and gains, and nothing else."""
    bodies = rng.choice(bench.wrong, min(int(rng.integers(2, 4)), len(bench.wrong)), replace=False)
    return Recording(
        robot=bench.model,
        motion=motion,
        seed=int(rng.integers(1, 2**31)),
        seconds=bench.seconds,
        mass={str(b): round(float(rng.uniform(0.8, 1.25)), 3) for b in bodies},
        kp=round(float(rng.uniform(0.85, 1.15)), 3) if bench.follow is None else 1.0,
        kv=round(float(rng.uniform(0.85, 1.2)), 3) if bench.follow is None and rng.random() < 0.3 else 1.0,
        sensors=sensors,
        follow=bench.follow,
    )


def _clean(rng: Generator, bench: Bench, number: int) -> Recording:
    """Other motions, sensors and numerics; the servo of one in five is digital, as its metadata says."""
    motion = list(MOTIONS)[(number - 1) % len(MOTIONS)]
    noise = float(rng.uniform(1.0e-4, 8.0e-4))
    sensors = Sensors(bits=int(rng.choice([0, 12, 12, 14])), position_noise=noise, effort=bool(rng.random() < 0.25))
    spec = _plain(rng, bench, motion, sensors)
    step = float(rng.choice([2.5e-4, 5.0e-4, 1.0e-3]))
    return replace(spec, step=step, servo_period=2.0e-3 if number % 5 == 4 else None)


def _effects(rng: Generator, bench: Bench, recipes: list[Recipe], stage: Stage) -> tuple[Effect, ...]:
    taken: list[str] = []
    effects: list[Effect] = []
    for recipe in recipes:
        where = _places(rng, bench, recipe, stage.robot, taken)
        effects.append(recipe.draw(rng, stage, where).resolved(stage.robot))
        if len(where) < stage.robot.n:
            taken += where
    return tuple(effects)


def _places(rng: Generator, bench: Bench, recipe: Recipe, robot: Robot, taken: list[str]) -> Names:
    """One place; on the Nao often a left-right pair; all joints where that is sensible."""
    if recipe.scope == "robot":
        return ()
    if recipe.scope == "body":
        return (str(rng.choice([b for b in bench.loadable if b not in taken] or bench.loadable)),)
    free = [j for j in robot.joints if j not in taken] or list(robot.joints)
    if recipe.scope == "two":
        a, b = sorted(int(i) for i in rng.choice(len(free), 2, replace=False))
        return free[a], free[b]
    if recipe.everywhere and not taken and rng.random() < 0.45:
        return robot.joints
    joint = str(rng.choice(free))
    other = {"R": "L", "L": "R"}.get(joint[0], "") + joint[1:]
    if other in free and rng.random() < 0.5:
        return tuple(j for j in free if j in (joint, other))
    return (joint,)


@dataclass(frozen=True)
class View:
    """What exact sensors see of one motion without effects, and what declared parameters can imitate.

    Attributes
    ----------
    plain : recording without effects.
    stage : sizes.
    columns : names of the sensors' columns, positions first; `floor` (c,) their noise, SI.
    exact : (samples, c) without effects.
    basis : (samples c, p) orthonormal; the changes, in noise floors, that masses and gains can make.
    """

    plain: Recording
    stage: Stage
    columns: Names
    floor: Array
    exact: Array
    basis: Array

    @classmethod
    def of(cls, plain: Recording, bench: Bench) -> View:
        robot = load_robot(bench.model)
        rough = replace(plain, step=ROUGH)
        with_effort = replace(rough, sensors=replace(plain.sensors, effort=True))
        time, seen = exact_channels(with_effort)
        rough = replace(rough, commands=_commands(seen, robot))
        position = np.column_stack([seen[f"position.{j}"] for j in robot.joints])
        torque = np.column_stack([seen[f"effort.{j}"] for j in robot.joints])
        speed = np.gradient(position, time, axis=0)
        stage = Stage(
            robot=robot,
            seconds=plain.seconds,
            torque_rms=np.sqrt(np.mean(torque**2, axis=0)),
            torque_peak=np.abs(torque).max(axis=0),
            speed_peak=np.abs(speed).max(axis=0),
            centre=position.mean(axis=0),
            spread=position.std(axis=0),
        )
        sensors = plain.sensors
        noise = float(np.hypot(sensors.position_noise, sensors.tick / np.sqrt(12.0)))
        kinds = (("position", noise), ("effort", sensors.effort_noise))[: 2 if sensors.effort else 1]
        columns = tuple(f"{kind}.{j}" for kind, _ in kinds for j in robot.joints)
        floor = np.concatenate([np.full(robot.n, size) for _, size in kinds])
        exact = np.column_stack([seen[c] for c in columns])
        nudged = [*(replace(rough, mass=_times(plain.mass, body)) for body in bench.free)]
        if bench.follow is None:
            nudged.append(replace(rough, kp=float(plain.kp) * (1 + NUDGE)))  # type: ignore[arg-type]
            nudged.append(replace(rough, kv=float(plain.kv) * (1 + NUDGE)))  # type: ignore[arg-type]
        changes = [((_table(exact_channels(spec)[1], columns) - exact) / floor).ravel() for spec in nudged]
        left, size, _ = np.linalg.svd(np.column_stack(changes), full_matrices=False)
        return cls(plain, stage, columns, floor, exact, left[:, size > 1e-3 * size[0]])

    def shows(self, effects: tuple[Effect, ...], too_much: float = TOO_MUCH) -> bool:
        """Whether each effect shows beside the others, at each of its places, beyond what masses and gains do."""
        try:
            _, seen = exact_channels(replace(self.plain, effects=effects, step=ROUGH))
            whole = _table(seen, self.columns)
            for k, effect in enumerate(effects):
                without = self._without(effects[:k] + effects[k + 1 :], seen)
                if not self._shows(effect, whole - without, too_much):
                    return False
        except (FloatingPointError, np.linalg.LinAlgError):  # the robot with this effect is unstable
            return False
        return True

    def _without(self, others: tuple[Effect, ...], seen: Mapping[str, Array]) -> Array:
        """What sensors see of the same commands with the other effects alone; a host sends others each time."""
        if not others and self.plain.follow is None:
            return self.exact
        spec = replace(self.plain, effects=others, step=ROUGH, commands=_commands(seen, self.stage.robot))
        return _table(exact_channels(spec)[1], self.columns)

    def _shows(self, effect: Effect, change: Array, too_much: float) -> bool:
        robot = self.stage.robot
        raw = _rms(change)[: robot.n]
        if raw.max() > too_much:
            return False
        white = (change / self.floor).ravel()
        left = _rms((white - self.basis @ (self.basis.T @ white)).reshape(change.shape))
        beyond = left.reshape(-1, robot.n).max(axis=0)
        strength = np.minimum(raw / self.floor[0], beyond)
        if effect.acts_on == "body":
            return bool(strength.max() >= VISIBLE)
        if effect.acts_on == "robot" or effect.name == "voltage_sag":
            return bool(np.sort(strength)[-2:].min() >= VISIBLE)
        own = strength[robot.indices(effect.where)]
        if own.size > 2:
            return bool(np.mean(own >= VISIBLE_EVERYWHERE) >= MOST)
        return bool(own.min() >= VISIBLE)


def _times(mass: Mapping[str, float] | float, body: str) -> dict[str, float]:
    table = dict(mass) if isinstance(mass, Mapping) else {"*": mass}
    table[body] = table.get(body, 1.0) * (1 + NUDGE)
    return table


def _commands(seen: Mapping[str, Array], robot: Robot) -> Array:
    return np.column_stack([seen[f"command.{j}"] for j in robot.joints])


def _table(seen: Mapping[str, Array], columns: Names) -> Array:
    return np.column_stack([seen[c] for c in columns])


def _rms(x: Array) -> Array:
    return np.asarray(np.sqrt(np.mean(x**2, axis=0)))
