"""One panel of a figure: a quantity of every run against time, with what frames it, and axis limits
that stay readable.

`QUANTITIES` describes each panel as data; `show` draws one.  Limits follow the bounds where a
quantity has bounds, so that a run that leaves them is cut at the edge instead of flattening all
others; elsewhere they follow the runs, without the outliers of runs that failed.  Where a signal is
cut, the panel says its peak.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from iblf_jax.plotting import _style
from iblf_jax.plotting._curves import Curve, distinct, thinned
from iblf_jax.plotting._style import FAINT, label, series

Window = tuple[float, float]

FAR = 20.0
"""Bounds farther from the runs than this [rad] are no bounds to a picture, and do not set its
limits."""

OUT_OF_PROPORTION = 40.0
"""A failed run's range is cut where it is wider than this many times its median deviation."""

SPIKES, RULING = 0.98, 5.0
"""A sound run's peaks rule an axis where its whole range is wider than RULING times the one that
holds it for this part of the time."""


@dataclass(frozen=True)
class Plotted:
    """What a panel shows."""

    field: str
    """The signal of the run."""
    words: str
    symbol: str
    unit: str
    frame: tuple[str, str] | None = None
    """The signals that bound it."""
    frame_words: str = ""
    guide: str | None = None
    """The signal that it should follow, drawn once for all runs."""
    guide_words: str = ""
    truth: str | None = None
    """The signal that it estimates, drawn broad and pale under it; once, where the runs' cannot be
    told apart."""
    measured: str = ""
    """What a sensor told of it."""
    transient: str = ""
    """The signal whose transient a zoom should show, if not its own."""

    @property
    def label(self) -> str:
        """The label of the axis."""
        return label(f"{self.words} {self.symbol}", self.unit)


QUANTITIES = {
    quantity.field: quantity
    for quantity in (
        Plotted(
            "q",
            "position",
            "$q$",
            "rad",
            ("lower", "upper"),
            "bounds",
            "q_d",
            "reference $q_d$",
            measured="measured_q",
            transient="e1",
        ),
        Plotted("e1", "error", "$e_1$", "rad", ("error_lower", "error_upper"), "bounds"),
        Plotted(
            "xi",
            "relative error",
            r"$\xi$",
            "1",
            ("wall_lower", "wall_upper"),
            r"walls $\xi = \pm 1$",
        ),
        Plotted("e2", "error", "$e_2$", "rad/s"),
        Plotted(
            "dq",
            "velocity",
            r"$\dot q$",
            "rad/s",
            ("dq_lower", "dq_upper"),
            "bounds",
            "dq_d",
            r"reference $\dot q_d$",
            measured="measured_dq",
        ),
        Plotted("region_margin", "distance", "$h$", "m", guide="region_wall", guide_words="wall"),
        Plotted("tau", "torque", r"$\tau$", "N m"),
        Plotted(
            "disturbance_estimate",
            "uncertain term",
            "$f$",
            "N m",
            truth="disturbance",
            transient="estimate_error",
        ),
    )
}
"""Every panel, by the signal that it shows."""


def draw(
    axes: Axes, curve: Curve, field: str, joint: int, window: Window, **options: Any
) -> np.ndarray:
    """Draws one signal of one joint within a window of time; returns what was drawn."""
    y = curve[field][:, joint]
    t = curve.t[: len(y)]
    near = (t >= window[0]) & (t <= window[1])
    shown_t, shown_y = thinned(t[near], y[near])
    marker = {"marker": "."} if len(shown_t) == 1 else {}
    steps = {"drawstyle": "steps-post"} if curve.is_held(field) else {}
    axes.plot(shown_t, shown_y, **(marker | steps | options))
    return y[near]


def draw_frame(
    axes: Axes, curve: Curve, quantity: Plotted, joint: int, window: Window, **options: Any
) -> list[np.ndarray]:
    """Draws the bounds of a quantity as grey lines with a pale tube between them; returns them."""
    if quantity.frame is None or np.isnan(curve[quantity.frame[0]]).all():
        return []
    look = {
        "color": _style.bound(),
        "linewidth": 1.0,
        "zorder": 1.8,
        "label": quantity.frame_words,
    } | options
    lower, upper = (curve[field][:, joint] for field in quantity.frame)
    step = max(1, len(curve.t) // 500)
    axes.fill_between(
        curve.t[::step], lower[::step], upper[::step], color=_style.tube(), linewidth=0, zorder=0
    )
    drawn = [draw(axes, curve, quantity.frame[0], joint, window, **look)]
    return [*drawn, draw(axes, curve, quantity.frame[1], joint, window, **(look | {"label": "_"}))]


def _span(arrays: Iterable[np.ndarray]) -> tuple[float, float] | None:
    """Lowest and highest finite value."""
    finite = [y[np.isfinite(y)] for y in arrays]
    finite = [y for y in finite if y.size]
    if not finite:
        return None
    return float(min(y.min() for y in finite)), float(max(y.max() for y in finite))


def _in_proportion(y: np.ndarray) -> np.ndarray:
    """A failed run's values without those that are out of all proportion to the rest."""
    finite = y[np.isfinite(y)]
    if not finite.size:
        return finite
    middle = np.median(finite)
    deviation = np.median(np.abs(finite - middle))
    if np.ptp(finite) <= OUT_OF_PROPORTION * deviation:
        return finite
    return finite[np.abs(finite - middle) <= max(0.25 * OUT_OF_PROPORTION * deviation, 1e-12)]


def _without_spikes(y: np.ndarray) -> np.ndarray:
    """The range in which a signal is for SPIKES of the time, if the whole one is out of proportion
    to it.
    """
    finite = y[np.isfinite(y)]
    if finite.size < 10:
        return finite
    usual = np.quantile(finite, [0.5 - 0.5 * SPIKES, 0.5 + 0.5 * SPIKES])
    width = float(np.ptp(usual))
    return (
        usual + 0.5 * width * np.array([-1.0, 1.0])
        if 0.0 < RULING * width < np.ptp(finite)
        else finite
    )


def set_limits(
    axes: Axes,
    curves: Sequence[Curve],
    drawn: Sequence[np.ndarray],
    frame: Sequence[np.ndarray],
    *,
    spikes: bool = False,
) -> None:
    """Sets the limits of the vertical axis: the frame, or the sound runs where there is none, and
    the rest up to 40 % beyond.

    Args:
      axes: the panel.
      curves: the runs, in the order of `drawn`.
      drawn: what was drawn of each run.
      frame: bounds and reference; empty if there are none.
      spikes: cut short peaks that would rule the axis.
    """
    if spikes:
        drawn = [_without_spikes(y) for y in drawn]
    spans = [
        _span([_in_proportion(y) if curve.failed else y])
        for curve, y in zip(curves, drawn, strict=True)
    ]
    low, high = _span([np.array([span for span in spans if span])]) or (-1.0, 1.0)
    near = [y[(y > low - FAR) & (y < high + FAR)] for y in frame]
    base = _span(near) or _span(
        [
            np.array(
                [
                    span
                    for span, curve in zip(spans, curves, strict=True)
                    if span and not curve.failed
                ]
            )
        ]
    )
    if base:
        room = 0.4 * (base[1] - base[0])
        low = min(base[0], max(low, base[0] - room))
        high = max(base[1], min(high, base[1] + room))
    margin = 0.06 * (high - low) or max(0.1 * abs(high), 1e-3)
    axes.set_ylim(low - margin, high + margin)


def say_what_is_cut(
    axes: Axes, curves: Sequence[Curve], drawn: Sequence[np.ndarray], unit: str
) -> None:
    """Writes the largest value and its time into a panel whose limits leave it out.

    Args:
      axes: the panel, its limits set.
      curves: the runs, in the order of `drawn`.
      drawn: what was drawn of each run, from its first sample on.
      unit: of the values.
    """
    low, high = axes.get_ylim()
    found = []
    for curve, y in zip(curves, drawn, strict=True):
        outside = np.flatnonzero(np.isfinite(y) & ((y < low) | (y > high)))
        if outside.size:
            i = outside[np.argmax(np.abs(y[outside]))]
            found.append((abs(float(y[i])), float(curve.t[i])))
    if found:
        value, t = max(found)
        back = {"facecolor": _style.paper(), "edgecolor": "none", "alpha": 0.85, "pad": 1.0}
        where: dict[str, Any] = {
            "transform": axes.transAxes,
            "ha": "right",
            "va": "top",
            "fontsize": _style.size(7.5),
            "zorder": 6,
        }
        axes.text(0.98, 0.97, f"peak {value:.5g} {unit} at t = {t:.4g} s", bbox=back, **where)


def _mark_break(axes: Axes, curve: Curve, y: np.ndarray, window: Window) -> None:
    """A cross where a run broke, at the edge of the panel if that is outside of it."""
    index = curve.break_index()
    if index is not None and window[0] <= curve.t[index] <= window[1] and np.isfinite(y[index]):
        look: dict[str, Any] = {
            "marker": "x",
            "markersize": 7,
            "markeredgewidth": 2,
            "linestyle": "none",
        }
        axes.plot(
            curve.t[index],
            np.clip(y[index], *axes.get_ylim()),
            color=_style.alarm(),
            zorder=5,
            clip_on=False,
            **look,
        )


def _draw_surroundings(
    axes: Axes, curves: Sequence[Curve], quantity: Plotted, joint: int, window: Window
) -> tuple[list, list]:
    """Draws bounds and guide, once for all runs that share them; returns the two."""
    bounds, guides = [], []
    fields = [*(quantity.frame or ()), *filter(None, [quantity.guide])]
    for i, curve in enumerate(distinct(curves, fields, [joint]) if fields else []):
        own = {"color": series(curves.index(curve))["color"], "alpha": 0.6} if i else {}
        bounds += draw_frame(axes, curve, quantity, joint, window, **own)
        if quantity.guide:
            look = _style.reference() | {"zorder": 3, "label": quantity.guide_words} | own
            guides.append(draw(axes, curve, quantity.guide, joint, window, **look))
    return bounds, guides


def _draw_truth(
    axes: Axes, curves: Sequence[Curve], quantity: Plotted, joint: int, window: Window
) -> list[tuple[Curve, np.ndarray]]:
    """Draws what the runs estimate, once for all runs in which it cannot be told apart; returns
    it.
    """
    if quantity.truth is None:
        return []
    several = distinct(curves, [quantity.truth], [joint])
    drawn = []
    for curve in several:
        shared = len(several) == 1
        look = _style.pale() | (
            {} if shared else {"color": series(curves.index(curve))["color"], "alpha": 0.3}
        )
        look["label"] = quantity.symbol if shared else f"{curve.name} {quantity.symbol}"
        drawn.append((curve, draw(axes, curve, quantity.truth, joint, window, **look)))
    return drawn


def _draw_measured(
    axes: Axes, curves: Sequence[Curve], quantity: Plotted, joint: int, window: Window
) -> list[tuple[Curve, np.ndarray]]:
    """Draws what the sensors told, pale under what was; returns it."""
    drawn = []
    for i, curve in enumerate(curves):
        if quantity.measured and curve.is_measured:
            name = " ".join(filter(None, [curve.name, "measured"]))
            look: dict[str, Any] = {
                "color": _style.shade(0.45, series(i)["color"]),
                "linewidth": 0.8,
                "zorder": 1.9,
                "label": name,
            }
            drawn.append((curve, draw(axes, curve, quantity.measured, joint, window, **look)))
    return drawn


def show(
    axes: Axes,
    curves: Sequence[Curve],
    quantity: Plotted,
    joint: int,
    window: Window,
    *,
    tight: bool = False,
) -> None:
    """Draws a quantity of one joint for every run.

    Args:
      axes: the panel.
      curves: the runs.
      quantity: what to draw.
      joint: of which joint.
      window: from and to which time [s].
      tight: let the limits follow runs and reference alone, not the bounds (for a zoom).
    """
    bounds, guides = _draw_surroundings(axes, curves, quantity, joint, window)
    drawn = _draw_truth(axes, curves, quantity, joint, window) + _draw_measured(
        axes, curves, quantity, joint, window
    )
    for i, curve in enumerate(curves):
        name = (
            " ".join(filter(None, [curve.name, r"$\hat f$" if quantity.truth else ""]))
            or quantity.symbol
        )
        drawn.append(
            (
                curve,
                draw(
                    axes,
                    curve,
                    quantity.field,
                    joint,
                    window,
                    label=name,
                    **series(i) | (FAINT if curve.failed and len(curves) > 1 else {}),
                ),
            )
        )
    axes.set_xlim(*window)
    frame = guides + ([y for curve, y in drawn if not curve.failed] if tight else bounds)
    set_limits(axes, [c for c, _ in drawn], [y for _, y in drawn], frame if bounds else [])
    if not tight:
        say_what_is_cut(axes, [c for c, _ in drawn], [y for _, y in drawn], quantity.unit)
    for curve in curves:
        if curve.failed:
            _mark_break(axes, curve, curve[quantity.field][:, joint], window)


def transient_end(curves: Sequence[Curve], quantity: Plotted, joint: int) -> float:
    """When the last of the sound runs has come within 5 % of the range that it keeps to later, [s];
    0 if all start there.
    """
    ends = [0.0]
    for curve in curves:
        y = curve[quantity.transient or quantity.field][:, joint]
        half = len(y) // 2
        if curve.failed or half < 2 or not np.isfinite(y).all():
            continue
        room = 0.05 * np.ptp(y)
        outside = np.flatnonzero(
            (y[:half] < y[half:].min() - room) | (y[:half] > y[half:].max() + room)
        )
        ends.append(float(curve.t[outside[-1]]) if outside.size else 0.0)
    return max(ends)
