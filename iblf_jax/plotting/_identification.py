"""The figure of an identification: the numbers, what the log knows how well, and what is left."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from iblf_jax.plotting import _style
from iblf_jax.plotting._curves import plain

if TYPE_CHECKING:
    from iblf_jax.identification import Identification

MOST_ROWS = 40
"""Numbers that are drawn at most."""


@_style.styled()
def identification(known: Identification) -> Figure:
    """An identification at a glance: each number against its start, how well each combination is
    known, what is left and its correlations.

    Args:
      known: of `identify`.

    Returns:
      A matplotlib Figure.

    Source: design of this package.
    """
    rows = min(len(known.numbers), MOST_ROWS)
    heights = [max(1.8, 0.45 + 0.17 * rows), 2.1, 2.1]
    figure = _style.new_figure(_style.WIDTH, 0.6 + sum(heights))
    grid = figure.add_gridspec(3, 1, height_ratios=heights)
    _numbers(
        figure.add_subplot(grid[0].subgridspec(1, 1)[0]), known
    )  # a grid of its own, as its words stand at the right
    middle, last = (grid[i].subgridspec(1, 2) for i in (1, 2))
    _singular(figure.add_subplot(middle[0]), known)
    _joints(figure.add_subplot(middle[1]), known)
    _left(figure.add_subplot(last[0]), known)
    _correlations(figure.add_subplot(last[1]), known)
    untold = sum(number.verdict == "cannot be told" for number in known.numbers)
    _style.head(
        figure, ["Parameters from a log", *([f"{untold} numbers cannot be told"] if untold else [])]
    )
    return figure


def _numbers(axes: Axes, known: Identification) -> None:
    """Change of each number from its start, in scales, with three standard errors."""
    chosen = known.numbers[:MOST_ROWS]
    beside: dict[str, Any] = {
        "transform": axes.get_yaxis_transform(),
        "va": "center",
        "fontsize": _style.size(7),
    }
    for i, (number, scale) in enumerate(zip(chosen, known.scales, strict=False)):
        if number.value is None or number.error is None:
            colour = _style.bound() if number.verdict == "left free" else _style.alarm()
            axes.plot(0.0, i, marker="x", color=colour, linestyle="none")
            axes.text(1.01, i, number.verdict, color=colour, **beside)
            continue
        change, error = (number.value - number.start) / scale, 3.0 * number.error / scale
        is_biased = number.verdict == "biased"
        colour = _style.alarm() if is_biased else _style.colour(0)
        axes.errorbar(change, i, xerr=error, fmt="o", markersize=3.5, capsize=2, color=colour)
        words = f"{number.digits} $\\pm$ {number.error:.2g} {number.unit}" + (
            ", biased" if is_biased else ""
        )
        axes.text(1.01, i, words, **beside)
    axes.axvline(0.0, color=_style.bound(), linewidth=0.8)
    axes.set_yticks(
        range(len(chosen)), [plain(number.name) for number in chosen], fontsize=_style.size(7)
    )
    axes.set_ylim(len(chosen) - 0.5, -0.5)
    axes.set_xlabel("value less start, in the number's scale, with three standard errors")


def _singular(axes: Axes, known: Identification) -> None:
    """Standard error along each combination."""
    error = 1.0 / known.singular_values
    axes.bar(
        np.arange(len(error)) + 1,
        error,
        width=0.7,
        color=[_style.alarm() if x >= 0.5 else _style.colour(0) for x in error],
    )
    axes.axhline(0.5, color=_style.alarm(), linewidth=0.8)
    axes.set_yscale("log")
    axes.set_xlabel("combination, the best known first")
    axes.set_ylabel("standard error,\nin scales")
    axes.grid(axis="x", visible=False)


def _joints(axes: Axes, known: Identification) -> None:
    """What is left of each joint, before, after and held back."""
    n = len(known.fit)
    names = ("start", "fitted", "held back")
    columns = [
        [getattr(one, name) for one in known.fit] for name in ("before", "after", "held_back")
    ]
    for i, (name, column) in enumerate(zip(names, columns, strict=True)):
        if np.all(np.isfinite(column)):
            axes.bar(
                np.arange(n) + 0.27 * (i - 1),
                column,
                width=0.25,
                color=_style.colour(i),
                label=name,
            )
    words = [one.joint for one in known.fit]
    long = max(map(len, words)) * n > 40
    axes.set_xticks(range(n), words, rotation=40 if long else 0, ha="right" if long else "center")
    axes.set_yscale("log")
    axes.margins(y=0.3)
    axes.set_ylabel(_style.label("rms of what is left", "rad"))
    axes.legend(
        ncols=3, fontsize=_style.size(6.5), loc="upper center", handlelength=1.2, columnspacing=1.0
    )
    axes.grid(axis="x", visible=False)


def _left(axes: Axes, known: Identification) -> None:
    """Residuals of the joint with most left, over time, in standard deviations of its noise."""
    worst = int(np.argmax([one.after / max(one.noise, 1e-12) for one in known.fit]))
    for kept, colour, name in (
        (True, _style.colour(1), "fitted"),
        (False, _style.colour(2), "held back"),
    ):
        chosen = known.kept == kept
        if np.any(chosen):
            gap = np.full((int(chosen.sum()), 1), np.nan)
            t = np.concatenate([known.times[chosen], gap], axis=1).ravel()
            axes.plot(
                t,
                np.concatenate([known.residuals[chosen, :, worst], gap], axis=1).ravel(),
                color=colour,
                linewidth=0.5,
                label=name,
            )
    axes.set_xlabel(_style.label("time $t$", "s"))
    axes.set_ylabel(_style.label(f"logged less replayed,\n{known.fit[worst].joint}", "rad"))
    axes.legend(ncols=2, fontsize=_style.size(6.5), loc="upper center")
    axes.margins(y=0.25)


def _correlations(axes: Axes, known: Identification) -> None:
    """Autocorrelation of the residuals."""
    lags = np.arange(1, known.autocorrelations.shape[1] + 1)
    for j, row in enumerate(known.autocorrelations):
        axes.plot(lags, row, marker=".", markersize=3, label=known.fit[j].joint, **_style.series(j))
    band = 3.0 / np.sqrt(max(int(known.kept.sum()) * known.times.shape[1], 1))
    axes.axhspan(-band, band, color=_style.tube(), zorder=0)
    size = 1.2 * max(float(np.max(np.abs(known.autocorrelations))), 2.0 * band)
    axes.set_ylim(-size, size)
    axes.set_xlabel("lag [samples]")
    axes.set_ylabel("autocorrelation")
    if len(known.fit) <= 7:
        axes.legend(fontsize=_style.size(6), ncols=2)
