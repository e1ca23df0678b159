"""Figures of a sweep: heat maps over two of its dimensions, and parallel coordinates over all of
its parameters.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from iblf_jax.core import checks
from iblf_jax.core.first_use import xarray
from iblf_jax.core.status import FAILED, VIOLATED
from iblf_jax.plotting import _style
from iblf_jax.plotting._curves import escaped
from iblf_jax.plotting._studies import MARGINS
from iblf_jax.studies.statistics import SMALLER_IS_WORSE

SHARES = {
    "failed": (int(FAILED), "share of failed runs [1]"),
    "violated": (int(VIOLATED), "share of runs that left a bound [1]"),
}
"""Names that are accepted besides metrics: the share of the runs with one of these flags."""
COLOURS = "viridis"


def summary(data: xarray.Dataset, metric: str) -> tuple[xarray.DataArray, str]:
    """One number per point of a sweep, and its label.

    Args:
      data: the Dataset of a sweep.
      metric: a metric, of which the result is the median over the runs of the worst joint's value,
        or a key of `SHARES`.

    Raises:
      ValueError: not the Dataset of a sweep, or an unknown metric.
    """
    if not isinstance(data, xarray.Dataset) or "config" not in data.attrs:
        remedy = "ij.sweep and ij.load_sweep return one."
        raise checks.fail("data", type(data).__name__, "the Dataset of a sweep", remedy)
    if metric in SHARES:
        flags, label = SHARES[metric]
        values = ((data.status & flags) != 0).astype(float).where(data.status >= 0)
        if "run" in values.dims:
            values = values.mean("run")
        return values, label
    if metric not in data.data_vars:
        raise checks.fail("metric", metric, f"one of {', '.join([*SHARES, *data.data_vars])}")
    values = data[metric]
    label = metric.replace("_", " ")
    unit = values.attrs.get("units", "1")
    rows = ("level", "model_level", "higher_level", "joint")
    entries = [name for name in rows if name in values.dims]
    if entries:
        values = values.min(entries) if metric in SMALLER_IS_WORSE else values.max(entries)
        label = f"{label} of the worst joint"
    if "run" in values.dims:
        values = values.median("run")
        label = f"median {label}"
    return values, f"{label} [{unit}]"


def _axis_label(data: xarray.Dataset, name: str) -> str:
    if name in data.coords and data[name].attrs.get("units"):
        return _style.label(escaped(name), data[name].attrs["units"])
    return escaped(name)


@_style.figure_function
def heat_map(
    data: xarray.Dataset,
    metric: str | Sequence[str] = "failed",
    *,
    x: str | None = None,
    y: str | None = None,
    **at: Any,
) -> Figure:
    """Heat map of a metric over two dimensions of a grid; one panel per metric.

    Args:
      data: the Dataset of a sweep.
      metric: name of a metric (the median over the runs, of the worst joint), "failed" for the
        share of failed runs, "violated" for the share of runs that left a bound, or a list of
        these.
      x, y: dimensions of the axes; the first two if not given.
      at: values of the other dimensions (the nearest point is shown), given as a dict:
        `heat_map(data, **{"observer.kf": 20})`.

    Returns:
      The figure, with the numbers in its cells if there are few.

    Raises:
      ValueError: not the Dataset of a sweep, an unknown metric or dimension, or a dimension that is
        neither an axis nor fixed.
    """
    if isinstance(metric, str):
        metric = [metric]
    metrics = checks.nonempty_list("metric", metric, '["failed", "rmse"], or a name')
    width = _style.WIDTH
    if len(metrics) > 1:
        width = 5.2 * len(metrics)
    panels = _style.given_panels(len(metrics))
    if panels is None:
        panels = list(_style.new_figure(width, 4.2).subplots(1, len(metrics), squeeze=False)[0])
    figure: Any = panels[0].figure
    for axes, name in zip(panels, metrics, strict=True):
        _draw_heat_map(figure, axes, data, name, x, y, at)
    return figure


def _draw_heat_map(
    figure: Figure,
    axes: Axes,
    data: xarray.Dataset,
    metric: str,
    x: str | None,
    y: str | None,
    at: dict[str, Any],
) -> None:
    """One panel of a heat map."""
    values, label = summary(data, metric)
    for name, value in at.items():
        if name not in values.dims:
            raise checks.fail("dimension", name, "one of " + ", ".join(map(str, values.dims)))
        values = values.sel({name: value}, method="nearest")
    dims = [str(d) for d in values.dims]
    if x is None:
        x = next((d for d in dims if d != y), "")
    if y is None:
        y = next((d for d in dims if d != x), "")
    if len(dims) != 2 or {x, y} != set(dims):
        remedy = "Fix the others, heat_map(data, ..., **{'observer.kf': 20.0})."
        raise checks.fail("x, y", (x, y), f"two dimensions of {dims}", remedy)
    picture = values.transpose(y, x).values
    image = axes.imshow(picture, origin="lower", aspect="auto", cmap=_style.colour_map(COLOURS))
    axes.grid(visible=False)
    for axis, name in ((axes.xaxis, x), (axes.yaxis, y)):
        numbers = np.asarray(data[name].values)
        last = len(numbers) - 1
        places = np.unique(np.linspace(0, last, min(last + 1, 12)).round().astype(int))
        axis.set_ticks(places, labels=[f"{numbers[i]:.4g}" for i in places])
    axes.set_xlabel(_axis_label(data, x))
    axes.set_ylabel(_axis_label(data, y))
    figure.colorbar(image, ax=axes, label=label)
    finite = picture[np.isfinite(picture)]
    has_values = metric not in SHARES and finite.size > 1
    if has_values and np.allclose(finite, finite[0], 1e-6, 0.0):
        # Then the picture says nothing about what was swept.
        reason = ", as margins of the start (t = 0) are" if metric in MARGINS else ""
        axes.set_title(f"equal at all points{reason}")
    if picture.size > 150:
        return
    centred: dict[str, Any] = {"ha": "center", "va": "center", "fontsize": _style.size(7.5)}
    for (row, column), number in np.ndenumerate(picture):
        cell: Any = _style.background()
        if np.isfinite(number):
            cell = image.cmap(image.norm(number))[:3]
        colour = "black" if _style.is_light(cell) else "white"
        axes.text(column, row, f"{number:.3g}", color=colour, **centred)


@_style.figure_function
def parallel(data: xarray.Dataset, metric: str = "margin") -> Figure:
    """Parallel coordinates: one line per point through the values of all swept parameters, coloured
    by a metric.

    Args:
      data: the Dataset of a sweep.
      metric: as for `heat_map`; it is also the last axis.

    Returns:
      The figure; every axis extends from the smallest to the largest value.

    Raises:
      ValueError: not the Dataset of a sweep, or an unknown metric.
    """
    values, label = summary(data, metric)
    columns = _columns(data, values)
    columns[label] = np.ravel(values.values)
    raw = np.stack(list(columns.values()), -1)
    raw = raw[np.isfinite(raw).all(1)]
    if not len(raw):
        raise checks.fail("metric", metric, "a metric that is finite at some point")
    low, high = raw.min(0), raw.max(0)
    width = np.where(high > low, high - low, 1.0)
    scaled = (raw - low) / width
    figure, (axes,) = _style.panels(max(_style.WIDTH, 1.6 * len(columns)), 4.2)
    norm = matplotlib.colors.Normalize(low[-1], low[-1] + width[-1])
    mapper = matplotlib.cm.ScalarMappable(norm, _style.colour_map(COLOURS))
    for line, y in sorted(zip(scaled, raw[:, -1], strict=True), key=lambda pair: pair[1]):
        axes.plot(np.arange(len(columns)), line, color=mapper.to_rgba(y), linewidth=0.9, alpha=0.8)
    names = [_style.wrapped(escaped(name), 18) for name in columns]
    axes.set_xticks(np.arange(len(columns)), names)
    axes.set_yticks([])
    small: dict[str, Any] = {"ha": "center", "fontsize": _style.size(7.5)}
    for place, (bottom, top) in enumerate(zip(low, high, strict=True)):
        axes.text(place, -0.02, f"{bottom:.4g}", va="top", **small)
        axes.text(place, 1.02, f"{top:.4g}", va="bottom", **small)
    axes.set_ylim(-0.1, 1.1)
    figure.colorbar(mapper, ax=axes, label=label)
    return figure


def _columns(data: xarray.Dataset, values: xarray.DataArray) -> dict[str, np.ndarray]:
    """Label of every swept number -> its value at every point, in the order of `values`."""
    columns = {}
    for path in json.loads(data.attrs["config"])["points"]:
        vector = f"{path}_values"  # the coordinate of a path to a vector
        coordinate = data[vector if vector in data.coords else path]
        unit = coordinate.attrs.get("units") or "1"
        inner = [d for d in coordinate.dims if d not in values.dims]
        for index in np.ndindex(*(coordinate.sizes[d] for d in inner)):
            entry = coordinate.isel(dict(zip(inner, index, strict=True)))
            label = path + "".join(f"[{i}]" for i in index)
            at_points = entry.broadcast_like(values).transpose(*values.dims)
            columns[_style.label(label, unit)] = np.ravel(at_points.values)
    return columns
