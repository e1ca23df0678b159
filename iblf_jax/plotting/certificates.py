"""The figure of a certificate: V2 under its envelope, the inequality's left side, and the errors
under their bounds.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from iblf_jax.certificates import Certificate, Traces
from iblf_jax.core import checks
from iblf_jax.plotting import _style
from iblf_jax.plotting._curves import plain, thinned

WIDTH = 10.0
HEIGHT = 5.4
LEGEND: dict[str, Any] = {"frameon": True, "framealpha": 0.85, "edgecolor": "none"}


@_style.styled()
def certificate(
    shown: Certificate, *, title: str | None = None, until: float | None = None
) -> Figure:
    """What `Certificate.plot` shows, the verdict in the title.

    V2 with its envelope (3.20) or (3.28); the left side of the differential inequality (3.18) or
    (3.26), which must stay below zero, and the dropped terms of the printed proof; xi, |e2| and
    |f_tilde| with their bounds.  Samples without a claim are left out. Of a law with a claim of its own, V and the left side are those of that claim.

    Args:
      shown: the certificate; over many runs, its worst run is drawn.
      title: the first line of the title; what the certificate is about if not given.
      until: draw up to this time only [s].

    Returns:
      The figure.

    Raises:
      ValueError: something that is no Certificate, or `until` before the first samples.
    """
    if not isinstance(shown, Certificate):
        raise checks.fail(
            "shown", type(shown).__name__, "a Certificate", "Draw what ij.certify returned."
        )
    traces = _until(shown.traces, until)
    subject, symbol = (
        ("The law's own claim", "$V$") if shown.is_of_own_claim else ("Theorem 2", "$V_2$")
    )
    title = f"{subject} along the run" if title is None else title
    figure = _style.new_figure(WIDTH, HEIGHT)
    panels = figure.subplots(2, 3)
    _against_bound(
        panels[0, 0],
        traces.t,
        {symbol: traces.V},
        traces.envelope,
        f"Lyapunov function {symbol}",
        "1",
    )
    _inequality(panels[0, 1], traces)
    _relative_error(panels[0, 2], traces, shown.joints)
    _against_bound(
        panels[1, 0],
        traces.t,
        {"$|e_2|$": traces.e2},
        traces.e2_bound,
        "velocity error $|e_2|$",
        "rad/s",
    )
    words = r"estimation error $|\tilde f|$"
    _against_bound(
        panels[1, 1],
        traces.t,
        {r"$|\tilde f|$": traces.f_tilde},
        traces.f_tilde_bound,
        words,
        "N m",
    )
    _verdicts(panels[1, 2], shown)
    _mark_excluded(panels.flat[:5], traces)
    run = "" if shown.worst_run is None else f", worst run {shown.worst_run}"
    colour = _style.alarm() if shown.verdict == "fails" else _style.ink()
    _style.head(figure, [f"{title}{run}: {shown.verdict}", shown.heading], color=colour)
    return figure


def _until(traces: Traces, until: float | None) -> Traces:
    """The traces up to a time."""
    if until is None:
        return traces
    keep = traces.t <= checks.positive_number("until", until, "s")
    if np.sum(keep) < 2:
        raise checks.fail(
            "until", until, f"a time after the second sample, {float(traces.t[1]):g} s"
        )
    return Traces(*(x[keep] for x in traces))


def _limit() -> dict[str, Any]:
    return {"color": _style.bound(), "linewidth": 1.6, "linestyle": "-"}


def _frame(axes: Axes, t: np.ndarray, words: str, unit: str) -> None:
    axes.set_xlim(float(t[0]), float(t[-1]))
    axes.set_xlabel(_style.label("time $t$", "s"))
    axes.set_ylabel(_style.label(words, unit))


def _against_bound(
    axes: Axes,
    t: np.ndarray,
    curves: dict[str, np.ndarray],
    bound: np.ndarray,
    words: str,
    unit: str,
) -> None:
    """Sizes on a logarithmic axis, and the bound above them."""
    if np.isfinite(bound).any():
        axes.plot(*thinned(t, bound), label="bound", **_limit())
    for i, (name, values) in enumerate(curves.items()):
        axes.plot(*thinned(t, np.where(values > 0, values, np.nan)), label=name, **_style.series(i))
    axes.set_yscale("log")
    _frame(axes, t, words, unit)
    axes.legend(loc="best", **LEGEND)


def _inequality(axes: Axes, traces: Traces) -> None:
    """The left side of the inequality, on an axis that is logarithmic on both sides of zero."""
    _frame(axes, traces.t, "left side of the inequality", "1/s")
    left = traces.left
    if not np.isfinite(left).any():
        axes.text(0.5, 0.5, "no claim applies", transform=axes.transAxes, ha="center", va="center")
        return
    sizes = np.abs(left[np.isfinite(left) & (left != 0)])
    smallest = max(float(sizes.min()), 1e-12 * float(sizes.max())) if sizes.size else 1.0
    axes.set_yscale("symlog", linthresh=10.0 ** np.floor(np.log10(smallest)))
    axes.plot(*thinned(traces.t, left), label="left side", **_style.series(0))
    if np.any(traces.dropped != 0):
        axes.plot(
            *thinned(traces.t, traces.dropped),
            label="dropped terms",
            **(_style.series(1) | {"linewidth": 0.9}),
        )
    axes.axhline(0.0, color=_style.ink(), linewidth=0.9)
    low, high = axes.get_ylim()
    axes.set_ylim(low, max(high, -0.02 * low))
    axes.axhspan(0.0, axes.get_ylim()[1], color=_style.broken(), linewidth=0, zorder=0)
    axes.legend(loc="best", **LEGEND)


def _relative_error(axes: Axes, traces: Traces, joints: tuple[str, ...]) -> None:
    """The relative error xi of every joint between its bounds and the walls."""
    n = traces.xi.shape[1]
    for joint in range(n):
        look = _style.series(joint)
        axes.plot(*thinned(traces.t, traces.xi[:, joint]), label=plain(joints[joint]), **look)
        own = _limit() | (
            {"color": look["color"], "alpha": 0.45}
            if np.ptp(traces.xi_bound, axis=1).max(initial=0.0) > 1e-3
            else {}
        )
        for sign in (1, -1):
            text = "bound" if joint == 0 and sign == 1 else "_"
            axes.plot(*thinned(traces.t, sign * traces.xi_bound[:, joint]), label=text, **own)
    # Names of a robot's file may be long: as many columns as fit, and room above the wall for the
    # rows.
    columns = int(np.clip(44 // (max(map(len, joints)) + 4), 1, 4 if n > 5 else 3))
    top = 1.3 + 0.15 * -(-(n + 1) // columns)
    axes.axhspan(1.0, top, color=_style.broken(), linewidth=0, zorder=0)
    axes.axhspan(-1.08, -1.0, color=_style.broken(), linewidth=0, zorder=0)
    axes.set_ylim(-1.08, top)
    _frame(axes, traces.t, r"relative error $\xi$", "1")
    small = {"fontsize": _style.size(6.5), "handlelength": 1.8, "columnspacing": 0.8}
    axes.legend(loc="upper center", ncols=columns, **LEGEND, **small)


def _mark_excluded(panels: Any, traces: Traces) -> None:
    """A grey shade over the samples at which nothing is claimed."""
    if not traces.excluded.any():
        return
    for axes in panels:
        axes.fill_between(
            traces.t,
            0,
            1,
            where=traces.excluded,
            transform=axes.get_xaxis_transform(),
            color=_style.shade(0.149),
            step="mid",
            zorder=0.5,
        )


def _verdicts(axes: Axes, shown: Certificate) -> None:
    """The lines that were checked along the run, with their verdicts."""
    axes.set_axis_off()
    named: tuple[str, ...] = (
        "K2",
        "kf",
        "own",
        "inequality",
        "envelope",
        "xi",
        "e2",
        "f_tilde",
        "joints",
    )
    if not any(
        line.name.startswith("inequality") and line.verdict != "not applicable"
        for line in shown.lines
    ):
        named = (*named, "weighted")  # the paper's own claim does not apply
    growth = axes.get_figure().get_figwidth() / WIDTH  # type: ignore[union-attr]
    lines = [
        line
        for line in shown.lines
        if line.name.startswith(named) and line.verdict != "not applicable" and line.counts
    ]
    for row, line in enumerate(lines):
        height = 1.0 - (row + 0.5) / max(len(lines), 12)
        colour = _style.alarm() if line.verdict == "fails" else _style.ink()
        margin = (
            ""
            if line.margin is None
            else f"{line.margin:.3g}" + ("" if line.unit == "1" else f" {line.unit}")
        )
        for x, text in (
            (0.0, line.name),
            (0.41, line.equation),
            (0.56, line.verdict),
            (0.69, margin),
        ):
            axes.text(
                x,
                height,
                text,
                transform=axes.transAxes,
                color=colour,
                va="center",
                fontsize=7 * growth,
            )
    if not lines:
        axes.text(0.5, 0.5, "no claim applies", transform=axes.transAxes, ha="center", va="center")
