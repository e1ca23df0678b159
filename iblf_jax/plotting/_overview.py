"""One run at a glance: every joint in its tube, then errors, phase portrait, torque, estimate and
Lyapunov function.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.gridspec import SubplotSpec

from iblf_jax.core import checks
from iblf_jax.plotting import _style
from iblf_jax.plotting._curves import Curve, curves_of, plain, thinned
from iblf_jax.plotting._figures import draw_phase_portrait
from iblf_jax.plotting._panels import (
    QUANTITIES,
    Plotted,
    Window,
    draw,
    draw_frame,
    say_what_is_cut,
    set_limits,
    show,
)
from iblf_jax.plotting._workspace import draw_paths
from iblf_jax.simulation.results import Rollout
from iblf_jax.world.regions import in_words

WIDTH = 10.0
COLUMNS = 4
"""Tubes side by side at most."""


@_style.styled()
def overview(run: Rollout, *, title: str = "Overview of the run") -> Figure:
    """One run at a glance, its status in the title: what `run.plot()` shows.

    Position of every joint in its tube, and velocity where it has bounds or is measured; then, with
    the joints together, e1, xi and the phase portrait of the first two joints; torque, uncertain
    term with estimate, and Lyapunov function; where there are regions, the distances to their walls
    and the path of the tip.

    Args:
      run: one run of n joints.
      title: the first line of the title.

    Returns:
      The figure.

    Raises:
      ValueError: a batch, something that is no Rollout, or a title that is no text.
    """
    if not isinstance(run, Rollout):
        raise checks.fail(
            "run",
            type(run).__name__,
            "a Rollout",
            "To compare several, use plotting.joint and the other figures.",
        )
    checks.word("title", title, "a text")
    (curve,) = curves_of(run)
    rows = len(_style.row_sizes(run.n, COLUMNS))
    tubes = ("q", "dq") if curve.has_speed_limits or curve.is_measured else ("q",)
    heights = (*(2.0 * rows for _ in tubes), 4.4, *([3.2] if curve.has_regions else []))
    figure = _style.new_figure(WIDTH, 1.3 + sum(heights))
    parts = figure.add_gridspec(len(heights), 1, height_ratios=heights)
    whole = (0.0, float(np.asarray(run.t)[-1]) or 1e-3)
    for i, field in enumerate(tubes):
        _tubes(figure, parts[i], curve, QUANTITIES[field], whole)
    _together(figure, parts[len(tubes)], curve, whole)
    if curve.has_regions:
        _regions(figure, parts[len(tubes) + 1], curve, whole)
    _style.entitle(figure, title, [curve], always=True)
    _style.legend_below(figure, 8)
    return figure


def _tubes(
    figure: Figure, where: SubplotSpec, curve: Curve, quantity: Plotted, whole: Window
) -> None:
    """Position, or velocity, of every joint in its tube."""
    rows = _style.spread(figure, curve.run.n, COLUMNS, where)
    for joint, axes in enumerate(axes for row in rows for axes in row):
        show(axes, [curve], quantity, joint, whole)
        for line in axes.get_lines():
            if line.get_label() == quantity.symbol:
                line.set(**_style.series(joint), label="_")
        axes.set_title(curve.called(joint))
        axes.set_ylabel(quantity.label if any(axes is row[0] for row in rows) else "")
        axes.set_xlabel(_style.label("time $t$", "s") if axes in rows[-1] else "")


def _together(figure: Figure, where: SubplotSpec, curve: Curve, whole: Window) -> None:
    """The panels that show all joints together."""
    grid = where.subgridspec(2, 3)
    places: dict[str, Any] = {
        "e1": grid[0, 0],
        "xi": grid[0, 1],
        "tau": grid[1, 0],
        "disturbance_estimate": grid[1, 1],
    }
    for field, place in places.items():
        _joints(figure.add_subplot(place), curve, QUANTITIES[field], whole)
    if curve.run.n > 1:
        axes = figure.add_subplot(grid[0, 2])
        draw_phase_portrait(axes, [curve], (0, 1))
        for line in axes.get_lines():
            if line.get_label() == "$q$":
                line.set(color=_style.shade(0.396), linewidth=2.4)
            line.set_label("_")
    _lyapunov(figure.add_subplot(grid[1, 2]), curve, whole)


def _joints(axes: Axes, curve: Curve, quantity: Plotted, whole: Window) -> None:
    """One quantity of all joints, each in its colour."""
    # The walls of xi are the same for all joints; those of e1 are not, and are in the tubes above.
    frame = draw_frame(axes, curve, quantity, 0, whole, label="_") if quantity.field == "xi" else []
    drawn = []
    for joint in range(curve.run.n):
        look = _style.series(joint)
        if quantity.truth:
            drawn.append(
                draw(
                    axes,
                    curve,
                    quantity.truth,
                    joint,
                    whole,
                    color=look["color"],
                    linewidth=4.0,
                    alpha=0.3,
                    label="_",
                )
            )
        drawn.append(
            draw(axes, curve, quantity.field, joint, whole, label=curve.called(joint), **look)
        )
    axes.set_xlim(*whole)
    set_limits(axes, [curve] * len(drawn), drawn, frame, spikes=quantity.unit == "N m")
    say_what_is_cut(axes, [curve] * len(drawn), drawn, quantity.unit)
    axes.set_ylabel(r"$f$ (broad), $\hat f$ [N m]" if quantity.truth else quantity.label)
    axes.set_xlabel(_style.label("time $t$", "s"))


def _regions(figure: Figure, where: SubplotSpec, curve: Curve, whole: Window) -> None:
    """The distances to the walls of the regions, and the path of the tip between them."""
    grid = where.subgridspec(1, 2, width_ratios=(1.5, 1))
    axes, quantity, scenario = (
        figure.add_subplot(grid[0]),
        QUANTITIES["region_margin"],
        curve.run.scenario,
    )
    for i in range(len(scenario.regions)):
        draw(axes, curve, quantity.field, i, whole, **(_style.series(i) | {"label": "_"}))
    names = [
        plain(f"{i}: {in_words(region, scenario.plant)}")
        for i, region in enumerate(scenario.regions)
    ]
    axes.legend(axes.get_lines(), names, title="regions")
    axes.axhline(0.0, color=_style.alarm(), linewidth=1.0)
    axes.set_xlim(*whole)
    axes.set_xlabel(_style.label("time $t$", "s"))
    axes.set_ylabel(quantity.label)
    for line in draw_paths(figure, grid[1], [curve]).get_lines():
        line.set_label("_")


def _lyapunov(axes: Axes, curve: Curve, whole: Window) -> None:
    """The Lyapunov function on a logarithmic axis."""
    V = curve["V"]
    positive = np.where(np.isfinite(V) & (V > 0), V, np.nan)
    axes.plot(*thinned(curve.t[: len(V)], positive), color=_style.shade(0.733))
    if np.isfinite(positive).any():
        axes.set_yscale("log")
    axes.set_xlim(*whole)
    axes.set_ylabel("Lyapunov function $V_2$")
    axes.set_xlabel(_style.label("time $t$", "s"))
