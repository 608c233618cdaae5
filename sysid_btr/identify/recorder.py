"""Whether a log was recorded in MuJoCo, and in which steps.

A simulator's step is an error to anyone who integrates finely, a few percent of a joint's damping in steps of 2 ms, and
what is not there would be named for it. In such a log it is part of the robot.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import product
from math import log

import numpy as np

from sysid_btr._typing import FloatArray
from sysid_btr.estimators.lsq import linearise
from sysid_btr.identify.coarse import nearby
from sysid_btr.identify.refit import shorten
from sysid_btr.identify.study import Study
from sysid_btr.objectives.problem import ReplayProblem
from sysid_btr.simulation.numerics import INTEGRATORS, MUJOCO, Numerics
from sysid_btr.terms.model import Model

MEASURED = "measured"
"""`LogMeta.source` of a log that no simulator recorded."""
SECONDS = 4.0
"""Part of each log on which steps are compared."""
FIRST_ORDER = ("Euler", "implicitfast")
"""Integrators whose step shows."""
USUAL_STEPS = (0.0005, 0.001, 0.002, 0.0025, 0.004, 0.005, 0.01)
"""s, beside that of the model's options: of MuJoCo itself, and of collections of models and tasks for it."""
HALF = log(2.0)
"""Mean decrease of the logarithm of the columns' excess from which the log was recorded in some steps: half of it must
be gone in each, which an effect that steps resemble does not do at every joint."""
FITTED = 3
"""Steps in which parameters are fitted again, those that seem likely to first order."""
CHANCE = 3.0
"""Standard deviations of chi2 at the floor below which an excess is none."""


def as_recorded(study: Study, model: Model) -> Study:
    """The study in the steps of a MuJoCo that recorded it, where a model moves as the log does in these alone."""
    others = list(_other_steps(study))
    if not others:
        return study
    short = replace(shorten(study, SECONDS), numerics=study.numerics)
    problem = short.train_problem(model)
    residual, jacobian = linearise(problem, model.values, step=study.stencil(model.terms))
    jacobian = np.nan_to_num(jacobian)
    now = _excess(problem, _beside(residual, jacobian))
    if now < _excess(problem, np.zeros(len(residual))) + HALF:
        return study
    seen = {}
    for numerics in others:
        moved = problem.with_numerics(numerics).residuals(model.values[None])[0]
        if np.isfinite(moved).all():
            seen[numerics] = _excess(problem, _beside(moved, jacobian))
    likely = sorted((n for n in seen if seen[n] < now - HALF), key=lambda n: (n != others[0], seen[n]))[:FITTED]
    left = {n: _refitted_excess(replace(short, numerics=n), n, model) for n in likely}
    if not left:
        return study
    # the model's own steps come first: others must leave half of what these do
    best = min(likely, key=lambda n: left[n] + HALF * (n != others[0]))
    now = _refitted_excess(short, study.cheap, model)
    return replace(study, numerics=best) if left[best] < now - HALF else study


def _refitted_excess(study: Study, cheap: Numerics, model: Model) -> float:
    """The excess once the parameters have followed."""
    _, near = nearby(study, cheap, model)
    problem = study.train_problem(near)
    return _excess(problem, problem.residuals(near.values[None])[0])


def _other_steps(study: Study) -> Iterator[Numerics]:
    """Steps in which the logs may have been recorded; none where others are stated, or a robot was measured."""
    now, options = study.numerics, study.robot.model.opt
    if now.exact or now.servo_period or now.simulator != MUJOCO or not study.procedure.refines_step:
        return
    logs = [e.recording for e in study.train]
    if any(one.meta.source == MEASURED for one in logs):
        return
    own = (INTEGRATORS[int(options.integrator)], float(options.timestep))
    period = min(float(np.median(np.diff(one.time))) for one in logs)
    for name, step in dict.fromkeys((own, *product(FIRST_ORDER, USUAL_STEPS))):
        steps = period / step
        if name in FIRST_ORDER and steps > 0.999 and abs(steps - round(steps)) < 1e-3 * steps:
            yield Numerics(name, step, recorded=True)


def _beside(residual: FloatArray, jacobian: FloatArray) -> FloatArray:
    """What parameters leave of a residual (r,), to first order."""
    return np.asarray(residual - jacobian @ np.linalg.lstsq(jacobian, residual, rcond=None)[0])


def _excess(problem: ReplayProblem, residual: FloatArray) -> float:
    """Mean over the columns of the logarithm of what chi2 has above 1, or may have by chance."""
    chance = CHANCE * np.sqrt(2 / np.maximum(problem.counts, 1))
    return float(np.mean(np.log(np.maximum(problem.column_chi2(residual) - 1, chance))))
