"""Masses from a walk without any model of the ground.

Whatever the ground does, it acts on the feet alone. What each sample adds to those before it (`innovations`) depends on
the masses, and holds on springs, on carpet and on gravel.
"""

from __future__ import annotations

from functools import partial

import numpy as np

from sysid_btr._typing import FloatArray
from sysid_btr.errors import ModelError
from sysid_btr.estimators.linearisation import linearise
from sysid_btr.floating_base.chain import suits
from sysid_btr.floating_base.innovations import InnovationsEpisode, InnovationsProcedure
from sysid_btr.floating_base.segments import FloatingReplay
from sysid_btr.objectives.covariance import Known, covariance
from sysid_btr.objectives.problem import Comparison, Conditional, ReplayProblem

ROUNDS = 6
"""Times that states and numbers are found in turn, at most."""
SETTLED = 0.25
"""Standard errors by which a step moves an estimate when it is the last."""


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
    walks = [r for r in replays if isinstance(r, FloatingReplay) and suits(r)]
    free = np.array([not p.name.startswith("foot_") for p in problem.parameters])
    if len(walks) < len(replays) or not free.any():
        return None
    now, begun, span = values.copy(), values[free], (problem.upper - problem.lower)[free]
    belief = np.diag(1 / span)
    episodes = [_episode(walk) for walk in walks]
    numerics, _ = episodes[0].choose_numerics()
    cheap = episodes[0].procedure.cheap(numerics)

    def compare(episode: InnovationsEpisode) -> Comparison:
        return episode.compare(problem.terms, ("position",), numerics, threads=walks[0].threads)

    settled = False
    for _ in range(ROUNDS):
        try:
            episodes = [e.with_initial_states(partial(compare, e), now, numerics) for e in episodes]
        except ModelError:
            return None
        walked = ReplayProblem(tuple(map(compare, episodes)), now, problem.executor)
        seen = Conditional(walked, free, now).residuals(now[None, free])[0]
        _, slope = linearise(Conditional(walked.with_numerics(cheap), free, now), now[free])
        residual, jacobian = np.concatenate([belief @ (now[free] - begun), seen]), np.concatenate([belief, slope])
        if not (np.isfinite(residual).all() and np.isfinite(jacobian).all()):
            return None
        information = jacobian.T @ jacobian
        change = -np.linalg.solve(information, jacobian.T @ residual)
        mean = now[free] + change
        moved = np.clip(mean, problem.lower[free], problem.upper[free])
        std = np.sqrt(np.diag(np.linalg.inv(information)))
        settled = bool(np.all(np.abs(moved - now[free]) <= SETTLED * std))
        if settled:
            break
        now[free] = moved
    misfit = max(e.filter.misfit for e in episodes if e.filter is not None)
    if not settled or misfit > InnovationsProcedure.tolerated:
        return None
    blocks = np.concatenate([walked.blocks.max() + 1 + np.arange(len(belief)), walked.blocks])
    # beyond a bound, if there: what else is known of the others may bring it back
    return Known(np.flatnonzero(free), mean, covariance(jacobian, residual + jacobian @ change, blocks))


def _episode(walk: FloatingReplay) -> InnovationsEpisode:
    """A walk that was cut into segments, sample by sample."""
    assert walk.base is not None
    return InnovationsEpisode(walk.robot, walk.log, np.ones(len(walk.log), dtype=bool), walk.base)
