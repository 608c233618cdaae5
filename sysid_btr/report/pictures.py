"""The pictures of a run: what is drawn of which outcome, the files they are kept in, and the report made of them.

A picture is ``NAME.png`` in the output folder, and ``dark/NAME.png`` for a dark page; result.json lists the names.
So the report can be written again from the folder alone.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sysid_btr.errors import UsageError
from sysid_btr.report.html import Picture, render
from sysid_btr.report.style import on_page
from sysid_btr.run_folder import EXPLORER, OVERLAY, REPORT, RESULT, SERIES, Folder, make_relative

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from sysid_btr.diagnosis.closing import Closing
    from sysid_btr.identify.fit import Fit
    from sysid_btr.identify.intervals import Profile
    from sysid_btr.posterior.outcome import Posterior
    from sysid_btr.report.traces import Played

    Draw = Callable[[], Figure]

DARK = "dark"
"""Folder of the pictures for a dark page."""
PNG = b"\x89PNG\r\n\x1a\n"
"""First bytes of a picture."""
GZIP = b"\x1f\x8b"
"""First bytes of what was compressed."""


@dataclass(frozen=True)
class Caption:
    """What a picture shows.

    Attributes
    ----------
    title : its heading.
    note : how to read it.
    """

    title: str
    note: str = ""


CAPTIONS: Mapping[str, Caption] = {
    "overlay": Caption(
        "Command, log and model where the model was most wrong",
        "Left: the whole log, the held-out part shaded. Middle: the seconds in which the plain model is farthest off. "
        "Right: the residual there, over twice the sensor's noise.",
    ),
    "render": Caption(
        "Log, model before and model after, side by side",
        "Red: the log's pose where a model deviates from it. render.gif in the folder is animated.",
    ),
    "residuals": Caption(
        "Is the residual correlated with anything?",
        "Correlation of the held-out residual with itself (left) and with earlier commands (right). Inside the band "
        "it is that of white noise. A curve that leaves the band on the right is motion that the model lacks.",
    ),
    "curves": Caption(
        "Forms that were learnt",
        "A torque that no law of the library gives, over what it depends on, with its 95 % interval at each point.",
    ),
    "convergence": Caption("Progress of the search"),
    "predictive": Caption(
        "Posterior prediction of held-out data",
        "Left: the seconds that are predicted worst. Right: the error over the whole held-out part. 95 % of the "
        "samples should lie in the band.",
    ),
    "corner": Caption(
        "The posterior",
        "Every parameter, and every two of them; a slanted ellipse means that the two are correlated. "
        "Red lines: the least-squares fit. Dashed: median and 95 % interval.",
    ),
    "trace": Caption(
        "Did the draws converge?",
        "Mean and central 95 % of the walkers of each independent ensemble, step by step: they should "
        "coincide and show no trend.",
    ),
    "profile": Caption(
        "Profile of the likelihood",
        "Deviance with the parameter fixed and all others fitted anew; the interval ends where it crosses the line. "
        "Where it follows the dashed parabola, the standard error is sufficient.",
    ),
    "excite": Caption(
        "The motion, and how informative it is",
        "Left: the commands of the joints that move most, within their bounds. Right: the expected standard errors, "
        "relative to those of the reference motion: shorter is better.",
    ),
    "btr": Caption(
        "Fitness, its difference between model and robot, and the model, over the iterations",
        "Dots in the panels of the parameters: all models of an iteration, the better the darker; line: the one kept.",
    ),
}
"""By name of the picture's file, up to the first underscore; ``btr`` for the overlay of a result of that kind."""


def pictures_of(outcome: Fit | Closing | Posterior, played: Callable[[], Played]) -> Iterator[tuple[str, Draw]]:
    """Names of an outcome's pictures and what draws them, in the order of the report.

    `played` gives what its model does in the held-out episodes.
    """
    from sysid_btr.identify.curves import curves_of
    from sysid_btr.identify.fit import Fit
    from sysid_btr.posterior.outcome import Posterior
    from sysid_btr.report.curves import plot_curves
    from sysid_btr.report.figures import figure_of, plot_convergence, plot_overlay, plot_residuals
    from sysid_btr.writeback.write import identified

    model = outcome.as_fit if isinstance(outcome, Posterior) else outcome
    yield "overlay", lambda: figure_of(plot_overlay(played().worst()))
    if isinstance(outcome, Posterior):
        from sysid_btr.report.posterior import plot_bands, plot_corner, plot_trace

        yield "predictive", lambda: figure_of(plot_bands(outcome))
        yield "corner", lambda: figure_of(plot_corner(outcome))
        yield "trace", lambda: figure_of(plot_trace(outcome))
    final = identified(model)
    if curves := curves_of(final.model, final.estimates):
        yield "curves", lambda: figure_of(plot_curves(curves))
    yield "residuals", lambda: figure_of(plot_residuals(played().worst()))
    if isinstance(outcome, Fit):
        for profile in outcome.profiles:
            yield f"profile_{file_name(profile.name)}", partial(_profile, profile)
        if outcome.result.history:
            yield "convergence", lambda: figure_of(plot_convergence(outcome))


def _profile(profile: Profile) -> Figure:
    from sysid_btr.report.figures import figure_of
    from sysid_btr.report.posterior import plot_profile

    return figure_of(plot_profile(profile))


def write_pages(
    folder: Folder,
    result: dict[str, Any],
    pictures: Iterable[tuple[str, Draw]],
    series: Callable[[], bytes] | None = None,
) -> Path:
    """Write result.json, then pictures and pages; a picture that cannot be drawn costs no more than itself.

    The result is written before anything is drawn, and again with the names of the pictures. Paths in it become
    relative to the folder. `series` gives what the page to explore draws, where there is one.

    Returns
    -------
    Path
        The report.
    """
    from sysid_btr.result import to_json

    make_relative(result, folder.path)
    folder.write(RESULT, to_json(result))
    names, failed = _keep(folder, pictures)
    result["pictures"] = names
    for earlier in (EXPLORER, SERIES):
        (folder.path / earlier).unlink(missing_ok=True)
    if series is not None:
        try:
            folder.write(SERIES, series())
            result["explore"] = SERIES
        except Exception as error:
            failed.append(f"{EXPLORER}: {type(error).__name__}: {error}")
    if failed:
        result["not_drawn"] = failed
    report = write_report(folder, result)
    folder.write(RESULT, to_json(result))
    return report


def _keep(folder: Folder, pictures: Iterable[tuple[str, Draw]]) -> tuple[list[str], list[str]]:
    """Draw pictures for light and dark pages and write them; names of their files, and why others are missing."""
    names, failed = [], []
    dark = folder.within(DARK)
    for name, draw in pictures:
        try:
            light_page, dark_page = on_page(draw), on_page(draw, dark=True)
        except Exception as error:
            failed.append(f"{name}.png: {type(error).__name__}: {error}")
            continue
        folder.write(f"{name}.png", light_page)
        dark.write(f"{name}.png", dark_page)
        names.append(f"{name}.png")
    return names, failed


def write_report(folder: Folder, result: Mapping[str, Any]) -> Path:
    """Write report.html from a result and the pictures in the folder, and explore.html if the folder has its series.

    Pictures that result.json lists and that are gone are left out.

    Raises
    ------
    UsageError
        If it lists anything but PNG files of this folder: a result may come from somebody else, and the page with
        what is in it may go to others.
    """
    names = result.get("pictures", [OVERLAY])
    strange = [str(name) for name in names if not _is_picture(folder.path, name)]
    if strange:
        raise UsageError(
            f"{folder.path / RESULT} lists as pictures {', '.join(strange)}: pictures are PNG files in the same folder"
        )
    pictures = [p for name in names for p in _picture(folder.path, name, result)]
    explored = "explore" in result and _is_own(folder.path, folder.path / SERIES, GZIP)
    report = folder.write(REPORT, render(result, pictures, EXPLORER if explored else None))
    if explored:
        from sysid_btr.report.explore import explorer

        files = {file.name for file in folder.path.iterdir()}
        folder.write(EXPLORER, explorer(result, (folder.path / SERIES).read_bytes(), files))
    return report


def rewrite(folder: Folder, result: dict[str, Any], picture: str) -> None:
    """Write report and result again with one more picture, the second."""
    from sysid_btr.result import to_json

    result["pictures"] = [*result["pictures"][:1], picture, *result["pictures"][1:]]
    write_report(folder, result)
    folder.write(RESULT, to_json(result))


def _is_picture(folder: Path, name: Any) -> bool:
    """Whether a name is that of a PNG file of the folder itself, or of none."""
    if not isinstance(name, str) or Path(name).name != name or Path(name).suffix != ".png":
        return False
    return all(_is_own(folder, f, PNG) for f in (folder / name, folder / DARK / name) if f.exists())


def _is_own(folder: Path, file: Path, begins: bytes) -> bool:
    """Whether a file lies in a folder, through whatever links, and begins as its kind does."""
    return file.is_file() and file.resolve().is_relative_to(folder.resolve()) and file.read_bytes().startswith(begins)


def _picture(folder: Path, name: str, result: Mapping[str, Any]) -> Iterator[Picture]:
    file, dark = folder / name, folder / DARK / name
    if not file.is_file():
        return
    key = "btr" if result["kind"] == "btr" and name == OVERLAY else Path(name).stem.partition("_")[0]
    caption = CAPTIONS.get(key, Caption(Path(name).stem))
    title = caption.title
    if key == "profile":
        title = f"{title}: {_profiled(name, result)}"
    yield Picture(title, caption.note, file.read_bytes(), dark.read_bytes() if dark.is_file() else None)


def _profiled(name: str, result: Mapping[str, Any]) -> str:
    """The parameter whose profile a file shows."""
    stem = Path(name).stem.removeprefix("profile_")
    return next((p["name"] for p in result.get("profiles", []) if file_name(p["name"]) == stem), stem)


def file_name(parameter: str) -> str:
    """A parameter's name as a part of a file's."""
    return re.sub(r"[^A-Za-z0-9._-]+", "_", parameter).strip("_")
