"""Pictures of the robot: as logged, as the model had it before, and as it has it now."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from sysid_btr._typing import FloatArray
from sysid_btr.report.bodies import filled
from sysid_btr.terms.base import Term
from sysid_btr.terms.model import Model

if TYPE_CHECKING:
    import mujoco
    from PIL.Image import Image

    from sysid_btr.diagnosis.closing import Closing
    from sysid_btr.identify.fit import Fit
    from sysid_btr.identify.study import Study
    from sysid_btr.run_folder import Folder

Frames = np.ndarray[Any, np.dtype[np.uint8]]
PICTURE, ANIMATION = "render.png", "render.gif"
WORKER = Path(__file__).with_name("render_worker.py")
MOMENTS = 3
"""Times that are drawn."""
EPISODES_SEARCHED = 4
TIMES_SEARCHED = 400
SECONDS, RATE = 3.0, 15.0
"""Length of the animation, s, and its frames a second; in real time."""
PANEL, SMALL = (300, 360), (200, 240)
"""Height and width of a panel, in the picture and in the animation."""
VIEW = (135.0, -15.0)
"""Azimuth and elevation of the camera, degrees."""
PATIENCE = 180.0
"""Seconds after which a driver that draws nothing is given up."""
BAR = 22
"""Height of a caption, pixels."""


class CannotRenderError(Exception):
    """No way to draw off-screen on this machine."""


@dataclass(frozen=True, eq=False)
class Scene:
    """What is drawn.

    Attributes
    ----------
    model : to pose.
    time : (n,) s since the first sample.
    poses : name -> coordinates (n, nq): of the log, of the model before, of the model after.
    moments : samples where before and after differ most, in order.
    apart : name -> (n,) largest distance, m, of a geometry from where it is in the log.
    """

    model: mujoco.MjModel
    time: FloatArray
    poses: dict[str, FloatArray]
    moments: tuple[int, ...]
    apart: dict[str, FloatArray]


def save_pictures(folder: Folder, outcome: Fit | Closing) -> list[Path]:
    """Write ``render.png`` and ``render.gif`` of a fit or a closing.

    Raises
    ------
    CannotRenderError
        If nothing on this machine can draw off-screen; no file is written then.
    """
    scene = scene_of(outcome)
    picture = [int(i) for i in scene.moments]
    film = _film(scene)
    camera = _camera(scene, [*picture, *film])
    still, moving = draw(scene, [picture, film], camera, [PANEL, SMALL])
    return [
        folder.write(PICTURE, _png(_sheet(scene, picture, still))),
        folder.write(ANIMATION, _gif([_row(scene, i, panels) for i, panels in zip(film, moving, strict=True)])),
    ]


@dataclass(frozen=True)
class Backdrop(Term):
    """Light, and a sky for models that have none."""

    name: ClassVar[str] = "backdrop"

    def edit_spec(self, spec: mujoco.MjSpec) -> None:
        import mujoco

        sky = mujoco.mjtTexture.mjTEXTURE_SKYBOX
        if all(texture.type != sky for texture in spec.textures):
            spec.add_texture(
                name="sysid_btr_sky",
                type=sky,
                builtin=mujoco.mjtBuiltin.mjBUILTIN_GRADIENT,
                rgb1=[1.0, 1.0, 1.0],
                rgb2=[0.82, 0.86, 0.92],
                width=64,
                height=384,
            )
        spec.visual.headlight.ambient, spec.visual.headlight.diffuse = [0.35] * 3, [0.6] * 3
        spec.visual.global_.offheight = max(spec.visual.global_.offheight, PANEL[0])
        spec.visual.global_.offwidth = max(spec.visual.global_.offwidth, PANEL[1])


def scene_of(outcome: Fit | Closing) -> Scene:
    """Poses of the held-out episode in which the plain and the final model differ most.

    Joints that the log does not show stand as the final model has them; a free base stands where the model has
    it.
    """
    from sysid_btr.simulation.compiling import compile_model, make_index
    from sysid_btr.writeback.write import identified

    final = identified(outcome)
    study = final.study
    best: Scene | None = None
    for i, episode in enumerate(study.holdout[:EPISODES_SEARCHED]):
        log = episode.log
        robot = study.robot.for_log(log)
        model = compile_model(robot, log, (Backdrop(places=()),), study.numerics)
        index = make_index(model)
        before = _predicted(study, Model.of(()), i)
        after = _predicted(study, final.model, i)
        logged = np.column_stack(
            [filled(log.channels.get(f"position.{j}"), after[:, k]) for k, j in enumerate(index.joints)]
        )
        poses = {}
        for name, joints in (("log", logged), ("model before", before), ("model after", after)):
            poses[name] = np.tile(model.qpos0, (len(joints), 1))
            poses[name][:, index.qpos] = joints
        time = log.time - log.time[0]
        scene = _compared(model, time, poses, np.flatnonzero(episode.scored))
        if best is None or _most(scene) > _most(best):
            best = scene
    assert best is not None
    return best


def _predicted(study: Study, model: Model, episode: int) -> FloatArray:
    """Positions (n, joints) of one held-out episode under a model; bridged where it is not predicted."""
    replay = study.holdout_problem(model).episodes[episode].replay
    found = replay.predict(model.values[None]).position[0]
    return np.column_stack([filled(column, np.zeros(len(column))) for column in found.T])


def _compared(model: mujoco.MjModel, time: FloatArray, poses: dict[str, FloatArray], among: Any) -> Scene:
    looked = among[:: max(len(among) // TIMES_SEARCHED, 1)]
    where = {name: _geometry(model, pose[looked]) for name, pose in poses.items()}
    log, before, after = where.values()
    difference = _apart(before, after)
    order = np.argsort(-difference)
    moments: list[int] = []
    gap = 0.1 * (time[looked[-1]] - time[looked[0]])
    for k in order:
        if all(abs(time[looked[k]] - time[m]) >= gap for m in moments):
            moments.append(int(looked[k]))
        if len(moments) == MOMENTS:
            break
    apart = {}
    for name, places in where.items():
        apart[name] = np.interp(time, time[looked], _apart(places, log))
    return Scene(model, time, poses, tuple(sorted(moments)), apart)


def _geometry(model: mujoco.MjModel, poses: FloatArray) -> FloatArray:
    """Centres (n, geoms, 3) of the robot's geometry."""
    import mujoco

    data, moving = mujoco.MjData(model), model.geom_bodyid > 0
    result = np.empty((len(poses), int(moving.sum()), 3))
    for i, pose in enumerate(poses):
        data.qpos[:] = pose
        mujoco.mj_kinematics(model, data)
        result[i] = data.geom_xpos[moving]
    return result


def _apart(a: FloatArray, b: FloatArray) -> FloatArray:
    return np.asarray(np.linalg.norm(a - b, axis=2).max(axis=1, initial=0.0))


def _most(scene: Scene) -> float:
    return float(np.max(scene.apart["model before"], initial=0.0))


def _film(scene: Scene) -> list[int]:
    """Samples of the animation, around the moment at which before and after differ most."""
    middle = max(scene.moments, key=lambda i: float(scene.apart["model before"][i]))
    start = min(max(scene.time[middle] - SECONDS / 2, 0.0), max(scene.time[-1] - SECONDS, 0.0))
    times = np.arange(start, min(start + SECONDS, scene.time[-1]), 1 / RATE)
    return [int(i) for i in np.unique(np.searchsorted(scene.time, times))]


def _camera(scene: Scene, samples: Sequence[int]) -> FloatArray:
    """Where to look from, so that the robot stays in view."""
    model = scene.model
    moving = model.geom_bodyid > 0
    places = np.concatenate([_geometry(model, pose[list(samples)]) for pose in scene.poses.values()])
    reach = model.geom_rbound[moving]
    if not len(reach):
        return np.array([*model.stat.center, 3 * model.stat.extent, *VIEW])
    low = (places - reach[:, None]).min(axis=(0, 1))
    high = (places + reach[:, None]).max(axis=(0, 1))
    radius = max(0.5 * float(np.linalg.norm(high - low)), 1e-3)
    half = 0.5 * np.radians(float(model.vis.global_.fovy))
    return np.array([*(0.5 * (low + high)), radius / np.sin(half), *VIEW])


# --- drawing --------------------------------------------------------------------------------------------


def backends() -> list[str]:
    """Values of ``MUJOCO_GL`` to try: the user's own, or else each that draws off-screen."""
    own = os.environ.get("MUJOCO_GL")
    if own:
        return [own]
    return ["egl", "osmesa", "glfw"] if sys.platform.startswith("linux") else ["glfw"]


def draw(
    scene: Scene, samples: Sequence[Sequence[int]], camera: FloatArray, sizes: Sequence[tuple[int, int]]
) -> list[Frames]:
    """Frames (samples, panels, height, width, 3) of each list of samples, drawn by the first driver that works.

    Raises
    ------
    CannotRenderError
        If none does; says what each of them answered.
    """
    import mujoco

    answers = []
    with TemporaryDirectory(prefix="sysid_btr_") as name:
        model = Path(name) / "model.mjb"
        mujoco.mj_saveModel(scene.model, str(model))
        jobs = []
        for k, (rows, size) in enumerate(zip(samples, sizes, strict=True)):
            jobs.append((Path(name) / f"job{k}.npz", Path(name) / f"frames{k}.npz"))
            poses = np.stack([pose[list(rows)] for pose in scene.poses.values()], axis=1)
            np.savez(jobs[-1][0], model=str(model), poses=poses, ghost=poses[:, 0], camera=camera, size=size)
        for backend in backends():
            problem = next((p for p in (_work(backend, *job) for job in jobs) if p), None)
            if problem is None:
                return [np.load(answer)["frames"] for _, answer in jobs]
            answers.append(f"{backend}: {problem}")
    raise CannotRenderError("; ".join(answers))


def _work(backend: str, job: Path, answer: Path) -> str | None:
    """Draw one job by one driver; what went wrong, or None."""
    # -P: the folder of the script, whose modules are called text and html, must not come before the library
    command = [sys.executable, "-P", str(WORKER), str(job), str(answer)]
    try:
        done = subprocess.run(
            command,
            env={**os.environ, "MUJOCO_GL": backend},
            cwd=job.parent,
            capture_output=True,
            text=True,
            errors="replace",
            timeout=PATIENCE,
            check=False,
        )
    except (OSError, subprocess.TimeoutExpired) as error:
        return str(error)
    if done.returncode == 0 and answer.is_file():
        return None
    lines = [line for line in done.stderr.splitlines() if line.strip()]
    return lines[-1].strip() if lines else f"ended with {done.returncode}"


def _row(scene: Scene, sample: int, panels: Frames) -> Image:
    """Panels side by side under their captions."""
    from PIL import Image, ImageDraw, ImageFont

    height, width = panels.shape[1:3]
    row = Image.new("RGB", (width * len(panels), height + BAR), "white")
    pen, font = ImageDraw.Draw(row), ImageFont.load_default(12)
    for k, (name, panel) in enumerate(zip(scene.poses, panels, strict=True)):
        row.paste(Image.fromarray(panel), (k * width, BAR))
        off = "" if k == 0 else f": {1e3 * scene.apart[name][sample]:.1f} mm off"
        words = f"{name} at {scene.time[sample]:.2f} s (red beside)" if k == 0 else f"{name}{off}"
        pen.text((k * width + 6, 4), words, fill="black", font=font)
    return row


def _sheet(scene: Scene, samples: Sequence[int], frames: Frames) -> Image:
    """Rows below each other."""
    from PIL import Image

    rows = [_row(scene, i, panels) for i, panels in zip(samples, frames, strict=True)]
    sheet = Image.new("RGB", (rows[0].width, sum(r.height for r in rows)), "white")
    for k, row in enumerate(rows):
        sheet.paste(row, (0, k * row.height))
    return sheet


def _png(image: Image) -> bytes:
    buffer = BytesIO()
    image.save(buffer, format="PNG", optimize=True)
    return buffer.getvalue()


def _gif(images: Sequence[Image]) -> bytes:
    buffer = BytesIO()
    first, *others = (image.quantize(64) for image in images)
    first.save(buffer, format="GIF", save_all=True, append_images=others, duration=round(1000 / RATE), loop=0)
    return buffer.getvalue()
