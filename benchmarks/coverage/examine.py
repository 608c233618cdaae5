"""Fit one log, and hold its intervals against the truth."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping
from functools import cache
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING

import numpy as np

from benchmarks.coverage.draw import Case, recipe_state
from benchmarks.coverage.table import Row

if TYPE_CHECKING:
    from sysid_btr.identify.fit import Fit
    from sysid_btr.identify.intervals import Estimate

    Outcome = tuple[tuple[Estimate, ...], bool]
DECISIVE = ("estimators", "identify", "models", "objectives", "posterior", "replay")
"""Packages that decide what an interval is."""


def least_squares(found: Fit) -> Outcome:
    """The intervals of `fit`."""
    return found.estimates, True


def posterior_draws(found: Fit) -> Outcome:
    """The intervals of `posterior`, from fewer draws than it makes by default: enough for the ends of intervals."""
    from sysid_btr.posterior import posterior
    from sysid_btr.posterior.sampling import Settings

    # 300 effective draws leave an end of a 95 % interval uncertain by 0.15 standard deviations
    drawn = posterior(found, settings=Settings(draws=300, autocorrelation_times=20, fewest_steps=20, rhat=1.05))
    return drawn.estimates, drawn.converged


ESTIMATORS: Mapping[str, Callable[[Fit], Outcome]] = {"lsq": least_squares, "posterior": posterior_draws}


def examine(case: Case, estimator: str, plant: str, threads: int = 1) -> list[Row]:
    """One row a declared parameter."""
    from sysid_btr.identify.fit import fit
    from sysid_btr.identify.numerics import choose_numerics
    from sysid_btr.identify.study import make_study
    from sysid_btr.models.builtin import load_robot

    robot = load_robot(str(case.bench.model))
    log = case.log()
    if plant == "own":
        # as fine as a fit of the log would have it
        log = case.log(choose_numerics(robot, log, threads)[0])
    began = perf_counter()
    study = make_study(robot, [log], threads=threads)
    found = fit(study, case.bench.fit)
    estimates, converged = ESTIMATORS[estimator](found)
    seconds = perf_counter() - began
    (score,) = found.before.train.values()
    return [
        Row(
            robot=case.bench.name,
            estimator=estimator,
            plant=plant,
            number=case.number,
            motion=case.spec.motion,
            bits=case.spec.sensors.bits,
            noise=rounded(case.spec.sensors.position_noise),
            parameter=e.name,
            true=case.true(e.name),
            value=rounded(e.value),
            std=rounded(e.std),
            low=rounded(e.ci95[0]),
            high=rounded(e.ci95[1]),
            identifiable=e.identifiable,
            at_bound=int(e.at_bound),
            converged=int(converged),
            chi2=rounded(score.chi2),
            seconds=round(seconds, 2),
            recipe=recipe_state(),
            code=code_state(),
        )
        for e in estimates
    ]


def rounded(value: float) -> float:
    """To what a table needs."""
    return float(np.float64(f"{value:.8g}"))


@cache
def code_state() -> str:
    """Digest of the sources that decide an interval, as they were when this process first asked."""
    import sysid_btr

    folder, whole = Path(sysid_btr.__file__).parent, hashlib.sha256()
    for package in DECISIVE:
        for file in sorted((folder / package).glob("*.py")):
            whole.update(file.read_bytes())
    return f"{sysid_btr.__version__}+{whole.hexdigest()[:8]}"
