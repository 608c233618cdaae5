"""Figures of posteriors and profiles: functions that draw on axes and return them."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from sysid_btr._typing import FloatArray
from sysid_btr.optional import optional
from sysid_btr.report.style import FOUND, PLAIN, faint, ink, new_figure
from sysid_btr.units import si_all

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from sysid_btr.identify.intervals import Profile
    from sysid_btr.posterior.outcome import Posterior
    from sysid_btr.posterior.predictive import Band

MOST_PARAMETERS = 12
"""Parameters of a corner plot or a trace; more cannot be read."""
BANDS_SHOWN = 3
ZOOM_SECONDS = 3.0


def shown_parameters(posterior: Posterior) -> list[int]:
    """Parameters that are drawn: those about which the log is most informative come first where there are too many."""
    count = len(posterior.estimates)
    if count <= MOST_PARAMETERS:
        return list(range(count))
    return sorted(np.argsort(posterior.learnt, kind="stable")[:MOST_PARAMETERS].tolist())


def plot_corner(posterior: Posterior, figure: Figure | None = None) -> FloatArray:
    """Every parameter against every other; lines are the least-squares fit.

    Returns
    -------
    ndarray
        (k, k) of Axes.

    Raises
    ------
    UsageError
        The package corner is missing.
    """
    corner = optional("corner", "posterior", "the corner plot")
    which = shown_parameters(posterior)
    if figure is None:
        figure = new_figure(1.2 + 1.7 * len(which), 1.2 + 1.7 * len(which), layout=None)
    draws = posterior.sample.flat[:, which]
    low = draws.min(axis=0)
    spread = np.maximum(np.ptp(draws, axis=0), 1e-12 * np.maximum(np.abs(draws).max(axis=0), 1e-300))
    panels = list(zip(posterior.fit.values[which], low, spread, strict=True))
    # a line outside the panel only stretches it
    truths = [v if a - s < v < a + 2 * s else None for v, a, s in panels]
    corner.corner(
        draws,
        fig=figure,
        labels=[posterior.sample.names[j] for j in which],
        truths=truths if len(which) > 1 else None,  # corner cannot draw them over a single panel
        range=[(float(a - 0.02 * s), float(a + 1.02 * s)) for _, a, s in panels],
        quantiles=[0.025, 0.5, 0.975],
        truth_color=PLAIN,
        color=ink(),
        quiet=True,
        plot_datapoints=False,
        plot_density=False,
        fill_contours=True,
        no_fill_contours=True,  # the base fill is white
        label_kwargs={"fontsize": 8},
    )
    if len(which) == 1 and truths[0] is not None:
        figure.axes[0].axvline(truths[0], color=PLAIN)
    axes: Any = np.array(figure.axes).reshape(len(which), len(which))
    for axis in figure.axes:
        axis.tick_params(labelsize=6)
    return np.asarray(axes)


def plot_trace(posterior: Posterior, figure: Figure | None = None) -> list[Axes]:
    """Mean and central 95 % of the walkers, step by step, one colour an ensemble."""
    which = shown_parameters(posterior)
    rows = -(-len(which) // 2)
    figure = new_figure(11, 0.5 + 1.3 * rows) if figure is None else figure
    axes = list(figure.subplots(rows, min(len(which), 2), squeeze=False, sharex=True).flat)
    steps = np.arange(posterior.sample.draws.shape[1])
    found = posterior.sample.convergence
    for axis, j in zip(axes, which, strict=False):
        for draws, colour in zip(posterior.sample.draws[..., j], _colours(), strict=False):
            low, high = np.quantile(draws, [0.025, 0.975], axis=1)
            axis.fill_between(steps, low, high, color=colour, alpha=0.2, lw=0)
            axis.plot(steps, draws.mean(axis=1), color=colour, lw=1)
        axis.set_title(
            f"{posterior.sample.names[j]}: R-hat {found.rhat[j]:.3f}, tau {found.tau[j]:.1f}", fontsize=8, loc="left"
        )
        axis.tick_params(labelsize=7)
    for axis in axes[len(which) :]:
        axis.set_axis_off()
    return axes


def plot_bands(posterior: Posterior, figure: Figure | None = None) -> list[Axes]:
    """Predictions of the worst held-out sensors with their 95 % bands, and the error against the band."""
    bands = sorted(posterior.bands, key=lambda b: -b.surprise)[:BANDS_SHOWN]
    figure = new_figure(12, 0.6 + 2.3 * max(len(bands), 1)) if figure is None else figure
    table = figure.subplots(max(len(bands), 1), 2, squeeze=False, width_ratios=(1, 1.3))
    for (left, right), band in zip(table, bands, strict=False):
        plot_band(band, left)
        plot_band_error(band, right)
    return list(table.flat)


def plot_band(band: Band, axes: Axes) -> Axes:
    """Log and 95 % band in the seconds where the error is largest."""
    inside = _worst_stretch(band)
    time = band.time[inside]
    mean, half = band.mean[inside], band.half_width[inside]
    axes.fill_between(time, mean - half, mean + half, color=FOUND, alpha=0.35, lw=0, label="95 % of the posterior")
    axes.plot(time, band.measured[inside], color=ink(), lw=1.2, label="log")
    axes.set_ylabel(f"{band.joint} ({band.unit})", fontsize=8)
    axes.set_xlabel("time (s)", fontsize=8)
    axes.legend(fontsize=7, frameon=False)
    axes.tick_params(labelsize=7)
    return axes


def plot_band_error(band: Band, axes: Axes) -> Axes:
    """Held-out error over time in the band that is predicted for it."""
    at = np.flatnonzero(band.held_out)
    at = at[:: max(len(at) // 2000, 1)]
    half, off = band.half_width[at], (band.measured - band.mean)[at]
    axes.fill_between(band.time[at], -half, half, color=FOUND, alpha=0.35, lw=0)
    axes.plot(band.time[at], off, color=ink(), lw=0.6)
    share = float(np.mean(band.inside)) if len(band.inside) else float("nan")
    error, knowledge = si_all([band.error, float(np.sqrt(np.mean(band.spread[at] ** 2)))], band.unit)
    axes.set_title(
        f"{100 * share:.1f} % of the held-out samples inside; sensor {error}, parameters {knowledge}", fontsize=8
    )
    axes.set_ylabel(f"log - model ({band.unit})", fontsize=8)
    axes.set_xlabel("time (s)", fontsize=8)
    axes.tick_params(labelsize=7)
    return axes


def plot_profile(profile: Profile, axes: Axes | None = None) -> Axes:
    """Deviance along a parameter, the parabola of its standard error, and the interval."""
    axes = new_figure(6, 4).subplots() if axes is None else axes
    if profile.std > 0:
        x = np.linspace(profile.values[0], profile.values[-1], 200)
        axes.plot(x, ((x - profile.best) / profile.std) ** 2, color=faint(), lw=1, ls="--", label="standard error")
    axes.plot(profile.values, profile.deviance, color=ink(), marker="o", ms=3.5, lw=1.2, label="others fitted anew")
    axes.axhline(profile.threshold, color=PLAIN, lw=0.8)
    axes.axvspan(*profile.interval, color=FOUND, alpha=0.15, lw=0, label="95 % interval")
    axes.set_ylim(0, 1.6 * profile.threshold)
    axes.set_xlabel(profile.name + (" (x nominal)" if profile.unit == "1" else f" ({profile.unit})"))
    axes.set_ylabel("deviance")
    axes.legend(fontsize=8, frameon=False)
    return axes


def _colours() -> list[str]:
    from matplotlib import color_sequences

    return [str(c) if isinstance(c, str) else _hex(c) for c in color_sequences["tab10"]]


def _hex(colour: Any) -> str:
    from matplotlib.colors import to_hex

    return str(to_hex(colour))


def _worst_stretch(band: Band) -> Any:
    """Samples of the few held-out seconds with the largest error."""
    inside = np.flatnonzero(band.held_out)
    if len(inside) < 2:
        return np.arange(len(band.time))
    time = band.time[inside]
    energy = np.concatenate(([0.0], np.cumsum(np.nan_to_num((band.measured - band.mean)[inside]) ** 2)))
    stop = np.searchsorted(time, time + ZOOM_SECONDS, side="right")
    first = int(np.argmax(energy[stop] - energy[np.arange(len(time))]))
    return inside[first : int(stop[first])]
