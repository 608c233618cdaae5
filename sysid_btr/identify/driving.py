"""What moves a torque drive in a replay: the torque that it was asked for, or the one that it was measured to give.

Where both are logged and differ, either the drive gave another torque than it was asked for, or the sensor shows
another one than it gave. The motion decides. Dynamic identification takes what was measured (Swevers, Verdonck and De
Schutter 2007, doi:10.1109/MCS.2007.904659); a sensor that is wrong moves the model further from the log.
"""

from __future__ import annotations

import numpy as np

from sysid_btr.estimators.linearisation import linearise
from sysid_btr.identify.numerics import largest_step
from sysid_btr.identify.segmented import SegmentedEpisode, follow
from sysid_btr.io.log import Log
from sysid_btr.io.noise import channel_noise
from sysid_btr.models.commands import as_measured, commanded
from sysid_btr.models.robot import Robot
from sysid_btr.objectives.problem import Comparison, ReplayProblem
from sysid_btr.simulation.silence import silenced
from sysid_btr.terms.grammar import parse_parameters
from sysid_btr.terms.model import Terms

FRICTION = ("frictionloss:*", "damping:*")
"""What hardly any model of a joint has right, and what a torque that is too large or too small would pass for."""
STEP = 1e-3
"""Finite-difference step, fraction of a parameter's range."""
OTHER = 1.5
"""Chi2 of a measured torque, against the one that was asked for, from which it is another one (`coarse.MISFIT`)."""


def measured_torques(robot: Robot, log: Log, threads: int = 0) -> Log | None:
    """The log with torque drives moved by their measured torques, if these explain its motion better; else None."""
    configured = robot.for_log(log)

    def better() -> bool:
        seconds = follow(robot, log, threads)
        given, asked = (_misfit(robot, one, seconds, threads) for one in (measured, log))
        return given < asked

    measured = as_measured(log, configured.model)
    if not _differ(commanded(log, configured.model), commanded(measured, configured.model)):
        return None
    return measured if log.once(("torques", robot.fingerprint, robot.at), better) else None


def _differ(asked: Log, given: Log) -> bool:
    """Whether some drive is measured to give another torque than it is asked for, beyond the sensor's noise."""
    for name, torque in given.channels.items():
        if name.startswith("command.") and name in asked.channels and not np.array_equal(torque, asked.channels[name]):
            noise = channel_noise(given, name.replace("command.", "effort.")).sigma
            if np.nanmean((torque - asked.channels[name]) ** 2) > OTHER * noise**2:
                return True
    return False


def _misfit(robot: Robot, log: Log, seconds: float, threads: int) -> float:
    """Sum over positions of the logarithm of what the plain model leaves beside friction, to first order."""
    from scipy.optimize import lsq_linear

    terms, numerics = Terms(parse_parameters(FRICTION, robot)), largest_step(log)
    episode = SegmentedEpisode.whole(robot, log, threads, seconds=seconds)

    def compared(episode: SegmentedEpisode) -> Comparison:
        return episode.compare(terms, ("position",), numerics, threads=threads)

    episode = episode.with_initial_states(lambda: compared(episode), terms.nominal, numerics)
    problem = ReplayProblem((compared(episode),), terms.nominal)
    with silenced():
        if not np.isfinite(problem.residuals(terms.nominal[None])).all():
            return np.inf
        residual, jacobian = linearise(problem, terms.nominal, step=STEP)
    amount = lsq_linear(jacobian, -residual, bounds=(0.0, np.inf)).x
    return float(np.sum(np.log(problem.column_chi2(residual + jacobian @ amount))))
