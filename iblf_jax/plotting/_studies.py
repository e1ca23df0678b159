"""Figures of a Monte-Carlo study: the tube with quantile bands, histograms by verdict, margin
against each drawn parameter.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from iblf_jax.core import checks
from iblf_jax.plotting import _style
from iblf_jax.plotting._curves import called, plain
from iblf_jax.studies import statistics
from iblf_jax.studies.study import Study

if TYPE_CHECKING:
    import xarray

WIDTH = 10.0
COLUMNS = 4
"""Panels side by side at most."""
MOST_POINTS = 5000
"""Runs in a scatter at most: all failed ones first, then others evenly."""


def _check(study: Study) -> None:
    if not isinstance(study, Study):
        raise checks.fail("study", type(study).__name__, "a Study", "ij.monte_carlo returns one.")


def _verdict(study: Study) -> str:
    outside = study.status_counts["STARTED_OUTSIDE"]
    apart = f", {outside} of them because they started outside" if outside else ""
    return (
        f"{study.runs} runs, {len(study.failed)} failed; bound violated or run away:"
        f" {study.violation_probability}{apart}"
    )


def _grid(count: int, height: float) -> tuple[Figure, list[Axes]]:
    sizes = _style.row_sizes(count, COLUMNS)
    figure = _style.new_figure(max(4.0, WIDTH * sizes[0] / COLUMNS), 0.8 + height * len(sizes))
    return figure, [axes for row in _style.spread(figure, count, COLUMNS) for axes in row]


# ------------------------------------------------------------------------------------------------------------------- bands


@_style.styled()
def bands(
    study: Study,
    *,
    quantiles: Sequence[float] = (0.05, 0.5, 0.95),
    runs: int = 1024,
    exclude_failed: bool = False,
) -> Figure:
    """The tube of every joint with the quantiles of the runs' positions along time.

    Args:
      study: of n joints.
      quantiles: an odd number of levels in [0, 1]; the middle one is drawn as a line, the others as
        bands around it.
      runs: from how many of the runs, which are made again.
      exclude_failed: leave out failed runs; the title says how many.

    Returns:
      The figure, one panel a joint.

    Raises:
      ValueError: not a study, or bad quantiles.
    """
    _check(study)
    data = study.bands(quantiles, runs=runs, exclude_failed=exclude_failed)
    figure, panels = _grid(study.scenario.n, 2.4)
    for joint, axes in enumerate(panels):
        _draw_bands(axes, data, joint, study)
    _style.head(figure, [_bands_title(data)])
    _style.legend_below(figure)
    return figure


def _bands_title(data: xarray.Dataset) -> str:
    left_out = f", {data.attrs['excluded']} left out" if data.attrs["excluded"] else ""
    failed = (
        f", {data.attrs['failed_included']} failed ones among them"
        if data.attrs["failed_included"]
        else ""
    )
    return f"Quantiles of {data.attrs['runs']} runs{failed}{left_out}"


def _draw_bands(axes: Axes, data: xarray.Dataset, joint: int, study: Study) -> None:
    t, q, levels = data.time.values, data.q.values[:, :, joint], data["quantile"].values
    lower, upper = data.lower.values[:, joint], data.upper.values[:, joint]
    axes.fill_between(t, lower, upper, color=_style.tube(), linewidth=0, zorder=0)
    for edge, text in ((lower, "tightest bounds"), (upper, "_")):
        axes.plot(t, edge, color=_style.bound(), linewidth=1.0, label=text)
    order = np.argsort(levels)
    for k in range(len(levels) // 2):
        low, high = order[k], order[-1 - k]
        words = f"{100 * levels[low]:g} to {100 * levels[high]:g} %"
        axes.fill_between(
            t, q[low], q[high], color=_style.colour(0), alpha=0.25, linewidth=0, label=words
        )
        axes.plot(t, q[low], color=_style.colour(0), linewidth=0.6, label="_")
        axes.plot(t, q[high], color=_style.colour(0), linewidth=0.6, label="_")
    if len(levels) % 2:
        middle = order[len(levels) // 2]
        axes.plot(t, q[middle], color=_style.colour(0), label=f"{100 * levels[middle]:g} %")
    axes.plot(t, data.q_d.values[:, joint], label="reference $q_d$", **_style.reference())
    axes.set_title(called(study.scenario.plant, study.scenario.n)[joint])
    axes.set_xlabel(_style.label("time $t$", "s"))
    axes.set_ylabel(_style.label("position $q$", "rad"))


# ------------------------------------------------------------------------------------------------- histograms and scatters


@_style.styled()
def histograms(study: Study, metrics: Sequence[str] | None = None, *, bins: int = 40) -> Figure:
    """Histograms of metrics, runs that failed and runs that did not apart.

    Args:
      study: the study.
      metrics: names; all that are finite in some run if not given.  Of each the worst joint.
      bins: number of bins.

    Returns:
      The figure, one panel a metric; runs without a finite value are counted in its title.

    Raises:
      ValueError: not a study, or an unknown metric.
    """
    _check(study)
    names = (
        list(study.metrics)
        if metrics is None
        else checks.listed("metrics", metrics, '["margin", "rmse"]')
    )
    values = {name: statistics.one_number(study.metrics, name) for name in names}
    if metrics is None:
        values = {
            name: x
            for name, x in values.items()
            if np.isfinite(x).any() and np.ptp(x[np.isfinite(x)]) > 0
        }
    if not values:
        raise checks.fail("metrics", names, "at least one metric with values that differ")
    figure, panels = _grid(len(values), 2.0)
    for axes, (name, x) in zip(panels, values.items(), strict=True):
        _draw_histogram(axes, study, name, x, checks.positive_integer("bins", bins, most=10_000))
    _style.head(figure, [_verdict(study)])
    _style.legend_below(figure)
    return figure


def _draw_histogram(axes: Axes, study: Study, name: str, x: np.ndarray, bins: int) -> None:
    failed = np.zeros(study.runs, bool)
    failed[study.failed] = True
    finite = np.isfinite(x)
    if finite.any():
        edges = np.histogram_bin_edges(x[finite].astype(float), bins).tolist()
        axes.hist(x[finite & ~failed], edges, label="not failed", alpha=0.8, color=_style.colour(0))
        axes.hist(
            x[finite & failed],
            edges,
            label="failed",
            alpha=0.8,
            hatch="////",
            edgecolor=_style.paper(),
            linewidth=0,
            color=_style.colour(1),
        )
    if not finite.all():
        axes.set_title(f"{int((~finite).sum())} runs without a value")
    axes.set_xlabel(_style.label(name.replace("_", " "), study.metrics.units.get(name, "1")))
    axes.set_ylabel("runs")


@_style.styled()
def scatter(study: Study, metric: str = "margin") -> Figure:
    """A metric (its worst joint) of every run against each drawn parameter, with the rank
    correlation.

    Args:
      study: the study.
      metric: name of the metric.

    Returns:
      The figure, one panel a parameter.

    Raises:
      ValueError: not a study, or an unknown metric.
    """
    _check(study)
    drawn = statistics.columns(study.samples)
    figure, panels = _grid(len(drawn), 2.2)
    for axes, (path, x) in zip(panels, drawn.items(), strict=True):
        _draw_scatter(axes, study, metric, path, x)
    _style.head(figure, [_verdict(study)])
    _style.legend_below(figure)
    return figure


def _draw_scatter(axes: Axes, study: Study, metric: str, path: str, x: np.ndarray) -> None:
    y = statistics.one_number(study.metrics, metric)
    failed = np.zeros(study.runs, bool)
    failed[study.failed] = True
    some = study.made & np.isfinite(y)
    good = np.flatnonzero(some & ~failed)
    good = good[:: max(1, len(good) // MOST_POINTS)]
    bad = np.flatnonzero(some & failed)[:MOST_POINTS]
    axes.scatter(
        x[good], y[good], s=4, alpha=0.5, linewidths=0, label="not failed", color=_style.colour(0)
    )
    axes.scatter(
        x[bad], y[bad], s=9, marker="x", linewidths=0.8, label="failed", color=_style.colour(1)
    )
    if metric in ("margin", "xi_margin"):
        axes.axhline(0.0, color=_style.bound(), linewidth=1.0)
    rho, _ = statistics.rank_correlation(x[some], y[some])
    axes.set_title("" if np.isnan(rho) else f"rank correlation {rho:.2f}")
    axes.locator_params(axis="x", nbins=4)
    axes.set_xlabel(_style.label(plain(path), study.parameter_unit(path)))
    axes.set_ylabel(
        _style.label(f"worst {metric.replace('_', ' ')}", study.metrics.units.get(metric, "1"))
    )


@_style.styled()
def study_overview(study: Study, *, runs: int = 512) -> Figure:
    """A study at a glance: the tube with bands, the margins by verdict, the margin against each
    parameter.

    Args:
      study: of n joints.
      runs: from how many of the runs the bands are made.

    Returns:
      The figure.

    Raises:
      ValueError: not a study, or one without the metric `margin`.
    """
    _check(study)
    drawn, data = statistics.columns(study.samples), study.bands(runs=runs)
    margins = statistics.one_number(study.metrics, "margin")
    count = study.scenario.n + 1 + len(drawn)
    figure, panels = _grid(count, 2.3)
    for joint in range(study.scenario.n):
        _draw_bands(panels[joint], data, joint, study)
    _draw_histogram(panels[study.scenario.n], study, "margin", margins, 40)
    for axes, (path, x) in zip(panels[study.scenario.n + 1 :], drawn.items(), strict=True):
        _draw_scatter(axes, study, "margin", path, x)
    _style.head(figure, [_verdict(study), f"bands: {_bands_title(data).lower()}"])
    _style.legend_below(figure, 6)
    return figure
