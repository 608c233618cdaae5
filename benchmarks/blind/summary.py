"""Totals against the targets, and which effect was taken for which."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

from benchmarks.blind.draw import PARTS
from benchmarks.blind.table import Row

OUTCOMES = ("yes", "ambiguous", "provisional", "unexplained", "missed", "wrong", "error")
MOSTLY_GONE = 0.7
"""Share of the excess error."""


def latest(rows: Sequence[Row], code: str | None = None) -> list[Row]:
    """The last row of each log, of one state of the code if given."""
    chosen: dict[str, Row] = {}
    for row in rows:
        if code is None or row.code == code:
            chosen.pop(row.id, None)
            chosen[row.id] = row
    return sorted(chosen.values(), key=lambda r: (r.series, list(PARTS).index(r.part), r.number))


def summarise(rows: Sequence[Row]) -> str:
    """Totals by part, targets, confusion table and the logs that went wrong."""
    if not rows:
        return "no rows"
    lines = [f"code {', '.join(dict.fromkeys(r.code for r in rows))}", ""]
    lines.append(f"{'part':<9}{'logs':>5}" + "".join(f"{o:>12}" for o in OUTCOMES) + f"{'mean s':>9}{'max s':>7}")
    for part in PARTS:
        own = [r for r in rows if r.part == part]
        if not own:
            continue
        counts = Counter(r.correct for r in own)
        seconds = [r.seconds for r in own]
        lines.append(
            f"{part:<9}{len(own):>5}"
            + "".join(f"{counts[o]:>12}" for o in OUTCOMES)
            + f"{sum(seconds) / len(seconds):>9.0f}{max(seconds):>7.0f}"
        )
    lines += [
        "",
        *_targets(rows),
        *_by_robot(rows),
        "",
        *_calibration(rows),
        "",
        *_amounts(rows),
        "",
        *_confusion(rows),
        "",
        *_failures(rows),
    ]
    return "\n".join(lines).rstrip() + "\n"


def _targets(rows: Sequence[Row]) -> list[str]:
    def count(part: str, *outcomes: str) -> int:
        return sum(r.part == part and r.correct in outcomes for r in rows)

    def unnamed(part: str) -> int:
        return sum(r.part == part and not r.named and r.correct != "error" for r in rows)

    def target(part: str, what: str, value: int, needed: int, most: bool = False) -> str:
        done = sum(r.part == part for r in rows)
        reached = value <= needed if most else value >= needed
        state = "reached" if reached and done == PARTS[part] else "missed"
        if done < PARTS[part] and (reached or (not most and value + PARTS[part] - done >= needed)):
            state = "open"
        sign = "at most" if most else "at least"
        return f"{what:<40}{value:>4} of {done:<3} target {sign} {needed} of {PARTS[part]}: {state}"

    gone = sum(r.part == "shape" and float(r.excess_gone or 0.0) >= MOSTLY_GONE for r in rows)
    improved = [r for r in rows if r.part == "clean" and _improvement(r) > 0.02]
    fits = sum(r.signature_fits == "yes" for r in rows if r.part == "outside")
    return [
        target("single", "one effect: right name and place", count("single", "yes"), 54),
        target("single", "one effect: wrong name or place", count("single", "wrong", "error"), 2, most=True),
        target("pair", "two effects: both named", count("pair", "yes"), 16),
        target("outside", "outside the library: named all the same", _named(rows, "outside"), 0, most=True),
        target("outside", "outside the library: signature right", fits, 10),
        target("clean", "clean: nothing named", unnamed("clean"), 19),
        target("clean", "clean: held-out chi2 'improved' over 2 %", len(improved), 0, most=True),
        target("shape", "other forms: families and places right", count("shape", "yes"), 108),
        target("shape", "other forms: wrong, called explained", count("shape", "wrong", "error"), 2, most=True),
        target("shape", "other forms: 70 % of the excess gone", gone, 108),
    ]


def _calibration(rows: Sequence[Row]) -> list[str]:
    """How often names of a stated certainty are right (family and place)."""
    stated = [t for r in rows for t in r.certainties.split(";") if t and not t.startswith("nan")]
    lines = []
    for low, high in ((0.0, 0.5), (0.5, 0.9), (0.9, 1.01)):
        own = [t for t in stated if low <= float(t[:-1]) < high]
        if own:
            mean = sum(float(t[:-1]) for t in own) / len(own)
            right = sum(t.endswith("+") for t in own)
            lines.append(
                f"certainty {mean:.2f} on average: {right} of {len(own)} right ({100 * right / len(own):.0f} %)"
            )
    return lines


def _by_robot(rows: Sequence[Row]) -> list[str]:
    shape = [r for r in rows if r.part == "shape"]
    return [
        f"other forms on {robot}: {sum(r.correct == 'yes' for r in own)} of {len(own)} right"
        for robot in dict.fromkeys(r.robot for r in shape)
        for own in ([r for r in shape if r.robot == robot],)
    ]


def _named(rows: Sequence[Row], part: str) -> int:
    return sum(r.part == part and (bool(r.named) or r.correct == "error") for r in rows)


def _improvement(row: Row) -> float:
    if not row.chi2_before or not row.chi2_after:
        return 0.0
    return 1.0 - float(row.chi2_after) / float(row.chi2_before)


def _amounts(rows: Sequence[Row]) -> list[str]:
    right = [r for r in rows if r.correct == "yes" and r.amplitude_error]
    if not right:
        return []
    errors = sorted(float(r.amplitude_error) for r in right)
    inside, told = (sum(int(r.in_ci95.split("/")[i]) for r in right if r.in_ci95) for i in (0, 1))
    return [
        f"amounts of effects named right: median error {100 * errors[len(errors) // 2]:.1f} %, "
        f"worst {100 * errors[-1]:.1f} %; truth inside the 95 % interval: {inside} of {told}"
    ]


def _confusion(rows: Sequence[Row]) -> list[str]:
    own = [r for r in rows if r.part in ("single", "outside")]
    if not own:
        return []
    cells = Counter((_names(r.planted)[0], " + ".join(_names(r.named)) or r.verdict or r.correct) for r in own)
    lines = ["planted -> named"]
    for effect in dict.fromkeys(_names(r.planted)[0] for r in own):
        found = ", ".join(f"{n} {c}" for (p, n), c in cells.most_common() if p == effect)
        lines.append(f"  {effect:<22}{found}")
    return lines


def _failures(rows: Sequence[Row]) -> list[str]:
    bad = [r for r in rows if r.correct != "yes"]
    if not bad:
        return []
    return ["not right"] + [
        f"  {r.id:<12}{r.robot:<16} {r.correct:<12}{r.planted or 'nothing'} -> {r.named or r.verdict}"
        + (f" ({r.why})" if r.why else "")
        for r in bad
    ]


def _names(text: str) -> list[str]:
    return [part.partition("@")[0].partition(" ")[0] for part in text.split("; ") if part]
