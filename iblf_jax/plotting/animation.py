"""The arm in motion, as a GIF or as a web page with controls: its joint limits, its reference as a
ghost, its tip's path.

What stands still is drawn once; each frame moves and draws only what moves, which makes 20 s of
motion a matter of seconds. A run longer than `LONGEST_FILM` plays faster than it was, unless the
caller names a speed.
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

MOST_FPS, MOST_FRAMES = 50.0, 10_000
LONGEST_FILM = 10.0
"""How long an animation lasts at most if its speed is not given [s]."""

DPI = 90


def animate(runs: Runs, path: str | Path, fps: float = 25.0, *, speed: float | None = None) -> Path:
    """Writes the motion of the arm, with its joint limits, as a GIF or an HTML page.

    Limits, reference and its ghost are those of the first run; every run is an arm of its own.

    Args:
      runs: one run, or a dict of runs by name.
      path: where to; its ending, ".gif" or ".html", decides.
      fps: frames a second of the animation, up to 50.
      speed: how many times faster than the run it plays; 1 if not given, more for runs longer than
        10 s.

    Returns:
      The path of the file.

    Raises:
      ValueError: another ending, no run, a batch, robots that do not fit together, or fps or speed
        out of range.
    """
    curves, path = curves_of(runs), film_path(path)
    fps = checks.positive_number("fps", fps, "1/s")
    if fps > MOST_FPS:
        raise checks.fail("fps", fps, f"at most {MOST_FPS:g} frames a second")
    t = frame_times(max(float(np.asarray(curve.run.t)[-1]) for curve in curves), fps, speed)
    with _style.styled():
        return write_film(list(_pictures(Scene(curves, *motions_of(curves, t)))), path, fps)


def film_path(path: str | Path, field: str = "path") -> Path:
    """The path of a film, checked; `field` is what the caller calls it."""
    path = checks.file_path(field, path)
    if path.is_dir():
        raise checks.fail(field, str(path), "the path of a file", "It is a folder.")
    if path.suffix.lower() not in WRITERS:
        raise checks.fail(field, str(path), f"a file ending of {' or '.join(WRITERS)}")
    return path


def write_film(pictures: list[Image.Image], path: Path, fps: float) -> Path:
    """Writes pictures of one size as a film; returns its path."""
    path.parent.mkdir(parents=True, exist_ok=True)
    WRITERS[path.suffix.lower()](_with_one_palette(pictures), path, fps)
    return path


def frame_times(end: float, fps: float, speed: float | None = None) -> np.ndarray:
    """The times of the frames of a run that ends then [s], from 0 on, (F,) [s]."""
    speed = (
        max(1.0, end / LONGEST_FILM)
        if speed is None
        else checks.positive_number("speed", speed, "1")
    )
    frames = end / speed * fps
    if not frames <= MOST_FRAMES:
        raise checks.fail(
            "speed",
            speed,
            f"one at which the run has at most {MOST_FRAMES} frames",
            f"It would have {frames:.3g}.",
        )
    return np.linspace(0.0, end, max(2, round(frames) + 1))


def _pictures(scene: Scene) -> Iterator[Image.Image]:
    """Every frame in turn as an RGB picture: the parts that move, drawn over those that do not."""
    canvas = FigureCanvasAgg(scene.figure)
    scene.figure.set_dpi(DPI)
    scene.move_to(0)
    canvas.draw()
    scene.figure.set_layout_engine("none")
    background = canvas.copy_from_bbox(scene.figure.bbox)
    for frame in range(len(scene.world.t)):
        canvas.restore_region(background)
        for axes, part in scene.move_to(frame):
            axes.draw_artist(part)
        yield Image.fromarray(np.asarray(canvas.buffer_rgba())[..., :3].copy())


def _with_one_palette(pictures: list[Image.Image]) -> list[Image.Image]:
    """The pictures in 96 colours, the same for all, taken from the last one, in which every colour
    occurs.
    """
    palette = pictures[-1].quantize(96, method=Image.Quantize.MAXCOVERAGE)
    return [picture.quantize(palette=palette, dither=Image.Dither.NONE) for picture in pictures]


def _write_gif(pictures: list[Image.Image], path: Path, fps: float) -> None:
    """Writes a GIF that repeats."""
    first, *rest = pictures
    first.save(
        path, save_all=True, append_images=rest, duration=round(1000 / fps), loop=0, optimize=False
    )


class _Screen(Figure):
    """A figure that saves the picture it was given, for a player that wants figures."""

    picture: Image.Image

    def show_picture(self, picture: Image.Image) -> tuple[()]:
        """Takes the picture to save next."""
        self.picture = picture
        return ()

    def savefig(self, fname: Any, **kwargs: Any) -> None:
        """Saves the picture."""
        self.picture.save(fname, format="png")


def _write_html(pictures: list[Image.Image], path: Path, fps: float) -> None:
    """Writes a page that holds its frames and matplotlib's controls to play them."""
    screen = _Screen()
    screen.show_picture(pictures[0])
    with matplotlib.rc_context({"animation.embed_limit": 1000.0, "animation.frame_format": "png"}):
        player = FuncAnimation(screen, screen.show_picture, frames=pictures, cache_frame_data=False)
        path.write_text(player.to_jshtml(fps=max(1, round(fps))), encoding="utf-8")


WRITERS: dict[str, Any] = {".gif": _write_gif, ".html": _write_html}
"""Ending of a film's path -> what writes it."""
