"""The overview of a run: positions and bounds of all joints, errors, phase portrait, torque,
estimate and Lyapunov function.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.gridspec import SubplotSpec

from iblf_jax.core import checks
from iblf_jax.core.families import is_default
from iblf_jax.plotting import _style
from iblf_jax.plotting._curves import Curve, check_class, curves_of, escaped, thinned
from iblf_jax.plotting._figures import draw_phase_portrait
from iblf_jax.plotting._panels import (
    QUANTITIES,
    PanelQuantity,
    Window,
    annotate_clipped_peak,
    disturbance_quantity,
    draw,
    draw_band,
    draw_bounds,
    level_quantity,
    noise_band,
    quantity_of,
    say_zero,
    set_limits,
    show,
)
from iblf_jax.plotting._workspace import draw_paths
from iblf_jax.simulation.results import Rollout
from iblf_jax.world.plants import Plant
from iblf_jax.world.regions import in_words

WIDTH = 10.0
COLUMNS = 4
"""Largest number of panels in a row."""


@_style.figure_function
def overview(run: Rollout, *, title: str = "Overview of the run") -> Figure:
    """The overview of one run, its status in the title: what `run.plot()` shows.

    The first panels show the position of every joint between its bounds, and the velocity if it has
    bounds or is measured; of a plant in strict-feedback form every level, with the virtual control
    that it follows.  Further panels show all joints together: e1, xi, the phase portrait of
    the first two joints, the torque, the uncertain term with its estimate (of a model in
    strict-feedback form e2, and the disturbances of the levels in a row of their own), and the
    Lyapunov function.  For scenarios with regions, the last panels show the distances to the
    boundaries and the path of the tip.

    Args:
      run: one run of n joints.
      title: the first line of the title.

    Returns:
      The figure.

    Raises:
      ValueError: a batch, not a Rollout, or a title that is not a text.
    """
    check_class("run", run, Rollout, "plotting.joint and other figures compare several runs.")
    checks.string("title", title, "a text")
    (curve,) = curves_of(run)
    rows = len(_style.row_sizes(run.n, COLUMNS))
    plant = run.scenario.loop.plant
    levels = [1]
    for level in range(2, plant.order + 1):
        follows_alpha = level > plant.reference_levels
        if follows_alpha or curve.has_bounds(level) or curve.is_measured:
            levels.append(level)
    disturbed = curve.disturbed_levels()
    heights = [2.0 * rows] * len(levels) + [6.6 if _style.is_narrow() else 4.4]
    if disturbed:
        heights.append(2.2)
    if curve.has_regions:
        heights.append(3.2)
    figure = _style.new_figure(WIDTH, 1.3 + sum(heights))
    parts = figure.add_gridspec(len(heights), 1, height_ratios=heights)
    window = (0.0, float(np.asarray(run.t)[-1]) or 1e-3)
    for i, level in enumerate(levels):
        _level(figure, parts[i], curve, level, window)
    _together(figure, parts[len(levels)], curve, window)
    if disturbed:
        _disturbances(figure, parts[len(levels) + 1], curve, disturbed, window)
    if curve.has_regions:
        _regions(figure, parts[len(heights) - 1], curve, window)
    _style.set_title(figure, title, [curve], always=True)
    _style.legend_below(figure, 8)
    return figure


def _level(figure: Figure, where: SubplotSpec, curve: Curve, level: int, window: Window) -> None:
    """One level of every joint between its bounds."""
    scenario = curve.run.scenario
    rows = _style.panel_rows(figure, curve.run.n, COLUMNS, where)
    labels = []
    for joint, axes in enumerate(axes for row in rows for axes in row):
        quantity = level_quantity(scenario, level, joint)
        labels.append(quantity.label)
        show(axes, [curve], quantity, joint, window)
        for line in axes.get_lines():
            if line.get_label() == quantity.symbol:
                line.set(**_style.series(joint), label="_")
        axes.set_title(curve.joint_label(joint))
    units_differ = len(set(labels)) > 1
    first = 0
    for row in rows:
        for axes, label in zip(row, labels[first:], strict=False):
            if units_differ or axes is row[0]:
                axes.set_ylabel(label)
        first += len(row)
    for axes in rows[-1]:
        _style.time_axis(axes)


def _disturbances(
    figure: Figure, where: SubplotSpec, curve: Curve, levels: list[int], window: Window
) -> None:
    """The disturbances of the levels with their estimates, one panel a level."""
    grid = where.subgridspec(1, len(levels))
    for i, level in enumerate(levels):
        quantity = disturbance_quantity(curve.run.scenario, level)
        _joints(figure.add_subplot(grid[i]), curve, quantity, window)


def _together(figure: Figure, where: SubplotSpec, curve: Curve, window: Window) -> None:
    """The panels that show all joints together."""
    columns = 2 if _style.is_narrow() else 3
    cells = list(where.subgridspec(6 // columns, columns))  # type: ignore[call-overload]
    scenario = curve.run.scenario
    fields = {0: "e1", 1: "xi", 3: "tau", 4: "disturbance_estimate"}
    if scenario.loop.model.uncertain_levels:
        fields[4] = "e2"
    for place, field in fields.items():
        _joints(figure.add_subplot(cells[place]), curve, quantity_of(scenario, field), window)
    if curve.run.n > 1:
        axes = figure.add_subplot(cells[2])
        draw_phase_portrait(axes, [curve], (0, 1))
        symbol = quantity_of(scenario, "q").symbol
        for line in axes.get_lines():
            if line.get_label() == symbol:
                line.set(color=_style.blend(0.396), linewidth=2.4)
            line.set_label("_")
    _lyapunov(figure.add_subplot(cells[5]), curve, window)


def _lyapunov(axes: Axes, curve: Curve, window: Window) -> None:
    """The Lyapunov function on a logarithmic axis, as a band where it is a noise there."""
    V = curve["V"]
    t = curve.t[: len(V)]
    positive = np.where(np.isfinite(V) & (V > 0), V, np.nan)
    colour = _style.blend(0.733)
    band = noise_band(t, np.log(positive))
    if band is None:
        axes.plot(*thinned(t, positive), color=colour)
    else:
        middle, low, high, mean = band
        draw_band(axes, middle, np.exp(low), np.exp(high), {"color": colour})
        axes.plot(middle, np.exp(mean), color=colour)
    energy = curve.run.scenario.loop.model.energy_of_errors
    symbol = r"$\sum w_i V_i$" if is_default(energy, Plant.energy_of_errors) else "$V_2$"
    if np.isfinite(positive).any():
        axes.set_yscale("log")
    elif np.isfinite(V).any():
        say_zero(axes, 0.0, symbol, "1")
    axes.set_ylabel(f"Lyapunov function {symbol}")
    _style.time_axis(axes, window)


def _joints(axes: Axes, curve: Curve, quantity: PanelQuantity, window: Window) -> None:
    """One quantity of all joints, each in its own colour."""
    bounds = []
    if quantity.field == "xi":  # The bounds of e1 differ between joints; those of xi do not.
        bounds = draw_bounds(axes, curve, quantity, 0, window, label="_")
    drawn: list[np.ndarray] = []
    joints: list[int] = []
    for joint in range(curve.run.n):
        style = _style.series(joint)
        if quantity.truth:
            broad: dict[str, Any] = {"color": style["color"], "linewidth": 4.0, "alpha": 0.3}
            drawn.append(draw(axes, curve, quantity.truth, joint, window, label="_", **broad))
            joints.append(joint)
        style["label"] = curve.joint_label(joint)
        drawn.append(draw(axes, curve, quantity.field, joint, window, **style))
        joints.append(joint)
    curves = [curve] * len(drawn)
    set_limits(axes, curves, drawn, bounds, quantity, spikes=quantity.has_spikes)
    annotate_clipped_peak(axes, curves, drawn, quantity, joints)
    axes.set_ylabel(quantity.label)
    if quantity.truth:
        symbols = f"{quantity.symbol} (broad), {quantity.estimate_symbol}"
        axes.set_ylabel(_style.label(symbols, quantity.unit))
    _style.time_axis(axes, window)


def _regions(figure: Figure, where: SubplotSpec, curve: Curve, window: Window) -> None:
    """The distances to the boundaries of the regions, and the path of the tip."""
    grid = where.subgridspec(1, 2, width_ratios=(1.5, 1))
    axes = figure.add_subplot(grid[0])
    quantity = QUANTITIES["region_margin"]
    scenario = curve.run.scenario
    robot = checks.given(scenario.loop.plant.robot)
    names = []
    for i, region in enumerate(scenario.regions):
        draw(axes, curve, quantity.field, i, window, label="_", **_style.series(i))
        names.append(escaped(f"{i}: {in_words(region, robot)}"))
    axes.legend(axes.get_lines(), names, title="regions")
    axes.axhline(0.0, color=_style.failure(), linewidth=1.0)
    _style.time_axis(axes, window)
    axes.set_ylabel(quantity.label)
    for line in draw_paths(partial(figure.add_subplot, grid[1]), [curve]).get_lines():
        line.set_label("_")
