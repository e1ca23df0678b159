"""Figures of a Monte-Carlo study: quantile bands of the positions, histograms of metrics for failed
and successful runs, and metrics against the drawn parameters.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, cast

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from iblf_jax.core import checks
from iblf_jax.plotting import _scales, _style
from iblf_jax.plotting._curves import ROUNDING, check_class, escaped, joint_labels
from iblf_jax.plotting._panels import quantity_of
from iblf_jax.studies import statistics
from iblf_jax.studies.first_exit import FirstExit
from iblf_jax.studies.study import Study
from iblf_jax.studies.summaries import LEVELS, REGIONS, initial_margins

if TYPE_CHECKING:
    import xarray

WIDTH = 10.0
COLUMNS = 4
"""Largest number of panels in a row."""
MAX_POINTS = 5000
"""Largest number of failed runs, and about that of successful ones, in a scatter."""


def _check(study: Study) -> None:
    check_class("study", study, Study, "ij.monte_carlo returns one.")


def _failure_summary(study: Study) -> str:
    text = (
        f"{study.runs} runs, {len(study.failed)} failed; bound violated or diverged:"
        f" {study.violation_probability}"
    )
    outside = study.status_counts["STARTED_OUTSIDE"]
    if outside:
        text += f", {outside} of them because they started outside"
    return text


def _is_failed(study: Study) -> np.ndarray:
    """Whether each run failed, (runs,) bool."""
    failed = np.zeros(study.runs, bool)
    failed[study.failed] = True
    return failed


def _grid(count: int, height: float) -> tuple[Figure, list[Axes]]:
    given = _style.given_panels(count)
    if given is not None:
        return cast(Figure, given[0].figure), given
    sizes = _style.row_sizes(count, COLUMNS)
    figure = _style.new_figure(max(4.0, WIDTH * sizes[0] / COLUMNS), 0.8 + height * len(sizes))
    return figure, [axes for row in _style.panel_rows(figure, count, COLUMNS) for axes in row]


# --- bands


@_style.figure_function
def bands(
    study: Study,
    *,
    quantiles: Sequence[float] = (0.05, 0.5, 0.95),
    runs: int = 1024,
    exclude_failed: bool = False,
) -> Figure:
    """Quantiles of the positions over the runs along time, with the bounds, for every joint.

    Args:
      study: the study, of n joints.
      quantiles: an odd number of levels in [0, 1]; the middle one is drawn as a line, the others as
        bands.
      runs: number of the study's runs that are simulated again for the quantiles.
      exclude_failed: leave out failed runs; the title states how many.

    Returns:
      The figure, one panel per joint.

    Raises:
      ValueError: not a Study, or invalid quantiles.
    """
    _check(study)
    data = study.bands(quantiles, runs=runs, exclude_failed=exclude_failed)
    figure, panels = _grid(study.scenario.n, 2.4)
    for joint, axes in enumerate(panels):
        _draw_bands(axes, data, joint, study)
    _style.set_heading(figure, [_bands_title(data)])
    _style.legend_below(figure)
    return figure


def _bands_title(data: xarray.Dataset) -> str:
    text = f"Quantiles of {data.attrs['runs']} runs"
    if data.attrs["failed_included"]:
        text += f", {data.attrs['failed_included']} failed ones among them"
    if data.attrs["excluded"]:
        text += f", {data.attrs['excluded']} left out"
    return text


def _draw_bands(axes: Axes, data: xarray.Dataset, joint: int, study: Study) -> None:
    t = data.time.values
    q = data.q.values[:, :, joint]
    levels = data["quantile"].values
    lower, upper = data.lower.values[:, joint], data.upper.values[:, joint]
    axes.fill_between(t, lower, upper, color=_style.tube(), linewidth=0, zorder=0)
    for edge, text in ((lower, "tightest bounds"), (upper, "_")):
        axes.plot(t, edge, color=_style.bound(), linewidth=1.0, label=text)
    order = np.argsort(levels)
    for k in range(len(levels) // 2):
        low, high = order[k], order[-1 - k]
        band = f"{100 * levels[low]:g} to {100 * levels[high]:g} %"
        axes.fill_between(
            t, q[low], q[high], color=_style.colour(0), alpha=0.25, linewidth=0, label=band
        )
        for edge in (q[low], q[high]):
            axes.plot(t, edge, color=_style.colour(0), linewidth=0.6, label="_")
    if len(levels) % 2:
        middle = order[len(levels) // 2]
        axes.plot(t, q[middle], color=_style.colour(0), label=f"{100 * levels[middle]:g} %")
    quantity = quantity_of(study.scenario, "q", joint)
    axes.plot(t, data.q_d.values[:, joint], label=quantity.guide_label, **_style.reference())
    axes.set_title(joint_labels(study.scenario.plant)[joint])
    _style.time_axis(axes)
    axes.set_ylabel(quantity.label)


# --- histograms and scatters


@_style.figure_function
def histograms(study: Study, metrics: Sequence[str] | None = None, *, bins: int = 40) -> Figure:
    """Histograms of metrics, with failed and successful runs in different colours.

    Args:
      study: the study.
      metrics: names; by default all metrics whose finite values differ.  Of a metric with one value
        per joint, the figure shows the worst joint.
      bins: number of bins.

    Returns:
      The figure, one panel per metric, whose title counts the runs without a finite value.

    Raises:
      ValueError: not a Study, or an unknown metric.
    """
    _check(study)
    names = list(study.metrics)
    if metrics is not None:
        names = checks.nonempty_list("metrics", metrics, '["margin", "rmse"]')
    values = {name: statistics.worst_joint(study.metrics, name) for name in names}
    if metrics is None:
        values = {name: x for name, x in values.items() if _scales.varies(x)}
    if not values:
        raise checks.fail("metrics", names, "at least one metric with values that differ")
    figure, panels = _grid(len(values), 2.0)
    for axes, (name, x) in zip(panels, values.items(), strict=True):
        _draw_histogram(axes, study, name, x, checks.positive_integer("bins", bins, most=10_000))
    _style.set_heading(figure, [_failure_summary(study), *start_notes(study, list(values))])
    _style.legend_below(figure)
    return figure


def _draw_histogram(axes: Axes, study: Study, name: str, x: np.ndarray, bins: int) -> None:
    failed = _is_failed(study)
    finite = np.isfinite(x)
    unit = study.metrics.units.get(name, "1")
    if _scales.varies(x):
        good, bad = x[finite & ~failed], x[finite & failed]
        both = np.concatenate([good, bad]).astype(float)
        scale = _scales.scale_of(both)
        edges = scale.spread(float(both.min()), float(both.max()), bins + 1)
        # The inverse of a scale rounds; the outermost values belong to the first and the last bar.
        edges[0], edges[-1] = both.min(), both.max()
        axes.hist(good, edges.tolist(), label="not failed", alpha=0.8, color=_style.colour(0))
        style: dict[str, Any] = {"alpha": 0.8, "color": _style.colour(1), "linewidth": 0}
        style |= {"hatch": "////", "edgecolor": _style.background()}
        axes.hist(bad, edges.tolist(), label="failed", **style)
        axes.set_xscale(scale.name, **scale.options)
    elif finite.any():
        centred: dict[str, Any] = {"transform": axes.transAxes, "ha": "center", "va": "center"}
        axes.text(0.5, 0.5, f"{x[finite][0]:.5g} {unit} in every run", **centred)
        axes.set_xticks([])
        axes.set_yticks([])
    notes = []
    if not finite.all():
        notes.append(f"{int((~finite).sum())} runs without a value")
    if set_by_start(study, name):
        notes.append("that of the start (t = 0) in every run")
    axes.set_title("\n".join(notes))
    axes.set_xlabel(_metric_label(study, name))
    axes.set_ylabel("runs")


def _metric_label(study: Study, name: str) -> str:
    """The label of a metric of the worst joint; a peak of a study is a size without sign."""
    words = name.replace("_", " ")
    if name.startswith("peak_"):
        words += " (absolute value)"
    return _style.label(words, study.metrics.units.get(name, "1"))


MARGINS = {
    "margin": LEVELS[0],
    "velocity_margin": LEVELS[1],
    "region_margin": REGIONS,
}
"""Metric -> the margin at the start in `initial_margins` of which it is the smallest value."""


def set_by_start(study: Study, metric: str) -> bool:
    """Whether the least margin of every run is its margin at t = 0, so that the distribution of the
    metric is that of the starts and says nothing about the law.
    """
    if metric not in MARGINS:
        return False
    at_start = initial_margins(study.scenario, study.samples).get(MARGINS[metric])
    least = statistics.worst_joint(study.metrics, metric)[study.made]
    if at_start is None or not least.size or not np.all(np.isfinite(least)):
        return False
    start = np.broadcast_to(np.min(at_start, axis=1), study.made.shape)[study.made]
    # A margin is the difference of numbers of the size of the bounds, about 1 in SI units.
    rounding = ROUNDING * np.finfo(least.dtype).eps * max(1.0, float(np.max(np.abs(start))))
    return bool(np.all(np.abs(least - start) <= rounding))


def start_notes(study: Study, metrics: Sequence[str]) -> list[str]:
    """A sentence for the margins among some metrics that the start sets in every run."""
    names = [name.replace("_", " ") for name in metrics if set_by_start(study, name)]
    if not names:
        return []
    return [
        f"The least {' and '.join(names)} of every run is that of its start (t = 0): its"
        " distribution is that of the starts and says nothing about the law."
    ]


@_style.figure_function
def scatter(study: Study, metric: str = "margin") -> Figure:
    """A metric (of the worst joint) of every run against each drawn parameter, with the rank
    correlation.

    Args:
      study: the study.
      metric: name of the metric.

    Returns:
      The figure, one panel per parameter.

    Raises:
      ValueError: not a Study, or an unknown metric.
    """
    _check(study)
    drawn = statistics.scalar_samples(study.samples)
    figure, panels = _grid(len(drawn), 2.2)
    for axes, (path, x) in zip(panels, drawn.items(), strict=True):
        _draw_scatter(axes, study, metric, path, x)
    _style.set_heading(figure, [_failure_summary(study), *start_notes(study, [metric])])
    _style.legend_below(figure)
    return figure


def _draw_scatter(axes: Axes, study: Study, metric: str, path: str, x: np.ndarray) -> None:
    y = statistics.worst_joint(study.metrics, metric)
    failed = _is_failed(study)
    known = study.made & np.isfinite(y)
    good = np.flatnonzero(known & ~failed)
    good = good[:: max(1, len(good) // MAX_POINTS)]
    bad = np.flatnonzero(known & failed)[:MAX_POINTS]
    dots: dict[str, Any] = {"s": 4, "alpha": 0.5, "linewidths": 0, "color": _style.colour(0)}
    crosses: dict[str, Any] = {"s": 9, "marker": "x", "linewidths": 0.8, "color": _style.colour(1)}
    axes.scatter(x[good], y[good], label="not failed", **dots)
    axes.scatter(x[bad], y[bad], label="failed", **crosses)
    _scales.follow(axes, "x", x[known])
    _scales.follow(axes, "y", y[known])
    if metric in ("margin", "xi_margin") and np.any(y[known] <= 0.0):
        axes.axhline(0.0, color=_style.bound(), linewidth=1.0)
    rho, _ = statistics.rank_correlation(x[known], y[known])
    if not np.isnan(rho):
        axes.set_title(f"rank correlation {rho:.2f}")
    if axes.get_xscale() == "linear":
        axes.locator_params(axis="x", nbins=4)
    axes.set_xlabel(_style.label(escaped(path), study.parameter_unit(path)))
    axes.set_ylabel(f"worst {_metric_label(study, metric)}")


@_style.figure_function
def study_overview(study: Study, *, runs: int = 512) -> Figure:
    """The overview of a study: quantile bands, a histogram of the margin, and the margin against
    each parameter.

    Args:
      study: the study, of n joints.
      runs: number of the study's runs that are simulated again for the bands.

    Returns:
      The figure.

    Raises:
      ValueError: not a Study, or one without the metric `margin`.
    """
    _check(study)
    n = study.scenario.n
    drawn = statistics.scalar_samples(study.samples)
    data = study.bands(runs=runs)
    margins = statistics.worst_joint(study.metrics, "margin")
    figure, panels = _grid(n + 1 + len(drawn), 2.3)
    for joint in range(n):
        _draw_bands(panels[joint], data, joint, study)
    _draw_histogram(panels[n], study, "margin", margins, 40)
    for axes, (path, x) in zip(panels[n + 1 :], drawn.items(), strict=True):
        _draw_scatter(axes, study, "margin", path, x)
    lines = [_failure_summary(study), f"bands: {_bands_title(data).lower()}"]
    _style.set_heading(figure, [*lines, *start_notes(study, ["margin"])])
    _style.legend_below(figure, 6)
    return figure


# --- first exit


@_style.figure_function
def first_exit(found: FirstExit | Mapping[str, FirstExit]) -> Figure:
    """The distribution of the first exit from the bounds along time, with its intervals.

    Args:
      found: of `Study.first_exit`, one or a dict of them by name.

    Returns:
      The figure.

    Raises:
      ValueError: something else.
    """
    named = found if isinstance(found, Mapping) else {"": found}
    if not named:
        raise checks.fail("found", found, "at least one FirstExit")
    for name, one in named.items():
        check_class(f"found[{name!r}]", one, FirstExit, "study.first_exit() returns one.")
    figure, (axes,) = _style.panels(6.0, 3.8)
    for k, (name, one) in enumerate(named.items()):
        colour = _style.colour(k)
        label = escaped(name) or "share of runs"
        axes.step(one.t, one.probability, where="post", color=colour, label=label)
        axes.fill_between(
            one.t, one.low, one.high, step="post", color=colour, alpha=0.25, linewidth=0
        )
    confidence = next(iter(named.values())).confidence
    axes.set_xlabel("time [s]")
    axes.set_ylabel("P(first exit up to t) [1]")
    axes.set_ylim(bottom=0.0)
    heading = f"First exit from the bounds, with {confidence:.0%} intervals"
    _style.set_heading(figure, [heading.replace("%", " %")])
    _style.legend_below(figure)
    return figure
