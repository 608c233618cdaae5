"""``sysid-btr check``."""

from __future__ import annotations

import sys
from collections import Counter
from dataclasses import dataclass
from typing import TYPE_CHECKING

from sysid_btr.cli.close import declared
from sysid_btr.cli.groups import JsonOptions, ModelOptions, ParameterOptions, ReadingOptions, ThreadOptions
from sysid_btr.cli.inputs import as_stated, find_robot, read_logs, warn_of
from sysid_btr.cli.kinds import Names
from sysid_btr.cli.options import option
from sysid_btr.cli.terminal import print_json

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from rich.console import RenderableType

    from sysid_btr.checking import EffectCheck, LogCheck

MENTIONED = 3
"""Effects that are named as confounded with one; --json has all."""
FEW = 2
"""Places that are named one by one."""


@dataclass(frozen=True, kw_only=True)
class CheckOptions(ModelOptions, ReadingOptions, ParameterOptions, ThreadOptions, JsonOptions):
    """Options of `check`."""

    effects: Names = option(("all",), "Effects to check.", metavar="all|NAME[,NAME..]", decides=False)
    odds: float = option(
        99.0, "Odds in favour of an effect, from which it counts as visible.", metavar="N", decides=False
    )
    budget: float = option(60.0, "Seconds after which no further effects are tried.", metavar="SECONDS", decides=False)


def check(options: CheckOptions) -> int:
    """Say what a log is informative about, before anything is fitted.

    Which parameters are identifiable and with what error, which effects would show and from what size, how each joint
    moves, which drives reach their limits, and which motion would be more informative.
    """
    from sysid_btr.checking import check as check_logs
    from sysid_btr.progress import ProgressLine

    robot = find_robot(options, options.bounds)
    logs = as_stated(read_logs(options.log, robot), options)
    warn_of(robot, logs)
    with ProgressLine("check") as progress:
        found = check_logs(
            robot,
            logs,
            declared(robot, options.fit),
            effects=options.effects,
            odds=options.odds,
            budget=options.budget,
            threads=options.threads,
            progress=progress,
        )
    if options.json:
        print_json(found.to_dict())
        return 0
    from sysid_btr.display.text import console

    out = console(sys.stdout)
    for part in _parts(found):
        out.print(part)
    return 0


def _parts(found: LogCheck) -> Iterator[RenderableType]:
    from rich.text import Text

    from sysid_btr.display.text import identifiability, number
    from sysid_btr.units import si

    yield Text(found.message, style="bold")
    rows = [
        (
            j.joint,
            si(j.span, j.unit),
            si(j.velocity, f"{j.unit}/s"),
            si(j.torque, "N" if j.unit == "m" else "Nm"),
            f"{100 * j.saturated:.0f} %",
            f"{100 * j.beyond:.0f} %",
            "-" if j.floor is None else si(j.floor, j.unit),
        )
        for j in found.joints
    ]
    titles = ("joint", "moves by", "peak velocity", "peak torque", "at torque limit", "beyond range", "noise floor")
    yield _grid(titles, rows)
    parameters = [
        (
            p.name,
            number(p.nominal),
            number(p.std, 2) if p.identifiable != "no" else "-",
            "x nominal" if p.unit == "1" else p.unit,
            identifiability(p.to_dict()),
        )
        for p in found.parameters
    ]
    yield _grid(("parameter", "nominal", "expected std", "unit", "identifiable"), parameters)
    yield from (Text(f"  {p.name}: {p.reason}") for p in found.parameters if p.reason)
    by_effect: dict[str, list[EffectCheck]] = {}
    for effect in found.effects:
        by_effect.setdefault(effect.effect, []).append(effect)
    rows_of_effects = [_effect_row(name, places) for name, places in by_effect.items()]
    yield _grid(
        (f"effect (odds {found.odds:g}:1)", "would show at", "from a size of", "confounded with (at n places)"),
        [row for row in rows_of_effects if row is not None],
    )
    hidden = [name for name, row in zip(by_effect, rows_of_effects, strict=True) if row is None]
    if hidden:
        yield Text(f"would show nowhere: {', '.join(hidden)}")
    if found.skipped:
        yield Text(f"not tried for lack of time (--budget): {', '.join(found.skipped)}")
    yield from (Text(f"-> {line}") for line in found.advice)
    yield Text("expected for a model that is right otherwise; what it lacks makes everything less certain", style="dim")


def _effect_row(name: str, places: Sequence[EffectCheck]) -> tuple[str, str, str, str] | None:
    """Where an effect would show, from which size, and what looks like it; None if nowhere."""
    from sysid_btr.units import si_all

    shown = [e for e in places if e.size is not None]
    if not shown:
        return None
    where = ", ".join(e.where for e in shown) if len(shown) <= FEW else f"{len(shown)} of {len(places)} places"
    by_unit: dict[str, list[float]] = {}
    for e in shown:
        by_unit.setdefault("x nominal" if e.unit == "1" and e.nominal == 1 else e.unit, []).append(e.size or 0.0)
    sizes = []
    for unit, values in by_unit.items():
        low, high = si_all([min(values), max(values)], unit)
        sizes.append(high if low == high else f"{low.partition(' ')[0]} .. {high}")
    alike = Counter(other for e in shown for other in e.confounded_with).most_common()
    words = [other if n == len(shown) else f"{other} ({n})" for other, n in alike[:MENTIONED]]
    words += [f"{len(alike) - MENTIONED} more"] if len(alike) > MENTIONED else []
    return name, where, " or ".join(sizes), ", ".join(words)


def _grid(titles: Sequence[str], rows: Sequence[Sequence[str]]) -> RenderableType:
    from rich.box import SIMPLE_HEAD
    from rich.table import Table

    table = Table(box=SIMPLE_HEAD, pad_edge=False, show_edge=False, header_style="bold")
    for title in titles:
        table.add_column(title, overflow="fold")
    for row in rows:
        table.add_row(*row)
    return table
