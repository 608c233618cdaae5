"""Tasks and controllers of Back to Reality: arms that reach and follow, any legs, one's own, a real robot's player."""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from threading import Thread
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import toys
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from sysid_btr._typing import FloatArray
from sysid_btr.btr.arm_motions import FeedForward, feed_forward, spline_motion
from sysid_btr.btr.belief import Belief
from sysid_btr.btr.controllers import Controller, ControllerSpace, check_space
from sysid_btr.btr.exchange import FolderExchange
from sysid_btr.btr.gaits import NaoGait, SineGait, sine_gait
from sysid_btr.btr.learning import model_fit
from sysid_btr.btr.loop import back_to_reality
from sysid_btr.btr.named import get_space, get_task
from sysid_btr.btr.outcome import BackToReality
from sysid_btr.btr.problems import Stage
from sysid_btr.btr.robot import SILENT, HiddenRobot, Noise
from sysid_btr.btr.settings import Settings
from sysid_btr.btr.task import Motion, Reach, Task, Track, Walk, judged
from sysid_btr.btr.world import make_world
from sysid_btr.cli import run
from sysid_btr.errors import InterruptedRun, LogError, UsageError
from sysid_btr.estimators import CmaEs
from sysid_btr.io.log import Log
from sysid_btr.io.parquet import read_log, write_log
from sysid_btr.io.validation import validate_log
from sysid_btr.models.builtin import load_robot
from sysid_btr.models.robot import joint_ranges
from sysid_btr.terms.grammar import parse_parameters
from sysid_btr.terms.model import Terms

LEG = toys.leg()
ROOT = Path(__file__).resolve().parents[1]
REACH = Reach(1.5, place="ankle", point=(0.15, 0.0, -0.2))


def moving(seconds: float = 2.0) -> Log:
    return toys.swing(toys.LEG_JOINTS, seconds, 0.02, 0.4)


# --- tasks --------------------------------------------------------------------------------------------------------


def test_a_body_is_where_its_joints_put_it() -> None:
    world = make_world(LEG, REACH, threads=1)
    space = spline_motion(LEG, 1.0)
    values = np.random.default_rng(0).uniform(space.lower, space.upper, (2, len(space.names)))
    ((_, outputs),) = world.run(world.spread(space.joints, space.commands(values, REACH.time)), np.zeros((2, 0)))
    motion = world.motion(outputs, np.zeros((2, 0)), ("ankle", "knee"))
    hip, knee = (motion.position[:, :, motion.joints.index(joint)] for joint in ("hip", "knee"))

    def turned(angle: FloatArray, x: float, z: float) -> FloatArray:
        """A vector of a body that turned about y."""
        return np.stack([np.cos(angle) * x + np.sin(angle) * z, 0 * angle, np.cos(angle) * z - np.sin(angle) * x], -1)

    np.testing.assert_allclose(motion.places["knee"], turned(hip, 0.01, -0.14), atol=1e-9)
    ankle = turned(hip, 0.01, -0.14) + turned(hip + knee, 0.0, -0.12)
    np.testing.assert_allclose(motion.places["ankle"], ankle, atol=1e-9)
    away = np.linalg.norm(ankle - np.array(REACH.point), axis=2)
    np.testing.assert_allclose(REACH.fitness(motion), away[:, 0] - away[:, -15:].mean(axis=1), atol=1e-9)


def test_a_motion_that_is_followed_is_worth_one_and_a_robot_that_stays_nothing() -> None:
    task = Track.of_log(moving())
    assert task.joints == toys.LEG_JOINTS
    assert task.duration == pytest.approx(2.0)
    exact, still = task.wanted[None], np.broadcast_to(task.wanted[0], (1, *task.wanted.shape))
    motion = Motion(toys.LEG_JOINTS, np.concatenate([exact, still, 0.5 * (exact + still)]))
    np.testing.assert_allclose(task.fitness(motion), [1.0, 0.0, 0.5], atol=1e-12)
    shown = replace(moving(), channels={f"position.{j}": moving().channels[f"command.{j}"] for j in toys.LEG_JOINTS})
    np.testing.assert_allclose(Track.of_log(shown).wanted, task.wanted, atol=1e-12)
    with pytest.raises(LogError, match="nothing to track"):
        Track.of_log(toys.held())


def test_a_log_that_shows_no_single_motion_is_not_tracked() -> None:
    log = moving()
    shown = {f"position.{j}": log.channels[f"command.{j}"].copy() for j in toys.LEG_JOINTS}
    shown["position.knee"][20:25] = np.nan
    with pytest.raises(LogError, match="knee has positions missing"):
        Track.of_log(replace(log, channels=shown))
    with pytest.raises(LogError, match="2 episodes, and a trial has one motion"):
        Track.of_log(replace(log, episode=(log.time > 1).astype(np.int64)))
    late = log.time.copy()
    late[30] = late[29]
    for channels in (log.channels, shown):
        with pytest.raises(LogError, match="time does not increase strictly at sample 30"):
            Track.of_log(replace(log, time=late, channels=channels))


def test_what_decides_which_trials_are_made_is_told_apart() -> None:
    log = moving()
    other = replace(log, channels={**log.channels, "command.hip": 1.1 * log.channels["command.hip"]})
    prints = {Track.of_log(log).fingerprint, Track.of_log(other).fingerprint, REACH.fingerprint, Walk().fingerprint}
    assert len(prints) == 4


def test_a_robot_is_refused_what_it_cannot_do() -> None:
    with pytest.raises(UsageError, match="0 free joints"):
        make_world(LEG, Walk())
    with pytest.raises(UsageError, match=r"no body or site anckle \(did you mean ankle"):
        make_world(LEG, replace(REACH, place="anckle"))
    with pytest.raises(UsageError, match="no joint hip, knee, ankle"):
        make_world(toys.pendulum(), Track.of_log(moving()))


def test_a_fitness_of_another_shape_is_refused_and_one_that_diverged_has_none() -> None:
    class Wrong(Reach):
        def fitness(self, motion: Motion) -> FloatArray:
            return motion.position[:, 0]

    class Sure(Reach):
        def fitness(self, motion: Motion) -> FloatArray:
            return np.ones(len(motion.position))

    motion = Motion(("a",), np.array([[[0.0]], [[np.nan]]]))
    with pytest.raises(UsageError, match="Wrong: its fitness of 2 motions"):
        judged(Wrong(), motion)
    np.testing.assert_array_equal(judged(Sure(), motion)[0], [1.0, np.nan])


# --- controllers --------------------------------------------------------------------------------------------------


@settings(deadline=None)  # the first use imports scipy
@given(arrays(np.float64, 9, elements=st.floats(0.0, 1.0)), st.floats(0.5, 3.0))
def test_a_spline_goes_from_rest_to_where_it_stays_within_its_bounds(part: FloatArray, duration: float) -> None:
    space = spline_motion(LEG, duration)
    values = space.lower + part * (space.upper - space.lower)
    fine = np.linspace(0.0, 1.5 * duration, 1501)
    found = space.commands(values[None], fine)[0]
    np.testing.assert_allclose(found[0], space.rest, atol=1e-12)
    np.testing.assert_allclose(found[fine > duration], np.broadcast_to(values[2::3], found[fine > duration].shape))
    assert np.all(found >= np.array(space.lowest) - 1e-9)
    assert np.all(found <= np.array(space.highest) + 1e-9)
    # it begins and ends without velocity
    first, last = found[1] - found[0], found[1000] - found[999]
    assert np.abs(np.concatenate([first, last])).max() < 0.02 * np.ptp(space.highest)


def test_feed_forward_is_ahead_larger_and_shifted() -> None:
    time = 0.02 * np.arange(101)
    space = FeedForward(("a", "b"), np.stack([0.5 * time, -0.2 * time], axis=1), 0.02)
    values = np.array([[0.1, 0.2, 0.03, 0.0, -0.1, 0.0]])
    found = space.commands(values, time)[0]
    np.testing.assert_allclose(found[0], 0.0, atol=1e-12)
    late = (time > space.ramp) & (time < 1.9)
    np.testing.assert_allclose(found[late, 0], 1.2 * 0.5 * (time[late] + 0.1) + 0.03)
    np.testing.assert_allclose(found[late, 1], -0.9 * 0.2 * time[late])
    np.testing.assert_allclose(space.commands(space.start[None], time)[0], space.wanted, atol=1e-12)


@pytest.mark.parametrize("name", ["nao", "ant"])
def test_a_gait_of_any_legs_stays_within_the_joints_limits(name: str) -> None:
    robot = load_robot(name)
    space = sine_gait(robot, frequency=2.0)
    check_space(space, robot, Walk().time)
    values = np.random.default_rng(0).uniform(space.lower, space.upper, (20, len(space.names)))
    commands = space.commands(values, np.arange(100) * 0.02)
    ends = joint_ranges(robot)
    for i, joint in enumerate(space.joints):
        low, high = ends.get(joint, (-np.inf, np.inf))
        assert low - 1e-9 <= commands[:, :, i].min()
        assert commands[:, :, i].max() <= high + 1e-9


def test_robots_without_servos_have_no_controllers() -> None:
    def motors(spec: Any) -> None:
        for actuator in spec.actuators:
            actuator.set_to_motor()

    driven = toys.with_spec(LEG, motors)
    for make in (sine_gait, lambda robot: spline_motion(robot, 1.0), lambda robot: get_space("", robot, REACH)):
        with pytest.raises(UsageError, match="--servo"):
            make(driven)
    with pytest.raises(UsageError, match="no position servo drives elbow"):
        feed_forward(LEG, ("elbow",), np.zeros((2, 1)), 0.02)


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"joints": ("hip", "nee")}, "no joint nee"),
        ({"centre": (np.nan, 0.0)}, "not all finite"),
        ({"amplitude": (0.0, 0.2)}, "below its upper one"),
        ({"amplitude": (np.inf, 0.1)}, "`upper` is to hold 4 finite numbers"),
        ({"start_amplitude": 2.0}, "`start` within them"),
    ],
)
def test_controllers_that_are_none_are_refused_before_anything_runs(change: Mapping[str, Any], told: str) -> None:
    space = replace(SineGait(("hip", "knee"), (0.0, 0.0), (0.1, 0.2)), **change)
    with pytest.raises(UsageError, match=told):
        back_to_reality(LEG, parse_parameters(["kp:hip"], LEG), None, space, task=REACH)  # type: ignore[arg-type]


def test_what_suits_a_robot_and_a_task_is_chosen() -> None:
    nao, walk = load_robot("nao"), Walk()
    assert isinstance(get_space("", nao, walk), NaoGait)
    assert isinstance(get_space("sine", nao, walk), SineGait)
    track = Track.of_log(moving())
    found = get_space("", LEG, track)
    assert isinstance(found, FeedForward)
    assert found.joints == toys.LEG_JOINTS
    assert get_space("", LEG, REACH).names == spline_motion(LEG, 1.0).names


# --- the loop -----------------------------------------------------------------------------------------------------

FREE = ["kp:*=shared"]
DIFFERS = {"mass": 1.3, "kp": 0.6}
SMALL = Settings(
    iterations=2,
    trials=2,
    first=CmaEs(sigma=0.2, population=8, max_generations=16),
    controllers=CmaEs(sigma=0.1, population=8, max_generations=16),
    models=model_fit(),
    distance="likelihood",
    choice="improvement",
    draws=3,
    memory=4,
)


def hidden(task: Task, space: ControllerSpace, noise: Noise = SILENT) -> HiddenRobot:
    truth = Terms(parse_parameters(["mass:*=shared", *FREE], LEG))
    values = np.array([DIFFERS[name.partition(":")[0]] for name in truth.names])
    return HiddenRobot(make_world(LEG, task, truth, threads=1), values, task, space, noise)


def closed(task: Task, space: ControllerSpace, folder: Path | None = None, **more: Any) -> BackToReality:
    robot = hidden(task, space, Noise())
    terms = parse_parameters(["mass:*=shared", *FREE], LEG)
    return back_to_reality(LEG, terms, robot, space, task=task, settings=SMALL, folder=folder, threads=1, **more)


def test_an_arm_comes_to_a_point_and_its_model_is_corrected() -> None:
    space, said = spline_motion(LEG, 1.0), list[str]()
    outcome = closed(REACH, space, say=said.append)
    away = np.linalg.norm(np.array(REACH.point) - np.array([0.01, 0.0, -0.26]))
    assert 0.7 * away < outcome.best.trial.fitness < away
    learnt = dict(zip((p.name.partition(":")[0] for p in outcome.parameters), outcome.model, strict=True))
    assert learnt["kp"] / learnt["mass"] == pytest.approx(DIFFERS["kp"] / DIFFERS["mass"], rel=0.05)
    log = outcome.tried[0].trial.log
    assert log is not None
    assert log.meta.mount == "fixed"
    assert [p for p in validate_log(log, joints=space.joints) if p.severity == "error"] == []
    content = json.loads(json.dumps(outcome.to_dict(), default=str))
    assert content["units"] == {"fitness": "m"}
    words = " ".join([content["message"], *said])
    assert " m on the robot" in words
    assert not re.search(r"m/s|gait|fell|falls|stood", words)


def test_a_motion_is_followed_better_once_it_is_fed_forward() -> None:
    task = Track.of_log(moving())
    space = get_space("", LEG, task)
    plain = hidden(task, space).run(Controller(space.start))
    outcome = closed(task, space)
    assert 1 - outcome.best.trial.fitness < 0.4 * (1 - plain.fitness)
    for tried in outcome.tried:
        assert tried.foreseen is not None
        assert tried.foreseen.stands == 1
        assert tried.foreseen.low < tried.trial.fitness < tried.foreseen.high <= 1


def test_an_arm_has_no_ground() -> None:
    asked = {"coulomb_friction", "command_delay", "armature_factor", "damping_factor"}
    assert {term.name for term in Belief.unmeasured(LEG, ())[0]} == asked


def test_runs_are_the_same_whatever_is_beside_them() -> None:
    task, space = REACH, spline_motion(LEG, 1.0)
    terms = parse_parameters(FREE, LEG)
    stage = Stage(make_world(LEG, task, terms, threads=1), task, space)
    rng = np.random.default_rng(1)
    controllers = rng.uniform(space.lower, space.upper, (3, len(space.names)))
    models = np.array([[1.0], [0.7]])
    together = stage.fitness(controllers, models)
    assert len(np.unique(together)) == 6
    assert stage.fitness(controllers[1:2], models[1:])[0, 0] == together[1, 1]


# --- one's own ----------------------------------------------------------------------------------------------------

OWN = """
from dataclasses import dataclass

import numpy as np

from sysid_btr.btr.gaits import SineGait
from sysid_btr.btr.task import Task


@dataclass(frozen=True)
class Still(Task):
    goal = "how still it is"
    unit = "rad"
    duration: float = 2.0

    def fitness(self, motion):
        return -np.ptp(motion.position, axis=1).max(axis=1)


class Lazy(Task):
    def fitness(self, motion):
        return np.zeros(len(motion.position))


still = Still(duration=1.0)
space = SineGait(("hip",), (0.0,), (0.2,))


def for_robot(robot):
    return SineGait(tuple(robot.names("servo"))[:2], (0.0, 0.0), (0.2, 0.2))


number = 3


class Failing(Still):
    def fitness(self, motion):
        return motion.nothing


class Stray(SineGait):
    def commands(self, values, time):
        return self.nothing


class Unfinished(Task):
    pass


class Asking(Still):
    def __init__(self, what):
        pass


def refusing(robot):
    raise ValueError("not this robot")


stray = Stray(("hip",), (0.0,), (0.2,))
"""


@pytest.fixture
def own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    (tmp_path / "own_btr.py").write_text(OWN)
    (tmp_path / "broken_btr.py").write_text("1 / 0\n")
    (tmp_path / "needing_btr.py").write_text("import nothing_like_it\n")
    monkeypatch.chdir(tmp_path)
    for name in ("own_btr", "broken_btr", "needing_btr"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    return tmp_path


@pytest.mark.usefixtures("own")
def test_tasks_and_controllers_may_be_ones_own() -> None:
    before = list(sys.path)
    assert get_task("own_btr:Still", LEG).duration == 2.0
    assert get_task("own_btr:still", LEG).duration == get_task("own_btr.py:still", LEG).duration == 1.0
    assert get_task("own_btr:Lazy", LEG, 3.0).time[-1] == pytest.approx(3.0)
    assert get_space("own_btr:space", LEG, REACH).joints == ("hip",)
    assert get_space("own_btr:for_robot", LEG, REACH).joints == ("hip", "knee")
    assert sys.path == before


@pytest.mark.usefixtures("own")
@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("jump", "available are walk, reach:PLACE=X,Y,Z, track:FILE, or MODULE:NAME"),
        ("nowhere:jump", "there is no module nowhere in"),
        ("own_btr:stil", "did you mean still"),
        ("own_btr:number", "that is no task"),
        ("broken_btr:x", "ZeroDivisionError: division by zero"),
        ("needing_btr:x", "needs nothing_like_it, which is not installed"),
        ("own_btr:Unfinished", "TypeError: Can't instantiate abstract class Unfinished"),
        ("own_btr:Asking", "missing 1 required positional argument: 'what'"),
        ("own_btr:refusing", "failed: ValueError: not this robot (own_btr.py, line"),
        ("no_such.py:x", "there is no module no_such in"),
        ("reach:ankle", "reach:PLACE=X,Y,Z"),
        ("reach:ankle=0,1", "reach:PLACE=X,Y,Z"),
        ("reach:ankle=0,1,inf", "reach:PLACE=X,Y,Z"),
        ("reach:anckle=0,0,0", "did you mean ankle"),
        ("track", "track:FILE"),
    ],
)
def test_a_task_that_does_not_exist_is_refused(text: str, told: str) -> None:
    with pytest.raises(UsageError, match=re.escape(told)):
        get_task(text, LEG)


@pytest.mark.usefixtures("own")
@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("own_btr:number", "that is no controller space, it lacks names, lower"),
        ("own_btr:refusing", "failed: ValueError: not this robot (own_btr.py, line"),
        ("feedforward", "--task track:FILE"),
        ("walking", "available are sine, spline, feedforward, ant, nao, or MODULE:NAME"),
    ],
)
def test_controllers_that_do_not_exist_are_refused(text: str, told: str) -> None:
    with pytest.raises(UsageError, match=re.escape(told)):
        get_space(text, LEG, REACH)


@pytest.mark.usefixtures("own")
def test_what_fails_in_ones_own_code_is_said_to_be_there() -> None:
    failing, stray = get_task("own_btr:Failing", LEG), get_space("own_btr:stray", LEG, REACH)
    told = r"failed: AttributeError: .* has no attribute 'nothing' \(own_btr.py, line \d+\)"
    with pytest.raises(UsageError, match=f"task Failing {told}"):
        judged(failing, Motion(("a",), np.zeros((1, 2, 1))))
    with pytest.raises(UsageError, match=f"controllers Stray {told}"):
        check_space(stray, LEG, REACH.time)


def test_the_verb_reaches_follows_and_does_ones_own(own: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (own / "leg.xml").write_text(toys.LEG)
    write_log(moving(1.5), own / "motion.parquet")
    small = ("--iterations", "1", "--trials", "1", "--draws", "2", "--threads", "1", "--fit", "kp:*=shared")
    small = (*small, "--search", "ga", "--duration", "1")
    command = ("btr", "--model", "leg.xml", "--robot-sim", "leg.xml", "--robot-set", "kp:*=0.8", *small)
    for name, told in (("reach:ankle=0.1,0,-0.2", "m"), ("track:motion.parquet", "1"), ("own_btr:still", "rad")):
        out = own / name.partition(":")[0]
        assert run([*command, "--task", name, "--out", str(out), "--controllers", "own_btr:for_robot"]) == 0
        result = json.loads((out / "result.json").read_text())
        assert len(result["trials"]) == 1
        assert set(result["best"]["controller"]) == {"amplitude:hip", "phase:hip", "amplitude:knee", "phase:knee"}
        assert result["units"] == {"fitness": told}
        assert result["task"]["fitness"] in (out / "report.html").read_text()
    capsys.readouterr()
    assert run([*command[:-1], "0.1", "--task", "own_btr:still"]) == 2
    assert "a trial takes 1 to" in capsys.readouterr().err


# --- a real robot's player ----------------------------------------------------------------------------------------


def asked(folder: Path, task: Task, space: ControllerSpace) -> FolderExchange:
    return FolderExchange(folder, task, space, "leg", poll=0.01, patience=20.0, mount="fixed")


def test_an_exchange_says_what_the_fitness_is_and_refuses_what_it_cannot_be(tmp_path: Path) -> None:
    task = Track.of_log(moving())
    space = get_space("", LEG, task)
    impatient = replace(asked(tmp_path, task, space), patience=0.0)
    with pytest.raises(InterruptedRun):
        impatient.run(Controller(space.start, "0001"))
    place = tmp_path / "trial_0001"
    assert json.loads((place / "request.json").read_text())["fitness"] == "share of the motion that is followed"
    assert read_log(place / "command.parquet", check=False).meta.mount == "fixed"
    (place / "outcome.json").write_text('{"outcome": "done", "fitness": 1.2}')
    with pytest.raises(InterruptedRun):
        impatient.run(Controller(space.start, "0001"))
    assert "fitness is 1.2; expected the share of the motion" in (place / "problems.txt").read_text()


def test_the_player_of_the_guide_plays(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    task, space = REACH, spline_motion(LEG, 1.0)
    robot = hidden(task, space, Noise())
    played: list[FloatArray] = []

    def play(commands: Mapping[str, list[float]]) -> tuple[dict[str, FloatArray], float, str]:
        """What a robot's own software does: here that of a simulation, which is given the controller's commands."""
        wanted = np.array([commands[f"command.{joint}"] for joint in space.joints]).T
        played.append(wanted)
        trial = robot.run(Controller(space.start))
        assert trial.log is not None
        np.testing.assert_array_equal(wanted, trial.log.array("command", space.joints))
        return {"time": trial.log.time, **trial.log.channels}, trial.fitness, trial.outcome

    mine = ModuleType("my_robot")
    mine.play = play  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "my_robot", mine)
    monkeypatch.setattr(sys, "argv", ["player.py", str(tmp_path)])
    page = (ROOT / "docs" / "guide" / "back_to_reality.md").read_text()
    (code,) = re.findall(r"^    # player\.py\n((?:    .*\n|\n)+)", page, re.MULTILINE)
    lines = [line[4:] for line in code.splitlines()]
    assert len([line for line in lines if line.strip()]) <= 20
    player = Thread(target=exec, args=("\n".join(lines), {}), daemon=True)
    player.start()
    try:
        trial = asked(tmp_path, task, space).run(Controller(space.start, "0001"))
    finally:
        (tmp_path / "stop").touch()
        player.join(10.0)
    assert not player.is_alive()
    assert len(played) == 1
    assert trial.fitness == robot.run(Controller(space.start)).fitness
    assert trial.log is not None
    assert trial.log.meta.mount == "fixed"
