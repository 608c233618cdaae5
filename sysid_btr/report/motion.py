"""What a model makes of a motion that was not recorded yet."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from rich.table import Table

    from sysid_btr.io.log import Log
    from sysid_btr.models.robot import Robot

Span = tuple[float, float]


@dataclass(frozen=True)
class Reach:
    """How far a joint goes, rad or m.

    Attributes
    ----------
    commanded, predicted : least and largest position; (nan, nan) where the replay diverged.
    limits : of the joint in the model, None where it has none.
    error : largest distance of the predicted from the commanded position.
    torque : largest predicted, Nm or N.
    """

    commanded: Span
    predicted: Span
    limits: Span | None
    error: float
    torque: float

    @property
    def beyond(self) -> bool:
        """Whether the model leaves the joint's range, or diverges."""
        low, high = self.limits or (-np.inf, np.inf)
        return not (low <= self.predicted[0] and self.predicted[1] <= high)


def reach(robot: Robot, motion: Log, predicted: Log) -> dict[str, Reach]:
    """How far every commanded joint goes when a model plays a motion, the least room first."""
    from sysid_btr.models.robot import joint_ranges

    limits = joint_ranges(robot)
    found = {}
    for joint in motion.joints("command"):
        if not predicted.has("position", joint):
            continue
        command, position = motion.channels[f"command.{joint}"], predicted.channels[f"position.{joint}"]
        found[joint] = Reach(
            _span(command),
            _span(position),
            limits.get(joint),
            float(np.max(np.abs(position - command))),
            float(np.max(np.abs(predicted.channels[f"effort.{joint}"]))),
        )
    return dict(sorted(found.items(), key=lambda item: not item[1].beyond))


def reach_table(joints: Mapping[str, Reach]) -> Table:
    """The same for a terminal."""
    from rich.box import SIMPLE_HEAD
    from rich.table import Table

    table = Table(box=SIMPLE_HEAD, pad_edge=False, show_edge=False, header_style="bold")
    table.add_column("joint")
    for name in ("commanded (rad, m)", "in the model", "its limits", "off by at most", "torque at most (Nm, N)"):
        table.add_column(name, justify="right")
    table.add_column("")
    for joint, r in joints.items():
        warning = "beyond its limits" if r.beyond else ""
        cells = [_text(r.commanded), _text(r.predicted), _text(r.limits), f"{r.error:.3g}", f"{r.torque:.3g}"]
        table.add_row(joint, *cells, warning)
    return table


def _span(values: np.ndarray[tuple[int, ...], np.dtype[np.float64]]) -> Span:
    return float(np.min(values)), float(np.max(values))


def _text(span: Span | None) -> str:
    return "-" if span is None else f"{span[0]:.3f} .. {span[1]:.3f}"
