"""Writes animations of an arm, with joint limits, reference and path of the tip, as a GIF or as a
web page with controls.

The static parts are drawn once, and each frame draws only the parts that move, so that an animation
of a 20 s run takes seconds.  A run longer than `LONGEST_FILM` plays faster than real time by
default.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.animation import FuncAnimation
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image

from iblf_jax.core import checks
from iblf_jax.plotting import _style
from iblf_jax.plotting._arm import Scene, motions_of
from iblf_jax.plotting._curves import curves_of
from iblf_jax.plotting._figures import Runs

MAX_FPS, MAX_FRAMES = 50.0, 10_000
LONGEST_FILM = 10.0
"""Longest duration of an animation at the default speed [s]."""

DPI = 90


def animate(
    runs: Runs,
    path: str | Path,
    fps: float = 25.0,
    *,
    speed: float | None = None,
    note: str = "",
) -> Path:
    """Writes the motion of the arm, with its joint limits, as a GIF or an HTML page.

    Each run is one arm; limits and reference are those of the first run.

    Args:
      runs: one run, or a dict of runs by name.
      path: the file; its ending, ".gif" or ".html", determines the format.
      fps: frames per second of the animation, up to 50.
      speed: speed relative to the run; if not given 1, or more for runs longer than 10 s.
      note: a sentence for the title.

    Returns:
      The path of the file.

    Raises:
      ValueError: another ending, no run, a batch, robots in the plane and in space together, or fps
        or speed out of range.
    """
    curves = curves_of(runs)
    path = film_path(path)
    fps = checks.positive_number("fps", fps, "1/s")
    if fps > MAX_FPS:
        raise checks.fail("fps", fps, f"at most {MAX_FPS:g} frames a second")
    t = frame_times(max(float(np.asarray(curve.run.t)[-1]) for curve in curves), fps, speed)
    with _style.styled():
        return write_film(list(_pictures(Scene(curves, *motions_of(curves, t), note))), path, fps)


def film_path(path: str | Path, field: str = "path") -> Path:
    """The validated path of a film; `field` is the caller's name of the argument."""
    path = checks.file_path(field, path)
    if path.is_dir():
        raise checks.fail(field, str(path), "the path of a file", "It is a folder.")
    if path.suffix.lower() not in WRITERS:
        raise checks.fail(field, str(path), f"a file ending of {' or '.join(WRITERS)}")
    return path


def write_film(pictures: list[Image.Image], path: Path, fps: float) -> Path:
    """Writes pictures of equal size as a film; returns its path."""
    path.parent.mkdir(parents=True, exist_ok=True)
    # One palette for all: 96 colours of the last picture, in which every colour occurs.
    palette = pictures[-1].quantize(96, method=Image.Quantize.MAXCOVERAGE)
    few = [picture.quantize(palette=palette, dither=Image.Dither.NONE) for picture in pictures]
    WRITERS[path.suffix.lower()](few, path, fps)
    return path


def frame_times(end: float, fps: float, speed: float | None = None) -> np.ndarray:
    """The times of the frames of a run from 0 to `end` [s], (F,) [s]."""
    if speed is None:
        speed = max(1.0, end / LONGEST_FILM)
    speed = checks.positive_number("speed", speed, "1")
    frames = end / speed * fps
    if not frames <= MAX_FRAMES:
        expected = f"a speed at which the animation has at most {MAX_FRAMES} frames"
        remedy = f"It would have {frames:.3g}; raise the speed or lower fps."
        raise checks.fail("speed", speed, expected, remedy)
    return np.linspace(0.0, end, max(2, round(frames) + 1))


def _pictures(scene: Scene) -> Iterator[Image.Image]:
    """Every frame in turn as an RGB picture: the moving parts drawn over the static ones."""
    canvas = FigureCanvasAgg(scene.figure)
    scene.figure.set_dpi(DPI)
    scene.move_to(0)
    canvas.draw()
    scene.figure.set_layout_engine("none")
    background = canvas.copy_from_bbox(scene.figure.bbox)
    for frame in range(len(scene.target.t)):
        canvas.restore_region(background)
        for axes, part in scene.move_to(frame):
            axes.draw_artist(part)
        yield Image.fromarray(np.asarray(canvas.buffer_rgba())[..., :3].copy())


def _write_gif(pictures: list[Image.Image], path: Path, fps: float) -> None:
    """Writes a GIF that repeats."""
    first, *rest = pictures
    first.save(
        path, save_all=True, append_images=rest, duration=round(1000 / fps), loop=0, optimize=False
    )


class _Screen(Figure):
    """Presents pictures to `FuncAnimation`, which saves figures."""

    picture: Image.Image

    def show_picture(self, picture: Image.Image) -> tuple[()]:
        """Sets the picture to save next."""
        self.picture = picture
        return ()

    def savefig(self, fname: Any, **kwargs: Any) -> None:
        """Saves the current picture."""
        self.picture.save(fname, format="png")


def _write_html(pictures: list[Image.Image], path: Path, fps: float) -> None:
    """Writes a page that contains the frames and matplotlib's controls to play them."""
    screen = _Screen()
    screen.show_picture(pictures[0])
    with matplotlib.rc_context({"animation.embed_limit": 1000.0, "animation.frame_format": "png"}):
        player = FuncAnimation(screen, screen.show_picture, frames=pictures, cache_frame_data=False)
        path.write_text(player.to_jshtml(fps=max(1, round(fps))), encoding="utf-8")


WRITERS: dict[str, Any] = {".gif": _write_gif, ".html": _write_html}
"""Ending of a film's path -> the function that writes it."""
