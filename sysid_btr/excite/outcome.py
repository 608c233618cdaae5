"""A designed motion for users: result.json and table."""

from __future__ import annotations

import signal
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import numpy as np

from sysid_btr.estimators.base import Termination
from sysid_btr.result import SCHEMA, clean, versions

if TYPE_CHECKING:
    from rich.console import RenderableType

    from sysid_btr.excite.design import Design
    from sysid_btr.identify.intervals import Estimate

MOTION = "excite.parquet"
WARNING = (
    "Only the limits of the joints keep this motion from hitting the robot itself or the ground: replay it in a viewer "
    "first, and execute it slowly at first."
)


@contextmanager
def first_interrupt_ends_the_search() -> Iterator[None]:
    """Ctrl-C ends a search, which then gives its best, and not the run."""
    try:
        previous = signal.signal(signal.SIGINT, signal.default_int_handler)
    except ValueError:  # not in the main thread, which alone hears signals
        yield
        return
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, previous)


def interrupted(design: Design) -> bool:
    """Whether the search was stopped before its end."""
    return design.result.termination is Termination.INTERRUPTED


def make_result(design: Design, *, seed: int = 0) -> dict[str, Any]:
    """The content of result.json: kind ``excite``.

    A parameter's ``value`` is its nominal one; ``std`` and ``ci95`` are what a fit of a log of the motion to this
    model is expected to give, ``reference`` has the same of the reference motion.
    """
    after, before = design.designed.estimates, design.reference.estimates
    family, clock = design.family, design.family.clock
    commands = family.commands(design.coefficients)[1]
    step = 1 / clock.rate
    floors: dict[str, list[float]] = {}
    for (channel, _), sigma in design.experiment.sensors.floor.items():
        floors.setdefault(channel, []).append(sigma)
    plain: dict[str, Any] = clean(
        {
            "schema": SCHEMA,
            "kind": "excite",
            "message": message(design),
            "termination": design.result.termination.value,
            "parameters": [
                {**a.to_dict(), "reference": _uncertainty(b), "ratio": float(ratio) if known else None}
                for a, b, ratio, known in zip(after, before, design.ratios, design.identifiable, strict=True)
            ],
            "effects": [],
            "mean_ratio": design.mean_ratio,
            "reference": {"motion": design.compared_with, "seconds": design.reference.seconds},
            "motion": {
                "file": MOTION,
                "seconds": clock.seconds,
                "rate": clock.rate,
                "repeats_after": clock.period,
                "frequencies": clock.frequencies,
                "motors": [
                    {
                        "joints": list(m.joints),
                        "position": {"limits": [m.low, m.high], "used": [float(q.min()), float(q.max())]},
                        "velocity": {"limit": m.velocity, "used": float(np.abs(np.diff(q)).max() / step)},
                        "acceleration": {"limit": m.acceleration, "used": float(np.abs(np.diff(q, 2)).max() / step**2)},
                    }
                    for m, q in zip(family.motors, commands.T, strict=True)
                ],
                "predicted_beyond_range": dict(design.beyond),
                "warning": WARNING,
            },
            "noise_floor": {channel: float(np.median(values)) for channel, values in floors.items()},
            "noise_floor_source": design.experiment.sensors.source,
            "numerics": {"chosen": str(design.experiment.numerics)},
            "versions": versions(),
            "model": design.experiment.robot.to_dict(),
            "seed": seed,
            "motions_tried": design.result.evaluations,
            "wall_s": design.seconds,
        }
    )
    return plain


def _uncertainty(estimate: Estimate) -> dict[str, Any]:
    entry = estimate.to_dict()
    return {key: entry[key] for key in ("std", "ci95", "identifiable", "reason")}


def message(design: Design) -> str:
    """The outcome in one sentence."""
    count = sum(e.identifiable != "no" for e in design.designed.estimates)
    parts = [
        f"{count} of {len(design.designed.estimates)} parameters are identifiable from this motion of "
        f"{design.family.clock.seconds:g} s"
    ]
    if any(design.identifiable):
        parts.append(
            f"on average their intervals are {design.mean_ratio:.2f} of those after {design.compared_with} "
            f"({design.reference.seconds:.3g} s)"
        )
    if design.beyond:
        worst = max(design.beyond, key=lambda joint: design.beyond[joint])
        parts.append(f"in the model {worst} exceeds its range by {design.beyond[worst]:.2g}")
    return "; ".join(parts) + "."


def show(result: Mapping[str, Any]) -> Iterator[RenderableType]:
    """The result for a terminal."""
    from rich.box import SIMPLE_HEAD
    from rich.table import Table
    from rich.text import Text

    from sysid_btr.display.text import identifiability, number

    yield Text(result["message"], style="bold")
    table = Table(box=SIMPLE_HEAD, pad_edge=False, show_edge=False, header_style="bold")
    table.add_column("parameter", overflow="fold")
    for name in ("nominal", f"std, {result['reference']['motion']}", "std, designed", "95 % interval +-", "ratio"):
        table.add_column(name, justify="right")
    table.add_column("unit")
    table.add_column("identifiable")
    for p in result["parameters"]:
        known, before = p["identifiable"] != "no", p["reference"]
        table.add_row(
            p["name"],
            number(p["nominal"]),
            number(before["std"], 2) if before["identifiable"] != "no" else "-",
            number(p["std"], 2) if known else "-",
            number(0.5 * (p["ci95"][1] - p["ci95"][0]), 2) if known else "-",
            number(p["ratio"], 2),
            "x nominal" if p["unit"] == "1" else p["unit"],
            identifiability(p),
        )
    yield table
    for p in result["parameters"]:
        if p["reason"]:
            yield Text(f"  {p['name']}: {identifiability(p)}: {p['reason'].replace('this log', 'this motion')}")
    floors = ", ".join(f"{channel} {value:.3g}" for channel, value in result["noise_floor"].items())
    yield Text(f"noise floor {result['noise_floor_source']}: {floors} (SI, median over joints)", style="dim")
    yield Text(
        f"{result['motions_tried']} motions tried in {result['wall_s']:.1f} s; seed {result['seed']}; "
        f"{result['numerics']['chosen']}",
        style="dim",
    )
