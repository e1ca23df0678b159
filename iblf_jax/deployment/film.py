"""The motion of a run against MuJoCo as a film: MuJoCo's own picture where it can draw one, the
arm's skeleton otherwise.
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from iblf_jax.deployment.mujoco_plant import MujocoPlant
from iblf_jax.plotting.animation import animate, frame_times, write_film
from iblf_jax.simulation.results import Rollout

FPS = 25.0
SIZE = (480, 640)
"""Height and width of a picture [pixels]: MuJoCo's own buffer of a model that says nothing else."""
SHOWN_GROUPS = 3
"""Number of the first groups of shapes, which MuJoCo draws by default."""
AMBIENT, DIFFUSE = 0.5, 0.6
"""Of the camera's lamp, at least, in a model without lights: MuJoCo's own leaves a grey arm nearly
black."""


def film_run(
    run: Rollout, robot: MujocoPlant, positions: np.ndarray, dt: float, path: Path
) -> Path:
    """Writes the film of a run.

    Args:
      run: the run.
      robot: which MuJoCo has moved.
      positions: of everything in its model, at every step.
      dt: the step [s].
      path: where to, ".gif" or ".html".
    """
    renderer = _renderer(robot)
    if renderer is None:
        return animate(run, path, FPS)
    times = frame_times((len(positions) - 1) * dt, FPS)
    with renderer:
        pictures = [
            Image.fromarray(x)
            for x in _pictures(renderer, robot, positions[np.round(times / dt).astype(int)])
        ]
    return write_film(pictures, path, FPS)


def _renderer(robot: MujocoPlant) -> Any:
    """MuJoCo's renderer; None if MuJoCo cannot draw, or if the arm has no visible shapes."""
    if not has_shapes(robot.model) or not _can_draw():
        return None
    return robot.mujoco.Renderer(robot.model, *SIZE)


def has_shapes(model: Any) -> bool:
    """Whether MuJoCo's picture of a model has something that moves: the arm of a URDF whose meshes
    are not there has no shape.
    """
    seen = (model.geom_group < SHOWN_GROUPS) & (model.geom_rgba[:, 3] > 0)
    return bool(np.any(model.body_weldid[model.geom_bodyid[seen]] > 0))


@cache
def _can_draw() -> bool:
    """Whether MuJoCo can draw on this machine, tried in a process of its own: without a display,
    the second try ends the process.
    """
    words = "import mujoco; mujoco.Renderer(mujoco.MjModel.from_xml_string('<mujoco/>')).render()"
    try:
        return (
            subprocess.run(
                [sys.executable, "-c", words], capture_output=True, timeout=60
            ).returncode
            == 0
        )
    except (OSError, subprocess.TimeoutExpired):
        return False


def _pictures(renderer: Any, robot: MujocoPlant, positions: np.ndarray) -> Iterator[np.ndarray]:
    data = robot.mujoco.MjData(robot.model)
    for place in positions:
        data.qpos[:] = place
        robot.mujoco.mj_forward(robot.model, data)
        renderer.update_scene(data)
        if not robot.model.nlight:
            lamp = renderer.scene.lights[0]
            lamp.ambient, lamp.diffuse = (
                np.maximum(lamp.ambient, AMBIENT),
                np.maximum(lamp.diffuse, DIFFUSE),
            )
        yield renderer.render().copy()
