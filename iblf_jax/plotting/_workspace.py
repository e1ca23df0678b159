"""Draws paths of an arm's points in the workspace, with the boundaries of the scenario's regions.

In the plane, the area outside of any region is shaded.  In space, half-spaces are drawn as planes
and spheres as nets; regions of other classes are not drawn.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from mpl_toolkits.mplot3d.art3d import Poly3DCollection

from iblf_jax.core import checks
from iblf_jax.core.families import is_default
from iblf_jax.plotting import _style
from iblf_jax.plotting._curves import Curve, curves_of, escaped
from iblf_jax.plotting._figures import Runs
from iblf_jax.plotting._panels import run_style
from iblf_jax.world.plants import Plant
from iblf_jax.world.regions import HalfSpace, Region, Sphere, in_words, row_of
from iblf_jax.world.robots import Robot

GRID = 301
"""Points per side of the grid on which a boundary in the plane is computed."""
SPHERE_CIRCLES = (13, 25)
"""Circles of latitude and of longitude of a sphere."""
PATH_POINTS = 400
OUTLINES = 9
"""Number of times at which the outline of a plant is drawn along its path."""
LINES = ("-", "--", ":", "-.")
"""Line styles of the boundaries, one per confined point."""


def has_outline(plant: Plant) -> bool:
    """Whether a plant is drawn by its outline in the plane."""
    return not is_default(plant.outline, Plant.outline)


def skeletons(plant: Plant, q: np.ndarray) -> np.ndarray:
    """Base, joints and tip at the positions q of a run, (T, n + 1, d) [m]; of a plant with an
    outline its corners, (T, k + 1, 2) [m], of which the first one is repeated at the end.

    Args:
      plant: one that contains a robot, or has an outline.
      q: positions, the first level, (T, n).

    Raises:
      ValueError: a plant without a shape, or a robot whose `skeleton` does not return (n + 1, 2) or
        (n + 1, 3) points.
    """
    if has_outline(plant):
        corners = np.asarray(jax.jit(jax.vmap(plant.outline))(q))
        return np.concatenate([corners, corners[:, :1]], axis=1)
    robot = plant.robot
    points = None if robot is None else jax.jit(jax.vmap(robot.skeleton))(q)
    if points is None:
        remedy = "A robot has a skeleton(q); another plant may have an outline(x1), (k, 2) [m]."
        kind = type(plant if robot is None else robot).__name__
        raise checks.fail("plant", kind, "a plant with a shape", remedy)
    found = np.asarray(points)
    if found.shape[1:] not in ((q.shape[1] + 1, 2), (q.shape[1] + 1, 3)):
        expected = "n + 1 points in the plane or in space, the same for all runs"
        raise checks.fail("plant.skeleton(q)", found.shape[1:], expected)
    return found


def set_limits(axes: Axes, points: np.ndarray, regions: Sequence[Region]) -> np.ndarray:
    """Sets the limits of a panel so that it shows all points and all spheres to stay out of.

    Args:
      axes: the panel.
      points: (..., d) [m].
      regions: the regions of the scenario.

    Returns:
      The limits, (d, 2) [m].
    """
    points = points.reshape(-1, points.shape[-1])
    points = points[np.isfinite(points).all(axis=1)]
    for region in regions:
        if isinstance(region, Sphere) and region.keep == "outside":
            ends = region.centre + region.radius * np.array([[1.0], [-1.0]])
            points = np.concatenate([points, ends])
    low, high = points.min(axis=0), points.max(axis=0)
    size = max(float(np.max(high - low)), 1e-3)
    is_plane = len(low) == 2
    room = 0.08 * size
    if not is_plane:  # In space the limits form a cube.
        room = 0.55 * size - 0.5 * (high - low)
    limits = np.stack([low - room, high + room], axis=1)
    for name, ends in zip("xyz", limits, strict=False):
        axes.set(**{f"{name}lim": tuple(ends), f"{name}label": _style.label(f"${name}$", "m")})
    axes.set_aspect("equal")
    axes.locator_params(nbins=6 if is_plane else 4)
    return limits


def draw_boundaries(axes: Any, robot: Robot, regions: Sequence[Region], limits: np.ndarray) -> None:
    """Draws the boundaries of all regions within the limits (d, 2) of a panel [m].

    Boundaries for the same point of the robot have the same line style and one entry in the legend.
    """
    first: dict[int, Region] = {}
    for region in regions:
        first.setdefault(row_of(robot, region.point), region)
    draw_one = _draw_in_plane if len(limits) == 2 else _draw_in_space
    for index, (row, first_region) in enumerate(first.items()):
        style = {"color": _style.failure(), "linestyle": LINES[index % len(LINES)]}
        for region in regions:
            if row_of(robot, region.point) == row:
                draw_one(axes, region, limits, style)
        nowhere: list[list[float]] = [[]] * len(limits)
        label = escaped(f"bound of {in_words(first_region, robot)}")
        axes.plot(*nowhere, **style, linewidth=1.2, label=label)


def _draw_in_plane(axes: Any, region: Region, limits: np.ndarray, style: dict[str, Any]) -> None:
    x, y = (np.linspace(low, high, GRID) for low, high in limits)
    points = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    distance = np.asarray(jax.jit(jax.vmap(region.distance))(points)).reshape(GRID, GRID)
    if not distance.min() < 0.0 < distance.max():
        return
    outside = [distance.min(), 0.0]
    axes.contourf(x, y, distance, levels=outside, colors=[_style.forbidden()], zorder=0)
    line = {"colors": [style["color"]], "linestyles": [style["linestyle"]], "linewidths": 1.2}
    axes.contour(x, y, distance, levels=[0.0], zorder=1, **line)


def _draw_in_space(axes: Any, region: Region, limits: np.ndarray, style: dict[str, Any]) -> None:
    if isinstance(region, HalfSpace):
        corners = _plane_in_box(np.asarray(region.normal), float(region.offset), limits)
        if len(corners):
            edge = {"edgecolor": style["color"], "linestyle": style["linestyle"]}
            polygon = Poly3DCollection([corners], facecolor=style["color"], alpha=0.13, **edge)
            axes.add_collection3d(polygon)
    elif isinstance(region, Sphere):
        theta, phi = np.meshgrid(
            np.linspace(0.0, np.pi, SPHERE_CIRCLES[0]),
            np.linspace(0.0, 2 * np.pi, SPHERE_CIRCLES[1]),
            indexing="ij",
        )
        unit = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)])
        points = np.asarray(region.centre)[:, None, None] + float(region.radius) * unit
        inside = np.all((points >= limits[:, :1, None]) & (points <= limits[:, 1:, None]), axis=0)
        visible = np.where(inside, points, np.nan)
        for circle in (*visible.transpose(1, 0, 2), *visible.transpose(2, 0, 1)):
            axes.plot(*circle, **style, linewidth=0.5, alpha=0.6, label="_")


def _plane_in_box(normal: np.ndarray, offset: float, limits: np.ndarray) -> np.ndarray:
    """Corners of the polygon in which the plane n . x = offset intersects a box.

    Returns:
      (k, 3) [m], in order; (0, 3) if they do not intersect.
    """
    n = normal / np.linalg.norm(normal)
    corners = np.array(np.meshgrid(*limits, indexing="ij")).reshape(3, -1).T
    side = corners @ n - offset
    found = []
    for i, j in itertools.combinations(range(8), 2):
        is_edge = np.sum(corners[i] != corners[j]) == 1
        if is_edge and side[i] * side[j] < 0:
            share = side[i] / (side[i] - side[j])
            found.append(corners[i] + share * (corners[j] - corners[i]))
    if not found:
        return np.zeros((0, 3))
    from_centre = np.array(found) - np.mean(found, axis=0)
    first = from_centre[0] / np.linalg.norm(from_centre[0])
    second = np.cross(n, first)
    angles = np.arctan2(from_centre @ second, from_centre @ first)
    return np.array(found)[np.argsort(angles)]


@_style.figure_function
def workspace(runs: Runs) -> Figure:
    """The paths of the tip and of other confined points [m], the boundaries of the regions, and the
    arm at the end of the run; of a plant with an outline its path, and the outline at some times.

    Args:
      runs: one run, or a dict of runs by name; boundaries and reference are those of the first.

    Returns:
      The figure.

    Raises:
      ValueError: no run, a batch, a plant without a shape, or robots in the plane and in space
        together.
    """
    curves = curves_of(runs)

    def add_panel(projection: str) -> Axes:
        return _style.panels(4.9, 4.9, projection=projection)[1][0]

    figure = draw_paths(add_panel, curves).figure
    _style.set_title(figure, "Paths and boundaries", curves)
    _style.legend_below(figure, 3)
    return figure


def draw_paths(add_panel: Callable[..., Any], curves: Sequence[Curve]) -> Any:
    """Draws the paths of the runs and the boundaries of the first run.

    Args:
      add_panel: adds a panel with a projection.
      curves: the runs.

    Returns:
      The panel.
    """
    first = curves[0]
    plant = first.run.scenario.loop.plant
    robot: Any = plant.robot  # regions need one
    regions = first.run.scenario.regions
    actual = [
        skeletons(curve.run.scenario.loop.plant, curve.at("q", _times(curve))) for curve in curves
    ]
    desired = skeletons(plant, first.at("q_d", _times(first)))
    d = desired.shape[-1]
    if any(x.shape[-1] != d for x in actual):
        came = "arms in the plane and in space"
        raise checks.fail("runs", came, "arms of one kind", "Draw them one by one.")
    axes = add_panel(projection="3d" if d == 3 else "rectilinear")
    points = np.concatenate([x.reshape(-1, d) for x in (desired, *actual)])
    limits = set_limits(axes, points, regions)
    draw_boundaries(axes, robot, regions, limits)
    axes.plot(*desired[:, -1].T, **_style.reference(), label="reference")
    confined = {row_of(robot, region.point) for region in regions}
    arm: dict[str, Any] = {"linewidth": 2.4, "marker": "o", "markersize": 4, "label": "_"}
    for i, (curve, skeleton) in enumerate(zip(curves, actual, strict=True)):
        style = run_style(curves, i)
        pale = _style.blend(0.45, style["color"])
        for row in sorted(confined - {len(skeleton[0]) - 1}):
            axes.plot(*skeleton[:, row].T, **(style | {"label": "_", "linewidth": 0.9}))
        name = "path" if has_outline(plant) else "tip"
        axes.plot(*skeleton[:, -1].T, **(style | {"label": curve.name or name, "linewidth": 1.6}))
        if has_outline(plant):
            for index in np.linspace(0, len(skeleton) - 1, OUTLINES).astype(int):
                axes.plot(*skeleton[index].T, color=pale, linewidth=1.0, label="_")
        else:
            axes.plot(*skeleton[-1].T, color=pale, **arm)
    return axes


def _times(curve: Curve) -> np.ndarray:
    """Times of the points of a path, (PATH_POINTS,) [s]."""
    end = curve.t[: curve.samples][-1]
    return np.linspace(0.0, end, PATH_POINTS)
