"""Forms that were learnt, as curves over what they depend on."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from sysid_btr._typing import FloatArray
from sysid_btr.identify.intervals import Estimate
from sysid_btr.report.style import FOUND, faint, new_figure
from sysid_btr.terms.free_form import FreeCurve
from sysid_btr.terms.model import Model

if TYPE_CHECKING:
    from matplotlib.figure import Figure

POINTS = 201
ACROSS = 3
"""Curves side by side."""


@dataclass(frozen=True, eq=False)
class Curve:
    """A learnt torque.

    Attributes
    ----------
    title, variable, unit : what is drawn, and its axes with their units.
    x : (n,) values of the variable.
    torque, low, high : (n,) and its 95 % interval at each of them.
    """

    title: str
    variable: str
    unit: str
    x: FloatArray
    torque: FloatArray
    low: FloatArray
    high: FloatArray


def curves_of(model: Model, estimates: Sequence[Estimate]) -> tuple[Curve, ...]:
    """The curves in a model, with intervals from the standard errors of their amounts.

    The modes of a curve are orthogonal over its range, so their errors are taken as independent.
    """
    std = {e.name: e.std if np.isfinite(e.std) else 0.0 for e in estimates}
    found = []
    for term, own in model.parts:
        if not isinstance(term, FreeCurve):
            continue
        errors = np.array([std.get(p.name, 0.0) for p in term.parameters])
        values, spread = (term.spread(np.asarray(x)[None])[0] for x in (own, errors))
        for k, place in enumerate(term.places):
            x = np.linspace(*term.drawn_over(place), POINTS)
            line = term.curve(place, values[k], x)
            modes = term.modes_of(place, x)
            half = 1.96 * np.sqrt(np.square(modes) @ np.square(spread[k, : modes.shape[1]]))
            variable, unit = term.axes
            found.append(Curve(f"{place}: {term.title}", variable, unit, x, line, line - half, line + half))
    return tuple(found)


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
        axis.plot(curve.x, curve.torque, color=FOUND, lw=1.6)
        axis.set_title(curve.title, fontsize=9)
        axis.set_xlabel(curve.variable)
        axis.set_ylabel(curve.unit)
    return axes
