"""Figure of the probability of rare failures."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from iblf_jax.core import checks
from iblf_jax.plotting import _style
from iblf_jax.plotting._curves import check_class, escaped
from iblf_jax.studies.rare_events.limit_state import Level
from iblf_jax.studies.rare_events.result import FailureProbability, LikelyFailure

WIDTH = 9.0
MAX_NUMBERS = 10
"""Largest number of bars for the most likely failure."""


@_style.figure_function
def failure_probability(found: FailureProbability, *, numbers: int = MAX_NUMBERS) -> Figure:
    """The probability that the margin of a run is below a number, and the most likely failure.

    Left: through the levels of subset simulation, with their thresholds; the estimate and its
    interval at the limit.  Right: the draws of the most likely failure in standard deviations of a
    normal distribution.

    Args:
      found: the result of `ij.failure_probability`.
      numbers: how many draws are shown, those that deviate most.

    Returns:
      The figure.

    Raises:
      ValueError: something else.
    """
    check_class("found", found, FailureProbability, "ij.failure_probability returns one.")
    numbers = checks.positive_integer("numbers", numbers, most=1000)
    figure = _style.new_figure(WIDTH, 3.8)
    left, right = figure.subplots(1, 2, width_ratios=(1.5, 1.0))
    _draw_levels(left, found)
    _draw_likely(right, found.most_likely_failure, numbers)
    _style.set_heading(figure, [_heading(found)])
    _style.legend_below(figure)
    return figure


def _heading(found: FailureProbability) -> str:
    if found.margins_stagnate:
        margin = f"{found.levels[-1].threshold:.3g} {found.unit}"
        return f"No failure reachable was found in {found.runs} runs; margins stagnate at {margin}"
    if found.is_upper_bound:
        bound = f"{found.estimate:.2g}"
        return f"Probability of failure: at most {bound}; {found.runs} runs, and no sample failed"
    low, high = found.interval
    return (
        f"Probability of failure {found.estimate:.3g}, {100 * found.confidence:g}% interval"
        f" {low:.2g} to {high:.2g}; {found.runs} runs"
    ).replace("%", " %")


def level_curve(levels: tuple[Level, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Margins, and the estimated probability that the margin of a run is not above them.

    Each level contributes the samples that are above its threshold, the last one all.
    """
    margins: list[np.ndarray] = []
    probabilities: list[np.ndarray] = []
    reached = 1.0
    for number, level in enumerate(levels):
        ordered = np.sort(level.margins)[::-1]
        share = np.arange(len(ordered), 0, -1) / max(len(ordered), 1)
        is_last = number == len(levels) - 1
        kept = (ordered > level.threshold) | is_last
        kept &= np.isfinite(ordered)
        margins.append(ordered[kept])
        probabilities.append(reached * share[kept])
        reached *= level.probability
    return np.concatenate(margins), np.concatenate(probabilities)


def _draw_levels(axes: Axes, found: FailureProbability) -> None:
    axes.set_yscale("log")
    if found.estimator != "importance":
        margins, probabilities = level_curve(found.levels)
        label = "P(margin $\\leq$ x)"
        axes.plot(margins, probabilities, color=_style.colour(0), label=label)
        for number, level in enumerate(found.levels):
            label = "threshold of a level" if number == 0 else "_nolegend_"
            axes.axvline(level.threshold, color=_style.blend(0.4), **_style.FAINT, label=label)
    if not found.margins_stagnate:
        low, high = found.interval
        errors = [[found.estimate - max(low, found.estimate * 1e-3)], [high - found.estimate]]
        label = f"estimate with {100 * found.confidence:g}% interval".replace("%", " %")
        if found.is_upper_bound:
            label = "upper bound"
        colour = _style.colour(1)
        axes.errorbar(
            [0.0], [found.estimate], yerr=errors, fmt="o", color=colour, capsize=4, label=label
        )
    axes.set_xlabel(_style.label("margin x above the limit", found.unit))
    axes.set_ylabel("probability [1]")


def _draw_likely(axes: Axes, likely: LikelyFailure | None, numbers: int) -> None:
    if likely is None:
        axes.set_axis_off()
        axes.text(0.5, 0.5, "no failure found", ha="center", va="center", transform=axes.transAxes)
        return
    order = np.argsort(-np.abs(likely.z), kind="stable")[:numbers][::-1]
    labels = [escaped(likely.names[i]) for i in order]
    axes.barh(labels, likely.z[order], color=_style.colour(0))
    axes.axvline(0.0, color=_style.blend(0.4), linewidth=0.8)
    axes.set_xlabel(f"most likely failure: standard deviations\n(distance {likely.distance:.2f})")
