"""How long a replay can be followed: as long as changes of its start, of the masses, and its error act in proportion.

What is known of a start is integrated out along derivatives, and a fit steps along them: both need responses whose
curved part is small beside the linear one (Bates and Watts 1980, doi:10.1111/j.2517-6161.1980.tb01094.x). Where errors
grow exponentially that ends after some Lyapunov times, and beyond it the objective is rough (Ribeiro et al. 2020,
doi:10.1016/j.automatica.2020.109158); where a servo or friction takes them back it never does. What a model lacks is a
change too, as large as the error that it makes: the curved part of an oscillation's response is to its linear one as
the response is to the oscillation, so an error that is a good part of the motion is no longer in proportion to its
cause.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sysid_btr._typing import FloatArray
from sysid_btr.identify.numerics import largest_step
from sysid_btr.io.log import Log
from sysid_btr.io.noise import position_noise
from sysid_btr.models.robot import Robot, joint_names, servo_joints
from sysid_btr.simulation.segments import SegmentReplay, Segments
from sysid_btr.simulation.silence import silenced
from sysid_btr.terms.grammar import parse_parameters
from sysid_btr.terms.model import Terms

CURVED = 0.5
"""Curved part of a response over its linear one up to which it counts as linear: half of a step is then wrong."""


def is_held(robot: Robot, log: Log) -> bool:
    """Whether every joint of the model whose position is logged has a position servo, which takes errors back."""
    configured = robot.for_log(log)
    servos = servo_joints(configured)
    return all(joint in servos for joint in joint_names(configured) if log.has("position", joint))


def linear_seconds(robot: Robot, log: Log, segments: Segments, threads: int = 0) -> tuple[FloatArray, FloatArray]:
    """How long the replay of each segment by the plain model stays linear, and near the log.

    Changes are one standard deviation of each number of the start, and one `scale` of each body's mass.

    Parameters
    ----------
    robot, log : plain model, and what it is replayed on.
    segments : long ones, with initial states; they may overlap.
    threads : worker threads, 0 for all cores.

    Returns
    -------
    linear, near : (w,) each, s: until changes of start and masses, and until the error of the model itself, do not act
        in proportion any more; all of a segment where they do to the end.
    """
    terms = Terms(parse_parameters(["mass:*"], robot))
    whole = SegmentReplay(robot.for_log(log), log, tuple(terms), largest_step(log), threads=threads, segments=segments)
    names = whole.index.joints
    joints = [i for i, j in enumerate(names) if log.has("position", j)]
    sigma = position_noise(log, [names[i] for i in joints])
    measured = log.array("position", [names[i] for i in joints])
    nominal, step = terms.nominal, np.diag(terms.scale)
    candidates = np.concatenate([nominal[None], nominal + step, nominal - step])
    identity = np.eye(segments.std.shape[1])
    linear, near = np.zeros((2, len(segments)))
    for w, (a, b) in enumerate(segments.rows):
        replay = replace(whole, segments=segments.chosen(np.array([w])))
        directions = segments.std[w] * np.concatenate([0 * identity[:1], identity, -identity])
        with silenced():
            by_mass = replay.predict(candidates).position[:, a:b]
            by_start = next(outputs.position for _, outputs in replay.respond(nominal, directions))
        time = log.time[a:b] - log.time[a]
        end = min(_linear(x[:, :, joints] / sigma) for x in (by_mass, by_start))
        error = measured[a:b] - by_mass[0][:, joints]
        near[w] = time[_small(error / sigma, measured[a:b] / sigma) - 1]
        linear[w] = time[end - 1]
    return linear, near


def _linear(white: FloatArray) -> int:
    """Samples, at least one, up to which every response is linear.

    Parameters
    ----------
    white : (1 + 2 d, n, j) positions in noise floors: unchanged, and changed by d amounts up and down.
    """
    d = (len(white) - 1) // 2
    up, down = white[1 : 1 + d] - white[:1], white[1 + d :] - white[:1]
    count = np.arange(1, white.shape[1] + 1)
    linear, curved = (
        np.sqrt(np.cumsum(np.sum(x**2, axis=2), axis=1) / count) for x in ((up - down) / 2, (up + down) / 2)
    )
    # what is below the noise shows nothing
    fine = (curved <= CURVED * linear) | (curved <= 1.0)
    bad = np.flatnonzero(~fine.all(axis=0))
    return max(int(bad[0]), 1) if len(bad) else int(count[-1])


def _small(error: FloatArray, measured: FloatArray) -> int:
    """Samples, at least one, up to which an error (n, j) is small beside the motion; both in noise floors."""
    count = np.arange(1, len(error) + 1)
    size = np.sqrt(np.cumsum(np.nansum(error**2, axis=1)) / count)
    motion = np.sqrt(np.nansum(np.nanvar(measured, axis=0)))
    large = np.flatnonzero(~(size <= max(CURVED * float(motion), 1.0)))
    return max(int(large[0]), 1) if len(large) else len(error)
