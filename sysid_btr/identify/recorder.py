"""Whether a log was recorded in MuJoCo itself, in the steps of the model's own options.

A simulator's step is an error to anyone who integrates finely, a few percent of a joint's damping in steps of 2 ms, and
what is not there would be named for it. In such a log it is part of the robot.
"""

from __future__ import annotations

from dataclasses import replace
from math import log

from sysid_btr.identify.coarse import nearby
from sysid_btr.identify.refit import shorten
from sysid_btr.identify.study import Study
from sysid_btr.simulation.numerics import INTEGRATORS, MUJOCO, Numerics
from sysid_btr.terms.model import Model

MEASURED = "measured"
"""`LogMeta.source` of a log that no simulator recorded."""
SECONDS = 4.0
"""Part of each log on which the two are compared."""
HALF = log(2.0)
"""Mean decrease of the columns' log chi2 from which the log was recorded in these steps: in each, half of what is left
must be gone, which an effect that they resemble does not do at every joint."""
WHY = "the log moves as the model does in its own steps"


def as_recorded(study: Study, model: Model) -> Study:
    """The study in the steps of the model's own options, where a model moves as the log does in these alone."""
    own = own_numerics(study)
    if own is None:
        return study
    short = shorten(study, SECONDS)
    misfit, near = nearby(replace(short, numerics=study.numerics), study.cheap, model)
    other, _ = nearby(replace(short, numerics=own), own, near)
    return replace(study, numerics=own, numerics_why=WHY) if other < misfit - HALF else study


def own_numerics(study: Study) -> Numerics | None:
    """The steps of the model's own options; None where they cannot be those of the logs, or others are stated."""
    now, options = study.numerics, study.robot.model.opt
    if now.exact or now.servo_period or now.simulator != MUJOCO or not study.procedure.refines_step:
        return None
    if any(e.recording.meta.source == MEASURED for e in study.train):
        return None
    from mujoco import mjtIntegrator

    name = mjtIntegrator(options.integrator).name.removeprefix("mjINT_").casefold()
    integrator = next(known for known in INTEGRATORS if known.casefold() == name)
    return Numerics(integrator, float(options.timestep), stated=True)
