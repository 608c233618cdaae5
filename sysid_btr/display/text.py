"""A result as tables for a terminal."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING, Any, Protocol, TextIO

from sysid_btr.display.changes import model_lines
from sysid_btr.display.printable import printable
from sysid_btr.units import probability, si_all, with_digits_of

if TYPE_CHECKING:
    from rich.console import Console, RenderableType
    from rich.table import Table

PLAIN_WIDTH = 118
"""Columns where the output is no terminal, so that what is piped does not depend on a window."""
CANDIDATES_SHOWN, EXACT_SHOWN, PREDICTORS_SHOWN = 6, 4, 3
PARTS = (("train", "fitted"), ("holdout", "held-out"))
HELD_OUT = "held out"
RECORDED = (
    "the log moves as MuJoCo does in steps of {}, and not as in finer ones, so it is replayed in these "
    "(others: --for INTEGRATOR:STEP)"
)
MENTIONED = 0.01
"""Probability from which another cause is mentioned, and share from which a predictor is."""


class Finding(Protocol):
    """What is wrong with a log, as `io.problem.Problem` says it."""

    @property
    def severity(self) -> str: ...

    @property
    def code(self) -> str: ...

    @property
    def where(self) -> str: ...

    @property
    def message(self) -> str: ...

    @property
    def remedy(self) -> str: ...


def console(stream: TextIO) -> Console:
    """A console that writes results; plain text of fixed width unless `stream` is a terminal."""
    from rich.console import Console
    from rich.segment import Segment

    class Screen(Console):
        def render(self, *given: Any, **options: Any) -> Iterator[Segment]:
            for text, style, control in super().render(*given, **options):
                yield Segment(printable(text), style, control)

    width = None if stream.isatty() else PLAIN_WIDTH
    return Screen(file=stream, width=width, highlight=False, emoji=False, markup=False)


def show(result: Mapping[str, Any], out: Console, *, explain: bool = False) -> None:
    """Print the result of a fit, a closing or a replay; `explain` adds all effects that were tried, and their fate."""
    for part in _parts(result, explain):
        out.print(part)


def _parts(result: Mapping[str, Any], explain: bool) -> Iterator[RenderableType]:
    from rich.text import Text

    verdict, message = (result.get("verdict") or "").replace("_", " "), result["message"]
    said = not verdict or message.lower().startswith(verdict)
    yield Text(message if said else f"{verdict}: {message}", style="bold")
    yield errors_table(result)
    for effect in result.get("effects", []):
        yield Text(f"+ {effect['sentence'] or effect['effect']}")
        yield Text(f"  {certainty_words(effect)}")
        if effect["confused_with"]:
            yield Text(f"  confounded on this log with: {', '.join(effect['confused_with'])}")
    yield from (Text(line) for line in curve_lines(result))
    estimates = tabled_estimates(result)
    if estimates:
        yield parameters_table(estimates)
        yield from map(Text, exactness(result))
        for p in estimates:
            if p["reason"]:
                yield Text(f"  {p['name']}: {identifiability(p)}: {p['reason']}")
    yield from (Text(line) for line in model_lines(result))
    if explain and result.get("candidates"):
        yield tried_table(result["candidates"])
    elif result.get("verdict") in ("ambiguous", "partly_explained", "unexplained") and result.get("candidates"):
        yield candidates_table(result["candidates"][:CANDIDATES_SHOWN])
    if result.get("signature"):
        # in words it stands in the message
        rows = residual_rows(result["signature"])
        if rows:
            yield residual_table(rows)
    for p in result.get("profiles", []):
        ends = zip(p["ci95"], p["closed"], strict=True)
        low, high = (number(end) + ("" if closed else " (not closed)") for end, closed in ends)
        yield Text(f"profile of {p['name']}: 95 % within {low} .. {high}, the others fitted anew")
    if result.get("converged") is False:
        yield Text(result["termination"], style="bold")
    for missing in result.get("not_drawn", []):
        yield Text(f"could not be drawn: {missing}", style="bold")
    yield from (Text(words, style="dim") for words in episode_words(result))
    numerics, model = result["numerics"], result["model"]["name"]
    if numerics.get("recorded"):
        yield Text(RECORDED.format(numerics["chosen"]), style="dim")
    yield Text(
        f"model {model}, {numerics['chosen']}; {result['replays']} replays in {result['wall_s']:.1f} s"
        + (f"; seed {result['seed']}" if result.get("seed") is not None else ""),
        style="dim",
    )


def certainty_words(effect: Mapping[str, Any]) -> str:
    """How sure a name is, what else it would be, and what it explains."""
    text = f"{effect['family']} with {probability(effect['certainty'])} certainty"
    others = [f"{name} {probability(p)}" for name, p in effect["otherwise"].items() if p >= MENTIONED]
    if others:
        text += f" (otherwise {', '.join(others)})"
    gone = [f"{100 * effect['explains'][part]:.3g} % in {name}" for part, name in PARTS]
    text += f"; of the squared error above the noise it removes {' and '.join(gone)} data"
    return text + ("; something is left where it acts, so its form is provisional" if effect["provisional"] else "")


def episode_words(result: Mapping[str, Any]) -> Iterator[str]:
    """How each log was compared with the model, where that is not by one replay of it whose end is held out."""
    for episode in (*result.get("walks", []), *result.get("episodes", [])):
        if episode["part"] == "train":
            yield "; ".join(_episode_words(episode))
    for log in result.get("logs", []):
        for spans in log.get("held_out", []):
            if len(spans) > 1:
                seconds = sum(end - begin for begin, end in spans)
                name = Path(log["path"]).name if log["path"] else "the log"
                yield (
                    f"held out of {name}: {len(spans)} parts all over it, {seconds:.3g} s together; what changes along "
                    "a log cannot be judged at its end alone"
                )


def _episode_words(episode: Mapping[str, Any]) -> Iterator[str]:
    """What was done with one log."""
    yield episode["summary"] + (f" ({episode['why']})" if episode.get("why") else "")
    if episode.get("counted_less"):
        yield f"{episode['counted_less']} of them, mostly impacts, count less"
    yield from episode.get("events", ())
    yield from episode.get("lost", ())


def stages(result: Mapping[str, Any]) -> list[tuple[str, str]]:
    """(key, name) of the models that a result compares; none where nothing was compared with a log."""
    names = {
        "replay": [("nominal", "replayed")],
        "fit": [("nominal", "plain model"), ("before", "fitted")],
        "posterior": [("nominal", "plain model"), ("before", "posterior mean")],
        "close": [("nominal", "plain model"), ("before", "parameters fitted"), ("after", "effects added")],
        "btr": [("nominal", "plain model"), ("after", "corrected by the trials")],
    }
    return names.get(result["kind"], [])


def errors_table(result: Mapping[str, Any]) -> Table:
    """Error of each model on each channel, on fitted and on held-out data, against the noise floor."""
    table = _table("error (rmse)")
    columns = stages(result)
    for _, name in columns:
        table.add_column(name, justify="right")
    table.add_column("noise floor", justify="right")
    for label, channel, scores in channel_scores(result):
        unit = result["units"].get(channel, "").partition(",")[0]
        floor = result["noise_floor"].get(channel)
        *errors, least = si_all([*(s.get("rmse") for s in scores), floor], unit)
        cells = [text + relative(s.get("nrmse")) for text, s in zip(errors, scores, strict=True)]
        alone = result["kind"] == "replay" and label == HELD_OUT
        table.add_row(channel if alone else f"{channel}, {label}", *cells, least)
    return table


def channel_scores(result: Mapping[str, Any]) -> Iterator[tuple[str, str, list[Mapping[str, Any]]]]:
    """Part of the data, channel, and the score of each model there; an empty one where a model has none."""
    columns = [result.get(key, {}) for key, _ in stages(result)]
    for part, label in (("train", "fitted data"), ("holdout", HELD_OUT), ("whole", "whole log")):
        for channel in dict.fromkeys(c for scores in columns for c in scores.get(part, {})):
            yield label, channel, [scores.get(part, {}).get(channel, {}) for scores in columns]


def relative(nrmse: float | None) -> str:
    """Error relative to the signal, in brackets."""
    return "" if nrmse is None else f"  ({100 * nrmse:.3g} %)"


def parameters_table(parameters: Sequence[Mapping[str, Any]]) -> Table:
    """Estimates with intervals."""
    table = _table("parameter")
    for name in ("nominal", "value", "std", "95 % interval", "unit"):
        table.add_column(name, justify="left" if name == "unit" else "right", no_wrap=True)
    table.add_column("identifiable")
    for p in parameters:
        known = p["identifiable"] != "no"
        table.add_row(
            p["name"],
            number(p["nominal"]),
            with_digits_of(p["value"], p["std"]) if known else "-",
            number(p["std"], 2) if known else "-",
            " .. ".join(with_digits_of(end, p["std"]) for end in p["ci95"]) if known else "-",
            "x nominal" if p["unit"] == "1" else p["unit"],
            identifiability(p),
        )
    return table


def estimates_of(result: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    """All parameters of a result: the declared ones, then those of its effects."""
    return [*result.get("parameters", []), *(p for e in result.get("effects", []) for p in e["parameters"])]


def curve_lines(result: Mapping[str, Any]) -> Iterator[str]:
    """What was learnt, where it goes and how well it is known."""
    for curve in result.get("curves", []):
        half = median(0.5 * (high - low) for low, high in zip(curve["low"], curve["high"], strict=True))
        yield f"{curve['title']}: {curve['words']}; the 95 % interval at each value is +- {number(half, 2)} (median)"


def tabled_estimates(result: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    """The same without the numbers of curves, which say something together alone."""
    together = {name for curve in result.get("curves", []) for name in curve["parameters"]}
    return [p for p in estimates_of(result) if p["name"] not in together]


def exactness(result: Mapping[str, Any]) -> Iterator[str]:
    """What intervals take as exact, and what they do not."""
    exact, allowed = result.get("taken_as_exact"), result.get("nuisance")
    if exact is None:
        return
    wider = [p["std"] / p["std_if_right"] for p in estimates_of(result) if p.get("std_if_right")]
    if wider:
        yield (
            "the model leaves more than noise: intervals also hold for unknown torques at the joints, as large as what "
            f"is left, and are {number(median(wider), 2)} times as wide (median) as if the model were right"
        )
    elif result.get("misfit"):
        yield "the model leaves more than noise, which the intervals do not account for"
    held = [p for p in estimates_of(result) if p.get("prior_std")]
    if held:
        fields = ", ".join(dict.fromkeys(p["name"].partition(":")[0] for p in held))
        share = number(100 * held[0]["prior_std"] / held[0]["nominal"], 2)
        yield (
            f"beside what the log says, {fields} was taken to be what the model states, give or take "
            f"{share} % (one standard deviation); --bounds states otherwise"
        )
    if allowed:
        sizes = ", ".join(f"{name} by {number(std)}" for name, std in allowed.items())
        yield f"intervals hold where what is not fitted is off: {sizes} (one standard deviation)"
    else:
        masses = [name.partition(":")[2] for name in exact]
        shown = ", ".join(masses[:EXACT_SHOWN])
        shown += f" and {len(masses) - EXACT_SHOWN} more" if len(masses) > EXACT_SHOWN else ""
        among = f", among it the mass of {shown} (--nuisance mass=0.1: not known better than to 10 %)" if masses else ""
        yield f"intervals take what is not fitted as exact{among}"


def candidates_table(candidates: Sequence[Mapping[str, Any]]) -> Table:
    """Effects that were considered."""
    table = _table("effect considered")
    for name in ("where", "would explain", "size", "confounded with"):
        table.add_column(name)
    for c in candidates:
        explained = "-" if c["explained"] is None else f"{100 * c['explained']:.0f} %"
        where = ", ".join(c["where"])
        table.add_row(c["effect"], where, explained, number(c["amplitude"]), ", ".join(c["confused_with"]))
    return table


def tried_table(candidates: Sequence[Mapping[str, Any]]) -> Table:
    """Effects that were tried, round by round, the best first, and what became of each."""
    table = _table("effect tried")
    for name in ("round", "would explain", "amounts", "what became of it"):
        table.add_column(name)
    for c in sorted(candidates, key=lambda c: (c["round"], -(c["explained"] or 0.0))):
        explained = "-" if c["explained"] is None else f"{100 * c['explained']:.3g} %"
        amounts = ", ".join(f"{place} {number(value, 3)}" for place, value in c["amounts"].items())
        table.add_row(c["effect"], str(c["round"]), explained, amounts, c["why"])
    return table


RESIDUAL = ("joint", "share", "rms", "noise", "predicted by, on stretches left out")
"""Head of the table of what is left."""


def residual_rows(signature: Mapping[str, Any]) -> list[tuple[str, ...]]:
    """Of each joint's missing torque: its share of what is left, size, noise, and what predicts it, the best first."""
    rows = []
    for joint in signature["joints"]:
        predicts = [
            f"{d['on'].replace('_', ' ').replace(':', ' of ')} {100 * d['share']:.0f} %"
            for d in joint["dependence"][:PREDICTORS_SHOWN]
            if d["share"] >= MENTIONED
        ]
        sizes = (f"{number(joint[key], 3)} {joint['unit']}" for key in ("torque_rms", "torque_noise"))
        known = ", ".join(predicts) or "none of what was tried"
        rows.append((joint["joint"], f"{100 * joint['share']:.0f} %", *sizes, known))
    return rows


def residual_table(rows: Sequence[Sequence[str]]) -> Table:
    """The torque that a model lacks, by joint."""
    table = _table(f"left at {RESIDUAL[0]}")
    for name in RESIDUAL[1:]:
        table.add_column(name)
    for row in rows:
        table.add_row(*row)
    return table


def problems_table(problems: Sequence[Finding]) -> Table:
    """What is wrong with a log."""
    table = _table("")
    for name in ("where", "what is wrong", "what to do"):
        table.add_column(name)
    for p in problems:
        table.add_row(p.severity, p.where, f"{p.message} [{p.code}]", p.remedy)
    return table


def joints_table(joints: Mapping[str, float], channel: str, unit: str) -> Table:
    """Error of a channel at each joint, worst first."""
    table = _table("joint")
    table.add_column(f"{channel} error (rmse)", justify="right")
    order = sorted(joints, key=lambda name: -joints[name])
    for name, text in zip(order, si_all([joints[name] for name in order], unit), strict=True):
        table.add_row(name, text)
    return table


def identifiability(parameter: Mapping[str, Any]) -> str:
    """Whether a parameter is identifiable, in words."""
    words = {"yes": "yes", "weak": "weakly", "no": "not identifiable"}[parameter["identifiable"]]
    return f"{words}, at its bound" if parameter["at_bound"] and parameter["identifiable"] != "no" else words


def number(value: float | None, digits: int = 4) -> str:
    """A number in a table."""
    return "-" if value is None else f"{value:.{digits}g}"


def _table(first: str) -> Table:
    from rich.box import SIMPLE_HEAD
    from rich.table import Table

    table = Table(box=SIMPLE_HEAD, pad_edge=False, show_edge=False, header_style="bold")
    table.add_column(first, overflow="fold")
    return table
