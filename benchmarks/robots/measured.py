"""Measured robots: our figures beside published ones, those made by hand, and a linear regression's."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from benchmarks.robots.run import Run, run

COUPLED = ("joint_5", "joint_6")
TX40_VISCOUS = (8.05, 5.53, 1.97, 1.11, 1.86, 0.65)
TX40_COULOMB = (7.14, 8.26, 6.34, 2.48, 3.03, 0.28)
TX40_ROTOR = (0.362, 0.362, 0.099, 0.031, 0.047, 0.0105)
TX40_OWN_ROTOR = (0.36, 0.36, 0.1, 0.03, 0.045, 0.01)
"""kg m2, what the model already has (tx40.xml; the URDF has none)."""
TX40_COUPLING = {"inertia": 0.0096, "viscous": 0.62, "coulomb": 1.95}
SHARED = {"viscous": ("drive_coupling.viscous", COUPLED[0]), "rotor": ("drive_coupling.inertia", COUPLED[0])}
"""Published numbers of joints 5 and 6 that hold what the coupling adds on the diagonal, as their model is written
(Janot, Vandanjon, Gautier 2014, doi:10.1109/TCST.2013.2246163); its dry friction stands apart."""
TX40_HAND = {"viscous": (8.03, 5.55, 1.99, 1.09, 1.34, 0.57), "coulomb": (7.16, 8.13, 6.33, 2.52, 4.87, 2.70)}
DFKI_HAND = {"shoulder": 0.20, "elbow": 0.18}
DFKI_PUBLISHED = {"shoulder": 0.16, "elbow": 0.12}
DFKI_OPEN_LOOP = {"C1_143747": 0.064, "C1_143601": 0.214}
KUKA_OFFSETS = {"lwr_0_joint": 0.85, "lwr_4_joint": -0.65, "lwr_5_joint": 0.56}
KUKA_LATE = 1.41
INVERSE_FIT = ("mass", "frictionloss", "damping", "torque_offset")

_Found = tuple[float | None, tuple[float, float] | None]
"""A number and its 95 % interval, as far as there are any."""


@dataclass(frozen=True)
class Figure:
    """One number of a measured robot.

    Attributes
    ----------
    what : with its unit.
    ours : None where there is none.
    interval : 95 %, where there is one.
    published, hand, regression : of others, where known.
    reached : whether the goal is met; None where none is set.
    """

    what: str
    ours: float | None
    interval: tuple[float, float] | None = None
    published: float | None = None
    hand: float | None = None
    regression: float | None = None
    reached: bool | None = None


@dataclass(frozen=True)
class Measured:
    """A recording of a real robot, and what is made of it."""

    name: str
    title: str
    folder: str
    examine: Callable[[Path, Path, float], dict[str, Any]]

    def missing(self, data: Path) -> str:
        """Why it cannot be done here; empty if it can."""
        return "" if (data / self.folder).is_dir() else f"no recordings in {data / self.folder}; set SYSID_BTR_DATA"


def measured() -> tuple[Measured, ...]:
    """All of them."""
    return (
        Measured("tx40_urdf", "six axes, the URDF as it is; positions and torques alone", "tx40", _tx40("tx40.urdf")),
        Measured("tx40", "the same, from an MJCF with rotors", "tx40", _tx40("tx40_with_servos.xml")),
        Measured("dfki_C1_143339", "two links, torque motors", "dfki_double_pendulum", _dfki("C1_143339")),
        Measured("dfki_C1_144003", "two links, torque motors", "dfki_double_pendulum", _dfki("C1_144003")),
        Measured("dfki_transfer", "friction of design A, used on C1", "dfki_double_pendulum", _transfer),
        Measured("kuka_1", "seven axes with torque sensors, by inverse dynamics", "kuka_lwr4", _kuka),
    )


# ---- TX40 -----------------------------------------------------------------------------------------


def _tx40(model: str) -> Callable[[Path, Path, float], dict[str, Any]]:
    def examine(data: Path, out: Path, limit: float) -> dict[str, Any]:
        place, log = data / "tx40" / model, data / "tx40" / "logs" / "tx40.parquet"
        done = run(("close", "--model", str(place), "--log", str(log)), out, limit)
        baseline = _regression(place, log, (COUPLED,))
        found = _effects(done.result)
        figures = []
        published = {"viscous": TX40_VISCOUS, "coulomb": TX40_COULOMB, "rotor": TX40_ROTOR}
        for kind, effect in (("viscous", "viscous_damping"), ("coulomb", "coulomb_friction"), ("rotor", "armature")):
            for k, true in enumerate(published[kind]):
                joint = f"joint_{k + 1}"
                already = TX40_OWN_ROTOR[k] if kind == "rotor" and model.endswith(".xml") else 0.0
                value, interval = _shifted(found.get((effect, joint)), already)
                if joint in COUPLED and kind in SHARED:
                    value, interval = _together((value, interval), found.get(SHARED[kind]))
                regressed = None if kind == "rotor" else baseline.friction[f"{kind}:{joint}"]
                if regressed is not None and joint in COUPLED and kind in SHARED:
                    regressed += baseline.friction[f"{kind}:{'+'.join(COUPLED)}"]
                near = value is not None and abs(value / true - 1) <= 0.05
                held = interval is not None and interval[0] <= true <= interval[1]
                reached: bool | None = near if k < 4 and kind != "rotor" else held
                if already:  # nothing is missing there
                    reached = None
                hand = TX40_HAND[kind][k] if kind in TX40_HAND else None
                figures.append(Figure(f"{kind} {joint}", value, interval, true, hand, regressed, reached))
        for kind, true in TX40_COUPLING.items():
            value, interval = found.get((f"drive_coupling.{kind}", COUPLED[0]), (None, None))
            held = interval is not None and interval[0] <= true <= interval[1]
            regressed = None if kind == "inertia" else baseline.friction[f"{kind}:{'+'.join(COUPLED)}"]
            figures.append(Figure(f"wrist coupling {kind}", value, interval, true, None, regressed, held))
        figures += _torque_error(done, baseline.heldout, 1.05)
        return _row(done, [*figures, _time(done, 30)])

    return examine


# ---- DFKI -----------------------------------------------------------------------------------------


def _dfki(name: str) -> Callable[[Path, Path, float], dict[str, Any]]:
    def examine(data: Path, out: Path, limit: float) -> dict[str, Any]:
        folder = data / "dfki_double_pendulum"
        model, log = folder / "double_pendulum_C1.xml", folder / "logs" / f"{name}.parquet"
        done = run(("close", "--model", str(model), "--log", str(log)), out, limit)
        found = _effects(done.result)
        figures = []
        for joint, hand in DFKI_HAND.items():
            value, interval = found.get(("coulomb_friction", joint), (None, None))
            near = value is not None and abs(value / hand - 1) <= 0.15
            figures.append(Figure(f"coulomb {joint}, Nm", value, interval, DFKI_PUBLISHED[joint], hand, None, near))
        others = sorted({e["effect"] for e in done.result.get("effects", ())} - {"coulomb_friction", "viscous_damping"})
        figures.append(Figure("effects that imitate", float(len(others)), reached=done.came_to_a_result and not others))
        if done.came_to_a_result:
            for other, hand in DFKI_OPEN_LOOP.items():
                error = _open_loop(model, folder / "logs" / f"{other}.parquet", out / "open_loop", out)
                reached = error is not None and error <= hand
                figures.append(Figure(f"open loop {other}, rad", error, None, None, hand, None, reached))
        return _row(done, [*figures, _time(done, 60)])

    return examine


def _open_loop(model: Path, log: Path, work: Path, params: Path) -> float | None:
    """Position rmse of a replay of the whole log under the result of a run, rad."""
    replayed = run(
        ("replay", "--model", str(model), "--log", str(log), "--params", str(params), "--segments", "whole", "--json"),
        work / log.stem,
        300.0,
    )
    if not replayed.came_to_a_result:
        return None
    return _first(replayed.result, "position")


def _transfer(data: Path, out: Path, limit: float) -> dict[str, Any]:
    """Friction fitted on all logs of design A, masses on C1; over friction and masses fitted on C1."""
    folder = data / "dfki_double_pendulum"
    logs_a, log_c = sorted((folder / "logs").glob("A*.parquet")), folder / "logs" / "C1_143339.parquet"
    of_design = [word for log in logs_a for word in ("--log", str(log))]
    friction = ("--fit", "frictionloss:*", "--fit", "damping:*")
    masses = ("--fit", "mass:*")
    alike = ("--segments", "1")  # which segments a log is cut into depends on the model's friction
    of_a = run(
        ("fit", "--model", str(folder / "double_pendulum_A.xml"), *of_design, *friction, *masses), out / "of_a", limit
    )
    found = {p["name"]: p["value"] for p in of_a.result.get("parameters", ())}
    model_c = str(folder / "double_pendulum_C1.xml")
    own = run(("fit", "--model", model_c, "--log", str(log_c), *friction, *masses, *alike), out / "own", limit)
    values = {n: v for n, v in found.items() if not n.startswith("mass")}
    taken = run(
        ("fit", "--model", str(_with_friction(folder, values, out)), "--log", str(log_c), *masses, *alike),
        out / "taken",
        limit,
    )
    errors = [_held_out(r, "position") for r in (own, taken)]
    ratio = errors[1] / errors[0] if errors[0] and errors[1] else None
    figures = [Figure(f"{name} of A", value) for name, value in values.items()]
    figures.append(
        Figure("held-out error with friction of A over own", ratio, reached=ratio is not None and ratio <= 1.2)
    )
    return _row(of_a, figures)


def _with_friction(folder: Path, values: Mapping[str, float], out: Path) -> Path:
    """C1's model with friction of its joints."""
    import mujoco
    import numpy as np

    spec = mujoco.MjSpec.from_file(str(folder / "double_pendulum_C1.xml"))
    for name, value in values.items():
        field, _, joint = name.partition(":")
        # damping is a polynomial of the speed
        own = np.atleast_1d(getattr(spec.joint(joint), field)).copy()
        own[0] = value
        setattr(spec.joint(joint), field, own if len(own) > 1 else value)
    spec.compile()
    place = out / "C1_with_friction_of_A.xml"
    place.parent.mkdir(parents=True, exist_ok=True)
    place.write_text(spec.to_xml())
    return place


# ---- KUKA -----------------------------------------------------------------------------------------


def _kuka(data: Path, out: Path, limit: float) -> dict[str, Any]:
    folder = data / "kuka_lwr4"
    model, log = folder / "kuka.xml", folder / "logs" / "kuka_1.parquet"
    free = [word for field in INVERSE_FIT for word in ("--fit", f"{field}:*")]
    done = run(("fit", "--model", str(model), "--log", str(log), "--mode", "inverse", *free), out, limit)
    baseline = _regression(model, log, ())
    own = {p["name"]: p for p in done.result.get("parameters", ())}
    figures = []
    for joint, hand in KUKA_OFFSETS.items():
        p = own.get(f"torque_offset:{joint}")
        value = None if p is None else float(p["value"])
        near = value is not None and abs(value - hand) <= 0.1
        interval = None if p is None or p["ci95"][0] is None else (p["ci95"][0], p["ci95"][1])
        figures.append(Figure(f"torque offset {joint}, Nm", value, interval, None, hand, None, near))
    figures += _torque_error(done, baseline.heldout, None)
    share = _share_of_range(done, model)
    small = share is not None and share <= 0.01
    figures.append(Figure("held-out torque error, of the limits' range", share, published=0.002, reached=small))
    return _row(done, figures)


def _share_of_range(done: Run, model: Path) -> float | None:
    """Root mean square over joints of held-out error over the range of the torque limits, as published (FloBaRoID)."""
    import mujoco
    import numpy as np

    if not done.came_to_a_result:
        return None
    compiled = mujoco.MjModel.from_xml_path(str(model))
    joints = done.result["after"]["holdout"]["effort"]["joints"]
    shares = [e / np.ptp(compiled.jnt_actfrcrange[compiled.joint(j).id]) for j, e in joints.items()]
    return float(np.sqrt(np.mean(np.square(shares))))


# ---- all ------------------------------------------------------------------------------------------


def _regression(model: Path, log: Path, sums: Sequence[tuple[str, str]]) -> Any:
    from benchmarks.robots.regression import regress
    from sysid_btr.identify.inverse import InverseEpisode
    from sysid_btr.io.parquet import read_log
    from sysid_btr.models.builtin import load_robot

    fitted, held = InverseEpisode.split(load_robot(str(model)), read_log(log), 0.3)
    return regress(fitted, held, sums)


def _effects(result: Mapping[str, Any]) -> dict[tuple[str, str], _Found]:
    """(effect.kind, or effect for its first one, joint) -> value and interval."""
    found: dict[tuple[str, str], _Found] = {}
    for entry in result.get("effects", ()):
        for p in entry["parameters"]:
            label, _, places = p["name"].partition(":")
            kind = label.rpartition(".")[2]
            interval = None if p["ci95"][0] is None else (p["ci95"][0], p["ci95"][1])
            for place in places.split(","):
                found.setdefault((entry["effect"], place), (p["value"], interval))
                found[f"{entry['effect']}.{kind}", place] = (p["value"], interval)
    return found


def _shifted(found: _Found | None, by: float) -> _Found:
    if found is None or found[0] is None:
        return (by or None), None
    value, interval = found[0], found[1]
    return value + by, None if interval is None else (interval[0] + by, interval[1] + by)


def _together(one: _Found, other: _Found | None) -> _Found:
    """The sum of two independent estimates."""
    if other is None or other[0] is None:
        return one
    if one[0] is None:
        return other
    value = one[0] + other[0]
    if one[1] is None or other[1] is None:
        return value, None
    half = math.hypot(*(0.5 * (high - low) for low, high in (one[1], other[1])))
    return value, (value - half, value + half)


def _torque_error(done: Run, regression: float, limit: float | None) -> list[Figure]:
    ours = _held_out(done, "effort")
    ratio = None if ours is None else ours / regression
    reached = None if limit is None else ratio is not None and ratio <= limit
    return [
        Figure("held-out torque rmse, Nm", ours, regression=regression),
        Figure("held-out torque rmse over the regression's", ratio, reached=reached),
    ]


def _held_out(done: Run, channel: str) -> float | None:
    return float(done.result["after"]["holdout"][channel]["rmse"]) if done.came_to_a_result else None


def _first(result: Any, channel: str) -> float | None:
    """The rmse of a channel, wherever a replay's result has it."""
    if isinstance(result, Mapping):
        own = result.get(channel)
        if isinstance(own, Mapping) and isinstance(own.get("rmse"), int | float):
            return float(own["rmse"])
        return next((f for f in (_first(v, channel) for v in result.values()) if f is not None), None)
    return None


def _time(done: Run, limit: float) -> Figure:
    return Figure("seconds", round(done.seconds, 1), reached=done.came_to_a_result and done.seconds <= limit)


def _row(done: Run, figures: Sequence[Figure]) -> dict[str, Any]:
    why = "" if done.came_to_a_result else ("time was up" if done.code is None else f"exit {done.code}: {done.said}")
    goals = [f.reached for f in figures if f.reached is not None]
    return {
        "answer": "no result" if why else "right" if all(goals) else "not right",
        "verdict": done.result.get("verdict", ""),
        "found": "; ".join(f"{e['effect']} at {', '.join(e['where'])}" for e in done.result.get("effects", ())),
        "why": why or "; ".join(f.what for f in figures if f.reached is False),
        "seconds": round(done.seconds, 1),
        "cpu_seconds": round(done.cpu, 1),
        "figures": [{k: _finite(v) for k, v in asdict(f).items()} for f in figures],
    }


def _finite(value: Any) -> Any:
    return None if isinstance(value, float) and not math.isfinite(value) else value
