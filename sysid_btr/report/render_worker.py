"""Draws poses of a model off-screen, in a process of its own: a missing display must not end the run.

``python render_worker.py JOB.npz FRAMES.npz`` with ``MUJOCO_GL`` set. The job holds ``model`` (path of an .mjb),
``poses`` (frames, panels, nq), ``ghost`` (frames, nq), ``camera`` (x, y, z, distance, azimuth, elevation) and
``size`` (height, width); the answer ``frames`` (frames, panels, height, width, 3). Panels after the first show
the ghost too.
"""

from __future__ import annotations

import sys
from typing import Any

import mujoco
import numpy as np

GHOST = (0.85, 0.2, 0.25, 0.35)
"""Colour and opacity of the pose that a model is compared with."""
INSIDE = 0.97
"""Its size, so that it hides in the model where the two agree."""


def draw(job: Any) -> np.ndarray[Any, Any]:
    """All frames of a job."""
    model = mujoco.MjModel.from_binary_path(str(job["model"]))
    data, other = mujoco.MjData(model), mujoco.MjData(model)
    height, width = (int(n) for n in job["size"])
    camera = mujoco.MjvCamera()
    camera.lookat[:] = job["camera"][:3]
    camera.distance, camera.azimuth, camera.elevation = (float(x) for x in job["camera"][3:])
    option, nothing = mujoco.MjvOption(), mujoco.MjvPerturb()
    poses, ghosts = job["poses"], job["ghost"]
    frames = np.empty((*poses.shape[:2], height, width, 3), dtype=np.uint8)
    with mujoco.Renderer(model, height, width) as renderer:
        for i, panels in enumerate(poses):
            other.qpos[:] = ghosts[i]
            mujoco.mj_kinematics(model, other)
            for k, pose in enumerate(panels):
                data.qpos[:] = pose
                mujoco.mj_forward(model, data)
                renderer.update_scene(data, camera, option)
                scene = renderer.scene
                if k > 0:
                    first = scene.ngeom
                    mujoco.mjv_addGeoms(model, other, option, nothing, int(mujoco.mjtCatBit.mjCAT_DYNAMIC), scene)
                    for geom in scene.geoms[first : scene.ngeom]:
                        geom.rgba[:] = GHOST
                        geom.size[:] *= INSIDE
                renderer.render(out=frames[i, k])
    return frames


if __name__ == "__main__":
    np.savez_compressed(sys.argv[2], frames=draw(np.load(sys.argv[1])))
