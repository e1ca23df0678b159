"""Writes the motion of a run against MuJoCo as a film: MuJoCo's own picture where it can draw one,
the arm's skeleton otherwise.
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from PIL import Image

from iblf_jax.deployment.mujoco_plant import MujocoPlant
from iblf_jax.plotting.animation import animate, frame_times, write_film
from iblf_jax.simulation.results import Rollout

if TYPE_CHECKING:
    import mujoco

FPS = 25.0
SIZE = (480, 640)
"""Height and width of a picture [pixels], which are the defaults of MuJoCo's buffer."""
SHOWN_GROUPS = 3
"""MuJoCo draws this many groups of shapes, the first ones, by default."""
AMBIENT, DIFFUSE = 0.5, 0.6
"""Smallest intensities of the camera's lamp in a model without lights.  With MuJoCo's own values a
grey arm is nearly black."""


def film_run(
    run: Rollout, robot: MujocoPlant, positions: np.ndarray, dt: float, path: Path
) -> Path:
    """Writes the film of a run.

    Args:
      run: the run.
      robot: the robot that MuJoCo moved.
      positions: positions of all joints of its model at every step.
      dt: the step [s].
      path: the file, ".gif" or ".html".
    """
    if not has_shapes(robot.model) or not _can_draw():
        return animate(run, path, FPS)
    times = frame_times((len(positions) - 1) * dt, FPS)
    shown = positions[np.round(times / dt).astype(int)]
    with robot.mujoco.Renderer(robot.model, *SIZE) as renderer:
        pictures = [Image.fromarray(x) for x in _pictures(renderer, robot, shown)]
    return write_film(pictures, path, FPS)


def has_shapes(model: mujoco.MjModel) -> bool:
    """Whether MuJoCo's picture of a model shows something that moves.  The arm of a URDF whose mesh
    files are missing has no shapes.
    """
    seen = (model.geom_group < SHOWN_GROUPS) & (model.geom_rgba[:, 3] > 0)
    return bool(np.any(model.body_weldid[model.geom_bodyid[seen]] > 0))


@cache
def _can_draw() -> bool:
    """Whether MuJoCo can draw on this machine.  A separate process tries it, because without a
    display the second attempt ends the process.
    """
    code = "import mujoco; mujoco.Renderer(mujoco.MjModel.from_xml_string('<mujoco/>')).render()"
    try:
        done = subprocess.run([sys.executable, "-c", code], capture_output=True, timeout=60)
    except (OSError, subprocess.TimeoutExpired):
        return False
    return done.returncode == 0


def _pictures(
    renderer: mujoco.Renderer, robot: MujocoPlant, positions: np.ndarray
) -> Iterator[np.ndarray]:
    data = robot.mujoco.MjData(robot.model)
    for place in positions:
        data.qpos[:] = place
        robot.mujoco.mj_forward(robot.model, data)
        renderer.update_scene(data)
        if not robot.model.nlight:
            lamp = renderer.scene.lights[0]
            lamp.ambient = np.maximum(lamp.ambient, AMBIENT)
            lamp.diffuse = np.maximum(lamp.diffuse, DIFFUSE)
        yield renderer.render().copy()
