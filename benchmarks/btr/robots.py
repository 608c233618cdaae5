"""Hidden robots in another engine (Drake) that differ from their model in ways that nobody declares."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import mujoco
import numpy as np

from benchmarks.btr_nao import FREE
from benchmarks.robots.machines import quadruped
from reference_simulator.legged import Ground, Truth
from sysid_btr.btr.controllers import ControllerSpace
from sysid_btr.btr.gaits import NaoGait, sine_gait
from sysid_btr.btr.task import Walk
from sysid_btr.models.builtin import load_robot
from sysid_btr.models.robot import Robot, robot_from_spec

TASK = Walk(8.0)


@dataclass(frozen=True, eq=False)
class Machine:
    """A legged robot as its model has it.

    Attributes
    ----------
    model, space : what it is, and what gaits are tried.
    free : parameters that the model declares.
    legs : joints of which one may be weak.
    trunk : body that carries a load.
    side, height : m, how far from the trunk's origin that sits at most, and above it.
    load, friction : kg and Nm, ranges.
    """

    model: Robot
    space: ControllerSpace
    free: Sequence[str]
    legs: Sequence[str]
    trunk: str
    side: float
    height: float
    load: tuple[float, float]
    friction: tuple[float, float]

    @property
    def bodies(self) -> tuple[str, ...]:
        return tuple(self.model.model.body(b).name for b in range(1, self.model.model.nbody))


def _nao() -> Machine:
    model, space = load_robot("nao"), NaoGait()
    legs = tuple(j for j in space.joints if any(part in j for part in ("Hip", "Knee", "Ankle")))
    return Machine(model, space, FREE, legs, "Torso", 0.03, 0.08, (0.2, 0.6), (0.05, 0.35))


def _quadruped() -> Machine:
    """7 kg on four legs of two joints: sines about the pose in which it stands."""
    model = robot_from_spec("quadruped", lambda: mujoco.MjSpec.from_string(quadruped()))
    space = sine_gait(model, frequency=1.5, reach=0.4)
    masses = ("mass:trunk", "mass:*_thigh=shared", "mass:*_shank=shared")
    free = (*masses, "kp:*=shared", "kv:*=shared")
    return Machine(model, space, free, space.joints, "trunk", 0.1, 0.08, (1.0, 2.5), (0.3, 2.0))


NAO, QUADRUPED = _nao(), _quadruped()


def spread(names: Sequence[str], low: float, high: float, seed: int) -> dict[str, float]:
    """Amounts drawn evenly, one a place."""
    return dict(zip(names, np.random.default_rng([seed, 50]).uniform(low, high, len(names)).tolist(), strict=True))


def contact(seed: int) -> Truth:
    return Truth()


def late(seed: int) -> Truth:
    return Truth(
        gain=0.88,
        delay=0.03,
        friction=spread(NAO.space.joints, 0.05, 0.25, 7),
        mass=spread(NAO.bodies, 0.86, 1.13, 8),
        payload={"Torso": (0.3, (0.0, 0.0, 0.07))},
        ground=Ground(friction=0.7),
    )


def rough(seed: int) -> Truth:
    return Truth(
        gain=0.8,
        delay=0.044,
        friction=spread(NAO.space.joints, 0.1, 0.35, 7),
        mass=spread(NAO.bodies, 0.8, 1.2, 8),
        ground=Ground(friction=0.9),
    )


def drawn(machine: Machine, seed: int) -> Truth:
    """One to three differences, drawn with their amounts."""
    rng = np.random.default_rng([seed, 60])
    joint, side = str(rng.choice(machine.legs)), float(rng.uniform(-machine.side, machine.side))
    differences: Sequence[Mapping[str, Any]] = (
        {"mass": spread(machine.bodies, 0.7, 1.4, seed)},
        {"gain": float(rng.uniform(0.75, 1.2))},
        {"delay": 0.002 * float(rng.integers(5, 24))},
        {"friction": spread(machine.space.joints, *machine.friction, seed)},
        {"payload": {machine.trunk: (float(rng.uniform(*machine.load)), (side, 0.0, machine.height))}},
        {"kp": {joint: float(rng.uniform(0.4, 0.7))}},
        {"ground": Ground(float(rng.uniform(0.5, 1.0)), float(10 ** rng.uniform(3.7, 5.0)))},
    )
    found: dict[str, Any] = {}
    for i in rng.permutation(len(differences))[: rng.integers(1, 4)]:
        found |= differences[i]
    return Truth(**found)


ROBOTS: Mapping[str, tuple[Machine, Callable[[int], Truth]]] = {
    "contact": (NAO, contact),
    "late": (NAO, late),
    "rough": (NAO, rough),
    "drawn": (NAO, partial(drawn, NAO)),
    "quadruped": (QUADRUPED, partial(drawn, QUADRUPED)),
}
