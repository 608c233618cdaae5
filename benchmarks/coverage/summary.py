"""Coverage of the intervals with its own uncertainty, and how wide they are against those of a right model."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from benchmarks.coverage.table import Row

LOWEST, HIGHEST = 0.92, 0.98
"""Coverage asked of 95 % intervals."""
NEEDED = {("nao", "lsq"): 100, ("leg", "lsq"): 200, ("leg", "posterior"): 200}
"""Logs asked for."""
WIDEST = 3.0
"""Median width asked for, against a correctly specified model's."""


@dataclass(frozen=True)
class Count:
    """How many of some intervals hold the truth.

    Attributes
    ----------
    inside, told : of the parameters that the results call identifiable.
    untold, untold_inside : of the others, counted apart.
    """

    inside: int
    told: int
    untold: int = 0
    untold_inside: int = 0

    @classmethod
    def of(cls, rows: Iterable[Row]) -> Count:
        rows = list(rows)
        told = [r for r in rows if r.identifiable != "no"]
        untold = [r for r in rows if r.identifiable == "no"]
        return cls(sum(r.covered for r in told), len(told), len(untold), sum(r.covered for r in untold))

    @property
    def share(self) -> float:
        return self.inside / self.told if self.told else float("nan")

    @property
    def interval(self) -> tuple[float, float]:
        """95 % interval of the share (Clopper and Pearson 1934), parameters taken as independent."""
        if not self.told:
            return 0.0, 1.0
        from scipy.stats import binomtest

        found = binomtest(self.inside, self.told).proportion_ci(0.95)
        return float(found.low), float(found.high)


def latest(rows: Sequence[Row]) -> list[Row]:
    """The rows of each log that were made last, whatever code made them."""
    last = {(r.robot, r.estimator, r.plant, r.number): r.key for r in rows}
    return [r for r in rows if last[(r.robot, r.estimator, r.plant, r.number)] == r.key]


def over_logs(rows: Sequence[Row]) -> tuple[float, float]:
    """95 % interval of the share inside, logs taken as independent: parameters of one log need not be."""
    told: dict[int, list[bool]] = {}
    for row in rows:
        if row.identifiable != "no":
            told.setdefault(row.number, []).append(row.covered)
    number = np.array([len(v) for v in told.values()], dtype=np.float64)
    inside = np.array([sum(v) for v in told.values()], dtype=np.float64)
    if len(number) < 2:
        return 0.0, 1.0
    share = inside.sum() / number.sum()
    # ratio estimator (Cochran 1977, sec. 6.4)
    spread = np.sqrt(np.sum((inside - share * number) ** 2) * len(number) / (len(number) - 1)) / number.sum()
    return float(max(share - 1.96 * spread, 0.0)), float(min(share + 1.96 * spread, 1.0))


def width_ratio(rows: Sequence[Row], own: Sequence[Row]) -> dict[str, tuple[float, int]]:
    """Parameter -> median ratio of widths to those on the same logs made by the replay itself, and of how many."""
    reference = {(r.number, r.parameter): r for r in own if r.identifiable != "no"}
    ratios: dict[str, list[float]] = {}
    for row in rows:
        other = reference.get((row.number, row.parameter))
        if other is not None and row.identifiable != "no" and other.width > 0:
            ratios.setdefault(row.parameter, []).append(row.width / other.width)
    pooled = [x for values in ratios.values() for x in values]
    if pooled:
        ratios["all"] = pooled
    return {name: (float(np.median(values)), len(values)) for name, values in ratios.items()}


def summarise(rows: Sequence[Row]) -> str:
    """One block of text for each robot and estimator."""
    rows = latest(rows)
    if not rows:
        return "no rows\n"
    blocks = []
    for robot, estimator, plant in dict.fromkeys((r.robot, r.estimator, r.plant) for r in rows):
        own = [r for r in rows if (r.robot, r.estimator, r.plant) == (robot, estimator, plant)]
        reference = [r for r in rows if (r.robot, r.estimator, r.plant) == (robot, estimator, "own")]
        blocks.append("\n".join(_block(own, reference if plant == "other" else ())))
    return "\n\n".join(blocks) + "\n"


def _block(rows: Sequence[Row], own: Sequence[Row]) -> list[str]:
    first = rows[0]
    logs = len({r.number for r in rows})
    made = {
        "other": "other engine, quantised",
        "own": "replay's own numerics, white noise",
        "recorded": "shared recordings",
    }
    seconds = [r.seconds for r in {r.number: r for r in rows}.values()]
    lines = [
        f"{first.robot} {first.estimator}: {logs} logs ({made.get(first.plant, first.plant)}), "
        f"{np.median(seconds):.1f} s each (code {', '.join(dict.fromkeys(r.code for r in rows))})",
        f"{'parameter':<28}{'inside':>12}{'share':>8}{'95 % of the share':>20}{'bias/std':>10}{'width':>8}"
        f"{'not told':>10}",
    ]
    ratios = width_ratio(rows, own)
    for name in dict.fromkeys(r.parameter for r in rows):
        mine = [r for r in rows if r.parameter == name]
        lines.append(_line(name, mine, ratios.get(name)))
    lines.append(_line("all", rows, ratios.get("all")))
    low, high = over_logs(rows)
    lines.append(f"all, logs taken as independent: {100 * low:.1f} to {100 * high:.1f} %")
    unconverged = len({r.number for r in rows if not r.converged})
    if unconverged:
        lines.append(f"{unconverged} logs not converged; counted all the same")
    lines += _verdict(first, logs, Count.of(rows), ratios.get("all"))
    return lines


def _line(name: str, rows: Sequence[Row], ratio: tuple[float, int] | None) -> str:
    count = Count.of(rows)
    told = [r for r in rows if r.identifiable != "no"]
    low, high = count.interval
    z = [(r.value - r.true) / r.std for r in told if r.std > 0]
    bias = f"{np.mean(z):+.2f}" if z else "-"
    width = "-" if ratio is None else f"{ratio[0]:.2f}"
    share = f"{100 * count.share:.1f} %" if told else "-"
    interval = f"{100 * low:.1f} to {100 * high:.1f} %" if told else "-"
    apart = f"{count.untold_inside}/{count.untold}" if count.untold else ""
    shown = name if len(name) < 28 else f"{name[:24]}..."
    return f"{shown:<28}{f'{count.inside}/{count.told}':>12}{share:>8}{interval:>20}{bias:>10}{width:>8}{apart:>10}"


def _verdict(first: Row, logs: int, count: Count, ratio: tuple[float, int] | None) -> list[str]:
    needed = NEEDED.get((first.robot, first.estimator))
    if first.plant != "other" or needed is None:
        return []
    state = "reached" if LOWEST <= count.share <= HIGHEST else "missed"
    if logs < needed:
        state = f"{state} so far, {needed - logs} logs to go"
    lines = [f"target {100 * LOWEST:.0f} to {100 * HIGHEST:.0f} % on at least {needed} logs: {state}"]
    if ratio is not None:
        state = "reached" if ratio[0] <= WIDEST else "missed"
        lines.append(f"target width at most {WIDEST:g} x a right model's: {ratio[0]:.2f} over {ratio[1]}, {state}")
    return lines
