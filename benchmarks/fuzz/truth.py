"""`python -m benchmarks.fuzz.truth`: logs with a known truth, spoilt in ways that files allow: what is said of them?

A pendulum whose mass and gain are known is recorded by the replay itself, and its log is spoilt. `fit` and `close` then
refuse it, say that their model does not explain it, say that nothing is identifiable, or give intervals. What none may
do is to give, as if all were well, an interval that is more than five standard errors off.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.random import Generator

from sysid_btr._typing import FloatArray
from sysid_btr.diagnosis.close import close
from sysid_btr.errors import SysidError
from sysid_btr.identify.fit import fit
from sysid_btr.identify.intervals import Estimate
from sysid_btr.identify.replay import replay_log
from sysid_btr.identify.study import Study, make_study
from sysid_btr.io.log import Log, LogMeta
from sysid_btr.io.problem import errors_of
from sysid_btr.models.builtin import load_robot
from sysid_btr.models.log_checks import check_log
from sysid_btr.models.robot import Robot
from sysid_btr.simulation.numerics import Numerics

SAMPLES = Path(__file__).resolve().parents[2] / "sample_logs"
OUT = Path(__file__).parents[1] / "results" / "fuzz_truth.json"
JOINT, NOISE, RATE, SECONDS = "pendulum", 4e-4, 100, 10
TRUTH = {"mass:arm": 1.2, "kp:*": 0.9}
FREE, EFFECTS = ("mass:arm", "kp:*=shared"), ("coulomb_friction", "viscous_damping", "sensor_delay", "encoder_offset")
FAR = 5.0
"""Standard errors."""


def _position(change: Callable[[FloatArray, Generator], FloatArray]) -> Callable[[Log, Generator], Log]:
    def spoilt(log: Log, rng: Generator) -> Log:
        name = f"position.{JOINT}"
        return replace(log, channels={**log.channels, name: change(log.channels[name].copy(), rng)})

    return spoilt


def _late(samples: int) -> Callable[[FloatArray, Generator], FloatArray]:
    return lambda q, _: np.concatenate([np.full(samples, q[0]), q[:-samples]])


def _missing(q: FloatArray, rng: Generator) -> FloatArray:
    q[rng.random(len(q)) < 0.3] = np.nan
    return q


def _stuck(q: FloatArray, rng: Generator) -> FloatArray:
    at = int(rng.integers(100, len(q) - 200))
    q[at : at + 60] = q[at]
    return q


def _spikes(q: FloatArray, rng: Generator) -> FloatArray:
    q[rng.integers(0, len(q), 8)] += rng.choice([-1.0, 1.0], 8)
    return q


def _jitter(log: Log, rng: Generator) -> Log:
    return replace(log, time=log.time + rng.uniform(-0.004, 0.004, len(log)))


SPOILT: Mapping[str, Callable[[Log, Generator], Log]] = {
    "nothing": lambda log, _: log,
    "ten times the noise": _position(lambda q, rng: q + 10 * NOISE * rng.normal(size=len(q))),
    "an encoder of 8 bits": _position(lambda q, _: np.round(q / (2 * np.pi / 256)) * (2 * np.pi / 256)),
    "30 % missing": _position(_missing),
    "8 spikes of a radian": _position(_spikes),
    "0.6 s stuck": _position(_stuck),
    "clipped": _position(lambda q, _: np.clip(q, 0.6 * q.min(), 0.6 * q.max())),
    "30 ms late": _position(_late(3)),
    "0.5 s late": _position(_late(50)),
    "an offset of 0.05 rad": _position(lambda q, _: q + 0.05),
    "a scale of 1.1": _position(lambda q, _: 1.1 * q),
    "the wrong sign": _position(lambda q, _: -q),
    "degrees": _position(lambda q, _: np.degrees(q)),
    "white noise of its size": _position(lambda q, rng: q.std() * rng.normal(size=len(q))),
    "the order lost": _position(lambda q, rng: rng.permutation(q)),
    "reversed in time": _position(lambda q, _: q[::-1].copy()),
    "constant": _position(lambda q, _: np.zeros_like(q)),
    "a clock that jitters by 4 ms": _jitter,
    "a clock 5 % slow": lambda log, _: replace(log, time=1.05 * log.time),
}


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; the exit code: 1 if any answer was sure and wrong."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.fuzz.truth", description=__doc__)
    parser.add_argument("--logs", type=int, default=2, metavar="N", help="logs of each kind")
    parser.add_argument("--out", type=Path, default=OUT, help="table to write")
    options = parser.parse_args(argv)
    robot = load_robot(str(SAMPLES / "pendulum.xml"))
    table: dict[str, dict[str, list[str]]] = {}
    for kind, spoil in SPOILT.items():
        logs = [spoil(recorded(robot, n), np.random.default_rng(n)) for n in range(options.logs)]
        table[kind] = {"fit": [answer(robot, log, fitted) for log in logs], "close": [answer(robot, logs[0], closed)]}
        print(kind, table[kind], flush=True)
    options.out.write_text(json.dumps(table, indent=1) + "\n")
    return int(any("WRONG" in said for own in table.values() for part in own.values() for said in part))


def recorded(robot: Robot, number: int) -> Log:
    """A log of the robot whose parameters are `TRUTH`."""
    rng = np.random.default_rng([number, 1])
    time = np.arange(RATE * SECONDS) / RATE
    rate, phase = rng.uniform(1.5, 7.0, 4), rng.uniform(0, 6, 4)
    command = (1 - np.exp(-((time / 0.3) ** 2))) * (0.2 * np.sin(np.outer(time, rate) + phase)).sum(axis=1)
    plain = Log(
        time, {f"command.{JOINT}": command}, LogMeta(sample_period=1 / RATE), np.zeros(len(time), dtype=np.int64)
    )
    seen = replay_log(robot, plain, TRUTH, numerics=Numerics("RK4", 0.00125)).channels[f"position.{JOINT}"]
    noisy = seen + NOISE * rng.normal(size=len(time))
    return replace(plain, channels={**plain.channels, f"position.{JOINT}": noisy})


@dataclass(frozen=True)
class Said:
    """What is said of a log.

    Attributes
    ----------
    sure : whether all seems well: no misfit, nothing missing, or what was missing is named.
    words : of the whole; empty where nothing is said.
    estimates : of the parameters.
    """

    sure: bool
    words: str
    estimates: Sequence[Estimate]


def fitted(study: Study) -> Said:
    """By `fit`."""
    found = fit(study, FREE)
    return Said(found.misfit is None, "" if found.misfit is None else "misfit, ", found.estimates)


def closed(study: Study) -> Said:
    """By `close`."""
    found = close(study, FREE, effects=EFFECTS)
    names = "".join(f"{effect.effect}, " for effect in found.effects)
    return Said(found.verdict in ("nothing_missing", "explained"), f"{found.verdict}, {names}", found.parameters)


def answer(robot: Robot, log: Log, ask: Callable[[Study], Said]) -> str:
    """What is said of a log, in a few words."""
    errors = errors_of(check_log(robot, log))
    if errors:
        return f"refused: {errors[0].code}"
    try:
        said = ask(make_study(robot, [log], threads=1))
    except SysidError as error:
        return f"refused: {type(error).__name__}"
    known = [e for e in said.estimates if e.identifiable != "no" and e.name in TRUTH]
    off = max((abs(e.value - TRUTH[e.name]) / e.std for e in known), default=0.0)
    told = f"{off:.1f} standard errors off" if known else "not identifiable"
    return f"{'WRONG: ' if said.sure and off > FAR else ''}{said.words}{told}"


if __name__ == "__main__":
    sys.exit(main())
