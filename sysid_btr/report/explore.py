"""The page to explore: every joint over time, the robot in 3D, correlations, sensitivities; one file, works offline.

What it draws is in ``explore.json.gz`` beside it, so it can be written again from the folder alone. Arrays in there are
``{"type": "f4", "shape": [...], "data": base64}``. The page holds plotly.js as the Python package ``plotly`` ships it.
"""

from __future__ import annotations

import gzip
import json
from base64 import b64encode
from collections.abc import Collection, Iterator, Mapping
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from sysid_btr._typing import FloatArray
from sysid_btr.mujoco_conventions import free_joints
from sysid_btr.report.bodies import Body, bodies_of, filled, placed
from sysid_btr.report.guide import about_verdict
from sysid_btr.report.html import VERDICTS, environment
from sysid_btr.report.style import model_colours
from sysid_btr.report.traces import Played, PlayedEpisode, Trace
from sysid_btr.result import clean
from sysid_btr.run_folder import DRAWS, MODEL, PARAMS, REPORT, RESULT

SCHEMA = "sysid_btr.explore/2"
"""Of what explore.js reads."""
MOST_NUMBERS = 600_000
"""Numbers of all series together; of longer logs every other sample is left out, or more."""
FRAMES, RATE = 600, 25.0
"""Poses of the robot, of all episodes together and in a second at most."""
SCRIPTS = ("robot.js", "explore.js")
"""What the page does, in the order in which it is read."""
GRID = 32767
"""Positions and quaternions of bodies are whole numbers up to this one."""
FILES = {REPORT: "printed report", MODEL: "model.xml", PARAMS: "params.json", RESULT: "result.json", DRAWS: "draws"}
"""Files of a run that the page links to."""


def explorable(played: Played) -> bytes:
    """What the page draws of held-out episodes: content of ``explore.json.gz``."""
    sensors = sum(len(item.traces) * len(item.episode.log) for item in played.episodes)
    stride = max(int(np.ceil(sensors * (2 + len(played.models)) / MOST_NUMBERS)), 1)
    bodies = bodies_of(played.episodes[0].replay.model) if played.episodes else ()
    content = {
        "schema": SCHEMA,
        "models": played.models,
        "colours": model_colours(len(played.models)),
        "rank_by": played.models.index(played.rank_by),
        "stride": stride,
        "bodies": [_body(body) for body in bodies],
        "episodes": [_episode(played, item, stride, bodies) for item in played.episodes],
    }
    return gzip.compress(json.dumps(content, separators=(",", ":")).encode(), 6, mtime=0)


def _episode(played: Played, item: PlayedEpisode, stride: int, bodies: tuple[Body, ...]) -> dict[str, Any]:
    log = item.episode.log
    ordered = sorted(item.traces, key=lambda trace: -trace.error(played.rank_by))
    frames = max(FRAMES // len(played.episodes), 2)
    return {
        "label": item.label or (log.path.stem if log.path is not None else "the log"),
        "time": packed((log.time - log.time[0])[::stride], "f4"),
        "held_out": item.traces[0].spans,
        "channels": list(dict.fromkeys(trace.channel for trace in item.traces)),
        "sensors": [_sensor(trace, stride) for trace in ordered],
        "scene": _scene(item, bodies, frames) if bodies else None,
    }


def _sensor(trace: Trace, stride: int) -> dict[str, Any]:
    return {
        "joint": trace.joint,
        "channel": trace.channel,
        "unit": trace.unit,
        "noise": trace.noise,
        "errors": clean(list(trace.errors.values())),
        "command": packed(trace.command[::stride], "f4"),
        "log": packed(trace.measured[::stride], "f4"),
        "predicted": [packed(values[::stride], "f4") for values in trace.predicted.values()],
    }


def _scene(item: PlayedEpisode, bodies: tuple[Body, ...], frames: int) -> dict[str, Any]:
    """The robot as logged and as the first and the last model have it."""
    model, time = item.replay.model, item.episode.log.time - item.episode.log.time[0]
    count = int(min(frames, max(RATE * time[-1], 2), len(time)))
    rows = np.unique(np.searchsorted(time, np.linspace(0, time[-1], count)).clip(0, len(time) - 1))
    poses = np.stack([placed(model, bodies, pose[rows]) for pose in _poses(item)], axis=1)
    extent = float(np.abs(poses[..., :3]).max(initial=1e-9))
    poses[..., :3] *= GRID / extent
    poses[..., 3:] *= GRID
    return {
        "time": packed(time[rows], "f4"),
        "extent": extent,
        "poses": packed(np.rint(poses), "i2"),
        "floating": item.episode.log.meta.mount == "free",
    }


def _body(body: Body) -> dict[str, Any]:
    return {"name": body.name, "vertices": packed(body.vertices, "f4"), "faces": packed(body.faces, "u2")}


def _poses(item: PlayedEpisode) -> Iterator[FloatArray]:
    """Coordinates (n, nq) of the log, of the first and of the last model.

    Joints that the log does not show stand as the last model has them, and gaps are bridged. A free base stands where
    it was in the log: where a model has it is not observed.
    """
    outputs, log, index = list(item.outputs.values()), item.episode.log, item.replay.index
    first, last = (
        np.column_stack([filled(column, np.zeros(len(column))) for column in outputs[k].position[0].T]) for k in (0, -1)
    )
    logged = [filled(log.channels.get(f"position.{joint}"), last[:, k]) for k, joint in enumerate(index.joints)]
    base, free = item.episode.base_poses, item.replay.model.jnt_qposadr[free_joints(item.replay.model)]
    for joints in (np.column_stack(logged), first, last):
        pose = np.tile(item.replay.model.qpos0, (len(joints), 1))
        pose[:, index.qpos] = joints
        if base is not None and len(free):
            pose[:, free[0] : free[0] + 7] = base
        yield pose


def packed(values: FloatArray | np.ndarray[Any, Any], kind: str) -> dict[str, Any]:
    """An array for the page, in the type and byte order of its name (``f4``, ``i2``, ``u2``)."""
    data = np.ascontiguousarray(values, dtype=f"<{kind}")
    return {"type": kind, "shape": data.shape, "data": b64encode(data.tobytes()).decode()}


# --- the page ----------------------------------------------------------------------------------------------------


def explorer(result: Mapping[str, Any], series: bytes, files: Collection[str]) -> str:
    """The page.

    Parameters
    ----------
    result : content of result.json.
    series : content of explore.json.gz.
    files : names of files in the folder.
    """
    page = environment().get_template("explore.html.j2")
    return page.render(
        r=result,
        verdict_text=VERDICTS.get(result.get("verdict", ""), ""),
        next_step=next_step(result),
        about=about_verdict(result.get("verdict", "")),
        links=[(name, words) for name, words in FILES.items() if name in files],
        result=json.dumps(result, ensure_ascii=False).replace("<", "\\u003c"),
        series=b64encode(series).decode(),
        plotly=_plotly(),
        script="\n".join(Path(__file__).with_name(name).read_text(encoding="utf-8") for name in SCRIPTS),
    )


@cache
def _plotly() -> str:
    """plotly.js, compressed, as base64."""
    spec = find_spec("plotly")
    assert spec is not None
    assert spec.origin is not None
    script = Path(spec.origin).with_name("package_data") / "plotly.min.js"
    return b64encode(gzip.compress(script.read_bytes(), 6, mtime=0)).decode()


NEXT = {
    "nothing_missing": "Use model.xml, for motions like those of this log: what they do not excite stays unknown.",
    "explained": "Use model.xml, and check the effects that are named against what you know of the robot.",
    "partly_explained": "Use model.xml, and record a log with other loads, speeds or gains: it separates forms of an "
    "effect better than a longer log does.",
    "ambiguous": "Record slow and fast motion, reversals and other loads, with torques if there are sensors: that "
    "separates the effects that are confounded here.",
    "unexplained": "Look below where and when the residual is largest: a wrong axis or length, a loose part, a servo "
    "that switches off and a clock that drifts all end here.",
}


def next_step(result: Mapping[str, Any]) -> str:
    """What to do with a result, in a sentence."""
    if result.get("converged") is False:
        return "Let the search go on (--resume, with more of what ended it): it has not converged."
    if "verdict" in result:
        return NEXT[result["verdict"]]
    if result.get("misfit"):
        return "Run sysid-btr close, which looks for what the model lacks: it leaves more than noise of its own data."
    blind = [p["name"] for p in result["parameters"] if p["identifiable"] == "no"]
    if blind:
        return (
            f"Run sysid-btr excite, which designs a motion that is informative about {', '.join(blind[:3])}"
            f"{' and others' if len(blind) > 3 else ''}; the other parameters of model.xml can be used."
        )
    return "Use model.xml: the parameters are identifiable, and the model leaves no more than noise."
