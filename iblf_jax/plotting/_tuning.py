"""Figures of gain tuning: its progress, its effect on the run, the loss near the optimum, and a
front of two objectives.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from iblf_jax.control.actuators import Motor
from iblf_jax.control.controllers import Saturated
from iblf_jax.core import checks
from iblf_jax.core.first_use import ModuleOnFirstUse
from iblf_jax.core.pytree import layers
from iblf_jax.plotting import _scales, _style
from iblf_jax.plotting._curves import ROUNDING, Curve, check_class, curves_of, escaped, peak_of
from iblf_jax.plotting._panels import (
    Window,
    annotate_clipped_peak,
    draw,
    quantity_of,
    set_limits,
    show,
    signed,
)
from iblf_jax.simulation.scenario import Scenario
from iblf_jax.studies.summaries import LEVELS, initial_margins

if TYPE_CHECKING:
    from iblf_jax import tuning as results
else:
    results = ModuleOnFirstUse("iblf_jax.tuning")

MAX_NAMED = 28
"""Largest number of gains in the legend."""


@_style.figure_function
def tuning(
    result: results.TuneResult, *, landscape: tuple[str, str] | None = None, points: int = 13
) -> Figure:
    """The overview of a tuning: objective, margin and gains over the steps, the loss near the
    optimum, torques and positions before and after.

    Args:
      result: the result of `tune`.
      landscape: names of two tuned numbers, such as ("controller.k1[0]", "controller.K2[0]"); the
        first two if not given.
      points: points of the landscape along each axis.

    Returns:
      A matplotlib Figure.

    Raises:
      ValueError: an unknown name.

    Source: design of this package.
    """
    _check_tuned(result)
    if landscape is not None and (not isinstance(landscape, tuple | list) or len(landscape) != 2):
        remedy = f"They are {', '.join(result.names)}."
        raise checks.fail("landscape", landscape, "the names of two tuned numbers", remedy)
    n = result.scenario.n
    columns = 1 if n <= 3 else 2
    heights = [1.7 * len(_style.row_sizes(n, columns)), 1.9, 1.9, 2.4]
    if len(result.names) <= MAX_NAMED:
        heights[3] += 0.17 * len(result.names)
    figure = _style.new_figure(_style.WIDTH, 1.2 + sum(heights))
    grid = figure.add_gridspec(4, 2, height_ratios=heights)
    curves = curves_of(dict(zip(("before", "tuned"), result.nominal, strict=True)))
    window = (0.0, result.setup.duration)
    tubes = _style.panel_rows(figure, n, columns, grid[0, :])
    for i, axes in enumerate(axes for row in tubes for axes in row):
        quantity = quantity_of(result.scenario, "q", i)
        show(axes, curves, quantity, i, window)
        axes.set_ylabel(_style.label(curves[0].joint_label(i), quantity.unit))
    for axes in tubes[-1]:
        _style.time_axis(axes)
    limits = torque_limits(result.scenario)
    _torque(figure.add_subplot(grid[1, 0]), curves, window, limits)
    _peaks(figure.add_subplot(grid[1, 1]), curves, limits)
    search = figure.add_subplot(grid[2, 0])
    _progress(search, result)
    _margin(figure.add_subplot(grid[2, 1]), result)
    _gains(figure.add_subplot(grid[3, 0]), result)
    if landscape is None and len(result.names) > 1:
        landscape = (result.names[0], result.names[1])
    if landscape is not None:
        _landscape(figure.add_subplot(grid[3, 1]), result, landscape, points)
    if not _style.in_paper():
        tubes[0][0].set_title("Before and after", loc="left")
        search.set_title("The search", loc="left")
    heading = ["Gain tuning"]
    if result.at_limits:
        heading.append("at the end of their range: " + ", ".join(map(escaped, result.at_limits)))
    _style.set_heading(figure, heading)
    above: dict[str, Any] = {"loc": "lower right", "bbox_to_anchor": (1.0, 1.0)}
    legend = tubes[0][-1].legend(ncols=4, borderaxespad=0.0, **above)
    # It is wider than its panel, which the layout would make narrower for it; the title beside it
    # keeps the room above.
    legend.set_in_layout(_style.in_paper())
    return figure


def torque_limits(scenario: Scenario) -> np.ndarray | None:
    """The largest torque of each joint that the law or its actuator lets through, (n,) [N m]; None
    without limits.
    """
    limits = [law.limit for law in layers(scenario.controller) if isinstance(law, Saturated)]
    if isinstance(scenario.actuator, Motor):
        limits.append(scenario.actuator.limit)
    if not limits:
        return None
    smallest = np.min([np.broadcast_to(x, scenario.n) for x in limits], axis=0)
    if not np.all(np.isfinite(smallest)):
        return None
    return smallest


def _peaks(axes: Axes, curves: list[Curve], limits: np.ndarray | None) -> None:
    """The torque of every joint that is farthest from zero, with its sign, before and after, and
    its limits.
    """
    n = curves[0].run.n
    style: dict[str, Any] = {"textcoords": "offset points", "ha": "center"}
    style["fontsize"] = _style.size(6.5)
    margin = 0.15
    if n > 3:
        margin, style["rotation"] = 0.35, 90
    values = []
    for i, curve in enumerate(curves):
        found = [peak_of(curve, "tau", [joint]) for joint in range(n)]
        peaks = [0.0 if peak is None else peak.value for peak in found]
        places = np.arange(n) + 0.4 * (i - 0.5)
        axes.bar(places, peaks, width=0.36, color=_style.colour(i))
        for x, y in zip(places, peaks, strict=True):
            beyond: dict[str, Any] = {"xytext": (0, 2), "va": "bottom"}
            if y < 0.0:
                beyond = {"xytext": (0, -2), "va": "top"}
            axes.annotate(signed(float(f"{y:.3g}")), (x, y), **style, **beyond)
        values += peaks
    if limits is not None:
        for joint, limit in enumerate(limits):
            ends = [joint - 0.45, joint + 0.45]
            for side in (-limit, limit):
                axes.plot(ends, [side, side], color=_style.failure(), linewidth=1.0)
        values += limits.tolist()
    sizes = np.abs(values)
    if np.all(np.isfinite(sizes)) and sizes.min() > 0 and sizes.max() > 10 * sizes.min():
        axes.set_yscale("symlog", linthresh=float(sizes.min()))
    axes.axhline(0.0, color=_style.bound(), linewidth=0.8)
    axes.margins(y=margin)
    _style.name_ticks(axes, [curves[0].joint_label(i) for i in range(n)], 30)
    axes.grid(axis="x", visible=False)
    quantity = quantity_of(curves[0].run.scenario, "tau")
    axes.set_ylabel(_style.label(f"peak {quantity.name}", quantity.unit))


def _torque(axes: Axes, curves: list[Curve], window: Window, limits: np.ndarray | None) -> None:
    """The torque of the joint that is nearest to its limit, or has the largest torque without
    limits.
    """
    share = np.nan_to_num(np.abs(curves[-1]["tau"])).max(axis=0)
    if limits is not None:
        share = share / limits
    joint = int(np.argmax(share))
    drawn = []
    for i, curve in enumerate(curves):
        drawn.append(draw(axes, curve, "tau", joint, window, **_style.series(i)))
    quantity = quantity_of(curves[0].run.scenario, "tau", joint)
    set_limits(axes, curves, drawn, [], quantity, spikes=True)
    annotate_clipped_peak(axes, curves, drawn, quantity, [joint] * len(drawn))
    low, high = axes.get_ylim()
    if limits is not None:
        for side in (-limits[joint], limits[joint]):
            axes.axhline(side, color=_style.failure(), linewidth=1.0)
        if limits[joint] > 2.0 * max(-low, high):  # Far limits would flatten the curves.
            axes.set_ylim(low, high)
            axes.set_title(f"limit {limits[joint]:.4g} {quantity.unit}", loc="right")
    name = f"{quantity.name} of {curves[0].joint_label(joint)}"
    axes.set_ylabel(_style.label(name, quantity.unit))
    _style.time_axis(axes, window)


def _accepted(result: results.TuneResult) -> np.ndarray:
    """The steps of the best start at which its loss fell below all previous values."""
    loss = np.where(result.history["valid"], result.history["loss"], np.inf)[:, result.best_start]
    before = np.minimum.accumulate(np.concatenate([[np.inf], loss[:-1]]))
    found = np.flatnonzero(loss < before)
    if not len(found):
        return np.arange(1)
    return found


def _progress(axes: Axes, result: results.TuneResult) -> None:
    history = result.history
    trials = np.where(history["valid"], history["objective"], np.nan)
    steps = np.arange(1, len(trials) + 1)
    axes.plot(steps, trials, linestyle="none", marker=".", markersize=3, color=_style.bound())
    best = history["objective"][_accepted(result), result.best_start]
    axes.step(_accepted(result) + 1, best, where="post", marker=".", **_style.series(0))
    _scales.follow(axes, "y", trials)
    axes.set_xlabel("step")
    axes.set_ylabel("objective")


def _margin(axes: Axes, result: results.TuneResult) -> None:
    margin = result.history["margin"][:, result.best_start]
    axes.plot(np.arange(1, len(margin) + 1), margin, marker=".", markersize=3, **_style.series(2))
    axes.axhline(0.0, color=_style.failure(), linewidth=0.8)
    axes.set_xlabel("step")
    unit = quantity_of(result.scenario, "q").unit
    axes.set_ylabel(_style.label("smallest margin", unit))
    start = float(np.min(initial_margins(result.scenario, {})[LEVELS[0]]))
    rounding = ROUNDING * np.finfo(margin.dtype).eps
    validated = margin[np.isfinite(margin)]
    if validated.size and np.all(np.abs(validated - start) <= rounding):
        axes.set_title("that of the start (t = 0) at every step")


def _gains(axes: Axes, result: results.TuneResult) -> None:
    steps = _accepted(result)
    x = result.history["x"][steps, result.best_start]
    ends = result.at_limits
    at_end: dict[str, Any] = {"marker": "X", "markersize": 6, "linestyle": "none", "zorder": 4}
    for i, name in enumerate(result.names):
        label = escaped(name)
        if name in ends:
            label += f" (at its {ends[name].side} limit {ends[name].limit:.4g})"
        y = x[:, i] / (abs(x[0, i]) or 1.0)
        axes.plot(steps + 1, y, marker=".", markersize=3, label=label, **_style.series(i))
        if name in ends:
            axes.plot(steps[-1:] + 1, y[-1:], color=_style.failure(), **at_end)
    if np.all(x / np.where(x[0] == 0, 1, x[0]) > 0):
        axes.set_yscale("log")
    axes.set_xlabel("step")
    axes.set_ylabel("gain, relative to start")
    if len(result.names) <= MAX_NAMED:
        below: dict[str, Any] = {"bbox_to_anchor": (0.0, -0.22), "borderaxespad": 0.0}
        axes.legend(fontsize=_style.size(6.5), loc="upper left", **below)


def _draw_contours(
    axes: Axes, x: np.ndarray, y: np.ndarray, loss: np.ndarray, highest: float, count: int
) -> None:
    """Filled contours of a loss from its minimum to a quantile; none if the loss is constant."""
    finite = np.where(np.isfinite(loss), loss, np.nan)
    low = float(np.nanmin(finite))
    levels = low + (float(np.nanquantile(finite, highest)) - low) * np.linspace(0, 1, count) ** 2
    if levels[-1] > low:
        cmap = _style.colour_map("cividis")
        axes.contourf(x, y, finite.T, levels=levels, cmap=cmap, extend="max")


def _landscape(axes: Axes, result: results.TuneResult, names: tuple[str, str], points: int) -> None:
    a, b, loss = result.landscape(*names, points=points)
    _draw_contours(axes, a, b, loss, 0.8, 12)
    pair = [result.names.index(name) for name in names]
    path = result.history["x"][_accepted(result), result.best_start][:, pair]
    axes.plot(*path.T, color="white", linewidth=0.8, marker=".", markersize=2)
    axes.plot(*result.tuned[pair], marker="*", color=_style.colour(1), markersize=10)
    axes.set_xlim(a.min(), a.max())
    axes.set_ylim(b.min(), b.max())
    if a.min() > 0 and b.min() > 0:
        axes.set_xscale("log")
        axes.set_yscale("log")
    axes.set_xlabel(escaped(names[0]))
    axes.set_ylabel(escaped(names[1]))


@_style.figure_function
def paths(
    result: results.TuneResult,
    others: Mapping[str, Any] | None = None,
    *,
    gains: tuple[str, str] | None = None,
    points: int = 41,
) -> Figure:
    """The iterates of a tuning in the plane of two gains, with those of other searches.

    The contours show the objective of the nominal run on the slice through the tuned gains; the
    hatched area violates a requirement.

    Args:
      result: the result of `tune`.
      others: name of a search -> the values of the two gains that it tried, in their units and in
        order, (N, 2); none if not given.
      gains: names of the two gains; the first two tuned numbers if not given.
      points: points of the slice along each axis.

    Returns:
      A matplotlib Figure.

    Raises:
      ValueError: an unknown name, or fewer than two tuned numbers.

    Source: design of this package.
    """
    _check_tuned(result)
    names = result.names[:2] if gains is None else gains
    are_two = isinstance(names, tuple | list) and len(names) == 2
    if not are_two or not all(name in result.names for name in names):
        remedy = f"They are {', '.join(result.names)}."
        raise checks.fail("gains", gains, "the names of two tuned numbers", remedy)
    points = checks.positive_integer("points", points, least=2, most=checks.MAX_POINTS)
    pair = [result.names.index(name) for name in names]
    iterates = {"tune": result.history["x"][:, result.best_start][:, pair]}
    others = {} if others is None else checks.mapping("others", others, '{"grid": tried}')
    for name, x in others.items():
        tried = np.asarray(checks.as_floats(f"others[{name!r}]", x))
        if tried.ndim != 2 or tried.shape[1] != 2:
            raise checks.fail(f"others[{name!r}]", x, "the values of the two gains, (N, 2)")
        iterates[name] = tried
    tuned = result.tuned[pair]
    all_gains = np.concatenate([*iterates.values(), tuned[None]])
    logarithmic = bool(np.all(all_gains > 0))
    grid = [_axis(x, points, logarithmic=logarithmic) for x in all_gains.T]
    loss, excess = result.on_slice(names[0], names[1], *grid)
    figure, (axes,) = _style.panels(0.8 * _style.WIDTH, 4.4)
    _draw_contours(axes, grid[0], grid[1], loss, 0.7, 14)
    violation = np.where(np.isfinite(excess), excess, 1.0)
    if np.any(violation > 0):
        axes.contourf(*grid, violation.T, levels=[0.0, np.inf], colors="none", hatches=["//"])
        axes.contour(*grid, violation.T, levels=[0.0], colors=[_style.failure()], linewidths=1.0)
    _draw_iterates(axes, iterates, tuned)
    for direction, name, x in zip("xy", names, grid, strict=True):
        axes.set(**{f"{direction}lim": x[[0, -1]], f"{direction}label": escaped(name)})
    if logarithmic:
        axes.set(xscale="log", yscale="log")
    _style.legend_below(figure, of=[axes])
    return figure


def _check_tuned(result: object) -> None:
    """Raises ValueError for something that is no result of `tune`."""
    check_class("result", result, results.TuneResult, "ij.tune returns one.")


def _axis(x: np.ndarray, points: int, *, logarithmic: bool) -> np.ndarray:
    """Points of an axis with a margin around some values."""
    low, high = float(x.min()), float(x.max())
    if logarithmic:
        room = np.exp(0.08 * np.log(high / low) + 0.05)
        return np.geomspace(low / room, high * room, points)
    room = 0.08 * (high - low) + 0.05
    return np.linspace(low - room, high + room, points)


def _draw_iterates(axes: Axes, iterates: Mapping[str, np.ndarray], tuned: np.ndarray) -> None:
    """Draws the iterates of every search, and start and result of the tuning."""
    outlined: dict[str, Any] = {"markerfacecolor": "white", "markeredgecolor": "black", "zorder": 4}
    for i, (name, x) in enumerate(iterates.items()):
        style: dict[str, Any] = {"linestyle": "none", "marker": ".", "markersize": 3.5}
        style["color"] = _style.colour(i + 1)
        if name == "tune":
            style = {"linewidth": 1.2, "marker": "o", "markersize": 4, "color": "black", **outlined}
        axes.plot(*x.T, label=f"{name}, {len(x)} values", **style)
    outlined["linestyle"] = "none"
    axes.plot(*iterates["tune"][0], marker="s", markersize=6, label="start", **outlined)
    axes.plot(*tuned, marker="*", markersize=13, label="tuned", **outlined)


@_style.figure_function
def pareto(front: results.ParetoFront) -> Figure:
    """A front of two objectives, with all trials.

    Args:
      front: the result of `pareto`.

    Returns:
      A matplotlib Figure.

    Source: design of this package.
    """
    check_class("front", front, results.ParetoFront, "ij.pareto returns one.")
    figure, (axes,) = _style.panels(0.7 * _style.WIDTH, 3.6)
    dots: dict[str, Any] = {"linestyle": "none", "marker": ".", "markersize": 3}
    axes.plot(*front.tried.T, color=_style.bound(), label="trials", **dots)
    axes.plot(*front.objectives.T, marker="o", markersize=4, label="front", **_style.series(0))
    axes.plot(*front.first, linestyle="none", marker="s", color=_style.colour(1), label="start")
    points = np.concatenate([front.objectives, front.first[None], front.tried])
    for direction, x in zip("xy", points.T, strict=True):
        _scales.follow(axes, direction, x)
    axes.set_xlabel(front.labels[0])
    axes.set_ylabel(front.labels[1])
    axes.legend()
    return figure
