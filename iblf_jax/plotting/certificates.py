"""The figure of a certificate: the Lyapunov function and its envelope, the left side of the
inequality, and the errors with their bounds.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from iblf_jax.certificates import Certificate, Traces
from iblf_jax.certificates.lines import Line
from iblf_jax.certificates.result import LevelTraces
from iblf_jax.core import checks
from iblf_jax.plotting import _style
from iblf_jax.plotting._curves import ROUNDING, check_class, escaped, thinned
from iblf_jax.plotting._panels import say_zero

WIDTH = 10.0
HEIGHT = 5.4
COLUMNS = 3
LEGEND: dict[str, Any] = {"frameon": True, "framealpha": 0.85, "edgecolor": "none"}


@_style.figure_function
def certificate(
    shown: Certificate, *, title: str | None = None, until: float | None = None
) -> Figure:
    """The figure of `Certificate.plot`, with the verdict in the title.

    It shows V2 with its envelope (3.20) or (3.28); the left side of the differential inequality
    (3.18) or (3.26), which must stay below zero, with the terms that the printed proof drops; and
    xi, |e2| and |f_tilde| with their bounds.  Samples without a claim are left out.  For a law with
    its own claim, V and the left side are those of that claim.  For a plant in strict-feedback form
    it shows V with its envelope (S.4), the left side of (S.3) with its disturbance terms, the error
    of every level with its bounds, and |d_tilde| of every level.

    Args:
      shown: the certificate; of many runs, the figure shows the worst one.
      title: the first line of the title; the subject of the certificate if not given.
      until: last time of the figure [s].

    Returns:
      The figure.

    Raises:
      ValueError: not a Certificate, or `until` before the first samples.
    """
    check_class("shown", shown, Certificate, "Draw what ij.certify returned.")
    traces = shown.traces
    if until is not None:
        keep = traces.t <= checks.positive_number("until", until, "s")
        if np.sum(keep) < 2:
            expected = f"a time after the second sample, {float(traces.t[1]):g} s"
            raise checks.fail("until", until, expected)
        traces = type(traces)(*(x[keep] for x in traces))
    if isinstance(traces, LevelTraces):
        figure = _level_panels(shown, traces)
        subject = "The law's own claim" if shown.is_of_own_claim else "The claim (S.3)"
        _title(figure, shown, traces, title, subject)
        return figure
    subject, V = "Theorem 2", Bounded("Lyapunov function", "$V_2$", "1")
    if shown.is_of_own_claim:
        subject, V = "The law's own claim", Bounded("Lyapunov function", "$V$", "1")
    e2 = Bounded("velocity error", "$|e_2|$", "rad/s")
    f_tilde = Bounded("estimation error", r"$|\tilde f|$", "N m")
    figure = _style.new_figure(WIDTH, HEIGHT)
    panels = figure.subplots(2, 3)
    _draw_bounded(panels[0, 0], traces.t, traces.V, traces.envelope, V)
    _draw_inequality(panels[0, 1], traces, traces.dropped, "dropped terms")
    _draw_errors(panels[0, 2], traces.t, traces.xi, traces.xi_bound, shown.joints)
    _finish_relative_error(panels[0, 2], traces.t, shown.joints)
    _draw_bounded(panels[1, 0], traces.t, traces.e2, traces.e2_bound, e2)
    _draw_bounded(panels[1, 1], traces.t, traces.f_tilde, traces.f_tilde_bound, f_tilde)
    _verdicts(panels[1, 2], shown)
    _mark_excluded(panels.flat[:5], traces)
    _title(figure, shown, traces, title, subject)
    return figure


def _title(
    figure: Figure,
    shown: Certificate,
    traces: Traces | LevelTraces,
    title: str | None,
    subject: str,
) -> None:
    """The heading with the verdict."""
    if title is None:
        title = f"{subject} along the run"
    if shown.worst_run is not None:
        title += f", worst run {shown.worst_run}"
    lines = [f"{title}: {shown.verdict}", shown.heading]
    end, last = float(shown.traces.t[-1]), float(traces.t[-1])
    if last < end:
        lines.append(f"until {last:.4g} s, as requested; the verdict is that of all {end:.4g} s")
    _style.set_heading(figure, lines, color=_verdict_colour(shown.verdict))


def _verdict_colour(verdict: str) -> str:
    if verdict == "fails":
        return _style.failure()
    return _style.text_colour()


def _level_panels(shown: Certificate, traces: LevelTraces) -> Figure:
    """The panels of a plant in strict-feedback form, the verdicts last."""
    levels, t = shown.levels, traces.t
    rows = math.ceil((len(levels) + 4) / COLUMNS)
    figure = _style.new_figure(WIDTH, HEIGHT / 2 * rows)
    panels = list(figure.subplots(rows, COLUMNS).flat)
    V = Bounded("Lyapunov function", "$V$", "1")
    _draw_bounded(panels[0], t, traces.V, traces.envelope, V)
    _draw_inequality(panels[1], traces, traces.disturbance_terms, "disturbance terms")
    for i, level in enumerate(levels):
        axes, name = panels[2 + i], f"{level.name} error"
        error = Bounded(name, f"$e_{i + 1}$", level.unit)
        if not level.is_bounded and _is_zero(
            axes, traces.error[:, i], traces.error_bound[:, i], error
        ):
            _set_axes(axes, t, f"{name} {error.symbol}", level.unit)
            continue
        _draw_errors(axes, t, traces.error[:, i], traces.error_bound[:, i], shown.joints)
        if level.is_bounded:
            _finish_relative_error(axes, t, shown.joints, rf"{name} $\xi_{i + 1}$")
            continue
        _set_axes(axes, t, f"{name} $e_{i + 1}$", level.unit)
        axes.legend(loc="best", **LEGEND)
    _disturbances(panels[2 + len(levels)], traces)
    _mark_excluded(panels[: len(levels) + 3], traces)
    verdicts, *unused = panels[len(levels) + 3 :]
    _verdicts(verdicts, shown)
    for axes in unused:
        axes.set_axis_off()
    return figure


def _disturbances(axes: Axes, traces: LevelTraces) -> None:
    """The size of d_tilde of every level that has one, on a logarithmic axis."""
    for i in range(traces.d_tilde.shape[1]):
        if _is_rounding(traces.d_tilde[:, i], _rate(traces.t, traces.error[:, i])):
            continue
        size = np.where(traces.d_tilde[:, i] > 0, traces.d_tilde[:, i], np.nan)
        label = rf"$|\tilde d_{i + 1}|$"
        axes.plot(*thinned(traces.t, size), label=label, **_style.series(i))
    _set_axes(axes, traces.t, r"error of the estimate $|\tilde d_i|$", "unit of the level/s")
    if not axes.get_lines():
        say_zero(axes, _largest(traces.d_tilde), r"$\tilde d_i$", "")
        return
    axes.set_yscale("log")
    axes.legend(loc="best", **LEGEND)


class Bounded(NamedTuple):
    """A signal with a bound: the name, the symbol and the unit of its panel."""

    name: str
    symbol: str
    unit: str


def _bound_style() -> dict[str, Any]:
    return {"color": _style.bound(), "linewidth": 1.6, "linestyle": "-"}


def _set_axes(axes: Axes, t: np.ndarray, name: str, unit: str) -> None:
    _style.time_axis(axes, (float(t[0]), float(t[-1])))
    axes.set_ylabel(_style.label(name, unit))


def _draw_bounded(
    axes: Axes, t: np.ndarray, values: np.ndarray, bound: np.ndarray, signal: Bounded
) -> None:
    """A nonnegative signal and its bound on a logarithmic axis."""
    _set_axes(axes, t, f"{signal.name} {signal.symbol}", signal.unit)
    if _is_zero(axes, values, bound, signal):
        return
    if np.isfinite(bound).any():
        axes.plot(*thinned(t, bound), label="bound", **_bound_style())
    positive = np.where(values > 0, values, np.nan)
    axes.plot(*thinned(t, positive), label=signal.symbol, **_style.series(0))
    axes.set_yscale("log")
    axes.legend(loc="best", **LEGEND)


def _is_zero(axes: Axes, values: np.ndarray, bound: np.ndarray, signal: Bounded) -> bool:
    """Whether a signal consists of rounding errors of its bound; if so, the panel says it."""
    if not _is_rounding(values, bound):
        return False
    say_zero(axes, _largest(values), signal.symbol, signal.unit)
    return True


def _is_rounding(values: np.ndarray, scale: np.ndarray) -> bool:
    """Whether a signal consists of rounding errors of numbers of the size of another one."""
    rounding = ROUNDING * float(np.finfo(values.dtype).eps) * _largest(scale)
    return bool(np.isfinite(values).any()) and _largest(values) <= rounding


def _largest(values: np.ndarray) -> float:
    """The largest finite size of a signal; 0 if there is none."""
    return float(np.max(np.abs(values), where=np.isfinite(values), initial=0.0))


def _rate(t: np.ndarray, values: np.ndarray) -> np.ndarray:
    """The rate of a signal between its samples."""
    steps = np.diff(t).reshape(-1, *[1] * (values.ndim - 1))
    return np.diff(values, axis=0) / steps


def _draw_inequality(
    axes: Axes, traces: Traces | LevelTraces, terms: np.ndarray, name: str
) -> None:
    """The left side of the inequality, on an axis that is logarithmic on both sides of zero."""
    t, left = traces.t, traces.left
    _set_axes(axes, t, "left side of the inequality", "1/s")
    if not np.isfinite(left).any():
        axes.text(0.5, 0.5, "no claim applies", transform=axes.transAxes, ha="center", va="center")
        return
    both = Bounded("", r"$\mathrm{left\ side}$", "1/s")
    if _is_zero(axes, np.concatenate([left, terms]), _rate(t, traces.V), both):
        return
    sizes = np.abs(left[np.isfinite(left) & (left != 0)])
    smallest = 1.0
    if sizes.size:
        largest = max(float(sizes.max()), float(np.max(np.abs(terms))))
        smallest = max(float(sizes.min()), 1e-12 * largest)
    axes.set_yscale("symlog", linthresh=10.0 ** np.floor(np.log10(smallest)))
    axes.plot(*thinned(t, left), label="left side", **_style.series(0))
    if np.any(terms != 0):
        axes.plot(*thinned(t, terms), label=name, linewidth=0.9, **_style.series(1))
    axes.axhline(0.0, color=_style.text_colour(), linewidth=0.9)
    low, high = axes.get_ylim()
    axes.set_ylim(low, max(high, -0.02 * low))
    axes.axhspan(0.0, axes.get_ylim()[1], color=_style.forbidden(), linewidth=0, zorder=0)
    axes.legend(loc="best", **LEGEND)


def _draw_errors(
    axes: Axes, t: np.ndarray, errors: np.ndarray, bounds: np.ndarray, joints: tuple[str, ...]
) -> None:
    """An error of every joint, with the bounds on its size."""
    bounds_differ = np.ptp(bounds, axis=1).max(initial=0.0) > 1e-3
    for joint in range(errors.shape[1]):
        style = _style.series(joint)
        axes.plot(*thinned(t, errors[:, joint]), label=escaped(joints[joint]), **style)
        own = _bound_style()
        if bounds_differ:
            own |= {"color": style["color"], "alpha": 0.45}
        shown_t, bound = thinned(t, bounds[:, joint])
        axes.plot(shown_t, bound, label="_" if joint else "bound", **own)
        axes.plot(shown_t, -bound, label="_", **own)


def _finish_relative_error(
    axes: Axes, t: np.ndarray, joints: tuple[str, ...], name: str = r"relative error $\xi$"
) -> None:
    """Limits, label and legend of a panel of relative errors."""
    n = len(joints)
    # Joint names may be long: the legend has as many columns as fit, the axis room for its rows.
    columns = int(np.clip(44 // (max(map(len, joints)) + 4), 1, 4 if n > 5 else 3))
    top = 1.3 + 0.15 * math.ceil((n + 1) / columns)
    axes.axhspan(1.0, top, color=_style.forbidden(), linewidth=0, zorder=0)
    axes.axhspan(-1.08, -1.0, color=_style.forbidden(), linewidth=0, zorder=0)
    axes.set_ylim(-1.08, top)
    _set_axes(axes, t, name, "1")
    small = {"fontsize": _style.size(6.5), "handlelength": 1.8, "columnspacing": 0.8}
    axes.legend(loc="upper center", ncols=columns, **LEGEND, **small)


def _mark_excluded(panels: Any, traces: Traces | LevelTraces) -> None:
    """Shades the samples without a claim."""
    if not traces.excluded.any():
        return
    style = {"color": _style.blend(0.149), "step": "mid", "zorder": 0.5}
    for axes in panels:
        full_height = axes.get_xaxis_transform()
        axes.fill_between(traces.t, 0, 1, where=traces.excluded, transform=full_height, **style)


def _verdicts(axes: Axes, shown: Certificate) -> None:
    """The lines that were checked along the run, with their verdicts."""
    axes.set_axis_off()
    applicable = [line for line in shown.lines if line.verdict != "not applicable"]
    names = ["K2", "kf", "own", "inequality", "envelope", "xi", "e2", "f_tilde", "joints"]
    if shown.levels:
        names = ["own", "inequality", "equality", "estimate", "alpha", "envelope", "xi", "e,"]
    only_weighted = not any(x.is_inequality and not x.has_weights for x in applicable)
    lines = [
        line
        for line in applicable
        if line.enters_verdict
        and (line.name.startswith(tuple(names)) or (only_weighted and line.has_weights))
    ]
    style: dict[str, Any] = {"transform": axes.transAxes, "va": "center"}
    if not lines:
        axes.text(0.5, 0.5, "no claim applies", ha="center", **style)
    columns = (0.0, 0.41, 0.56, 0.69)
    for row, line in enumerate(lines):
        height = 1.0 - (row + 0.5) / max(len(lines), 12)
        colour = _verdict_colour(line.verdict)
        cells = (line.name, line.equation, line.verdict, _margin(line))
        for x, text in zip(columns, cells, strict=True):
            axes.text(x, height, text, color=colour, fontsize=_style.size(7), **style)


def _margin(line: Line) -> str:
    if line.margin is None:
        return ""
    if line.unit == "1":
        return f"{line.margin:.3g}"
    return f"{line.margin:.3g} {line.unit}"
