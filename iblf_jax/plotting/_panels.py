"""Draws one panel of a figure: a quantity of every run against time, with its bounds.

`QUANTITIES` describes each panel as data; `show` draws one.  Axis limits follow the bounds where a
quantity has bounds, so that a run that leaves them is clipped at the edge and does not flatten the
others.  Elsewhere the limits follow the runs, without the outliers of failed runs.  A panel whose
limits clip a signal states the signal's peak.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.typing import ColorType

from iblf_jax.core.units import per_second
from iblf_jax.plotting import _style
from iblf_jax.plotting._curves import (
    WITHOUT_JOINT,
    Curve,
    Peak,
    distinct,
    escaped,
    peak_of,
    rounding_error,
    thinned,
)
from iblf_jax.plotting._style import FAINT, label, series
from iblf_jax.simulation.scenario import Scenario
from iblf_jax.simulation.signals import has
from iblf_jax.simulation.units import signal_unit, unit_text
from iblf_jax.world import plants

Window = tuple[float, float]

FARTHEST_BOUND = 20.0
"""Bounds farther from the runs than this [rad] do not set the limits of an axis."""

OUTLIER_RATIO = 40.0
"""The axis excludes the outliers of a failed run whose range is wider than this many times its
median deviation."""

NOISE_BLOCKS = 80
"""Number of blocks in which a noise is drawn as a band."""
NOISE_REVERSALS = 0.3
"""Share of the steps of a noise that change their sign, at least; white noise has 2/3."""
NOISE_CROSSINGS = 4.0
"""Or a noise passes its range in a block at least so many times: one that a sampled law holds moves
smoothly between the samples, and its steps rarely change their sign."""
NOISE_SIZE = 0.03
"""Typical range of a noise in a block, as a share of the range of the signal, at least."""

SPIKE_FREE_SHARE = 0.98
SPIKE_RATIO = 5.0
"""The axis excludes the spikes of a signal whose full range is wider than SPIKE_RATIO times the
range in which it is for SPIKE_FREE_SHARE of the time."""


@dataclass(frozen=True)
class PanelQuantity:
    """The quantity that a panel shows, its labels, and the signals drawn with it."""

    field: str
    """The signal of the run."""
    name: str
    symbol: str
    unit: str
    bounds: tuple[str, str] | None = None
    """The signals that bound it."""
    bounds_label: str = "bounds"
    guide: str | None = None
    """The signal that the quantity should follow; it is drawn once for all runs."""
    guide_label: str = ""
    guide_sets_limits: bool = False
    """Whether the limits of the axis follow the guide where there are no bounds."""
    truth: str | None = None
    """The signal that the quantity estimates.  It is drawn as a broad pale line under them, and
    only once if it is the same in all runs."""
    measured: str = ""
    """The signal that is a measurement or an estimate of the quantity, which the law received."""
    transient: str = ""
    """The signal whose transient a zoom shows, an error; that of the quantity itself if empty."""
    transient_symbol: str = ""
    """The symbol of this signal."""
    has_spikes: bool = False
    """Whether an axis that shows all joints clips short peaks."""
    farthest_bound: float = FARTHEST_BOUND
    """Bounds farther from the runs do not set the limits of the axis, in the unit."""

    @property
    def label(self) -> str:
        """The label of the axis."""
        return label(f"{self.name} {self.symbol}", self.unit)

    @property
    def estimate_symbol(self) -> str:
        """The symbol of an estimate of the quantity."""
        return rf"$\hat {self.symbol.strip('$')}$"


QUANTITIES = {
    quantity.field: quantity
    for quantity in (
        PanelQuantity(
            "q",
            "position",
            "$q$",
            "rad",
            bounds=("lower", "upper"),
            guide="q_d",
            guide_label="reference $q_d$",
            measured="measured_q",
            transient="e1",
            transient_symbol="$e_1$",
        ),
        PanelQuantity("e1", "error", "$e_1$", "rad", bounds=("error_lower", "error_upper")),
        PanelQuantity(
            "xi",
            "relative error",
            r"$\xi$",
            "1",
            bounds=("xi_lower", "xi_upper"),
            bounds_label=r"bounds $\xi = \pm 1$",
        ),
        PanelQuantity("e2", "error", "$e_2$", "rad/s"),
        PanelQuantity(
            "dq",
            "velocity",
            r"$\dot q$",
            "rad/s",
            bounds=("dq_lower", "dq_upper"),
            guide="dq_d",
            guide_label=r"reference $\dot q_d$",
            measured="measured_dq",
        ),
        PanelQuantity(
            "theta",
            "estimate",
            r"$\hat\theta$",
            "",
            bounds=("theta_lower", "theta_upper"),
            guide="theta_of_plant",
            guide_label="value of the plant",
        ),
        PanelQuantity(
            "region_margin", "distance", "$h$", "m", guide="region_boundary", guide_label="boundary"
        ),
        PanelQuantity("tau", "torque", r"$\tau$", "N m", has_spikes=True),
        PanelQuantity(
            "disturbance_estimate",
            "uncertain term",
            "$f$",
            "N m",
            truth="disturbance",
            transient="estimate_error",
            transient_symbol=r"$f - \hat f$",
            has_spikes=True,
        ),
    )
}
"""Signal -> the panel that shows it; `quantity_of` has the names and units of a plant."""

VIRTUAL_CONTROL = r"virtual control $\alpha_{i-1}$"
"""The label of the signal that a level above the first should follow."""

UNRELATED_TO_LEVELS = ("xi", "region_margin", "theta")
"""Panels that do not depend on the plant."""


def quantity_of(scenario: Scenario, field: str, joint: int | None = None) -> PanelQuantity:
    """The panel of a signal with the names and units of the plant.

    Args:
      scenario: any.
      field: a key of `QUANTITIES`.
      joint: the component whose unit is shown; None for the units of all components.
    """
    quantity, plant = QUANTITIES[field], scenario.loop.plant
    if field in UNRELATED_TO_LEVELS:
        return quantity
    changed: dict[str, Any] = {"unit": signal_unit(scenario, field, joint)}
    notation, names = plant.notation, plants.level_names(plant)
    first, second = notation.symbols
    if field == "q":
        guide_label = f"reference ${notation.reference}$"
        changed |= {"name": names[0], "symbol": f"${first}$", "guide_label": guide_label}
    if field == "dq":
        changed |= {"name": names[1], "symbol": f"${second}$"}
        if plant.reference_levels == 1:
            alpha = {"guide": "alpha", "guide_label": VIRTUAL_CONTROL, "guide_sets_limits": True}
            changed |= alpha
    if field == "tau":
        changed |= {"name": plants.input_name(plant), "symbol": f"${notation.input}$"}
    if plant.robot is None:
        changed["farthest_bound"] = np.inf
    return dataclasses.replace(quantity, **changed)


def level_quantity(scenario: Scenario, level: int, joint: int | None = None) -> PanelQuantity:
    """The panel of one level, counted from 1, of a plant in strict-feedback form; other arguments
    as `quantity_of`.
    """
    if level <= 2:
        return quantity_of(scenario, ("q", "dq")[level - 1], joint)
    plant = scenario.plant
    return PanelQuantity(
        f"level_{level}",
        plants.level_names(plant)[level - 1],
        f"$x_{{{level}}}$",
        unit_text(scenario, plants.units_of(plant)[level - 1], joint),
        bounds=(f"level_{level}_lower", f"level_{level}_upper"),
        guide=f"level_{level}_alpha",
        measured=f"level_{level}_received",
        guide_label=VIRTUAL_CONTROL,
        guide_sets_limits=True,
        farthest_bound=np.inf,
    )


def disturbance_quantity(scenario: Scenario, level: int, joint: int | None = None) -> PanelQuantity:
    """The panel of the disturbance of one level and of its estimate; arguments as
    `level_quantity`.
    """
    return PanelQuantity(
        f"level_{level}_estimate",
        "disturbance",
        f"$d_{{{level}}}$",
        unit_text(scenario, per_second(plants.units_of(scenario.plant)[level - 1]), joint),
        truth=f"level_{level}_d",
        transient=f"level_{level}_estimate_error",
        transient_symbol=rf"$d_{{{level}}} - \hat d_{{{level}}}$",
        has_spikes=True,
    )


def draw(
    axes: Axes, curve: Curve, field: str, joint: int, window: Window, **options: Any
) -> np.ndarray:
    """Draws one signal of one joint within a window of time; returns its samples there."""
    y = curve[field][:, joint]
    t = curve.t[: len(y)]
    in_window = (t >= window[0]) & (t <= window[1])
    shown_t, shown_y = thinned(t[in_window], y[in_window])
    if len(shown_t) == 1:
        options.setdefault("marker", ".")
    if curve.is_sampled(field):
        options.setdefault("drawstyle", "steps-post")
    band = noise_band(t[in_window], y[in_window])
    if band is not None:
        shown_t, low, high, shown_y = band
        draw_band(axes, shown_t, low, high, options)
        options["drawstyle"] = "default"
    axes.plot(shown_t, shown_y, **options)
    return y[in_window]


def draw_band(
    axes: Axes, t: np.ndarray, low: np.ndarray, high: np.ndarray, options: dict[str, Any]
) -> None:
    """Draws the range of a noise in the colour of its line."""
    colour = options.get("color", _style.colour(0))
    alpha = 0.3 * (options.get("alpha") or 1.0)
    axes.fill_between(t, low, high, color=colour, alpha=alpha, linewidth=0, zorder=1.7)


def noise_band(t: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, ...] | None:
    """Times, lowest and highest values and means of the blocks of a noise, which a line would fill;
    None for a signal without noise.

    A signal is a noise if at least NOISE_REVERSALS of its steps change their sign, or if it passes
    its range in a block at least NOISE_CROSSINGS times; its blocks must have several samples each,
    and its typical range in a block must be visible.
    """
    if len(y) < 4 * NOISE_BLOCKS or not np.all(np.isfinite(y)):
        return None
    steps = np.diff(y)
    jumps = steps[steps != 0.0]  # A held sample changes nothing.
    if len(jumps) < 2 * NOISE_BLOCKS:
        return None
    starts = np.linspace(0, len(y), NOISE_BLOCKS + 1).astype(int)
    low, high = (f.reduceat(y, starts[:-1]) for f in (np.minimum, np.maximum))
    path = np.add.reduceat(np.append(np.abs(steps), 0.0), starts[:-1])
    crosses = np.median(path) >= NOISE_CROSSINGS * np.median(high - low)
    if not crosses and np.mean(jumps[1:] * jumps[:-1] < 0.0) < NOISE_REVERSALS:
        return None
    if np.median(high - low) < NOISE_SIZE * np.ptp(y):
        return None
    sizes = np.diff(starts)
    middle, mean = (np.add.reduceat(x, starts[:-1]) / sizes for x in (t, y))
    return middle, low, high, mean


def draw_bounds(
    axes: Axes, curve: Curve, quantity: PanelQuantity, joint: int, window: Window, **options: Any
) -> list[np.ndarray]:
    """Draws the bounds of a quantity as grey lines with a pale band between them; returns them."""
    if quantity.bounds is None or not np.isfinite(curve[quantity.bounds[0]]).any():
        return []
    style = {"color": _style.bound(), "linewidth": 1.0, "zorder": 1.8} | options
    style.setdefault("label", quantity.bounds_label)
    low_field, high_field = quantity.bounds
    lower, upper = curve[low_field][:, joint], curve[high_field][:, joint]
    step = max(1, len(curve.t) // 500)
    band = (curve.t[::step], lower[::step], upper[::step])
    axes.fill_between(*band, color=_style.tube(), linewidth=0, zorder=0)
    drawn_lower = draw(axes, curve, low_field, joint, window, **style)
    style["label"] = "_"
    return [drawn_lower, draw(axes, curve, high_field, joint, window, **style)]


def _span(arrays: Iterable[np.ndarray]) -> tuple[float, float] | None:
    """Lowest and highest finite value; None if there is none."""
    finite = [y[np.isfinite(y)] for y in arrays]
    finite = [y for y in finite if y.size]
    if not finite:
        return None
    return float(min(y.min() for y in finite)), float(max(y.max() for y in finite))


def _without_outliers(y: np.ndarray) -> np.ndarray:
    """The finite values of a failed run without its outliers."""
    finite = y[np.isfinite(y)]
    if not finite.size:
        return finite
    median = np.median(finite)
    deviation = np.median(np.abs(finite - median))
    if np.ptp(finite) <= OUTLIER_RATIO * deviation:
        return finite
    return finite[np.abs(finite - median) <= max(0.25 * OUTLIER_RATIO * deviation, 1e-12)]


def _without_spikes(y: np.ndarray) -> np.ndarray:
    """The finite values, or the ends of an axis that clips the spikes of a signal."""
    finite = y[np.isfinite(y)]
    if finite.size < 10:
        return finite
    usual = np.quantile(finite, [0.5 - 0.5 * SPIKE_FREE_SHARE, 0.5 + 0.5 * SPIKE_FREE_SHARE])
    width = float(np.ptp(usual))
    if 0.0 < SPIKE_RATIO * width < np.ptp(finite):
        return usual + 0.5 * width * np.array([-1.0, 1.0])
    return finite


def set_limits(
    axes: Axes,
    curves: Sequence[Curve],
    drawn: Sequence[np.ndarray],
    always_shown: Sequence[np.ndarray],
    quantity: PanelQuantity,
    *,
    spikes: bool = False,
) -> None:
    """Sets the limits of the vertical axis.

    The axis shows the bounds and the reference, or the successful runs where there are none, and
    the remaining signals up to 40 % beyond.  A panel that would show only rounding errors says that
    the quantity is zero.

    Args:
      axes: the panel.
      curves: the runs, in the order of `drawn`.
      drawn: the drawn samples of each run.
      always_shown: bounds and reference; empty if there are none.
      quantity: the quantity of the panel; bounds farther from the runs than its `farthest_bound` do
        not set the limits.
      spikes: clip short peaks.
    """
    successful, failed = [], []
    for curve, y in zip(curves, drawn, strict=True):
        if spikes:
            y = _without_spikes(y)
        if curve.failed:
            failed.append(_without_outliers(y))
        else:
            successful.append(y)
    low, high = _span([*successful, *failed]) or (-1.0, 1.0)
    farthest = quantity.farthest_bound
    near = [y[(y > low - farthest) & (y < high + farthest)] for y in always_shown]
    base = _span(near) or _span(successful)
    if base:
        room = 0.4 * (base[1] - base[0])
        low = min(base[0], max(low, base[0] - room))
        high = max(base[1], min(high, base[1] + room))
    rounding = rounding_error(curves, quantity.field)
    if max(abs(low), abs(high)) <= rounding:
        say_zero(axes, max(abs(low), abs(high)), quantity.symbol, quantity.unit)
        return
    margin = 0.06 * (high - low)
    if high - low <= rounding:
        margin = 0.1 * abs(high)
    axes.set_ylim(low - margin, high + margin)


def say_zero(axes: Axes, largest: float, symbol: str, unit: str) -> None:
    """Writes into a panel that its quantity is zero, on an axis that does not magnify rounding
    errors.

    Args:
      axes: the panel.
      largest: the largest size of the quantity, which is a rounding error.
      symbol, unit: of the quantity.
    """
    axes.set_yscale("linear")
    axes.set_ylim(-1.0, 1.0)
    axes.set_yticks([0.0])
    words = "zero"
    if largest > 0.0:
        words += f"\n({at_most(symbol, rounded_away(largest))} {unit} is rounding)"
    centred: dict[str, Any] = {"transform": axes.transAxes, "ha": "center", "va": "center"}
    axes.text(0.5, 0.75, words, fontsize=_style.size(7.5), **centred)


def annotate_clipped_peak(
    axes: Axes,
    curves: Sequence[Curve],
    drawn: Sequence[np.ndarray],
    quantity: PanelQuantity,
    joints: Sequence[int],
) -> None:
    """Writes the largest clipped value, with its sign, joint and time, into a panel.

    Args:
      axes: the panel, with its limits.
      curves: the runs, in the order of `drawn`.
      drawn: the drawn samples of each run, from the first one on.
      quantity: the quantity of the panel.
      joints: the joint of each of `drawn`.
    """
    low, high = axes.get_ylim()
    found = []
    for curve, y, joint in zip(curves, drawn, joints, strict=True):
        outside = np.flatnonzero(np.isfinite(y) & ((y < low) | (y > high)))
        if outside.size:
            i = outside[np.argmax(np.abs(y[outside]))]
            found.append((Peak(float(y[i]), joint, float(curve.t[i])), curve))
    if found:
        peak, curve = max(found, key=lambda one: abs(one[0].value))
        back = {"facecolor": _style.background(), "edgecolor": "none", "alpha": 0.85, "pad": 1.0}
        where: dict[str, Any] = {"transform": axes.transAxes, "ha": "right", "va": "top"}
        where |= {"fontsize": _style.size(7.5), "zorder": 6}
        words = peak_in_words(curve, peak, quantity)
        axes.text(0.98, 0.97, words, bbox=back, **where)


def peak_in_words(curve: Curve, peak: Peak, quantity: PanelQuantity) -> str:
    """A peak with its sign, its joint, its time and the name of its run, for a figure; of a paper
    the value only.
    """
    if _style.in_paper():
        return f"peak {signed(float(f'{peak.value:.3g}'))} {quantity.unit}"
    parts = [f"peak {signed(peak.value)} {quantity.unit}"]
    if curve.name:
        parts.append(escaped(curve.name))
    if quantity.field not in WITHOUT_JOINT:
        parts.append(curve.joint_label(peak.joint))
    return ", ".join([*parts, f"t = {peak.t:.4g} s"])


PEAKS = ("e1", "e2", "tau")
"""The signals of which tables list the peaks."""


def peak_rows(curve: Curve) -> list[tuple[str, str, str, str, str]]:
    """The peaks of errors and torque of every joint, for a table: signal, unit, joint, value with
    its sign, and time [s].
    """
    rows = []
    for field in PEAKS:
        for joint in range(curve.run.n):
            peak = peak_of(curve, field, [joint])
            unit = quantity_of(curve.run.scenario, field, joint).unit
            if peak is not None:
                numbers = (f"{peak.value:.4g}", f"{peak.t:.4g}")
                rows.append((field, unit, curve.joint_label(joint), *numbers))
    return rows


def signed(value: float, digits: int = 5) -> str:
    """A number with a typographic minus sign."""
    return f"{value:.{digits}g}".replace("-", "\N{MINUS SIGN}")


def _draw_bounds_and_guide(
    axes: Axes, curves: Sequence[Curve], quantity: PanelQuantity, joint: int, window: Window
) -> tuple[list, list]:
    """Draws bounds and guide, once for all runs that share them; returns the samples of the two."""
    bounds: list = []
    guides: list = []
    fields = [field for field in (*(quantity.bounds or ()), quantity.guide) if field]
    if not fields:
        return bounds, guides
    for i, curve in enumerate(distinct(curves, fields, [joint])):
        own: dict[str, Any] = {}
        if i > 0:
            own = {"color": series(curves.index(curve))["color"], "alpha": 0.6}
        bounds += draw_bounds(axes, curve, quantity, joint, window, **own)
        if quantity.guide and not np.isnan(curve[quantity.guide]).all():
            style = _style.reference() | {"zorder": 3, "label": quantity.guide_label} | own
            guides.append(draw(axes, curve, quantity.guide, joint, window, **style))
    return bounds, guides


def _draw_truth(
    axes: Axes, curves: Sequence[Curve], quantity: PanelQuantity, joint: int, window: Window
) -> list[tuple[Curve, np.ndarray]]:
    """Draws the estimated signal, once if it is the same in all runs; returns its samples."""
    if quantity.truth is None:
        return []
    several = distinct(curves, [quantity.truth], [joint])
    drawn = []
    for curve in several:
        style = _style.underlay() | {"label": quantity.symbol}
        if len(several) > 1:
            style |= {"color": series(curves.index(curve))["color"], "alpha": 0.3}
            style["label"] = f"{curve.name} {quantity.symbol}"
        drawn.append((curve, draw(axes, curve, quantity.truth, joint, window, **style)))
    return drawn


def _draw_measured(
    axes: Axes, curves: Sequence[Curve], quantity: PanelQuantity, joint: int, window: Window
) -> list[tuple[Curve, np.ndarray]]:
    """Draws the measurements as pale lines under the signals; returns their samples."""
    drawn = []
    for i, curve in enumerate(curves):
        has_values = quantity.measured and curve.is_measured
        if has_values and not np.isnan(curve[quantity.measured]).all():
            word = "received by the law" if curve.is_estimated else "measured"
            style: dict[str, Any] = {"label": f"{curve.name} {word}".strip()}
            style |= {"color": _style.blend(0.45, series(i)["color"])}
            style |= {"linewidth": 0.8, "zorder": 1.9}
            drawn.append((curve, draw(axes, curve, quantity.measured, joint, window, **style)))
    return drawn


MAX_MARKS = 200
"""More events than this in a window are not marked: the marks would cover the curve."""


def _mark_events(axes: Axes, curve: Curve, joint: int, window: Window, color: ColorType) -> None:
    """Marks the instants at which an event trigger sent a command."""
    run = curve.run
    if not has(run, "events"):
        return
    t, number = np.asarray(run.t), np.asarray(run.events)
    sent = np.diff(number, prepend=0.0) > 0.5
    at = np.flatnonzero(sent & (t >= window[0]) & (t <= window[1]))
    if not 0 < at.size <= MAX_MARKS:
        return
    style: dict[str, Any] = {"linestyle": "none", "marker": "o", "markersize": 3.0, "zorder": 3}
    axes.plot(t[at], np.asarray(run.tau)[at, joint], color=color, **style)


def show(
    axes: Axes,
    curves: Sequence[Curve],
    quantity: PanelQuantity,
    joint: int,
    window: Window,
    *,
    tight: bool = False,
) -> None:
    """Draws a quantity of one joint for every run.

    Args:
      axes: the panel.
      curves: the runs.
      quantity: the quantity to draw.
      joint: index of the joint.
      window: first and last time [s].
      tight: let the limits follow runs and reference, not the bounds (for a zoom).
    """
    bounds, guides = _draw_bounds_and_guide(axes, curves, quantity, joint, window)
    drawn = _draw_truth(axes, curves, quantity, joint, window)
    drawn += _draw_measured(axes, curves, quantity, joint, window)
    for i, curve in enumerate(curves):
        style = run_style(curves, i)
        style["label"] = curve.name or quantity.symbol
        if quantity.truth:
            style["label"] = f"{curve.name} {quantity.estimate_symbol}".strip()
        drawn.append((curve, draw(axes, curve, quantity.field, joint, window, **style)))
        if quantity.field == "tau":
            _mark_events(axes, curve, joint, window, style["color"])
    axes.set_xlim(*window)
    owners = [curve for curve, _ in drawn]
    samples = [y for _, y in drawn]
    kept = [y for curve, y in drawn if not curve.failed]
    always_shown: list = []
    if quantity.guide_sets_limits and not bounds:
        always_shown = guides + kept
    if bounds and tight:
        always_shown = guides + kept
    elif bounds:
        always_shown = guides + bounds
    set_limits(axes, owners, samples, always_shown, quantity)
    if not tight:
        annotate_clipped_peak(axes, owners, samples, quantity, [joint] * len(samples))
    for curve in curves:
        if not curve.failed:
            continue
        # A cross where the joint left its bounds, at the edge of the panel if it is outside.
        index = curve.exit_index(quantity.field, joint)
        y = curve[quantity.field][:, joint]
        if index is not None and window[0] <= curve.t[index] <= window[1] and np.isfinite(y[index]):
            style = {"marker": "x", "markersize": 7, "markeredgewidth": 2}
            style |= {"linestyle": "none", "zorder": 5, "clip_on": False}
            height = np.clip(y[index], *axes.get_ylim())
            axes.plot(curve.t[index], height, color=_style.failure(), **style)


def run_style(curves: Sequence[Curve], index: int) -> dict[str, Any]:
    """Colour and line of a run; a failed run among others is drawn faint."""
    if curves[index].failed and len(curves) > 1:
        return series(index) | FAINT
    return series(index)


def transient_end(curves: Sequence[Curve], quantity: PanelQuantity, joint: int) -> float:
    """Time [s] after which all successful runs stay within 5 % of the range of their second half;
    0 if they start in it, or differ from it by rounding errors.
    """
    ends = [0.0]
    for curve in curves:
        y = curve[quantity.transient or quantity.field][:, joint]
        half = len(y) // 2
        if curve.failed or half < 2 or not np.isfinite(y).all():
            continue
        room = max(0.05 * np.ptp(y), rounding_error([curve], quantity.field))
        low, high = y[half:].min() - room, y[half:].max() + room
        outside = np.flatnonzero((y[:half] < low) | (y[:half] > high))
        if outside.size:
            ends.append(float(curve.t[outside[-1]]))
    return max(ends)


ERRORS = ("e1", "e2", "xi")
"""Quantities that should be zero."""


def range_after(curves: Sequence[Curve], quantity: PanelQuantity, joint: int, time: float) -> str:
    """The range of a quantity, or of the error whose transient its zoom shows, after a time, in
    words; empty if no successful run continues after it.
    """
    field = quantity.transient or quantity.field
    values = []
    for curve in curves:
        y = curve[field][:, joint]
        later = y[curve.t[: len(y)] > time]
        if not curve.failed:
            values.append(later)
    span = _span(values)
    if span is None:
        return ""
    low, high = span
    largest = max(abs(low), abs(high))
    unit = quantity.unit.removeprefix("1")
    if largest <= rounding_error(curves, quantity.field):
        return "then zero"
    if quantity.transient or field in ERRORS:
        symbol = quantity.transient_symbol or quantity.symbol
        return f"then {at_most(symbol, rounded_away(largest))} {unit}".rstrip()
    ends = f"{signed(low, 3)} to {signed(high, 3)}"
    return f"then {ends} {unit}".rstrip()


def at_most(symbol: str, size: str) -> str:
    """The statement that a quantity is at most of a size, as one formula."""
    inside = symbol.strip("$").strip("|")
    return rf"$|{inside}| \leq$ {size}"


def rounded_away(value: float) -> str:
    """A size in two digits that is not below it."""
    if value == 0.0:
        return "0"
    place = math.floor(math.log10(value)) - 1
    return f"{math.ceil(value / 10.0**place - 1e-9) * 10.0**place:.2g}"
