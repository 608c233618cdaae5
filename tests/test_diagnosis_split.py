"""What is held out: the end of a log, or parts of all of it where its end is no fair judge."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import toys

from sysid_btr._typing import FloatArray
from sysid_btr.diagnosis.close import close
from sysid_btr.diagnosis.selection import STANDARD
from sysid_btr.diagnosis.split import held_out_elsewhere
from sysid_btr.diagnosis.state import State
from sysid_btr.display.text import episode_words
from sysid_btr.estimators import Journal
from sysid_btr.identify.fit import fit
from sysid_btr.identify.study import Study, make_study
from sysid_btr.io.log import Log
from sysid_btr.simulation.numerics import Numerics
from sysid_btr.simulation.replay import Replay
from sysid_btr.terms.base import Term
from sysid_btr.terms.friction import CoulombFriction

FREE = ("mass:knee",)
SECONDS = 10.0
DRIFTS = 0.04
"""rad, of an encoder in the end."""


def recorded(*effects: tuple[Term, FloatArray], seed: int = 3, still: float = 0.0) -> Log:
    """Several waves at every joint of the leg, which keeps still until then, seen by noisy encoders."""
    rng, time = np.random.default_rng(seed), np.arange(round(100 * SECONDS) + 1) / 100
    moves = -np.expm1(-((np.maximum(time - still, 0.0) / 0.3) ** 2))
    channels = {}
    for joint in toys.LEG_JOINTS:
        frequency, phase = rng.uniform(0.3, 3.0, 6), rng.uniform(0, 2 * np.pi, 6)
        waves = 0.15 / np.sqrt(frequency) * np.sin(2 * np.pi * np.outer(time, frequency) + phase)
        channels[f"command.{joint}"] = moves * waves.sum(axis=1)
    log = toys.make_log(time, channels, sample_period=0.01)
    terms, values = [e for e, _ in effects], np.concatenate([np.zeros(0), *(v for _, v in effects)])
    seen = Replay(toys.leg(), log, tuple(terms), Numerics("RK4", 0.0025)).predict(values[None]).position[0]
    noisy = seen + rng.normal(scale=5e-4, size=seen.shape)
    shown = {f"position.{joint}": x for joint, x in zip(toys.LEG_JOINTS, noisy.T, strict=True)}
    return replace(log, channels={**log.channels, **shown})


def drifting(log: Log, joint: str) -> Log:
    """A log whose encoder drifts at one joint."""
    name = f"position.{joint}"
    shown = log.channels[name] + DRIFTS * -np.expm1(-log.time / 4.0)
    return replace(log, channels={**log.channels, name: shown})


def moved(log: Log) -> Study | None:
    study = make_study(toys.leg(), [log], numerics=Numerics("RK4", 0.005), threads=1)
    return held_out_elsewhere(State.of(fit(study, FREE), None), STANDARD)


FRICTION = CoulombFriction(("hip",)), np.array([0.15])


@pytest.mark.parametrize("seed", [3, 4, 5])
def test_the_end_is_held_out_where_nothing_is_missing_and_where_nothing_changes(seed: int) -> None:
    assert moved(recorded(seed=seed)) is None
    assert moved(recorded(FRICTION, seed=seed)) is None


@pytest.mark.parametrize("seed", [3, 4, 5])
def test_parts_of_all_of_a_log_are_held_out_where_what_is_missing_follows_time(seed: int) -> None:
    study = moved(drifting(recorded(seed=seed), "knee"))
    assert study is not None
    (fitted,), (held,) = study.train, study.holdout
    assert np.array_equal(fitted.scored, ~held.scored)
    assert 0.25 < np.mean(held.scored) < 0.35
    assert fitted.scored[0]
    assert fitted.scored[-1]
    assert held_out_elsewhere(State.of(fit(study, FREE), None), STANDARD) is None, "once"


def test_parts_of_all_of_a_log_are_held_out_where_something_shows_only_at_its_end() -> None:
    assert moved(recorded(FRICTION, still=7.2)) is not None


def test_another_log_that_is_held_out_stays_held_out() -> None:
    first, second = (drifting(recorded(seed=seed), "knee") for seed in (3, 4))
    study = make_study(toys.leg(), [first], holdout=[second], numerics=Numerics("RK4", 0.005), threads=1)
    assert held_out_elsewhere(State.of(fit(study, FREE), None), STANDARD) is None


def test_what_acts_beside_a_function_of_time_is_found_and_the_result_says_what_was_held_out() -> None:
    log = drifting(recorded(FRICTION), "knee")
    study = make_study(toys.leg(), [log], numerics=Numerics("RK4", 0.005), threads=1)
    found = close(study, FREE, effects=("coulomb_friction", "viscous_damping", "free_reading"))
    assert found.verdict == "explained", found.message
    assert {(e.family, e.where) for e in found.effects} == {("friction", ("hip",)), ("sensor", ("knee",))}
    (size,) = [p for e in found.effects for p in e.parameters if p.name == "coulomb_friction:hip"]
    assert size.value == pytest.approx(0.15, rel=0.02)
    (words,) = [line for line in episode_words(found.to_dict()) if "held out" in line]
    assert words.startswith("held out of the log: 6 parts all over it, 2.9")


def test_a_run_that_began_anew_resumes(tmp_path: Path) -> None:
    kept, log = tmp_path / "journal.jsonl", drifting(recorded(), "hip")
    study = make_study(toys.leg(), [log], numerics=Numerics("RK4", 0.005), threads=1)
    closing = partial(close, study, FREE, effects=("free_reading",))
    found = closing(journal=Journal(kept))
    done = kept.read_bytes()
    assert np.array_equal(closing(journal=Journal(kept)).values, found.values)
    assert kept.read_bytes() == done, "nothing that was done is done again"


def test_the_end_of_a_log_that_is_too_short_for_parts_stays_held_out() -> None:
    late = recorded(FRICTION, still=7.2)
    study = make_study(toys.leg(), [late.window(0, 101), late], numerics=Numerics("RK4", 0.005), threads=1)
    spread = held_out_elsewhere(State.of(fit(study, FREE), None), STANDARD)
    assert spread is not None
    assert np.array_equal(spread.holdout[0].scored, study.holdout[0].scored)
    assert not spread.holdout[1].scored[-1]
