"""Figure of a level set that is proved, or not, to be invariant."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from iblf_jax.core import checks
from iblf_jax.plotting import _style
from iblf_jax.plotting._curves import check_class, curves_of, escaped, thinned
from iblf_jax.plotting._panels import quantity_of
from iblf_jax.proofs.result import Proof
from iblf_jax.world import plants

WIDTH = 7.6
RANGES = 2
"""Largest number of intervals that the heading lists."""
RUNS = 6
"""Runs with adversarial parameters that the figure shows."""


@_style.figure_function
def guaranteed_tube(found: Proof, *, runs: int = RUNS) -> Figure:
    """The positions of {V_w <= level} over time, with the bounds, the reference and runs.

    The runs start at points of the level set with parameters at the ends of their intervals.  Of a
    refuted statement, the run that violates the bounds is shown.

    Args:
      found: the result of `ij.prove`.
      runs: number of runs.

    Returns:
      The figure, one row per joint.

    Raises:
      ValueError: not a Proof, or a number of runs that is not a whole number.
    """
    check_class("found", found, Proof, "ij.prove returns one.")
    count = checks.positive_integer("runs", runs, least=0, most=1000)
    tube = found.tube
    names = plants.component_names(found.scenario.plant)
    height = 0.9 + 1.9 * len(names)
    figure, panels = _style.panels(WIDTH, height, len(names))
    shown = found.adversarial_runs(count) if count else []
    starts = "level" if found.start is None else f"{found.start.level:.4g}"
    for i, axes in enumerate(panels):
        for side, text in ((tube.lower_bound, "bounds"), (tube.upper_bound, "_")):
            axes.plot(tube.t, side[:, i], color=_style.bound(), linewidth=1.0, label=text)
        style: dict[str, Any] = {"color": _style.tube(), "linewidth": 0, "zorder": 0}
        axes.fill_between(tube.t, tube.lower[:, i], tube.upper[:, i], label="level set", **style)
        axes.plot(tube.t, tube.reference[:, i], label="reference", **_style.reference())
        for number, run in enumerate(shown):
            label = f"runs from V = {starts}" if number == 0 else "_"
            t, q = thinned(np.asarray(run.t), np.asarray(run.q)[:, i])
            axes.plot(t, q, color=_style.colour(0), linewidth=0.7, alpha=0.8, label=label)
        if found.violation is not None:
            _draw_violation(axes, found, i)
        quantity = quantity_of(found.scenario, "q", i)
        axes.set_ylabel(f"{escaped(names[i])}\n{_style.label(quantity.symbol, quantity.unit)}")
        axes.margins(x=0)
    panels[-1].set_xlabel(_style.label("$t$", "s"))
    colour = _style.text_colour() if found.violation is None else _style.failure()
    _style.set_heading(figure, [_heading(found)], color=colour)
    _style.legend_below(figure, 3)
    return figure


def _heading(found: Proof) -> str:
    level = f"$V_w \\leq$ {found.level:.4g}"
    if found.start is not None:
        level += f" from $V_w \\leq$ {found.start.level:.4g}"
    ranges = [f"{path} {low:.4g} to {high:.4g}" for path, (low, high) in found.ranges.items()]
    if len(ranges) > RANGES:
        ranges = [f"{len(ranges)} uncertain parameters"]
    words = escaped(", ".join([*ranges, str(found.verdict)]))
    return f"{level}: {words}"


def _draw_violation(axes: Axes, found: Proof, i: int) -> None:
    """The run that refutes the statement, at the times of its start; in red for the joint that
    leaves its bounds.
    """
    (curve,) = curves_of(found.replay())
    assert found.violation is not None
    t = curve.t[: curve.samples] + found.violation.state.t
    shown = t <= found.duration
    style: dict[str, Any] = {"color": _style.blend(0.733), "linewidth": 1.2}
    style["label"] = "run that refutes the statement"
    if curve.exit_index("q", i) is not None:
        style |= {"color": _style.failure(), "label": "joint that violates its bounds"}
    axes.plot(t[shown], curve["q"][shown, i], **style)
