"""The overlay: command, log and models at the joints where the model was most wrong, and what is left."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from io import BytesIO
from typing import TYPE_CHECKING, Any

import numpy as np

from sysid_btr._typing import FloatArray
from sysid_btr.units import si_all

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from sysid_btr.diagnosis.closing import Closing
    from sysid_btr.identify.fit import Fit
    from sysid_btr.identify.study import Study
    from sysid_btr.models.modifier import Modifier

JOINTS_SHOWN = 3
EPISODES_SEARCHED = 8
ZOOM_SECONDS = 2.0
MOST_POINTS = 4000
"""Points of a line; more cannot be seen on a page."""


@dataclass(frozen=True, eq=False)
class Trace:
    """One joint in one episode.

    Attributes
    ----------
    joint : name, with the log's where there are several.
    unit : of the position.
    time : (n,) s since the first sample.
    command, measured : (n,) NaN where missing.
    predicted : name of the model -> (n,), from the plain model to the final one.
    split : (s) held out from here on.
    noise : noise floor of the sensor.
    """

    joint: str
    unit: str
    time: FloatArray
    command: FloatArray
    measured: FloatArray
    predicted: Mapping[str, FloatArray]
    split: float
    noise: float

    def error(self, name: str) -> float:
        """Root-mean-square error of one model on the held-out part, in noise floors."""
        residual = (self.measured - self.predicted[name])[self.time >= self.split]
        residual = residual[np.isfinite(residual)]
        return float(np.sqrt(np.mean(residual**2)) / self.noise) if len(residual) else 0.0


Named = tuple[str, tuple["Modifier", ...], FloatArray]
"""A model to draw: its name, its modifiers and their values."""


def trace_outcome(outcome: Fit | Closing) -> tuple[Trace, ...]:
    """The worst joints of a fit or a closing, worst first.

    They are those where the plain model is farthest off on held-out data, in noise floors; in a closing
    those where the fitted parameters still are.
    """
    from sysid_btr.identify.fit import Fit
    from sysid_btr.identify.study import nominal_start

    if isinstance(outcome, Fit):
        start = nominal_start(outcome.modifiers)
        models: tuple[Named, ...] = (
            ("plain model", outcome.modifiers, start),
            ("fitted", outcome.modifiers, outcome.values),
        )
        return trace(outcome.study, models, "plain model")
    models = (
        ("plain model", (), np.zeros(0)),
        ("parameters fitted", outcome.before_modifiers, outcome.before_values),
    )
    if outcome.effects:
        models = (*models, ("effects added", outcome.modifiers, outcome.values))
    return trace(outcome.study, models, "parameters fitted")


def trace(study: Study, models: Sequence[Named], rank_by: str) -> tuple[Trace, ...]:
    """Replay the held-out episodes under each model; the joints where model `rank_by` is worst."""
    traces: list[Trace] = []
    several = len(study.holdout) > 1
    count = min(len(study.holdout), EPISODES_SEARCHED)
    predicted: list[dict[str, FloatArray]] = [{} for _ in range(count)]
    for name, modifiers, values in models:
        for i, episode in enumerate(study.holdout_problem(modifiers).episodes[:count]):
            predicted[i][name] = episode.replay.predict(values[None]).position[0]
    plain = study.holdout_problem(())
    for i, episode in enumerate(plain.episodes[:count]):
        log, joints = study.holdout[i], episode.replay.index.joints
        label = f" ({log.path.stem})" if several and log.path is not None else ""
        target = next(t for t in episode.targets if t.channel == "position")
        for k, joint in enumerate(target.joints):
            column = joints.index(joint)
            slide = int(episode.replay.model.joint(joint).type[0]) == 2
            traces.append(
                Trace(
                    joint=joint + label,
                    unit="m" if slide else "rad",
                    time=log.time - log.time[0],
                    command=log.channels.get(f"command.{joint}", np.full(len(log), np.nan)),
                    measured=target.measured[:, k],
                    predicted={name: p[:, column] for name, p in predicted[i].items()},
                    split=study.split[i],
                    noise=float(target.noise[k]),
                )
            )
    traces.sort(key=lambda t: -t.error(rank_by))
    return tuple(traces[:JOINTS_SHOWN])


LIGHT = {"ink": "#1f2328", "faint": "#8b949e", "shade": "#0969da14", "paper": "white"}
DARK = {"ink": "#e6edf3", "faint": "#768390", "shade": "#58a6ff1f", "paper": "#0d1117"}
MODEL_COLOURS = ("#d1495b", "#edae49", "#2e9e6b")
"""Plain, parameters fitted, effects added; told apart also without red and green."""


def page_style(theme: Mapping[str, str]) -> dict[Any, Any]:
    """Matplotlib's settings for a page of a report."""
    return {
        "font.size": 9,
        "text.color": theme["ink"],
        "axes.labelcolor": theme["ink"],
        "axes.edgecolor": theme["faint"],
        "axes.facecolor": theme["paper"],
        "xtick.color": theme["faint"],
        "ytick.color": theme["faint"],
        "xtick.labelcolor": theme["ink"],
        "ytick.labelcolor": theme["ink"],
        "axes.spines.top": False,
        "axes.spines.right": False,
    }


def draw_overlay(traces: Sequence[Trace], *, dark: bool = False) -> bytes:
    """PNG of the traces: whole log, a close-up of the held-out part, and the residual there.

    Parameters
    ----------
    traces : one a row.
    dark : for a dark page.
    """
    from matplotlib import rc_context
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    theme = DARK if dark else LIGHT
    with rc_context({**page_style(theme), "lines.linewidth": 1.1}):
        rows = max(len(traces), 1)
        figure = Figure(figsize=(13, 0.6 + 2.5 * rows), layout="constrained", facecolor=theme["paper"])
        FigureCanvasAgg(figure)
        axes = figure.subplots(rows, 3, squeeze=False, width_ratios=(1.5, 1.1, 1.1))
        for row, item in zip(axes, traces, strict=False):
            _draw_row(row, item, theme)
        if traces:
            handles, labels = axes[0][1].get_legend_handles_labels()
            figure.legend(handles, labels, loc="outside upper center", ncols=len(labels), frameon=False)
            for axis in axes[-1]:
                axis.set_xlabel("time (s)")
        buffer = BytesIO()
        figure.savefig(buffer, format="png", dpi=110, metadata={"Software": None})
    return buffer.getvalue()


def _draw_row(row: Sequence[Axes], item: Trace, theme: Mapping[str, str]) -> None:
    whole, close, left = row
    low, high = _zoom(item)
    for axis, (begin, end) in ((whole, (item.time[0], item.time[-1])), (close, (low, high))):
        _draw_lines(axis, item, begin, end, theme)
        axis.set_xlim(begin, end)
    if 0 < item.split < item.time[-1]:
        whole.axvspan(item.split, item.time[-1], color=theme["shade"], lw=0)
        whole.text(item.split, 1.0, " held out", transform=whole.get_xaxis_transform(), va="top", fontsize=8)
    whole.set_ylabel(f"{item.joint} ({item.unit})")
    close.set_title("close-up of the held-out part", fontsize=9)
    factor, unit = _milli(item)
    for name, colour in _coloured(item):
        x, y = _window(item.time, (item.measured - item.predicted[name]) * factor, low, high)
        left.plot(x, y, color=colour, lw=0.9)
    left.axhspan(-2 * item.noise * factor, 2 * item.noise * factor, color=theme["faint"], alpha=0.3, lw=0)
    left.set_xlim(low, high)
    for axis in row:
        axis.locator_params(nbins=6)
    left.set_ylabel(f"log - model ({unit})")
    errors = ", ".join(si_all([item.error(n) * item.noise for n in item.predicted], item.unit))
    left.set_title(f"rmse {errors} (band: 2 x noise)", fontsize=8)


def _draw_lines(axis: Axes, item: Trace, begin: float, end: float, theme: Mapping[str, str]) -> None:
    x, y = _window(item.time, item.command, begin, end)
    axis.plot(x, y, color=theme["faint"], lw=0.8, ls="--", drawstyle="steps-post", label="command")
    x, y = _window(item.time, item.measured, begin, end)
    axis.plot(x, y, color=theme["ink"], lw=1.6, label="log")
    for name, colour in _coloured(item):
        x, y = _window(item.time, item.predicted[name], begin, end)
        axis.plot(x, y, color=colour, label=name)


def _coloured(item: Trace) -> list[tuple[str, str]]:
    names = list(item.predicted)
    colours = (MODEL_COLOURS[0], MODEL_COLOURS[2]) if len(names) == 2 else MODEL_COLOURS
    return list(zip(names, colours, strict=False))


def _milli(item: Trace) -> tuple[float, str]:
    """Factor and unit in which the first model's residual reads well."""
    first = next(iter(item.predicted.values()))
    size = float(np.nanmax(np.abs(item.measured - first), initial=0.0))
    table = ((1.0, ""), (1e-3, "m"), (1e-6, "µ"))
    scale, prefix = next(((s, p) for s, p in table if size >= s), table[-1])
    return 1 / scale, prefix + item.unit


def _zoom(item: Trace) -> tuple[float, float]:
    """Two seconds of the held-out part around the first model's largest smoothed residual."""
    inside = np.flatnonzero(item.time >= item.split)
    if len(inside) < 2:
        inside = np.arange(len(item.time))
    time = item.time[inside]
    span = min(ZOOM_SECONDS, time[-1] - time[0])
    first = next(iter(item.predicted.values()))
    square = np.nan_to_num((item.measured - first)[inside]) ** 2
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
