"""The figure of a comparison: error, torque and settling time of every law, at the gains given and
at equal effort, side by side.

The error is drawn on a logarithmic scale, where an exponential decay is a straight line and its
rate a slope; the torque during a tenth of that time, because its transient, 1/K2 against 1/k1, is
so much shorter.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from iblf_jax.core import checks
from iblf_jax.plotting import _style
from iblf_jax.plotting._curves import Curve, check_joint, curves_of, thinned
from iblf_jax.plotting._figures import PanelRow, windows
from iblf_jax.plotting._panels import QUANTITIES, Window, draw, set_limits
from iblf_jax.simulation.metrics import Settling

if TYPE_CHECKING:
    from iblf_jax.studies.comparison import Comparison

SMALLEST = 1e-5
"""Errors below this [rad] are drawn at the foot of the logarithmic axis."""

TORQUE_SHARE = 0.1
"""The part of the error's time that the torque is shown for."""


@_style.styled()
def comparison(result: Comparison, joint: int = 0, *, zoom: float | None = None) -> Figure:
    """Error |e1| and torque of one joint during the transient, and every law's settling time (worst
    joint).

    One column at the gains given and, if factors were sought, one at equal effort; a law has the
    same colour in both.

    Args:
      result: what `iblf_jax.compare` returned.
      joint: which joint, from 0.
      zoom: how much of the start is shown [s]; two and a half transients of the error if not given.

    Returns:
      The figure.

    Raises:
      ValueError: not a comparison, no such joint, or a zoom that is no time.
    """
    if not hasattr(result, "equal_effort") or not hasattr(result, "rollouts"):
        raise checks.fail(
            "result", type(result).__name__, "a Comparison", "Draw what ij.compare returns."
        )
    given = curves_of(result.rollouts)
    joint = check_joint(given, joint)
    error, torque = (
        PanelRow(QUANTITIES[field], joint, QUANTITIES[field].label) for field in ("e1", "tau")
    )
    start, end = windows(given, [error], zoom)[1]
    columns = {"gains as given": given}
    if result.factors:
        columns["equal effort (RMS torque above gravity)"] = curves_of(result.equal_effort)
    figure = _style.new_figure(_style.WIDTH, 6.6)
    table = figure.subplots(
        3, len(columns), squeeze=False, sharey="row", height_ratios=(1.5, 1.5, 1.0)
    )
    order = list(result.rollouts)
    for column, (title, curves) in zip(table.T, columns.items(), strict=True):
        column[0].set_title(title)
        _errors(column[0], curves, order, joint, (start, end))
        _torques(column[1], curves, order, joint, (start, TORQUE_SHARE * end))
        _settling(column[2], curves, order)
    table[0, 0].set_ylabel(_style.label("error $|e_1|$", "rad"))
    table[1, 0].set_ylabel(torque.label)
    table[2, 0].set_ylabel(_style.label("settling", "s"))
    figure.align_ylabels(table[:, 0])
    _style.entitle(figure, f"Laws compared: {given[0].called(joint)}", given)
    _style.legend_below(figure, columns=4)
    return figure


def _look(curve: Curve, order: list[str]) -> dict[str, Any]:
    return (
        {"label": curve.name}
        | _style.series(order.index(curve.name))
        | (_style.FAINT if curve.failed else {})
    )


def _errors(axes: Axes, curves: list[Curve], order: list[str], joint: int, window: Window) -> None:
    """Every law's |e1|, and the tolerance that its settling is measured by."""
    start = 0.0
    for curve in curves:
        size = np.abs(curve["e1"][:, joint])
        near = curve.t[: len(size)] <= window[1]
        t, shown = thinned(curve.t[: len(size)][near], np.maximum(size[near], SMALLEST))
        axes.semilogy(t, shown, **_look(curve, order))
        start = max(start, size[0])
    axes.axhline(
        float(Settling().tolerance), color=_style.bound(), linewidth=0.8, zorder=1, label="settled"
    )
    axes.set_xlim(*window)
    axes.set_ylim(SMALLEST, 3.0 * max(start, 10.0 * SMALLEST))
    axes.set_xlabel(_style.label("time $t$", "s"))


def _torques(axes: Axes, curves: list[Curve], order: list[str], joint: int, window: Window) -> None:
    drawn = [draw(axes, curve, "tau", joint, window, **_look(curve, order)) for curve in curves]
    axes.set_xlim(*window)
    axes.set_xlabel(_style.label("time $t$", "s"))
    set_limits(axes, curves, drawn, [])


def _settling(axes: Axes, curves: list[Curve], order: list[str]) -> None:
    """A bar a law, at the same place in both columns; what never settled, or has no factor, has
    none and says so.
    """
    found = {
        curve.name: float(np.max(np.asarray(curve.run.metrics.settling_time))) for curve in curves
    }
    for i, name in enumerate(order):
        if name in found and np.isfinite(found[name]):
            axes.bar(i, found[name], color=_style.series(i)["color"], width=0.7)
        else:
            words = "never" if name in found else "no factor"
            axes.annotate(
                words,
                (i, 0.0),
                xytext=(0, 3),
                textcoords="offset points",
                rotation=90,
                ha="center",
                va="bottom",
                fontsize=_style.size(7),
            )
    axes.set_xlim(-0.6, len(order) - 0.4)
    axes.set_xticks(
        range(len(order)),
        [name.replace("_", " ") for name in order],
        rotation=40,
        ha="right",
        fontsize=_style.size(7),
    )
    axes.grid(axis="x", visible=False)
