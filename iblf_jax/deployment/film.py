"""The motion of a run against MuJoCo as a film: MuJoCo's own picture where it can draw one, the arm's skeleton otherwise."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
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


def film_run(run: Rollout, robot: MujocoPlant, positions: np.ndarray, dt: float, path: Path) -> Path:
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
        pictures = [Image.fromarray(x) for x in _pictures(renderer, robot, positions[np.round(times / dt).astype(int)])]
    return write_film(pictures, path, FPS)


def _renderer(robot: MujocoPlant) -> Any:
    """MuJoCo's renderer; None where nothing can be drawn."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            return robot.mujoco.Renderer(robot.model, *SIZE)
        except Exception:  # each graphics library has its own way to say that it is not there
            return None


def _pictures(renderer: Any, robot: MujocoPlant, positions: np.ndarray) -> Iterator[np.ndarray]:
    data = robot.mujoco.MjData(robot.model)
    for place in positions:
        data.qpos[:] = place
        robot.mujoco.mj_forward(robot.model, data)
        renderer.update_scene(data)
        yield renderer.render().copy()
