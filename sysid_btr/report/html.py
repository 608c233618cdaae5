"""The report: one HTML file that needs nothing else, light or dark as the reader's system is."""

from __future__ import annotations

import json
from base64 import b64encode
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sysid_btr.display.changes import model_lines
from sysid_btr.display.pages import templates
from sysid_btr.display.text import (
    RESIDUAL,
    certainty_words,
    channel_scores,
    episode_words,
    exactness,
    identifiability,
    number,
    residual_rows,
    stages,
    tabled_estimates,
)
from sysid_btr.units import si, si_all, with_digits_of

if TYPE_CHECKING:
    from jinja2 import Environment
    from markupsafe import Markup

LARGEST, LARGEST_RAW = 4_000_000, 500_000
"""Characters of a page's pictures, and of result.json in it; the whole stays below 5 MB."""
VERDICTS = {
    "explained": "The log shows effects that the model lacks, and they are named below.",
    "partly_explained": "The log shows effects that the model lacks, named below, and something without a likely name.",
    "nothing_missing": "With these parameters the model explains the log down to the noise of its sensors.",
    "ambiguous": "Something is missing, and on this log several effects that would explain it are confounded.",
    "unexplained": "Something is missing, and no name for it is more likely than not.",
}


@dataclass(frozen=True)
class Picture:
    """A picture of the report.

    Attributes
    ----------
    title, note : heading, and how to read it.
    light, dark : PNG for a light and a dark page; without the latter the former serves both.
    """

    title: str
    note: str
    light: bytes
    dark: bytes | None = None


def render(result: Mapping[str, Any], pictures: Sequence[Picture] = (), explorer: str | None = None) -> str:
    """The report of a result: one HTML page that needs nothing else.

    Parameters
    ----------
    result : content of result.json.
    pictures : in the order in which they are shown. The first comes after the table of errors, the others at the
        end; where the page would grow beyond `LARGEST`, those for dark pages are left out, then the last ones.
    explorer : name of the page to explore, if there is one.
    """
    shown, left_out = _fitting(pictures)
    raw = json.dumps(result, ensure_ascii=False)
    return (
        environment()
        .get_template("report.html.j2")
        .render(
            r=result,
            explorer=explorer,
            stages=stages(result),
            verdict_text=VERDICTS.get(result.get("verdict", ""), ""),
            rows=list(_error_rows(result)),
            floors=any(floor is not None for floor in result.get("noise_floor", {}).values()),
            bars=_bars(result),
            estimates=tabled_estimates(result),
            intervals=_intervals(result),
            pictures=[(p, _data_uri(p.light), None if p.dark is None else _data_uri(p.dark)) for p in shown],
            left_out=left_out,
            changes=list(model_lines(result)),
            walks=list(episode_words(result)),
            raw=raw if len(raw) <= LARGEST_RAW else None,
        )
    )


def _intervals(result: Mapping[str, Any]) -> str:
    """What the intervals of a result are, in a sentence."""
    limit = "they do not cover a model error that nobody named."
    return {
        "btr": f"Intervals are of the {result.get('intervals', '')}; {limit}",
        "posterior": "Value: posterior mean; interval: the central 95 % of the draws. The likelihood counts correlated "
        f"residuals and the replay's own numerical error; {limit}",
        "excite": "Expected of a fit to a log of this motion (the Cramer-Rao bound), compared with the same for the "
        "reference motion.",
    }.get(
        result["kind"],
        " ".join(
            (
                "Intervals hold for correlated residuals and for the replay's own numerical error.",
                *(f"{words[0].upper()}{words[1:]}." for words in exactness(result)),
            )
        ),
    )


def _fitting(pictures: Sequence[Picture]) -> tuple[list[Picture], list[str]]:
    """The pictures for which there is room, and the titles of the others."""
    shown = list(pictures)
    if _size(shown) > LARGEST:
        shown = [replace(p, dark=None) for p in shown]
    left_out: list[str] = []
    while _size(shown) > LARGEST:
        left_out.insert(0, shown.pop().title)
    return shown, left_out


def _size(pictures: Sequence[Picture]) -> int:
    """Characters of pictures in the page: four for every three bytes."""
    return sum((len(p.light) + len(p.dark or b"")) * 4 // 3 for p in pictures)


@cache
def environment() -> Environment:
    """The templates of the pages, with what these write numbers by."""
    made = templates(Path(__file__).parent)
    made.filters.update(
        si=si,
        number=number,
        identifiability=identifiability,
        residual_rows=residual_rows,
        digits=with_digits_of,
        certainty=certainty_words,
        count=_count,
        breakable=_breakable,
    )
    made.globals["residual_head"] = RESIDUAL
    return made


def _count(value: float | None) -> str:
    """A number of things."""
    return "-" if value is None else f"{value:,.0f}".replace(",", "\u202f")


def _breakable(name: str) -> Markup:
    """A name that may go on in the next line after each of its places."""
    from markupsafe import Markup, escape

    return Markup(",<wbr>").join(map(escape, name.split(",")))


def _data_uri(png: bytes) -> str:
    return "data:image/png;base64," + b64encode(png).decode()


def _error_rows(result: Mapping[str, Any]) -> list[dict[str, Any]]:
    rows = []
    for label, channel, scores in channel_scores(result):
        unit = result["units"].get(channel, "").partition(",")[0]
        *errors, floor = si_all([*(s.get("rmse") for s in scores), result["noise_floor"].get(channel)], unit)
        cells = [{**s, "text": text} if s else None for s, text in zip(scores, errors, strict=True)]
        rows.append({"channel": channel, "part": label, "cells": cells, "floor": floor})
    return rows


def _bars(result: Mapping[str, Any]) -> dict[str, Any] | None:
    """Held-out error of each joint under each model, as fractions of the largest, worst first.

    Of the first channel that was fitted and scored.
    """
    columns = stages(result)
    scored = [result[key].get("holdout", {}) for key, _ in columns]
    channel = next((c for c in result.get("channels", ()) if all(c in s for s in scored)), "position")
    scores = [s.get(channel) for s in scored]
    if not scores or any(s is None or not s.get("joints") for s in scores):
        return None
    unit = result["units"].get(channel, "rad").partition(",")[0]
    values = {j: [s["joints"].get(j) or 0.0 for s in scores] for j in scores[0]["joints"]}
    largest = max((max(v) for v in values.values()), default=0.0)
    if largest <= 0:
        return None
    floor = result["noise_floor"].get(channel)
    order = sorted(values, key=lambda j: -max(values[j]))
    texts = iter(si_all([v for j in order for v in values[j]], unit))
    return {
        "channel": channel,
        "names": [name for _, name in columns],
        "floor": None if floor is None else min(100 * floor / largest, 100),
        "joints": [
            {"name": j, "bars": [{"width": 100 * v / largest, "text": next(texts)} for v in values[j]]} for j in order
        ],
    }
