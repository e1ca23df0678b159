"""Figures of a sweep: heat maps over two of its dimensions, and parallel coordinates over all of
its parameters.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import matplotlib
import numpy as np
from matplotlib.figure import Figure

from iblf_jax.core import checks
from iblf_jax.core.status import FAILED, VIOLATED
from iblf_jax.plotting import _style
from iblf_jax.plotting._curves import plain
from iblf_jax.studies.statistics import SMALLER_IS_WORSE

if TYPE_CHECKING:
    import xarray

SHARES = {
    "failed": (int(FAILED), "share of failed runs [1]"),
    "violated": (int(VIOLATED), "share of runs that left a bound [1]"),
}
"""What may be drawn beside the metrics: the share of the runs that raised one of these flags."""
COLOURS = "viridis"


def summary(data: xarray.Dataset, metric: str) -> tuple[xarray.DataArray, str]:
    """One number a point, and what it is: the median over runs of the worst joint's metric, or the
    share of failed runs.
    """
    if "config" not in getattr(data, "attrs", {}):
        raise checks.fail(
            "data",
            type(data).__name__,
            "the Dataset of a sweep",
            "ij.sweep and ij.load_sweep return one.",
        )
    if metric in SHARES:
        flags, words = SHARES[metric]
        raised = ((data.status & flags) != 0).astype(float).where(data.status >= 0)
        return (raised.mean("run") if "run" in raised.dims else raised), words
    if metric not in data.data_vars:
        raise checks.fail(
            "metric", metric, "one of " + ", ".join([*SHARES, *map(str, data.data_vars)])
        )
    values, words = data[metric], metric.replace("_", " ")
    unit = values.attrs.get("units", "1")
    if "joint" in values.dims:
        smaller = metric in SMALLER_IS_WORSE
        values, words = (
            (values.min("joint") if smaller else values.max("joint")),
            f"{words} of the worst joint",
        )
    if "run" in values.dims:
        values, words = values.median("run"), f"median {words}"
    return values, f"{words} [{unit}]"


def _axis_label(data: xarray.Dataset, name: str) -> str:
    unit = data[name].attrs.get("units", "") if name in data.coords else ""
    return _style.label(plain(name), unit) if unit else plain(name)


@_style.styled()
def heat_map(
    data: xarray.Dataset,
    metric: str | Sequence[str] = "failed",
    *,
    x: str | None = None,
    y: str | None = None,
    **at: Any,
) -> Figure:
    """A number at every point over two dimensions of a grid; several numbers side by side.

    Args:
      data: the Dataset of a sweep.
      metric: name of a metric (the median over the runs, of the worst joint), "failed" for the
        share of runs that failed, or "violated" for that of those that left a bound; or several of
        them.
      x, y: dimensions of the axes; the first two if not given.
      at: for further dimensions, which value to show (`sel`, nearest), given as a dict:
        `heat_map(data, **{"observer.kf": 20})`.

    Returns:
      The figure, with the numbers in its cells if there are few.

    Raises:
      ValueError: no Dataset of a sweep, an unknown metric or dimension, or a dimension that is
        neither shown nor fixed.
    """
    metrics = [metric] if isinstance(metric, str) else list(metric)
    if not metrics:
        raise checks.fail("metric", metric, "at least one")
    figure = _style.new_figure(_style.WIDTH if len(metrics) == 1 else 5.2 * len(metrics), 4.2)
    for axes, name in zip(figure.subplots(1, len(metrics), squeeze=False)[0], metrics, strict=True):
        _heat(figure, axes, data, name, x, y, at)
    return figure


def _heat(
    figure: Figure,
    axes: Any,
    data: xarray.Dataset,
    metric: str,
    x: str | None,
    y: str | None,
    at: dict[str, Any],
) -> None:
    """One panel of a heat map."""
    values, words = summary(data, metric)
    for name, value in at.items():
        if name not in values.dims:
            raise checks.fail("dimension", name, "one of " + ", ".join(map(str, values.dims)))
        values = values.sel({name: value}, method="nearest")
    dims = [str(d) for d in values.dims]
    x = x if x is not None else (dims[0] if dims else "")
    y = y if y is not None else next((d for d in dims if d != x), "")
    if len(dims) != 2 or {x, y} != set(dims):
        raise checks.fail(
            "x, y",
            (x, y),
            f"two dimensions of {dims}",
            "Fix the others, heat_map(data, ..., **{'observer.kf': 20.0}).",
        )
    picture = values.transpose(y, x).values
    image = axes.imshow(picture, origin="lower", aspect="auto", cmap=_style.colour_map(COLOURS))
    axes.grid(visible=False)
    for axis, name in ((axes.xaxis, x), (axes.yaxis, y)):
        _ticks(axis, np.asarray(data[name].values))
    axes.set_xlabel(_axis_label(data, x))
    axes.set_ylabel(_axis_label(data, y))
    figure.colorbar(image, ax=axes, label=words)
    if picture.size <= 150:
        _write_numbers(axes, picture, image)


def _ticks(axis: Any, values: np.ndarray) -> None:
    places = np.unique(np.linspace(0, len(values) - 1, min(len(values), 12)).round().astype(int))
    axis.set_ticks(places, labels=[f"{values[i]:.4g}" for i in places])


def _write_numbers(axes: Any, picture: np.ndarray, image: Any) -> None:
    for (row, column), value in np.ndenumerate(picture):
        behind = image.cmap(image.norm(value))[:3] if np.isfinite(value) else _style.paper()
        colour = "black" if _style.is_light(behind) else "white"
        axes.text(
            column,
            row,
            f"{value:.3g}",
            ha="center",
            va="center",
            color=colour,
            fontsize=_style.size(7.5),
        )


@_style.styled()
def parallel(data: xarray.Dataset, metric: str = "margin") -> Figure:
    """Parallel coordinates: one line a point through the values of all swept parameters, coloured
    by a metric.

    Args:
      data: the Dataset of a sweep.
      metric: as for `heat_map`; it is the last axis too.

    Returns:
      The figure; every axis runs from the least to the greatest of its values.

    Raises:
      ValueError: no Dataset of a sweep, or an unknown metric.
    """
    values, words = summary(data, metric)
    columns = _columns(data, values)
    columns[words] = np.ravel(values.values)
    raw = np.stack(list(columns.values()), -1)
    raw = raw[np.isfinite(raw).all(1)]
    if not len(raw):
        raise checks.fail("metric", metric, "a metric that is finite at some point")
    low, high = raw.min(0), raw.max(0)
    scaled = (raw - low) / np.where(high > low, high - low, 1.0)
    figure = _style.new_figure(max(_style.WIDTH, 1.6 * len(columns)), 4.2)
    axes = figure.subplots()
    norm = matplotlib.colors.Normalize(low[-1], high[-1] if high[-1] > low[-1] else low[-1] + 1.0)
    mapper = matplotlib.cm.ScalarMappable(norm, _style.colour_map(COLOURS))
    for line, y in sorted(zip(scaled, raw[:, -1], strict=True), key=lambda pair: pair[1]):
        axes.plot(np.arange(len(columns)), line, color=mapper.to_rgba(y), linewidth=0.9, alpha=0.8)
    axes.set_xticks(np.arange(len(columns)), [_style.wrapped(plain(name), 18) for name in columns])
    axes.set_yticks([])
    for place, (bottom, top) in enumerate(zip(low, high, strict=True)):
        for value, height, side in ((bottom, -0.02, "top"), (top, 1.02, "bottom")):
            axes.text(
                place, height, f"{value:.4g}", ha="center", va=side, fontsize=_style.size(7.5)
            )
    axes.set_ylim(-0.1, 1.1)
    figure.colorbar(mapper, ax=axes, label=words)
    return figure


def _columns(data: xarray.Dataset, values: xarray.DataArray) -> dict[str, np.ndarray]:
    """Label of every swept number -> its value at every point, in the order of `values`."""
    columns = {}
    for path in json.loads(data.attrs["config"])["points"]:
        name = path if f"{path}_values" not in data.coords else f"{path}_values"
        coordinate = data[name]
        inner = [d for d in coordinate.dims if d not in values.dims]
        for place in np.ndindex(*(coordinate.sizes[d] for d in inner)):
            one = coordinate.isel(dict(zip(inner, place, strict=True)))
            label = path + "".join(f"[{i}]" for i in place)
            columns[_style.label(label, coordinate.attrs.get("units") or "1")] = np.ravel(
                one.broadcast_like(values).transpose(*values.dims).values
            )
    return columns
