"""The figure of an identification: the numbers, their standard errors, and the residuals."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from iblf_jax.identification.result import NOT_IDENTIFIABLE, Identification
from iblf_jax.plotting import _style
from iblf_jax.plotting._curves import check_class, escaped

MAX_ROWS = 40
"""Largest number of identified numbers in the figure."""


@_style.figure_function
def identification(known: Identification) -> Figure:
    """The overview of an identification: each number against its start, the standard error of each
    combination, the residuals and their correlations.

    Args:
      known: the result of `identify`.

    Returns:
      A matplotlib Figure.

    Source: design of this package.
    """
    check_class("known", known, Identification, "ij.identify returns one.")
    rows = min(len(known.numbers), MAX_ROWS)
    heights = [max(1.8, 0.45 + 0.17 * rows), 2.1, 2.1]
    figure = _style.new_figure(_style.WIDTH, 0.6 + sum(heights))
    grid = figure.add_gridspec(3, 1, height_ratios=heights)
    # A separate grid, because this panel has text at its right.
    _numbers(figure.add_subplot(grid[0].subgridspec(1, 1)[0]), known)
    middle, last = (grid[i].subgridspec(1, 2) for i in (1, 2))
    _singular(figure.add_subplot(middle[0]), known)
    _joints(figure.add_subplot(middle[1]), known)
    _residuals(figure.add_subplot(last[0]), known)
    _correlations(figure.add_subplot(last[1]), known)
    lines = ["Parameters from a log"]
    unidentifiable = sum(number.verdict == NOT_IDENTIFIABLE for number in known.numbers)
    if unidentifiable:
        lines.append(f"{unidentifiable} numbers are not identifiable")
    _style.set_heading(figure, lines)
    return figure


def _numbers(axes: Axes, known: Identification) -> None:
    """Change of each number from its start, in scales, with three standard errors."""
    chosen = known.numbers[:MAX_ROWS]
    beside: dict[str, Any] = {
        "transform": axes.get_yaxis_transform(),
        "va": "center",
        "fontsize": _style.size(7),
    }
    for i, (number, scale) in enumerate(zip(chosen, known.scales, strict=False)):
        if number.value is None or number.error is None:
            colour = _style.bound() if number.verdict == "left free" else _style.failure()
            axes.plot(0.0, i, marker="x", color=colour, linestyle="none")
            axes.text(1.01, i, number.verdict, color=colour, **beside)
            continue
        colour = _style.colour(0)
        text = f"{number.digits} $\\pm$ {number.error:.2g} {number.unit}"
        if number.verdict == "biased":
            colour = _style.failure()
            text += ", biased"
        change = (number.value - number.start) / scale
        error = 3.0 * number.error / scale
        axes.errorbar(change, i, xerr=error, fmt="o", markersize=3.5, capsize=2, color=colour)
        axes.text(1.01, i, text, **beside)
    axes.axvline(0.0, color=_style.bound(), linewidth=0.8)
    axes.set_yticks(
        range(len(chosen)), [escaped(number.name) for number in chosen], fontsize=_style.size(7)
    )
    axes.set_ylim(len(chosen) - 0.5, -0.5)
    axes.set_xlabel("value less start, in the number's scale, with three standard errors")


def _singular(axes: Axes, known: Identification) -> None:
    """Standard error along each combination."""
    error = 1.0 / known.singular_values
    colours = np.where(error >= 0.5, _style.failure(), _style.colour(0))
    axes.bar(np.arange(len(error)) + 1, error, width=0.7, color=colours.tolist())
    axes.axhline(0.5, color=_style.failure(), linewidth=0.8)
    axes.set_yscale("log")
    axes.set_xlabel("combination, the best known first")
    axes.set_ylabel("standard error,\nin scales")
    axes.grid(axis="x", visible=False)


def _joints(axes: Axes, known: Identification) -> None:
    """Residuals of each joint: at the start, fitted, and on the data held back."""
    n = len(known.fit)
    columns = {
        "start": [one.before for one in known.fit],
        "fitted": [one.after for one in known.fit],
        "held back": [one.held_back for one in known.fit],
    }
    for i, (name, column) in enumerate(columns.items()):
        if np.all(np.isfinite(column)):
            places = np.arange(n) + 0.27 * (i - 1)
            axes.bar(places, column, width=0.25, color=_style.colour(i), label=name)
    _style.name_ticks(axes, [one.joint for one in known.fit], 40)
    axes.set_yscale("log")
    axes.margins(y=0.3)
    axes.set_ylabel(_style.label("rms of what is left", "rad"))
    axes.legend(
        ncols=3, fontsize=_style.size(6.5), loc="upper center", handlelength=1.2, columnspacing=1.0
    )
    axes.grid(axis="x", visible=False)


def _residuals(axes: Axes, known: Identification) -> None:
    """Residuals over time of the joint that has the largest in standard deviations of its noise."""
    worst = int(np.argmax([one.after / max(one.noise, 1e-12) for one in known.fit]))
    for index, name, chosen in ((1, "fitted", known.kept), (2, "held back", ~known.kept)):
        if np.any(chosen):
            gap = np.full((int(chosen.sum()), 1), np.nan)  # separates the windows
            t = np.concatenate([known.times[chosen], gap], axis=1).ravel()
            left = np.concatenate([known.residuals[chosen, :, worst], gap], axis=1).ravel()
            axes.plot(t, left, color=_style.colour(index), linewidth=0.5, label=name)
    _style.time_axis(axes)
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
