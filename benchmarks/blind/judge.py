"""What counts as right: the verdict of a result against what was planted."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from reference_simulator import effects as planted

if TYPE_CHECKING:
    from reference_simulator.effects import Effect

Outcome = Literal["yes", "ambiguous", "provisional", "unexplained", "wrong", "missed", "error"]
EVERYWHERE, ALL_BUT = 6, 0.8
"""An effect planted at this many joints counts as found if this fraction of them, and no other, is named."""
ROBOT_WIDE = frozenset({"voltage_sag", "gravity_tilt"})


@dataclass(frozen=True)
class Named:
    """One name of a result with all its places; several entries under one name count as one."""

    effect: str
    where: frozenset[str]
    confused: frozenset[str]


@dataclass(frozen=True, eq=False)
class Planted:
    """One name of the truth with all its places; `effects` may have several sizes.

    Attributes
    ----------
    name : as in the library.
    where : all places.
    effects : as recorded.
    """

    name: str
    where: frozenset[str]
    effects: tuple[Effect, ...]

    def true(self, place: str) -> dict[str, float]:
        """The amounts at one place, as the library counts them."""
        own = next((e for e in self.effects if place in e.where), self.effects[0])
        return TRUE[self.name](own)


@dataclass(frozen=True)
class Context:
    """What decides which effects no log can tell apart.

    Attributes
    ----------
    effort : whether effort is logged.
    free : bodies whose mass is a declared parameter.
    """

    effort: bool
    free: frozenset[str]


Equivalence = Callable[[Planted, Context], bool]
EQUIVALENT: dict[frozenset[str], Equivalence] = {
    # without a second sensor a late command and a late encoder give the same positions
    frozenset({"command_delay", "sensor_delay"}): lambda e, c: not c.effort,
    # a stiff servo turns a torque into an offset; only effort shows which
    frozenset({"constant_force", "encoder_offset"}): lambda e, c: not c.effort,
    # mass is free, so a load on the body is a shift of its centre of mass but for a little inertia
    frozenset({"payload", "com_offset"}): lambda e, c: e.where <= c.free,
}
"""Pairs that count as right under the other's name, if the result says that they may be confused."""


@dataclass(frozen=True)
class Judgement:
    """Outcome, the reason in words, and how far off the amounts are.

    Attributes
    ----------
    amplitude_error : |found - true| / |true| of the worst effect, nan where nothing was found right.
    inside, told : how many true amounts lie in their 95 % intervals, of those the result calls identifiable.
    """

    outcome: Outcome
    why: str
    amplitude_error: float
    inside: int
    told: int


def judge(
    result: Mapping[str, Any], effects: Sequence[Effect], robot_joints: Sequence[str], context: Context
) -> Judgement:
    """Compare a result of `close` with the planted effects (places resolved to names).

    Parameters
    ----------
    result : content of result.json.
    effects : planted, of the library or not.
    robot_joints : all joints of the robot.
    context : what the log holds.
    """
    names = named_effects(e for e in result["effects"] if e.get("certainty", 1.0) > 0.5)
    inside = all(e.in_library for e in effects)
    if not effects or not inside:
        outcome, why = _nothing_to_name(result["verdict"], names, expected="" if not effects else effects[0].name)
        return Judgement(outcome, why, math.nan, 0, 0)
    true = planted_names(effects)
    outcome, why, matched = _match(result["verdict"], names, true, context)
    errors, hits, told = [], 0, 0
    for one in matched:
        error, k, n = _amounts(one, result["effects"])
        errors.append(error)
        hits, told = hits + k, told + n
    known = [e for e in errors if math.isfinite(e)]
    return Judgement(outcome, why, max(known, default=math.nan), hits, told)


def planted_names(effects: Sequence[Effect]) -> tuple[Planted, ...]:
    """The truth, each name once."""
    own: dict[str, list[Effect]] = {}
    for effect in effects:
        own.setdefault(effect.name, []).append(effect)
    return tuple(Planted(n, frozenset(p for e in es for p in e.where), tuple(es)) for n, es in own.items())


def named_effects(entries: Iterable[Mapping[str, Any]]) -> tuple[Named, ...]:
    """The names of a result, each once."""
    where: dict[str, set[str]] = {}
    confused: dict[str, set[str]] = {}
    for entry in entries:
        where.setdefault(entry["effect"], set()).update(entry["where"])
        confused.setdefault(entry["effect"], set()).update(entry["confused_with"])
    return tuple(Named(n, frozenset(w), frozenset(confused[n] - {n})) for n, w in where.items())


def _nothing_to_name(verdict: str, names: tuple[Named, ...], expected: str) -> tuple[Outcome, str]:
    if names:
        return ("wrong", f"named {', '.join(sorted(n.effect for n in names))} where the library has nothing to name")
    if not expected:
        return ("yes", "") if verdict == "nothing_missing" else ("unexplained", "a residual that is not there")
    return ("yes", "") if verdict == "unexplained" else ("missed", f"{expected} went unseen")


def _match(
    verdict: str, names: tuple[Named, ...], effects: Sequence[Planted], context: Context
) -> tuple[Outcome, str, tuple[Planted, ...]]:
    if verdict == "nothing_missing":
        return "missed", "nothing seen", ()
    if not names:
        return "unexplained", "", ()
    right = {e: next((n for n in names if n.effect == e.name and same_place(e, n.where)), None) for e in effects}
    found = tuple(e for e in effects if right[e])
    under = {e: right[e] or _under_another_name(e, names, context) for e in effects}
    extra = [n for n in names if n not in under.values()]
    if all(under.values()) and not extra:
        doubts = [_doubts(e, n, context) for e, n in under.items() if n is not None]
        if verdict == "explained" or not any(doubts):
            return "yes", "", found
        return "ambiguous", "; ".join(f"or {', '.join(sorted(d))}" for d in doubts if d), found
    loose = {
        e: next((n for n in names if e.name in {n.effect, *n.confused} and same_place(e, n.where)), None)
        for e in effects
    }
    unmatched = [n for n in names if n not in loose.values()]
    if verdict == "ambiguous" and all(loose.values()) and not unmatched:
        return "ambiguous", "the true name is among the rivals", found
    if found and not extra:
        return "missed", f"not seen: {', '.join(e.name for e in effects if e not in found)}", found
    return "wrong", "; ".join(_wrong(n, effects) for n in extra), found


def _wrong(name: Named, effects: Sequence[Planted]) -> str:
    same = any(e.name == name.effect for e in effects)
    place = ", ".join(sorted(name.where)) if len(name.where) < EVERYWHERE else f"{len(name.where)} places"
    return f"{name.effect} at {place}, {'other places than planted' if same else 'not planted'}"


def _under_another_name(effect: Planted, names: tuple[Named, ...], context: Context) -> Named | None:
    for pair, cannot_tell in EQUIVALENT.items():
        if effect.name not in pair or not cannot_tell(effect, context):
            continue
        for name in names:
            if name.effect in pair and effect.name in name.confused and same_place(effect, name.where):
                return name
    return None


def _doubts(effect: Planted, name: Named, context: Context) -> frozenset[str]:
    """What the name may be confused with, less what no log can tell from it."""
    same = {n for pair, c in EQUIVALENT.items() if effect.name in pair and c(effect, context) for n in pair}
    return name.confused - same - {effect.name}


def same_place(effect: Planted, where: frozenset[str]) -> bool:
    """Whether an effect was named where it is."""
    if effect.name in ROBOT_WIDE:
        return True
    true = effect.where
    if len(true) >= EVERYWHERE:
        return where <= true and len(where) >= ALL_BUT * len(true)
    return where == true


# ---- amounts --------------------------------------------------------------------------------------


def _tilt(e: planted.GravityTilt) -> dict[str, float]:
    """The library turns gravity about x, then y; the recorder turns the base."""
    cr, sr, cp, sp = math.cos(e.roll), math.sin(e.roll), math.cos(e.pitch), math.sin(e.pitch)
    about_x = np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
    about_y = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
    g = (about_y @ about_x).T @ np.array([0.0, 0.0, -1.0])
    return {"x": math.asin(g[1]), "y": math.atan2(-g[0], -g[2])}


def _xyz(vector: Sequence[float]) -> dict[str, float]:
    return dict(zip("xyz", vector, strict=True))


TRUE: dict[str, Callable[[Any], dict[str, float]]] = {
    "coulomb_friction": lambda e: {"torque": e.torque},
    "viscous_damping": lambda e: {"b": e.coefficient},
    "quadratic_damping": lambda e: {"b": e.coefficient},
    "stribeck_friction": lambda e: {"static": e.static - e.coulomb, "coulomb": e.coulomb, "velocity": e.velocity},
    "load_friction": lambda e: {"ratio": e.coefficient},
    "armature": lambda e: {"inertia": e.inertia},
    "command_delay": lambda e: {"time": e.delay},
    "sensor_delay": lambda e: {"time": e.delay},
    "backlash": lambda e: {"play": e.play},
    "joint_compliance": lambda e: {"softness": 1.0 / e.stiffness},
    "joint_spring": lambda e: {"stiffness": e.stiffness, "rest": e.rest},
    "encoder_offset": lambda e: {"offset": e.offset},
    "encoder_scale": lambda e: {"error": e.scale - 1.0},
    "torque_limit": lambda e: {"limit": e.limit},
    "speed_torque_limit": lambda e: {"stall": e.stall, "no_load_speed": e.no_load_speed},
    "slew_limit": lambda e: {"rate": e.rate},
    "integral_gain": lambda e: {"ki": e.ki},
    "voltage_sag": lambda e: {"rate": e.rate} if e.rate else {"ratio": e.per_torque},
    "thermal_derating": lambda e: {"alpha": e.alpha, "tau": e.time_constant},
    "payload": lambda e: {"mass": e.mass, **_xyz(e.offset)},
    "com_offset": lambda e: _xyz(e.offset),
    "constant_force": lambda e: {"torque": e.torque},
    "cogging": lambda e: {
        "sine": e.amplitude * math.cos(e.phase),
        "cosine": e.amplitude * math.sin(e.phase),
        "number": e.periods,
    },
    "external_disturbance": lambda e: {"torque": e.torque, "start": e.start, "duration": e.duration},
    "gravity_tilt": _tilt,
}
"""The planted amounts as the library counts them, by kind of parameter; the first says how large the effect is."""
VECTORS = {"com_offset": 3, "cogging": 2, "gravity_tilt": 2}
"""Effects whose size is the length of their first few numbers."""


def _amounts(planted_effect: Planted, entries: Sequence[Mapping[str, Any]]) -> tuple[float, int, int]:
    """Worst relative error of the size over places; how many amounts lie in their intervals, of how many."""
    name = planted_effect.name
    errors, inside, told = [], 0, 0
    for entry in entries:
        if entry["effect"] != name:
            continue
        by_group: dict[str, dict[str, Mapping[str, Any]]] = {}
        for p in entry["parameters"]:
            label, _, group = p["name"].partition(":")
            kind = label.partition(".")[2]
            by_group.setdefault(group, {})[kind] = p
        for group, numbers in by_group.items():
            # one amount for several places is compared with the first of them
            true = planted_effect.true(group.partition(",")[0])
            found = {k or next(iter(true)): p for k, p in numbers.items()}
            known = {k: p for k, p in found.items() if k in true and p["identifiable"] != "no" and _has(p)}
            told += len(known)
            inside += sum(p["ci95"][0] <= true[k] <= p["ci95"][1] for k, p in known.items())
            own = [k for k in list(true)[: VECTORS.get(name, 1)] if k in known]
            length = math.hypot(*(true[k] for k in own))
            if length > 0:
                errors.append(math.hypot(*(known[k]["value"] - true[k] for k in own)) / length)
    return max(errors, default=math.nan), inside, told


def _has(parameter: Mapping[str, Any]) -> bool:
    low, high = parameter["ci95"]
    return low is not None and high is not None


SIGNATURES: dict[str, tuple[str, ...]] = {
    "gain_drift": ("period", "time"),
    "friction_patch": ("position", "angle"),
    "controller_dropout": ("localis", "period"),
    "cable_coupling": ("position", "angle", "joint"),
    "random_walk_torque": ("time", "slow", "localis"),
}
"""Words of which one belongs into the summary of what is left."""


def signature_fits(effects: Sequence[Effect], signature: Mapping[str, Any] | None) -> bool | None:
    """Whether the summary of the residual says what it should; None where that is not asked."""
    outside = [e for e in effects if not e.in_library]
    if not outside or not signature:
        return None
    summary = str(signature.get("summary", "")).lower()
    told = any(word in summary for word in SIGNATURES[outside[0].name])
    places = str(signature).lower()
    return told and (len(outside[0].where) > 2 or any(j.lower() in places for j in outside[0].where))
