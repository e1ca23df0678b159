"""The scene of an animation: arms, reference, joint limits and joint bars, as artists that are
moved from frame to frame.

The limits of a joint are drawn as a fan: the directions of the joint's link for all positions
between the lower and the upper bound.  They are computed with the robot's own `skeleton` and are
therefore correct for planar and spatial robots.  The bars beside the arm show the positions and
bounds of all joints, including joints whose fan has no width (a wrist that rolls).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.artist import Artist

from iblf_jax.core import checks
from iblf_jax.plotting import _style
from iblf_jax.plotting._curves import Curve, joint_labels
from iblf_jax.plotting._panels import quantity_of
from iblf_jax.plotting._workspace import draw_boundaries, has_outline, set_limits, skeletons
from iblf_jax.world import plants

FAN_POINTS = 13
FAN_RADIUS = 0.42
"""Radius of a fan as a share of its link's length."""


@dataclass(frozen=True, eq=False)
class Motion:
    """One run at the times of the F frames, for a robot in d = 2 or 3 dimensions."""

    q: np.ndarray
    """(F, n) [rad]."""
    skeleton: np.ndarray
    """(F, n + 1, d) [m], or the closed outline of another plant, (F, k + 1, 2) [m]."""
    motors: np.ndarray | None = None
    """Positions of the motors of flexible joints, (F, n) [rad]; None for other plants."""


@dataclass(frozen=True, eq=False)
class ReferenceMotion:
    """Reference and bounds of the first run at the times of the frames."""

    t: np.ndarray
    """(F,) [s]."""
    q_d: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    desired: np.ndarray
    """Skeleton of the reference, (F, n + 1, d) [m]."""
    fans: np.ndarray
    """Outline of each joint's fan, (F, n, FAN_POINTS + 2, d) [m]; (F, 0) for a plant that is drawn
    by its outline."""


def _fans(robot: Any, q: jax.Array, lower: jax.Array, upper: jax.Array) -> jax.Array:
    """Outline of every joint's fan for one configuration, (n, FAN_POINTS + 2, d) [m]."""

    def rim(joint: jax.Array, low: jax.Array, high: jax.Array) -> jax.Array:
        """The link behind a joint, (FAN_POINTS, d), while the joint turns between its bounds."""
        angles = low + jnp.linspace(0.0, 1.0, FAN_POINTS) * (high - low)
        moved = jax.vmap(lambda angle: robot.skeleton(q.at[joint].set(angle)))(angles)
        return moved[:, joint + 1] - moved[:, joint]

    links = jax.vmap(rim)(jnp.arange(q.shape[0]), lower, upper)
    centre = robot.skeleton(q)[:-1, None]
    return jnp.concatenate([centre, centre + FAN_RADIUS * links, centre], axis=1)


def motions_of(curves: Sequence[Curve], t: np.ndarray) -> tuple[ReferenceMotion, list[Motion]]:
    """The runs at the times t [s] of the frames, (F,).

    Raises:
      ValueError: a robot whose `skeleton` does not return (n + 1, 2) or (n + 1, 3) points, or runs
        whose points differ in shape.
    """
    first = curves[0]
    motions: list[Motion] = []
    for curve in curves:
        q = curve.at("q", t)
        plant = curve.run.scenario.loop.plant
        motors = None
        if isinstance(plant, plants.FlexibleJoint):
            motors = curve.at("level_3", t)
        motions.append(Motion(q, skeletons(plant, q), motors))
        shape = motions[-1].skeleton.shape[1:]
        if shape != motions[0].skeleton.shape[1:]:
            expected = "points in the plane or in space, the same for all runs"
            raise checks.fail("plant.skeleton(q)", shape, expected)
    plant = first.run.scenario.loop.plant
    q_d, lower, upper = (first.at(field, t) for field in ("q_d", "lower", "upper"))
    desired = skeletons(plant, q_d)
    if has_outline(plant):
        return ReferenceMotion(t, q_d, lower, upper, desired, np.zeros((len(t), 0))), motions
    fans = jax.jit(jax.vmap(lambda *args: _fans(plant.robot, *args)))(motions[0].q, lower, upper)
    return ReferenceMotion(t, q_d, lower, upper, desired, np.asarray(fans)), motions


def _set_points(line: Any, points: np.ndarray) -> None:
    """Moves a line to points (k, d)."""
    if points.shape[-1] == 3:
        line.set_data_3d(*points.T)
    else:
        line.set_data(*points.T)


class Scene:
    """The figure of an animation; `move_to(frame)` moves its parts to their places."""

    def __init__(
        self,
        curves: Sequence[Curve],
        target: ReferenceMotion,
        motions: Sequence[Motion],
        note: str = "",
    ) -> None:
        self.target = target
        self.motions = motions
        self.figure = _style.new_figure(6.4, 3.8)
        grid = self.figure.add_gridspec(1, 2, width_ratios=(1.7, 1))
        self.dimensions = target.desired.shape[-1]
        projection = "3d" if self.dimensions == 3 else None
        self.arm: Any = self.figure.add_subplot(grid[0], projection=projection)
        self.bars: Any = self.figure.add_subplot(grid[1])
        self.parts: list[tuple[Any, Artist]] = []

        self.dots: list[Any] = []
        self.motors: dict[int, Any] = {}
        points = np.concatenate([target.desired, *(motion.skeleton for motion in motions)])
        scenario = curves[0].run.scenario
        limits = set_limits(self.arm, points, scenario.regions)
        plant = scenario.loop.plant
        if plant.robot is not None:
            draw_boundaries(self.arm, plant.robot, scenario.regions, limits)
        self._add_fans()
        self._add_arms(curves)
        self._add_bars(curves)
        self.time = self._animated(self.bars.text(0.0, 1.03, "t = ", transform=self.bars.transAxes))
        title = "The arm within its joint limits"
        if has_outline(plant):
            title = "The plant and its reference"
        notes = [note] if note else []
        _style.set_title(self.figure, title, curves, notes=notes)
        _style.legend_below(self.figure, 4)

    def _animated(self, artist: Any) -> Any:
        artist.set_animated(True)
        self.parts.append((artist.axes, artist))
        return artist

    def _line(self, axes: Any, **options: Any) -> Any:
        """An animated line without points."""
        dimensions = self.dimensions if axes is self.arm else 2
        return self._animated(axes.plot(*([[]] * dimensions), **options)[0])

    def _add_fans(self) -> None:
        """Adds the animated fans: areas in the plane, outlines in space."""
        edge, face = _style.bound(), _style.blend(0.11, _style.colour(0))
        self.fans = []
        for _ in range(self.target.fans.shape[1]):
            if self.dimensions == 3:
                self.fans.append(self._line(self.arm, color=edge, linewidth=0.8))
                continue
            (area,) = self.arm.fill([0.0], [0.0], edgecolor=edge, facecolor=face, linewidth=0.7)
            self.fans.append(self._animated(area))
        if self.fans:
            self.fans[0].set_label("joint limits")

    def _add_arms(self, curves: Sequence[Curve]) -> None:
        path = {"linewidth": 0.8, "color": _style.blend(0.533)}
        self.arm.plot(*self.target.desired[:, -1].T, **(_style.reference() | path))
        style: dict[str, Any] = {"linewidth": 1.6, "marker": "o", "markersize": 4}
        style |= {"color": _style.blend(0.4), "markerfacecolor": _style.background()}
        self.reference = self._line(self.arm, label="reference", **style)
        self.trails = [
            self._line(self.arm, color=_style.colour(i), linewidth=0.9) for i in range(len(curves))
        ]
        style = {"linewidth": 2.6, "marker": "o", "markersize": 5}
        name = "arm"
        if has_outline(curves[0].run.scenario.loop.plant):
            name, style["marker"] = "plant", ""
        self.arms = [
            self._line(self.arm, label=curve.name or name, **style, **_style.series(i))
            for i, curve in enumerate(curves)
        ]

    def _add_bars(self, curves: Sequence[Curve]) -> None:
        rows = np.arange(self.target.q_d.shape[1])
        shown = np.stack([self.target.lower, self.target.upper, self.target.q_d])
        shown = shown[np.isfinite(shown)]
        room = 0.15 * float(np.ptp(shown))
        self.bars.set(
            xlim=(shown.min() - room, shown.max() + room),
            ylim=(len(rows) - 0.4, -0.6),
            xlabel=quantity_of(curves[0].run.scenario, "q").label,
        )
        self.bars.set_yticks(rows, joint_labels(curves[0].run.scenario.plant))
        self.bars.spines["left"].set_visible(False)
        self.bars.tick_params(axis="y", length=0)
        width = max(4.0, min(18.0, 90.0 / len(rows)))
        self.ranges = [
            self._line(self.bars, color=_style.blend(0.149), linewidth=width, solid_capstyle="butt")
            for _ in rows
        ]
        style: dict[str, Any] = {"linestyle": "none", "marker": "|", "markersize": width + 3}
        style |= {"color": _style.text_colour(), "markeredgewidth": 1.6}
        self.desired = self._line(self.bars, **style)
        for i, curve in enumerate(curves):
            style = {"linestyle": "none", "marker": "oDs^v"[i % 5], "color": _style.colour(i)}
            style["markersize"] = max(3.0, min(5.5, width / len(curves)))
            self.dots.append(self._line(self.bars, **style))
            if self.motions[i].motors is not None:
                hollow = style | {"markerfacecolor": "none", "markersize": style["markersize"] + 4}
                label = f"{curve.name} motor".strip()
                self.motors[i] = self._line(self.bars, label=label, **hollow)

    def move_to(self, frame: int) -> list[tuple[Any, Artist]]:
        """Moves every part to its place in a frame; returns (axes, part) in the order of
        drawing.
        """
        target = self.target
        rows = np.arange(target.q_d.shape[1])
        for joint, fan in enumerate(self.fans):
            outline = target.fans[frame, joint]
            if self.dimensions == 2:
                fan.set_xy(outline)
            else:
                _set_points(fan, outline)
        for joint in range(len(rows)):
            ends = [target.lower[frame, joint], target.upper[frame, joint]]
            self.ranges[joint].set_data(ends, [joint, joint])
        _set_points(self.reference, target.desired[frame])
        self.desired.set_data(target.q_d[frame], rows)
        middle = 0.5 * (len(self.motions) - 1)
        for i, motion in enumerate(self.motions):
            _set_points(self.arms[i], motion.skeleton[frame])
            _set_points(self.trails[i], motion.skeleton[: frame + 1, -1])
            q = np.clip(motion.q[frame], *self.bars.get_xlim())
            heights = rows + 0.14 * (i - middle)
            self.dots[i].set_data(q, heights)
            if motion.motors is not None:
                motors = np.clip(motion.motors[frame], *self.bars.get_xlim())
                self.motors[i].set_data(motors, heights)
        self.time.set_text(f"t = {target.t[frame]:.2f} s")
        return self.parts
