"""Forms that were learnt, as curves over what they depend on."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from sysid_btr.identify.curves import Curve
from sysid_btr.report.style import FOUND, faint, new_figure

if TYPE_CHECKING:
    from matplotlib.figure import Figure

ACROSS = 3
"""Curves side by side."""


def plot_curves(curves: Sequence[Curve], figure: Figure | None = None) -> Any:
    """Each curve with its interval.

    Returns
    -------
    ndarray
        (rows, columns) of Axes.
    """
    columns = min(max(len(curves), 1), ACROSS)
    rows = -(-max(len(curves), 1) // columns)
    figure = new_figure(4.4 * columns, 0.4 + 2.8 * rows) if figure is None else figure
    axes = figure.subplots(rows, columns, squeeze=False)
    for axis in axes.ravel()[len(curves) :]:
        axis.set_visible(False)
    for axis, curve in zip(axes.ravel(), curves, strict=False):
        axis.axhline(0.0, color=faint(), lw=0.8)
        axis.fill_between(curve.x, curve.low, curve.high, color=FOUND, alpha=0.25, lw=0)
        axis.plot(curve.x, curve.value, color=FOUND, lw=1.6)
        axis.set_title(curve.title, fontsize=9)
        axis.set_xlabel(curve.variable)
        axis.set_ylabel(curve.amount)
    return axes
