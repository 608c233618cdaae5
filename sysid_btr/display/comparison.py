"""A comparison of runs as tables: for a terminal, as rows for CSV and pandas, and as one HTML page."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sysid_btr.display.pages import templates
from sysid_btr.units import probability, si_all, with_digits_of

if TYPE_CHECKING:
    from rich.console import RenderableType

Table = tuple[str, list[str], list[list[str]]]
"""Heading, names of the columns, and rows of texts."""
BECAME = {"stayed": "found in all", "came": "new", "went": "no longer found", "came and went": "found in some"}
"""What became of an effect from the first run to the last, in words."""


def flat_rows(content: Mapping[str, Any], table: str) -> Iterator[dict[str, Any]]:
    """Rows with every number by name; those of a run begin with its label."""
    labels = [run["label"] for run in content["runs"]]
    for row in content[table]:
        flat: dict[str, Any] = {}
        for name, value in row.items():
            if not isinstance(value, list):
                flat[name] = value
                continue
            for label, side in zip(labels, value, strict=True):
                flat |= _of_run(label, name, side, table)
        yield flat


def _of_run(label: str, name: str, side: Any, table: str) -> dict[str, Any]:
    if table != "parameters":
        return {f"{label}.{name}": side}
    side = side or {"value": None, "std": None, "ci95": [None, None]}
    low, high = side["ci95"]
    return {
        f"{label}.value": side["value"],
        f"{label}.std": side["std"],
        f"{label}.ci95_low": low,
        f"{label}.ci95_high": high,
    }


def tables(content: Mapping[str, Any]) -> Iterator[Table]:
    """The tables that have rows, as texts."""
    labels = [f"{run['label']}{_on(run['date'])}" for run in content["runs"]]
    rows = content["parameters"]
    drifts = any(row["drift"] is not None for row in rows)
    columns = ["parameter", *labels, "unit", "change", "z", "real"]
    texts = [
        [
            row["name"],
            *(_interval(side) for side in row["values"]),
            "x nominal" if row["unit"] == "1" else row["unit"],
            "-" if row["change"] is None else f"{with_digits_of(row['change'], row['change_std'])}",
            "-" if row["times"] is None else f"{row['times']:+.1f}",
            _real(row),
            *([_drift(row)] if drifts else []),
        ]
        for row in rows
    ]
    yield "Parameters, with 95 % intervals", [*columns, *(["drift per 30 days"] if drifts else [])], texts
    if content["effects"]:
        texts = [
            [
                f"{e['effect']} at {e['where']}",
                *("-" if c is None else probability(c) for c in e["certainty"]),
                BECAME[e["became"]],
            ]
            for e in content["effects"]
        ]
        yield "Effects that the model lacked, with certainty", ["effect", *labels, "from first to last"], texts
    if content["errors"]:
        yield (
            "Error (rmse), plain model -> identified",
            ["data", "channel", *labels, "noise floor"],
            [_error(row) for row in content["errors"]],
        )


def _on(date: str | None) -> str:
    return f" ({date[:10]})" if date else ""


def _interval(side: Mapping[str, Any] | None) -> str:
    if side is None:
        return "-"
    value, low, high = (with_digits_of(x, side["std"]) for x in (side["value"], *side["ci95"]))
    return f"{value} ({low} .. {high})"


def _real(row: Mapping[str, Any]) -> str:
    if row["real"] is None:
        return "not tested"
    return f"{'yes' if row['real'] else 'no'} (p {row['p_holm']:.2g})"


def _drift(row: Mapping[str, Any]) -> str:
    if row["drift"] is None:
        return "-"
    return f"{30 * row['drift']:+.2g}, standard error {30 * row['drift_std']:.1g} (p {row['drift_p']:.2g})"


def _error(row: Mapping[str, Any]) -> list[str]:
    sides = [*row["nominal"], *row["rmse"]]
    *texts, floor = si_all([*sides, row["noise_floor"]], row["unit"])
    count = len(row["rmse"])
    return [
        row["data"],
        row["channel"],
        *(f"{a} -> {b}" for a, b in zip(texts[:count], texts[count:], strict=True)),
        floor,
    ]


def rule(content: Mapping[str, Any]) -> str:
    """How it is decided whether a difference is real."""
    return (
        "Change: of the last run from the first; z: that over its standard error. A difference is real where "
        f"Cochran's Q (of two runs: z squared) is too large for chance: p below {content['chance']:g}, after Holm's "
        "correction for the number of parameters."
    )


def show(content: Mapping[str, Any]) -> Iterator[RenderableType]:
    """For a terminal."""
    from rich.box import SIMPLE_HEAD
    from rich.table import Table as Grid
    from rich.text import Text

    yield Text(content["message"], style="bold")
    for title, columns, rows in tables(content):
        grid = Grid(box=SIMPLE_HEAD, pad_edge=False, show_edge=False, header_style="bold")
        for name in columns:
            grid.add_column(name, overflow="fold")
        for row in rows:
            grid.add_row(*row)
        yield Text(f"\n{title}")
        yield grid
    yield Text("\n" + rule(content), style="dim")
    yield from (Text(f"note: {remark}") for remark in content["remarks"])


def page(content: Mapping[str, Any], *, whole: bool = True) -> str:
    """As HTML: a page that needs nothing else, or its body alone."""
    found: Sequence[Table] = list(tables(content))
    template = templates(Path(__file__).parent).get_template("comparison.html.j2")
    return template.render(c=content, tables=found, rule=rule(content), whole=whole)
