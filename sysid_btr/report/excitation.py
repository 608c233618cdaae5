"""Picture of an excitation trajectory."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from sysid_btr.report.style import FOUND, PLAIN, faint, ink, new_figure

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from sysid_btr.excite.design import Design

MOTORS_SHOWN = 6


def plot_motion(design: Design) -> Figure:
    """The commands of the motors that move most, and the ratio of every interval to the reference's."""
    time, commands = design.family.commands(design.coefficients)
    motors = design.family.motors
    order = np.argsort([-np.ptp(q) for q in commands.T], kind="stable")[:MOTORS_SHOWN]
    names = [e.name for e in design.designed.estimates]
    figure = new_figure(13, max(1.1 * len(order), 0.3 * len(names)) + 1.2)
    halves: Any = figure.subfigures(1, 2, width_ratios=(1.5, 1))
    left, right = halves
    rows = left.subplots(len(order), 1, sharex=True, squeeze=False)[:, 0]
    for axis, i in zip(rows, order, strict=True):
        axis.plot(time, commands[:, i], color=ink(), lw=1)
        for bound in (motors[i].low, motors[i].high):
            axis.axhline(bound, color=faint(), lw=0.8, ls="--")
        axis.set_ylabel(motors[i].joints[0], rotation=0, ha="right", fontsize=8)
        axis.locator_params(axis="y", nbins=4)
    rows[0].set_title("commands (rad, m) and their bounds", fontsize=9)
    rows[-1].set_xlabel("time (s)")
    axis = right.subplots()
    place = np.arange(len(names))[::-1]
    ratios = np.where(design.identifiable, design.ratios, np.nan)
    axis.barh(place, ratios, color=[FOUND if r <= 1 else PLAIN for r in np.nan_to_num(ratios)])
    for y, ratio in zip(place, ratios, strict=True):
        text = f" {ratio:.2f}" if np.isfinite(ratio) else " not identifiable from either"
        axis.text(ratio if np.isfinite(ratio) else 0.0, y, text, va="center", fontsize=8, color=ink())
    axis.axvline(1.0, color=faint(), lw=0.8)
    axis.set_yticks(place, names, fontsize=8)
    axis.set_ylim(-0.7, len(names) - 0.3)
    axis.set_xlim(0, 1.15 * max(np.nanmax(ratios, initial=1.0), 1.0))
    axis.set_title(f"standard error over that of {design.compared_with}", fontsize=9)
    return figure
