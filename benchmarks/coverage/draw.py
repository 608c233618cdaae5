"""From a number to a log whose every parameter is known: robot, masses, gains, motion, sensors, numerics."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np

from reference_simulator import MOTIONS, Recording, Sensors, record

if TYPE_CHECKING:
    from sysid_btr.io.log import Log
    from sysid_btr.simulation.numerics import Numerics

HERE = Path(__file__).parent
SAMPLE_LOGS = HERE.parents[1] / "sample_logs"
Plant = Literal["other", "own"]
SPREAD = (0.7, 1.3)
"""Of true masses and gains, as factors of the nominal."""
BITS = (12, 12, 14, 0)
"""Of the encoder, one drawn; 0 does not round."""
NOISE = (1.0e-4, 8.0e-4)
"""rad, of the encoder before it rounds."""
STEPS = (2.5e-4, 5.0e-4, 1.0e-3)
"""s, of the other engine."""


@dataclass(frozen=True)
class Bench:
    """A robot of the benchmark: model, length of its logs (s), what is declared free."""

    name: str
    model: Path
    seconds: float
    fit: tuple[str, ...]
    free: tuple[str, ...]


BENCHES: Mapping[str, Bench] = {
    "nao": Bench(
        name="nao",
        model=SAMPLE_LOGS / "nao.xml",
        seconds=12.0,
        fit=("mass:*KneePitch,*HipPitch,*HipRoll,*ShoulderRoll", "kp:*=shared", "kv:*=shared"),
        free=tuple(s + b for b in ("KneePitch", "HipPitch", "HipRoll", "ShoulderRoll") for s in "RL"),
    ),
    "leg": Bench(
        name="leg",
        model=SAMPLE_LOGS / "leg.xml",
        seconds=12.0,
        fit=("mass:HipPitch,KneePitch,AnkleRoll", "kp:*=shared", "kv:*=shared"),
        free=("HipPitch", "KneePitch", "AnkleRoll"),
    ),
}


@dataclass(frozen=True)
class Case:
    """One log: robot, number, and the recording that makes it."""

    bench: Bench
    number: int
    spec: Recording

    def true(self, parameter: str) -> float:
        """The true value of a declared parameter, such as ``mass:RKneePitch`` or ``kp:*``."""
        field, _, place = parameter.partition(":")
        if field != "mass":
            value = getattr(self.spec, field)
            assert isinstance(value, float)
            return value
        assert isinstance(self.spec.mass, Mapping)
        return next(float(v) for name, v in self.spec.mass.items() if fnmatchcase(name, place))

    def log(self, numerics: Numerics | None = None) -> Log:
        """The log from the other engine; or, given numerics, from the replay's own with white noise of equal size.

        The latter is what a model without any error of its own would see: it says how narrow intervals can be.
        """
        if numerics is None:
            return record(self.spec)[0]
        from sysid_btr.identify.replay import replay_log
        from sysid_btr.models.builtin import load_robot

        exact = Sensors(bits=0, position_noise=0.0)
        log, _ = record(replace(self.spec, sensors=exact))
        scales: dict[str, float] = {f"mass:{body}": self.true(f"mass:{body}") for body in self.bench.free}
        scales |= {"kp:*": self.true("kp:*"), "kv:*": self.true("kv:*")}
        run = replay_log(load_robot(str(self.bench.model)), log, scales, numerics=numerics, threads=1)
        sensors, rng = self.spec.sensors, np.random.default_rng([self.spec.seed, 3])
        size = float(np.hypot(sensors.position_noise, sensors.tick / np.sqrt(12.0)))
        channels = dict(log.channels)
        for name, column in run.channels.items():
            if name.startswith("position."):
                channels[name] = column + rng.normal(0.0, size, len(column))
        return replace(log, channels=channels)


def draw(bench: Bench, number: int) -> Case:
    """Log `number` (from 1) of a robot; the same arguments give the same log."""
    rng = np.random.default_rng([20264, list(BENCHES).index(bench.name), number])

    def factor() -> float:
        return round(float(rng.uniform(*SPREAD)), 3)

    spec = Recording(
        robot=bench.model,
        motion=str(rng.choice(list(MOTIONS))),
        seed=int(rng.integers(1, 2**31)),
        seconds=bench.seconds,
        mass={body: factor() for body in bench.free},
        kp=factor(),
        kv=factor(),
        sensors=Sensors(bits=int(rng.choice(BITS)), position_noise=float(rng.uniform(*NOISE))),
        step=float(rng.choice(STEPS)),
    )
    return Case(bench, number, spec)


def recipe_state() -> str:
    """Digest of what makes the logs."""
    whole = hashlib.sha256()
    recorder = sorted((HERE.parents[1] / "reference_simulator").glob("*.py"))
    for file in (HERE / "draw.py", *recorder, *(bench.model for bench in BENCHES.values())):
        whole.update(file.read_bytes())
    return whole.hexdigest()[:8]
