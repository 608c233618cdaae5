"""The accounts that `benchmarks.waits` keeps."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from toys import FINE, pendulum, swing

from benchmarks.phases import ALGEBRA, LAWS, MANY, ONE, watched
from benchmarks.waits import CASES, found_in
from sysid_btr.simulation.replay import Replay
from sysid_btr.terms.grammar import parse_parameters
from sysid_btr.terms.model import Terms


def test_steps_are_counted_with_laws_and_without() -> None:
    log = swing(seconds=0.5)
    plain = Replay(pendulum(), log, parse_parameters(["mass:*"], pendulum()), FINE)
    terms = Terms(parse_parameters(["stribeck_friction:*"], pendulum()))
    under_law = Replay(pendulum(), log, tuple(terms), FINE)
    with watched() as phases:
        plain.predict(np.ones((1, 1)))
        plain.predict(np.ones((3, 1)))
        under_law.predict(np.tile(terms.nominal, (2, 1)))
    assert phases.steps == {"RK4": (1 + 3 + 2) * plain.grid.steps}
    assert phases.calls == {ONE: 1, MANY: 1, LAWS: 1}


def test_time_goes_to_the_part_that_spends_it() -> None:
    matrix = np.random.default_rng(0).normal(size=(300, 300))
    with watched() as phases:
        while sum(phases.seconds.values()) < 0.2:
            np.linalg.svd(matrix)
    assert max(phases.seconds, key=lambda part: phases.seconds[part]) == ALGEBRA


def test_recordings_that_are_missing_leave_cases_out(tmp_path: Path) -> None:
    missing = {name for name, case in CASES.items() if case.needs(tmp_path)}
    assert {"close_emps", "fit_walk", "close_tx40"} <= missing
    assert not missing & {"close_friction", "close_clean", "law_pendulum", "demo"}


def test_what_was_found_is_kept_with_its_standard_deviations() -> None:
    number = {"name": "kp:*", "value": 0.9, "std": 0.01}
    result = {
        "verdict": "explained",
        "numerics": {"chosen": "RK4 5 ms"},
        "parameters": [number],
        "effects": [{"effect": "coulomb_friction", "where": ["knee"], "parameters": [{**number, "name": "torque"}]}],
        "after": {"holdout": {"position": {"rmse": 0.001}, "effort": {"rmse": None}}},
    }
    assert found_in(result) == {
        "verdict": "explained",
        "numerics": "RK4 5 ms",
        "parameters": {"kp:*": [0.9, 0.01]},
        "effects": [{"effect": "coulomb_friction", "where": ["knee"], "torque": [0.9, 0.01]}],
        "held_out": {"position": 0.001},
    }
