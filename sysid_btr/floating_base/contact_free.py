"""Masses from a walk without any model of the ground.

Whatever the ground does, it acts on the feet alone. What is left of a chain of steps, whose states and forces are at
their best (`chain`), depends on the masses, and holds on springs, on carpet and on gravel.
"""

from __future__ import annotations

import numpy as np

from sysid_btr._typing import FloatArray
from sysid_btr.floating_base.chain import (
    LATE,
    NUDGE_NUMBER,
    chain_of,
    derive,
    likeliest,
    linearise_chain,
    moved_chain,
    simulate_chain,
    suits,
)
from sysid_btr.floating_base.segments import FloatingReplay
from sysid_btr.objectives.covariance import Known, covariance
from sysid_btr.objectives.problem import ReplayProblem

ROUNDS = 6
"""Gauss-Newton steps at most; the first moves states alone."""
SETTLED = 0.25
"""Standard errors by which a step moves an estimate when it is the last."""
SIZED = 3
"""Of these the first in which the size of jolts is chosen anew, once states have moved."""
MISFIT = 1.0
"""Cost over number of measured values beyond which something else is missing than a ground. Right models leave 0.3 to
0.55 (the rest goes into what is unknown), a delay of 40 ms leaves 5."""


def without_ground(problem: ReplayProblem, values: FloatArray) -> Known | None:
    """Parameters from the walks where nothing is known of the ground.

    Parameters
    ----------
    problem : of walks alone.
    values : (p,) the candidate to begin at. Parameters of the ground stay there, and have no say.

    Returns
    -------
    Known or None
        All parameters but those of the ground. None where the logs or the model do not suit (servos with a clock of
        their own, joints with play, effects with a memory, irregular samples), where the walks contradict the model
        whatever the ground does, and where no estimate is found.
    """
    replays = [e.replay for e in problem.episodes]
    chains = [chain_of(r) for r in replays if isinstance(r, FloatingReplay) and suits(r)]
    free = np.flatnonzero([not p.name.startswith("foot_") for p in problem.parameters])
    if len(chains) < len(replays) or len(free) == 0:
        return None
    span = (problem.upper - problem.lower)[free]
    # the last number is by how much sensors and commands are apart in time
    belief = np.diag(1 / np.append(span, LATE))
    known = [derive(chain, values) for chain in chains]
    begun, now = values[free], values.copy()
    settled = False
    for k in range(ROUNDS):
        ends = [simulate_chain(chain, now, free, NUDGE_NUMBER * span) for chain in chains]
        if 0 < k < SIZED:
            chains = [likeliest(*parts) for parts in zip(chains, known, ends, strict=True)]
        rounds = [linearise_chain(*parts) for parts in zip(chains, known, ends, strict=True)]
        if not all(np.isfinite(r.surprise) for r in rounds):
            return None
        jacobian = np.concatenate([belief, *(r.left[:, 1:] for r in rounds)])
        residual = np.concatenate([belief @ np.append(now[free] - begun, 0.0), *(r.left[:, 0] for r in rounds)])
        information = jacobian.T @ jacobian
        change = np.zeros(len(free) + 1) if k == 0 else -np.linalg.solve(information, jacobian.T @ residual)
        mean = now[free] + change[:-1]
        moved = np.clip(mean, problem.lower[free], problem.upper[free])
        change[:-1], now[free] = moved - now[free], moved
        chains = [moved_chain(c, d, r, change) for c, d, r in zip(chains, known, rounds, strict=True)]
        std = np.sqrt(np.diag(np.linalg.inv(information)))
        settled = k >= SIZED - 1 and bool(np.all(np.abs(change[:-1]) <= SETTLED * std[:-1]))
        if settled:
            break
    residual = residual + jacobian @ change
    count = sum(int(np.isfinite(c.sigma).sum()) for c in chains)
    if not settled or float(residual @ residual) > MISFIT * count:
        return None
    ends_at = np.cumsum([0, *(int(r.blocks.max()) + 1 for r in rounds)])
    own = np.arange(len(belief)) + ends_at[-1]
    labels = [r.blocks + at for r, at in zip(rounds, ends_at, strict=False)]
    cov = covariance(jacobian, residual, np.concatenate([own, *labels]))
    # beyond a bound, if there: what else is known of the others may bring it back
    return Known(free, mean, cov[:-1, :-1])
