"""Where the model was most wrong: command, log and models, and what is left of the error; the course of a search."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product
from typing import TYPE_CHECKING, Any

import numpy as np

from sysid_btr._typing import FloatArray
from sysid_btr.identify.intervals import NORMAL
from sysid_btr.report.style import FOUND, SHADE, faint, ink, model_colours, new_figure
from sysid_btr.report.traces import Trace
from sysid_btr.units import si_all

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from sysid_btr.identify.fit import Fit


ZOOM_SECONDS = 2.0
MOST_POINTS = 4000
"""Points of a line; more cannot be seen on a page."""


def plot_overlay(traces: Sequence[Trace], figure: Figure | None = None) -> Any:
    """The traces: whole log, a close-up of what is held out, and the residual there.

    Parameters
    ----------
    traces : one a row.
    figure : to draw on; a new one if None.

    Returns
    -------
    ndarray
        (traces, 3) of Axes.
    """
    from matplotlib import rc_context

    rows = max(len(traces), 1)
    figure = new_figure(13, 0.6 + 2.5 * rows) if figure is None else figure
    with rc_context({"lines.linewidth": 1.1}):
        axes = figure.subplots(rows, 3, squeeze=False, width_ratios=(1.5, 1.1, 1.1))
        for row, item in zip(axes, traces, strict=False):
            _draw_row(row, item)
    if traces:
        _legend(figure, axes[0][1])
        for axis in axes[-1]:
            axis.set_xlabel("time (s)")
    return axes


LAGS = 1.0
"""s over which residuals are correlated."""


def plot_residuals(traces: Sequence[Trace], figure: Figure | None = None) -> Any:
    """What is left on the held-out part: correlation of each model's residual with itself and with the command's rate.

    Within the band, which holds 95 % of the lags where nothing is left but white noise, a residual has no memory
    (left) and does not follow from what was commanded (right). The right says more about a simulation: its errors
    have a memory even where the model is right (Ljung 1999, System Identification, section 16.6).

    Returns
    -------
    ndarray
        (traces, 2) of Axes.
    """
    rows = max(len(traces), 1)
    figure = new_figure(13, 0.6 + 1.9 * rows) if figure is None else figure
    axes = figure.subplots(rows, 2, squeeze=False)
    for (left, right), item in zip(axes, traces, strict=False):
        period = float(np.median(np.diff(item.time))) if len(item.time) > 1 else 1.0
        lags = max(min(round(LAGS / period), int(item.held_out.sum()) // 2), 1)
        rate = np.gradient(item.command)[item.held_out] if len(item.command) > 1 else item.command[item.held_out]
        for name, colour in _coloured(item):
            residual = item.residual(name)
            for axis, other in ((left, residual), (right, rate)):
                correlation, band = correlate(residual, other, lags)
                axis.plot(period * np.arange(lags + 1), correlation, color=colour, lw=1, label=name)
        for axis in (left, right):
            axis.axhspan(-band, band, color=faint(), alpha=0.3, lw=0)
            axis.set_xlim(0, period * lags)
            axis.set_ylim(-1.05, 1.05)
        left.set_ylabel(item.joint)
    axes[0][0].set_title("residual with itself, by lag", fontsize=9)
    axes[0][1].set_title("residual with the rate of the command before it, by lag", fontsize=9)
    for axis in axes[-1]:
        axis.set_xlabel("lag (s)")
    if traces:
        _legend(figure, axes[0][0])
    return axes


def correlate(late: FloatArray, early: FloatArray, lags: int) -> tuple[FloatArray, float]:
    """Correlation of one signal with another that many samples before, and the band of white noise.

    Parameters
    ----------
    late, early : (n,) NaN where missing; such pairs are left out.
    lags : largest, samples.

    Returns
    -------
    (ndarray, float)
        (lags + 1,) coefficients, and half the band that holds 95 % of them for signals with nothing in common.
    """
    a, b = (np.where(np.isfinite(x), x - np.nanmean(x), 0.0) if np.isfinite(x).any() else np.zeros(len(x))
            for x in (late, early))  # fmt: skip
    size = float(np.sqrt(np.sum(a**2) * np.sum(b**2)))
    found = np.array([np.dot(a[k:], b[: len(b) - k]) for k in range(lags + 1)]) / max(size, 1e-300)
    count = int(np.sum(np.isfinite(late) & np.isfinite(early)))
    return found, NORMAL / np.sqrt(max(count, 1))


def plot_convergence(fit: Fit, axes: Axes | None = None) -> Axes:
    """Best loss so far over the replays of a fit."""
    axes = new_figure(8, 3).subplots() if axes is None else axes
    done = np.array([n for n, _ in fit.result.history], dtype=np.float64)
    best = np.array([loss for _, loss in fit.result.history], dtype=np.float64)
    if len(done):
        end = max(float(fit.result.evaluations), done[-1])
        axes.step([*done, end], [*best, best[-1]], where="post", color=ink(), lw=1.2)
        axes.plot(done, best, ".", color=FOUND, ms=5)
        if best.min() > 0 and best.max() > 3 * best.min():
            axes.set_yscale("log")
    axes.set_xlabel("replays")
    axes.set_ylabel("best loss")
    return axes


def figure_of(axes: Any) -> Figure:
    """The figure that some axes are of."""
    figure = np.asarray(axes, dtype=object).ravel()[0].get_figure(root=True)
    assert figure is not None
    return figure  # type: ignore[no-any-return]


def _legend(figure: Figure, axis: Axes) -> None:
    handles, labels = axis.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=len(labels), frameon=False)


def _draw_row(row: Sequence[Axes], item: Trace) -> None:
    whole, close, left = row
    low, high = _zoom(item)
    for axis, (begin, end) in ((whole, (item.time[0], item.time[-1])), (close, (low, high))):
        _draw_lines(axis, item, begin, end)
        axis.set_xlim(begin, end)
    if not item.held_out.all():
        for axis, (begin, end) in product((whole, close) if len(item.spans) > 1 else (whole,), item.spans):
            axis.axvspan(begin, end, color=SHADE, lw=0)
        whole.text(item.spans[0][0], 1.0, " held out", transform=whole.get_xaxis_transform(), va="top", fontsize=8)
    whole.set_ylabel(f"{item.joint} ({item.unit})")
    close.set_title("close-up of what is held out", fontsize=9)
    factor, unit = _milli(item)
    for name, colour in _coloured(item):
        x, y = _window(item.time, (item.measured - item.predicted[name]) * factor, low, high)
        left.plot(x, y, color=colour, lw=0.9)
    left.axhspan(-2 * item.noise * factor, 2 * item.noise * factor, color=faint(), alpha=0.3, lw=0)
    left.set_xlim(low, high)
    for axis in row:
        axis.locator_params(nbins=6)
    left.set_ylabel(f"log - model ({unit})")
    errors = ", ".join(si_all([item.error(n) * item.noise for n in item.predicted], item.unit))
    left.set_title(f"rmse {errors} (band: 2 x noise)", fontsize=8)


def _draw_lines(axis: Axes, item: Trace, begin: float, end: float) -> None:
    if item.channel == "position":
        x, y = _window(item.time, item.command, begin, end)
        axis.plot(x, y, color=faint(), lw=0.8, ls="--", drawstyle="steps-post", label="command")
    x, y = _window(item.time, item.measured, begin, end)
    axis.plot(x, y, color=ink(), lw=1.6, label="log")
    for name, colour in _coloured(item):
        x, y = _window(item.time, item.predicted[name], begin, end)
        axis.plot(x, y, color=colour, label=name)


def _coloured(item: Trace) -> list[tuple[str, str]]:
    names = list(item.predicted)
    return list(zip(names, model_colours(len(names)), strict=False))


def _milli(item: Trace) -> tuple[float, str]:
    """Factor and unit in which the first model's residual reads well."""
    first = next(iter(item.predicted.values()))
    size = float(np.nanmax(np.abs(item.measured - first), initial=0.0))
    table = ((1.0, ""), (1e-3, "m"), (1e-6, "µ"))
    scale, prefix = next(((s, p) for s, p in table if size >= s), table[-1])
    return 1 / scale, prefix + item.unit


def _zoom(item: Trace) -> tuple[float, float]:
    """Two seconds around the first model's largest smoothed residual in what is held out."""
    time = item.time[int(np.argmax(item.held_out)) :]
    span = min(ZOOM_SECONDS, time[-1] - time[0])
    first = next(iter(item.predicted.values()))
    square = np.where(item.held_out, np.nan_to_num(item.measured - first) ** 2, 0.0)[-len(time) :]
    energy = np.concatenate(([0.0], np.cumsum(square)))
    stop = np.searchsorted(time, time + span, side="right")
    starts = np.flatnonzero(time + span <= time[-1] + 1e-9)
    starts = starts if len(starts) else np.array([0])
    best = int(starts[np.argmax(energy[stop[starts]] - energy[starts])])
    return float(time[best]), float(time[best] + span)


def _window(time: FloatArray, values: FloatArray, begin: float, end: float) -> tuple[Any, Any]:
    inside = np.flatnonzero((time >= begin) & (time <= end))
    inside = inside[:: max(len(inside) // MOST_POINTS, 1)]
    return time[inside], values[inside]
