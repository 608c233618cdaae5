"""The report: one HTML file that needs nothing else, light or dark as the reader's system is."""

from __future__ import annotations

import json
from base64 import b64encode
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sysid_btr.report.changes import model_lines
from sysid_btr.report.text import compact, number, stages, told
from sysid_btr.units import si, si_all, with_digits_of

if TYPE_CHECKING:
    from jinja2 import Template

TEMPLATE = Path(__file__).with_name("report.html.j2")
VERDICTS = {
    "explained": "The log shows effects that the model lacks, and they are named below.",
    "nothing_missing": "With these parameters the model explains the log down to the noise of its sensors.",
    "ambiguous": "Something is missing, and this log cannot tell which of several effects it is.",
    "unexplained": "Something is missing that no effect of the library explains.",
}


def render(result: Mapping[str, Any], overlay: bytes | None = None, overlay_dark: bytes | None = None) -> str:
    """The report of a result.

    Parameters
    ----------
    result : content of result.json.
    overlay, overlay_dark : PNG for a light and a dark page; without the latter the former serves both.
    """
    return _template().render(
        r=result,
        stages=stages(result),
        verdict_text=VERDICTS.get(result.get("verdict", ""), ""),
        rows=list(_error_rows(result)),
        bars=_bars(result),
        estimates=[
            *result.get("parameters", []),
            *(p for e in result.get("effects", []) for p in e["parameters"]),
        ],
        overlay=None if overlay is None else _data_uri(overlay),
        overlay_dark=None if overlay_dark is None else _data_uri(overlay_dark),
        changes=list(model_lines(result)),
        raw=json.dumps(result, ensure_ascii=False),
    )


@cache
def _template() -> Template:
    from jinja2 import Environment, StrictUndefined

    environment = Environment(
        autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    environment.filters.update(si=si, number=number, told=told, compact=compact, digits=with_digits_of)
    return environment.from_string(TEMPLATE.read_text(encoding="utf-8"))


def _data_uri(png: bytes) -> str:
    return "data:image/png;base64," + b64encode(png).decode()


def _error_rows(result: Mapping[str, Any]) -> list[dict[str, Any]]:
    rows = []
    for part, label in (("train", "fitted data"), ("holdout", "held out")):
        for channel in result["nominal"].get(part, {}):
            unit = result["units"].get(channel, "").partition(",")[0]
            scores = [result[key][part].get(channel) for key, _ in stages(result)]
            values = [None if s is None else s["rmse"] for s in scores]
            *errors, floor = si_all([*values, result["noise_floor"].get(channel)], unit)
            cells = [
                None if s is None else {**s, "text": text} for s, text in zip(scores, errors, strict=True)
            ]
            rows.append({"channel": channel, "part": label, "cells": cells, "floor": floor})
    return rows


def _bars(result: Mapping[str, Any]) -> dict[str, Any] | None:
    """Held-out position error of each joint under each model, as fractions of the largest, worst first."""
    columns = stages(result)
    scores = [result[key].get("holdout", {}).get("position") for key, _ in columns]
    if not scores or any(s is None or not s.get("joints") for s in scores):
        return None
    unit = result["units"].get("position", "rad").partition(",")[0]
    values = {j: [s["joints"].get(j) or 0.0 for s in scores] for j in scores[0]["joints"]}
    largest = max((max(v) for v in values.values()), default=0.0)
    if largest <= 0:
        return None
    floor = result["noise_floor"].get("position")
    order = sorted(values, key=lambda j: -max(values[j]))
    texts = iter(si_all([v for j in order for v in values[j]], unit))
    return {
        "names": [name for _, name in columns],
        "floor": None if floor is None else min(100 * floor / largest, 100),
        "joints": [
            {
                "name": j,
                "bars": [{"width": 100 * v / largest, "text": next(texts)} for v in values[j]],
            }
            for j in order
        ],
    }
