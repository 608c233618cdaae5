"""How figures look: on a light page, on a dark one, or in whatever style a user has set.

Functions that draw take the colours of text and frames from matplotlib's settings, so they follow a style that is in
force (`page`, or one of the user's own); only what distinguishes models has colours of its own.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from io import BytesIO
from typing import TYPE_CHECKING, Any, Literal

if TYPE_CHECKING:
    from matplotlib.figure import Figure

LIGHT = {"ink": "#1f2328", "faint": "#8b949e", "paper": "white"}
DARK = {"ink": "#e6edf3", "faint": "#768390", "paper": "#0d1117"}
MODEL_COLOURS = ("#d1495b", "#edae49", "#2e9e6b")
"""Plain, parameters fitted, effects added; distinguishable also without red and green."""
PLAIN, FITTED, FOUND = MODEL_COLOURS
SHADE = "#388bfd24"
"""Behind what is held out; lets both pages through."""
DPI = 100
PALETTE = 255
"""Colours of a picture file, and one; figures have few, and their files are a third as large for it."""


def model_colours(count: int) -> tuple[str, ...]:
    """Colours of so many models, from the plain to the final one."""
    return (PLAIN, FOUND) if count == 2 else MODEL_COLOURS


def page_style(theme: Mapping[str, str]) -> dict[Any, Any]:
    """Matplotlib's settings for a page of a report."""
    return {
        "font.size": 9,
        "text.color": theme["ink"],
        "axes.labelcolor": theme["ink"],
        "axes.edgecolor": theme["faint"],
        "axes.facecolor": theme["paper"],
        "figure.facecolor": theme["paper"],
        "savefig.facecolor": theme["paper"],
        "xtick.color": theme["faint"],
        "ytick.color": theme["faint"],
        "xtick.labelcolor": theme["ink"],
        "ytick.labelcolor": theme["ink"],
        "axes.spines.top": False,
        "axes.spines.right": False,
        "legend.frameon": False,
    }


@contextmanager
def page(*, dark: bool = False) -> Iterator[None]:
    """Draw for a page of a report while this lasts."""
    from matplotlib import rc_context

    with rc_context(page_style(DARK if dark else LIGHT)):
        yield


def ink() -> str:
    """Colour of what was measured: that of text."""
    from matplotlib import rcParams

    return str(rcParams["text.color"])


def faint() -> str:
    """Colour of what is beside the point: that of frames on a page, else a grey."""
    from matplotlib import rcParams, rcParamsDefault

    edge = rcParams["axes.edgecolor"]
    return LIGHT["faint"] if edge == rcParamsDefault["axes.edgecolor"] else str(edge)


def new_figure(width: float, height: float, layout: Literal["constrained"] | None = "constrained") -> Figure:
    """A figure (inches) that belongs to nobody's screen."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout=layout)
    FigureCanvasAgg(figure)
    return figure


def png(figure: Figure, dpi: float = DPI) -> bytes:
    """A figure as a PNG file of few colours."""
    from PIL import Image

    raw, small = BytesIO(), BytesIO()
    figure.savefig(raw, format="png", dpi=dpi, metadata={"Software": None})
    image = Image.open(raw).convert("RGB")
    image.quantize(PALETTE, dither=Image.Dither.NONE).save(small, format="png", optimize=True)
    return small.getvalue()


def on_page(draw: Callable[[], Figure], *, dark: bool = False) -> bytes:
    """What `draw` draws, as a PNG file for a light or a dark page."""
    with page(dark=dark):
        return png(draw())
