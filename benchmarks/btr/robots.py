"""Hidden robots: Naos in another engine (Drake) that differ from their model in ways that nobody declares."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from reference_simulator.legged import Ground, Truth
from sysid_btr.btr.gaits import NaoGait
from sysid_btr.btr.task import Walk
from sysid_btr.models.builtin import load_robot

TASK, SPACE, NAO = Walk(8.0), NaoGait(), load_robot("nao")
BODIES = tuple(NAO.model.body(b).name for b in range(1, NAO.model.nbody))
LEGS = tuple(j for j in SPACE.joints if any(part in j for part in ("Hip", "Knee", "Ankle")))


def spread(names: Sequence[str], low: float, high: float, seed: int) -> dict[str, float]:
    """Amounts drawn evenly, one a place."""
    return dict(zip(names, np.random.default_rng([seed, 50]).uniform(low, high, len(names)).tolist(), strict=True))


def contact(seed: int) -> Truth:
    return Truth()


def late(seed: int) -> Truth:
    return Truth(
        gain=0.88,
        delay=0.03,
        friction=spread(SPACE.joints, 0.05, 0.25, 7),
        mass=spread(BODIES, 0.86, 1.13, 8),
        payload={"Torso": (0.3, (0.0, 0.0, 0.07))},
        ground=Ground(friction=0.7),
    )


def rough(seed: int) -> Truth:
    return Truth(
        gain=0.8,
        delay=0.044,
        friction=spread(SPACE.joints, 0.1, 0.35, 7),
        mass=spread(BODIES, 0.8, 1.2, 8),
        ground=Ground(friction=0.9),
    )


def drawn(seed: int) -> Truth:
    """One to three differences, drawn with their amounts."""
    rng = np.random.default_rng([seed, 60])
    joint, side = str(rng.choice(LEGS)), float(rng.uniform(-0.03, 0.03))
    differences: Sequence[Mapping[str, Any]] = (
        {"mass": spread(BODIES, 0.7, 1.4, seed)},
        {"gain": float(rng.uniform(0.75, 1.2))},
        {"delay": 0.002 * float(rng.integers(5, 24))},
        {"friction": spread(SPACE.joints, 0.05, 0.35, seed)},
        {"payload": {"Torso": (float(rng.uniform(0.2, 0.6)), (side, 0.0, 0.08))}},
        {"kp": {joint: float(rng.uniform(0.4, 0.7))}},
        {"ground": Ground(float(rng.uniform(0.5, 1.0)), float(10 ** rng.uniform(3.7, 5.0)))},
    )
    found: dict[str, Any] = {}
    for i in rng.permutation(len(differences))[: rng.integers(1, 4)]:
        found |= differences[i]
    return Truth(**found)


ROBOTS: Mapping[str, Callable[[int], Truth]] = {"contact": contact, "late": late, "rough": rough, "drawn": drawn}
