"""The paper's Fig. 3: fitness, its difference, and the model's parameters over the iterations."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from sysid_btr.report.figures import figure_of
from sysid_btr.report.style import FOUND, PLAIN, faint, ink, new_figure, on_page

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

COLUMNS = 3
NAMED = 2
"""Places listed in a label; of more, their number."""
BESIDE = 0.06
"""Iterations by which trials of one stand beside each other."""
SHOWN = 30
"""Models drawn of each iteration, best last and darkest."""


def plot_btr(
    result: Mapping[str, Any], figure: Figure | None = None, *, truth: Mapping[str, float] | None = None
) -> list[Axes]:
    """Fitness, its difference between model and robot, and each of the model's parameters over the iterations.

    Parameters
    ----------
    result : content of result.json, of kind ``btr``.
    figure : to draw on; a new one if None.
    truth : parameter -> value in the robot, where it is known.
    """
    rounds = result["iterations"]
    names = list(dict.fromkeys(n for r in rounds for n in r["model"]))
    count = 2 + len(names)
    columns = 2 if count == 4 else min(count, COLUMNS)
    rows = -(-count // columns)
    figure = new_figure(13, 0.4 + 2.8 * rows) if figure is None else figure
    axes = list(figure.subplots(rows, columns, squeeze=False).ravel())
    _fitness(axes[0], result)
    _difference(axes[1], rounds, _unit(result))
    for axis, name in zip(axes[2:], names, strict=False):
        _parameter(axis, rounds, name, (truth or {}).get(name))
    for axis in axes[:count]:
        axis.set_xlabel("iteration")
        axis.locator_params(axis="x", integer=True)
    for axis in axes[count:]:
        axis.set_visible(False)
    return axes[:count]


def draw_btr(result: Mapping[str, Any], *, dark: bool = False, truth: Mapping[str, float] | None = None) -> bytes:
    """`plot_btr` as a PNG file, for a light or a dark page."""
    return on_page(lambda: figure_of(plot_btr(result, truth=truth)), dark=dark)


def _unit(result: Mapping[str, Any]) -> str:
    """Of the fitness, after its name."""
    unit = result["units"]["fitness"]
    return "" if unit == "1" else f" ({unit})"


def _numbers(values: Sequence[float | None]) -> list[float]:
    return [np.nan if v is None else v for v in values]


def _fitness(axis: Axes, result: Mapping[str, Any]) -> None:
    rounds = result["iterations"]
    x = [r["number"] for r in rounds]
    at = _places(result["trials"])
    axis.scatter(at, _numbers([t["fitness"] for t in result["trials"]]), s=8, color=faint(), label="trials")
    for place, t in zip(at, result["trials"], strict=True):
        if t.get("foreseen"):
            axis.plot([place] * 2, [t["foreseen"]["low"], t["foreseen"]["high"]], color=faint(), lw=0.5)
    for key, label, colour, line in (
        ("best", "best on the robot", FOUND, "-"),
        ("mean", "mean on the robot", FOUND, ":"),
        ("expected", "best in the model", PLAIN, "--"),
    ):
        axis.plot(x, _numbers([r["fitness"][key] for r in rounds]), line, color=colour, label=label)
    axis.set_ylabel(f"fitness{_unit(result)}")
    axis.legend(fontsize=7)


def _places(trials: Sequence[Mapping[str, Any]]) -> list[float]:
    """Where trials stand: side by side in their iteration where their intervals would cover each other."""
    rounds = [t["iteration"] for t in trials]
    if not any(t.get("foreseen") for t in trials):
        return rounds
    order = [rounds[:i].count(number) for i, number in enumerate(rounds)]
    return [n + BESIDE * (i - (rounds.count(n) - 1) / 2) for n, i in zip(rounds, order, strict=True)]


def _difference(axis: Axes, rounds: Sequence[Mapping[str, Any]], unit: str) -> None:
    x = [r["number"] for r in rounds]
    for key, label, colour, line in (
        ("transfer", "foreseen", PLAIN, "--"),
        ("corrected", "after correction", FOUND, "-"),
    ):
        axis.plot(x, _numbers([r["delta_fitness"][key] for r in rounds]), line, color=colour, label=label)
    axis.set_ylabel(f"mean |model - robot|{unit}")
    if any(v is not None and v > 0 for r in rounds for v in r["delta_fitness"].values()):
        axis.set_yscale("log")
    axis.legend(fontsize=7)


def _parameter(axis: Axes, rounds: Sequence[Mapping[str, Any]], name: str, truth: float | None) -> None:
    from matplotlib.colors import to_rgba

    for r in rounds:
        names, values = list(r["models"]["names"]), np.array(r["models"]["values"], dtype=np.float64)
        if name not in names or not len(values):
            continue
        losses = np.array(_numbers(r["models"]["losses"]))
        order = np.argsort(-np.nan_to_num(losses, nan=np.inf), kind="stable")[-SHOWN:]
        shades = [to_rgba(faint(), float(a)) for a in np.linspace(0.05, 0.5, len(order))]
        place = np.full(len(order), float(r["number"]))
        axis.scatter(place, values[order, names.index(name)], s=10, color=shades, lw=0)
    x = [r["number"] for r in rounds if name in r["model"]]
    axis.plot(x, [r["model"][name] for r in rounds if name in r["model"]], color=ink())
    if truth is not None:
        axis.axhline(truth, color=PLAIN, lw=0.8, ls="--")
    axis.set_ylabel(_short(name))


def _short(name: str) -> str:
    """A parameter's name with at most a few of its places."""
    kind, colon, places = name.partition(":")
    listed = places.split(",")
    return name if len(listed) <= NAMED else f"{kind}{colon}{len(listed)} places"
