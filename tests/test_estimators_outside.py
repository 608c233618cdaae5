"""An estimator by least squares from another package: one file, and it is treated as the built-in one is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from importlib.metadata import EntryPoint
from typing import Self

import numpy as np
import pytest
import toys
from numpy.random import Generator

from sysid_btr._typing import FloatArray
from sysid_btr.estimators import (
    Budget,
    Evaluator,
    FitResult,
    Journal,
    Outcome,
    Problem,
    Progress,
    ResidualProblem,
    Termination,
    drive,
    get_estimator,
    require_residuals,
)
from sysid_btr.estimators.registry import ENTRY_POINTS
from sysid_btr.identify.fit import Fit, fit
from sysid_btr.identify.replay import replay_log
from sysid_btr.identify.study import make_study
from sysid_btr.io.log import Log
from sysid_btr.simulation.numerics import Numerics
from sysid_btr.testing import check_estimator

DAMPING = np.array([0.0, 1e-3, 1e-1, 1e1, 1e3])


@dataclass(frozen=True)
class Ridge:
    """Gauss-Newton steps of which the best of several dampings is taken."""

    step: float = 1e-4
    tolerance: float = 1e-7
    iterations: int = 30
    name: str = "ridge"
    uses_residuals: bool = True

    def for_rough_objective(self, step: float, least_gain: float) -> Self:
        return replace(self, step=max(self.step, step), tolerance=1e-4, iterations=8)

    def unconfirmed(self) -> Self:
        return self

    def fit(
        self, problem: Problem, *, rng: Generator, budget: Budget, journal: Journal, progress: Progress
    ) -> FitResult:
        squares = require_residuals(problem, self.name)
        return drive(problem, lambda e: self._search(squares, e), budget=budget, journal=journal, progress=progress)

    def _search(self, problem: ResidualProblem, evaluator: Evaluator) -> Outcome:
        box = evaluator.box
        u = box.enter(evaluator.start)
        evaluator.loss(evaluator.start[None])
        for _ in range(self.iterations):
            h = np.where(u + self.step <= 1, self.step, -self.step)
            near = evaluator.reduce(problem, box.leave(u + np.vstack([0 * h, np.diag(h)])), normal_equations)
            loss, matrix = near.loss[0], near.arrays["normal"] / np.outer(h, h)
            if not np.isfinite(loss):
                return Outcome(Termination.NO_FINITE_CANDIDATE)
            size = np.maximum(np.diag(matrix), 1e-12 * np.trace(matrix))
            gradient = near.arrays["gradient"] / h
            tried = np.array([stepped(u, matrix + np.diag(damping * size), gradient) for damping in DAMPING])
            losses = evaluator.loss(box.leave(tried))
            best = int(np.argmin(losses))
            if not losses[best] < (1 - self.tolerance) * loss:
                return Outcome(Termination.CONVERGED)
            u = tried[best]
        return Outcome(Termination.ITERATION_LIMIT)


def normal_equations(rows: FloatArray) -> tuple[dict[str, FloatArray], None]:
    """The normal matrix and the gradient of differences; what failed moves nothing."""
    columns = np.where(np.isfinite(rows[1:]).all(axis=1)[:, None], rows[1:] - rows[0], 0.0)
    columns = np.nan_to_num(columns)
    return {"normal": columns @ columns.T, "gradient": columns @ np.nan_to_num(rows[0])}, None


def stepped(u: FloatArray, matrix: FloatArray, gradient: FloatArray) -> FloatArray:
    """Where a Newton step leads within the unit cube; what would leave it stays on its border."""
    free = np.ones(len(u), dtype=bool)
    while True:
        step = np.zeros(len(u))
        step[free] = np.linalg.lstsq(matrix[np.ix_(free, free)], gradient[free], rcond=1e-10)[0]
        out = free & (((u <= 0) & (step > 0)) | ((u >= 1) & (step < 0)))
        if not out.any():
            return np.clip(u - step, 0.0, 1.0)
        free &= ~out


@pytest.fixture
def installed(monkeypatch: pytest.MonkeyPatch) -> None:
    """As if another package had said ``[project.entry-points."sysid_btr.estimators"] ridge = ...``."""
    entry = EntryPoint("ridge", f"{__name__}:Ridge", ENTRY_POINTS)
    monkeypatch.setattr(EntryPoint, "load", lambda self: Ridge)
    monkeypatch.setattr("importlib.metadata.entry_points", lambda *, group: [entry] if group == ENTRY_POINTS else [])


def test_it_keeps_the_contract() -> None:
    check_estimator(Ridge())


# --- what `fit` does around least squares, it does around this one ------------------------------------------

GAINS = ("kp:*=shared", "kv:*=shared")
ROBOT = toys.with_spec(toys.leg(), lambda spec: spec.worldbody.add_body(name="stand", mass=2.0, inertia=[1, 1, 1]))
"""A leg beside a stand, whose mass moves nothing."""


def recorded(wrong: float = 0.0) -> Log:
    """A leg whose servos are softer than the model's, under noise; the ankle's encoder is wrong by some radians."""
    motion = toys.swing(toys.LEG_JOINTS, seconds=4.0)
    run = replay_log(ROBOT, motion, {"kp:*": 0.9}, numerics=Numerics("RK4", 0.00125))
    rng = np.random.default_rng(3)
    noisy = {c: run.channels[c] + rng.normal(0.0, 4e-4, len(run)) for c in run.channels if c.startswith("position.")}
    noisy["position.ankle"] += wrong * np.sin(5 * (run.time - run.time[0]))
    return replace(motion, channels={**motion.channels, **noisy})


def fitted(log: Log, parameters: Sequence[str], timestep: float = 0.005, start: FloatArray | None = None) -> Fit:
    study = make_study(ROBOT, [log], numerics=Numerics("RK4", timestep))
    return fit(study, parameters, estimator=get_estimator("ridge"), start=start)


@pytest.mark.usefixtures("installed")
def test_columns_that_the_model_cannot_explain_count_less() -> None:
    found = fitted(recorded(wrong=0.1), GAINS)
    assert found.study.inflation[("fixed", "position", "ankle")] > 10
    assert found.study.inflation[("fixed", "position", "hip")] < 2
    assert found.estimates[0].value == pytest.approx(0.9, abs=0.003)


@pytest.mark.usefixtures("installed")
def test_the_step_of_the_integrator_is_checked_and_halved() -> None:
    found = fitted(recorded(), GAINS, timestep=0.0125)
    assert found.study.numerics.timestep < 0.0125
    assert found.estimates[0].ci95[0] <= 0.9 <= found.estimates[0].ci95[1]


@pytest.mark.usefixtures("installed")
def test_what_is_not_identifiable_is_fixed_at_its_nominal_value() -> None:
    found = fitted(recorded(), ("mass:stand", *GAINS), start=np.array([1.5, 1.0, 1.0]))
    stand, kp, _ = found.estimates
    assert stand.identifiable == "no"
    assert stand.value == stand.nominal == 1.0
    assert kp.ci95[0] <= 0.9 <= kp.ci95[1]
