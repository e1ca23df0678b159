"""Figures of gain tuning: how it went, what it changed, the loss around the optimum, a front of two
objectives.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from iblf_jax.core import checks
from iblf_jax.plotting import _style
from iblf_jax.plotting._curves import Curve, curves_of, plain
from iblf_jax.plotting._panels import QUANTITIES, Window, draw, say_what_is_cut, set_limits, show

if TYPE_CHECKING:
    from iblf_jax.tuning import Front, TuneResult

MOST_NAMED = 28
"""Gains that the legend names at most."""


@_style.styled()
def tuning(
    result: TuneResult, *, landscape: tuple[str, str] | None = None, points: int = 13
) -> Figure:
    """A tuning at a glance: objective, margin and gains over steps, the loss around the optimum,
    torque and tubes before and after.

    Args:
      result: of `tune`.
      landscape: names of two tuned numbers, such as ("controller.k1[0]", "controller.K2[0]"); the
        first two if not given.
      points: of the landscape, a side.

    Returns:
      A matplotlib Figure.

    Raises:
      ValueError: an unknown name.

    Source: design of this package.
    """
    if landscape is not None and (not isinstance(landscape, tuple | list) or len(landscape) != 2):
        raise checks.fail(
            "landscape",
            landscape,
            "the names of two tuned numbers",
            f"They are {', '.join(result.names)}.",
        )
    n = result.scenario.n
    columns = 1 if n <= 3 else 2
    rows = len(_style.row_sizes(n, columns))
    named = len(result.names) if len(result.names) <= MOST_NAMED else 0
    heights = [1.9, 2.5 + 0.17 * named, 2.0, 1.7 * rows]
    figure = _style.new_figure(_style.WIDTH, 1.0 + sum(heights))
    grid = figure.add_gridspec(4, 2, height_ratios=heights)
    _progress(figure.add_subplot(grid[0, 0]), result)
    _margin(figure.add_subplot(grid[0, 1]), result)
    _gains(figure.add_subplot(grid[1, 0]), result)
    names = landscape or ((result.names[0], result.names[1]) if len(result.names) > 1 else None)
    if names is not None:
        _landscape(figure.add_subplot(grid[1, 1]), result, names, points)
    curves, whole = (
        curves_of(dict(zip(("before", "tuned"), result.nominal, strict=True))),
        (
            0.0,
            result.setup.duration,
        ),
    )
    _peaks(figure.add_subplot(grid[2, 0]), curves)
    _torque(figure.add_subplot(grid[2, 1]), curves, whole)
    tubes = _style.spread(figure, n, columns, grid[3, :])
    for i, axes in enumerate(axes for row in tubes for axes in row):
        show(axes, curves, QUANTITIES["q"], i, whole)
        axes.set_ylabel(_style.label(curves[0].called(i), "rad"))
        axes.set_xlabel(_style.label("time $t$", "s") if axes in tubes[-1] else "")
    ends = result.at_limits
    _style.head(
        figure,
        [
            "Gain tuning",
            *(["at the end of their range: " + ", ".join(map(plain, ends))] if ends else []),
        ],
    )
    _style.legend_below(figure, of=tubes[0])
    return figure


def _peaks(axes: Axes, curves: list[Curve]) -> None:
    """The largest torque of every joint, before and after."""
    n = curves[0].run.n
    peaks = [
        np.nanmax(np.where(np.isfinite(x), np.abs(x), 0.0), axis=0)
        for x in (curve["tau"] for curve in curves)
    ]
    for i, peak in enumerate(peaks):
        places = np.arange(n) + 0.4 * (i - 0.5)
        axes.bar(places, peak, width=0.36, color=_style.colour(i))
        for x, y in zip(places, peak, strict=True):
            axes.annotate(f"{y:.5g}", (x, y), xytext=(0, 2), textcoords="offset points", rotation=90 if n > 3 else 0, ha="center",
                          va="bottom", fontsize=_style.size(6.5))  # fmt: skip
    sizes = np.concatenate(peaks)
    if _spans_decades(sizes):
        axes.set_yscale("log")
    axes.margins(y=0.35 if n > 3 else 0.15)
    names = [curves[0].called(i) for i in range(n)]
    axes.set_xticks(
        range(n),
        names,
        rotation=40 if max(map(len, names)) * n > 30 else 0,
        ha="right" if max(map(len, names)) * n > 30 else "center",
    )
    axes.grid(axis="x", visible=False)
    axes.set_ylabel(_style.label("peak torque", "N m"))


def _torque(axes: Axes, curves: list[Curve], whole: Window) -> None:
    """The torque of the joint that has the largest one."""
    joint = int(np.argmax(np.nan_to_num(np.abs(curves[-1]["tau"])).max(axis=0)))
    drawn = [
        draw(axes, curve, "tau", joint, whole, **_style.series(i)) for i, curve in enumerate(curves)
    ]
    axes.set_xlim(*whole)
    set_limits(axes, curves, drawn, [], spikes=True)
    say_what_is_cut(axes, curves, drawn, "N m")
    axes.set_ylabel(_style.label(f"torque of {curves[0].called(joint)}", "N m"))
    axes.set_xlabel(_style.label("time $t$", "s"))


def _spans_decades(x: np.ndarray) -> bool:
    """Whether numbers are better seen on a logarithmic axis: all positive, over more than a
    decade.
    """
    return bool(np.all(np.isfinite(x)) and np.all(x > 0) and x.max() > 10 * x.min())


def _accepted(result: TuneResult) -> np.ndarray:
    """The steps of the winning start at which its loss fell below all before."""
    loss = np.where(result.history["valid"], result.history["loss"], np.inf)[:, result.best_start]
    before = np.minimum.accumulate(np.concatenate([[np.inf], loss[:-1]]))
    found = np.flatnonzero(loss < before)
    return found if len(found) else np.arange(1)


def _progress(axes: Axes, result: TuneResult) -> None:
    history = result.history
    trials = np.where(history["valid"], history["objective"], np.nan)
    steps = np.arange(1, len(trials) + 1)
    axes.plot(steps, trials, linestyle="none", marker=".", markersize=3, color=_style.bound())
    best = history["objective"][_accepted(result), result.best_start]
    axes.step(_accepted(result) + 1, best, where="post", marker=".", **_style.series(0))
    low, high = float(np.min(best)), float(np.max(best))
    axes.set_ylim(low - 0.1 * (high - low) - 1e-12, high + 0.2 * (high - low) + 1e-12)
    axes.set_xlabel("step")
    axes.set_ylabel("objective")


def _margin(axes: Axes, result: TuneResult) -> None:
    margin = result.history["margin"][:, result.best_start]
    axes.plot(np.arange(1, len(margin) + 1), margin, marker=".", markersize=3, **_style.series(2))
    axes.axhline(0.0, color=_style.alarm(), linewidth=0.8)
    axes.set_xlabel("step")
    axes.set_ylabel(_style.label("smallest margin", "rad"))


def _gains(axes: Axes, result: TuneResult) -> None:
    steps = _accepted(result)
    x = result.history["x"][steps, result.best_start]
    ends = result.at_limits
    for i, name in enumerate(result.names):
        said = plain(name) + (
            f" (at its {ends[name].side} limit {ends[name].limit:.4g})" if name in ends else ""
        )
        y = x[:, i] / (abs(x[0, i]) or 1.0)
        axes.plot(steps + 1, y, marker=".", markersize=3, label=said, **_style.series(i))
        if name in ends:
            axes.plot(
                steps[-1:] + 1,
                y[-1:],
                marker="X",
                markersize=6,
                linestyle="none",
                color=_style.alarm(),
                zorder=4,
            )
    if np.all(x / np.where(x[0] == 0, 1, x[0]) > 0):
        axes.set_yscale("log")
    axes.set_xlabel("step")
    axes.set_ylabel("gain, relative to start")
    if len(result.names) <= MOST_NAMED:
        axes.legend(
            fontsize=_style.size(6.5),
            loc="upper left",
            bbox_to_anchor=(0.0, -0.22),
            borderaxespad=0.0,
        )


def _landscape(axes: Axes, result: TuneResult, names: tuple[str, str], points: int) -> None:
    a, b, loss = result.landscape(*names, points=points)
    filled = np.where(np.isfinite(loss), loss, np.nan)
    low = float(np.nanmin(filled))
    levels = low + (np.nanquantile(filled, 0.8) - low) * np.linspace(0.0, 1.0, 12) ** 2
    if levels[-1] > low:
        axes.contourf(
            a, b, filled.T, levels=levels, cmap=_style.colour_map("cividis"), extend="max"
        )
    here = [
        result.history["x"][_accepted(result), result.best_start, result.names.index(name)]
        for name in names
    ]
    axes.plot(*here, color="white", linewidth=0.8, marker=".", markersize=2)
    best = [result.tuned[result.names.index(name)] for name in names]
    axes.plot(*best, marker="*", color=_style.colour(1), markersize=10)
    axes.set_xlim(a.min(), a.max())
    axes.set_ylim(b.min(), b.max())
    if a.min() > 0 and b.min() > 0:
        axes.set_xscale("log")
        axes.set_yscale("log")
    axes.set_xlabel(plain(names[0]))
    axes.set_ylabel(plain(names[1]))


@_style.styled()
def paths(
    result: TuneResult,
    others: Mapping[str, Any] | None = None,
    *,
    gains: tuple[str, str] | None = None,
    points: int = 41,
) -> Figure:
    """The way of a tuning across the gains that its requirements allow, beside the ways of other
    searches.

    Contours are of the objective of the nominal run, on the slice through the tuned gains; what
    breaks a requirement there is hatched.

    Args:
      result: of `tune`.
      others: name of a search -> the two gains that it tried, in their units, (N, 2), one after
        another; none if not given.
      gains: names of the two; the first two tuned numbers if not given.
      points: of the slice, a side.

    Returns:
      A matplotlib Figure.

    Raises:
      ValueError: an unknown name, or fewer than two tuned numbers.

    Source: design of this package.
    """
    names = tuple(result.names[:2]) if gains is None else gains
    fine = (
        isinstance(names, tuple | list)
        and len(names) == 2
        and all(name in result.names for name in names)
    )
    if not fine:
        raise checks.fail(
            "gains", gains, "the names of two tuned numbers", f"They are {', '.join(result.names)}."
        )
    points = checks.positive_integer("points", points, least=2)
    own = [result.names.index(name) for name in names]
    trials = result.history["x"][:, result.best_start][:, own]
    ways = {
        "tune": trials,
        **{name: np.asarray(x, float).reshape(-1, 2) for name, x in (others or {}).items()},
    }
    seen = np.concatenate([*ways.values(), result.tuned[None, own]])
    positive = bool(np.all(seen > 0))
    low, high = seen.min(axis=0), seen.max(axis=0)
    room = 0.08 * (np.log(high / low) if positive else high - low) + 0.05
    axis = [np.geomspace(a * np.exp(-r), b * np.exp(r), points) if positive else np.linspace(a - r, b + r, points)
            for a, b, r in zip(low, high, room, strict=True)]  # fmt: skip
    loss, excess = result.on_slice(names[0], names[1], *axis)
    figure = _style.new_figure(0.8 * _style.WIDTH, 4.4)
    axes = figure.subplots()
    filled = np.where(np.isfinite(loss), loss, np.nan)
    best = float(np.nanmin(filled))
    levels = best + (float(np.nanquantile(filled, 0.7)) - best) * np.linspace(0.0, 1.0, 14) ** 2
    if levels[-1] > best:
        axes.contourf(
            *axis, filled.T, levels=levels, cmap=_style.colour_map("cividis"), extend="max"
        )
    broken = np.where(np.isfinite(excess), excess, 1.0)
    if np.any(broken > 0):
        axes.contourf(*axis, broken.T, levels=[0.0, np.inf], colors="none", hatches=["//"])
        axes.contour(*axis, broken.T, levels=[0.0], colors=[_style.alarm()], linewidths=1.0)
    outlined: dict[str, Any] = {"markerfacecolor": "white", "markeredgecolor": "black", "zorder": 4}
    for i, (name, way) in enumerate(ways.items()):
        drawn: dict[str, Any] = {
            "linestyle": "none",
            "marker": ".",
            "markersize": 3.5,
            "color": _style.colour(i + 1),
        }
        if name == "tune":
            drawn = {"linewidth": 1.2, "marker": "o", "markersize": 4, "color": "black", **outlined}
        axes.plot(*way.T, label=f"{name}, {len(way)} values", **drawn)
    axes.plot(*trials[0], marker="s", linestyle="none", markersize=6, label="start", **outlined)
    axes.plot(
        *result.tuned[own], marker="*", linestyle="none", markersize=13, label="tuned", **outlined
    )
    axes.set(
        xlim=axis[0][[0, -1]], ylim=axis[1][[0, -1]], xlabel=plain(names[0]), ylabel=plain(names[1])
    )
    if positive:
        axes.set(xscale="log", yscale="log")
    _style.legend_below(figure, of=[axes])
    return figure


@_style.styled()
def pareto(front: Front) -> Figure:
    """A front of two objectives, with every trial behind it.

    Args:
      front: of `pareto`.

    Returns:
      A matplotlib Figure.

    Source: design of this package.
    """
    figure = _style.new_figure(0.7 * _style.WIDTH, 3.6)
    axes = figure.subplots()
    axes.plot(
        *front.tried.T,
        linestyle="none",
        marker=".",
        markersize=3,
        color=_style.bound(),
        label="trials",
    )
    axes.plot(*front.objectives.T, marker="o", markersize=4, label="front", **_style.series(0))
    axes.plot(*front.first, linestyle="none", marker="s", color=_style.colour(1), label="start")
    for axis, x in zip("xy", np.concatenate([front.objectives, front.first[None]]).T, strict=True):
        low, high = float(x.min()), float(x.max())
        if _spans_decades(x):
            room = (high / low) ** 0.1
            axes.set(**{f"{axis}scale": "log", f"{axis}lim": (low / room, high * room)})
        else:
            room = 0.1 * (high - low) or 0.1 * abs(high) or 1.0
            axes.set(**{f"{axis}lim": (low - room, high + room)})
    axes.set_xlabel(front.labels[0])
    axes.set_ylabel(front.labels[1])
    axes.legend()
    return figure
