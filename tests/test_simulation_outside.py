"""A simulator from another package: one file, and it moves models as the built-in one does."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from importlib.metadata import EntryPoint
from pathlib import Path

import mujoco
import numpy as np
import pytest
import toys
from terminal import Cli

from sysid_btr._typing import IntArray
from sysid_btr.cli.fit import FitOptions
from sysid_btr.cli.options import deciding
from sysid_btr.errors import UsageError
from sysid_btr.identify.fit import Fit, fit
from sysid_btr.identify.replay import replay_log
from sysid_btr.identify.study import make_study
from sysid_btr.io.log import Log
from sysid_btr.io.parquet import write_log
from sysid_btr.simulation.mujoco_batch import MujocoBatch
from sysid_btr.simulation.numerics import Numerics
from sysid_btr.simulation.registry import ENTRY_POINTS, available, get_simulator
from sysid_btr.simulation.replay import Replay
from sysid_btr.simulation.setup import Setup
from sysid_btr.simulation.simulator import States
from sysid_btr.simulation.stepping import step_through
from sysid_btr.terms.base import Term
from sysid_btr.terms.friction import StribeckFriction
from sysid_btr.terms.servo import IntegralGain
from sysid_btr.testing import SIMULATOR_CHECKS, check_simulator


class PlainLoop:
    """`mj_step` in a loop: every candidate has a model and data of its own."""

    def rollout(self, setup: Setup, borders: IntArray, *, threads: int = 0) -> States:
        models = [setup.batch.candidate(row) for row in range(setup.size)]
        datas = [mujoco.MjData(model) for model in models]
        for row, data in enumerate(datas):
            for name, values in setup.state.items():
                getattr(data, name)[...] = values[row]
        arrays: dict[str, np.ndarray] = {}

        def owner(row: int, name: str) -> object:
            return datas[row] if hasattr(datas[row], name) else models[row]

        def array_of(name: str) -> np.ndarray:
            arrays[name] = np.stack([getattr(owner(row, name), name) for row in range(setup.size)])
            return arrays[name]

        def advance() -> None:
            for row, (model, data) in enumerate(zip(models, datas, strict=True)):
                for name, values in arrays.items():
                    getattr(owner(row, name), name)[...] = values[row]
                mujoco.mj_step(model, data)
                for name in ("qpos", "qvel", "qfrc_bias"):
                    arrays[name][row] = getattr(data, name)

        states = step_through(setup, borders, array_of, advance)
        states.failed = np.array([any(warning.number > 0 for warning in data.warning) for data in datas])
        return states


@pytest.fixture
def installed(monkeypatch: pytest.MonkeyPatch) -> None:
    """As if another package had said ``[project.entry-points."sysid_btr.simulators"] loop = ...``."""
    entry = EntryPoint("loop", f"{__name__}:PlainLoop", ENTRY_POINTS)
    monkeypatch.setattr("importlib.metadata.entry_points", lambda *, group: [entry] if group == ENTRY_POINTS else [])


@pytest.mark.parametrize("check", SIMULATOR_CHECKS)
@pytest.mark.parametrize("simulator", [MujocoBatch(), PlainLoop()])
def test_both_keep_the_contract(simulator: MujocoBatch | PlainLoop, check: Callable[..., None]) -> None:
    check(simulator)


# --- the contract can be broken ---------------------------------------------------------------------------


@dataclass
class Broken:
    """The built-in simulator, of something else than it was given."""

    change: Callable[[Setup], Setup]

    def rollout(self, setup: Setup, borders: IntArray, *, threads: int = 0) -> States:
        return MujocoBatch().rollout(self.change(setup), borders, threads=threads)


def without_fields(setup: Setup) -> Setup:
    return replace(setup, batch=replace(setup.batch, fields={}))


def without(name: str) -> Callable[[Setup], Setup]:
    return lambda setup: replace(setup, state={n: v for n, v in setup.state.items() if n != name})


def late(setup: Setup) -> Setup:
    return replace(setup, command=np.roll(setup.command, 1, axis=1))


def mixed(setup: Setup) -> Setup:
    return replace(setup, command=setup.command[:, :, ::-1])


def like_the_first(setup: Setup) -> Setup:
    return replace(setup, command=np.broadcast_to(setup.command[:1], setup.command.shape))


def spoiling(setup: Setup) -> Setup:
    """Leaves the setup it was given as another one."""
    own = replace(setup, state={name: values.copy() for name, values in setup.state.items()})
    setup.state["qpos"] += 1e-3
    return own


def leaning(setup: Setup) -> Setup:
    """A little of what is beside a candidate gets into it."""
    return replace(setup, command=setup.command + 1e-13 * setup.command.mean(axis=0))


@dataclass
class Forgetful:
    """Its states are the right ones with something left out."""

    change: Callable[[States], States]

    def rollout(self, setup: Setup, borders: IntArray, *, threads: int = 0) -> States:
        return self.change(MujocoBatch().rollout(setup, borders, threads=threads))


def all_failed(states: States) -> States:
    return replace(states, failed=np.ones(len(states.failed), dtype=bool))


def all_is_well(states: States) -> States:
    kept = np.nan_to_num(states.motor), np.nan_to_num(states.motor_velocity)
    return replace(states, position=kept[0], velocity=kept[1], failed=np.zeros(len(states.failed), dtype=bool))


@dataclass
class Drifting:
    """Never the same twice."""

    calls: list[int] = field(default_factory=list)

    def rollout(self, setup: Setup, borders: IntArray, *, threads: int = 0) -> States:
        self.calls.append(0)
        states = MujocoBatch().rollout(setup, borders, threads=threads)
        states.motor[:, 1:] += 1e-12 * len(self.calls)
        return states


@pytest.mark.parametrize(
    ("simulator", "words"),
    [
        (Broken(late), "commands"),
        (Broken(mixed), "commands"),
        (Broken(like_the_first), "commands"),
        (Broken(lambda setup: replace(setup, control=None)), "of other actuators"),
        (Broken(lambda setup: replace(setup, applied=None)), "torques known in advance"),
        (Broken(without_fields), "fields"),
        (Broken(without("xfrc_applied")), "initial states and forces"),
        (Broken(without("qvel")), "initial states and forces"),
        (Broken(lambda setup: replace(setup, laws=())), "law"),
        (Broken(lambda setup: replace(setup, held_steps=0)), "hold their torque"),
        (Broken(leaning), "simulated alone"),
        (Broken(spoiling), "the second time"),
        (Drifting(), "the second time"),
        (Forgetful(all_is_well), "not said to have failed"),
        (Forgetful(all_failed), "said to have failed"),
    ],
)
def test_what_breaks_it_is_found(simulator: Broken | Forgetful | Drifting, words: str) -> None:
    with pytest.raises(AssertionError, match=words):
        check_simulator(simulator)


# --- a study on it ----------------------------------------------------------------------------------------

FREED = ("mass:knee", "kp:*=shared")
SCALES = dict.fromkeys(toys.LEG_JOINTS, toys.SCALE)


def recorded(**meta: float) -> Log:
    motion = toys.swing(toys.LEG_JOINTS, seconds=1.0)
    motion = replace(motion, meta=replace(motion.meta, **meta))
    run = replay_log(toys.leg(), motion, {"kp:*": 0.9}, numerics=Numerics("RK4", 0.0025))
    rng = np.random.default_rng(3)
    seen = {c: run.channels[c] + rng.normal(0.0, 4e-4, len(run)) for c in run.channels if c.startswith("position.")}
    return replace(motion, channels={**motion.channels, **seen})


def numbers(found: Fit) -> list[float]:
    return [x for e in found.estimates for x in (e.value, *e.ci95)]


@pytest.mark.usefixtures("installed")
@pytest.mark.parametrize("meta", [{}, {"servo_period": 0.01}])
def test_a_fit_has_the_same_bits_on_it(meta: dict[str, float]) -> None:
    log = recorded(**meta)
    own, other = (fit(make_study(toys.leg(), [log], simulator=name), FREED) for name in (None, "loop"))
    assert (own.study.numerics.simulator, other.study.numerics.simulator) == ("mujoco", "loop")
    assert own.study.numerics == replace(other.study.numerics, simulator="mujoco")
    assert np.isfinite(numbers(own)).all()
    assert numbers(other) == numbers(own)


@pytest.mark.usefixtures("installed")
@pytest.mark.parametrize("held", [None, 0.01])
@pytest.mark.parametrize("law", [StribeckFriction, IntegralGain])
def test_laws_move_a_leg_to_the_same_bits_on_it(law: type[Term], held: float | None) -> None:
    term = law.at(("hip", "knee"), SCALES)  # type: ignore[attr-defined]
    values = np.array([[p.nominal + p.scale for p in term.parameters]])
    seen = [
        Replay(toys.leg(), recorded(), (term,), Numerics("RK4", 0.005, held, name), effort=True).predict(values)
        for name in ("mujoco", "loop")
    ]
    for channel in ("position", "velocity", "effort"):
        np.testing.assert_array_equal(getattr(seen[1], channel), getattr(seen[0], channel))


def test_one_that_is_not_installed_is_refused_before_anything_is_done() -> None:
    with pytest.raises(UsageError, match="no simulator 'warp'; installed are mujoco"):
        make_study(toys.leg(), [recorded()], simulator="warp")


@pytest.mark.usefixtures("installed")
def test_it_is_listed_and_decides_what_a_journal_is_of() -> None:
    assert available() == ("mujoco", "loop")
    assert isinstance(get_simulator("loop"), PlainLoop)
    plain, other = (deciding(FitOptions(simulator=name)) for name in (None, "loop"))
    assert plain != other


@pytest.mark.usefixtures("installed")
def test_a_result_names_it_where_it_is_not_the_built_in_one(cli: Cli, tmp_path: Path) -> None:
    model, log = tmp_path / "leg.xml", tmp_path / "leg.parquet"
    model.write_text(toys.LEG)
    write_log(recorded(), log)
    found = {}
    for name in ("mujoco", "loop"):
        run = cli("replay", "--model", model, "--log", log, "--simulator", name, "--json")
        found[name] = json.loads(run.out)["numerics"]
    assert "simulator" not in found["mujoco"]
    assert found["loop"]["simulator"] == "loop"
    assert found["loop"]["chosen"] == found["mujoco"]["chosen"] + ", simulated by loop"
