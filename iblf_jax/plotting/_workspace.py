"""The space in which the arm moves: the paths of its points, and the walls of the regions in which
these must stay.

In the plane what is beyond a wall is shaded, whatever the region; in space half-spaces are drawn as
planes and spheres as nets, and regions of other classes are not drawn.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax
import numpy as np
from matplotlib.figure import Figure
from matplotlib.gridspec import SubplotSpec
from mpl_toolkits.mplot3d.art3d import Poly3DCollection

from iblf_jax.core import checks
from iblf_jax.plotting import _style
from iblf_jax.plotting._curves import Curve, curves_of, plain
from iblf_jax.plotting._figures import Runs
from iblf_jax.world.regions import HalfSpace, Region, Sphere, in_words, row_of

GRID = 301
"""Points on a side of the grid on which a wall in the plane is sought."""
NET = (13, 25)
"""Circles of latitude and of longitude of a sphere."""
PATH_POINTS = 400
LINES = ("-", "--", ":", "-.")
"""Of the walls, point by point."""


def skeletons(robot: Any, q: np.ndarray) -> np.ndarray:
    """Base, joints and tip at every q of a run (T, n), (T, n + 1, d) [m].

    Raises:
      ValueError: a robot whose `skeleton` does not give (n + 1, 2) or (n + 1, 3) points.
    """
    found = np.asarray(jax.jit(jax.vmap(robot.skeleton))(q))
    if found.shape[1:] not in ((q.shape[1] + 1, 2), (q.shape[1] + 1, 3)):
        raise checks.fail(
            "plant.skeleton(q)",
            found.shape[1:],
            "n + 1 points in the plane or in space, alike for all runs",
        )
    return found


def frame(axes: Any, points: np.ndarray, regions: Sequence[Region]) -> np.ndarray:
    """Limits of a drawing that shows all points (..., d) [m], and spheres that are to be kept out
    of; returns them, (d, 2).
    """
    points = points.reshape(-1, points.shape[-1])
    points = points[np.isfinite(points).all(axis=1)]
    for region in regions:
        if isinstance(region, Sphere) and region.keep == "outside":
            points = np.concatenate(
                [points, region.centre + region.radius * np.array([[1.0], [-1.0]])]
            )
    low, high = points.min(axis=0), points.max(axis=0)
    size = max(float(np.max(high - low)), 1e-3)
    room = (
        np.full_like(low, 0.08 * size) if len(low) == 2 else 0.55 * size - 0.5 * (high - low)
    )  # a cube, in space
    limits = np.stack([low - room, high + room], axis=1)
    for name, ends in zip("xyz", limits, strict=False):
        axes.set(**{f"{name}lim": tuple(ends), f"{name}label": _style.label(f"${name}$", "m")})
    axes.set_aspect("equal")
    axes.locator_params(nbins=6 if len(low) == 2 else 4)
    return limits


def draw_walls(axes: Any, robot: Any, regions: Sequence[Region], limits: np.ndarray) -> None:
    """Draws the walls of all regions within the limits (d, 2) of a drawing [m], one kind of line a
    point.
    """
    rows = list(dict.fromkeys(row_of(robot, region.point) for region in regions))
    named = set()
    for region in regions:
        row = row_of(robot, region.point)
        look = {"color": _style.alarm(), "linestyle": LINES[rows.index(row) % len(LINES)]}
        (_in_the_plane if len(limits) == 2 else _in_space)(axes, region, limits, look)
        if row not in named:
            axes.plot(
                *([[]] * len(limits)),
                **look,
                linewidth=1.2,
                label=plain(f"wall of {in_words(region, robot)}"),
            )
        named.add(row)


def _in_the_plane(axes: Any, region: Region, limits: np.ndarray, look: dict[str, Any]) -> None:
    x, y = (np.linspace(low, high, GRID) for low, high in limits)
    at = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    distance = np.asarray(jax.jit(jax.vmap(region.distance))(at)).reshape(GRID, GRID)
    if distance.min() < 0.0 < distance.max():
        axes.contourf(
            x,
            y,
            distance,
            levels=[distance.min(), 0.0],
            colors=[_style.shade(0.12, _style.alarm())],
            zorder=0,
        )
        axes.contour(
            x,
            y,
            distance,
            levels=[0.0],
            colors=[look["color"]],
            linestyles=[look["linestyle"]],
            linewidths=1.2,
            zorder=1,
        )


def _in_space(axes: Any, region: Region, limits: np.ndarray, look: dict[str, Any]) -> None:
    if isinstance(region, HalfSpace):
        corners = _cut(np.asarray(region.normal), float(region.offset), limits)
        if len(corners):
            pale = {
                "facecolor": look["color"],
                "alpha": 0.13,
                "edgecolor": look["color"],
                "linestyle": look["linestyle"],
            }
            axes.add_collection3d(Poly3DCollection([corners], **pale))
    elif isinstance(region, Sphere):
        theta, phi = np.meshgrid(
            np.linspace(0.0, np.pi, NET[0]), np.linspace(0.0, 2 * np.pi, NET[1]), indexing="ij"
        )
        unit = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)])
        points = np.asarray(region.centre)[:, None, None] + float(region.radius) * unit
        inside = np.all((points >= limits[:, :1, None]) & (points <= limits[:, 1:, None]), axis=0)
        for lines in (points, points.transpose(0, 2, 1)):
            seen = inside if lines is points else inside.T
            for i in range(lines.shape[1]):
                axes.plot(
                    *np.where(seen[i], lines[:, i], np.nan),
                    **look,
                    linewidth=0.5,
                    alpha=0.6,
                    label="_",
                )


def _cut(normal: np.ndarray, offset: float, limits: np.ndarray) -> np.ndarray:
    """The polygon that the plane n . x = offset cuts out of a box, (k, 3) [m]; none where it passes
    by.
    """
    n = normal / np.linalg.norm(normal)
    corners = np.array(np.meshgrid(*limits, indexing="ij")).reshape(3, -1).T
    side = corners @ n - offset
    # Edges of the box join corners that differ in one coordinate.
    pairs = [
        (i, j)
        for i in range(8)
        for j in range(i)
        if np.sum(corners[i] != corners[j]) == 1 and side[i] * side[j] < 0
    ]
    if not pairs:
        return np.zeros((0, 3))
    found = np.array(
        [corners[i] + side[i] / (side[i] - side[j]) * (corners[j] - corners[i]) for i, j in pairs]
    )
    away = found - found.mean(axis=0)
    across = np.cross(n, away[0])
    return found[
        np.argsort(
            np.arctan2(
                away @ across / np.linalg.norm(across), away @ away[0] / np.linalg.norm(away[0])
            )
        )
    ]


@_style.styled()
def workspace(runs: Runs) -> Figure:
    """The paths of the tip, and of what else has a wall, in the plane or in space [m], with the
    walls of the regions; the arm at the end.

    Args:
      runs: one run, or a dict of runs by name; walls and reference are the first one's.

    Returns:
      The figure.

    Raises:
      ValueError: no run, a batch, or robots that do not fit together.
    """
    curves = curves_of(runs)
    figure = _style.new_figure(4.9, 4.9)
    draw_paths(figure, figure.add_gridspec(1, 1)[0], curves)
    _style.entitle(figure, "Paths and walls", curves)
    _style.legend_below(figure, 3)
    return figure


def draw_paths(figure: Figure, where: SubplotSpec, curves: Sequence[Curve]) -> Any:
    """Draws the paths of the points of the runs, and the first one's walls; returns the panel."""
    first = curves[0]
    robot, regions = first.run.scenario.plant, first.run.scenario.regions
    moved = [skeletons(curve.run.scenario.plant, curve.at("q", _times(curve))) for curve in curves]
    wanted = skeletons(robot, first.at("q_d", _times(first)))
    if len({x.shape[-1] for x in (wanted, *moved)}) > 1:
        raise checks.fail(
            "runs", "arms in the plane and in space", "arms of one kind", "Draw them one by one."
        )
    axes: Any = figure.add_subplot(where, projection="3d" if wanted.shape[-1] == 3 else None)
    limits = frame(
        axes, np.concatenate([x.reshape(-1, x.shape[-1]) for x in (wanted, *moved)]), regions
    )
    draw_walls(axes, robot, regions, limits)
    axes.plot(*wanted[:, -1].T, **(_style.reference() | {"label": "reference"}))
    rows = sorted({row_of(robot, region.point) for region in regions} | {robot.n})
    for i, (curve, skeleton) in enumerate(zip(curves, moved, strict=True)):
        look = _style.series(i) | (_style.FAINT if curve.failed and len(curves) > 1 else {})
        for row in rows:
            label = (curve.name or "tip") if row == robot.n else "_"
            axes.plot(
                *skeleton[:, row].T,
                **(look | {"label": label, "linewidth": 1.6 if row == robot.n else 0.9}),
            )
        axes.plot(
            *skeleton[-1].T,
            color=_style.shade(0.45, look["color"]),
            linewidth=2.4,
            marker="o",
            markersize=4,
            label="_",
        )
    return axes


def _times(curve: Curve) -> np.ndarray:
    """Instants of a run that a path is drawn through, (k,) [s]."""
    end = curve.t[: curve.samples][-1]
    return np.linspace(0.0, end, PATH_POINTS)
