"""How logs, robots and results show themselves in a notebook."""

from __future__ import annotations

from collections.abc import Mapping
from html import escape
from io import StringIO
from typing import TYPE_CHECKING, Any

import numpy as np

from sysid_btr.report.text import PLAIN_WIDTH, show
from sysid_btr.units import si

if TYPE_CHECKING:
    from sysid_btr.diagnosis.closing import Closing
    from sysid_btr.identify.fit import Fit
    from sysid_btr.io.log import Log
    from sysid_btr.models.robot import Robot
    from sysid_btr.posterior.draw import Posterior

FRAME = '<pre style="white-space:pre;overflow-x:auto;line-height:1.25;font-family:monospace">{code}</pre>'


def html_of_outcome(outcome: Fit | Closing | Posterior) -> str:
    """The tables of the command line."""
    from sysid_btr.result import make_result

    return html_of_result(make_result(outcome))


def html_of_result(result: Mapping[str, Any]) -> str:
    """The same of the content of result.json."""
    from rich.console import Console

    out = Console(file=StringIO(), record=True, width=PLAIN_WIDTH, highlight=False, emoji=False, markup=False)
    show(result, out)
    return out.export_html(inline_styles=True, code_format=FRAME)


def html_of_log(log: Log) -> str:
    """What was recorded, for how long, and which joints moved."""
    rows: list[tuple[str, str]] = [
        ("robot", log.meta.robot or "not said"),
        ("samples", f"{len(log)} in {len(log.episodes())} episode(s), {log.time[-1] - log.time[0]:.1f} s"),
        ("sampled every", si(float(np.median(np.diff(log.time))), "s") if len(log) > 1 else "-"),
        ("base", log.meta.mount),
    ]
    for kind in dict.fromkeys(name.partition(".")[0] for name in log.channels):
        names = [name.partition(".")[2] for name in log.channels if name.partition(".")[0] == kind]
        rows.append((kind, ", ".join(names)))
    return _table("log", rows)


def html_of_robot(robot: Robot) -> str:
    """Joints, bodies and mass."""
    from sysid_btr.models.robot import body_names, joint_names, servo_joints

    model = robot.compile()
    rows = [
        ("joints", ", ".join(joint_names(robot))),
        ("with a servo", ", ".join(servo_joints(robot))),
        ("bodies", ", ".join(body_names(robot))),
        ("mass", f"{float(model.body_mass.sum()):.4g} kg"),
    ]
    return _table(f"robot {robot.name}", rows)


def _table(title: str, rows: list[tuple[str, Any]]) -> str:
    body = "".join(
        f'<tr><th style="text-align:left">{escape(name)}</th><td style="text-align:left">{escape(str(text))}</td></tr>'
        for name, text in rows
    )
    return f"<table><caption>{escape(title)}</caption>{body}</table>"
