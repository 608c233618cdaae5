"""Whether a log was recorded in MuJoCo, and in which steps.

A simulator's step is an error to anyone who integrates finely, a few percent of a joint's damping in steps of 2 ms, and
what is not there would be named for it. In such a log it is part of the robot.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from math import log

import numpy as np

from sysid_btr._typing import FloatArray
from sysid_btr.estimators.linearisation import linearise
from sysid_btr.identify.projection import explained_by
from sysid_btr.identify.refit import nearby, shorten
from sysid_btr.identify.study import Study
from sysid_btr.objectives.problem import ReplayProblem
from sysid_btr.simulation.numerics import INTEGRATORS, MUJOCO, Numerics
from sysid_btr.terms.model import Model

MEASURED = "measured"
"""`LogMeta.source` of a log that no simulator recorded."""
SECONDS = 12.0
"""Part of each log on which steps are compared."""
FIRST_ORDER = ("Euler", "implicitfast")
"""Integrators whose step shows."""
USUAL_STEPS = (0.0005, 0.001, 0.002, 0.0025, 0.004, 0.005)
"""s, beside that of the model's options: of MuJoCo itself, and of collections of models and tasks for it."""
HALF = log(2.0)
"""Mean decrease, to first order, of the logarithm of the columns' excess from which steps are looked at: half of it."""
FITTED = 4
"""Steps in which parameters are fitted again, those of the model first."""
TURNS = 2
"""Times that these, and where the replay starts, follow each other."""
CLEAR = 2 * log(100.0)
"""Decrease of a sum of squares over the noise by which the model file's own steps are 100 times as likely."""
FLOOR, CHANCE = 0.1, 3.0
"""Chi2 above 1 of a column in which nothing is left: noise floors are known to a few percent; and standard deviations
of chance on top. Steps must leave nothing: what is missing beside them is found first, and what they resemble, such as
damping at every joint in proportion to its gain, is hardly ever as exactly that."""


def as_recorded(study: Study, model: Model) -> Study:
    """The study in the steps of a MuJoCo that recorded it, where a model moves as the log does in these alone.

    Where it does in both, as far as chi2 tells, the likelihood decides on the model file's own steps.
    """
    others = tuple(_other_steps(study))
    if not others:
        return study
    short = replace(shorten(study, SECONDS), numerics=study.numerics)
    likely = _likely(short, model, others)
    left = {n: _refitted(replace(short, numerics=n), n, model) for n in likely}
    alike = [n for n in left if not _is_above(left[n].excess)]
    if not alike:
        return study
    here = _refitted(short, study.cheap, model)
    if not _is_above(here.excess):
        file = _of_the_file(study, others)
        alike = [n for n in alike if n == file and left[n].square < here.square - CLEAR]
    best = min(alike, key=lambda n: _file_first(study, n, _mean(left[n].excess)), default=study.numerics)
    return study if best == study.numerics else replace(study, numerics=best)


def _likely(study: Study, model: Model, others: Sequence[Numerics]) -> list[Numerics]:
    """The steps in which a model, to first order, may move as the log does; those of the model file first."""
    problem = study.train_problem(model)
    if not np.isfinite(problem.residuals(model.values[None])).all():
        return []
    residual, jacobian = linearise(problem, model.values, step=study.stencil(model.terms))
    jacobian = np.nan_to_num(jacobian)
    now = _excess(problem, residual - explained_by(jacobian, residual))
    seen: dict[Numerics, float] = {}
    for numerics in others if _is_above(now) else ():
        moved = problem.with_numerics(numerics).residuals(model.values[None])[0]
        if np.isfinite(moved).all():
            there = _excess(problem, moved - explained_by(jacobian, moved))
            if not _is_above(there) or _mean(there) < _mean(now) - HALF:
                seen[numerics] = _mean(there)
    file = _of_the_file(study, others)
    # derivatives reach too short for the steps of another: those of the file are the likeliest
    if file is not None and (seen or (not _is_above(now) and _shows(problem, file, model, residual, jacobian))):
        seen.setdefault(file, _mean(now))
    return sorted(seen, key=lambda n: _file_first(study, n, seen[n]))[:FITTED]


def _file_first(study: Study, numerics: Numerics, left: float) -> tuple[bool, float]:
    """Where steps come in the order of what they leave, those as long as the model file's first."""
    return numerics.timestep != float(study.robot.model.opt.timestep), left


def _shows(
    problem: ReplayProblem, numerics: Numerics, model: Model, residual: FloatArray, jacobian: FloatArray
) -> bool:
    """Whether parameters cannot do what other steps change, as far as a likelihood tells."""
    change = problem.with_numerics(numerics).residuals(model.values[None])[0] - residual
    change = change - explained_by(jacobian, change)
    return bool(change @ change > CLEAR)


@dataclass(frozen=True, eq=False)
class _Left:
    """What steps leave once parameters have followed: by column, and the sum of squares over the noise."""

    excess: FloatArray
    square: float


def _refitted(study: Study, cheap: Numerics, model: Model) -> _Left:
    """What is left once the parameters, and where the replay starts, have followed."""
    for _ in range(TURNS):
        _, model = nearby(study, cheap, model)
        study = study.with_initial_states(model, held_out=False)
    problem = study.train_problem(model)
    residual = problem.residuals(model.values[None])[0]
    return _Left(_excess(problem, residual), float(residual @ residual))


def _of_the_file(study: Study, others: Iterable[Numerics]) -> Numerics | None:
    """Of other steps those of the model file; None where no log can have been recorded in them."""
    own = study.robot.model.opt
    same = (
        numerics
        for numerics in others
        if (numerics.timestep, INTEGRATORS.index(numerics.integrator)) == (own.timestep, own.integrator)
    )
    return next(same, None)


def own_steps(study: Study) -> Numerics | None:
    """Those of the model file; None where no log can have been recorded in them, or noise hides a step's error."""
    if (numerics := _of_the_file(study, _other_steps(study))) is None:
        return None
    problem, plain = shorten(replace(study, inflation={}), SECONDS).train_problem(()), np.zeros((1, 0))
    change = problem.with_numerics(numerics).residuals(plain)[0] - problem.residuals(plain)[0]
    return numerics if np.isfinite(change).all() and float(problem.column_chi2(change).max()) > 1 else None


def _other_steps(study: Study) -> Iterator[Numerics]:
    """Steps in which the logs may have been recorded; none where others are stated, or a robot was measured."""
    now = study.numerics
    if now.exact or now.servo_period or now.simulator != MUJOCO or not study.procedure.refines_step:
        return
    logs = [e.recording for e in study.train]
    if any(one.meta.source == MEASURED for one in logs):
        return
    period = min(float(np.median(np.diff(one.time))) for one in logs)
    for step in dict.fromkeys((float(study.robot.model.opt.timestep), *USUAL_STEPS)):
        steps = period / step
        if steps > 0.999 and abs(steps - round(steps)) < 1e-3 * steps:
            yield from (Numerics(name, step, recorded=True) for name in FIRST_ORDER)


def _excess(problem: ReplayProblem, residual: FloatArray) -> FloatArray:
    """(columns,) what chi2 has above 1, over what that may be by chance and by a floor that is not quite known."""
    chance = FLOOR + CHANCE * np.sqrt(2 / np.maximum(problem.counts, 1))
    return np.asarray((problem.column_chi2(residual) - 1) / chance)


def _is_above(excess: FloatArray) -> bool:
    return bool(np.any(excess > 1))


def _mean(excess: FloatArray) -> float:
    """Mean logarithm of what is above the floor."""
    return float(np.mean(np.log(np.maximum(excess, 1))))
