"""Robots that stand without an inertial unit: replayed whole, from where they stand at first."""

from __future__ import annotations

import functools
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from toys import robot_from_xml

from benchmarks.robots.judge import judge
from benchmarks.robots.planted import Late, Planted
from benchmarks.robots.suite import Case, cases
from sysid_btr.diagnosis.close import close
from sysid_btr.floating_base.episode import FloatingEpisode
from sysid_btr.floating_base.standing import StandingEpisode
from sysid_btr.identify.fit import fit
from sysid_btr.identify.mode import AUTOMATIC, Mode, episode_of
from sysid_btr.identify.study import Study, make_study
from sysid_btr.io.log import Log
from sysid_btr.models.robot import Robot, robot_from_file
from sysid_btr.simulation.batching import batched_chunks, group_replays
from sysid_btr.simulation.numerics import Numerics
from sysid_btr.terms.grammar import parse_parameters

NOISE = 0.00025
STANDING = next(case for case in cases() if case.name == "standing")
ROBOT = robot_from_xml(STANDING.model)
FINE = Numerics("RK4", 0.005)
ARMS = ("mass:*_hand", "kp:*=shared", "kv:*=shared")


@functools.cache
def recorded(*planted: Planted, seed: int = 4, model: str = STANDING.model) -> tuple[Case, Log]:
    experiment = replace(STANDING.experiment, seconds=6.0, seed=seed)
    case = replace(STANDING, planted=planted, experiment=experiment, model=model)
    return case, case.log()


def study_of(log: Log, folder: Path) -> Study:
    place = folder / "standing.xml"
    place.write_text(STANDING.model)
    return make_study(robot_from_file(place), [log], threads=1)


def test_the_model_leaves_little_but_noise_from_the_first_samples_on() -> None:
    """The base settles on its soles first, and moves as they say: it hardly rocks, and forgets that."""
    errors = []
    for seed in (4, 6, 8):
        _, log = recorded(seed=seed)
        episode = episode_of(ROBOT, log, AUTOMATIC, 1)
        assert isinstance(episode, StandingEpisode)
        replay = episode.replay((), FINE, threads=1)
        errors.append(replay.predict(np.zeros((1, 0))).position[0] - log.array("position", replay.index.joints))
    first, then = (np.sqrt(np.mean(np.square([e[own] for e in errors]))) for own in (slice(10), slice(10, 50)))
    assert first < 2 * NOISE
    assert then < 1.5 * NOISE


def test_two_logs_in_one_batch_stand_as_each_does_alone() -> None:
    logs = [recorded(seed=seed)[1] for seed in (4, 5)]
    terms = tuple(parse_parameters(["mass:trunk"], ROBOT))
    replays = [episode_of(ROBOT, log, AUTOMATIC, 1).replay(terms, FINE, threads=1) for log in logs]
    assert group_replays(replays) == [(0, 1)]
    candidates = np.array([[1.0], [1.2]])
    ((_, together),) = batched_chunks(replays, candidates)
    for replay, outputs in zip(replays, together, strict=True):
        alone = replay.predict(candidates)
        np.testing.assert_allclose(outputs.position, alone.position, atol=1e-12)
        assert np.ptp(alone.position, axis=0).max() > 1e-5


def leaning() -> Robot:
    """The same robot with its trunk's weight in front of its feet."""
    box = '<geom type="box" pos="0 0 0.15"'
    assert box in STANDING.model
    return robot_from_xml(STANDING.model.replace(box, '<geom type="box" pos="0.1 0 0.15"'))


def test_a_model_that_falls_is_compared_by_segments() -> None:
    _, log = recorded()
    assert isinstance(episode_of(leaning(), log, AUTOMATIC, 1), FloatingEpisode)
    assert isinstance(episode_of(ROBOT, log, Mode("segments"), 1), FloatingEpisode)


@pytest.mark.parametrize("planted", [(), (Late(STANDING.experiment.joints, 0.03),)], ids=["nothing", "delay"])
def test_a_delay_is_a_delay_and_nothing_is_nothing(planted: tuple[Planted, ...], tmp_path: Path) -> None:
    case, log = recorded(*planted)
    rivals = ("coulomb_friction", "viscous_damping", "armature", "command_delay", "actuator_filter")
    found = close(study_of(log, tmp_path), ARMS, effects=rivals)
    answer = judge(found.to_dict(), case.planted, case.alike)
    assert answer.answer == "right", (answer, found.message)


def test_the_ground_of_the_log_may_be_softer(tmp_path: Path) -> None:
    """What softness does to the legs is no evidence against the model, and estimates are not sure beyond it."""
    floor = '<geom name="floor"'
    assert floor in STANDING.model
    _, log = recorded(model=STANDING.model.replace(floor, f'{floor} solref="0.04 1"'))
    found = fit(study_of(log, tmp_path), ["kp:*=shared", "kv:*=shared"])
    assert found.misfit is None
    for estimate in found.estimates:
        assert estimate.ci95[0] < 1 < estimate.ci95[1], estimate
