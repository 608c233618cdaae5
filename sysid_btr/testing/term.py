"""The checks that every term must pass: as a change of a model and, where it has a field, as the model's own value."""

from __future__ import annotations

import re
import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from inspect import getdoc
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from sysid_btr._typing import FloatArray
from sysid_btr.identify.study import Study, make_study
from sysid_btr.io.log import Log, LogMeta
from sysid_btr.models.robot import Robot, robot_from_spec
from sysid_btr.run_folder import Folder
from sysid_btr.simulation.numerics import Numerics
from sysid_btr.simulation.replay import Replay
from sysid_btr.terms.base import Kind, Parameter, Term
from sysid_btr.terms.effect import Effect
from sysid_btr.terms.grammar import make_term
from sysid_btr.terms.law import ROWS, Step
from sysid_btr.terms.model import Model
from sysid_btr.terms.scales import JointScale, scale_at
from sysid_btr.testing.require import require
from sysid_btr.writeback.write import Identified, draft, save_model

if TYPE_CHECKING:
    import mujoco

TOY = """
<mujoco model="toy">
  <worldbody>
    <geom name="floor" type="plane" size="5 5 .1" pos="0 0 -1"/>
    <body name="upper">
      <joint name="hip" axis="0 1 0" damping=".05" armature=".006" stiffness=".1"/>
      <geom type="box" size=".04 .03 .07" pos=".01 .004 -.07" mass=".4" contype="0" conaffinity="0"/>
      <body name="lower" pos=".01 0 -.14">
        <joint name="knee" axis="0 1 0" damping=".05" armature=".006" frictionloss=".01"/>
        <geom type="box" size=".03 .03 .06" pos=".01 0 -.06" mass=".3" contype="0" conaffinity="0"/>
      </body>
    </body>
    <body name="foot" pos="0 1 -.98">
      <joint name="slide" type="slide" axis="1 0 0"/><joint name="lift" type="slide" axis="0 0 1"/>
      <joint name="tip" axis="0 1 0"/>
      <geom type="box" size=".1 .05 .02" pos=".01 0 0" mass="1"/>
    </body>
  </worldbody>
  <actuator>
    <position name="hip" joint="hip" kp="20" kv=".6"/>
    <position name="knee" joint="knee" kp="20" kv=".6" forcerange="-9 9"/>
  </actuator>
</mujoco>
"""
"""Two joints with a servo each, and a foot that slides over the ground."""
NUMERICS = Numerics("implicitfast", 0.002)
EXACT, NEARLY = 1e-12, 5e-3
"""rad; largest change by a neutral term, and by one that adds a joint, which is held nearly, not exactly, still."""
SEEN = 1e-6
"""rad; least change by a clear case of a term."""
HOOKS = {
    "edit_spec": "Structure:",
    "model_fields": "Native:",
    "law": "Law:",
    "shape_command": "Command:",
    "applied_torque": "Torque:",
    "read_out": "Sensor:",
    "initial_state": "Start:",
}
"""What a term does at a stage of a replay -> how the line of its docstring begins that says so."""
UNIT = re.compile(r"1|((1|{0})/)?\(?{0}\)?".format(r"(Nm|N|kg|m|s|rad)\d?( (Nm|N|kg|m|s|rad)\d?)*"))


@dataclass(frozen=True, eq=False)
class TermBench:
    """A robot, a recording of its model's own motion, and what they let one ask of a term.

    Attributes
    ----------
    study : robot and recording.
    log : the whole of it.
    """

    study: Study
    log: Log

    @classmethod
    def of(cls, robot: Robot, log: Log) -> TermBench:
        """A bench of a robot and commands; what the log says of positions and velocities counts at its start."""
        replay = Replay(robot, log, (), NUMERICS)
        moved, channels = replay.predict(np.zeros((1, 0))), dict(log.channels)
        for i, joint in enumerate(replay.index.joints):
            channels |= {f"position.{joint}": moved.position[0, :, i], f"velocity.{joint}": moved.velocity[0, :, i]}
        log = replace(log, channels=channels)
        study = make_study(robot, [log], numerics=NUMERICS, threads=1)
        return cls(study, log)

    def predict(
        self, term: Term | None, *candidates: FloatArray, numerics: Numerics = NUMERICS, effort: bool = False
    ) -> FloatArray:
        """(m, samples, joints) positions, or torques of the servos, under values of a term, or of the plain model."""
        terms = () if term is None else (term,)
        outputs = Replay(self.study.robot, self.log, terms, numerics, effort).predict(np.array(candidates))
        return outputs.position if outputs.effort is None else outputs.effort

    def forms(self, cls: type[Term]) -> Iterator[tuple[Term, FloatArray]]:
        """The term at all its places, in each of its two meanings, with the values of a clear case."""
        robot, scales = self.study.robot, self.study.scales
        term = cls.at(robot.names(cls.scope), scales)
        cases = {place: clear_case(cls, scale_at(scales, place)) for place in robot.names(cls.scope)}
        yield term, np.concatenate(list(cases.values()))
        if cls.field:
            bare = cls(places=(), declared=cls.field)
            model = robot.compile()
            for place in robot.names(bare.location):
                own = cls.own_value(model, place)
                scale = scale_at(scales, place)
                change = clear_case(cls, scale)[0]
                value = change if np.isinf(own) else own + change - cls.sized(scale)[0].nominal
                yield make_term(bare, (place,), robot, scales, place), np.array([value])


def clear_case(cls: type[Term], scale: JointScale) -> FloatArray:
    """Values (kinds,) of a term that is easy to see."""
    probes = cls.probes(scale) if issubclass(cls, Effect) else ()
    if probes:
        return np.array(probes[-1][-1])
    return np.array([k.nominal + (5 if k.nominal + 5 * k.scale <= k.upper else -5) * k.scale for k in cls.sized(scale)])


def shows_in_effort(cls: type[Term]) -> bool:
    """Whether a term shows in torques and nothing else."""
    return issubclass(cls, Effect) and cls.needs == "effort"


def check_term(cls: type[Term], robot: Robot | None = None, log: Log | None = None) -> None:
    """Check every promise of a term.

    Parameters
    ----------
    cls : the term.
    robot, log : a robot that has places for it, and commands that make it show; a toy's if None.

    Raises
    ------
    AssertionError
        Naming the promise that is broken.
    """
    bench = TermBench.of(toy_robot() if robot is None else robot, toy_motion() if log is None else log)
    for check in TERM_CHECKS:
        check(cls, bench)


def check_description(cls: type[Term], bench: TermBench) -> None:
    """It says what it is and does, in which units; an effect also how it is asked for and what resembles it."""
    require(bool(re.fullmatch(r"[a-z]\w*", cls.name)), f"{cls.__name__}: a name is one lower-case word")
    text = "\n".join(getdoc(c) or "" for c in cls.__mro__ if issubclass(c, Term) and c not in (Term, Effect))
    for hook, begin in HOOKS.items():
        # of what adds joints the numbers are compiled fields, for which the others may have to make room
        if cls.overrides(hook) and hook != ("model_fields" if cls.structural else "edit_spec"):
            require(begin in text, f"{cls.name}: it overrides {hook}, and no line of its docstring begins '{begin}'")
    for kind in cls.kinds:
        require(bool(UNIT.fullmatch(kind.unit)), f"{cls.name}.{kind.name}: {kind.unit!r} is not a unit of SI")
    if not issubclass(cls, Effect):
        return
    require(bool(cls.title) and cls.title[0].islower(), f"{cls.name}: a title begins in lower case, as in a sentence")
    require(bool(cls.confounders), f"{cls.name}: say what else leaves such a trace, and what tells the two apart")
    require(0 <= cls.main < len(cls.kinds), f"{cls.name}: main is not one of its kinds")
    unknown = {*cls.held, *cls.details} - {k.name for k in cls.kinds}
    require(not unknown, f"{cls.name}: it has no {', '.join(sorted(unknown))}")


def check_bounds(cls: type[Term], bench: TermBench) -> None:
    """Finite bounds hold the neutral value, which is not all there is; what the scan tries lies within them."""
    own: Iterator[Kind | Parameter] = chain.from_iterable(term.parameters for term, _ in bench.forms(cls))
    for p in chain(cls.kinds, own):
        require(p.lower <= p.nominal <= p.upper, f"{p.name}: its neutral value is out of its bounds")
        require(0 < p.scale <= p.upper - p.lower < np.inf, f"{p.name}: its scale does not fit into its bounds")
    if not issubclass(cls, Effect):
        return
    for scale in bench.study.scales.values():
        kinds = cls.sized(scale)
        for values in chain.from_iterable(cls.probes(scale)):
            legal = [k.lower <= v <= k.upper for k, v in zip(kinds, values, strict=True)]
            require(all(legal), f"{cls.name}: the scan tries {values}, which is out of bounds")
            require(list(values) != [k.nominal for k in kinds], f"{cls.name}: the scan tries nothing by {values}")


def check_neutral(cls: type[Term], bench: TermBench) -> None:
    """At its neutral value the model is the plain one, and away from it, it is not."""
    effort = shows_in_effort(cls)
    plain = bench.predict(None, np.zeros(0), effort=effort)[0]
    for term, case in bench.forms(cls):
        neutral, changed = bench.predict(term, term.neutral, case, effort=effort)
        # under a law the torque of the last step stands at the last sample, at which none begins
        change = np.abs(neutral - plain)[: -1 if effort and cls.overrides("law") else None].max()
        exact = change <= EXACT
        if cls.structural:
            finer = replace(NUMERICS, timestep=NUMERICS.timestep / 2)
            still, held = (bench.predict(t, v, numerics=finer) for t, v in ((None, np.zeros(0)), (term, term.neutral)))
            exact = change <= NEARLY and np.abs(held - still).max() <= change / 2
        require(exact, f"{term.called}: its neutral value changes the plain model by {change:.2g} rad, m or Nm")
        require(bool(np.isfinite(changed).all()), f"{term.called}: {case} has no finite replay")
        moved = np.abs(changed - neutral).max()
        if not term.absolute:
            require(moved > SEEN, f"{term.called}: {case} changes nothing")


def check_neighbours(cls: type[Term], bench: TermBench) -> None:
    """What a candidate gets does not depend on those beside it, to the last bit."""
    for term, case in bench.forms(cls):
        effort = shows_in_effort(cls)
        beside = bench.predict(term, case, term.neutral, case, effort=effort)
        for values, found in ((case, beside[0]), (term.neutral, beside[1]), (case, beside[2])):
            same = np.array_equal(bench.predict(term, values, effort=effort)[0], found)
            require(same, f"{term.called}: {values} moves otherwise beside another candidate")


def check_shared(cls: type[Term], bench: TermBench) -> None:
    """One amount for several places is the same as that amount at each of them."""
    places, scales = bench.study.robot.names(cls.scope), bench.study.scales
    if len(places) < 2:
        return
    apart, together = cls.at(places, scales), cls.at(places, scales, shared=True)
    case = clear_case(cls, scale_at(scales, places[0]))
    require(len(apart.parameters) == len(places) * len(together.parameters), f"{cls.name}: one amount is not shared")
    effort = shows_in_effort(cls)
    one, each = (
        bench.predict(together, case, effort=effort),
        bench.predict(apart, np.tile(case, len(places)), effort=effort),
    )
    require(bool(np.abs(one[0] - each[0]).max() <= EXACT), f"{cls.name}: one amount for all is not that amount at each")


def check_alone(cls: type[Term], bench: TermBench) -> None:
    """What a law with numbers for each place does at one of them depends on what is there alone.

    Inverse dynamics show it all samples at once, as if the robot were there so many times.
    """
    places = bench.study.robot.names(cls.scope)
    if cls.scope == "robot" or not cls.overrides("law") or len(places) < 2:
        return
    term = cls.at(places, bench.study.scales)
    cases = np.array([clear_case(cls, scale_at(bench.study.scales, place)) for place in places])
    numbers, rng = term.law_numbers(cases[None])[0], np.random.default_rng(0)
    rows = 1 + 0.1 * rng.normal(size=(ROWS, len(places)))
    rows[-2] -= 5  # the lower limit
    others = rows + np.where(np.arange(len(places)) == 0, 0.0, 0.1 * rng.normal(size=rows.shape))
    for step in (Step(0.1, 0.01, *rows), Step(0.1, 0.01, *others)):
        cls.law(step, numbers, np.zeros((len(places), cls.law_memory)), np.arange(len(places)))
    same = np.array_equal(rows[:, 0], others[:, 0])
    require(same, f"{cls.name}: what its law does at {places[0]} depends on another: give it scope robot")


def check_written(cls: type[Term], bench: TermBench) -> None:
    """A written model, read again, moves the same; or the file and the result say what is not in it."""
    for term, case in bench.forms(cls):
        identified = Identified(bench.study, Model.of([term], case), ())
        with tempfile.TemporaryDirectory() as folder:
            written = save_model(Folder(Path(folder)), draft(identified))
            text = (Path(folder) / str(written["path"])).read_text(encoding="utf-8")
        missing = [entry["held"] for entry in written["not_in_file"]]
        if not missing:
            require(bool(written["reproduces"]), f"{term.called}: the file moves otherwise, and does not say so")
            continue
        words = {"no": "Not in this file: ", "approximately": "Approximate in this file: "}[missing[0]]
        require(words + term.called in text, f"{term.called}: it is not whole in the file, which does not say so")


TERM_CHECKS: Sequence[Callable[[type[Term], TermBench], None]] = (
    check_description,
    check_bounds,
    check_neutral,
    check_neighbours,
    check_shared,
    check_alone,
    check_written,
)
"""Each takes the class of a term and a bench."""


def toy_robot() -> Robot:
    """Two joints with a servo each, and a foot that slides over the ground."""

    def make_spec() -> mujoco.MjSpec:
        import mujoco

        return mujoco.MjSpec.from_string(TOY)

    return robot_from_spec("toy", make_spec)


def toy_motion(seconds: float = 0.8) -> Log:
    """Commands that move both joints of the toy differently, and the foot's start."""
    time = 0.01 * np.arange(round(100 * seconds) + 1, dtype=np.float64)
    fade = 1 - np.exp(-np.square(time / 0.1))
    moves = {"hip": 0.5 * np.sin(9 * time), "knee": 0.4 * np.sin(14 * time + 0.5)}
    still = np.zeros(len(time))
    channels = {f"command.{joint}": fade * angle for joint, angle in moves.items()}
    channels |= {f"position.{joint}": still for joint in ("slide", "lift", "tip")}
    channels |= {"velocity.slide": still + 3.0, "velocity.lift": still, "velocity.tip": still}
    return Log(time, channels, LogMeta(sample_period=0.01), np.zeros(len(time), dtype=np.int64))
