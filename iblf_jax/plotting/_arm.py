"""The moving parts of an animation: arms, ghost, joint limits and joint bars, as artists that are
only moved.

A joint's limits are a fan around its link: where the link's direction would be with that joint
anywhere from its lower to its upper bound, found by moving the robot's own `skeleton`, so that it
is right for any robot, planar or not.  The bars beside the arm show the same for every joint as
numbers, also for joints whose fan has no width (a wrist that rolls).
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
from iblf_jax.plotting._curves import Curve, called
from iblf_jax.plotting._workspace import draw_walls, frame, skeletons

FAN_POINTS = 13
FAN_RADIUS = 0.42
"""Radius of a fan as a part of its link's length."""


@dataclass(frozen=True, eq=False)
class Motion:
    """One run at the instants of the frames, F of them, of a robot in d = 2 or 3 dimensions."""

    q: np.ndarray
    """(F, n) [rad]."""
    skeleton: np.ndarray
    """(F, n + 1, d) [m]."""


@dataclass(frozen=True, eq=False)
class World:
    """What the runs should do and may do, at the instants of the frames; taken from the first
    run.
    """

    t: np.ndarray
    """(F,) [s]."""
    q_d: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    ghost: np.ndarray
    """Skeleton of the reference, (F, n + 1, d) [m]."""
    fans: np.ndarray
    """Outline of each joint's fan, (F, n, FAN_POINTS + 2, d) [m]."""


def _fans(robot: Any, q: jax.Array, lower: jax.Array, upper: jax.Array) -> jax.Array:
    """Outline of every joint's fan for one configuration, (n, FAN_POINTS + 2, d) [m]."""
    n, here = q.shape[0], robot.skeleton(q)
    share = jnp.linspace(0.0, 1.0, FAN_POINTS)
    angles = lower[:, None] + share * (upper - lower)[:, None]
    moved = jax.vmap(
        lambda joint, row: jax.vmap(lambda a: robot.skeleton(q.at[joint].set(a)))(row)
    )(jnp.arange(n), angles)
    joint = jnp.arange(n)
    rim = moved[joint, :, joint + 1] - moved[joint, :, joint]
    centre = here[:-1, None]
    return jnp.concatenate([centre, centre + FAN_RADIUS * rim, centre], axis=1)


def motions_of(curves: Sequence[Curve], t: np.ndarray) -> tuple[World, list[Motion]]:
    """The runs at the instants t [s] of the frames, (F,).

    Raises:
      ValueError: a robot whose `skeleton` does not give (n + 1, 2) or (n + 1, 3) points.
    """
    first, motions = curves[0], []
    for curve in curves:
        q = curve.at("q", t)
        motions.append(Motion(q, skeletons(curve.run.scenario.plant, q)))
        shape = motions[-1].skeleton.shape[1:]
        if shape != motions[0].skeleton.shape[1:]:
            raise checks.fail(
                "plant.skeleton(q)", shape, "points in the plane or in space, alike for all runs"
            )
    robot = first.run.scenario.plant
    q_d, lower, upper = (first.at(field, t) for field in ("q_d", "lower", "upper"))
    ghost = skeletons(robot, q_d)
    fans = jax.jit(jax.vmap(lambda *args: _fans(robot, *args)))(motions[0].q, lower, upper)
    return World(t, q_d, lower, upper, ghost, np.asarray(fans)), motions


def _move(line: Any, points: np.ndarray) -> None:
    """Puts a line through points (k, d)."""
    if points.shape[-1] == 3:
        line.set_data_3d(*points.T)
    else:
        line.set_data(*points.T)


class Scene:
    """The figure of an animation; `move_to(frame)` puts its parts where they belong."""

    def __init__(self, curves: Sequence[Curve], world: World, motions: Sequence[Motion]) -> None:
        self.world, self.motions = world, motions
        self.figure = _style.new_figure(6.4, 3.8)
        grid = self.figure.add_gridspec(1, 2, width_ratios=(1.7, 1))
        solid = world.ghost.shape[-1] == 3
        self.arm: Any = self.figure.add_subplot(grid[0], projection="3d" if solid else None)
        self.bars: Any = self.figure.add_subplot(grid[1])
        self.parts: list[tuple[Any, Artist]] = []
        self.fans: list[Any] = []
        self.dots: list[Any] = []
        points = [self.world.ghost, *(motion.skeleton for motion in self.motions)]
        robot, regions = curves[0].run.scenario.plant, curves[0].run.scenario.regions
        limits = frame(
            self.arm, np.concatenate([x.reshape(-1, x.shape[-1]) for x in points]), regions
        )
        draw_walls(self.arm, robot, regions, limits)
        self._add_fans()
        self._add_arms(curves)
        self._add_bars(curves)
        self.time = self._keep(self.bars.text(0.0, 1.03, "t = ", transform=self.bars.transAxes))
        _style.entitle(self.figure, "The arm within its joint limits", curves)
        _style.legend_below(self.figure, 4)

    def _keep(self, artist: Any) -> Any:
        artist.set_animated(True)
        self.parts.append((artist.axes, artist))
        return artist

    def _line(self, axes: Any, **options: Any) -> Any:
        dimensions = self.world.ghost.shape[-1] if axes is self.arm else 2
        return self._keep(axes.plot(*([[]] * dimensions), **options)[0])

    def _add_fans(self) -> None:
        n, planar = self.world.q_d.shape[1], self.world.ghost.shape[-1] == 2
        look: dict[str, Any] = {
            "edgecolor": _style.bound(),
            "facecolor": _style.shade(0.11, _style.colour(0)),
            "linewidth": 0.7,
        }
        for joint in range(n):
            text = "joint limits" if joint == 0 else None
            if planar:
                self.fans.append(self._keep(self.arm.fill([0.0], [0.0], label=text, **look)[0]))
            else:
                self.fans.append(
                    self._line(self.arm, color=_style.bound(), linewidth=0.8, label=text)
                )

    def _add_arms(self, curves: Sequence[Curve]) -> None:
        self.arm.plot(
            *self.world.ghost[:, -1].T,
            **(_style.reference() | {"linewidth": 0.8, "color": _style.shade(0.533)}),
        )
        look: dict[str, Any] = {
            "color": _style.shade(0.4),
            "linewidth": 1.6,
            "marker": "o",
            "markersize": 4,
        }
        look["markerfacecolor"] = _style.paper()
        self.ghost = self._line(self.arm, label="reference", **look)
        self.trails = [
            self._line(self.arm, color=_style.series(i)["color"], linewidth=0.9)
            for i in range(len(curves))
        ]
        look = {"linewidth": 2.6, "marker": "o", "markersize": 5}
        self.arms = [
            self._line(self.arm, label=curve.name or "arm", **look, **_style.series(i))
            for i, curve in enumerate(curves)
        ]

    def _add_bars(self, curves: Sequence[Curve]) -> None:
        rows = np.arange(self.world.q_d.shape[1])
        shown = np.concatenate(
            [x[np.isfinite(x)] for x in (self.world.lower, self.world.upper, self.world.q_d)]
        )
        room = 0.15 * float(np.ptp(shown))
        self.bars.set(
            xlim=(shown.min() - room, shown.max() + room),
            ylim=(len(rows) - 0.4, -0.6),
            xlabel=_style.label("position $q$", "rad"),
        )
        self.bars.set_yticks(rows, called(curves[0].run.scenario.plant, len(rows)))
        self.bars.spines["left"].set_visible(False)
        self.bars.tick_params(axis="y", length=0)
        width = max(4.0, min(18.0, 90.0 / len(rows)))
        self.ranges = [
            self._line(self.bars, color=_style.shade(0.149), linewidth=width, solid_capstyle="butt")
            for _ in rows
        ]
        look: dict[str, Any] = {
            "linestyle": "none",
            "marker": "|",
            "markersize": width + 3,
            "markeredgewidth": 1.6,
        }
        self.wanted = self._line(self.bars, color=_style.ink(), **look)
        for i in range(len(curves)):
            look = {
                "linestyle": "none",
                "marker": "oDs^v"[i % 5],
                "markersize": max(3.0, min(5.5, width / len(curves))),
            }
            self.dots.append(self._line(self.bars, color=_style.series(i)["color"], **look))

    def move_to(self, frame: int) -> list[tuple[Any, Artist]]:
        """Moves every part to where it is in this frame; returns (axes, part) in the order of
        drawing.
        """
        world = self.world
        rows = np.arange(world.q_d.shape[1])
        for joint, fan in enumerate(self.fans):
            outline = world.fans[frame, joint]
            fan.set_xy(outline) if outline.shape[-1] == 2 else _move(fan, outline)
            self.ranges[joint].set_data(
                [world.lower[frame, joint], world.upper[frame, joint]], [joint, joint]
            )
        _move(self.ghost, world.ghost[frame])
        self.wanted.set_data(world.q_d[frame], rows)
        shifts = 0.14 * (np.arange(len(self.motions)) - 0.5 * (len(self.motions) - 1))
        for motion, arm, trail, dots, shift in zip(
            self.motions, self.arms, self.trails, self.dots, shifts, strict=True
        ):
            _move(arm, motion.skeleton[frame])
            _move(trail, motion.skeleton[: frame + 1, -1])
            dots.set_data(np.clip(motion.q[frame], *self.bars.get_xlim()), rows + shift)
        self.time.set_text(f"t = {world.t[frame]:.2f} s")
        return self.parts
