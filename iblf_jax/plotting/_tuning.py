"""Figures of gain tuning: how it went, what it changed, the loss around the optimum, a front of two objectives."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from iblf_jax.plotting import _style
from iblf_jax.plotting._curves import curves_of
from iblf_jax.plotting._panels import QUANTITIES, show
from iblf_jax.rollout import simulate

if TYPE_CHECKING:
    from iblf_jax.tuning import Front, TuneResult


@_style.styled()
def tuning(result: TuneResult, *, landscape: tuple[str, str] | None = None, points: int = 13) -> Figure:
    """A tuning at a glance: objective and margin over steps, gains over steps, tubes before and after, the loss around the optimum.

    Args:
      result: of `tune`.
      landscape: names of two tuned numbers, such as ("controller.k1[0]", "controller.K2[0]"); the first two if not given.
      points: of the landscape, a side.

    Returns:
      A matplotlib Figure.

    Raises:
      ValueError: an unknown name.

    Source: design of this package.
    """
    n = result.scenario.n
    columns = 1 if n <= 3 else 2
    rows = -(-n // columns)
    figure = _style.new_figure(_style.WIDTH, 5.0 + 1.6 * rows)
    grid = figure.add_gridspec(2 + rows, 2, height_ratios=[1.2, 1.6] + [1.0] * rows)
    _progress(figure.add_subplot(grid[0, 0]), result)
    _margin(figure.add_subplot(grid[0, 1]), result)
    _gains(figure.add_subplot(grid[1, 0]), result)
    names = landscape or ((result.names[0], result.names[1]) if len(result.names) > 1 else None)
    if names is not None:
        _landscape(figure.add_subplot(grid[1, 1]), result, names, points)
    setup = result.setup
    timing: dict[str, Any] = {"duration": setup.duration, "dt": setup.dt, "method": setup.method}
    curves = curves_of({"before": simulate(result.start, **timing), "tuned": simulate(result.scenario, **timing)})
    for i in range(n):
        axes = figure.add_subplot(grid[2 + i // columns, i % columns] if columns > 1 else grid[2 + i, :])
        show(axes, curves, QUANTITIES["q"], i, (0.0, setup.duration))
        axes.set_ylabel(_style.label(f"joint {i}", "rad"))
        if i == 0:
            axes.legend(ncols=2, loc="lower right", fontsize=8.5 if columns == 1 else 6.5)
        if i + columns >= n:
            axes.set_xlabel(_style.label("time $t$", "s"))
    figure.suptitle("Gain tuning")
    return figure


def _accepted(result: TuneResult) -> np.ndarray:
    """The steps of the winning start at which its loss fell below all before."""
    loss = np.where(result.history["sound"], result.history["loss"], np.inf)[:, result.best_start]
    before = np.minimum.accumulate(np.concatenate([[np.inf], loss[:-1]]))
    found = np.flatnonzero(loss < before)
    return found if len(found) else np.arange(1)


def _progress(axes: Axes, result: TuneResult) -> None:
    history = result.history
    trials = np.where(history["sound"], history["objective"], np.nan)
    steps = np.arange(1, len(trials) + 1)
    axes.plot(steps, trials, linestyle="none", marker=".", markersize=3, color=_style.BOUND)
    best = history["objective"][_accepted(result), result.best_start]
    axes.step(_accepted(result) + 1, best, where="post", marker=".", **_style.series(0))
    low, high = float(np.min(best)), float(np.max(best))
    axes.set_ylim(low - 0.1 * (high - low) - 1e-12, high + 0.2 * (high - low) + 1e-12)
    axes.set_xlabel("step")
    axes.set_ylabel("objective")


def _margin(axes: Axes, result: TuneResult) -> None:
    margin = result.history["margin"][:, result.best_start]
    axes.plot(np.arange(1, len(margin) + 1), margin, marker=".", markersize=3, **_style.series(2))
    axes.axhline(0.0, color=_style.ALARM, linewidth=0.8)
    axes.set_xlabel("step")
    axes.set_ylabel(_style.label("smallest margin", "rad"))


def _gains(axes: Axes, result: TuneResult) -> None:
    steps = _accepted(result)
    x = result.history["x"][steps, result.best_start]
    for i, name in enumerate(result.names):
        axes.plot(steps + 1, x[:, i] / (abs(x[0, i]) or 1.0), marker=".", markersize=3, label=name, **_style.series(i))
    if np.all(x / np.where(x[0] == 0, 1, x[0]) > 0):
        axes.set_yscale("log")
    axes.set_xlabel("step")
    axes.set_ylabel("gain, relative to start")
    if len(result.names) <= 8:
        axes.legend(fontsize=6.5, ncols=2)


def _landscape(axes: Axes, result: TuneResult, names: tuple[str, str], points: int) -> None:
    a, b, loss = result.landscape(*names, points=points)
    filled = np.where(np.isfinite(loss), loss, np.nan)
    low = float(np.nanmin(filled))
    levels = low + (np.nanquantile(filled, 0.8) - low) * np.linspace(0.0, 1.0, 12) ** 2
    if levels[-1] > low:
        axes.contourf(a, b, filled.T, levels=levels, cmap="cividis", extend="max")
    here = [result.history["x"][_accepted(result), result.best_start, result.names.index(name)] for name in names]
    axes.plot(*here, color="white", linewidth=0.8, marker=".", markersize=2)
    best = [result.tuned[result.names.index(name)] for name in names]
    axes.plot(*best, marker="*", color=_style.COLOURS[1], markersize=10)
    axes.set_xlim(a.min(), a.max())
    axes.set_ylim(b.min(), b.max())
    if a.min() > 0 and b.min() > 0:
        axes.set_xscale("log")
        axes.set_yscale("log")
    axes.set_xlabel(names[0])
    axes.set_ylabel(names[1])


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
    axes.plot(*front.tried.T, linestyle="none", marker=".", markersize=3, color=_style.BOUND, label="trials")
    axes.plot(*front.objectives.T, marker="o", markersize=4, label="front", **_style.series(0))
    axes.plot(*front.first, linestyle="none", marker="s", color=_style.COLOURS[1], label="start")
    x, y = np.concatenate([front.objectives, front.first[None]]).T
    axes.set_xlim(x.min() - 0.1 * np.ptp(x), x.max() + 0.1 * np.ptp(x))
    axes.set_ylim(y.min() - 0.1 * np.ptp(y), y.max() + 0.1 * np.ptp(y))
    axes.set_xlabel(front.labels[0])
    axes.set_ylabel(front.labels[1])
    axes.legend()
    return figure
