"""The figure of a comparison: error, torque and settling time of every law, at the given gains and
at equal effort, side by side.

The error has a logarithmic axis, on which an exponential decay is a straight line whose slope is
its rate.  The torque is shown for a tenth of that time if the laws differ most there, because its
transient, 1/K2 against 1/k1, is much shorter.  The titles of the panels state why a window shows
the start, and the range of the signal after it.  Both torque panels have one axis, which shows the
torques of all runs without a failure; a panel whose axis clips a torque states its peak.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from iblf_jax.plotting import _style
from iblf_jax.plotting._curves import (
    Curve,
    check_class,
    check_joint,
    curves_of,
    escaped,
    thinned,
)
from iblf_jax.plotting._figures import PanelRow, windows, zoom_reason
from iblf_jax.plotting._panels import (
    Window,
    annotate_clipped_peak,
    draw,
    quantity_of,
    range_after,
    set_limits,
)
from iblf_jax.studies.comparison import Comparison
from iblf_jax.world import plants

SMALLEST = 1e-5
"""Errors below this, in the unit of the error, are drawn at the lower end of the logarithmic
axis."""

TORQUE_SHARE = 0.1
"""Time that the torque panel shows, as a share of the time of the error panel, if the torques
differ most there."""


@_style.figure_function
def comparison(result: Comparison, joint: int | str = 0, *, zoom: float | None = None) -> Figure:
    """Error |e1| and torque of one joint during the transient, and the settling time of every law
    (worst joint).

    One column shows the given gains and, if the comparison has factors, another one equal effort; a
    law has the same colour in both.

    Args:
      result: the result of `iblf_jax.compare`.
      joint: which joint, from 0, or its name.
      zoom: length of the start that is shown [s]; 2.5 transients of the error if not given.

    Returns:
      The figure.

    Raises:
      ValueError: not a Comparison, no such joint, or a zoom that is not a positive number.
    """
    check_class("result", result, Comparison, "Draw what ij.compare returns.")
    given = curves_of(result.rollouts)
    joint = check_joint(given, joint)
    scenario = given[0].run.scenario
    quantity = quantity_of(scenario, "e1", joint)
    error = PanelRow(quantity, joint, quantity.label)
    start, end = windows(given, [error], zoom)[1]
    columns = {"gains as given": given}
    if result.factors:
        effort = scenario.loop.plant.notation.effort
        columns[f"equal effort (RMS {effort})"] = curves_of(result.equal_effort)
    torque = PanelRow(quantity_of(scenario, "tau", joint), joint, "")
    shown = [curve for curves in columns.values() for curve in curves]
    figure = _style.new_figure(_style.WIDTH, 7.0)
    table = figure.subplots(
        3, len(columns), squeeze=False, sharey="row", height_ratios=(1.5, 1.5, 1.0)
    )
    order = list(result.rollouts)
    torques: list[tuple[Axes, Curve, np.ndarray]] = []
    for column, (title, curves) in zip(table.T, columns.items(), strict=True):
        column[0].set_title(title)
        _errors(column[0], curves, order, joint, (start, end))
        tolerance = np.broadcast_to(result.settling.tolerance, result.scenario.n)[joint]
        line = {"color": _style.bound(), "linewidth": 0.8, "zorder": 1, "label": "settled"}
        column[0].axhline(tolerance, **line)
        _name_window(column[0], curves, error, end, zoom_reason(curves, [error], end))
        reason = zoom_reason(curves, [torque], end)
        torque_end = end
        if _differ_most_before(shown, joint, TORQUE_SHARE * end):
            torque_end = TORQUE_SHARE * end
            reason = f"first {torque_end:.3g} s: the laws differ most"
        torques += _torques(column[1], curves, order, torque, (start, torque_end))
        _name_window(column[1], curves, torque, torque_end, reason)
        _settling(column[2], curves, order)
    drawn = [y for _, _, y in torques]
    set_limits(table[1, 0], [curve for _, curve, _ in torques], drawn, [], torque.quantity)
    for axes in table[1]:
        own = [(curve, y) for panel, curve, y in torques if panel is axes]
        curves, samples = (list(x) for x in zip(*own, strict=True))
        annotate_clipped_peak(axes, curves, samples, torque.quantity, [joint] * len(own))
    # In a paper the caption says it, which knows the joint only if the figure names it.
    of_joint = of_worst = ""
    if _style.in_paper():
        of_joint = f" of {escaped(plants.components_in_words(scenario.plant)[joint])}"
        of_worst = f" of the worst {plants.component_noun(scenario.plant)}"
    table[0, 0].set_ylabel(_style.label(f"error $|e_1|${of_joint}", quantity.unit))
    tau = torque.quantity
    table[1, 0].set_ylabel(_style.label(f"{tau.name} {tau.symbol}{of_joint}", tau.unit))
    table[2, 0].set_ylabel(_style.label(f"settling{of_worst}", "s"))
    figure.align_ylabels(table[:, 0])
    _style.set_title(figure, f"Laws compared: {given[0].joint_label(joint)}", given)
    _style.legend_below(figure, columns=4)
    return figure


def _law_style(curve: Curve, order: list[str]) -> dict[str, Any]:
    style = _style.series(order.index(curve.name)) | {"label": curve.name}
    if curve.failed:
        style |= _style.FAINT
    return style


def _differ_most_before(curves: list[Curve], joint: int, end: float) -> bool:
    """Whether the torques of the laws without failure differ most before a time [s]."""
    successful = [curve for curve in curves if not curve.failed]
    if not successful:
        return True
    t = successful[0].t
    torques = [curve.at("tau", t)[:, joint] for curve in successful]
    return bool(t[np.argmax(np.ptp(torques, axis=0))] <= end)


def _name_window(axes: Axes, curves: list[Curve], row: PanelRow, end: float, reason: str) -> None:
    """Adds the reason for the window of a panel, and the range of its quantity after the window, to
    its title; in a paper the caption says it.
    """
    if _style.in_paper():
        return
    words = ",\n".join(filter(None, [reason, range_after(curves, row.quantity, row.joint, end)]))
    axes.set_title("\n".join(filter(None, [axes.get_title(), words])))


def _errors(axes: Axes, curves: list[Curve], order: list[str], joint: int, window: Window) -> None:
    """The error |e1| of every law."""
    start = 0.0
    for curve in curves:
        error = np.abs(curve["e1"][:, joint])
        t = curve.t[: len(error)]
        shown = t <= window[1]
        points = thinned(t[shown], np.maximum(error[shown], SMALLEST))
        axes.semilogy(*points, **_law_style(curve, order))
        start = max(start, error[0])
    axes.set_ylim(SMALLEST, 3.0 * max(start, 10.0 * SMALLEST))
    _style.time_axis(axes, window)


def _torques(
    axes: Axes, curves: list[Curve], order: list[str], row: PanelRow, window: Window
) -> list[tuple[Axes, Curve, np.ndarray]]:
    """The torque of every law; returns what is drawn of each."""
    drawn = []
    for curve in curves:
        y = draw(axes, curve, "tau", row.joint, window, **_law_style(curve, order))
        drawn.append((axes, curve, y))
    _style.time_axis(axes, window)
    return drawn


def _settling(axes: Axes, curves: list[Curve], order: list[str]) -> None:
    """One bar per law, at the same place in both columns; a text for a law that never settled or
    has no factor.
    """
    small: dict[str, Any] = {"fontsize": _style.size(7)}
    instead: dict[str, Any] = {"xytext": (0, 3), "textcoords": "offset points", "rotation": 90}
    instead |= {"ha": "center", "va": "bottom", **small}
    by_name = {curve.name: np.max(np.asarray(curve.run.metrics.settling_time)) for curve in curves}
    for i, name in enumerate(order):
        if name not in by_name:
            axes.annotate("no factor", (i, 0.0), **instead)
        elif not np.isfinite(by_name[name]):
            axes.annotate("never", (i, 0.0), **instead)
        else:
            axes.bar(i, float(by_name[name]), color=_style.colour(i), width=0.7)
    axes.set_xlim(-0.6, len(order) - 0.4)
    names = [name.replace("_", " ") for name in order]
    axes.set_xticks(range(len(order)), names, rotation=40, ha="right", **small)
    axes.grid(axis="x", visible=False)
