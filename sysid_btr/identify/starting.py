"""Where a whole replay starts: the state that the log and the model want together.

The first samples alone give a velocity that their noise, and a motion that bends, leave far from known, and what is
wrong with it lasts until the servos have forgotten it.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sysid_btr._typing import FloatArray
from sysid_btr.estimators.linearisation import linearise
from sysid_btr.objectives.problem import Comparison, Conditional, ReplayProblem
from sysid_btr.objectives.targets import Target
from sysid_btr.simulation.start import Start, start_error
from sysid_btr.terms.initial_state import StartPosition, StartVelocity

SECONDS = 1.0
"""Part of a log that tells where it starts: servos that take longer to forget it are too weak to hold a joint."""
STEPS = 2
"""Of Gauss-Newton: a state is changed by little."""


def wanted_start(comparison: Comparison, values: FloatArray) -> Start:
    """The state in which a replay begins that fits its first second best, with that of the first samples as its prior.

    Parameters
    ----------
    comparison : of a whole replay. Errors of its model count by the size that its targets give them.
    values : (p,) the candidate.

    Returns
    -------
    Start
        As it is where its correction is a parameter, where no joint has a position, or where the replay fails.
    """
    replay, log = comparison.replay, comparison.replay.log
    here = Start(*replay.start)
    joints = tuple(j for j in replay.index.joints if log.has("position", j))
    if not joints or any(isinstance(t, StartPosition | StartVelocity) for t in replay.terms):
        return here
    stop = max(int(np.searchsorted(log.time, log.time[0] + SECONDS)), 2)
    targets = tuple(_first(t, stop) for t in comparison.targets if t.channel in ("position", "velocity"))
    if not targets:
        return here
    which, count = replay.index.of(joints), len(joints)
    known = _start_errors(comparison, joints)
    first = replace(replay, begun=None).start
    prior = np.concatenate([x[which] for x in first])
    terms = (*replay.terms, StartPosition(joints), StartVelocity(joints))
    window = log.window(0, stop)
    for _ in range(STEPS):
        short = replace(replay, log=window, terms=terms, effort=False, begun=here)
        start = np.concatenate([values, np.zeros(2 * count)])
        problem = ReplayProblem((Comparison(short, targets),), start)
        if not np.isfinite(problem.residuals(start[None])).all():
            return here
        own = Conditional(problem, np.arange(len(start)) >= len(values), start)
        residual, jacobian = linearise(own, own.start)
        off = np.concatenate([here.position[which], here.velocity[which]]) - prior
        information = jacobian.T @ jacobian + np.diag(known**-2)
        change = -np.linalg.solve(information, jacobian.T @ residual + off * known**-2)
        position, velocity = here.position.copy(), here.velocity.copy()
        position[which] += change[:count]
        velocity[which] += change[count:]
        here = Start(position, velocity)
    return here


def _start_errors(comparison: Comparison, joints: tuple[str, ...]) -> FloatArray:
    """Standard deviations (2 k,) of positions, then velocities of some joints at the first sample: `start_error`."""
    log = comparison.replay.log
    noise = {
        j: float(t.noise[k]) for t in comparison.targets if t.channel == "position" for k, j in enumerate(t.joints)
    }
    return np.array([start_error(log, joint, noise.get(joint, np.inf)) for joint in joints]).T.ravel()


def _first(target: Target, stop: int) -> Target:
    """The first samples of a target, all of which count."""
    measured = target.measured[:stop]
    return replace(target, measured=measured, mask=np.isfinite(measured))
