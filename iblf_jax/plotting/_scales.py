"""Chooses the scale and the limits of an axis from its data, so that all points are inside and do
not lie together in a corner.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from numpy.typing import ArrayLike

from iblf_jax.plotting._curves import ROUNDING

GAIN = 2.0
"""An axis is logarithmic if the middle half of the values then takes more than this many times the
share of the axis that it takes on a linear one."""
CORNER = 0.1
"""An axis is also logarithmic if the median of the values is then not within this share of the axis
from an end, and is so on a linear one."""
ROOM = 0.05
"""Room beyond the outermost values, as a share of the axis."""


class Scale(NamedTuple):
    """A scale of matplotlib: name and options, and its function with the inverse."""

    name: str
    options: dict[str, Any]
    forward: Callable[[np.ndarray], np.ndarray]
    inverse: Callable[[np.ndarray], np.ndarray]

    def spread(self, low: float, high: float, count: int, room: float = 0.0) -> np.ndarray:
        """Numbers at equal distances on the axis, from low to high and some room beyond them."""
        first, last = self.forward(np.array([low, high]))
        room = room * (last - first)
        return self.inverse(np.linspace(first - room, last + room, count))


LINEAR = Scale("linear", {}, lambda x: x, lambda x: x)
LOGARITHMIC = Scale("log", {}, np.log10, lambda y: 10.0**y)


def varies(x: np.ndarray) -> bool:
    """Whether the finite ones of some numbers differ by more than rounding errors."""
    x = _finite(x)
    if not x.size:
        return False
    unit_in_last_place = np.finfo(x.dtype).eps
    return bool(np.ptp(x) > ROUNDING * unit_in_last_place * np.max(np.abs(x)))


def _finite(x: ArrayLike) -> np.ndarray:
    values = np.ravel(np.asarray(x))
    if not np.issubdtype(values.dtype, np.floating):
        values = values.astype(float)
    return values[np.isfinite(values)]


def scale_of(x: ArrayLike) -> Scale:
    """The scale of an axis with these values: linear, unless a logarithmic one spreads their middle
    half (`GAIN`), or moves their median away from an end (`CORNER`).
    """
    values = _finite(x).astype(float)
    if not varies(values):
        return LINEAR
    other = LOGARITHMIC
    if np.min(values) <= 0.0:
        usual = float(np.quantile(np.abs(values), 0.75))
        if usual == 0.0:
            return LINEAR
        other = Scale(
            "symlog",
            {"linthresh": usual},
            lambda x: np.arcsinh(x / usual),
            lambda y: usual * np.sinh(y),
        )
    if _middle_share(other, values) > GAIN * _middle_share(LINEAR, values):
        return other
    if _is_in_corner(LINEAR, values) and not _is_in_corner(other, values):
        return other
    return LINEAR


def _middle_share(scale: Scale, values: np.ndarray) -> float:
    """The share of an axis that the middle half of the values takes."""
    low, first, third, high = scale.forward(np.quantile(values, [0.0, 0.25, 0.75, 1.0]))
    return float((third - first) / (high - low))


def _is_in_corner(scale: Scale, values: np.ndarray) -> bool:
    """Whether the median of the values is near an end of the axis."""
    low, middle, high = scale.forward(np.quantile(values, [0.0, 0.5, 1.0]))
    place = (middle - low) / (high - low)
    return bool(min(place, 1.0 - place) < CORNER)


def follow(axes: Axes, direction: str, x: ArrayLike) -> None:
    """Sets scale and limits of an axis so that it shows all finite ones of its values.

    Args:
      axes: the panel.
      direction: "x" or "y".
      x: the values along this axis.
    """
    values = _finite(x)
    if not values.size:
        return
    low, high = float(np.min(values)), float(np.max(values))
    scale = scale_of(values)
    limits = scale.spread(low, high, 2, ROOM)
    if not varies(values):
        room = 0.1 * abs(high) or 1.0
        limits = np.array([low - room, high + room])
    # The scale comes first, because it changes the limits.
    if direction == "x":
        axes.set_xscale(scale.name, **scale.options)
    else:
        axes.set_yscale(scale.name, **scale.options)
    axes.set(**{f"{direction}lim": limits.tolist()})
