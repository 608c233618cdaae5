"""What a log can tell before anything is fitted: its excitation, its limits, and what would show in it.

Parameters: the standard error that a fit of this motion to the plain model is expected to give (the Cramer-Rao bound
for white noise of the sensors' floor). Effects: the smallest amount that would show. A change of the residual by r, off
what the parameters can do, raises twice the log-likelihood by |r|^2; evidence for one more number at some odds takes
2 ln(odds) + ln(n) for n samples (Schwarz 1978, doi:10.1214/aos/1176344136; Kass and Raftery 1995,
doi:10.1080/01621459.1995.10476572), and |r| is taken to grow in proportion to the amount. Two effects at one place are
confounded where the correlation of their traces inflates their variance tenfold (O'Brien 2007,
doi:10.1007/s11135-006-9018-6). All of this holds for a model that is right otherwise; what it lacks makes it harder.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from time import perf_counter
from typing import TYPE_CHECKING, Any

import numpy as np

from sysid_btr._typing import FloatArray
from sysid_btr.errors import UsageError
from sysid_btr.excite.design import expect
from sysid_btr.identify.intervals import Estimate
from sysid_btr.identify.study import Study, make_study
from sysid_btr.io.log import Log
from sysid_btr.io.problem import Problem
from sysid_btr.models.log_checks import check_log
from sysid_btr.models.robot import Robot, joint_ranges
from sysid_btr.mujoco_conventions import slides
from sysid_btr.progress import shows_progress, watched
from sysid_btr.result import clean
from sysid_btr.terms.base import Parameter
from sysid_btr.terms.effect import Effect
from sysid_btr.terms.model import Model, Terms
from sysid_btr.terms.scales import JointScale, scale_at

if TYPE_CHECKING:
    import pandas as pd

    from sysid_btr.estimators.base import Progress

SCHEMA = "sysid_btr.check/1"
ODDS = 99.0
"""For an effect that is there, against none."""
INFLATED = 10.0
"""Variance inflation from which traces are confounded."""
KEPT = 4000
"""Samples of a trace that are compared with others."""
FULL = 0.98
"""Of its limit, from which a torque is at it."""
BUDGET = 60.0
"""s, after which no further effects are tried."""


@dataclass(frozen=True)
class JointCheck:
    """One joint in a log.

    Attributes
    ----------
    joint, unit : rad or m.
    span, velocity : range of the motion in the plain model, and its peak velocity.
    torque : peak torque of the drive in the plain model, Nm or N.
    saturated : share of samples at which the plain model's torque is at the actuator's or joint's limit.
    beyond : share of samples whose commanded position is outside the joint's range.
    floor : noise floor of the position.
    """

    joint: str
    unit: str
    span: float
    velocity: float
    torque: float
    saturated: float
    beyond: float
    floor: float | None

    @property
    def at_rest(self) -> bool:
        """Whether it moves by no more than its noise."""
        return self.floor is not None and self.span < 10 * self.floor


@dataclass(frozen=True)
class EffectCheck:
    """One effect at one place.

    Attributes
    ----------
    effect, where : of the effect.
    parameter, unit : which of its numbers `shows_from` is, e.g. the x of an offset; several are tried, and the one that
        shows best is given.
    nominal : amount that leaves the model as it is; None for a limit, which does so wherever it is not reached.
    shows_from : amount nearest to that which would show at the odds; None where none within its bounds would.
    confounded_with : effects at the same place whose traces are nearly the same.
    """

    effect: str
    where: str
    parameter: str
    unit: str
    nominal: float | None
    shows_from: float | None
    confounded_with: tuple[str, ...]

    @property
    def size(self) -> float | None:
        """The smallest change that would show; of a limit, the limit."""
        return None if self.shows_from is None else abs(self.shows_from - (self.nominal or 0.0))


@dataclass(frozen=True, eq=False, repr=False)
class LogCheck:
    """What logs can tell.

    Attributes
    ----------
    study : the logs as they would be compared with the model.
    joints : excitation, saturation and range.
    parameters : as a fit is expected to know them.
    effects : what would show; the library's, at every place.
    skipped : effects for which there was no time.
    problems : what validation finds.
    odds : see `EffectCheck`.
    """

    study: Study
    joints: tuple[JointCheck, ...]
    parameters: tuple[Estimate, ...]
    effects: tuple[EffectCheck, ...]
    skipped: tuple[str, ...]
    problems: tuple[Problem, ...]
    odds: float

    @property
    def message(self) -> str:
        """The outcome in one sentence."""
        known = sum(p.identifiable != "no" for p in self.parameters)
        shown = sum(e.shows_from is not None for e in self.effects)
        parts = [f"{known} of {len(self.parameters)} parameters are identifiable from this motion"]
        parts += [f"{shown} of {len(self.effects)} effects would show"] if self.effects else []
        for joints, one, several in (
            ([j.joint for j in self.joints if j.at_rest], "hardly moves", "hardly move"),
            (
                [j.joint for j in self.joints if j.saturated > 0],
                "reaches its torque limit",
                "reach their torque limits",
            ),
            (
                [j.joint for j in self.joints if j.beyond > 0],
                "is commanded beyond its range",
                "are commanded beyond their ranges",
            ),
        ):
            parts += [f"{', '.join(joints)} {one if len(joints) == 1 else several}"] if joints else []
        return "; ".join(parts) + "."

    @property
    def advice(self) -> tuple[str, ...]:
        """What to do next, one line each."""
        robot = self.study.robot
        model = robot.name if robot.path is None else str(robot.path)
        lines = []
        poor = [p.name for p in self.parameters if p.identifiable != "yes"]
        if poor and all(e.log.meta.mount == "fixed" for e in self.study.train):
            asked = " ".join(f"--fit '{name}'" for name in poor[:4])
            about = f"a motion that is more informative about {', '.join(poor[:4])}"
            lines.append(f"{about}: sysid-btr excite --model {model} {asked}")
        if any(j.saturated > 0 for j in self.joints):
            lines.append("a drive at its limit shows the limit, not its gains: record slower or smaller motion as well")
        if not any(e.logged(("effort",)) for e in self.study.train):
            lines.append("no effort is logged: measured torques separate masses from gains, and effects of the drive")
        return tuple(lines)

    def to_dict(self) -> dict[str, Any]:
        """As JSON."""
        content: dict[str, Any] = clean(
            {
                "schema": SCHEMA,
                "message": self.message,
                "robot": self.study.robot.name,
                "numerics": str(self.study.numerics),
                "odds": self.odds,
                "joints": [asdict(j) for j in self.joints],
                "parameters": [p.to_dict() for p in self.parameters],
                "effects": [asdict(e) for e in self.effects],
                "skipped": self.skipped,
                "problems": [asdict(p) for p in self.problems],
                "advice": self.advice,
            }
        )
        return content

    def to_pandas(self, table: str = "effects") -> pd.DataFrame:
        """``joints``, ``parameters``, ``effects`` or ``problems``.

        Raises
        ------
        UsageError
            If there is no such table.
        """
        import pandas as pd

        if table not in ("joints", "parameters", "effects", "problems"):
            raise UsageError(f"a check has no table {table!r}; it has joints, parameters, effects, problems")
        return pd.DataFrame(self.to_dict()[table])

    def __repr__(self) -> str:
        return f"<LogCheck of {self.study.robot.name}: {self.message}>"


@shows_progress("check")
def check(
    robot: Robot,
    logs: Sequence[Log],
    parameters: Sequence[str],
    *,
    effects: Sequence[str] = ("all",),
    odds: float = ODDS,
    budget: float = BUDGET,
    threads: int = 0,
    progress: Progress = watched,
) -> LogCheck:
    """Say what logs are informative about, before anything is fitted.

    Parameters
    ----------
    robot, logs : model and recordings.
    parameters : expressions of the grammar, as for `fit`.
    effects : names of effects, or ``all``.
    odds : in favour of an effect, from which it counts as visible.
    budget : s, after which no further effects are tried.
    threads : worker threads, 0 for all cores.
    progress : is told what is going on.

    Returns
    -------
    LogCheck
        Joints, parameters, effects, problems, and advice; its tables by ``to_pandas``.

    Raises
    ------
    ModelError, LogError, UsageError
        As `make_study` does.
    """
    from sysid_btr.diagnosis.close import usable_effects
    from sysid_btr.estimators.linearisation import linearise
    from sysid_btr.terms.library import select_effects

    if not odds > 1:
        raise UsageError(f"odds of {odds:g}: give more than 1")
    began = perf_counter()
    found = tuple(p for log in logs for p in check_log(robot, log))
    study = make_study(robot, logs, holdout=logs, threads=threads, progress=progress)
    terms = study.declare(parameters)
    problem = study.train_problem(Model.of(terms))
    expected = expect(problem).estimates if terms.parameters else ()
    residual, jacobian = (
        linearise(problem, problem.start)
        if terms.parameters
        else (problem.residuals(problem.start[None])[0], np.zeros((problem.count, 0)))
    )
    basis, rough = _basis(np.nan_to_num(jacobian)), replace(study, numerics=study.coarse)
    threshold = 2 * math.log(odds) + math.log(len(residual))
    traces: list[_Trace] = []
    skipped: list[str] = []
    # what acts at every step, or changes the structure, takes longest
    asked = sorted(usable_effects(select_effects(effects), study), key=lambda e: e.structural or e.overrides("law"))
    for number, effect in enumerate(asked):
        progress(done=number, total=len(asked), best=math.inf, note=f"would {effect.name} show?")
        places = _places(study, effect)
        if perf_counter() - began > budget:
            skipped.append(effect.name)
        elif places:
            traces += _traces(rough, terms, effect, places, basis)
    checked = tuple(_judged(traces, threshold))
    return LogCheck(study, tuple(_joints(study)), expected, checked, tuple(dict.fromkeys(skipped)), found, odds)


# --- effects ---------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _Trace:
    """What a probe of an effect at one place does to the residual, off what the parameters can do."""

    effect: type[Effect]
    place: str
    amount: float
    kind: Parameter
    size: float
    direction: FloatArray


def _places(study: Study, effect: type[Effect]) -> tuple[str, ...]:
    names = study.robot.names(effect.scope)
    moved = set(study.scales)
    return tuple(name for name in names if effect.scope in ("body", "robot") or name in moved)


def _basis(jacobian: FloatArray) -> FloatArray:
    """Orthonormal columns that span what the parameters can do."""
    norm = np.linalg.norm(jacobian, axis=0)
    if not np.any(norm > 0):
        return np.zeros((len(jacobian), 0))
    left, size, _ = np.linalg.svd(jacobian[:, norm > 0] / norm[norm > 0], full_matrices=False)
    return np.asarray(left[:, size > 1e-6 * size[0]])


def _traces(
    study: Study, terms: Terms, effect: type[Effect], places: tuple[str, ...], basis: FloatArray
) -> Iterator[_Trace]:
    """The traces of an effect at every place, simulated together."""
    term = effect.at(places, study.scales)
    model = Model.of(terms).with_(term, term.neutral)
    first, width = len(model.values) - len(term.neutral), len(effect.kinds)
    candidates, asked = [model.values], []
    for k, place in enumerate(places):
        # the first working point is the smallest; what has none is found in what a fit leaves
        for probe in next(iter(effect.probes(scale_at(study.scales, place))), ()):
            row = model.values.copy()
            row[first + k * width : first + (k + 1) * width] = probe
            candidates.append(row)
            asked.append((k, place, probe))
    base, *moved = study.train_problem(model).residuals(np.array(candidates))
    for (k, place, probe), residual in zip(asked, moved, strict=True):
        change = residual - base
        if not np.isfinite(change).all():
            continue
        change = change - basis @ (basis.T @ change)
        size = float(np.linalg.norm(change))
        varied = _varied(effect, probe, scale_at(study.scales, place))
        kind = replace(term.parameters[k * width + varied], name=effect.kinds[varied].name)
        few = change[:: max(len(change) // KEPT, 1)]
        norm = float(np.linalg.norm(few))
        yield _Trace(effect, place, float(probe[varied]), kind, size, few / norm if norm > 0 else few)


def _varied(effect: type[Effect], probe: Sequence[float], scale: JointScale) -> int:
    """Which of an effect's numbers says how large a probe is: its main one, or that which is changed in its place."""
    changes = [
        0.0 if kind.name in effect.held else abs(value - kind.nominal) / kind.scale
        for kind, value in zip(effect.sized(scale), probe, strict=True)
    ]
    return effect.main if effect.is_threshold() or changes[effect.main] > 0 else int(np.argmax(changes))


def _judged(traces: Sequence[_Trace], threshold: float) -> Iterator[EffectCheck]:
    """Each effect at each place once: by the direction and the variant that show best."""
    best: dict[tuple[str, str], _Trace] = {}
    for trace in traces:
        key = trace.effect.name, trace.place
        if key not in best or trace.size > best[key].size:
            best[key] = trace
    level = math.sqrt(1 - 1 / INFLATED)
    shown = {key: _shows_from(trace, threshold) for key, trace in best.items()}
    for (name, place), trace in best.items():
        others = [
            other
            for (other, where), rival in best.items()
            if where == place
            and other != name
            and shown[other, where] is not None
            and len(rival.direction) == len(trace.direction)
            and abs(float(rival.direction @ trace.direction)) > level
        ]
        alike = tuple(others) if shown[name, place] is not None else ()
        nominal = None if trace.effect.is_threshold() else trace.kind.nominal
        yield EffectCheck(
            effect=name,
            where=place,
            parameter=trace.kind.name,
            unit=trace.kind.unit,
            nominal=nominal,
            shows_from=shown[name, place],
            confounded_with=alike,
        )


def _shows_from(trace: _Trace, threshold: float) -> float | None:
    """Smallest amount that would show, on the side of the probe; for a limit the probe itself, or nothing."""
    if trace.effect.is_threshold():
        return trace.amount if trace.size**2 >= threshold else None
    if trace.size == 0:
        return None
    kind = trace.kind
    amount = kind.nominal + (trace.amount - kind.nominal) * math.sqrt(threshold) / trace.size
    return amount if kind.lower <= amount <= kind.upper else None


# --- joints ------------------------------------------------------------------------------------------------------


def _joints(study: Study) -> Iterator[JointCheck]:
    robot, model = study.robot, study.robot.model
    ranges = joint_ranges(robot)
    saturated: dict[str, list[float]] = {}
    beyond: dict[str, list[float]] = {}
    floors: dict[str, float] = {}
    for episode in study.train:
        replay = episode.replay((), study.numerics, effort=True, threads=study.threads)
        outputs = replay.predict(np.zeros((1, 0)))
        for i, joint in enumerate(replay.index.joints):
            limit = _torque_limit(robot, joint, int(replay.index.actuator[i]))
            if outputs.effort is not None and np.isfinite(limit):
                saturated.setdefault(joint, []).append(float(np.mean(np.abs(outputs.effort[0, :, i]) >= FULL * limit)))
            log, (low, high) = episode.log, ranges.get(joint, (-np.inf, np.inf))
            if log.has("command", joint) and replay.index.drive[i] == "position":
                command = log.channels[f"command.{joint}"]
                beyond.setdefault(joint, []).append(float(np.mean((command < low) | (command > high))))
        for target in episode.compare(Terms(()), study.channels, study.numerics, threads=study.threads).targets:
            if target.channel == "position":
                floors |= dict(zip(target.joints, map(float, target.noise), strict=True))
    for joint, scale in study.scales.items():
        yield JointCheck(
            joint,
            "m" if slides(model, joint) else "rad",
            scale.span,
            scale.velocity_peak,
            scale.torque_peak,
            float(np.mean(saturated.get(joint, [0.0]))),
            float(np.mean(beyond.get(joint, [0.0]))),
            floors.get(joint),
        )


def _torque_limit(robot: Robot, joint: str, actuator: int) -> float:
    """Largest torque of a joint's drive, Nm or N; infinite where the model states none."""
    model = robot.model
    number, limits = model.joint(joint).id, [np.inf]
    if model.jnt_actfrclimited[number]:
        limits.append(float(np.max(np.abs(model.jnt_actfrcrange[number]))))
    if actuator >= 0 and actuator < model.nu and model.actuator_forcelimited[actuator]:
        gear = abs(float(model.actuator_gear[actuator, 0]))
        limits.append(gear * float(np.max(np.abs(model.actuator_forcerange[actuator]))))
    return min(limits)
